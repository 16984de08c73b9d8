//! Writes a recording of an Azure Kinect, as its own recorder would have.
//!
//! `cargo run -p depthrig-kinect-fixture --example kinect_recording -- OUT.mkv [SECONDS [--simulated]]`: 720p JPEG,
//! depth and infrared of the narrow field of view, and motion, at 30 Hz. The images are a pattern, or with
//! `--simulated` what a simulated Kinect sees, 15 of them again and again.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::print_stderr)] // a tool for tests: any failure ends it

use depthrig_kinect_fixture::{Fixture, Pattern, Simulated};
use std::path::PathBuf;

fn main() {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let Some(out) = args.first().map(PathBuf::from) else {
        eprintln!("usage: kinect_recording OUT.mkv [SECONDS [--simulated]]");
        std::process::exit(2);
    };
    let seconds: u32 = args.get(1).map_or(2, |s| s.parse().expect("SECONDS is a whole number"));
    let mut fixture = Fixture { captures: seconds * 30, ..Fixture::default() };
    if args.iter().any(|a| a == "--simulated") {
        let mut images = Simulated::shoot(&mut fixture, 15);
        fixture.write(&out, &mut images).unwrap();
    } else {
        fixture.write(&out, &mut Pattern::new(&fixture)).unwrap();
    }
}
