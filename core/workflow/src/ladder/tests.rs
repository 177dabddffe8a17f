use super::*;
use dragfree_archive::product::{self, Stage, Status, Stream};
use dragfree_archive::{MadeOf, ProductWriter};
use dragfree_engine::draft::Draft;
use serde_json::json;

/// 2035-01-01.
const START_NS: i64 = 2_051_222_400_000_000_000;
const DAY_NS: i64 = 86_400_000_000_000;

/// A product of one day: revision, parent, effects, χ²/dof, offset ± σ in m; observations are 1000.
struct Made<'a> {
    revision: &'a str,
    parent: Option<&'a str>,
    effects: &'a [&'a str],
    day: i64,
    ratio: f64,
    offset: Option<(f64, f64)>,
    channels: &'a [&'a str],
    observations: f64,
    /// Degrees of freedom that a measured noise takes, of a product that tells observations too.
    noise: Option<f64>,
}

const OFFSET: &[&str] = &["com-offset:tm1"];
const BOTH: &[&str] = &["com-offset:tm1", "es-gain:tm1.y"];
const ALL: &[&str] = &["com-offset:tm1", "es-gain:tm1.y", "thermal:tm1.x"];

fn made<'a>(revision: &'a str, parent: Option<&'a str>, effects: &'a [&'a str], day: i64, ratio: f64) -> Made<'a> {
    let channels = &["tm1.accel.x", "sc.alpha.x"];
    Made {
        revision,
        parent,
        effects,
        day,
        ratio,
        offset: Some((0.1, 1e-3)),
        channels,
        observations: 1000.0,
        noise: None,
    }
}

impl Made<'_> {
    fn offset(self, value: f64, sigma: f64) -> Self {
        Self { offset: Some((value, sigma)), ..self }
    }

    /// With every coefficient fixed.
    fn fixed(self) -> Self {
        Self { offset: None, ..self }
    }

    fn product(&self) -> Product {
        let stage = |name: &&str| {
            let (plugin, instance) = name.split_once(':').expect("an instance");
            Stage {
                plugin: plugin.into(),
                instance: instance.into(),
                kind: "effect".into(),
                version: "0.1.0".into(),
                abi: "1".into(),
                library_sha256: "0".repeat(64),
                parameters_sha256: "0".repeat(64),
            }
        };
        let coefficients: Vec<_> = self
            .offset
            .iter()
            .flat_map(|(value, sigma)| {
                ["qp", "adopted"].map(|solution| {
                    let name = "com-offset.tm1.x";
                    json!({"name": name, "solution": solution, "value": value, "sigma": sigma, "unit": "m", "frame": "ORF_1"})
                })
            })
            .collect();
        let channel = |name: &&str| json!({"channel": name, "dof": 500.0, "measured_over_modelled": self.ratio.sqrt()});
        let free = f64::from(u8::from(self.offset.is_some()));
        let mut report = json!({
            "plugin": "weigher",
            "coefficients": coefficients,
            "chi2_per_dof": self.ratio,
            "nis": 1.0,
            "epochs_used": 100,
            "quality": {
                "dof": self.observations - free - self.noise.unwrap_or(0.0),
                "channels": self.channels.iter().map(channel).collect::<Vec<_>>(),
            },
        });
        if self.noise.is_some() {
            report["quality"]["observations"] = self.observations.into();
        }
        let first_ns = START_NS + self.day * DAY_NS;
        let draft = Draft {
            pipeline: "science-mode".into(),
            product: "COM1B".into(),
            release: 1,
            mission: "Taiji".into(),
            spacecraft: "SC1".into(),
            first_ns,
            last_ns: first_ns + DAY_NS - 1,
            inputs: Vec::new(),
            history: self.effects.iter().map(stage).collect(),
            model: product::Model {
                revision: self.revision.into(),
                parent: self.parent.map(str::to_owned),
                fixed_from: None,
                effects: Vec::new(),
                noise_levels: Vec::new(),
            },
            software: "0.1.0".into(),
            replay: dragfree_engine::feed::Summary { time_scale: "UTC".into(), ..Default::default() },
            reports: vec![serde_json::from_value(report).expect("a report")],
            settings: Default::default(),
            stream: Stream::Test,
            status: Status::Quicklook,
            created: chrono::DateTime::UNIX_EPOCH,
        };
        let folder = tempfile::tempdir().expect("folder");
        let writer = ProductWriter::begin(folder.path()).expect("begin");
        draft.commit(writer, MadeOf::default()).expect("commit").product
    }
}

fn of(fitted: &[Made<'_>], held_out: &[Made<'_>]) -> Result<Ladder, LadderError> {
    let products = |of: &[Made<'_>]| of.iter().map(Made::product).collect::<Vec<_>>();
    let truth = |name: &str| (name == "com-offset.tm1.x").then_some(0.1);
    ladder(&products(fitted), &products(held_out), &truth, &|_| None)
}

fn near(found: f64, wanted: f64) {
    assert!((found - wanted).abs() <= 1e-9 * wanted.abs().max(1.0), "{found} is not {wanted}");
}

#[test]
fn an_effect_that_helps_only_where_it_was_fitted_is_called_over_fitted_by_name() {
    let fitted = [
        made("3-cccccc", Some("2-bbbbbb"), ALL, 0, 0.99).offset(0.1, 2e-3),
        made("1", None, OFFSET, 0, 1.5).offset(0.106, 1e-3),
        made("2-bbbbbb", Some("1"), BOTH, 0, 1.0).offset(0.102, 2e-3),
    ];
    let held_out = [
        made("9-000001", Some("1"), OFFSET, 1, 1.4).fixed(),
        made("9-000002", Some("2-bbbbbb"), BOTH, 1, 1.1).fixed(),
        made("9-000003", Some("3-cccccc"), ALL, 1, 1.12).fixed(),
    ];
    let ladder = of(&fitted, &held_out).expect("a ladder");
    assert!(ladder.notes.is_empty(), "{:?}", ladder.notes);
    let [first, second, third] = &ladder.revisions[..] else { panic!("{:?}", ladder.revisions) };
    assert_eq!(
        (first.revision.as_str(), second.revision.as_str(), third.revision.as_str()),
        ("1", "2-bbbbbb", "3-cccccc")
    );
    assert_eq!((&second.compared_with, &second.added), (&Some("1".to_owned()), &vec!["es-gain:tm1.y".to_owned()]));

    // By hand: 1000 observations, one coefficient among them.
    near(first.fit.chi2, 1500.0);
    near(first.fit.rms, 1.5_f64.sqrt());
    near(second.fall.expect("compared").delta_chi2, 500.0);
    near(third.fall.expect("compared").delta_chi2, 10.0);
    near(second.fit.channels[1].chi2_per_dof, 1.0);
    // From 106 to 102 mm at a σ of 2 mm; the truth is 100 mm.
    near(second.coefficients[0].change_sigmas.expect("compared"), -2.0);
    near(first.coefficients[0].error.expect("known"), 0.006);
    near(first.coefficients[0].error_sigmas.expect("known"), 6.0);
    near(second.coefficients[0].error_sigmas.expect("known"), 1.0);

    let held = |rung: &Rung| rung.held_out.as_ref().and_then(|h| Some((h.fall?.delta_chi2, h.verdict?)));
    assert_eq!(held(first), None);
    let (helps, over) = (held(second).expect("compared"), held(third).expect("compared"));
    near(helps.0, 300.0);
    near(over.0, -20.0);
    assert_eq!((helps.1, over.1), (Verdict::Helps, Verdict::OverFitted));
    assert_eq!(ladder.over_fitted.len(), 1);
    assert_eq!(ladder.over_fitted[0].effects, ["thermal:tm1.x"]);
}

#[test]
fn days_add_up_and_a_day_that_is_not_everybodys_is_left_out() {
    let fitted = [
        made("1", None, OFFSET, 0, 1.2).offset(0.1, 1e-3),
        made("1", None, OFFSET, 1, 1.4).offset(0.13, 2e-3),
        made("1", None, OFFSET, 2, 9.0),
        made("2-bbbbbb", Some("1"), BOTH, 0, 1.0),
        made("2-bbbbbb", Some("1"), BOTH, 1, 1.1),
    ];
    let ladder = of(&fitted, &[]).expect("a ladder");
    assert_eq!(ladder.days.len(), 2);
    assert!(ladder.notes.iter().any(|n| n.contains("COM1B_2035-01-03_SC1_01_0001: left out")), "{:?}", ladder.notes);
    near(ladder.revisions[0].fit.chi2_per_dof, 1.3);
    near(ladder.revisions[1].fall.expect("compared").delta_chi2, 500.0);
    // Weights 4 : 1.
    near(ladder.revisions[0].coefficients[0].value, 0.106);
    near(ladder.revisions[0].coefficients[0].sigma, 1e-3 * (4.0_f64 / 5.0).sqrt());
}

#[test]
fn where_the_parent_has_no_product_the_nearest_model_inside_this_one_stands_for_it() {
    let fitted = [
        made("1", None, OFFSET, 0, 1.5),
        made("3-cccccc", Some("2-bbbbbb"), ALL, 0, 1.0),
        made("4-dddddd", Some("nobody"), BOTH, 0, 1.1),
    ];
    let ladder = of(&fitted, &[]).expect("a ladder");
    let told: Vec<_> = ladder.revisions.iter().map(|r| (r.revision.as_str(), r.compared_with.as_deref())).collect();
    assert_eq!(told, [("1", None), ("4-dddddd", Some("1")), ("3-cccccc", Some("4-dddddd"))]);
}

#[test]
fn parents_in_a_circle_end() {
    let fitted = [made("a", Some("b"), OFFSET, 0, 1.5), made("b", Some("a"), OFFSET, 0, 1.0)];
    assert_eq!(of(&fitted, &[]).expect("a ladder").revisions.len(), 2);
}

#[test]
fn other_channels_or_epochs_are_not_taken_for_a_better_model() {
    let mut fewer = made("2-bbbbbb", Some("1"), BOTH, 0, 0.9);
    fewer.channels = &["tm1.accel.x"];
    let ladder = of(&[made("1", None, OFFSET, 0, 1.0), fewer], &[]).expect("a ladder");
    assert_eq!(ladder.revisions[1].fall, None);
    assert!(ladder.notes[0].contains("do not weigh the same channels"), "{:?}", ladder.notes);

    // A lag took 200 observations; χ² of those is 200 ± 20, and 16 is no news.
    let mut shorter = made("8-000002", Some("2-bbbbbb"), BOTH, 1, 0.98).fixed();
    shorter.observations = 800.0;
    let fitted = [made("1", None, OFFSET, 0, 1.0), made("2-bbbbbb", Some("1"), BOTH, 0, 0.9)];
    let held_out = [made("8-000001", Some("1"), OFFSET, 1, 1.0).fixed(), shorter];
    let ladder = of(&fitted, &held_out).expect("a ladder");
    let held = ladder.revisions[1].held_out.as_ref().expect("held out");
    near(held.fall.expect("compared").delta_chi2, 16.0);
    near(held.fall.expect("compared").uncertainty, 20.0);
    assert_eq!(held.verdict, Some(Verdict::Undecided));
    assert!(ladder.over_fitted.is_empty());
}

/// A stage that measures the noise band by band has fewer degrees of freedom than one that measures levels alone: of
/// the same epochs.
#[test]
fn a_noise_measured_in_another_way_takes_no_epochs_away() {
    let with = |made: Made<'static>, noise: f64| Made { noise: Some(noise), ..made };
    let fitted = [with(made("1", None, OFFSET, 0, 1.3), 200.0), with(made("2-bbbbbb", Some("1"), BOTH, 0, 1.1), 3.0)];
    let ladder = of(&fitted, &[]).expect("a ladder");
    let fall = ladder.revisions[1].fall.expect("compared");
    near(fall.delta_chi2, 200.0);
    assert_eq!((fall.uncertainty, ladder.notes.len()), (0.0, 0), "{:?}", ladder.notes);
}

#[test]
fn a_product_that_is_no_held_out_one_is_refused() {
    let fitted = || [made("1", None, OFFSET, 0, 1.0), made("2-bbbbbb", Some("1"), BOTH, 0, 0.9)];
    for (held_out, part) in [
        (made("1", None, OFFSET, 1, 1.0), "revision 1 itself, which estimates its coefficients"),
        (made("8-000001", Some("7"), OFFSET, 1, 1.0).fixed(), "no child of a revision of the ladder (1, 2-bbbbbb)"),
        (made("8-000001", Some("1"), OFFSET, 0, 1.0).fixed(), "the fit has seen 2035-01-01 already"),
    ] {
        let error = of(&fitted(), &[held_out]).expect_err(part).to_string();
        assert!(error.contains(part) && error.contains("COM1B_"), "{error}");
    }
    // What the parent lacks is said, not guessed.
    let ladder = of(&fitted(), &[made("8-000002", Some("2-bbbbbb"), BOTH, 1, 1.0).fixed()]).expect("a ladder");
    assert!(ladder.notes[0].contains("revision 1 has no held-out product"), "{:?}", ladder.notes);
    assert!(matches!(ladder.revisions[1].held_out.as_ref().map(|h| h.verdict), Some(None)));

    // A coefficient that one of the two estimates anew lowers χ² whatever the added effect does.
    let held_out =
        [made("8-000001", Some("1"), OFFSET, 1, 1.0).fixed(), made("8-000002", Some("2-bbbbbb"), BOTH, 1, 0.9)];
    let ladder = of(&fitted(), &held_out).expect("a ladder");
    assert!(ladder.notes[0].contains("the same --keep"), "{:?}", ladder.notes);
    assert!(matches!(ladder.revisions[1].held_out.as_ref().map(|h| h.fall), Some(None)));
    // Where both leave it free it is no difference between them.
    let held_out = [made("8-000001", Some("1"), OFFSET, 1, 1.0), made("8-000002", Some("2-bbbbbb"), BOTH, 1, 0.9)];
    let ladder = of(&fitted(), &held_out).expect("a ladder");
    near(ladder.revisions[1].held_out.as_ref().and_then(|h| h.fall).expect("compared").delta_chi2, 100.0);

    let apart = [made("1", None, OFFSET, 0, 1.0), made("2-bbbbbb", Some("1"), BOTH, 1, 0.9)];
    let error = of(&apart, &[]).expect_err("nothing in common").to_string();
    assert!(error.contains("no stretch of data was fitted with every revision"), "{error}");
    assert!(of(&[], &[]).is_err());
}
