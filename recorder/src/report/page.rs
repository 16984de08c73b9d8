//! Building blocks of every HTML report: head and style, tables, and images embedded in the file.
//!
//! A report needs no script, no network and no other file, is well-formed XML, and reads well in dark mode and on
//! paper.

use super::markup::CSS;
use super::pixels::{self, Image, Small};
use crate::Result;
use depthrig_bus::FrameHeader;

pub use super::markup::{END_TABLE, escape, row, table};
pub use super::svg::{nice_end, nice_step, number};

/// The beginning of an HTML report with this title, which is text.
pub fn begin(title: &str) -> String {
    let mut out = String::with_capacity(1 << 19);
    out.push_str(
        "<!DOCTYPE html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"/>\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\"/>\
         <meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; img-src data:; style-src \
         'unsafe-inline'\"/><title>",
    );
    out.push_str(&escape(title));
    out.push_str("</title><style>");
    out.push_str(CSS);
    out.push_str("</style></head><body>");
    out
}

/// The end of an HTML report.
pub fn end(out: &mut String) {
    out.push_str("</body></html>\n");
}

/// The colours that depth is shown in, from near to far, as an HTML element.
pub fn ramp() -> String {
    pixels::ramp()
}

/// A small copy of an image, to embed in a report.
pub struct Thumbnail(Small);

impl Thumbnail {
    /// Of the image that `header` describes: its format, size, stride and depth unit are read.
    ///
    /// # Errors
    /// [`crate::ErrorKind::Codec`] when the pixels are not such an image.
    pub fn of(header: &FrameHeader, pixels: &[u8]) -> Result<Self> {
        Ok(Self(Image::new(header, pixels)?.small()))
    }

    /// The same with at most `width` pixels per row.
    ///
    /// # Errors
    /// As [`Thumbnail::of`].
    pub fn of_width(header: &FrameHeader, pixels: &[u8], width: u32) -> Result<Self> {
        Ok(Self(Image::new(header, pixels)?.small_of(width)))
    }

    /// The range of metres that shows most of some depth images; `None` without depth.
    pub fn range<'a>(of: impl Iterator<Item = &'a Self>) -> Option<(f32, f32)> {
        pixels::depth_range(of.map(|t| &t.0))
    }

    /// As an HTML element. Depth is shown in colours from `range_m`: near is light, missing is black.
    ///
    /// # Errors
    /// [`crate::ErrorKind::Codec`] when it cannot be packed.
    pub fn html(&self, range_m: Option<(f32, f32)>, name: &str) -> Result<String> {
        let (w, h) = self.0.size();
        let uri = self.0.data_uri(range_m)?;
        let name = escape(name);
        Ok(format!("<img width=\"{w}\" height=\"{h}\" alt=\"{name}\" title=\"{name}\" src=\"{uri}\"/>"))
    }
}
