//! Readouts of one epoch, and every random process of the loop.

use dragfree_physics::attitude::rotation_vector;
use dragfree_physics::control::{Readout, TestMassReadout};
use dragfree_physics::mission::{Limits, Mission, MissionError};
use dragfree_physics::noise::NoiseShape;
use dragfree_physics::process::{NoiseBank, NoiseProcess};
use nalgebra::Vector3;
use rand_xoshiro::Xoshiro256PlusPlus;

use crate::plant::{Loads, State};

const NEEDED_BY: &str = "the simulator";

/// Everything that the instruments say at `t_k`.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Measured {
    /// Capacitive displacement of both test masses, ORF, m.
    pub is_r_orf_m: [Vector3<f64>; 2],
    /// Capacitive attitude `φ, θ, ψ`, ORF, rad.
    pub is_att_orf_rad: [Vector3<f64>; 2],
    /// Whether a capacitive readout is at the end of its range.
    pub is_saturated: [bool; 2],
    /// Interferometers, ORF x, m.
    pub ifo_x_orf_m: [f64; 2],
    /// Local wavefront sensing `θ, ψ`, ORF, rad.
    pub dws_orf_rad: [[f64; 2]; 2],
    /// Long-arm wavefront sensing of the spacecraft, CRF, rad.
    pub dws_sc_crf_rad: Vector3<f64>,
}

impl Measured {
    /// Holds the capacitive readouts within their range.
    pub fn saturate(&mut self, limits: &Limits) {
        let hold = |v: &mut Vector3<f64>, limit: f64| {
            let beyond = v.iter().fold(false, |any, x| any | (x.abs() > limit));
            v.apply(|x| *x = x.clamp(-limit, limit));
            beyond
        };
        for i in 0..2 {
            let r = hold(&mut self.is_r_orf_m[i], limits.displacement_m);
            let att = hold(&mut self.is_att_orf_rad[i], limits.angle_rad);
            self.is_saturated[i] = r | att;
        }
    }

    /// What the controller uses of it.
    #[must_use]
    pub fn readout(&self, sun_srf: Option<Vector3<f64>>) -> Readout {
        let tm = std::array::from_fn(|i| TestMassReadout {
            r_orf_m: Vector3::new(self.ifo_x_orf_m[i], self.is_r_orf_m[i].y, self.is_r_orf_m[i].z),
            att_orf_rad: Vector3::new(self.is_att_orf_rad[i].x, self.dws_orf_rad[i][0], self.dws_orf_rad[i][1]),
        });
        Readout { sc_crf_rad: self.dws_sc_crf_rad, tm, sun_srf }
    }
}

/// Random processes of the loop.
const PROCESSES: usize = 44;

/// The random processes, each independent of the others.
#[derive(Clone, Debug)]
pub struct Noises {
    bank: NoiseBank<PROCESSES>,
    /// Of the epoch that was measured last.
    samples: [f64; PROCESSES],
    places: Places,
}

/// Where the processes stand in the bank; the further axes follow the first.
#[derive(Clone, Debug)]
struct Places {
    tm: [TestMassPlaces; 2],
    dws_sc: usize,
    mps_force: usize,
    mps_torque: usize,
    sunlight: usize,
}

#[derive(Clone, Debug)]
struct TestMassPlaces {
    is_r: usize,
    is_att: usize,
    ifo_x: usize,
    /// θ and ψ.
    dws: usize,
    /// y and z: nothing drives the electrodes along the sensitive axis.
    es_force: usize,
    es_torque: usize,
    acceleration: usize,
}

impl Noises {
    /// The processes of a mission, sampled at its rate.
    ///
    /// # Errors
    /// [`MissionError::Missing`] names the table that is not there.
    pub fn new(mission: &Mission) -> Result<Self, MissionError> {
        let (n, dt_s) = (&mission.noise, mission.dt_s());
        macro_rules! process {
            ($name:ident) => {{
                let table = Mission::need(&n.$name, concat!("noise.", stringify!($name)), NEEDED_BY)?;
                NoiseProcess::with_lines(&table.shape(), &table.lines(), dt_s)
            }};
        }
        let (is_x, is_y, is_z, is_angle) = (process!(is_x), process!(is_y), process!(is_z), process!(is_angle));
        let (ifo_x, dws_tm, dws_sc) = (process!(ifo_x), process!(dws_local), process!(dws_long_arm));
        let (es_force, es_torque) = (process!(electrostatic_force), process!(electrostatic_torque));
        let acceleration = process!(test_mass_acceleration);
        let (mut mps_force, mut mps_torque) = (process!(thruster_force), process!(thruster_torque));
        if mission.thrusters.as_ref().is_some_and(|t| !t.unit.is_empty()) {
            // The units have noise of their own.
            let silence = NoiseProcess::new(&NoiseShape::default(), dt_s);
            (mps_force, mps_torque) = (silence.clone(), silence);
        }
        let sunlight = n.solar_pressure.as_ref().map_or_else(
            || NoiseProcess::new(&NoiseShape::default(), dt_s),
            |table| NoiseProcess::with_lines(&table.shape(), &table.lines(), dt_s),
        );

        let mut processes: Vec<NoiseProcess> = Vec::with_capacity(PROCESSES);
        let mut add = |axes: &[&NoiseProcess]| {
            let place = processes.len();
            processes.extend(axes.iter().map(|p| (*p).clone()));
            place
        };
        let places = Places {
            tm: std::array::from_fn(|_| TestMassPlaces {
                is_r: add(&[&is_x, &is_y, &is_z]),
                is_att: add(&[&is_angle; 3]),
                ifo_x: add(&[&ifo_x]),
                dws: add(&[&dws_tm; 2]),
                es_force: add(&[&es_force; 2]),
                es_torque: add(&[&es_torque; 3]),
                acceleration: add(&[&acceleration; 3]),
            }),
            dws_sc: add(&[&dws_sc; 3]),
            mps_force: add(&[&mps_force; 3]),
            mps_torque: add(&[&mps_torque; 3]),
            sunlight: add(&[&sunlight]),
        };
        let processes: [NoiseProcess; PROCESSES] =
            processes.try_into().unwrap_or_else(|p: Vec<_>| unreachable!("{} processes", p.len()));
        Ok(Self { bank: NoiseBank::new(processes), samples: [0.0; PROCESSES], places })
    }

    /// Takes the thrusters' noise along the axes away, for one that comes from a layout.
    pub fn silence_thrusters(&mut self) {
        for process in self.places.mps_force..self.places.mps_torque + 3 {
            self.bank.silence(process);
        }
    }

    /// Draws every slow part from its stationary distribution.
    pub fn start(&mut self, rng: &mut Xoshiro256PlusPlus) {
        self.bank.start(rng);
    }

    /// What the drifts alone make the instruments show: acquisition brought these readouts to zero, not the masses.
    #[must_use]
    pub fn slow_readout(&self) -> Readout {
        let slow = |place: usize| self.bank.slow(place);
        let tm = self.places.tm.each_ref().map(|at| TestMassReadout {
            r_orf_m: Vector3::new(slow(at.ifo_x), slow(at.is_r + 1), slow(at.is_r + 2)),
            att_orf_rad: Vector3::new(slow(at.is_att), slow(at.dws), slow(at.dws + 1)),
        });
        Readout { sc_crf_rad: Vector3::from_fn(|i, _| slow(self.places.dws_sc + i)), tm, sun_srf: None }
    }

    /// Goes on to the next epoch and samples every instrument.
    pub fn measure(&mut self, y: &State, rng: &mut Xoshiro256PlusPlus) -> Measured {
        self.samples = self.bank.next(rng);
        let mut out = Measured::default();
        for (i, (tm, at)) in y.tm.iter().zip(&self.places.tm).enumerate() {
            let angle = rotation_vector(&tm.q_mrf_from_orf);
            out.is_r_orf_m[i] = tm.r_orf_m + self.three(at.is_r);
            out.is_att_orf_rad[i] = angle + self.three(at.is_att);
            out.ifo_x_orf_m[i] = tm.r_orf_m.x + self.samples[at.ifo_x];
            out.dws_orf_rad[i] = std::array::from_fn(|j| angle[j + 1] + self.samples[at.dws + j]);
        }
        out.dws_sc_crf_rad = y.sc_crf_rad() + self.three(self.places.dws_sc);
        out
    }

    /// Adds the epoch's sample of every force noise to the loads; gives the fluctuation of the sunlight, N.
    #[must_use]
    pub fn disturb(&self, loads: &mut Loads) -> f64 {
        loads.force_srf_n += self.three(self.places.mps_force);
        loads.torque_srf_nm += self.three(self.places.mps_torque);
        for (tm, at) in loads.tm.iter_mut().zip(&self.places.tm) {
            tm.force_orf_n += Vector3::new(0.0, self.samples[at.es_force], self.samples[at.es_force + 1]);
            tm.torque_orf_nm += self.three(at.es_torque);
            tm.acceleration_orf_m_s2 += self.three(at.acceleration);
        }
        self.samples[self.places.sunlight]
    }

    fn three(&self, place: usize) -> Vector3<f64> {
        Vector3::from_fn(|i, _| self.samples[place + i])
    }

    /// The states of all processes, for a checkpoint between epochs.
    #[must_use]
    pub fn states(&self) -> Vec<f64> {
        self.bank.states()
    }

    /// Takes back what [`Self::states`] gave; false when the length is another mission's.
    #[must_use]
    pub fn set_states(&mut self, states: &[f64]) -> bool {
        self.bank.set_states(states)
    }
}
