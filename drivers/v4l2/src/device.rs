//! An open camera: its modes, its controls, and how it is started.

use super::config::V4l2Config;
use super::find::{FoundCamera, NodePair};
use super::node::{Mode, Node};
use super::offer::{Offer, offers};
use super::stream::{Ready, V4l2Stream};
use depthrig_driver::{
    Device, DeviceInfo, Error, ErrorKind, Result, Stream, StreamProfile, StreamRequest, choose_profiles,
};
use depthrig_usb::controls::{Control, ControlKind, ControlValue, find as find_control};
use depthrig_usb::{SysRoot, health};

/// An open camera that is not streaming.
pub(super) struct V4l2Device {
    config: V4l2Config,
    root: SysRoot,
    found: FoundCamera,
    info: DeviceInfo,
    nodes: Vec<NodePair>,
    offers: Vec<Offer>,
    profiles: Vec<StreamProfile>,
}

impl V4l2Device {
    pub(super) fn open(found: FoundCamera, config: V4l2Config, root: SysRoot) -> Result<Self> {
        let nodes = found.open(&root)?;
        let mut modes: Vec<Vec<Mode>> = Vec::new();
        for pair in &nodes {
            let offered = pair.video.modes(super::offer::is_offered)?;
            // Only one may set the mode of a node: who streams already keeps everybody else from it. Better said now
            // than at the start.
            if let Some(mode) = offered.first() {
                pair.video.set_mode(mode).map_err(|e| named(&root, &found, e))?;
            }
            modes.push(offered);
        }
        let offers = offers(&modes, &config);
        if offers.is_empty() {
            let mut formats = Vec::new();
            for pair in &nodes {
                formats.extend(pair.video.formats()?.iter().map(ToString::to_string));
            }
            let camera = found.describe();
            let has = formats.join(", ");
            let what = format!("{camera} has no format that depthrig knows; it has: {has}");
            return Err(Error::new(ErrorKind::Unsupported, what));
        }
        let profiles = offers.iter().map(|o| o.profile.clone()).collect();
        let mut info = found.info.clone();
        if !config.intrinsics.is_empty() {
            "rig file".clone_into(&mut info.calibration);
        }
        Ok(Self { config, root, found, info, nodes, offers, profiles })
    }

    /// Sets the modes, then the controls: some drivers reset controls with the mode.
    fn prepare(self, chosen: &[StreamProfile]) -> Result<Vec<Ready>> {
        let Self { config, root, found, nodes, offers, .. } = self;
        let mut nodes: Vec<Option<NodePair>> = nodes.into_iter().map(Some).collect();
        let mut ready: Vec<Ready> = Vec::new();
        for profile in chosen {
            let offer = offers.iter().find(|o| o.profile == *profile);
            let taken = offer.and_then(|o| Some((o, nodes.get_mut(o.node)?.take()?)));
            let Some((offer, pair)) = taken else {
                let what = format!("{}: unsupported mode {}", found.describe(), profile.describe());
                return Err(Error::new(ErrorKind::Unsupported, what));
            };
            let layout = pair.video.set_mode(&offer.mode).map_err(|e| named(&root, &found, e))?;
            ready.push(Ready { video: pair.video, metadata: pair.metadata, offer: offer.clone(), layout });
        }
        let idle = nodes.iter().flatten().map(|pair| &pair.video);
        let all: Vec<&Node> = ready.iter().map(|r| &r.video).chain(idle).collect();
        apply_controls(&config, &all)?;
        Ok(ready)
    }
}

/// Writes the controls of the rig file, each on the first node that has it; switches and menus first.
fn apply_controls(config: &V4l2Config, nodes: &[&Node]) -> Result<()> {
    if config.controls.is_empty() {
        return Ok(());
    }
    let mut all = Vec::new();
    let mut place = Vec::new();
    for node in nodes {
        for control in node.controls()? {
            place.push(*node);
            all.push(control);
        }
    }
    let card = nodes.first().map(|n| n.capability().card.clone()).unwrap_or_default();
    for numbers in [false, true] {
        for (name, value) in &config.controls {
            let control =
                find_control(&all, name).map_err(|e| Error::new(e.kind(), format!("{card}: {e}")))?;
            let is_number =
                matches!(control.kind, ControlKind::Integer | ControlKind::Integer64 | ControlKind::Bitmask);
            let node = all.iter().zip(&place).find(|(c, _)| c.name == control.name).map(|(_, node)| *node);
            if let Some(node) = node.filter(|_| is_number == numbers) {
                node.set_control(&all, name, value)?;
                read_back(node, control, value)?;
            }
        }
    }
    Ok(())
}

/// A camera may take another value than it was given; that is logged, and not an error.
fn read_back(node: &Node, control: &Control, value: &ControlValue) -> Result<()> {
    if control.kind == ControlKind::Button || control.write_only {
        return Ok(());
    }
    let wanted = control.check(value)?;
    let got = node.read_control(control)?;
    if wanted != got {
        let camera = &node.capability().card;
        tracing::warn!(
            camera,
            control = control.name,
            wanted,
            got,
            "the camera changed the value of a control"
        );
    }
    Ok(())
}

/// The error with the process that holds the camera, when one does.
fn named(root: &SysRoot, found: &FoundCamera, e: Error) -> Error {
    if e.kind() != ErrorKind::Busy {
        return e;
    }
    match found.paths().next() {
        Some(node) => health::busy(root, &found.describe(), node).with_source(e),
        None => e,
    }
}

impl Device for V4l2Device {
    fn info(&self) -> &DeviceInfo {
        &self.info
    }

    fn profiles(&self) -> &[StreamProfile] {
        &self.profiles
    }

    fn start(self: Box<Self>, requests: &[StreamRequest]) -> Result<Box<dyn Stream>> {
        let name = format!("camera {}", self.found.describe());
        let chosen = choose_profiles(&name, &self.profiles, requests)?;
        let config = self.config.clone();
        let root = self.root.clone();
        let found = self.found.clone();
        let nodes = self.nodes.iter().map(|pair| pair.video.path().to_owned()).collect();
        let ready = self.prepare(&chosen)?;
        let clock_hz = config.device_clock_hz.or_else(|| found.clock_hz(&root));
        let stream =
            V4l2Stream::start(name, ready, &config, clock_hz, nodes).map_err(|e| named(&root, &found, e))?;
        Ok(Box::new(stream))
    }
}
