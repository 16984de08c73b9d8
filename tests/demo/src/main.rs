//! Makes the files that the demo plays in place of real cameras: an Azure Kinect `.mkv`, side-by-side images of a ZED
//! with its factory calibration, a network for stereo, images for the OAK bridge, and the rig file that names them.
//!
//! usage: `demo-recordings FOLDER COMMAND [ARGUMENT…]`; the command is what serves the camera that lives in another
//! process, which may be `demo-recordings --play FOLDER/oak`. All images show the table of the simulated cameras; none
//! is from a real camera.

mod network;
mod oak;
mod play;
mod zed;

use anyhow::{Context, Result};
use depthrig_kinect_fixture::{Fixture, Simulated};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

/// The rig of the demo, which names the files beside it.
const RIG: &str = include_str!("../rig.toml");
/// Images a second of the Kinect, as a Kinect can.
const KINECT_HZ: u32 = 15;
/// Captures of the Kinect's recording, 1.6 MB each; it plays without end.
const KINECT_CAPTURES: u32 = 36;
/// Different images in it, which come again and again.
const KINECT_SHOTS: usize = 12;

/// Where the rig names the command.
const COMMAND: &str = "\"@COMMAND@\"";

fn main() -> Result<ExitCode> {
    let mut arguments = std::env::args().skip(1);
    let folder = arguments.next().map(PathBuf::from);
    let command = arguments.collect::<Vec<_>>();
    let Some(folder) = folder.filter(|_| !command.is_empty()) else {
        eprintln!("usage: demo-recordings FOLDER COMMAND [ARGUMENT…]");
        return Ok(ExitCode::from(2));
    };
    if folder.as_os_str() == "--play" {
        play::run(Path::new(&command[0]))?;
        return Ok(ExitCode::SUCCESS);
    }
    std::fs::create_dir_all(&folder).with_context(|| format!("{}: cannot be created", folder.display()))?;
    kinect(&folder.join("kinect.mkv"))?;
    zed::write(&folder.join("zed"))?;
    oak::write(&folder.join("oak"))?;
    std::fs::write(
        folder.join("untrained_block_matching.onnx"),
        network::block_matching(zed::SIZE.0, zed::SIZE.1),
    )?;
    let rig = folder.join("rig.toml");
    std::fs::write(&rig, RIG.replace(COMMAND, &words(&command)))?;
    println!("{}", rig.display());
    Ok(ExitCode::SUCCESS)
}

/// The words of a command as items of a TOML array.
fn words(command: &[String]) -> String {
    command.iter().map(|word| format!("{word:?}")).collect::<Vec<_>>().join(", ")
}

/// A recording as Microsoft's recorder writes it: 720p Motion JPEG, the narrow field of view, infrared and motion.
fn kinect(path: &Path) -> Result<()> {
    let mut fixture = Fixture { rate_hz: KINECT_HZ, captures: KINECT_CAPTURES, ..Fixture::default() };
    let mut images = Simulated::shoot(&mut fixture, KINECT_SHOTS);
    fixture.write(path, &mut images).with_context(|| format!("{}: cannot be written", path.display()))?;
    Ok(())
}
