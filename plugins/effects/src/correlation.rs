//! Effect `mps-correlation`: noise of single thrusters makes correlated force and torque.
//!
//! The smoother's residual torque is `M̂ = J_S α̂ − (M_T + M_SRP)`, SRF, N m. The force correlated with it is `K M̂`,
//! `K = E[F Mᵀ] E[M Mᵀ]⁻¹`, with nine coefficients `force_X_by_torque_Y`, N per N m, SRF, range ±5. The test masses
//! show `z_i = −T_S^{O_i} K M̂/m_S` (eq:TM_SC_relative_acceleration). Left out of a model, the correlation biases
//! `b_z`.
//!
//! Confounder: the centre-of-mass offset, see Methods, "Thruster correlation". Gyroscopic and electrode torques are
//! nearly constant and stay in `M̂`.

use std::collections::BTreeMap;

use dragfree_physics::mission::Mission;
use dragfree_sdk::prelude::*;
use nalgebra::{Matrix3, Vector3};

use crate::columns::alpha_is_commanded;
use crate::common::{
    AXES, axis_of, keep_available, manifest, mission, read_srf_vector, responses_to_spacecraft_force, symmetric,
};
use crate::linear::attitude_channel;

const MAX_PER_METRE: f64 = 5.0;

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

/// Residual torque `M̂`, SRF, N m.
fn residual_torque(inertia: &Matrix3<f64>, alpha: &Vector3<f64>, modelled_nm: &Vector3<f64>) -> Vector3<f64> {
    inertia * alpha - modelled_nm
}

impl Effect for MpsCorrelation {
    const MANIFEST: Manifest = manifest(
        "mps-correlation",
        "Force and torque noise of the thrusters are correlated",
        &[],
        &["layout"],
        &["commands"],
    );

    fn new(setup: &Setup) -> Result<Self, PluginError> {
        Ok(Self { mission: mission(setup)?, handles: None })
    }

    fn link(&mut self, available: &Available, link: &mut EffectLink<'_, '_>) -> Result<(), PluginError> {
        let alpha = read_srf_vector(link, "sc.alpha_srf_rad_s2", "rad s-2")?;
        let torque = read_srf_vector(link, "used.mps_torque_srf_nm", "N m")?;
        let sunlit = self.mission.solar_pressure.is_some() && available.find("used.sun_srf.x").is_some();
        let sun = sunlit.then(|| read_srf_vector(link, "used.sun_srf", "1")).transpose()?;
        // In prediction mode α is what is commanded: what is left of the torque is then what no column knows.
        let predicts = alpha_is_commanded(available);
        let inertia = self.mission.spacecraft.inertia();
        let [x, y, z] = [0, 1, 2].map(|j| {
            let gains: BTreeMap<String, f64> = (0..3).map(|k| (attitude_channel(k), inertia[(j, k)])).collect();
            let lacks = serde_json::json!(gains).to_string();
            let attributes = [(UNPREDICTED_ATTRIBUTE, lacks.as_str())];
            let attributes = if predicts { &attributes[..] } else { &[] };
            link.series_with(&format!("torque_excess.{}", AXES[j]), "N m", "SRF", attributes)
        });
        self.handles = Some(Handles { alpha, torque, sun, out: [x?, y?, z?] });
        for force in AXES {
            for torque in AXES {
                let series = (link.table(), format!("torque_excess.{torque}"));
                let responses = responses_to_spacecraft_force(&self.mission, axis_of(force), &series);
                let name = format!("mps-correlation.layout.force_{force}_by_torque_{torque}");
                link.coefficient(&Coefficient {
                    frame: "SRF".to_owned(),
                    responses: keep_available(available, "mps-correlation:layout", responses)?,
                    ..symmetric(name, "m-1", MAX_PER_METRE)
                })?;
            }
        }
        Ok(())
    }

    fn process(&mut self, input: &Inputs<'_>, output: &mut Outputs) -> Result<(), PluginError> {
        let Some(handles) = &self.handles else {
            return Err(PluginError::fatal("mps-correlation: process called before link"));
        };
        let inertia = self.mission.spacecraft.inertia();
        let pressure = self.mission.solar_pressure.as_ref();
        let columns = |vector: [In; 3]| vector.map(|axis| input.f64(axis));
        let (alpha, torque, sun) = (columns(handles.alpha), columns(handles.torque), handles.sun.map(columns));
        for k in 0..input.rows() {
            let at = |columns: [&[f64]; 3]| Vector3::from(columns.map(|axis| axis[k]));
            let mut modelled_nm = at(torque);
            if let (Some(pressure), Some(sun)) = (pressure, sun) {
                modelled_nm += Vector3::from(pressure.arm_srf_m).cross(&(at(sun) * pressure.force_n));
            }
            let residual = residual_torque(&inertia, &at(alpha), &modelled_nm);
            for (axis, out) in handles.out.iter().enumerate() {
                output.f64(*out).push(residual[axis]);
            }
        }
        Ok(())
    }
}
