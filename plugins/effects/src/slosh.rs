//! Effect `slosh`: propellant that oscillates in its tank, driven by the spacecraft's acceleration.
//!
//! A slug of mass ratio μ adds to the spacecraft the acceleration `c s`, `c = μ/(1 − μ)`, where `s = −ẍ` is the output
//! of `ẍ + 2ZΩ ẋ + Ω² x = −F/m_S` and F the known force; Methods, "Slosh". Test masses show `z_i = −c T_S^{O_i} e s`.
//! The parameters `f0_hz` = Ω/2π and `zeta` = Z are those of the resonance with the spacecraft free.
//!
//! F contains thrusters, sunlight and the electrodes' recoil. Thruster noise drives the mode too, which changes the
//! noise spectrum common to the test masses ([`Colour`]). **Range** of c: 0 to 0.3. **Confounders**: `mps-gain`, whose
//! response is the same far above the resonance.

use std::f64::consts::TAU;

use dragfree_physics::mission::Mission;
use dragfree_sdk::prelude::*;
use serde_json::json;

use crate::common::{
    AXES, SeriesRef, axis_of, keep_available, manifest, mission, responses_to_spacecraft_force, skipped_rows,
};

const MAX_RATIO: f64 = 0.3;
/// Longest gap over which the last force is held, s; after a longer one the slug starts at rest.
const MAX_HOLD_S: f64 = 60.0;
/// Resonances of a candidate, Hz, and their damping ratios.
const FIRST_HZ: f64 = 0.005;
const LAST_HZ: f64 = 0.2;
const ZETAS: [f64; 1] = [0.05];
/// Spacing of the grid in half widths of a resonance. It trades the cost of a series at the full rate per point against
/// sensitivity between points, where the host fits mixtures of neighbours. It refines a detection with `fine` = 1.
const SPACING_PER_ZETA: f64 = 2.5;
/// Fine grid: relative half width about a detected resonance, and step.
const FINE_HALF_WIDTH: f64 = 0.15;
const FINE_STEP: f64 = 0.025;
const FINE_ZETAS: [f64; 3] = [0.01, 0.02, 0.05];

/// Grid of a candidate: resonance, Hz, and damping ratio.
pub(crate) fn grid() -> impl Iterator<Item = (f64, f64)> {
    ZETAS.into_iter().flat_map(|zeta| {
        let steps = ((LAST_HZ / FIRST_HZ).ln() / (SPACING_PER_ZETA * zeta).ln_1p()).ceil();
        let ratio = (LAST_HZ / FIRST_HZ).powf(1.0 / steps);
        // Rounding to 1 µHz, far below the narrowest width.
        let digits = |f: f64| (f * 1e6).round() / 1e6;
        (0..=steps as i32).map(move |i| (digits(FIRST_HZ * ratio.powi(i)), zeta))
    })
}

/// Fine grid about a detected resonance.
pub(crate) fn fine_grid(f0_hz: f64) -> impl Iterator<Item = (f64, f64)> {
    let steps = (FINE_HALF_WIDTH / FINE_STEP).round() as i32;
    let digits = |f: f64| (f * 1e7).round() / 1e7;
    FINE_ZETAS
        .into_iter()
        .flat_map(move |zeta| (-steps..=steps).map(move |i| (digits(f0_hz * (1.0 + FINE_STEP).powi(i)), zeta)))
}

/// Output `s = −ẍ` of `ẍ + 2ZΩẋ + Ω²x = −a`, mean over samples, exact for `a` held over each sample.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Mode {
    /// Transition matrix of `(x, ẋ)` about the rest over one sample.
    transition: [[f64; 2]; 2],
    /// Rest position for `a = 1`, s².
    rest_s2: f64,
    dt_s: f64,
    state: [f64; 2],
}

impl Mode {
    /// A resonance at `f0_hz` with damping ratio `zeta` below 1.
    pub(crate) fn new(f0_hz: f64, zeta: f64, dt_s: f64) -> Self {
        let (omega, damped) = (TAU * f0_hz, TAU * f0_hz * (1.0 - zeta * zeta).sqrt());
        let (decay, (sin, cos)) = ((-zeta * omega * dt_s).exp(), (damped * dt_s).sin_cos());
        let (s, ratio) = (decay * sin / damped, zeta * omega);
        let transition = [[decay * cos + ratio * s, s], [-omega * omega * s, decay * cos - ratio * s]];
        Self { transition, rest_s2: -1.0 / (omega * omega), dt_s, state: [0.0; 2] }
    }

    /// Sets the rest state under `a`.
    pub(crate) fn settle(&mut self, a: f64) {
        self.state = [self.rest_s2 * a, 0.0];
    }

    /// Advances by a sample with input `a`; returns the mean of `−ẍ` over it.
    pub(crate) fn step(&mut self, a: f64) -> f64 {
        let [x, v] = [self.state[0] - self.rest_s2 * a, self.state[1]];
        let [to_x, to_v] = self.transition;
        self.state = [self.rest_s2 * a + to_x[0] * x + to_x[1] * v, to_v[0] * x + to_v[1] * v];
        (v - self.state[1]) / self.dt_s
    }
}

/// Colouring of the thrusters' force noise by the response of [`Mode`], `s²/(s² + 2ZΩs + Ω²)`.
fn colour(instance: &str, (f0_hz, zeta): (f64, f64)) -> Colour {
    let omega = TAU * f0_hz;
    Colour {
        process: format!("thruster_force:{instance}"),
        numerator: vec![0.0, 0.0, 1.0],
        denominator: vec![omega * omega, 2.0 * zeta * omega, 1.0],
    }
}

/// The effect.
#[derive(Debug)]
pub(crate) struct Slosh {
    setup: Setup,
    mission: Mission,
    /// Columns and factors that add up to the force on the spacecraft along the axis, N.
    force_terms: Vec<(In, f64)>,
    modes: Vec<(Mode, Out)>,
    /// Last known force over the spacecraft's mass, m s⁻²; NaN before the first and after a long gap.
    last_input: f64,
    /// Rows since that force.
    missing: u64,
    last_ns: i64,
}

impl Slosh {
    fn name(&self) -> String {
        format!("slosh:{}", self.setup.instance())
    }

    /// Requests the terms of `F_T + F_SRP − Σ T_{O_j}^S F_Ej` along the axis (eq:TM_SC_relative_acceleration).
    fn link_force(&mut self, available: &Available, link: &mut EffectLink<'_, '_>) -> Result<(), PluginError> {
        let axis = axis_of(self.setup.instance());
        let thrust = Want::new(format!("used.mps_force_srf_n.{}", AXES[axis])).unit("N").frame("SRF");
        self.force_terms = vec![(link.read(&thrust)?, 1.0)];
        if let Some(pressure) = &self.mission.solar_pressure {
            let sun = Want::new(format!("used.sun_srf.{}", AXES[axis])).unit("1").frame("SRF");
            if let Some(sun) = link.read_if_available(available, &sun)? {
                self.force_terms.push((sun, pressure.force_n));
            }
        }
        for (name, tm) in &self.mission.test_mass {
            let frame = self.mission.frame(name);
            let srf_from_orf = tm.dcm_orf_from_srf().transpose();
            for (j, letter) in AXES.iter().enumerate() {
                let push = Want::new(format!("used.{name}.force_orf_n.{letter}")).unit("N").frame(&frame);
                if srf_from_orf[(axis, j)] != 0.0
                    && let Some(push) = link.read_if_available(available, &push)?
                {
                    self.force_terms.push((push, -srf_from_orf[(axis, j)]));
                }
            }
        }
        Ok(())
    }

    /// Responses to one resonance; registers its series.
    fn responses(
        &mut self,
        (f0_hz, zeta): (f64, f64),
        available: &Available,
        link: &mut EffectLink<'_, '_>,
    ) -> Result<Vec<Response>, PluginError> {
        let name = format!("slosh({},{f0_hz},{zeta})", self.setup.instance());
        let (table, out) = link.shared_series(available, &name, "m s-2", "SRF")?;
        if let Some(out) = out {
            self.modes.push((Mode::new(f0_hz, zeta, self.mission.dt_s()), out));
        }
        let mut responses =
            responses_to_spacecraft_force(&self.mission, axis_of(self.setup.instance()), &(table, name));
        // The series is an acceleration of the spacecraft rather than a force.
        responses.iter_mut().for_each(|r| r.factor *= self.mission.spacecraft.mass_kg);
        keep_available(available, &self.name(), responses)
    }

    /// Handles gaps before a row with the acceleration `a` by the known force; false if `a` is missing.
    fn advance_gaps(&mut self, now_ns: i64, a: f64) -> bool {
        let dt_s = self.mission.dt_s();
        let max_missing = (MAX_HOLD_S / dt_s) as u64;
        let skipped = skipped_rows(self.last_ns, now_ns, dt_s);
        self.missing = self.missing.saturating_add(skipped);
        self.last_ns = now_ns;
        let known = a.is_finite();
        if self.missing > max_missing {
            self.last_input = f64::NAN;
        }
        if self.last_input.is_finite() {
            for _ in 0..skipped {
                for (mode, _) in &mut self.modes {
                    mode.step(self.last_input);
                }
            }
        } else if known {
            self.modes.iter_mut().for_each(|(mode, _)| mode.settle(a));
        }
        if known {
            (self.last_input, self.missing) = (a, 0);
        } else {
            self.missing = self.missing.saturating_add(1);
        }
        known
    }
}

impl Effect for Slosh {
    const MANIFEST: Manifest = manifest(
        "slosh",
        "Propellant slosh along an axis, driven by the spacecraft's acceleration",
        &[
            Parameter::f64("f0_hz", "Hz", 0.03, 1e-4..=2.0, "resonance frequency with the spacecraft free"),
            Parameter::f64("zeta", "1", 0.02, 1e-4..=0.9, "damping ratio of that resonance"),
            Parameter::i64("fine", "1", 0, 0..=1, "1 to search a fine grid about f0_hz only, for candidates"),
        ],
        &["sc.x", "sc.y"],
        &["commands"],
    );

    fn new(setup: &Setup) -> Result<Self, PluginError> {
        Ok(Self {
            setup: setup.clone(),
            mission: mission(setup)?,
            force_terms: Vec::new(),
            modes: Vec::new(),
            last_input: f64::NAN,
            missing: 0,
            last_ns: 0,
        })
    }

    fn link(&mut self, available: &Available, link: &mut EffectLink<'_, '_>) -> Result<(), PluginError> {
        keep_available(
            available,
            &self.name(),
            responses_to_spacecraft_force(&self.mission, 0, &SeriesRef::default()),
        )?;
        self.link_force(available, link)?;
        let mut coefficient = Coefficient {
            name: format!("slosh.{}", self.setup.instance()),
            lower: 0.0,
            upper: MAX_RATIO,
            prior_sigma: MAX_RATIO / 3.0,
            ..Coefficient::default()
        };
        let shape = |(f0_hz, zeta): (f64, f64)| {
            Shape::from([("f0_hz".to_owned(), json!(f0_hz)), ("zeta".to_owned(), json!(zeta))])
        };
        let point = (self.setup.f64("f0_hz")?, self.setup.f64("zeta")?);
        if self.setup.candidate() {
            let fine = self.setup.i64("fine")? == 1;
            let points: Vec<(f64, f64)> = if fine { fine_grid(point.0).collect() } else { grid().collect() };
            for point in points {
                let responses = self.responses(point, available, link)?;
                let colours = Some(colour(self.setup.instance(), point));
                coefficient.variants.push(Variant { shape: shape(point), responses, colours, ..Variant::default() });
            }
        } else {
            (coefficient.shape, coefficient.responses) = (shape(point), self.responses(point, available, link)?);
            coefficient.colours = Some(colour(self.setup.instance(), point));
        }
        link.coefficient(&coefficient)
    }

    fn process(&mut self, input: &Inputs<'_>, output: &mut Outputs) -> Result<(), PluginError> {
        let times = input.time_ns();
        let mut acceleration = vec![0.0; times.len()];
        for (column, factor) in &self.force_terms {
            let factor = factor / self.mission.spacecraft.mass_kg;
            acceleration.iter_mut().zip(input.f64(*column)).for_each(|(a, x)| *a += factor * x);
        }
        let mut start = 0;
        while start < times.len() {
            // One row alone if it lacks a force or follows a gap, then all regular rows, mode by mode.
            let known = self.advance_gaps(times[start], acceleration[start]);
            let mut end = start + 1;
            let step_ns = (self.mission.dt_s() * 1.5e9) as i64;
            if known {
                while end < times.len() && acceleration[end].is_finite() && times[end] - times[end - 1] < step_ns {
                    end += 1;
                }
                (self.last_input, self.last_ns) = (acceleration[end - 1], times[end - 1]);
            }
            let last_input = self.last_input;
            for (mode, out) in &mut self.modes {
                let column = output.f64(*out);
                if known {
                    column.extend(acceleration[start..end].iter().map(|a| mode.step(*a)));
                } else {
                    if last_input.is_finite() {
                        mode.step(last_input);
                    }
                    column.push(f64::NAN);
                }
            }
            start = end;
        }
        Ok(())
    }

    fn state(&mut self, state: &mut State<'_>) -> Result<(), PluginError> {
        state.f64(&mut self.last_input)?;
        state.u64(&mut self.missing)?;
        state.i64(&mut self.last_ns)?;
        Ok(self.modes.iter_mut().try_for_each(|(mode, _)| state.f64s(&mut mode.state))?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Reference: each body's own equation of motion in small steps, without the mode's resonance or exponentials.
    #[test]
    fn mode_output_matches_two_body_dynamics() {
        let (mass_kg, mu, f0_hz, zeta, dt_s) = (1500.0, 0.2_f64, 0.4, 0.1, 0.1);
        let (slug_kg, rest_kg) = (mass_kg * mu, mass_kg * (1.0 - mu));
        let omega = TAU * f0_hz;
        let raised = (1.0 - mu).sqrt();
        let mut mode = Mode::new(f0_hz / raised, zeta / raised, dt_s);
        let coefficient = mu / (1.0 - mu);
        let (mut x, mut v, steps) = (0.0, 0.0, 20_000);
        let (h, mut worst, mut scale, mut first_order) = (dt_s / f64::from(steps), 0.0_f64, 0.0_f64, 0.0_f64);
        for k in 0..60 {
            let force_n = if k < 30 { 1e-4 } else { -2e-4 * (0.7 * f64::from(k)).sin() };
            let mut gained = 0.0;
            for _ in 0..steps {
                // Midpoint rule.
                let slug = |x: f64, v: f64| {
                    let spring_n = slug_kg * (omega * omega * x + 2.0 * zeta * omega * v);
                    let a = (force_n + spring_n) / rest_kg;
                    (a, -spring_n / slug_kg - a)
                };
                let (_, w) = slug(x, v);
                let (a, w) = slug(x + 0.5 * h * v, v + 0.5 * h * w);
                x += h * (v + 0.5 * h * w);
                v += h * w;
                gained += h * a;
            }
            let more = gained / dt_s - force_n / mass_kg;
            let s = mode.step(force_n / mass_kg);
            worst = worst.max((more - coefficient * s).abs());
            first_order = first_order.max((more - mu * s).abs());
            scale = scale.max(more.abs());
        }
        assert!(worst < 1e-6 * scale, "{worst:e} of {scale:e}");
        assert!(first_order > 0.1 * scale, "μ for μ/(1 − μ) would be seen");
    }

    #[test]
    fn a_settled_slug_has_no_effect_under_constant_force() {
        let mut mode = Mode::new(0.03, 0.02, 0.1);
        mode.settle(3e-7);
        for _ in 0..1000 {
            assert!(mode.step(3e-7).abs() < 1e-20);
        }
        // Far above its resonance the slug does not move and the spacecraft is lighter by it.
        let mut mode = Mode::new(1e-4, 0.02, 0.1);
        assert!((mode.step(3e-7) - 3e-7).abs() < 1e-12);
    }

    /// Reference: the settled response to a sine wave. The mode works with means over samples, hence the tolerance.
    #[test]
    fn the_colouring_is_the_response_of_the_mode() {
        let (f0_hz, zeta, dt_s) = (0.03, 0.05, 0.1);
        let colour = colour("sc.y", (f0_hz, zeta));
        assert_eq!(colour.process, "thruster_force:sc.y");
        for hz in [0.01, 0.029, 0.03, 0.033, 0.15] {
            let mut mode = Mode::new(f0_hz, zeta, dt_s);
            let (periods, samples) = (40, (1.0 / (hz * dt_s)).round() as usize);
            let turn = |k: usize| TAU * (k as f64 + 0.5) / samples as f64;
            let (mut re, mut im) = (0.0, 0.0);
            for k in 0..periods * samples {
                let s = mode.step(turn(k).sin());
                if k >= (periods - 1) * samples {
                    re += s * turn(k).sin() * 2.0 / samples as f64;
                    im += s * turn(k).cos() * 2.0 / samples as f64;
                }
            }
            let s = nalgebra::Complex::new(0.0, TAU / (samples as f64 * dt_s));
            let polynomial = |c: &[f64]| c[0] + s * (c[1] + s * c[2]);
            let h = polynomial(&colour.numerator) / polynomial(&colour.denominator);
            let error = (nalgebra::Complex::new(re, im) - h).norm() / h.norm();
            assert!(error < 0.01 + TAU * hz * dt_s, "{hz}: {re} {im} against {h}");
        }
    }

    /// Between points of the fine grid a resonance of 2 % damping loses at most a tenth of its Δχ².
    #[test]
    fn the_fine_grid_resolves_a_resonance_and_overlaps_the_coarse_neighbours() {
        let all: Vec<(f64, f64)> = fine_grid(0.05).filter(|(_, zeta)| *zeta == 0.02).collect();
        let middle = all.len() / 2;
        assert!((all[middle].0 - 0.05).abs() < 1e-9);
        let between = ((all[middle].0 * all[middle + 1].0).sqrt(), 0.02);
        let lost = loss(between, [all[middle], all[middle + 1]]);
        assert!(lost < 0.1, "{lost}");
        let coarse: Vec<f64> = grid().map(|(f, _)| f).collect();
        let ratio = coarse[1] / coarse[0];
        assert!(all[0].0 < 0.05 / ratio && all.last().unwrap().0 > 0.05 * ratio, "{all:?} {ratio}");
    }

    /// Fraction of Δχ² lost by the best mixture of two resonances when the truth lies elsewhere, for a flat force
    /// spectrum.
    fn loss(truth: (f64, f64), tried: [(f64, f64); 2]) -> f64 {
        let h = |f: f64, (f0, zeta): (f64, f64)| {
            nalgebra::Complex::new(f * f, 0.0) / nalgebra::Complex::new(f * f - f0 * f0, -2.0 * zeta * f0 * f)
        };
        // Band in which the control loop counteracts thruster noise.
        let mut g = nalgebra::Matrix3::<f64>::zeros();
        let df = 1e-2 * truth.0 * truth.1;
        for i in 0..(0.3 / df) as usize {
            let f = (i as f64 + 0.5) * df;
            let x = [h(f, truth), h(f, tried[0]), h(f, tried[1])];
            g += nalgebra::Matrix3::from_fn(|i, j| (x[i] * x[j].conj()).re) * df;
        }
        let with = nalgebra::Vector2::new(g[(0, 1)], g[(0, 2)]);
        let own = g.fixed_view::<2, 2>(1, 1).into_owned();
        1.0 - with.dot(&(own.try_inverse().unwrap() * with)) / g[(0, 0)]
    }

    #[test]
    fn a_mixture_of_grid_neighbours_loses_at_most_a_quarter() {
        let all: Vec<(f64, f64)> = grid().collect();
        assert!((all[0].0, all.last().unwrap().0) == (FIRST_HZ, LAST_HZ), "{all:?}");
        for i in [0, all.len() / 2, all.len() - 2] {
            let middle = ((all[i].0 * all[i + 1].0).sqrt(), all[i].1);
            let lost = loss(middle, [all[i], all[i + 1]]);
            assert!(lost < 0.25, "{middle:?}: {lost}");
        }
        // A grid twice as coarse loses over 40 %, except at the slowest resonances, which are seen above their
        // frequency.
        for i in [all.len() / 2, all.len() - 2] {
            let (middle, part) = ((all[i].0 * all[i + 1].0).sqrt(), (all[i + 1].0 / all[i].0).sqrt());
            let far = [(all[i].0 / part, all[i].1), (all[i + 1].0 * part, all[i].1)];
            assert!(loss((middle, all[i].1), far) > 0.4);
        }
    }
}
