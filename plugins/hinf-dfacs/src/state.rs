//! The stage's state as bytes: little-endian numbers in a fixed order. JSON would lose NaN.

/// A saved state that is not ours.
#[derive(Debug, thiserror::Error)]
pub enum StateError {
    /// It does not begin as ours do.
    #[error(
        "this is no state of hinf-dfacs {expected}; start from the beginning of the data, or from that version's state"
    )]
    Foreign {
        /// What it should begin with.
        expected: &'static str,
    },
    /// It ends early, or holds more than it should.
    #[error(
        "state of hinf-dfacs: {what} at byte {at} of {length}; it is damaged, or was saved with another mission or model file"
    )]
    Damaged {
        /// What is wrong.
        what: &'static str,
        /// Where.
        at: usize,
        /// Length of the whole.
        length: usize,
    },
    /// The control law refuses its part.
    #[error(transparent)]
    ControlLaw(#[from] dragfree_physics::control::StateError),
}

/// Puts a state together.
#[derive(Debug, Default)]
pub(crate) struct Writer(pub(crate) Vec<u8>);

impl Writer {
    pub(crate) fn numbers(&mut self, values: &[f64]) {
        for value in values {
            self.0.extend_from_slice(&value.to_le_bytes());
        }
    }

    pub(crate) fn count(&mut self, value: u64) {
        self.0.extend_from_slice(&value.to_le_bytes());
    }

    pub(crate) fn time(&mut self, value_ns: i64) {
        self.0.extend_from_slice(&value_ns.to_le_bytes());
    }

    pub(crate) fn flag(&mut self, value: bool) {
        self.0.push(u8::from(value));
    }

    pub(crate) fn optional(&mut self, values: Option<&[f64]>) {
        self.flag(values.is_some());
        self.numbers(values.unwrap_or_default());
    }
}

/// Takes a state apart.
#[derive(Debug)]
pub(crate) struct Reader<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl<'a> Reader<'a> {
    pub(crate) fn new(bytes: &'a [u8]) -> Self {
        Self { bytes, at: 0 }
    }

    pub(crate) fn damaged(&self, what: &'static str) -> StateError {
        StateError::Damaged { what, at: self.at, length: self.bytes.len() }
    }

    pub(crate) fn bytes<const N: usize>(&mut self) -> Result<[u8; N], StateError> {
        let chunk = self.bytes.get(self.at..).and_then(<[u8]>::first_chunk::<N>).copied();
        let chunk = chunk.ok_or_else(|| self.damaged("it ends"))?;
        self.at += N;
        Ok(chunk)
    }

    pub(crate) fn numbers(&mut self, values: &mut [f64]) -> Result<(), StateError> {
        for value in values {
            *value = f64::from_le_bytes(self.bytes()?);
        }
        Ok(())
    }

    pub(crate) fn count(&mut self) -> Result<u64, StateError> {
        self.bytes().map(u64::from_le_bytes)
    }

    pub(crate) fn time(&mut self) -> Result<i64, StateError> {
        self.bytes().map(i64::from_le_bytes)
    }

    /// A number of things that follow, at most `most`.
    pub(crate) fn length(&mut self, most: usize) -> Result<usize, StateError> {
        let count = self.count()?;
        usize::try_from(count).ok().filter(|n| *n <= most).ok_or_else(|| self.damaged("there is an impossible count"))
    }

    pub(crate) fn flag(&mut self) -> Result<bool, StateError> {
        match self.bytes()? {
            [0] => Ok(false),
            [1] => Ok(true),
            _ => Err(self.damaged("there is an impossible flag")),
        }
    }

    pub(crate) fn optional<const N: usize>(&mut self) -> Result<Option<[f64; N]>, StateError> {
        if !self.flag()? {
            return Ok(None);
        }
        let mut values = [0.0; N];
        self.numbers(&mut values)?;
        Ok(Some(values))
    }

    /// What has not been read yet.
    pub(crate) fn rest(&self) -> &'a [u8] {
        &self.bytes[self.at..]
    }

    pub(crate) fn end(&self) -> Result<(), StateError> {
        if self.at == self.bytes.len() { Ok(()) } else { Err(self.damaged("there is more than belongs")) }
    }
}
