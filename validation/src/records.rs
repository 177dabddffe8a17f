//! Results on disk: one JSON line per configuration and seed, appended as soon as it is known.

use crate::error::{CampaignError, file};
use nalgebra::DMatrix;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::fs::{File, OpenOptions};
use std::io::{ErrorKind, Write as _};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};

/// The coefficients of the model, in the order of every array of six.
pub(crate) const COEFFICIENTS: [&str; 6] = [
    "com-offset.tm1.x",
    "com-offset.tm1.y",
    "com-offset.tm1.z",
    "com-offset.tm2.x",
    "com-offset.tm2.y",
    "com-offset.tm2.z",
];

/// One solution of one run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Solution {
    /// Estimates, m.
    pub(crate) value_m: [f64; 6],
    /// Estimate minus truth, m.
    pub(crate) error_m: [f64; 6],
    /// Upper triangle of the covariance by rows, m²; its diagonal is σ².
    pub(crate) covariance_m2: Vec<f64>,
}

impl Solution {
    /// The whole covariance, m².
    pub(crate) fn covariance(&self) -> DMatrix<f64> {
        DMatrix::from_fn(6, 6, |i, j| {
            let (i, j) = (i.min(j), i.max(j));
            self.covariance_m2[i * 6 - i * (i + 1) / 2 + j]
        })
    }

    /// σ, m.
    pub(crate) fn sigma_m(&self) -> [f64; 6] {
        let c = self.covariance();
        std::array::from_fn(|i| c[(i, i)].sqrt())
    }

    /// The same with every σ divided by a factor.
    fn divided(&self, factor: impl Fn(usize) -> f64) -> Self {
        let rows = (0..6).flat_map(|i| (i..6).map(move |j| (i, j)));
        let covariance_m2 = rows.zip(&self.covariance_m2).map(|((i, j), c)| c / factor(i) / factor(j)).collect();
        Self { covariance_m2, ..self.clone() }
    }

    /// Error over σ.
    pub(crate) fn pulls(&self) -> [f64; 6] {
        let sigma = self.sigma_m();
        std::array::from_fn(|i| self.error_m[i] / sigma[i])
    }
}

/// Result of one run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Line {
    /// Configuration.
    pub(crate) configuration: String,
    /// Seed of the simulation.
    pub(crate) seed: u32,
    /// Length of the data, h.
    pub(crate) hours: f64,
    /// Day of the run.
    pub(crate) date: String,
    /// The program and its version.
    pub(crate) software: String,
    /// Digest of the plugins' libraries, twelve hexadecimal digits.
    pub(crate) build: String,
    /// Verdict of the product.
    pub(crate) verdict: String,
    /// Normalised innovation squared over its degrees of freedom.
    pub(crate) nis: f64,
    /// Its degrees of freedom.
    pub(crate) nis_dof: f64,
    /// χ²/dof of the batch solution against the noise of the mission file.
    pub(crate) chi2_per_dof: f64,
    /// Factor by which the ES-AKF inflated its σ, per test mass.
    pub(crate) sigma_stretch: [f64; 2],
    /// Factor by which the batch solution inflated its σ, per coefficient.
    pub(crate) qp_widened: [f64; 6],
    /// σ of the recursion's end, as the paper reports it, m.
    pub(crate) p_end_sigma_m: [f64; 6],
    /// Recursive solution.
    pub(crate) es_akf: Solution,
    /// Batch solution.
    pub(crate) qp: Solution,
    /// Adopted solution; `None` if it is the batch solution unchanged.
    pub(crate) adopted: Option<Solution>,
}

impl Line {
    /// Recursive and batch solution with σ before inflation.
    pub(crate) fn bare(&self) -> (Solution, Solution) {
        (self.es_akf.divided(|i| self.sigma_stretch[i / 3]), self.qp.divided(|i| self.qp_widened[i]))
    }

    /// Adopted solution.
    pub(crate) fn adopted(&self) -> &Solution {
        self.adopted.as_ref().unwrap_or(&self.qp)
    }
}

/// A result with a key, unique per build.
pub(crate) trait Keyed {
    /// Configuration and seed.
    fn key(&self) -> (String, u32);
    /// What program and plugins it was made with: the digest of a build, or a commit.
    fn made_with(&self) -> &str;
}

impl Keyed for Line {
    fn key(&self) -> (String, u32) {
        (self.configuration.clone(), self.seed)
    }

    fn made_with(&self) -> &str {
        &self.build
    }
}

/// Result of one set of the diagnosis campaign.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Diagnosed {
    /// Length, producer, whether nothing was to be hidden, and arguments: with the seed, the key.
    pub(crate) configuration: String,
    /// Seed of everything drawn.
    pub(crate) seed: u32,
    /// Commit of program, plugins and campaign.
    pub(crate) commit: String,
    /// Length, as `6h`.
    pub(crate) length: String,
    /// `own` or `foreign`.
    pub(crate) producer: String,
    /// Additional arguments of `dragfree diagnose`.
    pub(crate) arguments: String,
    /// What a foreign set was drawn with: loops, noise, start, gaps. Null for the bundled simulator.
    pub(crate) drawn: Value,
    /// Duration of the diagnosis, s.
    pub(crate) diagnosis_s: f64,
    /// What the program said when it failed to calibrate or diagnose.
    pub(crate) failed: Option<String>,
    /// Verdict of each product.
    pub(crate) run_verdicts: Vec<String>,
    /// χ²/dof of each product.
    pub(crate) chi2_per_dof: Vec<f64>,
    /// The diagnosis against the truth; `None` if the program failed.
    pub(crate) answer: Option<Answer>,
    /// What was hidden, with what became of it.
    pub(crate) effects: Vec<Acted>,
    /// Offset of each product by the model without additions.
    pub(crate) before: Vec<Solution>,
    /// Offset by the extended model; `None` if nothing was named, or not everything that was named is true.
    pub(crate) after: Option<Extended>,
    /// What a formula says of other data; `None` unless the one hidden effect is a force that no effect covers.
    pub(crate) kept_out: Option<KeptOut>,
}

/// By how much χ² falls on data that no fit has seen, with a formula that was fitted to the data of the set.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct KeptOut {
    /// The formulas that the diagnosis proposes; `None` if it proposes none, or the program cannot run them.
    pub(crate) proposed: Option<f64>,
    /// The formula of the force that acts; `None` if the program cannot run it.
    pub(crate) true_formula: Option<f64>,
}

/// What a diagnosis said as a whole.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Answer {
    /// `sufficient`, `missing` or `unexplained`.
    pub(crate) verdict: String,
    /// Accepted candidates, best first.
    pub(crate) named: Vec<String>,
    /// Those of them that are neither true nor confounded with a truth that was not named.
    pub(crate) false_causes: Vec<String>,
    /// The description of an unexplained remainder.
    pub(crate) unexplained: Value,
}

/// A hidden effect and what became of it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Acted {
    /// `EFFECT:INSTANCE`.
    pub(crate) name: String,
    /// True size, in `unit`.
    pub(crate) size: f64,
    /// SI unit.
    pub(crate) unit: String,
    /// Whether a bundled effect covers the kind.
    pub(crate) known: bool,
    /// Significance for which its size was drawn, by an approximate table.
    pub(crate) drawn_significance: f64,
    /// Significance with the σ of the diagnosis; `None` if it states none for the truth.
    pub(crate) significance_at_hand: Option<f64>,
    /// Whether it is accepted.
    pub(crate) named: bool,
    /// Whether it is accepted, and nothing false before it.
    pub(crate) first: bool,
    /// Accepted candidates that list it as a confounder.
    pub(crate) confounder_of: Vec<String>,
    /// Members of the smallest set of an accepted candidate and its confounders that contains it.
    pub(crate) set_size: Option<usize>,
    /// Estimate minus truth over σ of each coefficient, where it is accepted.
    pub(crate) difference_sigma: Vec<f64>,
}

/// Calibrations with what was named.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Extended {
    /// Added effects.
    pub(crate) added: Vec<String>,
    /// What the program said when an effect could not be added or the model did not run.
    pub(crate) failed: Option<String>,
    /// Offset of each product; none if it failed.
    pub(crate) offset: Vec<Solution>,
}

impl Keyed for Diagnosed {
    fn key(&self) -> (String, u32) {
        (self.configuration.clone(), self.seed)
    }

    fn made_with(&self) -> &str {
        &self.commit
    }
}

/// A growing file of results, shared by threads.
#[derive(Debug)]
pub(crate) struct Results<T> {
    path: PathBuf,
    /// The file and what is in it.
    state: Mutex<(File, Vec<T>)>,
}

/// Results of a file; empty if it does not exist. A last line without its end was interrupted and is ignored.
pub(crate) fn read<T: DeserializeOwned>(path: &Path) -> Result<Vec<T>, CampaignError> {
    let text = match std::fs::read_to_string(path) {
        Err(error) if error.kind() == ErrorKind::NotFound => String::new(),
        other => other.map_err(|e| file(path, &e))?,
    };
    let complete = text.rfind('\n').map_or("", |end| &text[..end]);
    let parse = |(i, line): (usize, &str)| {
        serde_json::from_str(line).map_err(|source| CampaignError::Line { path: path.to_owned(), line: i + 1, source })
    };
    complete.lines().enumerate().map(parse).collect()
}

/// A document of results; `None` if it does not exist.
pub(crate) fn read_document<T: DeserializeOwned>(path: &Path) -> Result<Option<T>, CampaignError> {
    match std::fs::read_to_string(path) {
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(None),
        Err(error) => Err(file(path, &error)),
        Ok(text) => serde_json::from_str(&text).map(Some).map_err(|e| file(path, &e)),
    }
}

/// Writes a document of results.
pub(crate) fn write_document(path: &Path, document: &impl Serialize) -> Result<(), CampaignError> {
    let text = serde_json::to_string_pretty(document).map_err(|e| file(path, &e))?;
    std::fs::write(path, text + "\n").map_err(|e| file(path, &e))
}

impl<T: Keyed + Serialize + DeserializeOwned> Results<T> {
    /// Opens a file to continue, or a new one. Removes results of another build, as a table must not mix builds;
    /// returns their number.
    pub(crate) fn open(path: &Path, build: &str) -> Result<(Self, usize), CampaignError> {
        let mut lines: Vec<T> = read(path)?;
        let before = lines.len();
        lines.retain(|line| line.made_with() == build);
        let dropped = before - lines.len();
        std::fs::create_dir_all(path.parent().unwrap_or(Path::new("."))).map_err(|e| file(path, &e))?;
        replace(path, &lines)?;
        let file = OpenOptions::new().append(true).open(path).map_err(|e| file(path, &e))?;
        Ok((Self { path: path.to_owned(), state: Mutex::new((file, lines)) }, dropped))
    }

    fn state(&self) -> MutexGuard<'_, (File, Vec<T>)> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Whether a result exists.
    pub(crate) fn has(&self, configuration: &str, seed: u32) -> bool {
        self.state().1.iter().any(|line| line.key() == (configuration.to_owned(), seed))
    }

    /// Appends a result in one write.
    pub(crate) fn append(&self, line: T) -> Result<(), CampaignError> {
        let text = as_lines(&self.path, std::slice::from_ref(&line))?;
        let mut state = self.state();
        state.0.write_all(&text).map_err(|e| file(&self.path, &e))?;
        state.1.push(line);
        Ok(())
    }

    /// Rewrites the file in the order of configurations and seeds, independent of the order of completion; gives the
    /// results.
    pub(crate) fn sort(self, configurations: &[impl AsRef<str>]) -> Result<Vec<T>, CampaignError> {
        let place = |name: &str| configurations.iter().position(|c| c.as_ref() == name);
        let (_, mut lines) = self.state.into_inner().unwrap_or_else(PoisonError::into_inner);
        lines.sort_by_key(|line| {
            let (configuration, seed) = line.key();
            (place(&configuration), configuration, seed)
        });
        replace(&self.path, &lines)?;
        Ok(lines)
    }
}

/// Replaces a file by these results, without an interrupted line; a kill leaves either file whole.
fn replace<T: Serialize>(path: &Path, lines: &[T]) -> Result<(), CampaignError> {
    let fresh = path.with_extension("tmp");
    std::fs::write(&fresh, as_lines(path, lines)?).map_err(|e| file(path, &e))?;
    std::fs::rename(&fresh, path).map_err(|e| file(path, &e))
}

/// Results as JSON, one per line; `path` is for messages.
fn as_lines<T: Serialize>(path: &Path, lines: &[T]) -> Result<Vec<u8>, CampaignError> {
    let mut text = Vec::new();
    for line in lines {
        serde_json::to_writer(&mut text, line).map_err(|e| file(path, &e))?;
        text.push(b'\n');
    }
    Ok(text)
}

/// Rounds to seven significant digits, more than any statistic needs.
pub(crate) fn rounded(value: f64) -> f64 {
    format!("{value:.6e}").parse().unwrap_or(value)
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    pub(crate) fn solution(error_m: [f64; 6], sigma_m: f64) -> Solution {
        let mut covariance_m2 = Vec::new();
        for i in 0..6 {
            for j in i..6 {
                covariance_m2.push(if i == j { sigma_m * sigma_m } else { 0.0 });
            }
        }
        Solution { value_m: error_m, error_m, covariance_m2 }
    }

    pub(crate) fn line(configuration: &str, seed: u32) -> Line {
        Line {
            configuration: configuration.to_owned(),
            seed,
            hours: 24.0,
            date: "2035-01-01".to_owned(),
            software: "dragfree 0.1.0".to_owned(),
            build: "abc".to_owned(),
            verdict: "agree".to_owned(),
            nis: 1.0,
            nis_dof: 5e6,
            chi2_per_dof: 1.0,
            sigma_stretch: [1.0; 2],
            qp_widened: [1.0; 6],
            p_end_sigma_m: [1e-3; 6],
            es_akf: solution([1e-3; 6], 1e-3),
            qp: solution([1e-4; 6], 2e-4),
            adopted: None,
        }
    }

    #[test]
    fn a_triangle_becomes_its_matrix() {
        let mut s = solution([0.0; 6], 1.0);
        s.covariance_m2 = (0..21).map(f64::from).collect();
        let c = s.covariance();
        assert_eq!((c[(0, 5)], c[(1, 1)], c[(5, 1)], c[(5, 5)]), (5.0, 6.0, 10.0, 20.0));
        assert_eq!(c, c.transpose());
    }

    /// An interruption at any byte of the last write keeps all complete lines once; the rest is repeated.
    #[test]
    fn a_kill_in_the_middle_loses_and_doubles_nothing() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("results.jsonl");
        let (results, dropped) = Results::open(&path, "abc").unwrap();
        assert_eq!(dropped, 0);
        for seed in [2, 1] {
            results.append(line("nominal", seed)).unwrap();
        }
        drop(results);
        let whole = std::fs::read(&path).unwrap();
        let first = whole.iter().position(|b| *b == b'\n').unwrap() + 1;
        for cut in (first..whole.len()).step_by(7).chain([whole.len() - 1]) {
            std::fs::write(&path, &whole[..cut]).unwrap();
            let (results, _) = Results::<Line>::open(&path, "abc").unwrap();
            assert!(results.has("nominal", 2) && !results.has("nominal", 1), "cut at {cut}");
            results.append(line("nominal", 1)).unwrap();
            drop(results);
            assert_eq!(std::fs::read(&path).unwrap(), whole, "cut at {cut}");
        }
        let (results, _) = Results::<Line>::open(&path, "abc").unwrap();
        results.sort(&["nominal"]).unwrap();
        let seeds: Vec<u32> = read::<Line>(&path).unwrap().iter().map(|l| l.seed).collect();
        assert_eq!(seeds, [1, 2]);
    }

    #[test]
    fn results_of_another_build_are_dropped_and_nonsense_is_refused() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("results.jsonl");
        let (results, _) = Results::open(&path, "abc").unwrap();
        results.append(line("nominal", 1)).unwrap();
        let (results, dropped) = Results::<Line>::open(&path, "def").unwrap();
        assert_eq!((results.state().1.len(), dropped), (0, 1));
        std::fs::write(&path, "{}\n").unwrap();
        let error = Results::<Line>::open(&path, "abc").unwrap_err().to_string();
        assert!(error.contains("line 1"), "{error}");
    }

    #[test]
    fn what_widened_sigma_can_be_undone() {
        let mut l = line("nominal", 1);
        (l.sigma_stretch, l.qp_widened[5]) = ([1.0, 2.0], 4.0);
        let (es_akf, qp) = l.bare();
        assert_eq!(es_akf.sigma_m(), [1e-3, 1e-3, 1e-3, 5e-4, 5e-4, 5e-4]);
        assert_eq!((qp.sigma_m()[0], qp.sigma_m()[5]), (2e-4, 5e-5));
    }

    #[test]
    fn seven_digits_are_kept() {
        assert_eq!((rounded(1.234_567_89e-8), rounded(0.0), rounded(-2.0)), (1.234_568e-8, 0.0, -2.0));
    }
}
