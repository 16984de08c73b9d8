//! Streams as `calibration.json` describes them.

use super::files::FoundFiles;
use super::stream::Stream;
use super::{ByteCameraImport, bad};
use crate::bytecamera::CALIBRATION_FILE;
use crate::bytecamera::calibration::Calibration;
use crate::bytecamera::images::Want;
use depthrig_bus::PixelFormat;
use depthrig_recorder::Result;

impl ByteCameraImport {
    /// Streams as `calibration.json` describes them.
    pub(super) fn described(&mut self, calibration: Calibration, mut found: FoundFiles) -> Result<()> {
        for s in calibration.streams {
            let files = found.remove(&(s.folder.clone(), s.prefix.clone(), s.ending.clone()));
            for copy in &s.copies {
                found.remove(&(copy.clone(), s.prefix.clone(), s.ending.clone()));
            }
            let mut record = s.stream;
            let given = self.given_unit(record.id.camera.as_str(), &s.folder);
            let given = given.filter(|_| record.format == PixelFormat::Z16);
            if let Some(unit) = given.filter(|u| *u != record.depth_unit_m) {
                let said = std::mem::replace(&mut record.depth_unit_m, unit);
                let id = &record.id;
                self.state(format!("{id}: depth unit {unit} m as given, {CALIBRATION_FILE} says {said}"));
            }
            let want = Want::Exactly(record.format, record.width, record.height);
            let files = files.unwrap_or_default();
            let mut stream = Stream::new(s.folder, s.prefix, s.ending, want, files, record);
            stream.unit_given = given.is_some();
            self.streams.push(stream);
        }
        self.session = calibration.session;
        if self.streams.is_empty() {
            return Err(bad(&self.dir.join(CALIBRATION_FILE), "it names no streams"));
        }
        self.state(format!("intrinsics, poses and depth units are those of {CALIBRATION_FILE}"));
        for ((folder, prefix, ending), files) in found {
            self.state(format!(
                "{folder}/{prefix}_N.{ending}: {} files that {CALIBRATION_FILE} does not name are left out",
                files.len()
            ));
        }
        Ok(())
    }
}
