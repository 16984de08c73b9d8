//! A recording of an Azure Kinect (`.mkv`), read from its start or from any time, in constant memory.
//!
//! The contents are described by the Azure Kinect Sensor SDK (MIT), `src/record`; the container is Matroska
//! (RFC 9559). The file is read cluster by cluster, a cluster being at most 32 ms of everything. Memory is that of the
//! largest cluster, whatever the length of the recording.
//!
//! **Damage.** A cluster is valid if it and everything in it is complete, and its checksum, if it has one, matches.
//! An invalid one is skipped and counted ([`Losses`]); reading goes on at the next valid one. So a file that was cut
//! off plays up to its last complete cluster. No size that a file states is trusted beyond its end, nor beyond
//! [`MAX_CLUSTER`].
//!
//! `matroska-demuxer` reads such files too, and tests compare the two. It is not used here because it gives up on files
//! whose end is missing, has no attachments, and accepts the bytes of a damaged cluster as they are.

use super::calibration::Calibration;
use super::ebml::{self, id};
use super::modes::{ColorMode, DepthMode, WiredSync};
use depthrig_driver::{Error, ErrorKind, Result};
use std::path::Path;

mod cluster;
mod facts;
mod head;
mod motion;
mod source;

pub use cluster::MAX_CLUSTER;
pub use motion::{MotionSample, motion_samples};
pub use source::ReadAt;

/// Contents of a track.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum TrackKind {
    /// Images of the colour camera.
    Color,
    /// Depth in millimetres.
    Depth,
    /// Infrared.
    Infrared,
    /// Accelerometer and gyroscope.
    Motion,
    /// Something that a user added.
    Other,
}

/// How the images of a track are stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Pixels {
    /// JPEG.
    Mjpg,
    /// Planar 4:2:0.
    Nv12,
    /// Packed 4:2:2, Y0 U Y1 V.
    Yuy2,
    /// Blue, green, red and an unused byte.
    Bgra,
    /// 16 bits, the high byte first.
    Gray16Be,
    /// 16 bits, the low byte first: depth and infrared of very early recordings, whose tracks say YUY2.
    Gray16Le,
}

impl Pixels {
    /// Bytes of an image; `None` for those of JPEG, which vary.
    pub const fn frame_bytes(self, width: u32, height: u32) -> Option<usize> {
        let pixels = width as usize * height as usize;
        match self {
            Self::Mjpg => None,
            Self::Nv12 => Some(pixels * 3 / 2),
            Self::Yuy2 | Self::Gray16Be | Self::Gray16Le => Some(pixels * 2),
            Self::Bgra => Some(pixels * 4),
        }
    }
}

/// One track.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Track {
    /// The number that blocks refer to.
    pub number: u64,
    /// The identifier that tags refer to.
    pub uid: u64,
    /// Its name, such as `COLOR`.
    pub name: String,
    /// Its contents.
    pub kind: TrackKind,
    /// How its images are stored; `None` when it holds none.
    pub pixels: Option<Pixels>,
    /// Width of its images.
    pub width: u32,
    /// Height of its images.
    pub height: u32,
    /// Nominal time from image to image, nanoseconds.
    pub period_ns: Option<u64>,
}

/// The facts that a recording states about itself.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Facts {
    /// Serial number of the device; empty when the file does not say it.
    pub serial: String,
    /// Firmware of the colour camera.
    pub color_firmware: String,
    /// Firmware of the depth camera.
    pub depth_firmware: String,
    /// The program that wrote the file.
    pub written_by: String,
    /// When it was written, nanoseconds since 1970 (UTC).
    pub date_utc_ns: Option<i64>,
    /// Mode of the depth camera.
    pub depth_mode: Option<DepthMode>,
    /// Mode of the colour camera.
    pub color_mode: Option<ColorMode>,
    /// Part of the device among others.
    pub wired_sync: WiredSync,
    /// How much later depth was exposed than colour, nanoseconds.
    pub depth_delay_ns: i64,
    /// How much later a subordinate was exposed than its master, nanoseconds.
    pub subordinate_delay_ns: u64,
    /// The device's clock at the file's time 0, nanoseconds.
    pub start_offset_ns: u64,
    /// Time from the file's time 0 to its last frame, nanoseconds, if the file was finished.
    pub duration_ns: Option<u64>,
    /// The calibration's text, if the file has it.
    pub calibration: Option<Vec<u8>>,
    /// Its tracks.
    pub tracks: Vec<Track>,
    /// Whether the file ends before it says that it does.
    pub is_cut: bool,
}

/// Counts of what was skipped so far because it was damaged.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Losses {
    /// Places at which something was left out.
    pub places: u64,
    /// Bytes that were left out.
    pub bytes: u64,
}

/// One block: one image, or some IMU samples.
#[derive(Debug, Clone)]
pub struct Block<'a> {
    /// Index into [`Facts::tracks`].
    pub track: usize,
    /// The device's clock, microseconds; the middle of the exposure. IMU samples have times of their own.
    pub device_us: u64,
    frames: ebml::Frames<'a>,
}

impl<'a> Block<'a> {
    /// The frames that share the block; images never do in what the SDK writes.
    pub fn frames(&self) -> ebml::Frames<'a> {
        self.frames.clone()
    }

    /// The first of them.
    pub fn data(&self) -> &'a [u8] {
        self.frames().next().unwrap_or_default()
    }
}

/// A block that was found and is still in the file's cluster.
#[derive(Debug, Clone, Copy)]
pub(super) struct Pending {
    pub(super) track: usize,
    pub(super) device_us: u64,
    place: cluster::Place,
}

/// An open recording.
pub struct Recording {
    name: String,
    facts: Facts,
    clusters: cluster::Clusters,
    /// Blocks before this time are skipped.
    from_us: u64,
}

impl Recording {
    /// Opens the recording at `path` and reads all but its images.
    ///
    /// # Errors
    /// [`ErrorKind::NotFound`], [`ErrorKind::PermissionDenied`], [`ErrorKind::Io`], and those of [`Self::read`].
    pub fn open(path: &Path) -> Result<Self> {
        Self::read(source::open(path)?, &path.display().to_string())
    }

    /// A recording out of `source`; messages call it `name`.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] if it is not a Matroska file, not from an Azure Kinect, damaged before its first image,
    /// or if its images are stored in an unsupported format.
    pub fn read(source: Box<dyn ReadAt>, name: &str) -> Result<Self> {
        let head = head::read(source.as_ref(), name)?;
        let facts = facts::facts(&head, name)?;
        let clusters = cluster::Clusters::new(source, name.to_owned(), &head);
        Ok(Self { name: name.to_owned(), facts, clusters, from_us: 0 })
    }

    /// The facts that the recording states about itself.
    pub const fn facts(&self) -> &Facts {
        &self.facts
    }

    /// Its tracks.
    pub fn tracks(&self) -> &[Track] {
        &self.facts.tracks
    }

    /// The track of this kind.
    pub fn track(&self, kind: TrackKind) -> Option<(usize, &Track)> {
        self.tracks().iter().enumerate().find(|(_, t)| t.kind == kind)
    }

    /// The device's calibration.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] when the recording has none, or none that can be.
    pub fn calibration(&self) -> Result<Calibration> {
        let text = self.facts.calibration.as_deref().ok_or_else(|| {
            let why = "the recording has no calibration.json; name the device's own as `calibration`, or write \"none\" there to do \
                 without intrinsics";
            Error::new(ErrorKind::BadInput, format!("{}: {why}", self.name))
        })?;
        Calibration::parse(text)
            .map_err(|e| Error::new(e.kind(), format!("{}: {e}", self.name)).with_source(e))
    }

    /// The next block in the order of the file; `None` at the end.
    ///
    /// # Errors
    /// [`ErrorKind::Io`] when the file cannot be read. Damage is not an error, see [`Self::losses`].
    pub fn next_block(&mut self) -> Result<Option<Block<'_>>> {
        let Some(found) = self.advance()? else { return Ok(None) };
        let Pending { track, device_us, .. } = found;
        Ok(Some(Block { track, device_us, frames: self.frames(&found) }))
    }

    /// [`Self::next_block`] without its frames, which stay where they are until it is called again.
    pub(super) fn advance(&mut self) -> Result<Option<Pending>> {
        let scale = self.clusters.scale_ns();
        let offset = self.facts.start_offset_ns;
        loop {
            let Some(place) = self.clusters.advance()? else { return Ok(None) };
            let device_us = (place.time.saturating_mul(scale)).saturating_add(offset) / 1000;
            let known = self.facts.tracks.iter().position(|t| t.number == place.track);
            if let Some(track) = known.filter(|_| device_us >= self.from_us) {
                return Ok(Some(Pending { track, device_us, place }));
            }
        }
    }

    /// The frames of the block that was found last.
    pub(super) fn frames(&self, block: &Pending) -> ebml::Frames<'_> {
        self.clusters.frames(&block.place)
    }

    /// Goes to the first block at or after `device_us` on the device's clock; back, too. By the file's index if it has
    /// one; else from cluster to cluster, which reads 60 bytes of each.
    ///
    /// # Errors
    /// [`ErrorKind::Io`] when the file cannot be read.
    pub fn seek(&mut self, device_us: u64) -> Result<()> {
        let ns = device_us.saturating_mul(1000).saturating_sub(self.facts.start_offset_ns);
        self.clusters.seek(ns / self.clusters.scale_ns())?;
        self.from_us = device_us;
        Ok(())
    }

    /// Counts of what was skipped so far because it was damaged.
    pub const fn losses(&self) -> Losses {
        self.clusters.losses()
    }

    /// Bytes read so far and bytes of the file, for progress.
    pub fn progress(&self) -> (u64, u64) {
        self.clusters.progress()
    }

    /// The largest cluster so far, bytes: what the memory of reading amounts to.
    pub fn memory_bytes(&self) -> usize {
        self.clusters.memory_bytes()
    }
}

impl core::fmt::Debug for Recording {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_struct("Recording")
            .field("name", &self.name)
            .field("facts", &self.facts)
            .finish_non_exhaustive()
    }
}

/// The time of a block: unsigned units of the file, from a cluster's time and the block's own.
const fn block_time(cluster: u64, block: i16) -> u64 {
    cluster.saturating_add_signed(block as i64)
}

/// Name of an element, for messages.
fn element_name(of: u32) -> String {
    let known = [
        (id::SEEK_HEAD, "SeekHead"),
        (id::INFO, "Info"),
        (id::TRACKS, "Tracks"),
        (id::ATTACHMENTS, "Attachments"),
        (id::TAGS, "Tags"),
        (id::CUES, "Cues"),
        (id::CLUSTER, "Cluster"),
        (id::VOID, "Void"),
    ];
    let found = known.iter().find(|(known, _)| *known == of);
    found.map_or_else(|| format!("0x{of:X}"), |(_, name)| (*name).to_owned())
}
