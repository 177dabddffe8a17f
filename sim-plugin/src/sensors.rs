//! Readouts of one epoch, and every random process of the loop.

use dragfree_physics::attitude::rotation_vector;
use dragfree_physics::control::{Readout, TestMassReadout};
use dragfree_physics::mission::{Mission, MissionError};
use dragfree_physics::noise::NoiseShape;
use dragfree_physics::process::NoiseProcess;
use nalgebra::Vector3;
use rand_xoshiro::Xoshiro256PlusPlus;

use crate::plant::{Loads, State, TestMassLoads};

const NEEDED_BY: &str = "the simulator";

/// Everything that the instruments say at `t_k`.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Measured {
    /// Capacitive displacement of both test masses, ORF, m.
    pub is_r_orf_m: [Vector3<f64>; 2],
    /// Capacitive attitude `φ, θ, ψ`, ORF, rad.
    pub is_att_orf_rad: [Vector3<f64>; 2],
    /// Interferometers, ORF x, m.
    pub ifo_x_orf_m: [f64; 2],
    /// Local wavefront sensing `θ, ψ`, ORF, rad.
    pub dws_orf_rad: [[f64; 2]; 2],
    /// Long-arm wavefront sensing of the spacecraft, CRF, rad.
    pub dws_sc_crf_rad: Vector3<f64>,
}

impl Measured {
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

type Axes = [NoiseProcess; 3];

/// The random processes, each independent of the others.
#[derive(Clone, Debug)]
pub struct Noises {
    is_r: [Axes; 2],
    is_att: [Axes; 2],
    ifo_x: [NoiseProcess; 2],
    dws_tm: [[NoiseProcess; 2]; 2],
    dws_sc: Axes,
    mps_force: Axes,
    mps_torque: Axes,
    sunlight: NoiseProcess,
    /// y and z: nothing drives the electrodes along the sensitive axis.
    es_force: [[NoiseProcess; 2]; 2],
    es_torque: [Axes; 2],
    acceleration: [Axes; 2],
}

impl Noises {
    /// The processes of a mission, sampled at its rate.
    ///
    /// # Errors
    /// [`MissionError::Missing`] names the table that is not there.
    pub fn new(mission: &Mission) -> Result<Self, MissionError> {
        let n = &mission.noise;
        macro_rules! process {
            ($name:ident) => {{
                let table = Mission::need(&n.$name, concat!("noise.", stringify!($name)), NEEDED_BY)?;
                NoiseProcess::new(&table.shape(), mission.dt_s())
            }};
        }
        let is_r = [process!(is_x), process!(is_y), process!(is_z)];
        let (is_angle, ifo_x, dws) = (process!(is_angle), process!(ifo_x), process!(dws_local));
        let (force, torque) = (process!(electrostatic_force), process!(electrostatic_torque));
        let sunlight = n.solar_pressure.as_ref().map_or_else(NoiseShape::default, |t| t.shape());
        let axes = |p: &NoiseProcess| [p.clone(), p.clone(), p.clone()];
        let pair = |p: &NoiseProcess| [p.clone(), p.clone()];
        let both = |p: &NoiseProcess| [axes(p), axes(p)];
        Ok(Self {
            is_r: [is_r.clone(), is_r],
            is_att: both(&is_angle),
            ifo_x: pair(&ifo_x),
            dws_tm: [pair(&dws), pair(&dws)],
            dws_sc: axes(&process!(dws_long_arm)),
            mps_force: axes(&process!(thruster_force)),
            mps_torque: axes(&process!(thruster_torque)),
            sunlight: NoiseProcess::new(&sunlight, mission.dt_s()),
            es_force: [pair(&force), pair(&force)],
            es_torque: both(&torque),
            acceleration: both(&process!(test_mass_acceleration)),
        })
    }

    fn all(&self) -> impl Iterator<Item = &NoiseProcess> {
        let tm = (0..2).flat_map(|i| {
            self.is_r[i]
                .iter()
                .chain(&self.is_att[i])
                .chain(std::iter::once(&self.ifo_x[i]))
                .chain(&self.dws_tm[i])
                .chain(&self.es_force[i])
                .chain(&self.es_torque[i])
                .chain(&self.acceleration[i])
        });
        tm.chain(&self.dws_sc).chain(&self.mps_force).chain(&self.mps_torque).chain(std::iter::once(&self.sunlight))
    }

    /// In the order of [`Self::all`].
    fn all_mut(&mut self) -> Vec<&mut NoiseProcess> {
        let mut out: Vec<&mut NoiseProcess> = Vec::new();
        let tm = self
            .is_r
            .iter_mut()
            .zip(&mut self.is_att)
            .zip(&mut self.ifo_x)
            .zip(&mut self.dws_tm)
            .zip(&mut self.es_force)
            .zip(&mut self.es_torque)
            .zip(&mut self.acceleration);
        for ((((((is_r, is_att), ifo_x), dws), force), torque), acceleration) in tm {
            out.extend(
                is_r.iter_mut()
                    .chain(is_att)
                    .chain(std::iter::once(ifo_x))
                    .chain(dws)
                    .chain(force)
                    .chain(torque)
                    .chain(acceleration),
            );
        }
        out.extend(self.dws_sc.iter_mut().chain(&mut self.mps_force).chain(&mut self.mps_torque));
        out.push(&mut self.sunlight);
        out
    }

    /// Draws every slow part from its stationary distribution.
    pub fn start(&mut self, rng: &mut Xoshiro256PlusPlus) {
        for process in self.all_mut() {
            process.start(rng);
        }
    }

    /// What the drifts alone make the instruments show: acquisition brought these readouts to zero, not the masses.
    #[must_use]
    pub fn slow_readout(&self) -> Readout {
        let slow3 = |a: &Axes| Vector3::from_fn(|i, _| a[i].slow());
        let tm = std::array::from_fn(|i| TestMassReadout {
            r_orf_m: Vector3::new(self.ifo_x[i].slow(), self.is_r[i][1].slow(), self.is_r[i][2].slow()),
            att_orf_rad: Vector3::new(self.is_att[i][0].slow(), self.dws_tm[i][0].slow(), self.dws_tm[i][1].slow()),
        });
        Readout { sc_crf_rad: slow3(&self.dws_sc), tm, sun_srf: None }
    }

    /// Samples every instrument.
    pub fn measure(&mut self, y: &State, rng: &mut Xoshiro256PlusPlus) -> Measured {
        let mut out = Measured::default();
        for (i, tm) in y.tm.iter().enumerate() {
            let angle = rotation_vector(&tm.q_mrf_from_orf);
            out.is_r_orf_m[i] = tm.r_orf_m + draw(&mut self.is_r[i], rng);
            out.is_att_orf_rad[i] = angle + draw(&mut self.is_att[i], rng);
            out.ifo_x_orf_m[i] = tm.r_orf_m.x + self.ifo_x[i].next(rng);
            for (j, process) in self.dws_tm[i].iter_mut().enumerate() {
                out.dws_orf_rad[i][j] = angle[j + 1] + process.next(rng);
            }
        }
        out.dws_sc_crf_rad = y.sc_crf_rad() + draw(&mut self.dws_sc, rng);
        out
    }

    /// Adds a sample of every force noise to the loads; gives the fluctuation of the sunlight, N.
    pub fn disturb(&mut self, loads: &mut Loads, rng: &mut Xoshiro256PlusPlus) -> f64 {
        loads.force_srf_n += draw(&mut self.mps_force, rng);
        loads.torque_srf_nm += draw(&mut self.mps_torque, rng);
        for (i, tm) in loads.tm.iter_mut().enumerate() {
            let TestMassLoads { force_orf_n, torque_orf_nm, acceleration_orf_m_s2, .. } = tm;
            let [y, z] = &mut self.es_force[i];
            *force_orf_n += Vector3::new(0.0, y.next(rng), z.next(rng));
            *torque_orf_nm += draw(&mut self.es_torque[i], rng);
            *acceleration_orf_m_s2 += draw(&mut self.acceleration[i], rng);
        }
        self.sunlight.next(rng)
    }

    /// The states of all processes, for a checkpoint.
    #[must_use]
    pub fn states(&self) -> Vec<f64> {
        self.all().flat_map(NoiseProcess::states).collect()
    }

    /// Takes back what [`Self::states`] gave; false when the length is another mission's.
    #[must_use]
    pub fn set_states(&mut self, states: &[f64]) -> bool {
        if states.len() != self.all().map(|p| p.states().count()).sum::<usize>() {
            return false;
        }
        let slots = self.all_mut().into_iter().flat_map(|p| p.states_mut());
        for (slot, value) in slots.zip(states) {
            *slot = *value;
        }
        true
    }
}

fn draw(axes: &mut Axes, rng: &mut Xoshiro256PlusPlus) -> Vector3<f64> {
    let [x, y, z] = axes;
    Vector3::new(x.next(rng), y.next(rng), z.next(rng))
}
