//! What a product's channels leave in each band, as a function of the coefficients of the model and of every candidate.
//!
//! With `r` the residual at the values `θ₀` and `φ_i` the regressors, the residual at θ is `r − Σ (θ_i − θ₀_i) φ_i`.
//! Its power in a band is a quadratic form, here over the power of the noise and summed over the bands of a group.
//! Forms of days add, as their bands are the same.

use std::collections::BTreeMap;
use std::ops::Range;

use dragfree_estimation::sigma::BandNoise;
use dragfree_identification::candidates::{Candidate, CandidateSet, Coefficient as Unknown, Form};
use dragfree_identification::gram::Symmetric;
use dragfree_identification::record::Record;
use dragfree_schema::Coefficient;
use serde::{Deserialize, Serialize};

use super::packed::singles;
use crate::WorkflowError;
use crate::residuals::groups;

/// Residual power of a product by channel and group of bands.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct ByBand {
    pub(crate) channels: Vec<String>,
    /// First and last frequency of each group of bands.
    pub(crate) groups_hz: Vec<[f64; 2]>,
    /// Complex observations in each group.
    pub(crate) observations: Vec<f64>,
    /// By channel and group, root of the mean modelled power spectral density, unit of the channel/√Hz.
    pub(crate) modelled_asd: Vec<Vec<f64>>,
    /// θ₀ of each coefficient of the extract.
    pub(crate) about: Vec<f64>,
    /// By channel, coefficients of the extract that act on it.
    pub(crate) acting: Vec<Vec<usize>>,
    /// By channel and group, the lower triangle of the form in 1 and the changes of the acting coefficients.
    #[serde(with = "singles")]
    pub(crate) forms: Vec<f32>,
    /// By coefficient of a noise level, channel and group: the part of the modelled power that has this level.
    pub(crate) levels: BTreeMap<String, Vec<Vec<f32>>>,
}

/// Numbers in the lower triangle of a matrix with so many rows.
pub(crate) fn triangle(rows: usize) -> usize {
    rows * (rows + 1) / 2
}

impl ByBand {
    /// From the sums of all candidates, and what is named in its form. `about` gives the values of the model's
    /// coefficients.
    ///
    /// # Errors
    /// The declared noise contradicts itself.
    pub(super) fn new(
        coefficients: &[Coefficient],
        named: &[Candidate],
        record: &Record,
        about: impl Fn(&str) -> Option<f64>,
    ) -> Result<Self, WorkflowError> {
        let Record { candidate_set: set, gathered, .. } = record;
        let plan = gathered.plan();
        let model = record.noise_model()?;
        let noise = BandNoise::new(&model, &plan);
        let bands_hz: Vec<[f64; 2]> =
            plan.bands.iter().map(|b| [b.first, b.end - 1].map(|k| plan.hz(*b, k as f64))).collect();
        let groups = groups(&bands_hz);
        let (expected, observations) = (&gathered.total.weights.expected, gathered.total.weights.observations(&plan));
        let initial = |i: usize| set.coefficients[i].initial;
        let value = |i: usize| about(&set.coefficients[i].name).unwrap_or_else(|| initial(i));
        let forms: Vec<Option<&Form>> = coefficients.iter().map(|c| form_of(set, named, c)).collect();
        let about: Vec<f64> =
            coefficients.iter().map(|c| if c.candidate { 0.0 } else { about(&c.name).unwrap_or(c.initial) }).collect();
        // What a coefficient adds to a channel, as columns with weights.
        let adds = |form: &Form, channel: usize| -> Vec<(usize, f64)> {
            let own = form.terms.iter().filter(|t| t.channel == channel);
            own.map(|t| (t.column, t.factor * t.times.map_or(1.0, value))).collect()
        };
        let (mut acting, mut packed, mut modelled_asd) = (Vec::new(), Vec::new(), Vec::new());
        for channel in 0..set.channels.len() {
            let all = forms.iter().enumerate().filter_map(|(i, form)| Some((i, adds((*form)?, channel))));
            let all: Vec<(usize, Vec<(usize, f64)>)> = all.filter(|(_, terms)| !terms.is_empty()).collect();
            let mut residual = vec![(channel, 1.0)];
            let mut taken: Vec<&str> = Vec::new();
            for (i, terms) in all.iter().filter(|(i, _)| !coefficients[*i].candidate) {
                taken.push(&coefficients[*i].name);
                residual.extend(terms.iter().map(|(column, weight)| (*column, -about[*i] * weight)));
            }
            // Coefficients of the model that the extract has not, as fixed ones.
            for (i, c) in set.coefficients[..set.model()].iter().enumerate() {
                if !taken.contains(&c.name.as_str()) {
                    let terms = adds(&c.forms[0], channel);
                    residual.extend(terms.iter().map(|(column, weight)| (*column, -value(i) * weight)));
                }
            }
            let mut combinations = vec![residual];
            combinations.extend(all.iter().map(|(_, terms)| terms.clone()));
            for range in &groups {
                let n = combinations.len();
                let mut sum = vec![0.0; triangle(n)];
                for b in range.clone().filter(|b| observations[*b] > 0.0 && expected[*b] > 0.0) {
                    let power = noise.mean(b)[(channel, channel)];
                    if power > 0.0 {
                        add(&mut sum, &gathered.total.bands[b], &combinations, observations[b] / (expected[b] * power));
                    }
                }
                packed.extend(sum.iter().map(|x| *x as f32));
            }
            let asd = |range: &Range<usize>| {
                let bins = |b: usize| plan.bands[b].bins() as f64;
                let sum: f64 = range.clone().map(|b| bins(b) * noise.mean(b)[(channel, channel)]).sum();
                (sum / range.clone().map(bins).sum::<f64>()).max(0.0).sqrt()
            };
            modelled_asd.push(groups.iter().map(asd).collect());
            acting.push(all.into_iter().map(|(i, _)| i).collect());
        }
        let part = |process: &str, channel: usize, range: &Range<usize>| -> f32 {
            let of = |b: usize| {
                let hz = plan.frequency_hz(plan.bands[b]);
                let own = model.process_psd(process, hz).map_or(0.0, |psd| psd[(channel, channel)]);
                let all = model.psd(hz)[(channel, channel)];
                (observations[b], if all > 0.0 { own / all } else { 0.0 })
            };
            let (weight, sum) =
                range.clone().map(of).fold((0.0, 0.0), |(w, s), (weight, x)| (w + weight, s + weight * x));
            if weight > 0.0 { (sum / weight) as f32 } else { 0.0 }
        };
        let levels = set.coefficients.iter().filter(|c| !c.noise.is_empty()).map(|c| {
            let by_group = |channel: usize| groups.iter().map(|range| part(&c.noise, channel, range)).collect();
            (c.name.clone(), (0..set.channels.len()).map(by_group).collect())
        });
        Ok(Self {
            channels: set.channels.clone(),
            groups_hz: groups.iter().map(|r| [bands_hz[r.start][0], bands_hz[r.end - 1][1]]).collect(),
            observations: groups.iter().map(|r| r.clone().map(|b| observations[b]).sum()).collect(),
            modelled_asd,
            about,
            acting,
            forms: packed,
            levels: levels.collect(),
        })
    }

    /// Whether its numbers are as many as its coefficients, channels and groups need.
    pub(super) fn is_whole(&self, coefficients: usize) -> bool {
        let (channels, groups) = (self.channels.len(), self.groups_hz.len());
        let by_group = |rows: &Vec<Vec<f32>>| rows.len() == channels && rows.iter().all(|row| row.len() == groups);
        self.about.len() == coefficients
            && self.observations.len() == groups
            && self.acting.len() == channels
            && self.acting.iter().flatten().all(|i| *i < coefficients)
            && self.modelled_asd.len() == channels
            && self.modelled_asd.iter().all(|row| row.len() == groups)
            && self.levels.values().all(by_group)
            && self.forms.len() == self.acting.iter().map(|own| groups * triangle(own.len() + 1)).sum::<usize>()
            && self.forms.iter().all(|x| x.is_finite())
    }

    /// Whether forms of another product can be added.
    pub(crate) fn adds_to(&self, other: &Self) -> bool {
        self.channels == other.channels && self.groups_hz == other.groups_hz
    }

    /// Power of the residual over that of the noise, times the observations, by channel and group. `value` gives the
    /// value of each coefficient of the extract.
    pub(crate) fn power(&self, value: impl Fn(usize) -> f64) -> Vec<Vec<f64>> {
        let groups = self.groups_hz.len();
        let mut forms = self.forms.as_slice();
        let of_channel = |acting: &Vec<usize>| {
            let n = acting.len() + 1;
            let moved: Vec<f64> =
                std::iter::once(1.0).chain(acting.iter().map(|i| self.about[*i] - value(*i))).collect();
            // Most candidates are off.
            let some: Vec<usize> = (0..n).filter(|k| moved[*k] != 0.0).collect();
            let (own, rest) = forms.split_at(groups * triangle(n));
            forms = rest;
            let of_group = |form: &[f32]| {
                let row = |k: usize| {
                    let below = some.iter().take_while(|l| **l < k);
                    let half: f64 = below.map(|l| f64::from(form[triangle(k) + l]) * moved[*l]).sum();
                    moved[k] * (2.0 * half + f64::from(form[triangle(k) + k]) * moved[k])
                };
                some.iter().map(|k| row(*k)).sum::<f64>().max(0.0)
            };
            own.chunks_exact(triangle(n)).map(of_group).collect()
        };
        self.acting.iter().map(of_channel).collect()
    }
}

/// The form in which a coefficient is in an extract: one of the search, or one between these that is named.
fn form_of<'a>(set: &'a CandidateSet, named: &'a [Candidate], c: &Coefficient) -> Option<&'a Form> {
    let same = |own: &&Unknown| own.name == c.name && own.candidate == c.candidate;
    let of_shape = |form: &&Form| {
        !c.candidate || (form.shape.len() == c.shape.len() && form.shape.iter().all(|(k, v)| c.shape.get(k) == Some(v)))
    };
    let parts = named.iter().flat_map(|candidate| &candidate.parts);
    let between = parts.filter(|(index, _)| same(&&set.coefficients[*index])).map(|(_, form)| form);
    set.coefficients.iter().filter(same).flat_map(|own| &own.forms).chain(between).find(of_shape)
}

/// Adds the products of combinations of columns in a band, from the diagonal down, times a weight.
fn add(sum: &mut [f64], gram: &Symmetric, combinations: &[Vec<(usize, f64)>], weight: f64) {
    let n = gram.order();
    let inside = |terms: &[(usize, f64)]| -> Vec<(usize, f64)> {
        terms.iter().copied().filter(|(column, _)| *column < n).collect()
    };
    let combinations: Vec<Vec<(usize, f64)>> = combinations.iter().map(|terms| inside(terms)).collect();
    let mut to = sum.iter_mut();
    for (k, a) in combinations.iter().enumerate() {
        for b in &combinations[..=k] {
            let product = |(i, x): &(usize, f64)| x * b.iter().map(|(j, y)| y * gram.at(*i, *j)).sum::<f64>();
            if let Some(to) = to.next() {
                *to += weight * a.iter().map(product).sum::<f64>();
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::DMatrix;

    use super::*;

    /// The form at any values is the power of the residual made of the columns themselves, to the digits of 32 bits.
    /// The Gram matrix is that of columns that are there: integers of a generator by Lehmer.
    #[test]
    fn a_form_is_the_power_of_the_residual() {
        let mut state = 7_u64;
        let mut next = || {
            state = state * 48_271 % 2_147_483_647;
            state as f64 / 2_147_483_647.0 - 0.5
        };
        let columns = DMatrix::from_fn(40, 5, |_, _| next());
        let mut gram = Symmetric::zeros(5);
        gram.add_square(&columns.as_view());
        // Channel 0 with a coefficient of the model in column 1, and candidates in 2 and in 3 and 4; a sixth column is
        // not in this band.
        let about = [0.7, 0.0, 0.0];
        let adds = [vec![(1, 2.0)], vec![(2, -1.0)], vec![(3, 0.5), (4, 3.0), (5, 9.0)]];
        let residual = vec![(0, 1.0), (1, -0.7 * 2.0)];
        let combinations = [vec![residual], adds.to_vec()].concat();
        let mut sum = vec![0.0; triangle(4)];
        add(&mut sum, &gram, &combinations, 3.0);
        let by_band = ByBand {
            channels: vec!["c".to_owned()],
            groups_hz: vec![[0.1, 0.2]],
            observations: vec![40.0],
            modelled_asd: vec![vec![1.0]],
            about: about.to_vec(),
            acting: vec![vec![0, 1, 2]],
            forms: sum.iter().map(|x| *x as f32).collect(),
            levels: BTreeMap::new(),
        };
        assert!(by_band.is_whole(3) && !by_band.is_whole(2));
        for values in [[0.7, 0.0, 0.0], [0.5, 0.0, 0.3], [-1.0, 2.0, 0.1]] {
            let mut left = columns.column(0).into_owned();
            for (value, terms) in values.iter().zip(&adds) {
                terms.iter().filter(|(k, _)| *k < 5).for_each(|(k, x)| left.axpy(-value * x, &columns.column(*k), 1.0));
            }
            let expected = 3.0 * left.norm_squared();
            let power = by_band.power(|i| values[i])[0][0];
            assert!((power / expected - 1.0).abs() < 1e-5, "{values:?}: {power} {expected}");
        }
        let text = serde_json::to_string(&by_band).expect("JSON");
        assert_eq!(serde_json::from_str::<ByBand>(&text).expect("our own"), by_band);
    }
}
