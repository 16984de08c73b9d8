//! A sample's world as meshes, for renderers that are not ours.

use super::super::color;
use super::super::scene::World;
use super::super::shape::Triangles;
use super::super::texture::{Paint, Surface};
use super::super::view::{NOTHING, Rays, View};
use super::{Draw, RandomWorld, depth, varied};
use super::{Generator, TRUTH_UNIT_M, material_of, mix};
use depthrig_bus::Intrinsics;
use depthrig_calib::PoseExt;
use glam::{Mat3, Vec3};

/// Corners of what is in view are so many pixels apart, so that their colours show the patterns.
const PIXELS: f32 = 1.2;
/// Corners of what is out of view are this far apart, metres.
const UNSEEN_M: f32 = 0.03;

/// A part of a world: triangles of one material, in metres.
#[derive(Debug, Clone, Default)]
pub struct WorldPart {
    /// `matte`, `glossy`, `metal`, `mirror` or `glass`.
    pub surface: &'static str,
    /// Number of its material, as in [`super::Triplet::material`].
    pub material: u8,
    /// Part of the infrared light that comes back, 0..1.
    pub infrared: f32,
    /// Corners in the world.
    pub corners: Vec<[f32; 3]>,
    /// Unit normals at the corners, outwards.
    pub normals: Vec<[f32; 3]>,
    /// Linear RGB at the corners; of glass what it lets through.
    pub colors: Vec<[f32; 3]>,
    /// Three corners each, counterclockwise from outside.
    pub triangles: Vec<[u32; 3]>,
}

/// A lamp: a ball that shines.
#[derive(Debug, Clone, Copy)]
pub struct WorldLamp {
    /// Middle in the world, metres.
    pub center: [f32; 3],
    /// Metres.
    pub radius: f32,
    /// Light at 1 m, by which a white surface that faces the lamp has the brightness 1.
    pub power: f32,
    /// Linear RGB.
    pub color: [f32; 3],
}

/// A world and what the camera sees of it.
#[derive(Debug, Clone)]
pub struct WorldModel {
    /// Number of the sample.
    pub number: u64,
    /// Its things, and after them the six faces of the room: lowest x, highest x, then y and z.
    pub parts: Vec<WorldPart>,
    /// Lamps.
    pub lamps: Vec<WorldLamp>,
    /// Light from all around, linear RGB: from below and from above.
    pub around: [[f32; 3]; 2],
    /// Factor from light to the tone curve.
    pub exposure: f32,
    /// Factors of red, green, blue.
    pub white: [f32; 3],
    /// Colour camera in the world: columns of the rotation and the place, metres.
    pub camera: [[f64; 3]; 4],
    /// Its intrinsics.
    pub intrinsics: Intrinsics,
    /// Colour without a camera's faults (blur, JPEG), RGB.
    pub color: Vec<u8>,
    /// True depth, in [`TRUTH_UNIT_M`].
    pub truth: Vec<u16>,
    /// Material of the first surface.
    pub material: Vec<u8>,
    /// Number of the part that each pixel shows; those of no part follow the last.
    pub part: Vec<u16>,
}

impl Generator {
    /// The world of sample `number` as meshes.
    pub fn world(&self, number: u64) -> WorldModel {
        let super::Settings { seed, width, height, .. } = self.settings;
        let model = varied(self.model(number), &mut Draw::new(seed, number, 5));
        let RandomWorld { world, camera_pose, .. } = RandomWorld::new(seed, number, &self.stock);
        let optics = self.optics(&model, number);
        let rays = Rays::new(&optics.color, width, height);
        let camera = camera_pose * model.color_in_device.to_affine();
        let view = View::new(&rays, &camera);
        let mets = view.cast(&world);
        let noise = mix(seed ^ mix(number.wrapping_add(0x5CE4E)));
        let truth = mets.iter().map(|m| if *m == NOTHING { 0 } else { depth::counts(m.t, TRUTH_UNIT_M) });
        let room = world.things.len() as u16;
        let axes = camera.matrix3;
        WorldModel {
            number,
            parts: parts(&world, &Viewpoint::new(&view, (width, height))),
            lamps: world
                .lamps
                .iter()
                .map(|lamp| WorldLamp {
                    center: lamp.center.to_array(),
                    radius: lamp.radius,
                    power: lamp.power,
                    color: lamp.color.to_array(),
                })
                .collect(),
            around: world.around.map(|c| c.to_array()),
            exposure: world.exposure,
            white: model.white,
            camera: [axes.x_axis, axes.y_axis, axes.z_axis, camera.translation].map(|v| v.to_array()),
            intrinsics: optics.color,
            color: color::render_met(&world, &view, &mets, model.white, noise),
            truth: truth.collect(),
            material: mets.iter().map(|m| material_of(&world, m.key)).collect(),
            part: mets.iter().map(|m| part_of(m.key, room)).collect(),
        }
    }
}

/// Number of the part that a key names: the faces of the room come after the things.
fn part_of(key: u16, room: u16) -> u16 {
    if key >> 3 < room { key >> 3 } else { room + (key & 7) }
}

/// Where a camera is and what it has in view.
struct Viewpoint {
    origin: Vec3,
    ahead: Vec3,
    /// Half of the angle that holds the image, radians.
    reach: f32,
    pixel_rad: f32,
}

impl Viewpoint {
    fn new(view: &View<'_>, (width, height): (u32, u32)) -> Self {
        let pixel_rad = view.rays.pixel_rad;
        let half = (width as f32).hypot(height as f32) / 2.0 * pixel_rad;
        Self { origin: view.origin, ahead: view.axes.z_axis, reach: 1.1 * half.atan(), pixel_rad }
    }

    /// How far apart corners may be around `p`, within a ball of `radius`.
    fn spacing(&self, p: Vec3, radius: f32) -> f32 {
        let to = p - self.origin;
        let far = to.length();
        let near = (far - radius).max(0.1);
        let is_in_view =
            far < radius || self.ahead.angle_between(to) < self.reach + (radius / far).min(1.0).asin();
        let seen = PIXELS * near * self.pixel_rad;
        if is_in_view { seen } else { seen.max(UNSEEN_M) }
    }

    /// Width of a pixel at `p`, metres.
    fn blur(&self, p: Vec3) -> f32 {
        self.ahead.dot(p - self.origin).max(0.1) * self.pixel_rad
    }
}

fn parts(world: &World, from: &Viewpoint) -> Vec<WorldPart> {
    let things = world.things.iter().map(|thing| {
        let solid = &thing.solid;
        let place = |p: Vec3| solid.center + solid.axes * p;
        // Flat shapes ask for each of their tiles, round ones for their middle.
        let made = Triangles::of(solid, &|p| from.spacing(place(p), solid.bound.min(0.2)));
        part(&made, solid.center, solid.axes, from, |_| thing.paint)
    });
    let room = (0..6).map(|face| {
        let made = Triangles::of_room(world.room, face, &|p| from.spacing(p, 0.2));
        part(&made, Vec3::ZERO, Mat3::IDENTITY, from, |n| world.room_paint(n))
    });
    things.chain(room).collect()
}

fn part(
    made: &Triangles,
    center: Vec3,
    axes: Mat3,
    from: &Viewpoint,
    paint: impl Fn(Vec3) -> Paint,
) -> WorldPart {
    let first = paint(made.normals.first().copied().unwrap_or(Vec3::Z));
    let mut part = WorldPart {
        surface: match first.surface() {
            Surface::Matte => "matte",
            Surface::Glossy => "glossy",
            Surface::Shiny => "metal",
            Surface::Mirror => "mirror",
            Surface::Glass => "glass",
        },
        material: super::material_of_paint(first),
        infrared: first.infrared().albedo,
        triangles: made.faces.clone(),
        ..WorldPart::default()
    };
    for (p, n) in made.corners.iter().zip(&made.normals) {
        let place = center + axes * *p;
        part.corners.push(place.to_array());
        part.normals.push((axes * *n).to_array());
        part.colors.push(paint(*n).color(*p, *n, from.blur(place)).to_array());
    }
    part
}
