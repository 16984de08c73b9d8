//! The images of a depthrig dataset with ground truth.

use super::read::Metres;
use super::{Job, Loaded, Source};
use crate::image_file::depth_m;
use anyhow::{Context, Result, bail};
use depthrig_bus::sync::lock;
use depthrig_bus::{FrameHeader, PixelFormat, StreamName};
use depthrig_calib::{PoseExt, Registration, same_view};
use depthrig_recorder::{Dataset, DatasetFrame, PixelMode, SetRange, Sets};
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};

/// Streams that are evaluated by default, if present.
const PREDICTIONS: [&str; 3] = ["depth", "depth_aligned", "depth_refined"];
/// Streams that serve as ground truth by default, best first.
const TRUTHS: [&str; 2] = ["depth_true_color", "depth_true"];
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
    /// Registrations that are not in use, by the numbers of the two streams.
    registrations: Mutex<BTreeMap<(usize, usize), Vec<Registration>>>,
    other_moment: AtomicU64,
    no_truth: AtomicU64,
}

impl FromDataset {
    /// Opens the dataset at `path`; empty lists mean the usual streams.
    pub fn open(path: &Path, predictions: &[StreamName], truth: Option<&StreamName>) -> Result<Self> {
        let dataset = Dataset::open(path)?;
        let records = &dataset.session().streams;
        let streams: Vec<_> =
            records.iter().map(|r| (r.id.camera.to_string(), r.id.stream.to_string())).collect();
        let has = |name: &str| streams.iter().any(|(_, s)| s == name);
        let all = || records.iter().map(|r| r.id.to_string()).collect::<Vec<_>>().join(", ");
        let truth: Vec<String> = match truth {
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
        let names: Vec<String> = if predictions.is_empty() {
            PREDICTIONS.iter().filter(|p| has(p)).map(|p| (*p).to_owned()).collect()
        } else {
            predictions.iter().map(ToString::to_string).collect()
        };
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
            names,
            streams,
            truth,
            registrations: Mutex::default(),
            other_moment: AtomicU64::new(0),
            no_truth: AtomicU64::new(0),
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
            let mut cameras: Vec<&str> = shared.streams.iter().map(|(c, _)| c.as_str()).collect();
            cameras.dedup();
            let of_camera = |c: &str| shared.of_camera(c, set.id, &set.frames).transpose();
            cameras.into_iter().filter_map(of_camera).collect()
        })))
    }

    fn left_out(&self) -> Vec<String> {
        let said = |n: &AtomicU64, what: &str| {
            let n = n.load(Ordering::Relaxed);
            (n > 0).then(|| format!("{n} images {what}"))
        };
        let other = said(&self.shared.other_moment, "are of another moment than the truth of their set");
        other.into_iter().chain(said(&self.shared.no_truth, "have no truth in their set")).collect()
    }
}

impl Shared {
    fn of_camera(&self, camera: &str, set: u64, frames: &[DatasetFrame]) -> Result<Option<Loaded>> {
        let frame = |stream: &str| {
            let is_it = |f: &&DatasetFrame| {
                self.streams.get(f.stream).is_some_and(|(c, s)| c == camera && s == stream)
            };
            frames.iter().find(is_it)
        };
        let wanted: Vec<_> =
            self.names.iter().enumerate().filter_map(|(k, n)| Some((k, frame(n)?))).collect();
        if wanted.is_empty() {
            return Ok(None);
        }
        let Some(truth_frame) = self.truth.iter().find_map(|t| frame(t)) else {
            self.no_truth.fetch_add(wanted.len() as u64, Ordering::Relaxed);
            return Ok(None);
        };
        let truth = metres(truth_frame)?;
        let mut predictions = Vec::new();
        for (k, f) in wanted {
            let off = f.header.capture_time_ns.abs_diff(truth_frame.header.capture_time_ns);
            if off > SAME_MOMENT_NS {
                self.other_moment.fetch_add(1, Ordering::Relaxed);
                continue;
            }
            predictions.push((k, self.in_view_of(f, truth_frame)?));
        }
        let color = match frame("color") {
            Some(f) => Some((f.header, f.decoded()?)),
            None => None,
        };
        Ok(Some(Loaded {
            group: camera.to_owned(),
            name: format!("{camera}, set {set}"),
            truth,
            predictions,
            color,
        }))
    }

    /// The depth of `frame` where `truth` looks.
    fn in_view_of(&self, frame: &DatasetFrame, truth: &DatasetFrame) -> Result<Metres> {
        let a = &frame.header;
        let b = &truth.header;
        let view = |h: &FrameHeader| (h.intrinsics, (h.width, h.height), h.pose);
        let (ka, sa, pa) = view(a);
        let (kb, sb, pb) = view(b);
        if frame.stream == truth.stream || same_view((&ka, sa, &pa), (&kb, sb, &pb)) {
            return metres(frame);
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
        let pixels = out.iter().map(|d| (f64::from(*d) * a.depth_unit_m) as f32).collect();
        Ok(Metres { width: sb.0 as usize, height: sb.1 as usize, pixels })
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
