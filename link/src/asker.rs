//! Asks another host for its clock, and keeps the offset.

use crate::corridor::{Corridor, Estimate, Exchange, Reading, Taken};
use crate::key::{Key, Trust};
use crate::stamped::Stamped;
use crate::wire::{Answer, LENGTH, Question, Refusal, is_trusted};
use crate::worker::Worker;
use core::time::Duration;
use depthrig_bus::{HostTime, sync::lock};
use serde::Serialize;
use std::collections::VecDeque;
use std::fs::File;
use std::io::{self, Read};
use std::net::{SocketAddr, UdpSocket};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};

/// From one question to the next.
const EVERY: Duration = Duration::from_millis(50);
/// Questions whose answers may still come: two seconds.
const OUTSTANDING: usize = 40;
/// After so long without a packet the socket is made anew: it keeps the address of this computer that it began with, which another one may have
/// replaced.
const SILENT: Duration = Duration::from_secs(2);

/// State of the exchange with the other host.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
#[non_exhaustive]
pub struct AskerState {
    /// Questions sent.
    pub asked: u64,
    /// Answers that were of use.
    pub answered: u64,
    /// Packets that were no answer to a question of ours, not signed by the key, came twice, or contradict themselves.
    pub refused: u64,
    /// Questions that the other host did not believe: its key is another one, or has not come here yet.
    pub strange: u64,
    /// When it last said so; 0 if it never did.
    pub last_refusal: HostTime,
    /// Changes of a clock's rate that the corridor followed.
    pub bends: u64,
    /// Which clock answers ([`crate::identity`]); 0 before the first answer.
    pub clock: u64,
    /// Time on the way of the newest answer or refusal, both ways together, nanoseconds.
    pub round_trip_ns: i64,
    /// When the newest answer had arrived; 0 before the first.
    pub last_answer: HostTime,
}

/// A thread that asks until this is dropped.
#[derive(Debug)]
pub struct Asker {
    shared: Arc<Mutex<Shared>>,
    address: SocketAddr,
    _thread: Worker,
}

/// Whoever reads it waits for no computation.
#[derive(Debug)]
struct Shared {
    estimate: Option<Estimate>,
    state: AskerState,
    trust: Trust,
}

impl Asker {
    /// Asks the host at `address`, whether it answers yet, or can be reached yet, or not. Answers of others than `trust` are left out.
    ///
    /// # Errors
    /// When no thread can be started.
    pub fn start(address: SocketAddr, trust: Trust) -> io::Result<Self> {
        let random = File::open("/dev/urandom")?;
        let shared = Arc::new(Mutex::new(Shared { estimate: None, state: AskerState::default(), trust }));
        let asking = Asking {
            address,
            socket: None,
            heard: HostTime::now(),
            random,
            outstanding: VecDeque::new(),
            corridor: Corridor::default(),
            shared: Arc::clone(&shared),
        };
        let thread = Worker::start("link_clock", move |stop| asking.run(stop))?;
        Ok(Self { shared, address, _thread: thread })
    }

    /// Signs with `key` from now on, and believes answers that are signed by it alone.
    pub fn set_key(&self, key: Key) {
        lock(&self.shared).trust = Trust::Key(key);
    }

    /// The remote clock at a local time; none before the first answer.
    pub fn at(&self, local: HostTime) -> Option<Reading> {
        let estimate = lock(&self.shared).estimate;
        estimate.map(|estimate| estimate.at(local))
    }

    /// The host that is asked.
    pub const fn address(&self) -> SocketAddr {
        self.address
    }

    /// State of the exchange.
    pub fn state(&self) -> AskerState {
        lock(&self.shared).state
    }
}

struct Asking {
    address: SocketAddr,
    /// None until there is a route to the host.
    socket: Option<Stamped>,
    /// When the last packet came, or the socket was made.
    heard: HostTime,
    random: File,
    /// Questions without an answer, and when they were sent.
    outstanding: VecDeque<([u8; 16], HostTime)>,
    corridor: Corridor,
    shared: Arc<Mutex<Shared>>,
}

impl Asking {
    fn run(mut self, stop: &AtomicBool) {
        let mut next = HostTime::now();
        while !stop.load(Ordering::Relaxed) {
            next = next.plus(EVERY).max(HostTime::now());
            if let Err(e) = self.ask() {
                tracing::debug!("the clock of {} is not asked: {e}", self.address);
            }
            while self.wait(next) {}
        }
    }

    fn ask(&mut self) -> io::Result<()> {
        let mut nonce = [0; 16];
        self.random.read_exact(&mut nonce)?;
        let kept = self.socket.take().filter(|_| self.heard.elapsed() < SILENT);
        let socket = if let Some(socket) = kept {
            socket
        } else {
            self.heard = HostTime::now();
            connected(self.address)?
        };
        if self.outstanding.len() == OUTSTANDING {
            self.outstanding.pop_front();
        }
        let mut shared = lock(&self.shared);
        let question = Question { nonce }.to_bytes(&shared.trust);
        shared.state.asked += 1;
        drop(shared);
        let sent = HostTime::now();
        self.outstanding.push_back((nonce, sent));
        // One that cannot send is not kept.
        socket.socket().send(&question)?;
        self.socket = Some(socket);
        Ok(())
    }

    /// Waits for a packet until it is time for the next question; `false` when it is.
    fn wait(&mut self, next: HostTime) -> bool {
        let left = next.from_now();
        if left.is_zero() {
            return false;
        }
        let mut buffer = [0; LENGTH];
        let received = match &mut self.socket {
            Some(s) => s.socket().set_read_timeout(Some(left)).and_then(|()| s.receive(&mut buffer)),
            None => Err(io::ErrorKind::NotConnected.into()),
        };
        let received = match received {
            Ok(Some(received)) => {
                self.heard = received.at;
                received
            }
            Ok(None) => return false,
            Err(_) => {
                // The host cannot be reached, or nobody listens there yet.
                std::thread::sleep(next.from_now());
                return false;
            }
        };
        let packet = buffer.get(..received.length).unwrap_or_default();
        if let Some(Refusal { nonce }) = Refusal::from_bytes(packet)
            && let Some((_, sent)) = self.outstanding.iter().find(|(asked, _)| *asked == nonce)
        {
            // The question stays: who can read packets and not keep them back must not put a refusal before the answer.
            let state = &mut lock(&self.shared).state;
            state.strange += 1;
            state.last_refusal = received.at;
            state.round_trip_ns = received.at.since_ns(*sent);
            return true;
        }
        let shared = lock(&self.shared);
        let answer = Answer::from_bytes(packet).filter(|_| is_trusted(packet, &shared.trust));
        let known = shared.state.clock;
        drop(shared);
        let asked = answer.and_then(|a| Some((a, self.asked(a.nonce)?)));
        let taken = asked.map(|(a, t1)| {
            if a.clock != known {
                // Another computer, or this one after a start: what the clock said before is of no use.
                self.corridor.restart();
            }
            let exchange = Exchange { t1: t1.ns(), t2: a.t2, t3: a.t3, t4: received.at.ns() };
            (a.clock, exchange, self.corridor.take(exchange))
        });
        let estimate = self.corridor.estimate();
        let mut shared = lock(&self.shared);
        shared.estimate = estimate;
        let state = &mut shared.state;
        state.clock = taken.map_or(state.clock, |(clock, ..)| clock);
        match taken {
            None | Some((.., Taken::Refused)) => state.refused += 1,
            Some((_, exchange, taken)) => {
                state.answered += 1;
                state.bends += u64::from(taken == Taken::Bent);
                state.round_trip_ns = exchange.round_trip_ns();
                state.last_answer = received.at;
            }
        }
        true
    }

    /// When the question with this number was sent, which has no answer yet; it has one then.
    fn asked(&mut self, nonce: [u8; 16]) -> Option<HostTime> {
        let at = self.outstanding.iter().position(|(asked, _)| *asked == nonce)?;
        self.outstanding.remove(at).map(|(_, sent)| sent)
    }
}

/// A socket to `address` alone: the kernel hands over packets of that host and port, and no others.
fn connected(address: SocketAddr) -> io::Result<Stamped> {
    let any = if address.is_ipv4() { "0.0.0.0:0" } else { "[::]:0" };
    let socket = UdpSocket::bind(any)?;
    socket.connect(address)?;
    Stamped::new(socket)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Answerer;

    fn until(what: impl Fn() -> bool) {
        for _ in 0..600 {
            if what() {
                return;
            }
            std::thread::sleep(Duration::from_millis(50));
        }
        panic!("it does not come");
    }

    #[test]
    fn a_host_may_come_late_go_and_come_back() {
        let place = UdpSocket::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
        let key = Key::random().unwrap();
        let trust = Trust::Key(key.clone());
        let asker = Asker::start(place, Trust::Nobody).unwrap();
        until(|| asker.state().asked >= 2);
        assert_eq!(asker.at(HostTime::now()), None);
        let answerer = Answerer::start(place, trust.clone()).unwrap();
        // It is there, but says nothing of its clock to strangers.
        until(|| asker.state().strange >= 2);
        asker.set_key(Key::random().unwrap());
        let before = asker.state().strange;
        until(|| asker.state().strange >= before + 3);
        assert_eq!((asker.at(HostTime::now()), asker.state().answered, answerer.answered()), (None, 0, 0));
        asker.set_key(key);
        until(|| asker.state().answered >= 5);
        let first = asker.at(HostTime::now()).unwrap();
        // It is the same clock.
        assert!(first.offset_ns.unsigned_abs() <= first.uncertainty_ns, "{first:?}");
        drop(answerer);
        let before = asker.state();
        until(|| asker.state().asked >= before.asked + 5);
        let again = Answerer::start(place, trust).unwrap();
        until(|| asker.state().answered >= before.answered + 10);
        let back = asker.at(HostTime::now()).unwrap();
        assert_eq!(back.epoch, 1);
        assert!(again.answered() >= 5);
    }

    #[test]
    fn a_host_without_a_route_is_asked_again_and_again() {
        // Nothing is sent to this network, which documents alone use; a computer without a route to it says so at once.
        let asker = Asker::start("[2001:db8::1]:7447".parse().unwrap(), Trust::Anyone).unwrap();
        std::thread::sleep(Duration::from_millis(300));
        assert_eq!(asker.at(HostTime::now()), None);
    }

    #[test]
    fn silence_is_asked_from_another_socket() {
        let host = UdpSocket::bind("127.0.0.1:0").unwrap();
        host.set_read_timeout(Some(Duration::from_secs(30))).unwrap();
        let began = HostTime::now();
        let asker = Asker::start(host.local_addr().unwrap(), Trust::Anyone).unwrap();
        let from = || host.recv_from(&mut [0; 100]).unwrap().1;
        let first = from();
        while from() == first {
            assert!(began.elapsed() < Duration::from_mins(1), "the same socket for ever");
        }
        assert!(began.elapsed() >= SILENT && asker.state().answered == 0);
    }

    #[test]
    fn packets_that_answer_nothing_are_counted_and_change_nothing() {
        let host = UdpSocket::bind("127.0.0.1:0").unwrap();
        host.set_read_timeout(Some(Duration::from_secs(30))).unwrap();
        let trust = Trust::Key(Key::random().unwrap());
        let asker = Asker::start(host.local_addr().unwrap(), trust.clone()).unwrap();
        let mut buffer = [0; 100];
        let (length, from) = host.recv_from(&mut buffer).unwrap();
        let nonce = Question::from_bytes(&buffer[..length]).unwrap().nonce;
        let good = Answer { nonce, clock: 7, t2: 5, t3: 5 };
        let guessed = Answer { nonce: [1; 16], ..good };
        let untrue = Answer { t2: 9, ..good };
        let foreign = good.to_bytes(&Trust::Key(Key::random().unwrap()));
        let signed = |answer: Answer| answer.to_bytes(&trust).to_vec();
        // Who only sees the packets cannot answer, nor refuse in place of the answer.
        for packet in [
            b"x".to_vec(),
            buffer.to_vec(),
            foreign.to_vec(),
            good.to_bytes(&Trust::Anyone).to_vec(),
            Refusal { nonce: [1; 16] }.to_bytes().to_vec(),
            Refusal { nonce }.to_bytes().to_vec(),
            signed(guessed),
            signed(untrue),
        ] {
            host.send_to(&packet, from).unwrap();
        }
        // Its question is answered, although not with the truth.
        host.send_to(&signed(good), from).unwrap();
        until(|| asker.state().refused == 8);
        assert_eq!(asker.state().strange, 1);
        assert_eq!(asker.at(HostTime::now()), None);
        // Another port of the same host is not heard.
        UdpSocket::bind("127.0.0.1:0").unwrap().send_to(&signed(good), from).unwrap();
        let (length, from) = host.recv_from(&mut buffer).unwrap();
        let nonce = Question::from_bytes(&buffer[..length]).unwrap().nonce;
        host.send_to(&signed(Answer { nonce, ..good }), from).unwrap();
        until(|| asker.state().answered == 1);
        assert_eq!(asker.state().refused, 8);
        assert!(asker.at(HostTime::now()).is_some());
    }
}
