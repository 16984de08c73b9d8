//! Depth as a stereo camera reports it.
//!
//! Depth comes from disparity, `z = f b / d`, in steps of 1/32 px, so that noise and steps grow with z². Depth
//! is missing where the second imager does not see the spot, left of where the images overlap, where
//! nothing can be matched, and beyond the search range. The matching window makes near things wider.

use super::super::models::{DepthPrinciple, Model};
use super::super::noise::{Rolls, smooth2};
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
    /// Depth of one row.
    fn row(&self, y: usize, samples: &[Sample], ideal: &[f32], out: &mut [f32]) {
        let layer = (self.seed & 0xFFFF) as i32;
        for (x, z) in out.iter_mut().enumerate() {
            let fx = x as f32 / self.scale;
            let fy = y as f32 / self.scale;
            let blotch = smooth2(fx / 9.0, fy / 9.0, layer);
            // How far this window reaches wanders along an edge, as in real images.
            let window = (self.window * (0.35 + 1.1 * smooth2(fx / 7.0, fy / 7.0, layer + 1))) as usize;
            let found = self.nearest_in_window((x, y), ideal, window, blotch > 0.5);
            let disparity = ideal[found];
            let matched = &samples[found];
            let has_partner = disparity > 0.0 && disparity <= self.search_px && x as f32 >= disparity;
            if matched.is_hidden || !has_partner {
                continue;
            }
            let rolls = Rolls::new(self.seed, x as u32, y as u32, 7);
            let here = &samples[y * self.w + x];
            if self.quality(here, matched.texture, disparity) < 0.16 + 0.34 * blotch + 0.05 * rolls.normal(0)
            {
                continue;
            }
            // Part of the error is shared by neighbours that share most of a window.
            let shared = smooth2(fx / 5.0, fy / 5.0, layer + 2) - 0.5;
            let sigma = self.sigma_px * (1.5 - 0.5 * matched.texture.min(1.0));
            let noisy = disparity + sigma * (0.55 * rolls.normal(1) + 3.2 * shared);
            *z = self.focal_baseline / ((noisy * SUBPIXEL).round().max(1.0) / SUBPIXEL);
        }
    }

    /// The pixel of the window around `(x, y)` whose match wins: that of the nearest thing, when it is nearer
    /// by more than an edge's step. This is what makes near things wider than they are.
    fn nearest_in_window(
        &self,
        (x, y): (usize, usize),
        ideal: &[f32],
        window: usize,
        is_tall: bool,
    ) -> usize {
        let w = self.w;
        let h = ideal.len() / self.w;
        let mut best = y * w + x;
        let mut consider = |at: usize| {
            if ideal[at] > ideal[best] + EDGE_PX {
                best = at;
            }
        };
        for at in y * w + x.saturating_sub(window)..=y * w + (x + window).min(w - 1) {
            consider(at);
        }
        if is_tall {
            let half = window.div_ceil(2);
            consider(y.saturating_sub(half) * w + x);
            consider((y + half).min(h - 1) * w + x);
        }
        best
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
