//! The blind campaign: telemetry with effects drawn by a seed, diagnosed, and scored after the seal is opened.
//!
//! Each seed runs `simulate --hidden`, `run`, `diagnose` and `reveal`, as a user would. The sealed truth is moved away
//! before anything reads the telemetry. If every accepted cause is true and can be added to a model, the same telemetry
//! is calibrated again, and other telemetry with the same hidden causes is predicted by the model before, the model
//! after, and one with the true values.

use std::ffi::OsStr;
use std::ops::RangeInclusive;
use std::path::Path;
use std::time::Instant;

use serde_json::Value;

use crate::blind_report::numbers;
use crate::campaign::{Meter, note, work};
use crate::error::{CampaignError, file};
use crate::program::{Chain, Hidden, Program, root, solution};
use crate::records::{After, Blind, Results};

/// Runs the seeds that `results` lacks, `at_once` in parallel.
/// After an error the results so far are on disk, and the next call continues.
pub(crate) fn blind(
    program: &Program,
    seeds: RangeInclusive<u32>,
    hours: f64,
    at_once: usize,
    results: &Path,
    scratch: &Path,
) -> Result<(), CampaignError> {
    let build = program.digest()?;
    let configuration = format!("hidden-{hours}h");
    let (results, dropped) = Results::<Blind>::open(results, &build)?;
    if dropped > 0 {
        note(&format!("{dropped} results of another build are dropped and measured again"));
    }
    let left: Vec<u32> = seeds.filter(|seed| !results.has(&configuration, *seed)).collect();
    let meter = Meter::new(left.len() as f64);
    let pipeline = root().join("fixtures/pipelines/science-mode.toml");
    work(left, at_once, |seed| {
        let folder = scratch.join(format!("blind-{seed}"));
        let io = |e: std::io::Error| file(&folder, &e);
        if folder.exists() {
            std::fs::remove_dir_all(&folder).map_err(io)?;
        }
        std::fs::create_dir_all(&folder).map_err(io)?;
        let mission = root().join("fixtures/missions/taiji.toml");
        let hidden = program.hide(&mission, &folder, [seed, seed], hours)?;
        let archive = folder.join("archive");
        let bare = folder.join("bare.toml");
        std::fs::copy(root().join("fixtures/models/com-offset.toml"), &bare).map_err(io)?;
        let chain = Chain { pipeline: pipeline.clone(), model: Some(bare), ..Chain::default() };
        let product = program.run(&chain, &hidden.files, &archive)?;
        let start = Instant::now();
        let diagnosis = program.diagnose(&product, &archive)?;
        let diagnosis_s = (start.elapsed().as_secs_f64() * 10.0).round() / 10.0;
        let answer = folder.join("diagnosis.json");
        std::fs::write(&answer, diagnosis.to_string()).map_err(io)?;
        let score = program.reveal(&hidden, &answer)?;
        let lacks = |what: String| CampaignError::Product { configuration: configuration.clone(), seed, what };
        let set = Set { program, folder: &folder, archive: &archive, chain: &chain, hidden: &hidden };
        let line = Blind {
            configuration: configuration.clone(),
            seed,
            build: build.clone(),
            diagnosis_s,
            before: solution(&product, "adopted", &hidden.truth_m).map_err(lacks)?,
            after: match to_add(&diagnosis, &score) {
                names if names.is_empty() => None,
                names => {
                    let unseen = program.hide(&mission, &folder.join("unseen"), [seed, OTHER_NOISE + seed], hours)?;
                    Some(set.after(&product, &answer, &score, names, &unseen, &lacks)?)
                }
            },
            score: score.clone(),
        };
        results.append(line)?;
        std::fs::remove_dir_all(&folder).map_err(io)?;
        meter.say(1.0, &format!("seed {seed}: {} ({diagnosis_s} s)", score["verdict"].as_str().unwrap_or("?")));
        Ok(())
    })?;
    note(&numbers(&results.sort(&[&configuration])?).0);
    Ok(())
}

/// Offset between the seed of the noise and that of the withheld telemetry.
const OTHER_NOISE: u32 = 1_000_000;

/// Accepted causes to add to a model, if all of them are true and none is a noise level or a transient.
fn to_add(diagnosis: &Value, score: &Value) -> Vec<String> {
    let accepted: Vec<&Value> =
        diagnosis["candidates"].as_array().into_iter().flatten().filter(|c| c["accepted"] == true).collect();
    let none_false = score["false_causes"].as_array().is_some_and(Vec::is_empty);
    let lasting = |c: &&&Value| c["chi2_per_dof_before"].is_f64();
    if !none_false || !accepted.iter().all(|c| lasting(&c)) {
        return Vec::new();
    }
    let name = |c: &Value| format!("{}:{}", c["effect"].as_str().unwrap_or("?"), c["instance"].as_str().unwrap_or("?"));
    accepted.into_iter().map(name).collect()
}

/// Files of one seed.
struct Set<'a> {
    program: &'a Program,
    folder: &'a Path,
    archive: &'a Path,
    chain: &'a Chain,
    hidden: &'a Hidden,
}

impl Set<'_> {
    fn after(
        &self,
        before: &Value,
        diagnosis: &Path,
        score: &Value,
        added: Vec<String>,
        unseen: &Hidden,
        lacks: &impl Fn(String) -> CampaignError,
    ) -> Result<After, CampaignError> {
        let io = |e: std::io::Error| file(self.folder, &e);
        let [bare, found, knowing] = ["bare", "found", "knowing"].map(|name| self.folder.join(format!("{name}.toml")));
        for model in [&found, &knowing] {
            std::fs::copy(&bare, model).map_err(io)?;
        }
        let mut known = true;
        for name in &added {
            let words = |model: &Path, more: &[String]| {
                let mut all = vec!["add".into(), model.as_os_str().to_owned(), name.into()];
                all.extend(["--from".into(), diagnosis.as_os_str().to_owned()]);
                all.extend(more.iter().map(|word| OsStr::new(word).to_owned()));
                self.program.model(&all.iter().map(AsRef::as_ref).collect::<Vec<_>>())
            };
            words(&found, &[])?;
            match truth_as_words(score, name) {
                Some(fixed) if known => words(&knowing, &fixed)?,
                _ => known = false,
            }
        }
        let run = |model: &Path, files: &[_]| {
            let chain = Chain { model: Some(model.to_owned()), ..self.chain.clone() };
            self.program.run(&chain, files, self.archive)
        };
        let after = run(&found, &self.hidden.files)?;
        let id = |product: &Value| product["id"].as_str().map(str::to_owned).ok_or_else(|| lacks("id".to_owned()));
        let fixed = |model: &Path, product: &Value| {
            let (out, id) = (model.with_extension("fixed.toml"), id(product)?);
            let words = [OsStr::new("fix"), model.as_os_str(), "--from".as_ref(), id.as_ref(), "--keep".as_ref()];
            let more = ["com-offset".as_ref(), "--out".as_ref(), out.as_os_str(), "--archive".as_ref()];
            self.program.model(&[&words[..], &more[..], &[self.archive.as_os_str()]].concat())?;
            Ok::<_, CampaignError>(out)
        };
        let chi2 = |model: &Path| Ok::<_, CampaignError>(run(model, &unseen.files)?["chi2_per_dof"].as_f64());
        Ok(After {
            offset: solution(&after, "adopted", &self.hidden.truth_m).map_err(lacks)?,
            held_out_chi2_per_dof: [
                chi2(&fixed(&bare, before)?)?,
                chi2(&fixed(&found, &after)?)?,
                if known { chi2(&knowing)? } else { None },
            ],
            added,
        })
    }
}

/// True values and shape of an effect as arguments of `model add`; `None` if not all are known.
fn truth_as_words(score: &Value, name: &str) -> Option<Vec<String>> {
    let effects = score["effects"].as_array()?;
    let named =
        |e: &&Value| e["effect"].as_str().zip(e["instance"].as_str()).is_some_and(|(a, b)| format!("{a}:{b}") == name);
    let effect = effects.iter().find(named)?;
    let mut words = Vec::new();
    let values = effect["values"].as_array().filter(|values| !values.is_empty())?;
    for value in values {
        let number = value["truth"].as_f64()?;
        let part = value["coefficient"].as_str()?.strip_prefix(&name.replacen(':', ".", 1))?.trim_start_matches('.');
        let of = if part.is_empty() { String::new() } else { format!("{part}=") };
        words.extend(["--fixed".to_owned(), format!("{of}{number:e}")]);
    }
    for (parameter, value) in effect["expected_shape"].as_object()? {
        words.extend(["--set".to_owned(), format!("{parameter}={value}")]);
    }
    Some(words)
}
