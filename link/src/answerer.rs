//! Answers other hosts' questions about this host's clock.

use crate::identity::of_this_clock;
use crate::key::Trust;
use crate::stamped::Stamped;
use crate::wire::{Answer, LENGTH, Question, Refusal, is_trusted};
use crate::worker::Worker;
use core::time::Duration;
use depthrig_bus::HostTime;
use std::io;
use std::net::{SocketAddr, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

/// The thread looks this often whether to stop.
const LOOK: Duration = Duration::from_millis(100);
/// Questions of all hosts that are answered in a second: fifty hosts at 20 Hz. A flood costs no more than that, and one of strangers takes
/// nothing from those who are trusted.
const PER_SECOND: u64 = 1000;

/// A thread that answers until this is dropped.
#[derive(Debug)]
pub struct Answerer {
    counts: Arc<Counts>,
    address: SocketAddr,
    _thread: Worker,
}

#[derive(Debug, Default)]
struct Counts {
    answered: AtomicU64,
    refused: AtomicU64,
}

impl Answerer {
    /// Answers those whom it trusts on `address`; port 0 chooses one. Others hear that they are not.
    ///
    /// # Errors
    /// When the address cannot be listened on, or no thread can be started.
    pub fn start(address: SocketAddr, trust: Trust) -> io::Result<Self> {
        let socket = UdpSocket::bind(address)?;
        socket.set_read_timeout(Some(LOOK))?;
        let address = socket.local_addr()?;
        let socket = Stamped::new(socket)?;
        let clock = of_this_clock()?;
        let counts = Arc::new(Counts::default());
        let of_thread = Arc::clone(&counts);
        let thread =
            Worker::start("link_answers", move |stop| answer(socket, clock, &trust, &of_thread, stop))?;
        Ok(Self { counts, address, _thread: thread })
    }

    /// Where it listens.
    pub const fn address(&self) -> SocketAddr {
        self.address
    }

    /// Questions answered so far.
    pub fn answered(&self) -> u64 {
        self.counts.answered.load(Ordering::Relaxed)
    }

    /// Packets that were no question or a stranger's, or came above the limit.
    pub fn refused(&self) -> u64 {
        self.counts.refused.load(Ordering::Relaxed)
    }
}

fn answer(mut socket: Stamped, clock: u64, trust: &Trust, counts: &Counts, stop: &AtomicBool) {
    let mut buffer = [0; LENGTH];
    let mut second = HostTime::now();
    let (mut of_trusted, mut of_strangers) = (0, 0);
    while !stop.load(Ordering::Relaxed) {
        let received = match socket.receive(&mut buffer) {
            Ok(Some(received)) => received,
            Ok(None) => continue,
            Err(e) => {
                // An ICMP error of an earlier answer; the thread must not spin on others.
                tracing::debug!("the clock's questions: {e}");
                std::thread::sleep(Duration::from_millis(1));
                continue;
            }
        };
        if received.at.since_ns(second) >= 1_000_000_000 {
            (second, of_trusted, of_strangers) = (received.at, 0, 0);
        }
        let packet = buffer.get(..received.length).unwrap_or_default();
        let (Some(Question { nonce }), Some(from)) = (Question::from_bytes(packet), received.from) else {
            counts.refused.fetch_add(1, Ordering::Relaxed);
            continue;
        };
        let is_trusted = is_trusted(packet, trust);
        let in_second = if is_trusted { &mut of_trusted } else { &mut of_strangers };
        *in_second += 1;
        let is_answered = *in_second <= PER_SECOND;
        let count = if is_trusted && is_answered { &counts.answered } else { &counts.refused };
        count.fetch_add(1, Ordering::Relaxed);
        if is_answered {
            let answer = if is_trusted {
                let (t2, t3) = (received.at.ns(), HostTime::now().ns());
                Answer { nonce, clock, t2, t3 }.to_bytes(trust)
            } else {
                Refusal { nonce }.to_bytes()
            };
            // An answer that cannot be sent is one that is lost.
            let _ = socket.socket().send_to(&answer, from);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Key;

    /// Strangers use up what they get in a second; a trusted host asks in the same one.
    #[test]
    fn strangers_take_no_answers_from_a_trusted_host() {
        let trust = Trust::Key(Key::random().unwrap());
        let answerer = Answerer::start("127.0.0.1:0".parse().unwrap(), trust.clone()).unwrap();
        let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
        socket.connect(answerer.address()).unwrap();
        socket.set_read_timeout(Some(Duration::from_secs(10))).unwrap();
        let mut buffer = [0; 2 * LENGTH];
        let mut asked = 0;
        // Those above the limit get nothing, so that only their count says that they arrived.
        for _ in 0..PER_SECOND + 200 {
            socket.send(&Question { nonce: [7; 16] }.to_bytes(&Trust::Anyone)).unwrap();
            asked += 1;
            if asked <= PER_SECOND {
                let length = socket.recv(&mut buffer).unwrap();
                assert_eq!(Refusal::from_bytes(&buffer[..length]), Some(Refusal { nonce: [7; 16] }));
            }
        }
        while answerer.refused() < asked {
            std::thread::sleep(Duration::from_millis(1));
        }
        let question = Question { nonce: [8; 16] }.to_bytes(&trust);
        socket.send(&question).unwrap();
        let answer = loop {
            let length = socket.recv(&mut buffer).unwrap();
            if let Some(answer) = Answer::from_bytes(&buffer[..length]) {
                break answer;
            }
        };
        assert_eq!((answer.nonce, answerer.answered()), ([8; 16], 1));
    }
}
