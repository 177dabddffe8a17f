//! Detection of transients near the ends of the data and of gaps: matched filters on the innovations.
//!
//! The spectra of [`crate::transient`] taper the ends of the data, so that a transient there is lost or has a wrong
//! time. The innovations need no taper: they are white, and what a transient that begins at `t` adds to them is one
//! response `h`, shifted. With innovations e up to the last one, `n(t) = Σ_s h(s)·e(t + s)` has the variance `D(t) =
//! Σ_s h²(s)`, both over the samples that there are, and `n/√D` is the significance. Constants and starts have been
//! fitted before, and their score is zero: they only lower D, so the significance is never too high on their account.
//!
//! A transient rings through most of a window. The loudest is therefore taken off before the next is looked for, with
//! the size that the least squares of its own template gives it.

use std::f64::consts::TAU;
use std::ops::Range;

use realfft::num_complex::Complex64;

use super::lanes::Kernel;
use crate::transient::{Detection, LEAST, LOUD, MEDIAN, PROFILE_S, Template, Transforms, Transients};

/// Length of a window at an end of a stretch of data, s. The response of a push of a test mass lasts for about half an
/// hour.
const WINDOW_S: f64 = 3000.0;
/// Part of a window, from the end of the data on, in which a transient may begin. In the rest of it the windows inside
/// of the data see more of it.
const ZONE: f64 = 0.75;
/// Windows that are searched at most, as each takes some megabytes: those at the ends of all data and at the first and
/// the last gaps. Beside the other gaps the search by spectra stands.
const MOST_WINDOWS: usize = 16;
/// Transients that are looked for in a window at most.
const MOST_IN_A_WINDOW: usize = 4;
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
        while self.windows.len() > MOST_WINDOWS {
            self.windows.remove(MOST_WINDOWS / 2);
        }
    }

    /// The loudest transients of each window, as every place that could have made them, and where they were looked for.
    pub(super) fn search(&self, threads: usize) -> (Transients, Vec<Range<i64>>) {
        let look = Look::new(self);
        let mut rows: Vec<Vec<f64>> = self.windows.iter().map(|w| w.rows.clone()).collect();
        // Noise may exceed the declared one. A transient in one window leaves the others as they are.
        let mut levels = vec![f64::INFINITY; self.templates.len()];
        let mut taken_off: Vec<Vec<usize>> = vec![Vec::new(); self.windows.len()];
        let mut open: Vec<usize> = (0..self.windows.len()).collect();
        let mut found = Transients::default();
        for round in 0..MOST_IN_A_WINDOW {
            let looked = look.peaks(&open, &rows, &mut levels, threads);
            if round == 0 {
                found.tried = looked.iter().map(|own| own.tried).sum();
            }
            let peaks: Vec<Peak> = looked.into_iter().flat_map(|own| own.peaks).collect();
            open.retain(|w| {
                let known = &mut taken_off[*w];
                // What is nearer may be what the template of a louder one has left of it.
                let is_new = |p: &&Peak| known.iter().all(|row| p.row.abs_diff(*row) > self.rows_in(PROFILE_S));
                let own: Vec<&Peak> = peaks.iter().filter(|p| p.window == *w).filter(is_new).collect();
                let Some(loudest) = own.iter().max_by(|a, b| a.significance.total_cmp(&b.significance)) else {
                    return false;
                };
                let detections = self.places(&self.windows[*w], loudest, &own);
                found.add(&Transients { detections, tried: 0.0 });
                look.take_off(loudest, &mut rows[*w]);
                known.push(loudest.row);
                true
            });
            if open.is_empty() {
                break;
            }
        }
        let time = |w: &Window, row: usize| w.first_ns + row as i64 * self.step_ns;
        (found, self.windows.iter().map(|w| time(w, w.zone.start)..time(w, w.zone.end)).collect())
    }

    /// A transient of a window if it begins in the zone, as each place could best have made it.
    fn places(&self, window: &Window, loudest: &Peak, all: &[&Peak]) -> Vec<Detection> {
        if !window.zone.contains(&loudest.row) {
            return Vec::new();
        }
        let near = |p: &&&Peak| window.zone.contains(&p.row) && p.row.abs_diff(loudest.row) < self.rows_in(SAME_S);
        let mut places: Vec<&Peak> = Vec::new();
        for peak in all.iter().filter(near) {
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

    fn rows_in(&self, seconds: f64) -> usize {
        (seconds * 1e9 / self.step_ns as f64) as usize
    }
}

/// What one template shows in some windows.
struct Looked {
    peaks: Vec<Peak>,
    /// Independent trials.
    tried: f64,
}

/// The search for templates in windows.
struct Look<'a> {
    ends: &'a Ends,
    fft: Transforms,
    /// Spectra of the responses to each channel, by channel of the innovations.
    responses: Vec<Vec<Vec<Complex64>>>,
    /// Spectrum of the mean of two samples.
    averaging: Vec<Complex64>,
}

impl<'a> Look<'a> {
    fn new(ends: &'a Ends) -> Self {
        let n = 2 * ends.length;
        let fft = Transforms::new(n);
        let previous = |k: usize| Complex64::from_polar(1.0, -TAU * k as f64 / n as f64);
        let averaging = (0..=ends.length).map(|k| 0.5 * (1.0 + previous(k))).collect();
        let mut look = Self { ends, fft, responses: Vec::new(), averaging };
        look.responses = ends.responses.iter().map(|rows| look.spectra(rows)).collect();
        look
    }

    /// Spectra of rows, by channel.
    fn spectra(&self, rows: &[f64]) -> Vec<Vec<Complex64>> {
        let channels = self.ends.channels;
        let channel = |c: usize| {
            let mut samples: Vec<f64> = rows.iter().skip(c).step_by(channels).copied().collect();
            samples.resize(2 * self.ends.length, 0.0);
            self.fft.spectrum(samples)
        };
        (0..channels).map(channel).collect()
    }

    /// Peaks of every template in some windows, template after template. `levels` are the lowest levels of the noise
    /// that each template has seen.
    fn peaks(&self, open: &[usize], rows: &[Vec<f64>], levels: &mut [f64], threads: usize) -> Vec<Looked> {
        let windows: Vec<(usize, Vec<Vec<Complex64>>)> = open.iter().map(|w| (*w, self.spectra(&rows[*w]))).collect();
        let of = |(template, lowest): (usize, &mut f64)| self.of_template(template, lowest, &windows);
        let each = levels.len().div_ceil(threads).max(1);
        let (of, chunks) = (&of, levels.chunks_mut(each).enumerate());
        std::thread::scope(|scope| {
            let own = |(k, levels): (usize, &mut [f64])| {
                levels.iter_mut().enumerate().map(|(i, lowest)| of((k * each + i, lowest))).collect::<Vec<Looked>>()
            };
            let running: Vec<_> = chunks.map(|chunk| scope.spawn(move || own(chunk))).collect();
            let join = |thread: std::thread::ScopedJoinHandle<'_, Vec<Looked>>| {
                thread.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))
            };
            running.into_iter().flat_map(join).collect()
        })
    }

    fn of_template(&self, template: usize, lowest: &mut f64, windows: &[(usize, Vec<Vec<Complex64>>)]) -> Looked {
        let response = self.response(template);
        let outputs: Vec<Vec<f64>> = windows.iter().map(|(w, spectra)| self.sizes(*w, &response, spectra)).collect();
        *lowest = outputs.iter().filter_map(|sizes| level(sizes)).fold(*lowest, f64::min);
        let louder = lowest.max(1.0);
        let mut looked = Looked { peaks: Vec::new(), tried: 0.0 };
        let same_rows = self.ends.rows_in(SAME_S);
        for ((window, _), sizes) in windows.iter().zip(&outputs) {
            let zone_s = self.ends.windows[*window].zone.len() as f64 * self.ends.step_ns as f64 * 1e-9;
            looked.tried += response.trials_hz * zone_s;
            // The highest of each part: that of all tells whether the transient is in the zone, the others what other
            // places could have made there.
            for (part, sizes) in sizes.chunks(same_rows).enumerate() {
                let highest = sizes.iter().enumerate().filter(|(_, x)| x.is_finite());
                let Some((k, size)) = highest.max_by(|a, b| a.1.total_cmp(b.1)) else { continue };
                let (row, significance) = (part * same_rows + k, size / louder);
                if significance > LEAST {
                    looked.peaks.push(Peak { template, window: *window, row, significance });
                }
            }
        }
        looked
    }

    /// What a template adds to the innovations.
    fn response(&self, template: usize) -> Response {
        let Self { ends, fft, responses, averaging } = self;
        let template = &ends.templates[template];
        let n = 2 * ends.length;
        let mut kernel = template.kernel.clone();
        kernel.resize(n, 0.0);
        let kernel = fft.spectrum(kernel);
        let averaged: Vec<Complex64> = kernel.iter().zip(averaging).map(|(x, mean)| x * mean).collect();
        let mut energy = vec![0.0; ends.length + 1];
        let mut power = vec![0.0; n / 2 + 1];
        let conjugate = (0..ends.channels)
            .map(|to| {
                let mut spectrum = vec![Complex64::default(); n / 2 + 1];
                for (from, factor, is_averaged) in &template.channels {
                    let own = if *is_averaged { &averaged } else { &kernel };
                    let driven = responses[*from][to].iter().zip(own);
                    spectrum.iter_mut().zip(driven).for_each(|(x, (r, own))| *x += r * own * *factor);
                }
                let mut samples = fft.samples(spectrum);
                samples.iter_mut().for_each(|x| *x /= n as f64);
                samples[ends.length..].fill(0.0);
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
        let spread_hz = (turning / whole).sqrt() * 1e9 / ends.step_ns as f64;
        Response { conjugate, energy, trials_hz: TAU.sqrt() * LOUD * spread_hz }
    }

    /// Size of the output of a template's filter over its σ at every row of a window; not finite where nothing is left
    /// of the response.
    fn sizes(&self, w: usize, response: &Response, spectra: &[Vec<Complex64>]) -> Vec<f64> {
        let rows = self.ends.windows[w].rows.len() / self.ends.channels;
        let mut sum = vec![Complex64::default(); self.ends.length + 1];
        for (h, e) in response.conjugate.iter().zip(spectra) {
            sum.iter_mut().zip(h.iter().zip(e)).for_each(|(sum, (h, e))| *sum += h * e);
        }
        let samples = self.fft.samples(sum);
        let n = 2.0 * self.ends.length as f64;
        (0..rows).map(|k| (samples[k] / (n * response.energy[rows - k].sqrt())).abs()).collect()
    }

    /// Takes a transient off the rows of its window, with the size of least squares.
    fn take_off(&self, peak: &Peak, rows: &mut [f64]) {
        let response = self.response(peak.template);
        let n = 2.0 * self.ends.length as f64;
        let channels = self.ends.channels;
        let added = |conjugate: Vec<Complex64>| self.fft.samples(conjugate.iter().map(Complex64::conj).collect());
        let added: Vec<Vec<f64>> = response.conjugate.into_iter().map(added).collect();
        let after = &mut rows[peak.row * channels..];
        let energy = response.energy[after.len() / channels];
        let sum = |c: usize| after.iter().skip(c).step_by(channels).zip(&added[c]).map(|(e, h)| e * h / n).sum::<f64>();
        let size = (0..channels).map(sum).sum::<f64>() / energy;
        for (c, h) in added.iter().enumerate() {
            after.iter_mut().skip(c).step_by(channels).zip(h).for_each(|(e, h)| *e -= size * h / n);
        }
    }
}

/// σ of numbers by the median of their sizes.
fn level(sizes: &[f64]) -> Option<f64> {
    let mut known: Vec<f64> = sizes.iter().copied().filter(|x| x.is_finite()).collect();
    let half = known.len() / 2;
    (!known.is_empty()).then(|| *known.select_nth_unstable_by(half, f64::total_cmp).1 / MEDIAN)
}
