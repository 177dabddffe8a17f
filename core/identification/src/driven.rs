//! Forces that follow a function of housekeeping: which function explains the residual of a channel best, over the
//! whole of each product.
//!
//! The amplitude a of a function is one. What is slow is told by [`crate::slow_samples`], what is faster by the
//! cross-spectra of [`crate::coherence`]; the level of the noise is one in each band and one of the samples. With n
//! numbers of power P before and P(a) after, the logarithm of the likelihood rises by `½ Σ n log(P/P(a))`.

use dragfree_estimation::sigma::NoiseModel;
use nalgebra::{Complex, DMatrix};

use crate::coherence::{Driver, HousekeepingCoherence, Part};
use crate::slow_samples::{OWN, SlowSamples, Stretch, Whitened};

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

/// Products that are given for it.
const PRODUCTS: usize = 3;

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

/// A channel's residual as a multiple of a function of housekeeping.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Driven {
    /// Index of the channel.
    pub channel: usize,
    /// The function.
    pub driver: Driver,
    /// What lies between it and the force.
    pub memory: Memory,
    /// Twice the rise of the logarithm of the likelihood with the declared noise.
    pub gain: f64,
}

impl SlowSamples {
    /// Functions that are tried for each channel by [`Self::driven`].
    pub fn functions(&self, housekeeping: &HousekeepingCoherence) -> usize {
        self.forms(housekeeping).len()
    }

    fn forms(&self, housekeeping: &HousekeepingCoherence) -> Vec<(Driver, Memory)> {
        let memories = self.memories();
        let with = |driver: &Driver| {
            let all = match driver {
                Driver::Product(..) => &[Memory::None],
                // The integral of a derivative is the value.
                Driver::Derivative(_) => &memories[1..],
                _ => &memories[..],
            };
            all.iter().map(|memory| (*driver, *memory)).collect::<Vec<_>>()
        };
        housekeeping.drivers.iter().flat_map(with).collect()
    }

    /// Lags from a part of the distance of samples, by which slow samples move, to the length of the longest stretch;
    /// the integral first.
    fn memories(&self) -> Vec<Memory> {
        let longest = self.products.iter().flatten().map(Stretch::len).max().unwrap_or(0) as f64;
        let count = longest.max(1.0).log2() as i32;
        let lags = (-2..count).map(|k| Memory::Lag(self.step_s * RATIO.powi(k)));
        [Memory::Integral, Memory::None].into_iter().chain(lags).collect()
    }

    /// Functions of housekeeping for the one of some channels of which they explain most, and the first of them for the
    /// other channels, since a force along one shows in all: those that explain more than the best of as many would by
    /// chance. The best first; `noise` is that of the channels.
    pub fn driven(&self, channels: &[usize], noise: &NoiseModel, housekeeping: &HousekeepingCoherence) -> Vec<Driven> {
        let (thin, means_s) = self.thinned();
        let forms = thin.forms(housekeeping);
        let chance = 2.0 * ((forms.len() * channels.len()) as f64).ln();
        let search = |channel: &usize| {
            let whitened = thin.whitened(*channel, noise, &means_s)?;
            Some(Search { samples: &thin, housekeeping, channel: *channel, whitened, chance })
        };
        let searches: Vec<Search<'_>> = channels.iter().filter_map(search).collect();
        let ranked: Vec<Vec<(f64, usize)>> = searches.iter().map(|search| search.ranked(&forms)).collect();
        let most = |s: &usize| ranked[*s].first().map_or(0.0, |(gain, _)| *gain);
        let Some(best) = (0..searches.len()).max_by(|a, b| most(a).total_cmp(&most(b))) else { return Vec::new() };
        let functions = searches[best].functions(&forms, &ranked[best]);
        let first = |factors: usize| functions.iter().position(|(driver, _)| driver.of().len() == factors);
        let firsts = [first(1), first(2)];
        let of_channel = |(s, f): (usize, usize)| {
            let (driver, memory) = functions[f];
            let gain = searches[s].gains(&[functions[f]])[0];
            let asked = s == best || firsts.contains(&Some(f));
            let channel = searches[s].channel;
            (asked && gain.fitted > chance).then_some(Driven { channel, driver, memory, gain: gain.declared })
        };
        let places = (0..functions.len()).flat_map(|f| (0..searches.len()).map(move |s| (s, f)));
        let mut found: Vec<Driven> = places.filter_map(of_channel).collect();
        found.sort_by(|a, b| b.gain.total_cmp(&a.gain));
        found
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
        };
        match memory {
            Memory::None => plain,
            Memory::Lag(lag_s) => format!("lag({plain}, {lag_s:.1})"),
            Memory::Integral => format!("integral({plain})"),
        }
    }

    /// The function in words, as among coherences.
    pub fn label(&self, driver: Driver) -> String {
        driver.label(&self.names)
    }

    /// Unit of the amplitude of a function that is an acceleration, `m s-2 A-2`.
    pub fn unit_of_amplitude(&self, driver: Driver, memory: Memory) -> String {
        let times = if matches!(driver, Driver::Square(_)) { 2 } else { 1 };
        let rate = i32::from(matches!(driver, Driver::Derivative(_)));
        let seconds = -2 + rate - i32::from(matches!(memory, Memory::Integral));
        let mut powers = vec![("m".to_owned(), 1), ("s".to_owned(), seconds)];
        let symbols = driver.of().into_iter().flat_map(|i| self.units[i].split_whitespace());
        for (symbol, power) in symbols.filter_map(symbol_and_power) {
            match powers.iter_mut().find(|(own, _)| *own == symbol) {
                Some((_, own)) => *own -= times * power,
                None => powers.push((symbol, -times * power)),
            }
        }
        let told = powers.into_iter().filter(|(_, power)| *power != 0);
        let told = told.map(|(symbol, power)| if power == 1 { symbol } else { format!("{symbol}{power}") });
        told.collect::<Vec<_>>().join(" ")
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

/// What explains one channel.
struct Search<'a> {
    samples: &'a SlowSamples,
    housekeeping: &'a HousekeepingCoherence,
    channel: usize,
    whitened: Whitened,
    /// What the best of all functions explains by chance.
    chance: f64,
}

impl Search<'_> {
    /// Functions that explain more than by chance, by index: what they explain with the declared noise, the most first.
    fn ranked(&self, forms: &[(Driver, Memory)]) -> Vec<(f64, usize)> {
        let gains = forms.chunks(AT_ONCE).flat_map(|some| self.gains(some)).enumerate();
        let mut all: Vec<(f64, usize)> =
            gains.filter(|(_, gain)| gain.fitted > self.chance).map(|(i, gain)| (gain.declared, i)).collect();
        all.sort_by(|a, b| b.0.total_cmp(&a.0));
        all
    }

    /// The best of them, no two of the same housekeeping, each with its best memory. A product with what hardly changes
    /// is its other factor, slightly better by chance: each kind has its own.
    fn functions(&self, forms: &[(Driver, Memory)], ranked: &[(f64, usize)]) -> Vec<(Driver, Memory)> {
        let mut functions: Vec<(Driver, Memory)> = Vec::new();
        for (_, i) in ranked {
            let own = forms[*i].0.of();
            let alike = functions.iter().filter(|(other, _)| other.of().len() == own.len()).count();
            let most = if own.len() == 1 { SINGLES } else { PRODUCTS };
            if alike < most && functions.iter().all(|(other, _)| other.of() != own) {
                functions.push(self.refined(forms[*i]));
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
        let observations = 0.5 * (w.y.len() - w.beside.ncols()) as f64;
        let nyquist_hz = 0.5 / samples.step_s;
        let part = |k: usize| {
            let (d, whole) = (own.column(k), whole.column(k));
            // What powers of time explain of a function but for rounding has nothing of its own.
            let told = d.norm_squared() > OWN * whole.norm_squared();
            let (squared, along) = if told { (d.norm_squared(), d.dot(&w.y)) } else { (0.0, 0.0) };
            Part { observations, power: w.y.norm_squared(), squared, along }
        };
        let gain = |(k, (driver, memory)): (usize, &(Driver, Memory))| {
            let fast = self.housekeeping.parts(self.channel, *driver, |hz| memory.at(hz), nyquist_hz);
            Gain::of(part(k), &fast)
        };
        forms.iter().enumerate().map(gain).collect()
    }

    /// The best memory of a function, between the lags that are tried too.
    fn refined(&self, (driver, best): (Driver, Memory)) -> (Driver, Memory) {
        let gain = |memory: Memory| self.gains(&[(driver, memory)])[0].declared;
        let all = self.samples.memories().into_iter().map(|memory| (memory, gain(memory)));
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
    use crate::slow_samples::tests::{noise, samples};
    use dragfree_estimation::spectra::Plan;

    /// Housekeeping without sums of segments: what is fast is told by nothing.
    fn none(names: usize) -> HousekeepingCoherence {
        let named = (0..names).map(|i| format!("hk/{i}")).collect();
        let mut coherence =
            HousekeepingCoherence::new(named, &Plan::new(1024, 1.0), DMatrix::identity(2, 2), Vec::new());
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
        assert_eq!(all.unit_of_amplitude(found[0].driver, Memory::None), "m s-2 A-2");
        assert_eq!(all.unit_of_amplitude(Driver::Derivative(0), Memory::Integral), "m s-2 A-1");
    }

    /// Without a force the gain of one function is χ² of one degree of freedom, so that its mean over 300 sets is one:
    /// false alarm 1e-5. The twin: a force of amplitude A in its shape, which adds A² T / S = 4.3.
    #[test]
    fn gains_are_chi_squared_without_a_force() {
        let gain = |seed: u64, size: f64| {
            let cause = wave(1.7, 0.1 * seed as f64);
            let all = samples(seed, 6.0, |t| size * cause(t), &[], &[&cause]);
            let (thin, means_s) = all.thinned();
            let whitened = thin.whitened(0, &noise(), &means_s).expect("a covariance");
            let housekeeping = none(1);
            let search = Search { samples: &thin, housekeeping: &housekeeping, channel: 0, whitened, chance: 0.0 };
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
