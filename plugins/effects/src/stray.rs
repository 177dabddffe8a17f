//! Stray forces on a test mass by charge and by magnetic field: `charge`, `magnetic`.

use dragfree_physics::mission::Mission;
use dragfree_sdk::prelude::*;
use serde_json::json;

use crate::common::{AXES, Place, SLOW_HZ, housekeeping, manifest, mission, named, on_channels, place, response};

/// `charge`: a charged test mass in the field of stray voltages.
///
/// `a_x = q(t)/C ∂C/∂x ΔV/m` (Shaul et al.; LISA Pathfinder: Armano et al., PRL 118, 171101). `ΔV` is the stray voltage across
/// x, V, the coefficient; positive pushes a positive charge along +x. Charge drifts up with cosmic rays and falls when the
/// lamps discharge it: its ramps are what tells `ΔV`. **Range** ±1 V: housings show 0.1 V and less.
///
/// The measured charge carries noise, 10⁴ elementary charges in a minute; what it carries into the fit is uncorrelated with the
/// residuals and shrinks `ΔV` by noise over signal power in the band of the ramps, parts in a thousand.
/// **Confounders.** A ramp without a discharge is a slope, as self-gravity's drift has it, or a temperature's.
#[derive(Debug)]
pub(crate) struct Charge {
    instance: String,
    mission: Mission,
    candidate: bool,
    column: String,
    capacitance_f: f64,
    gradient_f_m: f64,
}

impl Charge {
    fn name(&self) -> String {
        format!("charge:{}", self.instance)
    }

    fn responses(&self, available: &Available, column: &Column) -> Result<Vec<Response>, PluginError> {
        let by = self.name();
        let mass_kg = self.mission.test_mass(&self.instance, "the effect charge")?.mass_kg;
        let factor = self.gradient_f_m / (self.capacitance_f * mass_kg);
        let x = response(format!("{}.accel.x", self.instance), &place(column), factor);
        on_channels(available, &by, vec![x])
    }
}

impl Effect for Charge {
    const MANIFEST: Manifest = manifest(
        "charge",
        "Force along x by the test mass's charge and a stray voltage across it",
        &[
            Parameter::text("charge", "", &[], "column of the measured charge, hk.NAME in C"),
            Parameter::f64("capacitance_f", "F", 34.2e-12, 1e-13..=1e-9, "of the test mass against all around it"),
            Parameter::f64(
                "gradient_f_m",
                "F m-1",
                291e-12,
                1e-12..=1e-8,
                "derivative of an x electrode's capacitance",
            ),
        ],
        &["tm1", "tm2"],
        &[],
    );

    fn new(setup: &Setup) -> Result<Self, PluginError> {
        Ok(Self {
            instance: setup.instance().to_owned(),
            mission: mission(setup)?,
            candidate: setup.candidate(),
            column: setup.text("charge")?,
            capacitance_f: setup.f64("capacitance_f")?,
            gradient_f_m: setup.f64("gradient_f_m")?,
        })
    }

    fn link(&mut self, available: &Available, link: &mut EffectLink<'_, '_>) -> Result<(), PluginError> {
        let mut coefficient = Coefficient {
            name: format!("charge.{}", self.instance),
            unit: "V".to_owned(),
            lower: -1.0,
            upper: 1.0,
            prior_sigma: 0.3,
            ..Coefficient::default()
        };
        let shape = |c: &Column| Shape::from([("charge".to_owned(), json!(c.name))]);
        if self.candidate {
            for column in housekeeping(available, "C") {
                let responses = self.responses(available, column)?;
                coefficient.variants.push(Variant { shape: shape(column), responses, ..Variant::default() });
            }
            if coefficient.variants.is_empty() {
                let name = self.name();
                return Err(PluginError::error(format!(
                    "effect {name}: the telemetry has no charge, a column hk.* in C, so there is nothing to try"
                )));
            }
        } else {
            let column = named(available, &self.name(), "charge", &self.column, "C")?;
            (coefficient.shape, coefficient.responses) = (shape(column), self.responses(available, column)?);
        }
        link.coefficient(&coefficient)
    }

    fn process(&mut self, _input: &Inputs<'_>, _output: &mut Outputs) -> Result<(), PluginError> {
        Ok(())
    }
}

/// `magnetic`: the test mass is a weak magnet in a field that is not uniform.
///
/// `a = (χ/(μ0 ρ)) (B·∇)B + (m_r·∇)B/m` (LISA Pathfinder: arXiv:2407.04427). With the gradient tensor `∂B_i/∂x_j = G_ij(t)`, the
/// acceleration along i is `Σ_j G_ij(t) (χ B_j(t)/(μ0 ρ) + m_j/m)`. Telemetry has one number of the gradient, `g(t)`, and some
/// components `B(t)` of the field near by, in their own axes. Units that carry the same current make a tensor of a fixed form
/// that grows and shrinks as one, `G(t) = Γ g(t)`: then along each axis `a_i = p_i g + c_i g B`, and the coefficients are
///
/// * `gradient_x|y|z` = `Σ_j Γ_ij (m_j/m + χ B̄_j/(μ0 ρ))`, m s⁻² per T/m, of the remanent moment and the steady field, ±1e-6
///   (5e-10 per nA m² in a mass of 2 kg; LISA Pathfinder's is below 1 nA m²);
/// * `product_x|y|z` = `χ Γ_ij/(μ0 ρ)` for the component j that the column measures, m s⁻² per T · T/m, ±0.1: 1.4e-3 for
///   LISA Pathfinder's χ of 3.4e-5.
///
/// χ and `m_r` themselves need the tensor Γ, which no telemetry has: with it, divide. The sign follows the columns' own. In a
/// telemetry without gradients, a field column serves as its own gradient (`g = B`, products are squares): fields of units near
/// by fall off together with their gradients. One field column at a time: interplanetary field along the other axes is left
/// over. **Confounders.** All that follows the bus current: heaters' warmth, `current²`; `g²` and `g B` are alike where the
/// units' own field dominates.
#[derive(Debug)]
pub(crate) struct Magnetic {
    instance: String,
    candidate: bool,
    gradient: String,
    field: String,
    products: Vec<Product>,
}

/// The product of two columns.
#[derive(Debug)]
struct Product {
    columns: [In; 2],
    out: Out,
}

const GRADIENT_UNIT: &str = "T m-1";
const FIELD_UNIT: &str = "T";
const GRADIENT_MAX: f64 = 1e-6;
const PRODUCT_MAX: f64 = 0.1;
/// A gradient of 1 T/m stands for a field of so much beside the units that make both, T: they are decimetres away.
const FIELD_PER_GRADIENT_M: f64 = 0.1;

/// Along an axis: the coefficient's name, and whether it belongs to the product.
const COEFFICIENTS: [(&str, usize, bool); 6] = [
    ("gradient_x", 0, false),
    ("gradient_y", 1, false),
    ("gradient_z", 2, false),
    ("product_x", 0, true),
    ("product_y", 1, true),
    ("product_z", 2, true),
];

impl Magnetic {
    fn name(&self) -> String {
        format!("magnetic:{}", self.instance)
    }

    /// Where the product of two columns stands.
    fn product(
        &mut self,
        gradient: &Column,
        field: &Column,
        available: &Available,
        link: &mut EffectLink<'_, '_>,
    ) -> Result<Place, PluginError> {
        let name = format!("{}*{}", gradient.name, field.name);
        let unit = if gradient.unit == FIELD_UNIT { "T2" } else { "T2 m-1" };
        let (table, out) = link.slow_series(available, &name, unit, SLOW_HZ)?;
        if let Some(out) = out {
            let columns = [link.read(&Want::of(gradient))?, link.read(&Want::of(field))?];
            self.products.push(Product { columns, out });
        }
        Ok((table, name))
    }

    fn coefficient(&self, name: &str, of_product: bool, squared: bool) -> Coefficient {
        let (max, unit) = scale(of_product, squared);
        Coefficient {
            name: format!("magnetic.{}.{name}", self.instance),
            unit: unit.to_owned(),
            lower: -max,
            upper: max,
            prior_sigma: max / 3.0,
            ..Coefficient::default()
        }
    }
}

/// Largest value and unit of a coefficient; `squared` where a field serves as its own gradient.
fn scale(of_product: bool, squared: bool) -> (f64, &'static str) {
    match (of_product, squared) {
        (false, false) => (GRADIENT_MAX, "m2 s-2 T-1"),
        (true, false) => (PRODUCT_MAX, "m2 s-2 T-2"),
        (false, true) => (GRADIENT_MAX / FIELD_PER_GRADIENT_M, "m s-2 T-1"),
        (true, true) => (PRODUCT_MAX / FIELD_PER_GRADIENT_M, "m s-2 T-2"),
    }
}

impl Effect for Magnetic {
    const MANIFEST: Manifest = manifest(
        "magnetic",
        "Force on a test mass by a magnetic field and its gradient",
        &[
            Parameter::text(
                "gradient",
                "",
                &[],
                "column of the field's gradient, hk.NAME in T m-1 (or in T in place of one)",
            ),
            Parameter::text("field", "", &[], "column of the field, hk.NAME in T; empty for the gradient's part alone"),
        ],
        &["tm1", "tm2"],
        &[],
    );

    fn new(setup: &Setup) -> Result<Self, PluginError> {
        Ok(Self {
            instance: setup.instance().to_owned(),
            candidate: setup.candidate(),
            gradient: setup.text("gradient")?,
            field: setup.text("field")?,
            products: Vec::new(),
        })
    }

    fn link(&mut self, available: &Available, link: &mut EffectLink<'_, '_>) -> Result<(), PluginError> {
        let by = self.name();
        let pairs: Vec<(&Column, Option<&Column>)> = if self.candidate {
            let gradients: Vec<&Column> = housekeeping(available, GRADIENT_UNIT).collect();
            let fields: Vec<&Column> = housekeeping(available, FIELD_UNIT).collect();
            let products = gradients.iter().flat_map(|g| fields.iter().map(move |b| (*g, Some(*b))));
            products.chain(fields.iter().map(|b| (*b, Some(*b)))).collect()
        } else {
            let field = available.columns.iter().find(|c| c.name == self.gradient && c.unit == FIELD_UNIT);
            let gradient = match field {
                Some(field) => field,
                None => named(available, &by, "gradient", &self.gradient, GRADIENT_UNIT)?,
            };
            let field = if self.field.is_empty() {
                None
            } else {
                Some(named(available, &by, "field", &self.field, FIELD_UNIT)?)
            };
            vec![(gradient, field)]
        };
        if pairs.is_empty() {
            return Err(PluginError::error(format!(
                "effect {by}: the telemetry has no magnetic field, a column hk.* in T, so there is nothing to try"
            )));
        }
        let with_product = pairs.iter().all(|(_, field)| field.is_some());
        let used = COEFFICIENTS.into_iter().filter(|(.., of_product)| with_product || !of_product);
        let mut coefficients: Vec<(Coefficient, usize, bool)> = used
            .map(|(name, axis, of_product)| {
                (self.coefficient(name, of_product, pairs[0].0.unit == FIELD_UNIT), axis, of_product)
            })
            .collect();
        for (gradient, field) in pairs {
            let squared = gradient.unit == FIELD_UNIT;
            let product = match field {
                Some(field) => self.product(gradient, field, available, link)?,
                None => Place::default(),
            };
            let names = [("gradient", Some(gradient)), ("field", field)];
            let shape: Shape = names.into_iter().filter_map(|(n, c)| Some((n.to_owned(), json!(c?.name)))).collect();
            for (coefficient, axis, of_product) in &mut coefficients {
                let series = if *of_product { product.clone() } else { place(gradient) };
                let channel = format!("{}.accel.{}", self.instance, AXES[*axis]);
                let responses = on_channels(available, &by, vec![response(channel, &series, 1.0)])?;
                if self.candidate {
                    let (max, unit) = scale(*of_product, squared);
                    let (unit, range) = (Some(unit.to_owned()), Some([-max, max]));
                    coefficient.variants.push(Variant { shape: shape.clone(), responses, unit, range, colours: None });
                } else {
                    (coefficient.shape, coefficient.responses) = (shape.clone(), responses);
                }
            }
        }
        coefficients.iter().try_for_each(|(coefficient, ..)| link.coefficient(coefficient))
    }

    fn process(&mut self, input: &Inputs<'_>, output: &mut Outputs) -> Result<(), PluginError> {
        for Product { columns: [a, b], out } in &self.products {
            output.f64(*out).extend(input.f64(*a).iter().zip(input.f64(*b)).map(|(a, b)| a * b));
        }
        Ok(())
    }
}
