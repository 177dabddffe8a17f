//! Effect `formula`: an expression in the model file, without a compiler.
//!
//! ```toml
//! [[effect]]
//! id = "formula"
//! instance = "battery"                                             # any name
//! [effect.parameters]
//! acts_on = "tm2.force.x"
//! expression = "lag(hk.battery_current_a, 120) * alpha.z"
//! unit = "N s2 A-1"                                                # of the coefficient
//! range = [-1e-6, 1e-6]                                            # of the coefficient
//! ```
//!
//! The coefficient times the expression is
//!
//! | `acts_on` | unit of coefficient × expression | response |
//! |---|---|---|
//! | `tmN.force.x\|y\|z` | N on the test mass, ORF | `1/m_m` on `tmN.accel` |
//! | `tmN.accel.x\|y\|z` | m s⁻² of the test mass, ORF | `tmN.accel` |
//! | `sc.force.x\|y\|z` | N on the spacecraft, SRF | `−T_S^{O_i} e/m_S` on the test masses |
//! | `sc.torque.x\|y\|z` | N m on the spacecraft, SRF | `J_S⁻¹ e` on the attitude, `sc.alpha` |
//!
//! Names, functions and operators: the guide's page on formulas. [`crate::lag::Lags`] states how functions with state
//! treat missing values; an integral counts them as zero. `-x^2` is −(x²).
//!
//! Rows where a column is missing or the expression is not finite are not used. **Limit**: an expression of the readout
//! that it must explain (`r1.y` acting on `tm1.accel.y`) is correlated with its noise and biased (errors in variables).

mod program;
mod text;

use dragfree_physics::mission::Mission;
use dragfree_sdk::prelude::*;
use serde_json::json;

use crate::common::{
    AXES, SeriesRef, axis_of, keep_available, manifest, mission, response, responses_to_spacecraft_force,
};
use crate::torque::responses_to_spacecraft_torque;
pub use program::Program;
pub use text::{TextError, Tree, parse};

/// Duration without a single value, from the first row with all inputs, after which the run stops, s.
const MAX_UNDEFINED_S: f64 = 600.0;

/// Fuzz entry: parses, compiles and runs any bytes on a few rows; must not panic.
pub fn fuzz_formula(bytes: &[u8]) {
    let text = String::from_utf8_lossy(bytes);
    let known = ["hk.a".to_owned(), "alpha.x".to_owned()];
    let made = parse(&text).and_then(|tree| Program::new(&tree, &known, 0.1));
    match made {
        Ok(mut program) => {
            let rows = vec![[0.0, -1.0, f64::NAN].as_slice(); program.names().len()];
            let _ = program.push(&[0, 100_000_000, 200_000_000], &rows, &mut Vec::new());
        }
        Err(error) => drop(error.marked(&text)),
    }
}

/// Names that a formula may use, with their columns: housekeeping, and of the reconstruction every column by its own
/// name, some by a short one too.
fn names(available: &Available, mission: &Mission) -> Vec<(String, Column)> {
    let mut names = Vec::new();
    for column in &available.columns {
        let name = &column.name;
        let all = match column.table.as_str() {
            "grid" if name.starts_with("hk.") => [None, Some(name.clone())],
            "reconstruction" => [short_name(name, mission), Some(name.clone())],
            _ => [None, None],
        };
        // The parser cannot tell other names from expressions.
        let plain = |n: &String| n.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'_' || b == b'.');
        names.extend(all.into_iter().flatten().filter(plain).map(|name| (name, column.clone())));
    }
    names
}

/// A column of the reconstruction as formulas name it, `r1` and `u1` for the first test mass by name.
fn short_name(column: &str, mission: &Mission) -> Option<String> {
    let (stem, axis) = column.rsplit_once('.').filter(|(_, axis)| AXES.contains(axis))?;
    let of_test_mass = || {
        mission.test_mass.keys().enumerate().find_map(|(i, name)| match stem.strip_prefix(name.as_str()) {
            Some(".r_orf_m") => Some(format!("r{}", i + 1)),
            Some(".u_orf_m_s2") => Some(format!("u{}", i + 1)),
            _ => match stem.strip_prefix("used.")?.strip_prefix(name.as_str())? {
                ".force_orf_n" => Some(format!("command.{name}.force")),
                ".torque_orf_nm" => Some(format!("command.{name}.torque")),
                _ => None,
            },
        })
    };
    let stem = match stem {
        "sc.alpha_srf_rad_s2" => "alpha".to_owned(),
        "sc.omega_srf_rad_s" => "omega".to_owned(),
        "used.mps_force_srf_n" => "command.mps_force".to_owned(),
        "used.mps_torque_srf_nm" => "command.mps_torque".to_owned(),
        "used.sun_srf" => "sun".to_owned(),
        _ => of_test_mass()?,
    };
    Some(format!("{stem}.{axis}"))
}

/// The effect.
#[derive(Debug)]
pub struct Formula {
    instance: String,
    mission: Mission,
    log: Log,
    acts_on: String,
    expression: String,
    unit: String,
    range: Vec<f64>,
    linked: Option<Linked>,
    /// Rows in which all inputs have values, how many of them have no value of the formula, and the run's first row,
    /// Unix ns.
    rows_with_inputs: u64,
    rows_without_value: u64,
    first_ns: Option<i64>,
}

#[derive(Debug)]
struct Linked {
    program: Program,
    /// Input column per name of the program; `None` for the time.
    inputs: Vec<Option<In>>,
    /// Provides rows to a formula without columns.
    clock: In,
    out: Out,
}

impl Formula {
    fn name(&self) -> String {
        format!("formula:{}", self.instance)
    }

    fn refuse<T>(&self, what: &str) -> Result<T, PluginError> {
        Err(PluginError::error(format!("effect {}: {what}", self.name())))
    }

    fn responses(&self, available: &Available, series: &SeriesRef) -> Result<Vec<Response>, PluginError> {
        let mut parts = self.acts_on.split('.');
        let axis = axis_of(&self.acts_on);
        let known = parts.clone().count() == 3 && self.acts_on.rsplit('.').next().is_some_and(|a| AXES.contains(&a));
        match (parts.next().unwrap_or_default(), parts.next().unwrap_or_default()) {
            ("sc", "force") if known => Ok(responses_to_spacecraft_force(&self.mission, axis, series)),
            ("sc", "torque") if known => Ok(responses_to_spacecraft_torque(available, &self.mission, axis, series)),
            (tm, what @ ("force" | "accel")) if known && self.mission.test_mass.contains_key(tm) => {
                let mass_kg = self.mission.test_mass(tm, "the effect formula")?.mass_kg;
                let factor = if what == "force" { 1.0 / mass_kg } else { 1.0 };
                Ok(vec![response(format!("{tm}.accel.{}", AXES[axis]), series, factor)])
            }
            _ => self.refuse(&format!(
                "parameter `acts_on` = \"{}\" must be sc.force.AXIS, sc.torque.AXIS, or NAME.force.AXIS or NAME.accel.AXIS of a test mass: {}",
                self.acts_on,
                self.mission.test_mass.keys().cloned().collect::<Vec<_>>().join(", ")
            )),
        }
    }

    /// Counts rows without a value, and logs a warning at each power of ten.
    ///
    /// # Errors
    /// No row has a value within [`MAX_UNDEFINED_S`].
    fn count_undefined(&mut self, times: &[i64], columns: &[&[f64]], values: &[f64]) -> Result<(), PluginError> {
        let limit = (MAX_UNDEFINED_S / self.mission.dt_s()) as u64;
        for (k, value) in values.iter().enumerate() {
            if !columns.iter().all(|c| c[k].is_finite()) {
                continue;
            }
            self.rows_with_inputs += 1;
            if value.is_finite() {
                continue;
            }
            self.rows_without_value += 1;
            if self.rows_without_value == limit && self.rows_with_inputs == limit {
                return self.refuse(&format!(
                    "`{}` has no finite value in any of the first {limit} epochs in which all its columns have one; check it for a \
                     division by zero or a root or logarithm of a negative number",
                    self.expression
                ));
            }
            let decade = self.rows_without_value >= 10
                && 10_u64.pow(self.rows_without_value.ilog10()) == self.rows_without_value;
            if decade {
                self.log.message(
                    Level::Warn,
                    &format!(
                        "effect {}: {} of {} epochs so far are not used, because the expression has no finite value there although \
                         all its columns do: `{}`; the last at Unix time {} ns",
                        self.name(),
                        self.rows_without_value,
                        self.rows_with_inputs,
                        self.expression,
                        times[k]
                    ),
                );
            }
        }
        Ok(())
    }
}

impl Effect for Formula {
    const MANIFEST: Manifest = manifest(
        "formula",
        "An expression of the user",
        &[
            Parameter::text(
                "acts_on",
                "",
                &[],
                "NAME.force.AXIS or NAME.accel.AXIS of a test mass, sc.force.AXIS or sc.torque.AXIS",
            ),
            Parameter::text("expression", "", &[], "expression that acts per unit of the coefficient"),
            Parameter::text("unit", "", &[], "SI unit of the coefficient"),
            Parameter::f64_list("range", "", &[], "physical range of the coefficient: lower, upper"),
        ],
        &[],
        &["commands"],
    );

    fn new(setup: &Setup) -> Result<Self, PluginError> {
        let formula = Self {
            instance: setup.instance().to_owned(),
            mission: mission(setup)?,
            log: setup.log(),
            acts_on: setup.text("acts_on")?,
            expression: setup.text("expression")?,
            unit: setup.text("unit")?,
            range: setup.f64_list("range")?,
            linked: None,
            rows_with_inputs: 0,
            rows_without_value: 0,
            first_ns: None,
        };
        if formula.instance.is_empty() || formula.instance.contains('.') {
            return formula.refuse("the instance must be a name without dots, e.g. instance = \"battery\"");
        }
        if formula.expression.trim().is_empty() {
            return formula
                .refuse("parameter `expression` is not set; e.g. expression = \"lag(hk.NAME, 120) * alpha.z\"");
        }
        if let Err(error) = parse(&formula.expression) {
            return formula.refuse(&error.marked(&formula.expression));
        }
        if formula.unit.trim().is_empty() {
            return formula.refuse(
                "parameter `unit` is not set; give the coefficient's SI unit, so that coefficient times expression has the unit \
                 of `acts_on`, e.g. unit = \"N A-1\"",
            );
        }
        match formula.range[..] {
            [lower, upper] if lower < upper => Ok(formula),
            _ => formula.refuse(&format!(
                "parameter `range` = {:?} must be two numbers, the physical range [lower, upper] of the coefficient; without a \
                 range any slow expression fits any slow force",
                formula.range
            )),
        }
    }

    fn link(&mut self, available: &Available, link: &mut EffectLink<'_, '_>) -> Result<(), PluginError> {
        let mut known = names(available, &self.mission);
        known.push(("time_s".to_owned(), Column::default()));
        let texts: Vec<String> = known.iter().map(|(name, _)| name.clone()).collect();
        let made = parse(&self.expression).and_then(|tree| Program::new(&tree, &texts, self.mission.dt_s()));
        let program = match made {
            Ok(program) => program,
            Err(error) => return self.refuse(&error.marked(&self.expression)),
        };
        let mut inputs = Vec::new();
        for name in program.names() {
            let column = known.iter().find(|(n, _)| n == name).filter(|_| name != "time_s");
            inputs.push(column.map(|(_, column)| link.read(&Want::of(column))).transpose()?);
        }
        let Some(channel) = available.of_kind("channel").next() else {
            return keep_available(available, &self.name(), self.responses(available, &SeriesRef::default())?)
                .map(drop);
        };
        let clock = link.read(&Want::of(channel))?;
        let series = "formula".to_owned();
        let out = link.series(&series, "", "")?;
        let responses = keep_available(available, &self.name(), self.responses(available, &(link.table(), series))?)?;
        self.linked = Some(Linked { program, inputs, clock, out });
        let (lower, upper) = (self.range[0], self.range[1]);
        link.coefficient(&Coefficient {
            name: self.name().replace(':', "."),
            unit: self.unit.clone(),
            lower,
            upper,
            initial: 0.0_f64.clamp(lower, upper),
            prior_sigma: (upper - lower) / 2.0,
            responses,
            shape: [("acts_on".to_owned(), json!(self.acts_on)), ("expression".to_owned(), json!(self.expression))]
                .into(),
            ..Coefficient::default()
        })
    }

    fn process(&mut self, input: &Inputs<'_>, output: &mut Outputs) -> Result<(), PluginError> {
        let Some(linked) = &mut self.linked else {
            return Err(PluginError::fatal("formula: process called before link"));
        };
        let times = input.times_of(linked.clock);
        let Some(&begin_ns) = times.first() else { return Ok(()) };
        let first_ns = *self.first_ns.get_or_insert(begin_ns);
        let timed = linked.inputs.iter().any(Option::is_none);
        let middle_s = 0.5 * self.mission.dt_s();
        let seconds: Vec<f64> = if timed {
            times.iter().map(|now| (now - first_ns) as f64 * 1e-9 + middle_s).collect()
        } else {
            Vec::new()
        };
        let columns: Vec<&[f64]> =
            linked.inputs.iter().map(|column| column.map_or(&*seconds, |column| input.f64(column))).collect();
        let values = output.f64(linked.out);
        let before = values.len();
        linked.program.push(times, &columns, values)?;
        let values = &mut values[before..];
        // Infinite counts as missing.
        values.iter_mut().filter(|x| x.is_infinite()).for_each(|x| *x = f64::NAN);
        if values.iter().any(|x| x.is_nan()) {
            let values = values.to_vec();
            self.count_undefined(times, &columns, &values)?;
        } else {
            self.rows_with_inputs += values.len() as u64;
        }
        Ok(())
    }

    fn state(&mut self, state: &mut State<'_>) -> Result<(), PluginError> {
        state.u64(&mut self.rows_with_inputs)?;
        state.u64(&mut self.rows_without_value)?;
        state.option(&mut self.first_ns, State::i64)?;
        Ok(self.linked.iter_mut().try_for_each(|linked| linked.program.visit(state))?)
    }
}
