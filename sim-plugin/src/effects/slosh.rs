//! Propellant slosh: a damped mode of a slug in its tank, coupled to the spacecraft's translation.

use nalgebra::{Matrix2, Vector2};
use std::f64::consts::TAU;

use super::request::{Built, EffectRequest, Kind, Number, Place, Shape};
use super::{Basis, Cause, Moment, along};
use crate::plant::Loads;

pub(super) const KINDS: &[Kind] = &[Kind {
    id: "slosh",
    places: |_| vec![Place::ScAxis(0), Place::ScAxis(1)],
    size: Number::new("1", 0.0, 0.5),
    help: "propellant: this part of the spacecraft's mass swings along the axis",
    shape: &[
        Shape::new("f0_hz", Number::new("Hz", 1e-4, 1.0), 0.03, "frequency of the slug with the spacecraft held, Hz"),
        Shape::new("zeta", Number::new("1", 0.0, 2.0), 0.02, "damping ratio"),
    ],
    build,
}];

/// Slug `m_f` at `x` from its rest, spacecraft without it `m_S − m_f`, force `F` on the spacecraft:
///
/// `(m_S − m_f) a = F + κ`, `m_f (a + ẍ) = −κ`, `κ = m_f (ω0² x + 2ζω0 ẋ)`.
///
/// The plant has `m_S a = F + F_s`, so the slug adds `F_s = −m_f ẍ`. The discretisation is exact for a constant force
/// over a sample, as is the mean of `ẍ`, from the change of `ẋ`.
struct Slosh {
    axis: usize,
    slug_kg: f64,
    /// `exp(A dt)` of `(x, ẋ)`, and the response to a force of 1 N over a sample.
    transition: Matrix2<f64>,
    input: Vector2<f64>,
    dt_s: f64,
    state: Vector2<f64>,
}

fn build(request: &EffectRequest, basis: &Basis<'_>) -> Built {
    let Place::ScAxis(axis) = request.place else { unreachable!("instances are axes of the spacecraft") };
    let (omega, zeta) = (TAU * request.shape("f0_hz"), request.shape("zeta"));
    let dt_s = basis.mission.dt_s();
    let mass_kg = basis.mission.spacecraft.mass_kg;
    let rest_kg = mass_kg * (1.0 - request.size);
    let raised = mass_kg / rest_kg;
    let rates = Matrix2::new(0.0, 1.0, -raised * omega * omega, -raised * 2.0 * zeta * omega);
    // ∫ exp(A s) ds by its power series.
    let (mut term, mut integral, mut transition) = (Matrix2::identity() * dt_s, Matrix2::zeros(), Matrix2::identity());
    for k in 1..40 {
        integral += term;
        transition += rates * term;
        term = rates * term * (dt_s / f64::from(k + 1));
    }
    let input = integral * Vector2::new(0.0, -1.0 / rest_kg);
    Ok(Box::new(Slosh { axis, slug_kg: mass_kg * request.size, transition, input, dt_s, state: Vector2::zeros() }))
}

impl Cause for Slosh {
    fn react(&mut self, now: &Moment<'_>, loads: &mut Loads) {
        let force_n = loads.net_force_srf_n(now.plant)[self.axis];
        let next = self.transition * self.state + self.input * force_n;
        let force_n = -self.slug_kg * (next[1] - self.state[1]) / self.dt_s;
        self.state = next;
        loads.force_srf_n += along(self.axis) * force_n;
    }

    fn states(&self) -> Vec<f64> {
        self.state.iter().copied().collect()
    }

    fn set_states(&mut self, states: &[f64]) -> bool {
        crate::random::fill(self.state.iter_mut(), states)
    }
}
