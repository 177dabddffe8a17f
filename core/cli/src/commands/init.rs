//! `dragfree init`: the files of a new mission.

use super::Done;
use crate::args::Init;
use crate::failure::{Failure, Refusal};
use crate::installed;
use crate::operations;
use crate::text::quoted;
use dragfree_archive::files::{IoContext as _, read_text};
use dragfree_engine::limits::CONFIG_BYTES;
use std::fs::File;
use std::io::Write as _;
use std::path::Path;

/// The chain of a mission that no pipeline is made for.
const PIPELINE: &str = "science-mode";

/// The file of operations of a new mission.
const OPERATIONS: &str = include_str!("../../../../fixtures/operations/mission-ops.toml");

/// A campaign of a new mission.
const CAMPAIGN: &str = include_str!("../../../../fixtures/operations/campaign.toml");

/// The file of events of a new mission.
const EVENTS: &str = include_str!("../../../../fixtures/operations/events.yaml");

pub(super) fn execute(init: &Init, json: bool) -> Result<Done, Failure> {
    let read = |path: &Path| read_text(path, CONFIG_BYTES).at("read", path);
    let name = init.mission.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let pipeline =
        installed::pipeline_of(&name).map_or_else(|| installed::find(installed::PIPELINE, Path::new(PIPELINE)), Ok)?;
    let pipeline_text = read(&pipeline)?;
    let given = |key: &str| {
        let line = pipeline_text.lines().find_map(|line| line.strip_prefix(key)?.trim_start().strip_prefix('='));
        line.and_then(|value| value.split('"').nth(1)).unwrap_or_default()
    };
    let (mission, model) = (given("mission"), given("model"));
    let model_path = pipeline.with_file_name(model);
    let folder = init.folder.display();
    let texts = [
        (
            "mission.toml",
            format!(
                "# The spacecraft: started from the mission `{name}`. Every key carries its unit; put your own numbers in their places.\n\
                 # `dragfree design mission.toml` checks noise, requirements and actuators against each other.\n\n{}",
                read(&init.mission)?
            ),
        ),
        (
            "pipeline.toml",
            format!(
                "# The stages that a day of telemetry goes through. `dragfree plugins inspect STAGE` lists the parameters of a stage;\n\
                 # `dragfree config check pipeline.toml FILE.mcap` checks everything without reading data.\n\n{}",
                pipeline_text
                    .replace(&format!("{mission:?}"), "\"mission.toml\"")
                    .replace(&format!("{model:?}"), "\"model.toml\"")
            ),
        ),
        (
            "model.toml",
            format!(
                "# The effects whose coefficients are estimated. `dragfree model add model.toml EFFECT:INSTANCE` adds one and keeps\n\
                 # every revision; `dragfree plugins list` shows the effects.\n\n{}",
                read(&model_path)?
            ),
        ),
        (operations::NAME, OPERATIONS.to_owned()),
        ("events.yaml", EVENTS.to_owned()),
        ("campaign.toml", CAMPAIGN.to_owned()),
    ];
    std::fs::create_dir_all(&init.folder).at("make the folder", &init.folder)?;
    let places = texts.each_ref().map(|(file, _)| init.folder.join(file));
    if let Some(taken) = places.iter().find(|path| path.exists()) {
        return Err(Refusal::Taken(taken.clone()).into());
    }
    for (path, (_, text)) in places.iter().zip(&texts) {
        let made = File::create_new(path);
        made.and_then(|mut file| file.write_all(text.as_bytes())).at("write", path)?;
    }
    let files = places.each_ref().map(|path| path.display().to_string());
    if json {
        return Ok(Done::json(&serde_json::json!({ "folder": folder.to_string(), "files": files })));
    }
    let at = |file: &str| quoted(&init.folder.join(file).to_string_lossy());
    Ok(Done::new(format!(
        "{}\nnext      dragfree simulate {} --out {} --hours 6\n          dragfree run {} FILE... --archive {}\n",
        files.join("\n"),
        at("mission.toml"),
        at("telemetry"),
        at("pipeline.toml"),
        at("archive")
    )))
}
