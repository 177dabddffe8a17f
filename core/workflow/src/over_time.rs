//! What a product's model leaves of each channel, over time: the table `residuals` of the file beside it.

use std::collections::BTreeMap;

use dragfree_archive::Archive;
use dragfree_engine::EngineError;
use dragfree_engine::telemetry::{Topic, read_topic};
use dragfree_identification::distributions::normal_tails;
use serde::Serialize;

use crate::WorkflowError;

/// Topic of the residuals.
pub const RESIDUALS: &str = "/residuals";
/// File of time series beside a product.
pub const SERIES: &str = "mcap";

/// Residuals of a product over time.
#[derive(Clone, Debug, Serialize)]
pub struct OverTime {
    /// Centres of the intervals, Unix ns.
    pub time_ns: Vec<i64>,
    /// Channels, in the order of their names.
    pub channels: Vec<Channel>,
}

/// Residuals of a channel.
#[derive(Clone, Debug, Serialize)]
pub struct Channel {
    /// `tm1.accel.x`, for one.
    pub name: String,
    /// Unit.
    pub unit: String,
    /// Mean of each interval over its σ where model and noise are right; NaN where nobody declares a noise.
    pub whitened: Vec<f64>,
    /// Root of the mean square of each interval's residuals, in the unit.
    pub rms: Vec<f64>,
}

/// What a channel's means say of the model.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Told {
    /// Root of the mean square of the means over their σ: 1 where model and noise are right.
    pub size: f64,
    /// The mean farthest from zero, σ.
    pub farthest: f64,
    /// Its time, Unix ns.
    pub farthest_ns: i64,
    /// Whether chance is no explanation for it, all intervals of all channels considered.
    pub stands_out: bool,
}

impl OverTime {
    /// What the means of a channel say; none without a declared noise. A sound model has a channel with a mean that
    /// stands out with a probability of `false_alarm` at most.
    pub fn told(&self, channel: &Channel, false_alarm: f64) -> Option<Told> {
        let finite = channel.whitened.iter().zip(&self.time_ns).filter(|(x, _)| x.is_finite());
        let (farthest, farthest_ns) = finite.clone().max_by(|(a, _), (b, _)| a.abs().total_cmp(&b.abs()))?;
        let squares: f64 = finite.clone().map(|(x, _)| x * x).sum();
        let tried = (finite.count(), self.channels.len());
        let p = normal_tails(*farthest) * (tried.0 * tried.1) as f64;
        Some(Told {
            size: (squares / tried.0 as f64).sqrt(),
            farthest: *farthest,
            farthest_ns: *farthest_ns,
            stands_out: p < false_alarm,
        })
    }
}

/// Extremes of a series in stretches of equal length.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Extremes {
    /// Beginning of each stretch, Unix ns.
    pub time_ns: Vec<i64>,
    /// Least value of each stretch; NaN without one.
    pub low: Vec<f64>,
    /// Greatest.
    pub high: Vec<f64>,
}

/// Residuals of a product over time; none where it was made before they were kept, or has no solution.
///
/// # Errors
/// There is no such product, or the file beside it is damaged.
pub fn over_time(archive: &Archive, id: &str) -> Result<Option<OverTime>, WorkflowError> {
    let files = archive.files_of(id).map_err(EngineError::from)?;
    if !files.iter().any(|(suffix, ..)| suffix == SERIES) {
        return Ok(None);
    }
    let bytes = archive.read_file(id, SERIES).map_err(EngineError::from)?;
    let path = archive.path_of(id).with_extension(SERIES);
    let topic = read_topic(&path, &bytes, RESIDUALS);
    let topic = topic.map_err(|e| WorkflowError::Reference { path, what: e.source.to_string() })?;
    Ok((!topic.time_ns.is_empty()).then(|| of_topic(topic)))
}

fn of_topic(topic: Topic) -> OverTime {
    let Topic { time_ns, mut columns, metadata } = topic;
    let mut channels: BTreeMap<String, Channel> = BTreeMap::new();
    let fields: Vec<String> = columns.keys().cloned().collect();
    for field in fields {
        let Some((name, what @ ("whitened" | "rms"))) = field.rsplit_once('.') else { continue };
        let values = columns.remove(&field).unwrap_or_default();
        let channel = channels.entry(name.to_owned()).or_insert_with(|| Channel {
            name: name.to_owned(),
            unit: String::new(),
            whitened: Vec::new(),
            rms: Vec::new(),
        });
        if what == "rms" {
            channel.unit = metadata.get(&format!("unit:{field}")).cloned().unwrap_or_default();
            channel.rms = values;
        } else {
            channel.whitened = values;
        }
    }
    OverTime { time_ns, channels: channels.into_values().collect() }
}

/// The least and the greatest of every stretch of a series, at most `most` stretches: a picture as wide as that loses
/// nothing. Times are in ascending order.
pub fn extremes(time_ns: &[i64], values: &[f64], most: usize) -> Extremes {
    let (Some(first), Some(last)) = (time_ns.first(), time_ns.last()) else { return Extremes::default() };
    let shortest = time_ns.windows(2).map(|t| t[1] - t[0]).min().unwrap_or(1).max(1);
    let span_ns = last - first;
    let length_ns = shortest * (span_ns / most.max(1) as i64 / shortest + 1);
    let count = (span_ns / length_ns + 1) as usize;
    let mut all = Extremes {
        time_ns: (0..count).map(|k| first + k as i64 * length_ns).collect(),
        low: vec![f64::NAN; count],
        high: vec![f64::NAN; count],
    };
    for (t, x) in time_ns.iter().zip(values) {
        let k = ((t - first) / length_ns) as usize;
        // NaN gives way to any number.
        (all.low[k], all.high[k]) = (all.low[k].min(*x), all.high[k].max(*x));
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_stands_out_is_told() {
        let channel = |whitened: Vec<f64>| Channel {
            name: "a".to_owned(),
            unit: String::new(),
            rms: vec![1.0; whitened.len()],
            whitened,
        };
        let quiet: Vec<f64> = (0..1000).map(|k| if k % 2 == 0 { 1.0 } else { -1.0 }).collect();
        let mut loud = quiet.clone();
        loud[700] = -6.0;
        let all = OverTime { time_ns: (0..1000).collect(), channels: vec![channel(quiet), channel(loud)] };
        let told = |c: usize| all.told(&all.channels[c], 0.01).expect("numbers");
        assert_eq!((told(0).size, told(0).stands_out), (1.0, false));
        assert_eq!((told(1).farthest, told(1).farthest_ns, told(1).stands_out), (-6.0, 700, true));
        // 4.5 σ happens once in 150,000 times: of 2,000 means by chance with 1.4 %.
        let mut chance = all.channels[0].whitened.clone();
        chance[3] = 4.5;
        assert!(!all.told(&channel(chance), 0.01).expect("numbers").stands_out);
        assert_eq!(all.told(&channel(vec![f64::NAN; 1000]), 0.01), None);
    }

    #[test]
    fn extremes_lose_no_peak_and_close_no_gap() {
        let mut values: Vec<f64> = (0..1000).map(|k| f64::from(k % 7)).collect();
        values[501] = 40.0;
        values[502] = f64::NAN;
        values[503] = -3.0;
        let mut times: Vec<i64> = (0..1000).map(|k| 50 + 30 * k).collect();
        let all = extremes(&times, &values, 100);
        assert_eq!((all.time_ns.len(), all.time_ns[50]), (100, times[500]));
        assert_eq!((all.low[50], all.high[50]), (-3.0, 40.0));
        assert_eq!((all.low[49], all.high[49]), (0.0, 6.0));
        // Shorter than the picture: every value stands for itself.
        assert_eq!(extremes(&times[..3], &values[..3], 100).low, values[..3]);
        assert!(extremes(&[7], &[f64::NAN], 5).low[0].is_nan());
        assert_eq!(extremes(&[], &[], 5), Extremes::default());
        // The second half comes as much later as the first half is long.
        times.iter_mut().skip(500).for_each(|t| *t += 15_000);
        let all = extremes(&times, &values, 150);
        let empty = all.high.iter().filter(|x| x.is_nan()).count();
        assert!((45..=52).contains(&empty), "{empty} of {}", all.high.len());
    }
}
