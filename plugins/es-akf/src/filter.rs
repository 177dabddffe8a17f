//! The extended-state adaptive Kalman filter, equations Final_AKF_X_k to Final_AKF_p_k1, of `D` axes: those of one test
//! mass, as in the paper, or of several.
//!
//! # Two readings of the printed equations
//! * eq:Final_AKF_p_k1 carries `P_k`, the covariance of `X̂⁻_{k+1}`, to that of `X̂⁻_{k+2}`, so its `A_d` (and that of
//!   eq:Final_AKF_Q_ITER) belongs to the *next* interval. For a constant `A` that is no difference; here `A` holds the
//!   regressors of each interval, and with those of the last one `K` would follow an `α̂` one sample old. So the last
//!   three lines of an epoch run as the first of the next, when its regressors are known.
//! * eq:Final_AKF_Q_ITER needs `P̂_{k+1}` before eq:Final_AKF_p_k1 makes it: it is taken with `Q̂_{k−1}`.
//!
//! # Uncertainty
//! `P` is a covariance only if `Q̂` and `R̂` are those of the data, and the adaptation moves both for stability. A
//! second covariance `P̃` follows the gains that were used, under the noise of the mission file: the error covariance
//! of this estimator as far as that noise model holds, which the innovations test ([`Statistics::design_nis`]).
//!
//! # Definiteness
//! `Q` and `P` are tested every `check_epochs`: adaptation moves `Q̂` by `1 − α` a step, and an eigenvalue
//! decomposition costs far more than a step. `Q̂` is singular (one force drives `r` and `v`), so that one that adapts
//! by elements is slightly indefinite nearly every time.

use dragfree_sdk::state::{State, StateError};

use crate::definite::{Finding, repair};
use crate::kernel::{Columns, Matrix, Square, Transition, adapt, add_noise, advance, advance_joseph, inverse, mix};
use crate::model::Model;
use crate::octaves::Octaves;

/// How `Q̂` and `R̂` follow the innovations.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Adaptation {
    /// The paper's proposal: eqs Final_AKF_Q_K and Final_AKF_R_k.
    Monotone,
    /// eqs sage_husa_Q_update and sage_husa_R_update; nothing keeps `Q̂` and `R̂` positive, so that it can diverge.
    Innovation,
    /// eqs residual_Q_update and residual_R_update.
    Residual,
    /// `Q` and `R` stay those of the mission.
    Off,
}

/// What does not follow from the model.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Settings {
    /// How `Q̂` and `R̂` follow the innovations.
    pub adaptation: Adaptation,
    /// The paper's `α`, in (0, 1).
    pub forgetting: f64,
    /// Epochs after each (re-)acquisition before innovations are gated, and at first before anything is adapted.
    pub warm_up_epochs: u64,
    /// An innovation beyond so many σ is not used; 0 uses all.
    pub gate_sigma: f64,
    /// After so many rejections of a readout in a row the track is acquired anew.
    pub gate_patience: u32,
    /// Follow the covariance `P̃` of the gains in use beside `P`; without it a step costs half and σ is that of `P`.
    pub calibrated_sigma: bool,
    /// Epochs between two tests of `P` and `Q̂` for definiteness; 0 tests never.
    pub check_epochs: u64,
}

/// What acts between an epoch and the next.
#[derive(Clone, Copy, Debug)]
pub struct Drive<'a, const D: usize = 3> {
    /// `û`, mean over `[t_k, t_{k+1})`, ORF, m/s²; NaN where unknown.
    pub acceleration_m_s2: [f64; D],
    /// Regressor of each coefficient on each axis, mean over `[t_k, t_{k+1})`, ORF, m s⁻² per unit; NaN where unknown.
    pub regressors: &'a [[f64; D]],
}

/// What the filter counted and measured since its start.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Statistics<const D: usize = 3> {
    /// Epochs seen.
    pub epochs: u64,
    /// Epochs at which at least one readout was used.
    pub updates: u64,
    /// Epochs without any usable readout, or without a track.
    pub predictions: u64,
    /// Readouts (axes) that the gate refused.
    pub rejected: u64,
    /// Tracks begun after the first: gaps of `û` or the regressors, lock-outs of the gate.
    pub reacquisitions: u64,
    /// Times `Q̂` was indefinite and repaired.
    pub repairs_q: u64,
    /// Times `P` was indefinite and repaired.
    pub repairs_p: u64,
    /// Times the recursion broke down and `P`, `Q̂`, `R̂` began anew at their first values.
    pub resets: u64,
    /// Sum of `dᵀ S⁻¹ d` over the epochs after warm-up, `S` of the recursion.
    pub nis_sum: f64,
    /// Sum of `d_i² / S̃_ii` per readout, `S̃` from the mission's noise.
    pub design_sum: [f64; D],
    /// Readouts in `nis_sum`, per axis.
    pub readouts: [u64; D],
    /// Sum of `d_i / √S̃_ii` per readout.
    pub whitened_sum: [f64; D],
    /// `d_i / √S̃_ii` per readout, octave by octave.
    pub octaves: [Octaves; D],
}

impl<const D: usize> Default for Statistics<D> {
    fn default() -> Self {
        Self {
            epochs: 0,
            updates: 0,
            predictions: 0,
            rejected: 0,
            reacquisitions: 0,
            repairs_q: 0,
            repairs_p: 0,
            resets: 0,
            nis_sum: 0.0,
            design_sum: [0.0; D],
            whitened_sum: [0.0; D],
            readouts: [0; D],
            octaves: [Octaves::default(); D],
        }
    }
}

impl<const D: usize> Statistics<D> {
    /// Mean NIS per degree of freedom, gated samples excluded; `None` before the end of the warm-up.
    pub fn nis(&self) -> Option<f64> {
        let dof: u64 = self.readouts.iter().sum();
        (dof > 0).then(|| self.nis_sum / dof as f64)
    }

    /// Mean square of each readout's innovation against what the mission's noise predicts for the gains in use.
    pub fn design_nis(&self) -> [Option<f64>; D] {
        std::array::from_fn(|i| (self.readouts[i] > 0).then(|| self.design_sum[i] / self.readouts[i] as f64))
    }
}

/// The filter. The capacity `N ≥ model.states()` is a multiple of eight; see [`crate::tracker::follow`],
/// which chooses it.
#[derive(Clone, Debug)]
pub struct Filter<const N: usize, const D: usize = 3> {
    model: Model,
    settings: Settings,
    transition: Transition<N, D>,
    design_q: Matrix<N>,
    /// `R` of the mission's noise.
    design_r: Square<D>,
    /// Entries of the upper triangle of `Q` that are not zero.
    noise_entries: Vec<(usize, usize)>,
    /// Entries of the upper triangle of `Q̂` that can be other than zero.
    adapted_entries: Vec<(usize, usize)>,
    /// `X̂⁺`.
    x: [f64; N],
    /// `P_k`: covariance of the last epoch's `X̂⁻`.
    p: Matrix<N>,
    /// `Q̂_k`, upper triangle; what stands below it is not used.
    q: Matrix<N>,
    /// `R̂_k`.
    r: Square<D>,
    /// `Ŝ_k = E{d dᵀ}`.
    s_hat: Square<D>,
    /// `E{ε εᵀ}`, used by [`Adaptation::Residual`].
    e_hat: Square<D>,
    /// `P_k Hᵀ` at the last update.
    seen: Columns<N, D>,
    /// `K_k`, zero where no readout was used.
    gain: Columns<N, D>,
    /// `S⁻¹ = (H P_k Hᵀ + R̂_k)⁻¹`, zero where no readout was used.
    weight: Square<D>,
    /// Whether the last epoch may change `Q̂`.
    adapt: bool,
    /// `P̃`: like `P_k`, for the gains in use and the mission's noise.
    p_design: Matrix<N>,
    /// `P̃ Hᵀ` at the last update.
    seen_design: Columns<N, D>,
    /// `S̃ = H P̃ Hᵀ + R`.
    s_design: Square<D>,
    /// `û` of the interval that begins at the last epoch.
    u: [f64; D],
    /// Whether that interval's `û` and regressors are known.
    driven: bool,
    /// Whether `r` and `v` are tracked.
    tracking: bool,
    /// Epochs since the track began.
    age: u64,
    /// Epochs used to start `Ŝ`.
    s_samples: u64,
    /// Rejections in a row, per readout.
    refused: [u32; D],
    statistics: Statistics<D>,
    /// Scratch: `A P Aᵀ`.
    product: Matrix<N>,
}

impl<const N: usize, const D: usize> Filter<N, D> {
    const R: usize = Transition::<N, D>::R;
    const V: usize = Transition::<N, D>::V;
    const BIAS: usize = Transition::<N, D>::BIAS;
    const THETA: usize = Transition::<N, D>::THETA;

    /// A filter before its first epoch.
    ///
    /// # Panics
    /// When `D` is not the model's number of axes, or `N` is no multiple of eight or smaller than `model.states()`.
    pub fn new(model: Model, settings: Settings) -> Self {
        assert_eq!(D, model.axes(), "axes of the model");
        assert!(N.is_multiple_of(8) && model.states() <= N, "{} states do not fit into {N}", model.states());
        let mut filter = Self {
            transition: Transition::new(&model),
            design_q: Matrix::zero(),
            design_r: std::array::from_fn(|i| std::array::from_fn(|j| if i == j { model.readout_m2[i] } else { 0.0 })),
            noise_entries: Vec::new(),
            adapted_entries: Vec::new(),
            x: [0.0; N],
            p: Matrix::zero(),
            q: Matrix::zero(),
            r: [[0.0; D]; D],
            s_hat: [[0.0; D]; D],
            e_hat: [[0.0; D]; D],
            seen: [[0.0; N]; D],
            gain: [[0.0; N]; D],
            weight: [[0.0; D]; D],
            adapt: false,
            p_design: Matrix::zero(),
            seen_design: [[0.0; N]; D],
            s_design: [[0.0; D]; D],
            u: [0.0; D],
            driven: false,
            tracking: false,
            age: 0,
            s_samples: 0,
            refused: [0; D],
            statistics: Statistics::default(),
            product: Matrix::zero(),
            model,
            settings,
        };
        let design_q = &mut filter.design_q;
        filter.model.process_noise(|i, j, value| design_q.0[i][j] = value);
        let n = filter.model.states();
        let upper = || (0..n).flat_map(|i| (i..n).map(move |j| (i, j)));
        filter.noise_entries = upper().filter(|&(i, j)| design_q.0[i][j] != 0.0).collect();
        filter.adapted_entries = match settings.adaptation {
            Adaptation::Monotone | Adaptation::Off => filter.noise_entries.clone(),
            Adaptation::Innovation | Adaptation::Residual => upper().collect(),
        };
        filter.begin_covariances();
        for (j, c) in filter.model.coefficients.iter().enumerate() {
            filter.x[Self::THETA + j] = c.initial;
        }
        filter
    }

    /// `P`, `P̃`, `Q̂`, `R̂` at their first values.
    fn begin_covariances(&mut self) {
        self.p = Matrix::zero();
        let p = &mut self.p;
        self.model.prior_covariance(|i, j, value| p.0[i][j] = value);
        self.p_design = self.p.clone();
        self.q = self.design_q.clone();
        self.r = self.design_r;
        self.s_hat = [[0.0; D]; D];
        self.e_hat = self.r;
        self.s_samples = 0;
        self.forget_measurement();
    }

    /// One epoch: from `X̂⁺_k` and the drive of `[t_k, t_{k+1})` to the readout at `t_{k+1}`, and on with the drive
    /// that begins there. `readout_m` is the measured displacement, NaN where missing.
    pub fn step(&mut self, readout_m: [f64; D], next: Drive<'_, D>) {
        if self.statistics.epochs > 0 {
            if self.tracking && self.driven {
                self.time_update();
                self.transition.state(&mut self.x, &self.u);
            } else {
                self.drift();
            }
        }
        self.statistics.epochs += 1;
        self.set_drive(next);
        if self.tracking {
            self.age += 1;
            self.measure(readout_m);
        } else if self.driven {
            self.acquire(readout_m);
        } else {
            self.statistics.predictions += 1;
        }
        let every = self.settings.check_epochs;
        if every > 0 && self.statistics.epochs.is_multiple_of(every) {
            self.check();
        }
    }

    /// `epochs` without any data, as between two days with one missing: `a_b` and `n` walk on, `r` and `v` are lost.
    pub fn skip(&mut self, epochs: u64) {
        if epochs == 0 {
            return;
        }
        self.driven = false;
        self.drift();
        for i in Self::BIAS..Self::THETA {
            let walked = self.model.bias_step_m2_s4 * (epochs - 1) as f64;
            self.p.0[i][i] += walked;
            self.p_design.0[i][i] += walked;
        }
        // Noise of minutes to days has no memory of the other side of such a gap.
        for i in Self::THETA + self.model.coefficients.len()..self.model.states() {
            self.x[i] = 0.0;
            clear(&mut self.p, i);
            clear(&mut self.p_design, i);
        }
        let after = Self::THETA + self.model.coefficients.len();
        let (p, p_design) = (&mut self.p, &mut self.p_design);
        self.model.prior_covariance(|i, j, value| {
            if i >= after {
                p.0[i][j] = value;
                p_design.0[i][j] = value;
            }
        });
    }

    /// Stores what acts until the next epoch.
    fn set_drive(&mut self, next: Drive<'_, D>) {
        self.u = next.acceleration_m_s2;
        self.driven = self.u.iter().chain(next.regressors.iter().flatten()).all(|x| x.is_finite());
        if self.driven {
            self.transition.phi[..next.regressors.len()].copy_from_slice(next.regressors);
        }
    }

    /// eqs Final_AKF_Q_ITER, Final_AKF_Q_K and Final_AKF_p_k1 of the last epoch, with the `A` of the interval now
    /// known.
    fn time_update(&mut self) {
        let has_design = self.has_design_covariance();
        let product = &mut self.product;
        self.transition.conjugate(&self.p, product);
        let m = self.transition.columns(&self.seen);
        let w = mix(&self.weight, &m);
        if self.adapt {
            let y = mix(&self.s_hat, &self.gain);
            let (alpha, q, entries) = (self.settings.forgetting, &mut self.q, &self.adapted_entries);
            let (by_w, by_k) = ([&w, &m], [&y, &self.gain]);
            match self.settings.adaptation {
                // min{|·|, 0} = 0: what is no noise in the model never becomes one.
                Adaptation::Monotone => adapt(q, entries, by_w, by_k, |q, q_iter, _| {
                    let size = q_iter.abs();
                    alpha * q + (1.0 - alpha) * if size < q { size } else { q }
                }),
                Adaptation::Innovation => {
                    adapt(q, entries, by_w, by_k, |q, q_iter, _| alpha * q + (1.0 - alpha) * q_iter);
                }
                Adaptation::Residual => adapt(q, entries, by_w, by_k, |q, _, ksk| alpha * q + (1.0 - alpha) * ksk),
                Adaptation::Off => {}
            }
        }
        add_noise(product, &self.q, &self.adapted_entries);
        advance(&mut self.p, product, &w, &m);
        if !has_design {
            return;
        }
        self.transition.conjugate(&self.p_design, product);
        add_noise(product, &self.design_q, &self.noise_entries);
        let m = self.transition.columns(&self.seen_design);
        advance_joseph(&mut self.p_design, product, &w, &m, &self.s_design);
    }

    /// The covariance `P̃` of the gains in use under the mission's noise; `P` itself when nothing adapts.
    fn design_covariance(&self) -> &Matrix<N> {
        if self.has_design_covariance() { &self.p_design } else { &self.p }
    }

    /// Whether `P̃` differs from `P` and is followed.
    fn has_design_covariance(&self) -> bool {
        self.settings.calibrated_sigma && self.settings.adaptation != Adaptation::Off
    }

    /// Without `û` or regressors: `a_b`, `θ` and `n` go on, `r` and `v` fall back to their prior.
    fn drift(&mut self) {
        self.transition.phi[..self.model.coefficients.len()].fill([0.0; D]);
        self.adapt = false;
        self.time_update();
        self.transition.state(&mut self.x, &[0.0; D]);
        self.forget_measurement();
        self.lose_track();
    }

    /// Nothing of the last epoch is left to be carried to the next.
    fn forget_measurement(&mut self) {
        self.statistics.octaves.iter_mut().for_each(Octaves::interrupt);
        self.gain = [[0.0; N]; D];
        self.weight = [[0.0; D]; D];
        self.adapt = false;
    }

    fn lose_track(&mut self) {
        self.tracking = false;
        for i in 0..D {
            for (s, sigma) in
                [(Self::R + i, self.model.prior.displacement_m), (Self::V + i, self.model.prior.velocity_m_s)]
            {
                self.x[s] = 0.0;
                for p in [&mut self.p, &mut self.p_design] {
                    clear(p, s);
                    p.0[s][s] = sigma * sigma;
                }
            }
        }
    }

    /// Begins a track at a complete readout.
    fn acquire(&mut self, readout_m: [f64; D]) {
        self.forget_measurement();
        self.statistics.predictions += 1;
        if !readout_m.iter().all(|z| z.is_finite()) {
            return;
        }
        self.lose_track();
        let coloured = self.transition.observe(&self.x);
        for i in 0..D {
            self.x[Self::R + i] = readout_m[i] - coloured[i];
        }
        self.tracking = true;
        self.age = 0;
        self.refused = [0; D];
        if self.statistics.updates > 0 {
            self.statistics.reacquisitions += 1;
        }
    }

    /// eqs Final_AKF_D_k to Final_AKF_x_k1.
    fn measure(&mut self, readout_m: [f64; D]) {
        let settled = self.age > self.settings.warm_up_epochs;
        let predicted = self.transition.observe(&self.x);
        let c = self.transition.observed(&self.p);
        let hph = self.transition.observed_twice(&c);
        let mut d = [0.0; D];
        let mut used = [false; D];
        let mut complete = true;
        for i in 0..D {
            d[i] = readout_m[i] - predicted[i];
            let present = d[i].is_finite();
            let refused = present && settled && self.beyond_gate(d[i], hph[i][i] + self.r[i][i], self.s_hat[i][i]);
            used[i] = present && !refused;
            complete &= used[i];
            if !used[i] {
                d[i] = 0.0;
            }
            if present {
                self.refused[i] = if refused { self.refused[i] + 1 } else { 0 };
                self.statistics.rejected += u64::from(refused);
            }
        }
        if self.refused.iter().any(|&n| n >= self.settings.gate_patience) {
            self.acquire(readout_m);
            return;
        }
        if used == [false; D] {
            self.forget_measurement();
            self.statistics.predictions += 1;
            return;
        }
        self.adapt = complete && self.learn_innovation(&d);
        if self.adapt {
            self.adapt_readout_noise(&hph);
        }
        let s = sum(&hph, &self.r);
        let Some(weight) = inverse(&s, used) else {
            self.recover();
            return;
        };
        self.weight = weight;
        self.gain = mix(&self.weight, &c);
        self.seen = c;
        for i in 0..D {
            for l in 0..N {
                self.x[l] += self.gain[i][l] * d[i];
            }
        }
        if self.adapt && self.settings.adaptation == Adaptation::Residual {
            self.adapt_by_residual(&readout_m, &hph);
        }
        self.statistics.updates += 1;
        self.measure_consistency(&d, &s, used, settled);
    }

    /// Whether an innovation is beyond the gate, against the larger of the model's and the observed variance.
    fn beyond_gate(&self, d: f64, model: f64, observed: f64) -> bool {
        let n = self.settings.gate_sigma;
        n > 0.0 && d * d > n * n * model.max(observed)
    }

    /// `Ŝ_k = α Ŝ_{k−1} + (1 − α) d dᵀ`, begun at the mean over the second half of the warm-up. False until then,
    /// and in the first half of each later warm-up, when the innovations are those of an unknown velocity.
    fn learn_innovation(&mut self, d: &[f64; D]) -> bool {
        let warm_up = self.settings.warm_up_epochs;
        if self.age <= warm_up / 2 || self.settings.adaptation == Adaptation::Off {
            return false;
        }
        let first = self.s_samples < (warm_up - warm_up / 2).max(1);
        let fresh = if first { 1.0 / (self.s_samples + 1) as f64 } else { 1.0 - self.settings.forgetting };
        for i in 0..D {
            for j in 0..D {
                self.s_hat[i][j] += fresh * (d[i] * d[j] - self.s_hat[i][j]);
            }
        }
        if first {
            self.s_samples += 1;
        }
        !first
    }

    /// eqs Final_AKF_R_ITER and Final_AKF_R_k, or eq:sage_husa_R_update.
    fn adapt_readout_noise(&mut self, hph: &Square<D>) {
        let alpha = self.settings.forgetting;
        for i in 0..D {
            for j in 0..D {
                let r = self.r[i][j];
                let r_iter = (1.0 - alpha) * (self.s_hat[i][j] - hph[i][j]);
                match self.settings.adaptation {
                    Adaptation::Monotone => self.r[i][j] = alpha * r + r_iter.abs().min(r),
                    Adaptation::Innovation => self.r[i][j] = alpha * r + r_iter,
                    Adaptation::Residual | Adaptation::Off => {}
                }
            }
        }
    }

    /// eqs residual_def and residual_R_update: `ε` needs `K`, so this `R̂` serves from the next epoch on.
    fn adapt_by_residual(&mut self, readout_m: &[f64; D], hph: &Square<D>) {
        let alpha = self.settings.forgetting;
        let after = self.transition.observe(&self.x);
        let e: [f64; D] = std::array::from_fn(|i| readout_m[i] - after[i]);
        for i in 0..D {
            for j in 0..D {
                self.e_hat[i][j] = alpha * self.e_hat[i][j] + (1.0 - alpha) * e[i] * e[j];
                self.r[i][j] = alpha * self.r[i][j] + (1.0 - alpha) * (self.e_hat[i][j] + hph[i][j]);
            }
        }
    }

    fn measure_consistency(&mut self, d: &[f64; D], s: &Square<D>, used: [bool; D], settled: bool) {
        if self.has_design_covariance() {
            self.seen_design = self.transition.observed(&self.p_design);
            let hph = self.transition.observed_twice(&self.seen_design);
            self.s_design = sum(&hph, &self.design_r);
        } else {
            self.s_design = *s;
        }
        if !settled {
            return;
        }
        let s = &mut self.statistics;
        for i in 0..D {
            for j in 0..D {
                s.nis_sum += d[i] * self.weight[i][j] * d[j];
            }
            if used[i] {
                let whitened = d[i] / self.s_design[i][i].sqrt();
                s.design_sum[i] += d[i] * d[i] / self.s_design[i][i];
                s.whitened_sum[i] += whitened;
                s.readouts[i] += 1;
                s.octaves[i].push(whitened);
            } else {
                s.octaves[i].interrupt();
            }
        }
    }

    /// Tests `P` and `Q̂`, and repairs them.
    fn check(&mut self) {
        let n = self.model.states();
        let (q, p) = (repair(&mut self.q, n), repair(&mut self.p, n));
        self.statistics.repairs_q += u64::from(q == Finding::Repaired);
        if q == Finding::Repaired && self.settings.adaptation == Adaptation::Monotone {
            // The nearest definite matrix has the blocks of the indefinite one; what stands outside is rounding.
            let mut kept = Matrix::zero();
            for &(i, j) in &self.noise_entries {
                kept.0[i][j] = self.q.0[i][j];
            }
            self.q = kept;
        }
        self.statistics.repairs_p += u64::from(p == Finding::Repaired);
        if q == Finding::NotFinite || p == Finding::NotFinite || !self.x.iter().all(|x| x.is_finite()) {
            self.reset();
        }
    }

    /// `S` is not positive definite: repairs what can be repaired, else begins anew. The epoch is not used.
    fn recover(&mut self) {
        self.forget_measurement();
        self.statistics.predictions += 1;
        let before = self.statistics.repairs_p;
        self.check();
        if self.tracking && self.statistics.repairs_p == before {
            self.reset();
        }
    }

    /// All covariances at their first values, the track lost; the coefficients keep what is finite of their estimate.
    fn reset(&mut self) {
        self.begin_covariances();
        for i in 0..N {
            let initial = if i < Self::THETA {
                0.0
            } else {
                self.model.coefficients.get(i - Self::THETA).map_or(0.0, |c| c.initial)
            };
            if !self.x[i].is_finite() {
                self.x[i] = initial;
            }
        }
        self.lose_track();
        self.statistics.resets += 1;
    }

    /// The model.
    pub fn model(&self) -> &Model {
        &self.model
    }

    /// Counts and consistency.
    pub fn statistics(&self) -> &Statistics<D> {
        &self.statistics
    }

    /// `X̂⁺`, its first `model.states()` entries.
    pub fn state(&self) -> &[f64] {
        &self.x[..self.model.states()]
    }

    /// Estimates of the coefficients.
    pub fn coefficients(&self) -> &[f64] {
        &self.x[Self::THETA..][..self.model.coefficients.len()]
    }

    /// Estimate of the displacement `r`, ORF, m.
    pub fn displacement_m(&self) -> &[f64] {
        &self.x[Self::R..Self::V]
    }

    /// `P_k[i][j]`, of `X̂⁻` at the last epoch.
    pub fn covariance(&self, i: usize, j: usize) -> f64 {
        self.p.0[i][j]
    }

    /// `Q̂[i][j]`.
    pub fn process_noise(&self, i: usize, j: usize) -> f64 {
        self.q.0[i.min(j)][i.max(j)]
    }

    /// `R̂`.
    pub fn readout_noise(&self) -> &Square<D> {
        &self.r
    }

    /// Covariance of coefficients `i` and `j` as the recursion has it, before the last epoch's readout.
    pub fn recursion_covariance(&self, i: usize, j: usize) -> f64 {
        self.p.0[Self::THETA + i][Self::THETA + j]
    }

    /// Covariance of coefficients `i` and `j` for the gains in use and the mission's noise, before the last epoch's
    /// readout.
    pub fn coefficient_covariance(&self, i: usize, j: usize) -> f64 {
        self.design_covariance().0[Self::THETA + i][Self::THETA + j]
    }

    /// Whether a track has been found.
    pub fn is_tracking(&self) -> bool {
        self.tracking
    }

    /// Visits all that the next epoch depends on.
    pub(crate) fn visit(&mut self, state: &mut State<'_>) -> Result<(), StateError> {
        state.f64s(&mut self.x)?;
        for matrix in [&mut self.p, &mut self.q, &mut self.p_design] {
            state.f64s(matrix.0.as_flattened_mut())?;
        }
        for square in [&mut self.r, &mut self.s_hat, &mut self.e_hat, &mut self.weight, &mut self.s_design] {
            state.f64s(square.as_flattened_mut())?;
        }
        for columns in [&mut self.seen, &mut self.seen_design, &mut self.gain] {
            state.f64s(columns.as_flattened_mut())?;
        }
        state.f64s(self.transition.phi.as_flattened_mut())?;
        state.f64s(&mut self.u)?;
        for flag in [&mut self.adapt, &mut self.driven, &mut self.tracking] {
            state.flag(flag)?;
        }
        for n in [&mut self.age, &mut self.s_samples] {
            state.u64(n)?;
        }
        self.refused.iter_mut().try_for_each(|n| state.u32(n))?;
        let s = &mut self.statistics;
        for n in [
            &mut s.epochs,
            &mut s.updates,
            &mut s.predictions,
            &mut s.rejected,
            &mut s.reacquisitions,
            &mut s.repairs_q,
            &mut s.repairs_p,
            &mut s.resets,
        ] {
            state.u64(n)?;
        }
        s.readouts.iter_mut().try_for_each(|n| state.u64(n))?;
        state.f64(&mut s.nis_sum)?;
        state.f64s(&mut s.design_sum)?;
        state.f64s(&mut s.whitened_sum)?;
        s.octaves.iter_mut().try_for_each(|octaves| octaves.visit(state))
    }
}

fn sum<const D: usize>(a: &Square<D>, b: &Square<D>) -> Square<D> {
    std::array::from_fn(|i| std::array::from_fn(|j| a[i][j] + b[i][j]))
}

/// Zeroes row and column `i`.
fn clear<const N: usize>(p: &mut Matrix<N>, i: usize) {
    p.0[i] = [0.0; N];
    for row in p.0.iter_mut() {
        row[i] = 0.0;
    }
}
