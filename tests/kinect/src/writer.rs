//! Writes the file: headers, clusters of 32 ms, an index. As the SDK's `src/record` does, but for the forms asked for.

use super::element::{element, id as id_bytes, master, size, text, uint, uint8, vint};
use super::{ACCEL_LATE_NS, Fixture, Images, Lacing, MOTION_NS, Written, motion};
use depthrig_kinect::ebml::id;
use std::io::{self, Seek, SeekFrom, Write};

/// The longest cluster, nanoseconds.
const CLUSTER_NS: u64 = 32_000_000;
/// Time between entries of the index, nanoseconds.
const CUES_NS: u64 = 1_000_000_000;
/// Nanoseconds per unit of the file's times.
const SCALE_NS: u64 = 1000;
/// Elements that no name in the reader is for.
const DOC_HEADER: [(u32, u64); 6] =
    [(0x4286, 1), (0x42F7, 1), (0x42F2, 4), (0x42F3, 8), (0x4287, 2), (0x4285, 2)];
const MUXING_APP: u32 = 0x4D80;
const TITLE: u32 = 0x7BA9;
const TRACK_TYPE: u32 = 0x83;
const VIDEO: u32 = 0xE0;
const PIXEL_WIDTH: u32 = 0xB0;
const PIXEL_HEIGHT: u32 = 0xBA;
const MIME_TYPE: u32 = 0x4660;
const TARGET_TYPE: u32 = 0x63CA;
const BLOCK_DURATION: u32 = 0x9B;
const CUE_TRACK: u32 = 0xF7;
const CALIBRATION_UID: u64 = 0x0F9B_CA6A_FC51_2439;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Color,
    Depth,
    Infrared,
    Motion,
}

struct Frame {
    time_ns: u64,
    track: usize,
    data: Vec<u8>,
}

pub(super) struct Writer<'a, W> {
    fixture: &'a Fixture,
    out: &'a mut W,
    tracks: Vec<Kind>,
    /// Where positions count from.
    origin: u64,
    cues: Vec<(u64, u64)>,
    written: Written,
    last_ns: u64,
}

impl<'a, W: Write + Seek> Writer<'a, W> {
    pub(super) fn new(fixture: &'a Fixture, out: &'a mut W) -> Self {
        let mut tracks = Vec::new();
        if fixture.color.is_some() {
            tracks.push(Kind::Color);
        }
        if let Some(mode) = fixture.depth {
            if mode.has_depth() {
                tracks.push(Kind::Depth);
            }
            tracks.push(Kind::Infrared);
        }
        if fixture.motion {
            tracks.push(Kind::Motion);
        }
        Self { fixture, out, tracks, origin: 0, cues: Vec::new(), written: Written::default(), last_ns: 0 }
    }

    pub(super) fn run(mut self, images: &mut dyn Images) -> io::Result<Written> {
        let doc: Vec<_> = DOC_HEADER.into_iter().map(|(of, n)| uint(of, n)).collect();
        let header = master(id::EBML, &[doc, vec![text(id::DOC_TYPE, "matroska")]].concat());
        self.out.write_all(&header)?;
        self.out.write_all(&id_bytes(id::SEGMENT))?;
        let size_at = self.out.stream_position()?;
        self.out.write_all(&[0x01, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF])?;
        self.origin = self.out.stream_position()?;
        // The table is of one length whatever it says.
        let table_at = self.out.stream_position()?;
        self.out.write_all(&seek_head(&[0; 5]))?;
        let info_at = self.position()?;
        self.out.write_all(&info(0.0))?;
        let tracks_at = self.position()?;
        let tracks = master(
            id::TRACKS,
            &self.tracks.iter().enumerate().map(|(i, k)| self.track(i, *k)).collect::<Vec<_>>(),
        );
        self.out.write_all(&tracks)?;
        let attachments_at = self.position()?;
        if let Some(calibration) = &self.fixture.calibration {
            self.out.write_all(&attachments(calibration))?;
        }
        let mut tags_at = self.position()?;
        if !self.fixture.tags_behind {
            let tags = self.tags();
            self.out.write_all(&tags)?;
        }
        // Where the SDK leaves room for more tags.
        self.out.write_all(&element(id::VOID, &[0; 200]))?;
        self.clusters(images)?;
        if self.fixture.tags_behind {
            tags_at = self.position()?;
            let tags = self.tags();
            self.out.write_all(&tags)?;
        }
        let cues_at = self.position()?;
        if self.fixture.index {
            let cues: Vec<_> = self.cues.iter().map(|(time, at)| cue(*time, *at)).collect();
            self.out.write_all(&master(id::CUES, &cues))?;
        }
        let end = self.out.stream_position()?;
        self.out.seek(SeekFrom::Start(table_at))?;
        let attachments_at = if self.fixture.calibration.is_some() { attachments_at } else { 0 };
        let cues_at = if self.fixture.index { cues_at } else { 0 };
        self.out.write_all(&seek_head(&[info_at, tracks_at, attachments_at, tags_at, cues_at]))?;
        self.out.write_all(&info((self.last_ns / SCALE_NS) as f64))?;
        if !self.fixture.open_sizes {
            self.out.seek(SeekFrom::Start(size_at))?;
            self.out.write_all(&vint(end - self.origin, 8))?;
        }
        self.out.seek(SeekFrom::Start(end))?;
        Ok(self.written)
    }

    /// Where the next element goes, as the table says it.
    fn position(&mut self) -> io::Result<u64> {
        Ok(self.out.stream_position()? - self.origin)
    }

    fn track(&self, i: usize, kind: Kind) -> Vec<u8> {
        let f = self.fixture;
        let name = match kind {
            Kind::Color => "COLOR",
            Kind::Depth => "DEPTH",
            Kind::Infrared if f.early => "DEPTH_IR",
            Kind::Infrared => "IR",
            Kind::Motion => "IMU",
        };
        let is_motion = kind == Kind::Motion;
        let mut parts = vec![
            uint(id::TRACK_NUMBER, i as u64 + 1),
            uint(id::TRACK_UID, uid(i)),
            uint(TRACK_TYPE, if is_motion { 0x11 } else { 1 }),
            text(id::CODEC_ID, if is_motion { "S_K4A/IMU" } else { "V_MS/VFW/FOURCC" }),
            text(id::TRACK_NAME, name),
        ];
        if is_motion {
            return master(id::TRACK_ENTRY, &parts);
        }
        let ((width, height), fourcc, bits) = match (kind, f.color, f.depth) {
            (Kind::Color, Some(mode), _) => {
                let bits = [24u16, 12, 16, 32][mode.format.code() as usize];
                (mode.resolution.size(), mode.format.name().to_ascii_uppercase(), bits)
            }
            (_, _, Some(mode)) => (mode.size(), if f.early { "YUY2" } else { "b16g" }.to_owned(), 16),
            _ => unreachable!("a track without a mode"),
        };
        let image_size = if fourcc == "MJPG" { 0 } else { width * height * u32::from(bits) / 8 };
        let mut bitmap = Vec::new();
        for n in [40, width, height, 1 | u32::from(bits) << 16] {
            bitmap.extend(n.to_le_bytes());
        }
        bitmap.extend(fourcc.as_bytes());
        for n in [image_size, 0, 0, 0, 0] {
            bitmap.extend(n.to_le_bytes());
        }
        parts.push(element(id::CODEC_PRIVATE, &bitmap));
        parts.push(uint(id::DEFAULT_DURATION, 1_000_000_000 / u64::from(f.rate_hz)));
        parts.push(master(VIDEO, &[uint(PIXEL_WIDTH, width.into()), uint(PIXEL_HEIGHT, height.into())]));
        master(id::TRACK_ENTRY, &parts)
    }

    fn tags(&self) -> Vec<u8> {
        let f = self.fixture;
        let mut tags = Vec::new();
        for (i, kind) in self.tracks.iter().enumerate() {
            let of = |name: &str, value: &str| tag(name, value, Some(("TRACK", id::TAG_TRACK_UID, uid(i))));
            let mut named = |name: &str| {
                if !f.early {
                    tags.push(of(name, &uid(i).to_string()));
                }
            };
            match kind {
                Kind::Color => named("K4A_COLOR_TRACK"),
                Kind::Depth => named("K4A_DEPTH_TRACK"),
                Kind::Infrared => named("K4A_IR_TRACK"),
                Kind::Motion => named("K4A_IMU_TRACK"),
            }
            let mode = f.depth.map(|m| m.name().to_ascii_uppercase()).unwrap_or_default();
            // The depth tag is on depth's track, and on none for passive infrared.
            match kind {
                Kind::Color => tags.push(of("K4A_COLOR_MODE", &f.color.unwrap().tag())),
                Kind::Depth if f.early => tags.push(of("K4A_DEPTH_MODE", &mode.replace("2X2", "2x2"))),
                Kind::Depth => tags.push(of("K4A_DEPTH_MODE", &mode)),
                Kind::Infrared => {
                    let passive = !f.depth.unwrap().has_depth();
                    if passive {
                        tags.push(tag("K4A_DEPTH_MODE", &mode, None));
                    }
                    tags.push(of("K4A_IR_MODE", if passive { "PASSIVE" } else { "ACTIVE" }));
                }
                Kind::Motion => tags.push(of("K4A_IMU_MODE", "ON")),
            }
        }
        let mut plain = |name: &str, value: &str| tags.push(tag(name, value, None));
        plain("K4A_DEPTH_DELAY_NS", &f.depth_delay_ns.to_string());
        plain("K4A_WIRED_SYNC_MODE", &f.wired_sync.name().to_ascii_uppercase());
        plain("K4A_COLOR_FIRMWARE_VERSION", "1.6.110");
        plain("K4A_DEPTH_FIRMWARE_VERSION", "1.6.79");
        if !f.serial.is_empty() {
            plain("K4A_DEVICE_SERIAL_NUMBER", &f.serial);
        }
        plain("K4A_START_OFFSET_NS", &f.start_offset_ns.to_string());
        if f.calibration.is_some() {
            let target = ("ATTACHMENT", id::TAG_ATTACHMENT_UID, CALIBRATION_UID);
            tags.push(tag("K4A_CALIBRATION_FILE", "calibration.json", Some(target)));
        }
        master(id::TAGS, &tags)
    }

    /// Writes all clusters: frames in the order of their times, a new cluster after 32 ms.
    fn clusters(&mut self, images: &mut dyn Images) -> io::Result<()> {
        let f = self.fixture;
        let mut waiting: Vec<Frame> = Vec::new();
        let mut motion_at = 0;
        for n in 0..f.captures {
            let (color_ns, depth_ns) = f.file_times_ns(n);
            if !f.lost.contains(&n) {
                for (track, kind) in self.tracks.iter().enumerate() {
                    let (time_ns, data) = match kind {
                        Kind::Color => (color_ns, images.color(n)),
                        Kind::Depth => (depth_ns, gray(&images.depth(n), f.early)),
                        Kind::Infrared => (depth_ns, gray(&images.infrared(n), f.early)),
                        Kind::Motion => continue,
                    };
                    waiting.push(Frame { time_ns, track, data });
                }
            }
            let (next_color, next_depth) = f.file_times_ns(n + 1);
            let until = next_color.min(next_depth);
            if let Some(track) = self.tracks.iter().position(|k| *k == Kind::Motion) {
                while motion_at * MOTION_NS < until {
                    waiting.push(Frame { time_ns: motion_at * MOTION_NS, track, data: sample(f, motion_at) });
                    motion_at += 1;
                }
            }
            // All that is still to come is later.
            waiting.sort_by_key(|w| w.time_ns);
            let ready = waiting.partition_point(|w| w.time_ns < until);
            let later = waiting.split_off(ready);
            self.frames(&std::mem::replace(&mut waiting, later))?;
        }
        self.frames(&waiting)?;
        self.written.motion = motion_at;
        self.written.clusters_end = self.out.stream_position()?;
        Ok(())
    }

    /// Writes frames in the order of their times.
    fn frames(&mut self, mut frames: &[Frame]) -> io::Result<()> {
        while let Some(first) = frames.first() {
            let n = frames.partition_point(|w| w.time_ns < first.time_ns + CLUSTER_NS);
            let (these, rest) = frames.split_at(n);
            self.cluster(these)?;
            frames = rest;
        }
        Ok(())
    }

    fn cluster(&mut self, frames: &[Frame]) -> io::Result<()> {
        let start = frames[0].time_ns / SCALE_NS;
        let mut body = uint(id::TIMESTAMP, start);
        let mut rest = frames;
        while let Some(first) = rest.first() {
            let is_motion = self.tracks[first.track] == Kind::Motion;
            let same = rest.iter().take_while(|w| w.track == first.track).count();
            // One alone needs no lace.
            let laced = is_motion && self.fixture.lacing != Lacing::None && same > 1;
            let n = if laced { same.min(256) } else { 1 };
            let (these, later) = rest.split_at(n);
            let time = (first.time_ns / SCALE_NS - start) as i16;
            let lacing = if laced { self.fixture.lacing } else { Lacing::None };
            let block = block(first.track as u64 + 1, time, !is_motion, lacing, these);
            if is_motion {
                let last = these[n - 1].time_ns;
                let duration = uint(BLOCK_DURATION, (last - first.time_ns) / SCALE_NS + 1);
                body.extend(master(id::BLOCK_GROUP, &[element(id::BLOCK, &block), duration]));
            } else {
                body.extend(element(id::SIMPLE_BLOCK, &block));
            }
            rest = later;
        }
        let at = self.out.stream_position()?;
        self.written.clusters.push(at);
        self.last_ns = frames[frames.len() - 1].time_ns;
        if self.cues.last().is_none_or(|(time, _)| (start - time) * SCALE_NS >= CUES_NS) {
            self.cues.push((start, at - self.origin));
        }
        let checksum = if self.fixture.checksums {
            element(id::CRC_32, &crc32(&body).to_le_bytes())
        } else {
            Vec::new()
        };
        self.out.write_all(&id_bytes(id::CLUSTER))?;
        if self.fixture.open_sizes {
            self.out.write_all(&[0x01, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF])?;
        } else {
            self.out.write_all(&size((checksum.len() + body.len()) as u64))?;
        }
        self.out.write_all(&checksum)?;
        self.out.write_all(&body)
    }
}

fn uid(track: usize) -> u64 {
    0x0324_4080_9F71_DFD2 + track as u64
}

/// A table of where things are; 0 for what is not there.
fn seek_head(positions: &[u64; 5]) -> Vec<u8> {
    let of = [id::INFO, id::TRACKS, id::ATTACHMENTS, id::TAGS, id::CUES];
    let entries = of.into_iter().zip(positions).map(|(of, at)| {
        // An entry for nothing becomes as much of nothing.
        let entry = master(id::SEEK, &[element(id::SEEK_ID, &id_bytes(of)), uint8(id::SEEK_POSITION, *at)]);
        if *at == 0 { element(id::VOID, &vec![0; entry.len() - 2]) } else { entry }
    });
    master(id::SEEK_HEAD, &entries.collect::<Vec<_>>())
}

fn info(duration: f64) -> Vec<u8> {
    let parts = [
        uint(id::TIMESTAMP_SCALE, SCALE_NS),
        text(MUXING_APP, "libmatroska-1.4.9"),
        text(id::WRITING_APP, "depthrig-tests"),
        // 2026-01-01T00:00:00Z since 2001.
        element(id::DATE_UTC, &(788_918_400_000_000_000_i64).to_be_bytes()),
        text(TITLE, "Azure Kinect"),
        element(id::DURATION, &duration.to_be_bytes()),
    ];
    master(id::INFO, &parts)
}

fn attachments(calibration: &str) -> Vec<u8> {
    let file = [
        text(id::FILE_NAME, "calibration.json"),
        text(MIME_TYPE, "application/octet-stream"),
        element(id::FILE_DATA, calibration.as_bytes()),
        uint8(id::FILE_UID, CALIBRATION_UID),
    ];
    master(id::ATTACHMENTS, &[master(id::ATTACHED_FILE, &file)])
}

fn tag(name: &str, value: &str, target: Option<(&str, u32, u64)>) -> Vec<u8> {
    let targets =
        target.map_or_else(Vec::new, |(kind, of, uid)| vec![text(TARGET_TYPE, kind), uint8(of, uid)]);
    let simple = master(id::SIMPLE_TAG, &[text(id::TAG_NAME, name), text(id::TAG_STRING, value)]);
    master(id::TAG, &[master(id::TARGETS, &targets), simple])
}

fn cue(time: u64, at: u64) -> Vec<u8> {
    let place = master(id::CUE_TRACK_POSITIONS, &[uint(CUE_TRACK, 1), uint(id::CUE_CLUSTER_POSITION, at)]);
    master(id::CUE_POINT, &[uint(id::CUE_TIME, time), place])
}

/// A block of one frame, or of several.
fn block(track: u64, time: i16, is_simple: bool, lacing: Lacing, frames: &[Frame]) -> Vec<u8> {
    let mut out = vint(track, 1);
    out.extend(time.to_be_bytes());
    let code = match lacing {
        Lacing::None => 0,
        Lacing::Xiph => 1,
        Lacing::Fixed => 2,
        Lacing::Ebml => 3,
    };
    out.push(code << 1 | if is_simple { 0x80 } else { 0 });
    if lacing != Lacing::None {
        out.push((frames.len() - 1) as u8);
    }
    let sizes = frames.iter().take(frames.len() - 1).map(|w| w.data.len());
    match lacing {
        Lacing::None | Lacing::Fixed => {}
        Lacing::Xiph => sizes.for_each(|n| {
            out.extend(vec![255; n / 255]);
            out.push((n % 255) as u8);
        }),
        Lacing::Ebml => {
            let mut last = None;
            for n in sizes {
                match last {
                    None => out.extend(size(n as u64)),
                    // Two bytes hold differences of up to 8191.
                    Some(last) => out.extend(vint((n as i64 - last as i64 + 8191) as u64, 2)),
                }
                last = Some(n);
            }
        }
    }
    for w in frames {
        out.extend(&w.data);
    }
    out
}

fn gray(pixels: &[u16], early: bool) -> Vec<u8> {
    pixels.iter().flat_map(|p| if early { p.to_le_bytes() } else { p.to_be_bytes() }).collect()
}

fn sample(fixture: &Fixture, i: u64) -> Vec<u8> {
    let (at, acceleration, rotation) = motion(fixture, i);
    let mut out = (at + ACCEL_LATE_NS).to_le_bytes().to_vec();
    out.extend(acceleration.iter().flat_map(|a| a.to_le_bytes()));
    out.extend(at.to_le_bytes());
    out.extend(rotation.iter().flat_map(|r| r.to_le_bytes()));
    out
}

/// CRC-32 of IEEE 802.3, a byte at a time: not the reader's own.
fn crc32(bytes: &[u8]) -> u32 {
    let step = |crc: u32| if crc & 1 == 1 { crc >> 1 ^ 0xEDB8_8320 } else { crc >> 1 };
    let table: [u32; 256] = core::array::from_fn(|i| (0..8).fold(i as u32, |crc, _| step(crc)));
    !bytes.iter().fold(!0, |crc, b| crc >> 8 ^ table[((crc ^ u32::from(*b)) & 255) as usize])
}
