//! Fixture of the unit tests.

use crate::mission::Mission;

/// The bundled mission with two test masses.
pub(crate) fn taiji() -> Mission {
    let value: serde_json::Value = toml::from_str(include_str!("../../../fixtures/missions/taiji.toml")).unwrap();
    Mission::from_json(&value.to_string()).unwrap()
}
