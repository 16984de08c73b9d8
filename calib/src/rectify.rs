//! Stereo rectification: both eyes turned to one orientation, so that what one eye sees lies in the same row of the other.
//!
//! The geometry is that of `OpenCV`'s `stereoRectify` with `CALIB_ZERO_DISPARITY` and `alpha = 0` (Bouguet's method,
//! `calib3d/src/calibration.cpp`, Apache-2.0): the rotation between the eyes is shared out between them, the row axis
//! becomes the line between their centres, and the picture is magnified until every pixel of both views is seen by its
//! eye. A test holds it to numbers of `OpenCV`.

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
    /// That of the left eye, in which disparity and depth are.
    Left,
    /// That of the right eye.
    Right,
}

impl View {
    /// Both, left first.
    pub const BOTH: [Self; 2] = [Self::Left, Self::Right];
}

/// Turns raw pictures of a stereo camera into rectified ones. Its tables are made once; a picture costs one pass,
/// allocates nothing and goes between four pixels in proportion.
///
/// Both rectified views are pinholes with the same intrinsics and no distortion, so a point at depth `z` metres has
/// disparity `x_left - x_right = fx * baseline_m / z` pixels. Pictures are rows of `width` pixels without padding.
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
    /// For a camera whose eyes have these intrinsics at `size` (width, height) and whose right eye is at `right_in_left`:
    /// `p_left = R p_right + t`, so that `t.x` is positive.
    ///
    /// # Errors
    /// As [`Camera::new`]; [`ErrorKind::BadInput`] for a size that no picture has, for eyes that are above each other, that
    /// have no distance, or that are swapped (the right one left of the left one), and for lenses of which nothing is
    /// left after rectification.
    pub fn new(
        left: &Intrinsics,
        right: &Intrinsics,
        right_in_left: &Pose,
        size: (u32, u32),
    ) -> Result<Self> {
        let (left, right) = (Camera::new(left)?, Camera::new(right)?);
        let right_from_left = right_in_left.to_affine().inverse();
        let made = geometry::rectify(left.intrinsics(), right.intrinsics(), &right_from_left, size)?;
        let map = |camera: &Camera, rotation: DMat3| {
            Arc::new(Map::new(camera, rotation, &made.intrinsics, size, None))
        };
        Ok(Self {
            size,
            intrinsics: made.intrinsics,
            baseline_m: made.baseline_m,
            maps: [map(&left, made.rotations[0]), map(&right, made.rotations[1])],
            rotations: made.rotations,
            right,
        })
    }

    /// Moves the right view's rows by what was measured in rectified pairs, in place of what they were moved by before: what
    /// lies lower there by `rows` comes into the row in which the left view has it.
    pub fn correct_rows(&mut self, rows: &RowOffset) {
        let rotation = self.rotations[1];
        self.maps[1] = Arc::new(Map::new(&self.right, rotation, &self.intrinsics, self.size, Some(rows)));
    }

    /// Width and height of the raw and of the rectified pictures, pixels.
    pub const fn size(&self) -> (u32, u32) {
        self.size
    }

    /// Intrinsics of both rectified views: a pinhole with `fx = fy`.
    pub const fn intrinsics(&self) -> &Intrinsics {
        &self.intrinsics
    }

    /// Distance between the eyes, metres.
    pub const fn baseline_m(&self) -> f64 {
        self.baseline_m
    }

    /// What turns directions of the eye into those of its rectified view: `R1` and `R2` of `stereoRectify`.
    pub const fn rotation(&self, view: View) -> DMat3 {
        self.rotations[view as usize]
    }

    /// Pose of the rectified left view in the left eye's own frame: a rotation alone.
    pub fn left_view_in_left(&self) -> Pose {
        let turned = DQuat::from_mat3(&self.rotations[0].transpose()).normalize();
        Pose { translation_m: [0.0; 3], rotation_xyzw: turned.to_array() }
    }

    /// Where the rectified pixel (`x`, `y`) is in the eye's own picture, pixels, with the map's own precision of
    /// 1/256 pixel; `None` when the eye does not see it.
    pub fn source(&self, view: View, x: u32, y: u32) -> Option<(f64, f64)> {
        let inside = x < self.size.0 && y < self.size.1;
        inside.then(|| self.maps[view as usize].source(y as usize * self.size.0 as usize + x as usize))?
    }

    /// The rectified grey picture and, where it is wanted, the rectified picture in red, green, blue, out of an eye's own
    /// picture in `format`: [`PixelFormat::Mono8`], [`PixelFormat::Rgb8`] or [`PixelFormat::Yuyv`]. 0 where the eye sees
    /// nothing.
    ///
    /// Grey is the mean of BT.601 of red, green, blue, and of YUYV its luminance as it is. Colour of YUYV is as BT.601 with
    /// its limited range has it, which is what `OpenCV` makes of it and what USB cameras send; of grey it is grey.
    ///
    /// # Errors
    /// [`ErrorKind::SizeMismatch`] for pictures of another size; [`ErrorKind::BadInput`] for other formats, and for YUYV of
    /// an odd width.
    pub fn rectify(
        &self,
        view: View,
        format: PixelFormat,
        picture: &[u8],
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
                    "a picture in {other:?} cannot be rectified; Mono8, Rgb8 and Yuyv can"
                )));
            }
        };
        check_len("the picture of an eye", picture.len(), size, bytes)?;
        check_len("the rectified grey picture", grey.len(), size, 1)?;
        if let Some(rgb) = &rgb {
            check_len("the rectified colour picture", rgb.len(), size, 3)?;
        }
        let map = &self.maps[view as usize];
        match format {
            PixelFormat::Yuyv => {
                self.check_pairs()?;
                map.yuyv(picture, grey, rgb);
            }
            PixelFormat::Rgb8 => map.rgb(picture, grey, rgb),
            _ => {
                map.grey(picture, grey);
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
            "a picture of {width}x{height} pixels cannot be YUYV, which has pairs of pixels: its width is odd"
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
    /// For images of a size (width, height), whose content lies lower by `rows` than it should.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] for images with a side below 2.
    pub fn new(size: (u32, u32), rows: &RowOffset) -> Result<Self> {
        if size.0 < 2 || size.1 < 2 {
            return Err(bad(format!("rows of an image of {}x{} pixels cannot be moved", size.0, size.1)));
        }
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

/// The error of numbers that are no stereo camera's.
fn bad(what: impl Into<String>) -> Error {
    Error::new(ErrorKind::BadInput, what)
}

#[cfg(test)]
mod tests;
