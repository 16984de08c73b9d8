//! The ways to the other computers that record with this one, and their daemons.

use super::finding::{Finding, Severity};
use crate::client::Client;
use crate::config::{DepthCodec, HostConfig, LinkConfig, Reach, RecordingConfig, RigConfig};
use crate::hosts::reach;
use crate::recording::budget;
use crate::status::{CameraState, RigStatus, StreamStatus};
use crate::{Error, ErrorKind, Result};
use core::time::Duration;
use depthrig_bus::{HostTime, Name, PixelFormat, RuntimeDir, StreamId};
use depthrig_link::rates::{self, Rates};

/// Half of a mount of seven cameras at 5 Hz records about so much, bytes a second; a slower way delivers it after the session.
const PART_BYTES_S: f64 = 8e6;
/// A daemon has so long to answer, the start of `ssh` included, …
const ANSWER: Duration = Duration::from_secs(4);
/// … and is asked again after each.
const PAUSE: Duration = Duration::from_millis(100);

/// The way to another computer.
#[derive(Debug, Clone)]
pub struct Way {
    /// The computer.
    pub host: Name,
    /// As `ssh` names it, with the rates of the way, or the reason that nothing came through; `None` for a socket that something else connects.
    pub ssh: Option<(String, core::result::Result<Rates, String>)>,
    /// Status of the daemon there; `None` where it was not asked.
    pub daemon: Option<Result<RigStatus, (ErrorKind, String)>>,
}

/// Moves 5 MB each way between this computer and each of the others, and asks the daemons there.
pub(super) fn measure(config: &RigConfig, link: &LinkConfig, runtime: Option<&RuntimeDir>) -> Vec<Way> {
    let way = |host: &HostConfig| {
        let ssh = match &host.reach {
            Reach::Ssh { destination, .. } => Some((destination.clone(), rates::measure(destination))),
            Reach::Socket(_) => None,
        };
        let is_away = ssh.as_ref().is_some_and(|(_, rates)| rates.is_err());
        let daemon = runtime
            .filter(|_| !is_away)
            .map(|runtime| ask(config, host, runtime).map_err(|e| (e.kind(), e.to_string())));
        Way { host: host.name.clone(), ssh, daemon }
    };
    link.hosts.iter().map(way).collect()
}

/// The status of the daemon of `host`.
fn ask(config: &RigConfig, host: &HostConfig, runtime: &RuntimeDir) -> Result<RigStatus> {
    reach::link_socket(host, &config.rig, runtime)?;
    let tunnel = reach::tunnel(host, &config.rig, runtime)?;
    let client = Client::of_host(runtime, &config.rig, &host.name)?;
    let until = HostTime::now().plus(ANSWER);
    let mut answer = client.status();
    while answer.as_ref().is_err_and(|e| e.kind() == ErrorKind::Unreachable) && !until.from_now().is_zero() {
        std::thread::sleep(PAUSE);
        answer = client.status();
    }
    let why = tunnel.as_ref().and_then(depthrig_link::Tunnel::why);
    drop(tunnel);
    let _ = std::fs::remove_file(runtime.host_socket_path(&config.rig, &host.name));
    match (answer, why) {
        (Err(e), Some(why)) if e.kind() == ErrorKind::Unreachable => Err(Error::new(e.kind(), why)),
        (answer, _) => answer,
    }
}

/// Judges them.
pub(super) fn check(config: &RigConfig, ways: &[Way], findings: &mut Vec<Finding>) {
    for way in ways {
        let rates = match &way.ssh {
            Some((destination, Err(e))) => {
                let why = "it does not record when this computer does";
                let cure = format!(
                    "`ssh {destination} true` must work without a password: ssh-copy-id {destination}"
                );
                let what = format!("host {} is not reached: {e}", way.host);
                findings.push(Finding::new(Severity::Error, "host_unreachable", what, why, cure));
                continue;
            }
            Some((_, Ok(rates))) => {
                findings.push(rates_of(&way.host, rates));
                Some(rates)
            }
            None => None,
        };
        match &way.daemon {
            Some(Ok(status)) => {
                if let Some(finding) = daemon(config, &way.host, status) {
                    findings.push(finding);
                } else {
                    let hosts = config.link.iter().flat_map(|link| &link.hosts);
                    let wanted = hosts.filter(|host| host.name == way.host).flat_map(|host| &host.mirror);
                    findings.extend(mirrored(&way.host, wanted, status, rates));
                }
            }
            Some(Err((ErrorKind::Unreachable, e))) => {
                let what = format!("host {}: its daemon does not answer: {e}", way.host);
                let why =
                    "it records when it runs; until then its cameras and its version are not known here";
                let cure = format!("start it there: depthrig run RIG.toml, with rig = \"{}\"", config.rig);
                findings.push(Finding::new(Severity::Info, "host_silent", what, why, cure));
            }
            Some(Err((_, e))) => {
                let what = format!("host {}: {e}", way.host);
                let why = "it does not record when this computer does";
                let cure =
                    "install one version of depthrig on both computers, and start the daemon there again";
                findings.push(Finding::new(Severity::Error, "host_version", what, why, cure));
            }
            None => {}
        }
    }
}

fn rates_of(host: &Name, rates: &Rates) -> Finding {
    let what = format!(
        "host {host}: {:.0} MB/s from there, {:.0} MB/s to there, round trip {:.1} ms",
        rates.from_there / 1e6,
        rates.to_there / 1e6,
        rates.round_trip_us / 1e3
    );
    if rates.from_there < PART_BYTES_S {
        let why =
            "half of a mount at 5 Hz records about 8 MB/s: the rest of its part is pulled after the session";
        let cure = "connect both by cable, without Wi-Fi";
        return Finding::new(Severity::Warning, "host_slow", what, why, cure);
    }
    let why = "half of a mount at 5 Hz records about 8 MB/s: its part is pulled while it is recorded";
    Finding::new(Severity::Info, "host_reached", what, why, "nothing to do")
}

/// The reason that a daemon would be refused, or the cameras that it lacks.
fn daemon(config: &RigConfig, host: &Name, status: &RigStatus) -> Option<Finding> {
    let insecure = config.link.as_ref().is_some_and(|link| link.insecure);
    let is_here = |name: &String| config.cameras.iter().any(|camera| camera.name.as_str() == name);
    let names = || status.cameras.iter().map(|camera| &camera.name);
    let refused = reach::misfit(&config.rig, host, insecure, status)
        .or_else(|| names().find(|name| is_here(name)).map(|name| reach::taken(name, "this computer")));
    if let Some(what) = refused {
        let why = "its daemon is refused: it does not record when this computer does";
        let cure = "correct the rig file that the message names, and start the daemon of that computer again";
        return Some(Finding::new(
            Severity::Error,
            "host_refused",
            format!("host {host}: {what}"),
            why,
            cure,
        ));
    }
    let ill: Vec<_> = status.cameras.iter().filter(|camera| camera.state != CameraState::Streaming).collect();
    let names: Vec<&str> = ill.iter().map(|camera| camera.name.as_str()).collect();
    (!ill.is_empty()).then(|| {
        let what = format!(
            "host {host}: {} of {} cameras do not stream: {}",
            ill.len(),
            status.cameras.len(),
            names.join(", ")
        );
        let cure = format!("`depthrig status --host {host}` says why, once this rig runs");
        Finding::new(Severity::Warning, "host_cameras", what, "its part of a recording lacks them", cure)
    })
}

/// Holds the streams that come here live against the rate of the way.
fn mirrored<'a>(
    host: &Name,
    wanted: impl Iterator<Item = &'a StreamId>,
    status: &RigStatus,
    rates: Option<&Rates>,
) -> Vec<Finding> {
    let there: Vec<&StreamStatus> = status.cameras.iter().flat_map(|camera| &camera.streams).collect();
    let mut findings = Vec::new();
    let (mut raw, mut encoded) = (0.0, 0.0);
    for id in wanted {
        let id = id.to_string();
        let Some(stream) = there.iter().find(|stream| stream.id == id) else {
            let ids: Vec<_> = there.iter().map(|stream| stream.id.as_str()).collect();
            let what =
                format!("host {host} has no stream {id}, which is mirrored; it has {}", ids.join(", "));
            let cure = "correct mirror in the table of that computer in [[link.hosts]]";
            findings.push(Finding::new(
                Severity::Warning,
                "mirror_missing",
                what,
                "its subscribers get no frames",
                cure,
            ));
            continue;
        };
        let format = PixelFormat::ALL.into_iter().find(|format| format.name() == stream.format);
        let Some(format) = format.filter(|format| !format.is_motion()) else { continue };
        let bytes = format.frame_bytes(stream.width, stream.height);
        raw += bytes as f64 * stream.nominal_hz;
        let coded = RecordingConfig { depth: DepthCodec::Rank, ..RecordingConfig::default() };
        encoded += budget::bytes_per_s(core::iter::once((format, bytes)), stream.nominal_hz, &coded);
    }
    let Some(room) = rates.map(|rates| rates.from_there).filter(|_| raw > 0.0) else { return findings };
    let what = format!(
        "host {host}: its mirrored streams have {:.0} MB/s raw, about {:.0} MB/s encoded, the way carries {:.0} MB/s",
        raw / 1e6,
        encoded / 1e6,
        room / 1e6
    );
    findings.push(if encoded > room {
        let why = "frames are left out, and counted as skipped; recordings are not concerned";
        let cure = "mirror fewer streams or smaller ones, or connect both by a quicker cable";
        Finding::new(Severity::Warning, "mirror_slow", what, why, cure)
    } else {
        let why = if raw > room {
            "they come encoded, which costs both computers time"
        } else {
            "they fit as they are"
        };
        Finding::new(Severity::Info, "mirror_fits", what, why, "nothing to do")
    });
    findings
}
