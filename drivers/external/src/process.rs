//! A process that the daemon starts itself, such as that of a camera: start, restart, and end with its whole group.
#![allow(unsafe_code)] // `pre_exec` runs between fork and exec, where only some calls are allowed

use super::log;
use core::sync::atomic::{AtomicBool, Ordering};
use core::time::Duration;
use depthrig_bus::sync::lock;
use depthrig_bus::{HostTime, umask};
use depthrig_driver::{Error, ErrorKind, Result};
use rustix::process::{Pid, Signal, kill_process_group};
use std::ffi::OsString;
use std::os::unix::process::CommandExt;
use std::path::PathBuf;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::mpsc::{SyncSender, sync_channel};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;

/// First pause before a process that ended is started again; it doubles up to the second.
const FIRST_PAUSE: Duration = Duration::from_millis(500);
const LONGEST_PAUSE: Duration = Duration::from_secs(30);
/// A process that ran for so long was in order; the pause begins anew.
const GOOD_RUN: Duration = Duration::from_mins(1);
/// How long it may take to end when it is asked to.
const GRACE: Duration = Duration::from_millis(500);
const LOOK: Duration = Duration::from_millis(20);

/// The process of a camera, if the daemon runs it.
pub(super) type SharedKeeper = Option<Arc<Mutex<Keeper>>>;

/// A program, and how it is started.
#[derive(Debug, Clone)]
pub struct Program {
    /// Whose it is, in the log.
    pub owner: Owner,
    /// The program, with its arguments.
    pub command: Vec<String>,
    /// Where it runs.
    pub directory: PathBuf,
    /// Variables of its environment, beside those of this process.
    pub environment: Vec<(&'static str, OsString)>,
}

/// Whose program it is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Owner {
    /// That of a camera of this name.
    Camera(String),
    /// One of the rig.
    Rig(&'static str),
}

impl Owner {
    fn name(&self) -> &str {
        match self {
            Self::Camera(name) => name,
            Self::Rig(name) => name,
        }
    }

    fn camera(&self) -> Option<&str> {
        matches!(self, Self::Camera(_)).then(|| self.name())
    }

    fn program(&self) -> Option<&str> {
        matches!(self, Self::Rig(_)).then(|| self.name())
    }
}

/// Keeps one process running. Dropping it ends the process.
#[derive(Debug)]
pub struct Keeper {
    program: Program,
    running: Option<Running>,
    pause: Duration,
    not_before: HostTime,
    last_end: Option<String>,
}

/// A process and the thread that waits for it. The thread lives as long as the process, because the kernel ends the
/// process with the thread that started it.
#[derive(Debug)]
struct Running {
    pid: u32,
    since: HostTime,
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

#[derive(Debug, Default)]
struct Shared {
    stop: AtomicBool,
    kill: AtomicBool,
    ended: Mutex<Option<String>>,
}

impl Shared {
    fn ended(&self) -> Option<String> {
        lock(&self.ended).clone()
    }
}

impl Keeper {
    /// One that has started nothing yet.
    pub const fn new(program: Program) -> Self {
        Self { program, running: None, pause: FIRST_PAUSE, not_before: HostTime::from_ns(0), last_end: None }
    }

    /// The number of the process, if it runs.
    pub fn pid(&self) -> Option<u32> {
        self.running.as_ref().filter(|r| r.shared.ended().is_none()).map(|r| r.pid)
    }

    /// Starts the process unless it runs.
    ///
    /// # Errors
    /// [`ErrorKind::NotFound`] while it pauses before the next try, saying how it ended; [`ErrorKind::BadInput`] when
    /// the program does not exist.
    pub fn ensure(&mut self) -> Result<()> {
        self.notice_end();
        if self.running.is_some() {
            return Ok(());
        }
        let left = self.not_before.from_now();
        if !left.is_zero() {
            let end = self.last_end.as_deref().unwrap_or("ended");
            return Err(Error::new(
                ErrorKind::NotFound,
                format!("its process {end}; it is started again in {:.1} s", left.as_secs_f64()),
            ));
        }
        self.running = Some(self.start()?);
        Ok(())
    }

    /// Kills a process that does not do what it must; [`Self::ensure`] starts it again.
    pub fn kill(&mut self, why: &str) {
        let Some(running) = &self.running else { return };
        let owner = &self.program.owner;
        tracing::warn!(
            camera = owner.camera(),
            program = owner.program(),
            pid = running.pid,
            "the process is killed: {why}"
        );
        running.shared.kill.store(true, Ordering::Relaxed);
        let deadline = HostTime::now().plus(GRACE);
        while running.shared.ended().is_none() && !deadline.from_now().is_zero() {
            std::thread::sleep(LOOK);
        }
        self.notice_end();
    }

    /// Takes note of an end: how, and when to start again.
    fn notice_end(&mut self) {
        let Some(end) = self.running.as_ref().and_then(|r| r.shared.ended()) else { return };
        let Some(mut running) = self.running.take() else { return };
        if let Some(thread) = running.thread.take() {
            let _ = thread.join();
        }
        if running.since.elapsed() > GOOD_RUN {
            self.pause = FIRST_PAUSE;
        }
        let owner = &self.program.owner;
        tracing::warn!(
            camera = owner.camera(),
            program = owner.program(),
            pid = running.pid,
            "its process {end}"
        );
        self.not_before = HostTime::now().plus(self.pause);
        self.pause = (self.pause * 2).min(LONGEST_PAUSE);
        self.last_end = Some(end);
    }

    fn start(&self) -> Result<Running> {
        let shared = Arc::new(Shared::default());
        let (report, reported) = sync_channel(1);
        let program = self.program.clone();
        let theirs = Arc::clone(&shared);
        let thread = std::thread::Builder::new()
            .name(format!("proc-{}", self.program.owner.name()))
            .spawn(move || keep(&program, &theirs, &report))
            .map_err(|e| Error::new(ErrorKind::Io, "no thread for its process").with_source(e))?;
        let Program { owner, command, directory, .. } = &self.program;
        let program = command.first().map_or("", String::as_str);
        let pid = reported
            .recv()
            .map_err(|e| {
                Error::new(ErrorKind::Io, format!("\"{program}\" could not be started")).with_source(e)
            })?
            .map_err(|e| {
                use std::io::ErrorKind as Io;
                let kind = match e.kind() {
                    Io::NotFound | Io::PermissionDenied | Io::NotADirectory => ErrorKind::BadInput,
                    _ => ErrorKind::Io,
                };
                let place = directory.display();
                Error::new(kind, format!("\"{program}\" of `command` could not be started in {place}: {e}"))
                    .with_source(e)
            })?;
        tracing::info!(camera = owner.camera(), program = owner.program(), pid, "started \"{program}\"");
        Ok(Running { pid, since: HostTime::now(), shared, thread: Some(thread) })
    }
}

impl Drop for Keeper {
    fn drop(&mut self) {
        let Some(mut running) = self.running.take() else { return };
        running.shared.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = running.thread.take() {
            let _ = thread.join();
        }
    }
}

/// The thread of a process: starts it, waits for its end, ends it when asked to.
fn keep(program: &Program, shared: &Shared, report: &SyncSender<std::io::Result<u32>>) {
    let mut child = match spawn(program) {
        Ok(child) => child,
        Err(e) => {
            let _ = report.send(Err(e));
            return;
        }
    };
    let pid = child.id();
    copy_output(&mut child, &program.owner, pid);
    let _ = report.send(Ok(pid));
    let mut term_until = None;
    let end = loop {
        match child.try_wait() {
            Ok(Some(status)) => break describe(status),
            Ok(None) => {}
            Err(e) => break format!("cannot be waited for ({e})"),
        }
        let stop = shared.stop.load(Ordering::Relaxed);
        let overdue = term_until.is_some_and(|t: HostTime| t.from_now().is_zero());
        if shared.kill.load(Ordering::Relaxed) || overdue {
            signal(pid, Signal::KILL);
        } else if stop && term_until.is_none() {
            signal(pid, Signal::TERM);
            term_until = Some(HostTime::now().plus(GRACE));
        }
        std::thread::sleep(LOOK);
    };
    // Processes that it left behind in its group would keep the camera.
    signal(pid, Signal::KILL);
    *lock(&shared.ended) = Some(end);
}

fn signal(pid: u32, signal: Signal) {
    if let Some(group) = i32::try_from(pid).ok().and_then(Pid::from_raw) {
        // The group does not exist: all of it has ended.
        let _ = kill_process_group(group, signal);
    }
}

fn describe(status: ExitStatus) -> String {
    use std::os::unix::process::ExitStatusExt;
    match (status.code(), status.signal()) {
        (Some(code), _) => format!("ended with exit code {code}"),
        (None, Some(signal)) => format!("was killed by signal {signal}"),
        (None, None) => "ended".to_owned(),
    }
}

fn spawn(program: &Program) -> std::io::Result<Child> {
    let Program { command, directory, environment, .. } = program;
    let (program, arguments) = command.split_first().ok_or(std::io::ErrorKind::InvalidInput)?;
    let daemon = std::process::id();
    let mut command = Command::new(program);
    command
        .args(arguments)
        .current_dir(directory)
        .envs(environment.iter().map(|(name, value)| (name, value)))
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .process_group(0);
    let end_with_daemon = move || {
        rustix::process::set_parent_process_death_signal(Some(Signal::KILL))?;
        // Sockets of iceoryx2 are not closed by exec; a camera's process would keep the daemon's open after its end.
        // Older kernels lack the call, and inherit them as before. SAFETY: it takes numbers alone, and marks
        // descriptors of this process, which is about to call exec.
        unsafe { libc::close_range(3, libc::c_uint::MAX, libc::CLOSE_RANGE_CLOEXEC.cast_signed()) };
        // The daemon may have ended before that call; nobody would send the signal then.
        let parent = rustix::process::getppid().map(|p| p.as_raw_nonzero().get().cast_unsigned());
        if parent == Some(daemon) { Ok(()) } else { Err(std::io::ErrorKind::Interrupted.into()) }
    };
    // SAFETY: between fork and exec the closure makes three system calls and neither allocates nor takes a lock; an
    // error without a message allocates nothing either.
    unsafe { command.pre_exec(end_with_daemon) };
    // It inherits the umask.
    let _steady = umask::steady();
    command.spawn()
}

/// Threads that bring what the process prints into the log; they end with its output.
fn copy_output(child: &mut Child, owner: &Owner, pid: u32) {
    let out = child.stdout.take().map(|o| Box::new(o) as Box<dyn std::io::Read + Send>);
    let err = child.stderr.take().map(|e| Box::new(e) as Box<dyn std::io::Read + Send>);
    for pipe in [out, err].into_iter().flatten() {
        let of_thread = owner.clone();
        let copy = move || {
            log::copy(pipe, |line| {
                tracing::info!(camera = of_thread.camera(), program = of_thread.program(), pid, "{line}");
            });
        };
        if let Err(e) = std::thread::Builder::new().name(format!("log-{}", owner.name())).spawn(copy) {
            let (camera, program) = (owner.camera(), owner.program());
            tracing::warn!(camera, program, error = %e, "what its process prints cannot be read");
        }
    }
}

/// A process that does not answer is killed, if it is the daemon's.
pub(super) fn kill(keeper: &SharedKeeper, why: &str) {
    if let Some(keeper) = keeper {
        lock(keeper).kill(why);
    }
}

/// A message that ends with what can be done.
pub(super) fn stalled(kind: ErrorKind, keeper: &SharedKeeper, pid: u32, what: &str) -> Error {
    let cure = if keeper.is_some() {
        "it is killed and started again".to_owned()
    } else {
        format!("if it hangs, end it (kill -9 {pid}) and start it again")
    };
    Error::new(kind, format!("its process {pid} {what}; {cure}"))
}
