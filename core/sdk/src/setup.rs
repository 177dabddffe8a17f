//! What an instance is made from.

use dragfree_abi as abi;
use dragfree_schema::Settings;
use serde::Deserialize;
use std::ffi::{CString, c_void};
use std::path::PathBuf;

use crate::error::PluginError;

/// Parameters, mission, and for sources files and window. Everything declared in the manifest is there: the host
/// checked the values and filled in the defaults.
#[derive(Clone, Debug)]
pub struct Setup {
    config: Config,
    mission_json: String,
    log: Log,
}

#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default)]
struct Config {
    parameters: serde_json::Map<String, serde_json::Value>,
    mission: serde_json::Value,
    instance: String,
    candidate: bool,
    needs: Vec<String>,
    settings: Settings,
    threads: Option<usize>,
    files: Vec<PathBuf>,
    start_ns: Option<i64>,
    end_ns: Option<i64>,
}

/// Sends messages to the host.
#[derive(Clone, Copy, Debug)]
pub struct Log {
    context: *mut c_void,
    write: Option<unsafe extern "C" fn(*mut c_void, i32, *const std::ffi::c_char)>,
}

// SAFETY: the header promises that the host's functions may be called from any thread as long as the instance lives,
// and the context is the host's own, never touched here.
#[allow(unsafe_code, reason = "the host's context crosses threads with the instance")]
unsafe impl Send for Log {}
// SAFETY: as above.
#[allow(unsafe_code, reason = "the host's context crosses threads with the instance")]
unsafe impl Sync for Log {}

/// How much a message matters.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Level {
    /// Something failed.
    Error,
    /// Something is odd.
    Warn,
    /// Something worth knowing.
    Info,
    /// Something for developers.
    Debug,
}

impl Log {
    /// Sends one message.
    #[allow(unsafe_code, reason = "calls the host's log function")]
    pub fn message(&self, level: Level, text: &str) {
        let Some(write) = self.write else { return };
        let level = match level {
            Level::Error => abi::LOG_ERROR,
            Level::Warn => abi::LOG_WARN,
            Level::Info => abi::LOG_INFO,
            Level::Debug => abi::LOG_DEBUG,
        };
        if let Ok(text) = CString::new(text.replace('\0', "?")) {
            // SAFETY: the host gave this function with this context; both live as long as the instance, and the text
            // lives during the call.
            unsafe { write(self.context, level, text.as_ptr()) }
        }
    }
}

impl Setup {
    pub(crate) fn parse(json: &str, host: Option<&abi::HostV1>) -> Result<Self, PluginError> {
        let mut config: Config = serde_json::from_str(json)?;
        let mission_json = config.mission.take().to_string();
        let log = Log { context: host.map_or(std::ptr::null_mut(), |h| h.context), write: host.map(|h| h.log) };
        Ok(Self { config, mission_json, log })
    }

    /// A setup for a plugin's own tests: the JSON object that the border would carry.
    ///
    /// # Errors
    /// The text is no such object.
    pub fn for_tests(json: &str) -> Result<Self, PluginError> {
        Self::parse(json, None)
    }

    fn parameter(&self, name: &str) -> Result<&serde_json::Value, PluginError> {
        self.config.parameters.get(name).ok_or_else(|| {
            PluginError::error(format!("parameter {name} is not declared in the manifest; declare it there"))
        })
    }

    fn typed<T: serde::de::DeserializeOwned>(&self, name: &str) -> Result<T, PluginError> {
        serde_json::from_value(self.parameter(name)?.clone())
            .map_err(|e| PluginError::error(format!("parameter {name}: {e}; its declared type is another")))
    }

    /// A number.
    ///
    /// # Errors
    /// The manifest declares no such number.
    pub fn f64(&self, name: &str) -> Result<f64, PluginError> {
        self.typed(name)
    }

    /// A whole number.
    ///
    /// # Errors
    /// The manifest declares no such number.
    pub fn i64(&self, name: &str) -> Result<i64, PluginError> {
        self.typed(name)
    }

    /// A switch.
    ///
    /// # Errors
    /// The manifest declares no such switch.
    pub fn bool(&self, name: &str) -> Result<bool, PluginError> {
        self.typed(name)
    }

    /// A text.
    ///
    /// # Errors
    /// The manifest declares no such text.
    pub fn text(&self, name: &str) -> Result<String, PluginError> {
        self.typed(name)
    }

    /// A list of numbers.
    ///
    /// # Errors
    /// The manifest declares no such list.
    pub fn f64_list(&self, name: &str) -> Result<Vec<f64>, PluginError> {
        self.typed(name)
    }

    /// A list of texts.
    ///
    /// # Errors
    /// The manifest declares no such list.
    pub fn text_list(&self, name: &str) -> Result<Vec<String>, PluginError> {
        self.typed(name)
    }

    /// The mission file as JSON.
    #[must_use]
    pub fn mission_json(&self) -> &str {
        &self.mission_json
    }

    /// Effects: which instance.
    #[must_use]
    pub fn instance(&self) -> &str {
        &self.config.instance
    }

    /// Effects: whether this instance is not in the model and only asks to be: it then declares [`crate::Variant`]s,
    /// one for each value that its shape parameters may have, in place of the one that its parameters name.
    #[must_use]
    pub fn candidate(&self) -> bool {
        self.config.candidate
    }

    /// Stages: whether an effect after this one needs what the stage calls `name`, and makes only on demand.
    #[must_use]
    pub fn needs(&self, name: &str) -> bool {
        self.config.needs.iter().any(|n| n == name)
    }

    /// Thresholds: those of the pipeline file's table `[settings]`, or the defaults.
    #[must_use]
    pub fn settings(&self) -> &Settings {
        &self.config.settings
    }

    /// Threads that an instance may use, itself included; results must not depend on it.
    #[must_use]
    pub fn threads(&self) -> usize {
        self.config.threads.unwrap_or(1).max(1)
    }

    /// Sources: the files of the run.
    #[must_use]
    pub fn files(&self) -> &[PathBuf] {
        &self.config.files
    }

    /// Sources: first time wanted, Unix ns. Stages and effects: first time of the product, where rows before it come in
    /// that only settle what goes on with them; `None` where every row belongs to the product.
    #[must_use]
    pub fn start_ns(&self) -> Option<i64> {
        self.config.start_ns
    }

    /// Sources: end of the time wanted, Unix ns, exclusive.
    #[must_use]
    pub fn end_ns(&self) -> Option<i64> {
        self.config.end_ns
    }

    /// Where messages go.
    #[must_use]
    pub fn log(&self) -> Log {
        self.log
    }
}
