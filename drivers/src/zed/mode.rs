//! The modes of the camera: their names in the factory calibration and the sizes of one eye.

/// A sensor mode. The camera's own list of sizes and rates is asked for when it is opened; what is fixed is only
/// which part of the calibration belongs to which size.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Mode {
    /// 2208x1242 per eye.
    Hd2k,
    /// 1920x1080 per eye.
    Hd1080,
    /// 1280x720 per eye.
    Hd720,
    /// 672x376 per eye.
    Vga,
}

impl Mode {
    /// Every mode, the largest first.
    pub const ALL: [Self; 4] = [Self::Hd2k, Self::Hd1080, Self::Hd720, Self::Vga];

    /// Width and height of one eye, pixels.
    pub const fn eye_size(self) -> (u32, u32) {
        match self {
            Self::Hd2k => (2208, 1242),
            Self::Hd1080 => (1920, 1080),
            Self::Hd720 => (1280, 720),
            Self::Vga => (672, 376),
        }
    }

    /// Width and height of the side-by-side picture, pixels.
    pub const fn wire_size(self) -> (u32, u32) {
        let (width, height) = self.eye_size();
        (2 * width, height)
    }

    /// The mode whose eye has this size.
    pub fn of_eye(width: u32, height: u32) -> Option<Self> {
        Self::ALL.into_iter().find(|m| m.eye_size() == (width, height))
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

/// One of the two eyes, as seen from behind the camera.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Eye {
    /// The left half of the picture.
    Left,
    /// The right half.
    Right,
}

impl Eye {
    /// Both, left first.
    pub const BOTH: [Self; 2] = [Self::Left, Self::Right];
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_find_their_mode() {
        for m in Mode::ALL {
            let (w, h) = m.eye_size();
            assert_eq!(Mode::of_eye(w, h), Some(m));
            assert_eq!(m.wire_size(), (2 * w, h));
        }
        assert_eq!(Mode::Hd720.wire_size(), (2560, 720));
        assert_eq!(Mode::of_eye(640, 480), None);
    }
}
