//! Numbers and names as people read them, on screens, on pages and in comments of model files.

/// A word as a shell takes it.
pub fn quoted(word: &str) -> String {
    let plain = |c: char| c.is_ascii_alphanumeric() || "-_./:=,+@".contains(c);
    if !word.is_empty() && word.chars().all(plain) {
        word.to_owned()
    } else {
        format!("'{}'", word.replace('\'', r"'\''"))
    }
}

/// `216 000`.
pub fn grouped(number: u64) -> String {
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
pub fn readable_unit(unit: &str) -> (&str, f64) {
    match unit {
        "m" => ("mm", 1e3),
        "1" => ("", 1.0),
        other => (other, 1.0),
    }
}

/// A unit as it stands after a number: nothing for a pure number.
pub fn after_a_number(unit: &str) -> String {
    if unit == "1" { String::new() } else { format!(" {unit}") }
}

/// A value with its standard deviation, two digits of the latter: `90.912 ± 0.011`.
pub fn measured(value: f64, sigma: f64) -> String {
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
pub fn plain(value: f64) -> String {
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

    #[test]
    fn numbers_are_grouped() {
        for (number, expected) in
            [(0, "0"), (999, "999"), (1000, "1 000"), (216_000, "216 000"), (21_600_000, "21 600 000")]
        {
            assert_eq!(grouped(number), expected);
        }
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
