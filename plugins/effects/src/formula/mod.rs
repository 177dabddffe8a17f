//! Effect `formula`: what the user writes down, without a compiler.
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
//! | `acts_on` | unit of coefficient × expression | what the channels show |
//! |---|---|---|
//! | `tmN.force.x\|y\|z` | N on the test mass, ORF | `1/m_m` on `tmN.accel` |
//! | `tmN.accel.x\|y\|z` | m s⁻² of the test mass, ORF | itself |
//! | `sc.force.x\|y\|z` | N on the spacecraft, SRF | both test masses stay behind, `−T_S^{O_i} e/m_S` |
//! | `sc.torque.x\|y\|z` | N m on the spacecraft, SRF | `J_S⁻¹ e` in the attitude, `sc.alpha` |
//!
//! **Names.** `hk.NAME` the telemetry's housekeeping; `alpha.x`, `omega.x` the spacecraft's angular acceleration and rate (SRF,
//! rad s⁻², rad s⁻¹); `r1.x`, `u1.x` displacement and known acceleration of a test mass (ORF, m, m s⁻²);
//! `command.mps_force.x`, `command.mps_torque.x`, `command.tm1.force.x`, `command.tm1.torque.x` what acted as commanded (SRF or
//! ORF, N, N m); `sun.x` the direction from the Sun (SRF); `time_s` seconds since the first epoch of the run; `pi`.
//!
//! **Functions.** `sin cos tan asin acos atan sinh cosh tanh exp ln log10 sqrt abs sign`, `min max atan2` of two; with memory:
//! `lag(x, s)` first-order lag, `lowpass(x, hz)` the same by its corner, `highpass(x, hz)` the rest, `derivative(x)` backward
//! difference, `integral(x)` from the first epoch of the run, a missing value adding nothing. See [`crate::lag::Lags`] for what
//! lags do where values are missing. `-x^2` is −(x²).
//!
//! A row without a value, by a column that has none or by a division by zero, is not used. **Trap**: a regressor made from the very
//! readout that it must explain (`r1.y` acting on `tm1.accel.y`) fits the readout's noise.

mod program;
mod text;

use dragfree_physics::mission::Mission;
use dragfree_sdk::prelude::*;
use serde_json::json;

use crate::common::{
    AXES, Place, axis_of, behind_spacecraft, loaded, manifest, mission, on_channels, response, saved, turning,
};
pub use program::Program;
pub use text::{TextError, Tree, read};

const STATE: &[u8; 8] = b"formula1";
/// Where all columns have values, but the formula has none in so many epochs from the first, it never will, s.
const HOPELESS_S: f64 = 600.0;

/// A text from outside: read, compiled, run on a few rows. Whatever it is, no panic.
pub fn fuzz_formula(bytes: &[u8]) {
    let text = String::from_utf8_lossy(bytes);
    let known = ["hk.a".to_owned(), "alpha.x".to_owned()];
    let made = read(&text).and_then(|tree| Program::new(&tree, &known, 0.1));
    match made {
        Ok(mut program) => {
            let rows = vec![[0.0, -1.0, f64::NAN].as_slice(); program.names().len()];
            let _ = program.push(&[0, 100_000_000, 200_000_000], &rows, &mut Vec::new());
        }
        Err(error) => drop(error.marked(&text)),
    }
}

/// Every name that a formula may use here, with its column.
fn names(available: &Available) -> Vec<(String, Column)> {
    let mut names = Vec::new();
    for column in &available.columns {
        let name = column.name.as_str();
        let short = if column.table == "grid" && name.starts_with("hk.") {
            Some(name.to_owned())
        } else if column.table == "reconstruction" {
            short_name(name)
        } else {
            None
        };
        // A name with other letters could not be told from an expression.
        let plain = |n: &String| n.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'_' || b == b'.');
        names.extend(short.filter(plain).map(|short| (short, column.clone())));
    }
    names
}

fn short_name(column: &str) -> Option<String> {
    let (stem, axis) = column.rsplit_once('.').filter(|(_, axis)| AXES.contains(axis))?;
    let stem = match stem {
        "sc.alpha_srf_rad_s2" => "alpha",
        "sc.omega_srf_rad_s" => "omega",
        "tm1.r_orf_m" => "r1",
        "tm2.r_orf_m" => "r2",
        "tm1.u_orf_m_s2" => "u1",
        "tm2.u_orf_m_s2" => "u2",
        "used.mps_force_srf_n" => "command.mps_force",
        "used.mps_torque_srf_nm" => "command.mps_torque",
        "used.tm1.force_orf_n" => "command.tm1.force",
        "used.tm1.torque_orf_nm" => "command.tm1.torque",
        "used.tm2.force_orf_n" => "command.tm2.force",
        "used.tm2.torque_orf_nm" => "command.tm2.torque",
        "used.sun_srf" => "sun",
        _ => return None,
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
    /// Rows whose columns all have values: how many, how many of them without a value of the formula, and Unix ns of the run's
    /// first row.
    asked: u64,
    without: u64,
    first_ns: Option<i64>,
}

#[derive(Debug)]
struct Linked {
    program: Program,
    /// Column of each of the program's names; none for the time.
    inputs: Vec<Option<In>>,
    /// So that a formula of no column has rows.
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

    fn responses(&self, series: &Place) -> Result<Vec<Response>, PluginError> {
        let mut parts = self.acts_on.split('.');
        let axis = axis_of(&self.acts_on);
        let known = parts.clone().count() == 3 && self.acts_on.rsplit('.').next().is_some_and(|a| AXES.contains(&a));
        match (parts.next().unwrap_or_default(), parts.next().unwrap_or_default()) {
            ("sc", "force") if known => Ok(behind_spacecraft(&self.mission, axis, series)),
            ("sc", "torque") if known => Ok(turning(&self.mission, axis, series)),
            (tm @ ("tm1" | "tm2"), what @ ("force" | "accel")) if known => {
                let mass_kg = self.mission.test_mass(tm, "the effect formula")?.mass_kg;
                let factor = if what == "force" { 1.0 / mass_kg } else { 1.0 };
                Ok(vec![response(format!("{tm}.accel.{}", AXES[axis]), series, factor)])
            }
            _ => self.refuse(&format!(
                "`acts_on` = \"{}\" must be tm1.force.x or tm1.accel.x (tm2, y, z likewise), sc.force.x or sc.torque.x",
                self.acts_on
            )),
        }
    }

    /// Tells of rows without a value, each time when there are ten times as many.
    fn count(&mut self, times: &[i64], columns: &[&[f64]], values: &[f64]) -> Result<(), PluginError> {
        let hopeless = (HOPELESS_S / self.mission.dt_s()) as u64;
        for (k, value) in values.iter().enumerate() {
            if !columns.iter().all(|c| c[k].is_finite()) {
                continue;
            }
            self.asked += 1;
            if value.is_finite() {
                continue;
            }
            self.without += 1;
            if self.without == hopeless && self.asked == hopeless {
                return self.refuse(&format!(
                    "the expression has no value in any of the {hopeless} epochs in which all its columns have one: `{}` divides \
                     by zero, or takes a root or a logarithm of a negative number; mend it",
                    self.expression
                ));
            }
            let decade = self.without >= 10 && 10_u64.pow(self.without.ilog10()) == self.without;
            if decade {
                self.log.message(
                    Level::Warn,
                    &format!(
                        "effect {}: so far {} of {} epochs have no value of `{}`, though all its columns have one; the last at Unix \
                         time {} ns. They are not used",
                        self.name(),
                        self.without,
                        self.asked,
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
        "The user's own expression",
        &[
            Parameter::text("acts_on", "", &[], "tmN.force.AXIS, tmN.accel.AXIS, sc.force.AXIS or sc.torque.AXIS"),
            Parameter::text("expression", "", &[], "what acts per unit of the coefficient"),
            Parameter::text("unit", "", &[], "SI unit of the coefficient"),
            Parameter::f64_list("range", "", &[], "physical range of the coefficient, two numbers"),
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
            asked: 0,
            without: 0,
            first_ns: None,
        };
        if formula.instance.is_empty() || formula.instance.contains('.') {
            return formula
                .refuse("its instance must be a name without dots, of your own choice: instance = \"battery\"");
        }
        if formula.expression.trim().is_empty() {
            return formula
                .refuse("`expression` is not given; write one, as in expression = \"lag(hk.NAME, 120) * alpha.z\"");
        }
        if formula.unit.trim().is_empty() {
            return formula.refuse(
                "`unit` is not given; coefficient times expression must be what `acts_on` says, so name the coefficient's SI \
                 unit, as in unit = \"N A-1\"",
            );
        }
        match formula.range[..] {
            [lower, upper] if lower < upper => Ok(formula),
            _ => formula.refuse(&format!(
                "`range` = {:?} must be two numbers, lower and upper end of what the coefficient can be: without one a slow force is \
                 \"explained\" by anything that is slow",
                formula.range
            )),
        }
    }

    fn link(&mut self, available: &Available, link: &mut EffectLink<'_, '_>) -> Result<(), PluginError> {
        let mut known = names(available);
        known.push(("time_s".to_owned(), Column::default()));
        let texts: Vec<String> = known.iter().map(|(name, _)| name.clone()).collect();
        let made = read(&self.expression).and_then(|tree| Program::new(&tree, &texts, self.mission.dt_s()));
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
            return on_channels(available, &self.name(), self.responses(&Place::default())?).map(drop);
        };
        let clock = link.read(&Want::of(channel))?;
        let series = "formula".to_owned();
        let out = link.series(&series, "", "")?;
        let responses = on_channels(available, &self.name(), self.responses(&(link.table(), series))?)?;
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
            return Err(PluginError::fatal("formula: called before it was linked"));
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
        // An infinite value is none either.
        values.iter_mut().filter(|x| x.is_infinite()).for_each(|x| *x = f64::NAN);
        if values.iter().any(|x| x.is_nan()) {
            let values = values.to_vec();
            self.count(times, &columns, &values)?;
        } else {
            self.asked += values.len() as u64;
        }
        Ok(())
    }

    fn save(&self) -> Result<Vec<u8>, PluginError> {
        let first_ns = self.first_ns.unwrap_or(i64::MIN).cast_unsigned();
        let whole = [self.asked, self.without, first_ns].map(f64::from_bits);
        let program = self.linked.iter().flat_map(|linked| linked.program.state());
        Ok(saved(STATE, whole.into_iter().chain(program)))
    }

    fn load(&mut self, state: &[u8]) -> Result<(), PluginError> {
        let count = 3 + self.linked.as_ref().map_or(0, |linked| linked.program.state().len());
        let numbers = loaded(STATE, &self.name(), count, state)?;
        let [asked, without, first_ns] = [0, 1, 2].map(|i| numbers[i].to_bits());
        (self.asked, self.without) = (asked, without);
        self.first_ns = Some(first_ns.cast_signed()).filter(|ns| *ns != i64::MIN);
        if let Some(linked) = &mut self.linked {
            linked.program.set_state(&numbers[3..]);
        }
        Ok(())
    }
}
