//! Vendor commands: blocks that are written to and read back from selector 2 of extension unit 4.
//!
//! The value of the selector has 384 bytes on USB 3 and 64 on USB 2. Byte 0 says whether the command sets or gets,
//! byte 1 is the command; what is read comes from byte 17 on. Behind it are the flash, the registers of the bridge
//! chip (OV580) and, over its I2C bus, those of the two image sensors (OV4689).

use super::mode::Side;
use core::time::Duration;
use depthrig_driver::{Error, ErrorKind, Result};
use depthrig_usb::uvc::control::{ControlPort, Query};

/// Extension unit of the vendor commands.
pub const UNIT: u8 = 4;
/// Selector of the vendor commands.
pub const SELECTOR: u8 = 2;
/// Bytes of the value on USB 3; on USB 2 it has 64.
pub const BLOCK_BYTES: usize = 384;
/// First byte of an answer.
const ANSWER: usize = 17;
/// Byte of the value that a register is set to.
const VALUE: usize = 16;
/// The device needs a moment between the request and its answer; the open code waits 0.3 ms, or 2 ms to be safe.
const PAUSE: Duration = Duration::from_millis(2);
/// Flash address of the serial number.
const SERIAL_ADDRESS: u32 = 0x0001_8000;
/// Pin of the light on the camera's front.
const LED_PIN: u8 = 2;
/// Bit of [`isp_control`] that has the bridge regulate exposure and gain.
const AUTO_EXPOSURE: u8 = 0x02;
/// I2C address of an image sensor.
const SENSOR: u8 = 0x6C;

/// A command block of the longer form; the shorter one is its beginning.
pub type Block = [u8; BLOCK_BYTES];

/// One of the vendor commands.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Command {
    /// Reads `length` bytes of the flash.
    ReadFlash {
        /// Address in the flash.
        address: u32,
        /// How many bytes.
        length: u16,
    },
    /// Reads a register of the bridge.
    ReadSystem {
        /// Its address.
        address: u32,
    },
    /// Writes a register of the bridge.
    WriteSystem {
        /// Its address.
        address: u32,
        /// Its new value.
        value: u8,
    },
    /// Reads a register of an image sensor.
    ReadSensor {
        /// Which sensor.
        side: Side,
        /// Its address.
        address: u16,
    },
    /// Writes a register of an image sensor.
    WriteSensor {
        /// Which sensor.
        side: Side,
        /// Its address.
        address: u16,
        /// Its new value.
        value: u8,
    },
    /// Makes a pin an output, or an input.
    PinDirection {
        /// Number of the pin, 0 to 4.
        pin: u8,
        /// An output.
        output: bool,
    },
    /// Sets a pin.
    SetPin {
        /// Number of the pin.
        pin: u8,
        /// High.
        high: bool,
    },
    /// Reads a pin.
    GetPin {
        /// Number of the pin.
        pin: u8,
    },
}

impl Command {
    /// Whether an answer is read back.
    pub const fn has_answer(self) -> bool {
        matches!(
            self,
            Self::ReadFlash { .. } | Self::ReadSystem { .. } | Self::ReadSensor { .. } | Self::GetPin { .. }
        )
    }

    /// The block that is written.
    pub fn block(self) -> Block {
        let mut b = [0; BLOCK_BYTES];
        b[0] = if self.has_answer() { 0x51 } else { 0x50 };
        match self {
            Self::ReadFlash { address, length } => {
                b[1..3].copy_from_slice(&[0xA1, 0x03]);
                b[5..9].copy_from_slice(&address.to_be_bytes());
                b[9..11].copy_from_slice(&length.wrapping_add(0x9000).to_be_bytes());
                b[11..13].copy_from_slice(&length.to_be_bytes());
            }
            Self::ReadSystem { address } | Self::WriteSystem { address, .. } => {
                // Addresses of four bytes, data of one, one of them.
                b[1..5].copy_from_slice(&[0xA2, 0x00, 0x04, 0x01]);
                b[5..9].copy_from_slice(&address.to_be_bytes());
                b[9..13].copy_from_slice(&[0x00, 0x01, 0x00, 0x01]);
            }
            Self::ReadSensor { side, address } | Self::WriteSensor { side, address, .. } => {
                b[1] = match side {
                    Side::Left => 0xA3,
                    Side::Right => 0xA5,
                };
                b[2..5].copy_from_slice(&[SENSOR, 0x02, 0x01]);
                b[5..9].copy_from_slice(&u32::from(address).to_be_bytes());
                b[9..13].copy_from_slice(&[0x90, 0x01, 0x00, 0x01]);
            }
            Self::PinDirection { pin, output } => b[1..4].copy_from_slice(&[0x10, pin, u8::from(!output)]),
            Self::SetPin { pin, high } => b[1..4].copy_from_slice(&[0x12, pin, u8::from(high)]),
            Self::GetPin { pin } => b[1..3].copy_from_slice(&[0x13, pin]),
        }
        if let Self::WriteSystem { value, .. } | Self::WriteSensor { value, .. } = self {
            b[VALUE] = value;
        }
        b
    }

    /// Parses the command in a block, for an emulated camera; `None` if it is not one of these.
    pub fn parse(block: &[u8]) -> Option<Self> {
        let b: [u8; 17] = block.get(..17)?.try_into().ok()?;
        let address = u32::from_be_bytes([b[5], b[6], b[7], b[8]]);
        let side = |code| if code == 0xA3 { Side::Left } else { Side::Right };
        Some(match (b[0], b[1]) {
            (0x51, 0xA1) => Self::ReadFlash { address, length: u16::from_be_bytes([b[11], b[12]]) },
            (0x51, 0xA2) => Self::ReadSystem { address },
            (0x50, 0xA2) => Self::WriteSystem { address, value: b[VALUE] },
            (0x51, code @ (0xA3 | 0xA5)) => {
                Self::ReadSensor { side: side(code), address: u16::try_from(address).ok()? }
            }
            (0x50, code @ (0xA3 | 0xA5)) => {
                Self::WriteSensor { side: side(code), address: u16::try_from(address).ok()?, value: b[VALUE] }
            }
            (0x50, 0x10) => Self::PinDirection { pin: b[2], output: b[3] == 0 },
            (0x50, 0x12) => Self::SetPin { pin: b[2], high: b[3] != 0 },
            (0x51, 0x13) => Self::GetPin { pin: b[2] },
            _ => return None,
        })
    }
}

/// Puts `data` where an answer stands; what does not fit is left out.
pub fn answer(block: &mut [u8], data: &[u8]) {
    for (to, from) in block.iter_mut().skip(ANSWER).zip(data) {
        *to = *from;
    }
}

/// The flash's bytes at the serial number's address, for an emulated camera.
///
/// # Errors
/// [`ErrorKind::BadInput`] unless `serial` is a decimal number of at most eight digits.
pub fn serial_bytes(serial: &str) -> Result<[u8; 6]> {
    let digits = (serial.len() <= 8 && serial.bytes().all(|c| c.is_ascii_digit()))
        .then(|| u32::from_str_radix(serial, 16).ok())
        .flatten()
        .ok_or_else(|| {
            Error::new(
                ErrorKind::BadInput,
                format!("invalid ZED serial number \"{serial}\"; it has up to 8 decimal digits"),
            )
        })?;
    let [a, b, c, d] = digits.to_be_bytes();
    Ok([b'O', b'V', a, b, c, d])
}

/// The serial number in the flash's bytes: `OV`, then four bytes whose hexadecimal digits are its decimal ones.
///
/// # Errors
/// [`ErrorKind::Protocol`] when they hold none.
pub fn parse_serial(flash: &[u8]) -> Result<String> {
    let found = match flash {
        [b'O', b'V', a, b, c, d, ..] => format!("{:x}", u32::from_be_bytes([*a, *b, *c, *d])),
        _ => String::new(),
    };
    if found.is_empty() || found == "0" || found.bytes().any(|c| !c.is_ascii_digit()) {
        let shown = flash.get(..6).unwrap_or(flash);
        let what =
            format!("the flash of the ZED holds no serial number at {SERIAL_ADDRESS:#x}: {shown:02x?}");
        return Err(Error::new(ErrorKind::Protocol, what));
    }
    Ok(found)
}

/// Raw exposure (sensor lines) of 100 % at a frame rate. Rates between are taken as the next higher one.
pub fn longest_exposure(rate_hz: f64) -> u32 {
    match rate_hz {
        r if r <= 15.5 => 1550,
        r if r <= 30.5 => 1100,
        r if r <= 60.5 => 880,
        _ => 720,
    }
}

/// The least raw exposure.
const SHORTEST_EXPOSURE: u32 = 2;
/// Registers of the exposure, the high byte first; the value is in sixteenths of a line.
const EXPOSURE: [u16; 3] = [0x3500, 0x3501, 0x3502];
/// Registers of the gain, the high byte first.
const GAIN: [u16; 3] = [0x3507, 0x3508, 0x3509];
/// Zones of the raw gain; what lies between them is not used. A zone's first value is the one before's last.
const GAIN_ZONES: [(u32, u32); 4] = [(0, 255), (378, 511), (890, 1023), (1914, 2047)];

/// Raw exposure of `percent` (0 to 100) of the longest at this frame rate.
pub fn raw_exposure(percent: u8, rate_hz: f64) -> u32 {
    (longest_exposure(rate_hz) * u32::from(percent.min(100)) / 100).max(SHORTEST_EXPOSURE)
}

/// Percent of the longest exposure at this frame rate, rounded.
pub fn exposure_percent(raw: u32, rate_hz: f64) -> u8 {
    let longest = longest_exposure(rate_hz);
    ((raw.min(longest) * 100 + longest / 2) / longest) as u8
}

/// Raw gain of `percent`, 0 to 100, over all zones.
pub fn raw_gain(percent: u8) -> u32 {
    let steps: u32 = GAIN_ZONES.iter().map(|(low, high)| high - low).sum();
    let mut left = (steps * u32::from(percent.min(100)) + 50) / 100;
    for (low, high) in GAIN_ZONES {
        if left <= high - low {
            return low + left;
        }
        left -= high - low;
    }
    GAIN_ZONES[3].1
}

/// Percent of a raw gain, rounded; `None` between the zones.
pub fn gain_percent(raw: u32) -> Option<u8> {
    let steps: u32 = GAIN_ZONES.iter().map(|(low, high)| high - low).sum();
    let zone = GAIN_ZONES.iter().position(|(low, high)| (*low..=*high).contains(&raw))?;
    let before: u32 = GAIN_ZONES[..zone].iter().map(|(low, high)| high - low).sum();
    Some((((before + raw - GAIN_ZONES[zone].0) * 100 + steps / 2) / steps) as u8)
}

/// Bridge register with the switch of automatic exposure and gain.
const fn isp_control(side: Side) -> u32 {
    match side {
        Side::Left => 0x8018_1033,
        Side::Right => 0x8018_1833,
    }
}

/// The vendor commands of one camera, over whatever carries its control requests.
pub struct Vendor<P> {
    port: P,
    length: usize,
    /// Names the camera in messages.
    device: String,
}

impl<P: ControlPort> Vendor<P> {
    /// Asks the camera for the length of its blocks. `device` names it in messages.
    ///
    /// # Errors
    /// Those of [`ControlPort::query`]; [`ErrorKind::Protocol`] when the length is neither 384 nor 64.
    pub fn new(mut port: P, device: impl Into<String>) -> Result<Self> {
        let device = device.into();
        let length = port.length(UNIT, SELECTOR)?;
        if !matches!(length, 64 | BLOCK_BYTES) {
            let what = format!(
                "{device}: command blocks of {length} bytes; those of a ZED have 384, or 64 on USB 2"
            );
            return Err(Error::new(ErrorKind::Protocol, what));
        }
        Ok(Self { port, length, device })
    }

    /// Whether the camera is on a USB 2 port, which shows in the length of its blocks.
    pub const fn is_usb2(&self) -> bool {
        self.length < BLOCK_BYTES
    }

    /// Sends `command` and returns its answer from its first byte on; nothing for one that has none.
    ///
    /// # Errors
    /// Those of [`ControlPort::query`].
    pub fn send(&mut self, command: Command) -> Result<Vec<u8>> {
        let mut block = command.block();
        let bytes = &mut block[..self.length];
        self.port.query(UNIT, SELECTOR, Query::SetCur, bytes)?;
        std::thread::sleep(PAUSE);
        if !command.has_answer() {
            return Ok(Vec::new());
        }
        self.port.query(UNIT, SELECTOR, Query::GetCur, bytes)?;
        Ok(bytes[ANSWER..].to_vec())
    }

    fn byte(&mut self, command: Command) -> Result<u8> {
        let answer = self.send(command)?;
        // A block has at least 64 bytes, so there is one.
        Ok(answer.first().copied().unwrap_or_default())
    }

    /// The serial number, from the flash.
    ///
    /// # Errors
    /// Those of [`Self::send`]; [`ErrorKind::Protocol`] when the flash holds none.
    pub fn serial(&mut self) -> Result<String> {
        // As the open code asks on USB 3. A block of USB 2 has room for 47 bytes of answer.
        let length = if self.is_usb2() { 32 } else { 64 };
        let flash = self.send(Command::ReadFlash { address: SERIAL_ADDRESS, length })?;
        parse_serial(&flash)
    }

    /// Whether the bridge regulates exposure and gain of both image sensors.
    ///
    /// # Errors
    /// Those of [`Self::send`].
    pub fn auto_exposure(&mut self) -> Result<bool> {
        let mut both = true;
        for side in Side::BOTH {
            both &= self.byte(Command::ReadSystem { address: isp_control(side) })? & AUTO_EXPOSURE != 0;
        }
        Ok(both)
    }

    /// Turns the bridge's regulation of exposure and gain of both image sensors on or off.
    ///
    /// # Errors
    /// Those of [`Self::send`]; [`ErrorKind::Protocol`] when the camera does not take it.
    pub fn set_auto_exposure(&mut self, on: bool) -> Result<()> {
        for side in Side::BOTH {
            let address = isp_control(side);
            let is = self.byte(Command::ReadSystem { address })?;
            let value = if on { is | AUTO_EXPOSURE } else { is & !AUTO_EXPOSURE };
            self.send(Command::WriteSystem { address, value })?;
        }
        if self.auto_exposure()? == on {
            return Ok(());
        }
        Err(self.refused(format_args!("automatic exposure {}", if on { "on" } else { "off" })))
    }

    /// Exposure of the image sensor on `side` in percent of the longest at this frame rate.
    ///
    /// # Errors
    /// Those of [`Self::send`].
    pub fn exposure(&mut self, side: Side, rate_hz: f64) -> Result<u8> {
        Ok(exposure_percent(self.registers(side, EXPOSURE)? >> 4, rate_hz))
    }

    /// Sets the exposure of the image sensor on `side`, percent of the longest at this frame rate. The regulation must
    /// be off, else it overwrites it.
    ///
    /// # Errors
    /// Those of [`Self::send`]; [`ErrorKind::Protocol`] when the camera does not take it.
    pub fn set_exposure(&mut self, side: Side, percent: u8, rate_hz: f64) -> Result<()> {
        self.set_registers(side, EXPOSURE, raw_exposure(percent, rate_hz) << 4, "exposure")
    }

    /// Gain of the image sensor on `side` in percent; `None` if the camera's value has no percentage.
    ///
    /// # Errors
    /// Those of [`Self::send`].
    pub fn gain(&mut self, side: Side) -> Result<Option<u8>> {
        Ok(gain_percent(self.registers(side, GAIN)?))
    }

    /// Sets the gain of the image sensor on `side`, percent. The regulation must be off.
    ///
    /// # Errors
    /// Those of [`Self::send`]; [`ErrorKind::Protocol`] when the camera does not take it.
    pub fn set_gain(&mut self, side: Side, percent: u8) -> Result<()> {
        self.set_registers(side, GAIN, raw_gain(percent), "gain")
    }

    /// Switches the light on the front.
    ///
    /// # Errors
    /// Those of [`Self::send`].
    pub fn set_led(&mut self, on: bool) -> Result<()> {
        self.send(Command::PinDirection { pin: LED_PIN, output: true })?;
        self.send(Command::SetPin { pin: LED_PIN, high: on }).map(drop)
    }

    fn registers(&mut self, side: Side, addresses: [u16; 3]) -> Result<u32> {
        let mut value = 0;
        for address in addresses {
            value = value << 8 | u32::from(self.byte(Command::ReadSensor { side, address })?);
        }
        Ok(value)
    }

    fn set_registers(&mut self, side: Side, addresses: [u16; 3], value: u32, what: &str) -> Result<()> {
        let [_, high, middle, low] = value.to_be_bytes();
        for (address, value) in addresses.into_iter().zip([high, middle, low]) {
            self.send(Command::WriteSensor { side, address, value })?;
        }
        if self.registers(side, addresses)? == value {
            return Ok(());
        }
        Err(self.refused(format_args!("the {what} of its {side:?} image sensor")))
    }

    fn refused(&self, what: core::fmt::Arguments<'_>) -> Error {
        let text = format!("{}: the camera does not take {what}; read back it is another value", self.device);
        Error::new(ErrorKind::Protocol, text)
    }
}

#[cfg(test)]
mod tests;
