//! Stage `accelerometer`: measured accelerations in place of the displacements of a test mass.
//!
//! The instrument measures the force per mass that holds its proof mass at `b` from the spacecraft's centre of mass,
//! `a = a_ng + α×b + ω×(ω×b) − Γ b`. The channels describe a **free** mass relative to its housing
//! (eq:TM_SC_relative_acceleration), `r̈ = −a_ng − α×b − ω×(ω×b) + Γ b`. So `channel = −a`.
//!
//! `α` is measured by the same instrument; its noise attenuates the offset (errors in variables). If the mission states
//! the noise, the stage writes `E[α | measured α]` ([`crate::angular`]), at most 18,435 samples late; 128 samples next
//! to a gap have no α, and intervals under 2,048 samples stay as measured. `ω` comes from differences of the attitude
//! SCA1B, which is in SRF and free of the gyros' drift.
//!
//! If the spacecraft hardly rotates, α is mostly noise. An offset fitted to it reflects the correlation of linear and
//! angular readout noise, which share electrodes. The stage compares α with its noise on several time scales and notes
//! this.
//!
//! The gravity gradient `Γ b` and the instrument's biases are nearly constant; `qp-check` removes constants and slopes.

use dragfree_physics::mission::Mission;
use dragfree_physics::noise::NoiseShape;
use dragfree_physics::spectrum::SpectrumError;
use dragfree_sdk::prelude::*;
use nalgebra::{Matrix3, Quaternion, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

use crate::angular::{Row, Wiener};
use crate::noise::declared;

/// Ratio of mean squares below which noise is a tenth or more of the regressors' power at every frequency.
const MIN_SIGNAL_RATIO: f64 = 10.0;

const AXES: [&str; 3] = ["x", "y", "z"];

/// Acceleration of a free mass relative to its housing, ORF, m s⁻², from the measured one, SRF, m s⁻².
pub fn channel_orf_m_s2(orf_from_srf: &Matrix3<f64>, measured_srf_m_s2: &Vector3<f64>) -> Vector3<f64> {
    -(orf_from_srf * measured_srf_m_s2)
}

/// Angular rate from the attitude; `q` takes components in SRF to components in IRF.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AttitudeRate {
    last: Option<(i64, [f64; 4])>,
}

impl AttitudeRate {
    /// Adds the attitude `[w, x, y, z]` of an epoch; returns the mean rate in SRF, rad s⁻¹, since the epoch `step_ns`
    /// before, NaN without it. The difference between the rates in the middle and at the end of the step is neglected.
    pub fn next(&mut self, time_ns: i64, q: [f64; 4], step_ns: i64) -> Vector3<f64> {
        let unit = |q: [f64; 4]| UnitQuaternion::from_quaternion(Quaternion::new(q[0], q[1], q[2], q[3]));
        let valid = q.iter().all(|x| x.is_finite()) && q.iter().any(|x| *x != 0.0);
        let now = valid.then_some((time_ns, q));
        match (std::mem::replace(&mut self.last, now), now) {
            // Epochs are rounded to whole nanoseconds.
            (Some((before_ns, p)), Some(_)) if (time_ns - before_ns - step_ns).abs() <= 1 => {
                (unit(p).inverse() * unit(q)).scaled_axis() / (step_ns as f64 * 1e-9)
            }
            _ => Vector3::repeat(f64::NAN),
        }
    }
}

/// Number of block lengths over which α is compared with its noise: 1, 2, 4 … 512 samples.
const LEVELS: usize = 10;

/// Minimum number of differences for a mean square, whose relative standard deviation is then about a half.
const MIN_DIFFERENCES: u64 = 8;

/// Differences between adjacent blocks of one length.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Level {
    /// Mean of the previous block.
    last: Option<[f64; 3]>,
    /// Mean of the first half of the next longer block.
    half: Option<[f64; 3]>,
    sum: [f64; 3],
    count: u64,
}

/// Mean squares of the differences of adjacent block means (twice the Allan variance), per axis and block length. A
/// slow oscillation shows at half its period even if it is far below the noise of a sample.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BlockDifferences {
    levels: [Level; LEVELS],
}

impl Default for BlockDifferences {
    fn default() -> Self {
        Self { levels: [Level::default(); LEVELS] }
    }
}

impl BlockDifferences {
    /// Adds the value of the next epoch. Blocks and differences do not cross gaps.
    pub fn next(&mut self, value: &Vector3<f64>) {
        if value.iter().any(|x| !x.is_finite()) {
            for level in &mut self.levels {
                (level.last, level.half) = (None, None);
            }
            return;
        }
        let mut mean = [value.x, value.y, value.z];
        for level in &mut self.levels {
            if let Some(before) = level.last.replace(mean) {
                for i in 0..3 {
                    level.sum[i] += (mean[i] - before[i]).powi(2);
                }
                level.count += 1;
            }
            match level.half.take() {
                None => {
                    level.half = Some(mean);
                    return;
                }
                Some(first) => mean = [0, 1, 2].map(|i| 0.5 * (first[i] + mean[i])),
            }
        }
    }

    /// Per axis, the largest ratio of the mean square to that of noise over all block lengths with enough differences.
    pub fn ratio_to_noise(&self, noise_block_differences: &[f64; LEVELS]) -> Option<[f64; 3]> {
        let ratios =
            self.levels.iter().zip(noise_block_differences).filter(|(level, _)| level.count >= MIN_DIFFERENCES);
        ratios
            .map(|(level, noise)| level.sum.map(|s| s / (level.count as f64 * noise)))
            .reduce(|a, b| [0, 1, 2].map(|i| f64::max(a[i], b[i])))
    }
}

/// Mean square of the differences of noise alone, per block length of m samples:
/// `∫ S(f) 4 sin⁴(π f m dt) / (m² sin²(π f dt)) df` up to Nyquist.
pub fn noise_block_differences(noise: &NoiseShape, dt_s: f64) -> [f64; LEVELS] {
    // Resolves the finest oscillation of the longest block by four points.
    const N: u32 = 1 << (LEVELS + 1);
    let width_hz = 0.5 / dt_s / f64::from(N);
    let mut all = [0.0; LEVELS];
    for k in 0..N {
        let f = (f64::from(k) + 0.5) * width_hz;
        let x = std::f64::consts::PI * f * dt_s;
        let power = noise.psd(f) * width_hz / x.sin().powi(2);
        for (level, sum) in all.iter_mut().enumerate() {
            let m = f64::from(1_u32 << level);
            *sum += power * (2.0 * (m * x).sin().powi(2) / m).powi(2);
        }
    }
    all
}

/// State of a checkpoint.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct State {
    attitude: AttitudeRate,
    alpha: BlockDifferences,
    rows: u64,
    without_acceleration: u64,
    without_attitude: u64,
}

#[derive(Clone, Copy, Debug)]
struct Handles {
    linear: [In; 3],
    angular: [In; 3],
    attitude: Option<[In; 4]>,
    channels: Table,
    channel: [Out; 3],
    motion: Table,
    alpha: [Out; 3],
    omega: [Out; 3],
}

/// The stage.
#[derive(Debug)]
pub struct Accelerometer {
    test_mass: String,
    linear: String,
    angular: String,
    attitude: String,
    orf_from_srf: Matrix3<f64>,
    step_ns: i64,
    /// Mean squares of the differences of α's noise per block length, (rad s⁻²)², if the mission states the noise.
    alpha_noise_differences: Option<[f64; LEVELS]>,
    /// Filter for `E[α | measured α]`, if the mission states the noise.
    wiener: Option<Wiener>,
    /// Noise of the channels.
    declared: Vec<NoiseProcess>,
    handles: Option<Handles>,
    state: State,
}

impl Handles {
    /// Writes a row of the reconstruction.
    fn emit(&self, row: &Row, output: &mut Outputs) {
        output.time(self.motion).push(row.time_ns);
        for i in 0..3 {
            output.f64(self.alpha[i]).push(row.alpha_srf_rad_s2.map_or(f64::NAN, |a| a[i]));
            output.f64(self.omega[i]).push(row.omega_srf_rad_s.map_or(f64::NAN, |w| w[i]));
        }
    }
}

fn transform(error: &SpectrumError) -> PluginError {
    PluginError::error(format!("the spectrum of the measured angular acceleration: {error}"))
}

impl Stage for Accelerometer {
    const MANIFEST: Manifest = Manifest {
        id: "accelerometer",
        version: env!("CARGO_PKG_VERSION"),
        licence: "MIT OR Apache-2.0",
        description: "Uses measured linear and angular accelerations in place of a test mass's displacements",
        parameters: &[
            Parameter::text(
                "test_mass",
                "tm1",
                &["tm1", "tm2"],
                "test mass of the mission that represents the proof mass",
            ),
            Parameter::text(
                "linear",
                "acc1a.lin_accl_srf_m_s2",
                &[],
                "grid columns of the linear acceleration, without .x",
            ),
            Parameter::text("angular", "acc1a.ang_accl_srf_rad_s2", &[], "grid columns of the angular acceleration"),
            Parameter::text(
                "attitude",
                "sca1b.quaternion_irf",
                &[],
                "grid columns of the attitude, without .w; may be absent",
            ),
        ],
        instances: &[],
        needs: &[],
    };

    fn new(setup: &Setup) -> Result<Self, PluginError> {
        let mission = Mission::from_json(setup.mission_json())?;
        let test_mass = setup.text("test_mass")?;
        let dt_s = mission.dt_s();
        let step_ns = (dt_s * 1e9).round() as i64;
        let noise = mission.noise.accelerometer_angular.as_ref().map(|n| n.shape());
        let tm = mission.test_mass(&test_mass, "the stage accelerometer")?;
        Ok(Self {
            orf_from_srf: tm.dcm_orf_from_srf(),
            declared: declared(&mission.noise, &test_mass, tm),
            step_ns,
            alpha_noise_differences: noise.as_ref().map(|n| noise_block_differences(n, dt_s)),
            wiener: noise.map(|n| Wiener::new(n, step_ns)),
            linear: setup.text("linear")?,
            angular: setup.text("angular")?,
            attitude: setup.text("attitude")?,
            test_mass,
            handles: None,
            state: State::default(),
        })
    }

    fn link(&mut self, available: &Available, link: &mut Link<'_>) -> Result<(), PluginError> {
        let grid = |stem: &str, part: &str| Want::new(format!("{stem}.{part}")).table("grid");
        let mut vector = |stem: &str, unit: &str| -> Result<[In; 3], PluginError> {
            let [x, y, z] = AXES.map(|a| link.read(&grid(stem, a).unit(unit).frame("SRF")));
            Ok([x?, y?, z?])
        };
        let linear = vector(&self.linear, "m s-2")?;
        let angular = vector(&self.angular, "rad s-2")?;
        let attitude = if available.column("grid", &format!("{}.w", self.attitude)).is_some() {
            let [w, x, y, z] = ["w", "x", "y", "z"].map(|a| link.read(&grid(&self.attitude, a).unit("1").frame("SRF")));
            Some([w?, x?, y?, z?])
        } else {
            None
        };
        let rate_hz = available.column("grid", &format!("{}.x", self.linear)).map_or(0.0, |c| c.rate_hz);
        let frame = if self.test_mass == "tm1" { "ORF_1" } else { "ORF_2" };
        let channels = link.table("channel", rate_hz);
        let [x, y, z] = AXES.map(|a| {
            let name = format!("{}.accel.{a}", self.test_mass);
            let attributes = [("kind", "channel"), ("channel", name.as_str()), ("average", "1")];
            // The noise of all three is declared with the first.
            let noise = if a == "x" { self.declared.as_slice() } else { &[] };
            link.write_noisy(channels, &name, "m s-2", frame, &attributes, noise)
        });
        let channel = [x?, y?, z?];
        let motion = link.table("reconstruction", rate_hz);
        let mut write = |stem: &str, unit: &str| -> Result<[Out; 3], PluginError> {
            let [x, y, z] = AXES.map(|a| link.write(motion, &format!("{stem}.{a}"), unit, "SRF"));
            Ok([x?, y?, z?])
        };
        let alpha = write("sc.alpha_srf_rad_s2", "rad s-2")?;
        let omega = write("sc.omega_srf_rad_s", "rad s-1")?;
        self.handles = Some(Handles { linear, angular, attitude, channels, channel, motion, alpha, omega });
        Ok(())
    }

    fn process(&mut self, input: &Inputs<'_>, output: &mut Outputs) -> Result<(), PluginError> {
        let h = self.handles.ok_or_else(|| PluginError::fatal("accelerometer: process called before link"))?;
        output.time(h.channels).extend_from_slice(input.time_ns());
        for (k, time_ns) in input.time_ns().iter().enumerate() {
            let measured = Vector3::from(h.linear.map(|c| input.f64(c)[k]));
            let channel = channel_orf_m_s2(&self.orf_from_srf, &measured);
            let alpha = Vector3::from(h.angular.map(|c| input.f64(c)[k]));
            let omega = match h.attitude {
                Some(q) => self.state.attitude.next(*time_ns, q.map(|c| input.f64(c)[k]), self.step_ns),
                None => Vector3::zeros(),
            };
            self.state.alpha.next(&alpha);
            self.state.rows += 1;
            let complete = |v: &Vector3<f64>| v.iter().all(|x| x.is_finite());
            self.state.without_acceleration += u64::from(!complete(&channel) || !complete(&alpha));
            self.state.without_attitude += u64::from(!complete(&omega));
            for i in 0..3 {
                output.f64(h.channel[i]).push(channel[i]);
            }
            let row = Row {
                time_ns: *time_ns,
                alpha_srf_rad_s2: complete(&alpha).then(|| alpha.into()),
                omega_srf_rad_s: complete(&omega).then(|| omega.into()),
            };
            match &mut self.wiener {
                Some(wiener) => wiener.next(row, &mut |row| h.emit(&row, output)).map_err(|e| transform(&e))?,
                None => h.emit(&row, output),
            }
        }
        Ok(())
    }

    fn flush(&mut self, output: &mut Outputs) -> Result<(), PluginError> {
        let h = self.handles.ok_or_else(|| PluginError::fatal("accelerometer: flush called before link"))?;
        let Some(wiener) = &mut self.wiener else { return Ok(()) };
        wiener.finish(&mut |row| h.emit(&row, output)).map_err(|e| transform(&e))
    }

    fn report(&mut self, _earlier: &[Report]) -> Result<Report, PluginError> {
        let mut notes = vec![format!(
            "{}.accel is the measured linear acceleration with opposite sign; the non-gravitational acceleration in it is not \
             modelled and counts as noise",
            self.test_mass
        )];
        if self.handles.is_some_and(|h| h.attitude.is_none()) {
            notes.push(format!(
                "the telemetry has no attitude {}: the angular rate is taken as zero, which neglects the centrifugal part of the \
                 offset's acceleration, about 1e-6 s⁻² in low orbit",
                self.attitude
            ));
        }
        let s = &self.state;
        let mut quality = serde_json::Map::new();
        if let Some(ratio) = self.alpha_noise_differences.as_ref().and_then(|noise| s.alpha.ratio_to_noise(noise)) {
            let quiet: Vec<String> = (0..3)
                .filter(|i| ratio[*i] < MIN_SIGNAL_RATIO)
                .map(|i| format!("{} ({:.2})", AXES[i], ratio[i]))
                .collect();
            if !quiet.is_empty() {
                notes.push(format!(
                    "the measured angular acceleration about {} hardly exceeds its noise (largest ratio of Allan variances over \
                     all block lengths): the fitted offset reflects the correlation of the instrument's linear and angular noise; \
                     use data of a manoeuvre",
                    quiet.join(", ")
                ));
            }
            quality.insert("alpha_steps_over_noise".to_owned(), ratio.to_vec().into());
        }
        let mut counts = vec![
            ("rows", s.rows),
            ("rows_without_acceleration", s.without_acceleration),
            ("rows_without_attitude", s.without_attitude),
        ];
        if let Some(wiener) = &self.wiener {
            let c = wiener.counts();
            if c.as_measured > 0 {
                notes.push(format!(
                    "{} rows lie in intervals too short for a spectrum; their angular acceleration is used as measured, and its \
                     noise attenuates the offset",
                    c.as_measured
                ));
            }
            counts.extend([
                ("rows_alpha_filtered", c.filtered),
                ("rows_alpha_as_measured", c.as_measured),
                ("rows_alpha_near_gap", c.near_gap),
            ]);
        } else {
            notes.push(
                "the mission file does not state the noise of the measured angular acceleration (noise.accelerometer_angular): \
                 it is used as measured, and its noise attenuates the offset by an unknown factor; state the noise"
                    .to_owned(),
            );
        }
        let counts = counts.into_iter().map(|(k, v)| (k.to_owned(), v)).collect();
        Ok(Report { counts, notes, quality, ..Report::default() })
    }

    fn state(&mut self, state: &mut dragfree_sdk::state::State<'_>) -> Result<(), PluginError> {
        state.document(&mut self.state)?;
        Ok(self.wiener.iter_mut().try_for_each(|wiener| wiener.visit(state))?)
    }
}
