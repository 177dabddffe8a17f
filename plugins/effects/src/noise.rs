//! Noise that is larger than the mission file says: `mps-noise`, `torque-noise`, `is-noise`.
//!
//! The coefficient k multiplies the amplitude spectral density of one process of the mission's noise: 1 is as the mission file
//! has it, and k² the power. It adds nothing to a channel's mean and has no response; it names its process, by which the
//! critic's Σ(f; k) changes:
//!
//! | effect | process | seen in |
//! |---|---|---|
//! | `mps-noise:sc.AXIS` | `thruster_force:sc.AXIS`, N/√Hz, SRF | both test masses in common, `T_S^{O_i} e/m_S` |
//! | `torque-noise:sc.AXIS` | `thruster_torque:sc.AXIS`, N m/√Hz, SRF | attitude, `J_S⁻¹ e` |
//! | `is-noise:tmN.AXIS` | `readout:tmN.AXIS`, m/√Hz, ORF | one axis of one test mass, rising as f² |
//!
//! In a model such an effect says what is known and changes nothing in es-akf or qp-check: these refine Σ from the residuals
//! anyway. **Range** 0.2 to 20. **Confounders.** Any unexplained force of the same spectrum; force noise along two axes of the
//! same test masses when only one of them is read; thrusters that sit on a layout make force and torque noise together.

use dragfree_sdk::prelude::*;

use crate::common::{TM_AXES, manifest};

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
    MpsNoise, "mps-noise", "thruster_force", "The thrusters' force noise along an axis is larger or smaller",
    &["sc.x", "sc.y", "sc.z"]
}
noise_effect! {
    /// Torque noise of the thrusters about an axis of SRF.
    TorqueNoise, "torque-noise", "thruster_torque", "The thrusters' torque noise about an axis is larger or smaller",
    &["sc.x", "sc.y", "sc.z"]
}
noise_effect! {
    /// Noise of the capacitive readout along an axis of ORF.
    IsNoise, "is-noise", "readout", "The readout noise along an axis is larger or smaller", &TM_AXES
}
