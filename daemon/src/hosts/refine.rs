//! Refined depth of cameras of another computer, made here from their mirrored streams: for the computer with the better processor, or a GPU.

use crate::config::HostConfig;
use crate::stage::{self, Intake, Readers, Refinement, Setup};
use crate::status::{CameraState, HostRefineStatus, RigStatus, SetAccount, StreamStatus};
use crate::stream::Stream;
use crate::{Error, ErrorKind, Result};
use core::time::Duration;
use depthrig_bus::sync::lock;
use depthrig_bus::{
    Bus, CameraName, ClockDomain, FrameHeader, HostTime, MetadataLevel, PixelFormat, StreamId, StreamName,
    Subscriber,
};
use depthrig_cdm::stage::RefineConfig;
use depthrig_driver::{DeviceClock, StreamProfile};
use std::sync::{Arc, Mutex, OnceLock};

/// A mirrored stream that is read sends its first frame within this.
const FIRST_FRAME: Duration = Duration::from_secs(1);
/// Slots of a refined stream.
const SLOTS: usize = 16;

/// Where refined depth is made.
#[derive(Debug, Clone, Copy)]
pub struct Place<'a> {
    /// The channels.
    pub bus: &'a Bus,
    /// The stage's.
    pub intake: &'a Intake,
}

/// A camera of another computer whose depth is refined here.
#[derive(Debug)]
pub(super) struct HostRefine {
    camera: CameraName,
    config: RefineConfig,
    refinement: OnceLock<Arc<Refinement>>,
    /// The last reason why it did not begin, which is logged once.
    why: Mutex<String>,
}

impl HostRefine {
    /// The cameras of a host whose depth is refined: those with colour and depth among the mirrored streams.
    pub(super) fn of(host: &HostConfig) -> Vec<Self> {
        let Some(config) = &host.refine else { return Vec::new() };
        let cameras = host.refined_cameras(&config.depth);
        let refine = |camera| Self {
            camera,
            config: config.clone(),
            refinement: OnceLock::new(),
            why: Mutex::default(),
        };
        cameras.into_iter().map(refine).collect()
    }

    /// Its state; it waits until frames of both streams have come.
    pub(super) fn status(&self) -> HostRefineStatus {
        let refine = self.refinement.get().map(|refinement| refinement.status());
        HostRefineStatus { camera: self.camera.to_string(), refine }
    }

    /// True for the camera of this name.
    pub(super) fn is_of(&self, camera: &str) -> bool {
        self.camera.as_str() == camera
    }

    /// The streams that are made of it, once they are.
    pub(super) fn streams(&self) -> Vec<StreamStatus> {
        let now = HostTime::now();
        let made = self.refinement.get().into_iter().flat_map(|refinement| refinement.streams());
        made.map(|stream| stream.status(SetAccount::default(), now)).collect()
    }

    /// Gives the camera to the stage, once it streams `there` and frames of both streams come; a reason against it is logged.
    pub(super) fn begin(&self, there: &RigStatus, place: Place<'_>) {
        if self.refinement.get().is_some() {
            return;
        }
        let now = self.try_begin(there, place).err().map(|e| e.to_string()).unwrap_or_default();
        let mut why = lock(&self.why);
        if *why != now && !now.is_empty() {
            tracing::error!("camera {}: its depth is not refined here: {now}", self.camera);
        }
        *why = now;
    }

    fn try_begin(&self, there: &RigStatus, place: Place<'_>) -> Result<()> {
        let Place { bus, intake } = place;
        let stream = |name: &str| -> Result<Option<(Subscriber, FrameHeader, StreamProfile)>> {
            let id = StreamId { camera: self.camera.clone(), stream: StreamName::new(name)? };
            // Frames of another one are not waited for, because pulling would wait too.
            let live = there.cameras.iter().filter(|camera| camera.state == CameraState::Streaming);
            let mut all = live.flat_map(|camera| &camera.streams);
            let rate_hz = all.find(|s| s.id == id.to_string()).map(|s| s.nominal_hz);
            let Some(rate_hz) = rate_hz.filter(|hz| hz.is_finite() && *hz > 0.0) else { return Ok(None) };
            let mut reader = match bus.subscriber(&id) {
                Err(e) if e.kind() == depthrig_bus::ErrorKind::NotFound => return Ok(None),
                reader => reader?,
            };
            let Some(header) = reader.next_timeout(FIRST_FRAME)?.map(|frame| *frame.header()) else {
                return Ok(None);
            };
            let profile = profile(&id, &header, rate_hz).ok_or_else(|| {
                let what =
                    format!("{id} has no images; remove [link.hosts.refine], or this camera from mirror");
                Error::new(ErrorKind::BadInput, what)
            })?;
            Ok(Some((reader, header, profile)))
        };
        let Some((color, _, color_profile)) = stream("color")? else { return Ok(()) };
        let Some((depth, header, depth_profile)) = stream(&self.config.depth)? else { return Ok(()) };
        let color_ns = color_profile.period_ns() as i64;
        let frame_ns = depth_profile.period_ns() as i64;
        let mut made = Vec::new();
        for (profile, _) in stage::profiles(Some(&self.config), None, &[color_profile, depth_profile])? {
            let id = StreamId { camera: self.camera.clone(), stream: profile.stream.clone() };
            let stream = Arc::new(Stream::new(id, profile, false, SLOTS));
            let publisher = bus.publisher(&stream.id, stream.profile.frame_bytes(), SLOTS)?;
            stream.books().publisher = Some(Arc::new(publisher));
            made.push(stream);
        }
        let mut made = made.into_iter();
        let Some(refined) = made.next() else { return Ok(()) };
        let refinement = Arc::new(Refinement::new(Setup {
            camera: self.camera.clone(),
            device_model: header.model().to_owned(),
            config: self.config.clone(),
            refined,
            aligned: made.next(),
            correct: None,
            color_ns,
            frame_ns,
            tolerance_ns: color_ns / 2 + 1_000_000,
            readers: Readers { color, depth },
        }));
        if self.refinement.set(Arc::clone(&refinement)).is_ok() {
            intake.add(refinement);
        }
        Ok(())
    }
}

/// The mode of a stream of which only frames are known.
fn profile(id: &StreamId, h: &FrameHeader, rate_hz: f64) -> Option<StreamProfile> {
    Some(StreamProfile {
        stream: id.stream.clone(),
        format: h.pixel_format().filter(|format| *format != PixelFormat::Motion)?,
        width: h.width,
        height: h.height,
        rate_hz,
        depth_unit_m: h.depth_unit_m,
        intrinsics: h.intrinsics,
        pose_in_device: h.pose,
        clock: DeviceClock { counter_bits: 64, tick_ps: 1000, domain: ClockDomain::Device },
        sequence_bits: 64,
        metadata: MetadataLevel::Full,
    })
}
