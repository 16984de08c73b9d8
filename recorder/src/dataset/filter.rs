//! A change of pixels as they are read; what is stored stays as it is.

use crate::{Error, ErrorKind, Result};
use depthrig_bus::FrameHeader;
use std::sync::Arc;

/// Changes the decoded pixels of a frame in place, or says why it cannot.
type Apply = dyn Fn(&FrameHeader, &mut [u8]) -> std::result::Result<(), String> + Send + Sync;

/// A change of the pixels of all frames that are read from a dataset ([`crate::Dataset::filtered`]), such as a correction of depth.
#[derive(Clone)]
pub struct PixelFilter {
    name: Arc<str>,
    apply: Arc<Apply>,
}

impl PixelFilter {
    /// A filter. `name` states in one line what it does; equal filters have equal names.
    pub fn new(
        name: &str,
        apply: impl Fn(&FrameHeader, &mut [u8]) -> std::result::Result<(), String> + Send + Sync + 'static,
    ) -> Self {
        Self { name: name.into(), apply: Arc::new(apply) }
    }

    /// Its description.
    pub fn name(&self) -> &str {
        &self.name
    }

    pub(crate) fn apply(&self, header: &FrameHeader, pixels: &mut [u8]) -> Result<()> {
        (self.apply)(header, pixels).map_err(|why| {
            let frame = format!("frame {} of {}/{}", header.sequence, header.camera(), header.stream());
            Error::new(ErrorKind::BadInput, format!("{frame}: {why}"))
        })
    }
}

impl core::fmt::Debug for PixelFilter {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_tuple("PixelFilter").field(&self.name).finish()
    }
}
