//! The search for the camera's pose, from coarse to fine.

use super::equations::{Equations, Scale, Scales, sigma};
use super::mesh::Mesh;
use super::raster::{Grid, Render};
use super::samples::{Comparison, Kind, Sample, Scene, Target, samples};
use super::{AlignView, AlignedView, Alignment};
use crate::Rigid;
use crate::rigid::by_motion;
use depthrig_calib::{Camera, Error, ErrorKind, Result};
use glam::{DVec2, DVec3};
use nalgebra::{Matrix6, Vector6};

/// A round of the search.
struct Stage {
    /// Camera pixels a pixel of the drawing.
    scale: u32,
    /// Steps at the most.
    steps: usize,
    /// Residual at which the weight is a quarter, camera pixels; the last stage adapts it to the masks.
    cutoff_px: f64,
    /// The same of depth, metres.
    cutoff_m: f64,
    by_direction: bool,
    outset: bool,
}

const STAGES: [Stage; 5] = [
    Stage { scale: 8, steps: 12, cutoff_px: 80.0, cutoff_m: 0.2, by_direction: false, outset: false },
    Stage { scale: 8, steps: 8, cutoff_px: 30.0, cutoff_m: 0.1, by_direction: true, outset: false },
    Stage { scale: 4, steps: 8, cutoff_px: 12.0, cutoff_m: 0.05, by_direction: true, outset: false },
    Stage { scale: 2, steps: 8, cutoff_px: 6.0, cutoff_m: 0.02, by_direction: true, outset: true },
    Stage { scale: 1, steps: 4, cutoff_px: 4.0, cutoff_m: 0.01, by_direction: true, outset: true },
];
/// Steps that move the drawing's middle onto the mask's.
const MIDDLE_STEPS: usize = 5;
const MIDDLE_SCALE: u32 = 8;
/// Residuals beyond this many cutoffs have no weight worth their time.
const LIMIT_CUTOFFS: f64 = 3.0;
/// A step is no longer than this.
const MAX_TURN: f64 = 0.2;
const MAX_MOVE_M: f64 = 0.2;
/// A shorter step ends a stage, in parts of a drawing's pixel at the arm's distance.
const DONE_PIXELS: f64 = 0.02;
/// The last stage's cutoff in standard deviations, and its range in pixels.
const CUTOFF_SIGMAS: f64 = 3.0;
const MIN_CUTOFF_PX: f64 = 1.5;
const MAX_CUTOFF_PX: f64 = 12.0;
const MIN_CUTOFF_M: f64 = 0.003;
/// Residuals' standard deviations are at least those of the pixel grid and of a depth unit.
const MIN_SIGMA_PX: f64 = 0.2;
const MIN_SIGMA_M: f64 = 3e-4;
/// Side of the cubes of coarse meshes, in the drawing's pixels.
const CELL_PIXELS: f64 = 0.5;

pub(super) struct Problem<'a> {
    camera: &'a Camera,
    width: u32,
    height: u32,
    meshes: &'a [Mesh],
    views: &'a [AlignView],
    targets: Vec<Target<'a>>,
}

impl<'a> Problem<'a> {
    pub(super) fn new(
        camera: &'a Camera,
        width: u32,
        height: u32,
        meshes: &'a [Mesh],
        views: &'a [AlignView],
    ) -> Self {
        let targets = views.iter().map(|v| Target::new(&v.mask, v.depth.as_ref())).collect();
        Self { camera, width, height, meshes, views, targets }
    }

    /// Searches from a start.
    pub(super) fn solve(&self, start: &Rigid) -> Result<Alignment> {
        let mut pose = *start;
        let mut outset = 0.0;
        let distance = self.distance(&pose)?;
        let pixel_m = distance / self.camera.intrinsics().fx;
        let coarse = self.coarser(pixel_m * f64::from(MIDDLE_SCALE));
        self.move_middles(&coarse, &mut pose)?;
        let mut meshes = coarse;
        let mut last_scale = MIDDLE_SCALE;
        for stage in &STAGES {
            if stage.scale != last_scale {
                meshes = if stage.scale == 1 {
                    self.meshes.to_vec()
                } else {
                    self.coarser(pixel_m * f64::from(stage.scale))
                };
                last_scale = stage.scale;
            }
            self.run(stage, &meshes, pixel_m, &mut pose, &mut outset)?;
        }
        self.finish(pose, outset)
    }

    fn coarser(&self, pixel_m: f64) -> Vec<Mesh> {
        self.meshes.iter().map(|m| m.coarser(pixel_m * CELL_PIXELS)).collect()
    }

    /// Mean distance of the arm from the camera along its axis, metres.
    fn distance(&self, camera_from_base: &Rigid) -> Result<f64> {
        let mut sum = 0.0;
        let mut count = 0.0;
        for view in self.views {
            for (mesh, pose) in self.meshes.iter().zip(&view.base_from_links) {
                let to_camera = camera_from_base.after(pose);
                for vertex in mesh.vertices().iter().step_by(16) {
                    sum += to_camera.transform(*vertex).z;
                    count += 1.0;
                }
            }
        }
        let distance = sum / count;
        if distance > 0.05 {
            return Ok(distance);
        }
        Err(Error::new(
            ErrorKind::BadInput,
            "from the start the arm is behind the camera; a camera's axes are x right, y down, z forward, and its pose is that in the \
             robot's base",
        ))
    }

    fn render(&self, meshes: &[Mesh], scale: u32, pose: &Rigid, view: usize) -> Render {
        let grid = Grid::new(self.width, self.height, scale);
        Render::new(self.camera, grid, meshes, pose, &self.views[view].base_from_links)
    }

    /// Moves the pose so that the middles of drawings and masks agree, with the least motion that does.
    fn move_middles(&self, meshes: &[Mesh], pose: &mut Rigid) -> Result<()> {
        // Of the start: 10 degrees, and 5 cm.
        let prior = Vector6::new(0.17, 0.17, 0.17, 0.05, 0.05, 0.05).map(|s| 1.0 / (s * s));
        // Middles of masks that are cut off by the image's border or by an obstacle are not exact.
        let weight = 1.0 / (10.0 * 10.0);
        let start = *pose;
        let mut seen = false;
        for _ in 0..MIDDLE_STEPS {
            let mut matrix = Matrix6::from_diagonal(&prior);
            let from_start = pose.after(&start.inverse());
            let turn = from_start.rotation_vector();
            let moved = from_start.translation;
            let away = Vector6::new(turn.x, turn.y, turn.z, moved.x, moved.y, moved.z);
            let mut right = -prior.component_mul(&away);
            for (view, target) in self.targets.iter().enumerate() {
                let render = self.render(meshes, MIDDLE_SCALE, pose, view);
                let Some(middle) = self.middle(&render) else { continue };
                seen = true;
                let residual = middle.at - target.middle;
                for axis in 0..2 {
                    matrix += middle.change[axis] * middle.change[axis].transpose() * weight;
                    right -= middle.change[axis] * residual[axis] * weight;
                }
            }
            let Some(cholesky) = matrix.cholesky() else { break };
            apply(pose, cholesky.solve(&right).as_slice());
        }
        if seen {
            return Ok(());
        }
        Err(Error::new(
            ErrorKind::BadInput,
            "from the start the camera sees nothing of the arm; give a start within 10 cm and 15 degrees of the camera's pose in the robot's \
             base, with the camera's optical axes: x right, y down, z forward",
        ))
    }

    fn middle(&self, render: &Render) -> Option<Middle> {
        let mut middle = Middle { at: DVec2::ZERO, change: [Vector6::zeros(); 2] };
        let mut count = 0.0;
        for y in 0..render.grid.height {
            for x in 0..render.grid.width {
                let Some(depth) = render.depth(x, y) else { continue };
                let pixel = render.grid.to_camera(DVec2::new(x as f64, y as f64));
                let Some(ray) = self.camera.unproject(pixel) else { continue };
                let point = ray * depth;
                let Some(projection) = self.camera.project_with_jacobian(point) else { continue };
                middle.at += pixel;
                for axis in 0..2 {
                    middle.change[axis] += by_motion(point, projection.d_point[axis]);
                }
                count += 1.0;
            }
        }
        (count > 0.0)
            .then(|| Middle { at: middle.at / count, change: middle.change.map(|change| change / count) })
    }

    fn compare(
        &self,
        meshes: &[Mesh],
        scale: u32,
        pose: &Rigid,
        outset: f64,
        comparison: &Comparison,
    ) -> Compared {
        let mut all = Vec::new();
        let mut overlaps = Vec::new();
        for (view, target) in self.targets.iter().enumerate() {
            let render = self.render(meshes, scale, pose, view);
            if scale == 1 {
                overlaps.push(overlap(&render.mask(), target));
            }
            let scene = Scene {
                camera: self.camera,
                meshes,
                camera_from_base: *pose,
                base_from_links: &self.views[view].base_from_links,
                view,
            };
            samples(&scene, &render, target, comparison, &mut all);
        }
        for sample in &mut all {
            sample.residual += sample.jacobian[6] * outset;
        }
        Compared { samples: all, overlaps }
    }

    fn run(
        &self,
        stage: &Stage,
        meshes: &[Mesh],
        pixel_m: f64,
        pose: &mut Rigid,
        outset: &mut f64,
    ) -> Result<()> {
        for _ in 0..stage.steps {
            let comparison = stage.comparison();
            let all = self.compare(meshes, stage.scale, pose, *outset, &comparison).samples;
            let scales = stage.scales(&all);
            let Some(step) = Equations::new(&all, &scales).step(1e-4, stage.outset) else {
                return Err(Error::new(
                    ErrorKind::BadInput,
                    "the outlines of masks and arm do not meet anywhere; check that masks and joint positions belong together, and the start",
                ));
            };
            apply(pose, step.as_slice());
            *outset += step[6];
            let turn = DVec3::new(step[0], step[1], step[2]).length();
            let moved = DVec3::new(step[3], step[4], step[5]).length();
            let pixel = pixel_m * f64::from(stage.scale);
            if turn * self.camera.intrinsics().fx / f64::from(stage.scale) + moved / pixel < DONE_PIXELS {
                break;
            }
        }
        Ok(())
    }

    /// The covariance and the fit of each view, at the pose found.
    fn finish(&self, pose: Rigid, outset: f64) -> Result<Alignment> {
        let stage = &STAGES[STAGES.len() - 1];
        let Compared { samples: all, overlaps } =
            self.compare(self.meshes, stage.scale, &pose, outset, &stage.comparison());
        let scales = stage.scales(&all);
        let covariance = Equations::new(&all, &scales).covariance(&all, &scales).ok_or_else(|| {
            Error::new(
                ErrorKind::BadInput,
                "the views do not determine the camera's pose; add views with the arm in other positions",
            )
        })?;
        let views = (0..self.views.len())
            .map(|view| {
                let of_view: Vec<Sample> = all.iter().filter(|s| s.view == view).copied().collect();
                AlignedView {
                    overlap: overlaps[view],
                    median_px: sigma(&of_view, Kind::Outline).map_or(f64::INFINITY, |s| s / 1.4826),
                }
            })
            .collect();
        Ok(Alignment {
            base_from_camera: pose.inverse(),
            covariance: covariance.fixed_view::<6, 6>(0, 0).into_owned(),
            outset_px: outset,
            outline_px: sigma(&all, Kind::Outline).unwrap_or(f64::INFINITY),
            depth_m: sigma(&all, Kind::Depth),
            views,
        })
    }
}

/// Residuals at a pose, and at full size the overlap of each view.
struct Compared {
    samples: Vec<Sample>,
    overlaps: Vec<f64>,
}

/// Pixels in both the drawing and the mask over pixels in either.
fn overlap(drawn: &[bool], target: &Target) -> f64 {
    let both = drawn.iter().zip(&target.mask.inside).filter(|(a, b)| **a && **b).count();
    let either = drawn.iter().filter(|d| **d).count() + target.area - both;
    both as f64 / either.max(1) as f64
}

impl Stage {
    fn comparison(&self) -> Comparison {
        Comparison {
            limit_px: LIMIT_CUTOFFS * self.cutoff_px.max(MAX_CUTOFF_PX),
            by_direction: self.by_direction,
            depth_limit_m: Some(LIMIT_CUTOFFS * self.cutoff_m),
        }
    }

    fn scales(&self, all: &[Sample]) -> Scales {
        let outline = sigma(all, Kind::Outline).unwrap_or(1.0).max(MIN_SIGMA_PX);
        let depth = sigma(all, Kind::Depth).unwrap_or(1.0).max(MIN_SIGMA_M);
        let last = self.scale == 1;
        Scales {
            outline: Scale {
                sigma: outline,
                cutoff: if last {
                    (CUTOFF_SIGMAS * outline).clamp(MIN_CUTOFF_PX, MAX_CUTOFF_PX)
                } else {
                    self.cutoff_px
                },
            },
            depth: Scale {
                sigma: depth,
                cutoff: if last {
                    (CUTOFF_SIGMAS * depth).clamp(MIN_CUTOFF_M, LIMIT_CUTOFFS * self.cutoff_m)
                } else {
                    self.cutoff_m
                },
            },
        }
    }
}

/// The middle of a drawing, and how it changes along x and y as the arm moves.
struct Middle {
    at: DVec2,
    change: [Vector6<f64>; 2],
}

/// Moves a pose by a step, shortened if it is too long to trust.
fn apply(pose: &mut Rigid, step: &[f64]) {
    let turn = DVec3::new(step[0], step[1], step[2]);
    let moved = DVec3::new(step[3], step[4], step[5]);
    let shorter = (MAX_TURN / turn.length()).min(MAX_MOVE_M / moved.length()).min(1.0);
    *pose = pose.moved(turn * shorter, moved * shorter);
}
