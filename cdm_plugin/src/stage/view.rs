//! Depth in the view of colour: tables built once, and again when a camera's calibration or mode changes.

use super::pixels;
use crate::stage::RefineConfig;
use depthrig_bus::{FrameHeader, Intrinsics, Pose};
use depthrig_calib::{PoseExt, Registration, same_view};
use std::sync::Arc;

/// Changes counts of depth, whose unit in metres is given.
pub type CorrectCounts = dyn Fn(&mut [u16], f64) + Send + Sync;

/// Changes counts of depth before they are put into the view of colour.
#[derive(Clone)]
pub struct Correct(pub Arc<CorrectCounts>);

impl core::fmt::Debug for Correct {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str("Correct")
    }
}

/// Inputs of registration.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Key {
    depth: Side,
    color: Side,
}

/// One camera of the two.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Side {
    intrinsics: Intrinsics,
    pose: Pose,
    size: (u32, u32),
    format: u32,
}

impl Side {
    const fn of(h: &FrameHeader) -> Self {
        Self { intrinsics: h.intrinsics, pose: h.pose, size: (h.width, h.height), format: h.format }
    }
}

/// How depth comes into the view of colour.
#[derive(Debug)]
enum How {
    /// It is there.
    AsItIs,
    /// It is registered.
    Registered(Box<Registration>),
    /// It is impossible, and why.
    Not(String),
}

/// How the depth of one camera comes into the view of its colour.
#[derive(Debug, Default)]
pub struct View {
    built: Option<(Key, How)>,
    /// Where registered depth is put.
    registered: Vec<u16>,
    /// Where depth is put that does not lie as it is wanted.
    packed: Vec<u16>,
    correct: Option<Correct>,
    /// Where corrected depth is put: the frame itself is read by others.
    corrected: Vec<u16>,
}

impl View {
    /// A view of depth that is corrected first.
    pub fn corrected_by(correct: Option<Correct>) -> Self {
        Self { correct, ..Self::default() }
    }

    /// Depth in the view of colour and its unit in metres, or why it is impossible. `config` says whether it is there
    /// already, `color` and `depth` are the headers.
    ///
    /// # Errors
    /// In words, for the status of the camera.
    pub fn depth<'a>(
        &'a mut self,
        config: &RefineConfig,
        color: &FrameHeader,
        depth: &FrameHeader,
        depth_pixels: &'a [u8],
    ) -> Result<(&'a [u16], f64), String> {
        let key = Key { depth: Side::of(depth), color: Side::of(color) };
        if self.built.as_ref().is_none_or(|(old, _)| *old != key) {
            let how = pixels::unfit(color, depth).map_or_else(|| how(config, &key), How::Not);
            self.built = Some((key, how));
        }
        let (mut raw, unit_m) =
            pixels::depth(depth, depth_pixels, &mut self.packed).map_err(|e| e.to_string())?;
        if let Some(Correct(correct)) = &self.correct {
            self.corrected.clear();
            self.corrected.extend_from_slice(raw);
            correct(&mut self.corrected, unit_m);
            raw = &self.corrected;
        }
        match &mut self.built {
            Some((_, How::Registered(registration))) => {
                let pixels = color.width as usize * color.height as usize;
                self.registered.resize(pixels, 0);
                registration.depth_to_color(raw, unit_m, &mut self.registered).map_err(|e| e.to_string())?;
                Ok((&self.registered, unit_m))
            }
            Some((_, How::Not(why))) => Err(why.clone()),
            _ => Ok((raw, unit_m)),
        }
    }

    /// The result of the last [`Self::depth`] that succeeded, unless it lies in that call's own frame.
    pub fn last<'a>(&'a self, depth: &FrameHeader, depth_pixels: &'a [u8]) -> Option<&'a [u16]> {
        match &self.built {
            Some((_, How::Registered(_))) => Some(&self.registered),
            Some((_, How::AsItIs)) if self.correct.is_some() => Some(&self.corrected),
            Some((_, How::AsItIs)) => pixels::in_place(depth, depth_pixels).or(Some(&self.packed)),
            _ => None,
        }
    }
}

fn how(config: &RefineConfig, key: &Key) -> How {
    let Key { depth, color } = key;
    let sizes = || {
        let (dw, dh) = depth.size;
        let (cw, ch) = color.size;
        format!("depth is {dw}x{dh} and colour {cw}x{ch}")
    };
    if config.is_aligned {
        return if depth.size == color.size {
            How::AsItIs
        } else {
            How::Not(format!("is_aligned says that depth is in the view of colour, but {}", sizes()))
        };
    }
    let none = match (depth.intrinsics.is_known(), color.intrinsics.is_known()) {
        (true, true) => None,
        (false, true) => Some("depth has no calibration"),
        (true, false) => Some("colour has no calibration"),
        (false, false) => Some("neither has a calibration"),
    };
    if let Some(none) = none {
        let hint = if depth.size == color.size {
            "; if the camera gives depth in the view of colour, write is_aligned = true into [camera.refine]"
        } else {
            ""
        };
        return How::Not(format!(
            "{} and {none}, so that depth cannot be put into the view of colour; give the camera its calibration{hint}",
            sizes()
        ));
    }
    if same_view((&depth.intrinsics, depth.size, &depth.pose), (&color.intrinsics, color.size, &color.pose)) {
        return How::AsItIs;
    }
    let color_from_depth = color.pose.inverse().compose(&depth.pose);
    let registration =
        Registration::new(&depth.intrinsics, depth.size, &color.intrinsics, color.size, &color_from_depth);
    match registration {
        Ok(registration) => How::Registered(Box::new(registration)),
        Err(e) => How::Not(e.to_string()),
    }
}
