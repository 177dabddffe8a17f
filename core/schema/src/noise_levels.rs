//! Levels of noise that a model states: how coefficients with `noise` change what the stages declare.

use std::collections::BTreeMap;

use crate::{Coefficient, NoiseProcess};

/// Amplitudes of components of noise over what the stages declare, as the effects of a model state them.
///
/// The host applies them to the declared noise once, before any later plugin sees it; every cross-spectral matrix that
/// is made from [`crate::Model::noise`] contains them. A stage that takes noise from the mission file multiplies the
/// amplitude of each component by [`Self::amplitude`].
#[derive(Clone, Debug, Default, PartialEq)]
pub struct NoiseLevels {
    /// By component: coefficients, and the product of their values.
    levels: BTreeMap<String, (Vec<String>, f64)>,
}

impl NoiseLevels {
    /// The levels that these coefficients state at their initial values; candidates state none.
    pub fn of<'a>(coefficients: impl IntoIterator<Item = &'a Coefficient>) -> Self {
        let mut levels: BTreeMap<String, (Vec<String>, f64)> = BTreeMap::new();
        for c in coefficients.into_iter().filter(|c| !c.noise.is_empty() && !c.candidate) {
            let (names, amplitude) = levels.entry(c.noise.clone()).or_insert_with(|| (Vec::new(), 1.0));
            names.push(c.name.clone());
            *amplitude *= c.initial;
        }
        Self { levels }
    }

    /// Amplitude of a component over the declared one, 1 where none is stated.
    pub fn amplitude(&self, component: &str) -> f64 {
        self.levels.get(component).map_or(1.0, |(_, amplitude)| *amplitude)
    }

    /// The levels that undo these.
    #[must_use]
    pub fn inverse(mut self) -> Self {
        self.levels.values_mut().for_each(|(_, amplitude)| *amplitude = amplitude.recip());
        self
    }

    /// Scales the declared noise: `C ← D C D` with the amplitudes D of the components of each process.
    ///
    /// # Errors
    /// A sentence: a level is not above zero, or no process has a component of this name.
    pub fn apply(&self, declared: &mut [NoiseProcess]) -> Result<(), String> {
        for (component, (names, amplitude)) in &self.levels {
            let names = names.join(", ");
            if !(amplitude.is_finite() && *amplitude > 0.0) {
                return Err(format!(
                    "{names} = {amplitude}: a level of noise is an amplitude above zero, 1 as declared"
                ));
            }
            if !declared.iter().any(|p| p.components.contains(component)) {
                let mut known: Vec<&str> = declared.iter().flat_map(|p| &p.components).map(String::as_str).collect();
                known.sort_unstable();
                return Err(format!(
                    "{names} scales the noise `{component}`, which no stage before the effects declares; declared are: {}",
                    known.join(", ")
                ));
            }
        }
        declared.iter_mut().for_each(|process| process.scale(|component| self.amplitude(component)));
        Ok(())
    }
}

impl NoiseProcess {
    /// Multiplies the amplitude of each named component by a factor; correlations stay.
    fn scale(&mut self, amplitude: impl Fn(&str) -> f64) {
        let factors: Vec<f64> = self.components.iter().map(|name| amplitude(name)).collect();
        if factors.iter().all(|factor| *factor == 1.0) {
            return;
        }
        let n = factors.len();
        let identity = || (0..n).map(|i| (0..n).map(|j| f64::from(u8::from(i == j))).collect()).collect();
        let covariance = self.covariance.get_or_insert_with(identity);
        for (row, a) in covariance.iter_mut().zip(&factors) {
            row.iter_mut().zip(&factors).for_each(|(entry, b)| *entry *= a * b);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::NoiseShape;

    fn level(effect: &str, component: &str, initial: f64) -> Coefficient {
        Coefficient { name: effect.to_owned(), noise: component.to_owned(), initial, ..Coefficient::default() }
    }

    fn declared() -> Vec<NoiseProcess> {
        let process = |name: &str, components: &[&str], covariance| NoiseProcess {
            name: name.to_owned(),
            spectrum: Some(NoiseShape::with_corner(3.0, 1e-3, 2)),
            enters: [("a".to_owned(), vec![1.0; components.len()])].into(),
            components: components.iter().map(|c| (*c).to_owned()).collect(),
            covariance,
            ..NoiseProcess::default()
        };
        let correlated = Some(vec![vec![4.0, 1.0, 0.5], vec![1.0, 9.0, 2.0], vec![0.5, 2.0, 1.0]]);
        vec![process("force", &["force:x", "force:y", "force:z"], correlated), process("readout", &["readout:y"], None)]
    }

    /// The power of a named component is k² times what it was, its correlation with others the same, and nothing else
    /// changes.
    #[test]
    fn a_level_scales_its_component_and_nothing_else() {
        let mut noise = declared();
        NoiseLevels::of(&[level("a", "force:y", 1.5)]).apply(&mut noise).expect("a component");
        let mut expected = declared();
        expected[0].covariance = Some(vec![vec![4.0, 1.5, 0.5], vec![1.5, 20.25, 3.0], vec![0.5, 3.0, 1.0]]);
        assert_eq!(noise, expected);
        let mut noise = declared();
        NoiseLevels::of(&[level("a", "readout:y", 2.0)]).apply(&mut noise).expect("a component");
        let mut expected = declared();
        expected[1].covariance = Some(vec![vec![4.0]]);
        assert_eq!(noise, expected);
        assert!(noise.iter().all(|process| process.check().is_ok()));
    }

    #[test]
    fn a_candidate_and_a_level_of_one_change_nothing_and_an_inverse_undoes() {
        let candidate = Coefficient { candidate: true, ..level("a", "force:y", 1.5) };
        let regressor = Coefficient { initial: 7.0, ..Coefficient::default() };
        let levels = NoiseLevels::of(&[candidate, regressor, level("b", "force:x", 1.0)]);
        let mut noise = declared();
        levels.apply(&mut noise).expect("a component");
        assert_eq!((noise, levels.amplitude("force:y")), (declared(), 1.0));
        let levels = NoiseLevels::of(&[level("a", "force:y", 2.0), level("b", "readout:y", 0.5)]);
        let mut noise = declared();
        levels.apply(&mut noise).expect("components");
        assert_ne!(noise, declared());
        levels.inverse().apply(&mut noise).expect("components");
        noise[1].covariance = None;
        assert_eq!(noise, declared());
    }

    #[test]
    fn a_level_that_scales_nothing_is_refused_by_name() {
        let refused = |c: Coefficient| NoiseLevels::of(&[c]).apply(&mut declared()).expect_err("a refusal");
        let unknown = refused(level("is-noise.tm3.y", "readout:tm3.y", 2.0));
        assert!(unknown.contains("is-noise.tm3.y") && unknown.contains("force:x, force:y"), "{unknown}");
        for value in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            assert!(refused(level("a", "force:x", value)).contains("above zero"), "{value}");
        }
    }
}
