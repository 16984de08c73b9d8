//! From an image to its packed form.

use super::{DepthShape, Table, bad, table};
use crate::Result;
use zstd::zstd_safe::{CParameter, ParamSwitch};

/// Packs depth images; its buffers are reused, so that only the first image of a size allocates.
pub struct DepthEncoder {
    seen: Table<u8>,
    ranks: Table<u16>,
    /// Two rows of ranks, each with a zero before it.
    rows: [Vec<u16>; 2],
    body: Vec<u8>,
    /// Where the compressor writes, which wants room for the worst case.
    packed: Vec<u8>,
    zstd: Option<zstd::bulk::Compressor<'static>>,
}

impl Default for DepthEncoder {
    fn default() -> Self {
        Self::new()
    }
}

/// The compressor of prediction residuals. These are noise, in which a compressor's search finds little but chance. So
/// it looks at every seventeenth place, and remembers 64 of them: runs and rows that repeat are found, and the rest is
/// Huffman coded, which the library by default leaves out at such steps. On real images that is 2.4 times as fast as
/// level 1, and a twentieth smaller (`examples/bench_codecs.rs`).
fn compressor() -> std::io::Result<zstd::bulk::Compressor<'static>> {
    let mut zstd = zstd::bulk::Compressor::new(1)?;
    for parameter in [
        CParameter::TargetLength(16),
        CParameter::HashLog(6),
        CParameter::MinMatch(7),
        CParameter::LiteralCompressionMode(ParamSwitch::Enable),
    ] {
        zstd.set_parameter(parameter)?;
    }
    Ok(zstd)
}

impl DepthEncoder {
    /// An encoder with its tables, 200 KB.
    pub fn new() -> Self {
        Self {
            seen: table(),
            ranks: table(),
            rows: Default::default(),
            body: Vec::new(),
            packed: Vec::new(),
            zstd: None,
        }
    }

    /// Appends the packed form of `pixels`, little-endian and padded as `shape` says, to `out`.
    ///
    /// # Errors
    /// [`crate::ErrorKind::Codec`] when `shape` is invalid, does not have the size of `pixels` or is above 256 MiB.
    pub fn encode(&mut self, pixels: &[u8], shape: DepthShape, out: &mut Vec<u8>) -> Result<()> {
        shape.check()?;
        if pixels.len() as u64 != shape.bytes() {
            return Err(bad(format!("{} bytes are there, {} are wanted", pixels.len(), shape.bytes())));
        }
        self.body.clear();
        let palette = self.palette(pixels, shape);
        self.residuals(pixels, shape);
        if shape.padding() > 0 {
            for row in pixels.chunks_exact(shape.step as usize) {
                self.body.extend_from_slice(&row[shape.row()..]);
            }
        }
        let fail = |e| bad("zstd failed").with_source(e);
        let zstd = match &mut self.zstd {
            Some(zstd) => zstd,
            none => none.insert(compressor().map_err(fail)?),
        };
        self.packed.clear();
        self.packed.reserve(zstd::zstd_safe::compress_bound(self.body.len()));
        zstd.compress_to_buffer(&self.body, &mut self.packed).map_err(fail)?;
        out.extend_from_slice(&palette.to_le_bytes());
        out.extend_from_slice(&self.packed);
        Ok(())
    }

    /// Gives each value in the image its rank and writes the sorted values as differences; returns their number.
    fn palette(&mut self, pixels: &[u8], shape: DepthShape) -> u32 {
        self.seen.fill(0);
        for row in pixels.chunks_exact(shape.step as usize) {
            for p in row[..shape.row()].chunks_exact(2) {
                self.seen[usize::from(u16::from_le_bytes([p[0], p[1]]))] = 1;
            }
        }
        let mut count = 0u32;
        let mut last = 0u16;
        // Low bytes first; the high bytes wait in the table of rows, which is free now.
        let high = &mut self.rows[0];
        high.clear();
        for value in 0..=u16::MAX {
            if self.seen[usize::from(value)] != 0 {
                self.ranks[usize::from(value)] = count as u16;
                let step = value - last;
                self.body.push(step as u8);
                high.push(step >> 8);
                (count, last) = (count + 1, value);
            }
        }
        self.body.extend(high.iter().map(|h| *h as u8));
        count
    }

    /// Writes what the prediction leaves: all low bytes, then all high bytes.
    fn residuals(&mut self, pixels: &[u8], shape: DepthShape) {
        let width = shape.width as usize;
        let at = self.body.len();
        self.body.resize(at + 2 * shape.pixels(), 0);
        let (low, high) = self.body[at..].split_at_mut(shape.pixels());
        for row in &mut self.rows {
            row.clear();
            row.resize(width + 1, 0);
        }
        let [above, here] = &mut self.rows;
        let planes = low.chunks_exact_mut(width).zip(high.chunks_exact_mut(width));
        for (row, (low, high)) in pixels.chunks_exact(shape.step as usize).zip(planes) {
            for (rank, p) in here[1..].iter_mut().zip(row[..shape.row()].chunks_exact(2)) {
                *rank = self.ranks[usize::from(u16::from_le_bytes([p[0], p[1]]))];
            }
            // Slices of one length, so that the loop is vectorised without a bounds check.
            let north_west = &above[..width];
            let north = &above[1..=width];
            let west = &here[..width];
            let this = &here[1..=width];
            let low = &mut low[..width];
            let high = &mut high[..width];
            for i in 0..width {
                let n = north[i];
                let w = west[i];
                let least = n.min(w);
                let most = n.max(w);
                // The median of n, w and n + w - nw, without leaving 16 bits.
                let predicted = n.wrapping_add(w).wrapping_sub(north_west[i].max(least).min(most));
                let left = this[i].wrapping_sub(predicted);
                // Zigzag: 0, -1, 1, -2, ... become 0, 1, 2, 3, ...
                let folded = (left << 1) ^ 0u16.wrapping_sub(left >> 15);
                low[i] = folded as u8;
                high[i] = (folded >> 8) as u8;
            }
            std::mem::swap(above, here);
        }
    }
}
