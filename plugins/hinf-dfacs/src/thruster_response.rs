//! What the thrusters make of a command: the delay and the lag that the mission file says they have.

use std::collections::VecDeque;

use dragfree_physics::lag::Lag;
use dragfree_physics::mission::Mission;
use dragfree_sdk::state::{State, StateError};

/// Force, N, and torque, N m, on the spacecraft, SRF.
pub(crate) type Wrench = [f64; 6];

/// Thrusters that act late. Their range and step are not modelled: a command within the range acts as it is, and
/// rounding it adds noise.
#[derive(Clone, Debug)]
pub(crate) struct ThrusterResponse {
    /// `None` where the thrusters act at once.
    lag: Option<Lag>,
    y: Wrench,
    /// The commands of the delay, oldest first; empty where the one before is unknown.
    waiting: VecDeque<Wrench>,
}

impl ThrusterResponse {
    pub(crate) fn new(mission: &Mission, dt_s: f64) -> Self {
        let late = mission.thrusters.as_ref().filter(|t| t.lag_s > 0.0 || t.delay_s > 0.0);
        Self { lag: late.map(|t| Lag::new(t.lag_s, t.delay_s, dt_s)), y: Wrench::default(), waiting: VecDeque::new() }
    }

    /// Mean of what acts over a sample in response to its command; `None` for an unknown one. What acted before the
    /// first one, or before the first after a gap, is taken to be the same: the smoother starts anew there.
    pub(crate) fn act(&mut self, commanded: Option<Wrench>) -> Option<Wrench> {
        let (Some(lag), Some(commanded)) = (&self.lag, commanded) else {
            self.waiting.clear();
            return commanded;
        };
        if self.waiting.is_empty() {
            self.y = commanded;
            self.waiting.extend(std::iter::repeat_n(commanded, lag.samples() + 1));
        }
        self.waiting.push_back(commanded);
        let (older, newer) = (&self.waiting[0], &self.waiting[1]);
        let acting = std::array::from_fn(|i| lag.step(&mut self.y[i], older[i], newer[i]));
        self.waiting.pop_front();
        Some(acting)
    }

    pub(crate) fn visit(&mut self, state: &mut State<'_>) -> Result<(), StateError> {
        state.f64s(&mut self.y)?;
        state.queue(&mut self.waiting, |state, commanded| state.f64s(commanded))?;
        let most = self.lag.as_ref().map_or(0, |lag| lag.samples() + 1);
        if self.waiting.len() > most { Err(StateError::Content("a number of commands")) } else { Ok(()) }
    }
}
