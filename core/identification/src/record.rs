//! Sums of some telemetry, with what they are of.

use dragfree_estimation::sigma::{NoiseError, NoiseModel};
use dragfree_schema::NoiseProcess;

use crate::candidates::CandidateSet;
use crate::gram::GramSums;

/// Candidates and sums of some telemetry.
#[derive(Clone, Debug, PartialEq)]
pub struct Record {
    /// Model and candidates.
    pub candidate_set: CandidateSet,
    /// Declared noise of the channels.
    pub noise: Vec<NoiseProcess>,
    /// Sums.
    pub gathered: GramSums,
    /// Candidates that could not be tried, with the reason.
    pub not_tried: Vec<(String, String)>,
}

/// Sums of different candidates, columns or segments.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "the products were made with different {0}, so their sums do not add: diagnose products of one mission, model and pipeline together"
)]
pub struct Unlike(&'static str);

impl Record {
    /// The noise model of the channels.
    ///
    /// # Errors
    /// A declaration contradicts itself.
    pub fn noise_model(&self) -> Result<NoiseModel, NoiseError> {
        NoiseModel::new(&self.noise, &self.candidate_set.channels, 1.0 / self.gathered.rate_hz)
    }

    /// Adds the sums of other telemetry. Forms of candidates whose series have gaps in one of the two are left out.
    ///
    /// # Errors
    /// [`Unlike`] where the two were not asked the same.
    pub fn add(&mut self, other: &Self) -> Result<(), Unlike> {
        let common = self.candidate_set.common(&other.candidate_set);
        let (a, b) = (&self.gathered, &other.gathered);
        let same = [
            (common.is_some(), "models or candidates"),
            (a.housekeeping.is_like(&b.housekeeping), "housekeeping"),
            (a.slow.housekeeping().eq(b.slow.housekeeping()), "housekeeping"),
            (self.noise == other.noise, "declared noise"),
            (a.columns == b.columns, "columns"),
            (a.length == b.length && a.rate_hz == b.rate_hz, "segments"),
        ];
        if let Some((_, what)) = same.into_iter().find(|(same, _)| !same) {
            return Err(Unlike(what));
        }
        self.candidate_set = common.unwrap_or_else(|| self.candidate_set.clone());
        let new = other.not_tried.iter().filter(|told| !self.not_tried.contains(told));
        let new: Vec<(String, String)> = new.cloned().collect();
        self.not_tried.extend(new);
        let g = &mut self.gathered;
        g.total.add(&other.gathered.total);
        g.hours.extend(other.gathered.hours.iter().cloned());
        g.hours.sort_by_key(|h| h.start_ns);
        g.housekeeping.add(&other.gathered.housekeeping);
        g.slow.add(&other.gathered.slow);
        g.transients.add(&other.gathered.transients);
        g.lines.add(&other.gathered.lines);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::coherence::HousekeepingCoherence;
    use crate::scores::tests::{candidate_set, gathered};
    use nalgebra::DMatrix;

    /// Sums with other housekeeping, or with products about other values of it, are refused; like ones add.
    #[test]
    fn sums_of_other_housekeeping_do_not_add() {
        let with = |names: &[&str], levels: &[f64]| {
            let mut gathered = gathered(1, 20_000, &[(9000, 6.0)], 0.0);
            let (names, plan) = (names.iter().map(|name| (*name).to_owned()).collect(), gathered.plan());
            let whitening = vec![DMatrix::identity(2, 2); plan.bands.len()];
            let residual = DMatrix::from_fn(2, 3, |i, j| f64::from(u8::from(i == j)));
            gathered.housekeeping =
                HousekeepingCoherence::new(names, Vec::new(), &plan, residual, whitening, Vec::new()).about(levels);
            Record { candidate_set: candidate_set(), noise: Vec::new(), gathered, not_tried: Vec::new() }
        };
        let mut record = with(&["hk/a", "hk/b"], &[1.0, 2.0]);
        for other in [with(&["hk/b", "hk/a"], &[1.0, 2.0]), with(&["hk/a", "hk/b"], &[1.0, 3.0])] {
            let before = record.clone();
            assert_eq!(record.add(&other), Err(Unlike("housekeeping")));
            assert!(record == before);
        }
        assert_eq!(record.add(&with(&["hk/a", "hk/b"], &[1.0, 2.0])), Ok(()));
    }
}
