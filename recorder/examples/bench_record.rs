//! Measures the cost of recording: `cargo run --release --example bench_record -- [DIR] [SECONDS] [IMAGES]`.
#![allow(clippy::print_stdout, clippy::unwrap_used)]

use depthrig_recorder::bench::{BenchOptions, run};

fn main() {
    let mut args = std::env::args().skip(1);
    let mut options = BenchOptions::default();
    if let Some(dir) = args.next() {
        options.dir = dir.into();
    }
    if let Some(seconds) = args.next() {
        options.seconds = seconds.parse().unwrap();
    }
    options.images = args.next().map(Into::into);
    println!("{}", serde_json::to_string_pretty(&run(&options).unwrap()).unwrap());
}
