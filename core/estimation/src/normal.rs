//! Normal equations over segments, for any Σ: `N = Σ Re Φᴴ Σ⁻¹ Φ`, `c = Σ Re Φᴴ Σ⁻¹ z` (§6 of the design).

use nalgebra::{DMatrix, DVector};
use serde::Serialize;

use crate::spectra::{Layout, Plan, Sums, triangle};

/// What any model's solution needs of the data. They add up over segments and days of the same Σ.
#[derive(Clone, Debug, Serialize)]
pub struct NormalEquations {
    /// Coefficients, in the order of rows and columns.
    pub names: Vec<String>,
    /// `N`, rows; the information if every sample had weight one, times its weight `g`.
    pub normal: Vec<Vec<f64>>,
    /// `c`.
    pub right: Vec<f64>,
    /// `Σ zᴴ Σ⁻¹ z`.
    pub zz: f64,
    /// `Σ_t g`, `g` the summed squared windows.
    pub sum_g: f64,
    /// `Σ_t g²`: the covariance of `N⁻¹c` is `N⁻¹ Σg²/Σg`.
    pub sum_g2: f64,
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

/// `N`, `c` and `zᴴΣ⁻¹z` from the sums, with one inverse per band of Σ in units of the modelled amplitudes.
pub(crate) fn accumulate(sums: &Sums, layout: &Layout, inverses: &[DMatrix<f64>]) -> (DMatrix<f64>, DVector<f64>, f64) {
    let (channels, columns) = (layout.channels.len(), layout.columns());
    let mut normal = DMatrix::zeros(layout.coefficients, layout.coefficients);
    let mut right = DVector::zeros(layout.coefficients);
    let mut zz = 0.0;
    for (b, inverse) in inverses.iter().enumerate() {
        let g = Packed(sums.band(b, columns));
        for i in 0..channels {
            for j in 0..channels {
                zz += inverse[(i, j)] * g.at(i, j);
            }
        }
        for (i, r) in layout.regressors.iter().enumerate() {
            for j in 0..channels {
                right[r.coefficient] += inverse[(r.channel, j)] * g.at(channels + i, j);
            }
            for (j, s) in layout.regressors.iter().enumerate() {
                normal[(r.coefficient, s.coefficient)] +=
                    inverse[(r.channel, s.channel)] * g.at(channels + i, channels + j);
            }
        }
    }
    let symmetric = 0.5 * (&normal + normal.transpose());
    (symmetric, right, zz)
}

/// Cross-spectra of the residuals `z − Φθ` in every band, in units of the modelled amplitudes.
pub(crate) fn residuals(sums: &Sums, layout: &Layout, bands: usize, theta: &DVector<f64>) -> Vec<DMatrix<f64>> {
    let (channels, columns) = (layout.channels.len(), layout.columns());
    let weight: Vec<f64> = (0..columns)
        .map(|j| j.checked_sub(channels).map_or(1.0, |r| -theta[layout.regressors[r].coefficient]))
        .collect();
    (0..bands)
        .map(|b| {
            let g = Packed(sums.band(b, columns));
            let mut out = DMatrix::zeros(channels, channels);
            for i in 0..columns {
                for j in 0..columns {
                    out[(layout.channel_of(i), layout.channel_of(j))] += weight[i] * weight[j] * g.at(i, j);
                }
            }
            0.5 * (&out + out.transpose())
        })
        .collect()
}

impl NormalEquations {
    pub(crate) fn new(
        names: Vec<String>,
        (normal, right, zz): &(DMatrix<f64>, DVector<f64>, f64),
        sums: &Sums,
        plan: &Plan,
    ) -> Self {
        let (sum_g, sum_g2) = sums.weights(plan);
        Self {
            names,
            normal: normal.row_iter().map(|r| r.iter().copied().collect()).collect(),
            right: right.iter().copied().collect(),
            zz: *zz,
            sum_g,
            sum_g2,
            segments: sums.segments,
        }
    }
}
