//! The parser on files of the mission: 2023-06-01, release 04, both spacecraft, bodies shortened to 100 rows.

use std::collections::BTreeMap;
use std::path::PathBuf;

use dragfree_gracefo::Window;
use dragfree_gracefo::archive::Container;
use dragfree_gracefo::rows::{EPOCH_UNIX_S, Parsed, Rows, align_quaternions, parse};

/// 2023-06-01T00:00:00 on the mission's time scale.
const MIDNIGHT_NS: i64 = (EPOCH_UNIX_S + 738_849_600) * 1_000_000_000;

fn fixture(level: &str) -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
        .join(format!("../../fixtures/gracefo/gracefo_{level}_2023-06-01_RL04.ascii.noLRI.tgz"))
}

fn read(level: &str, spacecraft: char) -> BTreeMap<&'static str, Parsed> {
    let mut all = BTreeMap::new();
    Container::open(&fixture(level))
        .expect("fixture")
        .visit(|member, text| {
            if member.spacecraft == spacecraft {
                let parsed = parse(text, member.product, spacecraft, Window::ALL).expect("a real header");
                all.insert(member.product.code, parsed);
            }
        })
        .expect("whole archive");
    all
}

fn mean(column: &[f64], n: usize) -> f64 {
    column[..n].iter().sum::<f64>() / n as f64
}

#[test]
fn every_product_of_both_spacecraft_is_read_without_loss() {
    for spacecraft in ['C', 'D'] {
        for (level, codes) in [
            ("1A", &["ACC1A", "ACT1A", "IMU1A", "MAG1A", "MAS1A", "SCA1A", "THR1A", "TNK1A"][..]),
            ("1B", &["ACT1B", "GNI1B", "SCA1B"][..]),
        ] {
            let all = read(level, spacecraft);
            assert_eq!(all.keys().copied().collect::<Vec<_>>(), codes);
            for (code, parsed) in all {
                let c = &parsed.counts;
                let rows = if code == "MAS1A" { 24 } else { 100 };
                assert_eq!((c.rows, c.garbage, c.truncated, c.foreign), (rows, 0, 0, 0), "{code} {spacecraft} {c:?}");
                assert_eq!(c.rows, parsed.tables.iter().map(|t| t.time_ns.len() as u64).sum::<u64>());
                for table in &parsed.tables {
                    assert!(table.time_ns.is_sorted_by(|a, b| a < b), "{code}");
                    assert!(table.columns.iter().all(|col| col.len() == table.time_ns.len()));
                }
                // Bodies were shortened but headers kept: only MAS1A, with 24 rows, has the right count.
                assert_eq!(c.promised.is_none(), code == "MAS1A", "{code}");
            }
        }
    }
}

#[test]
fn values_and_times_are_those_of_the_rows() {
    let all = read("1A", 'C');
    let acc = &all["ACC1A"].tables[0];
    // 738849600 7739 … -1.064995712362181e-05 -1.835037928999774e-07 -2.778613076425759e-07 1.296…e-05 …
    assert_eq!(acc.time_ns[0], MIDNIGHT_NS + 7_739_000);
    let first: Vec<f64> = acc.columns.iter().map(|c| c[0]).collect();
    assert_eq!(
        first,
        [
            -2.778613076425759e-07,
            -1.064995712362181e-05,
            -1.835037928999774e-07,
            -0.000781349539756775,
            1.296553015708923e-05,
            0.0001192528009414673,
            0.0
        ]
    );
    let cameras = &all["SCA1A"].tables;
    assert_eq!(cameras.iter().map(|t| t.time_ns.len()).collect::<Vec<_>>(), [34, 33, 33]);
    assert_eq!(cameras[2].columns[0][0], 0.1293144023812642);
    assert_eq!(cameras[2].columns[6][0], f64::from(0b1100_0001));
    let tank = &all["TNK1A"].tables[1];
    assert_eq!(tank.columns[0][0], 221.7747955322266 * 1e5);
    assert!(tank.columns[2][0].is_nan(), "a row with pressures has no temperatures");
    assert!(tank.columns[2].iter().any(|k| (250.0..320.0).contains(k)), "temperatures in kelvin");
    // Rows of MAG1A are half a second apart only if their fractions are microseconds.
    let mag = &all["MAG1A"].tables[0];
    assert!(mag.time_ns.windows(2).all(|w| w[1] - w[0] == 500_000_000));
    assert!(mag.columns[0].iter().all(|b| (1e-6..7e-5).contains(b)), "Earth's field in tesla");

    let orbit = &read("1B", 'C')["GNI1B"];
    assert_eq!(orbit.counts.fill_values, 600, "six formal errors of 1e33 in a hundred rows");
    assert!(orbit.tables[0].columns[3].iter().all(|x| x.is_nan()));
    assert_eq!(orbit.tables[0].time_ns[1], MIDNIGHT_NS + 1_000_000_000);
    assert_eq!(orbit.tables[0].columns[0][1], -2123592.510478244);
}

/// Orientation of the accelerometer's axes. ACT1B is ACC1A filtered to 1 Hz in SRF, so their means over the common ten
/// seconds agree. Of 24 rotations of the axes, the one in use fits 100 times better than any other.
#[test]
fn the_axes_of_the_accelerometer_match_act1b() {
    let acc = read("1A", 'C').remove("ACC1A").expect("ACC1A").tables.remove(0);
    let act = read("1B", 'C').remove("ACT1B").expect("ACT1B").tables.remove(0);
    let srf = [0, 1, 2].map(|i| mean(&act.columns[i], 10));
    let made = [0, 1, 2].map(|i| mean(&acc.columns[i], 99));
    let misfit = |v: [f64; 3]| (0..3).map(|i| (v[i] - srf[i]).powi(2)).sum::<f64>().sqrt();
    let own = misfit(made);
    assert!(own < 1e-9, "{own:e} m s⁻²");
    for order in [[0, 1, 2], [1, 2, 0], [2, 0, 1], [0, 2, 1], [2, 1, 0], [1, 0, 2]] {
        for signs in 0..8 {
            let sign = |i: usize| if signs >> i & 1 == 1 { -1.0 } else { 1.0 };
            let even = [[0, 1, 2], [1, 2, 0], [2, 0, 1]].contains(&order);
            let determinant = (if even { 1.0 } else { -1.0 }) * sign(0) * sign(1) * sign(2);
            if determinant < 0.0 || (order == [0, 1, 2] && signs == 0) {
                continue;
            }
            let other = misfit([0, 1, 2].map(|i| sign(i) * made[order[i]]));
            assert!(other > 100.0 * own, "order {order:?}, signs {signs:03b}: {other:e} against {own:e}");
        }
    }
}

/// The angular columns use the accelerometer's axes too: the instrument is least sensitive about `a_1`, whose noise
/// must appear on `s_2`.
#[test]
fn the_noisiest_angular_axis_is_the_pitch_axis() {
    for spacecraft in ['C', 'D'] {
        let acc = read("1A", spacecraft).remove("ACC1A").expect("ACC1A").tables.remove(0);
        let spread = [3, 4, 5].map(|i| {
            let d: Vec<f64> = acc.columns[i].windows(2).map(|w| w[1] - w[0]).collect();
            (d.iter().map(|x| x * x).sum::<f64>() / d.len() as f64).sqrt()
        });
        assert!(spread[1] > spread[0] && spread[1] > spread[2], "{spread:?}");
    }
}

/// ACT1B of spacecraft D is transplanted from C: ACC1A of D disagrees with it.
#[test]
fn spacecraft_d_has_a_transplanted_act1b() {
    let acc = read("1A", 'D').remove("ACC1A").expect("ACC1A").tables.remove(0);
    let act = read("1B", 'D').remove("ACT1B").expect("ACT1B").tables.remove(0);
    let far = [0, 1, 2].map(|i| (mean(&acc.columns[i], 99) - mean(&act.columns[i], 10)).abs());
    assert!(far.iter().all(|x| *x > 1e-6), "{far:?}");
}

#[test]
fn consecutive_quaternions_have_one_sign() {
    let mut rows = Rows {
        time_ns: vec![0, 1, 2, 3],
        columns: vec![vec![1.0, -1.0, f64::NAN, 1.0], vec![0.0, -0.1, 0.0, 0.2], vec![0.0; 4], vec![0.0; 4]],
    };
    let mut last = Some([-1.0, 0.0, 0.0, 0.0]);
    align_quaternions(&mut rows, 0, &mut last);
    assert_eq!((rows.columns[0][0], rows.columns[0][1], rows.columns[0][3]), (-1.0, -1.0, -1.0));
    assert_eq!(rows.columns[1], [-0.0, -0.1, 0.0, -0.2]);
    assert_eq!(last, Some([-1.0, -0.2, -0.0, -0.0]));
}
