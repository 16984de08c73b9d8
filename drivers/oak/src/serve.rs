//! The camera's frames on their way to the daemon.

use crate::Error;
use crate::arguments::Wishes;
use crate::camera::Camera;
use core::time::Duration;
use depthrig_bus::external::{About, ExternalCamera, ExternalFrame, ExternalReason, Mode, Place};
use depthrig_bus::{HostTime, Name};
use std::os::unix::process::CommandExt;

/// The variable that makes the SDK see these cameras alone (depthai-core `README.md`): the crate itself takes the
/// first.
const DEVICES: &str = "DEPTHAI_DEVICE_ID_LIST";
/// How often the queues of the SDK are looked into: what a time of arrival may be late by.
const LOOK: Duration = Duration::from_millis(1);
/// How often the daemon is asked while nothing runs, and the camera whether it is there.
const PAUSE: Duration = Duration::from_millis(200);

/// Serves the camera until it goes away. The daemon ends the process by a signal.
///
/// # Errors
/// When the camera cannot be started or is gone, and those of the hand-shake.
pub fn run(wishes: &Wishes) -> Result<(), Error> {
    only(wishes.serial.as_deref())?;
    let place = Place::from_environment()?;
    let camera = Camera::start(wishes)?;
    let modes = camera.streams().iter().map(|s| {
        Ok(Mode::new(Name::new(s.name)?, s.format, wishes.size.0, wishes.size.1, f64::from(wishes.rate_hz)))
    });
    let modes = modes.collect::<Result<Vec<_>, Error>>()?;
    let about = About {
        model: "OAK".into(),
        // The crate does not report which camera it opened.
        serial: wishes.serial.clone().unwrap_or_default(),
        calibration: "none".into(),
        program: "depthrig-oak".into(),
        ..About::default()
    };
    let mut offered = ExternalCamera::offer(&place, &about, &modes)?;
    let gone = loop {
        match forward(&camera, &mut offered, wishes) {
            Ok(()) if camera.is_there() => {}
            Ok(()) => break "it is unplugged, or its firmware stopped".to_owned(),
            Err(e) => break e.to_string(),
        }
    };
    offered.end(ExternalReason::Disconnected, &gone);
    Err(format!("the camera is gone: {gone}").into())
}

/// Lets the SDK see the wanted camera alone, by starting this program anew with that in its environment.
fn only(serial: Option<&str>) -> Result<(), Error> {
    let Some(serial) = serial.filter(|s| std::env::var(DEVICES).as_deref() != Ok(*s)) else { return Ok(()) };
    let mut again = std::process::Command::new(std::env::current_exe()?);
    // Only comes back when it fails.
    Err(again.args(std::env::args_os().skip(1)).env(DEVICES, serial).exec().into())
}

/// Serves one session, or a short while without one, in which frames are discarded: the next session begins with new
/// ones.
fn forward(camera: &Camera, offered: &mut ExternalCamera, wishes: &Wishes) -> Result<(), Error> {
    let Some(mut session) = offered.next_session(PAUSE)? else {
        for stream in camera.streams() {
            while stream.next()?.is_some() {}
        }
        return Ok(());
    };
    session.started();
    let running: Vec<usize> = session.modes().map(|(i, _)| i).collect();
    let mut look = HostTime::now();
    while session.is_wanted() {
        let mut idle = true;
        // Modes were offered in the order of the streams.
        for (mode, stream) in camera.streams().iter().enumerate() {
            let Some(frame) = stream.next()? else { continue };
            idle = false;
            if !running.contains(&mode) {
                continue;
            }
            let arrived = ExternalFrame { arrival_time_ns: HostTime::now().ns(), ..ExternalFrame::default() };
            if !stream.fits(&frame, wishes.size.0, wishes.size.1) {
                return Err(
                    format!("{} gives {}, which was not asked for", stream.name, frame.describe()).into()
                );
            }
            session.send_copy(mode, &arrived, &frame.bytes())?;
        }
        if idle {
            std::thread::sleep(LOOK);
        }
        if look.elapsed() > PAUSE {
            if !camera.is_there() {
                break;
            }
            look = HostTime::now();
        }
    }
    Ok(())
}
