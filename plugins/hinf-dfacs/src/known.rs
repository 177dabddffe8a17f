//! Known forces and torques by commands, sunlight and stiffness (Section IV, `û_i`).

use dragfree_physics::control::{Command, PerTestMass, TestMassCommand, TestMassReadout};
use dragfree_physics::mission::{Mission, MissionError};
use nalgebra::{Matrix3, Vector3};

const NEEDED_BY: &str = "hinf-dfacs";

/// The known motion over one sample interval.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct KnownMotion {
    /// `û_i`: known acceleration of each test mass relative to its housing without the offset's terms, ORF, m s⁻².
    pub u_orf_m_s2: PerTestMass<Vector3<f64>>,
    /// Angular acceleration of the spacecraft relative to IRF by the known torques, SRF, rad s⁻².
    pub alpha_srf_rad_s2: Vector3<f64>,
}

/// Model of the known motion: nominal masses, inertia, offsets and stiffness.
#[derive(Clone, Debug)]
pub struct KnownModel {
    mass_kg: f64,
    inertia_kg_m2: Matrix3<f64>,
    inertia_inverse: Matrix3<f64>,
    /// `k_dSC`, N, and the lever arm of the force, SRF, m.
    sunlight: Option<(f64, Vector3<f64>)>,
    tm: Vec<KnownTestMass>,
}

#[derive(Clone, Debug)]
struct KnownTestMass {
    mass_kg: f64,
    dcm_orf_from_srf: Matrix3<f64>,
    offset_nominal_srf_m: Vector3<f64>,
    stiffness_tt: Matrix3<f64>,
    stiffness_tr: Matrix3<f64>,
}

impl KnownModel {
    /// The model of a mission.
    ///
    /// # Errors
    /// [`MissionError::Missing`] without a test mass, [`MissionError::Value`] for a singular inertia.
    pub fn new(mission: &Mission) -> Result<Self, MissionError> {
        if mission.test_mass.is_empty() {
            return Err(MissionError::Missing { section: "test_mass".to_owned(), needed_by: NEEDED_BY });
        }
        let tm = mission.test_mass.values().map(|section| KnownTestMass {
            mass_kg: section.mass_kg,
            dcm_orf_from_srf: section.dcm_orf_from_srf(),
            offset_nominal_srf_m: Vector3::from(section.offset_nominal_srf_m),
            stiffness_tt: section.stiffness_tt(),
            stiffness_tr: section.stiffness_tr(),
        });
        Ok(Self {
            mass_kg: mission.spacecraft.mass_kg,
            inertia_kg_m2: mission.spacecraft.inertia(),
            inertia_inverse: mission.spacecraft.inertia_inverse(),
            sunlight: mission.solar_pressure.as_ref().map(|s| (s.force_n, Vector3::from(s.arm_srf_m))),
            tm: tm.collect(),
        })
    }

    /// The known motion under one command:
    /// `û_i = −T_S^{O_i}(F̂_T + F̂_SRP − Σ_j T_{O_j}^S F̂_Ej)/m_S + F̂_Ei/m_m + S_TT r_i + S_TR θ_i`, and
    /// `α = J_S⁻¹(M̂_T + D̂_SRP − Σ T M̂_Ei − Σ b_i×(T F̂_Ei) − ω×J_S ω)` (eq:SC_attitude_dynamics with two signs
    /// corrected, as the electrodes' reaction acts on the spacecraft).
    ///
    /// `sun_srf` is the unit vector from the Sun, `None` if sunlight is not modelled; `omega_srf_rad_s` is relative to
    /// IRF. The stiffness term adds the readout noise `S n` to `û`: smaller by `S/(2πf)²` than the `n̈` that the second
    /// difference of the same readout has.
    pub fn motion(
        &self,
        command: &Command,
        sun_srf: Option<&Vector3<f64>>,
        readout: &[TestMassReadout],
        omega_srf_rad_s: &Vector3<f64>,
    ) -> KnownMotion {
        let mut force = command.mps_force_srf_n;
        let mut torque = command.mps_torque_srf_nm - omega_srf_rad_s.cross(&(self.inertia_kg_m2 * omega_srf_rad_s));
        if let (Some((force_n, arm)), Some(sun)) = (&self.sunlight, sun_srf) {
            let pressure = sun * *force_n;
            force += pressure;
            torque += arm.cross(&pressure);
        }
        for (tm, electrodes) in self.tm.iter().zip(&command.tm) {
            let tm_force = tm.dcm_orf_from_srf.tr_mul(&electrodes.force_orf_n);
            force -= tm_force;
            torque -= tm.dcm_orf_from_srf.tr_mul(&electrodes.torque_orf_nm) + tm.offset_nominal_srf_m.cross(&tm_force);
        }
        let spacecraft_accel = force / self.mass_kg;
        let u = |((tm, electrodes), readout): ((&KnownTestMass, &TestMassCommand), &TestMassReadout)| {
            electrodes.force_orf_n / tm.mass_kg - tm.dcm_orf_from_srf * spacecraft_accel
                + tm.stiffness_tt * readout.r_orf_m
                + tm.stiffness_tr * readout.att_orf_rad
        };
        let u_orf_m_s2 = self.tm.iter().zip(&command.tm).zip(readout).map(u).collect();
        KnownMotion { u_orf_m_s2, alpha_srf_rad_s2: self.inertia_inverse * torque }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The paper's spacecraft without products of inertia, so that expected values can be computed by hand.
    fn model() -> KnownModel {
        let text = include_str!("../../../fixtures/missions/taiji.toml");
        let mut mission: Mission = toml::from_str(text).expect("the fixture is a mission");
        mission.spacecraft.inertia_srf_kg_m2 = [[800.0, 0.0, 0.0], [0.0, 800.0, 0.0], [0.0, 0.0, 1000.0]];
        KnownModel::new(&mission).expect("the fixture is complete")
    }

    fn close(got: Vector3<f64>, want: [f64; 3]) {
        let want = Vector3::from(want);
        assert!((got - want).norm() <= 1e-14 * want.norm().max(1e-30), "{got} against {want}");
    }

    fn motion(command: &Command) -> KnownMotion {
        model().motion(command, None, &[TestMassReadout::default(); 2], &Vector3::zeros())
    }

    const C: f64 = 0.866_025_403_784_438_6;

    /// 1.5 mN along s_1 accelerate the spacecraft by 1e-6 m/s², the test masses by the opposite. o_1 of bench 1 lies at
    /// +30° and of bench 2 at −30°, so the component along o_2 has opposite signs.
    #[test]
    fn thrust_accelerates_the_test_masses_relative_to_the_spacecraft() {
        let got = motion(&Command { mps_force_srf_n: Vector3::new(1.5e-3, 0.0, 0.0), ..Command::zero(2) });
        close(got.u_orf_m_s2[0], [-C * 1e-6, 0.5e-6, 0.0]);
        close(got.u_orf_m_s2[1], [-C * 1e-6, -0.5e-6, 0.0]);
        close(got.alpha_srf_rad_s2, [0.0, 0.0, 0.0]);
    }

    /// 1.96 nN on test mass 1 along its o_2 = (−1/2, √3/2, 0) in SRF: it gains 1e-9 m/s², and the spacecraft's recoil
    /// of 1.96e-9/1500 m/s² against o_2 of bench 1 adds to that. Bench 2 has its o_1 at (√3/2, −1/2, 0) and o_2 at
    /// (1/2, √3/2, 0): the recoil R·(1/2, −√3/2, 0) has components R·(√3/2, −1/2), and the test mass sees minus that.
    #[test]
    fn electrodes_push_the_test_mass_and_the_spacecraft_recoils() {
        let mut command = Command::zero(2);
        command.tm[0].force_orf_n = Vector3::new(0.0, 1.96e-9, 0.0);
        let got = motion(&command);
        let recoil = 1.96e-9 / 1500.0;
        close(got.u_orf_m_s2[0], [0.0, 1e-9 + recoil, 0.0]);
        close(got.u_orf_m_s2[1], [-C * recoil, 0.5 * recoil, 0.0]);
        // b_1 = (0, 0.18, 0), −F = 1.96e-9·(1/2, −√3/2, 0): torque −0.18·½·1.96e-9 about s_3.
        close(got.alpha_srf_rad_s2, [0.0, 0.0, -0.18 * 0.5 * 1.96e-9 / 1000.0]);
    }

    #[test]
    fn electrodes_torque_acts_back_on_the_spacecraft() {
        let mut command = Command::zero(2);
        command.tm[1] = TestMassCommand { torque_orf_nm: Vector3::new(0.0, 0.0, 1e-11), ..TestMassCommand::default() };
        close(motion(&command).alpha_srf_rad_s2, [0.0, 0.0, -1e-14]);
        command.tm[1].torque_orf_nm = Vector3::new(8e-12, 0.0, 0.0);
        // o_1 of bench 2 lies at −30°.
        close(motion(&command).alpha_srf_rad_s2, [-C * 1e-14, 0.5e-14, 0.0]);
    }

    /// A force F of sunlight along +s_1 at (0.1, 0, 0.6) m has the torque (0, 0.6 m, 0) F, as in the paper's matrix.
    #[test]
    fn sunlight_acts_as_a_force_at_its_lever_arm() {
        let sun = Vector3::new(1.0, 0.0, 0.0);
        let readout = [TestMassReadout::default(); 2];
        let got = model().motion(&Command::zero(2), Some(&sun), &readout, &Vector3::zeros());
        let a = 6.3513e-5 / 1500.0;
        close(got.u_orf_m_s2[0], [-C * a, 0.5 * a, 0.0]);
        close(got.alpha_srf_rad_s2, [0.0, 0.6 * 6.3513e-5 / 800.0, 0.0]);
    }

    #[test]
    fn a_spinning_spacecraft_precesses_by_eulers_sign() {
        let omega = Vector3::new(1e-3, 0.0, 2e-3);
        let got = model().motion(&Command::zero(2), None, &[TestMassReadout::default(); 2], &omega);
        // ω×Jω = (0, ω_3 J_1 ω_1 − ω_1 J_3 ω_3, 0) = (0, −200·2e-6, 0).
        close(got.alpha_srf_rad_s2, [0.0, 200.0 * 2e-6 / 800.0, 0.0]);
    }

    #[test]
    fn stiffness_acts_on_the_measured_displacement() {
        let mut readout = [TestMassReadout::default(); 2];
        readout[0].r_orf_m = Vector3::new(1e-9, 2e-9, 3e-9);
        readout[1].att_orf_rad = Vector3::new(1e-6, 0.0, -1e-6);
        let got = model().motion(&Command::zero(2), None, &readout, &Vector3::zeros());
        close(got.u_orf_m_s2[0], [-6e-16, -20e-16, -36e-16]);
        close(got.u_orf_m_s2[1], [1e-15, 0.0, -1e-15]);
    }
}
