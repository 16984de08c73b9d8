//! Around a network, an image of a size that was seen before costs no allocation. (The library's own memory is not counted.)
//!
//! One test in a binary of its own: the counter sees every thread of the process.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

use depthrig_cdm::{
    CdmRefiner, ChannelOrder, Color, ColorFormat, Encoder, ErrorKind, FillRefiner, Job, Model, NetShape,
    Network, Output, PositionEmbeddings, RawDepth, Refiner, RefinerOptions, Result, StepTimes, TinyRefiner,
    Weights,
};
use depthrig_counting::{Counting, of_process};
use safetensors::tensor::{Dtype, TensorView};
use std::sync::Arc;

#[global_allocator]
static COUNTING: Counting = Counting;

/// Gives back inverse depth as it came.
struct Mirror(NetShape);

impl Network for Mirror {
    fn describe(&self) -> &'static str {
        "mirror"
    }

    fn best_batch(&self) -> usize {
        2
    }

    fn prepare(&mut self, shape: NetShape, _: &PositionEmbeddings) -> Result<()> {
        self.0 = shape;
        Ok(())
    }

    fn run(&mut self, x: &[f32], y: &mut [f32]) -> Result<()> {
        let plane = self.0.height * self.0.width;
        for (x, y) in x.chunks_exact(4 * plane).zip(y.chunks_exact_mut(plane)) {
            y.copy_from_slice(&x[3 * plane..]);
        }
        Ok(())
    }
}

fn model() -> Model {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("positions.safetensors");
    let numbers = 1f32.to_le_bytes().repeat(1370 * 384);
    let view = || TensorView::new(Dtype::F32, vec![1, 1370, 384], &numbers).unwrap();
    let tensors = [("pretrained.pos_embed", view()), ("depth_pretrained.pos_embed", view())];
    safetensors::serialize_to_file(tensors, None, &path).unwrap();
    Model {
        id: "mirror".into(),
        encoder: Encoder::Vits,
        weights: Arc::new(Weights::open(&path).unwrap()),
        channel_order: ChannelOrder::Bgr,
        input_size: 70,
        max_depth_m: 6.0,
    }
}

#[test]
fn nothing_is_allocated_per_image() {
    let mirror = Mirror(NetShape { batch: 0, height: 0, width: 0 });
    let (units, metres, inverse) =
        refine_often(&mut CdmRefiner::new(Box::new(mirror), &model(), None, 1).unwrap());
    assert!(units.iter().all(|d| *d == 3000) && metres.iter().all(|d| *d == 1.5));
    assert!(inverse.iter().all(|d| (d - 1.0 / 1.5).abs() < 1e-7));
    let (units, metres, _) = refine_often(&mut FillRefiner::new(1).unwrap());
    assert!(units.iter().all(|d| *d == 3000) && metres.iter().all(|d| *d == 1.5));
    match TinyRefiner::open(&RefinerOptions { threads: 1, ..RefinerOptions::default() }) {
        Err(e)
            if e.kind() == ErrorKind::NoEngine
                && std::env::var_os("DEPTHRIG_REQUIRE_ONNXRUNTIME").is_none() =>
        {
            println!("skipped: {e}");
        }
        tiny => {
            let (units, ..) = refine_often(&mut tiny.unwrap());
            assert!(units.iter().all(|d| *d > 0));
        }
    }
}

/// Refines images of two sizes again and again; only the first rounds may allocate.
fn refine_often(refiner: &mut dyn Refiner) -> (Vec<u16>, Vec<f32>, Vec<f32>) {
    // Two cameras of one size and one of another, each with an output of its own kind.
    let sizes = [(128, 72), (128, 72), (64, 48)];
    let color: Vec<Vec<u8>> = sizes.iter().map(|(w, h)| vec![77; 3 * w * h]).collect();
    let depth: Vec<Vec<u16>> = sizes.iter().map(|(w, h)| vec![1500; w * h]).collect();
    let mut units = vec![0u16; 128 * 72];
    let mut metres = vec![0f32; 128 * 72];
    let mut inverse = vec![0f32; 64 * 48];
    let mut before = 0;
    for round in 0..6 {
        if round == 2 {
            before = of_process();
        }
        let outputs = [
            Output::Units { pixels: &mut units, unit_m: 0.0005 },
            Output::Metres(&mut metres),
            Output::Inverse(&mut inverse),
        ];
        let mut i = 0;
        let mut jobs = outputs.map(|out| {
            let (width, height) = sizes[i];
            let job = Job {
                color: Color {
                    pixels: &color[i],
                    format: ColorFormat::Rgb8,
                    width,
                    height,
                    stride: 3 * width,
                },
                depth: RawDepth { pixels: &depth[i], unit_m: 0.001 },
                out,
                steps: StepTimes::default(),
            };
            i += 1;
            job
        });
        refiner.refine(&mut jobs).unwrap();
    }
    let allocated = of_process() - before;
    assert!(before > 0, "the counter counts");
    assert_eq!(allocated, 0);
    (units, metres, inverse)
}
