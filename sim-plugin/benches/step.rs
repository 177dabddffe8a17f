//! One sample of the loop, and of its equations of motion alone.
fn main() {}
