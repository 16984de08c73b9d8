//! The firmware of a ZED 2i: the registers and the flash of its video bridge, and its IMU.

use depthrig_bus::HostTime;
use depthrig_zed::command::{Command, answer, serial_bytes};
use depthrig_zed::mode::Side;
use depthrig_zed::sensors::{REQUEST_REPORT, Record, STREAM_REPORT};
use std::collections::BTreeMap;

/// The unit and the selector of the vendor's commands.
pub(crate) const CONTROL: (u8, u8) = (4, 2);
const SERIAL_ADDRESS: u32 = 0x0001_8000;
const AUTO_EXPOSURE: [u32; 2] = [0x8018_1033, 0x8018_1833];
/// Without a word from the host for so long, the IMU stops.
const SILENCE_NS: i64 = 2_000_000_000;
/// Between two records: 400 a second.
pub(crate) const PERIOD_NS: i64 = 2_500_000;

/// The video bridge.
#[derive(Debug, Default)]
pub(crate) struct Bridge {
    system: BTreeMap<u32, u8>,
    sensors: BTreeMap<(u8, u16), u8>,
    pins: BTreeMap<u8, bool>,
}

impl Bridge {
    /// Executes a command and returns the value that the control then holds.
    pub fn command(&mut self, block: &[u8], serial: &str) -> Vec<u8> {
        let mut reply = block.to_vec();
        let index = |side: Side| u8::from(side == Side::Right);
        match Command::parse(block) {
            Some(Command::ReadFlash { address, length }) => {
                let flash = serial_bytes(serial).unwrap_or_default();
                let byte = |at: u32| {
                    let offset = at.checked_sub(SERIAL_ADDRESS).and_then(|o| usize::try_from(o).ok());
                    offset.and_then(|o| flash.get(o)).copied().unwrap_or(0xFF)
                };
                let data: Vec<u8> = (0..u32::from(length)).map(|i| byte(address.wrapping_add(i))).collect();
                answer(&mut reply, &data);
            }
            Some(Command::ReadSystem { address }) => {
                let default = if AUTO_EXPOSURE.contains(&address) { 0x02 } else { 0 };
                answer(&mut reply, &[self.system.get(&address).copied().unwrap_or(default)]);
            }
            Some(Command::WriteSystem { address, value }) => drop(self.system.insert(address, value)),
            Some(Command::ReadSensor { side, address }) => {
                answer(&mut reply, &[self.sensors.get(&(index(side), address)).copied().unwrap_or(0)]);
            }
            Some(Command::WriteSensor { side, address, value }) => {
                self.sensors.insert((index(side), address), value);
            }
            Some(Command::SetPin { pin, high }) => drop(self.pins.insert(pin, high)),
            Some(Command::GetPin { pin }) => {
                answer(&mut reply, &[self.pins.get(&pin).copied().unwrap_or(false).into()]);
            }
            Some(Command::PinDirection { .. }) | None => {}
        }
        reply
    }
}

/// The IMU.
#[derive(Debug, Default)]
pub(crate) struct Motion {
    heard: Option<HostTime>,
    next: HostTime,
    count: u64,
    frames: u64,
}

impl Motion {
    /// A feature report is written.
    pub fn feature(&mut self, report: &[u8], now: HostTime) {
        match report {
            [STREAM_REPORT, 0, ..] => self.heard = None,
            [STREAM_REPORT, ..] => {
                if self.heard.is_none() {
                    self.next = now;
                }
                self.heard = Some(now);
            }
            [REQUEST_REPORT, 0xF2, ..] => self.heard = self.heard.map(|_| now),
            _ => {}
        }
    }

    /// A feature report is read.
    pub fn read_feature(&self, id: u8) -> Vec<u8> {
        match id {
            STREAM_REPORT => vec![STREAM_REPORT, self.heard.is_some().into()],
            _ => vec![id, 0],
        }
    }

    /// When the next record is due.
    pub fn next_due(&self) -> Option<HostTime> {
        self.heard.map(|_| self.next)
    }

    /// The record that is due now, if one is. `frames` counts the images whose exposure has begun.
    pub fn record(&mut self, now: HostTime, frames: Option<u64>) -> Option<Vec<u8>> {
        let heard = self.heard?;
        if now.since_ns(heard) > SILENCE_NS {
            self.heard = None;
            return None;
        }
        if now < self.next {
            return None;
        }
        // The IMU measures on its own clock, whenever it may send; samples not sent in time are lost.
        let behind = now.since_ns(self.next) / PERIOD_NS;
        let measured = self.next.plus_ns(behind * PERIOD_NS);
        self.next = measured.plus_ns(PERIOD_NS);
        self.count += behind.cast_unsigned() + 1;
        let new = frames.is_some_and(|frames| frames > self.frames);
        self.frames = frames.unwrap_or(self.frames);
        let wave = (self.count % 400) as i16 - 200;
        let record = Record {
            motion_valid: true,
            // 39.0625 µs a tick.
            ticks: (measured.ns() as u64).saturating_mul(2) / 78_125,
            gyro_raw: [wave, -wave, 3],
            acceleration_raw: [0, 4096, wave],
            frame_sync: new,
            can_sync: true,
            frame_count: self.frames as u32,
            temperature_raw: 3150,
            field_raw: (self.count.is_multiple_of(8)).then_some([320, -160, 640]),
            air_raw: (self.count.is_multiple_of(16)).then_some((2950, 101_325, 40_000)),
            image_sensors_raw: [3820, 3815],
        };
        Some(record.build().to_vec())
    }
}
