use super::*;

#[test]
fn parts_of_the_image_that_the_board_never_reached_are_named() {
    let size = ImageSize { width: 640, height: 480 };
    let everywhere =
        (0..64).flat_map(|x| (0..48).map(move |y| DVec2::new(f64::from(x) * 10.0, f64::from(y) * 10.0)));
    assert!(Coverage::new(size, everywhere.clone()).empty_parts().is_empty());
    let left = Coverage::new(size, everywhere.filter(|p| p.x < 420.0 || p.y > 200.0));
    assert_eq!(left.empty_parts(), ["the top right"]);
    assert!(left.share() < 1.0);
}
