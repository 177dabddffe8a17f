//! The stage as a stream: rows, gaps, states, replayed commands, the turning of CRF.

use crate::common::{AttitudeLoop, EVERYTHING, RATE_HZ, late, levels, mission, run, settings, stage, still, unknown};
use dragfree_hinf_dfacs::noise_calibration;
use dragfree_hinf_dfacs::reconstruction::AngularAcceleration::{Commanded, Smoother};
use dragfree_hinf_dfacs::reconstruction::{Epoch, Reconstruction, Row, Settings, levels_of};
use dragfree_physics::mission::Mission;
use dragfree_sdk::state::{self, StateError};
use nalgebra::Vector3;
use proptest::prelude::*;
use rand::SeedableRng;
use rand_distr::{Distribution, StandardNormal};
use rand_xoshiro::Xoshiro256PlusPlus;

/// First of the nine channels in a row: after α̂, ω̂, and r and û of two test masses.
const CHANNELS_AT: usize = 18;

/// Telemetry of the loop under the mission's noise, and the true `α`.
pub(crate) fn telemetry(mission: &Mission, epochs: usize) -> (Vec<Epoch>, Vec<Vector3<f64>>) {
    let [torque, sensing] = levels(mission).map(|psd| (0.5 * psd * RATE_HZ).sqrt());
    let mut random = Xoshiro256PlusPlus::seed_from_u64(22);
    let mut gauss =
        |sigma: f64| Vector3::from_fn(|_, _| sigma * Distribution::<f64>::sample(&StandardNormal, &mut random));
    let mut body = AttitudeLoop::new(mission);
    (0..epochs).map(|_| body.step(&gauss(torque), &gauss(sensing))).unzip()
}

fn bits(rows: &[Row]) -> Vec<(i64, Vec<u64>)> {
    rows.iter().map(|r| (r.time_ns, r.values.iter().chain(&r.on_demand).map(|v| v.to_bits()).collect())).collect()
}

pub(crate) fn alpha(row: &Row) -> Vector3<f64> {
    Vector3::from_column_slice(&row.values[..3])
}

fn u1(row: &Row) -> Vector3<f64> {
    Vector3::from_column_slice(&row.values[9..12])
}

fn rms(values: impl Iterator<Item = Vector3<f64>>) -> f64 {
    let (sum, n) = values.fold((0.0, 0.0), |(s, n), v| (s + v.norm_squared(), n + 1.0));
    (sum / n).sqrt()
}

pub(crate) fn with_replay() -> Settings {
    Settings { replay: true, ..settings(Smoother) }
}

/// Some of everything goes missing.
pub(crate) fn holes(mut epochs: Vec<Epoch>) -> Vec<Epoch> {
    for (k, epoch) in epochs.iter_mut().enumerate() {
        if k % 13 == 5 || (700..760).contains(&k) {
            epoch.readout[1] = f64::NAN;
        }
        if k % 17 == 3 {
            epoch.readout[9] = f64::NAN;
        }
        if k % 211 == 100 || (1200..1300).contains(&k) {
            epoch.command[4] = f64::NAN;
        }
    }
    epochs
}

/// Version of the layout; states of the tests are saved and read with the same one.
const VERSION: u32 = 1;

fn save(stage: &mut Reconstruction) -> Vec<u8> {
    state::save("hinf-dfacs", VERSION, |state| stage.visit(state)).expect("a state")
}

fn load(stage: &mut Reconstruction, bytes: &[u8]) -> Result<(), StateError> {
    state::load("hinf-dfacs", VERSION, bytes, |state| stage.visit(state))
}

#[test]
fn one_row_per_epoch_in_order() {
    let mission = mission();
    let lag = stage(&mission, &settings(Smoother)).lag();
    let (epochs, _) = telemetry(&mission, 4 * lag + 7);
    for n in [0, 1, 2, 3, lag, 2 * lag - 1, 2 * lag, 2 * lag + 1, 4 * lag + 7] {
        let rows = run(&mut stage(&mission, &settings(Smoother)), &epochs[..n]);
        let times: Vec<_> = rows.iter().map(|r| r.time_ns).collect();
        let want: Vec<_> = epochs[..n].iter().map(|e| e.time_ns).collect();
        assert_eq!(times, want);
    }
}

/// A new stage after every batch, with the state of the old one: neither the batches nor the states can be seen.
#[test]
fn saved_and_loaded_it_goes_on_bit_by_bit() {
    let mission = late(mission());
    let epochs = holes(telemetry(&mission, 2600).0);
    for settings in [with_replay(), Settings { needs: EVERYTHING, ..with_replay() }] {
        let whole = bits(&run(&mut stage(&mission, &settings), &epochs));
        for batch in [1, 777, 2600] {
            let mut rows = Vec::new();
            let mut current = stage(&mission, &settings);
            for epochs in epochs.chunks(batch) {
                let mut next = stage(&mission, &settings);
                load(&mut next, &save(&mut current)).expect("its own state");
                assert_eq!(save(&mut next), save(&mut current));
                for epoch in epochs {
                    next.push(epoch, &mut rows).expect("the law takes its own state");
                }
                current = next;
            }
            current.finish(&mut rows);
            assert!(bits(&rows) == whole, "batches of {batch} give other rows");
        }
    }
}

#[test]
fn damaged_states_are_refused() {
    let mission = mission();
    let mut full = stage(&mission, &with_replay());
    for epoch in telemetry(&mission, 50).0 {
        full.push(&epoch, &mut Vec::new()).expect("the law takes its own state");
    }
    let state = save(&mut full);
    for length in (0..state.len()).step_by(101) {
        let refused = load(&mut stage(&mission, &with_replay()), &state[..length]);
        assert!(refused.is_err(), "{length} of {} bytes", state.len());
    }
    let longer = state::save("hinf-dfacs", VERSION, |state| full.visit(state).and_then(|()| state.u64(&mut 0)));
    let refused = load(&mut stage(&mission, &with_replay()), &longer.expect("a state")).expect_err("it is too long");
    assert_eq!(refused, StateError::Content("more"));
    let refused = load(&mut stage(&mission, &settings(Smoother)), &state).expect_err("it replays nothing");
    assert_eq!(refused, StateError::Content("a replay of commands"));
    let asking = Settings { needs: EVERYTHING, ..with_replay() };
    let refused = load(&mut stage(&mission, &asking), &state).expect_err("it lacks what is needed");
    assert!(refused.to_string().contains("effects need [commands, torque-response"), "{refused}");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]
    /// Words that no state holds, bare and under the header and checksum of a state of this mission and model.
    #[test]
    fn garbage_is_refused(mut words in proptest::collection::vec(any::<u64>(), 0..500), enveloped: bool) {
        let mut reconstruction = stage(&mission(), &settings(Smoother));
        let bytes = if enveloped {
            state::save::<StateError>("hinf-dfacs", VERSION, |state| {
                state.same("mission", "2 test masses")?;
                state.same("model", "one whose effects need []")?;
                words.iter_mut().try_for_each(|word| state.u64(word))
            })
            .expect("a state")
        } else {
            words.iter().flat_map(|word| word.to_le_bytes()).collect()
        };
        prop_assert!(load(&mut reconstruction, &bytes).is_err());
    }
}

/// Without sensing the commands still tell the acceleration; a channel needs its three samples.
#[test]
fn missing_sensing_leaves_the_acceleration() {
    let mission = mission();
    let (mut epochs, truth) = telemetry(&mission, 3000);
    let lost = 1500..1510;
    for epoch in &mut epochs[lost.clone()] {
        epoch.readout[0] = f64::NAN;
    }
    let mut stage = stage(&mission, &settings(Smoother));
    let rows = run(&mut stage, &epochs);
    for (k, row) in rows.iter().enumerate().take(2999).skip(1) {
        assert!(row.values[..CHANNELS_AT].iter().all(|v| v.is_finite()), "epoch {k}");
        let channel = row.values[CHANNELS_AT + 6].is_finite();
        assert_eq!(channel, !(lost.start - 1..lost.end + 1).contains(&k), "epoch {k}");
    }
    assert_eq!(stage.counts().attitude_missing, 10);
    // The error is the thrusters' noise, sensed or not, for such a short time.
    let noise = (0.5 * levels(&mission)[0] * RATE_HZ * 3.0).sqrt() / 800.0;
    let error = (1490..1520).map(|k| (alpha(&rows[k]) - truth[k]).norm()).fold(0.0, f64::max);
    assert!(error < 4.0 * noise, "{error} against {noise}");
}

/// Hours without sensing leave commands alone: from the smoother's memory of 2.8 s into the gap to as long before its
/// end nothing is given for the acceleration, whatever the blocks. The truth there regressed on the command has a slope
/// far below one.
#[test]
fn without_sensing_for_hours_no_acceleration_is_invented() {
    let mission = mission();
    let (mut epochs, truth) = telemetry(&mission, 80_000);
    let commanded = run(&mut stage(&mission, &settings(Commanded)), &epochs);
    let lost = 2_000..76_000;
    for epoch in &mut epochs[lost.clone()] {
        epoch.readout[..3].fill(f64::NAN);
    }
    let mut stage = stage(&mission, &settings(Smoother));
    let rows = run(&mut stage, &epochs);
    let unknown: Vec<usize> = (0..80_000).filter(|k| alpha(&rows[*k]).x.is_nan()).collect();
    let first = unknown.first().expect("the gap is long") - lost.start;
    assert!((20..40).contains(&first), "{first}");
    assert_eq!(unknown, (lost.start + first..lost.end - first).collect::<Vec<_>>());
    assert_eq!(stage.counts().alpha_unknown, unknown.len() as u64);
    assert!(rows.iter().all(|row| u1(row).x.is_finite()));

    // Means over 5 s: what is below 0.1 Hz.
    let (mut cross, mut auto) = (0.0, 0.0);
    for k in (lost.start..lost.end - 50).step_by(50) {
        let mean = |of: &dyn Fn(usize) -> f64| (k..k + 50).map(of).sum::<f64>();
        let (a, c) = (mean(&|k| truth[k].y), mean(&|k| alpha(&commanded[k]).y));
        cross += a * c;
        auto += c * c;
    }
    assert!(cross / auto < 0.9, "slope {}", cross / auto);
}

#[test]
fn a_missing_command_costs_its_interval() {
    let mission = mission();
    let (mut epochs, truth) = telemetry(&mission, 3000);
    epochs[1500].command[4] = f64::NAN;
    let mut stage = stage(&mission, &settings(Smoother));
    let rows = run(&mut stage, &epochs);
    for (k, row) in rows.iter().enumerate().take(2999).skip(1) {
        assert_eq!(alpha(row).x.is_finite(), k != 1500, "epoch {k}");
        assert_eq!(u1(row).x.is_finite(), k != 1500, "epoch {k}");
        let channels = row.values[CHANNELS_AT..].iter().filter(|v| v.is_finite()).count();
        assert_eq!(channels, if k == 1500 || k == 1501 { 0 } else { 9 }, "epoch {k}");
    }
    assert_eq!(stage.counts().commands_missing, 1);
    let noise = (0.5 * levels(&mission)[0] * RATE_HZ * 3.0).sqrt() / 800.0;
    let near = (1400..1600).filter(|k| *k != 1500);
    let error = near.map(|k| (alpha(&rows[k]) - truth[k]).norm()).fold(0.0, f64::max);
    assert!(error < 5.0 * noise, "{error} against {noise}");
}

/// An hour of nothing: rows of nothing, and then as good as new.
#[test]
fn after_an_hour_of_nothing_it_starts_afresh() {
    let mission = mission();
    let (mut epochs, truth) = telemetry(&mission, 40_000);
    for epoch in &mut epochs[2000..38_000] {
        epoch.readout = still().map(|_| f64::NAN);
        epoch.command = unknown();
    }
    let rows = run(&mut stage(&mission, &with_replay()), &epochs);
    assert_eq!(rows.len(), epochs.len());
    // The first lost command comes from readouts that were there.
    assert!(alpha(&rows[2000]).x.is_finite() && u1(&rows[2000]).x.is_finite());
    assert!(rows[2001..38_000].iter().all(|row| alpha(row).x.is_nan() && u1(row).x.is_nan()));
    let error = |range: std::ops::Range<usize>| rms(range.map(|k| alpha(&rows[k]) - truth[k]));
    // 1500 samples of three axes: 1.5 % each, so 10 % is nearly five standard deviations of the ratio.
    let ratio = error(38_000..39_500) / error(300..1800);
    assert!((ratio - 1.0).abs() < 0.1, "{ratio}");
}

/// Without `/command` the law stands in, and from the same start it repeats what flew.
#[test]
fn replayed_commands_are_the_flown_ones() {
    let mission = mission();
    let (mut epochs, _) = telemetry(&mission, 4000);
    let flown = run(&mut stage(&mission, &settings(Smoother)), &epochs);
    for epoch in &mut epochs {
        epoch.command = unknown();
    }
    let alone = Settings { commands: false, ..with_replay() };
    let mut replaying = stage(&mission, &alone);
    let rows = run(&mut replaying, &epochs);
    assert!(rows[..600].iter().all(|row| u1(row).x.is_nan()), "the law settles for 60 s");
    for k in 600..4000 {
        assert_eq!(u1(&rows[k]), u1(&flown[k]), "epoch {k}");
    }
    assert_eq!((replaying.counts().commands_replayed, replaying.counts().commands_missing), (3400, 600));
    assert!(replaying.comparison().is_none());

    // From the middle of a flight the integrators' states are unknown: a constant torque, which the wandering part of
    // the smoother's model takes up.
    let late = run(&mut stage(&mission, &alone), &epochs[1000..]);
    let difference = rms((2000..3900).map(|k| alpha(&late[k - 1000]) - alpha(&flown[k])));
    let size = rms((2000..3900).map(|k| alpha(&flown[k])));
    assert!(difference < 1e-2 * size, "{difference} against {size}");
}

#[test]
fn a_lost_command_is_filled_only_by_the_law_that_flew() {
    let ours = mission();
    let mut other = ours.clone();
    if let Some(requirements) = &mut other.requirements {
        requirements.sc_attitude_rad_rthz *= 3.0;
    }
    // Designed anew for the other requirement.
    other.control.as_mut().expect("the fixture has a loop").channel.clear();
    for (flying, same) in [(&ours, true), (&other, false)] {
        let (mut epochs, _) = telemetry(flying, 4000);
        let complete = run(&mut stage(&ours, &settings(Smoother)), &epochs);
        for k in [500, 3000, 3001] {
            epochs[k].command[0] = f64::NAN;
        }
        let mut stage = stage(&ours, &with_replay());
        let rows = run(&mut stage, &epochs);
        let comparison = stage.comparison().expect("both were there");
        assert_eq!(comparison.same_law(), same, "{:?}", comparison.rms_distance());
        assert_eq!(comparison.samples(), 4000 - 600 - 2);
        if same {
            assert!(comparison.rms_distance().iter().all(|d| *d < 1e-20), "{:?}", comparison.rms_distance());
            assert!((alpha(&rows[3000]) - alpha(&complete[3000])).norm() < 1e-18);
        }
        let filled = stage.counts().commands_replayed;
        assert_eq!(filled, if same { 2 } else { 0 });
        assert_eq!(stage.counts().commands_missing, 3 - filled);
    }
}

/// After a readout that was lost on the way down the law here does not command what the one on board did, for a second:
/// from the next command on, as there is a sample between a readout and the command that comes from it.
#[test]
fn a_replayed_command_waits_after_a_lost_readout() {
    let mission = mission();
    let (mut epochs, _) = telemetry(&mission, 4000);
    epochs[3000].readout[3] = f64::NAN;
    for k in [3000, 3003, 3050] {
        epochs[k].command[0] = f64::NAN;
    }
    let mut stage = stage(&mission, &with_replay());
    run(&mut stage, &epochs);
    assert_eq!((stage.counts().commands_replayed, stage.counts().commands_missing), (2, 1));
    let comparison = stage.comparison().expect("both were there");
    assert!(comparison.rms_distance().iter().all(|d| *d < 1e-20), "{:?}", comparison.rms_distance());
}

/// A spacecraft that follows CRF as it turns: sensing sees nothing, and the inertial motion is CRF's own.
#[test]
fn the_turning_of_the_constellation_is_added() {
    let mission = mission();
    let (omega_crf, alpha_crf) = (Vector3::new(0.0, 1e-7, 2e-7), Vector3::new(3e-13, 0.0, -2e-13));
    let rate = Vector3::new(1e-7, 0.0, 0.0);
    let epochs: Vec<_> = (0..3000)
        .map(|k| {
            let mut readout = still();
            readout[0] = rate.x * f64::from(k) / RATE_HZ;
            Epoch {
                time_ns: i64::from(k) * 100_000_000,
                readout,
                command: unknown().map(|_| 0.0),
                sun_srf: Vector3::from_element(f64::NAN),
                ephemeris_age_s: f64::NAN,
                // Once a minute; held in between.
                omega_crf_rad_s: if k % 600 == 0 { omega_crf } else { Vector3::from_element(f64::NAN) },
                alpha_crf_rad_s2: if k % 600 == 0 { alpha_crf } else { Vector3::from_element(f64::NAN) },
            }
        })
        .collect();
    let rows = run(&mut stage(&mission, &settings(Smoother)), &epochs);
    // ω̇_SI = ω̇_CI − ω_SC×ω_CI = ω̇_CI − 1e-7·(0, −2e-7, 1e-7).
    let want = alpha_crf + Vector3::new(0.0, 2e-14, -1e-14);
    for row in &rows[1000..2000] {
        assert!((alpha(row) - want).norm() < 1e-16, "{} against {want}", alpha(row));
        let omega = Vector3::from_column_slice(&row.values[3..6]);
        assert!((omega - omega_crf - rate).norm() < 1e-12, "{omega}");
    }
}

#[test]
fn sunlight_that_nobody_has_seen_yet_is_not_guessed() {
    let mut mission = mission();
    let (mut epochs, _) = telemetry(&mission, 1000);
    mission.solar_pressure = Mission::from_json(
        &toml::from_str::<serde_json::Value>(include_str!("../../../../fixtures/missions/taiji.toml"))
            .expect("the fixture is TOML")
            .to_string(),
    )
    .expect("the fixture is a mission")
    .solar_pressure;
    epochs[100].sun_srf = Vector3::x();
    let mut stage: Reconstruction = stage(&mission, &Settings { sun: true, ..settings(Smoother) });
    let rows = run(&mut stage, &epochs);
    assert_eq!(stage.counts().sun_missing, 100);
    for (k, row) in rows.iter().enumerate() {
        assert_eq!(u1(row).x.is_finite(), k >= 100, "epoch {k}");
    }
}

/// Holes of up to five readouts are bridged in the channels alone: these have a value everywhere, off by the readout's
/// noise differenced twice, while the readouts stay missing; a hole of six is a hole.
#[test]
fn short_holes_are_bridged_in_the_channels_alone() {
    let m = mission();
    let (epochs, _) = telemetry(&m, 4000);
    let sigma_m = 1e-9;
    let mut random = Xoshiro256PlusPlus::seed_from_u64(3);
    let noisy: Vec<Epoch> = epochs
        .into_iter()
        .map(|mut e| {
            for i in 3..15 {
                e.readout[i] = sigma_m * Distribution::<f64>::sample(&StandardNormal, &mut random);
            }
            e
        })
        .collect();
    let mut holed = noisy.clone();
    let holes: Vec<usize> = (200..3800).step_by(100).collect();
    for (n, first) in holes.iter().enumerate() {
        for k in 0..=n % 6 {
            holed[first + k].readout[4] = f64::NAN;
        }
    }
    let whole = run(&mut stage(&m, &settings(Smoother)), &noisy);
    let mut tested = stage(&m, &settings(Smoother));
    let rows = run(&mut tested, &holed);
    let (mut squares, mut count) = (0.0, 0.0);
    for (n, first) in holes.iter().enumerate() {
        let size = n % 6 + 1;
        for k in *first..first + size {
            assert!(rows[k].values[7].is_nan(), "the readout stays missing");
            let (got, want) = (rows[k].values[CHANNELS_AT + 1], whole[k].values[CHANNELS_AT + 1]);
            assert_eq!(got.is_nan(), size == 6, "hole of {size}");
            if size == 1 {
                squares += ((got - want) / (2.0 * sigma_m * RATE_HZ * RATE_HZ)).powi(2);
                count += 1.0;
            }
        }
    }
    // Weights −1/6, 2/3, 2/3, −1/6 and the missing noise itself: variance 1 + 0.944. χ² of six holes at 1e-4: 0.11 to
    // 4.6.
    let ratio: f64 = squares / count / 1.944;
    assert!(count == 6.0 && (0.11..4.6).contains(&ratio), "{ratio}");
    assert_eq!(tested.counts().readouts_bridged, 6 * (1 + 2 + 3 + 4 + 5));
}

/// Without a word of the second test mass's electrodes the first goes on, its û off by the recoil alone; the second has
/// none.
#[test]
fn one_silent_test_mass_does_not_silence_the_other() {
    let m = mission();
    let (mut epochs, _) = telemetry(&m, 2000);
    for e in &mut epochs {
        e.command[12..].fill(0.0);
        e.command[13] = 1e-9;
    }
    let whole = run(&mut stage(&m, &settings(Smoother)), &epochs);
    for e in &mut epochs {
        e.command[12..].fill(f64::NAN);
        e.readout[9..].fill(f64::NAN);
    }
    let mut tested = stage(&m, &settings(Smoother));
    let rows = run(&mut tested, &epochs);
    for (a, b) in rows.iter().zip(&whole) {
        assert!((u1(a) - u1(b)).norm() < 1e-9 / m.spacecraft.mass_kg * 1.001);
        assert!((alpha(a) - alpha(b)).norm() < 1e-11 && alpha(a).iter().all(|x| x.is_finite()));
        assert!(a.values[15..18].iter().all(|x| x.is_nan()), "û of the silent one");
    }
    let counts = tested.counts();
    assert_eq!((counts.commands_of_one_test_mass, counts.commands_missing), (2000, 0));
}

/// Levels measured in 55 minutes: with the mission's own noise nothing replaces it, and torque three times as loud
/// about one axis, or sensing twice, are found. The torque's level rests on 14 bins of 31 segments; both overlap, and
/// its σ is √(0.034 · 1.94 / 14) = 0.07; 4σ either way for three axes, two false alarms in ten thousand. The sensing's
/// is known to half a per cent.
#[test]
fn the_first_stretch_tells_the_levels_of_the_noise() {
    let m = mission();
    let measured = |torque: f64, sensing: f64, seed: u64| {
        let [t, s] = levels(&m).map(|psd| (0.5 * psd * RATE_HZ).sqrt());
        let mut random = Xoshiro256PlusPlus::seed_from_u64(seed);
        let mut body = AttitudeLoop::new(&m);
        let epochs: Vec<Epoch> = (0..noise_calibration::length(RATE_HZ))
            .map(|_| {
                let mut gauss = |sigma: f64| {
                    Vector3::from_fn(|_, _| sigma * Distribution::<f64>::sample(&StandardNormal, &mut random))
                };
                let push = gauss(t).component_mul(&Vector3::new(1.0, torque, 1.0));
                body.step(&push, &gauss(s * sensing)).0
            })
            .collect();
        let rows = run(&mut stage(&m, &settings(Smoother)), &epochs);
        let (held, readout) = levels_of(&m).expect("the fixture has noise");
        let channels: Vec<_> = rows.iter().map(Row::attitude_channels).collect();
        noise_calibration::measure(&channels, RATE_HZ, &held, readout)
    };
    for seed in 1..=3 {
        assert_eq!(measured(1.0, 1.0, seed), noise_calibration::NoiseScale::nominal());
    }
    let loud = measured(3.0, 1.0, 4);
    assert!((loud.torque.y / 9.0 - 1.0).abs() < 0.2 && loud.torque.x == 1.0 && loud.torque.z == 1.0, "{loud:?}");
    let quiet = measured(0.3, 1.0, 5);
    assert!((quiet.torque.y / 0.09 - 1.0).abs() < 0.3, "{quiet:?}");
    let blurred = measured(1.0, 2.0, 6);
    assert!((blurred.sensing / 4.0 - 1.0).abs() < 0.02, "{blurred:?}");
}
