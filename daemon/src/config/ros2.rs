//! The table `[ros2]`: the program that publishes the rig to ROS 2.

use super::Ros2Config;
use super::read::Section;
use super::value::resolve;
use std::path::Path;

/// Reads the table; `None` without one.
pub(super) fn read(top: &Section<'_, '_>, base: &Path) -> Option<Ros2Config> {
    let s = top.table("ros2", "[ros2]");
    if !top.has("ros2") {
        return None;
    }
    let command = s.or("command", Vec::new(), |command: &Vec<String>| match command.first() {
        Some(program) if program.trim().is_empty() => Err("names no program".to_owned()),
        None => Err("is empty; write [\"depthrig-ros2\", \"--domain\", \"7\"], or leave it out".to_owned()),
        _ => Ok(()),
    });
    s.finish();
    Some(Ros2Config { command, directory: resolve(base, Path::new(".")) })
}
