//! The normal equations of an adjustment, with the board poses eliminated.

use super::evaluate::{Shape, weight};
use super::{INTRINSIC_PARAMETERS, Layout, Problem};
use crate::rigid::by_motion;
use depthrig_calib::Camera;
use glam::DMat3;
use nalgebra::{Cholesky, DMatrix, DVector, Dyn, Matrix6, Vector6};

/// Unknowns of a camera at the most, those of the board's shape, and those of a view.
const ROW: usize = INTRINSIC_PARAMETERS + 6 + 2;

/// `[A W; Wᵀ V]` and the right-hand side, at one state. `A` is of the unknowns that views share.
#[derive(Debug, Clone)]
pub(crate) struct Normal {
    pub(crate) shared: DMatrix<f64>,
    gradient: DVector<f64>,
    pub(crate) views: Vec<ViewBlock>,
}

/// The blocks of one board pose.
#[derive(Debug, Clone)]
pub(crate) struct ViewBlock {
    /// `V`.
    pub(crate) own: Matrix6<f64>,
    /// `W`: shared unknowns by this view's.
    pub(crate) cross: DMatrix<f64>,
    gradient: Vector6<f64>,
}

/// A step of all unknowns.
pub(super) struct Step {
    pub(super) shared: DVector<f64>,
    pub(super) views: Vec<Vector6<f64>>,
}

/// One row of the Jacobian: the sparse part of the shared unknowns, and the view's.
struct Row {
    shared: [f64; ROW],
    view: [f64; 6],
    residual: f64,
}

impl Normal {
    pub(super) fn new(problem: &Problem, layout: &Layout, huber_px: Option<f64>) -> Self {
        let n = layout.shared;
        let mut normal = Self {
            shared: DMatrix::zeros(n, n),
            gradient: DVector::zeros(n),
            views: problem
                .rig_from_board
                .iter()
                .map(|_| ViewBlock {
                    own: Matrix6::zeros(),
                    cross: DMatrix::zeros(n, 6),
                    gradient: Vector6::zeros(),
                })
                .collect(),
        };
        let shape = Shape::new(problem);
        for sighting in &problem.sightings {
            normal.add(problem, layout, &shape, sighting, huber_px);
        }
        normal
    }

    fn add(
        &mut self,
        problem: &Problem,
        layout: &Layout,
        shape: &Shape,
        sighting: &super::Sighting,
        huber_px: Option<f64>,
    ) {
        let camera = &problem.cameras[sighting.camera];
        let Ok(lens) = Camera::new(&camera.intrinsics) else { return };
        let rig_from_board = &problem.rig_from_board[sighting.view];
        let rig_from_camera = DMat3::from_quat(camera.camera_from_rig.rotation).transpose();
        let board_from_rig = DMat3::from_quat(rig_from_board.rotation).transpose();
        let at = layout.cameras[sighting.camera];
        let free: Vec<usize> = (0..INTRINSIC_PARAMETERS).filter(|i| camera.free_intrinsics[*i]).collect();
        // Of the dense row: this camera's unknowns, then the board's shape.
        let mut places: Vec<usize> = (at.start..at.end).collect();
        if problem.free_warp {
            places.extend([layout.warp, layout.warp + 1]);
        }
        let used = places.len();
        // Summed here without the places, once for all corners: the matrices are touched once for a sighting.
        let mut square = [[0.0; ROW]; ROW];
        let mut cross = [[0.0; 6]; ROW];
        let mut gradient = [0.0; ROW];
        let mut own = [[0.0; 6]; 6];
        let mut own_gradient = [0.0; 6];
        let view = &mut self.views[sighting.view];
        let board = rig_from_board.affine();
        let pose = camera.camera_from_rig.affine();
        for corner in &sighting.corners {
            let in_rig = board.transform_point3(shape.bent(corner.point, problem.warp));
            let in_camera = pose.transform_point3(in_rig);
            let Some(projection) = lens.project_with_jacobian(in_camera) else { continue };
            let residual = projection.pixel - corner.pixel;
            let root = weight(residual, huber_px).sqrt();
            for axis in 0..2 {
                let d_camera = projection.d_point[axis];
                let d_rig = rig_from_camera * d_camera;
                let mut row = Row {
                    shared: [0.0; ROW],
                    view: (by_motion(in_rig, d_rig) * root).into(),
                    residual: residual[axis] * root,
                };
                for (k, parameter) in free.iter().enumerate() {
                    row.shared[k] = projection.d_params[axis][*parameter] * root;
                }
                let mut next = free.len();
                if camera.free_pose {
                    let by = by_motion(in_camera, d_camera);
                    for k in 0..6 {
                        row.shared[next + k] = by[k] * root;
                    }
                    next += 6;
                }
                if problem.free_warp {
                    let by_z = (board_from_rig * d_rig).z * root;
                    let by_warp = shape.by_warp(corner.point);
                    row.shared[next] = by_z * by_warp.x;
                    row.shared[next + 1] = by_z * by_warp.y;
                }
                // Plain arrays, row by row, so that the compiler makes vectors of the inner loops.
                for i in 0..used {
                    let value = row.shared[i];
                    for (sum, by) in square[i].iter_mut().zip(&row.shared[..=i]) {
                        *sum += value * by;
                    }
                    for (sum, by) in cross[i].iter_mut().zip(&row.view) {
                        *sum += value * by;
                    }
                    gradient[i] += value * row.residual;
                }
                for i in 0..6 {
                    for (sum, by) in own[i].iter_mut().zip(&row.view) {
                        *sum += row.view[i] * by;
                    }
                    own_gradient[i] += row.view[i] * row.residual;
                }
            }
        }
        view.own += Matrix6::from_fn(|i, j| own[i][j]);
        view.gradient += Vector6::from(own_gradient);
        for (i, at) in places.iter().enumerate() {
            for (j, other) in places.iter().enumerate() {
                self.shared[(*at, *other)] += if j <= i { square[i][j] } else { square[j][i] };
            }
            for (j, value) in cross[i].iter().enumerate() {
                view.cross[(*at, j)] += value;
            }
            self.gradient[*at] += gradient[i];
        }
    }

    /// `A − Σ W V⁻¹ Wᵀ` and each `V⁻¹ Wᵀ`, with every diagonal element scaled by `1 + damping`.
    pub(super) fn reduced(&self, damping: f64) -> Option<Reduced> {
        let mut matrix = self.shared.clone();
        for i in 0..matrix.nrows() {
            matrix[(i, i)] *= 1.0 + damping;
        }
        let mut views = Vec::with_capacity(self.views.len());
        for view in &self.views {
            let mut own = view.own;
            for i in 0..6 {
                own[(i, i)] *= 1.0 + damping;
            }
            let inverse = own.cholesky()?.inverse();
            let back = inverse * view.cross.transpose();
            matrix -= &view.cross * &back;
            views.push(ReducedView { inverse, back });
        }
        Some(Reduced { matrix, views })
    }

    /// The step that the damped equations ask for; `None` if they are singular.
    pub(super) fn step(&self, damping: f64) -> Option<Step> {
        let reduced = self.reduced(damping)?;
        let mut right = -&self.gradient;
        for (view, of) in self.views.iter().zip(&reduced.views) {
            right += of.back.transpose() * view.gradient;
        }
        let shared = if right.is_empty() { right } else { Cholesky::new(reduced.matrix)?.solve(&right) };
        let views = self
            .views
            .iter()
            .zip(&reduced.views)
            .map(|(view, of)| {
                let back = &of.back * &shared;
                -(of.inverse * view.gradient) - Vector6::from_iterator(back.iter().copied())
            })
            .collect();
        Some(Step { shared, views })
    }

    /// Half the slope of the cost along a step.
    #[cfg(test)]
    pub(super) fn slope(&self, along: &Step) -> f64 {
        let of_views = self.views.iter().zip(&along.views).map(|(v, by)| v.gradient.dot(by));
        self.gradient.dot(&along.shared) + of_views.sum::<f64>()
    }

    /// The shared unknown that the observations determine least, if it is not one of a view.
    pub(super) fn weakest(&self) -> Option<usize> {
        let reduced = self.reduced(1e-9)?.matrix;
        let n = reduced.nrows();
        // Scaled to a unit diagonal of the whole, so that units do not matter.
        (0..n).min_by(|a, b| {
            let share = |i: usize| reduced[(i, i)] / self.shared[(i, i)].max(f64::MIN_POSITIVE);
            share(*a).total_cmp(&share(*b))
        })
    }
}

/// The equations without the board poses.
pub(super) struct Reduced {
    pub(super) matrix: DMatrix<f64>,
    pub(super) views: Vec<ReducedView>,
}

/// The part that gives a board's pose back.
pub(super) struct ReducedView {
    /// `V⁻¹`.
    pub(super) inverse: Matrix6<f64>,
    /// `V⁻¹ Wᵀ`.
    pub(super) back: nalgebra::OMatrix<f64, nalgebra::Const<6>, Dyn>,
}
