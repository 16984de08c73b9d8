//! Where a camera sits on a robot's hand, or beside the robot, from views of a board at known poses of the robot.
//!
//! Closed form of Park and Martin (Robot Sensor Calibration: Solving AX = XB on the Euclidean Group, 1994), then one
//! least-squares problem of corners and robot poses together: each robot pose may move within the robot's own noise. Without that the
//! corners, which are far more exact than a robot, force its errors into the result.

use crate::Rigid;
use crate::adjustment::Corner;
use crate::board_pose::{board_pose, nearest_rotation};
use crate::rigid::by_motion;
use depthrig_bus::Intrinsics;
use depthrig_calib::{Camera, Error, ErrorKind, Result};
use glam::{DMat3, DVec3};
use nalgebra::{DMatrix, DVector, Matrix3, Matrix6, Vector3, Vector6};

mod agreement;

/// Where the camera is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Arrangement {
    /// On the hand; the board is fixed beside the robot.
    EyeInHand,
    /// Fixed beside the robot; the board is on the hand.
    EyeToHand,
}

/// A view of the board at a pose of the robot.
#[derive(Debug, Clone, PartialEq)]
pub struct HandEyeView {
    /// Name of the view, for messages.
    pub name: String,
    /// The hand's pose in the robot's base.
    pub base_from_hand: Rigid,
    /// Corners that the camera sees.
    pub corners: Vec<Corner>,
}

/// Standard deviations that the adjustment weighs against each other.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Noise {
    /// Of a corner's coordinate, pixels.
    pub corner_px: f64,
    /// Of a coordinate of the robot's position.
    pub robot_m: f64,
    /// Of the robot's orientation about each axis, radians.
    pub robot_rad: f64,
}

/// The result of [`hand_eye`].
#[derive(Debug, Clone, PartialEq)]
pub struct HandEye {
    /// [`Arrangement::EyeInHand`]: the camera in the hand. [`Arrangement::EyeToHand`]: the camera in the robot's base.
    pub camera: Rigid,
    /// [`Arrangement::EyeInHand`]: the board in the robot's base. [`Arrangement::EyeToHand`]: the board in the hand.
    pub board: Rigid,
    /// Covariance of [`HandEye::camera`] as [`Rigid::moved`] moves it: rotation (radians), then translation (metres).
    pub covariance: Matrix6<f64>,
    /// Root mean square of the corners' residuals' lengths, pixels.
    pub rms_px: f64,
    /// Of each view: how far the robot's pose was moved, within its noise.
    pub corrections: Vec<crate::Distance>,
    /// Of each view: how far the board is from where all other views put it, with the robot's pose as given. It is what a user
    /// has to expect of one grasp.
    pub held_out: Vec<crate::Distance>,
}

/// Rotations between views below which a motion says nothing, radians.
const MIN_ROTATION: f64 = 0.05;
/// The second largest spread of rotation axes relative to the largest, below which all rotations are about one axis.
const MIN_AXIS_SPREAD: f64 = 0.02;

/// Estimates where the camera is.
///
/// # Errors
/// [`ErrorKind::BadInput`] for fewer than three views, for motions without rotation, for rotations about one axis only, and for views
/// whose corners do not give the board's pose; the message says which motion is missing. Also for four views or more whose poses
/// contradict each other, as those of other views or of the other arrangement do.
pub fn hand_eye(
    arrangement: Arrangement,
    intrinsics: &Intrinsics,
    views: &[HandEyeView],
    noise: &Noise,
) -> Result<HandEye> {
    let sights = sights(arrangement, intrinsics, views)?;
    check_motions(&sights)?;
    let held_out = agreement::held_out(&sights)?;
    agreement::check(&held_out, &sights, noise)?;
    let mut state = closed_form(&sights)?;
    let covariance = adjust(arrangement, intrinsics, views, noise, &mut state)?;
    let camera = Camera::new(intrinsics)?;
    let mut squares = 0.0;
    let mut count = 0;
    for (i, view) in views.iter().enumerate() {
        for corner in &view.corners {
            if let Some(pixel) = camera.project(state.to_camera(i).transform(corner.point)) {
                squares += (pixel - corner.pixel).length_squared();
                count += 1;
            }
        }
    }
    Ok(HandEye {
        camera: state.camera,
        board: state.board,
        covariance,
        rms_px: (squares / f64::from(count.max(1))).sqrt(),
        corrections: sights.iter().zip(&state.motions).map(|(s, m)| s.motion.distance(m)).collect(),
        held_out,
    })
}

/// A view, with both arrangements in one form: `board = motion · camera · camera_from_board`, in which `board` and `camera` are
/// constant and `motion` is the hand's pose in the base, or its inverse.
#[derive(Clone, Copy)]
struct Sight {
    motion: Rigid,
    camera_from_board: Rigid,
}

/// The unknowns of the adjustment.
struct State {
    camera: Rigid,
    board: Rigid,
    motions: Vec<Rigid>,
}

impl State {
    /// From the board's coordinates to the camera's, in view `i`.
    fn to_camera(&self, i: usize) -> Rigid {
        self.motions[i].after(&self.camera).inverse().after(&self.board)
    }
}

fn sights(arrangement: Arrangement, intrinsics: &Intrinsics, views: &[HandEyeView]) -> Result<Vec<Sight>> {
    if views.len() < 3 {
        return Err(bad(format!(
            "{} views; hand-eye calibration needs three or more, and gains by twenty",
            views.len()
        )));
    }
    views
        .iter()
        .map(|view| {
            let pose =
                board_pose(intrinsics, &view.corners).map_err(|e| bad(format!("view {}: {e}", view.name)))?;
            let motion = match arrangement {
                Arrangement::EyeInHand => view.base_from_hand,
                Arrangement::EyeToHand => view.base_from_hand.inverse(),
            };
            Ok(Sight { motion, camera_from_board: pose.camera_from_board })
        })
        .collect()
}

/// A motion between two views: of the hand (`A`) and of the camera (`B`), with `A X = X B`.
struct Motion {
    hand: Rigid,
    camera: Rigid,
}

fn motions(sights: &[Sight]) -> Vec<Motion> {
    let mut all = Vec::new();
    for (i, a) in sights.iter().enumerate() {
        for b in &sights[..i] {
            all.push(Motion {
                hand: a.motion.inverse().after(&b.motion),
                camera: a.camera_from_board.after(&b.camera_from_board.inverse()),
            });
        }
    }
    all
}

fn check_motions(sights: &[Sight]) -> Result<()> {
    let mut spread = Matrix3::zeros();
    let mut largest = 0.0_f64;
    for motion in motions(sights) {
        let axis = motion.hand.rotation_vector();
        largest = largest.max(axis.length());
        let v = Vector3::new(axis.x, axis.y, axis.z);
        spread += v * v.transpose();
    }
    if largest < MIN_ROTATION {
        return Err(bad(format!(
            "the hand turned by {:.1} degrees at the most; turn it by 20 degrees or more between views, about two axes",
            largest.to_degrees()
        )));
    }
    let mut values: Vec<f64> = spread.symmetric_eigenvalues().iter().copied().collect();
    values.sort_by(f64::total_cmp);
    if values[1] < MIN_AXIS_SPREAD * MIN_AXIS_SPREAD * values[2] {
        let eigen = spread.symmetric_eigen();
        let axis = eigen.eigenvectors.column(eigen.eigenvalues.imax());
        return Err(bad(format!(
            "the hand turned about one axis only ({:.2}, {:.2}, {:.2} in its own frame), which leaves the camera's place along that \
             axis open; add views with the hand turned by 20 degrees or more about another axis",
            axis[0], axis[1], axis[2]
        )));
    }
    Ok(())
}

/// Park and Martin's closed form, with the constant pose of the board as the mean over views.
fn closed_form(sights: &[Sight]) -> Result<State> {
    let mut correlation = DMat3::ZERO;
    let all = motions(sights);
    for motion in &all {
        let a = motion.hand.rotation_vector();
        let b = motion.camera.rotation_vector();
        // Half a turn has two axes.
        if a.length() < MIN_ROTATION || a.length() > 3.0 {
            continue;
        }
        correlation += DMat3::from_cols(a * b.x, a * b.y, a * b.z);
    }
    let rotation =
        nearest_rotation(correlation).ok_or_else(|| bad("the motions give no rotation".to_owned()))?;
    let mut square = Matrix3::zeros();
    let mut right = Vector3::zeros();
    for motion in &all {
        // (R_A − I) t = R_X t_B − t_A.
        let left = DMat3::from_quat(motion.hand.rotation) - DMat3::IDENTITY;
        let by = rotation * motion.camera.translation - motion.hand.translation;
        let left = Matrix3::from_column_slice(&left.to_cols_array());
        square += left.transpose() * left;
        right += left.transpose() * Vector3::new(by.x, by.y, by.z);
    }
    let t = square
        .cholesky()
        .ok_or_else(|| bad("the motions do not give the camera's place".to_owned()))?
        .solve(&right);
    let camera = Rigid::from_matrix(rotation, DVec3::new(t.x, t.y, t.z));
    let board = mean(sights.iter().map(|s| s.motion.after(&camera).after(&s.camera_from_board)))
        .ok_or_else(|| bad("the views give no pose of the board".to_owned()))?;
    Ok(State { camera, board, motions: sights.iter().map(|s| s.motion).collect() })
}

/// The mean of poses that are near each other.
fn mean(poses: impl Iterator<Item = Rigid>) -> Option<Rigid> {
    let poses: Vec<Rigid> = poses.collect();
    let sum = poses.iter().fold(DMat3::ZERO, |sum, p| sum + DMat3::from_quat(p.rotation));
    let translation = poses.iter().map(|p| p.translation).sum::<DVec3>() / poses.len() as f64;
    Some(Rigid::from_matrix(nearest_rotation(sum)?, translation))
}

/// Unknowns: the camera, the board, then each motion.
const SHARED: usize = 12;
const STEPS: usize = 50;

/// Levenberg-Marquardt over corners and robot poses. Each motion is eliminated like a board's pose elsewhere; with tens of views the dense
/// system is solved directly. Returns the covariance of the camera.
fn adjust(
    arrangement: Arrangement,
    intrinsics: &Intrinsics,
    views: &[HandEyeView],
    noise: &Noise,
    state: &mut State,
) -> Result<Matrix6<f64>> {
    let camera = Camera::new(intrinsics)?;
    let n = SHARED + 6 * views.len();
    let mut damping = 1e-4;
    let mut at = Equations::new(&camera, views, arrangement, noise, state).ok_or_else(|| {
        bad("the closed form does not show the board; check units and order of the robot's poses".to_owned())
    })?;
    for _ in 0..STEPS {
        let mut matrix = at.matrix.clone();
        for i in 0..n {
            matrix[(i, i)] *= 1.0 + damping;
        }
        let next = matrix.cholesky().and_then(|c| {
            let step = c.solve(&at.right);
            let next = state.moved(&step);
            let equations = Equations::new(&camera, views, arrangement, noise, &next)?;
            (equations.cost <= at.cost).then_some((next, equations))
        });
        match next {
            Some((next, equations)) => {
                let done = at.cost - equations.cost <= 1e-12 * at.cost;
                *state = next;
                at = equations;
                damping = (damping * 0.1).max(1e-12);
                if done {
                    break;
                }
            }
            None if damping > 1e9 => break,
            None => damping *= 10.0,
        }
    }
    let inverse = at
        .matrix
        .cholesky()
        .ok_or_else(|| {
            bad("the views do not determine the camera's place; turn the hand about more axes".to_owned())
        })?
        .inverse();
    Ok(inverse.fixed_view::<6, 6>(0, 0).into_owned())
}

impl State {
    fn moved(&self, step: &DVector<f64>) -> Self {
        let by = |pose: &Rigid, at: usize| {
            let v = |k: usize| step[at + k];
            pose.moved(DVec3::new(v(0), v(1), v(2)), DVec3::new(v(3), v(4), v(5)))
        };
        Self {
            camera: by(&self.camera, 0),
            board: by(&self.board, 6),
            motions: self.motions.iter().enumerate().map(|(i, m)| by(m, SHARED + 6 * i)).collect(),
        }
    }
}

/// Normal equations in units of standard deviations.
struct Equations {
    matrix: DMatrix<f64>,
    right: DVector<f64>,
    cost: f64,
}

impl Equations {
    fn new(
        camera: &Camera,
        views: &[HandEyeView],
        arrangement: Arrangement,
        noise: &Noise,
        state: &State,
    ) -> Option<Self> {
        let n = SHARED + 6 * views.len();
        let mut this = Self { matrix: DMatrix::zeros(n, n), right: DVector::zeros(n), cost: 0.0 };
        for (i, view) in views.iter().enumerate() {
            this.add_corners(camera, view, state, i, noise.corner_px)?;
            this.add_prior(arrangement, &view.base_from_hand, &state.motions[i], i, noise);
        }
        this.cost.is_finite().then_some(this)
    }

    fn add_corners(
        &mut self,
        camera: &Camera,
        view: &HandEyeView,
        state: &State,
        index: usize,
        sigma_px: f64,
    ) -> Option<()> {
        let motion = &state.motions[index];
        // p_base = B p; p_hand = M⁻¹ p_base; p_camera = X⁻¹ p_hand.
        let from_motion = motion.inverse();
        let from_camera = state.camera.inverse();
        let hand_from_camera = DMat3::from_quat(state.camera.rotation);
        let base_from_hand = DMat3::from_quat(motion.rotation);
        let places = [0, 6, SHARED + 6 * index];
        for corner in &view.corners {
            let in_base = state.board.transform(corner.point);
            let in_hand = from_motion.transform(in_base);
            let projection = camera.project_with_jacobian(from_camera.transform(in_hand))?;
            let residual = (projection.pixel - corner.pixel) / sigma_px;
            self.cost += residual.length_squared();
            for axis in 0..2 {
                let d_hand = hand_from_camera * projection.d_point[axis] / sigma_px;
                let d_base = base_from_hand * d_hand;
                // A pose that moves its target frame moves the point the other way in the source frame.
                let rows =
                    [-by_motion(in_hand, d_hand), by_motion(in_base, d_base), -by_motion(in_base, d_base)];
                for (a, row) in places.iter().zip(&rows) {
                    for k in 0..6 {
                        self.right[a + k] -= row[k] * residual[axis];
                    }
                    for (b, other) in places.iter().zip(&rows) {
                        let mut block = self.matrix.fixed_view_mut::<6, 6>(*a, *b);
                        block += row * other.transpose();
                    }
                }
            }
        }
        Some(())
    }

    /// The robot's noise: of its position in the base's coordinates, and of its orientation.
    fn add_prior(
        &mut self,
        arrangement: Arrangement,
        given: &Rigid,
        motion: &Rigid,
        index: usize,
        noise: &Noise,
    ) {
        let at = SHARED + 6 * index;
        let now = match arrangement {
            Arrangement::EyeInHand => *motion,
            Arrangement::EyeToHand => motion.inverse(),
        };
        let turned = now.after(&given.inverse()).rotation_vector();
        // The step turns the motion's target frame: of an inverse that is the hand's own, the other way.
        let turned = match arrangement {
            Arrangement::EyeInHand => turned,
            Arrangement::EyeToHand => -(now.rotation.conjugate() * turned),
        };
        let rotation = turned / noise.robot_rad;
        let translation = (now.translation - given.translation) / noise.robot_m;
        self.cost += rotation.length_squared() + translation.length_squared();
        for axis in 0..3 {
            let unit = DVec3::AXES[axis];
            let mut row = Vector6::zeros();
            row[axis] = 1.0 / noise.robot_rad;
            self.add_row(at, &row, rotation[axis]);
            let row = match arrangement {
                Arrangement::EyeInHand => by_motion(now.translation, unit),
                Arrangement::EyeToHand => by_motion(DVec3::ZERO, -(now.rotation.conjugate() * unit)),
            };
            self.add_row(at, &(row / noise.robot_m), translation[axis]);
        }
    }

    fn add_row(&mut self, at: usize, row: &Vector6<f64>, residual: f64) {
        for k in 0..6 {
            self.right[at + k] -= row[k] * residual;
        }
        let mut block = self.matrix.fixed_view_mut::<6, 6>(at, at);
        block += row * row.transpose();
    }
}

fn bad(message: String) -> Error {
    Error::new(ErrorKind::BadInput, message)
}
