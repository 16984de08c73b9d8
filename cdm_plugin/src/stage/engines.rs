//! Selects the refiner for a camera's settings and opens it: models, engines and their stand-ins.

use super::{CdmConfig, EngineChoice, RefineConfig, RefineModel};
use crate::Precision;
use crate::{EngineKind, ErrorKind, Refiner, RefinerOptions, Result};

/// Where refiners come from. A rig has the installed ones; tests put others here.
pub trait Refiners: Send + Sync {
    /// The plan for the settings of a camera, `device_model` being the device's own name. Cameras whose plans are equal
    /// share a refiner.
    fn plan(&self, config: &RefineConfig, device_model: &str) -> Plan;

    /// Makes a refiner. May take minutes, and is called on a thread of its own.
    ///
    /// # Errors
    /// Those of the engine and of the models.
    fn open(&self, plan: &Plan, threads: usize) -> Result<Opened>;
}

/// The refiner that settings select.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    /// The engine.
    pub engine: EngineKind,
    /// The model, for engines that need one.
    pub model: Option<RefineModel>,
    /// Shorter side of the network's input; `None`: the model's own.
    pub input_size: Option<u32>,
    /// Precision of the network.
    pub precision: Precision,
    /// The device that it runs on.
    pub device: String,
    /// How far `fill` fills, as in [`RefineConfig`].
    pub fill_reach: f64,
    /// Whether `fill` may stand in when this cannot be had.
    pub may_fill: bool,
    /// Why this plan, where it is not the expected one.
    pub note: Option<String>,
}

/// A refiner that is ready.
pub struct Opened {
    /// The refiner.
    pub refiner: Box<dyn Refiner>,
    /// How it differs from the settings.
    pub note: Option<String>,
}

/// The engines of this build and the models of this computer.
pub struct Installed {
    cdm: CdmConfig,
}

impl Installed {
    /// Those that `cdm` says.
    pub const fn new(cdm: CdmConfig) -> Self {
        Self { cdm }
    }
}

/// `fill` with its reach, and why it runs.
fn fill(fill_reach: f64, note: Option<String>) -> Plan {
    Plan {
        engine: EngineKind::Fill,
        model: None,
        input_size: None,
        precision: Precision::Fp32,
        device: "cpu".to_owned(),
        fill_reach,
        may_fill: false,
        note,
    }
}

impl Plan {
    /// Whether two cameras may share the refiner.
    pub fn is_as(&self, other: &Self) -> bool {
        Self { note: None, ..self.clone() } == Self { note: None, ..other.clone() }
    }

    /// Describes it in words: `onnxruntime on cpu with cdm-d435`.
    pub fn describe(&self) -> String {
        let with = match &self.model {
            None => String::new(),
            Some(RefineModel::Installed(name)) => format!(" with {name}"),
            Some(RefineModel::File(path)) => format!(" with {}", path.display()),
        };
        let on = if self.engine == EngineKind::Fill { String::new() } else { format!(" on {}", self.device) };
        format!("{}{on}{with}", self.engine)
    }
}

impl Refiners for Installed {
    fn plan(&self, config: &RefineConfig, device_model: &str) -> Plan {
        let network = |engine, model, may_fill| Plan {
            engine,
            model,
            input_size: config.input_size,
            precision: config.precision,
            device: config.device.clone(),
            fill_reach: config.fill_reach,
            may_fill,
            note: None,
        };
        // The published name when none is installed, so that the error names the missing model.
        let usual = || {
            let published = || super::models::for_camera(device_model).map(str::to_owned);
            super::models::installed_for(&self.cdm, device_model).or_else(published)
        };
        match config.engine {
            EngineChoice::Fill | EngineChoice::Off => fill(config.fill_reach, None),
            EngineChoice::Auto if config.model.is_some() => {
                network(EngineKind::OnnxRuntime, config.model.clone(), true)
            }
            EngineChoice::Auto => match super::models::installed_for(&self.cdm, device_model) {
                Some(name) => network(EngineKind::OnnxRuntime, Some(RefineModel::Installed(name)), true),
                None => fill(config.fill_reach, Some(missing(device_model))),
            },
            EngineChoice::OnnxRuntime => {
                let model = config.model.clone().or_else(|| usual().map(RefineModel::Installed));
                network(EngineKind::OnnxRuntime, model, false)
            }
        }
    }

    fn open(&self, plan: &Plan, threads: usize) -> Result<Opened> {
        let opened = self.make(plan, threads);
        match opened {
            Err(e) if plan.may_fill && stands_in(e.kind()) => {
                let note = format!("fill stands in for {}: {e}", plan.describe());
                let refiner = self.make(&fill(plan.fill_reach, None), threads)?;
                Ok(Opened { refiner, note: Some(note) })
            }
            // Cameras that share it may have different reasons for it; these are in their plans.
            opened => opened.map(|refiner| Opened { refiner, note: None }),
        }
    }
}

/// Why `fill` stands in for a device.
pub fn missing(device_model: &str) -> String {
    match super::models::for_camera(device_model) {
        Some(name) => {
            format!("fill stands in for the model {name}, which is not installed (depthrig cdm fetch {name})")
        }
        None => format!("fill is used: no camera depth model is known for \"{device_model}\""),
    }
}

/// Whether `fill` stands in after such an error: for something missing, not for something damaged or full.
const fn stands_in(kind: ErrorKind) -> bool {
    matches!(kind, ErrorKind::NotFound | ErrorKind::NoEngine | ErrorKind::Unsupported)
}

impl Installed {
    fn make(&self, plan: &Plan, threads: usize) -> Result<Box<dyn Refiner>> {
        let model = plan.model.as_ref().map(|m| super::models::open(&self.cdm, m)).transpose()?;
        crate::refiner(&RefinerOptions {
            engine: Some(plan.engine),
            model,
            input_size: plan.input_size,
            precision: plan.precision,
            device: plan.device.clone(),
            threads,
            library: self.cdm.library.clone(),
            fill_reach: plan.fill_reach,
        })
    }
}
