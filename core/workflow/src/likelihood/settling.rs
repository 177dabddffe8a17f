//! Passes with what is named alone, until values and levels of noise stay.
//!
//! The sums of a pass are a quadratic form about its point. Far from the values that act, or from the noise that the
//! data have, the likelihood is another function: the step to the highest point of the form may lead to where the
//! likelihood is lower, and from there anywhere. Such a step is halved (backtracking; Nocedal and Wright, Numerical
//! Optimization, 2006, chapter 3).

use dragfree_engine::config::EffectEntry;
use dragfree_engine::run::Progress;
use dragfree_schema::NoiseProcess;

use super::{Decided, How, Judge, PASSES, Point, moved, one_pass, step};
use crate::WorkflowError;
use crate::replay::{Pass, Replay};

/// By how much minus twice the logarithm of the likelihood may rise in a step: that of one σ.
const RISE: f64 = 1.0;

/// A point at which a pass was made.
pub(crate) struct Reached {
    point: Point,
    /// Minus twice the logarithm of the likelihood there.
    height: f64,
}

impl Reached {
    /// Where these sums were made.
    pub(crate) fn new(point: &Point, decided: &Decided) -> Self {
        Self { point: point.clone(), height: decided.height }
    }
}

/// Passes with what is named alone, until levels of noise and values stay: they take a small part of the time of one
/// with all candidates. `from` is where the step to `point` was made, if the model there is a case of the present one.
///
/// # Errors
/// As a pass.
pub(crate) fn settle(
    replay: &Replay<'_>,
    named: &[EffectEntry],
    slow: &[NoiseProcess],
    mut from: Option<Reached>,
    mut point: Point,
    judge: &dyn Judge,
    progress: &mut dyn FnMut(Pass, usize, Progress),
) -> Result<Point, WorkflowError> {
    let (mut steps, mut halved) = (0, 0);
    while steps < PASSES {
        let fitted = one_pass(replay, named, slow, How::Fit, &point, judge, progress);
        if let Some(before) = &from {
            let rises = match &fitted {
                // A likelihood that is no number is no higher one either.
                Ok(fitted) => fitted.height.is_nan() || fitted.height > before.height + RISE,
                // Levels of noise so far off that nothing is left of it in some combination of the channels.
                Err(error) => matches!(error, WorkflowError::NoLikelihood(_)),
            };
            if rises && halved == PASSES {
                return Ok(before.point.clone());
            }
            if rises {
                point = before.point.halfway(point);
                halved += 1;
                continue;
            }
        }
        let fitted = fitted?;
        let next = step(&point, &fitted);
        let settled = moved(&point, &next, &fitted).is_empty();
        from = Some(Reached::new(&point, &fitted));
        point = next;
        (steps, halved) = (steps + 1, 0);
        if settled {
            break;
        }
    }
    Ok(point)
}

impl Point {
    /// The point between this one and another, of the other's model: what acts there alone is zero here.
    fn halfway(&self, mut to: Self) -> Self {
        for (name, value) in &mut to.values {
            *value = 0.5 * (*value + self.values.get(name).unwrap_or(&0.0));
        }
        for (name, level) in &mut to.levels {
            *level = (*level * self.levels.get(name).unwrap_or(&1.0)).sqrt();
        }
        for (name, power) in &mut to.powers {
            *power = 0.5 * (*power + self.powers.get(name).copied().unwrap_or(*power));
        }
        let starts = to.starts.iter_mut().flatten().zip(self.starts.iter().flatten());
        starts.filter(|(to, from)| to.len() == from.len()).for_each(|(to, from)| *to = (&*to + from) * 0.5);
        to
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::DVector;

    /// Halfway lie values and starts by their mean, levels by their geometric mean. What only the other has counts from
    /// nothing, a level from the declared one, a power from itself; starts of another number of states stay.
    #[test]
    fn halfway_lies_between_two_points() {
        let start = DVector::from_column_slice;
        let of = |all: &[(&str, f64)]| all.iter().map(|(name, x)| ((*name).to_owned(), *x)).collect();
        let point = |values, levels, powers, starts| Point {
            values: of(values),
            levels: of(levels),
            powers: of(powers),
            starts: vec![starts],
            ..Point::default()
        };
        let from =
            point(&[("a", 1.0), ("left", 9.0)], &[("x", 2.0)], &[("p", 4.0)], vec![start(&[2.0]), start(&[7.0])]);
        let to = point(
            &[("a", 2.0), ("b", 3.0)],
            &[("x", 8.0), ("y", 9.0)],
            &[("p", 1.0), ("q", 6.0)],
            vec![start(&[4.0]), start(&[1.0, 1.0])],
        );
        let halfway = from.halfway(to);
        assert_eq!(halfway.values, of(&[("a", 1.5), ("b", 1.5)]));
        assert_eq!(halfway.levels, of(&[("x", 4.0), ("y", 3.0)]));
        assert_eq!(halfway.powers, of(&[("p", 2.5), ("q", 6.0)]));
        assert_eq!(halfway.starts, [[start(&[3.0]), start(&[1.0, 1.0])]]);
    }
}
