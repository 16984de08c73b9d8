//! The way to the daemon of another computer, and reasons to refuse what answers there.

use crate::config::{HostConfig, Reach};
use crate::status::RigStatus;
use crate::{Error, ErrorKind, Result};
use depthrig_bus::{Name, RigName, RuntimeDir};
use depthrig_link::{Remote, Tunnel};

/// Makes the link to a socket that something else connects; what lay in its place is removed.
///
/// # Errors
/// `Other` when the link cannot be made.
pub fn link_socket(host: &HostConfig, rig: &RigName, runtime: &RuntimeDir) -> Result<()> {
    let here = runtime.host_socket_path(rig, &host.name);
    let _ = std::fs::remove_file(&here);
    let Reach::Socket(path) = &host.reach else { return Ok(()) };
    std::os::unix::fs::symlink(path, &here).map_err(|e| {
        let what = format!("host {}: {} cannot be made: {e}", host.name, here.display());
        Error::new(ErrorKind::Other, what).with_source(e)
    })
}

/// Connects its control socket with [`RuntimeDir::host_socket_path`] for as long as the tunnel lives; `None` where something else does.
///
/// # Errors
/// `Other` when no thread can be started.
pub fn tunnel(host: &HostConfig, rig: &RigName, runtime: &RuntimeDir) -> Result<Option<Tunnel>> {
    let Reach::Ssh { destination, socket } = &host.reach else { return Ok(None) };
    let here = runtime.host_socket_path(rig, &host.name);
    let remote = match socket {
        Some(path) => Remote::Path(path.clone()),
        None => Remote::InRuntimeDir(format!("{rig}.sock")),
    };
    let tunnel = Tunnel::start(destination, &here, remote).map_err(|e| {
        Error::new(ErrorKind::Other, format!("no thread for host {}: {e}", host.name)).with_source(e)
    })?;
    Ok(Some(tunnel))
}

/// The reason that a daemon with this status is not computer `name` of `rig`; `None` if it is. `insecure` is what the rig file of this
/// computer has in `[link]`.
pub fn misfit(rig: &RigName, name: &Name, insecure: bool, status: &RigStatus) -> Option<String> {
    if status.rig != rig.as_str() {
        return Some(format!("its rig is \"{}\"; write rig = \"{rig}\" into its rig file", status.rig));
    }
    let Some(link) = &status.link else {
        return Some(
            "its rig file has no [link], so that its clock is unknown; write the table there".to_owned(),
        );
    };
    if link.host != name.as_str() {
        return Some(format!(
            "its name is \"{}\"; write host = \"{name}\" into [link] of its rig file",
            link.host
        ));
    }
    if link.recorder.is_none() {
        return Some("its rig file has listen in [link]; a session has one computer with listen".to_owned());
    }
    if link.insecure != insecure {
        return Some(
            "only one of both has insecure = true in [link]; write it into both rig files, or into neither"
                .to_owned(),
        );
    }
    None
}

/// The reason to refuse a camera of this name, which is taken by `place`.
pub fn taken(camera: &str, place: &str) -> String {
    format!("camera \"{camera}\" is a name on {place}, too; give one of them another name")
}
