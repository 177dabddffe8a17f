//! Forces on a test mass by charge and by magnetic field: `charge`, `magnetic`.

use dragfree_physics::mission::Mission;
use dragfree_sdk::prelude::*;
use serde_json::json;

use crate::common::{
    AXES, SLOW_HZ, SeriesRef, TEST_MASSES, find_housekeeping, housekeeping_in, keep_available, manifest, mission,
    response, series_of, symmetric,
};

/// `charge`: a charged test mass in the field of stray voltages.
///
/// `a_x = q(t)/C ∂C/∂x ΔV/m` (Shaul et al.; LISA Pathfinder: Armano et al., PRL 118, 171101). The coefficient is the
/// stray voltage `ΔV` across x, V; positive if it pushes a positive charge along +x. Variations of the charge, which
/// cosmic rays raise and discharges lower, determine it. **Range** ±1 V: housings show 0.1 V and less.
///
/// Noise of the measured charge attenuates `ΔV` (errors in variables) by its ratio to the charge's variation, parts in
/// a thousand. **Confounders**: without a discharge, any slow drift.
///
/// As a candidate it has series of its own that are known to be slow: a charge drifts over hours, below the spectra,
/// and which of the measured charges acts on this test mass is told by the slowest samples alone.
#[derive(Debug)]
pub(crate) struct Charge {
    setup: Setup,
    mission: Mission,
    slow: Vec<(In, Out)>,
}

impl Charge {
    fn responses(&self, available: &Available, series: &SeriesRef) -> Result<Vec<Response>, PluginError> {
        let instance = self.setup.instance();
        let mass_kg = self.mission.test_mass(instance, "the effect charge")?.mass_kg;
        let factor = self.setup.f64("gradient_f_m")? / (self.setup.f64("capacitance_f")? * mass_kg);
        let x = response(format!("{instance}.accel.x"), series, factor);
        keep_available(available, &format!("charge:{instance}"), vec![x])
    }
}

impl Effect for Charge {
    const MANIFEST: Manifest = manifest(
        "charge",
        "Force along x by the charge of a test mass and a stray voltage",
        &[
            Parameter::text("charge", "", &[], "column of the measured charge, hk.NAME in C"),
            Parameter::f64("capacitance_f", "F", 34.2e-12, 1e-13..=1e-9, "total capacitance of the test mass"),
            Parameter::f64(
                "gradient_f_m",
                "F m-1",
                291e-12,
                1e-12..=1e-8,
                "derivative of an x electrode's capacitance along x",
            ),
        ],
        TEST_MASSES,
        &[],
    );

    fn new(setup: &Setup) -> Result<Self, PluginError> {
        Ok(Self { setup: setup.clone(), mission: mission(setup)?, slow: Vec::new() })
    }

    fn link(&mut self, available: &Available, link: &mut EffectLink<'_, '_>) -> Result<(), PluginError> {
        let instance = self.setup.instance();
        let mut coefficient = Coefficient {
            name: format!("charge.{instance}"),
            unit: "V".to_owned(),
            lower: -1.0,
            upper: 1.0,
            prior_sigma: 0.3,
            ..Coefficient::default()
        };
        let shape = |c: &Column| Shape::from([("charge".to_owned(), json!(c.name))]);
        if self.setup.candidate() {
            for column in housekeeping_in(available, "C") {
                let name = format!("charge({})", column.name);
                let (table, out) = link.slow_series(available, &name, "C", SLOW_HZ)?;
                if let Some(out) = out {
                    self.slow.push((link.read(&Want::of(column))?, out));
                }
                let responses = self.responses(available, &(table, name))?;
                coefficient.variants.push(Variant { shape: shape(column), responses, ..Variant::default() });
            }
            if coefficient.variants.is_empty() {
                return Err(PluginError::error(format!(
                    "effect charge:{instance}: the telemetry has no charge (a column hk.* in C), so this candidate has no form"
                )));
            }
        } else {
            let (by, name) = (format!("charge:{instance}"), self.setup.text("charge")?);
            let column = find_housekeeping(available, &by, "charge", &name, "C")?;
            (coefficient.shape, coefficient.responses) =
                (shape(column), self.responses(available, &series_of(column))?);
        }
        link.coefficient(&coefficient)
    }

    fn process(&mut self, input: &Inputs<'_>, output: &mut Outputs) -> Result<(), PluginError> {
        for (column, out) in &self.slow {
            output.f64(*out).extend_from_slice(input.f64(*column));
        }
        Ok(())
    }
}

/// `magnetic`: the test mass has a remanent moment and a susceptibility in a non-uniform field.
///
/// Along axis i the acceleration is `p_i g + c_i g B` for a measured gradient `g(t)` and field component `B(t)`;
/// Methods, "Magnetic force". Coefficients:
///
/// * `gradient_x|y|z` = `p_i`, m s⁻² per T/m, ±5e-8: remanent moment and steady field.
/// * `product_x|y|z` = `c_i`, m s⁻² per T · T/m, ±0.012: susceptibility in the measured field.
///
/// Telemetry without gradients uses a field column as its own gradient (`g = B`). The signs follow those of the
/// columns. **Confounders**: everything that follows the bus current, such as heaters; `g²` and `g B` are collinear if
/// the units' own field dominates.
#[derive(Debug)]
pub(crate) struct Magnetic {
    setup: Setup,
    products: Vec<Product>,
}

/// Product of two columns.
#[derive(Debug)]
struct Product {
    columns: [In; 2],
    out: Out,
}

const GRADIENT_UNIT: &str = "T m-1";
const FIELD_UNIT: &str = "T";
/// Three times |χ|/(ρμ₀) with |χ| ≤ 1e-4 and the density ρ = 2e4 kg/m³ of gold and platinum: LISA Pathfinder's test
/// masses have |χ| = 3.4e-5 (arXiv:2407.04427). The factor three stands for gradients along axes that are not measured.
const PRODUCT_MAX: f64 = 0.012;
/// Three times 20 nA m² over 2 kg, twice the moment that LISA Pathfinder allowed, and the susceptibility in a steady
/// field of 1.5 µT.
const GRADIENT_MAX: f64 = 5e-8;
/// Field per gradient of the units that cause both, m: they are decimetres away. It scales ranges of `g = B`.
const FIELD_PER_GRADIENT_M: f64 = 0.1;

/// Name, axis and whether the coefficient belongs to the product.
const COEFFICIENTS: [(&str, usize, bool); 6] = [
    ("gradient_x", 0, false),
    ("gradient_y", 1, false),
    ("gradient_z", 2, false),
    ("product_x", 0, true),
    ("product_y", 1, true),
    ("product_z", 2, true),
];

impl Magnetic {
    /// Series of the product of two columns.
    fn product(
        &mut self,
        gradient: &Column,
        field: &Column,
        available: &Available,
        link: &mut EffectLink<'_, '_>,
    ) -> Result<SeriesRef, PluginError> {
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
        symmetric(format!("magnetic.{}.{name}", self.setup.instance()), unit, max)
    }
}

/// Maximum and unit of a coefficient; `squared` where a field serves as its own gradient.
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
                "column of the field's gradient, hk.NAME in T m-1; without one, a field in T",
            ),
            Parameter::text("field", "", &[], "column of the field, hk.NAME in T; empty for the gradient terms alone"),
        ],
        TEST_MASSES,
        &[],
    );

    fn new(setup: &Setup) -> Result<Self, PluginError> {
        Ok(Self { setup: setup.clone(), products: Vec::new() })
    }

    fn link(&mut self, available: &Available, link: &mut EffectLink<'_, '_>) -> Result<(), PluginError> {
        let instance = self.setup.instance().to_owned();
        let (by, candidate) = (format!("magnetic:{instance}"), self.setup.candidate());
        let pairs: Vec<(&Column, Option<&Column>)> = if candidate {
            let gradients: Vec<&Column> = housekeeping_in(available, GRADIENT_UNIT).collect();
            let fields: Vec<&Column> = housekeeping_in(available, FIELD_UNIT).collect();
            let products = gradients.iter().flat_map(|g| fields.iter().map(move |b| (*g, Some(*b))));
            products.chain(fields.iter().map(|b| (*b, Some(*b)))).collect()
        } else {
            let (gradient, field) = (self.setup.text("gradient")?, self.setup.text("field")?);
            let gradient = match available.columns.iter().find(|c| c.name == gradient && c.unit == FIELD_UNIT) {
                Some(field) => field,
                None => find_housekeeping(available, &by, "gradient", &gradient, GRADIENT_UNIT)?,
            };
            let find = || find_housekeeping(available, &by, "field", &field, FIELD_UNIT);
            vec![(gradient, (!field.is_empty()).then(find).transpose()?)]
        };
        if pairs.is_empty() {
            return Err(PluginError::error(format!(
                "effect {by}: the telemetry has no magnetic field (a column hk.* in T), so this candidate has no form"
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
                None => SeriesRef::default(),
            };
            let names = [("gradient", Some(gradient)), ("field", field)];
            let shape: Shape = names.into_iter().filter_map(|(n, c)| Some((n.to_owned(), json!(c?.name)))).collect();
            for (coefficient, axis, of_product) in &mut coefficients {
                let series = if *of_product { product.clone() } else { series_of(gradient) };
                let channel = format!("{instance}.accel.{}", AXES[*axis]);
                let responses = keep_available(available, &by, vec![response(channel, &series, 1.0)])?;
                if candidate {
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
