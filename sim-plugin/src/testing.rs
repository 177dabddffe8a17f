//! Fixture of the unit tests.

use dragfree_physics::mission::Mission;

/// The paper's spacecraft.
pub(crate) fn taiji() -> Mission {
    let value: serde_json::Value = toml::from_str(include_str!("../../fixtures/missions/taiji.toml")).unwrap();
    Mission::from_json(&value.to_string()).unwrap()
}
