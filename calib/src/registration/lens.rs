//! Colour's lens in 32-bit floats, as a type of its own, so that the loop over pixels is compiled for each.
#![allow(clippy::inline_always, reason = "what is not inlined is compiled for the oldest processor")]

/// Where a lens shows the point (x, y) of the plane z = 1. The formulas are those of `camera/lens.rs`.
pub(super) trait Lens32: Copy {
    fn shown(self, x: f32, y: f32) -> (f32, f32);

    /// How far from (`u`, `v`), where it shows (x, y), it shows the point that is (dx, dy) beside it.
    #[inline(always)]
    fn beside(self, x: f32, y: f32, u: f32, v: f32, dx: f32, dy: f32) -> (f32, f32) {
        let there = self.shown(x + dx, y + dy);
        (there.0 - u, there.1 - v)
    }
}

/// No distortion.
#[derive(Debug, Clone, Copy)]
pub(super) struct Straight;

impl Lens32 for Straight {
    #[inline(always)]
    fn shown(self, x: f32, y: f32) -> (f32, f32) {
        (x, y)
    }

    #[inline(always)]
    fn beside(self, _: f32, _: f32, _: f32, _: f32, dx: f32, dy: f32) -> (f32, f32) {
        (dx, dy)
    }
}

/// `k1 k2 p1 p2 k3 k4 k5 k6`.
#[derive(Debug, Clone, Copy)]
pub(super) struct Rational(pub(super) [f32; 8]);

impl Lens32 for Rational {
    #[inline(always)]
    fn shown(self, x: f32, y: f32) -> (f32, f32) {
        let [k1, k2, p1, p2, k3, k4, k5, k6] = self.0;
        let r2 = x * x + y * y;
        let top = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
        let s = top / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)));
        let xy = 2.0 * x * y;
        (s * x + (p1 * xy + p2 * (r2 + 2.0 * x * x)), s * y + (p1 * (r2 + 2.0 * y * y) + p2 * xy))
    }

    /// By the derivative, whose divisions are those of [`Self::shown`].
    #[inline(always)]
    fn beside(self, x: f32, y: f32, _: f32, _: f32, dx: f32, dy: f32) -> (f32, f32) {
        let [k1, k2, p1, p2, k3, k4, k5, k6] = self.0;
        let r2 = x * x + y * y;
        let top = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
        let bottom = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6));
        let s = top / bottom;
        let d_r2 = 2.0 * (x * dx + y * dy);
        let d_top = d_r2 * (k1 + r2 * (2.0 * k2 + r2 * (3.0 * k3)));
        let d_bottom = d_r2 * (k4 + r2 * (2.0 * k5 + r2 * (3.0 * k6)));
        let d_s = (d_top - s * d_bottom) / bottom;
        let d_xy = 2.0 * (x * dy + y * dx);
        let d_tangent_x = p1 * d_xy + p2 * (d_r2 + 4.0 * x * dx);
        let d_tangent_y = p1 * (d_r2 + 4.0 * y * dy) + p2 * d_xy;
        (s * dx + x * d_s + d_tangent_x, s * dy + y * d_s + d_tangent_y)
    }
}

/// `k1 k2 p1 p2 k3`.
#[derive(Debug, Clone, Copy)]
pub(super) struct InverseBrownConrady(pub(super) [f32; 5]);

impl Lens32 for InverseBrownConrady {
    #[inline(always)]
    fn shown(self, x: f32, y: f32) -> (f32, f32) {
        let [k1, k2, p1, p2, k3] = self.0;
        let r2 = x * x + y * y;
        let s = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
        let x = x * s;
        let y = y * s;
        let xy = 2.0 * x * y;
        (x + (p1 * xy + p2 * (r2 + 2.0 * x * x)), y + (p1 * (r2 + 2.0 * y * y) + p2 * xy))
    }
}

/// `k1 k2 k3 k4`.
#[derive(Debug, Clone, Copy)]
pub(super) struct KannalaBrandt(pub(super) [f32; 4]);

impl Lens32 for KannalaBrandt {
    #[inline(always)]
    fn shown(self, x: f32, y: f32) -> (f32, f32) {
        let [k1, k2, k3, k4] = self.0;
        let r = (x * x + y * y).sqrt();
        let theta = r.atan();
        let t2 = theta * theta;
        let shown = theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))));
        let s = if r > 1e-6 { shown / r } else { 1.0 };
        (s * x, s * y)
    }
}
