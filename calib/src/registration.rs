//! Registration: depth in the view of the colour camera, and colour in the view of depth.
//!
//! Everything that depends on the cameras alone is computed once. A frame costs one pass over its depth: SIMD where
//! the processor has it, and the same bits where it has not. Nothing is allocated per frame.
//!
//! Sources: librealsense `src/proc/align.cpp` and `src/proc/sse/sse-align.cpp` (Apache-2.0) for [`Method::Splat`], Azure
//! Kinect `src/transformation/rgbz.c` (MIT) for [`Method::Triangles`]; only the rules are theirs.

use crate::error::check_len;
use crate::{Camera, Error, ErrorKind, PoseExt, Result};
use depthrig_bus::{Intrinsics, Pose};
use rayon::prelude::*;
use std::sync::Arc;

mod lens;
mod splat;
mod target;
mod triangles;
mod warp;

use splat::SplatRows;
use target::Target;
use triangles::TriangleRows;
use warp::Warp;

/// How depth is put into another view.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Method {
    /// Each depth pixel covers the rectangle between its projected corners; the nearest wins. Where colour is the coarser
    /// picture, a pixel alone: that of the first corner. Values are kept as they were measured, along depth's own axis.
    /// As librealsense 2.59: right where both pictures have about the same scale and direction. Unlike it, colour's lens
    /// is honoured whatever its model (librealsense ignores all but `MODIFIED_BROWN_CONRADY`), and so is a colour camera
    /// that is mounted upside down.
    Splat,
    /// Each 2x2 neighbourhood is drawn as two triangles unless depth jumps inside it; the nearest wins. Values are
    /// depth along colour's axis. As the Azure Kinect SDK: leaves no holes inside surfaces when colour has more pixels
    /// than depth, and serves cameras that look in different directions.
    Triangles,
}

/// The work of one thread.
#[derive(Debug)]
struct Band {
    splat: SplatRows,
    triangles: TriangleRows,
    /// Where this thread draws when there are several.
    private: Vec<u16>,
}

/// Puts depth into colour's view and colour into depth's view, for one pair of cameras.
///
/// # Example
/// ```
/// use depthrig_bus::{Intrinsics, Pose};
/// use depthrig_calib::{Method, Registration};
///
/// let k = Intrinsics::pinhole(60.0, 60.0, 31.5, 23.5);
/// let moved = Pose { translation_m: [0.105, 0.0, 0.0], ..Pose::IDENTITY };
/// let mut registration = Registration::new(&k, (64, 48), &k, (64, 48), &moved, Method::Splat)?;
/// let mut out = vec![0; 64 * 48];
/// registration.depth_to_color(&[1000; 64 * 48], 0.001, &mut out)?;
/// // 0.105 m at 1 m is 6.3 pixels: what colour sees to the left of depth's picture stays empty.
/// assert_eq!((out[5], out[6]), (0, 1000));
/// # Ok::<(), depthrig_calib::Error>(())
/// ```
#[derive(Debug)]
pub struct Registration {
    method: Method,
    depth_size: (usize, usize),
    color_size: (usize, usize),
    warp: Arc<Warp>,
    bands: Vec<Band>,
    pool: Option<Arc<rayon::ThreadPool>>,
}

/// Largest side of a picture: positions are kept in 16 bits.
const MAX_SIDE: u32 = 16_384;

impl Registration {
    /// Prepares for one pair of cameras. `color_from_depth` is the pose of depth's optical frame in colour's:
    /// `color_pose.inverse().compose(&depth_pose)` of the poses in two frame headers.
    ///
    /// # Errors
    /// [`ErrorKind::NoCalibration`] when one of the cameras has none, [`ErrorKind::BadInput`] for numbers that are none
    /// of a camera, and for pictures that are empty or have a side beyond 16384.
    pub fn new(
        depth: &Intrinsics,
        depth_size: (u32, u32),
        color: &Intrinsics,
        color_size: (u32, u32),
        color_from_depth: &Pose,
        method: Method,
    ) -> Result<Self> {
        for (what, (w, h)) in [("depth", depth_size), ("colour", color_size)] {
            if w == 0 || h == 0 || w > MAX_SIDE || h > MAX_SIDE {
                return Err(Error::new(
                    ErrorKind::BadInput,
                    format!("{what} of {w}x{h} pixels cannot be registered: sides are 1 to {MAX_SIDE}"),
                ));
            }
        }
        let named = |what: &str, k: &Intrinsics| {
            Camera::new(k)
                .map_err(|e| Error::new(e.kind(), format!("registration: {what}: {e}")).with_source(e))
        };
        let (depth, color) = (named("depth", depth)?, named("colour", color)?);
        let pose = color_from_depth.to_affine();
        if !pose.is_finite() {
            return Err(Error::new(
                ErrorKind::BadInput,
                format!("the pose of depth in colour is not finite: {color_from_depth:?}"),
            ));
        }
        let size = |(w, h): (u32, u32)| (w as usize, h as usize);
        let (depth_size, color_size) = (size(depth_size), size(color_size));
        let warp = Arc::new(Warp::new(&depth, depth_size, &color, color_size, &pose, method));
        let mut registration = Self { method, depth_size, color_size, warp, bands: Vec::new(), pool: None };
        registration.bands.push(registration.band(false));
        Ok(registration)
    }

    /// The same with `n` threads of its own; 1 is the caller's thread. The result is the same for every number, and
    /// when the system gives no more threads the caller's does it all. Handing a frame to several threads takes memory
    /// about every thirtieth time; one thread never does.
    pub fn with_threads(mut self, n: usize) -> Self {
        let n = n.clamp(1, self.depth_size.1);
        let pool = rayon::ThreadPoolBuilder::new().num_threads(n).thread_name(|i| format!("register-{i}"));
        self.pool = if n > 1 { pool.build().ok().map(Arc::new) } else { None };
        let n = if self.pool.is_some() { n } else { 1 };
        self.bands = (0..n).map(|_| self.band(n > 1)).collect();
        self
    }

    fn band(&self, private: bool) -> Band {
        let (w, h) = self.color_size;
        Band {
            splat: SplatRows::new(self.depth_size.0),
            triangles: TriangleRows::new(if self.method == Method::Triangles {
                self.depth_size.0
            } else {
                0
            }),
            private: if private { vec![0; w * h] } else { Vec::new() },
        }
    }

    /// The method.
    pub const fn method(&self) -> Method {
        self.method
    }

    /// Width and height of depth.
    pub const fn depth_size(&self) -> (usize, usize) {
        self.depth_size
    }

    /// Width and height of colour.
    pub const fn color_size(&self) -> (usize, usize) {
        self.color_size
    }

    /// Depth in the view and size of colour, in the same unit; 0 where no depth is seen. Rows lie without padding; 0 in
    /// `depth` is a hole, and `unit_m` is metres per unit.
    ///
    /// # Errors
    /// [`ErrorKind::SizeMismatch`] for a picture of another size, [`ErrorKind::BadInput`] for a unit that is not
    /// positive.
    pub fn depth_to_color(&mut self, depth: &[u16], unit_m: f64, out: &mut [u16]) -> Result<()> {
        check_len("depth", depth.len(), self.depth_size, 1)?;
        check_len("registered depth", out.len(), self.color_size, 1)?;
        let unit = check_unit(unit_m)?;
        let (warp, method, (w, h)) = (&*self.warp, self.method, self.depth_size);
        let (width, n) = (self.color_size.0, self.bands.len());
        let draw = |band: &mut Band, rows: core::ops::Range<usize>, target: &mut Target<'_>| match method {
            Method::Splat => band.splat.draw(warp, depth, unit, w, rows, target),
            Method::Triangles => band.triangles.draw(warp, depth, unit, (w, h), rows, target),
        };
        let Some(pool) = &self.pool else {
            let mut target = Target::new(out, width);
            draw(&mut self.bands[0], 0..h, &mut target);
            target.finish();
            return Ok(());
        };
        let bands = &mut self.bands;
        pool.install(|| {
            bands.par_iter_mut().enumerate().for_each(|(i, band)| {
                let mut private = core::mem::take(&mut band.private);
                let mut target = Target::new(&mut private, width);
                draw(band, i * h / n..(i + 1) * h / n, &mut target);
                band.private = private;
            });
            let rows = out.len().div_ceil(width).div_ceil(n).max(1) * width;
            out.par_chunks_mut(rows).enumerate().for_each(|(i, part)| {
                let of = i * rows..i * rows + part.len();
                let all = bands.iter().map(|b| &b.private[of.clone()]);
                target::merge(all, part);
            });
        });
        Ok(())
    }

    /// Colour in the view and size of depth; black where depth has a hole or colour does not look. `color` and `out`
    /// are 8-bit RGB or any other three bytes a pixel. What colour cannot see because something nearer hides it gets
    /// the colour of what hides it.
    ///
    /// [`Method::Splat`] takes the pixel under the top left corner of depth's pixel, under the bottom right one when colour
    /// has fewer rows and columns than depth: what librealsense does. [`Method::Triangles`] takes the four pixels around
    /// its middle in proportion, as the Azure Kinect SDK does.
    ///
    /// # Errors
    /// As [`Registration::depth_to_color`].
    pub fn color_to_depth(&mut self, depth: &[u16], unit_m: f64, color: &[u8], out: &mut [u8]) -> Result<()> {
        check_len("depth", depth.len(), self.depth_size, 1)?;
        check_len("colour", color.len(), self.color_size, 3)?;
        check_len("registered colour", out.len(), self.depth_size, 3)?;
        let unit = check_unit(unit_m)?;
        let (warp, method, (w, h)) = (&*self.warp, self.method, self.depth_size);
        let (size, n) = (self.color_size, self.bands.len());
        let paint = |band: &mut Band, rows: core::ops::Range<usize>, part: &mut [u8]| match method {
            Method::Splat => band.splat.paint(warp, depth, unit, (w, h), rows, color, size, part),
            Method::Triangles => band.triangles.paint(warp, depth, unit, (w, h), rows, color, size, part),
        };
        let Some(pool) = &self.pool else {
            paint(&mut self.bands[0], 0..h, out);
            return Ok(());
        };
        let bands = &mut self.bands;
        let rows = h.div_ceil(n);
        pool.install(|| {
            let parts = out.par_chunks_mut(rows * w * 3);
            bands.par_iter_mut().zip(parts).enumerate().for_each(|(i, (band, part))| {
                paint(band, i * rows..((i + 1) * rows).min(h), part);
            });
        });
        Ok(())
    }
}

fn check_unit(unit_m: f64) -> Result<f32> {
    let unit = unit_m as f32;
    if unit > 0.0 && unit.is_finite() {
        return Ok(unit);
    }
    Err(Error::new(ErrorKind::BadInput, format!("a depth unit of {unit_m} m is none; 0.001 is a millimetre")))
}

/// Largest translation, metres, that two poses of one view may differ by: what a text with six digits loses.
const SAME_PLACE_M: f64 = 1e-6;
/// Largest difference of what the same ray hits, pixels.
const SAME_PIXEL: f64 = 0.01;

/// Whether depth already lies in colour's view (same size, intrinsics and pose), so that nothing need be registered.
/// The poses are those of the two frame headers, on the same parent.
pub fn same_view(
    (depth, depth_size, depth_pose): (&Intrinsics, (u32, u32), &Pose),
    (color, color_size, color_pose): (&Intrinsics, (u32, u32), &Pose),
) -> bool {
    let (Ok(a), Ok(b)) = (Camera::new(depth), Camera::new(color)) else { return false };
    if depth_size != color_size {
        return false;
    }
    let between = color_pose.inverse().compose(depth_pose).to_affine();
    let apart = between.translation.length();
    if apart.is_nan() || apart > SAME_PLACE_M {
        return false;
    }
    let (w, h) = (f64::from(depth_size.0) - 1.0, f64::from(depth_size.1) - 1.0);
    // Lenses are smooth: corners, edges and the middle tell.
    (0..9).all(|i| {
        let pixel = glam::DVec2::new(w * f64::from(i % 3) / 2.0, h * f64::from(i / 3) / 2.0);
        match a.unproject(pixel).map(|ray| b.project(between.matrix3 * ray)) {
            Some(Some(there)) => (there - pixel).length() <= SAME_PIXEL,
            // Neither lens forms a picture there.
            None => b.unproject(pixel).is_none(),
            Some(None) => false,
        }
    })
}

#[cfg(test)]
mod tests;
