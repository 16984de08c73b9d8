//! Opening a camera: its driver, its streams, its channels on the bus.

use super::{Camera, Shared, calibration};
use crate::Result;
use crate::family::OpenContext;
use crate::sink::BusSink;
use crate::stage::{Readers, Refinement, Setup};
use crate::stream::Stream;
use depthrig_bus::sync::lock;
use depthrig_bus::{FrameHeader, StreamId, StreamName, shm};
use depthrig_calib::PoseExt;
use depthrig_driver::capture::Session;
use depthrig_driver::{Backend, DeviceInfo, ErrorKind as DriverErrorKind, StreamProfile, StreamRequest};
use depthrig_stereo::{StereoBackend, StereoOptions};
use std::sync::{Arc, Mutex};

/// A camera's driver, created at the first opening and kept for the later ones.
pub(super) type SharedBackend = Arc<Mutex<Option<Box<dyn Backend>>>>;

/// Opens the device and its channels; runs on the camera's own thread.
pub(super) fn open_session(
    camera: &Camera,
    shared: &Shared,
    backend: &Mutex<Option<Box<dyn Backend>>>,
) -> Result<Session, depthrig_driver::Error> {
    let name = &camera.config.name;
    let in_camera = |e: depthrig_driver::Error| {
        depthrig_driver::Error::new(e.kind(), format!("camera \"{name}\": {e}")).with_source(e)
    };
    let device = {
        // Held for the opening alone; a thread that hangs in it keeps its successors waiting, not the rig.
        let mut backend = lock(backend);
        let backend = match backend.as_ref() {
            Some(backend) => backend,
            None => backend.insert(make_backend(camera, shared).map_err(in_camera)?),
        };
        backend.open(None).map_err(in_camera)?
    };
    let mut info = device.info().clone();
    let wanted = requests(camera, device.profiles());
    let stream = device.start(&wanted).map_err(in_camera)?;
    set_again(camera, &*stream);
    let mut profiles = stream.profiles().to_vec();
    let calibrated = calibration::apply(&camera.config, &mut profiles, &mut info).map_err(in_camera)?;
    let pose = calibrated.pose;
    camera.state().pose = pose;
    let streams = adopt(camera, shared, &profiles, &info).map_err(in_camera)?;
    let mut ports = Vec::new();
    for s in streams {
        let mut header = FrameHeader::default();
        header.set_image(s.profile.format, s.profile.width, s.profile.height);
        header.set_names(shared.bus.rig().as_str(), &s.id);
        header.set_device(&info.model, &info.serial);
        header.depth_unit_m = s.profile.depth_unit_m;
        header.device_tick_ns = s.profile.clock.tick_ns();
        header.intrinsics = s.profile.intrinsics;
        header.pose = pose.compose(&s.profile.pose_in_device);
        let publisher = publisher_of(shared, &s).map_err(|e| {
            let kind = match e.kind() {
                crate::ErrorKind::NoSpace => DriverErrorKind::Unsupported,
                _ => DriverErrorKind::Io,
            };
            in_camera(depthrig_driver::Error::new(kind, e.to_string()).with_source(e))
        })?;
        ports.push((s, publisher, header));
    }
    open_refinement(camera, shared, &info).map_err(|e| {
        let kind = match e.kind() {
            crate::ErrorKind::BadInput => DriverErrorKind::BadInput,
            _ => DriverErrorKind::Io,
        };
        in_camera(depthrig_driver::Error::new(kind, e.to_string()).with_source(e))
    })?;
    let sink = BusSink::new(ports, Arc::clone(&shared.frames)).with_latencies(&calibrated.latencies);
    Ok(Session { info, stream, sink: Box::new(sink) })
}

/// Gives a camera that came back the controls that were changed before.
fn set_again(camera: &Camera, stream: &dyn depthrig_driver::Stream) {
    let panel = stream.controls();
    camera.state().panel.clone_from(&panel);
    let Some(panel) = panel.and_then(|panel| panel.upgrade()) else { return };
    for (key, value) in lock(&camera.changed).iter() {
        if let Err(e) = panel.set(key, value) {
            let camera = camera.config.name.as_str();
            tracing::warn!(camera, "{key} = {value} cannot be set again: {e}");
        }
    }
}

/// The streams to request of the device: those that the rig lists. Without a list it is every stream, at later openings
/// except an IMU that was not there at the first: its stream would be one that nobody knows of.
fn requests(camera: &Camera, offered: &[StreamProfile]) -> Vec<StreamRequest> {
    let state = camera.state();
    let known = |name: &StreamName| state.streams.iter().any(|s| s.id.stream == *name);
    let is_new = offered.iter().any(|p| p.format.is_motion() && !known(&p.stream));
    if camera.config.streams.is_empty() && !state.streams.is_empty() && is_new {
        return state.streams.iter().map(|s| StreamRequest::any(s.id.stream.clone())).collect();
    }
    camera.config.streams.clone()
}

/// Connects the camera's streams with those computed from them, at its first opening. All of it is there
/// before the first frame, so that no publisher waits for a subscriber that is half made.
fn open_refinement(camera: &Camera, shared: &Shared, info: &DeviceInfo) -> Result<()> {
    let Some(config) = &camera.config.refine else { return Ok(()) };
    let state = camera.state();
    let streams = state.streams.clone();
    let derived = state.derived.clone();
    let begun = state.refinement.is_some();
    drop(state);
    let find = |name: &str| streams.iter().find(|s| s.id.stream.as_str() == name);
    let (Some(color), Some(depth)) = (find("color"), find(&config.depth)) else { return Ok(()) };
    let [refined, aligned @ ..] = derived.as_slice() else { return Ok(()) };
    if begun {
        return Ok(());
    }
    for stream in &derived {
        publisher_of(shared, stream)?;
    }
    let readers =
        Readers { color: shared.bus.subscriber(&color.id)?, depth: shared.bus.subscriber(&depth.id)? };
    let correct = calibration::correct_of(&camera.config, config, &depth.profile, info)?;
    let color_ns = color.profile.period_ns() as i64;
    let refinement = Arc::new(Refinement::new(Setup {
        camera: camera.config.name.clone(),
        device_model: info.model.clone(),
        config: config.clone(),
        refined: Arc::clone(refined),
        aligned: aligned.first().cloned(),
        correct,
        color_ns,
        frame_ns: depth.profile.period_ns() as i64,
        tolerance_ns: color_ns / 2 + 1_000_000,
        readers,
    }));
    camera.state().refinement = Some(Arc::clone(&refinement));
    shared.stage.add(refinement);
    Ok(())
}

/// The driver of a camera.
fn make_backend(camera: &Camera, shared: &Shared) -> Result<Box<dyn Backend>, depthrig_driver::Error> {
    let backend = camera.config.backend.driver(&OpenContext {
        runtime: shared.bus.runtime(),
        rig: shared.bus.rig(),
        camera: &camera.config.name,
        began: shared.began,
        drawing: shared.drawing.as_ref(),
    })?;
    Ok(match &camera.config.stereo {
        Some(stereo) => {
            let options = StereoOptions {
                computed: Arc::clone(&camera.computed),
                notice: Arc::clone(&camera.notice),
                sets: Arc::clone(&shared.stage.sets),
                ..stereo.options()
            };
            Box::new(StereoBackend::new(backend, options))
        }
        None => backend,
    })
}

fn publisher_of(shared: &Shared, stream: &Stream) -> Result<Arc<depthrig_bus::Publisher>> {
    let mut books = stream.books();
    if let Some(publisher) = &books.publisher {
        return Ok(Arc::clone(publisher));
    }
    let publisher = Arc::new(shared.bus.publisher(&stream.id, stream.profile.frame_bytes(), stream.slots)?);
    if books.session == 0 {
        books.reader = Some(shared.bus.subscriber(&stream.id)?);
    }
    books.publisher = Some(Arc::clone(&publisher));
    Ok(publisher)
}

/// Makes the camera's streams at its first opening, and holds later openings to them.
fn adopt(
    camera: &Camera,
    shared: &Shared,
    profiles: &[StreamProfile],
    info: &DeviceInfo,
) -> Result<Vec<Arc<Stream>>, depthrig_driver::Error> {
    let mut state = camera.state();
    state.info = Some(info.clone());
    if state.streams.is_empty() {
        let derived = camera.config.derived_profiles(profiles).map_err(|e| {
            depthrig_driver::Error::new(DriverErrorKind::BadInput, e.to_string()).with_source(e)
        })?;
        let all = profiles.iter().chain(derived.iter().map(|(p, _)| p));
        state.set_bytes = all.map(|p| p.frame_bytes() as u64).sum();
        let slots = shm::slots_that_fit(shared.slots, state.set_bytes, shared.memory_share);
        state.short_of_memory = slots.is_err();
        let slots = slots.map_err(|e| {
            depthrig_driver::Error::new(DriverErrorKind::Unsupported, e.to_string()).with_source(e)
        })?;
        let stream = |p: &StreamProfile, record: bool| {
            let id = StreamId { camera: camera.config.name.clone(), stream: p.stream.clone() };
            Arc::new(Stream::new(id, p.clone(), record, slots))
        };
        state.streams = profiles.iter().map(|p| stream(p, camera.config.records(&p.stream))).collect();
        state.derived = derived.iter().map(|(p, record)| stream(p, *record)).collect();
        return Ok(state.streams.clone());
    }
    // An IMU that did not come back with its camera is silent; its images matter more.
    let is_back =
        |s: &&Arc<Stream>| !s.profile.format.is_motion() || profiles.iter().any(|p| p.stream == s.id.stream);
    let back: Vec<_> = state.streams.iter().filter(is_back).cloned().collect();
    if back.len() != profiles.len() || back.iter().zip(profiles).any(|(s, p)| !same_mode(&s.profile, p)) {
        let had: Vec<_> = state.streams.iter().map(|s| s.profile.describe()).collect();
        let has: Vec<_> = profiles.iter().map(StreamProfile::describe).collect();
        return Err(depthrig_driver::Error::new(
            DriverErrorKind::Unsupported,
            format!(
                "it came back with other modes: had {}, has {}; restart the daemon to use them",
                had.join(", "),
                has.join(", ")
            ),
        ));
    }
    Ok(back)
}

fn same_mode(a: &StreamProfile, b: &StreamProfile) -> bool {
    a.stream == b.stream && a.format == b.format && (a.width, a.height) == (b.width, b.height)
}
