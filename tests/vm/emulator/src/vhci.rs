//! The kernel's virtual host controller (`vhci-hcd`): finds a free port and hands it our end of a socket pair.

use crate::{Error, Result, Speed};
use rustix::net::{AddressFamily, SocketFlags, SocketType, socketpair};
use std::os::fd::AsRawFd;
use std::os::unix::net::UnixStream;
use std::path::PathBuf;
use std::time::Duration;

const CONTROLLERS: u32 = 8;
/// `VDEV_ST_NULL`: nothing is attached, and nothing is being detached.
const FREE: &str = "004";
/// Enough for two frames, so that a writer seldom waits for the kernel's reader.
const SEND_BUFFER: usize = 4 << 20;

/// A port of a controller, as its status file has it.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Port {
    speed: Speed,
    number: u32,
    free: bool,
    /// The name of the device that is on it in sysfs, once it has one.
    device: Option<String>,
}

fn file(controller: u32) -> PathBuf {
    let root = "/sys/devices/platform/vhci_hcd.0/status";
    if controller == 0 { root.into() } else { format!("{root}.{controller}").into() }
}

fn parse(status: &str) -> Vec<Port> {
    let line = |line: &str| {
        let words: Vec<&str> = line.split_whitespace().collect();
        let speed = match *words.first()? {
            "hs" => Speed::High,
            "ss" => Speed::Super,
            _ => return None,
        };
        let device = words.get(6).filter(|name| **name != "0-0").map(|name| (*name).to_owned());
        Some(Port { speed, number: words.get(1)?.parse().ok()?, free: *words.get(2)? == FREE, device })
    };
    status.lines().filter_map(line).collect()
}

fn ports(controller: u32) -> Result<Vec<Port>> {
    let path = file(controller);
    let text = std::fs::read_to_string(&path).map_err(|e| {
        Error::new(format!("{}: {e}; is the module vhci-hcd loaded (modprobe vhci-hcd)?", path.display()))
    })?;
    Ok(parse(&text))
}

/// The name in sysfs of the device on a port (`2-1`), once the kernel has given it one.
pub(crate) fn device_on(port: u32) -> Option<String> {
    (0..CONTROLLERS).map_while(|hub| ports(hub).ok()).flatten().find(|p| p.number == port)?.device
}

/// Attaches a device to a port of controller `hub`: to `wanted`, or else to the first that is free. Returns the socket
/// to serve it on.
///
/// # Errors
/// Without the module, without the right to use it, or when no port becomes free within two seconds.
pub(crate) fn attach(hub: u32, speed: Speed, wanted: Option<u32>) -> Result<(UnixStream, u32)> {
    let mut last = Error::new(format!("controller {hub} of vhci-hcd has no free port"));
    for _ in 0..400 {
        let found = ports(hub)?
            .into_iter()
            .find(|p| p.free && p.speed == speed && wanted.is_none_or(|wanted| wanted == p.number));
        if let Some(port) = found {
            match attach_to(port.number, speed) {
                Ok(socket) => return Ok((socket, port.number)),
                // Somebody else was quicker, or the port is still being cleared.
                Err(error) => last = error,
            }
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    Err(last)
}

fn attach_to(port: u32, speed: Speed) -> Result<UnixStream> {
    let failed = |what: &str, e: rustix::io::Errno| Error::new(format!("{what}: {e}"));
    let (ours, theirs) = socketpair(AddressFamily::UNIX, SocketType::STREAM, SocketFlags::CLOEXEC, None)
        .map_err(|e| failed("no socket pair", e))?;
    for socket in [&ours, &theirs] {
        rustix::net::sockopt::set_socket_send_buffer_size_force(socket, SEND_BUFFER)
            .map_err(|e| failed("the socket's buffer cannot be set (are you root?)", e))?;
    }
    let code = if speed == Speed::Super { 5 } else { 3 };
    let line = format!("{port} {} {} {code}\n", theirs.as_raw_fd(), 0x1_0000 + port + 1);
    std::fs::write("/sys/devices/platform/vhci_hcd.0/attach", line)
        .map_err(|e| Error::new(format!("vhci-hcd refuses to attach a device to port {port}: {e}")))?;
    Ok(ours.into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_status_file_is_read() {
        let text = "hub port sta spd dev      sockfd local_busid\n\
                    hs  0000 004 000 00000000 000000 0-0\n\
                    ss  0015 006 005 00010010 000005 2-1\n";
        let expected = [
            Port { speed: Speed::High, number: 0, free: true, device: None },
            Port { speed: Speed::Super, number: 15, free: false, device: Some("2-1".into()) },
        ];
        assert_eq!(parse(text), expected);
    }
}
