//! A folder of images that plays as a camera (`files`).

use super::{BackendConfig, CameraSettings, Family, Offered, OpenContext, Reader, Source};
use crate::config::value::{not_empty, rate, resolve};
use depthrig_driver::{Backend, Result, StreamRequest};
use depthrig_sim::files::{FilesBackend, FilesConfig};
use std::path::PathBuf;

pub(super) const FAMILY: Family = Family::new("files", read);

fn read(r: &Reader<'_>) -> Option<BackendConfig> {
    let s = r.section;
    let manifest = s.required::<PathBuf>("manifest", "\"images/camera.toml\"");
    if let Some(Err(why)) = manifest.as_ref().map(|m| not_empty(&m.value)) {
        s.problem(manifest.as_ref()?.at, format!("{} {why}", s.key_of("manifest")));
    }
    let rate_hz = s.or("rate_hz", None, |r| r.map_or(Ok(()), rate));
    let looped = s.get::<bool>("loop").map(|f| f.value);
    Some(BackendConfig::new(FilesConfig { manifest: resolve(r.base, &manifest?.value), rate_hz, looped }))
}

impl CameraSettings for FilesConfig {
    fn name(&self) -> &'static str {
        FAMILY.name
    }

    fn driver(&self, _: &OpenContext<'_>) -> Result<Box<dyn Backend>> {
        Ok(Box::new(FilesBackend::new(self.clone())))
    }

    fn source(&self) -> Source<'_> {
        Source::Here(FilesBackend::new(self.clone()).open(None).map(|device| Offered {
            device: format!("images of {}", device.info().port),
            profiles: device.profiles().to_vec(),
        }))
    }

    fn fastest_rate_hz(&self, _: &[StreamRequest]) -> Option<f64> {
        self.rate_hz
    }

    fn reads_files(&self) -> bool {
        true
    }

    fn check_input(&self) -> Result<()> {
        FilesBackend::new(self.clone()).discover().map(drop)
    }
}
