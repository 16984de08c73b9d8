//! Agrees with a camera on a stream: probe, then commit (UVC 1.5 class specification, section 4.3.1.1).

use super::camera::Inner;
use super::control::request;
use super::errors::failed;
use depthrig_driver::{Error, ErrorKind, Result};
use depthrig_usb::uvc::control::Query;
use depthrig_usb::uvc::probe::{self, Probe};

/// Tries of the whole exchange; a camera that has just been stopped may refuse the first.
const TRIES: u32 = 3;

/// The streaming parameters that camera and driver agreed on.
#[derive(Debug, Clone)]
pub(super) struct Agreement {
    /// The streaming interface.
    pub interface: u8,
    /// The block as it is committed.
    pub block: Vec<u8>,
    /// The same, read.
    pub probe: Probe,
}

/// Probes `interface` for a mode. Nothing streams before [`commit`].
///
/// # Errors
/// [`ErrorKind::Unsupported`] when the camera offers another mode instead, and those of a request.
pub(super) fn probe(
    camera: &Inner,
    interface: u8,
    format_index: u8,
    frame_index: u8,
    interval: u32,
) -> Result<Agreement> {
    let version = camera.configuration().control_of(interface).map_or(0x0150, |c| c.uvc_version);
    let exchange = || -> rusb::Result<Vec<u8>> {
        let mut block = vec![0; probe::bytes_of_version(version)];
        let ask = |query, block: &mut [u8]| request(camera, interface, 0, probe::PROBE, query, block);
        // The camera's maximum; an older camera answers with an older, shorter block.
        let n = ask(Query::GetMax, &mut block)?;
        block.truncate(n);
        let start = Probe::parse(&block).map_err(|_| rusb::Error::BadDescriptor)?;
        let mut wish = start.wish(format_index, frame_index, interval).build();
        ask(Query::SetCur, &mut wish)?;
        let n = ask(Query::GetCur, &mut wish)?;
        wish.truncate(n);
        Ok(wish)
    };
    let what = format!("probing streaming interface {interface}");
    let mut tried = 1;
    let block = loop {
        match exchange() {
            Ok(block) => break block,
            Err(rusb::Error::Pipe | rusb::Error::Timeout) if tried < TRIES => tried += 1,
            Err(e) => return Err(failed(camera.label(), &what, e)),
        }
    };
    let probe = Probe::parse(&block)?;
    let got = (probe.format_index, probe.frame_index);
    let same_rate = probe.frame_interval.abs_diff(interval) <= interval / 100;
    if got != (format_index, frame_index) || !same_rate {
        return Err(Error::new(
            ErrorKind::Unsupported,
            format!(
                "{}: {what}: asked for format {format_index}, size {frame_index}, interval {interval}; it offers \
                 {}, {}, {}",
                camera.label(),
                got.0,
                got.1,
                probe.frame_interval
            ),
        ));
    }
    Ok(Agreement { interface, block, probe })
}

/// Commits what was agreed: the camera starts to send.
pub(super) fn commit(camera: &Inner, agreement: &Agreement) -> rusb::Result<()> {
    let mut block = agreement.block.clone();
    request(camera, agreement.interface, 0, probe::COMMIT, Query::SetCur, &mut block)?;
    Ok(())
}
