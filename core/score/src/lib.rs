//! How a diagnosis did against the truth that a simulation sealed.
//!
//! Simulator and models name effects and places alike, and share no code. A size that was drawn is mostly a coefficient's value;
//! where it is not, [`expected`] says which values follow from it, or why none does.

use serde::Serialize;
use serde_json::{Map, Value};

/// The true cause of what no effect covers must be among so many drivers.
const DRIVERS: usize = 3;

/// Two impulses of one place nearer than this are one: as near as the search keeps a single peak, s.
const SAME_IMPULSE_S: f64 = 120.0;

/// What an effect is called in messages and in confounders, `es-gain:tm1.y`.
fn name(effect: &str, instance: &str) -> String {
    format!("{effect}:{instance}")
}

/// A cause that acted.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Truth {
    /// Effect of the simulator.
    pub effect: String,
    /// Where.
    pub instance: String,
    /// Size, in `unit`.
    pub size: f64,
    /// SI unit of the size; empty where the sealed file does not tell it.
    pub unit: String,
    /// Shape parameters of the simulator.
    pub shape: Map<String, Value>,
    /// Whether it was hidden; otherwise it was asked for with `--effect`.
    pub hidden: bool,
    /// Expected |size|/σ, counted from where the effect vanishes; none for what was asked for.
    pub expected_significance: Option<f64>,
    /// Expected σ of the size; none for what was asked for.
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

/// What became of a cause that acted.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Outcome {
    /// Accepted, effect and place.
    Accepted,
    /// Not accepted, but named as what the data cannot tell from an accepted one.
    Confounded,
    /// No installed effect covers it, and the diagnosis says that something is unexplained.
    Unexplained,
    /// None of these.
    Missed,
}

/// How a diagnosis did as a whole.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Verdict {
    /// Everything that acted is accepted, and nothing else.
    Right,
    /// Everything is accepted or a confounder of what is, and nothing else is accepted.
    Confounded,
    /// Something is accepted that did not act, and something that acted is not found.
    Wrong,
    /// Something that acted is not found, and nothing false is accepted.
    Missed,
    /// Everything that acted is found, possibly nothing did, and something that did not act is accepted or called unexplained.
    #[serde(rename = "false alarm")]
    FalseAlarm,
    /// The diagnosis accepts nothing false and says that something is unexplained, and so it is.
    Unexplained,
}

/// A coefficient beside the value that follows from the truth.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Compared {
    /// Name.
    pub coefficient: String,
    /// SI unit of all three numbers.
    pub unit: String,
    /// What follows from the truth.
    pub truth: f64,
    /// What was found.
    pub value: f64,
    /// σ of it.
    pub sigma: f64,
    /// `(value − truth)/σ`.
    pub difference_sigma: f64,
}

/// A limit beside the value that follows from the truth.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Limited {
    /// Name.
    pub coefficient: String,
    /// SI unit.
    pub unit: String,
    /// What follows from the truth; none where nothing does.
    pub truth: Option<f64>,
    /// 95 % upper limit on the size.
    pub limit_95: f64,
    /// σ that the data have for it.
    pub sigma: Option<f64>,
}

/// A cause that acted, beside what the diagnosis says of it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Scored {
    /// The truth.
    #[serde(flatten)]
    pub truth: Truth,
    /// Whether the diagnosis had the effect at this place to try.
    pub covered: bool,
    /// Why not, where the diagnosis or the installation says.
    pub not_covered_because: Option<String>,
    /// What became of it.
    pub outcome: Outcome,
    /// Place among the candidates, from 1; none where it is not among them.
    pub rank: Option<usize>,
    /// Whether it is the first candidate.
    pub first: bool,
    /// Whether it is accepted.
    pub accepted: bool,
    /// Accepted candidates that list it as a confounder.
    pub confounder_of: Vec<String>,
    /// What its own candidate lists as confounders.
    pub confounders: Vec<String>,
    /// Coefficients with a value that follows from the truth.
    pub values: Vec<Compared>,
    /// Why there are none.
    pub not_compared_because: Option<String>,
    /// |value|/σ of the candidate's leading coefficient, for a level of noise counted from 1.
    pub significance: Option<f64>,
    /// |truth|/σ with the σ that the diagnosis has for it, found or not; none where it has none. What was drawn for the σ that such
    /// data have as a rule may be worth less in these: a charge that drifts evenly tells little.
    pub significance_at_hand: Option<f64>,
    /// Fall of χ² by the candidate.
    pub delta_chi2: Option<f64>,
    /// Corrected chance.
    pub p_value: Option<f64>,
    /// Whether the value lies in its physical range.
    pub in_range: Option<bool>,
    /// Shape parameters of the model's effect that follow from the truth.
    pub expected_shape: Map<String, Value>,
    /// Shape in which the candidate was found.
    pub found_shape: Map<String, Value>,
    /// Found minus true time of an impulse, s.
    pub time_error_s: Option<f64>,
    /// Limits that the diagnosis gives where it does not see the effect.
    pub limits: Vec<Limited>,
    /// Housekeeping that drives it, where no effect covers it.
    pub drivers: Vec<String>,
    /// Place of the first witness made of just these drivers, from 1.
    pub driver_rank: Option<usize>,
}

/// How a diagnosis did.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Score {
    /// As a whole.
    pub verdict: Verdict,
    /// Whether that is the best there is to say: `right`, or `unexplained` for what no installed effect covers, with the true
    /// driver among the first three where housekeeping has one.
    pub correct: bool,
    /// What the diagnosis said: `sufficient`, `missing`, `unexplained`.
    pub diagnosis_verdict: String,
    /// Forms that it tried.
    pub tried: u64,
    /// The first candidate, accepted or not.
    pub first: Option<String>,
    /// What it accepted, in its order.
    pub accepted: Vec<String>,
    /// What of that neither acted nor stands for something that did.
    pub false_causes: Vec<String>,
    /// Everything that acted.
    pub effects: Vec<Scored>,
    /// Witnesses of what is unexplained, in the diagnosis's order; none where it calls nothing unexplained.
    pub coherent_with: Option<Vec<String>>,
}

/// The value of a coefficient that follows from a truth. Its name is `EFFECT.INSTANCE` and this.
#[derive(Clone, Debug, PartialEq)]
pub struct Expected {
    /// What follows in the name, with its point; empty for the only coefficient.
    pub part: &'static str,
    /// Unit.
    pub unit: &'static str,
    /// Value.
    pub value: f64,
}

/// One-based number of a test mass and letter of the axis of `tm1.x` or `tm1`.
fn test_mass(instance: &str) -> (usize, &str) {
    let (mass, axis) = instance.split_once('.').unwrap_or((instance, ""));
    (if mass == "tm2" { 2 } else { 1 }, axis)
}

/// The values of the coefficients of the effect of a model that follow from a truth, for the shape in which it was found;
/// `sealed` is all that was sealed.
///
/// # Errors
/// None follows, and why.
pub fn expected(truth: &Truth, shape: &Map<String, Value>, sealed: &Value) -> Result<Vec<Expected>, String> {
    let only = |unit, value| Ok(vec![Expected { part: "", unit, value }]);
    let column = |key: &str| shape.get(key).and_then(Value::as_str).unwrap_or_default();
    let (number, axis) = test_mass(&truth.instance);
    match truth.effect.as_str() {
        "es-gain" | "es-crosstalk" | "mps-gain" | "torque-gain" | "is-scale" | "is-crosstalk" => only("1", truth.size),
        "mps-tilt" => only("rad", truth.size),
        "time-offset" => only("s", truth.size),
        "stiffness" => only("s-2", truth.size),
        "cross-stiffness" => only("m s-2 rad-1", truth.size),
        // The level is the factor of the amplitude, as the size is.
        "mps-noise" | "torque-noise" | "is-noise" if truth.number("line_hz") > 0.0 => {
            Err("a line is no level".to_owned())
        }
        "mps-noise" | "torque-noise" | "is-noise" => only("1", truth.size),
        "tilt-to-length" => {
            let part = |part, value| Expected { part, unit: "m rad-1", value };
            Ok(vec![part(".theta", truth.size), part(".psi", truth.number("psi_m_rad"))])
        }
        "solar-pressure" => {
            let arm = |part, name| Expected { part, unit: "m", value: truth.number(name) };
            let force = Expected { part: ".force", unit: "1", value: truth.size };
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
                found.ok_or_else(|| format!("it was found to follow {}, and follows {all}", column("with")))?;
            only(unit, value)
        }
        "slosh" => {
            // The model's slug is counted against all the rest.
            only("1", truth.size / (1.0 - truth.size))
        }
        "thermal" => {
            let face = |side| format!("hk.eh{number}_{axis}{side}_temperature_k");
            let (plus, minus) = (column("plus"), column("minus"));
            if (plus, minus) == (&face("p"), &face("m")) {
                only("m s-2 K-1", truth.size)
            } else if (plus, minus) == (&face("m"), &face("p")) {
                only("m s-2 K-1", -truth.size)
            } else {
                Err(format!("it was found to follow {plus} − {minus}, and follows the faces of its own housing"))
            }
        }
        "charge" => match column("charge") {
            charge if charge == format!("hk.tm{number}_charge_c") => only("V", truth.size),
            other => Err(format!("it was found to follow {other}, and follows its own test mass's charge")),
        },
        "magnetic" if truth.size != 0.0 => {
            Err("the susceptibility follows from the coefficients only with the tensor of the gradient".to_owned())
        }
        "magnetic" => {
            // Force m ∂B_x/∂x, which is what the gradiometer shows.
            let mass_kg = sealed["test_mass_kg"][number - 1].as_f64();
            let mass_kg = mass_kg.ok_or("the sealed file does not tell the test mass's mass")?;
            match column("gradient") {
                gradient if gradient == format!("hk.magnetic_gradient{number}_t_m") => Ok(vec![Expected {
                    part: ".gradient_x",
                    unit: "m2 s-2 T-1",
                    value: truth.number("moment_a_m2") / mass_kg,
                }]),
                other => Err(format!("it was found to follow {other}, and follows its own test mass's gradient")),
            }
        }
        "impulse" if truth.instance.starts_with("tm") => only("N s", truth.size),
        "impulse" if ["x", "y", "z"].contains(&axis) => {
            let arm = ["arm_x_m", "arm_y_m", "arm_z_m"].map(|name| truth.number(name));
            let along = ["x", "y", "z"].map(|letter| if letter == axis { truth.size } else { 0.0 });
            let turned = |i: usize, j: usize| arm[i] * along[j] - arm[j] * along[i];
            let part = |part, unit, value| Expected { part, unit, value };
            Ok(vec![
                part(".momentum", "N s", truth.size),
                part(".angular_x", "N m s", turned(1, 2)),
                part(".angular_y", "N m s", turned(2, 0)),
                part(".angular_z", "N m s", turned(0, 1)),
            ])
        }
        "impulse" => only("N m s", truth.size),
        "mps-correlation" => {
            Err("the coefficients say where the thrusters sit, the size how much noise each has".to_owned())
        }
        _ => Err("no bundled effect has a coefficient for it".to_owned()),
    }
}

/// Shape parameters that follow from a truth, those of the model's effect that are numbers.
fn expected_shape(truth: &Truth) -> Map<String, Value> {
    let given = |names: &[&str], factor: f64| {
        let known = names.iter().filter(|name| truth.shape.contains_key(**name));
        known.map(|name| ((*name).to_owned(), Value::from(truth.number(name) * factor))).collect()
    };
    match truth.effect.as_str() {
        "thermal" => given(&["lag_s"], 1.0),
        // As it is seen, with the spacecraft free.
        "slosh" => given(&["f0_hz", "zeta"], (1.0 - truth.size).sqrt().recip()),
        "impulse" if truth.instance.starts_with("tm") => given(&["rise_s", "decay_s"], 1.0),
        "impulse" if ["sc.phi", "sc.theta", "sc.psi"].contains(&truth.instance.as_str()) => given(&["pulse_s"], 1.0),
        _ => Map::new(),
    }
}

/// Housekeeping whose square or product drives a cause that no bundled effect covers, as telemetry names it.
fn drivers(effect: &str) -> &'static [&'static str] {
    match effect {
        "current-force" => &["battery_current_a"],
        "product-force" => &["battery_current_a", "structure_temperature_k"],
        _ => &[],
    }
}

/// The channels in `d/dt hk.a`, `hk.a^2`, `hk.a * hk.b`, in order.
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

/// Everything that acted: what was drawn, and what was asked for with `--effect`. An offset is in every model and is left out.
///
/// # Errors
/// The sealed content is of another form.
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
        all.push(asked(given).ok_or_else(|| format!("{given} is no effect"))?);
    }
    all.retain(|truth| truth.effect != "com-offset");
    Ok(all)
}

/// `ID:INSTANCE=SIZE[,NAME=VALUE]...`
fn asked(text: &str) -> Option<Truth> {
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

/// Scores what `dragfree diagnose --json` printed against what was sealed. `installed` says whether there is an effect with an
/// instance.
///
/// # Errors
/// One of the two is of another form.
pub fn score(sealed: &Value, diagnosis: &Value, installed: &dyn Fn(&str, &str) -> bool) -> Result<Score, String> {
    let truths = truths(sealed).map_err(|e| format!("the sealed content: {e}"))?;
    let said = diagnosis["verdict"].as_str().ok_or("the diagnosis has no `verdict`")?;
    let candidates = diagnosis["candidates"].as_array().ok_or("the diagnosis has no `candidates`")?;
    let judged = Judged { sealed, diagnosis, candidates, installed };
    let effects: Vec<Scored> = truths.into_iter().map(|truth| judged.scored(truth)).collect();

    let accepted: Vec<&Value> = candidates.iter().filter(|c| c["accepted"] == true).collect();
    // One that stands for something that acted is no false cause, unless that is accepted beside it.
    let stands_for = |c: &&Value| {
        let confounded = effects.iter().filter(|e| !e.accepted);
        confounded.into_iter().any(|e| e.confounder_of.contains(&name_of(c)))
    };
    let acted = |c: &&Value| effects.iter().any(|e| judged.is(c, &e.truth));
    let false_causes: Vec<String> =
        accepted.iter().filter(|c| !acted(c) && !stands_for(c)).map(|c| name_of(c)).collect();

    let verdict = verdict(&effects, !false_causes.is_empty(), said);
    let pointed = |e: &Scored| e.drivers.is_empty() || e.driver_rank.is_some_and(|rank| rank <= DRIVERS);
    let found = |e: &Scored| e.outcome == Outcome::Accepted || (e.outcome == Outcome::Unexplained && pointed(e));
    let correct = match verdict {
        Verdict::Right => true,
        Verdict::Unexplained => effects.iter().all(found),
        _ => false,
    };
    Ok(Score {
        verdict,
        correct,
        diagnosis_verdict: said.to_owned(),
        tried: diagnosis["tried"].as_u64().unwrap_or(0),
        first: candidates.first().map(name_of),
        accepted: accepted.into_iter().map(name_of).collect(),
        false_causes,
        effects,
        coherent_with: diagnosis["unexplained"]["coherent_with"].as_array().map(|all| texts(all)),
    })
}

fn verdict(effects: &[Scored], any_false: bool, said: &str) -> Verdict {
    let any = |outcome| effects.iter().any(|e| e.outcome == outcome);
    let lost = any(Outcome::Missed);
    if any_false {
        return if lost || any(Outcome::Unexplained) { Verdict::Wrong } else { Verdict::FalseAlarm };
    }
    match said {
        "unexplained" if effects.is_empty() => Verdict::FalseAlarm,
        "unexplained" => Verdict::Unexplained,
        _ if lost => Verdict::Missed,
        _ if any(Outcome::Unexplained) => Verdict::Unexplained,
        _ if any(Outcome::Confounded) => Verdict::Confounded,
        _ => Verdict::Right,
    }
}

fn texts(all: &[Value]) -> Vec<String> {
    all.iter().filter_map(Value::as_str).map(str::to_owned).collect()
}

fn name_of(candidate: &Value) -> String {
    name(candidate["effect"].as_str().unwrap_or_default(), candidate["instance"].as_str().unwrap_or_default())
}

/// A diagnosis and what it is held against.
struct Judged<'a> {
    sealed: &'a Value,
    diagnosis: &'a Value,
    candidates: &'a [Value],
    installed: &'a dyn Fn(&str, &str) -> bool,
}

impl Judged<'_> {
    /// Found minus true time of an impulse, s; none for all else, and for what happens again and again.
    fn time_error_s(&self, candidate: &Value, truth: &Truth) -> Option<f64> {
        let at_s = truth.shape.get("at_s").and_then(Value::as_f64)?;
        // An antenna moves many times.
        if truth.effect != "impulse" || ["sc.phi", "sc.theta", "sc.psi"].contains(&truth.instance.as_str()) {
            return None;
        }
        let since_ns = candidate["shape"]["at_ns"].as_i64()? - self.sealed["start_ns"].as_i64()?;
        Some(since_ns as f64 * 1e-9 - at_s)
    }

    /// Whether a candidate is a truth: effect, place and, for what happens once, time.
    fn is(&self, candidate: &Value, truth: &Truth) -> bool {
        name_of(candidate) == truth.name()
            && self.time_error_s(candidate, truth).is_none_or(|error| error.abs() < SAME_IMPULSE_S)
    }

    /// Whether the diagnosis had the effect to try, or why not.
    fn covered(&self, truth: &Truth) -> Result<(), String> {
        if !(self.installed)(&truth.effect, &truth.instance) {
            return Err("no installed effect has this instance".to_owned());
        }
        let untried = self.diagnosis["not_tried"].as_array().into_iter().flatten();
        let reason = untried.filter(|pair| pair[0] == truth.name().as_str()).find_map(|pair| pair[1].as_str());
        reason.map_or(Ok(()), |reason| Err(reason.to_owned()))
    }

    fn scored(&self, truth: Truth) -> Scored {
        let own = self.candidates.iter().position(|c| self.is(c, &truth));
        let candidate = own.map(|at| &self.candidates[at]);
        let accepted = candidate.is_some_and(|c| c["accepted"] == true);
        let lists = |c: &&Value| {
            let named = c["confounders"].as_array().into_iter().flatten();
            c["accepted"] == true && !self.is(c, &truth) && named.into_iter().any(|n| *n == truth.name().as_str())
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
        let witnesses = unexplained["coherent_with"].as_array().map(|all| texts(all)).unwrap_or_default();
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
            confounders: field("confounders").as_array().map(|all| texts(all)).unwrap_or_default(),
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

    /// Coefficients of a candidate beside what follows from the truth.
    fn compared(&self, candidate: &Value, truth: &Truth) -> Result<Vec<Compared>, String> {
        let empty = Map::new();
        let expected = expected(truth, candidate["shape"].as_object().unwrap_or(&empty), self.sealed)?;
        let coefficients = candidate["coefficients"].as_array().ok_or("the candidate lists no coefficients")?;
        let stem = format!("{}.{}", truth.effect, truth.instance);
        let both = coefficients.iter().filter_map(|c| {
            let part = c["name"].as_str()?.strip_prefix(&stem)?;
            let expected = expected.iter().find(|e| e.part == part && c["unit"] == e.unit)?;
            let (value, sigma) = (c["value"].as_f64()?, c["sigma"].as_f64()?);
            // An antenna gives back when it stops what it took when it started, and either may have been found.
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
            none if none.is_empty() => Err("the candidate has none of the coefficients that follow".to_owned()),
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
