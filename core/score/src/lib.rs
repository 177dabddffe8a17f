//! Scores a diagnosis against the sealed truth of a simulation.
//!
//! Simulator and models use equal names of effects and instances but share no code. The drawn size usually equals the
//! value of a coefficient; [`expected`] gives the values otherwise, or the reason why none follows.

use serde::Serialize;
use serde_json::{Map, Value};
use std::collections::BTreeMap;

/// Highest rank at which the true housekeeping channel counts as found, for causes that no effect covers.
const MAX_DRIVER_RANK: usize = 3;

/// Impulses of one instance whose times are closer than this are the same, s; the search keeps one peak within this
/// distance.
const MAX_TIME_ERROR_S: f64 = 120.0;

/// Name of an effect as in messages and confounders, `es-gain:tm1.y`.
fn name(effect: &str, instance: &str) -> String {
    format!("{effect}:{instance}")
}

/// A true cause.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Truth {
    /// Effect of the simulator.
    pub effect: String,
    /// Instance.
    pub instance: String,
    /// Size, in `unit`.
    pub size: f64,
    /// SI unit of the size; empty if the sealed file does not state it.
    pub unit: String,
    /// Shape parameters of the simulator.
    pub shape: Map<String, Value>,
    /// Whether it was hidden rather than requested with `--effect`.
    pub hidden: bool,
    /// Expected |size|/σ, relative to the value without effect; `None` for a requested effect.
    pub expected_significance: Option<f64>,
    /// Expected σ of the size; `None` for a requested effect.
    pub expected_sigma: Option<f64>,
}

impl Truth {
    fn name(&self) -> String {
        name(&self.effect, &self.instance)
    }

    fn number(&self, parameter: &str) -> f64 {
        self.shape.get(parameter).and_then(Value::as_f64).unwrap_or(0.0)
    }
}

/// Outcome for a true cause.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Outcome {
    /// Accepted, with the right effect and instance.
    Accepted,
    /// Not accepted, but listed as a confounder of an accepted candidate.
    Confounded,
    /// No installed effect covers it, and the diagnosis reports an unexplained residual.
    Unexplained,
    /// None of these.
    Missed,
}

/// Overall result of a diagnosis.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Verdict {
    /// All true causes are accepted, and no other.
    Right,
    /// All true causes are accepted or confounders of accepted candidates, and no other is accepted.
    Confounded,
    /// A false cause is accepted and a true one is not found.
    Wrong,
    /// A true cause is not found; no false cause is accepted.
    Missed,
    /// All true causes are found and a false cause is accepted beside them; or nothing acts, and something is accepted
    /// or reported as unexplained.
    #[serde(rename = "false alarm")]
    FalseAlarm,
    /// No false cause is accepted, and the diagnosis rightly reports an unexplained residual.
    Unexplained,
}

/// A coefficient compared with its true value.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Compared {
    /// Name.
    pub coefficient: String,
    /// SI unit of all three numbers.
    pub unit: String,
    /// True value.
    pub truth: f64,
    /// Estimate.
    pub value: f64,
    /// Its σ.
    pub sigma: f64,
    /// `(value − truth)/σ`.
    pub difference_sigma: f64,
}

/// An upper limit compared with the true value.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Limited {
    /// Name.
    pub coefficient: String,
    /// SI unit.
    pub unit: String,
    /// True value, if one follows from the sealed truth.
    pub truth: Option<f64>,
    /// 95 % upper limit on the size.
    pub limit_95: f64,
    /// σ by the data.
    pub sigma: Option<f64>,
}

/// A true cause with its result in the diagnosis.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Scored {
    /// The truth.
    #[serde(flatten)]
    pub truth: Truth,
    /// Whether the effect and instance were among the candidates.
    pub covered: bool,
    /// Reason if not, if the diagnosis or the installation states one.
    pub not_covered_because: Option<String>,
    /// Outcome.
    pub outcome: Outcome,
    /// Rank among the candidates, from 1.
    pub rank: Option<usize>,
    /// Whether it is the first candidate.
    pub first: bool,
    /// Whether it is accepted.
    pub accepted: bool,
    /// Accepted candidates that list it as a confounder.
    pub confounder_of: Vec<String>,
    /// Confounders of its own candidate.
    pub confounders: Vec<String>,
    /// Coefficients for which a true value follows.
    pub values: Vec<Compared>,
    /// Reason if there are none.
    pub not_compared_because: Option<String>,
    /// |value|/σ of the candidate's leading coefficient; noise levels count from 1.
    pub significance: Option<f64>,
    /// Significance |truth|/σ with the σ of the diagnosis, found or not. It is below the expected one if these data say
    /// little, e.g. for a charge that drifts steadily.
    pub significance_at_hand: Option<f64>,
    /// Decrease of χ² by the candidate.
    pub delta_chi2: Option<f64>,
    /// Significance after correction for multiple tests.
    pub p_value: Option<f64>,
    /// Whether the value lies in its physical range.
    pub in_range: Option<bool>,
    /// True shape parameters of the model's effect.
    pub expected_shape: Map<String, Value>,
    /// Shape of the candidate.
    pub found_shape: Map<String, Value>,
    /// Found minus true time of an impulse, s.
    pub time_error_s: Option<f64>,
    /// Upper limits of an undetected effect.
    pub limits: Vec<Limited>,
    /// True housekeeping drivers of a cause that no effect covers.
    pub drivers: Vec<String>,
    /// Rank of the first reported coherence with exactly these drivers, from 1.
    pub driver_rank: Option<usize>,
}

/// Score of a diagnosis.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Score {
    /// Overall result.
    pub verdict: Verdict,
    /// Whether the result is correct: `right`, or `unexplained` for a cause that no installed effect covers, with its
    /// driver (if any) among the first three.
    pub correct: bool,
    /// Verdict of the diagnosis: `sufficient`, `missing`, `unexplained`.
    pub diagnosis_verdict: String,
    /// Number of forms tried.
    pub tried: u64,
    /// The first candidate, accepted or not.
    pub first: Option<String>,
    /// Accepted candidates, in the order of the diagnosis.
    pub accepted: Vec<String>,
    /// Accepted candidates that are neither true nor confounders of an undetected true cause.
    pub false_causes: Vec<String>,
    /// All true causes.
    pub effects: Vec<Scored>,
    /// Housekeeping coherent with the unexplained residual, in the order of the diagnosis; `None` if nothing is
    /// unexplained.
    pub coherent_with: Option<Vec<String>>,
}

/// True value of a coefficient; its name is `EFFECT.INSTANCE` followed by `part`.
#[derive(Clone, Debug, PartialEq)]
pub struct Expected {
    /// Rest of the name with its point; empty for the only coefficient.
    pub part: &'static str,
    /// Unit.
    pub unit: &'static str,
    /// Value.
    pub value: f64,
}

/// Test mass and axis of `tm1.x` or `tm1`.
fn parts(instance: &str) -> (&str, &str) {
    instance.split_once('.').unwrap_or((instance, ""))
}

/// The digits at the end of a test mass's name, which the bundled missions have.
fn digits(mass: &str) -> &str {
    mass.trim_start_matches(|c: char| !c.is_ascii_digit())
}

/// Number of a test mass in the order of their names, from 1, as the simulator numbers them.
fn number_of(mass: &str, sealed: &Value) -> String {
    let names = sealed["test_masses"].as_array();
    let at = names.and_then(|names| names.iter().position(|name| name == mass));
    at.map_or_else(|| digits(mass).to_owned(), |at| (at + 1).to_string())
}

/// True value of a coefficient `com-offset.NAME.AXIS`, m, in the first message of the truth of a simulation, by field
/// path.
pub fn offset(truth: &BTreeMap<String, f64>, coefficient: &str) -> Option<f64> {
    let (mass, axis) = parts(coefficient.strip_prefix("com-offset.")?);
    truth.get(&format!("b{}_orf_m.{axis}", digits(mass))).copied()
}

/// True values of the coefficients of a model's effect, for the shape that was found. `sealed` is the whole sealed
/// content.
///
/// # Errors
/// No value follows; the message says why.
pub fn expected(truth: &Truth, shape: &Map<String, Value>, sealed: &Value) -> Result<Vec<Expected>, String> {
    let part = |part, unit, value| Expected { part, unit, value };
    let only = |unit, value| Ok(vec![part("", unit, value)]);
    let column = |key: &str| shape.get(key).and_then(Value::as_str).unwrap_or_default();
    let (mass, axis) = parts(&truth.instance);
    let number = number_of(mass, sealed);
    if truth.number("per_day") != 0.0 || truth.number("from_s") != 0.0 {
        return Err("a size that changes with time has no one value".to_owned());
    }
    match truth.effect.as_str() {
        "es-gain" | "es-crosstalk" | "mps-gain" | "torque-gain" | "is-scale" | "is-crosstalk" => only("1", truth.size),
        "mps-tilt" => only("rad", truth.size),
        "time-offset" => only("s", truth.size),
        "stiffness" => only("s-2", truth.size),
        "opening-angle" if ["rate_rad_s", "follow"].iter().all(|moves| truth.number(moves) == 0.0) => {
            only("rad", truth.size)
        }
        "opening-angle" => Err("an angle that changes has no one value".to_owned()),
        "cross-stiffness" => only("m s-2 rad-1", truth.size),
        // The level is a factor of the amplitude, as is the size.
        "mps-noise" | "torque-noise" | "is-noise" if truth.number("line_hz") > 0.0 => {
            Err("a spectral line is not a noise level".to_owned())
        }
        "mps-noise" | "torque-noise" | "is-noise" => only("1", truth.size),
        "tilt-to-length" => {
            let psi = truth.number("psi_m_rad");
            Ok(vec![part(".theta", "m rad-1", truth.size), part(".psi", "m rad-1", psi)])
        }
        "solar-pressure" => {
            let arm = |name, key| part(name, "m", truth.number(key));
            let force = part(".force", "1", truth.size);
            Ok(vec![force, arm(".arm_x", "arm_x_m"), arm(".arm_y", "arm_y_m"), arm(".arm_z", "arm_z_m")])
        }
        "offset-drift" => {
            let followed = [
                ("time", "m s-1", truth.size),
                ("hk.structure_temperature_k", "m K-1", truth.number("kappa_m_k")),
                ("hk.tank_mass_kg", "m kg-1", truth.number("beta_m_kg")),
            ];
            let mut parts = followed.into_iter().filter(|(.., value)| *value != 0.0);
            let found = parts.clone().find(|(with, ..)| *with == column("with"));
            let all = parts.by_ref().map(|(with, ..)| with).collect::<Vec<_>>().join(" and ");
            let (_, unit, value) =
                found.ok_or_else(|| format!("the candidate follows {}, the truth {all}", column("with")))?;
            only(unit, value)
        }
        // The model's coefficient is the slug's mass relative to the rest.
        "slosh" => only("1", truth.size / (1.0 - truth.size)),
        "thermal" => {
            let face = |side| format!("hk.eh{number}_{axis}{side}_temperature_k");
            let (plus, minus) = (column("plus"), column("minus"));
            if (plus, minus) == (&face("p"), &face("m")) {
                only("m s-2 K-1", truth.size)
            } else if (plus, minus) == (&face("m"), &face("p")) {
                only("m s-2 K-1", -truth.size)
            } else {
                Err(format!("the candidate follows {plus} − {minus}, the truth the faces of its own housing"))
            }
        }
        "charge" => match column("charge") {
            charge if charge == format!("hk.{mass}_charge_c") => only("V", truth.size),
            other => Err(format!("the candidate follows {other}, the truth its own test mass's charge")),
        },
        "magnetic" if truth.size != 0.0 => {
            Err("the susceptibility follows from the coefficients only with the gradient tensor".to_owned())
        }
        "magnetic" => {
            // Force m ∂B_x/∂x; the gradiometer measures ∂B_x/∂x.
            let mass_kg = number.parse().ok().and_then(|n: usize| sealed["test_mass_kg"][n.checked_sub(1)?].as_f64());
            let mass_kg = mass_kg.ok_or("the sealed file does not state the mass of the test mass")?;
            match column("gradient") {
                gradient if gradient == format!("hk.magnetic_gradient{number}_t_m") => {
                    Ok(vec![part(".gradient_x", "m2 s-2 T-1", truth.number("moment_a_m2") / mass_kg)])
                }
                other => Err(format!("the candidate follows {other}, the truth its own test mass's gradient")),
            }
        }
        "impulse" if mass != "sc" => only("N s", truth.size),
        "impulse" if ["x", "y", "z"].contains(&axis) => {
            let arm = ["arm_x_m", "arm_y_m", "arm_z_m"].map(|name| truth.number(name));
            let along = ["x", "y", "z"].map(|letter| if letter == axis { truth.size } else { 0.0 });
            let turned = |i: usize, j: usize| arm[i] * along[j] - arm[j] * along[i];
            Ok(vec![
                part(".momentum", "N s", truth.size),
                part(".angular_x", "N m s", turned(1, 2)),
                part(".angular_y", "N m s", turned(2, 0)),
                part(".angular_z", "N m s", turned(0, 1)),
            ])
        }
        // Pulses at the steps of another flag have another size.
        "impulse" if shape.get("flag").is_some_and(|flag| flag != ANTENNA_FLAG) => {
            Err(format!("the candidate acts at the steps of another flag than {ANTENNA_FLAG}"))
        }
        "impulse" => only("N m s", truth.size),
        "mps-correlation" => Err("the coefficients describe the thrusters' positions, the size their noise".to_owned()),
        _ => Err("no bundled effect has a coefficient for it".to_owned()),
    }
}

/// Flag of the simulator's antenna, whose moves turn the spacecraft.
const ANTENNA_FLAG: &str = "hk.antenna_move_flag";

/// True numerical shape parameters of the model's effect.
fn expected_shape(truth: &Truth) -> Map<String, Value> {
    let given = |names: &[&str], factor: f64| {
        let known = names.iter().filter(|name| truth.shape.contains_key(**name));
        known.map(|name| ((*name).to_owned(), Value::from(truth.number(name) * factor))).collect()
    };
    match truth.effect.as_str() {
        "thermal" => given(&["lag_s"], 1.0),
        // The model's resonance is that with the spacecraft free.
        "slosh" => given(&["f0_hz", "zeta"], (1.0 - truth.size).sqrt().recip()),
        "impulse" if parts(&truth.instance).0 != "sc" => given(&["rise_s", "decay_s"], 1.0),
        "impulse" if ["sc.phi", "sc.theta", "sc.psi"].contains(&truth.instance.as_str()) => given(&["pulse_s"], 1.0),
        _ => Map::new(),
    }
}

/// Housekeeping whose square or product drives a cause that no bundled effect covers, by its telemetry name.
fn drivers(effect: &str) -> &'static [&'static str] {
    match effect {
        "current-force" => &["battery_current_a"],
        "product-force" => &["battery_current_a", "structure_temperature_k"],
        _ => &[],
    }
}

/// Channels of a term such as `d/dt hk.a`, `hk.a^2` or `hk.a * hk.b`, sorted.
fn channels_of(witness: &str) -> Vec<&str> {
    fn bare(part: &str) -> &str {
        let part = part.strip_prefix("d/dt ").unwrap_or(part);
        let part = part.strip_prefix("hk.").or_else(|| part.strip_prefix("hk/")).unwrap_or(part);
        part.strip_suffix("^2").unwrap_or(part)
    }
    let mut names: Vec<&str> = witness.split(" * ").map(bare).collect();
    names.sort_unstable();
    names
}

/// All true causes: drawn, and requested with `--effect`. An offset is part of every model and is omitted.
///
/// # Errors
/// The sealed content has another form.
pub fn truths(sealed: &Value) -> Result<Vec<Truth>, String> {
    let drawn = sealed["effects"].as_array().ok_or("it has no list of effects")?;
    let mut all = Vec::new();
    for one in drawn {
        let text = |key: &str| one[key].as_str().map(str::to_owned).ok_or_else(|| format!("an effect has no {key}"));
        all.push(Truth {
            effect: text("effect")?,
            instance: text("instance")?,
            size: one["size"].as_f64().ok_or("an effect has no size")?,
            unit: text("unit")?,
            shape: one["shape"].as_object().cloned().unwrap_or_default(),
            hidden: true,
            expected_significance: one["significance"].as_f64(),
            expected_sigma: one["sigma_expected"].as_f64(),
        });
    }
    for given in sealed["given"].as_array().into_iter().flatten().filter_map(Value::as_str) {
        all.push(parse_given(given).ok_or_else(|| format!("{given} is not an effect"))?);
    }
    all.retain(|truth| truth.effect != "com-offset");
    Ok(all)
}

/// Parses `ID:INSTANCE=SIZE[,NAME=VALUE]...`
fn parse_given(text: &str) -> Option<Truth> {
    let mut parts = text.split(',').map(|part| part.split_once('='));
    let number = |value: &str| value.trim().parse::<f64>().ok();
    let (who, size) = parts.next()??;
    let (effect, instance) = who.trim().split_once(':')?;
    let mut shape = Map::new();
    for part in parts {
        let (key, value) = part?;
        shape.insert(key.trim().to_owned(), number(value)?.into());
    }
    Some(Truth {
        effect: effect.to_owned(),
        instance: instance.to_owned(),
        size: number(size)?,
        unit: String::new(),
        shape,
        hidden: false,
        expected_significance: None,
        expected_sigma: None,
    })
}

/// Scores the output of `dragfree diagnose --json` against the sealed content. `installed(effect, instance)` says
/// whether such an effect exists.
///
/// # Errors
/// An input has another form.
pub fn score(sealed: &Value, diagnosis: &Value, installed: &dyn Fn(&str, &str) -> bool) -> Result<Score, String> {
    let truths = truths(sealed).map_err(|e| format!("the sealed content: {e}"))?;
    let diagnosis_verdict = diagnosis["verdict"].as_str().ok_or("the diagnosis has no `verdict`")?;
    let candidates = diagnosis["candidates"].as_array().ok_or("the diagnosis has no `candidates`")?;
    let scorer = Scorer { sealed, diagnosis, candidates, installed };
    let effects: Vec<Scored> = truths.into_iter().map(|truth| scorer.scored(truth)).collect();

    let accepted: Vec<&Value> = candidates.iter().filter(|c| c["accepted"] == true).collect();
    // A confounder of an undetected true cause is not a false cause.
    let is_confounder = |c: &&Value| {
        let confounded = effects.iter().filter(|e| !e.accepted);
        confounded.into_iter().any(|e| e.confounder_of.contains(&name_of(c)))
    };
    let acted = |c: &&Value| effects.iter().any(|e| scorer.matches(c, &e.truth));
    let false_causes: Vec<String> =
        accepted.iter().filter(|c| !acted(c) && !is_confounder(c)).map(|c| name_of(c)).collect();

    let verdict = verdict(&effects, !false_causes.is_empty(), diagnosis_verdict);
    let driver_found = |e: &Scored| e.drivers.is_empty() || e.driver_rank.is_some_and(|rank| rank <= MAX_DRIVER_RANK);
    let found = |e: &Scored| e.outcome == Outcome::Accepted || (e.outcome == Outcome::Unexplained && driver_found(e));
    let correct = match verdict {
        Verdict::Right => true,
        Verdict::Unexplained => effects.iter().all(found),
        _ => false,
    };
    Ok(Score {
        verdict,
        correct,
        diagnosis_verdict: diagnosis_verdict.to_owned(),
        tried: diagnosis["tried"].as_u64().unwrap_or(0),
        first: candidates.first().map(name_of),
        accepted: accepted.into_iter().map(name_of).collect(),
        false_causes,
        effects,
        coherent_with: diagnosis["unexplained"]["coherent_with"].as_array().map(|all| strings(all)),
    })
}

fn verdict(effects: &[Scored], any_false: bool, diagnosis_verdict: &str) -> Verdict {
    let any = |outcome| effects.iter().any(|e| e.outcome == outcome);
    let missed = any(Outcome::Missed);
    if any_false {
        return if missed || any(Outcome::Unexplained) { Verdict::Wrong } else { Verdict::FalseAlarm };
    }
    match diagnosis_verdict {
        "unexplained" if effects.is_empty() => Verdict::FalseAlarm,
        "unexplained" => Verdict::Unexplained,
        _ if missed => Verdict::Missed,
        _ if any(Outcome::Unexplained) => Verdict::Unexplained,
        _ if any(Outcome::Confounded) => Verdict::Confounded,
        _ => Verdict::Right,
    }
}

fn strings(all: &[Value]) -> Vec<String> {
    all.iter().filter_map(Value::as_str).map(str::to_owned).collect()
}

fn name_of(candidate: &Value) -> String {
    name(candidate["effect"].as_str().unwrap_or_default(), candidate["instance"].as_str().unwrap_or_default())
}

/// Whether an instance is at the place of a truth: `tm1.z-2` is a second transient at `tm1.z`.
fn is_at(instance: &str, truth: &Truth) -> bool {
    let is_number = |text: &str| text.parse::<usize>().is_ok_and(|number| number > 1);
    let numbered = |rest: &str| rest.strip_prefix('-').is_some_and(is_number);
    instance.strip_prefix(&truth.instance).is_some_and(|rest| rest.is_empty() || numbered(rest))
}

/// Whether a name, `EFFECT:INSTANCE`, is that of a truth.
fn is_name_of(name: &str, truth: &Truth) -> bool {
    name.split_once(':').is_some_and(|(effect, instance)| effect == truth.effect && is_at(instance, truth))
}

/// A diagnosis and the truth to compare it with.
struct Scorer<'a> {
    sealed: &'a Value,
    diagnosis: &'a Value,
    candidates: &'a [Value],
    installed: &'a dyn Fn(&str, &str) -> bool,
}

impl Scorer<'_> {
    /// Estimated minus true time of an impulse, s; `None` for other effects and for repeated events. The time is the
    /// mean of its profile where the candidate has one: data know the begin of a slow one no better than its rise.
    fn time_error_s(&self, candidate: &Value, truth: &Truth) -> Option<f64> {
        let at_s = truth.shape.get("at_s").and_then(Value::as_f64)?;
        // An antenna moves repeatedly.
        if truth.effect != "impulse" || ["sc.phi", "sc.theta", "sc.psi"].contains(&truth.instance.as_str()) {
            return None;
        }
        let shape = &candidate["shape"];
        let since_ns = shape["at_ns"].as_i64()? - self.sealed["start_ns"].as_i64()?;
        // Of a difference of exponentials.
        let later = |key: &str| Some(shape[key].as_f64()? - truth.shape.get(key)?.as_f64()?);
        let longer_s: f64 = ["rise_s", "decay_s"].into_iter().filter_map(later).sum();
        Some(since_ns as f64 * 1e-9 - at_s + longer_s)
    }

    /// Whether a candidate matches a truth: effect, instance and, for a transient, time.
    fn matches(&self, candidate: &Value, truth: &Truth) -> bool {
        candidate["effect"] == truth.effect.as_str()
            && is_at(candidate["instance"].as_str().unwrap_or_default(), truth)
            && self.time_error_s(candidate, truth).is_none_or(|error| error.abs() < MAX_TIME_ERROR_S)
    }

    /// Ok if the effect was a candidate, otherwise the reason.
    fn covered(&self, truth: &Truth) -> Result<(), String> {
        if !(self.installed)(&truth.effect, &truth.instance) {
            return Err("no installed effect has this instance".to_owned());
        }
        let untried = self.diagnosis["not_tried"].as_array().into_iter().flatten();
        let reason = untried.filter(|pair| pair[0] == truth.name().as_str()).find_map(|pair| pair[1].as_str());
        reason.map_or(Ok(()), |reason| Err(reason.to_owned()))
    }

    fn scored(&self, truth: Truth) -> Scored {
        let own = self.candidates.iter().position(|c| self.matches(c, &truth));
        let candidate = own.map(|at| &self.candidates[at]);
        let accepted = candidate.is_some_and(|c| c["accepted"] == true);
        let lists = |c: &&Value| {
            let named = c["confounders"].as_array().into_iter().flatten();
            c["accepted"] == true
                && !self.matches(c, &truth)
                && named.into_iter().filter_map(Value::as_str).any(|n| is_name_of(n, &truth))
        };
        let confounder_of: Vec<String> = self.candidates.iter().filter(lists).map(name_of).collect();
        let covered = self.covered(&truth);
        let unexplained = &self.diagnosis["unexplained"];
        let outcome = if accepted {
            Outcome::Accepted
        } else if !confounder_of.is_empty() {
            Outcome::Confounded
        } else if covered.is_err() && unexplained.is_object() {
            Outcome::Unexplained
        } else {
            Outcome::Missed
        };

        let (mut values, mut not_compared_because, mut significance) = (Vec::new(), None, None);
        let origin = if truth.effect.ends_with("-noise") { 1.0 } else { 0.0 };
        if let Some(c) = candidate {
            match self.compared(c, &truth) {
                Ok(compared) => values = compared,
                Err(why) => not_compared_because = Some(why),
            }
            let number = |key: &str| c[key].as_f64();
            significance = number("value").zip(number("sigma")).map(|(value, sigma)| (value - origin).abs() / sigma);
        }
        let limits = self.limits(&truth);
        let found = values.iter().map(|c| (c.truth, c.sigma));
        let limited = limits.iter().filter_map(|l| Some((l.truth?, l.sigma?)));
        let significances = found.chain(limited).map(|(truth, sigma)| (truth - origin).abs() / sigma);
        let significance_at_hand = significances.max_by(f64::total_cmp);
        let drivers: Vec<String> = drivers(&truth.effect).iter().map(|d| (*d).to_owned()).collect();
        let witnesses = unexplained["coherent_with"].as_array().map(|all| strings(all)).unwrap_or_default();
        let driver_rank =
            witnesses.iter().position(|w| !drivers.is_empty() && channels_of(w) == drivers).map(|at| at + 1);
        let field = |key: &str| candidate.map_or(&Value::Null, |c| &c[key]);
        Scored {
            covered: covered.is_ok(),
            not_covered_because: covered.err(),
            outcome,
            rank: own.map(|at| at + 1),
            first: own == Some(0),
            accepted,
            confounder_of,
            confounders: field("confounders").as_array().map(|all| strings(all)).unwrap_or_default(),
            values,
            not_compared_because,
            significance,
            significance_at_hand,
            delta_chi2: field("delta_chi2").as_f64(),
            p_value: field("p_value").as_f64(),
            in_range: field("in_range").as_bool(),
            expected_shape: expected_shape(&truth),
            found_shape: field("shape").as_object().cloned().unwrap_or_default(),
            time_error_s: candidate.and_then(|c| self.time_error_s(c, &truth)),
            limits,
            drivers,
            driver_rank,
            truth,
        }
    }

    /// Coefficients of a candidate compared with their true values.
    fn compared(&self, candidate: &Value, truth: &Truth) -> Result<Vec<Compared>, String> {
        let empty = Map::new();
        let expected = expected(truth, candidate["shape"].as_object().unwrap_or(&empty), self.sealed)?;
        let coefficients = candidate["coefficients"].as_array().ok_or("the candidate lists no coefficients")?;
        let stem = format!("{}.{}", truth.effect, candidate["instance"].as_str().unwrap_or_default());
        let both = coefficients.iter().filter_map(|c| {
            let part = c["name"].as_str()?.strip_prefix(&stem)?;
            let expected = expected.iter().find(|e| e.part == part && c["unit"] == e.unit)?;
            let (value, sigma) = (c["value"].as_f64()?, c["sigma"].as_f64()?);
            // An antenna returns the angular momentum when it stops, so either sign is right.
            let turns = truth.effect == "impulse" && truth.instance.starts_with("sc.") && part.is_empty();
            let truth = if turns { expected.value.abs().copysign(value) } else { expected.value };
            Some(Compared {
                coefficient: format!("{stem}{part}"),
                unit: expected.unit.to_owned(),
                truth,
                value,
                sigma,
                difference_sigma: (value - truth) / sigma,
            })
        });
        match both.collect::<Vec<_>>() {
            none if none.is_empty() => Err("the candidate has none of the coefficients with a true value".to_owned()),
            some => Ok(some),
        }
    }

    fn limits(&self, truth: &Truth) -> Vec<Limited> {
        let empty = Map::new();
        let all = self.diagnosis["upper_limits"].as_array().into_iter().flatten();
        let own = all.filter(|l| name_of(l) == truth.name());
        own.filter_map(|l| {
            let (coefficient, unit) = (l["coefficient"].as_str()?, l["unit"].as_str()?);
            let part = coefficient.strip_prefix(&format!("{}.{}", truth.effect, truth.instance))?;
            let expected = expected(truth, l["shape"].as_object().unwrap_or(&empty), self.sealed).ok();
            let value = expected.into_iter().flatten().find(|e| e.part == part && e.unit == unit).map(|e| e.value);
            Some(Limited {
                coefficient: coefficient.to_owned(),
                unit: unit.to_owned(),
                truth: value,
                limit_95: l["limit_95"].as_f64()?,
                sigma: l["sigma"].as_f64(),
            })
        })
        .collect()
    }
}

#[cfg(test)]
mod tests;
