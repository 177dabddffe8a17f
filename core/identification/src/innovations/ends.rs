//! Detection of transients near the ends of the data and of gaps: matched filters on the innovations.
//!
//! The spectra of [`crate::transient`] taper the ends of the data, so that a transient there is lost or has a wrong
//! time. The innovations need no taper: they are white, and what a transient that begins at `t` adds to them is one
//! response `h`, shifted. With innovations e up to the last one, `n(t) = Σ_s h(s)·e(t + s)` has the variance `D(t) =
//! Σ_s h²(s)`, both over the samples that there are, and `n/√D` is the significance. Constants and starts have been
//! fitted before, and their score is zero: they only lower D, so the significance is never too high on their account.

use std::f64::consts::TAU;
use std::ops::Range;

use realfft::num_complex::Complex64;

use super::lanes::Kernel;
use crate::transient::{Detection, LEAST, LOUD, MEDIAN, Template, Transforms, Transients};

/// Length of a window at an end of a stretch of data, s. The response of a push of a test mass lasts for about half an
/// hour.
const WINDOW_S: f64 = 3000.0;
/// Part of a window, from the end of the data on, in which a transient may begin. In the rest of it the windows inside
/// of the data see more of it.
const ZONE: f64 = 0.75;
/// Windows that are searched at most; each takes some megabytes.
const MOST_WINDOWS: usize = 16;
/// Other places that may have made the same transient are tried at times that differ by less than this, s.
const SAME_S: f64 = 300.0;

/// Some consecutive innovations.
struct Window {
    first_ns: i64,
    /// Whitened, row after row.
    rows: Vec<f64>,
    /// Rows in which a transient may begin.
    zone: Range<usize>,
}

/// Innovations near the ends of every stretch of data.
pub(super) struct Ends {
    templates: Vec<Template>,
    /// By channel: what one sample of one unit in it adds to the whitened innovations, row after row.
    responses: Vec<Vec<f64>>,
    channels: usize,
    step_ns: i64,
    /// Rows of a window.
    length: usize,
    windows: Vec<Window>,
    /// The first rows of the stretch that goes on.
    first: Vec<f64>,
    /// Its last rows; more than a window of them while rows come.
    last: Vec<f64>,
    /// Time of its last row, ns.
    last_ns: i64,
    /// Rows of it.
    count: usize,
}

/// One template in one window.
struct Peak {
    template: usize,
    window: usize,
    row: usize,
    significance: f64,
}

/// What a template looks like in a stretch of white innovations.
struct Response {
    /// Conjugate spectra, channel after channel.
    conjugate: Vec<Vec<Complex64>>,
    /// Energy of the first rows: element k is that of k rows.
    energy: Vec<f64>,
    /// Independent trials in one second, see [`LOUD`].
    trials_hz: f64,
}

impl Ends {
    /// Templates act on channels in their SI unit, of which `unit` is that of the kernel.
    pub(super) fn new(kernel: &Kernel, unit: &[f64], step_ns: i64, templates: Vec<Template>) -> Self {
        let channels = kernel.channels;
        let length = (WINDOW_S * 1e9 / step_ns as f64) as usize;
        let length = length.next_power_of_two();
        let response = |channel: usize| {
            let (mut state, mut next) = (vec![0.0; kernel.states], vec![0.0; kernel.states]);
            let mut rows = vec![0.0; length * channels];
            let mut e = vec![0.0; channels];
            for (k, row) in rows.chunks_exact_mut(channels).enumerate() {
                e.fill(0.0);
                e[channel] = if k == 0 { unit[channel].recip() } else { 0.0 };
                kernel.step(&mut state, &mut next, &mut e);
                kernel.whiten(&e, row);
            }
            rows
        };
        Self {
            responses: (0..channels).map(response).collect(),
            templates,
            channels,
            step_ns,
            length,
            windows: Vec::new(),
            first: Vec::new(),
            last: Vec::new(),
            last_ns: 0,
            count: 0,
        }
    }

    /// Adds the innovations of one row, whitened.
    pub(super) fn push(&mut self, time_ns: i64, row: &[f64]) {
        let whole = self.length * self.channels;
        if self.first.len() < whole {
            self.first.extend(row);
        }
        self.last.extend(row);
        if self.last.len() >= 2 * whole {
            self.last.drain(..self.last.len() - whole);
        }
        (self.last_ns, self.count) = (time_ns, self.count + 1);
    }

    /// The stretch has ended.
    pub(super) fn gap(&mut self) {
        let rows = std::mem::take(&mut self.count);
        let (first, mut last) = (std::mem::take(&mut self.first), std::mem::take(&mut self.last));
        let zone = (ZONE * self.length as f64) as usize;
        let first_ns = self.last_ns - (rows as i64 - 1) * self.step_ns;
        if rows == 0 {
            return;
        }
        if rows <= self.length {
            self.windows.push(Window { first_ns, rows: first, zone: 0..rows });
        } else {
            let begin = rows - self.length;
            last.drain(..last.len() - self.length * self.channels);
            // What lies in both zones is searched in the first of them.
            let from = (self.length - zone).max(zone.saturating_sub(begin));
            self.windows.push(Window { first_ns, rows: first, zone: 0..zone });
            let last_first_ns = first_ns + begin as i64 * self.step_ns;
            self.windows.push(Window { first_ns: last_first_ns, rows: last, zone: from..self.length });
        }
        // The ends of all data come first and last; those of gaps are left out where there are too many.
        if self.windows.len() > MOST_WINDOWS {
            self.windows.remove(MOST_WINDOWS / 2);
        }
    }

    /// The loudest transient of each window, as every place that could have made it, and where it was looked for.
    pub(super) fn search(&self, threads: usize) -> (Transients, Vec<Range<i64>>) {
        let n = 2 * self.length;
        let fft = Transforms::new(n);
        let spectra = |rows: &[f64]| -> Vec<Vec<Complex64>> {
            let channel = |c: usize| {
                let mut samples: Vec<f64> = rows.iter().skip(c).step_by(self.channels).copied().collect();
                samples.resize(n, 0.0);
                fft.spectrum(samples)
            };
            (0..self.channels).map(channel).collect()
        };
        let windows: Vec<_> = self.windows.iter().map(|w| spectra(&w.rows)).collect();
        let responses: Vec<_> = self.responses.iter().map(|rows| spectra(rows)).collect();
        // Spectrum of the mean of two samples.
        let previous = |k: usize| Complex64::from_polar(1.0, -TAU * k as f64 / n as f64);
        let averaging: Vec<Complex64> = (0..=self.length).map(|k| 0.5 * (1.0 + previous(k))).collect();
        let all: Vec<usize> = (0..self.templates.len()).collect();
        let look = |templates: &[usize]| {
            let (mut peaks, mut tried) = (Vec::new(), 0.0);
            for template in templates {
                let response = self.response(*template, &responses, &averaging, &fft);
                let outputs: Vec<Vec<f64>> =
                    windows.iter().enumerate().map(|(w, spectra)| self.sizes(w, &response, spectra, &fft)).collect();
                // Noise may exceed the declared one. A transient in one window leaves the others as they are.
                let louder = outputs.iter().filter_map(|sizes| level(sizes)).fold(f64::INFINITY, f64::min).max(1.0);
                for (window, sizes) in outputs.iter().enumerate() {
                    let zone_s = self.windows[window].zone.len() as f64 * self.step_ns as f64 * 1e-9;
                    tried += response.trials_hz * zone_s;
                    // The highest of each part: that of all tells whether the transient is in the zone, the others what
                    // other places could have made there.
                    for (part, sizes) in sizes.chunks(self.same_rows()).enumerate() {
                        let highest = sizes.iter().enumerate().filter(|(_, x)| x.is_finite());
                        let Some((k, size)) = highest.max_by(|a, b| a.1.total_cmp(b.1)) else { continue };
                        let (row, significance) = (part * self.same_rows() + k, size / louder);
                        if significance > LEAST {
                            peaks.push(Peak { template: *template, window, row, significance });
                        }
                    }
                }
            }
            (peaks, tried)
        };
        let parts: Vec<(Vec<Peak>, f64)> = std::thread::scope(|scope| {
            let each = all.len().div_ceil(threads).max(1);
            let running: Vec<_> = all.chunks(each).map(|own| scope.spawn(|| look(own))).collect();
            let join = |thread: std::thread::ScopedJoinHandle<'_, (Vec<Peak>, f64)>| {
                thread.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))
            };
            running.into_iter().map(join).collect()
        });
        let mut found = Transients { tried: parts.iter().map(|(_, tried)| tried).sum(), ..Transients::default() };
        let peaks: Vec<Peak> = parts.into_iter().flat_map(|(peaks, _)| peaks).collect();
        for (w, window) in self.windows.iter().enumerate() {
            found.add(&Transients { detections: self.loudest(w, window, &peaks), tried: 0.0 });
        }
        let time = |w: &Window, row: usize| w.first_ns + row as i64 * self.step_ns;
        (found, self.windows.iter().map(|w| time(w, w.zone.start)..time(w, w.zone.end)).collect())
    }

    /// The loudest transient of a window if it begins in the zone, as each place could best have made it.
    fn loudest(&self, w: usize, window: &Window, peaks: &[Peak]) -> Vec<Detection> {
        let own = || peaks.iter().filter(|p| p.window == w);
        let Some(best) = own().max_by(|a, b| a.significance.total_cmp(&b.significance)) else { return Vec::new() };
        if !window.zone.contains(&best.row) {
            return Vec::new();
        }
        let near = |p: &&Peak| window.zone.contains(&p.row) && p.row.abs_diff(best.row) < self.same_rows();
        let mut places: Vec<&Peak> = Vec::new();
        for peak in own().filter(near) {
            let place = |p: &Peak| (&self.templates[p.template].effect, &self.templates[p.template].instance);
            match places.iter_mut().find(|other| place(other) == place(peak)) {
                Some(other) if other.significance < peak.significance => *other = peak,
                Some(_) => {}
                None => places.push(peak),
            }
        }
        let detection = |p: &Peak| {
            let at_ns = window.first_ns + p.row as i64 * self.step_ns;
            self.templates[p.template].at(at_ns, p.significance)
        };
        places.into_iter().map(detection).collect()
    }

    /// What a template adds to the innovations.
    fn response(
        &self,
        template: usize,
        responses: &[Vec<Vec<Complex64>>],
        averaging: &[Complex64],
        fft: &Transforms,
    ) -> Response {
        let template = &self.templates[template];
        let n = 2 * self.length;
        let mut kernel = template.kernel.clone();
        kernel.resize(n, 0.0);
        let kernel = fft.spectrum(kernel);
        let averaged: Vec<Complex64> = kernel.iter().zip(averaging).map(|(x, mean)| x * mean).collect();
        let mut energy = vec![0.0; self.length + 1];
        let mut power = vec![0.0; n / 2 + 1];
        let conjugate = (0..self.channels)
            .map(|to| {
                let mut spectrum = vec![Complex64::default(); n / 2 + 1];
                for (from, factor, is_averaged) in &template.channels {
                    let own = if *is_averaged { &averaged } else { &kernel };
                    let driven = responses[*from][to].iter().zip(own);
                    spectrum.iter_mut().zip(driven).for_each(|(x, (r, own))| *x += r * own * *factor);
                }
                let mut samples = fft.samples(spectrum);
                samples.iter_mut().for_each(|x| *x /= n as f64);
                samples[self.length..].fill(0.0);
                energy[1..].iter_mut().zip(&samples).for_each(|(e, x)| *e += x * x);
                let spectrum = fft.spectrum(samples);
                power.iter_mut().zip(&spectrum).for_each(|(p, x)| *p += x.norm_sqr());
                spectrum.into_iter().map(|x| x.conj()).collect()
            })
            .collect();
        let mut sum = 0.0;
        for e in &mut energy {
            sum += *e;
            *e = sum;
        }
        let whole = power.iter().sum::<f64>().max(f64::MIN_POSITIVE);
        let turning: f64 = power.iter().enumerate().map(|(k, p)| p * (k as f64 / n as f64).powi(2)).sum();
        let spread_hz = (turning / whole).sqrt() * 1e9 / self.step_ns as f64;
        Response { conjugate, energy, trials_hz: TAU.sqrt() * LOUD * spread_hz }
    }

    /// Size of the output of a template's filter over its σ at every row of a window; not finite where nothing is left
    /// of the response.
    fn sizes(&self, w: usize, response: &Response, spectra: &[Vec<Complex64>], fft: &Transforms) -> Vec<f64> {
        let rows = self.windows[w].rows.len() / self.channels;
        let mut sum = vec![Complex64::default(); self.length + 1];
        for (h, e) in response.conjugate.iter().zip(spectra) {
            sum.iter_mut().zip(h.iter().zip(e)).for_each(|(sum, (h, e))| *sum += h * e);
        }
        let samples = fft.samples(sum);
        let n = 2.0 * self.length as f64;
        (0..rows).map(|k| (samples[k] / (n * response.energy[rows - k].sqrt())).abs()).collect()
    }

    /// Rows in [`SAME_S`].
    fn same_rows(&self) -> usize {
        (SAME_S * 1e9 / self.step_ns as f64) as usize
    }
}

/// σ of numbers by the median of their sizes.
fn level(sizes: &[f64]) -> Option<f64> {
    let mut known: Vec<f64> = sizes.iter().copied().filter(|x| x.is_finite()).collect();
    let half = known.len() / 2;
    (!known.is_empty()).then(|| *known.select_nth_unstable_by(half, f64::total_cmp).1 / MEDIAN)
}
