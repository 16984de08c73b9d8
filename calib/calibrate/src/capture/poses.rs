//! Where a board may be held before a camera, and what each camera then sees.

use super::Outline;
use crate::Rigid;
use crate::adjustment::{AdjustedCamera, Corner, Sighting};
use crate::board::{Board, Pattern};
use crate::intrinsics::ImageSize;
use crate::mount::MIN_CORNERS;
use depthrig_calib::Camera;
use glam::{DMat3, DQuat, DVec2, DVec3};
use serde::{Deserialize, Serialize};

/// How the board is turned, as the camera sees it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Tilt {
    /// Straight at the camera.
    None,
    /// The top away from the camera.
    TopAway,
    /// The bottom away.
    BottomAway,
    /// The left side of the image away.
    LeftAway,
    /// The right side away.
    RightAway,
}

impl Tilt {
    const ALL: [Self; 5] = [Self::None, Self::TopAway, Self::BottomAway, Self::LeftAway, Self::RightAway];

    fn rotation(self) -> DQuat {
        match self {
            Self::None => DQuat::IDENTITY,
            Self::TopAway => DQuat::from_rotation_x(-TILT),
            Self::BottomAway => DQuat::from_rotation_x(TILT),
            Self::LeftAway => DQuat::from_rotation_y(TILT),
            Self::RightAway => DQuat::from_rotation_y(-TILT),
        }
    }
}

/// Angle of a tilt, radians: 35 degrees, at which foreshortening shows the focal length well and corners are still found well.
const TILT: f64 = 0.61;
/// Centre of the board along x and y of the image, as a share of it.
const PLACES: [f64; 3] = [0.2, 0.5, 0.8];
/// The board's diagonal as a share of the image's.
const SIZES: [f64; 3] = [0.3, 0.5, 0.8];
/// Corners are found this far from the edge of the image, pixels.
const MARGIN_PX: f64 = 3.0;
/// Cosine of the steepest angle at which corners are found.
const STEEPEST: f64 = 0.42;
/// Corners closer together than this are confused, pixels.
const MIN_SPACING_PX: f64 = 8.0;

/// A pose of the board before one camera.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Candidate {
    /// The pose in the camera's frame.
    pub(super) camera_from_board: Rigid,
    /// Its place in the image: column and row of nine.
    pub(super) column: usize,
    /// See `column`.
    pub(super) row: usize,
    /// Distance of its centre, metres.
    pub(super) distance_m: f64,
    /// Its tilt.
    pub(super) tilt: Tilt,
}

/// The board's corners, and what poses need to know of it.
#[derive(Debug, Clone)]
pub(super) struct Points {
    pub(super) corners: Vec<DVec3>,
    centre: DVec3,
    diagonal: f64,
    upright: DQuat,
    /// Least distance of two corners.
    spacing: f64,
    /// Corners that must be seen at once.
    least: usize,
}

impl Points {
    pub(super) fn new(board: &Board) -> Self {
        let corners: Vec<DVec3> = (0..board.corner_count()).map(|id| board.corner(id)).collect();
        let low = corners.iter().copied().fold(DVec3::INFINITY, DVec3::min);
        let high = corners.iter().copied().fold(DVec3::NEG_INFINITY, DVec3::max);
        let spacing = corners.iter().skip(1).map(|c| c.distance(corners[0])).fold(f64::INFINITY, f64::min);
        Self {
            centre: (low + high) * 0.5,
            diagonal: (high - low).length(),
            // An AprilGrid's y axis points up.
            upright: match board.pattern {
                Pattern::Aprilgrid => DQuat::from_rotation_x(core::f64::consts::PI),
                Pattern::Charuco | Pattern::Chessboard => DQuat::IDENTITY,
            },
            least: match board.pattern {
                Pattern::Chessboard => corners.len(),
                Pattern::Charuco | Pattern::Aprilgrid => (corners.len() / 2).max(MIN_CORNERS),
            },
            spacing,
            corners,
        }
    }

    /// Poses before a camera: nine places, three distances, five tilts, as far as they can be seen.
    pub(super) fn candidates(&self, lens: &Camera, size: ImageSize) -> Vec<Candidate> {
        let mut all = Vec::new();
        for share in SIZES {
            for (row, y) in PLACES.iter().enumerate() {
                for (column, x) in PLACES.iter().enumerate() {
                    for tilt in Tilt::ALL {
                        let at = DVec2::new(x * f64::from(size.width), y * f64::from(size.height));
                        let Some(pose) = self.placed(lens, size, at, share, tilt) else { continue };
                        let distance_m = pose.transform(self.centre).length();
                        all.push(Candidate { camera_from_board: pose, column, row, distance_m, tilt });
                    }
                }
            }
        }
        all
    }

    /// The pose at a place of the image at which the board has this share of its diagonal, moved inside the image as far as it fits.
    fn placed(&self, lens: &Camera, size: ImageSize, at: DVec2, share: f64, tilt: Tilt) -> Option<Rigid> {
        let extent = DVec2::new(f64::from(size.width), f64::from(size.height));
        let middle = lens.unproject(0.5 * extent)?.normalize();
        let focal = lens.project(middle)?.distance(lens.project(middle + DVec3::X * 1e-3)?) * 1e3;
        let distance = focal * self.diagonal / (share * extent.length());
        let rotation = tilt.rotation() * self.upright;
        let mut at = at;
        let mut pose = None;
        for _ in 0..4 {
            let ray = lens.unproject(at)?.normalize();
            // The same distance along the axis everywhere, as a hand would hold it.
            let centre = ray * (distance / ray.z.max(0.3));
            let placed = Rigid { rotation, translation: centre - rotation * self.centre };
            let pixels: Option<Vec<DVec2>> =
                self.corners.iter().map(|c| lens.project(placed.transform(*c))).collect();
            pose = Some(placed);
            let Some(pixels) = pixels else { break };
            let low = pixels.iter().copied().fold(DVec2::INFINITY, DVec2::min);
            let high = pixels.iter().copied().fold(DVec2::NEG_INFINITY, DVec2::max);
            let step =
                inside(low.x, high.x, extent.x) * DVec2::X + inside(low.y, high.y, extent.y) * DVec2::Y;
            if step.length() < 0.5 {
                break;
            }
            at += step;
        }
        pose
    }

    /// The corners that a camera would see of the board; `None` if it would not find it.
    pub(super) fn seen_by(
        &self,
        lens: &Camera,
        size: ImageSize,
        camera_from_board: &Rigid,
    ) -> Option<Vec<Corner>> {
        let normal = DMat3::from_quat(camera_from_board.rotation * self.upright).z_axis;
        let mut seen = Vec::with_capacity(self.corners.len());
        for point in &self.corners {
            let at = camera_from_board.transform(*point);
            if at.z <= 0.0 || normal.dot(at.normalize()) < STEEPEST {
                continue;
            }
            let Some(pixel) = lens.project(at) else { continue };
            let far = DVec2::new(f64::from(size.width), f64::from(size.height)) - 1.0 - MARGIN_PX;
            if pixel.cmpge(DVec2::splat(MARGIN_PX)).all() && pixel.cmple(far).all() {
                seen.push(Corner { point: *point, pixel });
            }
        }
        if seen.len() < self.least {
            return None;
        }
        let centre = camera_from_board.transform(self.centre);
        let beside = lens.project(centre + DVec3::X * self.spacing)?;
        let spacing = lens.project(centre)?.distance(beside) * normal.dot(centre.normalize());
        (spacing >= MIN_SPACING_PX).then_some(seen)
    }

    /// The outline of the board in an image, as shares of its width and height.
    pub(super) fn outline(
        &self,
        lens: &Camera,
        size: ImageSize,
        camera_from_board: &Rigid,
    ) -> Option<Outline> {
        let low = self.corners.iter().copied().fold(DVec3::INFINITY, DVec3::min);
        let high = self.corners.iter().copied().fold(DVec3::NEG_INFINITY, DVec3::max);
        let mut outline = Outline::default();
        let ring = [low, DVec3::new(high.x, low.y, 0.0), high, DVec3::new(low.x, high.y, 0.0)];
        for (at, point) in outline.iter_mut().zip(ring) {
            let pixel = lens.project(camera_from_board.transform(point))?;
            *at = [pixel.x / f64::from(size.width), pixel.y / f64::from(size.height)];
        }
        Some(outline)
    }
}

/// How far an interval has to move to lie in an image of this extent; to its middle if it is longer.
fn inside(low: f64, high: f64, extent: f64) -> f64 {
    let room = extent - 1.0 - 2.0 * MARGIN_PX - 1.0;
    if high - low > room {
        return 0.5 * (extent - 1.0) - 0.5 * (low + high);
    }
    let least = MARGIN_PX + 0.5;
    let most = extent - 1.0 - MARGIN_PX - 0.5;
    if low < least {
        least - low
    } else if high > most {
        most - high
    } else {
        0.0
    }
}

/// The corners that each of these cameras would see of the board, as sightings of view 0.
pub(super) fn sightings(
    points: &Points,
    cameras: &[AdjustedCamera],
    lenses: &[Camera],
    sizes: &[ImageSize],
    rig_from_board: &Rigid,
) -> Vec<Sighting> {
    let mut all = Vec::new();
    for (camera, of) in cameras.iter().enumerate() {
        let pose = of.camera_from_rig.after(rig_from_board);
        if let Some(corners) = points.seen_by(&lenses[camera], sizes[camera], &pose) {
            all.push(Sighting { camera, view: 0, corners });
        }
    }
    all
}
