//! Actuators whose output differs from the command.

use dragfree_physics::control::Command;
use dragfree_physics::mission::{AXES, Mission, MissionError};
use nalgebra::Matrix3;

use super::request::{Built, EffectRequest, Kind, Number, Place, Shape, sc_axes, tm_axes, tm_pairs};
use super::{Basis, Cause, along};

const GAIN: Number = Number::new("1", -3.0, 3.0);

/// Seconds in a day.
const DAY_S: f64 = 86_400.0;

const DRIFT: &[Shape] = &[Shape::new(
    "per_day",
    Number::new("SIZE/day", -100.0, 100.0),
    0.0,
    "change of SIZE in a day, at the same rate from the first sample on",
)];

pub(super) const KINDS: &[Kind] = &[
    Kind {
        id: "es-gain",
        places: |count| tm_axes(count).into_iter().filter(|place| !matches!(place, Place::TmAxis(_, 0))).collect(),
        size: GAIN,
        help: "electrodes: a commanded force F acts as (1 + SIZE) F along the axis",
        shape: DRIFT,
        build,
    },
    Kind {
        id: "es-crosstalk",
        places: |count| tm_pairs(count, &[1, 2]),
        size: GAIN,
        help: "electrodes: NAME.y-x lets SIZE times the force commanded along y act along x too",
        shape: DRIFT,
        build,
    },
    Kind {
        id: "mps-gain",
        places: sc_axes,
        size: GAIN,
        help: "thrusters: a commanded force F acts as (1 + SIZE) F along the axis",
        shape: DRIFT,
        build,
    },
    Kind {
        id: "mps-tilt",
        places: sc_axes,
        size: Number::new("rad", -1.0, 1.0),
        help: "thrusters: their frame is turned by SIZE about the axis, F acts as F + θ × F",
        shape: DRIFT,
        build,
    },
    Kind {
        id: "torque-gain",
        places: sc_axes,
        size: GAIN,
        help: "thrusters: a commanded torque M acts as (1 + SIZE) M about the axis; an error of the inertia looks the same",
        shape: DRIFT,
        build,
    },
];

fn build(request: &EffectRequest, basis: &Basis<'_>) -> Built {
    if let Place::TmAxis(tm, axis) | Place::TmPair { tm, from: axis, .. } = request.place {
        electrodes_along(basis.mission, tm, axis)?;
    }
    let part = |to: usize, from: usize| along(to) * along(from).transpose();
    let (output, matrix) = match (request.kind.id, request.place) {
        ("mps-tilt", Place::ScAxis(axis)) => (Output::Thrust, along(axis).cross_matrix()),
        ("torque-gain", Place::ScAxis(axis)) => (Output::Torque, part(axis, axis)),
        (_, Place::ScAxis(axis)) => (Output::Thrust, part(axis, axis)),
        (_, Place::TmAxis(tm, axis)) => (Output::Electrodes(tm), part(axis, axis)),
        (_, Place::TmPair { tm, from, to }) => (Output::Electrodes(tm), part(to, from)),
        _ => unreachable!("instances are axes and pairs of them"),
    };
    Ok(Box::new(Actuator { output, matrix, size: request.size, per_day: request.shape("per_day") }))
}

/// That electrodes are commanded along an axis of a test mass.
fn electrodes_along(mission: &Mission, tm: usize, axis: usize) -> Result<(), MissionError> {
    match mission.test_mass.iter().nth(tm) {
        Some((name, section)) if section.is_drag_free(axis) => Err(MissionError::Value {
            key: format!("test_mass.{name}.drag_free"),
            value: AXES[axis].to_owned(),
            reason: "the test mass is free along it: no electrode is commanded there",
        }),
        _ => Ok(()),
    }
}

enum Output {
    Thrust,
    Torque,
    Electrodes(usize),
}

/// Adds `size · matrix · command` to the output.
struct Actuator {
    output: Output,
    matrix: Matrix3<f64>,
    /// At the first sample of the telemetry.
    size: f64,
    per_day: f64,
}

impl Cause for Actuator {
    fn act(&mut self, elapsed_s: f64, command: &Command, acting: &mut Command) {
        let matrix = self.matrix * (self.size + self.per_day * elapsed_s / DAY_S);
        match self.output {
            Output::Thrust => acting.mps_force_srf_n += matrix * command.mps_force_srf_n,
            Output::Torque => acting.mps_torque_srf_nm += matrix * command.mps_torque_srf_nm,
            Output::Electrodes(i) => acting.tm[i].force_orf_n += matrix * command.tm[i].force_orf_n,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::Effects;
    use super::*;
    use nalgebra::Vector3;

    fn command() -> Command {
        let mut c = Command { mps_force_srf_n: Vector3::new(1.0, 2.0, 3.0), ..Command::zero(2) };
        c.mps_torque_srf_nm = Vector3::new(4.0, 5.0, 6.0);
        c.tm[1].force_orf_n = Vector3::new(0.0, 7.0, 8.0);
        c
    }

    fn acting(effects: &[&str]) -> Command {
        acting_after(0.0, effects)
    }

    fn acting_after(elapsed_s: f64, effects: &[&str]) -> Command {
        let mission = crate::testing::taiji();
        let names: Vec<String> = mission.test_mass.keys().cloned().collect();
        let request: Vec<EffectRequest> =
            effects.iter().map(|text| EffectRequest::parse(text, &names).unwrap()).collect();
        Effects::new(&request, &Basis { mission: &mission }, 1).unwrap().act(elapsed_s, &command())
    }

    #[test]
    fn each_changes_what_it_names() {
        assert_eq!(acting(&[]), command());
        assert_eq!(acting(&["es-gain:tm2.y=0.5"]).tm[1].force_orf_n, Vector3::new(0.0, 10.5, 8.0));
        assert_eq!(acting(&["es-crosstalk:tm2.y-x=0.5"]).tm[1].force_orf_n, Vector3::new(3.5, 7.0, 8.0));
        assert_eq!(acting(&["mps-gain:sc.z=0.5"]).mps_force_srf_n, Vector3::new(1.0, 2.0, 4.5));
        // 0.1 e_x × (1, 2, 3) = (0, −0.3, 0.2)
        let tilted = acting(&["mps-tilt:sc.x=0.1"]).mps_force_srf_n;
        assert!((tilted - Vector3::new(1.0, 1.7, 3.2)).norm() < 1e-15);
        assert_eq!(acting(&["torque-gain:sc.y=-0.5"]).mps_torque_srf_nm, Vector3::new(4.0, 2.5, 6.0));
        // Two of them act on the command, not on one another.
        assert_eq!(acting(&["es-gain:tm2.y=0.25", "es-gain:tm2.y=0.25"]), acting(&["es-gain:tm2.y=0.5"]));
    }
    #[test]
    fn a_gain_drifts_from_the_first_sample_on() {
        let gain = |hours: f64| {
            let effects = ["mps-gain:sc.z=0.5,per_day=-0.5"];
            acting_after(3600.0 * hours, &effects).mps_force_srf_n[2] / command().mps_force_srf_n[2] - 1.0
        };
        for (hours, want) in [(0.0, 0.5), (12.0, 0.25), (24.0, 0.0)] {
            assert!((gain(hours) - want).abs() < 1e-12);
        }
    }
}
