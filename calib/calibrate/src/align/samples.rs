//! Residuals between the rendered arm and what a view shows, with how they change as the camera moves.

use super::distance::{Edge, SignedDistance, outline};
use super::mesh::Mesh;
use super::raster::{Render, normal};
use super::{DepthImage, Mask};
use crate::Rigid;
use crate::rigid::by_motion;
use depthrig_calib::Camera;
use glam::{DVec2, DVec3};
use nalgebra::SVector;

/// Unknowns: motion of the base in the camera's frame as [`Rigid::moved`] has it, then the outset of the masks in pixels.
pub(super) const UNKNOWNS: usize = 7;
/// Side of the squares in the image within which residuals count as correlated, pixels.
const CELL_PX: f64 = 24.0;
/// Normals of a ragged outline are averaged over this distance to each side, pixels.
const MASK_REACH_PX: f64 = 3.0;
/// Outlines that run in directions further apart than this (cosine) are not one.
const SAME_DIRECTION: f64 = 0.3;
/// Spacing of depth residuals, pixels.
const DEPTH_STEP_PX: f64 = 8.0;
/// Surfaces seen at a flatter angle than this (cosine) give no depth residual.
const MIN_SLANT: f64 = 0.25;

/// Unit of a residual.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    /// Pixels between outlines.
    Outline,
    /// Metres along a surface's normal.
    Depth,
}

/// A residual.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sample {
    pub kind: Kind,
    pub view: usize,
    /// Square of the image that it lies in; one square is the same in all views, because the base's outline is.
    pub cell: u32,
    pub residual: f64,
    pub jacobian: SVector<f64, UNKNOWNS>,
}

/// A view, ready for comparison.
pub(super) struct Target<'a> {
    pub mask: &'a Mask,
    pub depth: Option<&'a DepthImage>,
    pub distance: SignedDistance,
    pub outline: Vec<Edge>,
    pub area: usize,
    /// Mean of the pixels of the mask.
    pub middle: DVec2,
}

impl<'a> Target<'a> {
    pub(super) fn new(mask: &'a Mask, depth: Option<&'a DepthImage>) -> Self {
        let width = mask.width as usize;
        let height = mask.height as usize;
        let mut area = 0;
        let mut sum = DVec2::ZERO;
        for (i, _) in mask.inside.iter().enumerate().filter(|(_, inside)| **inside) {
            area += 1;
            sum += DVec2::new((i % width) as f64, (i / width) as f64);
        }
        Self {
            mask,
            depth,
            distance: SignedDistance::new(&mask.inside, width, height),
            outline: outline(&mask.inside, width, height),
            area,
            middle: sum / (area.max(1)) as f64,
        }
    }
}

/// Camera, arm and pose of a view.
pub(super) struct Scene<'a> {
    pub camera: &'a Camera,
    pub meshes: &'a [Mesh],
    pub camera_from_base: Rigid,
    pub base_from_links: &'a [Rigid],
    pub view: usize,
}

/// How outlines are compared.
#[derive(Debug, Clone, Copy)]
pub(super) struct Comparison {
    /// Longer residuals are left out, camera pixels.
    pub limit_px: f64,
    /// Only outlines that run in about the same direction are compared.
    pub by_direction: bool,
    /// With depth, up to this distance, metres.
    pub depth_limit_m: Option<f64>,
}

/// Residuals of a view.
pub(super) fn samples(
    scene: &Scene,
    render: &Render,
    target: &Target,
    comparison: &Comparison,
    into: &mut Vec<Sample>,
) {
    let rendered = Rendered::new(render, comparison.limit_px / render.grid.scale);
    for edge in &rendered.edges {
        into.extend(rendered.on_mask(scene, render, target, comparison, edge));
    }
    // As many points of the mask's outline as the render has.
    let step = (render.grid.scale as usize).max(1);
    for edge in target.outline.iter().step_by(step) {
        into.extend(rendered.at_mask(scene, render, target, comparison, edge));
    }
    if let (Some(depth), Some(limit)) = (target.depth, comparison.depth_limit_m) {
        depth_samples(scene, render, target, depth, limit, into);
    }
}

/// The outline of a render.
struct Rendered {
    edges: Vec<Edge>,
    /// Around the arm only.
    distance: SignedDistance,
    from: DVec2,
    to: DVec2,
}

impl Rendered {
    fn new(render: &Render, margin: f64) -> Self {
        let mask = render.mask();
        let grid = render.grid;
        let edges = outline(&mask, grid.width, grid.height);
        let mut low = DVec2::new(grid.width as f64, grid.height as f64);
        let mut high = DVec2::ZERO;
        for edge in &edges {
            low = low.min(edge.at);
            high = high.max(edge.at);
        }
        let margin = DVec2::splat(margin.ceil() + 4.0);
        let from = (low - margin).floor().max(DVec2::ZERO);
        let to = (high + margin)
            .ceil()
            .min(DVec2::new(grid.width as f64 - 1.0, grid.height as f64 - 1.0))
            .max(from);
        let width = (to.x - from.x) as usize + 1;
        let height = (to.y - from.y) as usize + 1;
        let mut part = Vec::with_capacity(width * height);
        for y in from.y as usize..from.y as usize + height {
            let start = y * grid.width + from.x as usize;
            part.extend_from_slice(&mask[start..start + width]);
        }
        Self { edges, distance: SignedDistance::new(&part, width, height), from, to }
    }

    /// Normal of the render's outline.
    fn normal(&self, at: DVec2) -> Option<DVec2> {
        self.distance.normal(at - self.from, 2.0)
    }

    /// A point of the render's outline against the mask.
    fn on_mask(
        &self,
        scene: &Scene,
        render: &Render,
        target: &Target,
        comparison: &Comparison,
        edge: &Edge,
    ) -> Option<Sample> {
        let pixel = render.grid.to_camera(edge.at);
        let residual = target.distance.at(pixel);
        if residual.abs() > comparison.limit_px {
            return None;
        }
        let own = self.normal(edge.at)?;
        let of_mask = target.distance.normal(pixel, MASK_REACH_PX);
        let direction = if comparison.by_direction {
            // The mask's own normals are ragged; the render's are smooth.
            (of_mask?.dot(own) > SAME_DIRECTION).then_some(own)?
        } else {
            of_mask?
        };
        let depth = render.depth(edge.x, edge.y)?;
        let change = change(scene.camera, pixel, depth, direction)?;
        Some(sample(scene.view, pixel, residual, change.push(1.0)))
    }

    /// A point of the mask's outline against the render.
    fn at_mask(
        &self,
        scene: &Scene,
        render: &Render,
        target: &Target,
        comparison: &Comparison,
        edge: &Edge,
    ) -> Option<Sample> {
        let at = render.grid.in_grid(edge.at);
        if at.cmplt(self.from).any() || at.cmpgt(self.to).any() {
            return None;
        }
        let distance = self.distance.at(at - self.from);
        let residual = distance * render.grid.scale;
        if residual.abs() > comparison.limit_px {
            return None;
        }
        let direction = self.normal(at)?;
        if comparison.by_direction
            && target.distance.normal(edge.at, MASK_REACH_PX)?.dot(direction) <= SAME_DIRECTION
        {
            return None;
        }
        let on_outline = at - direction * distance;
        let depth = depth_near(render, on_outline - direction * 0.7)?;
        let pixel = render.grid.to_camera(on_outline);
        let change = change(scene.camera, pixel, depth, direction)?;
        Some(sample(scene.view, edge.at, residual, (-change).push(-1.0)))
    }
}

/// Depth of the render at a place, or at one of the pixels around it.
fn depth_near(render: &Render, at: DVec2) -> Option<f64> {
    let x = at.x.round();
    let y = at.y.round();
    let shifts = [(0.0, 0.0), (-1.0, 0.0), (1.0, 0.0), (0.0, -1.0), (0.0, 1.0)];
    shifts.iter().find_map(|(dx, dy)| {
        let x = x + dx;
        let y = y + dy;
        let inside = x >= 0.0 && y >= 0.0 && x < render.grid.width as f64 && y < render.grid.height as f64;
        inside.then(|| render.depth(x as usize, y as usize)).flatten()
    })
}

/// Change along `direction` of the pixel that shows a surface point, as the arm moves.
fn change(camera: &Camera, pixel: DVec2, depth: f64, direction: DVec2) -> Option<SVector<f64, 6>> {
    let point = camera.unproject(pixel)? * depth;
    let projection = camera.project_with_jacobian(point)?;
    Some(by_motion(point, projection.d_point[0] * direction.x + projection.d_point[1] * direction.y))
}

fn sample(view: usize, pixel: DVec2, residual: f64, jacobian: SVector<f64, UNKNOWNS>) -> Sample {
    Sample { kind: Kind::Outline, view, cell: cell(pixel), residual, jacobian }
}

fn cell(pixel: DVec2) -> u32 {
    let at = (pixel / CELL_PX).floor().max(DVec2::ZERO);
    at.y as u32 * 4096 + at.x as u32
}

/// Measured points against the plane of the rendered triangle at their pixels.
fn depth_samples(
    scene: &Scene,
    render: &Render,
    target: &Target,
    depth: &DepthImage,
    limit_m: f64,
    into: &mut Vec<Sample>,
) {
    let grid = render.grid;
    let step = (DEPTH_STEP_PX / grid.scale).max(1.0) as usize;
    for y in (step / 2..grid.height).step_by(step) {
        for x in (step / 2..grid.width).step_by(step) {
            let Some(rendered) = render.depth(x, y) else { continue };
            let Some(drawn) = render.triangle(x, y) else { continue };
            let pixel = grid.to_camera(DVec2::new(x as f64, y as f64));
            let column = (pixel.x.round() as usize).min(target.mask.width as usize - 1);
            let row = (pixel.y.round() as usize).min(target.mask.height as usize - 1);
            let index = row * target.mask.width as usize + column;
            let measured = f64::from(depth.metres[index]);
            if !target.mask.inside[index] || measured <= 0.0 {
                continue;
            }
            let nearest = DVec2::new(column as f64, row as f64);
            let Some(at) = scene.camera.unproject(pixel) else { continue };
            let Some(ray) = scene.camera.unproject(nearest) else { continue };
            let pose = scene.camera_from_base.after(&scene.base_from_links[drawn.link]);
            let Some(n) = normal(&scene.meshes[drawn.link], drawn.triangle) else { continue };
            let n: DVec3 = pose.rotation * n;
            if n.dot(ray.normalize()).abs() < MIN_SLANT {
                continue;
            }
            let point = at * rendered;
            let residual = n.dot(point - ray * measured);
            if residual.abs() > limit_m {
                continue;
            }
            into.push(Sample {
                kind: Kind::Depth,
                view: scene.view,
                cell: cell(pixel),
                residual,
                jacobian: by_motion(point, n).push(0.0),
            });
        }
    }
}
