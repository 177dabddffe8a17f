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
