//! Entry points of the fuzz targets of Azure Kinect recordings and calibrations.

use crate::recording::{Recording, motion_samples};
use crate::{Calibration, ColorResolution, DepthMode};
use depthrig_calib::Camera;

/// Bytes as a recording: opened, read from front to back, and from the middle. Returns the blocks that were found, and
/// 1 for a recording that has none.
///
/// # Panics
/// When frames have more bytes than the file, memory is more than the file's, seeking finds what is earlier, or what is
/// left out is more than there is.
pub fn recording(bytes: &[u8]) -> u64 {
    let Ok(mut recording) = Recording::read(Box::new(bytes.to_vec()), "fuzz") else { return 0 };
    let _ = recording.calibration();
    let mut blocks = 0;
    let mut inside = 0;
    let mut last_us = 0;
    while let Ok(Some(block)) = recording.next_block() {
        blocks += 1;
        last_us = block.device_us;
        for frame in block.frames() {
            inside += frame.len();
            let samples = motion_samples(frame).count();
            assert!(samples * 40 <= frame.len());
        }
    }
    assert!(inside <= bytes.len(), "{inside} bytes of frames in a file of {}", bytes.len());
    assert!(recording.memory_bytes() <= bytes.len());
    assert!(recording.losses().bytes <= bytes.len() as u64);
    let middle_us = last_us / 2;
    if recording.seek(middle_us).is_ok() {
        let mut again = 0;
        while let Ok(Some(block)) = recording.next_block() {
            assert!(block.device_us >= middle_us);
            again += 1;
        }
        assert!(again <= blocks, "{again} blocks from the middle on, {blocks} in all");
    }
    blocks.max(1)
}

/// Bytes as a calibration; whether they are one.
///
/// # Panics
/// When an accepted calibration gives invalid intrinsics or an invalid pose, or changes by being written and read.
pub fn calibration(bytes: &[u8]) -> u64 {
    let Ok(read) = Calibration::parse(bytes) else { return 0 };
    let depth = DepthMode::ALL.map(|m| read.depth_intrinsics(m));
    let color = ColorResolution::ALL.map(|r| read.color_intrinsics(r));
    for k in depth.iter().chain(&color) {
        assert!(Camera::new(k).is_ok(), "{k:?}");
    }
    for pose in [read.color_from_depth(), read.color_in_device(), read.depth_in_device()] {
        let length = pose.rotation_xyzw.iter().map(|c| c * c).sum::<f64>();
        assert!((length - 1.0).abs() < 1e-6 && pose.translation_m.iter().all(|t| t.abs() <= 3.0), "{pose:?}");
    }
    let off = read.approximation_px(Some(DepthMode::NfovUnbinned), Some(ColorResolution::P720));
    assert!(off >= 0.0, "{off}");
    let again = Calibration::parse(read.build().as_bytes());
    let again = again.unwrap_or_else(|e| panic!("what was written cannot be read: {e}"));
    assert_eq!(again.depth.intrinsics, read.depth.intrinsics);
    assert_eq!(again.color.intrinsics, read.color.intrinsics);
    1
}

#[cfg(test)]
mod tests {
    use depthrig_corpus::run;

    #[test]
    fn recordings() {
        run("kinect_mkv", super::recording);
    }

    #[test]
    fn calibrations() {
        run("kinect_calibration", super::calibration);
    }
}
