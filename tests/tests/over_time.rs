//! Series over time: residuals as large as the declared noise where the model is right, and a glitch where and when it
//! is; the estimated angular acceleration, and the filter's innovations.

use dragfree_tests::recording::Recording;
use dragfree_tests::{dragfree, expect, fixture, json, simulate};
use std::path::Path;

const AXES: std::ops::RangeInclusive<u64> = 1..=3;

/// What the page of a product says of a channel's residual over time.
#[derive(Debug)]
struct Told {
    channel: String,
    /// Root of the mean square of the means over their σ.
    size: f64,
    /// Seconds of the day at which the farthest mean lies.
    farthest_s: f64,
    stands_out: bool,
}

/// The page "Compare" of a simulated product, channel by channel.
fn told(arguments: &[&str]) -> Vec<Told> {
    let folder = tempfile::tempdir().expect("a folder");
    let files = simulate(folder.path(), arguments);
    let mut run = dragfree(folder.path());
    run.arg("run").arg(fixture("pipelines/science-mode.toml")).args(&files).args(["--archive", "archive", "--json"]);
    let output = run.output().expect("runs");
    assert!(matches!(output.status.code(), Some(0 | 4)), "{}", String::from_utf8_lossy(&output.stderr));
    expect(dragfree(folder.path()).args(["report", "2035-01-01", "--archive", "archive", "--out", "pages"]), 0);
    let page = std::fs::read_to_string(folder.path().join("pages/compare.html")).expect("the page");
    let data = page.split("id=\"over-time\">").nth(1).and_then(|rest| rest.split("</script>").next());
    let data: serde_json::Value = serde_json::from_str(data.expect("the data")).expect("JSON");
    let stretches = data["time"].as_array().expect("times").len();
    assert!((300..=720).contains(&stretches), "{stretches}");
    page.split("<section class=\"chart\">").skip(1).map(of_section).collect()
}

fn of_section(text: &str) -> Told {
    let between = |from: &str, to: &str| {
        let rest = text.split(from).nth(1).unwrap_or_else(|| panic!("no {from} in {text}"));
        rest.split(to).next().unwrap_or_default().trim().to_owned()
    };
    let clock = between(" σ at ", ".");
    let parts: Vec<f64> = clock.split(':').map(|part| part.parse().expect("a time")).collect();
    Told {
        channel: between("data-over-time=\"", "\""),
        size: between("Size ", ",").parse().expect("a number"),
        farthest_s: 3600.0 * parts[0] + 60.0 * parts[1] + parts[2],
        stands_out: text.contains("stands out"),
    }
}

/// Two hours have 1920 intervals of 3.75 s. Neighbouring means of second differences have correlations down to −0.5,
/// so that the mean square of so many has a σ of √(3/1920) = 0.04 and its root one of 0.02: five of them are 0.1 (false
/// alarm 5e-6 for nine channels). That a mean stands out has a false alarm of 1 %.
#[test]
fn where_the_model_is_right_residuals_are_as_large_as_the_noise() {
    let all = told(&["--hours", "2", "--seed", "21"]);
    assert_eq!(all.len(), 9, "{all:?}");
    for channel in &all {
        assert!((channel.size - 1.0).abs() < 0.1 && !channel.stands_out, "{channel:?}");
    }
}

/// The twin: a push of a test mass stands out in its own channel, at its time.
#[test]
fn a_glitch_stands_out_at_its_time() {
    let all = told(&["--hours", "2", "--seed", "21", "--effect", "impulse:tm1.x=5e-9,at_s=4000,decay_s=1"]);
    let loud: Vec<&Told> = all.iter().filter(|channel| channel.stands_out).collect();
    assert!(loud.iter().any(|channel| channel.channel == "tm1.accel.x"), "{all:?}");
    for channel in loud {
        assert!((channel.farthest_s - 4000.0).abs() < 10.0, "{channel:?}");
    }
}

/// The layout names nothing that the file does not have, and all residuals in σ.
#[test]
fn a_layout_of_foxglove_has_a_plot_for_every_residual() {
    let folder = tempfile::tempdir().expect("a folder");
    let files = simulate(folder.path(), &["--hours", "0.5", "--seed", "3"]);
    let mut run = dragfree(folder.path());
    run.arg("run").arg(fixture("pipelines/science-mode.toml")).args(&files).args(["--archive", "archive", "--json"]);
    assert!(matches!(run.output().expect("runs").status.code(), Some(0 | 4)));
    let mut export = dragfree(folder.path());
    let layout =
        json(export.args(["products", "export", "2035-01-01", "--format", "foxglove", "--archive", "archive"]), 0);
    let panels = layout["configById"].as_object().expect("panels");
    let plots = panels.values().filter_map(|panel| panel["paths"].as_array()).flatten();
    let paths: Vec<&str> = plots.map(|path| path["value"].as_str().expect("a path")).collect();
    for channel in ["tm1.accel", "tm2.accel", "sc.alpha"] {
        for axis in ["x", "y", "z"] {
            assert!(paths.contains(&format!("/residuals.{channel}.{axis}.whitened").as_str()), "{paths:?}");
        }
    }
    let tabs = panels["Tab!product"]["tabs"].as_array().expect("tabs");
    let titles: Vec<&str> = tabs.iter().map(|tab| tab["title"].as_str().expect("a title")).collect();
    assert_eq!(titles, ["Residuals", "Values", "Filter"]);
}

/// Times and values of a field, by the number of the field on each level.
fn series(file: &Path, topic: &str, path: &[u64]) -> Vec<(u64, f64)> {
    let recording = Recording::read(file);
    let rows = recording.messages().iter().filter(|message| &*message.topic == topic);
    let all: Vec<_> = rows.map(|m| (m.log_time, m.double(path).unwrap_or(0.0))).collect();
    assert!(!all.is_empty(), "{topic} in {}", file.display());
    all
}

fn rms(all: impl Iterator<Item = f64>) -> f64 {
    let all: Vec<f64> = all.collect();
    (all.iter().map(|x| x * x).sum::<f64>() / all.len() as f64).sqrt()
}

/// Two hours beside their truth. Means over 3.75 s of α̂ are those of the true angular acceleration, to the third that
/// noise leaves; one interval away they are not, so that a row stands at its time. The lowest and the highest value are
/// on either side of the mean.
///
/// The mean innovations of a minute are white with a σ of one where the mission's noise is right: of 109 rows after the
/// warm-up the mean square has a σ of √(2/109) = 0.135, and six of them within 4.5 of these are a false alarm in 2e4.
#[test]
fn angular_acceleration_and_innovations_are_kept_over_time() {
    let folder = tempfile::tempdir().expect("a folder");
    let file = simulate(folder.path(), &["--hours", "2", "--seed", "23"]).remove(0);
    let mut run = dragfree(folder.path());
    run.arg("run").arg(fixture("pipelines/science-mode.toml")).arg(&file).args(["--archive", "archive", "--json"]);
    let product = json(&mut run, 0);
    let id = product["id"].as_str().expect("an id");
    let kept = folder.path().join(format!("archive/{id}.mcap"));
    let truth = folder.path().join("truth").join(file.file_name().expect("a name"));
    for axis in AXES {
        let field = |what: u64| series(&kept, "/reconstruction", &[1, 1, axis, what]);
        let (means, low, high) = (field(1), field(2), field(3));
        assert!(means.iter().zip(&low).zip(&high).all(|((m, l), h)| l.1 <= m.1 && m.1 <= h.1));
        let interval_ns = means[1].0 - means[0].0;
        let mut true_means = std::collections::BTreeMap::<u64, (f64, f64)>::new();
        for (time_ns, alpha) in series(&truth, "/truth", &[5, axis]) {
            let (sum, count) = true_means.entry(time_ns / interval_ns).or_default();
            (*sum, *count) = (*sum + alpha, *count + 1.0);
        }
        let off_by = |intervals: u64| {
            let difference = |(time_ns, mean): &(u64, f64)| {
                let (sum, count) = true_means.get(&(time_ns / interval_ns + intervals))?;
                Some(mean - sum / count)
            };
            rms(means.iter().filter_map(difference))
        };
        let size = rms(means.iter().map(|(_, mean)| *mean));
        assert!(off_by(0) < 0.4 * size && off_by(1) > 0.8 * size, "{} {} {size}", off_by(0), off_by(1));
    }
    for (test_mass, axis) in [2, 3].into_iter().flat_map(|t| AXES.map(move |axis| (t, axis))) {
        let innovations = series(&kept, "/es-akf", &[test_mass, 3, axis]);
        let settled = innovations.iter().filter(|(time_ns, _)| time_ns - innovations[0].0 > 600_000_000_000);
        let settled = settled.map(|(_, x)| *x);
        assert_eq!(settled.clone().count(), 109);
        let square = rms(settled).powi(2);
        assert!((square - 1.0).abs() < 4.5 * 0.135, "{test_mass} {axis}: {square}");
    }
}
