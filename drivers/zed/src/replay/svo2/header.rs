//! The message `svo_header`: JSON with 128 bytes in base64.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use depthrig_driver::bytes::u32_at;
use depthrig_driver::{Error, ErrorKind, Result};
use serde_json::Value;

/// Fields of the header, as far as their meaning is known.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Header {
    /// Pixels per row of the side-by-side image; of one half in some files.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Serial number; 0 if the file has none.
    pub serial: u32,
    /// Pairs a second.
    pub rate_hz: u32,
    /// The number at 0x14, which goes with the compression.
    pub code: u32,
    /// Version of the SDK that wrote the file.
    pub sdk: String,
    /// The JSON says that the file is encrypted.
    pub encrypted: bool,
}

impl Header {
    /// Reads the message.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] when it is not JSON with those 128 bytes.
    pub fn parse(json: &[u8]) -> Result<Self> {
        let bad = |what: String| {
            Error::new(
                ErrorKind::BadInput,
                format!("its svo_header {what}; the file is damaged, or not an SVO2 file"),
            )
        };
        let value: Value = serde_json::from_slice(json)
            .map_err(|e| bad(format!("is not valid JSON ({e})")).with_source(e))?;
        let Value::Object(map) = &value else { return Err(bad("is not a JSON object".to_owned())) };
        // Names are spelt in different ways by different SDKs.
        let find = |name: &str| map.iter().find(|(k, _)| k.eq_ignore_ascii_case(name)).map(|(_, v)| v);
        let encrypted = map.iter().any(|(k, v)| k.to_ascii_lowercase().contains("encrypt") && is_true(v));
        let sdk = find("zed_sdk_version").and_then(Value::as_str).unwrap_or("unknown").to_owned();
        let Some(text) = find("header").and_then(Value::as_str) else {
            if encrypted {
                return Ok(Self { sdk, encrypted, ..Self::default() });
            }
            return Err(bad("has no \"header\"".to_owned()));
        };
        let bytes = STANDARD
            .decode(text.trim())
            .map_err(|e| bad(format!("has a \"header\" that is not base64 ({e})")))?;
        let at = |i| u32_at(&bytes, i);
        let (Some(width), Some(height), Some(serial), Some(rate_hz), Some(code)) =
            (at(0), at(4), at(8), at(0xC), at(0x14))
        else {
            return Err(bad(format!("has a \"header\" of {} bytes, not of 128", bytes.len())));
        };
        Ok(Self { width, height, serial, rate_hz, code, sdk, encrypted })
    }

    /// Whether side-by-side images of this size match the header.
    pub const fn fits(&self, width: u32, height: u32) -> bool {
        self.height == height && (self.width == width || self.width.saturating_mul(2) == width)
    }

    /// The serial number as it is written on the camera.
    pub fn serial(&self) -> Option<String> {
        (self.serial != 0).then(|| self.serial.to_string())
    }

    /// For a message about images that are not understood.
    pub fn describe(&self) -> String {
        format!("SDK {}, compression code {}", self.sdk, self.code)
    }
}

fn is_true(value: &Value) -> bool {
    match value {
        Value::Bool(b) => *b,
        Value::Number(n) => n.as_f64() != Some(0.0),
        Value::String(s) => !matches!(s.to_ascii_lowercase().as_str(), "" | "0" | "false" | "no" | "none"),
        Value::Null => false,
        Value::Array(a) => !a.is_empty(),
        Value::Object(o) => !o.is_empty(),
    }
}
