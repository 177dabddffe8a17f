//! Runs an effect through the plugin interface: columns in, and the declared contribution to each channel out.

use dragfree_engine::border::{Config, Instance, Kind, Library, LinkRequest, Linked, Rows};
use dragfree_engine::table::Column;
use dragfree_physics::mission::Mission;
use serde_json::{Map, Value, json};
use std::collections::BTreeMap;

pub(crate) const DT_S: f64 = 0.1;
pub(crate) const START_NS: i64 = 2_051_222_400_000_000_000;
pub(crate) const AXES: [&str; 3] = ["x", "y", "z"];

fn library() -> Library {
    let program = std::env::current_exe().expect("a test program has a path");
    let folder = program.parent().expect("target/PROFILE/deps/test");
    let name = format!("{}dragfree_effects{}", std::env::consts::DLL_PREFIX, std::env::consts::DLL_SUFFIX);
    Library::open(&folder.join(name)).expect("cargo builds the library before its tests")
}

pub(crate) fn mission_json() -> Value {
    toml::from_str(include_str!("../../../../fixtures/missions/taiji.toml")).expect("the fixture is TOML")
}

pub(crate) fn mission() -> Mission {
    Mission::from_json(&mission_json().to_string()).expect("the fixture is a mission")
}

pub(crate) fn times(rows: usize) -> Vec<i64> {
    (0..rows as i64).map(|k| START_NS + k * 100_000_000).collect()
}

/// Columns with their rows; columns that no test fills are zero.
#[derive(Clone)]
pub(crate) struct Telemetry {
    pub(crate) columns: Vec<Column>,
    pub(crate) rows: Vec<Vec<f64>>,
    pub(crate) time_ns: Vec<i64>,
}

impl Telemetry {
    /// The nine channels, other columns of hinf-dfacs, and housekeeping with the given names and units.
    pub(crate) fn new(rows: usize, housekeeping: &[(&str, &str)]) -> Self {
        let mut telemetry = Self { columns: Vec::new(), rows: Vec::new(), time_ns: times(rows) };
        for (vector, unit, frame) in [
            ("tm1.accel", "m s-2", "ORF_1"),
            ("tm2.accel", "m s-2", "ORF_2"),
            ("sc.alpha", "rad s-2", "SRF"),
            ("sc.alpha_srf_rad_s2", "rad s-2", "SRF"),
            ("sc.omega_srf_rad_s", "rad s-1", "SRF"),
            ("tm1.r_orf_m", "m", "ORF_1"),
            ("used.mps_force_srf_n", "N", "SRF"),
            ("used.mps_torque_srf_nm", "N m", "SRF"),
            ("used.tm1.force_orf_n", "N", "ORF_1"),
            ("used.tm2.force_orf_n", "N", "ORF_2"),
            ("used.sun_srf", "1", "SRF"),
        ] {
            let channel = ["tm1.accel", "tm2.accel", "sc.alpha"].contains(&vector);
            for axis in AXES {
                let attributes: BTreeMap<String, String> = if channel {
                    [("kind", "channel"), ("average", "2")].map(|(k, v)| (k.to_owned(), v.to_owned())).into()
                } else {
                    BTreeMap::new()
                };
                telemetry.add("reconstruction", &format!("{vector}.{axis}"), unit, frame, attributes);
            }
        }
        for (name, unit) in housekeeping {
            telemetry.add("grid", name, unit, "", BTreeMap::new());
        }
        telemetry
    }

    pub(crate) fn add(
        &mut self,
        table: &str,
        name: &str,
        unit: &str,
        frame: &str,
        attributes: BTreeMap<String, String>,
    ) {
        let [table, name, unit, frame] = [table, name, unit, frame].map(str::to_owned);
        self.columns.push(Column { table, name, unit, frame, rate_hz: 10.0, attributes });
        self.rows.push(vec![0.0; self.time_ns.len()]);
    }

    pub(crate) fn fill(&mut self, name: &str, value: impl Fn(f64) -> f64) {
        let i = self.columns.iter().position(|c| c.name == name).unwrap_or_else(|| panic!("no column {name}"));
        self.rows[i] = (0..self.time_ns.len()).map(|k| value(DT_S * k as f64)).collect();
    }

    pub(crate) fn row(&self, name: &str) -> &[f64] {
        &self.rows[self.columns.iter().position(|c| c.name == name).unwrap_or_else(|| panic!("no column {name}"))]
    }

    /// Creates and links an effect.
    pub(crate) fn link(
        &self,
        id: &str,
        instance: &str,
        parameters: Value,
        candidate: bool,
    ) -> Result<(Instance, Linked), String> {
        let library = library();
        let plugin = library
            .plugins
            .iter()
            .find(|p| p.kind == Kind::Effect && p.manifest.id == id)
            .expect("the library contains the effect");
        let mut all: Map<String, Value> =
            plugin.manifest.parameters.iter().map(|p| (p.name.clone(), p.default.clone())).collect();
        if let Value::Object(given) = parameters {
            all.extend(given);
        }
        let value = json!({
            "parameters": all, "mission": mission_json(), "instance": instance, "candidate": candidate, "needs": ["commands"],
        });
        let mut effect = Instance::create(&library, plugin, &Config { value }).map_err(|e| e.to_string())?;
        let request = LinkRequest { available: &self.columns, model_json: r#"{"coefficients":[],"constraints":[]}"# };
        let linked = effect.link(request).map_err(|e| e.to_string())?;
        effect.activate(65_536).map_err(|e| e.to_string())?;
        Ok((effect, linked))
    }

    /// Series of the effect over rows `from..to`.
    pub(crate) fn process(&self, effect: &mut Instance, linked: &Linked, from: usize, to: usize) -> Vec<Vec<f64>> {
        let input: Vec<Rows<'_>> = linked
            .reads
            .iter()
            .map(|table| Rows {
                time_ns: &self.time_ns[from..to],
                columns: table.iter().map(|r| &self.rows[r.available][from..to]).collect(),
            })
            .collect();
        if input.is_empty() {
            return Vec::new();
        }
        let made = effect.process(&input, i64::MAX).expect("processed").expect("nothing is discarded");
        made.into_iter().flat_map(|batch| batch.columns).collect()
    }

    /// Contribution of an effect to each channel for given values of its coefficients, by the last part of their names
    /// (empty for the only coefficient).
    pub(crate) fn added(
        &self,
        id: &str,
        instance: &str,
        parameters: Value,
        values: &[(&str, f64)],
    ) -> BTreeMap<String, Vec<f64>> {
        let (mut effect, linked) = self.link(id, instance, parameters, false).unwrap_or_else(|e| panic!("{e}"));
        let made = self.process(&mut effect, &linked, 0, self.time_ns.len());
        let written: Vec<&Column> = linked.writes.iter().flat_map(|t| &t.columns).collect();
        let series = |table: &str, name: &str| {
            let own = written.iter().position(|c| c.table == table && c.name == name).map(|i| &made[i]);
            let input = || self.columns.iter().position(|c| c.table == table && c.name == name).map(|i| &self.rows[i]);
            own.or_else(input).unwrap_or_else(|| panic!("no series {name} in {table}")).clone()
        };
        let mut added: BTreeMap<String, Vec<f64>> = BTreeMap::new();
        assert_eq!(linked.coefficients.len(), values.len(), "{:?}", linked.coefficients);
        for (last, value) in values {
            let name = format!("{id}.{instance}{}{last}", if last.is_empty() { "" } else { "." });
            let coefficient = linked.coefficients.iter().find(|c| c.name == name);
            let coefficient = coefficient.unwrap_or_else(|| panic!("no {name} in {:?}", linked.coefficients));
            let range = coefficient.lower..=coefficient.upper;
            assert!(range.contains(value), "{name} = {value} is out of range");
            for response in &coefficient.responses {
                let column = series(&response.table, &response.series);
                let sum = added.entry(response.channel.clone()).or_insert_with(|| vec![0.0; column.len()]);
                sum.iter_mut().zip(column).for_each(|(s, x)| *s += value * response.factor * x);
            }
        }
        added
    }
}

/// Largest difference, relative to the largest expected value.
pub(crate) fn relative_difference(got: &[f64], want: &[f64]) -> f64 {
    assert_eq!(got.len(), want.len());
    let most = |x: f64, y: f64| if y.is_nan() { f64::INFINITY } else { x.max(y) };
    let scale = want.iter().map(|x| x.abs()).fold(0.0, most);
    got.iter().zip(want).map(|(a, b)| (a - b).abs()).fold(0.0, most) / scale
}
