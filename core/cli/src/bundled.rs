//! The files that the demo needs, so that it runs from any folder.

/// Path below the demo's folder and contents; the pipeline names the others by these relative paths.
pub(crate) const FILES: [(&str, &str); 3] = [
    (MISSION, include_str!("../../../fixtures/missions/taiji.toml")),
    (MODEL, include_str!("../../../fixtures/models/com-offset.toml")),
    (PIPELINE, include_str!("../../../fixtures/pipelines/science-mode.toml")),
];

/// The paper's spacecraft.
pub(crate) const MISSION: &str = "missions/taiji.toml";

/// The paper's chain.
pub(crate) const PIPELINE: &str = "pipelines/science-mode.toml";

/// The offset alone.
pub(crate) const MODEL: &str = "models/com-offset.toml";
