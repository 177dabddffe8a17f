//! The static decoupling of the paper (eqs decoupled_input and generalized_inverse_optimization): the linear plant
//! `p̈ = A_v p + B_v u` of the nominal mission, and the allocation `B_v†` of the channels' wanted accelerations to the
//! inputs.
//!
//! Of `n` test masses there are `3 + 6n` channels. The inputs are thrust and torque of the thrusters, three each, and
//! of each test mass the electrodes' forces along the axes that are not drag-free and their three torques: with `d`
//! drag-free axes `6 + 6n − d`, so that `3 − d` of the three directions of thrust are free. The paper's spacecraft has
//! `d = 2`, fifteen channels and sixteen inputs. One test mass that is drag-free along all of its axes has `d = 3`:
//! nine of each, and `B_v† = B_v⁻¹`.

use nalgebra::{DMatrix, DVector, Matrix3, Vector3};

use crate::mission::{Mission, MissionError};
use crate::signals::{Command, Readout, TestMassCommand};

const NEEDED_BY: &str = "the control law";

/// Rows of the input vector that hold thrust and torque of the thrusters.
const THRUSTERS: usize = 6;
/// Largest element of `B_v B_v† − 1`, in units of the channels' own accelerations.
const RESIDUAL_TOLERANCE: f64 = 1e-12;
/// Newton steps towards the least effort.
const NEWTON_STEPS: usize = 4;
/// Sine of the angle within which two drag-free axes count as parallel. By the electrodes' reaction, `m_m/m_S`, `B_v`
/// would still be regular, but the thrust unusably large.
const PARALLEL: f64 = 0.05;

/// The plant of eq:state_space_model that the decoupling assumes: nominal masses, offsets and stiffness.
pub(crate) struct LinearPlant {
    sc_mass_kg: f64,
    sc_inertia_inverse: Matrix3<f64>,
    tm: Vec<LinearTestMass>,
    /// Columns are orthogonal directions of thrust in SRF: those along drag-free axes first, then the free ones.
    thrust: Matrix3<f64>,
    /// Whether they are not the axes of SRF in their order.
    turned: bool,
    /// How many directions of thrust are free.
    free: usize,
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
    /// Axes along which electrodes push.
    suspended: Vec<usize>,
}

impl LinearTestMass {
    /// Inputs of its electrodes.
    fn inputs(&self) -> usize {
        self.suspended.len() + 3
    }
}

/// Orthogonal directions of thrust, those along drag-free axes first, and the number of free ones; `None` if drag-free
/// axes are parallel or more than three.
fn directions_of_thrust(drag_free: &[Vector3<f64>]) -> Option<(Matrix3<f64>, usize)> {
    // Use the axes of SRF if they suffice: two drag-free axes across s_3 use s_1 and s_2, one along s_3 uses s_3.
    let taken = |axis: usize| drag_free.iter().any(|d| d[axis] != 0.0);
    let mut order: Vec<usize> = (0..3).filter(|axis| taken(*axis)).collect();
    let aligned = order.len() == drag_free.len();
    order.extend((0..3).filter(|axis| !taken(*axis)));
    let unit = |axis: usize| Vector3::from_fn(|i, _| f64::from(u8::from(i == axis)));
    let mut basis: Vec<Vector3<f64>> = Vec::new();
    for axis in drag_free {
        let rest = basis.iter().fold(*axis, |rest, known| rest - known * known.dot(axis));
        if rest.norm() < PARALLEL {
            return None;
        }
        basis.push(rest.normalize());
    }
    let free = 3 - basis.len();
    if aligned {
        return Some((Matrix3::from_columns(&[order[0], order[1], order[2]].map(unit)), free));
    }
    while basis.len() < 3 {
        let rest = |axis: usize| {
            let unit = unit(axis);
            basis.iter().fold(unit, |rest, known| rest - known * known.dot(&unit))
        };
        let best = (0..3).map(rest).max_by(|a, b| a.norm().total_cmp(&b.norm()))?;
        basis.push(best.normalize());
    }
    Some((Matrix3::from_columns(&basis), free))
}

impl LinearPlant {
    pub(crate) fn new(mission: &Mission) -> Result<Self, MissionError> {
        let lever = mission.control.as_ref().is_none_or(|c| c.lever_feed_forward);
        let mut tm = Vec::with_capacity(mission.test_mass.len());
        let mut drag_free = Vec::new();
        for (name, section) in &mission.test_mass {
            let inertia_inverse = section.inertia_inverse(name, NEEDED_BY)?;
            let dcm_orf_from_srf = section.dcm_orf_from_srf();
            drag_free.extend(
                (0..3).filter(|axis| section.is_drag_free(*axis)).map(|axis| dcm_orf_from_srf.row(axis).transpose()),
            );
            tm.push(LinearTestMass {
                mass_kg: section.mass_kg,
                inertia_inverse,
                dcm_orf_from_srf,
                offset_srf_m: if lever { Vector3::from(section.offset_nominal_srf_m) } else { Vector3::zeros() },
                stiffness_tt: section.stiffness_tt(),
                stiffness_tr: section.stiffness_tr(),
                stiffness_rt: section.stiffness_rt(&inertia_inverse),
                stiffness_rr: section.stiffness_rr(),
                suspended: (0..3).filter(|axis| !section.is_drag_free(*axis)).collect(),
            });
        }
        if tm.is_empty() {
            return Err(MissionError::Missing { section: "test_mass".to_owned(), needed_by: NEEDED_BY });
        }
        let (thrust, free) = directions_of_thrust(&drag_free).ok_or_else(|| MissionError::Decoupling {
            reason: "drag-free axes of the test masses are parallel to within 3°, or more than three, and thrust cannot serve \
                     all of them; check test_mass.*.drag_free and orf_from_srf_angle_rad"
                .to_owned(),
        })?;
        Ok(Self {
            sc_mass_kg: mission.spacecraft.mass_kg,
            sc_inertia_inverse: mission.spacecraft.inertia_inverse(),
            tm,
            thrust,
            turned: thrust != Matrix3::identity(),
            free,
        })
    }

    pub(crate) fn channels(&self) -> usize {
        3 + 6 * self.tm.len()
    }

    fn inputs(&self) -> usize {
        THRUSTERS + self.tm.iter().map(LinearTestMass::inputs).sum::<usize>()
    }

    /// Directions of thrust that are free, as rows of the input vector.
    fn free_thrust(&self) -> std::ops::Range<usize> {
        3 - self.free..3
    }

    /// The inputs of eq:input_variables_reduced: `F_T` along the directions of thrust, `M_T`, then of each test mass
    /// `F_E` along its suspended axes and `M_E`.
    fn command(&self, u: &[f64]) -> Command {
        let three = |i: usize| Vector3::new(u[i], u[i + 1], u[i + 2]);
        let mut at = THRUSTERS;
        let tm = self.tm.iter().map(|tm| {
            let mut force_orf_n = Vector3::zeros();
            for (axis, value) in tm.suspended.iter().zip(&u[at..]) {
                force_orf_n[*axis] = *value;
            }
            let torque_orf_nm = three(at + tm.suspended.len());
            at += tm.inputs();
            TestMassCommand { force_orf_n, torque_orf_nm }
        });
        Command { mps_force_srf_n: self.thrust_srf(&three(0)), mps_torque_srf_nm: three(3), tm: tm.collect() }
    }

    /// Thrust in SRF from its components along the directions of thrust.
    fn thrust_srf(&self, along: &Vector3<f64>) -> Vector3<f64> {
        if self.turned { self.thrust * along } else { *along }
    }

    /// `B_v u`: accelerations of the channels, in the order of [`Mission::channels`].
    ///
    /// `α = J_S⁻¹(M_T − Σ T M_Ej − Σ b_j×(T F_Ej))`, `r̈_i = −T((F_T − Σ T F_Ej)/m_S + α×b_i) + F_Ei/m_i`, and a test
    /// mass turns against its housing by `J_m⁻¹ M_Ei − T α`.
    pub(crate) fn accelerations(&self, u: &Command) -> Vec<f64> {
        let (mut force, mut torque) = (u.mps_force_srf_n, u.mps_torque_srf_nm);
        for (tm, e) in self.tm.iter().zip(&u.tm) {
            let f = tm.dcm_orf_from_srf.tr_mul(&e.force_orf_n);
            force -= f;
            torque -= tm.dcm_orf_from_srf.tr_mul(&e.torque_orf_nm) + tm.offset_srf_m.cross(&f);
        }
        let alpha = self.sc_inertia_inverse * torque;
        let mut out = Vec::with_capacity(self.channels());
        out.extend(&alpha);
        for (tm, e) in self.tm.iter().zip(&u.tm) {
            let inertial = force / self.sc_mass_kg + alpha.cross(&tm.offset_srf_m);
            out.extend(&(e.force_orf_n / tm.mass_kg - tm.dcm_orf_from_srf * inertial));
            out.extend(&(tm.inertia_inverse * e.torque_orf_nm - tm.dcm_orf_from_srf * alpha));
        }
        out
    }

    /// `B_v`, column by column.
    fn input_matrix(&self) -> DMatrix<f64> {
        let inputs = self.inputs();
        let column = |j: usize| {
            let unit: Vec<f64> = (0..inputs).map(|i| f64::from(u8::from(i == j))).collect();
            DVector::from_vec(self.accelerations(&self.command(&unit)))
        };
        DMatrix::from_columns(&(0..inputs).map(column).collect::<Vec<_>>())
    }

    /// Subtracts `A_v p̂` from the wanted accelerations of the channels.
    pub(crate) fn take_stiffness_off(&self, y: &Readout, wanted: &mut [f64]) {
        for (i, (s, tm)) in self.tm.iter().zip(&y.tm).enumerate() {
            let r = s.stiffness_tt * tm.r_orf_m + s.stiffness_tr * tm.att_orf_rad;
            let turn = s.stiffness_rt * tm.r_orf_m + s.stiffness_rr * tm.att_orf_rad;
            let of_test_mass = &mut wanted[3 + 6 * i..9 + 6 * i];
            of_test_mass.iter_mut().zip(r.iter().chain(&turn)).for_each(|(wanted, a)| *wanted -= a);
        }
    }
}

/// The allocation, with measures of its accuracy.
#[derive(Clone, Debug)]
pub struct Allocation {
    /// `B_v†`: inputs by channels, N or N m per m s⁻² or rad s⁻². Inputs are thrust along [`Self::thrust`], torque of
    /// the thrusters, then of each test mass the electrodes' forces along its suspended axes and their torques.
    pub matrix: DMatrix<f64>,
    /// Columns are the directions of thrust in SRF; the axes of SRF where drag-free axes lie along or across `s_3`.
    pub thrust: Matrix3<f64>,
    /// Largest element of `|B_v B_v† − 1|`.
    pub residual: f64,
    /// Relative errors of the rules of thrust: eqs x_axis_thrust and
    /// y_axis_thrust for two test masses that are drag-free along x, and eq z_axis_thrust for each free direction of
    /// thrust. The last is kept exactly whatever the geometry; the first two follow when the optical benches mirror
    /// each other.
    pub thrust_rules: Vec<f64>,
}

impl Allocation {
    /// The allocation of a mission.
    ///
    /// # Errors
    /// [`MissionError`]: a section is missing, drag-free axes are parallel, or the programme has no solution.
    pub fn new(mission: &Mission) -> Result<Self, MissionError> {
        LinearPlant::new(mission)?.allocation()
    }
}

/// `B_v†` stored by columns, for repeated products.
pub(crate) struct Allocator {
    columns: Vec<f64>,
    /// `B_v† wanted` of the last call.
    inputs: Vec<f64>,
}

impl Allocator {
    pub(crate) fn new(allocation: &Allocation) -> Self {
        let inputs = vec![0.0; allocation.matrix.nrows()];
        Self { columns: allocation.matrix.as_slice().to_vec(), inputs }
    }

    /// The command that gives the channels these accelerations.
    pub(crate) fn command(&mut self, plant: &LinearPlant, wanted: &[f64]) -> Command {
        // −0 keeps the sign of the first term: −0 + x is x, for a zero of either sign too.
        self.inputs.fill(-0.0);
        for (column, wanted) in self.columns.chunks_exact(self.inputs.len()).zip(wanted) {
            for (input, weight) in self.inputs.iter_mut().zip(column) {
                *input += weight * wanted;
            }
        }
        plant.command(&self.inputs)
    }
}

impl LinearPlant {
    /// Component of each channel's acceleration along a free direction of thrust; zero for axes that are not suspended.
    fn common_motion(&self, direction: usize) -> Vec<f64> {
        let mut out = vec![0.0; self.channels()];
        for (i, tm) in self.tm.iter().enumerate() {
            let along = tm.dcm_orf_from_srf * self.thrust.column(direction);
            for axis in &tm.suspended {
                out[3 + 6 * i + axis] = along[*axis];
            }
        }
        out
    }

    /// `B_v†` of eq:generalized_inverse_optimization under the rules of eqs x_axis_thrust to z_axis_thrust.
    ///
    /// `B_v B_v† = 1` leaves one freedom for every channel and free direction of thrust, thrust along it against the
    /// electrodes. The paper's rule for that thrust, `F_Tz ∝ u_d6 + u_d12` and nothing else, is taken for each free
    /// direction: it carries the motion along it that suspended test masses have in common. The electrodes' effort
    /// settles the last freedom. So the programme is: least electrostatic acceleration, subject to `B_v B_v† = 1` and
    /// the rules. The rules for `F_Tx` and `F_Ty` then hold by the symmetry of the two optical frames.
    ///
    /// Read to the letter, eqs x_axis_thrust and y_axis_thrust also forbid thrust for any other channel; with the lever
    /// `α×b` and the electrodes' reaction in `B_v`, that and `B_v B_v† = 1` exclude each other.
    pub(crate) fn allocation(&self) -> Result<Allocation, MissionError> {
        let refuse = |reason: String| MissionError::Decoupling { reason };
        let b = self.input_matrix();
        let scale = self.input_scale();
        let rules: Vec<Vec<f64>> = self.free_thrust().map(|direction| self.common_motion(direction)).collect();
        let singular =
            || refuse("some channel has no actuator of its own; check masses, inertias and angles".to_owned());
        let with = |shares: &[f64]| {
            let scaled: Vec<f64> = shares.iter().map(|share| share * self.sc_mass_kg).collect();
            self.with_thrust(&b, &rules, &scaled).ok_or_else(singular)
        };
        let effort = |m: &DMatrix<f64>| {
            DMatrix::from_fn(m.nrows(), m.ncols(), |i, j| m[(i, j)] * if i >= THRUSTERS { 1.0 / scale[i] } else { 0.0 })
        };
        // The effort is quadratic in the shares: one Newton step minimises it, the others reduce rounding.
        let mut shares = vec![0.0; rules.len()];
        let mut matrix = with(&shares)?;
        for _ in 0..if rules.is_empty() { 0 } else { NEWTON_STEPS } {
            let here = effort(&matrix);
            let mut slopes = Vec::with_capacity(rules.len());
            for direction in 0..rules.len() {
                let mut one_more = shares.clone();
                one_more[direction] += 1.0;
                slopes.push(effort(&(with(&one_more)? - &matrix)));
            }
            let curvature = DMatrix::from_fn(slopes.len(), slopes.len(), |i, j| {
                if i == j { slopes[i].norm_squared() } else { slopes[i].dot(&slopes[j]) }
            });
            let gradient = DVector::from_fn(slopes.len(), |i, _| here.dot(&slopes[i]));
            let step = curvature.lu().solve(&gradient).ok_or_else(singular)?;
            shares.iter_mut().zip(&step).for_each(|(share, step)| *share -= step);
            matrix = with(&shares)?;
        }

        // Column by column: the summation order of a blocked product depends on the machine.
        let product = |j: usize| {
            let zero = DVector::zeros(self.channels());
            (0..self.inputs()).fold(zero, |sum, k| sum + b.column(k) * matrix[(k, j)])
        };
        let product = DMatrix::from_columns(&(0..self.channels()).map(product).collect::<Vec<_>>());
        let residual = (product - DMatrix::identity(self.channels(), self.channels())).amax();
        if residual.is_nan() || residual > RESIDUAL_TOLERANCE {
            return Err(refuse(format!(
                "B B† differs from 1 by {residual:e}, more than {RESIDUAL_TOLERANCE:e}; check masses, inertias and offsets"
            )));
        }
        let thrust_rules = self.thrust_rules(&matrix, &rules);
        Ok(Allocation { matrix, thrust: self.thrust, residual, thrust_rules })
    }

    fn thrust_rules(&self, matrix: &DMatrix<f64>, rules: &[Vec<f64>]) -> Vec<f64> {
        let mut missed = Vec::new();
        if let ([a, b], 1) = (self.tm.as_slice(), self.free)
            && [a, b].iter().all(|tm| tm.suspended == [1, 2])
        {
            for (input, sign) in [(0, 1.0), (1, -1.0)] {
                let [one, two] = [3, 9].map(|channel| matrix[(input, channel)]);
                missed.push((one - sign * two).abs() / one.abs());
            }
        }
        for (input, rule) in self.free_thrust().zip(rules) {
            let largest = (0..rule.len()).max_by(|a, b| rule[*a].abs().total_cmp(&rule[*b].abs())).unwrap_or_default();
            let unit = matrix[(input, largest)] / rule[largest];
            let off = (0..rule.len()).map(|channel| (matrix[(input, channel)] - unit * rule[channel]).abs());
            missed.push(off.fold(0.0, f64::max) / unit.abs());
        }
        missed
    }

    /// Input that gives a body unit acceleration: the unit of effort.
    fn input_scale(&self) -> Vec<f64> {
        let moment = |inverse: &Matrix3<f64>| 3.0 / inverse.trace();
        let mut scale = vec![self.sc_mass_kg; 3];
        scale.extend([moment(&self.sc_inertia_inverse); 3]);
        for tm in &self.tm {
            scale.extend(tm.suspended.iter().map(|_| tm.mass_kg));
            scale.extend([moment(&tm.inertia_inverse); 3]);
        }
        scale
    }

    /// The allocation whose thrust along each free direction is `share` times its rule, which determines all other
    /// inputs; `None` if their matrix is singular.
    fn with_thrust(&self, b: &DMatrix<f64>, rules: &[Vec<f64>], shares: &[f64]) -> Option<DMatrix<f64>> {
        let channels = self.channels();
        let free = self.free_thrust();
        let mut wanted = DMatrix::identity(channels, channels);
        for ((input, rule), share) in free.clone().zip(rules).zip(shares) {
            for (j, weight) in rule.iter().enumerate() {
                let thrust = share * weight;
                wanted.column_mut(j).axpy(-thrust, &b.column(input), 1.0);
            }
        }
        let others = b.clone().remove_columns(free.start, free.len());
        let mut out = others.lu().solve(&wanted)?.insert_rows(free.start, free.len(), 0.0);
        for ((input, rule), share) in free.zip(rules).zip(shares) {
            for (j, weight) in rule.iter().enumerate() {
                out[(input, j)] = share * weight;
            }
        }
        Some(out)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mission::{Axis, TestMass};
    use crate::testing::taiji;

    fn allocation(mission: &Mission) -> Allocation {
        Allocation::new(mission).unwrap()
    }

    #[test]
    fn allocation_is_a_right_inverse_and_keeps_the_rules() {
        let a = allocation(&taiji());
        assert!(a.residual < 1e-12 && a.thrust_rules.iter().all(|r| *r < 1e-12), "{a:?}");
        assert_eq!((a.thrust_rules.len(), a.thrust_rules[2], a.thrust), (3, 0.0, Matrix3::identity()));
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
        let ([x1, x2], [z1, z2]) = ([3, 9], [5, 11]);
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

    /// Thrust 1 % off the rule's share costs effort.
    #[test]
    fn the_allocation_has_the_least_effort() {
        let plant = LinearPlant::new(&taiji()).unwrap();
        let (b, scale) = (plant.input_matrix(), plant.input_scale());
        let rules = [plant.common_motion(2)];
        let effort = |thrust_z: f64| {
            let m = plant.with_thrust(&b, &rules, &[thrust_z]).unwrap();
            (THRUSTERS..16).map(|i| m.row(i).norm_squared() / (scale[i] * scale[i])).sum::<f64>()
        };
        assert!(effort(-750.0) < effort(-757.5) && effort(-750.0) < effort(-742.5));
    }

    /// The wrong sign of the electrodes' reaction on the spacecraft (eq:SC_attitude_dynamics as printed) is no right
    /// inverse.
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
        assert!((b * m - DMatrix::identity(15, 15)).amax() > 1e-6);
    }

    #[test]
    fn parallel_axes_are_refused() {
        let mut mission = taiji();
        mission.test_mass.get_mut("tm2").unwrap().orf_from_srf_angle_rad = std::f64::consts::FRAC_PI_6;
        let error = Allocation::new(&mission).unwrap_err().to_string();
        assert!(error.contains("drag-free axes"), "{error}");
    }

    /// Test masses: name, angle of the frame, rad, and drag-free axes.
    type Bodies<'a> = &'a [(&'a str, f64, &'a [Axis])];

    /// Test masses in any number, each with its drag-free axes.
    fn mission_of(layout: Bodies<'_>) -> Mission {
        let mut mission = taiji();
        let one = mission.test_mass["tm1"].clone();
        mission.housing = None;
        mission.test_mass = layout
            .iter()
            .enumerate()
            .map(|(i, (name, angle, drag_free))| {
                let tm = TestMass {
                    orf_from_srf_angle_rad: *angle,
                    offset_nominal_srf_m: [0.1 * i as f64, 0.05, -0.02],
                    drag_free: drag_free.to_vec(),
                    ..one.clone()
                };
                ((*name).to_owned(), tm)
            })
            .collect();
        mission
    }

    /// A right inverse whatever the number of test masses and of drag-free axes: three to nothing of the directions of
    /// thrust are free.
    #[test]
    fn any_number_of_test_masses_and_drag_free_axes_has_an_allocation() {
        use Axis::{X, Y, Z};
        let layouts: [(Bodies<'_>, usize, usize); 7] = [
            (&[("a", 0.3, &[X, Y, Z])], 9, 9),
            (&[("a", 0.3, &[X, Y])], 10, 9),
            (&[("a", 0.3, &[X])], 11, 9),
            (&[("a", 0.0, &[Z])], 11, 9),
            (&[("a", 0.5, &[])], 12, 9),
            (&[("a", 0.5, &[X]), ("b", -0.5, &[X]), ("c", 0.0, &[Z])], 21, 21),
            (&[("a", 0.5, &[X]), ("b", 0.1, &[]), ("c", 2.0, &[X])], 22, 21),
        ];
        for (layout, inputs, channels) in layouts {
            let a = allocation(&mission_of(layout));
            assert_eq!(a.matrix.shape(), (inputs, channels), "{layout:?}");
            assert!(a.thrust_rules.iter().all(|rule| *rule < 1e-12), "{layout:?}: {:?}", a.thrust_rules);
            assert!((a.thrust.transpose() * a.thrust - Matrix3::identity()).amax() < 1e-15, "{layout:?}");
        }
        for layout in [&[("a", 0.3, [X, Y].as_slice()), ("b", -0.3, &[X])][..], &[("a", 0.3, &[Z]), ("b", -0.3, &[Z])]]
        {
            let error = Allocation::new(&mission_of(layout)).unwrap_err().to_string();
            assert!(error.contains("drag-free axes"), "{error}");
        }
    }

    /// A spacecraft that follows its only test mass along all axes: `F_T = −m_S T_O^S u_d` plus what undoes the lever,
    /// and the electrodes turn the test mass against the spacecraft, `M_E = J_m (u + T α)`.
    #[test]
    fn a_single_drag_free_test_mass_is_followed_by_thrust_alone() {
        use Axis::{X, Y, Z};
        let mut mission = mission_of(&[("a", 0.3, &[X, Y, Z])]);
        mission.test_mass.get_mut("a").unwrap().offset_nominal_srf_m = [0.0; 3];
        let plant = LinearPlant::new(&mission).unwrap();
        let allocation = plant.allocation().unwrap();
        let wanted = [0.0, 0.0, 0.0, 1e-9, -2e-9, 3e-9, 0.0, 0.0, 0.0];
        let command = Allocator::new(&allocation).command(&plant, &wanted);
        let t = mission.test_mass["a"].dcm_orf_from_srf();
        let want = t.tr_mul(&Vector3::new(1e-9, -2e-9, 3e-9)) * -1500.0;
        assert!((command.mps_force_srf_n - want).amax() < 1e-12 * want.amax(), "{}", command.mps_force_srf_n);
        assert!(command.mps_torque_srf_nm.amax() < 1e-20);
        assert_eq!(command.tm[0].force_orf_n, Vector3::zeros());
        let accelerations = plant.accelerations(&command);
        assert!(accelerations.iter().zip(&wanted).all(|(a, b)| (a - b).abs() < 1e-21), "{accelerations:?}");
    }
}
