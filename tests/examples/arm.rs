//! Publishes the simulated arm as a robot's process would, until it is killed.
//!
//! usage: arm RUNTIME_DIR
#![allow(clippy::unwrap_used)]

use depthrig_bus::RuntimeDir;
use depthrig_sim::synthetic::arm::ArmSignals;
use std::path::Path;

fn main() {
    let folder = std::env::args_os().nth(1).unwrap();
    ArmSignals::new(&RuntimeDir::at(Path::new(&folder)).unwrap()).unwrap().run(|| false).unwrap();
}
