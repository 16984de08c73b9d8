//! Refined depth on a replay: the stage of a live rig, between the channels of a dataset.

use super::Inner;
use crate::stage::{self, Readers, Refinement, Setup};
use crate::stream::Stream;
use crate::{Error, ErrorKind, Result};
use depthrig_bus::{Bus, StreamId};
use depthrig_cdm::stage::{EngineChoice, RefineConfig};
use depthrig_recorder::StreamRecord;
use std::sync::Arc;

/// The refinement by `engine` of every camera of the dataset that has colour and depth; creates their channels.
///
/// # Errors
/// `BadInput` when no camera has both, or when the dataset has refined depth of its own; errors of creating channels.
pub fn refinements(inner: &Inner, bus: &Bus, engine: EngineChoice) -> Result<Vec<Arc<Refinement>>> {
    let config = RefineConfig { engine, rate_hz: 0.0, ..RefineConfig::default() };
    let bad = |what: String| Error::new(ErrorKind::BadInput, what);
    if let Some(had) = inner.records.iter().find(|r| crate::stream::is_derived(&r.id.stream)) {
        return Err(bad(format!("the dataset has {} of its own; replay it without --refine", had.id)));
    }
    let of = |camera: &StreamRecord, name: &str| {
        inner.streams.iter().find(|s| s.id.camera == camera.id.camera && s.id.stream.as_str() == name)
    };
    let mut refinements = Vec::new();
    for record in inner.records.iter().filter(|r| r.id.stream.as_str() == "depth") {
        let (Some(color), Some(depth)) = (of(record, "color"), of(record, "depth")) else { continue };
        let profiles = [color.profile.clone(), depth.profile.clone()];
        let derived = stage::profiles(Some(&config), None, &profiles)?;
        let Some((profile, _)) = derived.into_iter().next() else { continue };
        let id = StreamId { camera: record.id.camera.clone(), stream: profile.stream.clone() };
        let stream = Arc::new(Stream::new(id, profile, false, inner.slots()));
        let publisher = bus.publisher(&stream.id, stream.profile.frame_bytes(), stream.slots)?;
        stream.books().publisher = Some(Arc::new(publisher));
        let readers = Readers { color: bus.subscriber(&color.id)?, depth: bus.subscriber(&depth.id)? };
        let color_ns = color.profile.period_ns().max(1) as i64;
        let depth_ns = depth.profile.period_ns().max(1) as i64;
        // The frames of a set lie within half a period of its tick, on either side.
        let tolerance_ns = color_ns.max(depth_ns) + 1_000_000;
        refinements.push(Arc::new(Refinement::new(Setup {
            camera: record.id.camera.clone(),
            device_model: record.model.clone(),
            config: config.clone(),
            refined: stream,
            aligned: None,
            correct: None,
            color_ns,
            frame_ns: depth_ns,
            tolerance_ns,
            readers,
        })));
    }
    if refinements.is_empty() {
        return Err(bad(
            "no camera of the dataset has the streams color and depth; replay it without --refine".into(),
        ));
    }
    Ok(refinements)
}
