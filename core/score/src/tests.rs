use super::*;
use serde_json::json;

fn hidden(effect: &str, instance: &str, size: f64, shape: &Value) -> Value {
    json!({"effect": effect, "instance": instance, "size": size, "unit": "1", "shape": shape, "significance": 10.0,
        "sigma_expected": size.abs() / 10.0})
}

fn sealed(effects: &[Value]) -> Value {
    json!({"effects": effects, "given": [], "start_ns": 1_000_000_000_000_i64, "test_mass_kg": [2.0, 4.0]})
}

fn candidate(who: &str, accepted: bool, value: f64, sigma: f64, confounders: &[&str]) -> Value {
    let (effect, instance) = who.split_once(':').unwrap();
    json!({"effect": effect, "instance": instance, "value": value, "sigma": sigma, "shape": {}, "delta_chi2": 100.0,
        "p_value": 1e-9, "in_range": true, "accepted": accepted, "confounders": confounders,
        "coefficients": [{"name": format!("{effect}.{instance}"), "value": value, "sigma": sigma, "unit": "1"}]})
}

fn diagnosis(verdict: &str, candidates: &[Value]) -> Value {
    json!({"verdict": verdict, "tried": 100, "candidates": candidates, "upper_limits": [], "unexplained": null, "not_tried": []})
}

/// Bundled effects.
fn installed(effect: &str, instance: &str) -> bool {
    effect != "opening-angle" && effect != "current-force" && effect != "product-force" && instance != "is"
}

fn scored(effects: &[Value], diagnosis: &Value) -> Score {
    score(&sealed(effects), diagnosis, &installed).unwrap()
}

fn gain() -> Value {
    hidden("es-gain", "tm2.y", 0.1, &json!({}))
}

#[test]
fn the_true_effect_and_instance_alone_is_right() {
    let found = candidate("es-gain:tm2.y", true, 0.104, 0.002, &[]);
    let next = candidate("es-gain:tm1.y", false, 0.01, 0.01, &[]);
    let s = scored(&[gain()], &diagnosis("missing", &[found, next]));
    assert_eq!((s.verdict, s.correct), (Verdict::Right, true));
    let e = &s.effects[0];
    assert_eq!((e.rank, e.first, e.accepted, e.outcome, e.covered), (Some(1), true, true, Outcome::Accepted, true));
    assert!((e.values[0].difference_sigma - 2.0).abs() < 1e-9 && (e.significance.unwrap() - 52.0).abs() < 1e-9);
    assert_eq!((e.truth.expected_significance, e.truth.hidden), (Some(10.0), true));
    // Nothing hidden and nothing accepted is right too.
    let s = scored(&[], &diagnosis("sufficient", &[candidate("es-gain:tm1.y", false, 0.01, 0.01, &[])]));
    assert_eq!((s.verdict, s.correct, s.accepted.len()), (Verdict::Right, true, 0));
}

/// The right effect at another test mass is a wrong cause.
#[test]
fn a_false_cause_is_wrong_or_a_false_alarm() {
    let other = candidate("es-gain:tm1.y", true, 0.1, 0.01, &[]);
    let s = scored(&[gain()], &diagnosis("missing", std::slice::from_ref(&other)));
    assert_eq!((s.verdict, s.correct, s.effects[0].outcome), (Verdict::Wrong, false, Outcome::Missed));
    assert_eq!(s.false_causes, ["es-gain:tm1.y"]);
    let both = [candidate("es-gain:tm2.y", true, 0.1, 0.01, &[]), other.clone()];
    let s = scored(&[gain()], &diagnosis("missing", &both));
    assert_eq!((s.verdict, s.effects[0].outcome), (Verdict::FalseAlarm, Outcome::Accepted));
    let s = scored(&[], &diagnosis("missing", &[other]));
    assert_eq!((s.verdict, s.correct), (Verdict::FalseAlarm, false));
    assert_eq!(scored(&[], &diagnosis("unexplained", &[])).verdict, Verdict::FalseAlarm);
}

#[test]
fn an_accepted_confounder_is_confounded_and_no_detection_is_missed() {
    let stands = candidate("es-gain:tm1.y", true, 0.1, 0.01, &["es-gain:tm2.y"]);
    let listed = candidate("es-gain:tm2.y", false, 0.1, 0.01, &[]);
    let s = scored(&[gain()], &diagnosis("missing", &[stands.clone(), listed]));
    assert_eq!((s.verdict, s.correct), (Verdict::Confounded, false));
    assert_eq!((s.effects[0].rank, &s.effects[0].confounder_of[..]), (Some(2), &["es-gain:tm1.y".to_owned()][..]));
    assert!(s.false_causes.is_empty());
    // A confounder accepted beside the true cause is a false cause.
    let s = scored(&[gain()], &diagnosis("missing", &[candidate("es-gain:tm2.y", true, 0.1, 0.01, &[]), stands]));
    assert_eq!((s.verdict, s.false_causes.len()), (Verdict::FalseAlarm, 1));

    let mut silent = diagnosis("sufficient", &[]);
    silent["upper_limits"] = json!([{"effect": "es-gain", "instance": "tm2.y", "coefficient": "es-gain.tm2.y", "limit_95": 0.2,
        "unit": "1", "shape": {}}]);
    let s = scored(&[gain()], &silent);
    assert_eq!((s.verdict, s.effects[0].rank), (Verdict::Missed, None));
    assert_eq!((s.effects[0].limits[0].truth, s.effects[0].limits[0].limit_95), (Some(0.1), 0.2));
}

#[test]
fn both_of_two_causes_must_be_found() {
    let pair = [gain(), hidden("mps-tilt", "sc.z", 0.03, &json!({}))];
    let one = candidate("es-gain:tm2.y", true, 0.1, 0.01, &[]);
    assert_eq!(scored(&pair, &diagnosis("missing", std::slice::from_ref(&one))).verdict, Verdict::Missed);
    let mut tilt = candidate("mps-tilt:sc.z", true, 0.031, 0.001, &[]);
    tilt["coefficients"][0]["unit"] = "rad".into();
    let s = scored(&pair, &diagnosis("missing", &[one, tilt]));
    assert_eq!((s.verdict, s.effects[1].first, s.effects[1].rank), (Verdict::Right, false, Some(2)));
    assert!((s.effects[1].values[0].difference_sigma - 1.0).abs() < 1e-9);
}

/// Of two glitches at one place each is compared with the truth at its time, whatever its number; one at another time
/// is a false cause.
#[test]
fn a_second_glitch_at_a_place_is_told_from_the_first_by_its_time() {
    let glitch = |at_s: f64| hidden("impulse", "tm1.z", 1e-10, &json!({"at_s": at_s, "decay_s": 60.0}));
    let found = |who: &str, at_s: i64| {
        let mut found = candidate(who, true, 1e-10, 1e-11, &[]);
        found["shape"] = json!({"at_ns": 1_000_000_000_000_i64 + 1_000_000_000 * at_s});
        found
    };
    let truths = [glitch(500.0), glitch(9000.0)];
    let both = [found("impulse:tm1.z", 9000), found("impulse:tm1.z-2", 500)];
    let s = scored(&truths, &diagnosis("missing", &both));
    assert_eq!((s.verdict, s.effects[0].rank, s.effects[1].rank), (Verdict::Right, Some(2), Some(1)));
    let s = scored(&truths[..1], &diagnosis("missing", &both));
    assert_eq!((s.verdict, s.false_causes.len()), (Verdict::FalseAlarm, 1));
}

/// No installed effect covers it: by id, by instance, or because it was not tried.
#[test]
fn an_uncovered_cause_is_unexplained_with_its_driver() {
    let unknown = |effect: &str| [hidden(effect, "tm1.x", 1e-13, &json!({"lag_s": 50.0}))];
    let mut told = diagnosis("unexplained", &[]);
    told["unexplained"] = json!({"coherent_with": ["hk.tank_mass_kg", "d/dt hk.tank_mass_kg", "hk.battery_current_a^2",
        "hk.structure_temperature_k * hk.battery_current_a"]});
    let s = scored(&unknown("current-force"), &told);
    assert_eq!((s.verdict, s.correct, s.effects[0].driver_rank), (Verdict::Unexplained, true, Some(3)));
    assert!(!s.effects[0].covered && s.effects[0].outcome == Outcome::Unexplained);
    let s = scored(&unknown("product-force"), &told);
    assert_eq!((s.verdict, s.correct, s.effects[0].driver_rank), (Verdict::Unexplained, false, Some(4)));
    // An installed effect accepted instead is wrong; no detection is missed.
    let s =
        scored(&unknown("current-force"), &diagnosis("missing", &[candidate("thermal:tm1.x", true, 1.0, 0.1, &[])]));
    assert_eq!(s.verdict, Verdict::Wrong);
    assert_eq!(scored(&unknown("current-force"), &diagnosis("sufficient", &[])).verdict, Verdict::Missed);
    // A covered effect that is reported as unexplained is not found.
    let s = scored(&[gain()], &told);
    assert_eq!((s.verdict, s.correct, s.effects[0].outcome), (Verdict::Unexplained, false, Outcome::Missed));

    let scale = [hidden("is-scale", "tm1.y", 0.1, &json!({}))];
    assert!(scored(&scale, &told).effects[0].covered);
    told["not_tried"] = json!([["is-scale:tm1.y", "it is not tried"]]);
    let s = scored(&scale, &told);
    assert_eq!(s.effects[0].not_covered_because.as_deref(), Some("it is not tried"));
    assert_eq!((s.verdict, s.correct), (Verdict::Unexplained, true));
    assert!(!scored(&[hidden("time-offset", "is", 0.1, &json!({}))], &told).effects[0].covered);
}

/// The begin of a slow glitch is known to its rise: one that begins 140 s early and rises and decays so much more
/// slowly that its mean time is right is the same, and one whose mean time is 200 s later is another.
#[test]
fn a_glitch_is_found_at_its_mean_time() {
    let glitch = [hidden("impulse", "tm2.y", 1e-11, &json!({"at_s": 500.0, "rise_s": 5.0, "decay_s": 60.0}))];
    let found = |decay_s: f64| {
        let mut found = candidate("impulse:tm2.y", true, 1e-11, 1e-12, &[]);
        found["shape"] = json!({"at_ns": 1_360_000_000_000_i64, "rise_s": 70.0, "decay_s": decay_s});
        scored(&glitch, &diagnosis("missing", &[found]))
    };
    let (same, other) = (found(130.0), found(335.0));
    assert!(same.verdict == Verdict::Right && (same.effects[0].time_error_s.unwrap() + 5.0).abs() < 1e-9);
    assert_eq!(other.verdict, Verdict::Wrong);
}

/// A transient found at another time is another event.
#[test]
fn an_impulse_is_found_at_its_time() {
    let hit =
        [hidden("impulse", "sc.y", 1e-6, &json!({"at_s": 500.0, "arm_x_m": 0.5, "arm_y_m": 0.25, "arm_z_m": 0.3}))];
    let mut found = candidate("impulse:sc.y", true, 1.1e-6, 1e-7, &[]);
    found["coefficients"] =
        json!([{"name": "impulse.sc.y.angular_z", "value": 1.1e-6, "sigma": 1e-7, "unit": "N m s"}]);
    found["shape"]["at_ns"] = 1_500_100_000_000_i64.into();
    let s = scored(&hit, &diagnosis("missing", std::slice::from_ref(&found)));
    assert!((s.effects[0].time_error_s.unwrap() - 0.1).abs() < 1e-9);
    // z of the arm times the momentum, 0.5 m × 1e-6 N s.
    assert_eq!(s.effects[0].values[0].truth, 0.5e-6);
    assert_eq!(s.verdict, Verdict::Right);
    found["shape"]["at_ns"] = 1_700_000_000_000_i64.into();
    assert_eq!(scored(&hit, &diagnosis("missing", &[found])).verdict, Verdict::Wrong);
    // An antenna's sign is free; the size counts.
    let mut stop = candidate("impulse:sc.psi", true, -2e-6, 1e-7, &[]);
    stop["coefficients"][0]["unit"] = "N m s".into();
    stop["shape"]["at_ns"] = 9_000_000_000_000_i64.into();
    let s = scored(&[hidden("impulse", "sc.psi", 2.1e-6, &json!({"at_s": 3600.0}))], &diagnosis("missing", &[stop]));
    assert!((s.effects[0].values[0].difference_sigma - 1.0).abs() < 1e-9 && s.effects[0].time_error_s.is_none());
}

/// Values that differ from the size, by hand from the physics of either side.
#[test]
fn sizes_become_coefficients() {
    let truth = |effect: &str, instance: &str, size: f64, shape: &Value| {
        truths(&sealed(&[hidden(effect, instance, size, shape)])).unwrap().remove(0)
    };
    let of = |t: &Truth, shape: Value| expected(t, shape.as_object().unwrap(), &sealed(&[]));
    let value = |t: &Truth, shape: Value| of(t, shape).unwrap()[0].value;
    // A slug of a fifth of the whole is a quarter of the rest.
    assert!((value(&truth("slosh", "sc.y", 0.2, &json!({})), json!({"f0_hz": 0.03})) - 0.25).abs() < 1e-15);
    // The resonance with the spacecraft free exceeds that with it held by the root of all over the rest.
    let slug = truth("slosh", "sc.y", 0.19, &json!({"f0_hz": 0.09, "zeta": 0.02}));
    assert!((expected_shape(&slug)["f0_hz"].as_f64().unwrap() - 0.1).abs() < 1e-12);
    let heat = truth("thermal", "tm2.z", 3e-12, &json!({"lag_s": 480.0}));
    let faces = |plus: &str, minus: &str| json!({"plus": format!("hk.eh{plus}_temperature_k"), "minus": format!("hk.eh{minus}_temperature_k")});
    assert_eq!(value(&heat, faces("2_zp", "2_zm")), 3e-12);
    assert_eq!(value(&heat, faces("2_zm", "2_zp")), -3e-12);
    assert!(of(&heat, faces("1_zp", "1_zm")).unwrap_err().contains("hk.eh1_zp_temperature_k"));
    let drift = truth("offset-drift", "sc.x", 0.0, &json!({"kappa_m_k": 5e-6, "beta_m_kg": 0.0}));
    assert_eq!(of(&drift, json!({"with": "hk.structure_temperature_k"})).unwrap()[0].unit, "m K-1");
    assert!(of(&drift, json!({"with": "time"})).unwrap_err().contains("the truth hk.structure_temperature_k"));
    assert_eq!(value(&truth("offset-drift", "sc.x", 1e-9, &json!({})), json!({"with": "time"})), 1e-9);
    let magnet = truth("magnetic", "tm2", 0.0, &json!({"moment_a_m2": 2e-8}));
    assert_eq!(value(&magnet, json!({"gradient": "hk.magnetic_gradient2_t_m"})), 2e-8 / 4.0);
    assert!(of(&magnet, json!({"gradient": "hk.magnetic_gradient1_t_m"})).is_err());
    assert!(of(&truth("magnetic", "tm2", 1e-5, &json!({})), json!({})).is_err());
    let opened = |shape: Value| of(&truth("opening-angle", "tm1", 0.02, &shape), json!({}));
    assert_eq!(opened(json!({"rate_rad_s": 0.0, "follow": 0.0})).unwrap()[0].value, 0.02);
    assert!(opened(json!({"rate_rad_s": 1e-8})).is_err() && opened(json!({"follow": 1.0})).is_err());
    for drifts in [json!({"per_day": 0.06}), json!({"from_s": 3600.0})] {
        assert!(of(&truth("mps-gain", "sc.y", 0.1, &drifts), json!({})).is_err(), "{drifts}");
    }
    let charge = truth("charge", "tm1", 0.05, &json!({}));
    assert_eq!(value(&charge, json!({"charge": "hk.tm1_charge_c"})), 0.05);
    assert!(of(&charge, json!({"charge": "hk.tm2_charge_c"})).is_err());
    // The simulator numbers test masses in the order of their names, whatever these are.
    let mut named = sealed(&[]);
    named["test_masses"] = json!(["a2", "cube"]);
    let of_named = |t: &Truth, shape: Value| expected(t, shape.as_object().unwrap(), &named);
    let heat = truth("thermal", "a2.z", 3e-12, &json!({"lag_s": 480.0}));
    assert_eq!(of_named(&heat, faces("1_zp", "1_zm")).unwrap()[0].value, 3e-12);
    let charge = truth("charge", "cube", 0.05, &json!({}));
    assert_eq!(of_named(&charge, json!({"charge": "hk.cube_charge_c"})).unwrap()[0].value, 0.05);
    assert_eq!(of_named(&truth("impulse", "cube.z", 1e-9, &json!({})), json!({})).unwrap().len(), 1);
    assert!(of(&truth("is-noise", "tm1.y", 1.0, &json!({"line_hz": 0.1})), json!({})).is_err());
    assert_eq!(value(&truth("is-noise", "tm1.y", 1.5, &json!({"line_hz": 0.0})), json!({})), 1.5);
    assert_eq!(of(&truth("tilt-to-length", "tm1", 1e-3, &json!({})), json!({})).unwrap()[1].value, 0.0);
    assert!(of(&truth("product-force", "tm1.x", 1e-13, &json!({})), json!({})).is_err());
}

/// Requested effects count as true causes; an offset is part of every model.
#[test]
fn requested_effects_count_and_offsets_do_not() {
    let mut content = sealed(&[]);
    content["given"] = json!(["thermal:tm1.x=2e-12,lag_s=300", "com-offset:sc.x=0.01"]);
    let all = truths(&content).unwrap();
    assert_eq!(all.len(), 1);
    assert_eq!((all[0].name().as_str(), all[0].size, all[0].hidden), ("thermal:tm1.x", 2e-12, false));
    assert_eq!(all[0].shape["lag_s"], 300.0);
}

#[test]
fn inputs_of_another_form_are_refused() {
    let missing = score(&sealed(&[]), &json!({"candidates": []}), &installed).unwrap_err();
    assert!(missing.contains("verdict"), "{missing}");
    assert!(score(&sealed(&[]), &json!({"verdict": "missing"}), &installed).unwrap_err().contains("candidates"));
    assert!(score(&json!({}), &diagnosis("missing", &[]), &installed).unwrap_err().contains("sealed"));
}
