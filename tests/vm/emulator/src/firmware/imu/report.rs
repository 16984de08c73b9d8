//! The HID report descriptor of the IMU and its input reports.

use super::{ImuSensor, is_wide};
use crate::model::Model;

/// Items of a report descriptor (HID 1.11, section 6.2.2). Usages are of the page of sensors.
#[derive(Default)]
struct Items(Vec<u8>);

impl Items {
    fn raw(&mut self, bytes: &[u8]) -> &mut Self {
        self.0.extend_from_slice(bytes);
        self
    }

    fn usage(&mut self, usage: u16) -> &mut Self {
        let [low, high] = usage.to_le_bytes();
        self.raw(&[0x0A, low, high])
    }

    /// One field of `bits` for each of `count`, from `min` to `max`, in units of ten to the power of `exponent`.
    fn field(&mut self, min: i32, max: u32, bits: u8, count: u8, exponent: i8, main: &[u8]) -> &mut Self {
        self.raw(&[0x17]).raw(&min.to_le_bytes()).raw(&[0x27]).raw(&max.to_le_bytes());
        self.raw(&[0x75, bits, 0x95, count, 0x55, exponent as u8 & 0x0F]).raw(main)
    }

    /// A state: one byte that counts `names` from `min`.
    fn state(&mut self, usage: u16, min: u8, names: core::ops::RangeInclusive<u16>, main: u8) -> &mut Self {
        let most = min + (names.end() - names.start()) as u8;
        self.usage(usage).raw(&[0x15, min, 0x25, most, 0x75, 8, 0x95, 1, 0x55, 0, 0xA1, 0x02]);
        for name in names {
            self.usage(name);
        }
        self.raw(&[main, 0x00, 0xC0])
    }
}

const FEATURE: [u8; 2] = [0xB1, 0x02];
const INPUT: [u8; 2] = [0x81, 0x02];

/// The report descriptor of a model with an IMU.
pub(crate) fn descriptor(model: &Model) -> Vec<u8> {
    let wide = is_wide(model);
    let mut all = Items::default();
    all.raw(&[0x05, 0x20, 0x09, 0x01, 0xA1, 0x01]);
    // The type of the sensor, the change that its sensitivity is about, its first axis.
    for (kind, usage, sensitivity, axis) in
        [(ImuSensor::Accelerometer, 0x73, 0x1452, 0x0453), (ImuSensor::Gyroscope, 0x76, 0x1456, 0x0457)]
    {
        all.raw(&[0x09, usage, 0xA1, 0x00, 0x85, kind as u8]);
        // Connection, reporting, power, state.
        all.state(0x0309, 0, 0x0830..=0x0832, 0xB1);
        all.state(0x0316, 1, 0x0840..=0x0845, 0xB1);
        all.state(0x0319, 1, 0x0850..=0x0855, 0xB1);
        all.state(0x0201, 0, 0x0800..=0x0806, 0xB1);
        // Interval in milliseconds, as the kernel takes it, and sensitivity.
        all.usage(0x030E).field(0, 0xFFFF, 16, 1, 0, &FEATURE);
        all.usage(sensitivity).field(0, 0xFFFF, 16, 1, -3, &FEATURE);
        all.state(0x0201, 0, 0x0800..=0x0806, 0x81);
        // 64 bits of microseconds in two halves: the kernel warns of longer numbers.
        all.usage(0x0529).field(0, u32::MAX, 32, 2, -6, &INPUT);
        for axis in axis..axis + 3 {
            if wide {
                all.usage(axis).field(i32::MIN, i32::MAX as u32, 32, 1, -3, &INPUT);
            } else {
                all.usage(axis).field(i16::MIN.into(), i16::MAX as u32, 16, 1, -3, &INPUT);
            }
        }
        // Values of the vendor's own: 2 of 32 bits, 3 of 16, 2 of 8.
        for (at, bits) in [32, 32, 16, 16, 16, 8, 8].into_iter().enumerate() {
            all.usage(0x0544 + at as u16).field(0, u32::MAX >> (32 - bits), bits, 1, 0, &INPUT);
        }
        all.raw(&[0xC0]);
    }
    all.raw(&[0xC0]);
    all.0
}

/// An input report: id, state, time in microseconds, three axes, the vendor's own values.
pub(super) fn input(id: u8, ticks: u32, counts: [i32; 3], wide: bool) -> Vec<u8> {
    let mut bytes = vec![id, 2];
    bytes.extend(u64::from(ticks).to_le_bytes());
    for count in counts {
        if wide {
            bytes.extend(count.to_le_bytes());
        } else {
            bytes.extend((count as i16).to_le_bytes());
        }
    }
    bytes.resize(bytes.len() + 16, 0);
    bytes
}
