//! Which pixel a nearest-neighbour resize takes, with the rounding of the two libraries of the official code.

/// For each of `to` places, the one of `from` that OpenCV's `INTER_NEAREST` takes (`resizeNN` in
/// modules/imgproc/src/resize.cpp, Apache-2.0): `floor(i / (to / from))` in `f64`.
pub(super) fn index_like_opencv(from: usize, to: usize) -> Vec<u32> {
    let step = 1.0 / (to as f64 / from as f64);
    (0..to).map(|i| ((i as f64 * step).floor() as usize).min(from - 1) as u32).collect()
}

/// For each of `to` places, the one of `from` that PyTorch's `interpolate(mode="nearest")` takes
/// (aten/src/ATen/native/cpu/UpSampleKernel.cpp, BSD-3-Clause): `floor(i * (from / to))` in `f32`.
pub(super) fn index_like_torch(from: usize, to: usize) -> Vec<u32> {
    let step = from as f32 / to as f32;
    (0..to).map(|i| ((i as f32 * step).floor() as usize).min(from - 1) as u32).collect()
}
