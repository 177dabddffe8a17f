//! Test spacecraft: rigid bodies in inertial space, from which second differences of positions are taken.
//!
//! Reference for the effects' declared responses: it computes without `Ω` and `û`, with numbers of order one.

use dragfree_physics::frames::dcm_turned_about_z;
use dragfree_physics::mission::Mission;
use dragfree_sdk::prelude::*;
use nalgebra::{Matrix3, Rotation3, Vector3};
use serde_json::json;
use std::collections::BTreeMap;

use crate::com_offset;
use crate::common::AXES;
use crate::linear::{Form, LinearEffect};

/// Time between two positions, s.
const DT_S: f64 = 1e-3;
/// Step of the finite differences in a coefficient.
const COEFFICIENT_STEP: f64 = 1e-3;

/// Deviations of the true spacecraft from the model; the default is none.
#[derive(Clone, Debug)]
pub(crate) struct Deviations {
    pub(crate) thrust_gain: Matrix3<f64>,
    pub(crate) torque_gain: Matrix3<f64>,
    pub(crate) electrode_gain: [Matrix3<f64>; 2],
    /// Reported over true displacements.
    pub(crate) readout_gain: [Matrix3<f64>; 2],
    /// Reported in x per θ and ψ, m/rad.
    pub(crate) tilt_to_length_m_rad: [[f64; 2]; 2],
    pub(crate) solar_force_gain: f64,
    pub(crate) arm_srf_m: Vector3<f64>,
    pub(crate) offset_srf_m: Vector3<f64>,
    pub(crate) stiffness_s2: [Matrix3<f64>; 2],
    pub(crate) cross_stiffness_m_s2_rad: [Matrix3<f64>; 2],
    /// Delay of the readout of each of the nine channels, s.
    pub(crate) readout_delay_s: [f64; 9],
    /// Rotation of a test mass's frame about s_3, rad.
    pub(crate) opening_error_rad: [f64; 2],
}

impl Default for Deviations {
    fn default() -> Self {
        let (one, zero) = (Matrix3::identity(), Matrix3::zeros());
        Self {
            thrust_gain: one,
            torque_gain: one,
            electrode_gain: [one; 2],
            readout_gain: [one; 2],
            tilt_to_length_m_rad: [[0.0; 2]; 2],
            solar_force_gain: 1.0,
            arm_srf_m: Vector3::zeros(),
            offset_srf_m: Vector3::zeros(),
            stiffness_s2: [zero; 2],
            cross_stiffness_m_s2_rad: [zero; 2],
            readout_delay_s: [0.0; 9],
            opening_error_rad: [0.0; 2],
        }
    }
}

/// Forces and torques at an instant.
#[derive(Clone, Copy, Debug)]
struct Forces {
    thrust_srf_n: Vector3<f64>,
    torque_srf_nm: Vector3<f64>,
    electrodes_orf_n: [Vector3<f64>; 2],
    electrodes_orf_nm: [Vector3<f64>; 2],
    sun_srf: Vector3<f64>,
    /// Unmodelled torque, and unmodelled force that is not correlated with it.
    noise_torque_srf_nm: Vector3<f64>,
    unknown_force_srf_n: Vector3<f64>,
}

/// Sets the deviation that a coefficient of the given value describes.
pub(crate) type SetDeviation<'a> = &'a dyn Fn(&mut Deviations, f64);

/// The spacecraft and its forces.
pub(crate) struct TestSpacecraft {
    pub(crate) mission: Mission,
    /// Gain of the smoother on unmodelled angular acceleration.
    pub(crate) smoother_gain: Matrix3<f64>,
    /// Whether the columns are those of prediction mode: by commands alone, and saying what they lack.
    pub(crate) prediction: bool,
    /// Whether the unmodelled torque has a correlated force.
    pub(crate) thruster_layout: bool,
    /// Whether the electrodes act; their recoil is a thousand times that of a real spacecraft.
    pub(crate) electrodes_active: bool,
    /// Unmodelled force on the spacecraft and its rate, SRF, N and N s⁻¹.
    pub(crate) unknown_force_srf_n: [Vector3<f64>; 2],
    /// Whether the thrusters' torque is the only force that varies with time.
    pub(crate) only_torque_varies: bool,
    pub(crate) r_orf_m: [Vector3<f64>; 2],
    pub(crate) angle_orf_rad: [Vector3<f64>; 2],
    /// Change of `hk.fuel_kg` since its first value, kg.
    pub(crate) fuel_change_kg: f64,
}

/// Setup of an effect; `parameters` are JSON members.
pub(crate) fn setup(instance: &str, parameters: &str) -> Setup {
    Setup::for_tests(&format!(r#"{{"instance": "{instance}", "parameters": {{{parameters}}}}}"#)).unwrap()
}

const NOISE_FORCE_PER_TORQUE: [[f64; 3]; 3] = [[0.3, -0.2, 0.5], [0.1, 0.4, -0.6], [-0.7, 0.2, 0.3]];

fn skewed(i: usize, j: usize) -> f64 {
    (1.3 * i as f64 + 2.9 * j as f64 + 0.4).sin()
}

fn vector(seed: usize) -> Vector3<f64> {
    Vector3::from_fn(|i, _| skewed(i, seed))
}

impl TestSpacecraft {
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
            smoother_gain: Matrix3::identity(),
            prediction: false,
            thruster_layout: false,
            electrodes_active: true,
            unknown_force_srf_n: zero,
            only_torque_varies: false,
            r_orf_m: zero,
            angle_orf_rad: zero,
            fuel_change_kg: 0.0,
        }
    }

    fn forces(&self, t_s: f64) -> Forces {
        let ramp = |seed: usize| {
            let push = if self.electrodes_active || !(3..=6).contains(&seed) { 1.0 } else { 0.0 };
            let change = if self.only_torque_varies && seed != 2 { 0.0 } else { t_s };
            (vector(seed) + vector(seed + 20) * change) * push
        };
        Forces {
            thrust_srf_n: ramp(1),
            torque_srf_nm: ramp(2),
            electrodes_orf_n: [ramp(3), ramp(4)],
            electrodes_orf_nm: [ramp(5), ramp(6)],
            sun_srf: ramp(17),
            noise_torque_srf_nm: ramp(8),
            unknown_force_srf_n: self.unknown_force_srf_n[0] + self.unknown_force_srf_n[1] * t_s,
        }
    }

    fn dcm(&self, tm: usize) -> Matrix3<f64> {
        self.mission.test_mass[&format!("tm{}", tm + 1)].dcm_orf_from_srf()
    }

    fn offset_srf_m(&self, tm: usize) -> Vector3<f64> {
        Vector3::from(self.mission.test_mass[&format!("tm{}", tm + 1)].offset_nominal_srf_m)
    }

    fn noise_force(&self) -> Matrix3<f64> {
        if self.thruster_layout { Matrix3::from(NOISE_FORCE_PER_TORQUE) } else { Matrix3::zeros() }
    }

    /// Force and angular acceleration of the spacecraft, SRF, N and rad s⁻², with `noise` times the unmodelled part.
    fn spacecraft(&self, forces: &Forces, deviations: &Deviations, noise: f64) -> (Vector3<f64>, Vector3<f64>) {
        let sun = self.mission.solar_pressure.as_ref().unwrap();
        let pressure = forces.sun_srf * (sun.force_n * deviations.solar_force_gain);
        let arm = Vector3::from(sun.arm_srf_m) + deviations.arm_srf_m;
        let torque_noise_nm = forces.noise_torque_srf_nm * noise;
        let mut force = deviations.thrust_gain * forces.thrust_srf_n
            + pressure
            + self.noise_force() * torque_noise_nm
            + forces.unknown_force_srf_n * noise;
        let mut torque = deviations.torque_gain * forces.torque_srf_nm + arm.cross(&pressure) + torque_noise_nm;
        for tm in 0..2 {
            // Recoil of the commanded force. The recoil of its deviation is neglected here, as it is 1000 times less in
            // flight.
            let push = self.dcm(tm).transpose() * forces.electrodes_orf_n[tm];
            force -= push;
            torque -= self.dcm(tm).transpose() * forces.electrodes_orf_nm[tm] + self.offset_srf_m(tm).cross(&push);
        }
        (force, self.mission.spacecraft.inertia().try_inverse().unwrap() * torque)
    }

    /// Reported displacement of a test mass at time `h` from rest at `t_s`, ORF, m.
    fn displacement(&self, tm: usize, t_s: f64, h: f64, deviations: &Deviations) -> Vector3<f64> {
        let forces = self.forces(t_s);
        let body = &self.mission.test_mass[&format!("tm{}", tm + 1)];
        let (force, alpha) = self.spacecraft(&forces, deviations, 1.0);
        let dcm = dcm_turned_about_z(deviations.opening_error_rad[tm]) * self.dcm(tm);
        let acting = deviations.electrode_gain[tm] * forces.electrodes_orf_n[tm];
        // The recoil of the deviation moves the test mass's own housing.
        let recoil = dcm.transpose() * (acting - forces.electrodes_orf_n[tm]) / self.mission.spacecraft.mass_kg;
        let spring = deviations.stiffness_s2[tm] * self.r_orf_m[tm]
            + deviations.cross_stiffness_m_s2_rad[tm] * self.angle_orf_rad[tm];
        let half = 0.5 * h * h;
        let b = self.offset_srf_m(tm) + deviations.offset_srf_m;
        let position = b
            + dcm.transpose() * self.r_orf_m[tm]
            + dcm.transpose() * (acting / body.mass_kg + spring) * half
            + recoil * half;
        let spacecraft = force / self.mission.spacecraft.mass_kg * half;
        let turned = Rotation3::new(alpha * half);
        let r = dcm * (turned.inverse() * (position - spacecraft) - b);
        let own = body.inertia("tm", "test").unwrap().try_inverse().unwrap() * forces.electrodes_orf_nm[tm];
        let attitude = Rotation3::new(dcm.transpose() * own * half);
        let turn = (turned.inverse() * attitude).into_inner();
        let sine =
            Vector3::new(turn[(2, 1)] - turn[(1, 2)], turn[(0, 2)] - turn[(2, 0)], turn[(1, 0)] - turn[(0, 1)]) * 0.5;
        let angle = dcm * sine;
        let [theta, psi] = deviations.tilt_to_length_m_rad[tm];
        deviations.readout_gain[tm] * r + Vector3::new(theta * angle.y + psi * angle.z, 0.0, 0.0)
    }

    /// Second difference of the reported displacement, m s⁻².
    fn second_difference(&self, tm: usize, t_s: f64, deviations: &Deviations) -> Vector3<f64> {
        let at = |h: f64| self.displacement(tm, t_s, h, deviations);
        (at(DT_S) - at(0.0) * 2.0 + at(-DT_S)) / (DT_S * DT_S)
    }

    fn angular_acceleration(&self, t_s: f64, deviations: &Deviations) -> Vector3<f64> {
        self.spacecraft(&self.forces(t_s), deviations, 1.0).1
    }

    /// Angular acceleration by the commands alone, rad s⁻².
    fn commanded_angular_acceleration(&self, t_s: f64) -> Vector3<f64> {
        self.spacecraft(&self.forces(t_s), &Deviations::default(), 0.0).1
    }

    /// Estimate `α̂`: the command, corrected by the smoother's gain on the attitude's difference.
    fn alpha_hat(&self, t_s: f64, deviations: &Deviations) -> Vector3<f64> {
        if self.prediction {
            return self.commanded_angular_acceleration(t_s);
        }
        let seen =
            Vector3::from_fn(|i, _| self.angular_acceleration(t_s - deviations.readout_delay_s[6 + i], deviations)[i]);
        self.commanded_angular_acceleration(t_s)
            + self.smoother_gain * (seen - self.commanded_angular_acceleration(t_s))
    }

    /// `û` of a test mass, with the force correlated with the estimated torque noise, m s⁻².
    fn known_acceleration(&self, tm: usize, t_s: f64, deviations: &Deviations) -> Vector3<f64> {
        let forces = self.forces(t_s);
        let noise = self.alpha_hat(t_s, deviations) - self.commanded_angular_acceleration(t_s);
        let torque_noise_nm = self.noise_force() * self.mission.spacecraft.inertia() * noise;
        let force = self.spacecraft(&forces, &Deviations::default(), 0.0).0 + torque_noise_nm;
        let own = forces.electrodes_orf_n[tm] / self.mission.test_mass["tm1"].mass_kg;
        own - self.dcm(tm) * force / self.mission.spacecraft.mass_kg
    }

    /// Unknown acceleration in the channels of a test mass: by the unmodelled force and the force correlated with the
    /// unmodelled torque, m s⁻².
    fn unknown_acceleration(&self, tm: usize, t_s: f64) -> Vector3<f64> {
        let forces = self.forces(t_s);
        let force = self.noise_force() * forces.noise_torque_srf_nm + forces.unknown_force_srf_n;
        self.dcm(tm) * force / -self.mission.spacecraft.mass_kg
    }

    fn offset_regressors(&self, tm: usize, alpha: &Vector3<f64>) -> Matrix3<f64> {
        com_offset::regressors(&self.dcm(tm), alpha, &Vector3::zeros())
    }

    /// The nine channels less the modelled part.
    fn residual(&self, deviations: &Deviations) -> [f64; 9] {
        let alpha = self.alpha_hat(0.0, deviations);
        std::array::from_fn(|channel| {
            let (body, axis, late) = (channel / 3, channel % 3, -deviations.readout_delay_s[channel]);
            if body == 2 {
                return self.angular_acceleration(late, deviations)[axis]
                    - self.commanded_angular_acceleration(0.0)[axis];
            }
            let explained = self.offset_regressors(body, &alpha) * (self.dcm(body) * self.offset_srf_m(body));
            self.second_difference(body, late, deviations)[axis]
                - self.known_acceleration(body, 0.0, deviations)[axis]
                - explained[axis]
        })
    }

    /// Derivative of the residual with respect to a coefficient, by central differences.
    pub(crate) fn derivative(&self, set: SetDeviation<'_>) -> [f64; 9] {
        let at = |size: f64| {
            let mut deviations = Deviations::default();
            set(&mut deviations, size);
            self.residual(&deviations)
        };
        let (after, before) = (at(COEFFICIENT_STEP), at(-COEFFICIENT_STEP));
        std::array::from_fn(|i| (after[i] - before[i]) / (2.0 * COEFFICIENT_STEP))
    }

    /// Columns and coefficients that precede an effect.
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
        for axis in AXES.iter().filter(|_| self.prediction) {
            let lacks = |channel: String| [(UNPREDICTED_ATTRIBUTE, json!({ channel: 1.0 }).to_string())];
            let alpha = lacks(format!("sc.alpha.{axis}"));
            all.columns.push(column("reconstruction", format!("sc.alpha_srf_rad_s2.{axis}"), &alpha));
            for tm in ["tm1", "tm2"] {
                let known = lacks(format!("{tm}.accel.{axis}"));
                all.columns.push(column("reconstruction", format!("{tm}.u_orf_m_s2.{axis}"), &known));
            }
        }
        for (tm, axis) in [1, 2].into_iter().flat_map(|tm| AXES.map(move |axis| (tm, axis))) {
            // A raw topic has a column of the same name.
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
                if self.thruster_layout {
                    let name = format!("response.u_orf_m_s2.by_torque_gain.{about}.tm{tm}.{axis}");
                    all.columns.push(column("reconstruction", name, &[]));
                }
            }
            let name = format!("com-offset.tm{tm}.{axis}");
            all.coefficients.push(Coefficient { name, ..Coefficient::default() });
        }
        all
    }

    /// Value of a column or series at `t_s`; in prediction mode with the unknown part that the column states.
    fn value(&self, name: &str, t_s: f64) -> f64 {
        if let Some(inner) = name.strip_prefix("slope(").and_then(|s| s.strip_suffix(')')) {
            // All forces are linear in time.
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
                "lost(hk.fuel_kg)" => -self.fuel_change_kg,
                "elapsed_s" => ELAPSED_S,
                other => panic!("{other}"),
            };
            return self.value(inner, t_s) * driver;
        }
        let forces = self.forces(t_s);
        let nominal = Deviations::default();
        let alpha =
            if self.prediction { self.angular_acceleration(t_s, &nominal) } else { self.alpha_hat(t_s, &nominal) };
        let index = |part: &str| ["x", "y", "z"].iter().position(|a| *a == part).unwrap();
        let coefficients: Vec<&str> = name.split(['.', '@']).collect();
        let last = *coefficients.last().unwrap();
        let tm = usize::from(name.contains("tm2"));
        match coefficients.as_slice() {
            ["used", "mps_force_srf_n", a] => forces.thrust_srf_n[index(a)],
            ["used", "mps_torque_srf_nm", a] => forces.torque_srf_nm[index(a)],
            ["used", _, "force_orf_n", a] => forces.electrodes_orf_n[tm][index(a)],
            ["used", _, "torque_orf_nm", a] => forces.electrodes_orf_nm[tm][index(a)],
            ["used", "sun_srf", a] => forces.sun_srf[index(a)],
            [_, "u_orf_m_s2", a] if self.prediction => {
                (self.known_acceleration(tm, t_s, &nominal) + self.unknown_acceleration(tm, t_s))[index(a)]
            }
            [_, "u_orf_m_s2", a] => self.known_acceleration(tm, t_s, &nominal)[index(a)],
            [_, "accel", a] => {
                (self.second_difference(tm, t_s, &nominal) - self.known_acceleration(tm, t_s, &nominal))[index(a)]
            }
            [_, "r_orf_m", a] => self.r_orf_m[tm][index(a)],
            ["dws", _, "theta_orf_rad"] | ["is", _, "att_orf_rad", "theta"] => self.angle_orf_rad[tm].y,
            ["dws", _, "psi_orf_rad"] | ["is", _, "att_orf_rad", "psi"] => self.angle_orf_rad[tm].z,
            ["is", _, "att_orf_rad", "phi"] => self.angle_orf_rad[tm].x,
            ["sc", "alpha_srf_rad_s2", a] => alpha[index(a)],
            ["response", what, "by_torque_gain", i, ..] => {
                // With the gain known, its torque is modelled and the smoother attributes less to the attitude.
                let i = index(i);
                let column =
                    self.mission.spacecraft.inertia().try_inverse().unwrap().column(i) * forces.torque_srf_nm[i];
                let found = -self.smoother_gain * column;
                if *what == "alpha_srf_rad_s2" {
                    return (column + found)[index(last)];
                }
                let force = self.noise_force() * self.mission.spacecraft.inertia() * found;
                (self.dcm(tm) * force / -self.mission.spacecraft.mass_kg)[index(last)]
            }
            ["response", "alpha_srf_rad_s2", "by_dws_delay", j] => {
                let slope = self.angular_acceleration(t_s + 1.0, &nominal) - self.angular_acceleration(t_s, &nominal);
                (-self.smoother_gain * slope)[index(j)]
            }
            ["com-offset", _, j, _, "accel", row] => self.offset_regressors(tm, &alpha)[(index(row), index(j))],
            other => panic!("{other:?}"),
        }
    }

    /// Value of a coefficient of the model.
    fn coefficient(&self, name: &str) -> f64 {
        let coefficients: Vec<&str> = name.split('.').collect();
        let tm = usize::from(coefficients[1] == "tm2");
        (self.dcm(tm) * self.offset_srf_m(tm))[AXES.iter().position(|a| *a == coefficients[2]).unwrap()]
    }

    pub(crate) fn declared(&self, form: &Form) -> [f64; 9] {
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

    /// First form of each coefficient; checks that the manifest lists the instance.
    pub(crate) fn forms<R: LinearEffect>(&self, instance: &str, parameters: &str) -> Vec<(String, Form)> {
        let is_named =
            |template: &&str| ["tm1", "tm2"].iter().any(|tm| template.replace("{test_mass}", tm) == instance);
        assert!(R::MANIFEST.instances.iter().any(is_named), "{instance}");
        let coefficients = R::coefficients(&setup(instance, parameters), &self.mission, &self.available()).unwrap();
        coefficients.into_iter().map(|p| (p.name.to_owned(), p.forms[0].clone())).collect()
    }

    /// Asserts that the declared responses equal the derivative of the residual, and that every term matters: turning
    /// its sign or removing it must be detected.
    pub(crate) fn assert_matches_derivative<R: LinearEffect>(
        &self,
        instance: &str,
        parameters: &str,
        sets: &[SetDeviation<'_>],
    ) {
        let forms = self.forms::<R>(instance, parameters);
        assert_eq!(forms.len(), sets.len());
        for ((name, form), set) in forms.iter().zip(sets) {
            let truth = self.derivative(set);
            let close = |form: &Form| {
                let got = self.declared(form);
                (0..9).all(|i| (got[i] - truth[i]).abs() < 2e-5)
            };
            assert!(close(form), "{} {instance} {name}: {:?} against {truth:?}", R::MANIFEST.id, self.declared(form));
            assert!(!form.terms.is_empty());
            for i in 0..form.terms.len() {
                for factor in [-1.0, 0.0] {
                    let mut other = form.clone();
                    other.terms[i].factor *= factor;
                    assert!(
                        !close(&other),
                        "{} {instance} {name}: {:?} has no influence",
                        R::MANIFEST.id,
                        form.terms[i]
                    );
                }
            }
        }
    }
}

/// Time since the first epoch, s.
pub(crate) const ELAPSED_S: f64 = 1.7;
