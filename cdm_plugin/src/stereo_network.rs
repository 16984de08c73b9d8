//! A stereo network that a user has in ONNX form, as a matcher like any other.
//!
//! Which networks are taken, by their inputs and outputs, is in docs/zed-replay.md; any other gets an error that names what
//! it has and what is taken. Nothing is known of a network but what its file says: it is run as it is.

use crate::onnxruntime::device::Device;
use crate::onnxruntime::runtime::Runtime;
use crate::onnxruntime::{describe, failed, session};
use crate::{Error, ErrorKind, Precision, Result};
use core::fmt;
use core::str::FromStr;
use depthrig_calib::stereo::{Description, DisparityMap, Matcher, StereoPair};
use form::{Form, Images, Layout, Outlet};
use ort::session::{Session, SessionInputValue};
use ort::value::{Outlet as OrtOutlet, Tensor, TensorElementType, ValueType};
use sha2::{Digest, Sha256};
use std::borrow::Cow;
use std::path::{Path, PathBuf};

#[cfg(any(test, feature = "testing"))]
mod fake;
mod form;
mod images;
#[cfg(test)]
mod tests;

#[cfg(any(test, feature = "testing"))]
pub use fake::FakeNetwork;

/// The key of a network's metadata that says which numbers it takes pixels as: a name of [`NetworkPixels`].
const PIXELS_KEY: &str = "depthrig.pixels";
/// The key that says, with the value `true`, that its disparities are negative numbers.
const NEGATIVE_KEY: &str = "depthrig.negative";
/// Sides of images for networks that take every size: a multiple of this, as all of the common ones need.
const SIDE_MULTIPLE: usize = 32;
/// A network of which more than this share of the disparities is negative means them so.
const NEGATIVE_SHARE: f64 = 0.5;

/// The numbers that a network takes a pixel as.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum NetworkPixels {
    /// 0 to 255.
    #[default]
    Bytes,
    /// 0 to 1.
    Unit,
    /// -1 to 1.
    Signed,
    /// 0 to 1, less the mean and divided by the spread of the images of ImageNet, which most backbones were trained on:
    /// means 0.485, 0.456, 0.406 and spreads 0.229, 0.224, 0.225 (torchvision, `transforms.Normalize`).
    ImageNet,
}

impl NetworkPixels {
    /// All of them.
    pub const ALL: [Self; 4] = [Self::Bytes, Self::Unit, Self::Signed, Self::ImageNet];

    /// Its name: `0-255`, `0-1`, `-1-1` or `imagenet`.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Bytes => "0-255",
            Self::Unit => "0-1",
            Self::Signed => "-1-1",
            Self::ImageNet => "imagenet",
        }
    }

    /// Factor and offset for a byte of the colour channel `c`.
    pub(super) fn scale(self, c: usize) -> images::Scale {
        const MEAN: [f32; 3] = [0.485, 0.456, 0.406];
        const SPREAD: [f32; 3] = [0.229, 0.224, 0.225];
        match self {
            Self::Bytes => images::Scale { factor: 1.0, offset: 0.0 },
            Self::Unit => images::Scale { factor: 1.0 / 255.0, offset: 0.0 },
            Self::Signed => images::Scale { factor: 2.0 / 255.0, offset: -1.0 },
            Self::ImageNet => {
                images::Scale { factor: 1.0 / (255.0 * SPREAD[c % 3]), offset: -MEAN[c % 3] / SPREAD[c % 3] }
            }
        }
    }
}

impl fmt::Display for NetworkPixels {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}

impl FromStr for NetworkPixels {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        Self::ALL.into_iter().find(|p| p.name() == text).ok_or_else(|| {
            let known = Self::ALL.map(Self::name).join(", ");
            Error::new(ErrorKind::BadInput, format!("unknown pixel range {text:?}; use one of: {known}"))
        })
    }
}

/// How a network is run.
#[derive(Debug, Clone, PartialEq)]
pub struct StereoNetworkOptions {
    /// The library of ONNX Runtime or its folder; looked for without.
    pub library: Option<PathBuf>,
    /// The device, such as `cpu` or `cuda:0`.
    pub device: String,
    /// Threads on the CPU.
    pub threads: usize,
    /// The numbers that it takes; what its metadata says without, and [`NetworkPixels::Bytes`] when that says nothing.
    pub pixels: Option<NetworkPixels>,
    /// Its disparities are negative numbers; its metadata may say so as well.
    pub negative: bool,
}

/// A stereo network in ONNX Runtime.
#[derive(Debug)]
pub struct StereoNetwork {
    description: Description,
    /// For errors.
    file: PathBuf,
    engine: String,
    form: Form,
    pixels: NetworkPixels,
    negative: bool,
    /// Width and height of the images that it is given.
    size: (usize, usize),
    /// Width and height of the network's input.
    inner: (usize, usize),
    /// It sees the image in another size, and not with a border.
    resized: bool,
    inputs: Vec<Tensor<f32>>,
    session: Session,
}

fn bad(file: &Path, what: impl fmt::Display) -> Error {
    Error::new(ErrorKind::BadModel, format!("{}: {what}", file.display()))
}

impl StereoNetwork {
    /// Loads the network in `file` for images of `width` and `height`, and runs it once on black images, so that an
    /// unsuitable network is rejected before any work is done.
    ///
    /// # Errors
    /// [`ErrorKind::NotFound`] without the file, [`ErrorKind::NoEngine`] without a usable library,
    /// [`ErrorKind::BadModel`] for a network with unsupported inputs or outputs, [`ErrorKind::BadInput`] for an
    /// unknown device, [`ErrorKind::OutOfMemory`] and [`ErrorKind::Engine`].
    pub fn open(file: &Path, width: usize, height: usize, options: &StereoNetworkOptions) -> Result<Self> {
        let size = (width, height);
        let sha256 = hash(file)?;
        let device: Device = options.device.parse()?;
        device.check(Precision::Fp32)?;
        let runtime = Runtime::get(options.library.as_deref(), &device)?;
        let session = session::open_file(&runtime, file, &device, options.threads.max(1))?;
        let engine = describe(&runtime.version, &device, Precision::Fp32);
        let outlets = |of: &[OrtOutlet]| of.iter().map(outlet).collect::<Vec<_>>();
        let form =
            Form::of(&outlets(session.inputs()), &outlets(session.outputs())).map_err(|e| bad(file, e))?;
        let says = |key: &str| session.metadata().ok().and_then(|m| m.custom(key));
        let stated = says(PIXELS_KEY).map(|text| text.parse()).transpose().map_err(|e| bad(file, e))?;
        let pixels = options.pixels.or(stated).unwrap_or_default();
        let negative = options.negative || says(NEGATIVE_KEY).is_some_and(|v| v == "true");
        let up = |side: usize| side.next_multiple_of(SIDE_MULTIPLE);
        let inner = (form.width.unwrap_or(up(size.0)), form.height.unwrap_or(up(size.1)));
        let resized =
            (form.width.is_some() && inner.0 != size.0) || (form.height.is_some() && inner.1 != size.1);
        let shape = form.shape(inner);
        let inputs = (0..form.images.inputs()).map(|_| {
            let zeros = vec![0.0; shape.iter().product()];
            Tensor::from_array((shape.clone(), zeros)).map_err(|e| failed(&engine, "making room", &e))
        });
        let inputs = inputs.collect::<Result<Vec<_>>>()?;
        let name = file.file_name().unwrap_or(file.as_os_str()).to_string_lossy().replace(' ', "_");
        let fit = if resized { "resized" } else { "padded" };
        let numbers = shape.iter().product::<usize>() * inputs.len();
        let bytes = file.metadata().map_or(0, |m| m.len());
        let description = Description {
            producer: engine.clone(),
            name: "neural".to_owned(),
            parameters: format!(
                "network={name} sha256={sha256} pixels={pixels} {form} size={}x{} {fit} negative={negative}",
                inner.0, inner.1
            ),
            memory_bytes: bytes + 4 * numbers as u64,
        };
        let file = file.to_owned();
        let mut network =
            Self { description, file, engine, form, pixels, negative, size, inner, resized, inputs, session };
        let mut map = DisparityMap::default();
        network.infer(&mut map)?;
        Ok(network)
    }

    /// Runs the network on what its inputs hold.
    fn infer(&mut self, map: &mut DisparityMap) -> Result<()> {
        let Self { session, inputs, form, file, engine, size, inner, resized, negative, .. } = self;
        let values: Vec<(Cow<'_, str>, SessionInputValue<'_>)> =
            form.names.iter().zip(&*inputs).map(|(n, t)| (Cow::from(n.as_str()), t.into())).collect();
        let outputs = session.run(values).map_err(|e| failed(engine, "running", &e))?;
        let plane = |name: &str| {
            let value = outputs.get(name).ok_or_else(|| bad(file, format!("output {name} did not come")))?;
            let (shape, numbers) = value
                .try_extract_tensor::<f32>()
                .map_err(|e| bad(file, format!("output {name} is not in 32-bit floats: {e}")))?;
            let plane = form::plane(shape, numbers.len(), inner.0, inner.1)
                .map_err(|e| bad(file, format!("output {name} {e}")))?;
            Ok::<_, Error>((plane, numbers))
        };
        let fit = images::Fit { size: *size, inner: *inner, resized: *resized };
        let (disparity, numbers) = plane(&form.output)?;
        map.resize(size.0, size.1);
        let below = images::disparity(fit, disparity, numbers, *negative, &mut map.disparity);
        if below > NEGATIVE_SHARE {
            let meant = if *negative { "positive" } else { "negative" };
            return Err(bad(
                file,
                format!(
                    "{:.0} % of its disparities have the wrong sign; it seems to mean them as {meant} numbers: switch \
                     --network-negative, or the key {NEGATIVE_KEY} of its metadata",
                    below * 100.0
                ),
            ));
        }
        let confidence = form.confidence.as_deref().map(plane).transpose()?;
        images::confidence(fit, confidence, &map.disparity, &mut map.confidence);
        Ok(())
    }

    fn fill(&mut self, pair: &StereoPair<'_>) {
        let fit = images::Fit { size: self.size, inner: self.inner, resized: self.resized };
        let channels = self.form.channels;
        for (side, (grey, rgb)) in
            [(pair.left, pair.left_rgb), (pair.right, pair.right_rgb)].into_iter().enumerate()
        {
            let (input, first) = match self.form.images {
                Images::Two => (side, 0),
                Images::Stacked => (0, side * channels),
            };
            let all = channels * if self.form.images == Images::Stacked { 2 } else { 1 };
            let Some(tensor) = self.inputs.get_mut(input) else { continue };
            let numbers = tensor.extract_tensor_mut().1;
            let image = images::Image { grey, rgb: rgb.filter(|_| channels == 3) };
            for c in 0..channels {
                let place = match self.form.layout {
                    Layout::ChannelsFirst => {
                        images::Place { start: (first + c) * self.inner.0 * self.inner.1, step: 1 }
                    }
                    Layout::ChannelsLast => images::Place { start: first + c, step: all },
                };
                images::fill(fit, &image, c, self.pixels.scale(c), place, numbers);
            }
        }
    }
}

impl Matcher for StereoNetwork {
    fn describe(&self) -> Description {
        self.description.clone()
    }

    fn run(&mut self, pair: &StereoPair<'_>, out: &mut DisparityMap) -> depthrig_calib::Result<()> {
        use depthrig_calib::{Error as Calib, ErrorKind as Kind};
        let (width, height) = self.size;
        for (what, grey, rgb) in [("left", pair.left, pair.left_rgb), ("right", pair.right, pair.right_rgb)] {
            let reach = grey.stride.checked_mul(height - 1).and_then(|n| n.checked_add(width));
            let whole = grey.stride >= width && reach.is_some_and(|n| n <= grey.pixels.len());
            let colored = rgb.is_none_or(|c| c.len() == width * height * 3);
            if (grey.width, grey.height) != self.size || !whole || !colored {
                let what = format!(
                    "the {what} image is not one of {width}x{height}, which the network was opened for"
                );
                return Err(Calib::new(Kind::SizeMismatch, what));
            }
        }
        let failed = |e: Error| Calib::new(Kind::BadInput, e.to_string()).with_source(e);
        self.fill(pair);
        self.infer(out).map_err(failed)
    }
}

/// SHA-256 of the file, hexadecimal.
fn hash(file: &Path) -> Result<String> {
    let error = |e: std::io::Error| {
        let kind = if e.kind() == std::io::ErrorKind::NotFound { ErrorKind::NotFound } else { ErrorKind::Io };
        Error::new(kind, format!("the network {} cannot be read: {e}", file.display())).with_source(e)
    };
    let mut source = depthrig_bus::files::open(file).map_err(error)?;
    let mut sha = Sha256::new();
    let mut block = vec![0; 1 << 16];
    loop {
        match std::io::Read::read(&mut source, &mut block) {
            Ok(0) => break,
            Ok(n) => sha.update(&block[..n]),
            Err(e) if e.kind() == std::io::ErrorKind::Interrupted => {}
            Err(e) => return Err(error(e)),
        }
    }
    Ok(crate::durable::hex(&sha.finalize()))
}

fn outlet(of: &OrtOutlet) -> Outlet {
    let (kind, shape) = match of.dtype() {
        ValueType::Tensor { ty, shape, .. } => (ty.to_string(), Some(shape.to_vec())),
        other => (other.to_string(), None),
    };
    let is_float = matches!(of.dtype(), ValueType::Tensor { ty: TensorElementType::Float32, .. });
    Outlet { name: of.name().to_owned(), kind, is_float, shape }
}
