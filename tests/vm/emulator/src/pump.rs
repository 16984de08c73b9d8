//! One stream: its schedule, its frames and their way into the host's transfers.

use crate::clock::DeviceClock;
use crate::content::{self, Stamp};
use crate::fault::Damage;
use crate::model::{Metadata, Mode};
use crate::payload::Header;
use crate::shared::{Session, Shared};
use crate::usbip::{self, HEADER};
use depthrig_bus::HostTime;
use std::collections::VecDeque;
use std::io::{self, IoSlice, Write};
use std::os::unix::net::UnixStream;

/// Transfers that are answered in one write.
const BATCH: usize = 8;
/// Extra bytes of a frame that is too long.
static EXCESS: [u8; 512] = [0xA5; 512];
/// From the end of a frame in the sensor until it is sent.
const PIPELINE_NS: i64 = 2_000_000;

/// A transfer that waits for bytes.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Urb {
    pub seq: u32,
    pub length: usize,
}

/// Writes every byte of `slices`.
pub(crate) fn write_all(mut line: &UnixStream, mut slices: &mut [IoSlice<'_>]) -> io::Result<()> {
    IoSlice::advance_slices(&mut slices, 0);
    while !slices.is_empty() {
        match line.write_vectored(slices) {
            Ok(0) => return Err(io::ErrorKind::WriteZero.into()),
            Ok(written) => IoSlice::advance_slices(&mut slices, written),
            Err(e) if e.kind() == io::ErrorKind::Interrupted => {}
            Err(e) => return Err(e),
        }
    }
    Ok(())
}

/// Firmware settings that frames carry in their metadata.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Settings {
    pub exposure_us: u32,
    pub gain: u32,
    /// `None` without a projector.
    pub laser_mw: Option<u32>,
    /// Likewise.
    pub emitter: Option<u8>,
    pub auto_exposure: u32,
}

/// One stream of a camera. It outlives connections, so that its indices never start again.
pub(crate) struct Pump {
    pub stream: u16,
    pub serial: String,
    pub metadata: Metadata,
    pub color: bool,
    pub urbs: VecDeque<Urb>,
    /// The endpoint answers STALL.
    pub halted: bool,
    /// Faults that wait for frames.
    pub damages: VecDeque<(Damage, u32)>,
    /// The largest jitter of arrival.
    pub jitter_ns: i64,
    pub next_index: u64,
    running: Option<Running>,
    patterns: Vec<(Mode, Vec<u8>)>,
}

struct Running {
    session: Session,
    /// The number of the next frame in this session.
    next: u64,
    due: HostTime,
    body: Vec<u8>,
    header: [u8; 255],
    current: Option<Current>,
    /// The host has taken bytes of this session.
    taken: bool,
    sent_before: bool,
    /// The frame bit of the payload header: it changes with every frame that is sent, not with those that are not.
    toggle: bool,
}

#[derive(Debug, Clone, Copy)]
struct Current {
    header: usize,
    body: usize,
    excess: usize,
    offset: usize,
    begun: bool,
    damage: Option<Damage>,
}

impl Pump {
    pub fn new(stream: u16, serial: &str, metadata: Metadata, color: bool, jitter_ns: i64) -> Self {
        Self {
            stream,
            serial: serial.to_owned(),
            metadata,
            color,
            urbs: VecDeque::with_capacity(64),
            halted: false,
            damages: VecDeque::new(),
            jitter_ns,
            next_index: 0,
            running: None,
            patterns: Vec::new(),
        }
    }

    /// The host has committed a mode: frames come from now on.
    pub fn start(&mut self, mode: Mode, clock: DeviceClock, settings: &Settings, shared: &Shared) {
        self.stop(shared);
        let now = clock.running_ns(HostTime::now());
        let period_ns = i64::from(mode.interval) * 100;
        // All streams of a camera expose on one grid, each camera on its own.
        let phase = (content::hash(&self.serial) % 1000) as i64 * period_ns / 1000;
        let first_ns = (now - phase).div_euclid(period_ns).saturating_add(1) * period_ns + phase;
        let session = Session { first_index: self.next_index, first_ns, period_ns, mode, clock };
        let body = match self.patterns.iter().position(|(known, _)| known.same_image(&mode)) {
            Some(at) => self.patterns.swap_remove(at).1,
            None => content::pattern(&self.serial, self.stream, &mode),
        };
        let mut running = Running {
            session,
            next: 0,
            due: HostTime::default(),
            body,
            header: [0; 255],
            current: None,
            taken: false,
            sent_before: false,
            toggle: false,
        };
        running.due = due(&running, &clock, settings, self.jitter_ns);
        self.running = Some(running);
        shared.begin_session(self.stream.into(), session);
    }

    /// No more frames.
    pub fn stop(&mut self, shared: &Shared) {
        if let Some(running) = self.running.take() {
            if running.current.is_some_and(|c| c.offset > 0) {
                self.account(shared, |a| a.cut += 1);
            }
            self.next_index = running.session.first_index + running.next;
            self.patterns.truncate(3);
            self.patterns.push((running.session.mode, running.body));
            shared.end_session(self.stream.into());
        }
    }

    pub fn is_running(&self) -> bool {
        self.running.is_some()
    }

    /// The host cleared the endpoint. `uvcvideo` ends a stream so; a driver that clears it before it reads for the first
    /// time, or after a STALL, goes on with the stream.
    pub fn cleared(&mut self, shared: &Shared) {
        let was_halted = core::mem::take(&mut self.halted);
        if !was_halted && self.running.as_ref().is_some_and(|r| r.taken) {
            self.stop(shared);
        }
    }

    fn account(&self, shared: &Shared, change: impl FnOnce(&mut crate::Accounts)) {
        if let Some(accounts) = shared.lock().accounts.get_mut(usize::from(self.stream)) {
            change(accounts);
        }
    }

    /// When it has something to do next; `None` while it streams nothing.
    pub fn next_due(&self) -> Option<HostTime> {
        self.running.as_ref().map(|r| r.due)
    }

    /// Makes the frames that are due.
    pub fn advance(
        &mut self,
        now: HostTime,
        clock: &DeviceClock,
        settings: &Settings,
        silent: bool,
        shared: &Shared,
    ) {
        while self.running.as_ref().is_some_and(|r| r.due <= now) {
            let Some(mut running) = self.running.take() else { return };
            self.step(&mut running, now, clock, settings, silent, shared);
            self.running = Some(running);
        }
    }

    fn step(
        &mut self,
        running: &mut Running,
        now: HostTime,
        clock: &DeviceClock,
        settings: &Settings,
        silent: bool,
        shared: &Shared,
    ) {
        let k = running.next;
        running.next += 1;
        running.due = due(running, clock, settings, self.jitter_ns);
        if silent {
            self.account(shared, |a| a.skipped += 1);
            return;
        }
        if running.current.is_some() {
            self.account(shared, |a| a.unread += 1);
            if running.current.is_some_and(|c| c.offset > 0) {
                return; // the one that is under way is finished first; the new one is lost
            }
        } else if running.due <= now {
            self.account(shared, |a| a.late += 1);
            return;
        }
        let damage = self.damages.front_mut().map(|(damage, left)| {
            *left -= 1;
            (*damage, *left == 0)
        });
        let damage = damage.map(|(damage, last)| {
            if last {
                self.damages.pop_front();
            }
            damage
        });
        match damage {
            Some(Damage::Skip) => {
                running.current = None;
                self.account(shared, |a| a.skipped += 1);
                return;
            }
            // Header and body are still those of the frame before.
            Some(Damage::Repeat) if running.sent_before => {
                let header = usize::from(running.header[0]);
                let body = running.body.len();
                running.current = Some(Current { header, body, excess: 0, offset: 0, begun: false, damage });
                return;
            }
            _ => {}
        }
        let session = &running.session;
        let captured_ns = session.first_ns + k as i64 * session.period_ns;
        let sensor_us = sensor_us(&session.mode, settings);
        let header = Header {
            mode: &session.mode,
            metadata: self.metadata,
            color: self.color,
            toggle: false,
            damaged: damage == Some(Damage::ErrorBit),
            pts_us: clock.shown_us(captured_ns + i64::from(sensor_us) * 1000),
            sent_us: clock.shown_us(clock.running_ns(now)),
            counter: k as u32 + 1,
            sensor_us,
            exposure_us: settings.exposure_us,
            gain: settings.gain,
            laser_mw: settings.laser_mw,
            emitter: settings.emitter,
            auto_exposure: settings.auto_exposure,
        }
        .write(&mut running.header);
        let index = session.first_index + k;
        let stamp = Stamp { serial_hash: content::hash(&self.serial), stream: self.stream, index };
        content::put_stamp(&mut running.body, &session.mode, &stamp);
        let body = if damage == Some(Damage::Short) { running.body.len() / 3 } else { running.body.len() };
        let excess = if damage == Some(Damage::Long) { EXCESS.len() } else { 0 };
        running.current = Some(Current { header, body, excess, offset: 0, begun: false, damage });
    }

    /// Sends ready frames into waiting transfers.
    ///
    /// # Errors
    /// When the host's end is closed.
    pub fn send(&mut self, line: &UnixStream, shared: &Shared) -> io::Result<()> {
        if self.halted {
            while let Some(urb) = self.urbs.pop_front() {
                write_all(line, &mut [IoSlice::new(&usbip::submit_done(urb.seq, usbip::STALL, 0))])?;
            }
            return Ok(());
        }
        let Some(running) = self.running.as_mut() else { return Ok(()) };
        let mut finished = None;
        while let Some(current) = running.current.as_mut() {
            if self.urbs.is_empty() {
                break;
            }
            if current.offset == 0 && !current.begun {
                current.begun = true;
                running.toggle = !running.toggle;
                running.header[1] = running.header[1] & !1 | u8::from(running.toggle);
            }
            let parts: [&[u8]; 3] = [
                running.header.get(..current.header).unwrap_or_default(),
                running.body.get(..current.body).unwrap_or_default(),
                EXCESS.get(..current.excess).unwrap_or_default(),
            ];
            let total: usize = parts.iter().map(|p| p.len()).sum();
            let mut heads = [[0; HEADER]; BATCH];
            let mut spans = [(0, 0); BATCH];
            let mut count = 0;
            let mut ended = false;
            while count < BATCH && !ended {
                let Some(urb) = self.urbs.pop_front() else { break };
                let take = urb.length.min(total - current.offset);
                heads[count] = usbip::submit_done(urb.seq, 0, take);
                spans[count] = (current.offset, current.offset + take);
                current.offset += take;
                count += 1;
                // A transfer that is not filled ends the payload; after a filled one that may be an empty one.
                ended = take < urb.length;
            }
            let mut slices = [IoSlice::new(&[]); BATCH * 4];
            let mut used = 0;
            for (head, span) in heads.iter().zip(&spans).take(count) {
                slices[used] = IoSlice::new(head);
                used += 1;
                let mut start = 0;
                for part in parts {
                    let from = span.0.max(start);
                    let to = span.1.min(start + part.len());
                    if from < to {
                        slices[used] = IoSlice::new(&part[from - start..to - start]);
                        used += 1;
                    }
                    start += part.len();
                }
            }
            write_all(line, &mut slices[..used])?;
            running.taken = true;
            if ended {
                running.sent_before = true;
                finished = Some(current.damage);
                running.current = None;
            }
        }
        if let Some(damage) = finished {
            self.account(shared, |a| {
                a.sent += 1;
                match damage {
                    Some(Damage::ErrorBit) => a.error_bit += 1,
                    Some(Damage::Short) => a.short += 1,
                    Some(Damage::Long) => a.long += 1,
                    Some(Damage::Repeat) => a.repeated += 1,
                    Some(Damage::Skip) | None => a.good += 1,
                }
            });
        }
        Ok(())
    }
}

/// From mid-exposure to the time stamp: the rest of the exposure, and a readout of a quarter of the interval, 5 ms at most.
fn sensor_us(mode: &Mode, settings: &Settings) -> u32 {
    settings.exposure_us / 2 + (mode.interval / 40).min(5000)
}

/// When the next frame of a session reaches the host.
fn due(running: &Running, clock: &DeviceClock, settings: &Settings, jitter_ns: i64) -> HostTime {
    let session = &running.session;
    let captured = session.first_ns + running.next as i64 * session.period_ns;
    let sent = captured + i64::from(sensor_us(&session.mode, settings)) * 1000 + PIPELINE_NS;
    // splitmix64 of the frame's index: the same jitter in every run.
    let mut z = (session.first_index + running.next).wrapping_add(0x9E37_79B9_7F4A_7C15);
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    let jitter = if jitter_ns > 0 { ((z ^ (z >> 31)) % jitter_ns as u64) as i64 } else { 0 };
    clock.host(sent).plus_ns(jitter)
}
