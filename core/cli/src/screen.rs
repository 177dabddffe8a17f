//! What people read: products, archives, plugins. Nothing is wider than 80 columns unless a path is.

use crate::text::{self, Paint};
use crate::utc;
use dragfree_archive::files::Problem;
use dragfree_archive::product::{Coefficient, Product};
use dragfree_archive::{Entry, JOINT, Listing};
use dragfree_engine::border::{Manifest, Parameter, ParameterType};
use dragfree_engine::registry::Registry;
use dragfree_workflow::calibrate::{CheckReport, CheckedNode};
use serde_json::Value;
use std::fmt::Write as _;
use std::path::Path;

/// Notes beyond these are left to `--json`.
const NOTES_SHOWN: usize = 6;

/// A product: result, quality, where things lie.
pub(crate) fn product(product: &Product, path: &Path, paint: Paint) -> String {
    let header = &product.header;
    let attributes = &header.non_standard_attributes;
    let quality = &product.quality;
    let mut screen = String::new();
    let title = format!("{}  {} {}", product.id(), header.global_attributes.project, header.global_attributes.platform);
    let _ = writeln!(screen, "{}", paint.bold(&title));
    let (start, stop) = (attributes.start_time_epoch_ns, attributes.stop_time_epoch_ns);
    let window = format!("{} to {} {}", utc::format(start), utc::format(stop), attributes.time_scale);
    let commands = quality.commands.as_deref().map_or(String::new(), |commands| format!(", commands {commands}"));
    let (used, rejected) = (text::grouped(quality.epochs_used), text::grouped(quality.epochs_rejected));
    let model = format!("revision {}: {}", product.model.revision, product.model.effects.join(", "));
    screen += &text::labelled("window", &window);
    let days = product.inputs.iter().filter(|input| input.role == "product").count();
    if days > 0 {
        screen += &text::labelled("days", &days.to_string());
    } else {
        screen += &text::labelled("epochs", &format!("{used} used, {rejected} rejected{commands}"));
    }
    screen += &text::labelled("model", &model);
    screen.push('\n');
    screen += &coefficients(&product.result.coefficients);
    screen.push('\n');
    screen += &verdict(product, paint);
    screen += &losses(product, paint);
    for note in quality.notes.iter().take(NOTES_SHOWN) {
        screen += &text::labelled("note", note);
    }
    if quality.notes.len() > NOTES_SHOWN {
        screen += &text::labelled("", &format!("{} more notes with --json", quality.notes.len() - NOTES_SHOWN));
    }
    screen.push('\n');
    let _ = writeln!(screen, "product   {}", path.display());
    for attachment in &product.attachments {
        let _ = writeln!(screen, "beside    .{}, {} bytes", attachment.suffix, text::grouped(attachment.size));
    }
    screen
}

/// One row per coefficient, one column per solution; where that is too wide, one row per coefficient and solution.
fn coefficients(coefficients: &[Coefficient]) -> String {
    if coefficients.is_empty() {
        return "no stage estimated a coefficient\n".to_owned();
    }
    let solutions = text::distinct(coefficients.iter().map(|c| c.solution.as_str()));
    let names = text::distinct(coefficients.iter().map(|c| c.name.as_str()));
    let cell = |c: &Coefficient| {
        let (_, factor) = text::readable_unit(&c.unit);
        text::measured(c.value * factor, c.sigma * factor)
    };
    let place = |c: &Coefficient| format!("{} {}", text::readable_unit(&c.unit).0, c.frame).trim().to_owned();
    let row = |name: &&str| {
        let of = |solution: &str| coefficients.iter().find(|c| c.name == *name && c.solution == solution);
        let cells = solutions.iter().map(|solution| of(solution).map_or_else(|| "-".to_owned(), cell));
        let place = coefficients.iter().find(|c| c.name == *name).map_or_else(String::new, place);
        [(*name).to_owned()].into_iter().chain(cells).chain([place]).collect()
    };
    let wide = text::columns(&text::table(&[&["coefficient"], &solutions[..]].concat(), names.iter().map(row)));
    if text::fits(&wide) {
        return wide;
    }
    let mut narrow = String::new();
    for name in &names {
        let _ = writeln!(narrow, "{name}");
        let rows = coefficients.iter().filter(|c| c.name == *name);
        let rows = rows.map(|c| vec![format!("  {}", c.solution), cell(c), place(c)]);
        narrow += &text::columns(&rows.collect::<Vec<_>>());
    }
    narrow
}

fn verdict(product: &Product, paint: Paint) -> String {
    let quality = &product.quality;
    let mut screen = match product.result.verdict.as_deref() {
        None => text::labelled("verdict", "none: no stage compared two solutions"),
        Some(word) => {
            let many = product.header.non_standard_attributes.product == JOINT;
            let (meaning, painted) = match word {
                "agree" if many => ("what fits all days fits each", paint.good(word)),
                "disagree" if many => ("the days are not all the same", paint.bad(word)),
                "agree" if !product.result.is_compared() => {
                    ("no test of the data fails; there is no recursive solution to compare with", paint.good(word))
                }
                "agree" => ("the recursive and the batch solution agree within their errors", paint.good(word)),
                "weak" => ("the data leave directions open; do not use those alone", paint.doubtful(word)),
                _ => (
                    "solutions differ by more than their errors, or a test of the data fails; do not use",
                    paint.bad(word),
                ),
            };
            text::labelled("verdict", &format!("{word}: {meaning}")).replacen(word, &painted, 1)
        }
    };
    for direction in &quality.weak_directions {
        screen += &text::labelled("weak", direction);
    }
    let figures = format!("χ²/dof {}, NIS {}", text::plain(quality.chi2_per_dof), text::plain(quality.nis));
    screen += &text::labelled("fit", &figures);
    if quality.inconsistent {
        let sentence = "inconsistent: the residuals are larger than the noise of the mission file explains";
        screen += &text::labelled("fit", sentence).replacen("inconsistent", &paint.bad("inconsistent"), 1);
    }
    screen
}

fn losses(product: &Product, paint: Paint) -> String {
    let mut screen = String::new();
    if product.quality.data_loss {
        screen += &text::labelled("loss", "data were lost").replacen("data were lost", &paint.bad("data were lost"), 1);
    }
    for loss in &product.losses {
        screen += &text::labelled("loss", &format!("{} × {}: {}", loss.count, loss.kind, loss.detail));
    }
    screen
}

/// An archive, one line per product.
pub(crate) fn listing(listing: &Listing, folder: &Path, paint: Paint) -> String {
    let mut screen = String::new();
    if listing.entries.is_empty() {
        let _ = writeln!(screen, "no product in {}", folder.display());
    } else {
        let heading = ["product", "epochs", "verdict", "χ²/dof", "model", ""];
        let row = |Entry { row, .. }: &Entry| {
            let state = match (&row.withdrawn, &row.fixed_from, row.latest) {
                (Some(_), ..) => "withdrawn",
                (_, Some(_), _) => "held out",
                (.., true) => "latest",
                _ => "",
            };
            vec![
                row.id.clone(),
                text::grouped(row.epochs_used.unwrap_or(0)),
                row.verdict.clone().unwrap_or_else(|| "-".to_owned()),
                text::plain(row.chi2_per_dof.unwrap_or(f64::NAN)),
                row.model.clone().unwrap_or_default(),
                state.to_owned(),
            ]
        };
        screen += &text::columns(&text::table(&heading, listing.entries.iter().map(row)));
    }
    for problem in &listing.problems {
        let _ = writeln!(screen, "{} {}", paint.doubtful("not used:"), problem.reason);
        let _ = writeln!(screen, "          {}", problem.path.display());
    }
    screen
}

/// Every plugin and every file that was refused.
pub(crate) fn plugins(registry: &Registry, clash: Option<&str>, paint: Paint) -> String {
    let mut rows: Vec<_> = registry
        .plugins()
        .map(|found| {
            let file = found.opened.path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            let file = if found.opened.is_isolated() { format!("{file} (a process of its own)") } else { file };
            vec![found.info.manifest.id.clone(), found.info.kind.to_string(), found.info.manifest.version.clone(), file]
        })
        .collect();
    rows.sort_by_key(|row| (row[1].clone(), row[0].clone()));
    let mut screen = if rows.is_empty() {
        "no plugin was found; --plugin-dir names a folder, `cargo build --release` makes the bundled ones\n".to_owned()
    } else {
        text::columns(&text::table(&["plugin", "kind", "version", "file"], rows))
    };
    for refused in registry.refused() {
        let _ = writeln!(screen, "{} {}", paint.doubtful("refused:"), refused.path.display());
        screen += &text::labelled("", &refused.reason);
    }
    if let Some(sentence) = clash {
        screen += &text::labelled("error", sentence).replacen("error", &paint.bad("error"), 1);
    }
    screen
}

/// A pipeline as it would run.
pub(crate) fn check(report: &CheckReport) -> String {
    let mut screen = text::labelled("pipeline", &report.pipeline);
    screen += &text::labelled("mission", &report.mission);
    screen += &text::labelled("model", &format!("revision {}: {}", report.model, report.coefficients.join(" ")));
    if let Some(free) = report.free_bytes {
        screen += &text::labelled("free", &format!("{:.1} GB where the archive is", free as f64 * 1e-9));
    }
    screen.push('\n');
    let row = |node: &CheckedNode| {
        let count = |columns: &[String]| format!("{} columns", columns.len());
        vec![node.name.clone(), node.version.clone(), count(&node.reads), count(&node.writes)]
    };
    screen += &text::columns(&text::table(&["plugin", "version", "reads", "writes"], report.nodes.iter().map(row)));
    screen += "\nevery column fits; the names of all columns with --json\n";
    screen
}

/// A plugin's declaration.
pub(crate) fn manifest(kind: &str, manifest: &Manifest, library: &Path, paint: Paint) -> String {
    let mut screen = String::new();
    let _ = writeln!(screen, "{}", paint.bold(&format!("{}  {kind} {}", manifest.id, manifest.version)));
    screen += &text::labelled("", &manifest.description);
    screen += &text::labelled("licence", &manifest.licence);
    let _ = writeln!(screen, "file      {}", library.display());
    if !manifest.instances.is_empty() {
        screen += &text::labelled("instances", &manifest.instances.join(" "));
    }
    if manifest.parameters.is_empty() {
        screen += "\nno parameters\n";
    }
    for parameter in &manifest.parameters {
        screen.push('\n');
        let unit = match parameter.unit.as_str() {
            "" | "1" => String::new(),
            unit => format!(" in {unit}"),
        };
        let _ = writeln!(screen, "{}  {}{unit}", paint.bold(&parameter.name), parameter.kind);
        screen += &text::labelled("", &parameter.help);
        screen += &text::labelled("default", &parameter.default.to_string());
        if let Some(range) = range(parameter) {
            screen += &text::labelled("range", &range);
        }
    }
    screen
}

fn range(parameter: &Parameter) -> Option<String> {
    // The largest whole number is no bound that anybody chose.
    let maximum =
        parameter.maximum.filter(|maximum| parameter.kind != ParameterType::I64 || *maximum < i64::MAX as f64);
    match (parameter.minimum, maximum) {
        _ if !parameter.choices.is_empty() => Some(parameter.choices.join(" | ")),
        (Some(minimum), Some(maximum)) => Some(format!("{minimum} to {maximum}")),
        (Some(minimum), None) => Some(format!("{minimum} and more")),
        (None, Some(maximum)) => Some(format!("{maximum} and less")),
        (None, None) => None,
    }
}

/// Files that are not used, as JSON.
pub(crate) fn problems_json(problems: &[Problem]) -> Vec<Value> {
    let problem = |p: &Problem| serde_json::json!({"path": p.path.to_string_lossy(), "reason": p.reason});
    problems.iter().map(problem).collect()
}

/// An archive as JSON.
pub(crate) fn listing_json(listing: &Listing) -> Value {
    let entries = listing.entries.iter().map(|Entry { row, path }| {
        let mut value = serde_json::json!(row);
        value["path"] = serde_json::json!(path.to_string_lossy());
        value["model"] = serde_json::json!({"revision": row.model, "fixed_from": row.fixed_from});
        value["sha256"] = serde_json::json!(row.digest);
        value
    });
    serde_json::json!({"products": entries.collect::<Vec<_>>(), "problems": problems_json(&listing.problems)})
}

/// Every plugin and every file that was refused, as JSON.
pub(crate) fn plugins_json(registry: &Registry, clash: Option<&str>) -> Value {
    let plugins = registry.plugins().map(|found| {
        serde_json::json!({
            "id": found.info.manifest.id,
            "kind": found.info.kind,
            "version": found.info.manifest.version,
            "description": found.info.manifest.description,
            "path": found.opened.path.to_string_lossy(),
            "sha256": found.opened.sha256,
            "vouched_by": found.opened.vouched_by,
            "isolated": found.opened.is_isolated(),
        })
    });
    serde_json::json!({"plugins": plugins.collect::<Vec<_>>(), "refused": problems_json(registry.refused()), "error": clash})
}

#[cfg(test)]
mod tests {
    use super::*;
    use dragfree_archive::product::{Model, Status, Stream};
    use dragfree_archive::{Archive, Find, MadeOf, ProductWriter, Written};
    use dragfree_engine::draft::Draft;
    use dragfree_engine::schema::Report;

    const PLAIN: Paint = Paint(false);

    fn estimate(name: &str, solution: &str, value: f64, sigma: f64) -> Value {
        serde_json::json!({"name": name, "solution": solution, "value": value, "sigma": sigma, "unit": "m", "frame": "ORF_1"})
    }

    fn written(folder: &Path, report: Value) -> Written {
        let report: Report = serde_json::from_value(report).expect("a report");
        let draft = Draft {
            pipeline: "science-mode".into(),
            product: "COM1B".into(),
            release: 1,
            mission: "Taiji".into(),
            spacecraft: "SC1".into(),
            first_ns: 2_051_222_400_000_000_000,
            last_ns: 2_051_243_999_900_000_000,
            inputs: Vec::new(),
            history: Vec::new(),
            model: Model {
                revision: "1".into(),
                parent: None,
                fixed_from: None,
                effects: vec!["com-offset".into()],
                noise_levels: Vec::new(),
            },
            software: "0.1.0".into(),
            replay: dragfree_engine::feed::Summary { time_scale: "UTC".into(), ..Default::default() },
            reports: vec![Report { plugin: "qp-check".into(), ..report }],
            settings: Default::default(),
            stream: Stream::Test,
            status: Status::Quicklook,
            created: chrono::DateTime::UNIX_EPOCH,
        };
        draft.commit(ProductWriter::begin(folder).expect("begin"), MadeOf::default()).expect("commit")
    }

    fn fits(screen: &str) {
        for line in screen.lines().filter(|line| !line.starts_with("product   ")) {
            assert!(text::width(line) <= text::WIDTH, "{} columns: {line}", text::width(line));
            assert_eq!(line, line.trim_end());
        }
    }

    #[test]
    fn a_product_is_shown_in_millimetres_and_fits_the_screen() {
        let folder = tempfile::tempdir().expect("folder");
        let mut estimates = Vec::new();
        for name in ["com-offset.tm1.x", "com-offset.tm1.y"] {
            for (solution, sigma) in [("es-akf", 1.1e-4), ("qp", 1.2e-5), ("adopted", 1.2e-7)] {
                estimates.push(estimate(name, solution, 0.090_912_3, sigma));
            }
        }
        let Written { product: shown, path } = written(
            folder.path(),
            serde_json::json!({
                "coefficients": estimates, "verdict": "weak", "nis": 1.0, "chi2_per_dof": 0.998, "commands": "telemetered",
                "epochs_used": 215_874, "epochs_rejected": 126, "data_loss": true, "inconsistent": true,
                "weak_directions": ["com-offset.tm1.x ".repeat(8)], "notes": vec!["long words that go on ".repeat(9); 9],
            }),
        );
        let screen = product(&shown, &path, PLAIN);
        fits(&screen);
        for part in [
            "epochs    215 874 used, 126 rejected, commands telemetered",
            "com-offset.tm1.y  90.91 ± 0.11  90.912 ± 0.012  90.91230 ± 0.00012  mm ORF_1",
            "verdict   weak: ",
            "fit       χ²/dof 0.9980, NIS 1.0000",
            "inconsistent",
            "data were lost",
            "3 more notes",
        ] {
            assert!(screen.contains(part), "{part:?} is missing in\n{screen}");
        }
    }

    #[test]
    fn long_names_take_a_row_per_solution() {
        let folder = tempfile::tempdir().expect("folder");
        let name = "electrostatic-crosstalk.tm2.y-from-x.second-order";
        let estimates: Vec<_> = ["es-akf", "qp", "adopted"].map(|s| estimate(name, s, -0.0271, 4e-4)).into();
        let Written { product: shown, path } = written(folder.path(), serde_json::json!({"coefficients": estimates}));
        let screen = product(&shown, &path, PLAIN);
        fits(&screen);
        assert!(screen.contains(&format!("{name}\n  es-akf   -27.10 ± 0.40  mm ORF_1\n  qp ")), "{screen}");
    }

    #[test]
    fn a_product_without_results_says_so() {
        let folder = tempfile::tempdir().expect("folder");
        let Written { product: shown, path } = written(folder.path(), serde_json::json!({}));
        let screen = product(&shown, &path, PLAIN);
        fits(&screen);
        assert!(screen.contains("no stage estimated a coefficient") && screen.contains("verdict   none"), "{screen}");
        assert!(screen.contains("χ²/dof -, NIS -"), "{screen}");
    }

    #[test]
    fn colours_change_nothing_but_colours() {
        let folder = tempfile::tempdir().expect("folder");
        let Written { product: shown, path } = written(folder.path(), serde_json::json!({"verdict": "agree"}));
        let painted = product(&shown, &path, Paint(true));
        assert_ne!(painted, product(&shown, &path, PLAIN));
        let mut bare = painted.clone();
        for code in ["\x1b[1m", "\x1b[31m", "\x1b[32m", "\x1b[33m", "\x1b[0m"] {
            bare = bare.replace(code, "");
        }
        assert_eq!(bare, product(&shown, &path, PLAIN));
    }

    #[test]
    fn an_archive_is_listed_with_what_is_wrong_in_it() {
        let folder = tempfile::tempdir().expect("folder");
        written(folder.path(), serde_json::json!({"verdict": "agree", "epochs_used": 215_874, "chi2_per_dof": 1.0}));
        written(folder.path(), serde_json::json!({}));
        std::fs::write(folder.path().join("notes.txt"), "mine").expect("write");
        let found = Archive::open(folder.path()).expect("archive").list(&Find::default()).expect("list");
        let screen = listing(&found, folder.path(), PLAIN);
        let lines: Vec<_> = screen.lines().collect();
        assert_eq!(lines[1], "COM1B_2035-01-01_SC1_01_0001  215 874  agree    1.0000  1");
        assert_eq!(lines[2], "COM1B_2035-01-01_SC1_01_0002  0        -        -       1      latest");
        assert!(lines[3].starts_with("not used: ") && lines[4].ends_with("notes.txt"), "{screen}");
        let json = listing_json(&found);
        assert_eq!(json["products"][0]["latest"], false);
        assert_eq!(json["products"][1]["chi2_per_dof"], Value::Null);
        assert_eq!(json["problems"].as_array().map(Vec::len), Some(1));
    }

    #[test]
    fn a_plugin_shows_every_parameter() {
        let declared: Manifest = serde_json::from_value(serde_json::json!({
            "id": "es-akf", "version": "0.1.0", "licence": "MIT", "description": "Expanded-state filter.",
            "instances": ["tm1", "tm2"],
            "parameters": [
                {"name": "rate", "type": "f64", "unit": "Hz", "default": 10.0, "minimum": 0.1, "maximum": 100.0, "help": "Rate."},
                {"name": "mode", "type": "text", "default": "a", "choices": ["a", "b"], "help": "Way."},
                {"name": "depth", "type": "i64", "default": 3, "minimum": 1, "maximum": i64::MAX},
            ],
        }))
        .expect("a manifest");
        let screen = manifest("stage", &declared, Path::new("libes.so"), PLAIN);
        fits(&screen);
        for part in [
            "es-akf  stage 0.1.0",
            "rate  f64 in Hz",
            "range     0.1 to 100",
            "range     a | b",
            "range     1 and more",
            "instances tm1 tm2",
        ] {
            assert!(screen.contains(part), "{part:?} is missing in\n{screen}");
        }
    }
}
