//! Images of the simulated cameras as a refiner is given them: colour, raw depth in its view, and the truth.

use depthrig_bus::{Name, Pose};
use depthrig_calib::{PoseExt, Registration};
use depthrig_driver::{Backend, MemorySink, StreamProfile, StreamRequest};
use depthrig_sim::synthetic::{StreamOverride, SyntheticBackend, SyntheticConfig};
use std::path::Path;
use std::time::Duration;

/// The models with a depth principle of their own, stereo first.
pub const MODELS: [&str; 7] = ["d405", "d415", "d435", "d455", "zed2i", "l515", "kinect"];

/// One view of a camera.
pub struct Scene {
    /// Width and height of all images.
    pub size: (usize, usize),
    /// Red, green, blue.
    pub color: Vec<u8>,
    /// Measured depth, registered to colour.
    pub raw: Vec<u16>,
    /// True depth.
    pub truth: Vec<u16>,
    /// Metres per unit of both.
    pub unit_m: f64,
}

/// Image sizes to request from a camera.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Size {
    /// Those of its default modes.
    Default,
    /// The smallest it has.
    Small,
}

/// Renders the view of `model` from a pose on the mount.
pub fn shoot(model: &str, size: Size, pose_on_mount: Pose, cache: &Path) -> Scene {
    let mut config = SyntheticConfig {
        model: model.into(),
        truth: true,
        poses: 1,
        pose_on_mount,
        cache_dir: cache.to_path_buf(),
        ..SyntheticConfig::default()
    };
    if size == Size::Small {
        let smallest = |modes: &[depthrig_sim::synthetic::models::Mode]| {
            modes.iter().map(|m| (m.width, m.height)).min_by_key(|(w, h)| w * h)
        };
        let model = depthrig_sim::synthetic::models::find(model).unwrap();
        for (stream, modes) in [("color", model.color_modes), ("depth", model.depth_modes)] {
            let stream = Name::new(stream).unwrap();
            config.streams.push(StreamOverride { stream, size: smallest(modes), rate_hz: None });
        }
    }
    let backend = SyntheticBackend::new(vec![config]).unwrap();
    let requests = ["color", "depth", "depth_true_color"].map(|s| StreamRequest::any(Name::new(s).unwrap()));
    let mut stream = backend.open(None).unwrap().start(&requests).unwrap();
    let mut sink = MemorySink::default();
    while (0..3).any(|i| sink.delivered(i) == 0) {
        stream.poll(Duration::from_millis(50), &mut sink).unwrap();
    }
    let bytes = |i: usize| sink.frames.iter().find(|f| f.0 == i).unwrap().2.clone();
    let [color, depth, _] = stream.profiles() else { panic!("three streams were asked for") };
    let mut scene = Scene {
        size: (color.width as usize, color.height as usize),
        color: bytes(0),
        raw: vec![0; color.width as usize * color.height as usize],
        truth: counts(&bytes(2)),
        unit_m: depth.depth_unit_m,
    };
    register(depth, color, &counts(&bytes(1)), &mut scene.raw);
    scene
}

fn register(depth: &StreamProfile, color: &StreamProfile, from: &[u16], to: &mut [u16]) {
    let color_from_depth = color.pose_in_device.inverse().compose(&depth.pose_in_device);
    let size = |p: &StreamProfile| (p.width, p.height);
    let d = &depth.intrinsics;
    let c = &color.intrinsics;
    let mut registration = Registration::new(d, size(depth), c, size(color), &color_from_depth).unwrap();
    registration.depth_to_color(from, depth.depth_unit_m, to).unwrap();
}

fn counts(bytes: &[u8]) -> Vec<u16> {
    bytes.as_chunks::<2>().0.iter().map(|b| u16::from_le_bytes(*b)).collect()
}

/// Places and directions on the mount that show the table differently: as the mount has it, nearer and turned, further
/// back and from the side.
pub fn places() -> [Pose; 3] {
    let at = |translation_m, rotation_xyzw| Pose { translation_m, rotation_xyzw };
    [
        Pose::IDENTITY,
        at([0.12, 0.05, 0.15], [0.02, -0.09, 0.03, 0.995]),
        at([-0.15, -0.05, -0.1], [-0.05, 0.10, -0.02, 0.993]),
    ]
}
