//! `min ½ θᵀNθ − cᵀθ` subject to `lower ≤ aᵀθ ≤ upper`: Clarabel, in dimensionless unknowns, checked afterwards.

use clarabel::algebra::CscMatrix;
use clarabel::solver::{DefaultSettings, DefaultSolver, IPSolver, NonnegativeConeT, SolverStatus};
use nalgebra::{DMatrix, DVector};
use serde::Serialize;

/// A row `lower ≤ aᵀθ ≤ upper`; an infinite bound is none.
#[derive(Clone, Debug, Serialize)]
pub struct Row {
    /// What it is called in reports.
    pub name: String,
    /// `a`, one weight per unknown.
    pub terms: Vec<f64>,
    /// Lower bound, the row's unit.
    pub lower: f64,
    /// Upper bound, the row's unit.
    pub upper: f64,
}

impl Row {
    /// Half of the interval's width; infinite when one side is open.
    pub fn half_width(&self) -> f64 {
        0.5 * (self.upper - self.lower)
    }
}

/// A convex quadratic problem.
#[derive(Clone, Debug)]
pub struct Problem {
    /// `N`, symmetric, positive semidefinite.
    pub normal: DMatrix<f64>,
    /// `c`.
    pub right: DVector<f64>,
    /// Constraints.
    pub rows: Vec<Row>,
    /// Natural size of each unknown, above zero: the problem is solved for `u = (θ − origin)/scale`.
    pub scale: DVector<f64>,
    /// Where u = 0 lies; near the solution, so that the objective is small there and its relative gap means something.
    pub origin: DVector<f64>,
}

/// Which bound holds the solution.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Side {
    /// The lower one.
    Lower,
    /// The upper one.
    Upper,
}

/// An active row.
#[derive(Clone, Debug, Serialize)]
pub struct Active {
    /// Index in [`Problem::rows`].
    pub row: usize,
    /// Its name.
    pub name: String,
    /// Which bound.
    pub side: Side,
    /// Lagrange multiplier, 1 per unit of the row: the fall of the objective (half a χ²) per unit by which the bound is
    /// moved.
    pub multiplier: f64,
}

/// Residuals of the Karush–Kuhn–Tucker conditions, dimensionless, recomputed from the solution alone.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct Kkt {
    /// `‖Nθ − c + Σ z a‖∞`, relative to the largest of its terms.
    pub stationarity: f64,
    /// Largest violation of a bound, relative to the row's size over one unit of scale.
    pub primal: f64,
    /// Most negative multiplier, relative to the largest.
    pub dual: f64,
    /// Largest `|z s|`, relative to one and the objective.
    pub complementarity: f64,
}

/// Bounds beyond this many natural sizes hold no solution but one that runs away.
const FAR: f64 = 1e6;

/// Above this a residual makes the solution refused.
pub const KKT_TOLERANCE: f64 = 1e-6;

/// The solution of a problem.
#[derive(Clone, Debug)]
pub struct Solution {
    /// `θ`.
    pub theta: DVector<f64>,
    /// Rows that hold it.
    pub active: Vec<Active>,
    /// How exactly the conditions of optimality hold.
    pub kkt: Kkt,
    /// Iterations of the solver.
    pub iterations: u32,
}

/// Why there is no solution. The text holds the whole problem.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the messages name the fields")]
pub enum QpError {
    /// A number that is none, or bounds that exclude each other.
    #[error(
        "the quadratic problem is not well posed: {reason}; check the ranges and the survey of the model; the problem was {problem}"
    )]
    IllPosed { reason: String, problem: String },
    /// The solver refused to set it up.
    #[error("the solver did not accept the quadratic problem: {reason}; the problem was {problem}")]
    Refused { reason: String, problem: String },
    /// The solver ended with anything but a solution.
    #[error(
        "the solver ended with {status}, not with a solution: do the survey and the ranges contradict each other? The problem was {problem}"
    )]
    Unsolved { status: String, problem: String },
    /// The solution fails our own check.
    #[error(
        "the solver's solution fails the conditions of optimality ({kkt:?}, tolerance {KKT_TOLERANCE:e}); the problem was {problem}"
    )]
    Inexact { kkt: Kkt, problem: String },
}

impl Problem {
    /// Solves the problem.
    ///
    /// # Errors
    /// [`QpError`] when the solver ends without a solution, or our residuals exceed [`KKT_TOLERANCE`].
    pub fn solve(&self) -> Result<Solution, QpError> {
        self.check()?;
        // Dimensionless: P = D N D, q = D (N origin − c), rows of unit size in u.
        let d = DMatrix::from_diagonal(&self.scale);
        let p = &d * &self.normal * &d;
        let q = &d * (&self.normal * &self.origin - &self.right);
        let all = self.one_sided(&d);
        // Bounds that are far away cost the solver its digits. The solution without them is that with them where it
        // satisfies them.
        let near: Vec<&OneSided> = all.iter().filter(|r| r.b.abs() < FAR).collect();
        if near.len() < all.len()
            && let Ok(solution) = self.solve_with(&near, &d, &p, &q)
        {
            let u = (&solution.theta - &self.origin).component_div(&self.scale);
            if all.iter().all(|r| r.b.abs() < FAR || r.slack(&u) >= 0.0) {
                return Ok(solution);
            }
        }
        self.solve_with(&all.iter().collect::<Vec<_>>(), &d, &p, &q)
    }

    /// Solves it with some of its rows.
    fn solve_with(
        &self,
        one_sided: &[&OneSided],
        d: &DMatrix<f64>,
        p: &DMatrix<f64>,
        q: &DVector<f64>,
    ) -> Result<Solution, QpError> {
        let n = self.normal.nrows();
        let upper: Vec<Vec<f64>> =
            (0..n).map(|i| (0..n).map(|j| if i <= j { p[(i, j)] } else { 0.0 }).collect()).collect();
        let a: Vec<Vec<f64>> = one_sided.iter().map(|r| r.a.iter().copied().collect()).collect();
        let b: Vec<f64> = one_sided.iter().map(|r| r.b).collect();
        let a = if a.is_empty() { CscMatrix::zeros((0, n)) } else { CscMatrix::from(&a) };
        let settings = DefaultSettings::<f64> {
            verbose: false,
            max_threads: 1,
            tol_gap_abs: 1e-9,
            tol_gap_rel: 1e-9,
            tol_feas: 1e-9,
            ..DefaultSettings::default()
        };
        let cones = [NonnegativeConeT(b.len())];
        let mut solver = DefaultSolver::new(&CscMatrix::from(&upper), q.as_slice(), &a, &b, &cones, settings)
            .map_err(|e| QpError::Refused { reason: e.to_string(), problem: self.dump() })?;
        solver.solve();
        // A solver that stops a little before its own tolerance has a solution too if the conditions below hold.
        let near = [SolverStatus::Solved, SolverStatus::AlmostSolved, SolverStatus::InsufficientProgress];
        if !near.contains(&solver.solution.status) {
            return Err(QpError::Unsolved { status: solver.solution.status.to_string(), problem: self.dump() });
        }
        let u = DVector::from_column_slice(&solver.solution.x);
        let z = &solver.solution.z;

        let kkt = residuals(p, q, one_sided, &u, z);
        if [kkt.stationarity, kkt.primal, kkt.dual, kkt.complementarity]
            .iter()
            .any(|r| r.is_nan() || *r > KKT_TOLERANCE)
        {
            return Err(QpError::Inexact { kkt, problem: self.dump() });
        }
        // An interior-point solution has s > 0 and z > 0 everywhere; the smaller of the two tells the active rows.
        let active = one_sided
            .iter()
            .zip(z)
            .filter(|(r, z)| **z > r.slack(&u))
            .map(|(r, z)| Active {
                row: r.row,
                name: self.rows[r.row].name.clone(),
                side: r.side,
                multiplier: z / r.size,
            })
            .collect();
        Ok(Solution { theta: &self.origin + d * u, active, kkt, iterations: solver.solution.iterations })
    }

    /// Rows `a u ≤ b` with ‖a‖ = 1.
    fn one_sided(&self, d: &DMatrix<f64>) -> Vec<OneSided> {
        let mut all = Vec::new();
        for (row, r) in self.rows.iter().enumerate() {
            let terms = DVector::from_column_slice(&r.terms);
            let at_origin = terms.dot(&self.origin);
            let a = d * terms;
            let size = a.norm();
            if size == 0.0 {
                continue;
            }
            let mut push = |side, sign: f64, bound: f64| {
                if bound.is_finite() {
                    all.push(OneSided { row, side, size, a: &a * (sign / size), b: sign * (bound - at_origin) / size });
                }
            };
            push(Side::Upper, 1.0, r.upper);
            push(Side::Lower, -1.0, r.lower);
        }
        all
    }

    fn check(&self) -> Result<(), QpError> {
        let fail = |reason: String| Err(QpError::IllPosed { reason, problem: self.dump() });
        let numbers = self.normal.iter().chain(&self.right).chain(&self.origin).chain(&self.scale);
        if !numbers.clone().all(|x| x.is_finite()) {
            return fail("a value is not finite".into());
        }
        if self.scale.iter().any(|s| *s <= 0.0) {
            return fail("a scale is not above zero".into());
        }
        for r in &self.rows {
            if r.lower.is_nan() || r.upper.is_nan() || r.lower > r.upper || !r.terms.iter().all(|t| t.is_finite()) {
                return fail(format!("constraint `{}` allows [{}, {}]", r.name, r.lower, r.upper));
            }
        }
        Ok(())
    }

    /// The problem as one line of JSON; infinite bounds appear as null.
    pub fn dump(&self) -> String {
        let matrix: Vec<Vec<f64>> = self.normal.row_iter().map(|r| r.iter().copied().collect()).collect();
        serde_json::json!({
            "N": matrix, "c": self.right.as_slice(), "rows": self.rows,
            "scale": self.scale.as_slice(), "origin": self.origin.as_slice(),
        })
        .to_string()
    }
}

/// `a u ≤ b`
struct OneSided {
    row: usize,
    side: Side,
    /// Size of the row's `a` before it was divided out: row units per dimensionless unit.
    size: f64,
    a: DVector<f64>,
    b: f64,
}

impl OneSided {
    fn slack(&self, u: &DVector<f64>) -> f64 {
        self.b - self.a.dot(u)
    }
}

fn residuals(p: &DMatrix<f64>, q: &DVector<f64>, rows: &[&OneSided], u: &DVector<f64>, z: &[f64]) -> Kkt {
    let pu = p * u;
    let mut pull = DVector::zeros(u.len());
    let mut kkt = Kkt::default();
    let largest = z.iter().fold(1.0f64, |m, z| m.max(z.abs()));
    let objective = 1.0f64.max((0.5 * u.dot(&pu) + q.dot(u)).abs());
    for (r, z) in rows.iter().zip(z) {
        pull += &r.a * *z;
        let slack = r.slack(u);
        kkt.primal = kkt.primal.max(-slack / r.b.abs().max(1.0));
        kkt.dual = kkt.dual.max(-z / largest);
        kkt.complementarity = kkt.complementarity.max((z * slack).abs() / objective);
    }
    let size = pu.amax().max(q.amax()).max(pull.amax()).max(1.0);
    kkt.stationarity = (pu + q + pull).amax() / size;
    kkt
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn plain(normal: DMatrix<f64>, right: DVector<f64>, rows: Vec<Row>) -> Problem {
        let n = right.len();
        Problem { normal, right, rows, scale: DVector::repeat(n, 1.0), origin: DVector::zeros(n) }
    }

    /// An independent solver: every choice of active bounds, solved as equalities by LU; the feasible one of least
    /// objective.
    fn enumerate(problem: &Problem) -> Option<DVector<f64>> {
        let (n, m) = (problem.right.len(), problem.rows.len());
        let mut best: Option<(f64, DVector<f64>)> = None;
        for code in 0..3usize.pow(m as u32) {
            let held: Vec<(usize, f64)> = (0..m)
                .filter_map(|i| match code / 3usize.pow(i as u32) % 3 {
                    0 => None,
                    1 => Some((i, problem.rows[i].lower)),
                    _ => Some((i, problem.rows[i].upper)),
                })
                .collect();
            if held.len() > n || held.iter().any(|(_, b)| !b.is_finite()) {
                continue;
            }
            let k = n + held.len();
            let mut system = DMatrix::zeros(k, k);
            let mut side = DVector::zeros(k);
            system.view_mut((0, 0), (n, n)).copy_from(&problem.normal);
            side.rows_mut(0, n).copy_from(&problem.right);
            for (j, (i, bound)) in held.iter().enumerate() {
                for l in 0..n {
                    system[(n + j, l)] = problem.rows[*i].terms[l];
                    system[(l, n + j)] = problem.rows[*i].terms[l];
                }
                side[n + j] = *bound;
            }
            let Some(x) = system.lu().solve(&side) else { continue };
            let theta = x.rows(0, n).clone_owned();
            let feasible = problem.rows.iter().all(|r| {
                let v: f64 = r.terms.iter().zip(&theta).map(|(a, t)| a * t).sum();
                v >= r.lower - 1e-9 && v <= r.upper + 1e-9
            });
            let value = 0.5 * theta.dot(&(&problem.normal * &theta)) - problem.right.dot(&theta);
            if feasible && best.as_ref().is_none_or(|(b, _)| value < *b) {
                best = Some((value, theta));
            }
        }
        best.map(|(_, theta)| theta)
    }

    /// Fourteen unknowns, three of them with ranges of 3e14 natural sizes, with which the solver by itself makes no
    /// progress and is 0.6 off. No bound holds, so the solution is that of the linear system.
    #[test]
    fn far_bounds_cost_no_digits() {
        let n = 14;
        let normal =
            DMatrix::from_fn(n, n, |i, j| if i == j { 1.0 } else { 0.3 * (1.0 + (i + j) as f64).sin() / n as f64 });
        let normal = (&normal + normal.transpose()) * 0.5;
        let right = DVector::from_fn(n, |i, _| (i as f64).cos());
        let range = |i: usize| if i < 11 { 20.0 } else { 3e14 };
        let rows = (0..n).map(|i| {
            let terms = (0..n).map(|j| f64::from(u8::from(i == j))).collect();
            Row { name: format!("range {i}"), terms, lower: -range(i), upper: range(i) }
        });
        let problem = plain(normal.clone(), right.clone(), rows.collect());
        let expected = normal.cholesky().expect("positive definite").solve(&right);
        let solution = problem.solve().expect("a solution");
        assert!((&solution.theta - &expected).amax() < 1e-7, "{} {expected}", solution.theta);
        assert!(solution.active.is_empty());
    }

    /// A bound that is far away and holds the solution all the same is obeyed.
    #[test]
    fn a_far_bound_that_holds_is_obeyed() {
        let row = Row { name: "far".to_owned(), terms: vec![1.0], lower: f64::NEG_INFINITY, upper: 2e6 };
        let problem = plain(DMatrix::from_element(1, 1, 1.0), DVector::from_element(1, 5e6), vec![row]);
        let solution = problem.solve().expect("a solution");
        assert!((solution.theta[0] - 2e6).abs() < 1.0, "{}", solution.theta[0]);
        assert_eq!(solution.active.len(), 1);
    }

    proptest! {
        #![proptest_config(ProptestConfig { cases: 200, failure_persistence: None, ..ProptestConfig::default() })]
        #[test]
        fn agrees_with_an_enumeration_of_all_active_sets(
            factor in prop::collection::vec(-1.0f64..1.0, 9), right in prop::collection::vec(-5.0f64..5.0, 3),
            terms in prop::collection::vec(-1.0f64..1.0, 12), middle in prop::collection::vec(-0.5f64..0.5, 4),
            width in prop::collection::vec(0.01f64..3.0, 4), open in 0usize..4, scale in prop::collection::vec(0.1f64..10.0, 3),
        ) {
            let f = DMatrix::from_row_slice(3, 3, &factor);
            let normal = &f * f.transpose() + DMatrix::identity(3, 3) * 0.05;
            let rows: Vec<Row> = (0..4).map(|i| Row {
                name: format!("row {i}"), terms: terms[3 * i..3 * i + 3].to_vec(),
                lower: if i == open { f64::NEG_INFINITY } else { middle[i] - width[i] }, upper: middle[i] + width[i],
            }).collect();
            let mut problem = plain(normal, DVector::from_vec(right), rows);
            problem.scale = DVector::from_vec(scale);
            problem.origin = DVector::from_vec(vec![0.3, -0.2, 0.1]);
            match (problem.solve(), enumerate(&problem)) {
                // In the metric of N, which is distance in σ: a gap of 1e-9 of the objective and violations of 1e-9
                // under multipliers of a hundred allow ½ δᵀNδ of 1e-7, since the gradient at the optimum points inward.
                (Ok(got), Some(want)) => {
                    let apart = &got.theta - &want;
                    let objective = 0.5 * want.dot(&(&problem.normal * &want)) - problem.right.dot(&want);
                    prop_assert!(
                        apart.dot(&(&problem.normal * &apart)) < 1e-6 * (1.0 + objective.abs()), "{} against {want}", got.theta
                    );
                }
                (Err(QpError::Unsolved { .. }), None) => {}
                (got, want) => prop_assert!(false, "{got:?} against {want:?}"),
            }
        }
    }

    /// In one dimension: N = 2, c = 10, θ ≤ 3, so θ = 3 and the multiplier is c − Nθ = 4 per unit of the row.
    #[test]
    fn multipliers_are_in_the_units_of_the_row() {
        let row = Row { name: "box".into(), terms: vec![1e-3], lower: -1.0, upper: 3e-3 };
        let mut problem = plain(DMatrix::repeat(1, 1, 2.0), DVector::repeat(1, 10.0), vec![row]);
        problem.scale = DVector::repeat(1, 0.02);
        let s = problem.solve().expect("solved");
        assert!((s.theta[0] - 3.0).abs() < 1e-7);
        assert_eq!((s.active.len(), s.active[0].side), (1, Side::Upper));
        assert!((s.active[0].multiplier - 4e3).abs() < 1e-2);
    }

    #[test]
    fn a_contradiction_is_an_error_that_holds_the_problem() {
        let row = |lower, upper| Row { name: "survey".into(), terms: vec![1.0], lower, upper };
        let problem = plain(DMatrix::repeat(1, 1, 1.0), DVector::repeat(1, 0.0), vec![row(1.0, 2.0), row(3.0, 4.0)]);
        let text = problem.solve().expect_err("no point satisfies both").to_string();
        assert!(text.contains("\"N\":[[1.0]]") && text.contains("survey"), "{text}");
        let crossed = plain(DMatrix::repeat(1, 1, 1.0), DVector::repeat(1, 0.0), vec![row(2.0, 1.0)]);
        assert!(matches!(crossed.solve(), Err(QpError::IllPosed { .. })));
    }

    #[test]
    fn without_constraints_it_is_least_squares() {
        let s = plain(DMatrix::repeat(1, 1, 4.0), DVector::repeat(1, 2.0), vec![]).solve().expect("solved");
        assert!((s.theta[0] - 0.5).abs() < 1e-9 && s.active.is_empty());
    }
}
