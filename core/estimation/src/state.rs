//! The stage's state as bytes: a mark, what it was made for, little-endian words, a checksum. Exact to the bit, NaN included.

use crate::prediction::{self, Memory, Stretch};
use crate::segments::{Collected, State};
use crate::spectra::{Block, MAX_BLOCKS, Plan, Spectra, Sums};
use dragfree_physics::levels::Levels;

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
pub const VERSION: u64 = 3;

/// The state as bytes; `layout` says what it is for. Sums of this run and of those before are one in it.
#[must_use]
pub fn save(layout: &str, state: &State, collected: &Collected, plan: &Plan) -> Vec<u8> {
    let sums = collected.all(plan);
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
    if let Some(prediction) = &collected.prediction {
        let p = &prediction.state;
        p.levels.iter().for_each(|l| w.numbers(&[l.held, l.readout]));
        p.memory.iter().for_each(|m| w.numbers(&m.values));
        for word in [p.since_gap, p.block_ns.cast_unsigned(), p.trained_at, p.blocks.len() as u64] {
            w.word(word);
        }
        for block in &p.blocks {
            w.word(block.number.cast_unsigned());
            w.numbers(&block.sums);
        }
    }
    let sum = checksum(&w.0);
    w.word(sum);
    w.0
}

/// Takes a state back; `state` and `collected`, of a run that has not begun, give the sizes that this run expects.
///
/// # Errors
/// [`StateError`]; nothing is changed then.
pub fn load(
    bytes: &[u8],
    layout: &str,
    state: &State,
    collected: &Collected,
) -> Result<(State, Collected), StateError> {
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
    let empty = &collected.sums.total;
    let sizes = (empty.packed.len(), empty.expected.len());
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
    let mut collected = collected.clone();
    collected.earlier = Sums { total, block_ns, blocks };
    if let Some(prediction) = &mut collected.prediction {
        prediction.state = r.prediction(&prediction.state, prediction.block_size())?;
        prediction.design();
    }
    if !r.0.is_empty() {
        return Err(StateError::Damaged("too long"));
    }
    let last_ns = some.then_some(last);
    let state = State { last_ns, previous, run, run_has_segment, run_end_ns, rows, valid, covered, missing };
    Ok((state, collected))
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

    fn prediction(&mut self, like: &prediction::State, block: usize) -> Result<prediction::State, StateError> {
        let levels = (0..like.levels.len())
            .map(|_| Ok(Levels { held: self.number()?, readout: self.number()? }))
            .collect::<Result<_, StateError>>()?;
        let memory = (0..like.memory.len())
            .map(|_| {
                let mut values = [0.0; 6];
                for value in &mut values {
                    *value = self.number()?;
                }
                Ok(Memory { values })
            })
            .collect::<Result<_, StateError>>()?;
        let (since_gap, block_ns, trained_at) = (self.word()?, self.word()?.cast_signed(), self.word()?);
        let blocks = self.size()?;
        if block_ns <= 0 || blocks > MAX_BLOCKS {
            return Err(StateError::Damaged("stretches of time"));
        }
        let blocks = (0..blocks)
            .map(|_| Ok(Stretch { number: self.word()?.cast_signed(), sums: self.numbers(block)? }))
            .collect::<Result<_, StateError>>()?;
        Ok(prediction::State { levels, memory, since_gap, block_ns, blocks, trained_at })
    }

    fn number(&mut self) -> Result<f64, StateError> {
        Ok(f64::from_bits(self.word()?))
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
    use crate::prediction::Prediction;
    use crate::segments::Segmenter;
    use crate::sigma::{Measured, NoiseModel};
    use crate::spectra::{Analyser, Layout, Regressor};
    use dragfree_physics::mission::Mission;

    const DAY: [Measured; 1] = [Measured::Directly];

    fn layout() -> Layout {
        Layout {
            channels: vec!["c".into()],
            series: vec!["s".into()],
            regressors: vec![Regressor { coefficient: 0, channel: 0, series: 0, factor: 2.0, times: None }],
            coefficients: vec!["b".into()],
        }
    }

    fn begin() -> (Segmenter, Collected, Analyser) {
        let text = include_str!("../../../fixtures/missions/taiji.toml");
        let value: serde_json::Value = toml::from_str(text).expect("the fixture is TOML");
        let mission = Mission::from_json(&value.to_string()).expect("a mission");
        let model = NoiseModel::new(&mission, &[("c", DAY[0])], 0.1).expect("a model");
        let plan = Plan::new(64, 10.0);
        let prediction = Prediction::new(&model, &DAY, &layout(), &plan);
        assert!(prediction.is_some());
        let collected = Collected::new(&plan, &layout(), prediction);
        (Segmenter::new(64, 100_000_000, vec![false; 2]), collected, Analyser::new(plan, &layout()))
    }

    /// Rows of two columns with a gap, from `first` on.
    fn feed(first: i64, end: i64, (segmenter, collected, analyser): &mut (Segmenter, Collected, Analyser)) {
        let times: Vec<i64> = (first..end).map(|k| 100_000_000 * (k + i64::from(k > 5000) * 7)).collect();
        let column = |p: i64| -> Vec<f64> { (first..end).map(|k| ((k * k % p) as f64).sin()).collect() };
        segmenter.push(&times, &[&column(1009), &column(997)], analyser, collected);
    }

    fn saved() -> Vec<u8> {
        let mut run = begin();
        feed(0, 9000, &mut run);
        save("one channel", &run.0.state, &run.1, run.2.plan())
    }

    #[test]
    fn a_round_trip_changes_no_byte_and_the_run_goes_on_as_one() {
        let bytes = saved();
        let mut second = begin();
        let (state, collected) = load(&bytes, "one channel", &second.0.state, &second.1).expect("our own state");
        (second.0.state, second.1) = (state, collected);
        assert_eq!(save("one channel", &second.0.state, &second.1, second.2.plan()), bytes);
        feed(9000, 20_000, &mut second);
        let mut whole = begin();
        feed(0, 20_000, &mut whole);
        assert_eq!(second.0.state, whole.0.state);
        let states = [&second, &whole].map(|r| r.1.prediction.as_ref().expect("a fit").state.clone());
        let apart = states[0].blocks.iter().zip(&states[1].blocks).flat_map(|(a, b)| {
            assert_eq!(a.number, b.number);
            a.sums.iter().zip(&b.sums).map(|(a, b)| (a / b - 1.0).abs())
        });
        assert!(states[0].blocks.len() == states[1].blocks.len() && apart.fold(0.0, f64::max) < 1e-9);
        let (a, b) = (second.1.all(second.2.plan()), whole.1.all(whole.2.plan()));
        assert_eq!((a.total.segments, a.blocks.len()), (b.total.segments, b.blocks.len()));
        let apart = a.total.packed.iter().zip(&b.total.packed).map(|(a, b)| (a / b - 1.0).abs());
        assert!(apart.fold(0.0, f64::max) < 1e-9);
    }

    #[test]
    fn every_flipped_byte_and_every_cut_is_refused() {
        let bytes = saved();
        let (segmenter, collected, _) = begin();
        for i in (0..bytes.len()).step_by(7) {
            let mut damaged = bytes.clone();
            damaged[i] ^= 0x40;
            assert!(load(&damaged, "one channel", &segmenter.state, &collected).is_err(), "byte {i}");
            assert!(load(&bytes[..i], "one channel", &segmenter.state, &collected).is_err(), "cut at {i}");
        }
        assert!(matches!(load(&bytes, "two channels", &segmenter.state, &collected), Err(StateError::Layout { .. })));
    }
}
