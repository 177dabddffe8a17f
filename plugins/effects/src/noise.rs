//! Noise levels that differ from the mission file: `mps-noise`, `torque-noise`, `is-noise`.
//!
//! The coefficient k scales the amplitude spectral density of one noise process; 1 is the mission file's level. It has
//! no regressor: the identification varies Σ(f; k) of the named process.
//!
//! | effect | process | channels |
//! |---|---|---|
//! | `mps-noise:sc.AXIS` | `thruster_force:sc.AXIS`, N/√Hz, SRF | test masses, in common: `T_S^{O_i} e/m_S` |
//! | `torque-noise:sc.AXIS` | `thruster_torque:sc.AXIS`, N m/√Hz, SRF | attitude: `J_S⁻¹ e` |
//! | `is-noise:tmN.AXIS` | `readout:tmN.AXIS`, m/√Hz, ORF | one axis of one test mass, rising as f² |
//!
//! **In a model** the value of the entry scales the declared noise of its component ([`NoiseLevels`])
//! for the batch solution, the recursive filters, `compare` and `diagnose`. Left free, the batch solution estimates the
//! level by the likelihood of the residuals; the recursive filters use the value of the entry in any case. The smoother
//! of the angular acceleration stands before the effects and measures the level of the torque noise by itself.
//! **Range**: 0.2 to 20. **Confounders**: any unmodelled force of the same spectrum; thruster force along axes that
//! share the channels that are read; thrusters in a layout, whose force and torque noise are correlated.

use dragfree_sdk::prelude::*;

use crate::common::{SC_AXES, TM_AXES, manifest};

fn link(process: &str, id: &str, instance: &str, link: &mut EffectLink<'_, '_>) -> Result<(), PluginError> {
    link.coefficient(&Coefficient {
        name: format!("{id}.{instance}"),
        lower: 0.2,
        upper: 20.0,
        initial: 1.0,
        prior_sigma: 1.0,
        noise: format!("{process}:{instance}"),
        ..Coefficient::default()
    })
}

macro_rules! noise_effect {
    ($(#[$doc:meta])* $name:ident, $id:literal, $process:literal, $description:literal, $instances:expr) => {
        $(#[$doc])*
        #[derive(Debug)]
        pub(crate) struct $name {
            instance: String,
        }

        impl Effect for $name {
            const MANIFEST: Manifest = manifest($id, $description, &[], $instances, &[]);

            fn new(setup: &Setup) -> Result<Self, PluginError> {
                Ok(Self { instance: setup.instance().to_owned() })
            }

            fn link(&mut self, _available: &Available, to: &mut EffectLink<'_, '_>) -> Result<(), PluginError> {
                link($process, $id, &self.instance, to)
            }

            fn process(&mut self, _input: &Inputs<'_>, _output: &mut Outputs) -> Result<(), PluginError> {
                Ok(())
            }
        }
    };
}

noise_effect! {
    /// Force noise of the thrusters along an axis of SRF.
    MpsNoise, "mps-noise", "thruster_force", "Level of the thrusters' force noise along an axis",
    SC_AXES
}
noise_effect! {
    /// Torque noise of the thrusters about an axis of SRF.
    TorqueNoise, "torque-noise", "thruster_torque", "Level of the thrusters' torque noise about an axis",
    SC_AXES
}
noise_effect! {
    /// Noise of the capacitive readout along an axis of ORF.
    IsNoise, "is-noise", "readout", "Level of the capacitive readout noise along an axis", TM_AXES
}
