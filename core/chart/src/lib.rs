//! Line charts on logarithmic axes, as SVG: amplitude spectra, sensitivities and their bounds.

use plotters::prelude::*;
use std::ops::Range;

/// How a line is drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stroke {
    /// What was measured or computed.
    Solid,
    /// What it is held against.
    Dashed,
}

/// One line of a panel.
#[derive(Clone, Debug)]
pub struct Line {
    /// Text of the legend.
    pub label: String,
    /// Place in [`PALETTE`]; a bound shares the colour of what it bounds.
    pub colour: usize,
    /// How it is drawn.
    pub stroke: Stroke,
    /// Points in the order of x; those that are not positive and finite have no place on the axes and are left out.
    pub points: Vec<(f64, f64)>,
}

/// One pair of axes.
#[derive(Clone, Debug)]
pub struct Panel {
    /// Above the axes.
    pub title: String,
    /// Below, with the unit.
    pub x_label: String,
    /// Left, with the unit.
    pub y_label: String,
    /// Limits of x.
    pub x: Range<f64>,
    /// Limits of y; `None` for whole decades around the points.
    pub y: Option<Range<f64>>,
    /// The lines, the first at the bottom.
    pub lines: Vec<Line>,
}

/// Colours that remain apart for the colour-blind (Okabe and Ito).
pub const PALETTE: [(u8, u8, u8); 7] =
    [(0, 114, 178), (213, 94, 0), (0, 158, 115), (204, 121, 167), (230, 159, 0), (86, 180, 233), (90, 90, 90)];

/// The picture could not be drawn.
#[derive(Debug, thiserror::Error)]
pub enum ChartError {
    /// No point can be shown.
    #[error(
        "panel \"{panel}\" has no point with x in {x:?} and y above zero; nothing can be drawn on logarithmic axes"
    )]
    Empty {
        /// Title of the panel.
        panel: String,
        /// Its limits.
        x: Range<f64>,
    },
    /// The drawing library refused.
    #[error("the picture could not be drawn: {0}")]
    Drawing(String),
}

/// Width and height of a panel, px.
const PANEL: (u32, u32) = (560, 380);

impl Panel {
    fn shown(&self) -> impl Iterator<Item = &(f64, f64)> {
        self.lines.iter().flat_map(|l| &l.points).filter(|(x, y)| self.x.contains(x) && y.is_finite() && *y > 0.0)
    }

    /// Limits of y: as asked, or whole decades around what is shown.
    fn limits(&self) -> Result<Range<f64>, ChartError> {
        if let Some(y) = &self.y {
            return Ok(y.clone());
        }
        let (lo, hi) = self.shown().fold((f64::INFINITY, 0.0_f64), |(lo, hi), (_, y)| (lo.min(*y), hi.max(*y)));
        if hi == 0.0 {
            return Err(ChartError::Empty { panel: self.title.clone(), x: self.x.clone() });
        }
        let (lo, hi) = (lo.log10().floor(), hi.log10().ceil());
        Ok(10_f64.powf(lo)..10_f64.powf(hi.max(lo + 1.0)))
    }

    /// Where the legend hides the fewest points.
    fn emptiest_corner(&self, y: &Range<f64>) -> SeriesLabelPosition {
        let place = |v: f64, range: &Range<f64>| (v / range.start).log10() / (range.end / range.start).log10();
        let covered = |right: bool, upper: bool| {
            let near = |at: f64, end: bool, reach: f64| if end { at > 1.0 - reach } else { at < reach };
            self.shown()
                .filter(|(px, py)| near(place(*px, &self.x), right, 0.35) && near(place(*py, y), upper, 0.3))
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

    fn draw(&self, area: &DrawingArea<SVGBackend<'_>, plotters::coord::Shift>) -> Result<(), ChartError> {
        let y = self.limits()?;
        let mut chart = ChartBuilder::on(area)
            .caption(&self.title, ("sans-serif", 17))
            .margin(10)
            .x_label_area_size(42)
            .y_label_area_size(70)
            .build_cartesian_2d(self.x.clone().log_scale(), y.clone().log_scale())
            .map_err(refused)?;
        chart
            .configure_mesh()
            .x_desc(&self.x_label)
            .y_desc(&self.y_label)
            .axis_desc_style(("sans-serif", 14))
            .label_style(("sans-serif", 12))
            .x_label_formatter(&decade)
            .y_label_formatter(&decade)
            .bold_line_style(RGBColor(200, 200, 200))
            .max_light_lines(0)
            .draw()
            .map_err(refused)?;
        for line in &self.lines {
            let (r, g, b) = PALETTE[line.colour % PALETTE.len()];
            let style = RGBColor(r, g, b).stroke_width(2);
            let visible = line.points.iter().copied().filter(|(x, v)| self.x.contains(x) && v.is_finite() && *v > 0.0);
            let points: Vec<_> = visible.map(|(x, v)| (x, v.clamp(y.start, y.end))).collect();
            let solid = move |(x, y): (i32, i32)| PathElement::new([(x, y), (x + 18, y)], style);
            let dashes = move |(x, y): (i32, i32)| {
                let dash = |from: i32| PathElement::new([(from, 0), (from + 5, 0)], style);
                EmptyElement::at((x, y)) + dash(0) + dash(7) + dash(14)
            };
            match line.stroke {
                Stroke::Solid => {
                    chart.draw_series(LineSeries::new(points, style)).map_err(refused)?.label(&line.label).legend(solid)
                }
                Stroke::Dashed => chart
                    .draw_series(DashedLineSeries::new(points, 6, 4, style))
                    .map_err(refused)?
                    .label(&line.label)
                    .legend(dashes),
            };
        }
        chart
            .configure_series_labels()
            .position(self.emptiest_corner(&y))
            .background_style(WHITE.mix(0.85))
            .border_style(RGBColor(200, 200, 200))
            .label_font(("sans-serif", 12))
            .draw()
            .map_err(refused)
    }
}

/// `1e-3`, as engineers write decades.
fn decade(value: &f64) -> String {
    format!("{value:.0e}")
}

fn refused<E: std::fmt::Display>(error: E) -> ChartError {
    ChartError::Drawing(error.to_string())
}

/// Draws panels side by side, `columns` in a row.
///
/// # Errors
/// [`ChartError`]: a panel without a point, or the library's own refusal.
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
    fn what_has_no_place_on_the_axes_is_refused_by_name() {
        let error = svg(&[panel(vec![(1e-3, -1.0), (2.0, 1.0), (1e-2, f64::NAN)])], 1).unwrap_err().to_string();
        assert!(error.contains("tm1.x"), "{error}");
    }
}
