//! A camera that a process offers: its modes, and how it is started.

use super::process::SharedKeeper;
use super::stream::{ExternalStream, Started};
use super::{ExternalConfig, NAME, Place, kind_of, of_bus, refusal};
use depthrig_bus::external::{Beat, ExternalClock, ExternalLink, ExternalState, Mode, Offer};
use depthrig_bus::{ClockDomain, HostTime, MetadataLevel};
use depthrig_driver::{
    Device, DeviceClock, DeviceInfo, Error, Result, Stream, StreamProfile, StreamRequest, choose_profiles,
};

/// A camera whose process answers.
#[derive(Debug)]
pub(super) struct ExternalDevice {
    config: ExternalConfig,
    place: Place,
    keeper: SharedKeeper,
    link: ExternalLink,
    beat: Beat,
    modes: Vec<Mode>,
    info: DeviceInfo,
    profiles: Vec<StreamProfile>,
}

impl ExternalDevice {
    /// The camera that `offer` describes, last heard of in `beat`.
    ///
    /// # Errors
    /// The reason of the process when it says that its camera cannot be had now.
    #[allow(clippy::large_types_passed_by_value)] // it is kept, once for each opening
    pub(super) fn new(
        config: &ExternalConfig,
        place: &Place,
        keeper: SharedKeeper,
        link: ExternalLink,
        beat: Beat,
        offer: Offer,
    ) -> Result<Self> {
        if beat.session == 0 && beat.state == Some(ExternalState::Refused) {
            return Err(Error::new(kind_of(beat.reason), refusal(&beat)));
        }
        let about = &offer.about;
        let info = DeviceInfo {
            backend: NAME,
            model: about.model.clone(),
            serial: about.serial.clone(),
            firmware: about.firmware.clone(),
            port: if about.port.is_empty() { format!("process {}", beat.pid) } else { about.port.clone() },
            calibration: if about.calibration.is_empty() {
                "none".to_owned()
            } else {
                about.calibration.clone()
            },
            motion: String::new(),
        };
        let profiles = offer.modes.iter().map(profile).collect();
        let config = config.clone();
        let place = place.clone();
        Ok(Self { config, place, keeper, link, beat, modes: offer.modes, info, profiles })
    }
}

/// The profile of a mode.
pub(crate) fn profile(mode: &Mode) -> StreamProfile {
    let (domain, metadata) = match mode.clock {
        ExternalClock::Device => (ClockDomain::Device, MetadataLevel::Full),
        ExternalClock::DeviceHeader => (ClockDomain::Device, MetadataLevel::Header),
        ExternalClock::Host => (ClockDomain::Kernel, MetadataLevel::Kernel),
        _ => (ClockDomain::Arrival, MetadataLevel::Arrival),
    };
    let metadata = if mode.simulated { MetadataLevel::Simulated } else { metadata };
    let mut pose = mode.pose;
    let norm = pose.rotation_xyzw.iter().map(|c| c * c).sum::<f64>().sqrt();
    pose.rotation_xyzw = pose.rotation_xyzw.map(|c| c / norm);
    StreamProfile {
        stream: mode.stream.clone(),
        format: mode.format,
        width: mode.width,
        height: mode.height,
        rate_hz: mode.rate_hz,
        depth_unit_m: mode.depth_unit_m,
        intrinsics: mode.intrinsics,
        pose_in_device: pose,
        clock: DeviceClock { counter_bits: mode.counter_bits, tick_ps: mode.tick_ps, domain },
        sequence_bits: if mode.sequence_bits == 0 { 64 } else { mode.sequence_bits },
        metadata,
    }
}

impl Device for ExternalDevice {
    fn info(&self) -> &DeviceInfo {
        &self.info
    }

    fn profiles(&self) -> &[StreamProfile] {
        &self.profiles
    }

    fn start(self: Box<Self>, requests: &[StreamRequest]) -> Result<Box<dyn Stream>> {
        let name = format!("{} {}", self.info.model, self.info.serial);
        let chosen = choose_profiles(name.trim_end(), &self.profiles, requests)?;
        let mut wanted = vec![0; self.modes.len()];
        let mut inlets = Vec::new();
        for profile in &chosen {
            let Some(mode) = self.profiles.iter().position(|p| p == profile) else { continue };
            if let Some(flag) = wanted.get_mut(mode) {
                *flag = 1;
            }
            let has_counter = self.modes.get(mode).is_some_and(|m| m.sequence_bits > 0);
            // Before the process is asked to run, so that its first frame has a reader.
            inlets.push((self.link.frames(&profile.stream).map_err(of_bus)?, has_counter));
        }
        let started = Started {
            instance: self.beat.instance,
            // Higher than any before, this daemon's or another's, because the clock only rises.
            session: HostTime::now().ns().max(1) as u64,
            wanted,
            heartbeat: self.config.heartbeat_timeout,
            pid: self.beat.pid,
        };
        let mut stream = ExternalStream::new(self.place, self.link, self.keeper, started, chosen, inlets);
        stream.wait_for_first_frame(self.config.start_timeout)?;
        Ok(Box::new(stream))
    }
}
