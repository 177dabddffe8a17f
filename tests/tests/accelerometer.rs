//! GRACE-FO through the whole program: real quiet data, and a simulated manoeuvre that determines the offset.

use std::fmt::Write as _;
use std::path::Path;

use dragfree_tests::{dragfree, fixture, json};
use serde_json::Value;

fn run(folder: &Path, files: &[std::path::PathBuf]) -> Value {
    let mut command = dragfree(folder);
    command.arg("run").arg(fixture("pipelines/accelerometer.toml")).args(files);
    json(command.args(["--archive", "archive", "--json", "-q"]), 0)
}

fn qp(product: &Value, axis: &str) -> (Option<f64>, Option<f64>) {
    let name = format!("com-offset.tm1.{axis}");
    let all = product["coefficients"].as_array().expect("coefficients");
    let c = all.iter().find(|c| c["name"] == name.as_str() && c["solution"] == "qp").expect("a QP solution");
    (c["value"].as_f64(), c["sigma"].as_f64())
}

/// Ten quiet seconds of real telemetry: the verdict is `weak` and names the directions.
#[test]
fn real_quiet_data_are_weak_in_named_directions() {
    let dir = tempfile::tempdir().expect("directory");
    let files = ["1A", "1B"].map(|l| fixture(&format!("gracefo/gracefo_{l}_2023-06-01_RL04.ascii.noLRI.tgz")));
    let product = run(dir.path(), &files);
    assert_eq!(product["verdict"], "weak", "{product:#}");
    let directions = product["weak_directions"].to_string();
    for axis in ["x", "y", "z"] {
        assert!(directions.contains(&format!("com-offset.tm1.{axis}")), "{directions}");
        // No σ, or one above a third of the box of the offset.
        let (_, sigma) = qp(&product, axis);
        assert!(sigma.is_none_or(|s| s > 5e-4 / 3.0), "{axis}: σ = {sigma:?} m");
    }
}

/// Normal deviates from a linear congruential generator and the polar method, reproducible for ever.
struct Noise(u64);

impl Noise {
    fn uniform(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 11) as f64 / (1_u64 << 53) as f64
    }

    fn normal(&mut self) -> f64 {
        loop {
            let (u, v) = (2.0 * self.uniform() - 1.0, 2.0 * self.uniform() - 1.0);
            let s = u * u + v * v;
            if s > 0.0 && s < 1.0 {
                return u * (-2.0 * s.ln() / s).sqrt();
            }
        }
    }
}

fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

fn header(rows: u32, variables: &[(&str, &str)], extra: &str) -> String {
    let mut text = format!(
        "header:\n  dimensions:\n    num_records: {rows}\n  global_attributes:\n    platform: GRACE C\n  \
         non-standard_attributes:\n    epoch_time: 2000-01-01T12:00:00.00\n  variables:\n",
    );
    for (name, unit) in variables {
        let conditional = name.contains("accl");
        let comment = if conditional && !extra.is_empty() { "next column, if prod_flag bit set" } else { "a column" };
        let _ = writeln!(text, "    - {name}:\n        comment: {comment}\n        units: \"{unit}\"");
        if *name == "prod_flag" {
            text.push_str(extra);
        }
    }
    text + "# End of YAML header\n"
}

/// Half an hour in which the magnetic torquers oscillate the spacecraft about three axes with different periods, with
/// the amplitudes of 1 mN m, as in the mission's calibrations. The proof mass is at `b`.
fn manoeuvre(folder: &Path, b: [f64; 3]) -> [std::path::PathBuf; 2] {
    // The accelerometer's clock is fast, as in the real files, so its epochs slip against the grid.
    const DT_US: u64 = 99_993;
    const DT_S: f64 = DT_US as f64 * 1e-6;
    const START_S: u64 = 738_849_600;
    let amplitude = [9e-6, 2e-6, 1.5e-6];
    let turn_rate = [10.0, 12.0, 15.0].map(|period_s| std::f64::consts::TAU / period_s);
    let bias_linear = [-2.8e-7, -1.06e-5, -1.8e-7];
    let bias_angular = [-7.8e-4, 1.3e-5, 1.2e-4];
    let mut noise = Noise(1);
    let mut acc = header(
        18_000,
        &[
            ("rcvtime_intg", "seconds"),
            ("rcvtime_frac", "microseconds"),
            ("time_ref", "char"),
            ("GRACEFO_id", "char"),
            ("qualflg", ""),
            ("prod_flag", ""),
            ("lin_accl_x", "m/s2"),
            ("lin_accl_y", "m/s2"),
            ("lin_accl_z", "m/s2"),
            ("ang_accl_x", "rad/s2"),
            ("ang_accl_y", "rad/s2"),
            ("ang_accl_z", "rad/s2"),
        ],
        "        flag_meanings:\n          - bit 0 = lin_accl_x\n          - bit 1 = lin_accl_y\n          - bit 2 = lin_accl_z\n          \
         - bit 3 = ang_accl_x\n          - bit 4 = ang_accl_y\n          - bit 5 = ang_accl_z\n",
    );
    let mut sca = header(
        1_800,
        &[
            ("gps_time", "second"),
            ("GRACEFO_id", "char"),
            ("sca_id", ""),
            ("quatangle", ""),
            ("quaticoeff", ""),
            ("quatjcoeff", ""),
            ("quatkcoeff", ""),
            ("qual_rss", ""),
            ("qualflg", ""),
        ],
        "",
    );
    let mut q = [1.0, 0.0, 0.0, 0.0_f64];
    for k in 0..18_000_u64 {
        let t = k as f64 * DT_S;
        let time_us = START_S * 1_000_000 + k * DT_US;
        let alpha = [0, 1, 2].map(|i| amplitude[i] * (turn_rate[i] * t).sin());
        let rate = |i: usize, t: f64| -amplitude[i] / turn_rate[i] * (turn_rate[i] * t).cos();
        let omega = [rate(0, t), 1.105e-3 + rate(1, t), rate(2, t)];
        let (euler, inner) = (cross(alpha, b), cross(omega, cross(omega, b)));
        // White noise, 3e-10 m s⁻²/√Hz and 3e-8 rad s⁻²/√Hz, as on the quiet axes of the real file; drag varies slowly.
        let drag = 3e-8 * (t / 900.0).sin();
        let linear = [0, 1, 2].map(|i| {
            bias_linear[i]
                + euler[i]
                + inner[i]
                + 3e-10 * (0.5 / DT_S).sqrt() * noise.normal()
                + if i == 0 { drag } else { 0.0 }
        });
        let angular = [0, 1, 2].map(|i| bias_angular[i] + alpha[i] + 3e-8 * (0.5 / DT_S).sqrt() * noise.normal());
        // The accelerometer's x, y, z are s_2, s_3, s_1.
        let _ = writeln!(
            acc,
            "{} {} R C 00000000 00000000000000000000000000111111 {:e} {:e} {:e} {:e} {:e} {:e}",
            time_us / 1_000_000,
            time_us % 1_000_000,
            linear[1],
            linear[2],
            linear[0],
            angular[1],
            angular[2],
            angular[0]
        );
        if k % 10 == 0 {
            let (s, us) = (time_us / 1_000_000, time_us % 1_000_000);
            let _ = writeln!(sca, "{s}.{us:06} C 7 {} {} {} {} 1e-6 00000000", q[0], q[1], q[2], q[3]);
        }
        // q ← q ⊗ exp(ω dt / 2) with the rate in the middle of the step; |ω| dt is 1e-4, its square is below the noise.
        let h = [rate(0, t + 0.5 * DT_S), 1.105e-3 + rate(1, t + 0.5 * DT_S), rate(2, t + 0.5 * DT_S)]
            .map(|w| 0.5 * DT_S * w);
        let p = q;
        q = [
            p[0] - p[1] * h[0] - p[2] * h[1] - p[3] * h[2],
            p[1] + p[0] * h[0] + p[2] * h[2] - p[3] * h[1],
            p[2] + p[0] * h[1] + p[3] * h[0] - p[1] * h[2],
            p[3] + p[0] * h[2] + p[1] * h[1] - p[2] * h[0],
        ];
        let norm = q.iter().map(|x| x * x).sum::<f64>().sqrt();
        q = q.map(|x| x / norm);
    }
    [("ACC1A", acc), ("SCA1B", sca)].map(|(product, text)| {
        let path = folder.join(format!("{product}_2023-06-01_C_04.txt"));
        std::fs::write(&path, text).expect("write");
        path
    })
}

/// 4σ on three axes: false alarm 1 in 5,000. A wrong sign or swapped axes would be off by 20σ.
#[test]
fn a_calibration_manoeuvre_determines_the_offset() {
    let dir = tempfile::tempdir().expect("directory");
    let b = [1.2e-4, -2.0e-4, 2.6e-4];
    let product = run(dir.path(), &manoeuvre(dir.path(), b));
    assert_ne!(product["verdict"], "weak", "{product:#}");
    for (axis, truth) in ["x", "y", "z"].iter().zip(b) {
        let (Some(value), Some(sigma)) = qp(&product, axis) else { panic!("{axis} has no value: {product:#}") };
        assert!((value - truth).abs() < 4.0 * sigma, "{axis}: {value:e} ± {sigma:e}, truth {truth:e}");
        assert!(sigma < truth.abs() / 5.0, "{axis}: σ = {sigma:e}");
    }
}
