//! Runs the network in ONNX Runtime on numbers from files, once for each line of standard input; `tests/peers/cdm.py`
//! drives it beside the official code.
//!
//! `network WEIGHTS DEVICE PRECISION THREADS [LIBRARY]`, then lines `HEIGHT WIDTH X Y`: the file X holds
//! `4 * HEIGHT * WIDTH` little-endian 32-bit floats, Y is written. The first answer is what runs; each line is answered
//! with seconds on the clock, seconds of CPU of all threads, and megabytes that the process has held at most.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use depthrig_bus::clock::{HostTime, process_cpu_ns};
use depthrig_cdm::prep::Positions;
use depthrig_cdm::{ChannelOrder, Model, NetShape, Network, OnnxNetwork, RefinerOptions, Weights};
use std::io::{BufRead, Write};
use std::sync::Arc;

type AnyError = Box<dyn std::error::Error>;

fn peak_mb() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|l| l.starts_with("VmHWM:"))?;
    Some(line.split_whitespace().nth(1)?.parse::<u64>().ok()? / 1024)
}

fn main() -> Result<(), AnyError> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [weights, device, precision, threads, library @ ..] = arguments.as_slice() else {
        return Err("usage: network WEIGHTS DEVICE PRECISION THREADS [LIBRARY]".into());
    };
    let weights = Weights::open(weights)?;
    let encoder = depthrig_cdm::weights::verify(&weights)?;
    let model = Model {
        id: "bench".into(),
        encoder,
        weights: Arc::new(weights),
        channel_order: ChannelOrder::Bgr,
        input_size: 518,
        max_depth_m: 6.0,
    };
    let options = RefinerOptions {
        device: device.clone(),
        precision: precision.parse()?,
        threads: threads.parse()?,
        library: library.first().map(Into::into),
        ..RefinerOptions::default()
    };
    let mut network = OnnxNetwork::open(&model, &options)?;
    let positions = Positions::read(&encoder.architecture(), &model.weights)?;
    let mut prepared = None;
    let mut out = std::io::stdout();
    writeln!(out, "{}", network.describe())?;
    out.flush()?;
    for line in std::io::stdin().lock().lines() {
        let line = line?;
        let [height, width, x, y] = line.split_whitespace().collect::<Vec<_>>()[..] else {
            return Err(format!("{line:?} is not HEIGHT WIDTH X Y").into());
        };
        let shape = NetShape { batch: 1, height: height.parse()?, width: width.parse()? };
        let numbers: Vec<f32> =
            std::fs::read(x)?.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
        let mut result = vec![0f32; shape.output_len()];
        if prepared != Some(shape) {
            network.prepare(shape, &positions.at(shape))?;
            // The first run at a size makes room.
            network.run(&numbers, &mut result)?;
            prepared = Some(shape);
        }
        let wall = HostTime::now();
        let cpu = process_cpu_ns();
        network.run(&numbers, &mut result)?;
        let wall = wall.elapsed().as_secs_f64();
        let cpu = (process_cpu_ns() - cpu) as f64 / 1e9;
        std::fs::write(y, result.iter().flat_map(|n| n.to_le_bytes()).collect::<Vec<_>>())?;
        writeln!(out, "{wall} {cpu} {}", peak_mb().unwrap_or(0))?;
        out.flush()?;
    }
    Ok(())
}
