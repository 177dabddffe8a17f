//! All files of a spacecraft as one stream: order, resumption, days, releases, losses.

use std::path::{Path, PathBuf};

use dragfree_gracefo::archive::Container;
use dragfree_gracefo::rows::EPOCH_UNIX_S;
use dragfree_gracefo::telemetry::Telemetry;
use dragfree_gracefo::{Window, source::letter_of};
use dragfree_sdk::{PluginError, state};

/// 2023-06-01T00:00:00 on the mission's time scale.
const MIDNIGHT_NS: i64 = (EPOCH_UNIX_S + 738_849_600) * 1_000_000_000;

fn fixture(level: &str) -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
        .join(format!("../../fixtures/gracefo/gracefo_{level}_2023-06-01_RL04.ascii.noLRI.tgz"))
}

fn both() -> [PathBuf; 2] {
    [fixture("1A"), fixture("1B")]
}

fn open(files: &[PathBuf], wanted: &[&str]) -> Telemetry {
    let wanted: Vec<String> = wanted.iter().map(|w| (*w).to_owned()).collect();
    Telemetry::open(files, 'C', Window::ALL, &wanted).expect("opens")
}

/// Table, time, and bits of the values.
type Row = (usize, i64, Vec<u64>);

fn drain(stream: &mut Telemetry, batch: usize, most: usize) -> Vec<Row> {
    let mut all = Vec::new();
    let mut complete = i64::MIN;
    for _ in 0..most {
        let before = all.len();
        let (until, done) = stream
            .next(batch, |table, k, rows| {
                all.push((table, rows.time_ns[k], rows.columns.iter().map(|c| c[k].to_bits()).collect()));
            })
            .expect("reads");
        assert!(all.len() - before <= batch);
        assert!(all[before..].iter().all(|r: &Row| r.1 >= complete), "a row after its time was complete");
        assert!(until >= complete);
        complete = until;
        if done {
            break;
        }
    }
    all
}

/// Writes a changed member of the fixtures as a plain file.
fn write(dir: &Path, level: &str, name: &str, as_name: &str, change: impl Fn(String) -> String) -> PathBuf {
    let path = dir.join(as_name);
    let container = Container::open(&fixture(level)).expect("fixture");
    container
        .visit(|member, text| {
            if member.name == name {
                let mut content = String::new();
                text.read_to_string(&mut content).expect("text");
                std::fs::write(&path, change(content)).expect("write");
            }
        })
        .expect("whole archive");
    path
}

#[test]
fn rows_are_in_time_order_for_any_batch() {
    let whole = drain(&mut open(&both(), &[]), usize::MAX / 2, 9);
    // Eleven products of 100 rows, but MAS1A with 24.
    assert_eq!(whole.len(), 1024);
    assert!(whole.is_sorted_by_key(|r| (r.1, r.0)));
    for batch in [1, 7, 777] {
        assert!(drain(&mut open(&both(), &[]), batch, usize::MAX) == whole, "batch {batch}");
    }
}

fn saved(stream: &mut Telemetry) -> Vec<u8> {
    state::save("gracefo", 1, |state| stream.visit(state)).expect("saves")
}

fn load(stream: &mut Telemetry, bytes: &[u8]) -> Result<(), PluginError> {
    state::load("gracefo", 1, bytes, |state| stream.visit(state))
}

#[test]
fn a_stream_resumes_where_it_was_saved() {
    let mut stream = open(&both(), &["ACC1A", "SCA1B"]);
    let fresh = saved(&mut stream);
    let first = drain(&mut stream, 10, 7);
    let state = saved(&mut stream);
    let rest = drain(&mut stream, 10, usize::MAX);
    let log = stream.log().clone();

    let mut other = open(&both(), &["ACC1A", "SCA1B"]);
    load(&mut other, &state).expect("loads");
    assert!(drain(&mut other, 33, usize::MAX) == rest);
    assert_eq!(other.log(), &log, "nothing is counted twice");
    load(&mut other, &fresh).expect("loads");
    let again = drain(&mut other, 5, usize::MAX);
    assert!(again == [first, rest].concat());

    assert!(load(&mut open(&both(), &["ACC1A"]), &state).is_err(), "other tables");
    assert!(load(&mut other, &state[..state.len() / 2]).is_err());
    assert!(load(&mut other, b"").is_err());
}

#[test]
fn deviations_of_the_real_files_are_counted_without_loss() {
    let mut stream = open(&both(), &[]);
    drain(&mut stream, 1000, usize::MAX);
    let log = stream.log();
    let count = |k: &str| log.counts.get(k).copied().unwrap_or(0);
    assert_eq!((count("acc1a.rows"), count("gni1b.fill_values"), count("mas1a.rows")), (100, 600, 24));
    assert_eq!((count("acc1a.header_count_wrong"), count("mas1a.header_count_wrong")), (1, 0));
    assert!(log.notes["promised.ACC1A"].contains("864078"));
    assert!(!log.data_loss, "{log:?}");
}

#[test]
fn days_follow_each_other_and_late_rows_are_dropped() {
    let dir = tempfile::tempdir().expect("directory");
    let name = "SCA1B_2023-06-01_C_04.txt";
    // The next file: the same rows 98 s later, two of which the first file has already; q as −q.
    let later = |text: String| {
        let (header, body) = text.split_once("# End of YAML header\n").expect("header");
        let body: String = body
            .lines()
            .map(|line| {
                let mut words: Vec<String> = line.split_whitespace().map(str::to_owned).collect();
                words[0] = (words[0].parse::<i64>().expect("seconds") + 98).to_string();
                for w in &mut words[3..7] {
                    *w = (-w.parse::<f64>().expect("number")).to_string();
                }
                words.join(" ") + "\n"
            })
            .collect();
        format!("{header}# End of YAML header\n{body}")
    };
    let files =
        [write(dir.path(), "1B", name, "SCA1B_2023-06-02_C_04.txt", later), write(dir.path(), "1B", name, name, |t| t)];
    let whole = drain(&mut open(&files, &[]), 1, usize::MAX);
    let times: Vec<i64> = whole.iter().map(|r| (r.1 - MIDNIGHT_NS) / 1_000_000_000).collect();
    assert_eq!(times, (0..198).collect::<Vec<_>>());
    let w = |row: usize| f64::from_bits(whole[row].2[0]);
    assert!(w(99) > 0.0 && w(100) > 0.0, "one sign across midnight");
    for batch in [99, 100, 101, 150, 1000] {
        let mut stream = open(&files, &[]);
        assert!(drain(&mut stream, batch, usize::MAX) == whole, "batch {batch}");
        assert_eq!(stream.log().counts["sca1b.rows_late"], 2);
        assert_eq!(stream.log().counts["sca1b.rows"], 198);
    }
    let mut stream = open(&files, &[]);
    let first = drain(&mut stream, 75, 2);
    let state = saved(&mut stream);
    let mut other = open(&files, &[]);
    load(&mut other, &state).expect("loads");
    assert!([first, drain(&mut other, 75, usize::MAX)].concat() == whole, "resumed on the second day");
}

#[test]
fn the_newer_of_two_releases_is_used() {
    let dir = tempfile::tempdir().expect("directory");
    let name = "ACT1B_2023-06-01_C_04.txt";
    let old = write(dir.path(), "1B", name, "ACT1B_2023-06-01_C_03.txt", |t| t.replace("e-07 ", "e-06 "));
    let alone = drain(&mut open(&[fixture("1B")], &["ACT1B"]), 50, usize::MAX);
    let mut stream = open(&[old, fixture("1B")], &["ACT1B"]);
    assert!(drain(&mut stream, 50, usize::MAX) == alone);
    assert_eq!(stream.log().counts["act1b.rows_duplicate"], 100);
}

#[test]
fn damage_is_noted_as_data_loss() {
    let dir = tempfile::tempdir().expect("directory");
    let acc = "ACC1A_2023-06-01_C_04.txt";
    let files = [
        write(dir.path(), "1A", acc, acc, |t| t[..t.len() - 40].replace("\n738849601 ", "\nnonsense ")),
        write(dir.path(), "1B", "SCA1B_2023-06-01_C_04.txt", "SCA1B_2023-06-01_C_04.txt", |t| {
            t.replace("gps_time", "time")
        }),
    ];
    let mut stream = open(&files, &[]);
    let rows = drain(&mut stream, 1000, usize::MAX);
    let log = stream.log();
    assert_eq!(rows.len(), 89);
    assert_eq!((log.counts["acc1a.garbage_lines"], log.counts["acc1a.files_truncated"]), (10, 1));
    assert_eq!(log.counts["sca1b.files_refused"], 1);
    assert!(log.data_loss);
    for (kind, words) in
        [("garbage.ACC1A", "10 unreadable lines"), ("truncated.ACC1A", "truncated"), ("refused.SCA1B", "gps_time")]
    {
        assert!(log.notes[kind].contains(words), "{}", log.notes[kind]);
    }
}

#[test]
fn unusable_files_are_refused_with_a_reason() {
    let nothing = Telemetry::open(&[fixture("1B")], 'C', Window::ALL, &["ACC1A".to_owned()]).expect_err("no ACC1A");
    assert!(nothing.to_string().contains("spacecraft C") && nothing.to_string().contains("ACT1B"), "{nothing}");
    let unknown = Telemetry::open(&both(), 'C', Window::ALL, &["KBR1B".to_owned()]).expect_err("unknown");
    assert!(unknown.to_string().contains("KBR1B") && unknown.to_string().contains("SCA1B"), "{unknown}");
    let missing = Telemetry::open(&[PathBuf::from("/nowhere.tgz")], 'C', Window::ALL, &[]).expect_err("no file");
    assert!(missing.to_string().contains("/nowhere.tgz"), "{missing}");
    assert!(Telemetry::open(&[], 'C', Window::ALL, &[]).is_err());
    assert_eq!(letter_of("GRACE-FO-D").ok(), Some('D'));
    assert!(letter_of("SC1").expect_err("no letter").message().contains("mission.spacecraft"));
}
