//! The models of this computer, by name or by camera.

use crate::config::{CdmConfig, RefineModel};
use depthrig_cdm::{Model, ModelStore, Result, published};

/// The name of the published model that serves a device, if there is one.
pub fn for_camera(device_model: &str) -> Option<&'static str> {
    published::for_camera(device_model).map(|p| p.name)
}

/// The name of the installed model that serves a device, if there is one: the published one, or one that names the device
/// among its cameras.
pub fn installed_for(config: &CdmConfig, device_model: &str) -> Option<String> {
    // What keeps the folder from being read is said when a model of it is asked for by name.
    store(config).and_then(|s| s.for_camera(device_model)).ok().flatten()
}

/// A model, installed or out of a file.
///
/// # Errors
/// Those of the store and of reading a checkpoint.
pub fn open(config: &CdmConfig, model: &RefineModel) -> Result<Model> {
    match model {
        RefineModel::Installed(name) => store(config)?.get(name),
        RefineModel::File(path) => Model::from_file(path),
    }
}

fn store(config: &CdmConfig) -> Result<ModelStore> {
    ModelStore::open(config.models.as_deref())
}
