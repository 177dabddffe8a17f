//! H-infinity synthesis and its certificates.
//!
//! Synthesis is the γ-iteration on two Riccati equations of Doyle, Glover, Khargonekar and Francis (IEEE Trans. Autom.
//! Control 34, 831, 1989) in the general form of Glover and Doyle (Systems & Control Letters 11, 167, 1988): any
//! partition, `D_11 ≠ 0`, `D_12` and `D_21` of full rank but not normalised, `D_22 ≠ 0`.
//!
//! Two certificates verify a closed loop independently of the synthesis: the Hamiltonian test of `‖G‖∞ < γ` ([`norm`])
//! and the matrix inequality of the Bounded Real Lemma ([`bounded_real`]).

use nalgebra::linalg::balancing::balance_parlett_reinsch;
use nalgebra::{Complex, DMatrix};

use crate::lti::{LtiError, StateSpace, blocks};
use crate::riccati::{RiccatiError, stabilising_solution};
use crate::schur::{complex, eigenvalues, lyapunov, singular_value_range};

type C64 = Complex<f64>;
type Matrix = DMatrix<f64>;

/// Relative size below which a singular value counts as zero.
const RANK_TOLERANCE: f64 = 1e-7;
/// Relative size of a negative eigenvalue of `X∞` or `Y∞` that counts as rounding.
const DEFINITE_TOLERANCE: f64 = 1e-9;
/// Ratio of a difference to its terms below which it counts as zero.
const CANCELLED: f64 = 1e-13;
/// Upper limit of the search for γ, relative to the direct terms' bound.
const LARGEST_GAMMA: f64 = 1e9;
/// Regularisation of the states' covariance, relative to its largest element.
const LIFT: f64 = 1e-9;
/// Lower limit of the search for γ.
const SMALLEST_GAMMA: f64 = 1e-9;

/// Condition of Glover and Doyle's theorem that fails at a given γ, in the order of evaluation.
#[expect(missing_docs, reason = "the messages name the fields")]
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum Obstacle {
    /// γ is below the bound of the direct terms, which no controller changes.
    #[error("the direct term from w to z alone has a gain of {at_least}")]
    Direct { at_least: f64 },
    /// The control Riccati equation.
    #[error("X∞ does not exist: {0}")]
    ControlRiccati(RiccatiError),
    /// The filter Riccati equation.
    #[error("Y∞ does not exist: {0}")]
    FilterRiccati(RiccatiError),
    /// `X∞` is not positive semidefinite.
    #[error("X∞ has the negative eigenvalue {smallest}: full information would not suffice")]
    ControlIndefinite { smallest: f64 },
    /// `Y∞` is not positive semidefinite.
    #[error("Y∞ has the negative eigenvalue {smallest}: full control would not suffice")]
    FilterIndefinite { smallest: f64 },
    /// Control and estimation are each feasible, but not combined.
    #[error(
        "the spectral radius of X∞ Y∞ is {ratio} γ², not below γ²: states to be controlled are estimated too poorly"
    )]
    Coupling { ratio: f64 },
}

/// Why a synthesis or a certificate failed.
#[expect(missing_docs, reason = "the messages name the fields")]
#[derive(Debug, thiserror::Error)]
pub enum HinfError {
    /// Numbers of measurements and controls do not fit the plant.
    #[error(
        "a plant of {outputs} outputs and {inputs} inputs cannot have {measurements} measurements and {controls} \
         controls: there must be at least as many errors z as controls, and as many disturbances w as measurements"
    )]
    Partition { outputs: usize, inputs: usize, measurements: usize, controls: usize },
    /// `D_12` has not full column rank.
    #[error("some control costs nothing at high frequency (D_12 has not full column rank): weigh every control")]
    FreeControl,
    /// `D_21` has not full row rank.
    #[error("some measurement has no noise at high frequency (D_21 has not full row rank): add noise to every one")]
    PerfectMeasurement,
    /// An unstable mode is not controllable.
    #[error("the unstable mode at {re:e} + {im:e}i rad/s cannot be reached by the control")]
    NotStabilisable { re: f64, im: f64 },
    /// An unstable mode is not observable.
    #[error("the unstable mode at {re:e} + {im:e}i rad/s is not observable in the measurements")]
    NotDetectable { re: f64, im: f64 },
    /// No controller at this γ.
    #[error("no controller reaches γ = {gamma}: {obstacle}")]
    Infeasible { gamma: f64, obstacle: Obstacle },
    /// The system is unstable and has no norm.
    #[error("the system is not stable (a pole at {re:e} rad/s): its norm is infinite")]
    Unstable { re: f64 },
    /// The strict inequality has no solution at this γ.
    #[error("the Bounded Real Lemma's inequality has no strict solution at γ = {gamma}; the norm is not below it")]
    NotBounded { gamma: f64 },
    /// An interconnection or an eigenvalue computation failed.
    #[error(transparent)]
    System(#[from] LtiError),
}

/// A plant `(w, u) → (z, y)` whose last `measurements` outputs are `y` and whose last `controls` inputs are `u`.
#[derive(Clone, Debug, PartialEq)]
pub struct GeneralizedPlant {
    /// From `(w, u)` to `(z, y)`.
    pub system: StateSpace,
    /// Number of measurements `y`.
    pub measurements: usize,
    /// Number of controls `u`.
    pub controls: usize,
}

/// A synthesis problem, scaled so that `D_12 = [0; I]`, `D_21 = [0 I]`, `D_22 = 0`.
#[derive(Clone, Debug)]
pub struct Synthesis {
    a: Matrix,
    b1: Matrix,
    b2: Matrix,
    c1: Matrix,
    c2: Matrix,
    d11: Matrix,
    d22: Matrix,
    /// `u = control_scale · ũ`.
    control_scale: Matrix,
    /// `ỹ = measurement_scale · y`.
    measurement_scale: Matrix,
}

/// The result of a γ-iteration.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Optimum {
    /// Smallest γ found feasible.
    pub gamma: f64,
    /// Largest γ found infeasible, a relative tolerance below.
    pub refused: f64,
    /// The condition that fails there; `None` if γ has no positive lower bound.
    pub obstacle: Option<Obstacle>,
}

/// Solutions and gains at one γ.
struct Solved {
    x: Matrix,
    y: Matrix,
    f: Matrix,
    l: Matrix,
}

fn largest_singular_value(m: &Matrix) -> f64 {
    singular_value_range(&complex(m)).1
}

fn horizontal(left: &Matrix, right: &Matrix) -> Matrix {
    blocks([[left, right]])
}

fn vertical(upper: &Matrix, lower: &Matrix) -> Matrix {
    blocks([[upper], [lower]])
}

/// `diag(γ² I, 0)` with `count` entries of γ² in a square of `size`.
fn gamma_block(gamma: f64, count: usize, size: usize) -> Matrix {
    Matrix::from_fn(size, size, |i, j| if i == j && i < count { gamma * gamma } else { 0.0 })
}

/// Orthogonal `Q` (rows) and invertible `R` with `Q D = [0; R]` for `D` of full column rank, or `None`.
fn bottom_triangular(d: &Matrix) -> Option<(Matrix, Matrix)> {
    let (rows, columns) = d.shape();
    let (smallest, largest) = singular_value_range(&complex(d));
    if columns > rows || smallest <= RANK_TOLERANCE * largest {
        return None;
    }
    let qr = d.clone().qr();
    let mut transposed = Matrix::identity(rows, rows);
    qr.q_tr_mul(&mut transposed);
    // The rows that D reaches go last.
    let turned = Matrix::from_fn(rows, rows, |i, j| transposed[((i + columns) % rows, j)]);
    Some((turned, qr.r()))
}

impl GeneralizedPlant {
    /// `F_l(P, K)` of eq:lower_fractional_transformation.
    ///
    /// # Errors
    /// [`HinfError::System`] when the loop has no solution at infinite frequency.
    pub fn closed(&self, controller: &StateSpace) -> Result<StateSpace, HinfError> {
        Ok(self.system.lower_fractional(controller)?)
    }
}

impl Synthesis {
    /// Checks and scales a problem.
    ///
    /// # Errors
    /// [`HinfError`] names the assumption that the plant breaks.
    pub fn new(plant: &GeneralizedPlant) -> Result<Self, HinfError> {
        let StateSpace { a, b, c, d } = &plant.system;
        let (outputs, inputs) = d.shape();
        let (measurements, controls) = (plant.measurements, plant.controls);
        let enough = measurements > 0 && controls > 0;
        if !enough || outputs < measurements + controls || inputs < measurements + controls {
            return Err(HinfError::Partition { outputs, inputs, measurements, controls });
        }
        let (z, w) = (outputs - measurements, inputs - controls);
        let block = |i: usize, j: usize, rows: usize, columns: usize| d.view((i, j), (rows, columns)).into_owned();
        let (turn_z, r12) = bottom_triangular(&block(0, w, z, controls)).ok_or(HinfError::FreeControl)?;
        let (turn_w, r21) =
            bottom_triangular(&block(z, 0, measurements, w).transpose()).ok_or(HinfError::PerfectMeasurement)?;
        let control_scale = r12.try_inverse().ok_or(HinfError::FreeControl)?;
        let measurement_scale = r21.transpose().try_inverse().ok_or(HinfError::PerfectMeasurement)?;
        let b2 = b.columns(w, controls).into_owned();
        let c2 = c.rows(z, measurements).into_owned();
        reachable(a, &b2).map_err(|s| HinfError::NotStabilisable { re: s.re, im: s.im })?;
        reachable(&a.transpose(), &c2.transpose()).map_err(|s| HinfError::NotDetectable { re: s.re, im: s.im })?;
        // Scaling the states improves conditioning and changes nothing else.
        let mut balanced = a.clone();
        let scaling = balance_parlett_reinsch(&mut balanced);
        let (up, down) = (Matrix::from_diagonal(&scaling), Matrix::from_diagonal(&scaling.map(|s| 1.0 / s)));
        Ok(Self {
            a: balanced,
            b1: &down * b.columns(0, w) * turn_w.transpose(),
            b2: &down * b2 * &control_scale,
            c1: &turn_z * c.rows(0, z) * &up,
            c2: &measurement_scale * c2 * &up,
            d11: &turn_z * block(0, 0, z, w) * turn_w.transpose(),
            d22: block(z, w, measurements, controls),
            control_scale,
            measurement_scale,
        })
    }

    /// Numbers of `z`, `w`, `y`, `u`.
    fn sizes(&self) -> (usize, usize, usize, usize) {
        (self.c1.nrows(), self.b1.ncols(), self.c2.nrows(), self.b2.ncols())
    }

    /// `D_1111, D_1112, D_1121, D_1122`.
    fn direct(&self) -> [Matrix; 4] {
        let (z, w, y, u) = self.sizes();
        let block = |i, j, rows, columns| self.d11.view((i, j), (rows, columns)).into_owned();
        [block(0, 0, z - u, w - y), block(0, w - y, z - u, y), block(z - u, 0, u, w - y), block(z - u, w - y, u, y)]
    }

    /// Lower bound of γ from the direct terms.
    fn direct_bound(&self) -> f64 {
        let [d1111, d1112, d1121, _] = self.direct();
        largest_singular_value(&horizontal(&d1111, &d1112)).max(largest_singular_value(&vertical(&d1111, &d1121)))
    }

    /// `X∞`, `Y∞` and the gains `F`, `L` at γ.
    fn solve(&self, gamma: f64) -> Result<Solved, Obstacle> {
        let (z, w, y, u) = self.sizes();
        let at_least = self.direct_bound();
        if at_least >= gamma {
            return Err(Obstacle::Direct { at_least });
        }
        let unsolvable = Obstacle::Direct { at_least };
        let eye = |n: usize| Matrix::identity(n, n);
        let d12 = vertical(&Matrix::zeros(z - u, u), &eye(u));
        let d21 = horizontal(&Matrix::zeros(y, w - y), &eye(y));
        let b = horizontal(&self.b1, &self.b2);
        let c = vertical(&self.c1, &self.c2);
        let d1_ = horizontal(&self.d11, &d12);
        let d_1 = vertical(&self.d11, &d21);
        let r = d1_.transpose() * &d1_ - gamma_block(gamma, w, w + u);
        let r_filter = &d_1 * d_1.transpose() - gamma_block(gamma, z, z + y);
        let r = r.try_inverse().ok_or(unsolvable)?;
        let r_filter = r_filter.try_inverse().ok_or(unsolvable)?;
        let h = hamiltonian(&self.a, &b, &(self.c1.transpose() * &self.c1), &(self.c1.transpose() * &d1_), &r);
        let j = hamiltonian(
            &self.a.transpose(),
            &c.transpose(),
            &(&self.b1 * self.b1.transpose()),
            &(&self.b1 * d_1.transpose()),
            &r_filter,
        );
        let x = stabilising_solution(&h).map_err(Obstacle::ControlRiccati)?;
        let y = stabilising_solution(&j).map_err(Obstacle::FilterRiccati)?;
        let f = -r * (d1_.transpose() * &self.c1 + b.transpose() * &x);
        let l = -(&self.b1 * d_1.transpose() + &y * c.transpose()) * r_filter;
        Ok(Solved { x, y, f, l })
    }

    /// `solve`, and the three conditions on its result.
    fn feasible(&self, gamma: f64) -> Result<Solved, Obstacle> {
        let solved = self.solve(gamma)?;
        let smallest = |m: &Matrix| {
            let values = m.clone().symmetric_eigenvalues();
            if values.is_empty() { 0.0 } else { values.min() / values.amax().max(f64::MIN_POSITIVE) }
        };
        let (x, y) = (smallest(&solved.x), smallest(&solved.y));
        if x < -DEFINITE_TOLERANCE {
            return Err(Obstacle::ControlIndefinite { smallest: x });
        }
        if y < -DEFINITE_TOLERANCE {
            return Err(Obstacle::FilterIndefinite { smallest: y });
        }
        // `eigenvalues` balances the product, because X∞ and Y∞ differ in scale by orders of magnitude.
        let radius = eigenvalues(&(&solved.x * &solved.y))
            .map_or(f64::INFINITY, |values| values.iter().map(|v| v.re).fold(0.0, f64::max));
        let ratio = radius / (gamma * gamma);
        if ratio < 1.0 { Ok(solved) } else { Err(Obstacle::Coupling { ratio }) }
    }

    /// Whether a controller reaches `‖F_l(P, K)‖∞ < γ`.
    ///
    /// # Errors
    /// The condition that fails first.
    pub fn check(&self, gamma: f64) -> Result<(), Obstacle> {
        self.feasible(gamma).map(|_| ())
    }

    /// γ-iteration: the smallest feasible γ to a relative tolerance.
    ///
    /// # Errors
    /// [`HinfError::Infeasible`] when not even a very large γ is feasible.
    pub fn optimum(&self, relative_tolerance: f64) -> Result<Optimum, HinfError> {
        let floor = self.direct_bound().max(SMALLEST_GAMMA);
        let mut gamma = 2.0 * floor.max(0.5);
        let mut refused = (floor, None);
        while let Err(obstacle) = self.check(gamma) {
            if gamma > LARGEST_GAMMA * floor.max(1.0) {
                return Err(HinfError::Infeasible { gamma, obstacle });
            }
            refused = (gamma, Some(obstacle));
            gamma *= 4.0;
        }
        while gamma > (1.0 + relative_tolerance) * refused.0 {
            let middle = (gamma * refused.0).sqrt();
            match self.check(middle) {
                Ok(()) => gamma = middle,
                Err(obstacle) => refused = (middle, Some(obstacle)),
            }
        }
        // If no γ was refused, the floor is the bound of the direct terms.
        let bound = Obstacle::Direct { at_least: floor };
        let obstacle = refused.1.or((floor > SMALLEST_GAMMA).then_some(bound));
        Ok(Optimum { gamma, refused: refused.0, obstacle })
    }

    /// The central controller at a feasible γ, of the plant's order: `u = K y`.
    ///
    /// # Errors
    /// [`HinfError::Infeasible`] with the obstacle, or an algebraic loop through `D_22`.
    pub fn controller(&self, gamma: f64) -> Result<StateSpace, HinfError> {
        let infeasible = |obstacle| HinfError::Infeasible { gamma, obstacle };
        let solved = self.feasible(gamma).map_err(infeasible)?;
        let scaled = self
            .central(gamma, &solved)
            .ok_or_else(|| infeasible(Obstacle::Direct { at_least: self.direct_bound() }))?;
        // ỹ = S_y (y − D_22 u), u = S_u ũ: undo the scaling, then the shift of D_22.
        let b = &scaled.b * &self.measurement_scale;
        let c = &self.control_scale * &scaled.c;
        let d = &self.control_scale * &scaled.d * &self.measurement_scale;
        let u = d.nrows();
        let solved = (Matrix::identity(u, u) + &d * &self.d22).try_inverse().ok_or(LtiError::AlgebraicLoop)?;
        let (c, d) = (&solved * c, &solved * d);
        Ok(StateSpace { a: &scaled.a - &b * &self.d22 * &c, b: &b - &b * &self.d22 * &d, c, d })
    }

    /// Glover and Doyle's formulas for the central controller of the scaled problem.
    fn central(&self, gamma: f64, solved: &Solved) -> Option<StateSpace> {
        let (z, w, y, u) = self.sizes();
        let n = self.a.nrows();
        let [d1111, d1112, d1121, d1122] = self.direct();
        let square = gamma * gamma;
        let inverse = |m: Matrix| (Matrix::identity(m.nrows(), m.nrows()) * square - m).try_inverse();
        let left = inverse(&d1111 * d1111.transpose())?;
        let right = inverse(d1111.transpose() * &d1111)?;
        let d11 = -&d1121 * d1111.transpose() * &left * &d1112 - d1122;
        // D̂_12 D̂_12ᵀ and D̂_21ᵀ D̂_21, lower and upper Cholesky factors.
        let d12 = (Matrix::identity(u, u) - &d1121 * right * d1121.transpose()).cholesky()?.l();
        let d21 = (Matrix::identity(y, y) - d1112.transpose() * left * &d1112).cholesky()?.l().transpose();
        let (f, l) = (&solved.f, &solved.l);
        let f12 = f.rows(w - y, y);
        let f2 = f.rows(w, u);
        let l12 = l.columns(z - u, u);
        let l2 = l.columns(z, y);
        let z_inf = (Matrix::identity(n, n) - &solved.y * &solved.x / square).try_inverse()?;
        let b2 = &z_inf * (&self.b2 + l12) * &d12;
        let c2 = -&d21 * (&self.c2 + f12);
        let b1 = -&z_inf * l2 + &b2 * d12.try_inverse()? * &d11;
        let d21_inverse = d21.try_inverse()?;
        let c1 = f2 + &d11 * &d21_inverse * &c2;
        let a = &self.a + horizontal(&self.b1, &self.b2) * f + &b1 * d21_inverse * c2;
        StateSpace::new(a, b1, c1, d11).ok()
    }
}

/// `[[A, 0], [−Q, −Aᵀ]] − [B; −S] R⁻¹ [Sᵀ, Bᵀ]`.
fn hamiltonian(a: &Matrix, b: &Matrix, q: &Matrix, s: &Matrix, r_inverse: &Matrix) -> Matrix {
    let n = a.nrows();
    let mut h = blocks([[a, &Matrix::zeros(n, n)], [&-q, &-a.transpose()]]);
    h -= vertical(b, &-s) * r_inverse * horizontal(&s.transpose(), &b.transpose());
    // In mixed sensitivity this block cancels except for rounding.
    let mut constant = h.view_mut((n, 0), (n, n));
    if constant.amax() <= CANCELLED * q.amax() {
        constant.fill(0.0);
    }
    h
}

/// Whether every mode of `A` in the closed right half plane is reached through `B` (Popov, Belevitch and Hautus).
fn reachable(a: &Matrix, b: &Matrix) -> Result<(), C64> {
    let n = a.nrows();
    let modes = eigenvalues(a).ok_or(C64::from(f64::NAN))?;
    let size = a.norm().max(f64::MIN_POSITIVE);
    for mode in modes.into_iter().filter(|m| m.re >= -RANK_TOLERANCE * size) {
        let mut pencil = complex(&horizontal(a, b));
        let mut square = pencil.columns_mut(0, n);
        square -= DMatrix::from_diagonal_element(n, n, mode);
        // Normalise rows, so that the rank test does not depend on the scale of the states.
        for mut row in pencil.row_iter_mut() {
            let length = row.norm();
            if length > 0.0 {
                row.unscale_mut(length);
            }
        }
        if singular_value_range(&pencil).0 < RANK_TOLERANCE {
            return Err(mode);
        }
    }
    Ok(())
}

/// `‖G‖∞` and where it is reached.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Norm {
    /// Largest singular value of the response over all frequencies.
    pub value: f64,
    /// Frequency of the maximum, rad/s; infinite for the direct term.
    pub frequency_rad_s: f64,
}

/// The same system with balanced states.
fn with_balanced_states(system: &StateSpace) -> StateSpace {
    let mut a = system.a.clone();
    let scaling = balance_parlett_reinsch(&mut a);
    let (up, down) = (Matrix::from_diagonal(&scaling), Matrix::from_diagonal(&scaling.map(|s| 1.0 / s)));
    StateSpace { a, b: down * &system.b, c: &system.c * up, d: system.d.clone() }
}

fn gain_at(system: &StateSpace, omega: f64) -> f64 {
    singular_value_range(&system.response(C64::new(0.0, omega))).1
}

/// Hamiltonian of `‖G‖∞ < γ`: no imaginary eigenvalue if and only if the bound holds. `None` when `γ ≤ σ̄(D)`.
fn norm_hamiltonian(system: &StateSpace, gamma: f64) -> Option<Matrix> {
    let m = system.d.ncols();
    let r = Matrix::identity(m, m) * (gamma * gamma) - system.d.transpose() * &system.d;
    let r_inverse = r.cholesky()?.inverse();
    let q = system.c.transpose() * &system.c;
    Some(hamiltonian(&system.a, &system.b, &q, &(system.c.transpose() * &system.d), &-r_inverse))
}

/// Frequencies at which a singular value may pass γ, ascending, rad/s: imaginary parts of eigenvalues near the axis.
/// The tolerance is generous, since each candidate is evaluated afterwards.
fn crossings(system: &StateSpace, gamma: f64) -> Result<Vec<f64>, HinfError> {
    let order = 2 * system.order();
    let unknown = || HinfError::System(LtiError::Eigenvalues { order });
    let h = norm_hamiltonian(system, gamma).ok_or(HinfError::NotBounded { gamma })?;
    let values = eigenvalues(&h).ok_or_else(unknown)?;
    let near = values.iter().filter(|v| v.im >= 0.0 && v.re.abs() <= 1e-4 * v.norm());
    let mut found: Vec<f64> = near.map(|v| v.im).collect();
    found.sort_by(f64::total_cmp);
    Ok(found)
}

fn must_be_stable(system: &StateSpace) -> Result<Vec<C64>, HinfError> {
    let poles = system.poles()?;
    match poles.iter().map(|p| p.re).max_by(f64::total_cmp) {
        Some(re) if re >= 0.0 => Err(HinfError::Unstable { re }),
        _ => Ok(poles),
    }
}

/// Largest gain at the candidate frequencies and between them.
fn best_gain(system: &StateSpace, candidates: &[f64]) -> Norm {
    let between = candidates.windows(2).map(|w| 0.5 * (w[0] + w[1]));
    let mut best = Norm { value: 0.0, frequency_rad_s: 0.0 };
    for omega in candidates.iter().copied().chain(between) {
        let value = gain_at(system, omega);
        if value > best.value {
            best = Norm { value, frequency_rad_s: omega };
        }
    }
    best
}

/// `‖G‖∞` to a relative tolerance: the Hamiltonian test raises a lower bound until it passes (Boyd, Balakrishnan and
/// Kabamba; Bruinsma and Steinbuch).
///
/// # Errors
/// [`HinfError::Unstable`] for a system without norm.
pub fn norm(system: &StateSpace, relative_tolerance: f64) -> Result<Norm, HinfError> {
    let system = with_balanced_states(system);
    let poles = must_be_stable(&system)?;
    let mut candidates: Vec<f64> = poles.iter().flat_map(|p| [p.im.abs(), p.norm()]).collect();
    candidates.push(0.0);
    candidates.sort_by(f64::total_cmp);
    let mut best = best_gain(&system, &candidates);
    let direct = largest_singular_value(&system.d);
    if direct >= best.value {
        best = Norm { value: direct, frequency_rad_s: f64::INFINITY };
    }
    if best.value == 0.0 {
        return Ok(best);
    }
    loop {
        let gamma = best.value * (1.0 + relative_tolerance);
        let found = best_gain(&system, &crossings(&system, gamma)?);
        if found.value <= gamma {
            return Ok(Norm { value: best.value.max(found.value), ..best });
        }
        best = found;
    }
}

/// The Bounded Real Lemma's certificate of `‖G‖∞ < γ`: `X = Xᵀ > 0` with
/// `[[AᵀX + XA + CᵀC, XB + CᵀD], [BᵀX + DᵀC, DᵀD − γ²I]] < 0`.
///
/// The states are scaled so that a white input gives them unit covariance, and the lower rows are divided by γ:
/// eigenvalues are then comparable with squared gains and rates.
#[derive(Clone, Debug)]
pub struct BoundedReal {
    /// The bound that is proved.
    pub gamma: f64,
    /// `X`, for the scaled states.
    pub x: Matrix,
    /// Smallest eigenvalue of `X` over its largest: positive.
    pub x_smallest_eigenvalue: f64,
    /// Largest eigenvalue of the inequality's left side over its largest in size: negative.
    pub largest_eigenvalue: f64,
    /// The scaled states in the given system's: `x = scaling · x̃`.
    scaling: Matrix,
}

/// Largest eigenvalue of the inequality's left side at a given `X`, over its largest in size.
fn inequality(system: &StateSpace, gamma: f64, x: &Matrix) -> f64 {
    let StateSpace { a, b, c, d } = system;
    let xa = x * a;
    let corner = &xa + xa.transpose() + c.transpose() * c;
    let side = (x * b + c.transpose() * d) / gamma;
    let m = d.ncols();
    let lower = d.transpose() * d / (gamma * gamma) - Matrix::identity(m, m);
    let whole = blocks([[&corner, &side], [&side.transpose(), &lower]]);
    let values = whole.symmetric_eigenvalues();
    values.max() / values.amax()
}

/// The same system in other states, `x = scaling · x̃`.
fn in_states(system: &StateSpace, scaling: &Matrix) -> Option<StateSpace> {
    let inverse = scaling.clone().try_inverse()?;
    let StateSpace { a, b, c, d } = system;
    Some(StateSpace { a: &inverse * a * scaling, b: inverse * b, c: c * scaling, d: d.clone() })
}

/// Cholesky factor of the states' covariance under white noise, regularised by [`LIFT`] for states that are not
/// controllable.
fn covariance_factor(system: &StateSpace) -> Option<Matrix> {
    let mut a = system.a.clone();
    let up = Matrix::from_diagonal(&balance_parlett_reinsch(&mut a));
    let b = up.clone().try_inverse()? * &system.b;
    let covariance = lyapunov(&a.transpose(), &(&b * b.transpose()))?;
    let n = a.nrows();
    let lift = Matrix::identity(n, n) * (LIFT * covariance.amax());
    Some(up * (covariance + lift).cholesky()?.l())
}

impl BoundedReal {
    /// Evaluates the inequality of another system of the same order at this certificate's `X`; not negative where the
    /// certificate does not prove the bound for it.
    pub fn largest_eigenvalue_for(&self, system: &StateSpace) -> f64 {
        in_states(system, &self.scaling).map_or(f64::NAN, |system| inequality(&system, self.gamma, &self.x))
    }
}

/// Solves for a strict `X` through the Riccati equation with `CᵀC + δI`, the largest δ of a few decades that leaves a
/// solution, and evaluates the inequality at it.
///
/// # Errors
/// [`HinfError::NotBounded`] when no δ gives a strict inequality, as when the norm is not below γ.
pub fn bounded_real(system: &StateSpace, gamma: f64) -> Result<BoundedReal, HinfError> {
    let not_bounded = || HinfError::NotBounded { gamma };
    must_be_stable(system)?;
    let n = system.order();
    let scaling = covariance_factor(system).ok_or_else(not_bounded)?;
    let system = in_states(system, &scaling).ok_or_else(not_bounded)?;
    let h = norm_hamiltonian(&system, gamma).ok_or_else(not_bounded)?;
    for exponent in 1..12 {
        let delta = gamma * gamma * 10.0_f64.powi(-exponent);
        let mut strict = h.clone();
        for i in 0..n {
            strict[(n + i, i)] -= delta;
        }
        let Ok(x) = stabilising_solution(&strict) else { continue };
        let values = x.clone().symmetric_eigenvalues();
        let x_smallest_eigenvalue = values.min() / values.amax();
        let largest_eigenvalue = inequality(&system, gamma, &x);
        let rounding = f64::EPSILON * (n + system.d.ncols()) as f64;
        if x_smallest_eigenvalue > rounding && largest_eigenvalue < -rounding {
            return Ok(BoundedReal { gamma, x, x_smallest_eigenvalue, largest_eigenvalue, scaling });
        }
    }
    Err(not_bounded())
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use serde_json::Value;

    /// The Hamiltonian test alone: whether a stable system has `‖G‖∞ < γ`.
    fn norm_is_below(system: &StateSpace, gamma: f64) -> Result<bool, HinfError> {
        let system = with_balanced_states(system);
        if must_be_stable(&system).is_err() || largest_singular_value(&system.d) >= gamma {
            return Ok(false);
        }
        Ok(best_gain(&system, &crossings(&system, gamma)?).value < gamma)
    }

    fn matrix(value: &Value) -> Matrix {
        let rows: Vec<Vec<f64>> = serde_json::from_value(value.clone()).unwrap();
        Matrix::from_row_iterator(rows.len(), rows[0].len(), rows.iter().flatten().copied())
    }

    /// The published problems with SLICOT's γ (`tests/oracles`).
    fn benchmarks() -> Vec<(String, GeneralizedPlant, f64, Option<f64>)> {
        let text = include_str!("../../../tests/oracles/hinf_benchmarks.json");
        let problem = |p: &Value| {
            let [a, b, c, d] = ["a", "b", "c", "d"].map(|key| matrix(&p[key]));
            let count = |key: &str| p[key].as_u64().unwrap() as usize;
            let system = StateSpace::new(a, b, c, d).unwrap();
            let plant = GeneralizedPlant { system, measurements: count("measurements"), controls: count("controls") };
            let name = p["name"].as_str().unwrap().to_owned();
            (name, plant, p["slicot_gamma"].as_f64().unwrap(), p["published_gamma"].as_f64())
        };
        serde_json::from_str::<Vec<Value>>(text).unwrap().iter().map(problem).collect()
    }

    #[test]
    fn gamma_is_that_of_slicot_and_of_the_books() {
        let problems = benchmarks();
        assert!(problems.len() >= 9);
        for (name, plant, slicot, published) in problems {
            let optimum = Synthesis::new(&plant).unwrap().optimum(1e-6).unwrap();
            assert!((optimum.gamma / slicot - 1.0).abs() < 1e-3, "{name}: {} for {slicot}", optimum.gamma);
            assert!(optimum.obstacle.is_some() && optimum.refused < optimum.gamma, "{name}");
            if let Some(published) = published {
                // Books print two decimals; closed forms are exact.
                let tolerance = if published == (published * 100.0).round() / 100.0 { 0.005 } else { 2e-6 };
                assert!((optimum.gamma - published).abs() < tolerance, "{name}: {published} in print");
            }
        }
    }

    /// Both certificates hold just above γ, and fail with a γ 1 % lower, and with a controller that breaks the bound.
    #[test]
    fn certificates_hold_and_their_twins_fail() {
        for (name, plant, gamma, _) in benchmarks() {
            let synthesis = Synthesis::new(&plant).unwrap();
            assert!(synthesis.check(0.99 * gamma).is_err(), "{name}: 1 % below is feasible");
            let bound = 1.01 * gamma;
            let controller = synthesis.controller(bound).unwrap();
            let closed = plant.closed(&controller).unwrap();
            assert!(norm_is_below(&closed, bound).unwrap(), "{name}");
            let value = norm(&closed, 1e-6).unwrap().value;
            assert!(value >= 0.999 * gamma && value < bound, "{name}: norm {value}");
            let lemma = bounded_real(&closed, bound).unwrap();
            assert!(lemma.largest_eigenvalue < 0.0 && lemma.x_smallest_eigenvalue > 0.0, "{name}");
            assert!(bounded_real(&closed, 0.99 * value).is_err(), "{name}: a bound below the norm is proved");
            let broken = [0.5, 2.0, 4.0].into_iter().filter(|gain| {
                let other = StateSpace { c: &controller.c * *gain, d: &controller.d * *gain, ..controller.clone() };
                let closed = plant.closed(&other).unwrap();
                let breaks = !norm_is_below(&closed, bound).unwrap();
                assert!(
                    !breaks || lemma.largest_eigenvalue_for(&closed) > 0.0,
                    "{name}: the inequality holds at {gain}"
                );
                breaks
            });
            assert!(broken.count() > 0, "{name}: no gain breaks the bound");
        }
    }

    /// Resonance `1/(s² + 2ζs + 1)`, all-pass, and a direct term that is the largest gain.
    #[test]
    fn norms_in_closed_form() {
        let zeta: f64 = 0.01;
        let resonance = StateSpace::quotient(&[0.0, 0.0, 1.0], &[1.0, 2.0 * zeta, 1.0]);
        let found = norm(&resonance, 1e-9).unwrap();
        let exact = 1.0 / (2.0 * zeta * (1.0 - zeta * zeta).sqrt());
        assert!((found.value / exact - 1.0).abs() < 1e-8, "{} for {exact}", found.value);
        assert!((found.frequency_rad_s - (1.0 - 2.0 * zeta * zeta).sqrt()).abs() < 1e-4);
        let all_pass = StateSpace::quotient(&[-1.0, 3.0], &[1.0, 3.0]);
        assert!((norm(&all_pass, 1e-6).unwrap().value - 1.0).abs() < 1e-6);
        let lead = StateSpace::quotient(&[2.0, 1.0], &[1.0, 1.0]);
        assert!((norm(&lead, 1e-6).unwrap().value - 2.0).abs() < 2e-6);
        assert!(
            norm_is_below(&resonance, 1.0001 * exact).unwrap() && !norm_is_below(&resonance, 0.9999 * exact).unwrap()
        );
        let unstable = StateSpace::quotient(&[0.0, 1.0], &[1.0, -2.0]);
        assert!(matches!(norm(&unstable, 1e-3), Err(HinfError::Unstable { re }) if (re - 2.0).abs() < 1e-12));
    }

    /// A plant of one state: `ẋ = a x + w_1 + b u`, `z = (x, u)`, `y = c x + w_2`.
    fn scalar(a: f64, b: f64, c: f64) -> GeneralizedPlant {
        let system = StateSpace::new(
            Matrix::from_element(1, 1, a),
            Matrix::from_row_slice(1, 3, &[1.0, 0.0, b]),
            Matrix::from_row_slice(3, 1, &[1.0, 0.0, c]),
            Matrix::from_row_slice(3, 3, &[0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 1.0, 0.0]),
        );
        GeneralizedPlant { system: system.unwrap(), measurements: 1, controls: 1 }
    }

    /// Closed form for `a = b = c = 1`: `X = Y` with `2X + X²(γ⁻² − 1) + 1 = 0`, and `X² = γ²` at the optimum.
    #[test]
    fn scalar_problem_has_its_closed_form() {
        // X = γ: γ² − 2γ − 2 = 0.
        let exact = 1.0 + 3.0_f64.sqrt();
        let optimum = Synthesis::new(&scalar(1.0, 1.0, 1.0)).unwrap().optimum(1e-9).unwrap();
        assert!((optimum.gamma - exact).abs() < 1e-7, "{}", optimum.gamma);
        assert!(matches!(optimum.obstacle, Some(Obstacle::Coupling { .. })), "{:?}", optimum.obstacle);
    }

    #[test]
    fn broken_assumptions_are_named() {
        assert!(matches!(Synthesis::new(&scalar(1.0, 0.0, 1.0)), Err(HinfError::NotStabilisable { .. })));
        assert!(matches!(Synthesis::new(&scalar(1.0, 1.0, 0.0)), Err(HinfError::NotDetectable { .. })));
        assert!(Synthesis::new(&scalar(-1.0, 0.0, 0.0)).is_ok(), "a stable mode may be out of reach");
        let mut plant = scalar(1.0, 1.0, 1.0);
        plant.system.d[(1, 2)] = 0.0;
        assert!(matches!(Synthesis::new(&plant), Err(HinfError::FreeControl)));
        let mut plant = scalar(1.0, 1.0, 1.0);
        plant.system.d[(2, 1)] = 0.0;
        assert!(matches!(Synthesis::new(&plant), Err(HinfError::PerfectMeasurement)));
        let plant = GeneralizedPlant { controls: 3, ..scalar(1.0, 1.0, 1.0) };
        assert!(matches!(Synthesis::new(&plant), Err(HinfError::Partition { .. })));
        // A direct term from w_1 to x that no control reaches.
        let mut plant = scalar(1.0, 1.0, 1.0);
        plant.system.d[(0, 0)] = 5.0;
        let synthesis = Synthesis::new(&plant).unwrap();
        assert!(matches!(synthesis.check(4.9), Err(Obstacle::Direct { at_least }) if (at_least - 5.0).abs() < 1e-12));
        let error = synthesis.controller(4.9).unwrap_err().to_string();
        assert!(error.contains("4.9") && error.contains("direct term"), "{error}");
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]
        /// Random plants of all sizes, every direct term present: the controller at 1.05 γ keeps its bound.
        #[test]
        fn controllers_keep_their_gamma(
            n in 1..6_usize,
            sizes in prop::array::uniform4(1..3_usize),
            values in prop::collection::vec(-1.0..1.0_f64, 400),
        ) {
            let [extra_z, extra_w, measurements, controls] = sizes;
            let (outputs, inputs) = (extra_z + controls + measurements, extra_w + measurements + controls);
            let mut next = values.iter().copied().cycle();
            let mut fill = |rows, columns| Matrix::from_fn(rows, columns, |_, _| next.next().unwrap_or(0.0));
            let (a, b, c) = (fill(n, n) * 2.0, fill(n, inputs), fill(outputs, n));
            let mut d = fill(outputs, inputs) * 0.5;
            // Well away from a loss of rank in D_12 and D_21.
            for k in 0..controls {
                d[(extra_z + k, extra_w + measurements + k)] += 2.0;
            }
            for k in 0..measurements {
                d[(extra_z + controls + k, extra_w + k)] += 2.0;
            }
            let plant = GeneralizedPlant { system: StateSpace::new(a, b, c, d).unwrap(), measurements, controls };
            let Ok(synthesis) = Synthesis::new(&plant) else { return Ok(()) };
            // Zeros on the axis are not excluded, and have no optimum.
            let Ok(optimum) = synthesis.optimum(1e-4) else { return Ok(()) };
            let gamma = 1.05 * optimum.gamma;
            let closed = plant.closed(&synthesis.controller(gamma).unwrap()).unwrap();
            prop_assert!(norm_is_below(&closed, gamma).unwrap(), "{:?} against {}", norm(&closed, 1e-4), gamma);
        }
    }
}
