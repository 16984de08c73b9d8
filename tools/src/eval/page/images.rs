//! Images of the report: the worst of each row, and point clouds.

use super::super::Loaded;
use super::super::read::Metres;
use super::super::records::Header;
use super::super::summary::Row;
use super::super::text::value;
use super::label;
use crate::cloud_image::draw_as;
use anyhow::Result;
use depthrig_bus::{FrameHeader, PixelFormat};
use depthrig_calib::{Deprojection, PointCloud};
use depthrig_recorder::report::page::{END_TABLE, Thumbnail, escape, ramp};
use image::RgbImage;
use std::collections::BTreeMap;
use std::fmt::Write;

/// The error that has the strongest colour, metres.
const STRONG_M: f32 = 0.1;
/// Width of a point cloud, pixels.
const CLOUD: u32 = 480;
/// Rows of worst images in a report, to keep it small.
const ROWS: usize = 24;

/// Makes the images of a report while there is something to make them from.
#[derive(Default)]
pub struct Pictures {
    /// By group, of the image that is the worst of its first row.
    clouds: BTreeMap<String, Clouds>,
}

struct Clouds {
    name: String,
    panels: Vec<(String, String)>,
    /// Reason for their absence.
    why: Option<&'static str>,
}

impl Pictures {
    /// Colour, reference, raw depth, prediction and error of a row of an image, as elements of the page. Where it is the worst
    /// image of the first row of its group, the group's point clouds are of it.
    ///
    /// # Errors
    /// When an image cannot be encoded.
    pub fn of(
        &mut self,
        loaded: &Loaded,
        row: usize,
        is_worst: bool,
        header: &Header,
    ) -> Result<Vec<(&'static str, String)>> {
        if is_worst && loaded.predictions.iter().all(|(k, _)| *k >= row) {
            self.clouds.insert(loaded.group.clone(), clouds(loaded, header)?);
        }
        let Some((_, prediction)) = loaded.predictions.iter().find(|(k, _)| *k == row) else {
            return Ok(Vec::new());
        };
        let truth = depth(&loaded.truth)?;
        let range = Thumbnail::range([&truth].into_iter());
        let mut out = Vec::new();
        if let Some(color) = &loaded.color {
            out.push(("colour", of_rgb(color)?.html(None, "colour")?));
        }
        let bar =
            range.map(|(near, far)| format!("<span class=\"none\">{near:.2} m {} {far:.2} m</span>", ramp()));
        let bar = bar.unwrap_or_default();
        out.push(("reference", truth.html(range, "reference")? + &bar));
        if let Some((_, raw)) = loaded.raw.as_ref().filter(|(k, _)| *k != row) {
            out.push(("raw depth", depth(&raw.metres())?.html(range, "raw depth")?));
        }
        out.push(("prediction", depth(prediction)?.html(range, "prediction")?));
        let error: Vec<u8> =
            prediction.pixels.iter().zip(&loaded.truth.pixels).flat_map(|(p, t)| error(*p, *t)).collect();
        let error = Thumbnail::of(&header_of(PixelFormat::Rgb8, prediction), &error)?;
        out.push(("error", error.html(None, "error")? + &error_bar()));
        Ok(out)
    }

    /// The point clouds of each group.
    pub fn clouds(&self, out: &mut String) {
        if self.clouds.is_empty() {
            return;
        }
        out.push_str("<section><h2>Point clouds</h2>");
        for (group, clouds) in &self.clouds {
            let _ = write!(out, "<p>{} {}</p>", escape(group), escape(&clouds.name));
            if let Some(why) = clouds.why {
                let _ = write!(out, "<p class=\"cap\">{why}</p>");
                continue;
            }
            out.push_str("<div class=\"clouds\">");
            for (name, html) in &clouds.panels {
                let _ = write!(
                    out,
                    "<figure>{html}<figcaption class=\"none\">{}</figcaption></figure>",
                    escape(name)
                );
            }
            out.push_str("</div>");
        }
        out.push_str(
            "<p class=\"cap\">The worst image of each group's first row, seen from the right and above, from one place in all \
             panels of a group.</p></section>",
        );
    }
}

/// The clouds of everything that is known of an image.
fn clouds(loaded: &Loaded, header: &Header) -> Result<Clouds> {
    let none = |why| Clouds { name: loaded.place.name.clone(), panels: Vec::new(), why: Some(why) };
    let Some(lens) = &loaded.lens else {
        return Ok(none(
            "No point clouds: the intrinsics of this image are not known (--intrinsics FX,FY,CX,CY).",
        ));
    };
    let truth = &loaded.truth;
    let Ok(deprojection) = Deprojection::new(lens, (truth.width as u32, truth.height as u32)) else {
        return Ok(none("No point clouds: the intrinsics of this image are not those of a camera."));
    };
    let size = (truth.width as u32, truth.height as u32);
    let color = loaded.color.as_ref().filter(|c| c.dimensions() == size);
    let grey = vec![110; truth.pixels.len() * 3];
    let color = color.map_or(&grey[..], |c| c.as_raw().as_slice());
    let cloud = |m: &Metres| -> Result<PointCloud> {
        let mut cloud = PointCloud::default();
        deprojection.cloud_of_metres(&m.pixels, Some(color), &mut cloud)?;
        Ok(cloud)
    };
    let seen = cloud(truth)?;
    let panel = |name: &str, m: &Metres| -> Result<(String, String)> {
        let drawing = draw_as(&cloud(m)?, &seen);
        let mut h = FrameHeader::default();
        h.set_image(PixelFormat::Rgb8, drawing.width(), drawing.height());
        Ok((name.to_owned(), Thumbnail::of_width(&h, drawing.as_raw(), CLOUD)?.html(None, name)?))
    };
    let mut panels = vec![panel("reference", truth)?];
    for (k, prediction) in &loaded.predictions {
        panels.push(panel(header.rows.get(*k).map_or("", |r| r.name.as_str()), prediction)?);
    }
    Ok(Clouds { name: loaded.place.name.clone(), panels, why: None })
}

fn depth(m: &Metres) -> Result<Thumbnail> {
    let bytes: Vec<u8> = m.pixels.iter().flat_map(|v| v.to_le_bytes()).collect();
    Ok(Thumbnail::of(&header_of(PixelFormat::DepthF32, m), &bytes)?)
}

fn of_rgb(image: &RgbImage) -> Result<Thumbnail> {
    let mut h = FrameHeader::default();
    h.set_image(PixelFormat::Rgb8, image.width(), image.height());
    Ok(Thumbnail::of(&h, image.as_raw())?)
}

fn header_of(format: PixelFormat, m: &Metres) -> FrameHeader {
    let mut header = FrameHeader::default();
    header.set_image(format, m.width as u32, m.height as u32);
    header
}

/// Colour of an error: red is too far, blue too near, white correct; dark grey means no prediction, black no reference.
fn error(seen: f32, truth: f32) -> [u8; 3] {
    if !(truth.is_finite() && truth > 0.0) {
        return [0; 3];
    }
    if !(seen.is_finite() && seen > 0.0) {
        return [90; 3];
    }
    signed(seen - truth)
}

fn signed(error_m: f32) -> [u8; 3] {
    let e = (error_m / STRONG_M).clamp(-1.0, 1.0);
    let pale = (255.0 * (1.0 - e.abs())).round() as u8;
    if e > 0.0 { [255, pale, pale] } else { [pale, pale, 255] }
}

/// The colours of errors with their metres.
fn error_bar() -> String {
    let stops: Vec<String> = [-STRONG_M, 0.0, STRONG_M]
        .map(|e| format!("rgb({})", signed(e).map(|v| v.to_string()).join(",")))
        .to_vec();
    format!(
        "<span class=\"none\">−{STRONG_M} m <span class=\"ramp\" style=\"background:linear-gradient(90deg,{})\"></span> \
         +{STRONG_M} m</span>",
        stops.join(",")
    )
}

/// The worst images of each row.
pub fn worst(out: &mut String, rows: &[Row]) {
    let each = (ROWS / rows.len().max(1)).max(1);
    let shown = || rows.iter().flat_map(|r| r.worst.iter().take(each).map(move |w| (r, w)));
    if shown().all(|(_, w)| w.html.is_empty()) {
        out.push_str("<section><h2>Worst images</h2><p class=\"cap\">They were measured in other runs; the table of each \
                      --json has their names.</p></section>");
        return;
    }
    out.push_str("<section><h2>Worst images</h2><div class=\"wide\"><table class=\"images\"><tbody>");
    for (r, w) in shown() {
        let _ = write!(
            out,
            "<tr><th>{}<br/><span class=\"none\">{}<br/>strict L1 {} m</span></th>",
            escape(&label(r)),
            escape(&w.name),
            value(w.strict_l1_m)
        );
        for (what, html) in &w.html {
            let _ = write!(out, "<td>{html}<br/><span class=\"none\">{what}</span></td>");
        }
        out.push_str("</tr>");
    }
    out.push_str(END_TABLE);
    let _ = write!(
        out,
        "<p class=\"cap\">Depth in colours, near is light, in the range of the reference; black means no depth. Error: red is too \
         far, blue too near, strongest from {STRONG_M} m on; white is correct, grey means no prediction, black no reference.</p>\
         </section>"
    );
}
