//! The head of a segment, all before its first chunk: proven, or rebuilt.
//!
//! A checksum over all bytes before the first chunk proves a head as it stands. Without one, such as after damage
//! or in the first second of a recording, the head is compared with the one that the recorder writes for this session,
//! and that one is taken where they differ.

use crate::container::MAGIC;
use crate::container::copy::{Group, Groups, SetGroup, read_preamble};
use crate::container::scan::SegmentReader;
use crate::container::segment::Preamble;
use crate::dataset::segment_number;
use crate::encode::Codec;
use crate::fs::Fs;
use crate::msgs::frame_info;
use crate::recorder::topics::{SEGMENT_METADATA, SESSION_METADATA, Topics, image_channel};
use crate::{ColorCodec, DepthCodec, RecorderOptions, Result, Session};
use std::path::{Path, PathBuf};

/// The head of a segment.
pub(super) struct Head {
    pub(super) preamble: Preamble,
    /// Where the first chunk begins, or may begin.
    pub(super) first: u64,
    /// Whether it differs from the head in the file.
    pub(super) rebuilt: bool,
}

/// The head as it stands in the file; `None` where it cannot be read or names no session.
pub(super) fn own_head(reader: &SegmentReader) -> Result<Option<Head>> {
    if reader.size < MAGIC.len() as u64 || reader.read(0, MAGIC.len() as u64)? != MAGIC {
        return Ok(None);
    }
    let (preamble, first) = match read_preamble(reader) {
        Ok(found) => found,
        Err(e) if e.is_damage() => return Ok(None),
        Err(e) => return Err(e),
    };
    let head = Head { preamble, first, rebuilt: false };
    Ok(session_in(&head.preamble, reader).is_some().then_some(head))
}

/// The head as it stands in the file, if a checksum proves it.
pub(super) fn proven_head(reader: &SegmentReader) -> Result<Option<Head>> {
    let Some(head) = own_head(reader)? else { return Ok(None) };
    let proven = Groups::new(reader, &head.preamble, head.first)?.proves_head();
    Ok(proven.then_some(head))
}

/// The session that a head names.
pub(super) fn session_in(preamble: &Preamble, reader: &SegmentReader) -> Option<Session> {
    let metadata = preamble.metadata.iter().find(|(name, _)| name == SESSION_METADATA);
    let text = metadata.and_then(|(_, m)| m.get("session_toml"))?;
    Session::from_toml(text, &reader.path).ok()
}

/// Finds the head that a segment should have.
pub(super) struct HeadSearch<'a> {
    pub(super) fs: &'a dyn Fs,
    /// The segment.
    pub(super) path: &'a Path,
    /// All segments of the dataset.
    pub(super) segments: &'a [PathBuf],
    pub(super) session: &'a Session,
}

impl HeadSearch<'_> {
    /// The head for a copy of `reader`, its own one unless it should be `foreign`.
    pub(super) fn run(&self, reader: &SegmentReader, foreign: bool) -> Result<Head> {
        let own = if foreign { None } else { own_head(reader)? };
        let Some(own) = own else {
            let first = MAGIC.len().min(reader.size as usize) as u64;
            let preamble = self.made_head(reader, self.session, None, first)?;
            return Ok(Head { preamble, first, rebuilt: true });
        };
        if Groups::new(reader, &own.preamble, own.first)?.proves_head() {
            return Ok(own);
        }
        let named = session_in(&own.preamble, reader).filter(|s| s.has_streams_of(self.session));
        let made =
            self.made_head(reader, named.as_ref().unwrap_or(self.session), Some(&own.preamble), own.first)?;
        let preamble = mended(&own.preamble, made, named.is_some());
        let rebuilt = preamble != own.preamble;
        Ok(Head { preamble, first: own.first, rebuilt })
    }

    /// The head that this segment should have: that of another one, or that which the recorder writes for the session.
    /// Without a set nothing shows how images are stored; its `own` head does.
    fn made_head(
        &self,
        reader: &SegmentReader,
        session: &Session,
        own: Option<&Preamble>,
        first: u64,
    ) -> Result<Preamble> {
        let number = segment_number(&self.path.file_name().unwrap_or_default().to_string_lossy());
        for other in self.segments.iter().filter(|p| *p != self.path) {
            let other = SegmentReader::open_any(self.fs, other)?;
            let Some(mut head) = proven_head(&other)? else { continue };
            if session_in(&head.preamble, &other)
                .is_some_and(|s| s.has_streams_of(session) && s.signals.len() >= session.signals.len())
            {
                // What an empty segment says of itself at its end has no chunk before it either.
                head.preamble.metadata.retain(|(name, _)| name != SEGMENT_METADATA);
                for (_, map) in head.preamble.metadata.iter_mut().filter(|(name, _)| name == SESSION_METADATA)
                {
                    map.insert("segment".to_owned(), number.unwrap_or_default().to_string());
                }
                return Ok(head.preamble);
            }
        }
        let preamble = |options: &RecorderOptions| {
            let mut session = session.clone();
            session.outcome = None;
            Topics::new(&session, options).preamble(&session, number.unwrap_or_default())
        };
        // How images are stored decides the types of their channels; the first set shows it.
        let mut options = RecorderOptions::default();
        let guess = preamble(&options)?;
        let mut groups = Groups::new(reader, &guess, first)?;
        while let Some(group) = groups.next()? {
            if let Group::Set(set) = group {
                codecs(reader, &set, session, &mut options)?;
                return preamble(&options);
            }
        }
        let same_ids =
            |own: &Preamble| own.channels.iter().map(|c| c.id).eq(guess.channels.iter().map(|c| c.id));
        let channels = own.filter(|own| same_ids(own)).map(|own| own.channels.clone());
        Ok(Preamble { channels: channels.unwrap_or(guess.channels), ..guess })
    }
}

/// The head `own`, corrected to that of the recorder, `made`. Extra keys of `own` are kept: another version may have
/// more metadata. The texts of the session differ by later notes and edits; `own` has the text of its time, if it
/// `names` the session.
fn mended(own: &Preamble, made: Preamble, names: bool) -> Preamble {
    let mut mended = made;
    for (name, map) in &mut mended.metadata {
        let Some((_, said)) = own.metadata.iter().find(|(n, _)| n == name) else { continue };
        let kept = said.iter().filter(|(k, _)| !map.contains_key(*k) || (names && *k == "session_toml"));
        map.extend(kept.map(|(k, v)| (k.clone(), v.clone())).collect::<Vec<_>>());
    }
    mended
}

/// Finds out how the images of a set are stored.
fn codecs(
    reader: &SegmentReader,
    set: &SetGroup,
    session: &Session,
    options: &mut RecorderOptions,
) -> Result<()> {
    let (Some(chunk), Some(offset)) = (set.chunks.last(), set.offsets.last()) else { return Ok(()) };
    reader.chunk_messages(chunk.body(), *offset, |m| {
        let stream = session.streams.iter().enumerate().find(|(i, _)| image_channel(*i) + 2 == m.channel);
        let Some((_, stream)) = stream else { return Ok(()) };
        let (header, extra) = frame_info::read(m.data)?;
        let stored = Codec::from_name(extra.codec);
        if header.format != stream.format as u32 {
            return Ok(());
        }
        let agrees = |to: &RecorderOptions| Some(Codec::of(stream.format, to)) == stored;
        let colors = [ColorCodec::Jpeg, ColorCodec::Raw, ColorCodec::Png]
            .map(|color| RecorderOptions { color, ..options.clone() });
        let depths =
            [DepthCodec::Zstd, DepthCodec::Rank].map(|depth| RecorderOptions { depth, ..options.clone() });
        if !agrees(options)
            && let Some(found) = colors.into_iter().chain(depths).find(agrees)
        {
            *options = found;
        }
        Ok(())
    })
}
