//! The IMU of a RealSense camera: accelerometer and gyroscope as HID sensors behind one interface.
//!
//! Reports and features: librealsense `src/hid/hid-types.h`, selectors of the rate `src/ds/ds-motion-common.h`, units
//! `src/proc/motion-transform.cpp` (Apache-2.0). The report descriptor is ours, in the terms of the HID Sensor usages
//! (HID Usage Tables 1.3, chapter 24), so that the kernel's sensor hub takes it.

mod report;

use crate::clock::DeviceClock;
use crate::model::{ImuChip, Model, from_hex};
use crate::{Error, Result};
use depthrig_bus::HostTime;
use std::collections::VecDeque;

/// D0, full power: the second name of the power states, which count from 1.
const FULL_POWER: u8 = 2;
/// From the measurement until the report is ready.
const LATENCY_NS: i64 = 400_000;
/// Reports that the device keeps for a host that is slow to ask.
const FIFO: usize = 32;

/// Which of the two sensors.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum ImuSensor {
    /// Report 1.
    Accelerometer = 1,
    /// Report 2.
    Gyroscope = 2,
}

/// A sample that the IMU measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ImuSample {
    /// Which sensor.
    pub sensor: ImuSensor,
    /// Its number since power-on, from 0, sent or not.
    pub index: u64,
    /// The camera's clock, microseconds.
    pub ticks: u32,
    /// When it was measured, on the host's clock.
    pub captured: HostTime,
    /// Counts along the sensor's own axes.
    pub counts: [i32; 3],
    /// It went into a report.
    pub is_sent: bool,
}

/// The report descriptor of the HID interface of `model`.
///
/// # Errors
/// When it has none.
pub(crate) fn report_descriptor(model: &Model) -> Result<Vec<u8>> {
    match (&model.hid, model.imu) {
        (Some(hid), None) => from_hex(&hid.report_descriptor),
        (Some(_), Some(_)) => Ok(report::descriptor(model)),
        (None, _) => Err(Error::new(format!("{} has no HID interface", model.name))),
    }
}

/// One sensor and its feature report.
#[derive(Debug, Clone)]
struct Sensor {
    kind: ImuSensor,
    reporting: u8,
    power: u8,
    interval: u16,
    sensitivity: u16,
    /// When it measures next, nanoseconds of the device; `None` while it is off.
    next_ns: Option<i64>,
    index: u64,
    /// It sends nothing until it has lost its power so many times.
    silent: u32,
}

impl Sensor {
    fn new(kind: ImuSensor) -> Self {
        Self {
            kind,
            reporting: 1,
            power: 6,
            interval: 1000,
            sensitivity: 0,
            next_ns: None,
            index: 0,
            silent: 0,
        }
    }

    /// Nanoseconds between two samples. The host's selector is 100000 divided by the rate in Hz, rounded by the kernel.
    fn period_ns(&self, chip: ImuChip) -> i64 {
        match (self.kind, chip, self.interval) {
            // A BMI055 measures acceleration 62.5 or 250 times a second.
            (ImuSensor::Accelerometer, ImuChip::Bmi055, 0..=400) => 4_000_000,
            (ImuSensor::Accelerometer, ImuChip::Bmi055, _) => 16_000_000,
            (_, _, 0..=250) => 2_500_000,
            (_, _, 251..=500) => 5_000_000,
            _ => 10_000_000,
        }
    }

    fn feature(&self) -> Vec<u8> {
        let mut bytes = vec![self.kind as u8, 0, self.reporting, self.power, 0];
        bytes.extend(self.interval.to_le_bytes());
        bytes.extend(self.sensitivity.to_le_bytes());
        bytes
    }

    /// Counts of sample `index`: three waves that no two axes share. Milli-g, or parts of a degree per second.
    fn counts(&self, index: u64, wide: bool) -> [i32; 3] {
        let wave = |period: u64| (index % period) as i32 - period as i32 / 2;
        match (self.kind, wide) {
            (ImuSensor::Accelerometer, _) => [wave(97), 1000 + wave(31), -500 + 3 * wave(61)],
            // 0.0001 degrees per second in 32 bits, 0.1 in 16.
            (ImuSensor::Gyroscope, true) => [9973 * wave(89), 1009 * wave(53), -701 * wave(71)],
            (ImuSensor::Gyroscope, false) => [11 * wave(89), 2 * wave(53), -3 * wave(71)],
        }
    }
}

/// The IMU since power-on.
#[derive(Debug)]
pub(crate) struct Imu {
    chip: ImuChip,
    /// Axes of 32 bits instead of 16.
    wide: bool,
    sensors: [Sensor; 2],
    ready: VecDeque<Vec<u8>>,
    /// Samples of the gyroscope that are to be lost.
    pub skip: u32,
}

impl Imu {
    /// The IMU of a model, if it has one.
    pub fn new(model: &Model) -> Option<Self> {
        let sensors = [Sensor::new(ImuSensor::Accelerometer), Sensor::new(ImuSensor::Gyroscope)];
        let wide = is_wide(model);
        model.imu.map(|chip| Self { chip, wide, sensors, ready: VecDeque::with_capacity(FIFO), skip: 0 })
    }

    /// GET_REPORT of a feature.
    pub fn read_feature(&self, id: u8) -> Option<Vec<u8>> {
        self.sensors.iter().find(|s| s.kind as u8 == id).map(Sensor::feature)
    }

    /// SET_REPORT of a feature: the sensor is switched on or off, or gets another rate.
    pub fn write_feature(&mut self, report: &[u8], running_ns: i64) -> Option<()> {
        let &[id, _, reporting, power, _, i0, i1, s0, s1] = report.first_chunk::<9>()?;
        let chip = self.chip;
        let sensor = self.sensors.iter_mut().find(|s| s.kind as u8 == id)?;
        let interval = u16::from_le_bytes([i0, i1]);
        let changed = interval != sensor.interval;
        sensor.reporting = reporting;
        sensor.power = power;
        sensor.interval = interval;
        sensor.sensitivity = u16::from_le_bytes([s0, s1]);
        let period = sensor.period_ns(chip);
        if power != FULL_POWER && sensor.next_ns.is_some() {
            sensor.silent = sensor.silent.saturating_sub(1);
        }
        sensor.next_ns = match (power == FULL_POWER, sensor.next_ns) {
            (false, _) => None,
            (true, Some(next)) if !changed => Some(next),
            (true, _) => Some((running_ns.div_euclid(period) + 1) * period),
        };
        Some(())
    }

    /// When a report is ready next.
    pub fn next_due(&self, clock: &DeviceClock) -> Option<HostTime> {
        self.sensors.iter().filter_map(|s| s.next_ns).min().map(|ns| clock.host(ns + LATENCY_NS))
    }

    /// Measures everything that is due, in the order of time, and returns it.
    pub fn advance(&mut self, now: HostTime, clock: &DeviceClock, silent: bool) -> Vec<ImuSample> {
        let mut measured = Vec::new();
        let until = clock.running_ns(now) - LATENCY_NS;
        loop {
            let due = self.sensors.iter_mut().filter_map(|s| s.next_ns.map(|ns| (ns, s)));
            let Some((at, sensor)) = due.min_by_key(|(ns, _)| *ns).filter(|(ns, _)| *ns <= until) else {
                break;
            };
            let counts = sensor.counts(sensor.index, self.wide);
            let kind = sensor.kind;
            let index = sensor.index;
            let is_silent = sensor.silent > 0;
            sensor.index += 1;
            sensor.next_ns = Some(at + sensor.period_ns(self.chip));
            let is_skipped = kind == ImuSensor::Gyroscope && self.skip > 0;
            self.skip -= u32::from(is_skipped);
            let is_sent = !silent && !is_silent && !is_skipped && self.ready.len() < FIFO;
            let ticks = clock.shown_us(at);
            if is_sent {
                self.ready.push_back(report::input(kind as u8, ticks, counts, self.wide));
            }
            let captured = clock.host(at);
            measured.push(ImuSample { sensor: kind, index, ticks, captured, counts, is_sent });
        }
        measured
    }

    /// Both sensors send nothing until they have lost their power `cycles` times.
    pub fn silence(&mut self, cycles: u32) {
        for sensor in &mut self.sensors {
            sensor.silent = cycles;
        }
    }

    /// The next report that waits for the host.
    pub fn take(&mut self) -> Option<Vec<u8>> {
        self.ready.pop_front()
    }

    /// Whether a report waits for the host.
    pub fn is_ready(&self) -> bool {
        !self.ready.is_empty()
    }
}

/// Firmware of a D400 from 5.16 on has axes of 32 bits (librealsense `src/ds/d400/d400-motion.cpp`,
/// `is_imu_high_accuracy`).
pub(crate) fn is_wide(model: &Model) -> bool {
    model.family == crate::model::Family::D400 && model.firmware >= [5, 16, 0, 0]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn imu(model: &str) -> Imu {
        Imu::new(&Model::named(model).unwrap()).unwrap()
    }

    #[test]
    fn rates_follow_the_selectors_of_the_vendor() {
        let mut rates = Vec::new();
        for (model, id, interval) in [
            ("d435i", 1, 1000),
            ("d435i", 1, 333),
            ("d455", 1, 1000),
            ("d455", 1, 250),
            ("d455", 2, 500),
            ("l515", 2, 1000),
            ("l515", 2, 250),
        ] {
            let mut imu = imu(model);
            let [low, high] = u16::to_le_bytes(interval);
            imu.write_feature(&[id, 0, 2, FULL_POWER, 0, low, high, 0, 0], 0).unwrap();
            assert_eq!(imu.read_feature(id).unwrap()[5..7], [low, high]);
            let clock = DeviceClock::new(HostTime::from_ns(0), 0, 0.0);
            let second = HostTime::from_ns(1_000_000_000 + LATENCY_NS);
            rates.push(imu.advance(second, &clock, false).len());
        }
        assert_eq!(rates, [62, 250, 100, 400, 200, 100, 400]);
    }

    #[test]
    fn silent_sensors_measure_again_when_they_had_no_power() {
        let mut imu = imu("d435i");
        let clock = DeviceClock::new(HostTime::from_ns(0), 0, 0.0);
        let mut sent = Vec::new();
        imu.silence(2);
        for (at, power) in [FULL_POWER, FULL_POWER, 6, FULL_POWER, 6, 6, FULL_POWER].into_iter().enumerate() {
            let begin = at as i64 * 100_000_000;
            imu.write_feature(&[2, 0, 2, power, 0, 0xFA, 0, 0, 0], begin).unwrap();
            let end = HostTime::from_ns(begin + 100_000_000);
            sent.push(imu.advance(end, &clock, false).iter().filter(|s| s.is_sent).count() > 0);
        }
        assert_eq!(sent, [false, false, false, false, false, false, true]);
    }

    #[test]
    fn a_report_has_its_fields_where_the_vendor_reads_them() {
        let mut imu = imu("d435i");
        imu.write_feature(&[2, 0, 2, FULL_POWER, 0, 0xFA, 0, 0, 0], 0).unwrap();
        let clock = DeviceClock::new(HostTime::from_ns(0), u32::MAX, 0.0);
        let sample = imu.advance(HostTime::from_ns(3_000_000), &clock, false).remove(0);
        let bytes = imu.take().unwrap();
        assert_eq!((bytes.len(), bytes[0]), (38, 2));
        assert_eq!(bytes[2..10], [0xC3, 0x09, 0, 0, 0, 0, 0, 0], "2499 us after the wrap");
        assert_eq!(bytes[10..14], sample.counts[0].to_le_bytes());
        assert_eq!(bytes[18..22], sample.counts[2].to_le_bytes());
    }
}
