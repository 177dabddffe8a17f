//! What an estimation has gathered, as part of a stage's state. Exact to the bit, NaN included.

use dragfree_schema::state::{State, StateError};

use crate::collected::Collected;
use crate::prediction::{self, Stretch};
use crate::segments;
use crate::slow_band::SlowBand;
use crate::spectra::{Block, MAX_BLOCKS, Plan, Spectra, Sums};

/// Visits the whole state; `layout` says what it is for. Sums of this run and of those before are one in it. What is
/// loaded goes into a run that has not begun, whose sizes it must have.
///
/// # Errors
/// What is loaded does not fit.
pub fn visit(
    state: &mut State<'_>,
    layout: &str,
    segments: &mut segments::State,
    collected: &mut Collected,
    plan: &Plan,
) -> Result<(), StateError> {
    state.same("set of channels, effects or segments", layout)?;
    segments_of(state, segments)?;
    let mut sums =
        if state.is_loading() { Sums { blocks: Vec::new(), ..collected.sums.clone() } } else { collected.all(plan) };
    visit_spectra(state, &mut sums.total)?;
    state.i64(&mut sums.block_ns)?;
    let empty = Block { number: 0, overlaps_before: None, spectra: collected.sums.total.clone() };
    visit_blocks(state, sums.block_ns, &mut sums.blocks, &empty, |state, block| {
        state.i64(&mut block.number)?;
        state.option(&mut block.overlaps_before, State::usize)?;
        if block.overlaps_before.is_some_and(|taper| taper >= MOST_TAPERS) {
            return Err(StateError::Content("an overlap"));
        }
        visit_spectra(state, &mut block.spectra)
    })?;
    if state.is_loading() {
        collected.earlier = sums;
    }
    if let Some(slow) = &mut collected.slow {
        visit_slow(state, slow)?;
    }
    if let Some(residuals) = &mut collected.residuals {
        residuals.visit(state)?;
    }
    if let Some(prediction) = &mut collected.prediction {
        let empty = Stretch { number: 0, sums: vec![0.0; prediction.block_size()] };
        visit_prediction(state, &mut prediction.state, &empty)?;
        if state.is_loading() {
            prediction.design();
        }
    }
    Ok(())
}

/// More tapers than any segment has.
const MOST_TAPERS: usize = 64;

fn segments_of(state: &mut State<'_>, segments: &mut segments::State) -> Result<(), StateError> {
    state.option(&mut segments.last_ns, State::i64)?;
    state.f64s(&mut segments.previous)?;
    segments.run.iter_mut().try_for_each(|column| state.f64_list(column))?;
    if segments.run.windows(2).any(|pair| pair[0].len() != pair[1].len()) {
        return Err(StateError::Content("columns of different lengths"));
    }
    state.flag(&mut segments.run_has_segment)?;
    state.i64(&mut segments.run_end_ns)?;
    for count in [&mut segments.rows, &mut segments.valid, &mut segments.covered] {
        state.u64(count)?;
    }
    segments.missing.iter_mut().try_for_each(|count| state.u64(count))
}

fn visit_slow(state: &mut State<'_>, slow: &mut SlowBand) -> Result<(), StateError> {
    let length = slow.decimator.length();
    let pending = &mut slow.decimator.state;
    state.i64(&mut pending.first_ns)?;
    pending.pending.iter_mut().try_for_each(|column| state.f64_list(column))?;
    let samples = pending.pending.first().map_or(0, Vec::len);
    if samples >= length || pending.pending.iter().any(|column| column.len() != samples) {
        return Err(StateError::Content("decimated columns"));
    }
    segments_of(state, &mut slow.segmenter.state)
}

fn visit_spectra(state: &mut State<'_>, spectra: &mut Spectra) -> Result<(), StateError> {
    state.u64(&mut spectra.segments)?;
    for numbers in [&mut spectra.packed, &mut spectra.expected, &mut spectra.weight, &mut spectra.weight_squared] {
        state.f64s(numbers)?;
    }
    Ok(())
}

fn visit_prediction(
    state: &mut State<'_>,
    prediction: &mut prediction::State,
    empty: &Stretch,
) -> Result<(), StateError> {
    for levels in &mut prediction.levels {
        state.f64s([&mut levels.held, &mut levels.readout])?;
    }
    prediction.memory.iter_mut().try_for_each(|memory| state.f64s(&mut memory.values))?;
    state.u64(&mut prediction.since_gap)?;
    state.i64(&mut prediction.block_ns)?;
    state.u64(&mut prediction.trained_at)?;
    visit_blocks(state, prediction.block_ns, &mut prediction.blocks, empty, |state, block| {
        state.i64(&mut block.number)?;
        state.f64s(&mut block.sums)
    })
}

/// Blocks of time, each of the sizes of `empty`.
fn visit_blocks<T: Clone>(
    state: &mut State<'_>,
    block_ns: i64,
    blocks: &mut Vec<T>,
    empty: &T,
    mut visit: impl FnMut(&mut State<'_>, &mut T) -> Result<(), StateError>,
) -> Result<(), StateError> {
    let count = state.count(blocks.len())?;
    if block_ns <= 0 || count > MAX_BLOCKS {
        return Err(StateError::Content("blocks of time"));
    }
    if !state.is_loading() {
        return blocks.iter_mut().try_for_each(|block| visit(state, block));
    }
    blocks.clear();
    for _ in 0..count {
        let mut block = empty.clone();
        visit(state, &mut block)?;
        blocks.push(block);
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::prediction::Prediction;
    use crate::segments::Segmenter;
    use crate::sigma::NoiseModel;
    use crate::spectra::{Analyser, Layout, Regressor};
    use dragfree_schema::state;

    fn layout() -> Layout {
        Layout {
            channels: vec!["c".into()],
            series: vec!["s".into()],
            regressors: vec![Regressor {
                coefficient: 0,
                channel: 0,
                series: 0,
                factor: 2.0,
                times: None,
                in_loop: false,
            }],
            coefficients: vec!["b".into()],
        }
    }

    fn begin() -> (Segmenter, Collected, Analyser) {
        let model = NoiseModel::new(&[], &["c"], 0.1).expect("a model");
        let plan = Plan::with_slow_bands(64, 10.0);
        let prediction = Prediction::new(&model, &[false], &layout(), &plan);
        assert!(prediction.is_some());
        let collected = Collected::new(&plan, &layout(), prediction);
        (Segmenter::new(64, 100_000_000, vec![false; 2]), collected, Analyser::new(plan, &layout()))
    }

    /// Rows of two columns with a gap, from `first` on.
    fn feed(first: i64, end: i64, (segmenter, collected, analyser): &mut (Segmenter, Collected, Analyser)) {
        let times: Vec<i64> = (first..end).map(|k| 100_000_000 * (k + i64::from(k > 5000) * 7)).collect();
        let column = |p: i64| -> Vec<f64> { (first..end).map(|k| ((k * k % p) as f64).sin()).collect() };
        segmenter.push(&times, &[&column(1009), &column(997)], analyser, collected);
    }

    fn save(layout: &str, (segmenter, collected, analyser): &mut (Segmenter, Collected, Analyser)) -> Vec<u8> {
        let saved =
            state::save("mine", 1, |state| visit(state, layout, &mut segmenter.state, collected, analyser.plan()));
        saved.expect("a state")
    }

    fn load(
        bytes: &[u8],
        layout: &str,
        (segmenter, collected, analyser): &mut (Segmenter, Collected, Analyser),
    ) -> Result<(), StateError> {
        state::load("mine", 1, bytes, |state| visit(state, layout, &mut segmenter.state, collected, analyser.plan()))
    }

    fn saved() -> Vec<u8> {
        let mut run = begin();
        feed(0, 9000, &mut run);
        save("one channel", &mut run)
    }

    #[test]
    fn a_round_trip_changes_no_byte_and_the_run_goes_on_as_one() {
        let bytes = saved();
        let mut second = begin();
        load(&bytes, "one channel", &mut second).expect("our own state");
        assert_eq!(save("one channel", &mut second), bytes);
        feed(9000, 20_000, &mut second);
        let mut whole = begin();
        feed(0, 20_000, &mut whole);
        assert_eq!(second.0.state, whole.0.state);
        let slow = [&second, &whole].map(|r| r.1.slow.as_ref().expect("slow bands"));
        assert_eq!(slow[0].decimator.state, slow[1].decimator.state);
        assert_eq!(slow[0].segmenter.state, slow[1].segmenter.state);
        let states = [&second, &whole].map(|r| r.1.prediction.as_ref().expect("a fit").state.clone());
        let apart = states[0].blocks.iter().zip(&states[1].blocks).flat_map(|(a, b)| {
            assert_eq!(a.number, b.number);
            a.sums.iter().zip(&b.sums).map(|(a, b)| (a / b - 1.0).abs())
        });
        assert!(states[0].blocks.len() == states[1].blocks.len() && apart.fold(0.0, f64::max) < 1e-9);
        let (a, b) = (second.1.all(second.2.plan()), whole.1.all(whole.2.plan()));
        assert_eq!((a.total.segments, a.blocks.len()), (b.total.segments, b.blocks.len()));
        let apart = a.total.packed.iter().zip(&b.total.packed).map(|(a, b)| (a / b - 1.0).abs());
        assert!(apart.fold(0.0, f64::max) < 1e-9);
    }

    #[test]
    fn every_flipped_byte_and_every_cut_is_refused() {
        let bytes = saved();
        for i in (0..bytes.len()).step_by(bytes.len() / 500) {
            let mut damaged = bytes.clone();
            damaged[i] ^= 0x40;
            assert!(load(&damaged, "one channel", &mut begin()).is_err(), "byte {i}");
            assert!(load(&bytes[..i], "one channel", &mut begin()).is_err(), "cut at {i}");
        }
        assert!(matches!(load(&bytes, "two channels", &mut begin()), Err(StateError::Differs { .. })));
    }
}
