//! Positions from an SPK file (NAIF's "SPK Required Reading" and "DAF Required Reading"): little-endian, segments of
//! type 2, Chebyshev polynomials of position in records of equal length.
//!
//! A file is checked completely when it is opened; after that, a position fails only if no segment covers it.

use nalgebra::Vector3;

/// Words of 8 bytes in a record of a DAF.
const RECORD_WORDS: usize = 128;
/// `ND` and `NI` of an SPK: two doubles and six integers make a summary of five words.
const SPK_SHAPE: (i32, i32) = (2, 6);
const SUMMARY_WORDS: usize = 5;
/// Summaries that fit behind the three control words of a record.
const MOST_SUMMARIES: usize = (RECORD_WORDS - 3) / SUMMARY_WORDS;
/// NAIF's number of the frame J2000, whose axes are ICRF's.
const FRAME_J2000: i32 = 1;
const M_PER_KM: f64 = 1000.0;
/// A light year, farther than any planet.
const MOST_KM: f64 = 1e13;

/// Why an SPK file was refused, or does not cover a position.
#[expect(missing_docs, reason = "the messages name the fields")]
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum SpkError {
    /// The first record is not an SPK's.
    #[error("not a little-endian SPK file: {what}; convert a transfer or big-endian file with NAIF's toxfr and bingo")]
    NotSpk { what: String },
    /// The file has a hole, ends early or contradicts itself.
    #[error("damaged SPK file: {what} at word {word}; fetch it again and compare its digest")]
    Damaged { what: &'static str, word: usize },
    /// A segment of an unsupported type.
    #[error("SPK file: the segment of {target} relative to {center} has {what} {found}; only {needed} is read")]
    Unsupported { target: i32, center: i32, what: &'static str, found: i32, needed: i32 },
    /// No segment holds the body at that time.
    #[error("the SPK file has no position of {target} relative to {center} at {et_s} s TDB past J2000")]
    NotCovered { target: i32, center: i32, et_s: f64 },
}

/// One segment: records of `[middle, radius, x…, y…, z…]`.
#[derive(Clone, Debug)]
struct Segment {
    target: i32,
    center: i32,
    first_s: f64,
    last_s: f64,
    /// Where its records start, words from 0.
    start: usize,
    /// `INIT`, start of the first record, s.
    init_s: f64,
    /// `INTLEN`, length of a record, s.
    record_s: f64,
    record_words: usize,
    records: usize,
}

/// An SPK file in memory.
#[derive(Clone, Debug)]
pub struct Spk<'a> {
    words: &'a [[u8; 8]],
    segments: Vec<Segment>,
}

impl<'a> Spk<'a> {
    /// Opens a file and checks every record of it.
    ///
    /// # Errors
    /// Every [`SpkError`] but `NotCovered`.
    pub fn new(bytes: &'a [u8]) -> Result<Self, SpkError> {
        let (words, _) = bytes.as_chunks::<8>();
        let file = Self { words, segments: Vec::new() };
        let first_summaries = file.header()?;
        let segments = file.summaries(first_summaries)?;
        Ok(Self { segments, ..file })
    }

    /// Position of a body, ICRF axes, m, at TDB seconds past J2000. Numbers of bodies are NAIF's: 0 the solar system's
    /// barycentre, 3 the Earth–Moon barycentre, 10 the Sun, 301 the Moon, 399 the Earth.
    ///
    /// # Errors
    /// [`SpkError::NotCovered`].
    pub fn position_m(&self, target: i32, center: i32, et_s: f64) -> Result<Vector3<f64>, SpkError> {
        let holds = |s: &&Segment| (s.target, s.center) == (target, center) && s.first_s <= et_s && et_s <= s.last_s;
        // Of segments that overlap, the last one in the file counts.
        let segment = self.segments.iter().rev().find(holds);
        let segment = segment.ok_or(SpkError::NotCovered { target, center, et_s })?;
        Ok(self.evaluate(segment, et_s) * M_PER_KM)
    }

    /// First and last time at which all the given (target, center) have a position, TDB seconds past J2000.
    ///
    /// # Errors
    /// [`SpkError::NotCovered`] when a pair is not in the file.
    pub fn span_s(&self, pairs: &[(i32, i32)]) -> Result<(f64, f64), SpkError> {
        let mut span = (f64::NEG_INFINITY, f64::INFINITY);
        for &(target, center) in pairs {
            let segment = self.segments.iter().rev().find(|s| (s.target, s.center) == (target, center));
            let segment = segment.ok_or(SpkError::NotCovered { target, center, et_s: 0.0 })?;
            span = (span.0.max(segment.first_s), span.1.min(segment.last_s));
        }
        Ok(span)
    }

    /// km.
    fn evaluate(&self, segment: &Segment, et_s: f64) -> Vector3<f64> {
        let record = ((et_s - segment.init_s) / segment.record_s) as usize; // a cast of a float saturates
        let start = segment.start + record.min(segment.records - 1) * segment.record_words;
        let record = &self.words[start..start + segment.record_words];
        let [middle_s, radius_s] = [number(record[0]), number(record[1])];
        let s = (et_s - middle_s) / radius_s;
        let terms = (segment.record_words - 2) / 3;
        Vector3::from_fn(|i, _| chebyshev(&record[2 + i * terms..][..terms], s))
    }

    /// Checks the first record; where the summaries start, as a record's number from 1.
    fn header(&self) -> Result<usize, SpkError> {
        let refuse = |what: &str| SpkError::NotSpk { what: what.to_owned() };
        let header = self.words.get(..RECORD_WORDS).ok_or_else(|| refuse("it is shorter than a record"))?;
        if &header[0] != b"DAF/SPK " {
            return Err(refuse("it does not begin with DAF/SPK"));
        }
        if &header[11] != b"LTL-IEEE" {
            return Err(refuse("its format is not LTL-IEEE"));
        }
        let shape = integers(header[1]);
        if shape != SPK_SHAPE {
            return Err(SpkError::NotSpk { what: format!("ND and NI are {shape:?}, not {SPK_SHAPE:?}") });
        }
        // FWARD stands in bytes 76 to 79.
        usize::try_from(integers(header[9]).1).map_err(|_| SpkError::Damaged { what: "FWARD below zero", word: 10 })
    }

    /// Follows the records of summaries.
    fn summaries(&self, first: usize) -> Result<Vec<Segment>, SpkError> {
        let mut segments = Vec::new();
        let mut next = first;
        let records = self.words.len() / RECORD_WORDS;
        for _ in 0..=records {
            if next == 0 {
                return Ok(segments);
            }
            let start = (next - 1) * RECORD_WORDS; // next is at least 1
            let damaged = |what| SpkError::Damaged { what, word: start + 1 };
            let record = self.words.get(start..start.saturating_add(RECORD_WORDS));
            let record = record.ok_or(damaged("summaries beyond the end"))?;
            next = whole(record[0]).ok_or(damaged("the number of the next record"))?;
            if next > records {
                return Err(damaged("the number of the next record"));
            }
            let count = whole(record[2]).filter(|n| *n <= MOST_SUMMARIES).ok_or(damaged("the count of summaries"))?;
            for i in 0..count {
                let at = 3 + i * SUMMARY_WORDS;
                segments.push(self.segment(&record[at..at + SUMMARY_WORDS], start + at)?);
            }
        }
        Err(SpkError::Damaged { what: "summaries that run in a circle", word: first })
    }

    /// Reads and checks the segment of a summary, which stands at word `at`.
    fn segment(&self, summary: &[[u8; 8]], at: usize) -> Result<Segment, SpkError> {
        let damaged = |what, word: usize| SpkError::Damaged { what, word: word + 1 };
        let (first_s, last_s) = (number(summary[0]), number(summary[1]));
        let ((target, center), (frame, kind), (begin, end)) =
            (integers(summary[2]), integers(summary[3]), integers(summary[4]));
        for (what, found, needed) in [("data type", kind, 2), ("frame", frame, FRAME_J2000)] {
            if found != needed {
                return Err(SpkError::Unsupported { target, center, what, found, needed });
            }
        }
        // From 1, both included; the last four words are INIT, INTLEN, RSIZE, N.
        let bounds = (usize::try_from(begin).ok(), usize::try_from(end).ok());
        let (Some(begin @ 1..), Some(end)) = bounds else { return Err(damaged("addresses of a segment", at)) };
        let words = self.words.get(begin - 1..end).filter(|w| w.len() > 4);
        let words = words.ok_or(damaged("addresses of a segment", at))?;
        let (data, directory) = words.split_at(words.len() - 4);
        let (init_s, record_s) = (number(directory[0]), number(directory[1]));
        let sizes = (whole(directory[2]), whole(directory[3]));
        let (Some(record_words @ 5..), Some(records @ 1..)) = sizes else {
            return Err(damaged("directory of a segment", end - 2));
        };
        if (record_words - 2) % 3 != 0 || record_words.checked_mul(records) != Some(data.len()) {
            return Err(damaged("directory of a segment", end - 2));
        }
        let end_s = init_s + record_s * records as f64;
        if !(record_s > 0.0 && init_s <= first_s && first_s < last_s && last_s <= end_s) {
            return Err(damaged("times of a segment", at));
        }
        for (i, record) in data.chunks_exact(record_words).enumerate() {
            let start = begin - 1 + i * record_words;
            let middle_s = init_s + (i as f64 + 0.5) * record_s;
            if number(record[0]) != middle_s || number(record[1]) != 0.5 * record_s {
                return Err(damaged("times of a record", start));
            }
            if let Some(j) = record[2..].iter().position(|w| !(-MOST_KM..MOST_KM).contains(&number(*w))) {
                return Err(damaged("a coefficient that is no distance", start + 2 + j));
            }
        }
        Ok(Segment { target, center, first_s, last_s, start: begin - 1, init_s, record_s, record_words, records })
    }
}

/// `Σ c_k T_k(s)` by Clenshaw's recurrence.
fn chebyshev(coefficients: &[[u8; 8]], s: f64) -> f64 {
    let Some((constant, rest)) = coefficients.split_first() else { return 0.0 };
    let (mut w1, mut w2) = (0.0, 0.0);
    for c in rest.iter().rev() {
        (w1, w2) = (number(*c) + (2.0 * s * w1 - w2), w1);
    }
    number(*constant) + (s * w1 - w2)
}

fn number(word: [u8; 8]) -> f64 {
    f64::from_le_bytes(word)
}

/// A count that a DAF keeps in a double.
fn whole(word: [u8; 8]) -> Option<usize> {
    let value = number(word);
    (value >= 0.0 && value <= f64::from(u32::MAX) && value.fract() == 0.0).then_some(value as usize)
}

/// The two integers of a word.
fn integers(word: [u8; 8]) -> (i32, i32) {
    let [a, b, c, d, e, f, g, h] = word;
    (i32::from_le_bytes([a, b, c, d]), i32::from_le_bytes([e, f, g, h]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::orbit::ephemeris::DE440;
    use rand::{RngExt, SeedableRng};
    use rand_xoshiro::Xoshiro256PlusPlus;

    const PAIRS: [(i32, i32); 4] = [(10, 0), (3, 0), (399, 3), (301, 3)];

    #[test]
    fn what_is_not_there_is_told() {
        let spk = Spk::new(DE440).unwrap();
        let (first_s, last_s) = spk.span_s(&PAIRS).unwrap();
        assert_eq!((first_s, last_s), (1_086_004_800.0, 1_293_883_200.0));
        assert!(spk.position_m(399, 3, last_s).is_ok());
        for (target, center, et_s) in [(399, 3, last_s + 1.0), (399, 3, f64::NAN), (399, 10, first_s), (5, 0, first_s)]
        {
            assert!(matches!(spk.position_m(target, center, et_s), Err(SpkError::NotCovered { .. })));
        }
        assert!(spk.span_s(&[(5, 0)]).is_err());
    }

    #[test]
    fn other_files_are_refused_by_kind() {
        let refusal = |at: usize, byte: u8| {
            let mut bytes = DE440.to_vec();
            bytes[at] = byte;
            Spk::new(&bytes).unwrap_err().to_string()
        };
        assert!(refusal(0, b'N').contains("DAF/SPK"));
        assert!(refusal(88, b'B').contains("LTL-IEEE"));
        assert!(refusal(8, 3).contains("ND and NI are (3, 6)"));
        // The first summary's type: third word of the summary is target and centre, the fourth frame and type.
        let summaries = i32::from_le_bytes(DE440[76..80].try_into().unwrap()) as usize;
        let first = (summaries - 1) * 1024 + 24;
        assert!(refusal(first + 28, 3).contains("data type 3; only 2 is read"));
        assert!(refusal(first + 24, 17).contains("frame 17; only 1 is read"));
        assert!(Spk::new(&DE440[..1000]).is_err());
        assert!(matches!(Spk::new(&DE440[..500_000]), Err(SpkError::Damaged { .. })));
    }

    /// Bytes turned at random, most of them where the structure is: an error or finite positions, never a panic.
    #[test]
    fn damaged_bytes_never_panic() {
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(1);
        let summaries = i32::from_le_bytes(DE440[76..80].try_into().unwrap()) as usize;
        let mut bytes = DE440.to_vec();
        let mut refused = 0;
        for round in 0..4000 {
            let damage: Vec<(usize, u8)> = (0..rng.random_range(1..4))
                .map(|_| {
                    let at = match round % 4 {
                        0 => rng.random_range(0..128),
                        1 => (summaries - 1) * 1024 + rng.random_range(0..200),
                        // The directory of the first segment.
                        2 => 14_259 * 8 - rng.random_range(1..40),
                        _ => rng.random_range(0..bytes.len()),
                    };
                    (at, rng.random::<u8>())
                })
                .collect();
            for (at, byte) in &damage {
                bytes[*at] = *byte;
            }
            match Spk::new(&bytes) {
                Err(_) => refused += 1,
                Ok(spk) => {
                    for segment in &spk.segments {
                        for et_s in [segment.first_s, segment.last_s, 0.5 * (segment.first_s + segment.last_s)] {
                            assert!(spk.evaluate(segment, et_s).iter().all(|x| x.is_finite()));
                        }
                    }
                }
            }
            for (at, _) in &damage {
                bytes[*at] = DE440[*at];
            }
        }
        assert!((1000..4000).contains(&refused), "{refused} of 4000");
        for length in (0..DE440.len()).step_by(997) {
            let _ = Spk::new(&DE440[..length]);
        }
    }
}
