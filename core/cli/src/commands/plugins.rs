//! `dragfree plugins`.

use super::Done;
use crate::args::{Global, Plugins};
use crate::failure::{Failure, Refusal};
use crate::screen;
use crate::text::Paint;
use dragfree_engine::registry::Registry;
use dragfree_engine::{border, digests};
use std::path::PathBuf;

pub(super) fn execute(command: &Plugins, global: &Global, paint: Paint) -> Result<Done, Failure> {
    match command {
        Plugins::List => {
            let registry = listed(global)?;
            let clash = registry.check_ids().err().map(|error| error.to_string());
            let code = u8::from(clash.is_some());
            if global.json {
                return Ok(Done { code, ..Done::json(&screen::plugins_json(&registry, clash.as_deref())) });
            }
            Ok(Done { code, text: screen::plugins(&registry, clash.as_deref(), paint) })
        }
        Plugins::Inspect { id } => inspect(&super::registry(global)?, id, global.json, paint),
        Plugins::Validate(validate) => super::validate::execute(validate, global, paint),
        Plugins::Probe { digests, files } => super::probe::child(files, *digests),
        Plugins::Serve => border::serve(),
        Plugins::New(new) => super::new_plugin::execute(new, global.json),
    }
}

/// The plugins, with the digests of libraries that have not changed since the last list.
fn listed(global: &Global) -> Result<Registry, Failure> {
    // With a key the digests are what is asked for.
    let file = if super::plugin_key(global)?.is_none() { file_of_digests() } else { None };
    if let Some(file) = &file {
        digests::recall(file);
    }
    let registry = super::discovered(global)?;
    if let Some(file) = &file {
        digests::keep(file);
    }
    Ok(registry)
}

/// Where they are kept, below the user's folder for what can be made again.
fn file_of_digests() -> Option<PathBuf> {
    let folder = |name: &str| std::env::var_os(name).map(PathBuf::from).filter(|path| path.is_absolute());
    let cache = folder("XDG_CACHE_HOME").or_else(|| folder("HOME").map(|home| home.join(".cache")));
    cache.map(|cache| cache.join("dragfree/libraries.json"))
}

fn inspect(registry: &Registry, id: &str, json: bool, paint: Paint) -> Result<Done, Failure> {
    let found = registry.plugins().find(|found| found.info.manifest.id == id);
    let found = found.ok_or_else(|| Refusal::Plugin(id.to_owned()))?;
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
