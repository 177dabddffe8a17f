//! Many numbers in a JSON document: their bytes, little-endian, as base64. Decimal digits would take twice the room.

use data_encoding::BASE64;
use serde::{Deserialize as _, Deserializer, Serializer, de::Error as _};

fn bytes<'de, D: Deserializer<'de>>(from: D) -> Result<Vec<u8>, D::Error> {
    BASE64.decode(String::deserialize(from)?.as_bytes()).map_err(D::Error::custom)
}

/// Numbers of 32 bits.
pub(crate) mod singles {
    use super::{BASE64, Deserializer, Serializer, bytes};
    use serde::de::Error as _;

    pub(crate) fn serialize<S: Serializer>(numbers: &[f32], to: S) -> Result<S::Ok, S::Error> {
        let bytes: Vec<u8> = numbers.iter().flat_map(|x| x.to_le_bytes()).collect();
        to.serialize_str(&BASE64.encode(&bytes))
    }

    pub(crate) fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<Vec<f32>, D::Error> {
        let bytes = bytes(from)?;
        let (all, rest) = bytes.as_chunks();
        match rest {
            [] => Ok(all.iter().map(|b| f32::from_le_bytes(*b)).collect()),
            _ => Err(D::Error::custom("half a number")),
        }
    }
}

/// Numbers of 64 bits.
pub(crate) mod doubles {
    use super::{BASE64, Deserializer, Serializer, bytes};
    use serde::de::Error as _;

    pub(crate) fn serialize<S: Serializer>(numbers: &[f64], to: S) -> Result<S::Ok, S::Error> {
        let bytes: Vec<u8> = numbers.iter().flat_map(|x| x.to_le_bytes()).collect();
        to.serialize_str(&BASE64.encode(&bytes))
    }

    pub(crate) fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<Vec<f64>, D::Error> {
        let bytes = bytes(from)?;
        let (all, rest) = bytes.as_chunks();
        match rest {
            [] => Ok(all.iter().map(|b| f64::from_le_bytes(*b)).collect()),
            _ => Err(D::Error::custom("half a number")),
        }
    }
}
