//! Every plugin that the plugin folders hold, and why a file was refused.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::border::{BorderError, Config, Instance, Kind, Library, PluginInfo};
use dragfree_archive::files::Problem;

/// The plugins that were found.
#[derive(Debug, Default)]
pub struct Registry {
    libraries: Vec<Arc<Library>>,
    refused: Vec<Problem>,
    folders: Vec<PathBuf>,
}

/// A plugin of the registry.
#[derive(Clone, Debug)]
pub struct Found {
    /// Its library.
    pub opened: Arc<Library>,
    /// Its place and manifest.
    pub info: PluginInfo,
}

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
        let mut this = Self { folders: folders.to_vec(), ..Self::default() };
        let mut seen = std::collections::BTreeSet::new();
        for folder in folders {
            for path in shared_libraries(folder) {
                let canonical = path.canonicalize().unwrap_or_else(|_| path.clone());
                if !seen.insert(canonical) {
                    continue;
                }
                match Library::open(&path) {
                    // The same bytes under another name are the same plugin, not a second one.
                    Ok(library) if this.libraries.iter().any(|l| l.sha256 == library.sha256) => {}
                    Ok(library) => {
                        let plugins = library.plugins.len();
                        tracing::debug!(path = %path.display(), sha256 = library.sha256, plugins, "opened");
                        this.libraries.push(Arc::new(library));
                    }
                    Err(BorderError::Refused { path, reason }) => this.refused.push(Problem { path, reason }),
                    Err(other) => this.refused.push(Problem { path, reason: other.to_string() }),
                }
            }
        }
        this
    }

    /// Every plugin, by file and then kind.
    pub fn plugins(&self) -> impl Iterator<Item = Found> {
        self.libraries.iter().flat_map(|library| {
            library.plugins.iter().map(|info| Found { opened: Arc::clone(library), info: info.clone() })
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
    /// Makes an instance.
    ///
    /// # Errors
    /// The plugin refused its configuration.
    pub fn create(&self, config: &Config) -> Result<Instance, BorderError> {
        Instance::create(&self.opened, &self.info, config)
    }
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
