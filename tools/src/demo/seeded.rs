//! A camera depth model end to end, with random weights: from a checkpoint on disk to a frame that a subscriber reads.
//!
//! The output is not depth; it shows that the full pipeline works on this computer, and how long it takes.

use crate::context::private_folder;
use anyhow::{Context as _, Result};
use core::time::Duration;
use depthrig_bus::{Bus, HostTime, Name, RuntimeDir, StageStep};
use depthrig_cdm::stage::{EngineChoice, RefineConfig, RefineModel};
use depthrig_cdm::{Encoder, Precision};
use depthrig_daemon::config::RigConfig;
use depthrig_daemon::rig::{Rig, RigOptions};
use depthrig_daemon::status::RefineState;
use serde::Serialize;

/// The camera that is refined.
const CAMERA: &str = "d435";
/// Shorter side of the network's input: enough to see it work.
const INPUT_SIZE: u32 = 252;
/// Timeout for the first frame.
const TIMEOUT: Duration = Duration::from_mins(1);

/// Result of the run.
#[derive(Debug, Clone, Default, Serialize)]
pub struct Seeded {
    /// Engine, as named in the frame's header.
    pub engine: String,
    /// Model, as named in the frame's header.
    pub model: String,
    /// From the start of the rig to the frame, seconds; weights and engine are made ready in it.
    pub first_frame_s: f64,
    /// The network for this frame, milliseconds.
    pub infer_ms: f64,
    /// All steps of this frame, milliseconds.
    pub total_ms: f64,
    /// Reason why it did not run.
    pub missing: Option<String>,
}

/// Makes a model of random numbers and runs it in a rig of one simulated camera until its first frame.
pub fn run() -> Result<Seeded> {
    // Searched first, because a rig without the engine's library logs an error.
    if let Err(why) = depthrig_cdm::find_library(None, "cpu", Precision::Fp32) {
        return Ok(Seeded { missing: Some(why.to_string()), ..Seeded::default() });
    }
    let folder = tempfile::tempdir().context("no folder for the random weights")?;
    let weights = folder.path().join("vits.safetensors");
    depthrig_cdm::weights::write_seeded(Encoder::Vits, 7, &weights)?;
    let mut config =
        RigConfig::parse(RigConfig::default_text(), None).map_err(depthrig_daemon::Error::from)?;
    config.cameras.retain(|c| c.name.as_str() == CAMERA);
    for camera in &mut config.cameras {
        camera.refine = Some(RefineConfig {
            engine: EngineChoice::OnnxRuntime,
            model: Some(RefineModel::File(weights.clone())),
            rate_hz: 1.0,
            input_size: Some(INPUT_SIZE),
            ..RefineConfig::default()
        });
    }
    let private = private_folder()?;
    let runtime = RuntimeDir::at(private.path())?;
    let name = Name::new(config.rig.as_str())?;
    let options = RigOptions { serve_api: false, ..RigOptions::new(runtime.clone()) };
    let began = HostTime::now();
    let rig = Rig::start(config, &options)?;
    let bus = Bus::open(&runtime, &name)?;
    let mut refined = bus.subscriber(&format!("{CAMERA}/depth_refined").parse()?)?;
    let mut seen = Seeded::default();
    loop {
        if let Some(frame) = refined.next_timeout(Duration::from_millis(100))? {
            let h = frame.header();
            let ms = |step| h.step_ns(step) as f64 / 1e6;
            (seen.engine, seen.model) = (h.refiner().to_owned(), h.refiner_model().to_owned());
            (seen.infer_ms, seen.total_ms) = (ms(StageStep::Infer), ms(StageStep::Total));
            seen.first_frame_s = began.elapsed().as_secs_f64();
            break;
        }
        let status = rig.control().status();
        let refine = status.cameras.first().and_then(|c| c.refine.as_ref());
        if let Some(failed) = refine.filter(|r| r.state == RefineState::Failed) {
            let why = failed.message.clone().unwrap_or_default();
            seen.missing = Some(why.split("; tried again").next().unwrap_or_default().to_owned());
            break;
        }
        if began.elapsed() > TIMEOUT {
            seen.missing = Some(format!("no frame came within {} s", TIMEOUT.as_secs()));
            break;
        }
    }
    drop(rig);
    Ok(seen)
}
