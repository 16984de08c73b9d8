//! From the packed form back to the image. The input may be anything: every length is checked, and nothing is
//! allocated that the input cannot fill.

use super::{DepthShape, EXPANSION_MAX, HEAD, Table, bad, table};
use crate::Result;

/// Unpacks depth images; its buffers are reused.
pub struct DepthDecoder {
    palette: Table<u16>,
    rows: [Vec<u16>; 2],
    body: Vec<u8>,
    zstd: Option<zstd::bulk::Decompressor<'static>>,
}

impl Default for DepthDecoder {
    fn default() -> Self {
        Self::new()
    }
}

impl DepthDecoder {
    /// A decoder with its table, 128 KB.
    pub fn new() -> Self {
        Self { palette: table(), rows: Default::default(), body: Vec::new(), zstd: None }
    }

    /// Replaces `out` by the image of which `data` is the packed form.
    ///
    /// # Errors
    /// [`crate::ErrorKind::Codec`] when `data` is damaged or is not an image of this shape.
    pub fn decode(&mut self, data: &[u8], shape: DepthShape, out: &mut Vec<u8>) -> Result<()> {
        shape.check()?;
        let (head, packed) = data.split_first_chunk::<HEAD>().ok_or_else(|| bad("it is cut short"))?;
        let count = u32::from_le_bytes(*head) as usize;
        if count == 0 || count > (1 << 16).min(shape.pixels()) {
            return Err(bad(format!("a palette of {count} values does not fit {} pixels", shape.pixels())));
        }
        let len = 2 * count + shape.bytes() as usize;
        if len as u64 > EXPANSION_MAX * (packed.len() as u64 + 1) {
            return Err(bad(format!("{} bytes cannot hold {len}", packed.len())));
        }
        self.unpack(packed, len)?;
        self.read_palette(count)?;
        out.clear();
        out.resize(shape.bytes() as usize, 0);
        self.pixels(count, shape, out)
    }

    fn unpack(&mut self, packed: &[u8], len: usize) -> Result<()> {
        let fail = |e: std::io::Error| bad(format!("it cannot be unpacked: {e}"));
        let zstd = match &mut self.zstd {
            Some(zstd) => zstd,
            none => none.insert(zstd::bulk::Decompressor::new().map_err(fail)?),
        };
        self.body.resize(len, 0);
        let n = zstd.decompress_to_buffer(packed, &mut self.body[..]).map_err(fail)?;
        if n != len {
            return Err(bad(format!("it unpacks to {n} bytes, {len} are wanted")));
        }
        Ok(())
    }

    fn read_palette(&mut self, count: usize) -> Result<()> {
        let mut value = 0u32;
        for i in 0..count {
            let step = u32::from(self.body[i]) | u32::from(self.body[count + i]) << 8;
            if i > 0 && step == 0 {
                return Err(bad("its palette is not rising"));
            }
            value += step;
            self.palette[i] = u16::try_from(value).map_err(|_| bad("its palette leaves 16 bits"))?;
        }
        Ok(())
    }

    fn pixels(&mut self, count: usize, shape: DepthShape, out: &mut [u8]) -> Result<()> {
        let width = shape.width as usize;
        let pixels = shape.pixels();
        let (low, rest) = self.body[2 * count..].split_at(pixels);
        let (high, mut padding) = rest.split_at(pixels);
        for row in &mut self.rows {
            row.clear();
            row.resize(width + 1, 0);
        }
        let [above, here] = &mut self.rows;
        let planes = low.chunks_exact(width).zip(high.chunks_exact(width));
        let last = (count - 1) as u16;
        for (row, (low, high)) in out.chunks_exact_mut(shape.step as usize).zip(planes) {
            // Unfolding needs no neighbour and is vectorised; the sum behind it is not.
            for ((here, low), high) in here[1..].iter_mut().zip(low).zip(high) {
                let folded = u16::from(*low) | u16::from(*high) << 8;
                *here = (folded >> 1) ^ 0u16.wrapping_sub(folded & 1);
            }
            let mut west = 0u16;
            let mut most = 0u16;
            for (here, above) in here[1..].iter_mut().zip(above.windows(2)) {
                let north_west = above[0];
                let north = above[1];
                let least = north.min(west);
                let greatest = north.max(west);
                let predicted = north.wrapping_add(west).wrapping_sub(north_west.max(least).min(greatest));
                west = predicted.wrapping_add(*here);
                *here = west;
                most = most.max(west);
            }
            if most > last {
                return Err(bad(format!("rank {most} is not in its palette of {count} values")));
            }
            let (values, pad) = row.split_at_mut(shape.row());
            for (value, rank) in values.chunks_exact_mut(2).zip(&here[1..]) {
                value.copy_from_slice(&self.palette[usize::from(*rank)].to_le_bytes());
            }
            if !pad.is_empty() {
                let (these, left) = padding.split_at(pad.len());
                pad.copy_from_slice(these);
                padding = left;
            }
            std::mem::swap(above, here);
        }
        Ok(())
    }
}
