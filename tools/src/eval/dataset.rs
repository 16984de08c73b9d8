//! The images of a depthrig dataset with ground truth.

use super::read::{Metres, Raw, to_units};
use super::{Images, Job, Loaded, Place, Source};
use crate::image_file::{depth_m, to_rgb};
use anyhow::{Context, Result, bail};
use depthrig_bus::sync::lock;
use depthrig_bus::{FrameHeader, Intrinsics, PixelFormat, StreamName};
use depthrig_calib::{PoseExt, Registration, same_view};
use depthrig_cdm::stage::pixels::UNIT_OF_METRES;
use depthrig_recorder::{Dataset, DatasetFrame, PixelMode, SetRange, Sets};
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::{Arc, Mutex};

/// Streams that are evaluated by default, if present.
const PREDICTIONS: [&str; 3] = ["depth", "depth_aligned", "depth_refined"];
/// Streams that serve as ground truth by default, best first.
const TRUTHS: [&str; 2] = ["depth_true_color", "depth_true"];
/// Streams that refiners get by default, best first.
const RAWS: [&str; 2] = ["depth", "depth_aligned"];
const OTHER_MOMENT: &str = "are of another moment than the truth of their set";
const NO_TRUTH: &str = "have no truth in their set";
/// Prediction and truth are of one moment when their capture times are this near: capture times of two streams differ by
/// half their exposures, and frames of 60 Hz are 16 ms apart.
const SAME_MOMENT_NS: u64 = 8_000_000;

/// The sets of a dataset.
pub struct FromDataset {
    sets: Sets,
    shared: Arc<Shared>,
    total: u64,
}

/// State shared by all jobs.
struct Shared {
    names: Vec<String>,
    /// Camera and stream by number.
    streams: Vec<(String, String)>,
    truth: Vec<String>,
    /// Row of the stream that refiners get.
    raw: Option<usize>,
    /// Refiners need colour in the view of the truth.
    refining: bool,
    /// Name of the dataset.
    scene: String,
    /// Registrations that are not in use, by the numbers of the two streams.
    registrations: Mutex<BTreeMap<(usize, usize), Vec<Registration>>>,
}

/// The streams of a dataset to use; empty lists mean the usual ones.
pub struct Streams<'a> {
    /// Streams to evaluate.
    pub predictions: &'a [StreamName],
    /// Reference.
    pub truth: Option<&'a StreamName>,
    /// Stream that refiners get.
    pub raw: Option<&'a StreamName>,
    /// Whether there are refiners.
    pub refining: bool,
}

impl FromDataset {
    /// Opens the dataset at `path`.
    pub fn open(path: &Path, of: &Streams<'_>) -> Result<Self> {
        let dataset = Dataset::open(path)?;
        let records = &dataset.session().streams;
        let streams: Vec<_> =
            records.iter().map(|r| (r.id.camera.to_string(), r.id.stream.to_string())).collect();
        let has = |name: &str| streams.iter().any(|(_, s)| s == name);
        let all = || records.iter().map(|r| r.id.to_string()).collect::<Vec<_>>().join(", ");
        let truth: Vec<String> = match of.truth {
            Some(name) => vec![name.to_string()],
            None => TRUTHS.iter().filter(|t| has(t)).map(|t| (*t).to_owned()).collect(),
        };
        if !truth.iter().any(|t| has(t)) {
            bail!(
                "{}: it has no truth to compare with ({}); simulated cameras record it with `truth = true`. It has {}",
                path.display(),
                if truth.is_empty() { TRUTHS.join(" or ") } else { truth.join(", ") },
                all()
            );
        }
        let mut names: Vec<String> = if of.predictions.is_empty() {
            PREDICTIONS.iter().filter(|p| has(p)).map(|p| (*p).to_owned()).collect()
        } else {
            of.predictions.iter().map(ToString::to_string).collect()
        };
        let raw = of.raw.map(ToString::to_string).or_else(|| {
            let usual = RAWS.iter().find(|r| has(r) && (of.refining || names.iter().any(|n| n == *r)));
            usual.map(|r| (*r).to_owned())
        });
        if let Some(raw) = raw.as_ref().filter(|r| !names.contains(r)) {
            names.insert(0, raw.clone());
        }
        if of.refining && raw.is_none() {
            bail!(
                "{}: no camera has a stream {}; name raw depth with --raw",
                path.display(),
                RAWS.join(" or ")
            );
        }
        if let Some(missing) = names.iter().find(|n| !has(n)) {
            bail!("{}: no camera has a stream {missing}; there are {}", path.display(), all());
        }
        if names.is_empty() {
            bail!(
                "{}: none of {} is in it; name streams with --pred",
                path.display(),
                PREDICTIONS.join(", ")
            );
        }
        let total = dataset.session().outcome.as_ref().map_or(0, |o| o.sets_recorded);
        let sets = dataset.sets_with(SetRange::ALL, PixelMode::Stored);
        let shared = Shared {
            raw: raw.and_then(|r| names.iter().position(|n| *n == r)),
            refining: of.refining,
            scene: path.file_name().unwrap_or_default().to_string_lossy().into_owned(),
            names,
            streams,
            truth,
            registrations: Mutex::default(),
        };
        Ok(Self { sets, shared: Arc::new(shared), total })
    }
}

impl Source for FromDataset {
    fn names(&self) -> &[String] {
        &self.shared.names
    }

    fn total(&self) -> u64 {
        self.total
    }

    fn next(&mut self) -> Option<Result<Job>> {
        let set = match self.sets.next()? {
            Ok(set) => set,
            Err(e) => return Some(Err(e.into())),
        };
        let shared = Arc::clone(&self.shared);
        Some(Ok(Box::new(move || {
            let mut images = Images::default();
            for (i, (camera, _)) in shared.streams.iter().enumerate() {
                // Of a relabelled dataset the refined streams come after those of all cameras.
                if shared.streams[..i].iter().any(|(earlier, _)| earlier == camera) {
                    continue;
                }
                shared.of_camera(camera, set.id, &set.frames, &mut images)?;
            }
            Ok(images)
        })))
    }

    fn left_out(&self) -> Vec<String> {
        Vec::new()
    }
}

impl Shared {
    /// Adds what `camera` has in a set.
    fn of_camera(&self, camera: &str, set: u64, frames: &[DatasetFrame], images: &mut Images) -> Result<()> {
        let frame = |stream: &str| {
            let is_it = |f: &&DatasetFrame| {
                self.streams.get(f.stream).is_some_and(|(c, s)| c == camera && s == stream)
            };
            frames.iter().find(is_it)
        };
        let mut omit = |why: &str, n: u64| *images.omitted.entry(why.to_owned()).or_default() += n;
        let wanted: Vec<_> =
            self.names.iter().enumerate().filter_map(|(k, n)| Some((k, frame(n)?))).collect();
        if wanted.is_empty() {
            return Ok(());
        }
        let Some(truth_frame) = self.truth.iter().find_map(|t| frame(t)) else {
            omit(NO_TRUTH, wanted.len() as u64);
            return Ok(());
        };
        let truth = metres(truth_frame)?;
        let mut predictions = Vec::new();
        let mut raw = None;
        for (k, f) in wanted {
            let off = f.header.capture_time_ns.abs_diff(truth_frame.header.capture_time_ns);
            if off > SAME_MOMENT_NS {
                omit(OTHER_MOMENT, 1);
            } else if Some(k) == self.raw
                && (self.refining || f.header.pixel_format() == Some(PixelFormat::Z16))
            {
                raw = Some((k, self.raw_in_view_of(f, truth_frame)?));
            } else {
                predictions.push((k, self.in_view_of(f, truth_frame)?));
            }
        }
        let color = match frame("color").map(|f| self.color(f, truth_frame)) {
            // For the report alone it is not needed.
            Some(Err(_)) if !self.refining => None,
            color => color.transpose()?,
        };
        let h = &truth_frame.header;
        images.loaded.push(Loaded {
            group: camera.to_owned(),
            place: Place {
                name: format!("{camera}, set {set}"),
                scene: self.scene.clone(),
                sequence: self.scene.clone(),
            },
            lens: Some(h.intrinsics).filter(Intrinsics::is_known),
            truth: Arc::new(truth),
            predictions,
            raw,
            color: color.map(Arc::new),
            material: None,
        });
        Ok(())
    }

    /// Colour as RGB; refiners need it in the view of the truth.
    fn color(&self, frame: &DatasetFrame, truth: &DatasetFrame) -> Result<image::RgbImage> {
        let a = &frame.header;
        let b = &truth.header;
        let same = same_view(
            (&a.intrinsics, (a.width, a.height), &a.pose),
            (&b.intrinsics, (b.width, b.height), &b.pose),
        );
        if self.refining && !same {
            bail!(
                "{}: refiners need the truth in the view of colour, {}x{}; {} is in another one or of another size ({}x{}): use --truth {} \
                 of that size",
                a.camera(),
                a.width,
                a.height,
                b.stream(),
                b.width,
                b.height,
                TRUTHS[0]
            );
        }
        to_rgb(a, &frame.decoded()?)
    }

    /// Raw depth where `truth` looks.
    fn raw_in_view_of(&self, frame: &DatasetFrame, truth: &DatasetFrame) -> Result<Raw> {
        let h = &frame.header;
        if h.pixel_format() != Some(PixelFormat::Z16) {
            let Metres { width, height, pixels } = self.in_view_of(frame, truth)?;
            return Ok(Raw { width, height, pixels: to_units(&pixels), unit_m: UNIT_OF_METRES });
        }
        let pixels = match self.moved(frame, truth)? {
            Some(moved) => moved,
            None => rows(h, &frame.decoded()?)?,
        };
        let t = &truth.header;
        Ok(Raw { width: t.width as usize, height: t.height as usize, pixels, unit_m: h.depth_unit_m })
    }

    /// The depth of `frame` where `truth` looks.
    fn in_view_of(&self, frame: &DatasetFrame, truth: &DatasetFrame) -> Result<Metres> {
        let Some(moved) = self.moved(frame, truth)? else { return metres(frame) };
        let t = &truth.header;
        let raw = Raw {
            width: t.width as usize,
            height: t.height as usize,
            pixels: moved,
            unit_m: frame.header.depth_unit_m,
        };
        Ok(raw.metres())
    }

    /// Depth that looks elsewhere, moved into the view of `truth`; `None` when it is there already.
    fn moved(&self, frame: &DatasetFrame, truth: &DatasetFrame) -> Result<Option<Vec<u16>>> {
        let a = &frame.header;
        let b = &truth.header;
        let view = |h: &FrameHeader| (h.intrinsics, (h.width, h.height), h.pose);
        let (ka, sa, pa) = view(a);
        let (kb, sb, pb) = view(b);
        if frame.stream == truth.stream || same_view((&ka, sa, &pa), (&kb, sb, &pb)) {
            return Ok(None);
        }
        let what = || format!("{}: depth cannot be registered to the view of its ground truth", a.camera());
        if a.pixel_format() != Some(PixelFormat::Z16) {
            bail!("{}: only z16 depth can be moved to another view", what());
        }
        let key = (frame.stream, truth.stream);
        let known = self.pool().get_mut(&key).and_then(Vec::pop);
        let mut registration = if let Some(registration) = known {
            registration
        } else {
            let between = pb.inverse().compose(&pa);
            Registration::new(&ka, sa, &kb, sb, &between).with_context(what)?
        };
        let pixels = rows(a, &frame.decoded()?)?;
        let mut out = vec![0u16; sb.0 as usize * sb.1 as usize];
        registration.depth_to_color(&pixels, a.depth_unit_m, &mut out).with_context(what)?;
        self.pool().entry(key).or_default().push(registration);
        Ok(Some(out))
    }

    fn pool(&self) -> std::sync::MutexGuard<'_, BTreeMap<(usize, usize), Vec<Registration>>> {
        lock(&self.registrations)
    }
}

/// 16-bit pixels without padding.
fn rows(h: &FrameHeader, bytes: &[u8]) -> Result<Vec<u16>> {
    let row = 2 * h.width as usize;
    let stride = h.stride as usize;
    let all = (0..h.height as usize).map(|y| bytes.get(y * stride..y * stride + row));
    let all = all.collect::<Option<Vec<_>>>().context("an image is shorter than its header says")?;
    Ok(all.into_iter().flat_map(|r| r.as_chunks::<2>().0).map(|b| u16::from_le_bytes(*b)).collect())
}

fn metres(frame: &DatasetFrame) -> Result<Metres> {
    let h = &frame.header;
    let pixels = depth_m(h, &frame.decoded()?)?;
    let pixels = pixels.with_context(|| format!("{}: a stream to compare is not depth", h.camera()))?;
    Ok(Metres { width: h.width as usize, height: h.height as usize, pixels })
}
