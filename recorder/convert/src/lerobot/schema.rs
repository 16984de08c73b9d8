//! Columns of the exported dataset: one feature per stream, the columns that LeRobot prescribes, and our own.

use super::encode::Form;
use super::table::{Kind, Layout};
use crate::vectors::Vector;
use crate::{Gaps, Source, VectorOptions};
use depthrig_bus::{PixelFormat, StreamId};
use depthrig_recorder::{Error, ErrorKind, Result, Session, SignalRecord, StreamRecord};
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

/// One stream as a feature.
#[derive(Debug, Clone)]
pub(crate) struct Feature {
    pub(crate) id: StreamId,
    pub(crate) form: Form,
    pub(crate) width: u32,
    pub(crate) height: u32,
    /// `camera_stream`.
    pub(crate) short: String,
    /// Its facts in `info.json` besides type and shape.
    info: Value,
}

impl Feature {
    /// The name of its images.
    pub(super) fn key(&self) -> String {
        format!("observation.images.{}", self.short)
    }

    fn capture_key(&self) -> String {
        format!("capture.utc_ns.{}", self.short)
    }

    fn missing_key(&self) -> String {
        format!("missing.{}", self.short)
    }

    /// Whether LeRobot has a name for its unit of depth.
    pub(super) fn has_lerobot_unit(&self) -> bool {
        self.info.get("depth_unit").is_some()
    }

    /// The number that the loader divides pixel values by.
    pub(super) const fn divisor(&self) -> f64 {
        match self.form {
            Form::Color | Form::Grey8 => 255.0,
            _ => 1.0,
        }
    }
}

/// The features of an export.
#[derive(Debug, Clone)]
pub(crate) struct Schema {
    pub(crate) features: Vec<Feature>,
    /// The robot's state and action, as far as there are signals for them.
    pub(crate) vectors: Vec<Vector>,
    options: VectorOptions,
    /// Some episode was judged.
    is_judged: bool,
}

/// The column that says where a judged task was done: in the last row of an episode that succeeded.
const SUCCESS: &str = "next.success";

fn bad(message: String) -> Error {
    Error::new(ErrorKind::BadInput, message)
}

impl Schema {
    /// The streams that all datasets have, which must be the same; those that `wanted` refuses are left out.
    pub(super) fn of(
        sources: &[Source],
        wanted: &dyn Fn(&StreamId) -> bool,
        options: &VectorOptions,
    ) -> Result<Self> {
        let first = sources.first().ok_or_else(|| bad("there is no dataset to export".to_owned()))?;
        let mut features = Vec::<Feature>::new();
        for s in first.session().streams.iter().filter(|s| wanted(&s.id)) {
            let form = Form::of(s.format).ok_or_else(|| {
                bad(format!(
                    "{}: stream {} is {}, for which LeRobot has no image format; leave it out",
                    first.dataset().path().display(),
                    s.id,
                    s.format.name()
                ))
            })?;
            let short = s.id.to_string().replace('/', "_");
            if let Some(other) = features.iter().find(|f| f.short == short) {
                return Err(bad(format!(
                    "streams {} and {} would both be called {short} in LeRobot; leave one of them out",
                    other.id, s.id
                )));
            }
            let info = info(s, sources.iter().map(Source::session));
            features.push(Feature { id: s.id.clone(), form, width: s.width, height: s.height, short, info });
        }
        if features.is_empty() {
            return Err(bad(format!("{}: no stream is left to export", first.dataset().path().display())));
        }
        for other in &sources[1..] {
            same_streams(first, other, wanted)?;
        }
        let vectors = Vector::choose(sources, options, ["observation.state", "action"])?;
        let is_judged = sources.iter().any(|s| s.episode().is_some_and(|e| e.outcome.is_some()));
        Ok(Self { features, vectors, options: options.clone(), is_judged })
    }

    /// For each stream of a dataset its feature, if it is exported.
    pub(crate) fn places(&self, source: &Source) -> Vec<Option<usize>> {
        let streams = source.session().streams.iter();
        streams.map(|s| self.features.iter().position(|f| f.id == s.id)).collect()
    }

    /// Notes for readers of the export, in words.
    pub(super) fn losses(&self) -> Vec<String> {
        let mut losses = vec![
            "timestamp is frame_index / fps, as LeRobot demands; the true times are in capture.utc_ns and \
             capture.utc_ns.CAMERA_STREAM, nanoseconds since 1970"
                .to_owned(),
            "where a stream has no frame there is a blank image, and missing.CAMERA_STREAM is true"
                .to_owned(),
        ];
        for f in self.features.iter().filter(|f| f.form.is_depth() && !f.has_lerobot_unit()) {
            losses.push(format!(
                "{} is in the camera's units, neither metres nor millimetres: LeRobot hands its values on as they \
                 are; multiply by depthrig.depth_unit_m in meta/info.json",
                f.key()
            ));
        }
        losses
    }

    /// The same of state and action, for every layout that has them.
    pub(crate) fn vector_losses(&self) -> Vec<String> {
        let mut losses = Vec::new();
        for v in &self.vectors {
            losses.push(format!("{}: {}", v.key, self.rule()));
            let has_text = |s: &&SignalRecord| s.description.has_text();
            losses.extend(v.signals().filter(has_text).map(|s| format!("{}: texts are left out", s.id)));
        }
        losses
    }

    /// The rule for the values of signals at a set, in words.
    pub(crate) fn rule(&self) -> String {
        let max_gap_s = self.options.max_gap_ns as f64 / 1e9;
        let gaps = match self.options.gaps {
            Gaps::Refuse => "",
            Gaps::Mask => "; elsewhere the last value is held, and missing.* is true",
        };
        format!(
            "32-bit floats at the tick of each set (capture.utc_ns): on a line between samples at most {max_gap_s} s apart, \
             rotations on the shorter arc, integers and bools of the sample before{gaps}"
        )
    }

    /// Name and kind of every column of one number, in the order of the rows' values.
    pub(super) fn numbers(&self) -> Vec<(String, Kind)> {
        let fixed = PRESCRIBED.iter().chain(&PER_SET).map(|(name, kind)| ((*name).to_owned(), *kind));
        let capture = self.features.iter().map(|f| (f.capture_key(), Kind::Int64));
        let missing = self.features.iter().map(|f| (f.missing_key(), Kind::Bool));
        let masks = self.masks().map(|v| (format!("missing.{}", v.key), Kind::Bool));
        let success = self.is_judged.then(|| (SUCCESS.to_owned(), Kind::Bool));
        fixed.chain(capture).chain(missing).chain(masks).chain(success).collect()
    }

    /// The vectors that have a column for their gaps.
    pub(super) fn masks(&self) -> impl Iterator<Item = &Vector> {
        self.vectors.iter().filter(|_| self.options.gaps == Gaps::Mask)
    }

    /// Whether there is a column for success.
    pub(super) const fn is_judged(&self) -> bool {
        self.is_judged
    }

    /// Whether the values of a number column never fall within an episode.
    pub(super) fn ordered(name: &str) -> bool {
        PRESCRIBED.iter().any(|(n, _)| *n == name) || name == "capture.utc_ns" || name == "capture.set_id"
    }

    /// The data table: images, then numbers, then vectors.
    pub(super) fn layout(&self) -> Layout {
        let images = self.features.iter().map(|f| {
            // JPEG and PNG are packed already.
            (f.key(), Kind::Image { packed: f.form.is_depth() })
        });
        // LeRobot stores a vector of one number as that number.
        let vectors = self.vectors.iter().map(|v| {
            let length = v.names().len();
            (v.key.to_owned(), if length == 1 { Kind::Float32 } else { Kind::Floats { length } })
        });
        let columns: Vec<_> = images.chain(self.numbers()).chain(vectors).collect();
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
    pub(super) fn features_json(&self) -> Ordered<Value> {
        let mut out = Vec::new();
        for f in &self.features {
            let feature = json!({
                "dtype": "image",
                "shape": [f.height, f.width, f.form.channels()],
                "names": ["height", "width", "channels"],
                "info": f.info,
            });
            out.push((f.key(), feature));
        }
        for (name, kind) in self.numbers() {
            let dtype = match kind {
                Kind::Bool => "bool",
                Kind::Float32 => "float32",
                _ => "int64",
            };
            out.push((name, json!({ "dtype": dtype, "shape": [1], "names": null })));
        }
        for v in &self.vectors {
            let names = v.names();
            let signals: Vec<_> = v.signals().map(|s| s.id.to_string()).collect();
            let info = json!({ "depthrig.signals": signals, "depthrig.interpolation": self.rule() });
            let feature = json!({ "dtype": "float32", "shape": [names.len()], "names": names, "info": info });
            out.push((v.key.to_owned(), feature));
        }
        Ordered(out)
    }
}

/// Facts of a stream for `info.json`. Calibration is there only if it is the same in all datasets.
fn info<'s>(s: &StreamRecord, sessions: impl Iterator<Item = &'s Session>) -> Value {
    let mut all = sessions.filter_map(|session| session.streams.iter().find(|o| o.id == s.id));
    let same = all.all(|o| o.intrinsics == s.intrinsics && o.pose == s.pose && o.serial == s.serial);
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

/// Serial number, intrinsics, pose and where they come from.
pub(crate) fn calibration(s: &StreamRecord) -> [(&'static str, Value); 4] {
    let i = &s.intrinsics;
    let intrinsics = i.is_known().then(|| {
        json!({
            "fx": i.fx, "fy": i.fy, "cx": i.cx, "cy": i.cy,
            "model": i.distortion(), "coeffs": i.coeffs,
        })
    });
    [
        ("serial", json!(s.serial)),
        ("calibration", json!(s.calibration)),
        ("intrinsics", json!(intrinsics)),
        ("pose_on_mount", json!(s.pose)),
    ]
}

/// Streams of two datasets can only be in one table if they are alike.
fn same_streams(a: &Source, b: &Source, wanted: &dyn Fn(&StreamId) -> bool) -> Result<()> {
    let unlike = |why: String| {
        let a = a.dataset().path().display();
        let b = b.dataset().path().display();
        bad(format!("{a} and {b} cannot be episodes of one LeRobot dataset: {why}; export them separately"))
    };
    let describe =
        |s: &StreamRecord| format!("{} {}x{}, unit {} m", s.format.name(), s.width, s.height, s.depth_unit_m);
    let streams = |d: &Source| -> Vec<StreamRecord> {
        d.session().streams.iter().filter(|s| wanted(&s.id)).cloned().collect()
    };
    let of_a = streams(a);
    let of_b = streams(b);
    for s in &of_a {
        match of_b.iter().find(|o| o.id == s.id) {
            None => return Err(unlike(format!("only the first has stream {}", s.id))),
            Some(o) if describe(o) != describe(s) => {
                return Err(unlike(format!(
                    "stream {} is {} in the first, {} in the second",
                    s.id,
                    describe(s),
                    describe(o)
                )));
            }
            Some(_) => {}
        }
    }
    match of_b.iter().find(|o| of_a.iter().all(|s| s.id != o.id)) {
        Some(o) => Err(unlike(format!("only the second has stream {}", o.id))),
        None => Ok(()),
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
