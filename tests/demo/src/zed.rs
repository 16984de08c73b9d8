//! A folder of side-by-side images as a ZED 2i sends them: distorting lenses, cameras that are not quite parallel, and
//! the matching factory calibration.
//!
//! Left and right are two simulated cameras in the same world. Their undistorted images are bent by the lens of the
//! calibration, so that rows agree only after rectification by that calibration.

use anyhow::{Context, Result, ensure};
use depthrig_bus::{Distortion, HostTime, Intrinsics, Name, Pose};
use depthrig_calib::{Camera, PoseExt};
use depthrig_driver::{Backend, MemorySink, Stream, StreamRequest};
use depthrig_sim::synthetic::{SyntheticBackend, SyntheticConfig};
use glam::{DQuat, DVec2, DVec3};
use image::RgbImage;
use std::fmt::Write as _;
use std::path::Path;
use std::time::Duration;

/// Pixels of the left or right image: the mode VGA.
pub const SIZE: (u32, u32) = (672, 376);
/// Serial number of the camera that does not exist.
pub const SERIAL: &str = "39999999";
/// Different pairs; shown in a loop they swing to and fro.
const PAIRS: usize = 22;
const POSES: u32 = 12;
/// Rays for each pixel, in either direction.
const RAYS: u32 = 2;

/// The lens of one camera. Barrel distortion as these lenses have it.
fn lens(focal_px: f64, cx: f64, cy: f64, k1: f64) -> Intrinsics {
    let mut lens = Intrinsics::pinhole(focal_px, focal_px, cx, cy);
    lens.coeffs[..5].copy_from_slice(&[k1, 0.004, 0.0002, -0.0001, 0.0]);
    lens.model = Distortion::BrownConrady as u32;
    lens
}

/// Left and right.
pub fn lenses() -> [Intrinsics; 2] {
    [lens(303.1, 338.4, 186.2, -0.031), lens(302.4, 333.7, 189.9, -0.029)]
}

/// Pose of the right camera in the left one: some tenths of a degree off, as they leave the factory.
pub fn right_in_left() -> Pose {
    let turn = DQuat::from_scaled_axis(DVec3::new(0.0031, -0.0042, 0.0018));
    Pose { translation_m: [0.1198, 0.0002, -0.0003], rotation_xyzw: turn.to_array() }
}

/// The factory calibration's text, in the vendor's units and order (docs of the format: drivers/zed/src/conf.rs).
pub fn conf() -> Result<String> {
    let mut text = String::new();
    for (side, k) in ["LEFT", "RIGHT"].into_iter().zip(lenses()) {
        let fx = k.fx;
        let fy = k.fy;
        let cx = k.cx;
        let cy = k.cy;
        let [k1, k2, p1, p2, k3, ..] = k.coeffs;
        writeln!(text, "[{side}_CAM_VGA]\nfx={fx}\nfy={fy}\ncx={cx}\ncy={cy}")?;
        writeln!(text, "k1={k1}\nk2={k2}\np1={p1}\np2={p2}\nk3={k3}\n")?;
    }
    // From left to right a point moves by p_right = R p_left - t, with R = exp(r), t in millimetres.
    let to_right = right_in_left().inverse();
    let r = DQuat::from_array(to_right.rotation_xyzw).to_scaled_axis();
    let t = DVec3::from_array(to_right.translation_m) * -1000.0;
    writeln!(text, "[STEREO]\nBaseline={}\nTY={}\nTZ={}", t.x, t.y, t.z)?;
    writeln!(text, "CV_VGA={}\nRX_VGA={}\nRZ_VGA={}", r.y, r.x, r.z)?;
    Ok(text)
}

/// Writes the images and `SN39999999.conf` into `folder`.
pub fn write(folder: &Path) -> Result<()> {
    write_pairs(folder, shoot(POSES, PAIRS)?)
}

fn write_pairs(folder: &Path, [left, right]: [Seen; 2]) -> Result<()> {
    std::fs::create_dir_all(folder)?;
    std::fs::write(folder.join(format!("SN{SERIAL}.conf")), conf()?)?;
    let [left_lens, right_lens] = lenses();
    // Each simulated camera has its own optical centre, as each real one has.
    let to_left = Warp::new(&left_lens, &left.view).context("a lens that forms no image")?;
    let to_right = Warp::new(&right_lens, &right.view).context("a lens that forms no image")?;
    for (i, (l, r)) in left.images.iter().zip(&right.images).enumerate() {
        let mut both = RgbImage::new(2 * SIZE.0, SIZE.1);
        image::imageops::replace(&mut both, &to_left.bend(l), 0, 0);
        image::imageops::replace(&mut both, &to_right.bend(r), SIZE.0.into(), 0);
        let path = folder.join(format!("pair_{i:03}.png"));
        both.save(&path).with_context(|| format!("{}: cannot be written", path.display()))?;
    }
    Ok(())
}

/// The images of one camera without a lens.
struct Seen {
    view: Intrinsics,
    images: Vec<RgbImage>,
}

/// The simulated cameras, `left` and `right`, on a mount that swings through `poses`.
fn cameras(poses: u32) -> Result<SyntheticBackend> {
    let camera = |name: &str, pose_on_mount| SyntheticConfig {
        model: "zed2i".into(),
        serial: name.into(),
        pose_on_mount,
        poses,
        truth: true,
        ..SyntheticConfig::default()
    };
    let mount =
        Pose { translation_m: [0.0, -0.05, 0.0], rotation_xyzw: DQuat::from_rotation_x(-0.0716).to_array() };
    let configs = vec![camera("left", mount), camera("right", mount.compose(&right_in_left()))];
    Ok(SyntheticBackend::starting_at(configs, HostTime::now())?)
}

/// Images of both cameras at the same moments, `pairs` times, while the mount swings through `poses`.
fn shoot(poses: u32, pairs: usize) -> Result<[Seen; 2]> {
    let backend = cameras(poses)?;
    let request = StreamRequest {
        rate_hz: Some(30.0),
        size: Some((1280, 720)),
        ..StreamRequest::any(Name::new("color")?)
    };
    let start = |name| -> Result<Box<dyn Stream>> {
        Ok(backend.open(Some(name))?.start(std::slice::from_ref(&request))?)
    };
    let mut streams = [(start("left")?, MemorySink::default()), (start("right")?, MemorySink::default())];
    // Two frames for each pose, and some that have no partner.
    while streams.iter().any(|(_, sink)| sink.frames.len() < 2 * pairs + 12) {
        for (stream, sink) in &mut streams {
            stream.poll(Duration::from_millis(10), sink)?;
        }
    }
    let [(left_stream, left), (right_stream, right)] = &streams;
    let seen_by = |stream: &dyn Stream| -> Result<Seen> {
        let view = stream.profiles().first().context("no colour")?.intrinsics;
        Ok(Seen { view, images: Vec::new() })
    };
    let mut seen = [seen_by(left_stream.as_ref())?, seen_by(right_stream.as_ref())?];
    let image =
        |pixels: &[u8]| RgbImage::from_raw(1280, 720, pixels.to_vec()).context("an image of another size");
    let mut matched = 0;
    for (_, l, pixels) in &left.frames {
        let same = |r: &depthrig_driver::FrameMeta| r.capture_time.since_ns(l.capture_time).abs() < 8_000_000;
        let partner = right.frames.iter().find(|(_, r, _)| same(r));
        if let Some((_, _, other)) = partner {
            matched += 1;
            if matched % 2 == 1 && seen[0].images.len() < pairs {
                seen[0].images.push(image(pixels)?);
                seen[1].images.push(image(other)?);
            }
        }
    }
    ensure!(seen[0].images.len() == pairs, "only {} pairs were taken", seen[0].images.len());
    Ok(seen)
}

/// Where each ray of a lens lies in the image without one.
struct Warp {
    places: Vec<DVec2>,
}

impl Warp {
    fn new(lens: &Intrinsics, view: &Intrinsics) -> Option<Self> {
        let lens = Camera::new(lens).ok()?;
        let view = Camera::new(view).ok()?;
        let mut places = Vec::with_capacity((SIZE.0 * SIZE.1 * RAYS * RAYS) as usize);
        let part = |i: u32| (f64::from(i % RAYS) + 0.5) / f64::from(RAYS) - 0.5;
        for y in 0..SIZE.1 {
            for x in 0..SIZE.0 {
                for ray in 0..RAYS * RAYS {
                    let pixel = DVec2::new(f64::from(x) + part(ray), f64::from(y) + part(ray / RAYS));
                    places.push(view.project(lens.unproject(pixel)?)?);
                }
            }
        }
        Some(Self { places })
    }

    /// The image through the lens. Beyond its edge it goes on as at the edge.
    fn bend(&self, from: &RgbImage) -> RgbImage {
        let rays = (RAYS * RAYS) as usize;
        let mut out = RgbImage::new(SIZE.0, SIZE.1);
        for (pixel, places) in out.pixels_mut().zip(self.places.chunks_exact(rays)) {
            let mut sum = [0.0; 3];
            for place in places {
                let x = place.x.clamp(0.0, f64::from(from.width() - 1) - 1e-3);
                let y = place.y.clamp(0.0, f64::from(from.height() - 1) - 1e-3);
                let u = x as u32;
                let v = y as u32;
                let fx = x.fract();
                let fy = y.fract();
                for (dx, dy, share) in [
                    (0, 0, (1.0 - fx) * (1.0 - fy)),
                    (1, 0, fx * (1.0 - fy)),
                    (0, 1, (1.0 - fx) * fy),
                    (1, 1, fx * fy),
                ] {
                    let at = from.get_pixel(u + dx, v + dy).0;
                    (0..3).for_each(|c| sum[c] += share * f64::from(at[c]));
                }
            }
            pixel.0 = sum.map(|s| (s / rays as f64).round() as u8);
        }
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use depthrig_calib::stereo::Preset;
    use depthrig_driver::Poll;
    use depthrig_stereo::{StereoBackend, StereoMode, StereoOptions};
    use depthrig_zed::CalibrationFile;
    use depthrig_zed::conf::FactoryCalibration;
    use depthrig_zed::mode::Mode;
    use depthrig_zed::replay::{ZedPlaybackBackend, ZedPlaybackConfig};

    /// The text is read back as the values it was built from.
    #[test]
    fn the_calibration_is_the_cameras() {
        let read = FactoryCalibration::parse(&conf().unwrap(), "it").unwrap();
        let vga = read.at(Mode::Vga).unwrap();
        for (got, made) in [vga.left, vga.right].into_iter().zip(lenses()) {
            assert_eq!(
                (got.fx, got.fy, got.cx, got.cy, got.coeffs),
                (made.fx, made.fy, made.cx, made.cy, made.coeffs)
            );
        }
        let got = vga.right_in_left;
        let made = right_in_left();
        for p in [DVec3::ZERO, DVec3::new(0.3, -0.2, 2.0)] {
            assert!((got.transform_point(p) - made.transform_point(p)).length() < 1e-12);
        }
    }

    /// Depth computed from the pair, through rectification and matching, agrees with the simulation.
    #[test]
    fn depth_by_stereo_is_that_of_the_scene() {
        let folder = tempfile::tempdir().unwrap();
        // One pose: the truth is of the moment of the pair, whatever moment that is.
        let seen = shoot(1, 1).unwrap();
        let view = Camera::new(&seen[0].view).unwrap();
        write_pairs(folder.path(), seen).unwrap();
        let config = ZedPlaybackConfig {
            input: folder.path().to_owned(),
            serial: None,
            calibration: CalibrationFile::Known,
            rate_hz: Some(15.0),
            looped: false,
        };
        let modes = Preset::ALL.map(|p| StereoMode::preset(p, 0.45, 1)).into();
        let options = StereoOptions { modes, every_pair: true, range_m: (0.45, 20.0), ..<_>::default() };
        let wrapped = StereoBackend::new(Box::new(ZedPlaybackBackend::new(config)), options);
        let mut stream = wrapped.open(None).unwrap().start(&[]).unwrap();
        let mut sink = MemorySink::default();
        while stream.poll(Duration::from_millis(20), &mut sink).unwrap() != Poll::End {}

        let truth = StreamRequest {
            size: Some((1280, 720)),
            rate_hz: Some(30.0),
            ..StreamRequest::any(Name::new("depth_true_color").unwrap())
        };
        let mut camera_stream = cameras(1).unwrap().open(Some("left")).unwrap().start(&[truth]).unwrap();
        let mut true_sink = MemorySink::default();
        while true_sink.frames.is_empty() {
            camera_stream.poll(Duration::from_millis(10), &mut true_sink).unwrap();
        }
        let words =
            |b: &[u8]| -> Vec<u16> { b.chunks(2).map(|z| u16::from_le_bytes([z[0], z[1]])).collect() };
        let truth = words(&true_sink.frames[0].2);
        let unit_m = camera_stream.profiles()[0].depth_unit_m;
        for (i, profile) in stream.profiles().iter().enumerate() {
            let name = profile.stream.as_str();
            if !name.starts_with("depth_") {
                continue;
            }
            let (_, _, pixels) = sink.frames.iter().find(|f| f.0 == i).unwrap();
            let camera = Camera::new(&profile.intrinsics).unwrap();
            let mut errors = Vec::new();
            let mut shown = 0;
            for (n, z) in words(pixels).into_iter().enumerate() {
                let pixel = DVec2::new(f64::from(n as u32 % SIZE.0), f64::from(n as u32 / SIZE.0));
                let far = if z == 0 { 1.0 } else { f64::from(z) / 1000.0 };
                let point = profile.pose_in_device.transform_point(camera.unproject(pixel).unwrap() * far);
                let at = view.project(point).unwrap().round();
                if !(0.0..1280.0).contains(&at.x) || !(0.0..720.0).contains(&at.y) {
                    continue;
                }
                let true_m = f64::from(truth[at.y as usize * 1280 + at.x as usize]) * unit_m;
                if true_m > 0.0 {
                    shown += 1;
                    if z > 0 {
                        errors.push((point.z / true_m - 1.0).abs());
                    }
                }
            }
            errors.sort_by(f64::total_cmp);
            let seen = errors.len() as f64 / f64::from(shown);
            let near = errors.iter().filter(|e| **e < 0.05).count() as f64 / errors.len() as f64;
            let middle = errors[errors.len() / 2];
            println!("{name}: {seen:.3} of the scene, half within {middle:.4}, {near:.3} within 5 %");
            // Wood and walls have little for stereo to see: half a pixel of disparity is 1.5 % here, and what has no
            // texture gets no depth.
            assert!(seen > 0.6 && middle < 0.03 && near > 0.8, "{name}: {seen}, {middle}, {near}");
        }
    }

    /// The notice of live stereo on a folder's pairs, played in a loop.
    fn said_of(folder: &Path) -> Option<String> {
        let config = ZedPlaybackConfig {
            input: folder.to_owned(),
            serial: None,
            calibration: CalibrationFile::Known,
            rate_hz: Some(15.0),
            looped: true,
        };
        // Only the two images matter: a matcher that does nothing.
        let options = StereoOptions { every_pair: true, ..<_>::default() };
        let notice = std::sync::Arc::clone(&options.notice);
        let wrapped = StereoBackend::new(Box::new(ZedPlaybackBackend::new(config)), options);
        let mut stream = wrapped.open(None).unwrap().start(&[]).unwrap();
        let mut sink = MemorySink::default();
        // Enough for more looks than are believed.
        while sink.frames.iter().filter(|f| f.0 == 0).count() < 60 {
            assert!(stream.poll(Duration::from_millis(20), &mut sink).unwrap() != Poll::End);
        }
        // The last look may still be under way.
        std::thread::sleep(Duration::from_millis(500));
        notice.lock().unwrap().clone()
    }

    /// Both images once had the left one's optical centre: 1.5 px between their rows, which showed only as a smaller
    /// share of filled pixels.
    #[test]
    fn an_optical_centre_of_the_other_side_is_reported() {
        let folder = tempfile::tempdir().unwrap();
        let good = folder.path().join("good");
        let wrong = folder.path().join("wrong");
        write_pairs(&good, shoot(4, 4).unwrap()).unwrap();
        let mut seen = shoot(4, 4).unwrap();
        seen[1].view = seen[0].view;
        write_pairs(&wrong, seen).unwrap();
        assert_eq!(said_of(&good), None);
        let said = said_of(&wrong).unwrap();
        assert!(said.contains("1.5") && said.contains("higher in the right one"), "{said}");
    }

    /// A flat image of columns comes out with the column that the lens sees.
    #[test]
    fn a_lens_bends_as_it_says() {
        let view = Intrinsics::pinhole(530.0, 530.0, 640.0, 360.0);
        let k = lenses()[0];
        let warp = Warp::new(&k, &view).unwrap();
        let slope = RgbImage::from_fn(1280, 720, |x, y| image::Rgb([(x / 5) as u8, (y / 3) as u8, 0]));
        let bent = warp.bend(&slope);
        let camera = Camera::new(&k).unwrap();
        for (x, y) in [(100, 50), (336, 188), (600, 300)] {
            let ray = camera.unproject(DVec2::new(f64::from(x), f64::from(y))).unwrap();
            let u = 530.0 * ray.x / ray.z + 640.0;
            let v = 530.0 * ray.y / ray.z + 360.0;
            let [r, g, _] = bent.get_pixel(x, y).0;
            assert!((f64::from(r) - (u - 2.0) / 5.0).abs() < 1.0, "{r} at {u}");
            assert!((f64::from(g) - (v - 1.0) / 3.0).abs() < 1.0, "{g} at {v}");
        }
    }
}
