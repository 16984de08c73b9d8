//! The guest's system as scenarios need it: kernel modules, kernel messages, waiting.

use anyhow::{Context, bail};
use depthrig_bus::HostTime;
use std::path::PathBuf;
use std::process::Command;
use std::time::Duration;

/// Loads a module of the list in `tests/vm/rig/initramfs.py`, with `options` like `n_devs=7`.
///
/// # Errors
/// When it cannot be loaded.
pub fn modprobe(module: &str, options: &[&str]) -> anyhow::Result<()> {
    run(Command::new("modprobe").arg(module).args(options)).map(drop)
}

/// The output of a command that must succeed.
///
/// # Errors
/// When it cannot be started or fails, with its output.
pub fn run(command: &mut Command) -> anyhow::Result<String> {
    let done = command.output().with_context(|| format!("{}", command.get_program().display()))?;
    if !done.status.success() {
        let said = String::from_utf8_lossy(&done.stderr);
        bail!("{}: {}, {}", command.get_program().display(), done.status, said.trim());
    }
    Ok(String::from_utf8_lossy(&done.stdout).into_owned())
}

/// Waits until `done` holds, or for at most `limit` of guest time; returns whether it did.
pub fn wait_until(limit: Duration, mut done: impl FnMut() -> bool) -> bool {
    let end = HostTime::now().plus(limit);
    while !done() {
        if HostTime::now() >= end {
            return false;
        }
        std::thread::sleep(Duration::from_millis(15));
    }
    true
}

/// Kernel messages since the last call.
///
/// # Errors
/// When `dmesg` fails.
pub fn kernel_messages() -> anyhow::Result<Vec<String>> {
    let said = run(Command::new("dmesg").arg("-c"))?;
    Ok(said.lines().map(String::from).collect())
}

/// The video nodes there are, by number.
///
/// # Errors
/// When `/dev` cannot be read.
pub fn video_nodes() -> anyhow::Result<Vec<PathBuf>> {
    let mut numbers = Vec::new();
    for entry in std::fs::read_dir("/dev")? {
        let name = entry?.file_name();
        if let Some(number) = name.to_str().and_then(|name| name.strip_prefix("video")) {
            numbers.push(number.parse::<u32>()?);
        }
    }
    numbers.sort_unstable();
    Ok(numbers.into_iter().map(|number| PathBuf::from(format!("/dev/video{number}"))).collect())
}
