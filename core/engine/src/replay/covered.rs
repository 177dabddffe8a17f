//! The times that a file covers: what its pieces state, and where a piece spans more than a day or lies more than a day
//! from all others, what its messages say.

use std::collections::BTreeMap;
use std::io;
use std::ops::Range;

use mcap::records::op;

use super::inflate::{InflateError, Inflater, Piece};
use super::reader::{STRAY_NS, STRAY_ROWS, clamp_ns, is_sane};
use super::records::{Cursor, Message};
use crate::input::InputFile;

/// Times and channels of messages.
type Times = Vec<(i64, u16)>;

/// Stretches without a gap of more than a day in which a file has messages, Unix ns, in order. A few messages by
/// themselves are left out, as the replay drops them, unless there is nothing else.
///
/// # Errors
/// The file can no longer be read.
pub(super) fn covered(file: &InputFile, pieces: &[Piece]) -> io::Result<Vec<Range<i64>>> {
    let mut inflater = Inflater::new()?;
    let (short, long): (Vec<&Piece>, Vec<&Piece>) = pieces.iter().partition(|piece| is_short(piece));
    let (mut covered, mut few) = (Vec::new(), Vec::new());
    let mut read = |piece: &Piece, covered: &mut Vec<_>| -> io::Result<()> {
        sort_out(&times(&mut inflater, file, piece)?, covered, &mut few);
        Ok(())
    };
    for stretch in joined(short.iter().map(|piece| stated(piece)).collect()) {
        let mut inside = short.iter().filter(|piece| stretch.contains(&clamp_ns(piece.start)));
        match (inside.next(), inside.next()) {
            (Some(piece), None) => read(piece, &mut covered)?,
            _ => covered.push(stretch),
        }
    }
    for piece in long {
        read(piece, &mut covered)?;
    }
    let apart = |a: &Range<i64>, b: &Range<i64>| a.start - b.end > STRAY_NS || b.start - a.end > STRAY_NS;
    few.retain(|few| covered.is_empty() || !covered.iter().all(|stretch| apart(few, stretch)));
    covered.extend(few);
    Ok(joined(covered))
}

/// Whether a piece states a sane range of at most a day.
fn is_short(piece: &Piece) -> bool {
    is_sane(piece.start) && is_sane(piece.end) && clamp_ns(piece.end) - clamp_ns(piece.start) <= STRAY_NS
}

fn stated(piece: &Piece) -> Range<i64> {
    clamp_ns(piece.start)..clamp_ns(piece.end).saturating_add(1)
}

/// Stretches in order, those in one that are no more than a day apart.
pub(super) fn joined(mut stretches: Vec<Range<i64>>) -> Vec<Range<i64>> {
    stretches.sort_by_key(|stretch| stretch.start);
    let mut joined: Vec<Range<i64>> = Vec::new();
    for stretch in stretches {
        match joined.last_mut() {
            Some(last) if stretch.start - last.end <= STRAY_NS => last.end = last.end.max(stretch.end),
            _ => joined.push(stretch),
        }
    }
    joined
}

/// Times and channels of the messages of a piece, as far as they are sane, in order; none of a piece that nobody can
/// read, which the replay counts as a loss.
fn times(inflater: &mut Inflater, file: &InputFile, piece: &Piece) -> io::Result<Times> {
    let records = match inflater.read(file, piece) {
        Ok(records) => records,
        Err(InflateError::Io(error)) => return Err(error),
        Err(InflateError::Corrupt(_) | InflateError::Unreadable { .. }) => return Ok(Times::new()),
    };
    let (mut cursor, mut times) = (Cursor(records), Times::new());
    while let Ok(Some((code, body))) = cursor.record() {
        let message = (code == op::MESSAGE).then(|| Message::parse(body).ok()).flatten();
        times.extend(message.filter(|m| is_sane(m.log_time)).map(|m| (clamp_ns(m.log_time), m.channel)));
    }
    times.sort_unstable();
    Ok(times)
}

/// Cuts times at gaps of more than a day: what has few messages of every channel apart from the rest.
fn sort_out(times: &Times, stretches: &mut Vec<Range<i64>>, few: &mut Vec<Range<i64>>) {
    for run in times.chunk_by(|a, b| b.0 - a.0 <= STRAY_NS) {
        let mut rows: BTreeMap<u16, usize> = BTreeMap::new();
        run.iter().for_each(|(_, channel)| *rows.entry(*channel).or_default() += 1);
        let (Some(first), Some(last)) = (run.first(), run.last()) else { continue };
        let to = if rows.values().all(|rows| *rows <= STRAY_ROWS) { &mut *few } else { &mut *stretches };
        to.push(first.0..last.0.saturating_add(1));
    }
}
