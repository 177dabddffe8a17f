//! The dragfree command.
fn main() {}
