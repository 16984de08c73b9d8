//! Drawing depth pixels as rectangles of planes: the nearest wins.
//!
//! Neighbouring pixels of a row mostly cover the same rows of colour. Such a run is drawn into a line first, which holds
//! the plane of the nearest depth pixel for every column. The line is then drawn into each of these rows, a few columns at
//! a time: a run of a real image is about ten columns long, and remainders of long vectors would take most of the time.
#![allow(clippy::inline_always, reason = "what is not inlined is compiled for the oldest processor")]

use super::cover::{Cover, NOWHERE, Planes, whole};
use super::target::{EMPTY, Target};
use super::warp::Warp;
use crate::simd::for_every_processor;

/// A depth that draws nothing.
const BEYOND: f32 = 65_536.0;
/// Columns that are drawn together.
const CHUNK: usize = 8;

/// The rows that one thread works with.
#[derive(Debug)]
pub(super) struct SplatRows {
    cover: Cover,
    /// One slot per column of colour and a chunk beyond; free between runs.
    line: Vec<Slot>,
}

/// The depth that a run of depth pixels draws into one column of colour. One store writes all of it.
#[derive(Debug, Clone, Copy)]
#[repr(align(16))]
struct Slot {
    /// The key of the nearest pixel.
    key: u16,
    /// Its depth in the first row of the run, and its change from row to row.
    first: f32,
    by_row: f32,
}

/// Draws nothing.
const FREE: Slot = Slot { key: EMPTY, first: BEYOND, by_row: 0.0 };

impl SplatRows {
    pub(super) fn new(depth_width: usize, color_width: usize) -> Self {
        Self { cover: Cover::new(depth_width), line: vec![FREE; color_width + CHUNK] }
    }

    /// Draws some rows of depth.
    pub(super) fn draw(
        &mut self,
        warp: &Warp,
        is_point: bool,
        depth: &[u16],
        unit: f32,
        rows: core::ops::Range<usize>,
        target: &mut Target<'_>,
    ) {
        let Self { cover, line } = self;
        for row in rows {
            cover.find(warp, is_point, depth, unit, row);
            let Cover { columns, rows, keys, planes, .. } = &*cover;
            if is_point {
                draw_points(columns, rows, keys, target.pixels, target.width);
            } else {
                draw_row(columns, rows, keys, planes, line, target.pixels, target.width);
            }
        }
    }
}

/// Draws pixels that cover one pixel each.
fn draw_points(columns: &[u32], rows: &[u32], keys: &[u16], pixels: &mut [u16], width: usize) {
    for ((c, r), key) in columns.iter().zip(rows).zip(keys) {
        // One that is not seen lies beyond the image.
        let at = (r & 0xffff) as usize * width + (c & 0xffff) as usize;
        if let Some(pixel) = pixels.get_mut(at) {
            *pixel = (*pixel).min(*key);
        }
    }
}

/// The key of a depth that is cut to 16 bits; that of a hole from [`BEYOND`] on.
#[inline(always)]
fn key_at(z: f32) -> u16 {
    let z = z + 0.5;
    let z = if z > 1.0 { z } else { 1.0 };
    (whole(if z < BEYOND { z } else { BEYOND }) - 1) as u16
}

for_every_processor! {
    /// Draws the rectangles of a row.
    fn draw_row(
        columns: &[u32], rows: &[u32], keys: &[u16], planes: &Planes,
        line: &mut [Slot], pixels: &mut [u16], width: usize,
    ) {
        let n = rows.len();
        let columns = &columns[..n];
        let keys = &keys[..n];
        let z = &planes.z[..n];
        let by_u = &planes.by_u[..n];
        let by_v = &planes.by_v[..n];
        let mut i = 0;
        while i < n {
            let run = rows[i];
            if run == NOWHERE {
                i += 1;
                continue;
            }
            let top = (run >> 16) as usize;
            let bottom = (run & 0xffff) as usize;
            let mut from = width;
            let mut to = 0;
            while i < n && rows[i] == run {
                let l = (columns[i] >> 16) as usize;
                let r = (columns[i] & 0xffff) as usize;
                (from, to) = (from.min(l), to.max(r + 1));
                put(keys[i], z[i], by_u[i], by_v[i], line.get_mut(l..=r));
                i += 1;
            }
            // Whole chunks where the image does not end: free slots draw nothing.
            let end = from + (to - from).next_multiple_of(CHUNK);
            let to = if bottom * width + end <= pixels.len() { end } else { to };
            let Some(line) = line.get_mut(from..to) else { continue };
            let mut at = top * width + from;
            let (chunks, rest) = line.as_chunks_mut::<CHUNK>();
            for chunk in chunks {
                let mut first = [0.0; CHUNK];
                let mut by_row = [0.0; CHUNK];
                for k in 0..CHUNK {
                    first[k] = chunk[k].first;
                    by_row[k] = chunk[k].by_row;
                    chunk[k] = FREE;
                }
                for row in 0..=bottom - top {
                    let beyond = pixels.get_mut(at + row * width..);
                    let Some(pixels) = beyond.and_then(|p| p.first_chunk_mut::<CHUNK>()) else { continue };
                    for k in 0..CHUNK {
                        pixels[k] = pixels[k].min(key_at(first[k] + by_row[k] * row as f32));
                    }
                }
                at += CHUNK;
            }
            for slot in rest {
                for row in 0..=bottom - top {
                    let Some(pixel) = pixels.get_mut(at + row * width) else { continue };
                    *pixel = (*pixel).min(key_at(slot.first + slot.by_row * row as f32));
                }
                *slot = FREE;
                at += 1;
            }
        }
    }
}

/// Puts a depth pixel into those slots in which it is the nearest: depth `z` in the first of them, `by_column` more in each
/// further one.
#[inline(always)]
fn put(key: u16, z: f32, by_column: f32, by_row: f32, slots: Option<&mut [Slot]>) {
    let mut first = z;
    // Not `flatten`, which made all of drawing a tenth slower.
    let Some(slots) = slots else { return };
    for slot in slots {
        if key < slot.key {
            *slot = Slot { key, first, by_row };
        }
        first += by_column;
    }
}
