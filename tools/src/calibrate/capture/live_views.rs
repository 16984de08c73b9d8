//! Views of a board in front of a running rig, for so many seconds.

use super::rounds::{Rounds, Sight, look};
use crate::calibrate::{Sightings, ViewedCamera};
use crate::context::Context;
use crate::live;
use crate::out;
use crate::signals::Stop;
use anyhow::{Result, bail};
use core::time::Duration;
use depthrig_bus::{HostTime, RigName, StreamId};
use depthrig_calibrate::board::Board;
use depthrig_calibrate::capture::Capture;
use depthrig_calibrate::detect::detector;
use depthrig_calibrate::file::Provenance;

/// Rig, streams and board to look at.
pub struct Wanted<'a> {
    /// The running rig.
    pub rig: &'a RigName,
    /// Its streams; those that the rig does not have are left out.
    pub streams: &'a [StreamId],
    /// The board.
    pub board: &'a Board,
    /// For how long.
    pub length: Duration,
}

/// Looks at the board wherever it stands still.
///
/// # Errors
/// When the rig has none of the streams, delivers nothing, or ends; when it was interrupted.
pub fn live_views(wanted: &Wanted<'_>, context: &Context) -> Result<Sightings> {
    let Wanted { rig, streams, board, length } = *wanted;
    let stop = Stop::on_signals()?;
    let interrupted = || anyhow::anyhow!("interrupted");
    let mut chosen = live::streams(rig, &stop, context)?.ok_or_else(interrupted)?;
    chosen.retain(|facts| streams.contains(&facts.id));
    if chosen.is_empty() {
        let names: Vec<String> = streams.iter().map(ToString::to_string).collect();
        bail!("rig {rig} has none of the calibrated streams {}", names.join(", "));
    }
    let mut rounds = Rounds::of_rig(rig, &chosen, &stop, context)?.ok_or_else(interrupted)?;
    let detector = detector(board)?;
    let mut capture = Capture::new(rounds.cameras(), board)?;
    let mut found = Sightings::default();
    for record in &rounds.streams {
        found.cameras.push(ViewedCamera {
            name: record.id.camera.to_string(),
            size: depthrig_calibrate::intrinsics::ImageSize { width: record.width, height: record.height },
            factory: None,
            provenance: Provenance { stream: record.id.stream.to_string(), serial: record.serial.clone() },
        });
    }
    let is_quiet = context.global.quiet > 0;
    if !is_quiet {
        out::note(format_args!("looking for {} s; hold the board still, at a few places", length.as_secs()));
    }
    let began = HostTime::now();
    while began.elapsed() < length {
        let round = rounds.next(&stop)?.ok_or_else(interrupted)?;
        let Sight { seen, refused } = look(detector.as_ref(), board, capture.cameras(), &round)?;
        found.images += round.shots.iter().flatten().count();
        if found.refused.is_empty() {
            found.refused = refused;
        }
        if let Some(view) = capture.look(&seen).view
            && !is_quiet
        {
            out::note(format_args!("view {}: {}", view.name, out::count(view.seen.len(), "camera")));
        }
    }
    found.views = capture.views().to_vec();
    if found.views.is_empty() {
        let why = found.refused.first().map(|r| format!("; {r}")).unwrap_or_default();
        bail!("within {} s the board never stood still where a camera sees it{why}", length.as_secs());
    }
    Ok(found)
}
