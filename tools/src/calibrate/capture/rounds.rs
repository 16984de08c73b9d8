//! Images of all cameras, round by round, from a running rig or from a dataset.

use crate::calibrate::dataset::{DatasetOptions, STREAMS, chosen};
use crate::calibrate::{Looked, grey, seen};
use crate::context::Context;
use crate::exit::UsageError;
use crate::image_file;
use crate::live::{self, LiveStreams, Shot, Source, StreamFacts};
use crate::signals::Stop;
use anyhow::{Context as _, Result, bail};
use core::time::Duration;
use depthrig_bus::{Distortion, FrameHeader, RigName, StreamId, UtcPair};
use depthrig_calibrate::board::Board;
use depthrig_calibrate::capture::CaptureCamera;
use depthrig_calibrate::detect::Detector;
use depthrig_calibrate::intrinsics::ImageSize;
use depthrig_calibrate::rig::Seen;
use depthrig_recorder::{Dataset, PixelMode, SetRange, Sets, StreamRecord};
use std::collections::VecDeque;

/// Time between live rounds at least: three of them are a rest that no moving hand makes by chance.
const INTERVAL: Duration = Duration::from_millis(80);
/// Time that cameras get to deliver a first frame.
const FIRST: Duration = Duration::from_secs(20);

/// One image of each camera.
pub struct Round {
    /// The images; `None` of a camera that gave none.
    pub shots: Vec<Option<Shot>>,
    /// Added to a monotonic time of their headers this gives UTC.
    pub utc_offset_ns: i64,
}

/// Rounds of images.
pub struct Rounds {
    /// The streams, one of each camera, sorted by the cameras' names.
    pub streams: Vec<StreamRecord>,
    /// Name of the rig.
    pub rig: String,
    feed: Feed,
    ready: VecDeque<Round>,
}

enum Feed {
    Live(LiveStreams),
    Recorded(Box<Recorded>),
}

struct Recorded {
    sets: Sets,
    /// Index of each stream in the dataset.
    at: Vec<usize>,
}

impl Rounds {
    /// Opens the source; `None` when the end is asked for meanwhile.
    ///
    /// # Errors
    /// When it cannot be read, or no camera has a stream to look at.
    pub fn open(source: &Source, named: &[StreamId], stop: &Stop, context: &Context) -> Result<Option<Self>> {
        match source {
            Source::Dataset(path) => {
                let dataset = Dataset::open(path)?;
                let options = DatasetOptions { streams: named.to_vec(), moving: false };
                let at = chosen(&dataset, path, &options)?;
                Ok(Some(Self {
                    streams: at.iter().map(|i| dataset.session().streams[*i].clone()).collect(),
                    rig: dataset.session().rig.clone(),
                    feed: Feed::Recorded(Box::new(Recorded {
                        sets: dataset.sets_with(SetRange::ALL, PixelMode::Decoded),
                        at,
                    })),
                    ready: VecDeque::new(),
                }))
            }
            Source::Rig(rig) => {
                let Some(all) = live::streams(rig, stop, context)? else { return Ok(None) };
                Self::of_rig(rig, &chosen_live(rig, &all, named)?, stop, context)
            }
        }
    }

    /// Follows streams of a running rig; `None` when the end is asked for meanwhile.
    ///
    /// # Errors
    /// When a stream delivers nothing.
    pub fn of_rig(
        rig: &RigName,
        chosen: &[StreamFacts],
        stop: &Stop,
        context: &Context,
    ) -> Result<Option<Self>> {
        let ids: Vec<StreamId> = chosen.iter().map(|f| f.id.clone()).collect();
        let mut feed = LiveStreams::open(rig, &ids, context)?;
        // What a camera's images are is known from its first one.
        let began = depthrig_bus::HostTime::now();
        let mut first: Vec<Option<FrameHeader>> = vec![None; ids.len()];
        let mut ready = VecDeque::new();
        while first.iter().any(Option::is_none) && began.elapsed() < FIRST {
            let Some(shots) = feed.round(INTERVAL, stop)? else { return Ok(None) };
            for (header, shot) in first.iter_mut().zip(&shots) {
                *header = header.or(shot.as_ref().map(|s| s.header));
            }
            ready.push_back(Round { shots, utc_offset_ns: utc_offset_ns() });
            ready.truncate(1);
        }
        let mut streams = Vec::with_capacity(ids.len());
        for (facts, header) in chosen.iter().zip(first) {
            let header = header.with_context(|| {
                format!(
                    "{}: no image within {} s; `depthrig status` says why, --stream names other streams",
                    facts.id,
                    FIRST.as_secs()
                )
            })?;
            streams.push(record(facts, &header)?);
        }
        Ok(Some(Self { streams, rig: rig.to_string(), feed: Feed::Live(feed), ready }))
    }

    /// The cameras, as a capture needs them.
    pub fn cameras(&self) -> Vec<CaptureCamera> {
        let camera = |s: &StreamRecord| CaptureCamera {
            name: s.id.camera.to_string(),
            size: ImageSize { width: s.width, height: s.height },
            factory: (s.intrinsics.distortion() != Distortion::Unknown).then_some(s.intrinsics),
        };
        self.streams.iter().map(camera).collect()
    }

    /// The next round; `None` at the end of a dataset, or when the end is asked for.
    ///
    /// # Errors
    /// When the source cannot be read.
    pub fn next(&mut self, stop: &Stop) -> Result<Option<Round>> {
        if let Some(round) = self.ready.pop_front() {
            return Ok(Some(round));
        }
        match &mut self.feed {
            Feed::Live(streams) => {
                let Some(shots) = streams.round(INTERVAL, stop)? else { return Ok(None) };
                Ok(Some(Round { shots, utc_offset_ns: utc_offset_ns() }))
            }
            Feed::Recorded(_) if stop.is_asked() => Ok(None),
            Feed::Recorded(recorded) => {
                let Some(set) = recorded.sets.next() else { return Ok(None) };
                let mut set = set?;
                let mut shots: Vec<Option<Shot>> = vec![None; recorded.at.len()];
                for frame in set.frames.drain(..) {
                    if let Some(camera) = recorded.at.iter().position(|s| *s == frame.stream) {
                        shots[camera] = Some(Shot { header: frame.header, pixels: frame.pixels });
                    }
                }
                Ok(Some(Round { shots, utc_offset_ns: set.utc_offset_ns }))
            }
        }
    }
}

fn utc_offset_ns() -> i64 {
    let pair = UtcPair::sample();
    pair.utc_ns.saturating_sub(pair.mono.ns())
}

/// One stream of each camera: the named one, else the usual one.
fn chosen_live(rig: &RigName, facts: &[StreamFacts], named: &[StreamId]) -> Result<Vec<StreamFacts>> {
    let all = || facts.iter().map(|f| f.id.to_string()).collect::<Vec<_>>().join(", ");
    if let Some(id) = named.iter().find(|id| facts.iter().all(|f| f.id != **id)) {
        return Err(UsageError(format!("rig {rig} has no stream {id}; it has {}", all())).into());
    }
    let mut cameras: Vec<_> = facts.iter().map(|f| f.id.camera.clone()).collect();
    cameras.sort();
    cameras.dedup();
    let mut chosen = Vec::new();
    for camera in cameras {
        let of =
            |stream: &str| facts.iter().find(|f| f.id.camera == camera && f.id.stream.as_str() == stream);
        let stream = named.iter().find(|id| id.camera == camera);
        let found = match stream {
            Some(id) => of(id.stream.as_str()),
            None => STREAMS.iter().find_map(|s| of(s)),
        };
        chosen.extend(found.cloned());
    }
    if chosen.is_empty() {
        bail!(
            "rig {rig} has none of the streams {}; name one with --stream; it has {}",
            STREAMS.join(", "),
            all()
        );
    }
    Ok(chosen)
}

/// A stream as a dataset lists it.
fn record(facts: &StreamFacts, header: &FrameHeader) -> Result<StreamRecord> {
    let format = header.pixel_format().with_context(|| {
        format!("{}: pixel format {} is unknown to this version", facts.id, header.format)
    })?;
    Ok(StreamRecord {
        id: facts.id.clone(),
        model: facts.model.clone(),
        serial: facts.serial.clone(),
        format,
        width: header.width,
        height: header.height,
        rate_hz: facts.rate_hz,
        depth_unit_m: header.depth_unit_m,
        calibration: facts.calibration.clone(),
        intrinsics: header.intrinsics,
        pose: header.pose,
    })
}

/// Corners that the cameras see in a round, and why a board was refused.
#[derive(Default)]
pub struct Sight {
    /// The board in each camera that sees it.
    pub seen: Vec<Seen>,
    /// Reasons, with the camera's name.
    pub refused: Vec<String>,
}

/// Finds the board in the images of a round, on all processors.
///
/// # Errors
/// When an image cannot be read or has another size than before.
pub fn look(
    detector: &dyn Detector,
    board: &Board,
    cameras: &[CaptureCamera],
    round: &Round,
) -> Result<Sight> {
    let threads = std::thread::available_parallelism().map_or(2, core::num::NonZero::get).min(8);
    let jobs: Vec<usize> = (0..cameras.len()).filter(|c| round.shots[*c].is_some()).collect();
    let share = jobs.len().div_ceil(threads).max(1);
    let one = |camera: usize| -> Result<Looked> {
        let of = &cameras[camera];
        let Some(shot) = &round.shots[camera] else { return Ok(Looked { seen: None, refused: None }) };
        let header = &shot.header;
        if (header.width, header.height) != (of.size.width, of.size.height) {
            bail!(
                "camera {}: its images were {}x{} and are {}x{} now; start again with another --out",
                of.name,
                of.size.width,
                of.size.height,
                header.width,
                header.height
            );
        }
        let image =
            image_file::to_rgb(header, &shot.pixels).with_context(|| format!("camera {}", of.name))?;
        seen(detector, board, camera, of.size, &grey(&image))
    };
    let found: Vec<Result<Looked>> = std::thread::scope(|scope| {
        let workers: Vec<_> = jobs
            .chunks(share)
            .map(|part| scope.spawn(|| part.iter().map(|camera| one(*camera)).collect::<Vec<_>>()))
            .collect();
        workers
            .into_iter()
            .flat_map(|w| {
                w.join().unwrap_or_else(|_| vec![Err(anyhow::anyhow!("the board's detector panicked"))])
            })
            .collect()
    });
    let mut sight = Sight::default();
    for (camera, looked) in jobs.iter().zip(found) {
        let looked = looked?;
        sight.seen.extend(looked.seen);
        sight.refused.extend(looked.refused.map(|why| format!("{}: {why}", cameras[*camera].name)));
    }
    Ok(sight)
}
