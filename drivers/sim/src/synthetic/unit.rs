//! The simulated device on its bus: what stays true while drivers come and go.
//!
//! A unit outlives every [`depthrig_driver::Device`] and [`depthrig_driver::Stream`] made from it: whether it is plugged in, who
//! holds it, which faults are still to come, its clock and its frame counters. It also keeps the books that a
//! driver cannot see, which is what tests compare a driver's accounts with.

use super::config::{FaultKind, ScheduledFault, SyntheticConfig};
use super::drawing::Drawing;
use super::models::Model;
use super::profiles::model_of;
use super::timeline::{Boot, Timeline};
use core::sync::atomic::AtomicU32;
use core::time::Duration;
use depthrig_bus::sync::lock;
use depthrig_bus::{DropCounts, DropReason, HostTime};
use depthrig_driver::{DeviceInfo, Error, ErrorKind, Result, StreamProfile};
use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard};

/// How many frames a unit remembers for [`SimTruth::frame`].
const HISTORY: usize = 4096;

/// A simulated device.
#[derive(Debug)]
pub(crate) struct Unit {
    pub(crate) config: SyntheticConfig,
    pub(crate) model: &'static Model,
    pub(crate) info: DeviceInfo,
    pub(crate) profiles: Vec<StreamProfile>,
    pub(crate) timeline: Timeline,
    /// When the mount began to move; one moment for all cameras of a backend.
    pub(crate) world_start: HostTime,
    /// Renders what the cache lacks while the unit streams; without it, before.
    pub(crate) drawing: Option<Arc<Drawing>>,
    /// Gain of the colour camera.
    pub(crate) gain: AtomicU32,
    state: Mutex<State>,
}

/// Mutable state of a unit.
#[derive(Debug)]
pub(crate) struct State {
    pub(crate) boot: Boot,
    /// Not on the bus before this moment.
    pub(crate) absent_until: HostTime,
    /// Held by somebody else until this moment.
    busy_until: HostTime,
    is_open: bool,
    /// When it first streamed: the zero of the schedule.
    first_stream: Option<HostTime>,
    /// Faults to come, the next one last.
    to_come: Vec<(HostTime, ScheduledFault)>,
    /// The simulation's record of the current or last session, by stream.
    pub(crate) ledgers: Vec<Ledger>,
    history: VecDeque<SimFrame>,
}

/// The device's record of the frames of one stream since streaming was last started; every driver's
/// accounts must equal it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Ledger {
    /// Frames that the host could know of: those that came, and those lost before one that came.
    pub captured: u64,
    /// Frames that came whole and once.
    pub good: u64,
    /// Frames that did not, by the reason that the driver must find.
    pub drops: DropCounts,
}

/// The truth of one frame that a simulated device handed over.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SimFrame {
    /// Index of the stream.
    pub stream: usize,
    /// The device's frame counter.
    pub sequence: u64,
    /// Mid-exposure.
    pub capture: HostTime,
    /// Last byte on the host; unique per stream.
    pub arrival: HostTime,
    /// Pose of the mount that it shows.
    pub pose: u32,
    /// Its fault.
    pub fault: Option<FaultKind>,
}

impl Unit {
    pub(crate) fn new(
        config: SyntheticConfig,
        world_start: HostTime,
        drawing: Option<Arc<Drawing>>,
    ) -> Result<Self> {
        let model = model_of(&config)?;
        let profiles = super::profiles::profiles(&config)?;
        let info = DeviceInfo {
            backend: super::NAME,
            model: model.title.into(),
            serial: config.serial_or_default(),
            firmware: "simulated".into(),
            port: format!("sim:{}", config.serial_or_default()),
            calibration: "simulated".into(),
            motion: String::new(),
        };
        let state = State {
            boot: Boot { number: 0, at: world_start, set_back_us: 0 },
            absent_until: world_start,
            busy_until: world_start,
            is_open: false,
            first_stream: None,
            to_come: Vec::new(),
            ledgers: Vec::new(),
            history: VecDeque::new(),
        };
        let timeline = Timeline::new(&config);
        let gain = AtomicU32::new(config.gain);
        let state = Mutex::new(state);
        Ok(Self { config, model, info, profiles, timeline, world_start, drawing, gain, state })
    }

    pub(crate) fn state(&self) -> MutexGuard<'_, State> {
        lock(&self.state)
    }

    /// Takes the unit for a driver.
    pub(crate) fn open(&self) -> Result<()> {
        let now = HostTime::now();
        let mut state = self.state();
        // Scheduled faults happen whether or not a driver is there to see them.
        while let Some(fault) = state.take_due(now) {
            if matches!(
                fault.kind,
                FaultKind::Unplug | FaultKind::ClockReset | FaultKind::TimeBackwards | FaultKind::OpenBusy
            ) {
                state.apply_to_unit(&fault);
            }
        }
        let label = self.config.label();
        if now < state.absent_until {
            return Err(Error::new(
                ErrorKind::NotFound,
                format!("{label} is not plugged in; check its cable"),
            ));
        }
        if state.is_open || now < state.busy_until {
            let message = format!("{label} is held by another program; end that one first");
            return Err(Error::new(ErrorKind::Busy, message));
        }
        state.is_open = true;
        Ok(())
    }

    /// Gives the unit back.
    pub(crate) fn release(&self) {
        self.state().is_open = false;
    }

    /// Notes that streaming began, which starts the schedule when it is the first time.
    pub(crate) fn begin_session(&self, streams: usize) -> HostTime {
        let now = HostTime::now();
        let mut state = self.state();
        state.ledgers = vec![Ledger::default(); streams];
        if state.first_stream.is_none() {
            state.first_stream = Some(now);
            let resets = self.config.clock.reset_at_s.iter().map(|at_s| ScheduledFault {
                at_s: *at_s,
                kind: FaultKind::ClockReset,
                duration_s: 0.0,
                count: 1,
            });
            for fault in self.config.faults.iter().copied().chain(resets) {
                state.schedule(now.plus_ns((fault.at_s * 1e9) as i64), fault);
            }
        }
        now
    }
}

impl State {
    fn schedule(&mut self, at: HostTime, fault: ScheduledFault) {
        let place = self.to_come.partition_point(|(t, _)| *t > at);
        self.to_come.insert(place, (at, fault));
    }

    /// When the next fault is due.
    pub(crate) fn next_fault(&self) -> Option<HostTime> {
        self.to_come.last().map(|(at, _)| *at)
    }

    /// Takes the next fault that is due.
    pub(crate) fn take_due(&mut self, now: HostTime) -> Option<DueFault> {
        if self.next_fault()? > now {
            return None;
        }
        let (at, fault) = self.to_come.pop()?;
        let lasts = Duration::from_secs_f64(fault.duration_s);
        Some(DueFault { at, until: at.plus(lasts), kind: fault.kind, lasts, count: fault.count })
    }

    /// Does what a fault does to the unit itself, whoever holds it.
    pub(crate) fn apply_to_unit(&mut self, fault: &DueFault) {
        let next = self.boot.number + 1;
        match fault.kind {
            FaultKind::Unplug => {
                self.absent_until = fault.until;
                self.boot = Boot { number: next, at: fault.until, set_back_us: 0 };
            }
            FaultKind::ClockReset => self.boot = Boot { number: next, at: fault.at, set_back_us: 0 },
            FaultKind::TimeBackwards => self.boot.set_back_us += fault.lasts.as_micros() as u64,
            FaultKind::OpenBusy => self.busy_until = fault.until,
            _ => {}
        }
    }

    /// Books a frame that is handed over, with `lost` frames lost before it.
    pub(crate) fn book(&mut self, frame: SimFrame, lost: u64) {
        if let Some(ledger) = self.ledgers.get_mut(frame.stream) {
            ledger.captured += lost + 1;
            ledger.drops.add(DropReason::DeviceGap, lost);
            match frame.fault {
                None => ledger.good += 1,
                Some(FaultKind::HalfFrame) => ledger.drops.add(DropReason::Incomplete, 1),
                Some(FaultKind::WrongSize) => ledger.drops.add(DropReason::WrongSize, 1),
                Some(FaultKind::Repeated) => ledger.drops.add(DropReason::OutOfOrder, 1),
                Some(_) => ledger.drops.add(DropReason::DeviceError, 1),
            }
        }
        if self.history.len() == HISTORY {
            self.history.pop_front();
        }
        self.history.push_back(frame);
    }
}

/// A fault whose moment has come.
#[derive(Debug, Clone, Copy)]
pub(crate) struct DueFault {
    pub(crate) at: HostTime,
    pub(crate) until: HostTime,
    pub(crate) kind: FaultKind,
    lasts: Duration,
    pub(crate) count: u32,
}

/// Ground truth of a simulated device, which a driver cannot see; also lets a test make it fail.
#[derive(Debug, Clone)]
pub struct SimTruth(pub(crate) Arc<Unit>);

impl SimTruth {
    /// The device's record of the frames of `stream` since streaming was last started.
    pub fn ledger(&self, stream: usize) -> Ledger {
        self.0.state().ledgers.get(stream).copied().unwrap_or_default()
    }

    /// The frame of `stream` that arrived at `arrival`, if it is one of the last 4096.
    pub fn frame(&self, stream: usize, arrival: HostTime) -> Option<SimFrame> {
        let state = self.0.state();
        state.history.iter().rev().find(|f| f.stream == stream && f.arrival == arrival).copied()
    }

    /// Every frame that the device handed over lately, oldest first; at most 4096.
    pub fn frames(&self) -> Vec<SimFrame> {
        self.0.state().history.iter().copied().collect()
    }

    /// Makes `kind` happen now; `duration` and `count` mean what they mean in [`ScheduledFault`].
    pub fn inject(&self, kind: FaultKind, duration: Duration, count: u32) {
        let fault = ScheduledFault { at_s: 0.0, kind, duration_s: duration.as_secs_f64(), count };
        self.0.state().schedule(HostTime::now(), fault);
    }

    /// Whether a driver holds the device now.
    pub fn is_open(&self) -> bool {
        self.0.state().is_open
    }

    /// Whether the device is plugged in now.
    pub fn is_present(&self) -> bool {
        self.0.state().absent_until <= HostTime::now()
    }
}
