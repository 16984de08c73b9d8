//! The thread of one USB device: it serves the host's transfers, keeps time and obeys faults.
//!
//! One thread does it all, so an answer to UNLINK can never overtake the end of the transfer that it names, which the
//! kernel takes for a broken connection.

mod hid;
mod requests;

use crate::clock::DeviceClock;
use crate::control::Units;
use crate::fault::Fault;
use crate::firmware::imu::Imu;
use crate::firmware::zed::{Bridge, Motion};
use crate::firmware::{Firmware, Identity};
use crate::model::{Family, Mode, Model};
use crate::pump::{Pump, Settings, Urb, write_all};
use crate::shared::{Command, Presence, Shared};
use crate::usbip::{self, HEADER, Submit};
use crate::{Options, Result, Speed, vhci};
use core::time::Duration;
use depthrig_bus::HostTime;
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use std::collections::VecDeque;
use std::io::{self, IoSlice, Read};
use std::os::unix::net::UnixStream;
use std::sync::Arc;

/// How long a camera needs to restart by itself.
const RESTART: Duration = Duration::from_millis(1500);

/// Why a connection ended.
enum End {
    /// The host closed it, or it failed.
    Closed,
    Unplug(Option<Duration>),
    Thread,
}

/// One USB device.
pub(crate) struct Device {
    model: Arc<Model>,
    options: Options,
    identity: Identity,
    shared: Arc<Shared>,
    pumps: Vec<Pump>,
    port: Option<u32>,
    /// The video half, for the sensor half of a ZED.
    video: Option<Arc<Shared>>,
    // From here on: reset at power-on.
    clock: DeviceClock,
    units: Units,
    firmware: Firmware,
    bridge: Bridge,
    motion: Motion,
    imu: Option<Imu>,
    probes: Vec<Option<(Vec<u8>, Mode)>>,
    refusal: u8,
    // Faults that last.
    silent: bool,
    nak: bool,
    control_held: Option<HostTime>,
    control_stalls: u32,
    // Transfers that wait: of the vendor's endpoint, of interrupts, of controls that are held back.
    vendor_urbs: VecDeque<Urb>,
    vendor_replies: VecDeque<Vec<u8>>,
    idle_urbs: Vec<(u8, Urb)>,
    held: VecDeque<(Submit, Vec<u8>)>,
    restart: bool,
}

impl Device {
    pub fn new(
        model: Arc<Model>,
        options: Options,
        serial: &str,
        shared: Arc<Shared>,
        video: Option<Arc<Shared>>,
    ) -> Self {
        let jitter = options.jitter.as_nanos() as i64;
        let pumps =
            model.functions.iter().flat_map(|f| f.streams.iter()).enumerate().map(|(i, stream)| {
                Pump::new(i as u16, serial, model.metadata, stream.name == "color", jitter)
            });
        let pumps: Vec<Pump> = pumps.collect();
        Self {
            identity: Identity::new(&model, serial),
            clock: DeviceClock::new(HostTime::now(), options.start_ticks, options.drift_ppm),
            units: Units::new(&model, options.speed),
            firmware: Firmware::new(&model),
            probes: vec![None; pumps.len()],
            pumps,
            port: None,
            video,
            bridge: Bridge::default(),
            motion: Motion::default(),
            imu: Imu::new(&model),
            refusal: 0,
            silent: false,
            nak: false,
            control_held: None,
            control_stalls: 0,
            vendor_urbs: VecDeque::new(),
            vendor_replies: VecDeque::new(),
            idle_urbs: Vec::new(),
            held: VecDeque::new(),
            restart: false,
            model,
            options,
            shared,
        }
    }

    /// Runs until the command to end.
    pub fn run(mut self) {
        let mut back_at: Option<HostTime> = None;
        loop {
            match self.next_command(back_at) {
                Some(Command::Serve(line, port)) => {
                    back_at = None;
                    self.port = port;
                    match self.connection(&line) {
                        End::Thread => return,
                        End::Closed => self.shared.set_presence(Presence::Unplugged),
                        End::Unplug(again) => {
                            back_at = again.map(|time| HostTime::now().plus(time));
                            let presence = if again.is_some() { Presence::Away } else { Presence::Unplugged };
                            self.shared.set_presence(presence);
                        }
                    }
                }
                Some(Command::Unplug(again)) => {
                    back_at = again.map(|time| HostTime::now().plus(time));
                    self.shared.set_presence(if again.is_some() {
                        Presence::Away
                    } else {
                        Presence::Unplugged
                    });
                }
                Some(Command::Fault(fault)) => self.fault(&fault),
                Some(Command::End) => return,
                None => {
                    back_at = None;
                    self.come_back();
                }
            }
        }
    }

    fn come_back(&mut self) {
        match vhci::attach(self.options.hub, self.options.speed, self.port) {
            Ok((line, port)) => {
                if let Err(error) = self.shared.ask(Command::Serve(line, Some(port))) {
                    self.trouble(&error);
                }
            }
            Err(error) => self.trouble(&error),
        }
    }

    fn trouble(&self, error: &crate::Error) {
        self.shared.lock().trouble = Some(error.to_string());
        self.shared.set_presence(Presence::Unplugged);
    }

    /// The next command while it is off the bus; `None` when it is time to come back.
    fn next_command(&self, back_at: Option<HostTime>) -> Option<Command> {
        loop {
            if let Some(command) = self.shared.lock().commands.pop_front() {
                return Some(command);
            }
            let wait = back_at.map(HostTime::from_now);
            if wait.is_some_and(|w| w.is_zero()) {
                return None;
            }
            self.sleep(None, wait);
        }
    }

    /// Sleeps until there is a command, something from the host, or the time is up. Says whether the host has sent.
    fn sleep(&self, line: Option<&UnixStream>, time: Option<Duration>) -> bool {
        let timeout = time.map(|t| Timespec { tv_sec: t.as_secs() as i64, tv_nsec: t.subsec_nanos().into() });
        let wake = PollFd::new(&self.shared.wake, PollFlags::IN);
        let (mut one, mut two);
        let fds: &mut [PollFd<'_>] = if let Some(line) = line {
            two = [wake, PollFd::new(line, PollFlags::IN)];
            &mut two
        } else {
            one = [wake];
            &mut one
        };
        if poll(fds, timeout.as_ref()).is_err() {
            return false;
        }
        if fds[0].revents().contains(PollFlags::IN) {
            // Nobody else reads it, so it cannot fail for want of a value.
            let _ = rustix::io::read(&self.shared.wake, &mut [0; 8]);
        }
        fds.get(1).is_some_and(|fd| !fd.revents().is_empty())
    }

    /// Power-on, and service until the connection ends.
    fn connection(&mut self, line: &UnixStream) -> End {
        self.clock = DeviceClock::new(HostTime::now(), self.options.start_ticks, self.options.drift_ppm);
        self.units = Units::new(&self.model, self.options.speed);
        self.firmware.power_on(&self.model);
        self.bridge = Bridge::default();
        self.motion = Motion::default();
        self.imu = Imu::new(&self.model);
        self.probes.fill(None);
        self.restart = false;
        self.shared.lock().trouble = None;
        self.shared.set_presence(Presence::Plugged(self.port));
        let end = self.serve(line);
        // Both ends: the kernel sees at once that the device is gone.
        let _ = line.shutdown(std::net::Shutdown::Both);
        for pump in &mut self.pumps {
            pump.stop(&self.shared);
            pump.urbs.clear();
            pump.halted = false;
        }
        self.vendor_urbs.clear();
        self.vendor_replies.clear();
        self.idle_urbs.clear();
        self.held.clear();
        end
    }

    fn serve(&mut self, line: &UnixStream) -> End {
        let mut input = Input::new();
        loop {
            while let Some(command) = self.take_command() {
                match command {
                    Command::Unplug(again) => return End::Unplug(again),
                    Command::End => return End::Thread,
                    Command::Fault(fault) => self.fault(&fault),
                    Command::Serve(..) => {}
                }
            }
            if self.restart {
                return End::Unplug(Some(RESTART));
            }
            if self.work(line).is_err() {
                return End::Closed;
            }
            let wait = self.next_event().map(HostTime::from_now);
            if self.sleep(Some(line), wait) {
                match self.receive(&mut input, line) {
                    Ok(true) => {}
                    Ok(false) | Err(_) => return End::Closed,
                }
            }
        }
    }

    fn take_command(&self) -> Option<Command> {
        self.shared.lock().commands.pop_front()
    }

    /// When something is due by itself.
    fn next_event(&self) -> Option<HostTime> {
        let pumps = self.pumps.iter().filter_map(Pump::next_due);
        let imu = self.imu.as_ref().and_then(|imu| imu.next_due(&self.clock));
        pumps.chain(self.control_held).chain(self.motion.next_due()).chain(imu).min()
    }

    /// Everything that is due now.
    fn work(&mut self, line: &UnixStream) -> io::Result<()> {
        let now = HostTime::now();
        if self.control_held.is_some_and(|end| end <= now) {
            self.control_held = None;
            while let Some((submit, data)) = self.held.pop_front() {
                self.control_transfer(line, &submit, &data)?;
            }
        }
        let settings = self.settings();
        for pump in &mut self.pumps {
            pump.advance(now, &self.clock, &settings, self.silent, &self.shared);
            if !self.nak {
                pump.send(line, &self.shared)?;
            }
        }
        while !self.nak && !self.vendor_replies.is_empty() {
            let Some(urb) = self.vendor_urbs.pop_front() else { break };
            let reply = self.vendor_replies.pop_front().unwrap_or_default();
            let take = urb.length.min(reply.len());
            answer(line, urb.seq, 0, reply.get(..take).unwrap_or_default(), take)?;
        }
        self.imu_reports(line, now)?;
        self.reports(line, now)
    }

    fn settings(&self) -> Settings {
        let number = |unit, selector, default: i64| self.units.number(unit, selector).unwrap_or(default);
        Settings {
            exposure_us: number(3, 3, 8000).clamp(1, 165_000) as u32,
            gain: number(2, 4, 16) as u32,
            laser_mw: self.units.number(3, 4).map(|v| v as u32),
            emitter: self.units.number(3, 2).map(|v| v as u8),
            auto_exposure: number(3, 0x0B, 1) as u32,
        }
    }

    fn fault(&mut self, fault: &Fault) {
        self.shared.count_fault(fault.name());
        let now = HostTime::now();
        match fault {
            Fault::Frames { stream, damage, frames } => {
                if let Some(pump) = self.pump(stream)
                    && *frames > 0
                {
                    pump.damages.push_back((*damage, *frames));
                }
            }
            Fault::Silence => self.silent = true,
            Fault::StallEndpoint { stream } => {
                if let Some(pump) = self.pump(stream) {
                    pump.halted = true;
                }
            }
            Fault::Nak => self.nak = true,
            Fault::ControlTimeout(time) => self.control_held = Some(now.plus(*time)),
            Fault::ControlStall { times } => self.control_stalls = *times,
            Fault::ImuSkip(samples) => {
                if let Some(imu) = &mut self.imu {
                    imu.skip = *samples;
                }
            }
            Fault::ImuSilence(cycles) => {
                if let Some(imu) = &mut self.imu {
                    imu.silence(*cycles);
                }
            }
            Fault::ClockJump(us) => self.clock.jump(*us),
            Fault::ClockReset => self.clock.zero(now),
            Fault::Restart => self.restart = true,
            Fault::Clear => {
                self.silent = false;
                self.nak = false;
                if let Some(imu) = &mut self.imu {
                    imu.silence(0);
                }
                self.control_held = self.control_held.map(|_| now);
                self.control_stalls = 0;
                for pump in &mut self.pumps {
                    pump.damages.clear();
                    pump.halted = false;
                }
                self.firmware.fault(fault);
            }
            Fault::ReportError(code) => self.units.put(3, self.error_selector(), &[*code]),
            Fault::Reply { .. } | Fault::DamagedTable(_) | Fault::Uncalibrated => self.firmware.fault(fault),
        }
    }

    fn pump(&mut self, stream: &str) -> Option<&mut Pump> {
        let index = self.model.stream_index(stream).ok()?;
        self.pumps.get_mut(index)
    }

    /// Reads and executes messages from the host; `false` at the end.
    fn receive(&mut self, input: &mut Input, mut line: &UnixStream) -> io::Result<bool> {
        let free = input.space(HEADER);
        match line.read(free) {
            Ok(0) => return Ok(false),
            Ok(count) => input.end += count,
            Err(e) if e.kind() == io::ErrorKind::Interrupted => return Ok(true),
            Err(e) => return Err(e),
        }
        while let Some(head) = input.peek() {
            let command = usbip::parse(head).ok_or(io::ErrorKind::InvalidData)?;
            input.start += HEADER;
            match command {
                usbip::Command::Submit(submit) if submit.input => {
                    self.submitted(line, &submit, &[])?;
                }
                usbip::Command::Submit(submit) => {
                    if submit.length > 1 << 20 {
                        return Err(io::ErrorKind::InvalidData.into());
                    }
                    while input.end - input.start < submit.length {
                        let free = input.space(submit.length);
                        match line.read(free) {
                            Ok(0) => return Ok(false),
                            Ok(count) => input.end += count,
                            Err(e) if e.kind() == io::ErrorKind::Interrupted => {}
                            Err(e) => return Err(e),
                        }
                    }
                    let data = input.take(submit.length);
                    self.submitted(line, &submit, &data)?;
                }
                usbip::Command::Unlink { seq, victim } => {
                    let status = if self.forget(victim) { usbip::UNLINKED } else { 0 };
                    write_all(line, &mut [IoSlice::new(&usbip::unlink_done(seq, status))])?;
                }
            }
        }
        Ok(true)
    }

    /// A transfer arrives.
    fn submitted(&mut self, line: &UnixStream, submit: &Submit, data: &[u8]) -> io::Result<()> {
        let urb = Urb { seq: submit.seq, length: submit.length };
        if submit.endpoint == 0 {
            return self.control_transfer(line, submit, data);
        }
        let address = submit.endpoint | if submit.input { 0x80 } else { 0 };
        if let Some(at) = self.model.streams().position(|s| s.endpoint == address) {
            if let Some(pump) = self.pumps.get_mut(at) {
                pump.urbs.push_back(urb);
            }
            return Ok(());
        }
        match &self.model.vendor {
            Some(vendor) if vendor.in_endpoint == address => self.vendor_urbs.push_back(urb),
            Some(vendor) if vendor.out_endpoint == address && !self.nak => {
                self.vendor_request(data);
                return answer(line, urb.seq, 0, &[], submit.length);
            }
            _ => self.idle_urbs.push((address, urb)),
        }
        Ok(())
    }

    /// Cancels a transfer. Returns whether it was still queued.
    fn forget(&mut self, victim: u32) -> bool {
        let queues = self.pumps.iter_mut().map(|p| &mut p.urbs).chain([&mut self.vendor_urbs]);
        for queue in queues {
            if let Some(at) = queue.iter().position(|u| u.seq == victim) {
                queue.remove(at);
                return true;
            }
        }
        let before = self.idle_urbs.len() + self.held.len();
        self.idle_urbs.retain(|(_, u)| u.seq != victim);
        self.held.retain(|(s, _)| s.seq != victim);
        before > self.idle_urbs.len() + self.held.len()
    }

    /// Where the extension unit has the error report.
    fn error_selector(&self) -> u8 {
        if self.model.family == Family::L515 { 3 } else { 7 }
    }

    fn streaming(&self) -> bool {
        self.pumps.iter().any(Pump::is_running)
    }

    fn speed(&self) -> Speed {
        self.options.speed
    }
}

/// Ends a transfer.
fn answer(line: &UnixStream, seq: u32, status: i32, data: &[u8], actual: usize) -> io::Result<()> {
    let head = usbip::submit_done(seq, status, actual);
    write_all(line, &mut [IoSlice::new(&head), IoSlice::new(data)])
}

/// Buffer of bytes from the host that are not yet read.
struct Input {
    bytes: Vec<u8>,
    start: usize,
    end: usize,
}

impl Input {
    fn new() -> Self {
        Self { bytes: vec![0; 64 * HEADER], start: 0, end: 0 }
    }

    /// Room for the next read, with place for `wanted` bytes in all.
    fn space(&mut self, wanted: usize) -> &mut [u8] {
        self.bytes.copy_within(self.start..self.end, 0);
        self.end -= self.start;
        self.start = 0;
        if self.bytes.len() < wanted.max(self.end + HEADER) {
            self.bytes.resize(wanted.max(self.end + HEADER), 0);
        }
        &mut self.bytes[self.end..]
    }

    fn peek(&self) -> Option<&[u8; HEADER]> {
        self.bytes.get(self.start..self.end)?.first_chunk()
    }

    fn take(&mut self, length: usize) -> Vec<u8> {
        let data = self.bytes[self.start..self.start + length].to_vec();
        self.start += length;
        data
    }
}

/// Starts the thread of a device.
pub(crate) fn spawn(device: Device, name: &str) -> Result<std::thread::JoinHandle<()>> {
    std::thread::Builder::new()
        .name(name.to_owned())
        .spawn(move || device.run())
        .map_err(|e| crate::Error::new(format!("no thread for the camera: {e}")))
}
