//! The network's input and the way back, against the official code.

use crate::support::{Pair, Tensors, max_abs, seeded_model};
use depthrig_cdm::prep::{Positions, Prep, net_size};
use depthrig_cdm::{ChannelOrder, Color, ColorFormat, Encoder, NetShape, Output};

const MAX_DEPTH_M: f64 = 6.0;

fn cases() -> [(Pair, &'static str, u32); 2] {
    [
        (Pair::d405(), "vits_252_d405.safetensors", 252),
        (Pair::lingbot(0), "vits_308_lingbot0.safetensors", 308),
    ]
}

#[test]
fn the_network_sees_what_the_official_one_sees() {
    for (pair, file, input_size) in cases() {
        let (shape, expected) = Tensors::open(file).get("x");
        let (width, height) = net_size(pair.width, pair.height, input_size).unwrap();
        assert_eq!(shape, [1, 4, height, width]);
        let mut prep = Prep::new(pair.width, pair.height, input_size, MAX_DEPTH_M).unwrap();
        let mut x = vec![f32::NAN; expected.len()];
        let any = prep.prepare(&pair.color(), &pair.depth(), ChannelOrder::Bgr, &mut x).unwrap();
        assert!(any);
        let colour = 3 * width * height;
        let difference = max_abs(&x[..colour], &expected[..colour]);
        println!("{file}: colour differs by {difference:e} at most");
        assert!(difference <= 4e-6, "{file}: {difference}");
        assert!(x[colour..] == expected[colour..], "{file}: inverse depth is the same to the bit");
    }
}

#[test]
fn the_way_back_is_the_official_one() {
    for (pair, file, input_size) in cases() {
        let tensors = Tensors::open(file);
        let (_, y) = tensors.get("y");
        let (shape, expected) = tensors.get("inv_full");
        assert_eq!(shape, [pair.height, pair.width]);
        let mut prep = Prep::new(pair.width, pair.height, input_size, MAX_DEPTH_M).unwrap();
        let mut inverse = vec![f32::NAN; expected.len()];
        prep.finish(&y, &mut Output::Inverse(&mut inverse)).unwrap();
        assert!(inverse == expected, "{file}: the same to the bit");
        let mut metres = vec![f32::NAN; expected.len()];
        prep.finish(&y, &mut Output::Metres(&mut metres)).unwrap();
        let mut units = vec![1u16; expected.len()];
        prep.finish(&y, &mut Output::Units { pixels: &mut units, unit_m: pair.unit_m }).unwrap();
        for ((inverse, metres), units) in expected.iter().zip(&metres).zip(&units) {
            assert_eq!(*metres, 1.0 / inverse);
            assert_eq!(*units, (f64::from(*metres) / pair.unit_m).round() as u16);
        }
    }
}

/// Blue-green-red images, padded rows and the other channel order give the same planes, in the order asked for.
#[test]
fn formats_strides_and_orders() {
    let pair = Pair::lingbot(0);
    let size = (pair.width, pair.height);
    let mut prep = Prep::new(size.0, size.1, 252, MAX_DEPTH_M).unwrap();
    let (w, h) = prep.net();
    let mut run = |color: &Color<'_>, order| {
        let mut x = vec![f32::NAN; 4 * w * h];
        assert!(prep.prepare(color, &pair.depth(), order, &mut x).unwrap());
        x
    };
    let reference = run(&pair.color(), ChannelOrder::Bgr);

    let stride = 3 * pair.width + 37;
    let mut padded = vec![0xAB; stride * (pair.height - 1) + 3 * pair.width];
    for (y, row) in pair.color.chunks_exact(3 * pair.width).enumerate() {
        padded[y * stride..][..row.len()].copy_from_slice(row);
    }
    let strided = Color { pixels: &padded, stride, ..pair.color() };
    assert!(run(&strided, ChannelOrder::Bgr) == reference);

    let mut turned = pair.color.clone();
    turned.as_chunks_mut::<3>().0.iter_mut().for_each(|p| p.reverse());
    let bgr = Color { pixels: &turned, format: ColorFormat::Bgr8, ..pair.color() };
    assert!(run(&bgr, ChannelOrder::Bgr) == reference);
    let relabelled = Color { pixels: &turned, ..pair.color() };
    let rgb = run(&pair.color(), ChannelOrder::Rgb);
    assert!(run(&bgr, ChannelOrder::Rgb) == rgb);
    assert!(run(&relabelled, ChannelOrder::Bgr) == rgb, "the order is that of the planes");
    assert!(max_abs(&rgb, &reference) > 0.1, "and it matters");
}

/// Each encoder has its own, and where nothing is resized they are the ones that were learnt; what resizing gives is
/// proven by the output of a whole network.
#[test]
fn positions_of_a_whole_model() {
    let model = seeded_model(Encoder::Vits);
    let positions = Positions::read(&model.encoder.architecture(), &model.weights).unwrap();
    let at = positions.at(NetShape { batch: 3, height: 252, width: 448 });
    assert_eq!((at.rgb.len(), at.depth.len()), ((1 + 576) * 384, (1 + 576) * 384));
    assert!(max_abs(&at.rgb, &at.depth) > 0.1, "each encoder has its own");
    let same = positions.at(NetShape { batch: 1, height: 518, width: 518 });
    assert_eq!(same.rgb, model.weights.to_f32("pretrained.pos_embed").unwrap());
}
