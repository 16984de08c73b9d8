//! The service of `depthrig install` under the real systemd, where the host has it: the permissions of its sandbox and its behaviour
//! not, how it ends, comes back after a crash, and stays away after a configuration that cannot work.

use crate::checks::Checks;
use crate::{Scenario, system};
use anyhow::{Context, ensure};
use depthrig_emulator::{Camera, Options};
use serde_json::Value;
use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command};
use std::time::Duration;

/// See the module.
pub const SCENARIO: Scenario = Scenario {
    name: "service",
    about: "the installed service under systemd: sandbox, a camera, a recording, stop, crash, bad configuration",
    cost: 9,
    limit_s: 120,
    needs: "",
    run,
};

const SYSTEMD: &str = "/bin/systemd";
const UDEVADM: &str = "/bin/udevadm";
const TIMEOUT: Duration = Duration::from_secs(20);
/// The user that the service runs as.
const USER: (&str, u32) = ("robot", 1000);
const DATA: &str = "/var/lib/depthrig";
const UNITS: &str = "/etc/systemd/system";
const UNIT: &str = "depthrig.service";
/// Targets of a Debian system that the service refers to; nothing else is started.
const TARGETS: [&str; 4] = ["basic.target", "sysinit.target", "shutdown.target", "time-sync.target"];

fn run(checks: &mut Checks) -> anyhow::Result<()> {
    if !Path::new(SYSTEMD).exists() || !Path::new(UDEVADM).exists() {
        checks
            .note("the host has no systemd (Debian packages systemd and udev), so the service was not tried");
        return Ok(());
    }
    system::modprobe("vhci-hcd", &[])?;
    system::modprobe("uvcvideo", &[])?;
    configure()?;
    rules()?;
    let _camera = Camera::plug("d435", Options::default())?;
    let six = || system::video_nodes().is_ok_and(|nodes| nodes.len() == 6);
    checks.that("six nodes", system::wait_until(TIMEOUT, six), "");
    system::run(Command::new(UDEVADM).args(["settle", "--timeout=10"]))?;

    let systemd = Systemd::start()?;
    systemd.control(&["start", UNIT])?;
    let status = systemd.streaming()?;
    checks.equal(
        "the camera streams to the user's own commands",
        &status["cameras"][0]["state"],
        "streaming",
    );
    checks.equal("the service is", systemd.show("ActiveState")?, "active");
    sandbox(checks, &systemd)?;

    let recording = systemd.depthrig(&["record", "start", "--name", "served", "--force", "--json"])?;
    let recorded = |n: u64| {
        wait_until(|| {
            systemd.status().is_ok_and(|s| s["recording"]["sets"].as_u64().is_some_and(|sets| sets >= n))
        })
    };
    checks.that("sets are recorded", recorded(5), &recording);
    // Below its root: `/run` is its own.
    let runtime = PathBuf::from(format!("/proc/{}/root/run/depthrig", systemd.pid));
    checks.that("it has a runtime folder", runtime.exists(), runtime.display());
    systemd.control(&["stop", UNIT])?;
    checks.equal("stopped, its result is", systemd.show("Result")?, "success");
    checks.equal("the runtime folder is gone", runtime.exists(), false);
    let dataset = PathBuf::from(DATA).join("datasets/served");
    checks.equal("whose the dataset is", fs::metadata(&dataset)?.uid(), USER.1);
    whole(checks, &systemd, "served")?;

    // A crash: it restarts by itself and finishes its recording.
    systemd.control(&["start", UNIT])?;
    systemd.streaming()?;
    systemd.depthrig(&["record", "start", "--name", "killed", "--force", "--json"])?;
    checks.that("more sets are recorded", recorded(5), "");
    systemd.control(&["kill", "--signal=KILL", UNIT])?;
    let back = || systemd.show("NRestarts").is_ok_and(|n| n == "1") && systemd.status().is_ok();
    checks.that("killed, it is started again", wait_until(back), "");
    systemd.streaming()?;
    let finished = || !Path::new(DATA).join("datasets/killed/seg_0000.mcap.part").exists();
    checks.that("and has finished what it left", system::wait_until(TIMEOUT, finished), "");
    whole(checks, &systemd, "killed")?;
    systemd.control(&["stop", UNIT])?;

    // Exit status 2: trying again would not help.
    fs::write(RIG_FILE, "rig = \"served\"\nunknown = 1\n")?;
    let _ = systemd.control(&["start", UNIT]);
    let failed = || systemd.show("ActiveState").is_ok_and(|state| state == "failed");
    checks.that("a bad configuration fails", wait_until(failed), "");
    checks.equal("with the status", systemd.show("ExecMainStatus")?, "2");
    std::thread::sleep(Duration::from_secs(3)); // RestartSec is 2
    checks.equal("and is not tried again", systemd.show("NRestarts")?, "0");
    Ok(())
}

const RIG_FILE: &str = "/etc/depthrig/rig.toml";

/// Users, the units of an empty system, the rig, and what `depthrig install` makes of it.
fn configure() -> anyhow::Result<()> {
    for folder in ["/etc/depthrig", UNITS, "/root", "/var/cache", "/home", "/var/log"] {
        fs::create_dir_all(folder)?;
    }
    let (name, id) = USER;
    fs::write("/etc/group", format!("root:x:0:\nvideo:x:44:\n{name}:x:{id}:\n"))?;
    fs::write("/etc/passwd", format!("root:x:0:0:root:/root:/bin/sh\n{name}:x:{id}:{id}::/home:/bin/sh\n"))?;
    fs::write("/etc/machine-id", "0123456789abcdef0123456789abcdef\n")?;
    for target in TARGETS {
        fs::write(Path::new(UNITS).join(target), format!("[Unit]\nDescription={target}\n"))?;
    }
    fs::write(
        RIG_FILE,
        format!(
            "rig = \"served\"\n[recording]\ndirectory = \"{DATA}/datasets\"\nallow = [\"/home/elsewhere\"]\nreserve_mb = 1\n[[camera]]\nname = \"d435\"\n\
             backend = \"realsense\"\n[[camera.stream]]\nname = \"depth\"\nwidth = 424\nheight = 240\nrate_hz = 15.0\n"
        ),
    )?;
    system::run(Command::new("depthrig").args(["install", "--apply", "--user", name]))?;
    // Only for the scenario's log.
    let beside = Path::new(UNITS).join("depthrig.service.d");
    fs::create_dir_all(&beside)?;
    fs::write(beside.join("log.conf"), "[Service]\nStandardOutput=append:/log\nStandardError=append:/log\n")?;
    Ok(())
}

/// udev, which gives cameras to the group `video`.
fn rules() -> anyhow::Result<()> {
    // One program under two names; another scenario of this boot may have made the second.
    if !Path::new("/bin/systemd-udevd").exists() {
        std::os::unix::fs::symlink(UDEVADM, "/bin/systemd-udevd")?;
    }
    system::run(Command::new("/bin/systemd-udevd").arg("--daemon"))?;
    Ok(())
}

/// Waits as `system::wait_until` does, asking less often: each question is a program that starts, which is slow here.
fn wait_until(mut done: impl FnMut() -> bool) -> bool {
    system::wait_until(TIMEOUT, || {
        std::thread::sleep(Duration::from_millis(250));
        done()
    })
}

/// Checks the permissions of the process.
fn sandbox(checks: &mut Checks, systemd: &Systemd) -> anyhow::Result<()> {
    let pid = served().context("the service has no process")?;
    let status = fs::read_to_string(format!("/proc/{pid}/status"))?;
    let field = |name: &str| -> String {
        let line = status.lines().find_map(|l| l.strip_prefix(name)?.strip_prefix(':'));
        line.unwrap_or_default().split_whitespace().next().unwrap_or_default().to_owned()
    };
    checks.equal("it runs as", field("Uid"), USER.1.to_string());
    checks.equal("its capabilities", field("CapBnd"), "0000000000000000");
    checks.equal("no new privileges", field("NoNewPrivs"), "1");
    checks.equal("its system calls are filtered", field("Seccomp"), "2");
    let mut real_time = 0;
    for task in fs::read_dir(format!("/proc/{pid}/task"))? {
        let stat = fs::read_to_string(task?.path().join("stat"))?;
        // After the name in parentheses the 39th is the policy (proc_pid_stat(5)); 1 is SCHED_FIFO.
        let after = stat.rsplit_once(')').map(|(_, rest)| rest).unwrap_or_default();
        real_time += u32::from(after.split_whitespace().nth(38) == Some("1"));
    }
    checks.that("its camera threads have real-time priority", real_time >= 1, real_time);
    // Below its root, because its mounts are its own.
    let inside = |path: &str| fs::write(format!("/proc/{pid}/root{path}/probe"), "");
    checks.that(
        "its own /tmp is not the system's",
        inside("/tmp").is_ok() && !Path::new("/tmp/probe").exists(),
        "",
    );
    let mounts = fs::read_to_string(format!("/proc/{pid}/mounts"))?;
    let read_only = |at: &str| {
        let mut options = mounts.lines().filter_map(|l| {
            let mut words = l.split(' ').skip(1);
            (words.next()? == at).then(|| words.nth(1)).flatten()
        });
        options.next_back().is_some_and(|o| o.split(',').any(|o| o == "ro"))
    };
    checks.that("the system is read-only for it", read_only("/"), "");
    for writable in ["/dev/shm", DATA] {
        let listed = mounts.lines().filter(|l| l.split(' ').nth(1) == Some(writable)).collect::<Vec<_>>();
        checks.that(&format!("{writable} is not"), !read_only(writable), listed.join("; "));
    }
    let elsewhere = systemd.depthrig(&["record", "start", "--out", "/home/elsewhere", "--force"]);
    let said = elsewhere.map_or_else(|e| format!("{e:#}"), |_| "it records".to_owned());
    let named = said.contains("/home/elsewhere") && said.to_lowercase().contains("read-only");
    checks.that("a recording elsewhere is refused with the reason", named, said);
    Ok(())
}

/// The process of the service, by its command line.
fn served() -> Option<u32> {
    let entries = fs::read_dir("/proc").ok()?;
    entries.flatten().find_map(|entry| {
        let pid = entry.file_name().to_str()?.parse().ok()?;
        let line = fs::read(entry.path().join("cmdline")).ok()?;
        let mut words = line.split(|b| *b == 0);
        let program = words.next()?.ends_with(b"/depthrig");
        (program && words.next()? == b"run").then_some(pid)
    })
}

/// `verify` has nothing against a dataset but what a crash may cost.
fn whole(checks: &mut Checks, systemd: &Systemd, name: &str) -> anyhow::Result<()> {
    let dataset = format!("{DATA}/datasets/{name}");
    let report = systemd.inside("depthrig", &["verify", "--decode", "--json", &dataset]).output()?;
    let text = String::from_utf8_lossy(&report.stdout);
    let report: Value = serde_json::from_str(&text).with_context(|| format!("verify {name}: {text}"))?;
    let sets = report["sets"].as_u64().unwrap_or_default();
    checks.that(&format!("\"{name}\" has its sets"), sets >= 4, sets);
    let broken: Vec<_> = report["findings"]
        .as_array()
        .into_iter()
        .flatten()
        .filter(|f| !matches!(f["severity"].as_str(), Some("note" | "lost")))
        .collect();
    checks.that(&format!("\"{name}\" is complete"), broken.is_empty(), format!("{broken:?}"));
    Ok(())
}

/// systemd as the first process of a world of its own: processes, mounts and control groups.
struct Systemd {
    unshare: Child,
    /// Its number outside.
    pid: u32,
}

impl Systemd {
    fn start() -> anyhow::Result<Self> {
        let script = "mount --make-rshared / 2>/dev/null; mount -t proc proc /proc; mount -t tmpfs run /run; \
                      mkdir -p /sys/fs/cgroup; mount -t cgroup2 cgroup2 /sys/fs/cgroup; \
                      exec env container=guest /bin/systemd --system --unit=basic.target --log-target=console \
                      --show-status=0 --default-standard-output=null";
        let mut command = Command::new("unshare");
        command.args(["-m", "-p", "-f", "/bin/sh", "-c", script]);
        let unshare = command.spawn().context("unshare")?;
        let mut systemd = Self { unshare, pid: 0 };
        let children = format!("/proc/{0}/task/{0}/children", systemd.unshare.id());
        let ready = wait_until(|| {
            let child = fs::read_to_string(&children).ok().and_then(|c| c.trim().parse().ok());
            systemd.pid = child.unwrap_or_default();
            systemd.pid != 0 && systemd.control(&["show"]).is_ok()
        });
        ensure!(ready, "systemd does not answer: {:?}", systemd.control(&["show"]));
        Ok(systemd)
    }

    /// A command in its world.
    fn inside(&self, program: &str, arguments: &[&str]) -> Command {
        let mut command = Command::new("nsenter");
        command.args(["-t", &self.pid.to_string(), "-m", "-p", program]).args(arguments);
        command
    }

    fn control(&self, arguments: &[&str]) -> anyhow::Result<String> {
        system::run(&mut self.inside("systemctl", arguments))
    }

    /// A property of the service.
    fn show(&self, property: &str) -> anyhow::Result<String> {
        let shown = self.control(&["show", "--value", "--property", property, UNIT])?;
        Ok(shown.trim().to_owned())
    }

    /// A command of depthrig's that the user gives who the service runs as.
    fn depthrig(&self, arguments: &[&str]) -> anyhow::Result<String> {
        let words = ["DEPTHRIG_RUNTIME_DIR=/run/depthrig", "depthrig"].iter().chain(arguments);
        let line: Vec<&str> = words.copied().collect();
        system::run(
            &mut self.inside("su", &["-s", "/bin/sh", USER.0, "-c", &format!("env {}", line.join(" "))]),
        )
    }

    fn status(&self) -> anyhow::Result<Value> {
        Ok(serde_json::from_str(&self.depthrig(&["status", "--json"])?)?)
    }

    /// Its status, once the camera streams.
    fn streaming(&self) -> anyhow::Result<Value> {
        let mut last = Err(anyhow::anyhow!("never asked"));
        let streams = wait_until(|| {
            last = self.status();
            last.as_ref().is_ok_and(|s| s["cameras"][0]["state"] == "streaming")
        });
        let log = fs::read_to_string("/log").unwrap_or_default();
        ensure!(streams, "the service does not stream: {last:?}; it said: {log}");
        last
    }
}

impl Drop for Systemd {
    fn drop(&mut self) {
        if self.pid == 0 {
            // It has not begun, or has ended; `kill 0` would end this scenario.
            let _ = self.unshare.kill();
        } else {
            let _ = system::run(Command::new("kill").args(["-9", &self.pid.to_string()]));
        }
        let _ = self.unshare.wait();
    }
}
