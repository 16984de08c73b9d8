//! What answers the vendor's requests: the hardware monitor of RealSense cameras, the registers of a ZED.

mod d400;
mod monitor;

use crate::clock::DeviceClock;
use crate::content;
use crate::fault::{Fault, WrongReply};
use crate::model::{Family, Model};
use depthrig_bus::HostTime;
use monitor::Request;

/// Who a camera is.
#[derive(Debug, Clone)]
pub(crate) struct Identity {
    /// What is printed on it and what its firmware calls its serial.
    pub serial: String,
    /// The serial of its chip, which is what USB shows for a RealSense camera.
    pub chip_serial: String,
}

impl Identity {
    /// Everything about a camera follows from its serial.
    pub fn new(model: &Model, serial: &str) -> Self {
        let chip_serial = match model.family {
            Family::D400 | Family::L515 => {
                format!("{:012}", content::hash(&format!("{serial} chip")) % 1_000_000_000_000)
            }
            Family::Zed | Family::ZedMcu => serial.to_owned(),
        };
        Self { serial: serial.to_owned(), chip_serial }
    }
}

/// What the firmware may look at while it answers.
pub(crate) struct World<'a> {
    pub model: &'a Model,
    pub identity: &'a Identity,
    pub clock: &'a DeviceClock,
    pub now: HostTime,
}

/// What a command of the host leads to.
pub(crate) enum Answer {
    Reply(Vec<u8>),
    /// None comes: the camera restarts.
    Restart,
}

/// The state of a camera's firmware since power-on.
pub(crate) struct Firmware {
    d400: d400::State,
    wrong: Option<(WrongReply, u32)>,
    seed: u64,
}

impl Firmware {
    pub fn new(model: &Model) -> Self {
        Self { d400: d400::State::new(model), wrong: None, seed: 1 }
    }

    /// Takes a fault that is the firmware's; says whether it was.
    pub fn fault(&mut self, fault: &Fault) -> bool {
        match fault {
            Fault::Reply { wrong, times } => self.wrong = Some((*wrong, *times)),
            Fault::Clear => self.wrong = None,
            _ => return false,
        }
        true
    }

    /// Answers a request of the hardware monitor.
    pub fn monitor(&mut self, bytes: &[u8], world: &World<'_>) -> Answer {
        let reply = match Request::parse(bytes) {
            Some(request) => match world.model.family {
                Family::D400 => match self.d400.answer(&request, world) {
                    Some(answer) => monitor::reply(request.opcode, answer),
                    None => return Answer::Restart,
                },
                _ => monitor::reply(request.opcode, Err(monitor::WRONG_COMMAND)),
            },
            None => monitor::error(monitor::WRONG_COMMAND),
        };
        Answer::Reply(self.spoil(reply))
    }

    fn spoil(&mut self, reply: Vec<u8>) -> Vec<u8> {
        let Some((wrong, times)) = self.wrong else { return reply };
        self.wrong = (times > 1).then_some((wrong, times - 1));
        match wrong {
            WrongReply::Opcode => {
                let mut reply = reply;
                if let Some(byte) = reply.first_mut() {
                    *byte ^= 0x40;
                }
                reply
            }
            WrongReply::Code(code) => monitor::error(code),
            WrongReply::Garbage => {
                let mut next = || {
                    self.seed = self
                        .seed
                        .wrapping_mul(6_364_136_223_846_793_005)
                        .wrapping_add(1_442_695_040_888_963_407);
                    (self.seed >> 56) as u8
                };
                reply.iter().map(|_| next()).collect()
            }
            WrongReply::Truncated => reply[..reply.len() / 2].to_vec(),
        }
    }
}

/// A reply of the hardware monitor as the extension unit hands it out.
pub(crate) fn as_control(reply: &[u8]) -> Vec<u8> {
    monitor::control(reply)
}
