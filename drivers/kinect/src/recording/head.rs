//! All of a recording but its clusters: the elements before the first one, and those behind that its table names.

use super::element_name;
use super::source::ReadAt;
use crate::ebml::{self, Head, MAX_HEAD, id};
use depthrig_driver::{Error, ErrorKind, Result};

/// The most that one of these elements may have; a calibration has 4 kB and ten thousand tags have 1 MB.
const MAX_ELEMENT: u64 = 32 << 20;
/// The most elements before the first cluster that are looked at.
const MAX_ELEMENTS: usize = 10_000;

/// The bodies of a recording's elements, and where its clusters are.
pub(super) struct Parts {
    pub(super) info: Vec<u8>,
    pub(super) tracks: Vec<u8>,
    pub(super) tags: Vec<u8>,
    pub(super) attachments: Vec<u8>,
    /// Where the index is, if the file has one.
    pub(super) cues: Option<u64>,
    /// Where positions in the file count from.
    pub(super) origin: u64,
    /// Where the first cluster is.
    pub(super) clusters: u64,
    /// Where the last one ends at the latest.
    pub(super) end: u64,
    /// Whether the file ends before it says that it does.
    pub(super) is_cut: bool,
}

/// Reads the head of the element at `at`; `None` without an element there.
pub(super) fn head_at(source: &dyn ReadAt, at: u64, end: u64) -> std::io::Result<Option<Head>> {
    let mut bytes = [0; MAX_HEAD];
    let there = end.saturating_sub(at).min(MAX_HEAD as u64) as usize;
    if there == 0 {
        return Ok(None);
    }
    let bytes = bytes.get_mut(..there).unwrap_or_default();
    source.read_at(at, bytes)?;
    Ok(ebml::head(bytes))
}

struct Reader<'a> {
    source: &'a dyn ReadAt,
    name: &'a str,
    end: u64,
}

impl Reader<'_> {
    fn bad(&self, what: impl core::fmt::Display) -> Error {
        Error::new(ErrorKind::BadInput, format!("{}: {what}", self.name))
    }

    fn io(&self, e: std::io::Error) -> Error {
        Error::new(ErrorKind::Io, format!("{}: {e}", self.name)).with_source(e)
    }

    fn head(&self, at: u64) -> Result<Option<Head>> {
        head_at(self.source, at, self.end).map_err(|e| self.io(e))
    }

    /// The body of the element at `at` with this head.
    fn body(&self, at: u64, head: Head) -> Result<Vec<u8>> {
        let from = at + head.len as u64;
        let size = head.size.unwrap_or(u64::MAX);
        let left = self.end.saturating_sub(from);
        if size > left.min(MAX_ELEMENT) {
            let name = element_name(head.id);
            let what = if size > left { "the file is cut off or damaged" } else { "the file is damaged" };
            return Err(self.bad(format_args!(
                "{name} at byte {at} claims {size} bytes where {left} are left: {what} before its first image"
            )));
        }
        let mut body = vec![0; size as usize];
        self.source.read_at(from, &mut body).map_err(|e| self.io(e))?;
        Ok(body)
    }
}

/// Reads them.
pub(super) fn read(source: &dyn ReadAt, name: &str) -> Result<Parts> {
    let mut r = Reader { source, name, end: source.size() };
    if r.end == 0 {
        return Err(r.bad("the file is empty, and so not a Matroska file (.mkv)"));
    }
    let start = r.head(0)?.filter(|h| h.id == id::EBML);
    let Some(start) = start else { return Err(r.bad("not a Matroska file (.mkv)")) };
    let doc_type = ebml::child_text(&r.body(0, start)?, id::DOC_TYPE).unwrap_or_default();
    if doc_type != "matroska" && doc_type != "webm" {
        return Err(r.bad(format_args!(
            "it has the EBML document type \"{doc_type}\", so it is not a Matroska file"
        )));
    }
    let at = start.len as u64 + start.size.unwrap_or(0);
    let segment = r.head(at)?.filter(|h| h.id == id::SEGMENT);
    let Some(segment) = segment else {
        return Err(r.bad("a Matroska file without contents: it is cut off or damaged at its start"));
    };
    let origin = at + segment.len as u64;
    let claimed = segment.size.map(|size| origin.saturating_add(size));
    let is_cut = claimed.is_some_and(|end| end > r.end);
    r.end = claimed.unwrap_or(u64::MAX).min(r.end);
    let mut parts = Parts {
        info: Vec::new(),
        tracks: Vec::new(),
        tags: Vec::new(),
        attachments: Vec::new(),
        cues: None,
        origin,
        clusters: 0,
        end: r.end,
        is_cut,
    };
    let mut elsewhere = Vec::new();
    before_clusters(&r, &mut parts, &mut elsewhere)?;
    for (of, at) in elsewhere {
        behind_clusters(&r, &mut parts, of, at);
    }
    Ok(parts)
}

/// Reads what lies before the first cluster; `elsewhere` becomes what the file's table names.
fn before_clusters(r: &Reader<'_>, parts: &mut Parts, elsewhere: &mut Vec<(u32, u64)>) -> Result<()> {
    let mut at = parts.origin;
    for _ in 0..MAX_ELEMENTS {
        let Some(head) = r.head(at)? else { break };
        match head.id {
            id::CLUSTER => {
                parts.clusters = at;
                return Ok(());
            }
            id::SEEK_HEAD => elsewhere.extend(table(&r.body(at, head)?, parts.origin)),
            id::INFO => parts.info = r.body(at, head)?,
            id::TRACKS => parts.tracks = r.body(at, head)?,
            id::TAGS => parts.tags = r.body(at, head)?,
            id::ATTACHMENTS => parts.attachments = r.body(at, head)?,
            id::CUES => parts.cues = Some(at),
            _ => {}
        }
        let next = head.size.and_then(|size| (at + head.len as u64).checked_add(size));
        match next {
            Some(next) if next <= r.end => at = next,
            _ => {
                let name = element_name(head.id);
                return Err(r.bad(format_args!(
                    "{name} at byte {at} reaches beyond the end of the file: it is cut off or damaged before its first \
                     image"
                )));
            }
        }
    }
    Err(r.bad(format_args!(
        "no images: from byte {at} on there is no cluster; the file is cut off or damaged before its first one"
    )))
}

/// The elements that a table names, and where they are.
fn table(body: &[u8], origin: u64) -> impl Iterator<Item = (u32, u64)> + '_ {
    ebml::children(body).filter(|c| c.0 == id::SEEK).filter_map(move |(_, seek)| {
        let of = u32::try_from(ebml::child_uint(seek, id::SEEK_ID)?).ok()?;
        Some((of, origin.checked_add(ebml::child_uint(seek, id::SEEK_POSITION)?)?))
    })
}

/// Reads the elements behind the clusters. Their absence, as in a file that was cut off, is not an error.
fn behind_clusters(r: &Reader<'_>, parts: &mut Parts, of: u32, at: u64) {
    if of == id::CUES {
        parts.cues = parts.cues.or(Some(at));
        return;
    }
    let part = match of {
        id::INFO => &mut parts.info,
        id::TRACKS => &mut parts.tracks,
        id::TAGS => &mut parts.tags,
        id::ATTACHMENTS => &mut parts.attachments,
        _ => return,
    };
    if !part.is_empty() || at < parts.clusters {
        return;
    }
    let head = r.head(at).ok().flatten().filter(|h| h.id == of);
    match head.map(|head| r.body(at, head)) {
        Some(Ok(body)) => *part = body,
        Some(Err(e)) => tracing::warn!("{e}"),
        None => tracing::warn!("{}: no {} at byte {at}, where it should be", r.name, element_name(of)),
    }
}
