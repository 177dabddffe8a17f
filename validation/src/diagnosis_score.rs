//! A diagnosis against what was hidden: by the score of `dragfree reveal`, or by names for the foreign producer.

use dragfree_tests::foreign;
use serde_json::Value;

use crate::records::{Acted, Answer};

/// Impulses closer than this are the same, s; the search keeps one peak within this distance.
const MAX_TIME_ERROR_S: f64 = 120.0;
/// Thermometers that drive the foreign producer's thermal force: the warmer side, and the other one.
const THERMOMETERS: [&str; 2] = ["hk.housing_a_left_k", "hk.housing_a_right_k"];
/// Kinds of the bundled simulator that no bundled effect covers.
const UNKNOWN: [&str; 2] = ["current-force", "product-force"];

/// What is true of a foreign set.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Truth<'a> {
    /// Hidden effects.
    pub(crate) acted: &'a [foreign::Acted],
    /// Names of noise levels that are off; naming one is not false, whether it was hidden or not.
    pub(crate) levels: &'a [String],
    /// Time of the first sample, ns.
    pub(crate) start_ns: u64,
}

fn list(value: &Value) -> &[Value] {
    value.as_array().map_or(&[], Vec::as_slice)
}

fn texts(value: &Value) -> Vec<String> {
    list(value).iter().filter_map(Value::as_str).map(str::to_owned).collect()
}

/// `EFFECT:INSTANCE` of a candidate or limit.
pub(crate) fn name_of(candidate: &Value) -> String {
    let text = |key: &str| candidate[key].as_str().unwrap_or("?");
    format!("{}:{}", text("effect"), text("instance"))
}

fn accepted(diagnosis: &Value) -> impl Iterator<Item = &Value> {
    list(&diagnosis["candidates"]).iter().filter(|c| c["accepted"] == true)
}

/// Effects among the confounders of a candidate; coefficients of the model are no rival causes.
fn rivals(candidate: &Value) -> Vec<String> {
    texts(&candidate["confounders"]).into_iter().filter(|name| name.contains(':')).collect()
}

/// Members of the smallest set of an accepted candidate and its confounders that contains `name`.
fn smallest_set(diagnosis: &Value, name: &str) -> Option<usize> {
    let sets = accepted(diagnosis).map(|c| [vec![name_of(c)], rivals(c)].concat());
    sets.filter(|set| set.iter().any(|member| member == name)).map(|set| set.len()).min()
}

fn answer(diagnosis: &Value, false_causes: Vec<String>) -> Answer {
    Answer {
        verdict: diagnosis["verdict"].as_str().unwrap_or("?").to_owned(),
        named: accepted(diagnosis).map(name_of).collect(),
        false_causes,
        unexplained: diagnosis["unexplained"].clone(),
    }
}

/// Scores a set of the bundled simulator: `score` is what `dragfree reveal` makes of the diagnosis.
pub(crate) fn by_reveal(score: &Value, diagnosis: &Value) -> (Answer, Vec<Acted>) {
    let effect = |e: &Value| {
        let name = name_of(e);
        Acted {
            size: e["size"].as_f64().unwrap_or(0.0),
            unit: e["unit"].as_str().unwrap_or("?").to_owned(),
            known: !UNKNOWN.iter().any(|kind| e["effect"] == *kind),
            drawn_significance: e["expected_significance"].as_f64().unwrap_or(0.0),
            significance_at_hand: e["significance_at_hand"].as_f64(),
            named: e["accepted"] == true,
            first: e["accepted"] == true && e["first"] == true,
            confounder_of: texts(&e["confounder_of"]),
            // A set holds an impulse by its time too, which `reveal` has compared.
            set_size: (e["accepted"] == true || !list(&e["confounder_of"]).is_empty())
                .then(|| smallest_set(diagnosis, &name))
                .flatten(),
            difference_sigma: match e["accepted"] == true {
                true => list(&e["values"]).iter().filter_map(|v| v["difference_sigma"].as_f64()).collect(),
                false => Vec::new(),
            },
            name,
        }
    };
    (answer(diagnosis, texts(&score["false_causes"])), list(&score["effects"]).iter().map(effect).collect())
}

/// Scores a set by the names of what was hidden; nothing hidden is an empty list.
pub(crate) fn by_names(truth: &Truth<'_>, diagnosis: &Value) -> (Answer, Vec<Acted>) {
    let mut effects: Vec<Acted> = truth.acted.iter().map(|acted| scored(acted, truth.start_ns, diagnosis)).collect();
    let is_true = |c: &Value| {
        let name = name_of(c);
        truth.levels.contains(&name) || truth.acted.iter().any(|acted| matches(c, acted, truth.start_ns))
    };
    // Levels that are off, and another truth, may come before it.
    let first_true = accepted(diagnosis).take_while(|c| is_true(c)).map(name_of).collect::<Vec<_>>();
    for effect in &mut effects {
        effect.first = effect.named && first_true.contains(&effect.name);
    }
    let is_confounder = |c: &Value| effects.iter().any(|e| !e.named && e.confounder_of.contains(&name_of(c)));
    let false_causes = accepted(diagnosis).filter(|c| !is_true(c) && !is_confounder(c)).map(name_of).collect();
    (answer(diagnosis, false_causes), effects)
}

/// Hidden effects of a set that the program could not diagnose.
pub(crate) fn undiagnosed(acted: &[foreign::Acted]) -> Vec<Acted> {
    acted.iter().map(|acted| scored(acted, 0, &Value::Null)).collect()
}

/// Whether a candidate is an effect: by name and, for an impulse, time.
fn matches(candidate: &Value, acted: &foreign::Acted, start_ns: u64) -> bool {
    let in_time = |at_s: f64| {
        let found_ns = candidate["shape"]["at_ns"].as_i64();
        found_ns.is_some_and(|at| ((at - start_ns as i64) as f64 * 1e-9 - at_s).abs() < MAX_TIME_ERROR_S)
    };
    name_of(candidate) == acted.name() && acted.at_s.is_none_or(in_time)
}

/// True value of the coefficient in the form that was found; `None` if the form is another.
fn truth_in_form(acted: &foreign::Acted, form: &Value) -> Option<f64> {
    if acted.effect != "thermal" {
        return Some(acted.size);
    }
    match [&form["plus"], &form["minus"]].map(|name| name.as_str().unwrap_or_default()) {
        pair if pair == THERMOMETERS => Some(acted.size),
        [minus, plus] if [plus, minus] == THERMOMETERS => Some(-acted.size),
        _ => None,
    }
}

/// Amplitude of a line and its σ: its phase is free, and its two coefficients are as well known.
fn amplitude(candidate: &Value) -> Option<(f64, f64)> {
    let parts = list(&candidate["coefficients"]);
    let sum = |key: &str| parts.iter().map(|part| Some(part[key].as_f64()?.powi(2))).sum::<Option<f64>>();
    Some((sum("value")?.sqrt(), (sum("sigma")? / parts.len() as f64).sqrt()))
}

fn scored(acted: &foreign::Acted, start_ns: u64, diagnosis: &Value) -> Acted {
    let name = acted.name();
    let part = if acted.effect == "impulse" && acted.instance.starts_with("sc") { ".momentum" } else { "" };
    let coefficient = format!("{}.{}{part}", acted.effect, acted.instance);
    let origin = if acted.effect.ends_with("-noise") { 1.0 } else { 0.0 };
    let candidates = list(&diagnosis["candidates"]);
    let own = candidates.iter().position(|c| matches(c, acted, start_ns));
    let candidate = own.map(|at| &candidates[at]);
    let named = candidate.is_some_and(|c| c["accepted"] == true);
    let estimate = candidate.and_then(|c| {
        let truth = truth_in_form(acted, &c["shape"])?;
        if acted.effect == "line" {
            return amplitude(c).map(|(value, sigma)| (truth.abs(), value, sigma));
        }
        let found = list(&c["coefficients"]).iter().find(|one| one["name"] == coefficient.as_str())?;
        Some((truth, found["value"].as_f64()?, found["sigma"].as_f64()?))
    });
    let limit = list(&diagnosis["upper_limits"]).iter().find_map(|l| {
        let of_it = l["coefficient"] == coefficient.as_str() && acted.at_s.is_none();
        of_it.then_some(())?;
        Some((truth_in_form(acted, &l["shape"])?, l["sigma"].as_f64()?))
    });
    let at_hand = estimate.map(|(truth, _, sigma)| (truth, sigma)).or(limit);
    let lists = |c: &&Value| !matches(c, acted, start_ns) && rivals(c).contains(&name);
    let confounder_of: Vec<String> = accepted(diagnosis).filter(lists).map(name_of).collect();
    Acted {
        size: acted.size,
        unit: acted.unit.to_owned(),
        known: acted.known,
        drawn_significance: acted.significance(),
        significance_at_hand: at_hand
            .map(|(truth, sigma)| (truth - origin).abs() / sigma)
            .filter(|significance| significance.is_finite()),
        named,
        first: named && own == Some(0),
        set_size: (named || !confounder_of.is_empty()).then(|| smallest_set(diagnosis, &name)).flatten(),
        confounder_of,
        difference_sigma: estimate
            .filter(|_| named)
            .map(|(truth, value, sigma)| (value - truth) / sigma)
            .into_iter()
            .collect(),
        name,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn hidden(effect: &'static str, instance: &str, size: f64) -> foreign::Acted {
        let at_s = (effect == "impulse").then_some(1000.0);
        let known = effect != "current-squared";
        foreign::Acted {
            effect,
            instance: instance.to_owned(),
            size,
            unit: "1",
            sigma: 0.01,
            at_s,
            frequency_hz: None,
            known,
        }
    }

    fn candidate(name: &str, accepted: bool, value: f64, confounders: &[&str]) -> Value {
        let (effect, instance) = name.split_once(':').unwrap();
        let coefficient = json!({ "name": format!("{effect}.{instance}"), "value": value, "sigma": 0.01 });
        json!({ "effect": effect, "instance": instance, "accepted": accepted, "confounders": confounders,
            "shape": {}, "coefficients": [coefficient] })
    }

    fn diagnosis(verdict: &str, candidates: &[Value]) -> Value {
        json!({ "verdict": verdict, "candidates": candidates, "upper_limits": [], "unexplained": null })
    }

    fn by(acted: &[foreign::Acted], levels: &[&str], d: &Value) -> (Answer, Vec<Acted>) {
        let levels: Vec<String> = levels.iter().map(|l| (*l).to_owned()).collect();
        by_names(&Truth { acted, levels: &levels, start_ns: 5_000_000_000 }, d)
    }

    #[test]
    fn the_truth_first_has_a_size_and_a_significance() {
        let found = [candidate("mps-gain:sc.y", true, 0.11, &["com-offset.tm1.x"])];
        let (answer, effects) = by(&[hidden("mps-gain", "sc.y", 0.1)], &[], &diagnosis("missing", &found));
        let e = &effects[0];
        assert!(answer.false_causes.is_empty() && e.first && e.named);
        assert!((e.difference_sigma[0] - 1.0).abs() < 1e-9 && (e.significance_at_hand.unwrap() - 10.0).abs() < 1e-9);
        assert_eq!(e.set_size, Some(1), "a coefficient of the model is no rival");
    }

    #[test]
    fn a_confounder_is_neither_named_nor_false() {
        let rivals = ["is-scale:tm1.y", "es-gain:tm2.y"];
        let found = [candidate("es-gain:tm1.y", true, 0.12, &rivals)];
        let (answer, effects) = by(&[hidden("is-scale", "tm1.y", 0.1)], &[], &diagnosis("missing", &found));
        assert!(answer.false_causes.is_empty() && !effects[0].named && effects[0].difference_sigma.is_empty());
        assert_eq!((effects[0].confounder_of.len(), effects[0].set_size), (1, Some(3)));
        // Beside the truth, it is false.
        let both = [candidate("is-scale:tm1.y", true, 0.1, &[]), found[0].clone()];
        let (answer, effects) = by(&[hidden("is-scale", "tm1.y", 0.1)], &[], &diagnosis("missing", &both));
        assert_eq!((answer.false_causes, effects[0].set_size), (vec!["es-gain:tm1.y".to_owned()], Some(1)));
    }

    #[test]
    fn a_level_that_is_off_may_be_named_and_come_first() {
        let found = [candidate("mps-noise:sc.x", true, 1.25, &[])];
        let d = diagnosis("missing", &found);
        assert_eq!(by(&[], &[], &d).0.false_causes, ["mps-noise:sc.x"]);
        assert!(by(&[], &["mps-noise:sc.x"], &d).0.false_causes.is_empty());
        let both = [found[0].clone(), candidate("mps-gain:sc.y", true, 0.11, &[])];
        let d = diagnosis("missing", &both);
        assert!(by(&[hidden("mps-gain", "sc.y", 0.1)], &["mps-noise:sc.x"], &d).1[0].first);
        assert!(!by(&[hidden("mps-gain", "sc.y", 0.1)], &[], &d).1[0].first);
    }

    #[test]
    fn an_impulse_is_known_by_its_time() {
        let mut late = candidate("impulse:sc.x", true, 0.1, &[]);
        late["coefficients"][0]["name"] = "impulse.sc.x.momentum".into();
        for (at_s, named) in [(1030.0, true), (1500.0, false)] {
            late["shape"] = json!({ "at_ns": 5_000_000_000_i64 + (at_s * 1e9) as i64 });
            let d = diagnosis("missing", std::slice::from_ref(&late));
            let (answer, effects) = by(&[hidden("impulse", "sc.x", 0.1)], &[], &d);
            assert_eq!((effects[0].named, answer.false_causes.is_empty()), (named, named));
            assert_eq!(effects[0].significance_at_hand.is_some(), named);
        }
    }

    /// A thermal force of exchanged thermometers has the other sign; of others it has no size.
    #[test]
    fn a_thermal_force_is_compared_with_its_thermometers() {
        for (pair, value, difference) in [
            (["hk.housing_a_left_k", "hk.housing_a_right_k"], 0.11, vec![1.0]),
            (["hk.housing_a_right_k", "hk.housing_a_left_k"], -0.11, vec![-1.0]),
            (["hk.battery_case_k", "hk.housing_a_left_k"], 0.1, vec![]),
        ] {
            let mut found = candidate("thermal:tm1.x", true, value, &[]);
            found["shape"] = json!({ "plus": pair[0], "minus": pair[1] });
            let (_, effects) = by(&[hidden("thermal", "tm1.x", 0.1)], &[], &diagnosis("missing", &[found]));
            let found: Vec<f64> = effects[0].difference_sigma.iter().map(|d| (d * 1e6).round() / 1e6).collect();
            assert_eq!(found, difference);
        }
    }

    #[test]
    fn a_limit_gives_the_significance_of_what_is_missed() {
        let mut d = diagnosis("sufficient", &[]);
        d["upper_limits"] = json!([{ "effect": "mps-noise", "instance": "sc.x", "coefficient": "mps-noise.sc.x",
            "sigma": 0.1, "shape": {} }]);
        let (_, effects) = by(&[hidden("mps-noise", "sc.x", 1.5), hidden("current-squared", "sc.x", 0.1)], &[], &d);
        assert!((effects[0].significance_at_hand.unwrap() - 5.0).abs() < 1e-9 && effects[0].set_size.is_none());
        assert!(effects[1].significance_at_hand.is_none() && (effects[1].drawn_significance - 10.0).abs() < 1e-9);
    }

    #[test]
    fn the_score_of_reveal_is_taken_over() {
        let effect = json!({ "effect": "es-gain", "instance": "tm2.y", "size": 0.2, "unit": "1",
            "expected_significance": 9.0, "significance_at_hand": 8.0, "accepted": true, "first": true,
            "confounder_of": [], "values": [{ "difference_sigma": 0.5 }] });
        let unknown = json!({ "effect": "current-force", "instance": "tm1.x", "size": 1e-14, "unit": "m s-2 A-2",
            "expected_significance": 7.0, "accepted": false, "first": false, "confounder_of": [], "values": [] });
        let score = json!({ "effects": [effect, unknown], "false_causes": ["slosh:sc.x"] });
        let found =
            [candidate("es-gain:tm2.y", true, 0.2, &["is-scale:tm2.y"]), candidate("slosh:sc.x", true, 0.1, &[])];
        let (answer, effects) = by_reveal(&score, &diagnosis("missing", &found));
        assert_eq!((answer.named.len(), answer.false_causes), (2, vec!["slosh:sc.x".to_owned()]));
        assert_eq!((effects[0].set_size, effects[0].first, effects[0].known), (Some(2), true, true));
        assert_eq!((effects[0].difference_sigma.as_slice(), effects[1].known), (&[0.5][..], false));
    }
}
