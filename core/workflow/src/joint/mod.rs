//! One calibration of many days from the sums that their products hold, without telemetry.
//!
//! Each day has its own product. Here the days' sums are added (`calendar`) and solved once more, with constraints
//! counted once. Every coefficient has a constant rate, and those that a declared event changes have a step there. What
//! the days say alone is compared with that.
//!
//! Rates are estimated whether they stand out or not. One that is left out because it does not may be as large as twice
//! its σ or more, and would be an error of several σ at either end of the time, and of every step.

pub(crate) mod calendar;
mod events;
mod product;
mod stale;

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

use chrono::NaiveDate;
use dragfree_archive::product::{Input, Product};
use dragfree_archive::{Archive, Row};
use dragfree_engine::EngineError;
use dragfree_estimation::estimate::{Estimate, Scatter};
use dragfree_estimation::joint::{self as many, Change, Course, DayScore, ManyDays, Stretch};
use dragfree_estimation::stored::Stored;
use dragfree_identification::distributions::chi2_tails;
use serde::{Deserialize, Serialize};

use crate::WorkflowError;
use crate::days::{DAY_NS, day_number, day_of_number, start_of_day_ns};
use calendar::{Calendar, Leaf};

pub use events::Event;
pub use product::{At, again, archived, at};
pub use stale::{Stale, stale};

/// Days below which no rate is estimated: two would be fitted exactly.
const LEAST_DAYS: usize = 3;

/// A day whose data end or begin within this of an event, ns, is not cut by it.
const EDGE_NS: i64 = 1_000_000_000;

/// Where the time scales of event and day differ, an event may lie so much earlier or later, ns: more than TAI, UTC and
/// GPS differ by.
const SCALES_NS: i64 = 60_000_000_000;

/// What is asked for.
#[derive(Clone, Debug)]
pub struct Options {
    /// First day.
    pub first: NaiveDate,
    /// Last day.
    pub last: NaiveDate,
    /// Spacecraft; the only one where it is left out.
    pub spacecraft: Option<String>,
    /// File of events.
    pub events: Option<PathBuf>,
    /// Kinds of events with the effects, or coefficients, that they change.
    pub steps: Vec<(String, String)>,
    /// Whether coefficients are known to be constant between events.
    pub constant: bool,
}

/// What is declared of the days.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Declared {
    /// Kinds of events with the effects that they change.
    pub steps: Vec<(String, String)>,
    /// Whether coefficients are known to be constant between events.
    pub constant: bool,
    /// Name and text of the file of events.
    #[serde(skip)]
    pub file: Option<(String, String)>,
}

impl Declared {
    /// Reads the file of events that is asked for.
    ///
    /// # Errors
    /// It cannot be read.
    pub fn read(options: &Options) -> Result<Self, WorkflowError> {
        let file = options.events.as_ref().map(|path| {
            let refuse = |e: std::io::Error| WorkflowError::Events { path: path.clone(), what: e.to_string() };
            let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            std::fs::read_to_string(path).map(|text| (name, text)).map_err(refuse)
        });
        Ok(Self { steps: options.steps.clone(), constant: options.constant, file: file.transpose()? })
    }

    /// Events of a spacecraft, in order.
    ///
    /// # Errors
    /// The file is no list of events.
    pub fn events(&self, spacecraft: &str) -> Result<Vec<Event>, WorkflowError> {
        let parse = |(name, text): &(String, String)| events::parse(text, name.as_ref(), spacecraft, &self.steps);
        self.file.as_ref().map_or_else(|| Ok(Vec::new()), parse)
    }
}

/// One calibration of many days.
#[derive(Clone, Debug, Serialize)]
pub struct Joint {
    /// Spacecraft.
    pub spacecraft: String,
    /// First day with a product.
    pub first: NaiveDate,
    /// Last day with a product.
    pub last: NaiveDate,
    /// Coefficients at the end of the last day, with their changes.
    pub coefficients: Vec<Coefficient>,
    /// Whether the days agree with it.
    pub same: Agreement,
    /// χ² per degree of freedom of the residuals, with the declared noise.
    pub chi2_per_dof: f64,
    /// Whether the noise was the same at all times: scatter of the days over what is expected, and the largest that
    /// chance allows; none with too few days.
    pub scatter: Option<Scatter>,
    /// Directions that the data do not determine.
    pub weak: Vec<String>,
    /// Days that entered, in order.
    pub days: Vec<Day>,
    /// Days with a product that did not, and why.
    pub left_out: Vec<LeftOut>,
    /// Days without a product.
    pub missing: Vec<NaiveDate>,
    /// Events that lie between days.
    pub events: Vec<Event>,
    /// What was declared of events.
    pub declared: Declared,
    /// Sentences.
    pub notes: Vec<String>,
    /// Covariance of all that was estimated, in the units of the product.
    #[serde(skip)]
    covariance: Option<(Vec<String>, Vec<Vec<f64>>)>,
    #[serde(skip)]
    like: Product,
    #[serde(skip)]
    inputs: Vec<Input>,
}

/// A coefficient of all days.
#[derive(Clone, Debug, Serialize)]
pub struct Coefficient {
    /// `com-offset.tm1.x`
    pub name: String,
    /// SI unit.
    pub unit: String,
    /// Frame, empty where there is none.
    pub frame: String,
    /// Value at the end of the last day.
    pub value: f64,
    /// Its standard deviation.
    pub sigma: f64,
    /// Constant rate, per s; none where it is known to be zero, or with too few days.
    pub rate: Option<Changed>,
    /// Steps at events that change it.
    pub steps: Vec<Step>,
}

/// A value.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Measured {
    /// Value.
    pub value: f64,
    /// Standard deviation.
    pub sigma: f64,
}

/// A rate, or the size of a step.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Changed {
    /// Value and σ.
    #[serde(flatten)]
    pub size: Measured,
    /// Whether it stands out from the noise, at the false-alarm rate of the settings for all rates, or steps, together.
    pub seen: bool,
}

/// A step of a coefficient.
#[derive(Clone, Debug, Serialize)]
pub struct Step {
    /// Times of the events, as they are written.
    pub events: Vec<String>,
    /// Its size.
    #[serde(flatten)]
    pub changed: Changed,
    /// Time of the last of its events, Unix ns.
    #[serde(skip)]
    time_ns: i64,
}

/// A day.
#[derive(Clone, Debug, Serialize)]
pub struct Day {
    /// Day.
    pub day: NaiveDate,
    /// Its product.
    pub product: String,
    /// Digest of that.
    pub sha256: String,
    /// The values of the product.
    pub values: Vec<Value>,
    /// Whether the day agrees with all days.
    #[serde(flatten)]
    pub agreement: Agreement,
}

/// A coefficient as a day's product has it.
#[derive(Clone, Debug, Serialize)]
pub struct Value {
    /// Coefficient.
    pub name: String,
    /// Value and σ.
    #[serde(flatten)]
    pub measured: Measured,
}

/// A χ² with its probability.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Agreement {
    /// χ².
    pub chi2: f64,
    /// Degrees of freedom.
    pub dof: usize,
    /// Probability of a larger one where there is agreement.
    pub p: f64,
}

impl Agreement {
    fn new(chi2: f64, dof: usize) -> Self {
        let p = if dof == 0 { 1.0 } else { chi2_tails(chi2 / dof as f64, dof as f64).1 };
        Self { chi2, dof, p }
    }
}

/// A day that did not enter.
#[derive(Clone, Debug, Serialize)]
pub struct LeftOut {
    /// Day.
    pub day: NaiveDate,
    /// Its product.
    pub product: String,
    /// Digest of that.
    pub sha256: String,
    /// Why.
    pub reason: String,
}

impl LeftOut {
    fn new(day: NaiveDate, row: &Row, reason: String) -> Self {
        Self { day, product: row.id.clone(), sha256: row.digest.clone().unwrap_or_default(), reason }
    }
}

impl Joint {
    /// Whether what fits all days fits each.
    pub fn agrees(&self) -> bool {
        self.same.p >= self.like.settings.false_alarm
    }
}

/// Days with what their products say.
type Products = BTreeMap<i64, (Row, Product)>;

/// Makes one calibration of the days of an archive.
///
/// # Errors
/// [`WorkflowError`]: no day has a product, or several spacecraft have; the days are of different make; the sums of one
/// are damaged or of an earlier version.
pub fn joint(archive: &Archive, options: &Options) -> Result<Joint, WorkflowError> {
    of_products(archive, chosen(archive, options)?, Declared::read(options)?)
}

/// Makes one calibration of products of one spacecraft and pipeline, one a day.
fn of_products(archive: &Archive, rows: Vec<Row>, declared: Declared) -> Result<Joint, WorkflowError> {
    let (mut days, mut left_out) = products(archive, rows)?;
    let spacecraft = days.values().next().map(|(row, _)| row.spacecraft.clone()).unwrap_or_default();
    let events = declared.events(&spacecraft)?;
    let scale = days.values().next().map(|(_, p)| p.header.non_standard_attributes.time_scale.clone());
    let margin = |event: &Event| if scale.as_deref() == Some(&event.time_scale) { 0 } else { SCALES_NS };
    days.retain(|number, (row, product)| {
        let attributes = &product.header.non_standard_attributes;
        let (from, until) = (attributes.start_time_epoch_ns + EDGE_NS, attributes.stop_time_epoch_ns - EDGE_NS);
        let cut = events.iter().find(|e| from < e.time_ns + margin(e) && e.time_ns - margin(e) < until);
        if let Some(event) = cut {
            let reason = format!("{} at {}: its coefficients step within the day", event.kind, event.time);
            left_out.push(LeftOut::new(day_of_number(*number), row, reason));
        }
        cut.is_none()
    });
    left_out.sort_by_key(|l| l.day);
    let reasons = || left_out.iter().map(|l| format!("{}: {}", l.product, l.reason)).collect::<Vec<_>>().join("; ");
    let (Some(first), Some(last)) = (days.keys().next().copied(), days.keys().last().copied()) else {
        return Err(WorkflowError::NoDays { what: reasons() });
    };

    let inputs = inputs(&days);
    let calendar = Calendar { kept: archive.sums(), days: leaves(archive, &days)? };
    let like = calendar.stored(first)?;
    same_make(&calendar, first, &like)?;
    let origin = 0.5 * (first + last + 1) as f64;
    let borders = borders(&days, &events);
    let stretches = stretches(&calendar, &days, &borders, origin)?;
    let settings = days[&last].1.settings.clone();
    let (layout, plan) = (&like.layout, &like.plan());
    let all = ManyDays {
        layout,
        plan,
        declared: &like.declared,
        settings: &settings,
        stretches: &stretches,
        length_days: (last + 1 - first) as f64,
    };
    let mut courses = steps(&like, &borders);
    if days.len() >= LEAST_DAYS && !declared.constant {
        courses.extend(rates(&like));
    }
    let solution = all.solve(&courses)?;
    let scores = scores(&calendar, &all, &solution, &borders, origin)?;
    let scatter = solution.scatter(&scores, settings.scatter_sigmas);
    let solution = solution.widened(scatter.as_ref());

    let same = solution.same(&scores);
    let day_lines = days.iter().zip(&scores).map(|((number, (row, product)), score)| Day {
        day: day_of_number(*number),
        product: row.id.clone(),
        sha256: row.digest.clone().unwrap_or_default(),
        values: values(product),
        agreement: Agreement::new(score.chi2, score.dof),
    });
    let day_lines: Vec<Day> = day_lines.collect();
    let Estimate { weak, quality, .. } = &solution.solution.estimate;
    let mut notes = Vec::new();
    let within = |e: &&Event| (start_of_day_ns(first)..start_of_day_ns(last + 1)).contains(&e.time_ns);
    let lone = events.iter().filter(within).filter(|e| !borders.iter().any(|b| b.events.contains(e)));
    notes.extend(
        lone.map(|e| {
            format!("{} at {}: there are no days on both sides of it, so no step is estimated", e.kind, e.time)
        }),
    );
    let reported = Reported { days: &days, borders: &borders, origin, last, false_alarm: settings.false_alarm };
    Ok(Joint {
        spacecraft,
        first: day_of_number(first),
        last: day_of_number(last),
        coefficients: reported.coefficients(&like, &solution),
        covariance: reported.covariance(&like, &solution),
        same: Agreement::new(same.chi2, same.dof),
        chi2_per_dof: quality.chi2_per_dof_modelled_sigma,
        scatter,
        weak: weak.iter().map(|w| w.sentence.clone()).collect(),
        missing: (first..=last)
            .filter(|n| !days.contains_key(n))
            .map(day_of_number)
            .filter(|day| left_out.iter().all(|l| l.day != *day))
            .collect(),
        days: day_lines,
        left_out,
        events: borders.iter().flat_map(|b| b.events.clone()).collect(),
        declared,
        notes,
        inputs,
        like: days.remove(&last).map(|(_, product)| product).ok_or(WorkflowError::NoProduct)?,
    })
}

/// The newest product of each day that is asked for, of one spacecraft and one pipeline.
pub(crate) fn chosen(archive: &Archive, options: &Options) -> Result<Vec<Row>, WorkflowError> {
    let mut rows: Vec<Row> = archive.newest().map_err(EngineError::from)?.into_iter().map(|entry| entry.row).collect();
    rows.retain(|row| {
        let wanted = options.spacecraft.as_ref().is_none_or(|s| *s == row.spacecraft);
        wanted && row.day.parse().is_ok_and(|day: NaiveDate| (options.first..=options.last).contains(&day))
    });
    let series: BTreeSet<String> = rows.iter().map(|row| format!("{} of {}", row.name, row.spacecraft)).collect();
    if series.len() > 1 {
        let what = series.into_iter().collect::<Vec<_>>().join(", ");
        return Err(WorkflowError::SeveralSeries { what });
    }
    if rows.is_empty() {
        let what = format!("{} to {}: no day has a product", options.first, options.last);
        return Err(WorkflowError::NoDays { what });
    }
    Ok(rows)
}

/// Products that agree with their data, by day, and those that do not.
fn products(archive: &Archive, rows: Vec<Row>) -> Result<(Products, Vec<LeftOut>), WorkflowError> {
    let (mut days, mut left_out) = (Products::new(), Vec::new());
    for row in rows {
        let day = row.day.parse::<NaiveDate>().unwrap_or_default();
        let product = archive.document(&row.id).map_err(EngineError::from)?;
        if product.quality.inconsistent {
            let reason = "its model contradicts the data; `dragfree diagnose` asks why".to_owned();
            left_out.push(LeftOut::new(day, &row, reason));
        } else {
            days.insert(day_number(day), (row, product));
        }
    }
    Ok((days, left_out))
}

/// The days' products, as what the calibration is made of: by name without revision and by digest, so that a day with
/// the same result once more changes nothing.
fn inputs(days: &Products) -> Vec<Input> {
    let of = |(row, product): &(Row, Product)| Input {
        role: "product".to_owned(),
        name: row.stem().to_owned(),
        size: product.attachments.iter().map(|file| file.size).sum(),
        sha256: product.header.non_standard_attributes.sha256.clone(),
    };
    days.values().map(of).collect()
}

fn leaves(archive: &Archive, days: &Products) -> Result<BTreeMap<i64, Leaf>, WorkflowError> {
    days.iter().map(|(day, (_, product))| Ok((*day, Leaf::new(archive, *day, product)?))).collect()
}

/// Whether the sums of all days can be added.
fn same_make(calendar: &Calendar, first: i64, like: &Stored) -> Result<(), WorkflowError> {
    let path = |day: i64| calendar.days[&day].path();
    if like.declared.coefficients.is_empty() {
        let what = "its sums are of an earlier version, without ranges and surveys: run the day again".to_owned();
        return Err(WorkflowError::Reference { path: path(first), what });
    }
    let (_, make) = calendar.day(first)?;
    for day in calendar.days.keys() {
        if calendar.day(*day)?.1 != make {
            let other = calendar.stored(*day)?;
            let what = like.unlike(&other).unwrap_or("their version");
            let what = format!(
                "its sums differ from those of {} in {what}, so they cannot be added: run the days with one model, mission \
                 and pipeline",
                calendar.days[&first].product
            );
            return Err(WorkflowError::Reference { path: path(*day), what });
        }
    }
    Ok(())
}

/// Between two days that both entered, events that change coefficients.
struct Border {
    /// The first day after it.
    after: i64,
    events: Vec<Event>,
}

fn borders(days: &Products, events: &[Event]) -> Vec<Border> {
    let mut borders: Vec<Border> = Vec::new();
    for event in events {
        let middle = |(_, product): &(Row, Product)| {
            let attributes = &product.header.non_standard_attributes;
            i64::midpoint(attributes.start_time_epoch_ns, attributes.stop_time_epoch_ns)
        };
        let before = days.values().any(|day| middle(day) < event.time_ns);
        let Some((after, _)) = days.iter().find(|(_, day)| middle(day) > event.time_ns).filter(|_| before) else {
            continue;
        };
        match borders.last_mut().filter(|border| border.after == *after) {
            Some(border) => border.events.push(event.clone()),
            None => borders.push(Border { after: *after, events: vec![event.clone()] }),
        }
    }
    borders
}

fn stretch_of(borders: &[Border], day: i64) -> usize {
    borders.iter().filter(|border| border.after <= day).count()
}

fn stretches(
    calendar: &Calendar,
    days: &Products,
    borders: &[Border],
    origin: f64,
) -> Result<Vec<Stretch>, WorkflowError> {
    let mut stretches = Vec::new();
    for number in 0..=borders.len() {
        let own: Vec<i64> = days.keys().copied().filter(|day| stretch_of(borders, *day) == number).collect();
        let (Some(first), Some(last)) = (own.first(), own.last()) else { continue };
        stretches.push(Stretch {
            sums: calendar.sum(*first, last + 1, origin)?,
            middle_days: 0.5 * (first + last + 1) as f64 - origin,
        });
    }
    Ok(stretches)
}

/// Steps of the coefficients that events change.
fn steps(like: &Stored, borders: &[Border]) -> Vec<Course> {
    let mut steps = Vec::new();
    for (after, border) in borders.iter().enumerate() {
        for (coefficient, c) in like.declared.coefficients.iter().enumerate() {
            if c.estimate && c.noise.is_empty() && border.events.iter().any(|e| e.changes(&c.name)) {
                steps.push(Course { coefficient, change: Change::Step(after) });
            }
        }
    }
    steps
}

/// Rates of the coefficients that act on a channel.
fn rates(like: &Stored) -> Vec<Course> {
    let acts = |coefficient: &usize| like.layout.regressors.iter().any(|r| r.coefficient == *coefficient);
    let estimated = |i: &usize| like.declared.coefficients[*i].estimate;
    let all = (0..like.declared.coefficients.len()).filter(acts).filter(estimated);
    all.map(|coefficient| Course { coefficient, change: Change::Rate }).collect()
}

fn scores(
    calendar: &Calendar,
    all: &ManyDays<'_>,
    solution: &many::Joint,
    borders: &[Border],
    origin: f64,
) -> Result<Vec<DayScore>, WorkflowError> {
    let of = |(day, leaf): (&i64, &Leaf)| {
        let days = *day as f64 + 0.5 + leaf.after_noon_days - origin;
        let (spectra, _) = calendar.day(*day)?;
        Ok(all.score(solution, &spectra, days, stretch_of(borders, *day)))
    };
    calendar.days.iter().map(of).collect()
}

/// The coefficients of a product that are estimated.
fn values(product: &Product) -> Vec<Value> {
    let of = |c: &dragfree_archive::product::Coefficient| Value {
        name: c.name.clone(),
        measured: Measured { value: c.value, sigma: c.sigma },
    };
    product.result.adopted().into_iter().map(of).collect()
}

/// What a solution is told as.
struct Reported<'a> {
    days: &'a Products,
    borders: &'a [Border],
    origin: f64,
    last: i64,
    false_alarm: f64,
}

impl Reported<'_> {
    /// Times between the last day before a step and the first one after it.
    fn step_ns(&self, after: usize) -> i64 {
        let middles = self.borders[after].events.iter().map(|e| e.time_ns);
        middles.max().unwrap_or_else(|| start_of_day_ns(self.borders[after].after))
    }

    /// End of the last day's data, in days after the origin.
    fn end_days(&self) -> f64 {
        let end_ns = self.days[&self.last].1.header.non_standard_attributes.stop_time_epoch_ns;
        (end_ns - start_of_day_ns(self.last)) as f64 / DAY_NS as f64 + self.last as f64 - self.origin
    }

    fn coefficients(&self, like: &Stored, solution: &many::Joint) -> Vec<Coefficient> {
        let Estimate { free, theta, covariance, .. } = &solution.solution.estimate;
        let of_free = free.iter().map(|i| theta[*i]);
        let estimated = nalgebra::DVector::from_iterator(free.len(), of_free);
        let sigma = |weights: &nalgebra::DVector<f64>| {
            covariance.as_ref().map_or(f64::NAN, |c| weights.dot(&(c * weights)).max(0.0).sqrt())
        };
        let change = |course: usize| {
            let at = free.iter().position(|i| *i == solution.of_day + course)?;
            let own = covariance.as_ref().map_or(f64::NAN, |c| c[(at, at)].sqrt());
            Some(Measured { value: estimated[at], sigma: own })
        };
        let rates = solution.courses.iter().filter(|c| c.change == Change::Rate).count();
        let changed = |size: Measured, tried: usize| {
            let p = chi2_tails((size.value / size.sigma).powi(2), 1.0).1;
            Changed { size, seen: p * tried as f64 <= self.false_alarm }
        };
        let mut all = Vec::new();
        for (i, c) in like.declared.coefficients.iter().enumerate().filter(|(i, _)| free.contains(i)) {
            let weights = solution.weights(i, self.end_days(), self.borders.len());
            let mut told = Coefficient {
                name: c.name.clone(),
                unit: c.unit.clone(),
                frame: c.frame.clone(),
                value: weights.dot(&estimated),
                sigma: sigma(&weights),
                rate: None,
                steps: Vec::new(),
            };
            for (number, course) in solution.courses.iter().enumerate().filter(|(_, c)| c.coefficient == i) {
                let Some(size) = change(number) else { continue };
                match course.change {
                    Change::Rate => {
                        let per_s = 1e9 / DAY_NS as f64;
                        let size = Measured { value: size.value * per_s, sigma: size.sigma * per_s };
                        told.rate = Some(changed(size, rates));
                    }
                    Change::Step(after) => told.steps.push(Step {
                        events: self.borders[after].events.iter().map(|e| e.time.clone()).collect(),
                        changed: changed(size, solution.courses.len() - rates),
                        time_ns: self.step_ns(after),
                    }),
                }
            }
            all.push(told);
        }
        all
    }

    /// Names of the product's coefficients, those of [`Self::coefficients`] with rates and steps behind each, and their
    /// covariance.
    fn covariance(&self, like: &Stored, solution: &many::Joint) -> Option<(Vec<String>, Vec<Vec<f64>>)> {
        let Estimate { free, covariance, .. } = &solution.solution.estimate;
        let covariance = covariance.as_ref()?;
        let (mut names, mut rows) = (Vec::new(), Vec::new());
        for (i, c) in like.declared.coefficients.iter().enumerate().filter(|(i, _)| free.contains(i)) {
            names.push(c.name.clone());
            rows.push(solution.weights(i, self.end_days(), self.borders.len()));
            for (number, course) in solution.courses.iter().enumerate().filter(|(_, c)| c.coefficient == i) {
                let Some(at) = free.iter().position(|i| *i == solution.of_day + number) else { continue };
                let mut row = nalgebra::DVector::zeros(free.len());
                match course.change {
                    Change::Rate => {
                        names.push(product::rate(&c.name));
                        row[at] = 1e9 / DAY_NS as f64;
                    }
                    Change::Step(after) => {
                        names.push(product::step(&c.name, self.step_ns(after)));
                        row[at] = 1.0;
                    }
                }
                rows.push(row);
            }
        }
        let of = |a: &nalgebra::DVector<f64>| rows.iter().map(|b| a.dot(&(covariance * b))).collect();
        Some((names, rows.iter().map(of).collect()))
    }
}
