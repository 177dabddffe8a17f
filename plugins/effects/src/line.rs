//! Effect `line`: a force or torque at one frequency.
//!
//! ```toml
//! [[effect]]
//! id = "line"
//! instance = "sc.y"                      # sc.x|y|z, sc.phi|theta|psi, TM.x|y|z; sc.y-2 is a second line there
//! parameters.frequency_hz = 0.0123
//! ```
//!
//! Two coefficients, the amplitudes of `cos 2πft` and `sin 2πft` with t in Unix time: N in SRF on the spacecraft
//! (`−T_S^{O_i} e/m_S` on the test masses), N m in SRF (`J_S⁻¹ e` on the attitude), N in ORF on a test mass (`1/m_m`).
//! A series has the mean over each sample. The host searches the frequency. **Range**: ±1e-4 N, ±1e-4 N m, ±1e-9 N.
//! **Confounder**: a line A in the readout, which shows as `−(2πf)² A`.

use std::f64::consts::{PI, TAU};

use dragfree_physics::mission::Mission;
use dragfree_sdk::place_and_number;
use dragfree_sdk::prelude::*;
use serde_json::json;

use crate::common::{
    SeriesRef, accel_channel_of, axis_of, keep_available, manifest, mission, response, responses_to_spacecraft_force,
    symmetric, tm_of,
};
use crate::torque::responses_to_spacecraft_torque;

/// Largest force and torque on the spacecraft, N and N m, and largest force on a test mass, N.
const MAX_SPACECRAFT: f64 = 1e-4;
const MAX_TEST_MASS: f64 = 1e-9;

const TORQUES: [&str; 3] = ["sc.phi", "sc.theta", "sc.psi"];

/// The effect.
#[derive(Debug)]
pub(crate) struct Line {
    instance: String,
    mission: Mission,
    frequency_hz: f64,
    /// Provides rows; the series of cosine and sine.
    linked: Option<(In, [Out; 2])>,
}

impl Line {
    fn name(&self) -> String {
        format!("line:{}", self.instance)
    }

    /// Unit and range of the coefficients, and the responses to a series of the force or torque.
    fn acts(
        &self,
        available: &Available,
        series: &SeriesRef,
    ) -> Result<(&'static str, f64, Vec<Response>), PluginError> {
        let (place, _) = place_and_number(&self.instance);
        let axis = TORQUES.iter().position(|name| *name == place);
        let (unit, most, responses) = match axis {
            Some(axis) => {
                ("N m", MAX_SPACECRAFT, responses_to_spacecraft_torque(available, &self.mission, axis, series))
            }
            None if tm_of(place) == "sc" => {
                ("N", MAX_SPACECRAFT, responses_to_spacecraft_force(&self.mission, axis_of(place), series))
            }
            None => {
                let mass_kg = self.mission.test_mass(tm_of(place), "the effect line")?.mass_kg;
                ("N", MAX_TEST_MASS, vec![response(accel_channel_of(place), series, 1.0 / mass_kg)])
            }
        };
        Ok((unit, most, keep_available(available, &self.name(), responses)?))
    }
}

impl Effect for Line {
    const MANIFEST: Manifest = manifest(
        "line",
        "A force or torque at one frequency",
        &[Parameter::f64("frequency_hz", "Hz", 0.0, 0.0..=1e3, "frequency; the host searches that of a candidate")],
        &["sc.x", "sc.y", "sc.z", "sc.phi", "sc.theta", "sc.psi", "{test_mass}.x", "{test_mass}.y", "{test_mass}.z"],
        &[],
    );

    fn new(setup: &Setup) -> Result<Self, PluginError> {
        let mission = mission(setup)?;
        let frequency_hz = setup.f64("frequency_hz")?;
        let line = Self { instance: setup.instance().to_owned(), mission, frequency_hz, linked: None };
        let nyquist_hz = 0.5 / line.mission.dt_s();
        let known = frequency_hz > 0.0 && frequency_hz < nyquist_hz;
        if known || setup.candidate() && frequency_hz == 0.0 {
            return Ok(line);
        }
        Err(PluginError::error(format!(
            "effect {}: parameter `frequency_hz` = {frequency_hz} must lie between 0 and {nyquist_hz} Hz, half the sampling rate",
            line.name()
        )))
    }

    fn link(&mut self, available: &Available, link: &mut EffectLink<'_, '_>) -> Result<(), PluginError> {
        let Some(channel) = available.of_kind("channel").next() else {
            return self.acts(available, &SeriesRef::default()).map(drop);
        };
        let clock = link.read(&Want::of(channel))?;
        let mut outs = Vec::new();
        for part in ["cos", "sin"] {
            outs.push(link.series(part, "", "")?);
            let (unit, most, responses) = self.acts(available, &(link.table(), part.to_owned()))?;
            link.coefficient(&Coefficient {
                responses,
                shape: [("frequency_hz".to_owned(), json!(self.frequency_hz))].into(),
                ..symmetric(format!("line.{}.{part}", self.instance), unit, most)
            })?;
        }
        self.linked = Some((clock, [outs[0], outs[1]]));
        Ok(())
    }

    fn process(&mut self, input: &Inputs<'_>, output: &mut Outputs) -> Result<(), PluginError> {
        let Some((clock, [cos, sin])) = self.linked else {
            return Err(PluginError::fatal("line: process called before link"));
        };
        let dt_s = self.mission.dt_s();
        let half = PI * self.frequency_hz * dt_s;
        let mean = if half > 0.0 { half.sin() / half } else { 1.0 };
        let wave = |now_ns: &i64| {
            let (sin, cos) = (TAU * cycles(self.frequency_hz, *now_ns) + half).sin_cos();
            (mean * cos, mean * sin)
        };
        let values: Vec<(f64, f64)> = input.times_of(clock).iter().map(wave).collect();
        output.f64(cos).extend(values.iter().map(|(cos, _)| cos));
        output.f64(sin).extend(values.iter().map(|(_, sin)| sin));
        Ok(())
    }
}

/// Part of a cycle since the Unix epoch. Whole seconds and the rest apart: their product with a frequency would lose
/// digits of the phase.
fn cycles(frequency_hz: f64, now_ns: i64) -> f64 {
    const SECOND_NS: i64 = 1_000_000_000;
    let (seconds, rest_ns) = (now_ns.div_euclid(SECOND_NS), now_ns.rem_euclid(SECOND_NS));
    (frequency_hz * seconds as f64).fract() + frequency_hz * 1e-9 * rest_ns as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_phase_goes_on_over_the_seconds() {
        let start_ns = 2_051_222_400_000_000_000;
        for k in 1..200 {
            let (a, b) = (cycles(0.037, start_ns + (k - 1) * 100_000_000), cycles(0.037, start_ns + k * 100_000_000));
            let step = (b - a).rem_euclid(1.0);
            assert!((step - 0.0037).abs() < 1e-6, "{k}: {step}");
        }
    }
}
