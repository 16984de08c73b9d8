//! Datasets as ByteCameraDepth folders.

use super::calibration::{Calibration, StreamFacts};
use super::rows::{Row, head};
use super::{CALIBRATION_FILE, FORMAT, FRAMES_FILE, names};
use crate::{Exporter, Output, Part, PartOut, PartSets, Parts, Plan, Source};
use depthrig_bus::{FrameHeader, PixelFormat};
use depthrig_recorder::still::{StillFormat, encode, still, tight};
use depthrig_recorder::{DatasetFrame, DatasetSet, Error, ErrorKind, PixelMode, Result, Session};
use serde_json::{Value, json};
use std::borrow::Cow;
use std::collections::BTreeSet;
use time::OffsetDateTime;

/// How cameras are spelled in the names of folders.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum CameraNames {
    /// `camera_d455`, as the recorder of the dataset spells them today.
    #[default]
    Short,
    /// `camera_realsense_455`, as the published dataset does.
    Long,
}

/// The exporter.
#[derive(Debug, Clone, Default)]
pub struct ByteCameraExport {
    names: CameraNames,
    depth_unit_m: Option<f64>,
    sessions: Vec<Layout>,
}

/// The folders of one session.
#[derive(Debug, Clone)]
struct Layout {
    /// `YYYYMMDD_HHMM`.
    folder: String,
    /// By the index of the stream.
    streams: Vec<StreamFacts>,
}

impl ByteCameraExport {
    /// With depth PNGs in units of `depth_unit_m`, or as the cameras count when `None`.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] for an invalid unit.
    pub fn new(names: CameraNames, depth_unit_m: Option<f64>) -> Result<Self> {
        if let Some(unit) = depth_unit_m
            && !(1e-6..=1.0).contains(&unit)
        {
            let what = format!("invalid depth unit {unit} m; use metres per unit, such as 0.001");
            return Err(Error::new(ErrorKind::BadInput, what));
        }
        Ok(Self { names, depth_unit_m, sessions: Vec::new() })
    }

    /// Folder and files of each stream, and what is lost with them.
    fn layout(&self, session: &Session, taken: &mut BTreeSet<String>, losses: &mut Vec<String>) -> Layout {
        let stem = folder_name(session);
        let mut folder = stem.clone();
        let mut n = 2;
        while !taken.insert(folder.clone()) {
            folder = format!("{stem}_{n}");
            n += 1;
        }
        let mut cameras: Vec<(String, String)> = Vec::new();
        let mut files = BTreeSet::new();
        let mut streams = Vec::new();
        for s in &session.streams {
            let camera = s.id.camera.as_str();
            let mut folder_of = |mode: Option<&str>| {
                let key = mode.map_or_else(|| camera.to_owned(), |m| format!("{camera}/{m}"));
                if let Some((_, folder)) = cameras.iter().find(|(k, _)| *k == key) {
                    return folder.clone();
                }
                let plain = names::of_model(&s.model, camera, self.names == CameraNames::Long);
                let plain = mode.map_or_else(|| plain.clone(), |m| format!("{plain}_{m}"));
                let mut name = format!("camera_{plain}");
                let mut n = 2;
                while cameras.iter().any(|(_, folder)| *folder == name) {
                    name = format!("camera_{plain}_{n}");
                    n += 1;
                }
                cameras.push((key, name.clone()));
                name
            };
            // A stereo camera with several depth modes has a folder for each, with its colour in all of them.
            let modes = if s.id.stream.as_str() == "color" { modes_of(session, camera) } else { Vec::new() };
            // Two depth streams of one mode, of different formats, share its folder.
            let mut named = BTreeSet::new();
            let folders = modes.iter().map(|mode| folder_of(Some(mode)));
            let mut copies: Vec<_> = folders.filter(|folder| named.insert(folder.clone())).collect();
            let of_camera = if copies.is_empty() {
                folder_of(names::mode_of(s.id.stream.as_str()))
            } else {
                copies.remove(0)
            };
            let wanted = match s.format {
                PixelFormat::Z16 => "depth",
                PixelFormat::DepthF32 => "raw_depth",
                PixelFormat::Mono8 | PixelFormat::Mono16 => "ir",
                PixelFormat::Confidence8 => "confidence",
                PixelFormat::DisparityF32 => "disparity",
                _ => "color",
            };
            let ending = StillFormat::of(s.format).extension();
            let folders = || copies.iter().chain([&of_camera]);
            let is_free = |name: &str| !folders().any(|f| files.contains(&(f.clone(), name.to_owned())));
            let prefix = free_prefix(wanted, s.id.stream.as_str(), is_free);
            files.extend(folders().map(|f| (f.clone(), prefix.clone())));
            let mut stream = s.clone();
            let mut recorded_format = None;
            let mut recorded_depth_unit_m = None;
            if s.format == PixelFormat::Mjpeg {
                stream.format = PixelFormat::Rgb8;
                recorded_format = Some(s.format.name().to_owned());
                losses.push(format!(
                    "{}: the camera's JPEG becomes PNG; what JPEG lost was lost in the camera",
                    s.id
                ));
            } else if matches!(s.format, PixelFormat::Rgb8 | PixelFormat::Bgr8) {
                let what =
                    "where it was recorded as JPEG, the PNG holds what JPEG left; nothing more is lost here";
                losses.push(format!("{}: {what}", s.id));
            } else if s.format.is_subsampled() {
                losses.push(format!(
                    "{}: {} is written as NPY, because no PNG holds it",
                    s.id,
                    s.format.name()
                ));
            }
            if let Some(unit) = self.rescaled(s.format, s.depth_unit_m) {
                stream.depth_unit_m = unit;
                recorded_depth_unit_m = Some(s.depth_unit_m);
                losses.push(format!(
                    "{}: depth is rounded from units of {} m to {unit} m, which moves a distance by up to {} m",
                    s.id,
                    s.depth_unit_m,
                    unit / 2.0
                ));
            }
            let folder = of_camera;
            let ending = ending.to_owned();
            if !copies.is_empty() {
                losses.push(format!("{}: the same images are in {folder} and {}", s.id, copies.join(", ")));
            }
            streams.push(StreamFacts {
                folder,
                prefix,
                ending,
                copies,
                recorded_format,
                recorded_depth_unit_m,
                stream,
            });
        }
        Layout { folder, streams }
    }

    /// The unit that depth of such a stream is rescaled to, if it is.
    fn rescaled(&self, format: PixelFormat, unit_m: f64) -> Option<f64> {
        let wanted = self.depth_unit_m?;
        (format == PixelFormat::Z16 && unit_m > 0.0 && unit_m != wanted).then_some(wanted)
    }

    /// The file of a frame.
    fn image<'a>(&self, frame: &'a DatasetFrame, set: u64, out: &mut PartOut<'_>) -> Result<Cow<'a, [u8]>> {
        let h = &frame.header;
        let format = h.pixel_format().unwrap_or(PixelFormat::Mjpeg);
        let Some(unit) = self.rescaled(format, h.depth_unit_m) else {
            return still(frame, StillFormat::of(format));
        };
        let pixels = frame.decoded()?;
        let (scaled, rounded, beyond) = rescale(&tight(h, &pixels, format), h.depth_unit_m / unit);
        out.count("pixels of depth that were rounded", rounded);
        out.count("pixels of depth beyond 65535 units, written as 0 (no depth)", beyond);
        if beyond > 0 {
            out.lose(format!(
                "set {set}: {beyond} pixels of {}/{} are beyond 65535 units of {unit} m",
                h.camera(),
                h.stream()
            ));
        }
        encode(h, format, &scaled, StillFormat::Png).map(Cow::Owned)
    }

    fn set(
        &self,
        layout: &Layout,
        source: &Source,
        n: u32,
        set: &DatasetSet,
        out: &mut PartOut<'_>,
    ) -> Result<()> {
        for (stream, facts) in layout.streams.iter().enumerate() {
            let mut row = Row {
                n,
                set: set.id,
                tick_ns: set.tick.ns(),
                set_utc_ns: set.utc_ns,
                utc_offset_ns: set.utc_offset_ns,
                spread_ns: set.spread_ns,
                stream: facts.stream.id.to_string(),
                file: String::new(),
                header: FrameHeader::default(),
            };
            if let Some(frame) = set.frames.iter().find(|f| f.stream == stream) {
                match self.image(frame, set.id, out) {
                    Ok(file) => {
                        row.file = format!("{}/{}_{n}.{}", facts.folder, facts.prefix, facts.ending);
                        row.header = frame.header;
                        if facts.recorded_depth_unit_m.is_some() {
                            row.header.depth_unit_m = facts.stream.depth_unit_m;
                        }
                        let recorded = &source.session().streams[stream];
                        let h = &frame.header;
                        let differs = h.intrinsics != recorded.intrinsics || h.pose != recorded.pose;
                        out.count(
                            "frames whose own calibration is not the session's and is left out",
                            differs.into(),
                        );
                        out.file(&format!("{}/{}", layout.folder, row.file), &file)?;
                        for copy in &facts.copies {
                            let name =
                                format!("{}/{copy}/{}_{n}.{}", layout.folder, facts.prefix, facts.ending);
                            out.file(&name, &file)?;
                        }
                        out.frame(stream);
                    }
                    Err(e) => out.lose(format!("set {}: {e}", set.id)),
                }
            }
            out.rows().extend_from_slice(row.text().as_bytes());
        }
        Ok(())
    }
}

/// The first part of a stream's files: the name of its kind, or where that is taken its own name, or that with a number.
fn free_prefix(kind: &str, own: &str, is_free: impl Fn(&str) -> bool) -> String {
    let numbered = (2u64..).map(|n| format!("{own}_{n}"));
    let mut names = [kind.to_owned(), own.to_owned()].into_iter().chain(numbered);
    // The numbers never end, and what is taken does.
    names.find(|name| is_free(name)).unwrap_or_else(|| own.to_owned())
}

/// The depth modes of a camera, in the order of its streams.
fn modes_of<'a>(session: &'a Session, camera: &str) -> Vec<&'a str> {
    let of_camera = session.streams.iter().filter(|s| s.id.camera.as_str() == camera && s.format.is_depth());
    of_camera.filter_map(|s| names::mode_of(s.id.stream.as_str())).collect()
}

/// Depth in other units: the pixels, how many were rounded, and how many do not fit.
fn rescale(pixels: &[u8], factor: f64) -> (Vec<u8>, u64, u64) {
    let mut rounded = 0;
    let mut beyond = 0;
    let mut out = Vec::with_capacity(pixels.len());
    for raw in pixels.as_chunks().0 {
        let exact = f64::from(u16::from_le_bytes(*raw)) * factor;
        let nearest = exact.round();
        let fits = nearest <= f64::from(u16::MAX);
        // Products such as 3 * 0.1 are not what they stand for; a billionth does not count as a loss.
        rounded += u64::from(fits && (nearest - exact).abs() > 1e-9 * exact.max(1.0));
        beyond += u64::from(!fits);
        out.extend((if fits { nearest as u16 } else { 0 }).to_le_bytes());
    }
    (out, rounded, beyond)
}

/// `YYYYMMDD_HHMM`: as the session is called, else when it began in UTC.
fn folder_name(session: &Session) -> String {
    let begin: Vec<char> = session.name.chars().take(14).collect();
    let digit = |i: usize| begin.get(i).is_some_and(char::is_ascii_digit);
    let named = (0..8).chain(9..13).all(digit)
        && begin[8] == '_'
        && begin.get(13).is_none_or(|c| !c.is_ascii_digit());
    if named {
        return begin[..13].iter().collect();
    }
    let t = OffsetDateTime::from_unix_timestamp_nanos(i128::from(session.started_utc_ns));
    let t = t.unwrap_or(OffsetDateTime::UNIX_EPOCH);
    format!("{:04}{:02}{:02}_{:02}{:02}", t.year(), u8::from(t.month()), t.day(), t.hour(), t.minute())
}

impl Exporter for ByteCameraExport {
    fn format(&self) -> &'static str {
        FORMAT
    }

    fn options(&self) -> Value {
        let names = if self.names == CameraNames::Long { "long" } else { "short" };
        json!({ "names": names, "depth_unit_m": self.depth_unit_m })
    }

    fn plan(&mut self, sources: &[Source]) -> Result<Plan> {
        let mut plan = Plan::by_segment(sources);
        let mut taken = BTreeSet::new();
        plan.losses.push(
            "depth and colour of a camera are as they were captured; the published dataset has depth aligned to colour"
                .to_owned(),
        );
        self.sessions.clear();
        for source in sources {
            if source.times().len() as u64 > u64::from(u32::MAX) {
                return Err(Error::new(
                    ErrorKind::BadInput,
                    "the dataset has more sets than files can be numbered",
                ));
            }
            let layout = self.layout(source.session(), &mut taken, &mut plan.losses);
            let folders: BTreeSet<_> =
                layout.streams.iter().flat_map(|s| s.copies.iter().chain([&s.folder])).collect();
            plan.folders.push(layout.folder.clone());
            plan.folders.extend(folders.into_iter().map(|f| format!("{}/{f}", layout.folder)));
            self.sessions.push(layout);
        }
        Ok(plan)
    }

    fn part(
        &self,
        source: &Source,
        part: &Part,
        sets: &mut PartSets<'_>,
        out: &mut PartOut<'_>,
    ) -> Result<()> {
        let layout = &self.sessions[part.source];
        while let Some((number, set)) = sets.next(PixelMode::Stored, out)? {
            self.set(layout, source, number as u32, &set, out)?;
        }
        Ok(())
    }

    fn finish(&self, sources: &[Source], parts: &Parts<'_>, out: &Output<'_>) -> Result<()> {
        for (i, (layout, source)) in self.sessions.iter().zip(sources).enumerate() {
            let calibration = Calibration::new(source.session(), layout.streams.clone());
            out.file(&format!("{}/{CALIBRATION_FILE}", layout.folder), &calibration.text()?)?;
            let mut list = out.create(&format!("{}/{FRAMES_FILE}", layout.folder))?;
            list.append(head().as_bytes())?;
            for rows in parts.rows(i) {
                list.append(&rows?)?;
            }
            list.finish()?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Folder and first part of the files of each stream of such cameras, copies included; ends in time or panics.
    fn files_of(streams: Vec<(usize, &'static str, PixelFormat)>) -> Vec<(String, String)> {
        let mut session = Session::new("20260314_1512", "rig");
        for (camera, stream, format) in streams {
            let id = format!("cam{camera}/{stream}").parse().unwrap();
            let model = ["D435", "ZED 2i", "Test 1"][camera % 3].to_owned();
            session.streams.push(depthrig_recorder::testing::stream(id, model, format));
        }
        let (done, ended) = std::sync::mpsc::sync_channel(1);
        std::thread::spawn(move || {
            let exporter = ByteCameraExport::new(CameraNames::Short, None).unwrap();
            let layout = exporter.layout(&session, &mut BTreeSet::new(), &mut Vec::new());
            let _ = done.send(layout.streams);
        });
        let streams = ended.recv_timeout(std::time::Duration::from_mins(1)).expect("the layout never ends");
        let each = |s: &StreamFacts| {
            let folders = s.copies.iter().chain([&s.folder]).cloned().collect::<Vec<_>>();
            let prefix = s.prefix.clone();
            folders.into_iter().map(move |folder| (folder, prefix.clone()))
        };
        streams.iter().flat_map(each).collect()
    }

    #[test]
    fn a_stream_called_as_the_kind_of_one_before_gets_a_number() {
        let files = files_of(vec![(2, "aux", PixelFormat::Rgb8), (2, "color", PixelFormat::Rgb8)]);
        let prefixes: Vec<_> = files.iter().map(|(_, prefix)| prefix.as_str()).collect();
        assert_eq!(prefixes, ["color", "color_2"]);
    }

    /// Depth of one mode in two streams: colour is in its folder once.
    #[test]
    fn streams_of_one_mode_share_its_folder() {
        let files = files_of(vec![
            (1, "color", PixelFormat::Rgb8),
            (1, "depth_quality", PixelFormat::Z16),
            (1, "disparity_quality", PixelFormat::DepthF32),
        ]);
        let prefixes: Vec<_> = files.iter().map(|(_, prefix)| prefix.as_str()).collect();
        assert_eq!(prefixes, ["color", "depth", "raw_depth"], "{files:?}");
        assert!(files.iter().all(|(folder, _)| folder == "camera_zed2i_quality"), "{files:?}");
    }

    #[test]
    fn sessions_that_began_in_one_minute_have_folders_of_their_own() {
        let session = Session::new("20260314_1512_kitchen", "rig");
        let exporter = ByteCameraExport::new(CameraNames::Short, None).unwrap();
        let mut taken = BTreeSet::new();
        let mut folder = || exporter.layout(&session, &mut taken, &mut Vec::new()).folder;
        assert_eq!([folder(), folder(), folder()], ["20260314_1512", "20260314_1512_2", "20260314_1512_3"]);
    }

    proptest! {
        /// Names that are names of kinds, of modes, or look like numbered ones.
        #[test]
        fn whatever_streams_are_called_no_two_have_the_same_files(
            streams in proptest::collection::btree_map(
                (0usize..4, proptest::sample::select(vec![
                    "color", "color_2", "color_3", "aux", "depth", "depth_2", "ir", "ir_2", "raw_depth", "confidence",
                    "disparity", "depth_quality", "depth_neural", "confidence_quality", "confidence_neural", "left",
                ])),
                proptest::sample::select(vec![
                    PixelFormat::Rgb8, PixelFormat::Z16, PixelFormat::DepthF32, PixelFormat::Mono8, PixelFormat::Mono16,
                    PixelFormat::Confidence8, PixelFormat::DisparityF32, PixelFormat::Yuyv, PixelFormat::Mjpeg,
                ]),
                1..20,
            ).prop_map(|m| m.into_iter().map(|((c, s), f)| (c, s, f)).collect::<Vec<_>>()).prop_shuffle(),
        ) {
            let files = files_of(streams);
            let unique: BTreeSet<_> = files.iter().collect();
            prop_assert_eq!(unique.len(), files.len(), "{:?}", files);
        }

        #[test]
        fn rescaled_depth_is_the_nearest_or_none(values: Vec<u16>, tenths in 1u32..40) {
            let pixels: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
            let factor = f64::from(tenths) / 10.0;
            let (out, rounded, beyond) = rescale(&pixels, factor);
            let mut r = 0;
            let mut b = 0;
            for (v, o) in values.iter().zip(out.chunks(2)) {
                // Exactly, in tenths.
                let exact = u32::from(*v) * tenths;
                let o = u32::from(u16::from_le_bytes([o[0], o[1]]));
                if (exact + 5) / 10 > 65535 {
                    b += 1;
                    prop_assert_eq!(o, 0);
                } else {
                    r += u64::from(exact % 10 != 0);
                    prop_assert!((10 * o).abs_diff(exact) <= 5);
                }
            }
            prop_assert_eq!((rounded, beyond), (r, b));
        }
    }

    #[test]
    fn folders_are_called_as_sessions_are() {
        let mut session = Session::new("20260314_1512_kitchen", "rig");
        session.started_utc_ns = 1_700_000_000_000_000_000;
        assert_eq!(folder_name(&session), "20260314_1512");
        for other in ["20260314_15123", "kitchen", "", "20260314-1512", "2026031é_1512"] {
            session.name = other.into();
            assert_eq!(folder_name(&session), "20231114_2213", "{other}");
        }
    }
}
