//! Plugin libraries: checked, opened through the descriptor that was checked, their manifests read.

use dragfree_abi as abi;
use dragfree_archive::PublicKey;
use dragfree_archive::files::read_text;
use dragfree_schema::Manifest;
use serde::{Deserialize, Serialize};
use std::ffi::CString;
use std::mem::ManuallyDrop;
use std::path::{Path, PathBuf};

use super::BorderError;
use super::crash::{self, Name};
use super::text::{aligned, text_of};
use crate::input::InputFile;
use crate::limits::{CONFIG_BYTES, LIBRARY_BYTES, PLUGINS, TEXT_BYTES};

/// What a plugin is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
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

/// A library file that was checked and that no code was run of yet.
#[derive(Debug)]
pub struct Checked {
    file: InputFile,
    sha256: String,
    lock: Lock,
}

/// An open plugin library; never closed.
#[derive(Debug)]
pub struct Library {
    /// The file.
    pub path: PathBuf,
    /// Its digest, lower-case hexadecimal.
    pub sha256: String,
    /// Who vouches for it: `plugins.lock`, and with which key that is signed; none where it was tried in a process of
    /// its own instead.
    pub vouched_by: Option<String>,
    /// What it holds.
    pub plugins: Vec<PluginInfo>,
    /// None where its instances run in processes of their own, and this one has not opened it.
    entry: Option<&'static abi::EntryV1>,
}

/// What tells a library from any other.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Identity {
    /// Its place, size and times, which suffice for [settled](Checked::is_settled) ones.
    Look,
    /// The digest of its bytes, which takes longer than to open it.
    Digest,
}

impl Checked {
    /// Opens a file and checks it: who may change it, and whether `plugins.lock` has its digest. With a `key` it must
    /// have, and must be signed with the key.
    ///
    /// # Errors
    /// [`BorderError::Refused`] with the reason.
    pub fn new(path: &Path, key: Option<&PublicKey>) -> Result<Self, BorderError> {
        let refuse = |reason: String| BorderError::Refused { path: path.to_owned(), reason };
        let Self { file, .. } = Self::owned(path)?;
        let sha256 = file.sums(0).map_err(|e| refuse(format!("cannot be read: {e}")))?.sha256;
        let lock = Lock::of(path, &sha256, key).map_err(refuse)?;
        Ok(Self { file, sha256, lock })
    }

    /// Opens a file and checks who may change it, without its digest and without `plugins.lock`.
    fn owned(path: &Path) -> Result<Self, BorderError> {
        let refuse = |reason: String| BorderError::Refused { path: path.to_owned(), reason };
        let file = InputFile::open(path).map_err(|e| refuse(format!("cannot be read: {e}")))?;
        if file.size() > LIBRARY_BYTES {
            return Err(refuse(format!("has {} bytes, where a library may have {LIBRARY_BYTES}", file.size())));
        }
        super::owner::check(path, &file).map_err(refuse)?;
        Ok(Self { file, sha256: String::new(), lock: Lock::default() })
    }

    /// What tells it from any other file, for who tries it in another process.
    pub fn identity(&self, by: Identity) -> String {
        match by {
            Identity::Look => self.file.look(),
            Identity::Digest => self.sha256.clone(),
        }
    }

    /// Whether its look tells it from whatever may be written to it from now on.
    pub fn is_settled(&self) -> bool {
        self.file.is_settled()
    }

    /// The file.
    pub fn path(&self) -> &Path {
        self.file.path()
    }

    /// Its digest, lower-case hexadecimal.
    pub fn sha256(&self) -> &str {
        &self.sha256
    }

    /// Whether the operator vouches for it by name and digest.
    pub fn is_locked(&self) -> bool {
        self.lock.vouched_by.is_some()
    }

    /// Whether its folder asks for a process of its own for each instance.
    pub fn is_isolated(&self) -> bool {
        self.lock.isolates
    }
}

impl Library {
    /// Checks a file, opens it and reads its manifests.
    ///
    /// # Errors
    /// [`BorderError::Refused`] with the reason: others may change it, not in `plugins.lock`, no shared library, no
    /// plugin, another ABI version, a manifest that cannot be read.
    pub fn open(path: &Path) -> Result<Self, BorderError> {
        Self::load(Checked::new(path, None)?)
    }

    /// Opens a file to see whether that can be done. Gives its identity.
    ///
    /// # Errors
    /// As [`Self::open`].
    pub fn try_open(path: &Path, by: Identity) -> Result<String, BorderError> {
        let checked = match by {
            Identity::Look => Checked::owned(path)?,
            Identity::Digest => Checked::new(path, None)?,
        };
        let identity = checked.identity(by);
        Self::load(checked)?;
        Ok(identity)
    }

    /// Opens a file that was checked and reads its manifests.
    ///
    /// # Errors
    /// As [`Self::open`].
    pub fn load(checked: Checked) -> Result<Self, BorderError> {
        let path = checked.path().to_owned();
        let refuse = |reason: String| BorderError::Refused { path: path.clone(), reason };
        let same = checked.file.is_unchanged().map_err(|e| refuse(format!("cannot be read: {e}")))?;
        if !same {
            return Err(refuse("was changed while it was checked; try again when it is complete".to_owned()));
        }
        crash::install();
        let (opened, changed) =
            Name::of(&path.to_string_lossy()).guarded("open", || Self::read(checked).map_err(refuse));
        if changed {
            return Err(refuse(super::FLOATS_CHANGED.to_owned()));
        }
        opened
    }

    /// A library that was checked, and of which a process of its own says that it has these plugins: no code of it runs
    /// here.
    pub(super) fn elsewhere(checked: &Checked, plugins: Vec<PluginInfo>) -> Self {
        Self {
            path: checked.path().to_owned(),
            sha256: checked.sha256.clone(),
            vouched_by: checked.lock.vouched_by.clone(),
            plugins,
            entry: None,
        }
    }

    /// Whether its instances run in processes of their own, whoever makes them.
    pub fn is_isolated(&self) -> bool {
        self.entry.is_none()
    }

    /// Opens a library and reads its manifests: what runs code of it.
    fn read(checked: Checked) -> Result<Self, String> {
        let library = ManuallyDrop::new(open(&checked)?);
        // SAFETY: the header defines the symbol as data of this type; its first field is read before anything else.
        let symbol = unsafe { library.get::<*const abi::EntryV1>(abi::ENTRY_SYMBOL) }
            .map_err(|_| "exports no `dragfree_entry`: it is no dragfree plugin".to_owned())?;
        // SAFETY: the symbol's address outlives the handle, which is never closed.
        let entry =
            unsafe { symbol.try_as_raw_ptr() }.map_or(std::ptr::null(), |p| p.cast::<abi::EntryV1>().cast_const());
        if !aligned(entry) {
            return Err("exports a null or misaligned `dragfree_entry`".to_owned());
        }
        // SAFETY: `abi_version` is the first field in every version of the struct; reading it alone is always sound.
        let version = unsafe { *entry.cast::<u32>() };
        if version != abi::ABI_VERSION {
            return Err(format!(
                "was built for ABI version {version}, this host speaks version {}; rebuild it with this host's plugin.h",
                abi::ABI_VERSION
            ));
        }
        // SAFETY: the version matches, so the plugin says that the whole struct is there; it is never unloaded.
        let entry: &'static abi::EntryV1 = unsafe { &*entry };
        let path = checked.path().to_owned();
        let Checked { sha256, lock, .. } = checked;
        let mut this = Self { path, sha256, vouched_by: lock.vouched_by, plugins: Vec::new(), entry: Some(entry) };
        for kind in Kind::ALL {
            this.read_manifests(kind)?;
        }
        if this.plugins.is_empty() {
            return Err("holds no source, stage or effect of a revision that this host knows".to_owned());
        }
        Ok(this)
    }

    fn read_manifests(&mut self, kind: Kind) -> Result<(), String> {
        let Some(factory) = self.factory(kind)? else { return Ok(()) };
        let manifest = factory.manifest.ok_or("a factory without `manifest`")?;
        if factory.count > PLUGINS {
            return Err(format!("says that it has {} {kind}s, where {PLUGINS} are the most", factory.count));
        }
        for index in 0..factory.count {
            let broken = |what: String| format!("manifest {index} of its {kind}s: {what}");
            // SAFETY: `index` is below `count`; the header promises a static string.
            let text = unsafe { text_of(manifest(index), TEXT_BYTES) }
                .map_err(broken)?
                .ok_or_else(|| format!("manifest {index} of its {kind}s is null"))?;
            let manifest: Manifest = serde_json::from_str(&text).map_err(|e| broken(e.to_string()))?;
            if manifest.id.is_empty() {
                return Err(format!("manifest {index} of its {kind}s has an empty id"));
            }
            self.plugins.push(PluginInfo { kind, index, manifest });
        }
        Ok(())
    }

    pub(super) fn factory(&self, kind: Kind) -> Result<Option<&'static abi::FactoryV1>, String> {
        let entry = self.entry.ok_or("it runs in a process of its own, and was not opened here")?;
        let get = entry.get_factory.ok_or("its entry has no `get_factory`")?;
        let id = CString::new(kind.factory_id()).map_err(|e| e.to_string())?;
        // SAFETY: the id is NUL-terminated.
        let factory = unsafe { get(id.as_ptr()) };
        if !factory.is_null() && !factory.is_aligned() {
            return Err(format!("its factory of {kind}s is misaligned"));
        }
        // SAFETY: the header promises null or a static factory.
        Ok(unsafe { factory.as_ref() })
    }
}

/// Opens a checked library by its descriptor, so that what runs is what was checked. The descriptor stays open for
/// ever: the loader knows libraries by name, and a number that came again would be taken for the library before.
#[cfg(target_os = "linux")]
fn open(checked: &Checked) -> Result<libloading::Library, String> {
    let descriptor = checked.file.keep_open().map_err(|e| format!("cannot be kept open: {e}"))?;
    // SAFETY: opening a library runs its initialisers; the operator vouches for the plugin folder, and the checks
    // before refuse a file that somebody else could have changed.
    let opened = unsafe { libloading::Library::new(format!("/proc/self/fd/{descriptor}")) };
    match opened {
        // Libraries beside it that it finds by `$ORIGIN` are found by its path alone; nobody promised them by digest.
        Err(_) if !checked.is_locked() && checked.file.is_in_place().is_ok_and(|same| same) => by_path(checked),
        opened => opened.map_err(unloadable),
    }
}

#[cfg(not(target_os = "linux"))]
fn open(checked: &Checked) -> Result<libloading::Library, String> {
    by_path(checked)
}

fn by_path(checked: &Checked) -> Result<libloading::Library, String> {
    // SAFETY: as above.
    unsafe { libloading::Library::new(checked.path()) }.map_err(unloadable)
}

#[allow(clippy::needless_pass_by_value, reason = "for `map_err`")]
fn unloadable(error: libloading::Error) -> String {
    format!("is no shared library that this machine can load: {error}")
}

/// What `plugins.lock` beside a library says of it: a table `[sha256]` from file name to digest, outside of which
/// nothing loads, and `isolate = true` for a folder whose plugins run in processes of their own.
#[derive(Clone, Debug, Default)]
struct Lock {
    /// As [`Library::vouched_by`].
    vouched_by: Option<String>,
    isolates: bool,
}

impl Lock {
    fn of(path: &Path, sha256: &str, key: Option<&PublicKey>) -> Result<Self, String> {
        #[derive(Deserialize)]
        #[serde(deny_unknown_fields)]
        struct File {
            #[serde(default)]
            isolate: bool,
            sha256: Option<std::collections::BTreeMap<String, String>>,
        }
        let lock_path = path.with_file_name("plugins.lock");
        let text = match read_text(&lock_path, CONFIG_BYTES) {
            Ok(text) => text,
            Err(e) if e.kind() == std::io::ErrorKind::NotFound && key.is_none() => return Ok(Self::default()),
            Err(e) => return Err(format!("{} cannot be read: {e}", lock_path.display())),
        };
        key.map_or(Ok(()), |key| key.check(&lock_path, &text))?;
        let file: File = toml::from_str(&text).map_err(|e| format!("{}: {e}", lock_path.display()))?;
        let isolates = file.isolate;
        if key.is_some() && file.sha256.is_none() {
            return Err(format!("{} has no [sha256], which --plugin-key asks for", lock_path.display()));
        }
        let Some(locked) = file.sha256 else {
            let empty = || format!("{} says neither `isolate` nor [sha256]", lock_path.display());
            return isolates.then_some(Self { vouched_by: None, isolates }).ok_or_else(empty);
        };
        let name = path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
        match locked.get(&name) {
            Some(locked) if locked.eq_ignore_ascii_case(sha256) => {
                let signed = key.map_or_else(String::new, |key| format!(", signed with {key}"));
                Ok(Self { vouched_by: Some(format!("plugins.lock{signed}")), isolates })
            }
            Some(_) => Err(format!("its digest {sha256} is not the one in {}", lock_path.display())),
            None => {
                Err(format!("it is not listed in {}; add its digest {sha256} if you trust it", lock_path.display()))
            }
        }
    }
}
