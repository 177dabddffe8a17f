//! Effect `mps-correlation`: thruster noise that comes from single thrusters pushes and turns at once.
//!
//! A thruster at `r` that pushes along `d` with noise n makes the force `d n` and the torque `(r × d) n`. Of the torque noise the
//! smoother knows much: `M̂ = J_S α̂ − (M_T + M_SRP)`, what turned the spacecraft besides the known torques. The force that comes
//! with it is `K M̂`, `K = E[F Mᵀ] E[M Mᵀ]⁻¹`, nine coefficients `force_X_by_torque_Y`, N per N m, SRF, and the test masses stay
//! behind: `z_i = −T_S^{O_i} K M̂/m_S` (eq:TM_SC_relative_acceleration). Thrusters a metre from the centre of mass make K of
//! order one per metre: **range** ±5.
//!
//! **Confounders.** `M̂` is nearly `J_S α̂` where the loop commands little, so K is the offset's twin: a column `K e_j` looks
//! like an offset `−[J⁻¹ e_j ×] b` wherever commands are small against noise, above the attitude loop's bandwidth. This is
//! how the correlation biases `b_z` by centimetres when it is left out; told apart only below that bandwidth, where
//! commands cancel what K sees and the offset sees neither. Gyroscopic and electrode torques, 1e-10 N m, are left in `M̂`: they are
//! nearly constant.

use dragfree_physics::mission::Mission;
use dragfree_sdk::prelude::*;
use nalgebra::{Matrix3, Vector3};

use crate::common::{AXES, axis_of, behind_spacecraft, manifest, mission, on_channels};

const MOST: f64 = 5.0;

#[derive(Debug)]
struct Handles {
    alpha: [In; 3],
    torque: [In; 3],
    sun: Option<[In; 3]>,
    out: [Out; 3],
}

/// The effect.
#[derive(Debug)]
pub(crate) struct MpsCorrelation {
    mission: Mission,
    handles: Option<Handles>,
}

/// `M̂`, SRF, N m.
fn unexplained(inertia: &Matrix3<f64>, alpha: &Vector3<f64>, known_nm: &Vector3<f64>) -> Vector3<f64> {
    inertia * alpha - known_nm
}

impl Effect for MpsCorrelation {
    const MANIFEST: Manifest = manifest(
        "mps-correlation",
        "Force and torque noise of the thrusters belong together",
        &[],
        &["layout"],
        &["commands"],
    );

    fn new(setup: &Setup) -> Result<Self, PluginError> {
        Ok(Self { mission: mission(setup)?, handles: None })
    }

    fn link(&mut self, available: &Available, link: &mut EffectLink<'_, '_>) -> Result<(), PluginError> {
        let mut vector = |stem: &str, unit: &str| -> Result<[In; 3], PluginError> {
            let [x, y, z] = AXES.map(|axis| link.read(&Want::new(format!("{stem}.{axis}")).unit(unit).frame("SRF")));
            Ok([x?, y?, z?])
        };
        let alpha = vector("sc.alpha_srf_rad_s2", "rad s-2")?;
        let torque = vector("used.mps_torque_srf_nm", "N m")?;
        let sunlit = self.mission.solar_pressure.is_some() && available.find("used.sun_srf.x").is_some();
        let sun = if sunlit { Some(vector("used.sun_srf", "1")?) } else { None };
        let [x, y, z] = AXES.map(|axis| link.series(&format!("torque_excess.{axis}"), "N m", "SRF"));
        self.handles = Some(Handles { alpha, torque, sun, out: [x?, y?, z?] });
        for force in AXES {
            for torque in AXES {
                let series = (link.table(), format!("torque_excess.{torque}"));
                let responses = behind_spacecraft(&self.mission, axis_of(force), &series);
                link.coefficient(&Coefficient {
                    name: format!("mps-correlation.layout.force_{force}_by_torque_{torque}"),
                    unit: "m-1".to_owned(),
                    frame: "SRF".to_owned(),
                    lower: -MOST,
                    upper: MOST,
                    prior_sigma: MOST / 3.0,
                    responses: on_channels(available, "mps-correlation:layout", responses)?,
                    ..Coefficient::default()
                })?;
            }
        }
        Ok(())
    }

    fn process(&mut self, input: &Inputs<'_>, output: &mut Outputs) -> Result<(), PluginError> {
        let Some(handles) = &self.handles else {
            return Err(PluginError::fatal("mps-correlation: called before it was linked"));
        };
        let inertia = self.mission.spacecraft.inertia();
        let pressure = self.mission.solar_pressure.as_ref();
        let columns = |vector: [In; 3]| vector.map(|axis| input.f64(axis));
        let (alpha, torque, sun) = (columns(handles.alpha), columns(handles.torque), handles.sun.map(columns));
        for k in 0..input.rows() {
            let at = |columns: [&[f64]; 3]| Vector3::from(columns.map(|axis| axis[k]));
            let mut known_nm = at(torque);
            if let (Some(pressure), Some(sun)) = (pressure, sun) {
                known_nm += Vector3::from(pressure.arm_srf_m).cross(&(at(sun) * pressure.force_n));
            }
            let excess = unexplained(&inertia, &at(alpha), &known_nm);
            for (axis, out) in handles.out.iter().enumerate() {
                output.f64(*out).push(excess[axis]);
            }
        }
        Ok(())
    }
}
