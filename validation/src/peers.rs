//! The heaviest steps side by side with the packages that the field uses, each pair on the same inputs, with the same
//! result, on one core, in turn.
//!
//! Python packages run in a virtual environment of their own, which the command makes from
//! `validation/peers/requirements.txt`; the work they do is in `validation/peers/peers.py`.

mod work;

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Instant;

use serde::{Deserialize, Serialize};

use crate::campaign::{ScratchFolder, note};
use crate::error::{CampaignError, file};
use crate::program::{Program, output, root};
use crate::records::write_document;
use crate::stats::median;
use work::{Task, Work, tasks};

/// What was measured.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Peers {
    /// Date of the measurement.
    pub(crate) date: String,
    /// One for each peer.
    pub(crate) pairs: Vec<Pair>,
}

/// One piece of work by this project and by another.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Pair {
    /// The work.
    pub(crate) work: String,
    /// Part of this project that does it.
    pub(crate) own: String,
    /// Package and version, and what it does.
    pub(crate) peer: String,
    /// Seconds of this project, median of the rounds.
    pub(crate) own_s: f64,
    /// Seconds of the other.
    pub(crate) peer_s: f64,
    /// Their ratio in each round: median, least, largest.
    pub(crate) times: [f64; 3],
    /// Largest difference of the results in units of what is allowed; `None` where there is nothing to compare.
    pub(crate) difference: Option<f64>,
}

/// One line of what `peers.py` prints.
#[derive(Deserialize)]
struct Said {
    peer: String,
    /// Own work that it is compared with; empty for the first.
    #[serde(default)]
    own: String,
    seconds: f64,
    result: Vec<f64>,
}

/// What was met of a peer.
#[derive(Default)]
struct Met {
    own: usize,
    /// Seconds of own work and of the peer's, round by round.
    seconds: Vec<[f64; 2]>,
    difference: Option<f64>,
}

const ROUNDS: usize = 5;

/// Times all pairs and writes the file.
pub(crate) fn peers(program: &Program, results: &Path, scratch: &Path) -> Result<(), CampaignError> {
    let python = environment(&scratch.join("peers-python"))?;
    let folder = ScratchFolder::new(&scratch.join("peers"))?;
    let mut pairs = Vec::new();
    for task in &mut tasks(program, &folder)? {
        let measured = side_by_side(task, &python)?;
        for pair in &measured {
            note(&format!(
                "{}: {} / {} {:.2} (result {:?})",
                pair.work, pair.peer, pair.own, pair.times[0], pair.difference
            ));
        }
        pairs.extend(measured);
    }
    let date = chrono::Utc::now().format("%Y-%m-%d").to_string();
    write_document(results, &Peers { date, pairs })
}

/// A Python with the packages of `requirements.txt`, made where it is missing or older than that file.
fn environment(folder: &Path) -> Result<PathBuf, CampaignError> {
    let wanted = root().join("validation/peers/requirements.txt");
    let text = std::fs::read_to_string(&wanted).map_err(|e| file(&wanted, &e))?;
    let (python, stamp) = (folder.join("bin/python"), folder.join("requirements.txt"));
    if std::fs::read_to_string(&stamp).is_ok_and(|there| there == text) {
        return Ok(python);
    }
    note("installing the Python packages of validation/peers/requirements.txt");
    output(Command::new("python3").args(["-m", "venv", "--clear"]).arg(folder), &[0])?;
    output(Command::new(&python).args(["-m", "pip", "install", "--quiet", "-r"]).arg(&wanted), &[0])?;
    std::fs::write(&stamp, text).map_err(|e| file(&stamp, &e))?;
    Ok(python)
}

/// Own work and that of the peers in turn. The first round, in which files and code are read for the first time, does
/// not count.
fn side_by_side(task: &mut Task, python: &Path) -> Result<Vec<Pair>, CampaignError> {
    let mut met: BTreeMap<String, Met> = BTreeMap::new();
    for round in 0..=ROUNDS {
        let own: Vec<(f64, Vec<f64>)> = task.own.iter_mut().map(timed).collect();
        let in_process = task.peers.iter_mut().map(|work| {
            let (seconds, result) = timed(work);
            Said { peer: work.name.clone(), own: String::new(), seconds, result }
        });
        let mut others: Vec<Said> = in_process.collect();
        let mut command = Command::new(python);
        command.arg(root().join("validation/peers/peers.py")).arg(task.name).arg(&task.folder);
        for line in String::from_utf8_lossy(&output(&mut command, &[0])?).lines() {
            let said =
                serde_json::from_str(line).map_err(|e| file(&task.folder, &format!("{}: {e}: {line}", task.name)));
            others.push(said?);
        }
        for said in others.into_iter().filter(|_| round > 0) {
            let against = task.own.iter().position(|work| work.name == said.own).unwrap_or(0);
            let (own_s, result) = &own[against];
            let entry = met.entry(said.peer).or_default();
            entry.own = against;
            entry.seconds.push([*own_s, said.seconds]);
            let differences = [entry.difference, task.difference(result, &said.result)];
            entry.difference = differences.into_iter().flatten().reduce(f64::max);
        }
    }
    Ok(met.into_iter().map(|(peer, met)| pair(task, peer, &met)).collect())
}

fn timed(work: &mut Work) -> (f64, Vec<f64>) {
    let start = Instant::now();
    let result = (work.run)();
    (start.elapsed().as_secs_f64(), result)
}

fn pair(task: &Task, peer: String, met: &Met) -> Pair {
    let mut ratios: Vec<f64> = met.seconds.iter().map(|[own, other]| other / own).collect();
    ratios.sort_by(f64::total_cmp);
    let seconds = |i: usize| median(met.seconds.iter().map(|s| s[i]).collect());
    Pair {
        work: task.words.to_owned(),
        own: task.own[met.own].name.clone(),
        peer,
        own_s: seconds(0),
        peer_s: seconds(1),
        times: [median(ratios.clone()), ratios[0], ratios[ratios.len() - 1]],
        difference: met.difference,
    }
}

impl Peers {
    /// The table of the report.
    pub(crate) fn table(&self) -> String {
        let mut text = format!(
            "Measured on {}: one core, in turn, medians of {ROUNDS} rounds (least and largest ratio in brackets), after \
             the results had been compared. A ratio above one means that this project is faster.\n\n",
            self.date
        );
        text += "| work | here | peer | here, ms | peer, ms | ratio |\n|---|---|---|---|---|---|\n";
        for p in &self.pairs {
            let [times, least, largest] = p.times;
            let ratio = match p.difference {
                Some(d) if d > 1.0 => "another result".to_owned(),
                _ => {
                    let digits = usize::from(times < 100.0);
                    format!("{times:.digits$} ({least:.digits$}–{largest:.digits$})")
                }
            };
            let ms = |s: f64| if s < 0.1 { format!("{:.2}", 1e3 * s) } else { format!("{:.0}", 1e3 * s) };
            let _ = writeln!(
                text,
                "| {} | {} | {} | {} | {} | {ratio} |",
                p.work,
                p.own,
                p.peer,
                ms(p.own_s),
                ms(p.peer_s)
            );
        }
        text
    }
}
