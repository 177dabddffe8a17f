//! What was gathered, as bytes: a header in JSON, then every number as it is in memory.

use dragfree_estimation::spectra::Spectra;
use nalgebra::DMatrix;
use serde::{Deserialize, Serialize};

use crate::gather::{Columns, Gathered, Gram, Hour};
use crate::question::Question;
use crate::transient::{Hit, Search};
use crate::witness::Witnesses;

const MAGIC: &[u8; 8] = b"DFCRIT1\n";

/// Question and sums of some telemetry.
#[derive(Clone, Debug, PartialEq)]
pub struct Record {
    /// Model and candidates.
    pub question: Question,
    /// How each channel is measured, true for second differences.
    pub differenced: Vec<bool>,
    /// Sums.
    pub gathered: Gathered,
    /// Candidates that could not be tried, with the reason.
    pub not_tried: Vec<(String, String)>,
}

/// Why bytes are no record, or two records do not belong together.
#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    /// Not ours, or damaged.
    #[error("the gathered sums are damaged ({0}): gather them again")]
    Damaged(&'static str),
    /// Different questions.
    #[error(
        "the products were made with different {0}, so their sums do not add: diagnose products of one mission, model and pipeline together"
    )]
    Unlike(&'static str),
}

#[derive(Serialize, Deserialize)]
struct Header {
    question: Question,
    differenced: Vec<bool>,
    not_tried: Vec<(String, String)>,
    names: Vec<String>,
    channels: usize,
    base: usize,
    fast: usize,
    length: usize,
    rate_hz: f64,
    segments: [u64; 2],
    hours: Vec<(i64, u64)>,
    housekeeping: Vec<String>,
    witness_segments: u64,
    hits: Vec<Hit>,
    tried: f64,
}

struct Numbers<'a>(&'a [u8]);

impl Numbers<'_> {
    fn fill(&mut self, out: &mut [f64]) -> Result<(), RecordError> {
        let (mine, rest) = self.0.split_at_checked(8 * out.len()).ok_or(RecordError::Damaged("it ends early"))?;
        for (x, bytes) in out.iter_mut().zip(mine.as_chunks::<8>().0) {
            *x = f64::from_le_bytes(*bytes);
        }
        self.0 = rest;
        Ok(())
    }

    fn spectra(&mut self, spectra: &mut Spectra) -> Result<(), RecordError> {
        self.fill(&mut spectra.packed)?;
        self.fill(&mut spectra.expected)?;
        self.fill(&mut spectra.weight)?;
        self.fill(&mut spectra.weight_squared)
    }
}

impl Record {
    /// The bytes.
    #[must_use]
    pub fn to_bytes(&self) -> Vec<u8> {
        let g = &self.gathered;
        let header = Header {
            question: self.question.clone(),
            differenced: self.differenced.clone(),
            not_tried: self.not_tried.clone(),
            names: g.columns.names.clone(),
            channels: g.columns.channels,
            base: g.columns.base,
            fast: g.columns.fast,
            length: g.length,
            rate_hz: g.rate_hz,
            segments: [g.sets[0].weights.segments, g.sets[1].weights.segments],
            hours: g.hours.iter().map(|h| (h.start_ns, h.spectra.segments)).collect(),
            housekeeping: g.witnesses.names.clone(),
            witness_segments: g.witnesses.segments,
            hits: g.transients.hits.clone(),
            tried: g.transients.tried,
        };
        // A struct of plain data has no way to fail.
        let header = serde_json::to_vec(&header).unwrap_or_default();
        let mut bytes = MAGIC.to_vec();
        bytes.extend((header.len() as u64).to_le_bytes());
        bytes.extend(header);
        let mut put = |numbers: &[f64]| numbers.iter().for_each(|x| bytes.extend(x.to_le_bytes()));
        let mut spectra = |s: &Spectra| {
            [&s.packed, &s.expected, &s.weight, &s.weight_squared].into_iter().for_each(|v| put(v));
        };
        for set in &g.sets {
            spectra(&set.weights);
        }
        for hour in &g.hours {
            spectra(&hour.spectra);
        }
        g.sets.iter().flat_map(|s| &s.bands).for_each(|m| put(m.as_slice()));
        let w = &g.witnesses;
        put(w.residual.as_slice());
        put(&w.level);
        [&w.residual_power, &w.power, &w.cross[0], &w.cross[1]].into_iter().for_each(|m| put(m.as_slice()));
        bytes
    }

    /// Reads what [`Self::to_bytes`] wrote.
    ///
    /// # Errors
    /// [`RecordError::Damaged`].
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, RecordError> {
        let rest = bytes.strip_prefix(MAGIC).ok_or(RecordError::Damaged("no record at all"))?;
        let (length, rest) = rest.split_first_chunk::<8>().ok_or(RecordError::Damaged("it ends early"))?;
        let length = usize::try_from(u64::from_le_bytes(*length)).map_err(|_| RecordError::Damaged("its header"))?;
        let (header, rest) = rest.split_at_checked(length).ok_or(RecordError::Damaged("it ends early"))?;
        let h: Header = serde_json::from_slice(header).map_err(|_| RecordError::Damaged("its header"))?;
        let sound = h.channels <= h.base && h.base <= h.fast && h.fast <= h.names.len();
        if !sound
            || !(16..=1 << 24).contains(&h.length)
            || !h.length.is_multiple_of(4)
            || !h.rate_hz.is_finite()
            || h.rate_hz <= 0.0
        {
            return Err(RecordError::Damaged("its header"));
        }
        let columns = Columns { names: h.names, channels: h.channels, base: h.base, fast: h.fast };
        let plan = dragfree_estimation::spectra::Plan::new(h.length, h.rate_hz);
        let mut numbers = Numbers(rest);
        let mut sets = [Gram::zero(&columns, &plan), Gram::zero(&columns, &plan)];
        for (set, segments) in sets.iter_mut().zip(h.segments) {
            numbers.spectra(&mut set.weights)?;
            set.weights.segments = segments;
        }
        let mut hours = Vec::new();
        for (start_ns, segments) in h.hours {
            let mut spectra = Spectra::zero(plan.bands.len(), columns.base);
            numbers.spectra(&mut spectra)?;
            spectra.segments = segments;
            hours.push(Hour { start_ns, spectra });
        }
        for m in sets.iter_mut().flat_map(|s| &mut s.bands) {
            numbers.fill(m.as_mut_slice())?;
        }
        let mut residual = DMatrix::zeros(columns.channels, columns.base);
        numbers.fill(residual.as_mut_slice())?;
        let mut w = Witnesses::new(h.housekeeping, h.length, h.rate_hz, residual);
        numbers.fill(&mut w.level)?;
        for m in [&mut w.residual_power, &mut w.power].into_iter().chain(&mut w.cross) {
            numbers.fill(m.as_mut_slice())?;
        }
        w.segments = h.witness_segments;
        if !numbers.0.is_empty() {
            return Err(RecordError::Damaged("it goes on too long"));
        }
        let transients = Search::found(h.hits, h.tried);
        let gathered =
            Gathered { columns, length: h.length, rate_hz: h.rate_hz, sets, hours, witnesses: w, transients };
        Ok(Self { question: h.question, differenced: h.differenced, gathered, not_tried: h.not_tried })
    }

    /// Adds the sums of other telemetry.
    ///
    /// # Errors
    /// [`RecordError::Unlike`] where the two were not asked the same.
    pub fn add(&mut self, other: &Self) -> Result<(), RecordError> {
        let (a, b) = (&self.gathered, &other.gathered);
        let same = [
            (self.question == other.question, "models, candidates or housekeeping"),
            (a.columns == b.columns, "columns"),
            (a.length == b.length && a.rate_hz == b.rate_hz, "segments"),
        ];
        if let Some((_, what)) = same.into_iter().find(|(same, _)| !same) {
            return Err(RecordError::Unlike(what));
        }
        let g = &mut self.gathered;
        g.sets.iter_mut().zip(&other.gathered.sets).for_each(|(a, b)| a.add(b));
        g.hours.extend(other.gathered.hours.iter().cloned());
        g.hours.sort_by_key(|h| h.start_ns);
        g.witnesses.add(&other.gathered.witnesses);
        g.transients.add(&other.gathered.transients);
        Ok(())
    }
}
