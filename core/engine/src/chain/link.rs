//! Linking: every plugin of a pipeline made, asked for its columns, and routed, before a byte of data is read.

use dragfree_schema::{Coefficient, Constraint, NoiseLevels, NoiseProcess, Settings};
use serde_json::{Map, Value, json};

use super::{Carry, Chain, ChainError, ChainNode, Queue, Route, To};
use crate::border::{BorderError, Config, Instance, Kind, LinkRequest, Linked};
use crate::config::{EffectEntry, Mission, Model, Node, Pipeline, resolve_parameters};
use crate::means;
use crate::registry::{Found, Registry};
use crate::table::{Column, TableSpec};
use dragfree_archive::files::sha256;

/// Links a pipeline over the tables of a feed.
///
/// # Errors
/// A plugin is missing, refuses its parameters, wants a column that nobody makes or with another unit, frame or rate;
/// the model names an effect or a coefficient that does not exist.
pub fn build(
    registry: &Registry,
    pipeline: &Pipeline,
    mission: &Mission,
    model: &Model,
    feed_tables: &[TableSpec],
    carry: Carry,
) -> Result<Chain, ChainError> {
    let mut builder = Builder {
        registry,
        mission,
        model,
        available: feed_tables.iter().filter(|t| !t.truth).flat_map(|t| t.columns.clone()).collect(),
        needs: needs(registry, model),
        settings: &pipeline.settings,
        chain: Chain {
            feed_tables: feed_tables.to_vec(),
            feed_routes: vec![Route::default(); feed_tables.len()],
            carry: Carry { batch_rows: carry.batch_rows.max(1), ..carry },
            complete_until_ns: i64::MIN,
            mission_sha256: sha256(mission.value.to_string()),
            ..Chain::default()
        },
    };
    let mut behind_effects = false;
    for node in &pipeline.nodes {
        match node {
            Node::Stage { plugin, isolate, parameters } => {
                builder.stage(plugin, *isolate, parameters, pipeline)?;
                if let (true, Some(from_ns), Some(stage)) =
                    (behind_effects, carry.run_in_until_ns, builder.chain.nodes.last_mut())
                {
                    stage.inputs.iter_mut().for_each(|queue| queue.begin_at(from_ns));
                }
            }
            Node::Effects => {
                builder.effects()?;
                behind_effects = true;
            }
        }
    }
    if !model.effects.is_empty() && !pipeline.nodes.contains(&Node::Effects) {
        return Err(builder.model_error(format!(
            "has effects, but {} has no `[[stage]] effects = true` to say where they stand",
            pipeline.path.display()
        )));
    }
    builder.chain.columns = std::mem::take(&mut builder.available);
    builder.chain.needs = std::mem::take(&mut builder.needs);
    builder.chain.model_sha256 = sha256(builder.model_json(false));
    Ok(builder.chain)
}

/// What the host and the effects of a model want of the stages before them. An effect that does not exist is met again
/// when it is linked.
fn needs(registry: &Registry, model: &Model) -> Vec<String> {
    let effects = model.effects.iter().chain(&model.candidates).chain(&model.chosen);
    let found = effects.filter_map(|e| registry.find(Kind::Effect, &e.id).ok());
    let mut needs: Vec<String> = found.flat_map(|f| f.info.manifest.needs.clone()).chain(model.needs.clone()).collect();
    needs.sort();
    needs.dedup();
    needs
}

/// How a plugin stands to the model.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Standing {
    /// A stage, or an effect of the model.
    Member,
    /// An effect that is tried beside the model in every form that it may have.
    Candidate,
    /// An effect that is tried beside the model in the form that its parameters say.
    Chosen,
}

struct Builder<'a> {
    registry: &'a Registry,
    mission: &'a Mission,
    model: &'a Model,
    available: Vec<Column>,
    needs: Vec<String>,
    settings: &'a Settings,
    chain: Chain,
}

impl Builder<'_> {
    fn model_error(&self, what: String) -> ChainError {
        ChainError::Model { path: self.model.path.display().to_string(), what }
    }

    fn model_json(&self, for_candidate: bool) -> String {
        // A candidate need not know of others, whose forms may be ten thousands.
        let told: Vec<_> = self.chain.coefficients.iter().filter(|c| !(for_candidate && c.candidate)).collect();
        json!({ "coefficients": told, "constraints": self.chain.constraints, "noise": self.chain.noise }).to_string()
    }

    fn stage(
        &mut self,
        id: &str,
        isolate: bool,
        parameters: &toml::Table,
        pipeline: &Pipeline,
    ) -> Result<(), ChainError> {
        let found = self.registry.find(Kind::Stage, id)?.apart(isolate);
        let file = pipeline.path.display().to_string();
        let parameters = resolve_parameters(&file, &found.info.manifest, parameters)?;
        self.add(&found, parameters, "", Standing::Member)?;
        Ok(())
    }

    fn effects(&mut self) -> Result<(), ChainError> {
        let mut constraints: Vec<(Constraint, u32)> = Vec::new();
        for entry in &self.model.effects {
            let found = self.registry.find(Kind::Effect, &entry.id)?.apart(entry.isolate);
            entry.check_instance(&found.info.manifest, self.mission).map_err(|what| self.model_error(what))?;
            let file = self.model.path.display().to_string();
            let parameters = resolve_parameters(&file, &found.info.manifest, &entry.parameters)?;
            let linked = self.add(&found, parameters, &entry.instance, Standing::Member)?;
            self.take_coefficients(entry, linked.coefficients, false)?;
            for constraint in linked.constraints {
                self.merge(&mut constraints, constraint)?;
            }
        }
        self.chain.constraints =
            constraints.into_iter().filter(|(c, contributed)| *contributed >= c.parts).map(|(c, _)| c).collect();
        self.apply_noise_levels()?;
        let candidates = self.model.candidates.iter().map(|entry| (entry, Standing::Candidate));
        let chosen = self.model.chosen.iter().map(|entry| (entry, Standing::Chosen));
        for (entry, standing) in candidates.chain(chosen) {
            if let Err(reason) = self.candidate(entry, standing) {
                let name = format!("{}:{}", entry.id, entry.instance);
                self.chain.not_tried.push((name, reason.to_string()));
            }
        }
        Ok(())
    }

    /// Levels of noise that effects of the model state enter the declared noise here, for every plugin and consumer
    /// after the effects.
    fn apply_noise_levels(&mut self) -> Result<(), ChainError> {
        let levels = NoiseLevels::of(&self.chain.coefficients);
        let applied = levels.apply(&mut self.chain.noise);
        applied.map_err(|what| self.model_error(what))
    }

    /// An effect that is not in the model: what keeps it from being tried is no error of the run.
    fn candidate(&mut self, entry: &EffectEntry, standing: Standing) -> Result<(), ChainError> {
        let found = self.registry.find(Kind::Effect, &entry.id)?.apart(entry.isolate);
        let mut linked = self.chain.coefficients.iter();
        let in_a_form = |c: &Coefficient| c.candidate && c.variants.is_empty() && c.transients.is_empty();
        let may_come_again = |c: &Coefficient| standing == Standing::Chosen && in_a_form(c);
        let of = |c: &&Coefficient| c.effect == entry.id && c.instance == entry.instance;
        if let Some(c) = linked.find(|c| of(c) && !may_come_again(c)) {
            // Before it is linked, because its table has the name of the other's.
            return Err(self.model_error(format!("coefficient {} exists twice", c.name)));
        }
        let file = self.model.path.display().to_string();
        let parameters = resolve_parameters(&file, &found.info.manifest, &entry.parameters)?;
        let linked = self.add(&found, parameters, &entry.instance, standing)?;
        self.take_coefficients(entry, linked.coefficients, true)
    }

    fn merge(&self, all: &mut Vec<(Constraint, u32)>, constraint: Constraint) -> Result<(), ChainError> {
        match all.iter_mut().find(|(c, _)| c.name == constraint.name) {
            Some((there, contributed)) => {
                if (there.lower, there.upper, &there.kind, there.parts)
                    != (constraint.lower, constraint.upper, &constraint.kind, constraint.parts)
                {
                    return Err(self
                        .model_error(format!("constraint {} has different bounds in different effects", there.name)));
                }
                there.terms.extend(constraint.terms);
                *contributed += 1;
            }
            None => all.push((constraint, 1)),
        }
        Ok(())
    }

    fn take_coefficients(
        &mut self,
        entry: &EffectEntry,
        announced: Vec<Coefficient>,
        candidate: bool,
    ) -> Result<(), ChainError> {
        let mut unused: Vec<&String> = entry.prior.keys().collect();
        for mut c in announced {
            // One that is tried may come again in another form.
            let is_another_form = |other: &Coefficient| candidate && other.candidate && other.shape != c.shape;
            let same = |other: &&Coefficient| other.name == c.name && !is_another_form(other);
            if self.chain.coefficients.iter().any(|other| same(&other)) {
                return Err(self.model_error(format!("coefficient {} exists twice", c.name)));
            }
            c.effect.clone_from(&entry.id);
            c.instance.clone_from(&entry.instance);
            c.estimate = entry.estimate && !candidate;
            c.candidate = candidate;
            let short = c.name.rsplit('.').next().unwrap_or_default();
            if let Some(prior) = entry.prior.get(short) {
                unused.retain(|key| *key != short);
                c.initial = prior.value.unwrap_or(c.initial);
                c.prior_sigma = prior.sigma.unwrap_or(c.prior_sigma);
                c.lower = prior.lower.unwrap_or(c.lower);
                c.upper = prior.upper.unwrap_or(c.upper);
                if c.lower >= c.upper {
                    return Err(self.model_error(format!(
                        "effect {}:{}: prior.{short}: the range from {} to {} {} is empty",
                        entry.id, entry.instance, c.lower, c.upper, c.unit
                    )));
                }
            }
            self.chain.coefficients.push(c);
        }
        let Some(key) = unused.first() else { return Ok(()) };
        let own = |c: &&Coefficient| c.effect == entry.id && c.instance == entry.instance;
        let names: Vec<_> = self.chain.coefficients.iter().filter(own).map(|c| c.name.as_str()).collect();
        let (id, instance, names) = (&entry.id, &entry.instance, names.join(", "));
        Err(self.model_error(format!("effect {id}:{instance}: prior.{key} is no coefficient; it has {names}")))
    }

    fn add(
        &mut self,
        found: &Found,
        parameters: Map<String, Value>,
        instance: &str,
        standing: Standing,
    ) -> Result<Linked, ChainError> {
        let mut config = Config {
            value: json!({
                "parameters": parameters,
                "mission": self.mission.value,
                "instance": instance,
                "candidate": standing == Standing::Candidate,
                "needs": self.needs,
                "settings": self.settings,
                "threads": self.chain.carry.threads,
            }),
        };
        if let Some(start_ns) = self.chain.carry.run_in_until_ns {
            config.value["start_ns"] = start_ns.into();
        }
        let mut node = found.create(&config)?;
        let model_json = self.model_json(standing != Standing::Member);
        let mut linked =
            node.link(LinkRequest { available: &self.without_tables_of(&node.name), model_json: &model_json })?;
        self.rename_tables(&mut linked);
        self.take_noise(&node.name, std::mem::take(&mut linked.noise))?;
        self.inherit_loop(&mut linked);
        node.activate(u32::try_from(self.chain.carry.batch_rows).unwrap_or(u32::MAX))?;
        let index = self.chain.nodes.len();
        let (inputs, makers) = self.route(index, &linked);
        let reads = linked
            .reads
            .iter()
            .flatten()
            .map(|r| format!("{}:{}", self.available[r.available].table, self.available[r.available].name))
            .collect();
        self.available.extend(linked.writes.iter().flat_map(|t| t.columns.clone()));
        self.chain.nodes.push(ChainNode {
            info: found.info.clone(),
            sha256: found.opened.sha256.clone(),
            parameters,
            reads,
            inputs,
            routes: linked
                .writes
                .iter()
                .map(|t| Route { readers: Vec::new(), archive: Archived::of(t).is_some() })
                .collect(),
            writes: linked.writes.clone(),
            makers,
            done_until_ns: i64::MIN,
            seconds: 0.0,
            is_effect: node.kind == Kind::Effect,
            discarded_rows: 0,
            instance: node,
        });
        Ok(linked)
    }

    /// What exists for a plugin with a name. An effect that is tried in several forms writes the same tables in each:
    /// those that are there already are hidden behind another name.
    fn without_tables_of(&self, name: &str) -> std::borrow::Cow<'_, [Column]> {
        let own = self.chain.nodes.iter().filter(|n| n.is_effect && n.name() == name).flat_map(|n| &n.writes);
        let own: Vec<&str> = own.map(|table| table.name.as_str()).collect();
        if own.is_empty() {
            return self.available.as_slice().into();
        }
        let hidden = |c: &Column| {
            let table = if own.contains(&c.table.as_str()) { format!("{} before", c.table) } else { c.table.clone() };
            Column { table, ..c.clone() }
        };
        self.available.iter().map(hidden).collect()
    }

    /// Gives tables that an earlier form of the same effect has written too a number.
    fn rename_tables(&self, linked: &mut Linked) {
        for written in &mut linked.writes {
            let taken = |name: &str| self.available.iter().any(|c| c.table == name);
            let free = |name: &String| (2..).map(|k| format!("{name} {k}")).find(|name| !taken(name));
            let Some(other) = taken(&written.name).then(|| free(&written.name)).flatten() else { continue };
            let before = std::mem::replace(&mut written.name, other.clone());
            written.columns.iter_mut().for_each(|c| c.table.clone_from(&other));
            let responses = linked.coefficients.iter_mut().flat_map(|c| &mut c.responses);
            responses.filter(|r| r.table == before).for_each(|r| r.table.clone_from(&other));
        }
    }

    fn take_noise(&mut self, plugin: &str, declared: Vec<NoiseProcess>) -> Result<(), ChainError> {
        for process in declared {
            if self.chain.noise.iter().any(|other| other.name == process.name) {
                let sentence = format!("declares the noise process `{}`, which exists already", process.name);
                return Err(BorderError::Link { plugin: plugin.to_owned(), sentence }.into());
            }
            self.chain.noise.push(process);
        }
        Ok(())
    }

    /// A regressor or series of a plugin that reads a series made from commands (attribute `in_loop`) counts as made
    /// from commands too.
    fn inherit_loop(&self, linked: &mut Linked) {
        let in_loop = |c: &Column| c.attributes.get("in_loop").is_some_and(|a| a == "true");
        if linked.reads.iter().flatten().any(|r| in_loop(&self.available[r.available])) {
            let acts = |c: &&mut Column| c.attributes.get("kind").is_some_and(|k| k == "regressor" || k == "series");
            for column in linked.writes.iter_mut().flat_map(|t| &mut t.columns).filter(acts) {
                column.attributes.insert("in_loop".to_owned(), "true".to_owned());
            }
        }
    }

    /// The queues of a new node, its routes entered where its tables are made.
    fn route(&mut self, index: usize, linked: &Linked) -> (Vec<Queue>, Vec<usize>) {
        let mut makers = Vec::new();
        let mut inputs = Vec::new();
        for (input, columns) in linked.reads.iter().enumerate() {
            let Some(first) = columns.first().map(|c| &self.available[c.available]) else { continue };
            let (table, uniform) = (first.table.clone(), first.rate_hz > 0.0);
            let names: Vec<&str> = columns.iter().map(|c| self.available[c.available].name.as_str()).collect();
            inputs.push(Queue::new(table.clone(), uniform, columns.len()));
            makers.extend(self.chain.subscribe(&table, &names, To::Node(index), input));
        }
        (inputs, makers)
    }
}

/// How a table goes into the file beside a product.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Archived {
    /// Row by row.
    Whole,
    /// Row by row; all rows come at the flush.
    AtTheEnd,
    /// As means of some columns over intervals.
    Means {
        /// Their indices.
        columns: Vec<usize>,
        /// Rate of the table, Hz.
        rate_hz: f64,
    },
}

impl Archived {
    /// As the attributes `archive` of its columns say; none where no column has one.
    fn of(table: &TableSpec) -> Option<Self> {
        let says = |c: &Column, value: &str| c.attributes.get("archive").is_some_and(|a| a == value);
        let any = |value: &str| table.columns.iter().any(|c| says(c, value));
        if any("end") {
            return Some(Self::AtTheEnd);
        }
        if any("true") {
            return Some(Self::Whole);
        }
        let columns = table.columns.iter().enumerate().filter(|(_, c)| says(c, "mean"));
        let columns: Vec<usize> = columns.map(|(i, _)| i).collect();
        (!columns.is_empty() && table.rate_hz > 0.0).then_some(Self::Means { columns, rate_hz: table.rate_hz })
    }
}

impl Chain {
    /// Tables of the file beside the product, as they are there, and how they come to it.
    pub(crate) fn archived_tables(&self) -> Vec<(TableSpec, Archived)> {
        let all = self.nodes.iter().flat_map(|n| n.writes.iter().zip(&n.routes)).filter(|(_, route)| route.archive);
        let table = |table: &TableSpec| {
            let archived = Archived::of(table)?;
            let spec = match &archived {
                Archived::Means { columns, .. } => TableSpec {
                    rate_hz: 0.0,
                    columns: columns.iter().flat_map(|c| means::columns_of(&table.columns[*c])).collect(),
                    ..table.clone()
                },
                Archived::Whole | Archived::AtTheEnd => table.clone(),
            };
            Some((spec, archived))
        };
        all.filter_map(|(own, _)| table(own)).collect()
    }
}

/// Makes and links a source: it reads nothing, and says which tables it makes.
///
/// # Errors
/// The plugin refuses its configuration.
pub(crate) fn open_source(found: &Found, config: &Config) -> Result<(Instance, Vec<TableSpec>), ChainError> {
    let mut instance = found.create(config)?;
    let linked = instance.link(LinkRequest { available: &[], model_json: "{}" })?;
    instance.activate(u32::MAX)?;
    Ok((instance, linked.writes))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;

    #[test]
    fn what_the_host_asks_for_is_needed_once_without_any_effect() {
        let mut model = Model::parse(Path::new("m.toml"), "[model]\nrevision = \"1\"\n").expect("a model");
        assert!(needs(&Registry::default(), &model).is_empty());
        model.needs = vec![dragfree_schema::PREDICTION_NEED.to_owned(); 2];
        assert_eq!(needs(&Registry::default(), &model), ["prediction"]);
    }
}
