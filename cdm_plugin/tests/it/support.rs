//! Real pairs of images, the official code's numbers for them, and seeded weights.

use depthrig_cdm::{ChannelOrder, Color, ColorFormat, Encoder, Model, RawDepth, Weights};
use safetensors::SafeTensors;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::{Arc, Mutex, PoisonError};

/// The folder of the test data.
pub fn data() -> PathBuf {
    let default = || Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/data");
    let root =
        std::env::var_os("DEPTHRIG_TEST_DATA").filter(|v| !v.is_empty()).map_or_else(default, PathBuf::from);
    assert!(
        root.join("cdm_parity").is_dir(),
        "the parity data are not in {}: set DEPTHRIG_TEST_DATA to the absolute path of a folder that holds cdm_parity, \
         cdm_d405 and lingbot_depth",
        root.display()
    );
    root
}

/// Colour (red first) and raw depth of one view.
pub struct Pair {
    pub color: Vec<u8>,
    pub depth: Vec<u16>,
    pub unit_m: f64,
    pub width: usize,
    pub height: usize,
}

impl Pair {
    fn open(color: &str, depth: &str, unit_m: f64) -> Self {
        let open = |name: &str| {
            let path = data().join(name);
            image::open(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
        };
        let color = open(color).into_rgb8();
        let depth = open(depth).into_luma16();
        assert_eq!(color.dimensions(), depth.dimensions());
        let width = color.width() as usize;
        let height = color.height() as usize;
        Self { color: color.into_raw(), depth: depth.into_raw(), unit_m, width, height }
    }

    /// A RealSense D405, 1280x720, unit 0.1 mm.
    pub fn d405() -> Self {
        Self::open("cdm_d405/color_26.png", "cdm_d405/depth_26.png", 0.0001)
    }

    /// A RealSense D435, 640x480, unit 1 mm.
    pub fn lingbot(number: u32) -> Self {
        let file = |name| format!("lingbot_depth/{number}/{name}");
        Self::open(&file("rgb.png"), &file("raw_depth.png"), 0.001)
    }

    pub fn color(&self) -> Color<'_> {
        Color {
            pixels: &self.color,
            format: ColorFormat::Rgb8,
            width: self.width,
            height: self.height,
            stride: 3 * self.width,
        }
    }

    pub fn depth(&self) -> RawDepth<'_> {
        RawDepth { pixels: &self.depth, unit_m: self.unit_m }
    }
}

/// One file of the official code's numbers.
pub struct Tensors(Vec<u8>);

impl Tensors {
    pub fn open(path: impl AsRef<Path>) -> Self {
        let path = data().join("cdm_parity").join(path);
        Self(std::fs::read(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display())))
    }

    /// The shape and the numbers of one tensor.
    pub fn get(&self, name: &str) -> (Vec<usize>, Vec<f32>) {
        let file = SafeTensors::deserialize(&self.0).unwrap();
        let tensor = file.tensor(name).unwrap();
        assert_eq!(tensor.dtype(), safetensors::Dtype::F32);
        let numbers = tensor.data().as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
        (tensor.shape().to_vec(), numbers)
    }
}

/// The largest difference; NaN anywhere is infinite.
pub fn max_abs(a: &[f32], b: &[f32]) -> f32 {
    assert_eq!(a.len(), b.len());
    a.iter()
        .zip(b)
        .map(|(a, b)| (a - b).abs())
        .fold(0.0, |m, d| if d.is_nan() { f32::INFINITY } else { m.max(d) })
}

/// The model with weights that are random but the same everywhere, as the official code was given them: made by
/// `make_seeded_weights.py` beside the parity data, once, and kept under `target/`.
///
/// The Python is `$PYTHON`, or that of the repository's `.venv`; it needs numpy and safetensors.
pub fn seeded_model(encoder: Encoder) -> Model {
    Model {
        id: format!("seeded-{encoder}@20260"),
        encoder,
        weights: Arc::new(Weights::open(seeded_weights(encoder)).unwrap()),
        channel_order: ChannelOrder::Bgr,
        input_size: 518,
        max_depth_m: 6.0,
    }
}

/// The file of [`seeded_model`].
pub fn seeded_weights(encoder: Encoder) -> PathBuf {
    // Tests of one process wait for each other; those of two make it twice, and the second file replaces an equal one.
    static MAKING: Mutex<()> = Mutex::new(());
    let _one = MAKING.lock().unwrap_or_else(PoisonError::into_inner);
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR"));
    let path = folder.join(format!("cdm-seeded-{encoder}.safetensors"));
    if path.exists() {
        return path;
    }
    let script = data().join("cdm_parity/make_seeded_weights.py");
    let python = std::env::var_os("PYTHON")
        .filter(|v| !v.is_empty())
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../.venv/bin/python"), PathBuf::from);
    let unfinished = folder.join(format!("cdm-seeded-{encoder}.{}.part", std::process::id()));
    let ran = Command::new(&python).arg(script).arg(encoder.name()).arg(&unfinished).output();
    let output = ran.unwrap_or_else(|e| {
        panic!(
            "{}: {e}; `make test` installs it; or set PYTHON to a Python with numpy and safetensors",
            python.display()
        )
    });
    assert!(
        output.status.success(),
        "{} made no weights: {}\nit needs numpy and safetensors (python/requirements-test.txt); `make test` installs them",
        python.display(),
        String::from_utf8_lossy(&output.stderr)
    );
    std::fs::rename(&unfinished, &path).unwrap();
    path
}
