//! Rendering a camera's loop of images once, and finding it again in the cache.

use super::arm::Arm;
use super::cache::{ImageFile, Wanted};
use super::config::SyntheticConfig;
use super::models::Model;
use super::noise::{mix, text_seed};
use super::profiles::{Content, default_profiles, model_of};
use super::scene::World;
use super::view::{Rays, View};
use super::{color, depth, motion};
use depthrig_calib::PoseExt;
use depthrig_driver::{Error, ErrorKind, Result, StreamProfile};
use std::path::PathBuf;
use std::sync::{Arc, OnceLock};

/// Goes up with every change of what is rendered, so that older caches are not used.
const RENDER_VERSION: u32 = 3;

/// Says how many of how many images are ready.
pub type Progress<'a> = &'a (dyn Fn(usize, usize) + Sync);

/// A sketch has this many times fewer pixels per row and column: a sixteenth of the work.
const COARSE: u32 = 4;

/// The images of one file: sketches until all are drawn.
#[derive(Debug, Default)]
pub(crate) struct Album {
    /// By plane; empty where nobody looks before the file is there.
    sketches: Vec<Vec<u8>>,
    file: OnceLock<ImageFile>,
}

impl Album {
    pub(crate) const fn sketched(sketches: Vec<Vec<u8>>) -> Self {
        Self { sketches, file: OnceLock::new() }
    }

    /// From now on these are shown.
    pub(crate) fn finish(&self, file: ImageFile) {
        // Of two files of one scene either will do.
        let _ = self.file.set(file);
    }
}

/// The images of one stream, by pose.
#[derive(Debug, Clone)]
pub(crate) struct Images {
    album: Arc<Album>,
    plane: u32,
}

impl Images {
    /// The image at `pose`.
    pub(crate) fn get(&self, pose: u32) -> &[u8] {
        match self.album.file.get() {
            Some(file) => file.get(self.plane, pose),
            None => self.album.sketches.get(self.plane as usize).map(Vec::as_slice).unwrap_or_default(),
        }
    }
}

/// Renders what the default modes of the camera need and the cache does not hold. Opening the camera does it
/// too, but says nothing while it takes its time.
///
/// # Errors
/// Those of a wrong configuration, and [`depthrig_driver::ErrorKind::Io`] when the cache cannot be written.
pub fn prepare(config: &SyntheticConfig, progress: Progress<'_>) -> Result<()> {
    prepare_all(core::slice::from_ref(config), progress)
}

/// [`prepare`] for several cameras, with one count of all their images.
///
/// # Errors
/// As [`prepare`].
pub fn prepare_all(configs: &[SyntheticConfig], progress: Progress<'_>) -> Result<()> {
    let mut jobs: Vec<(&SyntheticConfig, StreamProfile)> = Vec::new();
    for config in configs {
        for p in default_profiles(config)? {
            let is_truth = Content::of(&p.stream) == Some(Content::DepthTrue);
            // Depth and true depth of one size come out of one job.
            let is_done = is_truth
                && jobs.iter().any(|(c, q)| {
                    core::ptr::eq::<SyntheticConfig>(*c, config)
                        && Content::of(&q.stream) == Some(Content::Depth)
                        && (q.width, q.height, q.intrinsics) == (p.width, p.height, p.intrinsics)
                });
            if !config.cheap && !is_done && !p.format.is_motion() {
                jobs.push((config, p));
            }
        }
    }
    let total = jobs.iter().map(|(c, _)| c.poses as usize).sum();
    let mut done = 0;
    progress(0, total);
    for (config, profile) in jobs {
        images(config, &profile, &|n, _| progress(done + n, total))?;
        done += config.rendered_poses() as usize;
        progress(done, total);
    }
    Ok(())
}

/// The images of one stream, rendered if they are not in the cache.
pub(crate) fn images(
    config: &SyntheticConfig,
    profile: &StreamProfile,
    progress: Progress<'_>,
) -> Result<Images> {
    let scene = Scene::new(config, profile)?;
    let file = match scene.cached() {
        Some(file) => file,
        None => scene.draw(progress, &|| true)?,
    };
    let album = Album::default();
    album.finish(file);
    Ok(scene.images(&Arc::new(album)))
}

/// The images of a stream, and the file that keeps them.
#[derive(Debug)]
pub(crate) struct Scene {
    config: SyntheticConfig,
    profile: StreamProfile,
    model: &'static Model,
    content: Content,
    planes: u32,
    key: String,
    pub(crate) path: PathBuf,
}

impl Scene {
    pub(crate) fn new(config: &SyntheticConfig, profile: &StreamProfile) -> Result<Self> {
        let model = model_of(config)?;
        let content = Content::of(&profile.stream).unwrap_or(Content::Color);
        let planes = if content.is_color_view() || !config.truth { 1 } else { 2 };
        let key = key(config, model, profile, planes);
        let path = path(config, profile, &key);
        Ok(Self { config: config.clone(), profile: profile.clone(), model, content, planes, key, path })
    }

    /// Poses to be rendered.
    pub(crate) const fn poses(&self) -> usize {
        self.config.rendered_poses() as usize
    }

    fn wanted(&self) -> Wanted<'_> {
        let bytes = self.profile.frame_bytes();
        Wanted { key: &self.key, planes: self.planes, poses: self.config.rendered_poses(), bytes }
    }

    /// The images of `album` that this stream shows.
    pub(crate) fn images(&self, album: &Arc<Album>) -> Images {
        Images { album: Arc::clone(album), plane: u32::from(self.content == Content::DepthTrue) }
    }

    pub(crate) fn cached(&self) -> Option<ImageFile> {
        ImageFile::open(&self.path, &self.wanted())
    }

    /// Renders every pose into the cache, until `go_on` is false.
    pub(crate) fn draw(&self, progress: Progress<'_>, go_on: &dyn Fn() -> bool) -> Result<ImageFile> {
        if self.path.exists() {
            tracing::warn!(file = %self.path.display(), "the render cache of a synthetic camera is damaged or cannot be read; it is made anew");
        }
        let Self { profile, config, .. } = self;
        let rays = Rays::new(&profile.intrinsics, profile.width, profile.height);
        progress(0, self.poses());
        ImageFile::create(&self.path, &self.wanted(), |pose| {
            if !go_on() {
                return Err(Error::new(ErrorKind::Io, "rendering was stopped"));
            }
            let made = self.render(&rays, pose);
            progress(pose as usize + 1, config.rendered_poses() as usize);
            Ok(made)
        })
    }

    /// The first pose from a [`COARSE`]th of the rays per row and column: every plane, in the size of the stream.
    pub(crate) fn sketch(&self) -> Vec<Vec<u8>> {
        let p = &self.profile;
        let small = |n: u32| n.div_ceil(COARSE);
        let scale = 1.0 / f64::from(COARSE);
        let mut k = p.intrinsics;
        (k.fx, k.fy) = (k.fx * scale, k.fy * scale);
        // Pixel centres are at whole numbers.
        (k.cx, k.cy) = ((k.cx + 0.5) * scale - 0.5, (k.cy + 0.5) * scale - 0.5);
        let rays = Rays::new(&k, small(p.width), small(p.height));
        let planes = self.render(&rays, 0);
        let pixel = p.frame_bytes() / (p.width as usize * p.height as usize);
        planes.iter().map(|plane| enlarge(plane, pixel, p.width as usize, p.height as usize)).collect()
    }

    /// Every plane at `pose`.
    fn render(&self, rays: &Rays, pose: u32) -> Vec<Vec<u8>> {
        let Self { config, model, .. } = self;
        let world = &World::fixed(if config.arm { Arm::in_pose(pose).things() } else { Vec::new() });
        let camera = config.true_pose().compose(&self.profile.pose_in_device).to_affine();
        let mount =
            if config.arm { motion::mount(0, 1) } else { motion::mount(pose, config.rendered_poses()) };
        let view = View::new(rays, &(mount * camera));
        let seed = mix(text_seed(config.seed, &config.serial_or_default()).wrapping_add(u64::from(pose)));
        let bytes = |counts: Vec<u16>| counts.iter().flat_map(|z| z.to_le_bytes()).collect();
        match self.content {
            Content::Color => vec![color::render(world, &view, model.white, seed)],
            Content::DepthTrueColor => vec![bytes(depth::truth(&view.cast(world), model))],
            Content::Depth | Content::DepthTrue => {
                let pair = depth::render(world, &view, model, seed);
                [pair.sensed, pair.truth].into_iter().take(self.planes as usize).map(bytes).collect()
            }
        }
    }
}

/// Each pixel of `bytes` bytes [`COARSE`] times per row and column, up to this size.
fn enlarge(small: &[u8], bytes: usize, width: usize, height: usize) -> Vec<u8> {
    let coarse = COARSE as usize;
    let small_row = width.div_ceil(coarse) * bytes;
    let mut large = Vec::with_capacity(width * height * bytes);
    for y in 0..height {
        let row = &small[y / coarse * small_row..][..small_row];
        for x in 0..width {
            large.extend_from_slice(&row[x / coarse * bytes..][..bytes]);
        }
    }
    large
}

/// Everything that the images depend on, as text.
fn key(config: &SyntheticConfig, model: &Model, p: &StreamProfile, planes: u32) -> String {
    let stream = file_of(p);
    let arm = if config.arm { "arm 1 " } else { "" };
    format!(
        "render {RENDER_VERSION} {arm}{stream} planes {planes} poses {} seed {} serial {} model {} {:?} unit {} range {:?} \
         white {:?} size {}x{} {:?} on mount {:?} in device {:?}",
        config.rendered_poses(),
        config.seed,
        config.serial_or_default(),
        model.name,
        model.depth,
        model.depth_unit_m,
        model.range_m,
        model.white,
        p.width,
        p.height,
        p.intrinsics,
        config.true_pose(),
        p.pose_in_device
    )
}

/// Name of the file of a stream's images: depth and its truth share one.
fn file_of(p: &StreamProfile) -> &'static str {
    match Content::of(&p.stream) {
        Some(Content::Depth | Content::DepthTrue) => "depth",
        Some(Content::DepthTrueColor) => "truth",
        Some(Content::Color) | None => "color",
    }
}

fn path(config: &SyntheticConfig, p: &StreamProfile, key: &str) -> PathBuf {
    let stream = file_of(p);
    let hash = text_seed(0, key);
    let name =
        format!("{}-{stream}-{}x{}-{hash:016x}.images", config.model.to_lowercase(), p.width, p.height);
    config.cache_dir.join(name)
}
