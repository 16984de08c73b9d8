//! A folder of images as the OAK bridge plays it: `color/` and `depth/`, of one view, depth in millimetres.

use anyhow::{Context, Result};
use depthrig_bus::{Intrinsics, Name, Pose};
use depthrig_driver::{Backend, Device, MemorySink, StreamRequest};
use depthrig_sim::synthetic::{SyntheticBackend, SyntheticConfig};
use image::{ImageBuffer, Luma, RgbImage};
use std::path::Path;
use std::time::Duration;

/// Different images.
const SHOTS: usize = 12;
/// The simulated model: stereo without a projector, depth and colour in one view, as an OAK-D gives them when it aligns
/// them.
const MODEL: &str = "zed2i";
const SIZE: (u32, u32) = (1280, 720);
/// Every second pixel is kept, in either direction.
const KEPT: u32 = 2;

/// The camera that is simulated.
fn camera() -> Result<Box<dyn Device>> {
    let config = SyntheticConfig {
        model: MODEL.into(),
        serial: "oak".into(),
        seed: 8,
        pose_on_mount: Pose { translation_m: [0.08, -0.10, 0.0], ..Pose::IDENTITY },
        ..SyntheticConfig::default()
    };
    Ok(SyntheticBackend::new(vec![config])?.open(None)?)
}

/// Intrinsics of the written images.
pub fn intrinsics() -> Result<Intrinsics> {
    let device = camera()?;
    let full = device.profiles().iter().find(|p| p.stream.as_str() == "depth" && (p.width, p.height) == SIZE);
    let full = full.context("the simulated OAK has no depth of the size of its images")?.intrinsics;
    // The kept pixel (x, y) is pixel (KEPT x, KEPT y).
    let scale = 1.0 / f64::from(KEPT);
    Ok(Intrinsics::pinhole(full.fx * scale, full.fy * scale, full.cx * scale, full.cy * scale))
}

/// Writes the images into `folder`.
pub fn write(folder: &Path) -> Result<()> {
    let requests = [StreamRequest::any(Name::new("color")?), StreamRequest::any(Name::new("depth")?)];
    let mut stream = camera()?.start(&requests)?;
    let mut sink = MemorySink::default();
    while (0..2).any(|i| sink.delivered(i) < 2 * SHOTS as u64) {
        stream.poll(Duration::from_millis(50), &mut sink)?;
    }
    for (i, name) in ["color", "depth"].into_iter().enumerate() {
        let folder = folder.join(name);
        std::fs::create_dir_all(&folder)?;
        let frames = sink.frames.iter().filter(|f| f.0 == i).step_by(2).take(SHOTS);
        for (n, (_, _, pixels)) in frames.enumerate() {
            let path = folder.join(format!("{n:03}.png"));
            save(&path, name == "color", pixels)
                .with_context(|| format!("{}: cannot be written", path.display()))?;
        }
    }
    Ok(())
}

fn save(path: &Path, is_color: bool, pixels: &[u8]) -> Result<()> {
    let width = SIZE.0 / KEPT;
    let height = SIZE.1 / KEPT;
    let at = |x: u32, y: u32| (y * KEPT * SIZE.0 + x * KEPT) as usize;
    let byte = |i: usize| pixels.get(i).copied().unwrap_or_default();
    if is_color {
        let pixel = |x, y| image::Rgb([0, 1, 2].map(|c| byte(3 * at(x, y) + c)));
        RgbImage::from_fn(width, height, pixel).save(path)?;
    } else {
        let pixel = |x, y| Luma([u16::from_le_bytes([byte(2 * at(x, y)), byte(2 * at(x, y) + 1)])]);
        ImageBuffer::from_fn(width, height, pixel).save(path)?;
    }
    Ok(())
}
