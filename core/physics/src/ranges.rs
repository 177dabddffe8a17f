//! Range of every number of a mission file. Beyond it a value is a slip of the unit, and would cost a program minutes,
//! gigabytes or a panic before it cost a wrong result: a rate of 1e9 Hz is a grid of 1e14 epochs a day.

use serde_json::Value;

/// Longest list under one key, and most tables in one: terms, lines, thrusters, sections.
pub(crate) const MOST_ENTRIES: usize = 64;
/// Longest text, bytes.
pub(crate) const MOST_TEXT_BYTES: usize = 200;

/// Least and greatest value by key, both possible.
const RANGES: [(&str, f64, f64); 52] = [
    ("sample_rate_hz", 0.1, 100.0),
    ("corner_hz", 0.0, 1e3),
    ("frequency_hz", 0.0, 1e3),
    ("exponent", 0.0, 8.0),
    ("asd_m_rthz", 0.0, 1.0),
    ("asd_rad_rthz", 0.0, 1.0),
    ("asd_n_rthz", 0.0, 1e3),
    ("asd_nm_rthz", 0.0, 1e3),
    ("asd_m_s2_rthz", 0.0, 1e3),
    ("asd_rad_s2_rthz", 0.0, 1e3),
    ("amplitude_m", 0.0, 1.0),
    ("amplitude_rad", 0.0, 1.0),
    ("amplitude_n", 0.0, 1e3),
    ("amplitude_nm", 0.0, 1e3),
    ("amplitude_m_s2", 0.0, 1e3),
    ("amplitude_rad_s2", 0.0, 1e3),
    ("mass_kg", 1e-3, 1e6),
    ("inertia_srf_kg_m2", -1e9, 1e9),
    ("inertia_mrf_kg_m2", -1e9, 1e9),
    ("orf_from_srf_angle_rad", -7.0, 7.0),
    ("offset_nominal_srf_m", -100.0, 100.0),
    ("offset_box_srf_m", 0.0, 100.0),
    ("stiffness_tt_orf_s2", -1.0, 1.0),
    ("stiffness_tr_orf_m_s2_rad", -1.0, 1.0),
    ("stiffness_rr_orf_s2", -1.0, 1.0),
    ("baseline_srf_m", -100.0, 100.0),
    ("baseline_tolerance_m", 0.0, 100.0),
    ("force_n", 0.0, 1e3),
    ("arm_srf_m", -100.0, 100.0),
    ("orbit_error_m", 0.0, 1e12),
    ("tm_x_m_rthz", 0.0, 1.0),
    ("tm_yz_m_rthz", 0.0, 1.0),
    ("sc_attitude_rad_rthz", 0.0, 1.0),
    ("tm_phi_rad_rthz", 0.0, 1.0),
    ("tm_theta_psi_rad_rthz", 0.0, 1.0),
    ("attitude_bandwidth_factor", 0.0, 10.0),
    ("delay_samples", 0.0, 1e3),
    ("gain_s2", -1e12, 1e12),
    ("sections", -1e12, 1e12),
    ("thrust_limit_n", 0.0, 1e6),
    ("torque_limit_nm", 0.0, 1e6),
    ("electrostatic_force_limit_n", 0.0, 1e3),
    ("electrostatic_torque_limit_nm", 0.0, 1e3),
    ("lag_s", 0.0, 1e3),
    ("delay_s", 0.0, 1e3),
    ("position_srf_m", -100.0, 100.0),
    ("direction_srf", -1e6, 1e6),
    ("acceleration_orf_m_s2", 0.0, 1.0),
    ("angular_acceleration_rad_s2", 0.0, 1.0),
    ("drift_m_s2_day", 0.0, 1.0),
    ("displacement_m", 0.0, 100.0),
    ("angle_rad", 0.0, 7.0),
];

/// Path of the first value of a mission that is beyond its range, the value, and what it must be.
pub(crate) fn beyond(mission: &Value) -> Option<(String, String, String)> {
    let tables = mission.as_object()?;
    // What missions state for their own plugins is theirs to check.
    tables.iter().filter(|(key, _)| *key != "plugin").find_map(|(key, value)| within(key, key, value))
}

fn within(path: &str, key: &str, value: &Value) -> Option<(String, String, String)> {
    let found = |value: &dyn std::fmt::Display, must: String| Some((path.to_owned(), value.to_string(), must));
    match value {
        Value::Number(number) => {
            let number = number.as_f64().unwrap_or(f64::NAN);
            let (_, least, most) = RANGES.iter().find(|(of, ..)| *of == key)?;
            let fits = (*least..=*most).contains(&number);
            if fits { None } else { found(&number, format!("must be {least} to {most}; mind the unit in the key")) }
        }
        Value::String(text) if text.len() > MOST_TEXT_BYTES => {
            found(&format!("{} bytes", text.len()), format!("must have at most {MOST_TEXT_BYTES}"))
        }
        Value::Array(items) if items.len() > MOST_ENTRIES => {
            found(&format!("{} entries", items.len()), format!("must have at most {MOST_ENTRIES}"))
        }
        Value::Array(items) => items.iter().find_map(|item| within(path, key, item)),
        Value::Object(table) if table.len() > MOST_ENTRIES => {
            found(&format!("{} keys", table.len()), format!("must have at most {MOST_ENTRIES}"))
        }
        Value::Object(table) => table.iter().find_map(|(key, value)| within(&format!("{path}.{key}"), key, value)),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mission::Mission;

    /// Keys whose range is checked elsewhere: `[thrusters]` and `[orbit]`.
    const ELSEWHERE: [&str; 5] = ["min_n", "max_n", "step_n", "trailing_angle_rad", "arm_length_m"];

    fn taiji() -> Value {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../fixtures/missions/taiji.toml");
        let table: toml::Table = std::fs::read_to_string(path).unwrap().parse().unwrap();
        serde_json::to_value(table).unwrap()
    }

    /// Every number of a mission with every optional section, by its key.
    fn numbers(key: &str, value: &Value, all: &mut Vec<String>) {
        match value {
            Value::Number(_) => all.push(key.to_owned()),
            Value::Array(items) => items.iter().for_each(|item| numbers(key, item, all)),
            Value::Object(table) => table.iter().for_each(|(key, value)| numbers(key, value, all)),
            _ => {}
        }
    }

    #[test]
    fn every_number_of_the_missions_has_a_range() {
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../fixtures/missions");
        let mut seen = 0;
        for entry in std::fs::read_dir(folder).unwrap() {
            let table: toml::Table = std::fs::read_to_string(entry.unwrap().path()).unwrap().parse().unwrap();
            let mut all = Vec::new();
            numbers("", &serde_json::to_value(table).unwrap(), &mut all);
            seen += all.len();
            for key in all {
                let known = RANGES.iter().any(|(of, ..)| *of == key) || ELSEWHERE.contains(&key.as_str());
                assert!(known, "{key} has no range");
            }
        }
        assert!(seen > 300, "{seen}");
    }

    /// 1e9 Hz aborted for want of memory, 1e5 Hz took a minute, 1e-4 Hz was a panic of the filter.
    #[test]
    fn a_sample_rate_that_no_program_can_follow_is_refused_by_its_key() {
        let mission = taiji();
        assert_eq!(beyond(&mission), None);
        for rate in [1e9, 1e5, 1000.0, 1e-4, 0.0, -10.0] {
            let mut changed = mission.clone();
            changed["mission"]["sample_rate_hz"] = rate.into();
            let error = Mission::from_json(&changed.to_string()).unwrap_err().to_string();
            assert!(error.contains("mission.sample_rate_hz") && error.contains("0.1 to 100"), "{error}");
        }
    }

    #[test]
    fn values_and_lists_beyond_measure_are_refused_by_their_key() {
        for (pointer, value, key) in [
            ("/spacecraft/mass_kg", Value::from(1e9), "spacecraft.mass_kg"),
            ("/test_mass/tm1/offset_box_srf_m/1", Value::from(1e7), "test_mass.tm1.offset_box_srf_m"),
            ("/mission/name", Value::from("x".repeat(300)), "mission.name"),
            ("/noise/ifo_x/corner_hz", Value::from(1e300), "noise.ifo_x.corner_hz"),
        ] {
            let mut changed = taiji();
            *changed.pointer_mut(pointer).unwrap() = value;
            let error = Mission::from_json(&changed.to_string()).unwrap_err().to_string();
            assert!(error.contains(key), "{error}");
        }
        let mut changed = taiji();
        changed["test_mass"] = (0..100).map(|k| (format!("tm{k}"), changed["test_mass"]["tm1"].clone())).collect();
        assert!(Mission::from_json(&changed.to_string()).unwrap_err().to_string().contains("100 keys"));
    }
}
