//! State as bytes: little-endian words, nothing else. A state that does not fit is refused, never guessed at.

/// Why a saved state was refused.
#[derive(Debug, thiserror::Error, PartialEq, Eq)]
pub(crate) enum StateError {
    #[error("state of preprocess ends after {0} bytes in the middle of a value; it was cut, take an older one")]
    Truncated(usize),
    #[error("state of preprocess has {0} bytes too many; it is no state of this version, start without it")]
    Trailing(usize),
    #[error(
        "state of preprocess was saved with another {0}; run with the pipeline, mission and topics that saved it, or \
         start without it"
    )]
    Foreign(&'static str),
}

/// Appends values to a state.
#[derive(Default)]
pub(crate) struct Writer(pub(crate) Vec<u8>);

impl Writer {
    pub(crate) fn u64(&mut self, value: u64) {
        self.0.extend_from_slice(&value.to_le_bytes());
    }
    pub(crate) fn i64(&mut self, value: i64) {
        self.0.extend_from_slice(&value.to_le_bytes());
    }
    pub(crate) fn f64(&mut self, value: f64) {
        self.u64(value.to_bits());
    }
    pub(crate) fn flag(&mut self, value: bool) {
        self.u64(u64::from(value));
    }
    pub(crate) fn option(&mut self, value: Option<i64>) {
        self.flag(value.is_some());
        self.i64(value.unwrap_or(0));
    }
    pub(crate) fn i64s(&mut self, values: &[i64]) {
        self.u64(values.len() as u64);
        values.iter().for_each(|v| self.i64(*v));
    }
    pub(crate) fn f64s(&mut self, values: &[f64]) {
        self.u64(values.len() as u64);
        values.iter().for_each(|v| self.f64(*v));
    }
    pub(crate) fn text(&mut self, text: &str) {
        self.u64(text.len() as u64);
        self.0.extend_from_slice(text.as_bytes());
    }
}

/// Takes values from a state.
pub(crate) struct Reader<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl<'a> Reader<'a> {
    pub(crate) fn new(bytes: &'a [u8]) -> Self {
        Self { bytes, at: 0 }
    }
    fn take(&mut self, count: usize) -> Result<&'a [u8], StateError> {
        let end = self.at.checked_add(count).filter(|end| *end <= self.bytes.len());
        let end = end.ok_or(StateError::Truncated(self.bytes.len()))?;
        let taken = &self.bytes[self.at..end];
        self.at = end;
        Ok(taken)
    }
    pub(crate) fn u64(&mut self) -> Result<u64, StateError> {
        let mut word = [0; 8];
        word.copy_from_slice(self.take(8)?);
        Ok(u64::from_le_bytes(word))
    }
    pub(crate) fn i64(&mut self) -> Result<i64, StateError> {
        Ok(self.u64()?.cast_signed())
    }
    pub(crate) fn f64(&mut self) -> Result<f64, StateError> {
        Ok(f64::from_bits(self.u64()?))
    }
    pub(crate) fn flag(&mut self) -> Result<bool, StateError> {
        match self.u64()? {
            0 => Ok(false),
            1 => Ok(true),
            _ => Err(StateError::Foreign("layout")),
        }
    }
    pub(crate) fn option(&mut self) -> Result<Option<i64>, StateError> {
        let there = self.flag()?;
        let value = self.i64()?;
        if !there && value != 0 {
            return Err(StateError::Foreign("layout"));
        }
        Ok(there.then_some(value))
    }
    /// A count of things of `size` bytes each, no more than the rest of the state can hold.
    pub(crate) fn count(&mut self, size: usize) -> Result<usize, StateError> {
        let count = usize::try_from(self.u64()?).unwrap_or(usize::MAX);
        if count.saturating_mul(size) > self.bytes.len() - self.at {
            return Err(StateError::Truncated(self.bytes.len()));
        }
        Ok(count)
    }
    pub(crate) fn i64s(&mut self) -> Result<Vec<i64>, StateError> {
        (0..self.count(8)?).map(|_| self.i64()).collect()
    }
    pub(crate) fn f64s(&mut self) -> Result<Vec<f64>, StateError> {
        (0..self.count(8)?).map(|_| self.f64()).collect()
    }
    pub(crate) fn text_is(&mut self, expected: &str, what: &'static str) -> Result<(), StateError> {
        let count = self.count(1)?;
        if self.take(count)? == expected.as_bytes() { Ok(()) } else { Err(StateError::Foreign(what)) }
    }
    pub(crate) fn end(&self) -> Result<(), StateError> {
        match self.bytes.len() - self.at {
            0 => Ok(()),
            rest => Err(StateError::Trailing(rest)),
        }
    }
}
