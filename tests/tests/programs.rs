//! The whole-program tests in one binary: linked once, on all cores until the last one ends. Each file is a module, so
//! that `cargo test --release -p dragfree-tests --test programs traps` runs the tests of `traps.rs`.
//!
//! `diagnosis.rs` and `foreign.rs`, which take longest, are binaries of their own, and so is `long.rs`, which runs only
//! where it is asked for. A file that is in none of these places is found by `architecture.rs`.

mod abi_v1;
mod accelerometer;
mod architecture;
mod archive;
mod bad_input;
mod border;
mod calibration_bad_input;
mod campaigns;
mod changes;
mod command_line;
mod compare;
mod crash;
mod day_to_day;
mod declared_noise;
mod design;
mod diagnosis_bad_input;
mod effects_actuators;
mod effects_stray;
mod extracts;
mod first_day;
mod guide;
mod hidden;
mod hostile;
mod json_schema;
mod loop_gains;
mod many_days;
mod missions;
mod model;
mod noise_effects;
mod operations;
mod over_time;
mod plugin_author;
mod python_reader;
mod recursive_solutions;
#[path = "release/main.rs"]
mod release;
mod replayed_law;
mod second_checkout;
mod settings;
mod threads;
mod traps;
mod workbench;
