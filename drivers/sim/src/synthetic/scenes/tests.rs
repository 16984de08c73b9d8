use super::*;

fn settings(cameras: &[&str]) -> Settings {
    let cameras = cameras.iter().map(|c| (*c).to_owned()).collect();
    Settings { seed: 5, width: 192, height: 144, cameras, ..Settings::default() }
}

#[test]
fn a_sample_depends_on_seed_and_number_alone() {
    let generator = Generator::new(settings(&["d435", "l515"])).unwrap();
    let fifth = generator.sample(5).unwrap();
    for n in [1, 3, 5] {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(n).build().unwrap();
        let again = Generator::new(settings(&["d435", "l515"])).unwrap();
        drop(again.sample(0).unwrap());
        assert_eq!(pool.install(|| again.sample(5)).unwrap(), fifth, "{n} threads");
    }
    assert_eq!(fifth.camera, "l515");
    assert_eq!(fifth.sensor_model, "tof");
    let other = Generator::new(Settings { seed: 6, ..settings(&["d435", "l515"]) }).unwrap();
    assert_ne!(other.sample(5).unwrap().truth, fifth.truth);
    assert_ne!(generator.sample(7).unwrap().truth, fifth.truth);
}

#[test]
fn another_measurement_is_of_the_same_world_and_not_the_same() {
    for sensor in [Sensor::Statistical, Sensor::Stereo] {
        let made = |again| {
            Generator::new(Settings { sensor, again, ..settings(&["d435"]) }).unwrap().sample(4).unwrap()
        };
        let [first, second, third] = [made(0), made(1), made(2)];
        assert_eq!((&first.color, &first.truth), (&second.color, &second.truth), "{sensor:?}");
        assert_eq!(second, made(1));
        let differ = |a: &Triplet, b: &Triplet| a.raw.iter().zip(&b.raw).filter(|(a, b)| a != b).count();
        let pixels = first.raw.len();
        assert!(differ(&first, &second) * 10 > pixels && differ(&second, &third) * 10 > pixels, "{sensor:?}");
    }
}

#[test]
fn a_world_as_meshes_is_that_of_the_sample() {
    let generator = Generator::new(settings(&["d435"])).unwrap();
    for number in [0, 3] {
        let sample = generator.sample(number).unwrap();
        let world = generator.world(number);
        assert_eq!((&world.truth, &world.material), (&sample.truth, &sample.material));
        // Where a pixel sees a part, one of the part's corners is near.
        let axes: Vec<glam::DVec3> = world.camera.iter().map(|c| glam::DVec3::from_array(*c)).collect();
        let k = &world.intrinsics;
        for (i, part) in world.part.iter().enumerate().step_by(97) {
            let z = f64::from(world.truth[i]) * TRUTH_UNIT_M;
            if z == 0.0 {
                continue;
            }
            let x = ((i % 192) as f64 - k.cx) / k.fx;
            let y = ((i / 192) as f64 - k.cy) / k.fy;
            let place = (axes[3] + (axes[0] * x + axes[1] * y + axes[2]) * z).as_vec3();
            let part = &world.parts[usize::from(*part)];
            assert_eq!(part.material, world.material[i]);
            let off = part.corners.iter().map(|c| (Vec3::from(*c) - place).length()).fold(9.0, f32::min);
            let pixel = z as f32 / k.fx as f32;
            assert!(off < 4.0 * pixel, "{number}: pixel {i}: {off} m, a pixel is {pixel} m wide");
        }
    }
}

/// Share of holes, and median error in metres of what was measured, by material.
fn quality(samples: &[Triplet], material: u8) -> (f64, f64) {
    let mut holes = 0;
    let mut seen = 0;
    let mut errors = Vec::new();
    for s in samples {
        for ((t, r), m) in s.truth.iter().zip(&s.raw).zip(&s.material) {
            let z = f64::from(*t) * TRUTH_UNIT_M;
            if *m != material || !(0.3..3.0).contains(&z) {
                continue;
            }
            seen += 1;
            if *r == 0 {
                holes += 1;
            } else {
                errors.push((f64::from(*r) * s.raw_unit_m - z).abs() / z);
            }
        }
    }
    errors.sort_by(f64::total_cmp);
    assert!(errors.len() > 100, "material {material}: {} of {seen} measured", errors.len());
    (f64::from(holes) / f64::from(seen), errors[errors.len() / 2])
}

#[test]
fn every_sensor_measures_most_of_what_is_diffuse_and_less_of_the_rest() {
    for (camera, sensor) in [
        ("d435", Sensor::Statistical),
        ("l515", Sensor::Statistical),
        ("zed2i", Sensor::Statistical),
        ("d435", Sensor::Stereo),
        ("d415", Sensor::Stereo),
    ] {
        // At the size at which the sensors work.
        let wide = Settings { width: 640, height: 480, sensor, ..settings(&[camera]) };
        let generator = Generator::new(wide).unwrap();
        let samples: Vec<Triplet> = (0..10).map(|i| generator.sample(i).unwrap()).collect();
        let (holes, error) = quality(&samples, 1);
        let (dark_holes, dark_error) = quality(&samples, 5);
        let (_, glass_error) = quality(&samples, 4);
        let text = format!(
            "{camera} {sensor:?}: {holes:.3} {error:.5} dark {dark_holes:.3} {dark_error:.5} glass {glass_error:.4}"
        );
        assert!(holes < 0.45 && error < 0.016, "{text}");
        assert!(dark_holes > holes || dark_error > 1.3 * error, "{text}");
        assert!(glass_error > error, "{text}");
    }
}

#[test]
fn truth_lies_in_the_view_of_colour() {
    // Without faults, measured depth that is registered to colour is the truth: both come from other rays.
    let generator =
        Generator::new(Settings { width: 320, height: 240, ..settings(&["d435", "kinect", "l515"]) })
            .unwrap();
    for number in 0..6 {
        let s = generator.sample(number).unwrap();
        let near = s.truth.iter().zip(&s.raw).filter(|(t, r)| (1..30_000).contains(*t) && **r > 0);
        let off: Vec<f64> =
            near.map(|(t, r)| f64::from(*r) * s.raw_unit_m / (f64::from(*t) * TRUTH_UNIT_M) - 1.0).collect();
        let good = off.iter().filter(|d| d.abs() < 0.05).count();
        assert!(good * 10 > off.len() * 8, "{number}: {good} of {}", off.len());
        assert_eq!(s.color.len(), 3 * 320 * 240);
        let mean = s.color.iter().map(|v| f64::from(*v)).sum::<f64>() / s.color.len() as f64;
        assert!((20.0..235.0).contains(&mean), "{number}: mean {mean}");
        assert!(s.material.iter().all(|m| *m <= 5));
    }
}

#[test]
fn wrong_settings_are_refused() {
    let refused = |s: Settings| Generator::new(s).unwrap_err().to_string();
    assert!(refused(settings(&["d999"])).contains("d435"));
    assert!(refused(settings(&[])).contains("no camera"));
    assert!(refused(Settings { width: 8, ..settings(&["d435"]) }).contains("8x144"));
    let meshes = Settings { families: vec![Family::Mesh], ..settings(&["d435"]) };
    assert!(refused(meshes.clone()).contains("OBJ"));
    let bad = TriangleMesh { name: "cup.obj".into(), corners: vec![[0.0; 3]; 3], triangles: vec![[0, 1, 3]] };
    assert!(refused(Settings { meshes: vec![bad], ..meshes }).contains("cup.obj"));
}
