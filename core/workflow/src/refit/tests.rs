use std::time::{Duration, Instant};

use dragfree_schema::Settings;
use rand::SeedableRng as _;
use rand_distr::{Distribution as _, StandardNormal};
use rand_xoshiro::Xoshiro256PlusPlus;
use serde_json::json;

use super::*;

/// Samples of a day, offsets, and effects.
const SAMPLES: usize = 400;
const OFFSETS: usize = 6;

/// Data of a day: regressors of all coefficients and what was measured with unit noise.
struct Data {
    regressors: DMatrix<f64>,
    measured: DVector<f64>,
}

fn data(random: &mut Xoshiro256PlusPlus, truth: &DVector<f64>) -> Data {
    let mut white = || StandardNormal.sample(random);
    let own = DMatrix::from_fn(SAMPLES, truth.len(), |_, _| white());
    // Every effect looks a little like an offset, so that its absence moves one.
    let regressors = DMatrix::from_fn(SAMPLES, truth.len(), |t, k| {
        let other: f64 = own[(t, k % OFFSETS)];
        if k < OFFSETS { own[(t, k)] } else { own[(t, k)] + 0.5 * other }
    });
    let noise = DVector::from_fn(SAMPLES, |_, _| white());
    let measured = &regressors * truth + noise;
    Data { regressors, measured }
}

/// The basis that diagnoses of these data would leave, with a level of noise beside.
fn basis(days: &[Data]) -> Basis {
    let n = days[0].regressors.ncols();
    let coefficient = |k: usize| Coefficient {
        name: if k < OFFSETS { format!("offset.b.{k}") } else { format!("effect.{k}") },
        effect: if k < OFFSETS { "offset".to_owned() } else { "effect".to_owned() },
        instance: k.to_string(),
        unit: if k < OFFSETS { "m".to_owned() } else { "1".to_owned() },
        lower: f64::NEG_INFINITY,
        upper: f64::INFINITY,
        prior_sigma: f64::INFINITY,
        candidate: k >= OFFSETS,
        estimate: true,
        ..Coefficient::default()
    };
    let switch = |k: usize| Switch {
        name: format!("effect:{k}"),
        effect: "effect".to_owned(),
        instance: k.to_string(),
        shape: Shape::new(),
    };
    let level = NoiseLevel {
        effect: "louder".to_owned(),
        instance: "x".to_owned(),
        coefficient: "louder.x".to_owned(),
        stated: 1.0,
        ln: 0.3,
        sigma: 0.1,
        channels: Vec::new(),
        rivals: None,
    };
    let day = |(number, d): (usize, &Data)| Day {
        product: format!("day{number}"),
        places: (0..n).collect(),
        information: d.regressors.tr_mul(&d.regressors),
        score: d.regressors.tr_mul(&d.measured),
        chi2_at_zero: d.measured.norm_squared(),
        numbers: SAMPLES as f64,
        levels: vec![level.clone()],
        kept: (0..n).collect(),
        by_band: None,
        stretches: Vec::new(),
        extract: None,
    };
    Basis {
        settings: Settings::default(),
        days: days.iter().enumerate().map(day).collect(),
        coefficients: (0..n).map(coefficient).collect(),
        channels: BTreeMap::new(),
        priors: Vec::new(),
        candidates: (OFFSETS..n).map(Candidate::free).collect(),
        switches: (OFFSETS..n).map(switch).collect(),
        trials: serde_json::from_value(json!({ "forms": { "effect": n - OFFSETS, "louder": 1.0 } })).expect("trials"),
        named: Vec::new(),
        unexplained: Vec::new(),
        not_tried: BTreeMap::new(),
        housekeeping: BTreeMap::new(),
        divided: Mutex::default(),
    }
}

fn asked(on: &[&str], held_out: &[&str]) -> Asked {
    let all = |names: &[&str]| names.iter().map(|name| (*name).to_owned()).collect();
    Asked { on: all(on), held_out: all(held_out) }
}

/// Least squares of some columns by QR: values, σ, and the sum of squared residuals of other data at these values.
fn least_squares(days: &[Data], columns: &[usize]) -> (DVector<f64>, DVector<f64>) {
    let rows: Vec<DMatrix<f64>> = days.iter().map(|d| d.regressors.select_columns(columns)).collect();
    let design = DMatrix::from_fn(SAMPLES * days.len(), columns.len(), |t, k| rows[t / SAMPLES][(t % SAMPLES, k)]);
    let measured = DVector::from_fn(SAMPLES * days.len(), |t, _| days[t / SAMPLES].measured[t % SAMPLES]);
    let qr = design.qr();
    let r = qr.r().try_inverse().expect("regular");
    let values = &r * qr.q().tr_mul(&measured);
    let sigma = DVector::from_fn(columns.len(), |k, _| r.row(k).norm());
    (values, sigma)
}

fn squares(day: &Data, columns: &[usize], values: &DVector<f64>) -> f64 {
    (&day.measured - day.regressors.select_columns(columns) * values).norm_squared()
}

/// Of a product with one stretch nothing would be left: it was fitted nevertheless.
#[test]
fn the_only_stretch_of_a_product_is_not_kept_out_alone() {
    let mut random = Xoshiro256PlusPlus::seed_from_u64(4);
    let days = [data(&mut random, &DVector::zeros(OFFSETS + 1)), data(&mut random, &DVector::zeros(OFFSETS + 1))];
    let mut basis = basis(&days);
    basis.days[0].stretches = vec![(0, 1)];
    assert!(basis.stretches("day0").is_empty(), "it is not offered");
    let refused = basis.refit(&asked(&[], &[&format!("day0{STRETCH}1")]));
    assert!(matches!(refused, Err(RefitError::WholeProduct(product)) if product == "day0"));
}

/// Every rung is the least-squares solution of its columns, made from the data themselves by QR: values, σ, χ² of the
/// fit and of the day that is kept out.
#[test]
fn a_refit_is_least_squares_on_the_data() {
    let mut random = Xoshiro256PlusPlus::seed_from_u64(1);
    let mut truth = DVector::zeros(OFFSETS + 8);
    truth[0] = 0.5;
    truth[OFFSETS + 2] = 0.4;
    let days: Vec<Data> = (0..3).map(|_| data(&mut random, &truth)).collect();
    let refit = basis(&days).refit(&asked(&["effect:8", "effect:11"], &["day2"])).expect("a refit");
    assert_eq!((refit.products, refit.held_out), (vec!["day0".into(), "day1".into()], vec!["day2".to_owned()]));
    let model: Vec<usize> = (0..OFFSETS).collect();
    let mut before: Option<(f64, f64)> = None;
    for (rung, more) in refit.rungs.iter().zip([&[][..], &[8], &[8, 11]]) {
        let columns = [&model, more].concat();
        let (values, sigma) = least_squares(&days[..2], &columns);
        let fit: f64 = days[..2].iter().map(|d| squares(d, &columns, &values)).sum();
        let kept_out = squares(&days[2], &columns, &values);
        let near = |a: f64, b: f64| assert!((a - b).abs() < 1e-8 * b.abs().max(1.0), "{a} {b}");
        for (k, offset) in rung.offsets.iter().enumerate() {
            near(offset.value_m, values[k]);
            near(offset.sigma_m, sigma[k]);
            near(rung.covariance_m2[k][k], sigma[k].powi(2));
        }
        near(rung.chi2, fit);
        near(rung.held_out_chi2.expect("a day is kept out"), kept_out);
        let (fit_before, kept_out_before) = *before.get_or_insert((fit, kept_out));
        near(rung.fall, fit_before - fit);
        near(rung.held_out_fall.expect("a day is kept out"), kept_out_before - kept_out);
    }
    let names: Vec<&str> = refit.effects.iter().take(2).map(|e| e.name.as_str()).collect();
    assert_eq!(names, ["effect:8", "effect:11"]);
    // What is there is certain, what is not is not.
    let [real, none] = [&refit.effects[0], &refit.effects[1]];
    assert!(real.p_value < 1e-6 && none.p_value > 1e-4, "{real:?} {none:?}");
    let (all, _) = least_squares(&days[..2], &[&model[..], &[8, 11]].concat());
    let (without, _) = least_squares(&days[..2], &[&model[..], &[11]].concat());
    assert!((real.offset_shift_m["offset.b.2"] - (without[2] - all[2])).abs() < 1e-9);
}

/// A level of noise enters with the Gaussian that each day has of it: three days with ln = 0.3 ± 0.1 fall by 3 · 9, and
/// two of them say of the third what it says itself. It moves nothing else.
#[test]
fn a_level_of_noise_falls_by_its_own_significance() {
    let mut random = Xoshiro256PlusPlus::seed_from_u64(2);
    let days: Vec<Data> = (0..3).map(|_| data(&mut random, &DVector::zeros(OFFSETS + 2))).collect();
    let basis = basis(&days);
    let all = basis.refit(&asked(&["louder:x"], &[])).expect("a refit");
    assert!((all.rungs[1].fall - 27.0).abs() < 1e-9, "{:?}", all.rungs[1]);
    let [before, after] = [0, 1].map(|k| all.rungs[k].offsets.iter().map(|o| o.value_m).collect::<Vec<_>>());
    assert_eq!(before, after);
    let level = &all.effects[0];
    assert!(level.is_noise && level.on && (level.coefficients[0].value - 0.3_f64.exp()).abs() < 1e-12, "{level:?}");
    let kept_out = basis.refit(&asked(&["louder:x"], &["day2"])).expect("a refit");
    assert!((kept_out.rungs[1].held_out_fall.expect("kept out") - 9.0).abs() < 1e-9);
}

#[test]
fn what_is_not_there_is_refused_by_name() {
    let mut random = Xoshiro256PlusPlus::seed_from_u64(3);
    let basis = basis(&[data(&mut random, &DVector::zeros(OFFSETS + 2))]);
    let refused = |on: &[&str], held_out: &[&str]| basis.refit(&asked(on, held_out)).expect_err("refused").to_string();
    assert!(refused(&["<b>"], &[]).contains("<b>"));
    assert!(refused(&[], &["day7"]).contains("day7"));
    assert!(refused(&[], &["day0"]).contains("leave one in"));
}

/// Processor time of this thread: other programs of the machine do not count. The clock where the system has none.
fn processor_time(begun: Instant) -> Duration {
    let text = std::fs::read_to_string("/proc/thread-self/schedstat").unwrap_or_default();
    let own = text.split(' ').next().and_then(|ns| ns.parse().ok());
    own.map_or_else(|| begun.elapsed(), Duration::from_nanos)
}

/// Ten effects of 130, more than an extract of the bundled mission has, over 30 days: 95 of 100 refits take at most
/// 100 ms. Each asks for another set, so that nothing can be remembered.
#[test]
#[allow(clippy::print_stdout, reason = "VALIDATION.md has this line")]
fn ten_effects_over_thirty_days_take_a_tenth_of_a_second_at_most() {
    let mut random = Xoshiro256PlusPlus::seed_from_u64(4);
    let days: Vec<Data> = (0..30).map(|_| data(&mut random, &DVector::zeros(OFFSETS + 130))).collect();
    let basis = basis(&days);
    let mut times: Vec<Duration> = Vec::new();
    let start = Instant::now();
    for k in 0..40 {
        let on: Vec<String> = (0..10).map(|i| format!("effect:{}", OFFSETS + (7 * k + 23 * i) % 130)).collect();
        let asked = Asked { on, held_out: vec![format!("day{}", k % 30)] };
        let before = processor_time(start);
        let refit = basis.refit(&asked).expect("a refit");
        times.push(processor_time(start) - before);
        assert_eq!((refit.rungs.len(), refit.products.len()), (11, 29));
    }
    times.sort();
    let [median, most] = [times[20], times[37]];
    println!("refit of 10 of 130 effects over 30 days: median {median:.1?}, 95 of 100 within {most:.1?}");
    assert!(most < Duration::from_millis(100), "{times:?}");
}
