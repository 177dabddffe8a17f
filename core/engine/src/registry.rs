//! Every plugin that the plugin folders hold, and why a file was refused.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::border::{self, BorderError, Checked, Config, Identity, Instance, Isolation, Kind, Library, PluginInfo};
use dragfree_archive::PublicKey;
use dragfree_archive::files::Problem;

/// The plugins that were found.
#[derive(Debug, Default)]
pub struct Registry {
    libraries: Vec<Arc<Library>>,
    refused: Vec<Problem>,
    folders: Vec<PathBuf>,
    isolation: Option<Arc<Isolation>>,
}

/// A plugin of the registry.
#[derive(Clone, Debug)]
pub struct Found {
    /// Its library.
    pub opened: Arc<Library>,
    /// Its place and manifest.
    pub info: PluginInfo,
    isolation: Option<Arc<Isolation>>,
    /// Whether its instances run in processes of their own.
    apart: bool,
}

/// Tries files as plugin libraries where that can do no harm. For each the identity of what was tried, or why it is to
/// be refused.
pub type Probe<'a> = &'a mut dyn FnMut(&[&Path], Identity) -> Vec<Result<String, String>>;

/// Why there is no plugin.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "every field is named in its sentence")]
pub enum RegistryError {
    /// No folder holds it.
    #[error(
        "no {kind} `{id}` in the plugin folders {folders}{near}; `dragfree plugins list` shows what is there, --plugin-dir adds a folder"
    )]
    Unknown { kind: Kind, id: String, folders: String, near: String },
    /// Two libraries have it.
    #[error("{kind} `{id}` is in both {} and {}; remove one of the files, or leave its folder out", first.display(), second.display())]
    Twice { kind: Kind, id: String, first: PathBuf, second: PathBuf },
}

impl Registry {
    /// Opens every shared library in the folders. A file that is refused is kept with its reason, and is no error.
    pub fn discover(folders: &[PathBuf]) -> Self {
        Self::open_all(folders, None, None, None)
    }

    /// The same; but with a `key` every folder needs a `plugins.lock` that is signed with it. What no `plugins.lock`
    /// vouches for goes through `probe` first, since a library may crash, end the
    /// program or hang where it is opened. Plugins can run in processes of their own, and those of a folder that asks
    /// for it are opened nowhere else.
    pub fn discover_probed(
        folders: &[PathBuf],
        isolation: Isolation,
        key: Option<&PublicKey>,
        probe: Probe<'_>,
    ) -> Self {
        Self::open_all(folders, Some(Arc::new(isolation)), key, Some(probe))
    }

    fn open_all(
        folders: &[PathBuf],
        isolation: Option<Arc<Isolation>>,
        key: Option<&PublicKey>,
        probe: Option<Probe<'_>>,
    ) -> Self {
        let mut this = Self { folders: folders.to_vec(), isolation, ..Self::default() };
        let mut checked = this.check_all(key);
        if let Some(probe) = probe {
            let is_tried = |library: &Checked| !library.is_locked() && !library.is_isolated();
            let unknown: Vec<&Path> = checked.iter().filter(|c| is_tried(c)).map(Checked::path).collect();
            let settled = checked.iter().all(Checked::is_settled);
            let by = if settled { Identity::Look } else { Identity::Digest };
            let answers = if unknown.is_empty() { Vec::new() } else { probe(&unknown, by) };
            let mut answers = answers.into_iter();
            checked.retain(|library| {
                let refused = if is_tried(library) { refusal(library, by, answers.next()) } else { None };
                this.refused.extend(refused.clone());
                refused.is_none()
            });
        }
        for library in checked {
            let path = library.path().to_owned();
            match this.opened(library) {
                Ok(library) => {
                    let plugins = library.plugins.len();
                    tracing::debug!(path = %path.display(), sha256 = library.sha256, plugins, "opened");
                    this.libraries.push(Arc::new(library));
                }
                Err(error) => this.refuse(path, error),
            }
        }
        this.refused.sort_by(|a, b| a.path.cmp(&b.path));
        this
    }

    /// Opens a library, here or, where its folder asks for it, in a process of its own.
    fn opened(&self, checked: Checked) -> Result<Library, BorderError> {
        match &self.isolation {
            Some(isolation) if checked.is_isolated() => border::described(isolation, &checked),
            None if checked.is_isolated() => Err(not_isolated(checked.path())),
            _ => Library::load(checked),
        }
    }

    /// Every shared library in the folders that passes the checks that run no code of it, each content once.
    fn check_all(&mut self, key: Option<&PublicKey>) -> Vec<Checked> {
        let mut seen = std::collections::BTreeSet::new();
        let mut all: Vec<Checked> = Vec::new();
        for path in self.folders.clone().iter().flat_map(|folder| shared_libraries(folder)) {
            if !seen.insert(path.canonicalize().unwrap_or_else(|_| path.clone())) {
                continue;
            }
            match Checked::new(&path, key) {
                // The same bytes under another name are the same plugin, not a second one.
                Ok(library) if all.iter().any(|other| other.sha256() == library.sha256()) => {}
                Ok(library) => all.push(library),
                Err(error) => self.refuse(path, error),
            }
        }
        all
    }

    fn refuse(&mut self, path: PathBuf, error: BorderError) {
        let reason = match error {
            BorderError::Refused { reason, .. } => reason,
            other => other.to_string(),
        };
        self.refused.push(Problem { path, reason });
    }

    /// Every plugin, by file and then kind.
    pub fn plugins(&self) -> impl Iterator<Item = Found> {
        self.libraries.iter().flat_map(|library| {
            library.plugins.iter().map(|info| Found {
                opened: Arc::clone(library),
                info: info.clone(),
                isolation: self.isolation.clone(),
                apart: library.is_isolated(),
            })
        })
    }

    /// Every file that was refused.
    pub fn refused(&self) -> &[Problem] {
        &self.refused
    }

    /// That no two libraries have a plugin of one kind and id.
    ///
    /// # Errors
    /// [`RegistryError::Twice`] names both files.
    pub fn check_ids(&self) -> Result<(), RegistryError> {
        self.plugins().try_for_each(|p| self.find(p.info.kind, &p.info.manifest.id).map(|_| ()))
    }

    /// A plugin by kind and id.
    ///
    /// # Errors
    /// There is none, or there are two.
    pub fn find(&self, kind: Kind, id: &str) -> Result<Found, RegistryError> {
        let mut found = self.plugins().filter(|p| p.info.kind == kind && p.info.manifest.id == id);
        match (found.next(), found.next()) {
            (Some(plugin), None) => Ok(plugin),
            (Some(a), Some(b)) => Err(RegistryError::Twice {
                kind,
                id: id.to_owned(),
                first: a.opened.path.clone(),
                second: b.opened.path.clone(),
            }),
            (None, _) => {
                let folders: Vec<_> = self.folders.iter().map(|f| f.display().to_string()).collect();
                let file = id.replace('-', "_");
                let refused = self.refused.iter().find(|r| r.path.to_string_lossy().contains(&file));
                let near =
                    refused.map(|r| format!(" ({} was refused: {})", r.path.display(), r.reason)).unwrap_or_default();
                Err(RegistryError::Unknown { kind, id: id.to_owned(), folders: folders.join(", "), near })
            }
        }
    }
}

impl Found {
    /// The same, with instances in processes of their own if `isolate` or its folder asks for it.
    #[must_use]
    pub fn apart(self, isolate: bool) -> Self {
        Self { apart: self.apart || isolate, ..self }
    }

    /// Makes an instance.
    ///
    /// # Errors
    /// The plugin refused its configuration, or its process cannot be started.
    pub fn create(&self, config: &Config) -> Result<Instance, BorderError> {
        if !self.apart {
            return Instance::create(&self.opened, &self.info, config);
        }
        let isolation = self.isolation.as_ref().ok_or_else(|| not_isolated(&self.opened.path))?;
        Instance::create_apart(isolation, &self.opened, &self.info, config)
    }
}

/// What is said where nobody said how a process is started.
fn not_isolated(path: &Path) -> BorderError {
    let reason = "is to run in a process of its own, which this program does not start".to_owned();
    BorderError::Refused { path: path.to_owned(), reason }
}

/// Why a library that was tried is not opened.
fn refusal(library: &Checked, by: Identity, answer: Option<Result<String, String>>) -> Option<Problem> {
    let reason = match answer {
        Some(Ok(identity)) if identity == library.identity(by) => return None,
        Some(Ok(_)) => "was changed while it was tried; try again when it is complete".to_owned(),
        Some(Err(reason)) => reason,
        None => "could not be tried".to_owned(),
    };
    Some(Problem { path: library.path().to_owned(), reason })
}

/// The shared libraries of a folder in the order of their names; none where the folder cannot be read.
fn shared_libraries(folder: &Path) -> Vec<PathBuf> {
    let mut paths: Vec<PathBuf> = std::fs::read_dir(folder)
        .into_iter()
        .flatten()
        .flatten()
        .map(|entry| entry.path())
        .filter(|path| path.extension().is_some_and(|e| e == std::env::consts::DLL_EXTENSION) && path.is_file())
        .collect();
    paths.sort();
    paths
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    /// What was tried is what is opened: by the look of a file that was written long ago, by the digest of a new one.
    #[test]
    fn a_library_that_changes_while_it_is_tried_is_not_opened() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(format!("a{}", std::env::consts::DLL_SUFFIX));
        // As one that is written anew before it is opened for its trial.
        let refused = |written_anew: bool| {
            let mut tried_by = None;
            let mut probe = |files: &[&Path], by: Identity| {
                tried_by = Some(by);
                if written_anew {
                    std::fs::write(&path, "two").unwrap();
                }
                vec![Ok(Checked::new(files[0], None).unwrap().identity(by))]
            };
            let registry = Registry::open_all(&[folder.path().to_owned()], None, None, Some(&mut probe));
            (tried_by, registry.refused[0].reason.clone())
        };
        for by in [Identity::Digest, Identity::Look] {
            for (written_anew, why) in [(false, "no shared library"), (true, "was changed while it was tried")] {
                std::fs::write(&path, "one").unwrap();
                if by == Identity::Look && cfg!(unix) {
                    std::thread::sleep(Duration::from_millis(1100));
                }
                let (tried_by, reason) = refused(written_anew);
                assert!(!cfg!(unix) || tried_by == Some(by));
                assert!(reason.contains(why), "{by:?}, {written_anew}: {reason}");
            }
        }
    }
}
