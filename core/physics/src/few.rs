//! A list of bounded length stored inline: values per test mass without an allocation per sample.

use std::ops::{Deref, DerefMut};

/// At most `MOST` values; dereferences to a slice.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Few<T, const MOST: usize> {
    values: [T; MOST],
    length: usize,
}

impl<T: Copy + Default, const MOST: usize> Few<T, MOST> {
    /// `length` values as a function of their index.
    ///
    /// # Panics
    /// `length` is above `MOST`.
    pub fn from_fn(length: usize, value: impl FnMut(usize) -> T) -> Self {
        let mut out = Self { values: [T::default(); MOST], length };
        out.values[..length].iter_mut().zip((0..length).map(value)).for_each(|(slot, value)| *slot = value);
        out
    }

    /// Adds a value.
    ///
    /// # Panics
    /// The list has `MOST` values already.
    pub fn push(&mut self, value: T) {
        self.values[self.length] = value;
        self.length += 1;
    }

    /// Maps each value.
    pub fn map<U: Copy + Default>(&self, mut f: impl FnMut(&T) -> U) -> Few<U, MOST> {
        Few::from_fn(self.length, |i| f(&self.values[i]))
    }
}

impl<T: Copy + Default, const MOST: usize, const N: usize> From<[T; N]> for Few<T, MOST> {
    fn from(values: [T; N]) -> Self {
        Self::from_fn(N, |i| values[i])
    }
}

impl<T: Copy + Default, const MOST: usize> FromIterator<T> for Few<T, MOST> {
    /// # Panics
    /// There are more than `MOST` values.
    fn from_iter<I: IntoIterator<Item = T>>(values: I) -> Self {
        let mut out = Self::default();
        values.into_iter().for_each(|value| out.push(value));
        out
    }
}

impl<T: Copy + Default, const MOST: usize> Default for Few<T, MOST> {
    /// No values.
    fn default() -> Self {
        Self { values: [T::default(); MOST], length: 0 }
    }
}

impl<T, const MOST: usize> Deref for Few<T, MOST> {
    type Target = [T];

    fn deref(&self) -> &[T] {
        &self.values[..self.length]
    }
}

impl<T, const MOST: usize> DerefMut for Few<T, MOST> {
    fn deref_mut(&mut self) -> &mut [T] {
        &mut self.values[..self.length]
    }
}

impl<'a, T, const MOST: usize> IntoIterator for &'a Few<T, MOST> {
    type Item = &'a T;
    type IntoIter = std::slice::Iter<'a, T>;

    fn into_iter(self) -> Self::IntoIter {
        self.iter()
    }
}

impl<'a, T, const MOST: usize> IntoIterator for &'a mut Few<T, MOST> {
    type Item = &'a mut T;
    type IntoIter = std::slice::IterMut<'a, T>;

    fn into_iter(self) -> Self::IntoIter {
        self.iter_mut()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_is_as_long_as_it_was_made() {
        let three: Few<u32, 4> = Few::from_fn(3, |i| 10 * i as u32);
        assert_eq!(*three, [0, 10, 20]);
        assert_eq!(*three.map(|x| f64::from(*x)), [0.0, 10.0, 20.0]);
        assert_eq!(three, (0..3).map(|i| 10 * i).collect());
        assert_ne!(three, Few::from([0, 10]));
        assert!(Few::<u32, 4>::default().is_empty());
    }

    #[test]
    #[should_panic(expected = "out of range")]
    fn it_holds_no_more_than_it_may() {
        let _ = Few::<u32, 4>::from_fn(5, |_| 0);
    }
}
