//! The equations of motion of spacecraft and test masses in relative coordinates (design: the paper's Section II with
//! the signs of `ops-guide`), and their integration over one sample.
//!
//! Inertial positions are not used: at one astronomical unit the resolution of a double is too coarse.

use dragfree_physics::attitude::{derivative, from_rotation_vector, rotation_vector, turn, unit};
use dragfree_physics::control::PerTestMass;
use dragfree_physics::mission::{Mission, MissionError};
use nalgebra::{Matrix3, Quaternion, Vector3};

/// Constants of a test mass.
#[derive(Clone, Debug)]
pub struct TestMassBody {
    /// Mass `m_m`, kg.
    pub mass_kg: f64,
    /// `J_m`, MRF, kg m².
    pub inertia: Matrix3<f64>,
    /// `J_m⁻¹`.
    pub inertia_inverse: Matrix3<f64>,
    /// `T_S^O`.
    pub dcm_orf_from_srf: Matrix3<f64>,
    /// `b_i`, housing relative to the centre of mass, SRF, m.
    pub offset_srf_m: Vector3<f64>,
    /// `S_TT`, s⁻².
    pub stiffness_tt: Matrix3<f64>,
    /// `S_TR`, m s⁻² rad⁻¹.
    pub stiffness_tr: Matrix3<f64>,
    /// `S_RT`, rad s⁻² m⁻¹.
    pub stiffness_rt: Matrix3<f64>,
    /// `S_RR`, s⁻².
    pub stiffness_rr: Matrix3<f64>,
}

/// Spacecraft and test masses.
#[derive(Clone, Debug)]
pub struct Plant {
    /// Mass `m_S`, kg.
    pub sc_mass_kg: f64,
    /// `J_S`, SRF, kg m².
    pub sc_inertia: Matrix3<f64>,
    /// `J_S⁻¹`.
    pub sc_inertia_inverse: Matrix3<f64>,
    /// The test masses, in the order of their names.
    pub tm: Vec<TestMassBody>,
}

/// State of a test mass.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct TestMassState {
    /// `r_i`, relative to the housing's centre, ORF, m.
    pub r_orf_m: Vector3<f64>,
    /// `ṙ_i` in the rotating ORF, m/s.
    pub v_orf_m_s: Vector3<f64>,
    /// Turns ORF into MRF.
    pub q_mrf_from_orf: Quaternion<f64>,
    /// `ω_mI`, MRF, rad/s.
    pub omega_mrf_rad_s: Vector3<f64>,
}

/// State of everything.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct State {
    /// Turns CRF into SRF.
    pub q_srf_from_crf: Quaternion<f64>,
    /// `ω_SI`, SRF, rad/s.
    pub omega_srf_rad_s: Vector3<f64>,
    /// The test masses.
    pub tm: PerTestMass<TestMassState>,
}

/// Number of values of the spacecraft in a [`State`], and of each test mass.
const SPACECRAFT_NUMBERS: usize = 7;
const TEST_MASS_NUMBERS: usize = 13;

/// Loads on a test mass, constant over a sample.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct TestMassLoads {
    /// Electrostatic force `F_E`, which the spacecraft feels reversed, ORF, N.
    pub force_orf_n: Vector3<f64>,
    /// Electrostatic torque `M_E`, which the spacecraft feels reversed, ORF, N m.
    pub torque_orf_nm: Vector3<f64>,
    /// Stray acceleration and self-gravity, ORF, m/s².
    pub acceleration_orf_m_s2: Vector3<f64>,
    /// Stray angular acceleration, ORF, rad/s².
    pub angular_acceleration_orf_rad_s2: Vector3<f64>,
}

/// Loads that are constant over a sample.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Loads {
    /// Thrust and sunlight, `F_T + d_S`, SRF, N.
    pub force_srf_n: Vector3<f64>,
    /// Their torque about the centre of mass, `M_T + D_S`, SRF, N m.
    pub torque_srf_nm: Vector3<f64>,
    /// The test masses.
    pub tm: PerTestMass<TestMassLoads>,
}

impl Loads {
    /// Zero loads.
    pub fn zero(test_masses: usize) -> Self {
        Self { tm: PerTestMass::from_fn(test_masses, |_| TestMassLoads::default()), ..Self::default() }
    }

    /// Net force on the spacecraft, with the electrodes' reaction, SRF, N.
    pub fn net_force_srf_n(&self, plant: &Plant) -> Vector3<f64> {
        let pairs = plant.tm.iter().zip(&self.tm);
        pairs.fold(self.force_srf_n, |net, (body, load)| net - body.dcm_orf_from_srf.tr_mul(&load.force_orf_n))
    }
}

/// Rotation of CRF and gravity gradient over a sample.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Outside {
    /// `ω_CI` at the start of the sample, CRF, rad/s.
    pub omega_crf_rad_s: Vector3<f64>,
    /// `ω̇_CI`, CRF, rad/s².
    pub alpha_crf_rad_s2: Vector3<f64>,
    /// `Γ` in each ORF, s⁻².
    pub gradient_orf_s2: PerTestMass<Matrix3<f64>>,
}

/// Means over the sample that was integrated.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Means {
    /// Angular acceleration of the spacecraft `α`, SRF, rad/s².
    pub alpha_srf_rad_s2: Vector3<f64>,
    /// `a_ng`, SRF, m/s².
    pub nongrav_srf_m_s2: Vector3<f64>,
}

/// Quantities that are constant within a sample.
struct Held {
    torque_srf_nm: Vector3<f64>,
    nongrav_srf_m_s2: Vector3<f64>,
    tm: PerTestMass<HeldTestMass>,
}

#[derive(Clone, Copy, Default)]
struct HeldTestMass {
    /// `−T a_ng + (F_E + d_m)/m_m + a_sg`.
    acceleration_orf_m_s2: Vector3<f64>,
    torque_orf_nm: Vector3<f64>,
    angular_acceleration_orf_rad_s2: Vector3<f64>,
    gradient_orf_s2: Matrix3<f64>,
}

impl Plant {
    /// The plant of a mission whose housings sit `com_offset_srf_m` away from the drawings, relative to the centre of
    /// mass; `stiffness` multiplies each test mass' stiffness, element by element, in the order TT, TR, RR.
    ///
    /// # Errors
    /// [`MissionError::Missing`] when the mission lacks a test mass or its inertia.
    pub fn new(
        mission: &Mission,
        com_offset_srf_m: &Vector3<f64>,
        stiffness: &[[Matrix3<f64>; 3]],
    ) -> Result<Self, MissionError> {
        const NEEDED_BY: &str = "the simulator";
        let tm = mission.test_mass.iter().zip(stiffness).map(|((name, section), [tt, tr, rr])| {
            let inertia_inverse = section.inertia_inverse(name, NEEDED_BY)?;
            let stiffness_tr = section.stiffness_tr().component_mul(tr);
            Ok(TestMassBody {
                mass_kg: section.mass_kg,
                inertia: section.inertia(name, NEEDED_BY)?,
                inertia_inverse,
                dcm_orf_from_srf: section.dcm_orf_from_srf(),
                offset_srf_m: Vector3::from(section.offset_nominal_srf_m) + com_offset_srf_m,
                stiffness_tt: section.stiffness_tt().component_mul(tt),
                stiffness_tr,
                stiffness_rt: inertia_inverse * stiffness_tr.transpose() * section.mass_kg,
                stiffness_rr: section.stiffness_rr().component_mul(rr),
            })
        });
        Ok(Self {
            sc_mass_kg: mission.spacecraft.mass_kg,
            sc_inertia: mission.spacecraft.inertia(),
            sc_inertia_inverse: mission.spacecraft.inertia_inverse(),
            tm: tm.collect::<Result<_, MissionError>>()?,
        })
    }

    fn held(&self, loads: &Loads, outside: &Outside) -> Held {
        let (mut force, mut torque) = (loads.force_srf_n, loads.torque_srf_nm);
        for (body, load) in self.tm.iter().zip(&loads.tm) {
            // F_E acts on the test mass; the spacecraft feels −F_E at b_i (the paper's eq:SC_attitude_dynamics has +).
            let f = body.dcm_orf_from_srf.tr_mul(&load.force_orf_n);
            force -= f;
            torque -= body.dcm_orf_from_srf.tr_mul(&load.torque_orf_nm) + body.offset_srf_m.cross(&f);
        }
        let nongrav = force / self.sc_mass_kg;
        let pairs = self.tm.iter().zip(&loads.tm).zip(&outside.gradient_orf_s2);
        let tm = pairs.map(|((body, load), gradient_orf_s2)| {
            let t = &body.dcm_orf_from_srf;
            HeldTestMass {
                acceleration_orf_m_s2: load.force_orf_n / body.mass_kg + load.acceleration_orf_m_s2 - t * nongrav,
                torque_orf_nm: load.torque_orf_nm,
                angular_acceleration_orf_rad_s2: load.angular_acceleration_orf_rad_s2,
                gradient_orf_s2: *gradient_orf_s2,
            }
        });
        let tm = tm.collect();
        Held { torque_srf_nm: torque, nongrav_srf_m_s2: nongrav, tm }
    }

    /// Advances `y` by `dt_s` under constant loads (midpoint rule) and returns the sample's means.
    ///
    /// Displacement and angle are exact for constant accelerations. Accelerations vary by stiffness and rotation only,
    /// on time scales far longer than a sample.
    ///
    /// Midpoint displacements need no accelerations, and only the terms in the rates are iterated, so stiffness,
    /// gradient and torques are evaluated once.
    pub fn step(&self, y: &mut State, loads: &Loads, outside: &Outside, dt_s: f64) -> Means {
        let held = self.held(loads, outside);
        let half_s = 0.5 * dt_s;
        // Euler's equation, −J⁻¹(ω×Jω) (the paper prints +).
        let alpha_at =
            |w: &Vector3<f64>| self.sc_inertia_inverse * (held.torque_srf_nm - w.cross(&(self.sc_inertia * w)));
        let omega = y.omega_srf_rad_s + alpha_at(&y.omega_srf_rad_s) * half_s;
        let alpha = alpha_at(&omega);
        let omega_ci = outside.omega_crf_rad_s + outside.alpha_crf_rad_s2 * half_s;
        for ((body, held), tm) in self.tm.iter().zip(&held.tm).zip(&mut y.tm) {
            body.step(tm, held, &omega, &alpha, dt_s);
        }
        let midway = y.q_srf_from_crf + derivative(&y.q_srf_from_crf, &y.omega_srf_rad_s, &omega_ci) * half_s;
        y.q_srf_from_crf = unit(&(y.q_srf_from_crf + derivative(&midway, &omega, &omega_ci) * dt_s));
        y.omega_srf_rad_s += alpha * dt_s;
        Means { alpha_srf_rad_s2: alpha, nongrav_srf_m_s2: held.nongrav_srf_m_s2 }
    }
}

impl TestMassBody {
    /// Advances a test mass; `omega`, `alpha` are the spacecraft's rate and angular acceleration at the midpoint, SRF.
    fn step(&self, y: &mut TestMassState, held: &HeldTestMass, omega: &Vector3<f64>, alpha: &Vector3<f64>, dt_s: f64) {
        let half_s = 0.5 * dt_s;
        let (omega_o, alpha_o) = (self.dcm_orf_from_srf * omega, self.dcm_orf_from_srf * alpha);
        let r = y.r_orf_m + y.v_orf_m_s * half_s;
        let q = y.q_mrf_from_orf + derivative(&y.q_mrf_from_orf, &y.omega_mrf_rad_s, &omega_o) * half_s;
        let rho = self.dcm_orf_from_srf * self.offset_srf_m + r;
        // Twice the vector part is the small angle.
        let angle = q.imag() * 2.0;

        let still = held.acceleration_orf_m_s2 + held.gradient_orf_s2 * rho
            - alpha_o.cross(&rho)
            - omega_o.cross(&omega_o.cross(&rho))
            + self.stiffness_tt * r
            + self.stiffness_tr * angle;
        let moving = |v: &Vector3<f64>| still - omega_o.cross(v) * 2.0;
        let acceleration = moving(&(y.v_orf_m_s + moving(&y.v_orf_m_s) * half_s));
        y.r_orf_m += (y.v_orf_m_s + acceleration * half_s) * dt_s;
        y.v_orf_m_s += acceleration * dt_s;

        let torque = turn(&q, &held.torque_orf_nm);
        let still = held.angular_acceleration_orf_rad_s2 + self.stiffness_rt * r + self.stiffness_rr * angle;
        let turning = |w: &Vector3<f64>| still + self.inertia_inverse * (torque - w.cross(&(self.inertia * w)));
        let midway = y.omega_mrf_rad_s + turning(&y.omega_mrf_rad_s) * half_s;
        y.q_mrf_from_orf = unit(&(y.q_mrf_from_orf + derivative(&q, &midway, &omega_o) * dt_s));
        y.omega_mrf_rad_s += turning(&midway) * dt_s;
    }
}

impl State {
    /// At rest relative to CRF and to the housings, at the given attitude, displacements and angles.
    pub fn at_rest(
        sc_rad: &Vector3<f64>,
        tm: &[(Vector3<f64>, Vector3<f64>)],
        plant: &Plant,
        outside: &Outside,
    ) -> Self {
        let q_srf_from_crf = from_rotation_vector(sc_rad);
        let omega_srf_rad_s = turn(&q_srf_from_crf, &outside.omega_crf_rad_s);
        let tm = plant.tm.iter().zip(tm).map(|(body, (r_orf_m, angle_rad))| {
            let q_mrf_from_orf = from_rotation_vector(angle_rad);
            TestMassState {
                r_orf_m: *r_orf_m,
                v_orf_m_s: Vector3::zeros(),
                q_mrf_from_orf,
                omega_mrf_rad_s: turn(&q_mrf_from_orf, &(body.dcm_orf_from_srf * omega_srf_rad_s)),
            }
        });
        Self { q_srf_from_crf, omega_srf_rad_s, tm: tm.collect() }
    }

    /// Attitude of the spacecraft relative to CRF, `φ, θ, ψ`, rad.
    pub fn sc_crf_rad(&self) -> Vector3<f64> {
        rotation_vector(&self.q_srf_from_crf)
    }

    /// Whether displacements and angles (twice the vector part of a quaternion) are within limits; false for NaN.
    pub fn is_within(&self, limit_m: f64, limit_rad: f64) -> bool {
        let within = |v: &Vector3<f64>, limit: f64| v.iter().fold(true, |all, x| all & (x.abs() <= limit));
        let near = |q: &Quaternion<f64>| within(&q.imag(), 0.5 * limit_rad);
        near(&self.q_srf_from_crf)
            & self.tm.iter().fold(true, |all, s| all & within(&s.r_orf_m, limit_m) & near(&s.q_mrf_from_orf))
    }

    /// All numbers, for a checkpoint.
    pub fn to_numbers(&self) -> Vec<f64> {
        let mut out = Vec::with_capacity(SPACECRAFT_NUMBERS + TEST_MASS_NUMBERS * self.tm.len());
        out.extend_from_slice(self.q_srf_from_crf.coords.as_slice());
        out.extend_from_slice(self.omega_srf_rad_s.as_slice());
        for s in &self.tm {
            out.extend_from_slice(s.r_orf_m.as_slice());
            out.extend_from_slice(s.v_orf_m_s.as_slice());
            out.extend_from_slice(s.q_mrf_from_orf.coords.as_slice());
            out.extend_from_slice(s.omega_mrf_rad_s.as_slice());
        }
        out
    }

    /// The inverse of [`Self::to_numbers`]; `None` for a state of another number of test masses.
    pub fn from_numbers(numbers: &[f64], test_masses: usize) -> Option<Self> {
        if numbers.len() != SPACECRAFT_NUMBERS + TEST_MASS_NUMBERS * test_masses {
            return None;
        }
        let v = |n: &[f64]| Vector3::from_column_slice(&n[..3]);
        // nalgebra stores the vector part first.
        let q = |n: &[f64]| Quaternion::new(n[3], n[0], n[1], n[2]);
        let (spacecraft, tm) = numbers.split_at(SPACECRAFT_NUMBERS);
        let tm = tm.chunks_exact(TEST_MASS_NUMBERS).map(|n| TestMassState {
            r_orf_m: v(n),
            v_orf_m_s: v(&n[3..]),
            q_mrf_from_orf: q(&n[6..]),
            omega_mrf_rad_s: v(&n[10..]),
        });
        Some(Self { q_srf_from_crf: q(spacecraft), omega_srf_rad_s: v(&spacecraft[4..]), tm: tm.collect() })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dragfree_physics::frames::{dcm_turned_about_z, omega_matrix};

    fn body(angle_rad: f64, y_m: f64) -> TestMassBody {
        let inertia = Matrix3::new(7e-4, 1e-5, 0.0, 1e-5, 6e-4, 2e-5, 0.0, 2e-5, 9e-4);
        TestMassBody {
            mass_kg: 1.96,
            inertia,
            inertia_inverse: inertia.try_inverse().unwrap(),
            dcm_orf_from_srf: dcm_turned_about_z(angle_rad),
            offset_srf_m: Vector3::new(0.03, y_m, -0.02),
            stiffness_tt: Matrix3::zeros(),
            stiffness_tr: Matrix3::zeros(),
            stiffness_rt: Matrix3::zeros(),
            stiffness_rr: Matrix3::zeros(),
        }
    }

    /// The paper's spacecraft without stiffness; the test masses are uneven bodies here, to see their gyroscopic
    /// torque.
    fn plant() -> Plant {
        let inertia = Matrix3::new(800.0, 13.0, 10.0, 13.0, 800.0, 12.0, 10.0, 12.0, 1000.0);
        Plant {
            sc_mass_kg: 1500.0,
            sc_inertia: inertia,
            sc_inertia_inverse: inertia.try_inverse().unwrap(),
            tm: vec![body(std::f64::consts::FRAC_PI_6, 0.18), body(-std::f64::consts::FRAC_PI_6, -0.18)],
        }
    }

    fn nothing() -> Outside {
        Outside {
            omega_crf_rad_s: Vector3::zeros(),
            alpha_crf_rad_s2: Vector3::zeros(),
            gradient_orf_s2: [Matrix3::zeros(); 2].into(),
        }
    }

    fn at_rest(plant: &Plant) -> State {
        State::at_rest(&Vector3::zeros(), &[Default::default(); 2], plant, &nothing())
    }

    /// Components in the frame that `q` starts from.
    fn back(q: &Quaternion<f64>, v: &Vector3<f64>) -> Vector3<f64> {
        turn(&q.conjugate(), v)
    }

    /// Undisturbed bodies keep energy and angular momentum in inertial space. With `+J⁻¹(ω×Jω)`, as the paper prints,
    /// the momentum turns by a radian here.
    #[test]
    fn tumbling_bodies_keep_energy_and_momentum() {
        let plant = plant();
        let mut y = at_rest(&plant);
        y.omega_srf_rad_s = Vector3::new(0.3, 0.2, 0.5);
        // The spacecraft tumbles alone first, then a test mass in a spacecraft at rest.
        let of_sc = |y: &State| {
            let l = plant.sc_inertia * y.omega_srf_rad_s;
            (back(&y.q_srf_from_crf, &l), y.omega_srf_rad_s.dot(&l))
        };
        let (l0, e0) = of_sc(&y);
        for _ in 0..20_000 {
            plant.step(&mut y, &Loads::zero(2), &nothing(), 1e-3);
        }
        let (l1, e1) = of_sc(&y);
        assert!((l1 - l0).norm() < 1e-6 * l0.norm() && (e1 / e0 - 1.0).abs() < 1e-6, "{l0} {l1} {e0} {e1}");

        let mut y = at_rest(&plant);
        y.tm[1].omega_mrf_rad_s = Vector3::new(0.3, 0.2, 0.5);
        let of_tm = |y: &State| {
            let tm = &y.tm[1];
            let l = plant.tm[1].inertia * tm.omega_mrf_rad_s;
            (back(&tm.q_mrf_from_orf, &l), tm.omega_mrf_rad_s.dot(&l))
        };
        let (l0, e0) = of_tm(&y);
        for _ in 0..20_000 {
            plant.step(&mut y, &Loads::zero(2), &nothing(), 1e-3);
        }
        let (l1, e1) = of_tm(&y);
        assert!((l1 - l0).norm() < 1e-6 * l0.norm() && (e1 / e0 - 1.0).abs() < 1e-6, "{l0} {l1} {e0} {e1}");
    }

    /// Electrodes push spacecraft and test masses apart and leave the whole as it was: linear and angular momentum
    /// about the spacecraft's centre. With `+b×(T F_E)`, as the paper prints, the angular momentum changes by 2 b×F.
    #[test]
    fn electrodes_are_internal_forces() {
        let plant = plant();
        let mut loads = Loads::zero(2);
        loads.tm[0].force_orf_n = Vector3::new(1e-9, -3e-9, 2e-9);
        loads.tm[0].torque_orf_nm = Vector3::new(2e-12, 1e-12, -4e-12);
        loads.tm[1].force_orf_n = Vector3::new(0.0, 4e-9, -1e-9);
        // From rest, a step so short that nothing has moved.
        let (mut y, dt_s) = (at_rest(&plant), 1e-6);
        let means = plant.step(&mut y, &loads, &nothing(), dt_s);
        let alpha = means.alpha_srf_rad_s2;
        let mut momentum = means.nongrav_srf_m_s2 * plant.sc_mass_kg;
        let mut angular = plant.sc_inertia * alpha;
        for (body, tm) in plant.tm.iter().zip(&y.tm) {
            let relative = body.dcm_orf_from_srf.tr_mul(&(tm.v_orf_m_s / dt_s));
            let inertial = relative + means.nongrav_srf_m_s2 + alpha.cross(&body.offset_srf_m);
            momentum += inertial * body.mass_kg;
            angular += body.offset_srf_m.cross(&(inertial * body.mass_kg))
                + body.dcm_orf_from_srf.tr_mul(&(body.inertia * tm.omega_mrf_rad_s / dt_s));
        }
        assert!(momentum.norm() < 1e-15 * 5e-9 * 10.0, "{momentum}");
        assert!(angular.norm() < 1e-15 * 1e-9 * 10.0, "{angular}");
    }

    /// A free test mass stays where it is while the spacecraft spins up about s_3 under a constant torque: in ORF it
    /// moves on an arc that is known in closed form. Euler's, Coriolis' and the centrifugal term each carry it.
    fn error_after_spin_up(dt_s: f64) -> f64 {
        let mut plant = plant();
        plant.sc_inertia = Matrix3::from_diagonal(&Vector3::new(800.0, 800.0, 1000.0));
        plant.sc_inertia_inverse = plant.sc_inertia.try_inverse().unwrap();
        let (spin, alpha) = (0.02, 0.003);
        let mut y = at_rest(&plant);
        y.omega_srf_rad_s.z = spin;
        // At rest in inertial space: ṙ = −ω×b.
        for (body, tm) in plant.tm.iter().zip(&mut y.tm) {
            tm.v_orf_m_s = -(body.dcm_orf_from_srf * y.omega_srf_rad_s.cross(&body.offset_srf_m));
        }
        let loads = Loads { torque_srf_nm: Vector3::new(0.0, 0.0, 1000.0 * alpha), ..Loads::zero(2) };
        let seconds = 20.0;
        for _ in 0..(seconds / dt_s).round() as usize {
            plant.step(&mut y, &loads, &nothing(), dt_s);
        }
        let angle = spin * seconds + 0.5 * alpha * seconds * seconds;
        let errors = plant.tm.iter().zip(&y.tm).map(|(body, tm)| {
            let seen = dcm_turned_about_z(angle) * body.offset_srf_m - body.offset_srf_m;
            (tm.r_orf_m - body.dcm_orf_from_srf * seen).norm()
        });
        errors.fold(0.0, f64::max)
    }

    #[test]
    fn a_free_test_mass_ignores_the_turning_spacecraft() {
        let (coarse, fine) = (error_after_spin_up(0.1), error_after_spin_up(0.05));
        assert!(coarse < 1e-4, "{coarse} m of 0.3 m");
        // Midpoint rule: halving the step quarters the error.
        assert!((coarse / fine - 4.0).abs() < 0.2, "{coarse} {fine}");
    }

    /// Twice differenced displacement against the equation of motion evaluated from the means of the step:
    /// `D² r = mean of r̈ over both steps`, `r̈ = −T(a_ng + Ω(ω, α) ρ) + F_E/m + d − 2ω×ṙ`.
    #[test]
    fn second_differences_hold_the_offset() {
        let plant = plant();
        let mut y = at_rest(&plant);
        y.omega_srf_rad_s = Vector3::new(1e-7, -2e-7, 3e-7);
        let dt_s = 0.1;
        let mut earlier: Vec<[Vector3<f64>; 2]> = Vec::new();
        let mut accelerations: Vec<[Vector3<f64>; 2]> = Vec::new();
        for k in 0..200 {
            // Loads of flight size that change from sample to sample.
            let v = |i: usize, size: f64| Vector3::from_fn(|j, _| size * ((k * 13 + i * 5 + j * 3) as f64).sin());
            let tm = |i: usize| TestMassLoads {
                force_orf_n: v(i, 3e-9),
                torque_orf_nm: v(i + 1, 1e-12),
                acceleration_orf_m_s2: v(i + 2, 1e-10),
                angular_acceleration_orf_rad_s2: v(i + 3, 1e-9),
            };
            let loads = Loads { force_srf_n: v(7, 1e-6), torque_srf_nm: v(8, 1e-6), tm: [tm(1), tm(4)].into() };
            let before = y;
            let means = plant.step(&mut y, &loads, &nothing(), dt_s);
            let omega = (before.omega_srf_rad_s + y.omega_srf_rad_s) * 0.5;
            earlier.push([before.tm[0].r_orf_m, before.tm[1].r_orf_m]);
            accelerations.push(std::array::from_fn(|i| {
                let (body, load) = (&plant.tm[i], &loads.tm[i]);
                let rho = body.offset_srf_m + body.dcm_orf_from_srf.tr_mul(&before.tm[i].r_orf_m);
                let midway = (before.tm[i].v_orf_m_s + y.tm[i].v_orf_m_s) * 0.5;
                let velocity = body.dcm_orf_from_srf.tr_mul(&midway);
                let inertial = means.nongrav_srf_m_s2
                    + omega_matrix(&omega, &means.alpha_srf_rad_s2) * rho
                    + omega.cross(&velocity) * 2.0;
                load.force_orf_n / body.mass_kg + load.acceleration_orf_m_s2 - body.dcm_orf_from_srf * inertial
            }));
        }
        for k in 1..199 {
            for i in 0..2 {
                let second = (earlier[k + 1][i] - earlier[k][i] * 2.0 + earlier[k - 1][i]) / (dt_s * dt_s);
                let want = (accelerations[k][i] + accelerations[k - 1][i]) * 0.5;
                // Coriolis' term changes within the sample, by 1e-16 m/s²; the offset's part is 2e-10.
                assert!((second - want).norm() < 5e-17, "epoch {k}: {second} {want}");
            }
        }
    }

    #[test]
    fn thrust_moves_the_housings_not_the_masses() {
        let plant = plant();
        let loads = Loads { force_srf_n: Vector3::new(3e-6, 0.0, 0.0), ..Loads::zero(2) };
        let mut y = at_rest(&plant);
        plant.step(&mut y, &loads, &nothing(), 0.1);
        let want = plant.tm[0].dcm_orf_from_srf * Vector3::new(-2e-10, 0.0, 0.0);
        assert!((y.tm[0].v_orf_m_s - want).norm() < 1e-25);
    }

    #[test]
    fn numbers_go_and_come_back() {
        let mut y = at_rest(&plant());
        y.tm[1].v_orf_m_s.z = 3.0;
        y.q_srf_from_crf = from_rotation_vector(&Vector3::new(0.1, 0.2, 0.3));
        assert_eq!(State::from_numbers(&y.to_numbers(), 2), Some(y));
        assert_eq!(State::from_numbers(&y.to_numbers(), 1), None);
    }
}
