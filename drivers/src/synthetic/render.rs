//! Rendering a camera's loop of pictures once, and finding it again in the cache.

use super::cache::{PictureFile, Wanted};
use super::config::SyntheticConfig;
use super::models::Model;
use super::noise::{mix, text_seed};
use super::profiles::{Content, default_profiles, model_of};
use super::scene::World;
use super::view::{Rays, View};
use super::{color, depth, motion};
use crate::{Result, StreamProfile};
use depthrig_calib::PoseExt;
use std::path::PathBuf;
use std::sync::Arc;

/// Goes up with every change of what is rendered, so that older caches are not used.
const RENDER_VERSION: u32 = 2;

/// Says how many of how many pictures are ready.
pub type Progress<'a> = &'a (dyn Fn(usize, usize) + Sync);

/// The pictures of one stream, by pose.
#[derive(Debug, Clone)]
pub(crate) struct Pictures {
    file: Arc<PictureFile>,
    plane: u32,
}

impl Pictures {
    /// The picture at `pose`.
    pub(crate) fn get(&self, pose: u32) -> &[u8] {
        self.file.get(self.plane, pose)
    }
}

/// Renders what the default modes of the camera need and the cache does not hold. Opening the camera does it
/// too, but says nothing while it takes its time.
///
/// # Errors
/// Those of a wrong configuration, and [`crate::ErrorKind::Io`] when the cache cannot be written.
pub fn prepare(config: &SyntheticConfig, progress: Progress<'_>) -> Result<()> {
    prepare_all(core::slice::from_ref(config), progress)
}

/// [`prepare`] for several cameras, with one count of all their pictures.
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
        pictures(config, &profile, &|n, _| progress(done + n, total))?;
        done += config.poses as usize;
        progress(done, total);
    }
    Ok(())
}

/// The pictures of one stream, rendered if they are not in the cache.
pub(crate) fn pictures(
    config: &SyntheticConfig,
    profile: &StreamProfile,
    progress: Progress<'_>,
) -> Result<Pictures> {
    let model = model_of(config)?;
    let content = Content::of(&profile.stream).unwrap_or(Content::Color);
    let planes = if content.is_color_view() || !config.truth { 1 } else { 2 };
    let key = key(config, model, profile, planes);
    let wanted = Wanted { key: &key, planes, poses: config.poses, bytes: profile.frame_bytes() };
    let path = path(config, profile, &key);
    let plane = u32::from(content == Content::DepthTrue);
    if let Some(file) = PictureFile::open(&path, &wanted) {
        return Ok(Pictures { file: Arc::new(file), plane });
    }
    if path.exists() {
        tracing::warn!(file = %path.display(), "the render cache of a synthetic camera is damaged and is made anew");
    }
    let world = World::new();
    let rays = Rays::new(&profile.intrinsics, profile.width, profile.height);
    let camera = config.pose_on_mount.compose(&profile.pose_in_device).to_affine();
    progress(0, config.poses as usize);
    let file = PictureFile::create(&path, &wanted, |pose| {
        let view = View::new(&rays, &(motion::mount(pose, config.poses) * camera));
        let seed = mix(text_seed(config.seed, &config.serial_or_default()).wrapping_add(u64::from(pose)));
        let bytes = |counts: Vec<u16>| counts.iter().flat_map(|z| z.to_le_bytes()).collect();
        let made = match content {
            Content::Color => vec![color::render(&world, &view, model.white, seed)],
            Content::DepthTrueColor => vec![bytes(depth::truth(&view.cast(&world), model))],
            Content::Depth | Content::DepthTrue => {
                let pair = depth::render(&world, &view, model, seed);
                [pair.sensed, pair.truth].into_iter().take(planes as usize).map(bytes).collect()
            }
        };
        progress(pose as usize + 1, config.poses as usize);
        made
    })?;
    Ok(Pictures { file: Arc::new(file), plane })
}

/// Everything that the pictures depend on, as text.
fn key(config: &SyntheticConfig, model: &Model, p: &StreamProfile, planes: u32) -> String {
    let stream = file_of(p);
    format!(
        "render {RENDER_VERSION} {stream} planes {planes} poses {} seed {} serial {} model {} {:?} unit {} range {:?} \
         white {:?} size {}x{} {:?} on mount {:?} in device {:?}",
        config.poses,
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
        config.pose_on_mount,
        p.pose_in_device
    )
}

/// What the file of a stream's pictures is called: depth and its truth share one.
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
        format!("{}-{stream}-{}x{}-{hash:016x}.pictures", config.model.to_lowercase(), p.width, p.height);
    config.cache_dir.join(name)
}
