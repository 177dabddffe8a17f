//! Sums of many days, added in a calendar tree.
//!
//! Addition of floating-point numbers depends on the order. Here it follows the calendar alone: a node stands for
//! 2, 4, 8 … days from a multiple of that number on, and is the sum of its two halves; a day that is missing adds
//! nothing. So whoever adds, in whatever order and on whatever machine, gets the same bits, and a day that comes late
//! changes the nodes above it, one of each length. Nodes of 8, 64, 512 … days are kept in the archive.

use std::collections::BTreeMap;
use std::path::PathBuf;

use dragfree_archive::files::sha256;
use dragfree_archive::product::Product;
use dragfree_archive::{Archive, Sums};
use dragfree_engine::EngineError;
use dragfree_estimation::moments::Moments;
use dragfree_estimation::spectra::Spectra;
use dragfree_estimation::stored::Stored;
use serde::{Deserialize, Serialize};

use crate::WorkflowError;
use crate::days::{DAY_NS, start_of_day_ns};

/// Nodes of every so many levels are kept; those between them are added again from at most 2³ kept ones.
const KEPT_LEVELS: u32 = 3;

/// Nodes have less than 2 to this days.
const MOST_LEVELS: u32 = 20;

/// Changes with the layout of what is kept.
const FORMAT: &str = "dragfree-sums/1";

/// Suffix of a product's sums.
const SUMS: &str = "neq.json";

/// The sums of a day.
#[derive(Clone, Debug)]
pub(crate) struct Leaf {
    /// Archive of the day's product.
    archive: PathBuf,
    /// The day's product.
    pub(crate) product: String,
    /// Digest of its sums.
    pub(crate) sha256: String,
    /// Middle of its data, days after noon.
    pub(crate) after_noon_days: f64,
}

/// A day's sums as they are kept.
#[derive(Serialize, Deserialize)]
struct KeptDay {
    /// Digest of everything but the numbers: days are added where it is the same.
    make: String,
    spectra: Spectra,
}

/// Days by their number, with their sums.
pub(crate) struct Calendar {
    pub(crate) kept: Sums,
    pub(crate) days: BTreeMap<i64, Leaf>,
}

/// 2^level days from `index · 2^level` on.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Node {
    pub(crate) level: u32,
    pub(crate) index: i64,
}

impl Node {
    /// Nodes that are kept, shorter ones first, of days from `first` to `last`.
    pub(crate) fn kept(first: i64, last: i64) -> Vec<Self> {
        let mut nodes = Vec::new();
        for level in (KEPT_LEVELS..MOST_LEVELS).step_by(KEPT_LEVELS as usize) {
            let (from, to) = (first >> level, last >> level);
            nodes.extend((from..=to).map(|index| Self { level, index }));
            if from == to {
                break;
            }
        }
        nodes
    }

    /// Whether a kept node is one of those that it is made of.
    pub(crate) fn made_of(self, other: Self) -> bool {
        other.level + KEPT_LEVELS == self.level && other.index >> KEPT_LEVELS == self.index
    }

    pub(crate) fn first(self) -> i64 {
        self.index << self.level
    }

    pub(crate) fn end(self) -> i64 {
        (self.index + 1) << self.level
    }

    fn middle(self) -> f64 {
        0.5 * (self.first() + self.end()) as f64
    }

    fn halves(self) -> [Self; 2] {
        [2 * self.index, 2 * self.index + 1].map(|index| Self { level: self.level - 1, index })
    }
}

impl Leaf {
    /// Of the product of a day.
    pub(crate) fn new(archive: &Archive, day: i64, product: &Product) -> Result<Self, WorkflowError> {
        let Some(sums) = product.attachments.iter().find(|a| a.suffix == SUMS) else {
            let what = "no stage of its pipeline leaves sums".to_owned();
            return Err(WorkflowError::Reference { path: archive.path_of(product.id()), what });
        };
        let attributes = &product.header.non_standard_attributes;
        let middle_ns = i64::midpoint(attributes.start_time_epoch_ns, attributes.stop_time_epoch_ns);
        Ok(Self {
            archive: archive.folder().to_owned(),
            product: product.id().to_owned(),
            sha256: sums.sha256.clone(),
            after_noon_days: (middle_ns - start_of_day_ns(day) - DAY_NS / 2) as f64 / DAY_NS as f64,
        })
    }

    /// The product's file.
    pub(crate) fn path(&self) -> PathBuf {
        self.archive.join(format!("{}.toml", self.product))
    }
}

impl Calendar {
    /// The sums of a day as its product has them.
    pub(crate) fn stored(&self, day: i64) -> Result<Stored, WorkflowError> {
        let leaf = &self.days[&day];
        let read = || Archive::open(&leaf.archive)?.read_file(&leaf.product, SUMS);
        let text = read().map_err(EngineError::from)?;
        let path = leaf.path().with_extension(SUMS);
        Stored::of_equations(&text).map_err(|e| WorkflowError::Reference { path, what: e.to_string() })
    }

    /// Cross-spectra of a day, and a digest of what they are of.
    pub(crate) fn day(&self, day: i64) -> Result<(Spectra, String), WorkflowError> {
        let key = format!("{FORMAT} day {}", self.days[&day].sha256);
        if let Some(KeptDay { make, spectra }) = self.kept(&key) {
            return Ok((spectra, make));
        }
        let Stored { spectra, ref layout, length, rate_hz, slow_bands, ref declared, format, .. } = self.stored(day)?;
        let make = sha256(serde_json::json!([layout, length, rate_hz, slow_bands, declared, format]).to_string());
        let kept = KeptDay { make, spectra };
        self.keep(&key, &kept);
        Ok((kept.spectra, kept.make))
    }

    /// Sums of the days from `first` to `end`, exclusive. Their time is counted from `origin`, days since 1970.
    pub(crate) fn sum(&self, first: i64, end: i64, origin: f64) -> Result<Moments, WorkflowError> {
        let mut sum = Moments::default();
        let mut at = first;
        while at < end {
            // The longest node that begins here and ends in time.
            let fits = |level: &u32| at.rem_euclid(1 << level) == 0 && at + (1 << level) <= end;
            let level = (0..MOST_LEVELS).rev().find(fits).unwrap_or(0);
            let node = Node { level, index: at >> level };
            if let Some(own) = self.node(node)? {
                sum.add(&own.shifted(node.middle() - origin));
            }
            at = node.end();
        }
        Ok(sum)
    }

    /// The sums of a node about its middle; none where it has no day.
    pub(crate) fn node(&self, node: Node) -> Result<Option<Moments>, WorkflowError> {
        let days: Vec<(&i64, &Leaf)> = self.days.range(node.first()..node.end()).collect();
        if days.is_empty() {
            return Ok(None);
        }
        if node.level == 0 {
            let (spectra, _) = self.day(node.index)?;
            return Ok(Some(Moments::of_day(spectra, self.days[&node.index].after_noon_days)));
        }
        let key = || {
            let of = |(day, leaf): &(&i64, &Leaf)| format!("{day} {} {}", leaf.sha256, leaf.after_noon_days.to_bits());
            let all: Vec<String> = days.iter().map(of).collect();
            format!("{FORMAT} node {} {} {}", node.level, node.index, all.join(" "))
        };
        let is_kept = node.level.is_multiple_of(KEPT_LEVELS);
        if let Some((spectra, first, second)) = is_kept.then(|| self.kept(&key())).flatten() {
            return Ok(Some(Moments { spectra, first, second }));
        }
        let mut sum: Option<Moments> = None;
        for half in node.halves() {
            let Some(own) = self.node(half)? else { continue };
            let own = own.shifted(half.middle() - node.middle());
            match &mut sum {
                Some(sum) => sum.add(&own),
                None => sum = Some(own),
            }
        }
        if let Some(Moments { spectra, first, second }) = sum.as_ref().filter(|_| is_kept) {
            self.keep(&key(), &(spectra, first, second));
        }
        Ok(sum)
    }

    fn kept<T: for<'de> Deserialize<'de>>(&self, key: &str) -> Option<T> {
        postcard::from_bytes(&self.kept.get(key)?).ok()
    }

    fn keep(&self, key: &str, what: &impl Serialize) {
        if let Ok(content) = postcard::to_stdvec(what) {
            self.kept.keep(key, &content);
        }
    }
}
