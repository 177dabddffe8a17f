//! `dragfree demo`: a day with a hidden effect, told in the commands that a user would type.

use super::{Done, products};
use crate::args::{Arguments, Global};
use crate::failure::{Failure, Refusal};
use crate::text::{self, Paint, labelled, quoted};
use crate::{bundled, truth};
use clap::Parser as _;
use dragfree_archive::Written;
use dragfree_archive::files::IoContext as _;
use dragfree_archive::product;
use serde_json::{Value, json};
use std::fs::{self, File};
use std::io::{ErrorKind, Write as _};
use std::path::{Path, PathBuf};

/// File that marks a folder as the demo's own.
const MARK: &str = ".dragfree-demo";

/// What the story makes and makes anew. The archive keeps every revision, the configuration is the user's.
const MADE: [&str; 7] =
    ["day1", "day2", "model.toml", "model.history", "held-out.toml", "held-out.history", "diagnosis.json"];

/// The day of the paper's simulation, and the one after it.
const DAYS: [&str; 2] = ["2035-01-01", "2035-01-02"];

pub(super) fn execute(folder: &Path, open: bool, global: &Global, paint: Paint) -> Result<Done, Failure> {
    if open && global.json {
        return Err(Refusal::OpenAsJson.into());
    }
    own(folder)?;
    for (path, text) in bundled::FILES {
        place(&folder.join(path), text)?;
    }
    for name in MADE {
        clear(&folder.join(name))?;
    }
    let at = |name: &str| folder.join(name).display().to_string();
    let (mission, pipeline, archive) = (at(bundled::MISSION), at(bundled::PIPELINE), at("archive"));
    let (model, held_out, diagnosis) = (at("model.toml"), at("held-out.toml"), at("diagnosis.json"));
    let telemetry = [at("day1/SC1_2035-01-01.mcap"), at("day2/SC1_2035-01-02.mcap")];
    let truth = at("day1/truth/SC1_2035-01-01.mcap");
    let mut story = Story { global, paint, archive: folder.join("archive"), commands: Vec::new() };
    let hidden = |seed: &'static str, out: &'static str, day: &'static str| {
        let out = at(out);
        ["simulate", &mission, "--out", &out, "--start", day, "--hours", "8", "--seed", seed, "--hidden", "38"]
            .map(str::to_owned)
    };
    let run = |telemetry: &str, model: &str| {
        ["run", &pipeline, telemetry, "--model", model, "--archive", &archive].map(str::to_owned)
    };
    let fix = |product: &str| {
        ["model", "fix", &model, "--from", product, "--keep", "com-offset", "--out", &held_out, "--archive", &archive]
            .map(str::to_owned)
    };

    story.say(
        "Eight hours of a drag-free spacecraft. Something acts on it that no model knows; what it is lies sealed.",
    )?;
    story.tell(&hidden("5", "day1", DAYS[0]))?;

    story.say("Calibrate it with the model that every mission starts with: the offset alone. Nothing looks wrong.")?;
    story.copy(&folder.join(bundled::MODEL), Path::new(&model))?;
    let before = story.tell(&run(&telemetry[0], &model))?;
    let first = story.newest(DAYS[0])?;

    story.say("Is there an effect missing? Every installed one is tried.")?;
    let found = story.keep(&["diagnose", &first, "--archive", &archive, "--keep-extract", "--json"], &diagnosis)?;
    story.say("The answer is in that file. In short:")?;
    story.show(&format!("\n{}", summary(&found)))?;

    story.say(
        "Eight other hours of the same spacecraft, kept out of every fit: how well does the old model predict them?",
    )?;
    story.tell(&hidden("6", "day2", DAYS[1]))?;
    story.tell(&fix(&first))?;
    story.tell(&run(&telemetry[1], &held_out))?;
    let first_held_out = story.newest(DAYS[1])?;

    story.say("Add what was found to the model, and calibrate the first hours again.")?;
    story.tell(&["model", "add", &model, "--from", &diagnosis])?;
    let after = story.tell(&run(&telemetry[0], &model))?;
    let second = story.newest(DAYS[0])?;

    story.say("The new model on the hours that were kept out.")?;
    story.tell(&fix(&second))?;
    story.tell(&run(&telemetry[1], &held_out))?;
    let second_held_out = story.newest(DAYS[1])?;

    story.say("Now the seal is opened: was the diagnosis right?")?;
    let sealed = at("day1/truth/SC1_2035-01-01.sealed.json");
    let opened = story.tell(&["reveal", &sealed, "--diagnosis", &diagnosis])?;

    story.say(
        "Before and after: χ² falls on the hours kept out too, and the offset's true error falls back to its σ.",
    )?;
    let ladder = ["ladder", &first, &second, "--held-out", &first_held_out, &second_held_out, "--truth", &truth];
    let ladder = story.tell(&[&ladder[..], &["--archive", &archive]].concat())?;

    let Written { product, path } = products::open(&second, &story.archive)?;
    let code = super::run::code(&product);
    if global.json {
        let mut all = product::to_json(&product, &path);
        all["truth"] = json!(truth::first(Path::new(&truth))?);
        all["story"] = json!({
            "commands": story.commands, "before": before, "diagnosis": found, "after": after, "score": opened["score"],
            "ladder": ladder,
        });
        return Ok(Done { code, ..Done::json(&all) });
    }
    let mut text = format!("\nproduct   {}, before it {first}\n", path.display());
    text += &format!("telemetry {}\n          {}\n", telemetry[0], telemetry[1]);
    text += &format!("next      dragfree products show {second} --archive {archive}\n");
    text += &format!("          dragfree serve --archive {archive} --model {model} --truth {truth}\n");
    text += "          and open the address that it prints: look at it, and switch the effect on by hand\n";
    text += "          hide another: the same commands with another number behind --hidden\n";
    text += "          open the .mcap files in Foxglove, PlotJuggler or Rerun\n";
    if open {
        story.show(&text)?;
        story.say("The switch of the effect is on this page. Ctrl-C ends it.")?;
        let page = format!("missing?products={first}");
        let free = ["serve", "--listen", "127.0.0.1:0", "--archive", &archive];
        story.tell(&[&free[..], &["--model", &model, "--truth", &truth, "--open", &page]].concat())?;
        text.clear();
    }
    Ok(Done { text, code })
}

/// Tells what is done and does it, with the program's own parser: a command is what stands on the screen.
struct Story<'a> {
    global: &'a Global,
    paint: Paint,
    archive: PathBuf,
    commands: Vec<String>,
}

impl Story<'_> {
    fn show(&self, text: &str) -> Result<(), Failure> {
        if !self.global.json {
            crate::output::print(text)?;
        }
        Ok(())
    }

    fn say(&self, sentence: &str) -> Result<(), Failure> {
        self.show(&format!("\n{}", text::wrapped(sentence)))
    }

    fn announce(&mut self, words: &[&str], into: Option<&str>) -> Result<(), Failure> {
        let mut line = words.iter().map(|word| quoted(word)).collect::<Vec<_>>().join(" ");
        if let Some(file) = into {
            line += &format!(" > {}", quoted(file));
        }
        self.show(&format!("\n{}\n", self.paint.bold(&format!("$ {line}"))))?;
        self.commands.push(line);
        Ok(())
    }

    /// Runs `dragfree` with these words; gives what it prints.
    fn run(&mut self, words: &[&str], into: Option<&str>, json: bool) -> Result<String, Failure> {
        let words: Vec<&str> = std::iter::once("dragfree").chain(words.iter().copied()).collect();
        self.announce(&words, into)?;
        let mut arguments = Arguments::try_parse_from(&words)?;
        arguments.global = Global { json, ..self.global.clone() };
        Ok(super::execute(&arguments, self.paint)?.text)
    }

    /// Runs a command and shows what it prints; gives it where the demo answers in JSON, and nothing else.
    fn tell<S: AsRef<str>>(&mut self, words: &[S]) -> Result<Value, Failure> {
        let words: Vec<&str> = words.iter().map(AsRef::as_ref).collect();
        let text = self.run(&words, None, self.global.json)?;
        self.show(&text)?;
        Ok(if self.global.json { serde_json::from_str(&text)? } else { Value::Null })
    }

    /// Runs a command that answers in JSON, into a file, and gives the answer.
    fn keep(&mut self, words: &[&str], file: &str) -> Result<Value, Failure> {
        let text = self.run(words, Some(file), true)?;
        fs::write(file, &text).at("write", file)?;
        Ok(serde_json::from_str(&text)?)
    }

    fn copy(&mut self, from: &Path, to: &Path) -> Result<(), Failure> {
        self.announce(&["cp", &from.display().to_string(), &to.display().to_string()], None)?;
        fs::copy(from, to).at("write", to)?;
        Ok(())
    }

    /// The newest product of a day.
    fn newest(&self, day: &str) -> Result<String, Failure> {
        Ok(products::open(day, &self.archive)?.product.id().to_owned())
    }
}

/// What a diagnosis says in a few lines.
fn summary(diagnosis: &Value) -> String {
    let number = |value: &Value| value.as_f64().unwrap_or(f64::NAN);
    let word = |value: &Value| value.as_str().unwrap_or_default().to_owned();
    let tried = text::grouped(diagnosis["tried"].as_u64().unwrap_or(0));
    let mut lines = labelled("verdict", &format!("{}, of {tried} forms of effects", word(&diagnosis["verdict"])));
    for found in diagnosis["candidates"].as_array().into_iter().flatten().filter(|c| c["accepted"] == true) {
        let (unit, factor) = text::readable_unit(found["unit"].as_str().unwrap_or_default());
        let size = text::measured(number(&found["value"]) * factor, number(&found["sigma"]) * factor);
        let size = format!("{size} {unit}");
        let (fall, p) = (number(&found["delta_chi2"]), number(&found["p_value"]));
        let name = format!("{}:{}", word(&found["effect"]), word(&found["instance"]));
        lines += &labelled("missing", &format!("{name} = {}, χ² falls by {fall:.0}, p {p:.1e}", size.trim_end()));
        for (name, sigmas) in found["offset_shift_sigma"].as_object().into_iter().flatten() {
            let (shift_mm, sigmas) = (1e3 * number(&found["offset_shift_m"][name]), number(sigmas));
            if sigmas.abs() > 1.0 {
                lines += &labelled("without", &format!("{name} is moved by {shift_mm:.2} mm, {sigmas:.1} σ"));
            }
        }
    }
    lines
}

/// Removes what an earlier demo made.
fn clear(path: &Path) -> Result<(), Failure> {
    let removed = if path.is_dir() { fs::remove_dir_all(path) } else { fs::remove_file(path) };
    match removed {
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(()),
        other => Ok(other.at("remove the earlier demo's", path)?),
    }
}

/// Makes `folder` the demo's own: it must be new, empty or an earlier demo's.
fn own(folder: &Path) -> Result<(), Failure> {
    fs::create_dir_all(folder).at("make", folder)?;
    let empty = fs::read_dir(folder).at("read", folder)?.next().is_none();
    if !empty && !folder.join(MARK).is_file() {
        return Err(Refusal::NoDemoFolder(folder.to_owned()).into());
    }
    place(
        &folder.join(MARK),
        "Made by `dragfree demo`, which replaces day1/, day2/ and the story's files when it is run again.\n",
    )
}

/// Writes a bundled file; one that is there is the user's and stays.
fn place(path: &Path, text: &str) -> Result<(), Failure> {
    if let Some(folder) = path.parent() {
        fs::create_dir_all(folder).at("make", folder)?;
    }
    let written = match File::create_new(path) {
        Ok(mut file) => file.write_all(text.as_bytes()),
        Err(error) if error.kind() == ErrorKind::AlreadyExists => Ok(()),
        Err(error) => Err(error),
    };
    Ok(written.at("write", path)?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_of_someone_else_is_refused_and_untouched() {
        let folder = tempfile::tempdir().expect("folder");
        let mine = folder.path().join("mine.txt");
        fs::write(&mine, "mine").expect("write");
        assert!(own(folder.path()).is_err_and(|e| e.is::<Refusal>()));
        assert_eq!(fs::read_dir(folder.path()).expect("folder").count(), 1);
        fs::remove_file(&mine).expect("remove");
        own(folder.path()).expect("an empty folder will do");
        own(folder.path()).expect("and the demo's own");
    }

    #[test]
    fn a_file_that_the_user_changed_stays() {
        let folder = tempfile::tempdir().expect("folder");
        let path = folder.path().join("missions/taiji.toml");
        place(&path, "first").expect("written");
        fs::write(&path, "changed").expect("write");
        place(&path, "first").expect("left alone");
        assert_eq!(fs::read_to_string(&path).expect("read"), "changed");
    }
}
