//! Intrinsics and pose as they travel in a frame header. The mathematics on them lives in `depthrig-calib`.

use iceoryx2::prelude::ZeroCopySend;
use serde::{Deserialize, Serialize};

/// The distortion model of a camera. The discriminant is part of the wire format.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[repr(u32)]
#[non_exhaustive]
pub enum Distortion {
    /// No calibration is known: `fx` is 0.
    #[default]
    Unknown = 0,
    /// A pinhole without distortion.
    None = 1,
    /// Brown-Conrady, coefficients `k1 k2 p1 p2 k3` (OpenCV's order).
    BrownConrady = 2,
    /// Inverse Brown-Conrady as RealSense defines it, coefficients `k1 k2 p1 p2 k3`.
    InverseBrownConrady = 3,
    /// Kannala-Brandt fisheye, coefficients `k1 k2 k3 k4`.
    KannalaBrandt4 = 4,
    /// Rational, coefficients `k1 k2 p1 p2 k3 k4 k5 k6` (OpenCV's order; Azure Kinect).
    Rational = 5,
}

impl Distortion {
    /// Every model, in wire order.
    pub const ALL: [Self; 6] = [
        Self::Unknown,
        Self::None,
        Self::BrownConrady,
        Self::InverseBrownConrady,
        Self::KannalaBrandt4,
        Self::Rational,
    ];

    /// The model of a wire code; codes of later versions read as `Unknown`.
    pub fn from_code(code: u32) -> Self {
        Self::ALL.into_iter().find(|d| *d as u32 == code).unwrap_or_default()
    }
}

/// Camera intrinsics for the size of the frame that carries them: pixels, optical frame x right, y down,
/// z forward, the centre of the top-left pixel at (0, 0).
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Default, ZeroCopySend)]
#[type_name("depthrig.Intrinsics.v1")]
pub struct Intrinsics {
    /// Focal length along x, pixels; 0 when no calibration is known.
    pub fx: f64,
    /// Focal length along y, pixels.
    pub fy: f64,
    /// Principal point x, pixels.
    pub cx: f64,
    /// Principal point y, pixels.
    pub cy: f64,
    /// Distortion coefficients in the order that [`Distortion`] names; unused ones are 0.
    pub coeffs: [f64; 8],
    /// Wire code of the [`Distortion`] model.
    pub model: u32,
    /// Zero.
    pub reserved: u32,
}

impl Intrinsics {
    /// A pinhole without distortion.
    pub const fn pinhole(fx: f64, fy: f64, cx: f64, cy: f64) -> Self {
        Self { fx, fy, cx, cy, coeffs: [0.0; 8], model: Distortion::None as u32, reserved: 0 }
    }

    /// The distortion model.
    pub fn distortion(&self) -> Distortion {
        Distortion::from_code(self.model)
    }

    /// Whether a calibration is known at all.
    pub fn is_known(&self) -> bool {
        self.fx > 0.0
    }
}

/// A rigid transform: the pose of a child frame in its parent, `p_parent = R p_child + t`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ZeroCopySend)]
#[type_name("depthrig.Pose.v1")]
pub struct Pose {
    /// Translation in metres.
    pub translation_m: [f64; 3],
    /// Rotation as a unit quaternion x, y, z, w.
    pub rotation_xyzw: [f64; 4],
}

impl Pose {
    /// No motion at all.
    pub const IDENTITY: Self = Self { translation_m: [0.0; 3], rotation_xyzw: [0.0, 0.0, 0.0, 1.0] };
}

impl Default for Pose {
    fn default() -> Self {
        Self::IDENTITY
    }
}
