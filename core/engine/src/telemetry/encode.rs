//! Columns to wire bytes.

use std::collections::{BTreeMap, BTreeSet};

use prost::Message as _;
use prost_types::field_descriptor_proto::{Label, Type};
use prost_types::{DescriptorProto, FieldDescriptorProto, FileDescriptorProto, FileDescriptorSet};

use super::interface;
use super::layout::{Kind, Layout, LayoutError, Slot};
use crate::table::{Batch, TableSpec};

/// Why a table cannot be written as messages.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[allow(missing_docs, reason = "every field is named in its sentence")]
pub enum EncodeError {
    /// A table of the interface has a column that its message has not.
    #[error(
        "table {table} has a column {column} that its message {message} in telemetry.proto does not have; rename the column or the table"
    )]
    UnknownColumn { table: String, column: String, message: String },
    /// A value of an integer field is no such integer.
    #[error("column {column} holds {value}, which is not a {kind}")]
    NotAnInteger { column: String, value: f64, kind: Kind },
    /// The generated schema is refused, as it would be by a reader.
    #[error("table {table} makes no message: {source}")]
    Layout { table: String, source: LayoutError },
}

/// The message that a table becomes: its name, the schema that defines it and where each column lies in it.
#[derive(Clone, Debug)]
pub struct MessageType {
    /// Fully qualified name.
    pub name: String,
    /// Serialised FileDescriptorSet.
    pub descriptor_set: Vec<u8>,
    /// For a generated message, path of the field of each column; empty for a message of the interface.
    pub paths: Vec<String>,
    layout: Layout,
    /// Column of each leaf of the layout.
    columns: Vec<Option<usize>>,
}

impl MessageType {
    /// The message of `table`: of the interface where the topic is there, or else one generated from the columns, with
    /// a nested message for every dot of a name and a double for every column.
    ///
    /// # Errors
    /// [`EncodeError`] when a table of the interface has a foreign column or a generated schema is too large.
    pub fn of(table: &TableSpec) -> Result<Self, EncodeError> {
        let topic = format!("/{}", table.name);
        match (interface::expected(&topic), interface::descriptor(&topic)) {
            (Some(layout), Some((name, set))) => Self::of_interface(table, layout, name, set),
            _ => Self::generated(table),
        }
    }

    fn of_interface(table: &TableSpec, layout: &Layout, name: &str, set: &[u8]) -> Result<Self, EncodeError> {
        let position = |path: &str| table.columns.iter().position(|c| c.name == path);
        if let Some(column) = table.columns.iter().find(|c| layout.leaves().iter().all(|l| l.path != c.name)) {
            return Err(EncodeError::UnknownColumn {
                table: table.name.clone(),
                column: column.name.clone(),
                message: name.to_owned(),
            });
        }
        Ok(Self {
            name: name.to_owned(),
            descriptor_set: set.to_vec(),
            paths: vec![],
            columns: layout.leaves().iter().map(|l| position(&l.path)).collect(),
            layout: layout.clone(),
        })
    }

    fn generated(table: &TableSpec) -> Result<Self, EncodeError> {
        let mut root = Tree::default();
        let mut taken = BTreeSet::new();
        let paths: Vec<String> = table
            .columns
            .iter()
            .map(|column| {
                let path = free_path(&column.name, &mut taken);
                root.insert(&path);
                path
            })
            .collect();
        let message = identifier(&table.name, "Table");
        let set = FileDescriptorSet {
            file: vec![FileDescriptorProto {
                name: Some(format!("dragfree/product/{message}.proto")),
                package: Some("dragfree.product.v1".into()),
                syntax: Some("proto3".into()),
                message_type: vec![root.message(&message, &format!(".dragfree.product.v1.{message}"))],
                ..FileDescriptorProto::default()
            }],
        };
        let name = format!("dragfree.product.v1.{message}");
        let layout =
            Layout::compile(&set, &name).map_err(|source| EncodeError::Layout { table: table.name.clone(), source })?;
        let columns = layout.leaves().iter().map(|l| paths.iter().position(|p| *p == l.path)).collect();
        Ok(Self { name, descriptor_set: set.encode_to_vec(), paths, layout, columns })
    }
}

/// Encodes the rows of one table.
#[derive(Clone, Debug)]
pub struct Encoder {
    message: MessageType,
    last: Option<Pattern>,
}

/// A row's message but for its numbers: the next row mostly has its zeros, which are left out, in the same places.
#[derive(Clone, Debug, Default)]
struct Pattern {
    bytes: Vec<u8>,
    /// Column and place of each number.
    numbers: Vec<(usize, usize)>,
    /// Columns that are zero.
    zeros: Vec<usize>,
}

impl Encoder {
    /// An encoder of the table from which `message` was made.
    pub fn new(message: MessageType) -> Self {
        Self { message, last: None }
    }

    /// Appends one row to `out` as a message. A sub-message whose values are all NaN is left out, which is how it is
    /// read back; a field without a column is NaN, or 0 for an integer.
    ///
    /// # Errors
    /// [`EncodeError::NotAnInteger`].
    ///
    /// # Panics
    /// When `batch` has not the columns of the table or not the row.
    pub fn encode(&mut self, batch: &Batch, row: usize, out: &mut Vec<u8>) -> Result<(), EncodeError> {
        if self.last.as_ref().is_some_and(|pattern| pattern.encode(batch, row, out)) {
            return Ok(());
        }
        self.node(0, batch, row, out)?;
        let mut pattern = Pattern::default();
        self.last = self.lay_out(0, batch, row, &mut pattern).map(|_| pattern);
        Ok(())
    }

    /// Adds a row's pattern; returns whether a sub-message has a column. `None` for a row with NaN or with an integer
    /// other than 0.
    fn lay_out(&self, node: usize, batch: &Batch, row: usize, pattern: &mut Pattern) -> Option<bool> {
        let mut any = false;
        for field in &self.message.layout.nodes[node].fields {
            match field.slot {
                Slot::Scalar { kind, column: leaf } => {
                    let column = self.message.columns[leaf];
                    any |= column.is_some();
                    let value = column.map(|c| batch.columns[c][row]);
                    match (kind, column) {
                        _ if value.is_some_and(f64::is_nan) => return None,
                        (_, Some(c)) if batch.columns[c][row].to_bits() == 0 => pattern.zeros.push(c),
                        (Kind::Double, _) => {
                            put_double(field.number, f64::NAN, &mut pattern.bytes);
                            pattern.numbers.extend(column.map(|c| (c, pattern.bytes.len() - 8)));
                        }
                        (_, Some(_)) => return None,
                        (_, None) => {}
                    }
                }
                Slot::Message { node: child } => {
                    let (start, numbers) = (pattern.bytes.len(), pattern.numbers.len());
                    put_tag(field.number, 2, &mut pattern.bytes);
                    let body = pattern.bytes.len();
                    pattern.bytes.push(0);
                    if self.lay_out(child, batch, row, pattern)? {
                        any = true;
                        let shift = set_length(body, &mut pattern.bytes);
                        pattern.numbers[numbers..].iter_mut().for_each(|(_, place)| *place += shift);
                    } else {
                        pattern.bytes.truncate(start);
                    }
                }
            }
        }
        Some(any)
    }

    /// Returns whether there was anything but NaN.
    fn node(&self, node: usize, batch: &Batch, row: usize, out: &mut Vec<u8>) -> Result<bool, EncodeError> {
        let mut any = false;
        let mut unencodable = None;
        for field in &self.message.layout.nodes[node].fields {
            match field.slot {
                Slot::Scalar { kind, column: leaf } => {
                    let value = self.message.columns[leaf].map(|c| batch.columns[c][row]);
                    any |= value.is_some_and(|v| !v.is_nan());
                    match kind {
                        Kind::Double => put_double(field.number, value.unwrap_or(f64::NAN), out),
                        _ => {
                            if let Err(value) = put_uint32(field.number, kind, value.unwrap_or(0.0), out) {
                                unencodable = Some((leaf, kind, value));
                            }
                        }
                    }
                }
                Slot::Message { node: child } => {
                    let start = out.len();
                    put_tag(field.number, 2, out);
                    let body = out.len();
                    out.push(0);
                    if self.node(child, batch, row, out)? {
                        any = true;
                        set_length(body, out);
                    } else {
                        out.truncate(start);
                    }
                }
            }
        }
        match unencodable {
            // A NaN is the absence of its sub-message, if all of it is NaN.
            Some((leaf, kind, value)) if any || node == 0 || !value.is_nan() => {
                let column = self.message.layout.leaves()[leaf].path.clone();
                Err(EncodeError::NotAnInteger { column, value, kind })
            }
            _ => Ok(any),
        }
    }
}

impl Pattern {
    /// Appends a row of this pattern; false, and nothing done, when the row is another.
    fn encode(&self, batch: &Batch, row: usize, out: &mut Vec<u8>) -> bool {
        if self.zeros.iter().any(|c| batch.columns[*c][row].to_bits() != 0) {
            return false;
        }
        let start = out.len();
        out.extend_from_slice(&self.bytes);
        let message = &mut out[start..];
        let mut same = true;
        for (column, place) in &self.numbers {
            let value = batch.columns[*column][row];
            same &= value.to_bits() != 0 && !value.is_nan();
            message[*place..place + 8].copy_from_slice(&value.to_le_bytes());
        }
        if !same {
            out.truncate(start);
        }
        same
    }
}

fn put_double(number: u32, value: f64, out: &mut Vec<u8>) {
    // proto3 leaves out what is all bits zero; −0 is not.
    if value.to_bits() != 0 {
        put_tag(number, 1, out);
        out.extend_from_slice(&value.to_le_bytes());
    }
}

/// `uint32` is the only integer of the interface; any other kind gives the value back.
fn put_uint32(number: u32, kind: Kind, value: f64, out: &mut Vec<u8>) -> Result<(), f64> {
    if kind != Kind::Uint32 || value.fract() != 0.0 || !(0.0..=f64::from(u32::MAX)).contains(&value) {
        return Err(value);
    }
    if value != 0.0 {
        put_tag(number, 0, out);
        put_varint(value as u64, out);
    }
    Ok(())
}

fn put_varint(mut value: u64, out: &mut Vec<u8>) {
    while value >= 0x80 {
        out.push((value & 0x7f) as u8 | 0x80);
        value >>= 7;
    }
    out.push(value as u8);
}

fn put_tag(number: u32, wire_type: u8, out: &mut Vec<u8>) {
    put_varint(u64::from(number) << 3 | u64::from(wire_type), out);
}

/// Sets the length of the sub-message whose one-byte placeholder stands at `at`; longer lengths shift the body, by as
/// many bytes as this returns.
fn set_length(at: usize, out: &mut Vec<u8>) -> usize {
    let length = out.len() - at - 1;
    if length < 0x80 {
        out[at] = length as u8;
        return 0;
    }
    let mut varint = Vec::new();
    put_varint(length as u64, &mut varint);
    let shift = varint.len() - 1;
    out.splice(at..=at, varint);
    shift
}

/// `name` as an identifier of protobuf: letters, digits and underscores; `prefix` goes before anything but a letter.
fn identifier(name: &str, prefix: &str) -> String {
    let mut text: String = name.chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '_' }).collect();
    if !text.starts_with(|c: char| c.is_ascii_alphabetic()) {
        text.insert_str(0, prefix);
    }
    text
}

/// The path of a column as identifiers. proto3 wants siblings that differ by more than case and underscores, and no
/// field can be a message and a value at once; a column that collides becomes a flat name with a number.
fn free_path(name: &str, taken: &mut BTreeSet<String>) -> String {
    let components: Vec<String> = name.split('.').map(|c| identifier(c, "column")).collect();
    let plain = |path: &str| path.replace('_', "").to_ascii_lowercase();
    let free = |path: &str, taken: &BTreeSet<String>| {
        let path = plain(path);
        let above = |a: &str, b: &str| b.strip_prefix(a).is_some_and(|rest| rest.is_empty() || rest.starts_with('.'));
        taken.iter().all(|t| !above(t, &path) && !above(&path, t))
    };
    let mut path = components.join(".");
    let mut number = 1;
    while !free(&path, taken) {
        number += 1;
        path = format!("{}_{number}", components.join("_"));
    }
    taken.insert(plain(&path));
    path
}

/// Fields of a generated message in the order of the columns.
#[derive(Default)]
struct Tree {
    names: Vec<String>,
    children: BTreeMap<String, Tree>,
}

impl Tree {
    fn insert(&mut self, path: &str) {
        let (name, rest) = match path.split_once('.') {
            Some((name, rest)) => (name, Some(rest)),
            None => (path, None),
        };
        if !self.names.iter().any(|n| n == name) {
            self.names.push(name.to_owned());
        }
        if let Some(rest) = rest {
            self.children.entry(name.to_owned()).or_default().insert(rest);
        }
    }

    fn message(&self, name: &str, type_name: &str) -> DescriptorProto {
        let mut nested_type = vec![];
        let field = (1..)
            .zip(&self.names)
            .map(|(number, field)| {
                let message = self.children.get(field).map(|child| {
                    let nested = format!("{}_", identifier(field, "_"));
                    let type_name = format!("{type_name}.{nested}");
                    nested_type.push(child.message(&nested, &type_name));
                    type_name
                });
                FieldDescriptorProto {
                    name: Some(field.clone()),
                    json_name: Some(field.clone()),
                    number: Some(number),
                    label: Some(Label::Optional.into()),
                    r#type: Some(if message.is_some() { Type::Message } else { Type::Double }.into()),
                    type_name: message,
                    ..FieldDescriptorProto::default()
                }
            })
            .collect();
        DescriptorProto { name: Some(name.to_owned()), field, nested_type, ..DescriptorProto::default() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::table::Column;
    use crate::telemetry::{Cells, Decoder, descriptor, expected, interface_tables};
    use proptest::prelude::*;
    use protox::prost_reflect::{DescriptorPool, DynamicMessage, ReflectMessage as _, Value};

    fn table(name: &str, columns: &[&str]) -> TableSpec {
        let column = |name: &&str| Column {
            table: "t".into(),
            name: (*name).into(),
            unit: "m".into(),
            frame: String::new(),
            rate_hz: 0.0,
            attributes: BTreeMap::new(),
        };
        TableSpec { name: name.into(), rate_hz: 0.0, columns: columns.iter().map(column).collect(), truth: false }
    }

    fn one_row(values: &[f64]) -> Batch {
        Batch { time_ns: vec![0], columns: values.iter().map(|v| vec![*v]).collect() }
    }

    /// Another implementation of protobuf, on the descriptor that goes into the file.
    fn pool(message: &MessageType) -> DescriptorPool {
        DescriptorPool::decode(message.descriptor_set.as_slice()).expect("a valid descriptor set")
    }

    fn reflected(message: &DynamicMessage, path: &str) -> f64 {
        let (name, rest) = path.split_once('.').map_or((path, None), |(n, r)| (n, Some(r)));
        match (message.get_field_by_name(name).expect("the field is there").into_owned(), rest) {
            (Value::Message(inner), Some(rest)) => reflected(&inner, rest),
            (Value::F64(value), None) => value,
            (Value::U32(value), None) => f64::from(value),
            other => panic!("{path}: {other:?}"),
        }
    }

    #[test]
    fn a_generated_message_is_read_by_another_implementation() {
        let odd = [
            "com-offset.tm1.x@tm1.accel.y",
            "a",
            "a.b",
            "a.b.c",
            "a-b",
            "a_b",
            "1x",
            "",
            "é",
            "tm1.x",
            "tm1.y",
            "..",
            "x.",
        ];
        let table = table("es-akf", &odd);
        let message = MessageType::of(&table).unwrap();
        let distinct: BTreeSet<_> = message.paths.iter().collect();
        assert_eq!(distinct.len(), odd.len(), "{distinct:?}");
        assert_eq!(message.paths[9], "tm1.x", "a sound name stays");
        let values: Vec<f64> = (0..odd.len()).map(|i| i as f64 - 3.0).collect();
        let mut bytes = vec![];
        Encoder::new(message.clone()).encode(&one_row(&values), 0, &mut bytes).unwrap();
        let descriptor = pool(&message).get_message_by_name(&message.name).unwrap();
        let decoded = DynamicMessage::decode(descriptor.clone(), bytes.as_slice()).unwrap();
        for (path, value) in message.paths.iter().zip(&values) {
            assert_eq!(reflected(&decoded, path), *value, "{path}");
        }
        assert!(descriptor.fields().all(|f| f.json_name() == f.name()));
    }

    #[test]
    fn what_has_no_encoding_is_an_error() {
        let foreign = table("hk/t", &["value", "error"]);
        assert!(
            matches!(MessageType::of(&foreign), Err(EncodeError::UnknownColumn { column, .. }) if column == "error")
        );
        let status = table("ifo", &["tm1.x_orf_m", "tm1.status"]);
        let mut encoder = Encoder::new(MessageType::of(&status).unwrap());
        for bad in [0.5, -1.0, 4_294_967_296.0, f64::INFINITY, f64::NAN] {
            let refused = encoder.encode(&one_row(&[1.0, bad]), 0, &mut vec![]);
            assert!(matches!(refused, Err(EncodeError::NotAnInteger { .. })), "{bad}");
        }
        let mut bytes = vec![];
        encoder.encode(&one_row(&[f64::NAN, f64::NAN]), 0, &mut bytes).unwrap();
        assert!(bytes.is_empty(), "a sub-message of NaN is absent");
    }

    /// A pattern gives the bytes of the general way, and leaves every row that differs to it.
    #[test]
    fn a_pattern_is_the_general_way() {
        let long: Vec<String> = (0..40).map(|i| format!("m.n.c{i}")).chain(["m.z".into(), "a".into()]).collect();
        let generated = table("long", &long.iter().map(String::as_str).collect::<Vec<_>>());
        let partial = table("is", &["tm1.r_orf_m.x", "tm2.status"]);
        for table in interface_tables().into_iter().chain([generated, partial]) {
            let mut encoder = Encoder::new(MessageType::of(&table).unwrap());
            let integer = |i: usize| table.columns[i].name.ends_with("status");
            let n = table.columns.len();
            let row = |k: usize| move |i: usize| if i % 7 == 3 { 0.0 } else { (i * n + k) as f64 + 0.5 };
            let values = |k: usize| (0..n).map(|i| if integer(i) { 0.0 } else { row(k)(i) }).collect::<Vec<f64>>();
            let general = |encoder: &Encoder, values: &[f64]| {
                let mut bytes = vec![7];
                encoder.node(0, &one_row(values), 0, &mut bytes).unwrap();
                bytes
            };
            encoder.encode(&one_row(&values(0)), 0, &mut vec![]).unwrap();
            let pattern = encoder.last.clone().unwrap();
            let mut bytes = vec![7];
            assert!(pattern.encode(&one_row(&values(1)), 0, &mut bytes), "{}", table.name);
            assert_eq!(bytes, general(&encoder, &values(1)), "{}", table.name);
            for i in 0..n {
                let mut other = values(2);
                other[i] = if other[i] == 0.0 { 3.0 } else { 0.0 };
                let mut bytes = vec![7];
                assert!(!pattern.encode(&one_row(&other), 0, &mut bytes) && bytes == [7], "{} {i}", table.name);
                encoder.encode(&one_row(&other), 0, &mut bytes).unwrap();
                assert_eq!(bytes, general(&encoder, &other), "{} {i}", table.name);
            }
        }
    }

    #[test]
    fn a_long_sub_message_gets_a_long_length() {
        let names: Vec<String> = (0..40).map(|i| format!("m.c{i}")).collect();
        let table = table("long", &names.iter().map(String::as_str).collect::<Vec<_>>());
        let message = MessageType::of(&table).unwrap();
        let values: Vec<f64> = (0..40).map(|i| f64::from(i) + 0.5).collect();
        let mut bytes = vec![];
        Encoder::new(message.clone()).encode(&one_row(&values), 0, &mut bytes).unwrap();
        assert!(bytes.len() > 0x80);
        let layout = Layout::parse(&message.descriptor_set, &message.name).unwrap();
        let mut read = vec![f64::NAN; 40];
        Decoder::new(&layout).decode(&bytes, &mut Cells { values: &mut read, rows: 1, row: 0 }).unwrap();
        assert_eq!(read, values);
    }

    proptest! {
        #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::default() })]

        /// Both ways against another implementation: its reading of our bytes, our reading of its bytes.
        #[test]
        fn the_interface_as_another_implementation_has_it(
            which in 0usize..5,
            values in prop::collection::vec(any::<f64>().prop_filter("a number", |v| !v.is_nan()), 18),
            status in any::<u32>(),
        ) {
            let table = &interface_tables()[which];
            let message = MessageType::of(table).unwrap();
            let cells: Vec<f64> = (table.columns.iter().zip(values))
                .map(|(c, v)| if c.name.ends_with("status") { f64::from(status) } else { v })
                .collect();
            let mut bytes = vec![];
            Encoder::new(message.clone()).encode(&one_row(&cells), 0, &mut bytes).unwrap();
            let topic = format!("/{}", table.name);
            let theirs = pool(&message).get_message_by_name(descriptor(&topic).unwrap().0).unwrap();
            let decoded = DynamicMessage::decode(theirs, bytes.as_slice()).unwrap();
            for (column, cell) in table.columns.iter().zip(&cells) {
                prop_assert_eq!(reflected(&decoded, &column.name).to_bits(), cell.to_bits());
            }
            let again = decoded.transcode_to_dynamic().encode_to_vec();
            let mut read = vec![f64::NAN; cells.len()];
            Decoder::new(expected(&topic).unwrap()).decode(&again, &mut Cells { values: &mut read, rows: 1, row: 0 }).unwrap();
            prop_assert_eq!(read, cells);
        }
    }
}
