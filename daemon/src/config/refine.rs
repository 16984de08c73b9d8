//! `[camera.refine]` and `[cdm]`: whether and how a camera's depth is refined.

use super::read::Section;
use super::value::{MAX_REFINE_HZ, above_zero, not_empty, resolve, within};
use super::wanted::WantedStream;
use super::{CdmConfig, EngineChoice, Precision, RefineConfig, RefineModel};
use depthrig_bus::PixelFormat;
use depthrig_cdm::tiny;
use std::path::{Path, PathBuf};

/// The table of a camera's refined depth.
pub(super) const TABLE: &str = "[camera.refine]";
/// The streams that it makes.
pub(super) const COMPUTED: [&str; 2] = [depthrig_cdm::stage::REFINED, depthrig_cdm::stage::ALIGNED];

const ENGINES: [(&str, EngineChoice); 5] = [
    ("auto", EngineChoice::Auto),
    ("fill", EngineChoice::Fill),
    ("tiny", EngineChoice::Tiny),
    ("onnxruntime", EngineChoice::OnnxRuntime),
    ("off", EngineChoice::Off),
];
const FORMATS: [(&str, PixelFormat); 2] = [("z16", PixelFormat::Z16), ("depth_f32", PixelFormat::DepthF32)];

/// Reads `table` of a camera that is asked for `streams` and whose depth is in `depth` if nothing else is said, or of a host; `None` without
/// the table.
pub(super) fn read(
    camera: &Section<'_, '_>,
    base: &Path,
    streams: &[WantedStream],
    depth: &str,
    table: &'static str,
) -> Option<RefineConfig> {
    let present = camera.has("refine");
    let s = camera.table("refine", table);
    let d = RefineConfig::default();
    let config = RefineConfig {
        engine: s.choice("engine", &ENGINES, d.engine),
        model: s
            .or("model", None, |m: &Option<String>| match m {
                Some(m) if m.trim().is_empty() => {
                    Err("is empty; leave it out for the camera's own model".to_owned())
                }
                _ => Ok(()),
            })
            .map(|name| model(base, &name)),
        rate_hz: s.or("rate_hz", d.rate_hz, |hz| match hz {
            0.0 => Ok(()),
            hz => above_zero(MAX_REFINE_HZ)(hz).map_err(|why| format!("{why}, or 0 for every pair")),
        }),
        input_size: s
            .or("input_size", d.input_size, |n: &Option<u32>| n.map_or(Ok(()), |n| within(56..=2044)(&n))),
        precision: s.choice("precision", &Precision::ALL.map(|p| (p.name(), p)), d.precision),
        device: s.or("device", d.device, |v| device(v)),
        format: s.choice("format", &FORMATS, d.format),
        fill_reach: s.or("fill_reach", d.fill_reach, within(0.0..=1.0)),
        record: s.or("record", d.record, |_| Ok(())),
        align: s.or("align", d.align, |_| Ok(())),
        is_aligned: s.or("is_aligned", d.is_aligned, |_| Ok(())),
        corrected: s.or("corrected", d.corrected, |_| Ok(())),
        depth: s.or("depth", depth.to_owned(), |name: &String| {
            let starts = name == "depth" || name.starts_with("depth_");
            if starts {
                Ok(())
            } else {
                Err(format!("is \"{name}\"; streams of depth are called depth or depth_…"))
            }
        }),
    };
    let at = s.at;
    let useless = |key: &'static str, why: String| {
        let at = s.at_key(key);
        s.problem(at, format!("{} has no use: {why}; remove one of the two", s.key_of(key)));
    };
    let is_tiny_file = |m: &RefineModel| matches!(m, RefineModel::File(path) if tiny::is_tiny_file(path));
    match (config.engine, &config.model) {
        (EngineChoice::Fill, Some(_)) if present => {
            useless("model", "the engine \"fill\" needs no model".to_owned());
        }
        (EngineChoice::Tiny, Some(m)) if present && !is_tiny_file(m) => {
            useless("model", "the engine \"tiny\" runs its own network, or a file NAME.onnx".to_owned());
        }
        _ => {}
    }
    if present && config.engine == EngineChoice::Tiny {
        if config.device != "cpu" {
            useless("device", "the engine \"tiny\" runs on the CPU".to_owned());
        }
        if config.precision != Precision::Fp32 {
            useless("precision", "the engine \"tiny\" computes in fp32".to_owned());
        }
    }
    for key in ["record", "corrected"] {
        if table != TABLE && s.has(key) {
            let what = format!(
                "{} has no use: what comes from another computer is recorded and corrected there; remove it",
                s.key_of(key)
            );
            s.problem(s.at_key(key), what);
        }
    }
    s.finish();
    if !present {
        return None;
    }
    // Both are needed; where no stream is asked for, the camera gives all that it has.
    for needed in ["color", config.depth.as_str()] {
        if !streams.is_empty() && streams.iter().all(|w| w.request.stream.as_str() != needed) {
            let what = format!(
                "{table} needs the stream \"{needed}\", which is not among its [[camera.stream]] tables; add it"
            );
            camera.problem(at, what);
        }
    }
    Some(config)
}

/// Reads `[cdm]`.
pub(super) fn cdm(top: &Section<'_, '_>, base: &Path) -> CdmConfig {
    let d = CdmConfig::default();
    let s = top.table("cdm", "[cdm]");
    let path = |key| {
        s.or(key, None, |p: &Option<PathBuf>| p.as_deref().map_or(Ok(()), not_empty))
            .map(|p| resolve(base, &p))
    };
    let config = CdmConfig {
        threads: s.or("threads", d.threads, within(0..=256)),
        library: path("library"),
        models: path("models"),
        hang_s: s.or("hang_s", d.hang_s, above_zero(3600.0)),
    };
    s.finish();
    config
}

/// A path is a file, anything else the name of an installed model.
fn model(base: &Path, text: &str) -> RefineModel {
    if depthrig_cdm::store::names_a_file(text) {
        RefineModel::File(resolve(base, Path::new(text)))
    } else {
        RefineModel::Installed(text.to_owned())
    }
}

fn device(text: &str) -> Result<(), String> {
    let (kind, number) = text.split_once(':').map_or((text, None), |(k, n)| (k, Some(n)));
    let numbered = number.is_none_or(|n| n.parse::<u8>().is_ok());
    match kind {
        "cpu" | "openvino" if number.is_none() => Ok(()),
        // OpenVINO names devices of its own, such as GPU.
        "openvino" => Ok(()),
        "cuda" | "tensorrt" if numbered => Ok(()),
        _ => Err(format!(
            "is \"{text}\"; it must be cpu, cuda, cuda:1, tensorrt, tensorrt:0 or openvino, the number being that of the GPU"
        )),
    }
}
