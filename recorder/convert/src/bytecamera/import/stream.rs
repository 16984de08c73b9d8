//! One stream of images while it is imported.

use crate::bytecamera::images::{Image, Want};
use depthrig_bus::{DropCounts, FrameHeader};
use depthrig_recorder::{StreamAccount, StreamRecord};
use std::collections::BTreeMap;

/// One kind of file in one folder.
pub(super) struct Stream {
    pub(super) folder: String,
    pub(super) prefix: String,
    pub(super) ending: String,
    pub(super) want: Want,
    /// The name of each number's file where it is not the plain one (`depth_007.png`), and which numbers there are.
    pub(super) files: BTreeMap<u32, Option<String>>,
    pub(super) record: StreamRecord,
    /// The unit of depth is not that of the rows of `frames.csv`: every frame has the stream's.
    pub(super) unit_given: bool,
    pub(super) sequence: u64,
    pub(super) dropped: DropCounts,
    /// The number of the last frame, to see what is missing between it and the next.
    pub(super) last: Option<u32>,
    /// The header of the last frame, where the files say it.
    pub(super) last_header: Option<FrameHeader>,
}

impl Stream {
    pub(super) fn new(
        folder: String,
        prefix: String,
        ending: String,
        want: Want,
        files: BTreeMap<u32, Option<String>>,
        record: StreamRecord,
    ) -> Self {
        let dropped = DropCounts::default();
        Self {
            folder,
            prefix,
            ending,
            want,
            files,
            record,
            unit_given: false,
            sequence: 0,
            dropped,
            last: None,
            last_header: None,
        }
    }

    /// The file of a number, below the folder of the session.
    pub(super) fn path(&self, n: u32) -> String {
        match self.files.get(&n) {
            Some(Some(name)) => format!("{}/{name}", self.folder),
            _ => format!("{}/{}_{n}.{}", self.folder, self.prefix, self.ending),
        }
    }

    /// Refuses an image that is not like the first one.
    pub(super) fn check(&self, image: Image) -> Result<Image, String> {
        let r = &self.record;
        if (image.format, image.width, image.height) == (r.format, r.width, r.height) {
            return Ok(image);
        }
        let said = format!("{}x{} {}", r.width, r.height, r.format.name());
        Err(format!("it is {}x{} {}, its stream is {said}", image.width, image.height, image.format.name()))
    }

    /// Fills in the fields that all frames of the stream share.
    pub(super) fn fill(&self, header: &mut FrameHeader, rig: &str, image: &Image) {
        header.set_names(rig, &self.record.id);
        header.set_device(&self.record.model, &self.record.serial);
        header.set_image(image.format, image.width, image.height);
        (header.intrinsics, header.pose) = (self.record.intrinsics, self.record.pose);
        if self.unit_given {
            header.depth_unit_m = self.record.depth_unit_m;
        }
    }

    pub(super) fn account(&self) -> StreamAccount {
        let (captured, delivered, dropped) = match &self.last_header {
            Some(h) if self.sequence == 0 => {
                (h.captured, h.captured.saturating_sub(h.drops().total()), h.drops())
            }
            _ => (self.sequence + self.dropped.total(), self.sequence, self.dropped),
        };
        StreamAccount { stream: self.record.id.clone(), captured, delivered, dropped }
    }
}
