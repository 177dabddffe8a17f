//! A stage with a parameter and an effect, from the skeletons of `dragfree plugins new`.

use dragfree_sdk::prelude::*;

/// What a saved state begins with.
const STATE: &[u8; 8] = b"v1scale1";

struct Columns {
    read: In,
    table: Table,
    written: Out,
}

/// A column of the grid times a factor; reports the sum of what it wrote and which reports came before its own.
struct Scaled {
    factor: f64,
    rows: u64,
    sum_m: f64,
    columns: Option<Columns>,
}

impl Stage for Scaled {
    const MANIFEST: Manifest = Manifest {
        id: "v1-rust-scale",
        version: env!("CARGO_PKG_VERSION"),
        licence: "MIT OR Apache-2.0",
        description: "Scales the first test mass's displacement along y",
        parameters: &[Parameter::f64("factor", "1", 2.0, -1e3..=1e3, "what the displacement is multiplied by")],
        instances: &[],
        needs: &[],
    };

    fn new(setup: &Setup) -> Result<Self, PluginError> {
        setup.log().message(dragfree_sdk::Level::Info, "v1-rust-scale is alive");
        Ok(Self { factor: setup.f64("factor")?, rows: 0, sum_m: 0.0, columns: None })
    }

    fn link(&mut self, available: &Available, link: &mut Link<'_>) -> Result<(), PluginError> {
        let read = link.read(&Want::new("is.tm1.r_orf_m.y").table("grid").unit("m").frame("ORF_1"))?;
        let rate_hz = available.columns.iter().filter(|c| c.table == "grid").map(|c| c.rate_hz).fold(0.0, f64::max);
        let table = link.table("v1-rust-scale", rate_hz);
        let written = link.write_with(table, "tm1.scaled_orf_m.y", "m", "ORF_1", &[("archive", "true")])?;
        self.columns = Some(Columns { read, table, written });
        Ok(())
    }

    fn process(&mut self, input: &Inputs<'_>, output: &mut Outputs) -> Result<(), PluginError> {
        let Some(columns) = &self.columns else { return Err(PluginError::fatal("called before it was linked")) };
        output.time(columns.table).extend_from_slice(input.time_ns());
        for x in input.f64(columns.read) {
            self.rows += 1;
            self.sum_m += self.factor * x;
            output.f64(columns.written).push(self.factor * x);
        }
        Ok(())
    }

    fn report(&mut self, earlier: &[Report]) -> Result<Report, PluginError> {
        let plugins: Vec<&str> = earlier.iter().map(|report| report.plugin.as_str()).collect();
        let coefficients: usize = earlier.iter().map(|report| report.coefficients.len()).sum();
        let quality = [
            ("sum_m".to_owned(), self.sum_m.into()),
            ("earlier_plugins".to_owned(), plugins.into()),
            ("earlier_coefficients".to_owned(), coefficients.into()),
        ];
        Ok(Report {
            counts: [("rows".to_owned(), self.rows)].into(),
            notes: vec!["v1-rust-scale was here".to_owned()],
            quality: quality.into_iter().collect(),
            ..Report::default()
        })
    }

    fn save(&self) -> Result<Vec<u8>, PluginError> {
        Ok([*STATE, self.rows.to_le_bytes(), self.sum_m.to_le_bytes()].concat())
    }

    fn load(&mut self, state: &[u8]) -> Result<(), PluginError> {
        let refuse = || PluginError::error(format!("{} bytes are no state of v1-rust-scale", state.len()));
        let state = state.strip_prefix(STATE).ok_or_else(refuse)?;
        let (rows, sum) = state.split_first_chunk::<8>().ok_or_else(refuse)?;
        self.rows = u64::from_le_bytes(*rows);
        self.sum_m = f64::from_le_bytes(sum.try_into().map_err(|_| refuse())?);
        Ok(())
    }
}

struct ForceColumns {
    channel: In,
    reference: Option<In>,
    acceleration: Out,
}

/// A force on one axis of one test mass in proportion to the difference of two housekeeping channels.
struct ForceByChannel {
    instance: String,
    channel: String,
    reference: String,
    mass_kg: f64,
    columns: Option<ForceColumns>,
}

impl Effect for ForceByChannel {
    const MANIFEST: Manifest = Manifest {
        id: "v1-rust-force",
        version: env!("CARGO_PKG_VERSION"),
        licence: "MIT OR Apache-2.0",
        description: "Force on a test mass in proportion to a housekeeping channel",
        parameters: &[
            Parameter::text("channel", "hk.battery_current_a", &[], "housekeeping channel that the force follows"),
            Parameter::text("reference", "", &[], "channel that is taken off it first; empty for none"),
        ],
        instances: &["tm1.x", "tm1.y", "tm1.z", "tm2.x", "tm2.y", "tm2.z"],
        needs: &[],
    };

    fn new(setup: &Setup) -> Result<Self, PluginError> {
        let instance = setup.instance().to_owned();
        let test_mass = instance.split('.').next().unwrap_or_default();
        let mission: serde_json::Value = serde_json::from_str(setup.mission_json())?;
        let mass_kg = mission["test_mass"][test_mass]["mass_kg"].as_f64();
        let mass_kg = mass_kg.ok_or_else(|| PluginError::error(format!("the mission has no test mass {test_mass}")))?;
        Ok(Self { channel: setup.text("channel")?, reference: setup.text("reference")?, mass_kg, instance, columns: None })
    }

    fn link(&mut self, available: &Available, link: &mut EffectLink<'_, '_>) -> Result<(), PluginError> {
        let channel = link.read(&Want::new(&self.channel).table("grid"))?;
        let unit = available.columns.iter().find(|c| c.table == "grid" && c.name == self.channel);
        let unit = unit.map_or("1", |c| c.unit.as_str());
        let reference = match self.reference.as_str() {
            "" => None,
            name => Some(link.read(&Want::new(name).table("grid").unit(unit))?),
        };
        let name = format!("{}.{}", Self::MANIFEST.id, self.instance);
        let (test_mass, axis) = self.instance.split_once('.').unwrap_or((&self.instance, "x"));
        link.coefficient(&Coefficient {
            name: name.clone(),
            unit: format!("N ({unit})-1"),
            frame: if test_mass == "tm1" { "ORF_1".to_owned() } else { "ORF_2".to_owned() },
            lower: -1e-6,
            upper: 1e-6,
            prior_sigma: 1e-7,
            ..Coefficient::default()
        })?;
        let acceleration = link.regressor(&name, &format!("{test_mass}.accel.{axis}"), "m s-2")?;
        self.columns = Some(ForceColumns { channel, reference, acceleration });
        Ok(())
    }

    fn process(&mut self, input: &Inputs<'_>, output: &mut Outputs) -> Result<(), PluginError> {
        let Some(columns) = &self.columns else { return Err(PluginError::fatal("called before it was linked")) };
        let channel = input.f64(columns.channel);
        let reference = columns.reference.map(|column| input.f64(column));
        let rows = (0..input.rows()).map(|k| (channel[k] - reference.map_or(0.0, |r| r[k])) / self.mass_kg);
        output.f64(columns.acceleration).extend(rows);
        Ok(())
    }
}

export_plugin!(stages: [Scaled], effects: [ForceByChannel]);
