//! Tables of counts as pictures, such as confusion matrices.

use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

use crate::{ChartError, refused};

/// A table of counts.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Matrix {
    /// Title.
    pub title: String,
    /// Row labels.
    pub rows: Vec<String>,
    /// Column labels.
    pub columns: Vec<String>,
    /// Counts, row by row.
    pub counts: Vec<Vec<usize>>,
    /// Cells that count as right, (row, column).
    pub right: Vec<(usize, usize)>,
}

const CELL: i32 = 26;
/// Space for row and column labels.
const LEFT: i32 = 150;
const TOP: i32 = 150;
const MARGIN: i32 = 14;

/// Colours of right and wrong cells, distinguishable for the colour-blind.
const RIGHT: [f64; 3] = [0.0, 114.0, 178.0];
const WRONG: [f64; 3] = [213.0, 94.0, 0.0];

/// Shade: darker with the cell's share of its row.
fn colour(of: [f64; 3], part: f64) -> RGBColor {
    let [r, g, b] = of.map(|full| (255.0 + (full - 255.0) * (0.25 + 0.75 * part)).round() as u8);
    RGBColor(r, g, b)
}

/// Draws tables one below the other.
///
/// # Errors
/// [`ChartError`]: a table without cells, or a failure of the drawing library.
pub fn svg(tables: &[Matrix]) -> Result<String, ChartError> {
    let high = |m: &Matrix| TOP + CELL * m.rows.len() as i32 + MARGIN;
    let wide = tables.iter().map(|m| LEFT + CELL * m.columns.len() as i32 + 3 * MARGIN).max().unwrap_or(0);
    if let Some(empty) = tables.iter().find(|m| m.rows.is_empty() || m.columns.is_empty()) {
        return Err(ChartError::Empty { panel: empty.title.clone(), x: 0.0..0.0 });
    }
    let size = (wide.max(0) as u32, tables.iter().map(high).sum::<i32>().max(0) as u32);
    let mut out = String::new();
    {
        let root = SVGBackend::with_string(&mut out, size).into_drawing_area();
        root.fill(&WHITE).map_err(refused)?;
        let mut top = 0;
        for m in tables {
            draw(m, &root, top)?;
            top += high(m);
        }
        root.present().map_err(refused)?;
    }
    Ok(out)
}

fn draw(m: &Matrix, area: &DrawingArea<SVGBackend<'_>, plotters::coord::Shift>, top: i32) -> Result<(), ChartError> {
    let font = |size: i32| ("sans-serif", size).into_font();
    let text = |text: &str, at: (i32, i32), style: TextStyle<'_>| {
        area.draw(&Text::new(text.to_owned(), at, style)).map_err(refused)
    };
    text(&m.title, (MARGIN, top + 8), font(16).color(&BLACK))?;
    let below = top + TOP;
    for (j, name) in m.columns.iter().enumerate() {
        let style = font(12).transform(FontTransform::Rotate270).color(&BLACK).pos(Pos::new(HPos::Left, VPos::Center));
        text(name, (LEFT + CELL * j as i32 + CELL / 2, below - 6), style)?;
    }
    for (i, (name, counts)) in m.rows.iter().zip(&m.counts).enumerate() {
        let y = below + CELL * i as i32;
        let style = font(12).color(&BLACK).pos(Pos::new(HPos::Right, VPos::Center));
        text(name, (LEFT - 6, y + CELL / 2), style)?;
        let all = counts.iter().sum::<usize>().max(1);
        for (j, count) in counts.iter().enumerate() {
            let x = LEFT + CELL * j as i32;
            let is_right = m.right.contains(&(i, j));
            if *count > 0 {
                let fill = colour(if is_right { RIGHT } else { WRONG }, *count as f64 / all as f64);
                area.draw(&Rectangle::new([(x, y), (x + CELL, y + CELL)], fill.filled())).map_err(refused)?;
                let dark = *count * 2 > all;
                let style =
                    font(12).color(if dark { &WHITE } else { &BLACK }).pos(Pos::new(HPos::Center, VPos::Center));
                text(&count.to_string(), (x + CELL / 2, y + CELL / 2), style)?;
            }
            let grey = RGBColor(215, 215, 215).stroke_width(1);
            area.draw(&Rectangle::new([(x, y), (x + CELL, y + CELL)], grey)).map_err(refused)?;
        }
    }
    // Drawn after all cells.
    for (i, j) in m.right.iter().filter(|(i, j)| *i < m.rows.len() && *j < m.columns.len()) {
        let (x, y) = (LEFT + CELL * *j as i32, below + CELL * *i as i32);
        area.draw(&Rectangle::new([(x, y), (x + CELL, y + CELL)], BLACK.stroke_width(2))).map_err(refused)?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_table_has_its_names_and_counts() {
        let table = Matrix {
            title: "Said of what was hidden".to_owned(),
            rows: vec!["a".to_owned(), "nothing".to_owned()],
            columns: vec!["a".to_owned(), "sufficient".to_owned()],
            counts: vec![vec![17, 3], vec![0, 5]],
            right: vec![(0, 0), (1, 1)],
        };
        let picture = svg(std::slice::from_ref(&table)).expect("a picture");
        for word in ["Said of what was hidden", "nothing", "sufficient", "17", "5"] {
            assert!(picture.contains(word), "{word}");
        }
        // Frames are drawn after all cells.
        let last = |word: &str| picture.rfind(word).expect("drawn");
        assert!(last("stroke=\"#000000\"") > last("stroke=\"#D7D7D7\""), "{picture}");
        assert!(svg(&[Matrix { rows: Vec::new(), ..table }]).is_err());
    }
}
