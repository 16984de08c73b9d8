//! From options to a refiner: the one place that knows every engine.

use crate::{
    CdmRefiner, EngineKind, Error, ErrorKind, FillRefiner, Model, Network, OnnxNetwork, Refiner,
    RefinerOptions, Result,
};

/// The refiner that `options` ask for.
///
/// # Errors
/// [`ErrorKind::BadInput`] for options that contradict each other, [`ErrorKind::Unsupported`] for what the engine or this
/// build has not, and those of the engine: [`ErrorKind::NoEngine`], [`ErrorKind::BadModel`],
/// [`ErrorKind::OutOfMemory`].
pub fn refiner(options: &RefinerOptions) -> Result<Box<dyn Refiner>> {
    let engine = options.engine_kind();
    if engine == EngineKind::Fill {
        return Ok(Box::new(FillRefiner::new(options.threads)?.with_reach(options.fill_reach)));
    }
    let Some(model) = &options.model else {
        let message = format!(
            "the engine {engine} needs a model and none was given; install one with `depthrig cdm import FILE` or \
             `depthrig cdm fetch NAME`, or use the engine fill, which needs none"
        );
        return Err(Error::new(ErrorKind::BadInput, message));
    };
    let network = match engine {
        EngineKind::Candle => candle(model, options)?,
        EngineKind::OnnxRuntime | EngineKind::Fill => Box::new(OnnxNetwork::open(model, options)?),
    };
    Ok(Box::new(CdmRefiner::new(network, model, options.input_size)?))
}

#[cfg(feature = "candle")]
fn candle(model: &Model, options: &RefinerOptions) -> Result<Box<dyn Network>> {
    let RefinerOptions { device, precision, .. } = options;
    if device != "cpu" || *precision != crate::Precision::Fp32 {
        let message = format!(
            "the engine candle runs on the device cpu in fp32, and {device} in {precision} was asked for; leave them out, \
             or use the engine onnxruntime"
        );
        return Err(Error::new(ErrorKind::Unsupported, message));
    }
    Ok(Box::new(crate::CandleNetwork::open(model, options.threads)?))
}

#[cfg(not(feature = "candle"))]
fn candle(_: &Model, _: &RefinerOptions) -> Result<Box<dyn Network>> {
    let message = "the engine candle is not part of this build; build depthrig with `--features candle`, or use the engine \
                   onnxruntime";
    Err(Error::new(ErrorKind::Unsupported, message))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn without_a_model_there_is_fill_and_nothing_else() {
        let fill = refiner(&RefinerOptions::default()).unwrap();
        assert!(fill.describe().engine.starts_with("fill") && fill.describe().model.is_empty());
        for engine in [EngineKind::OnnxRuntime, EngineKind::Candle] {
            let options = RefinerOptions { engine: Some(engine), ..RefinerOptions::default() };
            let error = refiner(&options).err().unwrap();
            assert_eq!(error.kind(), ErrorKind::BadInput);
            assert!(error.to_string().contains(engine.name()), "{error}");
            assert!(error.to_string().contains("depthrig cdm import"), "{error}");
        }
    }
}
