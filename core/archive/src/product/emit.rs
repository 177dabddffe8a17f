//! TOML for readers: the `toml` crate spells 1.1e-10 with ten zeros and a matrix in one line.
//!
//! Every product is parsed again by the `toml` crate and compared before it is archived, so a slip here is an error,
//! never a wrong product.

use std::fmt::Write as _;
use toml::{Table, Value};

/// The text of a document; floats survive bit for bit.
pub(crate) fn emit(document: &Table) -> String {
    let mut text = String::new();
    tables(&mut text, "", document);
    text
}

/// Keys of `table` under the header that stands already, then its tables under headers of their own.
fn tables(text: &mut String, path: &str, table: &Table) {
    for (name, item) in table.iter().filter(|(_, item)| !has_header(item)) {
        let _ = writeln!(text, "{} = {}", key(name), value(item)); // here and below: a String takes everything
    }
    for (name, item) in table.iter().filter(|(_, item)| has_header(item)) {
        let path = if path.is_empty() { key(name) } else { format!("{path}.{}", key(name)) };
        match item {
            Value::Table(inner) => {
                let only_headers = !inner.is_empty() && inner.values().all(has_header);
                if !only_headers {
                    let _ = writeln!(text, "\n[{path}]");
                }
                tables(text, &path, inner);
            }
            Value::Array(items) => {
                for inner in items.iter().filter_map(Value::as_table) {
                    let _ = writeln!(text, "\n[[{path}]]");
                    tables(text, &path, inner);
                }
            }
            _ => {}
        }
    }
}

/// Tables, and arrays of nothing but tables.
fn has_header(item: &Value) -> bool {
    match item {
        Value::Table(_) => true,
        Value::Array(items) => !items.is_empty() && items.iter().all(Value::is_table),
        _ => false,
    }
}

/// A value on the right of `=`.
fn value(item: &Value) -> String {
    match item {
        Value::Float(number) => float(*number),
        Value::Array(rows) if rows.len() > 1 && rows.iter().all(Value::is_array) => {
            rows.iter().fold("[\n".to_owned(), |text, row| format!("{text}    {},\n", value(row))) + "]"
        }
        Value::Array(items) => format!("[{}]", items.iter().map(value).collect::<Vec<_>>().join(", ")),
        Value::Table(table) => {
            let pairs = table.iter().map(|(name, item)| format!("{} = {}", key(name), value(item)));
            format!("{{ {} }}", pairs.collect::<Vec<_>>().join(", "))
        }
        other => other.to_string(),
    }
}

/// Shortest digits that give the same float again.
fn float(number: f64) -> String {
    let plain = number == 0.0 || (1e-3..1e15).contains(&number.abs());
    if number.is_nan() {
        "nan".to_owned()
    } else if plain || number.is_infinite() {
        format!("{number:?}")
    } else {
        format!("{number:e}")
    }
}

fn key(name: &str) -> String {
    let bare = |c: char| c.is_ascii_alphanumeric() || matches!(c, '_' | '-');
    if !name.is_empty() && name.chars().all(bare) {
        return name.to_owned();
    }
    let mut quoted = String::from("\"");
    for c in name.chars() {
        match c {
            '"' | '\\' => quoted.extend(['\\', c]),
            c if c.is_control() => {
                let _ = write!(quoted, "\\u{:04X}", u32::from(c));
            }
            c => quoted.push(c),
        }
    }
    quoted + "\""
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn small_numbers_and_matrices_are_readable() {
        let document: Table = toml::from_str(
            "a = 0.00000000011444\nb = 90.9\nc = [[1.0, nan], [inf, -0.0]]\n[d]\n[d.e]\nf = []\n[[g]]\nh = 1\n[[g]]",
        )
        .expect("TOML");
        let expected = "a = 1.1444e-10\nb = 90.9\nc = [\n    [1.0, nan],\n    [inf, -0.0],\n]\n\n[d.e]\nf = []\n\n\
            [[g]]\nh = 1\n\n[[g]]\n";
        assert_eq!(emit(&document), expected);
    }

    fn any_value() -> impl Strategy<Value = Value> {
        let leaf = prop_oneof![
            any::<bool>().prop_map(Value::from),
            any::<i64>().prop_map(Value::from),
            any::<f64>().prop_filter("NaN has no sign to keep", |f| !f.is_nan()).prop_map(Value::from),
            any::<String>().prop_map(Value::from),
        ];
        leaf.prop_recursive(4, 24, 4, |inner| {
            prop_oneof![
                proptest::collection::vec(inner.clone(), 0..4).prop_map(Value::Array),
                proptest::collection::btree_map(any::<String>(), inner, 0..4)
                    .prop_map(|map| Value::Table(map.into_iter().collect())),
            ]
        })
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(256))]

        /// The `toml` crate reads back what was emitted, whatever the nesting.
        #[test]
        fn everything_survives(map in proptest::collection::btree_map(any::<String>(), any_value(), 0..5)) {
            let document: Table = map.into_iter().collect();
            let text = emit(&document);
            let back: Table = toml::from_str(&text).map_err(|e| TestCaseError::fail(format!("{e}\n{text}")))?;
            prop_assert_eq!(back, document);
        }
    }
}
