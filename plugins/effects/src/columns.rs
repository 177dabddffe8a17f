//! Test masses of a mission, and the columns of earlier stages from which effects make regressors.

use dragfree_physics::mission::{Mission, TestMass};
use dragfree_sdk::prelude::*;

use crate::common::{AXES, tm_of};

/// A test mass of the mission.
#[derive(Clone, Debug)]
pub(crate) struct Body {
    pub(crate) name: String,
    /// Name of its frame ORF.
    pub(crate) frame: String,
    pub(crate) section: TestMass,
}

impl Body {
    /// All test masses of the mission, in the order of their names.
    pub(crate) fn all(mission: &Mission) -> Vec<Self> {
        let body = |(name, section): (&String, &TestMass)| Self {
            name: name.clone(),
            frame: mission.frame(name),
            section: section.clone(),
        };
        mission.test_mass.iter().map(body).collect()
    }

    /// The test mass of an instance such as `NAME` or `NAME.x`.
    ///
    /// # Errors
    /// The mission has no such test mass.
    pub(crate) fn of(mission: &Mission, instance: &str, by: &'static str) -> Result<Self, PluginError> {
        let name = tm_of(instance);
        let section = mission.test_mass(name, by)?.clone();
        Ok(Self { name: name.to_owned(), frame: mission.frame(name), section })
    }
}

/// A column that an earlier stage writes.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct InputColumn {
    pub(crate) name: String,
    pub(crate) unit: &'static str,
    pub(crate) frame: String,
}

impl InputColumn {
    pub(crate) fn new(name: String, unit: &'static str, frame: impl Into<String>) -> Self {
        Self { name, unit, frame: frame.into() }
    }

    /// Commanded force of the thrusters, mean over the sample, SRF, N.
    pub(crate) fn thrust(axis: usize) -> Self {
        Self::new(format!("used.mps_force_srf_n.{}", AXES[axis]), "N", "SRF")
    }

    /// Commanded torque of the thrusters, mean over the sample, SRF, N m.
    pub(crate) fn torque(axis: usize) -> Self {
        Self::new(format!("used.mps_torque_srf_nm.{}", AXES[axis]), "N m", "SRF")
    }

    /// Commanded force of the electrodes on a test mass, mean over the sample, ORF, N.
    pub(crate) fn electrodes_force(tm: &Body, axis: usize) -> Self {
        Self::new(format!("used.{}.force_orf_n.{}", tm.name, AXES[axis]), "N", &tm.frame)
    }

    /// Commanded torque of the electrodes on a test mass, mean over the sample, ORF, N m.
    pub(crate) fn electrodes_torque(tm: &Body, axis: usize) -> Self {
        Self::new(format!("used.{}.torque_orf_nm.{}", tm.name, AXES[axis]), "N m", &tm.frame)
    }

    /// Unit vector from the Sun, SRF.
    pub(crate) fn sun(axis: usize) -> Self {
        Self::new(format!("used.sun_srf.{}", AXES[axis]), "1", "SRF")
    }

    /// Known acceleration `û` of a test mass, ORF, m s⁻².
    pub(crate) fn known_accel(tm: &Body, axis: usize) -> Self {
        Self::new(format!("{}.u_orf_m_s2.{}", tm.name, AXES[axis]), "m s-2", &tm.frame)
    }

    /// Acceleration channel of a test mass, ORF, m s⁻².
    pub(crate) fn channel(tm: &Body, axis: usize) -> Self {
        Self::new(accel_channel(tm, axis), "m s-2", &tm.frame)
    }

    /// Best readout of a test mass's displacement, ORF, m.
    pub(crate) fn displacement(tm: &Body, axis: usize) -> Self {
        Self::new(format!("{}.r_orf_m.{}", tm.name, AXES[axis]), "m", &tm.frame)
    }

    /// Estimate `α̂` of the spacecraft's angular acceleration, SRF, rad s⁻².
    pub(crate) fn alpha(axis: usize) -> Self {
        Self::new(format!("sc.alpha_srf_rad_s2.{}", AXES[axis]), "rad s-2", "SRF")
    }

    /// Derivative `∂α̂_j/∂g_i`, SRF, rad s⁻²; the torque about axis `i` is `1 + g_i` times the commanded one.
    pub(crate) fn alpha_by_torque_gain(i: usize, j: usize) -> Self {
        let name = format!("response.alpha_srf_rad_s2.by_torque_gain.{}.{}", AXES[i], AXES[j]);
        Self::new(name, "rad s-2", "SRF")
    }

    /// Derivative `∂û_row/∂g_i` of a test mass, ORF, m s⁻²; written only for thrusters with a layout.
    pub(crate) fn known_accel_by_torque_gain(i: usize, tm: &Body, row: usize) -> Self {
        let name = format!("response.u_orf_m_s2.by_torque_gain.{}.{}.{}", AXES[i], tm.name, AXES[row]);
        Self::new(name, "m s-2", &tm.frame)
    }

    /// Derivative `∂α̂_j/∂τ`, SRF, rad s⁻³, for a delay `τ` of the attitude readout.
    pub(crate) fn alpha_by_dws_delay(j: usize) -> Self {
        Self::new(format!("response.alpha_srf_rad_s2.by_dws_delay.{}", AXES[j]), "rad s-3", "SRF")
    }

    /// Angle of a test mass by differential wavefront sensing, ORF, rad.
    pub(crate) fn angle_by_dws(tm: &Body, angle: &str) -> Self {
        Self::new(format!("dws.{}.{angle}_orf_rad", tm.name), "rad", &tm.frame)
    }

    /// Angle of a test mass by the capacitive readout, ORF, rad.
    pub(crate) fn angle_by_is(tm: &Body, angle: &str) -> Self {
        Self::new(format!("is.{}.att_orf_rad.{angle}", tm.name), "rad", &tm.frame)
    }

    /// An available column, with the unit that the effect expects.
    pub(crate) fn of(column: &Column, unit: &'static str) -> Self {
        Self::new(column.name.clone(), unit, &column.frame)
    }
}

/// The column of this name that was written last, e.g. the reconstruction's `NAME.r_orf_m.y` rather than the raw
/// topic's.
pub(crate) fn latest_column<'a>(available: &'a Available, name: &str) -> Option<&'a Column> {
    available.columns.iter().rev().find(|c| c.name == name)
}

/// What an available column lacks in prediction mode, its attribute [`UNPREDICTED_ATTRIBUTE`]; `None` for a column that
/// is known completely, as all are outside of that mode.
pub(crate) fn unpredicted<'a>(available: &'a Available, column: &InputColumn) -> Option<&'a str> {
    let column = latest_column(available, &column.name)?;
    Some(column.attribute(UNPREDICTED_ATTRIBUTE)).filter(|gains| !gains.is_empty())
}

/// Whether `α̂` is what is commanded, as in prediction mode, and lacks what anything else does to the attitude.
pub(crate) fn alpha_is_commanded(available: &Available) -> bool {
    (0..3).all(|j| unpredicted(available, &InputColumn::alpha(j)).is_some())
}

/// Name of an acceleration channel, `NAME.accel.x`, m s⁻².
pub(crate) fn accel_channel(tm: &Body, axis: usize) -> String {
    format!("{}.accel.{}", tm.name, AXES[axis])
}
