//! The values of days over time, and the days that leave what those before them predict.
//!
//! A day is predicted by the straight line that fits the days before it since the last event that changes the
//! coefficient, each weighted by its own σ. What days share, such as a survey, is in every σ and cancels in the
//! difference, so that false alarms are at most as frequent as stated.

use chrono::NaiveDate;
use dragfree_archive::Archive;
use dragfree_archive::product::Product;
use dragfree_engine::EngineError;
use dragfree_estimation::verdict::chi2_bounds;
use dragfree_identification::distributions::normal_tails;
use serde::Serialize;

use crate::WorkflowError;
use crate::days::{DAY_NS, day_number, day_of_number};
use crate::joint::{Declared, Event, Measured, Options, chosen};

/// Most days that a prediction rests on: what changes slower than in a month is followed.
const MOST_DAYS: usize = 30;

/// Values of days over time.
#[derive(Clone, Debug, Serialize)]
pub struct Trend {
    /// Spacecraft.
    pub spacecraft: String,
    /// Days with a product, in order.
    pub days: Vec<Day>,
    /// Every coefficient, in the order of the products.
    pub coefficients: Vec<Series>,
    /// What asks for attention, in order of time.
    pub alerts: Vec<Alert>,
    /// Rate of false alarms of a day, all of its coefficients together.
    pub false_alarm_per_day: f64,
    /// Events that change coefficients.
    pub events: Vec<Event>,
}

/// A day.
#[derive(Clone, Debug, Serialize)]
pub struct Day {
    /// Day.
    pub day: NaiveDate,
    /// Its product.
    pub product: String,
    /// Verdict of the product.
    pub verdict: Option<String>,
    /// χ²/dof with the declared noise.
    pub chi2_per_dof: f64,
    /// Mean normalised innovation squared.
    pub nis: f64,
}

/// A coefficient over days.
#[derive(Clone, Debug, Serialize)]
pub struct Series {
    /// `com-offset.tm1.x`
    pub name: String,
    /// SI unit.
    pub unit: String,
    /// Frame, empty where there is none.
    pub frame: String,
    /// Days that have it, in order.
    pub points: Vec<Point>,
}

/// A coefficient on a day.
#[derive(Clone, Debug, Serialize)]
pub struct Point {
    /// Day.
    pub day: NaiveDate,
    /// Value and σ of the product.
    #[serde(flatten)]
    pub measured: Measured,
    /// What the days before it predict; none with fewer than two.
    pub predicted: Option<Measured>,
    /// Difference from the prediction over its σ.
    pub sigmas: Option<f64>,
}

/// What asks for attention.
#[derive(Clone, Debug, Serialize)]
pub struct Alert {
    /// Day.
    pub day: NaiveDate,
    /// Coefficient; none where it is of the day as a whole.
    pub coefficient: Option<String>,
    /// One sentence.
    pub what: String,
}

/// The trend of the days of an archive. A day without a product is an alert where a later one has one, or where it is
/// before `today`.
///
/// # Errors
/// [`WorkflowError`]: no day has a product, or several spacecraft have; the events cannot be read.
pub fn trend(archive: &Archive, options: &Options, today: NaiveDate) -> Result<Trend, WorkflowError> {
    let mut products = Vec::new();
    for row in chosen(archive, options)? {
        let product = archive.document(&row.id).map_err(EngineError::from)?;
        products.push((row.day.parse::<NaiveDate>().unwrap_or(options.first), row, product));
    }
    products.sort_by_key(|(day, ..)| *day);
    let Some((first, row, newest)) = products.first().map(|(day, row, product)| (*day, row.clone(), product.clone()))
    else {
        return Err(WorkflowError::NoProduct);
    };
    let events = Declared::read(options)?.events(&row.spacecraft)?;
    let false_alarm = newest.settings.false_alarm;
    let mut alerts = Vec::new();
    for (day, row, product) in &products {
        alerts.extend(of_day(*day, &row.id, product));
    }
    let last = products.last().map_or(first, |(day, ..)| *day);
    let expected = last.max(today.pred_opt().unwrap_or(today)).min(options.last);
    for number in day_number(options.first)..=day_number(expected) {
        let day = day_of_number(number);
        if products.iter().all(|(other, ..)| *other != day) {
            alerts.push(Alert { day, coefficient: None, what: "no product: is its telemetry late?".to_owned() });
        }
    }
    let mut coefficients: Vec<Series> = Vec::new();
    for (day, _, product) in &products {
        for c in product.result.adopted().into_iter().filter(|c| c.value.is_finite() && c.sigma.is_finite()) {
            let at = coefficients.iter().position(|s| s.name == c.name).unwrap_or_else(|| {
                let (name, unit, frame) = (c.name.clone(), c.unit.clone(), c.frame.clone());
                coefficients.push(Series { name, unit, frame, points: Vec::new() });
                coefficients.len() - 1
            });
            let measured = Measured { value: c.value, sigma: c.sigma };
            coefficients[at].points.push(Point { day: *day, measured, predicted: None, sigmas: None });
        }
    }
    let tried = coefficients.len().max(1) as f64;
    for series in &mut coefficients {
        alerts.extend(series.predict(&events, false_alarm / tried));
    }
    alerts.sort_by_key(|alert| alert.day);
    let days = products.into_iter().map(|(day, row, product)| Day {
        day,
        product: row.id,
        verdict: product.result.verdict,
        chi2_per_dof: product.quality.chi2_per_dof,
        nis: product.quality.nis,
    });
    Ok(Trend {
        spacecraft: row.spacecraft,
        days: days.collect(),
        coefficients,
        alerts,
        false_alarm_per_day: false_alarm,
        events,
    })
}

/// What is wrong with a day as a whole.
fn of_day(day: NaiveDate, id: &str, product: &Product) -> Vec<Alert> {
    let mut alerts = Vec::new();
    let mut say = |what: String| alerts.push(Alert { day, coefficient: None, what });
    if product.quality.inconsistent {
        let why = product.quality.notes.first().map_or_else(String::new, |note| format!(": {note}"));
        say(format!("{id} contradicts its data{why}"));
    }
    if product.quality.data_loss {
        say(format!("{id} lacks data that were lost"));
    }
    let figures = product.quality.stages.values();
    let dof = figures.filter_map(|stage| stage.get("dof")?.as_float()).next_back();
    if let Some(dof) = dof.filter(|dof| *dof > 0.0) {
        let (low, high) = chi2_bounds(&product.settings, dof);
        for (name, value) in [("χ²/dof", product.quality.chi2_per_dof), ("NIS", product.quality.nis)] {
            if value.is_finite() && !(low..=high).contains(&value) {
                say(format!("{name} of {id} is {value:.4}, outside {low:.4} to {high:.4}"));
            }
        }
    }
    alerts
}

impl Series {
    /// Predicts every day from those before it. A day that leaves its prediction is no ground for the next ones.
    fn predict(&mut self, events: &[Event], false_alarm: f64) -> Vec<Alert> {
        let mut alerts = Vec::new();
        let mut ground: Vec<(f64, Measured)> = Vec::new();
        let mut previous: Option<NaiveDate> = None;
        for point in &mut self.points {
            let stepped = |e: &&Event| {
                let number = e.time_ns.div_euclid(DAY_NS);
                let since = |previous: i64| {
                    let between = previous < number && number <= day_number(point.day);
                    // A day with an event in it is no ground for the next one.
                    between || (previous == number && e.time_ns.rem_euclid(DAY_NS) != 0)
                };
                previous.is_some_and(|day| since(day_number(day))) && e.changes(&self.name)
            };
            if events.iter().any(|e| stepped(&e)) {
                ground.clear();
            }
            previous = Some(point.day);
            let time = day_number(point.day) as f64;
            point.predicted = line(&ground, time);
            let leaves = point.predicted.is_some_and(|predicted| {
                let sigma = predicted.sigma.hypot(point.measured.sigma);
                let sigmas = (point.measured.value - predicted.value) / sigma;
                point.sigmas = Some(sigmas);
                normal_tails(sigmas.abs()) < false_alarm
            });
            if leaves {
                let what = format!(
                    "{:+.1}σ from what the {} days before it predict",
                    point.sigmas.unwrap_or(f64::NAN),
                    ground.len()
                );
                alerts.push(Alert { day: point.day, coefficient: Some(self.name.clone()), what });
                continue;
            }
            ground.push((time, point.measured));
            if ground.len() > MOST_DAYS {
                ground.remove(0);
            }
        }
        alerts
    }
}

/// Value at a time of the straight line that fits points with their σ; none with fewer than two.
fn line(points: &[(f64, Measured)], time: f64) -> Option<Measured> {
    let (mut weight, mut mean_time, mut mean) = (0.0, 0.0, 0.0);
    for (t, m) in points {
        let w = m.sigma.powi(-2);
        (weight, mean_time, mean) = (weight + w, mean_time + w * t, mean + w * m.value);
    }
    (mean_time, mean) = (mean_time / weight, mean / weight);
    let (mut spread, mut slope) = (0.0, 0.0);
    for (t, m) in points {
        let w = m.sigma.powi(-2);
        spread += w * (t - mean_time).powi(2);
        slope += w * (t - mean_time) * (m.value - mean);
    }
    (points.len() >= 2 && spread > 0.0).then(|| {
        let ahead = time - mean_time;
        let sigma = (weight.recip() + ahead * ahead / spread).sqrt();
        Measured { value: mean + slope / spread * ahead, sigma }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Against the textbook's weighted least squares, solved as normal equations.
    #[test]
    fn the_line_is_that_of_least_squares() {
        let points = [(0.0, 1.0, 0.5), (1.0, 2.5, 1.0), (3.0, 2.0, 0.25), (4.0, 4.0, 2.0)]
            .map(|(t, value, sigma)| (t, Measured { value, sigma }));
        let sum =
            |f: &dyn Fn(f64, f64) -> f64| -> f64 { points.iter().map(|(t, m)| f(*t, m.value) / m.sigma.powi(2)).sum() };
        let (s, st, stt) = (sum(&|_, _| 1.0), sum(&|t, _| t), sum(&|t, _| t * t));
        let (sy, sty) = (sum(&|_, y| y), sum(&|t, y| t * y));
        let det = s * stt - st * st;
        let (a, b) = ((stt * sy - st * sty) / det, (s * sty - st * sy) / det);
        let at = 6.0;
        let variance = (stt - 2.0 * at * st + at * at * s) / det;
        let found = line(&points, at).expect("four points");
        assert!((found.value - (a + b * at)).abs() < 1e-12 && (found.sigma - variance.sqrt()).abs() < 1e-12);
        assert!(line(&points[..1], at).is_none());
    }

    fn day(k: i64) -> NaiveDate {
        day_of_number(23_741 + k)
    }

    fn series(values: impl Iterator<Item = f64>) -> Series {
        let point =
            |(k, value)| Point { day: day(k), measured: Measured { value, sigma: 1.0 }, predicted: None, sigmas: None };
        let points = (0..).zip(values).map(point).collect();
        Series { name: "com-offset.tm1.x".into(), unit: "m".into(), frame: String::new(), points }
    }

    /// Gaussian values from a line: of 400 × 58 predictions at a false-alarm rate of 1 in 100, 232 are expected to
    /// alarm; they hang together through the days that they share, so 4σ of what 400 independent series scatter by.
    #[test]
    fn alarms_come_at_the_rate_that_is_stated() {
        use rand::SeedableRng as _;
        use rand_distr::{Distribution as _, StandardNormal};
        let mut random = rand_xoshiro::Xoshiro256PlusPlus::seed_from_u64(7);
        let mut counts = Vec::new();
        for _ in 0..400 {
            let noise: Vec<f64> = (0..60).map(|_| StandardNormal.sample(&mut random)).collect();
            let values = noise.iter().enumerate().map(|(k, x)| 0.3 * k as f64 + x);
            counts.push(series(values).predict(&[], 0.01).len() as f64);
        }
        let n = counts.len() as f64;
        let mean = counts.iter().sum::<f64>() / n;
        let scatter = (counts.iter().map(|c| (c - mean).powi(2)).sum::<f64>() / (n - 1.0)).sqrt();
        assert!((mean - 0.58).abs() < 4.0 * scatter / n.sqrt(), "{mean} ± {}", scatter / n.sqrt());
    }

    /// A step of ten σ alarms from its day on, until an event declares it; an event of another effect does not.
    #[test]
    fn a_step_alarms_until_it_is_declared() {
        let values = || (0..30).map(|k| if k < 15 { 0.0 } else { 10.0 });
        let alerts = series(values()).predict(&[], 1e-3);
        assert_eq!((alerts[0].day, alerts.len()), (day(15), 15));
        let event = |changes: &str| Event {
            kind: "MTEA".into(),
            time: String::new(),
            time_ns: (23_741 + 15) * DAY_NS,
            time_scale: "UTC".into(),
            comments: String::new(),
            data: serde_json::Map::new(),
            effects: vec![changes.to_owned()],
        };
        let mut declared = series(values());
        assert!(declared.predict(&[event("com-offset")], 1e-3).is_empty());
        // The day of the step is ground for the next ones: two of them predict the third.
        let predicted: Vec<bool> = declared.points.iter().map(|p| p.predicted.is_some()).collect();
        assert_eq!(predicted[13..19], [true, true, false, false, true, true]);
        // A day with the event in it is no ground.
        let within = Event { time_ns: event("com-offset").time_ns + 1, ..event("com-offset") };
        let mut declared = series(values());
        declared.predict(&[within], 1e-3);
        let predicted: Vec<bool> = declared.points.iter().map(|p| p.predicted.is_some()).collect();
        assert_eq!(predicted[13..20], [true, true, false, false, false, true, true]);
        assert_eq!(series(values()).predict(&[event("com-off")], 1e-3).len(), 15);
    }
}
