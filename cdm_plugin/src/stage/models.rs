//! The models of this computer, by name or by camera.

use crate::stage::{CdmConfig, RefineModel};
use crate::tiny::TinyFile;
use crate::{Encoder, Error, ErrorKind, Model, ModelStore, Result, published};

/// The name of the published model that serves a device, if there is one.
pub fn for_camera(device_model: &str) -> Option<&'static str> {
    published::for_camera(device_model).map(|p| p.name)
}

/// The name of the installed model that serves a device, if there is one: the published one, or one that names the device
/// among its cameras.
pub fn installed_for(config: &CdmConfig, device_model: &str) -> Option<String> {
    // An unreadable folder is reported when a model of it is asked for by name.
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

/// Reads the network that the engine `tiny` is to run.
///
/// # Errors
/// Those of [`TinyFile::read`]; [`ErrorKind::BadInput`] for the name of an installed model.
pub fn open_tiny(model: &RefineModel) -> Result<TinyFile> {
    match model {
        RefineModel::File(path) => TinyFile::read(path),
        RefineModel::Installed(name) => {
            let what = format!("the engine tiny runs a file NAME.onnx, not the installed model {name}");
            Err(Error::new(ErrorKind::BadInput, what))
        }
    }
}

/// The size of a model's network and the shorter side of its input, as far as its record says: nothing is read of files.
///
/// # Errors
/// Those of the store; [`ErrorKind::NotFound`] for a file that is not there.
pub fn look(config: &CdmConfig, model: &RefineModel) -> Result<Option<(Encoder, u32)>> {
    match model {
        RefineModel::Installed(name) => {
            let record = store(config)?.info(name)?.record;
            Ok(Some((record.encoder, record.input_size)))
        }
        RefineModel::File(path) if path.is_file() => Ok(None),
        RefineModel::File(path) => {
            let what = format!("the checkpoint {} is not there", path.display());
            Err(Error::new(ErrorKind::NotFound, what))
        }
    }
}

fn store(config: &CdmConfig) -> Result<ModelStore> {
    ModelStore::open(config.models.as_deref())
}
