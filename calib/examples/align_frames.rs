//! Registers one image and prints its cost, with which `tests/peers/align.py` compares librealsense.
//!
//! `align_frames SETUP.json DEPTH.z16 OUT.z16 TURNS THREADS` reads little-endian 16-bit depth, writes the registered
//! depth, and prints one line of JSON with the CPU and wall time of each turn, nanoseconds.

use depthrig_bus::{Distortion, HostTime, Intrinsics, Pose};
use depthrig_calib::Registration;
use serde::Deserialize;
use std::error::Error;

#[derive(Deserialize)]
struct Side {
    size: (u32, u32),
    /// fx, fy, cx, cy.
    pinhole: [f64; 4],
    model: Distortion,
    coeffs: [f64; 8],
}

#[derive(Deserialize)]
struct Setup {
    depth: Side,
    color: Side,
    color_from_depth: Pose,
    unit_m: f64,
}

impl Side {
    fn intrinsics(&self) -> Intrinsics {
        let [fx, fy, cx, cy] = self.pinhole;
        Intrinsics { coeffs: self.coeffs, model: self.model as u32, ..Intrinsics::pinhole(fx, fy, cx, cy) }
    }
}

fn main() -> Result<(), Box<dyn Error>> {
    let args: Vec<_> = std::env::args().skip(1).collect();
    let [setup, depth, out, turns, threads] = args.as_slice() else {
        return Err("usage: align_frames SETUP.json DEPTH.z16 OUT.z16 TURNS THREADS".into());
    };
    let setup: Setup = serde_json::from_slice(&std::fs::read(setup)?)?;
    let d = &setup.depth;
    let c = &setup.color;
    let mut registration =
        Registration::new(&d.intrinsics(), d.size, &c.intrinsics(), c.size, &setup.color_from_depth)?
            .with_threads(threads.parse()?);
    let depth: Vec<u16> =
        std::fs::read(depth)?.chunks_exact(2).map(|b| u16::from_le_bytes([b[0], b[1]])).collect();
    let mut registered = vec![0; c.size.0 as usize * c.size.1 as usize];
    let mut cpu = Vec::new();
    let mut wall = Vec::new();
    for _ in 0..turns.parse::<usize>()? {
        let began = (cpu_ns(), HostTime::now().ns());
        registration.depth_to_color(&depth, setup.unit_m, &mut registered)?;
        cpu.push(cpu_ns() - began.0);
        wall.push(HostTime::now().ns() - began.1);
    }
    std::fs::write(out, registered.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<_>>())?;
    println!("{}", serde_json::json!({ "cpu_ns": cpu, "wall_ns": wall }));
    Ok(())
}

/// CPU time of the whole process.
fn cpu_ns() -> i64 {
    let t = rustix::time::clock_gettime(rustix::time::ClockId::ProcessCPUTime);
    t.tv_sec * 1_000_000_000 + t.tv_nsec
}
