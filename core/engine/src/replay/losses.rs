//! Defects that a replay finds in its data: counted by kind, described, never skipped silently.

use std::collections::{BTreeMap, BTreeSet};

use serde::Serialize;

use dragfree_archive::product::Loss;

/// Sentences kept of each kind; the counts go on.
const MESSAGES_PER_KIND: usize = 8;

/// One kind of finding; its name is the key of the count in a product.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Finding {
    /// A file that ends before its end: cut, or still being written.
    TruncatedFiles,
    /// A file without a byte.
    EmptyFiles,
    /// A chunk whose CRC, compression or size is wrong; all its messages are lost.
    CorruptChunks,
    /// A chunk that is too large, or compressed in another way; all its messages are lost.
    UnreadableChunks,
    /// A file whose data section is not what its CRC says, with messages that no other CRC covers: they were read, and
    /// may be wrong.
    DamagedDataSections,
    /// A message that the statistics of its file count and the file does not hold.
    MissingMessages,
    /// A record that makes no sense where it stands; what it held is lost.
    DamagedRecords,
    /// A message that is not what its schema says; lost.
    MalformedMessages,
    /// A message on a channel that the file does not define; lost.
    MessagesOfUnknownChannels,
    /// A message before 1980 or after 2200; dropped.
    TimesOutOfRange,
    /// A message more than a day from all others, or one of two or three together: its clock had failed; dropped.
    StrayMessages,
    /// A message earlier than its file's index says, found too late to be put in order; lost.
    LateMessages,
    /// An epoch of a stretch in which the clock of its topic was wrong: as many messages are missing on one side of it
    /// as have a second one on the other; its rows are there, with doubtful times.
    SteppedClocks,
    /// A message of a time at which its topic already has other values; the first in the order of the files counts.
    ConflictingMessages,
    /// A message that repeats one of the same topic, time and values; dropped.
    DuplicateMessages,
    /// A message with an earlier time than the one before it on its channel; put in order.
    BackwardTimes,
    /// A transmitted value that is NaN or infinite; passed on.
    NonFiniteValues,
    /// A message of a topic that is not in the interface; not read.
    MessagesOfUnknownTopics,
    /// A message of `/truth`, which a calibration must not see; not read.
    TruthMessages,
    /// A field that cannot be a column (repeated, text, 64-bit integers), per channel; not read.
    IgnoredFields,
    /// A housekeeping channel that does not state its unit.
    MissingUnits,
    /// A file without a `dragfree` metadata record, so nobody knows whose it is.
    FilesWithoutMetadata,
    /// A chunk written without a CRC.
    ChunksWithoutCrc,
    /// A file with messages that no CRC covers.
    UncheckedFiles,
    /// A file whose data section is not what its CRC says, where CRCs of their own show that every message is right.
    DamageBesideMessages,
    /// A file without a usable summary; its channels were found by reading all of it.
    FilesWithoutSummary,
    /// A file without a message.
    FilesWithoutMessages,
    /// A topic of the interface that is defined and has no message in any file; it makes no table.
    TopicsWithoutMessages,
}

impl Finding {
    /// True where data were there and are not in the tables.
    pub fn is_loss(self) -> bool {
        self <= Self::ConflictingMessages
    }
}

impl std::fmt::Display for Finding {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.serialize(f)
    }
}

/// Counts of findings, and the first sentences of each kind.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Losses {
    counts: BTreeMap<Finding, u64>,
    messages: Vec<(Finding, String)>,
    /// What was told already: a kind, and the file or topic it concerns.
    told: BTreeSet<(Finding, String)>,
}

/// What was met in the data that were asked for, and in those before them that only settle the stages.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Findings {
    /// In the data, and in whatever may have held some of them.
    pub of_data: Losses,
    /// In what ends before the data begin.
    pub of_run_in: Losses,
}

impl Findings {
    /// Where a finding belongs in something that ends before `end_ns`, where the data begin at `run_in_until_ns`.
    pub(super) fn before(&mut self, end_ns: i64, run_in_until_ns: i64) -> &mut Losses {
        if end_ns <= run_in_until_ns { &mut self.of_run_in } else { &mut self.of_data }
    }
}

impl Losses {
    /// How often `finding` was met.
    pub fn count(&self, finding: Finding) -> u64 {
        self.counts.get(&finding).copied().unwrap_or(0)
    }

    /// Everything met, by the key of its kind.
    pub fn counts(&self) -> BTreeMap<String, u64> {
        self.counts.iter().map(|(finding, &count)| (finding.to_string(), count)).collect()
    }

    /// What was lost, as a product states it.
    pub fn entries(&self) -> Vec<Loss> {
        let of = |finding| self.messages.iter().filter(move |(f, _)| *f == finding).map(|(_, text)| text.as_str());
        let lost = self.counts.iter().filter(|(finding, _)| finding.is_loss());
        lost.map(|(&finding, &count)| Loss {
            kind: finding.to_string(),
            count,
            detail: of(finding).collect::<Vec<_>>().join("; "),
        })
        .collect()
    }

    /// What was odd and cost no data, in the order of its finding: the first sentences of each kind.
    pub fn notes(&self) -> Vec<String> {
        self.messages.iter().filter(|(finding, _)| !finding.is_loss()).map(|(_, text)| text.clone()).collect()
    }

    /// True when data were lost.
    pub fn data_loss(&self) -> bool {
        self.counts.keys().any(|f| f.is_loss())
    }

    /// Counts `times` of `finding`, nothing when that is 0. The sentence is kept once for each `subject`, a file or a
    /// topic, and while there are few of the kind.
    pub(super) fn add(&mut self, finding: Finding, times: u64, subject: &str, sentence: impl FnOnce() -> String) {
        if times == 0 {
            return;
        }
        *self.counts.entry(finding).or_default() += times;
        let of_kind = self.told.range((finding, String::new())..).take_while(|(f, _)| *f == finding).count();
        if of_kind < MESSAGES_PER_KIND && self.told.insert((finding, subject.to_owned())) {
            self.messages.push((finding, sentence()));
        }
    }
}
