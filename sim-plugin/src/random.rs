//! Random streams, reproducible from one seed, and the states of random processes.

use rand::SeedableRng;
use rand_xoshiro::Xoshiro256PlusPlus;

/// An independent random stream per name: FNV-1a of the name combined with the seed.
pub(crate) fn stream(seed: u64, name: &str) -> Xoshiro256PlusPlus {
    let hash = name.bytes().fold(0xcbf2_9ce4_8422_2325_u64, |h, b| (h ^ u64::from(b)).wrapping_mul(0x100_0000_01b3));
    Xoshiro256PlusPlus::seed_from_u64(hash.wrapping_add(seed.wrapping_mul(0x9e37_79b9_7f4a_7c15)))
}

/// Fills slots with saved numbers; false if their numbers differ.
pub(crate) fn fill<'a>(slots: impl IntoIterator<Item = &'a mut f64>, states: &[f64]) -> bool {
    let mut states = states.iter();
    let filled = slots.into_iter().all(|slot| states.next().map(|value| *slot = *value).is_some());
    filled && states.next().is_none()
}
