//! Instruments that show something else than what is.

use dragfree_physics::attitude::{rotation_vector, turn};
use nalgebra::Vector3;
use rand_xoshiro::Xoshiro256PlusPlus;
use std::collections::VecDeque;

use super::asked::{Asked, Built, Instrument, Kind, Number, Place, Shape, test_masses, tm_axes, tm_pairs};
use super::{Basis, Cause, Moment};
use crate::sensors::Measured;

const RATIO: Number = Number::new("1", -1.0, 1.0);
const LEVER: Number = Number::new("m rad-1", -1.0, 1.0);

pub(super) const KINDS: &[Kind] = &[
    Kind {
        id: "is-scale",
        places: tm_axes,
        size: RATIO,
        help: "capacitive readout: a displacement r shows as (1 + SIZE) r",
        shape: &[],
        build: |asked, _| {
            let Place::TmAxis(tm, axis) = asked.place else { unreachable!("instances are axes of a test mass") };
            Ok(Box::new(Capacitive { tm, from: axis, to: axis, size: asked.size }))
        },
    },
    Kind {
        id: "is-crosstalk",
        places: || tm_pairs(&[0, 1, 2]),
        size: RATIO,
        help: "capacitive readout: tm1.y-x shows SIZE times the displacement along y in x too",
        shape: &[],
        build: |asked, _| {
            let Place::TmPair { tm, from, to } = asked.place else { unreachable!("instances are pairs of axes") };
            Ok(Box::new(Capacitive { tm, from, to, size: asked.size }))
        },
    },
    Kind {
        id: "tilt-to-length",
        places: test_masses,
        size: LEVER,
        help: "interferometer: x shows SIZE times the test mass's angle θ too",
        shape: &[Shape { name: "psi_m_rad", number: LEVER, default: 0.0, help: "and this times its ψ, m/rad" }],
        build: |asked, _| {
            let Place::Tm(tm) = asked.place else { unreachable!("instances are test masses") };
            Ok(Box::new(TiltToLength { tm, theta_m_rad: asked.size, psi_m_rad: asked.shape("psi_m_rad") }))
        },
    },
    Kind {
        id: "time-offset",
        places: || vec![Instrument::Is, Instrument::Ifo, Instrument::Dws].into_iter().map(Place::Instrument).collect(),
        size: Number::new("s", 0.0, 2.0),
        help: "what the instrument shows at t was true SIZE seconds before",
        shape: &[],
        build,
    },
];

struct Capacitive {
    tm: usize,
    from: usize,
    to: usize,
    size: f64,
}

impl Cause for Capacitive {
    fn read(&mut self, now: &Moment<'_>, _rng: &mut Xoshiro256PlusPlus, measured: &mut Measured) {
        measured.is_r_orf_m[self.tm][self.to] += self.size * now.state.tm[self.tm].r_orf_m[self.from];
    }
}

struct TiltToLength {
    tm: usize,
    theta_m_rad: f64,
    psi_m_rad: f64,
}

impl Cause for TiltToLength {
    fn read(&mut self, now: &Moment<'_>, _rng: &mut Xoshiro256PlusPlus, measured: &mut Measured) {
        let angle = rotation_vector(&now.state.tm[self.tm].q_mrf_from_orf);
        measured.ifo_x_orf_m[self.tm] += self.theta_m_rad * angle.y + self.psi_m_rad * angle.z;
    }
}

/// Displacements and angles of both test masses, then the spacecraft's attitude, each three numbers, with their rates.
#[derive(Clone, Copy)]
struct Shown {
    value: [Vector3<f64>; 5],
    rate: [Vector3<f64>; 5],
}

impl Shown {
    fn of(now: &Moment<'_>) -> Self {
        let mut out = Self { value: [Vector3::zeros(); 5], rate: [Vector3::zeros(); 5] };
        for (i, tm) in now.state.tm.iter().enumerate() {
            let housing = now.plant.tm[i].dcm_orf_from_srf * now.state.omega_srf_rad_s;
            (out.value[2 * i], out.rate[2 * i]) = (tm.r_orf_m, tm.v_orf_m_s);
            // The rotation vector of a small angle turns as the body does.
            out.value[2 * i + 1] = rotation_vector(&tm.q_mrf_from_orf);
            out.rate[2 * i + 1] = tm.omega_mrf_rad_s - turn(&tm.q_mrf_from_orf, &housing);
        }
        out.value[4] = now.state.sc_crf_rad();
        out.rate[4] = now.state.omega_srf_rad_s - turn(&now.state.q_srf_from_crf, &now.omega_crf_rad_s);
        out
    }

    /// Between `self` and `next`, `part` of the interval after `self`: the cubic that has their values and rates.
    fn between(&self, next: &Self, part: f64, dt_s: f64) -> [Vector3<f64>; 5] {
        let (s, rest) = (part, 1.0 - part);
        let (a, b) = (rest * rest * (1.0 + 2.0 * s), s * s * (3.0 - 2.0 * s));
        let (c, d) = (s * rest * rest * dt_s, -s * s * rest * dt_s);
        std::array::from_fn(|i| self.value[i] * a + next.value[i] * b + self.rate[i] * c + next.rate[i] * d)
    }
}

/// Numbers in a [`Shown`].
const SHOWN: usize = 30;

struct TimeOffset {
    instrument: Instrument,
    /// Whole samples and the part of one by which the readout is late.
    samples: usize,
    part: f64,
    /// The last samples, newest first.
    past: VecDeque<Shown>,
}

fn build(asked: &Asked, basis: &Basis<'_>) -> Built {
    let Place::Instrument(instrument) = asked.place else { unreachable!("instances are instruments") };
    let late = asked.size / basis.mission.dt_s();
    Ok(Box::new(TimeOffset { instrument, samples: late as usize, part: late.fract(), past: VecDeque::new() }))
}

impl Cause for TimeOffset {
    fn read(&mut self, now: &Moment<'_>, _rng: &mut Xoshiro256PlusPlus, measured: &mut Measured) {
        let shown = Shown::of(now);
        self.past.push_front(shown);
        self.past.truncate(self.samples + 2);
        // While the loop settles there may be no past yet: the oldest sample is as good.
        let oldest = self.past.len() - 1;
        let (after, before) = (self.past[self.samples.min(oldest)], self.past[(self.samples + 1).min(oldest)]);
        let late = before.between(&after, 1.0 - self.part, now.dt_s);
        let change: [Vector3<f64>; 5] = std::array::from_fn(|i| late[i] - shown.value[i]);
        for tm in 0..2 {
            let (displacement, angle) = (change[2 * tm], change[2 * tm + 1]);
            match self.instrument {
                Instrument::Is => {
                    measured.is_r_orf_m[tm] += displacement;
                    measured.is_att_orf_rad[tm] += angle;
                }
                Instrument::Ifo => measured.ifo_x_orf_m[tm] += displacement.x,
                Instrument::Dws => {
                    measured.dws_orf_rad[tm][0] += angle.y;
                    measured.dws_orf_rad[tm][1] += angle.z;
                }
            }
        }
        if self.instrument == Instrument::Dws {
            measured.dws_sc_crf_rad += change[4];
        }
    }

    fn states(&self) -> Vec<f64> {
        let numbers = |s: &Shown| s.value.iter().chain(&s.rate).flatten().copied().collect::<Vec<_>>();
        self.past.iter().flat_map(numbers).collect()
    }

    fn set_states(&mut self, states: &[f64]) -> bool {
        let vectors = |v: &[f64]| std::array::from_fn(|i| Vector3::from_column_slice(&v[3 * i..3 * i + 3]));
        let (whole, rest) = states.as_chunks::<SHOWN>();
        self.past = whole.iter().map(|s| Shown { value: vectors(&s[..15]), rate: vectors(&s[15..]) }).collect();
        rest.is_empty() && whole.len() <= self.samples + 2
    }
}
