//! Linear time-invariant systems in continuous time: state space, interconnection, frequency response, and the
//! bilinear transform to sampled second-order sections.
//!
//! The bilinear transform `z = (1 + hs)/(1 − hs)`, `h = dt/2`, maps the unit circle onto the imaginary axis, so that a
//! norm or bound proved in `s` holds exactly in `z`, at the frequency `Im s = tan(ω dt/2)/h`.

use nalgebra::{Complex, DMatrix};

use crate::schur::{complex, eigenvalues};

type C64 = Complex<f64>;
type Matrix = DMatrix<f64>;

/// Ratio of imaginary part to magnitude below which a root counts as real.
const REAL_TOLERANCE: f64 = 1e-9;

/// A matrix of blocks; those of a row have one height, those of a column one width.
pub(crate) fn blocks<const R: usize, const C: usize>(grid: [[&Matrix; C]; R]) -> Matrix {
    let rows = grid.iter().map(|row| row[0].nrows()).sum();
    let mut out = Matrix::zeros(rows, grid[0].iter().map(|block| block.ncols()).sum());
    let mut top = 0;
    for row in grid {
        let mut left = 0;
        for block in row {
            out.view_mut((top, left), block.shape()).copy_from(block);
            left += block.ncols();
        }
        top += row[0].nrows();
    }
    out
}

/// Why a system could not be built or converted.
#[expect(missing_docs, reason = "the messages name the fields")]
#[derive(Debug, thiserror::Error)]
pub enum LtiError {
    /// Dimensions of the matrices disagree.
    #[error("state space of A {a:?}, B {b:?}, C {c:?}, D {d:?} (rows, columns): A must be n×n, B n×m, C p×n, D p×m")]
    Shape { a: (usize, usize), b: (usize, usize), c: (usize, usize), d: (usize, usize) },
    /// The algebraic loop of an interconnection is singular.
    #[error("the interconnection has an algebraic loop: I − D_K D_22 is singular; give plant or controller a lag")]
    AlgebraicLoop,
    /// The system has no second-order sections with unit gain at zero frequency.
    #[error("system with gain {gain} at zero frequency cannot be scaled by it; a controller here needs a finite gain")]
    NoStaticGain { gain: f64 },
    /// The eigenvalue iteration failed.
    #[error("the eigenvalues of a {order}×{order} matrix were not found; its entries are not finite or overflow")]
    Eigenvalues { order: usize },
}

/// `ẋ = A x + B u`, `y = C x + D u`.
#[derive(Clone, Debug, PartialEq)]
pub struct StateSpace {
    /// n×n.
    pub a: Matrix,
    /// n×m.
    pub b: Matrix,
    /// p×n.
    pub c: Matrix,
    /// p×m.
    pub d: Matrix,
}

impl StateSpace {
    /// A system of the given matrices.
    ///
    /// # Errors
    /// [`LtiError::Shape`] when they do not fit each other.
    pub fn new(a: Matrix, b: Matrix, c: Matrix, d: Matrix) -> Result<Self, LtiError> {
        let fits = a.is_square()
            && b.nrows() == a.nrows()
            && c.ncols() == a.nrows()
            && d.nrows() == c.nrows()
            && d.ncols() == b.ncols();
        if fits {
            Ok(Self { a, b, c, d })
        } else {
            Err(LtiError::Shape { a: a.shape(), b: b.shape(), c: c.shape(), d: d.shape() })
        }
    }

    /// A gain without states, p×m.
    pub fn gain(d: Matrix) -> Self {
        let (p, m) = d.shape();
        Self { a: Matrix::zeros(0, 0), b: Matrix::zeros(0, m), c: Matrix::zeros(p, 0), d }
    }

    /// Single-input single-output quotient of two polynomials in `s` of one length, highest power first, in
    /// controllable canonical form.
    pub fn quotient(numerator: &[f64], denominator: &[f64]) -> Self {
        let n = denominator.len() - 1;
        let lead = denominator[0];
        let direct = numerator[0] / lead;
        let a = Matrix::from_fn(n, n, |i, j| match i {
            0 => -denominator[j + 1] / lead,
            _ => f64::from(u8::from(i == j + 1)),
        });
        let b = Matrix::from_fn(n, 1, |i, _| f64::from(u8::from(i == 0)));
        let c = Matrix::from_fn(1, n, |_, j| (numerator[j + 1] - direct * denominator[j + 1]) / lead);
        Self { a, b, c, d: Matrix::from_element(1, 1, direct) }
    }

    /// Number of states.
    pub fn order(&self) -> usize {
        self.a.nrows()
    }

    /// `C (sI − A)⁻¹ B + D`, p×m; infinite at a pole.
    pub fn response(&self, s: C64) -> DMatrix<C64> {
        let n = self.order();
        let resolvent = DMatrix::from_diagonal_element(n, n, s) - complex(&self.a);
        match resolvent.lu().solve(&complex(&self.b)) {
            Some(x) => complex(&self.c) * x + complex(&self.d),
            None => self.d.map(|_| C64::from(f64::INFINITY)),
        }
    }

    /// `next · self`: the output of this system drives `next`, whose inputs are as many.
    pub fn then(&self, next: &Self) -> Self {
        let zero = Matrix::zeros(self.order(), next.order());
        Self {
            a: blocks([[&self.a, &zero], [&(&next.b * &self.c), &next.a]]),
            b: blocks([[&self.b], [&(&next.b * &self.d)]]),
            c: blocks([[&(&next.d * &self.c), &next.c]]),
            d: &next.d * &self.d,
        }
    }

    /// `F_l(P, K)` (eq:lower_fractional_transformation): this system's last outputs drive `controller`, whose outputs
    /// are this system's last inputs.
    ///
    /// # Errors
    /// [`LtiError::AlgebraicLoop`] when the loop through both direct terms cannot be solved.
    pub fn lower_fractional(&self, controller: &Self) -> Result<Self, LtiError> {
        let (u, y) = controller.d.shape();
        let (z, w) = (self.c.nrows() - y, self.b.ncols() - u);
        let (b1, b2) = (self.b.columns(0, w), self.b.columns(w, u));
        let (c1, c2) = (self.c.rows(0, z), self.c.rows(z, y));
        let d = |i: usize, j: usize, rows: usize, columns: usize| self.d.view((i, j), (rows, columns)).into_owned();
        let (d11, d12, d21, d22) = (d(0, 0, z, w), d(0, w, z, u), d(z, 0, y, w), d(z, w, y, u));
        // u = (I − D_K D_22)⁻¹ (D_K (C_2 x + D_21 w) + C_K x_K) and y = C_2 x + D_21 w + D_22 u.
        let solved = (Matrix::identity(u, u) - &controller.d * &d22).try_inverse().ok_or(LtiError::AlgebraicLoop)?;
        let u_of_x = &solved * &controller.d * c2;
        let u_of_k = &solved * &controller.c;
        let u_of_w = &solved * &controller.d * &d21;
        let y_of_x = c2 + &d22 * &u_of_x;
        let y_of_k = &d22 * &u_of_k;
        let y_of_w = &d21 + &d22 * &u_of_w;
        Ok(Self {
            a: blocks([
                [&(&self.a + b2 * &u_of_x), &(b2 * &u_of_k)],
                [&(&controller.b * y_of_x), &(&controller.a + &controller.b * y_of_k)],
            ]),
            b: blocks([[&(b1 + b2 * &u_of_w)], [&(&controller.b * y_of_w)]]),
            c: blocks([[&(c1 + &d12 * &u_of_x), &(&d12 * &u_of_k)]]),
            d: d11 + d12 * u_of_w,
        })
    }

    /// Poles, rad/s.
    ///
    /// # Errors
    /// [`LtiError::Eigenvalues`] when they cannot be found.
    pub fn poles(&self) -> Result<Vec<C64>, LtiError> {
        eigenvalues(&self.a).ok_or(LtiError::Eigenvalues { order: self.order() })
    }

    /// The system in `v = 1/s`, whose direct term is the static gain; `None` with a pole at zero.
    fn reciprocal(&self) -> Option<Self> {
        let a = self.a.clone().try_inverse()?;
        let b = -(&a * &self.b);
        Some(Self { d: &self.d + &self.c * &b, c: &self.c * &a, a, b })
    }

    /// Reciprocals of the zeros of a system with one input and one output and static gain; zero for one at infinity.
    fn reciprocal_zeros(&self) -> Option<Vec<C64>> {
        let Self { a, b, c, d } = self.reciprocal()?;
        eigenvalues(&(a - b * c / d[(0, 0)]))
    }

    /// A system with one input and one output as `gain · Π sections(z)`, sampled by the bilinear transform with
    /// `half_step` `h = dt/2` in this system's unit of time.
    ///
    /// Each section `[b0, b1, b2, a1, a2]` has unit gain at zero frequency, so `gain` is the static gain. Conjugate
    /// pairs share a section; poles nearest to the unit circle are paired first, with the zeros nearest to them.
    ///
    /// # Errors
    /// [`LtiError::NoStaticGain`] when the gain at zero frequency is zero or infinite.
    pub fn sections(&self, half_step: f64) -> Result<Sections, LtiError> {
        let gain = self.response(C64::from(0.0))[(0, 0)].re;
        if !gain.is_finite() || gain == 0.0 {
            return Err(LtiError::NoStaticGain { gain });
        }
        let zeros = self.reciprocal_zeros().ok_or(LtiError::NoStaticGain { gain })?;
        let mut poles = pairs(self.poles()?.into_iter().map(|s| Root::sampled(s.inv(), half_step)));
        poles.sort_by(|p, q| radius(q).total_cmp(&radius(p)));
        let mut zeros: Vec<Root> = zeros.into_iter().map(|v| Root::sampled(v, half_step)).collect();
        // A single pole is paired first, which leaves an even number of real zeros.
        poles.sort_by_key(Vec::len);
        let sections = poles.iter().map(|pole| section(&nearest_zeros(&mut zeros, pole), pole)).collect();
        Ok(Sections { gain, sections })
    }

    /// `gain · Π sections(z)` in continuous time, `z = (1 + hs)/(1 − hs)`: the inverse of [`Self::sections`].
    pub fn from_sections(sections: &[[f64; 5]], gain: f64, half_step: f64) -> Self {
        let h = half_step;
        sections.iter().fold(Self::gain(Matrix::from_element(1, 1, gain)), |system, [b0, b1, b2, a1, a2]| {
            let next = if *b2 == 0.0 && *a2 == 0.0 {
                Self::quotient(&[h * (b0 - b1), b0 + b1], &[h * (1.0 - a1), 1.0 + a1])
            } else {
                let quadratic = |c0: f64, c1: f64, c2: f64| [h * h * (c0 - c1 + c2), 2.0 * h * (c0 - c2), c0 + c1 + c2];
                Self::quotient(&quadratic(*b0, *b1, *b2), &quadratic(1.0, *a1, *a2))
            };
            system.then(&next)
        })
    }
}

/// A sampled system as a cascade.
#[derive(Clone, Debug, PartialEq)]
pub struct Sections {
    /// Gain at zero frequency.
    pub gain: f64,
    /// `[b0, b1, b2, a1, a2]` each, of unit gain at zero frequency.
    pub sections: Vec<[f64; 5]>,
}

/// A root of a polynomial in `z`, with `1 − z` computed without cancellation.
#[derive(Clone, Copy, Debug)]
struct Root {
    z: C64,
    /// `1 − z`.
    from_one: C64,
}

impl Root {
    /// From `v = 1/s`: `z = (v + h)/(v − h)`.
    fn sampled(v: C64, h: f64) -> Self {
        Self { z: (v + h) / (v - h), from_one: C64::from(-2.0 * h) / (v - h) }
    }

    fn is_real(&self) -> bool {
        self.from_one.im.abs() <= REAL_TOLERANCE * self.from_one.norm()
    }

    fn conj(self) -> Self {
        Self { z: self.z.conj(), from_one: self.from_one.conj() }
    }

    fn real(self) -> Self {
        Self { z: C64::from(self.z.re), from_one: C64::from(self.from_one.re) }
    }
}

/// Groups roots into conjugate pairs and pairs of real roots, slowest first; at most one root stays single.
fn pairs(roots: impl Iterator<Item = Root>) -> Vec<Vec<Root>> {
    let (mut real, complex): (Vec<Root>, Vec<Root>) = roots.partition(Root::is_real);
    real.sort_by(|a, b| a.from_one.re.total_cmp(&b.from_one.re));
    let conjugates = complex.into_iter().filter(|r| r.z.im > 0.0).map(|r| vec![r, r.conj()]);
    conjugates.chain(real.chunks(2).map(|pair| pair.iter().map(|r| r.real()).collect())).collect()
}

fn radius(roots: &[Root]) -> f64 {
    roots.iter().map(|r| r.z.norm()).fold(0.0, f64::max)
}

/// Removes as many zeros as there are poles, those nearest to them; conjugates stay together.
fn nearest_zeros(zeros: &mut Vec<Root>, poles: &[Root]) -> Vec<Root> {
    let distance = |group: &[Root]| -> f64 { group.iter().zip(poles).map(|(x, y)| (x.z - y.z).norm()).sum() };
    let mut real: Vec<Root> = zeros.iter().filter(|r| r.is_real()).map(|r| r.real()).collect();
    real.sort_by(|a, b| (a.z - poles[0].z).norm().total_cmp(&(b.z - poles[0].z).norm()));
    let alone = (real.len() >= poles.len()).then(|| real[..poles.len()].to_vec());
    let conjugates = zeros.iter().filter(|r| poles.len() == 2 && !r.is_real() && r.z.im > 0.0);
    let candidates = conjugates.map(|r| vec![*r, r.conj()]).chain(alone);
    let best = candidates.min_by(|a, b| distance(a).total_cmp(&distance(b))).unwrap_or_default();
    for taken in &best {
        let gap = |r: &Root| (r.z - taken.z).norm();
        if let Some(i) = (0..zeros.len()).min_by(|i, j| gap(&zeros[*i]).total_cmp(&gap(&zeros[*j]))) {
            zeros.remove(i);
        }
    }
    best
}

/// A section with the given zeros and poles (one or two of each) and unit gain at `z = 1`.
fn section(zeros: &[Root], poles: &[Root]) -> [f64; 5] {
    let polynomial = |roots: &[Root]| match roots {
        [] => [1.0, 0.0, 0.0],
        [r] => [1.0, -r.z.re, 0.0],
        [r, s, ..] => [1.0, -(r.z + s.z).re, (r.z * s.z).re],
    };
    let at_one = |roots: &[Root]| roots.iter().fold(C64::from(1.0), |p, r| p * r.from_one).re;
    let scale = at_one(poles) / at_one(zeros);
    let ([b0, b1, b2], [_, a1, a2]) = (polynomial(zeros), polynomial(poles));
    [scale * b0, scale * b1, scale * b2, a1, a2]
}

/// `Π sections` at a point `z`.
pub fn sections_response(sections: &[[f64; 5]], z: C64) -> C64 {
    sections.iter().fold(C64::from(1.0), |product, [b0, b1, b2, a1, a2]| {
        product * (z * z * *b0 + z * *b1 + *b2) / (z * z + z * *a1 + *a2)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn at(system: &StateSpace, omega: f64) -> C64 {
        system.response(C64::new(0.0, omega))[(0, 0)]
    }

    #[test]
    fn quotient_and_cascade_respond_as_their_polynomials() {
        let first = StateSpace::quotient(&[0.0, 1.0, 3.0], &[2.0, 0.5, 1.0]);
        let second = StateSpace::quotient(&[1.0, 4.0], &[1.0, 0.1]);
        let both = first.then(&second);
        for omega in [1e-3, 0.3, 5.0] {
            let s = C64::new(0.0, omega);
            let want = (s + 3.0) / (s * s * 2.0 + s * 0.5 + 1.0) * (s + 4.0) / (s + 0.1);
            assert!((at(&both, omega) - want).norm() < 1e-12 * want.norm());
        }
    }

    /// `[[W, G], [−W, −G]]` with `K`: the closed loop is `W/(1 + GK)`.
    #[test]
    fn lower_fractional_closes_the_loop() {
        let g = StateSpace::quotient(&[0.5, 1.0, 2.0], &[1.0, 0.2, 0.0]);
        let k = StateSpace::quotient(&[3.0, 1.0], &[1.0, 4.0]);
        let n = g.order();
        let plant = StateSpace::new(
            g.a.clone(),
            Matrix::from_fn(n, 2, |i, j| if j == 1 { g.b[i] } else { 0.0 }),
            Matrix::from_fn(2, n, |i, j| if i == 0 { g.c[j] } else { -g.c[j] }),
            Matrix::from_row_slice(2, 2, &[1.0, 0.5, -1.0, -0.5]),
        )
        .unwrap();
        let closed = plant.lower_fractional(&k).unwrap();
        for omega in [1e-2, 0.7, 9.0] {
            let want = C64::from(1.0) / (at(&g, omega) * at(&k, omega) + 1.0);
            assert!((at(&closed, omega) - want).norm() < 1e-12);
        }
        // K = −2 against D_22 = −0.5: 1 − D_K D_22 = 0.
        let static_gain = StateSpace::gain(Matrix::from_element(1, 1, -2.0));
        assert!(matches!(plant.lower_fractional(&static_gain), Err(LtiError::AlgebraicLoop)));
    }

    #[test]
    fn matrices_must_fit() {
        let error = StateSpace::new(Matrix::zeros(2, 2), Matrix::zeros(3, 1), Matrix::zeros(1, 2), Matrix::zeros(1, 1));
        assert!(matches!(error, Err(LtiError::Shape { b: (3, 1), .. })));
    }

    #[test]
    fn a_system_without_static_gain_has_no_sections() {
        let derivative = StateSpace::quotient(&[1.0, 0.0], &[1.0, 1.0]);
        assert!(matches!(derivative.sections(0.05), Err(LtiError::NoStaticGain { .. })));
        let integrator = StateSpace::quotient(&[0.0, 1.0], &[1.0, 0.0]);
        assert!(matches!(integrator.sections(0.05), Err(LtiError::NoStaticGain { .. })));
    }

    proptest! {
        /// The sections answer at `e^{iωdt}` what the system answers at `i tan(ω dt/2)/h`, and give the system back.
        #[test]
        fn sections_are_the_bilinear_transform(
            poles in prop::collection::vec((0.05..20.0_f64, 0.05..1.5_f64), 1..3),
            lone in 0.001..20.0_f64,
            odd in any::<bool>(),
            zero in 0.05..20.0_f64,
        ) {
            let mut system = StateSpace::quotient(&[0.0, zero], &[1.0, zero]);
            if odd {
                system = system.then(&StateSpace::quotient(&[1.0, 2.0 * zero], &[1.0, lone]));
            }
            // No two factors have their zeros at one place, where a root is known to the square root of rounding alone.
            for (i, (omega, damping)) in poles.into_iter().enumerate() {
                let zero = zero * 4.0_f64.powi(i as i32 + 1);
                let quadratic = |omega: f64| [1.0, 2.0 * damping * omega, omega * omega];
                system = system.then(&StateSpace::quotient(&quadratic(zero), &quadratic(omega)));
            }
            let h = 0.05;
            let cascade = system.sections(h).unwrap();
            let back = StateSpace::from_sections(&cascade.sections, cascade.gain, h);
            prop_assert_eq!(back.order(), system.order());
            let points = [1e-4, 1e-2, 0.3, 4.9].map(|f_hz: f64| std::f64::consts::TAU * f_hz * 2.0 * h);
            let wanted = points.map(|angle| at(&system, (angle / 2.0).tan() / h));
            // Rounding is on the scale of the largest response: near a zero nothing better can be had. How well roots
            // so far apart are conditioned has no bound in closed form; none of 12,000 draws is above this.
            let tolerance = 1e-6 * wanted.iter().map(|w| w.norm()).fold(0.0, f64::max);
            for (angle, want) in points.into_iter().zip(wanted) {
                let sampled = sections_response(&cascade.sections, C64::from_polar(1.0, angle)) * cascade.gain;
                prop_assert!((sampled - want).norm() < tolerance, "{} {} {}", angle, sampled, want);
                let again = at(&back, (angle / 2.0).tan() / h);
                prop_assert!((again - want).norm() < tolerance);
            }
        }
    }
}
