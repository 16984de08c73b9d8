//! A pixel's depth, where that is on the mount, and where other cameras see it.

use depthrig_bus::{Frame, FrameHeader, PixelFormat, StreamId};
use depthrig_calib::{Camera, PoseExt};
use glam::{DVec2, DVec3};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// A question about a pixel of a stream's newest frame.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct PixelQuestion {
    /// Comes back with the answer.
    pub id: u64,
    /// The stream, `camera/stream`.
    pub stream: String,
    /// Column of the full image.
    pub x: u32,
    /// Row.
    pub y: u32,
}

/// The answer.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct PixelAnswer {
    #[serde(flatten)]
    pub place: Place,
    /// Along the optical axis, metres; `None` where depth is missing.
    pub depth_m: Option<f64>,
    /// In the mount's coordinates, metres.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub xyz_m: Option<[f64; 3]>,
    /// The same point in other streams.
    pub seen: Vec<Seen>,
}

/// The pixel that was asked about.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub(crate) struct Place {
    pub id: u64,
    pub stream: String,
    pub x: u32,
    pub y: u32,
}

/// A point in the image of a stream.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct Seen {
    pub stream: String,
    pub x: f64,
    pub y: f64,
}

/// Answers from the newest frames.
pub(super) fn answer(question: PixelQuestion, frames: &BTreeMap<StreamId, Frame>) -> PixelAnswer {
    let PixelQuestion { id, stream, x, y } = question;
    let asked = frames.iter().find(|(name, _)| name.to_string() == stream);
    let depth_m = asked.and_then(|(_, frame)| depth_m(frame.header(), frame.pixels(), x, y));
    let point = asked.zip(depth_m).and_then(|((_, frame), depth)| on_mount(frame.header(), x, y, depth));
    let seen = point.map_or_else(Vec::new, |point| {
        frames
            .iter()
            .filter(|(name, _)| name.to_string() != stream)
            .filter_map(|(name, frame)| {
                let at = in_image(frame.header(), point)?;
                Some(Seen { stream: name.to_string(), x: at.x, y: at.y })
            })
            .collect()
    });
    PixelAnswer { place: Place { id, stream, x, y }, depth_m, xyz_m: point.map(Into::into), seen }
}

/// Depth of a pixel, metres.
fn depth_m(h: &FrameHeader, pixels: &[u8], x: u32, y: u32) -> Option<f64> {
    if x >= h.width || y >= h.height {
        return None;
    }
    let of = |bytes: usize| {
        let at = y as usize * h.stride as usize + x as usize * bytes;
        pixels.get(at..at + bytes)
    };
    let metres = match h.pixel_format()? {
        PixelFormat::Z16 => f64::from(u16::from_le_bytes(of(2)?.try_into().ok()?)) * h.depth_unit_m,
        PixelFormat::DepthF32 => f64::from(f32::from_le_bytes(of(4)?.try_into().ok()?)),
        _ => return None,
    };
    (metres > 0.0).then_some(metres)
}

/// The point in the mount's coordinates; `None` without calibration.
fn on_mount(h: &FrameHeader, x: u32, y: u32, depth_m: f64) -> Option<DVec3> {
    let ray = Camera::new(&h.intrinsics).ok()?.unproject(DVec2::new(x.into(), y.into()))?;
    Some(h.pose.to_affine().transform_point3(ray * depth_m))
}

/// Where an image shows a point of the mount's coordinates.
fn in_image(h: &FrameHeader, point: DVec3) -> Option<DVec2> {
    let camera = Camera::new(&h.intrinsics).ok()?;
    let at = camera.project(h.pose.to_affine().inverse().transform_point3(point))?;
    let size = DVec2::new(h.width.into(), h.height.into());
    (at.cmpge(DVec2::splat(-0.5)).all() && at.cmplt(size - 0.5).all()).then_some(at)
}
