//! Sums as they lie beside a product: what a day leaves behind, to be added to other days and solved again for any Σ.

use dragfree_schema::{Coefficient, Constraint, NoiseProcess};
use serde::{Deserialize, Serialize};

use crate::spectra::{Block, Layout, Plan, Spectra, Sums, triangle};

/// Version of the layout of stored sums. Those of version 2 have no slow bands, those of version 3 no coefficients.
pub const FORMAT: u32 = 4;

/// What a solution needs beside the sums, as the plugins declared it.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Declared {
    /// Noise in the channels, from which Σ is made.
    #[serde(default)]
    pub noise: Vec<NoiseProcess>,
    /// Coefficients of the model, in the order of the layout, without their responses, which are in the layout.
    #[serde(default)]
    pub coefficients: Vec<Coefficient>,
    /// Surveys and ranges.
    #[serde(default)]
    pub constraints: Vec<Constraint>,
    /// How often Σ is measured from the residuals.
    #[serde(default)]
    pub refinements: usize,
}

/// Sums in a form for JSON, in which every float is exact.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Stored {
    /// [`FORMAT`].
    pub format: u32,
    /// Channels, series, regressors and coefficients.
    pub layout: Layout,
    /// Samples of a segment.
    pub length: usize,
    /// Samples per second.
    pub rate_hz: f64,
    /// Bands below the others, of segments [`LONG`](crate::spectra::LONG) times as long, which stand first.
    #[serde(default)]
    pub slow_bands: usize,
    /// Noise, coefficients and constraints.
    #[serde(flatten)]
    pub declared: Declared,
    /// First and last frequency of each band, Hz.
    pub bands_hz: Vec<[f64; 2]>,
    /// Per band, the lower triangle of the columns' summed cross-spectra, channels, then series; and their weights.
    pub spectra: Spectra,
}

/// Why stored sums cannot be used.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the messages name the fields")]
pub enum StoredError {
    /// No JSON of sums.
    #[error("these are no sums of a day: {0}")]
    Json(#[from] serde_json::Error),
    /// Another version.
    #[error("stored sums have format {found}, this program reads 2 to {FORMAT}: run the day again")]
    Format { found: u32 },
    /// Sizes that contradict each other, or numbers that are none.
    #[error("stored sums contradict themselves ({0}): the file is damaged, run the day again")]
    Damaged(&'static str),
    /// Two days of different make.
    #[error(
        "the sums of two days differ in {0}, so they cannot be added: run the days again with one model, mission and pipeline"
    )]
    Unlike(&'static str),
}

impl Stored {
    /// What is to be stored.
    pub fn new(layout: &Layout, plan: &Plan, mut declared: Declared, spectra: &Spectra) -> Self {
        declared.coefficients.iter_mut().for_each(|c| c.responses.clear());
        Self {
            format: FORMAT,
            layout: layout.clone(),
            length: plan.length,
            rate_hz: plan.rate_hz,
            slow_bands: plan.slow_bands,
            declared,
            bands_hz: plan.bands.iter().map(|b| [b.first, b.end - 1].map(|k| plan.hz(*b, k as f64))).collect(),
            spectra: spectra.clone(),
        }
    }

    /// Of the normal equations beside a product, `neq.json`, which hold them as `sums`.
    ///
    /// # Errors
    /// [`StoredError`] when it holds none, or damaged ones.
    pub fn of_equations(text: &[u8]) -> Result<Self, StoredError> {
        #[derive(Deserialize)]
        struct Equations {
            sums: Stored,
        }
        let Equations { sums } = serde_json::from_slice(text)?;
        sums.check()?;
        Ok(sums)
    }

    /// The days' sums as one, each day a block.
    ///
    /// # Errors
    /// [`StoredError`] when a file is damaged or the days are not of one make.
    pub fn stack(days: &[Self]) -> Result<(Layout, Plan, Sums), StoredError> {
        let first = days.first().ok_or(StoredError::Damaged("no day at all"))?;
        for day in days {
            day.check()?;
            if let Some(what) = first.unlike(day) {
                return Err(StoredError::Unlike(what));
            }
        }
        let plan = first.plan();
        let mut sums = Sums::new(&plan, &first.layout);
        for (number, day) in (0..).zip(days) {
            let block = Block { number, spectra: day.spectra.clone(), overlaps_before: None };
            let day = Sums { total: day.spectra.clone(), block_ns: sums.block_ns, blocks: vec![block] };
            sums.add(&plan, &day);
        }
        Ok((first.layout.clone(), plan, sums))
    }

    /// In what the sums of another day differ so that they cannot be added.
    pub fn unlike(&self, other: &Self) -> Option<&'static str> {
        let same = [
            (self.layout == other.layout, "channels or effects"),
            (self.length == other.length, "the length of segments"),
            (self.rate_hz == other.rate_hz, "the sample rate"),
            (self.slow_bands == other.slow_bands, "the lowest band"),
            (self.declared.noise == other.declared.noise, "the declared noise"),
            (self.declared == other.declared, "ranges, surveys or starting values"),
        ];
        same.into_iter().find(|(same, _)| !same).map(|(_, what)| what)
    }

    /// The bands of the sums.
    pub fn plan(&self) -> Plan {
        match self.slow_bands {
            0 => Plan::new(self.length, self.rate_hz),
            _ => Plan::with_slow_bands(self.length, self.rate_hz),
        }
    }

    /// Whether sizes and numbers fit each other.
    ///
    /// # Errors
    /// [`StoredError::Format`] or [`StoredError::Damaged`].
    pub fn check(&self) -> Result<(), StoredError> {
        if !(2..=FORMAT).contains(&self.format) {
            return Err(StoredError::Format { found: self.format });
        }
        let Layout { channels, series, regressors, coefficients } = &self.layout;
        let inside = |r: &crate::spectra::Regressor| {
            r.channel < channels.len()
                && r.series < series.len()
                && r.coefficient < coefficients.len()
                && r.times.is_none_or(|other| other < coefficients.len())
        };
        let damaged = |what| Err(StoredError::Damaged(what));
        if !(16..=1 << 24).contains(&self.length) || !self.length.is_multiple_of(4) {
            return damaged("length of a segment");
        }
        if !(self.rate_hz.is_finite() && self.rate_hz > 0.0) {
            return damaged("sample rate");
        }
        if !regressors.iter().all(|r| inside(r) && r.factor.is_finite()) {
            return damaged("regressors");
        }
        if self.declared.noise.iter().any(|p| p.check().is_err()) {
            return damaged("declared noise");
        }
        let names = self.declared.coefficients.iter().map(|c| &c.name);
        if self.format == FORMAT && !names.eq(coefficients) {
            return damaged("coefficients");
        }
        let plan = self.plan();
        let bands = plan.bands.len();
        if self.slow_bands != plan.slow_bands {
            return damaged("number of slow bands");
        }
        let Spectra { packed, expected, weight, weight_squared, .. } = &self.spectra;
        let sizes = [self.bands_hz.len(), expected.len(), weight.len(), weight_squared.len()];
        if sizes != [bands; 4] || packed.len() != bands * triangle(self.layout.columns()) {
            return damaged("number of spectra");
        }
        let weights = expected.iter().chain(weight).chain(weight_squared);
        if !packed.iter().all(|x| x.is_finite()) || !weights.clone().all(|x| x.is_finite() && *x >= 0.0) {
            return damaged("spectra");
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::spectra::{Analyser, Regressor};
    use dragfree_schema::NoiseShape;

    fn declared(asd: f64) -> NoiseProcess {
        NoiseProcess {
            name: "n".to_owned(),
            spectrum: Some(NoiseShape::white(asd)),
            enters: [("c".to_owned(), vec![1.0])].into(),
            ..NoiseProcess::default()
        }
    }

    fn day(seed: u64) -> Stored {
        let layout = Layout {
            channels: vec!["c".into()],
            series: vec!["s".into()],
            regressors: vec![Regressor {
                coefficient: 0,
                channel: 0,
                series: 0,
                factor: -0.5,
                times: None,
                in_loop: false,
            }],
            coefficients: vec!["b".into()],
        };
        let mut analyser = Analyser::new(Plan::new(64, 10.0), &layout);
        let mut sums = Sums::new(analyser.plan(), &layout);
        let column =
            |k: u64| -> Vec<f64> { (0..64).map(|t| (1e-9 * (t * t + 7 * k) as f64 * seed as f64).sin()).collect() };
        analyser.add(0, 0, &[&column(1), &column(2)], false, &mut sums);
        let coefficients = vec![Coefficient { name: "b".to_owned(), ..Coefficient::default() }];
        let declared = Declared { noise: vec![declared(1e-12)], coefficients, ..Declared::default() };
        Stored::new(&layout, analyser.plan(), declared, &sums.total)
    }

    #[test]
    fn json_and_back_changes_no_bit_and_days_add_up() {
        let text = serde_json::to_string(&day(1)).expect("JSON");
        let back: Stored = serde_json::from_str(&text).expect("our own");
        assert_eq!(back, day(1));
        let (_, _, sums) = Stored::stack(&[day(1), day(2)]).expect("two days");
        assert_eq!((sums.total.segments, sums.blocks.len()), (2, 2));
        let both = day(1).spectra.packed.iter().zip(&day(2).spectra.packed).map(|(a, b)| a + b).collect::<Vec<_>>();
        assert_eq!(sums.total.packed, both);
    }

    #[test]
    fn what_does_not_fit_is_refused_by_name() {
        let change = |f: fn(&mut Stored)| {
            let mut other = day(2);
            f(&mut other);
            Stored::stack(&[day(1), other]).map(|_| ()).expect_err("refused").to_string()
        };
        assert!(change(|d| d.format = 7).contains("format 7"));
        assert!(change(|d| d.spectra.packed.truncate(3)).contains("number of spectra"));
        assert!(change(|d| d.spectra.packed[0] = f64::NAN).contains("damaged"));
        assert!(change(|d| d.length = 10).contains("length"));
        assert!(change(|d| d.rate_hz = 5.0).contains("sample rate"));
        assert!(change(|d| d.declared.noise = vec![declared(2e-12)]).contains("declared noise"));
        assert!(change(|d| d.declared.noise = vec![declared(f64::NAN)]).contains("damaged"));
        assert!(change(|d| d.layout.regressors[0].series = 9).contains("regressors"));
        assert!(change(|d| d.layout.coefficients[0] = "g".into()).contains("coefficients"));
        assert!(change(|d| d.declared.coefficients[0].upper = 3.0).contains("ranges"));
        let rename = |d: &mut Stored| {
            d.layout.coefficients[0] = "g".into();
            d.declared.coefficients[0].name = "g".into();
        };
        assert!(change(rename).contains("effects"));
        assert!(Stored::stack(&[]).is_err());
    }
}
