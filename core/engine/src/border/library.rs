//! Plugin libraries: checked, opened, their manifests read.

use dragfree_abi as abi;
use dragfree_schema::Manifest;
use serde::{Deserialize, Serialize};
use std::ffi::{CStr, CString};
use std::mem::ManuallyDrop;
use std::path::{Path, PathBuf};

use super::BorderError;
use super::crash::{self, Name};

/// What a plugin is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Kind {
    /// Makes telemetry.
    Source,
    /// Turns columns into columns.
    Stage,
    /// Turns columns into regressors.
    Effect,
}

impl Kind {
    /// All of them.
    pub const ALL: [Self; 3] = [Self::Source, Self::Stage, Self::Effect];

    fn factory_id(self) -> &'static str {
        match self {
            Self::Source => abi::SOURCE_V1,
            Self::Stage => abi::STAGE_V1,
            Self::Effect => abi::EFFECT_V1,
        }
    }
}

impl std::fmt::Display for Kind {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.serialize(f)
    }
}

/// One plugin of a library.
#[derive(Clone, Debug, Serialize)]
pub struct PluginInfo {
    /// Source, stage or effect.
    pub kind: Kind,
    /// Its index in the factory.
    #[serde(skip)]
    pub index: u32,
    /// Its manifest.
    pub manifest: Manifest,
}

/// An open plugin library; never closed.
#[derive(Debug)]
pub struct Library {
    /// The file.
    pub path: PathBuf,
    /// Its digest, lower-case hexadecimal.
    pub sha256: String,
    /// What it holds.
    pub plugins: Vec<PluginInfo>,
    entry: &'static abi::EntryV1,
}

impl Library {
    /// Checks a file, opens it and reads its manifests.
    ///
    /// # Errors
    /// [`BorderError::Refused`] with the reason: writable by everybody, not in `plugins.lock`, no shared library, no
    /// plugin, another ABI version, a manifest that cannot be read.
    pub fn open(path: &Path) -> Result<Self, BorderError> {
        let refuse = |reason: String| BorderError::Refused { path: path.to_owned(), reason };
        let bytes = std::fs::read(path).map_err(|e| refuse(format!("cannot be read: {e}")))?;
        let sha256 = dragfree_archive::files::sha256(&bytes);
        check_permissions(path).map_err(&refuse)?;
        check_lock(path, &sha256).map_err(&refuse)?;
        crash::install();
        Name::of(&path.to_string_lossy()).during("open", || Self::load(path, sha256))
    }

    /// Opens a file that was checked: what runs code of the library.
    fn load(path: &Path, sha256: String) -> Result<Self, BorderError> {
        let refuse = |reason: String| BorderError::Refused { path: path.to_owned(), reason };
        // SAFETY: opening a library runs its initialisers; the operator vouches for the plugin folder, and the checks
        // above refuse a file that somebody else could have changed.
        let library = unsafe { libloading::Library::new(path) }
            .map_err(|e| refuse(format!("is no shared library that this machine can load: {e}")))?;
        let library = ManuallyDrop::new(library);
        // SAFETY: the header defines the symbol as data of this type; its first field is read before anything else.
        let symbol = unsafe { library.get::<*const abi::EntryV1>(abi::ENTRY_SYMBOL) }
            .map_err(|_| refuse("exports no `dragfree_entry`: it is no dragfree plugin".to_owned()))?;
        // SAFETY: the symbol's address outlives the handle, which is never closed.
        let entry =
            unsafe { symbol.try_as_raw_ptr() }.map_or(std::ptr::null(), |p| p.cast::<abi::EntryV1>().cast_const());
        if entry.is_null() {
            return Err(refuse("exports a null `dragfree_entry`".to_owned()));
        }
        // SAFETY: `abi_version` is the first field in every version of the struct; reading it alone is always sound.
        let version = unsafe { *entry.cast::<u32>() };
        if version != abi::ABI_VERSION {
            return Err(refuse(format!(
                "was built for ABI version {version}, this host speaks version {}; rebuild it with this host's plugin.h",
                abi::ABI_VERSION
            )));
        }
        // SAFETY: the version matches, so the whole struct is there; the library is never closed.
        let entry: &'static abi::EntryV1 = unsafe { &*entry };
        let mut this = Self { path: path.to_owned(), sha256, plugins: Vec::new(), entry };
        for kind in Kind::ALL {
            this.read_manifests(kind).map_err(&refuse)?;
        }
        if this.plugins.is_empty() {
            return Err(refuse("holds no source, stage or effect of a revision that this host knows".to_owned()));
        }
        Ok(this)
    }

    fn read_manifests(&mut self, kind: Kind) -> Result<(), String> {
        let Some(factory) = self.factory(kind)? else { return Ok(()) };
        let manifest = factory.manifest.ok_or("a factory without `manifest`")?;
        for index in 0..factory.count {
            // SAFETY: `index` is below `count`.
            let text = unsafe { manifest(index) };
            if text.is_null() {
                return Err(format!("manifest {index} of its {kind}s is null"));
            }
            // SAFETY: the header promises a static string.
            let text = unsafe { CStr::from_ptr(text) }.to_string_lossy();
            let manifest: Manifest =
                serde_json::from_str(&text).map_err(|e| format!("manifest {index} of its {kind}s: {e}"))?;
            if manifest.id.is_empty() {
                return Err(format!("manifest {index} of its {kind}s has an empty id"));
            }
            self.plugins.push(PluginInfo { kind, index, manifest });
        }
        Ok(())
    }

    pub(super) fn factory(&self, kind: Kind) -> Result<Option<&'static abi::FactoryV1>, String> {
        let get = self.entry.get_factory.ok_or("its entry has no `get_factory`")?;
        let id = CString::new(kind.factory_id()).map_err(|e| e.to_string())?;
        // SAFETY: the id is NUL-terminated; the header promises null or a static factory.
        Ok(unsafe { get(id.as_ptr()).as_ref() })
    }
}

#[cfg(unix)]
fn check_permissions(path: &Path) -> Result<(), String> {
    use std::os::unix::fs::PermissionsExt;
    let mode = std::fs::metadata(path).map_err(|e| e.to_string())?.permissions().mode();
    if mode & 0o002 != 0 {
        return Err(format!("may be changed by everybody (mode {:o}); `chmod o-w` it if you trust it", mode & 0o777));
    }
    Ok(())
}

#[cfg(not(unix))]
fn check_permissions(_path: &Path) -> Result<(), String> {
    Ok(())
}

/// `plugins.lock` beside the libraries: a table `[sha256]` from file name to digest. Where it exists, nothing else
/// loads.
fn check_lock(path: &Path, sha256: &str) -> Result<(), String> {
    #[derive(Deserialize)]
    #[serde(deny_unknown_fields)]
    struct Lock {
        sha256: std::collections::BTreeMap<String, String>,
    }
    let lock_path = path.with_file_name("plugins.lock");
    let text = match std::fs::read_to_string(&lock_path) {
        Ok(text) => text,
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(()),
        Err(e) => return Err(format!("{} cannot be read: {e}", lock_path.display())),
    };
    let lock: Lock = toml::from_str(&text).map_err(|e| format!("{}: {e}", lock_path.display()))?;
    let name = path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
    match lock.sha256.get(&name) {
        Some(locked) if locked.eq_ignore_ascii_case(sha256) => Ok(()),
        Some(_) => Err(format!("its digest {sha256} is not the one in {}", lock_path.display())),
        None => Err(format!("it is not listed in {}; add its digest {sha256} if you trust it", lock_path.display())),
    }
}
