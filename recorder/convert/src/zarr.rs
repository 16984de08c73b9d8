//! Zarr (version 2) in the layout of `diffusion_policy`'s replay buffer: below `data` an array for each stream and vector, the rows of
//! all episodes one after the other, and `meta/episode_ends`. The rows are those of the export to LeRobot.
//!
//! A chunk of an image array is one image, so that parts write chunks of their own; a missing image has no chunk and reads as zeros.

use crate::rows::facts::attributes;
use crate::rows::images::{Form, pixels};
use crate::rows::plan;
use crate::rows::schema::Feature;
use crate::{EpisodeUse, Exporter, Output, Part, PartOut, PartSets, Parts, Plan, RowOptions, Source};
use depthrig_bus::StreamId;
use depthrig_recorder::{Error, ErrorKind, PixelMode, Result};
use serde_json::{Value, json};

/// The level of zstd: the fastest, which packs depth nearly as well as the next ones.
const LEVEL: i32 = 1;

/// The exporter to Zarr.
#[derive(Debug, Default)]
pub struct Zarr(plan::Planned);

impl Zarr {
    /// With these options.
    pub const fn new(options: RowOptions) -> Self {
        Self(plan::Planned::new(options))
    }
}

impl Exporter for Zarr {
    fn format(&self) -> &'static str {
        "zarr"
    }

    fn episodes(&self) -> EpisodeUse {
        EpisodeUse::Each
    }

    fn takes(&self, signal: &StreamId) -> bool {
        self.0.takes(signal)
    }

    fn options(&self) -> Value {
        json!(self.0.options)
    }

    fn plan(&mut self, sources: &[Source]) -> Result<Plan> {
        let plan = self.0.make(sources)?;
        let mut losses = plan.losses.clone();
        losses.push("a missing image reads as zeros, and is true in missing_CAMERA_STREAM".to_owned());
        let arrays = names(plan).into_iter().map(|name| format!("data/{name}"));
        let folders =
            ["data".to_owned(), "meta".to_owned(), ENDS.to_owned()].into_iter().chain(arrays).collect();
        Ok(Plan { folders, losses, ..Plan::by_segment(sources) })
    }

    fn part(
        &self,
        source: &Source,
        part: &Part,
        sets: &mut PartSets<'_>,
        out: &mut PartOut<'_>,
    ) -> Result<()> {
        let plan = self.0.get()?;
        let episode = &plan.episodes[part.source];
        let places = plan.schema.places(source);
        let mut present = Vec::new();
        while let Some((number, set)) = sets.next(PixelMode::Stored, out)? {
            let Some(row) = episode.row_of(number) else {
                out.leave_out();
                continue;
            };
            let row = episode.first_row + row;
            for frame in &set.frames {
                let Some(place) = places.get(frame.stream).copied().flatten() else { continue };
                let feature = &plan.schema.features[place];
                match pixels(feature.form, frame) {
                    Ok(bytes) => {
                        let name = format!("data/{}/{row}{}", feature.short, inner_chunks(feature.form));
                        out.file(&name, &packed(&bytes)?)?;
                        out.frame(frame.stream);
                        present.push((row, place));
                    }
                    Err(e) => out.lose(e.to_string()),
                }
            }
        }
        *out.rows() = serde_json::to_vec(&present).map_err(unwritten)?;
        Ok(())
    }

    fn finish(&self, sources: &[Source], parts: &Parts<'_>, out: &Output<'_>) -> Result<()> {
        let plan = self.0.get()?;
        let rows = plan.rows() as usize;
        let mut missing = vec![vec![1_u8; rows]; plan.schema.features.len()];
        for source in 0..sources.len() {
            for part in parts.rows(source) {
                let present: Vec<(usize, usize)> = serde_json::from_slice(&part?).map_err(unread)?;
                for (row, place) in present {
                    if let Some(cell) = missing.get_mut(place).and_then(|m| m.get_mut(row)) {
                        *cell = 0;
                    }
                }
            }
        }
        for (feature, missing) in plan.schema.features.iter().zip(&missing) {
            let head = image_head(feature, rows);
            write_json(out, &format!("data/{}/.zarray", feature.short), &head)?;
            array(out, &format!("data/missing_{}", feature.short), "|b1", &[rows], missing)?;
        }
        let mut times = Vec::with_capacity(rows);
        let mut vectors: Vec<Vec<u8>> = vec![Vec::new(); plan.schema.vectors.len()];
        let mut masks: Vec<Vec<u8>> = vec![Vec::new(); plan.schema.vectors.len()];
        for (source, episode) in sources.iter().zip(&plan.episodes) {
            for number in source.numbers().filter(|n| episode.row_of(*n).is_some()) {
                times.push(source.times()[number]);
                for (v, (values, mask)) in vectors.iter_mut().zip(&mut masks).enumerate() {
                    let row = episode.moments.row(v, number);
                    values.extend(row.into_iter().flat_map(|r| &r.values).flat_map(|x| x.to_le_bytes()));
                    mask.push(u8::from(row.is_none_or(|r| r.is_missing)));
                }
            }
        }
        array(out, "data/utc_ns", "<i8", &[rows], &bytes_of(&times))?;
        for ((vector, values), mask) in plan.schema.vectors.iter().zip(&vectors).zip(&masks) {
            let name = short_of(vector.key);
            array(out, &format!("data/{name}"), "<f4", &[rows, vector.names().len()], values)?;
            array(out, &format!("data/missing_{name}"), "|b1", &[rows], mask)?;
        }
        let ends: Vec<_> = plan.episodes.iter().map(|e| (e.first_row + e.rows) as i64).collect();
        array(out, ENDS, "<i8", &[ends.len()], &bytes_of(&ends))?;
        for group in ["data/", "meta/", ""] {
            write_json(out, &format!("{group}.zgroup"), &json!({ "zarr_format": 2 }))?;
        }
        let facts = attributes(plan, sources, "depthrig.zarr/1", &short_of);
        write_json(out, ".zattrs", &json!({ "depthrig": facts }))
    }
}

const ENDS: &str = "meta/episode_ends";

/// The arrays below `data`.
fn names(plan: &plan::Plan) -> Vec<String> {
    let streams = plan.schema.features.iter().map(|f| f.short.clone());
    let vectors = plan.schema.vectors.iter().map(|v| short_of(v.key).to_owned());
    let both: Vec<_> = streams.chain(vectors).collect();
    let missing: Vec<_> = both.iter().map(|name| format!("missing_{name}")).collect();
    [both, missing, vec!["utc_ns".to_owned()]].concat()
}

/// LeRobot's `observation.state` is `state` here.
fn short_of(key: &'static str) -> &'static str {
    key.rsplit('.').next().unwrap_or(key)
}

/// The chunk's numbers behind that of the row.
const fn inner_chunks(form: Form) -> &'static str {
    if form.channels() == 1 { ".0.0" } else { ".0.0.0" }
}

fn image_head(feature: &Feature, rows: usize) -> Value {
    let kind = match feature.form {
        Form::Color | Form::Grey8 => "|u1",
        Form::Grey16 | Form::Depth16 => "<u2",
        Form::DepthF32 => "<f4",
    };
    let mut image = vec![feature.height as usize, feature.width as usize];
    if feature.form.channels() > 1 {
        image.push(feature.form.channels());
    }
    let of = |n: usize| core::iter::once(n).chain(image.iter().copied()).collect::<Vec<_>>();
    head(kind, &of(rows), &of(1))
}

/// The `.zarray` of an array.
fn head(kind: &str, shape: &[usize], chunks: &[usize]) -> Value {
    json!({
        "zarr_format": 2,
        "shape": shape,
        "chunks": chunks,
        "dtype": kind,
        "compressor": { "id": "zstd", "level": LEVEL },
        "fill_value": if kind == "|b1" { json!(false) } else { json!(0) },
        "order": "C",
        "filters": null,
    })
}

/// Writes an array of one chunk.
fn array(out: &Output<'_>, name: &str, kind: &str, shape: &[usize], bytes: &[u8]) -> Result<()> {
    let chunk: Vec<_> = shape.iter().map(|n| (*n).max(1)).collect();
    write_json(out, &format!("{name}/.zarray"), &head(kind, shape, &chunk))?;
    let first = vec!["0"; shape.len()].join(".");
    out.file(&format!("{name}/{first}"), &packed(bytes)?)
}

fn bytes_of(numbers: &[i64]) -> Vec<u8> {
    numbers.iter().flat_map(|n| n.to_le_bytes()).collect()
}

fn packed(bytes: &[u8]) -> Result<Vec<u8>> {
    let failed = |e| Error::new(ErrorKind::Codec, "a chunk cannot be packed").with_source(e);
    zstd::bulk::compress(bytes, LEVEL).map_err(failed)
}

fn write_json(out: &Output<'_>, name: &str, value: &Value) -> Result<()> {
    out.file(name, &serde_json::to_vec_pretty(value).map_err(unwritten)?)
}

fn unwritten(e: serde_json::Error) -> Error {
    Error::new(ErrorKind::BadInput, "the description of an array cannot be written").with_source(e)
}

fn unread(e: serde_json::Error) -> Error {
    let what = "the marks of a part are not as depthrig wrote them; export into a new folder";
    Error::new(ErrorKind::Corrupt, what).with_source(e)
}
