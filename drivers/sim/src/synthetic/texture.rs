//! Appearance of surfaces, in colour and to a depth camera.

use super::noise::{fractal2, lattice, smooth2};
use glam::Vec3;

mod look;

pub(crate) use look::{DARK_ALBEDO, Look, Pattern};

/// How light leaves a surface.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Surface {
    Matte,
    /// Varnished: a highlight, and a faint mirror at grazing angles.
    Glossy,
    /// Polished metal: more mirror than colour.
    Shiny,
    Mirror,
    Glass,
}

/// The look of a thing.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Paint {
    Wood,
    DarkWood,
    Wall,
    Floor,
    Ceiling,
    Poster,
    Cabinet,
    Lampshade,
    Sofa,
    Checker,
    Mirror,
    Glass,
    Green,
    Stripes,
    Speckle,
    BookBlue,
    BookRed,
    BookSand,
    BeachBall,
    Orange,
    Mug,
    Velvet,
    Steel,
    Eraser,
    Cutlery,
    /// Of a random world.
    Made(Look),
}

/// Infrared properties of a spot, for a depth camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Infrared {
    /// Part of the light that comes back, 0..1.
    pub(crate) albedo: f32,
    /// How well two images of it can be matched, 0..1.
    pub(crate) texture: f32,
}

impl Paint {
    pub(crate) const fn surface(self) -> Surface {
        match self {
            Self::Made(look) => look.surface,
            Self::Mirror => Surface::Mirror,
            Self::Glass => Surface::Glass,
            Self::Steel | Self::Cutlery => Surface::Shiny,
            Self::Mug | Self::BeachBall | Self::Orange | Self::Green | Self::Wood | Self::Floor => {
                Surface::Glossy
            }
            _ => Surface::Matte,
        }
    }

    /// Whether the pattern has hard edges, which need several rays per pixel.
    pub(crate) const fn is_sharp(self) -> bool {
        matches!(
            self,
            Self::Checker | Self::Stripes | Self::Poster | Self::BeachBall | Self::Floor | Self::Speckle
        )
    }

    /// Its infrared properties, for a depth camera.
    pub(crate) const fn infrared(self) -> Infrared {
        let (albedo, texture) = match self {
            Self::Made(look) => return look.infrared,
            Self::Wood => (0.55, 0.8),
            Self::DarkWood => (0.3, 0.5),
            Self::Wall | Self::Eraser => (0.7, 0.3),
            Self::Floor => (0.4, 0.6),
            Self::Ceiling => (0.8, 0.05),
            Self::Poster => (0.6, 0.9),
            Self::Cabinet => (0.6, 0.25),
            Self::Lampshade => (0.8, 0.15),
            Self::Sofa => (0.35, 0.6),
            Self::Checker => (0.6, 1.0),
            Self::Mirror | Self::Glass => (0.9, 0.0),
            Self::Green | Self::Orange => (0.6, 0.2),
            Self::Stripes => (0.55, 0.9),
            Self::Speckle => (0.5, 1.0),
            Self::BookBlue | Self::BookRed => (0.4, 0.35),
            Self::BookSand => (0.6, 0.4),
            Self::BeachBall => (0.65, 0.55),
            Self::Mug => (0.85, 0.04),
            Self::Velvet => (0.015, 0.12),
            Self::Steel => (0.5, 0.05),
            Self::Cutlery => (0.6, 0.45),
        };
        Infrared { albedo, texture }
    }

    /// Base colour (linear RGB) at a point in the thing's frame; `blur_m` is the width of a pixel there.
    pub(crate) fn color(self, p: Vec3, n: Vec3, blur_m: f32) -> Vec3 {
        match self {
            Self::Made(look) => look.color(p, n, blur_m),
            Self::Wood => wood(p, blur_m),
            Self::DarkWood => {
                Vec3::new(0.105, 0.055, 0.03) * (0.8 + 0.4 * smooth2(p.x * 30.0, p.z * 9.0 + p.y * 30.0, 3))
            }
            Self::Wall => {
                Vec3::new(0.58, 0.60, 0.575) * (0.97 + 0.06 * fractal2((p.x + p.y) * 40.0, p.z * 40.0, 11))
            }
            Self::Floor => floor(p),
            Self::Ceiling => Vec3::splat(0.75),
            Self::Poster => poster(p),
            Self::Cabinet => {
                let line = (p.x.abs() < 0.004 || (p.z + 0.02).abs() < 0.004) && n.y < -0.5;
                if line { Vec3::splat(0.12) } else { Vec3::new(0.50, 0.53, 0.55) }
            }
            Self::Lampshade => Vec3::new(0.85, 0.62, 0.34),
            Self::Sofa => {
                Vec3::new(0.10, 0.20, 0.24)
                    * (0.7 + 0.6 * smooth2((p.x + p.z) * 220.0, (p.y + p.z) * 220.0, 5))
            }
            Self::Checker => checker(p, n),
            Self::Mirror | Self::Glass => Vec3::splat(0.02),
            Self::Green => Vec3::new(0.09, 0.42, 0.14),
            Self::Stripes => stripes(p, n),
            Self::Speckle => {
                let cell = (p * 160.0).floor();
                let r = lattice(cell.x as i32, cell.y as i32, cell.z as i32 + 77);
                if r > 0.74 {
                    Vec3::new(0.75, 0.68, 0.3)
                } else {
                    Vec3::new(0.05, 0.17, 0.42) * (0.7 + 0.6 * r)
                }
            }
            Self::BookBlue => book(p, n, Vec3::new(0.07, 0.13, 0.30)),
            Self::BookRed => book(p, n, Vec3::new(0.45, 0.07, 0.06)),
            Self::BookSand => book(p, n, Vec3::new(0.62, 0.48, 0.26)),
            Self::BeachBall => {
                let sector = ((p.y.atan2(p.x) / core::f32::consts::TAU + 0.5) * 6.0).floor() as usize % 6;
                let white = Vec3::splat(0.78);
                let colors = [
                    Vec3::new(0.68, 0.08, 0.07),
                    white,
                    Vec3::new(0.05, 0.22, 0.58),
                    white,
                    Vec3::new(0.80, 0.52, 0.05),
                    white,
                ];
                if p.z.abs() > 0.052 { white } else { colors[sector] }
            }
            Self::Orange => Vec3::new(0.78, 0.30, 0.04),
            Self::Mug => {
                let is_inside = n.z > 0.5 && p.x.hypot(p.y) < 0.034;
                if is_inside { Vec3::new(0.045, 0.02, 0.01) } else { Vec3::new(0.80, 0.79, 0.76) }
            }
            Self::Velvet => Vec3::new(0.010, 0.009, 0.013),
            Self::Steel => Vec3::new(0.56, 0.57, 0.58),
            Self::Eraser => Vec3::new(0.75, 0.35, 0.40),
            Self::Cutlery => Vec3::new(0.52, 0.52, 0.53),
        }
    }
}

/// Planks along x: each with its own tone, long wavy grain and fine pores.
fn wood(p: Vec3, blur_m: f32) -> Vec3 {
    const PLANK: f32 = 0.125;
    let row = (p.y / PLANK).floor();
    let shift = lattice(row as i32, 5, 1) * 7.0;
    let across = p.y / PLANK - row;
    let joint = ((p.x + shift) / 0.62).floor();
    let tone = 0.82 + 0.36 * lattice(row as i32, joint as i32, 2);
    let wave = smooth2(p.x * 2.2 + shift, p.y * 9.0, 21) * 5.0;
    let ring = (p.y * 95.0 + wave * 2.2 + smooth2(p.x * 5.0, p.y * 40.0, 22) * 1.6).sin() * 0.5 + 0.5;
    let fine = (1.0 - blur_m * 250.0).clamp(0.0, 1.0);
    let pores =
        if fine > 0.0 { smooth2(p.x * 60.0, p.y * 900.0, 23) * fine + 0.5 * (1.0 - fine) } else { 0.5 };
    let light = Vec3::new(0.46, 0.27, 0.135);
    let dark = Vec3::new(0.29, 0.145, 0.062);
    let base = dark.lerp(light, 0.25 + 0.6 * ring * 0.6 + 0.25 * pores) * tone;
    let edge = (across.min(1.0 - across) * PLANK / 0.0012).clamp(0.35, 1.0);
    base * edge
}

fn floor(p: Vec3) -> Vec3 {
    let tile = (p / 0.3).floor();
    let inside = (p / 0.3 - tile - 0.5).abs();
    if inside.x.max(inside.y) > 0.49 {
        return Vec3::splat(0.12);
    }
    let tone = 0.8 + 0.3 * lattice(tile.x as i32, tile.y as i32, 9);
    Vec3::new(0.30, 0.28, 0.26) * tone * (0.85 + 0.3 * fractal2(p.x * 14.0, p.y * 14.0, 31))
}

/// 8 x 6 squares of 30 mm with a white border: inner corners 7 x 5.
fn checker(p: Vec3, n: Vec3) -> Vec3 {
    let white = Vec3::splat(0.82);
    let u = p.x / 0.03 + 4.0;
    let v = p.z / 0.03 + 3.0;
    if n.y > -0.5 || !(0.0..8.0).contains(&u) || !(0.0..6.0).contains(&v) {
        return white;
    }
    if (u as i32 + v as i32) % 2 == 0 { Vec3::splat(0.03) } else { white }
}

fn stripes(p: Vec3, n: Vec3) -> Vec3 {
    let red = Vec3::new(0.60, 0.085, 0.06);
    let cream = Vec3::new(0.80, 0.68, 0.50);
    if n.z.abs() > 0.5 {
        let d = p.x.hypot(p.y);
        return if (0.018..0.03).contains(&d) { cream } else { red };
    }
    let along = if n.x.abs() > 0.5 { p.y } else { p.x };
    if ((along + p.z) * 42.0).rem_euclid(2.0) < 0.8 { cream } else { red }
}

fn book(p: Vec3, n: Vec3, cover: Vec3) -> Vec3 {
    if n.x > 0.5 || n.y.abs() > 0.5 && p.x > -0.07 {
        // The pages.
        return Vec3::splat(0.62) * (0.85 + 0.15 * (p.z * 2600.0).sin());
    }
    let frame = n.z > 0.5 && (p.x.abs() - 0.05).abs() < 0.0015;
    if frame { Vec3::new(0.7, 0.55, 0.25) } else { cover }
}

/// Hills in the evening.
fn poster(p: Vec3) -> Vec3 {
    let x = p.x / 0.42;
    let y = p.z / 0.27;
    if x.abs() > 0.94 || y.abs() > 0.91 {
        return Vec3::splat(0.8);
    }
    let sun = (x - 0.3).hypot((y - 0.25) * 0.65);
    let sky =
        Vec3::new(0.85, 0.42, 0.20).lerp(Vec3::new(0.16, 0.24, 0.50), ((y + 0.3) * 0.8).clamp(0.0, 1.0));
    let mut c = if sun < 0.16 { Vec3::new(0.95, 0.80, 0.45) } else { sky };
    let layers = [
        (0.05, 1.7, Vec3::new(0.34, 0.22, 0.36)),
        (-0.25, 2.6, Vec3::new(0.16, 0.16, 0.32)),
        (-0.55, 3.7, Vec3::new(0.05, 0.09, 0.17)),
    ];
    for (i, (height, scale, color)) in layers.into_iter().enumerate() {
        if y < height + 0.45 * (smooth2(x * scale, i as f32 * 3.0, 41) - 0.5) {
            c = color;
        }
    }
    c
}
