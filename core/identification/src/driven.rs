//! Forces that follow a function of housekeeping: which function explains the residual of a channel best, over the
//! whole of each product.
//!
//! The amplitude a of a function is one. What is slow is told by [`crate::slow_samples`], what is faster by the
//! cross-spectra of [`crate::coherence`]; the level of the noise is one in each band and one of the samples. With n
//! numbers of power P before and P(a) after, the logarithm of the likelihood rises by `½ Σ n log(P/P(a))`.

use dragfree_estimation::sigma::NoiseModel;
use nalgebra::{Complex, DMatrix, DVector};

use crate::coherence::{Driver, HousekeepingCoherence, Part};
use crate::slow_samples::{BesideWalk, OWN, SlowSamples, Stretch, Whitened};

/// Ratio of the lags that are tried before the best is refined.
const RATIO: f64 = 2.0;

/// Steps of the golden section that refines a lag, each by 0.618: to a per cent.
const LAG_STEPS: usize = 10;

/// Rounds in which amplitude and levels of the noise follow each other: what is explained is a part of the power, and
/// the error of the levels falls by that part in each round.
const LEVEL_ROUNDS: usize = 10;

/// Functions whose samples are made at a time.
const AT_ONCE: usize = 256;

/// Functions of one housekeeping channel that are given for the channel of which most is explained.
const SINGLES: usize = 6;

/// Products of two that are given for it, and products with known series.
const PRODUCTS: usize = 3;

/// Housekeeping channels of which every product with a command at the place is given.
const AS_GAINS: usize = 2;

/// What lies between a cause and its force.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Memory {
    /// Nothing.
    None,
    /// A first-order lag, s.
    Lag(f64),
    /// The force follows the integral of the cause.
    Integral,
}

/// A force as a multiple of a function of housekeeping.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Driven {
    /// Where it acts ([`crate::coherence::HousekeepingCoherence::places`]).
    pub place: usize,
    /// The function.
    pub driver: Driver,
    /// What lies between it and the force.
    pub memory: Memory,
    /// Twice the rise of the logarithm of the likelihood with the declared noise.
    pub gain: f64,
}

impl Driven {
    /// What it adds to a combination of channels per unit, by itself; a product with its factors too, since where each
    /// is zero is not known. `response` is the acceleration in each channel per unit where it acts, `level` as of
    /// [`HousekeepingCoherence`]. Nothing where a series in it is not among the samples, as of commands in sums that
    /// were made without formulas on the spacecraft.
    pub(crate) fn acting(&self, response: &DVector<f64>, beside: &BesideWalk, level: &[f64]) -> Vec<Vec<DVector<f64>>> {
        if !beside.samples.has(self.driver) {
            return Vec::new();
        }
        let gain = beside.gains().dot(response);
        let of = |driver: Driver| {
            let series = beside.samples.series(driver, self.memory, level);
            gain * DVector::from_vec(series)
        };
        let own = of(self.driver);
        if own.norm_squared() == 0.0 {
            return Vec::new();
        }
        let factors = self.driver.factors();
        let with_factors = (!factors.is_empty()).then(|| {
            let factors = factors.into_iter().map(of).filter(|factor| factor.norm_squared() > 0.0);
            std::iter::once(own.clone()).chain(factors).collect()
        });
        std::iter::once(vec![own.clone()]).chain(with_factors).collect()
    }
}

/// Whether a function is a product, of two housekeeping channels or of one with a known series.
fn is_product(driver: Driver) -> bool {
    matches!(driver, Driver::Product(..) | Driver::Modulated(..))
}

impl SlowSamples {
    /// Functions that are tried at some places by [`Self::driven`].
    pub fn functions(&self, places: &[usize], housekeeping: &HousekeepingCoherence) -> usize {
        places.iter().map(|place| self.forms_at(*place, housekeeping).len()).sum()
    }

    fn forms_at(&self, place: usize, housekeeping: &HousekeepingCoherence) -> Vec<(Driver, Memory)> {
        self.forms(housekeeping).into_iter().filter(|(driver, _)| housekeeping.acts(*driver, place)).collect()
    }

    fn forms(&self, housekeeping: &HousekeepingCoherence) -> Vec<(Driver, Memory)> {
        let with = |driver: &Driver| {
            let all = if is_product(*driver) { vec![Memory::None] } else { self.memories(*driver) };
            all.into_iter().map(|memory| (*driver, memory)).collect::<Vec<_>>()
        };
        housekeeping.drivers.iter().flat_map(with).collect()
    }

    /// Memories that a function may have: the integral, none, and lags from a part of the distance of samples, by which
    /// slow samples move, to the length of the longest stretch.
    fn memories(&self, driver: Driver) -> Vec<Memory> {
        let longest = self.products.iter().flatten().map(Stretch::len).max().unwrap_or(0) as f64;
        let count = longest.max(1.0).log2() as i32;
        let lags = (-2..count).map(|k| Memory::Lag(self.step_s * RATIO.powi(k)));
        // The integral of a derivative is the value.
        let integral = (!matches!(driver, Driver::Derivative(_))).then_some(Memory::Integral);
        integral.into_iter().chain([Memory::None]).chain(lags).collect()
    }

    /// Functions of housekeeping for the one of some places at which they explain most, and the first of them for the
    /// other places, since a force at one shows at all: those that explain more than the best of as many would by
    /// chance, and of the first of them the products with every command there. The best first; `noise` is that of
    /// the channels.
    pub fn driven(&self, places: &[usize], noise: &NoiseModel, housekeeping: &HousekeepingCoherence) -> Vec<Driven> {
        let (thin, means_s) = self.thinned();
        let chance = 2.0 * (thin.functions(places, housekeeping).max(1) as f64).ln();
        let search = |place: &usize| {
            let whitened = thin.whitened(&housekeeping.places[*place].response, noise, &means_s)?;
            Some(Search::new(&thin, housekeeping, *place, whitened, chance))
        };
        let searches: Vec<Search<'_>> = places.iter().filter_map(search).collect();
        let ranked: Vec<Vec<(f64, (Driver, Memory))>> = searches.iter().map(Search::ranked).collect();
        let most = |s: &usize| ranked[*s].first().map_or(0.0, |(gain, _)| *gain);
        let Some(best) = (0..searches.len()).max_by(|a, b| most(a).total_cmp(&most(b))) else { return Vec::new() };
        let functions = searches[best].functions(&ranked[best]);
        let first = |kind: Kind| functions.iter().position(|(driver, _)| Kind::of(*driver) == kind);
        let firsts = [Kind::Single, Kind::Product, Kind::WithKnown].map(first);
        let at_place = |(s, f): (usize, usize)| {
            let (driver, memory) = functions[f];
            if !housekeeping.acts(driver, searches[s].place) {
                return None;
            }
            let gain = searches[s].gains(&[functions[f]])[0];
            let asked = s == best || firsts.contains(&Some(f));
            let place = searches[s].place;
            (asked && gain.fitted > chance).then_some(Driven { place, driver, memory, gain: gain.declared })
        };
        let all = (0..functions.len()).flat_map(|f| (0..searches.len()).map(move |s| (s, f)));
        let mut found: Vec<Driven> = all.filter_map(at_place).collect();
        // Commands have a constant part, so a gain that follows housekeeping shows as a force that does; what tells the
        // two apart may be faster than what is seen here.
        let singles = functions.iter().filter(|(driver, _)| Kind::of(*driver) == Kind::Single);
        let leading: Vec<usize> = singles.map(|(driver, _)| driver.of()[0]).take(AS_GAINS).collect();
        let commands = || housekeeping.known().filter(|k| self.units[*k] != "m");
        let gains = leading.iter().flat_map(|i| commands().map(move |k| Driver::Modulated(*i, k)));
        for driver in gains.filter(|driver| housekeeping.acts(*driver, searches[best].place)) {
            let (place, memory) = (searches[best].place, Memory::None);
            let gain = searches[best].gains(&[(driver, memory)])[0].declared;
            if found.iter().all(|other| (other.place, other.driver) != (place, driver)) {
                found.push(Driven { place, driver, memory, gain });
            }
        }
        found.sort_by(|a, b| b.gain.total_cmp(&a.gain));
        found
    }

    /// Whether every series in a function is among the samples.
    fn has(&self, driver: Driver) -> bool {
        let has = |stretch: &Stretch| driver.of().iter().all(|i| *i < stretch.housekeeping.len());
        self.products.iter().flatten().all(has)
    }

    /// Samples of a function in all stretches.
    fn series(&self, driver: Driver, memory: Memory, level: &[f64]) -> Vec<f64> {
        let of = |stretch: &Stretch| {
            let columns: Vec<&[f64]> = stretch.housekeeping.iter().map(Vec::as_slice).collect();
            let mut x = driver.samples(&columns, level);
            if matches!(driver, Driver::Derivative(_)) {
                x.iter_mut().for_each(|x| *x /= 2.0 * self.step_s);
            }
            memory.behind(x, self.step_s)
        };
        self.products.iter().flatten().flat_map(of).collect()
    }

    /// Root mean square of a function about its mean, in the unit of [`Self::expression`].
    pub fn rms(&self, driver: Driver, memory: Memory, housekeeping: &HousekeepingCoherence) -> f64 {
        let series = self.series(driver, memory, &housekeeping.level);
        let n = series.len().max(1) as f64;
        let mean = series.iter().sum::<f64>() / n;
        (series.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / n).sqrt()
    }

    /// Root mean square of what changes in a product with a known series: of housekeeping about where it began.
    pub fn rms_of_factor(&self, driver: Driver, housekeeping: &HousekeepingCoherence) -> f64 {
        self.rms(driver.housekeeping(), Memory::None, housekeeping)
    }

    /// The function as the effect `formula` reads it, `lag(hk.battery_current_a - 1.900000e0, 120.0)`.
    pub fn expression(&self, driver: Driver, memory: Memory, housekeeping: &HousekeepingCoherence) -> String {
        let level = &housekeeping.level;
        let name = |i: usize| self.names[i].replacen("hk/", "hk.", 1);
        let less = |level: f64| format!("{} {:.6e}", if level < 0.0 { '+' } else { '-' }, level.abs());
        let about = |i: usize| format!("{} {}", name(i), less(level[i]));
        // Without what is constant, which has no power to tell and costs digits.
        let plain = match driver {
            Driver::Value(i) => about(i),
            Driver::Derivative(i) => format!("derivative({})", name(i)),
            Driver::Square(i) => format!("{}^2 {}", name(i), less(level[i].powi(2))),
            Driver::Product(i, j) => format!("({}) * ({})", about(i), about(j)),
            Driver::Modulated(i, k) => format!("({}) * {}", about(i), name(k)),
        };
        match memory {
            Memory::None => plain,
            Memory::Lag(lag_s) => format!("lag({plain}, {lag_s:.1})"),
            Memory::Integral => format!("integral({plain})"),
        }
    }

    /// Unit of the known series in a function; none without one.
    pub fn unit_of_known(&self, driver: Driver) -> Option<&str> {
        let Driver::Modulated(_, k) = driver else { return None };
        self.units.get(k).map(String::as_str)
    }

    /// The function in words, as among coherences.
    pub fn label(&self, driver: Driver) -> String {
        driver.label(&self.names)
    }

    /// Unit of the amplitude of a function that has the unit `of`, `m s-2 A-2`.
    pub fn unit_of_amplitude(&self, of: &str, driver: Driver, memory: Memory) -> String {
        let times = if matches!(driver, Driver::Square(_)) { 2 } else { 1 };
        let seconds =
            i32::from(matches!(driver, Driver::Derivative(_))) - i32::from(matches!(memory, Memory::Integral));
        let mut powers: Vec<(String, i32)> = of.split_whitespace().filter_map(symbol_and_power).collect();
        let divided =
            driver.of().into_iter().flat_map(|i| self.units[i].split_whitespace()).filter_map(symbol_and_power);
        let divided = divided.map(|(symbol, power)| (symbol, -times * power));
        for (symbol, power) in std::iter::once(("s".to_owned(), seconds)).chain(divided) {
            match powers.iter_mut().find(|(own, _)| *own == symbol) {
                Some((_, own)) => *own += power,
                None => powers.push((symbol, power)),
            }
        }
        let told = powers.into_iter().filter(|(_, power)| *power != 0);
        let told = told.map(|(symbol, power)| if power == 1 { symbol } else { format!("{symbol}{power}") });
        let unit = told.collect::<Vec<_>>().join(" ");
        if unit.is_empty() { "1".to_owned() } else { unit }
    }
}

/// `s-2` as symbol and power; none of `1`.
fn symbol_and_power(text: &str) -> Option<(String, i32)> {
    let end = text.find(|c: char| c == '-' || c.is_ascii_digit()).unwrap_or(text.len());
    let (symbol, power) = text.split_at(end);
    let power = if power.is_empty() { 1 } else { power.parse().ok()? };
    (!symbol.is_empty()).then(|| (symbol.to_owned(), power))
}

impl Memory {
    /// Its frequency response.
    fn at(self, hz: f64) -> Complex<f64> {
        let omega = std::f64::consts::TAU * hz;
        match self {
            Self::None => Complex::new(1.0, 0.0),
            Self::Lag(lag_s) => Complex::new(1.0, omega * lag_s).inv(),
            Self::Integral => Complex::new(0.0, omega).inv(),
        }
    }

    /// What comes out behind it, settled at the start; between samples the cause is a straight line.
    fn behind(self, mut x: Vec<f64>, step_s: f64) -> Vec<f64> {
        match self {
            Self::None => {}
            Self::Integral => {
                let (mut sum, mut before) = (0.0, x.first().copied().unwrap_or(0.0));
                for x in &mut x {
                    sum += 0.5 * step_s * (before + *x);
                    before = std::mem::replace(x, sum);
                }
            }
            Self::Lag(lag_s) => {
                let decay = (-step_s / lag_s).exp();
                let mut before = x.first().copied().unwrap_or(0.0);
                let mut out = before;
                for x in &mut x {
                    let delay = (*x - before) * lag_s / step_s;
                    out = *x - delay + (out - before + delay) * decay;
                    before = std::mem::replace(x, out);
                }
            }
        }
        x
    }
}

/// Kinds of functions, of which each has its own best.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Kind {
    Single,
    Product,
    WithKnown,
}

impl Kind {
    fn of(driver: Driver) -> Self {
        match driver {
            Driver::Product(..) => Self::Product,
            Driver::Modulated(..) => Self::WithKnown,
            _ => Self::Single,
        }
    }
}

/// What explains a force at one place.
struct Search<'a> {
    samples: &'a SlowSamples,
    housekeeping: &'a HousekeepingCoherence,
    place: usize,
    whitened: Whitened,
    /// What is left of each housekeeping value and known series that is a factor; zero where nothing is.
    factors: Vec<DVector<f64>>,
    /// What the best of all functions explains by chance.
    chance: f64,
}

impl<'a> Search<'a> {
    fn new(
        samples: &'a SlowSamples,
        housekeeping: &'a HousekeepingCoherence,
        place: usize,
        whitened: Whitened,
        chance: f64,
    ) -> Self {
        let of = |i: usize| {
            let series = samples.series(Driver::Value(i), Memory::None, &housekeeping.level);
            let whole = DMatrix::from_column_slice(series.len(), 1, &series);
            let whole = whitened.whiten(&whole).unwrap_or_else(|| DMatrix::zeros(series.len(), 1));
            let own = whitened.left(&whole).column(0).into_owned();
            if own.norm_squared() > OWN * whole.norm_squared() { own.normalize() } else { own * 0.0 }
        };
        let are = !housekeeping.known().is_empty();
        let factors = (0..samples.names.len()).filter(|_| are).map(of).collect();
        Self { samples, housekeeping, place, whitened, factors, chance }
    }

    /// Functions that explain more than by chance, and what they explain with the declared noise, the most first.
    fn ranked(&self) -> Vec<(f64, (Driver, Memory))> {
        let forms = self.samples.forms_at(self.place, self.housekeeping);
        let gains = forms.chunks(AT_ONCE).flat_map(|some| self.gains(some)).zip(&forms);
        let mut all: Vec<(f64, (Driver, Memory))> =
            gains.filter(|(gain, _)| gain.fitted > self.chance).map(|(gain, form)| (gain.declared, *form)).collect();
        all.sort_by(|a, b| b.0.total_cmp(&a.0));
        all
    }

    /// The best of them, no two of the same housekeeping, each with its best memory. A product with what hardly changes
    /// is its other factor, slightly better by chance: each kind has its own.
    fn functions(&self, ranked: &[(f64, (Driver, Memory))]) -> Vec<(Driver, Memory)> {
        let mut functions: Vec<(Driver, Memory)> = Vec::new();
        for (_, form) in ranked {
            let (own, kind) = (form.0.of(), Kind::of(form.0));
            let alike = functions.iter().filter(|(other, _)| Kind::of(*other) == kind).count();
            let most = if kind == Kind::Single { SINGLES } else { PRODUCTS };
            if alike < most && functions.iter().all(|(other, _)| other.of() != own) {
                functions.push(self.refined(*form));
            }
        }
        functions
    }

    /// Gains of some functions.
    fn gains(&self, forms: &[(Driver, Memory)]) -> Vec<Gain> {
        let (w, samples) = (&self.whitened, self.samples);
        let mut all = DMatrix::zeros(w.y.len(), forms.len());
        for (mut column, (driver, memory)) in all.column_iter_mut().zip(forms) {
            column.copy_from_slice(&samples.series(*driver, *memory, &self.housekeeping.level));
        }
        let Some(whole) = w.whiten(&all) else { return vec![Gain::default(); forms.len()] };
        let own = w.left(&whole);
        let nyquist_hz = 0.5 / samples.step_s;
        let slow = |k: usize, driver: Driver| {
            let (mut d, mut y) = (own.column(k).into_owned(), w.y.clone());
            let mut parameters = w.beside.ncols();
            // See `HousekeepingCoherence::parts`.
            if let Driver::Modulated(i, k) = driver {
                let (known, value) = (&self.factors[k], &self.factors[i]);
                let apart = value - known * known.dot(value);
                let apart = apart.try_normalize(OWN).unwrap_or_else(|| value * 0.0);
                for factor in [known, &apart] {
                    d.axpy(-factor.dot(&d), factor, 1.0);
                    y.axpy(-factor.dot(&y), factor, 1.0);
                    parameters += 1;
                }
            }
            // What is explained of a function but for rounding by what is beside it has nothing of its own.
            let told = d.norm_squared() > OWN * whole.column(k).norm_squared();
            let (squared, along) = if told { (d.norm_squared(), d.dot(&y)) } else { (0.0, 0.0) };
            let observations = 0.5 * y.len().saturating_sub(parameters) as f64;
            Part { observations, power: y.norm_squared(), squared, along }
        };
        let gain = |(k, (driver, memory)): (usize, &(Driver, Memory))| {
            let fast = self.housekeeping.parts(self.place, *driver, |hz| memory.at(hz), nyquist_hz);
            Gain::of(slow(k, *driver), &fast)
        };
        forms.iter().enumerate().map(gain).collect()
    }

    /// The best memory of a function, between the lags that are tried too. A product counts as one trial, without a
    /// memory: it has one only if it explains more with it than the best of so many would by chance.
    fn refined(&self, (driver, best): (Driver, Memory)) -> (Driver, Memory) {
        let gain = |memory: Memory| self.gains(&[(driver, memory)])[0].declared;
        let memories = self.samples.memories(driver);
        let uncounted = if is_product(driver) { 2.0 * (memories.len() as f64).ln() } else { 0.0 };
        let counted = |memory: Memory| if memory == Memory::None { 0.0 } else { uncounted };
        let all = memories.into_iter().map(|memory| (memory, gain(memory) - counted(memory)));
        let memory = all.max_by(|a, b| a.1.total_cmp(&b.1)).map_or(best, |(memory, _)| memory);
        let Memory::Lag(lag_s) = memory else { return (driver, memory) };
        let (mut low, mut high) = ((lag_s / RATIO).ln(), (lag_s * RATIO).ln());
        let golden = 0.5 * (5.0_f64.sqrt() - 1.0);
        for _ in 0..LAG_STEPS {
            let (a, b) = (high - golden * (high - low), low + golden * (high - low));
            if gain(Memory::Lag(a.exp())) > gain(Memory::Lag(b.exp())) { high = b } else { low = a }
        }
        (driver, Memory::Lag((0.5 * (low + high)).exp()))
    }
}

/// Twice the rise of the logarithm of the likelihood by a function.
#[derive(Clone, Copy, Debug, Default)]
struct Gain {
    /// With the level of the noise fitted in each part: whether it is there.
    fitted: f64,
    /// With the declared level of slow noise, the same for all channels: along which channel, and which function.
    declared: f64,
}

impl Gain {
    /// From slow samples, whitened with the declared noise, and from faster bands.
    fn of(slow: Part, fast: &[Part]) -> Self {
        let weighed = |of: fn(&Part) -> f64| fast.iter().map(|p| 2.0 * p.observations / p.power * of(p)).sum::<f64>();
        let (squared, along) = (slow.squared + weighed(|p| p.squared), slow.along + weighed(|p| p.along));
        let declared = if squared > 0.0 { along.powi(2) / squared } else { 0.0 };
        Self { fitted: gain(&[&[slow], fast].concat()), declared }
    }
}

/// Twice the rise of the logarithm of the likelihood by one amplitude in all parts, each with a level of its own.
fn gain(parts: &[Part]) -> f64 {
    let mut left: Vec<f64> = parts.iter().map(|p| p.power).collect();
    for _ in 0..LEVEL_ROUNDS {
        let weighed =
            |of: fn(&Part) -> f64| parts.iter().zip(&left).map(|(p, left)| p.observations / left * of(p)).sum::<f64>();
        let (squared, along) = (weighed(|p| p.squared), weighed(|p| p.along));
        let amplitude = if squared > 0.0 { along / squared } else { 0.0 };
        let taken = |p: &Part| amplitude * (2.0 * p.along - amplitude * p.squared);
        left.iter_mut().zip(parts).for_each(|(left, p)| *left = (p.power - taken(p)).max(1e-12 * p.power));
    }
    parts.iter().zip(&left).map(|(p, left)| 2.0 * p.observations * (p.power / left).ln()).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::coherence::Direction;
    use crate::slow_samples::tests::{first, noise, random_walk, samples};
    use dragfree_estimation::spectra::Plan;

    /// Housekeeping without sums of segments: what is fast is told by nothing.
    fn none(names: usize) -> HousekeepingCoherence {
        let named = (0..names).map(|i| format!("hk/{i}")).collect();
        let places = Direction::of_channels(&[("a", ""), ("b", "")]);
        let (plan, same) = (Plan::new(1024, 1.0), DMatrix::identity(2, 2));
        let mut coherence = HousekeepingCoherence::new(named, Vec::new(), &plan, same, Vec::new(), places);
        coherence.level = vec![0.0; names];
        coherence
    }

    fn wave(period_h: f64, phase: f64) -> impl Fn(f64) -> f64 {
        move |t: f64| (std::f64::consts::TAU * t / (3600.0 * period_h) + phase).sin()
    }

    /// A force behind a lag is told with its cause and its lag, on the channel on which it acts first; of a force that
    /// is the square of a cause the square is told.
    #[test]
    fn a_force_is_told_with_its_cause_and_its_lag() {
        // Up for a third of every three hours.
        let up = |t: f64| f64::from(u8::from((t / 3600.0) % 3.0 < 1.0));
        let lag_s = 700.0;
        let behind = move |t: f64| {
            let hour = (t / 3600.0) % 3.0;
            let since = |h: f64| 3600.0 * (hour - h);
            let settled = if t < 10_800.0 { 1.0 } else { 0.0 };
            // Settled at the start, and nearly so before each rise.
            if hour < 1.0 {
                settled + (1.0 - settled) * (1.0 - (-since(0.0) / lag_s).exp())
            } else {
                (-since(1.0) / lag_s).exp()
            }
        };
        let other = wave(2.3, 0.4);
        let all = samples(8, 24.0, |t| 5e-14 * behind(t), &[], &[&other, &up]);
        let housekeeping = none(2);
        let found = all.driven(&[0], &noise(), &housekeeping);
        let Some(Driven { driver: Driver::Value(1) | Driver::Square(1), memory: Memory::Lag(found_s), .. }) =
            found.first()
        else {
            panic!("{found:?}");
        };
        assert!((found_s - lag_s).abs() < 0.1 * lag_s, "{found:?}");
        let cause = wave(3.1, 0.0);
        let all = samples(9, 24.0, |t| 5e-14 * cause(t).powi(2), &[], &[&other, &cause]);
        let found = all.driven(&[0], &noise(), &housekeeping);
        assert!(matches!(found[0].driver, Driver::Square(1)), "{found:?}");
        let expression = all.expression(found[0].driver, Memory::Lag(120.0), &housekeeping);
        assert_eq!(expression, "lag(hk.1^2 - 0.000000e0, 120.0)");
        assert_eq!(all.unit_of_amplitude("m s-2", found[0].driver, Memory::None), "m s-2 A-2");
        assert_eq!(all.unit_of_amplitude("m s-2", Driver::Derivative(0), Memory::Integral), "m s-2 A-1");
        assert_eq!(all.unit_of_amplitude("N", Driver::Derivative(0), Memory::None), "N s A-1");
        assert_eq!(all.unit_of_amplitude("A", Driver::Value(0), Memory::None), "1");
    }

    /// A force that is the product of two of six housekeeping channels whose zeros are unknown is explained by them
    /// better than by a random walk, and one that follows none of them is not. Of 200 sets of nine hours (seeds 0 to
    /// 199) 195 are, and 13 of those in which the force follows none, as the best of so many functions resembles it by
    /// chance. Of 40 others with these rates fewer than 33, and more than 11, are with a probability of 6e-6 each.
    #[test]
    fn a_driven_force_is_told_from_a_random_walk() {
        let (hours, size) = (9.0, 1e-14);
        let housekeeping = none(6);
        let (mut own, mut others) = (0, 0);
        for seed in 200..240 {
            let walks: Vec<_> = (0..7).map(|k| random_walk(5000 + 10 * seed + k, hours)).collect();
            let series: Vec<&dyn Fn(f64) -> f64> = walks[..6].iter().map(|w| w as &dyn Fn(f64) -> f64).collect();
            let is_explained = |force: &dyn Fn(f64) -> f64| {
                let all = samples(seed, hours, |t| size * force(t), &[], &series);
                let beside = all.beside_a_walk(&first(), &[], &noise()).expect("a covariance");
                let found = all.driven(&[0], &noise(), &housekeeping);
                let acting = |d: &Driven| d.acting(&first(), &beside, &housekeeping.level);
                let causes: Vec<_> = found.iter().flat_map(acting).collect();
                usize::from(beside.is_explained_by_one_of(&causes, all.functions(&[0], &housekeeping) as f64))
            };
            own += is_explained(&|t| (walks[0](t) - 1.0) * (walks[1](t) + 0.5));
            others += is_explained(&walks[6]);
        }
        assert!(own >= 33 && others <= 11, "{own} {others}");
    }

    /// Samples that were made without a command say nothing of its product with housekeeping, and all of housekeeping
    /// alone.
    #[test]
    fn a_function_acts_where_all_its_series_are_among_the_samples() {
        let cause = wave(3.1, 0.0);
        let all = samples(8, 24.0, |t| 5e-14 * cause(t), &[], &[&cause]);
        let beside = all.beside_a_walk(&first(), &[], &noise()).expect("a covariance");
        let acting = |driver: Driver| {
            let driven = Driven { place: 0, driver, memory: Memory::None, gain: 0.0 };
            driven.acting(&first(), &beside, &[0.0])
        };
        assert!(acting(Driver::Modulated(0, 1)).is_empty());
        assert_eq!(acting(Driver::Value(0)).len(), 1);
    }

    /// A product has a memory if it explains more with one by more than `2 log` of their number n. Without a force
    /// each does so with a probability of `P(χ² > 2 log n)` at most, all n together of less than 0.4: more than 22 of
    /// 30 sets have a probability of 5e-5. If the best memory were taken, 25 would have one.
    #[test]
    fn a_product_has_a_memory_by_chance_as_rarely_as_is_counted() {
        let (cause, other) = (wave(1.7, 0.1), wave(2.3, 0.7));
        let has_memory = |seed: u64| {
            let all = samples(seed, 6.0, |_| 0.0, &[], &[&cause, &other]);
            let (thin, means_s) = all.thinned();
            let whitened = thin.whitened(&first(), &noise(), &means_s).expect("a covariance");
            let housekeeping = none(2);
            let search = Search::new(&thin, &housekeeping, 0, whitened, 0.0);
            search.refined((Driver::Product(0, 1), Memory::None)).1 != Memory::None
        };
        let found = (0..30).filter(|seed| has_memory(*seed)).count();
        assert!(found <= 22, "{found}");
    }

    /// Without a force the gain of one function is χ² of one degree of freedom, so that its mean over 300 sets is one:
    /// false alarm 1e-5. The twin: a force of amplitude A in its shape, which adds A² T / S = 4.3.
    #[test]
    fn gains_are_chi_squared_without_a_force() {
        let gain = |seed: u64, size: f64| {
            let cause = wave(1.7, 0.1 * seed as f64);
            let all = samples(seed, 6.0, |t| size * cause(t), &[], &[&cause]);
            let (thin, means_s) = all.thinned();
            let whitened = thin.whitened(&first(), &noise(), &means_s).expect("a covariance");
            let housekeeping = none(1);
            let search = Search::new(&thin, &housekeeping, 0, whitened, 0.0);
            search.gains(&[(Driver::Value(0), Memory::None)])[0].fitted
        };
        let mean = |size: f64| (0..300).map(|seed| gain(seed, size)).sum::<f64>() / 300.0;
        let quiet = mean(0.0);
        assert!((quiet - 1.0).abs() < 4.4 * (2.0_f64 / 300.0).sqrt(), "{quiet}");
        assert!(mean(2e-15) > 2.0, "a force of 2e-15 m s⁻²");
    }

    /// The lag of a step settles as an exponential; the integral of a constant is a straight line.
    #[test]
    fn memories_are_those_of_continuous_time() {
        let step: Vec<f64> = (0..50).map(|k| f64::from(u8::from(k > 0))).collect();
        let out = Memory::Lag(500.0).behind(step, 100.0);
        // Between the first two samples the cause rises along a straight line.
        let ramp = 1.0 - 5.0 * (1.0 - (-0.2_f64).exp());
        assert!((out[1] - ramp).abs() < 1e-12, "{}", out[1]);
        assert!((out[11] - (1.0 - (1.0 - ramp) * (-2.0_f64).exp())).abs() < 1e-12, "{}", out[11]);
        let line = Memory::Integral.behind(vec![2.0; 4], 100.0);
        assert_eq!(line, [100.0, 300.0, 500.0, 700.0].map(|x| x + line[0] - 100.0));
    }
}
