//! Every effect against the same simulation without it. The random numbers are the same, so the difference is the
//! effect's alone: it is compared with what physics says, sign and size, worked out here from the states.

use dragfree_physics::attitude::rotation_vector;
use dragfree_physics::mission::Mission;
use dragfree_physics::spectrum::welch;
use dragfree_sim::effects::{EffectError, EffectRequest, catalogue};
use dragfree_sim::housekeeping::{Housekeeping, channels};
use dragfree_sim::interior::Interior;
use dragfree_sim::plant::State;
use dragfree_sim::simulator::{Epoch, Settings, Simulator};
use nalgebra::{Matrix3, Matrix6, Vector3, Vector6};
use rand::SeedableRng;
use rand_xoshiro::Xoshiro256PlusPlus;
use std::f64::consts::TAU;

const DT_S: f64 = 0.1;

fn taiji() -> Mission {
    let value: serde_json::Value = toml::from_str(include_str!("../../fixtures/missions/taiji.toml")).unwrap();
    Mission::from_json(&value.to_string()).unwrap()
}

fn names() -> Vec<String> {
    taiji().test_mass.keys().cloned().collect()
}

fn parse(text: &str) -> Result<EffectRequest, EffectError> {
    EffectRequest::parse(text, &names())
}

fn settings(effects: &[&str], settle_s: f64) -> Settings {
    Settings {
        seed: 11,
        start_ns: 2_051_222_400_000_000_000,
        settle_s,
        com_offset_srf_m: Vector3::new(0.001, 0.0, 0.0),
        stiffness_error: 0.2,
        manoeuvres: Vec::new(),
        effects: effects.iter().map(|text| parse(text).unwrap()).collect(),
    }
}

/// One epoch: the state before it, the inside at it, and how an effect changes it.
struct Row {
    epoch: Epoch,
    plain: Epoch,
    state: State,
    inside: Interior,
    elapsed_s: f64,
    /// Acceleration of each test mass that the effect adds, ORF, m/s².
    accel_orf_m_s2: [Vector3<f64>; 2],
    /// The same of the spacecraft, SRF, m/s².
    sc_accel_srf_m_s2: Vector3<f64>,
    /// Angular acceleration of the spacecraft that it adds, SRF, rad/s².
    alpha_srf_rad_s2: Vector3<f64>,
    /// The same of each test mass, rad/s².
    tm_alpha_rad_s2: [Vector3<f64>; 2],
}

/// A simulation with effects and, beside it, one without that is set into its state before every epoch: the two epochs
/// differ by what the effects do in that very epoch, the same random numbers included.
struct Twins {
    with: Simulator,
    plain: Simulator,
}

impl Twins {
    fn new(effects: &[&str], settle_s: f64) -> Self {
        let mission = taiji();
        Self {
            with: Simulator::new(&mission, settings(effects, settle_s)).unwrap(),
            plain: Simulator::new(&mission, settings(&[], 0.0)).unwrap(),
        }
    }

    fn run(&mut self, epochs: usize) {
        for _ in 0..epochs {
            self.with.step().unwrap();
        }
    }

    fn row(&mut self) -> Row {
        let mut saved: serde_json::Value = serde_json::from_slice(&self.with.save().unwrap()).unwrap();
        saved["effects"] = serde_json::json!([]);
        self.plain.load(&serde_json::to_vec(&saved).unwrap()).unwrap();
        let (state, inside) = (*self.with.state(), self.with.inside().clone());
        let elapsed_s = self.with.index() as f64 * DT_S;
        let (epoch, plain) = (self.with.step().unwrap(), self.plain.step().unwrap());
        let (a, b) = (self.with.state(), self.plain.state());
        Row {
            state,
            inside,
            elapsed_s,
            accel_orf_m_s2: [0, 1].map(|i| (a.tm[i].v_orf_m_s - b.tm[i].v_orf_m_s) / DT_S),
            sc_accel_srf_m_s2: epoch.truth.nongrav_srf_m_s2 - plain.truth.nongrav_srf_m_s2,
            alpha_srf_rad_s2: (a.omega_srf_rad_s - b.omega_srf_rad_s) / DT_S,
            tm_alpha_rad_s2: [0, 1].map(|i| (a.tm[i].omega_mrf_rad_s - b.tm[i].omega_mrf_rad_s) / DT_S),
            epoch,
            plain,
        }
    }

    fn rows(&mut self, count: usize) -> Vec<Row> {
        (0..count).map(|_| self.row()).collect()
    }
}

/// Settled, then so many epochs.
fn settled(effect: &str, count: usize) -> Vec<Row> {
    Twins::new(&[effect], 600.0).rows(count)
}

const SC_KG: f64 = 1500.0;
const TM_KG: f64 = 1.96;
const TM_INERTIA: f64 = 6.913e-4;

fn sc_inertia() -> Matrix3<f64> {
    Matrix3::new(800.0, 13.0, 10.0, 13.0, 800.0, 12.0, 10.0, 12.0, 1000.0)
}

fn dcm(tm: usize) -> Matrix3<f64> {
    let (s, c) = if tm == 0 { (0.5, 0.75_f64.sqrt()) } else { (-0.5, 0.75_f64.sqrt()) };
    Matrix3::new(c, s, 0.0, -s, c, 0.0, 0.0, 0.0, 1.0)
}

fn offset_srf_m(tm: usize) -> Vector3<f64> {
    Vector3::new(0.001, if tm == 0 { 0.18 } else { -0.18 }, 0.0)
}

fn axis(i: usize) -> Vector3<f64> {
    Vector3::from_fn(|j, _| f64::from(i == j))
}

fn near(found: &Vector3<f64>, want: &Vector3<f64>, relative: f64, what: &str) {
    assert!(want.norm() > 0.0, "{what}: nothing to compare with");
    assert!((found - want).norm() <= relative * want.norm(), "{what}: found {found}, wanted {want}");
}

/// What extra loads do to first order: `F` and `M` on the spacecraft, `F_E` on the test masses (ORF) with their
/// reaction.
fn answers(row: &Row, force: Vector3<f64>, torque: Vector3<f64>, electric: [Vector3<f64>; 2], what: &str) {
    let (mut net, mut moment) = (force, torque);
    for i in 0..2 {
        let f = dcm(i).transpose() * electric[i];
        net -= f;
        moment -= offset_srf_m(i).cross(&f);
    }
    let alpha = sc_inertia().try_inverse().unwrap() * moment;
    if moment.norm() > 0.0 {
        near(&row.alpha_srf_rad_s2, &alpha, 1e-6, what);
    }
    for i in 0..2 {
        let rho = offset_srf_m(i) + dcm(i).transpose() * row.state.tm[i].r_orf_m;
        let want = electric[i] / TM_KG - dcm(i) * (net / SC_KG + alpha.cross(&rho));
        near(&row.accel_orf_m_s2[i], &want, 1e-5, what);
    }
}

#[test]
fn stiffness_pulls_by_the_displacement() {
    for row in settled("stiffness:tm2.y=2e-5", 20) {
        let tm = &row.state.tm[1];
        // The mean over the sample sees its middle.
        let want = axis(1) * 2e-5 * (tm.r_orf_m.y + 0.5 * DT_S * tm.v_orf_m_s.y);
        near(&row.accel_orf_m_s2[1], &want, 1e-6, "tm2");
        assert!(row.accel_orf_m_s2[0].norm() < 1e-6 * want.norm(), "tm1 feels nothing");
    }
}

#[test]
fn cross_stiffness_couples_angle_and_displacement_both_ways() {
    for row in settled("cross-stiffness:tm1.y=3e-7", 20) {
        let tm = &row.state.tm[0];
        let angle = rotation_vector(&tm.q_mrf_from_orf);
        // Rotation within the sample counts for 1e-3 of the angle.
        near(&row.accel_orf_m_s2[0], &(axis(1) * 3e-7 * angle.y), 1e-2, "force");
        let middle_m = tm.r_orf_m.y + 0.5 * DT_S * tm.v_orf_m_s.y;
        near(&row.tm_alpha_rad_s2[0], &(axis(1) * 3e-7 * TM_KG / TM_INERTIA * middle_m), 1e-5, "torque");
    }
}

#[test]
fn actuators_do_more_or_else_than_commanded() {
    let none = [Vector3::zeros(); 2];
    for row in settled("mps-gain:sc.y=0.07", 10) {
        let force = axis(1) * 0.07 * row.epoch.command.mps_force_srf_n.y;
        answers(&row, force, Vector3::zeros(), none, "mps-gain");
    }
    for row in settled("mps-tilt:sc.z=0.04", 10) {
        let force = axis(2).cross(&row.epoch.command.mps_force_srf_n) * 0.04;
        answers(&row, force, Vector3::zeros(), none, "mps-tilt");
    }
    for row in settled("torque-gain:sc.x=0.05", 10) {
        let torque = axis(0) * 0.05 * row.epoch.command.mps_torque_srf_nm.x;
        answers(&row, Vector3::zeros(), torque, none, "torque-gain");
    }
    for row in settled("es-gain:tm1.z=-0.1", 10) {
        let electric = [axis(2) * -0.1 * row.epoch.command.tm[0].force_orf_n.z, Vector3::zeros()];
        answers(&row, Vector3::zeros(), Vector3::zeros(), electric, "es-gain");
    }
    for row in settled("es-crosstalk:tm2.y-x=0.03", 10) {
        let electric = [Vector3::zeros(), axis(0) * 0.03 * row.epoch.command.tm[1].force_orf_n.y];
        answers(&row, Vector3::zeros(), Vector3::zeros(), electric, "es-crosstalk");
    }
}

/// The loop is closed. Electrodes carry the difference of z between the test masses, `F_1 = −F_2`, and thrust the
/// common part: `F_2 (1 + g) − F_1 = m (g_1 − g_2)`, so that half of one gain missing asks for 2/(2 + g) = 4/3 of the
/// force.
#[test]
fn the_controller_answers() {
    let mean = |effects: &[&str]| {
        let mut simulator = Simulator::new(&taiji(), settings(effects, 3000.0)).unwrap();
        let n = 6000;
        (0..n).map(|_| simulator.step().unwrap().command.tm[1].force_orf_n.z).sum::<f64>() / f64::from(n)
    };
    let ratio = mean(&["es-gain:tm2.z=-0.5"]) / mean(&[]);
    assert!((ratio - 4.0 / 3.0).abs() < 0.01, "{ratio}");
}

/// The test's own lag, from the first sample on.
#[test]
fn thermal_force_follows_the_difference_of_two_faces_behind_its_lag() {
    let mut twins = Twins::new(&["thermal:tm1.z=4e-11,lag_s=30"], 0.0);
    let mut lagged: Option<f64> = None;
    for k in 0..3000 {
        let across_k = twins.with.inside().across_k[0][2];
        let value = lagged.get_or_insert(across_k);
        *value += (across_k - *value) * (1.0 - (-DT_S / 30.0_f64).exp());
        if k % 100 == 0 {
            let row = twins.row();
            near(&row.accel_orf_m_s2[0], &(axis(2) * 4e-11 * lagged.unwrap()), 1e-6, "thermal");
        } else {
            twins.run(1);
        }
    }
    // It did lag: the difference had moved on.
    let now_k = twins.with.inside().across_k[0][2];
    assert!((now_k - lagged.unwrap()).abs() > 1e-7, "{now_k}");
}

#[test]
fn forces_that_no_bundled_effect_covers() {
    let mut twins = Twins::new(&["current-force:tm2.x=1e-13,lag_s=0"], 60.0);
    let row = twins.row();
    near(&row.accel_orf_m_s2[1], &(axis(0) * 1e-13 * row.inside.battery_a.powi(2)), 1e-6, "current");
    let mut twins = Twins::new(&["product-force:tm1.y=1e-12"], 60.0);
    let row = twins.row();
    let want = 1e-12 * (row.inside.battery_a - 2.1) * (row.inside.structure_k - 296.5);
    near(&row.accel_orf_m_s2[0], &(axis(1) * want), 1e-6, "product");
    // About s_3 the frame of a test mass is turned, so that x tells the frames apart and z does not.
    for (place, along) in [("tm2.x", 0), ("tm2.z", 2)] {
        let mut twins = Twins::new(&[&format!("field-force:{place}=0.5")], 60.0);
        let row = twins.row();
        let outside = dcm(1) * Vector3::from(row.inside.interplanetary_t);
        let field_t = outside[along] + row.inside.units_field[1] * dragfree_sim::interior::FIELD_T[1][along];
        near(&row.accel_orf_m_s2[1], &(axis(along) * 0.5 * field_t.powi(2)), 1e-6, place);
    }
}

/// `χ/(2 μ0 ρ) ∇B²` by differences of the field itself, and `∇(m·B)/m_m`.
#[test]
fn magnetic_force_is_the_gradient_of_the_energy() {
    use dragfree_sim::interior::{FIELD_T, GRADIENT_T_M};
    for row in settled("magnetic:tm2=-3e-5,moment_a_m2=1e-8", 5) {
        let units = row.inside.units_field[1];
        let [xx, yy, xy, xz, yz] = GRADIENT_T_M[1];
        let g = Matrix3::new(xx, xy, xz, xy, yy, yz, xz, yz, -xx - yy);
        let outside = dcm(1) * Vector3::from(row.inside.interplanetary_t);
        let field = |r: &Vector3<f64>| outside + (Vector3::from(FIELD_T[1]) + g * r) * units;
        let energy = |r: &Vector3<f64>| {
            let b = field(r);
            -3e-5 / (2.0 * 4e-7 * std::f64::consts::PI * 2e4) * b.norm_squared() + 1e-8 * b.x / TM_KG
        };
        let h_m = 1e-3;
        let want = Vector3::from_fn(|i, _| (energy(&(axis(i) * h_m)) - energy(&(axis(i) * -h_m))) / (2.0 * h_m));
        near(&row.accel_orf_m_s2[1], &want, 1e-5, "magnetic");
    }
}

/// A million elementary charges and 20 mV: 1.4e-14 m/s², as on LISA Pathfinder.
#[test]
fn charge_pushes_along_x() {
    let row = settled("charge:tm1=0.02", 1).remove(0);
    let charges = row.inside.charge_c[0] / 1.602_176_634e-19;
    near(&row.accel_orf_m_s2[0], &(axis(0) * charges / 1e6 * 1.391e-14), 1e-3, "charge");
    assert!(charges > 0.0 && charges < 7e5, "{charges}");
}

/// Slug and spacecraft as two bodies, integrated with thirty steps to a sample.
#[test]
fn sloshing_propellant_pushes_back() {
    let (slug_kg, f0_hz, zeta) = (0.02 * SC_KG, 0.2, 0.03);
    let omega = TAU * f0_hz;
    let mut twins = Twins::new(&["slosh:sc.y=0.02,f0_hz=0.2,zeta=0.03"], 0.0);
    let rates = |x: f64, v: f64, force_n: f64| {
        let spring_n = slug_kg * (omega * omega * x + 2.0 * zeta * omega * v);
        let accel = (force_n + spring_n) / (SC_KG - slug_kg);
        (v, -spring_n / slug_kg - accel, accel)
    };
    let (mut x, mut v, mut swing) = (0.0_f64, 0.0, 0.0_f64);
    for row in twins.rows(600) {
        let force_n = SC_KG * row.plain.truth.nongrav_srf_m_s2.y;
        let (thin, mut mean) = (30, 0.0);
        let h = DT_S / f64::from(thin);
        for _ in 0..thin {
            let (vx, vv, _) = rates(x, v, force_n);
            let (mx, mv, accel) = rates(x + 0.5 * h * vx, v + 0.5 * h * vv, force_n);
            (x, v) = (x + h * mx, v + h * mv);
            mean += accel / f64::from(thin);
        }
        swing = swing.max(x.abs());
        let found = row.epoch.truth.nongrav_srf_m_s2.y;
        // The midpoint rule's own error, (ω h)²/24 of what swings.
        assert!((found - mean).abs() < 1e-4 * mean.abs().max(1e-9), "{found} {mean}");
    }
    assert!(swing > 1e-10, "it swings: {swing} m");
}

#[test]
fn sunlight_pushes_harder_and_elsewhere() {
    let arm = Vector3::new(0.1, 0.0, 0.6);
    for row in settled("solar-pressure:sc=0.08,arm_y_m=0.05", 5) {
        let more = row.sc_accel_srf_m_s2 * SC_KG;
        assert!((more.norm() / (0.08 * 6.3513e-5) - 1.0).abs() < 1e-3, "{more}");
        // The ephemeris is that of the last minute and 50 km off.
        let sun = Vector3::new(0.0, 0.0, -1.0);
        assert!(more.dot(&sun) > 0.8 * more.norm(), "away from the Sun: {more}");
        let torque = arm.cross(&more) + Vector3::new(0.0, 0.05, 0.0).cross(&(more * 1.08 / 0.08));
        answers(&row, more, torque, [Vector3::zeros(); 2], "solar-pressure");
    }
}

#[test]
fn a_micrometeoroid_gives_its_momentum_at_once() {
    let mut twins = Twins::new(&["impulse:sc.z=2e-5,at_s=0.55,arm_x_m=0.7,arm_y_m=-0.4,arm_z_m=0.1"], 60.0);
    let rows = twins.rows(12);
    for (k, row) in rows.iter().enumerate() {
        if k == 5 {
            let force = axis(2) * 2e-4;
            answers(row, force, Vector3::new(0.7, -0.4, 0.1).cross(&force), [Vector3::zeros(); 2], "hit");
        } else {
            assert_eq!((row.sc_accel_srf_m_s2.norm(), row.alpha_srf_rad_s2.norm()), (0.0, 0.0), "sample {k}");
        }
    }
}

/// The momentum of a glitch, and when it is half given: `(e^{−t/τ1} − e^{−t/τ2})/(τ1 − τ2)` summed in thin steps.
#[test]
fn a_glitch_rises_and_decays() {
    let mut twins = Twins::new(&["impulse:tm2.x=1e-9,at_s=1,rise_s=0.5,decay_s=2"], 60.0);
    let mut given = 0.0;
    for row in twins.rows(300) {
        let found = row.accel_orf_m_s2[1].x * TM_KG * DT_S;
        let thin = 100;
        let part = |t: f64| if t < 0.0 { 0.0 } else { ((-t / 2.0).exp() - (-t / 0.5).exp()) / 1.5 };
        let middle = |j: i32| row.elapsed_s - 1.0 + (f64::from(j) + 0.5) * DT_S / f64::from(thin);
        let want: f64 = (0..thin).map(|j| 1e-9 * part(middle(j)) * DT_S / f64::from(thin)).sum();
        assert!((found - want).abs() < 1e-15, "{} s: {found} {want}", row.elapsed_s);
        given += found;
    }
    // 29 s are 14 decay times.
    assert!((given / 1e-9 - 1.0).abs() < 1e-5, "{given}");
}

#[test]
fn the_antenna_turns_the_spacecraft_and_back() {
    let mut twins = Twins::new(&["impulse:sc.theta=3e-6,pulse_s=2"], 60.0);
    for sign in [1.0, -1.0] {
        while twins.with.inside().antenna_moves != (sign > 0.0) {
            twins.run(1);
        }
        let turned: Vector3<f64> = twins.rows(40).iter().map(|row| row.alpha_srf_rad_s2 * DT_S).sum();
        near(&(sc_inertia() * turned), &(axis(1) * 3e-6 * sign), 1e-6, "antenna");
    }
}

/// `b + ḃ t + κ ΔT + β Δm`, and the test masses feel `−Ω Δb`; their displacement shrinks as the housings move.
#[test]
fn the_centre_of_mass_wanders() {
    let effect = "offset-drift:sc.x=5e-6,kappa_m_k=1e-3,beta_m_kg=1";
    let mut twins = Twins::new(&[effect], 0.0);
    let inside = twins.with.inside().clone();
    let (first_k, first_kg) = (inside.structure_k, inside.tank_kg);
    twins.run(60_000);
    for row in twins.rows(5) {
        // Between the last two seconds, a line.
        let part = row.elapsed_s - (row.elapsed_s + 1e-6).floor();
        let between = |a: f64, b: f64| a + part * (b - a);
        let warmer = between(row.inside.structure_before_k, row.inside.structure_k) - first_k;
        let spent = first_kg - between(row.inside.tank_before_kg, row.inside.tank_kg);
        assert!(warmer.abs() > 1e-4 && spent > 1e-4, "{warmer} K, {spent} kg");
        let drift = axis(0) * (5e-6 * row.elapsed_s + 1e-3 * warmer + spent);
        let alpha = row.epoch.truth.alpha_srf_rad_s2;
        for i in 0..2 {
            let moved = row.epoch.truth.offset_orf_m[i] - row.plain.truth.offset_orf_m[i];
            near(&moved, &(dcm(i) * drift), 1e-9, "offset");
            // The electrodes' longer arms turn the spacecraft a little more.
            let want = dcm(i) * -(alpha.cross(&drift) + row.alpha_srf_rad_s2.cross(&offset_srf_m(i)));
            near(&row.accel_orf_m_s2[i], &want, 1e-3, "Euler term");
        }
    }
    let before = twins.with.state().tm[0];
    let row = twins.row();
    // The next sample brings 5e-7 m (and its jerk) towards −x of both housings, on top of the motion itself.
    let own = row.plain.truth.r_orf_m[0] + before.v_orf_m_s * DT_S - twins.with.state().tm[0].r_orf_m;
    near(&own, &(dcm(0) * axis(0) * 5e-7), 0.2, "displacement");
}

#[test]
fn the_optical_frame_opens() {
    let mut twins = Twins::new(&["opening-angle:tm1=0.01,rate_rad_s=1e-6"], 0.0);
    twins.run(10_000);
    let row = twins.row();
    let (s, c) = (0.01 + 1e-6 * row.elapsed_s + std::f64::consts::FRAC_PI_6).sin_cos();
    let turned = Matrix3::new(c, s, 0.0, -s, c, 0.0, 0.0, 0.0, 1.0);
    near(&row.epoch.truth.offset_orf_m[0], &(turned * offset_srf_m(0)), 1e-12, "offset in ORF_1");
    near(&row.epoch.truth.offset_orf_m[1], &(dcm(1) * offset_srf_m(1)), 1e-12, "offset in ORF_2");

    // With the telescopes: half of what the constellation opens, to either side.
    for (tm, sign) in [(0, 0.5), (1, -0.5)] {
        let mut twins = Twins::new(&[&format!("opening-angle:tm{}=0,follow=1", tm + 1)], 0.0);
        let first_rad = twins.with.inside().opening_rad;
        twins.run(20_000);
        let row = twins.row();
        let opened_rad = row.inside.opening_rad - first_rad;
        assert!(opened_rad.abs() > 1e-10, "{opened_rad}");
        let (s, c) = (sign * opened_rad).sin_cos();
        let turned = Matrix3::new(c, s, 0.0, -s, c, 0.0, 0.0, 0.0, 1.0) * dcm(tm) * offset_srf_m(tm);
        let (found, own) = (row.epoch.truth.offset_orf_m[tm], dcm(tm) * offset_srf_m(tm));
        near(&(found - own), &(turned - own), 1e-5, "follows");
    }
}

#[test]
fn capacitive_readout_scales_and_mixes() {
    for row in settled("is-scale:tm1.y=0.05", 5) {
        let shown = row.epoch.measured.tm[0].is_r_orf_m - row.plain.measured.tm[0].is_r_orf_m;
        near(&shown, &(axis(1) * 0.05 * row.state.tm[0].r_orf_m.y), 1e-6, "scale");
    }
    for row in settled("is-crosstalk:tm2.y-z=-0.1", 5) {
        let shown = row.epoch.measured.tm[1].is_r_orf_m - row.plain.measured.tm[1].is_r_orf_m;
        near(&shown, &(axis(2) * -0.1 * row.state.tm[1].r_orf_m.y), 1e-6, "cross-talk");
    }
}

#[test]
fn tilt_shows_as_length() {
    for row in settled("tilt-to-length:tm2=2e-3,psi_m_rad=-1e-3", 5) {
        let angle = rotation_vector(&row.state.tm[1].q_mrf_from_orf);
        let shown = row.epoch.measured.tm[1].ifo_orf_m.x - row.plain.measured.tm[1].ifo_orf_m.x;
        let want = 2e-3 * angle.y - 1e-3 * angle.z;
        assert!((shown - want).abs() < 1e-6 * want.abs(), "{shown} {want}");
        assert_eq!(row.epoch.measured.tm[1].is_r_orf_m, row.plain.measured.tm[1].is_r_orf_m);
    }
}

/// What was true 0.23 s before: two whole samples, and 0.03 s of one with its constant acceleration.
#[test]
fn a_late_instrument_shows_the_past() {
    for instrument in ["is", "ifo", "dws"] {
        let rows = settled(&format!("time-offset:{instrument}=0.23"), 10);
        for k in 3..10 {
            let (now, late, after) = (&rows[k], &rows[k - 3], &rows[k - 2]);
            let s = 0.07;
            let past = |i: usize| {
                let (a, b) = (&late.state.tm[i], &after.state.tm[i]);
                a.r_orf_m + a.v_orf_m_s * s + (b.v_orf_m_s - a.v_orf_m_s) / DT_S * (0.5 * s * s)
            };
            let angle = |row: &Row, i: usize| rotation_vector(&row.state.tm[i].q_mrf_from_orf);
            let turned_by = |a: Vector3<f64>, b: Vector3<f64>, alpha: Vector3<f64>| {
                a + (b - a) * (s / DT_S) - alpha * (0.5 * s * (DT_S - s))
            };
            let alpha_sc = (after.state.omega_srf_rad_s - late.state.omega_srf_rad_s) / DT_S;
            let alpha = |i: usize| {
                let [a, b] = [after, late].map(|row| row.state.tm[i].omega_mrf_rad_s);
                (a - b) / DT_S - dcm(i) * alpha_sc
            };
            let (measured, unchanged) = (&now.epoch.measured, &now.plain.measured);
            for (i, (found, plain)) in measured.tm.iter().zip(&unchanged.tm).enumerate() {
                let moved = past(i) - now.state.tm[i].r_orf_m;
                let turned = turned_by(angle(late, i), angle(after, i), alpha(i)) - angle(now, i);
                if instrument == "is" {
                    near(&(found.is_r_orf_m - plain.is_r_orf_m), &moved, 1e-4, "is");
                    near(&(found.is_att_orf_rad - plain.is_att_orf_rad), &turned, 1e-3, "is angles");
                } else {
                    assert_eq!(found.is_r_orf_m, plain.is_r_orf_m);
                }
                let x = found.ifo_orf_m.x - plain.ifo_orf_m.x;
                let want = if instrument == "ifo" { moved.x } else { 0.0 };
                assert!((x - want).abs() <= 1e-4 * want.abs(), "ifo: {x} {want}");
                for j in 0..2 {
                    let shown = found.dws_orf_rad[j] - plain.dws_orf_rad[j];
                    let want = if instrument == "dws" { turned[j + 1] } else { 0.0 };
                    assert!((shown - want).abs() <= 1e-3 * turned.norm(), "dws: {shown} {want}");
                }
            }
            let sc = measured.dws_sc_crf_rad - unchanged.dws_sc_crf_rad;
            let turned =
                turned_by(late.state.sc_crf_rad(), after.state.sc_crf_rad(), alpha_sc) - now.state.sc_crf_rad();
            if instrument == "dws" {
                near(&sc, &turned, 1e-3, "attitude");
            } else {
                assert_eq!(sc, Vector3::zeros());
            }
        }
    }
}

/// Excess power of three times the mission's for twice the ASD, each band within 4.5σ (false alarm 7e-6), and the twin
/// that claims 5 % more is caught. The excess is what differs between two simulations in the same state.
#[test]
fn noise_grows_by_the_square() {
    let series = |effect: &str, of: fn(&Row) -> f64| -> Vec<f64> {
        Twins::new(&[effect], 0.0).rows(20_000).iter().map(of).collect()
    };
    let ratio = |x: &[f64], band: std::ops::Range<f64>, psd: f64| {
        welch(x, 1.0 / DT_S, 512).unwrap().ratio(band, |_| psd).unwrap()
    };
    let force = series("mps-noise:sc.y=2", |row| row.sc_accel_srf_m_s2.y * SC_KG);
    let torque = series("torque-noise:sc.z=2", |row| (sc_inertia() * row.alpha_srf_rad_s2).z);
    let shown =
        series("is-noise:tm2.z=2", |row| row.epoch.measured.tm[1].is_r_orf_m.z - row.plain.measured.tm[1].is_r_orf_m.z);
    for (series, base, what) in [(force, 1e-14, "force"), (torque, 1e-14, "torque"), (shown, 1.8e-9_f64.powi(2), "is")]
    {
        for band in [0.1..0.5, 0.5..4.9] {
            let found = ratio(&series, band.clone(), 3.0 * base);
            assert!((found.value - 1.0).abs() < 4.5 * found.sigma, "{what} {band:?}: {found:?}");
        }
        let wrong = ratio(&series, 0.1..4.9, 3.0 * 1.1025 * base);
        assert!((wrong.value - 1.0).abs() > 4.5 * wrong.sigma, "{what}: 5 % would be seen: {wrong:?}");
    }
}

/// A line alone: `k = 1`, amplitude 0.1 √Hz of 1e-7 N/√Hz.
#[test]
fn a_line_has_its_frequency_and_amplitude() {
    let mut twins = Twins::new(&["mps-noise:sc.x=1,line_hz=0.5"], 0.0);
    let rows = twins.rows(2000);
    let (mut cosine, mut sine) = (0.0, 0.0);
    for row in &rows {
        let force = row.sc_accel_srf_m_s2.x * SC_KG;
        let phase = TAU * 0.5 * (row.elapsed_s + 0.5 * DT_S);
        (cosine, sine) = (cosine + force * phase.cos() / 1000.0, sine + force * phase.sin() / 1000.0);
    }
    let amplitude_n = cosine.hypot(sine);
    assert!((amplitude_n / 1e-8 - 1.0).abs() < 1e-6, "{amplitude_n}");
    let power: f64 = rows.iter().map(|row| (row.sc_accel_srf_m_s2.x * SC_KG).powi(2)).sum::<f64>() / 2000.0;
    assert!((power / (0.5e-16) - 1.0).abs() < 1e-6, "nothing but the line: {power}");
}

/// Covariance of force and torque against `Σ S (d, r×d)(d, r×d)ᵀ` of six units, worked out here from where they sit;
/// the other simulation's noise along the axes, 1e-7 each, differs with it and so adds to the diagonal. Each number
/// within 4.5σ (false alarm 7e-6), and the twins whose force and torque do not belong together, or whose noise along
/// the axes goes on in both, are caught.
#[test]
fn noise_of_a_thruster_pushes_and_turns_at_once() {
    let asd_n_rthz = 1e-7_f64;
    let rows = Twins::new(&["mps-correlation:layout=1e-7"], 0.0).rows(20_000);
    let mut units = Matrix6::<f64>::zeros();
    for (azimuth_deg, side) in [60.0, 180.0, 300.0_f64].into_iter().flat_map(|a| [(a, 1.0), (a, -1.0)]) {
        let (out, up) = (Vector3::new(azimuth_deg.to_radians().cos(), azimuth_deg.to_radians().sin(), 0.0), axis(2));
        let tilt = 35.0_f64.to_radians();
        let direction = up.cross(&out) * (side * tilt.cos()) + up * tilt.sin();
        let torque = (out * 1.5 + up * 0.35).cross(&direction);
        let wrench = Vector6::from_fn(|i, _| if i < 3 { direction[i] } else { torque[i - 3] });
        units += wrench * wrench.transpose();
    }
    let per_sample = 0.5 / DT_S;
    let units = units * (asd_n_rthz.powi(2) * per_sample);
    let axes = Matrix6::identity() * (1e-14 * per_sample);

    let n = rows.len() as f64;
    let mut found = Matrix6::<f64>::zeros();
    for row in &rows {
        let (force, torque) = (row.sc_accel_srf_m_s2 * SC_KG, sc_inertia() * row.alpha_srf_rad_s2);
        let wrench = Vector6::from_fn(|i, _| if i < 3 { force[i] } else { torque[i - 3] });
        found += wrench * wrench.transpose() / n;
    }
    let worst = |wanted: &Matrix6<f64>| {
        let z = |i: usize, j: usize| {
            let sigma = ((wanted[(i, i)] * wanted[(j, j)] + wanted[(i, j)].powi(2)) / n).sqrt();
            ((found[(i, j)] - wanted[(i, j)]) / sigma).abs()
        };
        (0..6).flat_map(|i| (0..=i).map(move |j| (i, j))).map(|(i, j)| z(i, j)).fold(0.0, f64::max)
    };
    assert!(worst(&(units + axes)) < 4.5, "{found} {}", units + axes);
    let apart = Matrix6::from_diagonal(&(units + axes).diagonal());
    assert!(worst(&apart) > 4.5, "force and torque drawn apart would pass");
    assert!(worst(&units) > 4.5, "noise along the axes beside that of the units would pass");
}

/// Where the mission's own units have their noise, there is nothing to replace.
#[test]
fn units_of_the_mission_keep_their_noise() {
    let value: serde_json::Value =
        toml::from_str(include_str!("../../fixtures/missions/taiji-thrusters.toml")).unwrap();
    let mission = Mission::from_json(&value.to_string()).unwrap();
    let refused = Simulator::new(&mission, settings(&["mps-correlation:layout=7e-8"], 0.0)).err().unwrap().to_string();
    assert!(refused.contains("mps-correlation") && refused.contains("thrusters.unit = 9 units"), "{refused}");
}

/// Housekeeping, 300 s of it, by channel.
fn housekeeping(effects: &[&str]) -> Vec<Vec<f64>> {
    let mut simulator = Simulator::new(&taiji(), settings(effects, 0.0)).unwrap();
    let mut sensors = Housekeeping::new(&names(), DT_S, Xoshiro256PlusPlus::seed_from_u64(5));
    let mut channels = vec![Vec::new(); sensors.channels().len()];
    for _ in 0..3000 {
        let index = simulator.index();
        sensors.read(index, simulator.inside(), |i, value| channels[i].push(value));
        simulator.step().unwrap();
    }
    channels
}

/// An effect shows in housekeeping only where the loop acts on what is measured: the thrusters' commands (valves, tank)
/// and the attitude (Sun sensor and, through the panel, temperatures, by less than a step of their converter). Every
/// other channel is the same to the last bit, so no channel tells which effect is hidden.
#[test]
fn housekeeping_does_not_tell_what_is_hidden() {
    let plain = housekeeping(&[]);
    for kind in catalogue() {
        let effect = example(kind.id, &(kind.places)(2)[0].name(&names()));
        let hidden = housekeeping(&[&effect]);
        for ((channel, a), b) in channels(&names()).iter().zip(&plain).zip(&hidden) {
            let commanded = channel.place.starts_with("thruster ");
            let left = ["tank_mass_kg", "tank_pressure_pa"].contains(&channel.name.as_str());
            if commanded || left || channel.name == "sun_angle_rad" {
                continue;
            }
            assert!(a.len() >= 30 && a.len() == b.len(), "{}", channel.name);
            let most = a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
            let allowed = if channel.unit == "K" { 1.001 * channel.step } else { 0.0 };
            assert!(most <= allowed, "{effect}: {} changes by {most} {}", channel.name, channel.unit);
        }
    }
    // What is compared would show a change: sunlight that pushes twice as hard opens the valves.
    let pushed = housekeeping(&["solar-pressure:sc=1"]);
    let valve = channels(&names()).iter().position(|c| c.place == "thruster 1" && c.unit == "A").unwrap();
    assert_ne!(plain[valve], pushed[valve]);
}

/// A size for each kind that keeps the loop.
fn example(id: &str, place: &str) -> String {
    let size = match id {
        "com-offset" | "tilt-to-length" => "1e-3",
        "stiffness" | "cross-stiffness" => "1e-8",
        "offset-drift" => "1e-8",
        "mps-noise" | "torque-noise" | "is-noise" => "1.5",
        "thermal" | "current-force" | "product-force" => "1e-13",
        "magnetic" => "-2e-5",
        "mps-correlation" => "7e-8",
        "impulse" => "1e-8,at_s=3",
        _ => "0.02",
    };
    format!("{id}:{place}={size}")
}

/// Every instance of every kind flies, leaves the random stream of the loop alone, changes something, and goes on from
/// a saved state bit for bit.
#[test]
fn every_instance_flies_and_resumes_bit_for_bit() {
    let mission = taiji();
    let run = |simulator: &mut Simulator, n: usize| (0..n).map(|_| simulator.step().unwrap()).collect::<Vec<_>>();
    let rng = |simulator: &Simulator| {
        serde_json::from_slice::<serde_json::Value>(&simulator.save().unwrap()).unwrap()["rng"].clone()
    };
    let mut plain = Simulator::new(&mission, settings(&[], 5.0)).unwrap();
    run(&mut plain, 100);
    for kind in catalogue() {
        for place in (kind.places)(2) {
            let effect = example(kind.id, &place.name(&names()));
            let make = || Simulator::new(&mission, settings(&[&effect], 5.0)).unwrap();
            let (mut whole, mut resumed) = (make(), make());
            let first = run(&mut whole, 37);
            resumed.load(&whole.save().unwrap()).unwrap();
            let (a, b) = (run(&mut whole, 63), run(&mut resumed, 63));
            let bits = |rows: &[Epoch]| rows.iter().map(|e| format!("{e:?}")).collect::<Vec<_>>();
            assert!(bits(&a) == bits(&b), "{effect}: another end");
            assert_eq!(whole.state(), resumed.state(), "{effect}");
            assert_eq!(rng(&whole), rng(&plain), "{effect} takes random numbers of the loop");
            assert!(!first.is_empty() && first[0].index == 0);
        }
    }
}

#[test]
fn what_is_not_there_is_answered_with_what_is() {
    for (text, told) in [
        ("", "ID:INSTANCE=SIZE"),
        ("es-gain", "ID:INSTANCE=SIZE"),
        ("es-gain:tm1.y", "ID:INSTANCE=SIZE"),
        ("es-gain:tm1.y=1,", "ID:INSTANCE=SIZE"),
        ("sloshing:sc.x=0.1", "there is no effect sloshing; there are"),
        ("es-gain:tm1.x=1", "es-gain has no instance tm1.x; it has tm1.y, tm1.z, tm2.y, tm2.z"),
        ("es-crosstalk:tm1.y-y=1", "tm1.y-x, tm1.y-z"),
        ("mps-gain:tm1.x=1", "it has sc.x, sc.y, sc.z"),
        ("es-gain:tm1.y=inf", "SIZE = inf must be a number from -3e0 to 3e0 1"),
        ("es-gain:tm1.y=nan", "SIZE = nan"),
        ("mps-noise:sc.x=0.5", "SIZE = 0.5 must be a number from 1e0"),
        ("slosh:sc.x=-0.1", "SIZE = -0.1"),
        ("slosh:sc.x=0.1,zeta=-1", "zeta = -1 must be a number from 0e0 to 2e0 1"),
        ("thermal:tm1.x=1e-12,tau=3", "thermal has no parameter tau; it has lag_s (lag, s; 480 unless given)"),
        ("is-scale:tm1.y=0.1,lag_s=3", "is-scale has no parameter lag_s; it has none"),
        ("time-offset:is=-0.1", "SIZE = -0.1"),
        ("mps-correlation:sc=1e-7", "mps-correlation has no instance sc; it has layout"),
    ] {
        let error = parse(text).unwrap_err().to_string();
        assert!(error.contains(told), "{text}: {error}");
    }
    let list = parse("x:y=1").unwrap_err().to_string();
    for kind in catalogue() {
        assert!(list.contains(kind.id), "{}", kind.id);
        // What the border carries of a message.
        let about = parse(&format!("{}:?=0", kind.id)).unwrap_err().to_string();
        assert!(about.contains(kind.help) && about.len() < 1000, "{about}");
    }
}
