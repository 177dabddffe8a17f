//! Whole tables through the gridder.

use dragfree_sdk::state::{self, StateError};
use proptest::prelude::*;

use crate::gridder::{Config, Gridder, MAX_ROWS, Sink};
use crate::layout::{TableSpec, table_spec};
use crate::series::Reason;
use crate::testing::{Noise, columns};

const DT: i64 = 100_000_000;
const SECOND: i64 = 1_000_000_000;
/// Start time that is not a multiple of the period or a second.
const START: i64 = 2_051_222_400_123_456_789;

/// A table of telemetry: name, names of columns, rows.
#[derive(Clone)]
struct Telemetry {
    name: &'static str,
    columns: Vec<&'static str>,
    rows: Vec<(i64, Vec<f64>)>,
}

const IS: [&str; 5] = ["tm1.r_orf_m.x", "tm1.r_orf_m.y", "tm1.r_orf_m.z", "tm1.att_orf_rad.phi", "tm1.status"];
const DWS: [&str; 5] = ["tm1.theta_orf_rad", "sc_crf_rad.phi", "sc_crf_rad.theta", "sc_crf_rad.psi", "status"];

fn saved(gridder: &mut Gridder) -> Vec<u8> {
    state::save("preprocess", 1, |state| gridder.visit(state)).expect("a state")
}

fn load(gridder: &mut Gridder, bytes: &[u8]) -> Result<(), StateError> {
    state::load("preprocess", 1, bytes, |state| gridder.visit(state))
}

/// A table of white noise of 1e-9 on a slow oscillation; columns named `status` are zero.
fn telemetry(name: &'static str, columns: &[&'static str], times: impl Iterator<Item = i64>, seed: u64) -> Telemetry {
    let mut noise = Noise::new(seed);
    let value = |column: &str, t: i64, noise: &mut Noise| {
        if column.ends_with("status") { 0.0 } else { 1e-9 * (noise.gauss() + 5.0 * ((t - START) as f64 * 1e-10).sin()) }
    };
    let rows = times.map(|t| (t, columns.iter().map(|c| value(c, t, &mut noise)).collect())).collect();
    Telemetry { name, columns: columns.to_vec(), rows }
}

fn steady(rows: i64) -> impl Iterator<Item = i64> {
    (0..rows).map(|k| START + k * DT)
}

fn is_and_dws(rows: i64) -> Vec<Telemetry> {
    vec![telemetry("is", &IS, steady(rows), 1), telemetry("dws", &DWS, steady(rows), 2)]
}

fn config() -> Config {
    Config {
        rate_hz: 10.0,
        outlier_sigma: 20.0,
        stuck_samples: 10,
        hold_intervals: 2.0,
        max_gap_s: 21_600.0,
        counted_from_ns: i64::MIN,
    }
}

fn spec(t: &Telemetry) -> TableSpec {
    let owned = columns(t.name, &t.columns);
    let limits = dragfree_physics::mission::Limits { displacement_m: 1e-4, angle_rad: 1e-3 };
    table_spec(t.name, &owned.iter().collect::<Vec<_>>(), matches!(t.name, "is" | "dws"), &["tm1"], Some(&limits))
}

/// Output of the gridder.
#[derive(Clone, Default)]
struct Grid {
    times: Vec<i64>,
    tables: Vec<Vec<Vec<f64>>>,
    ages: Vec<Vec<f64>>,
    largest_call: usize,
}

impl Sink for Grid {
    fn times(&mut self) -> &mut Vec<i64> {
        &mut self.times
    }
    fn column(&mut self, table: usize, column: usize) -> &mut Vec<f64> {
        &mut self.tables[table][column]
    }
    fn age(&mut self, table: usize) -> Option<&mut Vec<f64>> {
        self.ages.get_mut(table)
    }
}

impl Grid {
    fn bits(&self) -> (Vec<i64>, Vec<Vec<Vec<u64>>>) {
        let bits = |t: &Vec<Vec<f64>>| t.iter().map(|c| c.iter().map(|v| v.to_bits()).collect()).collect();
        (self.times.clone(), self.tables.iter().map(bits).collect())
    }
}

/// Runs telemetry through a gridder in pieces of `piece` rows of the first table; saves and restores after each piece
/// for which `restore` is true. Rows keep their order; a row belongs to the piece of the latest time so far.
fn run_with(tables: &[Telemetry], config: &Config, piece: usize, restore: impl Fn(usize) -> bool) -> (Grid, Gridder) {
    let mut gridder = Gridder::new(config.clone(), tables.iter().map(spec).collect());
    let mut grid = Grid {
        tables: tables.iter().map(|t| vec![Vec::new(); t.columns.len()]).collect(),
        ages: vec![Vec::new(); tables.len()],
        ..Grid::default()
    };
    let mut cuts: Vec<i64> = tables[0].rows.iter().skip(piece).step_by(piece).map(|r| r.0).collect();
    let mut latest = i64::MIN;
    cuts.retain(|t| {
        let later = *t > latest;
        latest = latest.max(*t);
        later
    });
    let last = tables.iter().flat_map(|t| t.rows.iter().map(|r| r.0)).max().unwrap_or(0);
    cuts.push(last.max(cuts.last().copied().unwrap_or(0)) + 1);
    let mut next = vec![0; tables.len()];
    for (n, cut) in cuts.into_iter().enumerate() {
        for (t, table) in tables.iter().enumerate() {
            let from = next[t];
            while next[t] < table.rows.len() && table.rows[next[t]].0 < cut {
                next[t] += 1;
            }
            let rows = &table.rows[from..next[t]];
            let times: Vec<i64> = rows.iter().map(|r| r.0).collect();
            let values: Vec<Vec<f64>> =
                (0..table.columns.len()).map(|c| rows.iter().map(|r| r.1[c]).collect()).collect();
            gridder.take(t, &times, &values.iter().map(Vec::as_slice).collect::<Vec<_>>());
        }
        let before = grid.times.len();
        gridder.advance(cut, &mut grid);
        grid.largest_call = grid.largest_call.max(grid.times.len() - before);
        if restore(n) {
            let state = saved(&mut gridder);
            let mut other = Gridder::new(config.clone(), tables.iter().map(spec).collect());
            load(&mut other, &state).unwrap();
            assert!(saved(&mut other) == state);
            gridder = other;
        }
    }
    gridder.flush(&mut grid);
    for column in grid.tables.iter().flatten().chain(&grid.ages) {
        assert_eq!(column.len(), grid.times.len());
    }
    assert!(grid.times.windows(2).all(|w| w[0] < w[1]));
    assert_eq!(gridder.summary.used + gridder.summary.rejected, grid.times.len() as u64);
    (grid, gridder)
}

fn run(tables: &[Telemetry]) -> (Grid, Gridder) {
    run_with(tables, &config(), 500, |_| false)
}

fn count(gridder: &Gridder, table: usize, reason: Reason) -> u64 {
    gridder.tables[table].tally.get(reason)
}

/// Asserts that every row is on the grid, waits for interpolation, or is counted.
fn assert_accounted(gridder: &Gridder) {
    use Reason::{BadTime, BeforeJump, Conflicting, Crowded, Duplicate, Late, Outside};
    for series in &gridder.tables {
        let refused: u64 = [BadTime, BeforeJump, Conflicting, Crowded, Duplicate, Late, Outside]
            .map(|reason| series.tally.get(reason))
            .iter()
            .sum();
        let waiting = series.times.len() as u64;
        assert_eq!(
            series.tally.rows_in,
            series.tally.rows_placed + refused + waiting,
            "{}: {:?}",
            series.spec.name,
            series.tally
        );
    }
}

#[test]
fn clean_telemetry_is_unchanged() {
    let tables = is_and_dws(20_000);
    let (grid, gridder) = run(&tables);
    assert_eq!(grid.times, steady(20_000).collect::<Vec<_>>());
    for (t, table) in tables.iter().enumerate() {
        for c in 0..table.columns.len() {
            assert!(table.rows.iter().zip(&grid.tables[t][c]).all(|(row, v)| row.1[c].to_bits() == v.to_bits()));
        }
    }
    assert_eq!((gridder.summary.used, gridder.summary.rejected), (20_000, 0));
    assert!(Reason::ALL.iter().all(|(reason, _)| count(&gridder, 0, *reason) == 0));
    assert_accounted(&gridder);
}

#[test]
fn jitter_below_half_an_interval_loses_no_sample() {
    let mut noise = Noise::new(4);
    let times: Vec<i64> = steady(20_000).map(|t| t + ((noise.uniform() - 0.5) * 0.45 * DT as f64) as i64).collect();
    let mut tables = is_and_dws(20_000);
    tables[0] = telemetry("is", &IS, times.into_iter(), 1);
    let (grid, gridder) = run(&tables);
    let values: Vec<f64> = tables[0].rows.iter().map(|r| r.1[0]).collect();
    assert_eq!(grid.tables[0][0], values);
    assert_eq!(gridder.summary.rejected, 0);
    // Epochs are DT apart, in the middle of the jitter: median of 20 samples, uniform within ±0.225 DT.
    assert!(grid.times.windows(2).all(|w| w[1] - w[0] == DT));
    assert!((grid.times[0] - START).abs() < DT * 15 / 100);
}

#[test]
fn a_constant_phase_of_a_table_is_measured() {
    let mut tables = is_and_dws(9_000);
    tables[1] = telemetry("dws", &DWS, steady(9_000).map(|t| t + 49_999_999), 2);
    let (grid, gridder) = run(&tables);
    assert_eq!(grid.times[0], START);
    assert_eq!(grid.tables[1][1], tables[1].rows.iter().map(|r| r.1[1]).collect::<Vec<_>>());
    assert_eq!(gridder.table_summaries()[1].phase_s, Some(0.049_999_999));
}

#[test]
fn a_gap_becomes_blank_rows_and_is_reported() {
    let keep = |k: &i64| !(3_000..39_000).contains(k);
    let times: Vec<i64> = (0..45_000).filter(keep).map(|k| START + k * DT).collect();
    let tables = vec![telemetry("is", &IS, times.iter().copied(), 1), telemetry("dws", &DWS, times.iter().copied(), 2)];
    let (grid, gridder) = run(&tables);
    assert_eq!(grid.times, steady(45_000).collect::<Vec<_>>());
    assert_eq!((gridder.summary.used, gridder.summary.rejected), (9_000, 36_000));
    assert_eq!((gridder.summary.longest.rows, gridder.summary.longest.from_ns), (36_000, START + 3_000 * DT));
    assert!(grid.tables[0][0][3_000..39_000].iter().all(|v| v.is_nan()));
    assert_eq!(gridder.table_summaries()[0].missing, Some(36_000));
}

#[test]
fn long_gaps_are_emitted_in_bounded_pieces_or_omitted() {
    // A gap of five hours is filled; a week is omitted.
    let five_hours = 5 * 36_000;
    let week = 7 * 864_000;
    let keep = |k: &i64| *k < 8_000 || (8_000 + five_hours..16_000 + five_hours).contains(k);
    let times: Vec<i64> = (0..16_000 + five_hours)
        .filter(keep)
        .chain(20_000 + week..28_000 + week)
        .map(|k| START + k * DT + if k > week { 37_000_000 } else { 0 })
        .collect();
    let tables = vec![
        telemetry("is", &IS, times.iter().copied(), 1),
        telemetry("dws", &DWS, times.iter().copied().chain([START + week / 2 * DT]).sorted(), 2),
    ];
    let (grid, gridder) = run(&tables);
    assert!(grid.largest_call <= MAX_ROWS as usize, "{}", grid.largest_call);
    assert_eq!(grid.times.len() as i64, 16_000 + five_hours + 6_000 + 8_000);
    assert_eq!(gridder.summary.cut_gaps, 1);
    // Ten minutes of blank rows, then epochs with the new phase.
    let cut = (16_000 + five_hours) as usize;
    assert!(grid.tables[0][0][cut..cut + 6_000].iter().all(|v| v.is_nan()));
    assert_eq!(grid.times[cut + 6_000], START + (20_000 + week) * DT + 37_000_000);
    assert_eq!(gridder.summary.used, 24_000);
    assert_eq!(count(&gridder, 1, Reason::Outside), 1);
    assert_accounted(&gridder);
}

/// A gap hardly longer than the longest that is filled, after which the clock has another phase.
#[test]
fn epochs_advance_where_a_gap_is_cut_and_the_phase_changes() {
    for (first, phase_ns) in [8_009, 8_010].into_iter().flat_map(|k| [-45, -10, 10, 49].map(|ms| (k, ms * 1_000_000))) {
        let times = (0..8_000).map(|k| START + k * DT).chain((first..16_000).map(|k| START + k * DT + phase_ns));
        let tables = vec![telemetry("is", &IS, times.clone(), 1), telemetry("dws", &DWS, times, 2)];
        let (grid, gridder) = run_with(&tables, &Config { max_gap_s: 1.0, ..config() }, 700, |_| false);
        let least = grid.times.windows(2).map(|two| two[1] - two[0]).min();
        assert!(least >= Some(DT / 2), "{first}, {phase_ns}: {least:?}");
        let gap_ns = (first - 7_999) * DT + phase_ns;
        assert_eq!(gridder.summary.cut_gaps, u64::from(gap_ns > 1_000_000_000), "{first}, {phase_ns}");
    }
}

/// Sorts times, as a method of iterators.
trait Sorted: Iterator<Item = i64> + Sized {
    fn sorted(self) -> std::vec::IntoIter<i64> {
        let mut all: Vec<i64> = self.collect();
        all.sort_unstable();
        all.into_iter()
    }
}
impl<I: Iterator<Item = i64>> Sorted for I {}

#[test]
fn epochs_follow_a_clock_jump_and_no_difference_spans_it() {
    for jump_ns in
        [-65_000_000, -52_000_000, -45_000_000, -30_000_000, 26_000_000, 50_000_000, 130_000_000, 1_234_567_890]
    {
        let times: Vec<i64> = (0..9_000).map(|k| START + k * DT + if k >= 7_000 { jump_ns } else { 0 }).collect();
        let tables =
            vec![telemetry("is", &IS, times.iter().copied(), 1), telemetry("dws", &DWS, times.iter().copied(), 2)];
        let (grid, gridder) = run(&tables);
        assert_eq!(gridder.summary.rephased, 1, "{jump_ns}");
        // Every value keeps the exact time of its sample.
        for (t, table) in tables.iter().enumerate() {
            let mut found = 0;
            for (time, v) in grid.times.iter().zip(&grid.tables[t][1]).filter(|(_, v)| !v.is_nan()) {
                let row = table.rows.binary_search_by_key(time, |r| r.0).unwrap();
                assert_eq!(table.rows[row].1[1], *v);
                found += 1;
            }
            assert!(found >= if jump_ns < -DT / 2 { 8_998 } else { 8_999 }, "{jump_ns}: {found}");
            assert!(grid.times.windows(2).all(|w| w[1] - w[0] > DT / 2 && w[1] - w[0] <= DT * 3 / 2));
        }
        // Neighbouring valid rows are one interval apart.
        let full: Vec<bool> = grid.tables[0][1].iter().map(|v| !v.is_nan()).collect();
        for k in 1..full.len() {
            assert!(!(full[k - 1] && full[k]) || grid.times[k] - grid.times[k - 1] == DT, "{jump_ns} at row {k}");
        }
        assert_accounted(&gridder);
    }
}

#[test]
fn a_clock_jump_of_another_table_blanks_one_of_its_rows() {
    let mut tables = is_and_dws(9_000);
    let times = (0..9_000).map(|k| START + k * DT + if k >= 7_000 { 40_000_000 } else { 0 });
    tables[1] = telemetry("dws", &DWS, times, 2);
    let (grid, gridder) = run(&tables);
    assert_eq!(gridder.summary.rephased, 0);
    assert_eq!(count(&gridder, 1, Reason::ClockJump), 1);
    assert_eq!(gridder.summary.rejected, 1);
    assert!(grid.tables[1][1][6_999].is_nan() && !grid.tables[1][1][7_000].is_nan());
    assert_accounted(&gridder);
}

#[test]
fn a_wrong_rate_is_reported_without_interpolation() {
    for period_ns in [103_092_784, 98_039_216] {
        let times: Vec<i64> = (0..20_000).map(|k| START + k * period_ns).collect();
        let tables =
            vec![telemetry("is", &IS, times.iter().copied(), 1), telemetry("dws", &DWS, times.iter().copied(), 2)];
        let (grid, gridder) = run(&tables);
        let interval = gridder.table_summaries()[0].interval_s.unwrap();
        assert!((interval * 1e9 - period_ns as f64).abs() < 1.0);
        let mut used = 0;
        for (time, v) in grid.times.iter().zip(&grid.tables[0][1]).filter(|(_, v)| !v.is_nan()) {
            let row = tables[0].rows.partition_point(|r| r.0 < time - DT * 3 / 4);
            let near = tables[0].rows[row..].iter().take(3).find(|r| r.1[1] == *v).unwrap();
            assert!((near.0 - time).abs() <= DT * 3 / 4);
            used += 1;
        }
        // Each slip costs one row (rate too low) or two samples (too high).
        let slips = 20_000.0 * (period_ns - DT).abs() as f64 / DT as f64;
        assert!(f64::from(used) > 20_000.0 - 3.0 * slips, "{used}, {slips} slips");
        assert!(gridder.summary.rejected as f64 > 0.5 * slips, "{}", gridder.summary.rejected);
        assert_accounted(&gridder);
    }
}

#[test]
fn slow_telemetry_is_interpolated_then_held_then_missing() {
    let mut tables = is_and_dws(9_000);
    // One row every 10 s, one missing at 300 s, none from 600 s to 700 s; the value is the time in seconds.
    let seconds = (0..90).map(|k| k * 10).filter(|s| *s != 300 && !(601..700).contains(s));
    let rows = seconds.clone().map(|s| (START + s * SECOND, vec![s as f64])).collect();
    tables.push(Telemetry { name: "hk/temperature", columns: vec!["value"], rows });
    let flags = seconds.map(|s| (START + s * SECOND, vec![s as f64, (s / 100) as f64])).collect();
    tables.push(Telemetry { name: "hk/heater", columns: vec!["value", "status"], rows: flags });
    let (grid, gridder) = run(&tables);
    for (k, v) in grid.tables[2][0].iter().enumerate() {
        let second = k as f64 * 0.1;
        match second {
            s if s <= 600.0 || (700.0..=890.0).contains(&s) => assert!((v - s).abs() < 1e-9, "{s}: {v}"),
            s if s <= 620.0 => assert_eq!(*v, 600.0),
            s if s < 700.0 => assert!(v.is_nan(), "{s}: {v}"),
            _ => assert_eq!(*v, 890.0),
        }
    }
    // Age of the latest row: 0 at a row, growing over a missing one.
    let age = &grid.ages[2];
    for (second, want) in [(0.0, 0.0), (9.9, 9.9), (10.0, 0.0), (305.0, 15.0), (615.0, 15.0), (700.0, 0.0)] {
        assert!((age[(second * 10.0) as usize] - want).abs() < 1e-6, "{second} s: {}", age[(second * 10.0) as usize]);
    }
    assert!(age[6_500].is_nan() && grid.ages[0].iter().all(|a| *a == 0.0));
    // A flag is never interpolated; a raised flag blanks the columns it covers.
    assert!(grid.tables[3][1].iter().all(|v| v.is_nan() || v.fract() == 0.0));
    assert!(grid.tables[3][0][..900].iter().all(|v| !v.is_nan()) && grid.tables[3][0][1_000].is_nan());
    assert_accounted(&gridder);
}

#[test]
fn instruments_are_never_interpolated() {
    let mut tables = is_and_dws(9_000);
    tables.push(telemetry("ifo", &["tm1.x_orf_m"], (0..1_500).map(|k| START + k * 6 * DT), 3));
    let (grid, _) = run(&tables);
    assert!(grid.tables[2][0].iter().enumerate().all(|(k, v)| v.is_nan() == (k % 6 != 0)));
}

/// Housekeeping faster than the grid, at its rate by a clock of its own, slower by less than half, and at half of it
/// has a value in every epoch, and none of it is a loss.
#[test]
fn housekeeping_at_any_rate_has_a_value_in_every_epoch() {
    for step in [DT / 2, DT / 10_001 * 10_000, DT / 2 * 3, 2 * DT] {
        let mut tables = is_and_dws(3_000);
        let samples = 3_000 * DT / step;
        tables.push(telemetry("hk/field", &["value"], (0..samples).map(|k| START + k * step), 3));
        let (grid, gridder) = run(&tables);
        let missing = grid.tables[2][0].iter().filter(|v| v.is_nan()).count() as i64;
        // Behind its last sample housekeeping that is interpolated is not known.
        assert!(missing <= step / DT + 1, "{step}: {missing}");
        assert_eq!(count(&gridder, 2, Reason::Crowded), 0);
    }
}

/// Every seven minutes, and nobody states the rate.
#[test]
fn slow_housekeeping_without_a_rate_is_interpolated() {
    let (mut tables, step) = (is_and_dws(30_000), 4_200 * DT);
    tables.push(telemetry("hk/tank", &["value"], (0..8).map(|k| START + k * step), 3));
    let (grid, _) = run(&tables);
    assert!(grid.tables[2][0].iter().all(|v| !v.is_nan()));
    let (first, second) = (tables[2].rows[0].1[0], tables[2].rows[1].1[0]);
    assert!((grid.tables[2][0][2_100] - 0.5 * (first + second)).abs() < 1e-15);
}

/// Of three test masses each makes an epoch usable.
#[test]
fn an_epoch_is_used_with_any_of_three_test_masses() {
    let masses = ["tm1", "tm2", "tm3"];
    let names: Vec<String> = masses.iter().flat_map(|m| ["x", "y", "z"].map(|a| format!("{m}.r_orf_m.{a}"))).collect();
    let names: Vec<&str> = names.iter().map(String::as_str).collect();
    for complete in [0..3, 0..1, 2..3, 0..0] {
        let (is, dws) = (columns("is", &names), columns("dws", &DWS[1..4]));
        let spec = |name: &str, owned: &[_]| table_spec(name, &owned.iter().collect::<Vec<_>>(), true, &masses, None);
        let mut gridder = Gridder::new(config(), vec![spec("is", &is), spec("dws", &dws)]);
        let tables = vec![vec![Vec::new(); names.len()], vec![Vec::new(); 3]];
        let mut grid = Grid { tables, ages: vec![Vec::new(); 2], ..Grid::default() };
        let mut noise = Noise::new(7);
        let times: Vec<i64> = steady(3_000).collect();
        for (t, width) in [(0, names.len()), (1, 3)] {
            let mut column = |c: usize| -> Vec<f64> {
                let there = t == 1 || complete.contains(&(c / 3));
                times.iter().map(|_| if there { 1e-9 * noise.gauss() } else { f64::NAN }).collect()
            };
            let values: Vec<Vec<f64>> = (0..width).map(&mut column).collect();
            gridder.take(t, &times, &values.iter().map(Vec::as_slice).collect::<Vec<_>>());
        }
        gridder.flush(&mut grid);
        let expected = if complete.is_empty() { 0 } else { 3_000 };
        assert_eq!(gridder.summary.used, expected, "{complete:?}");
    }
}

#[test]
fn status_limits_and_stuck_values_blank_their_columns() {
    let mut tables = is_and_dws(9_000);
    let is = &mut tables[0].rows;
    is[100].1[4] = 1.0;
    is[200].1[0] = f64::NAN;
    is[300].1[1] = f64::INFINITY;
    is[400].1[2] = 2e-4;
    (500..510).for_each(|k| is[k].1[3] = 7e-9);
    (600..609).for_each(|k| is[k].1[3] = 8e-9);
    is[700].1[0] += 1e-7;
    tables[1].rows[800].1[4] = 4.0;
    let (grid, gridder) = run(&tables);
    let nan = |t: usize, c: usize| -> Vec<usize> { (0..9_000).filter(|k| grid.tables[t][c][*k].is_nan()).collect() };
    assert_eq!(nan(0, 0), [100, 200, 700]);
    assert_eq!(nan(0, 1), [100, 300]);
    assert_eq!(nan(0, 2), [100, 400]);
    assert_eq!(nan(0, 3), [vec![100], (500..510).collect()].concat());
    assert_eq!(nan(1, 0), Vec::<usize>::new());
    assert_eq!(nan(1, 2), [800]);
    use Reason::{Infinite, Limit, NotANumber, Outlier, Status, Stuck};
    let counts = [Status, NotANumber, Infinite, Limit, Stuck, Outlier].map(|r| count(&gridder, 0, r));
    assert_eq!(counts, [4, 1, 1, 1, 10, 1]);
    assert_eq!(count(&gridder, 1, Status), 3);
    // Only capacitive readouts here: 100, 200, 300, 400, 700 and 800 are rejected.
    assert_eq!(gridder.summary.rejected, 6);
}

#[test]
fn a_column_of_zeros_is_absent_rather_than_stuck() {
    let mut tables = is_and_dws(7_000);
    tables[0].rows.iter_mut().for_each(|r| r.1[3] = 0.0);
    let (grid, gridder) = run(&tables);
    assert!(grid.tables[0][3].iter().all(|v| *v == 0.0));
    assert_eq!(gridder.table_summaries()[0].absent, ["tm1.att_orf_rad.phi"]);
    // Constant at any other value it is stuck.
    tables[0].rows.iter_mut().for_each(|r| r.1[3] = 1e-8);
    assert!(run(&tables).0.tables[0][3].iter().all(|v| v.is_nan()));
}

#[test]
fn duplicate_late_and_invalid_times_are_counted() {
    let mut tables = is_and_dws(7_000);
    let is = &mut tables[0].rows;
    let twin = is[100].clone();
    is.insert(101, twin);
    let mut other = is[201].clone();
    other.1[0] += 1e-12;
    is.insert(202, other);
    let late = is[300].clone();
    is.insert(320, late);
    is.insert(400, (-5, vec![0.0; 5]));
    let (grid, gridder) = run(&tables);
    use Reason::{BadTime, Conflicting, Duplicate, Late};
    assert_eq!([Duplicate, Conflicting, Late, BadTime].map(|r| count(&gridder, 0, r)), [1, 2, 1, 1]);
    let blank: Vec<usize> = (0..7_000).filter(|k| grid.tables[0][0][*k].is_nan()).collect();
    assert_eq!(blank, [200]);
    assert_accounted(&gridder);
}

#[test]
fn a_state_that_does_not_fit_is_refused() {
    let tables = is_and_dws(7_000);
    let specs = || tables.iter().map(spec).collect::<Vec<_>>();
    let mut gridder = run(&tables).1;
    let state = saved(&mut gridder);
    for bytes in [&state[..0], &state[..state.len() - 1], &state[..40], b"rubbish that is longer than a word"] {
        assert!(load(&mut Gridder::new(config(), specs()), bytes).is_err());
    }
    assert!(load(&mut Gridder::new(config(), specs()), &[state.as_slice(), &[0]].concat()).is_err());
    let mut other = Gridder::new(Config { stuck_samples: 11, ..config() }, specs());
    let refused = load(&mut other, &state).expect_err("other parameters").to_string();
    assert!(refused.contains("another set of tables or parameters"), "{refused}");
    for k in (0..state.len()).step_by(7) {
        let mut bent = state.clone();
        bent[k] ^= 0x80;
        assert!(load(&mut Gridder::new(config(), specs()), &bent).is_err(), "byte {k}");
    }
}

#[test]
fn a_saved_state_continues_on_the_next_day() {
    let whole = is_and_dws(16_000);
    let day = |from: usize, to: usize| -> Vec<Telemetry> {
        whole.iter().map(|t| Telemetry { rows: t.rows[from..to].to_vec(), ..t.clone() }).collect()
    };
    let (first, mut gridder) = run(&day(0, 8_000));
    let state = saved(&mut gridder);
    let mut second = Gridder::new(config(), whole.iter().map(spec).collect());
    load(&mut second, &state).unwrap();
    second.reset_counts();
    let mut grid = Grid { tables: vec![vec![Vec::new(); 5]; 2], ..Grid::default() };
    for (t, table) in day(8_000, 16_000).iter().enumerate() {
        let times: Vec<i64> = table.rows.iter().map(|r| r.0).collect();
        let values: Vec<Vec<f64>> = (0..5).map(|c| table.rows.iter().map(|r| r.1[c]).collect()).collect();
        second.take(t, &times, &values.iter().map(Vec::as_slice).collect::<Vec<_>>());
    }
    second.advance(i64::MAX, &mut grid);
    second.flush(&mut grid);
    assert_eq!([first.times, grid.times].concat(), run(&whole).0.times);
    assert_eq!((second.summary.used, second.summary.rejected), (8_000, 0));
}

/// Telemetry with every kind of corruption.
fn corrupt_telemetry(seed: u64, rows: i64) -> Vec<Telemetry> {
    let mut noise = Noise::new(seed);
    let mut jump = 0;
    let mut times = Vec::new();
    let mut k = 0;
    while k < rows {
        match noise.word() % 4_000 {
            0 => k += (noise.word() % 3_000) as i64,
            1 => jump += (noise.word() % 300_000_000) as i64,
            2 => k += 1,
            _ => {}
        }
        times.push(START + k * DT + jump + (noise.word() % 4_000_000) as i64);
        k += 1;
    }
    let mut tables = vec![
        telemetry("is", &IS, times.iter().copied(), seed),
        telemetry("dws", &DWS, times.iter().map(|t| t + 20_000_000), seed + 1),
        telemetry("hk/field", &["value"], times.iter().copied().step_by(37), seed + 2),
        telemetry("hk/current", &["value"], times.iter().copied(), seed + 3),
    ];
    for table in &mut tables {
        for k in 0..table.rows.len() {
            match noise.word() % 500 {
                0 => table.rows[k].1[0] = f64::NAN,
                1 => table.rows[k].1[0] += 1e-6,
                2 if table.columns.len() == 5 => table.rows[k].1[4] = (noise.word() % 9) as f64,
                3 => table.rows[k].1[0] = f64::NEG_INFINITY,
                4 if k > 10 => {
                    let stuck = table.rows[k].1[0];
                    table.rows[k - 10..k].iter_mut().for_each(|r| r.1[0] = stuck);
                }
                _ => {}
            }
        }
        for _ in 0..table.rows.len() / 300 {
            let from = noise.word() as usize % table.rows.len();
            let to = (from + noise.word() as usize % 5).min(table.rows.len());
            let mut row = table.rows[from].clone();
            if noise.word().is_multiple_of(3) {
                row.1[0] += 1e-12;
            }
            table.rows.insert(to, row);
        }
    }
    tables
}

#[test]
fn results_do_not_depend_on_batches_or_saved_states() {
    let tables = corrupt_telemetry(77, 12_000);
    // A row is late or not depending on the piece, so this test uses ordered rows only.
    let ordered: Vec<Telemetry> = tables
        .into_iter()
        .map(|mut t| {
            t.rows.sort_by_key(|r| r.0);
            t
        })
        .collect();
    let (grid, mut gridder) = run_with(&ordered, &config(), 65_536, |_| false);
    assert_accounted(&gridder);
    for (piece, every) in [(1, 1_000), (777, 1), (777, usize::MAX), (65_536, 1)] {
        let (other, mut end) = run_with(&ordered, &config(), piece, |n| n % every == every - 1);
        assert!(other.bits() == grid.bits(), "pieces of {piece}");
        assert!(saved(&mut end) == saved(&mut gridder), "state after pieces of {piece}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn every_row_is_on_the_grid_or_counted(seed in 0_u64..1_000_000, rows in 1_i64..9_000, piece in 1_usize..5_000) {
        let tables = corrupt_telemetry(seed, rows);
        let (grid, gridder) = run_with(&tables, &config(), piece, |_| false);
        assert_accounted(&gridder);
        // No instrument value appears that was not in the telemetry.
        for (t, table) in tables.iter().enumerate().take(2) {
            let mut sent: Vec<u64> = table.rows.iter().map(|r| r.1[1].to_bits()).collect();
            sent.sort_unstable();
            for v in grid.tables[t][1].iter().filter(|v| !v.is_nan()) {
                prop_assert!(sent.binary_search(&v.to_bits()).is_ok());
            }
        }
    }
}
