//! A short round for every reader. Long ones: `cargo run --release -p dragfree-fuzz -- --seconds 600`.

use dragfree_fuzz::round::round;
use dragfree_fuzz::targets::Target;
use std::time::Duration;

/// Other numbers than those of the long rounds, which begin at 0.
const FIRST: u64 = 1 << 40;

#[test]
fn no_damaged_input_makes_a_reader_panic_or_hang() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    for target in Target::ALL {
        let kept = folder.path().join(target.name());
        let round = round(target, FIRST, 20_000, Duration::from_secs_f64(1.5), &kept).expect("a round");
        assert!(round.inputs > 100, "{round:?}");
        assert!(round.panics.is_empty() && round.late.is_empty(), "{round:?}");
    }
}

/// A reader that fails on sound inputs would make every round pass; that of telemetry: `corpus.rs`.
#[test]
fn the_corpora_are_sound() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    for target in Target::ALL {
        let corpus = target.corpus().expect("a corpus");
        assert!(!corpus.is_empty(), "{}", target.name());
        corpus.iter().for_each(|input| target.read(input, &folder.path().join("file")).expect("read"));
    }
}
