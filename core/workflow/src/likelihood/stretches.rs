//! Stretches of time of a product, any of which may be kept out of a fit: the likelihood of each, with the levels of
//! noise and the powers of time still free, as these are shared by all stretches of the product.
//!
//! With c the coefficients and n what is shared, about the point of the pass,
//!
//! ```text
//! χ²(c, n) = χ² − 2 sᵀ(c, n) + (c, n)ᵀ N (c, n),   χ²(c) = min_n χ²(c, n),   χ²_o(c | f) = χ²_fo(c) − χ²_f(c)
//! ```
//!
//! of the stretches f of the fit and of those that are kept out, o. What is shared is a polynomial in time for one:
//! it is not known in o as f alone has it, and χ² given f counts that.

use dragfree_identification::innovations::decision::{Candidate, Prior, Quadratic};
use dragfree_identification::innovations::filter::{Block, Passed, Sums};
use dragfree_identification::quadratic::inverse;
use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};

use super::{Decided, LEVEL_PRIOR, Meaning};
use crate::extract::doubles;

/// Most stretches of a product: three hours each of a day.
const STRETCHES: usize = 8;

/// Sums of a stretch of time.
pub(super) struct Stretch {
    from_ns: i64,
    until_ns: i64,
    sums: Sums,
}

/// The blocks of a pass, some neighbouring ones together.
pub(super) fn stretches(passed: &Passed) -> Vec<Stretch> {
    let each = passed.blocks.len().div_ceil(STRETCHES).max(1);
    let length_ns = passed.blocks.windows(2).map(|two| two[1].first_ns - two[0].first_ns).min().unwrap_or(0);
    let stretch = |blocks: &[Block]| {
        let first = &blocks[0];
        let mut sums = Sums::zeros(first.score.len(), first.squares.nrows());
        blocks.iter().for_each(|block| sums.add(block));
        let until_ns = blocks.last().map_or(first.first_ns, |last| last.first_ns + length_ns);
        Stretch { from_ns: first.first_ns, until_ns, sums }
    };
    passed.blocks.chunks(each).map(stretch).collect()
}

/// The stretches of a product, as an extract keeps them.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Stretches {
    /// Values about which the sums are: of the coefficients of the extract, then of what is shared.
    pub(crate) about: Vec<f64>,
    /// Of what is shared, the names of the noise's components; empty for a power of time.
    pub(crate) levels: Vec<String>,
    /// The stretches in the order of time.
    pub(crate) all: Vec<OneStretch>,
}

/// Sums of a stretch.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct OneStretch {
    pub(crate) from_ns: i64,
    pub(crate) until_ns: i64,
    /// Sum of squares of the whitened innovations, and numbers of them.
    pub(crate) chi2: f64,
    pub(crate) numbers: f64,
    /// Lower triangle, row after row.
    #[serde(with = "doubles")]
    pub(crate) information: Vec<f64>,
    #[serde(with = "doubles")]
    pub(crate) score: Vec<f64>,
}

/// A likelihood of the coefficients alone, about zero.
#[derive(Clone, Debug)]
pub(crate) struct Alone {
    pub(crate) information: DMatrix<f64>,
    pub(crate) score: DVector<f64>,
    pub(crate) chi2_at_zero: f64,
    pub(crate) numbers: f64,
    /// Logarithm and σ of each component of the noise, by its name.
    pub(crate) levels: Vec<(String, f64, f64)>,
}

impl Decided {
    /// The stretches of one product, with the coefficients of an extract: `None` of several products.
    pub(crate) fn stretches(&self, kept: impl Fn(&dragfree_schema::Coefficient) -> bool) -> Option<Stretches> {
        let [part] = &self.parts[..] else { return None };
        let meaning = |i: &usize| &self.parameters[*i].1;
        let is_kept = |i: &usize| matches!(meaning(i), Meaning::Coefficient(c) if kept(c));
        let shared = |i: &usize| !matches!(meaning(i), Meaning::Coefficient(_));
        let all = || 0..self.parameters.len();
        let order: Vec<usize> = all().filter(is_kept).chain(all().filter(shared)).collect();
        let own: Vec<Option<usize>> =
            order.iter().map(|i| part.places.iter().find(|(_, to)| to == i).map(|(own, _)| *own)).collect();
        let of = |stretch: &Stretch| {
            let at = |i: usize, j: usize| own[i].zip(own[j]).map_or(0.0, |(a, b)| stretch.sums.information[(a, b)]);
            OneStretch {
                from_ns: stretch.from_ns,
                until_ns: stretch.until_ns,
                chi2: stretch.sums.chi2,
                numbers: stretch.sums.numbers,
                information: (0..order.len())
                    .flat_map(|i| (0..=i).map(move |j| (i, j)))
                    .map(|(i, j)| at(i, j))
                    .collect(),
                score: own.iter().map(|a| a.map_or(0.0, |a| stretch.sums.score[a])).collect(),
            }
        };
        let level = |i: &usize| match meaning(i) {
            Meaning::Level => self.parameters[*i].0.clone(),
            _ => String::new(),
        };
        Some(Stretches {
            about: order.iter().map(|i| self.start[*i]).collect(),
            levels: order.iter().filter(|i| shared(i)).map(level).collect(),
            all: part.stretches.iter().map(of).collect(),
        })
    }
}

/// Information and score about the point of the pass, and χ² there.
struct Whole {
    information: DMatrix<f64>,
    score: DVector<f64>,
    chi2: f64,
    numbers: f64,
}

impl Stretches {
    /// Whether the numbers are as many as the coefficients need.
    pub(crate) fn is_whole(&self, coefficients: usize) -> bool {
        let n = coefficients + self.levels.len();
        let whole = |one: &OneStretch| {
            let numbers = one.information.iter().chain(&one.score).chain([&one.chi2, &one.numbers]);
            one.information.len() == n * (n + 1) / 2 && one.score.len() == n && numbers.clone().all(|x| x.is_finite())
        };
        self.about.len() == n && self.about.iter().all(|x| x.is_finite()) && self.all.iter().all(whole)
    }

    /// The likelihood of the coefficients in the stretches of the fit, and that of those that are kept out, given
    /// these.
    pub(crate) fn divided(&self, kept_out: impl Fn(usize) -> bool) -> (Alone, Alone) {
        let all: Vec<usize> = (0..self.all.len()).collect();
        let (out, fit): (Vec<usize>, Vec<usize>) = all.iter().partition(|k| kept_out(**k));
        let (whole, fit, out) = (self.alone(&all), self.alone(&fit), self.alone(&out));
        let given = Alone {
            information: whole.information - &fit.information,
            score: whole.score - &fit.score,
            chi2_at_zero: whole.chi2_at_zero - fit.chi2_at_zero,
            ..out
        };
        (fit, given)
    }

    /// The likelihood of the coefficients in some stretches, with what is shared fitted there.
    fn alone(&self, which: &[usize]) -> Alone {
        let sum = self.sum(which);
        let (total, shared) = (self.about.len(), self.levels.len());
        let coefficients = total - shared;
        let priors = self.priors();
        let mut normal = sum.information.view((coefficients, coefficients), (shared, shared)).into_owned();
        let mut right = sum.score.rows(coefficients, shared).into_owned();
        for (terms, prior) in &priors {
            let (i, known) = (terms[0].0 - coefficients, prior.sigma.powi(-2));
            normal[(i, i)] += known;
            right[i] += known * (prior.mean - self.about[i + coefficients]);
        }
        let known = inverse(&normal);
        let at = &known * &right;
        // As the extract of the whole product is made, with what rounding alone leaves set to zero.
        let mut sums = Sums::zeros(0, 0);
        (sums.information, sums.score, sums.numbers) = (sum.information, sum.score.as_slice().to_vec(), sum.numbers);
        let whole = Quadratic::new(&sums, &self.about, &priors, (0..coefficients).map(Candidate::free).collect());
        let (information, score) = whole.of_candidates();
        let about = DVector::from_column_slice(&self.about[..coefficients]);
        // At the point of the pass, less what the shared parameters take.
        let chi2_there = sum.chi2 - right.dot(&at);
        Alone {
            chi2_at_zero: chi2_there + 2.0 * score.dot(&about) - about.dot(&(&information * &about)),
            information,
            score,
            numbers: sum.numbers,
            levels: self.levels_of(&at, &known),
        }
    }

    fn sum(&self, which: &[usize]) -> Whole {
        let n = self.about.len();
        let mut whole = Whole { information: DMatrix::zeros(n, n), score: DVector::zeros(n), chi2: 0.0, numbers: 0.0 };
        for one in which.iter().map(|k| &self.all[*k]) {
            let mut packed = one.information.iter();
            for i in 0..n {
                for (j, x) in (0..=i).zip(&mut packed) {
                    whole.information[(i, j)] += x;
                }
            }
            whole.score += DVector::from_column_slice(&one.score);
            whole.chi2 += one.chi2;
            whole.numbers += one.numbers;
        }
        whole.information.fill_upper_triangle_with_lower_triangle();
        whole
    }

    /// What is known of the levels before any data.
    fn priors(&self) -> Vec<(Vec<(usize, f64)>, Prior)> {
        let first = self.about.len() - self.levels.len();
        let named = self.levels.iter().enumerate().filter(|(_, name)| !name.is_empty());
        named.map(|(k, _)| (vec![(first + k, 1.0)], Prior { mean: 0.0, sigma: LEVEL_PRIOR })).collect()
    }

    fn levels_of(&self, at: &DVector<f64>, known: &DMatrix<f64>) -> Vec<(String, f64, f64)> {
        let first = self.about.len() - self.levels.len();
        let level =
            |(k, name): (usize, &String)| (name.clone(), self.about[first + k] + at[k], known[(k, k)].max(0.0).sqrt());
        self.levels.iter().enumerate().filter(|(_, name)| !name.is_empty()).map(level).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng as _;
    use rand_distr::{Distribution as _, StandardNormal};
    use rand_xoshiro::Xoshiro256PlusPlus;

    const ROWS: usize = 200;

    /// Least squares by QR, with three coefficients and two parameters that all stretches share, for any
    /// coefficients: the form of the fit has its sum of squares and its values, that of what is kept out the sum of
    /// squares of all rows less it. About a point that is not the solution.
    #[test]
    fn what_is_kept_out_is_judged_given_the_others() {
        let mut random = Xoshiro256PlusPlus::seed_from_u64(3);
        let mut white = || -> f64 { StandardNormal.sample(&mut random) };
        let about = DVector::from_vec(vec![0.3, -0.2, 0.0, 0.5, 0.1]);
        let rows: Vec<(DMatrix<f64>, DVector<f64>)> = (0..3)
            .map(|_| {
                let design = DMatrix::from_fn(ROWS, 5, |_, k| white() + if k == 3 { 0.5 } else { 0.0 });
                let truth = DVector::from_vec(vec![0.4, -0.1, 0.2, 0.6, 0.0]);
                let measured = &design * truth + DVector::from_fn(ROWS, |_, _| white());
                (design, measured)
            })
            .collect();
        let stretch = |(k, (design, measured)): (usize, &(DMatrix<f64>, DVector<f64>))| {
            let left = measured - design * &about;
            let normal = design.tr_mul(design);
            OneStretch {
                from_ns: k as i64,
                until_ns: k as i64 + 1,
                chi2: left.norm_squared(),
                numbers: ROWS as f64,
                information: (0..5).flat_map(|i| (0..=i).map(move |j| (i, j))).map(|at| normal[at]).collect(),
                score: design.tr_mul(&left).as_slice().to_vec(),
            }
        };
        let stretches = Stretches {
            about: about.as_slice().to_vec(),
            levels: vec![String::new(); 2],
            all: rows.iter().enumerate().map(stretch).collect(),
        };
        assert!(stretches.is_whole(3) && !stretches.is_whole(2));
        let (fit, out) = stretches.divided(|k| k == 1);
        let together = |which: &[usize]| {
            let n = ROWS * which.len();
            let design = DMatrix::from_fn(n, 5, |t, k| rows[which[t / ROWS]].0[(t % ROWS, k)]);
            (design, DVector::from_fn(n, |t, _| rows[which[t / ROWS]].1[t % ROWS]))
        };
        let solved = |design: DMatrix<f64>, target: &DVector<f64>| -> DVector<f64> {
            let qr = design.qr();
            qr.r().solve_upper_triangular(&qr.q().tr_mul(target)).expect("regular")
        };
        let (own, all) = (together(&[0, 2]), together(&[0, 1, 2]));
        let best = solved(own.0.clone(), &own.1);
        let found = fit.information.clone().cholesky().expect("definite").solve(&fit.score);
        assert!((&found - best.rows(0, 3)).norm() < 1e-9, "{found} {best}");
        let at = |form: &Alone, c: &DVector<f64>| {
            form.chi2_at_zero + c.dot(&(&form.information * c)) - 2.0 * form.score.dot(c)
        };
        for c in [found, DVector::from_vec(vec![0.0, 0.0, 0.0]), DVector::from_vec(vec![0.5, 0.1, -2.0])] {
            let squares = |(design, measured): &(DMatrix<f64>, DVector<f64>)| {
                let rest = measured - design.columns(0, 3) * &c;
                let shared = design.columns(3, 2).into_owned();
                (&rest - &shared * solved(shared.clone(), &rest)).norm_squared()
            };
            let near = |a: f64, b: f64| assert!((a / b - 1.0).abs() < 1e-9, "{a} {b}");
            near(at(&fit, &c), squares(&own));
            near(at(&out, &c), squares(&all) - squares(&own));
        }
        assert_eq!((fit.numbers, out.numbers), (2.0 * ROWS as f64, ROWS as f64));
    }
}
