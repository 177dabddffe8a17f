//! Effects that `--hidden SEED` adds: drawn from the seed alone, with sizes of 3σ to 30σ for the simulated time.

use dragfree_physics::mission::Mission;
use rand::RngExt;
use rand_xoshiro::Xoshiro256PlusPlus;
use serde_json::{Value, json};

use crate::effects::{Basis, EffectRequest, Place};
use crate::random::stream;

/// Smallest and largest expected significance of an effect.
const SIGNIFICANCE: (f64, f64) = (3.0, 30.0);
/// Probabilities of no effect, of a pair, and of an effect that no bundled one models; otherwise there is one effect.
const NOTHING: f64 = 0.1;
const PAIR: f64 = 0.15;
const UNCOVERED: f64 = 0.1;

/// An effect in the table, with the range of its size.
struct Row {
    id: &'static str,
    /// Whether a bundled effect models it.
    covered: bool,
    /// Shape parameter that takes the drawn amount in place of SIZE, which is then 0.
    carrier: Option<&'static str>,
    /// Physical range of the amount.
    range: (f64, f64),
    /// SIZE without an effect: 1 for a factor of noise.
    origin: f64,
    /// Whether the amount may be negative.
    signed: bool,
    /// Exponent of the decrease of σ with time, below six hours and beyond a day.
    power: f64,
    /// Minimum duration of a simulation, days.
    least_days: f64,
    /// Shape parameter, drawn between the first and the last of these values, and the values at which σ is tabulated.
    shape: Option<(&'static str, &'static [f64])>,
    /// Instances, with `{N}` for the name of test mass N.
    places: &'static [&'static str],
    /// σ of the size after six hours and after a day: for each place, for each value of the shape parameter.
    sigma: &'static [f64],
}

const SC_AXES: &[&str] = &["sc.x", "sc.y", "sc.z"];
const TEST_MASSES: &[&str] = &["{0}", "{1}"];
const TM_YZ: &[&str] = &["{0}.y", "{0}.z", "{1}.y", "{1}.z"];
const TM_AXES: &[&str] = &["{0}.x", "{0}.y", "{0}.z", "{1}.x", "{1}.y", "{1}.z"];

/// A kind of either sign that a bundled effect covers, without a shape parameter; σ falls as the root of the time.
const fn row(id: &'static str, range: (f64, f64), places: &'static [&'static str], sigma: &'static [f64]) -> Row {
    Row {
        id,
        covered: true,
        carrier: None,
        range,
        origin: 0.0,
        signed: true,
        power: 0.5,
        least_days: 0.0,
        shape: None,
        places,
        sigma,
    }
}

// σ is printed by the example `expected_sigma` for the bundled mission, with offsets, a constant and a slope fitted.
// Effects are missing whose range never reaches three σ: stiffness, cross-stiffness, solar-pressure, an offset that
// follows the propellant, and capacitive readout into x, which no residual uses. mps-correlation has no size whose
// significance could be stated.
const ROWS: &[Row] = &[
    Row {
        power: 1.5,
        ..row("offset-drift", (2.3e-10, 5.8e-8), SC_AXES, &[1.78e-7, 2.21e-8, 1.48e-7, 1.84e-8, 8.73e-8, 1.09e-8])
    },
    Row {
        carrier: Some("kappa_m_k"),
        ..row("offset-drift", (1.0e-6, 2.0e-5), SC_AXES, &[1.04e-4, 1.45e-5, 1.25e-4, 1.76e-5, 1.64e-4, 2.45e-5])
    },
    row("opening-angle", (1.0e-3, 1.5e-2), TEST_MASSES, &[3.83e-3, 1.92e-3, 3.83e-3, 1.92e-3]),
    row("es-gain", (5.0e-3, 2.0e-1), TM_YZ, &[1.09e-2, 5.75e-3, 2.61e-2, 1.31e-2, 1.15e-2, 5.87e-3, 2.61e-2, 1.31e-2]),
    row(
        "es-crosstalk",
        (3.0e-3, 5.0e-2),
        &["{0}.y-x", "{0}.y-z", "{0}.z-x", "{0}.z-y", "{1}.y-x", "{1}.y-z", "{1}.z-x", "{1}.z-y"],
        &[
            2.05e-3, 1.03e-3, 1.36e-2, 7.13e-3, 2.41e-3, 1.21e-3, 2.18e-2, 1.10e-2, 2.08e-3, 1.04e-3, 1.42e-2, 7.27e-3,
            2.42e-3, 1.21e-3, 2.18e-2, 1.10e-2,
        ],
    ),
    row("mps-gain", (1.0e-2, 1.0e-1), SC_AXES, &[9.48e-3, 4.78e-3, 7.54e-3, 3.78e-3, 1.71e-2, 8.48e-3]),
    row("mps-tilt", (5.0e-3, 6.0e-2), SC_AXES, &[3.52e-3, 1.77e-3, 3.09e-3, 1.56e-3, 5.52e-3, 2.76e-3]),
    row("torque-gain", (1.0e-2, 5.0e-2), SC_AXES, &[1.01e-2, 5.07e-3, 1.01e-2, 5.04e-3, 1.08e-2, 5.35e-3]),
    Row {
        origin: 1.0,
        signed: false,
        ..row("mps-noise", (3.0e-1, 2.0), SC_AXES, &[3.35e-3, 1.67e-3, 4.81e-3, 2.41e-3, 1.95e-2, 9.77e-3])
    },
    Row {
        origin: 1.0,
        signed: false,
        ..row("torque-noise", (3.0e-1, 2.0), SC_AXES, &[1.32e-2, 6.61e-3, 1.32e-2, 6.61e-3, 1.40e-2, 6.99e-3])
    },
    Row {
        origin: 1.0,
        signed: false,
        ..row(
            "is-noise",
            (3.0e-1, 2.0),
            TM_YZ,
            &[1.52e-3, 7.61e-4, 1.53e-3, 7.63e-4, 1.52e-3, 7.61e-4, 1.53e-3, 7.63e-4],
        )
    },
    row("is-scale", (3.0e-3, 1.0e-1), TM_YZ, &[1.07e-2, 5.37e-3, 1.34e-2, 6.87e-3, 1.06e-2, 5.50e-3, 1.35e-2, 6.86e-3]),
    row(
        "is-crosstalk",
        (3.0e-3, 1.0e-1),
        &["{0}.x-y", "{0}.x-z", "{0}.y-z", "{0}.z-y", "{1}.x-y", "{1}.x-z", "{1}.y-z", "{1}.z-y"],
        &[
            5.93e-2, 3.09e-2, 6.99e-2, 3.61e-2, 1.34e-2, 6.74e-3, 1.06e-2, 5.42e-3, 4.04e-2, 3.08e-2, 5.17e-2, 3.61e-2,
            1.34e-2, 6.89e-3, 1.05e-2, 5.39e-3,
        ],
    ),
    row("tilt-to-length", (1.0e-4, 3.0e-3), TEST_MASSES, &[7.79e-4, 3.87e-4, 8.05e-4, 4.02e-4]),
    Row {
        signed: false,
        ..row(
            "time-offset",
            (1.0e-3, 1.0e-1),
            &["is", "ifo", "dws"],
            &[2.20e-2, 1.16e-2, 5.13e-4, 2.57e-4, 5.87e-3, 2.91e-3],
        )
    },
    Row {
        shape: Some(("lag_s", &[60.0, 480.0, 3000.0])),
        ..row(
            "thermal",
            (0.0, 5.0e-11),
            TM_AXES,
            &[
                5.59e-12, 7.23e-13, 4.25e-12, 8.58e-13, 7.39e-12, 1.83e-12, 8.65e-12, 1.53e-12, 7.06e-12, 1.78e-12,
                1.41e-11, 3.02e-12, 8.73e-12, 2.37e-12, 6.99e-12, 2.67e-12, 5.92e-12, 3.31e-12, 4.97e-12, 9.05e-13,
                4.11e-12, 1.06e-12, 6.42e-12, 2.03e-12, 9.25e-12, 1.28e-12, 7.97e-12, 1.55e-12, 1.83e-11, 3.55e-12,
                9.05e-12, 3.02e-12, 8.52e-12, 3.44e-12, 8.89e-12, 5.73e-12,
            ],
        )
    },
    row("magnetic", (0.0, 1.0e-4), TEST_MASSES, &[3.11e-4, 2.29e-5, 3.23e-4, 2.42e-5]),
    Row {
        carrier: Some("moment_a_m2"),
        ..row("magnetic", (0.0, 2.0e-8), TEST_MASSES, &[6.29e-8, 2.04e-9, 6.98e-8, 2.28e-9])
    },
    row("charge", (0.0, 1.0e-1), TEST_MASSES, &[4.12e-3, 2.40e-3, 7.42e-3, 2.23e-3]),
    Row {
        signed: false,
        shape: Some(("f0_hz", &[0.005, 0.012, 0.03, 0.08, 0.2])),
        ..row(
            "slosh",
            (1.0e-3, 5.0e-2),
            &["sc.x", "sc.y"],
            &[
                4.07e-3, 2.04e-3, 4.06e-3, 2.04e-3, 3.90e-3, 1.96e-3, 2.29e-3, 1.16e-3, 1.16e-3, 5.85e-4, 4.61e-3,
                2.30e-3, 4.59e-3, 2.29e-3, 4.32e-3, 2.16e-3, 2.38e-3, 1.15e-3, 7.53e-4, 3.76e-4,
            ],
        )
    },
    Row {
        power: 0.0,
        ..row("impulse", (0.0, 2.0e-4), SC_AXES, &[4.43e-8, 4.43e-8, 5.49e-8, 5.49e-8, 1.72e-7, 1.72e-7])
    },
    Row {
        least_days: 0.25,
        ..row(
            "impulse",
            (0.0, 1.0e-4),
            &["sc.phi", "sc.theta", "sc.psi"],
            &[1.29e-7, 7.12e-8, 1.29e-7, 7.12e-8, 1.30e-7, 7.20e-8],
        )
    },
    Row {
        power: 0.0,
        ..row(
            "impulse",
            (0.0, 2.0e-9),
            TM_AXES,
            &[
                1.63e-12, 1.64e-12, 1.91e-12, 1.91e-12, 2.62e-12, 2.62e-12, 1.63e-12, 1.64e-12, 1.91e-12, 1.91e-12,
                2.62e-12, 2.62e-12,
            ],
        )
    },
    Row {
        covered: false,
        ..row(
            "current-force",
            (0.0, 1.0e-12),
            TM_AXES,
            &[
                1.64e-14, 6.05e-16, 1.99e-14, 6.94e-16, 2.74e-14, 9.46e-16, 1.64e-14, 6.05e-16, 1.99e-14, 6.94e-16,
                2.74e-14, 9.46e-16,
            ],
        )
    },
    Row {
        covered: false,
        ..row(
            "product-force",
            (0.0, 1.0e-12),
            TM_AXES,
            &[
                2.75e-13, 6.86e-15, 3.31e-13, 7.87e-15, 4.55e-13, 1.07e-14, 2.75e-13, 6.86e-15, 3.31e-13, 7.87e-15,
                4.55e-13, 1.07e-14,
            ],
        )
    },
];

/// A drawn effect.
#[derive(Clone, Debug)]
pub struct Drawn {
    /// The effect.
    pub request: EffectRequest,
    covered: bool,
    /// Drawn amount in the unit of `sigma`; zero is no effect.
    pub amount: f64,
    /// Expected standard deviation of the amount.
    pub sigma: f64,
}

/// All effects that a seed hides.
#[derive(Clone, Debug)]
pub struct Hidden {
    seed: u64,
    /// The effects; possibly none.
    pub drawn: Vec<Drawn>,
    salt: String,
}

impl Hidden {
    /// Draws by `seed` for a simulation of `days` of a mission, among what can act there. Sizes and significance are
    /// those of the bundled mission's noise.
    ///
    /// # Panics
    /// Never: every row of the table names an effect, its instances and its parameters, as a test sees to.
    pub fn draw(seed: u64, days: f64, mission: &Mission) -> Self {
        let mut rng = stream(seed, "hidden");
        let luck: f64 = rng.random();
        let mut drawn: Vec<Drawn> = Vec::new();
        if luck >= NOTHING {
            let uncovered = luck >= 1.0 - UNCOVERED;
            let pair = luck < NOTHING + PAIR;
            drawn.extend(draw_one(&mut rng, days, mission, |row| row.covered != uncovered));
            if let (true, Some(first)) = (pair, drawn.first().map(|d| d.request.kind.id)) {
                drawn.extend(draw_one(&mut rng, days, mission, |row| row.covered && row.id != first));
            }
        }
        let salt = (0..4).map(|_| format!("{:016x}", rng.random::<u64>())).collect();
        Self { seed, drawn, salt }
    }

    /// Content of the sealed document, with the caller's members.
    pub fn content(&self, more: &Value) -> Value {
        let effects: Vec<Value> = self.drawn.iter().map(Drawn::content).collect();
        let mut content = json!({
            "format": "dragfree-hidden/1",
            "hidden_seed": self.seed,
            "effects": effects,
            "salt": self.salt,
        });
        if let (Value::Object(content), Value::Object(more)) = (&mut content, more) {
            content.extend(more.clone());
        }
        content
    }
}

impl Drawn {
    fn content(&self) -> Value {
        let request = &self.request;
        let shape: serde_json::Map<String, Value> =
            request.kind.shape.iter().zip(&request.shape).map(|(s, v)| (s.name.to_owned(), json!(v))).collect();
        json!({
            "effect": request.kind.id,
            "instance": request.instance,
            "size": request.size,
            "unit": if turns(request.place) { "N m s" } else { request.kind.size.unit },
            "shape": shape,
            "covered": self.covered,
            "significance": self.amount.abs() / self.sigma,
            "sigma_expected": self.sigma,
        })
    }
}

/// Whether the size of an impulse is that of a moment of momentum.
fn turns(place: Place) -> bool {
    matches!(place, Place::ScAngle(_))
}

impl Row {
    /// Places with their σ at each value of the shape parameter.
    fn sigmas(&self) -> impl Iterator<Item = (&'static str, &'static [[f64; 2]])> {
        let (pairs, _) = self.sigma.as_chunks::<2>();
        self.places.iter().copied().zip(pairs.chunks_exact(self.shape.map_or(1, |(_, grid)| grid.len())))
    }

    /// σ after `days` at one value of the shape parameter.
    fn after(&self, [six_hours, day]: [f64; 2], days: f64) -> f64 {
        let known = days.clamp(0.25, 1.0);
        let between = six_hours * (day / six_hours).powf((4.0 * known).ln() / 4.0f64.ln());
        between * (known / days).powf(self.power)
    }

    /// σ after `days` at any value of the shape parameter, by log-log interpolation.
    fn sigma_at(&self, sigma: &[[f64; 2]], value: f64, days: f64) -> f64 {
        let Some((_, grid)) = self.shape else { return self.after(sigma[0], days) };
        let i = grid.partition_point(|x| *x <= value).clamp(1, grid.len() - 1);
        let part = (value / grid[i - 1]).ln() / (grid[i] / grid[i - 1]).ln();
        let [below, above] = [i - 1, i].map(|i| self.after(sigma[i], days));
        below * (above / below).powf(part)
    }
}

/// Amounts in the physical range with a significance in [`SIGNIFICANCE`]; if even the smallest physical amount exceeds
/// it, up to three times that. `None` if the largest physical amount is not significant.
fn interval(row: &Row, sigma: f64) -> Option<(f64, f64)> {
    let (seen, glaring) = (SIGNIFICANCE.0 * sigma, SIGNIFICANCE.1 * sigma);
    let (least, most) = row.range;
    if seen > most {
        None
    } else if glaring < least {
        Some((least, most.min(3.0 * least)))
    } else {
        Some((seen.max(least), glaring.min(most)))
    }
}

fn log_uniform(rng: &mut Xoshiro256PlusPlus, (least, most): (f64, f64)) -> f64 {
    least * (most / least).powf(rng.random())
}

fn pick<'a, T>(rng: &mut Xoshiro256PlusPlus, from: &'a [T]) -> Option<&'a T> {
    // random() is below 1, so the index is below the length.
    from.get((rng.random::<f64>() * from.len() as f64) as usize)
}

/// An instance of the table on a spacecraft with these test masses; `None` where it has no such test mass.
fn instance(place: &str, test_masses: &[String]) -> Option<String> {
    let Some((number, rest)) = place.strip_prefix('{').and_then(|place| place.split_once('}')) else {
        return Some(place.to_owned());
    };
    let name = test_masses.get(number.parse::<usize>().ok()?)?;
    Some(format!("{name}{rest}"))
}

/// Whether an effect of the table can act in an instance of it.
fn acts(row: &Row, place: &str, mission: &Mission, test_masses: &[String]) -> bool {
    let parse = |place| EffectRequest::parse(&format!("{}:{place}={}", row.id, row.origin), test_masses).ok();
    let request = instance(place, test_masses).and_then(parse);
    request.is_some_and(|request| request.cause(&Basis { mission }).is_ok())
}

fn draw_one(
    rng: &mut Xoshiro256PlusPlus,
    days: f64,
    mission: &Mission,
    wanted: impl Fn(&Row) -> bool,
) -> Option<Drawn> {
    let test_masses: &[String] = &mission.test_mass.keys().cloned().collect::<Vec<_>>();
    // An instance at which the effect is significant at every value of the shape parameter.
    let seen = |row: &Row, (place, sigma): &(&str, &[[f64; 2]])| {
        acts(row, place, mission, test_masses) && sigma.iter().all(|s| interval(row, row.after(*s, days)).is_some())
    };
    let places = |row: &Row| row.sigmas().filter(|place| seen(row, place)).collect::<Vec<_>>();
    let rows: Vec<&Row> =
        ROWS.iter().filter(|row| wanted(row) && days >= row.least_days && !places(row).is_empty()).collect();
    let row = *pick(rng, &rows)?;
    let places = places(row);
    let (place, sigmas) = pick(rng, &places)?;
    let shape = row.shape.map(|(name, grid)| (name, log_uniform(rng, (grid[0], grid[grid.len() - 1]))));
    let sigma = row.sigma_at(sigmas, shape.map_or(1.0, |(_, value)| value), days);
    let amount = log_uniform(rng, interval(row, sigma)?) * if row.signed && rng.random() { -1.0 } else { 1.0 };

    let size = if row.carrier.is_some() { 0.0 } else { row.origin + amount };
    let mut text = format!("{}:{}={size:e}", row.id, instance(place, test_masses)?);
    for (name, value) in shape.into_iter().chain(row.carrier.map(|name| (name, amount))) {
        text += &format!(",{name}={value:e}");
    }
    if row.id == "impulse" {
        text += &format!(",at_s={:.1}", 86_400.0 * days * (0.1 + 0.8 * rng.random::<f64>()));
    }
    let request = EffectRequest::parse(&text, test_masses)
        .unwrap_or_else(|error| unreachable!("the table of hidden effects: {error}"));
    Some(Drawn { request, covered: row.covered, amount, sigma })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::taiji;
    use std::collections::BTreeMap;

    fn both() -> Vec<String> {
        ["tm1", "tm2"].map(str::to_owned).to_vec()
    }

    /// With one test mass nothing of a second one is drawn, and its own name is used. Where it is free along every axis
    /// no electrode acts, and thrusters with noise of their own have no other.
    #[test]
    fn only_what_can_act_is_drawn() {
        let mission = |file: &str| {
            let value: Value = toml::from_str(file).unwrap();
            Mission::from_json(&value.to_string()).unwrap()
        };
        let single = include_str!("../../fixtures/missions/single.toml").replace("test_mass.tm1", "test_mass.cube");
        let one = mission(&single);
        let drawn: Vec<Drawn> = (0..500).flat_map(|seed| Hidden::draw(seed, 3.0, &one).drawn).collect();
        let named = |prefix: &str| drawn.iter().filter(|d| d.request.instance.starts_with(prefix)).count();
        assert!(named("cube") > 50 && named("sc.") > 50 && named("tm") == 0 && named("{") == 0);
        let with = |drawn: &[Drawn], prefix: &str| drawn.iter().any(|d| d.request.kind.id.starts_with(prefix));
        assert!(!with(&drawn, "es-"));
        let units = mission(include_str!("../../fixtures/missions/taiji-thrusters.toml"));
        let drawn: Vec<Drawn> = (0..500).flat_map(|seed| Hidden::draw(seed, 3.0, &units).drawn).collect();
        assert!(with(&drawn, "es-") && !with(&drawn, "mps-noise") && !with(&drawn, "torque-noise"));
    }

    /// Three thousand seeds: the chances within 4.5σ of a binomial (false alarm 7e-6 each), sizes physical,
    /// significances where they should be, every row drawn.
    #[test]
    fn draws_keep_their_chances_and_ranges() {
        let n = 3000;
        // Three days: offset-drift is not seen in one.
        let (mut nothing, mut pairs, mut uncovered, mut seen) = (0.0, 0.0, 0.0, BTreeMap::new());
        let mission = taiji();
        for seed in 0..n {
            let hidden = Hidden::draw(seed, 3.0, &mission);
            nothing += f64::from(hidden.drawn.is_empty());
            pairs += f64::from(hidden.drawn.len() == 2);
            uncovered += f64::from(hidden.drawn.iter().any(|d| !d.covered));
            for d in &hidden.drawn {
                let significance = d.amount.abs() / d.sigma;
                assert!(significance >= SIGNIFICANCE.0 * 0.999_999, "{}: {significance}", d.request);
                let loud = ROWS.iter().any(|r| r.id == d.request.kind.id && r.range.0 > 0.0);
                assert!(significance <= SIGNIFICANCE.1 * 1.000_001 || loud, "{}: {significance}", d.request);
                let rows = ROWS.iter().filter(|r| r.id == d.request.kind.id);
                let physical =
                    rows.map(|r| r.range).any(|(a, b)| (a * 0.999_999..=b * 1.000_001).contains(&d.amount.abs()));
                assert!(physical, "{}", d.request);
                *seen.entry(d.request.kind.id).or_insert(0) += 1;
            }
            if let [a, b] = &hidden.drawn[..] {
                assert_ne!(a.request.kind.id, b.request.kind.id);
            }
        }
        for (count, chance) in [(nothing, NOTHING), (pairs, PAIR), (uncovered, UNCOVERED)] {
            let z = (count - n as f64 * chance) / (n as f64 * chance * (1.0 - chance)).sqrt();
            assert!(z.abs() < 4.5, "{count} of {n}, chance {chance}");
        }
        for row in ROWS {
            assert!(seen.contains_key(row.id), "{} is never drawn: {seen:?}", row.id);
        }
    }

    #[test]
    fn a_seed_draws_the_same_and_another_draws_another() {
        let mission = taiji();
        let text = |seed: u64| Hidden::draw(seed, 2.0, &mission).content(&json!({"noise_seed": 5})).to_string();
        assert_eq!(text(4), text(4));
        assert_ne!(text(4), text(5));
        let salts: std::collections::BTreeSet<String> =
            (0..100).map(|seed| Hidden::draw(seed, 1.0, &mission).salt).collect();
        assert!(salts.len() == 100 && salts.iter().all(|salt| salt.len() == 64));
        // More days show smaller effects: the same seed aims at the same significance.
        let one = (0..100).map(|seed| (Hidden::draw(seed, 1.0, &mission), Hidden::draw(seed, 1.2, &mission)));
        let shrunk = one.filter(|(a, b)| a.drawn.first().is_some_and(|a| a.sigma > b.drawn[0].sigma)).count();
        assert!(shrunk > 50, "{shrunk}");
    }

    /// Every row of the table names what there is.
    #[test]
    fn the_table_names_effects_that_exist() {
        for row in ROWS {
            let grid = row.shape.map_or(1, |(_, grid)| grid.len());
            assert_eq!(row.sigma.len(), 2 * grid * row.places.len(), "{}", row.id);
            for (place, sigma) in row.sigmas() {
                let place = instance(place, &both()).unwrap();
                EffectRequest::parse(&format!("{}:{place}={}", row.id, row.origin), &both()).unwrap();
                // More time tells at least as much, to the three digits that are printed.
                assert!(sigma.iter().all(|[six, day]| 0.0 < *day && *day <= 1.01 * six && six.is_finite()));
            }
            for name in row.carrier.into_iter().chain(row.shape.map(|(name, _)| name)) {
                let place = instance(row.places[0], &both()).unwrap();
                EffectRequest::parse(&format!("{}:{place}={},{name}=1e-12", row.id, row.origin), &both())
                    .map_or_else(|e| assert!(!e.to_string().contains("no parameter"), "{e}"), drop);
            }
        }
    }
}
