//! Meaning of the telemetry's tables: status flags and the columns they cover, readouts, units and frames.

use dragfree_physics::mission::Limits;
use dragfree_sdk::Column;

/// A column of a table.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct ColumnSpec {
    /// Name in its table, `tm1.r_orf_m.x`.
    pub(crate) name: String,
    /// Largest valid magnitude, in the column's SI unit.
    pub(crate) limit: f64,
    /// Whether it is held rather than interpolated: a flag, or housekeeping where columns must know no later sample.
    pub(crate) flag: bool,
    /// Whether it is an instrument's measurement; exact repetition means that it is stuck.
    pub(crate) instrument: bool,
    /// Whether it is a displacement or an angle; these are tested for outliers.
    pub(crate) readout: bool,
    /// Whether an epoch needs it.
    pub(crate) mandatory: Mandatory,
}

/// Whether an epoch needs a column.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Mandatory {
    /// Not needed.
    No,
    /// Needed.
    Yes,
    /// At least one such column of this test mass is needed: x by interferometer or inertial sensor.
    OneOf(u8),
    /// All such columns of this test mass are needed. One test mass with its columns suffices.
    EachOf(u8),
}

/// A status column and the columns it covers.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct StatusRule {
    /// Index of the status column.
    pub(crate) status: usize,
    /// Relevant bits.
    mask: u64,
    /// Columns that are invalid while one of the bits is set.
    pub(crate) covers: Vec<usize>,
}

impl StatusRule {
    /// Whether a status invalidates its columns. A value that is not a whole number counts as all bits.
    pub(crate) fn raised(&self, status: f64) -> bool {
        let bits = if status >= 0.0 && status.fract() == 0.0 && status < 1.8e19 { status as u64 } else { u64::MAX };
        bits & self.mask != 0
    }
}

/// A table of the telemetry.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct TableSpec {
    /// Name, `is` or `hk/battery_current_a`.
    pub(crate) name: String,
    /// Columns.
    pub(crate) columns: Vec<ColumnSpec>,
    /// Status flags.
    pub(crate) status: Vec<StatusRule>,
    /// Rate that the telemetry states, Hz.
    pub(crate) stated_rate_hz: Option<f64>,
    /// Whether it is an instrument or a command, which are not interpolated at any rate.
    pub(crate) never_interpolated: bool,
    /// Whether a calibration needs it.
    pub(crate) mandatory: bool,
}

/// Unit and frame of a column by `telemetry.proto`; `None` for columns that it does not define.
pub(crate) fn expected(table: &str, column: &str) -> Option<(&'static str, &'static str)> {
    let parts: Vec<&str> = column.split('.').collect();
    let orf = match parts[0] {
        "tm1" => "ORF_1",
        "tm2" => "ORF_2",
        _ => "",
    };
    let after_tm = if orf.is_empty() { parts[0] } else { parts.get(1).copied().unwrap_or_default() };
    match (table, after_tm) {
        ("is", "r_orf_m") | ("ifo", "x_orf_m") => Some(("m", orf)),
        ("is", "att_orf_rad") | ("dws", "theta_orf_rad" | "psi_orf_rad") => Some(("rad", orf)),
        ("dws", "sc_crf_rad") => Some(("rad", "CRF")),
        ("command", "mps_force_srf_n") => Some(("N", "SRF")),
        ("command", "mps_torque_srf_nm") => Some(("N m", "SRF")),
        ("command", "force_orf_n") => Some(("N", orf)),
        ("command", "torque_orf_nm") => Some(("N m", orf)),
        ("ephemeris", "r_sc_irf_m") => Some(("m", "IRF")),
        ("ephemeris", "v_sc_irf_m_s") => Some(("m s-1", "IRF")),
        ("ephemeris", "omega_crf_rad_s") => Some(("rad s-1", "CRF")),
        ("ephemeris", "alpha_crf_rad_s2") => Some(("rad s-2", "CRF")),
        ("ephemeris", "sun_srf") => Some(("1", "SRF")),
        _ => None,
    }
}

/// Name of a column in the grid: `is.tm1.r_orf_m.x`, `hk.battery_current_a`.
pub(crate) fn grid_name(table: &str, column: &str, only_column: bool) -> String {
    let table = table.replace('/', ".");
    if only_column && column == "value" { table } else { format!("{table}.{column}") }
}

/// Specification of a table from its columns.
pub(crate) fn table_spec(
    name: &str,
    columns: &[&Column],
    mandatory: bool,
    test_masses: &[&str],
    limits: Option<&Limits>,
) -> TableSpec {
    let interpolated = name == "ephemeris" || name.starts_with("hk/");
    let instrument = name != "command" && !interpolated;
    let needed = |c: &Column| needed(name, mandatory, columns, test_masses, c);
    let specs = columns
        .iter()
        .map(|c| {
            let readout = instrument && (c.unit == "m" || c.unit == "rad");
            let limit = match (limits, name, c.unit.as_str()) {
                (Some(l), "is" | "ifo", "m") => l.displacement_m,
                (Some(l), "is" | "dws", "rad") => l.angle_rad,
                (_, "ephemeris", unit) => ephemeris_limit(unit),
                _ => f64::MAX,
            };
            let flag = is_status(&c.name) || (c.unit.is_empty() && !name.starts_with("hk/"));
            let measured = instrument && !flag && c.unit != "1";
            ColumnSpec { name: c.name.clone(), limit, flag, instrument: measured, readout, mandatory: needed(c) }
        })
        .collect();
    TableSpec {
        name: name.to_owned(),
        columns: specs,
        status: status_rules(name, columns),
        stated_rate_hz: stated_rate_hz(columns),
        never_interpolated: mandatory || matches!(name, "is" | "ifo" | "dws" | "command"),
        mandatory,
    }
}

/// Largest size of a value of the ephemeris by its unit: within the heliosphere, slower than anything bound to the Sun,
/// turning less than once in six seconds. Unlike instruments, nothing else tells a wrong one.
fn ephemeris_limit(unit: &str) -> f64 {
    match unit {
        "m" => 1e13,
        "m s-1" => 1e6,
        "rad s-1" | "rad s-2" => 1.0,
        "1" => 1.1,
        _ => f64::MAX,
    }
}

/// Rate stated by a column's metadata, Hz.
pub(crate) fn stated_rate_hz(columns: &[&Column]) -> Option<f64> {
    columns
        .iter()
        .find_map(|c| c.attribute("rate_hz").parse().ok())
        .filter(|rate: &f64| rate.is_finite() && *rate > 0.0)
}

fn is_status(column: &str) -> bool {
    column == "status" || column.ends_with(".status")
}

/// Status rules: `P.status` covers the columns below `P`. `dws.status` has one bit for each of three groups; an
/// undefined bit covers all of them.
fn status_rules(table: &str, columns: &[&Column]) -> Vec<StatusRule> {
    let below = |prefix: &str| -> Vec<usize> {
        let covered = |c: &Column| !is_status(&c.name) && c.name.starts_with(prefix);
        (0..columns.len()).filter(|i| covered(columns[*i])).collect()
    };
    let mut rules = Vec::new();
    for (status, column) in columns.iter().enumerate().filter(|(_, c)| is_status(&c.name)) {
        let prefix = column.name.trim_end_matches("status");
        if table == "dws" && prefix.is_empty() {
            for (bit, group) in ["tm1.", "tm2.", "sc_"].iter().enumerate() {
                rules.push(StatusRule { status, mask: 1 << bit | !0b111, covers: below(group) });
            }
        } else {
            rules.push(StatusRule { status, mask: u64::MAX, covers: below(prefix) });
        }
    }
    rules
}

/// Whether an epoch needs a column of a table.
fn needed(table: &str, mandatory: bool, columns: &[&Column], test_masses: &[&str], column: &Column) -> Mandatory {
    let tm = test_masses.iter().position(|tm| column.name.split('.').next() == Some(tm));
    match (table, tm) {
        ("ifo", Some(tm)) if column.name.ends_with(".x_orf_m") => Mandatory::OneOf(tm as u8),
        ("is", Some(tm)) if mandatory && column.name.ends_with(".r_orf_m.x") => Mandatory::OneOf(tm as u8),
        ("is", Some(tm)) if mandatory && column.name.contains(".r_orf_m.") => Mandatory::EachOf(tm as u8),
        ("dws", _) if mandatory && column.name.starts_with("sc_crf_rad.") => Mandatory::Yes,
        ("is" | "dws" | "ifo", _) => Mandatory::No,
        _ if mandatory => {
            // A mission's own instrument: its accelerations if it has any, otherwise all its measurements.
            let acceleration = |c: &Column| c.unit == "m s-2" || c.unit == "rad s-2";
            let any = columns.iter().any(|c| acceleration(c));
            let measured = !is_status(&column.name) && !column.unit.is_empty() && column.unit != "1";
            if if any { acceleration(column) } else { measured } { Mandatory::Yes } else { Mandatory::No }
        }
        _ => Mandatory::No,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::columns;

    #[test]
    fn a_status_covers_the_columns_below_it() {
        let owned =
            columns("dws", &["tm1.theta_orf_rad", "tm2.theta_orf_rad", "sc_crf_rad.phi", "sc_crf_rad.psi", "status"]);
        let all: Vec<&Column> = owned.iter().collect();
        let spec = table_spec("dws", &all, true, &["tm1", "tm2"], None);
        let covered = |status: f64| -> Vec<usize> {
            let raised = spec.status.iter().filter(|r| r.raised(status));
            raised.flat_map(|r| r.covers.clone()).collect()
        };
        assert_eq!(covered(0.0), Vec::<usize>::new());
        assert_eq!(covered(1.0), [0]);
        assert_eq!(covered(6.0), [1, 2, 3]);
        assert_eq!(covered(8.0), [0, 1, 2, 3]);
        assert_eq!(covered(f64::NAN), [0, 1, 2, 3]);
        assert_eq!(covered(0.5), [0, 1, 2, 3]);
    }

    /// One 1e30 in an ephemeris nearly doubled σ, and nothing said so.
    #[test]
    fn an_impossible_ephemeris_is_beyond_its_limit() {
        let owned = columns("ephemeris", &["r_sc_irf_m.x", "omega_crf_rad_s.z", "sun_srf.y", "alpha_crf_rad_s2.x"]);
        let spec = table_spec("ephemeris", &owned.iter().collect::<Vec<_>>(), false, &["tm1"], None);
        for (column, sound) in spec.columns.iter().zip([1.5e11, 1.1e-3, 1.0, 1e-6]) {
            assert!(sound < column.limit && column.limit < 1e30, "{}: {}", column.name, column.limit);
        }
    }

    #[test]
    fn names_of_the_grid() {
        assert_eq!(grid_name("is", "tm1.r_orf_m.x", false), "is.tm1.r_orf_m.x");
        assert_eq!(grid_name("hk/bus_voltage", "value", true), "hk.bus_voltage");
        assert_eq!(grid_name("hk/bus", "value", false), "hk.bus.value");
        assert_eq!(grid_name("ephemeris", "sun_srf.x", false), "ephemeris.sun_srf.x");
    }

    #[test]
    fn telemetry_columns_have_unit_and_frame() {
        assert_eq!(expected("is", "tm2.r_orf_m.y"), Some(("m", "ORF_2")));
        assert_eq!(expected("dws", "sc_crf_rad.phi"), Some(("rad", "CRF")));
        assert_eq!(expected("command", "mps_torque_srf_nm.x"), Some(("N m", "SRF")));
        assert_eq!(expected("ephemeris", "alpha_crf_rad_s2.z"), Some(("rad s-2", "CRF")));
        assert_eq!(expected("is", "tm1.status"), None);
        assert_eq!(expected("acc1a", "lin_accl.x"), None);
    }
}
