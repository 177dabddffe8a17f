//! The static decoupling of the paper (eqs decoupled_input and generalized_inverse_optimization): the linear plant
//! `p̈ = A_v p + B_v u` of the nominal mission, and the allocation `B_v†` of fifteen wanted accelerations to sixteen inputs.

use clarabel::algebra::CscMatrix;
use clarabel::solver::{DefaultSettings, DefaultSolver, IPSolver, SolverStatus, ZeroConeT};
use nalgebra::{Matrix3, SMatrix, SVector, Vector3};

use crate::control::{Command, Readout};
use crate::mission::{Mission, MissionError};

const NEEDED_BY: &str = "the control law";

/// Inputs of eq:input_variables_reduced: `F_T` (3), `M_T` (3), then for each test mass `F_E` (y, z) and `M_E` (3).
pub const INPUTS: usize = 16;
/// Rows of the input vector that hold the thrust along `s_1`, `s_2`, `s_3`.
const THRUST: [usize; 3] = [0, 1, 2];
/// Rows of eq:state_variables that hold `x_1` and `x_2`, and `z_1` and `z_2`.
const X: [usize; 2] = [3, 9];
const Z: [usize; 2] = [5, 11];
/// Rows of the input vector that the electrodes carry.
const ELECTRODES: std::ops::Range<usize> = 6..INPUTS;
/// Largest element of `B_v B_v† − 1`, in units of the channels' own accelerations.
const RESIDUAL_TOLERANCE: f64 = 1e-12;

pub(crate) type Accelerations = SVector<f64, 15>;
pub(crate) type InputVector = SVector<f64, INPUTS>;
/// `B_v`: fifteen channels by sixteen inputs, m s⁻² or rad s⁻² per N or N m.
type InputMatrix = SMatrix<f64, 15, INPUTS>;
/// `B_v†`: sixteen inputs by fifteen channels, N or N m per m s⁻² or rad s⁻².
pub type AllocationMatrix = SMatrix<f64, INPUTS, 15>;

/// The plant of eq:state_space_model that the decoupling assumes: nominal masses, offsets and stiffness.
pub(crate) struct LinearPlant {
    sc_mass_kg: f64,
    sc_inertia_inverse: Matrix3<f64>,
    tm: [LinearTestMass; 2],
}

struct LinearTestMass {
    mass_kg: f64,
    inertia_inverse: Matrix3<f64>,
    dcm_orf_from_srf: Matrix3<f64>,
    offset_srf_m: Vector3<f64>,
    stiffness_tt: Matrix3<f64>,
    stiffness_tr: Matrix3<f64>,
    stiffness_rt: Matrix3<f64>,
    stiffness_rr: Matrix3<f64>,
}

impl LinearPlant {
    pub(crate) fn new(mission: &Mission) -> Result<Self, MissionError> {
        let lever = mission.control.as_ref().is_none_or(|c| c.lever_feed_forward);
        let tm = |name: &str| -> Result<LinearTestMass, MissionError> {
            let section = mission.test_mass(name, NEEDED_BY)?;
            let inertia_inverse = section.inertia_inverse(name, NEEDED_BY)?;
            Ok(LinearTestMass {
                mass_kg: section.mass_kg,
                inertia_inverse,
                dcm_orf_from_srf: section.dcm_orf_from_srf(),
                offset_srf_m: if lever { Vector3::from(section.offset_nominal_srf_m) } else { Vector3::zeros() },
                stiffness_tt: section.stiffness_tt(),
                stiffness_tr: section.stiffness_tr(),
                stiffness_rt: section.stiffness_rt(&inertia_inverse),
                stiffness_rr: section.stiffness_rr(),
            })
        };
        Ok(Self {
            sc_mass_kg: mission.spacecraft.mass_kg,
            sc_inertia_inverse: mission.spacecraft.inertia_inverse(),
            tm: [tm("tm1")?, tm("tm2")?],
        })
    }

    /// `B_v u`: accelerations of the fifteen channels, in the order of [`CHANNELS`].
    ///
    /// `α = J_S⁻¹(M_T − Σ T M_Ej − Σ b_j×(T F_Ej))`, `r̈_i = −T((F_T − Σ T F_Ej)/m_S + α×b_i) + F_Ei/m_i`, and a test
    /// mass turns against its housing by `J_m⁻¹ M_Ei − T α`.
    fn accelerations(&self, u: &Command) -> Accelerations {
        let (mut force, mut torque) = (u.mps_force_srf_n, u.mps_torque_srf_nm);
        for (tm, e) in self.tm.iter().zip(&u.tm) {
            let f = tm.dcm_orf_from_srf.tr_mul(&e.force_orf_n);
            force -= f;
            torque -= tm.dcm_orf_from_srf.tr_mul(&e.torque_orf_nm) + tm.offset_srf_m.cross(&f);
        }
        let alpha = self.sc_inertia_inverse * torque;
        let mut out = Accelerations::zeros();
        out.fixed_rows_mut::<3>(0).copy_from(&alpha);
        for (i, (tm, e)) in self.tm.iter().zip(&u.tm).enumerate() {
            let inertial = force / self.sc_mass_kg + alpha.cross(&tm.offset_srf_m);
            let r = e.force_orf_n / tm.mass_kg - tm.dcm_orf_from_srf * inertial;
            let turn = tm.inertia_inverse * e.torque_orf_nm - tm.dcm_orf_from_srf * alpha;
            out.fixed_rows_mut::<3>(3 + 6 * i).copy_from(&r);
            out.fixed_rows_mut::<3>(6 + 6 * i).copy_from(&turn);
        }
        out
    }

    /// `B_v`, column by column.
    fn input_matrix(&self) -> InputMatrix {
        let mut b = InputMatrix::zeros();
        for j in 0..INPUTS {
            let mut unit = InputVector::zeros();
            unit[j] = 1.0;
            b.set_column(j, &self.accelerations(&Command::from_vector(&unit)));
        }
        b
    }

    /// `A_v p̂`.
    pub(crate) fn stiffness(&self, y: &Readout) -> Accelerations {
        let mut out = Accelerations::zeros();
        for (i, (s, tm)) in self.tm.iter().zip(&y.tm).enumerate() {
            let r = s.stiffness_tt * tm.r_orf_m + s.stiffness_tr * tm.att_orf_rad;
            let turn = s.stiffness_rt * tm.r_orf_m + s.stiffness_rr * tm.att_orf_rad;
            out.fixed_rows_mut::<3>(3 + 6 * i).copy_from(&r);
            out.fixed_rows_mut::<3>(6 + 6 * i).copy_from(&turn);
        }
        out
    }
}

/// The allocation and how exactly it is one.
#[derive(Clone, Debug)]
pub struct Allocation {
    /// `B_v†`.
    pub matrix: AllocationMatrix,
    /// Largest element of `|B_v B_v† − 1|`.
    pub residual: f64,
    /// By how much eqs x_axis_thrust, y_axis_thrust and z_axis_thrust are missed, relative to the coefficients they equate.
    /// The third is kept exactly whatever the geometry; the first two follow when the optical benches mirror each other.
    pub thrust_rules: [f64; 3],
}

impl Allocation {
    /// The allocation of a mission.
    ///
    /// # Errors
    /// [`MissionError`]: a section is missing, the sensitive axes are parallel, or the programme has no solution.
    pub fn new(mission: &Mission) -> Result<Self, MissionError> {
        LinearPlant::new(mission)?.allocation()
    }
}

impl LinearPlant {
    /// `B_v†` of eq:generalized_inverse_optimization under the rules of eqs x_axis_thrust to z_axis_thrust.
    ///
    /// `B_v` has one input more than channels: `B_v B_v† = 1` leaves one freedom for every channel, thrust along `s_3`
    /// against the electrodes. The rule for that thrust takes fourteen of the fifteen, `F_Tz ∝ u_d6 + u_d12` and nothing
    /// else; the electrodes' effort settles the last. So the programme is: least electrostatic acceleration, subject to
    /// `B_v B_v† = 1` and the rule. The rules for `F_Tx` and `F_Ty` then hold by the symmetry of the two optical frames.
    ///
    /// Read to the letter, eqs x_axis_thrust and y_axis_thrust also forbid thrust for any other channel; with the lever
    /// `α×b` and the electrodes' reaction in `B_v`, that and `B_v B_v† = 1` exclude each other.
    pub(crate) fn allocation(&self) -> Result<Allocation, MissionError> {
        let refuse = |reason: String| MissionError::Decoupling { reason };
        let sensitive = |i: usize| self.tm[i].dcm_orf_from_srf.row(0).transpose();
        // The electrodes' reaction, m_m/m_S, would still make B_v regular, with thrust beyond all use.
        if sensitive(0).cross(&sensitive(1)).norm() < 0.05 {
            return Err(refuse(
                "the sensitive axes of tm1 and tm2 are parallel to within 3°, and thrust cannot serve both; \
                 check test_mass.tm2.orf_from_srf_angle_rad"
                    .to_owned(),
            ));
        }
        let b = self.input_matrix();
        let scale = self.input_scale();
        let share = self.solve(&b, &scale).map_err(refuse)?;
        let singular =
            || refuse("some channel has no actuator of its own; check masses, inertias and angles".to_owned());
        let with = |thrust_z: f64| with_thrust_z(&b, thrust_z).ok_or_else(singular);
        // The solver stops at its tolerance; one Newton step along the freedom that is left makes the optimum exact.
        let matrix = with(share * scale[THRUST[2]])?;
        let along = with((share + 1.0) * scale[THRUST[2]])? - matrix;
        let effort = |m: &AllocationMatrix| {
            let mut electrodes = *m;
            for i in 0..INPUTS {
                electrodes.row_mut(i).scale_mut(if ELECTRODES.contains(&i) { 1.0 / scale[i] } else { 0.0 });
            }
            electrodes
        };
        let (here, slope) = (effort(&matrix), effort(&along));
        let matrix = with((share - here.dot(&slope) / slope.norm_squared()) * scale[THRUST[2]])?;

        let residual = (b * matrix - SMatrix::<f64, 15, 15>::identity()).amax();
        if residual.is_nan() || residual > RESIDUAL_TOLERANCE {
            return Err(refuse(format!(
                "B B† differs from 1 by {residual:e}, more than {RESIDUAL_TOLERANCE:e}; check masses, inertias and offsets"
            )));
        }
        let rule = |input: usize, channels: [usize; 2], sign: f64| {
            let [one, two] = channels.map(|c| matrix[(input, c)]);
            (one - sign * two).abs() / one.abs()
        };
        let [x, y, z] = THRUST;
        Ok(Allocation { matrix, residual, thrust_rules: [rule(x, X, 1.0), rule(y, X, -1.0), rule(z, Z, 1.0)] })
    }

    /// Input that gives a body of the plant the acceleration 1: the programme is solved in these units.
    fn input_scale(&self) -> InputVector {
        let moment = |inverse: &Matrix3<f64>| 3.0 / inverse.trace();
        let sc = moment(&self.sc_inertia_inverse);
        let [a, b] = &self.tm;
        let [ja, jb] = [moment(&a.inertia_inverse), moment(&b.inertia_inverse)];
        let (m, ma, mb) = (self.sc_mass_kg, a.mass_kg, b.mass_kg);
        InputVector::from([m, m, m, sc, sc, sc, ma, ma, ja, ja, ja, mb, mb, jb, jb, jb])
    }

    /// The quadratic programme in Clarabel, unknowns `B_v†` column by column in units of [`Self::input_scale`]; gives the
    /// thrust along `s_3` per wanted acceleration of `z_1` or `z_2`.
    fn solve(&self, b: &InputMatrix, scale: &InputVector) -> Result<f64, String> {
        let unknown = |input: usize, channel: usize| INPUTS * channel + input;
        let (mut rows, mut columns, mut values, mut right) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        let mut equation = |terms: &[(usize, f64)], value: f64| {
            for (column, weight) in terms.iter().filter(|(_, w)| *w != 0.0) {
                rows.push(right.len());
                columns.push(*column);
                values.push(*weight);
            }
            right.push(value);
        };
        for wanted in 0..15 {
            for answer in 0..15 {
                let terms: Vec<_> = (0..INPUTS).map(|i| (unknown(i, wanted), b[(answer, i)] * scale[i])).collect();
                equation(&terms, f64::from(u8::from(wanted == answer)));
            }
            if !Z.contains(&wanted) {
                equation(&[(unknown(THRUST[2], wanted), 1.0)], 0.0);
            }
        }
        equation(&[(unknown(THRUST[2], Z[0]), 1.0), (unknown(THRUST[2], Z[1]), -1.0)], 0.0);

        let unknowns = 15 * INPUTS;
        let costly: Vec<usize> = (0..unknowns).filter(|u| ELECTRODES.contains(&(u % INPUTS))).collect();
        let effort =
            CscMatrix::new_from_triplets(unknowns, unknowns, costly.clone(), costly.clone(), vec![1.0; costly.len()]);
        let equations = CscMatrix::new_from_triplets(right.len(), unknowns, rows, columns, values);
        let settings = DefaultSettings { verbose: false, ..DefaultSettings::default() };
        let mut solver =
            DefaultSolver::new(&effort, &vec![0.0; unknowns], &equations, &right, &[ZeroConeT(right.len())], settings)
                .map_err(|e| format!("the solver did not accept the allocation: {e}"))?;
        solver.solve();
        match solver.solution.status {
            SolverStatus::Solved => Ok(solver.solution.x[unknown(THRUST[2], Z[0])]),
            status => {
                Err(format!("the solver ended with {status:?}, not with an allocation; check masses and inertias"))
            }
        }
    }
}

/// The allocation with `F_Tz = thrust_z (u_d6 + u_d12)`: the other fifteen inputs follow without freedom. `None` when they
/// do not.
fn with_thrust_z(b: &InputMatrix, thrust_z: f64) -> Option<AllocationMatrix> {
    let mut row = SMatrix::<f64, 1, 15>::zeros();
    for z in Z {
        row[z] = thrust_z;
    }
    let wanted = SMatrix::<f64, 15, 15>::identity() - b.column(THRUST[2]) * row;
    let others: SMatrix<f64, 15, 15> = b.remove_column(THRUST[2]);
    let mut out: AllocationMatrix = others.lu().solve(&wanted)?.insert_row(THRUST[2], 0.0);
    out.set_row(THRUST[2], &row);
    Some(out)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::control_design::tests::taiji;

    fn allocation(mission: &Mission) -> Allocation {
        Allocation::new(mission).unwrap()
    }

    #[test]
    fn allocation_is_a_right_inverse_and_keeps_the_rules() {
        let a = allocation(&taiji());
        assert!(a.residual < 1e-12 && a.thrust_rules.iter().all(|r| *r < 1e-12), "{a:?}");
        assert_eq!(a.thrust_rules[2], 0.0);
    }

    proptest::proptest! {
        /// A right inverse for other spacecraft too: masses, offsets, opening angles.
        #[test]
        fn allocation_is_a_right_inverse_for_any_geometry(
            mass_kg in 100.0..5000.0_f64,
            half_angle_rad in 0.1..0.7_f64,
            offsets in proptest::array::uniform6(-0.5..0.5_f64),
        ) {
            let mut mission = taiji();
            mission.spacecraft.mass_kg = mass_kg;
            for (i, (name, sign)) in [("tm1", 1.0), ("tm2", -1.0)].into_iter().enumerate() {
                let tm = mission.test_mass.get_mut(name).unwrap();
                tm.orf_from_srf_angle_rad = sign * half_angle_rad;
                tm.offset_nominal_srf_m = [offsets[3 * i], offsets[3 * i + 1], offsets[3 * i + 2]];
            }
            proptest::prop_assert!(Allocation::new(&mission).is_ok());
        }
    }

    /// eqs x_axis_thrust to z_axis_thrust, with the paper's channels 4, 10 (x) and 6, 12 (z).
    #[test]
    fn thrust_follows_the_rules_of_the_paper() {
        let b = allocation(&taiji()).matrix;
        let ([x1, x2], [z1, z2]) = (X, Z);
        // −(c F_x + s F_y)/m_S = u_d4 and −(c F_x − s F_y)/m_S = u_d10.
        let (c, s) = (std::f64::consts::FRAC_PI_6.cos(), 0.5);
        // The electrodes' reaction, m_m/m_S, is the only other way to x.
        let near = |got: f64, want: f64| (got / want - 1.0).abs() < 4.0 * 1.96 / 1500.0;
        assert!(near(b[(0, x1)], -1500.0 / (2.0 * c)) && (b[(0, x1)] / b[(0, x2)] - 1.0).abs() < 1e-12);
        assert!(near(b[(1, x1)], -1500.0 / (2.0 * s)) && (b[(1, x1)] / b[(1, x2)] + 1.0).abs() < 1e-12);
        for j in 0..15 {
            // Thrust carries the whole common motion of z, so that the electrodes need none of it: −m_S/2 each.
            let want = if j == z1 || j == z2 { -750.0 } else { 0.0 };
            assert!((b[(2, j)] - want).abs() < 1e-9, "F_Tz from channel {j}: {}", b[(2, j)]);
        }
        // Pushing the spacecraft for x_1 moves it along y of both housings; the electrodes carry the masses along.
        assert!(b[(6, x1)].abs() > 0.1, "F_E1y takes no part: {}", b[(6, x1)]);
    }

    /// The programme's own solution, before it is made exact, and a share off the optimum by 1 %, which costs effort.
    #[test]
    fn the_solver_finds_the_least_effort() {
        let plant = LinearPlant::new(&taiji()).unwrap();
        let (b, scale) = (plant.input_matrix(), plant.input_scale());
        let share = plant.solve(&b, &scale).unwrap();
        assert!((share + 0.5).abs() < 1e-6, "{share}");
        let effort = |thrust_z: f64| {
            let m = with_thrust_z(&b, thrust_z).unwrap();
            ELECTRODES.map(|i| m.row(i).norm_squared() / (scale[i] * scale[i])).sum::<f64>()
        };
        assert!(effort(-750.0) < effort(-757.5) && effort(-750.0) < effort(-742.5));
    }

    /// The wrong sign of the electrodes' reaction on the spacecraft (eq:SC_attitude_dynamics as printed) is no right inverse.
    #[test]
    fn the_printed_reaction_is_seen() {
        let plant = LinearPlant::new(&taiji()).unwrap();
        let mut b = plant.input_matrix();
        let m = plant.allocation().unwrap().matrix;
        // Torque of F_E1z about s_1 at b_1 = 0.18 m along s_2, printed with the other sign.
        let flipped = plant.sc_inertia_inverse.column(0) * (2.0 * 0.18);
        for i in 0..3 {
            b[(i, 7)] += flipped[i];
        }
        assert!((b * m - SMatrix::<f64, 15, 15>::identity()).amax() > 1e-6);
    }

    #[test]
    fn parallel_axes_are_refused() {
        let mut mission = taiji();
        mission.test_mass.get_mut("tm2").unwrap().orf_from_srf_angle_rad = std::f64::consts::FRAC_PI_6;
        let error = Allocation::new(&mission).unwrap_err().to_string();
        assert!(error.contains("sensitive axes"), "{error}");
    }
}
