//! Active stereo by physics: two infrared images of a world with projected dots, matched by our own semi-global matching.
//!
//! A projector between the imagers throws dots; their light falls off with the square of the distance and does not come
//! back from glass, mirrors and polished metal, and little from dark things. Both imagers see the dots, what else is
//! infrared in the room, and noise. The matcher checks left against right; disparity is kept in steps of 1/32 px.

use super::super::depth::{self, SUBPIXEL};
use super::super::models::{DepthPrinciple, Model};
use super::super::noise::{Rolls, lattice, smooth3};
use super::super::scene::{Met, Spot, World};
use super::super::texture::Surface;
use super::super::view::{Ball, NOTHING, TILE, View, between};
use depthrig_calib::stereo::{DisparityMap, Gray, Matcher, Parameters, Preset, SgmMatcher, StereoPair};
use depthrig_driver::{Error, ErrorKind, Result};
use glam::Vec3;
use rayon::prelude::*;

/// Distance of neighbouring dots as an angle: about 7 pixels of a D435's depth at 640x480.
const DOT_RAD: f32 = 0.016;
/// Light of a dot on white at 1 m, and of the room, in grey levels.
const DOT_LIGHT: f32 = 420.0;
const ROOM_LIGHT: f32 = 28.0;
/// Shot noise and read noise of the imagers, grey levels.
const SHOT: f32 = 0.25;
const READ: f32 = 1.8;

/// Depth in counts of the model's unit, 0 for none.
pub(super) fn measure(world: &World, view: &View<'_>, model: &Model, seed: u64) -> Result<Vec<u16>> {
    let DepthPrinciple::Stereo { baseline_m, projector, search_px, .. } = model.depth else {
        return Ok(Vec::new());
    };
    let right_view = View { origin: view.origin + view.axes.x_axis * baseline_m, ..*view };
    let pattern = projector.then(|| Pattern {
        origin: view.origin + view.axes.x_axis * (baseline_m * 0.55),
        view: *view,
        field: (seed & 0xFFFF) as i32,
    });
    let left = image(world, view, pattern.as_ref(), seed ^ 1);
    let right = image(world, &right_view, pattern.as_ref(), seed ^ 2);
    let disparity = matched(view, &left, &right, search_px)?;
    let focal_baseline = baseline_m / view.rays.pixel_rad;
    let (near, far) = model.range_m;
    Ok(disparity
        .iter()
        .map(|d| {
            let steps = (d * SUBPIXEL).round();
            let z = focal_baseline * SUBPIXEL / steps;
            if steps >= 1.0 && (near..=far).contains(&z) { depth::counts(z, model.depth_unit_m) } else { 0 }
        })
        .collect())
}

fn matched(view: &View<'_>, left: &[u8], right: &[u8], search_px: f32) -> Result<Vec<f32>> {
    let (w, h) = (view.rays.width, view.rays.height);
    let wrong = |e: depthrig_calib::Error| Error::new(ErrorKind::BadInput, e.to_string()).with_source(e);
    let most = (search_px as usize + 2).next_multiple_of(32).min(w).clamp(32, 256);
    let mut parameters = Parameters::preset(Preset::Quality, most);
    // A depth camera of this kind leaves holes where it does not know.
    parameters.gap_px = 0;
    parameters.rematch = false;
    parameters.median_rounds = 1;
    parameters.left_right_px = 1;
    let mut matcher = SgmMatcher::new(w, h, &parameters, 1).map_err(wrong)?;
    let mut map = DisparityMap::default();
    let pair = StereoPair::new(Gray::packed(left, w, h), Gray::packed(right, w, h));
    matcher.run(&pair, &mut map).map_err(wrong)?;
    Ok(map.disparity)
}

/// The projector.
struct Pattern<'a> {
    origin: Vec3,
    view: View<'a>,
    field: i32,
}

impl Pattern<'_> {
    /// Light of the dots at a point, 0..1 at 1 m.
    fn at(&self, p: Vec3) -> f32 {
        let q = self.view.axes.transpose() * (p - self.origin);
        if q.z <= 0.01 {
            return 0.0;
        }
        let u = q.x / q.z / DOT_RAD;
        let v = q.y / q.z / DOT_RAD;
        let (i, j) = (u.floor(), v.floor());
        let mut light = 0.0;
        // A dot lies anywhere in its cell, so it can reach into the next ones.
        for dj in -1..=1 {
            for di in -1..=1 {
                let (x, y) = (i as i32 + di, j as i32 + dj);
                if lattice(x, y, self.field) > 0.8 {
                    continue;
                }
                let off_x = u - (x as f32 + lattice(x, y, self.field + 1));
                let off_y = v - (y as f32 + lattice(x, y, self.field + 2));
                let squared = off_x * off_x + off_y * off_y;
                if squared < 0.3 {
                    light += (-squared * 22.0).exp() * (0.6 + 0.4 * lattice(x, y, self.field + 3));
                }
            }
        }
        light.min(1.3) / q.length_squared().max(0.04)
    }
}

/// One imager's image.
fn image(world: &World, view: &View<'_>, pattern: Option<&Pattern<'_>>, seed: u64) -> Vec<u8> {
    let mets = view.cast(world);
    let w = view.rays.width;
    let all = world.all();
    let mut out = vec![0.0f32; mets.len()];
    out.par_chunks_mut(w * TILE).enumerate().for_each(|(band, out)| {
        for tile in view.tiles(band * TILE) {
            let Some(extent) = view.extent(&mets, &tile) else { continue };
            let hiding = pattern.map(|p| between(world, extent, Ball { center: p.origin, radius: 0.0 }));
            let shader = Shader {
                world,
                pattern,
                hiding: hiding.unwrap_or_default(),
                all: &all,
                blur: view.rays.pixel_rad,
            };
            for y in tile.ys.clone() {
                for x in tile.xs.clone() {
                    let met = mets[y * w + x];
                    if met != NOTHING {
                        out[(y - band * TILE) * w + x] = shader.light(view.origin, view.dir(x, y), met, 2);
                    }
                }
            }
        }
    });
    expose(&out, w, seed)
}

/// Light to grey levels: an exposure for the image as a whole, and noise.
fn expose(light: &[f32], w: usize, seed: u64) -> Vec<u8> {
    let sum: f64 = light.iter().map(|v| f64::from(v.min(400.0))).sum();
    let mean = (sum / light.len().max(1) as f64) as f32;
    let gain = (95.0 / mean.max(1.0)).clamp(0.3, 6.0);
    let at = |(i, v): (usize, &f32)| {
        let rolls = Rolls::new(seed, (i % w) as u32, (i / w) as u32, 11);
        let level = v * gain;
        let sigma = (SHOT * SHOT * gain * level.max(0.0) + READ * READ * gain).sqrt();
        (level + sigma * rolls.normal(0)).round().clamp(0.0, 255.0) as u8
    };
    light.iter().enumerate().map(at).collect()
}

struct Shader<'a> {
    world: &'a World,
    pattern: Option<&'a Pattern<'a>>,
    /// Solids that can stand between the projector and this tile.
    hiding: Vec<u16>,
    all: &'a [u16],
    blur: f32,
}

impl Shader<'_> {
    /// Infrared light along a ray that met something.
    fn light(&self, from: Vec3, dir: Vec3, met: Met, bounces: u32) -> f32 {
        let spot = self.world.spot(from, dir, met);
        let forward = dir.normalize();
        let surface = spot.paint.surface();
        let onward = match surface {
            Surface::Glass => Some((dir, 0.88)),
            Surface::Mirror => Some((dir.reflect(spot.n), 0.9)),
            Surface::Shiny => Some((dir.reflect(spot.n), 0.55)),
            _ => None,
        };
        let seen = match onward {
            Some((way, part)) if bounces > 0 => {
                let start = spot.p + way * 5e-4;
                part * self.light(start, way, self.world.meet(self.all, start, way), bounces - 1)
            }
            Some(_) => 20.0,
            None => 0.0,
        };
        if matches!(surface, Surface::Glass | Surface::Mirror) {
            return seen;
        }
        let scatter = if surface == Surface::Shiny { 0.25 } else { 1.0 };
        seen + scatter * self.own(&spot, forward, bounces, met.t)
    }

    /// Light that a spot scatters.
    fn own(&self, spot: &Spot, forward: Vec3, bounces: u32, t: f32) -> f32 {
        let infrared = spot.paint.infrared();
        // Grey of the paint around its infrared mean.
        let color = spot.paint.color(spot.local, spot.normal_local, t * self.blur);
        let luma = color.dot(Vec3::new(0.3, 0.59, 0.11));
        // No surface is even: fibres, scratches, dust.
        let uneven = smooth3(spot.local * 90.0, 5) + smooth3(spot.local * 400.0, 6) - 1.0;
        let rough = 1.0 + (0.10 + 0.45 * infrared.texture) * uneven;
        let albedo = infrared.albedo * (0.55 + 0.9 * luma).min(1.2) * rough;
        let lamp = self.world.lamps.iter().map(|lamp| {
            let to = lamp.center - spot.p;
            lamp.power * spot.n.dot(to.normalize()).max(0.0) / to.length_squared()
        });
        let room = ROOM_LIGHT * (0.45 + 0.4 * lamp.sum::<f32>().min(2.5));
        let mut dots = 0.0;
        if let Some(pattern) = self.pattern {
            let to = pattern.origin - spot.p;
            let facing = spot.n.dot(to.normalize());
            let light = if facing > 0.0 { pattern.at(spot.p) } else { 0.0 };
            // Second rays leave the tile that `hiding` is for.
            let hiding = if bounces == 2 { self.hiding.as_slice() } else { self.all };
            if light > 0.01 && !self.world.is_blocked(hiding, spot, pattern.origin) {
                dots = DOT_LIGHT * light * facing;
                if spot.paint.surface() == Surface::Glossy {
                    let half = (to.normalize() - forward).normalize_or(spot.n);
                    dots *= 0.8 + 3.0 * spot.n.dot(half).max(0.0).powf(60.0);
                }
            }
        }
        albedo * (room + dots)
    }
}
