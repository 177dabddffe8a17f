//! Wire bytes to columns.

use super::layout::{Kind, Layout, Node, Slot};

/// Why a message cannot be decoded.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum WireError {
    /// A value or a length reaches past the end of the message.
    #[error("a field reaches past the end of the message")]
    Truncated,
    /// A varint longer than 10 bytes, or a field number 0 or above 2^29 − 1.
    #[error("a variable-length integer is malformed")]
    Varint,
    /// A field has another wire type than its schema says.
    #[error("field {0} has another wire type than the schema says")]
    WireType(u32),
    /// A group that is not closed, or closed and never opened.
    #[error("a group is not balanced")]
    Group,
}

/// One row of a block of columns: value `c` stands at `values[c * rows + row]`. NaN where nothing was decoded.
#[derive(Debug)]
pub struct Cells<'a> {
    /// All columns, one after the other.
    pub values: &'a mut [f64],
    /// Rows of a column.
    pub rows: usize,
    /// The row to fill; its cells hold NaN.
    pub row: usize,
}

impl Cells<'_> {
    fn set(&mut self, column: usize, value: f64) {
        self.values[column * self.rows + self.row] = value;
    }
}

/// Decodes the messages of one channel.
#[derive(Clone, Debug)]
pub struct Decoder {
    nodes: Vec<Node>,
    /// Number of the message in which each node was last entered: proto3 merges a sub-message that comes twice, so
    /// only the first one sets its absent scalars to 0.
    entered: Vec<u64>,
    message: u64,
    non_finite: u64,
}

impl Decoder {
    /// A decoder that fills the columns to which `layout` points.
    pub fn new(layout: &Layout) -> Self {
        Self { entered: vec![0; layout.nodes.len()], nodes: layout.nodes.clone(), message: 0, non_finite: 0 }
    }

    /// Decodes one message into one row. An absent scalar is 0, an absent sub-message leaves NaN. Returns how many of
    /// the transmitted values are NaN or infinite.
    ///
    /// # Errors
    /// [`WireError`]; the row then holds some of the values.
    ///
    /// # Panics
    /// When `cells` is too small for the columns to which the layout points.
    pub fn decode(&mut self, message: &[u8], cells: &mut Cells<'_>) -> Result<u64, WireError> {
        self.message += 1;
        self.non_finite = 0;
        self.walk(0, message, cells)?;
        Ok(self.non_finite)
    }

    fn walk(&mut self, node: usize, bytes: &[u8], cells: &mut Cells<'_>) -> Result<(), WireError> {
        if self.entered[node] != self.message {
            self.entered[node] = self.message;
            for &column in &self.nodes[node].implicit {
                cells.set(column, 0.0);
            }
        }
        let mut wire = Wire { bytes };
        while !wire.bytes.is_empty() {
            let (number, wire_type) = wire.tag()?;
            match self.nodes[node].slot(number) {
                Some(Slot::Scalar { kind, column }) => {
                    let value = wire.scalar(kind, number, wire_type)?;
                    self.non_finite += u64::from(!value.is_finite());
                    cells.set(column, value);
                }
                Some(Slot::Message { node: child }) => {
                    if wire_type != LENGTH {
                        return Err(WireError::WireType(number));
                    }
                    let inner = wire.delimited()?;
                    self.walk(child, inner, cells)?;
                }
                None => wire.skip(number, wire_type)?,
            }
        }
        Ok(())
    }
}

const VARINT: u8 = 0;
const FIXED64: u8 = 1;
const LENGTH: u8 = 2;
const GROUP: u8 = 3;
const END_GROUP: u8 = 4;
const FIXED32: u8 = 5;

/// What is left of a message.
struct Wire<'a> {
    bytes: &'a [u8],
}

impl<'a> Wire<'a> {
    fn varint(&mut self) -> Result<u64, WireError> {
        if let [byte, rest @ ..] = self.bytes
            && *byte < 0x80
        {
            self.bytes = rest;
            return Ok(u64::from(*byte));
        }
        let mut value = 0;
        for (i, &byte) in self.bytes.iter().take(10).enumerate() {
            value |= u64::from(byte & 0x7f) << (7 * i);
            if byte < 0x80 {
                self.bytes = &self.bytes[i + 1..];
                return Ok(value);
            }
        }
        Err(if self.bytes.len() < 10 { WireError::Truncated } else { WireError::Varint })
    }

    fn tag(&mut self) -> Result<(u32, u8), WireError> {
        let tag = self.varint()?;
        let number = u32::try_from(tag >> 3).unwrap_or(0);
        if number == 0 || number >= 1 << 29 {
            return Err(WireError::Varint);
        }
        Ok((number, (tag & 7) as u8))
    }

    fn fixed<const N: usize>(&mut self) -> Result<[u8; N], WireError> {
        let (value, rest) = self.bytes.split_first_chunk::<N>().ok_or(WireError::Truncated)?;
        self.bytes = rest;
        Ok(*value)
    }

    fn delimited(&mut self) -> Result<&'a [u8], WireError> {
        let length = usize::try_from(self.varint()?).map_err(|_| WireError::Truncated)?;
        let (value, rest) = self.bytes.split_at_checked(length).ok_or(WireError::Truncated)?;
        self.bytes = rest;
        Ok(value)
    }

    #[allow(clippy::cast_possible_truncation, reason = "protobuf truncates a varint to the width of its field")]
    fn scalar(&mut self, kind: Kind, number: u32, wire_type: u8) -> Result<f64, WireError> {
        let due = match kind {
            Kind::Double => FIXED64,
            Kind::Float | Kind::Fixed32 | Kind::Sfixed32 => FIXED32,
            Kind::Uint32 | Kind::Int32 | Kind::Sint32 | Kind::Bool | Kind::Enum => VARINT,
        };
        if wire_type != due {
            return Err(WireError::WireType(number));
        }
        Ok(match kind {
            Kind::Double => f64::from_le_bytes(self.fixed()?),
            Kind::Float => f64::from(f32::from_le_bytes(self.fixed()?)),
            Kind::Fixed32 => f64::from(u32::from_le_bytes(self.fixed()?)),
            Kind::Sfixed32 => f64::from(i32::from_le_bytes(self.fixed()?)),
            Kind::Uint32 => f64::from(self.varint()? as u32),
            Kind::Int32 | Kind::Enum => f64::from(self.varint()? as u32 as i32),
            Kind::Sint32 => {
                let zigzag = self.varint()? as u32;
                f64::from((zigzag >> 1) as i32 ^ -((zigzag & 1) as i32))
            }
            Kind::Bool => f64::from(u8::from(self.varint()? != 0)),
        })
    }

    fn skip(&mut self, number: u32, wire_type: u8) -> Result<(), WireError> {
        match wire_type {
            VARINT => self.varint().map(drop),
            FIXED64 => self.fixed::<8>().map(drop),
            LENGTH => self.delimited().map(drop),
            FIXED32 => self.fixed::<4>().map(drop),
            GROUP => {
                let mut open = vec![number];
                while let Some(&innermost) = open.last() {
                    match self.tag()? {
                        (number, GROUP) => open.push(number),
                        (number, END_GROUP) if number == innermost => drop(open.pop()),
                        (_, END_GROUP) => return Err(WireError::Group),
                        (number, wire_type) => self.skip(number, wire_type)?,
                    }
                }
                Ok(())
            }
            END_GROUP => Err(WireError::Group),
            _ => Err(WireError::WireType(number)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::telemetry::expected;

    fn decode(topic: &str, message: &[u8]) -> Result<(Vec<f64>, u64), WireError> {
        let layout = expected(topic).unwrap();
        let mut values = vec![f64::NAN; layout.leaves().len()];
        let non_finite = Decoder::new(layout).decode(message, &mut Cells { values: &mut values, rows: 1, row: 0 })?;
        Ok((values, non_finite))
    }

    fn value(topic: &str, path: &str, message: &[u8]) -> f64 {
        let column = expected(topic).unwrap().leaves().iter().position(|l| l.path == path).unwrap();
        decode(topic, message).unwrap().0[column]
    }

    /// Bytes written out by hand from the encoding rules of protobuf and the text of `telemetry.proto`.
    #[test]
    fn bytes_by_hand() {
        // Dws { tm1 { theta_orf_rad: 1.0 } status: 300 }
        let mut message = vec![0x0a, 9, 0x09];
        message.extend(1.0_f64.to_le_bytes());
        message.extend([0x20, 0xac, 0x02]);
        assert_eq!(value("/dws", "tm1.theta_orf_rad", &message), 1.0);
        assert_eq!(value("/dws", "tm1.psi_orf_rad", &message), 0.0, "absent scalar");
        assert_eq!(value("/dws", "status", &message), 300.0);
        assert!(value("/dws", "tm2.psi_orf_rad", &message).is_nan(), "absent sub-message");
        assert!(value("/dws", "sc_crf_rad.phi", &message).is_nan());
    }

    /// Proto3 leaves out what is zero: a producer that does not turn its test masses sends no torque.
    #[test]
    fn a_command_that_is_not_set_is_zero() {
        let mut layout = expected("/command").unwrap().clone();
        layout.absent_numbers_are_zero();
        // Command { mps_force_srf_n { y: 2 } tm1 { force_orf_n { x: 1 } } }
        let mut message = vec![0x0a, 9, 0x11];
        message.extend(2.0_f64.to_le_bytes());
        message.extend([0x1a, 11, 0x0a, 9, 0x09]);
        message.extend(1.0_f64.to_le_bytes());
        let mut values = vec![f64::NAN; layout.leaves().len()];
        Decoder::new(&layout).decode(&message, &mut Cells { values: &mut values, rows: 1, row: 0 }).unwrap();
        let value = |path: &str| values[layout.leaves().iter().position(|leaf| leaf.path == path).unwrap()];
        assert_eq!(
            [value("mps_force_srf_n.y"), value("mps_force_srf_n.z"), value("tm1.force_orf_n.x")],
            [2.0, 0.0, 1.0]
        );
        assert_eq!([value("mps_torque_srf_nm.x"), value("tm1.torque_orf_nm.z")], [0.0, 0.0]);
        assert!(value("tm2.force_orf_n.x").is_nan(), "nothing is said of the other test mass");
    }

    #[test]
    fn a_repeated_sub_message_merges() {
        // Dws { tm1 { theta: 1 } tm1 { psi: 2 } }: the second does not reset theta.
        let mut message = vec![0x0a, 9, 0x09];
        message.extend(1.0_f64.to_le_bytes());
        message.extend([0x0a, 9, 0x11]);
        message.extend(2.0_f64.to_le_bytes());
        assert_eq!(value("/dws", "tm1.theta_orf_rad", &message), 1.0);
        assert_eq!(value("/dws", "tm1.psi_orf_rad", &message), 2.0);
    }

    #[test]
    fn unknown_fields_of_every_wire_type_are_skipped() {
        let mut message = vec![0x98, 0x06, 0x96, 0x01]; // field 99, varint 150
        message.extend([0x99, 0x06, 1, 2, 3, 4, 5, 6, 7, 8]); // fixed64
        message.extend([0x9a, 0x06, 2, 0xff, 0xff]); // length-delimited
        message.extend([0x9d, 0x06, 1, 2, 3, 4]); // fixed32
        message.extend([0x9b, 0x06, 0xa3, 0x06, 0x08, 1, 0xa4, 0x06, 0x9c, 0x06]); // group in a group
        message.extend([0x20, 7]);
        assert_eq!(value("/dws", "status", &message), 7.0);
    }

    #[test]
    fn malformed_messages_are_errors() {
        for (message, error) in [
            (&[0x09, 0, 0][..], WireError::WireType(1)),
            (&[0x0a, 200][..], WireError::Truncated),
            (&[0x0a, 5, 0x09][..], WireError::Truncated),
            (&[0x0a, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0x01][..], WireError::Truncated),
            (&[0x20, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff][..], WireError::Varint),
            (&[0x21, 0, 0, 0, 0, 0, 0, 0, 0][..], WireError::WireType(4)),
            (&[0x00, 0x00][..], WireError::Varint),
            (&[0x9b, 0x06][..], WireError::Truncated),
            (&[0x9c, 0x06][..], WireError::Group),
            (&[0x9b, 0x06, 0xa4, 0x06][..], WireError::Group),
            (&[0x9e, 0x06][..], WireError::WireType(99)),
        ] {
            assert_eq!(decode("/dws", message), Err(error), "{message:02x?}");
        }
    }

    #[test]
    fn non_finite_values_pass_and_are_counted() {
        let mut message = vec![0x0a, 18, 0x09];
        message.extend(f64::NAN.to_le_bytes());
        message.push(0x11);
        message.extend(f64::NEG_INFINITY.to_le_bytes());
        let (values, non_finite) = decode("/dws", &message).unwrap();
        assert_eq!(non_finite, 2);
        assert_eq!(values[1], f64::NEG_INFINITY);
    }
}
