//! `dragfree plugins`.

use super::Done;
use crate::args::{Global, Plugins};
use crate::failure::Failure;
use crate::screen;
use crate::text::Paint;
use dragfree_engine::registry::Registry;

pub(super) fn execute(command: &Plugins, global: &Global, paint: Paint) -> Result<Done, Failure> {
    let registry = super::registry(global)?;
    match command {
        Plugins::List if global.json => Ok(Done::json(&screen::plugins_json(&registry))),
        Plugins::List => Ok(Done::new(screen::plugins(&registry, paint))),
        Plugins::Inspect { id } => inspect(&registry, id, global.json, paint),
    }
}

fn inspect(registry: &Registry, id: &str, json: bool, paint: Paint) -> Result<Done, Failure> {
    let found = registry.plugins().find(|found| found.info.manifest.id == id);
    let found = found.ok_or_else(|| Failure::Plugin(id.to_owned()))?;
    let (info, library) = (&found.info, &found.opened);
    if json {
        return Ok(Done::json(&serde_json::json!({
            "kind": info.kind,
            "manifest": info.manifest,
            "path": library.path.to_string_lossy(),
            "sha256": library.sha256,
        })));
    }
    Ok(Done::new(screen::manifest(&info.kind.to_string(), &info.manifest, &library.path, paint)))
}
