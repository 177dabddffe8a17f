//! The equations of motion of spacecraft and test masses in relative coordinates (design: the paper's Section II with
//! the signs of `ops-guide`), and their integration over one sample.
//!
//! Inertial positions never appear: at one astronomical unit a float has 3e-5 m of grain.

use dragfree_physics::attitude::{dcm, derivative, from_rotation_vector, rotation_vector};
use dragfree_physics::mission::{Mission, MissionError};
use nalgebra::{Matrix3, Quaternion, Vector3};

/// One test mass in the mission's numbers and in the truth's.
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
    /// Test masses 1 and 2.
    pub tm: [TestMassBody; 2],
}

/// State of a test mass; also, element by element, its time derivative.
#[derive(Clone, Copy, Debug, PartialEq)]
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

/// State of everything; also, element by element, its time derivative.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct State {
    /// Turns CRF into SRF.
    pub q_srf_from_crf: Quaternion<f64>,
    /// `ω_SI`, SRF, rad/s.
    pub omega_srf_rad_s: Vector3<f64>,
    /// Test masses 1 and 2.
    pub tm: [TestMassState; 2],
}

/// Numbers in a [`State`].
pub const STATE_NUMBERS: usize = 33;

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
    /// Test masses 1 and 2.
    pub tm: [TestMassLoads; 2],
}

/// What turns and pulls from outside, over a sample.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Outside {
    /// `ω_CI` at the start of the sample, CRF, rad/s.
    pub omega_crf_rad_s: Vector3<f64>,
    /// `ω̇_CI`, CRF, rad/s².
    pub alpha_crf_rad_s2: Vector3<f64>,
    /// `Γ`, SRF, s⁻².
    pub gradient_srf_s2: Matrix3<f64>,
}

/// Means over the sample that was integrated.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Means {
    /// Angular acceleration of the spacecraft `α`, SRF, rad/s².
    pub alpha_srf_rad_s2: Vector3<f64>,
    /// `a_ng`, SRF, m/s².
    pub nongrav_srf_m_s2: Vector3<f64>,
}

/// Everything that stays the same within a sample, worked out once.
struct Held {
    torque_srf_nm: Vector3<f64>,
    nongrav_srf_m_s2: Vector3<f64>,
    tm: [HeldTestMass; 2],
    outside: Outside,
}

struct HeldTestMass {
    offset_orf_m: Vector3<f64>,
    gradient_orf_s2: Matrix3<f64>,
    /// `−T a_ng + (F_E + d_m)/m_m + a_sg`.
    acceleration_orf_m_s2: Vector3<f64>,
    torque_orf_nm: Vector3<f64>,
    angular_acceleration_orf_rad_s2: Vector3<f64>,
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
        stiffness: &[[Matrix3<f64>; 3]; 2],
    ) -> Result<Self, MissionError> {
        const NEEDED_BY: &str = "the simulator";
        let tm = |i: usize, name: &str| -> Result<TestMassBody, MissionError> {
            let section = mission.test_mass(name, NEEDED_BY)?;
            let inertia_inverse = section.inertia_inverse(name, NEEDED_BY)?;
            let [tt, tr, rr] = &stiffness[i];
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
        };
        Ok(Self {
            sc_mass_kg: mission.spacecraft.mass_kg,
            sc_inertia: mission.spacecraft.inertia(),
            sc_inertia_inverse: mission.spacecraft.inertia_inverse(),
            tm: [tm(0, "tm1")?, tm(1, "tm2")?],
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
        let tm = std::array::from_fn(|i| {
            let (body, load) = (&self.tm[i], &loads.tm[i]);
            let t = &body.dcm_orf_from_srf;
            HeldTestMass {
                offset_orf_m: t * body.offset_srf_m,
                gradient_orf_s2: t * outside.gradient_srf_s2 * t.transpose(),
                acceleration_orf_m_s2: load.force_orf_n / body.mass_kg + load.acceleration_orf_m_s2 - t * nongrav,
                torque_orf_nm: load.torque_orf_nm,
                angular_acceleration_orf_rad_s2: load.angular_acceleration_orf_rad_s2,
            }
        });
        Held { torque_srf_nm: torque, nongrav_srf_m_s2: nongrav, tm, outside: *outside }
    }

    fn rates(&self, y: &State, held: &Held, elapsed_s: f64) -> State {
        let omega = &y.omega_srf_rad_s;
        // Euler's equation, −J⁻¹(ω×Jω) (the paper prints +).
        let alpha = self.sc_inertia_inverse * (held.torque_srf_nm - omega.cross(&(self.sc_inertia * omega)));
        let omega_ci = held.outside.omega_crf_rad_s + held.outside.alpha_crf_rad_s2 * elapsed_s;
        let omega_sc = omega - dcm(&y.q_srf_from_crf) * omega_ci;
        let tm = std::array::from_fn(|i| {
            let (body, s, h) = (&self.tm[i], &y.tm[i], &held.tm[i]);
            let (omega_o, alpha_o) = (body.dcm_orf_from_srf * omega, body.dcm_orf_from_srf * alpha);
            let rho = h.offset_orf_m + s.r_orf_m;
            // Twice the vector part is the small angle; the stiffness is linear in it anyway.
            let angle = s.q_mrf_from_orf.imag() * 2.0;
            let acceleration = h.acceleration_orf_m_s2 + h.gradient_orf_s2 * rho
                - alpha_o.cross(&rho)
                - omega_o.cross(&(omega_o.cross(&rho) + s.v_orf_m_s * 2.0))
                + body.stiffness_tt * s.r_orf_m
                + body.stiffness_tr * angle;
            let mrf_from_orf = dcm(&s.q_mrf_from_orf);
            let w = &s.omega_mrf_rad_s;
            let turn = body.inertia_inverse * (mrf_from_orf * h.torque_orf_nm - w.cross(&(body.inertia * w)))
                + h.angular_acceleration_orf_rad_s2
                + body.stiffness_rt * s.r_orf_m
                + body.stiffness_rr * angle;
            TestMassState {
                r_orf_m: s.v_orf_m_s,
                v_orf_m_s: acceleration,
                q_mrf_from_orf: derivative(&s.q_mrf_from_orf, &(w - mrf_from_orf * omega_o)),
                omega_mrf_rad_s: turn,
            }
        });
        State { q_srf_from_crf: derivative(&y.q_srf_from_crf, &omega_sc), omega_srf_rad_s: alpha, tm }
    }

    /// Moves `y` on by `dt_s` under constant loads (classical Runge–Kutta of order 4) and gives the sample's means.
    pub fn step(&self, y: &mut State, loads: &Loads, outside: &Outside, dt_s: f64) -> Means {
        let held = self.held(loads, outside);
        let k1 = self.rates(y, &held, 0.0);
        let k2 = self.rates(&y.moved(&k1, 0.5 * dt_s), &held, 0.5 * dt_s);
        let k3 = self.rates(&y.moved(&k2, 0.5 * dt_s), &held, 0.5 * dt_s);
        let k4 = self.rates(&y.moved(&k3, dt_s), &held, dt_s);
        let mean = k1.moved(&k2, 2.0).moved(&k3, 2.0).moved(&k4, 1.0).scaled(1.0 / 6.0);
        *y = y.moved(&mean, dt_s);
        y.normalise();
        Means { alpha_srf_rad_s2: mean.omega_srf_rad_s, nongrav_srf_m_s2: held.nongrav_srf_m_s2 }
    }
}

impl State {
    /// At rest relative to CRF and to the housings, at the given attitude, displacements and angles.
    #[must_use]
    pub fn at_rest(
        sc_rad: &Vector3<f64>,
        tm: &[(Vector3<f64>, Vector3<f64>); 2],
        plant: &Plant,
        outside: &Outside,
    ) -> Self {
        let q_srf_from_crf = from_rotation_vector(sc_rad);
        let omega_srf_rad_s = dcm(&q_srf_from_crf) * outside.omega_crf_rad_s;
        let tm = std::array::from_fn(|i| {
            let q_mrf_from_orf = from_rotation_vector(&tm[i].1);
            TestMassState {
                r_orf_m: tm[i].0,
                v_orf_m_s: Vector3::zeros(),
                q_mrf_from_orf,
                omega_mrf_rad_s: dcm(&q_mrf_from_orf) * (plant.tm[i].dcm_orf_from_srf * omega_srf_rad_s),
            }
        });
        Self { q_srf_from_crf, omega_srf_rad_s, tm }
    }

    /// Attitude of the spacecraft relative to CRF, `φ, θ, ψ`, rad.
    #[must_use]
    pub fn sc_crf_rad(&self) -> Vector3<f64> {
        rotation_vector(&self.q_srf_from_crf)
    }

    /// `self + k·h`, element by element.
    fn moved(&self, k: &Self, h: f64) -> Self {
        let tm = std::array::from_fn(|i| {
            let (s, k) = (&self.tm[i], &k.tm[i]);
            TestMassState {
                r_orf_m: s.r_orf_m + k.r_orf_m * h,
                v_orf_m_s: s.v_orf_m_s + k.v_orf_m_s * h,
                q_mrf_from_orf: s.q_mrf_from_orf + k.q_mrf_from_orf * h,
                omega_mrf_rad_s: s.omega_mrf_rad_s + k.omega_mrf_rad_s * h,
            }
        });
        Self {
            q_srf_from_crf: self.q_srf_from_crf + k.q_srf_from_crf * h,
            omega_srf_rad_s: self.omega_srf_rad_s + k.omega_srf_rad_s * h,
            tm,
        }
    }

    fn scaled(mut self, h: f64) -> Self {
        self.q_srf_from_crf *= h;
        self.omega_srf_rad_s *= h;
        for s in &mut self.tm {
            s.r_orf_m *= h;
            s.v_orf_m_s *= h;
            s.q_mrf_from_orf *= h;
            s.omega_mrf_rad_s *= h;
        }
        self
    }

    fn normalise(&mut self) {
        self.q_srf_from_crf.normalize_mut();
        for s in &mut self.tm {
            s.q_mrf_from_orf.normalize_mut();
        }
    }

    /// All numbers, for a checkpoint.
    #[must_use]
    pub fn to_numbers(&self) -> Vec<f64> {
        let mut out = Vec::with_capacity(STATE_NUMBERS);
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

    /// The inverse of [`Self::to_numbers`].
    #[must_use]
    pub fn from_numbers(n: &[f64; STATE_NUMBERS]) -> Self {
        let v = |i: usize| Vector3::new(n[i], n[i + 1], n[i + 2]);
        // nalgebra keeps the vector part first.
        let q = |i: usize| Quaternion::new(n[i + 3], n[i], n[i + 1], n[i + 2]);
        let tm = |i: usize| TestMassState {
            r_orf_m: v(i),
            v_orf_m_s: v(i + 3),
            q_mrf_from_orf: q(i + 6),
            omega_mrf_rad_s: v(i + 10),
        };
        Self { q_srf_from_crf: q(0), omega_srf_rad_s: v(4), tm: [tm(7), tm(20)] }
    }
}
