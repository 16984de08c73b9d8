//! Surfaces as triangles, for programs that render meshes. Corners are made from the shapes' parameters and not by rays,
//! so that a renderer of meshes can check what rays find.

use super::{Shape, Solid};
use core::f32::consts::{PI, TAU};
use glam::Vec3;

/// A surface of two parameters, 0 to 1.
pub(crate) struct Patch<'a> {
    at: Box<dyn Fn(f32, f32) -> Vec3 + 'a>,
    /// Its size along both parameters at the widest, metres.
    size: [f32; 2],
    /// The least radius of its curvature, metres; infinite where it is flat.
    radius: f32,
}

/// Triangles in the shape's frame.
#[derive(Debug, Default)]
pub(crate) struct Triangles {
    pub(crate) corners: Vec<Vec3>,
    pub(crate) normals: Vec<Vec3>,
    pub(crate) faces: Vec<[u32; 3]>,
}

/// Chords on curved surfaces are at most this part of the radius.
const CHORD: f32 = 0.1;
/// Flat patches are cut into tiles of at most this side, so that near parts are finer than far ones.
const TILE_M: f32 = 0.25;

impl Triangles {
    /// Triangles of the whole surface of a solid; `spacing` is how far apart corners may be around a place of the shape's
    /// frame.
    pub(crate) fn of(solid: &Solid, spacing: &dyn Fn(Vec3) -> f32) -> Self {
        let mut out = Self::default();
        if let Shape::Mesh(mesh) = &solid.shape {
            for triangle in mesh.triangles() {
                let [a, b, c] = *triangle;
                out.normals.extend([(b - a).cross(c - a).normalize_or(Vec3::Z); 3]);
                out.faces.push([0, 1, 2].map(|i| out.corners.len() as u32 + i));
                out.corners.extend(triangle);
            }
            return out;
        }
        for patch in patches(&solid.shape) {
            out.add(&patch, spacing, &|p| solid.normal_local(p).0);
        }
        out
    }

    /// A face of a box between two corners, seen from inside: 0 is at the lowest x, 1 at the highest, then y and z.
    pub(crate) fn of_room((low, high): (Vec3, Vec3), face: usize, spacing: &dyn Fn(Vec3) -> f32) -> Self {
        let middle = (low + high) / 2.0;
        let mut inward = Vec3::ZERO;
        inward[face / 2] = if face.is_multiple_of(2) { 1.0 } else { -1.0 };
        let mut out = Self::default();
        let patches = faces((high - low) / 2.0, f32::INFINITY, |p| p + middle);
        out.add(&patches[face], spacing, &|_| inward);
        out
    }

    fn add(&mut self, patch: &Patch<'_>, spacing: &dyn Fn(Vec3) -> f32, normal: &dyn Fn(Vec3) -> Vec3) {
        let tiles = patch
            .size
            .map(|s| if patch.radius.is_finite() { 1 } else { (s / TILE_M).ceil().max(1.0) as usize });
        for (i, j) in (0..tiles[0]).flat_map(|i| (0..tiles[1]).map(move |j| (i, j))) {
            let [width, height] = [1.0 / tiles[0] as f32, 1.0 / tiles[1] as f32];
            let inside = |u: f32, v: f32| (patch.at)((i as f32 + u) * width, (j as f32 + v) * height);
            let apart = spacing(inside(0.5, 0.5)).min(CHORD * patch.radius);
            let count =
                [0, 1].map(|k| (patch.size[k] / tiles[k] as f32 / apart).ceil().clamp(1.0, 2000.0) as u32);
            let first = self.corners.len() as u32;
            for (b, a) in (0..=count[1]).flat_map(|b| (0..=count[0]).map(move |a| (b, a))) {
                let [u, v] = [a as f32 / count[0] as f32, b as f32 / count[1] as f32];
                self.corners.push(inside(u, v));
                // On an edge of two patches the normal is that of this one.
                let inner = |x: f32| x.mul_add(1.0 - 2e-3, 1e-3);
                self.normals.push(normal(inside(inner(u), inner(v))));
            }
            let row = count[0] + 1;
            for (b, a) in (0..count[1]).flat_map(|b| (0..count[0]).map(move |a| (b, a))) {
                let at = first + b * row + a;
                self.face([at, at + 1, at + row]);
                self.face([at + 1, at + row + 1, at + row]);
            }
        }
    }

    /// Adds a triangle that faces outwards, unless it is only a line.
    fn face(&mut self, [a, b, c]: [u32; 3]) {
        let [p, q, r] = [a, b, c].map(|i| self.corners[i as usize]);
        let way = (q - p).cross(r - p);
        let outward = [a, b, c].map(|i| self.normals[i as usize]).iter().sum::<Vec3>();
        if way.length_squared() > 0.0 {
            self.faces.push(if way.dot(outward) < 0.0 { [a, c, b] } else { [a, b, c] });
        }
    }
}

fn patches(shape: &Shape) -> Vec<Patch<'_>> {
    match shape {
        Shape::Sphere { radius } => vec![arc(*radius, 0.0, [-1.0, 1.0])],
        Shape::Block { half } => faces(*half, f32::INFINITY, |p| p).into(),
        Shape::Superquadric(s) => {
            // A convex surface as the box around it, drawn in; the corners of small exponents are the sharpest.
            let sharp = s.half.min_element() * s.side.min(s.above).min(1.0);
            faces(s.half, sharp, move |p| p / s.gauge(p).0).into()
        }
        Shape::Cylinder { half, radius } => {
            let outline = [(0.0, -*half), (*radius, -*half), (*radius, *half), (0.0, *half)];
            outline.windows(2).map(|w| cone(w[0], w[1], *radius)).collect()
        }
        Shape::Capsule { half, radius } => vec![
            arc(*radius, -*half, [-1.0, 0.0]),
            cone((*radius, -*half), (*radius, *half), *radius),
            arc(*radius, *half, [0.0, 1.0]),
        ],
        Shape::Lathe(lathe) => {
            let outline: Vec<(f32, f32)> =
                lathe.outline().into_iter().map(|(r, z)| (r as f32, z as f32)).collect();
            let widest = outline.iter().map(|p| p.0).fold(0.0, f32::max);
            outline.windows(2).map(|w| cone(w[0], w[1], widest)).collect()
        }
        Shape::Mesh(_) => Vec::new(),
    }
}

/// A part of a sphere around z = `middle`: between two heights, -1 to 1 as sines.
fn arc<'a>(radius: f32, middle: f32, [low, high]: [f32; 2]) -> Patch<'a> {
    let at = move |u: f32, v: f32| {
        let (up, along) = (PI / 2.0 * (low + (high - low) * v)).sin_cos();
        let (sin, cos) = (u * TAU).sin_cos();
        Vec3::new(along * cos, along * sin, up) * radius + Vec3::Z * middle
    };
    Patch { at: Box::new(at), size: [radius * TAU, radius * PI / 2.0 * (high - low)], radius }
}

/// A piece of a cone around z between two circles (radius, height).
fn cone<'a>(a: (f32, f32), b: (f32, f32), widest: f32) -> Patch<'a> {
    let at = move |u: f32, v: f32| {
        let (sin, cos) = (u * TAU).sin_cos();
        let radius = a.0 + (b.0 - a.0) * v;
        Vec3::new(radius * cos, radius * sin, a.1 + (b.1 - a.1) * v)
    };
    Patch { at: Box::new(at), size: [widest * TAU, (b.0 - a.0).hypot(b.1 - a.1)], radius: widest }
}

/// The six faces of a block, as `bend` moves their points.
fn faces<'a>(half: Vec3, radius: f32, bend: impl Fn(Vec3) -> Vec3 + Copy + 'a) -> [Patch<'a>; 6] {
    core::array::from_fn(|face| {
        let axis = face / 2;
        let [p, q] = [(axis + 1) % 3, (axis + 2) % 3];
        let side = if face % 2 == 0 { -1.0 } else { 1.0 };
        let at = move |u: f32, v: f32| {
            let mut point = Vec3::ZERO;
            point[axis] = side * half[axis];
            point[p] = u.mul_add(2.0, -1.0) * half[p];
            point[q] = v.mul_add(2.0, -1.0) * half[q];
            bend(point)
        };
        Patch { at: Box::new(at), size: [2.0 * half[p], 2.0 * half[q]], radius }
    })
}

#[cfg(test)]
mod tests {
    use super::super::{Lathe, Superquadric};
    use super::*;
    use glam::Mat3;
    use std::sync::Arc;

    #[test]
    fn corners_lie_on_the_surface_and_faces_look_outwards() {
        let cup = [(0.0, -0.05), (0.03, -0.05), (0.04, 0.05), (0.037, 0.05), (0.028, -0.045), (0.0, -0.045)];
        for shape in [
            Shape::Sphere { radius: 0.05 },
            Shape::Block { half: Vec3::new(0.4, 0.05, 0.02) },
            Shape::Capsule { half: 0.1, radius: 0.01 },
            Shape::Cylinder { half: 0.1, radius: 0.02 },
            Shape::Superquadric(Superquadric { half: Vec3::new(0.06, 0.05, 0.03), side: 0.4, above: 1.0 }),
            Shape::Lathe(Arc::new(Lathe::new(&cup))),
        ] {
            let solid = Solid::new(shape, Vec3::ZERO, Mat3::IDENTITY);
            let made = Triangles::of(&solid, &|_| 0.01);
            let mut volume = 0.0;
            for triangle in &made.faces {
                let [a, b, c] = triangle.map(|i| made.corners[i as usize]);
                volume += a.dot(b.cross(c)) / 6.0;
                for i in triangle {
                    let off = solid.distance(made.corners[*i as usize]).abs();
                    assert!(off < 1e-5, "{:?}: a corner lies {off} m off", solid.shape);
                }
                // Chords stay near a round surface.
                let middle = solid.distance((a + b + c) / 3.0).abs();
                assert!(middle < 5e-4, "{:?}: the middle of a face lies {middle} m off", solid.shape);
                let outward: Vec3 = triangle.iter().map(|i| made.normals[*i as usize]).sum();
                assert!((b - a).cross(c - a).dot(outward) >= 0.0, "{:?}", solid.shape);
            }
            // The volume by a count of points inside, in the box around the corners.
            let low = made.corners.iter().copied().reduce(Vec3::min).unwrap();
            let high = made.corners.iter().copied().reduce(Vec3::max).unwrap();
            let n = 40;
            let part = |i: usize| (i as f32 + 0.5) / n as f32;
            let points = (0..n).flat_map(|x| (0..n).flat_map(move |y| (0..n).map(move |z| [x, y, z])));
            let is_inside =
                |p: &[usize; 3]| solid.distance(low + Vec3::from(p.map(part)) * (high - low)) < 0.0;
            let share = points.filter(is_inside).count() as f32 / (n * n * n) as f32;
            let counted = share * (high - low).element_product();
            assert!((volume / counted - 1.0).abs() < 0.1, "{:?}: {volume} {counted}", solid.shape);
        }
    }

    #[test]
    fn a_room_looks_inwards_and_near_parts_are_finer() {
        let room = (Vec3::splat(-1.0), Vec3::new(1.0, 2.0, 1.5));
        let middle = Vec3::new(0.0, 0.5, 0.25);
        for face in 0..6 {
            let made = Triangles::of_room(room, face, &|p| if p.dot(Vec3::ONE) > 0.5 { 0.02 } else { 0.25 });
            let wall = if face % 2 == 0 { room.0 } else { room.1 };
            for (p, n) in made.corners.iter().zip(&made.normals) {
                assert!((*p - wall)[face / 2].abs() < 1e-5 && n.dot(middle - *p) > 0.0, "{face}: {p} {n}");
            }
            for t in &made.faces {
                let [a, b, c] = t.map(|i| made.corners[i as usize]);
                assert!((b - a).cross(c - a).dot(middle - a) > 0.0, "{face}");
            }
            let near = made.corners.iter().filter(|p| p.dot(Vec3::ONE) > 0.7).count();
            let far = made.corners.iter().filter(|p| p.dot(Vec3::ONE) < 0.3).count();
            assert!(near > 3 * far, "{face}: {near} {far}");
        }
    }
}
