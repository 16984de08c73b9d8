//! The other computers of a rig in the status: a line for each, and one for what became of their parts.

use super::{RED, Style, refined};
use crate::{out, printable};
use depthrig_daemon::status::{
    HostState, HostStatus, HostsStatus, JoinState, MirrorState, MirrorStatus, PartStatus, SessionStatus,
};

/// The lines, without newlines.
pub(super) fn lines(status: &HostsStatus, style: Style) -> Vec<String> {
    let hosts = status.hosts.iter().flat_map(|h| {
        let mirrors = h.mirrors.iter().map(move |m| mirror(&h.host, m, style));
        let refined = h.refined.iter().map(move |r| match &r.refine {
            Some(refine) => refined(&r.camera, refine, None, style),
            None => format!("refined   {}: waits for its color and depth", printable::line(&r.camera)),
        });
        core::iter::once(host(h, style)).chain(mirrors).chain(refined)
    });
    hosts.chain(status.session.iter().flat_map(|s| session(s, style))).collect()
}

/// The fault of the clock of a host that answers; empty without one.
pub fn clock(host: &HostStatus) -> &'static str {
    if host.has_clock { "" } else { ", its clock is not known yet (UDP must pass to the address in listen)" }
}

fn host(host: &HostStatus, style: Style) -> String {
    let name = &host.host;
    let why = host.why.as_deref().map(printable::line).unwrap_or_default();
    match host.state {
        HostState::Absent => format!("host    {name}: {}: {why}", style.paint(RED, "absent")),
        HostState::Refused => format!("host    {name}: {}: {why}", style.paint(RED, "refused")),
        HostState::Connected => {
            let cameras =
                format!("{} of {} stream", host.streaming, out::count(host.cameras as u64, "camera"));
            let clock = clock(host);
            let recording = host.recording.as_deref().map(|r| format!(", recording {}", printable::line(r)));
            let recording = recording.unwrap_or_default();
            let trouble =
                if why.is_empty() { String::new() } else { format!("; {}", style.paint(RED, &why)) };
            format!("host    {name}: {cameras}{clock}{recording}{trouble}")
        }
    }
}

fn mirror(host: &str, mirror: &MirrorStatus, style: Style) -> String {
    let stream = &mirror.stream;
    if mirror.state == MirrorState::Waiting {
        let why = mirror.why.as_deref().map(|why| format!(": {}", style.paint(RED, &printable::line(why))));
        return format!("mirror  {stream}: waits for {host}{}", why.unwrap_or_default());
    }
    if mirror.state == MirrorState::Unread {
        return format!("mirror  {stream}: nobody here reads it");
    }
    let coding = mirror.coding.as_deref().unwrap_or_default();
    let skipped = if mirror.skipped == 0 { String::new() } else { format!(", {} left out", mirror.skipped) };
    format!("mirror  {stream}: {:.1} Hz from {host} as {}{skipped}", mirror.rate_hz, printable::line(coding))
}

fn session(session: &SessionStatus, style: Style) -> Vec<String> {
    let mut lines: Vec<_> = session.parts.iter().map(|p| part(p, style)).collect();
    let why = session.why.as_deref().map(printable::line).unwrap_or_default();
    match session.joined {
        JoinState::Waiting => {}
        JoinState::Joining => {
            lines.push(format!("joined  {} is being written", printable::line(&session.name)));
        }
        JoinState::Done => {
            let dataset = session.dataset.as_deref().unwrap_or_default();
            lines.push(format!("joined  {}, verified", printable::line(dataset)));
        }
        JoinState::Failed => {
            let failed = style.paint(RED, "not joined");
            lines.push(format!("joined  {}: {failed}: {why}", printable::line(&session.name)));
        }
    }
    lines
}

fn part(part: &PartStatus, style: Style) -> String {
    let name = printable::line(&part.name);
    let why = part.why.as_deref().map(|why| format!("; {}", style.paint(RED, &printable::line(why))));
    let why = why.unwrap_or_default();
    if part.is_complete {
        return format!("part    {name}: pulled and equal{why}");
    }
    let pulled = out::bytes(part.pulled_bytes);
    format!("part    {name}: {pulled} of {} pulled{why}", out::bytes(part.bytes))
}
