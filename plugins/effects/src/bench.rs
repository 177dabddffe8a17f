//! A small spacecraft to try the effects on: positions and rotations of rigid bodies in inertial space, from which second
//! differences are taken. It knows neither `Ω` nor `û` nor any regressor. Numbers are of order one, so that nothing hides.

use dragfree_physics::frames::dcm_turned_about_z;
use dragfree_physics::mission::Mission;
use dragfree_sdk::prelude::*;
use nalgebra::{Matrix3, Rotation3, Vector3};
use std::collections::BTreeMap;

use crate::com_offset;
use crate::linear::{AXES, Form, Recipe};

/// Time between two positions, s.
const STEP_S: f64 = 1e-3;
/// Steps of the finite differences in a coefficient.
const SMALL: f64 = 1e-3;

/// What is not as the model says. All is as it says by default.
#[derive(Clone, Debug)]
pub(crate) struct Wrong {
    pub(crate) thrust: Matrix3<f64>,
    pub(crate) torque: Matrix3<f64>,
    pub(crate) electrodes: [Matrix3<f64>; 2],
    /// Shown displacements of the true ones.
    pub(crate) shown: [Matrix3<f64>; 2],
    /// Shown in x of θ and ψ, m/rad.
    pub(crate) tilt_m_rad: [[f64; 2]; 2],
    pub(crate) sunlight: f64,
    pub(crate) arm_srf_m: Vector3<f64>,
    pub(crate) offset_srf_m: Vector3<f64>,
    pub(crate) stiffness_s2: [Matrix3<f64>; 2],
    pub(crate) cross_m_s2_rad: [Matrix3<f64>; 2],
    /// What each of the nine channels' readouts shows is so much too old, s.
    pub(crate) late_s: [f64; 9],
    /// Turn of a test mass's frame about s_3, rad.
    pub(crate) opening_rad: [f64; 2],
}

impl Default for Wrong {
    fn default() -> Self {
        let (one, zero) = (Matrix3::identity(), Matrix3::zeros());
        Self {
            thrust: one,
            torque: one,
            electrodes: [one; 2],
            shown: [one; 2],
            tilt_m_rad: [[0.0; 2]; 2],
            sunlight: 1.0,
            arm_srf_m: Vector3::zeros(),
            offset_srf_m: Vector3::zeros(),
            stiffness_s2: [zero; 2],
            cross_m_s2_rad: [zero; 2],
            late_s: [0.0; 9],
            opening_rad: [0.0; 2],
        }
    }
}

/// Loads of an instant.
#[derive(Clone, Copy, Debug)]
struct Loads {
    thrust_srf_n: Vector3<f64>,
    torque_srf_nm: Vector3<f64>,
    electrodes_orf_n: [Vector3<f64>; 2],
    electrodes_orf_nm: [Vector3<f64>; 2],
    sun_srf: Vector3<f64>,
    /// Torque that nobody knows, and a force on the spacecraft that comes with it.
    noise_srf_nm: Vector3<f64>,
    gust_srf_n: Vector3<f64>,
}

/// Brings a coefficient of a size into the world.
pub(crate) type Set<'a> = &'a dyn Fn(&mut Wrong, f64);

/// The spacecraft and what drives it.
pub(crate) struct Bench {
    pub(crate) mission: Mission,
    /// Part of an unknown angular acceleration that the toy smoother sees in the attitude.
    pub(crate) sees: Matrix3<f64>,
    /// Whether the torque's noise has a force with it.
    pub(crate) layout: bool,
    /// Whether the electrodes push, with a recoil that is a thousand times that of a real spacecraft.
    pub(crate) electrodes: bool,
    /// Force on the spacecraft that nobody knows, and its rate, SRF, N and N s⁻¹.
    pub(crate) gust_srf_n: [Vector3<f64>; 2],
    /// Whether the thrusters' torque alone varies with time.
    pub(crate) torque_alone_varies: bool,
    pub(crate) r_orf_m: [Vector3<f64>; 2],
    pub(crate) angle_orf_rad: [Vector3<f64>; 2],
    /// Value of `hk.fuel_kg` less its first.
    pub(crate) gained_kg: f64,
}

const NOISE_FORCE_PER_TORQUE: [[f64; 3]; 3] = [[0.3, -0.2, 0.5], [0.1, 0.4, -0.6], [-0.7, 0.2, 0.3]];

fn skewed(i: usize, j: usize) -> f64 {
    (1.3 * i as f64 + 2.9 * j as f64 + 0.4).sin()
}

fn vector(seed: usize) -> Vector3<f64> {
    Vector3::from_fn(|i, _| skewed(i, seed))
}

impl Bench {
    pub(crate) fn new() -> Self {
        let tm = |angle: f64, y: f64| {
            format!(
                r#"{{"mass_kg": 0.7, "inertia_mrf_kg_m2": [[0.5, 0.02, 0.03], [0.02, 0.6, -0.04], [0.03, -0.04, 0.8]],
                    "orf_from_srf_angle_rad": {angle}, "offset_nominal_srf_m": [0.05, {y}, 0.03], "offset_box_srf_m": [1, 1, 1]}}"#
            )
        };
        let text = format!(
            r#"{{"mission": {{"name": "M", "spacecraft": "S", "sample_rate_hz": 10.0}},
                "spacecraft": {{"mass_kg": 3.0, "inertia_srf_kg_m2": [[2.0, 0.2, 0.1], [0.2, 2.5, 0.3], [0.1, 0.3, 3.0]]}},
                "test_mass": {{"tm1": {}, "tm2": {}}},
                "solar_pressure": {{"force_n": 0.4, "arm_srf_m": [0.1, 0.2, 0.6], "orbit_error_m": 0.0}}}}"#,
            tm(0.5, 0.3),
            tm(-0.5, -0.3)
        );
        let zero = [Vector3::zeros(); 2];
        Self {
            mission: Mission::from_json(&text).unwrap(),
            sees: Matrix3::identity(),
            layout: false,
            electrodes: true,
            gust_srf_n: zero,
            torque_alone_varies: false,
            r_orf_m: zero,
            angle_orf_rad: zero,
            gained_kg: 0.0,
        }
    }

    fn loads(&self, t_s: f64) -> Loads {
        let ramp = |seed: usize| {
            let push = if self.electrodes || !(3..=6).contains(&seed) { 1.0 } else { 0.0 };
            let change = if self.torque_alone_varies && seed != 2 { 0.0 } else { t_s };
            (vector(seed) + vector(seed + 20) * change) * push
        };
        Loads {
            thrust_srf_n: ramp(1),
            torque_srf_nm: ramp(2),
            electrodes_orf_n: [ramp(3), ramp(4)],
            electrodes_orf_nm: [ramp(5), ramp(6)],
            sun_srf: ramp(7),
            noise_srf_nm: ramp(8),
            gust_srf_n: self.gust_srf_n[0] + self.gust_srf_n[1] * t_s,
        }
    }

    fn dcm(&self, tm: usize) -> Matrix3<f64> {
        self.mission.test_mass[&format!("tm{}", tm + 1)].dcm_orf_from_srf()
    }

    fn offset_srf_m(&self, tm: usize) -> Vector3<f64> {
        Vector3::from(self.mission.test_mass[&format!("tm{}", tm + 1)].offset_nominal_srf_m)
    }

    fn noise_force(&self) -> Matrix3<f64> {
        if self.layout { Matrix3::from(NOISE_FORCE_PER_TORQUE) } else { Matrix3::zeros() }
    }

    /// Force and angular acceleration of the spacecraft, SRF, N and rad s⁻², with `noise` of the torque that nobody knows.
    fn spacecraft(&self, loads: &Loads, wrong: &Wrong, noise: f64) -> (Vector3<f64>, Vector3<f64>) {
        let sun = self.mission.solar_pressure.as_ref().unwrap();
        let pressure = loads.sun_srf * (sun.force_n * wrong.sunlight);
        let arm = Vector3::from(sun.arm_srf_m) + wrong.arm_srf_m;
        let hum = loads.noise_srf_nm * noise;
        let mut force =
            wrong.thrust * loads.thrust_srf_n + pressure + self.noise_force() * hum + loads.gust_srf_n * noise;
        let mut torque = wrong.torque * loads.torque_srf_nm + arm.cross(&pressure) + hum;
        for tm in 0..2 {
            // The recoil of a correct push; that of the wrong part is 1/1000 of it in a real spacecraft, for the other test mass
            // and for the attitude.
            let push = self.dcm(tm).transpose() * loads.electrodes_orf_n[tm];
            force -= push;
            torque -= self.dcm(tm).transpose() * loads.electrodes_orf_nm[tm] + self.offset_srf_m(tm).cross(&push);
        }
        (force, self.mission.spacecraft.inertia().try_inverse().unwrap() * torque)
    }

    /// What an instrument shows of a test mass at time `h` around rest at `t_s`: displacement, ORF.
    fn displacement(&self, tm: usize, t_s: f64, h: f64, wrong: &Wrong) -> Vector3<f64> {
        let loads = self.loads(t_s);
        let body = &self.mission.test_mass[&format!("tm{}", tm + 1)];
        let (force, alpha) = self.spacecraft(&loads, wrong, 1.0);
        let dcm = dcm_turned_about_z(wrong.opening_rad[tm]) * self.dcm(tm);
        let acting = wrong.electrodes[tm] * loads.electrodes_orf_n[tm];
        // Its own recoil moves the housing against it.
        let recoil = dcm.transpose() * (acting - loads.electrodes_orf_n[tm]) / self.mission.spacecraft.mass_kg;
        let spring = wrong.stiffness_s2[tm] * self.r_orf_m[tm] + wrong.cross_m_s2_rad[tm] * self.angle_orf_rad[tm];
        let half = 0.5 * h * h;
        let b = self.offset_srf_m(tm) + wrong.offset_srf_m;
        let place = b
            + dcm.transpose() * self.r_orf_m[tm]
            + dcm.transpose() * (acting / body.mass_kg + spring) * half
            + recoil * half;
        let spacecraft = force / self.mission.spacecraft.mass_kg * half;
        let turned = Rotation3::new(alpha * half);
        let r = dcm * (turned.inverse() * (place - spacecraft) - b);
        let own = body.inertia("tm", "test").unwrap().try_inverse().unwrap() * loads.electrodes_orf_nm[tm];
        let attitude = Rotation3::new(dcm.transpose() * own * half);
        let turn = (turned.inverse() * attitude).into_inner();
        let sine =
            Vector3::new(turn[(2, 1)] - turn[(1, 2)], turn[(0, 2)] - turn[(2, 0)], turn[(1, 0)] - turn[(0, 1)]) * 0.5;
        let angle = dcm * sine;
        let [theta, psi] = wrong.tilt_m_rad[tm];
        wrong.shown[tm] * r + Vector3::new(theta * angle.y + psi * angle.z, 0.0, 0.0)
    }

    /// Second difference of what is shown of a test mass.
    fn shown(&self, tm: usize, t_s: f64, wrong: &Wrong) -> Vector3<f64> {
        let at = |h: f64| self.displacement(tm, t_s, h, wrong);
        (at(STEP_S) - at(0.0) * 2.0 + at(-STEP_S)) / (STEP_S * STEP_S)
    }

    fn turning(&self, t_s: f64, wrong: &Wrong) -> Vector3<f64> {
        self.spacecraft(&self.loads(t_s), wrong, 1.0).1
    }

    /// What commands say of the angular acceleration.
    fn commanded(&self, t_s: f64) -> Vector3<f64> {
        self.spacecraft(&self.loads(t_s), &Wrong::default(), 0.0).1
    }

    /// The toy smoother: it believes commands, and a part of what the attitude says beside them.
    fn alpha_hat(&self, t_s: f64, wrong: &Wrong) -> Vector3<f64> {
        let seen = Vector3::from_fn(|i, _| self.turning(t_s - wrong.late_s[6 + i], wrong)[i]);
        self.commanded(t_s) + self.sees * (seen - self.commanded(t_s))
    }

    /// `û` of a test mass, with the force that comes with the estimated noise of the torque.
    fn known(&self, tm: usize, t_s: f64, wrong: &Wrong) -> Vector3<f64> {
        let loads = self.loads(t_s);
        let noise = self.alpha_hat(t_s, wrong) - self.commanded(t_s);
        let hum = self.noise_force() * self.mission.spacecraft.inertia() * noise;
        let force = self.spacecraft(&loads, &Wrong::default(), 0.0).0 + hum;
        let own = loads.electrodes_orf_n[tm] / self.mission.test_mass["tm1"].mass_kg;
        own - self.dcm(tm) * force / self.mission.spacecraft.mass_kg
    }

    fn offset_regressors(&self, tm: usize, alpha: &Vector3<f64>) -> Matrix3<f64> {
        com_offset::regressors(&self.dcm(tm), alpha, &Vector3::zeros())
    }

    /// The nine channels less all that the model explains.
    fn residual(&self, wrong: &Wrong) -> [f64; 9] {
        let alpha = self.alpha_hat(0.0, wrong);
        std::array::from_fn(|channel| {
            let (body, axis, late) = (channel / 3, channel % 3, -wrong.late_s[channel]);
            if body == 2 {
                return self.turning(late, wrong)[axis] - self.commanded(0.0)[axis];
            }
            let explained = self.offset_regressors(body, &alpha) * (self.dcm(body) * self.offset_srf_m(body));
            self.shown(body, late, wrong)[axis] - self.known(body, 0.0, wrong)[axis] - explained[axis]
        })
    }

    /// Derivative of the residual to a coefficient that `set` brings into the world.
    pub(crate) fn derivative(&self, set: Set<'_>) -> [f64; 9] {
        let at = |size: f64| {
            let mut wrong = Wrong::default();
            set(&mut wrong, size);
            self.residual(&wrong)
        };
        let (after, before) = (at(SMALL), at(-SMALL));
        std::array::from_fn(|i| (after[i] - before[i]) / (2.0 * SMALL))
    }

    /// Everything that telemetry and model have before an effect.
    pub(crate) fn available(&self) -> Available {
        let column = |table: &str, name: String, attributes: &[(&str, String)]| Column {
            table: table.to_owned(),
            name,
            attributes: attributes.iter().map(|(k, v)| ((*k).to_owned(), v.clone())).collect::<BTreeMap<_, _>>(),
            ..Column::default()
        };
        let mut all = Available::default();
        all.columns.push(Column { unit: "kg".to_owned(), ..column("grid", "hk.fuel_kg".to_owned(), &[]) });
        all.columns.push(Column { unit: "V".to_owned(), ..column("grid", "hk.bus_v".to_owned(), &[]) });
        for (tm, axis) in [1, 2].into_iter().flat_map(|tm| AXES.map(move |axis| (tm, axis))) {
            // The raw topic has a column of the same name, as telemetry has.
            all.columns.insert(0, column("is", format!("tm{tm}.r_orf_m.{axis}"), &[]));
            let noise = if axis == "x" { "ifo_x".to_owned() } else { format!("is_{axis}") };
            all.columns.push(column("reconstruction", format!("tm{tm}.r_orf_m.{axis}"), &[("noise", noise)]));
            let channel = format!("tm{tm}.accel.{axis}");
            all.columns.push(column("reconstruction", channel.clone(), &[("kind", "channel".to_owned())]));
            for about in AXES {
                let coefficient = format!("com-offset.tm{tm}.{about}");
                let kind = ("kind", "regressor".to_owned());
                let attributes = [kind, ("coefficient", coefficient.clone()), ("channel", channel.clone())];
                all.columns.push(column("effect/com-offset", format!("{coefficient}@{channel}"), &attributes));
                if self.layout {
                    let name = format!("response.u_orf_m_s2.by_torque_gain.{about}.tm{tm}.{axis}");
                    all.columns.push(column("reconstruction", name, &[]));
                }
            }
            let name = format!("com-offset.tm{tm}.{axis}");
            all.coefficients.push(Coefficient { name, ..Coefficient::default() });
        }
        all
    }

    /// The value of a column or series at `t_s`.
    fn value(&self, name: &str, t_s: f64) -> f64 {
        if let Some(inner) = name.strip_prefix("slope(").and_then(|s| s.strip_suffix(')')) {
            // All loads are straight lines in time.
            return self.value(inner, t_s + 1.0) - self.value(inner, t_s);
        }
        if let Some(inner) = name.strip_prefix("newer(").and_then(|s| s.strip_suffix(')')) {
            return self.value(inner, t_s);
        }
        if let Some(inner) = name.strip_prefix("held(").and_then(|s| s.strip_suffix(')')) {
            return self.value(inner, t_s);
        }
        if let Some((inner, driver)) = name.split_once('*') {
            let driver = match driver {
                "lost(hk.fuel_kg)" => -self.gained_kg,
                "elapsed_s" => ELAPSED_S,
                other => panic!("{other}"),
            };
            return self.value(inner, t_s) * driver;
        }
        let loads = self.loads(t_s);
        let right = Wrong::default();
        let alpha = self.alpha_hat(t_s, &right);
        let index = |part: &str| ["x", "y", "z"].iter().position(|a| *a == part).unwrap();
        let parts: Vec<&str> = name.split(['.', '@']).collect();
        let last = *parts.last().unwrap();
        let tm = usize::from(name.contains("tm2"));
        match parts.as_slice() {
            ["used", "mps_force_srf_n", a] => loads.thrust_srf_n[index(a)],
            ["used", "mps_torque_srf_nm", a] => loads.torque_srf_nm[index(a)],
            ["used", _, "force_orf_n", a] => loads.electrodes_orf_n[tm][index(a)],
            ["used", _, "torque_orf_nm", a] => loads.electrodes_orf_nm[tm][index(a)],
            ["used", "sun_srf", a] => loads.sun_srf[index(a)],
            [_, "u_orf_m_s2", a] => self.known(tm, t_s, &right)[index(a)],
            [_, "accel", a] => (self.shown(tm, t_s, &right) - self.known(tm, t_s, &right))[index(a)],
            [_, "r_orf_m", a] => self.r_orf_m[tm][index(a)],
            ["dws", _, "theta_orf_rad"] | ["is", _, "att_orf_rad", "theta"] => self.angle_orf_rad[tm].y,
            ["dws", _, "psi_orf_rad"] | ["is", _, "att_orf_rad", "psi"] => self.angle_orf_rad[tm].z,
            ["is", _, "att_orf_rad", "phi"] => self.angle_orf_rad[tm].x,
            ["sc", "alpha_srf_rad_s2", a] => alpha[index(a)],
            ["response", what, "by_torque_gain", i, ..] => {
                // One who knows the gain takes all of it for known, and finds less in the attitude beside it.
                let i = index(i);
                let column =
                    self.mission.spacecraft.inertia().try_inverse().unwrap().column(i) * loads.torque_srf_nm[i];
                let found = -self.sees * column;
                if *what == "alpha_srf_rad_s2" {
                    return (column + found)[index(last)];
                }
                let force = self.noise_force() * self.mission.spacecraft.inertia() * found;
                (self.dcm(tm) * force / -self.mission.spacecraft.mass_kg)[index(last)]
            }
            ["response", "alpha_srf_rad_s2", "by_dws_delay", j] => {
                let slope = self.turning(t_s + 1.0, &right) - self.turning(t_s, &right);
                (-self.sees * slope)[index(j)]
            }
            ["com-offset", _, j, _, "accel", row] => self.offset_regressors(tm, &alpha)[(index(row), index(j))],
            other => panic!("{other:?}"),
        }
    }

    /// The value of a coefficient of the model.
    fn coefficient(&self, name: &str) -> f64 {
        let parts: Vec<&str> = name.split('.').collect();
        let tm = usize::from(parts[1] == "tm2");
        (self.dcm(tm) * self.offset_srf_m(tm))[AXES.iter().position(|a| *a == parts[2]).unwrap()]
    }

    pub(crate) fn predicted(&self, form: &Form) -> [f64; 9] {
        let mut out = [0.0; 9];
        for term in &form.terms {
            let names = ["tm1.accel", "tm2.accel", "sc.alpha"];
            let (body, axis) = term.channel.rsplit_once('.').unwrap();
            let channel =
                3 * names.iter().position(|n| *n == body).unwrap() + AXES.iter().position(|a| *a == axis).unwrap();
            let times = term.times.as_ref().map_or(1.0, |name| self.coefficient(name));
            out[channel] += term.factor * self.value(&term.series.name(), 0.0) * times;
        }
        out
    }

    /// The forms of an effect, one for each coefficient, and that the manifest has the instance.
    pub(crate) fn forms<R: Recipe>(&self, instance: &str, parameters: &str) -> Vec<(String, Form)> {
        assert!(R::MANIFEST.instances.contains(&instance), "{instance}");
        let setup = format!(r#"{{"instance": "{instance}", "parameters": {{{parameters}}}}}"#);
        let recipe = R::new(&Setup::for_tests(&setup).unwrap()).unwrap();
        let parts = recipe.parts(&self.mission, &self.available()).unwrap();
        parts.into_iter().map(|p| (p.name.to_owned(), p.forms[0].clone())).collect()
    }

    /// What the effect declares is the derivative of the residual; and the test sees it when any one term has its sign turned
    /// or is missing.
    pub(crate) fn check<R: Recipe>(&self, instance: &str, parameters: &str, sets: &[Set<'_>]) {
        let forms = self.forms::<R>(instance, parameters);
        assert_eq!(forms.len(), sets.len());
        for ((name, form), set) in forms.iter().zip(sets) {
            let truth = self.derivative(set);
            let close = |form: &Form| {
                let got = self.predicted(form);
                (0..9).all(|i| (got[i] - truth[i]).abs() < 2e-5)
            };
            assert!(close(form), "{} {instance} {name}: {:?} against {truth:?}", R::MANIFEST.id, self.predicted(form));
            assert!(!form.terms.is_empty());
            for i in 0..form.terms.len() {
                for factor in [-1.0, 0.0] {
                    let mut other = form.clone();
                    other.terms[i].factor *= factor;
                    assert!(!close(&other), "{} {instance} {name}: {:?} says nothing", R::MANIFEST.id, form.terms[i]);
                }
            }
        }
    }
}

/// Time since the first epoch, s.
pub(crate) const ELAPSED_S: f64 = 1.7;
