//! `dragfree reveal`.

use super::Done;
use crate::failure::Failure;
use crate::text::{self, Paint};
use dragfree_engine::sealed::Sealed;
use serde_json::Value;
use std::path::{Path, PathBuf};

pub(super) fn execute(path: &Path, telemetry: &[PathBuf], json: bool, paint: Paint) -> Result<Done, Failure> {
    let sealed = Sealed::read(path).map_err(Failure::engine)?;
    let content = sealed.content(path).map_err(Failure::engine)?;
    let checked = sealed.check(path, telemetry).map_err(Failure::engine)?;
    if json {
        let value = serde_json::json!({"sha256": sealed.sha256, "telemetry": checked, "content": content});
        return Ok(Done::json(&value));
    }
    let agreement = match checked.len() {
        0 => paint.doubtful("not checked: no telemetry beside it names a digest; --telemetry FILE"),
        1 => "agrees with 1 telemetry file".to_owned(),
        n => format!("agrees with {n} telemetry files"),
    };
    let mut screen = format!("sha256    {}\n          {agreement}\n", sealed.sha256);
    screen += &text::labelled("seeds", &format!("hidden {}, noise {}", content["hidden_seed"], content["noise_seed"]));
    screen += "\n";
    screen += &effects(&content);
    screen += "\n";
    for (name, value) in content["offset_m"].as_object().into_iter().flatten() {
        screen += &format!("{name}  {:.4} mm\n", value.as_f64().unwrap_or(f64::NAN) * 1e3);
    }
    Ok(Done::new(screen))
}

/// What is hidden, a block each.
fn effects(content: &Value) -> String {
    let word = |value: &Value| value.as_str().unwrap_or_default().to_owned();
    let number = |value: &Value| value.as_f64().unwrap_or(f64::NAN);
    let one = |e: &Value| {
        let (unit, factor) = text::readable_unit(e["unit"].as_str().unwrap_or_default());
        let size = text::plain(number(&e["size"]) * factor);
        let mut block =
            text::labelled("hidden", &format!("{}:{} {size} {unit}", word(&e["effect"]), word(&e["instance"])));
        let shape = e["shape"].as_object().into_iter().flatten();
        let shape: Vec<String> = shape.map(|(name, value)| format!("{name} {}", text::plain(number(value)))).collect();
        if !shape.is_empty() {
            block += &text::labelled("shape", &shape.join(", "));
        }
        let covered = if e["covered"] == false { "; no bundled effect covers it" } else { "" };
        block + &text::labelled("expected", &format!("{:.1} σ{covered}", number(&e["significance"])))
    };
    match content["effects"].as_array().map_or(&[][..], Vec::as_slice) {
        [] => "hidden    nothing\n".to_owned(),
        all => all.iter().map(one).collect(),
    }
}
