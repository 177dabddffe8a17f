//! `dragfree diagnose` at lengths that take minutes a set: `cargo test --release -p dragfree-tests --test lengths`, some
//! ten minutes. `cargo test` without this name leaves them out (Cargo.toml); results: VALIDATION.md, "Single sets".

use dragfree_tests::calibration::{accepted, diagnosis, named_alone, scale_or_gain};
use serde_json::Value;

/// A thruster gain of 10 % is named alone at any length.
#[test]
fn a_thruster_gain_is_named_from_six_to_twelve_hours() {
    for hours in ["6", "10"] {
        let d = diagnosis(&["--hours", hours, "--seed", "77", "--effect", "mps-gain:sc.y=0.1"]);
        assert_eq!(named_alone(&d, 0.1), "mps-gain:sc.y", "{hours} h");
    }
    let d = diagnosis(&["--hours", "12", "--seed", "425", "--effect", "mps-gain:sc.z=0.08"]);
    // Beside a free level of the noise σ is 0.27 of the truth here: the one set that the bound of the others excludes.
    let first = &d["candidates"][0];
    let (value, sigma) = (first["value"].as_f64().expect("a value"), first["sigma"].as_f64().expect("a sigma"));
    assert_eq!(accepted(&d), ["mps-gain:sc.z"]);
    assert!((value - 0.08).abs() < 4.0 * sigma && sigma < 0.3 * 0.08, "{value} ± {sigma}");
}

/// A readout scale of 5 % along y from eight hours to a day.
#[test]
fn a_scale_is_named_from_eight_hours_to_a_day() {
    for hours in ["8", "12", "24"] {
        scale_or_gain(hours, "is-scale:tm2.y");
    }
}

/// A delay of all capacitive readouts is named alone.
#[test]
fn a_delay_of_the_capacitive_readouts_is_named_alone() {
    let d = diagnosis(&["--hours", "12", "--seed", "213", "--effect", "time-offset:is=0.15"]);
    assert_eq!(named_alone(&d, 0.15), "time-offset:is");
}

/// A day of a force by a product that no effect covers, along one axis. `magnetic` with six coefficients explains no
/// more than a formula with one but for what five explain by chance, and a charge a part of it: neither is named.
#[test]
fn six_coefficients_are_not_named_where_one_explains_as_much() {
    let d = diagnosis(&["--hours", "24", "--seed", "9204", "--effect", "product-force:tm2.x=2e-13"]);
    assert_eq!((d["verdict"].as_str(), accepted(&d)), (Some("unexplained"), Vec::new()), "{:#}", d["candidates"]);
    let expression = |f: &Value| f["shape"]["expression"].as_str().is_some_and(|e| e.contains("hk.battery_current_a"));
    let formulas = d["formulas"].as_array().expect("a list");
    assert!(formulas.iter().take(3).any(expression), "{formulas:#?}");
}
