//! Pictures that are more than lines: what a product was made of, and the ladder as named steps.

use dragfree_archive::Place;
use dragfree_archive::product::Stage;
use dragfree_chart::ChartError;
use dragfree_chart::graph::{self, Node};
use dragfree_workflow::provenance::Lineage;
use dragfree_workflow::refit::{Offset, Refit, Rung};
use maud::{Markup, html};

/// Role of the products that one of many days was made of.
const PRODUCT: &str = "product";

/// Whether a file holds data: telemetry, or a product that entered another.
pub fn is_data(place: &&Place) -> bool {
    ["telemetry", PRODUCT].contains(&place.role.as_str())
}

/// The start of a digest, enough to tell contents apart.
pub fn short(sha256: &str) -> &str {
    sha256.get(..12).unwrap_or(sha256)
}

/// Inputs on the left, the product, what came of it on the right, as SVG.
///
/// # Errors
/// [`ChartError`]: the drawing library failed.
pub fn lineage(l: &Lineage) -> Result<String, ChartError> {
    let node = |kind: &str, name: &str, note: &str| Node { lines: vec![kind.into(), name.into(), note.into()] };
    let mut left: Vec<Node> = Vec::new();
    left.extend(l.resumed.first().map(|id| node("state of", id, "")));
    left.extend(l.supersedes.iter().map(|id| node("in place of", id, "")));
    left.extend(l.inputs.iter().filter(is_data).map(|p| node(&p.role, &p.name, short(&p.sha256))));
    let kept = l.kept.iter().filter(|p| !p.role.starts_with("state"));
    left.extend(kept.map(|p| node(&p.role, &p.name, short(&p.sha256))));
    let mut plugins: Vec<(&str, &str)> = Vec::new();
    for Stage { plugin, library_sha256, .. } in &l.plugins {
        if !plugins.contains(&(plugin, library_sha256)) {
            plugins.push((plugin, library_sha256));
        }
    }
    left.extend(plugins.into_iter().map(|(name, sha256)| node("plugin", name, short(sha256))));
    let verdict = l.product.verdict.as_deref().unwrap_or("no verdict");
    let middle = vec![node("product", &l.product.id, verdict)];
    let mut right: Vec<Node> = Vec::new();
    right.extend(l.superseded_by.iter().map(|id| node("superseded by", id, "")));
    right.extend(l.resumed_by.iter().map(|id| node("resumed by", id, "")));
    right.extend(l.entered.iter().map(|id| node("entered", id, "")));
    right.extend(l.tested_by.iter().map(|id| node("tested by", id, "")));
    let from = |ns: i64| chrono::DateTime::from_timestamp_nanos(ns).format("%Y-%m-%d %H:%M:%S%.f").to_string();
    right.extend(l.certified.iter().map(|v| node("set", &v.set, &from(v.from_ns))));
    let edges = (0..left.len()).map(|i| ((0, i), (1, 0))).chain((0..right.len()).map(|i| ((1, 0), (2, i))));
    let edges: Vec<_> = edges.collect();
    graph::svg(&[left, middle, right], &edges)
}

/// Width of the column of names, of the plot and of the column of figures, px.
const COLUMNS: [f64; 3] = [190.0, 360.0, 190.0];
/// Height of an offset within a step, and of what a step has besides, px.
const OFFSET: f64 = 13.0;
const STEP: f64 = 22.0;
/// Above the first step and below the last, px.
const EDGES: [f64; 2] = [46.0, 34.0];

/// The ladder: a row a step with each offset as a point with its σ. The axis is the true error where truth is known, or
/// else the difference from the last step.
pub(crate) fn ladder(refit: &Refit, truth: &dyn Fn(&str) -> Option<f64>) -> Markup {
    let Some(last) = refit.rungs.last() else { return html! {} };
    let known = last.offsets.iter().all(|o| truth(&o.name).is_some());
    let reference = |o: &Offset, at: usize| truth(&o.name).filter(|_| known).unwrap_or(last.offsets[at].value_m);
    let mm = |rung: &Rung| -> Vec<(f64, f64)> {
        let of = |(at, o): (usize, &Offset)| (1e3 * (o.value_m - reference(o, at)), 1e3 * o.sigma_m);
        rung.offsets.iter().enumerate().map(of).collect()
    };
    let steps: Vec<Vec<(f64, f64)>> = refit.rungs.iter().map(mm).collect();
    let reach = steps.iter().flatten().map(|(x, s)| x.abs() + s).fold(0.0, f64::max).max(1e-3);
    let tick = nice(reach / 2.0);
    let [names, plot, figures] = COLUMNS;
    let high = |n: usize| STEP + OFFSET * n as f64;
    let tall = EDGES[0] + EDGES[1] + steps.iter().map(|s| high(s.len())).sum::<f64>();
    let x = |mm: f64| names + plot * (0.5 + 0.46 * mm / reach);
    let bottom = tall - EDGES[1];
    let axis = if known { "true error, mm" } else { "difference from the last step, mm" };
    let rows = steps.iter().scan(EDGES[0], |top, step| {
        let own = *top;
        *top += high(step.len());
        Some(own)
    });
    let rows: Vec<f64> = rows.collect();
    let held_out = refit.rungs.iter().any(|r| r.held_out_fall.is_some());
    html! {
        svg class="drawn ladder" role="img" aria-label={ "Ladder: " (axis) ", a row a step" }
            viewBox=(format!("0 0 {} {tall}", names + plot + figures)) {
            @for (k, o) in last.offsets.iter().enumerate() {
                @let at = names + 8.0 + 92.0 * (k % 6) as f64;
                circle class=(format!("c{} dot", k % 6)) cx=(at) cy=(14.0 + 14.0 * (k / 6) as f64) r="4" {}
                text x=(at + 8.0) y=(18.0 + 14.0 * (k / 6) as f64) { (tail(&o.name)) }
            }
            text class="quiet" x=(names + plot + 10.0) y="38" { "χ² falls by" }
            @for n in (-5..=5).map(f64::from) {
                @if n.abs() * tick <= 1.04 * reach {
                    line class=(if n == 0.0 { "axis" } else { "grid" }) x1=(x(n * tick)) x2=(x(n * tick))
                        y1=(EDGES[0] - 4.0) y2=(bottom) {}
                    text class="quiet middle" x=(x(n * tick)) y=(bottom + 14.0) { (plain(n * tick)) }
                }
            }
            text class="quiet middle" x=(x(0.0)) y=(bottom + 29.0) { (axis) }
            @for ((rung, step), top) in refit.rungs.iter().zip(&steps).zip(&rows) {
                line class="grid" x1="0" x2=(names + plot + figures) y1=(top) y2=(top) {}
                text class="name" x="4" y=(top + 0.5 * high(step.len()) + 4.0) {
                    (rung.added.as_ref().map_or_else(|| "the model".to_owned(), |a| format!("+ {a}")))
                }
                @for (k, (value, sigma)) in step.iter().enumerate() {
                    @let y = top + 0.5 * STEP + OFFSET * (k as f64 + 0.5);
                    line class=(format!("c{} bar", k % 6)) x1=(x(value - sigma)) x2=(x(value + sigma)) y1=(y) y2=(y) {}
                    circle class=(format!("c{} dot", k % 6)) cx=(x(*value)) cy=(y) r="4" {}
                }
                @if rung.added.is_some() {
                    text x=(names + plot + 10.0) y=(top + 0.5 * high(step.len()) - 4.0) { (format!("{:.1}",
                        rung.fall)) " in the fit" }
                    @if held_out {
                        text x=(names + plot + 10.0) y=(top + 0.5 * high(step.len()) + 13.0) {
                            (format!("{:.1}", rung.held_out_fall.unwrap_or(0.0))) " kept out"
                        }
                    }
                }
            }
        }
    }
}

/// What stands behind the first point of a name.
pub(crate) fn tail(name: &str) -> &str {
    name.split_once('.').map_or(name, |(_, rest)| rest)
}

/// 1, 2 or 5 times a power of ten, at most `x`.
pub(crate) fn nice(x: f64) -> f64 {
    let ten = 10_f64.powf(x.log10().floor());
    let steps = [5.0, 2.0, 1.0];
    steps.into_iter().map(|s| s * ten).find(|s| *s <= x * (1.0 + 1e-9)).unwrap_or(ten)
}

/// A number of an axis.
pub(crate) fn plain(x: f64) -> String {
    let x = if x.abs() < 1e-12 { 0.0 } else { x };
    format!("{}", (x * 1e6).round() / 1e6).replace('-', "−")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round() {
        for (x, tick) in [(1.0, 1.0), (1.9, 1.0), (2.0, 2.0), (7.0, 5.0), (0.049, 0.02), (30.0, 20.0)] {
            assert!((nice(x) / tick - 1.0).abs() < 1e-9, "{x}: {}", nice(x));
        }
        assert_eq!(["−0.5", "0"], [plain(-0.5), plain(-1e-15)].each_ref().map(String::as_str));
    }
}
