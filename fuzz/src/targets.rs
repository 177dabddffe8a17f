//! The readers, and what each of them must never do: panic, hang, or take more than its budget.

use dragfree_engine::border::{Kind, Linked, read_answer};
use dragfree_engine::config::{Mission, Model, Pipeline};
use dragfree_engine::replay::Replay;
use dragfree_engine::schema::{Coefficient, Constraint, NoiseProcess, NoiseShape};
use dragfree_engine::table::{Column, TableSpec};
use dragfree_engine::telemetry::{Cells, Decoder, Layout, check, descriptor, expected};
use serde_json::json;
use std::io;
use std::path::{Path, PathBuf};

/// Topics of the interface.
const TOPICS: [&str; 6] = ["/is", "/ifo", "/dws", "/command", "/ephemeris", "/hk/x"];

/// A reader.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Target {
    /// A telemetry file, from its first byte to the rows and digests.
    Telemetry,
    /// A message of the interface.
    Message,
    /// A schema in a telemetry file, and a message by it.
    Schema,
    /// A mission file, by the engine and by the plugins.
    Mission,
    /// A model file.
    Model,
    /// A pipeline file.
    Pipeline,
    /// A product.
    Product,
    /// An answer of the process of a plugin that is not trusted.
    Answer,
}

impl Target {
    /// All of them.
    pub const ALL: [Self; 8] = {
        use Target::*;
        [Telemetry, Message, Schema, Mission, Model, Pipeline, Product, Answer]
    };

    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Telemetry => "telemetry",
            Self::Message => "message",
            Self::Schema => "schema",
            Self::Mission => "mission",
            Self::Model => "model",
            Self::Pipeline => "pipeline",
            Self::Product => "product",
            Self::Answer => "answer",
        }
    }

    /// The reader of a name.
    pub fn named(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|target| target.name() == name)
    }

    /// Sound inputs: the fixtures of the repository and `fuzz/corpus`.
    ///
    /// # Errors
    /// They cannot be read.
    pub fn corpus(self) -> io::Result<Vec<Vec<u8>>> {
        let root = Path::new(env!("CARGO_MANIFEST_DIR"));
        let folder = match self {
            Self::Message => return Ok(messages()),
            Self::Answer => return Ok(answers()),
            Self::Schema => return Ok(TOPICS.iter().filter_map(|t| Some(descriptor(t)?.1.to_vec())).collect()),
            Self::Telemetry => root.join("corpus/telemetry"),
            Self::Product => root.join("corpus/product"),
            Self::Mission => root.join("../fixtures/missions"),
            Self::Model => root.join("../fixtures/models"),
            Self::Pipeline => root.join("../fixtures/pipelines"),
        };
        let mut paths: Vec<PathBuf> = std::fs::read_dir(folder)?.flatten().map(|entry| entry.path()).collect();
        paths.sort();
        paths.iter().map(std::fs::read).collect()
    }

    /// Reads an input. What it refuses it refuses; `scratch` is a file of the caller's for readers of files.
    ///
    /// # Errors
    /// The scratch file cannot be written.
    pub fn read(self, bytes: &[u8], scratch: &Path) -> io::Result<()> {
        let name = Path::new("input.toml");
        let text = || String::from_utf8_lossy(bytes);
        match self {
            Self::Telemetry => {
                std::fs::write(scratch, bytes)?;
                replay(scratch);
            }
            Self::Message => {
                for layout in TOPICS.into_iter().filter_map(expected) {
                    decode(layout, bytes);
                }
            }
            Self::Schema => {
                if let Ok(layout) = Layout::parse(bytes, "dragfree.telemetry.v1.Dws") {
                    let _ = check("/dws", &layout); // either answer will do
                    decode(&layout, bytes);
                }
            }
            Self::Mission => {
                if let Ok(mission) = Mission::parse(name, &text()) {
                    // As plugins read it.
                    let _ = dragfree_physics::mission::Mission::from_json(&mission.value.to_string());
                }
            }
            Self::Model => drop(Model::parse(name, &text())),
            Self::Pipeline => drop(Pipeline::parse(name, &text())),
            Self::Answer => {
                for kind in Kind::ALL {
                    let _ = read_answer(bytes, &[column("grid", "x")], kind); // either answer will do
                }
            }
            Self::Product => {
                std::fs::write(scratch, bytes)?;
                drop(dragfree_archive::product::read(scratch));
            }
        }
        Ok(())
    }
}

fn column(table: &str, name: &str) -> Column {
    let attributes = [("kind".to_owned(), "channel".to_owned())].into();
    let (table, name) = (table.to_owned(), name.to_owned());
    Column { table, name, unit: "m".to_owned(), frame: "ORF_1".to_owned(), rate_hz: 10.0, attributes }
}

/// Answers to every kind of question, as a process would send them.
fn answers() -> Vec<Vec<u8>> {
    let written = vec![column("own", "a"), column("own", "b")];
    let linked = Linked {
        writes: vec![TableSpec { name: "own".to_owned(), rate_hz: 10.0, columns: written, truth: false }],
        coefficients: vec![Coefficient { name: "own.tm1.x".to_owned(), ..Coefficient::default() }],
        constraints: vec![Constraint {
            name: "survey".to_owned(),
            kind: "survey".to_owned(),
            terms: vec![("own.tm1.x".to_owned(), 1.0)],
            lower: -1.0,
            upper: 1.0,
            unit: "m".to_owned(),
            parts: 1,
        }],
        noise: vec![NoiseProcess {
            name: "n".to_owned(),
            spectrum: Some(NoiseShape::white(1e-12)),
            enters: [("a".to_owned(), vec![1.0])].into(),
            ..NoiseProcess::default()
        }],
        ..Linked::default()
    };
    let texts = [
        json!("Done"),
        json!("Discarded"),
        json!({ "Bytes": true }),
        json!({ "Log": { "level": 2, "text": "it works" } }),
        json!({ "Rows": { "rows": [10, 0, 3], "complete_until_ns": 7, "done": false } }),
        json!({ "Failed": { "kind": "Plugin", "message": "no column" } }),
        json!({ "Linked": linked }),
    ];
    let framed =
        |text: String| [&(text.len() as u64).to_le_bytes()[..], &0_u64.to_le_bytes(), text.as_bytes()].concat();
    texts.iter().map(|text| framed(text.to_string())).collect()
}

/// Messages as a producer would write them: fields of doubles in messages in messages, and a status.
fn messages() -> Vec<Vec<u8>> {
    let double = |field: u8, value: f64| [&[field << 3 | 1][..], &value.to_le_bytes()].concat();
    let inner = |field: u8, bytes: &[u8]| [&[field << 3 | 2, bytes.len() as u8][..], bytes].concat();
    let vector = [double(1, 1e-9), double(2, -2e-9), double(3, 3e-9)].concat();
    let body = [inner(1, &vector), inner(2, &vector), vec![0x20, 1]].concat();
    vec![vector.clone(), inner(1, &body), [inner(1, &body), inner(2, &body), vec![0x20, 3]].concat()]
}

fn decode(layout: &Layout, bytes: &[u8]) {
    let mut values = vec![f64::NAN; layout.leaves().len()];
    let mut cells = Cells { values: &mut values, rows: 1, row: 0 };
    let _ = Decoder::new(layout).decode(bytes, &mut cells); // either answer will do
}

fn replay(file: &Path) {
    let Ok(mut replay) = Replay::open(&[file.to_owned()], None, 1) else { return };
    while let Ok(Some(_)) = replay.next() {}
    let _ = replay.digests(); // either answer will do
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Otherwise every damaged one would be refused for the same reason.
    #[test]
    fn answers_of_the_corpus_are_accepted() {
        for answer in answers() {
            let read = read_answer(&answer, &[column("grid", "x")], Kind::Effect);
            assert_eq!(read, Ok(()), "{}", String::from_utf8_lossy(&answer));
        }
    }
}
