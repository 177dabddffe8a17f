//! The compiled form of a message descriptor: which wire field goes to which column.

use std::collections::BTreeMap;
use std::fmt;

use prost::Message;
use prost_types::field_descriptor_proto::{Label, Type};
use prost_types::{DescriptorProto, FileDescriptorSet};
use serde::Serialize;

/// Deepest nesting of messages that is followed; what lies deeper is ignored like a string.
const MAX_DEPTH: usize = 16;
/// Most columns one message may have: a recursive or hostile schema must not fill the memory.
const MAX_LEAVES: usize = 1024;
/// Most (sub)messages one layout may have, for the same reason: messages without a scalar make no column.
const MAX_NODES: usize = 1024;

/// Why a schema cannot be used.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum LayoutError {
    /// The bytes are no FileDescriptorSet.
    #[error("the schema is not a protobuf FileDescriptorSet: {0}")]
    NotADescriptorSet(String),
    /// The set lacks a message type.
    #[error("the schema does not define the message type {0}; a FileDescriptorSet must include its imports")]
    UnknownType(String),
    /// The message has more scalar fields or nested messages than a packet can sensibly have.
    #[error("message type {0} has more than {MAX_LEAVES} scalar fields or nested messages")]
    TooLarge(String),
    /// A field number outside 1 to 2^29 − 1, or two fields with one number.
    #[error("field {0} has an invalid or repeated field number")]
    FieldNumber(String),
}

/// Scalar types of a field that become a column of float64; every one of them fits exactly.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
#[allow(missing_docs, reason = "the names are those of protobuf")]
pub enum Kind {
    Double,
    Float,
    Uint32,
    Int32,
    Sint32,
    Fixed32,
    Sfixed32,
    Bool,
    Enum,
}

impl Kind {
    fn of(kind: Type) -> Option<Self> {
        Some(match kind {
            Type::Double => Self::Double,
            Type::Float => Self::Float,
            Type::Uint32 => Self::Uint32,
            Type::Int32 => Self::Int32,
            Type::Sint32 => Self::Sint32,
            Type::Fixed32 => Self::Fixed32,
            Type::Sfixed32 => Self::Sfixed32,
            Type::Bool => Self::Bool,
            Type::Enum => Self::Enum,
            _ => return None,
        })
    }
}

impl fmt::Display for Kind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.serialize(f)
    }
}

/// One scalar field below a message, as a column.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Leaf {
    /// Dotted path from the message, `tm1.r_orf_m.x`.
    pub path: String,
    /// Type on the wire.
    pub kind: Kind,
}

/// What a field number of a message leads to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Slot {
    /// A scalar, into column `column`.
    Scalar { kind: Kind, column: usize },
    /// A sub-message, `Layout::nodes[node]`.
    Message { node: usize },
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Field {
    pub(super) number: u32,
    pub(super) slot: Slot,
}

/// One message of the tree.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Node {
    /// In ascending order of field number; field numbers that are not here are skipped.
    pub(super) fields: Vec<Field>,
    /// Columns of the scalars that are 0 when the message is there and they are not (proto3 without `optional`).
    pub(super) implicit: Vec<usize>,
}

impl Node {
    /// Field numbers mostly count from 1 without holes, so the first look is nearly always the right one.
    pub(super) fn slot(&self, number: u32) -> Option<Slot> {
        let guess = (number as usize).wrapping_sub(1);
        match self.fields.get(guess) {
            Some(field) if field.number == number => Some(field.slot),
            _ => self.fields.binary_search_by_key(&number, |f| f.number).ok().map(|at| self.fields[at].slot),
        }
    }
}

/// A message type as a walk from wire bytes to columns.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Layout {
    /// The root is the first.
    pub(super) nodes: Vec<Node>,
    leaves: Vec<Leaf>,
    ignored: Vec<String>,
}

impl Layout {
    /// Compiles message type `name` (fully qualified, no leading dot) of a serialised FileDescriptorSet.
    ///
    /// # Errors
    /// [`LayoutError`] when the bytes are no descriptor set or do not define the type completely.
    pub fn parse(descriptor_set: &[u8], name: &str) -> Result<Self, LayoutError> {
        let set =
            FileDescriptorSet::decode(descriptor_set).map_err(|e| LayoutError::NotADescriptorSet(e.to_string()))?;
        Self::compile(&set, name)
    }

    /// As [`Layout::parse`], of a descriptor set already decoded.
    ///
    /// # Errors
    /// [`LayoutError`] when the set does not define the type completely.
    pub fn compile(set: &FileDescriptorSet, name: &str) -> Result<Self, LayoutError> {
        let mut types = BTreeMap::new();
        for file in &set.file {
            let scope = match file.package() {
                "" => String::new(),
                package => format!(".{package}"),
            };
            let proto3 = file.syntax() == "proto3";
            for message in &file.message_type {
                collect(&scope, message, proto3, 0, &mut types);
            }
        }
        let mut compiler =
            Compiler { root: name, types: &types, layout: Self { nodes: vec![], leaves: vec![], ignored: vec![] } };
        compiler.message(&format!(".{name}"), "", 0)?;
        Ok(compiler.layout)
    }

    /// The columns, in the order of the schema's text.
    pub fn leaves(&self) -> &[Leaf] {
        &self.leaves
    }

    /// Paths of the fields that are no column: repeated, text, bytes, 64-bit integers, groups, too deep.
    pub fn ignored(&self) -> &[String] {
        &self.ignored
    }

    /// Lets a sub-message of nothing but numbers that is not there be zero where the message that should hold it is. Of
    /// a readout it is no measurement, and stays NaN; of a command it is none.
    pub fn absent_numbers_are_zero(&mut self) {
        let only_numbers = |node: &Node| node.fields.iter().all(|field| matches!(field.slot, Slot::Scalar { .. }));
        let numbers: Vec<Option<Vec<usize>>> =
            self.nodes.iter().map(|node| only_numbers(node).then(|| node.implicit.clone())).collect();
        for node in &mut self.nodes {
            let held = node.fields.iter().filter_map(|field| match field.slot {
                Slot::Message { node } => numbers[node].as_ref(),
                Slot::Scalar { .. } => None,
            });
            let held: Vec<usize> = held.flatten().copied().collect();
            node.implicit.extend(held);
        }
    }

    /// Sends leaf `i` to column `columns[i]`.
    ///
    /// # Panics
    /// When `columns` is shorter than [`Layout::leaves`].
    pub fn redirect(&mut self, columns: &[usize]) {
        for node in &mut self.nodes {
            for field in &mut node.fields {
                if let Slot::Scalar { column, .. } = &mut field.slot {
                    *column = columns[*column];
                }
            }
            for column in &mut node.implicit {
                *column = columns[*column];
            }
        }
    }
}

/// A message descriptor and whether its file is proto3 (absent scalars are 0).
type Types<'a> = BTreeMap<String, (&'a DescriptorProto, bool)>;

fn collect<'a>(scope: &str, message: &'a DescriptorProto, proto3: bool, depth: usize, types: &mut Types<'a>) {
    let name = format!("{scope}.{}", message.name());
    if depth < MAX_DEPTH {
        for nested in &message.nested_type {
            collect(&name, nested, proto3, depth + 1, types);
        }
    }
    types.insert(name, (message, proto3));
}

struct Compiler<'a> {
    root: &'a str,
    types: &'a Types<'a>,
    layout: Layout,
}

impl Compiler<'_> {
    fn message(&mut self, type_name: &str, path: &str, depth: usize) -> Result<usize, LayoutError> {
        let &(message, proto3) = self
            .types
            .get(type_name)
            .ok_or_else(|| LayoutError::UnknownType(type_name.trim_start_matches('.').to_owned()))?;
        if self.layout.nodes.len() >= MAX_NODES {
            return Err(LayoutError::TooLarge(self.root.to_owned()));
        }
        let at = self.layout.nodes.len();
        self.layout.nodes.push(Node::default());
        let mut node = Node::default();
        for field in &message.field {
            let path = match path {
                "" => field.name().to_owned(),
                path => format!("{path}.{}", field.name()),
            };
            let number = u32::try_from(field.number()).unwrap_or(0);
            if number == 0 || number >= 1 << 29 {
                return Err(LayoutError::FieldNumber(path));
            }
            let kind = field.r#type.and_then(|t| Type::try_from(t).ok());
            let slot = match kind {
                _ if field.label() == Label::Repeated => None,
                Some(Type::Message) if depth + 1 < MAX_DEPTH => {
                    Some(Slot::Message { node: self.message(field.type_name(), &path, depth + 1)? })
                }
                Some(kind) => Kind::of(kind).map(|kind| self.leaf(&path, kind)).transpose()?,
                None => None,
            };
            match slot {
                None => self.layout.ignored.push(path),
                Some(slot) => {
                    // A field with presence (`optional`, in a oneof, or of an older syntax) is missing when absent.
                    if let Slot::Scalar { column, .. } = slot
                        && proto3
                        && field.oneof_index.is_none()
                    {
                        node.implicit.push(column);
                    }
                    node.fields.push(Field { number, slot });
                }
            }
        }
        node.fields.sort_by_key(|f| f.number);
        if let Some(pair) = node.fields.windows(2).find(|w| w[0].number == w[1].number) {
            return Err(LayoutError::FieldNumber(format!("{type_name} #{}", pair[0].number)));
        }
        self.layout.nodes[at] = node;
        Ok(at)
    }

    fn leaf(&mut self, path: &str, kind: Kind) -> Result<Slot, LayoutError> {
        let column = self.layout.leaves.len();
        if column >= MAX_LEAVES {
            return Err(LayoutError::TooLarge(self.root.to_owned()));
        }
        self.layout.leaves.push(Leaf { path: path.to_owned(), kind });
        Ok(Slot::Scalar { kind, column })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use prost_types::{FieldDescriptorProto, FileDescriptorProto};

    fn field(name: &str, number: i32, kind: Type, type_name: &str) -> FieldDescriptorProto {
        FieldDescriptorProto {
            name: Some(name.into()),
            number: Some(number),
            label: Some(Label::Optional.into()),
            r#type: Some(kind.into()),
            type_name: (!type_name.is_empty()).then(|| type_name.into()),
            ..FieldDescriptorProto::default()
        }
    }

    fn set(messages: Vec<(&str, Vec<FieldDescriptorProto>)>) -> FileDescriptorSet {
        let message_type = messages
            .into_iter()
            .map(|(name, field)| DescriptorProto { name: Some(name.into()), field, ..DescriptorProto::default() })
            .collect();
        FileDescriptorSet {
            file: vec![FileDescriptorProto {
                package: Some("p".into()),
                syntax: Some("proto3".into()),
                message_type,
                ..FileDescriptorProto::default()
            }],
        }
    }

    #[test]
    fn what_is_no_column_is_named() {
        let mut repeated = field("list", 2, Type::Double, "");
        repeated.label = Some(Label::Repeated.into());
        let set = set(vec![(
            "M",
            vec![
                field("v", 1, Type::Double, ""),
                repeated,
                field("t", 3, Type::Int64, ""),
                field("s", 4, Type::String, ""),
            ],
        )]);
        let layout = Layout::compile(&set, "p.M").unwrap();
        assert_eq!(layout.leaves(), [Leaf { path: "v".into(), kind: Kind::Double }]);
        assert_eq!(layout.ignored(), ["list", "t", "s"]);
    }

    #[test]
    fn a_recursive_type_ends_at_the_depth_limit() {
        let chain = set(vec![("M", vec![field("v", 1, Type::Double, ""), field("next", 2, Type::Message, ".p.M")])]);
        let layout = Layout::compile(&chain, "p.M").unwrap();
        assert_eq!(layout.leaves().len(), MAX_DEPTH);
        let tree = set(vec![(
            "M",
            vec![
                field("a", 1, Type::Message, ".p.M"),
                field("b", 2, Type::Message, ".p.M"),
                field("v", 3, Type::Bool, ""),
            ],
        )]);
        assert_eq!(Layout::compile(&tree, "p.M"), Err(LayoutError::TooLarge("p.M".into())));
    }

    #[test]
    fn incomplete_or_contradictory_schemas_are_refused() {
        let missing = set(vec![("M", vec![field("v", 1, Type::Message, ".p.Vec3")])]);
        assert_eq!(Layout::compile(&missing, "p.M"), Err(LayoutError::UnknownType("p.Vec3".into())));
        assert_eq!(Layout::compile(&missing, "q.M"), Err(LayoutError::UnknownType("q.M".into())));
        let twice = set(vec![("M", vec![field("a", 1, Type::Bool, ""), field("b", 1, Type::Bool, "")])]);
        assert!(matches!(Layout::compile(&twice, "p.M"), Err(LayoutError::FieldNumber(_))));
        let zero = set(vec![("M", vec![field("a", 0, Type::Bool, "")])]);
        assert!(matches!(Layout::compile(&zero, "p.M"), Err(LayoutError::FieldNumber(_))));
        assert!(matches!(Layout::parse(b"\xff\xff", "p.M"), Err(LayoutError::NotADescriptorSet(_))));
    }
}
