//! Answers other hosts' questions about this host's clock.

use crate::identity::of_this_clock;
use crate::stamped::Stamped;
use crate::wire::{Answer, LENGTH, Question};
use crate::worker::Worker;
use core::time::Duration;
use depthrig_bus::HostTime;
use std::io;
use std::net::{SocketAddr, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

/// The thread looks this often whether to stop.
const LOOK: Duration = Duration::from_millis(100);
/// Questions of all hosts that are answered in a second: fifty hosts at 20 Hz. A flood costs no more than that.
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
    /// Answers on `address`; port 0 chooses one.
    ///
    /// # Errors
    /// When the address cannot be listened on, or no thread can be started.
    pub fn start(address: SocketAddr) -> io::Result<Self> {
        let socket = UdpSocket::bind(address)?;
        socket.set_read_timeout(Some(LOOK))?;
        let address = socket.local_addr()?;
        let socket = Stamped::new(socket)?;
        let clock = of_this_clock()?;
        let counts = Arc::new(Counts::default());
        let of_thread = Arc::clone(&counts);
        let thread = Worker::start("link_answers", move |stop| answer(socket, clock, &of_thread, stop))?;
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

    /// Packets that were no question, or came above the limit.
    pub fn refused(&self) -> u64 {
        self.counts.refused.load(Ordering::Relaxed)
    }
}

fn answer(mut socket: Stamped, clock: u64, counts: &Counts, stop: &AtomicBool) {
    let mut buffer = [0; LENGTH];
    let mut second = HostTime::now();
    let mut in_second = 0;
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
            (second, in_second) = (received.at, 0);
        }
        in_second += 1;
        let question = buffer.get(..received.length).and_then(Question::from_bytes);
        let (Some(question), Some(from), true) = (question, received.from, in_second <= PER_SECOND) else {
            counts.refused.fetch_add(1, Ordering::Relaxed);
            continue;
        };
        let answer = Answer { nonce: question.nonce, clock, t2: received.at.ns(), t3: HostTime::now().ns() };
        // An answer that cannot be sent is one that is lost.
        let _ = socket.socket().send_to(&answer.to_bytes(), from);
        counts.answered.fetch_add(1, Ordering::Relaxed);
    }
}
