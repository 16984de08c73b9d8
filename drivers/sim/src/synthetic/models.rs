//! The simulated camera models as data: modes, optics, depth principle.
//!
//! Fields of view, baselines, ranges and depth units are those of the makers' data sheets; focal lengths
//! follow from the field of view (`fx = w / 2 / tan(hfov / 2)`). Every camera's principal point is a little
//! off the centre, by an amount that follows from its seed.

use depthrig_bus::{Distortion, Intrinsics, Pose};

/// A camera model.
#[derive(Debug)]
pub struct Model {
    /// Name in configurations.
    pub name: &'static str,
    /// Name as the maker writes it.
    pub title: &'static str,
    /// How it measures depth.
    pub depth: DepthPrinciple,
    /// Metres per count of depth.
    pub depth_unit_m: f64,
    /// Nearest and farthest depth that it reports, metres.
    pub range_m: (f32, f32),
    /// Colour modes, default first.
    pub color_modes: &'static [Mode],
    /// Depth modes, default first.
    pub depth_modes: &'static [Mode],
    /// Pose of the colour sensor in the device's frame, which is that of depth.
    pub color_in_device: Pose,
    /// Exposure time of colour and of depth, nanoseconds.
    pub exposure_ns: [u64; 2],
    /// White balance of the colour sensor: factors of red, green, blue.
    pub white: [f32; 3],
}

/// How a camera measures depth.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum DepthPrinciple {
    /// Two imagers side by side, the second `baseline_m` to the right.
    Stereo {
        /// Distance of the imagers.
        baseline_m: f32,
        /// A projector adds texture to what has none.
        projector: bool,
        /// Standard deviation of a match, pixels.
        sigma_px: f32,
        /// The widest match that is searched, pixels: sets the nearest depth.
        search_px: f32,
    },
    /// Modulated light and the time it takes.
    TimeOfFlight {
        /// Standard deviation at 1 m on a white surface, metres.
        sigma_m: f32,
        /// Depth added in a deep corner by light that took a detour, metres.
        multipath_m: f32,
        /// The light's field ends at this angle from the axis, degrees: a circle in the image.
        half_angle_deg: f32,
    },
}

/// One image size.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Mode {
    /// Pixels per row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Frame rates, default first.
    pub rates_hz: &'static [f64],
    /// Focal length, pixels; both axes.
    pub focal_px: f64,
    /// Lens.
    pub lens: Lens,
}

/// The lens of a mode.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Lens {
    /// Rectified or nearly so.
    Pinhole,
    /// The depth lens of the Azure Kinect, 120° wide.
    KinectDepth,
}

/// Rational coefficients `k1 k2 p1 p2 k3 k4 k5 k6` of the size that the Azure Kinect's depth cameras carry;
/// they put 60° off axis at 522 px for a focal length of 504 px, the edge of the 1024-px image.
const KINECT_DEPTH: [f64; 8] = [1.147, 0.2557, 2.5e-5, 7.5e-5, 0.00358, 1.4849, 0.5187, 0.0451];

impl Mode {
    /// Intrinsics with the principal point `off` (a fraction of width and height) from the centre.
    pub fn intrinsics(&self, off: [f64; 2]) -> Intrinsics {
        let w = f64::from(self.width);
        let h = f64::from(self.height);
        let cx = (w - 1.0) / 2.0 + off[0] * w;
        let cy = (h - 1.0) / 2.0 + off[1] * h;
        let k = Intrinsics::pinhole(self.focal_px, self.focal_px, cx, cy);
        match self.lens {
            Lens::Pinhole => k,
            Lens::KinectDepth => Intrinsics { coeffs: KINECT_DEPTH, model: Distortion::Rational as u32, ..k },
        }
    }
}

const fn mode(width: u32, height: u32, focal_px: f64, rates_hz: &'static [f64]) -> Mode {
    Mode { width, height, rates_hz, focal_px, lens: Lens::Pinhole }
}

const fn kinect(width: u32, height: u32, focal_px: f64, rates_hz: &'static [f64]) -> Mode {
    Mode { width, height, rates_hz, focal_px, lens: Lens::KinectDepth }
}

const fn at(x: f64, y: f64, z: f64) -> Pose {
    Pose { translation_m: [x, y, z], rotation_xyzw: [0.0, 0.0, 0.0, 1.0] }
}

const D400_RATES: &[f64] = &[30.0, 15.0, 6.0];
const D400_FAST: &[f64] = &[30.0, 60.0, 90.0, 15.0, 6.0];
const D455_RATES: &[f64] = &[30.0, 15.0, 5.0];

/// Every model.
pub static MODELS: [Model; 8] = [
    Model {
        name: "d405",
        title: "D405",
        depth: DepthPrinciple::Stereo {
            baseline_m: 0.018,
            projector: false,
            sigma_px: 0.055,
            search_px: 126.0,
        },
        depth_unit_m: 0.0001,
        range_m: (0.07, 6.0),
        color_modes: &[mode(1280, 720, 650.0, &[30.0, 15.0, 5.0]), mode(848, 480, 431.0, D400_FAST)],
        depth_modes: &[mode(1280, 720, 650.0, &[30.0, 15.0, 5.0]), mode(848, 480, 431.0, D400_FAST)],
        color_in_device: Pose::IDENTITY,
        exposure_ns: [8_000_000, 8_000_000],
        white: [1.0, 0.99, 0.94],
    },
    Model {
        name: "d415",
        title: "D415",
        depth: DepthPrinciple::Stereo {
            baseline_m: 0.055,
            projector: true,
            sigma_px: 0.06,
            search_px: 126.0,
        },
        depth_unit_m: 0.001,
        range_m: (0.3, 10.0),
        color_modes: &[
            mode(1280, 720, 930.0, D400_RATES),
            mode(1920, 1080, 1395.0, D400_RATES),
            mode(640, 480, 620.0, D400_FAST),
        ],
        depth_modes: &[
            mode(1280, 720, 990.0, D400_RATES),
            mode(848, 480, 656.0, D400_FAST),
            mode(640, 480, 656.0, D400_FAST),
        ],
        color_in_device: at(-0.0151, 0.0, 0.0),
        exposure_ns: [10_000_000, 6_000_000],
        white: [1.0, 0.98, 0.97],
    },
    Model {
        name: "d435",
        title: "D435",
        depth: DepthPrinciple::Stereo { baseline_m: 0.05, projector: true, sigma_px: 0.07, search_px: 126.0 },
        depth_unit_m: 0.001,
        range_m: (0.2, 10.0),
        color_modes: &[
            mode(1280, 720, 930.0, D400_RATES),
            mode(1920, 1080, 1395.0, D400_RATES),
            mode(640, 480, 620.0, D400_FAST),
        ],
        depth_modes: &[
            mode(1280, 720, 650.0, D400_RATES),
            mode(848, 480, 431.0, D400_FAST),
            mode(640, 480, 431.0, D400_FAST),
        ],
        color_in_device: at(-0.0148, 0.0, 0.0),
        exposure_ns: [10_000_000, 6_000_000],
        white: [0.98, 1.0, 0.98],
    },
    Model {
        name: "d455",
        title: "D455",
        depth: DepthPrinciple::Stereo {
            baseline_m: 0.095,
            projector: true,
            sigma_px: 0.065,
            search_px: 126.0,
        },
        depth_unit_m: 0.001,
        range_m: (0.4, 10.0),
        color_modes: &[
            mode(1280, 800, 640.0, D455_RATES),
            mode(1280, 720, 640.0, D455_RATES),
            mode(640, 480, 384.0, &[30.0, 60.0]),
        ],
        depth_modes: &[
            mode(1280, 720, 650.0, D455_RATES),
            mode(848, 480, 431.0, &[30.0, 60.0, 90.0]),
            mode(640, 480, 431.0, &[30.0, 60.0, 90.0]),
        ],
        color_in_device: at(0.059, 0.0, 0.0),
        exposure_ns: [9_000_000, 6_000_000],
        white: [1.0, 1.0, 1.0],
    },
    Model {
        name: "l515",
        title: "L515",
        depth: DepthPrinciple::TimeOfFlight { sigma_m: 0.0015, multipath_m: 0.004, half_angle_deg: 90.0 },
        depth_unit_m: 0.00025,
        range_m: (0.25, 9.0),
        color_modes: &[
            mode(1280, 720, 914.0, &[30.0, 60.0]),
            mode(1920, 1080, 1371.0, &[30.0]),
            mode(640, 480, 609.0, &[30.0, 60.0]),
        ],
        depth_modes: &[mode(1024, 768, 734.0, &[30.0]), mode(640, 480, 459.0, &[30.0])],
        color_in_device: at(0.0, -0.0137, 0.0033),
        exposure_ns: [10_000_000, 1_000_000],
        white: [1.0, 0.97, 1.0],
    },
    Model {
        name: "zed2i",
        title: "ZED 2i",
        depth: DepthPrinciple::Stereo {
            baseline_m: 0.12,
            projector: false,
            sigma_px: 0.09,
            search_px: 256.0,
        },
        depth_unit_m: 0.001,
        range_m: (0.2, 20.0),
        color_modes: &[mode(1280, 720, 530.0, &[30.0, 60.0, 15.0]), mode(1920, 1080, 1060.0, &[30.0, 15.0])],
        depth_modes: &[mode(1280, 720, 530.0, &[30.0, 60.0, 15.0]), mode(1920, 1080, 1060.0, &[30.0, 15.0])],
        color_in_device: Pose::IDENTITY,
        exposure_ns: [9_000_000, 9_000_000],
        white: [0.97, 1.0, 1.02],
    },
    Model {
        name: "kinect",
        title: "Azure Kinect",
        depth: DepthPrinciple::TimeOfFlight { sigma_m: 0.0012, multipath_m: 0.012, half_angle_deg: 60.0 },
        depth_unit_m: 0.001,
        range_m: (0.25, 5.5),
        color_modes: &[
            mode(1280, 720, 610.0, &[15.0, 30.0, 5.0]),
            mode(1920, 1080, 915.0, &[15.0, 30.0, 5.0]),
        ],
        depth_modes: &[
            kinect(1024, 1024, 504.0, &[15.0, 5.0]),
            kinect(512, 512, 252.0, &[30.0, 15.0, 5.0]),
            kinect(640, 576, 504.0, &[30.0, 15.0, 5.0]),
        ],
        // The depth camera looks 6° further down than the colour camera.
        color_in_device: Pose {
            translation_m: [0.032, 0.002, -0.004],
            rotation_xyzw: [0.052_336, 0.0, 0.0, 0.998_630],
        },
        exposure_ns: [12_000_000, 12_800_000],
        white: [1.01, 1.0, 0.96],
    },
    Model {
        name: "generic",
        title: "Generic RGB-D",
        depth: DepthPrinciple::Stereo { baseline_m: 0.05, projector: true, sigma_px: 0.07, search_px: 126.0 },
        depth_unit_m: 0.001,
        range_m: (0.2, 10.0),
        color_modes: &[mode(640, 480, 500.0, &[30.0])],
        depth_modes: &[mode(640, 480, 500.0, &[30.0])],
        color_in_device: at(-0.015, 0.0, 0.0),
        exposure_ns: [8_000_000, 6_000_000],
        white: [1.0, 1.0, 1.0],
    },
];

/// The model called `name`, case not minded.
pub fn find(name: &str) -> Option<&'static Model> {
    MODELS.iter().find(|m| m.name.eq_ignore_ascii_case(name))
}
