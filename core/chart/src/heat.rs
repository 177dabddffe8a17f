//! Heat maps of a ratio over two axes; red above one, blue below.

use plotters::prelude::*;

use crate::{ChartError, refused};

/// A cell of a map.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Cell {
    /// Limits in x.
    pub x: [f64; 2],
    /// Limits in y, positive.
    pub y: [f64; 2],
    /// Ratio shown by the colour.
    pub ratio: f64,
    /// Whether it is framed.
    pub framed: bool,
}

/// A map; x is linear, y logarithmic.
#[derive(Clone, Debug, PartialEq)]
pub struct HeatMap {
    /// Title.
    pub title: String,
    /// Label of x, with the unit.
    pub x_label: String,
    /// Label of y, with the unit.
    pub y_label: String,
    /// Cells; grey elsewhere.
    pub cells: Vec<Cell>,
}

/// Colour scale: from the inverse of this ratio to this ratio.
const MOST: f64 = 4.0;

/// End and middle colours, distinguishable for the colour-blind.
const BELOW: [f64; 3] = [33.0, 102.0, 172.0];
const EVEN: [f64; 3] = [247.0; 3];
const ABOVE: [f64; 3] = [178.0, 24.0, 43.0];

const PANEL: (u32, u32) = (560, 300);
const LEGEND: u32 = 60;

/// Colour of a ratio, linear in its logarithm.
fn colour(ratio: f64) -> RGBColor {
    let place = if ratio > 0.0 { (ratio.ln() / MOST.ln()).clamp(-1.0, 1.0) } else { -1.0 };
    let end = if place < 0.0 { BELOW } else { ABOVE };
    let [r, g, b] = std::array::from_fn(|i| (EVEN[i] + (end[i] - EVEN[i]) * place.abs()).round() as u8);
    RGBColor(r, g, b)
}

/// Draws maps, `columns` in a row, with a colour scale below.
///
/// # Errors
/// [`ChartError`]: a map without cells, or a failure of the drawing library.
pub fn svg(maps: &[HeatMap], columns: usize, legend: &str) -> Result<String, ChartError> {
    let columns = columns.clamp(1, maps.len().max(1));
    let rows = maps.len().div_ceil(columns);
    let size = (PANEL.0 * columns as u32, PANEL.1 * rows as u32 + LEGEND);
    let mut out = String::new();
    {
        let root = SVGBackend::with_string(&mut out, size).into_drawing_area();
        root.fill(&WHITE).map_err(refused)?;
        let (above, below) = root.split_vertically(size.1 - LEGEND);
        for (map, area) in maps.iter().zip(above.split_evenly((rows, columns))) {
            draw(map, &area)?;
        }
        explain(&below, legend)?;
        root.present().map_err(refused)?;
    }
    Ok(out)
}

type Area<'a> = DrawingArea<SVGBackend<'a>, plotters::coord::Shift>;

fn draw(map: &HeatMap, area: &Area<'_>) -> Result<(), ChartError> {
    let ends = |of: fn(&Cell) -> [f64; 2]| {
        let all = map.cells.iter().flat_map(of);
        all.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), x| (low.min(x), high.max(x)))
    };
    let (x, y) = (ends(|c| c.x), ends(|c| c.y));
    if x.0.partial_cmp(&x.1) != Some(std::cmp::Ordering::Less) || y.0.is_nan() || y.0 <= 0.0 || y.0 >= y.1 {
        return Err(ChartError::Empty { panel: map.title.clone(), x: x.0..x.1 });
    }
    let mut chart = ChartBuilder::on(area)
        .caption(&map.title, ("sans-serif", 17))
        .margin(10)
        .x_label_area_size(42)
        .y_label_area_size(70)
        .build_cartesian_2d(x.0..x.1, (y.0..y.1).log_scale())
        .map_err(refused)?;
    let rectangles =
        |style: fn(&Cell) -> ShapeStyle| move |c: &Cell| Rectangle::new([(c.x[0], c.y[0]), (c.x[1], c.y[1])], style(c));
    chart.plotting_area().fill(&RGBColor(225, 225, 225)).map_err(refused)?;
    chart.draw_series(map.cells.iter().map(rectangles(|c| colour(c.ratio).filled()))).map_err(refused)?;
    let framed = map.cells.iter().filter(|c| c.framed);
    chart.draw_series(framed.map(rectangles(|_| BLACK.stroke_width(2)))).map_err(refused)?;
    chart
        .configure_mesh()
        .disable_mesh()
        .x_desc(&map.x_label)
        .y_desc(&map.y_label)
        .axis_desc_style(("sans-serif", 14))
        .label_style(("sans-serif", 12))
        .y_label_formatter(&|value| format!("{value:.0e}"))
        .draw()
        .map_err(refused)
}

/// Colour scale with three labelled values.
fn explain(area: &Area<'_>, legend: &str) -> Result<(), ChartError> {
    const STEPS: i32 = 60;
    const LEFT: i32 = 80;
    const TOP: i32 = 8;
    const WIDE: i32 = 5;
    const HIGH: i32 = 16;
    for step in 0..STEPS {
        let ratio = MOST.powf(2.0 * f64::from(step) / f64::from(STEPS - 1) - 1.0);
        let left = LEFT + WIDE * step;
        let strip = Rectangle::new([(left, TOP), (left + WIDE, TOP + HIGH)], colour(ratio).filled());
        area.draw(&strip).map_err(refused)?;
    }
    let font = ("sans-serif", 13).into_font();
    for (place, text) in [(0, format!("1/{MOST}")), (STEPS / 2, "1".to_owned()), (STEPS, format!("{MOST}"))] {
        area.draw(&Text::new(text, (LEFT + WIDE * place - 4, TOP + HIGH + 4), font.clone())).map_err(refused)?;
    }
    area.draw(&Text::new(legend.to_owned(), (LEFT + WIDE * STEPS + 30, TOP), font)).map_err(refused)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colours_run_from_blue_by_white_to_red_in_even_steps_of_the_logarithm() {
        assert_eq!(
            [0.0, 0.1, 1.0, 4.0, 100.0].map(colour),
            [
                RGBColor(33, 102, 172),
                RGBColor(33, 102, 172),
                RGBColor(247, 247, 247),
                RGBColor(178, 24, 43),
                RGBColor(178, 24, 43)
            ]
        );
        // Halfway from white to red.
        assert_eq!(colour(2.0), RGBColor(213, 136, 145));
    }

    #[test]
    fn a_map_holds_its_cells_its_frames_and_its_legend() {
        let cell = |h: f64, ratio, framed| Cell { x: [h, h + 1.0], y: [1e-3, 1e-2], ratio, framed };
        let map = HeatMap {
            title: "tm1.x".to_owned(),
            x_label: "hour".to_owned(),
            y_label: "frequency / Hz".to_owned(),
            cells: vec![cell(0.0, 1.0, false), cell(1.0, 4.0, true)],
        };
        let picture = svg(std::slice::from_ref(&map), 1, "measured over predicted power").unwrap();
        for text in ["tm1.x", "frequency / Hz", "measured over predicted power", "#B2182B", "#F7F7F7"] {
            assert!(picture.contains(text), "{text}");
        }
        let empty = HeatMap { cells: Vec::new(), ..map };
        assert!(svg(&[empty], 1, "").unwrap_err().to_string().contains("tm1.x"));
    }
}
