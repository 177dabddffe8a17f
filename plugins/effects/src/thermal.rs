//! Effect `thermal`: a force on a test mass proportional to the difference of two temperatures.
//!
//! Residual gas, radiation pressure and outgassing of opposite housing faces differ with their temperatures:
//! `a = k (T₊ − T₋)` behind a first-order lag `τ` between thermometer and face, `τ ẏ = T − y` (LISA Pathfinder:
//! arXiv:1905.09060, 2507.20846).
//!
//! k: m s⁻² K⁻¹, positive if the test mass is pushed along its axis of ORF while `plus` is warmer. **Range** ±1e-9;
//! radiation pressure and the radiometric effect give some 1e-11 each. **Confounders**: neighbouring lags, of which the
//! truth may be a mixture; thermometers that see the same heater.

use dragfree_physics::mission::Mission;
use dragfree_sdk::prelude::*;
use serde_json::json;

use crate::common::{
    SLOW_HZ, SeriesRef, TM_AXES, accel_channel_of, find_housekeeping, housekeeping_in, keep_available, manifest,
    mission, response, symmetric,
};
use crate::lag::Lags;

const MAX_PER_KELVIN: f64 = 1e-9;

/// Lags of a candidate, s: 30 s to 4,000 s in steps of 1.5, whole seconds.
pub(crate) const LAGS_S: [f64; 13] =
    [30.0, 45.0, 68.0, 101.0, 152.0, 228.0, 342.0, 513.0, 769.0, 1153.0, 1730.0, 2595.0, 3892.0];

/// Name of the series of a lagged column.
pub(crate) fn lagged_name(column: &str, lag_s: f64) -> String {
    format!("lag({column},{lag_s})")
}

/// One column behind several lags.
#[derive(Debug)]
struct LaggedColumn<const N: usize> {
    input: In,
    lags: Lags<N>,
    /// Output column per lag; `None` if another effect writes the series.
    out: [Option<Out>; N],
}

impl<const N: usize> LaggedColumn<N> {
    /// Requests the series; returns them, and the bank if this effect must compute any of them.
    fn link(
        column: &Column,
        lag_s: [f64; N],
        dt_s: f64,
        available: &Available,
        link: &mut EffectLink<'_, '_>,
    ) -> Result<([SeriesRef; N], Option<Self>), PluginError> {
        let mut places = [const { (String::new(), String::new()) }; N];
        let mut out = [None; N];
        for j in 0..N {
            let name = lagged_name(&column.name, lag_s[j]);
            let (table, written) = link.slow_series(available, &name, &column.unit, SLOW_HZ)?;
            (places[j], out[j]) = ((table, name), written);
        }
        if out.iter().all(Option::is_none) {
            return Ok((places, None));
        }
        let input = link.read(&Want::of(column).unit(&column.unit))?;
        Ok((places, Some(Self { input, lags: Lags::new(lag_s, dt_s), out })))
    }

    fn process(&mut self, input: &Inputs<'_>, output: &mut Outputs) {
        let out = self.out;
        self.lags.push(input.time_ns(), input.f64(self.input), |j, rows| {
            if let Some(column) = out[j] {
                output.f64(column).extend_from_slice(rows);
            }
        });
    }
}

/// The effect.
#[derive(Debug)]
pub(crate) struct Thermal {
    setup: Setup,
    mission: Mission,
    lagged_pair: Vec<LaggedColumn<1>>,
    banks: Vec<LaggedColumn<13>>,
}

impl Thermal {
    fn name(&self) -> String {
        format!("thermal:{}", self.setup.instance())
    }

    /// Response to one lagged temperature.
    fn force_response(&self, temperature: &SeriesRef, factor: f64) -> Response {
        response(accel_channel_of(self.setup.instance()), temperature, factor)
    }

    /// Every pair of temperatures at every lag. The sign of k is free, so each pair is listed in one order.
    fn variants(&mut self, available: &Available, link: &mut EffectLink<'_, '_>) -> Result<Vec<Variant>, PluginError> {
        let columns: Vec<&Column> = housekeeping_in(available, "K").collect();
        let mut places = Vec::new();
        for column in &columns {
            let (place, bank) = LaggedColumn::link(column, LAGS_S, self.mission.dt_s(), available, link)?;
            places.push(place);
            self.banks.extend(bank);
        }
        let mut variants = Vec::new();
        for plus in 0..columns.len() {
            for minus in plus + 1..columns.len() {
                for (j, lag_s) in LAGS_S.into_iter().enumerate() {
                    let shape = [
                        ("plus".to_owned(), json!(columns[plus].name)),
                        ("minus".to_owned(), json!(columns[minus].name)),
                        ("lag_s".to_owned(), json!(lag_s)),
                    ];
                    let responses =
                        vec![self.force_response(&places[plus][j], 1.0), self.force_response(&places[minus][j], -1.0)];
                    variants.push(Variant { shape: shape.into(), responses, ..Variant::default() });
                }
            }
        }
        Ok(variants)
    }

    /// Responses to the temperatures that the parameters name; either may be empty.
    fn responses(
        &mut self,
        available: &Available,
        link: &mut EffectLink<'_, '_>,
    ) -> Result<Vec<Response>, PluginError> {
        let mut responses = Vec::new();
        for (parameter, factor) in [("plus", 1.0), ("minus", -1.0)] {
            let name = self.setup.text(parameter)?;
            if name.is_empty() {
                continue;
            }
            let column = find_housekeeping(available, &self.name(), parameter, &name, "K")?;
            let lag_s = [self.setup.f64("lag_s")?];
            let ([lagged_name], bank) = LaggedColumn::link(column, lag_s, self.mission.dt_s(), available, link)?;
            responses.push(self.force_response(&lagged_name, factor));
            self.lagged_pair.extend(bank);
        }
        if responses.is_empty() {
            // Refuses with the list of columns.
            find_housekeeping(available, &self.name(), "plus", "", "K")?;
        }
        Ok(responses)
    }
}

impl Effect for Thermal {
    const MANIFEST: Manifest = manifest(
        "thermal",
        "Force on a test mass proportional to a lagged temperature difference",
        &[
            Parameter::text("plus", "", &[], "column of the temperature that pushes along the axis, hk.NAME in K"),
            Parameter::text("minus", "", &[], "column of the temperature that pushes against it, hk.NAME in K"),
            Parameter::f64("lag_s", "s", 480.0, 0.0..=1e5, "first-order lag between temperature and force"),
        ],
        TM_AXES,
        &[],
    );

    fn new(setup: &Setup) -> Result<Self, PluginError> {
        Ok(Self { setup: setup.clone(), mission: mission(setup)?, lagged_pair: Vec::new(), banks: Vec::new() })
    }

    fn link(&mut self, available: &Available, link: &mut EffectLink<'_, '_>) -> Result<(), PluginError> {
        let mut coefficient = symmetric(format!("thermal.{}", self.setup.instance()), "m s-2 K-1", MAX_PER_KELVIN);
        // Checks the channel first.
        keep_available(available, &self.name(), vec![self.force_response(&SeriesRef::default(), 1.0)])?;
        if self.setup.candidate() {
            coefficient.variants = self.variants(available, link)?;
            if coefficient.variants.is_empty() {
                return Err(PluginError::error(format!(
                    "effect {}: the telemetry has fewer than two temperatures (columns hk.* in K), so this candidate has no form",
                    self.name()
                )));
            }
        } else {
            coefficient.responses = self.responses(available, link)?;
            let text = |name: &str| Ok::<_, PluginError>((name.to_owned(), json!(self.setup.text(name)?)));
            let lag_s = ("lag_s".to_owned(), json!(self.setup.f64("lag_s")?));
            coefficient.shape = [text("plus")?, text("minus")?, lag_s].into();
        }
        link.coefficient(&coefficient)
    }

    fn process(&mut self, input: &Inputs<'_>, output: &mut Outputs) -> Result<(), PluginError> {
        self.lagged_pair.iter_mut().for_each(|bank| bank.process(input, output));
        self.banks.iter_mut().for_each(|bank| bank.process(input, output));
        Ok(())
    }

    fn state(&mut self, state: &mut State<'_>) -> Result<(), PluginError> {
        self.lagged_pair.iter_mut().try_for_each(|bank| bank.lags.visit(state))?;
        Ok(self.banks.iter_mut().try_for_each(|bank| bank.lags.visit(state))?)
    }
}
