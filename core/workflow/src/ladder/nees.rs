//! Normalised estimation error squared of the solutions of products of a simulation.

use dragfree_archive::product::{Coefficient, Product};
use nalgebra::{Cholesky, DMatrix, DVector};
use serde::Serialize;

/// `eᵀ C⁻¹ e` of the errors of coefficients whose truth is known, per coefficient: 1 on average where C is right.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Nees {
    /// `qp`, `es-akf`, `adopted`
    pub solution: String,
    /// Mean over coefficients and days.
    pub per_dof: f64,
    /// Coefficients times days.
    pub dof: usize,
}

/// Of every solution that comes with a covariance.
pub(super) fn nees<'a>(days: impl Iterator<Item = &'a Product>, truth: &dyn Fn(&str) -> Option<f64>) -> Vec<Nees> {
    let mut all: Vec<(String, f64, usize)> = Vec::new();
    for product in days {
        for (solution, c) in &product.result.covariance {
            let own = |name: &String| {
                let is_it = |k: &&Coefficient| k.solution == *solution && k.name == *name;
                product.result.coefficients.iter().find(is_it)
            };
            let error = |(i, name): (usize, &String)| Some((i, own(name)?.value - truth(name)?));
            let errors: Vec<(usize, f64)> = c.names.iter().enumerate().filter_map(error).collect();
            let e = DVector::from_iterator(errors.len(), errors.iter().map(|(_, e)| *e));
            let matrix = DMatrix::from_fn(e.len(), e.len(), |i, j| c.matrix[errors[i].0][errors[j].0]);
            let Some(factor) = Cholesky::new(matrix).filter(|_| !e.is_empty()) else { continue };
            let squared = e.dot(&factor.solve(&e));
            match all.iter_mut().find(|(known, ..)| known == solution) {
                Some((_, sum, dof)) => (*sum, *dof) = (*sum + squared, *dof + e.len()),
                None => all.push((solution.clone(), squared, e.len())),
            }
        }
    }
    let of = |(solution, sum, dof): (String, f64, usize)| Nees { solution, per_dof: sum / dof as f64, dof };
    all.into_iter().map(of).collect()
}
