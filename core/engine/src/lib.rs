//! Replay, links between plugins, checkpoints and model files; no terminal, no clock.
//!
//! [`run::run`] is the main job: a [`feed`] of rows from telemetry files ([`mod@replay`]) or a source plugin, carried
//! through a linked [`chain`] of plugins found in a [`registry`], into a product of the archive.

pub mod border;
pub mod chain;
pub mod config;
pub mod digests;
pub mod draft;
pub mod examine;
pub mod feed;
mod input;
pub mod limits;
mod means;
pub mod registry;
pub mod replay;
pub mod revisions;
pub mod run;
pub mod sealed;
mod series;
pub mod simulate;
pub mod sources;
pub mod stop;
pub mod table;
pub mod telemetry;
pub mod validate;

pub use dragfree_schema as schema;

use std::path::PathBuf;

/// Why a run or a simulation failed.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "every field is named in its sentence")]
pub enum EngineError {
    /// A file of the configuration.
    #[error(transparent)]
    Config(#[from] config::ConfigError),
    /// A plugin is missing.
    #[error(transparent)]
    Registry(#[from] registry::RegistryError),
    /// A plugin, or the links between plugins.
    #[error(transparent)]
    Chain(#[from] chain::ChainError),
    /// Reading telemetry.
    #[error(transparent)]
    Replay(#[from] replay::ReplayError),
    /// Writing telemetry or time series.
    #[error(transparent)]
    Write(#[from] telemetry::WriteError),
    /// What a simulation hides.
    #[error(transparent)]
    Sealed(#[from] sealed::SealedError),
    /// The archive.
    #[error(transparent)]
    Archive(#[from] dragfree_archive::ArchiveError),
    /// The operating system refused something.
    #[error(transparent)]
    Io(#[from] dragfree_archive::files::IoError),
    /// Neither the command line nor the pipeline names a file.
    #[error("{}: names no {what}, and the command line gives none; add `{what} = \"…\"` or pass --{what}", pipeline.display())]
    NotNamed { what: &'static str, pipeline: PathBuf },
    /// No telemetry was given.
    #[error("{}: has no [source], so it reads telemetry files, and none was given; pass MCAP files", pipeline.display())]
    NoFiles { pipeline: PathBuf },
    /// The files hold no topic of the interface.
    #[error("there is no telemetry in {}: {said}", files.iter().map(|f| f.display().to_string()).collect::<Vec<_>>().join(", "))]
    NoTelemetry { files: Vec<PathBuf>, said: String },
    /// There is not one row in the window.
    #[error("there is no telemetry in the time that was asked for ({} files); check --from and --until", files.len())]
    NoRows { files: Vec<PathBuf> },
    /// The telemetry is not of the mission's spacecraft.
    #[error("the telemetry is of spacecraft {telemetry}, the mission file {} is for {mission}; use that spacecraft's mission file", path.display())]
    WrongSpacecraft { telemetry: String, mission: String, path: PathBuf },
    /// Somebody asked the program to end.
    #[error("stopped as asked, between two batches; nothing half done is left")]
    Stopped,
    /// A simulation of no time.
    #[error("there is nothing to simulate: the end is not after the start")]
    EmptyWindow,
    /// An input of a product is not what it was.
    #[error("{} is not what it was when {product} was made from it; run the product again, or put the file back", path.display())]
    Changed { path: PathBuf, product: String },
    /// A file would be overwritten.
    #[error("{} exists already and is not overwritten; choose another folder with --out, or remove it", path.display())]
    Exists { path: PathBuf },
}

impl EngineError {
    /// Whether the machine is at fault, a disk or the memory, or somebody who wrote to a file meanwhile: the same run
    /// may succeed another time.
    pub fn may_pass(&self) -> bool {
        use chain::ChainError;
        use config::ConfigError;
        use replay::ReplayError;
        matches!(
            self,
            Self::Io(_)
                | Self::Archive(_)
                | Self::Stopped
                | Self::Write(telemetry::WriteError::Io { .. })
                | Self::Replay(ReplayError::Io { .. } | ReplayError::Changed { .. })
                | Self::Config(ConfigError::Read { .. })
                | Self::Chain(
                    ChainError::Sink(_) | ChainError::Recording { .. } | ChainError::Config(ConfigError::Read { .. })
                )
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_the_machine_refuses_may_pass_and_what_the_data_lack_does_not() {
        let source = || std::io::Error::from_raw_os_error(5);
        let path = PathBuf::from("a.mcap");
        assert!(EngineError::from(replay::ReplayError::Io { path: path.clone(), source: source() }).may_pass());
        assert!(EngineError::from(telemetry::WriteError::Io { path: path.clone(), source: source() }).may_pass());
        assert!(EngineError::from(chain::ChainError::Sink("no space".to_owned())).may_pass());
        assert!(!EngineError::from(replay::ReplayError::NotMcap { path: path.clone() }).may_pass());
        assert!(!EngineError::NoRows { files: vec![path] }.may_pass());
    }
}
