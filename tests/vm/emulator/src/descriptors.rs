//! The USB descriptors of a model: device, configuration, binary object store, strings.
//!
//! Layouts: USB 3.2 chapter 9; UVC 1.5 class specification, chapter 3 and its payload documents.

use crate::firmware::imu::report_descriptor;
use crate::model::{Control, Format, Function, Layout, Model, Stream, Unit, UnitKind, from_hex};
use crate::{Result, Speed};

const CS_INTERFACE: u8 = 0x24;

/// Bytes in the making.
#[derive(Default)]
struct Bytes(Vec<u8>);

impl Bytes {
    fn u8(mut self, values: &[u8]) -> Self {
        self.0.extend_from_slice(values);
        self
    }

    fn u16(mut self, value: u16) -> Self {
        self.0.extend_from_slice(&value.to_le_bytes());
        self
    }

    fn u32(mut self, value: u32) -> Self {
        self.0.extend_from_slice(&value.to_le_bytes());
        self
    }

    /// Itself with its length in front, as every descriptor begins.
    fn sized(self) -> Vec<u8> {
        let mut all = vec![(self.0.len() + 1) as u8];
        all.extend(self.0);
        all
    }
}

/// The device descriptor. Strings: 1 manufacturer, 2 product, 3 serial.
pub(crate) fn device(model: &Model, speed: Speed) -> Vec<u8> {
    let (usb, packet) = if speed == Speed::Super { (0x0320, 9) } else { (0x0210, 64) };
    let class: [u8; 3] = if model.functions.is_empty() { [0, 0, 0] } else { [0xEF, 2, 1] };
    let head = Bytes::default().u8(&[1]).u16(usb).u8(&class).u8(&[packet]);
    head.u16(model.vendor_id).u16(model.product_id).u16(model.device_version).u8(&[1, 2, 3, 1]).sized()
}

/// The configuration with everything in it.
///
/// # Errors
/// When the model's texts are no bytes; [`Model::from_toml`] has seen to that.
pub(crate) fn configuration(model: &Model, speed: Speed) -> Result<Vec<u8>> {
    let mut body = Vec::new();
    let mut interfaces = 0;
    for function in &model.functions {
        let count = 1 + function.streams.len() as u8;
        interfaces += count;
        body.extend(Bytes::default().u8(&[11, function.interface, count, 0x0E, 3, 0, 0]).sized());
        body.extend(control_interface(model, function, speed)?);
        for stream in &function.streams {
            body.extend(streaming_interface(stream, speed)?);
        }
    }
    if let Some(hid) = &model.hid {
        interfaces += 1;
        let report = report_descriptor(model)?;
        body.extend([9, 4, hid.interface, 0, 1, 3, 0, 0, 0]);
        let head = Bytes::default().u8(&[0x21]).u16(0x0111).u8(&[0, 1, 0x22]).u16(report.len() as u16);
        body.extend(head.sized());
        body.extend(endpoint(hid.endpoint, 3, 64, if speed == Speed::Super { 5 } else { 4 }, speed, 64));
    }
    if let Some(vendor) = &model.vendor {
        interfaces += 1;
        body.extend([9, 4, vendor.interface, 0, 2, 0xFF, 0, 0, 0]);
        body.extend(endpoint(vendor.out_endpoint, 2, bulk_packet(speed), 0, speed, 0));
        body.extend(endpoint(vendor.in_endpoint, 2, bulk_packet(speed), 0, speed, 0));
    }
    // Self-powered; the unit of the current is 8 mA on USB3 and 2 mA on USB2, so this is 440 mA or 110 mA.
    let head = Bytes::default().u8(&[2]).u16(9 + body.len() as u16).u8(&[interfaces, 1, 0, 0xC0, 55]);
    let mut all = head.sized();
    all.extend(body);
    Ok(all)
}

fn bulk_packet(speed: Speed) -> u16 {
    if speed == Speed::Super { 1024 } else { 512 }
}

/// An endpoint, with its SuperSpeed companion. `attributes` 2 is bulk, 3 interrupt.
fn endpoint(
    address: u8,
    attributes: u8,
    packet: u16,
    interval: u8,
    speed: Speed,
    per_interval: u16,
) -> Vec<u8> {
    let mut bytes = Bytes::default().u8(&[5, address, attributes]).u16(packet).u8(&[interval]).sized();
    if speed == Speed::Super {
        let burst = if attributes == 2 { 15 } else { 0 };
        bytes.extend(Bytes::default().u8(&[0x30, burst, 0]).u16(per_interval).sized());
    }
    bytes
}

fn control_interface(model: &Model, function: &Function, speed: Speed) -> Result<Vec<u8>> {
    let mut units = Vec::new();
    for unit in &function.units {
        units.extend(unit_descriptor(unit)?);
    }
    let count = function.streams.len() as u8;
    let header = 12 + count;
    let endpoints = function.status_endpoint.is_some().into();
    let mut bytes = vec![9, 4, function.interface, 0, endpoints, 0x0E, 1, 0, 0];
    let head = Bytes::default().u8(&[CS_INTERFACE, 1]).u16(model.uvc_version);
    let head = head.u16(u16::from(header) + units.len() as u16).u32(function.clock_hz).u8(&[count]);
    let numbers: Vec<u8> = function.streams.iter().map(|s| s.interface).collect();
    bytes.extend(head.u8(&numbers).sized());
    bytes.extend(units);
    if let Some(address) = function.status_endpoint {
        bytes.extend(endpoint(address, 3, 64, 8, speed, 64));
        bytes.extend(Bytes::default().u8(&[0x25, 3]).u16(64).sized());
    }
    Ok(bytes)
}

fn unit_descriptor(unit: &Unit) -> Result<Vec<u8>> {
    let bits = |bit_of: fn(u8) -> u32| {
        unit.controls.iter().fold(0u32, |bits, control| bits | 1 << bit_of(control.selector)).to_le_bytes()
    };
    let head = |subtype: u8| Bytes::default().u8(&[CS_INTERFACE, subtype, unit.id]);
    Ok(match unit.kind {
        UnitKind::Camera => {
            let bits = bits(camera_bit);
            head(2).u16(0x0201).u8(&[0, 0]).u16(0).u16(0).u16(0).u8(&[3, bits[0], bits[1], bits[2]]).sized()
        }
        UnitKind::Processing => {
            let bits = bits(processing_bit);
            head(5).u8(&[unit.source]).u16(0).u8(&[3, bits[0], bits[1], bits[2], 0, 0]).sized()
        }
        UnitKind::Extension => {
            let bits = bits(|selector| u32::from(selector) - 1);
            let guid = from_hex(&unit.guid)?;
            let count = unit.controls.len() as u8;
            head(6).u8(&guid).u8(&[count, 1, unit.source, 4]).u8(&bits).u8(&[0]).sized()
        }
        UnitKind::Output => head(3).u16(0x0101).u8(&[0, unit.source, 0]).sized(),
    })
}

/// Which bit of a camera terminal's controls a selector has (UVC 1.5, table 3-6 and A-12).
fn camera_bit(selector: u8) -> u32 {
    u32::from(selector.saturating_sub(1)).min(23)
}

/// Which bit of a processing unit's controls a selector has (UVC 1.5, table 3-8 and A-13).
fn processing_bit(selector: u8) -> u32 {
    match selector {
        0x01 => 8,  // backlight compensation
        0x02 => 0,  // brightness
        0x03 => 1,  // contrast
        0x04 => 9,  // gain
        0x05 => 10, // power line frequency
        0x06 => 2,  // hue
        0x07 => 3,  // saturation
        0x08 => 4,  // sharpness
        0x09 => 5,  // gamma
        0x0A => 6,  // white balance temperature
        0x0B => 12, // the same, automatic
        _ => 23,
    }
}

fn streaming_interface(stream: &Stream, speed: Speed) -> Result<Vec<u8>> {
    let formats = offered(stream, speed);
    let mut body = Vec::new();
    for (index, format) in formats.iter().enumerate() {
        body.extend(format_descriptors(format, index as u8 + 1, speed)?);
    }
    let count = formats.len() as u8;
    let length = 13 + count;
    let mut bytes = vec![9, 4, stream.interface, 0, 1, 0x0E, 2, 0, 0];
    let head = Bytes::default().u8(&[CS_INTERFACE, 1, count]).u16(u16::from(length) + body.len() as u16);
    let head = head.u8(&[stream.endpoint, 0, stream.terminal, 0, 0, 0, 1]);
    bytes.extend(head.u8(&vec![0; formats.len()]).sized());
    bytes.extend(body);
    bytes.extend(endpoint(stream.endpoint, 2, bulk_packet(speed), 0, speed, 0));
    Ok(bytes)
}

/// The formats of a stream that have any mode at a speed, in the order of their index (from 1).
pub(crate) fn offered(stream: &Stream, speed: Speed) -> Vec<&Format> {
    stream.formats.iter().filter(|f| !f.sizes(speed).is_empty()).collect()
}

fn format_descriptors(format: &Format, index: u8, speed: Speed) -> Result<Vec<u8>> {
    let sizes = format.sizes(speed);
    let jpeg = format.layout == Layout::Jpeg;
    let subtype = match (jpeg, format.frame_based) {
        (true, _) => 0x06,
        (false, true) => 0x10,
        (false, false) => 0x04,
    };
    let head = Bytes::default().u8(&[CS_INTERFACE, subtype, index, sizes.len() as u8]);
    // Motion JPEG has a descriptor of its own in place of an identifier; its images differ in size.
    let head = if jpeg { head.u8(&[0]) } else { head.u8(&format.guid_bytes()?).u8(&[format.bits]) };
    let head = head.u8(&[1, 0, 0, 0, 0]);
    // Frame-based payloads end with bVariableSize: 0, every frame has the same size.
    let mut bytes = if format.frame_based { head.u8(&[0]).sized() } else { head.sized() };
    for (at, size) in sizes.iter().enumerate() {
        let row = u32::from(size.width) * u32::from(format.bits) / 8;
        let frame = row * u32::from(size.height);
        let rates = || size.rates.iter().copied();
        let least = rates().min().unwrap_or(1);
        let most = rates().max().unwrap_or(1);
        let intervals: Vec<u32> = size.intervals().collect();
        let first = intervals.first().copied().unwrap_or(0);
        let head = Bytes::default().u8(&[CS_INTERFACE, subtype + 1, at as u8 + 1, 0]);
        let head = head.u16(size.width).u16(size.height);
        let head = head.u32(frame.saturating_mul(8 * least)).u32(frame.saturating_mul(8 * most));
        let count = intervals.len() as u8;
        let head = if format.frame_based {
            head.u32(first).u8(&[count]).u32(row)
        } else {
            head.u32(frame).u32(first).u8(&[count])
        };
        bytes.extend(intervals.iter().fold(head, |head, interval| head.u32(*interval)).sized());
    }
    // A colour matching descriptor ends an uncompressed format: BT.709, BT.709, SMPTE 170M.
    if !format.frame_based {
        bytes.extend([6, CS_INTERFACE, 0x0D, 1, 1, 4]);
    }
    Ok(bytes)
}

/// The binary object store: USB 2.0 extension and SuperSpeed capability.
pub(crate) fn object_store() -> Vec<u8> {
    vec![5, 15, 22, 0, 2, 7, 16, 2, 2, 0, 0, 0, 10, 16, 3, 0, 0x0E, 0, 1, 10, 0xFF, 7]
}

/// A string descriptor.
pub(crate) fn string(text: &str) -> Vec<u8> {
    let utf16: Vec<u8> = text.encode_utf16().take(126).flat_map(u16::to_le_bytes).collect();
    Bytes::default().u8(&[3]).u8(&utf16).sized()
}

/// The length of a control's value at a speed.
pub(crate) fn control_length(control: &Control, speed: Speed) -> usize {
    match control.length_usb2 {
        Some(length) if speed == Speed::High => length,
        _ => control.length,
    }
}
