//! Bringing a dataset out of the guest, for readers on the host that are not ours.

use crate::checks::REPORT_VARIABLE;
use anyhow::{Context, bail};
use depthrig_bus::PixelFormat;
use depthrig_recorder::{Dataset, PixelMode, SetRange};
use serde_json::json;
use std::path::{Path, PathBuf};

/// Copies `dataset` to where the host has it read (`tests/vm/rig/outside.py`), with a list of its images as depthrig reads
/// them here. Returns how many; `None` without a host to bring it to.
///
/// # Errors
/// When it cannot be read or copied.
pub fn bring(scenario: &str, dataset: &Path) -> anyhow::Result<Option<usize>> {
    let Some(report) = std::env::var_os(REPORT_VARIABLE).map(PathBuf::from) else { return Ok(None) };
    let share = report.parent().context("the report lies in the shared folder")?;
    let out = share.join("out").join(scenario);
    std::fs::create_dir_all(out.join("dataset"))?;
    for entry in std::fs::read_dir(dataset)? {
        let entry = entry?;
        if entry.file_type()?.is_file() {
            std::fs::copy(entry.path(), out.join("dataset").join(entry.file_name()))?;
        }
    }
    let dataset = Dataset::open(dataset)?;
    let session = dataset.session().clone();
    let mut images = Vec::new();
    for set in dataset.sets_with(SetRange::ALL, PixelMode::Stored) {
        let set = set?;
        for frame in &set.frames {
            let stream = &session.streams[frame.stream];
            let (last, encoding) = match frame.codec {
                "raw" => ("image_raw", encoding(stream.format)?),
                "jpeg" | "mjpeg" => ("image_compressed", "jpeg"),
                "png" => ("image_compressed", "png"),
                other => bail!("{} is stored as {other}", stream.id),
            };
            images.push(json!({
                "topic": format!("/{}/{}/{last}", session.rig, stream.id),
                "log_time": set.utc_ns.to_string(),
                "width": stream.width,
                "height": stream.height,
                "encoding": encoding,
                "crc32": crc32fast::hash(&frame.pixels),
            }));
        }
    }
    std::fs::write(out.join("expected.json"), serde_json::to_vec(&images)?)?;
    Ok(Some(images.len()))
}

/// Name of a format in ROS.
fn encoding(format: PixelFormat) -> anyhow::Result<&'static str> {
    Ok(match format {
        PixelFormat::Rgb8 => "rgb8",
        PixelFormat::Mono8 | PixelFormat::Confidence8 => "mono8",
        PixelFormat::Mono16 => "mono16",
        PixelFormat::Z16 => "16UC1",
        PixelFormat::DisparityF32 => "32FC1",
        PixelFormat::Yuyv => "yuv422_yuy2",
        other => bail!("{} is not known to the outside readers' check", other.name()),
    })
}
