//! Taking views of a board: when it stands still, whether a view adds something, what is missing, and which view to take next.
//!
//! No I/O: [`Capture::look`] is given what the cameras see, round by round, and says what to do.

use crate::board::Board;
use crate::intrinsics::ImageSize;
use crate::mount::{CameraInput, Coverage, usable};
use crate::rig::{RigView, Seen};
use depthrig_bus::{Distortion, Intrinsics};
use depthrig_calib::Result;

mod estimate;
mod hint;
mod plan;
mod poses;
mod progress;
mod still;
#[cfg(test)]
mod tests;

use estimate::{Group, distance_now, groups_of, intrinsics_of};
pub use hint::Hint;
use poses::Points;
pub use poses::Tilt;
pub use progress::{CameraProgress, PairProgress, Progress, State};
use still::{Motion, Stillness, displacements};
pub use still::{STILL_PX, STILL_ROUNDS};

/// The outline of a board in an image: four corners, as shares of its width and height.
pub type Outline = [[f64; 2]; 4];

/// A view is new if in one camera a corner is further than this from its place in every earlier view, of the image's width.
const NEW_VIEW: f64 = 0.03;
/// Uncertainty of projection with which a camera has views enough, pixels: half of what [`crate::mount`] advises against.
pub const CERTAIN_PX: f64 = 0.5;
/// Views for which the hint asks for a common view of two groups of cameras before it goes on with others.
const PATIENCE: usize = 4;

/// A camera whose views are taken.
#[derive(Debug, Clone, PartialEq)]
pub struct CaptureCamera {
    /// Its name.
    pub name: String,
    /// Size of its images.
    pub size: ImageSize,
    /// The intrinsics that it was delivered with, if known.
    pub factory: Option<Intrinsics>,
}

/// Result of [`Capture::look`].
#[derive(Debug, Clone, PartialEq)]
pub struct Step {
    /// How the board stands.
    pub state: State,
    /// A view to take: the cameras of this round that show the board well. It counts as taken.
    pub view: Option<RigView>,
}

/// Views of a board that are being taken.
#[derive(Debug)]
pub struct Capture {
    cameras: Vec<CaptureCamera>,
    points: Points,
    stillness: Stillness,
    state: State,
    now: Vec<Seen>,
    views: Vec<RigView>,
    /// Of the views so far.
    knowledge: Knowledge,
    /// Groups of cameras, and the views when their number last changed.
    joined: Joined,
    hint: Option<Hint>,
}

/// Knowledge from the views so far.
#[derive(Debug, Clone, Default)]
struct Knowledge {
    intrinsics: Vec<Intrinsics>,
    /// Groups of cameras that common views join; those without a view alone.
    groups: Vec<Group>,
    /// Worst uncertainty of projection of each camera, pixels.
    worst_px: Vec<Option<f64>>,
    coverage: Vec<Coverage>,
}

#[derive(Debug, Clone, Copy, Default)]
struct Joined {
    groups: usize,
    since: usize,
}

impl Capture {
    /// Nothing taken yet.
    ///
    /// # Errors
    /// As [`Board::check`].
    pub fn new(cameras: Vec<CaptureCamera>, board: &Board) -> Result<Self> {
        board.check()?;
        let mut capture = Self {
            points: Points::new(board),
            stillness: Stillness::default(),
            state: State::Searching,
            now: Vec::new(),
            views: Vec::new(),
            knowledge: Knowledge::default(),
            joined: Joined::default(),
            hint: None,
            cameras,
        };
        capture.learn();
        Ok(capture)
    }

    /// The views that were taken.
    pub fn views(&self) -> &[RigView] {
        &self.views
    }

    /// The cameras.
    pub fn cameras(&self) -> &[CaptureCamera] {
        &self.cameras
    }

    /// Adds views that were taken earlier.
    pub fn restore(&mut self, views: Vec<RigView>) {
        self.views.extend(views);
        self.learn();
    }

    /// Looks at what the cameras see in one round: one new image of each. A view that is returned was added to those taken.
    pub fn look(&mut self, seen: &[Seen]) -> Step {
        self.now = seen.to_vec();
        let mut view = None;
        self.state = match self.stillness.look(seen) {
            Motion::Unseen => State::Searching,
            Motion::Moving => State::Moving,
            Motion::Settling => State::HoldStill,
            Motion::Still => {
                let steady = self.usable();
                if steady.is_empty() {
                    State::Unusable
                } else if self.is_known(&steady) {
                    // The view that was just taken stays in sight until the board is moved.
                    if self.state == State::Taken { State::Taken } else { State::Known }
                } else {
                    view = Some(RigView { name: (self.views.len() + 1).to_string(), seen: steady });
                    State::Taken
                }
            }
        };
        if let Some(view) = &view {
            self.views.push(view.clone());
            self.learn();
        }
        Step { state: self.state, view }
    }

    /// Takes a view back that could not be stored.
    pub fn forget_last(&mut self) {
        self.views.pop();
        self.learn();
    }

    /// Whether nothing is missing.
    pub fn is_enough(&self) -> bool {
        !self.views.is_empty() && self.progress().missing.is_empty()
    }

    /// The view to take next; `None` if nothing is missing.
    pub const fn hint(&self) -> Option<&Hint> {
        self.hint.as_ref()
    }

    /// Everything that a display shows.
    pub fn progress(&self) -> Progress {
        progress::progress(self)
    }

    /// The sightings of this round that a calibration can use.
    fn usable(&self) -> Vec<Seen> {
        let inputs: Vec<CameraInput> = self
            .cameras
            .iter()
            .map(|c| CameraInput {
                name: c.name.clone(),
                size: c.size,
                factory: c.factory,
                model: Distortion::BrownConrady,
            })
            .collect();
        let view = RigView { name: String::new(), seen: self.stillness.steady() };
        usable(&inputs, vec![view])
            .ok()
            .and_then(|u| u.views.into_iter().next())
            .map_or_else(Vec::new, |v| v.seen)
    }

    /// Whether a view that was taken shows the same: every camera the board, at the same place.
    fn is_known(&self, seen: &[Seen]) -> bool {
        let same_place = |now: &Seen, before: &Seen| {
            let moved = displacements(before, now).into_iter().fold(0.0, f64::max);
            let common = displacements(before, now).len() * 2 >= now.corners.len();
            common && moved <= NEW_VIEW * f64::from(self.cameras[now.camera].size.width)
        };
        self.views.iter().any(|view| {
            seen.iter().all(|now| view.seen.iter().any(|b| b.camera == now.camera && same_place(now, b)))
        })
    }

    /// Calibrates roughly from the views so far, and plans the next one.
    fn learn(&mut self) {
        let intrinsics: Vec<Intrinsics> =
            (self.cameras.iter().enumerate()).map(|(i, c)| intrinsics_of(c, i, &self.views)).collect();
        let coverage = (self.cameras.iter().enumerate())
            .map(|(i, c)| {
                let seen = self.views.iter().flat_map(|v| &v.seen).filter(|s| s.camera == i);
                Coverage::new(c.size, seen.flat_map(|s| &s.corners).map(|c| c.pixel))
            })
            .collect();
        let groups: Vec<Group> = groups_of(self.cameras.len(), &self.views)
            .iter()
            .filter_map(|members| Group::new(members, &self.cameras, &intrinsics, &self.views))
            .collect();
        let mut worst_px = vec![None; self.cameras.len()];
        for group in &groups {
            let Some(covariance) = group.information.covariance() else { continue };
            for (local, camera) in group.cameras.iter().enumerate() {
                let boards = &group.problem.rig_from_board;
                let size = self.cameras[*camera].size;
                worst_px[*camera] =
                    group.uncertainty(local, size, &covariance, boards, None).map(|u| u.worst_px);
            }
        }
        self.knowledge = Knowledge { intrinsics, groups, worst_px, coverage };
        let count = self.group_count();
        if self.joined.groups != count {
            self.joined = Joined { groups: count, since: self.views.len() };
        }
        self.hint = hint::hint(self);
    }

    /// Groups of cameras that no view joins; a camera without a view is one of its own.
    fn group_count(&self) -> usize {
        let groups = groups_of(self.cameras.len(), &self.views);
        groups.len() + self.cameras.len() - groups.iter().map(Vec::len).sum::<usize>()
    }

    fn views_of(&self, camera: usize) -> usize {
        self.views.iter().filter(|v| v.seen.iter().any(|s| s.camera == camera)).count()
    }

    fn shared_views(&self, a: usize, b: usize) -> usize {
        let sees = |view: &RigView, camera: usize| view.seen.iter().any(|s| s.camera == camera);
        self.views.iter().filter(|v| sees(v, a) && sees(v, b)).count()
    }

    /// Distance of the board in the newest view of a camera, or now, metres.
    fn distance_m(&self, camera: usize) -> Option<f64> {
        let newest = self.views.iter().rev().flat_map(|v| &v.seen);
        let seen = self.now.iter().chain(newest).find(|s| s.camera == camera)?;
        distance_now(self.knowledge.intrinsics.get(camera)?, seen)
    }
}
