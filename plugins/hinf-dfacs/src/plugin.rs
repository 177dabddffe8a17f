//! The stage: input columns, output rows, report.

use dragfree_physics::mission::{ANGLES, AXES, INERTIAL_SENSOR, INTERFEROMETER, Mission};
use dragfree_sdk::prelude::*;
use nalgebra::Vector3;
use serde_json::json;

use crate::noise;
use crate::noise_calibration::{self, NoiseScale};
use crate::on_demand::{self, Needs};
use crate::reconstruction::{AngularAcceleration, Epoch, Reconstruction, Row, Settings, levels_of, row_length};
use crate::replay::{CommandNumbers, Comparison, command_vectors};

/// Relative deviation of the innovations' variance from the prediction above which the report has a note.
const INNOVATION_TOLERANCE: f64 = 0.1;
/// Score of replayed commands, in standard deviations, above which the report has a note.
const INCONSISTENT_SIGMA: f64 = 5.0;
/// The stage.
pub struct HinfDfacs {
    mission: Mission,
    angular_acceleration: AngularAcceleration,
    compare_commands: bool,
    measure_noise: bool,
    warm_up_s: f64,
    needs: Needs,
    linked: Option<Linked>,
    notes: Vec<String>,
}

struct Linked {
    reconstruction: Reconstruction,
    settings: Settings,
    all_readouts: bool,
    /// Epochs held back until the noise levels are measured; `None` after that.
    held_back: Option<Vec<Epoch>>,
    /// Whether the levels by which the smoother weighs follow the data.
    follows: bool,
    /// Attitude channels of the interval that is not complete.
    recent: Vec<[f64; 3]>,
    /// When the levels changed, Unix ns, and to what.
    changes: Vec<(i64, NoiseScale)>,
    rate_hz: f64,
    input: Columns<In>,
    table: Table,
    out: Vec<Out>,
    /// Number of columns in `out` that are written without a request.
    fixed: usize,
    /// Rows to be written; empty between calls.
    rows: Vec<Row>,
}

/// Names of the noise tables of a test mass's displacements along x, y, z.
type Noises = [&'static str; 3];

/// Requests three columns of the grid, if the first is available.
fn read_vector(
    available: &Available,
    link: &mut Link<'_>,
    name: &str,
    unit: &str,
    frame: &str,
) -> Result<Option<[In; 3]>, PluginError> {
    if available.column("grid", &format!("{name}.x")).is_none() {
        return Ok(None);
    }
    let mut read = |axis: &str| link.read(&grid(&format!("{name}.{axis}"), unit, frame));
    Ok(Some([read("x")?, read("y")?, read("z")?]))
}

fn grid(name: &str, unit: &str, frame: &str) -> Want {
    Want::new(name).table("grid").unit(unit).frame(frame)
}

impl HinfDfacs {
    /// The most precise available readout of each degree of freedom, and the noise tables of the displacements:
    /// interferometer and local wavefront sensing before the inertial sensor. The angles of the test masses may be
    /// missing, as only the stiffness and the replay need them.
    fn link_readouts(
        &mut self,
        available: &Available,
        link: &mut Link<'_>,
    ) -> Result<(Vec<Option<In>>, Vec<Noises>), PluginError> {
        let (mut readout, mut noises) = (Vec::new(), Vec::new());
        for angle in ANGLES {
            let want = grid(&format!("dws.sc_crf_rad.{angle}"), "rad", "CRF");
            readout.push(if self.angular_acceleration == AngularAcceleration::Commanded {
                link.read_if_available(available, &want)?
            } else {
                Some(link.read(&want)?)
            });
        }
        for (name, tm) in &self.mission.test_mass {
            let frame = self.mission.frame(name);
            let mut noise = INERTIAL_SENSOR;
            for (axis, letter) in AXES.into_iter().enumerate() {
                // A column is there also where telemetry has a field for an instrument that the mission has not.
                let want = grid(&format!("ifo.{name}.{letter}_orf_m"), "m", &frame);
                let has_one = tm.has_interferometer(axis);
                let optical = if has_one { link.read_if_available(available, &want)? } else { None };
                if optical.is_some() {
                    noise[axis] = INTERFEROMETER[axis];
                } else if has_one {
                    self.notes.push(format!("no interferometer for {name}.{letter}: the inertial sensor is used"));
                }
                readout.push(match optical {
                    None => Some(link.read(&grid(&format!("is.{name}.r_orf_m.{letter}"), "m", &frame))?),
                    some => some,
                });
            }
            noises.push(noise);
            for angle in ANGLES {
                let dws = grid(&format!("dws.{name}.{angle}_orf_rad"), "rad", &frame);
                let is = grid(&format!("is.{name}.att_orf_rad.{angle}"), "rad", &frame);
                let wavefront = if tm.has_interferometer(0) { link.read_if_available(available, &dws)? } else { None };
                readout.push(match wavefront {
                    None => link.read_if_available(available, &is)?,
                    some => some,
                });
            }
        }
        Ok((readout, noises))
    }

    fn link_commands(&self, available: &Available, link: &mut Link<'_>) -> Result<Option<Vec<In>>, PluginError> {
        if !available.columns.iter().any(|c| c.table == "grid" && c.name.starts_with("command.")) {
            return Ok(None);
        }
        let mut columns = Vec::new();
        for (vector, unit, frame) in command_vectors(&self.mission) {
            for axis in AXES {
                columns.push(link.read(&grid(&format!("command.{vector}.{axis}"), unit, &frame))?);
            }
        }
        Ok(Some(columns))
    }

    /// Restarts the reconstruction with other noise levels.
    fn rebuild(&mut self, scale: NoiseScale) -> Result<(), PluginError> {
        let linked = self.linked.as_ref().ok_or_else(not_linked)?;
        let (settings, all_readouts) = (Settings { scale, ..linked.settings }, linked.all_readouts);
        // `link` has made the notes on the control law already.
        let notes = self.notes.clone();
        let reconstruction = self.reconstruction(&settings, all_readouts)?;
        self.notes = notes;
        let linked = self.linked.as_mut().ok_or_else(not_linked)?;
        (linked.settings, linked.reconstruction) = (settings, reconstruction);
        Ok(())
    }

    /// Measures the noise levels in the epochs held back, and then processes these.
    fn calibrate_noise(&mut self) -> Result<(), PluginError> {
        let linked = self.linked.as_mut().ok_or_else(not_linked)?;
        let Some(epochs) = linked.held_back.take() else { return Ok(()) };
        let mut rows = Vec::new();
        for epoch in &epochs {
            linked.reconstruction.push(epoch, &mut rows)?;
        }
        linked.reconstruction.finish(&mut rows);
        let levels = levels_of(&self.mission);
        let channels: Vec<_> = rows.iter().map(Row::attitude_channels).collect();
        let measured = |(held, sensing)| noise_calibration::measure(&channels, linked.rate_hz, &held, sensing);
        let scale = levels.map_or_else(NoiseScale::nominal, measured);
        self.rebuild(scale)?;
        let linked = self.linked.as_mut().ok_or_else(not_linked)?;
        epochs.iter().try_for_each(|epoch| linked.push(&self.mission, epoch))
    }

    /// Builds the reconstruction, with a replay of the control law if possible.
    fn reconstruction(&mut self, settings: &Settings, all_readouts: bool) -> Result<Reconstruction, PluginError> {
        let without = Settings { replay: false, ..*settings };
        if !settings.commands {
            if !all_readouts {
                return Err(PluginError::error(
                    "hinf-dfacs: there is no topic /command, and the control law cannot be replayed instead because \
                     readouts of /is or /dws are missing; give telemetry with /command, or with all readouts",
                ));
            }
            return Ok(Reconstruction::new(&self.mission, &Settings { replay: true, ..*settings })?);
        }
        if !(self.compare_commands && all_readouts) {
            return Ok(Reconstruction::new(&self.mission, &without)?);
        }
        match Reconstruction::new(&self.mission, &Settings { replay: true, ..*settings }) {
            Ok(reconstruction) => Ok(reconstruction),
            Err(reason) => {
                let reconstruction = Reconstruction::new(&self.mission, &without)?;
                self.notes.push(format!("telemetered commands were not compared with the control law: {reason}"));
                Ok(reconstruction)
            }
        }
    }
}

/// The channels of the attitude, as [`AHEAD_ATTRIBUTE`] names them.
const ATTITUDE_CHANNELS: &str = r#"["sc.alpha.x","sc.alpha.y","sc.alpha.z"]"#;

fn write_columns(
    link: &mut Link<'_>,
    table: Table,
    mission: &Mission,
    noises: &[Noises],
    prediction: bool,
) -> Result<Vec<Out>, PluginError> {
    let declare = if prediction { noise::declared_for_prediction } else { noise::declared };
    let declared = declare(mission, noises);
    // What the command lacks is all of the unknown acceleration in the channel of the same axis.
    let unpredicted = |channel: String| json!({ channel: 1.0 }).to_string();
    let mut out = Vec::with_capacity(row_length(noises.len()));
    for axis in AXES {
        let unpredicted = unpredicted(format!("sc.alpha.{axis}"));
        let attributes = [("archive", "mean"), (UNPREDICTED_ATTRIBUTE, unpredicted.as_str())];
        let attributes = if prediction { &attributes[..] } else { &attributes[..1] };
        out.push(link.write_with(table, &format!("sc.alpha_srf_rad_s2.{axis}"), "rad s-2", "SRF", attributes)?);
    }
    for axis in AXES {
        out.push(link.write(table, &format!("sc.omega_srf_rad_s.{axis}"), "rad s-1", "SRF")?);
    }
    for (name, noises) in mission.test_mass.keys().zip(noises) {
        let frame = mission.frame(name);
        for (axis, noise) in AXES.iter().zip(noises) {
            out.push(link.write_with(table, &format!("{name}.r_orf_m.{axis}"), "m", &frame, &[("noise", *noise)])?);
        }
        for axis in AXES {
            let column = format!("{name}.u_orf_m_s2.{axis}");
            let unpredicted = unpredicted(format!("{name}.accel.{axis}"));
            let attributes = [("in_loop", "true"), (UNPREDICTED_ATTRIBUTE, unpredicted.as_str())];
            let attributes = if prediction { &attributes[..] } else { &attributes[..1] };
            out.push(link.write_with(table, &column, "m s-2", &frame, attributes)?);
        }
    }
    let mut channel = |name: &str, unit: &str, frame: &str, noise: &str, declared: &[NoiseProcess]| {
        let attributes = [("kind", "channel"), ("channel", name), ("average", "2"), ("noise", noise)];
        link.write_noisy(table, name, unit, frame, &attributes, declared)
    };
    for (name, noises) in mission.test_mass.keys().zip(noises) {
        for (axis, noise) in AXES.iter().zip(noises) {
            out.push(channel(&format!("{name}.accel.{axis}"), "m s-2", &mission.frame(name), noise, &[])?);
        }
    }
    // The noise of all channels is declared with the last of them.
    for axis in AXES {
        let declared = if axis == "z" { declared.as_slice() } else { &[] };
        out.push(channel(&format!("sc.alpha.{axis}"), "rad s-2", "SRF", "dws_long_arm", declared)?);
    }
    Ok(out)
}

impl Linked {
    /// Reconstructs an epoch, and measures the levels of noise at the end of every interval.
    fn push(&mut self, mission: &Mission, epoch: &Epoch) -> Result<(), PluginError> {
        let before = self.rows.len();
        self.reconstruction.push(epoch, &mut self.rows)?;
        if !self.follows {
            return Ok(());
        }
        self.recent.extend(self.rows[before..].iter().map(Row::attitude_channels));
        let length = noise_calibration::length(self.rate_hz);
        while self.recent.len() >= length {
            let interval: Vec<_> = self.recent.drain(..length).collect();
            self.follow(mission, &interval, epoch.time_ns)?;
        }
        Ok(())
    }

    /// Levels by which the smoother weighs now.
    fn levels(&self) -> NoiseScale {
        self.changes.last().map_or(self.settings.scale, |(_, scale)| *scale)
    }

    fn follow(&mut self, mission: &Mission, interval: &[[f64; 3]], time_ns: i64) -> Result<(), PluginError> {
        let Some((held, sensing)) = levels_of(mission) else { return Ok(()) };
        let now = self.levels();
        let (held, sensing) = (held.component_mul(&now.torque), sensing * now.sensing);
        let change = noise_calibration::measure(interval, self.rate_hz, &held, sensing);
        if change == NoiseScale::nominal() {
            return Ok(());
        }
        let torque = now.torque.component_mul(&change.torque);
        let scale = NoiseScale { torque, sensing: now.sensing * change.sensing };
        self.changes.push((time_ns, scale));
        Ok(self.reconstruction.set_levels(mission, &Settings { scale, ..self.settings })?)
    }

    fn write_rows(&mut self, output: &mut Outputs) {
        output.time(self.table).extend(self.rows.iter().map(|row| row.time_ns));
        let (fixed, on_demand) = self.out.split_at(self.fixed);
        for (i, column) in fixed.iter().enumerate() {
            output.f64(*column).extend(self.rows.iter().map(|row| row.values[i]));
        }
        for (i, column) in on_demand.iter().enumerate() {
            output.f64(*column).extend(self.rows.iter().map(|row| row.on_demand[i]));
        }
        self.rows.clear();
    }
}

/// Input columns: handles, or the values of a batch.
struct Columns<T> {
    readout: Vec<Option<T>>,
    command: Option<Vec<T>>,
    sun: Option<[T; 3]>,
    ephemeris_age: Option<T>,
    omega_crf: Option<[T; 3]>,
    alpha_crf: Option<[T; 3]>,
}

impl Columns<In> {
    fn values<'a>(&self, input: &'a Inputs<'_>) -> Columns<&'a [f64]> {
        let values = |column: In| input.f64(column);
        Columns {
            readout: self.readout.iter().map(|c| c.map(values)).collect(),
            command: self.command.as_ref().map(|c| c.iter().copied().map(values).collect()),
            sun: self.sun.map(|c| c.map(values)),
            ephemeris_age: self.ephemeris_age.map(values),
            omega_crf: self.omega_crf.map(|c| c.map(values)),
            alpha_crf: self.alpha_crf.map(|c| c.map(values)),
        }
    }
}

impl Columns<&[f64]> {
    fn epoch(&self, time_ns: i64, k: usize) -> Epoch {
        let vector = |columns: &Option<[&[f64]; 3]>| match columns {
            Some([x, y, z]) => Vector3::new(x[k], y[k], z[k]),
            None => Vector3::from_element(f64::NAN),
        };
        Epoch {
            time_ns,
            readout: self.readout.iter().map(|column| column.map_or(f64::NAN, |column| column[k])).collect(),
            command: match &self.command {
                Some(columns) => columns.iter().map(|column| column[k]).collect(),
                None => CommandNumbers::from_fn(self.readout.len() + 3, |_| f64::NAN),
            },
            sun_srf: vector(&self.sun),
            ephemeris_age_s: self.ephemeris_age.map_or(f64::NAN, |column| column[k]),
            omega_crf_rad_s: vector(&self.omega_crf),
            alpha_crf_rad_s2: vector(&self.alpha_crf),
        }
    }
}

fn not_linked() -> PluginError {
    PluginError::fatal("hinf-dfacs was called before `link`; the host must link first")
}

impl Stage for HinfDfacs {
    const MANIFEST: Manifest = Manifest {
        id: "hinf-dfacs",
        version: env!("CARGO_PKG_VERSION"),
        licence: "MIT OR Apache-2.0",
        description: "Known specific force, unbiased angular acceleration and angular velocity from commands and sensing",
        parameters: &[
            Parameter::text(
                "angular_acceleration",
                "smoother",
                &["smoother", "commanded", "second-difference"],
                "where the angular acceleration comes from; all but the smoother bias the calibration",
            ),
            Parameter::bool(
                "compare_commands",
                true,
                "replay the control law beside telemetered commands: report the distance, and fill gaps if it is small",
            ),
            Parameter::bool(
                "measure_noise",
                true,
                "measure the levels of torque noise and attitude sensing in the first 55 minutes; false trusts the mission file",
            ),
            Parameter::f64(
                "warm_up_s",
                "s",
                600.0,
                0.0..=86_400.0,
                "time after which a replayed control law counts as settled",
            ),
        ],
        instances: &[],
        needs: &[],
    };

    const STATE_VERSION: u32 = 2;

    fn new(setup: &Setup) -> Result<Self, PluginError> {
        let prediction = setup.needs(PREDICTION_NEED);
        let angular_acceleration = match setup.text("angular_acceleration")?.as_str() {
            _ if prediction => AngularAcceleration::Commanded,
            "commanded" => AngularAcceleration::Commanded,
            "second-difference" => AngularAcceleration::SecondDifference,
            _ => AngularAcceleration::Smoother,
        };
        Ok(Self {
            mission: Mission::from_json(setup.mission_json())?,
            angular_acceleration,
            compare_commands: setup.bool("compare_commands")?,
            measure_noise: setup.bool("measure_noise")?,
            warm_up_s: setup.f64("warm_up_s")?,
            needs: Needs {
                commands: setup.needs("commands"),
                torque_response: setup.needs("torque-response"),
                dws_delay_response: setup.needs("dws-delay-response"),
                prediction,
            },
            linked: None,
            notes: Vec::new(),
        })
    }

    fn link(&mut self, available: &Available, link: &mut Link<'_>) -> Result<(), PluginError> {
        let (readout, noises) = self.link_readouts(available, link)?;
        let command = self.link_commands(available, link)?;
        let sun = read_vector(available, link, "ephemeris.sun_srf", "1", "SRF")?;
        let ephemeris_age = link.read_if_available(available, &grid("ephemeris.age_s", "s", ""))?;
        let omega_crf = read_vector(available, link, "ephemeris.omega_crf_rad_s", "rad s-1", "CRF")?;
        let alpha_crf = read_vector(available, link, "ephemeris.alpha_crf_rad_s2", "rad s-2", "CRF")?;
        let sensing = self.mission.noise.dws_long_arm.as_ref().map(|n| n.shape());
        if sensing.is_some_and(|shape| shape.coloured().any(|term| term.exponent > 4)) {
            self.notes.push(
                "noise.dws_long_arm has a term of exponent above 4, which the estimated angular acceleration neglects"
                    .to_owned(),
            );
        }
        if sun.is_none() && self.mission.solar_pressure.is_some() {
            self.notes
                .push("no direction of the Sun in /ephemeris: sunlight is not modelled in the known forces".to_owned());
        }
        if omega_crf.is_none() || alpha_crf.is_none() {
            self.notes.push(
                "no rotation of CRF in /ephemeris: angular velocity is relative to CRF, not to inertial space"
                    .to_owned(),
            );
        }
        let rate_hz = available.columns.iter().find(|c| c.table == "grid").map_or(0.0, |c| c.rate_hz);
        let settings = Settings {
            rate_hz,
            angular_acceleration: self.angular_acceleration,
            commands: command.is_some(),
            sun: sun.is_some(),
            replay: false,
            warm_up_s: self.warm_up_s,
            scale: NoiseScale::nominal(),
            needs: self.needs,
        };
        let all_readouts = readout.iter().all(Option::is_some);
        let reconstruction = self.reconstruction(&settings, all_readouts)?;
        let smoother = self.angular_acceleration == AngularAcceleration::Smoother;
        if self.needs.smoothed_responses() && !smoother {
            return Err(PluginError::error(
                "hinf-dfacs: an effect of the model needs derivatives of the smoothed angular acceleration; set \
                 angular_acceleration = \"smoother\", or remove that effect (a gain of a torque, or a delay of the \
                 wavefront sensing) from the model",
            ));
        }
        let table = link.table("reconstruction", rate_hz);
        let mut out = write_columns(link, table, &self.mission, &noises, self.needs.prediction)?;
        let fixed = out.len();
        for (name, unit, frame) in reconstruction.on_demand_columns() {
            let mut attributes = vec![("kind", "series")];
            attributes.extend(on_demand::is_in_loop(&name).then_some(("in_loop", "true")));
            let follows_angles = self.needs.prediction && on_demand::is_torque_on_a_test_mass(&name);
            attributes.extend(follows_angles.then_some((AHEAD_ATTRIBUTE, ATTITUDE_CHANNELS)));
            out.push(link.write_with(table, &name, unit, &frame, &attributes)?);
        }
        self.linked = Some(Linked {
            reconstruction,
            settings,
            all_readouts,
            held_back: (smoother && self.measure_noise).then(Vec::new),
            follows: smoother && self.measure_noise,
            recent: Vec::new(),
            changes: Vec::new(),
            rate_hz,
            input: Columns { readout, command, sun, ephemeris_age, omega_crf, alpha_crf },
            table,
            out,
            fixed,
            rows: Vec::new(),
        });
        Ok(())
    }

    fn process(&mut self, input: &Inputs<'_>, output: &mut Outputs) -> Result<(), PluginError> {
        let linked = self.linked.as_mut().ok_or_else(not_linked)?;
        let (columns, times) = (linked.input.values(input), input.time_ns());
        let mut k = 0;
        if let Some(held_back) = &linked.held_back {
            let end = times.len().min(noise_calibration::length(linked.rate_hz) - held_back.len());
            let epochs: Vec<Epoch> = (0..end).map(|k| columns.epoch(times[k], k)).collect();
            linked.held_back.get_or_insert_default().extend(epochs);
            k = end;
            if linked.held_back.as_ref().is_some_and(|p| p.len() < noise_calibration::length(linked.rate_hz)) {
                return Ok(());
            }
            self.calibrate_noise()?;
        }
        let linked = self.linked.as_mut().ok_or_else(not_linked)?;
        for (k, time_ns) in times.iter().enumerate().skip(k) {
            linked.push(&self.mission, &columns.epoch(*time_ns, k))?;
        }
        linked.write_rows(output);
        Ok(())
    }

    fn flush(&mut self, output: &mut Outputs) -> Result<(), PluginError> {
        self.calibrate_noise()?;
        let linked = self.linked.as_mut().ok_or_else(not_linked)?;
        linked.reconstruction.finish(&mut linked.rows);
        linked.write_rows(output);
        Ok(())
    }

    fn report(&mut self, _earlier: &[Report]) -> Result<Report, PluginError> {
        let linked = self.linked.as_ref().ok_or_else(not_linked)?;
        let counts = linked.reconstruction.counts();
        let mut report = Report { notes: self.notes.clone(), ..Report::default() };
        let replayed = counts.commands_replayed > counts.commands_telemetered;
        report.commands = Some(if replayed { "reconstructed" } else { "telemetered" }.to_owned());
        let counted = [
            ("commands_telemetered", counts.commands_telemetered),
            ("commands_replayed", counts.commands_replayed),
            ("commands_missing", counts.commands_missing),
            ("sun_direction_missing", counts.sun_missing),
            ("commands_of_one_test_mass", counts.commands_of_one_test_mass),
            ("attitude_missing", counts.attitude_missing),
            ("readouts_bridged", counts.readouts_bridged),
            ("angular_acceleration_unknown", counts.alpha_unknown),
        ];
        report.counts = counted.map(|(name, count)| (name.to_owned(), count)).into();
        if counts.commands_replayed > 0 {
            report.notes.push(format!(
                "commands of {} of {} epochs were not telemetered and come from the replayed control law",
                counts.commands_replayed, counts.epochs
            ));
        }
        if counts.commands_missing > 0 {
            report.notes.push(format!(
                "commands of {} of {} epochs are neither telemetered nor replayed: those epochs are not used",
                counts.commands_missing, counts.epochs
            ));
        }
        if counts.commands_of_one_test_mass > 0 {
            report.notes.push(format!(
                "commands of {} of {} epochs lack the electrodes of one test mass: it is not used in those epochs",
                counts.commands_of_one_test_mass, counts.epochs
            ));
        }
        let q = &mut report.quality;
        let method = match self.angular_acceleration {
            AngularAcceleration::Smoother => "smoother",
            AngularAcceleration::Commanded => "commanded",
            AngularAcceleration::SecondDifference => "second-difference",
        };
        q.insert("angular_acceleration".to_owned(), json!(method));
        let scale = linked.settings.scale;
        q.insert("measured_over_stated_noise_power".to_owned(), scale_json(&scale));
        if scale != NoiseScale::nominal() {
            report.notes.push(format!(
                "the first 55 minutes have {:.2?} times the power of the mission file's torque noise about x, y, z and {:.2} times that \
                 of its long-arm wavefront sensing; the measured levels were used for the angular acceleration",
                scale.torque.as_slice(),
                scale.sensing
            ));
        }
        let change = |(time_ns, scale): &(i64, NoiseScale)| json!({ "time_ns": time_ns, "power": scale_json(scale) });
        let changes: Vec<_> = linked.changes.iter().map(change).collect();
        q.insert("noise_power_changes".to_owned(), json!(changes));
        if let Some((time_ns, scale)) = linked.changes.last() {
            report.notes.push(format!(
                "the noise of the attitude changed {} times; from Unix time {time_ns} ns on the torque noise about x, y, z has {:.2?} \
                 times the power of the mission file's and the long-arm wavefront sensing {:.2} times. The angular acceleration \
                 follows an hour later; the levels by which the offset is weighed are those of the whole run",
                linked.changes.len(),
                scale.torque.as_slice(),
                scale.sensing
            ));
        }
        q.insert("smoother_lag_s".to_owned(), json!(linked.reconstruction.lag() as f64 / linked.rate_hz));
        if self.angular_acceleration != AngularAcceleration::Smoother && !self.needs.prediction {
            report
                .notes
                .push(format!("angular_acceleration = \"{method}\" biases the calibration; it is for comparison"));
        }
        if let Some(ratio) = linked.reconstruction.innovation_ratio() {
            q.insert("attitude_innovation_ratio".to_owned(), json!(ratio));
            if ratio.iter().any(|r| (r - 1.0).abs() > INNOVATION_TOLERANCE) {
                report.notes.push(format!(
                    "attitude innovations have {ratio:.2?} times their predicted variance about the principal axes: \
                     the noise of thruster torque or long-arm wavefront sensing differs from the mission file"
                ));
            }
        }
        if let Some(sigma) = linked.reconstruction.inconsistency_sigma() {
            q.insert("command_innovation_correlation_sigma".to_owned(), json!(sigma));
            if replayed && sigma.iter().any(|z| z.abs() > INCONSISTENT_SIGMA) {
                report.notes.push(format!(
                    "the spacecraft does not turn as the replayed commands predict: attitude innovations correlate \
                     with them at {sigma:.1?} standard deviations about the principal axes. The flown controller, the \
                     thrusters or the inertia differ from the mission file"
                ));
            }
        }
        if let Some(comparison) = linked.reconstruction.comparison() {
            q.insert("command_replay".to_owned(), comparison_json(comparison, &self.mission));
            if !comparison.same_law() {
                report.notes.push(
                    "telemetered commands differ from the replayed control law by more than readout noise explains: \
                     another controller flew; the telemetered commands were used"
                        .to_owned(),
                );
            }
        }
        Ok(report)
    }

    fn state(&mut self, state: &mut State<'_>) -> Result<(), PluginError> {
        let test_masses = self.mission.test_mass.len();
        let linked = self.linked.as_mut().ok_or_else(not_linked)?;
        let mut scale = linked.settings.scale;
        scale.visit(state)?;
        let most = noise_calibration::length(linked.rate_hz);
        state.option(&mut linked.held_back, |state, held_back| {
            state.list(held_back, |state, epoch| epoch.visit(test_masses, state))?;
            if held_back.len() > most { Err(StateError::Content("a number of epochs")) } else { Ok(()) }
        })?;
        if linked.held_back.is_some() {
            return Ok(());
        }
        if state.is_loading() {
            self.rebuild(scale)?;
        }
        let linked = self.linked.as_mut().ok_or_else(not_linked)?;
        state.list(&mut linked.recent, |state, row| state.f64s(row))?;
        if linked.recent.len() >= most {
            return Err(StateError::Content("a number of epochs").into());
        }
        state.list(&mut linked.changes, |state, (time_ns, scale)| {
            state.i64(time_ns)?;
            scale.visit(state)
        })?;
        if state.is_loading() && !linked.changes.is_empty() {
            let scale = linked.levels();
            linked.reconstruction.set_levels(&self.mission, &Settings { scale, ..linked.settings })?;
        }
        Ok(self.linked.as_mut().ok_or_else(not_linked)?.reconstruction.visit(state)?)
    }
}

/// Power over that of the mission file.
fn scale_json(scale: &NoiseScale) -> serde_json::Value {
    json!({ "thruster_torque": scale.torque.as_slice(), "dws_long_arm": scale.sensing })
}

/// `{"samples", "rms_distance": {vector: value}, "mean_distance": {…}, "rms_flown": {…}, "rms_change_of_flown": {…}}`,
/// N and N m.
fn comparison_json(comparison: &Comparison, mission: &Mission) -> serde_json::Value {
    let by_vector = |values: Vec<f64>| {
        let pairs = command_vectors(mission).into_iter().zip(values).map(|((name, _, _), value)| (name, json!(value)));
        pairs.collect::<serde_json::Map<_, _>>()
    };
    json!({
        "samples": comparison.samples(),
        "rms_distance": by_vector(comparison.rms_distance()),
        "mean_distance": by_vector(comparison.mean_distance()),
        "rms_flown": by_vector(comparison.rms_flown()),
        "rms_change_of_flown": by_vector(comparison.rms_change()),
    })
}
