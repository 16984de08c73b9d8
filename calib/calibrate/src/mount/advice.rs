//! Doubts about a calibration, and advice for the next one.

use super::{CameraResult, MountResult, Source};

/// Views of a camera below which intrinsics are weak.
pub(crate) const FEW_VIEWS: usize = 10;
/// Views that two cameras must share.
pub(crate) const FEW_SHARED: usize = 3;
/// Uncertainty of projection that is worth a remark, pixels.
const UNCERTAIN_PX: f64 = 1.0;
/// Corners left out, of all, that are worth a remark.
const MANY_OUTLIERS: f64 = 0.02;
/// A view whose residual is this many times the camera's is doubtful.
const BAD_VIEW: f64 = 3.0;
/// A view of which more than this share of the corners was left out is wrong as a whole.
const WRONG_VIEW: f64 = 0.25;
/// Residuals above this mean that something is wrong, pixels.
const LARGE_RMS_PX: f64 = 1.0;

pub(super) fn advice(result: &MountResult) -> Vec<String> {
    let mut lines = Vec::new();
    for camera in &result.cameras {
        of_camera(camera, &mut lines);
    }
    of_views(result, &mut lines);
    of_pairs(result, &mut lines);
    lines
}

fn of_camera(camera: &CameraResult, lines: &mut Vec<String>) {
    let name = &camera.name;
    if camera.source == Source::Calibrated && camera.views < FEW_VIEWS {
        lines.push(format!("{name}: {} views; take {FEW_VIEWS} or more", camera.views));
    }
    let empty = camera.coverage.empty_parts();
    if camera.source == Source::Calibrated && !empty.is_empty() {
        lines.push(format!(
            "{name}: the board was never at {} of the image; take views there",
            empty.join(", ")
        ));
    }
    let worst = camera.uncertainty.worst_px();
    if worst > UNCERTAIN_PX {
        lines.push(format!(
            "{name}: projection is uncertain by up to {worst:.1} px at the edge of the image, {:.2} px in the middle; \
             take views with the board at the edges, tilted by 30 to 45 degrees",
            camera.uncertainty.middle_px()
        ));
    }
    let share = camera.outliers as f64 / (camera.corners + camera.outliers).max(1) as f64;
    if share > MANY_OUTLIERS {
        lines.push(format!(
            "{name}: {:.1} % of the corners were left out as wrong; look for blur, reflections and a board that is not flat",
            100.0 * share
        ));
    }
    if camera.rms_px > LARGE_RMS_PX {
        lines.push(format!(
            "{name}: residuals of {:.2} px are large; check the board's measurements, that nothing moved, and the lens model",
            camera.rms_px
        ));
    }
    if let (Source::Calibrated, Some(theirs), Some(ours)) =
        (camera.source, camera.factory_px, camera.held_out_px)
    {
        lines.push(format!(
            "{name}: the factory's intrinsics leave {theirs:.3} px on these views, the new ones {ours:.3} px on views that they were not \
             fitted to"
        ));
    }
}

fn of_views(result: &MountResult, lines: &mut Vec<String>) {
    for view in &result.views {
        for seen in &view.seen {
            let camera = &result.cameras[seen.camera];
            if seen.outliers as f64 > WRONG_VIEW * (seen.corners + seen.outliers) as f64 {
                lines.push(format!(
                    "view {}, {}: {} of {} corners were left out as wrong: the board or the mount moved, or the image is blurred; leave the \
                     view out",
                    view.name,
                    camera.name,
                    seen.outliers,
                    seen.corners + seen.outliers
                ));
            } else if seen.rms_px > BAD_VIEW * camera.rms_px {
                lines.push(format!(
                    "view {}, {}: residuals of {:.2} px, {:.1} times those of the other views: the board or the mount moved, or the image is \
                     blurred; leave the view out",
                    view.name,
                    camera.name,
                    seen.rms_px,
                    seen.rms_px / camera.rms_px
                ));
            }
        }
    }
}

fn of_pairs(result: &MountResult, lines: &mut Vec<String>) {
    for (i, camera) in result.cameras.iter().enumerate().skip(1) {
        let shared = |other: usize| {
            let both = result
                .views
                .iter()
                .filter(|v| v.seen.iter().any(|s| s.camera == i) && v.seen.iter().any(|s| s.camera == other));
            both.count()
        };
        let most = (0..result.cameras.len()).filter(|k| *k != i).map(shared).max().unwrap_or(0);
        if most < FEW_SHARED {
            lines.push(format!(
                "{}: only {most} views show the board to it and to another camera at once; take {FEW_SHARED} or more",
                camera.name
            ));
        }
    }
}
