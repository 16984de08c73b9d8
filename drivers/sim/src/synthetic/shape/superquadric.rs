//! Convex superquadrics, `((|x/a|^(2/e2) + |y/b|^(2/e2))^(e2/e1) + |z/c|^(2/e1)) = 1` (Barr 1981): from boxes with
//! round edges (small exponents) over ellipsoids (1) to double cones (2).

use glam::Vec3;

/// A superquadric around the origin. Exponents of 0.2 to 2 keep it convex and single precision sufficient.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Superquadric {
    pub(crate) half: Vec3,
    /// Exponent of the outline from the side.
    pub(crate) side: f32,
    /// Exponent of the outline from above.
    pub(crate) above: f32,
}

impl Superquadric {
    /// How much the solid must grow for its surface to hold `p`: a convex function that doubles with `p`. The gradient
    /// comes with it.
    pub(crate) fn gauge(&self, p: Vec3) -> (f32, Vec3) {
        let q = p.abs() / self.half;
        let sign = Vec3::ONE.copysign(p) / self.half;
        let (ring, ring_x, ring_y) = norm(q.x, q.y, 2.0 / self.above);
        let (all, by_ring, by_z) = norm(ring, q.z, 2.0 / self.side);
        (all, Vec3::new(by_ring * ring_x, by_ring * ring_y, by_z) * sign)
    }

    /// The first crossing of the surface within `near..far`.
    pub(crate) fn meet(&self, o: Vec3, d: Vec3, near: f32, far: f32) -> Option<f32> {
        let (enter, leave) = super::slabs(o, d, self.half)?;
        if leave <= near || enter >= far {
            return None;
        }
        let within = |t: &f32| *t > near && *t < far;
        let first = self.newton(o, d, enter, 1.0)?;
        if first > near {
            return Some(first).filter(within);
        }
        self.newton(o, d, leave, -1.0).filter(within)
    }

    /// Walks from outside towards the surface. Along a line the gauge is convex, so that Newton's steps from outside never
    /// pass the crossing, and a slope that no longer falls says that the line misses.
    fn newton(&self, o: Vec3, d: Vec3, mut t: f32, way: f32) -> Option<f32> {
        let size = self.half.max_element() / d.length();
        for _ in 0..40 {
            let (g, gradient) = self.gauge(o + d * t);
            if g <= 1.0 {
                break;
            }
            let slope = gradient.dot(d) * way;
            if slope >= 0.0 {
                return None;
            }
            let step = (g - 1.0) / -slope;
            if step > 4.0 * size {
                return None;
            }
            t += way * step;
            if step < 2e-7 * size {
                break;
            }
        }
        // Steps that still shrink after so many graze the surface.
        (self.gauge(o + d * t).0 < 1.0 + 1e-4).then_some(t)
    }

    /// Outward normal at a point near the surface.
    pub(crate) fn normal(&self, p: Vec3) -> Vec3 {
        self.gauge(p).1.normalize_or(Vec3::Z)
    }

    /// About the distance from the surface; never more outside.
    pub(crate) fn distance(&self, p: Vec3) -> f32 {
        let (g, gradient) = self.gauge(p);
        (g - 1.0) / gradient.length().max(1.0 / self.half.max_element())
    }
}

/// The `power` norm of two numbers that are not negative, and its slopes.
fn norm(a: f32, b: f32, power: f32) -> (f32, f32, f32) {
    let most = a.max(b);
    if most < 1e-12 {
        return (0.0, 0.0, 0.0);
    }
    // The larger one counts as 1, so that one power of the smaller one is enough.
    let ratio = a.min(b) / most;
    let less = ratio.powf(power - 1.0);
    let sum = 1.0 + less * ratio;
    let share = sum.powf(1.0 / power - 1.0);
    let root = most * share * sum;
    if a >= b { (root, share, share * less) } else { (root, share * less, share) }
}
