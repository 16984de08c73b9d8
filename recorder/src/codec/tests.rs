//! The codec against a slow model of what the format page says, and against hostile input.

use super::*;
use proptest::prelude::*;

/// The head and the body before it is packed, in the plainest code: one pixel at a time, in wide integers.
fn model(pixels: &[u8], s: DepthShape) -> (Vec<u8>, Vec<u8>) {
    let w = s.width as usize;
    let h = s.height as usize;
    let step = s.step as usize;
    let value = |x: usize, y: usize| {
        i64::from(pixels[y * step + 2 * x]) + 256 * i64::from(pixels[y * step + 2 * x + 1])
    };
    let mut palette: Vec<i64> = (0..h).flat_map(|y| (0..w).map(move |x| value(x, y))).collect();
    palette.sort_unstable();
    palette.dedup();
    let rank = |x: isize, y: isize| {
        if x < 0 || y < 0 {
            return 0;
        }
        palette.binary_search(&value(x as usize, y as usize)).unwrap() as i64
    };
    let mut low = Vec::new();
    let mut high = Vec::new();
    let mut put = |v: i64| {
        low.push((v % 256) as u8);
        high.push((v / 256) as u8);
    };
    let mut residuals = Vec::new();
    for (i, v) in palette.iter().enumerate() {
        put(if i == 0 { *v } else { v - palette[i - 1] });
    }
    for y in 0..h as isize {
        for x in 0..w as isize {
            let a = rank(x - 1, y);
            let b = rank(x, y - 1);
            let c = rank(x - 1, y - 1);
            let predicted = if c >= a.max(b) {
                a.min(b)
            } else if c <= a.min(b) {
                a.max(b)
            } else {
                a + b - c
            };
            // Into -32768..32767, then folded.
            let r = (rank(x, y) - predicted + 32768).rem_euclid(65536) - 32768;
            residuals.push(if r >= 0 { 2 * r } else { -2 * r - 1 });
        }
    }
    let mut body = [low, high].concat();
    body.extend(residuals.iter().map(|r| (r % 256) as u8));
    body.extend(residuals.iter().map(|r| (r / 256) as u8));
    for row in pixels.chunks_exact(step) {
        body.extend(&row[2 * w..]);
    }
    ((palette.len() as u32).to_le_bytes().to_vec(), body)
}

/// The head of a packed image and its body unpacked.
fn unpacked(packed: &[u8]) -> (Vec<u8>, Vec<u8>) {
    (packed[..HEAD].to_vec(), zstd::bulk::decompress(&packed[HEAD..], 1 << 24).unwrap())
}

fn encode(pixels: &[u8], shape: DepthShape) -> Vec<u8> {
    let mut out = vec![7];
    DepthEncoder::new().encode(pixels, shape, &mut out).unwrap();
    assert_eq!(out.remove(0), 7, "what was in the buffer stays");
    out
}

fn decode(data: &[u8], shape: DepthShape) -> Result<Vec<u8>> {
    let mut out = vec![1, 2, 3];
    DepthDecoder::new().decode(data, shape, &mut out).map(|()| out)
}

/// Images from flat to random, with holes, and with padding that is not zero.
fn image() -> impl Strategy<Value = (Vec<u8>, DepthShape)> {
    let value = prop_oneof![Just(any::<u16>().boxed()), Just((0u16..4).boxed()), Just((700u16..760).boxed())];
    (1u32..40, 1u32..12, 0u32..5, value).prop_flat_map(|(width, height, pad, value)| {
        let shape = DepthShape { width, height, step: 2 * width + pad };
        let values = proptest::collection::vec(value, (width * height) as usize);
        let padding = proptest::collection::vec(any::<u8>(), (pad * height) as usize);
        (values, padding).prop_map(move |(values, padding)| {
            let mut bytes = Vec::new();
            for y in 0..height as usize {
                let row = &values[y * width as usize..][..width as usize];
                bytes.extend(row.iter().flat_map(|v| v.to_le_bytes()));
                bytes.extend(&padding[y * pad as usize..][..pad as usize]);
            }
            (bytes, shape)
        })
    })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(400))]
    #[test]
    fn what_is_packed_is_what_the_format_page_says_and_comes_back((bytes, shape) in image()) {
        let packed = encode(&bytes, shape);
        prop_assert_eq!(unpacked(&packed), model(&bytes, shape));
        prop_assert_eq!(decode(&packed, shape).unwrap(), bytes);
    }

    #[test]
    fn damage_is_an_error_or_another_image_and_never_a_panic(
        (bytes, shape) in image(), at in any::<prop::sample::Index>(), new in any::<u8>(), cut in any::<prop::sample::Index>()
    ) {
        let mut packed = encode(&bytes, shape);
        let at = at.index(packed.len());
        packed[at] = new;
        if let Ok(other) = decode(&packed, shape) {
            prop_assert_eq!(other.len(), bytes.len());
        }
        packed.truncate(cut.index(packed.len()));
        prop_assert!(decode(&packed, shape).is_err());
    }

    #[test]
    fn any_body_behind_a_good_frame_is_taken_without_panic(
        body in proptest::collection::vec(any::<u8>(), 0..400), count in 0u32..20, width in 1u32..9, height in 1u32..9
    ) {
        let mut data = count.to_le_bytes().to_vec();
        let shape = DepthShape { width, height, step: 2 * width };
        let mut exact = body;
        exact.resize(2 * count as usize + shape.bytes() as usize, 1);
        data.extend(zstd::bulk::compress(&exact, 1).unwrap());
        let _ = decode(&data, shape);
    }
}

/// A room as a depth camera sees it: planes with noise that grows with distance, holes, an edge.
fn room(shape: DepthShape) -> Vec<u8> {
    let mut seed = 1u64;
    let mut noise = || {
        seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
        (seed >> 33) as f64 / f64::from(1u32 << 31) - 0.5
    };
    let places = (0..shape.height).flat_map(|y| (0..shape.width).map(move |x| (f64::from(x), f64::from(y))));
    let values = places.map(|(x, y)| {
        let disparity = if x > 200.0 && y > 120.0 { 60.0 } else { 20.0 + 0.02 * x + 0.03 * y };
        let mm = 50_000.0 / (disparity + noise()).round();
        if noise() > 0.48 { 0 } else { mm as u16 }
    });
    values.flat_map(u16::to_le_bytes).collect()
}

#[test]
fn depth_takes_less_room_than_at_level_1_of_the_compressor() {
    let shape = DepthShape { width: 640, height: 360, step: 1280 };
    let pixels = room(shape);
    let packed = encode(&pixels, shape);
    let (head, body) = unpacked(&packed);
    let level_1 = head.len() + zstd::bulk::compress(&body, 1).unwrap().len();
    assert!(packed.len() < level_1 && 4 * packed.len() < pixels.len(), "{} and {level_1}", packed.len());
}

#[test]
fn every_value_at_once_is_packed() {
    let shape = DepthShape { width: 256, height: 256, step: 512 };
    for order in [1u32, 40503] {
        let bytes: Vec<u8> =
            (0..65536u32).flat_map(|i| (i.wrapping_mul(order) as u16).to_le_bytes()).collect();
        let packed = encode(&bytes, shape);
        assert_eq!(packed[..4], 65536u32.to_le_bytes());
        assert_eq!(decode(&packed, shape).unwrap(), bytes);
    }
}

#[test]
fn one_encoder_and_one_decoder_take_images_of_any_size_in_turn() {
    let mut encoder = DepthEncoder::new();
    let mut decoder = DepthDecoder::new();
    let mut packed = Vec::new();
    let mut back = Vec::new();
    for (width, height) in [(64, 48), (5, 3), (100, 2), (64, 48)] {
        let shape = DepthShape { width, height, step: 2 * width };
        let bytes: Vec<u8> = (0..width * height).flat_map(|i| ((i * i) as u16 / 3).to_le_bytes()).collect();
        packed.clear();
        encoder.encode(&bytes, shape, &mut packed).unwrap();
        decoder.decode(&packed, shape, &mut back).unwrap();
        assert_eq!(back, bytes);
    }
}

#[test]
fn lies_are_refused_before_memory_is_taken() {
    let small = DepthShape { width: 4, height: 4, step: 8 };
    let packed = encode(&[5; 32], small);
    let refused = |data: &[u8], shape: DepthShape, why: &str| {
        let e = decode(data, shape).unwrap_err();
        assert!(e.kind() == ErrorKind::Codec && e.to_string().contains(why), "{e}");
    };
    refused(&packed, DepthShape { width: 16000, height: 8000, step: 32000 }, "cannot hold");
    refused(&packed, DepthShape { width: 1 << 20, height: 1 << 20, step: 1 << 21 }, "too large");
    refused(
        &packed,
        DepthShape { width: u32::MAX, height: u32::MAX, step: u32::MAX },
        "is not a valid image",
    );
    refused(&packed, DepthShape { width: 4, height: 0, step: 8 }, "is not a valid image");
    refused(&packed, DepthShape { width: 4, height: 5, step: 8 }, "it unpacks to 34 bytes, 42 are wanted");
    refused(&packed[..3], small, "cut short");
    for count in [0u32, 17, u32::MAX] {
        refused(&[&count.to_le_bytes(), &packed[4..]].concat(), small, "does not fit 16 pixels");
    }
    let body = |palette: &[u8], first: u8| {
        let mut body = palette.to_vec();
        body.push(first);
        body.resize(palette.len() + 32, 0);
        [&2u32.to_le_bytes()[..], &zstd::bulk::compress(&body, 1).unwrap()].concat()
    };
    assert!(decode(&body(&[1, 1, 0, 0], 2), small).is_ok());
    refused(&body(&[1, 1, 0, 0], 4), small, "rank 2 is not in its palette of 2 values");
    refused(&body(&[1, 0, 0, 0], 0), small, "not rising");
    refused(&body(&[255, 1, 255, 0], 0), small, "leaves 16 bits");
}
