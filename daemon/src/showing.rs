//! Datasets on the live page of a running rig: each is a replay on channels of its own, in a folder where no other program looks for rigs.

use crate::control::{Shown, Shows};
use crate::replay::{Replay, ReplayOptions};
use crate::{Error, ErrorKind, Result};
use depthrig_bus::sync::lock;
use depthrig_bus::{Bus, RigName, RuntimeDir};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, Weak};

/// The folder of their channels, below the rig's.
const FOLDER: &str = "shown";

/// Shows one dataset at a time.
pub struct Showing {
    runtime: RuntimeDir,
    rig: RigName,
    shown: Mutex<Option<Current>>,
}

struct Current {
    dataset: PathBuf,
    shown: Weak<Shown>,
}

impl Showing {
    /// For the rig `rig`, whose lock the caller holds. Channels that an earlier daemon left are removed.
    ///
    /// # Errors
    /// Those of making a folder below `runtime`.
    pub fn new(runtime: &RuntimeDir, rig: &RigName) -> Result<Self> {
        let runtime = RuntimeDir::at(&runtime.path().join(FOLDER))?;
        Bus::open(&runtime, rig)?.clean_dead();
        Ok(Self { runtime, rig: rig.clone(), shown: Mutex::default() })
    }
}

impl Shows for Showing {
    fn show(&self, dataset: &Path) -> Result<Arc<Shown>> {
        let mut current = lock(&self.shown);
        if let Some(Current { dataset: before, shown }) = current.as_ref()
            && let Some(shown) = shown.upgrade()
        {
            if before == dataset {
                return Ok(shown);
            }
            let before = before.display();
            let what =
                format!("another page shows {before}; one dataset is shown at a time, close that page first");
            return Err(Error::new(ErrorKind::InUse, what));
        }
        let options = ReplayOptions { hold: true, in_background: true, ..ReplayOptions::default() };
        let replay = Replay::start(&[dataset.to_owned()], &self.runtime, Some(self.rig.clone()), options)?;
        let shown = Arc::new(Shown {
            control: replay.control(),
            runtime: self.runtime.clone(),
            rig: self.rig.clone(),
            replay: Box::new(replay),
        });
        *current = Some(Current { dataset: dataset.to_owned(), shown: Arc::downgrade(&shown) });
        Ok(shown)
    }
}
