//! Depth as a time-of-flight camera reports it.
//!
//! Depth is missing where too little light comes back (dark, far or slanted surfaces), where too much does (near,
//! bright or polished ones that face the camera), where a polished one sends it elsewhere, and outside the circle
//! that the light fills. At edges a pixel mixes near and far into a
//! depth at which nothing is ("flying pixels"). In corners, light that took a detour makes things seem farther.

use super::super::models::{DepthPrinciple, Model};
use super::super::noise::{Rolls, normal_of, smooth2};
use super::super::texture::Surface;
use super::super::view::View;
use super::Sample;
use rayon::prelude::*;

/// The least signal that gives a depth: albedo · cos / z² at 1 m.
const LEAST_SIGNAL: f32 = 0.016;
/// The signal that fills a pixel, which gives no depth then: that of a white thing at 0.35 m.
const FULL_SIGNAL: f32 = 8.0;
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
            let signal = (here.albedo * (0.15 + 0.85 * here.facing) + highlight(here)) / (here.z * here.z);
            let blotch = smooth2(x as f32 / 6.0, y as f32 / 6.0, (seed & 0xFFFF) as i32);
            let is_enough = signal >= LEAST_SIGNAL * (0.7 + 0.6 * blotch);
            if !is_enough || signal > FULL_SIGNAL || is_lost(here, blotch) {
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

/// The highlight of the camera's own light, in the unit of an albedo.
///
/// Blinn and Phong's lobe with (power + 8) / 8 as its factor, so that it is energy that is shared out (Akenine-Möller
/// et al., Real-Time Rendering). The lamp is at the lens, so halfway between both is the ray.
fn highlight(here: &Sample) -> f32 {
    let (part, power) = match here.surface {
        Surface::Glossy => (0.035, 70),
        Surface::Shiny => (here.albedo, 180),
        Surface::Matte | Surface::Mirror | Surface::Glass => return 0.0,
    };
    part * (power as f32 + 8.0) / 8.0 * here.facing.powi(power)
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

#[cfg(test)]
mod tests {
    use super::super::super::models;
    use super::super::super::motion;
    use super::super::super::view::Rays;
    use super::super::NO_SAMPLE;
    use super::*;
    use depthrig_bus::Intrinsics;

    /// Pixels with depth, of 100 of one kind.
    fn measured(surface: Surface, albedo: f32, z: f32, facing: f32) -> usize {
        let rays = Rays::new(&Intrinsics::pinhole(100.0, 100.0, 5.0, 5.0), 10, 10);
        let view = View::new(&rays, &motion::mount(0, 12));
        let sample = Sample { z, albedo, facing, surface, ..NO_SAMPLE };
        let depth = measure(&view, models::find("l515").unwrap(), &[sample; 100], 1);
        depth.iter().filter(|z| **z > 0.0).count()
    }

    #[test]
    fn too_much_light_is_no_depth() {
        assert_eq!(measured(Surface::Matte, 0.9, 0.30, 1.0), 0, "white and near");
        assert_eq!(measured(Surface::Matte, 0.9, 0.40, 1.0), 100, "white, not so near");
        assert_eq!(measured(Surface::Matte, 0.4, 0.30, 1.0), 100, "grey and near");
        assert_eq!(measured(Surface::Glossy, 0.9, 0.37, 1.0), 0, "a highlight on white");
        assert_eq!(measured(Surface::Glossy, 0.9, 0.37, 0.9), 100, "beside it");
        assert_eq!(measured(Surface::Shiny, 0.5, 1.0, 1.0), 0, "metal that faces the camera");
        assert_eq!(measured(Surface::Shiny, 0.5, 1.0, 0.97), 100, "and a little turned");
        assert_eq!(measured(Surface::Shiny, 0.5, 1.5, 1.0), 100, "and far");
    }
}
