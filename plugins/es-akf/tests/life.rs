//! Gaps, outliers, indefinite noise, saved states.

mod common;

use common::{Alpha, Epoch, Simulation, model, settings};
use dragfree_es_akf::filter::{Adaptation, Drive, Filter, Settings};
use dragfree_es_akf::model::{Coefficient, Model};
use dragfree_es_akf::tracker::{Factor, Follower, Regressor, Rows, follow};
use dragfree_sdk::state::{self, StateError};

const NAN3: [f64; 3] = [f64::NAN; 3];

/// One test mass with 16 states.
type Akf = Filter<16, 3>;

fn default_model() -> Model {
    model([&[4], &[2], &[2]], 1e-6)
}

fn gated() -> Settings {
    Settings { gate_sigma: 6.0, ..settings(Adaptation::Monotone) }
}

/// `epochs` of data through a filter, spoilt on the way by `spoil(k, &mut epoch)`.
fn run(settings: Settings, epochs: usize, mut spoil: impl FnMut(usize, &mut Epoch)) -> (Akf, Simulation) {
    let model = default_model();
    let mut data = Simulation::new(&model, Alpha::Coloured(1.0), 5);
    let mut filter = Akf::new(model, settings);
    for k in 0..epochs {
        let mut epoch = data.epoch();
        spoil(k, &mut epoch);
        filter.step(epoch.readout_m, Drive { acceleration_m_s2: epoch.u_m_s2, regressors: &epoch.phi });
    }
    (filter, data)
}

fn worst_z(filter: &Akf, data: &Simulation) -> f64 {
    let z = |i: usize| (filter.coefficients()[i] - data.b_m[i]).abs() / filter.coefficient_covariance(i, i).sqrt();
    (0..3).map(z).fold(0.0, f64::max)
}

/// NIS per degree of freedom: within five σ of sampling, false alarm 6e-7.
fn nis_is_one(filter: &Akf) -> bool {
    let s = filter.statistics();
    let dof = s.readouts.iter().sum::<u64>() as f64;
    (s.nis().expect("after warm-up") - 1.0).abs() < 5.0 * (2.0 / dof).sqrt()
}

#[test]
fn missing_readouts_are_bridged_and_nothing_is_invented() {
    let gap = 8_000..8_600;
    let mut variances = Vec::new();
    let model = default_model();
    let mut data = Simulation::new(&model, Alpha::Coloured(1.0), 5);
    let mut filter = Akf::new(model, settings(Adaptation::Off));
    for k in 0..20_000 {
        let mut epoch = data.epoch();
        if gap.contains(&k) {
            epoch.readout_m = NAN3;
        }
        filter.step(epoch.readout_m, Drive { acceleration_m_s2: epoch.u_m_s2, regressors: &epoch.phi });
        if gap.contains(&k) {
            variances.push((filter.coefficient_covariance(1, 1), filter.coefficients()[1]));
        }
    }
    // The first row of the gap still carries the update before it.
    assert!(variances[1..].windows(2).all(|w| w[0].1.to_bits() == w[1].1.to_bits()), "the estimate moved without data");
    assert!(variances[1..].windows(2).all(|w| w[1].0 >= w[0].0 * (1.0 - 1e-9)), "σ fell without data");
    let s = filter.statistics();
    assert_eq!((s.predictions, s.reacquisitions), (gap.len() as u64 + 1, 0));
    assert!(nis_is_one(&filter) && worst_z(&filter, &data) < 4.5, "{s:?}");
}

#[test]
fn one_missing_readout_leaves_the_others_at_work() {
    let (filter, data) = run(settings(Adaptation::Off), 20_000, |k, e| {
        if (5_000..15_000).contains(&k) {
            e.readout_m[0] = f64::NAN;
        }
    });
    let s = filter.statistics();
    assert_eq!(s.readouts[1] - s.readouts[0], 10_000);
    assert_eq!(s.updates, 19_999);
    assert!(nis_is_one(&filter) && worst_z(&filter, &data) < 4.5, "{s:?}");
}

#[test]
fn after_a_gap_of_the_drive_the_track_is_acquired_anew_and_the_coefficients_are_kept() {
    let gap = 10_000..11_000;
    for regressors in [false, true] {
        let (filter, data) = run(settings(Adaptation::Off), 20_000, |k, e| {
            if gap.contains(&k) {
                if regressors {
                    e.phi[1][0] = f64::NAN;
                } else {
                    e.u_m_s2 = NAN3;
                }
            }
        });
        let s = filter.statistics();
        assert_eq!((s.reacquisitions, s.predictions), (1, gap.len() as u64 + 1));
        assert!(nis_is_one(&filter) && worst_z(&filter, &data) < 4.5, "{s:?}");
        let (short, _) = run(settings(Adaptation::Off), 10_000, |_, _| {});
        assert!(
            filter.coefficient_covariance(1, 1) < 0.8 * short.coefficient_covariance(1, 1),
            "it learned nothing after the gap"
        );
    }
}

#[test]
fn a_missing_day_lets_sigma_grow_only_where_something_walks() {
    let (mut filter, _) = run(settings(Adaptation::Off), 5_000, |_, _| {});
    let (value, before) = (filter.coefficients().to_vec(), filter.coefficient_covariance(1, 1));
    filter.skip(864_000);
    assert_eq!(filter.coefficients(), value);
    assert!(filter.coefficient_covariance(1, 1) <= before, "the last readout was lost");
}

#[test]
fn outliers_are_refused_and_counted() {
    let spoil = |k: usize, e: &mut Epoch| {
        if k >= 10_000 && k.is_multiple_of(500) {
            e.readout_m[k % 3] += 1e-6;
        }
    };
    let (filter, data) = run(gated(), 20_000, spoil);
    let s = filter.statistics();
    assert_eq!((s.rejected, s.reacquisitions), (20, 0));
    assert!(worst_z(&filter, &data) < 4.5, "{s:?}");
    // The twin: without the gate the same outliers ruin the estimate.
    let (open, data) = run(Settings { gate_sigma: 0.0, ..gated() }, 20_000, spoil);
    assert!(worst_z(&open, &data) > 10.0);
}

#[test]
fn a_lasting_jump_does_not_lock_the_gate_for_ever() {
    let (filter, data) = run(gated(), 20_000, |k, e| {
        if k >= 12_000 {
            e.readout_m[1] += 1e-5;
        }
    });
    let s = filter.statistics();
    assert_eq!((s.rejected, s.reacquisitions), (30, 1));
    assert!(worst_z(&filter, &data) < 4.5, "{s:?}");
}

#[test]
fn an_indefinite_noise_is_repaired_and_counted() {
    // A thousand times faster than in service, so that weeks of adaptation pass in minutes.
    let fast = |adaptation| Settings { forgetting: 0.999, check_epochs: 100, ..settings(adaptation) };
    let (filter, _) = run(fast(Adaptation::Monotone), 30_000, |_, _| {});
    let s = filter.statistics();
    assert!(s.repairs_q > 0, "{s:?}");
    assert!(filter.coefficients().iter().all(|x| x.is_finite()));
    // The innovation variant breaks down, is begun anew, and never gives NaN.
    let (filter, _) = run(fast(Adaptation::Innovation), 30_000, |_, _| {});
    let s = filter.statistics();
    assert!(s.repairs_q + s.repairs_p + s.resets > 0, "{s:?}");
    assert!(filter.coefficients().iter().all(|x| x.is_finite()));
}

/// A prior that no covariance can be, as a wrong hand-over would leave one: repaired at the first check and counted.
#[test]
fn an_indefinite_prior_is_repaired_and_counted() {
    let mut model = default_model();
    // A chain of two states correlated by more than one.
    let s = &mut model.chains[0][0].stationary;
    let size = (s[0] * s[3]).sqrt();
    (s[1], s[2]) = (1.5 * size, 1.5 * size);
    let mut data = Simulation::new(&default_model(), Alpha::Coloured(1.0), 5);
    let mut filter = Akf::new(model, Settings { check_epochs: 100, ..gated() });
    for _ in 0..20_000 {
        let e = data.epoch();
        filter.step(e.readout_m, Drive { acceleration_m_s2: e.u_m_s2, regressors: &e.phi });
    }
    let s = filter.statistics();
    assert!(s.repairs_p + s.resets > 0, "{s:?}");
    assert!(filter.coefficients().iter().all(|x| x.is_finite()) && worst_z(&filter, &data) < 4.5, "{s:?}");
}

/// An offset half a metre from where a prior of 2 cm (1σ) puts it: theory leaves `P P₀⁻¹` of the difference, nothing
/// else.
#[test]
fn an_offset_far_from_its_prior_is_found() {
    let truth = default_model();
    let mut data = Simulation::new(&truth, Alpha::Coloured(1.0), 5);
    let mut believed = truth;
    for (j, c) in believed.coefficients.iter_mut().enumerate() {
        *c = Coefficient { initial: data.b_m[j] - 0.5, prior_sigma: 0.02 };
    }
    let mut filter = Akf::new(believed, Settings { gate_sigma: 6.0, ..settings(Adaptation::Off) });
    for _ in 0..20_000 {
        let e = data.epoch();
        filter.step(e.readout_m, Drive { acceleration_m_s2: e.u_m_s2, regressors: &e.phi });
    }
    for i in 0..3 {
        let pulled: f64 = (0..3).map(|j| filter.coefficient_covariance(i, j) / 0.02_f64.powi(2) * 0.5).sum();
        let error = filter.coefficients()[i] - (data.b_m[i] - pulled);
        let sigma = filter.coefficient_covariance(i, i).sqrt();
        assert!(error.abs() < 4.5 * sigma, "{i}: {error} with σ {sigma}, of which the prior {pulled}");
        assert!(pulled < 0.25, "{i}: the data say too little for the test");
    }
}

/// An instrument that gives the same bits for ever: finite, and σ promises what it would with live data, not more.
#[test]
fn constant_readouts_promise_nothing() {
    for adaptation in [Adaptation::Off, Adaptation::Monotone] {
        let stuck = [1e-9, -2e-9, 3e-9];
        let (dead, _) = run(settings(adaptation), 20_000, |_, e| e.readout_m = stuck);
        let (live, _) = run(settings(adaptation), 20_000, |_, _| {});
        assert!(dead.coefficients().iter().all(|x| x.is_finite()));
        for i in 0..3 {
            let (dead, live) = (dead.coefficient_covariance(i, i), live.coefficient_covariance(i, i));
            assert!(dead > 0.99 * live, "{adaptation:?} {i}: {dead:e} against {live:e}");
        }
    }
}

/// Without a single readout nothing is known that was not before, to the bit.
#[test]
fn without_readouts_the_prior_stays() {
    let (filter, _) = run(gated(), 5_000, |_, e| e.readout_m = NAN3);
    let s = filter.statistics();
    assert_eq!((s.updates, s.predictions, s.nis()), (0, 5_000, None));
    for i in 0..3 {
        assert_eq!(filter.coefficients()[i], 0.0);
        assert_eq!(filter.coefficient_covariance(i, i), 0.1_f64.powi(2));
        assert_eq!(filter.recursion_covariance(i, i), 0.1_f64.powi(2));
    }
}

/// A spacecraft that does not turn tells nothing of the offset: value and σ stay at the prior, to the bit, under every
/// adaptation.
#[test]
fn without_angular_acceleration_the_prior_stays() {
    for adaptation in [Adaptation::Off, Adaptation::Monotone, Adaptation::Innovation, Adaptation::Residual] {
        let (filter, _) = run(settings(adaptation), 20_000, |_, e| e.phi = [[0.0; 3]; 3]);
        assert_eq!(filter.statistics().updates, 19_999);
        for i in 0..3 {
            assert_eq!(filter.coefficients()[i], 0.0, "{adaptation:?}");
            assert_eq!(filter.coefficient_covariance(i, i), 0.1_f64.powi(2), "{adaptation:?}");
        }
    }
}

/// Two halves through a saved state give the bits of the whole, wherever it is cut, gaps included.
#[test]
fn a_saved_state_resumes_to_the_bit() {
    let model = default_model();
    let mut data = Simulation::new(&model, Alpha::White, 9);
    let (mut r, mut u, mut phi) = ([vec![], vec![], vec![]], [vec![], vec![], vec![]], vec![vec![]; 9]);
    for k in 0..6_000 {
        let mut e = data.epoch();
        if (3_000..3_050).contains(&k) {
            e.u_m_s2 = NAN3;
        }
        if (4_000..4_020).contains(&k) {
            e.readout_m[2] = f64::NAN;
        }
        for i in 0..3 {
            r[i].push(e.readout_m[i]);
            u[i].push(e.u_m_s2[i]);
            for j in 0..3 {
                phi[3 * j + i].push(e.phi[j][i]);
            }
        }
    }
    let rows = Rows {
        readout_m: vec![&r[0], &r[1], &r[2]],
        u_m_s2: vec![&u[0], &u[1], &u[2]],
        regressors: (0..9)
            .map(|c| Regressor {
                coefficient: Factor::Estimated(c / 3),
                times: Factor::Fixed(1.0),
                factor: 1.0,
                axis: c % 3,
                column: phi[c].as_slice(),
            })
            .collect(),
    };
    let fresh = || follow(model.clone(), gated(), 60.0).expect("16 states");
    let save = |t: &mut dyn Follower| state::save("es-akf", 1, |state| t.state(state)).expect("a state");
    let load = |t: &mut dyn Follower, bytes: &[u8]| state::load("es-akf", 1, bytes, |state| t.state(state));
    let mut whole = fresh();
    let snapshots = whole.process(&rows, 0..6_000);
    for cut in [0, 1, 777, 2_001, 3_000, 3_025, 4_010, 5_999] {
        let mut first = fresh();
        let mut both = first.process(&rows, 0..cut);
        let saved = save(&mut *first);
        let mut second = fresh();
        load(&mut *second, &saved).expect("its own state");
        assert_eq!(save(&mut *second), saved, "cut at {cut}");
        both.extend(second.process(&rows, cut..6_000));
        assert_eq!(format!("{both:?}"), format!("{snapshots:?}"), "cut at {cut}");
        assert_eq!(save(&mut *second), save(&mut *whole), "cut at {cut}");
    }
    let mut fewer = model.clone();
    fewer.coefficients.pop();
    let mut fewer = follow(fewer, gated(), 60.0).expect("15 states");
    assert!(matches!(load(&mut *fewer, &save(&mut *whole)), Err(StateError::Content(_))));
}
