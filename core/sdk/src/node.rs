//! The three traits a plugin implements, and the one shape in which they cross the border.

use dragfree_schema::state::{self, State};
use dragfree_schema::{Available, Report};

use crate::batch::{Inputs, Outputs, Progress};
use crate::error::PluginError;
use crate::link::{EffectLink, Link};
use crate::manifest::Manifest;
use crate::setup::Setup;

/// A stage of the chain: columns in, columns out, a report at the end.
pub trait Stage: Sized + Send + 'static {
    /// What it is.
    const MANIFEST: Manifest;

    /// Makes an instance from checked parameters.
    ///
    /// # Errors
    /// The configuration has no sense for this stage.
    fn new(setup: &Setup) -> Result<Self, PluginError>;

    /// Says which columns are read and written.
    ///
    /// # Errors
    /// A column is missing or is another than wanted.
    fn link(&mut self, available: &Available, link: &mut Link<'_>) -> Result<(), PluginError>;

    /// One batch. Results must not depend on where batches end.
    ///
    /// # Errors
    /// See [`PluginError`].
    fn process(&mut self, input: &Inputs<'_>, output: &mut Outputs) -> Result<(), PluginError>;

    /// There will be no more input: give what a lag held back.
    ///
    /// # Errors
    /// See [`PluginError`].
    fn flush(&mut self, _output: &mut Outputs) -> Result<(), PluginError> {
        Ok(())
    }

    /// The result, once, after `flush`; `earlier` are the reports of the stages before this one.
    ///
    /// # Errors
    /// See [`PluginError`].
    fn report(&mut self, earlier: &[Report]) -> Result<Report, PluginError>;

    /// Version of what [`Self::state`] visits; raise it when that changes.
    const STATE_VERSION: u32 = 1;

    /// Visits all that the next rows depend on, in one order for saving and for loading; after an error the instance is
    /// not used any more.
    ///
    /// # Errors
    /// What is loaded does not fit this stage.
    fn state(&mut self, state: &mut State<'_>) -> Result<(), PluginError>;
}

/// A physical cause: telemetry in, regressors out, row by row.
pub trait Effect: Sized + Send + 'static {
    /// What it is; `instances` lists where it can act.
    const MANIFEST: Manifest;

    /// Makes an instance from checked parameters; `setup.instance()` says which.
    ///
    /// # Errors
    /// The configuration has no sense for this effect.
    fn new(setup: &Setup) -> Result<Self, PluginError>;

    /// Says which columns are read, which coefficients there are and on which channels they act.
    ///
    /// # Errors
    /// A column is missing or is another than wanted.
    fn link(&mut self, available: &Available, link: &mut EffectLink<'_, '_>) -> Result<(), PluginError>;

    /// One batch; gives one value per row and regressor. The times are filled in.
    ///
    /// # Errors
    /// See [`PluginError`].
    fn process(&mut self, input: &Inputs<'_>, output: &mut Outputs) -> Result<(), PluginError>;

    /// Version of what [`Self::state`] visits; raise it when that changes.
    const STATE_VERSION: u32 = 1;

    /// Visits all that the next rows depend on, in one order for saving and for loading; an effect without memory
    /// visits nothing.
    ///
    /// # Errors
    /// What is loaded does not fit this effect.
    fn state(&mut self, _state: &mut State<'_>) -> Result<(), PluginError> {
        Ok(())
    }
}

/// A source of telemetry that is no file of ours: a simulator, a mission's own format.
pub trait Source: Sized + Send + 'static {
    /// What it is.
    const MANIFEST: Manifest;

    /// Makes an instance from checked parameters, files and window.
    ///
    /// # Errors
    /// The configuration has no sense for this source.
    fn new(setup: &Setup) -> Result<Self, PluginError>;

    /// Says which tables are made. A table named `truth` is never given to a stage.
    ///
    /// # Errors
    /// A name is taken.
    fn link(&mut self, link: &mut Link<'_>) -> Result<(), PluginError>;

    /// About `rows` more epochs, ordered by time within each table.
    ///
    /// # Errors
    /// See [`PluginError`].
    fn next(&mut self, rows: usize, output: &mut Outputs) -> Result<Progress, PluginError>;

    /// What was counted and lost. `quality` may hold `time_scale`, `mission` and `spacecraft` for the file's metadata.
    ///
    /// # Errors
    /// See [`PluginError`].
    fn report(&mut self) -> Result<Report, PluginError>;

    /// Version of what [`Self::state`] visits; raise it when that changes.
    const STATE_VERSION: u32 = 1;

    /// Visits all that the next rows depend on, in one order for saving and for loading; after an error the instance is
    /// not used any more.
    ///
    /// # Errors
    /// What is loaded does not fit this source.
    fn state(&mut self, state: &mut State<'_>) -> Result<(), PluginError>;
}

/// What the border calls.
pub(crate) trait Node: Send {
    fn link(&mut self, available: &Available, link: &mut Link<'_>) -> Result<(), PluginError>;
    fn process(&mut self, input: &Inputs<'_>, output: &mut Outputs) -> Result<(), PluginError>;
    fn next(&mut self, rows: usize, output: &mut Outputs) -> Result<Progress, PluginError>;
    fn flush(&mut self, output: &mut Outputs) -> Result<(), PluginError>;
    fn report(&mut self, earlier: &[Report]) -> Result<Report, PluginError>;
    fn save(&mut self) -> Result<Vec<u8>, PluginError>;
    fn load(&mut self, bytes: &[u8]) -> Result<(), PluginError>;
}

pub(crate) struct StageNode<T>(pub(crate) T);
pub(crate) struct EffectNode<T> {
    pub(crate) effect: T,
    pub(crate) instance: String,
}
pub(crate) struct SourceNode<T>(pub(crate) T);

fn not_for(kind: &str, call: &str) -> PluginError {
    PluginError::fatal(format!("a {kind} has no `{call}`; the host called a function that its kind does not offer"))
}

impl<T: Stage> Node for StageNode<T> {
    fn link(&mut self, available: &Available, link: &mut Link<'_>) -> Result<(), PluginError> {
        self.0.link(available, link)
    }
    fn process(&mut self, input: &Inputs<'_>, output: &mut Outputs) -> Result<(), PluginError> {
        self.0.process(input, output)
    }
    fn next(&mut self, _rows: usize, _output: &mut Outputs) -> Result<Progress, PluginError> {
        Err(not_for("stage", "next"))
    }
    fn flush(&mut self, output: &mut Outputs) -> Result<(), PluginError> {
        self.0.flush(output)
    }
    fn report(&mut self, earlier: &[Report]) -> Result<Report, PluginError> {
        self.0.report(earlier)
    }
    fn save(&mut self) -> Result<Vec<u8>, PluginError> {
        state::save(T::MANIFEST.id, T::STATE_VERSION, |state| self.0.state(state))
    }
    fn load(&mut self, bytes: &[u8]) -> Result<(), PluginError> {
        state::load(T::MANIFEST.id, T::STATE_VERSION, bytes, |state| self.0.state(state))
    }
}

impl<T: Effect> Node for EffectNode<T> {
    fn link(&mut self, available: &Available, link: &mut Link<'_>) -> Result<(), PluginError> {
        // All uniform tables share one grid; its rate is the regressors' rate.
        let rate_hz = available.columns.iter().map(|c| c.rate_hz).fold(0.0, f64::max);
        self.effect.link(available, &mut EffectLink::new(link, T::MANIFEST.id, &self.instance, rate_hz))?;
        // One that acts through the series of others alone has no table.
        link.written.retain(|table| !table.columns.is_empty());
        Ok(())
    }
    fn process(&mut self, input: &Inputs<'_>, output: &mut Outputs) -> Result<(), PluginError> {
        if let Some(table) = output.tables.first_mut() {
            table.time_ns.extend_from_slice(input.time_ns());
        }
        self.effect.process(input, output)
    }
    fn next(&mut self, _rows: usize, _output: &mut Outputs) -> Result<Progress, PluginError> {
        Err(not_for("effect", "next"))
    }
    fn flush(&mut self, _output: &mut Outputs) -> Result<(), PluginError> {
        Ok(())
    }
    fn report(&mut self, _earlier: &[Report]) -> Result<Report, PluginError> {
        Ok(Report::default())
    }
    fn save(&mut self) -> Result<Vec<u8>, PluginError> {
        let name = format!("{}:{}", T::MANIFEST.id, self.instance);
        state::save(&name, T::STATE_VERSION, |state| self.effect.state(state))
    }
    fn load(&mut self, bytes: &[u8]) -> Result<(), PluginError> {
        let name = format!("{}:{}", T::MANIFEST.id, self.instance);
        state::load(&name, T::STATE_VERSION, bytes, |state| self.effect.state(state))
    }
}

impl<T: Source> Node for SourceNode<T> {
    fn link(&mut self, _available: &Available, link: &mut Link<'_>) -> Result<(), PluginError> {
        self.0.link(link)
    }
    fn process(&mut self, _input: &Inputs<'_>, _output: &mut Outputs) -> Result<(), PluginError> {
        Err(not_for("source", "process"))
    }
    fn next(&mut self, rows: usize, output: &mut Outputs) -> Result<Progress, PluginError> {
        self.0.next(rows, output)
    }
    fn flush(&mut self, _output: &mut Outputs) -> Result<(), PluginError> {
        Ok(())
    }
    fn report(&mut self, _earlier: &[Report]) -> Result<Report, PluginError> {
        self.0.report()
    }
    fn save(&mut self) -> Result<Vec<u8>, PluginError> {
        state::save(T::MANIFEST.id, T::STATE_VERSION, |state| self.0.state(state))
    }
    fn load(&mut self, bytes: &[u8]) -> Result<(), PluginError> {
        state::load(T::MANIFEST.id, T::STATE_VERSION, bytes, |state| self.0.state(state))
    }
}
