//! The colour image: lamps with soft shadows, light from all around, mirrors, glass, and the noise of a
//! real sensor.

use super::noise::{Rolls, normal_of};
use super::scene::{Lamp, Met, Spot, World};
use super::texture::{Paint, Surface};
use super::view::{Ball, NOTHING, TILE, Tile, View, between};
use glam::Vec3;
use rayon::prelude::*;

/// How often light is followed through mirrors and glass.
const BOUNCES: u32 = 3;
/// Standard deviation of the sensor's noise in steps of 256 in the mid-tones.
const NOISE: f32 = 1.3;
/// Bayer's 4x4 matrix.
const DITHER: [usize; 16] = [0, 8, 2, 10, 12, 4, 14, 6, 3, 11, 1, 9, 15, 7, 13, 5];

/// Renders an RGB8 image.
pub(crate) fn render(world: &World, view: &View<'_>, white: [f32; 3], seed: u64) -> Vec<u8> {
    render_met(world, view, &view.cast(world), white, seed)
}

/// The same where the rays have been cast.
pub(crate) fn render_met(
    world: &World,
    view: &View<'_>,
    mets: &[Met],
    white: [f32; 3],
    seed: u64,
) -> Vec<u8> {
    let w = view.rays.width;
    let h = view.rays.height;
    let mut image = vec![0; w * h * 3];
    let tone = Tone::new(white, world.exposure);
    let places: Vec<_> = world.lamps.iter().map(|lamp| places_on_lamp(lamp.radius)).collect();
    image.par_chunks_mut(w * TILE * 3).enumerate().for_each(|(band, out)| {
        for tile in view.tiles(band * TILE) {
            let Some(shader) = Shader::new(world, view, mets, &tile, &places) else { continue };
            for y in tile.ys.clone() {
                for x in tile.xs.clone() {
                    let met = mets[y * w + x];
                    if met != NOTHING {
                        let light = shader.pixel(mets, x, y, met);
                        let at = ((y - band * TILE) * w + x) * 3;
                        let rolls = Rolls::new(seed, x as u32, y as u32, 0).bits(0);
                        out[at..at + 3].copy_from_slice(&tone.develop(light, rolls));
                    }
                }
            }
        }
    });
    image
}

/// Four places on the lamp's disc, spread evenly, for each of 16 phases: in metres from its middle.
fn places_on_lamp(lamp_radius: f32) -> [[f32; 2]; 64] {
    core::array::from_fn(|n| {
        let i = (n / 16) as f32;
        let phase = (n % 16) as f32;
        let (sin, cos) = ((i * 0.618 + phase / 16.0) * core::f32::consts::TAU).sin_cos();
        let radius = lamp_radius * ((i + 0.2 + phase / 20.0) / 4.0).sqrt();
        [radius * cos, radius * sin]
    })
}

struct Shader<'a> {
    world: &'a World,
    view: &'a View<'a>,
    /// The solids that this tile's rays can meet, that can shade it, and that are near it.
    seen: Vec<u16>,
    shading: Vec<Vec<u16>>,
    near: Vec<u16>,
    all: Vec<u16>,
    /// `all` for each lamp.
    all_shading: Vec<Vec<u16>>,
    extent: Ball,
    places: &'a [[[f32; 2]; 64]],
}

/// Whose shadows and contacts matter at a spot.
#[derive(Clone, Copy)]
struct Around<'a> {
    /// For each lamp.
    shading: &'a [Vec<u16>],
    near: &'a [u16],
}

impl<'a> Shader<'a> {
    fn new(
        world: &'a World,
        view: &'a View<'a>,
        mets: &[Met],
        tile: &Tile,
        places: &'a [[[f32; 2]; 64]],
    ) -> Option<Self> {
        let extent = view.extent(mets, tile)?;
        let reach = Ball { center: extent.center, radius: extent.radius + 0.17 };
        Some(Self {
            world,
            view,
            seen: view.in_sight(world, tile),
            shading: world.lamps.iter().map(|lamp| between(world, extent, Ball::of(lamp))).collect(),
            near: between(world, reach, reach),
            all: world.all(),
            all_shading: vec![world.all(); world.lamps.len()],
            extent,
            places,
        })
    }

    /// The light that a pixel gets; with four rays where the image has an edge.
    fn pixel(&self, mets: &[Met], x: usize, y: usize, met: Met) -> Vec3 {
        let origin = self.view.origin;
        let dir = self.view.dir(x, y);
        let spot = self.world.spot(origin, dir, met);
        let w = self.view.rays.width;
        let h = self.view.rays.height;
        let key = |x: usize, y: usize| mets[y * w + x].key;
        let is_edge = (x > 0 && key(x - 1, y) != met.key)
            || (x + 1 < w && key(x + 1, y) != met.key)
            || (y > 0 && key(x, y - 1) != met.key)
            || (y + 1 < h && key(x, y + 1) != met.key);
        let around = Around { shading: &self.shading, near: &self.near };
        // The order of a 4x4 ordered dither: neighbours differ as much as can be.
        let phase = DITHER[(y & 3) * 4 + (x & 3)];
        if !(is_edge || spot.paint.is_sharp()) || w < 2 || h < 2 {
            return self.light(&spot, dir, met.t, around, phase, BOUNCES);
        }
        let mut sum = Vec3::ZERO;
        for (i, (dx, dy)) in
            [(-0.125, -0.375), (0.375, -0.125), (-0.375, 0.125), (0.125, 0.375)].into_iter().enumerate()
        {
            let dir = self.view.dir_between(x, y, dx, dy);
            let met = self.world.meet(&self.seen, origin, dir);
            let spot = self.world.spot(origin, dir, met);
            // The spots between pixels of an edge may lie outside what the tile's lists were made for.
            let is_outside = (spot.p - self.extent.center).length() > self.extent.radius;
            let around =
                if is_outside { Around { shading: &self.all_shading, near: &self.all } } else { around };
            // Bright spots are cut before the mean, or the edge of a highlight would stay jagged.
            sum += self.light(&spot, dir, met.t, around, (phase + i * 4) % 16, BOUNCES).min(Vec3::splat(1.5));
        }
        sum * 0.25
    }

    /// The light that leaves `spot` against `dir`.
    fn light(&self, spot: &Spot, dir: Vec3, t: f32, around: Around<'_>, phase: usize, bounces: u32) -> Vec3 {
        let forward = dir.normalize();
        let facing = spot.n.dot(forward).abs().min(1.0);
        let fresnel = (1.0 - facing).powi(5);
        match spot.paint.surface() {
            Surface::Mirror => {
                self.follow(spot, forward.reflect(spot.n), bounces) * Vec3::new(0.86, 0.88, 0.87)
            }
            // Out of the pane again: what is reflected inside is left out.
            Surface::Glass if spot.n.dot(forward) > 0.0 => self.follow(spot, forward, bounces),
            Surface::Glass if matches!(spot.paint, Paint::Made(_)) => {
                let part = 0.05 + 0.95 * fresnel;
                // Curved glass shows its outline: there the way through it is long.
                let clear = 0.25 + 0.75 * (facing * 2.2).min(1.0);
                let tint = spot.paint.color(spot.local, spot.normal_local, 0.0) * clear;
                let behind = self.follow(spot, forward, bounces + 1) * tint;
                behind * (1.0 - part) + self.follow(spot, forward.reflect(spot.n), bounces) * part
            }
            Surface::Glass => {
                let part = 0.05 + 0.95 * fresnel;
                let behind = self.follow(spot, forward, bounces + 1) * Vec3::new(0.90, 0.965, 0.94);
                let rim = spot.normal_local.y.abs() < 0.5;
                let behind = if rim { behind * 0.35 + Vec3::new(0.10, 0.26, 0.20) } else { behind };
                behind * (1.0 - part) + self.follow(spot, forward.reflect(spot.n), bounces) * part
            }
            surface => {
                let color = spot.paint.color(spot.local, spot.normal_local, t * self.view.rays.pixel_rad);
                let open = self.world.openness(around.near, spot);
                let power = if surface == Surface::Shiny { 180.0 } else { 70.0 };
                let has_shine = matches!(surface, Surface::Shiny | Surface::Glossy);
                let mut key = Vec3::ZERO;
                let mut shine = 0.0;
                for (number, lamp) in self.world.lamps.iter().enumerate() {
                    let to_lamp = lamp.center - spot.p;
                    let toward = spot.n.dot(to_lamp.normalize()).max(0.0);
                    let is_simple = bounces == 0 || number > 1 || (self.world.is_quick && bounces < BOUNCES);
                    let rays = if is_simple { 1 } else { 4 };
                    let lit = self.lit(spot, lamp, number, around.shading, phase, rays);
                    let fall = lamp.power / to_lamp.length_squared();
                    key += lamp.color * (lit * fall * toward);
                    if has_shine {
                        let half = (to_lamp.normalize() - forward).normalize_or(spot.n);
                        shine += spot.n.dot(half).max(0.0).powf(power) * lit * fall;
                    }
                }
                // From above the sky through a window, from below what the floor sends back.
                let up = spot.n.z * 0.5 + 0.5;
                let fill = self.world.around[0].lerp(self.world.around[1], up) * open;
                let body = color * (key + fill);
                match surface {
                    Surface::Shiny => {
                        let mirror = self.follow(spot, forward.reflect(spot.n), bounces);
                        body * 0.35 + mirror * color * (0.8 + 0.2 * fresnel) + Vec3::splat(shine * 1.2)
                    }
                    Surface::Glossy => {
                        let part = 0.035 + 0.5 * fresnel;
                        let mirror = if part > 0.06 {
                            self.follow(spot, forward.reflect(spot.n), bounces)
                        } else {
                            fill
                        };
                        body * (1.0 - part) + mirror * part + Vec3::splat(shine * 0.22)
                    }
                    _ => body,
                }
            }
        }
    }

    /// Light along a ray that leaves a spot.
    fn follow(&self, spot: &Spot, dir: Vec3, bounces: u32) -> Vec3 {
        if bounces == 0 {
            return Vec3::new(0.3, 0.3, 0.3);
        }
        let from = spot.p + dir * 2e-4;
        let met = self.world.meet(&self.all, from, dir);
        let next = self.world.spot(from, dir, met);
        let around = Around { shading: &self.all_shading, near: &self.all };
        self.light(&next, dir, met.t, around, 0, bounces - 1)
    }

    /// The part of a lamp that a spot sees, 0..1.
    fn lit(
        &self,
        spot: &Spot,
        lamp: &Lamp,
        number: usize,
        shading: &[Vec<u16>],
        phase: usize,
        rays: u16,
    ) -> f32 {
        let to_lamp = lamp.center - spot.p;
        let shading = &shading[number];
        if spot.n.dot(to_lamp) <= 0.0 {
            return 0.0;
        }
        if shading.iter().all(|i| *i == spot.thing && !self.world.things[usize::from(*i)].solid.is_hollow()) {
            return 1.0;
        }
        // Neighbouring pixels try other places on the lamp, which blurs the steps of the shadow's rim.
        let (u, v) = to_lamp.normalize().any_orthonormal_pair();
        let mut seen = 0u32;
        for i in 0..rays {
            let [across, up] = self.places[number][(i as usize * 16 + phase) % 64];
            if i == 2 && self.world.is_quick && seen != 1 {
                return seen as f32 / 2.0;
            }
            seen += u32::from(!self.world.is_blocked(shading, spot, lamp.center + u * across + v * up));
        }
        seen as f32 / rays as f32
    }
}

/// From light to bytes.
struct Tone {
    /// Factors of red, green, blue.
    white: Vec3,
    exposure: f32,
    /// sRGB's curve with a shoulder for what is too bright, over 0..4 in 4096 steps.
    curve: Vec<f32>,
}

impl Tone {
    fn new(white: [f32; 3], exposure: f32) -> Self {
        let curve = (0..4096).map(|i| {
            let x = i as f32 / 1023.75;
            // The filmic curve fitted by Narkowicz (2015), then sRGB (IEC 61966-2-1).
            let film = (x * (2.51 * x + 0.03)) / (x * (2.43 * x + 0.59) + 0.14);
            let srgb = if film <= 0.003_130_8 { 12.92 * film } else { 1.055 * film.powf(1.0 / 2.4) - 0.055 };
            srgb.clamp(0.0, 1.0) * 255.0
        });
        Self { white: white.into(), exposure, curve: curve.collect() }
    }

    fn develop(&self, light: Vec3, rolls: u64) -> [u8; 3] {
        let light = light * self.white * self.exposure;
        core::array::from_fn(|c| {
            let at = (light[c] * 1023.75).clamp(0.0, 4095.0) as usize;
            // One draw serves three channels: bits are taken at other places, and that is not visible.
            let noise = normal_of(rolls.rotate_left(c as u32 * 21).wrapping_mul(0x9E37_79B9_7F4A_7C15));
            (self.curve[at] + noise * NOISE + 0.5).clamp(0.0, 255.0) as u8
        })
    }
}

#[cfg(test)]
mod tests {
    use super::super::models;
    use super::super::motion;
    use super::super::noise::text_seed;
    use super::super::view::Rays;
    use super::*;
    use depthrig_bus::Intrinsics;

    /// Caches, recordings and documents show this world: a change of the caster must not change it.
    #[test]
    fn the_fixed_world_keeps_its_images() {
        let rays = Rays::new(&Intrinsics::pinhole(130.0, 130.0, 119.0, 80.0), 240, 160);
        let world = World::fixed(Vec::new());
        let view = View::new(&rays, &motion::mount(4, 12));
        let sum =
            |bytes: &[u8]| bytes.iter().fold(1u64, |h, b| (h ^ u64::from(*b)).wrapping_mul(0x0100_0000_01B3));
        let color = render(&world, &view, [0.98, 1.0, 0.98], text_seed(3, "d435"));
        let mut sums = vec![sum(&color)];
        for name in ["d435", "l515"] {
            let pair = super::super::depth::render(&world, &view, models::find(name).unwrap(), 5);
            for plane in [pair.sensed, pair.truth] {
                sums.push(sum(&plane.iter().flat_map(|z| z.to_le_bytes()).collect::<Vec<_>>()));
            }
        }
        let known = [
            6_141_041_364_541_434_045,
            15_715_093_159_497_008_735,
            12_484_886_604_661_181_018,
            4_443_944_187_793_672_099,
            16_911_552_773_165_426_096,
        ];
        assert_eq!(sums, known);
    }
}
