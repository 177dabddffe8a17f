//! Prints the generalized plants and γ of the default mission's channels and of the published benchmarks as JSON, for
//! `tests/oracles/hinf_oracle.py`.

use dragfree_physics::control_design::design;
use dragfree_physics::hinf::{GeneralizedPlant, Synthesis};
use dragfree_physics::lti::StateSpace;
use dragfree_physics::mission::Mission;
use nalgebra::DMatrix;
use serde_json::{Value, json};
use std::error::Error;
use std::io::Write;

const MISSION: &str = include_str!("../../../fixtures/missions/taiji.toml");
const BENCHMARKS: &str = include_str!("../../../tests/oracles/hinf_benchmarks.json");

fn rows(m: &DMatrix<f64>) -> Vec<Vec<f64>> {
    m.row_iter().map(|row| row.iter().copied().collect()).collect()
}

fn matrix(value: &Value) -> Result<DMatrix<f64>, Box<dyn Error>> {
    let rows: Vec<Vec<f64>> = serde_json::from_value(value.clone())?;
    Ok(DMatrix::from_row_iterator(rows.len(), rows[0].len(), rows.iter().flatten().copied()))
}

fn problem(name: &str, plant: &GeneralizedPlant, gamma: f64) -> Value {
    let StateSpace { a, b, c, d } = &plant.system;
    json!({
        "name": name, "gamma": gamma, "measurements": plant.measurements, "controls": plant.controls,
        "a": rows(a), "b": rows(b), "c": rows(c), "d": rows(d),
    })
}

fn main() -> Result<(), Box<dyn Error>> {
    let mission = Mission::from_json(&toml::from_str::<Value>(MISSION)?.to_string())?;
    let mut problems: Vec<Value> =
        design(&mission)?.channels.iter().map(|c| problem(&c.name, &c.plant, c.gamma)).collect();
    for benchmark in serde_json::from_str::<Vec<Value>>(BENCHMARKS)? {
        let [a, b, c, d] = ["a", "b", "c", "d"].map(|key| matrix(&benchmark[key]));
        let number = |key: &str| benchmark[key].as_u64().unwrap_or(0) as usize;
        let system = StateSpace::new(a?, b?, c?, d?)?;
        let (measurements, controls) = (number("measurements"), number("controls"));
        let plant = GeneralizedPlant { system, measurements, controls };
        let gamma = Synthesis::new(&plant)?.optimum(1e-6)?.gamma;
        problems.push(problem(benchmark["name"].as_str().unwrap_or(""), &plant, gamma));
    }
    writeln!(std::io::stdout(), "{}", serde_json::to_string(&problems)?)?;
    Ok(())
}
