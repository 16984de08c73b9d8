//! Tests of the picture and the page.

use super::*;

fn look() -> Look {
    let (w, h) = (320, 240);
    let color = RgbImage::from_fn(w, h, |x, y| image::Rgb([(x % 256) as u8, (y % 256) as u8, 90]));
    let n = (w * h) as usize;
    let raw: Vec<f32> = (0..n).map(|i| if i % 5 == 0 { 0.0 } else { 1.0 }).collect();
    let refined = (0..n).map(|i| if i % w as usize > 200 { 1.3 } else { 1.0 }).collect();
    Look {
        color,
        raw,
        refined,
        intrinsics: Intrinsics::pinhole(300.0, 300.0, 160.0, 120.0),
        title: "a <b> & c".to_owned(),
        engine: "fill".to_owned(),
        note: String::new(),
    }
}

#[test]
fn the_picture_has_four_panels_and_legends() {
    let picture = panels::draw(&look());
    assert_eq!(picture.dimensions(), (2 * 320 + 36, 2 * (240 + 26 + 40) + 36));
    let panel = |n: u32, x: u32, y: u32| {
        picture.get_pixel(12 + n % 2 * 332 + x, 12 + n / 2 * (240 + 66 + 12) + 26 + y).0
    };
    assert_eq!(panel(0, 7, 9), [7, 9, 90]);
    // Holes of raw depth are black; what refined depth alone has is grey; 0.3 m are at the end of the colours.
    assert_eq!(panel(1, 5, 0), [0; 3]);
    assert_eq!(panel(3, 5, 0), [70; 3]);
    assert_eq!(panel(3, 251, 0), crate::turbo::turbo(1.0));
    assert_eq!(panel(3, 6, 0), crate::turbo::turbo(0.0));
}

#[test]
fn the_page_is_one_file_of_bounded_size() {
    let page = page::write(&look()).unwrap();
    assert!(
        !page.contains("@RAW@") && !page.contains("http") && !page.contains("src="),
        "it needs something else"
    );
    assert!(page.contains("a &lt;b&gt; &amp; c") && !page.contains("<b>"));
    let (mut large, n) = (look(), 1280 * 960);
    large.color = RgbImage::new(1280, 960);
    (large.raw, large.refined) = (vec![1.0; n], vec![1.0; n]);
    assert!(page::write(&large).unwrap().len() < 3_000_000);
    (large.raw, large.refined) = (vec![0.0; n], vec![0.0; n]);
    assert!(page::write(&large).unwrap().len() < 20_000, "no depth at all is a page too");
}

#[test]
fn arrays_of_numpy() {
    let mut file = b"\x93NUMPY\x01\x00\x46\x00".to_vec();
    file.extend(format!("{:<69}\n", "{'descr': '<f4', 'fortran_order': False, 'shape': (1, 2), }").bytes());
    file.extend([1.5f32.to_le_bytes(), f32::NAN.to_le_bytes()].concat());
    assert_eq!(npy(&file, (2, 1)), Some(vec![1.5, 0.0]));
    assert_eq!(npy(&file, (1, 2)), None);
    for end in 0..file.len() {
        assert_eq!(npy(&file[..end], (2, 1)), None, "{end}");
    }
}
