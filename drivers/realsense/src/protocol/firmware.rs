//! A firmware version, ordered.

use core::fmt;
use core::str::FromStr;

/// A firmware version `a.b.c.d`; newer is greater.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub struct Firmware(pub [u8; 4]);

impl Firmware {
    /// The version `a.b.c.d`.
    pub const fn new(a: u8, b: u8, c: u8, d: u8) -> Self {
        Self([a, b, c, d])
    }

    /// From four bytes as a camera stores them, lowest part first.
    pub const fn from_device(bytes: [u8; 4]) -> Self {
        let [d, c, b, a] = bytes;
        Self([a, b, c, d])
    }

    /// The four bytes as a camera stores them.
    pub const fn to_device(self) -> [u8; 4] {
        let [a, b, c, d] = self.0;
        [d, c, b, a]
    }
}

impl fmt::Display for Firmware {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [a, b, c, d] = self.0;
        write!(f, "{a}.{b}.{c}.{d}")
    }
}

impl FromStr for Firmware {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let wrong =
            || format!("invalid firmware version \"{text}\"; it has four numbers of 0 to 255, as 5.16.0.1");
        let parts: Vec<u8> =
            text.split('.').map(str::parse).collect::<Result<_, _>>().map_err(|_| wrong())?;
        parts.try_into().map(Self).map_err(|_| wrong())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_lowest_part_comes_first_on_the_wire() {
        let version = Firmware::from_device([0x64, 0x07, 0x0C, 0x05]);
        assert_eq!(version.to_string(), "5.12.7.100");
        assert_eq!(version.to_device(), [0x64, 0x07, 0x0C, 0x05]);
    }

    #[test]
    fn versions_are_ordered_by_number_not_by_letter() {
        assert!(Firmware::new(5, 12, 7, 100) > Firmware::new(5, 9, 15, 1));
        assert!(Firmware::new(5, 9, 15, 1) < Firmware::new(5, 9, 15, 2));
    }

    #[test]
    fn text_is_read_strictly() {
        assert_eq!("5.16.0.1".parse(), Ok(Firmware::new(5, 16, 0, 1)));
        for wrong in ["", "5.16.0", "5.16.0.1.2", "5.16.0.256", "5.16.x.1", "5..0.1"] {
            assert!(wrong.parse::<Firmware>().is_err(), "{wrong}");
        }
    }
}
