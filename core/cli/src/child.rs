//! How a process ended that gave no answer.

use std::process::ExitStatus;

pub(crate) fn ended(status: ExitStatus) -> String {
    #[cfg(unix)]
    if let Some(signal) = std::os::unix::process::ExitStatusExt::signal(&status) {
        let name = match signal {
            4 => ", an illegal instruction",
            6 => ", it aborted",
            7 | 11 => ", memory that is not its own",
            8 => ", a division of whole numbers by zero",
            _ => "",
        };
        return format!("crashed: signal {signal}{name}");
    }
    format!("ended the process: {status}")
}
