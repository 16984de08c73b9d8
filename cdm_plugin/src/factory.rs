//! From options to a refiner: the one place that knows every engine.

use crate::{
    CdmRefiner, EngineKind, Error, ErrorKind, FillRefiner, OnnxNetwork, Refiner, RefinerOptions, Result,
};

/// The refiner that `options` ask for.
///
/// # Errors
/// [`ErrorKind::BadInput`] for options that contradict each other, [`ErrorKind::Unsupported`] for an engine that this
/// build has not, and those of the engine: [`ErrorKind::NoEngine`], [`ErrorKind::BadModel`],
/// [`ErrorKind::OutOfMemory`].
pub fn refiner(options: &RefinerOptions) -> Result<Box<dyn Refiner>> {
    let engine = options.engine_kind();
    if engine.needs_model() && options.model.is_none() {
        let message = format!(
            "the engine {engine} needs a model and none was given; install one with `depthrig cdm import FILE` or \
             `depthrig cdm fetch NAME`, or use the engine fill, which needs none"
        );
        return Err(Error::new(ErrorKind::BadInput, message));
    }
    if engine == EngineKind::Fill {
        return Ok(Box::new(FillRefiner::new(options.threads)?));
    }
    if let (EngineKind::OnnxRuntime, Some(model)) = (engine, &options.model) {
        let network = OnnxNetwork::open(model, options)?;
        return Ok(Box::new(CdmRefiner::new(Box::new(network), model, options.input_size)?));
    }
    let message = format!("the engine {engine} is not part of this build");
    Err(Error::new(ErrorKind::Unsupported, message))
}
