//! Model files: a list of effects.

use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use super::{ConfigError, Mission, parse, read};
use crate::border::Manifest;
use dragfree_archive::files::sha256;

/// A model: a revision and its effects.
#[derive(Clone, Debug)]
pub struct Model {
    /// The file.
    pub path: PathBuf,
    /// Revision, as the file has it.
    pub revision: String,
    /// Revision that this one came from.
    pub parent: Option<String>,
    /// The product at whose values `model fix` fixed its coefficients.
    pub fixed_from: Option<String>,
    /// Effects in order.
    pub effects: Vec<EffectEntry>,
    /// Effects that are not in the file but are to be tried beside it.
    pub candidates: Vec<EffectEntry>,
    /// As `candidates`, each in the one form that its parameters say.
    pub chosen: Vec<EffectEntry>,
    /// What the host itself asks of stages by name, beside what the effects need.
    pub needs: Vec<String>,
}

/// One `[[effect]]`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EffectEntry {
    /// Id of the effect.
    pub id: String,
    /// Where it acts, `tm1`.
    #[serde(default)]
    pub instance: String,
    /// False fixes every coefficient at its value.
    #[serde(default = "yes")]
    pub estimate: bool,
    /// Whether it runs in a process of its own.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub isolate: bool,
    /// Priors by the last part of a coefficient's name, `x`.
    #[serde(default)]
    pub prior: BTreeMap<String, Prior>,
    /// Parameters of the effect.
    #[serde(default)]
    pub parameters: toml::Table,
}

/// What a model file says of one coefficient, in its SI unit.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Prior {
    /// Value before any data, or the fixed value.
    pub value: Option<f64>,
    /// Standard deviation before any data.
    pub sigma: Option<f64>,
    /// Lower end of the range.
    pub lower: Option<f64>,
    /// Upper end of the range.
    pub upper: Option<f64>,
}

fn yes() -> bool {
    true
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    model: Header,
    #[serde(default)]
    effect: Vec<EffectEntry>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Header {
    revision: String,
    parent: Option<String>,
    fixed_from: Option<String>,
}

/// Hexadecimal digits of a digest in a revision's name.
const DIGITS: usize = 6;

impl Model {
    /// Reads a model file.
    ///
    /// # Errors
    /// [`ConfigError`] says what, where and why.
    pub fn load(path: &Path) -> Result<Self, ConfigError> {
        Self::parse(path, &read(path)?)
    }

    /// Reads the text of a model file; `path` is for messages.
    ///
    /// # Errors
    /// [`ConfigError`] says what, where and why.
    pub fn parse(path: &Path, text: &str) -> Result<Self, ConfigError> {
        let file: File = parse(path, text)?;
        let sense = |what: String| ConfigError::Sense { path: path.to_owned(), what };
        for (i, effect) in file.effect.iter().enumerate() {
            if file.effect[..i].iter().any(|e| e.id == effect.id && e.instance == effect.instance) {
                return Err(sense(format!("effect {effect} stands twice; remove one")));
            }
            for (name, prior) in &effect.prior {
                let numbers = [prior.value, prior.sigma, prior.lower, prior.upper];
                if numbers.iter().flatten().any(|x| !x.is_finite()) || prior.sigma.is_some_and(|s| s <= 0.0) {
                    return Err(sense(format!("effect {effect}: prior.{name} must be finite, with sigma above zero")));
                }
            }
        }
        Ok(Self {
            path: path.to_owned(),
            revision: file.model.revision,
            parent: file.model.parent,
            fixed_from: file.model.fixed_from,
            effects: file.effect,
            candidates: Vec::new(),
            chosen: Vec::new(),
            needs: Vec::new(),
        })
    }

    /// Six hexadecimal digits of the SHA-256 of the effects as JSON, keys sorted: comments, formatting, revision and
    /// parent do not enter.
    pub fn digest(&self) -> String {
        let mut effects = serde_json::json!(self.effects);
        effects.sort_all_objects();
        let mut digest = sha256(effects.to_string());
        digest.truncate(DIGITS);
        digest
    }

    /// Name of the revision that makes these effects number `counter`, `2-5f3a9c`.
    pub(crate) fn name(&self, counter: u32) -> String {
        format!("{counter}-{}", self.digest())
    }

    /// Counter and digest of a revision's name that this program made; `None` for a name written by hand.
    pub(crate) fn parts(revision: &str) -> Option<(u32, &str)> {
        let (counter, digest) = revision.split_once('-')?;
        let hexadecimal = digest.len() == DIGITS && digest.bytes().all(|b| matches!(b, b'0'..=b'9' | b'a'..=b'f'));
        Some((counter.parse().ok().filter(|_| hexadecimal)?, digest))
    }

    /// Number of a revision: the counter of its name, or the name itself where that is a number.
    pub fn counter(revision: &str) -> Option<u32> {
        Self::parts(revision).map(|(counter, _)| counter).or_else(|| revision.parse().ok())
    }

    /// Whether the effects are not those that the revision's name has the digest of.
    pub fn edited_by_hand(&self) -> bool {
        Self::parts(&self.revision).is_some_and(|(_, digest)| digest != self.digest())
    }

    /// Revision and parent as products name them. A file that was edited by hand since its revision was made is no
    /// longer that revision: it is a child of it, `2-5f3a9c+0b11d2`.
    pub fn identity(&self) -> (String, Option<String>) {
        if self.edited_by_hand() {
            (format!("{}+{}", self.revision, self.digest()), Some(self.revision.clone()))
        } else {
            (self.revision.clone(), self.parent.clone())
        }
    }
}

/// `com-offset:tm1`, as on the command line.
impl std::fmt::Display for EffectEntry {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.id)?;
        if self.instance.is_empty() { Ok(()) } else { write!(f, ":{}", self.instance) }
    }
}

impl EffectEntry {
    /// An effect whose coefficients are estimated, nothing else said.
    pub fn new(id: &str, instance: &str) -> Self {
        Self {
            id: id.to_owned(),
            instance: instance.to_owned(),
            estimate: true,
            isolate: false,
            prior: BTreeMap::new(),
            parameters: toml::Table::new(),
        }
    }

    /// Start of the names of its coefficients: `es-gain.tm1.y`, which is the whole name where there is one coefficient.
    pub fn coefficient(&self) -> String {
        if self.instance.is_empty() { self.id.clone() } else { format!("{}.{}", self.id, self.instance) }
    }

    /// Whether a coefficient is one of this effect's.
    pub fn owns(&self, coefficient: &str) -> bool {
        coefficient.strip_prefix(&self.coefficient()).is_some_and(|rest| rest.is_empty() || rest.starts_with('.'))
    }

    /// Refuses an instance that the plugin does not have on a mission; a plugin that lists none takes any.
    ///
    /// # Errors
    /// A sentence that lists what there is.
    pub fn check_instance(&self, manifest: &Manifest, mission: &Mission) -> Result<(), String> {
        let instances = manifest.instances_on(&mission.value);
        let place = manifest.place_of(&self.instance);
        if manifest.instances.is_empty() || instances.iter().any(|name| name == place) {
            return Ok(());
        }
        let there = instances.join(", ");
        Err(format!("effect {} has no instance `{}`; it has {there}", self.id, self.instance))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn model(text: &str) -> Model {
        Model::parse(Path::new("m.toml"), text).expect("a model")
    }

    #[test]
    fn a_digest_tells_effects_apart_and_nothing_else() {
        let plain = model("[model]\nrevision = \"1\"\n[[effect]]\nid = \"a\"\ninstance = \"tm1\"\n");
        let same = model(
            "# why\n[model]\nparent = \"1\"\nrevision = \"x\"\n[[effect]]\ninstance='tm1' # here\nid='a'\nestimate=true\n",
        );
        assert_eq!(plain.digest(), same.digest());
        for other in [
            "[[effect]]\nid = \"a\"\ninstance = \"tm2\"\n",
            "[[effect]]\nid = \"a\"\ninstance = \"tm1\"\nestimate = false\n",
            "[[effect]]\nid = \"a\"\ninstance = \"tm1\"\nprior.x.sigma = 0.1\n",
            "[[effect]]\nid = \"a\"\ninstance = \"tm1\"\nparameters = { lag_s = 480 }\n",
            "",
        ] {
            assert_ne!(plain.digest(), model(&format!("[model]\nrevision = \"1\"\n{other}")).digest(), "{other}");
        }
    }

    #[test]
    fn names_of_revisions_are_read_back_and_hand_written_ones_are_left_alone() {
        let effects = "[[effect]]\nid = \"a\"\n";
        let digest = model(&format!("[model]\nrevision = \"1\"\n{effects}")).digest();
        let made = model(&format!("[model]\nrevision = \"12-{digest}\"\nparent = \"1\"\n{effects}"));
        assert_eq!(Model::parts(&made.revision), Some((12, digest.as_str())));
        assert_eq!(made.identity(), (made.revision.clone(), Some("1".to_owned())));
        for by_hand in ["1", "baseline", "2-final", "2035-01-01", "-abcdef", "2-ABCDEF"] {
            assert_eq!(Model::parts(by_hand), None, "{by_hand}");
        }
        let edited = model(&format!("[model]\nrevision = \"12-{digest}\"\nparent = \"1\"\n[[effect]]\nid = \"b\"\n"));
        assert!(edited.edited_by_hand());
        assert_eq!(
            edited.identity(),
            (format!("12-{digest}+{}", edited.digest()), Some(format!("12-{digest}"))),
            "a product must not say that it was made with a revision that it was not made with"
        );
    }

    #[test]
    fn coefficients_belong_to_the_effect_that_their_name_begins_with() {
        let gain = EffectEntry::new("es-gain", "tm1.y");
        assert!(gain.owns("es-gain.tm1.y") && gain.owns("es-gain.tm1.y.a"));
        assert!(!gain.owns("es-gain.tm1.yz") && !gain.owns("es-gain.tm1") && !gain.owns("x.es-gain.tm1.y"));
    }
}
