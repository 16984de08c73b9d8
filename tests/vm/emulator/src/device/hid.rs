//! A HID interface: its class requests, and its input reports.

use super::requests::{Reply, Setup};
use super::{Device, answer};
use crate::model::Family;
use depthrig_bus::HostTime;
use std::io;
use std::os::unix::net::UnixStream;

impl Device {
    pub(super) fn is_hid(&self, interface: u16) -> bool {
        self.model.hid.as_ref().is_some_and(|hid| u16::from(hid.interface) == interface)
    }

    /// GET_REPORT, SET_REPORT, SET_IDLE (Device Class Definition for HID 1.11, section 7.2).
    pub(super) fn hid_request(&mut self, setup: &Setup, data: &[u8]) -> Reply {
        let of_imu = self.model.family == Family::ZedMcu;
        if let Some(imu) = &mut self.imu {
            let running_ns = self.clock.running_ns(HostTime::now());
            return match (setup.kind, setup.request, setup.value >> 8) {
                (0xA1, 0x01, 3) => imu.read_feature(setup.value as u8),
                (0x21, 0x09, 3) => imu.write_feature(data, running_ns).map(|()| Vec::new()),
                (0x21, 0x0A, _) => Some(Vec::new()),
                _ => None,
            };
        }
        match (setup.kind, setup.request) {
            (0xA1, 0x01) if of_imu => Some(self.motion.read_feature(setup.value as u8)),
            (0x21, 0x09) if of_imu => {
                self.motion.feature(data, HostTime::now());
                Some(Vec::new())
            }
            (0x21, 0x0A) => Some(Vec::new()),
            _ => None,
        }
    }

    /// Takes the IMU samples that are due and sends their reports into waiting transfers.
    pub(super) fn imu_reports(&mut self, line: &UnixStream, now: HostTime) -> io::Result<()> {
        let Some(endpoint) = self.model.hid.as_ref().map(|hid| hid.endpoint) else { return Ok(()) };
        let Some(imu) = &mut self.imu else { return Ok(()) };
        let measured = imu.advance(now, &self.clock, self.silent);
        if !measured.is_empty() {
            self.shared.measured(measured);
        }
        while imu.is_ready() {
            let Some(at) = self.idle_urbs.iter().position(|(address, _)| *address == endpoint) else { break };
            let (_, urb) = self.idle_urbs.remove(at);
            let report = imu.take().unwrap_or_default();
            let take = urb.length.min(report.len());
            answer(line, urb.seq, 0, report.get(..take).unwrap_or_default(), take)?;
        }
        Ok(())
    }

    /// Sends the input reports that are due.
    pub(super) fn reports(&mut self, line: &UnixStream, now: HostTime) -> io::Result<()> {
        if self.motion.next_due().is_none_or(|due| due > now) {
            return Ok(());
        }
        let frames = self.video.as_ref().and_then(|video| video.exposures(now));
        let Some(record) = self.motion.record(now, frames) else { return Ok(()) };
        let Some(endpoint) = self.model.hid.as_ref().map(|hid| hid.endpoint) else { return Ok(()) };
        // Without a transfer that waits, the record is lost, as on a device.
        let Some(at) = self.idle_urbs.iter().position(|(address, _)| *address == endpoint) else {
            return Ok(());
        };
        let (_, urb) = self.idle_urbs.remove(at);
        let take = urb.length.min(record.len());
        answer(line, urb.seq, 0, record.get(..take).unwrap_or_default(), take)
    }
}
