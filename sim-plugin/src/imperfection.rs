//! What the actuators truly do with a command: gains, cross-talk and tilt that the controller does not know.

use dragfree_physics::control::Command;
use dragfree_sdk::PluginError;
use nalgebra::{Matrix3, Vector3};

/// Effects that [`Imperfections::parse`] knows.
const KNOWN: &str =
    "es-gain:tmN.AXIS, es-crosstalk:tmN.FROM-TO, mps-gain:sc.AXIS, mps-tilt:sc.AXIS, torque-gain:sc.AXIS";

/// Matrices between command and true load, without the unit matrix.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Imperfections {
    mps_force: Matrix3<f64>,
    mps_torque: Matrix3<f64>,
    es_force: [Matrix3<f64>; 2],
}

fn axis(name: &str) -> Option<usize> {
    ["x", "y", "z"].iter().position(|a| *a == name)
}

fn test_mass(name: &str) -> Option<usize> {
    ["tm1", "tm2"].iter().position(|t| *t == name)
}

impl Imperfections {
    /// Reads `ID:INSTANCE=SIZE`, as in `es-crosstalk:tm2.y-x=0.03`: 3 % of what is commanded along y acts along x.
    ///
    /// # Errors
    /// The text is of another form, or names an effect, a place or a size that the simulator does not know.
    pub fn parse(list: &[String]) -> Result<Self, PluginError> {
        let mut out = Self::default();
        for text in list {
            out.add(text).ok_or_else(|| {
                PluginError::new(format!(
                    "effect {text}: not ID:INSTANCE=SIZE of an effect that the simulator has; it has {KNOWN}"
                ))
            })?;
        }
        Ok(out)
    }

    fn add(&mut self, text: &str) -> Option<()> {
        let (name, size) = text.split_once('=')?;
        let size: f64 = size.trim().parse().ok().filter(|s: &f64| s.is_finite())?;
        let (id, instance) = name.trim().split_once(':')?;
        let (body, place) = instance.split_once('.')?;
        match (id, body) {
            ("es-gain", _) => {
                let a = axis(place)?;
                self.es_force[test_mass(body)?][(a, a)] += size;
            }
            ("es-crosstalk", _) => {
                let (from, to) = place.split_once('-')?;
                let (from, to) = (axis(from)?, axis(to)?);
                if from == to {
                    return None;
                }
                self.es_force[test_mass(body)?][(to, from)] += size;
            }
            ("mps-gain", "sc") => self.mps_force[(axis(place)?, axis(place)?)] += size,
            // θ × F_T for a thrust frame turned by θ about the axis.
            ("mps-tilt", "sc") => {
                let mut turn = Vector3::zeros();
                turn[axis(place)?] = size;
                self.mps_force += dragfree_physics::frames::skew(&turn);
            }
            ("torque-gain", "sc") => self.mps_torque[(axis(place)?, axis(place)?)] += size,
            _ => return None,
        }
        Some(())
    }

    /// What acts when `command` is given.
    #[must_use]
    pub fn act(&self, command: &Command) -> Command {
        let mut out = *command;
        out.mps_force_srf_n += self.mps_force * command.mps_force_srf_n;
        out.mps_torque_srf_nm += self.mps_torque * command.mps_torque_srf_nm;
        for i in 0..2 {
            out.tm[i].force_orf_n += self.es_force[i] * command.tm[i].force_orf_n;
        }
        out
    }
}
