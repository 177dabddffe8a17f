//! Text for people: columns, numbers, colours.

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

/// A word as a shell takes it.
pub(crate) fn quoted(word: &str) -> String {
    let plain = |c: char| c.is_ascii_alphanumeric() || "-_./:=,+@".contains(c);
    if !word.is_empty() && word.chars().all(plain) {
        word.to_owned()
    } else {
        format!("'{}'", word.replace('\'', r"'\''"))
    }
}

/// `216 000`.
pub(crate) fn grouped(number: u64) -> String {
    let digits = number.to_string();
    let mut text = String::new();
    for (at, digit) in digits.chars().enumerate() {
        if at > 0 && (digits.len() - at).is_multiple_of(3) {
            text.push(' ');
        }
        text.push(digit);
    }
    text
}

/// The unit that people read and the factor to it: offsets are told in millimetres.
pub(crate) fn readable_unit(unit: &str) -> (&str, f64) {
    match unit {
        "m" => ("mm", 1e3),
        "1" => ("", 1.0),
        other => (other, 1.0),
    }
}

/// A value with its standard deviation, two digits of the latter: `90.912 ± 0.011`.
pub(crate) fn measured(value: f64, sigma: f64) -> String {
    if !value.is_finite() {
        return "-".to_owned();
    }
    if !(sigma.is_finite() && sigma > 0.0) {
        return format!("{} ± ?", plain(value));
    }
    let decimals = 1 - exponent(sigma);
    if (0..=7).contains(&decimals) && value.abs() < 1e6 {
        let decimals = usize::try_from(decimals).unwrap_or(0);
        return format!("{value:.decimals$} ± {sigma:.decimals$}");
    }
    let common = exponent(value.abs().max(sigma));
    let scale = 10_f64.powi(-common);
    let decimals = usize::try_from((1 - exponent(sigma * scale)).clamp(1, 9)).unwrap_or(9);
    format!("({:.decimals$} ± {:.decimals$})e{common}", value * scale, sigma * scale)
}

/// A number without a known error.
pub(crate) fn plain(value: f64) -> String {
    if !value.is_finite() {
        "-".to_owned()
    } else if value == 0.0 || (1e-3..1e6).contains(&value.abs()) {
        format!("{value:.4}")
    } else {
        format!("{value:.4e}")
    }
}

/// Power of ten of the first digit of a finite number; 0 for 0.
fn exponent(number: f64) -> i32 {
    let scientific = format!("{number:e}");
    scientific.rsplit_once('e').and_then(|(_, exponent)| exponent.parse().ok()).unwrap_or(0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_label_and_its_words_are_apart() {
        assert_eq!(labelled("fit", "a b").trim_end(), "fit       a b");
        assert_eq!(labelled("    told from", "a b").trim_end(), "    told from a b");
    }

    #[test]
    fn values_are_told_with_two_digits_of_their_error() {
        for (value, sigma, expected) in [
            (90.9123, 0.0111, "90.912 ± 0.011"),
            (-90.9123, 0.123, "-90.91 ± 0.12"),
            (90.9, 1.2e-6, "90.9000000 ± 0.0000012"),
            (0.0, 25.0, "0 ± 25"),
            (3.0e-9, 2.0e-10, "(3.00 ± 0.20)e-9"),
            (1.0e-12, 2.0e-9, "(0.0 ± 2.0)e-9"),
            (1.5e8, 2.0e6, "(1.500 ± 0.020)e8"),
            (1.0, f64::NAN, "1.0000 ± ?"),
            (f64::NAN, 1.0, "-"),
        ] {
            assert_eq!(measured(value, sigma), expected);
        }
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
    fn numbers_are_grouped() {
        for (number, expected) in
            [(0, "0"), (999, "999"), (1000, "1 000"), (216_000, "216 000"), (21_600_000, "21 600 000")]
        {
            assert_eq!(grouped(number), expected);
        }
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

    #[test]
    fn a_word_with_a_space_or_an_apostrophe_is_one_word_to_a_shell() {
        for (word, expected) in
            [("a/b-c_1.toml", "a/b-c_1.toml"), ("my demo", "'my demo'"), ("it's", r"'it'\''s'"), ("", "''")]
        {
            assert_eq!(quoted(word), expected);
        }
    }
}
