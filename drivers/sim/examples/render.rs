//! Writes what every simulated camera sees as PNGs: colour, depth as the sensor reports it, and true depth.
//!
//! `cargo run --release -p depthrig-sim --example render -- OUT_DIR [MODEL …]`
#![allow(clippy::print_stdout)]

use depthrig_bus::{HostTime, PixelFormat, Pose};
use depthrig_driver::{Backend, MemorySink};
use depthrig_sim::synthetic::{SyntheticBackend, SyntheticConfig, models, prepare_all};
use std::error::Error;
use std::path::PathBuf;
use std::time::Duration;

fn main() -> Result<(), Box<dyn Error>> {
    let mut args = std::env::args().skip(1);
    let out = PathBuf::from(args.next().ok_or("usage: render OUT_DIR [MODEL …]")?);
    let chosen: Vec<String> = args.collect();
    let names = models::MODELS.iter().map(|m| m.name).filter(|n| *n != "generic");
    let names: Vec<&str> = names.filter(|n| chosen.is_empty() || chosen.iter().any(|c| c == n)).collect();
    let configs: Vec<_> = names.iter().enumerate().map(|(i, name)| config(name, i, &out)).collect();
    std::fs::create_dir_all(&out)?;

    let began = HostTime::now();
    let cpu = depthrig_bus::clock::process_cpu_ns();
    prepare_all(&configs, &|_, _| ())?;
    let cpu_s = (depthrig_bus::clock::process_cpu_ns() - cpu) as f64 * 1e-9;
    println!("rendered in {:.1} s, {cpu_s:.1} s of CPU", began.elapsed().as_secs_f64());

    let backend = SyntheticBackend::new(configs)?;
    for name in names {
        let mut stream = backend.open(Some(&format!("sim-{name}")))?.start(&[])?;
        let mut sink = MemorySink::default();
        while (0..stream.profiles().len()).any(|i| sink.delivered(i) == 0) {
            stream.poll(Duration::from_millis(100), &mut sink)?;
        }
        for (i, p) in stream.profiles().iter().enumerate() {
            let Some((_, _, pixels)) = sink.frames.iter().find(|f| f.0 == i) else { continue };
            let rgb =
                if p.format == PixelFormat::Z16 { paint(pixels, p.depth_unit_m) } else { pixels.clone() };
            let file = out.join(format!("{name}-{}.png", p.stream));
            image::save_buffer(&file, &rgb, p.width, p.height, image::ExtendedColorType::Rgb8)?;
            println!("{}", file.display());
        }
    }
    Ok(())
}

/// Seven cameras side by side and above each other, as on a plate.
fn config(name: &str, i: usize, out: &std::path::Path) -> SyntheticConfig {
    let column = (i % 4) as f64 - 1.5;
    let row = (i / 4) as f64 - 0.5;
    SyntheticConfig {
        model: name.into(),
        truth: true,
        pose_on_mount: Pose { translation_m: [column * 0.11, row * 0.07, 0.0], ..Pose::IDENTITY },
        cache_dir: out.join("cache"),
        ..SyntheticConfig::default()
    }
}

/// Depth in colours from near (warm) to far (cold) over 0.3 m to 1.8 m; black is "no depth".
fn paint(z16: &[u8], unit_m: f64) -> Vec<u8> {
    let anchors =
        [[180, 4, 38], [253, 141, 60], [254, 224, 120], [120, 198, 140], [49, 130, 189], [40, 30, 90]];
    let color = |counts: u16| {
        if counts == 0 {
            return [0; 3];
        }
        // Even steps of 1/z, as a stereo camera sees them.
        let z = f64::from(counts) * unit_m;
        let far = ((1.0 / 0.3 - 1.0 / z) / (1.0 / 0.3 - 1.0 / 1.8)).clamp(0.0, 1.0) * 4.999;
        let a = anchors[far as usize];
        let b = anchors[far as usize + 1];
        core::array::from_fn(|c| (f64::from(a[c]) + (f64::from(b[c]) - f64::from(a[c])) * far.fract()) as u8)
    };
    z16.chunks_exact(2).flat_map(|b| color(u16::from_le_bytes([b[0], b[1]]))).collect()
}
