//! An instance in a process of its own, as this process sees it.

use rustix::net::{SendAncillaryBuffer, SendAncillaryMessage, SendFlags, sendmsg};
use std::io::{self, BufRead as _, BufReader, IoSlice, Read, Write};
use std::mem::MaybeUninit;
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixStream;
use std::os::unix::process::CommandExt as _;
use std::path::PathBuf;
use std::process::{Child, Command, ExitStatus};
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

use super::super::call::{Config, LinkRequest, Rows, SourceStep};
use super::super::library::{Checked, Kind, Library, PluginInfo};
use super::super::link::{self, Linked};
use super::super::{BorderError, ended, without_name};
use super::Isolation;
use super::memory::Memory;
use super::message::{Answer, Ask, Failed, receive, send};
use crate::limits::{LOG_BYTES, LOG_LINES, OPENING, REPORT_BYTES, ROWS, STATE_BYTES};
use crate::table::Batch;
use dragfree_abi as abi;

/// Longest time between two looks at the clock: a program that was stopped meanwhile does not count the rest.
const LOOK: Duration = Duration::from_millis(500);
/// Time that a process has to end.
const FAREWELL: Duration = Duration::from_secs(2);
/// What every failure of such a process ends with.
const APART: &str = "it ran in a process of its own";

/// An instance in a process of its own.
#[derive(Debug)]
pub(in super::super) struct Isolated {
    name: String,
    kind: Kind,
    process: Process,
    /// Columns of each written table, beside the times.
    output_columns: Vec<usize>,
    input: Memory,
    output: Memory,
    /// An earlier call failed.
    dead: bool,
}

impl Drop for Isolated {
    fn drop(&mut self) {
        if !self.dead
            && let Err(error) = self.done("destroy", &Ask::Destroy, &[])
        {
            tracing::warn!(plugin = self.name, "{error}");
        }
    }
}

impl Isolated {
    /// Starts a process, opens the library there and makes an instance.
    ///
    /// # Errors
    /// The process cannot be started, or the plugin refused the configuration.
    pub(in super::super) fn create(
        isolation: &Isolation,
        library: &Library,
        plugin: &PluginInfo,
        config: &Config,
    ) -> Result<Self, BorderError> {
        let name = config.name_of(plugin);
        let files = config.value["files"].as_array().into_iter().flatten().filter_map(|f| f.as_str());
        let files = files.map(PathBuf::from).collect();
        let (process, input, output) = opened(isolation, &library.path, &library.sha256, &name, files)?.1;
        let (kind, index) = (plugin.kind, plugin.index);
        let mut this = Self { name, kind, process, output_columns: Vec::new(), input, output, dead: false };
        this.done("create", &Ask::Create { kind, index, config: config.value.clone() }, &[])?;
        Ok(this)
    }

    pub(in super::super) fn link(&mut self, request: LinkRequest<'_>) -> Result<Linked, BorderError> {
        let (available, model_json) = (request.available.to_vec(), request.model_json.to_owned());
        let linked = match self.ask("link", &Ask::Link { available, model_json }, &[], 0)? {
            (Answer::Linked(linked), _) => linked,
            _ => return Err(self.nonsense("link")),
        };
        let checked = link::declared_again(linked, request.available, self.kind)
            .and_then(|linked| link::check_noise(&linked, request.available).map(|()| linked));
        let linked = checked.map_err(|sentence| BorderError::Link { plugin: self.name.clone(), sentence })?;
        self.output_columns = linked.writes.iter().map(|table| table.columns.len()).collect();
        Ok(linked)
    }

    pub(in super::super) fn activate(&mut self, max_rows: u32) -> Result<(), BorderError> {
        self.done("activate", &Ask::Activate { max_rows }, &[])
    }

    pub(in super::super) fn process(
        &mut self,
        tables: &[Rows<'_>],
        complete_until_ns: i64,
    ) -> Result<Option<Vec<Batch>>, BorderError> {
        let mut columns: Vec<&[u8]> = Vec::new();
        for table in tables {
            columns.push(bytemuck::cast_slice(table.time_ns));
            columns.extend(table.columns.iter().map(|column| bytemuck::cast_slice::<f64, u8>(column)));
        }
        let written = self.input.write(&columns);
        written.map_err(|error| self.failed("process", &format!("cannot be given its rows: {error}")))?;
        let rows = tables.iter().map(|table| table.time_ns.len()).collect();
        match self.ask("process", &Ask::Process { rows, complete_until_ns }, &[], 0)?.0 {
            Answer::Discarded => Ok(None),
            Answer::Rows { rows, .. } => self.rows("process", &rows).map(Some),
            _ => Err(self.nonsense("process")),
        }
    }

    pub(in super::super) fn next(&mut self, rows: u32) -> Result<SourceStep, BorderError> {
        let (Answer::Rows { rows, complete_until_ns, done }, _) = self.ask("next", &Ask::Next { rows }, &[], 0)? else {
            return Err(self.nonsense("next"));
        };
        Ok(SourceStep { batches: self.rows("next", &rows)?, complete_until_ns, done })
    }

    pub(in super::super) fn flush(&mut self) -> Result<Vec<Batch>, BorderError> {
        match self.ask("flush", &Ask::Flush, &[], 0)?.0 {
            Answer::Rows { rows, .. } => self.rows("flush", &rows),
            _ => Err(self.nonsense("flush")),
        }
    }

    pub(in super::super) fn report(&mut self, earlier_json: &str) -> Result<Option<Vec<u8>>, BorderError> {
        match self.ask("report", &Ask::Report, earlier_json.as_bytes(), REPORT_BYTES)? {
            (Answer::Bytes(given), bytes) => Ok(given.then_some(bytes)),
            _ => Err(self.nonsense("report")),
        }
    }

    pub(in super::super) fn save(&mut self) -> Result<Vec<u8>, BorderError> {
        match self.ask("save", &Ask::Save, &[], STATE_BYTES)? {
            (Answer::Bytes(_), bytes) => Ok(bytes),
            _ => Err(self.nonsense("save")),
        }
    }

    pub(in super::super) fn load(&mut self, state: &[u8]) -> Result<(), BorderError> {
        self.done("load", &Ask::Load, state)
    }

    fn done(&mut self, call: &'static str, ask: &Ask, bytes: &[u8]) -> Result<(), BorderError> {
        match self.ask(call, ask, bytes, 0)?.0 {
            Answer::Done => Ok(()),
            _ => Err(self.nonsense(call)),
        }
    }

    /// Asks, and waits for the answer. A failure of the plugin is an error.
    fn ask(
        &mut self,
        call: &'static str,
        ask: &Ask,
        bytes: &[u8],
        most: usize,
    ) -> Result<(Answer, Vec<u8>), BorderError> {
        if self.dead {
            let what = "it failed before and must not be called again".to_owned();
            return Err(BorderError::Rule { plugin: self.name.clone(), call, what });
        }
        let answer = match self.process.ask(&self.name, ask, bytes, most) {
            Ok((Answer::Failed { kind, message }, _)) => Err(self.error(call, kind, message)),
            Ok(answer) => Ok(answer),
            Err(error) => {
                let why = self.process.why(&error);
                Err(self.failed(call, &why))
            }
        };
        self.dead = answer.is_err();
        answer
    }

    /// Copies rows out of the shared memory.
    fn rows(&mut self, call: &'static str, rows: &[usize]) -> Result<Vec<Batch>, BorderError> {
        if rows.len() != self.output_columns.len() || rows.iter().any(|rows| *rows > ROWS) {
            return Err(self.nonsense(call));
        }
        let sizes: Vec<_> = rows.iter().copied().zip(self.output_columns.iter().copied()).collect();
        let copied = self.output.copied(&sizes);
        copied.map_err(|error| self.failed(call, &format!("its rows cannot be read: {error}; {APART}")))
    }

    fn error(&self, call: &'static str, kind: Failed, message: String) -> BorderError {
        let plugin = self.name.clone();
        match kind {
            Failed::Refused | Failed::Plugin => BorderError::Plugin { plugin, call, message },
            Failed::Rule => BorderError::Rule { plugin, call, what: message },
            Failed::Link => BorderError::Link { plugin, sentence: message },
        }
    }

    fn failed(&self, call: &'static str, message: &str) -> BorderError {
        let message = without_name(&self.name, message).to_owned();
        BorderError::Plugin { plugin: self.name.clone(), call, message }
    }

    fn nonsense(&mut self, call: &'static str) -> BorderError {
        self.dead = true;
        let what = format!("its process answered what was not asked; {APART}");
        BorderError::Rule { plugin: self.name.clone(), call, what }
    }
}

/// A library, as a process says that opened it behind the sandbox: no code of it runs in this one.
///
/// # Errors
/// The process cannot be started, or the library is refused there, crashes or hangs.
pub fn described(isolation: &Isolation, checked: &Checked) -> Result<Library, BorderError> {
    let path = checked.path();
    let name = path.file_name().map_or_else(String::new, |name| name.to_string_lossy().into_owned());
    let (plugins, _) = opened(isolation, path, checked.sha256(), &name, Vec::new())?;
    Ok(Library::elsewhere(checked, plugins))
}

/// What a library holds, and its process with the memory that this one writes and the one that it writes.
type Opened = (Vec<PluginInfo>, (Process, Memory, Memory));

fn opened(
    isolation: &Isolation,
    path: &std::path::Path,
    sha256: &str,
    name: &str,
    files: Vec<PathBuf>,
) -> Result<Opened, BorderError> {
    let refused = |reason: String| BorderError::Refused { path: path.to_owned(), reason };
    let start = || -> io::Result<(Process, Memory, Memory)> {
        let (input, output) = (Memory::new()?, Memory::new()?);
        Ok((Process::start(isolation, name, [&input, &output])?, input, output))
    };
    let cannot = |error: io::Error| refused(format!("cannot be opened in a process of its own: {error}"));
    let (mut process, input, output) = start().map_err(cannot)?;
    let ask = Ask::Open { path: path.to_owned(), sha256: sha256.to_owned(), files };
    process.limit = isolation.limit.min(OPENING);
    match process.ask(name, &ask, &[], 0) {
        Ok((Answer::Opened { plugins, lacking }, _)) => {
            process.limit = isolation.limit;
            if !lacking.is_empty() {
                tracing::warn!(plugin = name, "runs in a process of its own without {}", lacking.join(", "));
            }
            let info = |(kind, index, manifest)| PluginInfo { kind, index, manifest };
            Ok((plugins.into_iter().map(info).collect(), (process, input, output)))
        }
        Ok((Answer::Failed { message, .. }, _)) => Err(refused(message)),
        Ok(_) => Err(refused(format!("its process answered what was not asked; {APART}"))),
        Err(error) => {
            let why = process.why(&error);
            Err(refused(format!("{why}, where it was opened")))
        }
    }
}

/// A process and the socket to it.
#[derive(Debug)]
struct Process {
    child: Child,
    socket: Option<UnixStream>,
    limit: Duration,
    /// Closed when all that it has printed is told.
    told: Receiver<()>,
}

impl Process {
    fn start(isolation: &Isolation, name: &str, memories: [&Memory; 2]) -> io::Result<Self> {
        let (socket, its) = UnixStream::pair()?;
        let (printed, writer) = io::pipe()?;
        let mut command = Command::new(&isolation.program);
        command.args(&isolation.arguments).stdin(OwnedFd::from(its)).stdout(writer.try_clone()?).stderr(writer);
        // It needs nothing of the environment, and its terminal's signals are for this program.
        command.env_clear().process_group(0);
        // Batches come and go: the C library would give their memory back to the system each time, and ask again.
        command.env("MALLOC_TRIM_THRESHOLD_", "268435456").env("MALLOC_MMAP_THRESHOLD_", "33554432");
        if let Some(path) = std::env::var_os("LD_LIBRARY_PATH") {
            command.env("LD_LIBRARY_PATH", path);
        }
        let child = command.spawn()?;
        // Its ends of the pipe and the socket.
        drop(command);
        let (name, (sender, told)) = (name.to_owned(), channel());
        let tell = move || {
            tell_printed(&name, printed);
            drop::<std::sync::mpsc::Sender<()>>(sender);
        };
        // From here on the end of this value is the end of the process.
        let mut process = Self { child, socket: Some(socket), limit: isolation.limit, told };
        std::thread::Builder::new().spawn(tell)?;
        process.hand_over(memories)?;
        Ok(process)
    }

    /// Sends the shared memory with a first byte.
    fn hand_over(&mut self, memories: [&Memory; 2]) -> io::Result<()> {
        let socket = self.socket.as_ref().ok_or(io::ErrorKind::NotConnected)?;
        let descriptors = memories.map(Memory::descriptor);
        let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(2))];
        let mut control = SendAncillaryBuffer::new(&mut space);
        if !control.push(SendAncillaryMessage::ScmRights(&descriptors)) {
            return Err(io::Error::other("no space for two descriptors"));
        }
        sendmsg(socket, &[IoSlice::new(&[0])], &mut control, SendFlags::NOSIGNAL)?;
        Ok(())
    }

    /// Asks, hands on what is logged, and gives the answer.
    fn ask(&mut self, name: &str, ask: &Ask, bytes: &[u8], most: usize) -> io::Result<(Answer, Vec<u8>)> {
        let socket = self.socket.as_ref().ok_or(io::ErrorKind::NotConnected)?;
        let mut timed = Timed { socket, waited: Duration::ZERO, limit: self.limit };
        send(&mut timed, ask, bytes)?;
        // Each line is told at once, and none of them counts as the answer: there is an end to it.
        for _ in 0..=LOG_LINES + 1 {
            match receive(&mut timed, most)? {
                (Answer::Log { level, text }, _) => tell(name, level, &text),
                answer => return Ok(answer),
            }
        }
        Err(io::Error::other(format!("it logs more than {LOG_LINES} lines in one call")))
    }

    /// Why a message did not come through: how the process ended. One that lives is ended.
    fn why(&mut self, error: &io::Error) -> String {
        let late = matches!(error.kind(), io::ErrorKind::TimedOut);
        if late {
            let limit = self.limit.as_secs_f64();
            self.end(Duration::ZERO);
            return format!("did not come back within {limit} s; {APART}; --plugin-time-limit gives it longer");
        }
        let gone = matches!(
            error.kind(),
            io::ErrorKind::UnexpectedEof | io::ErrorKind::BrokenPipe | io::ErrorKind::ConnectionReset
        );
        match self.end(if gone { FAREWELL } else { Duration::ZERO }) {
            Some(status) if gone => format!("{}; {APART}", ended(status)),
            _ => format!("its process cannot be understood: {error}; {APART}"),
        }
    }

    /// Closes the socket, and waits for the end and the last words.
    fn end(&mut self, patience: Duration) -> Option<ExitStatus> {
        self.socket = None;
        let begun = Instant::now();
        let status = loop {
            match self.child.try_wait() {
                Ok(Some(status)) => break Some(status),
                Ok(None) if begun.elapsed() < patience => std::thread::sleep(Duration::from_millis(1)),
                _ => {
                    // What cannot be killed has ended.
                    let _ = self.child.kill();
                    break self.child.wait().ok();
                }
            }
        };
        // Where the kernel lacks a part of the sandbox, something that the plugin has started may hold the pipe.
        let _ = self.told.recv_timeout(LOOK);
        status
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        self.end(FAREWELL);
    }
}

/// A socket that gives up when the other side takes longer than allowed.
struct Timed<'a> {
    socket: &'a UnixStream,
    waited: Duration,
    limit: Duration,
}

impl Timed<'_> {
    fn within<R>(&mut self, work: impl Fn(Duration, &UnixStream) -> io::Result<R>) -> io::Result<R> {
        loop {
            let look = self.limit.saturating_sub(self.waited).clamp(Duration::from_millis(1), LOOK);
            let begun = Instant::now();
            let done = work(look, self.socket);
            // What comes counts too: a byte now and then is no answer.
            self.waited += begun.elapsed().min(2 * look);
            match done.map_err(|e| (e.kind(), e)) {
                Err((io::ErrorKind::WouldBlock | io::ErrorKind::TimedOut, _)) if self.waited >= self.limit => {
                    return Err(io::ErrorKind::TimedOut.into());
                }
                Err((io::ErrorKind::WouldBlock | io::ErrorKind::TimedOut | io::ErrorKind::Interrupted, _)) => {}
                done => return done.map_err(|(_, e)| e),
            }
        }
    }
}

impl Read for Timed<'_> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let pointer = std::cell::RefCell::new(buffer);
        self.within(|look, mut socket| {
            socket.set_read_timeout(Some(look))?;
            socket.read(&mut pointer.borrow_mut())
        })
    }
}

impl Write for Timed<'_> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.within(|look, mut socket| {
            socket.set_write_timeout(Some(look))?;
            socket.write(bytes)
        })
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// Logs a line of a plugin.
fn tell(plugin: &str, level: i32, text: &str) {
    // Bytes that are no UTF-8 have become three each.
    let text = if text.len() > 4 * LOG_BYTES { "a line that is too long, left out" } else { text };
    match level {
        abi::LOG_ERROR => tracing::error!(%plugin, "{text}"),
        abi::LOG_WARN => tracing::warn!(%plugin, "{text}"),
        abi::LOG_INFO => tracing::info!(%plugin, "{text}"),
        _ => tracing::debug!(%plugin, "{text}"),
    }
}

/// Tells what a process prints, its last words among it.
fn tell_printed(plugin: &str, pipe: io::PipeReader) {
    let mut lines = BufReader::new(pipe);
    for line in 0.. {
        let mut bytes = Vec::new();
        match lines.by_ref().take(LOG_BYTES as u64).read_until(b'\n', &mut bytes) {
            Ok(0) | Err(_) => return,
            // What is beyond is read all the same: a full pipe would stop it.
            Ok(_) if line > LOG_LINES => {}
            Ok(_) if line == LOG_LINES => tell(plugin, abi::LOG_WARN, &format!("printed more than {line} lines")),
            Ok(_) => tell(plugin, abi::LOG_WARN, String::from_utf8_lossy(&bytes).trim_end()),
        }
    }
}
