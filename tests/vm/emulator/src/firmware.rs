//! Firmware that answers the vendor's requests: the hardware monitor of RealSense cameras, the registers of a ZED.

mod d400;
pub(crate) mod imu;
mod imu_table;
mod l515;
mod monitor;
pub(crate) mod zed;

use crate::calibration::Calibration;
use crate::clock::DeviceClock;
use crate::content;
use crate::fault::{Fault, WrongReply};
use crate::model::{Family, Model};
use depthrig_bus::HostTime;
use monitor::Request;
use std::collections::BTreeSet;

/// Identity of a camera.
#[derive(Debug, Clone)]
pub(crate) struct Identity {
    /// The serial that is printed on it and that its firmware reports.
    pub serial: String,
    /// The serial of its chip, which is what USB shows for a RealSense camera.
    pub chip_serial: String,
    pub calibration: Calibration,
}

impl Identity {
    /// Everything about a camera follows from its serial.
    pub fn new(model: &Model, serial: &str) -> Self {
        let chip_serial = match model.family {
            Family::D400 | Family::L515 => {
                format!("{:012}", content::hash(&format!("{serial} chip")) % 1_000_000_000_000)
            }
            // The same on every unit: the bridge has no serial of its own.
            Family::Zed => "OV0001".to_owned(),
            Family::ZedMcu | Family::Plain => serial.to_owned(),
        };
        Self { serial: serial.to_owned(), chip_serial, calibration: Calibration::new(model, serial) }
    }
}

/// State that the firmware reads while it answers.
pub(crate) struct World<'a> {
    pub model: &'a Model,
    pub identity: &'a Identity,
    pub clock: &'a DeviceClock,
    pub now: HostTime,
    /// A stream is running.
    pub streaming: bool,
}

/// Opcode that reads the clock.
const READ_MEMORY: u32 = 0x01;

/// A request that the hardware monitor received.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Asked {
    /// Its opcode.
    pub opcode: u32,
    /// Its parameters.
    pub params: [u32; 4],
    /// The data behind them.
    pub data: Vec<u8>,
}

/// Answer to a command of the host.
pub(crate) enum Answer {
    Reply(Vec<u8>),
    /// No reply; the camera restarts.
    Restart,
}

/// Faults of the flash contents; they outlive a restart.
#[derive(Debug, Default)]
pub(crate) struct Flash {
    pub damaged: BTreeSet<u32>,
    pub uncalibrated: bool,
}

/// Replies that are to be wrong.
#[derive(Debug, Clone, Copy)]
struct Wrong {
    how: WrongReply,
    /// To this request; `None`: to each.
    to: Option<u32>,
    times: u32,
}

/// A camera's firmware.
pub(crate) struct Firmware {
    d400: d400::State,
    l515: l515::State,
    flash: Flash,
    wrong: Option<Wrong>,
    seed: u64,
    /// The opcode of the last request, if it was none that the firmware knows.
    pub unknown: Option<u32>,
}

impl Firmware {
    pub fn new(model: &Model) -> Self {
        let flash = Flash::default();
        Self {
            d400: d400::State::new(model),
            l515: l515::State::default(),
            flash,
            wrong: None,
            seed: 1,
            unknown: None,
        }
    }

    /// Everything but the flash starts again.
    pub fn power_on(&mut self, model: &Model) {
        self.d400 = d400::State::new(model);
        self.l515 = l515::State::default();
    }

    /// Takes a fault that is the firmware's.
    pub fn fault(&mut self, fault: &Fault) {
        match fault {
            Fault::Reply { wrong, to, times } => {
                self.wrong = Some(Wrong { how: *wrong, to: *to, times: *times }).filter(|w| w.times > 0);
            }
            Fault::DamagedTable(id) => drop(self.flash.damaged.insert(*id)),
            Fault::Uncalibrated => self.flash.uncalibrated = true,
            Fault::Clear => {
                self.wrong = None;
                self.flash = Flash::default();
            }
            _ => {}
        }
    }

    /// Answers a request of the hardware monitor.
    pub fn monitor(&mut self, bytes: &[u8], world: &World<'_>) -> Answer {
        let Some(request) = Request::parse(bytes) else {
            return Answer::Reply(self.spoil(None, monitor::error(monitor::WRONG_COMMAND)));
        };
        let answer = match world.model.family {
            Family::D400 => self.d400.answer(&request, world, &self.flash),
            Family::L515 => self.l515.answer(&request, world, &self.flash),
            Family::Zed | Family::ZedMcu | Family::Plain => Some(Err(monitor::WRONG_COMMAND)),
        };
        self.unknown = matches!(answer, Some(Err(monitor::WRONG_COMMAND))).then_some(request.opcode);
        match answer {
            Some(answer) => {
                Answer::Reply(self.spoil(Some(request.opcode), monitor::reply(request.opcode, answer)))
            }
            None => Answer::Restart,
        }
    }

    /// The reply to a request, altered by an active fault.
    fn spoil(&mut self, opcode: Option<u32>, mut reply: Vec<u8>) -> Vec<u8> {
        let Some(wrong) = self.wrong.filter(|w| w.to.is_none() || w.to == opcode) else { return reply };
        let times = wrong.times - 1;
        self.wrong = (times > 0).then_some(Wrong { times, ..wrong });
        match wrong.how {
            WrongReply::Opcode => {
                if let Some(byte) = reply.first_mut() {
                    *byte ^= 0x40;
                }
            }
            WrongReply::Code(code) => reply = monitor::error(code),
            WrongReply::Garbage => {
                for byte in &mut reply {
                    self.seed = self
                        .seed
                        .wrapping_mul(6_364_136_223_846_793_005)
                        .wrapping_add(1_442_695_040_888_963_407);
                    *byte = (self.seed >> 56) as u8;
                }
            }
            WrongReply::Truncated => reply.truncate(reply.len() / 2),
        }
        reply
    }
}

/// A request to be remembered: each but readings of the clock, of which there is one a second.
pub(crate) fn asked(bytes: &[u8]) -> Option<Asked> {
    let request = Request::parse(bytes).filter(|r| r.opcode != READ_MEMORY)?;
    Some(Asked { opcode: request.opcode, params: request.params, data: request.data.to_vec() })
}

/// A reply of the hardware monitor as the extension unit hands it out.
pub(crate) fn as_control(reply: &[u8]) -> Vec<u8> {
    monitor::control(reply)
}

/// The clock register: the only memory that can be read.
fn read_clock(request: &Request<'_>, world: &World<'_>, address: u32) -> Result<Vec<u8>, i32> {
    if request.params[0] != address || request.params[1] != address + 4 {
        return Err(monitor::WRONG_PARAMETER);
    }
    Ok(world.clock.shown_us(world.clock.running_ns(world.now)).to_le_bytes().to_vec())
}
