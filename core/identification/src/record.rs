//! Sums as bytes: a header in JSON, then every number as it is in memory.

use std::io::{self, Read, Write};

use dragfree_estimation::sigma::{NoiseError, NoiseModel};
use dragfree_estimation::spectra::{Plan, Spectra};
use dragfree_schema::NoiseProcess;
use nalgebra::DMatrix;
use serde::{Deserialize, Serialize};

use crate::candidates::CandidateSet;
use crate::coherence::HousekeepingCoherence;
use crate::gram::{Columns, Gram, GramSums, Hour, low_plan, whole_plan};
use crate::transient::{Detection, Transients};

const MAGIC: &[u8; 8] = b"DFSUMS2\n";

/// CandidateSet and sums of some telemetry.
#[derive(Clone, Debug, PartialEq)]
pub struct Record {
    /// Model and candidates.
    pub candidate_set: CandidateSet,
    /// Declared noise of the channels.
    pub noise: Vec<NoiseProcess>,
    /// Sums.
    pub gathered: GramSums,
    /// Candidates that could not be tried, with the reason.
    pub not_tried: Vec<(String, String)>,
}

/// Why bytes are no record, or two records do not belong together.
#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    /// Not ours, or damaged.
    #[error("the gathered sums are damaged ({0}): gather them again")]
    Damaged(&'static str),
    /// Sums of different candidates, columns or segments.
    #[error(
        "the products were made with different {0}, so their sums do not add: diagnose products of one mission, model and pipeline together"
    )]
    Unlike(&'static str),
}

#[derive(Serialize, Deserialize)]
struct Header {
    candidate_set: CandidateSet,
    noise: Vec<NoiseProcess>,
    not_tried: Vec<(String, String)>,
    names: Vec<String>,
    channels: usize,
    base: usize,
    fast: usize,
    energy: Vec<Vec<f64>>,
    length: usize,
    rate_hz: f64,
    segments: [u64; 2],
    hours: Vec<(i64, u64)>,
    housekeeping: Vec<String>,
    detections: Vec<Detection>,
    tried: f64,
}

/// Numbers that are read one after the other.
struct Numbers<R>(R);

impl<R: Read> Numbers<R> {
    fn fill(&mut self, out: &mut [f64]) -> Result<(), RecordError> {
        let mut bytes = [0; 8 * 512];
        for out in out.chunks_mut(512) {
            let bytes = &mut bytes[..8 * out.len()];
            self.0.read_exact(bytes).map_err(|_| RecordError::Damaged("it ends early"))?;
            for (x, bytes) in out.iter_mut().zip(bytes.as_chunks::<8>().0) {
                *x = f64::from_le_bytes(*bytes);
            }
        }
        Ok(())
    }

    fn spectra(&mut self, spectra: &mut Spectra) -> Result<(), RecordError> {
        self.fill(&mut spectra.packed)?;
        self.fill(&mut spectra.expected)?;
        self.fill(&mut spectra.weight)?;
        self.fill(&mut spectra.weight_squared)
    }
}

/// Numbers as bytes.
fn put(to: &mut impl Write, numbers: &[f64]) -> io::Result<()> {
    let mut bytes = Vec::with_capacity(8 * numbers.len());
    numbers.iter().for_each(|x| bytes.extend(x.to_le_bytes()));
    to.write_all(&bytes)
}

impl Record {
    /// Writes it.
    ///
    /// # Errors
    /// Those of the writer.
    pub fn write(&self, to: &mut impl Write) -> io::Result<()> {
        let g = &self.gathered;
        let header = Header {
            candidate_set: self.candidate_set.clone(),
            noise: self.noise.clone(),
            not_tried: self.not_tried.clone(),
            names: g.columns.names.clone(),
            channels: g.columns.channels,
            base: g.columns.base,
            fast: g.columns.fast,
            energy: g.columns.energy.clone(),
            length: g.length,
            rate_hz: g.rate_hz,
            segments: [g.sets[0].weights.segments, g.sets[1].weights.segments],
            hours: g.hours.iter().map(|h| (h.start_ns, h.spectra.segments)).collect(),
            housekeeping: g.housekeeping.names.clone(),
            detections: g.transients.detections.clone(),
            tried: g.transients.tried,
        };
        // A struct of plain data has no way to fail.
        let header = serde_json::to_vec(&header).unwrap_or_default();
        to.write_all(MAGIC)?;
        to.write_all(&(header.len() as u64).to_le_bytes())?;
        to.write_all(&header)?;
        for spectra in g.sets.iter().map(|s| &s.weights).chain(g.hours.iter().map(|h| &h.spectra)) {
            for numbers in [&spectra.packed, &spectra.expected, &spectra.weight, &spectra.weight_squared] {
                put(to, numbers)?;
            }
        }
        // The matrices are symmetric: the part from the diagonal down, column by column.
        for m in g.sets.iter().flat_map(|s| &s.bands) {
            for j in 0..m.ncols() {
                put(to, &m.as_slice()[j * m.nrows() + j..(j + 1) * m.nrows()])?;
            }
        }
        let w = &g.housekeeping;
        put(to, w.residual.as_slice())?;
        put(to, &w.level)?;
        put(to, &w.observations)?;
        let sums = [&w.residual_power, &w.power, &w.cross[0], &w.cross[1]];
        sums.into_iter().chain(w.among.iter().flatten()).try_for_each(|m| put(to, m.as_slice()))
    }

    /// Reads what [`Self::write`] wrote.
    ///
    /// # Errors
    /// [`RecordError::Damaged`].
    pub fn read(from: &mut impl Read) -> Result<Self, RecordError> {
        let early = |_| RecordError::Damaged("it ends early");
        let mut start = [0; 16];
        from.read_exact(&mut start).map_err(early)?;
        let (magic, length) = start.split_at(8);
        if magic != MAGIC {
            return Err(RecordError::Damaged("no record at all"));
        }
        let length = u64::from_le_bytes(length.try_into().map_err(|_| RecordError::Damaged("its header"))?);
        // As much as there is, whatever the length claims.
        let mut header = Vec::new();
        let read = from.take(length).read_to_end(&mut header);
        if read.map_err(early)? as u64 != length {
            return Err(RecordError::Damaged("it ends early"));
        }
        let h: Header = serde_json::from_slice(&header).map_err(|_| RecordError::Damaged("its header"))?;
        let sound = h.channels <= h.base && h.base <= h.fast && h.fast <= h.names.len();
        if !sound
            || !(16..=1 << 20).contains(&h.length)
            || !h.length.is_multiple_of(4)
            || !h.rate_hz.is_finite()
            || h.rate_hz <= 0.0
        {
            return Err(RecordError::Damaged("its header"));
        }
        let (plan, hour_plan) = (whole_plan(h.length, h.rate_hz), Plan::new(h.length, h.rate_hz));
        if h.energy.len() > h.fast - h.base || h.energy.iter().any(|e| e.len() != plan.bands.len()) {
            return Err(RecordError::Damaged("its header"));
        }
        let columns = Columns { names: h.names, channels: h.channels, base: h.base, fast: h.fast, energy: h.energy };
        let mut numbers = Numbers(from);
        let mut sets = [Gram::zero(&columns, &plan), Gram::zero(&columns, &plan)];
        for (set, segments) in sets.iter_mut().zip(h.segments) {
            numbers.spectra(&mut set.weights)?;
            set.weights.segments = segments;
        }
        let mut hours = Vec::new();
        for (start_ns, segments) in h.hours {
            let mut spectra = Spectra::zero(hour_plan.bands.len(), columns.base);
            numbers.spectra(&mut spectra)?;
            spectra.segments = segments;
            hours.push(Hour { start_ns, spectra });
        }
        for m in sets.iter_mut().flat_map(|s| &mut s.bands) {
            let n = m.nrows();
            (0..n).try_for_each(|j| numbers.fill(&mut m.as_mut_slice()[j * n + j..(j + 1) * n]))?;
            m.fill_upper_triangle_with_lower_triangle();
        }
        let mut residual = DMatrix::zeros(columns.channels, columns.base);
        numbers.fill(residual.as_mut_slice())?;
        let mut w = HousekeepingCoherence::new(h.housekeeping, &low_plan(h.length, h.rate_hz).0, residual, Vec::new());
        numbers.fill(&mut w.level)?;
        numbers.fill(&mut w.observations)?;
        let sums = [&mut w.residual_power, &mut w.power].into_iter().chain(&mut w.cross);
        for m in sums.chain(w.among.iter_mut().flatten()) {
            numbers.fill(m.as_mut_slice())?;
        }
        if numbers.0.read(&mut [0]).map_err(early)? > 0 {
            return Err(RecordError::Damaged("it goes on too long"));
        }
        let transients = Transients { detections: h.detections, tried: h.tried };
        let gathered =
            GramSums { columns, length: h.length, rate_hz: h.rate_hz, sets, hours, housekeeping: w, transients };
        Ok(Self { candidate_set: h.candidate_set, noise: h.noise, gathered, not_tried: h.not_tried })
    }

    /// The noise model of the channels.
    ///
    /// # Errors
    /// A declaration contradicts itself.
    pub fn noise_model(&self) -> Result<NoiseModel, NoiseError> {
        NoiseModel::new(&self.noise, &self.candidate_set.channels, 1.0 / self.gathered.rate_hz)
    }

    /// Adds the sums of other telemetry.
    ///
    /// # Errors
    /// [`RecordError::Unlike`] where the two were not asked the same.
    pub fn add(&mut self, other: &Self) -> Result<(), RecordError> {
        let (a, b) = (&self.gathered, &other.gathered);
        let same = [
            (self.candidate_set == other.candidate_set, "models, candidates or housekeeping"),
            (self.noise == other.noise, "declared noise"),
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
        g.housekeeping.add(&other.gathered.housekeeping);
        g.transients.add(&other.gathered.transients);
        Ok(())
    }
}
