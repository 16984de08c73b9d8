//! Random materials: diffuse, glossy, metal, glass, dark.

use super::super::texture::{DARK_ALBEDO, Infrared, Look, Paint, Pattern, Surface};
use super::draw::Draw;
use glam::Vec3;

/// Weights of the kinds of material, in the order diffuse, glossy, metal, glass, dark.
pub(crate) type Weights = [f32; 5];

/// Materials of things of the household.
pub(crate) const ANY: Weights = [0.42, 0.26, 0.10, 0.08, 0.14];
pub(crate) const CARTON: Weights = [0.62, 0.22, 0.04, 0.02, 0.10];
pub(crate) const CERAMIC: Weights = [0.20, 0.52, 0.08, 0.14, 0.06];
pub(crate) const BOTTLE: Weights = [0.10, 0.30, 0.12, 0.36, 0.12];
pub(crate) const CUTLERY: Weights = [0.04, 0.10, 0.80, 0.0, 0.06];
pub(crate) const CABLE: Weights = [0.45, 0.15, 0.02, 0.0, 0.38];
pub(crate) const CLOTH: Weights = [0.86, 0.0, 0.0, 0.0, 0.14];
pub(crate) const FURNITURE: Weights = [0.60, 0.22, 0.04, 0.03, 0.11];

const ALL: [Pattern; 10] = [
    Pattern::Plain,
    Pattern::Cloud,
    Pattern::Marble,
    Pattern::Grain,
    Pattern::Stripes,
    Pattern::Checks,
    Pattern::Dots,
    Pattern::Speckle,
    Pattern::Print,
    Pattern::Tiles,
];

/// A paint of one of the kinds that `weights` allow; `size_m` is the thing's size, which sets that of the pattern.
pub(crate) fn paint(draw: &mut Draw, weights: Weights, size_m: f32) -> Paint {
    Paint::Made(match draw.weighted(&weights) {
        0 => body(draw, Surface::Matte, size_m),
        1 => body(draw, Surface::Glossy, size_m),
        2 => metal(draw),
        3 => glass(draw),
        _ => dark(draw, size_m),
    })
}

/// A colour, linear RGB: any hue, mostly not loud.
pub(crate) fn color(draw: &mut Draw) -> Vec3 {
    let hue = draw.unit() * core::f32::consts::TAU;
    let loud = draw.unit().powi(2);
    let value = draw.scale(0.06, 0.82);
    let wheel = Vec3::new(hue.cos(), (hue - 2.094).cos(), (hue + 2.094).cos()) * 0.5 + 0.5;
    let tint = Vec3::ONE.lerp(wheel * wheel * 1.6, loud * 0.9);
    (tint * value).min(Vec3::splat(0.88))
}

fn luma(c: Vec3) -> f32 {
    c.dot(Vec3::new(0.2126, 0.7152, 0.0722))
}

/// A look of matte or glossy matter.
pub(crate) fn body(draw: &mut Draw, surface: Surface, size_m: f32) -> Look {
    let weights = [0.34, 0.13, 0.04, 0.09, 0.09, 0.05, 0.05, 0.08, 0.13, 0.0];
    let pattern = ALL[draw.weighted(&weights)];
    patterned(draw, surface, pattern, size_m)
}

/// A look with this pattern.
pub(crate) fn patterned(draw: &mut Draw, surface: Surface, pattern: Pattern, size_m: f32) -> Look {
    let first = color(draw);
    let second = if draw.chance(0.5) { first * draw.between(0.45, 0.85) } else { color(draw) };
    let scale = match pattern {
        Pattern::Speckle => draw.scale(25.0, 120.0) * 0.1,
        Pattern::Print => draw.scale(16.0, 50.0) * 0.12,
        Pattern::Grain => draw.scale(4.0, 14.0),
        _ => draw.scale(2.0, 12.0),
    } / size_m.clamp(0.02, 2.0);
    let contrast = (luma(first) - luma(second)).abs();
    let busy = match pattern {
        Pattern::Plain => 0.06,
        Pattern::Cloud | Pattern::Marble | Pattern::Dots | Pattern::Tiles => 0.25,
        Pattern::Stripes | Pattern::Checks => 0.4,
        Pattern::Grain | Pattern::Print => 0.6,
        Pattern::Speckle => 0.9,
    };
    let texture = (busy * (0.35 + 1.8 * contrast) + 0.08 + draw.between(0.0, 0.6).powi(2)).min(1.0);
    // Dyes that absorb what is seen often send infrared back.
    let mean = f32::midpoint(luma(first), luma(second));
    let albedo = (mean + draw.unit() * 0.5 * (0.75 - mean)).clamp(DARK_ALBEDO + 0.02, 0.9);
    let infrared = Infrared { albedo, texture };
    Look { surface, pattern, colors: [first, second], scale, layer: draw.below(1 << 20) as i32, infrared }
}

fn metal(draw: &mut Draw) -> Look {
    let tones =
        [Vec3::new(0.56, 0.57, 0.58), Vec3::new(0.62, 0.5, 0.3), Vec3::new(0.6, 0.4, 0.3), Vec3::splat(0.32)];
    let tone = tones[draw.weighted(&[0.6, 0.1, 0.08, 0.22])];
    // A few are as good as a mirror.
    let surface = if draw.chance(0.12) { Surface::Mirror } else { Surface::Shiny };
    let brushed = draw.chance(0.4);
    Look {
        surface,
        pattern: if brushed { Pattern::Grain } else { Pattern::Plain },
        colors: [tone, tone * 0.8],
        scale: 40.0,
        layer: draw.below(1 << 20) as i32,
        infrared: Infrared { albedo: draw.between(0.35, 0.65), texture: if brushed { 0.3 } else { 0.05 } },
    }
}

/// Clear or tinted glass.
pub(crate) fn glass(draw: &mut Draw) -> Look {
    let tints = [
        Vec3::new(0.93, 0.97, 0.955),
        Vec3::new(0.55, 0.85, 0.6),
        Vec3::new(0.75, 0.5, 0.25),
        Vec3::new(0.6, 0.75, 0.92),
    ];
    let tint = tints[draw.weighted(&[0.62, 0.14, 0.12, 0.12])];
    Look {
        surface: Surface::Glass,
        pattern: Pattern::Plain,
        colors: [tint, tint],
        scale: 1.0,
        layer: 0,
        infrared: Infrared { albedo: 0.9, texture: 0.0 },
    }
}

/// Black: velvet, rubber, carbon.
fn dark(draw: &mut Draw, size_m: f32) -> Look {
    let surface = if draw.chance(0.3) { Surface::Glossy } else { Surface::Matte };
    let mut look = body(draw, surface, size_m);
    let tone = draw.scale(0.006, 0.035);
    let tint = Vec3::ONE.lerp(look.colors[0], 0.3);
    look.colors = [tint * tone, tint * tone * draw.between(0.5, 1.6)];
    look.infrared = Infrared { albedo: draw.scale(0.006, DARK_ALBEDO), texture: look.infrared.texture * 0.3 };
    look
}
