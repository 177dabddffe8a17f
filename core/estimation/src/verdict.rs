//! What the solution is worth: directions that the data do not see, and whether two methods agree.

use dragfree_schema::Settings;
use nalgebra::{DMatrix, DVector, SymmetricEigen};
use serde::Serialize;

/// A combination of coefficients that data and survey leave open, in words.
#[derive(Clone, Debug, PartialEq)]
pub struct Direction {
    /// The sentence for the report.
    pub sentence: String,
    /// σ along it, in natural sizes of the coefficients (half ranges); infinite when nothing depends on it.
    pub sigma_in_sizes: f64,
}

impl Direction {
    /// A coefficient on which nothing measured depends.
    pub fn unseen(name: &str) -> Self {
        Self { sentence: format!("{name} is not seen: nothing measured depends on it"), sigma_in_sizes: f64::INFINITY }
    }
}

/// Coefficients that share less than this part of the leading one's motion are not named.
const NAMED: f64 = 0.05;

/// Eigen-directions of the information, scaled by `size`, whose σ exceeds `from`
/// ([`Settings::weak_direction`]); `names` with units.
pub fn weak_directions(
    information: &DMatrix<f64>,
    size: &DVector<f64>,
    names: &[(&str, &str)],
    from: f64,
) -> Vec<Direction> {
    if names.is_empty() {
        return Vec::new();
    }
    let d = DMatrix::from_diagonal(size);
    let eigen = SymmetricEigen::new(&d * information * &d);
    let mut found: Vec<(f64, usize)> = eigen
        .eigenvalues
        .iter()
        .enumerate()
        .map(|(k, e)| (e.max(0.0).sqrt().recip(), k))
        .filter(|(s, _)| *s > from)
        .collect();
    found.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
    found
        .into_iter()
        .map(|(sigma, k)| describe(sigma, &eigen.eigenvectors.column(k).clone_owned(), size, names))
        .collect()
}

fn describe(sigma: f64, vector: &DVector<f64>, size: &DVector<f64>, names: &[(&str, &str)]) -> Direction {
    let lead = vector.icamax();
    let motion = |i: usize| vector[i] * size[i] / (vector[lead] * size[lead]);
    let (name, unit) = names[lead];
    let mut combination = name.to_owned();
    for i in (0..vector.len()).filter(|i| *i != lead && (vector[*i] / vector[lead]).abs() >= NAMED) {
        let m = motion(i);
        combination += &format!(" {} {:.2} {}", if m < 0.0 { '−' } else { '+' }, m.abs(), names[i].0);
    }
    // σ of the leading coefficient's motion along the direction.
    let spread = sigma * (vector[lead] * size[lead]).abs();
    let spread = if spread.is_finite() { format!("σ {spread:.2e} {unit}") } else { "σ unbounded".to_owned() };
    Direction {
        sentence: format!("{combination} is not seen: {spread} against a range of ±{:.2e} {unit}", size[lead]),
        sigma_in_sizes: sigma,
    }
}

/// A value with its σ.
#[derive(Clone, Debug, PartialEq)]
pub struct Value {
    /// Coefficient.
    pub name: String,
    /// Value.
    pub value: f64,
    /// σ.
    pub sigma: f64,
}

/// Two solutions of one coefficient.
#[derive(Clone, Debug, PartialEq)]
pub struct Difference {
    /// Coefficient.
    pub name: String,
    /// First minus second.
    pub difference: f64,
    /// `sqrt(σ₁² + σ₂²)`.
    pub sigma: f64,
}

impl Difference {
    /// Size in σ.
    pub fn sigmas(&self) -> f64 {
        self.difference.abs() / self.sigma
    }
}

/// Coefficient by coefficient, `qp − other`.
///
/// Both come from the same data. If the QP were efficient and the other not, the variance of the difference would be
/// `σ_other² − σ_qp²` (Hausman), but that is zero or negative as soon as one σ is a little off. The sum of the
/// variances holds whatever their correlation, as long as it is not negative, and errs on the quiet side.
pub fn differences(qp: &[Value], other: &[Value]) -> Vec<Difference> {
    qp.iter()
        .filter_map(|q| {
            let o = other.iter().find(|o| o.name == q.name)?;
            Some(Difference { name: q.name.clone(), difference: q.value - o.value, sigma: q.sigma.hypot(o.sigma) })
        })
        .collect()
}

/// A survey or a physical range against the data.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Pull {
    /// Name of the row.
    pub constraint: String,
    /// Unit of the row.
    pub unit: String,
    /// By how much the data alone lie beyond the interval, or from its middle for a survey; signed, the row's unit.
    pub distance: f64,
    /// Its standard deviation, the survey's tolerance included.
    pub sigma: f64,
    /// Half a χ² per unit by which the bound is moved, zero where the row does not hold the solution.
    pub multiplier: f64,
    /// Whether it is a survey.
    pub survey: bool,
}

impl Pull {
    /// Size in σ.
    pub fn sigmas(&self) -> f64 {
        self.distance.abs() / self.sigma
    }
}

/// Bounds of χ²/dof at [`Settings::chi2_sigmas`], widened by what a Σ in bands cannot follow.
pub fn chi2_bounds(settings: &Settings, dof: f64) -> (f64, f64) {
    let Settings { chi2_sigmas, chi2_tolerance, .. } = *settings;
    (chi2_per_dof_at(dof, -chi2_sigmas) - chi2_tolerance, chi2_per_dof_at(dof, chi2_sigmas) + chi2_tolerance)
}

/// The χ²/dof that corresponds to a normal quantile, by Wilson and Hilferty.
pub fn chi2_per_dof_at(dof: f64, quantile: f64) -> f64 {
    let v = 2.0 / (9.0 * dof);
    (1.0 - v + quantile * v.sqrt()).max(0.0).powi(3)
}

/// The normal quantile that corresponds to a χ²/dof, the inverse of [`chi2_per_dof_at`].
pub fn chi2_quantile(chi2_per_dof: f64, dof: f64) -> f64 {
    let v = 2.0 / (9.0 * dof);
    (chi2_per_dof.cbrt() - 1.0 + v) / v.sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two coefficients of which only the sum is measured, to 1 mm, in ranges of ±2 cm.
    #[test]
    fn an_unseen_difference_is_named() {
        let a = DVector::from_vec(vec![1.0, 1.0]);
        let information = &a * a.transpose() * 1e6 + DMatrix::identity(2, 2) * (0.5f64 / 9.0);
        let weak = weak_directions(&information, &DVector::repeat(2, 0.02), &[("b.x", "m"), ("b.y", "m")], 1.0 / 3.0);
        assert_eq!(weak.len(), 1);
        // Along (1, −1)/√2 the information is 0.5/9: σ is 3√2 m along the unit vector, 3 m in each coefficient.
        let sentence = &weak[0].sentence;
        assert!(sentence.contains("σ 3.00e0 m against a range of ±2.00e-2 m"), "{sentence}");
        assert!(sentence.starts_with("b.x − 1.00 b.y") || sentence.starts_with("b.y − 1.00 b.x"), "{sentence}");
    }

    #[test]
    fn a_well_measured_coefficient_is_not_weak() {
        let information = DMatrix::repeat(1, 1, 1e6);
        assert!(weak_directions(&information, &DVector::repeat(1, 0.02), &[("b", "m")], 1.0 / 3.0).is_empty());
        // 1 mm of σ in a range of ±2 mm is.
        assert_eq!(weak_directions(&information, &DVector::repeat(1, 0.002), &[("b", "m")], 1.0 / 3.0).len(), 1);
    }

    #[test]
    fn differences_are_in_combined_sigmas() {
        let value = |name: &str, value, sigma| Value { name: name.into(), value, sigma };
        let d = differences(&[value("a", 1.0, 3.0), value("b", 0.0, 1.0)], &[value("a", 21.0, 4.0)]);
        assert_eq!((d.len(), d[0].sigmas()), (1, 4.0));
    }

    /// Table values of χ²: for 10 degrees of freedom P(χ² > 41.3) = 1e-5, P(χ² < 0.889) = 1e-4.
    #[test]
    fn bounds_of_chi2_are_those_of_the_tables() {
        let settings = Settings::default();
        let (low, high) = chi2_bounds(&settings, 10.0);
        assert!((high - settings.chi2_tolerance - 4.3).abs() < 0.1, "{high}");
        assert!(low < 0.0889);
        let (low, high) = chi2_bounds(&settings, 1e6);
        assert!((low - 0.983_75).abs() < 2e-5 && (high - 1.016_25).abs() < 2e-5, "{low} {high}");
    }
}
