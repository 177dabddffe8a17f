//! The replay against files of other writers, damaged files and hostile ones.

use std::collections::{BTreeMap, BTreeSet};
use std::io::Cursor;
use std::path::{Path, PathBuf};

use mcap::records::{MessageHeader, Metadata};
use mcap::{Compression, WriteOptions};
use proptest::prelude::*;

use super::losses::Finding;
use super::*;
use crate::table::Batch;
use crate::telemetry::{Cells, Decoder, FileHeader, Layout, TelemetryWriter, check, column, descriptor, expected};

/// 2035-01-01T00:00:00Z, Unix ns.
const DAY: i64 = 2_051_222_400_000_000_000;
const EPOCH: i64 = 100_000_000;

/// A `Dws` message by hand: `tm1 { theta_orf_rad: v }, status`, as any producer would write it.
fn dws(value: f64, status: u8) -> Vec<u8> {
    let mut bytes = vec![0x0a, 9, 0x09];
    bytes.extend(value.to_le_bytes());
    bytes.extend([0x20, status]);
    bytes
}

/// A `Scalar` message by hand.
fn scalar(value: f64) -> Vec<u8> {
    let mut bytes = vec![0x09];
    bytes.extend(value.to_le_bytes());
    bytes
}

type Messages = Vec<(&'static str, i64, Vec<u8>)>;

/// A file of another writer, the `mcap` crate.
struct Foreign {
    messages: Messages,
    options: WriteOptions,
    metadata: Vec<(&'static str, &'static str)>,
    unit: &'static str,
}

impl Foreign {
    fn new(messages: Messages) -> Self {
        let options = WriteOptions::new().compression_threads(0).chunk_size(Some(2000));
        Self { messages, options, metadata: vec![("time_scale", "TAI"), ("spacecraft", "SC1")], unit: "A" }
    }

    fn bytes(self) -> Vec<u8> {
        let mut writer = self.options.create(Cursor::new(Vec::new())).unwrap();
        if !self.metadata.is_empty() {
            let metadata = self.metadata.iter().map(|(k, v)| ((*k).to_owned(), (*v).to_owned())).collect();
            writer.write_metadata(&Metadata { name: "dragfree".into(), metadata }).unwrap();
        }
        let mut channels: BTreeMap<&str, u16> = BTreeMap::new();
        for (topic, time, data) in &self.messages {
            let channel_id = *channels.entry(topic).or_insert_with(|| {
                let (name, set) =
                    descriptor(topic).unwrap_or(("dragfree.telemetry.v1.Scalar", descriptor("/hk/x").unwrap().1));
                let schema = writer.add_schema(name, "protobuf", set).unwrap();
                let metadata = BTreeMap::from([("unit".into(), self.unit.into()), ("place".into(), "bus".into())]);
                writer.add_channel(schema, topic, "protobuf", &metadata).unwrap()
            });
            let log_time = *time as u64;
            writer
                .write_to_known_channel(&MessageHeader { channel_id, sequence: 0, log_time, publish_time: 0 }, data)
                .unwrap();
        }
        writer.finish().unwrap();
        writer.into_inner().into_inner()
    }
}

/// `count` epochs of `/dws` from epoch `first`; the value is the number of the epoch.
fn epochs(first: i64, count: i64) -> Messages {
    (first..first + count).map(|k| ("/dws", DAY + k * EPOCH, dws(k as f64, 0))).collect()
}

/// All that a replay gives: tables, rows of each, losses.
#[derive(Debug, PartialEq)]
struct Outcome {
    tables: Vec<TableSpec>,
    rows: BTreeMap<String, Batch>,
    losses: Losses,
}

impl Outcome {
    fn count(&self, finding: Finding) -> u64 {
        self.losses.count(finding)
    }

    fn values(&self, table: &str, column: &str) -> Vec<f64> {
        let spec = self.tables.iter().find(|t| t.name == table).unwrap();
        let at = spec.columns.iter().position(|c| c.name == column).unwrap();
        self.rows[table].columns[at].clone()
    }

    /// Numbers of the epochs of [`epochs`] that came, which must be in order and each once.
    fn numbers(&self) -> Vec<i64> {
        let numbers: Vec<i64> = self.values("dws", "tm1.theta_orf_rad").iter().map(|v| *v as i64).collect();
        assert!(numbers.is_sorted_by(|a, b| a < b));
        assert!(numbers.iter().zip(&self.rows["dws"].time_ns).all(|(k, t)| DAY + k * EPOCH == *t));
        numbers
    }
}

/// Writes files into `folder`.
fn stored(folder: &Path, files: &[Vec<u8>]) -> Vec<PathBuf> {
    let store = |(i, bytes): (usize, &Vec<u8>)| {
        let path = folder.join(format!("file{i}.mcap"));
        std::fs::write(&path, bytes).unwrap();
        path
    };
    files.iter().enumerate().map(store).collect()
}

/// A schema from outside: no panic, no endless loop, no unbounded memory.
fn fuzz_schema(bytes: &[u8]) {
    if let Ok(layout) = Layout::parse(bytes, "dragfree.telemetry.v1.Dws") {
        let _ = check("/dws", &layout);
        let mut values = vec![f64::NAN; layout.leaves().len()];
        let _ = Decoder::new(&layout).decode(bytes, &mut Cells { values: &mut values, rows: 1, row: 0 });
    }
}

/// A message from outside, against every message of the interface.
fn fuzz_message(bytes: &[u8]) {
    for layout in ["/is", "/ifo", "/dws", "/command", "/ephemeris", "/hk/x", "/truth"].into_iter().filter_map(expected)
    {
        let mut values = vec![f64::NAN; layout.leaves().len()];
        let _ = Decoder::new(layout).decode(bytes, &mut Cells { values: &mut values, rows: 1, row: 0 });
    }
}

/// A file from outside. Returns how many rows it gave.
fn fuzz_file(bytes: &[u8]) -> usize {
    let folder = tempfile::tempdir().unwrap();
    let Ok(mut replay) = Replay::open(&stored(folder.path(), &[bytes.to_vec()]), None, 1) else { return 0 };
    let mut rows = 0;
    while let Ok(Some(chunk)) = replay.next() {
        rows += chunk.batches.iter().map(Batch::rows).sum::<usize>();
    }
    rows
}

fn drive(files: &[Vec<u8>], window: Option<Range<i64>>, threads: usize) -> Result<(Outcome, Vec<Chunk>), ReplayError> {
    let folder = tempfile::tempdir().unwrap();
    drive_files(&stored(folder.path(), files), window, threads)
}

fn drive_files(
    files: &[PathBuf],
    window: Option<Range<i64>>,
    threads: usize,
) -> Result<(Outcome, Vec<Chunk>), ReplayError> {
    let mut replay = Replay::open(files, window, threads)?;
    let tables = replay.tables().to_vec();
    let mut rows: BTreeMap<String, Batch> =
        tables.iter().map(|t| (t.name.clone(), Batch::empty(t.columns.len()))).collect();
    let mut chunks = vec![];
    let mut before = i64::MIN;
    while let Some(chunk) = replay.next()? {
        for (table, batch) in tables.iter().zip(&chunk.batches) {
            assert!(batch.time_ns.iter().all(|t| (before..chunk.complete_until_ns).contains(t)));
            let all = rows.get_mut(&table.name).unwrap();
            all.time_ns.extend(&batch.time_ns);
            all.columns.iter_mut().zip(&batch.columns).for_each(|(a, b)| a.extend(b));
        }
        before = chunk.complete_until_ns;
        chunks.push(chunk);
    }
    assert!(replay.next()?.is_none(), "the end is the end");
    assert_eq!(replay.digests()?.len(), files.len());
    Ok((Outcome { tables, rows, losses: replay.losses().clone() }, chunks))
}

/// Every bit of the chunks: NaN is equal to itself here.
fn bits(chunks: &[Chunk]) -> Vec<u64> {
    let mut bits = vec![];
    for chunk in chunks {
        bits.push(chunk.complete_until_ns as u64);
        for batch in &chunk.batches {
            bits.push(batch.rows() as u64);
            bits.extend(batch.time_ns.iter().map(|t| *t as u64));
            bits.extend(batch.columns.iter().flatten().map(|v| v.to_bits()));
        }
    }
    bits
}

/// Replays with one thread and with two, which must agree to the bit.
fn replay_window(files: &[Vec<u8>], window: Option<Range<i64>>) -> Result<Outcome, ReplayError> {
    let folder = tempfile::tempdir().unwrap();
    let files = stored(folder.path(), files);
    let (one, chunks) = drive_files(&files, window.clone(), 1)?;
    let (two, chunks_of_two) = drive_files(&files, window, 2)?;
    assert_eq!(bits(&chunks), bits(&chunks_of_two));
    assert_eq!(one.losses, two.losses);
    Ok(one)
}

fn replay(files: &[Vec<u8>]) -> Outcome {
    replay_window(files, None).unwrap()
}

fn sound(outcome: &Outcome) {
    assert_eq!(outcome.losses, Losses::default());
}

#[test]
fn a_sound_file_of_another_writer() {
    let mut messages = epochs(0, 500);
    messages.push(("/hk/battery", DAY + 1, scalar(7.5)));
    let outcome = replay(&[Foreign::new(messages).bytes()]);
    sound(&outcome);
    assert_eq!(outcome.numbers(), (0..500).collect::<Vec<_>>());
    assert_eq!(outcome.values("hk/battery", "value"), [7.5]);
    assert_eq!(outcome.tables.iter().map(|t| t.name.as_str()).collect::<Vec<_>>(), ["dws", "hk/battery"]);
    let value = &outcome.tables[1].columns[0];
    assert_eq!((value.unit.as_str(), value.attributes["place"].as_str()), ("A", "bus"));
    let theta = &outcome.tables[0].columns[0];
    assert_eq!((theta.unit.as_str(), theta.frame.as_str()), ("rad", "ORF_1"));
    assert!(outcome.values("dws", "tm2.psi_orf_rad").iter().all(|v| v.is_nan()), "absent sub-message");
    assert!(outcome.values("dws", "tm1.psi_orf_rad").iter().all(|v| *v == 0.0), "absent scalar");
}

#[test]
fn every_way_of_storing_gives_the_same() {
    type Edit = fn(WriteOptions) -> WriteOptions;
    let plain = replay(&[Foreign::new(epochs(0, 300)).bytes()]);
    let stored = |edit: Edit| {
        let mut file = Foreign::new(epochs(0, 300));
        file.options = edit(file.options);
        replay(&[file.bytes()])
    };
    let cases: [(Edit, Option<Finding>); 10] = [
        (|o| o.compression(Some(Compression::Lz4)), None),
        (|o| o.compression(None), None),
        (|o| o.use_chunks(false), None),
        (|o| o.chunk_size(None), None),
        (|o| o.calculate_chunk_crcs(false), Some(Finding::ChunksWithoutCrc)),
        (|o| o.emit_summary_records(false).emit_summary_offsets(false), Some(Finding::FilesWithoutSummary)),
        (|o| o.repeat_channels(false), Some(Finding::FilesWithoutSummary)),
        (|o| o.emit_chunk_indexes(false), Some(Finding::FilesWithoutSummary)),
        (|o| o.emit_message_indexes(false), None),
        (|o| o.calculate_summary_section_crc(false).calculate_data_section_crc(false), None),
    ];
    for (edit, finding) in cases {
        let other = stored(edit);
        assert_eq!(other.numbers(), plain.numbers());
        assert!(!other.losses.data_loss(), "{:?}", other.losses);
        // The crate leaves chunks without a CRC out of that of the data section.
        let counts = usize::from(finding.is_some()) + usize::from(finding == Some(Finding::ChunksWithoutCrc));
        assert_eq!(other.losses.counts().len(), counts, "{:?}", other.losses);
        assert!(finding.is_none_or(|f| other.count(f) > 0), "{:?}", other.losses);
    }
}

#[test]
fn overlapping_files_in_any_order() {
    let files = [epochs(0, 100), epochs(50, 100), epochs(400, 20), epochs(140, 100)].map(|m| Foreign::new(m).bytes());
    let expected: Vec<i64> = (0..240).chain(400..420).collect();
    let forth = replay(&files);
    assert_eq!(forth.numbers(), expected);
    assert_eq!(forth.count(Finding::DuplicateMessages), 60);
    assert_eq!(forth.count(Finding::ConflictingMessages), 0);
    let mut back = files.to_vec();
    back.reverse();
    assert_eq!(replay(&back).rows["dws"].time_ns, forth.rows["dws"].time_ns);
}

#[test]
fn of_conflicting_values_the_first_file_counts() {
    let other = vec![("/dws", DAY + 5 * EPOCH, dws(-1.0, 0))];
    let outcome = replay(&[Foreign::new(other).bytes(), Foreign::new(epochs(0, 10)).bytes()]);
    assert_eq!(outcome.numbers(), (0..10).collect::<Vec<_>>());
    assert_eq!(outcome.count(Finding::ConflictingMessages), 1);
    assert_eq!(outcome.count(Finding::DuplicateMessages), 0);
    assert!(outcome.losses.data_loss(), "the other values were there and are not in the tables");
}

/// Two files that begin at once, in folders of either order: a day made again elsewhere must come out the same.
#[test]
fn of_conflicting_values_those_of_the_same_file_count_wherever_it_lies() {
    let of = |value: f64| Foreign::new(vec![("/dws", DAY, dws(value, 0))]).bytes();
    let folder = tempfile::tempdir().unwrap();
    for (a, b) in [("1", "2"), ("2", "1")] {
        let paths = [(a, "a.mcap", 1.0), (b, "b.mcap", 2.0)].map(|(under, name, value)| {
            let path = folder.path().join(under).join(name);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(&path, of(value)).unwrap();
            path
        });
        let (outcome, _) = drive_files(&paths, None, 1).unwrap();
        assert_eq!(outcome.values("dws", "tm1.theta_orf_rad"), [1.0], "a.mcap in folder {a}");
    }
}

/// Late by 0.3 s for a minute: three epochs without a message, and three with two.
#[test]
fn a_clock_that_is_wrong_for_a_while_is_told_and_a_loss() {
    let late: Messages = (0..2_000)
        .map(|k| ("/dws", DAY + (if (700..1_300).contains(&k) { k + 3 } else { k }) * EPOCH, dws(k as f64, 0)))
        .collect();
    let outcome = replay(&[Foreign::new(late).bytes()]);
    assert_eq!(outcome.count(Finding::ConflictingMessages), 3);
    assert_eq!(outcome.count(Finding::SteppedClocks), 597);
    let said = outcome.losses.entries();
    let told = said.iter().find(|loss| loss.kind == "stepped_clocks").expect("told");
    assert!(told.detail.contains("/dws: its clock was 0.3 s late from 00:01:10 on for 597 epochs"), "{}", told.detail);
}

#[test]
fn unsorted_messages_are_put_in_order() {
    // 40,000 epochs are ten stretches; 200,000 lie beyond the horizon of sixteen, so pieces are read again.
    for count in [1_000, 40_000, 200_000] {
        let mut messages = epochs(0, count);
        let step = 7_919; // prime, and no divisor of the counts: a permutation without order
        let shuffled: Messages = (0..count).map(|k| messages[(k * step % count) as usize].clone()).collect();
        messages = shuffled;
        let mut file = Foreign::new(messages);
        file.options = file.options.chunk_size(Some(1 << 20));
        let outcome = replay(&[file.bytes()]);
        assert_eq!(outcome.numbers(), (0..count).collect::<Vec<_>>());
        assert!(outcome.count(Finding::BackwardTimes) > 0);
        assert!(!outcome.losses.data_loss());
    }
}

#[test]
fn a_gap_is_jumped_and_a_window_is_kept() {
    let year = 315_360_000;
    let messages: Messages = epochs(0, 10).into_iter().chain(epochs(year, 10)).collect();
    let file = [Foreign::new(messages).bytes()];
    let (outcome, chunks) = drive(&file, None, 1).unwrap();
    assert_eq!(chunks.len(), 2, "a year without data costs no stretches");
    assert_eq!(outcome.numbers(), (0..10).chain(year..year + 10).collect::<Vec<_>>());
    let window = replay_window(&file, Some(DAY + 3 * EPOCH..DAY + 7 * EPOCH)).unwrap();
    assert_eq!(window.numbers(), [3, 4, 5, 6]);
    sound(&window);
}

#[test]
fn borders_do_not_depend_on_where_data_begin() {
    let borders = |first| -> Vec<i64> {
        let file = [Foreign::new(epochs(first, 20_000 - first)).bytes()];
        drive(&file, None, 1).unwrap().1.iter().map(|c| c.complete_until_ns).collect()
    };
    let (all, late) = (borders(0), borders(777));
    assert!(all.len() > 4 && all.ends_with(&late), "{all:?} {late:?}");
}

#[test]
fn nothing_is_made_up_when_a_file_is_cut() {
    let whole = Foreign::new(epochs(0, 300)).bytes();
    let mut most = 0;
    for end in (0..whole.len()).step_by(7) {
        let outcome = replay(&[whole[..end].to_vec()]);
        let came = if outcome.tables.is_empty() { vec![] } else { outcome.numbers() };
        assert_eq!(came, (0..came.len() as i64).collect::<Vec<_>>(), "what comes is the beginning");
        assert!(came.len() >= most, "a longer file holds no less");
        most = came.len();
        assert!(came.len() == 300 || outcome.losses.data_loss(), "cut at {end}: {:?}", outcome.losses);
    }
    assert_eq!(most, 300, "the summary alone may be missing");
}

#[test]
fn a_flipped_bit_loses_its_chunk_and_says_so() {
    let whole = Foreign::new(epochs(0, 300)).bytes();
    let mut survived = BTreeSet::new();
    for byte in (0..whole.len()).step_by(5) {
        let mut damaged = whole.clone();
        damaged[byte] ^= 1 << (byte / 5 % 8);
        // Headers and the metadata record stand outside every CRC: there a flip may make another file of it.
        let Ok(outcome) = replay_window(&[damaged], None) else { continue };
        let came = if outcome.tables.is_empty() { vec![] } else { outcome.numbers() };
        assert!(came.iter().all(|k| (0..300).contains(k)));
        assert!(came.len() == 300 || outcome.losses.data_loss(), "byte {byte}: {:?}", outcome.losses);
        survived.insert(came.len());
    }
    assert!(survived.len() > 1 && survived.iter().min() > Some(&150), "one chunk of several is lost: {survived:?}");
}

/// A file without chunks has one CRC for all its messages; it was never compared, and 143 of 300 flips went unseen.
#[test]
fn a_flipped_bit_outside_of_chunks_is_told() {
    let mut file = Foreign::new(epochs(0, 300));
    file.options = file.options.use_chunks(false);
    let whole = file.bytes();
    let sound = replay(std::slice::from_ref(&whole));
    let mut told = BTreeSet::new();
    for byte in (8..whole.len()).step_by(11) {
        let mut damaged = whole.clone();
        damaged[byte] ^= 1 << (byte / 11 % 8);
        let Ok(outcome) = replay_window(&[damaged], None) else { continue };
        let same = bits_of(&outcome) == bits_of(&sound);
        assert!(same || outcome.losses.data_loss(), "byte {byte}: {:?}", outcome.losses);
        told.extend(outcome.losses.counts().into_keys());
    }
    assert!(told.contains("damaged_data_sections"), "{told:?}");
    let mut unchecked = Foreign::new(epochs(0, 5));
    unchecked.options = unchecked.options.use_chunks(false).calculate_data_section_crc(false);
    assert_eq!(replay(&[unchecked.bytes()]).count(Finding::UncheckedFiles), 1);
}

fn bits_of(outcome: &Outcome) -> Vec<u64> {
    let cells = outcome.rows.values().flat_map(|batch| batch.columns.iter().flatten().map(|v| v.to_bits()));
    cells.chain(outcome.rows.values().flat_map(|batch| batch.time_ns.iter().map(|t| *t as u64))).collect()
}

/// Where the header of every chunk begins, after its operation code and length.
fn chunk_headers(file: &[u8]) -> Vec<usize> {
    let summary = mcap::Summary::read(file).unwrap().unwrap();
    summary.chunk_indexes.iter().map(|index| index.chunk_start_offset as usize + 9).collect()
}

/// The size of a chunk's records stands in its header, outside of every CRC but the file's: with 0 in it the chunk was
/// left out, and nothing said so.
#[test]
fn a_chunk_that_says_it_is_empty_is_no_silent_loss() {
    for compression in [None, Some(Compression::Zstd), Some(Compression::Lz4)] {
        let mut file = Foreign::new(epochs(0, 300));
        file.options = file.options.compression(compression);
        let mut bytes = file.bytes();
        let header = chunk_headers(&bytes)[1];
        bytes[header + 16..header + 24].copy_from_slice(&0_u64.to_le_bytes());
        let outcome = replay(&[bytes]);
        assert_eq!(outcome.count(Finding::CorruptChunks), 1, "{compression:?}: {:?}", outcome.losses);
        let missing = 300 - outcome.numbers().len() as u64;
        assert!(missing > 0);
        assert_eq!(outcome.count(Finding::MissingMessages), missing, "{:?}", outcome.losses);
    }
}

/// Neither is mended by fetching the file again, so that something else is said of them.
#[test]
fn a_chunk_that_nobody_could_read_says_what_helps() {
    let mut large = Foreign::new(epochs(0, 300)).bytes();
    let header = chunk_headers(&large)[1];
    large[header + 16..header + 24].copy_from_slice(&(200_u64 << 20).to_le_bytes());
    let mut other = Foreign::new(epochs(0, 300)).bytes();
    assert_eq!(&other[header + 32..header + 36], b"zstd");
    other[header + 32..header + 36].copy_from_slice(b"brot");
    for (bytes, remedy) in [(large, "in chunks of a few MiB"), (other, "write it again with zstd")] {
        let outcome = replay(&[bytes]);
        assert_eq!(outcome.count(Finding::UnreadableChunks), 1, "{:?}", outcome.losses);
        let said = outcome.losses.entries();
        assert!(said[0].detail.contains(remedy) && !said[0].detail.contains("fetch"), "{said:?}");
    }
}

/// Damage in a file that ends before the data begin costs these nothing; the same damage in their own file does.
#[test]
fn what_is_lost_before_the_data_is_no_loss_of_theirs() {
    let halves = || [Foreign::new(epochs(0, 300)).bytes(), Foreign::new(epochs(300, 300)).bytes()];
    for damaged in [0, 1] {
        let mut files = halves();
        let header = chunk_headers(&files[damaged])[1];
        files[damaged][header + 16..header + 24].copy_from_slice(&0_u64.to_le_bytes());
        let folder = tempfile::tempdir().unwrap();
        let files = stored(folder.path(), &files);
        for threads in [1, 2] {
            let begin_ns = Some(DAY + 300 * EPOCH);
            let mut replay = Replay::open_with_run_in(&files, None, begin_ns, threads).unwrap();
            while replay.next().unwrap().is_some() {}
            let (data, run_in) = (replay.losses(), replay.losses_of_run_in());
            let (with, without) = if damaged == 0 { (run_in, data) } else { (data, run_in) };
            assert_eq!(with.count(Finding::CorruptChunks), 1, "file {damaged}");
            assert!(with.count(Finding::MissingMessages) > 0, "file {damaged}");
            assert_eq!(*without, Losses::default(), "file {damaged}");
        }
    }
}

/// Chunks that vanish with their entries of the index leave the statistics, which say what should be there.
#[test]
fn messages_that_the_statistics_count_are_missed() {
    let whole = Foreign::new(epochs(0, 300)).bytes();
    let summary = mcap::Summary::read(&whole).unwrap().unwrap();
    let chunk = &summary.chunk_indexes[1];
    let mut damaged = whole;
    // Another operation code: a record that readers pass over. Neither it nor its index entry is a chunk any more.
    damaged[chunk.chunk_start_offset as usize] = 0x80;
    let start = footer_of(&damaged);
    let index_at = find_chunk_index(&damaged, start, chunk.chunk_start_offset);
    damaged[index_at] = 0x80;
    let end = damaged.len();
    damaged[end - 12..end - 8].fill(0); // the sum of the summary: 0 stands for none
    let outcome = replay(&[damaged]);
    let missing = 300 - outcome.numbers().len() as u64;
    assert!(missing > 0 && outcome.count(Finding::MissingMessages) == missing, "{:?}", outcome.losses);
    let window = Some(DAY..DAY + EPOCH);
    let part = replay_window(&[Foreign::new(epochs(0, 300)).bytes()], window).unwrap();
    assert_eq!(part.count(Finding::MissingMessages), 0, "what nobody asked for is not missing");
}

/// Where the summary of a file begins, by its footer.
fn footer_of(file: &[u8]) -> usize {
    let body = file.len() - 8 - 20;
    u64::from_le_bytes(file[body..body + 8].try_into().unwrap()) as usize
}

fn find_chunk_index(file: &[u8], mut at: usize, chunk: u64) -> usize {
    loop {
        let length = u64::from_le_bytes(file[at + 1..at + 9].try_into().unwrap()) as usize;
        let of_chunk = file[at] == 0x08 && file[at + 25..at + 33] == chunk.to_le_bytes();
        if of_chunk {
            return at;
        }
        at += 9 + length;
    }
}

/// Damage to an index record costs no message, and says so.
#[test]
fn damage_beside_messages_is_a_note() {
    let mut bytes = Foreign::new(epochs(0, 300)).bytes();
    let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
    let chunk = &summary.chunk_indexes[1];
    let index = (chunk.chunk_start_offset + chunk.chunk_length) as usize;
    bytes[index + 9 + 6] ^= 4;
    let outcome = replay(&[bytes]);
    assert_eq!(outcome.count(Finding::DamageBesideMessages), 1, "{:?}", outcome.losses);
    assert!(!outcome.losses.data_loss());
    assert_eq!(outcome.numbers().len(), 300);
}

/// 514 kB became 7.6 GB, and the program aborted.
#[test]
fn what_grows_beyond_measure_is_refused() {
    let zeros = zstd::bulk::compress(&vec![0; 100 << 20], 3).unwrap();
    let mut bytes = Foreign::new(epochs(0, 300)).bytes();
    let header = chunk_headers(&bytes)[1];
    bytes[header + 16..header + 24].copy_from_slice(&(100_u64 << 20).to_le_bytes());
    bytes[header + 24..header + 28].fill(0);
    let size_at = header + 28 + 4 + 4; // after "zstd"
    let stored = u64::from_le_bytes(bytes[size_at..size_at + 8].try_into().unwrap()) as usize;
    assert_eq!(&bytes[header + 32..header + 36], b"zstd");
    bytes.splice(size_at + 8..size_at + 8 + stored, zeros.iter().copied());
    bytes[size_at..size_at + 8].copy_from_slice(&(zeros.len() as u64).to_le_bytes());
    bytes[header - 8..header].copy_from_slice(&(44 + zeros.len() as u64).to_le_bytes());
    let outcome = replay(&[bytes]);
    assert!(outcome.count(Finding::CorruptChunks) == 1, "{:?}", outcome.losses);
    let said = outcome.losses.entries();
    assert!(said.iter().any(|loss| loss.detail.contains("are to become 104857600")), "{said:?}");

    // Two million rows in one chunk: a sentence, and no gigabytes.
    let many: Messages = (0..2_200_000).map(|k| ("/ephemeris", DAY + k, vec![])).collect();
    let mut file = Foreign::new(many);
    file.options = file.options.chunk_size(None).compression(None);
    let outcome = replay_window(&[file.bytes()], None);
    assert!(matches!(outcome, Err(ReplayError::TooMuchAtOnce { .. })));
}

/// Each chunk was read from whatever lay at the path at that time: rows of two files, and the digest of the second.
#[test]
fn a_file_replaced_in_mid_replay_gives_no_product_of_two_files() {
    let folder = tempfile::tempdir().unwrap();
    let files = stored(folder.path(), &[Foreign::new(epochs(0, 40_000)).bytes()]);
    let mut replay = Replay::open(&files, None, 1).unwrap();
    let first = replay.next().unwrap().unwrap();
    let other = epochs(0, 40_000).into_iter().map(|(topic, time, _)| (topic, time, dws(-1.0, 0))).collect();
    let beside = folder.path().join("beside");
    std::fs::write(&beside, Foreign::new(other).bytes()).unwrap();
    std::fs::rename(&beside, &files[0]).unwrap();
    let mut negative = 0;
    while let Some(chunk) = replay.next().unwrap() {
        negative += chunk.batches[0].columns[0].iter().filter(|v| **v < 0.0).count();
    }
    assert!(first.batches[0].rows() > 0 && negative == 0, "{negative} rows of the other file");
    assert!(matches!(replay.digests(), Err(ReplayError::Changed { .. })));
}

#[test]
fn lengths_that_overflow() {
    let whole = Foreign::new(epochs(0, 300)).bytes();
    // The length of every record of the data section in turn, as far as the walk would see it.
    let mut at = 8;
    let mut records = 0;
    while whole[at] != 0x0f {
        let length = u64::from_le_bytes(whole[at + 1..at + 9].try_into().unwrap());
        for hostile in [u64::MAX, i64::MAX as u64, u64::MAX - at as u64 - 8, 0] {
            let mut damaged = whole.clone();
            damaged[at + 1..at + 9].copy_from_slice(&hostile.to_le_bytes());
            let outcome = replay(&[damaged]);
            let came = if outcome.tables.is_empty() { vec![] } else { outcome.numbers() };
            assert!(came.len() == 300 || outcome.losses.data_loss());
        }
        at += 9 + length as usize;
        records += 1;
    }
    assert!(records > 10);
}

#[test]
fn what_is_not_telemetry_is_named() {
    let error = |files: &[Vec<u8>]| replay_window(files, None).unwrap_err();
    assert!(matches!(error(&[]), ReplayError::NoFiles));
    assert!(matches!(error(&[b"PK\x03\x04 some archive".to_vec()]), ReplayError::NotMcap { .. }));
    assert!(matches!(
        error(&[Foreign::new(vec![("/camera", DAY, scalar(1.0))]).bytes()]),
        ReplayError::NoTelemetry { .. }
    ));
    assert!(matches!(error(&[Foreign::new(vec![]).bytes()]), ReplayError::NoTelemetry { .. }));
    let missing = Replay::open(&[PathBuf::from("/nowhere/at/all.mcap")], None, 1);
    assert!(matches!(missing.err(), Some(ReplayError::Io { .. })));
}

#[test]
fn files_that_do_not_belong_together() {
    let with = |key, value| {
        let mut file = Foreign::new(epochs(10, 10));
        file.metadata.retain(|(k, _)| *k != key);
        file.metadata.push((key, value));
        replay_window(&[Foreign::new(epochs(0, 10)).bytes(), file.bytes()], None)
    };
    assert!(matches!(with("time_scale", "UTC"), Err(ReplayError::Mixed { key: "time_scale", .. })));
    assert!(matches!(with("spacecraft", "SC2"), Err(ReplayError::Mixed { key: "spacecraft", .. })));
    assert!(matches!(with("time_scale", "local"), Err(ReplayError::TimeScale { .. })));
    assert!(with("spacecraft", "SC1").is_ok());
    let hk = |unit| {
        let mut file = Foreign::new(vec![("/hk/t", DAY, scalar(1.0))]);
        file.unit = unit;
        file.bytes()
    };
    assert!(matches!(replay_window(&[hk("K"), hk("degC")], None), Err(ReplayError::MixedUnits { .. })));
    assert_eq!(replay(&[hk("")]).count(Finding::MissingUnits), 1);
    let mut anonymous = Foreign::new(epochs(0, 10));
    anonymous.metadata.clear();
    assert_eq!(replay(&[anonymous.bytes()]).count(Finding::FilesWithoutMetadata), 1);
}

#[test]
fn findings_are_counted() {
    let mut messages = epochs(0, 20);
    messages.push(("/truth", DAY, vec![]));
    messages.push(("/truth", DAY + 1, vec![]));
    messages.push(("/camera", DAY, scalar(1.0)));
    messages.push(("/dws", DAY + 20 * EPOCH, vec![0x09, 0])); // field 1 is a message, not a double
    messages.push(("/hk/t", DAY, scalar(f64::NAN)));
    messages.push(("/hk/t", DAY + 1, scalar(f64::INFINITY)));
    messages.push(("/hk/t", DAY, scalar(2.0))); // backwards, and a conflict
    messages.push(("/hk/t", 5, scalar(3.0))); // 1970, backwards
    messages.push(("/hk/t", -1, scalar(3.0))); // 2554
    let outcome = replay(&[Foreign::new(messages).bytes(), vec![]]);
    for (finding, count) in [
        (Finding::TruthMessages, 2),
        (Finding::MessagesOfUnknownTopics, 1),
        (Finding::MalformedMessages, 1),
        (Finding::NonFiniteValues, 2),
        (Finding::ConflictingMessages, 1),
        (Finding::BackwardTimes, 2),
        (Finding::TimesOutOfRange, 2),
        (Finding::EmptyFiles, 1),
    ] {
        assert_eq!(outcome.count(finding), count, "{finding:?}: {:?}", outcome.losses);
    }
    assert_eq!(outcome.numbers(), (0..20).collect::<Vec<_>>());
    assert_eq!(outcome.rows["hk/t"].rows(), 2);
    assert!(outcome.losses.data_loss());
    assert!(!outcome.rows.contains_key("truth"));
}

#[test]
fn a_whole_file_out_of_range_is_counted() {
    for time in [7, i64::MAX, -1] {
        let lost = vec![("/dws", time, dws(0.0, 0))];
        let outcome = replay(&[Foreign::new(epochs(0, 5)).bytes(), Foreign::new(lost).bytes()]);
        assert_eq!(outcome.numbers(), (0..5).collect::<Vec<_>>());
        assert_eq!(outcome.count(Finding::TimesOutOfRange), 1, "{time}");
    }
}

/// One time of 1980 in a day of 2035 made the product one of 1980.
#[test]
fn a_stray_time_is_no_part_of_the_data() {
    for stray in [316_000_000_000_000_000, DAY + 40_000 * EPOCH + 2 * 86_400_000_000_000, 7_000_000_000_000_000_000] {
        let mut messages = epochs(0, 40_000);
        messages.insert(20_000, ("/dws", stray, dws(1.0, 0)));
        let outcome = replay(&[Foreign::new(messages).bytes()]);
        assert_eq!(outcome.numbers(), (0..40_000).collect::<Vec<_>>(), "{stray}");
        assert_eq!(outcome.count(Finding::StrayMessages), 1, "{:?}", outcome.losses);
        assert!(outcome.losses.data_loss());
    }
    let near = DAY + 40_000 * EPOCH + 80_000_000_000_000;
    let mut messages = epochs(0, 40_000);
    messages.push(("/dws", near, dws(1.0, 0)));
    let outcome = replay(&[Foreign::new(messages).bytes()]);
    assert_eq!((outcome.count(Finding::StrayMessages), outcome.rows["dws"].rows()), (0, 40_001), "within a day");
    let single = replay(&[Foreign::new(epochs(7, 1)).bytes()]);
    assert_eq!(single.numbers(), [7], "alone it is what there is");
}

/// A single time of 1980 made the days from 1980 on days with telemetry.
#[test]
fn a_stray_time_is_not_covered() {
    let (day, far) = (86_400_000_000_000, 316_000_000_000_000_000);
    let folder = tempfile::tempdir().unwrap();
    let covered = |messages: Messages, chunk: u64| {
        let mut file = Foreign::new(messages);
        file.options = file.options.chunk_size(Some(chunk));
        let replay = Replay::open(&stored(folder.path(), &[file.bytes()]), None, 1).unwrap();
        replay.info().covered_ns.iter().map(|stretch| (stretch.start, stretch.end)).collect::<Vec<_>>()
    };
    let whole = (DAY, DAY + 39_999 * EPOCH + 1);
    for chunk in [1, 2000, 1 << 22] {
        let mut messages = epochs(0, 40_000);
        messages.insert(20_000, ("/dws", far, dws(1.0, 0)));
        assert_eq!(covered(messages, chunk), [whole], "one message a chunk, many, or all: {chunk}");
        let late: Messages = (0..10).map(|k| ("/dws", DAY + 5 * day + k * EPOCH, dws(1.0, 0))).collect();
        let messages = [epochs(0, 40_000), late].concat();
        let end = DAY + 5 * day + 9 * EPOCH + 1;
        assert_eq!(covered(messages, chunk), [whole, (DAY + 5 * day, end)], "two dumps in a file: {chunk}");
    }
    assert_eq!(covered(epochs(7, 1), 2000), [(DAY + 7 * EPOCH, DAY + 7 * EPOCH + 1)], "alone it is what there is");
}

/// A second that is told twice, as clocks that follow UTC do at a leap second, lost ten epochs at exit code 0.
#[test]
fn a_repeated_leap_second_is_a_loss() {
    let mut messages = epochs(0, 100);
    let again: Messages = (50..60).map(|k| ("/dws", DAY + k * EPOCH, dws(-1.0, 0))).collect();
    messages.splice(60..60, again);
    let outcome = replay(&[Foreign::new(messages).bytes()]);
    assert_eq!(outcome.numbers(), (0..100).collect::<Vec<_>>(), "the first second counts");
    assert_eq!(outcome.count(Finding::ConflictingMessages), 10);
    assert!(outcome.losses.data_loss());
}

#[test]
fn a_topic_without_messages_is_missing() {
    let tables = interface_tables();
    let mut batches: Vec<Batch> = tables.iter().map(|t| Batch::empty(t.columns.len())).collect();
    batches[0].time_ns.push(DAY);
    batches[0].columns.iter_mut().for_each(|c| c.push(1.0));
    let outcome = replay(&[write(&tables, &[Chunk { batches, complete_until_ns: i64::MAX }])]);
    assert_eq!(outcome.tables, tables[..1]);
    assert_eq!(outcome.count(Finding::TopicsWithoutMessages), 5);
}

#[test]
fn a_schema_that_drifted_stops_the_replay() {
    let mut file = Foreign::new(vec![]);
    file.options = WriteOptions::new().compression_threads(0);
    let mut writer = file.options.clone().create(Cursor::new(Vec::new())).unwrap();
    let (name, set) = descriptor("/ifo").unwrap();
    let schema = writer.add_schema(name, "protobuf", set).unwrap();
    let channel_id = writer.add_channel(schema, "/dws", "protobuf", &BTreeMap::new()).unwrap();
    let log_time = DAY as u64;
    writer.write_to_known_channel(&MessageHeader { channel_id, sequence: 0, log_time, publish_time: 0 }, &[]).unwrap();
    writer.finish().unwrap();
    let error = replay_window(&[writer.into_inner().into_inner()], None).unwrap_err();
    let text = error.to_string();
    assert!(matches!(error, ReplayError::Drift { .. }));
    assert!(text.contains("/dws") && text.contains("tm1.theta_orf_rad") && text.contains("tm1.x_orf_m"), "{text}");
}

/// The tables of the interface with a housekeeping scalar, as a source would give them.
fn interface_tables() -> Vec<TableSpec> {
    let mut value = column("hk/battery_current_a", "value");
    value.unit = "A".into();
    value.attributes = BTreeMap::from([("place".into(), "bus".into()), ("rate_hz".into(), "0.1".into())]);
    let mut tables = crate::telemetry::interface_tables();
    tables.push(TableSpec { name: value.table.clone(), rate_hz: 0.0, columns: vec![value], truth: false });
    tables
}

fn header() -> FileHeader {
    FileHeader {
        time_scale: "TAI".into(),
        mission: "Taiji".into(),
        spacecraft: "SC1".into(),
        producer: "test".into(),
        version: "0".into(),
        extra: BTreeMap::from([("seed".into(), "7".into())]),
    }
}

prop_compose! {
    /// One row of a table of the interface: any doubles but NaN, any status; or a sub-message missing.
    fn cells(table: TableSpec)(
        bits in prop::collection::vec(any::<f64>().prop_filter("a number", |v| !v.is_nan()), table.columns.len()),
        status in any::<u32>(),
        missing in prop::option::weighted(0.3, 0usize..3),
        table in Just(table),
    ) -> Vec<f64> {
        let parts: Vec<&str> = table.columns.iter().filter_map(|c| c.name.split_once('.').map(|p| p.0)).collect();
        let gone = missing.and_then(|i| parts.get(i * parts.len() / 3)).copied();
        table.columns.iter().zip(bits).map(|(column, value)| match column.name.split_once('.') {
            Some((part, _)) if Some(part) == gone => f64::NAN,
            _ if column.name.ends_with("status") => f64::from(status),
            _ => value,
        }).collect()
    }
}

fn any_batch(table: TableSpec) -> impl Strategy<Value = Batch> {
    let columns = table.columns.len();
    let row = (0..30_000_000_000_000i64, cells(table));
    prop::collection::vec(row, 1..40).prop_map(move |mut rows| {
        rows.sort_by_key(|r| r.0);
        rows.dedup_by_key(|r| r.0);
        let mut batch = Batch::empty(columns);
        for (time, cells) in rows {
            batch.time_ns.push(DAY + time);
            batch.columns.iter_mut().zip(cells).for_each(|(c, v)| c.push(v));
        }
        batch
    })
}

fn write(tables: &[TableSpec], chunks: &[Chunk]) -> Vec<u8> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("written.mcap");
    let mut writer = TelemetryWriter::create(&path, tables, &header()).unwrap();
    assert!(!path.exists(), "no file before it is whole");
    chunks.iter().for_each(|c| writer.write(c.clone()).unwrap());
    writer.finish().unwrap();
    let bytes = std::fs::read(&path).unwrap();
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "nothing is left beside it");
    bytes
}

fn same(a: &Batch, b: &Batch) -> bool {
    let equal = |x: &f64, y: &f64| x.to_bits() == y.to_bits() || x.is_nan() && y.is_nan();
    a.time_ns == b.time_ns
        && a.columns
            .iter()
            .zip(&b.columns)
            .all(|(a, b)| a.len() == b.len() && a.iter().zip(b).all(|(x, y)| equal(x, y)))
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 48, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn what_is_written_is_read(batches in interface_tables().into_iter().map(any_batch).collect::<Vec<_>>()) {
        let tables = interface_tables();
        let bytes = write(&tables, &[Chunk { batches: batches.clone(), complete_until_ns: i64::MAX }]);
        let outcome = replay(&[bytes]);
        prop_assert_eq!(&outcome.tables, &tables);
        for (table, batch) in tables.iter().zip(&batches) {
            let mut batch = batch.clone();
            // What the spacecraft is not commanded is no command.
            let of_spacecraft = table.columns.iter().map(|c| table.name == "command" && c.name.starts_with("mps_"));
            for (column, _) in batch.columns.iter_mut().zip(of_spacecraft).filter(|(_, is)| *is) {
                column.iter_mut().filter(|x| x.is_nan()).for_each(|x| *x = 0.0);
            }
            prop_assert!(same(&outcome.rows[&table.name], &batch), "{}", table.name);
        }
        prop_assert!(!outcome.losses.data_loss());
    }

    #[test]
    fn no_bytes_do_harm(bytes in prop::collection::vec(any::<u8>(), 0..400)) {
        fuzz_message(&bytes);
        fuzz_schema(&bytes);
        fuzz_file(&bytes);
        fuzz_file(&[&b"\x89MCAP0\r\n"[..], &bytes].concat());
    }

    /// A sound file or schema with a stretch of it overwritten: closer to what parses than noise is.
    #[test]
    fn no_damage_does_harm(at in 0.0..1.0f64, noise in prop::collection::vec(any::<u8>(), 1..40)) {
        let place = |length: usize| (at * (length - noise.len()) as f64) as usize;
        let mut file = Foreign::new(epochs(0, 60)).bytes();
        let start = place(file.len());
        file[start..start + noise.len()].copy_from_slice(&noise);
        prop_assert!(fuzz_file(&file) <= 60);
        let mut schema = descriptor("/dws").unwrap().1.to_vec();
        let start = place(schema.len());
        schema[start..start + noise.len()].copy_from_slice(&noise);
        fuzz_schema(&schema);
    }
}

/// The 416 conformance files of the format, by other writers, against their expected contents.
mod conformance {
    use super::super::inflate::Inflater;
    use super::super::records::{Cursor, Message};
    use super::*;
    use mcap::records::op;
    use serde_json::Value;
    use std::io::Read as _;

    fn field<'a>(record: &'a Value, name: &str) -> &'a Value {
        let fields = record["fields"].as_array().unwrap();
        &fields.iter().find(|f| f[0] == name).unwrap()[1]
    }

    fn number(value: &Value) -> u64 {
        value.as_str().unwrap().parse().unwrap()
    }

    fn bytes(value: &Value) -> Vec<u8> {
        value.as_array().unwrap().iter().map(|b| number(b) as u8).collect()
    }

    fn compare(name: &str, file: &[u8], expected: &Value) {
        let mut losses = Losses::default();
        let folder = tempfile::tempdir().unwrap();
        let path = &stored(folder.path(), &[file.to_vec()])[0];
        let input = InputFile::open(path).unwrap();
        let scan = scan(&input, &mut losses).unwrap_or_else(|e| panic!("{name}: {e:?}"));
        assert!(!losses.data_loss(), "{name}: {losses:?}");
        let mut messages = vec![];
        let mut inflater = Inflater::new().unwrap();
        for piece in &scan.pieces {
            let mut cursor = Cursor(inflater.read(&input, piece).unwrap_or_else(|e| panic!("{name}: {e:?}")));
            while let Some((code, body)) = cursor.record().unwrap() {
                if code == op::MESSAGE {
                    let m = Message::parse(body).unwrap();
                    messages.push((u64::from(m.channel), m.log_time, m.data.to_vec()));
                }
            }
        }
        let records = expected["records"].as_array().unwrap();
        let of = |kind: &str| records.iter().filter(move |r| r["type"] == kind).collect::<Vec<_>>();
        let due: Vec<_> = of("Message")
            .iter()
            .map(|m| (number(field(m, "channel_id")), number(field(m, "log_time")), bytes(field(m, "data"))))
            .collect();
        assert_eq!(messages, due, "{name}");
        let topics: BTreeMap<u64, &str> =
            of("Channel").iter().map(|c| (number(field(c, "id")), field(c, "topic").as_str().unwrap())).collect();
        let channels = &scan.definitions.channels;
        assert_eq!(
            channels.iter().map(|(&id, c)| (u64::from(id), c.topic.as_str())).collect::<BTreeMap<_, _>>(),
            topics,
            "{name}"
        );
        let schemas: BTreeMap<u64, Vec<u8>> =
            of("Schema").iter().map(|s| (number(field(s, "id")), bytes(field(s, "data")))).collect();
        let found = &scan.definitions.schemas;
        assert_eq!(
            found.iter().map(|(&id, s)| (u64::from(id), s.data.clone())).collect::<BTreeMap<_, _>>(),
            schemas,
            "{name}"
        );
    }

    #[test]
    fn all_files() {
        let archive = &include_bytes!("../../tests/data/mcap-conformance.tgz")[..];
        let mut files: BTreeMap<String, Vec<u8>> = BTreeMap::new();
        for entry in tar::Archive::new(flate2::read::GzDecoder::new(archive)).entries().unwrap() {
            let mut entry = entry.unwrap();
            let mut bytes = vec![];
            entry.read_to_end(&mut bytes).unwrap();
            files.insert(entry.path().unwrap().display().to_string(), bytes);
        }
        let mut compared = 0;
        for (name, bytes) in files.iter().filter(|(name, _)| name.ends_with(".mcap")) {
            let expected = serde_json::from_slice(&files[&name.replace(".mcap", ".json")]).unwrap();
            compare(name, bytes, &expected);
            compared += 1;
        }
        assert_eq!(compared, 416);
    }
}
