//! Bad input and the calibration: what is missing or wrong is left out and counted, and what is left gives the right offsets.
//!
//! All tests change copies of the same six hours (seed 1). Every product's coefficients must lie within 3σ of the truth: with the
//! noise of one seed that is one draw of twelve correlated numbers, so a right program fails with probability 3.2 % at
//! most (union bound), whatever the number of tests. That a wrong offset would be seen is the last test's business.

use dragfree_tests::recording::{Message, Recording};
use dragfree_tests::{coefficient, dragfree, fixture, simulate};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use tempfile::TempDir;

const SECOND_NS: u64 = 1_000_000_000;
const EPOCHS: u64 = 216_000;

/// The offsets of the paper's Table tab:com_calibration_results, m.
const TRUTH_M: [(&str, f64); 6] = [
    ("com-offset.tm1.x", 0.090_866_025_403_784_44),
    ("com-offset.tm1.y", 0.155_384_572_681_198_96),
    ("com-offset.tm1.z", 0.0),
    ("com-offset.tm2.x", 0.090_866_025_403_784_44),
    ("com-offset.tm2.y", -0.155_384_572_681_198_96),
    ("com-offset.tm2.z", 0.0),
];

/// Six hours of telemetry, made once.
fn sound() -> &'static (TempDir, PathBuf, Recording) {
    static SOUND: OnceLock<(TempDir, PathBuf, Recording)> = OnceLock::new();
    SOUND.get_or_init(|| {
        let dir = tempfile::tempdir().expect("a temporary folder");
        let file = simulate(dir.path(), &["--hours", "6", "--seed", "1"]).remove(0);
        let recording = Recording::read(&file);
        (dir, file, recording)
    })
}

/// What came of a run.
struct Run {
    code: Option<i32>,
    stderr: String,
    product: Value,
}

impl Run {
    fn count(&self, stage: &str, what: &str) -> u64 {
        self.product["quality"]["counts"][stage][what].as_u64().unwrap_or(0)
    }

    fn rejected(&self) -> u64 {
        self.product["epochs_rejected"].as_u64().expect("a count")
    }

    fn notes(&self) -> String {
        self.product["quality"]["notes"].to_string()
    }
}

/// A run of science mode over `files` with the mission and the model given.
fn run(folder: &Path, files: &[PathBuf], mission: Option<&Path>, model: Option<&Path>) -> Run {
    let mut command = dragfree(folder);
    command.arg("run").arg(fixture("pipelines/science-mode.toml")).args(files).args(["--archive", "archive", "--json"]);
    for (option, path) in [("--mission", mission), ("--model", model)] {
        if let Some(path) = path {
            command.arg(option).arg(path);
        }
    }
    let output = command.output().expect("the program runs");
    let stderr = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.code().is_some() && !stderr.contains("panicked"), "{stderr}");
    Run { code: output.status.code(), stderr, product: serde_json::from_slice(&output.stdout).unwrap_or(Value::Null) }
}

/// A run over the six hours as `change` leaves them.
fn run_changed(change: impl FnMut(Message) -> Option<Message>) -> Run {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let file = dir.path().join("changed.mcap");
    sound().2.write(&file, change);
    run(dir.path(), &[file], None, None)
}

/// The mission file with a text replaced.
fn mission(folder: &Path, from: &str, to: &str) -> PathBuf {
    let text = std::fs::read_to_string(fixture("missions/taiji.toml")).expect("readable");
    assert!(text.contains(from), "{from}");
    let path = folder.join("mission.toml");
    std::fs::write(&path, text.replace(from, to)).expect("writable");
    path
}

/// Whether a message lies in a stretch of the six hours, s.
fn within(message: &Message, from_s: u64, until_s: u64) -> bool {
    let start = sound().2.start_ns();
    (start + from_s * SECOND_NS..start + until_s * SECOND_NS).contains(&message.log_time)
}

fn is(message: &Message, topic: &str) -> bool {
    *message.topic == *topic
}

/// Errors over σ of all coefficients that have a σ.
fn pulls(product: &Value) -> Vec<(String, f64)> {
    let all = TRUTH_M.iter().flat_map(|(name, truth)| ["es-akf", "qp"].map(|solution| (name, truth, solution)));
    let of = |(name, truth, solution): (&&str, &f64, &str)| {
        let (value, sigma) = coefficient(product, name, solution);
        (format!("{name} by {solution}"), (value - truth) / sigma)
    };
    all.map(|(name, truth, solution)| of((name, truth, solution))).collect()
}

fn assert_right(run: &Run) {
    for (name, pull) in pulls(&run.product) {
        assert!(pull.abs() <= 3.0, "{name} is {pull:.2}σ from the truth\n{}", run.notes());
    }
}

/// The product of the telemetry as it is.
fn reference() -> &'static Run {
    static REFERENCE: OnceLock<Run> = OnceLock::new();
    REFERENCE.get_or_init(|| {
        let dir = tempfile::tempdir().expect("a temporary folder");
        run(dir.path(), &[sound().1.clone()], None, None)
    })
}

fn print(what: &str, run: &Run) {
    println!(
        "==== {what}: exit {:?} verdict {} used {} rejected {} commands {}\n{}",
        run.code,
        run.product["verdict"],
        run.product["epochs_used"],
        run.product["epochs_rejected"],
        run.product["commands"],
        run.stderr
    );
    println!("counts {}", run.product["quality"]["counts"]);
    println!("weak {}", run.product["weak_directions"]);
    if let Some(n) = run.product["quality"]["notes"].as_array() {
        for n in n {
            println!("   NOTE {n}");
        }
    }
    if run.product.is_null() {
        return;
    }
    for (name, truth) in TRUTH_M {
        for s in ["es-akf", "qp"] {
            let all = run.product["coefficients"].as_array().unwrap();
            let Some(c) = all.iter().find(|c| c["name"] == name && c["solution"] == s) else {
                println!("  no {name} {s}");
                continue;
            };
            let (v, g) = (c["value"].as_f64().unwrap_or(f64::NAN), c["sigma"].as_f64().unwrap_or(f64::NAN));
            println!(
                "  {name} {s:7} err {:9.4} mm σ {:8.4} mm pull {:6.2}",
                (v - truth) * 1e3,
                g * 1e3,
                (v - truth) / g
            );
        }
    }
}

#[test]
fn explore() {
    print("reference", reference());
    print(
        "gaps",
        &run_changed(|m| {
            let t = (m.log_time - sound().2.start_ns()) / SECOND_NS;
            let gap = [(1000, 1003), (2000, 2003), (3000, 3002), (4000, 4060), (5000, 5300), (9000, 16200)]
                .iter()
                .any(|(a, b)| (*a..*b).contains(&t));
            (!gap).then_some(m)
        }),
    );
    for topic in ["/dws", "/ifo", "/is", "/command", "/ephemeris"] {
        print(
            &format!("no {topic} for two hours"),
            &run_changed(|m| (!(is(&m, topic) && within(&m, 7_200, 14_400))).then_some(m)),
        );
    }
    print(
        "no command in the first hour",
        &run_changed(|m| (!(is(&m, "/command") && within(&m, 0, 3_600))).then_some(m)),
    );
    print("tm2 gone, model of both", &run_changed(without_tm2));
    let dir = tempfile::tempdir().expect("a temporary folder");
    let file = dir.path().join("changed.mcap");
    sound().2.write(&file, without_tm2);
    let model = dir.path().join("model.toml");
    std::fs::write(
        &model,
        "[model]\nrevision = \"1\"\n[[effect]]\nid = \"com-offset\"\ninstance = \"tm1\"\nestimate = true\n",
    )
    .unwrap();
    print("tm2 gone, model of tm1", &run(dir.path(), &[file.clone()], None, Some(&model)));
    print("all there, model of tm1", &run(dir.path(), &[sound().1.clone()], None, Some(&model)));
    print(
        "status",
        &run_changed(|mut m| {
            if is(&m, "/is") && within(&m, 3000, 3600) {
                m.set_number(&[1, 3], 1);
            }
            if is(&m, "/ifo") && within(&m, 6000, 6300) {
                m.set_number(&[2, 2], 2);
            }
            if is(&m, "/dws") && within(&m, 9000, 9600) {
                m.set_number(&[4], 4);
            }
            Some(m)
        }),
    );
    print(
        "stuck at a limit",
        &run_changed(|mut m| {
            if is(&m, "/is") && within(&m, 3000, 3600) {
                m.set_double(&[1, 1, 2], 5e-6);
            }
            if is(&m, "/dws") && within(&m, 9000, 9030) {
                m.set_double(&[3, 1], 1e-6);
            }
            if is(&m, "/ifo") && within(&m, 12000, 12030) {
                m.set_double(&[2, 1], 1.0);
            }
            Some(m)
        }),
    );
    for (topic, path, size) in [
        ("/is", &[1u64, 1, 2][..], 20.0 * 1.8e-9 * 5f64.sqrt()),
        ("/is", &[2, 1, 3], 20.0 * 1.8e-9 * 5f64.sqrt()),
        ("/ifo", &[1, 1], 20.0 * 1.42e-12 * 5f64.sqrt()),
        ("/dws", &[3, 3], 20.0 * 5e-10 * 5f64.sqrt()),
    ] {
        let mut k = 0u64;
        print(
            &format!("outliers {topic} {path:?}"),
            &run_changed(|mut m| {
                if is(&m, topic) {
                    k += 1;
                    if k.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407) >> 33 < (1 << 31) / 1000 {
                        let v = m.double(path).unwrap();
                        m.set_double(path, v + if k % 2 == 0 { size } else { -size });
                    }
                }
                Some(m)
            }),
        );
    }
    for (topic, paths) in [
        ("/is", vec![vec![1u64, 1, 2]]),
        ("/dws", vec![vec![3, 1], vec![3, 2], vec![3, 3]]),
        ("/ifo", vec![vec![1, 1]]),
    ] {
        print(
            &format!("constant {topic}"),
            &run_changed(|mut m| {
                if is(&m, topic) {
                    for p in &paths {
                        m.set_double(p, 1e-9);
                    }
                }
                Some(m)
            }),
        );
    }
    for (from, to) in [
        ("offset_nominal_srf_m = [0.0, 0.18, 0.0] ", "offset_nominal_srf_m = [0.0, 0.195, 0.0] "),
        ("offset_nominal_srf_m = [0.0, 0.18, 0.0] ", "offset_nominal_srf_m = [0.0, 0.205, 0.0] "),
    ] {
        let dir = tempfile::tempdir().expect("a temporary folder");
        let mission = mission(dir.path(), from, to);
        print(to, &run(dir.path(), &[sound().1.clone()], Some(&mission), None));
    }
}

fn without_tm2(mut m: Message) -> Option<Message> {
    match &*m.topic {
        "/is" | "/ifo" | "/dws" => m.remove(2),
        "/command" => m.remove(4),
        _ => {}
    }
    Some(m)
}
