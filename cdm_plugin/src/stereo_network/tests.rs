//! Networks of every form that is taken, run; and those that are not taken, refused by name.

use super::fake::FakeNetwork;
use super::*;
use depthrig_calib::stereo::Gray;

const SIZE: (usize, usize) = (90, 50);

/// Noise in colour whose right image is `shift` pixels on.
fn noise(shift: usize, (width, height): (usize, usize)) -> (Vec<u8>, Vec<u8>) {
    let spot = |x: usize, y: usize, c: usize| {
        let mut v = ((x * 7919 + y * 104_729 + c * 31) as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15);
        v ^= v >> 29;
        (v.wrapping_mul(0xBF58_476D_1CE4_E5B9) >> 40) as u8
    };
    let image = |shift: usize| {
        let at = move |i: usize| (i % width + shift, i / width);
        (0..width * height).flat_map(|i| [0, 1, 2].map(|c| spot(at(i).0, at(i).1, c))).collect::<Vec<u8>>()
    };
    (image(0), image(shift))
}

fn grey(rgb: &[u8]) -> Vec<u8> {
    rgb.as_chunks().0.iter().map(|[r, ..]: &[u8; 3]| *r).collect()
}

fn options() -> StereoNetworkOptions {
    StereoNetworkOptions { library: None, device: "cpu".into(), threads: 2, pixels: None, negative: false }
}

struct Home(tempfile::TempDir);

impl Home {
    fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    fn open(
        &self,
        fake: &FakeNetwork,
        size: (usize, usize),
        options: &StereoNetworkOptions,
    ) -> Result<StereoNetwork> {
        let file = self.0.path().join("network of mine.onnx");
        std::fs::write(&file, fake.file()).unwrap();
        StereoNetwork::open(&file, size.0, size.1, options)
    }

    /// `None`, with a line that says so, where the library is not installed; see `tests/it/onnxruntime.rs`.
    fn try_open(&self, fake: &FakeNetwork, options: &StereoNetworkOptions) -> Option<StereoNetwork> {
        match self.open(fake, SIZE, options) {
            Err(e)
                if e.kind() == ErrorKind::NoEngine
                    && std::env::var_os("DEPTHRIG_REQUIRE_ONNXRUNTIME").is_none() =>
            {
                println!("skipped: {e}");
                None
            }
            opened => Some(opened.unwrap()),
        }
    }
}

/// Runs it on noise of this shift; disparities within a margin, and confidences.
fn run(network: &mut StereoNetwork, shift: usize) -> depthrig_calib::Result<(Vec<f32>, DisparityMap)> {
    let (left, right) = noise(shift, SIZE);
    let l = grey(&left);
    let r = grey(&right);
    let (w, h) = SIZE;
    let pair = StereoPair {
        left: Gray::packed(&l, w, h),
        right: Gray::packed(&r, w, h),
        left_rgb: Some(&left),
        right_rgb: Some(&right),
    };
    let mut map = DisparityMap::default();
    network.run(&pair, &mut map)?;
    let inner = |i: &usize| (20..w - 4).contains(&(i % w)) && (4..h - 4).contains(&(i / w));
    Ok(((0..w * h).filter(inner).map(|i| map.disparity[i]).collect(), map))
}

#[test]
fn every_form_that_is_taken() {
    let home = Home::new();
    let forms = [
        FakeNetwork::default(),
        FakeNetwork { channels: 1, ..FakeNetwork::default() },
        FakeNetwork { stacked: true, names: ["input", ""], ..FakeNetwork::default() },
        FakeNetwork { stacked: true, channels: 1, names: ["input", ""], ..FakeNetwork::default() },
        FakeNetwork { channels_last: true, ..FakeNetwork::default() },
        FakeNetwork { stacked: true, channels_last: true, names: ["input", ""], ..FakeNetwork::default() },
        FakeNetwork { names: ["img_left", "img_right"], right_first: true, ..FakeNetwork::default() },
        FakeNetwork { names: ["0", "1"], confidence: true, ..FakeNetwork::default() },
        FakeNetwork { size: Some(SIZE), ..FakeNetwork::default() },
        FakeNetwork {
            negative: true,
            metadata: vec![("depthrig.negative", "true")],
            ..FakeNetwork::default()
        },
    ];
    for fake in forms {
        for pixels in [None, Some(NetworkPixels::ImageNet)] {
            let Some(mut network) = home.try_open(&fake, &StereoNetworkOptions { pixels, ..options() })
            else {
                return;
            };
            for shift in [0, 5, 11] {
                let (inner, map) = run(&mut network, shift).unwrap();
                assert!(inner.iter().all(|d| *d == shift as f32), "{fake:?} {shift}: {:?}", &inner[..20]);
                assert_eq!((map.width, map.height), SIZE);
                for (i, (d, c)) in map.disparity.iter().zip(&map.confidence).enumerate() {
                    assert_eq!(d.is_nan(), *c == 0);
                    // A match left of the right image's edge is invalid.
                    assert!(d.is_nan() || *d <= (i % SIZE.0) as f32);
                }
                assert!(!fake.confidence || map.confidence[25 * SIZE.0 + 50] > 250);
            }
            let description = network.describe();
            assert_eq!(description.name, "neural");
            assert!(
                description.producer.starts_with("onnxruntime 1.") && description.producer.len() <= 31,
                "{description:?}"
            );
            let expected = pixels.unwrap_or_default().name();
            let p = &description.parameters;
            assert!(
                p.contains("network=network_of_mine.onnx sha256=")
                    && p.contains(&format!("pixels={expected}")),
                "{p}"
            );
        }
    }
}

/// A network of one size sees the image in that size, and its disparities are those of the image again.
#[test]
fn a_size_of_its_own() {
    let home = Home::new();
    let fake = FakeNetwork { size: Some((180, 100)), disparities: 32, ..FakeNetwork::default() };
    let Some(mut network) = home.try_open(&fake, &options()) else { return };
    assert!(network.describe().parameters.contains("size=180x100 resized"), "{:?}", network.describe());
    let (inner, _) = run(&mut network, 6).unwrap();
    let off = inner.iter().filter(|d| (**d - 6.0).abs() > 0.51).count();
    assert!(off * 50 < inner.len(), "{off} of {} disparities are not 6", inner.len());
}

#[test]
fn the_sign_is_found_out() {
    let home = Home::new();
    let fake = FakeNetwork { negative: true, ..FakeNetwork::default() };
    let Some(mut network) = home.try_open(&fake, &options()) else { return };
    let e = run(&mut network, 5).unwrap_err().to_string();
    assert!(e.contains("negative numbers") && e.contains("--network-negative"), "{e}");
    let mut network = home.open(&fake, SIZE, &StereoNetworkOptions { negative: true, ..options() }).unwrap();
    assert!(run(&mut network, 5).unwrap().0.iter().all(|d| *d == 5.0));
}

#[test]
fn pixels_are_scaled_as_they_should() {
    for (pixels, dark, bright) in [
        (NetworkPixels::Bytes, 0.0, 255.0),
        (NetworkPixels::Unit, 0.0, 1.0),
        (NetworkPixels::Signed, -1.0, 1.0),
        // (0 - 0.456) / 0.224 and (1 - 0.456) / 0.224.
        (NetworkPixels::ImageNet, -2.035_714, 2.428_571),
    ] {
        let scale = pixels.scale(1);
        let of = |byte: f32| byte * scale.factor + scale.offset;
        assert!((of(0.0) - dark).abs() < 1e-5 && (of(255.0) - bright).abs() < 1e-5, "{pixels}");
        assert_eq!(pixels.name().parse::<NetworkPixels>().unwrap(), pixels);
    }
    assert!("bgr".parse::<NetworkPixels>().unwrap_err().to_string().contains("imagenet"));
}

fn outlet(name: &str, shape: &[i64]) -> Outlet {
    Outlet { name: name.into(), kind: "f32".into(), is_float: true, shape: Some(shape.to_vec()) }
}

#[test]
fn other_inputs_get_an_error_that_says_what_is_taken() {
    let side = |name| outlet(name, &[1, 3, -1, -1]);
    let disparity = [outlet("disparity", &[1, 1, -1, -1])];
    assert!(Form::of(&[side("a"), side("b")], &disparity).is_ok());
    let integer = Outlet { kind: "u8".into(), is_float: false, ..side("b") };
    for (inputs, why) in [
        (vec![], "there are 0 of them"),
        (vec![side("a"), side("b"), side("iterations")], "there are 3 of them"),
        (vec![side("a"), outlet("b", &[1, 4, -1, -1])], "b has another number of channels"),
        (vec![side("a"), outlet("b", &[1, 1, -1, -1])], "they are not alike"),
        (vec![side("a"), outlet("b", &[1, 3, 480, 640])], "they are not alike"),
        (vec![outlet("a", &[2, 3, -1, -1]), side("b")], "a takes 2 images at once"),
        (vec![side("a"), integer], "b is not an image in 32-bit floats"),
        (vec![outlet("a", &[1, 3])], "a is not an image"),
        (vec![side("a")], "a has another number of channels"),
        (vec![outlet("a", &[1, 6, 0, 640])], "a has no size"),
        (vec![Outlet { shape: None, ..side("a") }, side("b")], "a is not an image"),
    ] {
        let e = Form::of(&inputs, &disparity).unwrap_err();
        assert!(e.contains(why) && e.contains("taken are two inputs"), "{e}");
    }
}

#[test]
fn the_output_is_the_one_that_is_named_so() {
    let pair = [outlet("left", &[1, 3, -1, -1]), outlet("right", &[1, 3, -1, -1])];
    let named = |names: &[&str]| {
        let outputs: Vec<_> = names.iter().map(|n| outlet(n, &[1, 1, -1, -1])).collect();
        Form::of(&pair, &outputs).map(|f| (f.output, f.confidence))
    };
    let of = |a: &str, b: Option<&str>| Ok((a.to_owned(), b.map(str::to_owned)));
    assert_eq!(named(&["out"]), of("out", None));
    assert_eq!(named(&["out", "confidence"]), of("out", Some("confidence")));
    assert_eq!(named(&["features", "disp_final"]), of("disp_final", None));
    assert!(named(&[]).unwrap_err().contains("none is a disparity"));
    assert!(named(&["a", "b"]).unwrap_err().contains("none of them is named"));
    assert!(named(&["disp_1", "disp_2"]).unwrap_err().contains("several"));
    let integer = Outlet { is_float: false, ..outlet("disp", &[1, 1, -1, -1]) };
    assert!(Form::of(&pair, &[integer]).unwrap_err().contains("32-bit"));
}

#[test]
fn planes_are_found_in_what_comes_out() {
    let of = |shape: &[i64]| {
        let len = shape.iter().product::<i64>() as usize;
        form::plane(shape, len, 6, 4).map(|p| p.step)
    };
    for shape in [&[4, 6][..], &[1, 4, 6], &[1, 1, 4, 6], &[1, 4, 6, 1], &[1, 2, 4, 6]] {
        assert_eq!(of(shape), Ok(1), "{shape:?}");
    }
    assert_eq!(of(&[1, 4, 6, 2]), Ok(2));
    for shape in [&[1, 1, 2, 3][..], &[1, 1, 6, 4], &[24], &[1, 3, 4, 6], &[2, 1, 4, 6, 1, 2]] {
        assert!(of(shape).is_err(), "{shape:?}");
    }
    assert!(form::plane(&[1, 1, 4, 6], 23, 6, 4).is_err());
}

#[test]
fn files_that_are_no_network() {
    let home = Home::new();
    let missing =
        StereoNetwork::open(&home.0.path().join("no.onnx"), SIZE.0, SIZE.1, &options()).unwrap_err();
    assert_eq!(missing.kind(), ErrorKind::NotFound, "{missing}");
    let Some(_) = home.try_open(&FakeNetwork::default(), &options()) else { return };
    let text = home.0.path().join("text.onnx");
    std::fs::write(&text, "a stereo network, honestly").unwrap();
    let e = StereoNetwork::open(&text, SIZE.0, SIZE.1, &options()).unwrap_err();
    assert!(e.to_string().contains("loading") && e.to_string().contains("text.onnx"), "{e}");
    // Cut anywhere, it is refused and nothing ends.
    let whole = FakeNetwork::default().file();
    for len in (0..whole.len()).step_by(whole.len() / 7) {
        std::fs::write(&text, &whole[..len]).unwrap();
        assert!(StereoNetwork::open(&text, SIZE.0, SIZE.1, &options()).is_err(), "{len} bytes");
    }
    let e = home.open(
        &FakeNetwork { metadata: vec![("depthrig.pixels", "bgr")], ..FakeNetwork::default() },
        SIZE,
        &options(),
    );
    assert!(e.unwrap_err().to_string().contains("bgr"));
}

#[test]
fn images_of_another_size_are_refused() {
    let home = Home::new();
    let Some(mut network) = home.try_open(&FakeNetwork::default(), &options()) else { return };
    let small = vec![0; 40 * 20];
    let pair = StereoPair::new(Gray::packed(&small, 40, 20), Gray::packed(&small, 40, 20));
    let e = network.run(&pair, &mut DisparityMap::default()).unwrap_err();
    assert_eq!(e.kind(), depthrig_calib::ErrorKind::SizeMismatch, "{e}");
}
