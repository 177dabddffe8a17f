//! Columns written only on request of an effect: commands as executed, and derivatives of `α̂` with respect to a torque
//! gain and to a delay of the attitude readout. Derivations: Methods, "Derivatives of α̂".
//!
//! `α̂ = α_c + D[θ, α_c]` with the commanded `α_c` and the smoother `D`, which is linear in both arguments.
//! * Torque: `∂α̂/∂g_i = J⁻¹ e_i M_i + D[0, J⁻¹ e_i M_i]`.
//! * Delay: `∂α̂/∂τ = D[−ω, 0] = D[0, kicks Δα̂]`, for the channels of the test masses only. The attitude channels
//!   share the noise of `α̂` and use the command without the smoother.

use dragfree_physics::control::PerTestMass;
use dragfree_physics::mission::{AXES, Mission};
use dragfree_sdk::state::{State, StateError};
use nalgebra::{Matrix3, Vector3};

use crate::replay::{CommandNumbers, command_vectors, electrodes_of, visit_command};
use crate::smoother::{Perturbation, ResponseState, Smoothed, Smoother};

/// Whether a column on demand is made from commands, as all but two are: the Sun's direction, and the derivative by a
/// delay of the wavefront sensing, which is made of the smoothed attitude.
pub(crate) fn is_in_loop(column: &str) -> bool {
    !column.starts_with("used.sun_srf.") && !column.starts_with("response.alpha_srf_rad_s2.by_dws_delay.")
}

/// Columns on demand, each off by default.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Needs {
    /// `used.*`: commands and direction of the Sun as `û` has them, means over `[t_k, t_{k+1})`.
    pub commands: bool,
    /// `response.alpha_srf_rad_s2.by_torque_gain.I.J`, `∂α̂_J/∂g_I` for a torque about axis `I` of `(1 + g_I)` times
    /// the commanded one: `α̂` given `g` minus `α̂` without it. And `response.u_orf_m_s2.by_torque_gain.I.NAME.J`, the
    /// same of `û` of a test mass, where thrusters have a layout: noise of their torque then correlates with that of
    /// their force.
    pub torque_response: bool,
    /// `response.alpha_srf_rad_s2.by_dws_delay.J`, `∂α̂_J/∂τ` where long-arm sensing shows the attitude `τ` before:
    /// `α̂` late minus `α̂` on time. For the test masses' channels; see the module.
    pub dws_delay_response: bool,
}

impl Needs {
    /// Whether any column is a derivative of the smoothed `α̂`.
    pub fn responses(&self) -> bool {
        self.torque_response || self.dws_delay_response
    }

    /// For a sentence about a state that is of another model.
    pub(crate) fn describe(self) -> String {
        let all = [
            ("commands", self.commands),
            ("torque-response", self.torque_response),
            ("dws-delay-response", self.dws_delay_response),
        ];
        let names: Vec<&str> = all.iter().filter(|(_, needed)| *needed).map(|(name, _)| *name).collect();
        format!("one whose effects need [{}]", names.join(", "))
    }
}

/// What acted over one interval as commanded; NaN where unknown.
#[derive(Clone, Copy, Debug, Default)]
struct Used {
    command: CommandNumbers,
    sun_srf: Vector3<f64>,
}

/// What there is of an epoch that leaves: without a series there is no derivative of it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Availability {
    pub(crate) alpha: bool,
    pub(crate) u: PerTestMass<bool>,
}

/// The running columns.
#[derive(Clone, Debug)]
pub(crate) struct OnDemand {
    needs: Needs,
    inertia_inverse: Matrix3<f64>,
    /// `−T_S^{O_i} C J/m_S`, m s⁻² per rad s⁻²; zero unless thrusters have a layout.
    push_per_turn: Vec<Matrix3<f64>>,
    /// Names, units and frames of the vectors of a command, and names and frames of the test masses.
    vectors: Vec<(String, &'static str, String)>,
    test_masses: Vec<(String, String)>,
    /// One for each epoch that waits for the smoother.
    used: Vec<Used>,
    torque: [ResponseState; 3],
    delay: ResponseState,
    /// By how much `α̂` changes where the oldest waiting epoch begins, of one estimate of both sides: from one block to
    /// the next the estimate of the slow torque changes too.
    kick_rad_s2: Vector3<f64>,
}

impl OnDemand {
    pub(crate) fn new(needs: Needs, mission: &Mission, push_per_turn: Vec<Matrix3<f64>>) -> Self {
        Self {
            needs,
            inertia_inverse: mission.spacecraft.inertia_inverse(),
            push_per_turn,
            vectors: command_vectors(mission),
            test_masses: mission.test_mass.keys().map(|name| (name.clone(), mission.frame(name))).collect(),
            used: Vec::new(),
            torque: Default::default(),
            delay: ResponseState::default(),
            kick_rad_s2: Vector3::from_element(f64::NAN),
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
            for about in AXES.iter().filter(|_| self.layout()) {
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

    fn layout(&self) -> bool {
        self.push_per_turn.iter().any(|push| *push != Matrix3::zeros())
    }

    /// Takes what acts over the newest interval. The command of the test mass `unknown` is missing.
    pub(crate) fn take(
        &mut self,
        acting: Option<&CommandNumbers>,
        unknown: Option<usize>,
        sun_srf: Option<Vector3<f64>>,
    ) {
        let missing = f64::NAN;
        let numbers = 3 * self.vectors.len();
        let mut command = acting.copied().unwrap_or_else(|| CommandNumbers::from_fn(numbers, |_| missing));
        if let Some(tm) = unknown {
            command[electrodes_of(tm)].fill(missing);
        }
        self.used.push(Used { command, sun_srf: sun_srf.unwrap_or(Vector3::from_element(missing)) });
    }

    /// Values for the oldest waiting epochs, which leave. `alpha_crf_rad_s2` is the smoothed `α̂` relative to CRF of
    /// all that wait, NaN where a command is missing; nothing unless a delay is asked for.
    pub(crate) fn give(
        &mut self,
        smoother: &Smoother,
        leaving: &[Availability],
        alpha_crf_rad_s2: &[Vector3<f64>],
    ) -> Vec<Vec<f64>> {
        let mut out = vec![Vec::new(); leaving.len()];
        if self.needs.commands {
            for (out, used) in out.iter_mut().zip(&self.used) {
                out.extend_from_slice(&used.command);
                out.extend_from_slice(used.sun_srf.as_slice());
            }
        }
        if self.needs.torque_response {
            self.torque_columns(smoother, leaving, &mut out);
        }
        if self.needs.dws_delay_response {
            let responses = self.delay_columns(smoother, leaving.len(), alpha_crf_rad_s2);
            for ((out, available), response) in out.iter_mut().zip(leaving).zip(responses) {
                put(out, &response.disturbance_rad_s2, available.alpha);
            }
        }
        self.used.drain(..leaving.len());
        out
    }

    fn torque_columns(&mut self, smoother: &Smoother, leaving: &[Availability], out: &mut [Vec<f64>]) {
        let (used, inverse) = (&self.used, &self.inertia_inverse);
        let turn = |about: usize, k: usize| inverse.column(about) * used[k].command[3 + about];
        let responses = [0, 1, 2].map(|about| {
            let more = |k| Perturbation { held_rad_s2: turn(about, k), kick_rad_s: Vector3::zeros() };
            smoother.response(&mut self.torque[about], leaving.len(), more)
        });
        let layout = self.layout();
        for (k, (out, available)) in out.iter_mut().zip(leaving).enumerate() {
            for (about, response) in responses.iter().enumerate() {
                put(out, &(turn(about, k) + response[k].disturbance_rad_s2), available.alpha);
            }
            for response in responses.iter().filter(|_| layout) {
                for (push, available) in self.push_per_turn.iter().zip(&available.u) {
                    put(out, &(push * response[k].noise_rad_s2), *available);
                }
            }
        }
    }

    fn delay_columns(&mut self, smoother: &Smoother, count: usize, alpha_crf_rad_s2: &[Vector3<f64>]) -> Vec<Smoothed> {
        let change = |k: usize| alpha_crf_rad_s2[k] - alpha_crf_rad_s2[k - 1];
        let first = self.kick_rad_s2;
        let more = |k: usize| {
            let kick = if k == 0 { first } else { change(k) };
            // The attitude starts anew after an unknown command, so that its change there carries no information.
            let known = kick.iter().all(|x| x.is_finite());
            Perturbation { held_rad_s2: Vector3::zeros(), kick_rad_s: if known { kick } else { Vector3::zeros() } }
        };
        let response = smoother.response(&mut self.delay, count, more);
        if (1..alpha_crf_rad_s2.len()).contains(&count) {
            self.kick_rad_s2 = change(count);
        }
        response
    }

    /// The state with `waiting` epochs.
    pub(crate) fn visit(&mut self, waiting: usize, state: &mut State<'_>) -> Result<(), StateError> {
        state.f64s(self.kick_rad_s2.iter_mut())?;
        for response in self.torque.iter_mut().chain([&mut self.delay]) {
            response.visit(state)?;
        }
        let numbers = 3 * self.vectors.len();
        state.list(&mut self.used, |state, used| {
            visit_command(state, numbers, &mut used.command)?;
            state.f64s(used.sun_srf.iter_mut())
        })?;
        if self.used.len() == waiting { Ok(()) } else { Err(StateError::Content("a number of waiting commands")) }
    }
}

fn put(out: &mut Vec<f64>, value: &Vector3<f64>, available: bool) {
    out.extend(value.iter().map(|x| if available { *x } else { f64::NAN }));
}
