//! How fast the workbench answers over many days: a switch, and a diagnosis of all days from their extracts.

use std::path::Path;
use std::time::Instant;

use dragfree_tests::browser::get;
use rand::seq::SliceRandom as _;
use rand::{RngExt as _, SeedableRng as _};
use rand_xoshiro::Xoshiro256PlusPlus;
use serde::Serialize;
use serde_json::Value;

use crate::campaign::{Meter, ScratchFolder, note, science_mode, taiji};
use crate::error::{CampaignError, file};
use crate::program::{Chain, Program};

/// What is in every day.
const HIDDEN: [&str; 2] = ["--effect", "mps-tilt:sc.z=0.08"];
/// Most effects that are on at a time.
const MOST_ON: usize = 10;
/// Requests that are timed.
const REQUESTS: usize = 200;

/// What was measured.
#[derive(Clone, Debug, Serialize)]
struct Measured {
    days: u32,
    hours: f64,
    /// Extract of a day.
    extract_mb: f64,
    /// A switch, s: median, 95 of 100, longest.
    switch_s: [f64; 3],
    /// The first one, which reads the extracts, s.
    first_s: f64,
    /// Memory of the server, MB.
    server_mb: f64,
    /// A diagnosis of all days from their extracts, s.
    diagnosis_s: f64,
}

/// Simulates days, diagnoses each, and asks a server for random switches over all of them.
pub(crate) fn workbench(
    program: &Program,
    days: u32,
    hours: f64,
    results: &Path,
    scratch: &Path,
) -> Result<(), CampaignError> {
    let folder = scratch.join("workbench");
    ScratchFolder::new(&folder)?;
    let archive = folder.join("archive");
    let ids = diagnosed(program, days, hours, &folder, &archive)?;
    let (begun, all) = (Instant::now(), ids.iter().map(|id| serde_json::json!({ "id": id })).collect::<Vec<_>>());
    program.diagnose_together(&all, &archive, &["--extracts"])?;
    let diagnosis_s = begun.elapsed().as_secs_f64();
    let mut server = program.serve(&archive)?;
    let asked = switches(server.port, &ids);
    let server_mb = server.memory_mb();
    server.end();
    let (first_s, mut times) = asked?;
    times.sort_by(f64::total_cmp);
    let at = |part: f64| times[((times.len() - 1) as f64 * part).round() as usize];
    let measured = Measured {
        days,
        hours,
        extract_mb: extracts_mb(&archive)? / f64::from(days),
        switch_s: [at(0.5), at(0.95), at(1.0)],
        first_s,
        server_mb,
        diagnosis_s,
    };
    let text = serde_json::to_string_pretty(&measured).map_err(|e| file(results, &e))?;
    note(&text);
    std::fs::write(results, text + "\n").map_err(|e| file(results, &e))?;
    std::fs::remove_dir_all(&folder).map_err(|e| file(&folder, &e))
}

/// The products of the days, each with its extract.
fn diagnosed(
    program: &Program,
    days: u32,
    hours: f64,
    folder: &Path,
    archive: &Path,
) -> Result<Vec<String>, CampaignError> {
    let chain = Chain { pipeline: science_mode(), ..Chain::default() };
    let meter = Meter::new(f64::from(days));
    let mut ids = Vec::new();
    for day in 0..days {
        let start = (chrono::NaiveDate::from_ymd_opt(2035, 1, 1).unwrap_or_default()
            + chrono::Days::new(u64::from(day)))
        .to_string();
        let telemetry = folder.join(format!("telemetry-{day}"));
        let (seed, hours) = ((500 + day).to_string(), hours.to_string());
        let arguments = [&["--start", &start, "--seed", &seed, "--hours", &hours], &HIDDEN[..]].concat();
        let simulated = program.simulate(&taiji(), &telemetry, &arguments)?;
        let product = program.run(&chain, &simulated.files, archive)?;
        program.diagnose_together(std::slice::from_ref(&product), archive, &["--keep-extract"])?;
        std::fs::remove_dir_all(&telemetry).map_err(|e| file(&telemetry, &e))?;
        let id = product["id"].as_str().unwrap_or_default().to_owned();
        meter.say(1.0, &id);
        ids.push(id);
    }
    Ok(ids)
}

/// Seconds of the first request, and of each of the others.
fn switches(port: u16, ids: &[String]) -> Result<(f64, Vec<f64>), CampaignError> {
    let products = ids.join(",");
    let ask = |on: &str| -> Result<(f64, Value), CampaignError> {
        let begun = Instant::now();
        let answer = get(port, &format!("/refit.json?products={products}&on={on}"));
        let took = begun.elapsed().as_secs_f64();
        let refit = serde_json::from_str(&answer.body).map_err(|e| file(Path::new("/refit.json"), &e))?;
        Ok((took, refit))
    };
    let (first_s, refit) = ask("")?;
    let effects = refit["effects"].as_array().into_iter().flatten().filter_map(|e| e["name"].as_str());
    let mut effects: Vec<String> = effects.map(|name| name.replace('#', "%23")).collect();
    let mut random = Xoshiro256PlusPlus::seed_from_u64(1);
    let mut times = Vec::new();
    for _ in 0..REQUESTS {
        effects.shuffle(&mut random);
        let on = random.random_range(1..=MOST_ON.min(effects.len()));
        times.push(ask(&effects[..on].join(","))?.0);
    }
    Ok((first_s, times))
}

fn extracts_mb(archive: &Path) -> Result<f64, CampaignError> {
    let mut bytes = 0;
    for entry in std::fs::read_dir(archive).map_err(|e| file(archive, &e))? {
        let path = entry.map_err(|e| file(archive, &e))?.path();
        if path.to_string_lossy().ends_with(".extract.json") {
            bytes += std::fs::metadata(&path).map_err(|e| file(&path, &e))?.len();
        }
    }
    Ok(bytes as f64 / 1e6)
}
