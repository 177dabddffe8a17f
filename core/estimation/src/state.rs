//! The stage's state as bytes: a mark, what it was made for, little-endian words, a checksum. Exact to the bit, NaN included.

use crate::segments::State;
use crate::spectra::{Block, MAX_BLOCKS, Spectra, Sums};

/// Why a saved state was refused.
#[derive(Debug, thiserror::Error)]
pub enum StateError {
    /// Written by something else.
    #[error(
        "saved state is not one of qp-check version {VERSION}: start from the beginning of the data, or with that version"
    )]
    Foreign,
    /// Bits have changed, or bytes are missing.
    #[error("saved state of qp-check is damaged ({0}): start from the beginning of the data, or from an older state")]
    Damaged(&'static str),
    /// Written for other channels, effects or segments.
    #[error(
        "saved state of qp-check was made for {found}, this run has {expected}: after a change of model or mission start anew"
    )]
    Layout {
        /// In the state.
        found: String,
        /// In this run.
        expected: String,
    },
}

const MARK: &[u8; 8] = b"QPCHECK\n";
/// Version of the layout of saved states.
pub const VERSION: u64 = 2;

/// The state as bytes; `layout` says what it is for.
#[must_use]
pub fn save(layout: &str, state: &State, sums: &Sums) -> Vec<u8> {
    let mut w = Writer(MARK.to_vec());
    w.word(VERSION);
    w.word(layout.len() as u64);
    w.0.extend_from_slice(layout.as_bytes());
    w.word(u64::from(state.last_ns.is_some()));
    w.word(state.last_ns.unwrap_or_default().cast_unsigned());
    w.numbers(&state.previous);
    w.columns(&state.run);
    w.word(u64::from(state.run_has_segment));
    w.word(state.run_end_ns.cast_unsigned());
    for count in [state.rows, state.valid, state.covered] {
        w.word(count);
    }
    state.missing.iter().for_each(|n| w.word(*n));
    w.spectra(&sums.total);
    w.word(sums.block_ns.cast_unsigned());
    w.word(sums.blocks.len() as u64);
    for block in &sums.blocks {
        w.word(block.number.cast_unsigned());
        w.word(block.overlaps_before.map_or(0, |taper| taper as u64 + 1));
        w.spectra(&block.spectra);
    }
    let sum = checksum(&w.0);
    w.word(sum);
    w.0
}

/// Takes a state back; `sums` and `state` give the sizes that this run expects.
///
/// # Errors
/// [`StateError`]; nothing is changed then.
pub fn load(bytes: &[u8], layout: &str, state: &State, sums: &Sums) -> Result<(State, Sums), StateError> {
    if bytes.get(..8) != Some(MARK) || bytes.get(8..16) != Some(&VERSION.to_le_bytes()) {
        return Err(StateError::Foreign);
    }
    let (body, sum) = bytes.split_last_chunk::<8>().ok_or(StateError::Damaged("cut off"))?;
    if checksum(body) != u64::from_le_bytes(*sum) {
        return Err(StateError::Damaged("checksum"));
    }
    let mut r = Reader(&body[16..]);
    let length = r.size()?;
    let found = r.take(length)?;
    if found != layout.as_bytes() {
        let found = String::from_utf8_lossy(found).into_owned();
        return Err(StateError::Layout { found, expected: layout.to_owned() });
    }
    let columns = state.previous.len();
    let some = r.flag()?;
    let last = r.word()?.cast_signed();
    let previous = r.numbers(columns)?;
    let run = r.columns(columns)?;
    let run_has_segment = r.flag()?;
    let run_end_ns = r.word()?.cast_signed();
    let (rows, valid, covered) = (r.word()?, r.word()?, r.word()?);
    let missing = (0..columns).map(|_| r.word()).collect::<Result<_, _>>()?;
    let sizes = (sums.total.packed.len(), sums.total.expected.len());
    let total = r.spectra(sizes)?;
    let block_ns = r.word()?.cast_signed();
    let blocks = r.size()?;
    if block_ns <= 0 || blocks > MAX_BLOCKS {
        return Err(StateError::Damaged("blocks of time"));
    }
    let blocks = (0..blocks)
        .map(|_| {
            let number = r.word()?.cast_signed();
            let overlaps_before = (r.word()? as usize).checked_sub(1);
            if overlaps_before.is_some_and(|taper| taper >= 64) {
                return Err(StateError::Damaged("an overlap"));
            }
            Ok(Block { number, overlaps_before, spectra: r.spectra(sizes)? })
        })
        .collect::<Result<_, StateError>>()?;
    if !r.0.is_empty() {
        return Err(StateError::Damaged("too long"));
    }
    let last_ns = some.then_some(last);
    let state = State { last_ns, previous, run, run_has_segment, run_end_ns, rows, valid, covered, missing };
    Ok((state, Sums { total, block_ns, blocks }))
}

struct Writer(Vec<u8>);

impl Writer {
    fn word(&mut self, word: u64) {
        self.0.extend_from_slice(&word.to_le_bytes());
    }

    fn numbers(&mut self, numbers: &[f64]) {
        numbers.iter().for_each(|x| self.word(x.to_bits()));
    }

    fn spectra(&mut self, spectra: &Spectra) {
        self.word(spectra.segments);
        for numbers in [&spectra.packed, &spectra.expected, &spectra.weight, &spectra.weight_squared] {
            self.numbers(numbers);
        }
    }

    /// Columns of equal length.
    fn columns(&mut self, columns: &[Vec<f64>]) {
        self.word(columns.first().map_or(0, Vec::len) as u64);
        columns.iter().for_each(|c| self.numbers(c));
    }
}

struct Reader<'a>(&'a [u8]);

impl<'a> Reader<'a> {
    fn take(&mut self, bytes: usize) -> Result<&'a [u8], StateError> {
        let (head, tail) = self.0.split_at_checked(bytes).ok_or(StateError::Damaged("cut off"))?;
        self.0 = tail;
        Ok(head)
    }

    fn word(&mut self) -> Result<u64, StateError> {
        let (head, tail) = self.0.split_first_chunk::<8>().ok_or(StateError::Damaged("cut off"))?;
        self.0 = tail;
        Ok(u64::from_le_bytes(*head))
    }

    fn flag(&mut self) -> Result<bool, StateError> {
        match self.word()? {
            0 => Ok(false),
            1 => Ok(true),
            _ => Err(StateError::Damaged("a flag that is none")),
        }
    }

    /// A count of things that the rest of the bytes must hold.
    fn size(&mut self) -> Result<usize, StateError> {
        usize::try_from(self.word()?).ok().filter(|n| *n <= self.0.len()).ok_or(StateError::Damaged("a size"))
    }

    fn numbers(&mut self, count: usize) -> Result<Vec<f64>, StateError> {
        let bytes = self.take(count.checked_mul(8).ok_or(StateError::Damaged("a size"))?)?;
        Ok(bytes.as_chunks::<8>().0.iter().map(|b| f64::from_le_bytes(*b)).collect())
    }

    fn spectra(&mut self, (packed, bands): (usize, usize)) -> Result<Spectra, StateError> {
        Ok(Spectra {
            segments: self.word()?,
            packed: self.numbers(packed)?,
            expected: self.numbers(bands)?,
            weight: self.numbers(bands)?,
            weight_squared: self.numbers(bands)?,
        })
    }

    fn columns(&mut self, columns: usize) -> Result<Vec<Vec<f64>>, StateError> {
        let length = self.size()?;
        (0..columns).map(|_| self.numbers(length)).collect()
    }
}

/// FNV-1a over words; it guards against accidents, not against intent.
fn checksum(bytes: &[u8]) -> u64 {
    let (words, rest) = bytes.as_chunks::<8>();
    let words = words.iter().map(|w| u64::from_le_bytes(*w)).chain(rest.iter().map(|b| u64::from(*b)));
    words.fold(0xcbf2_9ce4_8422_2325, |h, w| (h ^ w).wrapping_mul(0x0000_0100_0000_01b3).rotate_left(23))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn example() -> (State, Sums) {
        let state = State {
            last_ns: Some(-5),
            previous: vec![f64::NAN, 1.0],
            run: vec![vec![1.0, 2.0, -0.0], vec![0.1, f64::MIN_POSITIVE, 3.0]],
            run_has_segment: true,
            run_end_ns: 77,
            rows: 10,
            valid: 9,
            covered: 8,
            missing: vec![0, 1],
        };
        let spectra = |segments| Spectra {
            packed: vec![1.5, 2.5],
            expected: vec![0.75],
            weight: vec![3.0],
            weight_squared: vec![2.0],
            segments,
        };
        let blocks = vec![
            Block { number: -1, spectra: spectra(1), overlaps_before: None },
            Block { number: 4, spectra: spectra(2), overlaps_before: Some(0) },
        ];
        (state, Sums { total: spectra(3), block_ns: 3_600_000_000_000, blocks })
    }

    #[test]
    fn a_round_trip_changes_no_byte() {
        let (state, sums) = example();
        let bytes = save("two channels", &state, &sums);
        let (s, g) = load(&bytes, "two channels", &state, &sums).expect("our own state");
        assert_eq!(save("two channels", &s, &g), bytes);
    }

    #[test]
    fn every_flipped_byte_and_every_cut_is_refused() {
        let (state, sums) = example();
        let bytes = save("two channels", &state, &sums);
        for i in 0..bytes.len() {
            let mut damaged = bytes.clone();
            damaged[i] ^= 0x40;
            assert!(load(&damaged, "two channels", &state, &sums).is_err(), "byte {i}");
            assert!(load(&bytes[..i], "two channels", &state, &sums).is_err(), "cut at {i}");
        }
        assert!(matches!(load(&bytes, "three channels", &state, &sums), Err(StateError::Layout { .. })));
    }
}
