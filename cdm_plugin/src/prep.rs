//! Everything around the network: from images to its input, and from its output to depth.
//!
//! The steps of the official code (`manip-as-in-sim-suite/cdm`, Apache-2.0) in one pass over each image and without
//! allocating: [`Prep`] holds the tables for one size of image and one size of input. The numbers are those of the
//! official code, except that colour is summed in `f32` where it uses `f64` (about 1e-6 of the network's input), and
//! that 65535 is a hole before it is a depth, which is the same with the official range of 6 m for every unit from
//! 0.1 mm up (65535 of them are more than 6 m).

// The steps of a pixel must end up inside the loops that are compiled for AVX2, whatever their size.
#[allow(clippy::inline_always)]
mod cubic;
#[allow(clippy::inline_always)]
mod depth;
#[allow(clippy::inline_always)]
mod finish;
mod nearest;
mod position;
mod size;

#[cfg(test)]
mod tests;

pub use position::Positions;
pub use size::{check_input_size, net_size};

use crate::workers::{Workers, wide};
use crate::{ChannelOrder, Color, Output, RawDepth, Result};
use cubic::{CubicResize, Normalise};
use depth::DepthTable;
use nearest::{index_like_opencv, index_like_torch};
use std::sync::Arc;

/// Tables and scratch memory for images of one size going to a network's input of one size.
#[derive(Debug)]
pub struct Prep {
    image: (usize, usize),
    net: (usize, usize),
    cubic: CubicResize,
    /// For each column and row of the input, that of the image.
    depth_columns: Vec<u32>,
    depth_rows: Vec<u32>,
    inverse: DepthTable,
    /// For each column and row of the image, that of the output.
    out_columns: Vec<u32>,
    out_rows: Vec<u32>,
    /// As many as there are threads.
    bands: Vec<Band>,
    workers: Arc<Workers>,
}

/// Scratch memory of one band of rows.
#[derive(Debug)]
struct Band {
    line: Vec<f32>,
    /// Whether any inverse depth of the band is above 0.
    has_depth: bool,
    out: finish::Row,
}

impl AsMut<finish::Row> for Band {
    fn as_mut(&mut self) -> &mut finish::Row {
        &mut self.out
    }
}

impl Prep {
    /// Builds the tables for images of `width` and `height` with the input's shorter side near `input_size`; the caller's
    /// thread does the work.
    ///
    /// # Errors
    /// Those of [`net_size`].
    pub fn new(width: usize, height: usize, input_size: u32, max_depth_m: f64) -> Result<Self> {
        Self::with_workers(Arc::new(Workers::new(1)?), width, height, input_size, max_depth_m)
    }

    /// As [`Self::new`]; `workers` do the work.
    pub(crate) fn with_workers(
        workers: Arc<Workers>,
        width: usize,
        height: usize,
        input_size: u32,
        max_depth_m: f64,
    ) -> Result<Self> {
        let net = net_size(width, height, input_size)?;
        let cubic = CubicResize::new(width, height, net.0, net.1);
        let band = || Band { line: cubic.line(), has_depth: false, out: finish::Row::new(net.0) };
        Ok(Self {
            image: (width, height),
            net,
            bands: (0..workers.threads()).map(|_| band()).collect(),
            cubic,
            depth_columns: index_like_opencv(width, net.0),
            depth_rows: index_like_opencv(height, net.1),
            inverse: DepthTable::new(max_depth_m),
            out_columns: index_like_torch(net.0, width),
            out_rows: index_like_torch(net.1, height),
            workers,
        })
    }

    /// Width and height of the images.
    pub const fn image(&self) -> (usize, usize) {
        self.image
    }

    /// Width and height of the network's input.
    pub const fn net(&self) -> (usize, usize) {
        self.net
    }

    /// Writes the network's input `[4, height, width]`: colour, normalised, and inverse depth in 1/m. Returns whether any
    /// inverse depth is above 0: without any, the network would have no reference.
    ///
    /// # Errors
    /// [`crate::ErrorKind::SizeMismatch`] and [`crate::ErrorKind::BadInput`] when the images are not of the size that
    /// this was made for, or are cut short.
    pub fn prepare(
        &mut self,
        color: &Color<'_>,
        depth: &RawDepth<'_>,
        order: ChannelOrder,
        x: &mut [f32],
    ) -> Result<bool> {
        color.check()?;
        depth.check(color)?;
        size::check_image(self.image.0, self.image.1, color)?;
        let plane = self.net.0 * self.net.1;
        size::check_len("the network's input", x.len(), 4 * plane)?;
        let mut planes = x.chunks_exact_mut(plane);
        let planes = [(); 4].map(|()| planes.next().unwrap_or_default());
        let scale = Normalise::new(color, order);
        self.inverse.use_unit(depth.unit_m);
        let mut bands = core::mem::take(&mut self.bands);
        let wide = self.workers.wide;
        self.workers.bands(&mut bands, planes, self.net.0, |first, band, rows| {
            prepare_rows(wide, self, (color, depth), &scale, first, band, rows);
        });
        self.bands = bands;
        Ok(self.bands.iter().any(|band| band.has_depth))
    }

    /// Writes depth at the image's size from the network's output `[height, width]`, inverse depth in 1/m.
    ///
    /// # Errors
    /// [`crate::ErrorKind::SizeMismatch`] and [`crate::ErrorKind::BadInput`] when `y` or `out` is of another size, or
    /// for an invalid unit.
    pub fn finish(&mut self, y: &[f32], out: &mut Output<'_>) -> Result<()> {
        size::check_len("the network's output", y.len(), self.net.0 * self.net.1)?;
        out.check(self.image.0, self.image.1)?;
        let source = finish::Source { y, rows: &self.out_rows, columns: &self.out_columns };
        source.write(&self.workers, &mut self.bands, out);
        Ok(())
    }
}

wide! {
    /// Rows of the network's input from the row `first` on.
    fn prepare_rows(
        prep: &Prep,
        images: (&Color<'_>, &RawDepth<'_>),
        scale: &Normalise,
        first: usize,
        band: &mut Band,
        rows: [&mut [f32]; 4],
    ) {
        let (color, depth) = images;
        let [a, b, c, inverse] = rows;
        prep.cubic.run(color, scale, first, &mut band.line, [a, b, c]);
        let rows = &prep.depth_rows[first..];
        band.has_depth = prep.inverse.sample(depth.pixels, prep.image.0, rows, &prep.depth_columns, inverse);
    }
}
