//! Response of the thrusters to a command.

use std::collections::VecDeque;

use dragfree_physics::lag::Lag;
use dragfree_physics::mission::Mission;
use dragfree_sdk::state::{State, StateError};

/// Force, N, and torque, N m, on the spacecraft, SRF.
pub(crate) type Wrench = [f64; 6];

/// Delay and lag of the thrusters by the mission file. Range and resolution are not modelled: commands within the range
/// are executed as they are, and rounding only adds noise.
#[derive(Clone, Debug)]
pub(crate) struct ThrusterResponse {
    /// `None` if the thrusters respond at once; `y` is its state.
    lag: Option<Lag>,
    y: Wrench,
    /// Commands within the delay, oldest first; empty if the previous one is unknown.
    waiting: VecDeque<Wrench>,
}

impl ThrusterResponse {
    pub(crate) fn new(mission: &Mission, dt_s: f64) -> Self {
        let slow = mission.thrusters.as_ref().filter(|t| t.lag_s > 0.0 || t.delay_s > 0.0);
        Self { lag: slow.map(|t| Lag::new(t.lag_s, t.delay_s, dt_s)), y: Wrench::default(), waiting: VecDeque::new() }
    }

    /// Mean wrench over a sample from its command; `None` if the command is unknown. The first command, or the first
    /// after a gap, is taken to have acted before as well, as the smoother restarts there.
    pub(crate) fn step(&mut self, commanded: Option<Wrench>) -> Option<Wrench> {
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
