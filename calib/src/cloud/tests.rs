//! Tests of point clouds and their files.

use super::*;

fn small() -> (Deprojection, PointCloud) {
    let d = Deprojection::new(&Intrinsics::pinhole(2.0, 4.0, 0.5, 0.0), (2, 2)).unwrap();
    let mut cloud = PointCloud::default();
    let color: Vec<u8> = (1..=12).collect();
    d.cloud(&[1000, 0, 2000, 65_535], 0.001, Some(&color), &mut cloud).unwrap();
    (d, cloud)
}

#[test]
fn points_by_hand() {
    let (d, cloud) = small();
    assert_eq!(cloud.points[0], [-0.25, 0.0, 1.0]);
    assert_eq!(cloud.points[1], [-0.5, 0.5, 2.0]);
    assert_eq!(cloud.colors, [[1, 2, 3], [7, 8, 9], [10, 11, 12]]);
    let mut metres = PointCloud::default();
    d.cloud_of_metres(&[1.0, f32::NAN, 2.0, -1.0], None, &mut metres).unwrap();
    assert_eq!((metres.points.as_slice(), metres.colors.len()), (&cloud.points[..2], 0));
    metres.transform(&Pose { translation_m: [0.0, 0.0, 1.0], rotation_xyzw: [0.0, 0.0, 1.0, 0.0] });
    for (have, want) in metres.points.iter().zip([[0.25, 0.0, 2.0], [0.5, -0.5, 3.0]]) {
        assert!(have.iter().zip(want).all(|(h, w)| (h - w).abs() < 1e-6), "{have:?}");
    }
    let e = d.cloud(&[1; 3], 0.001, None, &mut metres).unwrap_err();
    assert_eq!(e.kind(), ErrorKind::SizeMismatch);
}

#[test]
fn ply_byte_by_byte() {
    let (_, cloud) = small();
    let mut file = Vec::new();
    write_ply(&cloud, &mut file).unwrap();
    let end = file.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    let head = std::str::from_utf8(&file[..end]).unwrap();
    assert!(head.starts_with("ply\nformat binary_little_endian 1.0\n"), "{head}");
    assert!(head.contains("\nelement vertex 3\n"), "{head}");
    assert_eq!(file.len() - end, 3 * 15);
    assert_eq!(
        &file[end..end + 15],
        [&(-0.25f32).to_le_bytes()[..], &[0; 4], &1f32.to_le_bytes(), &[1, 2, 3]].concat()
    );
}

#[test]
fn pcd_byte_by_byte() {
    let (_, mut cloud) = small();
    let mut file = Vec::new();
    write_pcd(&cloud, &mut file).unwrap();
    let end = file.windows(12).position(|w| w == b"DATA binary\n").unwrap() + 12;
    assert!(std::str::from_utf8(&file[..end]).unwrap().contains("\nFIELDS x y z rgb\n"));
    assert_eq!(file.len() - end, 3 * 16);
    assert_eq!(&file[end + 12..end + 16], [3, 2, 1, 0]);
    cloud.colors.pop();
    assert_eq!(write_pcd(&cloud, &mut file).unwrap_err().kind(), ErrorKind::BadInput);
    cloud.colors.clear();
    file.clear();
    write_pcd(&cloud, &mut file).unwrap();
    assert!(file.ends_with(&65.535f32.to_le_bytes()));
}
