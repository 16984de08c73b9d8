//! Random worlds: tables with things on them, and rooms. Everything follows from a seed and the number of the sample.

use super::motion::look_at;
use super::scene::{Lamp, Thing, World};
use super::shape::{Mesh, Shape, Solid};
use super::texture::{Look, Paint, Pattern, Surface};
use glam::{DAffine3, DMat3, Mat3, Vec3};
use objects::Object;
use std::sync::Arc;

mod draw;
mod family;
mod material;
mod objects;

pub(crate) use draw::Draw;
pub use family::Family;

/// Height of a table's top over the floor, metres.
const TABLE_M: f32 = 0.74;
/// Solids that a world has at most; a part of an image's key counts them.
const MOST_THINGS: usize = 900;
/// Nearer than this a camera's place is not accepted, metres.
const CLEAR_M: f32 = 0.12;

/// Kind of a random world.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum SceneKind {
    /// Things on a table, from 0.25 to 1.5 m.
    Table,
    /// A furnished room, from 1 to 6 m.
    Room,
}

impl SceneKind {
    /// Its name in records.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Table => "table",
            Self::Room => "room",
        }
    }
}

/// A world and the camera in it.
#[derive(Debug)]
pub(crate) struct RandomWorld {
    pub(crate) world: World,
    pub(crate) kind: SceneKind,
    /// Families of the objects in it, each once, in order.
    pub(crate) families: Vec<Family>,
    /// The depth camera in the world.
    pub(crate) camera_pose: DAffine3,
}

/// The objects that random worlds have.
#[derive(Debug)]
pub(crate) struct Stock {
    /// Families to choose from; at least one.
    pub(crate) families: Vec<Family>,
    /// Meshes of radius 1.
    pub(crate) meshes: Vec<Arc<Mesh>>,
}

impl RandomWorld {
    /// World `number` of the run with this seed.
    pub(crate) fn new(seed: u64, number: u64, stock: &Stock) -> Self {
        let mut draw = Draw::new(seed, number, 1);
        let kind = if draw.chance(0.65) { SceneKind::Table } else { SceneKind::Room };
        let mut builder =
            Builder { stock, world: room(&mut draw, kind), families: Vec::new(), places: Vec::new() };
        match kind {
            SceneKind::Table => builder.table(&mut draw),
            SceneKind::Room => builder.furnish(&mut draw),
        }
        builder.families.sort_unstable();
        builder.families.dedup();
        let Builder { mut world, families, places, .. } = builder;
        let mut camera_pose = DAffine3::IDENTITY;
        for _ in 0..40 {
            let (at, target) = match kind {
                SceneKind::Table => over_table(&mut draw, &places),
                SceneKind::Room => in_room(&mut draw, &world, &places),
            };
            camera_pose = look_at(at.as_dvec3(), target.as_dvec3());
            if is_clear(&world, at, target) {
                break;
            }
        }
        let roll =
            f64::from(if draw.chance(0.15) { draw.between(-0.6, 0.6) } else { draw.between(-0.08, 0.08) });
        camera_pose.matrix3 *= DMat3::from_rotation_z(roll);
        light(&mut draw, &mut world, &camera_pose);
        Self { world, kind, families, camera_pose }
    }
}

/// Something to put things on: its middle and half its sides.
#[derive(Debug, Clone, Copy)]
struct Top {
    center: Vec3,
    half: [f32; 2],
    turn: f32,
}

struct Builder<'a> {
    stock: &'a Stock,
    world: World,
    families: Vec<Family>,
    /// Where things stand.
    places: Vec<Vec3>,
}

/// An empty room.
fn room(draw: &mut Draw, kind: SceneKind) -> World {
    let wide = match kind {
        SceneKind::Table => [draw.between(1.8, 4.0), draw.between(1.8, 4.0)],
        SceneKind::Room => [draw.between(1.8, 3.6), draw.between(1.8, 3.6)],
    };
    let low = Vec3::new(-wide[0], -wide[1], -TABLE_M);
    let high = Vec3::new(wide[0], wide[1], draw.between(1.6, 2.2));
    let weights =
        [Pattern::Plain, Pattern::Grain, Pattern::Tiles, Pattern::Cloud, Pattern::Checks, Pattern::Marble];
    let ground = weights[draw.weighted(&[0.15, 0.3, 0.25, 0.15, 0.05, 0.1])];
    let shine = if draw.chance(0.4) { Surface::Glossy } else { Surface::Matte };
    let floor = material::patterned(draw, shine, ground, 1.2);
    let cover = [Pattern::Plain, Pattern::Cloud, Pattern::Stripes, Pattern::Tiles]
        [draw.weighted(&[0.6, 0.2, 0.1, 0.1])];
    let wall = lighter(material::patterned(draw, Surface::Matte, cover, 1.0));
    let ceiling = lighter(lighter(material::patterned(draw, Surface::Matte, Pattern::Plain, 1.0)));
    World {
        things: Vec::new(),
        lamps: Vec::new(),
        room: (low, high),
        room_looks: Some([floor, wall, ceiling]),
        around: [Vec3::ZERO; 2],
        exposure: 1.0,
        is_quick: true,
    }
}

/// Walls are rarely dark.
fn lighter(mut look: Look) -> Look {
    look.colors = look.colors.map(|c| c.lerp(Vec3::splat(0.72), 0.55));
    look.infrared.albedo = look.infrared.albedo.mul_add(0.5, 0.35);
    look
}

impl Builder<'_> {
    /// A table and what is on it.
    fn table(&mut self, draw: &mut Draw) {
        let half = [draw.between(0.4, 0.9), draw.between(0.3, 0.6)];
        let top = Top { center: Vec3::ZERO, half, turn: draw.between(-3.1, 3.1) };
        self.desk(draw, top);
        let count = 6 + draw.below(24);
        let spread = draw.between(0.3, 0.9);
        self.set(draw, top, count, spread);
        // Things behind it.
        for _ in 0..draw.below(5) {
            let way = draw.between(0.0, core::f32::consts::TAU);
            let off = draw.between(1.2, 1.8);
            let at = Vec3::new(way.cos() * off, way.sin() * off, self.world.room.0.z);
            let family = [Family::Box, Family::Superquadric][draw.below(2)];
            let large = draw.between(3.0, 6.0);
            self.put(draw, family, at, large);
        }
        self.wall_things(draw, 3);
    }

    /// The table itself.
    fn desk(&mut self, draw: &mut Draw, top: Top) {
        let [x, y] = top.half;
        let turn = Mat3::from_rotation_z(top.turn);
        let thick = draw.between(0.01, 0.025);
        let plate = [
            Pattern::Grain,
            Pattern::Plain,
            Pattern::Cloud,
            Pattern::Marble,
            Pattern::Checks,
            Pattern::Stripes,
        ];
        let plate = plate[draw.weighted(&[0.42, 0.24, 0.12, 0.1, 0.06, 0.06])];
        let shine = if draw.chance(0.45) { Surface::Glossy } else { Surface::Matte };
        let look = Paint::Made(material::patterned(draw, shine, plate, 0.5));
        let look = if draw.chance(0.06) { material::paint(draw, material::ANY, 0.5) } else { look };
        self.block(Vec3::new(x, y, thick), top.center - Vec3::Z * thick, turn, look);
        let legs = material::paint(draw, material::FURNITURE, 0.3);
        let floor = self.world.room.0.z;
        let tall = (top.center.z - 2.0 * thick - floor) / 2.0;
        for (u, v) in [(-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)] {
            let foot = turn * Vec3::new(u * (x - 0.05), v * (y - 0.05), 0.0);
            let center = Vec3::new(top.center.x + foot.x, top.center.y + foot.y, floor + tall);
            self.block(Vec3::new(0.025, 0.025, tall), center, turn, legs);
        }
    }

    fn block(&mut self, half: Vec3, center: Vec3, axes: Mat3, paint: Paint) {
        let solid = Solid::new(Shape::Block { half }, center, axes);
        self.world.things.push(Thing::new(solid, paint));
    }

    /// Things on a top, beside and on each other.
    fn set(&mut self, draw: &mut Draw, top: Top, count: usize, spread: f32) {
        let mut taken: Vec<(Vec3, f32)> = Vec::new();
        // Families come in groups: a table of bottles is as likely as one of everything.
        let palette: Vec<Family> = (0..=draw.below(6)).map(|_| self.family(draw)).collect();
        for _ in 0..count {
            let family = palette[draw.below(palette.len())];
            let large = if draw.chance(0.2) { draw.between(0.6, 1.7) } else { 1.0 };
            let made = objects::object(draw, family, &self.stock.meshes, large);
            let place = (0..12).find_map(|_| {
                let u = draw.between(-1.0, 1.0) * (top.half[0] * spread - made.radius).max(0.01);
                let v = draw.between(-1.0, 1.0) * (top.half[1] * spread - made.radius).max(0.01);
                let at = top.center + Mat3::from_rotation_z(top.turn) * Vec3::new(u, v, 0.0);
                taken.iter().all(|(p, r)| (*p - at).length() > (r + made.radius) * 0.98).then_some(at)
            });
            let Some(at) = place else { continue };
            let radius = made.radius;
            let height = made.height;
            let is_flat = made.is_flat;
            self.place(draw, family, made, at);
            taken.push((at, radius));
            self.places.push(at);
            if is_flat && draw.chance(0.4) {
                let family = palette[draw.below(palette.len())];
                let small = objects::object(draw, family, &self.stock.meshes, 0.7);
                if small.radius < radius * 0.8 {
                    self.place(draw, family, small, at + Vec3::Z * height);
                }
            }
        }
    }

    fn family(&self, draw: &mut Draw) -> Family {
        let weights: Vec<f32> = self.stock.families.iter().map(|f| f.weight()).collect();
        self.stock.families.get(draw.weighted(&weights)).copied().unwrap_or(Family::Box)
    }

    fn place(&mut self, draw: &mut Draw, family: Family, made: Object, at: Vec3) {
        if self.world.things.len() + made.parts.len() > MOST_THINGS {
            return;
        }
        let turn = Mat3::from_rotation_z(draw.between(-3.1, 3.1));
        self.world.things.extend(made.place(at, turn));
        self.families.push(family);
    }

    /// One thing of the size of furniture, if its family is allowed.
    fn put(&mut self, draw: &mut Draw, family: Family, at: Vec3, large: f32) {
        let family = if self.stock.families.contains(&family) { family } else { self.family(draw) };
        let made = objects::object(draw, family, &self.stock.meshes, large);
        self.place(draw, family, made, at);
    }

    /// Furniture of a room, with things on it.
    fn furnish(&mut self, draw: &mut Draw) {
        let (low, high) = self.world.room;
        let floor = low.z;
        for _ in 0..=draw.below(3) {
            let half = [draw.between(0.35, 0.8), draw.between(0.3, 0.5)];
            let x = draw.between(low.x + 0.8, high.x - 0.8);
            let y = draw.between(low.y + 0.8, high.y - 0.8);
            let top = Top {
                center: Vec3::new(x, y, floor + draw.between(0.4, 0.8)),
                half,
                turn: draw.between(-3.1, 3.1),
            };
            self.desk(draw, top);
            let count = 2 + draw.below(8);
            self.set(draw, top, count, 0.95);
        }
        // Cabinets and shelves along the walls.
        for _ in 0..=draw.below(5) {
            let half = Vec3::new(draw.between(0.2, 0.7), draw.between(0.15, 0.35), draw.between(0.2, 1.0));
            let side = draw.below(4);
            let along = draw.between(-0.85, 0.85);
            let (center, turn) = match side {
                0 => (Vec3::new(high.x * along, high.y - half.y, floor + half.z), 0.0),
                1 => (Vec3::new(high.x * along, low.y + half.y, floor + half.z), 0.0),
                2 => (Vec3::new(low.x + half.y, high.y * along, floor + half.z), 1.570_796_4),
                _ => (Vec3::new(high.x - half.y, high.y * along, floor + half.z), 1.570_796_4),
            };
            let look = material::paint(draw, material::FURNITURE, 0.6);
            self.block(half, center, Mat3::from_rotation_z(turn), look);
            let top = Top { center: center + Vec3::Z * half.z, half: [half.x, half.y], turn };
            let count = draw.below(6);
            self.set(draw, top, count, 0.95);
        }
        // Chairs: a seat, a back, four legs.
        for _ in 0..draw.below(4) {
            let at = Vec3::new(draw.between(low.x, high.x) * 0.75, draw.between(low.y, high.y) * 0.75, floor);
            self.chair(draw, at);
        }
        for _ in 0..2 + draw.below(6) {
            let at = Vec3::new(draw.between(low.x, high.x) * 0.85, draw.between(low.y, high.y) * 0.85, floor);
            let family = self.family(draw);
            let large = draw.between(1.5, 5.0);
            self.put(draw, family, at, large);
        }
        self.wall_things(draw, 7);
    }

    fn chair(&mut self, draw: &mut Draw, at: Vec3) {
        let turn = Mat3::from_rotation_z(draw.between(-3.1, 3.1));
        let look = material::paint(draw, material::FURNITURE, 0.3);
        let legs = material::paint(draw, material::CUTLERY, 0.3);
        let mut made = Object::default();
        let half = draw.between(0.19, 0.25);
        let seat = draw.between(0.42, 0.48);
        made.add(Shape::Block { half: Vec3::new(half, half, 0.02) }, Vec3::Z * seat, Mat3::IDENTITY, look);
        let back = Vec3::new(0.0, half, seat + 0.3);
        made.add(
            Shape::Block { half: Vec3::new(half, 0.015, 0.16) },
            back,
            Mat3::from_rotation_x(-0.12),
            look,
        );
        for (u, v) in [(-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)] {
            let tall = if v > 0.0 { seat / 2.0 + 0.15 } else { seat / 2.0 };
            made.add(
                Shape::Capsule { half: tall - 0.012, radius: 0.012 },
                Vec3::new(u * (half - 0.015), v * (half - 0.015), tall),
                Mat3::IDENTITY,
                legs,
            );
        }
        self.world.things.extend(made.place(at, turn));
    }

    /// Posters, doors, panes and mirrors on the walls.
    fn wall_things(&mut self, draw: &mut Draw, most: usize) {
        let (low, high) = self.world.room;
        for _ in 0..draw.below(most + 1) {
            let half = Vec3::new(draw.between(0.15, 0.6), 0.012, draw.between(0.15, 0.6));
            let along = draw.between(-0.8, 0.8);
            let z = draw.between(0.1, 0.9);
            let (center, turn) = match draw.below(4) {
                0 => (Vec3::new(high.x * along, high.y - 0.012, z), 0.0),
                1 => (Vec3::new(high.x * along, low.y + 0.012, z), 0.0),
                2 => (Vec3::new(low.x + 0.012, high.y * along, z), 1.570_796_4),
                _ => (Vec3::new(high.x - 0.012, high.y * along, z), 1.570_796_4),
            };
            let look = material::paint(draw, [0.6, 0.2, 0.1, 0.05, 0.05], half.x);
            self.block(half, center, Mat3::from_rotation_z(turn), look);
        }
    }
}

/// A place over the table, and what the camera looks at.
fn over_table(draw: &mut Draw, places: &[Vec3]) -> (Vec3, Vec3) {
    let far = draw.scale(0.25, 1.5);
    let near = draw.pick(places);
    let off = Vec3::new(draw.between(-0.2, 0.2), draw.between(-0.2, 0.2), draw.between(0.0, 0.12));
    let target = near + off * far.min(1.0);
    let up = draw.between(0.3, 1.45);
    let way = draw.between(0.0, core::f32::consts::TAU);
    let at = target + Vec3::new(way.cos() * up.cos(), way.sin() * up.cos(), up.sin()) * far;
    (at, target)
}

/// A place in a room, and what the camera looks at.
fn in_room(draw: &mut Draw, world: &World, places: &[Vec3]) -> (Vec3, Vec3) {
    let (low, high) = world.room;
    let at = Vec3::new(
        draw.between(low.x, high.x) * 0.88,
        draw.between(low.y, high.y) * 0.88,
        low.z + draw.between(0.7, 1.9),
    );
    let target = if draw.chance(0.5) {
        draw.pick(places)
    } else {
        let x = draw.between(low.x, high.x) * 0.6;
        let y = draw.between(low.y, high.y) * 0.6;
        Vec3::new(x, y, low.z + draw.between(0.1, 1.2))
    };
    (at, target)
}

/// Whether a camera can be there: in the room, outside things, and not right before one.
fn is_clear(world: &World, at: Vec3, target: Vec3) -> bool {
    let way = target - at;
    if way.length() < 0.2 || way.normalize().z < -0.998 || world.distance(at) < CLEAR_M {
        return false;
    }
    let met = world.meet(&world.all(), at, way.normalize());
    met.t > 0.7 * way.length().min(1.0)
}

/// Lamps, light from all around, and an exposure that suits them.
fn light(draw: &mut Draw, world: &mut World, camera_pose: &DAffine3) {
    let (low, high) = world.room;
    let count = 1 + draw.weighted(&[0.35, 0.35, 0.2, 0.1]);
    let middle =
        (camera_pose.translation + camera_pose.matrix3.z_axis * 0.8).as_vec3().clamp(low + 0.1, high - 0.1);
    let direct = draw.between(0.35, 1.0);
    let parts: Vec<f32> = (0..count).map(|_| draw.between(0.3, 1.0)).collect();
    let sum: f32 = parts.iter().sum();
    for part in parts {
        let mut center = Vec3::new(
            draw.between(low.x, high.x) * 0.9,
            draw.between(low.y, high.y) * 0.9,
            draw.between(1.0, high.z - 0.15),
        );
        // Never between the camera and what it sees.
        if (center - camera_pose.translation.as_vec3()).length() < 0.5 {
            center.z = high.z - 0.1;
        }
        let warm = draw.unit();
        let color = Vec3::new(1.0, 0.80, 0.58).lerp(Vec3::new(0.86, 0.94, 1.0), warm.sqrt());
        let far = (center - middle).length_squared().max(0.3);
        let power = direct * part / sum * far * 1.35;
        world.lamps.push(Lamp { center, radius: draw.scale(0.03, 0.3), power, color });
    }
    let tint = Vec3::new(1.0, 0.92, 0.85).lerp(Vec3::new(0.9, 0.98, 1.1), draw.unit());
    let fill = draw.between(0.22, 0.6);
    world.around = [tint * fill * draw.between(0.4, 0.8), tint * fill];
    world.exposure = draw.scale(0.55, 1.25) / (0.35 + 0.65 * (direct + fill));
}

#[cfg(test)]
mod tests;
