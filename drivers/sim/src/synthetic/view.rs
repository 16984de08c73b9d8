//! A camera in the world, and where the ray of every pixel ends.
//!
//! Images are worked on in square tiles. For each tile the few solids that can matter (that its rays can
//! meet; that can stand between it and the lamp) are found first by their bounding spheres; this is what makes
//! ray casting affordable without a tree.

use super::scene::{Lamp, Met, World};
use depthrig_bus::Intrinsics;
use depthrig_calib::Camera;
use glam::{DAffine3, DVec2, Mat3, Vec3};
use rayon::prelude::*;

/// Pixels per side of a tile.
pub(crate) const TILE: usize = 16;
/// The `key` of a pixel whose ray the lens cannot form.
pub(crate) const NOTHING: Met = Met { t: 0.0, key: u16::MAX };

/// The rays of a camera: the directions in its own frame never change, so they are made once per stream.
#[derive(Debug)]
pub(crate) struct Rays {
    pub(crate) width: usize,
    pub(crate) height: usize,
    /// Per pixel, scaled to z = 1 in the optical frame; zero where the lens forms no ray.
    dirs: Vec<Vec3>,
    /// How far apart the rays of two neighbouring pixels are at 1 m.
    pub(crate) pixel_rad: f32,
}

impl Rays {
    pub(crate) fn new(k: &Intrinsics, width: u32, height: u32) -> Self {
        let width = width as usize;
        let height = height as usize;
        let camera = Camera::new(k).ok();
        let mut dirs = vec![Vec3::ZERO; width * height];
        dirs.par_chunks_mut(width).enumerate().for_each(|(y, row)| {
            for (x, dir) in row.iter_mut().enumerate() {
                let ray = camera.and_then(|c| c.unproject(DVec2::new(x as f64, y as f64)));
                *dir = ray.map_or(Vec3::ZERO, glam::DVec3::as_vec3);
            }
        });
        Self { width, height, dirs, pixel_rad: (1.0 / k.fx) as f32 }
    }

    pub(crate) fn dir(&self, x: usize, y: usize) -> Vec3 {
        self.dirs[y * self.width + x]
    }
}

/// A camera at one place in the world.
#[derive(Debug, Clone, Copy)]
pub(crate) struct View<'a> {
    pub(crate) rays: &'a Rays,
    pub(crate) origin: Vec3,
    pub(crate) axes: Mat3,
}

/// A tile's pixels: columns and rows.
#[derive(Debug, Clone)]
pub(crate) struct Tile {
    pub(crate) xs: core::ops::Range<usize>,
    pub(crate) ys: core::ops::Range<usize>,
}

/// A sphere.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Ball {
    pub(crate) center: Vec3,
    pub(crate) radius: f32,
}

impl Ball {
    /// The ball that a lamp is.
    pub(crate) const fn of(lamp: &Lamp) -> Self {
        Self { center: lamp.center, radius: lamp.radius }
    }
}

impl<'a> View<'a> {
    pub(crate) fn new(rays: &'a Rays, camera_in_world: &DAffine3) -> Self {
        Self { rays, origin: camera_in_world.translation.as_vec3(), axes: camera_in_world.matrix3.as_mat3() }
    }

    /// The ray of a pixel in the world; its length per unit of depth is not 1 but what z = 1 needs.
    pub(crate) fn dir(&self, x: usize, y: usize) -> Vec3 {
        self.axes * self.rays.dir(x, y)
    }

    /// The ray of a place between pixels, `dx` and `dy` of a pixel off; good enough for smoothing edges.
    pub(crate) fn dir_between(&self, x: usize, y: usize, dx: f32, dy: f32) -> Vec3 {
        let here = self.rays.dir(x, y);
        let w = self.rays.width;
        let h = self.rays.height;
        let next_x = if x + 1 < w { self.rays.dir(x + 1, y) - here } else { here - self.rays.dir(x - 1, y) };
        let next_y = if y + 1 < h { self.rays.dir(x, y + 1) - here } else { here - self.rays.dir(x, y - 1) };
        self.axes * (here + next_x * dx + next_y * dy)
    }

    /// The tiles of a band of [`TILE`] rows that begins at row `top`.
    pub(crate) fn tiles(&self, top: usize) -> impl Iterator<Item = Tile> + use<> {
        let w = self.rays.width;
        let bottom = (top + TILE).min(self.rays.height);
        (0..w).step_by(TILE).map(move |left| Tile { xs: left..(left + TILE).min(w), ys: top..bottom })
    }

    /// Where the ray of every pixel ends, row by row; `t` is the depth (z in the optical frame).
    pub(crate) fn cast(&self, world: &World) -> Vec<Met> {
        let w = self.rays.width;
        let h = self.rays.height;
        let mut mets = vec![NOTHING; w * h];
        mets.par_chunks_mut(w * TILE).enumerate().for_each(|(band, out)| {
            for tile in self.tiles(band * TILE) {
                let among = self.in_sight(world, &tile);
                for y in tile.ys.clone() {
                    for x in tile.xs.clone() {
                        if self.rays.dir(x, y).z > 0.0 {
                            let dir = self.dir(x, y);
                            let met = world.meet(&among, self.origin, dir);
                            out[(y - band * TILE) * w + x] = world.with_face(self.origin, dir, met);
                        }
                    }
                }
            }
        });
        mets
    }

    /// The solids that rays of this tile can meet.
    pub(crate) fn in_sight(&self, world: &World, tile: &Tile) -> Vec<u16> {
        let mut axis = Vec3::ZERO;
        let mut dirs = Vec::with_capacity(4 * TILE);
        for y in tile.ys.clone() {
            for x in tile.xs.clone() {
                let is_rim =
                    x == tile.xs.start || x + 1 == tile.xs.end || y == tile.ys.start || y + 1 == tile.ys.end;
                let dir = self.dir(x, y);
                if is_rim && dir != Vec3::ZERO {
                    let dir = dir.normalize();
                    axis += dir;
                    dirs.push(dir);
                }
            }
        }
        let axis = axis.normalize_or(Vec3::Z);
        // A pixel of margin on every side, for rays between pixels.
        let spread =
            dirs.iter().map(|d| axis.dot(*d).min(1.0).acos()).fold(0.0, f32::max) + 2.0 * self.rays.pixel_rad;
        let sees = |i: &u16| {
            let solid = &world.things[usize::from(*i)].solid;
            let to = solid.center - self.origin;
            let far = to.length();
            far <= solid.bound
                || (axis.dot(to) / far).clamp(-1.0, 1.0).acos() <= spread + (solid.bound / far).asin()
        };
        (0..world.things.len() as u16).filter(sees).collect()
    }

    /// A sphere that holds every spot that a tile shows.
    pub(crate) fn extent(&self, mets: &[Met], tile: &Tile) -> Option<Ball> {
        let mut low = Vec3::INFINITY;
        let mut high = Vec3::NEG_INFINITY;
        for y in tile.ys.clone() {
            for x in tile.xs.clone() {
                let met = mets[y * self.rays.width + x];
                if met != NOTHING {
                    let p = self.origin + self.dir(x, y) * met.t;
                    (low, high) = (low.min(p), high.max(p));
                }
            }
        }
        (low.x <= high.x)
            .then(|| Ball { center: (low + high) / 2.0, radius: (high - low).length() / 2.0 + 1e-3 })
    }
}

/// The solids that can touch the space between two spheres: the cone that holds both.
pub(crate) fn between(world: &World, a: Ball, b: Ball) -> Vec<u16> {
    let way = b.center - a.center;
    let length = way.length().max(1e-6);
    let touches = |i: &u16| {
        let solid = &world.things[usize::from(*i)].solid;
        let along = (solid.center - a.center).dot(way) / (length * length);
        let off = (solid.center - (a.center + way * along.clamp(0.0, 1.0))).length();
        // How wide the cone is where the solid's bounding sphere can touch it at the widest.
        let reach = (solid.bound + a.radius.max(b.radius)) / length;
        let widest = if b.radius > a.radius { along + reach } else { along - reach };
        off < solid.bound + a.radius + (b.radius - a.radius) * widest.clamp(0.0, 1.0)
    };
    (0..world.things.len() as u16).filter(touches).collect()
}

#[cfg(test)]
mod tests {
    use super::super::motion;
    use super::*;

    /// Casting with tiles finds exactly what casting against everything finds.
    #[test]
    fn tiles_miss_nothing() {
        let world = World::fixed(Vec::new());
        let rays = Rays::new(&Intrinsics::pinhole(110.0, 110.0, 99.5, 60.0), 200, 121);
        for pose in [0, 7] {
            let view = View::new(&rays, &motion::mount(pose, 12));
            let mets = view.cast(&world);
            let all = world.all();
            for y in 0..121 {
                for x in 0..200 {
                    let dir = view.dir(x, y);
                    let met = world.with_face(view.origin, dir, world.meet(&all, view.origin, dir));
                    assert_eq!(met, mets[y * 200 + x], "{x} {y}");
                }
            }
        }
    }

    #[test]
    fn nothing_between_two_balls_is_left_out() {
        let world = World::fixed(Vec::new());
        let all = world.all();
        let lamp = Ball::of(&world.lamps[0]);
        let mut met = 0;
        for i in 0..4000u32 {
            let r = super::super::noise::Rolls::new(5, i, 0, 0);
            let center = Vec3::new(r.unit(0) - 0.5, r.unit(1) * 0.8 - 0.3, r.unit(2) * 0.03);
            let list = between(&world, Ball { center, radius: 0.01 }, lamp);
            let to = lamp.center + Vec3::new(r.unit(3) - 0.5, 0.0, 0.0) * lamp.radius;
            let spot = world.spot(center, Vec3::NEG_Z, world.meet(&all, center, Vec3::NEG_Z));
            let list = if (spot.p - center).length() < 0.01 { list } else { continue };
            met += 1;
            assert_eq!(world.is_blocked(&list, &spot, to), world.is_blocked(&all, &spot, to));
        }
        assert!(met > 500, "only {met} spots were tried");
    }
}
