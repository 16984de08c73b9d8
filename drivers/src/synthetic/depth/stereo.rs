//! What a stereo camera reports.
//!
//! Depth comes from disparity, `z = f b / d`, in steps of 1/32 px, so that noise and steps grow with z². There
//! is no depth where the second imager does not see the spot, left of where the pictures overlap, where
//! nothing can be matched, and beyond the search range. The matching window makes near things wider.

use super::super::models::{DepthPrinciple, Model};
use super::super::noise::{Rolls, normal_of, smooth2};
use super::super::texture::Surface;
use super::super::view::View;
use super::Sample;
use rayon::prelude::*;

/// Disparities are multiples of one over this, pixels.
pub(crate) const SUBPIXEL: f32 = 32.0;
/// Half of the matching window at 1280 pixels per row.
const WINDOW: f32 = 3.6;
/// A step of disparity that is an edge, pixels.
const EDGE_PX: f32 = 1.2;

/// Depth in metres, 0 for none.
pub(super) fn measure(view: &View<'_>, model: &Model, samples: &[Sample], seed: u64) -> Vec<f32> {
    let DepthPrinciple::Stereo { baseline_m, projector, sigma_px, search_px } = model.depth else {
        return Vec::new();
    };
    let w = view.rays.width;
    let focal_baseline = baseline_m / view.rays.pixel_rad;
    let scale = w as f32 / 1280.0;
    let matcher = Matcher {
        w,
        focal_baseline,
        projector,
        sigma_px,
        search_px,
        window: (WINDOW * scale).max(1.0),
        scale,
        seed,
    };
    let ideal: Vec<f32> =
        samples.iter().map(|s| if s.z > 0.0 { focal_baseline / s.z } else { 0.0 }).collect();
    let mut out = vec![0.0; samples.len()];
    out.par_chunks_mut(w).enumerate().for_each(|(y, row)| matcher.row(y, samples, &ideal, row));
    out
}

struct Matcher {
    w: usize,
    focal_baseline: f32,
    projector: bool,
    sigma_px: f32,
    search_px: f32,
    window: f32,
    scale: f32,
    seed: u64,
}

impl Matcher {
    fn row(&self, y: usize, samples: &[Sample], ideal: &[f32], out: &mut [f32]) {
        let reach = (self.window * 1.4).ceil() as usize;
        let h = samples.len() / self.w;
        // The nearest thing within the window above and below, per column.
        let above = y.saturating_sub(reach / 2);
        let below = (y + reach / 2).min(h - 1);
        for x in 0..self.w {
            let at = y * self.w + x;
            let here = &samples[at];
            let layer = (self.seed & 0xFFFF) as i32;
            let (fx, fy) = (x as f32 / self.scale, y as f32 / self.scale);
            let rolls = Rolls::new(self.seed, x as u32, y as u32, 7).bits(0);
            let blotch = smooth2(fx / 9.0, fy / 9.0, layer);
            // How far this window reaches wanders along an edge, as in real pictures.
            let window = (self.window * (0.35 + 1.1 * smooth2(fx / 7.0, fy / 7.0, layer + 1))) as usize;
            let mut disparity = ideal[at];
            let mut is_hidden = here.is_hidden;
            let mut texture = here.texture;
            for dx in 1..=window {
                for side in [x.checked_sub(dx), Some(x + dx).filter(|x| *x < self.w)].into_iter().flatten() {
                    let there = y * self.w + side;
                    if ideal[there] > disparity + EDGE_PX {
                        (disparity, is_hidden, texture) =
                            (ideal[there], samples[there].is_hidden, samples[there].texture);
                    }
                }
            }
            for there in [above * self.w + x, below * self.w + x] {
                if ideal[there] > disparity + EDGE_PX && blotch > 0.5 {
                    (disparity, is_hidden, texture) =
                        (ideal[there], samples[there].is_hidden, samples[there].texture);
                }
            }
            if is_hidden || disparity <= 0.0 || disparity > self.search_px || (x as f32) < disparity {
                continue;
            }
            if self.quality(here, texture, disparity) < 0.16 + 0.34 * blotch + 0.05 * normal_of(rolls) {
                continue;
            }
            // Part of the error is shared by neighbours that share most of a window.
            let shared = smooth2(fx / 5.0, fy / 5.0, layer + 2) - 0.5;
            let own = normal_of(rolls.rotate_left(32).wrapping_mul(0x9E37_79B9_7F4A_7C15));
            let sigma = self.sigma_px * (1.5 - 0.5 * texture.min(1.0));
            let matched = disparity + sigma * (0.55 * own + 3.2 * shared);
            let step = (matched * SUBPIXEL).round().max(1.0) / SUBPIXEL;
            out[x] = self.focal_baseline / step;
        }
    }

    /// How surely a match is found, about 0..1; below the threshold of about 0.3 there is a hole.
    fn quality(&self, here: &Sample, texture: f32, disparity: f32) -> f32 {
        let z = self.focal_baseline / disparity;
        // The projector's dots: on what sends them back, as long as they are bright enough.
        let dots = if self.projector {
            0.75 * here.albedo.sqrt() / (1.0 + (z / 3.0).powi(2))
        } else {
            0.12 * here.albedo.sqrt()
        };
        let found = (texture + dots).min(1.0);
        // A slanted surface looks different to the two imagers.
        let slant = (here.facing * 3.5).min(1.0);
        let trouble = match here.surface {
            Surface::Glass => 0.45,
            Surface::Mirror => 0.6,
            Surface::Shiny => 0.5,
            Surface::Glossy => 0.92,
            Surface::Matte => 1.0,
        };
        found * slant * trouble
    }
}
