//! HDF5 in the layout of robomimic: one file with a group for each episode, actions and observations below it. The rows are those of the
//! export to LeRobot.
//!
//! ```text
//! plan (no image is read) ──▶ packed images of each part, in parallel ──▶ demo.hdf5: the parts one after the other, and an index of them
//! ```

mod checksum;
mod format;

use crate::rows::facts::attributes;
use crate::rows::images::{Form, pixels};
use crate::rows::plan::{self, Episode};
use crate::rows::schema::Feature;
use crate::{EpisodeUse, Exporter, Output, Part, PartOut, PartSets, Parts, Plan, RowOptions, Source};
use depthrig_bus::StreamId;
use depthrig_recorder::{Error, ErrorKind, PixelMode, Result};
use format::{Address, Attribute, Chunk, Kind, Objects, SUPERBLOCK_BYTES, pack};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

/// The file.
const FILE: &str = "demo.hdf5";
/// Bytes of a part that are copied at once.
const COPY_BYTES: u64 = 1 << 20;
/// robomimic's number for environments of Gym: of those that it knows, the one without arguments.
const GYM: i64 = 2;

/// The exporter to HDF5.
#[derive(Debug, Default)]
pub struct Hdf5(plan::Planned);

impl Hdf5 {
    /// With these options.
    pub const fn new(options: RowOptions) -> Self {
        Self(plan::Planned::new(options))
    }
}

/// A packed image in the file of its part, behind the one before.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
struct Packed {
    row: u64,
    /// Index of its stream among those of the export.
    place: usize,
    bytes: u32,
    /// When it was taken, UTC nanoseconds since 1970.
    utc_ns: i64,
}

impl Exporter for Hdf5 {
    fn format(&self) -> &'static str {
        "hdf5"
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
        losses.push("a missing image reads as zeros, and is true in missing/CAMERA_STREAM".to_owned());
        if plan.schema.vectors.iter().all(|v| name_of(v.key) != ACTIONS) {
            losses.push(
                "no signal is an action, so there are no actions, which robomimic needs (--action)"
                    .to_owned(),
            );
        }
        Ok(Plan { losses, ..Plan::by_segment(sources) })
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
        let mut file = out.scratch(&scratch_name(part))?;
        let mut all = Vec::new();
        while let Some((number, set)) = sets.next(PixelMode::Stored, out)? {
            let Some(row) = episode.row_of(number) else {
                out.leave_out();
                continue;
            };
            for frame in &set.frames {
                let Some(place) = places.get(frame.stream).copied().flatten() else { continue };
                let form = plan.schema.features[place].form;
                match pixels(form, frame) {
                    Ok(pixels) => {
                        let chunk = pack(kind_of(form), &pixels).map_err(|e| {
                            Error::new(ErrorKind::Codec, "an image cannot be packed").with_source(e)
                        })?;
                        file.append(&chunk)?;
                        let bytes = u32::try_from(chunk.len()).map_err(|e| {
                            Error::new(ErrorKind::BadInput, "an image has 4 GiB").with_source(e)
                        })?;
                        let utc_ns = frame.header.capture_time_ns.saturating_add(set.utc_offset_ns);
                        all.push(Packed { row, place, bytes, utc_ns });
                        out.frame(frame.stream);
                    }
                    Err(e) => out.lose(e.to_string()),
                }
            }
        }
        file.finish()?;
        *out.rows() = serde_json::to_vec(&all).map_err(|e| {
            Error::new(ErrorKind::BadInput, "the index of a part cannot be written").with_source(e)
        })?;
        Ok(())
    }

    fn finish(&self, sources: &[Source], parts: &Parts<'_>, out: &Output<'_>) -> Result<()> {
        let plan = self.0.get()?;
        // It has its name once it is complete.
        if let Some(file) = out.open_file(FILE)? {
            let bytes = file.size().map_err(|e| Error::reading("open", &out.dir().join(FILE), e))?;
            out.keep(bytes);
            return Ok(());
        }
        let mut images = 0;
        let mut episodes = Vec::with_capacity(sources.len());
        for source in 0..sources.len() {
            let mut all = Vec::new();
            for part in parts.rows(source) {
                let packed: Vec<Packed> = serde_json::from_slice(&part?).map_err(unread)?;
                for image in packed {
                    all.push((image, SUPERBLOCK_BYTES + images));
                    images += u64::from(image.bytes);
                }
            }
            episodes.push(all);
        }
        let mut objects = Objects::behind(images);
        let root = write_root(&mut objects, plan, sources, &episodes)?;
        let (superblock, rest) = objects.finish(root);
        let mut file = out.create(FILE)?;
        file.append(&superblock)?;
        for (part, _) in parts.iter() {
            images -= copy(out, &scratch_name(part), &mut file, images)?;
        }
        if images > 0 {
            return Err(changed(out, "the parts of the export"));
        }
        file.append(&rest)?;
        file.finish().map(drop)
    }
}

/// The file of a part, until the export is complete.
fn scratch_name(part: &Part) -> String {
    format!(".part_{:05}_{:08}.images", part.source, part.sets.start)
}

/// Appends the file `name`, of at most `most` bytes, to `to`; its bytes.
fn copy(out: &Output<'_>, name: &str, to: &mut crate::OutFile<'_>, most: u64) -> Result<u64> {
    let Some(file) = out.open_file(name)? else { return Err(changed(out, name)) };
    let failed = |e| Error::reading("read", &out.dir().join(name), e);
    let size = file.size().map_err(failed)?;
    if size > most {
        return Err(changed(out, name));
    }
    let mut at = 0;
    while at < size {
        let mut bytes = vec![0; (size - at).min(COPY_BYTES) as usize];
        file.read_exact_at(&mut bytes, at).map_err(failed)?;
        to.append(&bytes)?;
        at += bytes.len() as u64;
    }
    Ok(size)
}

fn changed(out: &Output<'_>, what: &str) -> Error {
    let dir = out.dir().display();
    Error::new(ErrorKind::Corrupt, format!("{dir} has lost {what}; remove the folder and export again"))
}

fn unread(e: serde_json::Error) -> Error {
    let what = "the index of a part is not as depthrig wrote it; export into a new folder";
    Error::new(ErrorKind::Corrupt, what).with_source(e)
}

const ACTIONS: &str = "actions";

/// The name of a vector: robomimic's for the action, that of the export to Zarr for the state.
fn name_of(key: &str) -> &'static str {
    if key == "action" { ACTIONS } else { "state" }
}

const fn kind_of(form: Form) -> Kind {
    match form {
        Form::Color | Form::Grey8 => Kind::U8,
        Form::Grey16 | Form::Depth16 => Kind::U16,
        Form::DepthF32 => Kind::F32,
    }
}

/// Adds everything of a file; `episodes` are the packed images of each and their addresses.
fn write_root(
    objects: &mut Objects,
    plan: &plan::Plan,
    sources: &[Source],
    episodes: &[Vec<(Packed, u64)>],
) -> Result<Address> {
    let mut demos = Vec::with_capacity(sources.len());
    for (i, source) in sources.iter().enumerate() {
        demos.push((demo_name(i), write_demo(objects, plan, source, &plan.episodes[i], &episodes[i])));
    }
    let text = |value: Value| {
        let failed = |e| Error::new(ErrorKind::BadInput, "an attribute cannot be written").with_source(e);
        serde_json::to_string(&value).map(Attribute::Text).map_err(failed)
    };
    let rig = sources.first().map_or("", |s| &s.session().rig);
    let environment = text(json!({ "env_name": rig, "type": GYM, "env_kwargs": {} }))?;
    let attributes_of_data = [("total", Attribute::Int(plan.rows() as i64)), ("env_args", environment)];
    let data = objects.group(&demos, &attributes_of_data);
    let mut masks = Vec::new();
    for (name, is_success) in [("success", true), ("failure", false)] {
        let names: Vec<_> = (0..sources.len())
            .filter(|i| is_judged(&sources[*i]) && plan.episodes[*i].is_success == is_success)
            .map(demo_name)
            .collect();
        if !names.is_empty() {
            masks.push((name.to_owned(), write_names(objects, &names)));
        }
    }
    let mut members = vec![("data".to_owned(), data)];
    if !masks.is_empty() {
        members.push(("mask".to_owned(), objects.group(&masks, &[])));
    }
    let facts = text(attributes(plan, sources, "depthrig.hdf5/1", &name_of))?;
    Ok(objects.group(&members, &[("depthrig", facts)]))
}

fn demo_name(i: usize) -> String {
    format!("demo_{i}")
}

fn is_judged(source: &Source) -> bool {
    source.episode().is_some_and(|e| e.outcome.is_some())
}

/// Adds the group of an episode.
fn write_demo(
    objects: &mut Objects,
    plan: &plan::Plan,
    source: &Source,
    episode: &Episode,
    images: &[(Packed, u64)],
) -> Address {
    let rows = episode.rows as usize;
    let numbers: Vec<_> = source.numbers().filter(|n| episode.row_of(*n).is_some()).collect();
    let mut obs = Vec::new();
    let mut missing = Vec::new();
    let mut captures = Vec::new();
    let mut members = Vec::new();
    for (place, feature) in plan.schema.features.iter().enumerate() {
        let mut is_missing = vec![1_u8; rows];
        let mut times = vec![0_i64; rows];
        let mut chunks = Vec::new();
        for (image, address) in images.iter().filter(|(image, _)| image.place == place) {
            let row = image.row as usize;
            if let (Some(mark), Some(time)) = (is_missing.get_mut(row), times.get_mut(row)) {
                (*mark, *time) = (0, image.utc_ns);
                chunks.push(Chunk { row: image.row, address: *address, bytes: image.bytes });
            }
        }
        let shape = image_shape(feature, rows);
        obs.push((feature.short.clone(), objects.images(kind_of(feature.form), &shape, &chunks)));
        missing.push((feature.short.clone(), objects.array(Kind::Bool, &[rows as u64], &is_missing)));
        captures.push((feature.short.clone(), write_times(objects, &times)));
    }
    for (v, vector) in plan.schema.vectors.iter().enumerate() {
        let mut values = Vec::new();
        let mut is_missing = Vec::with_capacity(rows);
        for number in &numbers {
            let row = episode.moments.row(v, *number);
            values.extend(row.into_iter().flat_map(|r| &r.values).flat_map(|x| x.to_le_bytes()));
            is_missing.push(u8::from(row.is_none_or(|r| r.is_missing)));
        }
        let name = name_of(vector.key);
        let array = objects.array(Kind::F32, &[rows as u64, vector.names().len() as u64], &values);
        (if name == ACTIONS { &mut members } else { &mut obs }).push((name.to_owned(), array));
        missing.push((name.to_owned(), objects.array(Kind::Bool, &[rows as u64], &is_missing)));
    }
    // The last action ends the episode, and is rewarded if its task was done.
    let last = |value: f32| (0..rows).map(move |row| if row + 1 == rows { value } else { 0.0 });
    let rewards: Vec<u8> = last(f32::from(u8::from(episode.is_success))).flat_map(f32::to_le_bytes).collect();
    let dones: Vec<u8> = last(1.0).map(|done| done as u8).collect();
    let times: Vec<_> = numbers.iter().map(|n| source.times()[*n]).collect();
    members.push(("obs".to_owned(), objects.group(&obs, &[])));
    members.push(("rewards".to_owned(), objects.array(Kind::F32, &[rows as u64], &rewards)));
    members.push(("dones".to_owned(), objects.array(Kind::U8, &[rows as u64], &dones)));
    members.push(("utc_ns".to_owned(), write_times(objects, &times)));
    members.push(("capture_utc_ns".to_owned(), objects.group(&captures, &[])));
    members.push(("missing".to_owned(), objects.group(&missing, &[])));
    let mut attributes = vec![
        ("num_samples", Attribute::Int(rows as i64)),
        ("task", Attribute::Text(plan.tasks[episode.task].clone())),
        ("session", Attribute::Text(source.session().name.clone())),
    ];
    if is_judged(source) {
        attributes.push(("success", Attribute::Bool(episode.is_success)));
    }
    objects.group(&members, &attributes)
}

fn image_shape(feature: &Feature, rows: usize) -> [u64; 4] {
    [rows as u64, feature.height.into(), feature.width.into(), feature.form.channels() as u64]
}

fn write_times(objects: &mut Objects, times: &[i64]) -> Address {
    let bytes: Vec<u8> = times.iter().flat_map(|t| t.to_le_bytes()).collect();
    objects.array(Kind::I64, &[times.len() as u64], &bytes)
}

/// Adds an array of names, the form of robomimic's filter keys.
fn write_names(objects: &mut Objects, names: &[String]) -> Address {
    let longest = names.iter().map(String::len).max().unwrap_or(0);
    let mut bytes = Vec::with_capacity(names.len() * longest);
    for name in names {
        bytes.extend(name.bytes());
        bytes.resize(bytes.len() + longest - name.len(), 0);
    }
    objects.array(Kind::Text(longest as u32), &[names.len() as u64], &bytes)
}
