//! The columns on demand against independent runs of the stage: what they say would change does change.

use dragfree_hinf_dfacs::on_demand::Needs;
use dragfree_hinf_dfacs::reconstruction::AngularAcceleration::{Commanded, Smoother};
use dragfree_hinf_dfacs::reconstruction::{Epoch, Row, Settings};
use dragfree_hinf_dfacs::replay::CommandNumbers;
use dragfree_physics::mission::Mission;
use nalgebra::Vector3;
use std::f64::consts::TAU;

use crate::common::{AttitudeLoop, DT_S, EVERYTHING, RATE_HZ, late, mission, run, settings, stage, still, unknown};
use crate::correlation::layout;
use crate::slope::{Against, DECADES, Response, of_responses};
use crate::stream::{alpha, holes, telemetry, with_replay};

const COMMANDS: Needs = Needs { dws_delay_response: false, torque_response: false, ..EVERYTHING };
const DELAY: Needs = Needs { commands: false, torque_response: false, ..EVERYTHING };

fn asking(needs: Needs) -> Settings {
    Settings { needs, ..settings(Smoother) }
}

/// The loop is linear, so that telemetry of a noise 10,000 times smaller is the same in small; the gyroscopic torque,
/// quadratic and no part of a response, is then 1e-13 of the rest.
fn quiet(epochs: &[Epoch]) -> Vec<Epoch> {
    let mut epochs = epochs.to_vec();
    for epoch in &mut epochs {
        epoch.readout.iter_mut().chain(&mut epoch.command).for_each(|x| *x *= 1e-4);
    }
    epochs
}

/// The values of three or more columns, by the first one's name.
fn columns(mission: &Mission, needs: Needs, rows: &[Row], first: &str) -> Vec<Vector3<f64>> {
    let names = stage(mission, &asking(needs)).on_demand_columns();
    let at = names.iter().position(|(name, _, _)| name == first).unwrap_or_else(|| panic!("no {first}"));
    rows.iter().map(|row| Vector3::from_column_slice(&row.on_demand[at..at + 3])).collect()
}

fn largest(values: &[Vector3<f64>]) -> f64 {
    values.iter().filter(|v| v.x.is_finite()).map(Vector3::amax).fold(0.0, f64::max)
}

/// Largest distance of two series over the size of the second; they must be NaN at the same epochs.
fn distance(got: &[Vector3<f64>], want: &[Vector3<f64>]) -> f64 {
    assert_eq!(got.len(), want.len());
    let mut worst = 0.0_f64;
    for (k, (got, want)) in got.iter().zip(want).enumerate() {
        assert_eq!(got.map(f64::is_nan), want.map(f64::is_nan), "epoch {k}: {got} against {want}");
        worst = worst.max(if want.x.is_nan() { 0.0 } else { (got - want).amax() });
    }
    worst / largest(want)
}

fn with_layout() -> Mission {
    Mission { thrusters: Some(layout()), ..mission() }
}

/// Commands of one axis doubled: α̂, and û where force comes with torque, change by the response, to rounding. As all
/// is linear the step may be large, and loses no digits. What is left, 4e-12 of what is known and in the first dozen
/// epochs alone, is the smoother's own rounding under its wide prior: it takes the first attitudes' innovations, 1e14
/// of their noise in variance, off again.
#[test]
fn a_torque_gain_does_what_its_response_says() {
    const GAIN: f64 = 1.0;
    for mission in [mission(), late(mission()), with_layout()] {
        let epochs = holes(quiet(&telemetry(&mission, 2600).0));
        let rows = run(&mut stage(&mission, &asking(EVERYTHING)), &epochs);
        let known =
            largest(&run(&mut stage(&mission, &settings(Commanded)), &epochs).iter().map(alpha).collect::<Vec<_>>());
        for (axis, about) in ["x", "y", "z"].into_iter().enumerate() {
            let mut louder = epochs.clone();
            louder.iter_mut().for_each(|epoch| epoch.command[3 + axis] *= 1.0 + GAIN);
            let louder = run(&mut stage(&mission, &settings(Smoother)), &louder);
            let change = |of: &dyn Fn(&Row) -> Vector3<f64>| -> Vec<_> {
                rows.iter().zip(&louder).map(|(a, b)| (of(b) - of(a)) / GAIN).collect()
            };
            let name = format!("response.alpha_srf_rad_s2.by_torque_gain.{about}.x");
            let response = columns(&mission, EVERYTHING, &rows, &name);
            let error = distance(&change(&alpha), &response) * largest(&response) / known;
            let settled = distance(&change(&alpha)[20..], &response[20..]) * largest(&response[20..]) / known;
            assert!(settled < 1e-13, "about {about}, settled: {settled:e}");
            assert!(error < 1e-11, "about {about}: {error:e}");
            assert!(largest(&response) > 0.01 * known, "about {about}: {:e} of {known:e}", largest(&response));
            for (tm, first) in [("tm1", 9), ("tm2", 15)] {
                let name = format!("response.u_orf_m_s2.by_torque_gain.{about}.{tm}.x");
                let u = |row: &Row| Vector3::from_column_slice(&row.values[first..first + 3]);
                let change = change(&u);
                if mission.thrusters.as_ref().is_none_or(|t| t.unit.is_empty()) {
                    assert!(change.iter().filter(|v| v.x.is_finite()).all(|v| *v == Vector3::zeros()));
                    continue;
                }
                let response = columns(&mission, EVERYTHING, &rows, &name);
                let size = largest(&rows.iter().map(u).collect::<Vec<_>>());
                let error = distance(&change, &response) * largest(&response) / size;
                assert!(error < 1e-11 && largest(&response) > 1e-4 * size, "{tm} about {about}: {error:e}");
            }
        }
    }
}

/// A spacecraft that does what it is told, about all axes, smoothly: α̂ is α. Attitude read 1 ms late and 1 ms early
/// then changes α̂ by twice the response, but for a part `τ Δt (2πf)²/4` of it, 2.5e-6 at 50 mHz. Readouts and commands
/// go missing.
#[test]
fn a_delay_does_what_its_response_says() {
    const TAU_S: f64 = 1e-3;
    let mission = mission();
    let inertia = mission.spacecraft.inertia();
    let wave = |k: usize| {
        let wave = |f: f64, phase: f64| 1e-13 * (TAU * f * DT_S * k as f64 + phase).sin();
        Vector3::new(wave(0.05, 0.3), wave(0.02, 1.0), wave(0.037, 2.0))
    };
    let record = |shift_s: f64, gaps: bool| -> Vec<Epoch> {
        let (mut theta, mut omega) = (Vector3::new(1e-12, -2e-12, 3e-12), Vector3::new(2e-13, 1e-13, -1e-13));
        let epochs = (0..4000).map(|k| {
            // Within a sample α is held, the one before t_k or the one after.
            let bent = if shift_s < 0.0 { wave(k.max(1) - 1) } else { wave(k) };
            let y = theta + omega * shift_s + bent * (0.5 * shift_s * shift_s);
            theta += omega * DT_S + wave(k) * (0.5 * DT_S * DT_S);
            omega += wave(k) * DT_S;
            let mut epoch = nothing(k);
            epoch.readout[..3].copy_from_slice(y.as_slice());
            epoch.command[3..6].copy_from_slice((inertia * wave(k)).as_slice());
            epoch
        });
        if gaps { holes(epochs.collect()) } else { epochs.collect() }
    };
    let rows = run(&mut stage(&mission, &asking(DELAY)), &record(0.0, true));
    let [late, early] =
        [-TAU_S, TAU_S].map(|shift_s| run(&mut stage(&mission, &settings(Smoother)), &record(shift_s, true)));
    let change: Vec<_> = late.iter().zip(&early).map(|(l, e)| (alpha(l) - alpha(e)) / (2.0 * TAU_S)).collect();
    let response = columns(&mission, DELAY, &rows, "response.alpha_srf_rad_s2.by_dws_delay.x");
    let error = distance(&change, &response);
    assert!(error < 5e-6, "{error:e}");
    // About y, at a quarter of the smoother's crossover of 80 mHz, sensing tells 1/(1 + 4⁻⁴) = 0.996 of everything.
    let whole = run(&mut stage(&mission, &asking(DELAY)), &record(0.0, false));
    let response = columns(&mission, DELAY, &whole, "response.alpha_srf_rad_s2.by_dws_delay.x");
    let bend = |k: usize| (wave(k - 1).y - wave(k + 1).y) * (0.5 * RATE_HZ);
    let sum = |of: &dyn Fn(usize) -> f64| (1000..3000).map(of).sum::<f64>();
    let slope = sum(&|k| response[k].y * bend(k)) / sum(&|k| bend(k).powi(2));
    assert!((slope - 0.996).abs() < 2e-3, "{slope}");
}

fn nothing(k: usize) -> Epoch {
    let missing = Vector3::from_element(f64::NAN);
    Epoch {
        time_ns: k as i64 * 100_000_000,
        readout: still(),
        command: CommandNumbers::from([0.0; 18]),
        sun_srf: missing,
        ephemeris_age_s: f64::NAN,
        omega_crf_rad_s: missing,
        alpha_crf_rad_s2: missing,
    }
}

/// What a stage makes of attitude alone, the commands zero: minus the integral of the accelerations `alpha_rad_s2`.
/// Missing attitude and commands are those of `like`.
fn answer_to_rate(mission: &Mission, like: &[Epoch], alpha_rad_s2: &[Vector3<f64>]) -> Vec<Vector3<f64>> {
    let mut omega: Vector3<f64> = Vector3::zeros();
    let epochs: Vec<Epoch> = like
        .iter()
        .zip(alpha_rad_s2)
        .enumerate()
        .map(|(k, (like, alpha))| {
            let mut epoch = nothing(k);
            for i in 0..3 {
                epoch.readout[i] = if like.readout[i].is_nan() { f64::NAN } else { -omega[i] };
            }
            for (command, like) in epoch.command.iter_mut().zip(&like.command) {
                *command = if like.is_nan() { f64::NAN } else { 0.0 };
            }
            omega += if alpha.x.is_nan() { Vector3::zeros() } else { alpha * DT_S };
            epoch
        })
        .collect();
    run(&mut stage(mission, &settings(Smoother)), &epochs).iter().map(alpha).collect()
}

/// Under noise, with readouts and commands missing: the response is what a stage makes of minus the rate that α̂
/// integrates to. In one block, as α̂ has small steps where two meet, to rounding.
#[test]
fn a_delay_adds_minus_the_rate_to_the_attitude() {
    let mission = mission();
    let mut epochs = quiet(&telemetry(&mission, 1100).0);
    for (k, epoch) in epochs.iter_mut().enumerate() {
        if k % 13 == 5 || (400..430).contains(&k) {
            epoch.readout[1] = f64::NAN;
        }
        if k % 211 == 100 || (800..830).contains(&k) {
            epoch.command[4] = f64::NAN;
        }
    }
    let rows = run(&mut stage(&mission, &asking(DELAY)), &epochs);
    let response = columns(&mission, DELAY, &rows, "response.alpha_srf_rad_s2.by_dws_delay.x");
    let again = answer_to_rate(&mission, &epochs, &rows.iter().map(alpha).collect::<Vec<_>>());
    let error = distance(&again, &response);
    assert!(error < 1e-7, "{error:e}");
}

/// Slope of the truth on the column, exactly, by impulses as for α̂ itself: one. The twin made of commands is far from
/// that.
#[test]
fn the_true_change_by_a_delay_on_the_column_has_slope_one() {
    const QUIET: usize = 40_321;
    const AFTER: usize = 1 << 16;
    let mission = mission();
    let response = |input: usize| {
        let mut body = AttitudeLoop::new(&mission);
        let mut impulse = [Vector3::zeros(), Vector3::zeros()];
        impulse[input / 3][input % 3] = [1e-7, 1e-9][input / 3];
        let zero = [Vector3::zeros(); 2];
        let (epochs, truth): (Vec<_>, Vec<_>) = (0..QUIET + AFTER)
            .map(|k| if k == QUIET { impulse } else { zero })
            .map(|[torque_nm, error_rad]| body.step(&torque_nm, &error_rad))
            .unzip();
        let truth = answer_to_rate(&mission, &epochs, &truth);
        let rows = run(&mut stage(&mission, &asking(DELAY)), &epochs);
        let column = columns(&mission, DELAY, &rows, "response.alpha_srf_rad_s2.by_dws_delay.x");
        let told: Vec<_> = run(&mut stage(&mission, &settings(Commanded)), &epochs).iter().map(alpha).collect();
        let twin = answer_to_rate(&mission, &epochs, &told);
        let axes = |v: &[Vector3<f64>]| [0, 1, 2].map(|i| v.iter().map(|v| v[i]).collect());
        [column, twin].map(|estimate| Response { truth: axes(&truth), estimate: axes(&estimate) })
    };
    let (column, twin): (Vec<_>, Vec<_>) = (0..6).map(response).map(|[column, twin]| (column, twin)).unzip();
    let [column, twin] = [column, twin].map(|responses| of_responses(&mission, &responses));
    let worst = |of: &[Against; 3]| of.iter().map(|a| (a.slope - 1.0).abs()).fold(0.0, f64::max);
    for (decade, (column, twin)) in DECADES.iter().zip(column.iter().zip(&twin)) {
        assert!(worst(column) < 2e-3, "{decade:?} Hz: {column:?}, twin {twin:?}");
        assert!(column.iter().all(|a| a.coherence > 0.1), "{decade:?} Hz: {column:?}");
    }
    assert!(worst(&twin[0]) > 0.5 && worst(&twin[1]) > 0.1, "{twin:?}");
}

#[test]
fn used_commands_are_those_that_act() {
    let names = stage(&mission(), &asking(COMMANDS)).on_demand_columns();
    assert_eq!(names.len(), 21);
    let (epochs, _) = telemetry(&mission(), 3000);
    let mut epochs = holes(epochs);
    for epoch in &mut epochs {
        epoch.command[6..]
            .copy_from_slice(&[1e-9, 2e-9, 3e-9, 4e-12, 5e-12, 6e-12, 7e-9, 8e-9, 9e-9, 1e-12, 2e-12, 3e-12]);
    }
    // The second test mass falls silent, and the Sun is heard of once.
    epochs[2000..2100].iter_mut().for_each(|epoch| epoch.command[12..].fill(f64::NAN));
    epochs[500].sun_srf = Vector3::new(0.6, 0.8, 0.0);
    let rows = run(&mut stage(&mission(), &asking(COMMANDS)), &epochs);
    for (k, (row, epoch)) in rows.iter().zip(&epochs).enumerate() {
        let told = epoch.command[..12].iter().all(|x| x.is_finite());
        for (i, (got, want)) in row.on_demand.iter().zip(&epoch.command).enumerate() {
            assert!(if told && want.is_finite() { got == want } else { got.is_nan() }, "epoch {k}, {}", names[i].0);
        }
        let sun = &row.on_demand[18..];
        assert!(if k < 500 { sun.iter().all(|x| x.is_nan()) } else { *sun == [0.6, 0.8, 0.0] }, "epoch {k}: {sun:?}");
    }

    // A delay of two samples before a lag of two: over a sample the mean of o + (y − o) e^{−t/0.2 s} by hand.
    let rows = run(&mut stage(&late(mission()), &asking(COMMANDS)), &epochs);
    let left = (-0.5_f64).exp();
    for i in 0..6 {
        let size = epochs.iter().map(|e| e.command[i].abs()).filter(|x| x.is_finite()).fold(0.0, f64::max);
        let (mut made, mut before) = (epochs[0].command[i], [epochs[0].command[i]; 2]);
        for (row, epoch) in rows.iter().zip(&epochs) {
            if epoch.command[..12].iter().any(|x| x.is_nan()) {
                before[0] = f64::NAN;
                assert!(row.on_demand[i].is_nan());
                continue;
            }
            if before[0].is_nan() {
                // After a gap what acted before is taken to be the same.
                (made, before) = (epoch.command[i], [epoch.command[i]; 2]);
            }
            let want = before[0] + (made - before[0]) * ((1.0 - left) / 0.5);
            made = before[0] + (made - before[0]) * left;
            before = [before[1], epoch.command[i]];
            assert!(
                (row.on_demand[i] - want).abs() <= 1e-14 * size,
                "{}: {} against {want}",
                names[i].0,
                row.on_demand[i]
            );
        }
    }
}

/// Without `/command` the law stands in: from the same start its commands are those that flew, and so are the
/// responses.
#[test]
fn replayed_commands_answer_as_flown_ones() {
    let mission = mission();
    let (mut epochs, _) = telemetry(&mission, 4000);
    epochs[..600].iter_mut().for_each(|epoch| epoch.command = unknown());
    let flown = run(&mut stage(&mission, &asking(EVERYTHING)), &epochs);
    epochs.iter_mut().for_each(|epoch| epoch.command = unknown());
    let alone = Settings { commands: false, needs: EVERYTHING, ..with_replay() };
    let rows = run(&mut stage(&mission, &alone), &epochs);
    assert!(rows[..600].iter().all(|row| row.on_demand.iter().all(|x| x.is_nan())), "the law settles for 60 s");
    for k in 600..4000 {
        assert_eq!(rows[k].on_demand[..18], flown[k].on_demand[..18], "epoch {k}");
        assert_eq!(rows[k].on_demand[21..], flown[k].on_demand[21..], "epoch {k}");
    }
}

#[test]
fn asking_changes_nothing_else() {
    let mission = late(with_layout());
    let epochs = holes(telemetry(&mission, 2600).0);
    let usual = run(&mut stage(&mission, &settings(Smoother)), &epochs);
    assert!(usual.iter().all(|row| row.on_demand.is_empty()));
    let on_demand = run(&mut stage(&mission, &asking(EVERYTHING)), &epochs);
    let bits = |rows: &[Row]| rows.iter().map(|row| row.values.map(|x| x.to_bits())).collect::<Vec<_>>();
    assert!(bits(&usual) == bits(&on_demand));
}
