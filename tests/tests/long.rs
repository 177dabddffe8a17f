//! Tests that take a minute and more each: `cargo test --release -p dragfree-tests --test long`, about a quarter of an hour.
//! `cargo test` without this name leaves them out (Cargo.toml). They are to pass before a release, and with every change
//! of what a diagnosis says.

mod long_diagnoses;
mod next;
