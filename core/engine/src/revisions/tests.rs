use super::*;
use crate::config::Prior;
use proptest::prelude::*;
use std::collections::BTreeMap;

const FIRST: &str = "\
# The model that every mission starts with.
[model]
revision = \"1\" # by hand

# Both test masses.

[[effect]]
id = \"com-offset\"
instance = \"tm1\"   # the first
prior = { x = { sigma = 0.01 } }

# and the other one
[[effect]]
id       = \"com-offset\"
instance = \"tm2\"
";

fn first(folder: &Path) -> PathBuf {
    let path = folder.join("m.toml");
    fs::write(&path, FIRST).expect("written");
    path
}

fn change(path: &Path, act: impl FnOnce(&mut Edit)) -> Committed {
    let mut edit = Edit::begin(path).expect("a model");
    act(&mut edit);
    edit.commit().expect("committed").expect("something changed")
}

fn gain() -> EffectEntry {
    let mut entry = EffectEntry::new("es-gain", "tm1.y");
    entry.prior.insert("y".into(), Prior { sigma: Some(0.05), ..Prior::default() });
    entry.parameters.insert("lag_s".into(), toml::Value::Float(480.0));
    entry
}

fn names(path: &Path) -> Vec<String> {
    log(path).expect("a log").revisions.into_iter().map(|r| r.revision).collect()
}

#[test]
fn comments_and_formatting_survive() {
    let folder = tempfile::tempdir().expect("folder");
    let path = first(folder.path());
    let added = change(&path, |edit| edit.add(&gain(), "seen").expect("new"));
    let text = fs::read_to_string(&path).expect("readable");
    let header = format!("revision = \"{}\" # by hand\nparent = \"1\"\n", added.revision);
    let tail = "\n# seen\n[[effect]]\nid = \"es-gain\"\ninstance = \"tm1.y\"\nestimate = true\n\
                parameters = { lag_s = 480.0 }\nprior.y.sigma = 0.05\n";
    assert_eq!(text, FIRST.replace("revision = \"1\" # by hand\n", &header) + tail);
    // What an empty line parts from an effect is not that effect's, and stays when it goes.
    let removed = change(&path, |edit| edit.remove("com-offset", Some("tm1")).expect("there"));
    let text = fs::read_to_string(&path).expect("readable");
    assert!(text.contains("# Both test masses.\n") && !text.contains("the first"), "{text}");
    assert!(
        text.contains("# and the other one\n[[effect]]\nid       = \"com-offset\"\ninstance = \"tm2\"\n"),
        "{text}"
    );
    assert!(Model::parts(&removed.revision).is_some_and(|(counter, _)| counter == 3), "{}", removed.revision);
    // All of them are what they were.
    assert_eq!(find(&path, "1").expect("kept").1, FIRST);
    assert_eq!(names(&path), [removed.revision, added.revision, "1".to_owned()]);
}

#[test]
fn an_effect_that_is_there_or_is_not_is_refused_and_nothing_is_left_behind() {
    let folder = tempfile::tempdir().expect("folder");
    let path = first(folder.path());
    let mut edit = Edit::begin(&path).expect("a model");
    let twice = edit.add(&EffectEntry::new("com-offset", "tm1"), "").expect_err("there").to_string();
    assert!(twice.contains("com-offset:tm1 is in the model already"), "{twice}");
    for (id, instance, part) in [
        ("es-gain", Some("tm1.y"), "es-gain:tm1.y is not in the model; the model has com-offset:tm1, com-offset:tm2"),
        ("com-offset", None, "com-offset is in the model 2 times: name the instance"),
    ] {
        let error = edit.remove(id, instance).expect_err(part).to_string();
        assert!(error.contains(part), "{error}");
    }
    assert!(edit.commit().expect("nothing to do").is_none());
    let left: Vec<_> = fs::read_dir(folder.path()).expect("folder").flatten().map(|e| e.file_name()).collect();
    assert_eq!(left, ["m.toml"]);
    assert_eq!(fs::read_to_string(&path).expect("readable"), FIRST);
}

#[test]
fn what_was_edited_by_hand_becomes_a_revision_of_its_own() {
    let folder = tempfile::tempdir().expect("folder");
    let path = first(folder.path());
    let added = change(&path, |edit| edit.add(&gain(), "").expect("new"));
    let edited = fs::read_to_string(&path).expect("readable").replace("0.05", "0.07");
    fs::write(&path, &edited).expect("written");
    assert!(log(&path).expect("a log").revisions[0].edited);
    let removed = change(&path, |edit| edit.remove("com-offset", Some("tm2")).expect("there"));
    let recorded = removed.recorded.expect("the edit was seen");
    assert_eq!(removed.parent.as_ref(), Some(&recorded));
    let (by_hand, text) = find(&path, &recorded).expect("kept");
    assert_eq!(by_hand.parent.as_ref(), Some(&added.revision));
    assert_eq!(by_hand.effects[2].prior["y"].sigma, Some(0.07));
    assert!(text.contains("# by hand"));
    assert_eq!(names(&path), [removed.revision, recorded, added.revision, "1".to_owned()]);
    // Comments alone make no revision.
    let commented = fs::read_to_string(&path).expect("readable") + "# checked\n";
    fs::write(&path, commented).expect("written");
    assert!(Edit::begin(&path).expect("a model").commit().expect("nothing to do").is_none());
}

/// A name written by hand has no digest: what the history holds under it is what it was.
#[test]
fn a_hand_written_revision_that_was_edited_is_told_by_the_history() {
    let folder = tempfile::tempdir().expect("folder");
    let path = first(folder.path());
    let added = change(&path, |edit| edit.add(&gain(), "").expect("new"));
    fs::write(&path, FIRST.replace("tm2", "tm3")).expect("written");
    let committed = Edit::begin(&path).expect("a model").commit().expect("committed").expect("an edit");
    assert_eq!(committed.recorded.as_ref(), Some(&committed.revision));
    assert_eq!(committed.parent.as_deref(), Some("1"));
    let changed: Vec<_> = committed.changes.iter().map(|c| c.effect.as_str()).collect();
    assert_eq!(changed, ["com-offset:tm2", "com-offset:tm3"]);
    let log = log(&path).expect("a log");
    assert_eq!(log.revisions[0].revision, committed.revision);
    let aside = log.revisions.iter().find(|r| r.revision == added.revision).expect("kept");
    assert_eq!(aside.place, Place::Aside, "the file did not come from it, and it is not lost");
}

/// A kill after any step: the file is the old or the new revision, both are in the history once they were current, and
/// work goes on when the lock is gone.
#[test]
fn a_kill_between_two_steps_loses_nothing() {
    for survived in 0..=3 {
        let folder = tempfile::tempdir().expect("folder");
        let path = first(folder.path());
        let mut edit = Edit::begin(&path).expect("a model");
        edit.add(&gain(), "").expect("new");
        let (steps, committed) = edit.plan().expect("a plan").expect("a change");
        assert_eq!(steps.len(), 3, "the old revision, the new one, the file");
        let mut lock = Some(edit.lock);
        for step in steps.into_iter().take(survived) {
            step.take(&mut lock).expect("a step");
        }
        let killed = lock.is_some();
        std::mem::forget(lock);
        fs::create_dir_all(history_folder(&path)).expect("folder");
        fs::write(history_folder(&path).join(".9-abcdef.partial"), "[mod").expect("half a file");

        let current = Model::load(&path).expect("whole");
        assert_eq!(current.revision, if survived < 3 { "1" } else { &committed.revision }, "after {survived} steps");
        assert!(names(&path).contains(&"1".to_owned()));
        if killed {
            let refused = Edit::begin(&path).expect_err("locked").to_string();
            assert!(refused.contains("m.toml.lock exists") && refused.contains("remove that file"), "{refused}");
            fs::remove_file(folder.path().join("m.toml.lock")).expect("as told");
        }
        let next = change(&path, |edit| edit.remove("com-offset", Some("tm2")).expect("there"));
        assert_eq!(next.parent, Some(current.revision));
        assert_eq!(find(&path, "1").expect("kept").1, FIRST);
        let log = log(&path).expect("a log");
        assert!(log.problems.is_empty(), "{:?}", log.problems);
        assert_eq!(log.revisions.len(), if survived < 2 { 2 } else { 3 });
    }
}

#[test]
fn two_writers_do_not_lose_each_others_changes() {
    let folder = tempfile::tempdir().expect("folder");
    let path = first(folder.path());
    let mut edit = Edit::begin(&path).expect("a model");
    assert!(matches!(Edit::begin(&path), Err(RevisionError::Locked { .. })));
    edit.add(&gain(), "").expect("new");
    // An editor knows no lock.
    let theirs = FIRST.replace("0.01", "0.02");
    fs::write(&path, &theirs).expect("written");
    assert!(matches!(edit.commit(), Err(RevisionError::Changed { .. })));
    assert_eq!(fs::read_to_string(&path).expect("readable"), theirs);
    Edit::begin(&path).expect("the lock is gone");
}

#[test]
fn an_earlier_revision_can_be_restored() {
    let folder = tempfile::tempdir().expect("folder");
    let path = first(folder.path());
    let added = change(&path, |edit| edit.add(&gain(), "").expect("new"));
    let restored = change(&path, |edit| edit.restore("1").expect("kept"));
    assert_eq!(restored.parent, Some(added.revision.clone()));
    assert_eq!(Model::load(&path).expect("whole").effects, find(&path, "1").expect("kept").0.effects);
    let again = change(&path, |edit| edit.restore("2").expect("the number is enough"));
    assert_eq!(Model::parts(&again.revision).map(|p| p.1), Model::parts(&added.revision).map(|p| p.1));
    let error = find(&path, "7").expect_err("none").to_string();
    assert!(error.contains("no revision 7") && error.contains(&added.revision), "{error}");
}

#[test]
fn coefficients_are_fixed_in_a_file_of_their_own() {
    let folder = tempfile::tempdir().expect("folder");
    let path = first(folder.path());
    let added = change(&path, |edit| edit.add(&gain(), "").expect("new"));
    let values = [
        ("com-offset.tm1.x", 0.1),
        ("com-offset.tm1.y", -0.25),
        ("com-offset.tm2.x", 0.3),
        ("es-gain.tm1.y", 0.027_000_000_000_000_003),
    ];
    let values = values.map(|(name, number)| (name.to_owned(), number));
    let held = folder.path().join("held.toml");
    let fix = |base: &str, values: &[(String, f64)], keep: &[&str]| {
        let mut edit = Edit::begin_or_new(&held)?;
        let keep: Vec<String> = keep.iter().map(|&k| k.to_owned()).collect();
        edit.fix(&path, base, ("COM1B_2035-01-01_SC1_01_0001", values), &keep)?;
        edit.commit()
    };
    let fixed = fix(&added.revision, &values, &["com-offset"]).expect("fixed").expect("a change");
    assert_eq!((fixed.before, fixed.parent.as_ref()), (None, Some(&added.revision)));
    let model = Model::load(&held).expect("whole");
    assert_eq!(model.effects.iter().map(|e| e.estimate).collect::<Vec<_>>(), [true, true, false]);
    assert_eq!(model.effects[2].prior["y"].value, Some(0.027_000_000_000_000_003), "no bit is lost");
    // Of the older revision, over the file of the newer one, which its history keeps.
    let older = fix("1", &values, &[]).expect("fixed").expect("a change");
    assert_eq!((older.before, older.parent.as_deref()), (Some(fixed.revision.clone()), Some("1")));
    let model = Model::load(&held).expect("whole");
    assert!(model.effects.iter().all(|e| !e.estimate) && model.effects.len() == 2);
    assert_eq!(model.effects[0].prior["x"], Prior { value: Some(0.1), sigma: Some(0.01), ..Prior::default() });
    assert!(find(&held, &fixed.revision).is_ok());
    assert_eq!(Model::load(&path).expect("whole").revision, added.revision, "the model itself is left alone");

    let nan = [("com-offset.tm1.x".to_owned(), f64::NAN)];
    let ambiguous = [("com-offset.tm1.a.x".to_owned(), 0.1), ("com-offset.tm1.b.x".to_owned(), 0.2)];
    for (values, keep, part) in [
        (&values[..2], &[][..], "no coefficient of effect com-offset:tm2"),
        (&nan[..], &[], "com-offset.tm1.x has no value in the product"),
        (&ambiguous[..], &[], "two coefficients end in .x"),
        (&values[..], &["thermal"], "thermal is not in the model"),
    ] {
        let error = fix("1", values, keep).expect_err(part).to_string();
        assert!(error.contains(part), "{error}");
    }
}

#[test]
fn a_damaged_history_is_told_and_not_used() {
    let folder = tempfile::tempdir().expect("folder");
    let path = first(folder.path());
    let added = change(&path, |edit| edit.add(&gain(), "").expect("new"));
    change(&path, |edit| edit.remove("es-gain", None).expect("there"));
    let kept = history_folder(&path).join(format!("{}.toml", added.revision));
    let text = fs::read_to_string(&kept).expect("readable");
    fs::remove_file(&kept).expect("removed");
    fs::write(&kept, text.replace("0.05", "0.5")).expect("written");
    let log = log(&path).expect("a log");
    assert_eq!(log.problems.len(), 1);
    assert!(log.problems[0].reason.contains("have the digest"), "{:?}", log.problems);
    assert!(matches!(find(&path, &added.revision), Err(RevisionError::NoRevision { .. })));
}

#[test]
fn a_revision_that_cannot_name_a_file_is_refused() {
    let folder = tempfile::tempdir().expect("folder");
    let path = first(folder.path());
    for bad in ["", "../1", "a b", ".1"] {
        fs::write(&path, FIRST.replace("\"1\"", &format!("\"{bad}\""))).expect("written");
        let error = Edit::begin(&path).expect_err(bad).to_string();
        assert!(error.contains("cannot name a file"), "{error}");
    }
    fs::write(&path, "effect = [{ id = \"a\" }]\n[model]\nrevision = \"1\"\n").expect("written");
    let error = Edit::begin(&path).expect("a model").add(&gain(), "").expect_err("not tables").to_string();
    assert!(error.contains("[[effect]] tables"), "{error}");
}

fn number() -> impl Strategy<Value = f64> {
    prop_oneof![any::<f64>().prop_filter("finite", |x| x.is_finite()), (-1000..1000_i32).prop_map(f64::from)]
}

fn parameter() -> impl Strategy<Value = toml::Value> {
    let leaf = prop_oneof![
        number().prop_map(toml::Value::Float),
        any::<i64>().prop_map(toml::Value::Integer),
        any::<bool>().prop_map(toml::Value::Boolean),
        any::<String>().prop_map(toml::Value::String),
    ];
    leaf.prop_recursive(2, 8, 4, |inner| prop::collection::vec(inner, 0..4).prop_map(toml::Value::Array))
}

fn effect() -> impl Strategy<Value = EffectEntry> {
    let positive = number().prop_map(|x| x.abs().max(f64::MIN_POSITIVE));
    let prior = (prop::option::of(number()), prop::option::of(positive), prop::option::of(number()))
        .prop_filter("a prior that says nothing is none", |(v, s, l)| v.is_some() || s.is_some() || l.is_some())
        .prop_map(|(value, sigma, lower)| Prior { value, sigma, lower, upper: value });
    (
        any::<String>(),
        "(tm[12](\\.[xyz](-[xyz])?)?)?",
        any::<[bool; 2]>(),
        prop::collection::btree_map("[a-z\"ü -]{1,4}", prior, 0..3),
        prop::collection::btree_map(any::<String>(), parameter(), 0..3),
    )
        .prop_map(|(id, instance, [estimate, isolate], prior, parameters)| EffectEntry {
            id,
            instance,
            estimate,
            isolate,
            prior,
            parameters: parameters.into_iter().collect(),
        })
}

fn distinct(effects: Vec<EffectEntry>) -> Vec<EffectEntry> {
    let mut by_name = BTreeMap::new();
    for effect in effects {
        by_name.insert((effect.id.clone(), effect.instance.clone()), effect);
    }
    by_name.into_values().collect()
}

proptest! {
    // Every case is flushed to disk some twenty times.
    #![proptest_config(ProptestConfig::with_cases(64))]

    /// What is written is read back, whatever stands in it; and an effect that comes and goes leaves no trace in the
    /// model.
    #[test]
    fn a_model_is_read_as_it_was_written(
        effects in prop::collection::vec(effect(), 0..4).prop_map(distinct),
        at in any::<prop::sample::Index>(),
    ) {
        let folder = tempfile::tempdir().expect("folder");
        let path = folder.path().join("m.toml");
        fs::write(&path, "[model]\nrevision = \"1\"\n").expect("written");
        let mut edit = Edit::begin(&path).expect("a model");
        for effect in &effects {
            edit.add(effect, "").expect("new");
        }
        edit.commit().expect("committed");
        prop_assert_eq!(&Model::load(&path).expect("whole").effects, &effects);
        prop_assert!(!Model::load(&path).expect("whole").edited_by_hand());

        if !effects.is_empty() {
            let gone = at.get(&effects);
            change(&path, |edit| edit.remove(&gone.id, Some(&gone.instance)).expect("there"));
            change(&path, |edit| edit.add(gone, "").expect("new"));
            let mut back = Model::load(&path).expect("whole").effects;
            back.sort_by(|a, b| (&a.id, &a.instance).cmp(&(&b.id, &b.instance)));
            prop_assert_eq!(&back, &effects);
            change(&path, |edit| edit.add(&EffectEntry::new("one-more", "\u{0}"), "").expect("new"));
            change(&path, |edit| edit.remove("one-more", None).expect("there"));
            let mut again = Model::load(&path).expect("whole").effects;
            again.sort_by(|a, b| (&a.id, &a.instance).cmp(&(&b.id, &b.instance)));
            prop_assert_eq!(again, effects);
        }
    }
}
