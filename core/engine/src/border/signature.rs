//! Signatures of `plugins.lock`, made with minisign.

use minisign_verify::{PublicKey, Signature};
use std::path::{Path, PathBuf};

use crate::input::read_text;
use crate::limits::NAME_BYTES;

/// The public key of who vouches for plugins.
#[derive(Clone, Debug)]
pub struct PluginKey(PublicKey);

impl PluginKey {
    /// From the text of a file that `minisign -G` has written, or from its second line alone.
    ///
    /// # Errors
    /// A sentence: it is no such key.
    pub fn parse(text: &str) -> Result<Self, String> {
        let key = match text.trim().lines().count() {
            1 => PublicKey::from_base64(text.trim()),
            _ => PublicKey::decode(text),
        };
        key.map(Self).map_err(|error| format!("is no public key of minisign: {error}"))
    }

    /// That the `text` of a file was signed by the owner of the key, in the file `.minisig` beside it.
    ///
    /// # Errors
    /// A sentence: it was not, or there is no signature.
    pub(super) fn check(&self, path: &Path, text: &str) -> Result<(), String> {
        let beside = PathBuf::from(format!("{}.minisig", path.display()));
        let signature = read_text(&beside, 4 * NAME_BYTES as u64).map_err(|error| {
            format!("{} cannot be read: {error}; `minisign -S -m {}` signs", beside.display(), path.display())
        })?;
        let refuse = |error| format!("{} is not signed with the key of --plugin-key: {error}", path.display());
        let signature = Signature::decode(&signature).map_err(refuse)?;
        self.0.verify(text.as_bytes(), &signature, false).map_err(refuse)
    }
}
