//! The stage: columns in, report out.

use std::collections::BTreeMap;

use dragfree_sdk::prelude::*;
use nalgebra::DMatrix;
use serde_json::json;

use dragfree_estimation::collected::Collected;
use dragfree_estimation::estimate::{Bound, Estimate as Solution, Method, Observed, Refinement};
use dragfree_estimation::free_levels::{WithLevels, log_determinant, solve};
use dragfree_estimation::levels::Level as NoiseLevel;
use dragfree_estimation::prediction::Prediction;
use dragfree_estimation::segments::{Segmenter, longest_length};
use dragfree_estimation::sigma::{BandNoise, NoiseModel};
use dragfree_estimation::spectra::{Analyser, LONG, Layout, Plan, Regressor, SHORTEST, Spectra};
use dragfree_estimation::state;
use dragfree_estimation::stored::{Declared, Stored};
use dragfree_estimation::verdict::{Difference, Pull, Value, chi2_bounds, chi2_quantile, differences};

/// Normal equations over segments, a constrained solution, and a verdict.
pub struct QpCheck {
    segment_s: f64,
    refinements: usize,
    settings: Settings,
    log: Log,
    linked: Option<Linked>,
}

/// What exists once the columns are known.
struct Linked {
    columns: Vec<In>,
    names: Vec<String>,
    /// Channels that share noise with those of the model, and on which nothing of the model acts.
    left_out: Vec<String>,
    layout: Layout,
    /// Noise as the stages before declare it, and its model of the channels that are weighed.
    declared: Vec<NoiseProcess>,
    model: NoiseModel,
    /// Per channel, whether it is a second difference of a displacement.
    differenced: Vec<bool>,
    coefficients: Vec<Coefficient>,
    bounds: Vec<Bound>,
    constraints: Vec<Constraint>,
    refinements: usize,
    refinement: Refinement,
    settings: Settings,
    analyser: Analyser,
    segmenter: Segmenter,
    collected: Collected,
    /// What a saved state must have been made for.
    signature: String,
    /// Columns of each channel's residuals over time.
    over_time: Vec<OverTime>,
    table: Table,
    /// The solution, once there is no more input.
    solved: Option<Solved>,
}

/// A channel's residuals over time: their mean over an interval, its σ where the model and the noise are right, the
/// mean in σ, and the root of their mean square.
struct OverTime {
    mean: Out,
    sigma: Out,
    whitened: Out,
    rms: Out,
}

/// A solution and what it was made of.
struct Solved {
    /// Everything collected, the open end too.
    collected: Collected,
    epochs_in_segments: u64,
    /// None where there is too little data for any.
    solution: Option<WithLevels>,
}

impl Stage for QpCheck {
    const MANIFEST: Manifest = Manifest {
        id: "qp-check",
        version: env!("CARGO_PKG_VERSION"),
        licence: "MIT OR Apache-2.0",
        description: "Normal equations over segments, a constrained quadratic programme for the coefficients, and a verdict",
        parameters: &[
            Parameter::f64(
                "segment_s",
                "s",
                1638.4,
                10.0..=100_000.0,
                "length of a segment; data with frequent gaps need shorter ones",
            ),
            Parameter::i64(
                "refinements",
                "1",
                3,
                0..=10,
                "how often the noise is measured from the residuals; 0 trusts its declaration",
            ),
        ],
        instances: &[],
        needs: &[],
    };

    fn new(setup: &Setup) -> Result<Self, PluginError> {
        Ok(Self {
            segment_s: setup.f64("segment_s")?,
            refinements: usize::try_from(setup.i64("refinements")?)?,
            settings: setup.settings().clone(),
            log: setup.log(),
            linked: None,
        })
    }

    fn link(&mut self, available: &Available, link: &mut Link<'_>) -> Result<(), PluginError> {
        let linked = Linked::new(self, available, link)?;
        for c in &linked.model.unknown {
            let name = &linked.layout.channels[*c];
            self.log.message(Level::Warn, &format!("{} {name}: {UNKNOWN_NOISE}", Self::MANIFEST.id));
        }
        self.linked = Some(linked);
        Ok(())
    }

    fn process(&mut self, input: &Inputs<'_>, _output: &mut Outputs) -> Result<(), PluginError> {
        let linked = self.linked.as_mut().ok_or_else(before_link)?;
        let columns: Vec<&[f64]> = linked.columns.iter().map(|c| input.f64(*c)).collect();
        linked.segmenter.push(input.time_ns(), &columns, &mut linked.analyser, &mut linked.collected);
        Ok(())
    }

    fn flush(&mut self, output: &mut Outputs) -> Result<(), PluginError> {
        let linked = self.linked.as_mut().ok_or_else(before_link)?;
        let solved = linked.solve()?;
        if let Some(WithLevels { estimate, noise, .. }) = &solved.solution {
            linked.put_residuals(estimate, noise, output)?;
        }
        linked.solved = Some(solved);
        Ok(())
    }

    fn report(&mut self, earlier: &[Report]) -> Result<Report, PluginError> {
        self.linked.as_mut().ok_or_else(before_link)?.report(earlier)
    }

    const STATE_VERSION: u32 = 2;

    fn state(&mut self, state: &mut State<'_>) -> Result<(), PluginError> {
        let linked = self.linked.as_mut().ok_or_else(before_link)?;
        if state.is_loading() {
            linked.collected = linked.nothing_collected();
        }
        let Linked { signature, segmenter, collected, analyser, .. } = linked;
        Ok(state::visit(state, signature, &mut segmenter.state, collected, analyser.plan())?)
    }
}

/// Key of what levels of noise in the model change of `−2 log` of the likelihood beside χ²; absent without such levels.
const LOG_DETERMINANT: &str = "log_determinant_over_declared";

const UNKNOWN_NOISE: &str = "no stage declares its noise, so it is weighed by its residuals alone; the stage that makes it should \
     declare one, from the [noise] tables of the mission file";

/// Table of the residuals over time.
const RESIDUALS: &str = "residuals";

/// What this stage brings.
const SOLUTIONS: [(&str, Role); 2] = [("qp", Role::Batch), ("adopted", Role::Adopted)];

/// A coefficient of the batch solution beside the same of a recursive solution.
struct Compared<'a> {
    /// Name of the recursive solution.
    with: &'a str,
    /// Batch less recursive.
    difference: Difference,
}

/// The recursive solutions of earlier stages, by name.
fn recursive_solutions(earlier: &[Report]) -> BTreeMap<&str, Vec<Value>> {
    let mut all: BTreeMap<&str, Vec<Value>> = BTreeMap::new();
    for e in earlier.iter().flat_map(|r| &r.coefficients).filter(|e| e.role == Some(Role::Recursive)) {
        if let (Some(value), Some(sigma)) = (e.value, e.sigma) {
            all.entry(&e.solution).or_default().push(Value { name: e.name.clone(), value, sigma });
        }
    }
    all
}

impl OverTime {
    fn new(link: &mut Link<'_>, table: Table, channel: &Column) -> Result<Self, PluginError> {
        let name = name_of(channel);
        let mut write = |what: &str, unit: &str| {
            link.write_with(table, &format!("{name}.{what}"), unit, &channel.frame, &[("archive", "end")])
        };
        Ok(Self {
            mean: write("value", &channel.unit)?,
            sigma: write("sigma", &channel.unit)?,
            whitened: write("whitened", "1")?,
            rms: write("rms", &channel.unit)?,
        })
    }
}

fn before_link() -> PluginError {
    PluginError::fatal("qp-check was called before it was linked; the host must link first")
}

impl Linked {
    fn new(stage: &QpCheck, available: &Available, link: &mut Link<'_>) -> Result<Self, PluginError> {
        let all: Vec<&Column> = available.of_kind("channel").collect();
        let Some(rate_hz) = all.first().map(|c| c.rate_hz) else {
            return Err(PluginError::error(
                "qp-check finds no channel to explain: put a stage before it that makes some, such as hinf-dfacs or accelerometer",
            ));
        };
        let responses = available.responses()?;
        let acted_on = |channel: &str| responses.iter().any(|(_, r)| r.channel == channel);
        let (channels, left_out) = modelled(&available.noise, &all, acted_on, rate_hz)?;
        let differenced: Vec<bool> = channels.iter().map(|c| is_differenced(c)).collect::<Result<_, _>>()?;
        let (layout, series) = layout(available, &channels, &responses)?;
        let series = series.iter().map(|(table, name)| Want::new(name).table(table).rate_hz(rate_hz));
        let columns = channels
            .iter()
            .map(|c| Want::of(c).rate_hz(rate_hz))
            .chain(series)
            .map(|want| link.read(&want))
            .collect::<Result<_, _>>()?;
        let model = noise_model(&available.noise, &channels, rate_hz)?;
        // Commands follow the very noise whose spectrum would be measured.
        let refinement = if available.has_regressors_in_loop()? { Refinement::Levels } else { Refinement::Bands };
        let length = longest_length((stage.segment_s * rate_hz).round() as usize);
        let analyser = Analyser::new(Plan::with_slow_bands(length, rate_hz), &layout);
        let table = link.table(RESIDUALS, 0.0);
        let over_time = channels.iter().map(|c| OverTime::new(link, table, c)).collect::<Result<_, _>>()?;
        let seen_as_mean = |s: usize| layout.regressors.iter().any(|r| r.series == s && differenced[r.channel]);
        let averaged = std::iter::repeat_n(false, layout.channels.len())
            .chain((0..layout.series.len()).map(seen_as_mean))
            .collect();
        let names: Vec<String> = channels.iter().map(|c| c.name.clone()).chain(layout.series.iter().cloned()).collect();
        Ok(Self {
            signature: format!(
                "{} in segments of {length} and {} samples at {rate_hz} Hz",
                names.join(", "),
                LONG * length
            ),
            columns,
            names,
            left_out,
            bounds: Bound::all(&available.coefficients, &available.constraints),
            constraints: available.constraints.clone(),
            coefficients: available.coefficients.clone(),
            refinements: stage.refinements,
            refinement,
            settings: stage.settings.clone(),
            collected: nothing_collected(
                refinement,
                &model,
                &differenced,
                &layout,
                &available.coefficients,
                analyser.plan(),
            ),
            differenced,
            declared: available.noise.clone(),
            segmenter: Segmenter::new(length, (1e9 / rate_hz).round() as i64, averaged),
            analyser,
            model,
            layout,
            over_time,
            table,
            solved: None,
        })
    }

    /// The solution of everything so far.
    fn solve(&mut self) -> Result<Solved, PluginError> {
        // The open run ends here for this answer alone: a later run goes on with it.
        let (mut segmenter, mut collected) = (self.segmenter.clone(), self.collected.clone());
        segmenter.end_run(&mut self.analyser, &mut collected);
        let sums = collected.all(self.analyser.plan());
        let epochs_in_segments = segmenter.state.covered;
        if sums.total.segments == 0 {
            return Ok(Solved { collected, epochs_in_segments, solution: None });
        }
        let observed = Observed {
            layout: &self.layout,
            plan: self.analyser.plan(),
            sums: &sums,
            prediction: collected.prediction.as_ref(),
        };
        let method = Method { refinements: self.refinements, refinement: self.refinement, settings: &self.settings };
        let solution = solve(&observed, &self.declared, &self.coefficients, &self.bounds, &method)?;
        Ok(Solved { collected, epochs_in_segments, solution: Some(solution) })
    }

    /// Writes what the solution leaves of the channels, over time.
    fn put_residuals(
        &self,
        solution: &Solution,
        noise: &[NoiseProcess],
        output: &mut Outputs,
    ) -> Result<(), PluginError> {
        let Some(means) = &self.collected.residuals else { return Ok(()) };
        let rate_hz = self.analyser.plan().rate_hz;
        let model = NoiseModel::new(noise, &self.layout.channels, 1.0 / rate_hz)?;
        let noise = means.noise(&model);
        let mut sigmas: BTreeMap<u64, Vec<f64>> = BTreeMap::new();
        for row in means.at(&self.layout, solution.theta.as_slice()) {
            let sigma = sigmas.entry(row.count).or_insert_with(|| noise.sigma(row.count));
            output.time(self.table).push(row.time_ns);
            for (c, to) in self.over_time.iter().enumerate() {
                // Where nobody declares a noise there is none to compare with.
                let sigma = if model.unknown.contains(&c) { f64::NAN } else { sigma[c] };
                output.f64(to.mean).push(row.mean[c]);
                output.f64(to.sigma).push(sigma);
                output.f64(to.whitened).push(row.mean[c] / sigma);
                output.f64(to.rms).push(row.rms[c]);
            }
        }
        Ok(())
    }

    fn report(&mut self, earlier: &[Report]) -> Result<Report, PluginError> {
        let mut report = Report::default();
        for c in &self.model.unknown {
            report.notes.push(format!("{}: {UNKNOWN_NOISE}", self.layout.channels[*c]));
        }
        if !self.left_out.is_empty() {
            report.notes.push(format!(
                "{}: nothing in the model acts on them, so they are left out; as witnesses of the thrusters' noise they would lend \
                 others what the model does not say of them",
                self.left_out.join(", ")
            ));
        }
        let Solved { collected, epochs_in_segments, solution } = match self.solved.take() {
            Some(solved) => solved,
            None => self.solve()?,
        };
        let sums = collected.all(self.analyser.plan());
        // The open end is stored only where there is nothing else of segments as long: a later run stores the segment
        // that it becomes.
        let declared = Declared {
            noise: self.declared.clone(),
            coefficients: self.coefficients.clone(),
            constraints: self.constraints.clone(),
            refinements: self.refinements,
        };
        let stored = Stored::new(&self.layout, self.analyser.plan(), declared, &self.own(&collected));
        report.counts.insert("epochs_in_segments".to_owned(), epochs_in_segments);
        let Some(WithLevels { estimate: solution, levels, noise: now }) = solution else {
            self.no_solution(&mut report);
            return Ok(report);
        };
        if self.coefficients.iter().any(|c| !c.noise.is_empty()) {
            let ratio = self.log_determinant_ratio(&now, &sums.total)?;
            report.quality.extend(ratio.map(|ratio| (LOG_DETERMINANT.to_owned(), json!(ratio))));
        }
        // What χ² with the declared Σ is a sum over: the same for every model of the same data, which `dof` is not.
        let observations = sums.total.counted().sum::<f64>() * self.layout.channels.len() as f64;
        report.quality.insert("observations".to_owned(), json!(observations));
        self.describe(&solution, &levels, earlier, &mut report);
        self.attach(&solution, &stored, &mut report);
        Ok(report)
    }

    /// What this run adds to the sums. `with_open_end` has its open end too.
    fn own(&self, with_open_end: &Collected) -> Spectra {
        let (whole, with_open_end) = (&self.collected.sums.total, &with_open_end.sums.total);
        if whole.segments == 0 {
            return with_open_end.clone();
        }
        let mut own = whole.clone();
        let slow_bands = self.analyser.plan().slow_bands;
        if whole.weight[..slow_bands].iter().all(|w| *w == 0.0) {
            own.replace_first(slow_bands, with_open_end);
        }
        own
    }

    fn nothing_collected(&self) -> Collected {
        let plan = self.analyser.plan();
        nothing_collected(self.refinement, &self.model, &self.differenced, &self.layout, &self.coefficients, plan)
    }

    /// Too short for any spectrum: a sentence, not a number.
    fn no_solution(&self, report: &mut Report) {
        let state = &self.segmenter.state;
        let mut sentence = format!(
            "every channel and regressor has a value in {} of {} epochs, and nowhere in {} of them in a row: too few for a spectrum",
            state.valid, state.rows, SHORTEST
        );
        if let Some((j, missing)) = state.missing.iter().enumerate().max_by_key(|(j, n)| (**n, std::cmp::Reverse(*j)))
            && *missing > 0
        {
            sentence += &format!(
                "; {} is missing in {missing} epochs: where an instrument is silent all day, take what reads it out of the model",
                self.names[j]
            );
        }
        report.notes.push(sentence);
        report.verdict = Some("weak".into());
        for c in self.coefficients.iter().filter(|c| c.estimate) {
            report.weak_directions.push(format!("{} is not seen: there is no segment of data", c.name));
            for solution in SOLUTIONS {
                report.coefficients.push(estimate_of(c, solution, None, None));
            }
        }
    }

    /// `Σ 2n log (det Σ/det Σ_declared)`: what the levels of the model change of `−2 log` of the likelihood beside χ².
    fn log_determinant_ratio(&self, now: &[NoiseProcess], total: &Spectra) -> Result<Option<f64>, PluginError> {
        let mut declared = self.declared.clone();
        NoiseLevels::of(&self.coefficients).inverse().apply(&mut declared).map_err(PluginError::error)?;
        let plan = self.analyser.plan();
        let of = |noise: &[NoiseProcess]| -> Result<Option<f64>, PluginError> {
            let model = NoiseModel::new(noise, &self.layout.channels, 1.0 / plan.rate_hz)?;
            Ok(log_determinant(&BandNoise::new(&model, plan), total))
        };
        Ok(of(now)?.zip(of(&declared)?).map(|(now, declared)| now - declared))
    }

    fn describe(&self, solution: &Solution, levels: &[NoiseLevel], earlier: &[Report], report: &mut Report) {
        let quality = &solution.quality;
        let sigma = |k: usize| solution.covariance.as_ref().map(|c| c[(k, k)].sqrt());
        let qp: Vec<Value> = solution
            .free
            .iter()
            .enumerate()
            .filter_map(|(k, i)| {
                Some(Value { name: self.coefficients[*i].name.clone(), value: solution.theta[*i], sigma: sigma(k)? })
            })
            .collect();
        let compared: Vec<Compared> = recursive_solutions(earlier)
            .into_iter()
            .flat_map(|(with, other)| {
                differences(&qp, &other).into_iter().map(move |d| Compared { with, difference: d })
            })
            .collect();
        let checked = checks(solution, &qp);
        let disagreeing: Vec<&Compared> =
            compared.iter().filter(|c| c.difference.sigmas() > self.settings.agreement_sigmas).collect();
        let mut insane = self.insane(solution);
        insane.extend(contradictions(&self.settings, solution));
        for d in checked.iter().filter(|d| d.sigmas() > self.settings.agreement_sigmas) {
            insane.push(format!(
                "{}: the fit by spectra and the prediction-error fit of the same data differ by {:.3e}, {:.1}σ: noise that is not \
                 stationary, or a band that the model does not describe",
                d.name,
                d.difference,
                d.sigmas()
            ));
        }

        // With Σ from the residuals the ratio is 1 by construction; only the declared Σ can be contradicted.
        report.chi2_per_dof = Some(quality.chi2_per_dof_modelled_sigma);
        report.weak_directions = solution.weak.iter().map(|d| d.sentence.clone()).collect();
        // What is wrong must not hide behind what is not known.
        let consistent = disagreeing.is_empty() && insane.is_empty();
        let verdict = match (consistent, solution.weak.is_empty()) {
            (false, _) => "disagree",
            (true, false) => "weak",
            (true, true) => "agree",
        };
        report.verdict = Some(verdict.into());
        report.inconsistent = !consistent;
        report.notes.extend(insane);
        if compared.is_empty() {
            report.notes.push("no recursive solution to compare with: the verdict rests on the QP alone".into());
        }
        for Compared { with, difference: d } in &disagreeing {
            report.notes.push(format!(
                "{}: qp − {with} = {:.3e}, {:.1}σ; likely causes: an effect missing from the model (torque gain and inertia act \
                 through α̂), noise levels of the filter that are not those of the data, or a stretch that one of the two did not use",
                d.name,
                d.difference,
                d.sigmas()
            ));
        }
        let (frequency_hz, ratio) = quality.worst_band;
        let (_, high) = chi2_bounds(&self.settings, quality.worst_band_dof);
        if ratio > high.max(self.settings.line_ratio) {
            report.notes.push(format!(
                "residuals near {frequency_hz:.3e} Hz have {ratio:.1} times the power of their neighbourhood: a line that nobody models?"
            ));
        }
        for p in solution.pulls.iter().filter(|p| p.sigmas() > self.settings.agreement_sigmas) {
            report.notes.push(pull_sentence(p));
        }
        self.put_coefficients(solution, levels, &disagreeing, report);
        self.put_quality(solution, &compared, &checked, report);
    }

    /// Sentences about χ²/dof outside its bounds although Σ was fitted.
    fn insane(&self, solution: &Solution) -> Vec<String> {
        let quality = &solution.quality;
        let whole = ("all channels", quality.chi2_per_dof, quality.dof);
        let single = quality.channels.iter().map(|c| (c.channel.as_str(), c.chi2_per_dof, c.dof));
        std::iter::once(whole)
            .chain(single)
            .filter_map(|(name, ratio, dof)| {
                let (low, high) = chi2_bounds(&self.settings, dof);
                (!(low..=high).contains(&ratio)).then(|| {
                    format!(
                        "χ²/dof of {name} is {ratio:.4}, outside [{low:.4}, {high:.4}] even with Σ from the residuals"
                    )
                })
            })
            .collect()
    }

    /// Values of the QP and what is adopted: the QP's values, because it alone has the survey, the whole band and a
    /// measured Σ; where it disagrees with recursive solutions, its σ grows to span the farthest.
    fn put_coefficients(
        &self,
        solution: &Solution,
        levels: &[NoiseLevel],
        disagreeing: &[&Compared],
        report: &mut Report,
    ) {
        let names: Vec<String> = solution.free.iter().map(|i| self.coefficients[*i].name.clone()).collect();
        let adopted = solution.covariance.as_ref().map(|c| {
            let widen: Vec<f64> = names
                .iter()
                .enumerate()
                .map(|(k, name)| {
                    let of_it = disagreeing.iter().map(|c| &c.difference).filter(|d| d.name == *name);
                    let apart = of_it.map(|d| d.difference.abs()).fold(0.0, f64::max);
                    (1.0 + apart * apart / c[(k, k)]).sqrt()
                })
                .collect();
            DMatrix::from_fn(c.nrows(), c.ncols(), |i, j| c[(i, j)] * widen[i] * widen[j])
        });
        for ((label, role), covariance) in SOLUTIONS.into_iter().zip([&solution.covariance, &adopted]) {
            for (i, c) in self.coefficients.iter().enumerate().filter(|(_, c)| c.estimate) {
                let free = solution.free.iter().position(|f| *f == i);
                let sigma = free.zip(covariance.as_ref()).map(|(k, c)| c[(k, k)].sqrt());
                let value = free.map(|_| solution.theta[i]);
                // Of several levels of one component the data see the product alone, and the first one moves.
                let first = self.coefficients.iter().find(|other| other.estimate && other.noise == c.noise);
                let moves = first.is_some_and(|first| first.name == c.name);
                let level = levels.iter().find(|level| moves && level.process == c.noise);
                let (value, sigma) = level.map_or((value, sigma), |level| (Some(level.value), Some(level.sigma)));
                report.coefficients.push(estimate_of(c, (label, role), value, sigma));
            }
            if let Some(c) = covariance {
                let matrix = c.row_iter().map(|r| r.iter().copied().collect()).collect();
                report.covariance.insert(label.to_owned(), Covariance { names: names.clone(), matrix });
            }
        }
    }

    fn put_quality(&self, solution: &Solution, compared: &[Compared], checked: &[Difference], report: &mut Report) {
        let quality = &solution.quality;
        let active: Vec<_> = solution
            .active
            .iter()
            .map(|a| json!({ "constraint": a.name, "side": a.side, "multiplier": a.multiplier }))
            .collect();
        let differences: Vec<_> = compared
            .iter()
            .map(|Compared { with, difference: d }| {
                json!({ "name": d.name, "recursive": with, "batch_minus_recursive": d.difference, "sigmas": d.sigmas() })
            })
            .collect();
        let predicted: Vec<_> = checked
            .iter()
            .zip(solution.prediction.iter().flat_map(|p| p.value.iter().zip(&p.sigma)))
            .map(|(d, (value, sigma))| json!({ "name": d.name, "value": value, "sigma": sigma, "sigmas_from_qp": d.sigmas() }))
            .collect();
        let entries = [
            ("active_constraints", json!(active)),
            ("kkt", json!(solution.kkt)),
            ("differences", json!(differences)),
            ("dof", json!(quality.dof)),
            ("chi2_per_dof_refined_sigma", json!(quality.chi2_per_dof)),
            ("last_step_sigma", json!(quality.last_step_sigma)),
            ("scatter_of_blocks", json!(solution.scatter)),
            ("widened", json!(widened(solution, &self.coefficients))),
            ("prediction_error", json!(predicted)),
            ("constraints", json!(solution.pulls)),
            ("survey_chi2", json!(solution.survey_chi2)),
            ("coherence_between_groups", json!(quality.between_groups)),
            ("channels", json!(quality.channels)),
        ];
        report.quality.extend(entries.into_iter().map(|(k, v)| (k.to_owned(), v)));
        let state = &self.segmenter.state;
        report.counts.extend([
            ("segments".to_owned(), solution.normal.segments),
            ("epochs".to_owned(), state.rows),
            ("epochs_without_every_value".to_owned(), state.rows - state.valid),
        ]);
    }

    /// The normal equations, and the sums that they are made of: what this run adds, and not what an earlier one has
    /// stored already.
    fn attach(&self, solution: &Solution, stored: &Stored, report: &mut Report) {
        let mut equations = json!(solution.normal);
        equations["channels"] = json!(self.layout.channels);
        equations["theta"] = json!(solution.theta.as_slice());
        equations["sums"] = json!(stored);
        report.attachments.push(Attachment { suffix: "neq.json".into(), text: equations.to_string() });
    }
}

/// The fit in the time domain takes products of coefficients at their initial values. It takes channels one by one, and
/// a prediction of a channel from its own past misses what a command knows of the others: where the model has
/// regressors made of commands there is none, and a filter of all test masses together is the check in the time
/// domain.
fn nothing_collected(
    refinement: Refinement,
    model: &NoiseModel,
    differenced: &[bool],
    layout: &Layout,
    coefficients: &[Coefficient],
    plan: &Plan,
) -> Collected {
    let initial: Vec<f64> = coefficients.iter().map(|c| c.initial).collect();
    let prediction = match refinement {
        Refinement::Bands => Prediction::new(model, differenced, &layout.linear_at(&initial), plan),
        Refinement::Levels => None,
    };
    Collected::new(plan, layout, prediction).with_residuals(plan, layout)
}

/// The fit in the time domain beside the QP, coefficient by coefficient.
fn checks(solution: &Solution, qp: &[Value]) -> Vec<Difference> {
    let Some(check) = &solution.prediction else { return Vec::new() };
    let other: Vec<Value> = qp
        .iter()
        .zip(check.value.iter().zip(&check.sigma))
        .map(|(q, (value, sigma))| Value { name: q.name.clone(), value: *value, sigma: *sigma })
        .collect();
    differences(qp, &other)
}

/// Sentences about a survey, a range or independent noises that the data contradict.
fn contradictions(settings: &Settings, solution: &Solution) -> Vec<String> {
    let mut out = Vec::new();
    let (chi2, dof) = solution.survey_chi2;
    if dof > 0.0 && chi2_quantile(chi2 / dof, dof) > settings.survey_sigmas {
        out.push(format!(
            "the survey contradicts the data: χ² {chi2:.1} on {dof} rows. Either the survey in the mission file is wrong, or the \
             data are read through a wrong model (angular acceleration, gains, frames); see the rows"
        ));
    }
    for p in solution.pulls.iter().filter(|p| !p.survey && p.sigmas() > settings.range_sigmas) {
        out.push(format!(
            "{} contradicts the data by {:.1}σ: an effect is missing from the model, or the range is wrong",
            p.constraint,
            p.sigmas()
        ));
    }
    let (ratio, dof) = solution.quality.between_groups;
    if dof > 0.0
        && ratio > settings.group_coherence_ratio
        && chi2_quantile(ratio, dof) > settings.group_coherence_sigmas
    {
        out.push(format!(
            "residuals of the attitude and of the test masses are coherent (χ²/dof {ratio:.3} on {dof}): noise that pushes and \
             turns at once, such as thrusters one by one, or an angular acceleration that is not E[α | data], as where the torque \
             noise changes; the offset takes such noise for its own. State the layout in \
             [[thrusters.unit]], calibrate the hours apart (--from, --until), or look at the reconstruction"
        ));
    }
    out
}

/// A row of the survey or a range, and by how much the data are off it.
fn pull_sentence(p: &Pull) -> String {
    let what = if p.survey { "from the survey" } else { "beyond the range" };
    format!(
        "{}: the data alone put it {:.3e} ± {:.1e} {} {what}, {:.1}σ; multiplier {:.3e} per {}",
        p.constraint,
        p.distance,
        p.sigma,
        p.unit,
        p.sigmas(),
        p.multiplier,
        p.unit
    )
}

/// The channels to weigh, and the names of those left out: where noise is shared, a channel on which no regressor acts
/// is a witness whose own model is empty.
fn modelled<'a>(
    noise: &[NoiseProcess],
    channels: &[&'a Column],
    acted_on: impl Fn(&str) -> bool,
    rate_hz: f64,
) -> Result<(Vec<&'a Column>, Vec<String>), PluginError> {
    let group = noise_model(noise, channels, rate_hz)?.groups();
    let with_effects: Vec<usize> =
        channels.iter().zip(&group).filter(|(c, _)| acted_on(name_of(c))).map(|(_, g)| *g).collect();
    let (kept, left): (Vec<_>, Vec<_>) =
        channels.iter().copied().zip(&group).partition(|(c, g)| acted_on(name_of(c)) || !with_effects.contains(g));
    Ok((kept.into_iter().map(|(c, _)| c).collect(), left.into_iter().map(|(c, _)| name_of(c).to_owned()).collect()))
}

/// What the columns of the sums are, and the series among them by table and name.
fn layout(
    available: &Available,
    channels: &[&Column],
    responses: &[(&Coefficient, Response)],
) -> Result<(Layout, Vec<(String, String)>), PluginError> {
    let nobody = |c: &Coefficient, what: &str, name: &str| {
        PluginError::error(format!(
            "coefficient {} acts on or through the {what} `{name}`, which nobody declares; the stage or effect that makes it must \
             stand before",
            c.name
        ))
    };
    let coefficient = |name: &str| available.coefficients.iter().position(|c| c.name == name);
    let mut series: Vec<(String, String)> = Vec::new();
    let mut regressors = Vec::new();
    for (c, r) in responses {
        let channel = channels.iter().position(|channel| name_of(channel) == r.channel);
        let times = match &r.times {
            Some(other) => Some(coefficient(other).ok_or_else(|| nobody(c, "coefficient", other))?),
            None => None,
        };
        let in_loop = available.is_in_loop(r);
        let key = (r.table.clone(), r.series.clone());
        regressors.push(Regressor {
            coefficient: coefficient(&c.name).ok_or_else(|| nobody(c, "coefficient", &c.name))?,
            channel: channel.ok_or_else(|| nobody(c, "channel", &r.channel))?,
            series: series.iter().position(|s| *s == key).unwrap_or_else(|| {
                series.push(key);
                series.len() - 1
            }),
            factor: r.factor,
            times,
            in_loop,
        });
    }
    let layout = Layout {
        channels: channels.iter().map(|c| name_of(c).to_owned()).collect(),
        series: series.iter().map(|(_, name)| name.clone()).collect(),
        regressors,
        coefficients: available.coefficients.iter().map(|c| c.name.clone()).collect(),
    };
    Ok((layout, series))
}

fn noise_model(declared: &[NoiseProcess], channels: &[&Column], rate_hz: f64) -> Result<NoiseModel, PluginError> {
    let names: Vec<&str> = channels.iter().map(|c| name_of(c)).collect();
    Ok(NoiseModel::new(declared, &names, 1.0 / rate_hz)?)
}

fn name_of(channel: &Column) -> &str {
    match channel.attribute("channel") {
        "" => &channel.name,
        name => name,
    }
}

fn is_differenced(channel: &Column) -> Result<bool, PluginError> {
    match channel.attribute("average") {
        "2" => Ok(true),
        "1" => Ok(false),
        other => Err(PluginError::error(format!(
            "channel {} has the attribute average = `{other}`; the stage that makes it must say 2 (second differences) or 1 (measured \
             directly)",
            channel.name
        ))),
    }
}

/// By how much each σ was widened.
fn widened<'a>(solution: &Solution, coefficients: &'a [Coefficient]) -> BTreeMap<&'a str, f64> {
    let of = |(i, widened): (&usize, &f64)| (coefficients[*i].name.as_str(), *widened);
    solution.free.iter().zip(&solution.widened).map(of).collect()
}

fn estimate_of(c: &Coefficient, (solution, role): (&str, Role), value: Option<f64>, sigma: Option<f64>) -> Estimate {
    Estimate {
        name: c.name.clone(),
        solution: solution.to_owned(),
        role: Some(role),
        value,
        sigma,
        unit: c.unit.clone(),
        frame: c.frame.clone(),
    }
}
