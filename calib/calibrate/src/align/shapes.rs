//! Meshes of the simple bodies of robot descriptions.

use super::Mesh;
use core::f64::consts::TAU;
use glam::DVec3;

/// Sides of round bodies: the polygon is within 0.12 % of the circle.
const SIDES: u32 = 64;
/// Rings of a sphere from pole to pole.
const RINGS: u32 = 32;

impl Mesh {
    /// A box about the origin with the lengths of its sides, metres.
    pub fn cuboid(size: DVec3) -> Self {
        let corner = |i: u32| {
            let side = |bit: u32| if i >> bit & 1 == 0 { -0.5 } else { 0.5 };
            size * DVec3::new(side(0), side(1), side(2))
        };
        let faces = [[0, 1, 3, 2], [4, 5, 7, 6], [0, 1, 5, 4], [2, 3, 7, 6], [0, 2, 6, 4], [1, 3, 7, 5]];
        let triangles = faces.iter().flat_map(|[a, b, c, d]| [[*a, *b, *c], [*a, *c, *d]]).collect();
        Self { vertices: (0..8).map(corner).collect(), triangles }
    }

    /// A cylinder about the origin, its axis along z; metres.
    pub fn cylinder(radius: f64, length: f64) -> Self {
        let half = length / 2.0;
        Self::turned(&[(0.0, -half), (radius, -half), (radius, half), (0.0, half)])
    }

    /// A sphere about the origin; metres.
    pub fn sphere(radius: f64) -> Self {
        Self::capsule(radius, 0.0)
    }

    /// A cylinder about the origin, its axis along z, with half a sphere beyond each end; metres.
    pub fn capsule(radius: f64, length: f64) -> Self {
        let ring = |i: u32| {
            let angle = TAU / 2.0 * f64::from(i) / f64::from(RINGS);
            let shift = if i * 2 < RINGS { -length / 2.0 } else { length / 2.0 };
            (radius * angle.sin(), shift - radius * angle.cos())
        };
        let mut outline: Vec<(f64, f64)> = (0..=RINGS).map(ring).collect();
        outline.insert(RINGS as usize / 2, (radius, -length / 2.0));
        Self::turned(&outline)
    }

    /// A body of revolution about z, from (radius, z) along its outline.
    fn turned(outline: &[(f64, f64)]) -> Self {
        let mut vertices = Vec::new();
        let mut triangles = Vec::new();
        for (k, (radius, z)) in outline.iter().enumerate() {
            for i in 0..SIDES {
                let angle = TAU * f64::from(i) / f64::from(SIDES);
                vertices.push(DVec3::new(radius * angle.cos(), radius * angle.sin(), *z));
                if k > 0 {
                    let here = k as u32 * SIDES;
                    let next = (i + 1) % SIDES;
                    triangles.push([here - SIDES + i, here - SIDES + next, here + i]);
                    triangles.push([here + i, here - SIDES + next, here + next]);
                }
            }
        }
        Self { vertices, triangles }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use core::f64::consts::PI;

    /// By the divergence theorem; the sign is that of the triangles' order.
    fn volume(mesh: &Mesh) -> f64 {
        let of = |t: &[u32; 3]| {
            let [a, b, c] = t.map(|i| mesh.vertices()[i as usize]);
            a.dot(b.cross(c)) / 6.0
        };
        mesh.triangles().iter().map(of).sum::<f64>().abs()
    }

    #[test]
    fn bodies_have_their_volumes() {
        let near = |a: f64, b: f64| assert!((a / b - 1.0).abs() < 0.01, "{a} {b}");
        near(volume(&Mesh::cylinder(0.1, 0.5)), PI * 0.01 * 0.5);
        near(volume(&Mesh::sphere(0.2)), 4.0 / 3.0 * PI * 0.008);
        near(volume(&Mesh::capsule(0.1, 0.5)), PI * 0.01 * 0.5 + 4.0 / 3.0 * PI * 0.001);
        let box_of = Mesh::cuboid(DVec3::new(1.0, 2.0, 3.0));
        let reach = box_of.vertices().iter().fold(DVec3::ZERO, |m, v| m.max(v.abs()));
        assert_eq!(reach, DVec3::new(0.5, 1.0, 1.5));
        assert_eq!(box_of.triangles().len(), 12);
    }
}
