//! Rendering beside the cameras: they stream at once, coarse images of a standing mount first, and show the moving
//! scene as soon as it is rendered. What is in the cache is not rendered.

use super::config::SyntheticConfig;
use super::profiles::default_profiles;
use super::render::{Album, Images, Scene};
use core::time::Duration;
use depthrig_bus::sync::lock;
use depthrig_driver::{Error, ErrorKind, Result, StreamProfile};
use std::collections::{HashMap, HashSet, VecDeque};
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard};

/// Capture and what it serves go first; but beside a busy computer it must come to an end.
const NICE: i32 = 5;
/// From one look for work to the next.
const LOOK: Duration = Duration::from_millis(50);

/// The scenes that several cameras wait for.
#[derive(Debug, Default)]
pub struct Drawing(Mutex<State>);

#[derive(Debug, Default)]
struct State {
    to_do: VecDeque<Arc<Scene>>,
    /// Files that are, were or will be rendered.
    wanted: HashSet<PathBuf>,
    /// By the path of the file: depth and true depth share one.
    albums: HashMap<PathBuf, Arc<Album>>,
    done: usize,
    total: usize,
    error: Option<String>,
}

/// How far the rendering is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DrawingProgress {
    /// Images rendered.
    pub done: usize,
    /// Images to be rendered.
    pub total: usize,
    /// Why there will be no more.
    pub error: Option<String>,
}

impl Drawing {
    /// How far it is; `None` when there is nothing to render.
    pub fn progress(&self) -> Option<DrawingProgress> {
        let state = self.lock();
        let progress = DrawingProgress { done: state.done, total: state.total, error: state.error.clone() };
        (progress.done < progress.total).then_some(progress)
    }

    /// Plans the scenes of the camera's usual streams, so that [`Self::progress`] knows of them before the camera
    /// opens.
    ///
    /// # Errors
    /// Those of a wrong configuration.
    pub fn plan(&self, config: &SyntheticConfig) -> Result<()> {
        for profile in default_profiles(config)? {
            if config.cheap || profile.format.is_motion() {
                continue;
            }
            let scene = Scene::new(config, &profile)?;
            if scene.cached().is_none() {
                want(&mut self.lock(), scene);
            }
        }
        Ok(())
    }

    /// The images of a stream: out of the cache, or a sketch until [`Self::run`] has rendered it.
    pub(crate) fn images(&self, config: &SyntheticConfig, profile: &StreamProfile) -> Result<Images> {
        let scene = Scene::new(config, profile)?;
        if let Some(album) = self.lock().albums.get(&scene.path) {
            return Ok(scene.images(album));
        }
        if let Some(file) = scene.cached() {
            let album = Album::default();
            album.finish(file);
            return Ok(scene.images(&Arc::new(album)));
        }
        let album = Arc::new(Album::sketched(scene.sketch()));
        let images = scene.images(&album);
        let mut state = self.lock();
        // It may have been rendered meanwhile.
        if let Some(file) = scene.cached() {
            album.finish(file);
            return Ok(images);
        }
        state.albums.insert(scene.path.clone(), album);
        want(&mut state, scene);
        Ok(images)
    }

    /// Renders what cameras ask for, until `stop`; for a thread of its own.
    ///
    /// # Errors
    /// [`ErrorKind::Io`] when its threads cannot be started.
    pub fn run(&self, stop: &AtomicBool) -> Result<()> {
        let politely = |_| {
            // On Linux this is the calling thread. Being refused costs nothing but the politeness.
            let _ = rustix::process::setpriority_process(None, NICE);
        };
        let threads =
            rayon::ThreadPoolBuilder::new().thread_name(|i| format!("draw-{i}")).start_handler(politely);
        let threads = threads.build().map_err(|e| {
            Error::new(ErrorKind::Io, "the threads that render scenes cannot be started").with_source(e)
        })?;
        while !stop.load(Ordering::Relaxed) {
            let next = self.lock().to_do.pop_front();
            match next {
                Some(scene) => threads.install(|| self.draw(&scene, stop)),
                None => std::thread::sleep(LOOK),
            }
        }
        Ok(())
    }

    fn draw(&self, scene: &Scene, stop: &AtomicBool) {
        let before = self.lock().done;
        let drawn = scene.draw(&|n, _| self.lock().done = before + n, &|| !stop.load(Ordering::Relaxed));
        let mut state = self.lock();
        match drawn {
            Ok(file) => {
                if let Some(album) = state.albums.remove(&scene.path) {
                    album.finish(file);
                }
            }
            Err(_) if stop.load(Ordering::Relaxed) => {}
            Err(e) => {
                tracing::error!("the images of a synthetic camera stay coarse: {e}");
                state.done = before;
                state.error = Some(e.to_string());
            }
        }
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        lock(&self.0)
    }
}

fn want(state: &mut State, scene: Scene) {
    if state.wanted.insert(scene.path.clone()) {
        state.total += scene.poses();
        state.to_do.push_back(Arc::new(scene));
    }
}

#[cfg(test)]
mod tests {
    use super::super::render;
    use super::*;

    fn config(cache: &std::path::Path) -> SyntheticConfig {
        SyntheticConfig {
            model: "d435".into(),
            truth: true,
            poses: 3,
            cache_dir: cache.to_owned(),
            ..SyntheticConfig::default()
        }
    }

    /// How far apart two images are on average, in units of their bytes or words.
    fn apart(a: &[u8], b: &[u8], depth: bool) -> f64 {
        let values = |bytes: &[u8]| -> Vec<f64> {
            if depth {
                let words = bytes.as_chunks::<2>().0;
                words.iter().map(|w| f64::from(u16::from_le_bytes(*w))).collect()
            } else {
                bytes.iter().map(|v| f64::from(*v)).collect()
            }
        };
        let a = values(a);
        let b = values(b);
        a.iter().zip(&b).map(|(a, b)| (a - b).abs()).sum::<f64>() / a.len() as f64
    }

    #[test]
    fn a_stream_shows_its_scene_coarsely_at_once_and_as_rendered_in_the_end() {
        let [beside, before] = [tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap()];
        let config_beside = config(beside.path());
        let drawing = Drawing::default();
        drawing.plan(&config_beside).unwrap();
        let planned = drawing.progress().unwrap();
        let profiles: Vec<_> = default_profiles(&config_beside).unwrap();
        let shown: Vec<_> = profiles.iter().map(|p| drawing.images(&config_beside, p).unwrap()).collect();
        let progress = drawing.progress().unwrap();
        assert_eq!(progress, planned, "opening the camera adds nothing to the plan");
        assert_eq!((progress.done, progress.error), (0, None));
        assert_eq!(progress.total % 3, 0, "three poses of each file");
        let coarse: Vec<Vec<u8>> = shown.iter().map(|p| p.get(2).to_vec()).collect();
        let stop = AtomicBool::new(false);
        std::thread::scope(|s| {
            s.spawn(|| drawing.run(&stop).unwrap());
            while drawing.progress().is_some() {
                std::thread::sleep(Duration::from_millis(5));
            }
            stop.store(true, Ordering::Relaxed);
        });
        for ((profile, shown), coarse) in profiles.iter().zip(&shown).zip(&coarse) {
            let fine = render::images(&config(before.path()), profile, &|_, _| ()).unwrap();
            for pose in 0..3 {
                assert_eq!(shown.get(pose), fine.get(pose), "{} at pose {pose}", profile.stream);
            }
            assert_eq!(coarse.len(), profile.frame_bytes());
            let depth = profile.format.is_depth();
            let others = coarse.iter().rev().copied().collect::<Vec<_>>();
            let own = apart(coarse, fine.get(0), depth);
            assert!(
                2.0 * own < apart(&others, fine.get(0), depth),
                "{} is not its scene: {own}",
                profile.stream
            );
        }
        // Another start finds all of it in the cache.
        let again = Drawing::default();
        let found = again.images(&config_beside, &profiles[0]).unwrap();
        assert!(again.progress().is_none() && found.get(1) == shown[0].get(1));
    }

    #[test]
    fn a_stop_ends_it_and_leaves_no_file() {
        let cache = tempfile::tempdir().unwrap();
        let config = config(cache.path());
        let drawing = Drawing::default();
        let profiles = default_profiles(&config).unwrap();
        drawing.images(&config, &profiles[0]).unwrap();
        let scene = drawing.lock().to_do.pop_front().unwrap();
        drawing.draw(&scene, &AtomicBool::new(true));
        assert_eq!(std::fs::read_dir(cache.path()).unwrap().count(), 0);
        assert!(drawing.progress().is_some_and(|p| p.error.is_none()));
    }

    #[test]
    fn a_cache_that_cannot_be_written_leaves_coarse_images_and_says_so() {
        let cache = tempfile::tempdir().unwrap();
        let file = cache.path().join("in_the_way");
        std::fs::write(&file, b"x").unwrap();
        let config = config(&file.join("deeper"));
        let drawing = Drawing::default();
        let profiles = default_profiles(&config).unwrap();
        let shown = drawing.images(&config, &profiles[0]).unwrap();
        let scene = drawing.lock().to_do.pop_front().unwrap();
        drawing.draw(&scene, &AtomicBool::new(false));
        let error = drawing.progress().unwrap().error.unwrap();
        assert!(error.contains("in_the_way") && error.contains("cache_dir"), "{error}");
        assert_eq!(shown.get(0).len(), profiles[0].frame_bytes());
    }
}
