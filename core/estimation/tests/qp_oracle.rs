//! The constrained solution against another program: sixty problems solved by quadprog (a dual active-set method),
//! committed with the script that makes them, `oracles/qp_oracle.py`.

use dragfree_estimation::qp::{Problem, QpError, Row, Side};
use nalgebra::{DMatrix, DVector};
use serde::Deserialize;

#[derive(Deserialize)]
struct Oracle {
    problems: Vec<Case>,
}

#[derive(Deserialize)]
struct Case {
    kind: String,
    normal: Vec<Vec<f64>>,
    right: Vec<f64>,
    rows: Vec<Bounds>,
    /// None where no point satisfies all rows.
    theta: Option<Vec<f64>>,
    /// Positive at the upper bound, negative at the lower.
    multipliers: Option<Vec<f64>>,
}

#[derive(Deserialize)]
struct Bounds {
    terms: Vec<f64>,
    lower: f64,
    upper: f64,
}

impl Case {
    fn problem(&self) -> Problem {
        let n = self.right.len();
        let normal = DMatrix::from_fn(n, n, |i, j| self.normal[i][j]);
        let rows = self.rows.iter().enumerate().map(|(i, r)| Row {
            name: format!("row {i}"),
            terms: r.terms.clone(),
            lower: r.lower,
            upper: r.upper,
        });
        let right = DVector::from_column_slice(&self.right);
        Problem {
            scale: normal.diagonal().map(|x| x.sqrt().recip()),
            // The solution without constraints, as a caller would start.
            origin: normal.clone().cholesky().expect("positive definite").solve(&right),
            rows: rows.collect(),
            normal,
            right,
        }
    }
}

#[test]
fn solutions_and_multipliers_are_those_of_an_active_set_method() {
    let oracle: Oracle = serde_json::from_str(include_str!("oracles/qp_oracle.json")).expect("the oracle's file");
    let (mut solved, mut held) = (0, 0);
    for (k, case) in oracle.problems.iter().enumerate() {
        let problem = case.problem();
        let (Some(theta), Some(multipliers)) = (&case.theta, &case.multipliers) else {
            assert!(matches!(problem.solve(), Err(QpError::Unsolved { .. })), "problem {k} has no solution");
            continue;
        };
        let ours = problem.solve().unwrap_or_else(|e| panic!("problem {k} ({}): {e}", case.kind));
        solved += 1;
        // Distance in σ: both solve to 1e-9 of the objective, and ½ δᵀNδ is at most what the objectives differ by.
        let apart = &ours.theta - DVector::from_column_slice(theta);
        let objective = 0.5 * ours.theta.dot(&(&problem.normal * &ours.theta)) - problem.right.dot(&ours.theta);
        let at_origin =
            0.5 * problem.origin.dot(&(&problem.normal * &problem.origin)) - problem.right.dot(&problem.origin);
        let bound = 1e-7 * (1.0 + (objective - at_origin).abs());
        let distance = apart.dot(&(&problem.normal * &apart));
        assert!(distance < bound, "problem {k} ({}): {distance:e} against {bound:e}", case.kind);
        let largest = multipliers.iter().fold(0.0, |m: f64, z| m.max(z.abs()));
        for (row, theirs) in multipliers.iter().enumerate() {
            let of =
                |side| ours.active.iter().filter(|a| a.row == row && a.side == side).map(|a| a.multiplier).sum::<f64>();
            let mine = of(Side::Upper) - of(Side::Lower);
            assert!((mine - theirs).abs() < 1e-4 * largest.max(1.0), "problem {k}, row {row}: {mine} against {theirs}");
            held += usize::from(theirs.abs() > 1e-6);
        }
    }
    assert!(solved > 50 && held > 100, "{solved} problems, {held} rows hold them");
}
