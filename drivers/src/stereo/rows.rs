//! The thread that measures now and then whether the rows of the rectified eyes agree, beside those that have to be in time.

use super::crew::Views;
use super::newest::Newest;
use super::{Geometry, Notice};
use depthrig_calib::stereo::{Gray, RowCheck, StereoPair};
use std::sync::{Arc, PoisonError};

/// Pairs from one look to the next until as many were looked at as count at once.
const FIRST_EVERY: u64 = 10;
/// The same from then on: ten seconds of 30 Hz. Heat and a knock change rows, and neither is in a hurry.
const EVERY: u64 = 300;
/// Pairs that must have been looked at before anything is said: two eyes that do not expose at one moment differ in rows when
/// the camera moves, in one pair up and in the next one down.
const LOOKS: usize = 3;

/// Whether pair number `pair`, from 1, is looked at.
pub(super) const fn is_looked_at(pair: u64) -> bool {
    let every = if pair <= FIRST_EVERY * RowCheck::PAIRS as u64 { FIRST_EVERY } else { EVERY };
    pair.is_multiple_of(every)
}

/// The thread's work.
pub(super) struct Rows {
    camera: String,
    size: (usize, usize),
    check: RowCheck,
    input: Arc<Newest<Arc<Views>>>,
    notice: Notice,
    /// It was logged.
    said: bool,
}

impl Rows {
    /// For the pairs of one start of `camera`. What was said of an earlier start is taken back.
    pub(super) fn new(
        camera: &str,
        geometry: &Geometry,
        input: Arc<Newest<Arc<Views>>>,
        notice: &Notice,
    ) -> Self {
        let size = (geometry.width, geometry.height);
        let rows = Self {
            camera: camera.to_owned(),
            size,
            check: RowCheck::new(size.0, size.1),
            input,
            notice: Arc::clone(notice),
            said: false,
        };
        rows.tell(None);
        rows
    }

    /// Looks at what is put into its box until that is closed.
    pub(super) fn run(mut self) {
        while let Some(views) = self.input.take() {
            let eye = |picture| Gray::packed(picture, self.size.0, self.size.1);
            let pair = StereoPair::new(eye(&views.left), eye(&views.right));
            if let Err(e) = self.check.look(&pair) {
                tracing::debug!(camera = self.camera, error = %e, "the rows of a pair were not looked at");
            }
            drop(views);
            // Pictures that say nothing take back nothing.
            let Some(offset) = self.check.offset().filter(|o| o.pairs >= LOOKS) else { continue };
            let warning = offset.warning();
            tracing::debug!(camera = self.camera, "rows: {offset}");
            if let Some(text) = warning.as_ref().filter(|_| !self.said) {
                self.said = true;
                tracing::warn!(camera = self.camera, "{text}");
            }
            self.tell(warning);
        }
    }

    fn tell(&self, warning: Option<String>) {
        *self.notice.lock().unwrap_or_else(PoisonError::into_inner) = warning;
    }
}
