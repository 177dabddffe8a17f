//! The design of the fifteen controllers when a mission file brings none.
//!
//! The H-infinity synthesis replaces [`loop_shaping`] and nothing else.

use nalgebra::Vector3;
use std::collections::BTreeMap;
use std::f64::consts::TAU;

use crate::mission::{CHANNELS, ChannelController, Mission, MissionError};

const NEEDED_BY: &str = "the default control design";

/// Factor between `ω_c²` and disturbance over requirement. A double integrator under the controller below answers a
/// white acceleration with at most about `5/ω_c²`, so 12 keeps the disturbance's part at two fifths of the requirement.
const BANDWIDTH_MARGIN: f64 = 12.0;
/// Corners of the controller in units of `ω_c`: integral action, derivative action, roll-off (twice).
const INTEGRAL: f64 = 1.0 / 30.0;
const DERIVATIVE: f64 = 1.0 / 5.0;
const ROLL_OFF: f64 = 6.0;

/// Loop-shaping design: one PID with a doubly filtered derivative per channel, for the plant `1/s²` that the static
/// decoupling leaves (eq:decoupled_dynamics).
///
/// `K(s) = k (s + ω_c/30)(s + ω_c/5)/s · (6ω_c)²/(s + 6ω_c)²`, `|K(iω_c)| = ω_c²`, Tustin at the mission's sample rate.
/// The crossover follows from the requirement table and the thrusters' noise, `ω_c² = 12 d/requirement` with `d` the
/// ASD of the acceleration that disturbs the channel, and stays below a sixtieth of the sample rate, where the hold
/// and one sample of delay cost nine degrees. Phase margins are 53° to 57°.
///
/// # Errors
/// [`MissionError::Missing`] without `[requirements]` or the noise of the thrusters and electrodes.
pub fn loop_shaping(mission: &Mission) -> Result<BTreeMap<String, ChannelController>, MissionError> {
    let dt_s = mission.dt_s();
    let fastest_rad_s = TAU / (60.0 * dt_s);
    CHANNELS
        .iter()
        .map(|name| {
            let crossover = (BANDWIDTH_MARGIN * disturbance(mission, name)? / requirement(mission, name)?).sqrt();
            // A channel that nothing disturbs still has to settle within hours.
            Ok(((*name).to_owned(), pid(crossover.clamp(1e-2, fastest_rad_s), dt_s)))
        })
        .collect()
}

/// Splits `tm1.x` into test mass and degree of freedom.
fn parts(channel: &str) -> (&str, &str) {
    channel.split_once('.').unwrap_or((channel, ""))
}

/// Requirement of a channel above its corner, m/√Hz or rad/√Hz.
fn requirement(mission: &Mission, channel: &str) -> Result<f64, MissionError> {
    let r = Mission::need(&mission.requirements, "requirements", NEEDED_BY)?;
    Ok(match parts(channel) {
        ("sc", _) => r.sc_attitude_rad_rthz,
        (_, "x") => r.tm_x_m_rthz,
        (_, "y" | "z") => r.tm_yz_m_rthz,
        (_, "phi") => r.tm_phi_rad_rthz,
        _ => r.tm_theta_psi_rad_rthz,
    })
}

/// White acceleration that disturbs a channel, m s⁻²/√Hz or rad s⁻²/√Hz: noise of the thrusters, which reaches a test
/// mass through the spacecraft's acceleration and through `α×b`, and of the electrodes.
fn disturbance(mission: &Mission, channel: &str) -> Result<f64, MissionError> {
    let n = &mission.noise;
    let force = Mission::need(&n.thruster_force, "noise.thruster_force", NEEDED_BY)?.asd_n_rthz;
    let torque = Mission::need(&n.thruster_torque, "noise.thruster_torque", NEEDED_BY)?.asd_nm_rthz;
    let alpha = torque * mission.spacecraft.inertia_inverse().symmetric_eigenvalues().max();
    let (body, freedom) = parts(channel);
    if body == "sc" {
        return Ok(alpha);
    }
    let tm = mission.test_mass(body, NEEDED_BY)?;
    if matches!(freedom, "phi" | "theta" | "psi") {
        let noise = Mission::need(&n.electrostatic_torque, "noise.electrostatic_torque", NEEDED_BY)?.asd_nm_rthz;
        let own = noise * tm.inertia_inverse(body, NEEDED_BY)?.symmetric_eigenvalues().max();
        return Ok(alpha.hypot(own));
    }
    let electrodes = match freedom {
        "x" => 0.0,
        _ => Mission::need(&n.electrostatic_force, "noise.electrostatic_force", NEEDED_BY)?.asd_n_rthz / tm.mass_kg,
    };
    let lever = alpha * Vector3::from(tm.offset_nominal_srf_m).norm();
    Ok((force / mission.spacecraft.mass_kg).hypot(lever).hypot(electrodes))
}

/// The controller of [`loop_shaping`] for a crossover in rad/s.
fn pid(crossover_rad_s: f64, dt_s: f64) -> ChannelController {
    let wc = crossover_rad_s;
    let (wi, wd, wp) = (INTEGRAL * wc, DERIVATIVE * wc, ROLL_OFF * wc);
    let magnitude = wc.hypot(wi) * wc.hypot(wd) / wc * wp * wp / (wc * wc + wp * wp);
    // Tustin's rule, s = k(z−1)/(z+1), section by section.
    let k = 2.0 / dt_s;
    let lead = [
        (k + wi) * (k + wd) / (k * (k + wp)),
        2.0 * (wi * wd - k * k) / (k * (k + wp)),
        (k - wi) * (k - wd) / (k * (k + wp)),
        -2.0 * k / (k + wp),
        (k - wp) / (k + wp),
    ];
    let roll_off = [wp / (k + wp), wp / (k + wp), 0.0, (wp - k) / (k + wp), 0.0];
    ChannelController { gain_s2: wc * wc / magnitude * wp, sections: vec![lead, roll_off] }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::noise::NoiseShape;
    use nalgebra::Complex;

    pub(crate) fn taiji() -> Mission {
        let text = include_str!("../../../fixtures/missions/taiji.toml");
        let value: serde_json::Value = toml::from_str(text).unwrap();
        Mission::from_json(&value.to_string()).unwrap()
    }

    /// Open-loop parts at a frequency: controller, and plant (held double integrator and one sample of delay).
    fn parts_at(c: &ChannelController, f_hz: f64, dt_s: f64) -> (Complex<f64>, Complex<f64>) {
        let z = Complex::from_polar(1.0, TAU * f_hz * dt_s);
        let k = c.sections.iter().fold(Complex::from(c.gain_s2), |k, [b0, b1, b2, a1, a2]| {
            k * (z * z * *b0 + z * *b1 + *b2) / (z * z + z * *a1 + *a2)
        });
        let hold = (z + 1.0) / ((z - 1.0) * (z - 1.0)) * (0.5 * dt_s * dt_s);
        (k, hold / z)
    }

    fn readout_noise(m: &Mission, channel: &str) -> NoiseShape {
        let n = &m.noise;
        match parts(channel) {
            ("sc", _) => n.dws_long_arm.as_ref().unwrap().shape(),
            (_, "x") => n.ifo_x.as_ref().unwrap().shape(),
            (_, "y" | "z") => n.is_y.as_ref().unwrap().shape(),
            (_, "phi") => n.is_angle.as_ref().unwrap().shape(),
            _ => n.dws_local.as_ref().unwrap().shape(),
        }
    }

    /// Largest predicted ASD over requirement, and largest |S| and |T|.
    fn judge(m: &Mission, channel: &str, c: &ChannelController) -> (f64, f64, f64) {
        let d = disturbance(m, channel).unwrap();
        // Lateral displacement has a requirement without corner, and a capacitive readout that is noisier than it below
        // 0.18 mHz: no controller can meet the table there.
        let lowest_hz: f64 = if matches!(parts(channel).1, "y" | "z") { 2e-4 } else { 1e-4 };
        let mut worst: (f64, f64, f64) = (0.0, 0.0, 0.0);
        for i in 0..2000 {
            let f = 1e-5 * (4.99e5_f64).powf(f64::from(i) / 1999.0);
            let (k, p) = parts_at(c, f, m.dt_s());
            let s = Complex::from(1.0) / (k * p + 1.0);
            worst.1 = worst.1.max(s.norm());
            worst.2 = worst.2.max((s * k * p).norm());
            if (lowest_hz..=1.0).contains(&f) {
                let noise = (s * k * p).norm_sqr() * readout_noise(m, channel).psd(f);
                let asd = ((s * p).norm_sqr() * d * d + noise).sqrt();
                let corner = m.requirements.as_ref().unwrap().corner_hz / f;
                let factor =
                    if matches!(parts(channel).1, "x" | "y" | "z") { 1.0 } else { (1.0 + corner.powi(4)).sqrt() };
                worst.0 = worst.0.max(asd / (requirement(m, channel).unwrap() * factor));
            }
        }
        worst
    }

    /// The sampled loop, with its delay, keeps the requirement table and a modulus margin of 0.66.
    #[test]
    fn default_design_meets_the_requirement_table() {
        let m = taiji();
        for (name, c) in &loop_shaping(&m).unwrap() {
            let (ratio, s, t) = judge(&m, name, c);
            assert!(ratio < 1.0 && s < 1.5 && t < 1.4, "{name}: {ratio} of the requirement, |S| {s}, |T| {t}");
        }
    }

    /// The judgement above has power: thrusters three times noisier than designed for break the table on x.
    #[test]
    fn a_slower_loop_fails_the_table() {
        let m = taiji();
        let slow = pid(0.2, m.dt_s());
        assert!(judge(&m, "tm1.x", &slow).0 > 1.0);
    }
}
