//! What a simulation hides: a file that nobody reads by accident, whose digest stands in the telemetry, so that nobody
//! changes it unseen either.

use serde_json::{Value, json};
use std::fs::File;
use std::io::{Read as _, Write as _};
use std::path::{Path, PathBuf};

use dragfree_archive::files::{IoContext as _, IoError, hex, sha256};

/// Key of the digest in the Metadata record of every telemetry file of the simulation.
pub const DIGEST_KEY: &str = "sealed_sha256";
const FORMAT: &str = "dragfree-sealed/1";
/// The Metadata record stands before the first channel, far within these bytes.
const HEAD_BYTES: u64 = 1 << 20;

/// Why a sealed file cannot be written or opened.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "every field is named in its sentence")]
pub enum SealedError {
    /// The operating system refused something.
    #[error(transparent)]
    Io(#[from] IoError),
    /// Another sealed file is there.
    #[error("{} exists already, holds something else and is not overwritten; choose another folder with --out", .0.display())]
    Exists(PathBuf),
    /// The file is none.
    #[error("{} is no sealed file: {reason}; `dragfree simulate --hidden` writes them as truth/*.sealed.json", path.display())]
    Form { path: PathBuf, reason: String },
    /// The telemetry belongs to another sealed file, or this one was changed.
    #[error(
        "{}: its SHA-256 is {found}, the telemetry {} was made with {expected}; it was changed or is another simulation's",
        path.display(), telemetry.display()
    )]
    Digest { path: PathBuf, found: String, telemetry: PathBuf, expected: String },
    /// The telemetry tells no digest.
    #[error("{} names no sealed file; it was simulated without --hidden", .0.display())]
    NoDigest(PathBuf),
}

/// A sealed file's bytes and their digest.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Sealed {
    bytes: Vec<u8>,
    /// SHA-256 of the file, hexadecimal.
    pub sha256: String,
}

fn from_hex(text: &str) -> Option<Vec<u8>> {
    let pair = |at: usize| u8::from_str_radix(text.get(at..at + 2)?, 16).ok();
    (0..text.len()).step_by(2).map(pair).collect()
}

impl Sealed {
    /// Seals a text.
    pub fn new(content: &str) -> Self {
        let file = json!({
            "format": FORMAT,
            "about": "what this simulation hides, in hexadecimal; `dragfree reveal` opens it",
            "payload": hex(content.as_bytes()),
        });
        let bytes = format!("{file:#}\n").into_bytes();
        Self { sha256: sha256(&bytes), bytes }
    }

    /// Writes the file; one with the same bytes, of an interrupted run, may be there.
    ///
    /// # Errors
    /// [`SealedError::Exists`], [`SealedError::Io`].
    pub fn write(&self, path: &Path) -> Result<(), SealedError> {
        if path.exists() {
            let there = std::fs::read(path).at("read", path)?;
            return if there == self.bytes { Ok(()) } else { Err(SealedError::Exists(path.to_owned())) };
        }
        if let Some(folder) = path.parent() {
            std::fs::create_dir_all(folder).at("make the folder of", path)?;
        }
        let mut file = File::create_new(path).at("write", path)?;
        Ok(file.write_all(&self.bytes).and_then(|()| file.sync_all()).at("write", path)?)
    }

    /// Reads a file.
    ///
    /// # Errors
    /// [`SealedError::Io`].
    pub fn read(path: &Path) -> Result<Self, SealedError> {
        let bytes = std::fs::read(path).at("read", path)?;
        Ok(Self { sha256: sha256(&bytes), bytes })
    }

    /// What is in it. `path` is for messages.
    ///
    /// # Errors
    /// [`SealedError::Form`].
    pub fn content(&self, path: &Path) -> Result<Value, SealedError> {
        let form = |reason: &str| SealedError::Form { path: path.to_owned(), reason: reason.to_owned() };
        let file: Value = serde_json::from_slice(&self.bytes).map_err(|e| form(&e.to_string()))?;
        if file["format"] != FORMAT {
            return Err(form("its format is another"));
        }
        let payload = file["payload"].as_str().and_then(from_hex).ok_or_else(|| form("its payload is damaged"))?;
        serde_json::from_slice(&payload).map_err(|e| form(&e.to_string()))
    }

    /// Checks that telemetry was made with this sealed file: each of `files`, or, where there is none, each in the
    /// folder above that names a digest. Gives the files that agree; `path` is where this was read.
    ///
    /// # Errors
    /// [`SealedError::Digest`], [`SealedError::NoDigest`], [`SealedError::Io`].
    pub fn check(&self, path: &Path, files: &[PathBuf]) -> Result<Vec<PathBuf>, SealedError> {
        let asked = !files.is_empty();
        let files = if asked { files.to_vec() } else { telemetry_above(path) };
        let mut agree = Vec::new();
        for telemetry in files {
            match digest_of(&telemetry)? {
                None if asked => return Err(SealedError::NoDigest(telemetry)),
                None => {}
                Some(expected) if expected == self.sha256 => agree.push(telemetry),
                Some(expected) => {
                    let (path, found) = (path.to_owned(), self.sha256.clone());
                    return Err(SealedError::Digest { path, found, telemetry, expected });
                }
            }
        }
        Ok(agree)
    }
}

/// Telemetry in the folder that holds the folder of a sealed file, in order.
fn telemetry_above(path: &Path) -> Vec<PathBuf> {
    let folder = path.canonicalize().ok().and_then(|p| Some(p.parent()?.parent()?.to_owned()));
    let entries = folder.and_then(|folder| std::fs::read_dir(folder).ok());
    let paths = entries.into_iter().flatten().flatten().map(|entry| entry.path());
    let mut files: Vec<PathBuf> = paths.filter(|p| p.extension().is_some_and(|e| e == "mcap")).collect();
    files.sort();
    files
}

/// The digest that a telemetry file tells; `None` where it tells none.
fn digest_of(telemetry: &Path) -> Result<Option<String>, SealedError> {
    let mut head = Vec::new();
    File::open(telemetry).and_then(|file| file.take(HEAD_BYTES).read_to_end(&mut head)).at("read", telemetry)?;
    let ignore_end = mcap::read::Options::IgnoreEndMagic.into();
    let Ok(records) = mcap::read::LinearReader::new_with_options(&head, ignore_end) else { return Ok(None) };
    Ok(records.map_while(Result::ok).find_map(|record| match record {
        mcap::records::Record::Metadata(m) if m.name == "dragfree" => m.metadata.get(DIGEST_KEY).cloned(),
        _ => None,
    }))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_sealed_opens_and_nothing_of_it_shows() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("truth/a.sealed.json");
        let sealed = Sealed::new(r#"{"effects": ["es-gain"]}"#);
        sealed.write(&path).unwrap();
        sealed.write(&path).unwrap();
        let text = std::fs::read_to_string(&path).unwrap();
        assert!(!text.contains("es-gain") && !text.contains("effects"), "{text}");
        let read = Sealed::read(&path).unwrap();
        assert_eq!(read, sealed);
        assert_eq!(read.content(&path).unwrap(), json!({"effects": ["es-gain"]}));
        let other = Sealed::new("{}");
        assert!(matches!(other.write(&path), Err(SealedError::Exists(_))));
    }

    #[test]
    fn what_is_no_sealed_file_is_told() {
        let folder = tempfile::tempdir().unwrap();
        for (text, told) in [
            ("", "EOF"),
            ("{}", "format"),
            (r#"{"format": "dragfree-sealed/1", "payload": "7"}"#, "payload"),
            (r#"{"format": "dragfree-sealed/1", "payload": "zz"}"#, "payload"),
            (r#"{"format": "dragfree-sealed/1", "payload": "7b"}"#, "EOF"),
        ] {
            let path = folder.path().join("a.sealed.json");
            std::fs::write(&path, text).unwrap();
            let error = Sealed::read(&path).unwrap().content(&path).unwrap_err().to_string();
            assert!(error.contains(told) && error.contains("no sealed file"), "{text}: {error}");
        }
        assert!(Sealed::read(&folder.path().join("none")).is_err());
    }
}
