//! What pages are made of, for every report that is one: head and look, tables, and pictures that lie in the page.
//!
//! A page needs no script, no network and no other file, is well-formed XML, and reads well dark and on paper.

use super::markup::CSS;
use super::pixels::{self, Picture, Small};
use crate::Result;
use depthrig_bus::FrameHeader;

pub use super::markup::{END_TABLE, escape, row, table};
pub use super::svg::{nice_end, nice_step, number};

/// The beginning of a page of this title, which is text.
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

/// The end of a page.
pub fn end(out: &mut String) {
    out.push_str("</body></html>\n");
}

/// A small copy of a picture, to be shown in a page.
pub struct Thumbnail(Small);

impl Thumbnail {
    /// Of the picture that `header` describes: its format, size, stride and depth unit are read.
    ///
    /// # Errors
    /// [`crate::ErrorKind::Codec`] when the pixels are not such a picture.
    pub fn of(header: &FrameHeader, pixels: &[u8]) -> Result<Self> {
        Ok(Self(Picture::new(header, pixels)?.small()))
    }

    /// The range of metres that shows most of some depth pictures; `None` when there is no depth.
    pub fn range<'a>(of: impl Iterator<Item = &'a Self>) -> Option<(f32, f32)> {
        pixels::depth_range(of.map(|t| &t.0))
    }

    /// As an element of a page. Depth is shown in colours from `range_m`: near is light, none is black.
    ///
    /// # Errors
    /// [`crate::ErrorKind::Codec`] when it cannot be packed.
    pub fn html(&self, range_m: Option<(f32, f32)>, name: &str) -> Result<String> {
        let ((w, h), uri) = (self.0.size(), self.0.data_uri(range_m)?);
        let name = escape(name);
        Ok(format!("<img width=\"{w}\" height=\"{h}\" alt=\"{name}\" title=\"{name}\" src=\"{uri}\"/>"))
    }
}
