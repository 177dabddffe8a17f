//! Cramér–Rao bound of the offsets from the mission's noise alone, without data, segments or normal equations.
//!
//! The regressors of the channels are `Φ = −cos(πf dt) [α̂×]`. Stationary data over a span `T` carry the information
//!
//! ```text
//! N = 2T ∫ Re E[Φᴴ Σ⁻¹ Φ] df,   f from 0 to Nyquist, one-sided spectra
//! ```
//!
//! **Σ** is the noise of the channels: readouts through the second difference, accelerations of the test masses, and
//! the covariance of the thrusters' force and torque noise conditional on the attitude readout. **S_α̂** is the
//! excitation, `α = S w − K S n` in the closed loop with torque noise `w` and attitude readout noise `n`, minus the
//! spectrum of the best estimate's error, which is orthogonal to it.

use dragfree_physics::control_design::{DesignError, design};
use dragfree_physics::frames::skew;
use dragfree_physics::mission::{Mission, MissionError};
use dragfree_physics::noise::{NoiseShape, NoiseTerm};
use nalgebra::{Complex, DMatrix, Matrix3, Matrix6, SMatrix, Vector3};
use std::f64::consts::{PI, TAU};

type C64 = Complex<f64>;

/// Number of integration points, evenly spaced in ln f.
const POINTS: usize = 6000;
/// Lower limit of the integral, Hz; less than a millionth of the information lies below.
const LOWEST_HZ: f64 = 1e-5;

/// Error of a bound.
#[derive(Debug, thiserror::Error)]
pub(crate) enum BoundError {
    /// The mission lacks something.
    #[error(transparent)]
    Mission(#[from] MissionError),
    /// The mission has no controllers.
    #[error(transparent)]
    Design(#[from] DesignError),
    /// A combination of channels has no noise, or an offset is unobservable.
    #[error("{0} is singular: give every readout and every test mass a noise in the mission file")]
    Singular(&'static str),
}

/// One-sided PSD of the thrusters' force above their torque at a frequency in Hz, SRF, N² and N² m² per Hz.
type WrenchPsd = Box<dyn Fn(f64) -> Matrix6<f64>>;
/// Open loop of the three attitude channels at a frequency in Hz.
type OpenLoop = Box<dyn Fn(f64) -> [C64; 3]>;

/// Inputs of the two spectra.
pub(crate) struct Case {
    /// Sampling interval, s.
    pub(crate) dt_s: f64,
    /// Mass of the spacecraft, kg.
    pub(crate) mass_kg: f64,
    /// Inverse inertia, SRF, kg⁻¹ m⁻².
    pub(crate) inertia_inverse: Matrix3<f64>,
    /// The test masses.
    pub(crate) test_masses: Vec<TestMass>,
    /// Noise of the thrusters.
    pub(crate) wrench_psd: WrenchPsd,
    /// Noise of the attitude readout, rad.
    pub(crate) attitude: NoiseShape,
    /// Attitude control.
    pub(crate) open_loop: OpenLoop,
}

/// What the channels of one test mass depend on.
pub(crate) struct TestMass {
    /// `T_S^O`.
    pub(crate) dcm_orf_from_srf: Matrix3<f64>,
    /// Its offset, ORF, m: the lever of the unknown torque.
    pub(crate) offset_orf_m: Vector3<f64>,
    /// Noise of the displacement readouts, m.
    pub(crate) readout: [NoiseShape; 3],
    /// Accelerations of the test mass itself, m s⁻².
    pub(crate) stray: [NoiseShape; 3],
}

/// σ of the offsets, m: x, y, z of each test mass, ORF.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct InformationBound {
    /// Each test mass from its own three channels.
    pub(crate) single_m: Vec<f64>,
    /// All test masses together, without the survey.
    pub(crate) joint_m: Vec<f64>,
    /// All, tied by surveyed baselines.
    pub(crate) surveyed_m: Vec<f64>,
}

impl Case {
    /// The case of a mission.
    pub(crate) fn of(mission: &Mission) -> Result<Self, BoundError> {
        const NEEDED_BY: &str = "the information bound";
        let n = &mission.noise;
        macro_rules! shape {
            ($key:ident) => {
                Mission::need(&n.$key, concat!("noise.", stringify!($key)), NEEDED_BY)?.shape()
            };
        }
        let mut test_masses = Vec::new();
        for tm in mission.test_mass.values() {
            let (mut readout, mut stray) = (<[NoiseShape; 3]>::default(), <[NoiseShape; 3]>::default());
            for axis in 0..3 {
                let (name, noise) = mission.displacement_noise(tm, axis);
                readout[axis] = Mission::need(&noise, &format!("noise.{name}"), NEEDED_BY)?.shape();
                stray[axis] = n.test_mass_acceleration.as_ref().map(|s| s.shape()).unwrap_or_default();
                let electrodes = n.electrostatic_force.as_ref().filter(|_| !tm.is_drag_free(axis));
                let force = electrodes.map(|s| s.shape()).unwrap_or_default();
                stray[axis].terms.extend(force.terms.into_iter().map(|t| NoiseTerm { asd: t.asd / tm.mass_kg, ..t }));
            }
            let (dcm_orf_from_srf, offset_orf_m) = (tm.dcm_orf_from_srf(), tm.offset_nominal_orf_m());
            test_masses.push(TestMass { dcm_orf_from_srf, offset_orf_m, readout, stray });
        }
        let units = mission.thrusters.as_ref().map(|t| t.unit.clone()).unwrap_or_default();
        let wrench_psd: WrenchPsd = if units.is_empty() {
            let (force, torque) = (shape!(thruster_force), shape!(thruster_torque));
            Box::new(move |f| {
                let diagonal = SMatrix::<f64, 6, 1>::from_fn(|i, _| if i < 3 { force.psd(f) } else { torque.psd(f) });
                Matrix6::from_diagonal(&diagonal)
            })
        } else {
            let whole = units.iter().fold(Matrix6::zeros(), |sum, unit| {
                let d = Vector3::from(unit.direction_srf).normalize();
                let turn = Vector3::from(unit.position_srf_m).cross(&d);
                let wrench = SMatrix::<f64, 6, 1>::from_fn(|i, _| if i < 3 { d[i] } else { turn[i - 3] });
                sum + wrench * wrench.transpose() * unit.asd_n_rthz.powi(2)
            });
            Box::new(move |_| whole)
        };
        let channels = design(mission)?.channels;
        let (lag_s, delay_s) = mission.thrusters.as_ref().map_or((0.0, 0.0), |t| (t.lag_s, t.delay_s));
        let open_loop: OpenLoop = Box::new(move |f| {
            let omega = TAU * f;
            let thrusters = C64::from_polar(1.0, -omega * delay_s) / C64::new(1.0, omega * lag_s);
            [0, 1, 2].map(|axis| channels[axis].open_loop(f) * thrusters)
        });
        Ok(Self {
            dt_s: mission.dt_s(),
            mass_kg: mission.spacecraft.mass_kg,
            inertia_inverse: mission.spacecraft.inertia_inverse(),
            test_masses,
            wrench_psd,
            attitude: shape!(dws_long_arm),
            open_loop,
        })
    }

    /// Spectrum of `α̂`, SRF, rad² s⁻⁴/Hz, real part, and noise of the channels x, y, z of each test mass,
    /// ORF, m² s⁻⁴/Hz.
    fn spectra(&self, f_hz: f64) -> Option<(Matrix3<f64>, DMatrix<f64>)> {
        let (sin, cos) = (PI * f_hz * self.dt_s).sin_cos();
        let differenced = (4.0 * sin * sin / self.dt_s.powi(2)).powi(2);
        let s = (self.wrench_psd)(f_hz);
        let j = &self.inertia_inverse;

        // Covariance of force and torque conditional on the attitude readout, which sees the mean torque of two
        // samples.
        let mut attitude_response = SMatrix::<f64, 3, 6>::zeros();
        attitude_response.fixed_view_mut::<3, 3>(0, 3).copy_from(&(j * cos));
        let attitude = Matrix3::identity() * (differenced * self.attitude.psd(f_hz));
        let gain = s
            * attitude_response.transpose()
            * (attitude_response * s * attitude_response.transpose() + attitude).try_inverse()?;
        let unknown = s - gain * attitude_response * s;

        let torque = s.fixed_view::<3, 3>(3, 3).into_owned();
        let disturbance = j * torque * j.transpose();
        let unseen = j * unknown.fixed_view::<3, 3>(3, 3) * j.transpose();
        // Transfer from acceleration over a sample to attitude at its end, s²: dt²/2 (z + 1)/(z − 1)².
        let z = C64::from_polar(1.0, TAU * f_hz * self.dt_s);
        let integrators = (z + 1.0) / ((z - 1.0) * (z - 1.0)) * (0.5 * self.dt_s.powi(2));
        let sensitivity = (self.open_loop)(f_hz).map(|l| (l + 1.0).inv());
        let of_readout = sensitivity.map(|s| (C64::from(1.0) - s) / integrators);
        let excitation = Matrix3::from_fn(|a, b| {
            let own = if a == b { of_readout[a].norm_sqr() * self.attitude.psd(f_hz) } else { 0.0 };
            (sensitivity[a] * sensitivity[b].conj()).re * disturbance[(a, b)] + own - unseen[(a, b)]
        });

        let mut channel_response = DMatrix::zeros(3 * self.test_masses.len(), 6);
        for (i, tm) in self.test_masses.iter().enumerate() {
            let dcm = tm.dcm_orf_from_srf;
            channel_response.fixed_view_mut::<3, 3>(3 * i, 0).copy_from(&(-dcm / self.mass_kg));
            channel_response.fixed_view_mut::<3, 3>(3 * i, 3).copy_from(&(skew(&tm.offset_orf_m) * dcm * j));
        }
        let mut noise = &channel_response * unknown * channel_response.transpose() * (cos * cos);
        for (i, tm) in self.test_masses.iter().enumerate() {
            for (axis, (readout, stray)) in tm.readout.iter().zip(&tm.stray).enumerate() {
                noise[(3 * i + axis, 3 * i + axis)] += differenced * readout.psd(f_hz) + cos * cos * stray.psd(f_hz);
            }
        }
        Some((excitation, noise))
    }

    /// Bounds for `span_s` seconds of data in a band, Hz.
    pub(crate) fn bound_in(&self, span_s: f64, band_hz: std::ops::Range<f64>) -> Result<InformationBound, BoundError> {
        const NOISE: BoundError = BoundError::Singular("the noise of the channels");
        const SEEN: BoundError = BoundError::Singular("the information");
        let test_masses = self.test_masses.len();
        let zeros = || DMatrix::<f64>::zeros(3 * test_masses, 3 * test_masses);
        // Channels of −[α×] b for α along each axis of SRF.
        let regressors = [0, 1, 2].map(|axis| {
            let mut g = zeros();
            for (i, tm) in self.test_masses.iter().enumerate() {
                let alpha = tm.dcm_orf_from_srf.column(axis).into_owned();
                g.fixed_view_mut::<3, 3>(3 * i, 3 * i).copy_from(&-skew(&alpha));
            }
            g
        });
        let step = (band_hz.end / band_hz.start).ln() / POINTS as f64;
        let (mut joint, mut single) = (zeros(), zeros());
        for k in 0..POINTS {
            let f = band_hz.start * (step * (k as f64 + 0.5)).exp();
            let (excitation, noise) = self.spectra(f).ok_or(NOISE)?;
            let mut separate = zeros();
            for i in 0..test_masses {
                let own = noise.fixed_view::<3, 3>(3 * i, 3 * i).try_inverse().ok_or(NOISE)?;
                separate.fixed_view_mut::<3, 3>(3 * i, 3 * i).copy_from(&own);
            }
            let combined = noise.try_inverse().ok_or(NOISE)?;
            let weight = 2.0 * span_s * (PI * f * self.dt_s).cos().powi(2) * f * step;
            for (a, b) in (0..3).flat_map(|a| (0..3).map(move |b| (a, b))) {
                let power = weight * excitation[(a, b)];
                joint += regressors[a].transpose() * &combined * &regressors[b] * power;
                single += regressors[a].transpose() * &separate * &regressors[b] * power;
            }
        }
        let sigmas = |information: &DMatrix<f64>| -> Result<Vec<f64>, BoundError> {
            Ok(sigmas_of(&information.clone().try_inverse().ok_or(SEEN)?))
        };
        // With the survey all housings move together: b_i = T_S^O c + constant.
        let mut tied = DMatrix::zeros(3 * test_masses, 3);
        for (i, tm) in self.test_masses.iter().enumerate() {
            tied.fixed_view_mut::<3, 3>(3 * i, 0).copy_from(&tm.dcm_orf_from_srf);
        }
        let centre = (tied.transpose() * &joint * &tied).try_inverse().ok_or(SEEN)?;
        let surveyed = &tied * centre * tied.transpose();
        Ok(InformationBound { single_m: sigmas(&single)?, joint_m: sigmas(&joint)?, surveyed_m: sigmas_of(&surveyed) })
    }

    /// Bounds for `span_s` seconds of data, up to Nyquist.
    pub(crate) fn bound(&self, span_s: f64) -> Result<InformationBound, BoundError> {
        self.bound_in(span_s, LOWEST_HZ..0.5 / self.dt_s * (1.0 - 1e-9))
    }
}

fn sigmas_of(covariance: &DMatrix<f64>) -> Vec<f64> {
    covariance.diagonal().iter().map(|variance| variance.sqrt()).collect()
}

/// Orthonormal basis, 6 × 3, of the directions that the survey leaves free: both housings along an axis of SRF
/// together.
pub(crate) fn free_space(dcm_orf_from_srf: &[Matrix3<f64>; 2]) -> DMatrix<f64> {
    DMatrix::from_fn(6, 3, |row, axis| dcm_orf_from_srf[row / 3][(row % 3, axis)] * 0.5_f64.sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn mission(text: &str) -> Mission {
        let value: toml::Value = toml::from_str(text).unwrap();
        Mission::from_json(&serde_json::to_string(&value).unwrap()).unwrap()
    }

    fn taiji() -> Mission {
        mission(include_str!("../../fixtures/missions/taiji.toml"))
    }

    fn turned(angle_deg: f64) -> Matrix3<f64> {
        let (s, c) = f64::to_radians(angle_deg).sin_cos();
        Matrix3::new(c, s, 0.0, -s, c, 0.0, 0.0, 0.0, 1.0)
    }

    fn near(found: &[f64], wanted: &[f64], tolerance: f64, what: &str) {
        for (f, w) in found.iter().zip(wanted) {
            assert!((f / w - 1.0).abs() < tolerance, "{what}: {found:?} for {wanted:?}");
        }
    }

    /// Reference: σ of an independent Python study that summed normal equations of 25 simulated days with Hann windows,
    /// rounded to two digits. It counted one observation every 1.5 bins for the window's bandwidth; untapered data have
    /// one in each.
    #[test]
    fn bounds_match_an_independent_simulation_study() {
        let dt_s = 0.1;
        let inertia = Matrix3::new(800.0, 13.0, 10.0, 13.0, 800.0, 12.0, 10.0, 12.0, 1000.0);
        let white = NoiseShape::white;
        let test_mass = |(angle_deg, y_m)| TestMass {
            dcm_orf_from_srf: turned(angle_deg),
            offset_orf_m: turned(angle_deg) * Vector3::new(0.001, y_m, 0.0),
            readout: [white(1.5e-12), white(1.8e-9), white(3e-9)],
            stray: [NoiseShape::default(), white(6e-15 / 1.96), white(6e-15 / 1.96)],
        };
        let case = Case {
            dt_s,
            mass_kg: 1500.0,
            inertia_inverse: inertia.try_inverse().unwrap(),
            test_masses: [(30.0, 0.18), (-30.0, -0.18)].map(test_mass).into(),
            wrench_psd: Box::new(|_| Matrix6::identity() * 1e-14),
            attitude: white(5e-10),
            open_loop: Box::new(move |f| {
                // A low pass, then proportional, derivative and integral gains, without delay.
                let (w, z) = (0.35_f64, C64::from_polar(1.0, TAU * f * dt_s));
                let a = 1.0 - (-6.0 * w * dt_s).exp();
                let filter = C64::from(a) / (C64::from(1.0) - z.inv() * (1.0 - a));
                let step = C64::from(1.0) - z.inv();
                let gains = step * (1.8 * w / dt_s) + w * w + step.inv() * (0.1 * w.powi(3) * dt_s);
                [filter * gains * (z + 1.0) / ((z - 1.0) * (z - 1.0)) * (0.5 * dt_s * dt_s); 3]
            }),
        };
        let bound = case.bound_in(25.0 * 86_400.0, 2e-4..4.9).unwrap();
        let mm = |values: [f64; 3]| values.map(|v| v * 1e-3 / 1.5_f64.sqrt());
        near(&bound.joint_m[..3], &mm([3.2, 0.064, 0.061]), 0.03, "joint");
        near(&bound.single_m[..3], &mm([3.6, 0.064, 0.064]), 0.03, "single");
        near(&bound.surveyed_m[..3], &mm([0.072, 0.064, 0.047]), 0.03, "surveyed");
    }

    /// Closed form for white noise s_n on every channel and white α̂ (no control, perfect readout): N = 2T f_N ½
    /// s_α/s_n (|e_a × e_j|² summed), σ = 1/√N.
    #[test]
    fn white_noise_has_a_closed_form() {
        let (dt_s, torque, noise) = (0.1, 1e-10_f64, 1e-12_f64);
        let test_mass = |angle_deg| TestMass {
            dcm_orf_from_srf: turned(angle_deg),
            offset_orf_m: Vector3::zeros(),
            readout: Default::default(),
            stray: std::array::from_fn(|_| NoiseShape::white(noise)),
        };
        let case = |angles_deg: &[f64]| Case {
            dt_s,
            mass_kg: f64::INFINITY,
            inertia_inverse: Matrix3::identity(),
            test_masses: angles_deg.iter().copied().map(test_mass).collect(),
            wrench_psd: Box::new(move |_| Matrix6::identity() * torque.powi(2)),
            attitude: NoiseShape::white(1e-30),
            open_loop: Box::new(|_| [C64::from(0.0); 3]),
        };
        // cos² of regressors and noise cancel; two of the three axes of α act on each coefficient.
        let information = 2.0 * 5.0 * (torque / noise).powi(2) * 2.0;
        for angles_deg in [&[30.0, -30.0][..], &[0.0], &[10.0, 70.0, 200.0]] {
            let bound = case(angles_deg).bound_in(1.0, 1e-5..5.0 * (1.0 - 1e-9)).unwrap();
            let (all, together) = (angles_deg.len(), information * angles_deg.len() as f64);
            near(&bound.single_m, &vec![information.powf(-0.5); 3 * all], 1e-3, "single");
            near(&bound.joint_m, &vec![information.powf(-0.5); 3 * all], 1e-3, "joint");
            near(&bound.surveyed_m, &vec![together.powf(-0.5); 3 * all], 1e-3, "surveyed");
        }
    }

    /// More information never increases σ, and σ falls with the root of the span.
    #[test]
    fn more_information_gives_smaller_bounds() {
        let case = Case::of(&taiji()).unwrap();
        let (day, month) = (case.bound(86_400.0).unwrap(), case.bound(25.0 * 86_400.0).unwrap());
        for i in 0..6 {
            assert!(day.surveyed_m[i] <= day.joint_m[i] && day.joint_m[i] <= day.single_m[i], "{day:?}");
            assert!((day.surveyed_m[i] / month.surveyed_m[i] - 5.0).abs() < 1e-9);
        }
        // A quieter attitude readout excites the spacecraft less; a noisier interferometer carries less information.
        let with = |change: &dyn Fn(&mut Mission)| {
            let mut m = taiji();
            // The controllers stay those of the original mission.
            change(&mut m);
            Case { open_loop: Case::of(&taiji()).unwrap().open_loop, ..Case::of(&m).unwrap() }.bound(86_400.0).unwrap()
        };
        let quiet = with(&|m| m.noise.dws_long_arm.as_mut().unwrap().asd_rad_rthz /= 2.0);
        let loud = with(&|m| m.noise.ifo_x.as_mut().unwrap().asd_m_rthz *= 2.0);
        assert!(quiet.surveyed_m[1] > 1.05 * day.surveyed_m[1], "{quiet:?} {day:?}");
        assert!(loud.surveyed_m[0] > 1.05 * day.surveyed_m[0], "{loud:?} {day:?}");
    }

    /// For single thrusters torque determines part of the force, so neglecting the correlation increases σ.
    #[test]
    fn correlated_thrusters_reduce_the_bound() {
        let thrusters = mission(include_str!("../../fixtures/missions/taiji-thrusters.toml"));
        let case = Case::of(&thrusters).unwrap();
        let known = case.bound(86_400.0).unwrap();
        let whole = (case.wrench_psd)(1e-2);
        let blind = Case {
            wrench_psd: Box::new(move |_| {
                Matrix6::from_fn(|i, j| if (i < 3) == (j < 3) { whole[(i, j)] } else { 0.0 })
            }),
            ..case
        };
        let blind = blind.bound(86_400.0).unwrap();
        for i in 0..6 {
            assert!(known.single_m[i] < blind.single_m[i], "{known:?} {blind:?}");
        }
    }

    /// Housings that move together are free, apart they are not.
    #[test]
    fn the_survey_leaves_three_free_directions() {
        let dcm = [turned(30.0), turned(-30.0)];
        let free = free_space(&dcm);
        assert!((free.transpose() * &free - DMatrix::identity(3, 3)).norm() < 1e-14);
        let moved = |sign: f64| {
            let v = Vector3::new(0.1, -0.2, 0.3);
            let (a, b) = (dcm[0] * v, dcm[1] * v * sign);
            nalgebra::DVector::from_fn(6, |i, _| if i < 3 { a[i] } else { b[i - 3] })
        };
        assert!(((free.transpose() * moved(1.0)).norm() - moved(1.0).norm()).abs() < 1e-14);
        assert!((free.transpose() * moved(-1.0)).norm() < 1e-14);
    }
}
