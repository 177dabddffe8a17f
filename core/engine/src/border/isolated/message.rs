//! What two processes say to each other of an instance: a head of two lengths, a JSON text, bytes.

use dragfree_schema::Manifest;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use std::io::{self, Read, Write};
use std::path::PathBuf;

use super::super::BorderError;
use super::super::library::Kind;
use super::super::link::Linked;
use crate::limits::MESSAGE_BYTES;
use crate::table::Column;

/// What the child is asked.
#[derive(Debug, Serialize, Deserialize)]
pub(super) enum Ask {
    /// First of all: open a library behind the sandbox. Answered by [`Answer::Opened`].
    Open {
        path: PathBuf,
        sha256: String,
        /// Files that may be read.
        files: Vec<PathBuf>,
    },
    Create {
        kind: Kind,
        index: u32,
        config: serde_json::Value,
    },
    Link {
        available: Vec<Column>,
        model_json: String,
    },
    Activate {
        max_rows: u32,
    },
    /// Rows of each input table; they lie in the memory that the parent writes.
    Process {
        rows: Vec<usize>,
        complete_until_ns: i64,
    },
    Next {
        rows: u32,
    },
    Flush,
    /// The earlier reports follow as bytes.
    Report,
    Save,
    /// The state follows as bytes.
    Load,
    /// Destroys the instance.
    Destroy,
}

/// What it answers; lines of a log may come before.
#[derive(Debug, Serialize, Deserialize)]
pub(super) enum Answer {
    Log {
        level: i32,
        text: String,
    },
    Opened {
        plugins: Vec<(Kind, u32, Manifest)>,
        /// Parts of the sandbox that this kernel does not have.
        lacking: Vec<String>,
    },
    Done,
    Linked(Linked),
    /// Rows of each written table; they lie in the memory that the child writes.
    Rows {
        rows: Vec<usize>,
        complete_until_ns: i64,
        done: bool,
    },
    /// The batch was discarded.
    Discarded,
    /// A report or a state follows as bytes; false where the plugin has none.
    Bytes(bool),
    Failed {
        kind: Failed,
        message: String,
    },
}

/// Which error of the border it was.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub(super) enum Failed {
    Refused,
    Plugin,
    Rule,
    Link,
}

impl Answer {
    pub(super) fn of(error: BorderError) -> Self {
        let (kind, message) = match error {
            BorderError::Refused { reason, .. } => (Failed::Refused, reason),
            BorderError::Plugin { message, .. } => (Failed::Plugin, message),
            BorderError::Rule { what, .. } => (Failed::Rule, what),
            BorderError::Link { sentence, .. } => (Failed::Link, sentence),
        };
        Self::Failed { kind, message }
    }
}

/// Sends a message.
pub(super) fn send(to: &mut impl Write, message: &impl Serialize, bytes: &[u8]) -> io::Result<()> {
    let text = serde_json::to_vec(message)?;
    let mut head = [0; 16];
    head[..8].copy_from_slice(&(text.len() as u64).to_le_bytes());
    head[8..].copy_from_slice(&(bytes.len() as u64).to_le_bytes());
    to.write_all(&[&head[..], &text].concat())?;
    to.write_all(bytes)
}

/// Receives a message with at most so many bytes behind it.
pub(super) fn receive<T: DeserializeOwned>(from: &mut impl Read, most: usize) -> io::Result<(T, Vec<u8>)> {
    let mut head = [0; 16];
    from.read_exact(&mut head)?;
    let length = |part: &[u8]| part.iter().rev().fold(0_u64, |all, byte| all << 8 | u64::from(*byte));
    let mut part = |length: u64, most: usize| {
        if length > most as u64 {
            return Err(io::Error::new(io::ErrorKind::InvalidData, format!("a message of {length} bytes")));
        }
        let mut bytes = Vec::new();
        from.take(length).read_to_end(&mut bytes)?;
        if (bytes.len() as u64) < length { Err(io::ErrorKind::UnexpectedEof.into()) } else { Ok(bytes) }
    };
    let text = part(length(&head[..8]), MESSAGE_BYTES)?;
    let bytes = part(length(&head[8..]), most)?;
    let message = serde_json::from_slice(&text);
    Ok((
        message.map_err(|e| io::Error::new(io::ErrorKind::InvalidData, format!("a message that is none: {e}")))?,
        bytes,
    ))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn any_bytes_are_a_message_or_an_error(bytes in proptest::collection::vec(any::<u8>(), 0..200)) {
            let _ = receive::<Answer>(&mut bytes.as_slice(), 100);
            let mut framed = Vec::new();
            framed.extend((bytes.len() as u64).to_le_bytes());
            framed.extend(0_u64.to_le_bytes());
            framed.extend(&bytes);
            prop_assert!(receive::<Answer>(&mut framed.as_slice(), 0).is_err());
        }
    }

    #[test]
    fn a_message_comes_out_as_it_went_in() {
        let mut sent = Vec::new();
        send(&mut sent, &Ask::Process { rows: vec![3, 0], complete_until_ns: i64::MIN }, b"abc").unwrap();
        let (ask, bytes) = receive::<Ask>(&mut sent.as_slice(), 3).unwrap();
        assert!(matches!(ask, Ask::Process { rows, complete_until_ns: i64::MIN } if rows == [3, 0]));
        assert_eq!(bytes, b"abc");
        assert!(receive::<Ask>(&mut sent.as_slice(), 2).is_err(), "more bytes than are taken");
        assert!(receive::<Ask>(&mut &sent[..sent.len() - 1], 3).is_err(), "cut");
        // Lengths that no memory has.
        assert!(receive::<Ask>(&mut [255_u8; 16].as_slice(), 3).is_err());
    }
}
