//! Progress of a capture, for displays.

use super::{CERTAIN_PX, Capture, Hint};
use crate::mount::{FEW_SHARED, FEW_VIEWS, MIN_CORNERS};
use crate::rig::Seen;
use serde::{Deserialize, Serialize};

/// How the board stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum State {
    /// No camera sees it.
    Searching,
    /// It moves.
    Moving,
    /// It has just come to rest.
    HoldStill,
    /// It stands still where a view was taken already.
    Known,
    /// It stands still and no calibration could use what is seen of it.
    Unusable,
    /// A view of it was taken.
    Taken,
}

/// Progress of a capture.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Progress {
    /// How the board stands.
    pub state: State,
    /// Views that were taken.
    pub views: usize,
    /// The cameras.
    pub cameras: Vec<CameraProgress>,
    /// Every pair of cameras that share a view, and those that should.
    pub pairs: Vec<PairProgress>,
    /// Missing things, in words; empty when everything is there.
    pub missing: Vec<String>,
    /// The view that would help most.
    pub hint: Option<Hint>,
}

/// View of a camera now, and its views so far.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CameraProgress {
    /// Its name.
    pub name: String,
    /// Corners that it sees now.
    pub corners: usize,
    /// Places of these corners, as shares of the image's width and height.
    pub at: Vec<[f32; 2]>,
    /// Views that show the board to it.
    pub views: usize,
    /// Corners of all views in each cell of the image, row by row.
    pub coverage: Vec<u32>,
    /// Cells along x.
    pub coverage_columns: usize,
    /// Uncertainty of projection at the worst place of the image, pixels; absent before the first view.
    pub worst_px: Option<f64>,
    /// Missing things of it, in words.
    pub missing: Vec<String>,
}

/// Views that two cameras share.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct PairProgress {
    /// Name of one camera.
    pub a: String,
    /// Name of the other.
    pub b: String,
    /// Views that show the board to both.
    pub shared: usize,
    /// Views that are still needed of this pair, because nothing else joins the cameras well enough.
    pub missing: usize,
}

/// Needs of one camera.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct Lacks {
    pub(super) views: bool,
    pub(super) certainty: bool,
    pub(super) parts: Vec<&'static str>,
    /// Too few views shared with any one camera.
    pub(super) shared: bool,
}

impl Lacks {
    pub(super) const fn is_nothing(&self) -> bool {
        !self.views && !self.certainty && self.parts.is_empty() && !self.shared
    }
}

pub(super) fn lacks(capture: &Capture, camera: usize) -> Lacks {
    let knowledge = &capture.knowledge;
    Lacks {
        views: capture.views_of(camera) < FEW_VIEWS,
        certainty: knowledge.worst_px[camera].is_none_or(|w| w > CERTAIN_PX),
        parts: knowledge.coverage[camera].empty_parts(),
        shared: capture.cameras.len() > 1 && most_shared(capture, camera) < FEW_SHARED,
    }
}

fn most_shared(capture: &Capture, camera: usize) -> usize {
    let others = (0..capture.cameras.len()).filter(|other| *other != camera);
    others.map(|other| capture.shared_views(camera, other)).max().unwrap_or(0)
}

pub(super) fn progress(capture: &Capture) -> Progress {
    let cameras: Vec<CameraProgress> = (0..capture.cameras.len()).map(|c| of_camera(capture, c)).collect();
    let mut missing: Vec<String> =
        cameras.iter().flat_map(|c| c.missing.iter().map(move |m| format!("{}: {m}", c.name))).collect();
    let groups = well_joined(capture);
    if groups.len() > 1 {
        let names: Vec<String> = groups.iter().map(|g| format!("[{}]", names(capture, g))).collect();
        missing.push(format!(
            "the board seen by cameras of two groups at once, {FEW_SHARED} times: {}",
            names.join(" and ")
        ));
    }
    Progress {
        state: capture.state,
        views: capture.views.len(),
        pairs: pairs(capture, &groups),
        cameras,
        missing,
        hint: capture.hint.clone(),
    }
}

fn of_camera(capture: &Capture, index: usize) -> CameraProgress {
    let camera = &capture.cameras[index];
    let now = capture.now.iter().find(|s| s.camera == index);
    let coverage = &capture.knowledge.coverage[index];
    let at = |seen: &Seen| {
        let share = |c: &crate::adjustment::Corner| {
            let x = c.pixel.x / f64::from(camera.size.width);
            let y = c.pixel.y / f64::from(camera.size.height);
            // Four digits are a tenth of a pixel and keep an event small.
            [(x * 1e4).round() as f32 / 1e4, (y * 1e4).round() as f32 / 1e4]
        };
        seen.corners.iter().map(share).collect()
    };
    CameraProgress {
        name: camera.name.clone(),
        corners: now.map_or(0, |s| s.corners.len()),
        at: now.map_or_else(Vec::new, at),
        views: capture.views_of(index),
        coverage: coverage.corners.clone(),
        coverage_columns: coverage.columns,
        worst_px: capture.knowledge.worst_px[index],
        missing: missing_of(capture, index),
    }
}

fn missing_of(capture: &Capture, camera: usize) -> Vec<String> {
    let lacks = lacks(capture, camera);
    let mut missing = Vec::new();
    if lacks.views {
        missing.push(format!("{} of {FEW_VIEWS} views", capture.views_of(camera)));
    }
    if capture.views_of(camera) == 0 {
        return missing;
    }
    if !lacks.parts.is_empty() {
        missing.push(format!("the board at {} of the image", lacks.parts.join(", ")));
    }
    match capture.knowledge.worst_px[camera] {
        Some(worst) if worst > CERTAIN_PX && !lacks.views => {
            missing.push(format!("projection is uncertain by {worst:.1} px, {CERTAIN_PX} px is enough"));
        }
        None if !lacks.views => {
            missing.push(format!(
                "its views cannot be calibrated yet; check board.toml, and show the board tilted, with {MIN_CORNERS} corners and more"
            ));
        }
        _ => {}
    }
    if lacks.shared {
        missing.push(format!(
            "{} of {FEW_SHARED} views together with another camera",
            most_shared(capture, camera)
        ));
    }
    missing
}

/// Groups of cameras that are joined by pairs with views enough.
pub(super) fn well_joined(capture: &Capture) -> Vec<Vec<usize>> {
    let n = capture.cameras.len();
    let mut group: Vec<usize> = (0..n).collect();
    for a in 0..n {
        for b in 0..a {
            if group[a] != group[b] && capture.shared_views(a, b) >= FEW_SHARED {
                let old = group[a];
                let new = group[b];
                group.iter_mut().filter(|g| **g == old).for_each(|g| *g = new);
            }
        }
    }
    let of = |label: usize| (0..n).filter(|c| group[*c] == label).collect::<Vec<usize>>();
    (0..n).map(of).filter(|g| !g.is_empty()).collect()
}

fn pairs(capture: &Capture, groups: &[Vec<usize>]) -> Vec<PairProgress> {
    let group_of = |camera: usize| groups.iter().position(|g| g.contains(&camera));
    let mut pairs = Vec::new();
    for b in 0..capture.cameras.len() {
        for a in 0..b {
            let shared = capture.shared_views(a, b);
            let apart = group_of(a) != group_of(b);
            // A pair that shares a view can share more; of pairs that share none nobody knows whether they can.
            let missing = if apart && shared > 0 { FEW_SHARED - shared.min(FEW_SHARED) } else { 0 };
            if shared > 0 {
                let name = |c: usize| capture.cameras[c].name.clone();
                pairs.push(PairProgress { a: name(a), b: name(b), shared, missing });
            }
        }
    }
    pairs
}

pub(super) fn names(capture: &Capture, cameras: &[usize]) -> String {
    let names: Vec<&str> = cameras.iter().map(|c| capture.cameras[*c].name.as_str()).collect();
    names.join(", ")
}
