//! One calibration of many days from the sums that their products hold, without telemetry.
//!
//! Each day has its own product. Here the days' sums are added (`calendar`) and solved once more, with constraints
//! counted once. Every coefficient has a constant rate, and those that a declared event changes have a step there. What
//! the days say alone is compared with that.
//!
//! Rates are estimated whether they stand out or not. One that is left out because it does not may be as large as twice
//! its σ or more, and would be an error of several σ at either end of the time, and of every step.

mod asked;
pub(crate) mod calendar;
mod days;
mod events;
mod product;
mod reported;
mod result;
mod stale;

use dragfree_archive::product::Product;
use dragfree_archive::{Archive, Row};
use dragfree_estimation::estimate::Estimate;
use dragfree_estimation::joint::{self as many, Change, Course, DayScore, ManyDays, Stretch};
use dragfree_estimation::stored::Stored;

use crate::WorkflowError;
use crate::days::{day_number, day_of_number, start_of_day_ns};
use calendar::{Calendar, Leaf};
use days::{Products, inputs, leaves, products, same_make, values};
use reported::Reported;

pub(crate) use days::chosen;

pub use asked::{Declared, Options};
pub use events::Event;
pub use product::{At, again, archived, at, rate_of};
pub use result::{Agreement, Changed, Coefficient, Day, Joint, LeftOut, Measured, Step, Value};
pub use stale::{Stale, stale};

/// Days below which no rate is estimated: two would be fitted exactly.
const LEAST_DAYS: usize = 3;

/// A day whose data end or begin within this of an event, ns, is not cut by it.
const EDGE_NS: i64 = 1_000_000_000;

/// Where the time scales of event and day differ, an event may lie so much earlier or later, ns: more than TAI, UTC and
/// GPS differ by.
const SCALES_NS: i64 = 60_000_000_000;

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
            let near =
                if margin(event) > 0 { ", which has another time scale: within a minute of the day" } else { "" };
            let reason = format!("{} at {} lies in the day{near}", event.kind, event.time);
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
    let same = solution.same(&scores);
    let (solution, widened) = solution.widened(same, settings.scatter_sigmas);
    let day_lines = days.iter().zip(&scores).map(|((number, (row, product)), score)| Day {
        day: day_of_number(*number),
        product: row.id.clone(),
        sha256: row.digest.clone().unwrap_or_default(),
        values: values(product),
        agreement: Agreement::new(score.chi2, score.dof),
    });
    let day_lines: Vec<Day> = day_lines.collect();
    let Estimate { weak, quality, .. } = &solution.solution.estimate;
    let mut notes = notes(&like, &events, &declared, days.len());
    if widened > 1.0 {
        notes.push(format!(
            "the days differ by {widened:.2} times what their noise says; σ of everything is widened by that"
        ));
    }
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
        first: declared.days.0,
        last: declared.days.1,
        epoch_ns: days[&last].1.header.non_standard_attributes.stop_time_epoch_ns,
        coefficients: reported.coefficients(&like, &solution),
        covariance: reported.covariance(&like, &solution),
        same: Agreement::new(same.chi2, same.dof),
        chi2_per_dof: quality.chi2_per_dof_modelled_sigma,
        widened,
        weak: weak.iter().map(|w| w.sentence.clone()).collect(),
        missing: (day_number(declared.days.0)..=day_number(declared.days.1))
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

/// What was asked for and cannot be done.
fn notes(like: &Stored, events: &[Event], declared: &Declared, days: usize) -> Vec<String> {
    let mut notes = Vec::new();
    let names: Vec<&str> = like.declared.coefficients.iter().filter(|c| c.estimate).map(|c| c.name.as_str()).collect();
    for event in events {
        let nothing = event.names_nothing(&names);
        if !nothing.is_empty() {
            notes.push(format!(
                "{} at {} changes {}, which no coefficient of the model is: there is no step of it",
                event.kind,
                event.time,
                nothing.join(", ")
            ));
        }
    }
    if days < LEAST_DAYS && !declared.constant {
        notes.push(format!("with fewer than {LEAST_DAYS} days no rate is estimated"));
    }
    notes
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
