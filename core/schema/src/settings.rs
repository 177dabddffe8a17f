//! Thresholds of calibration, comparison, diagnosis and ladder.

use serde::{Deserialize, Serialize};

/// Thresholds: what each is derived from, or what it trades.
///
/// A pipeline file overrides them in its table `[settings]`; a product stores those that it was made with, and
/// comparison, diagnosis and ladder use what their first product stores. In σ: quantiles of the normal distribution,
/// one-sided unless said otherwise.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "json-schema", derive(schemars::JsonSchema))]
#[serde(default)]
pub struct Settings {
    /// Chosen: 0.27 % of false alarms per coefficient at most, two-sided. Two solutions that differ by more σ disagree,
    /// and so do a survey and the data in one row.
    pub agreement_sigmas: f64,
    /// Derived: a false alarm in 1e3. All surveys together contradict the data.
    pub survey_sigmas: f64,
    /// Derived: a false alarm in 1e4. The data leave a physical range; a candidate that they want outside its range is
    /// refused.
    pub range_sigmas: f64,
    /// Derived: a false alarm in 1e4 per coefficient. The scatter of blocks of time widens its σ.
    pub scatter_sigmas: f64,
    /// Derived: a false alarm in 1e5, two-sided; with nine channels and their sum below 1e-4 in all. Bounds of χ²/dof.
    pub chi2_sigmas: f64,
    /// Measured: Σ is constant in its bands but for the declared shape, so χ²/dof is 1 to about this only.
    pub chi2_tolerance: f64,
    /// Derived: a false alarm in 1e5. Channels that share no declared noise are coherent.
    pub group_coherence_sigmas: f64,
    /// Chosen. Such a coherence below this ratio of χ²/dof changes no σ by more than a per cent and is not reported.
    pub group_coherence_ratio: f64,
    /// Chosen. A line is reported from this many times the power of its neighbourhood.
    pub line_ratio: f64,
    /// Chosen. A direction is weak when its σ exceeds this part of the half range: the range then says as much as the
    /// data.
    pub weak_direction: f64,
    /// Derived: five σ. A level of noise, or an unknown slow force, is adopted when `−2 log` of the likelihood falls by
    /// more.
    pub level_delta_chi2: f64,
    /// Chosen. Where the power of a band exceeds what the levels explain by this ratio, Σ takes up the excess: less is
    /// left to be explained by candidates.
    pub absorbed_excess_ratio: f64,
    /// Derived: a false alarm in 3e4 per band. The same excess must be as certain as this.
    pub absorbed_excess_sigmas: f64,
    /// Chosen: 0.27 % of false alarms, two-sided. A fall of χ² between two revisions counts beyond this many standard
    /// deviations of what different epochs make.
    pub ladder_sigmas: f64,
    /// Chosen. False-alarm rate of a whole comparison or diagnosis: lower misses smaller effects.
    pub false_alarm: f64,
    /// Chosen. Independent segments of full length below which there is no comparison: fewer have too coarse a Σ.
    pub min_segments: f64,
    /// Chosen. Length of a short segment, s: longer ones resolve more and leave fewer observations.
    pub segment_s: f64,
    /// Chosen. Time at the start that waits for the first value of slow housekeeping, s: it may come once a minute.
    pub patience_s: f64,
    /// Chosen. Part of its rows that a candidate's series may lack: gaps are bridged by the last value, which is noise.
    pub max_missing: f64,
    /// Chosen. Most transients that become candidates: each is a column of the sums.
    pub max_transients: usize,
    /// Chosen. A transient becomes a candidate below this p-value; whether it is certain is decided among the
    /// candidates.
    pub transient_p_value: f64,
    /// Chosen. Detections this close to a larger one are its ringing in another window, s.
    pub same_transient_s: f64,
    /// Chosen. Local maxima of the score over a grid of shapes from which the highest likelihood is searched for.
    pub likelihood_starts: usize,
    /// Chosen. The taper's loss of a waveform's energy is corrected up to this factor: with less left, its amplitude
    /// rests on too few samples.
    pub max_taper_loss: f64,
    /// Chosen. Most effects that are added.
    pub max_added: usize,
    /// Chosen. Candidates that are evaluated in full in each round: time against the length of the list.
    pub max_evaluated: usize,
    /// Chosen. Candidates whose likelihood is computed where there is an excess: each costs two fits.
    pub max_excess_candidates: usize,
    /// Chosen. Relative accuracy of the noise in a mission file: a level within it is not reported as missing.
    pub level_tolerance: f64,
    /// Chosen. Measured over modelled power of a third of a decade above which it is reported as an excess.
    pub excess_ratio: f64,
    /// Derived: 3.4e-6 each, 1e-3 over nine channels and fourteen thirds of decades, plain and partial.
    pub excess_sigmas: f64,
    /// Chosen. Part of the largest excess that an explanation may leave: the forms that are tried differ from the true
    /// one.
    pub excess_remainder: f64,
    /// Chosen. False-alarm rate of a coherence with housekeeping over all drivers and channels: a small part of
    /// `false_alarm`.
    pub coherence_false_alarm: f64,
    /// Chosen. Part of a channel's power that housekeeping has to explain to be evidence where there is no excess:
    /// currents of actuators follow commands, which share the readouts with the residuals, by a few per cent.
    pub coherence_min_explained: f64,
    /// Chosen. An excess wholly below this frequency is called a drift, Hz: slower than an hour.
    pub drift_hz: f64,
    /// Chosen. Most coherences in a comparison.
    pub max_coherences: usize,
    /// Chosen. Probability outside the intervals of the spectra of a comparison.
    pub outside_interval: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            agreement_sigmas: 3.0,
            survey_sigmas: 3.090,
            range_sigmas: 3.719,
            scatter_sigmas: 3.719,
            chi2_sigmas: 4.417,
            chi2_tolerance: 0.01,
            group_coherence_sigmas: 4.265,
            group_coherence_ratio: 1.02,
            line_ratio: 1.5,
            weak_direction: 1.0 / 3.0,
            level_delta_chi2: 25.0,
            absorbed_excess_ratio: 2.0,
            absorbed_excess_sigmas: 4.0,
            ladder_sigmas: 3.0,
            false_alarm: 0.01,
            min_segments: 4.0,
            segment_s: 1638.4,
            patience_s: 120.0,
            max_missing: 0.01,
            max_transients: 8,
            transient_p_value: 0.5,
            same_transient_s: 3600.0,
            likelihood_starts: 3,
            max_taper_loss: 4.0,
            max_added: 4,
            max_evaluated: 12,
            max_excess_candidates: 6,
            level_tolerance: 0.15,
            excess_ratio: 1.25,
            excess_sigmas: 4.5,
            excess_remainder: 1e-3,
            coherence_false_alarm: 1e-3,
            coherence_min_explained: 0.1,
            drift_hz: 1.0 / 3600.0,
            max_coherences: 40,
            outside_interval: 0.05,
        }
    }
}
