//! A socket on this computer that reaches one on another, carried by OpenSSH.
//!
//! OpenSSH proves who each side is, encrypts, and is on every computer of a lab with its keys and addresses already; depthrig only starts
//! `ssh` and starts it again. The user's `~/.ssh/config` and agent hold; a password is never asked for.

use crate::worker::Worker;
use core::time::Duration;
use depthrig_bus::{HostTime, sync::lock};
use std::io::{self, Read};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};

/// From one look at the process to the next.
const LOOK: Duration = Duration::from_millis(50);
/// The pause before `ssh` is started again, for a connection that was lost, and for a host that is away for long.
const PAUSES: [Duration; 2] = [Duration::from_millis(300), Duration::from_secs(3)];
/// A host without a connection for so long is away.
const AWAY: Duration = Duration::from_mins(5);
/// A connection that lasted so long was one.
const GOOD: Duration = Duration::from_secs(5);
/// Bytes of its messages that are kept.
const MAX_MESSAGE: u64 = 4096;
/// Prints the folder of the other user's rigs, by the rule of [`depthrig_bus::RuntimeDir::of_user`].
const FIND_FOLDER: &str = "d=$DEPTHRIG_RUNTIME_DIR; \
    if [ -z \"$d\" ] && [ -d \"$XDG_RUNTIME_DIR\" ]; then d=$XDG_RUNTIME_DIR/depthrig; fi; \
    printf %s \"${d:-/tmp/depthrig-$(id -u)}\"";
/// Options of all calls: no questions, a dead connection is noticed within three seconds, and none waits longer.
const OPTIONS: [&str; 10] = [
    "BatchMode=yes",
    "ConnectTimeout=2",
    "ServerAliveInterval=1",
    "ServerAliveCountMax=2",
    "ExitOnForwardFailure=yes",
    "StreamLocalBindUnlink=yes",
    "StreamLocalBindMask=0177",
    "ControlPath=none",
    "LogLevel=ERROR",
    // Before the one that OpenSSH takes first: processors have instructions for AES.
    "Ciphers=^aes128-gcm@openssh.com",
];

/// The socket on the other computer.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Remote {
    /// At this path.
    Path(PathBuf),
    /// Of this name in the folder of that user's rigs.
    InRuntimeDir(String),
}

/// Keeps the socket until this is dropped.
#[derive(Debug)]
pub struct Tunnel {
    why: Arc<Mutex<Option<String>>>,
    _thread: Worker,
}

impl Tunnel {
    /// Connects `local`, a path that is replaced, with `remote` on `destination`, as `ssh` names it: `user@address`, or a `Host` of the user's
    /// `~/.ssh/config`.
    ///
    /// # Errors
    /// When no thread can be started.
    pub fn start(destination: &str, local: &Path, remote: Remote) -> io::Result<Self> {
        let why = Arc::new(Mutex::new(None));
        let keeping = Keeping {
            destination: destination.to_owned(),
            local: local.to_owned(),
            remote,
            why: Arc::clone(&why),
        };
        Ok(Self { why, _thread: Worker::start("link_ssh", move |stop| keeping.run(stop))? })
    }

    /// Why there was no connection at the last try; `None` while there is one, or may be.
    pub fn why(&self) -> Option<String> {
        lock(&self.why).clone()
    }
}

struct Keeping {
    destination: String,
    local: PathBuf,
    remote: Remote,
    why: Arc<Mutex<Option<String>>>,
}

impl Keeping {
    fn run(mut self, stop: &AtomicBool) {
        let [lost, away] = PAUSES;
        let mut connected = HostTime::now();
        while !stop.load(Ordering::Relaxed) {
            let begun = HostTime::now();
            let ended = self.connect(stop);
            if begun.elapsed() > GOOD {
                connected = HostTime::now();
            }
            *lock(&self.why) = ended.err();
            let until = HostTime::now().plus(if connected.elapsed() > AWAY { away } else { lost });
            while !until.from_now().is_zero() && !stop.load(Ordering::Relaxed) {
                std::thread::sleep(LOOK);
            }
        }
        let _ = std::fs::remove_file(&self.local);
    }

    /// One connection, to its end; an error says why it ended.
    fn connect(&mut self, stop: &AtomicBool) -> Result<(), String> {
        let remote = match &self.remote {
            Remote::Path(path) => path.clone(),
            Remote::InRuntimeDir(name) => {
                let name = name.clone();
                let folder = self.ssh(&[], &format!("sh -c '{FIND_FOLDER}'"), stop)?;
                if !folder.starts_with('/') || folder.contains(['\n', ':']) {
                    let said = folder.lines().next().unwrap_or_default();
                    return Err(format!(
                        "{}: its login shell prints {said:?} before anything else; it must print nothing",
                        self.destination
                    ));
                }
                // What was found holds for the next connections, too.
                let path = Path::new(&folder).join(name);
                self.remote = Remote::Path(path.clone());
                path
            }
        };
        let forward = format!("{}:{}", self.local.display(), remote.display());
        // The other end reads until this process has gone, however it goes.
        self.ssh(&["-L", &forward], "cat", stop).map(drop)
    }

    /// Runs a command there; its output, or the last line of its errors.
    fn ssh(&self, options: &[&str], command: &str, stop: &AtomicBool) -> Result<String, String> {
        let mut child = spawn(&self.destination, options, command)?;
        let is_done = |child: &mut Child| !matches!(child.try_wait(), Ok(None));
        while !is_done(&mut child) {
            if stop.load(Ordering::Relaxed) {
                let _ = child.kill();
                let _ = child.wait();
                return Ok(String::new());
            }
            std::thread::sleep(LOOK);
        }
        let status = child.wait().map_err(|e| format!("ssh was lost: {e}"))?;
        if status.success() {
            return Ok(text(child.stdout.as_mut()));
        }
        Err(said(&self.destination, &text(child.stderr.as_mut())))
    }
}

/// Starts `command` on `destination`, with pipes to it.
pub(crate) fn spawn(destination: &str, options: &[&str], command: &str) -> Result<Child, String> {
    let mut ssh = Command::new("ssh");
    for option in OPTIONS {
        ssh.args(["-o", option]);
    }
    ssh.args(options).args(["-T", "--", destination, command]);
    ssh.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
    // Ctrl-C on a terminal is for this process, which has something to say to the other host before it ends.
    ssh.process_group(0);
    ssh.spawn().map_err(|e| match e.kind() {
        io::ErrorKind::NotFound => "ssh is not installed (apt install openssh-client)".to_owned(),
        _ => format!("ssh cannot be started: {e}"),
    })
}

/// The beginning of the text that comes out of a pipe, to its end.
pub(crate) fn text(pipe: Option<&mut impl Read>) -> String {
    let mut text = Vec::new();
    if let Some(pipe) = pipe {
        let _ = pipe.take(MAX_MESSAGE).read_to_end(&mut text);
    }
    String::from_utf8_lossy(&text).into_owned()
}

/// The last line of what `ssh` printed.
pub(crate) fn said(destination: &str, errors: &str) -> String {
    let line = errors.lines().map(str::trim).rfind(|line| !line.is_empty());
    format!("ssh {destination}: {}", line.unwrap_or("the connection ended"))
}
