//! The parser on damaged files: no panic for any bytes, and every dropped row is counted.

use std::path::PathBuf;
use std::sync::LazyLock;

use dragfree_gracefo::archive::{Container, Member};
use dragfree_gracefo::product::{PRODUCTS, find};
use dragfree_gracefo::rows::{Parsed, parse};
use dragfree_gracefo::{Level1Error, Window};
use proptest::prelude::*;

static REAL: LazyLock<Vec<(Member, Vec<u8>)>> = LazyLock::new(|| {
    let mut all = Vec::new();
    for level in ["1A", "1B"] {
        let path = PathBuf::from(env!("CARGO_MANIFEST_DIR"))
            .join(format!("../../fixtures/gracefo/gracefo_{level}_2023-06-01_RL04.ascii.noLRI.tgz"));
        let container = Container::open(&path).expect("fixture");
        container
            .visit(|member, text| {
                let mut bytes = Vec::new();
                text.read_to_end(&mut bytes).expect("member");
                all.push((member, bytes));
            })
            .expect("whole archive");
    }
    all
});

fn real(code: &str, spacecraft: char) -> String {
    let (_, bytes) =
        REAL.iter().find(|(m, _)| m.product.code == code && m.spacecraft == spacecraft).expect("a real file");
    String::from_utf8(bytes.clone()).expect("text")
}

fn read(code: &str, text: &str) -> Result<Parsed, Level1Error> {
    parse(&mut text.as_bytes(), find(code).expect("product"), 'C', Window::ALL)
}

/// Invariants of the result for any bytes.
fn check(bytes: &[u8], code: &str) {
    let product = find(code).expect("product");
    let Ok(parsed) = parse(&mut &bytes[..], product, 'C', Window::ALL) else { return };
    assert_eq!(parsed.tables.len(), product.tables().len());
    let c = &parsed.counts;
    let lines = bytes.iter().filter(|b| **b == b'\n').count() as u64;
    assert!(c.rows + c.garbage + c.duplicates + c.foreign + c.untimed <= lines);
    assert_eq!(c.rows, parsed.tables.iter().map(|t| t.time_ns.len() as u64).sum::<u64>());
    for table in &parsed.tables {
        assert!(table.time_ns.is_sorted_by(|a, b| a < b));
        assert_eq!(table.columns.len(), product.columns.len());
        assert!(table.columns.iter().all(|col| col.len() == table.time_ns.len()));
        assert!(table.columns.iter().flatten().all(|x| !x.is_infinite()));
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(400))]

    #[test]
    fn any_bytes(bytes in proptest::collection::vec(any::<u8>(), 0..2000), which in 0..PRODUCTS.len()) {
        check(&bytes, PRODUCTS[which].code);
    }

    #[test]
    fn a_real_header_over_any_rows(
        which in 0..1_000_usize,
        rows in proptest::collection::vec("[-+0-9eE.RGCDPNaninf \t]{0,120}", 0..20),
    ) {
        let (member, bytes) = &REAL[which % REAL.len()];
        let text = String::from_utf8_lossy(bytes);
        let end = text.find("# End of YAML header").expect("header");
        let file = format!("{}# End of YAML header\n{}\n", &text[..end], rows.join("\n"));
        check(file.as_bytes(), member.product.code);
    }

    #[test]
    fn a_real_file_with_bytes_overwritten_cut_or_doubled(
        which in 0..1_000_usize,
        edits in proptest::collection::vec((any::<prop::sample::Index>(), any::<u8>(), 0..4_u8), 1..12),
    ) {
        let (member, bytes) = &REAL[which % REAL.len()];
        let mut bytes = bytes.clone();
        for (at, byte, kind) in edits {
            if bytes.is_empty() {
                break;
            }
            let i = at.index(bytes.len());
            match kind {
                0 => bytes[i] = byte,
                1 => bytes.truncate(i),
                2 => bytes.insert(i, byte),
                _ => {
                    let tail = bytes[i..(i + 400).min(bytes.len())].to_vec();
                    bytes.splice(i..i, tail);
                }
            }
        }
        check(&bytes, member.product.code);
    }

    #[test]
    fn rows_in_any_order_make_one_table(seed in proptest::collection::vec(any::<u32>(), 100)) {
        let text = real("ACC1A", 'C');
        let whole = read("ACC1A", &text).expect("real");
        let (header, body) = text.split_once("# End of YAML header\n").expect("header");
        let mut rows: Vec<(u32, &str)> = seed.iter().copied().zip(body.lines()).collect();
        rows.sort_unstable();
        let body: String = rows.iter().flat_map(|(_, r)| [*r, "\n"]).collect();
        let mixed = read("ACC1A", &format!("{header}# End of YAML header\n{body}")).expect("real header");
        prop_assert_eq!(&mixed.tables, &whole.tables);
        prop_assert!(mixed.counts.out_of_order > 0, "a hundred rows stay in order once in 100! shuffles");
    }
}

/// The seventh and eighth words are the first values that a row's `prod_flag` announces.
const ROW: &str = "738849601  7650  R  C  00000000   00000100000000000000000000111111  1 2 3 4 5 6 7";

fn with_rows(rows: &str) -> Parsed {
    let text = real("ACC1A", 'C');
    let (header, _) = text.split_once("# End of YAML header\n").expect("header");
    read("ACC1A", &format!("{header}# End of YAML header\n{rows}")).expect("a real header")
}

#[test]
fn the_flag_of_a_row_selects_its_columns() {
    // Linear acceleration along the accelerometer's x alone; then all but its y; then a flag that announces more.
    let p = with_rows(
        "738849601 0 R C 00000000 00000000000000000000000000000001 0.25\n\
         738849602 0 R C 00000000 00000000000000000000000000111101 1 3 4 5 6\n\
         738849603 0 R C 00000000 00000000000000000000000000111111 1 2 3 4 5\n\
         738849604 0 R C 00000000 00000000000000000000000000000001 1 2\n",
    );
    let at = |k: usize| p.tables[0].columns[..6].iter().map(|c| c[k]).collect::<Vec<_>>();
    let same = |a: Vec<f64>, b: [f64; 6]| a.iter().zip(b).all(|(x, y)| *x == y || (x.is_nan() && y.is_nan()));
    const NAN: f64 = f64::NAN;
    assert!(same(at(0), [NAN, 0.25, NAN, NAN, NAN, NAN]), "{:?}", at(0));
    assert!(same(at(1), [3.0, 1.0, NAN, 6.0, 4.0, 5.0]), "{:?}", at(1));
    assert_eq!((p.counts.rows, p.counts.garbage, p.counts.first_garbage_line.is_some()), (2, 2, true));
    assert_eq!(p.counts.fill_values, 0, "what the flag leaves out was never lost");
}

#[test]
fn every_loss_is_counted_once() {
    let p = with_rows(&format!(
        "{ROW}\nnot a row\n{ROW}\n{}\n{}\n{}\n{}\n738849605 1 R C 000",
        ROW.replace("  C  ", "  D  "),
        ROW.replace("738849601", "738849600"),
        ROW.replace("00000000 ", "00000010 ").replace("738849601", "738849603"),
        ROW.replace(" 1 2 3", " 1e33 nan 3").replace("738849601", "738849604"),
    ));
    let c = &p.counts;
    assert_eq!(c.rows, 3, "{c:?}");
    assert_eq!((c.garbage, c.duplicates, c.foreign, c.out_of_order), (1, 1, 1, 1), "{c:?}");
    assert_eq!((c.untimed, c.fill_values, c.truncated, c.outside_window), (1, 2, 1, 0), "{c:?}");
    assert_eq!(c.promised, Some(864_078));
    let header_lines =
        real("ACC1A", 'C').split_once("# End of YAML header\n").expect("header").0.lines().count() as u64;
    assert_eq!(c.first_garbage_line, Some(header_lines + 3));
}

#[test]
fn a_window_keeps_what_is_inside() {
    let text = real("ACT1B", 'C');
    let all = read("ACT1B", &text).expect("real").tables[0].time_ns.clone();
    let window = Window { start_ns: all[10], end_ns: all[20] };
    let p = parse(&mut text.as_bytes(), find("ACT1B").expect("product"), 'C', window).expect("real");
    assert_eq!(p.tables[0].time_ns, all[10..20]);
    assert_eq!((p.counts.rows, p.counts.outside_window), (10, 90));
}

#[test]
fn the_fill_value_of_a_header_is_used() {
    let text = real("ACT1B", 'C').replace("    - lin_accl_y:\n", "    - lin_accl_y:\n        _FillValue: -99.5\n");
    let (header, _) = text.split_once("# End of YAML header\n").expect("header");
    let p = read("ACT1B", &format!("{header}# End of YAML header\n738849600 C 1 -99.5 3 0 0 0 -99.5 0 0 00000000\n"));
    let p = p.expect("header");
    assert!(p.tables[0].columns[1][0].is_nan());
    assert_eq!(p.tables[0].columns[3][0], -99.5, "another column's fill value is a number here");
    assert_eq!(p.counts.fill_values, 1);
}

#[test]
fn a_foreign_header_is_refused_with_a_reason() {
    let text = real("ACC1A", 'C');
    let refusals = [
        (read("ACC1A", ""), "no line"),
        (read("ACC1A", &text[..5000]), "no line"),
        (read("ACC1A", "{[\n# End of YAML header\n"), "not valid YAML"),
        (read("ACC1A", "a: 1\n# End of YAML header\n"), "no header"),
        (read("SCA1B", &text), "no variable"),
        (read("ACC1A", &text.replace("m/s2", "mm/s2")), "mm/s2"),
        (read("ACC1A", &text.replace("epoch_time: 2000", "epoch_time: 1980")), "1980"),
        (read("ACC1A", &text.replace("platform: GRACE C", "platform: GRACE D")), "GRACE D"),
    ];
    for (result, word) in refusals {
        let error = result.expect_err(word).to_string();
        assert!(error.contains(word), "{error}");
    }
}

#[test]
fn only_names_of_the_mission_are_members() {
    let name = |n: &str| Member::from_name(n).map(|m| (m.product.code, m.date, m.spacecraft, m.release));
    assert_eq!(name("ACC1A_2023-06-01_C_04.txt"), Some(("ACC1A", "2023-06-01".to_owned(), 'C', "04".to_owned())));
    for stray in [
        "._ACC1A_2023-06-01_C_04.txt",
        "ACC1A_2023-06-01_C_04.rpt",
        "KBR1B_2023-06-01_Y_04.txt",
        "ACC1A_2023-06-01_Y_04.txt",
        "ACC1A_2023-06-01_C.txt",
        "ACC1A.txt",
        "",
    ] {
        assert_eq!(name(stray), None, "{stray}");
    }
}

#[test]
fn a_truncated_archive_gives_its_intact_members() {
    let path = PathBuf::from(env!("CARGO_MANIFEST_DIR"))
        .join("../../fixtures/gracefo/gracefo_1A_2023-06-01_RL04.ascii.noLRI.tgz");
    let whole = std::fs::read(&path).expect("fixture");
    let dir = tempfile::tempdir().expect("directory");
    let cut = dir.path().join("cut.tgz");
    std::fs::write(&cut, &whole[..whole.len() / 3]).expect("write");
    let container = Container::open(&cut).expect("opens");
    assert!(container.damage.is_some());
    let all = Container::open(&path).expect("opens").members.len();
    assert!((1..all).contains(&container.members.len()), "{} of {all}", container.members.len());
    std::fs::write(&cut, b"").expect("write");
    assert!(Container::open(&cut).expect("an empty file is a file").members.is_empty());
}
