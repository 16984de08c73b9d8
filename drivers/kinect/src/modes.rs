//! The modes of an Azure Kinect: what its depth camera and its colour camera can be set to, and what each one shows.
//!
//! Sizes, crops and codes are those of the Azure Kinect Sensor SDK (MIT), `include/k4a/k4atypes.h` and
//! `src/transformation/mode_specific_calibration.c`.

/// A mode of the depth camera, which gives depth and infrared.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum DepthMode {
    /// Narrow field of view, 2x2 pixels as one: 320x288.
    Nfov2x2Binned,
    /// Narrow field of view: 640x576.
    NfovUnbinned,
    /// Wide field of view, 2x2 pixels as one: 512x512.
    Wfov2x2Binned,
    /// Wide field of view: 1024x1024, at most 15 Hz.
    WfovUnbinned,
    /// Infrared of the surroundings' own light, no depth: 1024x1024.
    PassiveIr,
}

/// An image cut out of a sensor that was read whole or binned.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Cut {
    /// Size of the whole sensor in pixels of the image.
    pub sensor: (u32, u32),
    /// First column and first row that the image shows.
    pub offset: (u32, u32),
    /// Size of the image.
    pub size: (u32, u32),
}

impl DepthMode {
    /// Every mode, in the SDK's order.
    pub const ALL: [Self; 5] =
        [Self::Nfov2x2Binned, Self::NfovUnbinned, Self::Wfov2x2Binned, Self::WfovUnbinned, Self::PassiveIr];

    /// The name used in configuration and messages.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Nfov2x2Binned => "nfov_2x2binned",
            Self::NfovUnbinned => "nfov_unbinned",
            Self::Wfov2x2Binned => "wfov_2x2binned",
            Self::WfovUnbinned => "wfov_unbinned",
            Self::PassiveIr => "passive_ir",
        }
    }

    /// The mode with this name, in either case: recordings write it in capitals, early ones with a small `x`.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|m| m.name().eq_ignore_ascii_case(name))
    }

    /// The SDK's `k4a_depth_mode_t`.
    pub const fn code(self) -> u32 {
        match self {
            Self::Nfov2x2Binned => 1,
            Self::NfovUnbinned => 2,
            Self::Wfov2x2Binned => 3,
            Self::WfovUnbinned => 4,
            Self::PassiveIr => 5,
        }
    }

    /// The part of the sensor that its images show.
    pub const fn cut(self) -> Cut {
        match self {
            Self::Nfov2x2Binned => Cut { sensor: (512, 512), offset: (96, 90), size: (320, 288) },
            Self::NfovUnbinned => Cut { sensor: (1024, 1024), offset: (192, 180), size: (640, 576) },
            Self::Wfov2x2Binned => Cut { sensor: (512, 512), offset: (0, 0), size: (512, 512) },
            Self::WfovUnbinned | Self::PassiveIr => {
                Cut { sensor: (1024, 1024), offset: (0, 0), size: (1024, 1024) }
            }
        }
    }

    /// Width and height of its images.
    pub const fn size(self) -> (u32, u32) {
        self.cut().size
    }

    /// Whether it measures depth.
    pub const fn has_depth(self) -> bool {
        !matches!(self, Self::PassiveIr)
    }

    /// The fastest rate, images per second.
    pub const fn max_rate_hz(self) -> u32 {
        if matches!(self, Self::WfovUnbinned) { 15 } else { 30 }
    }
}

/// A resolution of the colour camera.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum ColorResolution {
    /// 1280x720.
    P720,
    /// 1920x1080.
    P1080,
    /// 2560x1440.
    P1440,
    /// 2048x1536.
    P1536,
    /// 3840x2160.
    P2160,
    /// 4096x3072, at most 15 Hz.
    P3072,
}

impl ColorResolution {
    /// Every resolution, in the SDK's order.
    pub const ALL: [Self; 6] = [Self::P720, Self::P1080, Self::P1440, Self::P1536, Self::P2160, Self::P3072];

    /// The name used in configuration and messages.
    pub const fn name(self) -> &'static str {
        match self {
            Self::P720 => "720p",
            Self::P1080 => "1080p",
            Self::P1440 => "1440p",
            Self::P1536 => "1536p",
            Self::P2160 => "2160p",
            Self::P3072 => "3072p",
        }
    }

    /// The resolution with this name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|r| r.name().eq_ignore_ascii_case(name))
    }

    /// The resolution of images of this size.
    pub fn from_size(width: u32, height: u32) -> Option<Self> {
        Self::ALL.into_iter().find(|r| r.size() == (width, height))
    }

    /// The SDK's `k4a_color_resolution_t`.
    pub const fn code(self) -> u32 {
        match self {
            Self::P720 => 1,
            Self::P1080 => 2,
            Self::P1440 => 3,
            Self::P1536 => 4,
            Self::P2160 => 5,
            Self::P3072 => 6,
        }
    }

    /// The part of the sensor that its images show: all of it in width, and in height too where they are 4:3.
    pub const fn cut(self) -> Cut {
        match self {
            Self::P720 => Cut { sensor: (1280, 960), offset: (0, 120), size: (1280, 720) },
            Self::P1080 => Cut { sensor: (1920, 1440), offset: (0, 180), size: (1920, 1080) },
            Self::P1440 => Cut { sensor: (2560, 1920), offset: (0, 240), size: (2560, 1440) },
            Self::P1536 => Cut { sensor: (2048, 1536), offset: (0, 0), size: (2048, 1536) },
            Self::P2160 => Cut { sensor: (3840, 2880), offset: (0, 360), size: (3840, 2160) },
            Self::P3072 => Cut { sensor: (4096, 3072), offset: (0, 0), size: (4096, 3072) },
        }
    }

    /// Width and height of its images.
    pub const fn size(self) -> (u32, u32) {
        self.cut().size
    }

    /// The fastest rate, images per second.
    pub const fn max_rate_hz(self) -> u32 {
        if matches!(self, Self::P3072) { 15 } else { 30 }
    }
}

/// How the colour camera sends its images.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum ColorFormat {
    /// JPEG images, at every resolution.
    Mjpg,
    /// Planar 4:2:0, at 720p.
    Nv12,
    /// Packed 4:2:2, at 720p.
    Yuy2,
    /// Blue, green, red and an unused byte, made of JPEG on the host.
    Bgra,
}

impl ColorFormat {
    /// Every format, in the SDK's order.
    pub const ALL: [Self; 4] = [Self::Mjpg, Self::Nv12, Self::Yuy2, Self::Bgra];

    /// The name used in configuration and messages; the four characters of a recording's track in small letters.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Mjpg => "mjpg",
            Self::Nv12 => "nv12",
            Self::Yuy2 => "yuy2",
            Self::Bgra => "bgra",
        }
    }

    /// The format with this name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|f| f.name().eq_ignore_ascii_case(name))
    }

    /// The SDK's `k4a_image_format_t`.
    pub const fn code(self) -> u32 {
        match self {
            Self::Mjpg => 0,
            Self::Nv12 => 1,
            Self::Yuy2 => 2,
            Self::Bgra => 3,
        }
    }
}

/// The mode of the colour camera.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct ColorMode {
    /// How images are sent.
    pub format: ColorFormat,
    /// Their size.
    pub resolution: ColorResolution,
}

impl ColorMode {
    /// The mode that a recording names, such as `MJPG_720P`.
    pub fn from_tag(tag: &str) -> Option<Self> {
        let (format, resolution) = tag.split_once('_')?;
        Some(Self {
            format: ColorFormat::from_name(format)?,
            resolution: ColorResolution::from_name(resolution)?,
        })
    }

    /// How a recording names it.
    pub fn tag(self) -> String {
        format!("{}_{}", self.format.name(), self.resolution.name()).to_ascii_uppercase()
    }
}

/// Part of a Kinect among others that are wired together.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum WiredSync {
    /// It is on its own.
    #[default]
    Standalone,
    /// The others follow it.
    Master,
    /// It follows a master.
    Subordinate,
}

impl WiredSync {
    /// Every part, in the SDK's order.
    pub const ALL: [Self; 3] = [Self::Standalone, Self::Master, Self::Subordinate];

    /// The name used in configuration and messages; recordings write it in capitals.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Standalone => "standalone",
            Self::Master => "master",
            Self::Subordinate => "subordinate",
        }
    }

    /// The part with this name, in either case.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|s| s.name().eq_ignore_ascii_case(name))
    }

    /// The SDK's `k4a_wired_sync_mode_t`.
    pub const fn code(self) -> u32 {
        self as u32
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_found_again() {
        for m in DepthMode::ALL {
            assert_eq!(DepthMode::from_name(&m.name().to_ascii_uppercase()), Some(m));
        }
        assert_eq!(
            DepthMode::from_name("NFOV_2x2BINNED"),
            Some(DepthMode::Nfov2x2Binned),
            "early recordings"
        );
        for r in ColorResolution::ALL {
            let (width, height) = r.size();
            assert_eq!(
                (ColorResolution::from_name(r.name()), ColorResolution::from_size(width, height)),
                (Some(r), Some(r))
            );
        }
        for s in WiredSync::ALL {
            assert_eq!(WiredSync::from_name(s.name()), Some(s));
        }
        let mode = ColorMode { format: ColorFormat::Mjpg, resolution: ColorResolution::P720 };
        assert_eq!((mode.tag().as_str(), ColorMode::from_tag("MJPG_720P")), ("MJPG_720P", Some(mode)));
        assert_eq!(ColorMode::from_tag("OFF"), None);
        assert_eq!(ColorMode::from_tag("H264_720P"), None);
    }

    #[test]
    fn a_cut_lies_within_its_sensor_and_in_its_middle() {
        let cuts = DepthMode::ALL
            .map(DepthMode::cut)
            .into_iter()
            .chain(ColorResolution::ALL.map(ColorResolution::cut));
        for Cut { sensor, offset, size } in cuts {
            assert!(offset.0 + size.0 <= sensor.0 && offset.1 + size.1 <= sensor.1, "{sensor:?} {size:?}");
            // The narrow field of view is 22 of 1024 rows above the middle.
            assert_eq!(2 * offset.0 + size.0, sensor.0);
        }
    }
}
