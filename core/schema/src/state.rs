//! The state of a plugin as bytes: one function visits every field, for saving and for loading.
//!
//! A state begins with a mark, the plugin's id and the version of its layout, and ends with a checksum; between them
//! stand little-endian words in the order of the visits, numbers bit by bit, NaN included. Bytes that are cut, too
//! long, damaged or another plugin's are refused before a field is read, and no count makes a reader take more memory
//! than the bytes justify.
//!
//! ```
//! use dragfree_schema::state::{self, State, StateError};
//!
//! #[derive(Debug, Default, PartialEq)]
//! struct Mean { sum: f64, rows: u64, recent: Vec<f64> }
//!
//! impl Mean {
//!     fn visit(&mut self, state: &mut State<'_>) -> Result<(), StateError> {
//!         state.f64(&mut self.sum)?;
//!         state.u64(&mut self.rows)?;
//!         state.f64_list(&mut self.recent)
//!     }
//! }
//!
//! let mut mean = Mean { sum: 2.0, rows: 2, recent: vec![0.5, f64::INFINITY] };
//! let bytes = state::save("mean", 1, |state| mean.visit(state))?;
//! let mut again = Mean::default();
//! state::load("mean", 1, &bytes, |state| again.visit(state))?;
//! assert_eq!(again, mean);
//! # Ok::<(), StateError>(())
//! ```

use serde::Serialize;
use serde::de::DeserializeOwned;
use std::collections::VecDeque;

const MARK: &[u8; 8] = b"DFPLUGIN";
const WORD: usize = 8;

/// Why a saved state was refused.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum StateError {
    /// It does not begin as states of this version do.
    Foreign {
        /// The plugin that was to take it.
        plugin: String,
    },
    /// Another plugin saved it.
    Plugin {
        /// The plugin that saved it.
        found: String,
        /// The plugin that was to take it.
        expected: String,
    },
    /// Another version of the plugin saved it.
    Version {
        /// The plugin.
        plugin: String,
        /// Version of the layout in the state.
        found: u64,
        /// Version that the plugin reads.
        expected: u64,
    },
    /// Bytes are missing or have changed.
    Damaged,
    /// It was saved with something else than this run has.
    Differs {
        /// What differs: `model`.
        what: &'static str,
        /// In the state.
        found: String,
        /// In this run.
        expected: String,
    },
    /// Its content does not fit this run.
    Content(&'static str),
}

impl std::fmt::Display for StateError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        const NEXT: &str = "replay the day before with this version, or start without a state";
        match self {
            Self::Foreign { plugin } => write!(
                f,
                "the state of {plugin} is of an older version of the program, or no state at all; this version cannot read it: {NEXT}"
            ),
            Self::Plugin { found, expected } => {
                write!(f, "the state was saved by plugin {found}, not by {expected}; give each plugin its own state")
            }
            Self::Version { plugin, found, expected } => write!(
                f,
                "the state of {plugin} has layout version {found}, this {plugin} reads version {expected}: {NEXT}"
            ),
            Self::Damaged => write!(f, "the state is damaged or cut off: use an earlier state, or start without one"),
            Self::Differs { what, found, expected } => {
                write!(
                    f,
                    "the state was saved with another {what}, {found}; this run has {expected}: start without a state"
                )
            }
            Self::Content(what) => write!(
                f,
                "the state holds {what} that this run has no place for; it was saved with another mission, model or pipeline \
                 file: start without a state"
            ),
        }
    }
}

impl std::error::Error for StateError {}

/// Saves what `visit` visits.
///
/// # Errors
/// Those of `visit`.
pub fn save<E>(plugin: &str, version: u32, visit: impl FnOnce(&mut State<'_>) -> Result<(), E>) -> Result<Vec<u8>, E> {
    let mut state = State(Direction::Save(MARK.to_vec()));
    state.put(&u64::from(version).to_le_bytes());
    state.put(&(plugin.len() as u64).to_le_bytes());
    state.put(plugin.as_bytes());
    visit(&mut state)?;
    let Direction::Save(mut bytes) = state.0 else { return Ok(Vec::new()) };
    let sum = checksum(&bytes);
    bytes.extend_from_slice(&sum.to_le_bytes());
    Ok(bytes)
}

/// Loads what [`save`] saved for the same plugin and version into what `visit` visits.
///
/// # Errors
/// A [`StateError`], or those of `visit`; what was visited is then in an undefined state.
pub fn load<E: From<StateError>>(
    plugin: &str,
    version: u32,
    bytes: &[u8],
    visit: impl FnOnce(&mut State<'_>) -> Result<(), E>,
) -> Result<(), E> {
    if !bytes.starts_with(MARK) {
        return Err(StateError::Foreign { plugin: plugin.to_owned() }.into());
    }
    let (body, sum) = bytes.split_last_chunk::<WORD>().ok_or(StateError::Damaged)?;
    let mut rest = body.get(MARK.len()..).ok_or(StateError::Damaged)?;
    let found_version = word(&mut rest)?;
    let length = usize::try_from(word(&mut rest)?).map_err(|_| StateError::Damaged)?;
    let (found, content) = rest.split_at_checked(length).ok_or(StateError::Damaged)?;
    if checksum(body) != u64::from_le_bytes(*sum) {
        return Err(StateError::Damaged.into());
    }
    if found != plugin.as_bytes() {
        let found = String::from_utf8_lossy(found).into_owned();
        return Err(StateError::Plugin { found, expected: plugin.to_owned() }.into());
    }
    if found_version != u64::from(version) {
        let plugin = plugin.to_owned();
        return Err(StateError::Version { plugin, found: found_version, expected: u64::from(version) }.into());
    }
    let mut state = State(Direction::Load(content));
    visit(&mut state)?;
    match state.0 {
        Direction::Load([]) | Direction::Save(_) => Ok(()),
        Direction::Load(_) => Err(StateError::Content("more").into()),
    }
}

fn word(rest: &mut &[u8]) -> Result<u64, StateError> {
    let (word, after) = rest.split_first_chunk().ok_or(StateError::Damaged)?;
    *rest = after;
    Ok(u64::from_le_bytes(*word))
}

/// FNV-1a over words; it guards against accidents, not against intent.
fn checksum(bytes: &[u8]) -> u64 {
    let (words, rest) = bytes.as_chunks::<WORD>();
    let words = words.iter().map(|w| u64::from_le_bytes(*w)).chain(rest.iter().map(|b| u64::from(*b)));
    words.fold(0xcbf2_9ce4_8422_2325, |h, w| (h ^ w).wrapping_mul(0x0000_0100_0000_01b3).rotate_left(23))
}

/// A state being saved or loaded: every method writes the value that it is given, or replaces it by the one that was
/// saved.
#[derive(Debug)]
pub struct State<'a>(Direction<'a>);

#[derive(Debug)]
enum Direction<'a> {
    /// What was written.
    Save(Vec<u8>),
    /// What has not been read yet.
    Load(&'a [u8]),
}

impl State<'_> {
    /// Whether values are being replaced by those that were saved.
    pub fn is_loading(&self) -> bool {
        matches!(self.0, Direction::Load(_))
    }

    fn put(&mut self, bytes: &[u8]) {
        if let Direction::Save(out) = &mut self.0 {
            out.extend_from_slice(bytes);
        }
    }

    /// A whole number without sign.
    ///
    /// # Errors
    /// The state ends.
    pub fn u64(&mut self, value: &mut u64) -> Result<(), StateError> {
        match &mut self.0 {
            Direction::Save(out) => out.extend_from_slice(&value.to_le_bytes()),
            Direction::Load(rest) => *value = word(rest).map_err(|_| StateError::Content("less"))?,
        }
        Ok(())
    }

    /// A whole number, a time in Unix ns.
    ///
    /// # Errors
    /// The state ends.
    pub fn i64(&mut self, value: &mut i64) -> Result<(), StateError> {
        let mut bits = value.cast_unsigned();
        self.u64(&mut bits)?;
        *value = bits.cast_signed();
        Ok(())
    }

    /// A count or an index.
    ///
    /// # Errors
    /// The state ends, or the number is too large for this machine.
    pub fn usize(&mut self, value: &mut usize) -> Result<(), StateError> {
        let mut wide = *value as u64;
        self.u64(&mut wide)?;
        *value = usize::try_from(wide).map_err(|_| StateError::Content("a count"))?;
        Ok(())
    }

    /// A count of at most 32 bits.
    ///
    /// # Errors
    /// The state ends, or the number is too large.
    pub fn u32(&mut self, value: &mut u32) -> Result<(), StateError> {
        let mut wide = u64::from(*value);
        self.u64(&mut wide)?;
        *value = u32::try_from(wide).map_err(|_| StateError::Content("a count"))?;
        Ok(())
    }

    /// A flag.
    ///
    /// # Errors
    /// The state ends, or the word is neither 0 nor 1.
    pub fn flag(&mut self, value: &mut bool) -> Result<(), StateError> {
        let mut bits = u64::from(*value);
        self.u64(&mut bits)?;
        *value = match bits {
            0 => false,
            1 => true,
            _ => return Err(StateError::Content("a flag")),
        };
        Ok(())
    }

    /// A number, bit by bit.
    ///
    /// # Errors
    /// The state ends.
    pub fn f64(&mut self, value: &mut f64) -> Result<(), StateError> {
        let mut bits = value.to_bits();
        self.u64(&mut bits)?;
        *value = f64::from_bits(bits);
        Ok(())
    }

    /// Numbers, as many as there are in this run.
    ///
    /// # Errors
    /// The state ends.
    pub fn f64s<'v>(&mut self, values: impl IntoIterator<Item = &'v mut f64>) -> Result<(), StateError> {
        values.into_iter().try_for_each(|value| self.f64(value))
    }

    /// A list of numbers, as many as were saved.
    ///
    /// # Errors
    /// The state ends.
    pub fn f64_list(&mut self, values: &mut Vec<f64>) -> Result<(), StateError> {
        self.list(values, Self::f64)
    }

    /// A list of whole numbers, as many as were saved.
    ///
    /// # Errors
    /// The state ends.
    pub fn i64_list(&mut self, values: &mut Vec<i64>) -> Result<(), StateError> {
        self.list(values, Self::i64)
    }

    /// A list, as many entries as were saved; `visit` visits at least one word of each.
    ///
    /// # Errors
    /// The state ends, or those of `visit`.
    pub fn list<T: Default>(
        &mut self,
        values: &mut Vec<T>,
        mut visit: impl FnMut(&mut Self, &mut T) -> Result<(), StateError>,
    ) -> Result<(), StateError> {
        let count = self.count(values.len())?;
        if self.is_loading() {
            values.clear();
            values.resize_with(count, T::default);
        }
        values.iter_mut().try_for_each(|value| visit(self, value))
    }

    /// A queue, as [`Self::list`].
    ///
    /// # Errors
    /// As [`Self::list`].
    pub fn queue<T: Default>(
        &mut self,
        values: &mut VecDeque<T>,
        visit: impl FnMut(&mut Self, &mut T) -> Result<(), StateError>,
    ) -> Result<(), StateError> {
        // A queue and a list turn into each other without a copy of their entries.
        let mut list = Vec::from(std::mem::take(values));
        let visited = self.list(&mut list, visit);
        *values = list.into();
        visited
    }

    /// What may be missing.
    ///
    /// # Errors
    /// The state ends, or those of `visit`.
    pub fn option<T: Default>(
        &mut self,
        value: &mut Option<T>,
        visit: impl FnOnce(&mut Self, &mut T) -> Result<(), StateError>,
    ) -> Result<(), StateError> {
        let mut there = value.is_some();
        self.flag(&mut there)?;
        if self.is_loading() {
            *value = there.then(T::default);
        }
        value.as_mut().map_or(Ok(()), |value| visit(self, value))
    }

    /// A number of entries that follow, of a word at least each.
    ///
    /// # Errors
    /// The rest of the state cannot hold as many.
    pub fn count(&mut self, count: usize) -> Result<usize, StateError> {
        let mut count = count;
        self.usize(&mut count)?;
        match &self.0 {
            Direction::Load(rest) if count > rest.len() / WORD => Err(StateError::Content("a count")),
            _ => Ok(count),
        }
    }

    /// Bytes, as many as were saved.
    ///
    /// # Errors
    /// The state ends.
    pub fn bytes(&mut self, value: &mut Vec<u8>) -> Result<(), StateError> {
        let mut length = value.len();
        self.usize(&mut length)?;
        match &mut self.0 {
            Direction::Save(out) => out.extend_from_slice(value),
            Direction::Load(rest) => {
                let (taken, after) = rest.split_at_checked(length).ok_or(StateError::Content("a length"))?;
                (*value, *rest) = (taken.to_vec(), after);
            }
        }
        Ok(())
    }

    /// What must be the same in this run: a layout, the names of coefficients.
    ///
    /// # Errors
    /// It is another in the state.
    pub fn same(&mut self, what: &'static str, expected: &str) -> Result<(), StateError> {
        let mut found = expected.as_bytes().to_vec();
        self.bytes(&mut found)?;
        if found == expected.as_bytes() {
            return Ok(());
        }
        let found = String::from_utf8_lossy(&found).into_owned();
        Err(StateError::Differs { what, found, expected: expected.to_owned() })
    }

    /// Something that `serde` can write as JSON: no NaN and no infinity.
    ///
    /// # Errors
    /// It cannot be written, or is no such thing.
    pub fn document<T: Serialize + DeserializeOwned>(&mut self, value: &mut T) -> Result<(), StateError> {
        let mut text = Vec::new();
        if !self.is_loading() {
            text = serde_json::to_vec(value).map_err(|_| StateError::Content("a document"))?;
        }
        self.bytes(&mut text)?;
        if self.is_loading() {
            *value = serde_json::from_slice(&text).map_err(|_| StateError::Content("a document"))?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Clone, Debug, Default, PartialEq)]
    struct Sample {
        rows: u64,
        last_ns: Option<i64>,
        values: Vec<f64>,
        waiting: VecDeque<u32>,
        held: bool,
    }

    impl Sample {
        fn visit(&mut self, state: &mut State<'_>) -> Result<(), StateError> {
            state.same("model", "two coefficients")?;
            state.u64(&mut self.rows)?;
            state.option(&mut self.last_ns, State::i64)?;
            state.f64_list(&mut self.values)?;
            state.queue(&mut self.waiting, State::u32)?;
            state.flag(&mut self.held)
        }
    }

    fn sample() -> Sample {
        Sample {
            rows: 7,
            last_ns: Some(-5),
            values: vec![1.5, f64::INFINITY, -0.0],
            waiting: [3, 4].into(),
            held: true,
        }
    }

    fn saved() -> Vec<u8> {
        save("mine", 2, |state| sample().visit(state)).expect("nothing to refuse")
    }

    fn loaded(bytes: &[u8]) -> Result<Sample, StateError> {
        let mut value = Sample::default();
        load("mine", 2, bytes, |state| value.visit(state)).map(|()| value)
    }

    #[test]
    fn what_was_saved_comes_back() {
        assert_eq!(loaded(&saved()), Ok(sample()));
        let nothing = Sample::default();
        let bytes = save("mine", 2, |state| nothing.clone().visit(state)).expect("nothing to refuse");
        assert_eq!(loaded(&bytes), Ok(nothing));
    }

    #[test]
    fn every_flipped_bit_every_cut_and_every_addition_is_refused() {
        let bytes = saved();
        for bit in 0..bytes.len() * 8 {
            let mut bad = bytes.clone();
            bad[bit / 8] ^= 1 << (bit % 8);
            assert!(loaded(&bad).is_err(), "bit {bit}");
        }
        for length in 0..bytes.len() {
            assert!(loaded(&bytes[..length]).is_err(), "cut to {length}");
        }
        assert!(loaded(&[&bytes[..], &[0]].concat()).is_err());
        assert!(loaded(&[&bytes[..], &[0; 8]].concat()).is_err());
    }

    #[test]
    fn each_refusal_says_what_is_wrong() {
        let other = |plugin, version| save(plugin, version, |state| sample().visit(state)).expect("nothing to refuse");
        let older = loaded(b"ES-AKF\r\n and what an older version wrote").expect_err("older");
        assert!(older.to_string().contains("older version of the program"), "{older}");
        assert_eq!(loaded(&other("yours", 2)).expect_err("another's").to_string().find("plugin yours"), Some(23));
        let version = loaded(&other("mine", 1)).expect_err("another version");
        assert_eq!(version, StateError::Version { plugin: "mine".into(), found: 1, expected: 2 });
        let bytes = save("mine", 2, |state| state.same("model", "one coefficient")).expect("nothing to refuse");
        assert!(loaded(&bytes).expect_err("another model").to_string().contains("another model, one coefficient"));
    }

    /// A count is no reason to take memory: 2⁶⁰ entries would need eight exbibytes.
    #[test]
    fn a_count_beyond_the_bytes_is_refused_before_memory_is_taken() {
        for count in [4, 1 << 60, u64::MAX] {
            let bytes = save("mine", 2, |state| {
                state.u64(&mut count.clone())?;
                (0..3).try_for_each(|_| state.f64(&mut 0.0))
            });
            let bytes = bytes.expect("nothing to refuse");
            let read = load("mine", 2, &bytes, |state| state.f64_list(&mut Vec::new()));
            assert_eq!(read, Err(StateError::Content("a count")), "{count}");
            let read = load("mine", 2, &bytes, |state| state.bytes(&mut Vec::new()));
            assert!(read.is_err(), "{count}");
        }
    }
}
