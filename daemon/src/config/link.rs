//! The table `[link]`: the part of this computer in a rig of several.

use super::read::{FromToml, Section};
use super::{HostConfig, LinkConfig, LinkRole, Reach, refine};
use depthrig_bus::{Name, StreamId};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};

/// The table of refined depth of a host's cameras.
const REFINE: &str = "[link.hosts.refine]";

/// Reads the table; `None` without one, and after a problem was noted.
pub(super) fn read(top: &Section<'_, '_>, base: &Path) -> Option<LinkConfig> {
    let s = top.table("link", "[link]");
    if !top.has("link") {
        return None;
    }
    let host = s.required::<Name>("host", "\"left\"");
    let role = role(&s);
    let insecure = s.or("insecure", false, |_| Ok(()));
    let hosts = hosts(&s, base, host.as_ref().map(|h| &h.value), role);
    s.finish();
    Some(LinkConfig { host: host?.value, role: role?, insecure, hosts: hosts? })
}

/// The other computers; `None` after a problem was noted.
fn hosts(
    link: &Section<'_, '_>,
    base: &Path,
    own: Option<&Name>,
    role: Option<LinkRole>,
) -> Option<Vec<HostConfig>> {
    let mut hosts: Vec<HostConfig> = Vec::new();
    let mut is_good = true;
    for mut s in link.tables("hosts", "[[link.hosts]]")? {
        let name = s.required::<Name>("name", "\"left\"");
        if let Some(name) = &name {
            s.set_name(name.value.as_str());
            if hosts.iter().any(|h| h.name == name.value) || own == Some(&name.value) {
                is_good = false;
                s.problem(
                    name.at,
                    format!("host \"{}\" is named twice; each computer has a name of its own", name.value),
                );
            }
        }
        if matches!(role, Some(LinkRole::Camera(_))) {
            is_good = false;
            let what = "[[link.hosts]] goes with listen, into the rig file of the computer that records the session; this one has recorder";
            s.problem(s.at, what);
        }
        let reach = reach(&s);
        let mirror = mirror(&s);
        let refine = refine::read(&s, base, &[], "depth", REFINE);
        let at = s.at;
        s.finish();
        match (name, reach, mirror) {
            (Some(name), Some(reach), Some(mirror)) => {
                let host = HostConfig { name: name.value, reach, mirror, refine };
                check_refined(link, at, &host);
                hosts.push(host);
            }
            _ => is_good = false,
        }
    }
    is_good.then_some(hosts)
}

/// Refined depth needs streams to be made from, and a name that no mirrored stream has.
fn check_refined(link: &Section<'_, '_>, at: usize, host: &HostConfig) {
    let Some(refine) = &host.refine else { return };
    let depth = &refine.depth;
    let cameras = host.refined_cameras(depth);
    let taken =
        |id: &&StreamId| cameras.contains(&id.camera) && refine::COMPUTED.contains(&id.stream.as_str());
    let what = if cameras.is_empty() {
        format!(
            "{REFINE} needs a camera's color and {depth} in mirror, such as mirror = [\"wrist/color\", \"wrist/{depth}\"]"
        )
    } else if let Some(id) = host.mirror.iter().find(taken) {
        format!("{id} comes from there by mirror and from {REFINE}; remove one of the two")
    } else {
        return;
    };
    link.problem(at, what);
}

/// Streams whose frames come from there; `None` after a problem was noted.
fn mirror(s: &Section<'_, '_>) -> Option<Vec<StreamId>> {
    let Some(streams) = s.get::<Vec<StreamId>>("mirror") else {
        return (!s.has("mirror")).then(Vec::new);
    };
    let twice = streams.value.iter().enumerate().find(|(i, id)| streams.value[..*i].contains(id));
    if let Some((_, id)) = twice {
        s.problem(streams.at, format!("mirror names {id} twice"));
        return None;
    }
    Some(streams.value)
}

fn reach(s: &Section<'_, '_>) -> Option<Reach> {
    let ssh = s.get::<String>("ssh");
    let socket = s.get::<PathBuf>("socket");
    if let Some(path) = &socket
        && !path.value.is_absolute()
    {
        s.problem(path.at, "socket must be a path that begins with /");
        return None;
    }
    let socket = socket.map(|path| path.value);
    match (ssh, socket) {
        (Some(ssh), socket) => {
            let destination = ssh.value;
            if destination.is_empty()
                || destination.starts_with('-')
                || destination.contains(char::is_whitespace)
            {
                let what = format!(
                    "ssh must be \"user@address\", or a Host of ~/.ssh/config; it is \"{destination}\""
                );
                s.problem(ssh.at, what);
                return None;
            }
            Some(Reach::Ssh { destination, socket })
        }
        (None, Some(path)) => Some(Reach::Socket(path)),
        (None, None) if s.has("ssh") || s.has("socket") => None,
        (None, None) => {
            s.problem(s.at, "[[link.hosts]] needs the key ssh, such as ssh = \"lab@10.0.0.2\"");
            None
        }
    }
}

fn role(s: &Section<'_, '_>) -> Option<LinkRole> {
    let asks = s.get::<SocketAddr>("recorder");
    let answers = s.get::<SocketAddr>("listen");
    let problem = match (asks, answers) {
        (Some(at), None) => return Some(LinkRole::Camera(at.value)),
        (None, Some(at)) => return Some(LinkRole::Recorder(at.value)),
        // A value that cannot be read was noted.
        (None, None) if s.has("recorder") || s.has("listen") => return None,
        (Some(_), Some(_)) => "has both \"recorder\" and \"listen\"; keep one",
        (None, None) => "has neither \"recorder\" nor \"listen\"",
    };
    let what = format!(
        "[link] {problem}: the computer whose clock is that of the session has listen = \"ADDRESS:PORT\", an address of its \
         own, and each other one names it, recorder = \"ADDRESS:PORT\""
    );
    s.problem(s.at, what);
    None
}

impl FromToml for SocketAddr {
    fn from_toml(value: &toml::de::DeValue<'_>) -> Result<Self, String> {
        let text = String::from_toml(value)?;
        let wrong =
            || format!("must be an IP address and a port such as \"10.0.0.1:7447\"; it is \"{text}\"");
        text.parse().map_err(|_| wrong())
    }
}
