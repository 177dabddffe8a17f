//! The unit tests of the border under Miri, which sees what no run shows: a pointer used after what it points to was
//! lent again, a read of what was never written.

use std::process::Command;

use crate::Failure;
use crate::dist::ROOT;

/// What Miri comes with: not the compiler of the project.
const TOOLCHAIN: &str = "nightly";

/// Installs Miri where it is missing, and runs the tests of the border that need no shared memory.
///
/// # Errors
/// Miri cannot be had, or a test fails.
pub(crate) fn look() -> Result<String, Failure> {
    let miri = || {
        let mut command = Command::new("rustup");
        command.args(["run", TOOLCHAIN, "cargo", "miri"]).current_dir(ROOT);
        // This program was started by the project's own toolchain.
        command.env_remove("RUSTUP_TOOLCHAIN").env_remove("CARGO").env_remove("RUSTC").env_remove("RUSTDOC");
        command
    };
    if !miri().arg("--version").output().is_ok_and(|output| output.status.success()) {
        let mut install = Command::new("rustup");
        install.args(["toolchain", "install", TOOLCHAIN, "--profile", "minimal", "--component", "miri,rust-src"]);
        succeed(&mut install)?;
    }
    let mut test = miri();
    test.args(["test", "--package", "dragfree-engine", "--lib", "--target-dir", "target/miri", "--", "border::"]);
    test.args(["--skip", "isolated::"]).env("MIRIFLAGS", "-Zmiri-disable-isolation");
    succeed(&mut test)?;
    Ok("Miri finds nothing in the border\n".to_owned())
}

fn succeed(command: &mut Command) -> Result<(), Failure> {
    let status = command.status()?;
    if status.success() { Ok(()) } else { Err(format!("{command:?} ended by {status}").into()) }
}
