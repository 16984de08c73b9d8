//! The messages of a segment that wait for the mark of their set.

use super::{Findings, Severity, motion, signals};
use crate::container::scan::HEAD;
use crate::frame::Waiting;
use depthrig_bus::StreamId;
use std::collections::{BTreeMap, BTreeSet};

/// Opcode, length, channel, sequence, log time and publish time of a message.
pub(super) const MESSAGE_HEAD: u64 = HEAD + 2 + 4 + 8 + 8;

/// The messages since the last commit mark, and where findings about them go.
pub(super) struct Seen<'a> {
    pub(super) file: String,
    pub(super) findings: &'a mut Findings,
    /// Images in chunks from here on are unpacked.
    pub(super) unproven: u64,
    pub(super) images: BTreeMap<StreamId, Image>,
    pub(super) infos: BTreeMap<StreamId, (u64, Vec<u8>)>,
    pub(super) calibrated: BTreeSet<StreamId>,
    pub(super) motion: motion::Messages,
    pub(super) signals: signals::Messages,
    /// Bytes of the two.
    pub(super) waiting: Waiting,
}

impl<'a> Seen<'a> {
    pub(super) fn new(file: &str, findings: &'a mut Findings, unproven: u64) -> Self {
        Self {
            file: file.to_owned(),
            findings,
            unproven,
            images: BTreeMap::new(),
            infos: BTreeMap::new(),
            calibrated: BTreeSet::new(),
            motion: motion::Messages::default(),
            signals: signals::Messages::default(),
            waiting: Waiting::default(),
        }
    }

    /// Adds a finding that the segment is broken at `offset`.
    pub(super) fn broken(&mut self, offset: Option<u64>, what: impl Into<String>) {
        self.findings.add(Severity::Broken, &self.file, offset, what);
    }
}

/// An image that waits for the mark of its set.
pub(super) struct Image {
    /// Where its chunk begins.
    pub(super) offset: u64,
    pub(super) channel: u16,
    pub(super) log_time: u64,
    pub(super) len: u64,
    pub(super) proof: Proof,
}

/// The checksum that is known of an image.
pub(super) enum Proof {
    /// The CRC-32 of its message.
    Crc(u32),
    /// The CRC-32 of its message's whole record, as the head of its chunk says; it was not unpacked.
    Packed(u32),
}
