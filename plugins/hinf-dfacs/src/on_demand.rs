//! Columns written only if an effect requests them: commands as executed, and derivatives of `α̂` with respect to a
//! torque gain and to a delay of the attitude readout. Derivations: Methods, "Derivatives of α̂".
//!
//! `α̂ = α_c + D[θ, α_c]` with the commanded `α_c` and the smoother `D`, which is linear in both arguments.
//! * Torque: `∂α̂/∂g_i = J⁻¹ e_i M_i + D[0, J⁻¹ e_i M_i]`.
//! * Delay: `∂α̂/∂τ = D[−ω, 0] = D[0, rate steps Δα̂]`, for the channels of the test masses only. The attitude
//!   channels share the readout noise of `α̂`; their regressor is the commanded acceleration without the smoother.
//!
//! In prediction mode `α̂ = α_c`, and `D` is left out of both.

use dragfree_physics::control::PerTestMass;
use dragfree_physics::mission::{AXES, Mission};
use dragfree_sdk::PREDICTION_NEED;
use dragfree_sdk::state::{State, StateError};
use nalgebra::{Matrix3, Vector3};

use crate::replay::{CommandNumbers, command_vectors, electrodes_of, visit_command};
use crate::smoother::{Perturbation, ResponseState, Smoothed, Smoother};

/// Whether a requested column is made from commands: all are, except the Sun's direction and the derivative for a delay
/// of the wavefront sensing, which is made from the smoothed attitude.
pub(crate) fn is_in_loop(column: &str) -> bool {
    !column.starts_with("used.sun_srf.") && !column.starts_with("response.alpha_srf_rad_s2.by_dws_delay.")
}

/// What effects and the host request; nothing by default.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Needs {
    /// `used.*`: commands (N, N m) and Sun direction from which `û` is made, means over `[t_k, t_{k+1})`.
    pub commands: bool,
    /// `response.alpha_srf_rad_s2.by_torque_gain.I.J`, `∂α̂_J/∂g_I`, rad s⁻², for a torque about axis `I` of
    /// `(1 + g_I)` times the commanded one. If thrusters have a layout, so that noise of their torque and force is
    /// correlated, also `response.u_orf_m_s2.by_torque_gain.I.NAME.J`, the derivative of a test mass's `û`, m s⁻².
    pub torque_response: bool,
    /// `response.alpha_srf_rad_s2.by_dws_delay.J`, `∂α̂_J/∂τ`, rad s⁻³, for a delay `τ` of long-arm sensing. Only for
    /// the channels of the test masses; see the module.
    pub dws_delay_response: bool,
    /// Prediction mode ([`dragfree_sdk::PREDICTION_NEED`]): columns from which effects make regressors depend on
    /// commands and past readouts alone.
    pub prediction: bool,
}

impl Needs {
    /// Whether any column is a derivative of the smoothed `α̂`.
    pub fn smoothed_responses(&self) -> bool {
        (self.torque_response || self.dws_delay_response) && !self.prediction
    }

    /// The needs in words. The state stores them, and the error about a state of another model quotes them.
    pub(crate) fn describe(self) -> String {
        let all = [
            ("commands", self.commands),
            ("torque-response", self.torque_response),
            ("dws-delay-response", self.dws_delay_response),
            (PREDICTION_NEED, self.prediction),
        ];
        let names: Vec<&str> = all.iter().filter(|(_, needed)| *needed).map(|(name, _)| *name).collect();
        format!("one whose effects need [{}]", names.join(", "))
    }
}

/// Command as executed and Sun direction of one interval; NaN where unknown.
#[derive(Clone, Copy, Debug, Default)]
struct Executed {
    command: CommandNumbers,
    sun_srf: Vector3<f64>,
}

/// Whether an emitted epoch has `α̂` and each test mass's `û`; otherwise their derivatives are NaN.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Availability {
    pub(crate) alpha: bool,
    pub(crate) u: PerTestMass<bool>,
}

/// Makes the requested columns.
#[derive(Clone, Debug)]
pub(crate) struct OnDemand {
    needs: Needs,
    inertia_inverse: Matrix3<f64>,
    /// See `Reconstruction`; zero unless thrusters have a layout.
    tm_accel_per_alpha: Vec<Matrix3<f64>>,
    /// Names, units and frames of the vectors of a command, and names and frames of the test masses.
    vectors: Vec<(String, &'static str, String)>,
    test_masses: Vec<(String, String)>,
    /// One for each epoch that waits for the smoother.
    executed: Vec<Executed>,
    torque: [ResponseState; 3],
    delay: ResponseState,
    /// Change of `α̂` at the start of the oldest waiting epoch. Both values come from the same smoothing, because the
    /// estimate of the slow torque changes from block to block.
    first_alpha_change_rad_s2: Vector3<f64>,
}

/// Whether a column is the torque of electrodes, which follows the angles of a test mass.
pub(crate) fn is_torque_on_a_test_mass(column: &str) -> bool {
    column.starts_with("used.") && column.contains(".torque_orf_nm.")
}

impl OnDemand {
    pub(crate) fn new(needs: Needs, mission: &Mission, tm_accel_per_alpha: Vec<Matrix3<f64>>) -> Self {
        Self {
            needs,
            inertia_inverse: mission.spacecraft.inertia_inverse(),
            tm_accel_per_alpha,
            vectors: command_vectors(mission),
            test_masses: mission.test_mass.keys().map(|name| (name.clone(), mission.frame(name))).collect(),
            executed: Vec::new(),
            torque: Default::default(),
            delay: ResponseState::default(),
            first_alpha_change_rad_s2: Vector3::from_element(f64::NAN),
        }
    }

    pub(crate) fn needs(&self) -> Needs {
        self.needs
    }

    /// Name, unit and frame of the columns, in the order of [`crate::reconstruction::Row::on_demand`].
    pub(crate) fn columns(&self) -> Vec<(String, &'static str, String)> {
        let mut columns = Vec::new();
        if self.needs.commands {
            let sun = [("sun_srf".to_owned(), "1", "SRF".to_owned())];
            for (vector, unit, frame) in self.vectors.iter().chain(&sun) {
                columns.extend(AXES.map(|axis| (format!("used.{vector}.{axis}"), *unit, frame.clone())));
            }
        }
        if self.needs.torque_response {
            for about in AXES {
                let name = |axis| format!("response.alpha_srf_rad_s2.by_torque_gain.{about}.{axis}");
                columns.extend(AXES.map(|axis| (name(axis), "rad s-2", "SRF".to_owned())));
            }
            for about in AXES.iter().filter(|_| self.has_layout()) {
                for (tm, frame) in &self.test_masses {
                    let name = |axis| format!("response.u_orf_m_s2.by_torque_gain.{about}.{tm}.{axis}");
                    columns.extend(AXES.map(|axis| (name(axis), "m s-2", frame.clone())));
                }
            }
        }
        if self.needs.dws_delay_response {
            let name = |axis| format!("response.alpha_srf_rad_s2.by_dws_delay.{axis}");
            columns.extend(AXES.map(|axis| (name(axis), "rad s-3", "SRF".to_owned())));
        }
        columns
    }

    fn has_layout(&self) -> bool {
        self.tm_accel_per_alpha.iter().any(|matrix| *matrix != Matrix3::zeros())
    }

    /// Adds the newest interval. The electrodes' command of test mass `unknown` is missing.
    pub(crate) fn push(
        &mut self,
        command: Option<&CommandNumbers>,
        unknown: Option<usize>,
        sun_srf: Option<Vector3<f64>>,
    ) {
        let missing = f64::NAN;
        let numbers = 3 * self.vectors.len();
        let mut command = command.copied().unwrap_or_else(|| CommandNumbers::from_fn(numbers, |_| missing));
        if let Some(tm) = unknown {
            command[electrodes_of(tm)].fill(missing);
        }
        self.executed.push(Executed { command, sun_srf: sun_srf.unwrap_or(Vector3::from_element(missing)) });
    }

    /// Removes the oldest waiting epochs, one for each of `available`, and returns their values. `alpha_crf_rad_s2` is
    /// `α̂` relative to CRF of all waiting epochs, NaN where a command is missing; empty unless a delay is requested.
    pub(crate) fn emit(
        &mut self,
        smoother: &Smoother,
        available: &[Availability],
        alpha_crf_rad_s2: &[Vector3<f64>],
    ) -> Vec<Vec<f64>> {
        let mut out = vec![Vec::new(); available.len()];
        if self.needs.commands {
            for (out, executed) in out.iter_mut().zip(&self.executed) {
                out.extend_from_slice(&executed.command);
                out.extend_from_slice(executed.sun_srf.as_slice());
            }
        }
        if self.needs.torque_response {
            self.torque_columns(smoother, available, &mut out);
        }
        if self.needs.dws_delay_response {
            let responses = self.by_delay(smoother, available.len(), alpha_crf_rad_s2);
            for ((out, available), response) in out.iter_mut().zip(available).zip(responses) {
                push_if(available.alpha, &response.disturbance_rad_s2, out);
            }
        }
        self.executed.drain(..available.len());
        out
    }

    fn torque_columns(&mut self, smoother: &Smoother, available: &[Availability], out: &mut [Vec<f64>]) {
        let (executed, inverse) = (&self.executed, &self.inertia_inverse);
        let commanded_alpha = |about: usize, k: usize| inverse.column(about) * executed[k].command[3 + about];
        let responses = [0, 1, 2].map(|about| {
            if self.needs.prediction {
                return vec![Smoothed::default(); available.len()];
            }
            let perturb = |k| Perturbation { held_rad_s2: commanded_alpha(about, k), kick_rad_s: Vector3::zeros() };
            smoother.response(&mut self.torque[about], available.len(), perturb)
        });
        let has_layout = self.has_layout();
        for (k, (out, available)) in out.iter_mut().zip(available).enumerate() {
            for (about, response) in responses.iter().enumerate() {
                push_if(available.alpha, &(commanded_alpha(about, k) + response[k].disturbance_rad_s2), out);
            }
            for response in responses.iter().filter(|_| has_layout) {
                for (accel_per_alpha, available) in self.tm_accel_per_alpha.iter().zip(&available.u) {
                    push_if(*available, &(accel_per_alpha * response[k].noise_rad_s2), out);
                }
            }
        }
    }

    fn by_delay(&mut self, smoother: &Smoother, count: usize, alpha_crf_rad_s2: &[Vector3<f64>]) -> Vec<Smoothed> {
        if self.needs.prediction {
            return vec![Smoothed::default(); count];
        }
        let change = |k: usize| alpha_crf_rad_s2[k] - alpha_crf_rad_s2[k - 1];
        let first = self.first_alpha_change_rad_s2;
        let perturb = |k: usize| {
            let step = if k == 0 { first } else { change(k) };
            // The smoother resets the rate after an unknown command, so a rate step there has no effect.
            let known = step.iter().all(|x| x.is_finite());
            Perturbation { held_rad_s2: Vector3::zeros(), kick_rad_s: if known { step } else { Vector3::zeros() } }
        };
        let response = smoother.response(&mut self.delay, count, perturb);
        if (1..alpha_crf_rad_s2.len()).contains(&count) {
            self.first_alpha_change_rad_s2 = change(count);
        }
        response
    }

    /// Saves or restores the state for `waiting` epochs.
    pub(crate) fn visit(&mut self, waiting: usize, state: &mut State<'_>) -> Result<(), StateError> {
        state.f64s(self.first_alpha_change_rad_s2.iter_mut())?;
        for response in self.torque.iter_mut().chain([&mut self.delay]) {
            response.visit(state)?;
        }
        let numbers = 3 * self.vectors.len();
        state.list(&mut self.executed, |state, executed| {
            visit_command(state, numbers, &mut executed.command)?;
            state.f64s(executed.sun_srf.iter_mut())
        })?;
        if self.executed.len() == waiting { Ok(()) } else { Err(StateError::Content("a number of waiting commands")) }
    }
}

fn push_if(available: bool, value: &Vector3<f64>, out: &mut Vec<f64>) {
    out.extend(value.iter().map(|x| if available { *x } else { f64::NAN }));
}
