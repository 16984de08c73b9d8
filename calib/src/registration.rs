//! Registration: depth in the view of the colour camera, and colour in the view of depth.
//!
//! Registered depth is depth along colour's axis on the ray of colour's pixel, however the cameras are turned against each
//! other, so that colour's intrinsics and pose make points of it. A row of depth takes two steps:
//! 1. every depth pixel becomes a piece of the plane that it and its neighbours lie on, projected into colour ([`cover`]);
//! 2. each piece is drawn with its depth on the ray of every colour pixel that it covers, and the nearest wins ([`splat`]).
//!
//! Everything that depends on the cameras alone is computed once. SIMD is used where the processor has it, and the bits
//! are the same where it has not. Nothing is allocated per frame.

use crate::error::check_len;
use crate::{Camera, Error, ErrorKind, PoseExt, Result};
use depthrig_bus::{Intrinsics, Pose};
use rayon::prelude::*;
use std::sync::Arc;

mod cover;
mod footprint;
mod lens;
mod paint;
mod splat;
mod target;
mod warp;

use paint::PaintRows;
use splat::SplatRows;
use target::Target;
use warp::Warp;

/// The work of one thread.
#[derive(Debug)]
struct Band {
    splat: SplatRows,
    paint: PaintRows,
    /// Where this thread draws when there are several.
    private: Vec<u16>,
}

/// Tables that depend on the cameras alone.
#[derive(Debug)]
struct Tables {
    warp: Warp,
    /// Colour is the coarser image: a depth pixel covers one of its pixels.
    is_point: bool,
}

/// Puts depth into colour's view and colour into depth's view, for one pair of cameras.
///
/// # Example
/// ```
/// use depthrig_bus::{Intrinsics, Pose};
/// use depthrig_calib::Registration;
///
/// let k = Intrinsics::pinhole(60.0, 60.0, 31.5, 23.5);
/// let moved = Pose { translation_m: [0.105, 0.0, 0.0], ..Pose::IDENTITY };
/// let mut registration = Registration::new(&k, (64, 48), &k, (64, 48), &moved)?;
/// let mut out = vec![0; 64 * 48];
/// registration.depth_to_color(&[1000; 64 * 48], 0.001, &mut out)?;
/// // 0.105 m at 1 m is 6.3 pixels: what colour sees to the left of depth's image stays empty.
/// assert_eq!((out[5], out[6]), (0, 1000));
/// # Ok::<(), depthrig_calib::Error>(())
/// ```
#[derive(Debug)]
pub struct Registration {
    depth_size: (usize, usize),
    color_size: (usize, usize),
    tables: Arc<Tables>,
    bands: Vec<Band>,
    pool: Option<Arc<rayon::ThreadPool>>,
}

/// Largest side of an image: positions are kept in 16 bits.
const MAX_SIDE: u32 = 16_384;

impl Registration {
    /// Prepares for one pair of cameras. `color_from_depth` is the pose of depth's optical frame in colour's:
    /// `color_pose.inverse().compose(&depth_pose)` of the poses in two frame headers.
    ///
    /// # Errors
    /// [`ErrorKind::NoCalibration`] when one of the cameras has none, [`ErrorKind::BadInput`] for invalid numbers, and
    /// for images that are empty or have a side beyond 16384.
    pub fn new(
        depth: &Intrinsics,
        depth_size: (u32, u32),
        color: &Intrinsics,
        color_size: (u32, u32),
        color_from_depth: &Pose,
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
        let depth = named("depth", depth)?;
        let color = named("colour", color)?;
        let pose = color_from_depth.to_affine();
        if !pose.is_finite() {
            return Err(Error::new(
                ErrorKind::BadInput,
                format!("the pose of depth in colour is not finite: {color_from_depth:?}"),
            ));
        }
        let size = |(w, h): (u32, u32)| (w as usize, h as usize);
        let depth_size = size(depth_size);
        let color_size = size(color_size);
        let tables = Arc::new(Tables {
            warp: Warp::new(&depth, depth_size, &color, color_size, &pose),
            is_point: footprint::is_point(&depth, depth_size, &color, &pose),
        });
        let mut registration = Self { depth_size, color_size, tables, bands: Vec::new(), pool: None };
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
            splat: SplatRows::new(self.depth_size.0, w),
            paint: PaintRows::new(self.depth_size.0),
            private: if private { vec![0; w * h] } else { Vec::new() },
        }
    }

    /// Width and height of depth.
    pub const fn depth_size(&self) -> (usize, usize) {
        self.depth_size
    }

    /// Width and height of colour.
    pub const fn color_size(&self) -> (usize, usize) {
        self.color_size
    }

    /// Depth in the view and size of colour, in the same unit and along colour's axis; 0 where no depth is seen. Rows lie
    /// without padding; 0 in `depth` is a hole, and `unit_m` is metres per unit.
    ///
    /// # Errors
    /// [`ErrorKind::SizeMismatch`] for an image of another size, [`ErrorKind::BadInput`] for a unit that is not
    /// positive.
    pub fn depth_to_color(&mut self, depth: &[u16], unit_m: f64, out: &mut [u16]) -> Result<()> {
        check_len("depth", depth.len(), self.depth_size, 1)?;
        check_len("registered depth", out.len(), self.color_size, 1)?;
        let unit = check_unit(unit_m)?;
        let Tables { warp, is_point } = &*self.tables;
        let h = self.depth_size.1;
        let width = self.color_size.0;
        let draw = |band: &mut SplatRows, rows: core::ops::Range<usize>, target: &mut Target<'_>| {
            band.draw(warp, *is_point, depth, unit, rows, target);
        };
        let Some(pool) = &self.pool else {
            let mut target = Target::new(out, width);
            draw(&mut self.bands[0].splat, 0..h, &mut target);
            target::finish(out);
            return Ok(());
        };
        let bands = &mut self.bands;
        let n = bands.len();
        pool.install(|| {
            bands.par_iter_mut().enumerate().for_each(|(i, band)| {
                let mut target = Target::new(&mut band.private, width);
                draw(&mut band.splat, i * h / n..(i + 1) * h / n, &mut target);
            });
            let rows = out.len().div_ceil(width).div_ceil(n).max(1);
            out.par_chunks_mut(rows * width).enumerate().for_each(|(i, part)| {
                let from = i * rows * width;
                let of = from..from + part.len();
                target::merge(bands.iter().map(|b| &b.private[of.clone()]), part);
                target::finish(part);
            });
        });
        Ok(())
    }

    /// Colour in the view and size of depth; black where depth has a hole or colour sees nothing. `color` and `out`
    /// are 8-bit RGB or any other three bytes a pixel. A pixel gets the four pixels of colour around its middle in
    /// proportion. What colour cannot see because something nearer hides it gets the colour of what hides it.
    ///
    /// # Errors
    /// As [`Registration::depth_to_color`].
    pub fn color_to_depth(&mut self, depth: &[u16], unit_m: f64, color: &[u8], out: &mut [u8]) -> Result<()> {
        check_len("depth", depth.len(), self.depth_size, 1)?;
        check_len("colour", color.len(), self.color_size, 3)?;
        check_len("registered colour", out.len(), self.depth_size, 3)?;
        let unit = check_unit(unit_m)?;
        let warp = &self.tables.warp;
        let (w, h) = self.depth_size;
        let size = self.color_size;
        let paint = |band: &mut Band, rows: core::ops::Range<usize>, part: &mut [u8]| {
            band.paint.paint(warp, depth, unit, w, rows, color, size, part);
        };
        let Some(pool) = &self.pool else {
            paint(&mut self.bands[0], 0..h, out);
            return Ok(());
        };
        let bands = &mut self.bands;
        let rows = h.div_ceil(bands.len());
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
    Err(Error::new(ErrorKind::BadInput, format!("invalid depth unit {unit_m} m; 0.001 is a millimetre")))
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
    let w = f64::from(depth_size.0) - 1.0;
    let h = f64::from(depth_size.1) - 1.0;
    // Lenses are smooth: corners, edges and the middle suffice.
    (0..9).all(|i| {
        let pixel = glam::DVec2::new(w * f64::from(i % 3) / 2.0, h * f64::from(i / 3) / 2.0);
        match a.unproject(pixel).map(|ray| b.project(between.matrix3 * ray)) {
            Some(Some(there)) => (there - pixel).length() <= SAME_PIXEL,
            // Neither lens forms an image there.
            None => b.unproject(pixel).is_none(),
            Some(None) => false,
        }
    })
}

#[cfg(test)]
mod tests;
