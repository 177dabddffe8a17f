//! Clocks that are wrong for a while.
//!
//! A clock that is put forward by a few samples and back again leaves as many epochs without a message as it gives
//! others a second one, with other values: the hole begins the stretch whose times are wrong and the conflicts end it,
//! or the other way round where it was put back first. Nothing else about such a stretch is odd, and which of two
//! messages of one time is the right one, nobody can know.

use std::collections::BTreeMap;

/// Fewer are no sign of a clock: one message is lost, and another one repeated with a wrong value, by chance.
const FEWEST: u64 = 2;
/// Epochs whose median distance is that of all.
const SAMPLE: usize = 16;

/// A stretch of one topic whose clock was wrong.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Stepped {
    /// Epochs between the two steps.
    pub(super) epochs: u64,
    /// Distance of epochs, ns.
    pub(super) step_ns: i64,
    /// First epoch of the stretch, Unix ns.
    pub(super) from_ns: i64,
    /// By how many epochs the clock was wrong; late times are positive.
    pub(super) by: i64,
}

/// Epochs in a row without a message, or with two.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Odd {
    missing: bool,
    count: u64,
    first_ns: i64,
    end_ns: i64,
}

/// What is odd about the epochs of one topic, as they come.
#[derive(Clone, Debug, Default)]
pub(super) struct Clock {
    /// Distance of the epochs, once there are enough of them.
    step_ns: Option<i64>,
    last_ns: Option<i64>,
    /// The last hole and the last conflicts of each number of epochs that are half of no stretch yet: other holes may
    /// lie in a stretch.
    holes: BTreeMap<u64, Odd>,
    conflicts: BTreeMap<u64, Odd>,
    /// What is odd now.
    now: Option<Odd>,
}

impl Clock {
    /// The next epochs, with those at which a message was refused as another had come before it; both ascending.
    pub(super) fn see(&mut self, times_ns: &[i64], refused_ns: &[i64]) -> Vec<Stepped> {
        if self.step_ns.is_none() && times_ns.len() > SAMPLE {
            let mut steps: Vec<i64> = times_ns.windows(2).take(SAMPLE).map(|w| w[1] - w[0]).collect();
            steps.sort_unstable();
            self.step_ns = Some(steps[SAMPLE / 2].max(1));
        }
        let mut found = Vec::new();
        let Some(step_ns) = self.step_ns else { return found };
        let mut refused = refused_ns.iter().peekable();
        for time in times_ns {
            if let Some(last) = self.last_ns {
                let missing = (time - last + step_ns / 2) / step_ns - 1;
                if missing > 0 {
                    let (first_ns, count) = (last + step_ns, missing.unsigned_abs());
                    found.extend(self.met(Odd { missing: true, count, first_ns, end_ns: *time }));
                }
            }
            self.last_ns = Some(*time);
            if refused.next_if(|t| *t <= time).is_some() {
                // More than two messages may have one time.
                while refused.next_if(|t| *t <= time).is_some() {}
                found.extend(self.met(Odd { missing: false, count: 1, first_ns: *time, end_ns: time + step_ns }));
            }
        }
        found
    }

    /// One more oddity: it goes on with the one under way, or ends it.
    fn met(&mut self, odd: Odd) -> Option<Stepped> {
        match &mut self.now {
            Some(now) if now.missing == odd.missing && odd.first_ns <= now.end_ns => {
                now.count += odd.count;
                now.end_ns = odd.end_ns;
                None
            }
            _ => {
                let found = self.end();
                self.now = Some(odd);
                found
            }
        }
    }

    /// What is odd has ended, as it has at the end of the data: with what was odd before, it may enclose a stretch.
    pub(super) fn end(&mut self) -> Option<Stepped> {
        let now = self.now.take().filter(|odd| odd.count >= FEWEST)?;
        let (own, others) =
            if now.missing { (&mut self.holes, &mut self.conflicts) } else { (&mut self.conflicts, &mut self.holes) };
        let Some(before) = others.remove(&now.count) else {
            own.insert(now.count, now);
            return None;
        };
        let by = i64::try_from(now.count).unwrap_or(i64::MAX);
        let epochs = (now.first_ns - before.end_ns) / self.step_ns?;
        let by = if before.missing { by } else { -by };
        Some(Stepped { epochs: epochs.max(0).unsigned_abs(), step_ns: self.step_ns?, from_ns: before.end_ns, by })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const STEP_NS: i64 = 100_000_000;

    /// What is found where messages are sent at the epochs of `sent` in pieces of `piece` epochs.
    fn found(sent: &[i64], piece: usize) -> Vec<Stepped> {
        let mut clock = Clock::default();
        let mut sent: Vec<i64> = sent.iter().map(|k| k * STEP_NS).collect();
        sent.sort_unstable();
        let (mut times, mut refused): (Vec<i64>, Vec<i64>) = (Vec::new(), Vec::new());
        for time in sent {
            if times.last() == Some(&time) { refused.push(time) } else { times.push(time) }
        }
        let mut all = Vec::new();
        for times in times.chunks(piece) {
            let own: Vec<i64> =
                refused.iter().copied().filter(|t| (times[0]..=times[times.len() - 1]).contains(t)).collect();
            all.extend(clock.see(times, &own));
        }
        all.extend(clock.end());
        all
    }

    /// Epochs up to 200 whose clock is `by` epochs late in some of them.
    fn stepped(wrong: std::ops::Range<i64>, by: i64) -> Vec<i64> {
        (0..200).map(|k| if wrong.contains(&k) { k + by } else { k }).collect()
    }

    #[test]
    fn a_clock_that_is_late_or_early_for_a_while_is_found_in_whatever_pieces_it_comes() {
        for piece in [17, 50, 1000] {
            let late = Stepped { epochs: 57, step_ns: STEP_NS, from_ns: 43 * STEP_NS, by: 3 };
            assert_eq!(found(&stepped(40..100, 3), piece), [late], "{piece}");
            let early = Stepped { epochs: 57, step_ns: STEP_NS, from_ns: 40 * STEP_NS, by: -3 };
            assert_eq!(found(&stepped(40..100, -3), piece), [early], "{piece}");
        }
    }

    #[test]
    fn a_hole_in_between_hides_no_clock() {
        let sent: Vec<i64> = stepped(40..100, 3).into_iter().filter(|k| !(60..67).contains(k)).collect();
        let late = Stepped { epochs: 57, step_ns: STEP_NS, from_ns: 43 * STEP_NS, by: 3 };
        assert_eq!(found(&sent, 50), [late]);
    }

    #[test]
    fn lost_and_repeated_messages_are_no_clock() {
        let without = |gone: std::ops::Range<i64>| (0..200).filter(move |k| !gone.contains(k));
        assert_eq!(found(&without(40..43).collect::<Vec<_>>(), 50), []);
        // Other numbers of them, a single one, and holes alone.
        assert_eq!(found(&without(40..43).chain(100..105).collect::<Vec<_>>(), 50), []);
        assert_eq!(found(&without(40..41).chain([100]).collect::<Vec<_>>(), 50), []);
        let holes: Vec<i64> = (0..200).filter(|k| !(40..43).contains(k) && !(60..63).contains(k)).collect();
        assert_eq!(found(&holes, 50), []);
    }
}
