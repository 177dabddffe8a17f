//! States as bytes: little-endian words under a header with magic, version and layout, and a checksum at the end.

/// Why a saved state was refused.
#[derive(Debug, thiserror::Error, PartialEq, Eq)]
pub enum StateError {
    /// Not written by this stage.
    #[error("saved state does not begin with the mark of es-akf: it belongs to another plugin or is damaged")]
    Magic,
    /// Written by another version.
    #[error(
        "saved state has layout version {found}, this es-akf reads {VERSION}: start anew from an older checkpoint or replay"
    )]
    Version {
        /// Version in the header.
        found: u64,
    },
    /// Written for another model or mission.
    #[error(
        "saved state was written for \"{found}\", this run has \"{expected}\": start anew after a change of model or mission"
    )]
    Layout {
        /// Layout in the header.
        found: String,
        /// Layout of this run.
        expected: String,
    },
    /// Cut off or too long.
    #[error("saved state has {found} bytes where {expected} belong: it is cut off or damaged")]
    Length {
        /// Bytes given.
        found: usize,
        /// Bytes needed.
        expected: usize,
    },
    /// Bits have changed.
    #[error("saved state fails its checksum: it is damaged")]
    Checksum,
    /// A word has no sense.
    #[error("saved state holds {0} out of its range: it is damaged")]
    Content(&'static str),
}

const MAGIC: &[u8; 8] = b"ES-AKF\r\n";
/// Version of the layout of saved states.
const VERSION: u64 = 3;

/// Bytes of a state being written.
pub type Bytes = Vec<u8>;

/// Either direction of the same list of words.
#[derive(Debug)]
pub enum Words<'a> {
    /// Appends.
    Write(&'a mut Bytes),
    /// Takes from the front.
    Read(&'a [u8]),
}

impl Words<'_> {
    fn word(&mut self, bits: &mut u64) -> Result<(), StateError> {
        match self {
            Self::Write(out) => out.extend_from_slice(&bits.to_le_bytes()),
            Self::Read(left) => {
                let (word, rest) =
                    left.split_first_chunk().ok_or(StateError::Length { found: left.len(), expected: 8 })?;
                *bits = u64::from_le_bytes(*word);
                *left = rest;
            }
        }
        Ok(())
    }

    /// Numbers, bit by bit.
    ///
    /// # Errors
    /// [`StateError::Length`] at the end of the bytes.
    pub fn all(&mut self, values: &mut [f64]) -> Result<(), StateError> {
        for value in values {
            let mut bits = value.to_bits();
            self.word(&mut bits)?;
            *value = f64::from_bits(bits);
        }
        Ok(())
    }

    /// Nothing may be left.
    ///
    /// # Errors
    /// [`StateError::Length`] when something is.
    pub fn end(&self) -> Result<(), StateError> {
        match self {
            Self::Read(left) if !left.is_empty() => Err(StateError::Length { found: left.len(), expected: 0 }),
            _ => Ok(()),
        }
    }

    /// A count.
    ///
    /// # Errors
    /// [`StateError::Length`] at the end of the bytes.
    pub fn count(&mut self, value: &mut u64) -> Result<(), StateError> {
        self.word(value)
    }

    /// A flag.
    ///
    /// # Errors
    /// [`StateError::Length`] at the end of the bytes, [`StateError::Content`] when it is neither 0 nor 1.
    pub fn flag(&mut self, value: &mut bool) -> Result<(), StateError> {
        let mut bits = u64::from(*value);
        self.word(&mut bits)?;
        *value = match bits {
            0 => false,
            1 => true,
            _ => return Err(StateError::Content("a flag")),
        };
        Ok(())
    }
}

/// Wraps a state: magic, version, the layout that it belongs to, the words, a checksum.
#[must_use]
pub fn seal(layout: &str, words: &[u8]) -> Bytes {
    let mut out = Vec::with_capacity(words.len() + layout.len() + 40);
    out.extend_from_slice(MAGIC);
    out.extend_from_slice(&VERSION.to_le_bytes());
    out.extend_from_slice(&(layout.len() as u64).to_le_bytes());
    out.extend_from_slice(layout.as_bytes());
    out.extend_from_slice(words);
    out.extend_from_slice(&fnv1a(&out).to_le_bytes());
    out
}

/// Unwraps what [`seal`] wrote for the same layout.
///
/// # Errors
/// Every way in which it can differ is a [`StateError`] of its own.
pub fn unseal<'a>(layout: &str, bytes: &'a [u8]) -> Result<&'a [u8], StateError> {
    let short = StateError::Length { found: bytes.len(), expected: layout.len() + 32 };
    let rest = bytes.strip_prefix(MAGIC).ok_or(StateError::Magic)?;
    let Some((version, rest)) = rest.split_first_chunk() else { return Err(short) };
    let found = u64::from_le_bytes(*version);
    if found != VERSION {
        return Err(StateError::Version { found });
    }
    let Some((body, checksum)) = bytes.split_last_chunk() else { return Err(short) };
    if fnv1a(body) != u64::from_le_bytes(*checksum) {
        return Err(StateError::Checksum);
    }
    let Some((length, rest)) = rest[..rest.len() - 8].split_first_chunk() else { return Err(short) };
    let length = usize::try_from(u64::from_le_bytes(*length)).map_err(|_| StateError::Content("a length"))?;
    let Some((found, words)) = rest.split_at_checked(length) else { return Err(short) };
    if found != layout.as_bytes() {
        let found = String::from_utf8_lossy(found).into_owned();
        return Err(StateError::Layout { found, expected: layout.to_owned() });
    }
    Ok(words)
}

/// FNV-1a, 64 bits.
fn fnv1a(bytes: &[u8]) -> u64 {
    bytes.iter().fold(0xcbf2_9ce4_8422_2325, |h, &b| (h ^ u64::from(b)).wrapping_mul(0x0100_0000_01b3))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_single_flipped_bit_and_every_cut_is_refused() {
        let sealed = seal("22 states", &[7; 24]);
        assert_eq!(unseal("22 states", &sealed).as_deref(), Ok(&[7; 24][..]));
        for bit in 0..sealed.len() * 8 {
            let mut bad = sealed.clone();
            bad[bit / 8] ^= 1 << (bit % 8);
            assert!(unseal("22 states", &bad).is_err(), "bit {bit}");
        }
        for length in 0..sealed.len() {
            assert!(unseal("22 states", &sealed[..length]).is_err(), "cut to {length}");
        }
    }

    #[test]
    fn another_model_is_told_apart_from_damage() {
        let error = unseal("16 states", &seal("22 states", &[])).expect_err("another layout");
        assert_eq!(error, StateError::Layout { found: "22 states".into(), expected: "16 states".into() });
        assert_eq!(unseal("22 states", b"some other file of bytes"), Err(StateError::Magic));
    }
}
