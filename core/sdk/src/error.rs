//! What a plugin says when it cannot go on.

use dragfree_abi as abi;

/// A failure, with what the host should do about it.
///
/// The text says what went wrong, where, why, and what to do next. Like `anyhow::Error` it is no `std::error::Error`
/// itself, so that `?` turns every such error into one; those become [`PluginError::error`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PluginError {
    pub(crate) status: abi::Status,
    pub(crate) message: String,
}

impl PluginError {
    /// The call failed; the instance can come back only from a snapshot.
    pub fn error(message: impl Into<String>) -> Self {
        Self { status: abi::ERROR, message: message.into() }
    }

    /// The same as [`PluginError::error`].
    pub fn new(message: impl Into<String>) -> Self {
        Self::error(message)
    }

    /// This batch gives nothing; the instance is as it was before the call.
    pub fn discard(message: impl Into<String>) -> Self {
        Self { status: abi::DISCARD, message: message.into() }
    }

    /// The instance must never be called again.
    pub fn fatal(message: impl Into<String>) -> Self {
        Self { status: abi::FATAL, message: message.into() }
    }

    /// What the host's answer means; `sentence` is for the case that the host said nothing itself.
    pub(crate) fn unless_ok(status: abi::Status, sentence: impl FnOnce() -> String) -> Result<(), Self> {
        if status == abi::OK { Ok(()) } else { Err(Self { status, message: sentence() }) }
    }

    /// The text.
    #[must_use]
    pub fn message(&self) -> &str {
        &self.message
    }
}

impl<E: std::error::Error> From<E> for PluginError {
    fn from(error: E) -> Self {
        let mut message = error.to_string();
        let mut source = error.source();
        while let Some(cause) = source {
            let text = cause.to_string();
            if !message.contains(&text) {
                message.push_str(": ");
                message.push_str(&text);
            }
            source = cause.source();
        }
        Self::error(message)
    }
}
