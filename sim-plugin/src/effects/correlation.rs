//! Noise of single thrusters, with correlated force and torque.

use dragfree_physics::mission::{Mission, MissionError};
use rand_xoshiro::Xoshiro256PlusPlus;

use super::request::{Built, EffectRequest, Kind, Number, Place};
use super::{Basis, Cause, Moment};
use crate::plant::Loads;
use crate::thrusters::{Layout, ThrusterNoise};

pub(super) const KINDS: &[Kind] = &[Kind {
    id: "mps-correlation",
    places: |_| vec![Place::Layout],
    size: Number::new("N Hz^-0.5", 0.0, 1e-5),
    help: "thrusters: noise of this ASD in each of six thrusters, white, in place of the noise along and about the axes; \
           7e-8 is as much force along each axis as 1e-7 there",
    shape: &[],
    build,
}];

/// That the thrusters' noise is that along and about the axes, and not of units.
pub(super) fn noise_along_axes(mission: &Mission) -> Result<(), MissionError> {
    let units = mission.thrusters.as_ref().map_or(0, |thrusters| thrusters.unit.len());
    if units == 0 {
        return Ok(());
    }
    Err(MissionError::Value {
        key: "thrusters.unit".to_owned(),
        value: format!("{units} units"),
        reason: "have noise of their own already, which pushes and turns at once: change their asd_n_rthz instead",
    })
}

/// Adds `Σ n_i (d_i, r_i × d_i)` of [`Layout::six`]: the cross-spectrum of force and torque is `Σ S d_i (r_i × d_i)ᵀ`.
struct Correlation(ThrusterNoise);

fn build(request: &EffectRequest, basis: &Basis<'_>) -> Built {
    noise_along_axes(basis.mission)?;
    Ok(Box::new(Correlation(ThrusterNoise::new(Layout::six(request.size), basis.mission.dt_s()))))
}

impl Cause for Correlation {
    fn replaces_thruster_noise(&self) -> bool {
        true
    }

    fn push(&mut self, _now: &Moment<'_>, rng: &mut Xoshiro256PlusPlus, loads: &mut Loads) {
        let (force_srf_n, torque_srf_nm) = self.0.sample(rng);
        loads.force_srf_n += force_srf_n;
        loads.torque_srf_nm += torque_srf_nm;
    }
}
