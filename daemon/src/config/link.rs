//! The table `[link]`: the part of this computer in a rig of several.

use super::read::{FromToml, Section};
use super::{LinkConfig, LinkRole};
use depthrig_bus::Name;
use std::net::SocketAddr;

/// Reads the table; `None` without one, and after a problem was noted.
pub(super) fn read(top: &Section<'_, '_>) -> Option<LinkConfig> {
    let s = top.table("link", "[link]");
    if !top.has("link") {
        return None;
    }
    let host = s.required::<Name>("host", "\"left\"");
    let role = role(&s);
    let insecure = s.or("insecure", false, |_| Ok(()));
    if let Some(LinkRole::Camera(address) | LinkRole::Recorder(address)) = role
        && !address.ip().is_loopback()
        && !insecure
    {
        let what = format!(
            "{address} is reached over a network, and packets of the clock are neither encrypted nor signed: whoever can send \
             from that address can shift the times; if the network is your own, write insecure = true in [link]"
        );
        s.problem(s.at, what);
    }
    s.finish();
    Some(LinkConfig { host: host?.value, role: role? })
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
