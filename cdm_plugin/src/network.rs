//! The trait of everything that runs a network, independent of the library.

use crate::Result;

/// The size of a network's input.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct NetShape {
    /// Images at a time.
    pub batch: usize,
    /// Rows, a multiple of 14.
    pub height: usize,
    /// Columns, a multiple of 14.
    pub width: usize,
}

impl NetShape {
    /// Patches of one image, without the class token.
    pub const fn patches(self) -> usize {
        (self.height / crate::arch::PATCH) * (self.width / crate::arch::PATCH)
    }

    /// Numbers in the input: colour in three planes and inverse depth in one.
    pub const fn input_len(self) -> usize {
        self.batch * 4 * self.height * self.width
    }

    /// Numbers in the output: inverse depth in one plane.
    pub const fn output_len(self) -> usize {
        self.batch * self.height * self.width
    }
}

/// The position embeddings of both encoders at one size of input, row-major `[1 + patches, width of the encoder]`, the
/// class token first.
#[derive(Debug, Clone, PartialEq)]
pub struct PositionEmbeddings {
    /// Of the encoder of colour.
    pub rgb: Vec<f32>,
    /// Of the encoder of inverse depth.
    pub depth: Vec<f32>,
}

/// A network with its weights, on some engine and device.
pub trait Network: Send {
    /// The engine, its version, the device and the precision, such as `onnxruntime 1.31.1 cpu fp32`; at most 31 bytes.
    fn describe(&self) -> &str;

    /// How many images at a time this engine gains from; 1 when it gains nothing.
    fn best_batch(&self) -> usize {
        1
    }

    /// Whether the first run at a shape takes much longer than the others.
    fn warms_up(&self) -> bool {
        false
    }

    /// Gets ready for inputs of `shape`; called before the first [`Self::run`] at it, and again after another shape was
    /// prepared: images of two sizes may take turns.
    ///
    /// # Errors
    /// [`crate::ErrorKind::OutOfMemory`] and [`crate::ErrorKind::Engine`].
    fn prepare(&mut self, shape: NetShape, positions: &PositionEmbeddings) -> Result<()>;

    /// Runs the network at the size that was prepared last. `x` is `[batch, 4, height, width]`: colour, normalised, and
    /// inverse depth in 1/m; `y` becomes `[batch, height, width]`: inverse depth in 1/m, not negative.
    ///
    /// # Errors
    /// [`crate::ErrorKind::OutOfMemory`] and [`crate::ErrorKind::Engine`].
    fn run(&mut self, x: &[f32], y: &mut [f32]) -> Result<()>;
}

/// The network `tiny` on some engine, for one image at a time.
pub(crate) trait ImageNetwork: Send {
    /// Gets ready for images of `width` by `height`, multiples of 16, and returns where the input belongs: six planes, and the
    /// filled inverse depth.
    ///
    /// # Errors
    /// [`crate::ErrorKind::OutOfMemory`] and [`crate::ErrorKind::Engine`].
    fn inputs(&mut self, width: usize, height: usize) -> Result<(&mut [f32], &mut [f32])>;

    /// Runs the network on the input of the last [`Self::inputs`]: refined inverse depth.
    ///
    /// # Errors
    /// [`crate::ErrorKind::OutOfMemory`] and [`crate::ErrorKind::Engine`].
    fn run(&mut self) -> Result<&[f32]>;
}
