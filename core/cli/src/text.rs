//! Text for people: columns, numbers, colours.

pub(crate) use dragfree_workflow::words::{grouped, measured, plain, quoted, readable_unit};

use std::fmt::Write as _;

/// Screens are at least this wide.
pub(crate) const WIDTH: usize = 80;

/// Escape sequences, or none of them.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Paint(pub(crate) bool);

impl Paint {
    fn wrap(self, code: &str, text: &str) -> String {
        if self.0 { format!("\x1b[{code}m{text}\x1b[0m") } else { text.to_owned() }
    }

    pub(crate) fn bold(self, text: &str) -> String {
        self.wrap("1", text)
    }

    pub(crate) fn good(self, text: &str) -> String {
        self.wrap("32", text)
    }

    pub(crate) fn doubtful(self, text: &str) -> String {
        self.wrap("33", text)
    }

    pub(crate) fn bad(self, text: &str) -> String {
        self.wrap("31", text)
    }
}

/// A text that tells a terminal nothing: control characters from telemetry, files and plugins become visible, and so do
/// those that turn the direction of writing. The paint's own sequences stay where it is used.
pub(crate) fn harmless(text: &str, paint: Paint) -> String {
    const OWN: [&str; 5] = ["\x1b[0m", "\x1b[1m", "\x1b[31m", "\x1b[32m", "\x1b[33m"];
    let mut safe = String::with_capacity(text.len());
    let mut rest = text;
    while let Some(c) = rest.chars().next() {
        if let Some(own) = OWN.iter().find(|own| paint.0 && rest.starts_with(**own)) {
            safe += own;
            rest = &rest[own.len()..];
            continue;
        }
        match c {
            '\n' | '\t' => safe.push(c),
            '\u{200e}' | '\u{200f}' | '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}' => {
                safe.extend(c.escape_unicode());
            }
            c if c.is_control() => safe.extend(c.escape_default()),
            c => safe.push(c),
        }
        rest = &rest[c.len_utf8()..];
    }
    safe
}

/// Characters on the screen; everything printed here is one column wide.
pub(crate) fn width(text: &str) -> usize {
    text.chars().count()
}

/// Rows in columns, two spaces between them, no space at the end of a line.
pub(crate) fn columns(rows: &[Vec<String>]) -> String {
    let count = rows.iter().map(Vec::len).max().unwrap_or(0);
    let widths: Vec<usize> = (0..count)
        .map(|at| rows.iter().filter_map(|row| row.get(at)).map(|cell| width(cell)).max().unwrap_or(0))
        .collect();
    let mut text = String::new();
    for row in rows {
        let cells = row.iter().zip(&widths).map(|(cell, &wide)| format!("{cell:<wide$}"));
        let line = cells.collect::<Vec<_>>().join("  ");
        let _ = writeln!(text, "{}", line.trim_end());
    }
    text
}

/// A heading and the rows below it, for [`columns`].
pub(crate) fn table(heading: &[&str], rows: impl IntoIterator<Item = Vec<String>>) -> Vec<Vec<String>> {
    let heading = heading.iter().map(|&cell| cell.to_owned()).collect();
    std::iter::once(heading).chain(rows).collect()
}

/// Whether no line is wider than the screen.
pub(crate) fn fits(text: &str) -> bool {
    text.lines().all(|line| width(line) <= WIDTH)
}

/// Each value once, in order of appearance.
pub(crate) fn distinct<T: PartialEq>(all: impl IntoIterator<Item = T>) -> Vec<T> {
    all.into_iter().fold(Vec::new(), |mut seen, one| {
        if !seen.contains(&one) {
            seen.push(one);
        }
        seen
    })
}

/// A sentence broken at [`WIDTH`].
pub(crate) fn wrapped(sentence: &str) -> String {
    wrap(String::new(), 0, sentence)
}

/// `label` and then `words`, broken at [`WIDTH`] and indented under the first word.
pub(crate) fn labelled(label: &str, words: &str) -> String {
    const INDENT: usize = 10;
    let first = format!("{:<INDENT$}", format!("{label} "));
    let indent = width(&first);
    wrap(first, indent, words)
}

fn wrap(first: String, indent: usize, words: &str) -> String {
    let (mut lines, mut line, mut empty) = (String::new(), first, true);
    for word in words.split_whitespace() {
        if !empty && width(&line) + 1 + width(word) > WIDTH {
            lines += &format!(
                "{line}
"
            );
            line = " ".repeat(indent);
        } else if !empty {
            line.push(' ');
        }
        line += word;
        empty = false;
    }
    lines
        + line.trim_end()
        + "
"
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_label_and_its_words_are_apart() {
        assert_eq!(labelled("fit", "a b").trim_end(), "fit       a b");
        assert_eq!(labelled("    told from", "a b").trim_end(), "    told from a b");
    }

    /// A topic or a plugin's note could clear the screen, change the window's title or write over what stood there.
    #[test]
    fn a_terminal_is_told_nothing_by_data() {
        let paint = Paint(true);
        let text = format!("{}\n\tfine ± χ²\x1b]0;title\x07\x1b[2J\r\u{9b}31m\u{202e}", paint.bold("bold"));
        let safe = harmless(&text, paint);
        assert!(safe.starts_with("\x1b[1mbold\x1b[0m\n\tfine ± χ²\\u{1b}]0;title"), "{safe:?}");
        let left = safe.replace("\x1b[1m", "").replace("\x1b[0m", "");
        assert!(left.chars().all(|c| c == '\n' || c == '\t' || !c.is_control()), "{left:?}");
        assert!(!left.contains('\u{202e}') && left.contains("\\u{202e}") && left.contains("\\r"), "{left:?}");
        assert!(!harmless(&text, Paint(false)).contains('\x1b'));
    }

    #[test]
    fn long_sentences_are_broken_under_their_label() {
        let text = labelled("verdict", &"word ".repeat(40));
        assert!(text.lines().count() > 2);
        assert!(text.lines().all(|line| width(line) <= WIDTH), "{text}");
        assert!(text.lines().skip(1).all(|line| line.starts_with("          word")), "{text}");
        assert_eq!(labelled("a", ""), "a\n");
        let text = wrapped(&"word ".repeat(40));
        assert!(text.lines().count() == 3 && text.lines().all(|line| width(line) <= WIDTH), "{text}");
    }
}
