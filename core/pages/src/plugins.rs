//! The plugins that can be found, and why others were refused.

use maud::{Markup, html};

use crate::PagesError;
use crate::layout::{Links, command, page as whole};
use crate::site::Site;

pub(crate) fn page(site: &Site, links: &Links) -> Result<Markup, PagesError> {
    let registry = &site.setup.registry;
    let mut all: Vec<_> = registry.plugins().collect();
    all.sort_by_key(|found| (found.info.kind.to_string(), found.info.manifest.id.clone()));
    let refused = registry.refused();
    let body = html! {
        @if !refused.is_empty() {
            h2 { "Refused" }
            ul class="bad-list" {
                @for problem in refused { li { code { (problem.path.display()) } ": " (problem.reason) } }
            }
        }
        h2 { "Loaded" }
        p { (all.len()) " plugins. A product names each by the digest of its library, so that a day can be made again \
            with the very same ones." }
        @for found in &all {
            @let manifest = &found.info.manifest;
            details class="plugin" {
                summary {
                    strong { (manifest.id) } " " span class="quiet" { (found.info.kind) " " (manifest.version) }
                    " " (manifest.description)
                }
                dl {
                    dt { "File" } dd { code { (found.opened.path.display()) } }
                    dt { "SHA-256" } dd { code class="digest" { (found.opened.sha256) } }
                    dt { "Vouched for by" }
                    dd {
                        @match (&found.opened.vouched_by, found.opened.is_isolated()) {
                            (Some(by), _) => code class="digest" { (by) },
                            (None, true) => "nobody; it runs in a process of its own",
                            (None, false) => "nobody; it was tried in a process of its own first",
                        }
                    }
                    dt { "Licence" } dd { (manifest.licence) }
                }
                @if !manifest.parameters.is_empty() {
                    div class="scroll" tabindex="0" { table {
                        thead { tr { th { "parameter" } th { "default" } th { "unit" } th { "range" } th { "meaning"
                            } } }
                        tbody { @for p in &manifest.parameters { tr {
                            td { code { (p.name) } }
                            td { (p.default) }
                            td { (p.unit) }
                            td {
                                @if let Some(minimum) = p.minimum { (minimum) }
                                @if p.minimum.is_some() || p.maximum.is_some() { " … " }
                                @if let Some(maximum) = p.maximum { (maximum) }
                                (p.choices.join(", "))
                            }
                            td { (p.help) }
                        } } }
                    } }
                }
            }
        }
        h2 { "On the command line" }
        (command("dragfree plugins list\ndragfree plugins validate FILE"))
    };
    let lead = "Look under Refused for a plugin that you miss; open a loaded one for its parameters.";
    Ok(whole(links, "Plugins", "Plugins", lead, &body))
}
