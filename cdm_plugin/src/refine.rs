//! From colour and raw depth of one view to clean metric depth: what every refiner offers.

use crate::Result;

/// How the bytes of a colour image are ordered.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ColorFormat {
    /// Red, green, blue.
    Rgb8,
    /// Blue, green, red.
    Bgr8,
}

/// A colour image, three bytes a pixel.
#[derive(Debug, Clone, Copy)]
pub struct Color<'a> {
    /// The bytes.
    pub pixels: &'a [u8],
    /// Their order.
    pub format: ColorFormat,
    /// Pixels per row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Bytes from one row to the next.
    pub stride: usize,
}

/// Raw depth of the same view and size as its colour image, without padding between rows; 0 is a hole, and so is 65535,
/// which cameras give where their range ends.
#[derive(Debug, Clone, Copy)]
pub struct RawDepth<'a> {
    /// The pixels.
    pub pixels: &'a [u16],
    /// Metres per unit.
    pub unit_m: f64,
}

/// Where refined depth goes: the size of the colour image, without padding. What is not finite or cannot be expressed
/// is 0.
#[derive(Debug)]
pub enum Output<'a> {
    /// 16-bit depth in units of `unit_m` metres.
    Units {
        /// The pixels.
        pixels: &'a mut [u16],
        /// Metres per unit.
        unit_m: f64,
    },
    /// Metres.
    Metres(&'a mut [f32]),
    /// Inverse depth, 1/m, as the network gives it.
    Inverse(&'a mut [f32]),
}

/// One pair of images to be refined.
#[derive(Debug)]
pub struct Job<'a> {
    /// Colour.
    pub color: Color<'a>,
    /// Depth in the view of `color`.
    pub depth: RawDepth<'a>,
    /// Where the result goes.
    pub out: Output<'a>,
    /// Filled in by [`Refiner::refine`].
    pub steps: StepTimes,
}

/// How long each step took, nanoseconds; of a batch, each job has its share.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct StepTimes {
    /// From images to the engine's input.
    pub prepare_ns: u64,
    /// The engine.
    pub infer_ns: u64,
    /// From the engine's output to the result.
    pub finish_ns: u64,
}

/// Description of a refiner.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Description {
    /// The engine with version, device and precision, such as `onnxruntime 1.31.1 cpu fp32`, or `fill`; at most 31 bytes.
    pub engine: String,
    /// [`crate::Model::id`], or empty when the engine needs no model.
    pub model: String,
}

/// Something that turns colour and raw depth into clean depth.
///
/// It may keep memory from one call to the next, but no images: a result depends on its own job alone.
pub trait Refiner: Send {
    /// Describes the refiner.
    fn describe(&self) -> &Description;

    /// How many jobs at a time it gains from; 1 when it gains nothing.
    fn best_batch(&self) -> usize {
        1
    }

    /// Whether the first image of a size takes much longer than the others, so that
    /// [`warm_up`](crate::stage::warm_up) is worth its time.
    fn warms_up(&self) -> bool {
        false
    }

    /// Refines every job. After an error the outputs hold nothing of use. A job without any depth to go by comes out all
    /// holes and does not fail: in a live view that is a hand in front of the lens.
    ///
    /// # Errors
    /// [`crate::ErrorKind::SizeMismatch`] when colour, depth and output of a job differ in size,
    /// [`crate::ErrorKind::BadInput`] for images that cannot be used, [`crate::ErrorKind::OutOfMemory`] and
    /// [`crate::ErrorKind::Engine`] from the engine.
    fn refine(&mut self, jobs: &mut [Job<'_>]) -> Result<()>;
}
