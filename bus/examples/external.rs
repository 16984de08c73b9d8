//! Serves a test pattern as a camera of a rig, from a process of its own: the smallest external camera there is.
//!
//! ```text
//! cargo run -p depthrig-bus --example external -- [--rig NAME] [--camera NAME] [--size 640x480] [--rate 30] [--frames N]
//! ```
//! Without `--rig` and `--camera` they are those of `DEPTHRIG_RIG` and `DEPTHRIG_CAMERA`, which the daemon sets for the
//! process of a `command`. The rig file needs `backend = "external"` for this camera; docs/external.md says the rest. It
//! streams `color` (a moving ramp) and `depth` (a tilted plane), stamped by a microsecond counter of 32 bits, and stops
//! after `--frames` frames as files at their end do.

use depthrig_bus::external::{About, ExternalCamera, ExternalFrame, ExternalReason, Mode, Place, Session};
use depthrig_bus::{HostTime, Intrinsics, Name, PixelFormat, RuntimeDir};
use std::error::Error;
use std::time::Duration;

struct Options {
    rig: Option<String>,
    camera: Option<String>,
    size: (u32, u32),
    rate_hz: f64,
    frames: u64,
}

fn main() -> Result<(), Box<dyn Error>> {
    let options = options()?;
    let place = match (&options.rig, &options.camera) {
        (Some(rig), Some(camera)) => Place {
            runtime: RuntimeDir::of_user()?,
            rig: Name::new(rig.as_str())?,
            camera: Name::new(camera.as_str())?,
        },
        _ => Place::from_environment()?,
    };
    let about = About {
        model: "Test pattern".to_owned(),
        serial: "pattern-1".to_owned(),
        calibration: "simulated".to_owned(),
        program: "external example".to_owned(),
        ..About::default()
    };
    let mut camera = ExternalCamera::offer(&place, &about, &modes(&options)?)?;
    println!("offering {}/{}", place.rig, place.camera);
    let mut sent = 0;
    while sent < options.frames {
        if let Some(mut session) = camera.next_session(Duration::from_secs(1))? {
            println!("session {} begins", session.number());
            sent = serve(&mut session, &options, sent)?;
            println!("session ends after frame {sent}");
            // So that the daemon has the last frames too before this process and its memory are gone.
            if sent >= options.frames && !session.finish("that was the last frame", Duration::from_secs(5)) {
                eprintln!("the daemon did not say that it has the last frames");
            }
        }
    }
    camera.end(ExternalReason::Finished, "that was the last frame");
    Ok(())
}

/// The modes of the pattern. A real camera has its factory calibration here.
fn modes(options: &Options) -> Result<[Mode; 2], depthrig_bus::Error> {
    let width = f64::from(options.size.0);
    let height = f64::from(options.size.1);
    let intrinsics = Intrinsics::pinhole(width, width, width / 2.0 - 0.5, height / 2.0 - 0.5);
    let mode = |name: &str, format| {
        let mode = Mode::new(Name::new(name)?, format, options.size.0, options.size.1, options.rate_hz);
        let mode = mode.with_device_clock(32, 1_000_000, 32);
        Ok(Mode { intrinsics, simulated: true, ..mode })
    };
    Ok([mode("color", PixelFormat::Rgb8)?, mode("depth", PixelFormat::Z16)?])
}

/// Sends frames as long as they are wanted; returns the number of the last one.
fn serve(session: &mut Session<'_>, options: &Options, mut number: u64) -> Result<u64, depthrig_bus::Error> {
    let running: Vec<(usize, Mode)> = session.modes().map(|(i, mode)| (i, mode.clone())).collect();
    let start = HostTime::now();
    let first = number;
    session.started();
    while session.is_wanted() && number < options.frames {
        number += 1;
        let due = start.plus(Duration::from_secs_f64((number - first) as f64 / options.rate_hz));
        std::thread::sleep(due.from_now());
        // A real device would give these: its counter, and its clock at mid-exposure.
        let now = HostTime::now();
        let facts = ExternalFrame {
            device_sequence: number & 0xFFFF_FFFF,
            device_time: (now.ns() as u64 / 1000) & 0xFFFF_FFFF,
            arrival_time_ns: now.ns(),
            exposure_ns: 8_000_000,
            ..ExternalFrame::default()
        };
        for (index, mode) in &running {
            // Written where the daemon reads it; `send_copy` is for an SDK that has its own memory.
            let Some(mut slot) = session.frame(*index, mode.frame_bytes())? else { continue };
            slot.set_facts(&facts);
            draw(mode, number, slot.pixels_mut());
            session.send(slot)?;
        }
    }
    if let Some(why) = session.refusal() {
        eprintln!("the daemon refuses the frames: {why}");
    }
    Ok(number)
}

/// Byte `i` of row `y` of colour is `i + y + number`; depth is 1 m and a millimetre more with each column.
fn draw(mode: &Mode, number: u64, pixels: &mut [u8]) {
    let row_bytes = mode.format.row_bytes(mode.width) as usize;
    for (y, row) in pixels.chunks_exact_mut(row_bytes).enumerate() {
        if mode.format == PixelFormat::Z16 {
            for (x, pixel) in row.chunks_exact_mut(2).enumerate() {
                pixel.copy_from_slice(&(1000 + x as u16).to_le_bytes());
            }
        } else {
            for (i, byte) in row.iter_mut().enumerate() {
                *byte = (i + y).wrapping_add(number as usize) as u8;
            }
        }
    }
}

fn options() -> Result<Options, Box<dyn Error>> {
    let mut options = Options { rig: None, camera: None, size: (640, 480), rate_hz: 30.0, frames: u64::MAX };
    let mut args = std::env::args().skip(1);
    while let Some(arg) = args.next() {
        let value = args.next().ok_or_else(|| format!("{arg} needs a value"))?;
        match arg.as_str() {
            "--rig" => options.rig = Some(value),
            "--camera" => options.camera = Some(value),
            "--size" => {
                let (w, h) = value.split_once('x').ok_or("--size is WIDTHxHEIGHT")?;
                options.size = (w.parse()?, h.parse()?);
            }
            "--rate" => options.rate_hz = value.parse()?,
            "--frames" => options.frames = value.parse()?,
            _ => return Err(format!("unknown option {arg}").into()),
        }
    }
    Ok(options)
}
