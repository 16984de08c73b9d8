//! A copy of a segment in which everything about calibration is as a session says.

use super::Calibrations;
use crate::cdr::Reader;
use crate::container::chunk::{Chunk, ChunkBuilder, MessageHead};
use crate::container::copy::{Group, Groups, read_preamble};
use crate::container::scan::{Message, SegmentReader};
use crate::container::segment::{Preamble, Segment};
use crate::fs::Fs;
use crate::msgs::frame_set::Checkpoint;
use crate::msgs::schemas::Schema;
use crate::msgs::{frame_info, image, tf};
use crate::recorder::topics::SESSION_METADATA;
use crate::{Error, ErrorKind, Result, Session};
use core::ops::ControlFlow;
use depthrig_bus::{FrameHeader, StreamId};
use std::collections::BTreeMap;
use std::path::Path;

/// Whether the session in a segment has the calibration of `session`. Only the head of the file is read.
pub(super) fn says(fs: &dyn Fs, path: &Path, session: &Session) -> Result<bool> {
    let reader = SegmentReader::open_bare(fs, path)?;
    let (preamble, _) = read_preamble(&reader)?;
    let own = embedded(&preamble, path)?;
    Ok(Calibrations::of(&own) == Calibrations::of(session) && own.calibration == session.calibration)
}

fn embedded(preamble: &Preamble, path: &Path) -> Result<Session> {
    let facts = preamble.metadata.iter().find(|(name, _)| name == SESSION_METADATA);
    let text = facts.and_then(|(_, m)| m.get("session_toml")).map(String::as_str).unwrap_or_default();
    Session::from_toml(text, path)
}

/// Copies the segment `path` to the new file `to`, which is durable then.
pub(super) fn copy(
    fs: &dyn Fs,
    path: &Path,
    to: &Path,
    session: &Session,
    progress: &mut dyn FnMut(u64) -> ControlFlow<()>,
) -> Result<()> {
    let reader = SegmentReader::open(fs, path)?;
    let (mut preamble, first) = read_preamble(&reader)?;
    let mut groups = Groups::new(&reader, &preamble, first)?;
    let roles = roles(&preamble);
    calibrate_preamble(&mut preamble, path, session)?;
    let segment = Segment::create_as(fs, to, path.to_owned(), &preamble)?;
    let mut rewriter = Rewriter { reader: &reader, roles, session, builder: ChunkBuilder::new(), segment };
    while let Some(group) = groups.next()? {
        rewriter.group(&group)?;
        if progress(groups.offset()).is_break() {
            return Err(Error::new(ErrorKind::Cancelled, "it was interrupted; nothing was changed"));
        }
    }
    rewriter.segment.seal()?;
    Ok(())
}

/// Contents of a channel that speak of calibration, or of the file.
#[derive(Debug, Clone)]
enum Role {
    TfStatic,
    CameraInfo(StreamId),
    FrameInfo(StreamId),
    Checkpoint,
}

fn roles(preamble: &Preamble) -> BTreeMap<u16, Role> {
    let schemas: BTreeMap<u16, &str> = preamble.schemas.iter().map(|s| (s.id, s.name.as_str())).collect();
    let role = |channel: &crate::container::record::Channel| {
        let is = |s: Schema| schemas.get(&channel.schema) == Some(&s.name());
        let stream = || channel.metadata.get("stream").and_then(|s| s.parse().ok());
        match () {
            () if is(Schema::TfMessage) => Some(Role::TfStatic),
            () if is(Schema::Checkpoint) => Some(Role::Checkpoint),
            () if is(Schema::CameraInfo) => stream().map(Role::CameraInfo),
            () if is(Schema::FrameInfo) => stream().map(Role::FrameInfo),
            () => None,
        }
    };
    preamble.channels.iter().filter_map(|c| Some((c.id, role(c)?))).collect()
}

/// The session's copy and the channels' metadata.
fn calibrate_preamble(preamble: &mut Preamble, path: &Path, session: &Session) -> Result<()> {
    let mut own = embedded(preamble, path)?;
    for stream in &mut own.streams {
        if let Some(now) = session.streams.iter().find(|s| s.id == stream.id) {
            stream.clone_from(now);
        }
    }
    for unit in &mut own.motion {
        if let Some(now) = session.motion.iter().find(|u| u.id == unit.id) {
            unit.clone_from(now);
        }
    }
    own.calibration.clone_from(&session.calibration);
    own.history.clone_from(&session.history);
    let text = own.to_toml()?;
    for (_, facts) in preamble.metadata.iter_mut().filter(|(name, _)| name == SESSION_METADATA) {
        facts.insert("session_toml".to_owned(), text.clone());
    }
    let images = own.streams.iter().map(|s| (s.id.to_string(), &s.calibration));
    let units = own.motion.iter().map(|u| (u.id.to_string(), &u.calibration));
    let calibrations: BTreeMap<String, &String> = images.chain(units).collect();
    for channel in &mut preamble.channels {
        let now = channel.metadata.get("stream").and_then(|s| calibrations.get(s));
        if let Some(now) = now.filter(|_| channel.metadata.contains_key("calibration")) {
            channel.metadata.insert("calibration".to_owned(), (*now).clone());
        }
    }
    Ok(())
}

struct Rewriter<'a> {
    reader: &'a SegmentReader,
    roles: BTreeMap<u16, Role>,
    session: &'a Session,
    builder: ChunkBuilder,
    segment: Segment,
}

impl Rewriter<'_> {
    fn group(&mut self, group: &Group) -> Result<()> {
        match group {
            Group::Set(set) => {
                // Written together: a set without its commit mark is torn.
                let mut repacked: Vec<Chunk> = Vec::new();
                for (chunk, offset) in set.chunks.iter().zip(&set.offsets) {
                    if self.is_concerned(chunk) {
                        repacked.push(self.repack(chunk, *offset)?);
                    } else {
                        self.segment.append_chunks(std::slice::from_ref(chunk))?;
                    }
                }
                self.segment.append_chunks(&repacked)
            }
            Group::Between(between) if self.is_concerned(&between.chunk) => {
                let chunk = self.repack(&between.chunk, between.offset)?;
                self.segment.append_chunks(&[chunk])
            }
            Group::Between(_) | Group::Metadata(..) => self.segment.append_group(group),
            Group::Damage(damage) => Err(Error::new(
                ErrorKind::Corrupt,
                format!(
                    "{} is damaged at byte {}: {}; run `depthrig recover` first; nothing was changed",
                    self.reader.path.display(),
                    damage.from,
                    damage.why
                ),
            )),
        }
    }

    fn is_concerned(&self, chunk: &Chunk) -> bool {
        chunk.messages.iter().any(|(channel, ..)| self.roles.contains_key(channel))
    }

    /// The chunk with its messages about calibration replaced.
    fn repack(&mut self, chunk: &Chunk, offset: u64) -> Result<Chunk> {
        let (file_bytes, crc32) = self.segment.checkpoint();
        let checkpoint = Checkpoint { file_bytes, crc32 };
        let Self { reader, roles, session, builder, .. } = self;
        reader.chunk_messages(chunk.body(), offset, |m| {
            let head = MessageHead {
                channel: m.channel,
                sequence: m.sequence,
                log_time: m.log_time,
                publish_time: m.publish_time,
            };
            builder.message(head, |to| rewrite(to, &m, roles.get(&m.channel), session, &checkpoint))?;
            Ok(())
        })?;
        self.builder.pack(true)
    }
}

/// Writes a message as it is to be.
fn rewrite(
    to: &mut Vec<u8>,
    m: &Message<'_>,
    role: Option<&Role>,
    session: &Session,
    checkpoint: &Checkpoint,
) -> Result<()> {
    let stream = |id: &StreamId| session.streams.iter().find(|s| s.id == *id);
    match role {
        Some(Role::TfStatic) => tf::write(to, m.log_time as i64, session),
        Some(Role::Checkpoint) => checkpoint.write(to, m.log_time as i64),
        Some(Role::CameraInfo(id)) => match stream(id) {
            Some(record) => {
                let mut r = Reader::new(m.data)?;
                let stamp_utc_ns = r.time()?;
                let frame_id = r.str()?;
                let header = FrameHeader {
                    height: r.u32()?,
                    width: r.u32()?,
                    intrinsics: record.intrinsics,
                    ..FrameHeader::default()
                };
                image::write_camera_info(to, stamp_utc_ns, frame_id, &header);
            }
            None => to.extend_from_slice(m.data),
        },
        Some(Role::FrameInfo(id)) => {
            let (mut header, extra) = frame_info::read(m.data)?;
            if let Some(record) = stream(id) {
                header.intrinsics = record.intrinsics;
                header.pose = record.pose;
            } else if let Some(unit) = session.motion.iter().find(|u| u.id == *id) {
                header.pose = unit.pose;
            }
            frame_info::write(to, &header, &extra);
        }
        None => to.extend_from_slice(m.data),
    }
    Ok(())
}
