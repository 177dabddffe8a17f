//! The pages of one product as files that need no server.

use std::path::{Path, PathBuf};

use dragfree_archive::EXTRACT;

use crate::PagesError;
use crate::layout::Links;
use crate::server::ASSETS;
use crate::site::{Query, Site};

/// Writes the pages of a product into a folder and gives the files, the one to open first.
///
/// # Errors
/// [`PagesError`]: there is no such product, what a page shows cannot be computed, or the folder cannot be written.
pub fn report(site: &Site, id: &str, folder: &Path) -> Result<Vec<PathBuf>, PagesError> {
    let archive = site.archive()?;
    let id = archive.find(id)?.row.id;
    let links = Links::Files { id: id.clone() };
    let mut query = Query { products: id.clone(), ..Query::default() };
    let mut pages = vec![("index.html", site.page(&format!("/day/{id}"), &query, &links)?)];
    pages.push(("compare.html", site.page(&format!("/compare/{id}"), &query, &links)?));
    if archive.files_of(&id)?.iter().any(|(suffix, ..)| suffix == EXTRACT) {
        query.on = site.basis(&id)?.named().join(",");
        pages.push(("missing.html", site.page("/missing", &query, &links)?));
    } else {
        let lead = "Diagnose the product first: this page then shows which effect is missing.";
        let words = format!("dragfree diagnose {id} --keep-extract{}", site.setup.flags);
        let body = crate::layout::command(&words);
        pages.push((
            "missing.html",
            crate::layout::page(&links, "Missing physics", "Missing physics", lead, &body).into_string(),
        ));
    }
    let assets = folder.join("assets");
    let refuse = |path: &Path| {
        let path = path.to_owned();
        move |source| PagesError::Write { path, source }
    };
    std::fs::create_dir_all(&assets).map_err(refuse(&assets))?;
    let files = pages.iter().map(|(name, text)| (folder.join(name), text.as_str()));
    let files = files.chain(ASSETS.iter().map(|(name, _, text)| (assets.join(name), *text)));
    let mut written = Vec::new();
    for (path, text) in files {
        std::fs::write(&path, text).map_err(refuse(&path))?;
        written.push(path);
    }
    Ok(written)
}
