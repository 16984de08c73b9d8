//! Stereo rectification: turns the left and right image to one orientation, so that a point lies in the same row of
//! both.
//!
//! The geometry is that of `OpenCV`'s `stereoRectify` with `CALIB_ZERO_DISPARITY` and `alpha = 0` (Bouguet's method,
//! `calib3d/src/calibration.cpp`, Apache-2.0): the rotation between the cameras is split between them, the row axis
//! becomes the line between their centres, and the image is magnified until every pixel of both views is seen by its
//! camera. A test compares it with `OpenCV`.

use crate::error::check_len;
use crate::stereo::{Gray, RowOffset};
use crate::{Camera, Error, ErrorKind, PoseExt, Result};
use depthrig_bus::{Intrinsics, PixelFormat, Pose};
use glam::{DMat3, DQuat};

mod geometry;
mod map;

use map::Map;
use std::sync::Arc;

/// One of the two rectified views.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum View {
    /// The left camera's view, in which disparity and depth are.
    Left,
    /// The right camera's view.
    Right,
}

impl View {
    /// Both, left first.
    pub const BOTH: [Self; 2] = [Self::Left, Self::Right];
}

/// Turns raw images of a stereo camera into rectified ones. Its tables are computed once; an image costs one pass,
/// allocates nothing and is interpolated between four pixels.
///
/// Both rectified views are pinholes with the same intrinsics and no distortion, so a point at depth `z` metres has
/// disparity `x_left - x_right = fx * baseline_m / z` pixels. Images are rows of `width` pixels without padding.
#[derive(Debug, Clone)]
pub struct Rectifier {
    size: (u32, u32),
    intrinsics: Intrinsics,
    baseline_m: f64,
    rotations: [DMat3; 2],
    maps: [Arc<Map>; 2],
    right: Camera,
}

impl Rectifier {
    /// For left and right cameras with these intrinsics at `size` (width, height), the right one at `right_in_left`:
    /// `p_left = R p_right + t`, so that `t.x` is positive.
    ///
    /// # Errors
    /// As [`Camera::new`]; [`ErrorKind::BadInput`] for an invalid size, for cameras that are above each other, that
    /// have no distance, or that are swapped (the right one left of the left one), and for lenses of which nothing is
    /// left after rectification.
    pub fn new(
        left: &Intrinsics,
        right: &Intrinsics,
        right_in_left: &Pose,
        size: (u32, u32),
    ) -> Result<Self> {
        let left = Camera::new(left)?;
        let right = Camera::new(right)?;
        let right_from_left = right_in_left.to_affine().inverse();
        let rectified = geometry::rectify(left.intrinsics(), right.intrinsics(), &right_from_left, size)?;
        let map = |camera: &Camera, rotation: DMat3| {
            Arc::new(Map::new(camera, rotation, &rectified.intrinsics, size, None))
        };
        Ok(Self {
            size,
            intrinsics: rectified.intrinsics,
            baseline_m: rectified.baseline_m,
            maps: [map(&left, rectified.rotations[0]), map(&right, rectified.rotations[1])],
            rotations: rectified.rotations,
            right,
        })
    }

    /// Moves the right view's rows by an offset measured in rectified pairs, in place of the previous offset: what lies
    /// lower there by `rows` moves to its row in the left view.
    pub fn correct_rows(&mut self, rows: &RowOffset) {
        let rotation = self.rotations[1];
        self.maps[1] = Arc::new(Map::new(&self.right, rotation, &self.intrinsics, self.size, Some(rows)));
    }

    /// Width and height of the raw and of the rectified images, pixels.
    pub const fn size(&self) -> (u32, u32) {
        self.size
    }

    /// Intrinsics of both rectified views: a pinhole with `fx = fy`.
    pub const fn intrinsics(&self) -> &Intrinsics {
        &self.intrinsics
    }

    /// Distance between the cameras, metres.
    pub const fn baseline_m(&self) -> f64 {
        self.baseline_m
    }

    /// Rotation from directions of the camera to those of its rectified view: `R1` and `R2` of `stereoRectify`.
    pub const fn rotation(&self, view: View) -> DMat3 {
        self.rotations[view as usize]
    }

    /// Pose of the rectified left view in the left camera's own frame: a rotation alone.
    pub fn left_view_in_left(&self) -> Pose {
        let turned = DQuat::from_mat3(&self.rotations[0].transpose()).normalize();
        Pose { translation_m: [0.0; 3], rotation_xyzw: turned.to_array() }
    }

    /// Where the rectified pixel (`x`, `y`) is in the camera's own image, pixels, with the map's own precision of 1/256
    /// pixel; `None` when the camera does not see it.
    pub fn source(&self, view: View, x: u32, y: u32) -> Option<(f64, f64)> {
        let inside = x < self.size.0 && y < self.size.1;
        inside.then(|| self.maps[view as usize].source(y as usize * self.size.0 as usize + x as usize))?
    }

    /// Computes the rectified grey image and, if requested, the rectified image in red, green, blue, from a camera's
    /// own image in `format`: [`PixelFormat::Mono8`], [`PixelFormat::Rgb8`] or [`PixelFormat::Yuyv`]. 0 where the
    /// camera sees nothing.
    ///
    /// Grey is the BT.601 luma of red, green, blue, and the unchanged luminance of YUYV. YUYV converts to colour by
    /// BT.601 with limited range, as `OpenCV` converts it and USB cameras send it; grey stays grey.
    ///
    /// # Errors
    /// [`ErrorKind::SizeMismatch`] for images of another size; [`ErrorKind::BadInput`] for other formats, and for YUYV of
    /// an odd width.
    pub fn rectify(
        &self,
        view: View,
        format: PixelFormat,
        image: &[u8],
        grey: &mut [u8],
        rgb: Option<&mut [u8]>,
    ) -> Result<()> {
        let size = (self.size.0 as usize, self.size.1 as usize);
        let bytes = match format {
            PixelFormat::Mono8 => 1,
            PixelFormat::Yuyv => 2,
            PixelFormat::Rgb8 => 3,
            other => {
                return Err(bad(format!(
                    "an image in {other:?} cannot be rectified; Mono8, Rgb8 and Yuyv can"
                )));
            }
        };
        check_len("the camera's image", image.len(), size, bytes)?;
        check_len("the rectified grey image", grey.len(), size, 1)?;
        if let Some(rgb) = &rgb {
            check_len("the rectified colour image", rgb.len(), size, 3)?;
        }
        let map = &self.maps[view as usize];
        match format {
            PixelFormat::Yuyv => {
                self.check_pairs()?;
                map.yuyv(image, grey, rgb);
            }
            PixelFormat::Rgb8 => map.rgb(image, grey, rgb),
            _ => {
                map.grey(image, grey);
                if let Some(rgb) = rgb {
                    rgb.as_chunks_mut().0.iter_mut().zip(grey).for_each(|(p, v)| *p = [*v; 3]);
                }
            }
        }
        Ok(())
    }

    /// In YUYV two pixels share a colour.
    fn check_pairs(&self) -> Result<()> {
        let (width, height) = self.size;
        if width.is_multiple_of(2) {
            return Ok(());
        }
        Err(bad(format!(
            "a YUYV image of {width}x{height} pixels is invalid: YUYV has pairs of pixels, and the width is odd"
        )))
    }
}

/// Moves the rows of right images that are rectified already, as [`Rectifier::correct_rows`] does while it rectifies.
#[derive(Debug, Clone)]
pub struct RowCorrector {
    size: (u32, u32),
    map: Map,
}

impl RowCorrector {
    /// For images of `width` x `height` pixels whose content lies lower by `rows` than it should.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] for images with a side below 2.
    pub fn new(width: u32, height: u32, rows: &RowOffset) -> Result<Self> {
        if width < 2 || height < 2 {
            return Err(bad(format!("rows of an image of {width}x{height} pixels cannot be moved")));
        }
        let size = (width, height);
        let same = Intrinsics::pinhole(1.0, 1.0, 0.0, 0.0);
        let map = Map::new(&Camera::new(&same)?, DMat3::IDENTITY, &same, size, Some(rows));
        Ok(Self { size, map })
    }

    /// The right image with its rows moved, without padding; 0 where they come from outside of it.
    ///
    /// # Errors
    /// [`ErrorKind::SizeMismatch`] for images of another size.
    pub fn correct(&self, right: &Gray<'_>, out: &mut Vec<u8>) -> Result<()> {
        let size = (self.size.0 as usize, self.size.1 as usize);
        right.check("right", size.0, size.1)?;
        let packed: Vec<u8> = (0..size.1).flat_map(|y| right.row(y)).copied().collect();
        out.resize(size.0 * size.1, 0);
        self.map.grey(&packed, out);
        Ok(())
    }
}

/// The error of numbers that are invalid for a stereo camera.
fn bad(what: impl Into<String>) -> Error {
    Error::new(ErrorKind::BadInput, what)
}

#[cfg(test)]
mod tests;
