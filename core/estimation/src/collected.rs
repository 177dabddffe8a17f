//! What an estimation gathers of its rows: sums of segments and of long segments, and the fit in the time domain.

use crate::prediction::Prediction;
use crate::residual_means::ResidualMeans;
use crate::segments::{Cuts, Segmenter};
use crate::slow_band::SlowBand;
use crate::spectra::{Analyser, Layout, Plan, Sums};

/// Segments into sums, rows into long segments, samples into the fit in the time domain.
struct IntoSums<'a>(&'a mut Analyser, &'a mut Collected);

impl Cuts for IntoSums<'_> {
    fn plan(&self) -> &Plan {
        self.0.plan()
    }
    fn segment(&mut self, taper: usize, first_ns: i64, columns: &[&[f64]], overlaps: bool) {
        self.0.add(taper, first_ns, columns, overlaps, &mut self.1.sums);
    }
    fn rows(&mut self, first_ns: i64, columns: &[&[f64]]) {
        if let Some(residuals) = &mut self.1.residuals {
            residuals.push(first_ns, columns);
        }
        if let Some(slow) = &mut self.1.slow {
            slow.push(first_ns, columns, &mut self.1.sums.total);
        }
    }
    fn samples(&mut self, first_ns: i64, columns: &[&[f64]]) {
        self.1.samples(first_ns, columns);
    }
    fn between(&mut self) {
        self.1.train(self.0.plan());
    }
    fn gap(&mut self) {
        if let Some(slow) = &mut self.1.slow {
            slow.gap(&mut self.1.sums.total);
        }
        self.1.gap();
    }
}

/// What has been made of the segments.
#[derive(Clone)]
pub struct Collected {
    /// Sums of this run.
    pub sums: Sums,
    /// Sums of runs before, whose state this one took over.
    pub earlier: Sums,
    /// The fit in the time domain, over all of these runs.
    pub prediction: Option<Prediction>,
    /// The open long segments, where the plan has bands for them.
    pub slow: Option<SlowBand>,
    /// Means of rows, for residuals over time, where they are asked for.
    pub residuals: Option<ResidualMeans>,
}

impl Collected {
    /// Nothing yet.
    pub fn new(plan: &Plan, layout: &Layout, prediction: Option<Prediction>) -> Self {
        let sums = Sums::new(plan, layout);
        let slow = SlowBand::new(plan, layout.columns());
        Self { earlier: sums.clone(), sums, prediction, slow, residuals: None }
    }

    /// The same with means of the rows to come.
    pub fn with_residuals(mut self, plan: &Plan, layout: &Layout) -> Self {
        self.residuals = Some(ResidualMeans::new(layout, plan.rate_hz));
        self
    }

    /// Sums of this run and of those before.
    pub fn all(&self, plan: &Plan) -> Sums {
        let mut sums = self.earlier.clone();
        sums.add(plan, &self.sums);
        sums
    }

    /// Segments of this run and of those before.
    pub fn segments(&self) -> u64 {
        self.earlier.total.segments + self.sums.total.segments
    }

    /// New samples in fixed portions, whatever the batches, so that sums do not depend on these.
    fn samples(&mut self, first_ns: i64, columns: &[&[f64]]) {
        if let Some(prediction) = &mut self.prediction {
            prediction.push(first_ns, columns);
        }
    }

    fn train(&mut self, plan: &Plan) {
        let due = self.prediction.as_ref().is_some_and(|p| p.is_due(self.segments()));
        if due {
            let all = self.all(plan);
            if let Some(prediction) = &mut self.prediction {
                prediction.train(&all.total, plan);
            }
        }
    }

    fn gap(&mut self) {
        if let Some(prediction) = &mut self.prediction {
            prediction.gap();
        }
    }
}

impl Segmenter {
    /// As [`Self::cut`], into sums.
    pub fn push(&mut self, time_ns: &[i64], columns: &[&[f64]], analyser: &mut Analyser, collected: &mut Collected) {
        self.cut(time_ns, columns, &mut IntoSums(analyser, collected));
    }

    /// As [`Self::cut_end`], into sums.
    pub fn end_run(&mut self, analyser: &mut Analyser, collected: &mut Collected) {
        self.cut_end(&mut IntoSums(analyser, collected));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn layout() -> Layout {
        Layout {
            channels: vec!["a".into(), "b".into()],
            series: vec!["s".into()],
            regressors: vec![],
            coefficients: vec![],
        }
    }

    fn run(plan: Plan, batch: usize, columns: &[Vec<f64>], times: &[i64]) -> (Collected, Segmenter) {
        let length = plan.length;
        let mut analyser = Analyser::new(plan, &layout());
        let mut collected = Collected::new(analyser.plan(), &layout(), None);
        let mut segmenter = Segmenter::new(length, 100_000_000, vec![false, false, true]);
        for first in (0..times.len()).step_by(batch) {
            let end = (first + batch).min(times.len());
            let part: Vec<&[f64]> = columns.iter().map(|c| &c[first..end]).collect();
            segmenter.push(&times[first..end], &part, &mut analyser, &mut collected);
        }
        (collected, segmenter)
    }

    fn noise(n: usize, seed: u64) -> Vec<f64> {
        let mut x = seed;
        (0..n)
            .map(|_| {
                x = x.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                (x >> 11) as f64 / (1u64 << 53) as f64 - 0.5
            })
            .collect()
    }

    #[test]
    fn the_size_of_a_batch_changes_no_bit() {
        let mut columns: Vec<Vec<f64>> = (1..4).map(|s| noise(1000, s)).collect();
        columns[1][333] = f64::NAN;
        let times: Vec<i64> = (0..1000).map(|k| 100_000_000 * (k + i64::from(k > 600))).collect();
        let plans: [fn() -> Plan; 2] = [|| Plan::new(64, 10.0), || Plan::with_slow_bands(16, 10.0)];
        for plan in plans {
            let whole = run(plan(), 1000, &columns, &times);
            assert!(whole.0.sums.total.weight.iter().all(|w| *w > 0.0));
            for batch in [1, 7, 64, 777] {
                let parts = run(plan(), batch, &columns, &times);
                assert_eq!(parts.0.sums, whole.0.sums);
                let state = &parts.1.state;
                assert_eq!((state.valid, state.covered, &state.missing), (997, whole.1.state.covered, &vec![0, 1, 0]));
            }
        }
    }

    /// Runs 1..333, 334..601 and 602..1000 (the average needs a predecessor): each starts its own segments, and what
    /// they leave over is cut into shorter ones, all but the last, which goes on.
    #[test]
    fn a_segment_never_spans_a_gap_and_little_is_left_over() {
        let mut columns: Vec<Vec<f64>> = (1..4).map(|s| noise(1000, s)).collect();
        columns[1][333] = f64::NAN;
        let times: Vec<i64> = (0..1000).map(|k| 100_000_000 * (k + i64::from(k > 600))).collect();
        let (mut collected, mut segmenter) = run(Plan::new(64, 10.0), 100, &columns, &times);
        // 332 = 32 · 10 + 12, 267 = 32 · 8 + 11, 398 = 32 · 12 + 14: nothing shorter than 16 is left over.
        assert_eq!((collected.sums.total.segments, segmenter.state.covered), (9 + 7 + 11, 320 + 256 + 384));
        let mut analyser = Analyser::new(Plan::new(64, 10.0), &layout());
        let before = collected.sums.total.segments;
        segmenter.end_run(&mut analyser, &mut collected);
        assert_eq!((collected.sums.total.segments, segmenter.state.run[0].len()), (before, 0));
    }

    /// 100 samples: two segments of 64 that overlap, as three halves fit; the four left over are lost. 63: of 32,
    /// three; 31: of 16, two.
    #[test]
    fn short_runs_have_short_segments() {
        for (samples, segments, covered) in [(100, 2, 96), (63, 2, 48), (31, 2, 24), (15, 0, 0)] {
            let columns: Vec<Vec<f64>> = (1..4).map(|s| noise(samples + 1, s)).collect();
            let times: Vec<i64> = (0..=samples as i64).map(|k| 100_000_000 * k).collect();
            let mut analyser = Analyser::new(Plan::new(128, 10.0), &layout());
            let mut collected = Collected::new(analyser.plan(), &layout(), None);
            let mut segmenter = Segmenter::new(128, 100_000_000, vec![false, false, true]);
            let slices: Vec<&[f64]> = columns.iter().map(Vec::as_slice).collect();
            segmenter.push(&times, &slices, &mut analyser, &mut collected);
            segmenter.end_run(&mut analyser, &mut collected);
            assert_eq!((collected.sums.total.segments, segmenter.state.covered), (segments, covered), "{samples}");
        }
    }

    #[test]
    fn a_regressor_is_averaged_with_its_predecessor() {
        let columns = [vec![0.0; 8], vec![0.0; 8], (0..8).map(f64::from).collect()];
        let times: Vec<i64> = (0..8).map(|k| 100_000_000 * k).collect();
        let (_, segmenter) = run(Plan::new(64, 10.0), 3, &columns, &times);
        assert_eq!(segmenter.state.run[2], [0.5, 1.5, 2.5, 3.5, 4.5, 5.5, 6.5]);
    }
}
