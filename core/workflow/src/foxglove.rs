//! A layout of Foxglove for the time series beside a product: plots of what belongs together, on three tabs.

use std::collections::BTreeMap;

use dragfree_archive::Archive;
use dragfree_engine::EngineError;
use dragfree_engine::telemetry::topics;
use serde_json::{Map, Value, json};

use crate::WorkflowError;
use crate::over_time::{RESIDUALS, SERIES};

/// The layout, as Foxglove imports it.
///
/// # Errors
/// There is no such product, no file of time series beside it, or that file is damaged.
pub fn layout(archive: &Archive, id: &str) -> Result<Value, WorkflowError> {
    let bytes = archive.read_file(id, SERIES).map_err(EngineError::from)?;
    let path = archive.path_of(id).with_extension(SERIES);
    let fields = topics(&path, &bytes);
    let fields = fields.map_err(|e| WorkflowError::Reference { path, what: e.source.to_string() })?;
    Ok(of_topics(&fields))
}

/// A plot: its title and the paths of its messages.
type Plots = BTreeMap<String, Vec<String>>;

/// Tabs with plots of fields that differ in their axis alone: residuals in σ, values of coefficients, everything else.
fn of_topics(topics: &BTreeMap<String, Vec<String>>) -> Value {
    let mut tabs: [(&str, Plots); 3] =
        [("Residuals", Plots::new()), ("Values", Plots::new()), ("Filter", Plots::new())];
    for (topic, fields) in topics {
        for field in fields {
            let (name, what) = field.rsplit_once('.').unwrap_or(("", field));
            let tab = match what {
                "whitened" if topic == RESIDUALS => 0,
                _ if topic == RESIDUALS => continue,
                "value" => 1,
                "sigma" | "low" | "high" => continue,
                _ => 2,
            };
            let of = if tab == 2 { field } else { name };
            let group = of.rsplit_once('.').map_or(of, |(group, _)| group);
            let title = if tab == 0 { format!("{group}: residual, in σ") } else { group.to_owned() };
            tabs[tab].1.entry(title).or_default().push(format!("{topic}.{field}"));
        }
    }
    let mut configs = Map::new();
    let mut shown: Vec<Value> = Vec::new();
    for (tab, plots) in tabs.iter().filter(|(_, plots)| !plots.is_empty()) {
        let mut panels: Vec<String> = Vec::new();
        for (title, paths) in plots {
            let id = format!("Plot!{}{}", tab.to_lowercase(), panels.len());
            configs.insert(id.clone(), plot(title, paths));
            panels.push(id);
        }
        shown.push(json!({ "title": tab, "layout": stacked(&panels) }));
    }
    configs.insert("Tab!product".to_owned(), json!({ "activeTabIdx": 0, "tabs": shown }));
    json!({
        "configById": configs,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": { "speed": 1 },
        "layout": "Tab!product",
    })
}

fn plot(title: &str, paths: &[String]) -> Value {
    let path = |value: &String| json!({ "value": value, "enabled": true, "timestampMethod": "receiveTime" });
    json!({
        "title": title,
        "paths": paths.iter().map(path).collect::<Vec<_>>(),
        "isSynced": true,
        "xAxisVal": "timestamp",
        "showLegend": true,
        "legendDisplay": "floating",
    })
}

/// Panels of equal height, one below the other.
fn stacked(panels: &[String]) -> Value {
    match panels {
        [] => Value::Null,
        [one] => json!(one),
        [first, rest @ ..] => json!({
            "direction": "column",
            "first": first,
            "second": stacked(rest),
            "splitPercentage": 100.0 / panels.len() as f64,
        }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_belongs_together_is_in_one_plot() {
        let fields = |all: &[&str]| all.iter().map(|f| (*f).to_owned()).collect();
        let residuals = fields(&["tm1.accel.x.value", "tm1.accel.x.whitened", "tm1.accel.y.whitened"]);
        let filter = fields(&["com_offset.tm1.x.value", "com_offset.tm1.x.sigma", "com_offset.tm1.x.low", "tm1.nis"]);
        let layout = of_topics(&[(RESIDUALS.to_owned(), residuals), ("/es-akf".to_owned(), filter)].into());
        let paths = |panel: &str| -> Vec<&str> {
            let all = layout["configById"][panel]["paths"].as_array().expect("paths");
            all.iter().map(|path| path["value"].as_str().expect("a path")).collect()
        };
        assert_eq!(paths("Plot!residuals0"), ["/residuals.tm1.accel.x.whitened", "/residuals.tm1.accel.y.whitened"]);
        assert_eq!(paths("Plot!values0"), ["/es-akf.com_offset.tm1.x.value"]);
        assert_eq!(paths("Plot!filter0"), ["/es-akf.tm1.nis"]);
        let tabs = layout["configById"]["Tab!product"]["tabs"].as_array().expect("tabs");
        assert_eq!(tabs.len(), 3);
        assert_eq!(stacked(&["a".into(), "b".into(), "c".into()])["second"]["splitPercentage"], 50.0);
    }
}
