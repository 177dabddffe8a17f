//! The attitude loop of the paper's spacecraft, with the mission's own control law and the test masses at rest.

use dragfree_hinf_dfacs::known::KnownModel;
use dragfree_hinf_dfacs::noise_calibration::NoiseScale;
use dragfree_hinf_dfacs::on_demand::Needs;
use dragfree_hinf_dfacs::reconstruction::{AngularAcceleration, Epoch, Reconstruction, Row, Settings};
use dragfree_hinf_dfacs::replay::{CommandNumbers, ReadoutNumbers};
use dragfree_physics::control::{ControlLaw, Readout, TestMassReadout};
use dragfree_physics::mission::Mission;
use nalgebra::{Matrix3, Vector3};
use std::sync::OnceLock;

pub(crate) const RATE_HZ: f64 = 10.0;
pub(crate) const DT_S: f64 = 1.0 / RATE_HZ;

/// Every column on demand.
pub(crate) const EVERYTHING: Needs =
    Needs { commands: true, torque_response: true, dws_delay_response: true, prediction: false };

/// The default mission without sunlight, so that nothing but the loop moves the spacecraft, with its controllers
/// designed once for all tests.
pub(crate) fn mission() -> Mission {
    static MISSION: OnceLock<Mission> = OnceLock::new();
    MISSION.get_or_init(designed).clone()
}

fn designed() -> Mission {
    let text = include_str!("../../../../fixtures/missions/taiji.toml");
    let value: serde_json::Value = toml::from_str(text).expect("the fixture is TOML");
    let mut mission = Mission::from_json(&value.to_string()).expect("the fixture is a mission");
    mission.solar_pressure = None;
    let design = dragfree_physics::control_design::design(&mission).expect("the fixture is complete");
    mission.control.as_mut().expect("the fixture has a loop").channel = design.controllers();
    mission
}

/// The mission with thrusters that act 0.2 s late, behind a lag of 0.2 s.
pub(crate) fn late(mut mission: Mission) -> Mission {
    let thrusters = serde_json::json!({"lag_s": 0.2, "delay_s": 0.2});
    mission.thrusters = Some(serde_json::from_value(thrusters).expect("lag and delay"));
    mission
}

pub(crate) fn settings(angular_acceleration: AngularAcceleration) -> Settings {
    Settings {
        rate_hz: RATE_HZ,
        angular_acceleration,
        commands: true,
        sun: false,
        replay: false,
        warm_up_s: 60.0,
        scale: NoiseScale::nominal(),
        needs: Needs::default(),
    }
}

pub(crate) fn stage(mission: &Mission, settings: &Settings) -> Reconstruction {
    Reconstruction::new(mission, settings).expect("the fixture is complete")
}

/// One-sided PSDs of the torque (per axis, N² m²/Hz) and of the attitude readout (rad²/Hz).
pub(crate) fn levels(mission: &Mission) -> [f64; 2] {
    let n = &mission.noise;
    let torque = n.thruster_torque.as_ref().expect("the fixture has it").asd_nm_rthz;
    let sensing = n.dws_long_arm.as_ref().expect("the fixture has it").asd_rad_rthz;
    [torque * torque, sensing * sensing]
}

pub(crate) struct AttitudeLoop {
    law: ControlLaw,
    known: KnownModel,
    inertia_inverse: Matrix3<f64>,
    theta: Vector3<f64>,
    omega: Vector3<f64>,
    /// Whether the thrusters act as [`late`] says; what they make, and the commands of the two samples before.
    late: bool,
    made_nm: Vector3<f64>,
    before_nm: [Vector3<f64>; 2],
    time_ns: i64,
}

impl AttitudeLoop {
    pub(crate) fn new(mission: &Mission) -> Self {
        Self {
            law: ControlLaw::new(mission).expect("the fixture is complete"),
            known: KnownModel::new(mission).expect("the fixture is complete"),
            inertia_inverse: mission.spacecraft.inertia_inverse(),
            theta: Vector3::zeros(),
            omega: Vector3::zeros(),
            late: mission.thrusters.is_some(),
            made_nm: Vector3::zeros(),
            before_nm: [Vector3::zeros(); 2],
            time_ns: 0,
        }
    }

    /// One sample under a disturbing torque, with an error of the readout: telemetry and the true mean `α`.
    pub(crate) fn step(&mut self, torque_nm: &Vector3<f64>, error_rad: &Vector3<f64>) -> (Epoch, Vector3<f64>) {
        let y = self.theta + error_rad;
        let command = self.law.step(&Readout { sc_crf_rad: y, ..Readout::zero(2) });
        let rest = [TestMassReadout::default(); 2];
        let mut acting = command;
        if self.late {
            // y → u with e^{−t/0.2 s} over 0.1 s.
            let [oldest, older] = self.before_nm;
            let left = (-0.5_f64).exp();
            acting.mps_torque_srf_nm = oldest + (self.made_nm - oldest) * ((1.0 - left) / 0.5);
            self.made_nm = oldest + (self.made_nm - oldest) * left;
            self.before_nm = [older, command.mps_torque_srf_nm];
        }
        let known = self.known.motion(&acting, None, &rest, &Vector3::zeros());
        let alpha = known.alpha_srf_rad_s2 + self.inertia_inverse * torque_nm;
        self.theta += self.omega * DT_S + alpha * (0.5 * DT_S * DT_S);
        self.omega += alpha * DT_S;
        let time_ns = self.time_ns;
        self.time_ns += 100_000_000;
        let mut readout = still();
        readout[..3].copy_from_slice(y.as_slice());
        let missing = Vector3::from_element(f64::NAN);
        let epoch = Epoch {
            time_ns,
            readout,
            command: command.numbers().collect(),
            sun_srf: missing,
            ephemeris_age_s: f64::NAN,
            omega_crf_rad_s: missing,
            alpha_crf_rad_s2: missing,
        };
        (epoch, alpha)
    }
}

/// A readout of nothing but zeros.
pub(crate) fn still() -> ReadoutNumbers {
    ReadoutNumbers::from([0.0; 15])
}

/// A command that nobody knows.
pub(crate) fn unknown() -> CommandNumbers {
    CommandNumbers::from([f64::NAN; 18])
}

/// A whole record at once.
pub(crate) fn run(stage: &mut Reconstruction, epochs: &[Epoch]) -> Vec<Row> {
    let mut rows = Vec::new();
    for epoch in epochs {
        stage.push(epoch, &mut rows).expect("the law takes its own state");
    }
    stage.finish(&mut rows);
    rows
}
