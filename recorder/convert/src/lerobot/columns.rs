//! Columns of the exported dataset: one feature per stream, the columns that LeRobot prescribes, and our own.

use super::table::{Kind, Layout};
use crate::Source;
use crate::rows::images::Form;
use crate::rows::schema::{Feature, Schema, calibration};
use depthrig_bus::PixelFormat;
use depthrig_recorder::StreamRecord;
use serde::Serialize;
use serde::ser::Serializer;
use serde_json::{Value, json};

/// Columns that LeRobot prescribes (`DEFAULT_FEATURES` in its `constants.py`).
const PRESCRIBED: [(&str, Kind); 5] = [
    ("timestamp", Kind::Float32),
    ("frame_index", Kind::Int64),
    ("episode_index", Kind::Int64),
    ("index", Kind::Int64),
    ("task_index", Kind::Int64),
];

/// Columns of our own for each set. Their names do not begin with `observation`: LeRobot would take them for the
/// state of a robot and feed them to the policy.
const PER_SET: [(&str, Kind); 3] =
    [("capture.utc_ns", Kind::Int64), ("capture.set_id", Kind::Int64), ("capture.spread_ns", Kind::Int64)];

/// The column that says where a judged task was done: in the last row of an episode that succeeded.
const SUCCESS: &str = "next.success";

/// The name of a stream's images.
pub(super) fn image_key(feature: &Feature) -> String {
    format!("observation.images.{}", feature.short)
}

fn capture_key(feature: &Feature) -> String {
    format!("capture.utc_ns.{}", feature.short)
}

fn missing_key(feature: &Feature) -> String {
    format!("missing.{}", feature.short)
}

/// The number that the loader divides pixel values by.
pub(super) const fn divisor(form: Form) -> f64 {
    match form {
        Form::Color | Form::Grey8 => 255.0,
        _ => 1.0,
    }
}

/// Notes for readers of the export, in words.
pub(super) fn losses(schema: &Schema, sources: &[Source]) -> Vec<String> {
    let mut losses = vec![
        "timestamp is frame_index / fps, as LeRobot demands; the true times are in capture.utc_ns and \
         capture.utc_ns.CAMERA_STREAM, nanoseconds since 1970"
            .to_owned(),
        "where a stream has no frame there is a blank image, and missing.CAMERA_STREAM is true".to_owned(),
    ];
    let has_unit = |f: &&Feature| {
        sources.first().and_then(|source| record(f, source)).is_some_and(|s| lerobot_unit(s).is_some())
    };
    for f in schema.features.iter().filter(|f| f.form.is_depth() && !has_unit(f)) {
        losses.push(format!(
            "{} is in the camera's units, neither metres nor millimetres: LeRobot hands its values on as they \
             are; multiply by depthrig.depth_unit_m in meta/info.json",
            image_key(f)
        ));
    }
    losses
}

/// Name and kind of every column of one number, in the order of the rows' values.
pub(super) fn numbers(schema: &Schema) -> Vec<(String, Kind)> {
    let fixed = PRESCRIBED.iter().chain(&PER_SET).map(|(name, kind)| ((*name).to_owned(), *kind));
    let capture = schema.features.iter().map(|f| (capture_key(f), Kind::Int64));
    let missing = schema.features.iter().map(|f| (missing_key(f), Kind::Bool));
    let masks = schema.masks().map(|v| (format!("missing.{}", v.key), Kind::Bool));
    let success = schema.is_judged().then(|| (SUCCESS.to_owned(), Kind::Bool));
    fixed.chain(capture).chain(missing).chain(masks).chain(success).collect()
}

/// Whether the values of a number column never fall within an episode.
pub(super) fn ordered(name: &str) -> bool {
    PRESCRIBED.iter().any(|(n, _)| *n == name) || name == "capture.utc_ns" || name == "capture.set_id"
}

/// The data table: images, then numbers, then vectors.
pub(super) fn layout(schema: &Schema) -> Layout {
    let images = schema.features.iter().map(|f| {
        // JPEG and PNG are packed already.
        (image_key(f), Kind::Image { packed: f.form.is_depth() })
    });
    // LeRobot stores a vector of one number as that number.
    let vectors = schema.vectors.iter().map(|v| {
        let length = v.names().len();
        (v.key.to_owned(), if length == 1 { Kind::Float32 } else { Kind::Floats { length } })
    });
    let columns: Vec<_> = images.chain(numbers(schema)).chain(vectors).collect();
    let features: Ordered<Value> = Ordered(
        columns
            .iter()
            .map(|(name, kind)| {
                let dtype = |d: &str| json!({ "dtype": d, "_type": "Value" });
                let value = match kind {
                    Kind::Image { .. } => json!({ "_type": "Image" }),
                    Kind::Bool => dtype("bool"),
                    Kind::Float32 => dtype("float32"),
                    Kind::Floats { length } => {
                        json!({ "feature": dtype("float32"), "length": length, "_type": "Sequence" })
                    }
                    _ => dtype("int64"),
                };
                (name.clone(), value)
            })
            .collect(),
    );
    // With this the `datasets` library knows an image for one, also without `info.json`.
    let hugging_face = format!(r#"{{"info": {{"features": {}}}}}"#, features.text());
    Layout { columns, footer: vec![("huggingface", hugging_face)] }
}

/// The `features` of `info.json`, in the order of the columns.
pub(super) fn features_json(schema: &Schema, sources: &[Source]) -> Ordered<Value> {
    let mut out = Vec::new();
    for f in &schema.features {
        let feature = json!({
            "dtype": "image",
            "shape": [f.height, f.width, f.form.channels()],
            "names": ["height", "width", "channels"],
            "info": info(f, sources),
        });
        out.push((image_key(f), feature));
    }
    for (name, kind) in numbers(schema) {
        let dtype = match kind {
            Kind::Bool => "bool",
            Kind::Float32 => "float32",
            _ => "int64",
        };
        out.push((name, json!({ "dtype": dtype, "shape": [1], "names": null })));
    }
    for v in &schema.vectors {
        let names = v.names();
        let signals: Vec<_> = v.signals().map(|s| s.id.to_string()).collect();
        let info = json!({ "depthrig.signals": signals, "depthrig.interpolation": schema.rule() });
        let feature = json!({ "dtype": "float32", "shape": [names.len()], "names": names, "info": info });
        out.push((v.key.to_owned(), feature));
    }
    Ordered(out)
}

/// The record of a stream in a dataset.
fn record<'s>(feature: &Feature, source: &'s Source) -> Option<&'s StreamRecord> {
    source.session().streams.iter().find(|s| s.id == feature.id)
}

/// Facts of a stream for `info.json`. Calibration is there only if it is the same in all datasets.
fn info(feature: &Feature, sources: &[Source]) -> Value {
    let Some(s) = sources.first().and_then(|source| record(feature, source)) else { return json!({}) };
    let same = sources
        .iter()
        .filter_map(|source| record(feature, source))
        .all(|o| o.intrinsics == s.intrinsics && o.pose == s.pose && o.serial == s.serial);
    let mut info = json!({
        "is_depth_map": s.format.is_depth(),
        "depthrig.stream": s.id.to_string(),
        "depthrig.format": s.format.name(),
        "depthrig.model": s.model,
    });
    if s.format.is_depth() {
        info["depthrig.depth_unit_m"] = json!(s.depth_unit_m);
        // LeRobot knows metres and millimetres. With another unit it hands the values on as they are.
        if let Some(unit) = lerobot_unit(s) {
            info["depth_unit"] = json!(unit);
        }
    }
    if same {
        for (key, value) in calibration(s) {
            info[format!("depthrig.{key}")] = value;
        }
    }
    info
}

/// LeRobot's name of a depth unit, if it has one.
fn lerobot_unit(s: &StreamRecord) -> Option<&'static str> {
    let is = |unit: f64| (s.depth_unit_m / unit - 1.0).abs() < 1e-6;
    if is(0.001) {
        Some("mm")
    } else if is(1.0) || s.format == PixelFormat::DepthF32 {
        Some("m")
    } else {
        None
    }
}

/// A JSON object whose keys stay in the order given.
#[derive(Debug, Clone)]
pub(super) struct Ordered<T>(pub(super) Vec<(String, T)>);

impl<T: Serialize> Serialize for Ordered<T> {
    fn serialize<S: Serializer>(&self, serializer: S) -> core::result::Result<S::Ok, S::Error> {
        serializer.collect_map(self.0.iter().map(|(k, v)| (k, v)))
    }
}

impl<T: Serialize> Ordered<T> {
    fn text(&self) -> String {
        // Strings, numbers and maps with string keys: there is nothing that could fail.
        serde_json::to_string(self).unwrap_or_default()
    }
}
