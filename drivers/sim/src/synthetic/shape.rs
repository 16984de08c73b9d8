//! Solid shapes that a ray can meet: spheres, blocks, capsules, capped cylinders, superquadrics, solids of revolution and
//! meshes, each in its own frame.

use glam::{Mat3, Vec3};
use std::sync::Arc;

mod dice;
mod lathe;
mod mesh;
mod superquadric;

pub(crate) use dice::Triangles;
pub(crate) use lathe::Lathe;
pub(crate) use mesh::Mesh;
pub(crate) use superquadric::Superquadric;

/// A solid around the origin of its own frame.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Shape {
    Sphere {
        radius: f32,
    },
    Block {
        half: Vec3,
    },
    /// A rod along z with round ends; `half` is half the distance of the ends' centres.
    Capsule {
        half: f32,
        radius: f32,
    },
    /// A rod along z with flat ends.
    Cylinder {
        half: f32,
        radius: f32,
    },
    Superquadric(Superquadric),
    Lathe(Arc<Lathe>),
    Mesh(Arc<Mesh>),
}

/// A shape with its place in the world.
#[derive(Debug, Clone)]
pub(crate) struct Solid {
    pub(crate) shape: Shape,
    pub(crate) center: Vec3,
    /// Columns are the shape's axes in the world.
    pub(crate) axes: Mat3,
    /// Radius of a sphere around `center` that holds it.
    pub(crate) bound: f32,
    /// Its square, with a little margin for rounding.
    bound_squared: f32,
}

impl Solid {
    pub(crate) fn new(shape: Shape, center: Vec3, axes: Mat3) -> Self {
        let bound = match &shape {
            Shape::Sphere { radius } => *radius,
            Shape::Block { half } => half.length(),
            Shape::Capsule { half, radius } => half + radius,
            Shape::Cylinder { half, radius } => half.hypot(*radius),
            Shape::Superquadric(s) => s.half.length(),
            Shape::Lathe(s) => s.bound(),
            Shape::Mesh(s) => s.bound(),
        };
        Self { shape, center, axes, bound, bound_squared: bound * bound * 1.001 + 1e-8 }
    }

    /// The point of the world in the shape's own frame.
    pub(crate) fn to_local(&self, p: Vec3) -> Vec3 {
        self.axes.transpose() * (p - self.center)
    }

    /// Distance along the ray at which it enters the solid, if that lies within `near..far`. A ray that
    /// begins inside meets the far side.
    pub(crate) fn meet(&self, from: Vec3, dir: Vec3, near: f32, far: f32) -> Option<f32> {
        // Most rays miss the sphere around the solid: this is where rendering spends its time.
        let to = self.center - from;
        let along = to.dot(dir);
        let dd = dir.dot(dir);
        let tt = to.dot(to);
        let outside = tt - self.bound_squared;
        if outside > 0.0 && (along < 0.0 || (outside - 1e-6 * tt) * dd > along * along) {
            return None;
        }
        let o = self.axes.transpose() * -to;
        let d = self.axes.transpose() * dir;
        match &self.shape {
            Shape::Sphere { radius } => first(sphere(o, d, *radius)?, near, far),
            Shape::Block { half } => first(slabs(o, d, *half)?, near, far),
            Shape::Cylinder { half, radius } => first(cylinder(o, d, *half, *radius)?, near, far),
            Shape::Superquadric(s) => s.meet(o, d, near, far),
            Shape::Lathe(s) => s.meet(o, d, near, far),
            Shape::Mesh(s) => s.meet(o, d, near, far).map(|hit| hit.t),
            &Shape::Capsule { half, radius } => {
                // The union of three convex pieces: the first entry counts, and a ray from inside leaves last.
                let pieces = [
                    cylinder(o, d, half, radius),
                    sphere(o - Vec3::Z * half, d, radius),
                    sphere(o + Vec3::Z * half, d, radius),
                ];
                let mut enter = f32::INFINITY;
                let mut leave = f32::NEG_INFINITY;
                for (a, b) in pieces.into_iter().flatten() {
                    (enter, leave) = (enter.min(a), leave.max(b));
                }
                first((enter, leave), near, far)
            }
        }
    }

    /// Outward normal at a point of the surface, in the shape's frame, and the number of the face.
    pub(crate) fn normal_local(&self, p: Vec3) -> (Vec3, u16) {
        match &self.shape {
            Shape::Sphere { .. } => (p.normalize_or(Vec3::Z), 0),
            Shape::Block { half } => {
                // The face whose plane is nearest.
                let off = (p.abs() - *half).abs();
                if off.x < off.y && off.x < off.z {
                    (Vec3::X * p.x.signum(), u16::from(p.x > 0.0))
                } else if off.y < off.z {
                    (Vec3::Y * p.y.signum(), 2 + u16::from(p.y > 0.0))
                } else {
                    (Vec3::Z * p.z.signum(), 4 + u16::from(p.z > 0.0))
                }
            }
            Shape::Capsule { half, .. } => {
                ((p - Vec3::Z * p.z.clamp(-*half, *half)).normalize_or(Vec3::X), 0)
            }
            Shape::Cylinder { half, radius } => {
                let to_side = (p.x.hypot(p.y) - radius).abs();
                if to_side < (p.z.abs() - half).abs() {
                    (Vec3::new(p.x, p.y, 0.0).normalize_or(Vec3::X), 0)
                } else {
                    (Vec3::Z * p.z.signum(), 1 + u16::from(p.z > 0.0))
                }
            }
            Shape::Superquadric(s) => (s.normal(p), 0),
            Shape::Lathe(s) => (s.normal(p), 0),
            // A point does not say which triangle it is on: `normal_met` does.
            Shape::Mesh(_) => (Vec3::Z, 0),
        }
    }

    /// Normal in the shape's frame where a ray meets the solid at distance `t`: outward; of meshes towards the ray's side.
    pub(crate) fn normal_met(&self, from: Vec3, dir: Vec3, t: f32) -> Vec3 {
        let Shape::Mesh(mesh) = &self.shape else {
            return self.normal_local(self.to_local(from + dir * t)).0;
        };
        let o = self.to_local(from);
        let d = self.axes.transpose() * dir;
        let margin = 1e-5 * t + 1e-7;
        mesh.meet(o, d, t - margin, t + margin).map_or(-d.normalize_or(Vec3::Z), |hit| mesh.normal(hit, d))
    }

    /// Whether the solid can hide a spot of its own surface from a place that the spot faces.
    pub(crate) const fn is_hollow(&self) -> bool {
        matches!(self.shape, Shape::Lathe(_) | Shape::Mesh(_))
    }

    /// Whether the surface can be nearer than `reach` to a point of the world; a quick look that may say yes
    /// too often.
    pub(crate) fn is_within(&self, p: Vec3, reach: f32) -> bool {
        (p - self.center).length_squared() < (self.bound + reach) * (self.bound + reach)
    }

    /// Distance of a point of the world from the surface, negative inside.
    pub(crate) fn distance(&self, p: Vec3) -> f32 {
        let q = self.to_local(p);
        match &self.shape {
            Shape::Sphere { radius } => q.length() - radius,
            Shape::Block { half } => {
                let e = q.abs() - *half;
                e.max(Vec3::ZERO).length() + e.max_element().min(0.0)
            }
            Shape::Capsule { half, radius } => (q - Vec3::Z * q.z.clamp(-*half, *half)).length() - radius,
            Shape::Cylinder { half, radius } => {
                let r = q.x.hypot(q.y) - radius;
                let h = q.z.abs() - half;
                r.max(0.0).hypot(h.max(0.0)) + r.max(h).min(0.0)
            }
            Shape::Superquadric(s) => s.distance(q),
            Shape::Lathe(s) => s.distance(q),
            // Too far to matter to a contact shade; the sphere around it is what a camera keeps clear of.
            Shape::Mesh(s) => q.length() - s.bound(),
        }
    }
}

fn first((enter, leave): (f32, f32), near: f32, far: f32) -> Option<f32> {
    let t = if enter > near { enter } else { leave };
    (t > near && t < far).then_some(t)
}

fn sphere(o: Vec3, d: Vec3, radius: f32) -> Option<(f32, f32)> {
    let a = d.dot(d);
    let b = o.dot(d);
    // The distance of the line from the centre first: no cancellation for far, small spheres.
    let off = o - d * (b / a);
    let rest = radius * radius - off.dot(off);
    if rest < 0.0 {
        return None;
    }
    let half = (rest / a).sqrt();
    Some((-b / a - half, -b / a + half))
}

fn slabs(o: Vec3, d: Vec3, half: Vec3) -> Option<(f32, f32)> {
    let inverse = d.recip();
    let a = (-half - o) * inverse;
    let b = (half - o) * inverse;
    let enter = a.min(b).max_element();
    let leave = a.max(b).min_element();
    (enter <= leave).then_some((enter, leave))
}

fn cylinder(o: Vec3, d: Vec3, half: f32, radius: f32) -> Option<(f32, f32)> {
    let a = d.x * d.x + d.y * d.y;
    let (low, high) = {
        let s = (-half - o.z) / d.z;
        let t = (half - o.z) / d.z;
        if s < t { (s, t) } else { (t, s) }
    };
    if a < 1e-12 {
        return (o.x.hypot(o.y) < radius).then_some((low, high));
    }
    let b = o.x * d.x + o.y * d.y;
    let cross = o.x * d.y - o.y * d.x;
    let rest = radius * radius * a - cross * cross;
    if rest < 0.0 {
        return None;
    }
    let root = rest.sqrt();
    let mut enter = (-b - root) / a;
    let mut leave = (-b + root) / a;
    if d.z.abs() < 1e-9 {
        return (o.z.abs() < half).then_some((enter, leave));
    }
    (enter, leave) = (enter.max(low), leave.min(high));
    (enter <= leave).then_some((enter, leave))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn shapes() -> impl Strategy<Value = Shape> {
        let size = 0.05f32..1.0;
        prop_oneof![
            size.clone().prop_map(|radius| Shape::Sphere { radius }),
            (size.clone(), size.clone(), size.clone())
                .prop_map(|(x, y, z)| Shape::Block { half: Vec3::new(x, y, z) }),
            (size.clone(), size.clone()).prop_map(|(half, radius)| Shape::Capsule { half, radius }),
            (size.clone(), size.clone()).prop_map(|(half, radius)| Shape::Cylinder { half, radius }),
            (size.clone(), size.clone(), size.clone(), 0.25f32..2.0, 0.25f32..2.0).prop_map(
                |(x, y, z, side, above)| {
                    Shape::Superquadric(Superquadric { half: Vec3::new(x, y, z), side, above })
                }
            ),
            // A cup: up the outside and down the inside.
            (size.clone(), size.clone(), size, 0.02f32..0.04).prop_map(|(foot, rim, height, wall)| {
                let bent = (foot + rim) * 0.55;
                let outline = [
                    (0.0, -height),
                    (foot, -height),
                    (bent, 0.0),
                    (rim, height),
                    (rim - wall, height),
                    (bent - wall, 0.0),
                    (0.0, wall - height),
                ];
                Shape::Lathe(Arc::new(Lathe::new(&outline)))
            }),
        ]
    }

    fn vectors(r: f32) -> impl Strategy<Value = Vec3> {
        (-r..r, -r..r, -r..r).prop_map(|(x, y, z)| Vec3::new(x, y, z))
    }

    /// Walks along the ray by the distance to the surface: slow, and obviously right.
    fn walk(solid: &Solid, from: Vec3, dir: Vec3) -> Option<f32> {
        let mut t = 0.0;
        for _ in 0..20_000 {
            let d = solid.distance(from + dir * t);
            if d < 1e-5 {
                return Some(t);
            }
            t += d;
            if t > 20.0 {
                return None;
            }
        }
        None
    }

    proptest! {
        #[test]
        fn meets_where_walking_meets(
            shape in shapes(), center in vectors(1.0), spin in vectors(3.0), from in vectors(4.0), dir in vectors(1.0),
        ) {
            prop_assume!(dir.length() > 0.1);
            let dir = dir.normalize();
            let axes = Mat3::from_euler(glam::EulerRot::XYZ, spin.x, spin.y, spin.z);
            let solid = Solid::new(shape, center, axes);
            prop_assume!(solid.distance(from) > 0.01);
            let met = solid.meet(from, dir, 1e-4, f32::INFINITY);
            match (met, walk(&solid, from, dir)) {
                (Some(a), Some(b)) => {
                    prop_assert!((a - b).abs() < 5e-3, "{a} {b}");
                    let p = from + dir * a;
                    prop_assert!(solid.distance(p).abs() < 1e-4);
                    prop_assert!((p - center).length() <= solid.bound + 1e-4);
                    // Smoothed normals and estimated distances are no measure.
                    if !matches!(solid.shape, Shape::Lathe(_) | Shape::Superquadric(_)) {
                        let n = solid.axes * solid.normal_local(solid.to_local(p)).0;
                        prop_assert!(n.dot(dir) < 0.02, "the side that is seen faces the camera");
                        // Half a millimetre outside along the normal is half a millimetre from the surface.
                        prop_assert!((solid.distance(p + n * 5e-4) - 5e-4).abs() < 1e-4);
                    }
                }
                (None, None) => {}
                // A ray that grazes may be judged either way.
                (a, b) => {
                    let t = a.or(b).unwrap_or_default();
                    let near = (0..200).map(|i| solid.distance(from + dir * (t + (i as f32 - 100.0) * 1e-3)));
                    prop_assert!(near.fold(f32::INFINITY, f32::min) > -2e-3, "{a:?} {b:?}");
                }
            }
        }
    }

    #[test]
    fn a_ray_from_inside_meets_the_far_side() {
        let block = Solid::new(Shape::Block { half: Vec3::ONE }, Vec3::ZERO, Mat3::IDENTITY);
        assert_eq!(block.meet(Vec3::ZERO, Vec3::X, 1e-4, 10.0), Some(1.0));
        assert_eq!(block.meet(Vec3::ZERO, Vec3::X, 1e-4, 0.5), None);
    }
}
