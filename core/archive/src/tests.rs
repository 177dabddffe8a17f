use super::*;
use crate::files::sha256;
use crate::product::Product;
use chrono::{DateTime, Utc};
use proptest::prelude::*;
use serde_json::json;
use std::fs;
use std::path::Path;

const FIRST: &str = "COM1B_2035-01-01_SC1_01_0001";
const DAY_NS: i64 = 86_400_000_000_000;
/// 2035-01-01, Unix ns.
const START_NS: i64 = 2_051_222_400_000_000_000;

fn stamp() -> Stamp<'static> {
    Stamp { time: DateTime::<Utc>::UNIX_EPOCH, software: "dragfree 0.1.0" }
}

/// A product of a day after 2035-01-01 without its revision.
fn product(day: i64, spacecraft: &str, value: f64) -> Product {
    let start = START_NS + day * DAY_NS;
    let date = DateTime::from_timestamp_nanos(start).format("%Y-%m-%d").to_string();
    let id = format!("COM1B_{date}_{spacecraft}_01");
    let document = json!({
        "format_version": FORMAT_VERSION,
        "header": {
            "dimensions": {"epoch": 10, "coefficient": 1, "stage": 0, "input": 1},
            "global_attributes": {
                "id": id, "title": "a calibration", "summary": "of a test", "conventions": "CF-1.6", "project": "Taiji",
                "platform": spacecraft, "processing_level": "1B", "product_version": "01", "source": "science-mode",
                "date_created": "2035-01-02T00:00:00Z", "time_coverage_start": "2035-01-01T00:00:00.000000000",
                "time_coverage_stop": "2035-01-01T00:00:00.900000000"
            },
            "non_standard_attributes": {
                "product": "COM1B", "release": 1, "revision": 0, "day": date, "stream": "OPER", "status": "final",
                "time_scale": "UTC", "start_time_epoch_ns": start, "stop_time_epoch_ns": start + DAY_NS,
                "frames": ["ORF_1"], "software_version": "0.1.0", "sha256": ""
            },
            "variables": []
        },
        "model": {"revision": "1", "effects": ["com-offset"]},
        "result": {
            "epoch_ns": start, "verdict": "agree",
            "coefficients": [{"name": "com-offset.tm1.x", "solution": "qp", "value": value, "sigma": 1e-4, "unit": "m",
                "frame": "ORF_1"}],
            "covariance": {}
        },
        "quality": {
            "epochs_used": 10, "epochs_rejected": 0, "chi2_per_dof": 1.0, "nis": 1.0, "data_loss": false,
            "inconsistent": false, "weak_directions": [], "notes": [], "counts": {}, "stages": {}
        },
        "inputs": [{"role": "telemetry", "name": "a.mcap", "size": 3, "sha256": sha256("abc")}],
        "history": [], "losses": [], "attachments": []
    });
    serde_json::from_value(document).expect("a product")
}

fn verdict(product: Product, verdict: &str) -> Product {
    let result = product::Outcome { verdict: Some(verdict.to_owned()), ..product.result.clone() };
    Product { result, ..product }
}

/// Archives a product with a series beside it and a state that it left.
fn write(folder: &Path, product: &Product) -> Written {
    let mut writer = ProductWriter::begin(folder).expect("begin");
    let value = product.result.coefficients[0].value;
    fs::write(writer.staged("mcap"), format!("{value}")).expect("write");
    writer.attach("qp-check", "neq.json", "{}").expect("attach");
    writer.keep("mission", "taiji.toml", b"[mission]").expect("keep");
    writer.keep("state_out", "state", format!("state {value}").as_bytes()).expect("keep");
    writer.commit(product, MadeOf::default(), &stamp()).expect("commit")
}

fn open(folder: &Path) -> Archive {
    Archive::open(folder).expect("an archive")
}

fn list(folder: &Path) -> Listing {
    open(folder).list(&Find::default()).expect("list")
}

fn ids(listing: &Listing) -> Vec<&str> {
    listing.entries.iter().map(|entry| entry.row.id.as_str()).collect()
}

/// Names in a folder, but for the lock and the catalogue.
fn names(folder: &Path) -> Vec<String> {
    objects::entries(folder).expect("a folder")
}

#[test]
fn a_second_run_is_the_next_revision_and_says_what_changed() {
    let folder = tempfile::tempdir().expect("folder");
    let first = write(folder.path(), &product(0, "SC1", 0.0909));
    assert_eq!(first.product.id(), FIRST);
    let text = fs::read(&first.path).expect("read");
    let second = write(folder.path(), &product(0, "SC1", 0.0909)).product;
    assert_eq!(second.id(), "COM1B_2035-01-01_SC1_01_0002");
    assert_eq!(text, fs::read(&first.path).expect("read"), "the first is untouched");
    assert_eq!(second.header.non_standard_attributes.sha256, first.product.header.non_standard_attributes.sha256);
    let supersedes = second.supersedes.expect("an earlier revision");
    assert_eq!((supersedes.id.as_str(), supersedes.reason.as_str()), (FIRST, "run again, same result"));
    let mut late = product(0, "SC1", 0.0909);
    late.inputs[0].size = 8;
    let third = write(folder.path(), &late).product.supersedes.expect("an earlier revision");
    assert_eq!((third.id.as_str(), third.reason.as_str()), ("COM1B_2035-01-01_SC1_01_0002", "changed: inputs"));
}

/// They had the names of the writer's own files, which then took their place under their digest.
#[test]
fn attachments_may_have_any_name() {
    let folder = tempfile::tempdir().expect("folder");
    let mut writer = ProductWriter::begin(folder.path()).expect("begin");
    let names = ["product.toml", "placing.json", "entry.json", "running.json", "mission.kept"];
    for name in names {
        writer.attach("odd", name, name).expect("attach");
    }
    writer.keep("mission", "taiji.toml", b"[mission]").expect("keep");
    let written = writer.commit(&product(0, "SC1", 1.0), MadeOf::default(), &stamp()).expect("commit");
    for name in names {
        assert_eq!(open(folder.path()).read_file(written.product.id(), name).expect(name), name.as_bytes());
    }
    assert!(list(folder.path()).problems.is_empty());
}

#[test]
fn a_day_of_two_spacecraft_is_asked_about() {
    let folder = tempfile::tempdir().expect("folder");
    for (spacecraft, value) in [("SC1", 1.0), ("SC1", 2.0), ("SC2", 1.0)] {
        write(folder.path(), &product(0, spacecraft, value));
    }
    let archive = open(folder.path());
    let error = archive.find("2035-01-01").expect_err("which one?").to_string();
    assert!(error.contains("name one of COM1B_2035-01-01_SC1_01, COM1B_2035-01-01_SC2_01"), "{error}");
    let one = archive.find("COM1B_2035-01-01_SC1_01").expect("the newest of one spacecraft");
    assert_eq!(one.row.id, "COM1B_2035-01-01_SC1_01_0002");
    let days = |from: &str, until: &str| archive.find_days(from.parse().expect("day"), until.parse().expect("day"));
    assert!(matches!(days("2034-12-31", "2035-01-05"), Err(ArchiveError::Several { .. })));
    assert!(matches!(days("2035-01-02", "2035-01-05"), Err(ArchiveError::NotFound { .. })));
    assert!(matches!(archive.find("2035-01-02"), Err(ArchiveError::NotFound { .. })));
}

#[test]
fn the_newest_of_each_day_is_found() {
    let folder = tempfile::tempdir().expect("folder");
    for (day, value) in [(0, 1.0), (1, 1.0), (0, 2.0), (12, 1.0)] {
        write(folder.path(), &product(day, "SC1", value));
    }
    let archive = open(folder.path());
    let days = archive.find_days("2035-01-01".parse().expect("day"), "2035-01-02".parse().expect("day"));
    let found: Vec<String> = days.expect("two days").into_iter().map(|entry| entry.row.id).collect();
    assert_eq!(found, ["COM1B_2035-01-01_SC1_01_0002", "COM1B_2035-01-02_SC1_01_0001"]);
    assert_eq!(archive.find("2035-01-01").expect("a day").row.revision, 2);
}

/// Newest that holds: neither a product in disagreement, nor a withdrawn one, nor a test on data kept out of a fit.
#[test]
fn what_does_not_hold_is_not_the_latest() {
    let folder = tempfile::tempdir().expect("folder");
    let latest = |folder: &Path| {
        let found = open(folder).list(&Find { latest: true, ..Find::default() }).expect("list");
        ids(&found).iter().map(|id| id[id.len() - 4..].parse().expect("a revision")).collect::<Vec<u32>>()
    };
    write(folder.path(), &product(0, "SC1", 1.0));
    write(folder.path(), &product(0, "SC1", 2.0));
    assert_eq!(latest(folder.path()), [2]);
    write(folder.path(), &verdict(product(0, "SC1", 3.0), "disagree"));
    assert_eq!(latest(folder.path()), [2]);
    let mut held_out = product(0, "SC1", 4.0);
    held_out.model.fixed_from = Some(FIRST.to_owned());
    write(folder.path(), &held_out);
    assert_eq!(latest(folder.path()), [2]);
    open(folder.path()).withdraw("COM1B_2035-01-01_SC1_01_0002", "wrong survey", &stamp()).expect("withdrawn");
    assert_eq!(latest(folder.path()), [1]);
    let error = open(folder.path()).withdraw("COM1B_2035-01-01_SC1_01_0002", "again", &stamp()).expect_err("twice");
    assert!(error.to_string().contains("withdrawn already: wrong survey"), "{error}");
    assert_eq!(write(folder.path(), &product(0, "SC1", 5.0)).product.header.non_standard_attributes.revision, 5);
    assert_eq!(latest(folder.path()), [5]);
}

#[test]
fn eight_writers_at_once_get_a_revision_each_with_their_own_files() {
    const WRITERS: u32 = 8;
    let folder = tempfile::tempdir().expect("folder");
    std::thread::scope(|scope| {
        for writer in 0..WRITERS {
            let folder = folder.path();
            scope.spawn(move || write(folder, &product(0, "SC1", f64::from(writer))));
        }
    });
    let listing = list(folder.path());
    assert!(listing.problems.is_empty(), "{:?}", listing.problems);
    assert!(listing.entries.iter().map(|e| e.row.revision).eq(1..=WRITERS), "no revision lost, none twice");
    assert_eq!(listing.entries.iter().filter(|entry| entry.row.latest).count(), 1);
    for entry in &listing.entries {
        let product = open(folder.path()).product(&entry.row.id).expect("sound");
        let beside = fs::read_to_string(entry.path.with_extension("mcap")).expect("series");
        assert_eq!(beside, format!("{}", product.result.coefficients[0].value));
    }
    assert!(names(&folder.path().join("staging")).is_empty());
    assert!(open(folder.path()).strangers().expect("objects").is_empty());
}

#[test]
fn a_failed_commit_leaves_nothing() {
    let folder = tempfile::tempdir().expect("folder");
    let mut bad = product(0, "SC1", 1.0);
    bad.header.non_standard_attributes.time_scale = "Mars".into();
    let mut writer = ProductWriter::begin(folder.path()).expect("begin");
    writer.keep("mission", "taiji.toml", b"[mission]").expect("keep");
    let error = writer.commit(&bad, MadeOf::default(), &stamp()).expect_err("no such time scale").to_string();
    assert!(error.contains("/header/non_standard_attributes/time_scale") && error.contains("Mars"), "{error}");
    assert!(list(folder.path()).entries.is_empty());
    for part in ["staging", "objects"] {
        assert_eq!(names(&folder.path().join(part)), Vec::<String>::new(), "{part}");
    }
}

/// One bit of any file of a product is noticed by `list`, and by whoever reads the product.
#[test]
fn a_flipped_bit_in_any_file_is_noticed() {
    let folder = tempfile::tempdir().expect("folder");
    write(folder.path(), &product(0, "SC1", 1.0));
    assert_eq!(list(folder.path()).entries.len(), 1);
    for suffix in ["toml", "mcap", "neq.json", "state"] {
        let path = folder.path().join(format!("{FIRST}.{suffix}"));
        let sound = fs::read(&path).expect("read");
        let mut damaged = sound.clone();
        damaged[0] ^= 1;
        fs::write(&path, &damaged).expect("write");
        let listing = list(folder.path());
        assert!(listing.entries.is_empty(), "{suffix}");
        let said = &listing.problems[0].reason;
        assert!(said.contains(suffix) && said.contains("its digest is"), "{suffix}: {said}");
        let error = open(folder.path()).product(FIRST).expect_err(suffix).to_string();
        assert!(error.contains("is damaged"), "{error}");
        fs::write(&path, &sound).expect("write");
        assert_eq!(list(folder.path()).entries.len(), 1, "{suffix} is whole again");
    }
}

#[test]
fn the_same_result_again_mends_a_damaged_file() {
    let folder = tempfile::tempdir().expect("folder");
    write(folder.path(), &product(0, "SC1", 1.0));
    fs::write(folder.path().join(format!("{FIRST}.mcap")), "damaged").expect("write");
    assert!(list(folder.path()).entries.is_empty());
    write(folder.path(), &product(0, "SC1", 1.0));
    Archive::reindex(folder.path()).expect("reindex");
    let listing = list(folder.path());
    assert_eq!((listing.entries.len(), listing.problems.len()), (2, 0), "{:?}", listing.problems);
}

#[test]
fn a_file_of_nobody_is_told_and_left_alone() {
    let folder = tempfile::tempdir().expect("folder");
    write(folder.path(), &product(0, "SC1", 1.0));
    fs::write(folder.path().join("notes.txt"), "mine").expect("write");
    let listing = list(folder.path());
    assert_eq!(listing.problems.len(), 1);
    assert!(listing.problems[0].path.ends_with("notes.txt"));
    fs::remove_file(folder.path().join(format!("{FIRST}.neq.json"))).expect("remove");
    assert!(list(folder.path()).problems[0].reason.contains("neq.json"), "a missing file is told too");
}

/// Products of other archives come all or none, and what becomes of those archives afterwards changes nothing here.
#[test]
fn products_are_taken_over_whole_and_copied() {
    let (here, one, two) = (tempfile::tempdir(), tempfile::tempdir(), tempfile::tempdir());
    let [here, one, two] = [here, one, two].map(|folder| folder.expect("folder"));
    write(one.path(), &product(0, "SC1", 1.0));
    let second = write(two.path(), &product(1, "SC1", 2.0)).product.id().to_owned();
    let products = [(one.path().to_owned(), FIRST.to_owned()), (two.path().to_owned(), second.clone())];
    let series = two.path().join(format!("{second}.mcap"));
    let sound = fs::read(&series).expect("read");
    fs::write(&series, "damaged").expect("write"); // in place: the object is the same file
    let mut archive = Archive::create(here.path()).expect("an archive");
    let error = archive.take_over(&products, &stamp()).expect_err("a damaged series").to_string();
    assert!(error.contains("is damaged"), "{error}");
    for part in ["staging", "objects"] {
        assert_eq!(names(&here.path().join(part)), Vec::<String>::new(), "{part}");
    }

    fs::write(&series, &sound).expect("write");
    assert_eq!(archive.take_over(&products, &stamp()).expect("taken over"), [FIRST, &second]);
    assert_eq!(archive.events().expect("events").len(), 1, "in one step");
    for (folder, id) in &products {
        for suffix in ["toml", "mcap", "neq.json", "state"] {
            fs::write(folder.join(format!("{id}.{suffix}")), "written over").expect("write");
        }
        archive.product(id).expect("untouched here");
    }
    assert!(list(here.path()).problems.is_empty());
}

/// What takes long happens before the archive is held, as others wait for it.
#[test]
fn products_are_copied_before_the_archive_is_held() {
    let (here, other) = (tempfile::tempdir().expect("folder"), tempfile::tempdir().expect("folder"));
    let id = write(other.path(), &product(0, "SC1", 1.0)).product.id().to_owned();
    let mut archive = Archive::create(here.path()).expect("an archive");
    let held = archive.hold().expect("held");
    let products = [(other.path().to_owned(), id)];
    let copied = || {
        let staging = names(&here.path().join("staging"));
        staging.iter().filter(|name| !name.ends_with(".lock")).any(|name| {
            let contents = names(&here.path().join("staging").join(name));
            contents.iter().filter(|content| content.len() == 64).count() >= 3
        })
    };
    std::thread::scope(|scope| {
        let taken = scope.spawn(|| archive.take_over(&products, &stamp()).expect("taken over"));
        let since = std::time::Instant::now();
        while !copied() {
            assert!(since.elapsed().as_secs() < 30, "nothing was copied while another held the archive");
            std::thread::sleep(std::time::Duration::from_millis(5));
        }
        drop(held);
        assert_eq!(taken.join().expect("no panic"), [FIRST]);
    });
}

/// Everything that the catalogue says is in journal and objects.
#[test]
fn a_catalogue_made_again_is_the_same() {
    let folder = tempfile::tempdir().expect("folder");
    write_a_bit_of_everything(folder.path());
    let before = open(folder.path()).catalogue.dump();
    assert!(before.len() > 20, "{before:#?}");
    Archive::reindex(folder.path()).expect("reindex");
    assert_eq!(open(folder.path()).catalogue.dump(), before);
    let path = folder.path().join("catalogue.sqlite");
    fs::remove_file(&path).expect("remove");
    assert_eq!(open(folder.path()).catalogue.dump(), before, "one that is gone is made again");
    for garbage in ["", "not a database", &"x".repeat(100_000)] {
        fs::write(&path, garbage).expect("write");
        assert_eq!(open(folder.path()).catalogue.dump(), before, "one that is damaged is made again");
    }
    let mut bytes = fs::read(&path).expect("read");
    bytes[4096..8192].fill(0x5a);
    fs::write(&path, bytes).expect("write");
    let archive = open(folder.path());
    let rows = archive.list(&Find::default());
    assert!(rows.is_err() || archive.catalogue.dump() == before, "a damaged page is never believed");
    Archive::reindex(folder.path()).expect("reindex");
    assert_eq!(open(folder.path()).catalogue.dump(), before);
}

#[test]
fn an_extract_that_was_replaced_is_no_stranger() {
    let folder = tempfile::tempdir().expect("folder");
    write(folder.path(), &product(0, "SC1", 1.0));
    let mut archive = open(folder.path());
    for content in ["{}", "[]"] {
        archive.keep_extract(FIRST, content.as_bytes(), &stamp()).expect("kept");
    }
    assert!(archive.strangers().expect("objects").is_empty());
    Archive::reindex(folder.path()).expect("reindex");
    assert!(open(folder.path()).strangers().expect("objects").is_empty());
    let first = archive.objects.path(&sha256("{}"));
    assert_eq!(fs::read(first).expect("it is kept"), b"{}");
}

fn write_a_bit_of_everything(folder: &Path) {
    for (day, value) in [(0, 1.0), (1, 1.0), (0, 2.0)] {
        write(folder, &product(day, "SC1", value));
    }
    let mut archive = open(folder);
    archive.withdraw(FIRST, "wrong survey", &stamp()).expect("withdrawn");
    archive.keep_extract("COM1B_2035-01-02_SC1_01_0001", b"{}", &stamp()).expect("kept");
    let places = vec![InputPlace { sha256: sha256("abc"), path: folder.join("elsewhere/a.mcap") }];
    archive.keep_places(places, &stamp()).expect("kept");
    let day = |from: i64, until: i64| Window {
        from_ns: Some(START_NS + from * DAY_NS),
        until_ns: Some(START_NS + until * DAY_NS),
    };
    archive.certify("COM1B_2035-01-02_SC1_01_0001", "ops", day(1, 30), &stamp()).expect("certified");
    archive.decertify("ops", "SC1", day(10, 20), &stamp()).expect("decertified");
    archive.set_state("ops", SetState::Published, "", &stamp()).expect("published");
}

/// A program that is killed leaves a staging folder, contents without an event, an event without names. The next
/// command clears or finishes each.
#[test]
fn what_a_killed_writer_leaves_is_cleared_or_finished_by_the_next_command() {
    let folder = tempfile::tempdir().expect("folder");
    write(folder.path(), &product(0, "SC1", 1.0));
    let staging = folder.path().join("staging");

    // Killed while it wrote, and killed after it had placed a content that no event names.
    let orphan = sha256("orphan");
    let object = folder.path().join("objects").join(&orphan[..2]).join(&orphan[2..]);
    fs::create_dir_all(object.parent().expect("a folder")).expect("folder");
    fs::write(&object, "orphan").expect("write");
    let known = open(folder.path()).catalogue.made_of(FIRST).expect("contents")[0].sha256.clone();
    for (name, placing) in [("w1", vec![]), ("w2", vec![orphan.clone(), known.clone()])] {
        fs::write(staging.join(format!("{name}.lock")), "").expect("write");
        fs::create_dir(staging.join(name)).expect("folder");
        fs::write(staging.join(name).join("product.toml"), "half").expect("write");
        fs::write(staging.join(name).join(".placing.json"), json!(placing).to_string()).expect("write");
    }
    assert_eq!(list(folder.path()).entries.len(), 1);
    assert!(names(&staging).is_empty(), "{:?}", names(&staging));
    assert!(!object.exists(), "nobody names it");
    assert!(open(folder.path()).objects.path(&known).exists(), "an event names it");

    // Killed between the commit and the names.
    write(folder.path(), &product(1, "SC1", 1.0));
    let second = "COM1B_2035-01-02_SC1_01_0001";
    for suffix in ["toml", "mcap", "neq.json", "state"] {
        fs::remove_file(folder.path().join(format!("{second}.{suffix}"))).expect("remove");
    }
    catalogue::discard(&folder.path().join("catalogue.sqlite"));
    assert_eq!(list(folder.path()).entries.len(), 2);
    assert!(folder.path().join(format!("{second}.neq.json")).exists());

    // A living writer's folder stays.
    let writer = ProductWriter::begin(folder.path()).expect("begin");
    assert_eq!(list(folder.path()).entries.len(), 2);
    assert_eq!(names(&staging).len(), 2, "folder and lock");
    drop(writer);
    assert!(names(&staging).is_empty());
}

#[test]
fn a_damaged_journal_is_refused() {
    let folder = tempfile::tempdir().expect("folder");
    write_a_bit_of_everything(folder.path());
    let entry = folder.path().join("journal/00000002.json");
    let sound = fs::read_to_string(&entry).expect("read");
    fs::write(&entry, sound.replace("SC1_01_0001", "SC1_01_0009")).expect("write");
    let error = Archive::reindex(folder.path()).expect_err("another entry 2").to_string();
    assert!(error.contains("00000003.json is damaged"), "{error}");
    assert!(open(folder.path()).events().is_err());
    fs::remove_file(&entry).expect("remove");
    let error = Archive::reindex(folder.path()).expect_err("no entry 2").to_string();
    assert!(error.contains("it is missing, entry 3 is there"), "{error}");
    fs::write(&entry, &sound).expect("write");
    Archive::reindex(folder.path()).expect("whole again");
    assert_eq!(open(folder.path()).events().expect("events").len(), 9);
}

/// The cases of overlap that a calibration store must tell apart: before, touching, overlapping on either side, inside,
/// around, the same, another spacecraft, another set.
#[test]
fn times_of_a_set_never_overlap() {
    let folder = tempfile::tempdir().expect("folder");
    write(folder.path(), &product(0, "SC1", 1.0));
    write(folder.path(), &product(0, "SC2", 1.0));
    let mut archive = open(folder.path());
    let window = |from: i64, until: Option<i64>| Window {
        from_ns: Some(START_NS + from * DAY_NS),
        until_ns: until.map(|day| START_NS + day * DAY_NS),
    };
    let mut certify = |spacecraft: &str, set: &str, from: i64, until: Option<i64>| {
        archive
            .certify(&FIRST.replace("SC1", spacecraft), set, window(from, until), &stamp())
            .map_err(|e| e.to_string())
    };
    certify("SC1", "ops", 10, Some(20)).expect("the first");
    for (from, until) in [(5, Some(11)), (19, Some(25)), (12, Some(15)), (5, Some(25)), (10, Some(20)), (15, None)] {
        let error = certify("SC1", "ops", from, until).expect_err("it overlaps");
        assert!(error.contains("which overlaps"), "{error}");
    }
    assert!(certify("SC1", "ops", 30, Some(30)).expect_err("no time").contains("not after"));
    certify("SC1", "ops", 5, Some(10)).expect("it ends where the first begins");
    certify("SC1", "ops", 20, None).expect("it begins where the first ends");
    certify("SC2", "ops", 12, Some(15)).expect("another spacecraft");
    certify("SC1", "reprocessed", 12, Some(15)).expect("another set");
    let mut archive = open(folder.path());
    archive.decertify("ops", "SC1", window(12, Some(14)), &stamp()).expect("taken out of the middle");
    let times = |archive: &Archive| {
        let all = archive.validity(Some("ops")).expect("times");
        let day = |ns: i64| if ns == i64::MAX { 999 } else { (ns - START_NS) / DAY_NS };
        all.iter().filter(|v| v.spacecraft == "SC1").map(|v| (day(v.from_ns), day(v.until_ns))).collect::<Vec<_>>()
    };
    assert_eq!(times(&archive), [(5, 10), (10, 12), (14, 20), (20, 999)]);
    let error = archive.decertify("ops", "SC1", window(0, Some(4)), &stamp()).expect_err("nothing there");
    assert!(error.to_string().contains("says nothing"), "{error}");
    archive.set_state("ops", SetState::Published, "", &stamp()).expect("published");
    let error = archive.decertify("ops", "SC1", window(5, Some(6)), &stamp()).expect_err("published");
    assert!(error.to_string().contains("set ops is published"), "{error}");
    assert!(archive.set_state("ops", SetState::Open, "", &stamp()).is_err(), "it stays published");
    archive.set_state("ops", SetState::Invalidated, "the survey was wrong", &stamp()).expect("invalidated");
    assert!(archive.set_state("nothing", SetState::Published, "", &stamp()).is_err());
}

#[test]
fn inputs_that_have_moved_are_found_by_digest() {
    let folder = tempfile::tempdir().expect("folder");
    let data = tempfile::tempdir().expect("folder");
    let place = data.path().join("a.mcap");
    fs::write(&place, "abc").expect("write");
    let made_of =
        MadeOf { places: vec![InputPlace { sha256: sha256("abc"), path: place.clone() }], ..MadeOf::default() };
    let writer = ProductWriter::begin(folder.path()).expect("begin");
    writer.commit(&product(0, "SC1", 1.0), made_of, &stamp()).expect("commit");
    let mut archive = open(folder.path());
    assert_eq!(archive.inputs(FIRST).expect("inputs")[0].path.as_deref(), Some(place.as_path()));
    let moved = data.path().join("deep/er");
    fs::create_dir_all(&moved).expect("folder");
    fs::write(moved.join("decoy.mcap"), "xyz").expect("write");
    fs::rename(&place, moved.join("renamed.mcap")).expect("rename");
    let look = |archive: &mut Archive, at: &Path| archive.look_in(&[at.to_owned()], &[FIRST], &stamp()).expect("look");
    assert_eq!(look(&mut archive, folder.path()), 0);
    assert_eq!(look(&mut archive, data.path()), 1);
    assert_eq!(archive.inputs(FIRST).expect("inputs")[0].path.as_deref(), Some(moved.join("renamed.mcap").as_path()));
    assert_eq!(look(&mut archive, data.path()), 0, "nothing is missing any more");
}

#[test]
fn an_archive_of_an_earlier_version_is_taken_over() {
    let (old, new) = (tempfile::tempdir().expect("folder"), tempfile::tempdir().expect("folder"));
    let written = write(old.path(), &product(0, "SC1", 1.0));
    for suffix in ["toml", "mcap", "neq.json"] {
        let name = format!("{FIRST}.{suffix}");
        fs::copy(old.path().join(&name), new.path().join(&name)).expect("copy");
    }
    let broken = "COM1B_2035-01-02_SC1_01_0001.toml";
    fs::write(new.path().join(broken), "half").expect("write");
    let sources = json!({"pipeline": "/gone", "mission": "/gone", "model": "/gone", "telemetry": ["/data/a.mcap"],
        "from_ns": 5, "until_ns": null});
    fs::write(new.path().join(format!("{FIRST}.sources.json")), sources.to_string()).expect("write");
    fs::write(new.path().join(format!("{FIRST}.extract.json")), "{}").expect("write");
    let error = Archive::open(new.path()).expect_err("of before").to_string();
    assert!(error.contains("dragfree archive migrate"), "{error}");
    let migrated = migrate(new.path(), &stamp()).expect("migrated");
    assert_eq!(migrated.products, [FIRST]);
    assert_eq!(migrated.problems.len(), 1);
    let archive = open(new.path());
    let product = archive.product(FIRST).expect("sound");
    assert_eq!(product.digest(), written.product.digest());
    let inputs = archive.inputs(FIRST).expect("inputs");
    assert_eq!(inputs[0].path.as_deref(), Some(Path::new("/data/a.mcap")));
    assert_eq!(archive.row(FIRST).expect("row").asked_from_ns, Some(5));
    let problems = list(new.path()).problems;
    assert_eq!(problems.len(), 1, "{problems:?}");
    assert!(problems[0].path.ends_with(broken));
    assert!(migrate(new.path(), &stamp()).expect("again").products.is_empty());
}

#[test]
fn an_archive_that_cannot_be_written_is_read() {
    let folder = tempfile::tempdir().expect("folder");
    write_a_bit_of_everything(folder.path());
    let of_memory = Archive::open(folder.path()).expect("archive");
    let known = of_memory.catalogue.dump();
    // A catalogue that cannot be opened, as on a disk that is full: a folder is in its place.
    catalogue::discard(&folder.path().join("catalogue.sqlite"));
    fs::create_dir(folder.path().join("catalogue.sqlite")).expect("folder");
    let archive = Archive::open(folder.path()).expect("it is read all the same");
    assert_eq!(archive.catalogue.dump(), known);
    assert_eq!(archive.list(&Find::default()).expect("list").entries.len(), 3);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    /// Whatever is certified and taken out again, every instant has at most one product, and the one that was certified
    /// last.
    #[test]
    fn a_set_says_what_it_was_told(steps in prop::collection::vec((any::<bool>(), 0..40_i64, 1..20_i64), 1..12)) {
        let folder = tempfile::tempdir().expect("folder");
        write(folder.path(), &product(0, "SC1", 1.0));
        let mut archive = open(folder.path());
        let mut holds = [false; 64];
        for (certify, from, length) in steps {
            let window = Window { from_ns: Some(from), until_ns: Some(from + length) };
            let hours = from as usize..(from + length) as usize;
            let any = holds[hours.clone()].contains(&true);
            if certify {
                let done = archive.certify(FIRST, "s", window, &stamp());
                prop_assert_eq!(done.is_ok(), !any);
                if !any {
                    holds[hours].fill(true);
                }
            } else {
                let done = archive.decertify("s", "SC1", window, &stamp());
                prop_assert_eq!(done.is_ok(), any);
                holds[hours].fill(false);
            }
        }
        let all = archive.validity(Some("s")).expect("times");
        for (hour, held) in holds.iter().enumerate() {
            let hour = hour as i64;
            let found = all.iter().filter(|v| v.from_ns <= hour && hour < v.until_ns).count();
            prop_assert_eq!(found, usize::from(*held));
        }
    }
}
