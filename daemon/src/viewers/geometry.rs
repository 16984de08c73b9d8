//! Size, intrinsics and pose of a stream, with which a viewer puts its pixels in their place.

use depthrig_bus::{Distortion, FrameHeader, Intrinsics, Pose};
use serde::{Serialize, Serializer};

/// Size, intrinsics and pose of a stream's images.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub(crate) struct Geometry {
    /// Columns of the full image.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Metres of a unit of depth; 0 for other images.
    pub depth_unit_m: f64,
    #[serde(serialize_with = "intrinsics")]
    pub intrinsics: Intrinsics,
    /// The optical frame (x right, y down, z forward) on the mount: `p_mount = R p + t`.
    #[serde(flatten)]
    pub pose: Pose,
}

#[derive(Serialize)]
struct Named {
    fx: f64,
    fy: f64,
    cx: f64,
    cy: f64,
    model: Distortion,
    coeffs: [f64; 8],
}

impl Geometry {
    pub(super) fn of(h: &FrameHeader) -> Self {
        Self {
            width: h.width,
            height: h.height,
            depth_unit_m: h.depth_unit_m,
            intrinsics: h.intrinsics,
            pose: h.pose,
        }
    }
}

fn intrinsics<S: Serializer>(of: &Intrinsics, serializer: S) -> Result<S::Ok, S::Error> {
    let Intrinsics { fx, fy, cx, cy, coeffs, .. } = *of;
    Named { fx, fy, cx, cy, model: of.distortion(), coeffs }.serialize(serializer)
}
