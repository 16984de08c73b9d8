//! The tables of an L515, byte by byte.
//!
//! Layouts: librealsense `src/l500/l500-private.h` at commit aa80741c (Apache-2.0).

use super::{Spread, rotation};

/// The calibration of an L515.
#[derive(Debug, Clone, PartialEq)]
pub struct L515 {
    /// Depth and infrared, for each size (upright).
    pub depth: Vec<L515Depth>,
    /// Colour, for each size.
    pub color: Vec<L515Color>,
    /// From depth to colour, row after row.
    pub rotation: [f32; 9],
    /// From depth to colour, millimetres.
    pub translation_mm: [f32; 3],
    /// Counts per millimetre: the depth unit is 1 / (1000 znorm) metres.
    pub znorm: f32,
}

/// Intrinsics of one size of depth.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct L515Depth {
    /// Pixels.
    pub size: (u32, u32),
    /// `fx fy ppx ppy`, pixels.
    pub pinhole: [f32; 4],
}

/// Intrinsics of one size of colour.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct L515Color {
    /// Pixels.
    pub size: (u32, u32),
    /// `fx fy ppx ppy`, pixels.
    pub pinhole: [f32; 4],
    /// `k1 k2 p1 p2 k3`.
    pub distortion: [f32; 5],
}

struct Bytes(Vec<u8>);

impl Bytes {
    fn words(&mut self, values: &[u32]) {
        for value in values {
            self.0.extend_from_slice(&value.to_le_bytes());
        }
    }

    fn floats(&mut self, values: &[f32]) {
        for value in values {
            self.0.extend_from_slice(&value.to_le_bytes());
        }
    }
}

impl L515 {
    pub(super) fn new(spread: &Spread<'_>) -> Self {
        let pinhole = |(width, height): (u32, u32), per_width: f32, name: &str| {
            let f = width as f32 * (per_width + 0.005 * spread.at(name));
            let center =
                |extent: u32, axis: &str| extent as f32 * (0.5 + 0.01 * spread.at(&format!("{name}{axis}")));
            [f, f * 1.001, center(width, "x"), center(height, "y")]
        };
        let depth = [(1024, 768), (640, 480), (320, 240)];
        let color = [(1920, 1080), (1280, 720), (960, 540), (640, 480), (640, 360)];
        let distortion = ["k1", "k2", "p1", "p2", "k3"].map(|name| 0.01 * spread.at(name));
        Self {
            depth: depth.map(|size| L515Depth { size, pinhole: pinhole(size, 0.72, "depth") }).to_vec(),
            color: color
                .map(|size| L515Color { size, pinhole: pinhole(size, 0.71, "color"), distortion })
                .to_vec(),
            rotation: rotation(["a", "b", "c"].map(|n| 0.01 * spread.at(n))),
            translation_mm: [0.3 * spread.at("x"), 14.0 + 0.2 * spread.at("y"), -6.0 + 0.2 * spread.at("z")],
            znorm: 4.0,
        }
    }

    /// The reply to `DPT_INTRINSICS_FULL_GET`: 12 bytes of orientation, 4 with the count, then raw and world of each.
    pub(crate) fn depth_table(&self) -> Vec<u8> {
        let mut bytes = Bytes(vec![1, 0, 0, 0]);
        bytes.words(&[0]);
        bytes.floats(&[0.0]);
        bytes.0.extend([0, 0, 0, self.depth.len() as u8]);
        for entry in &self.depth {
            // "Raw" is before the correction of the projection; nobody should use it, so it differs.
            for (scale, world) in [(0.9, false), (1.0, true)] {
                bytes.words(&[entry.size.0, entry.size.1]);
                bytes.floats(&entry.pinhole.map(|v| v * scale));
                bytes.floats(&if world { [0.0; 5] } else { [0.1, 0.1, 0.01, 0.01, 0.1] });
                bytes.floats(&[entry.size.0 as f32 / 2.0, entry.size.1 as f32 / 2.0, self.znorm]);
            }
        }
        bytes.0
    }

    /// The reply to `RGB_INTRINSIC_GET`.
    pub(crate) fn color_table(&self) -> Vec<u8> {
        let mut bytes = Bytes(Vec::new());
        bytes.floats(&[0.0]);
        bytes.words(&[0]);
        bytes.0.extend([0, 0, 0, self.color.len() as u8]);
        for entry in &self.color {
            bytes.words(&[entry.size.0, entry.size.1]);
            bytes.floats(&entry.pinhole);
            bytes.floats(&entry.distortion);
        }
        bytes.0
    }

    /// The reply to `RGB_EXTRINSIC_GET`.
    pub(crate) fn extrinsics(&self) -> Vec<u8> {
        let mut bytes = Bytes(Vec::new());
        bytes.floats(&self.rotation);
        bytes.floats(&self.translation_mm);
        bytes.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn float(bytes: &[u8], at: usize) -> f32 {
        f32::from_le_bytes(bytes[at..at + 4].try_into().unwrap())
    }

    /// Offsets counted by hand from the structures.
    #[test]
    fn tables_have_their_fields_where_a_reader_looks() {
        let unit = L515::new(&Spread("f0000001"));
        let depth = unit.depth_table();
        assert_eq!(depth.len(), 12 + 4 + 3 * 2 * 56);
        assert_eq!(depth[15], 3);
        let world = 16 + 56;
        assert_eq!(depth[world..world + 8], [0, 4, 0, 0, 0, 3, 0, 0], "1024 x 768");
        assert_eq!(float(&depth, world + 8), unit.depth[0].pinhole[0]);
        assert_eq!(float(&depth, world + 52), 4.0, "znorm");
        let color = unit.color_table();
        assert_eq!((color.len(), color[11]), (8 + 4 + 5 * 44, 5));
        assert_eq!(float(&color, 12 + 8 + 8), unit.color[0].pinhole[2]);
        assert_eq!(unit.extrinsics().len(), 48);
    }
}
