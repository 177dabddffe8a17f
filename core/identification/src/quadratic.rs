//! Quadratic forms in a few values: their inverse, and the largest value inside a box.

use nalgebra::{DMatrix, DVector};

/// What the derivative at a bound must have of the largest one, in units of what each value adds, to be no rounding.
const ROUNDING: f64 = 1e-9;
/// Exchanges of several values at once without progress before they are exchanged one by one.
const PATIENCE: usize = 3;

/// Inverse of a symmetric matrix with rows of different units; rows of zeros stay zero.
pub fn inverse(m: &DMatrix<f64>) -> DMatrix<f64> {
    let unit: Vec<f64> = m.diagonal().iter().map(|d| if *d > 0.0 { d.sqrt().recip() } else { 0.0 }).collect();
    let mut scaled = DMatrix::from_fn(m.nrows(), m.nrows(), |i, j| m[(i, j)] * unit[i] * unit[j]);
    (0..m.nrows()).filter(|i| unit[*i] == 0.0).for_each(|i| scaled[(i, i)] = 1.0);
    if m.is_empty() {
        return scaled;
    }
    let eigen = scaled.symmetric_eigen();
    // What differs from a combination of the others by rounding alone has no information of its own.
    let least = 1e-13 * eigen.eigenvalues.max().max(1.0);
    let reciprocal = eigen.eigenvalues.map(|x| if x > least { x.recip() } else { 0.0 });
    let inner = &eigen.eigenvectors * DMatrix::from_diagonal(&reciprocal) * eigen.eigenvectors.transpose();
    DMatrix::from_fn(m.nrows(), m.nrows(), |i, j| inner[(i, j)] * unit[i] * unit[j])
}

/// Where a value is.
#[derive(Clone, Copy, PartialEq)]
enum At {
    Inside,
    Lower,
    Upper,
}

/// Values inside their bounds at which `2 sᵀx − xᵀNx` is largest, of a positive definite N; values without information
/// are as near zero as their bounds allow.
///
/// By block principal pivoting, which falls back on Murty's rule of one exchange at a time and so ends (Júdice and
/// Pires, 1994).
pub(crate) fn largest_in_box(n: &DMatrix<f64>, s: &DVector<f64>, bounds: &[(f64, f64)]) -> DVector<f64> {
    let size = s.len();
    let nearest = |i: usize| 0.0f64.max(bounds[i].0).min(bounds[i].1);
    let mut at = vec![At::Inside; size];
    let mut x = DVector::zeros(size);
    let unit = |i: usize| if n[(i, i)] > 0.0 { n[(i, i)].sqrt().recip() } else { 0.0 };
    let largest = (0..size).map(|i| (s[i] * unit(i)).abs()).fold(0.0, f64::max);
    let (mut fewest, mut patience) = (usize::MAX, PATIENCE);
    for _ in 0..100 + 20 * size {
        let held = DVector::from_fn(size, |i, _| match at[i] {
            At::Inside if n[(i, i)] > 0.0 => 0.0,
            At::Inside => nearest(i),
            At::Lower => bounds[i].0,
            At::Upper => bounds[i].1,
        });
        let free: Vec<usize> = (0..size).filter(|i| at[*i] == At::Inside && n[(*i, *i)] > 0.0).collect();
        let rest = s - n * &held;
        let own = inverse(&DMatrix::from_fn(free.len(), free.len(), |i, j| n[(free[i], free[j])]));
        let solved = own * DVector::from_fn(free.len(), |i, _| rest[free[i]]);
        x = held;
        free.iter().zip(solved.iter()).for_each(|(i, value)| x[*i] = *value);
        let slope = s - n * &x;
        let wrong = |i: usize| {
            let uphill = slope[i] * unit(i);
            match at[i] {
                At::Inside if x[i] < bounds[i].0 => Some(At::Lower),
                At::Inside if x[i] > bounds[i].1 => Some(At::Upper),
                At::Lower if uphill > ROUNDING * largest => Some(At::Inside),
                At::Upper if uphill < -ROUNDING * largest => Some(At::Inside),
                _ => None,
            }
        };
        let mut exchanges: Vec<(usize, At)> = (0..size).filter_map(|i| Some((i, wrong(i)?))).collect();
        if exchanges.is_empty() {
            return x;
        }
        if exchanges.len() < fewest {
            (fewest, patience) = (exchanges.len(), PATIENCE);
        } else if patience > 0 {
            patience -= 1;
        } else {
            exchanges.drain(..exchanges.len() - 1);
        }
        exchanges.into_iter().for_each(|(i, to)| at[i] = to);
    }
    // Of a form that is singular but for rounding: no value leaves its bounds.
    DVector::from_fn(size, |i, _| x[i].max(bounds[i].0).min(bounds[i].1))
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_xoshiro::Xoshiro256PlusPlus;

    fn value(n: &DMatrix<f64>, s: &DVector<f64>, x: &DVector<f64>) -> f64 {
        2.0 * s.dot(x) - x.dot(&(n * x))
    }

    /// The best of all choices of bounds, each solved for the rest.
    fn by_trying(n: &DMatrix<f64>, s: &DVector<f64>, bounds: &[(f64, f64)]) -> f64 {
        let size = s.len();
        let mut best = f64::NEG_INFINITY;
        for choice in 0..3usize.pow(size as u32) {
            let at: Vec<usize> = (0..size).map(|i| choice / 3usize.pow(i as u32) % 3).collect();
            let free: Vec<usize> = (0..size).filter(|i| at[*i] == 0).collect();
            let mut x = DVector::from_fn(size, |i, _| [0.0, bounds[i].0, bounds[i].1][at[i]]);
            let rest = s - n * &x;
            let own = DMatrix::from_fn(free.len(), free.len(), |i, j| n[(free[i], free[j])]);
            let solved = own.try_inverse().expect("definite") * DVector::from_fn(free.len(), |i, _| rest[free[i]]);
            free.iter().zip(solved.iter()).for_each(|(i, value)| x[*i] = *value);
            if (0..size).all(|i| bounds[i].0 - 1e-9 <= x[i] && x[i] <= bounds[i].1 + 1e-9) {
                best = best.max(value(n, s, &x));
            }
        }
        best
    }

    /// Values that were fixed at a bound are released where that is larger: here both orders of fixing end at zero if
    /// the first one stays.
    #[test]
    fn a_value_at_a_bound_is_released() {
        let n = DMatrix::from_row_slice(2, 2, &[1.0, -0.9, -0.9, 1.0]);
        for swapped in [false, true] {
            let s = if swapped { [-0.8, 0.5] } else { [0.5, -0.8] };
            let x = largest_in_box(&n, &DVector::from_column_slice(&s), &[(0.0, f64::INFINITY); 2]);
            let want = if swapped { [0.0, 0.5] } else { [0.5, 0.0] };
            assert!((x - DVector::from_column_slice(&want)).amax() < 1e-12);
        }
    }

    /// Five nearly collinear values in boxes, 300 times: none of all choices of bounds is better.
    #[test]
    fn no_other_choice_of_bounds_is_better() {
        let mut dice = Xoshiro256PlusPlus::seed_from_u64(1);
        let mut bound = 0;
        for _ in 0..300 {
            let common = DVector::from_fn(8, |_, _| dice.random_range(-1.0..1.0));
            let own = DMatrix::from_fn(8, 5, |i, _| common[i] + dice.random_range(-0.1..0.1));
            let n = own.transpose() * &own;
            let s = own.transpose() * DVector::from_fn(8, |_, _| dice.random_range(-1.0..1.0));
            let bounds: Vec<(f64, f64)> =
                (0..5).map(|_| (-dice.random_range(0.0..2.0), dice.random_range(0.0..2.0))).collect();
            let x = largest_in_box(&n, &s, &bounds);
            assert!((0..5).all(|i| bounds[i].0 <= x[i] && x[i] <= bounds[i].1));
            let (found, best) = (value(&n, &s, &x), by_trying(&n, &s, &bounds));
            assert!((found - best).abs() < 1e-9 * (1.0 + best.abs()), "{found} against {best}");
            bound += (0..5).filter(|i| x[*i] == bounds[*i].0 || x[*i] == bounds[*i].1).count();
        }
        assert!(bound > 300, "{bound} values at their bounds");
    }

    /// A value without information stays at zero, or at the bound next to it.
    #[test]
    fn a_value_without_information_stays_near_zero() {
        let n = DMatrix::from_diagonal(&DVector::from_column_slice(&[2.0, 0.0, 0.0]));
        let s = DVector::from_column_slice(&[1.0, 0.0, 0.0]);
        let x = largest_in_box(&n, &s, &[(-1.0, 1.0), (-1.0, 1.0), (3.0, 4.0)]);
        assert_eq!(x.as_slice(), [0.5, 0.0, 3.0]);
    }
}
