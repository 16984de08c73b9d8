//! Models as data, read from TOML: a camera's USB descriptors, streams and controls.

mod modes;

use crate::{Error, Result, Speed};
pub use modes::{Mode, Size};
use serde::Deserialize;

/// A camera model.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Model {
    /// Its short name: `d435`.
    pub name: String,
    /// Whose firmware answers the vendor's requests.
    pub family: Family,
    /// USB string 1.
    pub manufacturer: String,
    /// USB string 2.
    pub product: String,
    /// USB vendor.
    pub vendor_id: u16,
    /// USB product.
    pub product_id: u16,
    /// `bcdDevice`.
    pub device_version: u16,
    /// The firmware's version, most significant number first.
    #[serde(default)]
    pub firmware: [u8; 4],
    /// Lengths of the probe and commit blocks: 26 (UVC 1.0), 34 (1.1), 48 (1.5). 0 without video.
    #[serde(default)]
    pub probe_length: usize,
    /// `bcdUVC`.
    #[serde(default)]
    pub uvc_version: u16,
    /// Metadata in the payload header after the 12 bytes of the class.
    #[serde(default)]
    pub metadata: Metadata,
    /// Counts per metre are 1e6 divided by this: the depth unit in micrometres.
    #[serde(default)]
    pub depth_unit_um: f32,
    /// The baseline of its stereo pair in millimetres, signed as its tables have it.
    #[serde(default)]
    pub baseline_mm: f32,
    /// From the depth camera to the colour camera, millimetres along x.
    #[serde(default)]
    pub color_offset_mm: f32,
    /// The chip of its IMU, if it has one.
    pub imu: Option<ImuChip>,
    /// Video functions, in the order of their interfaces.
    #[serde(default)]
    pub functions: Vec<Function>,
    /// A HID interface.
    pub hid: Option<Hid>,
    /// A vendor interface with a bulk endpoint each way.
    pub vendor: Option<Vendor>,
    /// Another USB device in the same housing: the name of its model.
    pub companion: Option<String>,
}

/// Whose firmware answers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Family {
    /// RealSense D400.
    D400,
    /// RealSense L515.
    L515,
    /// The video half of a ZED 2i.
    Zed,
    /// The sensor half of a ZED 2i.
    ZedMcu,
    /// Nobody's: a camera of the video class alone.
    Plain,
}

/// The chip of an IMU, which decides its rates.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ImuChip {
    /// Bosch BMI055: acceleration at 62.5 or 250 Hz, rotation at 200 or 400 Hz.
    Bmi055,
    /// Bosch BMI085: both at 100, 200 or 400 Hz.
    Bmi085,
}

/// The vendor's part of the payload header.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Metadata {
    /// Nothing.
    #[default]
    None,
    /// The blocks of the D400.
    D400,
    /// Those of the L515: its timing block and its control block.
    L515,
}

/// A video function: an interface association of one control interface and its streams.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Function {
    /// The number of its control interface; the streams follow.
    pub interface: u8,
    /// The interrupt endpoint of its status, if it has one.
    pub status_endpoint: Option<u8>,
    /// `dwClockFrequency`.
    pub clock_hz: u32,
    /// Terminals and units.
    pub units: Vec<Unit>,
    /// Its streaming interfaces.
    pub streams: Vec<Stream>,
}

/// A terminal or unit of a control interface.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Unit {
    /// Its kind.
    pub kind: UnitKind,
    /// Its id within the function.
    pub id: u8,
    /// The id that feeds it; 0 for a camera.
    #[serde(default)]
    pub source: u8,
    /// Which extension it is: 32 hexadecimal digits as on the wire.
    #[serde(default)]
    pub guid: String,
    /// Its controls.
    #[serde(default)]
    pub controls: Vec<Control>,
}

/// The kinds of terminals and units.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum UnitKind {
    /// A camera terminal.
    Camera,
    /// A processing unit.
    Processing,
    /// An extension unit.
    Extension,
    /// The terminal of a stream.
    Output,
}

/// One control of a unit.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Control {
    /// Its selector.
    pub selector: u8,
    /// The bytes of its value on USB3.
    pub length: usize,
    /// The same on USB2, where that differs.
    pub length_usb2: Option<usize>,
    /// The least value.
    #[serde(default)]
    pub min: i64,
    /// The greatest.
    #[serde(default)]
    pub max: i64,
    /// The step.
    #[serde(default = "one")]
    pub step: i64,
    /// After power-on.
    #[serde(default)]
    pub default: i64,
    /// It cannot be written.
    #[serde(default)]
    pub read_only: bool,
}

fn one() -> i64 {
    1
}

/// One streaming interface.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Stream {
    /// Its name: `depth`, `ir`, `color`.
    pub name: String,
    /// Its interface.
    pub interface: u8,
    /// Its bulk endpoint, direction included.
    pub endpoint: u8,
    /// The output terminal that it hangs on.
    pub terminal: u8,
    /// Formats.
    pub formats: Vec<Format>,
}

/// One pixel format of a stream.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Format {
    /// Its V4L2 name: `Z16 `.
    pub fourcc: String,
    /// The first four bytes of its GUID, eight hexadecimal digits, where they are not those of `fourcc`.
    pub guid: Option<String>,
    /// Bits of a pixel.
    pub bits: u8,
    /// Described by the descriptors of frame-based payloads.
    #[serde(default)]
    pub frame_based: bool,
    /// How images lie in a frame.
    #[serde(default)]
    pub layout: Layout,
    /// Sizes and rates at 5 Gb/s: `640x480@30,15,6`. Empty: the format is not offered.
    #[serde(default)]
    pub usb3: Vec<String>,
    /// The same at 480 Mb/s.
    #[serde(default)]
    pub usb2: Vec<String>,
}

/// How images lie in a frame, which decides where the stamps are.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Layout {
    /// One image.
    #[default]
    Plain,
    /// Two images, byte by byte in turn.
    Interleaved,
    /// Two images of half the width.
    SideBySide,
    /// One image, transposed and flipped, as the L515 sends it.
    Turned,
    /// One JPEG image, with its stamp in a comment.
    Jpeg,
}

/// A HID interface.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Hid {
    /// Its interface.
    pub interface: u8,
    /// Its interrupt endpoint, direction included.
    pub endpoint: u8,
    /// Its report descriptor, hexadecimal; empty for that of an IMU, which follows from the firmware.
    #[serde(default)]
    pub report_descriptor: String,
}

/// A vendor interface.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Vendor {
    /// Its interface.
    pub interface: u8,
    /// Bulk to the device.
    pub out_endpoint: u8,
    /// Bulk to the host, direction included.
    pub in_endpoint: u8,
}

/// The models that come with the emulator.
const BUILT_IN: [(&str, &str); 9] = [
    ("d405", include_str!("../models/d405.toml")),
    ("d415", include_str!("../models/d415.toml")),
    ("d435", include_str!("../models/d435.toml")),
    ("d435i", include_str!("../models/d435i.toml")),
    ("d455", include_str!("../models/d455.toml")),
    ("l515", include_str!("../models/l515.toml")),
    ("uvc", include_str!("../models/uvc.toml")),
    ("zed2i", include_str!("../models/zed2i.toml")),
    ("zed2i-mcu", include_str!("../models/zed2i-mcu.toml")),
];

fn built_in(name: &str) -> Result<&'static str> {
    let found = BUILT_IN.iter().find(|(known, _)| *known == name);
    found.map(|(_, text)| *text).ok_or_else(|| {
        Error::new(format!("there is no model '{name}'; there are {}", Model::names().join(", ")))
    })
}

/// Reads a model's table. With `inherit` it is another model's, with what it has itself put over it; `modes` replaces
/// lists of sizes: `"depth Z16 usb3" = […]`.
fn table(text: &str) -> Result<toml::Table> {
    let mut own: toml::Table =
        toml::from_str(text).map_err(|e| Error::new(format!("not a camera model: {e}")))?;
    let Some(parent) = own.remove("inherit") else { return Ok(own) };
    let parent = parent.as_str().ok_or_else(|| Error::new("inherit is not the name of a model"))?;
    let mut all = table(built_in(parent)?)?;
    let modes = own.remove("modes");
    all.extend(own);
    for (path, sizes) in modes.as_ref().and_then(toml::Value::as_table).into_iter().flatten() {
        let list = size_list(&mut all, path)
            .ok_or_else(|| Error::new(format!("modes: {parent} has no list of sizes '{path}'")))?;
        *list = sizes.clone();
    }
    Ok(all)
}

/// The list of sizes that a path such as `depth Z16 usb3` names.
fn size_list<'a>(model: &'a mut toml::Table, path: &str) -> Option<&'a mut toml::Value> {
    let words: Vec<&str> = path.split_whitespace().collect();
    let [stream, fourcc, speed] = words.as_slice() else { return None };
    let text = |table: &toml::Value, key: &str| table.get(key)?.as_str().map(|s| s.trim().to_owned());
    let functions = model.get_mut("functions")?.as_array_mut()?;
    let streams = functions.iter_mut().filter_map(|f| f.get_mut("streams")?.as_array_mut()).flatten();
    let mut wanted = streams.filter(|s| text(s, "name").as_deref() == Some(stream));
    let formats = wanted.next()?.get_mut("formats")?.as_array_mut()?;
    formats.iter_mut().find(|f| text(f, "fourcc").as_deref() == Some(fourcc))?.get_mut(speed)
}

impl Model {
    /// A model that comes with the emulator.
    ///
    /// # Errors
    /// When the name is unknown.
    pub fn named(name: &str) -> Result<Self> {
        Self::from_toml(built_in(name)?)
    }

    /// The names of the models that come with the emulator.
    pub fn names() -> Vec<&'static str> {
        BUILT_IN.iter().map(|(name, _)| *name).collect()
    }

    /// Reads a model.
    ///
    /// # Errors
    /// When the text is not a model.
    pub fn from_toml(text: &str) -> Result<Self> {
        let model: Self =
            table(text)?.try_into().map_err(|e| Error::new(format!("not a camera model: {e}")))?;
        for stream in model.streams() {
            for format in &stream.formats {
                for text in format.usb3.iter().chain(&format.usb2) {
                    Size::parse(text)?;
                }
                format.guid_bytes()?;
            }
        }
        for function in &model.functions {
            for unit in &function.units {
                from_hex(&unit.guid)?;
            }
        }
        if let Some(hid) = &model.hid {
            from_hex(&hid.report_descriptor)?;
        }
        Ok(model)
    }

    /// Every stream, in the order of their interfaces.
    pub fn streams(&self) -> impl Iterator<Item = &Stream> {
        self.functions.iter().flat_map(|f| &f.streams)
    }

    /// The index of a stream.
    ///
    /// # Errors
    /// When the name is unknown.
    pub fn stream_index(&self, name: &str) -> Result<usize> {
        self.streams().position(|s| s.name == name).ok_or_else(|| {
            let names: Vec<&str> = self.streams().map(|s| s.name.as_str()).collect();
            Error::new(format!("{} has no stream '{name}'; it has {}", self.name, names.join(", ")))
        })
    }
}

impl Format {
    /// The sizes that it has at a speed.
    pub fn sizes(&self, speed: Speed) -> Vec<Size> {
        let texts = if speed == Speed::High { &self.usb2 } else { &self.usb3 };
        texts.iter().filter_map(|text| Size::parse(text).ok()).collect()
    }

    /// Its GUID as on the wire: four bytes that name the format, then those that all have in common.
    ///
    /// # Errors
    /// When the model's text is not a GUID.
    pub fn guid_bytes(&self) -> Result<[u8; 16]> {
        let mut guid = *b"\0\0\0\0\0\0\x10\0\x80\0\0\xAA\x00\x38\x9B\x71";
        let head = match &self.guid {
            Some(text) => from_hex(text)?,
            None => self.fourcc.as_bytes().to_vec(),
        };
        let head: [u8; 4] = head
            .try_into()
            .map_err(|_| Error::new(format!("the format '{}' is not named by four bytes", self.fourcc)))?;
        guid[..4].copy_from_slice(&head);
        Ok(guid)
    }
}

/// Bytes from hexadecimal digits; blanks are ignored.
pub(crate) fn from_hex(text: &str) -> Result<Vec<u8>> {
    let digits: Vec<u32> = text
        .chars()
        .filter(|c| !c.is_whitespace())
        .map(|c| c.to_digit(16))
        .collect::<Option<_>>()
        .ok_or_else(|| Error::new(format!("'{text}' is not hexadecimal")))?;
    if !digits.len().is_multiple_of(2) {
        return Err(Error::new(format!("'{text}' has half a byte too many")));
    }
    Ok(digits.chunks(2).map(|pair| (pair[0] << 4 | pair[1]) as u8).collect())
}
