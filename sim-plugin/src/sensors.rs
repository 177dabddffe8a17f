//! Readouts of one epoch, and the random processes of the loop.

use dragfree_physics::attitude::rotation_vector;
use dragfree_physics::control::{PerTestMass, Readout, TestMassReadout};
use dragfree_physics::mission::{Limits, Mission, MissionError};
use dragfree_physics::noise::NoiseShape;
use dragfree_physics::process::{NoiseBank, NoiseProcess};
use nalgebra::Vector3;
use rand_xoshiro::Xoshiro256PlusPlus;

use crate::plant::{Loads, State};

const NEEDED_BY: &str = "the simulator";

/// Readouts of one test mass at `t_k`.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct MeasuredTestMass {
    /// Capacitive displacement, ORF, m.
    pub is_r_orf_m: Vector3<f64>,
    /// Capacitive attitude `φ, θ, ψ`, ORF, rad.
    pub is_att_orf_rad: Vector3<f64>,
    /// Whether the capacitive readout is at the end of its range.
    pub is_saturated: bool,
    /// Interferometers along the axes of ORF, m; NaN along an axis without one.
    pub ifo_orf_m: Vector3<f64>,
    /// Local wavefront sensing `θ, ψ`, ORF, rad; NaN without an interferometer along x.
    pub dws_orf_rad: [f64; 2],
}

/// All readouts at `t_k`.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Measured {
    /// The test masses.
    pub tm: PerTestMass<MeasuredTestMass>,
    /// Long-arm wavefront sensing of the spacecraft, CRF, rad.
    pub dws_sc_crf_rad: Vector3<f64>,
}

impl MeasuredTestMass {
    /// The best readout of each degree of freedom.
    pub fn best(&self) -> TestMassReadout {
        let [theta, psi] = self.dws_orf_rad;
        let (optical, capacitive) = (Vector3::new(f64::NAN, theta, psi), &self.is_att_orf_rad);
        let best = |optical: &Vector3<f64>, capacitive: &Vector3<f64>| {
            optical.zip_map(capacitive, |optical, capacitive| if optical.is_nan() { capacitive } else { optical })
        };
        TestMassReadout { r_orf_m: best(&self.ifo_orf_m, &self.is_r_orf_m), att_orf_rad: best(&optical, capacitive) }
    }
}

impl Measured {
    /// Limits the capacitive readouts to their range.
    pub fn saturate(&mut self, limits: &Limits) {
        let hold = |v: &mut Vector3<f64>, limit: f64| {
            let beyond = v.iter().fold(false, |any, x| any | (x.abs() > limit));
            v.apply(|x| *x = x.clamp(-limit, limit));
            beyond
        };
        for tm in &mut self.tm {
            let r = hold(&mut tm.is_r_orf_m, limits.displacement_m);
            let att = hold(&mut tm.is_att_orf_rad, limits.angle_rad);
            tm.is_saturated = r | att;
        }
    }

    /// Inputs of the controller.
    pub fn readout(&self, sun_srf: Option<Vector3<f64>>) -> Readout {
        Readout { sc_crf_rad: self.dws_sc_crf_rad, tm: self.tm.map(MeasuredTestMass::best), sun_srf }
    }
}

/// The random processes, each independent of the others.
#[derive(Clone, Debug)]
pub struct Noises {
    bank: NoiseBank,
    places: Places,
}

/// Index of the first axis of each process in the bank; the other axes follow.
#[derive(Clone, Debug)]
struct Places {
    tm: Vec<TestMassPlaces>,
    dws_sc: usize,
    mps_force: usize,
    mps_torque: usize,
    sunlight: usize,
}

#[derive(Clone, Debug)]
struct TestMassPlaces {
    is_r: usize,
    is_att: usize,
    /// Along each axis with an interferometer.
    ifo: [Option<usize>; 3],
    /// θ and ψ, where x has an interferometer.
    dws: Option<usize>,
    /// Along each axis on which electrodes push.
    es_force: [Option<usize>; 3],
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
        let dws_sc = process!(dws_long_arm);
        let (es_torque, acceleration) = (process!(electrostatic_torque), process!(test_mass_acceleration));
        let (mut mps_force, mut mps_torque) = (process!(thruster_force), process!(thruster_torque));
        if mission.thrusters.as_ref().is_some_and(|t| !t.unit.is_empty()) {
            // The units have their own noise.
            let silence = NoiseProcess::new(&NoiseShape::default(), dt_s);
            (mps_force, mps_torque) = (silence.clone(), silence);
        }
        let sunlight = n.solar_pressure.as_ref().map_or_else(
            || NoiseProcess::new(&NoiseShape::default(), dt_s),
            |table| NoiseProcess::with_lines(&table.shape(), &table.lines(), dt_s),
        );

        let mut processes: Vec<NoiseProcess> = Vec::new();
        let mut add = |axes: &[&NoiseProcess]| {
            let place = processes.len();
            processes.extend(axes.iter().map(|p| (*p).clone()));
            place
        };
        let mut tm = Vec::with_capacity(mission.test_mass.len());
        for section in mission.test_mass.values() {
            let (is_r, is_att) = (add(&[&is_x, &is_y, &is_z]), add(&[&is_angle; 3]));
            let mut ifo = [None; 3];
            for axis in (0..3).filter(|axis| section.has_interferometer(*axis)) {
                let (key, noise) = mission.displacement_noise(section, axis);
                let table = Mission::need(&noise, &format!("noise.{key}"), NEEDED_BY)?;
                ifo[axis] = Some(add(&[&NoiseProcess::with_lines(&table.shape(), &table.lines(), dt_s)]));
            }
            let dws = if section.has_interferometer(0) { Some(add(&[&process!(dws_local); 2])) } else { None };
            let mut es_force = [None; 3];
            for axis in (0..3).filter(|axis| !section.is_drag_free(*axis)) {
                es_force[axis] = Some(add(&[&process!(electrostatic_force)]));
            }
            let (es_torque, acceleration) = (add(&[&es_torque; 3]), add(&[&acceleration; 3]));
            tm.push(TestMassPlaces { is_r, is_att, ifo, dws, es_force, es_torque, acceleration });
        }
        let places = Places {
            tm,
            dws_sc: add(&[&dws_sc; 3]),
            mps_force: add(&[&mps_force; 3]),
            mps_torque: add(&[&mps_torque; 3]),
            sunlight: add(&[&sunlight]),
        };
        Ok(Self { bank: NoiseBank::new(processes), places })
    }

    /// Removes the thrusters' noise along the axes, which that of a layout replaces.
    pub fn silence_thrusters(&mut self) {
        for process in self.places.mps_force..self.places.mps_torque + 3 {
            self.bank.silence(process);
        }
    }

    /// Draws all states from their stationary distribution.
    pub fn start(&mut self, rng: &mut Xoshiro256PlusPlus) {
        self.bank.start(rng);
    }

    /// Readouts by the initial drifts alone. Acquisition nulls the readouts rather than the displacements.
    pub fn slow_readout(&self) -> Readout {
        let slow = |place: usize| self.bank.slow(place);
        let three = |place: usize| Vector3::from_fn(|i, _| slow(place + i));
        let tm = self.places.tm.iter().map(|at| {
            let measured = MeasuredTestMass {
                is_r_orf_m: three(at.is_r),
                is_att_orf_rad: three(at.is_att),
                ifo_orf_m: Vector3::from(at.ifo.map(|place| place.map_or(f64::NAN, slow))),
                dws_orf_rad: at.dws.map_or([f64::NAN; 2], |place| [slow(place), slow(place + 1)]),
                ..MeasuredTestMass::default()
            };
            measured.best()
        });
        Readout { sc_crf_rad: three(self.places.dws_sc), tm: tm.collect(), sun_srf: None }
    }

    /// Advances to the next epoch and samples every instrument.
    pub fn measure(&mut self, y: &State, rng: &mut Xoshiro256PlusPlus) -> Measured {
        let samples = self.bank.next(rng);
        let three = |place: usize| Vector3::new(samples[place], samples[place + 1], samples[place + 2]);
        let tm = y.tm.iter().zip(&self.places.tm).map(|(tm, at)| {
            let angle = rotation_vector(&tm.q_mrf_from_orf);
            let ifo = |axis: usize| at.ifo[axis].map_or(f64::NAN, |place| tm.r_orf_m[axis] + samples[place]);
            MeasuredTestMass {
                is_r_orf_m: tm.r_orf_m + three(at.is_r),
                is_att_orf_rad: angle + three(at.is_att),
                is_saturated: false,
                ifo_orf_m: Vector3::new(ifo(0), ifo(1), ifo(2)),
                dws_orf_rad: at.dws.map_or([f64::NAN; 2], |place| [0, 1].map(|j| angle[j + 1] + samples[place + j])),
            }
        });
        Measured { tm: tm.collect(), dws_sc_crf_rad: y.sc_crf_rad() + three(self.places.dws_sc) }
    }

    /// Adds the epoch's sample of every force noise to the loads; returns the fluctuation of the sunlight, N.
    pub fn disturb(&self, loads: &mut Loads) -> f64 {
        let samples = self.bank.samples();
        let three = |place: usize| Vector3::new(samples[place], samples[place + 1], samples[place + 2]);
        loads.force_srf_n += three(self.places.mps_force);
        loads.torque_srf_nm += three(self.places.mps_torque);
        for (tm, at) in loads.tm.iter_mut().zip(&self.places.tm) {
            tm.force_orf_n += Vector3::from(at.es_force.map(|place| place.map_or(0.0, |place| samples[place])));
            tm.torque_orf_nm += three(at.es_torque);
            tm.acceleration_orf_m_s2 += three(at.acceleration);
        }
        samples[self.places.sunlight]
    }

    /// The states of all processes, for a checkpoint between epochs.
    pub fn states(&self) -> Vec<f64> {
        self.bank.states()
    }

    /// Restores [`Self::states`]; false if the length differs.
    pub fn set_states(&mut self, states: &[f64]) -> bool {
        self.bank.set_states(states)
    }
}
