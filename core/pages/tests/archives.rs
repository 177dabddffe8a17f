//! Pages of archives that no flight has made: of thousands of days, and with hostile names.

use std::path::Path;
use std::time::{Duration, Instant};

use chrono::{DateTime, Utc};
use dragfree_archive::product::Product;
use dragfree_archive::{Archive, MadeOf, ProductWriter, Stamp};
use dragfree_engine::config::Mission;
use dragfree_engine::registry::Registry;
use dragfree_pages::{Links, Query, Setup, Site};
use serde_json::json;

const DAY_NS: i64 = 86_400_000_000_000;
/// 2027-01-01, Unix ns.
const START_NS: i64 = 1_798_761_600_000_000_000;

fn stamp() -> Stamp<'static> {
    Stamp { time: DateTime::<Utc>::UNIX_EPOCH, software: "dragfree 0.1.0" }
}

/// A product of a day after 2027-01-01, with this text wherever a product has free text.
fn product(day: i64, text: &str) -> Product {
    let start = START_NS + day * DAY_NS;
    let date = DateTime::from_timestamp_nanos(start).format("%Y-%m-%d").to_string();
    let document = json!({
        "format_version": "1.2.0",
        "header": {
            "dimensions": {"epoch": 10, "coefficient": 1, "stage": 0, "input": 1},
            "global_attributes": {
                "id": format!("COM1B_{date}_SC1_01"), "title": "a calibration", "summary": "of a test",
                "conventions": "CF-1.6", "project": "Taiji", "platform": "SC1", "processing_level": "1B",
                "product_version": "01", "source": "science-mode", "date_created": "2035-01-02T00:00:00Z",
                "time_coverage_start": "2035-01-01T00:00:00.000000000",
                "time_coverage_stop": "2035-01-01T00:00:00.900000000"
            },
            "non_standard_attributes": {
                "product": "COM1B", "release": 1, "revision": 0, "day": date, "stream": "OPER", "status": "final",
                "time_scale": "UTC", "start_time_epoch_ns": start, "stop_time_epoch_ns": start + DAY_NS,
                "frames": ["ORF_1"], "software_version": "0.1.0", "sha256": ""
            },
            "variables": []
        },
        "model": {"revision": text, "effects": [text]},
        "result": {
            "epoch_ns": start, "verdict": if day % 50 == 7 { "disagree" } else { "agree" },
            "coefficients": [{"name": "offset.b.x", "solution": "qp", "value": 0.1, "sigma": 1e-4, "unit": "m",
                "frame": text}],
            "covariance": {}
        },
        "quality": {
            "epochs_used": 10, "epochs_rejected": 0, "chi2_per_dof": 1.0, "nis": 1.0, "data_loss": false,
            "inconsistent": false, "weak_directions": [text], "notes": [text], "counts": {}, "stages": {}
        },
        "inputs": [{"role": "telemetry", "name": text, "size": 3, "sha256": "0".repeat(64)}],
        "history": [], "losses": [{"kind": text, "count": 1, "detail": text}], "attachments": []
    });
    serde_json::from_value(document).expect("a product")
}

fn write(folder: &Path, product: &Product) -> String {
    let writer = ProductWriter::begin(folder).expect("begin");
    let written = writer.commit(product, MadeOf::default(), &stamp()).expect("commit");
    written.product.id().to_owned()
}

fn site(archive: &Path) -> Site {
    let text = include_str!("../../../fixtures/missions/taiji.toml");
    Site::new(Setup {
        archive: archive.to_owned(),
        registry: Registry::discover(&[]),
        mission: Mission::parse(Path::new("taiji.toml"), text).expect("a mission"),
        model: None,
        truth: None,
        starter: None,
        events: None,
        steps: Vec::new(),
        flags: String::new(),
        model_flags: String::new(),
        software: "dragfree 0.1.0",
        today: Box::new(|| "2035-01-01".parse().expect("a day")),
    })
}

fn page(site: &Site, path: &str) -> String {
    let links = Links::Server { changes: false };
    site.page(path, &Query::default(), &links).unwrap_or_else(|e| panic!("{path}: {e}"))
}

/// What a product or an event of the archive says is text on every page, whatever it holds.
#[test]
fn names_with_html_are_shown_as_text() {
    let folder = tempfile::tempdir().expect("a folder");
    let hostile = "</script><img src=x onerror=alert(1)>\"'&";
    let ids: Vec<String> = (0..3).map(|day| write(folder.path(), &product(day, hostile))).collect();
    let mut archive = Archive::open(folder.path()).expect("an archive");
    archive.withdraw(&ids[1], hostile, &stamp()).expect("withdrawn");
    let site = site(folder.path());
    let mut shown = 0;
    for path in ["/".to_owned(), "/trends".to_owned(), format!("/day/{}", ids[0]), format!("/day/{}", ids[1])] {
        let text = page(&site, &path);
        assert!(!text.contains("<img") && text.contains("&lt;img") | (path == "/trends"), "{path}");
        shown += text.matches("&lt;img src=x onerror=alert(1)&gt;").count();
    }
    assert!(shown > 8, "the texts are there: {shown}");
}

/// The first page is made within 300 ms, with a cell for every day. `DRAGFREE_DAYS=3000` asks it of more days, which
/// take minutes to archive.
#[test]
#[allow(clippy::print_stdout, reason = "VALIDATION.md has this line")]
fn many_days_are_shown_at_once() {
    let days = std::env::var("DRAGFREE_DAYS").ok().and_then(|days| days.parse().ok()).unwrap_or(100);
    let folder = tempfile::tempdir().expect("a folder");
    (0..days).for_each(|day| drop(write(folder.path(), &product(day, "1"))));
    let site = site(folder.path());
    let mut times = Vec::new();
    let mut text = String::new();
    for _ in 0..5 {
        let begun = Instant::now();
        text = page(&site, "/");
        times.push(begun.elapsed());
    }
    times.sort();
    println!("first page of {days} days: {:.1?}, {} kB", times[2], text.len() / 1000);
    let bad = (0..days).filter(|day| day % 50 == 7).count();
    let cells = ["bad", "good"].map(|state| text.matches(&format!("class=\"day {state}\" href")).count());
    assert_eq!((cells[0], cells[0] + cells[1]), (bad, usize::try_from(days).expect("a number")));
    assert!(times[2] < Duration::from_millis(300), "{times:?}");
}

/// A day that is diagnosed anew has another extract, and the pages show that one.
#[test]
fn what_a_new_diagnosis_keeps_is_shown() {
    let folder = tempfile::tempdir().expect("a folder");
    let id = write(folder.path(), &product(1, "1"));
    let mut archive = Archive::open(folder.path()).expect("an archive");
    let site = site(folder.path());
    let query = Query { products: id.clone(), ..Query::default() };
    let made = site.refit(&query).map(drop).expect_err("no extract").to_string();
    assert!(made.contains("--keep-extract"), "{made}");
    for (score, value_m) in [(4.0, 1.0), (8.0, 2.0)] {
        let extract = json!({
            "format": "dragfree-extract/1", "product": id, "program": env!("CARGO_PKG_VERSION"),
            "coefficients": [{"name": "offset.b.x", "unit": "m"}], "information": [4.0], "score": [score],
            "chi2": 10.0, "numbers": 10.0, "surveys": [], "channels": {}, "named": [], "levels": [],
            "trials": {"forms": {}}, "unexplained": null, "not_tried": []
        });
        let text = serde_json::to_vec(&extract).expect("JSON");
        drop(archive.keep_extract(&id, &text, &stamp()).expect("kept"));
        // Once more, from what was read before.
        for _ in 0..2 {
            let refit = site.refit(&query).expect("a refit");
            let offset = &refit.rungs[0].offsets[0];
            assert!((offset.value_m - value_m).abs() < 1e-12 && (offset.sigma_m - 0.5).abs() < 1e-12, "{offset:?}");
        }
    }
}

/// The sentence of a day says what its product and its diagnosis say, and nothing else.
#[test]
fn a_day_is_of_use_where_nothing_speaks_against_it() {
    let folder = tempfile::tempdir().expect("a folder");
    let of = |day: i64, change: fn(&mut serde_json::Value)| {
        let mut document = serde_json::to_value(product(day, "1")).expect("JSON");
        change(&mut document);
        write(folder.path(), &serde_json::from_value(document).expect("a product"))
    };
    let recursive = |document: &mut serde_json::Value| {
        let mut other = document["result"]["coefficients"][0].clone();
        other["solution"] = json!("es-akf");
        document["result"]["coefficients"].as_array_mut().expect("coefficients").push(other);
    };
    let compared = of(1, recursive);
    let alone = of(2, |_| ());
    let empty = of(3, |document| document["result"]["coefficients"] = json!([]));
    let unspoken = of(4, |document| document["result"]["verdict"] = json!(null));
    let joint = of(5, |document| document["header"]["non_standard_attributes"]["product"] = json!("COM2"));
    let lost = of(6, |document| document["quality"]["data_loss"] = json!(true));
    let weak_and_lost = of(7, |document| {
        document["quality"]["data_loss"] = json!(true);
        document["result"]["verdict"] = json!("weak");
    });
    let site = site(folder.path());
    for (id, class, said) in [
        (&compared, "good", "The recursive and the batch solution agree"),
        (&alone, "good", "there is no recursive solution to compare with"),
        (&empty, "bad", "It has no values"),
        (&unspoken, "weak", "No two solutions were compared"),
        (&joint, "good", "What fits all days fits each"),
        (&lost, "lost", "data were lost"),
        (&weak_and_lost, "lost", "The data do not determine everything. But data were lost"),
    ] {
        let text = page(&site, &format!("/day/{id}"));
        let sentence = text.split("<p class=\"verdict ").nth(1).and_then(|rest| rest.split("</p>").next());
        let sentence = sentence.expect("a verdict");
        assert!(sentence.starts_with(class) && sentence.contains(said), "{id}: {sentence}");
        assert!(!sentence.contains("A diagnosis found no effect missing"), "{id}: {sentence}");
    }
    assert!(page(&site, &format!("/day/{compared}")).contains("--into SET --from 2027-01-02 --until 2027-01-03"));

    let mut archive = Archive::open(folder.path()).expect("an archive");
    for (program, unexplained, class, said) in [
        (env!("CARGO_PKG_VERSION"), json!(null), "good", "A diagnosis found no effect missing"),
        (env!("CARGO_PKG_VERSION"), json!("a transient is left"), "bad", "a transient is left"),
        ("0.0.1", json!(null), "good", "release 0.0.1 made it"),
    ] {
        let extract = json!({
            "format": "dragfree-extract/1", "product": compared, "program": program,
            "coefficients": [{"name": "offset.b.x", "unit": "m"}], "information": [4.0], "score": [4.0],
            "chi2": 10.0, "numbers": 10.0, "surveys": [], "channels": {}, "named": [], "levels": [],
            "trials": {"forms": {}}, "unexplained": unexplained, "not_tried": []
        });
        let text = serde_json::to_vec(&extract).expect("JSON");
        drop(archive.keep_extract(&compared, &text, &stamp()).expect("kept"));
        let text = page(&site, &format!("/day/{compared}"));
        let sentence = text.split("<p class=\"verdict ").nth(1).and_then(|rest| rest.split("</p>").next());
        let sentence = sentence.expect("a verdict");
        assert!(sentence.starts_with(class) && sentence.contains(said), "{program}: {sentence}");
    }
}

#[test]
fn an_empty_archive_says_how_to_fill_it() {
    let folder = tempfile::tempdir().expect("a folder");
    drop(Archive::create(folder.path()).expect("an archive"));
    let site = site(folder.path());
    for path in ["/", "/trends", "/compare", "/missing", "/plugins"] {
        assert!(page(&site, path).contains("class=\"lead\""), "{path}");
    }
    assert!(page(&site, "/").contains("dragfree run"));
    let links = Links::Server { changes: false };
    assert!(site.page("/day/COM1B_2035-01-01_SC1_01_0001", &Query::default(), &links).is_err());
}
