//! Faults that can be injected, and their syntax on the control socket.

use crate::{Error, Result};
use core::str::FromStr;
use core::time::Duration;

/// A fault. Those with `frames` or `times` end by themselves; [`Fault::Clear`] ends all the others.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Fault {
    /// The next frames of a stream are damaged.
    Frames {
        /// The stream's name.
        stream: String,
        /// How.
        damage: Damage,
        /// How many of them.
        frames: u32,
    },
    /// The streams send nothing more; everything else answers.
    Silence,
    /// The bulk endpoint of a stream answers STALL until the host clears it.
    StallEndpoint {
        /// The stream's name.
        stream: String,
    },
    /// No bulk endpoint answers any more, that of the vendor interface included; control requests do.
    Nak,
    /// Requests to units are not answered for so long; the streams go on.
    ControlTimeout(Duration),
    /// The next requests to units are refused with STALL.
    ControlStall {
        /// How many.
        times: u32,
    },
    /// The next replies of the hardware monitor are wrong.
    Reply {
        /// How.
        wrong: WrongReply,
        /// Those to requests with this opcode; `None`: to every request.
        to: Option<u32>,
        /// How many.
        times: u32,
    },
    /// The next samples of the gyroscope are not sent.
    ImuSkip(u32),
    /// The sensors of the IMU send nothing until they have lost their power so many times.
    ImuSilence(u32),
    /// The device's clock jumps by so many microseconds.
    ClockJump(i64),
    /// The device's clock starts again at 0.
    ClockReset,
    /// One bit of a calibration table is wrong, so that its checksum does not fit.
    DamagedTable(u32),
    /// Its tables are those of a unit that was never calibrated.
    Uncalibrated,
    /// The camera reports this error code until the next such command.
    ReportError(u8),
    /// The camera restarts by itself: it drops off the bus and comes back.
    Restart,
    /// All faults end.
    Clear,
}

/// Damage to a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Damage {
    /// The ERR bit of its header is set.
    ErrorBit,
    /// The last two thirds are missing.
    Short,
    /// 512 bytes too many.
    Long,
    /// The frame before it comes again in its place.
    Repeat,
    /// It is not sent.
    Skip,
}

/// Defect of a reply of the hardware monitor.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum WrongReply {
    /// It names another opcode.
    Opcode,
    /// It is this error code.
    Code(i32),
    /// Every byte is random.
    Garbage,
    /// Half of it is missing.
    Truncated,
}

impl Fault {
    /// Its name in the accounts.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Frames { damage, .. } => match damage {
                Damage::ErrorBit => "error-bit",
                Damage::Short => "short",
                Damage::Long => "long",
                Damage::Repeat => "repeat",
                Damage::Skip => "skip",
            },
            Self::Silence => "silence",
            Self::StallEndpoint { .. } => "stall-endpoint",
            Self::Nak => "nak",
            Self::ControlTimeout(_) => "control-timeout",
            Self::ControlStall { .. } => "control-stall",
            Self::Reply { .. } => "reply",
            Self::ImuSkip(_) => "imu-skip",
            Self::ImuSilence(_) => "imu-silence",
            Self::ClockJump(_) => "clock-jump",
            Self::ClockReset => "clock-reset",
            Self::DamagedTable(_) => "damaged-table",
            Self::Uncalibrated => "uncalibrated",
            Self::ReportError(_) => "report-error",
            Self::Restart => "restart",
            Self::Clear => "clear",
        }
    }
}

fn number<T: FromStr>(word: Option<&&str>, what: &str) -> Result<T> {
    let word = word.ok_or_else(|| Error::new(format!("the fault lacks {what}")))?;
    word.parse().map_err(|_| Error::new(format!("'{word}' is not {what}")))
}

impl FromStr for Fault {
    type Err = Error;

    /// Reads a fault as the control socket has it: `short depth 3`, `control-timeout 6.5`, `reply code -7 1`.
    fn from_str(text: &str) -> Result<Self> {
        let words: Vec<&str> = text.split_whitespace().collect();
        let (name, rest) = words.split_first().ok_or_else(|| Error::new("no fault is named"))?;
        let frames = |damage| {
            let stream = number(rest.first(), "a stream")?;
            Ok(Self::Frames { stream, damage, frames: number(rest.get(1), "a number of frames")? })
        };
        match *name {
            "error-bit" => frames(Damage::ErrorBit),
            "short" => frames(Damage::Short),
            "long" => frames(Damage::Long),
            "repeat" => frames(Damage::Repeat),
            "skip" => frames(Damage::Skip),
            "silence" => Ok(Self::Silence),
            "stall-endpoint" => Ok(Self::StallEndpoint { stream: number(rest.first(), "a stream")? }),
            "nak" => Ok(Self::Nak),
            "control-timeout" => {
                let seconds: f64 = number(rest.first(), "a number of seconds")?;
                let time = Duration::try_from_secs_f64(seconds);
                Ok(Self::ControlTimeout(time.map_err(|e| Error::new(format!("{seconds} s: {e}")))?))
            }
            "control-stall" => {
                Ok(Self::ControlStall { times: number(rest.first(), "a number of requests")? })
            }
            "reply" => {
                let (wrong, used) = match rest.first() {
                    Some(&"opcode") => (WrongReply::Opcode, 1),
                    Some(&"code") => (WrongReply::Code(number(rest.get(1), "an error code")?), 2),
                    Some(&"garbage") => (WrongReply::Garbage, 1),
                    Some(&"truncated") => (WrongReply::Truncated, 1),
                    _ => return Err(Error::new("a wrong reply is opcode, code N, garbage or truncated")),
                };
                let times = number(rest.get(used), "a number of replies")?;
                let to = match rest.get(used + 1) {
                    Some(&"to") => Some(number(rest.get(used + 2), "an opcode")?),
                    _ => None,
                };
                Ok(Self::Reply { wrong, to, times })
            }
            "imu-skip" => Ok(Self::ImuSkip(number(rest.first(), "a number of samples")?)),
            "imu-silence" => Ok(Self::ImuSilence(number(rest.first(), "a number of power cycles")?)),
            "clock-jump" => Ok(Self::ClockJump(number(rest.first(), "a number of microseconds")?)),
            "clock-reset" => Ok(Self::ClockReset),
            "damaged-table" => Ok(Self::DamagedTable(number(rest.first(), "the number of a table")?)),
            "uncalibrated" => Ok(Self::Uncalibrated),
            "report-error" => Ok(Self::ReportError(number(rest.first(), "an error code")?)),
            "restart" => Ok(Self::Restart),
            "clear" => Ok(Self::Clear),
            other => Err(Error::new(format!("there is no fault '{other}'"))),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn faults_are_read_as_they_are_named() {
        for text in [
            "error-bit depth 1",
            "short color 2",
            "long ir 3",
            "repeat depth 1",
            "skip depth 4",
            "silence",
            "stall-endpoint depth",
            "nak",
            "control-timeout 6.5",
            "control-stall 2",
            "reply opcode 1",
            "reply code -7 2",
            "reply garbage 1",
            "reply truncated 1",
            "reply truncated 1 to 21",
            "imu-skip 3",
            "imu-silence 2",
            "clock-jump -5000",
            "clock-reset",
            "damaged-table 25",
            "uncalibrated",
            "report-error 2",
            "restart",
            "clear",
        ] {
            let fault: Fault = text.parse().unwrap();
            assert!(text.starts_with(fault.name()), "{text}: {fault:?}");
        }
        assert_eq!(
            "reply code -7 2".parse::<Fault>().unwrap(),
            Fault::Reply { wrong: WrongReply::Code(-7), to: None, times: 2 }
        );
        assert_eq!(
            "reply code -7 2 to 21".parse::<Fault>().unwrap(),
            Fault::Reply { wrong: WrongReply::Code(-7), to: Some(0x15), times: 2 }
        );
        for wrong in [
            "",
            "short depth",
            "short",
            "reply",
            "reply code",
            "reply garbage 1 to",
            "control-timeout x",
            "control-timeout -1",
            "x",
        ] {
            assert!(wrong.parse::<Fault>().is_err(), "{wrong}");
        }
    }
}
