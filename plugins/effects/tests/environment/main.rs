//! Effects of the environment through the plugin interface, compared with independent physics.

mod harness;
mod prediction;

use harness::{AXES, DT_S, START_NS, Telemetry, mission, relative_difference};
use nalgebra::{Matrix3, Vector3};
use proptest::prelude::*;
use serde_json::{Value, json};
use std::collections::BTreeMap;

const MU_0: f64 = 1.256_637_061_27e-6;

/// `T_S^{O_i}` from the mission file's angle.
fn orf_from_srf(tm: usize) -> Matrix3<f64> {
    let (sin, cos) = [std::f64::consts::FRAC_PI_6, -std::f64::consts::FRAC_PI_6][tm].sin_cos();
    Matrix3::new(cos, sin, 0.0, -sin, cos, 0.0, 0.0, 0.0, 1.0)
}

/// The three channels of a vector as one vector per row.
fn vectors(added: &BTreeMap<String, Vec<f64>>, stem: &str, rows: usize) -> Vec<Vector3<f64>> {
    let of = |axis: usize, k: usize| added.get(&format!("{stem}.{}", AXES[axis])).map_or(0.0, |column| column[k]);
    (0..rows).map(|k| Vector3::from_fn(|axis, _| of(axis, k))).collect()
}

fn flat(vectors: &[Vector3<f64>]) -> Vec<f64> {
    vectors.iter().flat_map(|v| v.iter().copied()).collect()
}

/// Asserts the response of both test masses to accelerations of the spacecraft, SRF, m s⁻²; a wrong sign must fail.
fn assert_test_masses_see(added: &BTreeMap<String, Vec<f64>>, spacecraft: &[Vector3<f64>], bound: f64) {
    for tm in 0..2 {
        let want: Vec<Vector3<f64>> = spacecraft.iter().map(|a| orf_from_srf(tm) * -a).collect();
        let got = flat(&vectors(added, &format!("tm{}.accel", tm + 1), want.len()));
        assert!(
            relative_difference(&got, &flat(&want)) < bound,
            "tm{}: {}",
            tm + 1,
            relative_difference(&got, &flat(&want))
        );
        let turned: Vec<f64> = flat(&want).iter().map(|x| -x).collect();
        assert!(relative_difference(&got, &turned) > 0.5, "a wrong sign must fail");
    }
}

/// Reference: `τ ẏ = T − y` in small steps. The column names carry no meaning.
#[test]
fn thermal_matches_the_lag_equation() {
    let rows = 6000;
    let mut telemetry = Telemetry::new(rows, &[("hk.b7", "K"), ("hk.a", "K"), ("hk.volts", "V")]);
    telemetry.fill("hk.b7", |t| 294.0 + if t > 50.0 { 0.02 } else { 0.0 });
    telemetry.fill("hk.a", |t| 293.0 + 0.01 * (0.05 * t).sin());
    let (k, tau) = (3e-11, 77.0);
    let parameters = json!({"plus": "hk.b7", "minus": "hk.a", "lag_s": tau});
    let added = telemetry.added("thermal", "tm2.y", parameters, &[("", k)]);
    assert_eq!(added.len(), 1);
    let lagged = |name: &str| {
        let steps = 50;
        let mut y = telemetry.row(name)[0];
        let of = |u: &f64| {
            let mut mean = 0.0;
            for _ in 0..steps {
                let half = y + 0.5 * DT_S / f64::from(steps) * (u - y) / tau;
                y += DT_S / f64::from(steps) * (u - half) / tau;
                mean += half / f64::from(steps);
            }
            mean
        };
        telemetry.row(name).iter().map(of).collect::<Vec<f64>>()
    };
    let (plus, minus) = (lagged("hk.b7"), lagged("hk.a"));
    let want: Vec<f64> = (0..rows).map(|i| k * (plus[i] - minus[i] - 1.0)).collect();
    let got: Vec<f64> = added["tm2.accel.y"].iter().map(|x| x - k).collect();
    assert!(relative_difference(&got, &want) < 1e-8, "{}", relative_difference(&got, &want));
    let no_lag: Vec<f64> =
        (0..rows).map(|i| k * (telemetry.row("hk.b7")[i] - telemetry.row("hk.a")[i] - 1.0)).collect();
    assert!(relative_difference(&no_lag, &want) > 0.1, "the lag must be visible");
}

/// Every pair occurs once at every lag; a second instance reuses the series of the first.
#[test]
fn a_thermal_candidate_has_every_pair_at_every_lag() {
    let mut telemetry = Telemetry::new(10, &[("hk.p", "K"), ("hk.q", "K"), ("hk.r", "K"), ("hk.volts", "V")]);
    let (_, first) = telemetry.link("thermal", "tm1.x", json!({}), true).expect("linked");
    assert_eq!(first.coefficients[0].variants.len(), 3 * 13);
    let written: Vec<_> = first.writes.iter().flat_map(|t| t.columns.clone()).collect();
    assert_eq!(written.len(), 3 * 13);
    let rows = telemetry.time_ns.len();
    telemetry.rows.extend(written.iter().map(|_| vec![0.0; rows]));
    telemetry.columns.extend(written);
    let (_, second) = telemetry.link("thermal", "tm2.z", json!({}), true).expect("linked");
    assert!(second.writes.is_empty() && second.reads.is_empty());
    let variant = &second.coefficients[0].variants[13 + 1];
    assert_eq!(json!(variant.shape), json!({"plus": "hk.p", "minus": "hk.r", "lag_s": 45.0}));
    let responses = &variant.responses;
    assert_eq!(responses[0].table, "effect/thermal:tm1.x");
    assert_eq!((responses[0].series.as_str(), responses[0].factor), ("lag(hk.p,45)", 1.0));
    assert_eq!((responses[1].series.as_str(), responses[1].factor), ("lag(hk.r,45)", -1.0));
    assert!(responses.iter().all(|r| r.channel == "tm2.accel.z"));
    // A variant's shape, given as parameters, reproduces its responses.
    let (_, third) = telemetry.link("thermal", "tm2.z", json!(variant.shape), false).expect("linked");
    assert_eq!(third.coefficients[0].responses, variant.responses);
}

/// Reference: the energy of two electrodes at `∓ΔV/2` and a charged test mass between them. At constant charge and
/// voltages `F = d/dx [½ΣC V² − ½(q + ΣC V)²/ΣC]`; its part odd in q is due to the stray voltage.
#[test]
fn charge_matches_the_electrostatic_energy() {
    let mut telemetry = Telemetry::new(50, &[("hk.q9", "C"), ("hk.other", "C")]);
    telemetry.fill("hk.q9", |t| 1e-13 * (1.0 - 0.3 * t));
    let (voltage, capacitance, gradient) = (0.4, 34.2e-12, 291e-12);
    let added = telemetry.added("charge", "tm1", json!({"charge": "hk.q9"}), &[("", voltage)]);
    let energy = |q: f64, x: f64| {
        // The remaining capacitance is to the grounded housing.
        let c = [1e-12 + gradient * x, 1e-12 - gradient * x, capacitance - 2e-12];
        let v = [-0.5 * voltage, 0.5 * voltage, 0.0];
        let (total, charged): (f64, f64) = (c.iter().sum(), q + c.iter().zip(v).map(|(c, v)| c * v).sum::<f64>());
        0.5 * c.iter().zip(v).map(|(c, v)| c * v * v).sum::<f64>() - 0.5 * charged * charged / total
    };
    let force = |q: f64| (energy(q, 1e-5) - energy(q, -1e-5)) / 2e-5;
    let want: Vec<f64> = telemetry
        .row("hk.q9")
        .iter()
        .map(|q| 0.5 * (force(*q) - force(-q)) / mission().test_mass["tm1"].mass_kg)
        .collect();
    assert!(
        relative_difference(&added["tm1.accel.x"], &want) < 1e-4,
        "{}",
        relative_difference(&added["tm1.accel.x"], &want)
    );
    let (_, tried) = telemetry.link("charge", "tm2", json!({}), true).expect("linked");
    assert_eq!(tried.coefficients[0].variants.len(), 2);
    let refused =
        telemetry.link("charge", "tm1", json!({"charge": "hk.q8"}), false).map(drop).expect_err("no such column");
    assert!(refused.contains("hk.q9, hk.other"), "{refused}");
}

/// Reference: finite differences of the energy `−(m_r·B + χV B²/2μ0)` in a field of constant form.
#[test]
fn magnetic_matches_the_field_energy() {
    let mut telemetry = Telemetry::new(80, &[("hk.g", "T m-1"), ("hk.b", "T"), ("hk.c", "T")]);
    telemetry.fill("hk.g", |t| 8e-6 * (1.0 + 0.3 * (0.9 * t).sin()));
    telemetry.fill("hk.b", |t| 5e-7 + 2e-7 * (1.7 * t).cos());
    // Symmetric and traceless; the gradiometer measures its xx element.
    let gamma = Matrix3::new(1.0, 0.25, -0.125, 0.25, -0.375, 0.375, -0.125, 0.375, -0.625);
    let (chi, density, mass_kg) = (2e-4, 2e4, 1.96);
    let moment = Vector3::new(1e-8, -2e-8, 5e-9);
    // The column measures y; x and z of the field are constant.
    let (steady, sensed) = (Vector3::new(3e-7, 0.0, -4e-7), 1);
    let mut want = Vec::new();
    for (g, b) in telemetry.row("hk.g").iter().zip(telemetry.row("hk.b")) {
        let energy = |r: Vector3<f64>| {
            let field = steady + Vector3::y() * *b + gamma * r * *g;
            -(moment.dot(&field) + chi * mass_kg / density / (2.0 * MU_0) * field.norm_squared())
        };
        let along = |i: usize| Vector3::from_fn(|j, _| if i == j { 1e-3 } else { 0.0 });
        want.push(Vector3::from_fn(|i, _| -(energy(along(i)) - energy(-along(i))) / 2e-3 / mass_kg));
    }
    let linear = gamma * (moment / mass_kg + steady * (chi / (MU_0 * density)));
    let product = gamma.column(sensed) * (chi / (MU_0 * density));
    let names = ["gradient_x", "gradient_y", "gradient_z", "product_x", "product_y", "product_z"];
    let values: Vec<(&str, f64)> =
        names.iter().enumerate().map(|(i, n)| (*n, if i < 3 { linear[i] } else { product[i - 3] })).collect();
    let parameters = json!({"gradient": "hk.g", "field": "hk.b"});
    let added = telemetry.added("magnetic", "tm2", parameters, &values);
    let got = flat(&vectors(&added, "tm2.accel", want.len()));
    assert!(relative_difference(&got, &flat(&want)) < 1e-9, "{}", relative_difference(&got, &flat(&want)));
    for wrong in 0..6 {
        let mut values = values.clone();
        values[wrong].1 *= -1.0;
        let added = telemetry.added("magnetic", "tm2", json!({"gradient": "hk.g", "field": "hk.b"}), &values);
        assert!(relative_difference(&flat(&vectors(&added, "tm2.accel", want.len())), &flat(&want)) > 0.01, "{wrong}");
    }
    // Two fields with one gradient, and two squares; the six coefficients list them in one order.
    let (_, tried) = telemetry.link("magnetic", "tm1", json!({}), true).expect("linked");
    let variants = |i: usize| tried.coefficients[i].variants.clone();
    assert!((0..6).all(|i| variants(i).len() == 4));
    assert!((0..4).all(|v| variants(0)[v].shape == variants(5)[v].shape));
    assert_eq!(variants(3)[3].shape["gradient"], "hk.c");
    assert_eq!(variants(3)[3].unit.as_deref(), Some("m s-2 T-2"));
    let again = telemetry.link("magnetic", "tm1", json!(variants(3)[3].shape), false).expect("linked").1;
    assert_eq!(again.coefficients[3].responses, variants(3)[3].responses);
}

/// Reference: equations of motion of slug and spacecraft in small steps.
#[test]
fn slosh_matches_two_body_dynamics() {
    let rows = 600;
    let mut telemetry = Telemetry::new(rows, &[]);
    telemetry.fill("used.mps_force_srf_n.y", |t| 1e-5 * if t < 20.0 { 1.0 } else { (0.6 * t).sin() });
    telemetry.fill("used.tm1.force_orf_n.x", |t| 3e-6 * (0.3 * t).cos());
    telemetry.fill("used.tm2.force_orf_n.y", |t| 2e-6 * (0.4 * t).sin());
    telemetry.fill("used.sun_srf.y", |t| 0.1 * (0.05 * t).cos());
    telemetry.fill("used.mps_force_srf_n.x", |t| (1.1 * t).sin());
    let m = mission();
    let (mass_kg, mu, f0_hz, zeta) = (m.spacecraft.mass_kg, 0.1_f64, 0.15, 0.05);
    let pressure_n = m.solar_pressure.as_ref().expect("sunlight").force_n;
    let row = |name: &str, k: usize| telemetry.row(name)[k];
    let net_n: Vec<f64> = (0..rows)
        .map(|k| {
            // Recoil of the electrodes: components of o_1 (bench 1) and o_2 (bench 2) along s_2.
            let recoil = 0.5 * row("used.tm1.force_orf_n.x", k) + 0.75_f64.sqrt() * row("used.tm2.force_orf_n.y", k);
            row("used.mps_force_srf_n.y", k) + pressure_n * row("used.sun_srf.y", k) - recoil
        })
        .collect();
    let (slug_kg, omega, steps) = (mass_kg * mu, std::f64::consts::TAU * f0_hz, 4000);
    let h = DT_S / f64::from(steps);
    // At rest under the first force.
    let (mut x, mut v) = (-net_n[0] / mass_kg / (omega * omega), 0.0);
    let more: Vec<Vector3<f64>> = net_n
        .iter()
        .map(|force_n| {
            let mut gained = 0.0;
            for _ in 0..steps {
                let slug = |x: f64, v: f64| {
                    let spring_n = slug_kg * (omega * omega * x + 2.0 * zeta * omega * v);
                    let a = (force_n + spring_n) / (mass_kg - slug_kg);
                    (a, -spring_n / slug_kg - a)
                };
                let (_, w) = slug(x, v);
                let (a, w) = slug(x + 0.5 * h * v, v + 0.5 * h * w);
                x += h * (v + 0.5 * h * w);
                v += h * w;
                gained += h * a;
            }
            Vector3::y() * (gained / DT_S - force_n / mass_kg)
        })
        .collect();
    let raised = (1.0 - mu).sqrt();
    let parameters = json!({"f0_hz": f0_hz / raised, "zeta": zeta / raised});
    let added = telemetry.added("slosh", "sc.y", parameters, &[("", mu / (1.0 - mu))]);
    assert_test_masses_see(&added, &more, 1e-5);
}

/// A momentum in one sample is a step of velocity, an angular momentum one of rate.
#[test]
fn a_hit_pushes_and_turns_the_spacecraft_once() {
    let telemetry = Telemetry::new(40, &[]);
    let (momentum, arm) = (Vector3::new(0.0, 4e-6, 0.0), Vector3::new(0.5, 0.4, -0.3));
    let angular: Vector3<f64> = arm.cross(&momentum);
    let values =
        [("momentum", momentum.y), ("angular_x", angular.x), ("angular_y", angular.y), ("angular_z", angular.z)];
    // In the middle of the sixth sample.
    let at = json!({"at_ns": START_NS + 550_000_000_i64});
    let added = telemetry.added("impulse", "sc.y", at.clone(), &values);
    let in_sixth = |total: Vector3<f64>| -> Vec<Vector3<f64>> {
        (0..40).map(|k| if k == 5 { total / DT_S } else { Vector3::zeros() }).collect()
    };
    assert_test_masses_see(&added, &in_sixth(momentum / 1500.0), 1e-12);
    let inertia = Matrix3::new(800.0, 13.0, 10.0, 13.0, 800.0, 12.0, 10.0, 12.0, 1000.0);
    let rate = inertia.lu().solve(&angular).expect("an inertia");
    let got = flat(&vectors(&added, "sc.alpha", 40));
    assert!(relative_difference(&got, &flat(&in_sixth(rate))) < 1e-12);

    // A turn: the same by itself, over two seconds.
    let turned = telemetry.added("impulse", "sc.psi", json!({"at_ns": START_NS, "pulse_s": 2.0}), &[("", 7e-7)]);
    let sum: Vector3<f64> = vectors(&turned, "sc.alpha", 40).iter().sum::<Vector3<f64>>() * DT_S;
    let rate = inertia.lu().solve(&Vector3::new(0.0, 0.0, 7e-7)).expect("an inertia");
    assert!((sum - rate).norm() < 1e-12 * rate.norm(), "{sum} {rate}");
    assert!(turned.len() == 3 && turned["sc.alpha.z"][19] > 0.0 && turned["sc.alpha.z"][20].abs() < 1e-30);

    // A glitch transfers its momentum to one axis of one test mass.
    let glitch = telemetry.added("impulse", "tm2.z", json!({"at_ns": START_NS, "decay_s": 0.1}), &[("", -3e-11)]);
    let sum = glitch["tm2.accel.z"].iter().sum::<f64>() * DT_S;
    assert!(glitch.len() == 1 && (sum + 3e-11 / 1.96).abs() < 1e-9 * 3e-11, "{sum:e}");

    let refused = telemetry.link("impulse", "sc.y", json!({}), false).map(drop).expect_err("no time");
    assert!(refused.contains("at_ns"), "{refused}");
}

/// A candidate's transient equals the effect in a model with the same shape.
#[test]
fn candidate_transients_match_the_effect_in_a_model() {
    let telemetry = Telemetry::new(4000, &[]);
    for instance in ["sc.z", "sc.theta", "tm1.x"] {
        let (_, tried) = telemetry.link("impulse", instance, json!({}), true).expect("linked");
        for coefficient in &tried.coefficients {
            let name = &coefficient.name;
            for transient in coefficient.transients.iter().take(4) {
                let mut shape = json!(transient.shape);
                shape["at_ns"] = json!(START_NS + 300_000_000);
                let last = name.strip_prefix(&format!("impulse.{instance}")).expect("its name").trim_start_matches('.');
                let values: Vec<(String, f64)> = tried
                    .coefficients
                    .iter()
                    .map(|c| {
                        c.name.trim_start_matches(&format!("impulse.{instance}")).trim_start_matches('.').to_owned()
                    })
                    .map(|n| (n.clone(), if n == last { 1e-8 } else { 0.0 }))
                    .collect();
                let values: Vec<(&str, f64)> = values.iter().map(|(n, v)| (n.as_str(), *v)).collect();
                let added = telemetry.added("impulse", instance, shape, &values);
                for (channel, factor) in &transient.channels {
                    let want: Vec<f64> = transient.kernel.iter().take(3997).map(|k| 1e-8 * factor * k).collect();
                    let got = &added[channel][3..3 + want.len()];
                    assert!(added[channel][..3].iter().all(|x| *x == 0.0));
                    assert!(
                        relative_difference(got, &want) < 1e-5,
                        "{instance} {name} {channel}: {}",
                        relative_difference(got, &want)
                    );
                }
            }
        }
    }
}

/// Reference: three thrusters with independent noise; force and torque follow from their positions and directions.
#[test]
fn mps_correlation_matches_single_thruster_noise() {
    let rows = 30;
    let mut telemetry = Telemetry::new(rows, &[]);
    let directions = Matrix3::new(1.0, 0.2, 0.0, 0.1, 1.0, 0.3, 0.0, -0.2, 1.0);
    let positions = Matrix3::new(0.5, -0.8, 0.1, 0.7, 0.3, -0.9, -0.2, 0.4, 0.6);
    let torques = Matrix3::from_columns(&[0, 1, 2].map(|i| positions.column(i).cross(&directions.column(i))));
    let noise = |t: f64| Vector3::new((3.0 * t).sin(), (2.3 * t).cos(), (1.1 * t).sin()) * 1e-7;
    let m = mission();
    let known = |t: f64| Vector3::new(2e-6 * t, -1e-6, 3e-7);
    let sun = Vector3::new(0.3, -0.2, -0.9);
    let pressure = m.solar_pressure.as_ref().expect("sunlight");
    let sunlight = Vector3::from(pressure.arm_srf_m).cross(&(sun * pressure.force_n));
    for (i, axis) in AXES.into_iter().enumerate() {
        let inverse = m.spacecraft.inertia_inverse();
        telemetry.fill(&format!("used.mps_torque_srf_nm.{axis}"), |t| known(t)[i]);
        telemetry.fill(&format!("used.sun_srf.{axis}"), |_| sun[i]);
        telemetry.fill(&format!("sc.alpha_srf_rad_s2.{axis}"), |t| {
            (inverse * (known(t) + sunlight + torques * noise(t)))[i]
        });
    }
    let gain = directions * torques.try_inverse().expect("three arms that differ");
    let names: Vec<String> =
        AXES.iter().flat_map(|f| AXES.iter().map(move |t| format!("force_{f}_by_torque_{t}"))).collect();
    let values: Vec<(&str, f64)> = names.iter().enumerate().map(|(i, n)| (n.as_str(), gain[(i / 3, i % 3)])).collect();
    let added = telemetry.added("mps-correlation", "layout", json!({}), &values);
    let spacecraft: Vec<Vector3<f64>> =
        (0..rows).map(|k| directions * noise(DT_S * k as f64) / m.spacecraft.mass_kg).collect();
    assert_test_masses_see(&added, &spacecraft, 1e-7);
}

#[test]
fn noise_effects_name_their_process() {
    let telemetry = Telemetry::new(3, &[]);
    for (id, instance, process) in [
        ("mps-noise", "sc.x", "thruster_force:sc.x"),
        ("torque-noise", "sc.z", "thruster_torque:sc.z"),
        ("is-noise", "tm1.y", "readout:tm1.y"),
    ] {
        let (_, linked) = telemetry.link(id, instance, json!({}), false).expect("linked");
        let c = &linked.coefficients[0];
        assert_eq!((c.noise.as_str(), c.initial, c.unit.as_str()), (process, 1.0, "1"));
        assert!(c.responses.is_empty() && linked.writes.is_empty());
    }
}

fn formula(acts_on: &str, expression: &str) -> Value {
    json!({"acts_on": acts_on, "expression": expression, "unit": "1", "range": [-10.0, 10.0]})
}

#[test]
fn a_formula_acts_on_the_named_channels() {
    let mut telemetry = Telemetry::new(50, &[("hk.a", "A")]);
    telemetry.fill("hk.a", |t| 1.0 + (0.7 * t).sin());
    telemetry.fill("sc.alpha_srf_rad_s2.z", |t| 1e-9 * t);
    let product: Vec<f64> =
        (0..50).map(|k| telemetry.row("hk.a")[k] * telemetry.row("sc.alpha_srf_rad_s2.z")[k]).collect();
    let times = |factor: f64| product.iter().map(|x| factor * x).collect::<Vec<f64>>();
    let added = |acts_on: &str| telemetry.added("formula", "mine", formula(acts_on, "hk.a * alpha.z"), &[("", 2.0)]);
    assert!(relative_difference(&added("tm2.force.y")["tm2.accel.y"], &times(2.0 / 1.96)) < 1e-14);
    assert!(relative_difference(&added("tm1.accel.z")["tm1.accel.z"], &times(2.0)) < 1e-14);
    let pushed: Vec<Vector3<f64>> = product.iter().map(|x| Vector3::x() * (2.0 * x / 1500.0)).collect();
    assert_test_masses_see(&added("sc.force.x"), &pushed, 1e-14);
    let inertia = Matrix3::new(800.0, 13.0, 10.0, 13.0, 800.0, 12.0, 10.0, 12.0, 1000.0);
    let turned: Vec<Vector3<f64>> =
        product.iter().map(|x| inertia.lu().solve(&(Vector3::y() * (2.0 * x))).expect("an inertia")).collect();
    assert!(relative_difference(&flat(&vectors(&added("sc.torque.y"), "sc.alpha", 50)), &flat(&turned)) < 1e-12);
    let seconds = telemetry.added("formula", "mine", formula("tm1.accel.x", "time_s"), &[("", 1.0)]);
    assert!((0..50).all(|k| (seconds["tm1.accel.x"][k] - DT_S * (k as f64 + 0.5)).abs() < 1e-9));
}

#[test]
fn an_invalid_formula_is_refused_with_its_position() {
    let mut telemetry = Telemetry::new(7000, &[("hk.battery_current_a", "A"), ("hk.zero", "1")]);
    telemetry.fill("hk.battery_current_a", |t| t + 1.0);
    let refused =
        |parameters: Value| telemetry.link("formula", "mine", parameters, false).map(drop).expect_err("refused");
    let message = refused(formula("tm1.force.x", "2 * hk.battery_curent_a"));
    let mark = "column 5: unknown name `hk.battery_curent_a`; the nearest: `hk.battery_current_a`";
    assert!(message.contains(mark) && message.contains("  2 * hk.battery_curent_a\n      ^"), "{message}");
    let elsewhere = refused(formula("tm1.push.x", "1"));
    assert!(elsewhere.contains("sc.torque.AXIS") && elsewhere.contains("of a test mass: tm1, tm2"), "{elsewhere}");
    assert!(refused(json!({"acts_on": "tm1.force.x", "expression": "1", "range": [0.0, 1.0]})).contains("`unit`"));
    let no_range = json!({"acts_on": "tm1.force.x", "expression": "1", "unit": "N"});
    assert!(refused(no_range).contains("`range`"));
    // A formula that is never finite is refused after ten minutes of data.
    let hopeless = formula("tm1.accel.x", "hk.battery_current_a / hk.zero");
    let (mut effect, linked) = telemetry.link("formula", "mine", hopeless, false).expect("linked");
    let rows = dragfree_engine::border::Rows {
        time_ns: &telemetry.time_ns,
        columns: linked.reads.iter().flatten().map(|r| &*telemetry.rows[r.available]).collect(),
    };
    // All columns belong to two tables with equal rows.
    let mut tables = Vec::new();
    let mut rest = rows.columns;
    for table in &linked.reads {
        let others = rest.split_off(table.len());
        tables.push(dragfree_engine::border::Rows { time_ns: rows.time_ns, columns: rest });
        rest = others;
    }
    let message = effect.process(&tables, i64::MAX).map(drop).expect_err("no value anywhere").to_string();
    assert!(message.contains("division by zero") && message.contains("6000 epochs"), "{message}");
}

/// Effects with state: id, instance, parameters, candidate.
fn effects_with_state() -> Vec<(&'static str, &'static str, Value, bool)> {
    let long = "lag(hk.a, 20) * derivative(hk.b) + integral(highpass(hk.a, 0.1)) * time_s";
    vec![
        ("thermal", "tm1.x", json!({"plus": "hk.a", "minus": "hk.b", "lag_s": 12.0}), false),
        ("thermal", "tm1.x", json!({}), true),
        ("slosh", "sc.x", json!({}), false),
        ("formula", "mine", formula("tm1.force.x", long), false),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(12))]
    /// Splitting the rows and saving the state in between leaves the output bit by bit the same.
    #[test]
    fn batches_and_saved_states_do_not_change_the_output(cut in 1_usize..2999, gap in 0_usize..900) {
        let mut telemetry = Telemetry::new(3000, &[("hk.a", "K"), ("hk.b", "K")]);
        let missing = move |t: f64| (100.0..100.0 + DT_S * gap as f64).contains(&t);
        telemetry.fill("hk.a", move |t| if missing(t) { f64::NAN } else { 290.0 + (0.1 * t).sin() });
        telemetry.fill("hk.b", |t| 290.0 + (0.17 * t).cos());
        telemetry.fill("used.mps_force_srf_n.x", move |t| if missing(t) { f64::NAN } else { 1e-6 * (0.3 * t).sin() });
        for (id, instance, parameters, candidate) in effects_with_state() {
            let link = || telemetry.link(id, instance, parameters.clone(), candidate).expect("linked");
            let (mut one, linked) = link();
            let whole = telemetry.process(&mut one, &linked, 0, 3000);
            let (mut first, _) = link();
            let mut parts = telemetry.process(&mut first, &linked, 0, cut);
            let (mut second, _) = link();
            let state = first.save().expect("a state");
            second.load(&state).expect("its state");
            prop_assert_eq!(second.save().expect("a state"), state);
            for (all, more) in parts.iter_mut().zip(telemetry.process(&mut second, &linked, cut, 3000)) {
                all.extend(more);
            }
            let bits = |all: &[Vec<f64>]| -> Vec<Vec<u64>> {
                all.iter().map(|c| c.iter().map(|x| x.to_bits()).collect()).collect()
            };
            prop_assert!(bits(&whole) == bits(&parts), "{} {}", id, candidate);
            prop_assert!(!whole.is_empty() && whole.iter().all(|c| c.iter().any(|x| x.is_finite())));
            let (mut third, _) = link();
            prop_assert!(third.load(b"something else").is_err());
        }
    }

    /// The parser returns a tree or an error for any bytes.
    #[test]
    fn no_bytes_make_a_formula_panic(bytes in prop::collection::vec(any::<u8>(), 0..400)) {
        dragfree_effects::formula::fuzz_formula(&bytes);
    }
}
