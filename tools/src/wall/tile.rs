//! One stream of the wall: its newest frame, made small.

use super::terminal::Size;
use crate::turbo::turbo;
use core::time::Duration;
use depthrig_bus::{Bus, HostTime, PixelFormat, StreamId, Subscriber};
use depthrig_recorder::preview::{Preview, PreviewKind, preview};
use image::RgbImage;

/// Colour of holes, as on the live page.
const HOLE: [u8; 3] = [0x26, 0x28, 0x2c];
/// The far end of turbo is nearly black and would look like a hole.
const FARTHEST: f32 = 0.05;
/// Nearest depth and smallest span of the range, metres.
const NEAREST_M: f32 = 0.05;
const MIN_SPAN_M: f32 = 0.05;
/// Depths of a tile that decide about the range.
const SAMPLES: usize = 2000;

/// Depths between which colours run, metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Range {
    near: f32,
    far: f32,
}

/// A stream and its newest image.
pub struct Tile {
    /// The stream.
    pub id: StreamId,
    subscriber: Option<Subscriber>,
    /// Why an image is missing.
    problem: Option<String>,
    preview: Option<Preview>,
    /// Whether the preview was not drawn yet.
    is_fresh: bool,
    heard: HostTime,
}

impl Tile {
    /// A tile without an image.
    pub fn new(id: StreamId) -> Self {
        Self { id, subscriber: None, problem: None, preview: None, is_fresh: false, heard: HostTime::now() }
    }

    /// Subscribes if that is not done.
    pub fn subscribe(&mut self, bus: &Bus) {
        if self.subscriber.is_some() {
            return;
        }
        match bus.subscriber(&self.id) {
            Ok(subscriber) => self.subscriber = Some(subscriber),
            Err(e) => self.problem = Some(e.to_string()),
        }
    }

    /// Takes the newest frame; `is_moved` draws the last one again without one.
    pub fn look(&mut self, size: Size, is_moved: bool) {
        self.is_fresh = is_moved;
        let Some(subscriber) = &mut self.subscriber else { return };
        let small = match subscriber.latest() {
            Ok(None) => return,
            Ok(Some(frame)) => {
                let header = frame.header();
                // The frame's slot is free again when its preview is there.
                let width =
                    f64::from(size.height) * f64::from(header.width) / f64::from(header.height.max(1));
                let width = (width as u32).clamp(1, size.width.max(1));
                let is_depth = header.pixel_format().is_some_and(PixelFormat::is_depth);
                // A preview has half of its size in colour. Depth is not scaled again, because that would be a mean.
                let width = if is_depth { width } else { 2 * width };
                preview(header, frame.pixels(), width).map_err(|e| e.to_string())
            }
            Err(e) => {
                self.subscriber = None;
                Err(e.to_string())
            }
        };
        match small {
            Ok(preview) => {
                self.preview = Some(preview);
                self.problem = None;
                self.is_fresh = true;
                self.heard = HostTime::now();
            }
            Err(problem) => self.problem = Some(problem),
        }
    }

    /// The new image, if there is one.
    pub fn image(&mut self, range: Range, size: Size) -> Option<RgbImage> {
        let preview = self.preview.as_ref().filter(|_| self.is_fresh)?;
        self.is_fresh = false;
        let image = match preview.kind {
            PreviewKind::Depth => depth(preview, range),
            PreviewKind::Jpeg => color(preview),
        };
        let Some(image) = image else {
            self.problem = Some("an image cannot be decoded".to_owned());
            return None;
        };
        Some(super::fitted(image, size.width, size.height))
    }

    /// Whether nothing new came for that long.
    pub fn is_stale(&self, limit: Duration) -> bool {
        self.problem.is_some() || self.heard.elapsed() > limit
    }

    /// The stream's name, and what is wrong with it.
    pub fn label(&self, limit: Duration) -> String {
        match &self.problem {
            Some(problem) => format!("{}: {problem}", self.id),
            None if self.is_stale(limit) => {
                format!("{}: no image for {} s", self.id, self.heard.elapsed().as_secs())
            }
            None => self.id.to_string(),
        }
    }

    /// Some of its depths in metres, without holes.
    fn depths(&self) -> impl Iterator<Item = f32> {
        let depth = self.preview.as_ref().filter(|p| p.kind == PreviewKind::Depth);
        depth.into_iter().flat_map(|p| {
            let values = p.bytes.as_chunks::<2>().0;
            let step = (values.len() / SAMPLES) | 1;
            let metres = |v: &[u8; 2]| f32::from(u16::from_le_bytes(*v)) * p.depth_unit_m;
            values.iter().step_by(step).map(metres).filter(|m| *m > 0.0)
        })
    }
}

/// The range of all tiles' depth, from its 2nd to its 98th percentile.
pub fn range(tiles: &[Tile]) -> Range {
    let mut metres: Vec<f32> = tiles.iter().flat_map(Tile::depths).collect();
    metres.sort_unstable_by(f32::total_cmp);
    let at = |share: f64| metres.get((share * metres.len() as f64) as usize).copied();
    let near = at(0.02).unwrap_or(NEAREST_M).max(NEAREST_M);
    Range { near, far: at(0.98).unwrap_or(near).max(near + MIN_SPAN_M) }
}

/// Depth in colours: equal steps of 1/z, near is red, far is blue, holes are grey.
fn depth(preview: &Preview, range: Range) -> Option<RgbImage> {
    let inverse_far = 1.0 / range.far;
    let scale = 1.0 / (1.0 / range.near - inverse_far);
    let color = |value: &[u8; 2]| match u16::from_le_bytes(*value) {
        0 => HOLE,
        value => {
            let x = (1.0 / (f32::from(value) * preview.depth_unit_m) - inverse_far) * scale;
            turbo(FARTHEST + (1.0 - FARTHEST) * x.clamp(0.0, 1.0))
        }
    };
    let pixels = preview.bytes.as_chunks::<2>().0.iter().flat_map(color).collect();
    RgbImage::from_raw(preview.width.into(), preview.height.into(), pixels)
}

fn color(preview: &Preview) -> Option<RgbImage> {
    let image = depthrig_jpeg::decode(&preview.bytes).ok()?;
    let pixels = match image.info.form {
        depthrig_jpeg::Form::Rgb => image.pixels,
        depthrig_jpeg::Form::Grey => image.pixels.iter().flat_map(|v| [*v; 3]).collect(),
    };
    RgbImage::from_raw(image.info.width, image.info.height, pixels)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tile(depths: &[u16]) -> Tile {
        let mut tile = Tile::new("a/depth".parse().unwrap());
        tile.preview = Some(Preview {
            kind: PreviewKind::Depth,
            step: 1,
            width: depths.len() as u16,
            height: 1,
            depth_unit_m: 0.001,
            bytes: depths.iter().flat_map(|d| d.to_le_bytes()).collect(),
        });
        tile
    }

    #[test]
    fn near_is_red_far_is_blue_and_a_hole_is_grey() {
        let tiles = [tile(&[500, 0]), tile(&[4000, 1000, 60000])];
        let range = range(&tiles);
        assert!((range.near - 0.5).abs() < 1e-6 && (range.far - 60.0).abs() < 1e-3, "{range:?}");
        let shown = depth(tiles[0].preview.as_ref().unwrap(), Range { near: 0.5, far: 4.0 }).unwrap();
        assert!(shown[(0, 0)][0] > shown[(0, 0)][2] + 50);
        assert_eq!(shown[(1, 0)].0, HOLE);
        let shown = depth(tiles[1].preview.as_ref().unwrap(), Range { near: 0.5, far: 4.0 }).unwrap();
        assert!(shown[(0, 0)][2] > shown[(0, 0)][0] + 50);
        assert_eq!(shown[(0, 0)], shown[(2, 0)]);
    }

    #[test]
    fn a_range_is_never_empty() {
        for tiles in [vec![], vec![tile(&[0, 0])], vec![tile(&[2000; 9])], vec![tile(&[1; 9])]] {
            let range = range(&tiles);
            assert!(range.near >= NEAREST_M && range.far >= range.near + MIN_SPAN_M - 1e-6, "{range:?}");
        }
    }
}
