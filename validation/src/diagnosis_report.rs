//! Report of the diagnosis campaign: its bars, each also by length and by producer.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;

use dragfree_chart::ChartError;
use dragfree_chart::matrix::{Matrix, svg};
use nalgebra::{DMatrix, DVector};
use serde_json::Value;

use crate::records::{Acted, Diagnosed, KeptOut, Solution};
use crate::stats;

/// A part of the campaign: title, and whether a set belongs to it.
type Part = (&'static str, fn(&Diagnosed) -> bool);

const PARTS: [Part; 8] = [
    ("all", |_| true),
    ("2 h", |l| l.length == "2h"),
    ("6 h", |l| l.length == "6h"),
    ("9 h", |l| l.length == "9h"),
    ("24 h", |l| l.length == "24h"),
    ("3 × 24 h", |l| l.length == "3x24h"),
    ("own", |l| l.producer == "own"),
    ("another", |l| l.producer == "foreign"),
];
/// Places of the lengths among the parts.
const LENGTHS: std::ops::Range<usize> = 1..6;

/// Number of sets of a length without hidden effect that its bar asks for.
const CLEAN_SETS: usize = 120;
/// Number of sets or sizes below which a bar of a percentage is left open unless it is missed.
const LEAST: usize = 20;
/// Number of sizes from which an upper bound of their percentage is judged.
const LEAST_ABOVE: usize = 100;
/// Largest confounder set in which a truth counts as found.
const MAX_SET: usize = 3;
/// Bounds of NEES/dof after the addition.
const NEES: std::ops::RangeInclusive<f64> = 0.8..=1.25;

/// What is measured of the sets of a part.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Measured {
    /// So many of so many.
    Share(usize, usize),
    /// A mean of so many.
    Mean(f64, usize),
}

impl Measured {
    fn share(of: impl Iterator<Item = bool>) -> Self {
        let (k, n) = of.fold((0, 0), |(k, n), held| (k + usize::from(held), n + 1));
        Self::Share(k, n)
    }

    fn number(self) -> usize {
        match self {
            Self::Share(_, n) | Self::Mean(_, n) => n,
        }
    }

    fn text(self) -> String {
        match self {
            Self::Share(_, 0) | Self::Mean(_, 0) => "–".to_owned(),
            Self::Share(k, n) => format!("{k} of {n}"),
            Self::Mean(value, n) => format!("{value:.2} ({n})"),
        }
    }
}

/// A bar of a measured quantity.
#[derive(Clone, Copy, Debug)]
enum Bar {
    /// At least this percentage.
    AtLeast(usize),
    /// At most this percentage.
    AtMost(usize),
    /// A percentage between these.
    Between(usize, usize),
    /// At most two of 120 of every length.
    TwoOf120,
    /// A mean within [`NEES`].
    Nees,
    /// None.
    Told,
}

impl Bar {
    fn text(self) -> String {
        match self {
            Self::AtLeast(p) => format!("≥ {p} %"),
            Self::AtMost(p) => format!("≤ {p} %"),
            Self::Between(a, b) => format!("{a} to {b} %"),
            Self::TwoOf120 => format!("≤ 2 of {CLEAN_SETS} per length"),
            Self::Nees => format!("{} to {}", NEES.start(), NEES.end()),
            Self::Told => String::new(),
        }
    }

    fn holds(self, measured: Measured) -> bool {
        match (self, measured) {
            (_, m) if m.number() == 0 => true,
            (Self::AtLeast(p), Measured::Share(k, n)) => 100 * k >= p * n,
            (Self::AtMost(p), Measured::Share(k, n)) => 100 * k <= p * n,
            // All of a few is more than a percentage and says nothing.
            (Self::Between(a, b), Measured::Share(k, n)) => 100 * k >= a * n && (n < LEAST_ABOVE || 100 * k <= b * n),
            (Self::TwoOf120, Measured::Share(k, n)) => CLEAN_SETS * k <= 2 * n,
            (Self::Nees, Measured::Mean(value, _)) => NEES.contains(&value),
            _ => true,
        }
    }

    /// Number from which the bar can be met. Fewer sets may miss it.
    fn least(self) -> usize {
        match self {
            Self::AtMost(p) => 100 / p.max(1),
            Self::TwoOf120 => CLEAN_SETS,
            _ => LEAST,
        }
    }

    /// `met`, `missed` or `open` by the measured parts, in the order of [`PARTS`].
    fn verdict(self, parts: &[Measured]) -> &'static str {
        let judged = match self {
            Self::Told => return "",
            Self::TwoOf120 => &parts[LENGTHS],
            _ => &parts[..1],
        };
        if !judged.iter().all(|m| self.holds(*m)) {
            "**missed**"
        } else if judged.iter().any(|m| m.number() < self.least()) {
            "open"
        } else {
            "met"
        }
    }
}

/// Significance with the σ of the diagnosis; as drawn where it states none. The σ of an effect that is not named is
/// that beside everything that is: something false in its place would widen it, and hide that it was missed. The larger
/// significance counts then. Of a kind that no effect covers it is that of `run` with its formula in the model.
fn significance(line: &Diagnosed, acted: &Acted) -> f64 {
    let beside_others = acted.known && !acted.named && line.answer.as_ref().is_some_and(|a| !a.named.is_empty());
    match acted.significance_at_hand {
        Some(at_hand) if beside_others => at_hand.max(acted.drawn_significance),
        Some(at_hand) => at_hand,
        None => acted.drawn_significance,
    }
}

/// Whether it is first, or in a small set of confounders.
fn is_first(acted: &Acted) -> bool {
    acted.first || is_in_small_set(acted)
}

fn is_in_small_set(acted: &Acted) -> bool {
    !acted.confounder_of.is_empty() && acted.set_size.is_some_and(|size| size <= MAX_SET)
}

fn is_found(acted: &Acted) -> bool {
    acted.named || is_in_small_set(acted)
}

/// Whether something is named or unexplained where nothing is hidden, if there is a diagnosis. A level of noise that
/// really is off may be named.
fn is_alarm(line: &Diagnosed) -> Option<bool> {
    line.answer.as_ref().map(|a| a.verdict == "unexplained" || a.unexplained.is_object() || !a.false_causes.is_empty())
}

/// Whether every noise is as the mission file declares.
fn is_declared(line: &Diagnosed) -> bool {
    line.drawn["noise_over_declared"].as_array().is_none_or(|all| all.iter().all(|part| *part == 1.0))
}

/// Whether the diagnosis says that something is left which no effect explains, and blames nothing false for it.
fn is_told_unexplained(line: &Diagnosed) -> bool {
    line.answer
        .as_ref()
        .is_some_and(|a| (a.verdict == "unexplained" || a.unexplained.is_object()) && a.false_causes.is_empty())
}

/// Whether one of the first three terms that are told of what is unexplained is made of what drives an effect.
fn tells_driver(line: &Diagnosed, effect: &Acted) -> bool {
    let drivers: &[&str] = match effect.name.split(':').next() {
        Some("current-force") => &["battery_current_a"],
        Some("product-force") => &["battery_current_a", "structure_temperature_k"],
        Some("current-squared") => &["bus_current_a"],
        Some("current-by-panel") => &["bus_current_a", "panel_k"],
        _ => return false,
    };
    let terms = line.answer.iter().flat_map(|a| a.unexplained["coherent_with"].as_array().into_iter().flatten());
    terms.take(3).filter_map(Value::as_str).any(|term| drivers.iter().all(|driver| term.contains(driver)))
}

/// Whether the proposed formula is nearly as good on other data as the true one, where the latter can be run.
fn predicts(kept_out: &KeptOut) -> Option<bool> {
    let with_truth = kept_out.true_formula?;
    Some(kept_out.proposed.is_some_and(|fall| fall >= 0.9 * with_truth))
}

fn names_false_cause(line: &Diagnosed) -> bool {
    line.answer.as_ref().is_some_and(|a| !a.false_causes.is_empty())
}

/// The only effect of a set, of a kind that bundled effects cover or not.
fn single(line: &Diagnosed, known: bool) -> Option<&Acted> {
    match line.effects.as_slice() {
        [one] if one.known == known => Some(one),
        _ => None,
    }
}

/// NEES of the offsets over their three degrees of freedom; `free` spans the directions that the survey leaves open.
fn nees<'a>(solutions: impl Iterator<Item = &'a Solution>, free: &DMatrix<f64>) -> Measured {
    let each: Vec<f64> = solutions
        .filter_map(|s| stats::nees(&DVector::from_row_slice(&s.error_m), &s.covariance(), free))
        .map(|nees| nees / 3.0)
        .collect();
    Measured::Mean(each.iter().sum::<f64>() / each.len().max(1) as f64, each.len())
}

/// Every row of the table: title, bar, and the measured quantity of some sets.
type Row<'a> = (&'static str, Bar, Box<dyn Fn(&[&Diagnosed]) -> Measured + 'a>);

fn rows(free: &DMatrix<f64>) -> Vec<Row<'_>> {
    let singles = |floor: f64| {
        move |lines: &[&Diagnosed]| {
            let known = lines.iter().filter_map(|l| Some((l, single(l, true)?)));
            Measured::share(known.filter(|(l, e)| significance(l, e) > floor).map(|(_, e)| is_first(e)))
        }
    };
    vec![
        (
            "nothing hidden: something is named or unexplained",
            Bar::TwoOf120,
            Box::new(|lines| {
                Measured::share(lines.iter().filter(|l| l.effects.is_empty()).filter_map(|l| is_alarm(l)))
            }),
        ),
        (
            "a false cause is named and no true one, all sets",
            Bar::AtMost(1),
            Box::new(|lines| {
                let alone = |l: &&Diagnosed| names_false_cause(l) && !l.effects.iter().any(is_found);
                Measured::share(lines.iter().map(alone))
            }),
        ),
        ("one effect above 6σ: first, or in a set of at most three", Bar::AtLeast(98), Box::new(singles(6.0))),
        ("one effect above 4σ: the same", Bar::AtLeast(85), Box::new(singles(4.0))),
        (
            "pairs of two above 6σ: both",
            Bar::AtLeast(95),
            Box::new(|lines| {
                let pairs = lines.iter().filter(|l| l.effects.len() == 2);
                let loud = pairs.filter(|l| l.effects.iter().all(|e| significance(l, e) > 6.0));
                Measured::share(loud.map(|l| l.effects.iter().all(is_found)))
            }),
        ),
        (
            "sizes of true causes within 2σ",
            Bar::Between(93, 98),
            Box::new(|lines| {
                let sizes = lines.iter().flat_map(|l| &l.effects).flat_map(|e| &e.difference_sigma);
                Measured::share(sizes.map(|d| d.abs() <= 2.0))
            }),
        ),
        (
            "NEES/dof of the offset after the addition",
            Bar::Nees,
            Box::new(|lines| nees(lines.iter().filter_map(|l| l.after.as_ref()).flat_map(|a| &a.offset), free)),
        ),
        (
            "a kind that no effect covers, above 8σ: `unexplained`",
            Bar::AtLeast(95),
            Box::new(|lines| {
                let loud = lines.iter().filter(|l| single(l, false).is_some_and(|e| significance(l, e) > 8.0));
                Measured::share(loud.map(|l| is_told_unexplained(l)))
            }),
        ),
        (
            "the same: what drives it among the first three that are told",
            Bar::AtLeast(80),
            Box::new(|lines| {
                let loud = lines.iter().filter_map(|l| Some((l, single(l, false)?)));
                Measured::share(loud.filter(|(l, e)| significance(l, e) > 8.0).map(|(l, e)| tells_driver(l, e)))
            }),
        ),
        (
            "the same: the proposed formula lowers χ² of other data by nine tenths of what the true one does",
            Bar::AtLeast(70),
            Box::new(|lines| {
                let loud = lines.iter().filter(|l| single(l, false).is_some_and(|e| significance(l, e) > 8.0));
                Measured::share(loud.filter_map(|l| predicts(l.kept_out.as_ref()?)))
            }),
        ),
        (
            "nothing hidden, every noise as declared: named or unexplained",
            Bar::Told,
            Box::new(|lines| {
                let clean = lines.iter().filter(|l| l.effects.is_empty() && is_declared(l));
                Measured::share(clean.filter_map(|l| is_alarm(l)))
            }),
        ),
        (
            "NEES/dof of the offset before the addition",
            Bar::Told,
            Box::new(|lines| nees(lines.iter().filter(|l| l.after.is_some()).flat_map(|l| &l.before), free)),
        ),
        (
            "NEES/dof of the offset where nothing is hidden",
            Bar::Told,
            Box::new(|lines| nees(lines.iter().filter(|l| l.effects.is_empty()).flat_map(|l| &l.before), free)),
        ),
        (
            "a false cause is named beside a true one",
            Bar::Told,
            Box::new(|lines| {
                let found = lines.iter().filter(|l| l.effects.iter().any(is_found));
                Measured::share(found.map(|l| names_false_cause(l)))
            }),
        ),
        (
            "a σ at hand is stated for the one known effect",
            Bar::Told,
            Box::new(|lines| {
                let known = lines.iter().filter_map(|l| single(l, true));
                Measured::share(known.map(|e| e.significance_at_hand.is_some()))
            }),
        ),
        (
            "what was named cannot be added or run",
            Bar::Told,
            Box::new(|lines| {
                Measured::share(lines.iter().filter_map(|l| l.after.as_ref()).map(|a| a.failed.is_some()))
            }),
        ),
        (
            "the program gave no diagnosis",
            Bar::AtMost(0),
            Box::new(|lines| Measured::share(lines.iter().map(|l| l.failed.is_some()))),
        ),
    ]
}

/// Generated part of VALIDATION.md, and the missed bars: a table for each set of arguments.
pub(crate) fn numbers(lines: &[Diagnosed], free: &DMatrix<f64>) -> (String, Vec<String>) {
    if lines.is_empty() {
        return ("Not measured yet.\n".to_owned(), Vec::new());
    }
    let (mut text, mut missed) = (String::new(), Vec::new());
    let methods: BTreeSet<&str> = lines.iter().map(|l| l.arguments.as_str()).collect();
    for method in methods {
        let own: Vec<&Diagnosed> = lines.iter().filter(|l| l.arguments == method).collect();
        let _ = writeln!(text, "{}", provenance(method, &own));
        let titles = PARTS.map(|(title, _)| title).join(" | ");
        let _ = writeln!(text, "| what | bar | | {titles} |\n|---|---|---|{}", "---|".repeat(PARTS.len()));
        for (what, bar, measure) in rows(free) {
            let parts =
                PARTS.map(|(_, belongs)| measure(&own.iter().copied().filter(|l| belongs(l)).collect::<Vec<_>>()));
            let cells = parts.map(|m| if bar.holds(m) { m.text() } else { format!("**{}**", m.text()) });
            let verdict = bar.verdict(&parts);
            let _ = writeln!(text, "| {what} | {} | {verdict} | {} |", bar.text(), cells.join(" | "));
            if verdict == "**missed**" {
                let by = if method.is_empty() { String::new() } else { format!(", {method}") };
                missed.push(format!("diagnosis{by}: {what}: {}, bar {}", parts[0].text(), bar.text()));
            }
        }
        text += &kinds(&own);
    }
    (text, missed)
}

/// What was run, and with which build.
fn provenance(method: &str, lines: &[&Diagnosed]) -> String {
    let builds: BTreeSet<&str> = lines.iter().map(|l| l.commit.as_str()).collect();
    let builds = builds.into_iter().collect::<Vec<_>>().join(", ");
    let (first, last) = lines.iter().fold((u32::MAX, 0), |(a, b), l| (a.min(l.seed), b.max(l.seed)));
    let median = stats::median(lines.iter().map(|l| l.diagnosis_s).collect());
    let most = lines.iter().map(|l| l.diagnosis_s).fold(0.0, f64::max);
    let method = if method.is_empty() { "dragfree diagnose".to_owned() } else { format!("dragfree diagnose {method}") };
    format!(
        "`{method}`: {} sets, seeds {first} to {last}, build {builds}; a diagnosis took {median:.0} s in the median, {most:.0} s at \
         most. **Bold** misses the bar; *open* means not missed, by too few sets.\n",
        lines.len()
    )
}

/// What was found of each kind, drawn above and below 8σ.
fn kinds(lines: &[&Diagnosed]) -> String {
    let mut found: BTreeMap<(&str, &str), [(usize, usize); 2]> = BTreeMap::new();
    for line in lines {
        let [one] = line.effects.as_slice() else { continue };
        let kind = one.name.split(':').next().unwrap_or("?");
        let row = found.entry((kind, line.producer.as_str())).or_default();
        let cell = &mut row[usize::from(significance(line, one) < 8.0)];
        cell.0 += usize::from(if one.known { is_first(one) } else { is_told_unexplained(line) });
        cell.1 += 1;
    }
    let mut text = "\n| one effect | producer | found above 8σ | below |\n|---|---|---|---|\n".to_owned();
    for ((kind, producer), cells) in found {
        let [above, below] = cells.map(|(k, n)| Measured::Share(k, n).text());
        let _ = writeln!(text, "| `{kind}` | {producer} | {above} | {below} |");
    }
    text + "\n"
}

/// Significance of a hidden effect that should be found.
const PLAIN: f64 = 6.0;
/// Label of a set in which nothing is hidden.
const NOTHING: &str = "nothing";

/// Confusion matrices of the sets with at most one effect: it against what was said, itself where it is named, else the
/// first that is false or takes its place. `None` without results.
pub(crate) fn picture(lines: &[Diagnosed]) -> Result<Option<String>, ChartError> {
    let kind = |name: &str| name.split(':').next().unwrap_or(name).to_owned();
    let mut tables = Vec::new();
    for (title, wanted) in [("Hidden above 6σ (rows), said (columns)", true), ("Hidden below 6σ, or nothing", false)]
    {
        let mut counts: BTreeMap<(String, String), usize> = BTreeMap::new();
        let mut known: BTreeMap<String, bool> = BTreeMap::new();
        for line in lines {
            let hidden = match line.effects.as_slice() {
                [] if !wanted => NOTHING.to_owned(),
                [one] if (significance(line, one) > PLAIN) == wanted => kind(&one.name),
                _ => continue,
            };
            let Some(answer) = &line.answer else { continue };
            let said = match line.effects.as_slice() {
                [one] if one.named => hidden.clone(),
                all => {
                    // A level of noise that really is off says nothing of what is hidden.
                    let rival = || all.first().and_then(|one| one.confounder_of.first());
                    let unexplained = answer.verdict == "unexplained" || answer.unexplained.is_object();
                    let nothing = if unexplained { "unexplained" } else { "sufficient" };
                    answer.false_causes.first().or_else(rival).map_or_else(|| nothing.to_owned(), |name| kind(name))
                }
            };
            known.insert(hidden.clone(), line.effects.iter().all(|e| e.known));
            *counts.entry((hidden, said)).or_default() += 1;
        }
        if counts.is_empty() {
            continue;
        }
        // Nothing, and kinds that no effect covers, come last, with the answers that belong to them.
        let order = |name: &String| {
            (matches!(name.as_str(), NOTHING | "sufficient" | "unexplained"), known.get(name) == Some(&false))
        };
        let sorted = |names: BTreeSet<&String>| {
            let mut names: Vec<String> = names.into_iter().cloned().collect();
            names.sort_by_key(order);
            names
        };
        let rows = sorted(counts.keys().map(|(hidden, _)| hidden).collect());
        let columns = sorted(counts.keys().map(|(_, said)| said).collect());
        let belongs = |row: &String, column: &String| match (row.as_str(), known.get(row)) {
            (NOTHING, _) => column == "sufficient",
            (_, Some(false)) => column == "unexplained",
            _ => column == row,
        };
        let cells = |i: usize| (0..columns.len()).map(move |j| (i, j));
        let right = (0..rows.len()).flat_map(cells).filter(|(i, j)| belongs(&rows[*i], &columns[*j])).collect();
        let count = |row: &String, column: &String| counts.get(&(row.clone(), column.clone())).copied().unwrap_or(0);
        let counts = rows.iter().map(|row| columns.iter().map(|column| count(row, column)).collect()).collect();
        tables.push(Matrix { title: title.to_owned(), rows, columns, counts, right });
    }
    if tables.is_empty() { Ok(None) } else { svg(&tables).map(Some) }
}

/// The counts of the bars in a few lines, for the end of a campaign.
pub(crate) fn summary(lines: &[Diagnosed]) -> String {
    let free = DMatrix::identity(6, 6);
    let all: Vec<&Diagnosed> = lines.iter().collect();
    let told = rows(&free).into_iter().filter(|(what, ..)| !what.starts_with("NEES"));
    told.map(|(what, _, measure)| format!("{what}: {}", measure(&all).text())).collect::<Vec<_>>().join("\n")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::records::tests::solution;
    use crate::records::{Answer, Extended};
    use serde_json::{Value, json};

    fn set(length: &str, producer: &str, verdict: &str, named: &[&str], effects: Vec<Acted>) -> Diagnosed {
        let named: Vec<String> = named.iter().map(|n| (*n).to_owned()).collect();
        let is_true = |n: &&String| effects.iter().any(|e| e.name == **n || e.confounder_of.contains(n));
        let false_causes = named.iter().filter(|n| !is_true(n)).cloned().collect();
        Diagnosed {
            configuration: format!("{length} {producer}"),
            seed: 1,
            commit: "b".to_owned(),
            length: length.to_owned(),
            producer: producer.to_owned(),
            arguments: String::new(),
            drawn: Value::Null,
            diagnosis_s: 1.0,
            failed: None,
            run_verdicts: vec!["agree".to_owned()],
            chi2_per_dof: vec![1.0],
            answer: Some(Answer { verdict: verdict.to_owned(), named, false_causes, unexplained: Value::Null }),
            effects,
            before: vec![solution([1e-3; 6], 1e-3)],
            after: None,
            kept_out: None,
        }
    }

    fn acted(name: &str, drawn: f64, at_hand: Option<f64>, named: bool) -> Acted {
        Acted {
            name: name.to_owned(),
            size: 0.1,
            unit: "1".to_owned(),
            known: !name.starts_with("current-squared"),
            drawn_significance: drawn,
            significance_at_hand: at_hand,
            named,
            first: named,
            confounder_of: Vec::new(),
            set_size: named.then_some(1),
            difference_sigma: if named { vec![0.5] } else { Vec::new() },
        }
    }

    fn measured(lines: &[Diagnosed], what: &str) -> Measured {
        let free = DMatrix::identity(6, 6);
        let row = rows(&free).into_iter().find(|(title, ..)| title.starts_with(what)).unwrap();
        row.2(&lines.iter().collect::<Vec<_>>())
    }

    #[test]
    fn sets_without_a_sigma_at_hand_count_as_drawn() {
        let lines = [
            set("6h", "own", "missing", &["a:x"], vec![acted("a:x", 3.0, Some(7.0), true)]),
            set("6h", "own", "sufficient", &[], vec![acted("a:x", 9.0, Some(2.0), false)]),
            set("6h", "own", "sufficient", &[], vec![acted("a:x", 9.0, None, false)]),
        ];
        assert_eq!(measured(&lines, "one effect above 6σ"), Measured::Share(1, 2));
        assert_eq!(measured(&lines, "a σ at hand"), Measured::Share(2, 3));
        // Beside something false its own σ is no measure.
        let replaced = set("6h", "own", "missing", &["b:x"], vec![acted("a:x", 9.0, Some(2.0), false)]);
        assert_eq!(measured(&[replaced], "one effect above 6σ"), Measured::Share(0, 1));
        assert_eq!(measured(&lines, "sizes"), Measured::Share(1, 1));
    }

    #[test]
    fn a_set_of_three_confounders_counts_and_one_of_four_does_not() {
        for (size, k) in [(3, 1), (4, 0)] {
            let mut effect = acted("is-scale:tm1.y", 9.0, Some(9.0), false);
            (effect.confounder_of, effect.set_size) = (vec!["es-gain:tm1.y".to_owned()], Some(size));
            let line = [set("6h", "own", "missing", &["es-gain:tm1.y"], vec![effect])];
            assert_eq!(measured(&line, "one effect above 6σ"), Measured::Share(k, 1));
        }
    }

    #[test]
    fn alarms_and_false_causes_are_counted() {
        let mut failed = set("2h", "own", "sufficient", &[], vec![]);
        failed.answer = None;
        failed.failed = Some("no".to_owned());
        let lines = [
            set("2h", "own", "sufficient", &[], vec![]),
            set("2h", "own", "unexplained", &[], vec![]),
            set("2h", "own", "missing", &["b:x"], vec![]),
            set("2h", "own", "missing", &["a:x", "b:x"], vec![acted("a:x", 9.0, None, true)]),
            failed,
        ];
        assert_eq!(measured(&lines, "nothing hidden"), Measured::Share(2, 3));
        assert_eq!(measured(&lines, "nothing hidden, every noise"), Measured::Share(2, 3));
        let mut off = lines[1].clone();
        off.drawn = json!({ "noise_over_declared": [1.0, 1.2, 1.0, 1.0, 1.0] });
        assert_eq!(measured(&[off], "nothing hidden, every noise"), Measured::Share(0, 0));
        assert_eq!(measured(&lines, "a false cause is named and no"), Measured::Share(1, 5));
        assert_eq!(measured(&lines, "a false cause is named beside"), Measured::Share(1, 1));
        assert_eq!(measured(&lines, "the program gave no"), Measured::Share(1, 5));
    }

    #[test]
    fn pairs_and_unknown_kinds() {
        let pair = |named| vec![acted("a:x", 9.0, Some(8.0), true), acted("b:x", 9.0, Some(7.0), named)];
        let lines = [
            set("9h", "foreign", "missing", &["a:x", "b:x"], pair(true)),
            set("9h", "foreign", "missing", &["a:x"], pair(false)),
            set("9h", "foreign", "unexplained", &[], vec![acted("current-squared:sc.x", 9.0, None, false)]),
            set("9h", "foreign", "sufficient", &[], vec![acted("current-squared:sc.x", 7.0, None, false)]),
            set("9h", "foreign", "missing", &["c:x"], vec![acted("current-squared:sc.x", 9.0, None, false)]),
        ];
        assert_eq!(measured(&lines, "pairs"), Measured::Share(1, 2));
        assert_eq!(measured(&lines, "a kind"), Measured::Share(1, 2));
        let mut loud = vec![lines[2].clone(); 4];
        let falls = [(Some(91.0), Some(100.0)), (Some(89.0), Some(100.0)), (None, Some(100.0)), (Some(50.0), None)];
        for (line, (proposed, true_formula)) in loud.iter_mut().zip(falls) {
            line.kept_out = Some(KeptOut { proposed, true_formula });
        }
        assert_eq!(measured(&loud, "the same: the proposed formula"), Measured::Share(1, 3));
    }

    /// One σ in each of six directions is six degrees of freedom, told per three.
    #[test]
    fn the_offset_is_judged_after_the_addition() {
        let mut line = set("24h", "own", "missing", &["a:x"], vec![acted("a:x", 9.0, None, true)]);
        let offset = vec![solution([1e-3; 6], 1e-3), solution([0.0; 6], 1e-3)];
        line.after = Some(Extended { added: vec!["a:x".to_owned()], failed: None, offset });
        assert_eq!(measured(std::slice::from_ref(&line), "NEES/dof of the offset after"), Measured::Mean(1.0, 2));
        assert_eq!(measured(&[line], "NEES/dof of the offset before"), Measured::Mean(2.0, 1));
    }

    /// A bar of every length is open until each has its sets, and missed as soon as one misses it.
    #[test]
    fn bars_are_met_missed_or_open() {
        let of = |k: usize, n: usize| {
            let mut parts = vec![Measured::Share(k, 5 * n)];
            parts.extend([Measured::Share(k, n)].into_iter().chain([Measured::Share(0, n); 4]));
            Bar::TwoOf120.verdict(&parts)
        };
        assert_eq!((of(0, 30), of(1, 30), of(2, 120), of(3, 120)), ("open", "**missed**", "met", "**missed**"));
        let at_least = |k, n| Bar::AtLeast(98).verdict(&[Measured::Share(k, n)]);
        assert_eq!((at_least(19, 19), at_least(49, 50), at_least(48, 50)), ("open", "met", "**missed**"));
        let between = |k| Bar::Between(93, 98).verdict(&[Measured::Share(k, 100)]);
        assert_eq!((between(95), between(99), between(92)), ("met", "**missed**", "**missed**"));
        assert_eq!(Bar::Between(93, 98).verdict(&[Measured::Share(10, 10)]), "open");
        assert_eq!(Bar::Nees.verdict(&[Measured::Mean(1.3, 40)]), "**missed**");
    }

    #[test]
    fn methods_have_tables_of_their_own() {
        let mut lines = vec![set("6h", "own", "sufficient", &[], vec![]); 2];
        lines[1].arguments = "--decide-by innovations".to_owned();
        let free = DMatrix::identity(6, 6);
        let (text, missed) = numbers(&lines, &free);
        assert!(
            text.contains("`dragfree diagnose`: 1 sets")
                && text.contains("`dragfree diagnose --decide-by innovations`")
        );
        assert!(missed.is_empty() && text.contains("| ≤ 2 of 120 per length | open | 0 of 1 | – | 0 of 1 |"), "{text}");
        lines.push(set("6h", "foreign", "unexplained", &[], vec![]));
        assert_eq!(numbers(&lines, &free).1.len(), 1);
        assert_eq!(numbers(&[], &free).0, "Not measured yet.\n");
    }
}
