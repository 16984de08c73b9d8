//! The daemon under test: the ordinary `depthrig run`, as a process of its own, and the client of its API.

use anyhow::{Context, bail, ensure};
use depthrig_bus::{HostTime, RigName, RuntimeDir};
use depthrig_daemon::client::Client;
use depthrig_daemon::control::RecordRequest;
use depthrig_daemon::status::{CameraState, CameraStatus, RecordingStatus, RigStatus};
use rustix::process::{Pid, Signal, kill_process};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus};
use std::time::Duration;

/// The name of every rig here.
pub const RIG: &str = "vm";
/// How long a daemon may take to start or to end, guest time.
const TIMEOUT: Duration = Duration::from_secs(30);

/// A daemon that runs. Dropped, it is killed.
pub struct Daemon {
    child: Child,
    client: Client,
    /// Its runtime folder.
    pub runtime: RuntimeDir,
}

impl Daemon {
    /// Starts a daemon for the cameras of `cameras` (`[[camera]]` tables), which records below [`datasets`], and waits
    /// until it answers.
    ///
    /// # Errors
    /// When it ends at once or never answers; the scenario's log has its output.
    pub fn start(cameras: &str) -> anyhow::Result<Self> {
        let (mut command, runtime) = Self::command(cameras)?;
        let child = command.spawn().context("depthrig run")?;
        let mut daemon = Starting(Some(child));
        let rig = RigName::new(RIG)?;
        let end = HostTime::now().plus(TIMEOUT);
        loop {
            if let Some(status) = daemon.child()?.try_wait()? {
                bail!("the daemon ended at once: {status}");
            }
            match Client::connect(&runtime, Some(&rig)) {
                Ok(client) => {
                    let child = daemon.0.take().context("the daemon was taken already")?;
                    return Ok(Self { child, client, runtime });
                }
                Err(error) if HostTime::now() >= end => {
                    return Err(error).context("the daemon never answered");
                }
                Err(_) => std::thread::sleep(Duration::from_millis(20)),
            }
        }
    }

    /// Runs a daemon that must refuse to start. Returns its exit status and its message.
    ///
    /// # Errors
    /// When it cannot be run.
    pub fn refused(cameras: &str) -> anyhow::Result<(Option<i32>, String)> {
        let output = Self::command(cameras)?.0.output().context("depthrig run")?;
        Ok((output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned()))
    }

    fn command(cameras: &str) -> anyhow::Result<(Command, RuntimeDir)> {
        let text = format!(
            "rig = \"{RIG}\"\n\
             [recording]\ndirectory = \"{}\"\ncolor = \"raw\"\nreserve_mb = 1\nmin_minutes = 0\n{cameras}",
            datasets().display()
        );
        let folder = Path::new("/tmp/rig");
        std::fs::create_dir_all(folder)?;
        let file = folder.join("rig.toml");
        std::fs::write(&file, text)?;
        let runtime = RuntimeDir::at(&folder.join("run"))?;
        let mut command = Command::new("depthrig");
        command.args(["run", "--json", "--runtime-dir"]).arg(runtime.path()).arg(&file);
        Ok((command, runtime))
    }

    /// Its complete status.
    ///
    /// # Errors
    /// When it does not answer.
    pub fn status(&self) -> anyhow::Result<RigStatus> {
        Ok(self.client.status()?)
    }

    /// Waits until `holds` for a status, and returns that one; the caller measures the time it took.
    ///
    /// # Errors
    /// When it does not within `limit`, with how the cameras stand.
    pub fn wait_for(
        &self,
        limit: Duration,
        what: &str,
        mut holds: impl FnMut(&RigStatus) -> bool,
    ) -> anyhow::Result<RigStatus> {
        let end = HostTime::now().plus(limit);
        loop {
            let status = self.status()?;
            if holds(&status) {
                return Ok(status);
            }
            ensure!(HostTime::now() < end, "{what}: not within {limit:?}; {}", summary(&status));
            // A status costs the guest's one processor milliseconds, on both sides.
            std::thread::sleep(Duration::from_millis(40));
        }
    }

    /// Waits until every camera streams and every stream has delivered a frame.
    ///
    /// # Errors
    /// As [`Self::wait_for`].
    pub fn wait_until_streaming(&self) -> anyhow::Result<RigStatus> {
        self.wait_for(TIMEOUT, "every camera streams", |status| status.cameras.iter().all(streams))
    }

    /// Waits until every camera streams and has captured a dozen frames of each stream. Its first frames come while others
    /// still open and the guest is busy: the next frames count those that are not read then.
    ///
    /// # Errors
    /// As [`Self::wait_for`].
    pub fn wait_until_settled(&self) -> anyhow::Result<RigStatus> {
        let settled = |c: &CameraStatus| streams(c) && c.streams.iter().all(|s| s.captured >= 12);
        self.wait_for(TIMEOUT, "a dozen frames of every stream", |s| s.cameras.iter().all(settled))
    }

    /// Starts a recording called `name`.
    ///
    /// # Errors
    /// When the daemon refuses.
    pub fn record(&self, name: &str) -> anyhow::Result<PathBuf> {
        let request = RecordRequest {
            name: Some(name.into()),
            scene: "vm".into(),
            force: true,
            ..RecordRequest::default()
        };
        Ok(self.client.record_start(&request)?.path.into())
    }

    /// Ends the recording.
    ///
    /// # Errors
    /// When the daemon refuses.
    pub fn record_stop(&self) -> anyhow::Result<RecordingStatus> {
        Ok(self.client.record_stop()?)
    }

    /// Sends it a signal.
    ///
    /// # Errors
    /// When it has ended.
    pub fn signal(&self, signal: Signal) -> anyhow::Result<()> {
        let pid = Pid::from_raw(self.child.id() as i32).context("a process has a number")?;
        kill_process(pid, signal).context("the daemon cannot be signalled")
    }

    /// Ends it with SIGTERM; how it ended, and how long that took.
    ///
    /// # Errors
    /// When it does not end.
    pub fn stop(mut self) -> anyhow::Result<(ExitStatus, Duration)> {
        let started = HostTime::now();
        self.signal(Signal::TERM)?;
        let end = started.plus(TIMEOUT);
        while HostTime::now() < end {
            if let Some(status) = self.child.try_wait()? {
                return Ok((status, started.elapsed()));
            }
            std::thread::sleep(Duration::from_millis(10));
        }
        bail!("the daemon did not end within {TIMEOUT:?} of SIGTERM")
    }

    /// Kills it, as a crash would.
    ///
    /// # Errors
    /// When it has ended already.
    pub fn kill(mut self) -> anyhow::Result<()> {
        self.signal(Signal::KILL)?;
        self.child.wait()?;
        Ok(())
    }
}

impl Drop for Daemon {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// A daemon that does not answer yet; killed when it is given up.
struct Starting(Option<Child>);

impl Starting {
    fn child(&mut self) -> anyhow::Result<&mut Child> {
        self.0.as_mut().context("the daemon was taken already")
    }
}

impl Drop for Starting {
    fn drop(&mut self) {
        if let Some(child) = &mut self.0 {
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}

/// Where daemons record: in the guest's memory.
pub fn datasets() -> PathBuf {
    PathBuf::from("/tmp/rig/datasets")
}

/// Whether a camera streams and every stream of it has delivered.
pub fn streams(camera: &CameraStatus) -> bool {
    camera.state == CameraState::Streaming && camera.streams.iter().all(|s| s.delivered > 0)
}

/// The cameras of a status in a line.
pub fn summary(status: &RigStatus) -> String {
    let camera = |c: &CameraStatus| {
        let message = c.message.as_ref().map(|m| format!(" ({m})")).unwrap_or_default();
        let frames = c
            .streams
            .iter()
            .map(|s| format!(" {} {}", s.id.rsplit('/').next().unwrap_or_default(), s.captured));
        format!("{} {}{message}:{}", c.name, c.state.name(), frames.collect::<String>())
    };
    status.cameras.iter().map(camera).collect::<Vec<_>>().join(", ")
}

/// The frames that streams of `camera` have dropped, by reason, in a line; empty when none.
pub fn drops(camera: &CameraStatus) -> String {
    let mut drops = Vec::new();
    for stream in &camera.streams {
        drops.extend(stream.dropped.iter().map(|(reason, n)| format!("{} {reason} {n}", stream.id)));
    }
    drops.join(", ")
}
