//! Solids of revolution: cups, bottles, bowls, plates. The outline is a polygon of radius and height; each of its sides
//! is a piece of a cone.

use glam::{DVec2, DVec3, Vec3};

/// Sides that meet at less than this angle (its cosine) look round.
const ROUND: f64 = 0.76;

/// The outline of a solid of revolution around z: from the axis to the axis, the solid on its left.
#[derive(Debug, PartialEq)]
pub(crate) struct Lathe {
    sides: Vec<Side>,
    radius: f64,
    low: f64,
    high: f64,
}

#[derive(Debug, PartialEq)]
struct Side {
    /// Radius and height of both ends.
    a: DVec2,
    b: DVec2,
    /// Outward normals at the middle and, smoothed, at both ends.
    normal: DVec2,
    normal_a: DVec2,
    normal_b: DVec2,
}

impl Lathe {
    /// The solid with this outline (radius, height), which begins and ends on the axis and runs with the solid on its
    /// left, as seen with the radius to the right and the height up: up the outside, down the inside of a cup.
    pub(crate) fn new(outline: &[(f32, f32)]) -> Self {
        let points: Vec<DVec2> =
            outline.iter().map(|(r, z)| DVec2::new(f64::from(*r), f64::from(*z))).collect();
        let ends: Vec<(DVec2, DVec2)> =
            points.windows(2).map(|w| (w[0], w[1])).filter(|(a, b)| (*b - *a).length() > 1e-7).collect();
        let normals: Vec<DVec2> = ends.iter().map(|(a, b)| -(*b - *a).normalize().perp()).collect();
        let joint = |i: usize, j: Option<usize>| {
            let own = normals[i];
            match j.and_then(|j| normals.get(j)) {
                Some(other) if own.dot(*other) > ROUND => (own + *other).normalize(),
                _ => own,
            }
        };
        let sides = ends.iter().enumerate().map(|(i, (a, b))| Side {
            a: *a,
            b: *b,
            normal: normals[i],
            normal_a: joint(i, i.checked_sub(1)),
            normal_b: joint(i, Some(i + 1)),
        });
        let heights = || points.iter().map(|p| p.y);
        Self {
            sides: sides.collect(),
            radius: points.iter().map(|p| p.x).fold(0.0, f64::max),
            low: heights().fold(f64::INFINITY, f64::min),
            high: heights().fold(f64::NEG_INFINITY, f64::max),
        }
    }

    /// Radius and height of the outline's corners.
    pub(crate) fn outline(&self) -> Vec<(f64, f64)> {
        self.sides.iter().map(|s| s.a).chain(self.sides.last().map(|s| s.b)).map(|p| (p.x, p.y)).collect()
    }

    /// Radius of a sphere around the origin that holds it.
    pub(crate) fn bound(&self) -> f32 {
        self.sides.iter().flat_map(|s| [s.a, s.b]).map(DVec2::length).fold(0.0, f64::max) as f32
    }

    /// The first crossing of the surface within `near..far`.
    pub(crate) fn meet(&self, o: Vec3, d: Vec3, near: f32, far: f32) -> Option<f32> {
        let d = d.as_dvec3();
        // From the point of the line that is nearest to the origin: no cancellation for far, small things.
        let shift = -o.as_dvec3().dot(d) / d.dot(d);
        let o = o.as_dvec3() + d * shift;
        let (enter, leave) = self.within(o, d)?;
        let (low, high) = {
            let a = o.z + d.z * enter;
            let b = o.z + d.z * leave;
            (a.min(b) - 1e-6, a.max(b) + 1e-6)
        };
        let near = f64::from(near) - shift;
        let mut best = f64::from(far) - shift;
        let mut is_met = false;
        for side in &self.sides {
            if side.a.y.max(side.b.y) < low || side.a.y.min(side.b.y) > high {
                continue;
            }
            for t in side.cross(o, d).into_iter().flatten() {
                if t > near && t < best {
                    best = t;
                    is_met = true;
                }
            }
        }
        is_met.then_some((best + shift) as f32)
    }

    /// Where a line is inside the cylinder that holds the solid.
    fn within(&self, o: DVec3, d: DVec3) -> Option<(f64, f64)> {
        let a = d.x * d.x + d.y * d.y;
        let mut enter = f64::NEG_INFINITY;
        let mut leave = f64::INFINITY;
        if a > 1e-18 {
            let b = o.x * d.x + o.y * d.y;
            let rest = b * b - a * (o.x * o.x + o.y * o.y - self.radius * self.radius);
            if rest < 0.0 {
                return None;
            }
            (enter, leave) = ((-b - rest.sqrt()) / a, (-b + rest.sqrt()) / a);
        }
        if d.z.abs() > 1e-12 {
            let s = (self.low - o.z) / d.z;
            let t = (self.high - o.z) / d.z;
            (enter, leave) = (enter.max(s.min(t)), leave.min(s.max(t)));
        } else if !(self.low..=self.high).contains(&o.z) {
            return None;
        }
        (enter <= leave).then_some((enter, leave))
    }

    /// The side nearest to a point of the surface, and where along it (0..1).
    fn nearest(&self, p: DVec2) -> Option<(&Side, f64, f64)> {
        let of = |side: &Side| {
            let way = side.b - side.a;
            let along = ((p - side.a).dot(way) / way.length_squared()).clamp(0.0, 1.0);
            (along, (side.a + way * along - p).length_squared())
        };
        let mut best: Option<(&Side, f64, f64)> = None;
        for side in &self.sides {
            let (along, off) = of(side);
            if best.is_none_or(|b| off < b.2) {
                best = Some((side, along, off));
            }
        }
        best
    }

    /// Outward normal at a point of the surface, smooth where the outline bends little.
    pub(crate) fn normal(&self, p: Vec3) -> Vec3 {
        let r = f64::from(p.x).hypot(f64::from(p.y));
        let Some((side, along, _)) = self.nearest(DVec2::new(r, f64::from(p.z))) else { return Vec3::Z };
        let n = if along < 0.5 {
            side.normal_a.lerp(side.normal, along * 2.0)
        } else {
            side.normal.lerp(side.normal_b, along * 2.0 - 1.0)
        };
        let out = if r > 1e-9 { DVec2::new(f64::from(p.x), f64::from(p.y)) / r } else { DVec2::X };
        DVec3::new(out.x * n.x, out.y * n.x, n.y).normalize_or(DVec3::Z).as_vec3()
    }

    /// Distance from the surface, negative inside.
    pub(crate) fn distance(&self, p: Vec3) -> f32 {
        let q = DVec2::new(f64::from(p.x).hypot(f64::from(p.y)), f64::from(p.z));
        let off = self.nearest(q).map_or(f64::INFINITY, |(_, _, off)| off.sqrt());
        if self.holds(q) { -off as f32 } else { off as f32 }
    }

    /// Whether a radius and height are inside: a ray outwards crosses the outline an odd number of times.
    fn holds(&self, q: DVec2) -> bool {
        let crosses = |s: &&Side| {
            (s.a.y > q.y) != (s.b.y > q.y) && q.x < s.a.x + (q.y - s.a.y) / (s.b.y - s.a.y) * (s.b.x - s.a.x)
        };
        self.sides.iter().filter(crosses).count() % 2 == 1
    }
}

impl Side {
    /// Where a line crosses this piece of a cone.
    fn cross(&self, o: DVec3, d: DVec3) -> [Option<f64>; 2] {
        let rise = self.b.y - self.a.y;
        if rise.abs() < 1e-9 {
            let t = (self.a.y - o.z) / d.z;
            let r = (o.x + d.x * t).hypot(o.y + d.y * t);
            let is_on = t.is_finite() && r >= self.a.x.min(self.b.x) && r <= self.a.x.max(self.b.x);
            return [is_on.then_some(t), None];
        }
        // The radius along the line is `start + slope t`.
        let widening = (self.b.x - self.a.x) / rise;
        let start = self.a.x + widening * (o.z - self.a.y);
        let slope = widening * d.z;
        let a = d.x * d.x + d.y * d.y - slope * slope;
        let b = o.x * d.x + o.y * d.y - start * slope;
        let c = o.x * o.x + o.y * o.y - start * start;
        let is_on = |t: &f64| {
            let z = o.z + d.z * t;
            t.is_finite()
                && start + slope * t >= 0.0
                && z >= self.a.y.min(self.b.y) - 1e-12
                && z <= self.a.y.max(self.b.y) + 1e-12
        };
        if a.abs() < 1e-14 {
            return [Some(-c / (2.0 * b)).filter(is_on), None];
        }
        let rest = b * b - a * c;
        if rest < 0.0 {
            return [None, None];
        }
        // The root without cancellation, and the other by their product.
        let q = -(b + rest.sqrt().copysign(b));
        [Some(q / a).filter(is_on), Some(c / q).filter(is_on)]
    }
}
