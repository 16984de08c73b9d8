//! Benchmark of the steps around the network: CPU time of one thread from images to the network's input, and from its
//! output to depth. `cargo run --release -p depthrig-cdm --example bench_around`
#![allow(clippy::print_stdout)]

use depthrig_bus::clock::thread_cpu_ns;
use depthrig_cdm::prep::Prep;
use depthrig_cdm::{ChannelOrder, Color, ColorFormat, Output, RawDepth, Result};

const ROUNDS: usize = 200;

fn main() -> Result<()> {
    println!("CPU time of one thread, ms, best and median of {ROUNDS}");
    println!("image    input    prepare        finish, u16    finish, f32");
    for (width, height) in [(1280, 720), (848, 480), (640, 480)] {
        for input_size in [252, 308, 518] {
            let [prepare, units, metres] = measure(width, height, input_size)?;
            let image = format!("{width}x{height}");
            println!("{image:<10} {input_size:<8} {prepare:<14} {units:<14} {metres}");
        }
    }
    Ok(())
}

/// Best and median of each step.
fn measure(width: usize, height: usize, input_size: u32) -> Result<[String; 3]> {
    // A slope with noise: neighbours differ, as they do in a real image.
    let noise = |i: usize| (i.wrapping_mul(0x9e37_79b9) >> 13) % 32;
    let color: Vec<u8> = (0..3 * width * height).map(|i| ((i / 3 % width) / 6 + noise(i)) as u8).collect();
    let depth: Vec<u16> = (0..width * height).map(|i| (700 + i % width + noise(i)) as u16).collect();
    let color = Color { pixels: &color, format: ColorFormat::Rgb8, width, height, stride: 3 * width };
    let depth = RawDepth { pixels: &depth, unit_m: 0.001 };
    let mut prep = Prep::new(width, height, input_size, 6.0)?;
    let plane = prep.net().0 * prep.net().1;
    let mut x = vec![0.0; 4 * plane];
    let mut units = vec![0u16; width * height];
    let mut metres = vec![0f32; width * height];
    let mut times: [Vec<i64>; 3] = Default::default();
    for _ in 0..ROUNDS {
        let start = thread_cpu_ns();
        prep.prepare(&color, &depth, ChannelOrder::Bgr, &mut x)?;
        let prepared = thread_cpu_ns();
        prep.finish(&x[3 * plane..], &mut Output::Units { pixels: &mut units, unit_m: 0.001 })?;
        let as_units = thread_cpu_ns();
        prep.finish(&x[3 * plane..], &mut Output::Metres(&mut metres))?;
        let as_metres = thread_cpu_ns();
        for (times, ns) in times.iter_mut().zip([prepared - start, as_units - prepared, as_metres - as_units])
        {
            times.push(ns);
        }
    }
    Ok(times.map(|mut ns| {
        ns.sort_unstable();
        format!("{:.2} {:.2}", ns[0] as f64 / 1e6, ns[ROUNDS / 2] as f64 / 1e6)
    }))
}
