//! The world that a camera sees, and the fixed one that all simulated cameras share: a room with a table and the things that give depth cameras
//! trouble: thin, transparent, mirroring, dark, shiny and plain ones.

use super::shape::{Shape, Solid};
use super::texture::{Look, Paint, Surface};
use glam::{Mat3, Quat, Vec3};

/// Corners of the fixed world's room.
const ROOM: (Vec3, Vec3) = (Vec3::new(-1.7, -1.9, -0.74), Vec3::new(1.7, 1.05, 1.75));
/// The lamp of the fixed world.
const LAMP: Lamp = Lamp {
    center: Vec3::new(-0.75, -0.55, 1.45),
    radius: 0.11,
    power: 1.9,
    color: Vec3::new(1.0, 0.93, 0.82),
};
/// The solid's number in the key of a point of the room itself; solids count from 0.
const ROOM_KEY: u16 = 0xFFF;

/// A lamp: a ball that shines.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Lamp {
    pub(crate) center: Vec3,
    pub(crate) radius: f32,
    /// Light at 1 m.
    pub(crate) power: f32,
    pub(crate) color: Vec3,
}

/// A solid with its look.
#[derive(Debug, Clone)]
pub(crate) struct Thing {
    pub(crate) solid: Solid,
    pub(crate) paint: Paint,
    /// Thin things and supports cast no contact shade worth its cost.
    pub(crate) is_thin: bool,
}

impl Thing {
    pub(crate) fn new(solid: Solid, paint: Paint) -> Self {
        let is_thin = match &solid.shape {
            Shape::Capsule { radius, .. } => *radius < 0.008,
            Shape::Mesh(_) => true,
            _ => paint.surface() == Surface::Glass,
        };
        Self { solid, paint, is_thin }
    }

    /// A capsule from `a` to `b`.
    pub(crate) fn rod(a: Vec3, b: Vec3, radius: f32, paint: Paint) -> Self {
        let turn = Mat3::from_quat(Quat::from_rotation_arc(Vec3::Z, (b - a).normalize_or(Vec3::Z)));
        let shape = Shape::Capsule { half: (b - a).length() / 2.0, radius };
        Self::new(Solid::new(shape, (a + b) / 2.0, turn), paint)
    }
}

/// Where a ray ends: the distance, and what is there (solid number and face).
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Met {
    pub(crate) t: f32,
    pub(crate) key: u16,
}

/// A point of a surface.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Spot {
    pub(crate) p: Vec3,
    pub(crate) n: Vec3,
    /// The point in the thing's own frame.
    pub(crate) local: Vec3,
    pub(crate) normal_local: Vec3,
    pub(crate) paint: Paint,
    /// Number of the solid; that of none for the room.
    pub(crate) thing: u16,
}

/// A world: the fixed one of the simulated cameras, or a random one.
#[derive(Debug)]
pub(crate) struct World {
    pub(crate) things: Vec<Thing>,
    pub(crate) lamps: Vec<Lamp>,
    /// Corners of the room.
    pub(crate) room: (Vec3, Vec3),
    /// Looks of floor, walls and ceiling; without them the fixed world's.
    pub(crate) room_looks: Option<[Look; 3]>,
    /// Light from all around: from below and from above.
    pub(crate) around: [Vec3; 2],
    pub(crate) exposure: f32,
    /// Shadows take two rays where these agree, and one in what is reflected or seen through glass.
    pub(crate) is_quick: bool,
}

impl World {
    /// Builds the fixed scene of the simulated cameras, which is always the same one, with `more` things in it.
    pub(crate) fn fixed(more: Vec<Thing>) -> Self {
        let mut b = Builder { things: Vec::new() };
        b.furniture();
        b.table_setting();
        b.fork();
        b.things.extend(more);
        Self {
            things: b.things,
            lamps: vec![LAMP],
            room: ROOM,
            room_looks: None,
            around: [Vec3::new(0.30, 0.245, 0.20), Vec3::new(0.43, 0.47, 0.53)],
            exposure: 0.78,
            is_quick: false,
        }
    }

    /// Every solid, by number.
    pub(crate) fn all(&self) -> Vec<u16> {
        (0..self.things.len() as u16).collect()
    }

    /// Where a ray out of the room's inside ends, looking only at the solids in `among`.
    pub(crate) fn meet(&self, among: &[u16], from: Vec3, dir: Vec3) -> Met {
        let mut met = self.meet_room(from, dir);
        for i in among {
            if let Some(t) = self.things[usize::from(*i)].solid.meet(from, dir, 1e-4, met.t) {
                met = Met { t, key: i << 3 };
            }
        }
        met
    }

    /// Whether a solid of `among` that is not clear stands between a spot and a point. The spot's own solid, if it is
    /// convex, can only do so by facing away.
    pub(crate) fn is_blocked(&self, among: &[u16], spot: &Spot, to: Vec3) -> bool {
        let from = spot.p + spot.n * 3e-4;
        let way = to - from;
        if spot.n.dot(way) <= 0.0 {
            return true;
        }
        among.iter().any(|i| {
            let thing = &self.things[usize::from(*i)];
            (*i != spot.thing || thing.solid.is_hollow())
                && thing.paint.surface() != Surface::Glass
                && thing.solid.meet(from, way, 1e-4, 0.9999).is_some()
        })
    }

    /// The spot that a ray met.
    pub(crate) fn spot(&self, from: Vec3, dir: Vec3, met: Met) -> Spot {
        let p = from + dir * met.t;
        let thing = met.key >> 3;
        if let Some(Thing { solid, paint, .. }) = self.things.get(usize::from(thing)) {
            let local = solid.to_local(p);
            let normal_local = solid.normal_met(from, dir, met.t);
            return Spot { p, n: solid.axes * normal_local, local, normal_local, paint: *paint, thing };
        }
        let n = room_normal(met.key);
        let paint = self.room_paint(n);
        Spot { p, n, local: p, normal_local: n, paint, thing }
    }

    /// The paint of what a key names.
    pub(crate) fn paint(&self, key: u16) -> Paint {
        match self.things.get(usize::from(key >> 3)) {
            Some(thing) => thing.paint,
            None => self.room_paint(room_normal(key)),
        }
    }

    /// The paint of the floor, a wall or the ceiling, by the normal.
    pub(crate) fn room_paint(&self, n: Vec3) -> Paint {
        let (part, fixed) = match n.z {
            z if z > 0.5 => (0, Paint::Floor),
            z if z < -0.5 => (2, Paint::Ceiling),
            _ => (1, Paint::Wall),
        };
        self.room_looks.map_or(fixed, |looks| Paint::Made(looks[part]))
    }

    /// Distance of a point from the nearest surface, negative inside a solid.
    pub(crate) fn distance(&self, p: Vec3) -> f32 {
        self.things.iter().map(|t| t.solid.distance(p)).fold(self.room_distance(p), f32::min)
    }

    /// Adds the face to what was met, so that two faces of a block differ.
    pub(crate) fn with_face(&self, from: Vec3, dir: Vec3, met: Met) -> Met {
        match self.things.get(usize::from(met.key >> 3)) {
            Some(thing) => {
                let solid = &thing.solid;
                let face = match solid.shape {
                    Shape::Block { .. } | Shape::Cylinder { .. } => {
                        solid.normal_local(solid.to_local(from + dir * met.t)).1
                    }
                    _ => 0,
                };
                Met { key: met.key | face, ..met }
            }
            None => met,
        }
    }

    /// How open the half space over a spot is, 0..1: near things and corners take light away.
    pub(crate) fn openness(&self, among: &[u16], spot: &Spot) -> f32 {
        let mut open = 1.0;
        for (reach, weight) in [(0.02, 0.30), (0.08, 0.55)] {
            let at = spot.p + spot.n * reach;
            let mut free = self.room_distance(at).min(reach);
            for i in among {
                let thing = &self.things[usize::from(*i)];
                // Over its own convex solid a spot is as free as it can be.
                if (*i != spot.thing || thing.solid.is_hollow())
                    && !thing.is_thin
                    && thing.solid.is_within(at, reach)
                {
                    free = free.min(thing.solid.distance(at));
                }
            }
            open *= 1.0 - weight * (1.0 - free.max(0.0) / reach);
        }
        open
    }

    fn meet_room(&self, from: Vec3, dir: Vec3) -> Met {
        let (low, high) = self.room;
        let inverse = dir.recip();
        let far = ((low - from) * inverse).max((high - from) * inverse);
        // A direction along an axis makes the other quotients infinite or, on a wall, no number: never smallest.
        let (axis, t) = [far.x, far.y, far.z]
            .into_iter()
            .enumerate()
            .fold((2, f32::INFINITY), |best, (i, t)| if t < best.1 { (i, t) } else { best });
        let side = u16::from(dir[axis] > 0.0);
        Met { t: t.min(1e3), key: (ROOM_KEY << 3) | (axis as u16 * 2 + side) }
    }

    fn room_distance(&self, p: Vec3) -> f32 {
        (p - self.room.0).min(self.room.1 - p).min_element()
    }
}

fn room_normal(key: u16) -> Vec3 {
    let face = key & 7;
    let inward = if face & 1 == 1 { -1.0 } else { 1.0 };
    match face >> 1 {
        0 => Vec3::X * inward,
        1 => Vec3::Y * inward,
        _ => Vec3::Z * inward,
    }
}

struct Builder {
    things: Vec<Thing>,
}

fn turned(yaw_deg: f32) -> Mat3 {
    Mat3::from_rotation_z(yaw_deg.to_radians())
}

impl Builder {
    fn add(&mut self, shape: Shape, center: Vec3, axes: Mat3, paint: Paint) {
        self.things.push(Thing::new(Solid::new(shape, center, axes), paint));
    }

    fn block(&mut self, half: [f32; 3], center: [f32; 3], yaw_deg: f32, paint: Paint) {
        self.add(Shape::Block { half: half.into() }, center.into(), turned(yaw_deg), paint);
    }

    fn ball(&mut self, radius: f32, center: [f32; 3], axes: Mat3, paint: Paint) {
        self.add(Shape::Sphere { radius }, center.into(), axes, paint);
    }

    fn rod(&mut self, a: Vec3, b: Vec3, radius: f32, paint: Paint) {
        self.things.push(Thing::rod(a, b, radius, paint));
    }

    fn furniture(&mut self) {
        self.block([0.78, 0.5, 0.018], [0.0, 0.14, -0.018], 0.0, Paint::Wood);
        for (x, y) in [(-0.72, -0.3), (0.72, -0.3), (-0.72, 0.58), (0.72, 0.58)] {
            self.block([0.03, 0.03, 0.352], [x, y, -0.388], 0.0, Paint::DarkWood);
        }
        self.block([0.42, 0.012, 0.27], [-0.2, 1.035, 0.40], 0.0, Paint::Poster);
        self.block([0.36, 0.2, 0.32], [1.15, 0.82, -0.42], 0.0, Paint::Cabinet);
        self.add(
            Shape::Cylinder { half: 0.09, radius: 0.075 },
            Vec3::new(1.0, 0.86, 0.13),
            Mat3::IDENTITY,
            Paint::Lampshade,
        );
        self.rod(Vec3::new(1.0, 0.86, -0.1), Vec3::new(1.0, 0.86, 0.05), 0.01, Paint::DarkWood);
        self.block([0.06, 0.06, 0.008], [1.0, 0.86, -0.092], 0.0, Paint::DarkWood);
        self.block([0.3, 0.3, 0.2], [-1.3, 0.6, -0.54], 12.0, Paint::Sofa);
    }

    fn table_setting(&mut self) {
        // A calibration board, leaning.
        let lean = turned(14.0) * Mat3::from_rotation_x(-0.3);
        self.add(
            Shape::Block { half: Vec3::new(0.135, 0.004, 0.095) },
            Vec3::new(-0.33, 0.40, 0.094),
            lean,
            Paint::Checker,
        );
        // A mirror in a frame.
        let stand = turned(-24.0) * Mat3::from_rotation_x(-0.10);
        let middle = Vec3::new(0.36, 0.40, 0.135);
        self.add(Shape::Block { half: Vec3::new(0.115, 0.006, 0.135) }, middle, stand, Paint::DarkWood);
        let glass = middle + stand * Vec3::new(0.0, -0.007, 0.0);
        self.add(Shape::Block { half: Vec3::new(0.103, 0.002, 0.123) }, glass, stand, Paint::Mirror);
        // A pane of glass in a foot, and a ball behind it.
        self.block([0.1, 0.003, 0.085], [0.2, 0.06, 0.1005], 12.0, Paint::Glass);
        self.block([0.115, 0.016, 0.007], [0.2, 0.06, 0.007], 12.0, Paint::DarkWood);
        self.ball(0.045, [0.21, 0.17, 0.045], turned(40.0), Paint::Green);
        // Boxes.
        self.block([0.065, 0.05, 0.045], [-0.19, 0.13, 0.045], 24.0, Paint::Stripes);
        self.block([0.034, 0.034, 0.03], [-0.2, 0.135, 0.12], -14.0, Paint::Speckle);
        self.block([0.09, 0.065, 0.014], [-0.47, 0.1, 0.014], 8.0, Paint::BookBlue);
        self.block([0.082, 0.06, 0.011], [-0.468, 0.1, 0.039], -6.0, Paint::BookRed);
        self.block([0.075, 0.055, 0.013], [-0.47, 0.1, 0.063], 15.0, Paint::BookSand);
        // Balls.
        let tilt = Mat3::from_rotation_x(0.5) * turned(25.0);
        self.ball(0.058, [0.02, 0.33, 0.058], tilt, Paint::BeachBall);
        self.ball(0.024, [-0.075, 0.0, 0.024], tilt, Paint::Orange);
        // A plain white mug: nothing on it that a stereo camera could match.
        let mug = Vec3::new(0.04, 0.14, 0.045);
        self.add(Shape::Cylinder { half: 0.045, radius: 0.038 }, mug, Mat3::IDENTITY, Paint::Mug);
        let grip = [(0.036, 0.026), (0.062, 0.018), (0.062, -0.012), (0.036, -0.024)];
        for pair in grip.windows(2) {
            let [a, b] = [pair[0], pair[1]].map(|(x, z)| mug + Vec3::new(-x * 0.8, -x * 0.6, z));
            self.rod(a, b, 0.006, Paint::Mug);
        }
        // A piece of velvet and a polished plate.
        self.block([0.075, 0.055, 0.0012], [-0.25, -0.08, 0.0012], -12.0, Paint::Velvet);
        self.block([0.06, 0.06, 0.0012], [0.27, -0.12, 0.0012], 22.0, Paint::Steel);
    }

    /// A fork that rests on an eraser: tines of 2.6 mm are what coarse stereo windows lose.
    fn fork(&mut self) {
        self.block([0.012, 0.02, 0.009], [0.045, -0.145, 0.009], 20.0, Paint::Eraser);
        let turn = turned(14.0);
        let at = |x: f32, y: f32, z: f32| Vec3::new(-0.03, -0.165, 0.0) + turn * Vec3::new(x, y, z);
        self.rod(at(-0.105, 0.0, 0.0045), at(-0.02, 0.0, 0.012), 0.0042, Paint::Cutlery);
        self.rod(at(-0.02, 0.0, 0.012), at(0.045, 0.0, 0.0215), 0.0030, Paint::Cutlery);
        self.rod(at(0.045, 0.0, 0.0215), at(0.062, 0.0, 0.0225), 0.0036, Paint::Cutlery);
        self.rod(at(0.062, -0.0125, 0.0225), at(0.062, 0.0125, 0.0225), 0.0026, Paint::Cutlery);
        for y in [-0.0125, -0.0042, 0.0042, 0.0125] {
            self.rod(at(0.062, y, 0.0225), at(0.092, y, 0.0215), 0.0014, Paint::Cutlery);
            self.rod(at(0.092, y, 0.0215), at(0.112, y, 0.026), 0.0012, Paint::Cutlery);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_ray_ends_somewhere_in_the_room() {
        let world = World::fixed(Vec::new());
        let all = world.all();
        let from = Vec3::new(0.0, -0.6, 0.5);
        for i in 0..5000u32 {
            let r = super::super::noise::Rolls::new(1, i, 0, 0);
            let dir = Vec3::new(r.normal(0), r.normal(1), r.normal(2)).normalize_or(Vec3::X);
            let met = world.meet(&all, from, dir);
            assert!(met.t > 0.0 && met.t < 6.0);
            let spot = world.spot(from, dir, met);
            assert!(spot.n.dot(dir) <= 1e-3, "surfaces face the camera: {met:?}");
            assert!(world.room_distance(spot.p) > -1e-4);
        }
        // Along the axes, where quotients are infinite.
        for dir in [Vec3::X, Vec3::Y, Vec3::NEG_Z] {
            assert!(world.meet(&all, from, dir).t < 6.0);
        }
    }

    #[test]
    fn nothing_but_glass_lets_light_through() {
        let world = World::fixed(Vec::new());
        let all = world.all();
        let from = Vec3::new(0.19, -0.3, 0.1);
        let wall =
            |p: Vec3, n: Vec3| Spot { p, n, local: p, normal_local: n, paint: Paint::Wall, thing: ROOM_KEY };
        let behind_glass = Vec3::new(0.2, 0.12, 0.1);
        assert!(!world.is_blocked(&all, &wall(from, Vec3::Y), behind_glass));
        assert!(world.is_blocked(&all, &wall(from, Vec3::NEG_Y), behind_glass), "it faces away");
        assert!(world.is_blocked(&all, &wall(from, Vec3::NEG_Z), Vec3::new(0.2, 0.1, -0.3)), "the table");
    }
}
