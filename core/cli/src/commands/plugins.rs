//! `dragfree plugins`.

use super::Done;
use crate::args::{Global, Plugins};
use crate::failure::Failure;
use crate::screen;
use crate::text::Paint;
use dragfree_engine::registry::Registry;

pub(super) fn execute(command: &Plugins, global: &Global, paint: Paint) -> Result<Done, Failure> {
    match command {
        Plugins::List if global.json => Ok(Done::json(&screen::plugins_json(&super::registry(global)?))),
        Plugins::List => Ok(Done::new(screen::plugins(&super::registry(global)?, paint))),
        Plugins::Inspect { id } => inspect(&super::registry(global)?, id, global.json, paint),
        Plugins::Validate(validate) => super::validate::execute(validate, global, paint),
        Plugins::New(new) => super::new_plugin::execute(new, global.json),
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
