//! The thread that switches the sensors of an IMU on and off: the kernel takes seconds for it.
//!
//! **Silent sensors.** Only sensors that had no power measure again when they are switched on. The kernel takes the
//! power away three to five seconds after a sensor was switched off (the delay of autosuspend in
//! `hid-sensor-trigger.c`, rounded up), so that sensors that fell silent stay off until it says so, or for [`COLD`]
//! where it says nothing.

use crate::iio::{FoundSensor, Switch};
use crate::protocol::imu::Rates;
use core::time::Duration;
use depthrig_bus::HostTime;
use depthrig_bus::sync::lock;
use depthrig_driver::{Error, ErrorKind, Result};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, TryRecvError, sync_channel};
use std::sync::{Mutex, MutexGuard};

/// The attributes of an accelerometer and of a gyroscope, by axis.
pub(super) const ACCELERATION: [&str; 3] = ["in_accel_x", "in_accel_y", "in_accel_z"];
pub(super) const ROTATION: [&str; 3] = ["in_anglvel_x", "in_anglvel_y", "in_anglvel_z"];

/// The longest that sensors stay off that fell silent.
pub(super) const COLD: Duration = Duration::from_secs(6);
/// Between two looks at whether they have lost their power.
const LOOK: Duration = Duration::from_millis(50);

/// The sensors of an IMU, and the rates that they are to have.
#[derive(Debug, Clone)]
pub(super) struct Pair {
    pub(super) accelerometer: FoundSensor,
    pub(super) gyroscope: FoundSensor,
    pub(super) rates: Rates,
    /// The longest that they stay off when they fell silent.
    pub(super) cold: Duration,
}

impl Pair {
    /// Whether the kernel says that neither has power.
    fn is_cold(&self) -> bool {
        [&self.accelerometer, &self.gyroscope].iter().all(|found| {
            let device = found.folder.parent().map(|parent| parent.join("power/runtime_status"));
            device
                .and_then(|file| std::fs::read_to_string(file).ok())
                .is_some_and(|t| t.trim() == "suspended")
        })
    }
}

/// A running thread. Dropping it switches the sensors off.
#[derive(Debug)]
pub(super) struct Switcher {
    orders: SyncSender<()>,
    outcomes: Receiver<Result<()>>,
}

impl Switcher {
    /// Starts the thread, which switches the sensors of the camera `label` on.
    ///
    /// # Errors
    /// [`ErrorKind::Io`] when the system refuses a thread.
    pub(super) fn spawn(pair: Pair, label: &str) -> Result<Self> {
        let (orders, ordered) = sync_channel(1);
        let (report, outcomes) = sync_channel(1);
        let thread = std::thread::Builder::new().name("realsense-imu".to_owned());
        thread.spawn(move || Worker::new(pair).run(&ordered, &report)).map_err(|e| {
            Error::new(ErrorKind::Io, format!("{label}: no thread for its IMU")).with_source(e)
        })?;
        Ok(Self { orders, outcomes })
    }

    /// How switching on came out, once after the start and once after each [`Self::restart`].
    pub(super) fn outcome(&self) -> Option<Result<()>> {
        match self.outcomes.try_recv() {
            Ok(outcome) => Some(outcome),
            Err(TryRecvError::Empty) => None,
            Err(TryRecvError::Disconnected) => {
                Some(Err(Error::new(ErrorKind::Disconnected, "the thread that switches its IMU has ended")))
            }
        }
    }

    /// Switches the sensors off and on again.
    pub(super) fn restart(&self) {
        // It fails when the thread has ended, which the next outcome reports.
        let _ = self.orders.try_send(());
    }
}

/// The stream that switched a sensor on last, and the time from which it can have power again.
#[derive(Debug, Default)]
struct Turn {
    /// A stream that is ended late must not switch off the sensors of the next one.
    number: u64,
    /// Silent sensors stay off until then at the latest, also for the next stream.
    cold_at: Option<HostTime>,
}

static TURNS: Mutex<BTreeMap<PathBuf, Turn>> = Mutex::new(BTreeMap::new());

fn turns() -> MutexGuard<'static, BTreeMap<PathBuf, Turn>> {
    lock(&TURNS)
}

struct Worker {
    pair: Pair,
    turn: u64,
}

impl Worker {
    fn new(pair: Pair) -> Self {
        let mut turns = turns();
        let turn = turns.entry(pair.accelerometer.folder.clone()).or_default();
        turn.number += 1;
        let turn = turn.number;
        Self { pair, turn }
    }

    fn folder(&self) -> &Path {
        &self.pair.accelerometer.folder
    }

    fn run(self, orders: &Receiver<()>, outcomes: &SyncSender<Result<()>>) {
        let mut outcome = self.on(orders);
        loop {
            // The receiver is gone if the stream has ended meanwhile; then the next order does not come either.
            let _ = outcomes.send(outcome);
            if orders.recv().is_err() {
                break;
            }
            outcome = self.off(true).and_then(|()| self.on(orders));
        }
        if let Err(e) = self.off(false) {
            tracing::debug!("the IMU is not switched off: {e}");
        }
    }

    /// Switches the sensors on as soon as they may, unless the stream ends before.
    fn on(&self, orders: &Receiver<()>) -> Result<()> {
        loop {
            let cold_at = turns().get(self.folder()).and_then(|turn| turn.cold_at);
            let wait = cold_at.map_or(Duration::ZERO, HostTime::from_now);
            if wait.is_zero() || self.pair.is_cold() {
                break;
            }
            if orders.recv_timeout(wait.min(LOOK)) == Err(RecvTimeoutError::Disconnected) {
                return Ok(());
            }
        }
        let Pair { accelerometer, gyroscope, rates, .. } = &self.pair;
        let mut turns = turns();
        let Some(turn) = turns.get_mut(self.folder()).filter(|turn| turn.number == self.turn) else {
            return Ok(());
        };
        turn.cold_at = None;
        let accel = Switch::prepare(accelerometer, ACCELERATION)?;
        let gyro = Switch::prepare(gyroscope, ROTATION)?;
        accel.write("in_accel_sampling_frequency", rates.accel_selector)?;
        gyro.write("in_anglvel_sampling_frequency", rates.gyro_selector)?;
        accel.on()?;
        gyro.on()
    }

    /// Switches them off; `is_silent` ones until they have lost their power.
    fn off(&self, is_silent: bool) -> Result<()> {
        let mut turns = turns();
        let Some(turn) = turns.get_mut(self.folder()).filter(|turn| turn.number == self.turn) else {
            return Ok(());
        };
        let done = [&self.pair.accelerometer, &self.pair.gyroscope].map(|found| Switch::of(found).off());
        if is_silent {
            turn.cold_at = Some(HostTime::now().plus(self.pair.cold));
        }
        done.into_iter().collect()
    }
}
