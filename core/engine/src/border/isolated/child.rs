//! The process of a plugin: it opens a library behind the sandbox, and does what it is asked.

use rustix::event::{PollFd, PollFlags, poll};
use rustix::net::{RecvAncillaryBuffer, RecvAncillaryMessage, RecvFlags, recvmsg};
use std::fmt::{Debug, Write as _};
use std::io::{self, IoSliceMut};
use std::mem::MaybeUninit;
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;
use tracing::field::{Field, Visit};
use tracing::span::{Attributes, Id, Record};
use tracing::{Event, Level, Metadata, Subscriber};

use super::super::call::{Config, LinkRequest, Rows};
use super::super::library::{Checked, Library, PluginInfo};
use super::super::local::Local;
use super::super::{BorderError, exit_now};
use super::memory::Memory;
use super::message::{Answer, Ask, receive, send};
use super::sandbox;
use crate::limits::STATE_BYTES;
use crate::table::Batch;
use dragfree_abi as abi;

/// Time that `destroy` has after the parent has closed the socket.
const FAREWELL: Duration = Duration::from_secs(5);

/// Serves the process at the other end of stdin, which is a socket, until that closes it.
pub fn serve() -> ! {
    let code = match greeted() {
        Ok((socket, memories)) => {
            let serve = || {
                let forward = Forward { socket: socket.try_clone()?, spans: AtomicU64::new(1) };
                tracing::subscriber::with_default(Arc::new(forward), || Served::open(socket, memories)?.serve())
            };
            let ended = serve();
            u8::from(ended.is_err_and(|e| e.kind() != io::ErrorKind::UnexpectedEof))
        }
        Err(_) => 1,
    };
    exit_now(code)
}

/// The socket and the shared memory, which the first byte comes with: what the parent writes, and what we write.
fn greeted() -> io::Result<(UnixStream, [Memory; 2])> {
    let socket = UnixStream::from(io::stdin().as_fd().try_clone_to_owned()?);
    // A plugin that reads its stdin finds nothing there.
    rustix::stdio::dup2_stdin(std::fs::File::open("/dev/null")?)?;
    let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(2))];
    let mut control = RecvAncillaryBuffer::new(&mut space);
    recvmsg(&socket, &mut [IoSliceMut::new(&mut [0])], &mut control, RecvFlags::CMSG_CLOEXEC)?;
    let sent: Vec<OwnedFd> = control
        .drain()
        .filter_map(|message| match message {
            RecvAncillaryMessage::ScmRights(rights) => Some(rights),
            _ => None,
        })
        .flatten()
        .collect();
    let memories = <[OwnedFd; 2]>::try_from(sent).map_err(|_| io::Error::other("no shared memory came"))?;
    Ok((socket, memories.map(Memory::of)))
}

/// Ends this process soon after the parent has ended: a plugin that hangs would stay for ever.
fn watch(socket: &UnixStream) -> io::Result<()> {
    let socket = socket.try_clone()?;
    std::thread::Builder::new().spawn(move || {
        // An error tells as little as the end.
        let _ = poll(&mut [PollFd::new(&socket, PollFlags::RDHUP)], None);
        std::thread::sleep(FAREWELL);
        exit_now(1)
    })?;
    Ok(())
}

/// A library, its instance, and who asks.
struct Served {
    socket: UnixStream,
    opened: Library,
    instance: Option<Local>,
    /// Columns of each input table, beside the times.
    reads: Vec<usize>,
    input: Memory,
    output: Memory,
}

impl Served {
    /// Goes behind the sandbox and opens the library that the first message names.
    fn open(mut socket: UnixStream, [input, output]: [Memory; 2]) -> io::Result<Self> {
        let (Ask::Open { path, sha256, files }, _) = receive(&mut socket, 0)? else {
            return Err(io::Error::other("the first message opens nothing"));
        };
        let opened = open(&socket, &path, &sha256, &files);
        let (library, lacking) = match opened {
            Ok(opened) => opened,
            Err(error) => {
                send(&mut socket, &Answer::of(error), &[])?;
                return Err(io::ErrorKind::UnexpectedEof.into());
            }
        };
        let plugins = library.plugins.iter().map(|p| (p.kind, p.index, p.manifest.clone())).collect();
        send(&mut socket, &Answer::Opened { plugins, lacking }, &[])?;
        Ok(Self { socket, opened: library, instance: None, reads: Vec::new(), input, output })
    }

    fn serve(mut self) -> io::Result<()> {
        loop {
            let (ask, bytes) = receive(&mut self.socket, STATE_BYTES)?;
            let (answer, bytes) = self.answer(ask, &bytes)?;
            send(&mut self.socket, &answer, &bytes)?;
        }
    }

    fn answer(&mut self, ask: Ask, bytes: &[u8]) -> io::Result<(Answer, Vec<u8>)> {
        let answer = match ask {
            Ask::Process { rows, complete_until_ns } => self.process(&rows, complete_until_ns)?,
            Ask::Next { rows } => match self.instance()?.next(rows) {
                Ok(step) => self.rows(&step.batches, step.complete_until_ns, step.done)?,
                Err(error) => Answer::of(error),
            },
            Ask::Flush => match self.instance()?.flush() {
                Ok(batches) => self.rows(&batches, 0, false)?,
                Err(error) => Answer::of(error),
            },
            Ask::Report => {
                let earlier = String::from_utf8_lossy(bytes);
                return Ok(match self.instance()?.report(&earlier) {
                    Ok(report) => (Answer::Bytes(report.is_some()), report.unwrap_or_default()),
                    Err(error) => (Answer::of(error), Vec::new()),
                });
            }
            Ask::Save => {
                return Ok(match self.instance()?.save() {
                    Ok(state) => (Answer::Bytes(true), state),
                    Err(error) => (Answer::of(error), Vec::new()),
                });
            }
            Ask::Create { kind, index, config } => {
                let plugin = self.opened.plugins.iter().find(|p| p.kind == kind && p.index == index);
                let plugin: PluginInfo = plugin.cloned().ok_or_else(|| io::Error::other("there is no such plugin"))?;
                let created = Local::create(&self.opened, &plugin, &Config { value: config });
                created.map_or_else(Answer::of, |instance| {
                    self.instance = Some(instance);
                    Answer::Done
                })
            }
            Ask::Link { available, model_json } => {
                let request = LinkRequest { available: &available, model_json: &model_json };
                self.instance()?.link(request).map_or_else(Answer::of, |linked| {
                    self.reads = linked.reads.iter().map(Vec::len).collect();
                    Answer::Linked(linked)
                })
            }
            Ask::Activate { max_rows } => {
                self.instance()?.activate(max_rows).map_or_else(Answer::of, |()| Answer::Done)
            }
            Ask::Load => self.instance()?.load(bytes).map_or_else(Answer::of, |()| Answer::Done),
            Ask::Destroy => {
                self.instance = None;
                Answer::Done
            }
            Ask::Open { .. } => return Err(io::Error::other("a second library")),
        };
        Ok((answer, Vec::new()))
    }

    fn instance(&mut self) -> io::Result<&mut Local> {
        self.instance.as_mut().ok_or_else(|| io::Error::other("there is no instance"))
    }

    fn process(&mut self, rows: &[usize], complete_until_ns: i64) -> io::Result<Answer> {
        let sizes: Vec<_> = rows.iter().copied().zip(self.reads.iter().copied()).collect();
        let instance = self.instance.as_mut().ok_or_else(|| io::Error::other("there is no instance"))?;
        let mut columns = self.input.columns(&sizes)?;
        // SAFETY: the parent waits for the answer and does not write before it.
        let table = |(rows, count): &(usize, usize)| unsafe {
            Rows { time_ns: columns.lying(*rows), columns: (0..*count).map(|_| columns.lying(*rows)).collect() }
        };
        let tables: Vec<Rows<'_>> = sizes.iter().map(table).collect();
        match instance.process(&tables, complete_until_ns) {
            Ok(Some(batches)) => self.rows(&batches, 0, false),
            Ok(None) => Ok(Answer::Discarded),
            Err(error) => Ok(Answer::of(error)),
        }
    }

    fn rows(&mut self, batches: &[Batch], complete_until_ns: i64, done: bool) -> io::Result<Answer> {
        self.output.write(&batches.iter().flat_map(Batch::bytes).collect::<Vec<_>>())?;
        Ok(Answer::Rows { rows: batches.iter().map(Batch::rows).collect(), complete_until_ns, done })
    }
}

fn open(
    socket: &UnixStream,
    path: &Path,
    sha256: &str,
    files: &[PathBuf],
) -> Result<(Library, Vec<String>), BorderError> {
    let refused = |reason: String| BorderError::Refused { path: path.to_owned(), reason };
    let checked = Checked::new(path, None)?;
    if checked.sha256() != sha256 {
        return Err(refused("was changed since it was checked; try again when it is complete".to_owned()));
    }
    let lacking = sandbox::enter(path, files)
        .map_err(|error| refused(format!("its process cannot be limited in what it may do: {error}")))?;
    // Not before: the sandbox is that of a thread and of those that it starts.
    watch(socket).map_err(|error| refused(format!("nobody would see that its parent has ended: {error}")))?;
    Ok((Library::load(checked)?, lacking))
}

/// Hands on what is logged.
struct Forward {
    socket: UnixStream,
    spans: AtomicU64,
}

impl Subscriber for Forward {
    fn enabled(&self, _: &Metadata<'_>) -> bool {
        true
    }

    fn new_span(&self, _: &Attributes<'_>) -> Id {
        Id::from_u64(self.spans.fetch_add(1, Ordering::Relaxed).max(1))
    }

    fn event(&self, event: &Event<'_>) {
        let mut text = Message::default();
        event.record(&mut text);
        let level = match *event.metadata().level() {
            Level::ERROR => abi::LOG_ERROR,
            Level::WARN => abi::LOG_WARN,
            Level::INFO => abi::LOG_INFO,
            _ => abi::LOG_DEBUG,
        };
        // Where nobody listens any more, the next answer says so.
        let _ = send(&mut &self.socket, &Answer::Log { level, text: text.0 }, &[]);
    }

    fn record(&self, _: &Id, _: &Record<'_>) {}
    fn record_follows_from(&self, _: &Id, _: &Id) {}
    fn enter(&self, _: &Id) {}
    fn exit(&self, _: &Id) {}
}

/// The message of an event; the plugin's name the parent knows.
#[derive(Default)]
struct Message(String);

impl Visit for Message {
    fn record_debug(&mut self, field: &Field, value: &dyn Debug) {
        if field.name() == "message" {
            let _ = write!(self.0, "{value:?}"); // a text takes all
        }
    }
}
