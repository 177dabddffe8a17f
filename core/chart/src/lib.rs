//! Charts as SVG: lines on linear or logarithmic axes, heat maps ([`heat`]), tables of counts ([`matrix`]) and boxes
//! with arrows ([`graph`]).

pub mod graph;
pub mod heat;
pub mod matrix;

use plotters::coord::Shift;
use plotters::coord::ranged1d::{AsRangedCoord, Ranged, ValueFormatter};
use plotters::prelude::*;
use std::ops::Range;

/// Style of a line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stroke {
    /// Solid: measured or computed.
    Solid,
    /// Dashed: a bound or reference.
    Dashed,
    /// Filled: a confidence region, given by its outline.
    Area,
}

/// Scale of an axis.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scale {
    /// Logarithmic; positive values only.
    Logarithmic,
    /// Linear.
    Linear,
}

impl Scale {
    fn shows(self, value: f64) -> bool {
        value.is_finite() && (self == Self::Linear || value > 0.0)
    }

    /// Position of a value in a range, 0 to 1.
    fn place(self, value: f64, range: &Range<f64>) -> f64 {
        match self {
            Self::Logarithmic => (value / range.start).ln() / (range.end / range.start).ln(),
            Self::Linear => (value - range.start) / (range.end - range.start),
        }
    }

    /// Tick marks of an axis over a range.
    fn text(self, value: f64, range: &Range<f64>) -> String {
        match self {
            Self::Logarithmic => format!("{value:.0e}"),
            // Rounds away the error of summed steps, so that zero is zero.
            Self::Linear if value.abs() < 1e-9 * (range.end - range.start) => "0".to_owned(),
            Self::Linear => format!("{}", format!("{value:.6e}").parse().unwrap_or(value)),
        }
    }
}

/// A line of a panel.
#[derive(Clone, Debug)]
pub struct Line {
    /// Legend; empty for none.
    pub label: String,
    /// Index in [`PALETTE`]; a bound shares the colour of its line.
    pub colour: usize,
    /// Style.
    pub stroke: Stroke,
    /// Points in order of x; points outside the axes are omitted.
    pub points: Vec<(f64, f64)>,
}

impl Line {
    /// A line; an empty label is not in the legend.
    pub fn new(label: impl Into<String>, colour: usize, stroke: Stroke, points: Vec<(f64, f64)>) -> Self {
        Self { label: label.into(), colour, stroke, points }
    }
}

/// A panel: one pair of axes.
#[derive(Clone, Debug)]
pub struct Panel {
    /// Title.
    pub title: String,
    /// Label of x, with the unit.
    pub x_label: String,
    /// Label of y, with the unit.
    pub y_label: String,
    /// Scale of x.
    pub x_scale: Scale,
    /// Scale of y.
    pub y_scale: Scale,
    /// Limits of x.
    pub x: Range<f64>,
    /// Limits of y; `None` for whole decades, or a margin, around the points.
    pub y: Option<Range<f64>>,
    /// Lines, in drawing order.
    pub lines: Vec<Line>,
}

/// Colours distinguishable for the colour-blind (Okabe and Ito).
pub const PALETTE: [(u8, u8, u8); 7] =
    [(0, 114, 178), (213, 94, 0), (0, 158, 115), (204, 121, 167), (230, 159, 0), (86, 180, 233), (90, 90, 90)];

/// Error of a drawing.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the messages name the fields")]
pub enum ChartError {
    /// No point lies on the axes.
    #[error("panel \"{panel}\" has no point with x in {x:?} that its axes can show (logarithmic ones: above zero)")]
    Empty { panel: String, x: Range<f64> },
    /// The drawing library failed.
    #[error("the picture could not be drawn: {0}")]
    Drawing(String),
}

/// Width and height of a panel, px.
const PANEL: (u32, u32) = (560, 380);

impl Panel {
    /// A panel over frequency in Hz, both axes logarithmic.
    pub fn over_frequency(
        title: impl Into<String>,
        y_label: impl Into<String>,
        x: Range<f64>,
        lines: Vec<Line>,
    ) -> Self {
        let (x_scale, y_scale) = (Scale::Logarithmic, Scale::Logarithmic);
        let x_label = "frequency / Hz".to_owned();
        Self { title: title.into(), x_label, y_label: y_label.into(), x_scale, y_scale, x, y: None, lines }
    }

    fn shows(&self, (x, y): &(f64, f64)) -> bool {
        self.x.contains(x) && self.x_scale.shows(*x) && self.y_scale.shows(*y)
    }

    fn shown(&self) -> impl Iterator<Item = &(f64, f64)> {
        self.lines.iter().flat_map(|l| &l.points).filter(|point| self.shows(point))
    }

    /// Limits of y: as given, or around the points.
    fn limits(&self) -> Result<Range<f64>, ChartError> {
        if let Some(y) = &self.y {
            return Ok(y.clone());
        }
        let around = |(lo, hi): (f64, f64), (_, y): &(f64, f64)| (lo.min(*y), hi.max(*y));
        let (lo, hi) = self.shown().fold((f64::INFINITY, f64::NEG_INFINITY), around);
        if lo > hi {
            return Err(ChartError::Empty { panel: self.title.clone(), x: self.x.clone() });
        }
        if self.y_scale == Scale::Linear {
            let margin = if hi > lo { 0.05 * (hi - lo) } else { 0.5 * hi.abs().max(1.0) };
            return Ok(lo - margin..hi + margin);
        }
        let (lo, hi) = (lo.log10().floor(), hi.log10().ceil());
        Ok(10_f64.powf(lo)..10_f64.powf(hi.max(lo + 1.0)))
    }

    /// Corner in which the legend covers the fewest points.
    fn emptiest_corner(&self, y: &Range<f64>) -> SeriesLabelPosition {
        let covered = |right: bool, upper: bool| {
            let near = |at: f64, end: bool, reach: f64| if end { at > 1.0 - reach } else { at < reach };
            self.shown()
                .filter(|(px, py)| {
                    near(self.x_scale.place(*px, &self.x), right, 0.35) && near(self.y_scale.place(*py, y), upper, 0.3)
                })
                .count()
        };
        let corners = [
            (SeriesLabelPosition::UpperRight, covered(true, true)),
            (SeriesLabelPosition::LowerRight, covered(true, false)),
            (SeriesLabelPosition::UpperLeft, covered(false, true)),
            (SeriesLabelPosition::LowerLeft, covered(false, false)),
        ];
        corners
            .into_iter()
            .min_by_key(|(_, hidden)| *hidden)
            .map_or(SeriesLabelPosition::UpperRight, |(corner, _)| corner)
    }

    fn draw(&self, area: &DrawingArea<SVGBackend<'_>, Shift>) -> Result<(), ChartError> {
        let y = self.limits()?;
        let x = self.x.clone();
        match (self.x_scale, self.y_scale) {
            (Scale::Logarithmic, Scale::Logarithmic) => self.draw_on(area, &y, x.log_scale(), y.clone().log_scale()),
            (Scale::Logarithmic, Scale::Linear) => self.draw_on(area, &y, x.log_scale(), y.clone()),
            (Scale::Linear, Scale::Logarithmic) => self.draw_on(area, &y, x, y.clone().log_scale()),
            (Scale::Linear, Scale::Linear) => self.draw_on(area, &y, x, y.clone()),
        }
    }

    fn draw_on<X, Y>(
        &self,
        area: &DrawingArea<SVGBackend<'_>, Shift>,
        y: &Range<f64>,
        x_axis: X,
        y_axis: Y,
    ) -> Result<(), ChartError>
    where
        X: AsRangedCoord<Value = f64>,
        Y: AsRangedCoord<Value = f64>,
        X::CoordDescType: Ranged<ValueType = f64> + ValueFormatter<f64>,
        Y::CoordDescType: Ranged<ValueType = f64> + ValueFormatter<f64>,
    {
        let mut chart = ChartBuilder::on(area)
            .caption(&self.title, ("sans-serif", 17))
            .margin(10)
            .x_label_area_size(42)
            .y_label_area_size(70)
            .build_cartesian_2d(x_axis, y_axis)
            .map_err(refused)?;
        chart
            .configure_mesh()
            .x_desc(&self.x_label)
            .y_desc(&self.y_label)
            .axis_desc_style(("sans-serif", 14))
            .label_style(("sans-serif", 12))
            .x_label_formatter(&|value| self.x_scale.text(*value, &self.x))
            .y_label_formatter(&|value| self.y_scale.text(*value, y))
            .bold_line_style(RGBColor(200, 200, 200))
            .max_light_lines(0)
            .draw()
            .map_err(refused)?;
        for line in &self.lines {
            let (r, g, b) = PALETTE[line.colour % PALETTE.len()];
            let style = RGBColor(r, g, b).stroke_width(2);
            let points: Vec<_> = line
                .points
                .iter()
                .copied()
                .filter(|point| self.shows(point))
                .map(|(x, v)| (x, v.clamp(y.start, y.end)))
                .collect();
            let solid = move |(x, y): (i32, i32)| PathElement::new([(x, y), (x + 18, y)], style);
            let dashes = move |(x, y): (i32, i32)| {
                let dash = |from: i32| PathElement::new([(from, 0), (from + 5, 0)], style);
                EmptyElement::at((x, y)) + dash(0) + dash(7) + dash(14)
            };
            let series = match line.stroke {
                Stroke::Solid => chart.draw_series(LineSeries::new(points, style)),
                Stroke::Dashed => chart.draw_series(DashedLineSeries::new(points, 6, 4, style)),
                Stroke::Area => chart.draw_series([Polygon::new(points, RGBColor(r, g, b).mix(0.25))]),
            }
            .map_err(refused)?;
            match line.stroke {
                _ if line.label.is_empty() => series,
                Stroke::Solid => series.label(&line.label).legend(solid),
                Stroke::Dashed => series.label(&line.label).legend(dashes),
                Stroke::Area => series.label(&line.label).legend(move |(x, y)| {
                    Rectangle::new([(x, y - 5), (x + 18, y + 5)], RGBColor(r, g, b).mix(0.25).filled())
                }),
            };
        }
        chart
            .configure_series_labels()
            .position(self.emptiest_corner(y))
            .background_style(WHITE.mix(0.85))
            .border_style(RGBColor(200, 200, 200))
            .label_font(("sans-serif", 12))
            .draw()
            .map_err(refused)
    }
}

fn refused<E: std::fmt::Display>(error: E) -> ChartError {
    ChartError::Drawing(error.to_string())
}

/// Draws panels, `columns` in a row.
///
/// # Errors
/// [`ChartError`]: a panel without points, or a failure of the drawing library.
pub fn svg(panels: &[Panel], columns: usize) -> Result<String, ChartError> {
    let columns = columns.clamp(1, panels.len().max(1));
    let rows = panels.len().div_ceil(columns);
    let size = (PANEL.0 * columns as u32, PANEL.1 * rows as u32);
    let mut out = String::new();
    {
        let root = SVGBackend::with_string(&mut out, size).into_drawing_area();
        root.fill(&WHITE).map_err(refused)?;
        for (panel, area) in panels.iter().zip(root.split_evenly((rows, columns))) {
            panel.draw(&area)?;
        }
        root.present().map_err(refused)?;
    }
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn panel(points: Vec<(f64, f64)>) -> Panel {
        let line = Line { label: "|S| & <T>".to_owned(), colour: 0, stroke: Stroke::Solid, points };
        Panel {
            title: "tm1.x".to_owned(),
            x_label: "frequency / Hz".to_owned(),
            y_label: "|S|".to_owned(),
            x_scale: Scale::Logarithmic,
            y_scale: Scale::Logarithmic,
            x: 1e-4..1.0,
            y: None,
            lines: vec![line],
        }
    }

    #[test]
    fn a_chart_holds_its_texts_and_its_lines() {
        let picture = svg(&[panel(vec![(1e-3, 2e-9), (1e-2, 3e-8)]), panel(vec![(1e-3, 1.0), (0.5, 2.0)])], 2).unwrap();
        assert!(picture.starts_with("<svg") && picture.trim_end().ends_with("</svg>"));
        assert!(
            picture.contains("tm1.x") && picture.contains("frequency / Hz") && picture.contains("|S| &amp; &lt;T&gt;")
        );
        assert!(picture.matches("<polyline").count() >= 2);
    }

    #[test]
    fn limits_are_whole_decades() {
        assert_eq!(panel(vec![(1e-3, 2e-9), (1e-2, 3e-8)]).limits().unwrap(), 1e-9..1e-7);
        assert_eq!(panel(vec![(1e-3, 1.0)]).limits().unwrap(), 1.0..10.0);
    }

    #[test]
    fn linear_axes_show_zero_and_below() {
        assert_eq!(
            [1e-16, -0.2, 0.6000000000000001].map(|v| Scale::Linear.text(v, &(-1.0..1.0))),
            ["0", "-0.2", "0.6"]
        );
        let mut linear = panel(vec![(0.0, -1.0), (0.5, 0.0), (0.9, 3.0), (0.95, f64::NAN)]);
        (linear.x_scale, linear.y_scale, linear.x) = (Scale::Linear, Scale::Linear, 0.0..1.0);
        assert_eq!(linear.limits().unwrap(), -1.2..3.2);
        assert_eq!(linear.shown().count(), 3);
        assert!(svg(&[linear.clone()], 1).unwrap().lines().any(|text| text.trim() == "0.5"));
        linear.y_scale = Scale::Logarithmic;
        assert_eq!(linear.shown().count(), 1);
        svg(&[linear], 1).unwrap();
    }

    #[test]
    fn what_has_no_place_on_the_axes_is_refused_by_name() {
        let error = svg(&[panel(vec![(1e-3, -1.0), (2.0, 1.0), (1e-2, f64::NAN)])], 1).unwrap_err().to_string();
        assert!(error.contains("tm1.x"), "{error}");
    }
}
