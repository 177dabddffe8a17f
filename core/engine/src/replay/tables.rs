//! Tables of a replay: the union of what its files hold, and the way of each channel into them.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::Arc;

use super::ReplayError;
use super::losses::{Finding, Losses};
use super::scan::Scan;
use crate::input::InputFile;
use crate::limits::{COLUMNS, TABLES};
use crate::table::TableSpec;
use crate::telemetry::{self, Decoder, Layout};

/// Where the messages of a channel go.
#[derive(Clone, Debug)]
pub(super) enum Route {
    /// Into a table.
    Table { table: usize, decoder: Decoder },
    /// Nowhere, but counted.
    Nowhere { finding: Finding, topic: String },
}

/// Ways of the channels of one file, by channel id.
pub(super) type Routes = BTreeMap<u16, Route>;

/// Order of the tables: as in `telemetry.proto`, housekeeping last.
const ORDER: [&str; 5] = ["is", "ifo", "dws", "command", "ephemeris"];

/// One channel that feeds a table.
struct Feed {
    file: usize,
    channel: u16,
    layout: Layout,
}

/// The tables of `files`, in the order of the interface, and the routes of each file.
pub(super) fn link(
    files: &[(Arc<InputFile>, Scan)],
    losses: &mut Losses,
) -> Result<(Vec<TableSpec>, Vec<Routes>), ReplayError> {
    let mut routes = vec![Routes::new(); files.len()];
    let mut feeds: BTreeMap<(usize, String), (Vec<Feed>, TableSpec)> = BTreeMap::new();
    for (at, (input, scan)) in files.iter().enumerate() {
        let path = input.path();
        for (&id, channel) in &scan.definitions.channels {
            let finding = match channel.topic.as_str() {
                telemetry::TRUTH => Some(Finding::TruthMessages),
                topic if telemetry::expected(topic).is_none() => Some(Finding::MessagesOfUnknownTopics),
                _ => None,
            };
            if let Some(finding) = finding {
                routes[at].insert(id, Route::Nowhere { finding, topic: channel.topic.clone() });
                continue;
            }
            let name = channel.topic.trim_start_matches('/').to_owned();
            let rank = ORDER.iter().position(|n| *n == name).unwrap_or(ORDER.len());
            let place = (rank, name.clone());
            if feeds.len() >= TABLES && !feeds.contains_key(&place) {
                let what = format!("more than {TABLES} topics of telemetry");
                return Err(ReplayError::TooManyColumns { path: path.to_owned(), what });
            }
            let layout = layout(path, scan, id)?;
            for field in layout.ignored() {
                losses.add(Finding::IgnoredFields, 1, &format!("{}.{field}", channel.topic), || {
                    format!(
                        "{}: field {field} of {} is no scalar of 32 bits or a double; it is not read",
                        super::name_of(path),
                        channel.topic
                    )
                });
            }
            let (feeds, table) = feeds.entry(place).or_insert_with(|| {
                (vec![], TableSpec { name: name.clone(), rate_hz: 0.0, columns: vec![], truth: false })
            });
            let housekeeping = name.starts_with("hk/").then_some(&channel.metadata);
            extend(table, &channel.topic, &layout, housekeeping, path, losses)?;
            let columns = table.columns.len();
            feeds.push(Feed { file: at, channel: id, layout });
            if columns > COLUMNS {
                let what = format!("topic {} has {columns} columns, where {COLUMNS} are the most", channel.topic);
                return Err(ReplayError::TooManyColumns { path: path.to_owned(), what });
            }
        }
    }
    let mut tables = Vec::with_capacity(feeds.len());
    for (feeds, table) in feeds.into_values() {
        // A stage that finds a table relies on it: an empty one is as good as a missing topic, and better told as one.
        if !feeds.iter().any(|f| files[f.file].1.used.contains(&f.channel)) {
            losses.add(Finding::TopicsWithoutMessages, 1, &table.name, || {
                format!("topic /{} has no messages; it counts as missing", table.name)
            });
            continue;
        }
        for Feed { file, channel, mut layout } in feeds {
            let columns: Vec<usize> = layout
                .leaves()
                .iter()
                .map(|leaf| table.columns.iter().position(|c| c.name == leaf.path).unwrap_or_default())
                .collect();
            layout.redirect(&columns);
            if table.name == "command" {
                layout.absent_numbers_are_zero();
            }
            routes[file].insert(channel, Route::Table { table: tables.len(), decoder: Decoder::new(&layout) });
        }
        tables.push(table);
    }
    Ok((tables, routes))
}

/// The compiled schema of a channel of the interface, found sound.
fn layout(path: &Path, scan: &Scan, channel: u16) -> Result<Layout, ReplayError> {
    let channel = &scan.definitions.channels[&channel];
    let (path, topic) = (path.to_owned(), channel.topic.clone());
    let schema = match scan.definitions.schemas.get(&channel.schema_id) {
        Some(schema) if schema.encoding == "protobuf" && channel.encoding == "protobuf" => schema,
        schema => {
            let found = schema.map_or("no schema", |s| s.encoding.as_str());
            let encoding = format!("messages {:?} with schema {found:?}", channel.encoding);
            return Err(ReplayError::Encoding { path, topic, encoding });
        }
    };
    let layout = Layout::parse(&schema.data, &schema.name).map_err(|source| ReplayError::Schema {
        path: path.clone(),
        topic: topic.clone(),
        source,
    })?;
    telemetry::check(&topic, &layout).map_err(|source| ReplayError::Drift { path, topic, source })?;
    Ok(layout)
}

/// Adds the columns that `table` has not yet: those of the interface first, in its order, then what a producer added.
fn extend(
    table: &mut TableSpec,
    topic: &str,
    layout: &Layout,
    housekeeping: Option<&BTreeMap<String, String>>,
    path: &Path,
    losses: &mut Losses,
) -> Result<(), ReplayError> {
    let due = telemetry::expected(topic).into_iter().flat_map(Layout::leaves);
    let mut have: BTreeSet<String> = table.columns.iter().map(|c| c.name.clone()).collect();
    let first = table.columns.is_empty();
    for leaf in due.chain(layout.leaves()) {
        if have.insert(leaf.path.clone()) {
            table.columns.push(telemetry::column(&table.name, &leaf.path));
        }
    }
    let (Some(metadata), Some(value)) = (housekeeping, table.columns.first_mut()) else { return Ok(()) };
    let unit = metadata.get("unit").filter(|u| !u.is_empty()).cloned().unwrap_or_else(|| {
        losses.add(Finding::MissingUnits, 1, topic, || {
            format!("{}: channel {topic} does not state its unit; it is read as a number (1)", super::name_of(path))
        });
        "1".to_owned()
    });
    if first {
        value.unit = unit;
        for key in ["place", "rate_hz"] {
            if let Some(text) = metadata.get(key) {
                value.attributes.insert(key.to_owned(), text.clone());
            }
        }
    } else if value.unit != unit {
        return Err(ReplayError::MixedUnits {
            path: path.to_owned(),
            topic: topic.to_owned(),
            found: unit,
            before: value.unit.clone(),
        });
    }
    Ok(())
}
