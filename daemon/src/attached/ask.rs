//! Asking nodes, cameras and running rigs; behind a trait, because tests have none of them.

use crate::client::Client;
use crate::config::{BackendConfig, RigConfig};
use crate::family::{Family, Probe};
use crate::status::RigStatus;
use depthrig_bus::RuntimeDir;
use depthrig_driver::{Device, DeviceInfo, Result, StreamProfile};
use depthrig_external as external;
use depthrig_external::{ExternalBackend, ExternalConfig, Place};
use depthrig_usb::SysRoot;
use depthrig_v4l2::Node;
use rustix::fs::Access;
use std::path::Path;

/// Facts about a video node, asked of the kernel.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NodeFacts {
    /// `images`, `metadata` or `other`.
    pub role: &'static str,
    /// Its formats as V4L2 names them.
    pub formats: Vec<String>,
    /// Where the kernel says that its device is, such as `platform:vivid-000`.
    pub bus: String,
    /// Another process streams from it.
    pub used_elsewhere: bool,
}

/// A camera that another process serves.
#[derive(Debug)]
pub struct Served {
    /// Which one of which rig.
    pub place: Place,
    /// The process, as it described itself.
    pub holder: String,
    /// The device and the streams that it offers.
    pub offered: Result<(DeviceInfo, Vec<StreamProfile>)>,
}

/// Who answers.
pub trait Ask {
    /// Asks the kernel about a node; the camera notices nothing.
    ///
    /// # Errors
    /// Those of opening it.
    fn node(&self, path: &Path) -> Result<NodeFacts>;

    /// Opens the camera at a port, which nobody has, and asks for its description and modes. `None` without a
    /// driver for its family.
    fn device(&self, family: &Family, port: &str) -> Option<Result<(DeviceInfo, Vec<StreamProfile>)>>;

    /// The cameras that other processes serve now, and what these say of them.
    fn served(&self) -> Vec<Served> {
        Vec::new()
    }

    /// Whether this user may read and write a USB device.
    fn may_open(&self, node: &Path) -> bool;

    /// The rigs of this user that run, and what could not be asked.
    fn rigs(&self) -> (Vec<RigStatus>, Vec<String>);
}

/// Asks the system that this runs on.
#[derive(Debug)]
pub struct System {
    /// Where the rigs of this user are; `None`: none are asked.
    pub runtime: Option<RuntimeDir>,
    /// The cameras of the rig that is examined; empty without one.
    pub rig: Vec<BackendConfig>,
    /// The folder that `/sys` is in.
    pub root: SysRoot,
}

impl System {
    /// The system for a rig.
    pub fn of_rig(config: &RigConfig, runtime: Option<RuntimeDir>) -> Self {
        let rig = config.cameras.iter().map(|c| c.backend.clone()).collect();
        Self { runtime, rig, root: SysRoot::default() }
    }
}

impl Ask for System {
    fn node(&self, path: &Path) -> Result<NodeFacts> {
        let node = Node::open(path)?;
        let c = node.capability();
        let role = match (c.is_capture(), c.is_metadata()) {
            (true, _) => "images",
            (false, true) => "metadata",
            (false, false) => "other",
        };
        let formats = if role == "other" { Vec::new() } else { node.formats()? };
        let formats = formats.iter().map(ToString::to_string).collect();
        Ok(NodeFacts { role, formats, bus: c.bus.clone(), used_elsewhere: node.is_used_elsewhere() })
    }

    fn device(&self, family: &Family, port: &str) -> Option<Result<(DeviceInfo, Vec<StreamProfile>)>> {
        let backend = (family.probe?)(&Probe { port, root: &self.root, rig: &self.rig });
        let facts = |device: Box<dyn Device>| (device.info().clone(), device.profiles().to_vec());
        Some(backend.open(None).map(facts))
    }

    fn served(&self) -> Vec<Served> {
        let Some(runtime) = &self.runtime else { return Vec::new() };
        let asked = |(place, holder): (Place, String)| {
            let offered = ExternalBackend::new(ExternalConfig::default(), place.clone()).offered();
            Served { place, holder, offered }
        };
        external::served(runtime).into_iter().map(asked).collect()
    }

    fn may_open(&self, node: &Path) -> bool {
        rustix::fs::access(node, Access::READ_OK | Access::WRITE_OK).is_ok()
    }

    fn rigs(&self) -> (Vec<RigStatus>, Vec<String>) {
        let Some(runtime) = &self.runtime else { return (Vec::new(), Vec::new()) };
        let mut rigs = Vec::new();
        let mut silent = Vec::new();
        for rig in runtime.running_rigs() {
            match Client::connect(runtime, Some(&rig)).and_then(|c| c.status()) {
                Ok(status) => rigs.push(status),
                Err(e) => silent.push(format!("rig \"{rig}\" was not asked: {e}")),
            }
        }
        (rigs, silent)
    }
}
