//! Control transfers: the standard requests, those of the video class, and the vendor's.

use super::{Device, answer};
use crate::control::{Refusal, probe, query};
use crate::firmware::imu::report_descriptor;
use crate::firmware::{Answer, World, zed};
use crate::model::{Family, Model, Stream};
use crate::usbip::{self, Submit};
use crate::{descriptors, firmware};
use depthrig_bus::HostTime;
use std::io;
use std::os::unix::net::UnixStream;

/// A setup packet, read.
pub(super) struct Setup {
    pub kind: u8,
    pub request: u8,
    pub value: u16,
    pub index: u16,
}

/// The reply to a control transfer; `None` is STALL.
pub(super) type Reply = Option<Vec<u8>>;

impl Device {
    /// Answers a control transfer, or holds it back while that is the fault.
    pub(super) fn control_transfer(
        &mut self,
        line: &UnixStream,
        submit: &Submit,
        data: &[u8],
    ) -> io::Result<()> {
        let word = |at: usize| u16::from_le_bytes([submit.setup[at], submit.setup[at + 1]]);
        let setup = Setup { kind: submit.setup[0], request: submit.setup[1], value: word(2), index: word(4) };
        let to_unit = self.is_unit_request(&setup);
        if to_unit && self.control_held.is_some_and(|end| end > HostTime::now()) {
            self.held.push_back((*submit, data.to_vec()));
            return Ok(());
        }
        let reply = if to_unit && self.control_stalls > 0 {
            self.control_stalls -= 1;
            self.refusal = Refusal::InvalidRequest as u8;
            None
        } else {
            self.request(&setup, data)
        };
        match reply {
            None => answer(line, submit.seq, usbip::STALL, &[], 0),
            Some(bytes) if submit.input => {
                let take = bytes.len().min(submit.length).min(word(6).into());
                answer(line, submit.seq, 0, bytes.get(..take).unwrap_or_default(), take)
            }
            Some(_) => answer(line, submit.seq, 0, &[], submit.length),
        }
    }

    /// A class request to a unit or terminal: not to a stream, not for the error code.
    fn is_unit_request(&self, setup: &Setup) -> bool {
        let interface = (setup.index & 0xFF) as u8;
        matches!(setup.kind, 0x21 | 0xA1)
            && setup.index >> 8 != 0
            && self.model.functions.iter().any(|f| f.interface == interface)
    }

    fn request(&mut self, setup: &Setup, data: &[u8]) -> Reply {
        match (setup.kind, setup.request) {
            (0x80, 6) => self.descriptor(setup),
            (0x80..=0x82, 0) => Some(vec![0, 0]), // status
            (0x80, 8) => Some(vec![1]),           // configuration
            (0x81, 10) => Some(vec![0]),          // alternate setting
            (0x81, 6) if setup.value >> 8 == 0x22 => self.report_descriptor(),
            (0x02, 1) => {
                self.clear_halt(setup.index as u8);
                Some(Vec::new())
            }
            (0x00..=0x02, _) => Some(Vec::new()), // configuration, interface, feature, exit latency
            (0x21 | 0xA1, _) if self.is_hid(setup.index) => self.hid_request(setup, data),
            (0x21 | 0xA1, _) => self.class_request(setup, data),
            _ => None,
        }
    }

    fn descriptor(&self, setup: &Setup) -> Reply {
        let speed = self.speed();
        match setup.value >> 8 {
            1 => Some(descriptors::device(&self.model, speed)),
            2 => descriptors::configuration(&self.model, speed).ok(),
            3 => match setup.value & 0xFF {
                0 => Some(vec![4, 3, 9, 4]),
                1 => Some(descriptors::string(&self.model.manufacturer)),
                2 => Some(descriptors::string(&self.model.product)),
                3 => Some(descriptors::string(&self.identity.chip_serial)),
                _ => None,
            },
            15 => Some(descriptors::object_store()),
            _ => None,
        }
    }

    fn report_descriptor(&self) -> Reply {
        report_descriptor(&self.model).ok()
    }

    fn clear_halt(&mut self, endpoint: u8) {
        if let Some(at) = self.model.streams().position(|s| s.endpoint == endpoint)
            && let Some(pump) = self.pumps.get_mut(at)
        {
            pump.cleared(&self.shared);
        }
        if self.model.vendor.as_ref().is_some_and(|v| v.in_endpoint == endpoint) {
            self.vendor_replies.clear();
        }
    }

    fn class_request(&mut self, setup: &Setup, data: &[u8]) -> Reply {
        let interface = (setup.index & 0xFF) as u8;
        let unit = (setup.index >> 8) as u8;
        let selector = (setup.value >> 8) as u8;
        let stream = self.model.streams().position(|s| s.interface == interface);
        if let Some(at) = stream {
            return self.stream_request(at, selector, setup.request, data);
        }
        if !self.model.functions.iter().any(|f| f.interface == interface) {
            return None;
        }
        if unit == 0 {
            // The error code of the request that was refused last.
            return (selector == 2 && setup.request == query::GET_CUR).then(|| vec![self.refusal]);
        }
        let result = if setup.request == query::SET_CUR {
            self.units.set(interface, unit, selector, data).map(|()| {
                self.unit_was_set(unit, selector, data);
                Vec::new()
            })
        } else {
            self.before_unit_is_read(unit, selector);
            self.units.get(interface, unit, selector, setup.request)
        };
        match result {
            Ok(bytes) => {
                self.refusal = 0;
                Some(bytes)
            }
            Err(refusal) => {
                self.refusal = refusal as u8;
                None
            }
        }
    }

    /// Controls that do something when they are written.
    fn unit_was_set(&mut self, unit: u8, selector: u8, data: &[u8]) {
        if matches!(self.model.family, Family::D400 | Family::L515) && (unit, selector) == (3, 1) {
            match self.monitor(data) {
                Answer::Reply(reply) => self.units.put(unit, selector, &firmware::as_control(&reply)),
                Answer::Restart => self.restart = true,
            }
        }
        if self.model.family == Family::Zed && (unit, selector) == zed::CONTROL {
            let reply = self.bridge.command(data, &self.identity.serial);
            self.units.put(unit, selector, &reply);
        }
    }

    /// Controls that the firmware sets by itself.
    fn before_unit_is_read(&mut self, unit: u8, selector: u8) {
        if self.model.family == Family::D400 && (unit, selector) == (3, 9) {
            // Both known only while it streams: valid flags, then projector and processor in °C.
            let known = u8::from(self.streaming());
            self.units.put(unit, selector, &[known, known, 36 * known, 41 * known]);
        }
    }

    fn monitor(&mut self, data: &[u8]) -> Answer {
        let streaming = self.streaming();
        let model = &*self.model;
        let identity = &self.identity;
        let clock = &self.clock;
        let world = World { model, identity, clock, now: HostTime::now(), streaming };
        if let Some(asked) = firmware::asked(data) {
            self.shared.remember(asked);
        }
        let answer = self.firmware.monitor(data, &world);
        if let Some(opcode) = self.firmware.unknown {
            self.shared.lock().unknown.insert(opcode);
        }
        answer
    }

    /// A request of the hardware monitor over the vendor's endpoint.
    pub(super) fn vendor_request(&mut self, data: &[u8]) {
        match self.monitor(data) {
            Answer::Reply(reply) => self.vendor_replies.push_back(reply),
            Answer::Restart => self.restart = true,
        }
        // A host that never reads its replies does not fill the memory.
        if self.vendor_replies.len() > 16 {
            self.vendor_replies.pop_front();
        }
    }

    fn stream_request(&mut self, at: usize, selector: u8, request: u8, data: &[u8]) -> Reply {
        if !matches!(selector, 1 | 2) {
            return None;
        }
        let length = self.model.probe_length;
        let (stream, clock_hz) = stream_of(&self.model, at)?;
        let negotiate =
            |proposal: &[u8]| probe::negotiate(stream, self.options.speed, length, clock_hz, proposal).ok();
        match request {
            query::SET_CUR => {
                let agreed = negotiate(data)?;
                let mode = agreed.1;
                if let Some(probe) = self.probes.get_mut(at) {
                    *probe = Some(agreed);
                }
                if selector == 2 {
                    let settings = self.settings();
                    let pump = self.pumps.get_mut(at)?;
                    pump.start(mode, self.clock, &settings, &self.shared);
                }
                Some(Vec::new())
            }
            query::GET_CUR => match self.probes.get(at)? {
                Some((bytes, _)) => Some(bytes.clone()),
                None => Some(negotiate(&[])?.0),
            },
            query::GET_MIN | query::GET_MAX | query::GET_DEF => Some(negotiate(&[])?.0),
            query::GET_LEN => Some((length as u16).to_le_bytes().to_vec()),
            query::GET_INFO => Some(vec![3]),
            _ => None,
        }
    }
}

/// A stream and the clock of its function.
fn stream_of(model: &Model, at: usize) -> Option<(&Stream, u32)> {
    model.functions.iter().flat_map(|f| f.streams.iter().map(|s| (s, f.clock_hz))).nth(at)
}
