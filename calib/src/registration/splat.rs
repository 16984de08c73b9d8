//! Drawing depth pixels as rectangles of planes: the nearest wins.
//!
//! Neighbouring pixels of a row mostly cover the same rows of colour. Such a run is drawn once into a line, which holds the
//! plane of the nearest depth pixel for every column, and the line into each of these rows: there the work is minima of
//! whole vectors.
#![allow(clippy::inline_always, reason = "what is not inlined is compiled for the oldest processor")]

use super::cover::{Cover, NOWHERE, Planes, whole};
use super::target::{EMPTY, Target};
use super::warp::Warp;
use crate::simd::for_every_processor;

/// What draws nothing.
const BEYOND: f32 = 65_536.0;

/// The rows that one thread works with.
#[derive(Debug)]
pub(super) struct SplatRows {
    cover: Cover,
    line: Line,
}

/// A run of depth pixels in the columns of colour; empty between runs.
#[derive(Debug)]
struct Line {
    /// The key of the nearest pixel.
    keys: Vec<u16>,
    /// Its depth in the first row of the run, and its change from row to row.
    first: Vec<f32>,
    by_row: Vec<f32>,
}

impl SplatRows {
    pub(super) fn new(depth_width: usize, color_width: usize) -> Self {
        Self {
            cover: Cover::new(depth_width),
            line: Line {
                keys: vec![EMPTY; color_width],
                first: vec![BEYOND; color_width],
                by_row: vec![0.0; color_width],
            },
        }
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
                let Line { keys: nearest, first, by_row } = line;
                draw_row(columns, rows, keys, planes, nearest, first, by_row, target.pixels, target.width);
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

/// The key of a depth that is cut to 16 bits; that of nothing from [`BEYOND`] on.
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
        nearest: &mut [u16], first: &mut [f32], by_row: &mut [f32], pixels: &mut [u16], width: usize,
    ) {
        let n = rows.len();
        let (columns, keys) = (&columns[..n], &keys[..n]);
        let (u, v, z) = (&planes.u[..n], &planes.v[..n], &planes.z[..n]);
        let (by_u, by_v) = (&planes.by_u[..n], &planes.by_v[..n]);
        let mut i = 0;
        while i < n {
            let run = rows[i];
            if run == NOWHERE {
                i += 1;
                continue;
            }
            let (top, bottom) = ((run >> 16) as usize, (run & 0xffff) as usize);
            let (mut from, mut to) = (width, 0);
            while i < n && rows[i] == run {
                let (l, r) = ((columns[i] >> 16) as usize, (columns[i] & 0xffff) as usize);
                (from, to) = (from.min(l), to.max(r + 1));
                let (own, change) = (keys[i], by_u[i]);
                let z = z[i] + (change * (l as f32 - u[i]) + by_v[i] * (top as f32 - v[i]));
                put(own, z, change, by_v[i], nearest.get_mut(l..=r), first.get_mut(l..=r), by_row.get_mut(l..=r));
                i += 1;
            }
            let parts = (nearest.get_mut(from..to), first.get_mut(from..to), by_row.get_mut(from..to));
            let (Some(nearest), Some(first), Some(by_row)) = parts else { continue };
            for y in top..=bottom {
                let Some(row) = pixels.get_mut(y * width + from..y * width + to) else { continue };
                let down = (y - top) as f32;
                for ((pixel, first), by_row) in row.iter_mut().zip(&*first).zip(&*by_row) {
                    *pixel = (*pixel).min(key_at(first + by_row * down));
                }
            }
            nearest.fill(EMPTY);
            first.fill(BEYOND);
            by_row.fill(0.0);
        }
    }
}

/// Puts a depth pixel into those columns of the line in which it is the nearest: depth `z` in the first of them, `change`
/// more in each further one.
#[inline(always)]
fn put(
    key: u16,
    z: f32,
    change: f32,
    down: f32,
    nearest: Option<&mut [u16]>,
    first: Option<&mut [f32]>,
    by_row: Option<&mut [f32]>,
) {
    let (Some(nearest), Some(first), Some(by_row)) = (nearest, first, by_row) else { return };
    let mut z = z;
    for ((nearest, first), by_row) in nearest.iter_mut().zip(first).zip(by_row) {
        if key < *nearest {
            (*nearest, *first, *by_row) = (key, z, down);
        }
        z += change;
    }
}
