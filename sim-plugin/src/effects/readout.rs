//! Readouts that differ from the true state.

use dragfree_physics::attitude::{rotation_vector, turn};
use dragfree_physics::few::Few;
use dragfree_physics::mission::MOST_TEST_MASSES;
use nalgebra::Vector3;
use rand_xoshiro::Xoshiro256PlusPlus;
use std::collections::VecDeque;

use super::request::{Built, EffectRequest, Instrument, Kind, Number, Place, Shape, test_masses, tm_axes, tm_pairs};
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
        build: |request, _| {
            let Place::TmAxis(tm, axis) = request.place else { unreachable!("instances are axes of a test mass") };
            Ok(Box::new(Capacitive { tm, from: axis, to: axis, size: request.size }))
        },
    },
    Kind {
        id: "is-crosstalk",
        places: |count| tm_pairs(count, &[0, 1, 2]),
        size: RATIO,
        help: "capacitive readout: NAME.y-x shows SIZE times the displacement along y in x too",
        shape: &[],
        build: |request, _| {
            let Place::TmPair { tm, from, to } = request.place else { unreachable!("instances are pairs of axes") };
            Ok(Box::new(Capacitive { tm, from, to, size: request.size }))
        },
    },
    Kind {
        id: "tilt-to-length",
        places: test_masses,
        size: LEVER,
        help: "interferometer: x shows SIZE times the test mass's angle θ too",
        shape: &[Shape::new("psi_m_rad", LEVER, 0.0, "and this times its ψ, m/rad")],
        build: |request, _| {
            let Place::Tm(tm) = request.place else { unreachable!("instances are test masses") };
            Ok(Box::new(TiltToLength { tm, theta_m_rad: request.size, psi_m_rad: request.shape("psi_m_rad") }))
        },
    },
    Kind {
        id: "time-offset",
        places: |_| vec![Instrument::Is, Instrument::Ifo, Instrument::Dws].into_iter().map(Place::Instrument).collect(),
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
        measured.tm[self.tm].is_r_orf_m[self.to] += self.size * now.state.tm[self.tm].r_orf_m[self.from];
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
        measured.tm[self.tm].ifo_orf_m.x += self.theta_m_rad * angle.y + self.psi_m_rad * angle.z;
    }
}

/// Displacements and angles of the test masses, then the spacecraft's attitude.
type Vectors = Few<Vector3<f64>, { 2 * MOST_TEST_MASSES + 1 }>;

/// True values and rates of all readouts.
#[derive(Clone, Copy)]
struct Shown {
    value: Vectors,
    rate: Vectors,
}

impl Shown {
    fn of(now: &Moment<'_>) -> Self {
        let zero = Vectors::from_fn(2 * now.state.tm.len() + 1, |_| Vector3::zeros());
        let mut out = Self { value: zero, rate: zero };
        for (i, tm) in now.state.tm.iter().enumerate() {
            let housing = now.plant.tm[i].dcm_orf_from_srf * now.state.omega_srf_rad_s;
            (out.value[2 * i], out.rate[2 * i]) = (tm.r_orf_m, tm.v_orf_m_s);
            // The rate of a small rotation vector is the angular rate.
            out.value[2 * i + 1] = rotation_vector(&tm.q_mrf_from_orf);
            out.rate[2 * i + 1] = tm.omega_mrf_rad_s - turn(&tm.q_mrf_from_orf, &housing);
        }
        let last = 2 * now.state.tm.len();
        out.value[last] = now.state.sc_crf_rad();
        out.rate[last] = now.state.omega_srf_rad_s - turn(&now.state.q_srf_from_crf, &now.omega_crf_rad_s);
        out
    }

    /// Cubic Hermite interpolation between `self` and `next`, at `part` of the interval after `self`.
    fn between(&self, next: &Self, part: f64, dt_s: f64) -> Vectors {
        let (s, rest) = (part, 1.0 - part);
        let (a, b) = (rest * rest * (1.0 + 2.0 * s), s * s * (3.0 - 2.0 * s));
        let (c, d) = (s * rest * rest * dt_s, -s * s * rest * dt_s);
        let at = |i: usize| self.value[i] * a + next.value[i] * b + self.rate[i] * c + next.rate[i] * d;
        Vectors::from_fn(self.value.len(), at)
    }
}

struct TimeOffset {
    instrument: Instrument,
    /// Delay of the readout: whole samples, and a fraction of a sample.
    samples: usize,
    part: f64,
    /// The last samples, newest first.
    past: VecDeque<Shown>,
    /// Vectors in a sample.
    vectors: usize,
}

fn build(request: &EffectRequest, basis: &Basis<'_>) -> Built {
    let Place::Instrument(instrument) = request.place else { unreachable!("instances are instruments") };
    let late = request.size / basis.mission.dt_s();
    let vectors = 2 * basis.mission.test_mass.len() + 1;
    Ok(Box::new(TimeOffset { instrument, samples: late as usize, part: late.fract(), past: VecDeque::new(), vectors }))
}

impl Cause for TimeOffset {
    fn read(&mut self, now: &Moment<'_>, _rng: &mut Xoshiro256PlusPlus, measured: &mut Measured) {
        let shown = Shown::of(now);
        self.past.push_front(shown);
        self.past.truncate(self.samples + 2);
        // The first epochs of the settling time use the oldest sample.
        let oldest = self.past.len() - 1;
        let (after, before) = (self.past[self.samples.min(oldest)], self.past[(self.samples + 1).min(oldest)]);
        let late = before.between(&after, 1.0 - self.part, now.dt_s);
        let change = |i: usize| late[i] - shown.value[i];
        for (i, tm) in measured.tm.iter_mut().enumerate() {
            let (displacement, angle) = (change(2 * i), change(2 * i + 1));
            match self.instrument {
                Instrument::Is => {
                    tm.is_r_orf_m += displacement;
                    tm.is_att_orf_rad += angle;
                }
                Instrument::Ifo => tm.ifo_orf_m += displacement,
                Instrument::Dws => {
                    tm.dws_orf_rad[0] += angle.y;
                    tm.dws_orf_rad[1] += angle.z;
                }
            }
        }
        if self.instrument == Instrument::Dws {
            measured.dws_sc_crf_rad += change(self.vectors - 1);
        }
    }

    fn states(&self) -> Vec<f64> {
        let numbers = |s: &Shown| s.value.iter().chain(&s.rate).flatten().copied().collect::<Vec<_>>();
        self.past.iter().flat_map(numbers).collect()
    }

    fn set_states(&mut self, states: &[f64]) -> bool {
        let vectors = |v: &[f64]| v.chunks_exact(3).map(Vector3::from_column_slice).collect();
        let samples = states.chunks_exact(6 * self.vectors);
        let fits = samples.remainder().is_empty() && samples.len() <= self.samples + 2;
        let (values, rates) = (0..3 * self.vectors, 3 * self.vectors..6 * self.vectors);
        self.past =
            samples.map(|s| Shown { value: vectors(&s[values.clone()]), rate: vectors(&s[rates.clone()]) }).collect();
        fits
    }
}
