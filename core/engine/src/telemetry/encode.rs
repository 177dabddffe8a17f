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
pub enum EncodeError {
    /// A table of the interface has a column that its message has not.
    #[error(
        "table {table} has a column {column} that its message {message} in telemetry.proto does not have; rename the column or the table"
    )]
    UnknownColumn {
        /// Name of the table.
        table: String,
        /// Name of the column.
        column: String,
        /// Name of the message.
        message: String,
    },
    /// A value of an integer field is no such integer.
    #[error("column {column} holds {value}, which is not a {kind}")]
    NotAnInteger {
        /// Path of the column.
        column: String,
        /// The value.
        value: f64,
        /// Type of the field.
        kind: Kind,
    },
    /// The generated schema is refused, as it would be by a reader.
    #[error("table {table} makes no message: {source}")]
    Layout {
        /// Name of the table.
        table: String,
        /// What is wrong with it.
        source: LayoutError,
    },
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
}

impl Encoder {
    /// An encoder of the table from which `message` was made.
    #[must_use]
    pub fn new(message: MessageType) -> Self {
        Self { message }
    }

    /// Appends one row to `out` as a message. A sub-message whose values are all NaN is left out, which is how it is
    /// read back; a field without a column is NaN, or 0 for an integer.
    ///
    /// # Errors
    /// [`EncodeError::NotAnInteger`].
    ///
    /// # Panics
    /// When `batch` has not the columns of the table or not the row.
    pub fn encode(&self, batch: &Batch, row: usize, out: &mut Vec<u8>) -> Result<(), EncodeError> {
        self.node(0, batch, row, out).map(drop)
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

/// Sets the length of the sub-message whose one-byte placeholder stands at `at`; longer lengths shift the body.
fn set_length(at: usize, out: &mut Vec<u8>) {
    let length = out.len() - at - 1;
    if length < 0x80 {
        out[at] = length as u8;
    } else {
        let mut varint = Vec::new();
        put_varint(length as u64, &mut varint);
        out.splice(at..=at, varint);
    }
}

/// `name` as an identifier of protobuf: letters, digits and underscores, not a digit first, never empty.
fn identifier(name: &str, empty: &str) -> String {
    let mut text: String = name.chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '_' }).collect();
    if text.is_empty() {
        empty.clone_into(&mut text);
    }
    if text.starts_with(|c: char| c.is_ascii_digit()) {
        text.insert(0, '_');
    }
    text
}

/// The path of a column as identifiers: distinct from those taken, and no field is a message and a value at once.
fn free_path(name: &str, taken: &mut BTreeSet<String>) -> String {
    let components: Vec<String> = name.split('.').map(|c| identifier(c, "_")).collect();
    let mut path = components.join(".");
    let collides = |path: &str, taken: &BTreeSet<String>| {
        taken.iter().any(|t| t == path || t.starts_with(&format!("{path}.")) || path.starts_with(&format!("{t}.")))
    };
    if collides(&path, taken) {
        // One flat name cannot be the parent or the child of another.
        path = components.join("_");
        while collides(&path, taken) {
            path.push('_');
        }
    }
    taken.insert(path.clone());
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
