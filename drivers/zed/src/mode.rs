//! The modes of the camera: their names in the factory calibration and the size of one image.

/// A sensor mode. The camera's own list of sizes and rates is read when it is opened; only the mapping from size to
/// part of the calibration is fixed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Mode {
    /// 2208x1242 per image.
    Hd2k,
    /// 1920x1080 per image.
    Hd1080,
    /// 1280x720 per image.
    Hd720,
    /// 672x376 per image.
    Vga,
}

impl Mode {
    /// Every mode, the largest first.
    pub const ALL: [Self; 4] = [Self::Hd2k, Self::Hd1080, Self::Hd720, Self::Vga];

    /// Width and height of the left or right image, pixels.
    pub const fn image_size(self) -> (u32, u32) {
        match self {
            Self::Hd2k => (2208, 1242),
            Self::Hd1080 => (1920, 1080),
            Self::Hd720 => (1280, 720),
            Self::Vga => (672, 376),
        }
    }

    /// Width and height of the side-by-side image, pixels.
    pub const fn wire_size(self) -> (u32, u32) {
        let (width, height) = self.image_size();
        (2 * width, height)
    }

    /// The mode whose left and right image have this size.
    pub fn of_size(width: u32, height: u32) -> Option<Self> {
        Self::ALL.into_iter().find(|m| m.image_size() == (width, height))
    }

    /// How the factory calibration calls it: `LEFT_CAM_HD`, `CV_HD`, …
    pub const fn suffix(self) -> &'static str {
        match self {
            Self::Hd2k => "2K",
            Self::Hd1080 => "FHD",
            Self::Hd720 => "HD",
            Self::Vga => "VGA",
        }
    }
}

/// One of the two cameras, as seen from behind.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Side {
    /// The left half of the image.
    Left,
    /// The right half.
    Right,
}

impl Side {
    /// Both, left first.
    pub const BOTH: [Self; 2] = [Self::Left, Self::Right];
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_find_their_mode() {
        for m in Mode::ALL {
            let (w, h) = m.image_size();
            assert_eq!(Mode::of_size(w, h), Some(m));
            assert_eq!(m.wire_size(), (2 * w, h));
        }
        assert_eq!(Mode::Hd720.wire_size(), (2560, 720));
        assert_eq!(Mode::of_size(640, 480), None);
    }
}
