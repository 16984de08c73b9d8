//! The objects of random worlds: each stands on z = 0 around the z axis of its own frame.

use super::super::scene::Thing;
use super::super::shape::{Lathe, Mesh, Shape, Solid, Superquadric};
use super::super::texture::Paint;
use super::draw::Draw;
use super::family::Family;
use super::material::{self, paint};
use core::f32::consts::{PI, TAU};
use glam::{Mat3, Quat, Vec3};
use std::sync::Arc;

/// An object: its parts, the radius of its footprint and its height, metres.
#[derive(Debug, Default)]
pub(crate) struct Object {
    pub(crate) parts: Vec<Part>,
    pub(crate) radius: f32,
    pub(crate) height: f32,
    /// Something can stand on it.
    pub(crate) is_flat: bool,
}

/// A solid of an object, in the object's frame.
#[derive(Debug)]
pub(crate) struct Part {
    shape: Shape,
    center: Vec3,
    axes: Mat3,
    paint: Paint,
}

impl Object {
    pub(crate) fn add(&mut self, shape: Shape, center: Vec3, axes: Mat3, paint: Paint) {
        self.parts.push(Part { shape, center, axes, paint });
    }

    fn rod(&mut self, a: Vec3, b: Vec3, radius: f32, paint: Paint) {
        let turn = Mat3::from_quat(Quat::from_rotation_arc(Vec3::Z, (b - a).normalize_or(Vec3::Z)));
        self.add(Shape::Capsule { half: (b - a).length() / 2.0, radius }, (a + b) / 2.0, turn, paint);
    }

    fn chain(&mut self, points: &[Vec3], radius: f32, paint: Paint) {
        for pair in points.windows(2) {
            self.rod(pair[0], pair[1], radius, paint);
        }
    }

    fn lathe(&mut self, outline: &[(f32, f32)], paint: Paint) {
        self.add(Shape::Lathe(Arc::new(Lathe::new(outline))), Vec3::ZERO, Mat3::IDENTITY, paint);
    }

    /// Its parts in the world.
    pub(crate) fn place(self, at: Vec3, turn: Mat3) -> impl Iterator<Item = Thing> {
        self.parts.into_iter().map(move |part| {
            let solid = Solid::new(part.shape, at + turn * part.center, turn * part.axes);
            Thing::new(solid, part.paint)
        })
    }

    /// The same object on its side.
    fn lying(mut self) -> Self {
        let turn = Mat3::from_rotation_x(PI / 2.0);
        let (radius, height) = (self.radius, self.height);
        for part in &mut self.parts {
            part.center = turn * (part.center - Vec3::Z * (height / 2.0)) + Vec3::Z * radius;
            part.axes = turn * part.axes;
        }
        Self { radius: height / 2.0, height: 2.0 * radius, is_flat: false, ..self }
    }
}

/// A random object of a family; `large` is the size that furniture has.
pub(crate) fn object(draw: &mut Draw, family: Family, meshes: &[Arc<Mesh>], large: f32) -> Object {
    match family {
        Family::Box => carton(draw, large),
        Family::Ball => ball(draw, large),
        Family::Superquadric => superquadric(draw, large),
        Family::Cup => cup(draw),
        Family::Bottle => bottle(draw, large),
        Family::Bowl => bowl(draw),
        Family::Plate => plate(draw),
        Family::Cutlery => cutlery(draw),
        Family::Cable => cable(draw, large),
        Family::Cloth => cloth(draw, large),
        Family::Mesh => mesh(draw, meshes, large),
    }
}

fn carton(draw: &mut Draw, large: f32) -> Object {
    let half = if draw.chance(0.3) {
        // A book.
        Vec3::new(draw.between(0.05, 0.13), draw.between(0.07, 0.16), draw.between(0.006, 0.025))
    } else {
        Vec3::new(draw.scale(0.015, 0.11), draw.scale(0.015, 0.11), draw.scale(0.012, 0.12))
    } * large;
    let mut made = Object {
        radius: half.x.hypot(half.y),
        height: 2.0 * half.z,
        is_flat: half.x.min(half.y) > 0.03,
        ..Object::default()
    };
    let look = paint(draw, material::CARTON, half.max_element());
    made.add(Shape::Block { half }, Vec3::Z * half.z, Mat3::IDENTITY, look);
    made
}

fn ball(draw: &mut Draw, large: f32) -> Object {
    let radius = draw.scale(0.014, 0.075) * large;
    let mut made = Object { radius, height: 2.0 * radius, ..Object::default() };
    let turn = Mat3::from_euler(glam::EulerRot::XYZ, draw.between(0.0, PI), draw.between(0.0, PI), 0.0);
    let look = paint(draw, material::ANY, radius);
    made.add(Shape::Sphere { radius }, Vec3::Z * radius, turn, look);
    made
}

fn superquadric(draw: &mut Draw, large: f32) -> Object {
    let half = Vec3::new(draw.scale(0.018, 0.09), draw.scale(0.018, 0.09), draw.scale(0.015, 0.1)) * large;
    let side = draw.scale(0.2, 1.6);
    let above = draw.scale(0.2, 1.6);
    let mut made = Object { radius: half.x.hypot(half.y), height: 2.0 * half.z, ..Object::default() };
    let look = paint(draw, material::ANY, half.max_element());
    let shape = Shape::Superquadric(Superquadric { half, side, above });
    made.add(shape, Vec3::Z * half.z, Mat3::IDENTITY, look);
    made
}

/// A smooth curve through radii at even heights (Catmull and Rom), as points from the bottom to the top.
fn curve(knots: &[(f32, f32)], steps: usize) -> Vec<(f32, f32)> {
    let at = |i: isize| knots[i.clamp(0, knots.len() as isize - 1) as usize];
    let mut points = Vec::new();
    for i in 0..knots.len() as isize - 1 {
        let [a, b, c, d] = [at(i - 1), at(i), at(i + 1), at(i + 2)];
        for step in 0..steps {
            let t = step as f32 / steps as f32;
            let mix = |a: f32, b: f32, c: f32, d: f32| {
                b + 0.5
                    * t
                    * ((c - a) + t * ((2.0 * a - 5.0 * b + 4.0 * c - d) + t * (3.0 * (b - c) + d - a)))
            };
            points.push((mix(a.0, b.0, c.0, d.0).max(0.0008), mix(a.1, b.1, c.1, d.1)));
        }
    }
    points.extend(knots.last());
    points
}

/// A vessel: up the outside, over the rim, and down the inside, a wall's width away.
fn vessel(outside: &[(f32, f32)], wall: f32) -> Vec<(f32, f32)> {
    let mut outline = vec![(0.0, 0.0)];
    outline.extend(outside.iter().copied());
    let top = outside.last().map_or(0.0, |p| p.1);
    let inside = outside.iter().rev().filter(|p| p.0 > 2.0 * wall && p.1 < top - wall * 0.3);
    if let Some(rim) = outside.last() {
        outline.push((rim.0 - wall * 0.5, rim.1 + wall * 0.4));
        outline.push((rim.0 - wall, rim.1));
    }
    outline.extend(inside.map(|p| (p.0 - wall, p.1.max(wall * 1.3))));
    let floor = outline.last().map_or(wall, |p| p.1);
    outline.push((0.0, floor));
    outline
}

/// A closed solid with this outside.
fn filled(outside: &[(f32, f32)]) -> Vec<(f32, f32)> {
    let mut outline = vec![(0.0, 0.0)];
    outline.extend(outside.iter().copied());
    outline.push((0.0, outside.last().map_or(0.0, |p| p.1)));
    outline
}

fn cup(draw: &mut Draw) -> Object {
    let height = draw.between(0.05, 0.13);
    let foot = draw.between(0.022, 0.04);
    let rim = foot * draw.between(1.0, 1.5);
    let belly = f32::midpoint(foot, rim) * draw.between(0.92, 1.2);
    let outside = curve(&[(foot, 0.0), (belly, height * 0.45), (rim, height)], 5);
    let look = paint(draw, material::CERAMIC, height);
    let mut made = Object { radius: belly.max(rim), height, ..Object::default() };
    // Clear cups are cast as solid glass: one entry and one exit of the light.
    let outline =
        if is_glass(look) { filled(&outside) } else { vessel(&outside, draw.between(0.002, 0.004)) };
    made.lathe(&outline, look);
    if draw.chance(0.55) && !is_glass(look) {
        let reach = draw.between(0.02, 0.034);
        let tall = height * draw.between(0.28, 0.36);
        let way = draw.between(0.0, TAU);
        let out = Vec3::new(way.cos(), way.sin(), 0.0);
        let points: Vec<Vec3> = (0..=8)
            .map(|i| {
                let a = (i as f32 / 8.0 - 0.5) * PI;
                out * (belly * 0.93 + reach * a.cos()) + Vec3::Z * (height * 0.5 + tall * a.sin())
            })
            .collect();
        made.chain(&points, draw.between(0.003, 0.006), look);
        made.radius += reach;
    }
    made
}

fn is_glass(paint: Paint) -> bool {
    paint.surface() == super::super::texture::Surface::Glass
}

fn bottle(draw: &mut Draw, large: f32) -> Object {
    let height = draw.between(0.1, 0.3) * large;
    let body = height * draw.between(0.11, 0.22);
    let neck = body * draw.between(0.28, 0.6);
    let shoulder = draw.between(0.5, 0.75);
    let waist = body * draw.between(0.85, 1.08);
    let mut knots = vec![(body * 0.9, 0.0), (body, height * 0.06), (waist, height * shoulder * 0.5)];
    knots.extend([(body, height * shoulder), (neck, height * draw.between(0.82, 0.88)), (neck, height)]);
    let outside = curve(&knots, 4);
    let look = paint(draw, material::BOTTLE, height / 2.0);
    let mut made = Object { radius: body * 1.05, height, ..Object::default() };
    made.lathe(&filled(&outside), look);
    if draw.chance(0.6) {
        let cap = paint(draw, material::CARTON, neck);
        let half = height * 0.035;
        made.add(
            Shape::Cylinder { half, radius: neck * 1.1 },
            Vec3::Z * (height + half * 0.8),
            Mat3::IDENTITY,
            cap,
        );
        made.height += 2.0 * half;
    }
    if draw.chance(0.5) {
        // A label around the belly.
        let (low, high) = (height * shoulder * 0.25, height * shoulder * 0.85);
        let band: Vec<_> =
            outside.iter().filter(|p| p.1 > low && p.1 < high).map(|p| (p.0 + 0.0006, p.1)).collect();
        if let (Some(first), Some(last)) = (band.first().copied(), band.last().copied()) {
            let mut outline = vec![(first.0 - 0.0012, first.1)];
            outline.extend(&band);
            outline.push((last.0 - 0.0012, last.1));
            outline.extend(band.iter().rev().map(|p| (p.0 - 0.0012, p.1)));
            let print = material::patterned(
                draw,
                super::super::texture::Surface::Matte,
                super::super::texture::Pattern::Print,
                0.05,
            );
            made.lathe(&outline, Paint::Made(print));
        }
    }
    if draw.chance(0.2) { made.lying() } else { made }
}

fn bowl(draw: &mut Draw) -> Object {
    let rim = draw.between(0.05, 0.13);
    let height = rim * draw.between(0.35, 0.8);
    let foot = rim * draw.between(0.3, 0.5);
    let outside =
        curve(&[(foot, 0.0), (rim * 0.8, height * 0.35), (rim * 0.95, height * 0.7), (rim, height)], 5);
    let look = paint(draw, material::CERAMIC, rim);
    let mut made = Object { radius: rim, height, ..Object::default() };
    made.lathe(&vessel(&outside, draw.between(0.0025, 0.005)), look);
    made
}

fn plate(draw: &mut Draw) -> Object {
    let rim = draw.between(0.07, 0.15);
    let height = draw.between(0.012, 0.026);
    let foot = rim * draw.between(0.55, 0.7);
    let outside = curve(&[(foot, 0.0), (rim * 0.8, height * 0.35), (rim, height)], 5);
    let look = paint(draw, material::CERAMIC, rim);
    let mut made = Object { radius: rim, height, is_flat: false, ..Object::default() };
    made.lathe(&vessel(&outside, draw.between(0.0025, 0.004)), look);
    made
}

/// A bent outline of rods: the stem rises to the front part.
fn cutlery(draw: &mut Draw) -> Object {
    let look = paint(draw, material::CUTLERY, 0.05);
    let length = draw.between(0.14, 0.21);
    let thick = draw.between(0.0016, 0.003);
    let bow = draw.between(0.004, 0.014);
    let lift = thick + 0.0004;
    let at = |s: f32, y: f32| {
        // Height over the table along the length: two bends.
        let rise = bow * ((s * PI * 1.5).sin().max(0.0) * 0.6 + (s - 0.55).max(0.0) * 1.1);
        Vec3::new((s - 0.5) * length, y, lift + rise)
    };
    let mut made = Object { radius: length / 2.0, height: bow + 0.01, ..Object::default() };
    let stem: Vec<Vec3> = (0..=7).map(|i| at(i as f32 / 7.0 * 0.68, 0.0)).collect();
    made.chain(&stem, thick, look);
    made.rod(at(0.0, 0.0), at(0.2, 0.0), thick * 1.5, look);
    match draw.below(3) {
        0 => {
            // Tines.
            let count = 3 + draw.below(2);
            let wide = draw.between(0.008, 0.012);
            made.rod(at(0.7, -wide), at(0.7, wide), thick * 0.9, look);
            made.rod(at(0.66, 0.0), at(0.7, 0.0), thick * 1.3, look);
            for i in 0..count {
                let y = wide * (2.0 * i as f32 / (count - 1) as f32 - 1.0);
                made.chain(&[at(0.7, y), at(0.85, y), at(1.0, y)], thick * 0.55, look);
            }
        }
        1 => {
            let half = Vec3::new(length * 0.16, draw.between(0.011, 0.02), thick * 1.3);
            let flat = Superquadric { half, side: 1.0, above: 1.0 };
            made.add(Shape::Superquadric(flat), at(0.83, 0.0), Mat3::from_rotation_y(-0.08), look);
        }
        _ => {
            let half = Vec3::new(length * 0.19, draw.between(0.006, 0.01), thick * 0.45);
            let blade = Superquadric { half, side: 1.0, above: 0.5 };
            made.add(Shape::Superquadric(blade), at(0.82, 0.0), Mat3::IDENTITY, look);
        }
    }
    made
}

fn cable(draw: &mut Draw, large: f32) -> Object {
    let radius = draw.scale(0.0012, 0.005) * large.sqrt();
    let look = paint(draw, material::CABLE, 0.03);
    let count = 14 + draw.below(30);
    let step = draw.between(0.012, 0.022) * large.sqrt();
    let mut way = draw.between(0.0, TAU);
    let mut bend = draw.between(-0.4, 0.4);
    let mut p = Vec3::ZERO;
    let mut points = vec![p];
    let hump = draw.between(0.0, 0.05) * large;
    let waves = draw.between(0.5, 3.0);
    for i in 1..=count {
        bend = (bend * 0.9 + draw.between(-0.18, 0.18)).clamp(-0.55, 0.55);
        way += bend;
        p += Vec3::new(way.cos(), way.sin(), 0.0) * step;
        let lift = hump * (i as f32 / count as f32 * PI * waves).sin().max(0.0).powi(2);
        points.push(Vec3::new(p.x, p.y, lift));
    }
    let middle = points.iter().sum::<Vec3>() / points.len() as f32;
    let points: Vec<Vec3> =
        points.iter().map(|q| Vec3::new(q.x - middle.x, q.y - middle.y, q.z + radius)).collect();
    let mut made = Object { height: hump + 2.0 * radius, ..Object::default() };
    // Cables run between other things: their footprint is small.
    made.radius = 0.02;
    made.chain(&points, radius, look);
    if draw.chance(0.5)
        && let Some(end) = points.last()
    {
        let half = Vec3::new(0.012, 0.006, 0.0035) * large.sqrt();
        let plug = Superquadric { half, side: 0.4, above: 0.4 };
        made.add(
            Shape::Superquadric(plug),
            Vec3::new(end.x, end.y, end.z.max(half.z)),
            Mat3::from_rotation_z(way),
            look,
        );
    }
    made
}

/// A height field: a piece of cloth with folds, as two layers of triangles.
fn cloth(draw: &mut Draw, large: f32) -> Object {
    const N: usize = 28;
    let half = [draw.between(0.07, 0.2) * large, draw.between(0.07, 0.2) * large];
    let amount = draw.scale(0.003, 0.045) * large;
    let waves: Vec<[f32; 4]> = (0..5)
        .map(|_| {
            let way = draw.between(0.0, TAU);
            let k = draw.scale(8.0, 70.0) / large;
            [way.cos() * k, way.sin() * k, draw.between(0.0, TAU), 14.0 / (k * large + 14.0)]
        })
        .collect();
    let field = draw.below(1 << 16) as i32;
    let height = |x: f32, y: f32| {
        let sum: f32 = waves.iter().map(|[u, v, phase, part]| part * (u * x + v * y + phase).sin()).sum();
        let crease = super::super::noise::smooth2(x * 18.0 / large + 50.0, y * 18.0 / large + 50.0, field);
        (amount * (0.35 * sum + 0.9 * crease)).max(0.0) + 0.0015
    };
    let wobble: Vec<f32> = (0..4).map(|_| draw.between(-0.12, 0.12)).collect();
    let corners: Vec<Vec3> = (0..N * N)
        .map(|i| {
            let u = (i % N) as f32 / (N - 1) as f32 * 2.0 - 1.0;
            let v = (i / N) as f32 / (N - 1) as f32 * 2.0 - 1.0;
            let x = half[0] * (u + wobble[0] * v * v + wobble[1] * (v * 2.0).sin());
            let y = half[1] * (v + wobble[2] * u * u + wobble[3] * (u * 2.0).sin());
            Vec3::new(x, y, height(x, y))
        })
        .collect();
    let mut triangles = Vec::new();
    for j in 0..N - 1 {
        for i in 0..N - 1 {
            let a = (j * N + i) as u32;
            let n = N as u32;
            triangles.extend([[a, a + 1, a + n], [a + 1, a + n + 1, a + n]]);
        }
    }
    let look = paint(draw, material::CLOTH, 0.06 * large);
    let mut made = Object {
        radius: half[0].max(half[1]) * 0.6,
        height: 0.0,
        is_flat: amount < 0.008,
        ..Object::default()
    };
    made.add(Shape::Mesh(Arc::new(Mesh::new(&corners, &triangles))), Vec3::ZERO, Mat3::IDENTITY, look);
    made
}

fn mesh(draw: &mut Draw, meshes: &[Arc<Mesh>], large: f32) -> Object {
    let Some(mesh) = meshes.get(draw.below(meshes.len())) else { return carton(draw, large) };
    // Meshes come with a radius of 1 and stand on the lowest corner.
    let radius = draw.scale(0.03, 0.14) * large;
    let look = paint(draw, material::ANY, radius);
    let scaled = mesh.scaled(radius);
    let mut made = Object { radius: radius * 0.8, height: radius, ..Object::default() };
    let low = scaled.low();
    made.add(Shape::Mesh(Arc::new(scaled)), Vec3::Z * -low, Mat3::IDENTITY, look);
    made
}
