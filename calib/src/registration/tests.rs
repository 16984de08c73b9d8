//! Tests of registration: against a model that is slow and plainly right.

use super::*;

fn size_of(registration: &Registration) -> ((usize, usize), (usize, usize)) {
    (registration.depth_size(), registration.color_size())
}

#[test]
fn a_wall_seen_from_beside() {
    let k = Intrinsics::pinhole(60.0, 60.0, 31.5, 23.5);
    let moved = Pose { translation_m: [0.105, 0.0, 0.0], ..Pose::IDENTITY };
    for method in [Method::Splat, Method::Triangles] {
        let mut r = Registration::new(&k, (64, 48), &k, (64, 48), &moved, method).unwrap();
        assert_eq!(size_of(&r), ((64, 48), (64, 48)));
        let mut out = vec![7; 64 * 48];
        r.depth_to_color(&[1000; 64 * 48], 0.001, &mut out).unwrap();
        for (i, z) in out.iter().enumerate() {
            let (x, y) = (i % 64, i / 64);
            // A neighbourhood does not draw its last row and column, and begins in the middle of its first pixel.
            let (first, last) = if method == Method::Triangles { (7, 46) } else { (6, 47) };
            assert_eq!(*z, if x < first || y > last { 0 } else { 1000 }, "{method:?} at {x}, {y}");
        }
    }
}
