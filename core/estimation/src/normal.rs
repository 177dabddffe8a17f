//! Normal equations over segments, for any Σ: `N = Σ Re Φᴴ Σ⁻¹ Φ`, `c = Σ Re Φᴴ Σ⁻¹ z` (§6 of the design).

use nalgebra::{DMatrix, DVector};
use serde::Serialize;

use crate::spectra::{Layout, Spectra, triangle};

/// What any model's solution needs of the data. They add up over segments and days of the same Σ.
#[derive(Clone, Debug, Serialize)]
pub struct NormalEquations {
    /// Coefficients, in the order of rows and columns.
    pub names: Vec<String>,
    /// `N`, rows: the information, so that the covariance of `N⁻¹c` is `N⁻¹`.
    pub normal: Vec<Vec<f64>>,
    /// `c`.
    pub right: Vec<f64>,
    /// `Σ zᴴ Σ⁻¹ z`.
    pub zz: f64,
    /// Segments.
    pub segments: u64,
}

/// A symmetric matrix per band, seen through a packed lower triangle.
pub(crate) struct Packed<'a>(pub(crate) &'a [f64]);

impl Packed<'_> {
    pub(crate) fn at(&self, i: usize, j: usize) -> f64 {
        let (i, j) = if i >= j { (i, j) } else { (j, i) };
        self.0[triangle(i) + j]
    }
}

/// `N`, `c` and `zᴴΣ⁻¹z`.
#[derive(Clone, Debug)]
pub(crate) struct Equations {
    pub(crate) normal: DMatrix<f64>,
    pub(crate) right: DVector<f64>,
    pub(crate) zz: f64,
}

/// The equations of some segments, with one `Σ⁻¹` and one weight per band.
pub(crate) fn accumulate(spectra: &Spectra, layout: &Layout, inverses: &[DMatrix<f64>], weights: &[f64]) -> Equations {
    let (channels, columns, coefficients) = (layout.channels.len(), layout.columns(), layout.coefficients.len());
    let mut normal = DMatrix::zeros(coefficients, coefficients);
    let mut right = DVector::zeros(coefficients);
    let mut zz = 0.0;
    for (b, (inverse, weight)) in inverses.iter().zip(weights).enumerate() {
        let g = Packed(spectra.band(b, columns));
        let inverse = inverse * *weight;
        for i in 0..channels {
            for j in 0..channels {
                zz += inverse[(i, j)] * g.at(i, j);
            }
        }
        for r in &layout.regressors {
            for j in 0..channels {
                right[r.coefficient] += r.factor * inverse[(r.channel, j)] * g.at(channels + r.series, j);
            }
            for s in &layout.regressors {
                normal[(r.coefficient, s.coefficient)] += r.factor
                    * s.factor
                    * inverse[(r.channel, s.channel)]
                    * g.at(channels + r.series, channels + s.series);
            }
        }
    }
    Equations { normal: 0.5 * (&normal + normal.transpose()), right, zz }
}

/// Summed cross-spectra of the residuals `z − Φθ`, channels × channels, per band; products of coefficients at their
/// values.
pub fn residual_spectra(spectra: &Spectra, layout: &Layout, theta: &DVector<f64>) -> Vec<DMatrix<f64>> {
    residuals(spectra, &layout.linear_at(theta.as_slice()), spectra.expected.len(), theta)
}

/// Cross-spectra of the residuals `z − Φθ` in every band.
pub(crate) fn residuals(spectra: &Spectra, layout: &Layout, bands: usize, theta: &DVector<f64>) -> Vec<DMatrix<f64>> {
    let (channels, columns) = (layout.channels.len(), layout.columns());
    // Residuals as combinations of columns: channel, column, weight.
    let mut terms: Vec<(usize, usize, f64)> = (0..channels).map(|c| (c, c, 1.0)).collect();
    terms.extend(layout.regressors.iter().map(|r| (r.channel, channels + r.series, -r.factor * theta[r.coefficient])));
    (0..bands)
        .map(|b| {
            let g = Packed(spectra.band(b, columns));
            let mut out = DMatrix::zeros(channels, channels);
            for (c, i, a) in &terms {
                for (d, j, b) in &terms {
                    out[(*c, *d)] += a * b * g.at(*i, *j);
                }
            }
            0.5 * (&out + out.transpose())
        })
        .collect()
}

impl NormalEquations {
    pub(crate) fn new(names: Vec<String>, Equations { normal, right, zz }: &Equations, segments: u64) -> Self {
        Self {
            names,
            normal: normal.row_iter().map(|r| r.iter().copied().collect()).collect(),
            right: right.iter().copied().collect(),
            zz: *zz,
            segments,
        }
    }
}
