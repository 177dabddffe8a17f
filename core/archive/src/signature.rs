//! Signatures made with minisign: of a lock of plugins, and of what a set of calibrations says.

use crate::files::read_text;
use minisign_verify::Signature;
use std::path::{Path, PathBuf};

/// Longest signature, or file of a key, bytes. A signature has some 300, and its comments at most 9,000 more.
const SIGNATURE_BYTES: u64 = 16 << 10;

/// The public key of who vouches for something.
#[derive(Clone, Debug)]
pub struct PublicKey {
    key: minisign_verify::PublicKey,
    base64: String,
}

impl PublicKey {
    /// From a file that `minisign -G` has written, or from the text of the key itself.
    ///
    /// # Errors
    /// A sentence: it is no such key, and no file with one.
    pub fn of(given: &str) -> Result<Self, String> {
        match read_text(Path::new(given), SIGNATURE_BYTES) {
            Ok(text) => Self::parse(&text),
            Err(error) => Self::parse(given).map_err(|what| format!("{what}, and no file with one: {error}")),
        }
    }

    /// From the text of such a file, or from its second line alone.
    fn parse(text: &str) -> Result<Self, String> {
        let key = match text.trim().lines().count() {
            1 => minisign_verify::PublicKey::from_base64(text.trim()),
            _ => minisign_verify::PublicKey::decode(text),
        };
        let key = key.map_err(|error| format!("is no public key of minisign: {error}"))?;
        let base64 = text.trim().lines().last().unwrap_or_default().trim().to_owned();
        Ok(Self { key, base64 })
    }

    /// That the `text` of a file was signed by the owner of the key, in the file `.minisig` beside it.
    ///
    /// # Errors
    /// A sentence: it was not, or there is no signature.
    pub fn check(&self, path: &Path, text: &str) -> Result<(), String> {
        let beside = PathBuf::from(format!("{}.minisig", path.display()));
        let signature = read_text(&beside, SIGNATURE_BYTES).map_err(|error| {
            format!("{} cannot be read: {error}; `minisign -S -m {}` signs", beside.display(), path.display())
        })?;
        let refuse = |error| format!("{} is not signed with the key that was given: {error}", path.display());
        let signature = Signature::decode(&signature).map_err(refuse)?;
        self.key.verify(text.as_bytes(), &signature, false).map_err(refuse)
    }
}

impl std::fmt::Display for PublicKey {
    /// As minisign writes it, without the comment.
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.base64)
    }
}
