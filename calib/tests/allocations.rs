//! Per-frame work allocates no memory: counted by an allocator.
#![allow(clippy::unwrap_used)]

use depthrig_bus::{Distortion, Intrinsics, PixelFormat, Pose};
use depthrig_calib::stereo::{
    DisparityMap, Gray, Matcher, Order, OrderCheck, Parameters, Preset, RowCheck, SgmMatcher, StereoPair,
};
use depthrig_calib::{Deprojection, PointCloud, Rectifier, Registration, Undistortion, View};
use depthrig_counting::{Counting, during, in_process_during};

#[global_allocator]
static COUNTING: Counting = Counting;

/// One test alone: others in this program would be counted too.
#[test]
fn a_frame_takes_no_memory() {
    let size = (160, 120);
    let k = Intrinsics::pinhole(150.0, 150.0, 79.5, 59.5);
    let coeffs = [-0.05, 0.06, 0.0007, 0.0002, -0.02, 0.0, 0.0, 0.0];
    let bent = Intrinsics { coeffs, model: Distortion::InverseBrownConrady as u32, ..k };
    let pose = Pose { translation_m: [0.015, 0.0, 0.0], ..Pose::IDENTITY };
    let depth: Vec<u16> =
        (0..160 * 120).map(|i| if i % 17 == 0 { 0 } else { 700 + (i % 160) as u16 }).collect();
    let color = vec![7; 160 * 120 * 3];
    let mut z = vec![0; 160 * 120];
    let mut rgb = vec![0; 160 * 120 * 3];
    for (d, c) in [(&k, &k), (&k, &bent), (&bent, &bent)] {
        let mut one = Registration::new(d, size, c, size, &pose).unwrap();
        assert_eq!(
            during(|| for _ in 0..3 {
                one.depth_to_color(&depth, 0.001, &mut z).unwrap();
                one.color_to_depth(&depth, 0.001, &color, &mut rgb).unwrap();
            }),
            0
        );
        // Handing a frame over to threads takes a block of a queue every 31st time or more seldom.
        let mut several = one.with_threads(3);
        for _ in 0..5 {
            several.depth_to_color(&depth, 0.001, &mut z).unwrap();
        }
        let taken = in_process_during(|| {
            for _ in 0..62 {
                several.depth_to_color(&depth, 0.001, &mut z).unwrap();
            }
        });
        // The pool's own queues take some now and then, more on a busy computer: far from one for each frame.
        assert!(taken <= 16, "{taken} in 62 frames");
    }
    let deprojection = Deprojection::new(&bent, size).unwrap();
    let mut cloud = PointCloud::default();
    deprojection.cloud(&depth, 0.001, Some(&color), &mut cloud).unwrap();
    assert_eq!(during(|| deprojection.cloud(&depth, 0.001, Some(&color), &mut cloud).unwrap()), 0);
    let map = Undistortion::new((&bent, size), (&k, size), glam::DMat3::IDENTITY).unwrap();
    assert_eq!(
        during(|| {
            map.bytes::<3>(&color, &mut rgb).unwrap();
            map.depth(&depth, &mut z).unwrap();
        }),
        0
    );
    let rectifier = Rectifier::new(&bent, &k, &pose, size).unwrap();
    let yuyv = vec![90; 160 * 120 * 2];
    let mut grey = vec![0; 160 * 120];
    assert_eq!(
        during(|| for view in View::BOTH {
            rectifier.rectify(view, PixelFormat::Rgb8, &color, &mut grey, Some(&mut rgb)).unwrap();
            rectifier.rectify(view, PixelFormat::Yuyv, &yuyv, &mut grey, Some(&mut rgb)).unwrap();
        }),
        0
    );
    let pair = StereoPair::new(Gray::packed(&grey, 160, 120), Gray::packed(&yuyv, 160, 120));
    for preset in Preset::ALL {
        let parameters = Parameters::preset(preset, 48);
        let mut map = DisparityMap::default();
        let mut one = SgmMatcher::new(160, 120, &parameters, 1).unwrap();
        one.run(&pair, &mut map).unwrap();
        assert_eq!(during(|| one.run(&pair, &mut map).unwrap()), 0, "{preset}");
        let mut several = SgmMatcher::new(160, 120, &parameters, 3).unwrap();
        for _ in 0..5 {
            several.run(&pair, &mut map).unwrap();
        }
        // Each pair is handed over four or eight times.
        let taken = in_process_during(|| (0..31).for_each(|_| several.run(&pair, &mut map).unwrap()));
        assert!(taken <= 16, "{preset}: {taken} in 31 pairs");
    }
    let mut order = OrderCheck::new(800, 24).unwrap();
    let pair = StereoPair::new(Gray::packed(&grey, 800, 24), Gray::packed(&grey, 800, 24));
    order.check(&pair).unwrap();
    assert_eq!(during(|| assert_eq!(order.check(&pair).unwrap(), Order::Unclear)), 0);
    // Noise, so that there is much to look at, and more pairs than count at once.
    let mut state = 1_u32;
    let mut next = || {
        state ^= state << 13;
        state ^= state >> 17;
        state ^= state << 5;
        (state >> 24) as u8
    };
    let noise: Vec<u8> = (0..400 * 240).map(|_| next()).collect();
    let pair = StereoPair::new(Gray::packed(&noise, 400, 240), Gray::packed(&noise, 400, 240));
    let mut rows = RowCheck::new(400, 240);
    let taken = during(|| {
        for _ in 0..RowCheck::PAIRS + 2 {
            assert!(rows.look(&pair).unwrap() > 50);
            assert!(rows.offset().is_some_and(|o| !o.is_bad()));
        }
    });
    assert_eq!(taken, 0, "looking at rows");
}
