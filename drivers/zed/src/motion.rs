//! The IMU of a camera that streams: a thread of its own reads its records and keeps it awake.
//!
//! It gives the temperatures of both image sensors for the frames' headers, the samples of the stream `imu` through a
//! queue of [`QUEUE`] of them, and, for a program that links this crate, the latest sample.
//!
//! **Time.** The IMU counts 25600 ticks a second. Each record's ticks and arrival go into a [`ClockMap`], as those of a
//! camera do. A record that says `frame_sync` is the first after an exposure began, so its time is that of the
//! exposure's start, late by at most the 2.5 ms between records.
//!
//! **Numbers.** The IMU has no counter. Samples are numbered by its clock, so that a record that never came is a gap. A
//! sample for which the queue has no room is a gap too, and the next one reports it ([`Sample::lost_before`]), so that
//! the reader of the queue can count it as lost here and not by the IMU.

use super::hid::Reports;
use super::sensors::{self, Record};
use core::sync::atomic::{AtomicBool, Ordering};
use core::time::Duration;
use depthrig_bus::{FrameFlags, HostTime, MotionFlags, MotionSample};
use depthrig_driver::clock::{ClockConfig, ClockMap, ClockQuality};
use depthrig_driver::{Error, ErrorKind, Result};
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::sync::{Arc, Mutex};

/// Period of the keep-alive report. The IMU stops a few seconds after the last one.
const KEEP_ALIVE: Duration = Duration::from_secs(1);
/// How long one read waits; also how late the thread notices that it is to end.
const WAIT: Duration = Duration::from_millis(50);
/// After so long without a record the IMU is restarted: its previous user may have stopped it just now.
const SILENCE: Duration = Duration::from_millis(500);
/// Nanoseconds from one record to the next.
const PERIOD_NS: u64 = 2_500_000;
/// Capacity of the sample queue: 2.5 s of samples.
pub const QUEUE: usize = 1024;
/// Records that may be missing at once: an hour of them.
const JUMP: u64 = 3600 * 400;
/// Records between two looks at how the clock's map is doing: a second of them.
const QUALITY_EVERY: u64 = 400;

/// A record and when it was measured.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sample {
    /// The measured record.
    pub record: Record,
    /// Its number by the IMU's clock, from 1.
    pub number: u64,
    /// When, on the host's clock.
    pub time: HostTime,
    /// The time is right within this much, apart from the constant least latency of the transport, which is unknown.
    pub uncertainty_ns: u64,
    /// The IMU's clock, ticks, unwrapped.
    pub device_time: u64,
    /// Number of the clock's map.
    pub epoch: u32,
    /// Facts about the time.
    pub flags: FrameFlags,
    /// When it had arrived.
    pub arrival: HostTime,
    /// Samples just before it for which the queue had no room.
    pub lost_before: u64,
}

impl Sample {
    /// Converts it to the bus's format: rad/s and m/s² along the IMU's own axes.
    pub fn for_bus(&self) -> MotionSample {
        let Record { motion_valid, gyro_raw, acceleration_raw, frame_sync, .. } = self.record;
        let three = |v: [f64; 3]| if motion_valid { v.map(|v| v as f32) } else { [f32::NAN; 3] };
        // The sensor reports the end of the 16-bit range for every value beyond it.
        let clipped = |raw: [i16; 3]| motion_valid && raw.iter().any(|v| matches!(*v, i16::MIN | i16::MAX));
        let flag = |is: bool, flag: MotionFlags| if is { flag.0 } else { 0 };
        MotionSample {
            time_ns: self.time.ns(),
            device_time: self.device_time,
            sequence: self.number,
            uncertainty_ns: u32::try_from(self.uncertainty_ns).unwrap_or(u32::MAX),
            accel_offset_ns: 0,
            gyro_rad_s: three(self.record.gyro_rad_s()),
            accel_m_s2: three(self.record.acceleration_m_s2()),
            temperature_c: self.record.own_c().map_or(f32::NAN, |c| c as f32),
            flags: flag(frame_sync, MotionFlags::FRAME_SYNC)
                | flag(clipped(acceleration_raw), MotionFlags::ACCEL_CLIPPED)
                | flag(clipped(gyro_raw), MotionFlags::GYRO_CLIPPED),
        }
    }
}

/// Counts of what has arrived so far.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Tally {
    /// Records.
    pub records: u64,
    /// Reports that were not valid records.
    pub rejected: u64,
    /// Records that began an exposure.
    pub frame_syncs: u64,
    /// Records that the IMU's clock says should have come in between and did not.
    pub missed: u64,
    /// Samples for which the queue had no room.
    pub overflowed: u64,
}

#[derive(Default)]
struct State {
    tally: Tally,
    latest: Option<Sample>,
    /// The last record that began an exposure.
    exposure: Option<Sample>,
    image_sensors_c: [Option<f64>; 2],
    quality: Option<ClockQuality>,
    ended: Option<String>,
}

#[derive(Default)]
struct Shared {
    stop: AtomicBool,
    state: Mutex<State>,
}

/// The running reader. Dropping it stops the IMU.
pub struct Motion {
    shared: Arc<Shared>,
}

impl Motion {
    /// Starts the thread that starts the IMU and reads it; `device` names the camera. What the IMU says against it is
    /// in [`Self::problem`].
    ///
    /// # Errors
    /// [`ErrorKind::Io`] when the system refuses a thread.
    pub fn start(reports: Box<dyn Reports>, device: &str) -> Result<Self> {
        Self::spawn(reports, device, None)
    }

    /// The same, and every sample in order through a queue.
    ///
    /// # Errors
    /// As [`Self::start`].
    pub fn start_streaming(reports: Box<dyn Reports>, device: &str) -> Result<(Self, Receiver<Sample>)> {
        let (send, samples) = sync_channel(QUEUE);
        Ok((Self::spawn(reports, device, Some(send))?, samples))
    }

    fn spawn(mut reports: Box<dyn Reports>, device: &str, send: Option<SyncSender<Sample>>) -> Result<Self> {
        let shared = Arc::new(Shared::default());
        let theirs = Arc::clone(&shared);
        let name = device.to_owned();
        std::thread::Builder::new()
            .name("zed-motion".to_owned())
            .spawn(move || {
                let end = run(reports.as_mut(), &theirs, send.as_ref());
                if let Err(e) = &end {
                    tracing::warn!(camera = name, error = %e, "the IMU is no longer read");
                }
                lock(&theirs.state).ended = end.err().map(|e| e.to_string());
            })
            .map_err(|e| {
                Error::new(ErrorKind::Io, format!("{device}: no thread for the IMU")).with_source(e)
            })?;
        Ok(Self { shared })
    }

    /// The newest sample.
    pub fn latest(&self) -> Option<Sample> {
        lock(&self.shared.state).latest
    }

    /// The sample that began the newest exposure: its record has the number of exposures.
    pub fn exposure(&self) -> Option<Sample> {
        lock(&self.shared.state).exposure
    }

    /// Counts of what has arrived so far.
    pub fn tally(&self) -> Tally {
        lock(&self.shared.state).tally
    }

    /// Temperatures of the left and the right image sensor, °C, as last said.
    pub fn image_sensors_c(&self) -> [Option<f64>; 2] {
        lock(&self.shared.state).image_sensors_c
    }

    /// How the map of its clock was doing, a second ago at the most.
    pub fn quality(&self) -> Option<ClockQuality> {
        lock(&self.shared.state).quality
    }

    /// Why the IMU is no longer read, if so.
    pub fn problem(&self) -> Option<String> {
        lock(&self.shared.state).ended.clone()
    }
}

impl Drop for Motion {
    fn drop(&mut self) {
        // The thread is not waited for: a device that hangs would hang its camera too.
        self.shared.stop.store(true, Ordering::Relaxed);
    }
}

fn lock(state: &Mutex<State>) -> std::sync::MutexGuard<'_, State> {
    depthrig_bus::sync::lock(state)
}

fn run(reports: &mut dyn Reports, shared: &Shared, queue: Option<&SyncSender<Sample>>) -> Result<()> {
    let tick_ns = sensors::TICK_PS as f64 / 1000.0;
    let mut clock = ClockMap::new(ClockConfig::new(64, tick_ns, PERIOD_NS));
    reports.send_feature(sensors::stream_report(true))?;
    let mut awake_until = HostTime::now().plus(KEEP_ALIVE);
    let mut silent_at = HostTime::now().plus(SILENCE);
    let mut buffer = [0; 64];
    let mut last_ticks: Option<u64> = None;
    let mut last: Option<(u32, HostTime)> = None;
    let mut sequence = 0;
    let mut lost_before = 0;
    while !shared.stop.load(Ordering::Relaxed) {
        if awake_until.from_now().is_zero() {
            reports.send_feature(sensors::keep_alive())?;
            awake_until = HostTime::now().plus(KEEP_ALIVE);
        }
        if silent_at.from_now().is_zero() {
            reports.send_feature(sensors::stream_report(true))?;
            silent_at = HostTime::now().plus(SILENCE);
        }
        let Some(n) = reports.read(&mut buffer, WAIT)? else { continue };
        let arrival = HostTime::now();
        silent_at = arrival.plus(SILENCE);
        let Ok(record) = Record::parse(buffer.get(..n).unwrap_or_default()) else {
            lock(&shared.state).tally.rejected += 1;
            continue;
        };
        // The IMU has no counter; how many records there should have been follows from its clock.
        let steps = last_ticks.map_or(1, |last| {
            let ticks = record.ticks.saturating_sub(last);
            let steps = (ticks as f64 * tick_ns / PERIOD_NS as f64).round().max(1.0) as u64;
            // More is not a gap: the clock jumped.
            if steps > JUMP { 1 } else { steps }
        });
        last_ticks = Some(record.ticks);
        sequence += steps;
        let mapped = clock.observe(record.ticks, sequence, arrival);
        // Ticks that stand still are another sample all the same, and samples of an epoch rise.
        let time = match last {
            Some((epoch, last)) if epoch == mapped.epoch && mapped.capture_time <= last => last.plus_ns(1),
            _ => mapped.capture_time,
        };
        last = Some((mapped.epoch, time));
        let sample = Sample {
            record,
            number: sequence,
            time,
            uncertainty_ns: mapped.uncertainty_ns,
            device_time: mapped.device_time,
            epoch: mapped.epoch,
            flags: mapped.flags,
            arrival,
            lost_before,
        };
        let is_full = queue.is_some_and(|queue| matches!(queue.try_send(sample), Err(TrySendError::Full(_))));
        lost_before = if is_full { lost_before + 1 } else { 0 };
        let mut state = lock(&shared.state);
        state.tally.records += 1;
        state.tally.missed += steps - 1;
        state.tally.overflowed += u64::from(is_full);
        if state.tally.records.is_multiple_of(QUALITY_EVERY) {
            state.quality = Some(clock.quality());
        }
        state.latest = Some(sample);
        if record.frame_sync {
            state.tally.frame_syncs += 1;
            state.exposure = Some(sample);
        }
        for (kept, new) in state.image_sensors_c.iter_mut().zip(record.image_sensors_c()) {
            *kept = new.or(*kept);
        }
    }
    reports.send_feature(sensors::stream_report(false))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::mpsc;

    /// A fake IMU that sends the given records and notes the reports it receives.
    struct Unit {
        records: mpsc::Receiver<Vec<u8>>,
        sent: Arc<Mutex<Vec<[u8; 2]>>>,
    }

    impl Reports for Unit {
        fn send_feature(&mut self, report: [u8; 2]) -> Result<()> {
            self.sent.lock().unwrap().push(report);
            Ok(())
        }

        fn read(&mut self, into: &mut [u8], timeout: Duration) -> Result<Option<usize>> {
            match self.records.recv_timeout(timeout.min(Duration::from_millis(5))) {
                Ok(r) => {
                    into[..r.len()].copy_from_slice(&r);
                    Ok(Some(r.len()))
                }
                Err(mpsc::RecvTimeoutError::Timeout) => Ok(None),
                Err(mpsc::RecvTimeoutError::Disconnected) => {
                    Err(Error::new(ErrorKind::Disconnected, "pulled"))
                }
            }
        }
    }

    fn wait_for(mut ready: impl FnMut() -> bool) {
        let until = HostTime::now().plus(Duration::from_secs(20));
        while !ready() {
            assert!(!until.from_now().is_zero(), "nothing happened");
            std::thread::sleep(Duration::from_millis(2));
        }
    }

    #[test]
    fn records_are_counted_stamped_and_the_unit_is_kept_awake() {
        let (send, records) = mpsc::sync_channel(64);
        let sent = Arc::<Mutex<Vec<[u8; 2]>>>::default();
        let motion =
            Motion::start(Box::new(Unit { records, sent: Arc::clone(&sent) }), "ZED 2i at 1-1").unwrap();
        let began = HostTime::now();
        for i in 0..10u64 {
            // Three records are missing after the fifth.
            let ticks = 1000 + 64 * if i < 5 { i } else { i + 3 };
            let air_raw = (i == 4).then_some((2000, 0, 0));
            let record = Record {
                ticks,
                frame_sync: i == 6,
                frame_count: 77,
                air_raw,
                image_sensors_raw: [4100, 4250],
                ..Record::default()
            };
            send.send(record.build().to_vec()).unwrap();
        }
        send.send(vec![9, 9, 9]).unwrap();
        wait_for(|| motion.tally().rejected == 1);
        assert_eq!(
            motion.tally(),
            Tally { records: 10, rejected: 1, frame_syncs: 1, missed: 3, overflowed: 0 }
        );
        assert_eq!(motion.image_sensors_c(), [Some(41.0), Some(42.5)], "said once, kept since");
        let latest = motion.latest().unwrap();
        let exposure = motion.exposure().unwrap();
        assert_eq!((latest.record.ticks, exposure.record.frame_count), (1000 + 64 * 12, 77));
        assert!(latest.time >= began.plus(Duration::ZERO) && latest.time <= HostTime::now());
        assert!(latest.time > exposure.time);
        wait_for(|| sent.lock().unwrap().contains(&[0x21, 0xF2]));
        let starts = sent.lock().unwrap().iter().filter(|t| **t == [0x32, 1]).count();
        assert!(
            sent.lock().unwrap()[0] == [0x32, 1] && starts > 1,
            "silent for a second, it is started anew"
        );
        drop(motion);
        wait_for(|| sent.lock().unwrap().last() == Some(&[0x32, 0]));
    }

    #[test]
    fn a_unit_that_goes_away_says_so_and_hurts_nobody() {
        let (send, records) = mpsc::sync_channel(64);
        let motion = Motion::start(Box::new(Unit { records, sent: Arc::default() }), "ZED 2i").unwrap();
        drop(send);
        wait_for(|| motion.problem().is_some());
        assert_eq!((motion.problem().as_deref(), motion.latest()), (Some("pulled"), None));
    }
}
