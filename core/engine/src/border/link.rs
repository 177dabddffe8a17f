//! What an instance declares when it is linked: columns that it reads and writes, coefficients, constraints, noise.

use dragfree_abi as abi;
use dragfree_schema::{Coefficient, Constraint, NOISE_ATTRIBUTE, NoiseProcess};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::ffi::{CString, c_char, c_void};

use super::library::Kind;
use super::read;
use super::text::text_of;
use crate::limits::{COLUMNS, DECLARATIONS, NAME_BYTES, TEXT_BYTES};
use crate::table::{Column, TableSpec};

/// A column that an instance reads: its index among the available ones.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ReadColumn {
    /// Index into [`available`](super::LinkRequest::available).
    pub available: usize,
}

/// What an instance declared when it was linked.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Linked {
    /// Per input table, in slot order: the columns read.
    pub reads: Vec<Vec<ReadColumn>>,
    /// Tables written, in order.
    pub writes: Vec<TableSpec>,
    /// Coefficients that it announced.
    pub coefficients: Vec<Coefficient>,
    /// Constraints that it announced.
    pub constraints: Vec<Constraint>,
    /// Noise processes that it declared.
    pub noise: Vec<NoiseProcess>,
}

/// The declarations while `link` runs.
pub(super) struct LinkContext<'a> {
    available: &'a [Column],
    pub(super) linked: Linked,
    tables: Vec<String>,
    kind: Kind,
    pub(super) refused: Option<String>,
}

impl<'a> LinkContext<'a> {
    pub(super) fn new(available: &'a [Column], kind: Kind) -> Self {
        Self { available, linked: Linked::default(), tables: Vec::new(), kind, refused: None }
    }

    fn refuse(&mut self, sentence: String) -> abi::Status {
        self.refused.get_or_insert(sentence);
        abi::ERROR
    }

    fn read(&mut self, want: &WantedColumn) -> Result<abi::SlotV1, String> {
        let column = self.find(want)?;
        let have = &self.available[column];
        let mismatch = |what: &str, wanted: &str, is: &str| {
            Err(format!(
                "wants column {}:{} with {what} `{wanted}`, but it is made with {what} `{is}`; correct the one that is wrong",
                have.table, have.name
            ))
        };
        if let Some(unit) = want.unit.as_deref().filter(|u| *u != have.unit) {
            return mismatch("unit", unit, &have.unit);
        }
        if let Some(frame) = want.frame.as_deref().filter(|f| *f != have.frame) {
            return mismatch("frame", frame, &have.frame);
        }
        if want.rate_hz != 0.0 && want.rate_hz != have.rate_hz {
            return mismatch("rate in Hz", &want.rate_hz.to_string(), &have.rate_hz.to_string());
        }
        let table = self.tables.iter().position(|t| *t == have.table).unwrap_or_else(|| {
            self.tables.push(have.table.clone());
            self.linked.reads.push(Vec::new());
            self.tables.len() - 1
        });
        let columns = &mut self.linked.reads[table];
        let read = ReadColumn { available: column };
        let position = columns.iter().position(|c| *c == read).unwrap_or_else(|| {
            columns.push(read);
            columns.len() - 1
        });
        let index = |i: usize| u32::try_from(i).map_err(|e| e.to_string());
        Ok(abi::SlotV1 { table: index(table)?, column: index(position)? })
    }

    fn find(&self, want: &WantedColumn) -> Result<usize, String> {
        let fits = |c: &Column| c.name == want.name && want.table.as_ref().is_none_or(|t| *t == c.table);
        // Raw telemetry has the names that preprocessed columns keep: without a table, the grid is meant.
        let uniform = self.available.iter().any(|c| fits(c) && c.rate_hz > 0.0);
        let mut found = self
            .available
            .iter()
            .enumerate()
            .filter(|(_, c)| fits(c) && (!uniform || c.rate_hz > 0.0 || want.table.is_some()));
        let shown = want.table.as_ref().map_or_else(|| want.name.clone(), |t| format!("{t}:{}", want.name));
        match (found.next(), found.next()) {
            (Some((index, _)), None) => Ok(index),
            (Some((_, a)), Some((_, b))) => Err(format!(
                "wants column {shown}, which tables {} and {} both have; it must name the table",
                a.table, b.table
            )),
            (None, _) => {
                let mut near: Vec<_> = self
                    .available
                    .iter()
                    .map(|c| (distance(&c.name, &want.name), format!("{}:{}", c.table, c.name)))
                    .collect();
                near.sort();
                let near: Vec<_> = near.into_iter().take(3).map(|(_, name)| name).collect();
                let near = if near.is_empty() {
                    "there are no columns yet".to_owned()
                } else {
                    format!("nearest: {}", near.join(", "))
                };
                Err(format!(
                    "wants column {shown}, which no file and no stage before it makes ({near}); add the topic or the stage that makes it"
                ))
            }
        }
    }

    fn write(&mut self, column: Column) -> Result<(), String> {
        if column.table.is_empty() || column.name.is_empty() {
            return Err("writes a column without a table or a name".to_owned());
        }
        if self.linked.writes.iter().map(|t| t.columns.len()).sum::<usize>() >= COLUMNS {
            return Err(format!("writes more than {COLUMNS} columns"));
        }
        let taken = |c: &Column| c.table == column.table && c.name == column.name;
        if self.available.iter().any(taken) || self.linked.writes.iter().flat_map(|t| &t.columns).any(taken) {
            return Err(format!("writes column {}:{}, which exists already", column.table, column.name));
        }
        if !(column.rate_hz.is_finite() && column.rate_hz >= 0.0) {
            return Err(format!("writes column {}:{} at a rate of {} Hz", column.table, column.name, column.rate_hz));
        }
        match column.attributes.get("archive").map(String::as_str) {
            None | Some("true" | "end") => {}
            Some("mean") if column.rate_hz > 0.0 => {}
            Some(other) => {
                let (table, name, rate_hz) = (&column.table, &column.name, column.rate_hz);
                return Err(format!(
                    "writes column {table}:{name} at {rate_hz} Hz with archive = {other:?}; there is `true`, `end`, and for tables with a rate `mean`"
                ));
            }
        }
        if let Some(table) = self.linked.writes.iter_mut().find(|t| t.name == column.table) {
            if table.rate_hz != column.rate_hz {
                return Err(format!(
                    "writes table {} at {} Hz and at {} Hz",
                    table.name, table.rate_hz, column.rate_hz
                ));
            }
            table.columns.push(column);
        } else {
            if self.available.iter().any(|c| c.table == column.table) {
                return Err(format!("writes table {}, which exists already", column.table));
            }
            let truth = self.kind == Kind::Source && column.table == "truth";
            let (name, rate_hz) = (column.table.clone(), column.rate_hz);
            self.linked.writes.push(TableSpec { name, rate_hz, columns: vec![column], truth });
        }
        Ok(())
    }
}

/// What another process says that an instance declared, checked again as if it had been declared here.
///
/// # Errors
/// A sentence: it is not what a plugin can declare.
pub(super) fn declared_again(claimed: Linked, available: &[Column], kind: Kind) -> Result<Linked, String> {
    let mut context = LinkContext::new(available, kind);
    for columns in &claimed.reads {
        let table = |read: &ReadColumn| available.get(read.available).map(|column| column.table.as_str());
        let first = columns.first().and_then(table).ok_or("reads a table without columns")?;
        if columns.iter().any(|read| table(read) != Some(first)) {
            return Err("reads columns of several tables as one".to_owned());
        }
        context.linked.reads.push(columns.clone());
    }
    claimed.writes.into_iter().flat_map(|table| table.columns).try_for_each(|column| context.write(column))?;
    if kind != Kind::Effect && !(claimed.coefficients.is_empty() && claimed.constraints.is_empty()) {
        return Err("announces a coefficient or a constraint, but is no effect".to_owned());
    }
    take(&mut context.linked.coefficients, claimed.coefficients, "coefficients")?;
    take(&mut context.linked.constraints, claimed.constraints, "constraints")?;
    take(&mut context.linked.noise, claimed.noise, "noise processes")?;
    Ok(context.linked)
}

/// The declared noise makes sense, and enters channels that exist.
pub(super) fn check_noise(linked: &Linked, available: &[Column]) -> Result<(), String> {
    for process in &linked.noise {
        process.check().map_err(|what| format!("declares the noise process `{}`: {what}", process.name))?;
        let known = |channel: &str| {
            let written = linked.writes.iter().flat_map(|t| &t.columns);
            let name = |c: &Column| c.attributes.get("channel").map_or(c.name.clone(), String::clone);
            available.iter().chain(written).any(|c| c.attribute("kind") == "channel" && name(c) == channel)
        };
        if let Some(channel) = process.channels().find(|channel| !known(channel)) {
            return Err(format!(
                "declares that the noise process `{}` enters `{channel}`, which is no channel; write it with the attribute kind = channel",
                process.name
            ));
        }
    }
    Ok(())
}

/// A coarse measure of how far two names are apart: what is left outside the common start and end.
fn distance(a: &str, b: &str) -> usize {
    let start = a.bytes().zip(b.bytes()).take_while(|(x, y)| x == y).count();
    let end = a.bytes().rev().zip(b.bytes().rev()).take_while(|(x, y)| x == y).count();
    (a.len().max(b.len())).saturating_sub(start + end)
}

struct WantedColumn {
    table: Option<String>,
    name: String,
    unit: Option<String>,
    frame: Option<String>,
    rate_hz: f64,
}

/// A column as a plugin describes it, with its attributes as text.
struct Described {
    table: Option<String>,
    name: Option<String>,
    unit: Option<String>,
    frame: Option<String>,
    rate_hz: f64,
    attributes: Option<String>,
}

/// # Safety
/// The texts of the column are null or NUL-terminated.
unsafe fn described(column: &abi::ColumnV1) -> Result<Described, String> {
    // SAFETY: by the caller.
    let text = |text: *const c_char, limit| unsafe { text_of(text, limit) };
    let name = |what| text(what, NAME_BYTES);
    Ok(Described {
        table: name(column.table)?,
        name: name(column.name)?,
        unit: name(column.unit)?,
        frame: name(column.frame)?,
        rate_hz: column.rate_hz,
        attributes: text(column.attributes, TEXT_BYTES)?,
    })
}

pub(super) unsafe extern "C" fn link_read(
    context: *mut c_void,
    wanted: *const abi::ColumnV1,
    slot: *mut abi::SlotV1,
) -> abi::Status {
    // SAFETY: as the header promises.
    unsafe {
        let (Some(context), Some(c)) = (context.cast::<LinkContext<'_>>().as_mut(), wanted.as_ref()) else {
            return abi::ERROR;
        };
        let Described { table, name, unit, frame, rate_hz, .. } = match described(c) {
            Ok(described) => described,
            Err(what) => return context.refuse(format!("wants a column with {what}")),
        };
        let Some(name) = name else { return context.refuse("wants a column without a name".to_owned()) };
        let want = WantedColumn { table, name, unit, frame, rate_hz };
        match (context.read(&want), slot.as_mut()) {
            (Ok(found), Some(slot)) => {
                *slot = found;
                abi::OK
            }
            (Ok(_), None) => context.refuse("gave no slot".to_owned()),
            (Err(sentence), _) => context.refuse(sentence),
        }
    }
}

pub(super) unsafe extern "C" fn link_write(context: *mut c_void, column: *const abi::ColumnV1) -> abi::Status {
    // SAFETY: as the header promises.
    unsafe {
        let (Some(context), Some(c)) = (context.cast::<LinkContext<'_>>().as_mut(), column.as_ref()) else {
            return abi::ERROR;
        };
        let result = described(c).map_err(|what| format!("writes a column with {what}")).and_then(|d| {
            let name = d.name.unwrap_or_default();
            let (attributes, noise) = attributes(&d.attributes.unwrap_or_default())
                .map_err(|what| format!("attributes of column {name}: {what}"))?;
            take(&mut context.linked.noise, noise, "noise processes")?;
            context.write(Column {
                table: d.table.unwrap_or_default(),
                name,
                unit: d.unit.unwrap_or_default(),
                frame: d.frame.unwrap_or_default(),
                rate_hz: d.rate_hz,
                attributes,
            })
        });
        result.map_or_else(|sentence| context.refuse(sentence), |()| abi::OK)
    }
}

/// Adds declarations, unless they become too many.
fn take<T>(list: &mut Vec<T>, more: impl IntoIterator<Item = T>, what: &str) -> Result<(), String> {
    list.extend(more);
    if list.len() > DECLARATIONS { Err(format!("declares more than {DECLARATIONS} {what}")) } else { Ok(()) }
}

/// The attributes of a written column, and the noise processes among them.
fn attributes(json: &str) -> Result<(BTreeMap<String, String>, Vec<NoiseProcess>), String> {
    if json.is_empty() {
        return Ok((BTreeMap::new(), Vec::new()));
    }
    let mut all: serde_json::Map<String, serde_json::Value> = serde_json::from_str(json).map_err(|e| e.to_string())?;
    let noise = all.remove(NOISE_ATTRIBUTE).map_or(Ok(Vec::new()), read::declaration);
    let noise = noise.map_err(|what| format!("{NOISE_ATTRIBUTE}: {what}"))?;
    Ok((read::declaration(all.into())?, noise))
}

/// # Safety
/// As the header promises for `coefficient` and `constraint`.
unsafe fn link_json<T: DeserializeOwned>(
    context: *mut c_void,
    json: *const c_char,
    what: &str,
    list: impl FnOnce(&mut Linked) -> &mut Vec<T>,
) -> abi::Status {
    // SAFETY: by the caller.
    unsafe {
        let Some(context) = context.cast::<LinkContext<'_>>().as_mut() else { return abi::ERROR };
        if context.kind != Kind::Effect {
            return context.refuse(format!("announces a {what}, but is no effect"));
        }
        let text = text_of(json, TEXT_BYTES).map(Option::unwrap_or_default);
        let document = text.and_then(|text| serde_json::from_str(&text).map_err(|e| e.to_string()));
        let declared = document.and_then(read::declaration);
        let taken = declared.map_err(|why| format!("announces a {what} that cannot be read: {why}"));
        let taken = taken.and_then(|declared| take(list(&mut context.linked), [declared], what));
        taken.map_or_else(|sentence| context.refuse(sentence), |()| abi::OK)
    }
}

pub(super) unsafe extern "C" fn link_coefficient(context: *mut c_void, json: *const c_char) -> abi::Status {
    // SAFETY: as the header promises.
    unsafe { link_json(context, json, "coefficient", |linked| &mut linked.coefficients) }
}

pub(super) unsafe extern "C" fn link_constraint(context: *mut c_void, json: *const c_char) -> abi::Status {
    // SAFETY: as the header promises.
    unsafe { link_json(context, json, "constraint", |linked| &mut linked.constraints) }
}

/// A column as C strings.
pub(super) struct CColumn {
    table: CString,
    name: CString,
    unit: CString,
    frame: CString,
    attributes: CString,
    rate_hz: f64,
}

impl CColumn {
    pub(super) fn new(column: &Column) -> Self {
        // Names come from files and plugins: a NUL cannot be in a C string, and no column has one that matters.
        let c = |s: &str| CString::new(s.replace('\0', "?")).unwrap_or_default();
        let attributes = serde_json::to_string(&column.attributes).unwrap_or_default();
        Self {
            table: c(&column.table),
            name: c(&column.name),
            unit: c(&column.unit),
            frame: c(&column.frame),
            attributes: c(&attributes),
            rate_hz: column.rate_hz,
        }
    }

    pub(super) fn raw(&self) -> abi::ColumnV1 {
        abi::ColumnV1 {
            table: self.table.as_ptr(),
            name: self.name.as_ptr(),
            unit: self.unit.as_ptr(),
            frame: self.frame.as_ptr(),
            rate_hz: self.rate_hz,
            attributes: self.attributes.as_ptr(),
        }
    }
}
