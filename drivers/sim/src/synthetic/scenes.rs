//! Triplets of colour, true depth and measured depth from random worlds: what a depth model learns from.
//!
//! Sample `i` of a run depends on the run's settings, its seed and `i` alone, so any part of a run can be made anywhere.
//!
//! ```
//! use depthrig_sim::synthetic::scenes::{Generator, Settings};
//!
//! let settings = Settings { width: 96, height: 64, ..Settings::default() };
//! let generator = Generator::new(settings)?;
//! let sample = generator.sample(3)?;
//! assert_eq!(sample.truth.len(), 96 * 64);
//! # Ok::<(), depthrig_driver::Error>(())
//! ```

use super::color;
use super::depth;
use super::models::{self, DepthPrinciple, MODELS, Mode, Model};
use super::noise::mix;
use super::random::{Draw, RandomWorld, Stock};
use super::scene::World;
use super::shape::Mesh;
use super::texture::{DARK_ALBEDO, Paint, Surface};
use super::view::{NOTHING, Rays, View};
use depthrig_bus::{Intrinsics, Pose};
use depthrig_calib::{PoseExt, Registration, same_view};
use depthrig_driver::{Error, ErrorKind, Result};
use glam::Vec3;
use std::sync::Arc;

mod hide;
mod ir;
mod optics;
mod world;

pub use super::random::{Family, SceneKind};
pub use world::{WorldLamp, WorldModel, WorldPart};

/// Metres per count of true depth.
pub const TRUTH_UNIT_M: f64 = 1e-4;
/// Sides of an image, pixels.
pub const SIDES: core::ops::RangeInclusive<u32> = 32..=4096;

/// How a sensor's faults come about.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Sensor {
    /// Drawn from what is known of the sensor's principle.
    #[default]
    Statistical,
    /// Stereo cameras: two infrared images with a dot pattern, matched. Time of flight as [`Sensor::Statistical`].
    Stereo,
}

/// A mesh of a user: triangles of corners, metres or any other unit; z is up.
#[derive(Debug, Clone, Default)]
pub struct TriangleMesh {
    /// Its name in messages, such as its file.
    pub name: String,
    /// Corners.
    pub corners: Vec<[f32; 3]>,
    /// Three corners' numbers each.
    pub triangles: Vec<[u32; 3]>,
}

/// Settings of a run.
#[derive(Debug, Clone)]
pub struct Settings {
    /// Its seed.
    pub seed: u64,
    /// Width of the colour image, pixels.
    pub width: u32,
    /// Height of the colour image, pixels.
    pub height: u32,
    /// Names of camera models; sample `i` is of model `i` modulo their number.
    pub cameras: Vec<String>,
    /// How depth is measured.
    pub sensor: Sensor,
    /// Share of the samples in which random regions of measured depth are hidden, 0 to 1.
    pub hide: f32,
    /// Every sample has the lens of its camera model; else each one is a little off it.
    pub nominal_lens: bool,
    /// Number of the measurement: each draws sensor and noise anew, of the same worlds, views and colour images.
    pub again: u64,
    /// Families of objects.
    pub families: Vec<Family>,
    /// Meshes for [`Family::Mesh`].
    pub meshes: Vec<TriangleMesh>,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            seed: 0,
            width: 640,
            height: 480,
            cameras: vec!["d435".to_owned()],
            sensor: Sensor::Statistical,
            hide: 0.0,
            nominal_lens: false,
            again: 0,
            families: Family::ALL.into_iter().filter(|f| *f != Family::Mesh).collect(),
            meshes: Vec::new(),
        }
    }
}

/// A sample: images of one size, rows without padding.
#[derive(Debug, Clone, PartialEq)]
pub struct Triplet {
    /// Its number in the run.
    pub number: u64,
    /// Colour, RGB, 3 bytes a pixel.
    pub color: Vec<u8>,
    /// True depth of the first surface along the optical axis at pixel centres, in [`TRUTH_UNIT_M`]; 0 beyond 6.5535 m.
    pub truth: Vec<u16>,
    /// Measured depth in colour's view, in `raw_unit_m`; 0 is a hole.
    pub raw: Vec<u16>,
    /// Share of the measured pixels that were hidden at random, and are holes in `raw`.
    pub hidden: f32,
    /// Material of the first surface: 0 nothing, 1 diffuse, 2 glossy, 3 metal, 4 glass, 5 dark.
    pub material: Vec<u8>,
    /// Metres per count of measured depth.
    pub raw_unit_m: f64,
    /// Name of the camera model.
    pub camera: &'static str,
    /// `statistical`, `stereo` or `tof`.
    pub sensor_model: &'static str,
    /// Families of the objects in the world, each once.
    pub families: Vec<Family>,
    /// Kind of the world.
    pub scene: SceneKind,
    /// Colour's intrinsics.
    pub intrinsics: Intrinsics,
}

/// Makes the samples of a run.
#[derive(Debug)]
pub struct Generator {
    settings: Settings,
    models: Vec<&'static Model>,
    stock: Stock,
}

impl Generator {
    /// Checks the settings.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] for an unknown camera, no camera or family, an impossible size, the family of meshes
    /// without a mesh, and a mesh that is damaged.
    pub fn new(settings: Settings) -> Result<Self> {
        let bad = |text: String| Error::new(ErrorKind::BadInput, text);
        let models = settings.cameras.iter().map(|name| {
            models::find(name).ok_or_else(|| {
                let names: Vec<_> = MODELS.iter().map(|m| m.name).collect();
                bad(format!("invalid camera model \"{name}\"; use {}", names.join(", ")))
            })
        });
        let models = models.collect::<Result<Vec<_>>>()?;
        if models.is_empty() || settings.families.is_empty() {
            return Err(bad("no camera or no family of objects is left; name at least one of each".into()));
        }
        if !(SIDES.contains(&settings.width) && SIDES.contains(&settings.height)) {
            let (w, h) = (settings.width, settings.height);
            return Err(bad(format!(
                "invalid size {w}x{h}; sides are {} to {} pixels",
                SIDES.start(),
                SIDES.end()
            )));
        }
        if settings.families.contains(&Family::Mesh) && settings.meshes.is_empty() {
            return Err(bad("the family \"mesh\" needs meshes; give a folder of OBJ files".into()));
        }
        let checked = |mesh: &TriangleMesh| {
            unit_mesh(mesh).ok_or_else(|| {
                let name = &mesh.name;
                bad(format!(
                    "mesh {name} has faces without corners, no extent or corners that are not finite; repair or remove it"
                ))
            })
        };
        if !(0.0..=1.0).contains(&settings.hide) {
            return Err(bad(format!(
                "share of samples with hidden depth {} is out of range 0..=1",
                settings.hide
            )));
        }
        let meshes = settings.meshes.iter().map(checked).collect::<Result<Vec<_>>>()?;
        let stock = Stock { families: settings.families.clone(), meshes };
        Ok(Self { settings, models, stock })
    }

    /// The settings that it was made with.
    pub const fn settings(&self) -> &Settings {
        &self.settings
    }

    fn model(&self, number: u64) -> &'static Model {
        self.models[(number % self.models.len() as u64) as usize]
    }

    /// Sample `number`.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] when a view cannot be registered.
    pub fn sample(&self, number: u64) -> Result<Triplet> {
        let Settings { seed, width, height, sensor, .. } = self.settings;
        let model = self.model(number);
        let measured = if self.settings.again == 0 { seed } else { mix(seed ^ mix(self.settings.again)) };
        let model = &varied(model, &mut Draw::new(measured, number, 5));
        let RandomWorld { world, kind, families, camera_pose } = RandomWorld::new(seed, number, &self.stock);
        let optics = self.optics(model, number);
        let noise_of = |seed: u64| mix(seed ^ mix(number.wrapping_add(0x5CE4E)));
        let noise = noise_of(measured);

        let rays = Rays::new(&optics.color, width, height);
        let view = View::new(&rays, &(camera_pose * model.color_in_device.to_affine()));
        let mets = view.cast(&world);
        let mut color = color::render_met(&world, &view, &mets, model.white, noise_of(seed));
        optics::blemish(&mut Draw::new(seed, number, 3), &mut color, width as usize);
        let truth = mets.iter().map(|m| if *m == NOTHING { 0 } else { depth::counts(m.t, TRUTH_UNIT_M) });
        let material = mets.iter().map(|m| material_of(&world, m.key)).collect();

        let (w, h) = optics.depth_size;
        let is_same = same_view(
            (&optics.depth, (w, h), &Pose::IDENTITY),
            (&optics.color, (width, height), &model.color_in_device),
        );
        let is_physical = sensor == Sensor::Stereo && matches!(model.depth, DepthPrinciple::Stereo { .. });
        let depth_rays = (!is_same).then(|| Rays::new(&optics.depth, w, h));
        let depth_view = depth_rays.as_ref().map_or(view, |rays| View::new(rays, &camera_pose));
        let sensed = if is_physical {
            ir::measure(&world, &depth_view, model, noise)?
        } else if is_same {
            depth::sense(&world, &depth_view, &mets, model, noise)
        } else {
            depth::sense(&world, &depth_view, &depth_view.cast(&world), model, noise)
        };
        let mut raw = if is_same { sensed } else { register(&optics, model, (width, height), &sensed)? };
        let mut draw = Draw::new(seed, number, 4);
        let hidden = if draw.chance(self.settings.hide) {
            hide::hide(&mut draw, &mut raw, (width, height), |i| mets[i].key)
        } else {
            0.0
        };
        Ok(Triplet {
            number,
            color,
            truth: truth.collect(),
            raw,
            hidden,
            material,
            raw_unit_m: model.depth_unit_m,
            camera: model.name,
            sensor_model: match model.depth {
                DepthPrinciple::TimeOfFlight { .. } => "tof",
                DepthPrinciple::Stereo { .. } if is_physical => "stereo",
                DepthPrinciple::Stereo { .. } => "statistical",
            },
            families,
            scene: kind,
            intrinsics: optics.color,
        })
    }

    fn optics(&self, model: &Model, number: u64) -> Optics {
        let Settings { seed, width, height, nominal_lens, .. } = self.settings;
        Optics::new(model, if nominal_lens { 0.0 } else { 1.0 }, seed, number, (width, height))
    }
}

/// The same model with more or less noise; a projector fails now and then, as in the sun.
fn varied(model: &Model, draw: &mut Draw) -> Model {
    let noise = draw.scale(0.6, 1.7);
    let other = draw.scale(0.5, 2.0);
    let is_outshone = draw.chance(0.12);
    let depth = match model.depth {
        DepthPrinciple::Stereo { baseline_m, projector, sigma_px, search_px } => DepthPrinciple::Stereo {
            baseline_m,
            projector: projector && !is_outshone,
            sigma_px: sigma_px * noise,
            search_px,
        },
        DepthPrinciple::TimeOfFlight { sigma_m, multipath_m, half_angle_deg } => {
            DepthPrinciple::TimeOfFlight {
                sigma_m: sigma_m * noise,
                multipath_m: multipath_m * other,
                half_angle_deg,
            }
        }
    };
    Model { depth, ..*model }
}

/// Depth in colour's view.
fn register(optics: &Optics, model: &Model, size: (u32, u32), sensed: &[u16]) -> Result<Vec<u16>> {
    let pose = model.color_in_device.inverse();
    let wrong = |e: depthrig_calib::Error| Error::new(ErrorKind::BadInput, e.to_string()).with_source(e);
    let registration = Registration::new(&optics.depth, optics.depth_size, &optics.color, size, &pose);
    let mut raw = vec![0; size.0 as usize * size.1 as usize];
    registration.and_then(|mut r| r.depth_to_color(sensed, model.depth_unit_m, &mut raw)).map_err(wrong)?;
    Ok(raw)
}

/// A sample's lenses: those of the model, `off` times a little off.
#[derive(Debug)]
struct Optics {
    color: Intrinsics,
    depth: Intrinsics,
    depth_size: (u32, u32),
}

impl Optics {
    fn new(model: &Model, off: f64, seed: u64, number: u64, size: (u32, u32)) -> Self {
        let rolls = super::noise::Rolls::new(seed, number as u32, (number >> 32) as u32, 2);
        let off = |i: u64, by: f64| (rolls.unit_f64(i) * 2.0 - 1.0) * by * off;
        let color_mode = fitted(model.color_modes, size);
        // Depth of about the same height as colour.
        let depth_modes = model.depth_modes.iter().filter(|m| m.height >= size.1);
        let depth_mode = depth_modes.min_by_key(|m| m.width * m.height);
        let depth_mode = match depth_mode {
            Some(mode) if mode.height < 2 * size.1 && model.color_in_device != Pose::IDENTITY => *mode,
            _ => fitted(model.depth_modes, size),
        };
        let stretch = 1.0 + off(0, 0.1);
        let lens = |mode: &Mode, first: u64| {
            let mut k = mode.intrinsics([off(first, 0.02), off(first + 1, 0.02)]);
            (k.fx, k.fy) = (k.fx * stretch, k.fy * stretch * (1.0 + off(first + 2, 0.003)));
            k
        };
        let color = lens(&color_mode, 1);
        let is_one = model.color_in_device == Pose::IDENTITY && color_mode == depth_mode;
        let depth = if is_one { color } else { lens(&depth_mode, 11) };
        Self { color, depth, depth_size: (depth_mode.width, depth_mode.height) }
    }
}

/// The mode of this size; else the default one, scaled to the height and cut to the width.
fn fitted(modes: &[Mode], (width, height): (u32, u32)) -> Mode {
    let exact = modes.iter().find(|m| (m.width, m.height) == (width, height));
    let base = exact.or(modes.first()).copied();
    let base = base.unwrap_or(Mode {
        width,
        height,
        rates_hz: &[],
        focal_px: f64::from(width),
        lens: models::Lens::Pinhole,
    });
    let focal_px = base.focal_px * f64::from(height) / f64::from(base.height);
    Mode { width, height, focal_px, ..base }
}

fn material_of(world: &World, key: u16) -> u8 {
    if key == NOTHING.key { 0 } else { material_of_paint(world.paint(key)) }
}

fn material_of_paint(paint: Paint) -> u8 {
    match paint.surface() {
        Surface::Glass => 4,
        Surface::Shiny | Surface::Mirror => 3,
        _ if paint.infrared().albedo <= DARK_ALBEDO => 5,
        Surface::Glossy => 2,
        Surface::Matte => 1,
    }
}

/// The mesh around the origin with radius 1.
fn unit_mesh(mesh: &TriangleMesh) -> Option<Arc<Mesh>> {
    let corners: Vec<Vec3> = mesh.corners.iter().copied().map(Vec3::from).collect();
    let is_good = mesh.triangles.iter().flatten().all(|i| (*i as usize) < corners.len())
        && corners.iter().all(|p| p.is_finite())
        && !mesh.triangles.is_empty();
    if !is_good {
        return None;
    }
    let low = corners.iter().copied().reduce(Vec3::min)?;
    let high = corners.iter().copied().reduce(Vec3::max)?;
    let middle = (low + high) / 2.0;
    let radius = corners.iter().map(|p| (*p - middle).length()).fold(0.0, f32::max);
    let unit: Vec<Vec3> = corners.iter().map(|p| (*p - middle) / radius).collect();
    (radius > 1e-9 && radius.is_finite()).then(|| Arc::new(Mesh::new(&unit, &mesh.triangles)))
}

#[cfg(test)]
mod tests;
