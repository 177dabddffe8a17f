//! The committed interface, `fixtures/proto/telemetry.proto`, and the comparison of a file's schema with it.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::LazyLock;

use super::layout::{Layout, Leaf};
use super::names::unit_and_frame;
use crate::table::{Column, TableSpec};

/// `telemetry.proto` as a serialised FileDescriptorSet; a test compiles the text again and compares the bytes.
const DESCRIPTOR: &[u8] = include_bytes!("telemetry.binpb");

/// The truth of a simulation, which no calibration may read.
pub(crate) const TRUTH: &str = "/truth";

/// Topics of the interface and their messages. Housekeeping topics share one message, under the name `/hk/`.
const MESSAGES: [(&str, &str); 7] = [
    ("/is", "dragfree.telemetry.v1.InertialSensors"),
    ("/ifo", "dragfree.telemetry.v1.Interferometers"),
    ("/dws", "dragfree.telemetry.v1.Dws"),
    ("/command", "dragfree.telemetry.v1.Command"),
    ("/ephemeris", "dragfree.telemetry.v1.Ephemeris"),
    ("/hk/", "dragfree.telemetry.v1.Scalar"),
    (TRUTH, "dragfree.telemetry.v1.Truth"),
];

/// Topic, message and its layout.
type Entry = (&'static str, &'static str, Layout);

static INTERFACE: LazyLock<Vec<Entry>> = LazyLock::new(|| {
    let layout = |message| Layout::parse(DESCRIPTOR, message).expect("the committed descriptor defines every message");
    MESSAGES.iter().map(|&(topic, message)| (topic, message, layout(message))).collect()
});

fn entry(topic: &str) -> Option<&'static Entry> {
    let key = match topic.strip_prefix("/hk/") {
        Some("") => return None,
        Some(_) => "/hk/",
        None => topic,
    };
    INTERFACE.iter().find(|(name, ..)| *name == key)
}

/// The message of a topic as the committed interface has it.
pub fn expected(topic: &str) -> Option<&'static Layout> {
    entry(topic).map(|(.., layout)| layout)
}

/// Name of the message of a topic and the descriptor set that defines it, for a writer.
pub fn descriptor(topic: &str) -> Option<(&'static str, &'static [u8])> {
    entry(topic).map(|(_, message, _)| (*message, DESCRIPTOR))
}

/// The tables of a spacecraft that sends everything in the interface, without its housekeeping.
pub fn interface_tables() -> Vec<TableSpec> {
    let sent = INTERFACE.iter().filter(|(topic, ..)| !matches!(*topic, TRUTH | "/hk/"));
    sent.map(|(topic, _, layout)| table(topic.trim_start_matches('/'), layout)).collect()
}

/// A table with the columns of `layout`.
fn table(name: &str, layout: &Layout) -> TableSpec {
    let columns = layout.leaves().iter().map(|leaf| column(name, &leaf.path)).collect();
    TableSpec { name: name.to_owned(), rate_hz: 0.0, columns, truth: false }
}

/// A column of an irregular table, its unit and frame from its name.
pub(crate) fn column(table: &str, path: &str) -> Column {
    let (unit, frame) = unit_and_frame(path);
    Column { table: table.to_owned(), name: path.to_owned(), unit, frame, rate_hz: 0.0, attributes: BTreeMap::new() }
}

/// A schema that is not what the interface says.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[allow(missing_docs, reason = "every field is named in its sentence")]
pub enum Drift {
    /// Fields are missing; those that came in their place may be the same in another unit or frame.
    #[error("its schema lacks {}{}; a name carries unit and frame, so another name is another quantity",
        missing.join(", "), if instead.is_empty() { String::new() } else { format!(" and has {} instead", instead.join(", ")) })]
    Missing { missing: Vec<String>, instead: Vec<String> },
    /// A field has another type.
    #[error("its field {path} is of type {found}, where telemetry.proto has {expected}")]
    Type { path: String, found: String, expected: String },
}

/// Compares the layout of `topic` in a file with the interface: every field must be there, by name and type; more
/// fields are welcome, and a topic that is not in the interface has nothing to agree with.
///
/// # Errors
/// [`Drift`], the first kind found.
pub fn check(topic: &str, layout: &Layout) -> Result<(), Drift> {
    let Some(expected) = expected(topic) else { return Ok(()) };
    let paths = |leaves: &[Leaf]| leaves.iter().map(|l| l.path.clone()).collect::<BTreeSet<_>>();
    let (due, found) = (paths(expected.leaves()), paths(layout.leaves()));
    let missing: Vec<String> = due.difference(&found).cloned().collect();
    if !missing.is_empty() {
        return Err(Drift::Missing { missing, instead: found.difference(&due).cloned().collect() });
    }
    for leaf in expected.leaves() {
        if let Some(other) = layout.leaves().iter().find(|l| l.path == leaf.path && l.kind != leaf.kind) {
            return Err(Drift::Type {
                path: leaf.path.clone(),
                found: other.kind.to_string(),
                expected: leaf.kind.to_string(),
            });
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use prost::Message as _;

    fn compiled() -> Vec<u8> {
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../fixtures/proto");
        let set = protox::Compiler::new([folder])
            .and_then(|mut c| {
                c.include_imports(true).open_file("telemetry.proto")?;
                Ok(c.file_descriptor_set())
            })
            .expect("telemetry.proto compiles");
        set.encode_to_vec()
    }

    /// The committed descriptor is the committed text. `DRAGFREE_BLESS=1` writes it anew after a change of the text.
    #[test]
    fn the_descriptor_is_the_text() {
        let compiled = compiled();
        if std::env::var_os("DRAGFREE_BLESS").is_some() {
            let path = concat!(env!("CARGO_MANIFEST_DIR"), "/src/telemetry/telemetry.binpb");
            std::fs::write(path, &compiled).unwrap();
        } else {
            assert!(compiled == DESCRIPTOR, "telemetry.binpb is stale: run this test once with DRAGFREE_BLESS=1");
        }
    }

    #[test]
    fn topics() {
        assert_eq!(expected("/is").unwrap().leaves().len(), 14);
        assert_eq!(expected("/command").unwrap().leaves().len(), 18);
        assert_eq!(expected("/hk/battery_current_a").unwrap().leaves()[0].path, "value");
        assert!(expected("/hk/a").is_some() && expected("/hk/").is_none() && expected("/isx").is_none());
    }

    fn drifted(edit: impl Fn(&str) -> String, topic: &str, message: &str) -> Result<(), Drift> {
        let text = include_str!("../../../../fixtures/proto/telemetry.proto");
        let edited = edit(text);
        assert_ne!(edited, text, "the edit must change something");
        let file = protox_parse(&edited);
        let layout = Layout::parse(&file, message).unwrap();
        check(topic, &layout)
    }

    fn protox_parse(text: &str) -> Vec<u8> {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("t.proto"), text).unwrap();
        protox::compile(["t.proto"], [folder.path()]).unwrap().encode_to_vec()
    }

    #[test]
    fn drift_is_told_from_growth() {
        let dws = "dragfree.telemetry.v1.Dws";
        let renamed = drifted(|t| t.replace("theta_orf_rad", "theta_orf_mrad"), "/dws", dws);
        assert_eq!(
            renamed,
            Err(Drift::Missing {
                missing: vec!["tm1.theta_orf_rad".into(), "tm2.theta_orf_rad".into()],
                instead: vec!["tm1.theta_orf_mrad".into(), "tm2.theta_orf_mrad".into()],
            })
        );
        let retyped = drifted(|t| t.replace("double theta_orf_rad", "float theta_orf_rad"), "/dws", dws);
        assert!(matches!(retyped, Err(Drift::Type { path, .. }) if path == "tm1.theta_orf_rad"));
        let grown =
            drifted(|t| t.replace("message Dws {", "message Dws { double t_k = 9; string s = 10;"), "/dws", dws);
        assert_eq!(grown, Ok(()));
        let renumbered = drifted(|t| t.replace("psi_orf_rad = 2", "psi_orf_rad = 77"), "/dws", dws);
        assert_eq!(renumbered, Ok(()));
    }
}
