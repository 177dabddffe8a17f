//! `dragfree products verify` and `rebuild`.

use crate::args::{BATCH_ROWS, Global};
use crate::commands::{Done, SOFTWARE};
use crate::failure::Failure;
use crate::progress::Meter;
use crate::text::{self, Paint};
use dragfree_archive::Find;
use dragfree_workflow::calibrate::Options;
use dragfree_workflow::provenance;
use serde_json::json;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

/// What is wrong with one thing.
struct Broken {
    what: String,
    reason: String,
    /// Whether `rebuild` has what it needs.
    rebuild: Option<bool>,
}

/// Compares products with their digests; of all of them, the journal and every content too.
pub(super) fn verify(names: &[String], folder: &Path, json: bool, paint: Paint) -> Result<Done, Failure> {
    let archive = super::archive(folder)?;
    let mut broken = Vec::new();
    let ids = if names.is_empty() {
        if let Err(error) = archive.events() {
            broken.push(Broken { what: "journal".to_owned(), reason: error.to_string(), rebuild: None });
        }
        for sha256 in archive.strangers()? {
            let reason = "no event names it; it is of no use".to_owned();
            broken.push(Broken { what: format!("objects/{}/{}", &sha256[..2], &sha256[2..]), reason, rebuild: None });
        }
        let listing = archive.list(&Find::default())?;
        for problem in &listing.problems {
            let is_product = problem.path.extension().is_some_and(|e| e == "toml");
            let id = problem.path.file_stem().unwrap_or_default().to_string_lossy();
            if !(is_product && archive.row(&id).is_ok()) {
                let what = problem.path.display().to_string();
                broken.push(Broken { what, reason: problem.reason.clone(), rebuild: None });
            }
        }
        archive.ids()?
    } else {
        names.iter().map(|name| archive.find(name).map(|e| e.row.id)).collect::<Result<_, _>>()?
    };
    for id in &ids {
        let whole = archive.product(id).map(drop).and_then(|()| archive.verify_kept(id));
        if let Err(error) = whole {
            let rebuild = Some(provenance::can_be_rebuilt(&archive, id));
            broken.push(Broken { what: id.clone(), reason: error.to_string(), rebuild });
        }
    }
    let code = u8::from(!broken.is_empty());
    if json {
        let broken: Vec<_> =
            broken.iter().map(|b| json!({"what": b.what, "reason": b.reason, "can_be_rebuilt": b.rebuild})).collect();
        return Ok(Done { code, ..Done::json(&json!({"products": ids.len(), "broken": broken})) });
    }
    let mut text = String::new();
    for b in &broken {
        let _ = writeln!(text, "{}    {}", paint.bad("broken"), b.what);
        text += &text::labelled("", &b.reason);
        match b.rebuild {
            Some(true) => text += &text::labelled("next", &format!("dragfree products rebuild {}", b.what)),
            Some(false) => {
                let words = "an input of it is gone; `dragfree products rebuild` with --inputs DIR looks for it";
                text += &text::labelled("", words);
            }
            None => {}
        }
    }
    let _ = writeln!(text, "{} products compared with their digests, {} things broken", ids.len(), broken.len());
    Ok(Done { text, code })
}

/// Makes a product again and compares.
pub(super) fn rebuild(
    name: &str,
    folder: &Path,
    inputs: &[PathBuf],
    global: &Global,
    paint: Paint,
) -> Result<Done, Failure> {
    let mut archive = super::archive(folder)?;
    let id = archive.find(name)?.row.id;
    if !inputs.is_empty() {
        archive.look_in(inputs, &[&id], &crate::commands::stamp())?;
    }
    let registry = crate::commands::registry(global)?;
    let options = Options {
        threads: crate::commands::threads(global),
        batch_rows: BATCH_ROWS as usize,
        software: SOFTWARE.to_owned(),
        ..Options::default()
    };
    let mut meter = Meter::new("rebuild", global);
    let rebuilt = provenance::rebuild(&registry, &mut archive, &id, &options, &mut |p| meter.show(&p))?;
    let code = u8::from(!rebuilt.same);
    if global.json {
        return Ok(Done { code, ..Done::json(&serde_json::to_value(&rebuilt)?) });
    }
    let mut text = if rebuilt.same {
        format!("{}      {id}: the digest is {}\n", paint.good("same"), rebuilt.archived_sha256)
    } else {
        let mut text = format!("{}   {id}: the digest is another one\n", paint.bad("differs"));
        text += &format!("archived  {}\nrebuilt   {}\n", rebuilt.archived_sha256, rebuilt.rebuilt_sha256);
        text
    };
    if !rebuilt.mended.is_empty() {
        text += &text::labelled("mended", &rebuilt.mended.join(", "));
    }
    if let (false, Some(diff)) = (rebuilt.same, &rebuilt.diff) {
        text += &super::history::differences(diff, paint);
    }
    if !rebuilt.same && rebuilt.same_but_libraries {
        text += "\n";
        let words = "all that was found is the same, to the last bit; the plugins' libraries alone are others, from \
                     other sources or built by another compiler";
        text += &text::labelled("result", words);
    } else if rebuilt.same_state == Some(false) {
        text += &text::labelled("note", "the state that it leaves to the next day is another one");
    }
    Ok(Done { text, code })
}
