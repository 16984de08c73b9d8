//! Depth as a time-of-flight camera reports it.
//!
//! Depth is missing where too little light comes back (dark, far or slanted surfaces), where a polished one
//! sends it elsewhere, and outside the circle that the light fills. At edges a pixel mixes near and far into a
//! depth at which nothing is ("flying pixels"). In corners, light that took a detour makes things seem farther.

use super::super::models::{DepthPrinciple, Model};
use super::super::noise::{Rolls, normal_of, smooth2};
use super::super::texture::Surface;
use super::super::view::View;
use super::Sample;
use rayon::prelude::*;

/// The least signal that gives a depth: albedo · cos / z² at 1 m.
const LEAST_SIGNAL: f32 = 0.016;
/// Neighbours this much apart, as a part of the depth, are an edge.
const EDGE: f32 = 0.03;

/// Depth in metres, 0 for none.
pub(super) fn measure(view: &View<'_>, model: &Model, samples: &[Sample], seed: u64) -> Vec<f32> {
    let DepthPrinciple::TimeOfFlight { sigma_m, multipath_m, half_angle_deg } = model.depth else {
        return Vec::new();
    };
    let w = view.rays.width;
    let h = view.rays.height;
    let circle = half_angle_deg.to_radians().tan();
    let mut out = vec![0.0; samples.len()];
    out.par_chunks_mut(w).enumerate().for_each(|(y, row)| {
        for (x, z) in row.iter_mut().enumerate() {
            let here = &samples[y * w + x];
            let ray = view.rays.dir(x, y);
            if here.z <= 0.0 || (half_angle_deg < 89.0 && ray.x.hypot(ray.y) > circle) {
                continue;
            }
            let rolls = Rolls::new(seed, x as u32, y as u32, 9);
            let signal = here.albedo * (0.15 + 0.85 * here.facing) / (here.z * here.z);
            let blotch = smooth2(x as f32 / 6.0, y as f32 / 6.0, (seed & 0xFFFF) as i32);
            if signal < LEAST_SIGNAL * (0.7 + 0.6 * blotch) || is_lost(here, blotch) {
                continue;
            }
            let mixed = mix_at_edge(samples, w, h, x, y, rolls.unit(1));
            let detour = multipath_m * (1.0 - here.open) * (1.0 + here.albedo) * 0.8;
            // Weak light is noisy light.
            let sigma = sigma_m * (0.35 + 0.65 * here.z) * (0.25 / signal.max(0.02)).sqrt().clamp(0.6, 4.0);
            *z = mixed + detour + sigma * normal_of(rolls.bits(0));
        }
    });
    out
}

/// Whether a polished surface sent the light elsewhere.
fn is_lost(here: &Sample, blotch: f32) -> bool {
    match here.surface {
        Surface::Shiny => here.facing < 0.96 && blotch > 0.12,
        Surface::Mirror => blotch > 0.78,
        Surface::Glass => blotch > 0.62,
        Surface::Glossy | Surface::Matte => false,
    }
}

/// The depth of a pixel whose neighbours lie elsewhere: anything between.
fn mix_at_edge(samples: &[Sample], w: usize, h: usize, x: usize, y: usize, part: f32) -> f32 {
    let here = samples[y * w + x].z;
    let neighbours = [
        (x > 0).then(|| y * w + x - 1),
        (x + 1 < w).then(|| y * w + x + 1),
        (y > 0).then(|| (y - 1) * w + x),
        (y + 1 < h).then(|| (y + 1) * w + x),
    ];
    let mut farthest = here;
    for z in neighbours.into_iter().flatten().map(|i| samples[i].z).filter(|z| *z > 0.0) {
        if (z - here).abs() > (farthest - here).abs() {
            farthest = z;
        }
    }
    if (farthest - here).abs() > EDGE * here { here + (farthest - here) * part * part } else { here }
}
