//! How a scan lies in memory: one number for each element that is on, in the order of their indices, each at a multiple
//! of its own size.

use depthrig_driver::{Error, ErrorKind, Result};

/// The most elements of a scan: three axes and a time.
pub const ELEMENTS: usize = 4;

/// One number of a scan, as its file `_type` has it: `le:s32/32>>0`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Element {
    big_endian: bool,
    signed: bool,
    /// Bits that mean something.
    pub bits: u32,
    storage: u32,
    shift: u32,
}

impl Element {
    /// Reads the file `_type` of an element.
    ///
    /// # Errors
    /// [`ErrorKind::Protocol`] for a type that the kernel's ABI does not describe.
    pub fn parse(text: &str) -> Result<Self> {
        Self::parsed(text.trim()).ok_or_else(|| {
            Error::new(ErrorKind::Protocol, format!("invalid type \"{}\" of a sensor's number", text.trim()))
        })
    }

    fn parsed(text: &str) -> Option<Self> {
        let (endian, rest) = text.split_once(':')?;
        let sign = rest.chars().next().filter(|c| matches!(c, 's' | 'u'))?;
        let (bits, rest) = rest.get(1..)?.split_once('/')?;
        let (storage, shift) = rest.split_once(">>")?;
        let element = Self {
            big_endian: match endian {
                "le" => false,
                "be" => true,
                _ => return None,
            },
            signed: sign == 's',
            bits: bits.parse().ok()?,
            storage: storage.parse().ok()?,
            shift: shift.parse().ok()?,
        };
        let fits =
            (1..=element.storage).contains(&element.bits) && element.shift <= element.storage - element.bits;
        (fits && matches!(element.storage, 8 | 16 | 32 | 64)).then_some(element)
    }

    const fn bytes(self) -> usize {
        self.storage as usize / 8
    }

    /// The number in `bytes`, which are as many as it takes.
    fn value(self, bytes: &[u8]) -> i64 {
        let byte = |sum: u64, b: &u8| sum << 8 | u64::from(*b);
        let raw = if self.big_endian { bytes.iter().fold(0, byte) } else { bytes.iter().rev().fold(0, byte) };
        let unused = 64 - self.bits;
        let top = raw >> self.shift << unused;
        if self.signed { top.cast_signed() >> unused } else { (top >> unused).cast_signed() }
    }
}

/// One measurement.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Scan {
    /// Counts along x, y and z.
    pub axes: [i32; 3],
    /// Nanoseconds of the device's clock, or of the host's where the device sends no time.
    pub time_ns: i64,
}

/// Where the numbers of a scan are.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Layout {
    /// x, y, z and the time.
    places: [(usize, Element); ELEMENTS],
    bytes: usize,
}

impl Layout {
    /// The layout of x, y, z and the time, each with its index.
    pub fn new(elements: [(u32, Element); ELEMENTS]) -> Self {
        let mut order: [usize; ELEMENTS] = [0, 1, 2, 3];
        order.sort_by_key(|at| elements.get(*at).map(|(index, _)| *index));
        let mut places = elements.map(|(_, element)| (0, element));
        let mut end = 0usize;
        let mut widest = 1;
        for at in order {
            if let Some((start, element)) = places.get_mut(at) {
                *start = end.next_multiple_of(element.bytes());
                end = *start + element.bytes();
                widest = widest.max(element.bytes());
            }
        }
        Self { places, bytes: end.next_multiple_of(widest) }
    }

    /// Bytes of a scan.
    pub const fn bytes(&self) -> usize {
        self.bytes
    }

    /// Bits of an axis that mean something.
    pub const fn bits(&self) -> u32 {
        self.places[0].1.bits
    }

    /// Reads a scan; `None` when it is too short.
    pub fn read(&self, bytes: &[u8]) -> Option<Scan> {
        let value = |(start, element): (usize, Element)| {
            bytes.get(start..start + element.bytes()).map(|b| element.value(b))
        };
        let [x, y, z, time] = self.places.map(value);
        Some(Scan { axes: [x? as i32, y? as i32, z? as i32], time_ns: time? })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn layout(types: [&str; 4], indices: [u32; 4]) -> Layout {
        let mut at = 0;
        Layout::new(types.map(|text| {
            at += 1;
            (indices[at - 1], Element::parse(text).unwrap())
        }))
    }

    /// The three scans of kernels and firmware that are known, by hand.
    #[test]
    fn scans_of_known_sensors_are_read() {
        let wide = layout(["le:s32/32>>0", "le:s32/32>>0", "le:s32/32>>0", "le:s64/64>>0"], [0, 1, 2, 3]);
        assert_eq!((wide.bytes(), wide.bits()), (24, 32));
        let mut bytes = vec![1, 0, 0, 0, 0xFE, 0xFF, 0xFF, 0xFF, 0, 1, 0, 0, 9, 9, 9, 9];
        bytes.extend(1_234_567_890_123i64.to_le_bytes());
        assert_eq!(wide.read(&bytes), Some(Scan { axes: [1, -2, 256], time_ns: 1_234_567_890_123 }));
        assert_eq!(wide.read(&bytes[..23]), None);
        // 16 bits mean something, and what stands above them is the next axis.
        let narrow = layout(["le:s16/32>>0", "le:s16/32>>0", "le:s16/32>>0", "le:s64/64>>0"], [0, 1, 2, 3]);
        assert_eq!(narrow.read(&[&[0xFF, 0xFF, 7, 7], &bytes[4..]].concat()).unwrap().axes, [-1, -2, 256]);
        let mixed = layout(["be:u12/16>>4", "le:s8/8>>0", "le:s16/16>>0", "le:s64/64>>0"], [3, 1, 0, 2]);
        assert_eq!(mixed.bytes(), 24);
    }

    #[test]
    fn a_type_that_is_none_is_refused() {
        for text in [
            "",
            "le",
            "le:s32",
            "le:x32/32>>0",
            "le:s33/32>>0",
            "le:s32/32>>1",
            "le:s24/24>>0",
            "me:s8/8>>0",
            "le:s0/8>>0",
        ] {
            assert!(Element::parse(text).is_err(), "{text}");
        }
    }

    proptest! {
        #[test]
        fn a_number_of_any_width_reads_back(value: i64, bits in 1u32..=32, extra in 0u32..8, big: bool, signed: bool) {
            let shift = extra.min(64 - bits);
            let sign = if signed { 's' } else { 'u' };
            let element = Element::parse(&format!("{}:{sign}{bits}/64>>{shift}", if big { "be" } else { "le" })).unwrap();
            let stored = (value as u64) << shift;
            let bytes = if big { stored.to_be_bytes() } else { stored.to_le_bytes() };
            let modulus = 1i128 << bits;
            let mut wanted = i128::from(value).rem_euclid(modulus);
            if signed && wanted >= modulus / 2 {
                wanted -= modulus;
            }
            prop_assert_eq!(i128::from(element.value(&bytes)), wanted);
        }
    }
}
