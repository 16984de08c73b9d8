//! A UDP socket whose packets have the time at which the kernel received them.
//!
//! A thread that waits for the processor reads a packet milliseconds after it came; the kernel's stamp does not wait with it.

use depthrig_bus::{HostTime, UtcPair};
use nix::cmsg_space;
use nix::errno::Errno;
use nix::sys::socket::sockopt::ReceiveTimestampns;
use nix::sys::socket::{ControlMessageOwned, MsgFlags, SockaddrStorage, recvmsg, setsockopt};
use nix::sys::time::TimeSpec;
use std::io::{self, IoSliceMut};
use std::net::{SocketAddr, UdpSocket};
use std::os::fd::AsRawFd;

/// Readings of UTC and the monotonic clock that differ by more since the last packet saw UTC step.
const STEP_NS: i64 = 10_000;
/// A stamp this old is not believed.
const OLDEST_NS: i64 = 1_000_000_000;

/// The socket.
#[derive(Debug)]
pub struct Stamped {
    socket: UdpSocket,
    /// UTC minus the monotonic clock at the last packet, nanoseconds.
    utc_offset_ns: i64,
}

/// A packet.
#[derive(Debug, Clone, Copy)]
pub struct Received {
    /// Its length.
    pub length: usize,
    /// Its sender; `None` for a kind of address that is not IP.
    pub from: Option<SocketAddr>,
    /// When it had arrived, never too early.
    pub at: HostTime,
}

impl Stamped {
    /// Has the kernel stamp what `socket` receives.
    ///
    /// # Errors
    /// When the kernel refuses.
    pub fn new(socket: UdpSocket) -> io::Result<Self> {
        setsockopt(&socket, ReceiveTimestampns, &true)?;
        Ok(Self { socket, utc_offset_ns: utc_offset_ns(&UtcPair::sample()) })
    }

    /// The socket, to send with.
    pub const fn socket(&self) -> &UdpSocket {
        &self.socket
    }

    /// Waits for a packet for as long as the socket's timeout; `None` when none came.
    ///
    /// # Errors
    /// Those of `recvmsg(2)`, such as `ECONNREFUSED` when nobody listens there.
    pub fn receive(&mut self, buffer: &mut [u8]) -> io::Result<Option<Received>> {
        let mut room = cmsg_space!(TimeSpec);
        let mut parts = [IoSliceMut::new(buffer)];
        let received = recvmsg::<SockaddrStorage>(
            self.socket.as_raw_fd(),
            &mut parts,
            Some(&mut room),
            MsgFlags::MSG_TRUNC,
        );
        let message = match received {
            Ok(message) => message,
            Err(Errno::EAGAIN | Errno::EINTR) => return Ok(None),
            Err(e) => return Err(e.into()),
        };
        let now = UtcPair::sample();
        let stamp = message.cmsgs()?.find_map(|c| match c {
            ControlMessageOwned::ScmTimestampns(stamp) => Some(stamp),
            _ => None,
        });
        let utc_ns = stamp.map(|s| s.tv_sec().saturating_mul(1_000_000_000).saturating_add(s.tv_nsec()));
        let from = message.address.as_ref().and_then(ip);
        Ok(Some(Received { length: message.bytes, from, at: self.time_of(utc_ns, &now) }))
    }

    /// The kernel's stamp on the monotonic clock. If UTC has stepped since the last packet, or the stamp is out of reason, it is the time
    /// at which the packet was read: later than it came, but never too early.
    fn time_of(&mut self, utc_ns: Option<i64>, now: &UtcPair) -> HostTime {
        let offset_ns = utc_offset_ns(now);
        let is_steady =
            offset_ns.saturating_sub(self.utc_offset_ns).saturating_abs() < STEP_NS + now.width_ns;
        self.utc_offset_ns = offset_ns;
        match utc_ns.map(|utc_ns| HostTime::from_ns(utc_ns.saturating_sub(offset_ns))) {
            Some(at) if is_steady && (0..OLDEST_NS).contains(&now.mono.since_ns(at)) => at,
            _ => now.mono,
        }
    }
}

const fn utc_offset_ns(pair: &UtcPair) -> i64 {
    pair.utc_ns.saturating_sub(pair.mono.ns())
}

fn ip(address: &SockaddrStorage) -> Option<SocketAddr> {
    let v4 = address.as_sockaddr_in().map(|a| SocketAddr::V4((*a).into()));
    v4.or_else(|| address.as_sockaddr_in6().map(|a| SocketAddr::V6((*a).into())))
}

#[cfg(test)]
mod tests {
    use super::*;
    use core::time::Duration;

    fn pair() -> (Stamped, UdpSocket) {
        let here = UdpSocket::bind("127.0.0.1:0").unwrap();
        here.set_read_timeout(Some(Duration::from_millis(20))).unwrap();
        let there = UdpSocket::bind("127.0.0.1:0").unwrap();
        there.connect(here.local_addr().unwrap()).unwrap();
        (Stamped::new(here).unwrap(), there)
    }

    #[test]
    fn a_packet_that_waited_has_the_time_at_which_it_came() {
        let (mut here, there) = pair();
        let mut buffer = [0; 16];
        assert!(here.receive(&mut buffer).unwrap().is_none());
        let before = HostTime::now();
        there.send(b"abc").unwrap();
        let after = HostTime::now();
        std::thread::sleep(Duration::from_millis(100));
        let received = here.receive(&mut buffer).unwrap().unwrap();
        assert_eq!((received.length, received.from), (3, there.local_addr().ok()));
        // Some hundred nanoseconds pass between two readings of two clocks.
        assert!(received.at.since_ns(before) > -2_000 && received.at.since_ns(after) < 50_000_000);
        // A longer packet says its whole length.
        there.send(&[0; 100]).unwrap();
        assert_eq!(here.receive(&mut buffer).unwrap().unwrap().length, 100);
    }

    #[test]
    fn after_a_step_of_utc_the_time_of_reading_counts() {
        let (mut here, _there) = pair();
        let now = UtcPair { mono: HostTime::from_ns(5_000_000_000), utc_ns: 100_000_000_000, width_ns: 100 };
        here.utc_offset_ns = 95_000_000_000;
        assert_eq!(here.time_of(Some(99_999_000_000), &now).ns(), 4_999_000_000);
        assert_eq!(here.time_of(None, &now), now.mono);
        assert_eq!(here.time_of(Some(100_000_000_001), &now), now.mono);
        assert_eq!(here.time_of(Some(98_000_000_000), &now), now.mono);
        let stepped = UtcPair { utc_ns: now.utc_ns + 20_000, ..now };
        assert_eq!(here.time_of(Some(99_999_000_000), &stepped), now.mono);
        assert_eq!(here.time_of(Some(99_999_020_000), &stepped).ns(), 4_999_000_000);
    }
}
