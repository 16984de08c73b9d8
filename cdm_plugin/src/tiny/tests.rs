//! Everything around the network against a slow form of it, and the network itself in ONNX Runtime.

use super::*;
use crate::{Color, ColorFormat, EngineKind, ErrorKind, Output, Precision, RawDepth};
use std::sync::{Arc, Mutex};

/// Odd sizes, smaller than 16, and multiples of 16.
const SIZES: [(usize, usize); 7] = [(64, 48), (33, 17), (5, 3), (3, 9), (16, 16), (100, 7), (47, 65)];

/// The last input of a [`Fake`].
#[derive(Debug, Default)]
struct Seen {
    runs: usize,
    size: (usize, usize),
    x: Vec<f32>,
    filled: Vec<f32>,
}

/// A network in which each pixel is on its own: filled depth times a factor that is made of all six planes.
#[derive(Default)]
struct Fake {
    seen: Arc<Mutex<Seen>>,
    x: Vec<f32>,
    filled: Vec<f32>,
    refined: Vec<f32>,
    /// Given in place of a result, in turn.
    instead: Vec<f32>,
}

fn factor(planes: [f32; 6]) -> f32 {
    let [r, g, b, filled, raw, mask] = planes;
    (0.3 * r - 0.2 * g + 0.1 * b + 0.05 * filled - 0.07 * raw + 0.2 * mask).exp()
}

impl ImageNetwork for Fake {
    fn inputs(&mut self, width: usize, height: usize) -> Result<(&mut [f32], &mut [f32])> {
        let len = width * height;
        // What is not written would be found.
        self.x = vec![f32::NAN; 6 * len];
        self.filled = vec![f32::NAN; len];
        self.seen.lock().unwrap().size = (width, height);
        Ok((&mut self.x, &mut self.filled))
    }

    fn run(&mut self) -> Result<&[f32]> {
        let len = self.filled.len();
        let of = |i: usize| self.filled[i] * factor([0, 1, 2, 3, 4, 5].map(|p| self.x[p * len + i]));
        self.refined = (0..len).map(of).collect();
        for (i, refined) in self.refined.iter_mut().enumerate().filter(|_| !self.instead.is_empty()) {
            *refined = self.instead[i % self.instead.len()];
        }
        let mut seen = self.seen.lock().unwrap();
        seen.runs += 1;
        seen.x.clone_from(&self.x);
        seen.filled.clone_from(&self.filled);
        Ok(&self.refined)
    }
}

fn options() -> RefinerOptions {
    RefinerOptions { engine: Some(EngineKind::Tiny), threads: 1, ..RefinerOptions::default() }
}

fn fake(fake: Fake, options: &RefinerOptions) -> TinyRefiner {
    TinyRefiner::new(Box::new(fake), "fake".into(), options).unwrap()
}

/// The refiner with its network, or `None` where ONNX Runtime is not installed and not required.
fn real(options: &RefinerOptions) -> Option<TinyRefiner> {
    let required = std::env::var_os("DEPTHRIG_REQUIRE_ONNXRUNTIME").is_some();
    match TinyRefiner::open(options) {
        Err(e) if e.kind() == ErrorKind::NoEngine && !required => {
            println!("skipped: {e}");
            None
        }
        opened => Some(opened.unwrap()),
    }
}

/// One image and its raw depth.
#[derive(Clone)]
struct Pair {
    w: usize,
    h: usize,
    stride: usize,
    color: Vec<u8>,
    depth: Vec<u16>,
}

impl Pair {
    /// Colour waves over a slanted wall with a box before it; every seventh pixel, a square and the edge of the box are holes.
    fn new(w: usize, h: usize, seed: usize) -> Self {
        let stride = 3 * w + 5;
        let color = (0..stride * h).map(|i| ((i * 37 + seed * 11) % 251) as u8).collect();
        let depth = (0..w * h).map(|i| {
            let x = i % w;
            let y = i / w;
            let is_box = 3 * x > w && 2 * y > h;
            let hole = (i + seed) % 7 == 3 || (4 * x > 3 * w && 4 * y > 3 * h);
            match (hole, is_box) {
                (true, _) if i % 2 == 0 => u16::MAX,
                (true, _) => 0,
                (_, true) => 800 + (x % 5) as u16,
                _ => 1500 + 3 * x as u16,
            }
        });
        Self { w, h, stride, color, depth: depth.collect() }
    }

    fn refine(&self, refiner: &mut dyn Refiner, format: ColorFormat, out: Output<'_>) -> Result<StepTimes> {
        let Self { w: width, h: height, stride, .. } = *self;
        let color = Color { pixels: &self.color, format, width, height, stride };
        let depth = RawDepth { pixels: &self.depth, unit_m: 0.001 };
        let mut job = Job { color, depth, out, steps: StepTimes::default() };
        refiner.refine(core::slice::from_mut(&mut job))?;
        Ok(job.steps)
    }

    fn inverse(&self, refiner: &mut dyn Refiner) -> Vec<f32> {
        let mut out = vec![f32::NAN; self.w * self.h];
        self.refine(refiner, ColorFormat::Rgb8, Output::Inverse(&mut out)).unwrap();
        out
    }

    /// The result of `fill` with this reach.
    fn filled(&self, reach: f64) -> Vec<f32> {
        self.inverse(&mut FillRefiner::new(1).unwrap().with_reach(reach))
    }

    /// The six numbers of the input at a pixel, in 64-bit floats, as `tiny_inputs` in Python has them.
    fn planes_at(&self, filled: &[f32], x: usize, y: usize) -> [f64; 6] {
        let mean = filled.iter().map(|q| f64::from(*q)).sum::<f64>() / filled.len() as f64;
        let i = y * self.w + x;
        let colour = |c: usize| f64::from(self.color[y * self.stride + 3 * x + c]) / 255.0 - 0.5;
        let measured = !matches!(self.depth[i], 0 | u16::MAX);
        let raw = if measured { 1000.0 / f64::from(self.depth[i]) } else { 0.0 };
        let mask = f64::from(u8::from(measured));
        [colour(0), colour(1), colour(2), f64::from(filled[i]) / mean, raw / mean, mask]
    }
}

/// The largest difference as a part of the larger; infinite where a number is NaN or 0 is where it should not be.
fn difference(a: &[f32], b: &[f32]) -> f32 {
    assert_eq!(a.len(), b.len());
    let of = |(a, b): (&f32, &f32)| if a == b { 0.0 } else { (a - b).abs() / a.abs().max(b.abs()) };
    a.iter().zip(b).map(of).fold(0.0, |most, d| if d.is_nan() { f32::INFINITY } else { most.max(d) })
}

#[test]
fn inputs_are_those_of_python_with_the_edge_repeated() {
    let seen = Arc::new(Mutex::new(Seen::default()));
    let mut refiner = fake(Fake { seen: Arc::clone(&seen), ..Fake::default() }, &options());
    for (w, h) in SIZES {
        let pair = Pair::new(w, h, 1);
        pair.inverse(&mut refiner);
        let filled = pair.filled(1.0);
        let seen = seen.lock().unwrap();
        let (across, down) = seen.size;
        assert_eq!((across, down), (w.div_ceil(16) * 16, h.div_ceil(16) * 16));
        for y in 0..down {
            for x in 0..across {
                let inside = (x.min(w - 1), y.min(h - 1));
                let at = y * across + x;
                assert_eq!(seen.filled[at], filled[inside.1 * w + inside.0], "{w}x{h}: {x}, {y}");
                for (p, expected) in pair.planes_at(&filled, inside.0, inside.1).into_iter().enumerate() {
                    let is = f64::from(seen.x[p * across * down + at]);
                    assert!(
                        (is - expected).abs() <= 1e-6 * expected.abs().max(1.0),
                        "{w}x{h}, plane {p}: {x}, {y}: {is}"
                    );
                }
            }
        }
    }
}

#[test]
fn results_are_the_networks_where_fill_knows_something() {
    for reach in [FillRefiner::REACH, 0.0, 1.0] {
        let options = RefinerOptions { fill_reach: reach, ..options() };
        let mut refiner = fake(Fake::default(), &options);
        let mut unknown = 0;
        for (w, h) in SIZES.into_iter().chain([(320, 96)]) {
            let mut pair = Pair::new(w, h, 2);
            if w == 320 {
                // Depth in a corner alone, so that much lies beyond the reach.
                pair.depth.iter_mut().enumerate().filter(|(i, _)| i % 320 > 99).for_each(|(_, d)| *d = 0);
            }
            let every = pair.filled(1.0);
            let known = pair.filled(reach);
            let expected: Vec<f32> = (0..w * h)
                .map(|i| {
                    let planes = pair.planes_at(&every, i % w, i / w).map(|v| v as f32);
                    if known[i] > 0.0 { every[i] * factor(planes) } else { 0.0 }
                })
                .collect();
            let inverse = pair.inverse(&mut refiner);
            let off = difference(&inverse, &expected);
            assert!(off <= 1e-5, "{w}x{h}: {off:e}");
            unknown += known.iter().filter(|q| **q == 0.0).count();

            let mut metres = vec![f32::NAN; w * h];
            pair.refine(&mut refiner, ColorFormat::Rgb8, Output::Metres(&mut metres)).unwrap();
            let mut units = vec![7u16; w * h];
            let out = Output::Units { pixels: &mut units, unit_m: 0.0005 };
            pair.refine(&mut refiner, ColorFormat::Rgb8, out).unwrap();
            for ((inverse, metres), units) in inverse.iter().zip(&metres).zip(&units) {
                let expected = if *inverse > 0.0 { 1.0 / inverse } else { 0.0 };
                assert_eq!(*metres, expected);
                assert!((f32::from(*units) - 2000.0 * expected).abs() <= 0.501, "{units} for {expected} m");
            }
        }
        assert_eq!(unknown > 0, reach < 1.0, "reach {reach}: {unknown} pixels unknown");
    }
}

#[test]
fn colours_are_told_apart_by_format() {
    let pair = Pair::new(33, 17, 3);
    let mut turned = pair.clone();
    for y in 0..pair.h {
        turned.color[y * pair.stride..][..3 * pair.w]
            .as_chunks_mut::<3>()
            .0
            .iter_mut()
            .for_each(|p| p.reverse());
    }
    let of = |pair: &Pair, format| {
        let mut out = vec![0.0; pair.w * pair.h];
        pair.refine(&mut fake(Fake::default(), &options()), format, Output::Inverse(&mut out)).unwrap();
        out
    };
    assert!(of(&pair, ColorFormat::Rgb8) == of(&turned, ColorFormat::Bgr8));
    assert!(of(&pair, ColorFormat::Rgb8) != of(&pair, ColorFormat::Bgr8));
}

#[test]
fn without_depth_the_network_does_not_run_and_nothing_is_known() {
    let seen = Arc::new(Mutex::new(Seen::default()));
    let mut refiner = fake(Fake { seen: Arc::clone(&seen), ..Fake::default() }, &options());
    for (w, h) in SIZES.into_iter().chain([(1, 1)]) {
        for nothing in [0, u16::MAX] {
            let pair = Pair { depth: vec![nothing; w * h], ..Pair::new(w, h, 4) };
            assert!(pair.inverse(&mut refiner).iter().all(|q| *q == 0.0));
            let mut units = vec![7u16; w * h];
            let out = Output::Units { pixels: &mut units, unit_m: 0.001 };
            let steps = pair.refine(&mut refiner, ColorFormat::Rgb8, out).unwrap();
            assert!(units.iter().all(|d| *d == 0) && steps == StepTimes::default());
        }
    }
    // One pixel is an island, which `fill` removes.
    let one = Pair { depth: vec![1000], ..Pair::new(1, 1, 4) };
    assert_eq!(one.inverse(&mut refiner), [0.0]);
    assert_eq!(seen.lock().unwrap().runs, 0);
}

#[test]
fn numbers_that_are_not_depth_are_unknown() {
    let bad = vec![f32::NAN, f32::INFINITY, f32::NEG_INFINITY, -1.0, 0.0, 2.0];
    let pair = Pair::new(30, 20, 5);
    let options = RefinerOptions { fill_reach: 1.0, ..options() };
    let mut refiner = fake(Fake { instead: bad, ..Fake::default() }, &options);
    let inverse = pair.inverse(&mut refiner);
    for (i, q) in inverse.iter().enumerate() {
        // Of 32 columns 30 are the image's, and six numbers take turns.
        let expected = if (i / 30 * 32 + i % 30) % 6 == 5 { 2.0 } else { 0.0 };
        assert_eq!(*q, expected, "{i}");
    }
    let mut metres = vec![f32::NAN; inverse.len()];
    pair.refine(&mut refiner, ColorFormat::Rgb8, Output::Metres(&mut metres)).unwrap();
    assert!(metres.iter().all(|m| *m == 0.0 || *m == 0.5) && metres.contains(&0.5));
}

#[test]
fn images_that_do_not_belong_together_are_refused() {
    let pair = Pair::new(20, 20, 6);
    let mut refiner = fake(Fake::default(), &options());
    let mut short = vec![0.0; 399];
    let error = pair.refine(&mut refiner, ColorFormat::Rgb8, Output::Inverse(&mut short)).unwrap_err();
    assert_eq!(error.kind(), ErrorKind::SizeMismatch, "{error}");
    let cut = Pair { color: vec![0; 100], ..pair };
    let error = cut.refine(&mut refiner, ColorFormat::Rgb8, Output::Inverse(&mut [0.0; 400])).unwrap_err();
    assert_eq!(error.kind(), ErrorKind::BadInput, "{error}");
}

/// The network of the program, given the input of the slow form and with a network object of its own.
#[test]
fn the_network_gives_what_it_gives_for_the_input_by_hand() {
    let options = RefinerOptions { fill_reach: 1.0, ..options() };
    let Some(mut refiner) = real(&options) else { return };
    let engine = &refiner.describe().engine;
    assert!(engine.starts_with("tiny onnxruntime 1.") && engine.ends_with(" cpu fp32") && engine.len() <= 31);
    assert_eq!(refiner.describe().model, model().id);
    let mut network = TinyNetwork::open(model::BYTES, &options).unwrap();
    for (w, h) in SIZES {
        let pair = Pair::new(w, h, 7);
        let every = pair.filled(1.0);
        let (across, down) = (w.div_ceil(16) * 16, h.div_ceil(16) * 16);
        let (x, filled) = network.inputs(across, down).unwrap();
        for i in 0..across * down {
            let at = ((i % across).min(w - 1), (i / across).min(h - 1));
            filled[i] = every[at.1 * w + at.0];
            for (p, v) in pair.planes_at(&every, at.0, at.1).into_iter().enumerate() {
                x[p * across * down + i] = v as f32;
            }
        }
        let refined = network.run().unwrap();
        let expected: Vec<f32> = (0..w * h).map(|i| refined[i / w * across + i % w]).collect();
        assert!(expected.iter().all(|q| q.is_finite() && *q > 0.0));
        let off = difference(&pair.inverse(&mut refiner), &expected);
        assert!(off <= 1e-4, "{w}x{h}: {off:e}");
    }
}

#[test]
fn the_same_image_gives_the_same_bits_whatever_came_between() {
    let Some(mut refiner) = real(&options()) else { return };
    let pairs: Vec<Pair> = SIZES.into_iter().map(|(w, h)| Pair::new(w, h, 8)).collect();
    let first: Vec<_> = pairs.iter().map(|p| p.inverse(&mut refiner)).collect();
    for (pair, first) in pairs.iter().zip(&first) {
        assert!(pair.inverse(&mut refiner) == *first, "again, {}x{}", pair.w, pair.h);
    }
    // More sizes than are kept.
    for w in 17..40 {
        assert!(Pair::new(16 * (w - 16), 16, 9).inverse(&mut refiner).iter().all(|q| q.is_finite()));
    }
    let nothing = Pair { depth: vec![0; 64 * 48], ..Pair::new(64, 48, 9) };
    assert!(nothing.inverse(&mut refiner).iter().all(|q| *q == 0.0));
    for (pair, first) in pairs.iter().zip(&first) {
        assert!(pair.inverse(&mut refiner) == *first, "{}x{}", pair.w, pair.h);
        assert!(pair.inverse(&mut real(&options()).unwrap()) == *first, "a new one, {}x{}", pair.w, pair.h);
        assert!(first.iter().all(|q| q.is_finite() && *q >= 0.0));
    }
    let two = RefinerOptions { threads: 2, ..options() };
    let off = difference(&pairs[0].inverse(&mut real(&two).unwrap()), &first[0]);
    assert!(off <= 1e-4, "two threads: {off:e}");
}

#[test]
fn other_devices_and_precisions_are_refused_with_the_cure() {
    for (device, precision, part) in [
        ("cuda:0", Precision::Fp32, "leave the device out"),
        ("openvino", Precision::Fp32, "leave the device out"),
        ("cpu", Precision::Fp16, "fp32"),
    ] {
        let options = RefinerOptions { device: device.into(), precision, ..options() };
        let error = TinyRefiner::open(&options).err().unwrap();
        assert_eq!(error.kind(), ErrorKind::Unsupported, "{error}");
        assert!(error.to_string().contains(part), "{error}");
    }
    let options = RefinerOptions { library: Some("/none/such.so".into()), ..options() };
    let error = TinyRefiner::open(&options).err().unwrap();
    assert_eq!(error.kind(), ErrorKind::NoEngine);
    assert!(error.to_string().contains("pip install onnxruntime"), "{error}");
}

#[test]
fn a_network_from_a_file_runs_under_its_own_name() {
    let home = tempfile::tempdir().unwrap();
    let path = home.path().join("my lab.onnx");
    std::fs::write(&path, model::BYTES).unwrap();
    let own = TinyFile::read(&path).unwrap();
    assert_eq!(own.id, format!("my-lab@{}", &super::model().sha256[..8]));
    let Some(mut refiner) = real(&RefinerOptions { tiny: Some(own), ..options() }) else { return };
    assert!(refiner.describe().model.starts_with("my-lab@"), "{:?}", refiner.describe());
    let Some(mut usual) = real(&options()) else { return };
    let pair = Pair::new(64, 48, 1);
    assert_eq!(pair.inverse(&mut refiner), pair.inverse(&mut usual));

    std::fs::write(&path, "no network").unwrap();
    let bad = RefinerOptions { tiny: Some(TinyFile::read(&path).unwrap()), ..options() };
    let error = TinyRefiner::open(&bad).err().unwrap();
    assert!(error.to_string().contains("my-lab"), "{error}");
    let error = TinyFile::read(&home.path().join("none.onnx")).err().unwrap();
    assert_eq!(error.kind(), ErrorKind::NotFound);
    assert!(
        error.to_string().contains("none.onnx") && error.to_string().contains("depthrig.lab.train"),
        "{error}"
    );
}
