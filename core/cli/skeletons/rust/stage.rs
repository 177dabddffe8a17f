//! Stage `{{NAME}}`: a column of the grid times a factor, and how many rows it has seen.
//!
//! The lines to change for another stage are marked with CHANGE.

use dragfree_sdk::prelude::*;

struct Columns {
    read: In,
    table: Table,
    written: Out,
}

struct Scaled {
    factor: f64,
    rows: u64,
    columns: Option<Columns>,
}

impl Stage for Scaled {
    const MANIFEST: Manifest = Manifest {
        id: "{{NAME}}",
        version: env!("CARGO_PKG_VERSION"),
        licence: "MIT OR Apache-2.0",
        // CHANGE: one sentence.
        description: "Scales the first test mass's displacement along y",
        // CHANGE: every parameter with unit, default, range and help; a pipeline that gives another key is refused.
        parameters: &[Parameter::f64("factor", "1", 2.0, -1e3..=1e3, "what the displacement is multiplied by")],
        instances: &[],
        needs: &[],
    };

    fn new(setup: &Setup) -> Result<Self, PluginError> {
        Ok(Self { factor: setup.f64("factor")?, rows: 0, columns: None })
    }

    fn link(&mut self, available: &Available, link: &mut Link<'_>) -> Result<(), PluginError> {
        // CHANGE: what is read, with the unit and the frame that the stage is written for; the host refuses another.
        let read = link.read(&Want::new("is.tm1.r_orf_m.y").table("grid").unit("m").frame("ORF_1"))?;
        let rate_hz = available.columns.iter().filter(|c| c.table == "grid").map(|c| c.rate_hz).fold(0.0, f64::max);
        let table = link.table("{{NAME}}", rate_hz);
        // CHANGE: what is written. The attribute `archive` puts the table beside the product.
        let written = link.write_with(table, "tm1.scaled_orf_m.y", "m", "ORF_1", &[("archive", "true")])?;
        self.columns = Some(Columns { read, table, written });
        Ok(())
    }

    fn process(&mut self, input: &Inputs<'_>, output: &mut Outputs) -> Result<(), PluginError> {
        let Some(columns) = &self.columns else { return Err(PluginError::fatal("called before it was linked")) };
        self.rows += input.rows() as u64;
        output.time(columns.table).extend_from_slice(input.time_ns());
        // CHANGE: the work, a value a row; it must not depend on where a batch ends.
        output.f64(columns.written).extend(input.f64(columns.read).iter().map(|x| self.factor * x));
        Ok(())
    }

    fn report(&mut self, _earlier: &[Report]) -> Result<Report, PluginError> {
        Ok(Report { counts: [("rows".to_owned(), self.rows)].into(), ..Report::default() })
    }

    fn state(&mut self, state: &mut State<'_>) -> Result<(), PluginError> {
        // CHANGE: everything that the next row depends on, for saving and for loading.
        Ok(state.u64(&mut self.rows)?)
    }
}

export_plugin!(stages: [Scaled]);
