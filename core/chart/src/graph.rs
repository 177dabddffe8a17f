//! Boxes in columns with arrows between them, such as what a product was made of.

use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

use crate::{ChartError, refused};

/// A box.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Node {
    /// Lines of text, the first one bold; empty ones are left out.
    pub lines: Vec<String>,
}

/// A box by its column and its place in it.
pub type Address = (usize, usize);

const WIDTH: i32 = 250;
const LINE: i32 = 16;
const PADDING: i32 = 8;
/// Between columns, where the arrows are, and between boxes.
const GAP_X: i32 = 70;
const GAP_Y: i32 = 14;
const MARGIN: i32 = 14;
const TEXT: i32 = 12;

/// Draws columns of boxes from left to right, each column centred, with arrows from box to box.
///
/// # Errors
/// [`ChartError`]: there is no box, or the drawing library failed.
pub fn svg(columns: &[Vec<Node>], edges: &[(Address, Address)]) -> Result<String, ChartError> {
    let columns: Vec<Vec<Vec<&str>>> = columns
        .iter()
        .map(|c| c.iter().map(|n| n.lines.iter().map(String::as_str).filter(|l| !l.is_empty()).collect()).collect())
        .collect();
    let high = |lines: &Vec<&str>| LINE * lines.len() as i32 + 2 * PADDING;
    let column_high = |column: &Vec<Vec<&str>>| column.iter().map(|n| high(n) + GAP_Y).sum::<i32>() - GAP_Y;
    let all_high = columns.iter().map(column_high).max().unwrap_or(0);
    if all_high <= 0 {
        return Err(ChartError::Empty { panel: "graph".to_owned(), x: 0.0..0.0 });
    }
    let count = columns.len() as i32;
    let size = ((count * (WIDTH + GAP_X) - GAP_X + 2 * MARGIN) as u32, (all_high + 2 * MARGIN) as u32);
    // Left, top and height of every box.
    let mut places: Vec<Vec<(i32, i32, i32)>> = Vec::new();
    for (i, column) in columns.iter().enumerate() {
        let mut top = MARGIN + (all_high - column_high(column)) / 2;
        let left = MARGIN + i as i32 * (WIDTH + GAP_X);
        let mut of_column = Vec::new();
        for lines in column {
            of_column.push((left, top, high(lines)));
            top += high(lines) + GAP_Y;
        }
        places.push(of_column);
    }
    let mut out = String::new();
    {
        let root = SVGBackend::with_string(&mut out, size).into_drawing_area();
        root.fill(&WHITE).map_err(refused)?;
        for (from, to) in edges {
            let at = |(column, place): &Address| places.get(*column).and_then(|c| c.get(*place)).copied();
            let (Some(from), Some(to)) = (at(from), at(to)) else { continue };
            arrow(&root, (from.0 + WIDTH, from.1 + from.2 / 2), (to.0, to.1 + to.2 / 2))?;
        }
        for (column, places) in columns.iter().zip(&places) {
            for (lines, (left, top, high)) in column.iter().zip(places) {
                let corners = [(*left, *top), (left + WIDTH, top + high)];
                root.draw(&Rectangle::new(corners, RGBColor(242, 246, 250).filled())).map_err(refused)?;
                root.draw(&Rectangle::new(corners, RGBColor(0, 114, 178).stroke_width(1))).map_err(refused)?;
                for (i, line) in lines.iter().enumerate() {
                    let style = if i == 0 { FontStyle::Bold } else { FontStyle::Normal };
                    let font = FontDesc::new(FontFamily::SansSerif, f64::from(TEXT), style);
                    let style = TextStyle::from(font).pos(Pos::new(HPos::Left, VPos::Top));
                    let at = (left + PADDING, top + PADDING + LINE * i as i32);
                    root.draw(&Text::new(*line, at, style)).map_err(refused)?;
                }
            }
        }
        root.present().map_err(refused)?;
    }
    Ok(out)
}

fn arrow<B: DrawingBackend>(
    root: &DrawingArea<B, plotters::coord::Shift>,
    from: (i32, i32),
    to: (i32, i32),
) -> Result<(), ChartError> {
    const HEAD: i32 = 6;
    let grey = RGBColor(90, 90, 90);
    let end = (to.0 - HEAD, to.1);
    root.draw(&PathElement::new(vec![from, end], grey.stroke_width(1))).map_err(refused)?;
    let head = vec![to, (to.0 - HEAD - 2, to.1 - HEAD / 2), (to.0 - HEAD - 2, to.1 + HEAD / 2)];
    root.draw(&Polygon::new(head, grey.filled())).map_err(refused)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn boxes_have_their_texts_and_arrows_join_them() {
        let node = |name: &str| Node { lines: vec!["telemetry".to_owned(), name.to_owned(), String::new()] };
        let columns = [vec![node("a.mcap"), node("b.mcap")], vec![node("product")], Vec::new()];
        let picture = svg(&columns, &[((0, 0), (1, 0)), ((0, 1), (1, 0)), ((2, 0), (1, 0))]).expect("a picture");
        for word in ["a.mcap", "b.mcap", "product"] {
            assert!(picture.contains(word), "{word}");
        }
        assert_eq!(picture.matches("<polygon").count(), 2, "one head for each arrow between boxes that there are");
        assert!(svg(&[Vec::new()], &[]).is_err());
    }
}
