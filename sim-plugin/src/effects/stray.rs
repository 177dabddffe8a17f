//! Stray forces on a test mass by the spacecraft's interior: temperature, magnetic field, charge, current.

use nalgebra::{Matrix3, Vector3};
use rand_xoshiro::Xoshiro256PlusPlus;

use super::request::{EffectRequest, Kind, Number, Place, Shape, test_masses, tm_axes};
use super::{Cause, Moment, along};
use crate::interior::{FIELD_T, GRADIENT_T_M, of_housing};
use crate::plant::Loads;

/// Vacuum permeability, T m/A, and density of the test mass (gold and platinum), kg/m³.
const MU_0_T_M_A: f64 = 1.256_637_061_27e-6;
const DENSITY_KG_M3: f64 = 2.0e4;
/// Capacitance of the test mass, F, and its derivative along the sensitive axis, F/m (LISA Pathfinder).
const CAPACITANCE_F: f64 = 34.2e-12;
const CAPACITANCE_GRADIENT_F_M: f64 = 291e-12;
/// Mean current and mean temperature of the structure.
const CURRENT_A: f64 = 2.1;
const STRUCTURE_K: f64 = 296.5;

const LAG: Number = Number::new("s", 0.0, 1e6);

pub(super) const KINDS: &[Kind] = &[
    Kind {
        id: "thermal",
        places: tm_axes,
        size: Number::new("m s-2 K-1", -1e-8, 1e-8),
        help: "SIZE times the temperature of the positive face of the housing minus that of the negative one, behind a lag",
        shape: &[Shape::new("lag_s", LAG, 480.0, "lag, s")],
        build: |request, _| Ok(Lagged::boxed(request, |now, tm, axis| now.inside.across_k[tm][axis])),
    },
    Kind {
        id: "magnetic",
        places: test_masses,
        size: Number::new("1", -1.0, 1.0),
        help: "SIZE is the susceptibility χ: χ/(μ0 ρ) (B·∇)B, and the remanent moment's ∇(m·B)/m",
        shape: &[Shape::new("moment_a_m2", Number::new("A m2", -1e-3, 1e-3), 0.0, "remanent moment along x, A m²")],
        build: |request, _| {
            let Place::Tm(tm) = request.place else { unreachable!("instances are test masses") };
            Ok(Box::new(Magnetic { tm, susceptibility: request.size, moment_a_m2: request.shape("moment_a_m2") }))
        },
    },
    Kind {
        id: "charge",
        places: test_masses,
        size: Number::new("V", -10.0, 10.0),
        help: "stray voltage across x: charge/C ∂C/∂x SIZE, along x",
        shape: &[],
        build: |request, _| {
            let Place::Tm(tm) = request.place else { unreachable!("instances are test masses") };
            Ok(Box::new(Charge { tm, voltage_v: request.size }))
        },
    },
    Kind {
        id: "current-force",
        places: tm_axes,
        size: Number::new("m s-2 A-2", -1e-8, 1e-8),
        help: "SIZE times the square of the battery's current, behind a lag",
        shape: &[Shape::new("lag_s", LAG, 50.0, "lag, s")],
        build: |request, _| Ok(Lagged::boxed(request, |now, _, _| now.inside.battery_a * now.inside.battery_a)),
    },
    Kind {
        id: "product-force",
        places: tm_axes,
        size: Number::new("m s-2 A-1 K-1", -1e-8, 1e-8),
        help: "SIZE times the product of battery current and structure temperature, each about its level",
        shape: &[],
        build: |request, _| {
            Ok(Lagged::boxed(request, |now, _, _| {
                (now.inside.battery_a - CURRENT_A) * (now.inside.structure_k - STRUCTURE_K)
            }))
        },
    },
    Kind {
        id: "field-force",
        places: tm_axes,
        size: Number::new("m s-2 T-2", -1e3, 1e3),
        help: "SIZE times the square of the magnetic field along the axis",
        shape: &[],
        build: |request, _| Ok(Lagged::boxed(request, |now, tm, axis| field_orf_t(now, tm)[axis].powi(2))),
    },
];

/// Field at a test mass, ORF, T.
fn field_orf_t(now: &Moment<'_>, tm: usize) -> Vector3<f64> {
    now.plant.tm[tm].dcm_orf_from_srf * Vector3::from(now.inside.interplanetary_t)
        + Vector3::from(*of_housing(&FIELD_T, tm)) * now.inside.units_field[tm]
}

/// A force proportional to a quantity of the interior behind a first-order lag.
struct Lagged {
    tm: usize,
    axis: usize,
    size: f64,
    lag_s: f64,
    driver: fn(&Moment<'_>, usize, usize) -> f64,
    /// The lagged quantity; the first sample starts it settled.
    value: Option<f64>,
}

impl Lagged {
    fn boxed(request: &EffectRequest, driver: fn(&Moment<'_>, usize, usize) -> f64) -> Box<dyn Cause> {
        let Place::TmAxis(tm, axis) = request.place else { unreachable!("instances are axes of a test mass") };
        let lag_s = if request.kind.shape.is_empty() { 0.0 } else { request.shape("lag_s") };
        Box::new(Self { tm, axis, size: request.size, lag_s, driver, value: None })
    }
}

impl Cause for Lagged {
    fn push(&mut self, now: &Moment<'_>, _rng: &mut Xoshiro256PlusPlus, loads: &mut Loads) {
        let target = (self.driver)(now, self.tm, self.axis);
        let value = self.value.get_or_insert(target);
        *value += (target - *value) * if self.lag_s > 0.0 { -(-now.dt_s / self.lag_s).exp_m1() } else { 1.0 };
        loads.tm[self.tm].acceleration_orf_m_s2[self.axis] += self.size * *value;
    }

    fn states(&self) -> Vec<f64> {
        self.value.into_iter().collect()
    }

    fn set_states(&mut self, states: &[f64]) -> bool {
        self.value = states.first().copied();
        states.len() <= 1
    }
}

struct Magnetic {
    tm: usize,
    susceptibility: f64,
    moment_a_m2: f64,
}

/// `∂B_i/∂x_j` of the units' field: symmetric and without trace.
fn gradient(tm: usize) -> Matrix3<f64> {
    let [xx, yy, xy, xz, yz] = *of_housing(&GRADIENT_T_M, tm);
    Matrix3::new(xx, xy, xz, xy, yy, yz, xz, yz, -xx - yy)
}

impl Cause for Magnetic {
    fn push(&mut self, now: &Moment<'_>, _rng: &mut Xoshiro256PlusPlus, loads: &mut Loads) {
        let body = &now.plant.tm[self.tm];
        let units = now.inside.units_field[self.tm];
        let field = field_orf_t(now, self.tm);
        let per_field = self.susceptibility / (MU_0_T_M_A * DENSITY_KG_M3);
        let source = field * per_field + along(0) * (self.moment_a_m2 / body.mass_kg);
        loads.tm[self.tm].acceleration_orf_m_s2 += gradient(self.tm) * source * units;
    }
}

struct Charge {
    tm: usize,
    voltage_v: f64,
}

impl Cause for Charge {
    fn push(&mut self, now: &Moment<'_>, _rng: &mut Xoshiro256PlusPlus, loads: &mut Loads) {
        let force_n = now.inside.charge_c[self.tm] / CAPACITANCE_F * CAPACITANCE_GRADIENT_F_M * self.voltage_v;
        loads.tm[self.tm].acceleration_orf_m_s2.x += force_n / now.plant.tm[self.tm].mass_kg;
    }
}
