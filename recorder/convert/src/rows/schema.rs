//! Streams and vectors of the rows of an export.

use super::images::Form;
use crate::vectors::Vector;
use crate::{Gaps, Source, VectorOptions};
use depthrig_bus::StreamId;
use depthrig_recorder::{Error, ErrorKind, Result, SignalRecord, StreamRecord};
use serde_json::{Value, json};

/// One stream of the rows.
#[derive(Debug, Clone)]
pub(crate) struct Feature {
    pub(crate) id: StreamId,
    pub(crate) form: Form,
    pub(crate) width: u32,
    pub(crate) height: u32,
    /// `camera_stream`.
    pub(crate) short: String,
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

fn bad(message: String) -> Error {
    Error::new(ErrorKind::BadInput, message)
}

impl Schema {
    /// The streams that all datasets have, which must be the same; those that `wanted` refuses are left out.
    pub(crate) fn of(
        sources: &[Source],
        wanted: &dyn Fn(&StreamId) -> bool,
        options: &VectorOptions,
    ) -> Result<Self> {
        let first = sources.first().ok_or_else(|| bad("there is no dataset to export".to_owned()))?;
        let mut features = Vec::<Feature>::new();
        for s in first.session().streams.iter().filter(|s| wanted(&s.id)) {
            let form = Form::of(s.format).ok_or_else(|| {
                bad(format!(
                    "{}: stream {} is {}, for which the layout has no image format; leave it out",
                    first.dataset().path().display(),
                    s.id,
                    s.format.name()
                ))
            })?;
            let short = s.id.to_string().replace('/', "_");
            if let Some(other) = features.iter().find(|f| f.short == short) {
                return Err(bad(format!(
                    "streams {} and {} would both be called {short}; leave one of them out",
                    other.id, s.id
                )));
            }
            features.push(Feature { id: s.id.clone(), form, width: s.width, height: s.height, short });
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

    /// The vectors that have a column for their gaps.
    pub(crate) fn masks(&self) -> impl Iterator<Item = &Vector> {
        self.vectors.iter().filter(|_| self.options.gaps == Gaps::Mask)
    }

    /// Whether there is a column for success.
    pub(crate) const fn is_judged(&self) -> bool {
        self.is_judged
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
        bad(format!("{a} and {b} cannot be episodes of one export: {why}; export them separately"))
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
