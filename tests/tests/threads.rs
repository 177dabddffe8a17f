//! Threads change the duration of a simulation, not its result.

use dragfree_tests::simulate;
use std::path::Path;

/// Telemetry and truth of both days.
fn files(folder: &Path, threads: &str) -> Vec<Vec<u8>> {
    let arguments = ["--start", "2035-01-01T23:45:00Z", "--hours", "0.5", "--seed", "3", "--threads", threads];
    let telemetry = simulate(folder, &arguments);
    assert_eq!(telemetry.len(), 2, "the half hour goes over midnight");
    let truth = telemetry.iter().map(|path| folder.join("truth").join(path.file_name().expect("a file")));
    telemetry.iter().cloned().chain(truth).map(|path| std::fs::read(path).expect("written")).collect()
}

#[test]
fn files_do_not_depend_on_the_threads() {
    let [one, two, three] = ["1", "2", "3"].map(|threads| {
        let folder = tempfile::tempdir().expect("a folder");
        files(folder.path(), threads)
    });
    assert!(one == two && one == three);
}
