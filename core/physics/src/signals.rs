//! Inputs and outputs of a control law: readouts and commands of the spacecraft and its test masses.

use nalgebra::Vector3;

use crate::few::Few;
use crate::mission::{Actuators, MOST_TEST_MASSES};

/// One value for each test mass, in the order of their names.
pub type PerTestMass<T> = Few<T, MOST_TEST_MASSES>;

/// Readout of one test mass at `t_k`.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct TestMassReadout {
    /// Displacement from the housing's centre, ORF, m: by interferometer along its axes, else by the inertial sensor.
    pub r_orf_m: Vector3<f64>,
    /// Attitude relative to ORF, rad: `θ` and `ψ` from local wavefront sensing where x has an interferometer, else from
    /// the inertial sensor, as `φ`.
    pub att_orf_rad: Vector3<f64>,
}

/// Readout at `t_k`. Every value must be finite; a replay of telemetry holds the last valid sample.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Readout {
    /// Attitude of the spacecraft relative to CRF, `φ, θ, ψ`, rad.
    pub sc_crf_rad: Vector3<f64>,
    /// The test masses.
    pub tm: PerTestMass<TestMassReadout>,
    /// Unit vector from the Sun to the spacecraft, SRF: the latest `/ephemeris` packet at or before `t_k`.
    /// `None` before the first one; sunlight is not fed forward then.
    pub sun_srf: Option<Vector3<f64>>,
}

impl Readout {
    /// Zero readout.
    pub fn zero(test_masses: usize) -> Self {
        let tm = PerTestMass::from_fn(test_masses, |_| TestMassReadout::default());
        Self { sc_crf_rad: Vector3::zeros(), tm, sun_srf: None }
    }
}

/// Command to the electrodes of one test mass.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct TestMassCommand {
    /// Electrostatic force on the test mass, ORF, N; none along the drag-free axes.
    pub force_orf_n: Vector3<f64>,
    /// Electrostatic torque on the test mass, ORF, N m.
    pub torque_orf_nm: Vector3<f64>,
}

/// Command over one sample interval.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Command {
    /// Thrust on the spacecraft `F_T`, SRF, N.
    pub mps_force_srf_n: Vector3<f64>,
    /// Thrusters' torque about the centre of mass `M_T`, SRF, N m.
    pub mps_torque_srf_nm: Vector3<f64>,
    /// Electrostatic commands of the test masses.
    pub tm: PerTestMass<TestMassCommand>,
}

impl Command {
    /// Zero command.
    pub fn zero(test_masses: usize) -> Self {
        let tm = PerTestMass::from_fn(test_masses, |_| TestMassCommand::default());
        Self { tm, ..Self::default() }
    }

    /// Whether any component is at its limit or beyond it.
    pub fn reaches(&self, limits: &Actuators) -> bool {
        let reaches = |v: &Vector3<f64>, limit: f64| v.iter().fold(false, |any, x| any | (x.abs() >= limit));
        let tm = self.tm.iter().fold(false, |any, tm| {
            any | reaches(&tm.force_orf_n, limits.electrostatic_force_limit_n)
                | reaches(&tm.torque_orf_nm, limits.electrostatic_torque_limit_nm)
        });
        tm | reaches(&self.mps_force_srf_n, limits.thrust_limit_n)
            | reaches(&self.mps_torque_srf_nm, limits.torque_limit_nm)
    }

    /// The same with every component within its limit.
    pub fn limited(mut self, limits: &Actuators) -> Self {
        let clamp = |v: &mut Vector3<f64>, limit: f64| v.apply(|x| *x = x.clamp(-limit, limit));
        clamp(&mut self.mps_force_srf_n, limits.thrust_limit_n);
        clamp(&mut self.mps_torque_srf_nm, limits.torque_limit_nm);
        for tm in &mut self.tm {
            clamp(&mut tm.force_orf_n, limits.electrostatic_force_limit_n);
            clamp(&mut tm.torque_orf_nm, limits.electrostatic_torque_limit_nm);
        }
        self
    }

    /// Thrust and torque of the thrusters, then force and torque on each test mass, axis by axis, N and N m.
    pub fn numbers(&self) -> impl Iterator<Item = f64> + '_ {
        let test_masses = self.tm.iter().flat_map(|tm| [&tm.force_orf_n, &tm.torque_orf_nm]);
        [&self.mps_force_srf_n, &self.mps_torque_srf_nm].into_iter().chain(test_masses).flatten().copied()
    }

    /// The inverse of [`Self::numbers`].
    ///
    /// # Panics
    /// There are fewer than six numbers, or more than those of [`MOST_TEST_MASSES`].
    pub fn from_numbers(numbers: &[f64]) -> Self {
        let vector = |v: &[f64]| Vector3::from_column_slice(v);
        let (thrusters, test_masses) = numbers.split_at(6);
        let tm = test_masses.chunks_exact(6);
        Self {
            mps_force_srf_n: vector(&thrusters[..3]),
            mps_torque_srf_nm: vector(&thrusters[3..]),
            tm: tm.map(|v| TestMassCommand { force_orf_n: vector(&v[..3]), torque_orf_nm: vector(&v[3..]) }).collect(),
        }
    }
}
