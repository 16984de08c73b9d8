//! Selects the refiner for a camera's settings and opens it: models, engines and their stand-ins.

use super::{CdmConfig, EngineChoice, RefineConfig, RefineModel};
use crate::onnxruntime::library_file;
use crate::{EngineKind, ErrorKind, Precision, Refiner, RefinerOptions, Result};

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
    /// How far `fill` and `tiny` fill, as in [`RefineConfig`].
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
    is_tiny_default: bool,
}

impl Installed {
    /// Those that `cdm` says.
    pub fn new(cdm: CdmConfig) -> Self {
        Self { cdm, is_tiny_default: crate::tiny::model().is_default }
    }

    /// The plan of `auto` without a model for a camera of this kind.
    fn without_model(&self, fill_reach: f64, device_model: &str) -> Plan {
        if !self.is_tiny_default {
            return bare(EngineKind::Fill, fill_reach, Some(missing(EngineKind::Fill, device_model)));
        }
        match library_file(self.cdm.library.as_deref(), "cpu") {
            Ok(_) => {
                let note = Some(missing(EngineKind::Tiny, device_model));
                Plan { may_fill: true, ..bare(EngineKind::Tiny, fill_reach, note) }
            }
            Err(e) => {
                let note = format!("{}; nor can tiny run: {e}", missing(EngineKind::Fill, device_model));
                bare(EngineKind::Fill, fill_reach, Some(note))
            }
        }
    }
}

/// An engine without a model, with the reach of filling, and why it runs.
fn bare(engine: EngineKind, fill_reach: f64, note: Option<String>) -> Plan {
    Plan {
        engine,
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
        let on = if self.engine.needs_model() { format!(" on {}", self.device) } else { String::new() };
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
            EngineChoice::Fill | EngineChoice::Off => bare(EngineKind::Fill, config.fill_reach, None),
            EngineChoice::Tiny => Plan {
                model: config.model.clone(),
                precision: config.precision,
                device: config.device.clone(),
                ..bare(EngineKind::Tiny, config.fill_reach, None)
            },
            EngineChoice::Auto if config.model.is_some() => {
                network(EngineKind::OnnxRuntime, config.model.clone(), true)
            }
            EngineChoice::Auto => match super::models::installed_for(&self.cdm, device_model) {
                Some(name) => network(EngineKind::OnnxRuntime, Some(RefineModel::Installed(name)), true),
                None => self.without_model(config.fill_reach, device_model),
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
                let refiner = self.make(&bare(EngineKind::Fill, plan.fill_reach, None), threads)?;
                Ok(Opened { refiner, note: Some(note) })
            }
            // Cameras that share it may have different reasons for it; these are in their plans.
            opened => opened.map(|refiner| Opened { refiner, note: None }),
        }
    }
}

/// Why `engine` stands in for a device's model.
fn missing(engine: EngineKind, device_model: &str) -> String {
    match super::models::for_camera(device_model) {
        Some(name) => {
            format!(
                "{engine} stands in for the model {name}, which is not installed (depthrig cdm fetch {name})"
            )
        }
        None => format!("{engine} is used: no camera depth model is known for \"{device_model}\""),
    }
}

/// Whether `fill` stands in after such an error: for something missing, not for something damaged or full.
const fn stands_in(kind: ErrorKind) -> bool {
    matches!(kind, ErrorKind::NotFound | ErrorKind::NoEngine | ErrorKind::Unsupported)
}

impl Installed {
    fn make(&self, plan: &Plan, threads: usize) -> Result<Box<dyn Refiner>> {
        let own = plan.model.as_ref().filter(|_| plan.engine == EngineKind::Tiny);
        let tiny = own.map(super::models::open_tiny).transpose()?;
        let model = plan.model.as_ref().filter(|_| own.is_none());
        let model = model.map(|m| super::models::open(&self.cdm, m)).transpose()?;
        crate::refiner(&RefinerOptions {
            engine: Some(plan.engine),
            model,
            tiny,
            input_size: plan.input_size,
            precision: plan.precision,
            device: plan.device.clone(),
            threads,
            library: self.cdm.library.clone(),
            fill_reach: plan.fill_reach,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn installed(is_tiny_default: bool, library: &str, models: &std::path::Path) -> Installed {
        let cdm =
            CdmConfig { library: Some(library.into()), models: Some(models.into()), ..CdmConfig::default() };
        Installed { cdm, is_tiny_default }
    }

    #[test]
    fn auto_takes_tiny_where_it_is_a_default_and_the_library_is_there() {
        let home = tempfile::tempdir().unwrap();
        let library = home.path().join("libonnxruntime.so.1.31.1");
        std::fs::write(&library, "").unwrap();
        let there = library.to_str().unwrap();
        let auto = RefineConfig { fill_reach: 0.25, device: "cuda:0".into(), ..RefineConfig::default() };
        let plan = |is_default, library, device| {
            let plan = installed(is_default, library, home.path()).plan(&auto, device);
            assert_eq!((plan.fill_reach, plan.device.as_str(), &plan.model), (0.25, "cpu", &None));
            (plan.engine, plan.may_fill, plan.note.unwrap())
        };
        let (engine, may_fill, note) = plan(true, there, "D435");
        assert_eq!((engine, may_fill), (EngineKind::Tiny, true));
        assert!(note.starts_with("tiny stands in for the model cdm-d435, which is not installed"), "{note}");
        let (engine, _, note) = plan(true, there, "webcam");
        assert_eq!(
            (engine, note.as_str()),
            (EngineKind::Tiny, "tiny is used: no camera depth model is known for \"webcam\"")
        );
        let (engine, _, note) = plan(true, "/none/such.so", "D435");
        assert_eq!(engine, EngineKind::Fill);
        for part in ["fill stands in for the model cdm-d435", "/none/such.so", "pip install onnxruntime"] {
            assert!(note.contains(part), "{part} in {note}");
        }
        let (engine, _, note) = plan(false, there, "D435");
        assert_eq!(engine, EngineKind::Fill);
        assert!(note.starts_with("fill stands in for") && !note.contains("tiny"), "{note}");

        // A library that is there and cannot be used is known only when it is loaded.
        let refiners = installed(true, there, home.path());
        let Opened { refiner, note } = refiners.open(&refiners.plan(&auto, "D435"), 1).unwrap();
        assert_eq!(refiner.describe().engine, "fill");
        assert!(note.unwrap().starts_with("fill stands in for tiny: "));
    }

    #[test]
    fn tiny_that_is_asked_for_runs_or_fails_with_the_cure() {
        let home = tempfile::tempdir().unwrap();
        let tiny = RefineConfig { engine: EngineChoice::Tiny, ..RefineConfig::default() };
        for is_default in [false, true] {
            let refiners = installed(is_default, "/none/such.so", home.path());
            let plan = refiners.plan(&tiny, "D435");
            assert_eq!((plan.engine, plan.may_fill, &plan.note), (EngineKind::Tiny, false, &None));
            assert_eq!(plan.describe(), "tiny");
            let error = refiners.open(&plan, 1).err().unwrap();
            assert_eq!(error.kind(), ErrorKind::NoEngine);
            assert!(error.to_string().contains("pip install onnxruntime"), "{error}");
        }
    }
}
