//! What `--hidden SEED` hides: effects drawn by the seed alone, so large that the days at hand show them at 3σ to 30σ.

use rand::RngExt;
use rand_xoshiro::Xoshiro256PlusPlus;
use serde_json::{Value, json};

use crate::effects::{Asked, stream};

/// Expected significance of what is drawn.
const SIGNIFICANCE: (f64, f64) = (3.0, 30.0);
/// Chances of nothing, of a pair and of a kind that no bundled effect covers; the rest is one effect alone.
const NOTHING: f64 = 0.1;
const PAIR: f64 = 0.15;
const UNCOVERED: f64 = 0.1;

/// A kind of effect as it is drawn.
struct Row {
    id: &'static str,
    /// Whether a bundled effect covers it.
    covered: bool,
    /// The shape parameter that carries the drawn size in place of SIZE, which is then 0.
    carrier: Option<&'static str>,
    /// Smallest and largest size with physical sense (design: the effects' table, and the parameters' sources).
    range: (f64, f64),
    /// Sizes count from here: 1 for a factor of noise.
    origin: f64,
    /// Either sign is drawn.
    signed: bool,
    /// σ falls with the days to this power.
    power: f64,
    /// Shorter simulations may not see it at all.
    least_days: f64,
    /// A shape parameter that is drawn between the first and the last of these values, where σ is known.
    shape: Option<(&'static str, &'static [f64])>,
    /// σ of the size after one day by instance, at each value of the shape parameter.
    sigma: &'static [(&'static str, &'static [f64])],
}

const PLAIN: Row = Row {
    id: "",
    covered: true,
    carrier: None,
    range: (0.0, f64::INFINITY),
    origin: 0.0,
    signed: true,
    power: 0.5,
    least_days: 0.0,
    shape: None,
    sigma: &[],
};

// σ: printed by the example `one_day_sigma` for the bundled mission, after the offsets, a constant and a slope are fitted.
// Not here, as three σ lie beyond their range whatever the days: stiffness and cross-stiffness, solar-pressure (a constant
// but for the Sun's slow motion), an offset that follows the propellant, capacitive readout into x, which no residual uses.
// Nor mps-correlation: at no size is the noise the mission's own, and its correlation has no size, so no significance.
const ROWS: &[Row] = &[
    Row {
        id: "offset-drift",
        range: (2.3e-10, 5.8e-8),
        power: 1.5,
        sigma: &[("sc.x", &[4.02e-8]), ("sc.y", &[3.31e-8]), ("sc.z", &[2.39e-8])],
        ..PLAIN
    },
    Row {
        id: "offset-drift",
        carrier: Some("kappa_m_k"),
        range: (1.0e-6, 2.0e-5),
        sigma: &[("sc.x", &[1.45e-5]), ("sc.y", &[1.77e-5]), ("sc.z", &[2.45e-5])],
        ..PLAIN
    },
    Row { id: "opening-angle", range: (1.0e-3, 1.5e-2), sigma: &[("tm1", &[1.98e-3]), ("tm2", &[1.98e-3])], ..PLAIN },
    Row {
        id: "es-gain",
        range: (5.0e-3, 2.0e-1),
        sigma: &[("tm1.y", &[6.57e-3]), ("tm1.z", &[1.23e-2]), ("tm2.y", &[6.69e-3]), ("tm2.z", &[1.23e-2])],
        ..PLAIN
    },
    Row {
        id: "es-crosstalk",
        range: (3.0e-3, 5.0e-2),
        sigma: &[
            ("tm1.y-x", &[4.41e-4]),
            ("tm1.y-z", &[7.67e-3]),
            ("tm1.z-x", &[6.27e-4]),
            ("tm1.z-y", &[1.08e-2]),
            ("tm2.y-x", &[4.41e-4]),
            ("tm2.y-z", &[7.81e-3]),
            ("tm2.z-x", &[6.27e-4]),
            ("tm2.z-y", &[1.08e-2]),
        ],
        ..PLAIN
    },
    Row {
        id: "mps-gain",
        range: (1.0e-2, 1.0e-1),
        sigma: &[("sc.x", &[5.31e-3]), ("sc.y", &[4.2e-3]), ("sc.z", &[7.79e-3])],
        ..PLAIN
    },
    Row {
        id: "mps-tilt",
        range: (5.0e-3, 6.0e-2),
        sigma: &[("sc.x", &[7.63e-4]), ("sc.y", &[6.43e-4]), ("sc.z", &[3.08e-3])],
        ..PLAIN
    },
    Row {
        id: "torque-gain",
        range: (1.0e-2, 5.0e-2),
        sigma: &[("sc.x", &[6.6e-3]), ("sc.y", &[6.57e-3]), ("sc.z", &[6.56e-3])],
        ..PLAIN
    },
    Row {
        id: "mps-noise",
        range: (3.0e-1, 2.0),
        origin: 1.0,
        signed: false,
        sigma: &[("sc.x", &[1.67e-3]), ("sc.y", &[2.41e-3]), ("sc.z", &[9.77e-3])],
        ..PLAIN
    },
    Row {
        id: "torque-noise",
        range: (3.0e-1, 2.0),
        origin: 1.0,
        signed: false,
        sigma: &[("sc.x", &[6.61e-3]), ("sc.y", &[6.61e-3]), ("sc.z", &[6.99e-3])],
        ..PLAIN
    },
    Row {
        id: "is-noise",
        range: (3.0e-1, 2.0),
        origin: 1.0,
        signed: false,
        sigma: &[("tm1.y", &[7.61e-4]), ("tm1.z", &[7.63e-4]), ("tm2.y", &[7.61e-4]), ("tm2.z", &[7.63e-4])],
        ..PLAIN
    },
    Row {
        id: "is-scale",
        range: (3.0e-3, 1.0e-1),
        sigma: &[("tm1.y", &[6.05e-3]), ("tm1.z", &[7.31e-3]), ("tm2.y", &[6.19e-3]), ("tm2.z", &[7.3e-3])],
        ..PLAIN
    },
    Row {
        id: "is-crosstalk",
        range: (3.0e-3, 1.0e-1),
        sigma: &[
            ("tm1.x-y", &[2.71e-2]),
            ("tm1.x-z", &[3.29e-2]),
            ("tm1.y-z", &[7.18e-3]),
            ("tm1.z-y", &[6.08e-3]),
            ("tm2.x-y", &[2.7e-2]),
            ("tm2.x-z", &[3.29e-2]),
            ("tm2.y-z", &[7.33e-3]),
            ("tm2.z-y", &[6.06e-3]),
        ],
        ..PLAIN
    },
    Row { id: "tilt-to-length", range: (1.0e-4, 3.0e-3), sigma: &[("tm1", &[3.91e-4]), ("tm2", &[3.93e-4])], ..PLAIN },
    Row {
        id: "time-offset",
        range: (1.0e-3, 1.0e-1),
        signed: false,
        sigma: &[("is", &[8.0e-3]), ("ifo", &[2.56e-4]), ("dws", &[5.32e-3])],
        ..PLAIN
    },
    Row {
        id: "thermal",
        range: (0.0, 5.0e-11),
        shape: Some(("lag_s", &[60.0, 480.0, 3000.0])),
        sigma: &[
            ("tm1.x", &[7.23e-13, 8.58e-13, 1.83e-12]),
            ("tm1.y", &[1.53e-12, 1.78e-12, 3.02e-12]),
            ("tm1.z", &[2.37e-12, 2.67e-12, 3.31e-12]),
            ("tm2.x", &[9.05e-13, 1.06e-12, 2.03e-12]),
            ("tm2.y", &[1.28e-12, 1.55e-12, 3.55e-12]),
            ("tm2.z", &[3.02e-12, 3.44e-12, 5.73e-12]),
        ],
        ..PLAIN
    },
    Row { id: "magnetic", range: (0.0, 1.0e-4), sigma: &[("tm1", &[2.29e-5]), ("tm2", &[2.42e-5])], ..PLAIN },
    Row {
        id: "magnetic",
        carrier: Some("moment_a_m2"),
        range: (0.0, 2.0e-8),
        sigma: &[("tm1", &[2.04e-9]), ("tm2", &[2.28e-9])],
        ..PLAIN
    },
    Row { id: "charge", range: (0.0, 1.0e-1), sigma: &[("tm1", &[2.4e-3]), ("tm2", &[2.23e-3])], ..PLAIN },
    Row {
        id: "slosh",
        range: (1.0e-3, 5.0e-2),
        signed: false,
        shape: Some(("f0_hz", &[0.005, 0.012, 0.03, 0.08, 0.2])),
        sigma: &[
            ("sc.x", &[2.08e-3, 2.07e-3, 1.98e-3, 1.23e-3, 6.47e-4]),
            ("sc.y", &[2.38e-3, 2.37e-3, 2.2e-3, 1.22e-3, 5.87e-4]),
        ],
        ..PLAIN
    },
    Row {
        id: "impulse",
        range: (0.0, 2.0e-4),
        power: 0.0,
        sigma: &[("sc.x", &[4.43e-8]), ("sc.y", &[5.49e-8]), ("sc.z", &[1.72e-7])],
        ..PLAIN
    },
    Row {
        id: "impulse",
        range: (0.0, 1.0e-4),
        least_days: 0.25,
        sigma: &[("sc.phi", &[7.12e-8]), ("sc.theta", &[7.12e-8]), ("sc.psi", &[7.2e-8])],
        ..PLAIN
    },
    Row {
        id: "impulse",
        range: (0.0, 2.0e-9),
        power: 0.0,
        sigma: &[
            ("tm1.x", &[1.64e-12]),
            ("tm1.y", &[1.91e-12]),
            ("tm1.z", &[2.62e-12]),
            ("tm2.x", &[1.64e-12]),
            ("tm2.y", &[1.91e-12]),
            ("tm2.z", &[2.62e-12]),
        ],
        ..PLAIN
    },
    Row {
        id: "current-force",
        covered: false,
        range: (0.0, 1.0e-12),
        sigma: &[
            ("tm1.x", &[6.05e-16]),
            ("tm1.y", &[6.94e-16]),
            ("tm1.z", &[9.46e-16]),
            ("tm2.x", &[6.05e-16]),
            ("tm2.y", &[6.94e-16]),
            ("tm2.z", &[9.46e-16]),
        ],
        ..PLAIN
    },
    Row {
        id: "product-force",
        covered: false,
        range: (0.0, 1.0e-12),
        sigma: &[
            ("tm1.x", &[6.86e-15]),
            ("tm1.y", &[7.87e-15]),
            ("tm1.z", &[1.07e-14]),
            ("tm2.x", &[6.86e-15]),
            ("tm2.y", &[7.87e-15]),
            ("tm2.z", &[1.07e-14]),
        ],
        ..PLAIN
    },
];

/// One effect that was drawn.
#[derive(Clone, Debug)]
pub struct Drawn {
    /// The effect.
    pub asked: Asked,
    covered: bool,
    /// What was drawn, in the unit of `sigma`, counted from where the effect vanishes.
    pub amount: f64,
    /// Expected standard deviation of the amount.
    pub sigma: f64,
}

/// Everything that a seed hides.
#[derive(Clone, Debug)]
pub struct Hidden {
    seed: u64,
    /// The effects; possibly none.
    pub drawn: Vec<Drawn>,
    salt: String,
}

impl Hidden {
    /// Draws by `seed` for a simulation of `days`.
    ///
    /// # Panics
    /// Never: every row of the table names an effect, its instances and its parameters, as a test sees to.
    #[must_use]
    pub fn draw(seed: u64, days: f64) -> Self {
        let mut rng = stream(seed, "hidden");
        let luck: f64 = rng.random();
        let mut drawn: Vec<Drawn> = Vec::new();
        if luck >= NOTHING {
            let uncovered = luck >= 1.0 - UNCOVERED;
            let pair = luck < NOTHING + PAIR;
            drawn.extend(draw_one(&mut rng, days, |row| row.covered != uncovered));
            if let (true, Some(first)) = (pair, drawn.first().map(|d| d.asked.kind.id)) {
                drawn.extend(draw_one(&mut rng, days, |row| row.covered && row.id != first));
            }
        }
        let salt = (0..4).map(|_| format!("{:016x}", rng.random::<u64>())).collect();
        Self { seed, drawn, salt }
    }

    /// What is sealed, with what the caller adds.
    #[must_use]
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
        let asked = &self.asked;
        let shape: serde_json::Map<String, Value> =
            asked.kind.shape.iter().zip(&asked.shape).map(|(s, v)| (s.name.to_owned(), json!(v))).collect();
        json!({
            "effect": asked.kind.id,
            "instance": asked.place.to_string(),
            "size": asked.size,
            "unit": asked.kind.size.unit,
            "shape": shape,
            "covered": self.covered,
            "significance": self.amount.abs() / self.sigma,
            "sigma_expected": self.sigma,
        })
    }
}

/// Log-log interpolation of σ over the shape parameter.
fn sigma_at(row: &Row, sigma: &[f64], value: f64) -> f64 {
    let Some((_, grid)) = row.shape else { return sigma[0] };
    let i = grid.partition_point(|x| *x <= value).clamp(1, grid.len() - 1);
    let part = (value / grid[i - 1]).ln() / (grid[i] / grid[i - 1]).ln();
    sigma[i - 1] * (sigma[i] / sigma[i - 1]).powf(part)
}

/// Sizes that are both physical and seen: where even the smallest physical one stands out more, from it up to three times
/// as much. `None` where the largest is not seen.
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
    // Never the length itself: random() is below 1.
    from.get((rng.random::<f64>() * from.len() as f64) as usize)
}

fn draw_one(rng: &mut Xoshiro256PlusPlus, days: f64, wanted: impl Fn(&Row) -> bool) -> Option<Drawn> {
    let scaled = |row: &Row, sigma: f64| sigma * days.powf(-row.power);
    // A place where the effect is seen whatever its shape.
    let seen = |row: &Row, sigma: &[f64]| sigma.iter().all(|s| interval(row, scaled(row, *s)).is_some());
    let rows: Vec<&Row> = ROWS
        .iter()
        .filter(|row| wanted(row) && days >= row.least_days && row.sigma.iter().any(|(_, s)| seen(row, s)))
        .collect();
    let row = *pick(rng, &rows)?;
    let places: Vec<_> = row.sigma.iter().filter(|(_, s)| seen(row, s)).collect();
    let (place, sigmas) = pick(rng, &places)?;
    let shape = row.shape.map(|(name, grid)| (name, log_uniform(rng, (grid[0], grid[grid.len() - 1]))));
    let sigma = scaled(row, sigma_at(row, sigmas, shape.map_or(1.0, |(_, value)| value)));
    let amount = log_uniform(rng, interval(row, sigma)?) * if row.signed && rng.random() { -1.0 } else { 1.0 };

    let size = if row.carrier.is_some() { 0.0 } else { row.origin + amount };
    let mut text = format!("{}:{place}={size:e}", row.id);
    for (name, value) in shape.into_iter().chain(row.carrier.map(|name| (name, amount))) {
        text += &format!(",{name}={value:e}");
    }
    if row.id == "impulse" {
        text += &format!(",at_s={:.1}", 86_400.0 * days * (0.1 + 0.8 * rng.random::<f64>()));
    }
    let asked = Asked::parse(&text).unwrap_or_else(|error| unreachable!("the table of hidden effects: {error}"));
    Some(Drawn { asked, covered: row.covered, amount, sigma })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeMap;

    /// Three thousand seeds: the chances within 4.5σ of a binomial (false alarm 7e-6 each), sizes physical, significances
    /// where they should be, every row drawn.
    #[test]
    fn draws_keep_their_chances_and_ranges() {
        let n = 3000;
        // Three days: offset-drift is not seen in one.
        let (mut nothing, mut pairs, mut uncovered, mut seen) = (0.0, 0.0, 0.0, BTreeMap::new());
        for seed in 0..n {
            let hidden = Hidden::draw(seed, 3.0);
            nothing += f64::from(hidden.drawn.is_empty());
            pairs += f64::from(hidden.drawn.len() == 2);
            uncovered += f64::from(hidden.drawn.iter().any(|d| !d.covered));
            for d in &hidden.drawn {
                let significance = d.amount.abs() / d.sigma;
                assert!(significance >= SIGNIFICANCE.0 * 0.999_999, "{}: {significance}", d.asked);
                let loud = ROWS.iter().any(|r| r.id == d.asked.kind.id && r.range.0 > 0.0);
                assert!(significance <= SIGNIFICANCE.1 * 1.000_001 || loud, "{}: {significance}", d.asked);
                let rows = ROWS.iter().filter(|r| r.id == d.asked.kind.id);
                let physical =
                    rows.map(|r| r.range).any(|(a, b)| (a * 0.999_999..=b * 1.000_001).contains(&d.amount.abs()));
                assert!(physical, "{}", d.asked);
                *seen.entry(d.asked.kind.id).or_insert(0) += 1;
            }
            if let [a, b] = &hidden.drawn[..] {
                assert_ne!(a.asked.kind.id, b.asked.kind.id);
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
        let text = |seed: u64| Hidden::draw(seed, 2.0).content(&json!({"noise_seed": 5})).to_string();
        assert_eq!(text(4), text(4));
        assert_ne!(text(4), text(5));
        let salts: std::collections::BTreeSet<String> = (0..100).map(|seed| Hidden::draw(seed, 1.0).salt).collect();
        assert!(salts.len() == 100 && salts.iter().all(|salt| salt.len() == 64));
        // More days show smaller effects: the same seed aims at the same significance.
        let one = (0..100).map(|seed| (Hidden::draw(seed, 1.0), Hidden::draw(seed, 1.2)));
        let shrunk = one.filter(|(a, b)| a.drawn.first().is_some_and(|a| a.sigma > b.drawn[0].sigma)).count();
        assert!(shrunk > 50, "{shrunk}");
    }

    /// Every row of the table names what there is.
    #[test]
    fn the_table_names_effects_that_exist() {
        for row in ROWS {
            for (place, sigma) in row.sigma {
                Asked::parse(&format!("{}:{place}={}", row.id, row.origin)).unwrap();
                assert_eq!(sigma.len(), row.shape.map_or(1, |(_, grid)| grid.len()), "{} {place}", row.id);
                assert!(sigma.iter().all(|s| *s > 0.0 && s.is_finite()));
            }
            for name in row.carrier.into_iter().chain(row.shape.map(|(name, _)| name)) {
                Asked::parse(&format!("{}:{}={},{name}=1e-12", row.id, row.sigma[0].0, row.origin))
                    .map_or_else(|e| assert!(!e.to_string().contains("no parameter"), "{e}"), drop);
            }
        }
    }
}
