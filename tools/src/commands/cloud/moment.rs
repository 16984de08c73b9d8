//! The images of which a cloud is made: a set of a dataset, or what a running rig delivers now.

use crate::context::Context;
use crate::live::{self, LiveStreams, Shot};
use crate::signals::Stop;
use anyhow::Result;
use core::time::Duration;
use depthrig_bus::{RigName, StreamId};
use depthrig_recorder::{Dataset, DatasetSet, Edge, PixelMode, SetReader, SetSpan};

/// The images of all cameras at one moment.
pub(super) struct Moment {
    /// For messages.
    pub(super) name: String,
    /// Number of the set, of a dataset.
    pub(super) set: Option<u64>,
    /// The cameras, in their order.
    pub(super) cameras: Vec<String>,
    /// The images.
    pub(super) shots: Vec<Shot>,
    /// Streams without an image.
    pub(super) missing: Vec<StreamId>,
}

/// Sets before and after the middle one among which one without a gap is looked for: ten seconds at 5 Hz.
const NEAR: usize = 50;

/// Rounds of a live rig that a stream which has delivered nothing yet is waited for.
const PATIENCE: usize = 20;
const ROUND: Duration = Duration::from_millis(150);

impl Moment {
    /// A set of a dataset; without a number the middle one, or one near it that lacks less.
    pub(super) fn recorded(dataset: &Dataset, id: Option<u64>) -> Result<Self> {
        let set = set(dataset, id)?;
        let shots: Result<Vec<Shot>> = set
            .frames
            .iter()
            .map(|frame| Ok(Shot { header: frame.header, pixels: frame.decoded()? }))
            .collect();
        let streams = &dataset.session().streams;
        let cameras = streams.iter().map(|s| s.id.camera.to_string());
        let missing = set.missing.iter().filter_map(|stream| streams.get(*stream));
        Ok(Self {
            name: format!("set {} of {}", set.id, dataset.path().display()),
            set: Some(set.id),
            cameras: in_order(cameras),
            shots: shots?,
            missing: missing.map(|s| s.id.clone()).collect(),
        })
    }

    /// The newest frame of every stream; `None` when it was interrupted. A running rig has at most half a frame between its streams.
    pub(super) fn live(rig: &RigName, context: &Context) -> Result<Option<Self>> {
        let stop = Stop::on_signals()?;
        let Some(facts) = live::streams(rig, &stop, context)? else { return Ok(None) };
        let ids: Vec<StreamId> = facts.into_iter().map(|f| f.id).collect();
        let mut streams = LiveStreams::open(rig, &ids, context)?;
        let mut newest: Vec<Option<Shot>> = vec![None; ids.len()];
        for _ in 0..PATIENCE {
            let Some(shots) = streams.round(ROUND, &stop)? else { return Ok(None) };
            let is_complete = shots.iter().all(Option::is_some);
            for (newest, shot) in newest.iter_mut().zip(shots) {
                *newest = shot.or(newest.take());
            }
            if is_complete {
                break;
            }
        }
        let missing = ids.iter().zip(&newest).filter(|(_, shot)| shot.is_none());
        Ok(Some(Self {
            name: format!("rig {rig}"),
            set: None,
            cameras: in_order(ids.iter().map(|id| id.camera.to_string())),
            missing: missing.map(|(id, _)| id.clone()).collect(),
            shots: newest.into_iter().flatten().collect(),
        }))
    }
}

fn in_order(names: impl Iterator<Item = String>) -> Vec<String> {
    let mut all: Vec<String> = Vec::new();
    for name in names {
        if !all.contains(&name) {
            all.push(name);
        }
    }
    all
}

fn set(dataset: &Dataset, id: Option<u64>) -> Result<DatasetSet> {
    let mut reader = dataset.set_reader()?;
    let number = match id {
        Some(id) => {
            SetSpan { from: Some(Edge::Set(id)), to: Some(Edge::Set(id)) }.numbers(&mut reader)?.start
        }
        None => fullest_near_middle(&mut reader),
    };
    Ok(reader.read(number, PixelMode::Stored)?)
}

/// Number of the set with the fewest missing streams within [`NEAR`] of the middle; of several the nearest to it. A set that cannot be read is chosen last.
fn fullest_near_middle(reader: &mut SetReader) -> usize {
    let count = reader.times().len();
    let middle = count / 2;
    let mut best = (usize::MAX, middle);
    let near = (0..=NEAR).flat_map(|distance| [middle.checked_add(distance), middle.checked_sub(distance)]);
    for number in near.flatten().filter(|number| *number < count) {
        let missing = reader.read(number, PixelMode::None).map_or(usize::MAX, |set| set.missing.len());
        if missing < best.0 {
            best = (missing, number);
        }
        if missing == 0 {
            break;
        }
    }
    best.1
}
