//! The telemetry interface: messages of `telemetry.proto` as columns, and columns as messages.
//!
//! A reader trusts the schema *in the file*, never its own: [`Layout`] compiles a message descriptor into a walk from
//! wire bytes to flat columns with dotted paths. Only then is the layout compared with the committed interface
//! ([`check`]), so that a producer may add fields or renumber them but not drop, retype or rename one.

mod decode;
mod encode;
mod interface;
mod layout;
mod mcap_file;
mod names;
mod topic;
mod write;

pub use decode::{Cells, Decoder, WireError};
pub use encode::{EncodeError, Encoder, MessageType};
pub use interface::{Drift, check, descriptor, expected, interface_tables};
pub(crate) use interface::{TRUTH, column};
pub use layout::{Kind, Layout, LayoutError, Leaf};
pub use names::unit_and_frame;
pub use topic::{Topic, TopicError, first_message, read_topic, topics};
pub use write::{FileHeader, TelemetryWriter, WriteError};
