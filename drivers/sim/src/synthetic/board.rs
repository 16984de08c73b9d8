//! A printed board in front of the mount, painted over the rendered scene at the pose that it has when a frame is exposed.
//!
//! The board is in front of everything else, casts no shadow and is not blurred by its motion.

use super::models::{DepthPrinciple, Model};
use super::noise::Rolls;
use super::view::Rays;
use depthrig_bus::{HostTime, Pose};
use depthrig_calib::PoseExt;
use glam::{DAffine3, Mat3, Vec3};
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

mod motion;
mod sheet;

pub use motion::BoardMotion;
pub(crate) use sheet::Print;
pub use sheet::{Black, Sheet};

/// White paper, black ink and the panel around the sheet, in steps of 256.
const WHITE: f32 = 205.0;
const INK: f32 = 26.0;
const PANEL: f32 = 165.0;
/// Standard deviation of the colour sensor's noise, in steps of 256.
const NOISE: f32 = 1.3;
/// Pixels of the panel of which the sensor reports no depth.
const HOLES: f32 = 0.01;

/// A printed board that moves in front of the mount.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct BoardScene {
    /// Description of the board, of whose print whoever opens the camera makes the sheet.
    pub file: PathBuf,
    /// The print.
    pub sheet: Sheet,
    /// How it moves.
    pub motion: BoardMotion,
    /// Seed of its places; the same for all cameras of a mount.
    pub seed: u64,
    /// `steps` and `wall`: time at each place, seconds.
    pub hold_s: f64,
    /// Where the camera really is, from where its pose says.
    pub displaced: Pose,
    /// Factor of the panel's sensed depth.
    pub depth_scale: f64,
    /// Added to the panel's sensed depth, millimetres.
    pub depth_offset_mm: f64,
}

impl Default for BoardScene {
    fn default() -> Self {
        Self {
            file: PathBuf::new(),
            sheet: Sheet::default(),
            motion: BoardMotion::Steps,
            seed: 1,
            hold_s: 2.0,
            displaced: Pose::IDENTITY,
            depth_scale: 1.0,
            depth_offset_mm: 0.0,
        }
    }
}

impl BoardScene {
    /// The first of its numbers that is out of range, in words.
    pub(super) fn problem(&self) -> Option<String> {
        let pose = self.displaced.translation_m.iter().chain(&self.displaced.rotation_xyzw);
        if !(0.1..=600.0).contains(&self.hold_s) {
            Some(format!("board.hold_s = {} is out of range 0.1..=600", self.hold_s))
        } else if !(0.5..=2.0).contains(&self.depth_scale) {
            Some(format!("board.depth_scale = {} is out of range 0.5..=2", self.depth_scale))
        } else if !(-500.0..=500.0).contains(&self.depth_offset_mm) {
            Some(format!("board.depth_offset_mm = {} is out of range -500..=500", self.depth_offset_mm))
        } else if !pose.clone().all(|v| v.is_finite()) {
            Some("board.displaced has a value that is not finite".to_owned())
        } else {
            self.sheet.problem()
        }
    }

    /// The pose of the sheet's middle in the mount's frame at `t`; `None` while it is away.
    pub(crate) fn pose(&self, world_start: HostTime, t: HostTime) -> Option<DAffine3> {
        let seconds = t.since_ns(world_start).max(0) as f64 * 1e-9;
        self.motion.pose(self.seed, self.hold_s, seconds)
    }

    /// Half of the panel that the sheet is glued to, metres.
    fn panel_half_m(&self) -> [f32; 2] {
        let border = if self.motion == BoardMotion::Wall { 1.2 } else { 0.01 };
        [0, 1].map(|i| (self.sheet.size_m[i] / 2.0 + border) as f32)
    }
}

/// Paints the board into one stream's images.
#[derive(Debug)]
pub(crate) struct Painter {
    scene: BoardScene,
    print: Print,
    rays: Rays,
    mount_from_sensor: DAffine3,
    seed: u64,
}

/// The board as a sensor sees it: its plane in the board's own frame.
struct Seen<'a> {
    painter: &'a Painter,
    /// The sensor in the board's frame.
    from: Vec3,
    /// From the sensor's directions to the board's.
    turn: Mat3,
    half: [f32; 2],
}

/// Where a pixel's ray meets the panel.
struct Spot {
    /// Depth in the sensor's optical frame, metres.
    z: f32,
    /// Place on the panel from the sheet's middle, metres.
    at: [f32; 2],
    /// Extent of the pixel there, metres.
    extent: [f32; 2],
    /// Cosine of the angle between ray and normal.
    facing: f32,
}

impl Painter {
    /// A painter of images with these rays, of the sensor at `sensor` on the mount.
    pub(crate) fn new(scene: &BoardScene, rays: Rays, sensor: &Pose, seed: u64) -> Self {
        Self {
            print: Print::new(&scene.sheet),
            scene: scene.clone(),
            rays,
            mount_from_sensor: sensor.to_affine(),
            seed,
        }
    }

    /// Paints RGB8.
    pub(crate) fn color(&self, rgb: &mut [u8], moment: Moment) {
        let Some(seen) = self.seen(moment) else { return };
        self.each(&seen, |i, spot| {
            let light = 0.8 + 0.2 * spot.facing;
            let value = match self.print.ink(spot.at, spot.extent) {
                Some(ink) => WHITE + (INK - WHITE) * ink,
                None => PANEL,
            };
            let rolls = Rolls::new(self.seed, i as u32, moment.frame as u32, 1);
            for (c, out) in rgb[3 * i..3 * i + 3].iter_mut().enumerate() {
                *out = (value * light + NOISE * rolls.normal(c as u64)).round().clamp(0.0, 255.0) as u8;
            }
        });
    }

    /// Paints depth in counts of the model's unit: true or as the sensor reports it.
    pub(crate) fn depth(&self, counts: &mut [u8], model: &Model, is_true: bool, moment: Moment) {
        let Some(seen) = self.seen(moment) else { return };
        let unit = model.depth_unit_m as f32;
        let scale = self.scene.depth_scale as f32;
        let offset = self.scene.depth_offset_mm as f32 * 1e-3;
        let (near, far) = model.range_m;
        self.each(&seen, |i, spot| {
            let sensed = if is_true {
                spot.z
            } else {
                let rolls = Rolls::new(self.seed, i as u32, moment.frame as u32, 2);
                let z = scale * spot.z + offset + self.sigma_m(model, spot.z) * rolls.normal(0);
                let is_hole = rolls.unit(1) < HOLES || !(near..=far).contains(&z);
                if is_hole { 0.0 } else { z }
            };
            let count = (sensed / unit).round().clamp(0.0, f32::from(u16::MAX)) as u16;
            counts[2 * i..2 * i + 2].copy_from_slice(&count.to_le_bytes());
        });
    }

    /// Standard deviation of a sensed depth, metres: of a match, or of a time.
    fn sigma_m(&self, model: &Model, z: f32) -> f32 {
        match model.depth {
            DepthPrinciple::Stereo { baseline_m, sigma_px, .. } => {
                z * z * self.rays.pixel_rad / baseline_m * sigma_px
            }
            DepthPrinciple::TimeOfFlight { sigma_m, .. } => sigma_m * z,
        }
    }

    fn seen(&self, moment: Moment) -> Option<Seen<'_>> {
        let board_from_sensor =
            self.scene.pose(moment.world_start, moment.capture)?.inverse() * self.mount_from_sensor;
        Some(Seen {
            painter: self,
            from: board_from_sensor.translation.as_vec3(),
            turn: board_from_sensor.matrix3.as_mat3(),
            half: self.scene.panel_half_m(),
        })
    }

    /// Calls `paint` for each pixel whose ray meets the panel.
    fn each(&self, seen: &Seen<'_>, mut paint: impl FnMut(usize, &Spot)) {
        let width = self.rays.width;
        for y in 0..self.rays.height {
            for x in 0..width {
                if let Some(spot) = seen.meet(self.rays.dir(x, y)) {
                    paint(y * width + x, &spot);
                }
            }
        }
    }
}

/// The moment of a frame.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Moment {
    /// When the world began.
    pub(crate) world_start: HostTime,
    /// Mid-exposure.
    pub(crate) capture: HostTime,
    /// The device's frame counter.
    pub(crate) frame: u64,
}

impl Seen<'_> {
    /// Where a ray (z = 1 in the sensor's frame) meets the panel, if it does.
    fn meet(&self, dir: Vec3) -> Option<Spot> {
        let d = self.turn * dir;
        // The plane is z = 0 and the print faces -z; a lens without a ray has a zero direction.
        let z = -self.from.z / d.z;
        if !(z > 0.0 && z.is_finite()) || self.from.z >= 0.0 {
            return None;
        }
        let at = [self.from.x + z * d.x, self.from.y + z * d.y];
        if at[0].abs() > self.half[0] || at[1].abs() > self.half[1] {
            return None;
        }
        // One pixel to the side turns `d` by a column of `turn`; the place moves by the derivative of the division.
        let step = self.painter.rays.pixel_rad * z;
        let extent = [d.x, d.y].map(|along| along / d.z);
        let moved = |axis: Vec3| [axis.x - extent[0] * axis.z, axis.y - extent[1] * axis.z];
        let right = moved(self.turn.x_axis);
        let down = moved(self.turn.y_axis);
        Some(Spot {
            z,
            at,
            extent: [0, 1].map(|i| right[i].hypot(down[i]) * step),
            facing: (d.z / d.length()).abs(),
        })
    }
}

#[cfg(test)]
mod tests;
