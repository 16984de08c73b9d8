//! From options to a refiner: the one place that knows every engine.

use crate::{
    CdmRefiner, EngineKind, Error, ErrorKind, FillRefiner, OnnxNetwork, Refiner, RefinerOptions, Result,
    TinyRefiner,
};

/// The refiner that `options` ask for.
///
/// # Errors
/// [`ErrorKind::BadInput`] for options that contradict each other, [`ErrorKind::Unsupported`] for what the engine or this
/// build has not, and those of the engine: [`ErrorKind::NoEngine`], [`ErrorKind::BadModel`],
/// [`ErrorKind::OutOfMemory`].
pub fn refiner(options: &RefinerOptions) -> Result<Box<dyn Refiner>> {
    let engine = options.engine_kind();
    match engine {
        EngineKind::Fill => {
            return Ok(Box::new(FillRefiner::new(options.threads)?.with_reach(options.fill_reach)));
        }
        EngineKind::Tiny => return Ok(Box::new(TinyRefiner::open(options)?)),
        EngineKind::OnnxRuntime => {}
    }
    let Some(model) = &options.model else {
        let message = format!(
            "the engine {engine} needs a model and none was given; install one with `depthrig cdm import FILE` or \
             `depthrig cdm fetch NAME`, or use the engine tiny or fill, which need none"
        );
        return Err(Error::new(ErrorKind::BadInput, message));
    };
    let network = OnnxNetwork::open(model, options)?;
    Ok(Box::new(CdmRefiner::new(Box::new(network), model, options.input_size, options.thread_count())?))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn without_a_model_there_is_fill_and_nothing_else() {
        let fill = refiner(&RefinerOptions::default()).unwrap();
        assert!(fill.describe().engine.starts_with("fill") && fill.describe().model.is_empty());
        let options = RefinerOptions { engine: Some(EngineKind::OnnxRuntime), ..RefinerOptions::default() };
        let error = refiner(&options).err().unwrap();
        assert_eq!(error.kind(), ErrorKind::BadInput);
        assert!(error.to_string().contains("onnxruntime"), "{error}");
        assert!(error.to_string().contains("depthrig cdm import"), "{error}");
    }
}
