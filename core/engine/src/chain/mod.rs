//! The chain: plugins linked by their columns, rows flowing from the feed through stages and effects.
//!
//! Uniform tables are joined row by row, so a lag of a stage delays the stages after it and needs no bookkeeping. All
//! nodes work at the same time, each at the rows that the one before it has made last. Results depend neither on the
//! ends of batches nor on the number of threads: each instance sees its rows in one order.

mod link;
mod queue;
mod recording;
mod state;

pub use link::build;
pub(crate) use link::{Archived, open_source};
pub(crate) use recording::Recording;
pub use recording::Recordings;
pub use state::resumes_at_ns;

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

use dragfree_schema::{Coefficient, Constraint, NoiseProcess, Report};

use crate::border::{BorderError, Instance, PluginInfo, Rows};
use crate::table::{Batch, Chunk, Column, TableSpec};
use queue::Queue;
use recording::Recorder;

/// What can go wrong between plugins.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "every field is named in its sentence")]
pub enum ChainError {
    /// At the border.
    #[error(transparent)]
    Border(#[from] BorderError),
    /// There is no such plugin.
    #[error(transparent)]
    Registry(#[from] crate::registry::RegistryError),
    /// Parameters are wrong.
    #[error(transparent)]
    Config(#[from] crate::config::ConfigError),
    /// The model and the chain do not fit.
    #[error("model {path}: {what}")]
    Model { path: String, what: String },
    /// Tables that should have the same rows do not.
    #[error("the tables that {reader} reads have different rows: {what}; the stage that makes one of them is at fault")]
    Join { reader: String, what: String },
    /// A state does not belong to this chain.
    #[error("state: {what}")]
    State { what: String },
    /// Reports could not be handed on.
    #[error("reports: {0}")]
    Reports(String),
    /// Rows could not be archived.
    #[error("time series: {0}")]
    Sink(String),
    /// What was kept of an earlier pass cannot be read.
    #[error("the file in which an earlier pass has kept its rows: {what}; give TMPDIR another folder")]
    Recording { what: String },
}

/// A consumer of rows that leave the chain.
pub trait Sink {
    /// Rows of one table that belongs beside the product, ordered by time.
    ///
    /// # Errors
    /// A sentence for the operator.
    fn rows(&mut self, _table: &TableSpec, _batch: &Batch) -> Result<(), String> {
        Ok(())
    }

    /// Rows of the columns that `Chain::tap` asked for, in the order asked for, joined by time.
    fn tapped(&mut self, _time_ns: &[i64], _columns: &[&[f64]]) {}
}

/// A plugin at its place in the chain.
#[derive(Debug)]
pub struct ChainNode {
    /// The living plugin.
    instance: Instance,
    /// What it says of itself.
    pub info: PluginInfo,
    /// Digest of its library.
    pub sha256: String,
    /// Its parameters, complete.
    pub parameters: serde_json::Map<String, serde_json::Value>,
    /// Columns that it reads, `table:column`.
    pub reads: Vec<String>,
    inputs: Vec<Queue>,
    /// Tables that it writes.
    pub writes: Vec<TableSpec>,
    routes: Vec<Route>,
    /// Nodes that make its irregular tables.
    makers: Vec<usize>,
    /// Everything before this time that the feed gave has gone through the node, Unix ns.
    done_until_ns: i64,
    /// Duration of its last call, s: what takes longest begins first.
    seconds: f64,
    is_effect: bool,
    /// Rows of batches that the plugin discarded.
    pub discarded_rows: u64,
}

impl ChainNode {
    /// Id, with the instance of an effect.
    pub fn name(&self) -> &str {
        &self.instance.name
    }

    /// Rows that one call could take now.
    fn ready(&self) -> usize {
        self.inputs.iter().filter(|q| q.uniform).map(Queue::rows).min().unwrap_or(0)
    }

    /// Rows that wait, of the table with most of them.
    fn waiting(&self) -> usize {
        self.inputs.iter().map(Queue::rows).max().unwrap_or(0)
    }

    /// Whether it goes row by row through some table; others take whatever there is.
    fn has_uniform(&self) -> bool {
        self.inputs.iter().any(|q| q.uniform)
    }
}

/// Whom a round calls.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Call {
    /// Who has a whole batch, and those that read no uniform table, as there are new rows.
    NewRows,
    /// Who has a whole batch: calls of equal size keep all threads busy.
    FullBatch,
    /// Who has any row of its uniform tables.
    AnyRows,
}

/// Where the rows of a table go.
#[derive(Clone, Debug, Default)]
struct Route {
    readers: Vec<Reader>,
    archive: bool,
}

#[derive(Clone, Debug)]
struct Reader {
    to: To,
    input: usize,
    /// Columns of the table, in the reader's order.
    columns: Arc<[usize]>,
}

/// Who reads.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum To {
    Node(usize),
    Tap,
    Recording,
}

/// How rows are carried.
#[derive(Clone, Copy, Debug)]
pub struct Carry {
    /// Most rows of a uniform table in one call.
    pub batch_rows: usize,
    /// Threads for nodes, each at rows of its own.
    pub threads: usize,
    /// Rows before this time run in what stands before and in the effects, and go no further: neither to the stages
    /// behind the effects nor to the host.
    pub run_in_until_ns: Option<i64>,
}

impl Default for Carry {
    fn default() -> Self {
        Self { batch_rows: 4096, threads: 1, run_in_until_ns: None }
    }
}

/// A linked chain.
#[derive(Debug, Default)]
pub struct Chain {
    /// Its plugins in order.
    pub nodes: Vec<ChainNode>,
    /// Coefficients of the model.
    pub coefficients: Vec<Coefficient>,
    /// Constraints on them.
    pub constraints: Vec<Constraint>,
    /// Noise in the channels, as its stages declared it, at the levels that the model states.
    pub noise: Vec<NoiseProcess>,
    /// Columns of the feed and of every plugin, in the order in which they are made.
    pub columns: Vec<Column>,
    /// Candidates that could not be linked, with the reason.
    pub not_tried: Vec<(String, String)>,
    feed_tables: Vec<TableSpec>,
    feed_routes: Vec<Route>,
    tap: Tap,
    recorder: Option<Recorder>,
    /// Whether rows come from a recording of what the stages before the effects have made.
    from_recording: bool,
    /// What effects and the host have asked of the stages by name.
    needs: Vec<String>,
    carry: Carry,
    complete_until_ns: i64,
    /// Digests of what a state must have been saved with.
    mission_sha256: String,
    model_sha256: String,
}

/// Columns that leave the chain for its host, joined by time.
#[derive(Debug, Default)]
struct Tap {
    inputs: Vec<Queue>,
    /// Input, and column of it, of every column asked for.
    order: Vec<(usize, usize)>,
}

impl Chain {
    /// Hands columns to the host ([`Sink::tapped`]); `columns` are indices into [`Self::columns`]. They must have one
    /// rate: otherwise their rows cannot be joined.
    pub(crate) fn tap(&mut self, columns: &[usize]) -> Result<(), ChainError> {
        let wanted: Vec<Column> = columns.iter().map(|c| self.columns[*c].clone()).collect();
        let rate_hz = wanted.first().map_or(0.0, |c| c.rate_hz);
        if let Some(other) = wanted.iter().find(|c| c.rate_hz != rate_hz || c.rate_hz <= 0.0) {
            let what = format!("{} comes at {} Hz, {} at {rate_hz} Hz", other.name, other.rate_hz, wanted[0].name);
            return Err(ChainError::Join { reader: TAP.to_owned(), what });
        }
        let mut tables: Vec<(&str, Vec<&str>)> = Vec::new();
        let mut order = Vec::new();
        for column in &wanted {
            let input = tables.iter().position(|(table, _)| *table == column.table).unwrap_or_else(|| {
                tables.push((&column.table, Vec::new()));
                tables.len() - 1
            });
            let names = &mut tables[input].1;
            order.push((input, names.len()));
            names.push(&column.name);
        }
        self.tap.order = order;
        for (input, (table, names)) in tables.into_iter().enumerate() {
            let mut queue = Queue::new(table.to_owned(), true, names.len());
            queue.begin_at(self.carry.run_in_until_ns.unwrap_or(i64::MIN));
            self.tap.inputs.push(queue);
            self.subscribe(table, &names, To::Tap, input);
        }
        Ok(())
    }

    /// Routes columns of a table to a node, or to the tap; where the table is irregular, gives the nodes that make it.
    fn subscribe(&mut self, table: &str, names: &[&str], to: To, input: usize) -> Vec<usize> {
        let reader = |made: &TableSpec| Reader {
            to,
            input,
            columns: names.iter().filter_map(|n| made.columns.iter().position(|c| c.name == *n)).collect(),
        };
        for (made, route) in self.feed_tables.iter().zip(&mut self.feed_routes).filter(|(t, _)| t.name == table) {
            route.readers.push(reader(made));
        }
        let mut makers = Vec::new();
        for (index, maker) in self.nodes.iter_mut().enumerate() {
            for (made, route) in maker.writes.iter().zip(&mut maker.routes).filter(|(t, _)| t.name == table) {
                route.readers.push(reader(made));
                if made.rate_hz <= 0.0 {
                    makers.push(index);
                }
            }
        }
        makers
    }

    /// Every row before this time has gone into the chain, Unix ns.
    pub fn complete_until_ns(&self) -> i64 {
        self.complete_until_ns
    }

    /// Pushes a chunk of the feed into the chain. What went in before goes on at the same time, node by node at rows of
    /// its own, as on an assembly line; up to a batch stays before each node ([`Self::settle`]).
    ///
    /// # Errors
    /// A plugin failed, or broke a rule.
    pub fn feed(&mut self, chunk: Chunk, sink: &mut dyn Sink) -> Result<(), ChainError> {
        for piece in pieces(chunk, self.carry.batch_rows) {
            for (i, batch) in piece.batches.into_iter().enumerate() {
                let (table, route) = (&self.feed_tables[i], &self.feed_routes[i]);
                publish(&mut self.nodes, &mut self.tap, &mut self.recorder, table, route, batch, sink)?;
            }
            self.complete_until_ns = piece.complete_until_ns;
            self.round(Call::NewRows, sink)?;
            // A plugin may hold rows back for an hour and give them at once.
            while self.has_backlog() && self.round(Call::FullBatch, sink)? {}
        }
        Ok(())
    }

    /// Whether more than a batch waits anywhere, beside the one that the next round takes.
    fn has_backlog(&self) -> bool {
        let rows = 2 * self.carry.batch_rows;
        self.nodes.iter().any(|n| n.ready() >= rows) || self.tap.ready() >= rows
    }

    /// Lets everything that can go on go on: what waits then waits for rows to come, however the feed was cut.
    ///
    /// # Errors
    /// A plugin failed, or broke a rule.
    pub fn settle(&mut self, sink: &mut dyn Sink) -> Result<(), ChainError> {
        while self.round(Call::AnyRows, sink)? {}
        // Rows of irregular tables that a node makes go one node at a time.
        for _ in 0..self.nodes.iter().filter(|n| !n.makers.is_empty()).count() {
            self.round(Call::NewRows, sink)?;
            while self.round(Call::AnyRows, sink)? {}
        }
        Ok(())
    }

    /// Ends the feed: processes the remaining rows and flushes every lag.
    ///
    /// # Errors
    /// A plugin failed, or broke a rule.
    pub fn finish(&mut self, sink: &mut dyn Sink) -> Result<(), ChainError> {
        self.settle(sink)?;
        for i in 0..self.nodes.len() {
            if self.from_recording && !self.nodes[i].is_effect {
                continue;
            }
            if let Some(made) = step(&mut self.nodes[i], i64::MAX, self.carry.batch_rows, true)? {
                self.distribute(i, made, sink)?;
            }
            while self.round(Call::AnyRows, sink)? {}
            let made = self.nodes[i].instance.flush()?;
            self.distribute(i, made, sink)?;
            while self.round(Call::AnyRows, sink)? {}
        }
        let readers = self.nodes.iter().map(|n| (n.name(), &n.inputs)).chain([(TAP, &self.tap.inputs)]);
        for (reader, inputs) in readers {
            if let Some(left) = inputs.iter().find(|q| q.uniform && q.rows() > 0) {
                return Err(ChainError::Join {
                    reader: reader.to_owned(),
                    what: format!("table {} has {} rows more than the others at the end", left.table, left.rows()),
                });
            }
        }
        Ok(())
    }

    /// The reports of all stages, in order; effects have none.
    ///
    /// # Errors
    /// A plugin failed, or its report cannot be understood.
    pub fn reports(&mut self) -> Result<Vec<Report>, ChainError> {
        let mut reports: Vec<Report> = Vec::new();
        for node in self.nodes.iter_mut().filter(|n| !n.is_effect) {
            let earlier = serde_json::to_string(&reports).map_err(|e| ChainError::Reports(e.to_string()))?;
            reports.push(node.instance.report(&earlier)?);
        }
        Ok(reports)
    }

    /// Calls nodes that are due once, all at the same time; the host takes its rows meanwhile. False if nobody was due.
    /// What a node makes, its readers have in the next round. An effect waits while a reader has two batches of its
    /// rows: to queue inputs takes less memory than outputs.
    fn round(&mut self, whom: Call, sink: &mut dyn Sink) -> Result<bool, ChainError> {
        let rows = self.carry.batch_rows;
        let (least, new_rows) = (if whom == Call::AnyRows { 1 } else { rows }, whom == Call::NewRows);
        let ahead: Vec<bool> = self.nodes.iter().map(|n| n.is_effect && self.unread(n) >= 2 * rows).collect();
        let made_until = |n: &ChainNode| n.makers.iter().map(|m| self.nodes[*m].done_until_ns).min();
        let until = |n: &ChainNode| made_until(n).map_or(self.complete_until_ns, |t| t.min(self.complete_until_ns));
        let until: Vec<i64> = self.nodes.iter().map(until).collect();
        let mut due: Vec<(usize, &mut ChainNode)> = Vec::new();
        let silent = |node: &ChainNode| self.from_recording && !node.is_effect;
        for (i, node) in self.nodes.iter_mut().enumerate().filter(|(_, node)| !silent(node)) {
            let is_due = node.ready() >= least && !ahead[i] || new_rows && !node.has_uniform();
            if node.has_uniform() && node.ready() == 0 || is_due && node.ready() <= rows {
                node.done_until_ns = until[i];
            }
            if is_due {
                due.push((i, node));
            }
        }
        due.sort_by(|(_, a), (_, b)| b.seconds.total_cmp(&a.seconds));
        let worth = due.iter().filter(|(_, n)| n.waiting() > SPAWN_WORTH_ROWS).count();
        let call = |(i, node): (usize, &mut ChainNode)| {
            let start = Instant::now();
            let made = step(node, until[i], rows, new_rows);
            node.seconds = start.elapsed().as_secs_f64();
            (i, made)
        };
        let (tap, more) = (&mut self.tap, self.carry.threads.min(worth).saturating_sub(1));
        let (mut made, poured): (Vec<(usize, Made)>, _) = if more > 0 {
            let waiting = Mutex::new(due.into_iter());
            let next = || waiting.lock().unwrap_or_else(PoisonError::into_inner).next();
            let work = || std::iter::from_fn(next).map(call).collect::<Vec<_>>();
            std::thread::scope(|scope| {
                // Where the system allows no more threads, this one does the work.
                let start = |_| std::thread::Builder::new().spawn_scoped(scope, work);
                let running: Vec<_> = (0..more).filter_map(|n| start(n).ok()).collect();
                let poured = tap.pour(rows, sink);
                let mine = work();
                let join = |thread: std::thread::ScopedJoinHandle<'_, Vec<(usize, Made)>>| {
                    thread.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))
                };
                (mine.into_iter().chain(running.into_iter().flat_map(join)).collect(), poured)
            })
        } else {
            let poured = tap.pour(rows, sink);
            (due.into_iter().map(call).collect(), poured)
        };
        let poured = poured?;
        made.sort_by_key(|(i, _)| *i);
        let mut busy = poured;
        for (i, made) in made {
            if let Some(batches) = made? {
                busy = true;
                self.distribute(i, batches, sink)?;
            }
        }
        Ok(busy)
    }

    /// Most rows that a reader of a node has not used yet.
    fn unread(&self, node: &ChainNode) -> usize {
        let readers = node.routes.iter().flat_map(|route| &route.readers);
        let rows = |r: &Reader| match r.to {
            To::Node(node) => self.nodes[node].inputs[r.input].rows(),
            To::Tap => self.tap.inputs[r.input].rows(),
            To::Recording => 0,
        };
        readers.map(rows).max().unwrap_or(0)
    }

    fn distribute(&mut self, node: usize, made: Vec<Batch>, sink: &mut dyn Sink) -> Result<(), ChainError> {
        let routes = std::mem::take(&mut self.nodes[node].routes);
        let writes = std::mem::take(&mut self.nodes[node].writes);
        let mut result = Ok(());
        for ((table, route), batch) in writes.iter().zip(&routes).zip(made) {
            let (nodes, tap, recorder) = (&mut self.nodes, &mut self.tap, &mut self.recorder);
            result = result.and_then(|()| publish(nodes, tap, recorder, table, route, batch, sink));
        }
        if let Some(Err(why)) = self.recorder.as_mut().map(|recorder| recorder.pour(false)) {
            recording::not_kept(&why);
            self.recorder = None;
        }
        self.nodes[node].routes = routes;
        self.nodes[node].writes = writes;
        result
    }
}

impl Tap {
    /// Rows that it could hand over now.
    fn ready(&self) -> usize {
        self.inputs.iter().map(Queue::rows).min().unwrap_or(0)
    }

    /// Hands its rows to the host, at most a batch of them; false where there are none.
    fn pour(&mut self, most: usize, sink: &mut dyn Sink) -> Result<bool, ChainError> {
        let rows = self.ready().min(most);
        let Self { inputs, order } = self;
        if rows == 0 {
            return Ok(false);
        }
        inputs.iter_mut().for_each(|queue| queue.gather(rows));
        check_join(TAP, inputs, rows)?;
        let tables: Vec<Rows<'_>> = inputs.iter().map(|q| q.front(rows)).collect();
        let columns: Vec<&[f64]> = order.iter().map(|(input, column)| tables[*input].columns[*column]).collect();
        sink.tapped(tables[0].time_ns, &columns);
        inputs.iter_mut().for_each(|q| q.consume(rows));
        Ok(true)
    }
}

/// Who reads the tap, in messages.
const TAP: &str = "the host";

/// What a node made in one call: one batch per written table; `None` if it was not called.
type Made = Result<Option<Vec<Batch>>, ChainError>;

/// Rows from which a thread is worth its start.
const SPAWN_WORTH_ROWS: usize = 512;

fn publish(
    nodes: &mut [ChainNode],
    tap: &mut Tap,
    recorder: &mut Option<Recorder>,
    table: &TableSpec,
    route: &Route,
    batch: Batch,
    sink: &mut dyn Sink,
) -> Result<(), ChainError> {
    if batch.rows() == 0 {
        return Ok(());
    }
    if route.archive {
        sink.rows(table, &batch).map_err(ChainError::Sink)?;
    }
    let batch = Arc::new(batch);
    for reader in &route.readers {
        let queue = match reader.to {
            To::Node(node) => &mut nodes[node].inputs[reader.input],
            To::Tap => &mut tap.inputs[reader.input],
            To::Recording => match recorder {
                Some(recorder) => &mut recorder.inputs[reader.input],
                None => continue,
            },
        };
        queue.push(&batch, &reader.columns);
    }
    Ok(())
}

/// Calls a node with at most `batch_rows` rows of its uniform tables; one without uniform tables only with `new_rows`.
fn step(node: &mut ChainNode, complete_until_ns: i64, batch_rows: usize, new_rows: bool) -> Made {
    let rows = node.ready().min(batch_rows);
    if rows == 0 && (node.has_uniform() || !new_rows) {
        return Ok(None);
    }
    let given: Vec<usize> = node.inputs.iter().map(|q| if q.uniform { rows } else { q.rows() }).collect();
    node.inputs.iter_mut().zip(&given).for_each(|(queue, n)| queue.gather(*n));
    check_join(node.name(), &node.inputs, rows)?;
    let tables: Vec<Rows<'_>> = node.inputs.iter().zip(&given).map(|(q, n)| q.front(*n)).collect();
    let batches = match node.instance.process(&tables, complete_until_ns)? {
        Some(batches) => {
            check_rows(node, &batches, rows)?;
            batches
        }
        None => discarded(node, rows),
    };
    for (queue, n) in node.inputs.iter_mut().zip(&given) {
        queue.consume(*n);
    }
    Ok(Some(batches))
}

/// A discarded batch leaves rows without values in the node's uniform tables, so that the chain stays in step.
fn discarded(node: &mut ChainNode, rows: usize) -> Vec<Batch> {
    node.discarded_rows += rows as u64;
    let times = node.inputs.iter().find(|q| q.uniform).map(|q| q.times(rows).to_vec()).unwrap_or_default();
    node.writes
        .iter()
        .map(|t| {
            if t.rate_hz > 0.0 {
                Batch { time_ns: times.clone(), columns: vec![vec![f64::NAN; times.len()]; t.columns.len()] }
            } else {
                Batch::empty(t.columns.len())
            }
        })
        .collect()
}

fn check_join(reader: &str, inputs: &[Queue], rows: usize) -> Result<(), ChainError> {
    let mut uniform = inputs.iter().filter(|q| q.uniform);
    let Some(first) = uniform.next() else { return Ok(()) };
    let times = first.times(rows);
    for queue in uniform {
        let other = queue.times(rows);
        if std::ptr::eq(times, other) {
            continue;
        }
        if let Some(i) = (0..rows).find(|i| times[*i] != other[*i]) {
            return Err(ChainError::Join {
                reader: reader.to_owned(),
                what: format!(
                    "at the same row, {} has {} ns and {} has {} ns",
                    first.table, times[i], queue.table, other[i]
                ),
            });
        }
    }
    Ok(())
}

fn check_rows(node: &ChainNode, batches: &[Batch], rows: usize) -> Result<(), ChainError> {
    let rule =
        |what: String| ChainError::Border(BorderError::Rule { plugin: node.name().to_owned(), call: "process", what });
    for (table, batch) in node.writes.iter().zip(batches) {
        if batch.time_ns.windows(2).any(|w| w[0] > w[1] || (table.rate_hz > 0.0 && w[0] == w[1])) {
            return Err(rule(format!("table {}: its times run backwards", table.name)));
        }
        if node.is_effect && batch.rows() != rows {
            return Err(rule(format!("an effect that gives {} rows for {rows}", batch.rows())));
        }
    }
    Ok(())
}

/// Cuts a chunk by time so that no table has many more than `rows` rows in one piece.
fn pieces(mut chunk: Chunk, rows: usize) -> Vec<Chunk> {
    let densest = chunk.batches.iter().max_by_key(|b| b.rows());
    let times = densest.map_or(&[][..], |b| &b.time_ns).iter().copied();
    let mut cuts: Vec<i64> = times.skip(rows).step_by(rows).filter(|t| *t <= chunk.complete_until_ns).collect();
    cuts.dedup();
    // From the end, so that every row is moved once.
    let mut pieces: Vec<Chunk> = cuts.into_iter().rev().map(|cut| chunk.split_off(cut)).collect();
    pieces.push(chunk);
    pieces.reverse();
    pieces
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pieces_cover_a_chunk_once_and_in_order() {
        let fast: Vec<i64> = (0..100).map(|k| k * 10).collect();
        let slow: Vec<i64> = (0..10).map(|k| k * 100).collect();
        let batch = |t: &[i64]| Batch { time_ns: t.to_vec(), columns: vec![t.iter().map(|t| *t as f64).collect()] };
        let chunk = Chunk { batches: vec![batch(&fast), batch(&slow)], complete_until_ns: 1000 };
        for rows in [1, 7, 99, 100, 1000] {
            let pieces = pieces(chunk.clone(), rows);
            for (table, times) in [(0, &fast), (1, &slow)] {
                let joined: Vec<i64> = pieces.iter().flat_map(|p| p.batches[table].time_ns.clone()).collect();
                assert_eq!(joined, *times, "{rows} rows");
            }
            for p in &pieces {
                assert!(p.batches.iter().all(|b| b.rows() <= rows.max(1)));
                assert!(p.batches.iter().flat_map(|b| &b.time_ns).all(|t| *t < p.complete_until_ns));
            }
            assert_eq!(pieces.last().map(|p| p.complete_until_ns), Some(1000));
        }
    }
}
