//! Everything that a camera can do wrong, to one of three under the daemon: it ends in the named state with a message
//! that says what to do, it streams again when the fault is over, and the camera on the other hub never notices.

use crate::checks::Checks;
use crate::daemon::{Daemon, drops};
use crate::subject::plug;
use crate::{Scenario, system};
use anyhow::Context;
use depthrig_daemon::status::{CameraState, CameraStatus, RigStatus};
use depthrig_emulator::{Camera, Damage, Fault, Hub, Options, Speed, WrongReply};
use std::time::Duration;

/// See the module.
pub const SCENARIO: Scenario = Scenario {
    name: "faults",
    about: "every fault of an emulated D435 under the daemon: the state it ends in, what is said, and that it comes back",
    cost: 23,
    limit_s: 240,
    needs: "",
    run,
};

/// The camera that is hurt, one on the same hub, and one on another.
const NAMES: [&str; 3] = ["victim", "neighbour", "witness"];
const TIMEOUT: Duration = Duration::from_secs(10);
const AWAY: Duration = Duration::from_millis(600);
/// More wrong replies than an opening asks for, with all its retries.
const MANY: u32 = 10_000;
/// Opcodes: a calibration table, a group of advanced mode that is written, a sync mode that is set.
const TABLE: u32 = 0x15;
const SET_GROUP: u32 = 0x2B;
const SET_SYNC: u32 = 0x69;
/// Preset that the victim gets at every opening.
const PRESET: &str = "/tmp/preset.json";

struct Bench {
    cameras: Vec<Camera>,
    daemon: Daemon,
}

fn run(checks: &mut Checks) -> anyhow::Result<()> {
    system::modprobe("vhci-hcd", &[])?;
    system::modprobe("uvcvideo", &[])?;
    let mut cameras = Vec::new();
    for hub in [0, 0, 1] {
        cameras.push(plug("d435", Options { hub, ..Options::default() })?);
    }
    std::fs::write(PRESET, r#"{ "name": "wide census", "groups": { "census_radius": [9, 9] } }"#)?;
    let rig = "[supervisor]\nstall_s = 0.5\nbackoff_min_s = 0.1\nbackoff_max_s = 0.5\n".to_owned();
    let tables = cameras.iter().zip(NAMES).map(|(camera, name)| {
        // The slowest that a D435 has for those that only show that they stream.
        let rate_hz = if name == NAMES[0] { 15 } else { 6 };
        table_at(name, camera.serial(), 424, 240, rate_hz)
    });
    let tables = with(&tables.collect::<String>(), &format!("preset = \"{PRESET}\""));
    let daemon = Daemon::start(&(rig + &tables))?;
    daemon.wait_until_streaming()?;
    let bench = Bench { cameras, daemon };
    bench.streams_that_end(checks)?;
    bench.frames_that_are_lost(checks)?;
    bench.controls(checks)?;
    bench.openings(checks)?;
    bench.hub(checks)?;
    let witness = bench.camera("witness")?;
    checks.equal("the camera on the other hub has lost nothing", drops(&witness), "");
    checks.equal("and was never opened again", witness.reconnects, 0);
    let late =
        |c: &Camera| -> anyhow::Result<u64> { Ok(c.accounts("depth")?.late + c.accounts("color")?.late) };
    for (camera, name) in bench.cameras.iter().zip(NAMES) {
        checks.note(format!("the emulator was late for {} frames of the {name}", late(camera)?));
    }
    bench.daemon.stop()?;
    usb2(checks)
}

/// First line of a stream's table.
const STREAM: &str = "[[camera.stream]]";

/// The first camera of `tables` with another key.
fn with(tables: &str, key: &str) -> String {
    tables.replacen(STREAM, &format!("{key}\n{STREAM}"), 1)
}

fn table(name: &str, serial: &str, width: u32, height: u32) -> String {
    table_at(name, serial, width, height, 15)
}

fn table_at(name: &str, serial: &str, width: u32, height: u32, rate_hz: u32) -> String {
    let stream = |stream: &str| {
        format!("{STREAM}\nname = \"{stream}\"\nwidth = {width}\nheight = {height}\nrate_hz = {rate_hz}.0\n")
    };
    let head = format!("[[camera]]\nname = \"{name}\"\nbackend = \"realsense\"\nserial = \"{serial}\"\n");
    head + &stream("depth") + &stream("color")
}

fn of<'a>(status: &'a RigStatus, name: &str) -> anyhow::Result<&'a CameraStatus> {
    status.cameras.iter().find(|c| c.name == name).with_context(|| format!("no camera {name} in the status"))
}

/// Why a wait was in vain; empty when it was not.
fn message(found: &anyhow::Result<RigStatus>) -> String {
    found.as_ref().err().map_or(String::new(), ToString::to_string)
}

/// Whether a message contains each of these words, regardless of case.
fn says(message: Option<&String>, words: &[&str]) -> bool {
    let message = message.map(|m| m.to_lowercase()).unwrap_or_default();
    words.iter().all(|word| message.contains(word))
}

impl Bench {
    fn victim(&self) -> &Camera {
        &self.cameras[0]
    }

    fn camera(&self, name: &str) -> anyhow::Result<CameraStatus> {
        of(&self.daemon.status()?, name).cloned()
    }

    /// The victim comes into a state with a message.
    fn ends_in(
        &self,
        checks: &mut Checks,
        fault: &str,
        state: CameraState,
        words: &[&str],
    ) -> anyhow::Result<()> {
        let what = format!("{fault}: {} with a message that says {words:?}", state.name());
        let there = |s: &RigStatus| {
            of(s, "victim").is_ok_and(|c| c.state == state && says(c.message.as_ref(), words))
        };
        let found = self.daemon.wait_for(TIMEOUT, &what, there);
        let now = self.camera("victim")?;
        let detail = format!("{}: {}", now.state.name(), now.message.unwrap_or_default());
        match found {
            Ok(status) => {
                let message = of(&status, "victim")?.message.clone();
                checks.that(&what, true, message.unwrap_or_default());
            }
            Err(_) => drop(checks.that(&what, false, detail)),
        }
        Ok(())
    }

    /// A camera streams, and goes on to.
    fn streams_again(&self, checks: &mut Checks, fault: &str, name: &str) -> anyhow::Result<()> {
        let delivered = |c: &CameraStatus| c.streams.iter().map(|s| s.delivered).collect::<Vec<_>>();
        let before = delivered(&self.camera(name)?);
        let more = |s: &RigStatus| {
            of(s, name).is_ok_and(|c| {
                c.state == CameraState::Streaming
                    && c.message.is_none()
                    && delivered(c).iter().zip(&before).all(|(now, before)| *now > before + 2)
            })
        };
        let found = self.daemon.wait_for(TIMEOUT, "it streams again", more);
        checks.that(&format!("{fault}: the {name} streams again"), found.is_ok(), message(&found));
        Ok(())
    }

    /// Faults that end a stream.
    fn streams_that_end(&self, checks: &mut Checks) -> anyhow::Result<()> {
        use CameraState::{Reconnecting, Stalled};
        self.victim().unplug()?;
        self.ends_in(checks, "unplugged", Reconnecting, &["no realsense", self.victim().serial()])?;
        self.victim().replug()?;
        self.streams_again(checks, "plugged in again", "victim")?;

        for fault in [Fault::Silence, Fault::Nak] {
            let name = fault.name();
            self.victim().fault(fault)?;
            self.ends_in(checks, name, Stalled, &["no frame"])?;
            self.ends_in(checks, name, Reconnecting, &["opened again"])?;
            self.victim().fault(Fault::Clear)?;
            self.streams_again(checks, name, "victim")?;
        }
        // Colour goes on: the camera as a whole is not silent.
        self.victim().fault(Fault::StallEndpoint { stream: "depth".into() })?;
        self.ends_in(checks, "stall-endpoint", Stalled, &["no frame of depth"])?;
        self.ends_in(checks, "stall-endpoint", Reconnecting, &["depth", "opened again"])?;
        self.streams_again(checks, "stall-endpoint", "victim")?;

        self.victim().fault(Fault::Restart)?;
        self.ends_in(checks, "restart", Reconnecting, &["d435"])?;
        self.streams_again(checks, "restart", "victim")
    }

    /// Damaged frames cost those frames, each counted with a reason, and nothing else.
    fn frames_that_are_lost(&self, checks: &mut Checks) -> anyhow::Result<()> {
        const FRAMES: u32 = 3;
        let before = self.camera("victim")?.reconnects;
        for damage in [Damage::ErrorBit, Damage::Short, Damage::Long, Damage::Skip, Damage::Repeat] {
            let fault = Fault::Frames { stream: "depth".into(), damage, frames: FRAMES };
            let name = fault.name();
            // A frame that is missing shows as a gap of the device's own counter, whatever became of it.
            let gaps = |c: &CameraStatus| {
                let depth = c.streams.iter().find(|s| s.id.ends_with("depth"));
                depth.and_then(|d| d.dropped.get("device_gap").copied()).unwrap_or(0)
            };
            let earlier = gaps(&self.camera("victim")?);
            self.victim().fault(fault)?;
            let enough =
                |s: &RigStatus| of(s, "victim").is_ok_and(|c| gaps(c) >= earlier + u64::from(FRAMES));
            let seen = self.daemon.wait_for(TIMEOUT, name, enough);
            self.streams_again(checks, name, "victim")?;
            let now = self.camera("victim")?;
            let lost = gaps(&now) - earlier;
            checks.that(
                &format!("{name}: exactly those frames are dropped and counted"),
                seen.is_ok() && lost == u64::from(FRAMES),
                format!("{lost} of {FRAMES}; all so far: {}", drops(&now)),
            );
        }
        for fault in [Fault::ClockJump(-2_000_000), Fault::ClockReset] {
            let name = fault.name();
            self.victim().fault(fault)?;
            self.streams_again(checks, name, "victim")?;
        }
        let now = self.camera("victim")?;
        checks.equal("none of that has the camera opened again", now.reconnects, before);
        Ok(())
    }

    /// Controls that do not answer do not stop the stream.
    fn controls(&self, checks: &mut Checks) -> anyhow::Result<()> {
        let before = self.camera("victim")?;
        self.victim().fault(Fault::ControlTimeout(Duration::from_secs(6)))?;
        std::thread::sleep(Duration::from_secs(7));
        self.victim().fault(Fault::ControlStall { times: 3 })?;
        std::thread::sleep(Duration::from_secs(1));
        let after = self.camera("victim")?;
        checks.equal("no frame is lost while controls do not answer", drops(&after), drops(&before).as_str());
        checks.equal("and the camera stays open", after.reconnects, before.reconnects);
        self.victim().fault(Fault::Clear)?;
        self.streams_again(checks, "control-timeout", "victim")
    }

    /// Openings that fail.
    fn openings(&self, checks: &mut Checks) -> anyhow::Result<()> {
        use CameraState::Reconnecting;
        let wrong = [
            (WrongReply::Opcode, "opcode"),
            (WrongReply::Code(-7), "not ready"),
            (WrongReply::Garbage, "reply"),
        ];
        for (wrong, word) in wrong {
            self.victim().unplug()?;
            self.victim().fault(Fault::Reply { wrong, to: None, times: MANY })?;
            self.victim().replug()?;
            self.ends_in(checks, &format!("reply {wrong:?}"), Reconnecting, &[word, "d435"])?;
            self.victim().fault(Fault::Clear)?;
            self.streams_again(checks, &format!("reply {wrong:?}"), "victim")?;
        }
        self.a_table_that_comes_wrong_once(checks)?;
        self.a_preset_that_is_refused(checks)?;
        self.no_answer_to_an_opening(checks)
    }

    /// One wrong reply in place of a calibration table is not the end of a camera: the table is read again.
    fn a_table_that_comes_wrong_once(&self, checks: &mut Checks) -> anyhow::Result<()> {
        for wrong in [WrongReply::Code(-1), WrongReply::Truncated] {
            let what = format!("table {wrong:?} once");
            let readings = || self.victim().asked().iter().filter(|a| a.opcode == TABLE).count();
            let before = readings();
            let opened = self.camera("victim")?.reconnects;
            self.victim().unplug()?;
            self.victim().fault(Fault::Reply { wrong, to: Some(TABLE), times: 1 })?;
            self.victim().replug()?;
            let back = |s: &RigStatus| of(s, "victim").is_ok_and(|c| c.reconnects > opened);
            let found = self.daemon.wait_for(TIMEOUT, &what, back);
            checks.that(&format!("{what}: the victim comes back"), found.is_ok(), message(&found));
            self.streams_again(checks, &what, "victim")?;
            checks.equal(&format!("{what}: two tables were read in three readings"), readings() - before, 3);
        }
        Ok(())
    }

    /// A camera that refuses its preset does not stream with another one.
    fn a_preset_that_is_refused(&self, checks: &mut Checks) -> anyhow::Result<()> {
        let what = "preset refused";
        self.victim().unplug()?;
        self.victim().fault(Fault::Reply {
            wrong: WrongReply::Code(-6),
            to: Some(SET_GROUP),
            times: MANY,
        })?;
        self.victim().replug()?;
        let words =
            ["preset \"wide census\"", "census_radius", "code -6", "leave it out", self.victim().serial()];
        self.ends_in(checks, what, CameraState::Reconnecting, &words)?;
        self.victim().fault(Fault::Clear)?;
        self.streams_again(checks, what, "victim")?;
        let asked = self.victim().asked();
        let last = asked.iter().rfind(|a| a.opcode == SET_GROUP).map(|a| a.data.clone());
        checks.equal("and it got its preset again", last, Some(vec![9, 0, 0, 0, 9, 0, 0, 0]));
        Ok(())
    }

    /// A camera that answers no control while it is opened.
    fn no_answer_to_an_opening(&self, checks: &mut Checks) -> anyhow::Result<()> {
        let what = "control-timeout at opening";
        // It stays on the bus, or the kernel's driver would wait before anybody else could.
        self.victim().fault(Fault::ControlTimeout(Duration::from_secs(20)))?;
        self.victim().fault(Fault::Silence)?;
        self.ends_in(checks, what, CameraState::Reconnecting, &["opened again"])?;
        self.ends_in(
            checks,
            what,
            CameraState::Reconnecting,
            &["did not answer", "plug it in anew", "d435"],
        )?;
        self.victim().fault(Fault::Clear)?;
        self.streams_again(checks, what, "victim")
    }

    /// A hub that resets takes all its cameras along, and they come back.
    fn hub(&self, checks: &mut Checks) -> anyhow::Result<()> {
        let before = self.camera("neighbour")?.reconnects;
        checks.equal("cameras on the hub", Hub::reset(&self.cameras, 0, AWAY)?, 2);
        self.ends_in(checks, "hub reset", CameraState::Reconnecting, &["d435"])?;
        for name in ["victim", "neighbour"] {
            self.streams_again(checks, "hub reset", name)?;
        }
        checks.equal("the neighbour came back once", self.camera("neighbour")?.reconnects, before + 1);
        // A table that is damaged for good; last, because a camera that failed is not opened again.
        self.victim().unplug()?;
        self.victim().fault(Fault::DamagedTable(25))?;
        self.victim().replug()?;
        self.ends_in(checks, "damaged-table", CameraState::Failed, &["checksum", "allow_uncalibrated"])
    }
}

/// Openings that cannot work: at USB 2, a mode of USB 3; a unit without calibration.
fn usb2(checks: &mut Checks) -> anyhow::Result<()> {
    let slow = plug("d435", Options { speed: Speed::High, ..Options::default() })?;
    let raw = plug("d435", Options::default())?;
    raw.fault(Fault::Uncalibrated)?;
    // Half a GVD is enough; half a table is not.
    let cut = plug("d435", Options::default())?;
    cut.fault(Fault::Reply { wrong: WrongReply::Truncated, to: None, times: MANY })?;
    // A setting that this unit says it has not.
    let alone = plug("d435", Options::default())?;
    alone.fault(Fault::Reply { wrong: WrongReply::Code(-58), to: Some(SET_SYNC), times: MANY })?;
    let fine = plug("d435", Options::default())?;
    let rig = table("fine", fine.serial(), 424, 240)
        + &table("slow", slow.serial(), 848, 480)
        + &table("raw", raw.serial(), 424, 240)
        + &table("cut", cut.serial(), 424, 240)
        + &with(&table("alone", alone.serial(), 424, 240), "sync = \"master\"");
    // Settings that cannot work end the start, however good the other cameras are: better now than after an hour.
    let (code, said) = Daemon::refused(&rig)?;
    checks.equal("the daemon does not start", code, Some(2));
    let reasons = said.rsplit("cameras cannot work:").next().unwrap_or_default();
    let port = slow.port_path().context("it has a port")?;
    for (name, words) in [
        ("slow", vec!["no such mode", port.as_str()]),
        ("raw", vec!["calibrat", "allow_uncalibrated"]),
        ("cut", vec!["checksum", "asked 3 times", "vendor's calibration tool"]),
        ("alone", vec!["does not support it (code -58)", "Choose another", alone.serial()]),
    ] {
        let line = reasons.lines().find(|l| l.contains(&format!("camera \"{name}\""))).unwrap_or_default();
        let holds = words.iter().all(|w| line.contains(w));
        checks.that(&format!("{name} is named, with a message that says {words:?}"), holds, line);
    }
    checks.that("the one that works is not named", !reasons.contains("\"fine\""), "");
    Ok(())
}
