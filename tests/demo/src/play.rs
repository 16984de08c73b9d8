//! Plays the OAK's images as a camera of another process, where Luxonis' library is not installed.
//!
//! usage: `demo-recordings --play FOLDER`; rig and camera are those of `DEPTHRIG_RIG` and `DEPTHRIG_CAMERA`.

use anyhow::{Context, Result, bail};
use depthrig_bus::external::{About, ExternalCamera, ExternalFrame, Mode, Place, Session};
use depthrig_bus::{HostTime, Name, PixelFormat};
use std::path::Path;
use std::time::Duration;

/// Images a second.
const RATE_HZ: f64 = 15.0;
/// Unit of the images' depth, metres.
const UNIT_M: f64 = 0.001;

/// The images of one stream.
struct Images {
    size: (u32, u32),
    frames: Vec<Vec<u8>>,
}

impl Images {
    /// Reads the images of a folder in the order of their names.
    fn read(folder: &Path, format: PixelFormat) -> Result<Self> {
        let listed =
            std::fs::read_dir(folder).with_context(|| format!("{}: cannot be read", folder.display()))?;
        let mut paths = listed.map(|e| Ok(e?.path())).collect::<Result<Vec<_>>>()?;
        paths.sort();
        let mut images = Self { size: (0, 0), frames: Vec::new() };
        for path in paths {
            let image =
                image::open(&path).with_context(|| format!("{}: cannot be decoded", path.display()))?;
            images.size = (image.width(), image.height());
            images.frames.push(match format {
                PixelFormat::Z16 => image.into_luma16().iter().flat_map(|v| v.to_le_bytes()).collect(),
                _ => image.into_rgb8().into_raw(),
            });
        }
        if images.frames.is_empty() {
            bail!("{}: there are no images", folder.display());
        }
        Ok(images)
    }
}

/// Serves the images of `folder` until the daemon ends this process.
pub fn run(folder: &Path) -> Result<()> {
    let intrinsics = super::oak::intrinsics()?;
    let formats = [("color", PixelFormat::Rgb8), ("depth", PixelFormat::Z16)];
    let mut streams = Vec::new();
    let mut modes = Vec::new();
    for (name, format) in formats {
        let images = Images::read(&folder.join(name), format)?;
        let mode = Mode::new(Name::new(name)?, format, images.size.0, images.size.1, RATE_HZ)
            .with_device_clock(32, 1_000_000, 32);
        let depth_unit_m = if format == PixelFormat::Z16 { UNIT_M } else { 0.0 };
        modes.push(Mode { intrinsics, depth_unit_m, simulated: true, ..mode });
        streams.push(images);
    }
    let about = About {
        model: "OAK, simulated".to_owned(),
        serial: "oak-images".to_owned(),
        calibration: "simulated".to_owned(),
        program: "demo-recordings".to_owned(),
        ..About::default()
    };
    let mut camera = ExternalCamera::offer(&Place::from_environment()?, &about, &modes)?;
    loop {
        if let Some(mut session) = camera.next_session(Duration::from_secs(1))? {
            serve(&mut session, &streams)?;
        }
    }
}

/// Sends frames for as long as they are wanted.
fn serve(session: &mut Session<'_>, streams: &[Images]) -> Result<()> {
    let running: Vec<usize> = session.modes().map(|(i, _)| i).collect();
    let start = HostTime::now();
    session.started();
    let mut number: u64 = 0;
    while session.is_wanted() {
        number += 1;
        std::thread::sleep(start.plus(Duration::from_secs_f64(number as f64 / RATE_HZ)).from_now());
        let now = HostTime::now();
        let facts = ExternalFrame {
            device_sequence: number & 0xFFFF_FFFF,
            device_time: (now.ns() as u64 / 1000) & 0xFFFF_FFFF,
            arrival_time_ns: now.ns(),
            ..ExternalFrame::default()
        };
        for index in &running {
            let Some(frames) = streams.get(*index).map(|s| &s.frames) else { continue };
            let pixels = &frames[number as usize % frames.len()];
            session.send_copy(*index, &facts, pixels)?;
        }
    }
    if let Some(why) = session.refusal() {
        eprintln!("the daemon refuses the frames: {why}");
    }
    Ok(())
}
