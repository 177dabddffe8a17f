//! From a sound input and a number to a damaged one.

use rand::{RngExt as _, SeedableRng as _};
use rand_xoshiro::Xoshiro256PlusPlus;

/// Longest input.
const MOST_BYTES: usize = 1 << 18;
/// Most changes of one input.
const MOST_CHANGES: u32 = 6;
/// Numbers at the edges of what integers and floats can hold.
const EDGES: [u64; 12] = [
    0,
    1,
    0x7f,
    0xff,
    0xffff,
    0x7fff_ffff,
    0xffff_ffff,
    1 << 60,
    i64::MAX as u64,
    u64::MAX,
    0x7ff0_0000_0000_0000, // infinity
    0x7ff8_0000_0000_0000, // NaN
];
/// Words that mean something to a reader of text.
const WORDS: [&str; 20] = [
    "nan",
    "inf",
    "-inf",
    "1e308",
    "-1",
    "0",
    "1e-400",
    "9223372036854775808",
    "true",
    "[]",
    "{}",
    "[[",
    "\"\"",
    "'''",
    "\n",
    "=",
    ".",
    "\u{0}",
    "\u{202e}",
    "999999999999999999999999",
];

/// The input with a number: one of `corpus`, changed a few times.
pub fn input(corpus: &[Vec<u8>], seed: u64) -> Vec<u8> {
    let mut rng = Xoshiro256PlusPlus::seed_from_u64(seed);
    let mut bytes = corpus[rng.random_range(0..corpus.len())].clone();
    for _ in 0..rng.random_range(1..=MOST_CHANGES) {
        change(&mut bytes, corpus, &mut rng);
        bytes.truncate(MOST_BYTES);
    }
    bytes
}

fn change(bytes: &mut Vec<u8>, corpus: &[Vec<u8>], rng: &mut Xoshiro256PlusPlus) {
    if bytes.is_empty() {
        bytes.push(rng.random());
        return;
    }
    let at = rng.random_range(0..bytes.len());
    let length = rng.random_range(1..=32.min(bytes.len() - at));
    match rng.random_range(0..12) {
        0 => bytes[at] ^= 1 << rng.random_range(0..8),
        1 => bytes[at] = rng.random(),
        2 => bytes[at..at + length].iter_mut().for_each(|byte| *byte = rng.random()),
        3 => drop(bytes.drain(at..at + length)),
        4 => bytes.truncate(at),
        5 => {
            let piece = bytes[at..at + length].to_vec();
            let to = rng.random_range(0..=bytes.len());
            bytes.splice(to..to, piece);
        }
        6 => {
            let edge = EDGES[rng.random_range(0..EDGES.len())].to_le_bytes();
            let width = [1, 2, 4, 8][rng.random_range(0..4)].min(bytes.len() - at);
            bytes[at..at + width].copy_from_slice(&edge[..width]);
        }
        7 => {
            let other = &corpus[rng.random_range(0..corpus.len())];
            let from = rng.random_range(0..other.len().max(1)).min(other.len());
            bytes.truncate(at);
            bytes.extend_from_slice(&other[from..]);
        }
        8 => {
            let word = WORDS[rng.random_range(0..WORDS.len())].as_bytes();
            bytes.splice(at..at + length, word.iter().copied());
        }
        9 => number(bytes, at, rng),
        10 => {
            let piece = bytes[at..at + length].to_vec();
            let times = rng.random_range(2..200);
            bytes.splice(at..at, piece.repeat(times));
        }
        _ => bytes[at] = bytes[at].wrapping_add(rng.random_range(1..=3)),
    }
}

/// Puts another number in the place of the next one in a text.
fn number(bytes: &mut Vec<u8>, from: usize, rng: &mut Xoshiro256PlusPlus) {
    let Some(start) = bytes[from..].iter().position(u8::is_ascii_digit).map(|at| from + at) else { return };
    let is_part = |byte: &&u8| byte.is_ascii_digit() || matches!(byte, b'.' | b'e' | b'-' | b'+' | b'_');
    let length = bytes[start..].iter().take_while(is_part).count();
    let value = match rng.random_range(0..4) {
        0 => format!("{}", rng.random::<i64>()),
        1 => format!("{:e}", f64::from_bits(rng.random())),
        2 => format!("1e{}", rng.random_range(-330..330)),
        _ => format!("{}", rng.random_range(-3..100)),
    };
    bytes.splice(start..start + length, value.bytes());
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_input_follows_from_its_number_and_differs_from_the_next() {
        let corpus = vec![b"mass_kg = 1500.0\nname = \"x\"\n".to_vec(), vec![0; 100]];
        let mut different = 0;
        for seed in 0..500 {
            assert_eq!(input(&corpus, seed), input(&corpus, seed));
            different += usize::from(input(&corpus, seed) != input(&corpus, seed + 1));
        }
        assert!(different > 480, "{different}");
    }
}
