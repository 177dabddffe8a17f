//! Σ(f): the modelled cross-spectral matrix of the channels, from the noise processes that the stages declare.
//!
//! A declared process enters the channels through a constant matrix M: it adds `M C Mᵀ` times its one-sided PSD times
//! the power response of the channels' way of measuring. All responses are even in time about `t_k`, so Σ is real and
//! symmetric.
//!
//! The shapes are those of the continuous processes: aliasing from above Nyquist is a factor near Nyquist, which the
//! refinement from residuals takes up (see `refine`).

use std::collections::BTreeMap;

use dragfree_physics::levels::responses;
use dragfree_schema::{NoiseProcess, NoiseResponse, NoiseShape};
use nalgebra::{DMatrix, DVector};

use crate::random_walk::held_directions;
use crate::spectra::{Band, Plan};

/// A declaration that makes no noise model.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the declared noise is unusable: {0}")]
pub struct NoiseError(String);

impl NoiseError {
    /// With this reason.
    pub(crate) fn of(reason: String) -> Self {
        Self(reason)
    }
}

/// A process as the channels of the model see it.
struct Process {
    shape: NoiseShape,
    response: NoiseResponse,
    /// Channels × channels, over the shape's PSD.
    enters: DMatrix<f64>,
}

/// A component of a declared process whose level may be fitted.
struct Component {
    name: String,
    /// Index of the declaration.
    declared: usize,
    process: Process,
    /// Index of the estimation error that it drives, and what it contributes to the estimated quantities, over the root
    /// of its PSD.
    estimated: Option<(usize, DVector<f64>)>,
}

/// The error of a minimum-variance estimate `E[q | q + n]` of quantities that a process drives, which enters the
/// channels.
struct EstimationError {
    /// B: channels × quantities.
    gain: DMatrix<f64>,
    /// Covariance of the quantities over the PSD of the driving process.
    driven: DMatrix<f64>,
    shape: NoiseShape,
    response: NoiseResponse,
    /// Noise n of the readout of each quantity; nothing where none is read.
    readout: Option<(NoiseShape, NoiseResponse)>,
}

/// The noise model of a set of channels.
pub struct NoiseModel {
    channels: usize,
    /// Channels in which the declared processes are all there is once the model is taken out.
    residual: Vec<bool>,
    dt_s: f64,
    processes: Vec<Process>,
    components: Vec<Component>,
    errors: Vec<EstimationError>,
    /// Unit vectors along which declared forces enter the channels.
    pub(crate) directions: Vec<DVector<f64>>,
    /// Channels without declared noise: they start as white with unit PSD and are measured.
    pub unknown: Vec<usize>,
}

impl NoiseModel {
    /// Builds the model of `channels`, sampled every `dt_s`, from what the stages declare. Channels of a declaration
    /// that are not among `channels` are left out of it.
    ///
    /// # Errors
    /// [`NoiseError`] when a declaration contradicts itself or holds a number that is not finite.
    pub fn new<S: AsRef<str>>(declared: &[NoiseProcess], channels: &[S], dt_s: f64) -> Result<Self, NoiseError> {
        let n = channels.len();
        let mut model = Self {
            channels: n,
            residual: vec![true; n],
            dt_s,
            processes: Vec::new(),
            components: Vec::new(),
            errors: Vec::new(),
            directions: held_directions(declared, channels).into_iter().map(|(_, direction)| direction).collect(),
            unknown: Vec::new(),
        };
        for (index, process) in declared.iter().enumerate() {
            process.check().map_err(|what| NoiseError(format!("process `{}`: {what}", process.name)))?;
            model.add(index, process, channels);
        }
        let probe = model.psd(0.1 / dt_s);
        model.unknown = (0..n).filter(|i| probe[(*i, *i)] <= 0.0).collect();
        for i in &model.unknown {
            model.residual[*i] = false;
            let mut enters = DMatrix::zeros(n, n);
            enters[(*i, *i)] = 1.0;
            model.processes.push(Process { shape: NoiseShape::white(1.0), response: NoiseResponse::Direct, enters });
        }
        Ok(model)
    }

    fn add<S: AsRef<str>>(&mut self, index: usize, declared: &NoiseProcess, channels: &[S]) {
        let size = declared.size();
        let mixing = gains(channels, &declared.enters, size);
        let Some(shape) = &declared.spectrum else {
            for (residual, row) in self.residual.iter_mut().zip(mixing.row_iter()) {
                *residual &= row.iter().all(|gain| *gain == 0.0);
            }
            return;
        };
        let process = |enters| Process { shape: shape.clone(), response: declared.response, enters };
        let covariance = match &declared.covariance {
            Some(rows) => matrix(rows, size),
            None => DMatrix::identity(size, size),
        };
        let error = declared.estimate.as_ref().map(|e| {
            let quantities = matrix(&e.matrix, size);
            let error = EstimationError {
                gain: gains(channels, &e.enters, quantities.nrows()),
                driven: &quantities * &covariance * quantities.transpose(),
                shape: shape.clone(),
                response: declared.response,
                readout: e.readout.as_ref().map(|shape| (shape.clone(), e.readout_response)),
            };
            (quantities, error)
        });
        let error = error.filter(|(_, error)| is_any(error.gain.as_slice()));
        for (k, name) in declared.components.iter().enumerate() {
            let (column, level) = (mixing.column(k), covariance[(k, k)]);
            let enters = column * column.transpose() * level;
            let driven = error.as_ref().map(|(quantities, _)| quantities.column(k) * level.sqrt());
            let estimated = driven.filter(|d| is_any(d.as_slice())).map(|d| (self.errors.len(), d));
            if estimated.is_some() || is_any(enters.as_slice()) {
                self.components.push(Component {
                    name: name.clone(),
                    declared: index,
                    process: process(enters),
                    estimated,
                });
            }
        }
        let enters = &mixing * &covariance * mixing.transpose();
        if is_any(enters.as_slice()) {
            self.processes.push(process(enters));
        }
        self.errors.extend(error.map(|(_, error)| error));
    }

    /// One-sided cross-spectral matrix of one component alone, by the name that its declaration gives it; `None` where
    /// there is none.
    ///
    /// Where an estimate is made from what the component drives, it is what Σ gains by a little more of the component:
    /// what enters the channels at once, and what the estimate does not know of it. The estimate is taken to follow the
    /// level, so that its error stays orthogonal to the readout.
    pub fn process_psd(&self, name: &str, frequency_hz: f64) -> Option<DMatrix<f64>> {
        let Component { process: p, estimated, .. } = self.components.iter().find(|c| c.name == name)?;
        let power = p.shape.psd(frequency_hz) * self.power(p.response, frequency_hz);
        let mut psd = &p.enters * power;
        if let Some((index, driven)) = estimated {
            let error = &self.errors[*index];
            let moves = &error.gain * self.unknown_part(error, frequency_hz) * driven;
            psd += &moves * moves.transpose() * power;
        }
        Some(psd)
    }

    /// One-sided cross-spectral matrix at `frequency_hz`, channels × channels, units of the channels squared per Hz.
    pub fn psd(&self, frequency_hz: f64) -> DMatrix<f64> {
        self.mean_psd(&[frequency_hz])
    }

    /// Mean of [`Self::psd`] over some frequencies. What is linear in the spectra is averaged before it is spread over
    /// the channels: a band has up to ten thousand bins.
    fn mean_psd(&self, frequencies_hz: &[f64]) -> DMatrix<f64> {
        let count = frequencies_hz.len() as f64;
        let mut sigma = DMatrix::zeros(self.channels, self.channels);
        for p in &self.processes {
            let power = |hz: &f64| p.shape.psd(*hz) * self.power(p.response, *hz);
            sigma += &p.enters * (frequencies_hz.iter().map(power).sum::<f64>() / count);
        }
        for error in &self.errors {
            let size = error.gain.ncols();
            let remaining = frequencies_hz.iter().map(|hz| self.remaining(error, *hz));
            let mean = remaining.fold(DMatrix::zeros(size, size), |sum, r| sum + r) / count;
            sigma += &error.gain * mean * error.gain.transpose();
        }
        sigma
    }

    /// Names of the components that [`Self::process_psd`] knows.
    pub fn process_names(&self) -> impl Iterator<Item = &str> {
        self.components.iter().map(|c| c.name.as_str())
    }

    /// Names of the components of each process that has several.
    pub fn vector_processes(&self) -> Vec<Vec<&str>> {
        let by_process = self.components.chunk_by(|a, b| a.declared == b.declared);
        let names = by_process.map(|own| own.iter().map(|c| c.name.as_str()).collect::<Vec<_>>());
        names.filter(|names| names.len() > 1).collect()
    }

    /// Whether an estimate that enters the channels is made from what this component drives.
    pub fn is_estimated(&self, name: &str) -> bool {
        self.components.iter().any(|c| c.name == name && c.estimated.is_some())
    }

    /// Per channel, whether the declared processes are all there is in it once the model is taken out; false for a
    /// channel into which a process of unknown spectrum enters, or none at all.
    pub fn residual(&self) -> &[bool] {
        &self.residual
    }

    /// A label per channel, the same for channels that a chain of common noises connects.
    pub fn groups(&self) -> Vec<usize> {
        let mut label: Vec<usize> = (0..self.channels).collect();
        let entries = self.processes.iter().map(|p| p.enters.clone());
        let entries = entries.chain(self.errors.iter().map(|e| &e.gain * e.gain.transpose()));
        for m in entries {
            for i in 0..self.channels {
                for j in (0..i).filter(|j| m[(i, *j)] != 0.0) {
                    let (keep, drop) = (label[j], label[i]);
                    label.iter_mut().filter(|l| **l == drop).for_each(|l| *l = keep);
                }
            }
        }
        label
    }

    fn power(&self, response: NoiseResponse, frequency_hz: f64) -> f64 {
        let [held, differenced] = responses(frequency_hz, self.dt_s);
        match response {
            NoiseResponse::Held => held,
            NoiseResponse::Differenced => differenced,
            NoiseResponse::Direct => 1.0,
        }
    }

    /// Spectra of the quantities and of their readout, `S_w` and `S_n`.
    fn spectra(&self, error: &EstimationError, frequency_hz: f64) -> (DMatrix<f64>, Option<DMatrix<f64>>) {
        let driven = &error.driven * (self.power(error.response, frequency_hz) * error.shape.psd(frequency_hz));
        let size = driven.nrows();
        let readout = error.readout.as_ref().map(|(shape, response)| {
            let level = self.power(*response, frequency_hz) * shape.psd(frequency_hz);
            DMatrix::from_diagonal_element(size, size, level)
        });
        (driven, readout)
    }

    /// The part of the estimated quantities that is not known, `S_n (S_w + S_n)⁻¹`: [`Self::remaining`] is this times
    /// `S_w`, and changes by this times a change of `S_w` times its transpose.
    fn unknown_part(&self, error: &EstimationError, frequency_hz: f64) -> DMatrix<f64> {
        let (sw, sn) = self.spectra(error, frequency_hz);
        let all = || DMatrix::identity(sw.nrows(), sw.nrows());
        let Some(sn) = sn else { return all() };
        (&sw + &sn).try_inverse().map_or_else(all, |inverse| sn * inverse)
    }

    /// `S_w − S_w (S_w + S_n)⁻¹ S_w = S_n (S_w + S_n)⁻¹ S_w`; the second form has no difference of near-equal matrices
    /// where the readout is good.
    fn remaining(&self, error: &EstimationError, frequency_hz: f64) -> DMatrix<f64> {
        let (sw, _) = self.spectra(error, frequency_hz);
        let r = self.unknown_part(error, frequency_hz) * sw;
        0.5 * (&r + r.transpose())
    }
}

fn is_any(numbers: &[f64]) -> bool {
    numbers.iter().any(|x| *x != 0.0)
}

/// Channels × components, zero for a channel that is not named.
fn gains<S: AsRef<str>>(channels: &[S], by_channel: &BTreeMap<String, Vec<f64>>, size: usize) -> DMatrix<f64> {
    let gain = |i: usize, k: usize| by_channel.get(channels[i].as_ref()).map_or(0.0, |row| row[k]);
    DMatrix::from_fn(channels.len(), size, gain)
}

fn matrix(rows: &[Vec<f64>], columns: usize) -> DMatrix<f64> {
    DMatrix::from_fn(rows.len(), columns, |i, j| rows[i][j])
}

/// The modelled noise in the bands of a plan: made once for as many estimates as there are.
pub struct BandNoise<'a> {
    /// At any frequency.
    pub model: &'a NoiseModel,
    /// Its mean over the bins of each band.
    pub(crate) mean: Vec<DMatrix<f64>>,
}

impl<'a> BandNoise<'a> {
    /// Of the bands of `plan`.
    pub fn new(model: &'a NoiseModel, plan: &Plan) -> Self {
        let mean = |band: &Band| {
            let bins: Vec<f64> = (band.first..band.end).map(|k| plan.hz(*band, k as f64)).collect();
            model.mean_psd(&bins)
        };
        Self { model, mean: plan.bands.iter().map(mean).collect() }
    }

    /// Mean over the bins of a band, channels × channels.
    pub fn mean(&self, band: usize) -> &DMatrix<f64> {
        &self.mean[band]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dragfree_schema::NoiseEstimate;

    const DT_S: f64 = 0.1;

    fn white(name: &str, asd: f64, response: NoiseResponse, channel: &str, gain: f64) -> NoiseProcess {
        NoiseProcess {
            name: name.to_owned(),
            spectrum: Some(NoiseShape::white(asd)),
            response,
            enters: [(channel.to_owned(), vec![gain])].into(),
            ..NoiseProcess::default()
        }
    }

    /// A process of ASD 3 drives a quantity by a factor of 2; an estimate of it, read with the ASD `readout`, enters
    /// the channel.
    fn estimated(readout: Option<f64>) -> NoiseProcess {
        NoiseProcess {
            components: vec!["driver".to_owned()],
            enters: BTreeMap::new(),
            estimate: Some(NoiseEstimate {
                matrix: vec![vec![2.0]],
                readout: readout.map(NoiseShape::white),
                readout_response: NoiseResponse::Differenced,
                enters: [("a".to_owned(), vec![0.5])].into(),
            }),
            ..white("driver", 3.0, NoiseResponse::Held, "a", 0.0)
        }
    }

    #[test]
    fn each_response_has_its_power() {
        let f = 1.3;
        let (sin, cos) = (std::f64::consts::PI * f * DT_S).sin_cos();
        for (response, power) in [
            (NoiseResponse::Held, cos * cos),
            (NoiseResponse::Differenced, 16.0 * sin.powi(4) / DT_S.powi(4)),
            (NoiseResponse::Direct, 1.0),
        ] {
            let model = NoiseModel::new(&[white("n", 2.0, response, "a", -3.0)], &["a"], DT_S).expect("a model");
            assert!((model.psd(f)[(0, 0)] / (36.0 * power) - 1.0).abs() < 1e-12, "{response:?}");
        }
    }

    /// `M C Mᵀ` of two components that are correlated, on three channels of which the second is not weighed; each
    /// component alone has its own variance.
    #[test]
    fn components_may_be_correlated() {
        let row = |a: f64, b: f64| vec![a, b];
        let process = NoiseProcess {
            components: vec!["n:1".to_owned(), "n:2".to_owned()],
            covariance: Some(vec![row(4.0, 1.0), row(1.0, 9.0)]),
            enters: [("a", row(1.0, 2.0)), ("b", row(5.0, 5.0)), ("c", row(0.0, 1.0))]
                .map(|(channel, row)| (channel.to_owned(), row))
                .into(),
            ..white("n", 1.0, NoiseResponse::Direct, "a", 1.0)
        };
        let model = NoiseModel::new(&[process], &["a", "c"], DT_S).expect("a model");
        assert_eq!(model.psd(1.0), DMatrix::from_row_slice(2, 2, &[44.0, 19.0, 19.0, 9.0]));
        let alone = model.process_psd("n:2", 1.0).expect("a component");
        assert_eq!(alone, DMatrix::from_row_slice(2, 2, &[36.0, 18.0, 18.0, 9.0]));
        assert_eq!((model.vector_processes(), model.groups()), (vec![vec!["n:1", "n:2"]], vec![0, 0]));
    }

    /// `S_n S_q/(S_n + S_q)` of a scalar: nothing with a perfect readout, all of `q` with a blind one or none.
    #[test]
    fn the_error_of_an_estimate_has_both_limits() {
        let f = 0.7;
        let (sin, cos) = (std::f64::consts::PI * f * DT_S).sin_cos();
        let all = 36.0 * cos * cos;
        let error = |readout| NoiseModel::new(&[estimated(readout)], &["a"], DT_S).expect("a model").psd(f)[(0, 0)];
        assert!(error(Some(1e-12)) < 1e-20 * all);
        assert!((error(Some(1e12)) / (0.25 * all) - 1.0).abs() < 1e-12);
        assert!((error(None) / (0.25 * all) - 1.0).abs() < 1e-12);
        let sn = 0.04 * 16.0 * sin.powi(4) / DT_S.powi(4);
        assert!((error(Some(0.2)) / (0.25 * sn * all / (sn + all)) - 1.0).abs() < 1e-12);
    }

    /// What a component is said to add is what Σ gains when a little more of it is declared, the estimate's error
    /// included.
    #[test]
    fn a_component_is_what_sigma_gains_by_a_little_more_of_it() {
        let model = |asd: f64| {
            let spectrum = Some(NoiseShape::white(asd));
            NoiseModel::new(&[NoiseProcess { spectrum, ..estimated(Some(0.2)) }], &["a"], DT_S).expect("a model")
        };
        let more = 1e-6_f64;
        let gained = (model(3.0 * (1.0 + more).sqrt()).psd(0.7) - model(3.0).psd(0.7)) / more;
        let named = model(3.0).process_psd("driver", 0.7).expect("a component");
        assert!((gained[(0, 0)] / named[(0, 0)] - 1.0).abs() < 1e-5);
        assert!(model(3.0).is_estimated("driver") && model(3.0).process_psd("another", 0.7).is_none());
    }

    #[test]
    fn a_channel_without_declared_noise_starts_white_and_is_no_residual() {
        let unknown = NoiseProcess { spectrum: None, ..white("motion", 0.0, NoiseResponse::Direct, "b", 1.0) };
        let own = |channel| white(channel, 1e-9, NoiseResponse::Direct, channel, 1.0);
        let model = NoiseModel::new(&[own("b"), own("c"), unknown], &["a", "b", "c"], DT_S).expect("a model");
        assert_eq!((model.unknown.as_slice(), model.residual()), (&[0][..], &[false, false, true][..]));
        assert_eq!(model.psd(0.1)[(0, 0)], 1.0);
        assert!((model.psd(0.1)[(1, 1)] / 1e-18 - 1.0).abs() < 1e-12);
    }

    #[test]
    fn a_declaration_that_contradicts_itself_is_refused_by_name() {
        let wrong =
            NoiseProcess { components: vec!["n:1".to_owned(); 2], ..white("n", 1.0, NoiseResponse::Held, "a", 1.0) };
        let refusal = NoiseModel::new(&[wrong], &["a"], DT_S).map(|_| ()).expect_err("two components, one column");
        assert!(refusal.to_string().contains("`n`"), "{refusal}");
    }
}
