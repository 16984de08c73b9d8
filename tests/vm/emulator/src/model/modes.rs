//! Sizes with their frame rates, as a model file writes them.

use super::{Format, Layout};
use crate::{Error, Result};

/// A size and the rates that it comes at.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Size {
    /// Pixels.
    pub width: u16,
    /// Pixels.
    pub height: u16,
    /// Frames per second, the default first.
    pub rates: Vec<u32>,
}

impl Size {
    /// Reads `640x480@30,15,6`.
    ///
    /// # Errors
    /// When the text is not such a mode.
    pub fn parse(text: &str) -> Result<Self> {
        let read = || {
            let (size, rates) = text.split_once('@')?;
            let (width, height) = size.split_once('x')?;
            let rates: Option<Vec<u32>> = rates.split(',').map(|r| r.trim().parse().ok()).collect();
            let rates = rates.filter(|r| r.iter().all(|rate| *rate > 0))?;
            Some(Self { width: width.trim().parse().ok()?, height: height.trim().parse().ok()?, rates })
        };
        read().ok_or_else(|| Error::new(format!("'{text}' is not a mode such as 640x480@30,15")))
    }

    /// Frame intervals in units of 100 ns, in the order of the rates.
    pub fn intervals(&self) -> impl Iterator<Item = u32> + '_ {
        self.rates.iter().map(|rate| 10_000_000 / rate)
    }
}

/// Mode that a stream was set to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Mode {
    /// `fourcc` of its format.
    pub fourcc: [u8; 4],
    /// How its images lie.
    pub layout: Layout,
    /// Bits of a pixel.
    pub bits: u8,
    /// Pixels, as the descriptor has them.
    pub width: u16,
    /// Pixels.
    pub height: u16,
    /// Between frames, in units of 100 ns of the device.
    pub interval: u32,
}

impl Mode {
    /// A format at a size and a rate.
    pub fn new(format: &Format, width: u16, height: u16, interval: u32) -> Self {
        let mut fourcc = [b' '; 4];
        for (to, from) in fourcc.iter_mut().zip(format.fourcc.bytes()) {
            *to = from;
        }
        Self { fourcc, layout: format.layout, bits: format.bits, width, height, interval }
    }

    /// Whether frames of the two hold the same pattern.
    pub fn same_image(&self, other: &Self) -> bool {
        Self { interval: other.interval, ..*self } == *other
    }

    /// The bytes of a frame.
    pub fn bytes(&self) -> usize {
        usize::from(self.width) * usize::from(self.height) * usize::from(self.bits) / 8
    }

    /// The bytes of a row.
    pub fn row(&self) -> usize {
        usize::from(self.width) * usize::from(self.bits) / 8
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_mode_is_read() {
        let size = Size::parse("848x480@90, 60,30").unwrap();
        assert_eq!((size.width, size.height, &size.rates[..]), (848, 480, &[90, 60, 30][..]));
        assert_eq!(size.intervals().collect::<Vec<_>>(), [111_111, 166_666, 333_333]);
        for wrong in ["640x480", "640@30", "ax1@30", "640x480@", "640x480@0"] {
            assert!(Size::parse(wrong).is_err(), "{wrong}");
        }
    }
}
