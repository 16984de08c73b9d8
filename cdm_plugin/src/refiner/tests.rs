//! Tests with a network that returns its input.

use super::*;
use crate::{Color, ColorFormat, Encoder, ErrorKind, Output, RawDepth, Weights};
use safetensors::tensor::{Dtype, TensorView};
use std::path::Path;
use std::sync::{Arc, Mutex};

/// Inputs of the network, in order.
#[derive(Default)]
struct Log {
    prepared: Vec<NetShape>,
    runs: Vec<NetShape>,
}

/// Returns its inverse depth unchanged, or a preset result.
struct Mirror {
    log: Arc<Mutex<Log>>,
    shape: Option<NetShape>,
    batch: usize,
    answer: Option<f32>,
    fails: bool,
}

impl Network for Mirror {
    fn describe(&self) -> &'static str {
        "mirror 1.0 cpu fp32"
    }

    fn best_batch(&self) -> usize {
        self.batch
    }

    fn prepare(&mut self, shape: NetShape, positions: &PositionEmbeddings) -> Result<()> {
        assert_eq!(positions.rgb.len(), (1 + shape.patches()) * 384);
        assert_eq!(positions.depth.len(), positions.rgb.len());
        assert!(positions.rgb.iter().all(|v| (v - 1.0).abs() < 1e-5));
        assert!(positions.depth.iter().all(|v| (v - 2.0).abs() < 1e-5));
        self.log.lock().unwrap().prepared.push(shape);
        self.shape = Some(shape);
        Ok(())
    }

    fn run(&mut self, x: &[f32], y: &mut [f32]) -> Result<()> {
        let shape = self.shape.unwrap();
        assert_eq!((x.len(), y.len()), (shape.input_len(), shape.output_len()));
        self.log.lock().unwrap().runs.push(shape);
        if self.fails {
            return Err(Error::new(ErrorKind::OutOfMemory, "the mirror is full"));
        }
        let plane = shape.height * shape.width;
        for (x, y) in x.chunks_exact(4 * plane).zip(y.chunks_exact_mut(plane)) {
            y.copy_from_slice(&x[3 * plane..]);
        }
        if let Some(answer) = self.answer {
            y.fill(answer);
        }
        Ok(())
    }
}

/// Weights that hold the position embeddings and nothing else.
fn model(folder: &Path) -> Model {
    let numbers = |v: f32| v.to_le_bytes().repeat(1370 * 384);
    let rgb = numbers(1.0);
    let depth = numbers(2.0);
    let view = |bytes| TensorView::new(Dtype::F32, vec![1, 1370, 384], bytes).unwrap();
    let path = folder.join("positions.safetensors");
    let tensors = [("pretrained.pos_embed", view(&rgb)), ("depth_pretrained.pos_embed", view(&depth))];
    safetensors::serialize_to_file(tensors, None, &path).unwrap();
    Model {
        id: "mirror@00000000".into(),
        encoder: Encoder::Vits,
        weights: Arc::new(Weights::open(&path).unwrap()),
        channel_order: ChannelOrder::Bgr,
        input_size: 28,
        max_depth_m: 6.0,
    }
}

fn refiner(batch: usize, change: impl FnOnce(&mut Mirror)) -> (CdmRefiner, Arc<Mutex<Log>>) {
    let folder = tempfile::tempdir().unwrap();
    let log = Arc::new(Mutex::new(Log::default()));
    let mut mirror = Mirror { log: Arc::clone(&log), shape: None, batch, answer: None, fails: false };
    change(&mut mirror);
    (CdmRefiner::new(Box::new(mirror), &model(folder.path()), None, 2).unwrap(), log)
}

/// One pair and room for its result.
struct Pair {
    color: Vec<u8>,
    depth: Vec<u16>,
    size: (usize, usize),
    out: Vec<u16>,
}

impl Pair {
    fn new(width: usize, height: usize, depth_mm: u16) -> Self {
        let n = width * height;
        Self { color: vec![90; 3 * n], depth: vec![depth_mm; n], size: (width, height), out: vec![1; n] }
    }

    fn job(&mut self) -> Job<'_> {
        let (width, height) = self.size;
        Job {
            color: Color { pixels: &self.color, format: ColorFormat::Rgb8, width, height, stride: 3 * width },
            depth: RawDepth { pixels: &self.depth, unit_m: 0.001 },
            out: Output::Units { pixels: &mut self.out, unit_m: 0.001 },
            steps: StepTimes { prepare_ns: u64::MAX, infer_ns: u64::MAX, finish_ns: u64::MAX },
        }
    }
}

const fn shape(batch: usize, height: usize, width: usize) -> NetShape {
    NetShape { batch, height, width }
}

#[test]
fn jobs_of_one_size_run_together_and_each_gets_its_own() {
    let (mut refiner, log) = refiner(2, |_| ());
    assert_eq!(refiner.describe().engine, "mirror 1.0 cpu fp32");
    assert_eq!((refiner.describe().model.as_str(), refiner.best_batch()), ("mirror@00000000", 2));
    // Three of 28x28, two of 56x28; one of these is a larger image that becomes an input of the same size.
    let sizes = [(20, 20), (40, 20), (28, 28), (80, 40), (56, 56)];
    let mut pairs: Vec<Pair> =
        sizes.iter().enumerate().map(|(i, size)| Pair::new(size.0, size.1, 1000 + 100 * i as u16)).collect();
    for round in 0..2 {
        for pair in &mut pairs {
            pair.out.fill(1);
        }
        let mut jobs: Vec<Job<'_>> = pairs.iter_mut().map(Pair::job).collect();
        refiner.refine(&mut jobs).unwrap();
        for steps in jobs.iter().map(|j| j.steps) {
            assert!(steps.prepare_ns > 0 && steps.prepare_ns < 1 << 40, "{steps:?}");
            assert!(steps.infer_ns < 1 << 40 && steps.finish_ns < 1 << 40, "{steps:?}");
        }
        drop(jobs);
        for (i, pair) in pairs.iter().enumerate() {
            let expected = 1000 + 100 * i as u16;
            assert!(pair.out.iter().all(|d| *d == expected), "round {round}, pair {i}: {:?}", &pair.out[..4]);
        }
        let runs = core::mem::take(&mut log.lock().unwrap().runs);
        assert_eq!(runs, [shape(2, 28, 28), shape(1, 28, 28), shape(2, 28, 56)]);
    }
    refiner.refine(&mut []).unwrap();
    // One size after the other: the tables are kept.
    let before = log.lock().unwrap().prepared.len();
    let mut pair = Pair::new(40, 20, 500);
    for _ in 0..3 {
        refiner.refine(&mut [pair.job()]).unwrap();
    }
    assert_eq!(log.lock().unwrap().prepared[before..], [shape(1, 28, 56)]);
}

#[test]
fn nothing_measured_is_nothing_refined() {
    let (mut refiner, log) = refiner(4, |mirror| mirror.answer = Some(0.5));
    // Holes, full scale, beyond 6 m; and one that has depth.
    let mut pairs = [0, u16::MAX, 6001, 6000].map(|d| Pair::new(20, 20, d));
    let mut jobs: Vec<Job<'_>> = pairs.iter_mut().map(Pair::job).collect();
    refiner.refine(&mut jobs).unwrap();
    assert!(jobs[0].steps.prepare_ns > 0 && jobs[0].steps.infer_ns == 0 && jobs[0].steps.finish_ns == 0);
    drop(jobs);
    assert_eq!(pairs.each_ref().map(|p| p.out[7]), [0, 0, 0, 2000]);
    assert!(pairs[..3].iter().all(|p| p.out.iter().all(|d| *d == 0)));
    assert_eq!(log.lock().unwrap().runs, [shape(1, 28, 28)], "one job of four was worth a run");
    let mut hole = Pair::new(20, 20, 0);
    refiner.refine(&mut [hole.job()]).unwrap();
    assert_eq!(log.lock().unwrap().runs.len(), 1);
}

#[test]
fn what_is_not_finite_is_a_hole() {
    for answer in [f32::NAN, f32::INFINITY, 0.0, 1e-9] {
        let (mut refiner, _) = refiner(1, |mirror| mirror.answer = Some(answer));
        let mut pair = Pair::new(20, 20, 1000);
        refiner.refine(&mut [pair.job()]).unwrap();
        assert!(pair.out.iter().all(|d| *d == 0), "{answer}");
    }
}

#[test]
fn tiny_and_long_images() {
    let (mut refiner, log) = refiner(1, |_| ());
    for (size, net) in [((1, 1), (28, 28)), ((3, 2), (28, 42)), ((2, 32), (448, 28))] {
        let mut pair = Pair::new(size.0, size.1, 700);
        refiner.refine(&mut [pair.job()]).unwrap();
        assert!(pair.out.iter().all(|d| *d == 700), "{size:?}");
        assert_eq!(log.lock().unwrap().runs.pop(), Some(shape(1, net.0, net.1)));
    }
    let mut long = Pair::new(1, 20_000, 700);
    let error = refiner.refine(&mut [long.job()]).unwrap_err();
    assert!(error.kind() == ErrorKind::BadInput && error.to_string().contains("1x20000"), "{error}");
}

#[test]
fn errors_name_the_pair_and_leave_the_refiner_usable() {
    let (mut refiner, log) = refiner(2, |_| ());
    let mut good = Pair::new(20, 20, 1000);
    let mut bad = Pair::new(20, 20, 1000);
    bad.depth.pop();
    let error = refiner.refine(&mut [good.job(), bad.job()]).unwrap_err();
    assert_eq!(error.kind(), ErrorKind::SizeMismatch);
    assert!(error.to_string().contains("pair 2 of 2") && error.to_string().contains("register"), "{error}");
    assert!(log.lock().unwrap().runs.is_empty(), "everything is checked first");
    bad.depth.push(0);
    bad.out.pop();
    assert_eq!(refiner.refine(&mut [bad.job()]).unwrap_err().kind(), ErrorKind::SizeMismatch);
    refiner.refine(&mut [good.job()]).unwrap();
    assert_eq!(good.out[0], 1000);
}

#[test]
fn errors_of_the_engine_are_passed_on() {
    let (mut refiner, _) = refiner(1, |mirror| mirror.fails = true);
    let error = refiner.refine(&mut [Pair::new(20, 20, 1000).job()]).unwrap_err();
    assert_eq!((error.kind(), error.to_string().as_str()), (ErrorKind::OutOfMemory, "the mirror is full"));
}

#[test]
fn more_sizes_than_are_kept() {
    let (mut refiner, _) = refiner(64, |_| ());
    let mut pairs: Vec<Pair> = (0..40).map(|i| Pair::new(20 + i, 20, 300 + i as u16)).collect();
    for _ in 0..2 {
        let mut jobs: Vec<Job<'_>> = pairs.iter_mut().map(Pair::job).collect();
        refiner.refine(&mut jobs).unwrap();
    }
    for (i, pair) in pairs.iter().enumerate() {
        assert!(pair.out.iter().all(|d| *d == 300 + i as u16), "{i}");
    }
    assert!(refiner.kept.preps.len() <= PREPS && refiner.kept.positions.len() <= POSITIONS);
}

#[test]
fn input_sizes_that_cannot_be() {
    let folder = tempfile::tempdir().unwrap();
    let mirror =
        || Box::new(Mirror { log: Arc::default(), shape: None, batch: 1, answer: None, fails: false });
    let model = model(folder.path());
    let error = CdmRefiner::new(mirror(), &model, Some(13), 1).err().unwrap();
    assert!(error.kind() == ErrorKind::BadInput && error.to_string().contains("13"), "{error}");
    let vitb = Model { encoder: Encoder::Vitb, ..model };
    let error = CdmRefiner::new(mirror(), &vitb, Some(28), 1).err().unwrap();
    assert!(error.kind() == ErrorKind::BadModel && error.to_string().contains("pos_embed"), "{error}");
}
