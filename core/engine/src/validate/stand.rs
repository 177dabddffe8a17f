//! The test environment of a plugin: the columns of a whole chain, and values for them.

use serde_json::{Map, Value};
use std::collections::BTreeMap;

use crate::border::Kind;
use crate::table::Column;
use crate::telemetry::{interface_tables, unit_and_frame};

/// First epoch, Unix ns: 2035-01-01.
pub(super) const START_NS: i64 = 2_051_222_400_000_000_000;

/// A model of one coefficient, whose columns stand in [`stands`].
pub(super) const MODEL: &str = r#"{"coefficients":[{"name":"example.tm1","effect":"example","instance":"tm1","unit":"m","frame":"ORF_1","lower":-1.0,"upper":1.0,"initial":0.0,"prior_sigma":1.0,"estimate":true}],"constraints":[]}"#;

const AXES: [&str; 3] = ["x", "y", "z"];

/// What there may be before a stage, the most first: telemetry, grid, reconstruction and regressors; without the last
/// two; telemetry alone. Before an effect there is always a reconstruction. Housekeeping is what the plugin's own text
/// parameters name, `hk.NAME` alone or in an expression, with the unit at the end of the name.
pub(super) fn stands(kind: Kind, rate_hz: f64, parameters: &Map<String, Value>) -> Vec<Vec<Column>> {
    if kind == Kind::Source {
        return vec![Vec::new()];
    }
    let raw: Vec<Column> = interface_tables().into_iter().flat_map(|t| t.columns).collect();
    let column = |table: &str, name: String, (unit, frame): (String, String), attributes: &[(&str, &str)]| Column {
        table: table.to_owned(),
        name,
        unit,
        frame,
        rate_hz,
        attributes: attributes.iter().map(|(k, v)| ((*k).to_owned(), (*v).to_owned())).collect(),
    };
    let grid = raw.iter().filter(|c| !c.unit.is_empty());
    let grid = grid.map(|c| column("grid", format!("{}.{}", c.table, c.name), (c.unit.clone(), c.frame.clone()), &[]));
    let mut grid: Vec<Column> = grid.collect();
    let mut housekeeping = Vec::new();
    let is_name = |c: char| c.is_ascii_alphanumeric() || c == '_' || c == '.';
    let words = parameters.values().filter_map(Value::as_str).flat_map(|text| text.split(|c| !is_name(c)));
    for name in words.filter_map(|word| word.strip_prefix("hk.")) {
        let unit = housekeeping_unit(name);
        if !grid.iter().any(|c| c.name == format!("hk.{name}")) {
            let meaning = (unit, String::new());
            grid.push(column("grid", format!("hk.{name}"), meaning.clone(), &[]));
            let value = column(&format!("hk/{name}"), "value".to_owned(), meaning, &[]);
            housekeeping.push(Column { rate_hz: 0.0, ..value });
        }
    }
    // Test masses of the interface with their frames.
    let displaced = raw.iter().filter_map(|c| Some((c.name.strip_suffix(".r_orf_m.x")?, c.frame.as_str())));
    let test_masses: BTreeMap<&str, &str> = displaced.collect();
    let mut reconstruction = Vec::new();
    let mut known = |name: String| {
        let meaning = unit_and_frame(&name);
        // Which of the mission's noises a displacement is read with.
        let along_x = name.ends_with(".r_orf_m.x");
        let noise = [("noise", "ifo_x")];
        reconstruction.push(column("reconstruction", name, meaning, if along_x { &noise } else { &[] }));
    };
    for axis in AXES {
        known(format!("sc.alpha_srf_rad_s2.{axis}"));
        known(format!("sc.omega_srf_rad_s.{axis}"));
        for tm in test_masses.keys() {
            known(format!("{tm}.r_orf_m.{axis}"));
            known(format!("{tm}.u_orf_m_s2.{axis}"));
        }
    }
    // What a reconstruction gives on demand (`needs`): commands as they acted, answers of α̂ to torque gains and to a
    // delay.
    let commands = ["mps_force_srf_n", "mps_torque_srf_nm", "sun_srf"].map(str::to_owned).into_iter();
    let of_tm = test_masses.keys().flat_map(|tm| ["force_orf_n", "torque_orf_nm"].map(|what| format!("{tm}.{what}")));
    for vector in commands.chain(of_tm) {
        AXES.iter().for_each(|axis| known(format!("used.{vector}.{axis}")));
    }
    for (i, j) in AXES.iter().flat_map(|i| AXES.iter().map(move |j| (i, j))) {
        known(format!("response.alpha_srf_rad_s2.by_torque_gain.{i}.{j}"));
    }
    for axis in AXES {
        let meaning = ("rad s-3".to_owned(), "SRF".to_owned());
        let name = format!("response.alpha_srf_rad_s2.by_dws_delay.{axis}");
        reconstruction.push(column("reconstruction", name, meaning, &[]));
    }
    let accelerations = test_masses.iter().map(|(tm, frame)| (*tm, "accel", "m s-2", *frame));
    for (body, quantity, unit, frame) in accelerations.chain([("sc", "alpha", "rad s-2", "SRF")]) {
        for axis in AXES {
            let name = format!("{body}.{quantity}.{axis}");
            let meaning = (unit.to_owned(), frame.to_owned());
            let attributes = [("kind", "channel"), ("channel", name.as_str()), ("average", "2")];
            reconstruction.push(column("reconstruction", name.clone(), meaning, &attributes));
        }
    }
    let regressors = AXES.map(|axis| {
        let channel = format!("tm1.accel.{axis}");
        let attributes = [
            ("kind", "regressor"),
            ("coefficient", "example.tm1"),
            ("channel", channel.as_str()),
            ("effect", "example"),
        ];
        column("effect/example:tm1", format!("example.tm1@{channel}"), ("s-2".to_owned(), String::new()), &attributes)
    });
    let telemetry = [raw, housekeeping].concat();
    let with_grid = [telemetry.clone(), grid].concat();
    let mut whole = [with_grid.clone(), reconstruction].concat();
    if kind == Kind::Effect {
        return vec![whole];
    }
    whole.extend(regressors);
    vec![whole, with_grid, telemetry]
}

/// `A` of `battery_current_a`; a housekeeping name ends with its unit.
fn housekeeping_unit(name: &str) -> String {
    match name.rsplit('_').next().unwrap_or_default() {
        letter @ ("a" | "k" | "v" | "w" | "t" | "c") => letter.to_ascii_uppercase(),
        unit @ ("kg" | "rad" | "m") => unit.to_owned(),
        "pa" => "Pa".to_owned(),
        "hz" => "Hz".to_owned(),
        _ => "1".to_owned(),
    }
}

/// A number in `0..1` that depends on all bits of `seed` (SplitMix64's mixing).
fn uniform(seed: u64) -> f64 {
    let mut z = seed.wrapping_add(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
}

/// Pseudo-random bytes.
pub(super) fn noise_bytes(count: u64) -> Vec<u8> {
    (0..count).map(|k| (256.0 * uniform(k)) as u8).collect()
}

/// What a column holds: a level, a swing and noise about as large, of a size that its unit makes likely.
#[derive(Clone, Debug)]
pub(super) struct Signal {
    level: f64,
    size: f64,
    period_s: f64,
    seed: u64,
}

impl Signal {
    pub(super) fn of(column: &Column) -> Self {
        let bytes = column.table.bytes().chain(column.name.bytes());
        let seed = bytes.fold(17u64, |hash, byte| hash.wrapping_mul(0x0100_0000_01b3) ^ u64::from(byte));
        let along_x = f64::from(u8::from(column.name.ends_with(".x")));
        let (level, size) = match (column.unit.as_str(), column.frame.as_str()) {
            ("", _) => (0.0, 0.0),
            ("m", "IRF") => (1.5e11 * along_x, 1e3),
            ("m s-1", "IRF") => (3e4 * (1.0 - along_x), 1e-3),
            ("m", _) => (0.0, 1e-9),
            ("rad", _) => (0.0, 1e-8),
            ("m s-2", _) => (0.0, 1e-10),
            ("rad s-1", _) => (0.0, 1e-8),
            ("rad s-2" | "s-2", _) => (0.0, 1e-10),
            ("N" | "N m", _) => (0.0, 1e-7),
            ("1", "SRF") => (along_x, 1e-9),
            ("K", _) => (295.0, 1e-2),
            ("kg", _) => (1.0, 1e-3),
            _ => (1.0, 0.1),
        };
        Self { level, size, period_s: 20.0 + 200.0 * uniform(seed), seed }
    }

    pub(super) fn at(&self, time_ns: i64) -> f64 {
        let turns = (time_ns - START_NS) as f64 * 1e-9 / self.period_s;
        let noise = uniform(self.seed ^ (time_ns as u64).rotate_left(17)) - 0.5;
        self.level + self.size * ((std::f64::consts::TAU * turns).sin() + noise)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_column_has_a_unit_and_a_name_of_its_own() {
        let parameters = Map::from_iter([("channel".to_owned(), Value::from("hk.battery_current_a"))]);
        let stands = stands(Kind::Stage, 10.0, &parameters);
        let mut seen = std::collections::BTreeSet::new();
        for column in &stands[0] {
            assert!(seen.insert((column.table.clone(), column.name.clone())), "{column:?}");
            assert!(!column.unit.is_empty() || column.rate_hz == 0.0, "{column:?}");
        }
        let has = |table: &str, name: &str, unit: &str| {
            stands[0].iter().any(|c| (c.table.as_str(), c.name.as_str(), c.unit.as_str()) == (table, name, unit))
        };
        assert!(has("grid", "is.tm1.r_orf_m.x", "m") && has("grid", "hk.battery_current_a", "A"));
        assert!(has("reconstruction", "sc.alpha_srf_rad_s2.z", "rad s-2") && has("hk/battery_current_a", "value", "A"));
        assert!(stands[1].iter().all(|c| c.table != "reconstruction") && stands[2].iter().all(|c| c.rate_hz == 0.0));
    }

    #[test]
    fn signals_move_about_their_level() {
        let column = &stands(Kind::Stage, 10.0, &Map::new())[0][0];
        let signal = Signal { level: 2.0, size: 0.5, ..Signal::of(column) };
        let values: Vec<f64> = (0..6000).map(|k| signal.at(START_NS + k * 100_000_000)).collect();
        let mean = values.iter().sum::<f64>() / 6000.0;
        assert!((mean - 2.0).abs() < 0.2 && values.iter().all(|x| (x - 2.0).abs() <= 0.75), "{mean}");
        assert!(values.windows(2).all(|pair| pair[0] != pair[1]));
    }
}
