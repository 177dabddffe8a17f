//! The offset as ellipses: where the centre of mass is, before and after effects were switched on.

use std::f64::consts::{FRAC_PI_3, TAU};

use dragfree_workflow::refit::{Refit, Rung};
use maud::{Markup, html};

use crate::pictures::{nice, plain, tail};

/// Side of a panel and its edge for labels, px.
const SIDE: f64 = 250.0;
const EDGE: f64 = 40.0;

/// Ellipses have 95 % of the probability: √χ²₂.
const REACH_SIGMAS: f64 = 2.447_747;

/// A body's offsets: its name, and the places of two of its axes among the offsets.
struct Plane {
    body: String,
    axes: [usize; 2],
}

/// A panel a body and plane: the ellipse of the model alone, that with the effects, an arrow, and the truth where it is
/// known.
pub(crate) fn ellipses(refit: &Refit, truth: &dyn Fn(&str) -> Option<f64>) -> Markup {
    let (Some(before), Some(after)) = (refit.rungs.first(), refit.rungs.last()) else { return html! {} };
    html! {
        div class="ellipses" {
            @for plane in planes(after) { (panel(before, after, &plane, truth)) }
        }
    }
}

/// The first axis of every body with each of the others.
fn planes(rung: &Rung) -> Vec<Plane> {
    let body = |k: usize| rung.offsets[k].name.rsplit_once('.').map_or("", |(body, _)| body).to_owned();
    let mut all: Vec<Plane> = Vec::new();
    let mut first: Option<usize> = None;
    for k in 0..rung.offsets.len() {
        match first.filter(|f| body(*f) == body(k)) {
            Some(f) => all.push(Plane { body: body(k), axes: [f, k] }),
            None => first = Some(k),
        }
    }
    all
}

fn panel(before: &Rung, after: &Rung, plane: &Plane, truth: &dyn Fn(&str) -> Option<f64>) -> Markup {
    let [a, b] = plane.axes;
    let point = |rung: &Rung| [1e3 * rung.offsets[a].value_m, 1e3 * rung.offsets[b].value_m];
    let (from, to) = (point(before), point(after));
    let [name_a, name_b] = [&after.offsets[a].name, &after.offsets[b].name];
    let true_mm = truth(name_a).zip(truth(name_b)).map(|(x, y)| [1e3 * x, 1e3 * y]);
    let outlines = [before, after].map(|rung| ellipse(rung, plane));
    let all = outlines.iter().flatten().copied().chain(true_mm);
    let (mut low, mut high) = (to, to);
    for p in all {
        for k in 0..2 {
            low[k] = low[k].min(p[k]);
            high[k] = high[k].max(p[k]);
        }
    }
    let middle = [0, 1].map(|k| 0.5 * (low[k] + high[k]));
    let reach = (0..2).map(|k| high[k] - low[k]).fold(1e-3, f64::max) * 0.56;
    let x = |mm: f64| EDGE + SIDE * (0.5 + 0.5 * (mm - middle[0]) / reach);
    let y = |mm: f64| SIDE * (0.5 - 0.5 * (mm - middle[1]) / reach) + 24.0;
    let path = |points: &[[f64; 2]]| {
        let points: Vec<String> = points.iter().map(|p| format!("{:.1},{:.1}", x(p[0]), y(p[1]))).collect();
        points.join(" ")
    };
    let tick = nice(reach * 0.7);
    let ticks = |k: usize| {
        let first = ((middle[k] - reach) / tick).ceil();
        (0..8).map(move |n| (first + f64::from(n)) * tick).filter(move |t| *t < middle[k] + reach)
    };
    let moved = (from[0] - to[0]).hypot(from[1] - to[1]) > 0.04 * reach;
    let label = format!("{}: offset with its 95 % ellipse before and after, in millimetres", plane.body);
    html! {
        svg class="drawn ellipse" role="img" aria-label=(label) viewBox=(format!("0 0 {} {}", SIDE + EDGE + 12.0,
            SIDE + 66.0)) {
            defs { marker id="arrow" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="8" markerHeight="8"
                orient="auto" {
                path class="head" d="M0 0 8 4 0 8z" {}
            } }
            text class="name" x=(EDGE) y="15" { (tail(&plane.body)) }
            (outline())
            rect class="frame" x=(EDGE) y="24" width=(SIDE) height=(SIDE) {}
            @for t in ticks(0) {
                line class="grid" x1=(x(t)) x2=(x(t)) y1="24" y2=(24.0 + SIDE) {}
                text class="quiet middle" x=(x(t)) y=(SIDE + 39.0) { (plain(t)) }
            }
            @for t in ticks(1) {
                line class="grid" x1=(EDGE) x2=(EDGE + SIDE) y1=(y(t)) y2=(y(t)) {}
                text class="quiet end" x=(EDGE - 4.0) y=(y(t) + 4.0) { (plain(t)) }
            }
            polygon class="before" points=(path(&outlines[0])) {}
            polygon class="after" points=(path(&outlines[1])) {}
            @if moved {
                line class="arrow" x1=(x(from[0])) y1=(y(from[1])) x2=(x(to[0])) y2=(y(to[1]))
                    marker-end="url(#arrow)" {}
            }
            @if let Some(t) = true_mm {
                path class="truth" d=(format!("M{0:.1} {2:.1}L{1:.1} {3:.1}M{0:.1} {3:.1}L{1:.1} {2:.1}", x(t[0]) -
                    5.0, x(t[0]) + 5.0, y(t[1]) - 5.0, y(t[1]) + 5.0)) {}
            }
            text class="quiet middle" x=(EDGE + 0.5 * SIDE) y=(SIDE + 58.0) { (tail(name_a)) " and, upwards, "
                (tail(name_b)) ", mm" }
        }
    }
}

/// The spacecraft in the corner of a panel, not to scale: the panel is a magnification about its centre of mass.
fn outline() -> Markup {
    let (x, y, r) = (EDGE + SIDE - 24.0, 48.0, 18.0);
    let corner = |k: i32| {
        let angle = f64::from(k) * FRAC_PI_3;
        format!("{:.1},{:.1}", x + r * angle.cos(), y + r * angle.sin())
    };
    let corners: Vec<String> = (0..6).map(corner).collect();
    html! {
        polygon class="hull" points=(corners.join(" ")) {}
        rect class="hull" x=(x - 2.5) y=(y - 2.5) width="5" height="5" {}
    }
}

/// The 95 % ellipse of a rung in a plane, mm.
fn ellipse(rung: &Rung, plane: &Plane) -> Vec<[f64; 2]> {
    let [a, b] = plane.axes;
    let c = |i: usize, j: usize| 1e6 * rung.covariance_m2[i][j];
    // The Cholesky factor of the covariance takes the circle to the ellipse.
    let l11 = c(a, a).max(0.0).sqrt();
    let l21 = if l11 > 0.0 { c(a, b) / l11 } else { 0.0 };
    let l22 = (c(b, b) - l21 * l21).max(0.0).sqrt();
    let (x, y) = (1e3 * rung.offsets[a].value_m, 1e3 * rung.offsets[b].value_m);
    let at = |k: u32| {
        let (sin, cos) = (f64::from(k) / 48.0 * TAU).sin_cos();
        [x + REACH_SIGMAS * l11 * cos, y + REACH_SIGMAS * (l21 * cos + l22 * sin)]
    };
    (0..48).map(at).collect()
}
