//! Forces that depend on where a test mass is and how it is turned: `stiffness`, `cross-stiffness`.
//!
//! Both act through a readout, held where it has no value. A channel's sample at `t_k` holds the readouts up to `t_{k+1}`, of
//! which the series knows those up to `t_k`: it is causal with respect to the channel, so that the readout's noise in it does not
//! bias a fit over the whole band. Within a sample the displacement moves by some 1e-10 m, which is left out.
//!
//! Usually below detection: displacements of 1e-8 m change by the nominal stiffness of 1e-6 s⁻² what a nanometre of readout noise
//! hides; the honest answer is an upper limit.

use dragfree_physics::mission::Mission;
use dragfree_sdk::prelude::*;

use crate::linear::{ANGLES, Linear, Part, Recipe, Series, Source, Term, accel, tm_axis};

const STIFFNESS_S2: [f64; 2] = [-1e-5, 1e-5];
const CROSS_M_S2_RAD: [f64; 2] = [-1e-6, 1e-6];

const INSTANCES: &[&str] = &["tm1.x", "tm1.y", "tm1.z", "tm2.x", "tm2.y", "tm2.z"];

/// `stiffness`: the element of `S_TT` along an axis of ORF is not the mission file's.
///
/// `z = ΔS r` with the measured displacement; ΔS: s⁻², ±1e-5, positive pushes away from the centre. The mission file's own
/// stiffness is in `û` already (eq:TM_SC_relative_acceleration, `F_st`). Confounders: gains of what holds the test mass.
#[derive(Debug)]
pub(crate) struct StiffnessRecipe(usize, usize);

/// See [`StiffnessRecipe`].
pub(crate) type Stiffness = Linear<StiffnessRecipe>;

impl Recipe for StiffnessRecipe {
    const MANIFEST: Manifest = Manifest {
        id: "stiffness",
        version: env!("CARGO_PKG_VERSION"),
        licence: "MIT OR Apache-2.0",
        description: "A test mass is pushed or pulled by its displacement more than the mission file says",
        parameters: &[],
        instances: INSTANCES,
        needs: &[],
    };

    fn new(setup: &Setup) -> Result<Self, PluginError> {
        let (tm, axis) = tm_axis(setup.instance());
        Ok(Self(tm, axis))
    }

    fn parts(&self, _: &Mission, _: &Available) -> Result<Vec<Part>, PluginError> {
        let Self(tm, axis) = *self;
        let terms = vec![Term::new(accel(tm, axis), Series::Held(Source::displacement(tm, axis)), 1.0)];
        Ok(Part::only("s-2", STIFFNESS_S2, terms))
    }
}

/// `cross-stiffness`: the element of `S_TR` along and about an axis of ORF is not the mission file's.
///
/// `z = ΔS θ` with the measured angle about the axis, local wavefront sensing for `θ` and `ψ`, the inertial sensor for `φ`;
/// ΔS: m s⁻² rad⁻¹, ±1e-6. The torque that belongs to it, `J_m S_RT = m S_TRᵀ`, is in no channel.
#[derive(Debug)]
pub(crate) struct CrossStiffnessRecipe(usize, usize);

/// See [`CrossStiffnessRecipe`].
pub(crate) type CrossStiffness = Linear<CrossStiffnessRecipe>;

impl Recipe for CrossStiffnessRecipe {
    const MANIFEST: Manifest = Manifest {
        id: "cross-stiffness",
        version: env!("CARGO_PKG_VERSION"),
        licence: "MIT OR Apache-2.0",
        description: "A test mass is pushed by its angle more than the mission file says",
        parameters: &[],
        instances: INSTANCES,
        needs: &[],
    };

    fn new(setup: &Setup) -> Result<Self, PluginError> {
        let (tm, axis) = tm_axis(setup.instance());
        Ok(Self(tm, axis))
    }

    fn parts(&self, _: &Mission, available: &Available) -> Result<Vec<Part>, PluginError> {
        let Self(tm, axis) = *self;
        let local = Source::angle_by_dws(tm, ANGLES[axis]);
        let angle = if available.find(&local.name).is_some() { local } else { Source::angle_by_is(tm, ANGLES[axis]) };
        Ok(Part::only("m s-2 rad-1", CROSS_M_S2_RAD, vec![Term::new(accel(tm, axis), Series::Held(angle), 1.0)]))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bench::Bench;
    use crate::linear::AXES;
    use nalgebra::Vector3;

    #[test]
    fn a_spring_pushes_by_its_own_axis_displacement_or_angle() {
        for (tm, axis) in [(0, 0), (0, 1), (1, 2)] {
            let r_orf_m = [Vector3::new(0.4, -0.3, 0.2), Vector3::new(-0.2, 0.5, 0.6)];
            let angle_orf_rad = [Vector3::new(0.3, 0.7, -0.2), Vector3::new(0.1, -0.4, 0.5)];
            let bench = Bench { r_orf_m, angle_orf_rad, ..Bench::new() };
            let instance = format!("tm{}.{}", tm + 1, AXES[axis]);
            bench.check::<StiffnessRecipe>(&instance, "", &[&|w, s| w.stiffness_s2[tm][(axis, axis)] += s]);
            bench.check::<CrossStiffnessRecipe>(&instance, "", &[&|w, s| w.cross_m_s2_rad[tm][(axis, axis)] += s]);
        }
    }

    #[test]
    fn angles_come_from_the_finer_instrument_where_there_is_one() {
        let bench = Bench::new();
        let mut available = bench.available();
        let name = |available: &Available| {
            let parts = CrossStiffnessRecipe(1, 2).parts(&bench.mission, available).unwrap();
            parts[0].forms[0].terms[0].series.name()
        };
        assert_eq!(name(&available), "held(is.tm2.att_orf_rad.psi)");
        available.columns.push(Column { name: "dws.tm2.psi_orf_rad".to_owned(), ..Column::default() });
        assert_eq!(name(&available), "held(dws.tm2.psi_orf_rad)");
    }
}
