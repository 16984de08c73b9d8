//! Appearance as data: the surfaces of random worlds. All patterns are functions of space, so that no shape has a seam.

use super::super::noise::{lattice, smooth2, smooth3};
use super::{Infrared, Surface};
use glam::Vec3;

/// How two colours share a surface.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Pattern {
    Plain,
    /// Soft clouds of several sizes.
    Cloud,
    /// Thin veins through clouds.
    Marble,
    /// Long fibres along x.
    Grain,
    /// Bands along a slanted direction.
    Stripes,
    /// Cubes in turn.
    Checks,
    /// Round spots.
    Dots,
    /// Small cells at random.
    Speckle,
    /// Lines of a print on a ground.
    Print,
    /// Tiles with gaps.
    Tiles,
}

/// The look of a thing of a random world.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Look {
    pub(crate) surface: Surface,
    pub(crate) pattern: Pattern,
    /// Linear RGB; that of glass is what it lets through.
    pub(crate) colors: [Vec3; 2],
    /// Periods per metre.
    pub(crate) scale: f32,
    /// Picks the noise field.
    pub(crate) layer: i32,
    pub(crate) infrared: Infrared,
}

impl Look {
    /// Base colour at a point in the thing's frame; `blur_m` is the width of a pixel there.
    pub(crate) fn color(&self, p: Vec3, n: Vec3, blur_m: f32) -> Vec3 {
        if self.pattern == Pattern::Plain {
            return self.colors[0];
        }
        // A shift keeps faces at 0 off the edges of cells.
        let q = p * self.scale + Vec3::splat(0.371);
        // Patterns finer than a pixel are their mean.
        let blur = (blur_m * self.scale).max(1e-4);
        let part = self.part(q, n, blur);
        let fade = ((0.8 - blur) / 0.4).clamp(0.0, 1.0);
        self.colors[0].lerp(self.colors[1], 0.5 + (part - 0.5) * fade)
    }

    /// The second colour's part.
    fn part(&self, q: Vec3, n: Vec3, blur: f32) -> f32 {
        let layer = self.layer;
        match self.pattern {
            Pattern::Plain => 0.0,
            Pattern::Cloud => clouds(q, layer),
            Pattern::Marble => {
                let vein = (q.x + q.y * 0.6 + 3.0 * clouds(q * 0.7, layer)).sin().abs();
                (1.0 - vein * 2.5).max(0.0)
            }
            Pattern::Grain => {
                let wave = smooth3(Vec3::new(q.x * 0.2, q.y, q.z), layer) * 4.0;
                let ring = (q.y * 5.0 + q.z * 2.0 + wave * 3.0).sin() * 0.5 + 0.5;
                0.65 * ring + 0.35 * smooth3(Vec3::new(q.x * 0.7, q.y * 11.0, q.z * 11.0), layer + 1)
            }
            Pattern::Stripes => band(q.z + 0.4 * q.x + 0.3 * q.y, 0.5, blur),
            Pattern::Checks => {
                let side = |v: f32| band(v * 0.5, 0.5, blur * 0.5) * 2.0 - 1.0;
                0.5 + 0.5 * side(q.x) * side(q.y) * side(q.z)
            }
            Pattern::Dots => {
                let cell = q.floor();
                let r = lattice(cell.x as i32, cell.y as i32, cell.z as i32 ^ layer);
                let off = q - cell - Vec3::splat(0.5);
                ramp(0.15 + 0.3 * r - off.length(), blur)
            }
            Pattern::Speckle => {
                let cell = q.floor();
                lattice(cell.x as i32, cell.y as i32, cell.z as i32 ^ layer)
            }
            Pattern::Print => print(q, n, layer, blur),
            Pattern::Tiles => {
                let gap = |v: f32, flat: f32| {
                    if flat.abs() > 0.7 { 0.0 } else { ramp((v - v.floor() - 0.5).abs() - 0.485, blur) }
                };
                gap(q.x, n.x).max(gap(q.y, n.y)).max(gap(q.z, n.z))
            }
        }
    }
}

/// Whether a surface keeps a depth camera from seeing it by being dark.
pub(crate) const DARK_ALBEDO: f32 = 0.05;

fn clouds(q: Vec3, layer: i32) -> f32 {
    (smooth3(q, layer) * 4.0 + smooth3(q * 2.1, layer + 1) * 2.0 + smooth3(q * 4.3, layer + 2)) / 7.0
}

/// 0 to 1 around 0, over a pixel.
fn ramp(x: f32, blur: f32) -> f32 {
    (x / blur + 0.5).clamp(0.0, 1.0)
}

/// 1 for `share` of every period, with edges of a pixel.
fn band(x: f32, share: f32, blur: f32) -> f32 {
    let x = x - x.floor();
    ramp(x, blur).min(ramp(share - x, blur)).max(ramp(x - 1.0, blur))
}

/// Rows of words and a block of colour: a label.
fn print(q: Vec3, n: Vec3, layer: i32, blur: f32) -> f32 {
    let [u, v] = match n.abs() {
        a if a.x > a.y && a.x > a.z => [q.y, q.z],
        a if a.y > a.z => [q.x, q.z],
        _ => [q.x, q.y],
    };
    let field = lattice((u / 9.0).floor() as i32, (v / 7.0).floor() as i32, layer);
    if field > 0.72 {
        return 1.0;
    }
    let row = (v * 1.6).floor();
    if field < 0.2 || lattice(row as i32, 3, layer) < 0.25 {
        return 0.0;
    }
    let word = smooth2(u * 3.5, row * 7.3, layer) + 0.25 * smooth2(u * 11.0, row * 5.1, layer + 1);
    ramp(word - 0.55, 0.2) * band(v * 1.6, 0.55, blur * 1.6)
}
