//! Depth images: the true one, and what a sensor would report.
//!
//! The truth is the depth (z of the optical frame) of the first surface, glass and mirrors included. The
//! sensor's image begins with what the light really did (through the glass, off the mirror) and then goes
//! the way of its principle: [`stereo`] or [`tof`].

use super::models::{DepthPrinciple, Model};
use super::scene::{Met, World};
use super::texture::Surface;
use super::view::{Ball, NOTHING, TILE, Tile, View, between};
use glam::Vec3;
use rayon::prelude::*;

mod stereo;
mod tof;

pub(crate) use stereo::SUBPIXEL;

/// Input of a sensor's pixel, before noise.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Sample {
    /// Depth at which the light seems to come from; 0 when none comes back.
    z: f32,
    /// Part of the light that comes back, 0..1.
    albedo: f32,
    /// How well it can be matched, 0..1.
    texture: f32,
    /// Cosine of the angle between ray and surface normal.
    facing: f32,
    /// How open the surroundings are, 0..1 (time of flight only).
    open: f32,
    /// The first surface's character.
    surface: Surface,
    /// The second imager does not see it (stereo only).
    is_hidden: bool,
}

const NO_SAMPLE: Sample = Sample {
    z: 0.0,
    albedo: 0.0,
    texture: 0.0,
    facing: 0.0,
    open: 1.0,
    surface: Surface::Matte,
    is_hidden: false,
};

/// A sensor's image and the truth, both in counts of the model's depth unit.
pub(crate) struct DepthPair {
    pub(crate) sensed: Vec<u16>,
    pub(crate) truth: Vec<u16>,
}

/// Renders both images.
pub(crate) fn render(world: &World, view: &View<'_>, model: &Model, seed: u64) -> DepthPair {
    let mets = view.cast(world);
    DepthPair { sensed: sense(world, view, &mets, model, seed), truth: truth(&mets, model) }
}

/// The sensor's image alone, where the rays have been cast.
pub(crate) fn sense(world: &World, view: &View<'_>, mets: &[Met], model: &Model, seed: u64) -> Vec<u16> {
    let samples = sample(world, view, mets, model.depth);
    let unit = model.depth_unit_m;
    let sensed_m = match model.depth {
        DepthPrinciple::Stereo { .. } => stereo::measure(view, model, &samples, seed),
        DepthPrinciple::TimeOfFlight { .. } => tof::measure(view, model, &samples, seed),
    };
    let (near, far) = model.range_m;
    let in_range = |z: &f32| if (near..=far).contains(z) { counts(*z, unit) } else { 0 };
    sensed_m.iter().map(in_range).collect()
}

/// The depth of the first surfaces, in counts of the model's depth unit.
pub(crate) fn truth(mets: &[Met], model: &Model) -> Vec<u16> {
    mets.iter().map(|m| if *m == NOTHING { 0 } else { counts(m.t, model.depth_unit_m) }).collect()
}

/// Metres to counts; what a count cannot hold is 0, "no depth".
pub(crate) fn counts(z_m: f32, unit_m: f64) -> u16 {
    let n = (f64::from(z_m) / unit_m).round();
    if n >= 1.0 && n <= f64::from(u16::MAX) { n as u16 } else { 0 }
}

/// Follows the light of every pixel.
fn sample(world: &World, view: &View<'_>, mets: &[Met], principle: DepthPrinciple) -> Vec<Sample> {
    let w = view.rays.width;
    let second_camera = match principle {
        DepthPrinciple::Stereo { baseline_m, .. } => Some(view.origin + view.axes.x_axis * baseline_m),
        DepthPrinciple::TimeOfFlight { .. } => None,
    };
    let all = world.all();
    let mut samples = vec![NO_SAMPLE; mets.len()];
    samples.par_chunks_mut(w * TILE).enumerate().for_each(|(band, out)| {
        for tile in view.tiles(band * TILE) {
            let Some(lists) = Lists::new(world, view, mets, &tile, second_camera) else { continue };
            for y in tile.ys.clone() {
                for x in tile.xs.clone() {
                    let met = mets[y * w + x];
                    if met != NOTHING {
                        let one = trace(world, view.origin, view.dir(x, y), met, &all);
                        out[(y - band * TILE) * w + x] = lists.finish(world, one);
                    }
                }
            }
        }
    });
    samples
}

/// The solids that matter to a tile.
struct Lists {
    second_camera: Option<Vec3>,
    hiding: Vec<u16>,
    near: Vec<u16>,
}

impl Lists {
    fn new(
        world: &World,
        view: &View<'_>,
        mets: &[Met],
        tile: &Tile,
        second_camera: Option<Vec3>,
    ) -> Option<Self> {
        let extent = view.extent(mets, tile)?;
        let hiding = second_camera
            .map(|origin| between(world, extent, Ball { center: origin, radius: 0.0 }))
            .unwrap_or_default();
        let reach = Ball { center: extent.center, radius: extent.radius + 0.17 };
        let near = if second_camera.is_none() { between(world, reach, reach) } else { Vec::new() };
        Some(Self { second_camera, hiding, near })
    }

    /// Adds what depends on the surroundings of the first surface.
    fn finish(&self, world: &World, (mut sample, spot): (Sample, super::scene::Spot)) -> Sample {
        match self.second_camera {
            Some(origin) => sample.is_hidden = world.is_blocked(&self.hiding, &spot, origin),
            None => sample.open = world.openness(&self.near, &spot),
        }
        sample
    }
}

/// Follows one ray until something sends its light back.
fn trace(world: &World, origin: Vec3, dir: Vec3, met: Met, all: &[u16]) -> (Sample, super::scene::Spot) {
    let spot = world.spot(origin, dir, met);
    let surface = spot.paint.surface();
    let facing = -spot.n.dot(dir.normalize());
    let own = spot.paint.infrared();
    let mut sample = Sample {
        z: met.t,
        albedo: own.albedo,
        texture: own.texture,
        facing: facing.clamp(0.0, 1.0),
        open: 1.0,
        surface,
        is_hidden: false,
    };
    // `dir` has depth 1 per unit, so the length of a detour counts as depth along the first ray.
    let onward = match surface {
        Surface::Mirror => Some(dir.reflect(spot.n)),
        Surface::Glass => Some(dir),
        _ => None,
    };
    if let Some(mut onward) = onward {
        let mut from = spot.p;
        let mut z = met.t;
        for _ in 0..4 {
            let next = world.meet(all, from + onward * 5e-4, onward);
            z += next.t + 5e-4;
            let there = world.spot(from + onward * 5e-4, onward, next);
            match there.paint.surface() {
                Surface::Mirror => onward = onward.reflect(there.n),
                Surface::Glass => {}
                _ => {
                    let infrared = there.paint.infrared();
                    sample.z = z;
                    sample.albedo = infrared.albedo * 0.75;
                    sample.texture = infrared.texture * 0.8;
                    sample.facing = (-there.n.dot(onward.normalize())).clamp(0.0, 1.0);
                    return (sample, spot);
                }
            }
            from = there.p;
        }
        sample.z = 0.0;
    }
    (sample, spot)
}

#[cfg(test)]
mod tests {
    use super::super::models;
    use super::super::motion;
    use super::super::view::Rays;
    use super::*;
    use depthrig_bus::Intrinsics;

    fn pair(model: &str, pose: u32) -> (Intrinsics, DepthPair) {
        let model = models::find(model).unwrap();
        let k = Intrinsics::pinhole(130.0, 130.0, 119.0, 80.0);
        let rays = Rays::new(&k, 240, 160);
        let world = World::fixed(Vec::new());
        (k, render(&world, &View::new(&rays, &motion::mount(pose, 12)), model, 5))
    }

    /// The truth is checked against distances to the solids, which the intersections do not use.
    #[test]
    fn every_true_depth_lies_on_a_surface() {
        let world = World::fixed(Vec::new());
        for (name, unit) in [("d405", 0.0001), ("l515", 0.00025)] {
            let (k, pair) = pair(name, 3);
            let camera = motion::mount(3, 12);
            for (i, counts) in pair.truth.iter().enumerate() {
                let x = (i % 240) as f64;
                let y = (i / 240) as f64;
                let ray = glam::DVec3::new((x - k.cx) / k.fx, (y - k.cy) / k.fy, 1.0);
                let p = camera.transform_point3(ray * f64::from(*counts) * unit).as_vec3();
                let off = world.distance(p).abs();
                // Half a count along the ray, and the rounding of single precision.
                let most = (0.5 * unit * ray.length()) as f32 + 3e-6;
                assert!(off <= most, "({x}, {y}): {off} m from every surface, {most} m allowed");
            }
        }
    }

    #[test]
    fn the_sensors_see_through_glass_and_into_the_mirror() {
        let (_, pair) = pair("l515", 6);
        let deeper = pair.sensed.iter().zip(&pair.truth).filter(|(s, t)| **s > **t + 200); // 5 cm
        assert!(deeper.count() > 200);
    }

    #[test]
    fn what_a_count_cannot_hold_is_no_depth() {
        assert_eq!(
            [0.0, 0.04, 6.5535, 6.6, f32::INFINITY, f32::NAN].map(|z| counts(z, 0.0001)),
            [0, 400, 65535, 0, 0, 0]
        );
        assert_eq!(counts(0.0004, 0.001), 0);
    }
}
