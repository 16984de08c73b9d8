//! Execution providers of a session with their options: those of the device first, then what it falls back to.
//!
//! Names and values of the options are those of onnxruntime_c_api.h and of the providers' documentation. They are text, so that
//! tests see all that a session is given where no such device is.

use super::device::Device;
use crate::{Precision, durable};
use ort::ep::{self, ArbitrarilyConfigurableExecutionProvider, ExecutionProviderDispatch};
use std::os::unix::fs::DirBuilderExt as _;
use std::path::{Path, PathBuf};

/// A provider of ONNX Runtime.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    TensorRt,
    Cuda,
    OpenVino,
}

/// A provider and its options.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Provider {
    pub(super) kind: Kind,
    pub(super) options: Vec<(&'static str, String)>,
}

/// The providers of a device, best first. Nothing for the CPU, which every session falls back to in the end. `cache` is the
/// folder of the model's compiled engines.
pub(super) fn providers(
    device: &Device,
    precision: Precision,
    threads: usize,
    cache: Option<&Path>,
) -> Vec<Provider> {
    match device {
        Device::Cpu => Vec::new(),
        Device::Cuda(number) => vec![cuda(*number)],
        // Operators that TensorRT lacks run on the same GPU.
        Device::TensorRt(number) => vec![tensorrt(*number, precision, cache), cuda(*number)],
        Device::OpenVino(name) => vec![openvino(name, precision, threads)],
    }
}

const fn flag(value: bool) -> &'static str {
    if value { "1" } else { "0" }
}

fn cuda(number: u32) -> Provider {
    let options = [
        ("device_id", number.to_string()),
        // The arena grows by what is asked for, not to the next power of two: models share the device.
        ("arena_extend_strategy", "kSameAsRequested".into()),
        ("cudnn_conv_algo_search", "HEURISTIC".into()),
        // Products of 19-bit floats would not be what `fp32` says.
        ("use_tf32", flag(false).into()),
    ];
    Provider { kind: Kind::Cuda, options: options.into() }
}

fn tensorrt(number: u32, precision: Precision, cache: Option<&Path>) -> Provider {
    let mut options = vec![
        ("device_id", number.to_string()),
        ("trt_fp16_enable", flag(precision == Precision::Fp16).into()),
        ("trt_bf16_enable", flag(precision == Precision::Bf16).into()),
        // Weights beside the message with the graph, which cannot have more than 2 GB.
        ("trt_load_user_initializer", flag(true).into()),
    ];
    // Engines are named by their graph alone, which models of one size share: each model has a folder.
    if let Some(folder) = cache.and_then(Path::to_str) {
        options.extend([
            ("trt_engine_cache_enable", flag(true).into()),
            ("trt_engine_cache_path", folder.into()),
            ("trt_timing_cache_enable", flag(true).into()),
            ("trt_timing_cache_path", folder.into()),
        ]);
    }
    Provider { kind: Kind::TensorRt, options }
}

fn openvino(name: &str, precision: Precision, threads: usize) -> Provider {
    let hint = match precision {
        Precision::Fp32 => "f32",
        Precision::Fp16 => "f16",
        Precision::Bf16 => "bf16",
    };
    let plugin = name.split('.').next().unwrap_or(name);
    let settings = if plugin == "CPU" {
        // Pinned threads would all sit on the first cores, of every model.
        serde_json::json!({ plugin: {
            "INFERENCE_PRECISION_HINT": hint,
            "INFERENCE_NUM_THREADS": threads,
            "NUM_STREAMS": "1",
            "ENABLE_CPU_PINNING": false,
        }})
    } else {
        serde_json::json!({ plugin: { "INFERENCE_PRECISION_HINT": hint } })
    };
    let options = vec![
        ("device_type", name.to_owned()),
        ("num_of_threads", threads.to_string()),
        ("load_config", settings.to_string()),
    ];
    Provider { kind: Kind::OpenVino, options }
}

impl Provider {
    /// The provider for a session. The first of a list must work, the others are only fallen back to.
    pub(super) fn dispatch(&self, is_first: bool) -> ExecutionProviderDispatch {
        fn with<P: ArbitrarilyConfigurableExecutionProvider>(provider: P, options: &[(&str, String)]) -> P {
            options.iter().fold(provider, |p, (key, value)| p.with_arbitrary_config(*key, value))
        }
        let built = match self.kind {
            Kind::TensorRt => with(ep::TensorRT::default(), &self.options).build(),
            Kind::Cuda => with(ep::CUDA::default(), &self.options).build(),
            Kind::OpenVino => with(ep::OpenVINO::default(), &self.options).build(),
        };
        if is_first { built.error_on_failure() } else { built.fail_silently() }
    }
}

/// Creates the folder for the compiled engines of a model, `id` being its name and the beginning of its hash: below the user's folder for
/// caches, for this user alone. `None`, with a line in the log, after an error: engines are compiled at every start then.
pub(super) fn cache_folder(id: &str) -> Option<PathBuf> {
    let set = |name| std::env::var_os(name).filter(|v| !v.is_empty()).map(PathBuf::from);
    let root = set("XDG_CACHE_HOME").or_else(|| set("HOME").map(|h| h.join(".cache")))?;
    let folder = cache_below(&root, id);
    let created = std::fs::DirBuilder::new().recursive(true).mode(0o700).create(&folder);
    if let Err(e) = created {
        let error = durable::cannot_write(&folder, e);
        tracing::warn!("compiled engines are not kept, so that each start compiles them again: {error}");
        return None;
    }
    Some(folder)
}

fn cache_below(root: &Path, id: &str) -> PathBuf {
    let plain = |c: char| if c.is_ascii_alphanumeric() || "-_.@".contains(c) { c } else { '-' };
    root.join("depthrig/tensorrt").join(id.chars().map(plain).collect::<String>())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(device: &str, precision: Precision, cache: Option<&str>) -> Vec<Provider> {
        providers(&device.parse().unwrap(), precision, 3, cache.map(Path::new))
    }

    fn value<'a>(provider: &'a Provider, key: &str) -> Option<&'a str> {
        let found: Vec<_> = provider.options.iter().filter(|(k, _)| *k == key).collect();
        assert!(found.len() <= 1, "{key} twice");
        found.first().map(|(_, v)| v.as_str())
    }

    #[test]
    fn cuda_is_what_tensorrt_falls_back_to_on_the_same_gpu() {
        let kinds = |device| of(device, Precision::Fp32, None).iter().map(|p| p.kind).collect::<Vec<_>>();
        assert_eq!(kinds("tensorrt:1"), [Kind::TensorRt, Kind::Cuda]);
        assert_eq!(kinds("cuda:1"), [Kind::Cuda]);
        assert_eq!(kinds("openvino"), [Kind::OpenVino]);
        assert!(kinds("cpu").is_empty(), "every session falls back to the CPU by itself");
        for provider in of("tensorrt:1", Precision::Fp32, None) {
            assert_eq!(value(&provider, "device_id"), Some("1"));
        }
    }

    #[test]
    fn precision_is_what_was_asked_for_and_nothing_less() {
        for (precision, fp16, bf16) in
            [(Precision::Fp32, "0", "0"), (Precision::Fp16, "1", "0"), (Precision::Bf16, "0", "1")]
        {
            let [trt, cuda] = &of("tensorrt", precision, None)[..] else { panic!("two") };
            assert_eq!(value(trt, "trt_fp16_enable"), Some(fp16));
            assert_eq!(value(trt, "trt_bf16_enable"), Some(bf16));
            assert_eq!(value(cuda, "use_tf32"), Some("0"));
        }
        let [openvino] = &of("openvino", Precision::Bf16, None)[..] else { panic!("one") };
        let config = value(openvino, "load_config").unwrap();
        assert!(config.contains("\"bf16\"") && config.contains("\"INFERENCE_NUM_THREADS\":3"), "{config}");
    }

    #[test]
    fn engines_and_timings_are_kept_in_a_folder_of_the_model() {
        let [trt, cuda] = &of("tensorrt", Precision::Fp16, Some("/c/m@1f2e3d4c"))[..] else { panic!("two") };
        for (enable, path) in [
            ("trt_engine_cache_enable", "trt_engine_cache_path"),
            ("trt_timing_cache_enable", "trt_timing_cache_path"),
        ] {
            assert_eq!((value(trt, enable), value(trt, path)), (Some("1"), Some("/c/m@1f2e3d4c")));
            assert_eq!((value(cuda, enable), value(cuda, path)), (None, None));
        }
        let [trt, _] = &of("tensorrt", Precision::Fp16, None)[..] else { panic!("two") };
        assert_eq!(value(trt, "trt_engine_cache_enable"), None, "without a folder there is no cache");
        let root = Path::new("/c");
        assert_eq!(
            cache_below(root, "cdm-d435@1f2e3d4c"),
            Path::new("/c/depthrig/tensorrt/cdm-d435@1f2e3d4c")
        );
        assert_ne!(
            cache_below(root, "m@1f2e3d4c"),
            cache_below(root, "m@1f2e3d4d"),
            "another hash, another folder"
        );
        assert_eq!(cache_below(root, "../../x"), Path::new("/c/depthrig/tensorrt/..-..-x"));
    }
}
