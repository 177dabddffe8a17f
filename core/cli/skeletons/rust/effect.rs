//! Effect `{{NAME}}`: a force on a test mass that is proportional to a housekeeping channel.
//!
//! The lines to change for another cause are marked with CHANGE.

use dragfree_sdk::prelude::*;

/// Axes of a test mass's frame.
const AXES: [&str; 3] = ["x", "y", "z"];

/// CHANGE: the physical range of the coefficient, N per unit of the channel. The solution never leaves it, so a
/// coefficient that ends at it says that the cause is another.
const RANGE: f64 = 1e-6;

/// CHANGE: how far from zero the coefficient is expected before any data, N per unit of the channel: one standard
/// deviation.
const PRIOR_SIGMA: f64 = 1e-7;

struct Columns {
    channel: In,
    reference: Option<In>,
    acceleration: Out,
}

/// One instance: one axis of one test mass.
struct ForceByChannel {
    /// `tm1.x`
    instance: String,
    channel: String,
    reference: String,
    mass_kg: f64,
    columns: Option<Columns>,
}

impl Effect for ForceByChannel {
    const MANIFEST: Manifest = Manifest {
        id: "{{NAME}}",
        version: env!("CARGO_PKG_VERSION"),
        licence: "MIT OR Apache-2.0",
        // CHANGE: one sentence.
        description: "Force on a test mass in proportion to a housekeeping channel",
        // CHANGE: every parameter with unit, default, range and help; a model that gives another key is refused.
        parameters: &[
            Parameter::text("channel", "hk.battery_current_a", &[], "housekeeping channel that the force follows, hk.NAME"),
            Parameter::text("reference", "", &[], "channel that is taken off it first, in the same unit; empty for none"),
        ],
        // CHANGE: where it can act; `{test_mass}` stands for each test mass of the mission.
        instances: &["{test_mass}.x", "{test_mass}.y", "{test_mass}.z"],
        needs: &[],
    };

    fn new(setup: &Setup) -> Result<Self, PluginError> {
        let instance = setup.instance().to_owned();
        let test_mass = instance.split('.').next().unwrap_or_default();
        // The mission file as JSON: whatever the effect needs to know of the spacecraft is there.
        let mission: serde_json::Value = serde_json::from_str(setup.mission_json())?;
        let mass_kg = mission["test_mass"][test_mass]["mass_kg"].as_f64();
        let mass_kg = mass_kg.ok_or_else(|| PluginError::error(format!("the mission has no test mass {test_mass}")))?;
        Ok(Self { channel: setup.text("channel")?, reference: setup.text("reference")?, mass_kg, instance, columns: None })
    }

    fn link(&mut self, available: &Available, link: &mut EffectLink<'_, '_>) -> Result<(), PluginError> {
        // Table `grid`: what the preprocessing stage has brought onto one grid of epochs.
        let channel = link.read(&Want::new(&self.channel).table("grid"))?;
        let unit = available.columns.iter().find(|c| c.table == "grid" && c.name == self.channel).map_or("1", |c| c.unit.as_str());
        let reference = match self.reference.as_str() {
            "" => None,
            name => Some(link.read(&Want::new(name).table("grid").unit(unit))?),
        };
        // A coefficient is called ID.INSTANCE, or ID.INSTANCE.NAME where an instance has several.
        let name = format!("{}.{}", Self::MANIFEST.id, self.instance);
        // CHANGE: the channels in which it shows, a column each. Channels hold measured minus known acceleration:
        // `NAME.accel.x` to `NAME.accel.z` of a test mass in m s⁻², `sc.alpha.x` to `sc.alpha.z` in rad s⁻².
        let (test_mass, axis) = self.instance.split_once('.').unwrap_or((&self.instance, AXES[0]));
        let shown = format!("{test_mass}.accel.{axis}");
        link.coefficient(&Coefficient {
            name: name.clone(),
            // CHANGE: the unit of the coefficient.
            unit: format!("N ({unit})-1"),
            frame: available.find(&shown).map_or_else(String::new, |c| c.frame.clone()),
            lower: -RANGE,
            upper: RANGE,
            prior_sigma: PRIOR_SIGMA,
            ..Coefficient::default()
        })?;
        let acceleration = link.regressor(&name, &shown, "m s-2")?;
        self.columns = Some(Columns { channel, reference, acceleration });
        Ok(())
    }

    fn process(&mut self, input: &Inputs<'_>, output: &mut Outputs) -> Result<(), PluginError> {
        let Some(columns) = &self.columns else { return Err(PluginError::fatal("called before it was linked")) };
        let channel = input.f64(columns.channel);
        let reference = columns.reference.map(|column| input.f64(column));
        // CHANGE: the acceleration that one unit of the coefficient adds, m s⁻², one value a row: the mean from the
        // row's time to the next row's. No value of the channel, NaN, gives no value here.
        let rows = (0..input.rows()).map(|k| (channel[k] - reference.map_or(0.0, |r| r[k])) / self.mass_kg);
        output.f64(columns.acceleration).extend(rows);
        Ok(())
    }

    // An effect with a memory, a lag or an integral, also has `state`, which visits it for saving and loading.
}

export_plugin!(effects: [ForceByChannel]);
