//! JSON from plugins: every refusal names the key, and keys that nobody knows are told apart from the rest.

use dragfree_schema::Report;
use serde::de::DeserializeOwned;
use serde_json::Value;

/// Reads a document, with the paths of the keys that its type does not have.
///
/// # Errors
/// A sentence that begins with the path of the key that cannot be understood.
fn lenient<T: DeserializeOwned>(document: Value) -> Result<(T, Vec<String>), String> {
    let mut unknown = Vec::new();
    let mut note = |path: serde_ignored::Path<'_>| unknown.push(path.to_string());
    let known = serde_ignored::Deserializer::new(document, &mut note);
    let read = serde_path_to_error::deserialize(known).map_err(|e| {
        let path = e.path().to_string();
        if path == "." { e.inner().to_string() } else { format!("key `{path}`: {}", e.inner()) }
    })?;
    Ok((read, unknown))
}

/// Reads a declaration. It is refused with an unknown key: what a plugin declares before the first row can still be
/// corrected, and a misspelt `responses` would be an effect without any.
///
/// # Errors
/// A sentence that names the key.
pub(super) fn declaration<T: DeserializeOwned>(document: Value) -> Result<T, String> {
    let (read, unknown) = lenient(document)?;
    match unknown.first() {
        None => Ok(read),
        Some(key) => Err(format!("key `{key}` is unknown; dragfree/schema beside plugin.h lists the keys")),
    }
}

/// Reads a report. Unknown keys and numbers that are none become notes in it: a day of data stands behind a report.
/// What breaks the schema is given beside it.
///
/// # Errors
/// A sentence that names the place or the key that cannot be understood.
pub(super) fn report(text: &str) -> Result<(Report, Vec<String>), String> {
    let mut notes = Vec::new();
    let document = serde_json::from_str(text).or_else(|original| {
        let mended = null_for_nan(text);
        let document = serde_json::from_str(&mended).map_err(|_| format!("a report that is no JSON: {original}"))?;
        notes.push("wrote NaN or infinity, which JSON does not have; read as null".to_owned());
        Ok::<Value, String>(document)
    })?;
    if !document.is_object() {
        return Err("a report must be a JSON object".to_owned());
    }
    let (mut report, unknown): (Report, _) = lenient(document)?;
    notes.extend(unknown.into_iter().map(|key| format!("unknown key {key:?} left out")));
    let broken = notes.clone();
    for (solution, covariance) in &report.covariance {
        let missing = covariance.matrix.iter().flatten().filter(|x| !x.is_finite()).count();
        if missing > 0 {
            notes.push(format!("{missing} entries of the covariance of {solution:?} are no numbers"));
        }
    }
    report.notes.extend(notes);
    Ok((report, broken))
}

/// The text with `null` in place of `nan`, `inf` and `infinity`, as C's `printf` writes them, outside of strings.
fn null_for_nan(text: &str) -> String {
    let mut mended = String::with_capacity(text.len());
    let (mut in_string, mut escaped) = (false, false);
    let mut rest = text;
    while let Some(c) = rest.chars().next() {
        let unsigned = rest.trim_start_matches(['-', '+']);
        let word = unsigned.split(|c: char| !c.is_ascii_alphabetic()).next().unwrap_or_default();
        if !in_string && ["nan", "inf", "infinity"].iter().any(|w| word.eq_ignore_ascii_case(w)) {
            mended.push_str("null");
            rest = &unsigned[word.len()..];
            continue;
        }
        if c == '"' && !escaped {
            in_string = !in_string;
        }
        escaped = c == '\\' && !escaped;
        mended.push(c);
        rest = &rest[c.len_utf8()..];
    }
    mended
}

#[cfg(test)]
mod tests {
    use super::*;

    /// One extra key, top level or deep, failed the run after the whole day had been read.
    #[test]
    fn an_unknown_key_of_a_report_is_noted() {
        let text = r#"{"nis": 1.5, "shade": "blue", "coefficients": [{"name": "a", "solution": "qp", "value": 1.0, "sigma": null, "snr": 3}]}"#;
        let (read, broken) = report(text).expect("a report");
        assert_eq!(broken, read.notes);
        assert_eq!((read.nis, read.coefficients[0].value, read.coefficients[0].sigma), (Some(1.5), Some(1.0), None));
        assert_eq!(read.notes, ["unknown key \"shade\" left out", "unknown key \"coefficients.0.snr\" left out"]);
    }

    /// `printf("%g", sigma)` of a C author writes `nan`, which is no JSON.
    #[test]
    fn nan_as_c_writes_it_is_read_as_null_and_noted() {
        let (read, _) = report(
            r#"{"nis": -nan, "chi2_per_dof": inf, "notes": ["-inf \"nan\" stays"],
                "covariance": {"c": {"names": ["a"], "matrix": [[NaN]]}}}"#,
        )
        .expect("a report");
        assert_eq!((read.nis, read.chi2_per_dof), (None, None));
        assert!(read.covariance["c"].matrix[0][0].is_nan());
        assert_eq!(
            read.notes,
            [
                "-inf \"nan\" stays",
                "wrote NaN or infinity, which JSON does not have; read as null",
                "1 entries of the covariance of \"c\" are no numbers"
            ]
        );
    }

    #[test]
    fn what_cannot_be_understood_is_named() {
        for (text, part) in [
            (r#"{"nis": "good"}"#, "key `nis`: invalid type: string \"good\", expected f64"),
            (r#"{"coefficients": [{"name": "a", "solution": "qp", "value": []}]}"#, "key `coefficients[0].value`: "),
            (r#"{"epochs_used": -1}"#, "key `epochs_used`: "),
            ("[]", "must be a JSON object"),
            (r#"{"nis": nano}"#, "no JSON: expected ident at line 1 column 10"),
            (r#"{"nis": 1"#, "no JSON: EOF"),
        ] {
            let error = report(text).expect_err(text);
            assert!(error.contains(part), "{text}: {error}");
        }
    }

    #[test]
    fn a_declaration_with_a_misspelt_key_is_refused() {
        let text = r#"{"name": "a.b", "unit": "m", "respones": []}"#;
        let error = declaration::<dragfree_schema::Coefficient>(serde_json::from_str(text).expect("JSON"));
        assert!(error.expect_err("misspelt").starts_with("key `respones` is unknown"));
    }
}
