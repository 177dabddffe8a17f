//! Parameters against their declaration: unknown keys, types, ranges, defaults.

use serde_json::{Map, Value};

use dragfree_schema::{Manifest, Parameter, ParameterType};

use super::ConfigError;

/// The full set of parameters of a plugin: those given, checked, and the defaults of the rest.
///
/// # Errors
/// [`ConfigError::Parameter`] names the key and what it may be.
pub fn resolve(file: &str, manifest: &Manifest, given: &toml::Table) -> Result<Map<String, Value>, ConfigError> {
    let refuse = |what: String| ConfigError::Parameter { file: file.to_owned(), plugin: manifest.id.clone(), what };
    if let Some(unknown) = given.keys().find(|key| !manifest.parameters.iter().any(|p| p.name == **key)) {
        let known: Vec<&str> = manifest.parameters.iter().map(|p| p.name.as_str()).collect();
        let known = if known.is_empty() { "it has none".to_owned() } else { format!("it has {}", known.join(", ")) };
        return Err(refuse(format!("`{unknown}` is no parameter; {known}")));
    }
    manifest
        .parameters
        .iter()
        .map(|p| {
            let value = match given.get(&p.name) {
                Some(value) => check(p, value).map_err(|what| refuse(format!("`{}` = {value} {what}", p.name)))?,
                None => p.default.clone(),
            };
            Ok((p.name.clone(), value))
        })
        .collect()
}

fn check(parameter: &Parameter, value: &toml::Value) -> Result<Value, String> {
    let unit = match parameter.unit.as_str() {
        "" | "1" => String::new(),
        unit => format!(" in {unit}"),
    };
    match parameter.kind {
        ParameterType::F64 => number(parameter, value)
            .map(Value::from)
            .ok_or_else(|| format!("must be a finite number{unit}{}", range(parameter))),
        ParameterType::I64 => value
            .as_integer()
            .filter(|i| within(parameter, *i as f64))
            .map(Value::from)
            .ok_or_else(|| format!("must be a whole number{unit}{}", range(parameter))),
        ParameterType::Bool => value.as_bool().map(Value::from).ok_or_else(|| "must be true or false".to_owned()),
        ParameterType::Text => match value.as_str() {
            Some(text) if parameter.choices.is_empty() || parameter.choices.iter().any(|c| c == text) => {
                Ok(Value::from(text))
            }
            Some(_) => Err(format!("must be one of {}", parameter.choices.join(", "))),
            None => Err("must be a text".to_owned()),
        },
        ParameterType::F64List => value
            .as_array()
            .and_then(|items| items.iter().map(|v| number(parameter, v)).collect::<Option<Vec<f64>>>())
            .map(Value::from)
            .ok_or_else(|| format!("must be a list of finite numbers{unit}")),
        ParameterType::TextList => value
            .as_array()
            .and_then(|items| items.iter().map(|v| v.as_str().map(str::to_owned)).collect::<Option<Vec<String>>>())
            .map(Value::from)
            .ok_or_else(|| "must be a list of texts".to_owned()),
    }
}

fn number(parameter: &Parameter, value: &toml::Value) -> Option<f64> {
    value.as_float().or_else(|| value.as_integer().map(|i| i as f64)).filter(|x| x.is_finite() && within(parameter, *x))
}

fn within(parameter: &Parameter, x: f64) -> bool {
    parameter.minimum.is_none_or(|m| x >= m) && parameter.maximum.is_none_or(|m| x <= m)
}

fn range(parameter: &Parameter) -> String {
    match (parameter.minimum, parameter.maximum) {
        (Some(a), Some(b)) => format!(" from {a} to {b}"),
        (Some(a), None) => format!(" of at least {a}"),
        (None, Some(b)) => format!(" of at most {b}"),
        (None, None) => String::new(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn manifest() -> Manifest {
        serde_json::from_value(serde_json::json!({
            "id": "gain", "version": "1.0.0", "licence": "MIT", "description": "",
            "parameters": [
                { "name": "gain", "type": "f64", "unit": "1", "default": 2.0, "minimum": 0.0, "maximum": 10.0 },
                { "name": "mode", "type": "text", "default": "a", "choices": ["a", "b"] },
                { "name": "list", "type": "f64_list", "default": [1.0] },
            ],
        }))
        .expect("a manifest")
    }

    fn resolved(text: &str) -> Result<Map<String, Value>, String> {
        resolve("pipeline.toml", &manifest(), &text.parse().expect("TOML")).map_err(|e| e.to_string())
    }

    #[test]
    fn defaults_fill_in_what_is_not_said() {
        let all = resolved("gain = 3").expect("in range");
        assert_eq!(all["gain"], 3.0);
        assert_eq!(all["mode"], "a");
    }

    #[test]
    fn every_refusal_names_the_key_and_what_it_may_be() {
        for (text, part) in [
            ("gian = 3", "`gian` is no parameter; it has gain, mode, list"),
            ("gain = 30", "from 0 to 10"),
            ("gain = nan", "finite"),
            ("gain = \"3\"", "must be a finite number from 0 to 10"),
            ("mode = \"c\"", "one of a, b"),
            ("list = [1, inf]", "finite numbers"),
        ] {
            let error = resolved(text).expect_err(text);
            assert!(error.contains(part), "{text}: {error}");
        }
    }
}
