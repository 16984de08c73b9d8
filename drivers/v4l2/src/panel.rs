//! The controls of a camera that streams. The kernel gives them to everybody who opens a node, so each call opens it for itself.

use super::node::Node;
use depthrig_driver::controls::{ControlKind, ControlPanel, ControlState, ControlValue};
use depthrig_driver::{Error, ErrorKind, Result};
use std::path::PathBuf;

/// The table of a rig file that controls are in.
const TABLE: &str = "controls";

/// The controls of a camera's nodes.
pub(super) struct Panel {
    pub(super) nodes: Vec<PathBuf>,
}

impl ControlPanel for Panel {
    fn list(&self) -> Result<Vec<ControlState>> {
        let mut all: Vec<ControlState> = Vec::new();
        for path in &self.nodes {
            let node = Node::open(path)?;
            for control in node.controls()? {
                let key = format!("{TABLE}.{}", control.name);
                let is_shown = !matches!(control.kind, ControlKind::Button | ControlKind::Other);
                // Of a control that several nodes have, the first counts, as at the start.
                if is_shown && all.iter().all(|c| c.key != key) {
                    let value = if control.write_only { None } else { Some(node.read_control(&control)?) };
                    all.push(ControlState { key, control, value });
                }
            }
        }
        Ok(all)
    }

    fn set(&self, key: &str, value: &ControlValue) -> Result<()> {
        let unknown = || {
            let what = format!("unknown control \"{key}\"; the list of controls has those there are");
            Error::new(ErrorKind::BadInput, what)
        };
        let name = key.strip_prefix(TABLE).and_then(|k| k.strip_prefix('.')).ok_or_else(unknown)?;
        for path in &self.nodes {
            let node = Node::open(path)?;
            let controls = node.controls()?;
            if controls.iter().any(|c| c.name == name) {
                return node.set_control(&controls, name, value);
            }
        }
        Err(unknown())
    }
}
