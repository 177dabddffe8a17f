//! Tests that take from half a minute to some minutes each, a quarter of an hour together:
//! `cargo test --release -p dragfree-tests --test long`. `cargo test` without this name leaves them out (Cargo.toml).
//! They are to pass before a release, and with every change of what a diagnosis says.

mod long_diagnoses;
mod next;
