//! The facts that a recording states about itself in its tracks, tags and attachments.

use super::head::Parts;
use super::{Facts, Pixels, Track, TrackKind};
use crate::ebml::{self, id};
use crate::modes::{ColorMode, DepthMode, WiredSync};
use depthrig_driver::bytes::{i32_at, u32_at};
use depthrig_driver::{Error, ErrorKind, Result};

/// 2001-01-01T00:00:00Z, from which Matroska counts, in nanoseconds since 1970.
const EPOCH_NS: i64 = 978_307_200_000_000_000;
/// The longest delays and offsets that are believed: 400 days.
const MAX_NS: u64 = 400 * 86_400 * 1_000_000_000;
/// Sides of images that are believed.
const SIDES: core::ops::RangeInclusive<u32> = 2..=8192;

/// A tag with what it is about.
struct Tag {
    name: String,
    value: String,
    track_uid: Option<u64>,
    attachment_uid: Option<u64>,
}

/// See [`Facts`].
pub(super) fn facts(parts: &Parts, name: &str) -> Result<Facts> {
    let bad = |what: String| Error::new(ErrorKind::BadInput, format!("{name}: {what}"));
    let tags = tags(&parts.tags);
    let mut tracks: Vec<Track> = ebml::children(&parts.tracks)
        .filter(|c| c.0 == id::TRACK_ENTRY)
        .filter_map(|(_, entry)| track(entry, &tags).transpose())
        .collect::<core::result::Result<_, String>>()
        .map_err(bad)?;
    if !tags.iter().any(|t| t.name.starts_with("K4A_")) {
        let called = |t: &Track| match t.name.as_str() {
            "" => "one without a name".to_owned(),
            name => format!("\"{name}\""),
        };
        let names: Vec<_> = tracks.iter().map(called).collect();
        return Err(bad(format!(
            "a Matroska file, but no recording of an Azure Kinect: it has no tags K4A_…; its tracks are {}",
            if names.is_empty() { "none".to_owned() } else { names.join(", ") }
        )));
    }
    // A second track of a kind is not the SDK's.
    for i in 0..tracks.len() {
        let kind = tracks.get(i).map(|t| t.kind);
        let is_second = tracks.iter().take(i).any(|t| Some(t.kind) == kind);
        if let Some(t) = tracks.get_mut(i).filter(|_| is_second) {
            t.kind = TrackKind::Other;
        }
    }
    let of = |kind| tracks.iter().find(|t| t.kind == kind);
    let color = of(TrackKind::Color);
    let depth = of(TrackKind::Depth);
    let infrared = of(TrackKind::Infrared);
    if color.is_none() && depth.is_none() && infrared.is_none() {
        return Err(bad("no track COLOR, DEPTH or IR: there are no images in it".to_owned()));
    }
    let value = |wanted: &str| tags.iter().find(|t| t.name == wanted).map(|t| t.value.trim());
    let depth_mode = depth_mode(value("K4A_DEPTH_MODE"), depth, infrared).map_err(bad)?;
    let color_mode = value("K4A_COLOR_MODE").and_then(ColorMode::from_tag);
    let number = |wanted: &str| -> Result<i64> {
        let Some(text) = value(wanted) else { return Ok(0) };
        let n = text.parse::<i64>().ok().filter(|n| n.unsigned_abs() <= MAX_NS);
        n.ok_or_else(|| bad(format!("the tag {wanted} = \"{text}\" is not a number of nanoseconds")))
    };
    let positive = |wanted: &str| -> Result<u64> {
        u64::try_from(number(wanted)?).map_err(|_| bad(format!("the tag {wanted} is negative")))
    };
    let wired_sync = match value("K4A_WIRED_SYNC_MODE") {
        None => WiredSync::Standalone,
        Some(text) => WiredSync::from_name(text)
            .ok_or_else(|| bad(format!("the tag K4A_WIRED_SYNC_MODE = \"{text}\" is unknown")))?,
    };
    let text = |wanted: &str| value(wanted).unwrap_or_default().to_owned();
    let duration = ebml::child(&parts.info, id::DURATION).and_then(ebml::float).filter(|_| !parts.is_cut);
    let scale_ns = ebml::child_uint(&parts.info, id::TIMESTAMP_SCALE).unwrap_or(1_000_000);
    let date = ebml::child_uint(&parts.info, id::DATE_UTC).map(|since| since as i64);
    Ok(Facts {
        serial: text("K4A_DEVICE_SERIAL_NUMBER"),
        color_firmware: text("K4A_COLOR_FIRMWARE_VERSION"),
        depth_firmware: text("K4A_DEPTH_FIRMWARE_VERSION"),
        written_by: ebml::child_text(&parts.info, id::WRITING_APP).unwrap_or_default(),
        date_utc_ns: date.filter(|since| *since != 0).map(|since| EPOCH_NS.saturating_add(since)),
        depth_mode,
        color_mode,
        wired_sync,
        depth_delay_ns: number("K4A_DEPTH_DELAY_NS")?,
        subordinate_delay_ns: positive("K4A_SUBORDINATE_DELAY_NS")?,
        start_offset_ns: positive("K4A_START_OFFSET_NS")?,
        duration_ns: duration
            .map(|d| d * scale_ns as f64)
            .filter(|d| *d > 0.0 && *d <= MAX_NS as f64)
            .map(|d| d as u64),
        calibration: calibration(&parts.attachments, &tags),
        tracks,
        is_cut: parts.is_cut,
    })
}

/// The tags of a recording: a `SimpleTag` each, and what its `Tag` targets.
fn tags(body: &[u8]) -> Vec<Tag> {
    let mut tags = Vec::new();
    for (_, tag) in ebml::children(body).filter(|c| c.0 == id::TAG) {
        let targets = ebml::child(tag, id::TARGETS).unwrap_or_default();
        for (_, simple) in ebml::children(tag).filter(|c| c.0 == id::SIMPLE_TAG) {
            tags.push(Tag {
                name: ebml::child_text(simple, id::TAG_NAME).unwrap_or_default(),
                value: ebml::child_text(simple, id::TAG_STRING).unwrap_or_default(),
                track_uid: ebml::child_uint(targets, id::TAG_TRACK_UID),
                attachment_uid: ebml::child_uint(targets, id::TAG_ATTACHMENT_UID),
            });
        }
    }
    tags
}

/// Which tags and which names say what a track holds. `DEPTH_IR` is infrared in early recordings.
const KINDS: [(TrackKind, &str, &[&str]); 4] = [
    (TrackKind::Color, "K4A_COLOR_TRACK", &["COLOR"]),
    (TrackKind::Depth, "K4A_DEPTH_TRACK", &["DEPTH"]),
    (TrackKind::Infrared, "K4A_IR_TRACK", &["IR", "DEPTH_IR"]),
    (TrackKind::Motion, "K4A_IMU_TRACK", &["IMU"]),
];

/// One track; `None` when it has no number, which blocks could not refer to.
fn track(entry: &[u8], tags: &[Tag]) -> core::result::Result<Option<Track>, String> {
    let Some(number) = ebml::child_uint(entry, id::TRACK_NUMBER).filter(|n| *n > 0) else { return Ok(None) };
    let uid = ebml::child_uint(entry, id::TRACK_UID).unwrap_or(0);
    let name = ebml::child_text(entry, id::TRACK_NAME).unwrap_or_default();
    // The tag is the surer sign: a user may name a track of their own as they like.
    let tagged = |tag: &str| {
        let found = tags.iter().find(|t| t.name == tag)?;
        found.track_uid.filter(|uid| *uid != 0).or_else(|| found.value.trim().parse().ok())
    };
    let kind = KINDS.iter().find(|(_, tag, _)| uid != 0 && tagged(tag) == Some(uid));
    let kind = kind.or_else(|| {
        KINDS.iter().find(|(_, tag, names)| tagged(tag).is_none() && names.contains(&name.as_str()))
    });
    let kind = kind.map_or(TrackKind::Other, |k| k.0);
    let period_ns =
        ebml::child_uint(entry, id::DEFAULT_DURATION).filter(|ns| (1_000_000..=10_000_000_000).contains(ns));
    let mut track = Track { number, uid, name, kind, pixels: None, width: 0, height: 0, period_ns };
    if matches!(kind, TrackKind::Color | TrackKind::Depth | TrackKind::Infrared) {
        images(entry, &mut track)?;
    }
    Ok(Some(track))
}

/// Reads how images are stored: a Windows bitmap header, whose four characters say the format.
fn images(entry: &[u8], track: &mut Track) -> core::result::Result<(), String> {
    let name = &track.name;
    let codec = ebml::child_text(entry, id::CODEC_ID).unwrap_or_default();
    if codec != "V_MS/VFW/FOURCC" {
        return Err(format!(
            "the track {name} is stored as \"{codec}\", which Azure Kinect recordings do not use"
        ));
    }
    let header = ebml::child(entry, id::CODEC_PRIVATE).unwrap_or_default();
    let fields = (|| Some((i32_at(header, 4)?, i32_at(header, 8)?, u32_at(header, 16)?)))();
    let Some((width, height, format)) =
        fields.filter(|_| u32_at(header, 0) == Some(40) && header.len() >= 40)
    else {
        return Err(format!("the track {name} has no bitmap header of 40 bytes"));
    };
    let sides = [width, height].map(|side| u32::try_from(side).ok().filter(|side| SIDES.contains(side)));
    let [Some(width), Some(height)] = sides else {
        return Err(format!("the track {name} states images of {width}x{height} pixels"));
    };
    let is_color = track.kind == TrackKind::Color;
    let pixels = match (&format.to_le_bytes(), is_color) {
        (b"MJPG", true) => Pixels::Mjpg,
        (b"NV12", true) => Pixels::Nv12,
        (b"YUY2", true) => Pixels::Yuy2,
        (b"BGRA", true) => Pixels::Bgra,
        (b"b16g", false) => Pixels::Gray16Be,
        (b"YUY2", false) => Pixels::Gray16Le,
        (other, _) => {
            let other = String::from_utf8_lossy(other).escape_debug().to_string();
            return Err(format!(
                "the images of the track {name} are stored as \"{other}\", which Azure Kinect recordings do not use"
            ));
        }
    };
    if matches!(pixels, Pixels::Nv12 | Pixels::Yuy2)
        && (!width.is_multiple_of(2) || !height.is_multiple_of(2))
    {
        return Err(format!("the track {name} has {width}x{height} pixels; its format needs even numbers"));
    }
    (track.pixels, track.width, track.height) = (Some(pixels), width, height);
    Ok(())
}

/// The mode of the depth camera, which must be that of its images. Without a tag it follows from their size.
fn depth_mode(
    tag: Option<&str>,
    depth: Option<&Track>,
    infrared: Option<&Track>,
) -> core::result::Result<Option<DepthMode>, String> {
    let Some(images) = depth.or(infrared) else { return Ok(None) };
    let size = (images.width, images.height);
    if let Some(other) = infrared.filter(|t| (t.width, t.height) != size) {
        let (width, height) = size;
        return Err(format!(
            "depth has {width}x{height} pixels and infrared {}x{}",
            other.width, other.height
        ));
    }
    let fits = |m: &DepthMode| m.size() == size && m.has_depth() == depth.is_some();
    let mode = match tag {
        Some(tag) => DepthMode::from_name(tag).filter(|m| m.size() == size),
        None => DepthMode::ALL.into_iter().find(fits),
    };
    mode.map(Some).ok_or_else(|| {
        let (width, height) = size;
        let tag = tag.unwrap_or("missing");
        format!("the tag K4A_DEPTH_MODE is \"{tag}\", which does not fit images of {width}x{height} pixels")
    })
}

/// The attached calibration: the one that a tag targets, else the one of that name.
fn calibration(attachments: &[u8], tags: &[Tag]) -> Option<Vec<u8>> {
    let uid = tags.iter().find(|t| t.name == "K4A_CALIBRATION_FILE").and_then(|t| t.attachment_uid);
    let files = || ebml::children(attachments).filter(|c| c.0 == id::ATTACHED_FILE).map(|c| c.1);
    let by_uid = files().find(|f| uid.is_some() && ebml::child_uint(f, id::FILE_UID) == uid);
    let by_name =
        || files().find(|f| ebml::child_text(f, id::FILE_NAME).as_deref() == Some("calibration.json"));
    by_uid.or_else(by_name).and_then(|f| ebml::child(f, id::FILE_DATA)).map(<[u8]>::to_vec)
}
