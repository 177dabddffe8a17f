//! What the spacecraft truly is: gains, cross-talk, tilt and offsets that the controller does not know.

use dragfree_physics::control::Command;
use dragfree_sdk::PluginError;
use nalgebra::{Matrix3, Vector3};

/// Effects that [`Imperfections::parse`] knows.
const KNOWN: &str = "com-offset:sc.AXIS, es-gain:tmN.AXIS, es-crosstalk:tmN.FROM-TO, mps-gain:sc.AXIS, mps-tilt:sc.AXIS, torque-gain:sc.AXIS";

/// Matrices between command and true load, without the unit matrix.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Imperfections {
    mps_force: Matrix3<f64>,
    mps_torque: Matrix3<f64>,
    es_force: [Matrix3<f64>; 2],
    /// How much farther both housings sit from the centre of mass, SRF, m.
    pub com_offset_srf_m: Vector3<f64>,
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
            ("com-offset", "sc") => self.com_offset_srf_m[axis(place)?] += size,
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

#[cfg(test)]
mod tests {
    use super::*;

    fn command() -> Command {
        let mut c = Command { mps_force_srf_n: Vector3::new(1.0, 2.0, 3.0), ..Command::default() };
        c.mps_torque_srf_nm = Vector3::new(4.0, 5.0, 6.0);
        c.tm[1].force_orf_n = Vector3::new(0.0, 7.0, 8.0);
        c
    }

    fn acting(text: &str) -> Command {
        Imperfections::parse(&[text.to_owned()]).unwrap().act(&command())
    }

    #[test]
    fn each_effect_changes_what_it_names() {
        assert_eq!(Imperfections::default().act(&command()), command());
        assert_eq!(acting("es-gain:tm2.y=0.5").tm[1].force_orf_n, Vector3::new(0.0, 10.5, 8.0));
        assert_eq!(acting("es-crosstalk:tm2.y-x=0.5").tm[1].force_orf_n, Vector3::new(3.5, 7.0, 8.0));
        assert_eq!(acting("mps-gain:sc.z=0.5").mps_force_srf_n, Vector3::new(1.0, 2.0, 4.5));
        // 0.1 e_x × (1, 2, 3) = (0, −0.3, 0.2)
        let tilted = acting("mps-tilt:sc.x=0.1").mps_force_srf_n;
        assert!((tilted - Vector3::new(1.0, 1.7, 3.2)).norm() < 1e-15);
        assert_eq!(acting("torque-gain:sc.y=-0.5").mps_torque_srf_nm, Vector3::new(4.0, 2.5, 6.0));
        let two = ["es-gain:tm2.y=0.25".to_owned(), "es-gain:tm2.y=0.25".to_owned()];
        assert_eq!(Imperfections::parse(&two).unwrap().act(&command()), acting("es-gain:tm2.y=0.5"));
    }

    #[test]
    fn what_is_not_there_is_refused() {
        for text in [
            "",
            "es-gain",
            "es-gain:tm1.y",
            "es-gain:tm1.w=1",
            "es-gain:tm1.y=inf",
            "es-crosstalk:tm1.y-y=1",
            "mps-gain:tm1.x=1",
            "thermal:tm1.x=1",
        ] {
            assert!(Imperfections::parse(&[text.to_owned()]).is_err(), "{text}");
        }
    }
}
