//! Prediction mode: rows depend on commands and past readouts alone, but for channels over a few missing readouts.

use dragfree_hinf_dfacs::on_demand::Needs;
use dragfree_hinf_dfacs::reconstruction::AngularAcceleration::{Commanded, Smoother};
use dragfree_hinf_dfacs::reconstruction::{Epoch, Row, Settings};
use dragfree_physics::mission::Mission;
use nalgebra::Vector3;

use crate::common::{EVERYTHING, mission, run, settings, stage};
use crate::correlation::layout;
use crate::stream::{alpha, holes, telemetry, with_replay};

/// First of the nine channels in a row.
const CHANNELS_AT: usize = 18;
const PREDICTING: Needs = Needs { prediction: true, ..EVERYTHING };

fn with_layout() -> Mission {
    Mission { thrusters: Some(layout()), ..mission() }
}

fn bits<'a>(values: impl IntoIterator<Item = &'a f64>) -> Vec<u64> {
    values.into_iter().map(|x| x.to_bits()).collect()
}

/// Values from which effects make regressors.
fn regressors(row: &Row) -> Vec<u64> {
    bits(row.values[..CHANNELS_AT].iter().chain(&row.on_demand))
}

/// Later readouts of all instruments change, one of them from missing to there, while commands stay as they flew.
#[test]
fn a_row_does_not_depend_on_later_readouts() {
    const CHANGED: usize = 1500;
    let mission = with_layout();
    let epochs = holes(telemetry(&mission, 2600).0);
    let mut other: Vec<Epoch> = epochs.clone();
    for (k, epoch) in other.iter_mut().enumerate().skip(CHANGED) {
        for (i, readout) in epoch.readout.iter_mut().enumerate() {
            *readout = if readout.is_nan() { 0.0 } else { *readout + 1e-9 * ((k * 7 + i) as f64).sin() };
        }
    }
    let rows = |needs: Needs, epochs: &[Epoch]| run(&mut stage(&mission, &Settings { needs, ..with_replay() }), epochs);
    let [before, after] = [&epochs, &other].map(|epochs| rows(PREDICTING, epochs));
    for k in 0..CHANGED {
        assert_eq!(regressors(&before[k]), regressors(&after[k]), "epoch {k}");
        // A channel's sample is complete with the next readout; beside a missing one, with the second after that.
        let channels = |rows: &[Row]| bits(&rows[k].values[CHANNELS_AT..]);
        assert!(k + 3 > CHANGED || channels(&before) == channels(&after), "epoch {k}");
    }
    assert_ne!(regressors(&before[CHANGED]), regressors(&after[CHANGED]));

    // The twin: the smoother uses them, and channels and û with it.
    let [before, after] = [&epochs, &other].map(|epochs| rows(EVERYTHING, epochs));
    let distinct = |columns: std::ops::Range<usize>| {
        (0..CHANGED).any(|k| before[k].values[columns.clone()] != after[k].values[columns.clone()])
    };
    assert!(distinct(0..3) && distinct(3..6) && distinct(9..12) && distinct(15..18));
}

/// The angular acceleration is the commanded one even where no readout is near, and `û` is that of thrusters without a
/// layout, whose torque has no force.
#[test]
fn acceleration_is_known_by_commands_alone() {
    let mut epochs = holes(telemetry(&mission(), 2600).0);
    epochs[1400..2400].iter_mut().for_each(|epoch| epoch.readout[..3].fill(f64::NAN));
    let with = |mission: &Mission, settings: &Settings| run(&mut stage(mission, settings), &epochs);
    let asked = Settings { needs: PREDICTING, ..settings(Smoother) };
    let predicted = with(&with_layout(), &asked);
    let [commanded, without_layout] = [with_layout(), mission()].map(|m| with(&m, &settings(Commanded)));
    let smoothed = with(&with_layout(), &settings(Smoother));
    let of = |rows: &[Row], columns: std::ops::Range<usize>| -> Vec<u64> {
        rows.iter().flat_map(|row| bits(&row.values[columns.clone()])).collect()
    };
    assert!(of(&predicted, 0..3) == of(&commanded, 0..3));
    assert!(of(&predicted, 0..3) != of(&smoothed, 0..3));
    let unknown = |rows: &[Row]| rows.iter().filter(|row| alpha(row).x.is_nan()).count();
    assert!(unknown(&smoothed) > unknown(&predicted));
    for u in [9..12, 15..18] {
        assert!(of(&predicted, u.clone()) == of(&without_layout, u.clone()));
        assert!(of(&predicted, u.clone()) != of(&smoothed, u));
    }
}

/// A short gap is interpolated in the channels by two later readouts, in prediction mode too: a filter that had to
/// begin anew after each would not settle where one packet in a thousand is lost. What is known of the motion does not
/// change.
#[test]
fn short_gaps_are_bridged_in_the_channels() {
    let (complete, _) = telemetry(&mission(), 200);
    let mut epochs = complete.clone();
    epochs[100].readout[3] = f64::NAN;
    for needs in [Needs::default(), PREDICTING] {
        let settings = Settings { needs, ..settings(Smoother) };
        let mut stage = stage(&mission(), &settings);
        let rows = run(&mut stage, &epochs);
        assert!((1..199).all(|k| rows[k].values[CHANNELS_AT].is_finite()));
        assert_eq!(stage.counts().readouts_bridged, 1);
        let whole = run(&mut crate::common::stage(&mission(), &settings), &complete);
        let known = |rows: &[Row]| rows.iter().flat_map(|row| bits(&row.values[9..12])).collect::<Vec<_>>();
        assert!(known(&rows) == known(&whole));
    }
}

/// A gain acts as the torque alone does, and a delay of the readout on nothing that commands make.
#[test]
fn responses_are_those_of_commands() {
    let mission = with_layout();
    let epochs = telemetry(&mission, 1200).0;
    let mut stage = stage(&mission, &Settings { needs: PREDICTING, ..settings(Smoother) });
    let rows = run(&mut stage, &epochs);
    let names: Vec<String> = stage.on_demand_columns().into_iter().map(|(name, _, _)| name).collect();
    let at = |name: &str| names.iter().position(|n| n == name).unwrap_or_else(|| panic!("no {name}"));
    let inverse = mission.spacecraft.inertia_inverse();
    for (about, letter) in ["x", "y", "z"].into_iter().enumerate() {
        let first = at(&format!("response.alpha_srf_rad_s2.by_torque_gain.{letter}.x"));
        for (row, epoch) in rows.iter().zip(&epochs) {
            let got = Vector3::from_column_slice(&row.on_demand[first..first + 3]);
            let want = inverse.column(about) * epoch.command[3 + about];
            assert!((got - want).norm() <= 1e-15 * want.norm(), "{got} against {want}");
        }
    }
    let zero = |name: &str| {
        let first = at(name);
        assert!(rows.iter().all(|row| row.on_demand[first..first + 3] == [0.0; 3]), "{name}");
    };
    zero("response.u_orf_m_s2.by_torque_gain.x.tm1.x");
    zero("response.u_orf_m_s2.by_torque_gain.z.tm2.x");
    zero("response.alpha_srf_rad_s2.by_dws_delay.x");
}
