//! Normal equations over segments, for any Σ: `N = Σ Re Φᴴ Σ⁻¹ Φ`, `c = Σ Re Φᴴ Σ⁻¹ z` (§6 of the design).

use nalgebra::{Cholesky, DMatrix, DVector};
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

/// Equations in which some coefficients have separate values in the slow bands. These are nuisance parameters and
/// eliminated, so that the other bands alone determine such a coefficient.
///
/// A command answers the noise of the channels. The score of a gain inside the loop has expectation zero summed over
/// all frequencies, not over the slow bands.
pub(crate) struct Split<'a> {
    pub(crate) spectra: &'a Spectra,
    /// Bands below the ordinary ones.
    pub(crate) slow_bands: usize,
    /// Coefficients that have separate values there.
    pub(crate) apart: &'a [usize],
}

impl Split<'_> {
    /// The equations of all bands.
    pub(crate) fn accumulate(&self, layout: &Layout, inverses: &[DMatrix<f64>], weights: &[f64]) -> Equations {
        if self.apart.is_empty() || self.slow_bands == 0 {
            return accumulate(self.spectra, layout, inverses, weights);
        }
        let mut above = weights.to_vec();
        above[..self.slow_bands].fill(0.0);
        let mut sum = accumulate(self.spectra, layout, inverses, &above);
        let slow = self.slow(layout, inverses, weights);
        let own = slow.own_values(self.apart);
        let cross = DMatrix::from_fn(self.apart.len(), slow.right.len(), |i, j| slow.normal[(self.apart[i], j)]);
        let (value, response) = (own.column(0).into_owned(), own.columns(1, slow.right.len()).into_owned());
        let mut normal = &slow.normal - cross.tr_mul(&response);
        let mut right = &slow.right - cross.tr_mul(&value);
        for i in self.apart {
            normal.row_mut(*i).fill(0.0);
            normal.column_mut(*i).fill(0.0);
            right[*i] = 0.0;
        }
        sum.normal += 0.5 * (&normal + normal.transpose());
        sum.right += right;
        sum.zz += slow.zz - self.apart.iter().zip(value.iter()).map(|(i, v)| slow.right[*i] * v).sum::<f64>();
        sum
    }

    /// Cross-spectra of the residuals in every band.
    pub(crate) fn residuals(
        &self,
        layout: &Layout,
        inverses: &[DMatrix<f64>],
        weights: &[f64],
        theta: &DVector<f64>,
    ) -> Vec<DMatrix<f64>> {
        let bands = self.spectra.expected.len();
        let mut all = residuals(self.spectra, layout, bands, theta);
        if !self.apart.is_empty() && self.slow_bands > 0 {
            let own = self.slow(layout, inverses, weights).own_values(self.apart);
            let mut others = theta.clone();
            self.apart.iter().for_each(|i| others[*i] = 0.0);
            let value = own.column(0) - own.columns(1, theta.len()) * &others;
            let mut theta = theta.clone();
            self.apart.iter().zip(value.iter()).for_each(|(i, v)| theta[*i] = *v);
            all[..self.slow_bands].clone_from_slice(&residuals(self.spectra, layout, self.slow_bands, &theta));
        }
        all
    }

    fn slow(&self, layout: &Layout, inverses: &[DMatrix<f64>], weights: &[f64]) -> Equations {
        accumulate(self.spectra, layout, &inverses[..self.slow_bands], weights)
    }
}

impl Equations {
    /// `N_aa⁻¹ (c_a, N_a)` of some coefficients a: with the others at θ their values are its first column less the rest
    /// times θ. Zero for a coefficient that is not seen.
    fn own_values(&self, some: &[usize]) -> DMatrix<f64> {
        let size = DVector::from_fn(some.len(), |i, _| {
            let information = self.normal[(some[i], some[i])];
            if information > 0.0 { information.sqrt().recip() } else { 0.0 }
        });
        let own = DMatrix::from_fn(some.len(), some.len(), |i, j| {
            size[i] * self.normal[(some[i], some[j])] * size[j] + if i == j { ROUNDING } else { 0.0 }
        });
        let all = DMatrix::from_fn(some.len(), self.right.len() + 1, |i, j| {
            size[i] * if j == 0 { self.right[some[i]] } else { self.normal[(some[i], j - 1)] }
        });
        let solved = Cholesky::new(own).map_or_else(|| DMatrix::zeros(all.nrows(), all.ncols()), |c| c.solve(&all));
        DMatrix::from_diagonal(&size) * solved
    }
}

/// Added to the ones on the diagonal of a correlation matrix, which keeps it definite.
const ROUNDING: f64 = 1e-12;

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
