//! Events of a spacecraft, in the form of JPL's sequence of events of GRACE-FO: a list in YAML.
//!
//! ```yaml
//! - soe_event: MTEA                  # kind of event
//!   time: 2035-01-31 12:00:00 UTC    # or TAI, or GPS
//!   spacecraft: SC1                  # all spacecraft where it is left out
//!   comments: mass trim, +0.5 mm in x
//!   changes: [com-offset]            # effects whose coefficients step; ours
//! ```
//!
//! Which coefficients an event changes, its entry says with `changes`, or else the caller by its kind: JPL's log has no
//! such key.

use std::path::Path;

use chrono::NaiveDateTime;
use serde::{Deserialize, Serialize};

use crate::WorkflowError;

/// An event.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Event {
    /// Kind, `MTEA`.
    pub kind: String,
    /// Time as it is written.
    pub time: String,
    /// Unix ns of its time scale.
    #[serde(skip)]
    pub time_ns: i64,
    /// `UTC`, `TAI` or `GPS`.
    #[serde(skip)]
    pub time_scale: String,
    /// Comment of the log.
    pub comments: String,
    /// Figures of the log, as they are written.
    pub data: serde_json::Map<String, serde_json::Value>,
    /// Effects, or coefficients, that it changes.
    #[serde(rename = "changes")]
    pub effects: Vec<String>,
}

impl Event {
    /// What of it is neither an effect nor a coefficient of a model.
    pub(super) fn names_nothing<'a>(&'a self, coefficients: &[&str]) -> Vec<&'a str> {
        let known = |what: &&String| {
            let one = Self { effects: vec![(*what).clone()], ..self.clone() };
            coefficients.iter().any(|name| one.changes(name))
        };
        self.effects.iter().filter(|what| !known(what)).map(String::as_str).collect()
    }

    /// Whether it changes a coefficient: by its name, or by a beginning of it that ends before a dot.
    pub fn changes(&self, coefficient: &str) -> bool {
        let names = |what: &String| match coefficient.strip_prefix(what.as_str()) {
            Some(rest) => rest.is_empty() || rest.starts_with('.'),
            None => false,
        };
        self.effects.iter().any(names)
    }
}

#[derive(Deserialize)]
struct Entry {
    #[serde(default)]
    soe_event: String,
    #[serde(default)]
    time: String,
    #[serde(default)]
    spacecraft: String,
    #[serde(default)]
    comments: String,
    #[serde(default)]
    data: serde_json::Value,
    #[serde(default)]
    changes: Vec<String>,
}

/// Events of a spacecraft that change coefficients, from the text of a file. `steps` are kinds with the effects that
/// they change.
///
/// # Errors
/// [`WorkflowError::Events`]: the text is no list of events, or a time in it is none.
pub(super) fn parse(
    text: &str,
    path: &Path,
    spacecraft: &str,
    steps: &[(String, String)],
) -> Result<Vec<Event>, WorkflowError> {
    let refuse = |what: String| WorkflowError::Events { path: path.to_owned(), what };
    let entries: Vec<Entry> = serde_yaml_ng::from_str(text).map_err(|e| refuse(e.to_string()))?;
    let mut events = Vec::new();
    for (number, entry) in entries.into_iter().enumerate() {
        let by_kind = steps.iter().filter(|(kind, _)| *kind == entry.soe_event).map(|(_, effect)| effect.clone());
        let effects = if entry.changes.is_empty() { by_kind.collect() } else { entry.changes };
        let elsewhere = !entry.spacecraft.is_empty() && entry.spacecraft != spacecraft;
        if effects.is_empty() || elsewhere || is_no_change(&entry.data) {
            continue;
        }
        let (time_ns, time_scale) = time(&entry.time).ok_or_else(|| {
            let line = line_of(text, number).map_or_else(String::new, |line| format!("at line {line}, "));
            refuse(format!("{line}the time {:?} of an event is not of the form 2035-01-31 12:00:00 UTC", entry.time))
        })?;
        let data = entry.data.as_object().cloned().unwrap_or_default();
        let Entry { soe_event: kind, time, comments, .. } = entry;
        events.push(Event { kind, time, time_ns, time_scale, comments, data, effects });
    }
    events.sort_by_key(|event| event.time_ns);
    Ok(events)
}

/// Line at which an entry of a list begins, from 1 on; none where the list is written in brackets.
fn line_of(text: &str, number: usize) -> Option<usize> {
    let dash = |line: &str| line.trim_start().starts_with('-').then(|| line.len() - line.trim_start().len());
    let indent = text.lines().filter(|line| !line.starts_with("---")).find_map(dash)?;
    let begins = |(_, line): &(usize, &str)| !line.starts_with("---") && dash(line) == Some(indent);
    text.lines().enumerate().filter(begins).nth(number).map(|(at, _)| at + 1)
}

/// JPL's log begins with entries of zeros, which say where things stood at first.
fn is_no_change(data: &serde_json::Value) -> bool {
    data.as_object().is_some_and(|data| !data.is_empty() && data.values().all(|v| v.as_f64() == Some(0.0)))
}

/// Unix ns and time scale of `2035-01-31 12:00:00 UTC`.
fn time(text: &str) -> Option<(i64, String)> {
    let (date, scale) = match text.trim().trim_end_matches('Z').rsplit_once(' ') {
        Some((date, scale)) if ["UTC", "TAI", "GPS"].contains(&scale) => (date, scale),
        _ => (text.trim().trim_end_matches('Z'), "UTC"),
    };
    let forms = ["%Y-%m-%d %H:%M:%S%.f", "%Y-%m-%dT%H:%M:%S%.f"];
    let time = forms.iter().find_map(|form| NaiveDateTime::parse_from_str(date, form).ok())?;
    Some((time.and_utc().timestamp_nanos_opt()?, scale.to_owned()))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The first entries and a mass trim of JPL's log of GRACE-C, and an entry of ours.
    const LOG: &str = "\
- soe_event: MTEB
  time: 2000-01-01 12:00:00 GPS
  gps_time: 0.0
  created: ''
  comments: Initial default
  spacecraft: C
  meta: 3 0.0 0.0 0.0
  data:
    X_trim: 0.0
    Y_trim: 0.0
    Z_trim: 0.0
- spacecraft_event: comment
  time: '2018-05-23 00:00:00'
  data: \"Missing data in the beginning of the arc\"
  spacecraft: C
- soe_event: MTEA
  time: 2018-07-18 06:00:00 GPS
  spacecraft: C
  data:
    X_trim: 0.0
    Y_trim: 5.15e-05
- soe_event: MTEA
  time: 2018-07-19 06:00:00 GPS
  spacecraft: D
  data: {Y_trim: 5.15e-05}
- soe_event: repair
  time: 2018-07-20T06:00:00.5Z
  changes: [com-offset, es-gain.tm1.y]
";

    fn read_text(text: &str) -> Result<Vec<Event>, WorkflowError> {
        parse(text, Path::new("events.yaml"), "C", &[("MTEA".to_owned(), "com-offset".to_owned())])
    }

    #[test]
    fn a_log_in_the_form_of_jpl_is_read() {
        let events = read_text(LOG).expect("a log");
        let [trim, repair] = &events[..] else { panic!("two events: {events:?}") };
        // 2018-07-18 is day 17730 of Unix time.
        assert_eq!((trim.time_ns, trim.time_scale.as_str()), ((17730 * 86_400 + 6 * 3600) * 1_000_000_000, "GPS"));
        assert_eq!((trim.data["Y_trim"].as_f64(), &trim.effects[..]), (Some(5.15e-5), &["com-offset".to_owned()][..]));
        assert_eq!((repair.time_ns % 1_000_000_000, repair.time_scale.as_str()), (500_000_000, "UTC"));
        assert_eq!(repair.effects, ["com-offset", "es-gain.tm1.y"]);
        assert!(repair.changes("com-offset.tm2.x") && repair.changes("es-gain.tm1.y"));
        assert!(!repair.changes("com-offsets.tm2.x") && !repair.changes("es-gain.tm1.z"));
    }

    #[test]
    fn a_time_that_is_none_is_refused_with_its_text() {
        let said = read_text(&LOG.replace("2018-07-18 06:00:00 GPS", "18 July")).expect_err("refused").to_string();
        assert!(said.contains("events.yaml: at line 16, the time \"18 July\""), "{said}");
        let said = read_text(&LOG.replace("changes: [com-offset, es-gain.tm1.y]", "changes: com-offset"));
        let said = said.expect_err("no list").to_string();
        assert!(said.contains("changes") && said.contains("line 28"), "{said}");
        assert!(read_text("- [").is_err());
        let said = read_text("[{soe_event: MTEA, time: never}]").expect_err("refused").to_string();
        assert!(said.contains("events.yaml: the time \"never\""), "{said}");
    }
}
