//! The thread that measures now and then whether the rows of the rectified images agree, and has them moved where they
//! do not. It runs beside the threads with deadlines.

use super::newest::Newest;
use super::pair::Views;
use super::{Descriptions, Notice, StereoOptions};
use depthrig_bus::sync::lock;
use depthrig_calib::Rectifier;
use depthrig_calib::stereo::{Gray, RowCheck, RowOffset, StereoPair};
use std::sync::{Arc, Mutex};

/// Pairs from one look to the next until as many were looked at as count at once.
const FIRST_EVERY: u64 = 10;
/// The same from then on: ten seconds of 30 Hz. Heat and a knock change rows, and neither is in a hurry.
const EVERY: u64 = 300;
/// Pairs that must have been looked at before anything is reported: two cameras that do not expose at one moment differ
/// in rows when the rig moves, in one pair up and in the next one down.
const LOOKS: usize = 3;

/// Whether pair number `pair`, from 1, is looked at.
pub(super) const fn is_looked_at(pair: u64) -> bool {
    let every = if pair <= FIRST_EVERY * RowCheck::PAIRS as u64 { FIRST_EVERY } else { EVERY };
    pair.is_multiple_of(every)
}

/// A rectifier on its way from the thread that measures rows to the one that rectifies.
#[derive(Debug, Default)]
pub(super) struct Corrected(Mutex<Option<Rectifier>>);

impl Corrected {
    /// The rectifier that is to be used from now on, if there is a new one.
    pub(super) fn take(&self) -> Option<Rectifier> {
        lock(&self.0).take()
    }

    fn put(&self, rectifier: Rectifier) {
        *lock(&self.0) = Some(rectifier);
    }
}

/// The thread's work.
pub(super) struct Rows {
    camera: String,
    size: (usize, usize),
    check: RowCheck,
    input: Arc<Newest<Arc<Views>>>,
    rectifier: Rectifier,
    corrected: Arc<Corrected>,
    /// How many rectifiers were handed over, and what the last one moves rows by.
    corrections: u64,
    moved: Option<RowOffset>,
    notice: Notice,
    computed: Descriptions,
    /// It was logged.
    said: bool,
}

impl Rows {
    /// For the pairs of one start of `camera`. What was said of an earlier start is taken back.
    pub(super) fn new(
        camera: &str,
        rectifier: &Rectifier,
        input: &Arc<Newest<Arc<Views>>>,
        corrected: &Arc<Corrected>,
        options: &StereoOptions,
    ) -> Self {
        let size = rectifier.size();
        let size = (size.0 as usize, size.1 as usize);
        let rows = Self {
            camera: camera.to_owned(),
            size,
            check: RowCheck::new(size.0, size.1),
            input: Arc::clone(input),
            rectifier: rectifier.clone(),
            corrected: Arc::clone(corrected),
            corrections: 0,
            moved: None,
            notice: Arc::clone(&options.notice),
            computed: Arc::clone(&options.computed),
            said: false,
        };
        rows.report(None);
        rows
    }

    /// Looks at what is put into its box until that is closed.
    pub(super) fn run(mut self) {
        while let Some(views) = self.input.take() {
            if views.corrections != self.corrections {
                // Rectified before the correction that is in force now.
                continue;
            }
            let gray = |image| Gray::packed(image, self.size.0, self.size.1);
            let pair = StereoPair::new(gray(&views.left), gray(&views.right));
            if let Err(e) = self.check.look(&pair) {
                tracing::debug!(camera = self.camera, error = %e, "the rows of a pair were not looked at");
            }
            drop(views);
            // Images that say nothing take back nothing.
            let Some(offset) = self.check.offset().filter(|o| o.pairs >= LOOKS) else { continue };
            tracing::debug!(camera = self.camera, "rows: {offset}");
            if offset.is_significant() {
                self.correct(&offset);
            }
        }
    }

    /// Has the rows moved by what was measured beyond what they are moved by.
    fn correct(&mut self, rest: &RowOffset) {
        let total = self.moved.map_or(*rest, |moved| moved.with_rest(rest));
        self.rectifier.correct_rows(&total);
        self.corrected.put(self.rectifier.clone());
        self.corrections += 1;
        self.moved = Some(total);
        // Earlier measurements are of other rows.
        self.check = RowCheck::new(self.size.0, self.size.1);
        self.describe(&total);
        tracing::info!(camera = self.camera, "the right image's rows are moved: {total}");
        let warning = total.warning(true);
        if let Some(text) = warning.as_ref().filter(|_| !self.said) {
            self.said = true;
            tracing::warn!(camera = self.camera, "{text}");
        }
        self.report(warning);
    }

    /// States the correction with what is computed, for the datasets that are recorded from now on.
    fn describe(&self, total: &RowOffset) {
        let mut all = lock(&self.computed);
        for description in all.values_mut() {
            let words = description.parameters.split(' ').filter(|word| !word.starts_with("rows_moved_px="));
            let kept = words.collect::<Vec<_>>().join(" ");
            description.parameters = format!("{kept} {}", total.describe_correction());
        }
    }

    fn report(&self, warning: Option<String>) {
        *lock(&self.notice) = warning;
    }
}
