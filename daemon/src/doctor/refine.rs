//! Refined depth: models that are not installed, a library that is not there, rates that a CPU does not reach.

use super::finding::{Finding, Severity};
use super::plan::CameraPlan;
use crate::config::{CameraConfig, RigConfig};
use depthrig_cdm::stage::{EngineChoice, RefineConfig};
use depthrig_cdm::stage::{Installed, Plan, Refiners, models};
use depthrig_cdm::{Encoder, EngineKind, find_library};

/// Multiplications and additions a second that one core of a present computer does in such a network, in 32-bit floats: a
/// rough figure, so that only rates that are far off are spoken of.
const CORE_FLOPS: f64 = 60e9;

/// Notes obstacles to refining the cameras' depth as the rig file has it.
pub(super) fn check(config: &RigConfig, plans: &[CameraPlan], findings: &mut Vec<Finding>) {
    let refiners = Installed::new(config.cdm.clone());
    let mut needed = 0.0;
    for camera in &config.cameras {
        let Some(refine) = camera.refine.as_ref().filter(|r| r.engine != EngineChoice::Off) else { continue };
        let device = plans.iter().find(|p| p.name == camera.name.as_str()).and_then(|p| p.device.clone());
        let plan = refiners.plan(refine, &device.unwrap_or_default());
        let found = of_camera(config, refine, &plan);
        findings.extend(found.into_iter().map(|f| f.of(camera.name.as_str())));
        needed += flops_a_second(config, camera, refine, &plan);
    }
    let cores = std::thread::available_parallelism().map_or(1, std::num::NonZero::get);
    let threads = if config.cdm.threads == 0 { cores.saturating_sub(1).max(1) } else { config.cdm.threads };
    let has = threads.min(cores) as f64 * CORE_FLOPS;
    if needed > 2.0 * has {
        findings.push(Finding::new(
            Severity::Warning,
            "refine_too_fast",
            format!(
                "refining depth as asked for is about {:.0} times what {threads} threads of this CPU do",
                needed / has
            ),
            "pairs of images are skipped and counted, and what is refined is older than it need be",
            "lower rate_hz or input_size in [camera.refine], name fewer cameras, or give it a GPU (device = \"cuda:0\")",
        ));
    }
}

fn of_camera(config: &RigConfig, refine: &RefineConfig, plan: &Plan) -> Vec<Finding> {
    let mut findings = Vec::new();
    // A stand-in is worth knowing; an engine that is missing altogether is an error.
    let (severity, then) = if plan.may_fill {
        (Severity::Warning, "the engine fill stands in: it closes holes and corrects nothing")
    } else {
        (Severity::Error, "the camera's depth is not refined; its stream depth_refined stays silent")
    };
    if refine.engine == EngineChoice::Auto
        && let Some(note) = &plan.note
    {
        let (id, why) = if plan.engine == EngineKind::Tiny {
            (
                "refine_tiny",
                "tiny is trained on simulated cameras; a camera depth model is trained for its camera",
            )
        } else {
            (
                "refine_fill",
                "fill closes holes along colour and corrects nothing; a camera depth model does both",
            )
        };
        let cure = format!(
            "install the model (`depthrig cdm import FILE` or `depthrig cdm fetch NAME`), or write engine = \"{}\" if that \
             is meant",
            plan.engine
        );
        findings.push(Finding::new(Severity::Info, id, note.as_str(), why, cure));
    }
    // `tiny` may have a network of its own.
    if plan.engine.needs_model() || (plan.engine == EngineKind::Tiny && plan.model.is_some()) {
        let looked = plan.model.as_ref().map(|m| models::look(&config.cdm, m));
        let missing = match looked {
            Some(Ok(_)) => None,
            Some(Err(e)) => Some(e.to_string()),
            None => Some("no camera depth model is known for this camera".to_owned()),
        };
        if let Some(what) = missing {
            let cure = "`depthrig cdm list` shows what is installed; name one of these, or a checkpoint, as model in \
                        [camera.refine]";
            findings.push(Finding::new(severity, "model_missing", what, then, cure));
        }
    }
    if plan.engine.needs_library()
        && let Err(e) = find_library(config.cdm.library.as_deref(), &plan.device, plan.precision)
    {
        let cure = "do what the message says, or use engine = \"fill\"";
        findings.push(Finding::new(severity, "engine_missing", e.to_string(), then, cure));
    }
    findings
}

/// The network's CPU load for this camera, multiplications and additions a second; 0 when it does not run there.
fn flops_a_second(config: &RigConfig, camera: &CameraConfig, refine: &RefineConfig, plan: &Plan) -> f64 {
    if !plan.engine.needs_model() || plan.device != "cpu" {
        return 0.0;
    }
    let looked = plan.model.as_ref().and_then(|m| models::look(&config.cdm, m).ok().flatten());
    let Some((encoder, size)) = looked else { return 0.0 };
    let side = f64::from(refine.input_size.unwrap_or(size));
    // Images are 16:9 where nothing else is known.
    let tokens = (side / 14.0) * (side * 16.0 / 9.0 / 14.0);
    let rate = if refine.rate_hz > 0.0 { refine.rate_hz } else { fastest(camera) };
    rate * flops(encoder, tokens)
}

/// Of one image: two encoders of `blocks` blocks, each with 12 width² weights and attention over all tokens, and about
/// half as much again for the head.
fn flops(encoder: Encoder, tokens: f64) -> f64 {
    let (width, blocks) = match encoder {
        Encoder::Vits => (384.0, 12.0),
        Encoder::Vitb => (768.0, 12.0),
        Encoder::Vitl => (1024.0, 24.0),
        Encoder::Vitg => (1536.0, 40.0),
    };
    let block = 2.0 * tokens * (12.0 * width * width + 2.0 * tokens * width);
    1.5 * 2.0 * blocks * block
}

fn fastest(camera: &CameraConfig) -> f64 {
    camera.streams.iter().filter_map(|s| s.rate_hz).fold(0.0, f64::max).max(30.0)
}
