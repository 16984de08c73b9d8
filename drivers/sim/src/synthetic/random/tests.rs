//! Random worlds against an independent model: marching in small steps and bisection, in double precision, with each
//! shape's definition; meshes by trying every triangle.

use super::super::shape::{Shape, Solid};
use super::super::view::{Rays, View};
use super::*;
use depthrig_bus::Intrinsics;
use glam::DVec3;

const STEP_M: f64 = 2.5e-4;

fn stock() -> Stock {
    // A tetrahedron as the user's mesh.
    let corners = [Vec3::X, Vec3::Y, Vec3::Z, Vec3::NEG_ONE / 1.8];
    let mesh = Mesh::new(&corners, &[[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]]);
    Stock { families: Family::ALL.to_vec(), meshes: vec![Arc::new(mesh)] }
}

/// Distance of a point from the border of a solid, by the shape's definition: positive within.
fn inside(solid: &Solid, p: DVec3) -> bool {
    let q = solid.axes.as_dmat3().transpose() * (p - solid.center.as_dvec3());
    let f = f64::from;
    match &solid.shape {
        Shape::Sphere { radius } => q.length() < f(*radius),
        Shape::Block { half } => (q.abs() - half.as_dvec3()).max_element() < 0.0,
        Shape::Capsule { half, radius } => {
            (q - DVec3::Z * q.z.clamp(-f(*half), f(*half))).length() < f(*radius)
        }
        Shape::Cylinder { half, radius } => q.z.abs() < f(*half) && q.x.hypot(q.y) < f(*radius),
        Shape::Superquadric(s) => {
            let n = (q / s.half.as_dvec3()).abs();
            let (above, side) = (f(s.above), f(s.side));
            let ring = n.x.powf(2.0 / above) + n.y.powf(2.0 / above);
            ring.powf(above / side) + n.z.powf(2.0 / side) < 1.0
        }
        Shape::Lathe(s) => {
            let r = q.x.hypot(q.y);
            // The winding of the closed outline around the point, by angles.
            let turn = |(a, b): &((f64, f64), (f64, f64))| {
                let (ax, ay, bx, by) = (a.0 - r, a.1 - q.z, b.0 - r, b.1 - q.z);
                (ax * by - ay * bx).atan2(ax * bx + ay * by)
            };
            let points = s.outline();
            let closed = points.iter().copied().zip(points.iter().copied().cycle().skip(1));
            closed.map(|pair| turn(&pair)).sum::<f64>().abs() > 3.0
        }
        Shape::Mesh(_) => false,
    }
}

fn slow_mesh(solid: &Solid, o: DVec3, d: DVec3) -> Option<f64> {
    let Shape::Mesh(mesh) = &solid.shape else { return None };
    let turn = solid.axes.as_dmat3().transpose();
    let (o, d) = (turn * (o - solid.center.as_dvec3()), turn * d);
    let cross = |t: &[Vec3; 3]| {
        let [a, b, c] = t.map(Vec3::as_dvec3);
        let n = (b - a).cross(c - a);
        let t = (a - o).dot(n) / d.dot(n);
        let p = o + d * t;
        let area = |a: DVec3, b: DVec3| (b - a).cross(p - a).dot(n);
        let is_in = area(a, b) >= 0.0 && area(b, c) >= 0.0 && area(c, a) >= 0.0;
        (is_in && t > 1e-4).then_some(t)
    };
    mesh.triangles().iter().filter_map(cross).reduce(f64::min)
}

/// Depth along a ray, found slowly.
fn slow(world: &World, o: DVec3, d: DVec3) -> f64 {
    let (low, high) = (world.room.0.as_dvec3(), world.room.1.as_dvec3());
    let mut best = ((low - o) / d).max((high - o) / d).min_element();
    let speed = d.length();
    for Thing { solid, .. } in &world.things {
        let to = solid.center.as_dvec3() - o;
        let middle = to.dot(d) / (speed * speed);
        let off = (to - d * middle).length();
        let bound = f64::from(solid.bound) + 1e-6;
        if off > bound {
            continue;
        }
        if let Some(t) = slow_mesh(solid, o, d) {
            best = best.min(t);
        }
        let reach = (bound * bound - off * off).sqrt() / speed;
        let mut t = (middle - reach).max(1e-4);
        let end = (middle + reach).min(best);
        while t < end {
            if inside(solid, o + d * t) {
                let (mut out, mut within) = ((t - STEP_M / speed).max(0.0), t);
                for _ in 0..40 {
                    let half = f64::midpoint(out, within);
                    if inside(solid, o + d * half) { within = half } else { out = half }
                }
                best = best.min(within);
                break;
            }
            t += STEP_M / speed;
        }
    }
    best
}

#[test]
fn true_depth_is_that_of_the_slow_model() {
    let stock = stock();
    let rays = Rays::new(&Intrinsics::pinhole(46.0, 46.0, 39.5, 29.5), 80, 60);
    let mut seen = std::collections::HashMap::<&'static str, usize>::new();
    let mut wrong = Vec::new();
    let mut tried = 0;
    for number in 0..36 {
        let RandomWorld { world, camera_pose, .. } = RandomWorld::new(11, number, &stock);
        let view = View::new(&rays, &camera_pose);
        let mets = view.cast(&world);
        for y in (1..60).step_by(5) {
            for x in (1..80).step_by(5) {
                let met = mets[y * 80 + x];
                let at = |dx: f64, dy: f64| {
                    let ray = DVec3::new((x as f64 + dx - 39.5) / 46.0, (y as f64 + dy - 29.5) / 46.0, 1.0);
                    slow(&world, view.origin.as_dvec3(), view.axes.as_dmat3() * ray)
                };
                tried += 1;
                let kind =
                    world.things.get(usize::from(met.key >> 3)).map_or("room", |t| match t.solid.shape {
                        Shape::Superquadric(_) => "superquadric",
                        Shape::Lathe(_) => "lathe",
                        Shape::Mesh(_) => "mesh",
                        Shape::Capsule { .. } => "capsule",
                        _ => "other",
                    });
                *seen.entry(kind).or_default() += 1;
                let close = |z: f64| (f64::from(met.t) - z).abs() < 2e-5 + 4e-6 * z;
                if close(at(0.0, 0.0)) {
                    continue;
                }
                // A ray that grazes an edge may be judged either way: a fiftieth of a pixel beside it decides.
                let around = [(-0.02, 0.0), (0.02, 0.0), (0.0, -0.02), (0.0, 0.02)];
                let zs = around.map(|(dx, dy)| at(dx, dy));
                let low = zs.into_iter().fold(f64::INFINITY, f64::min) - 1e-4;
                let high = zs.into_iter().fold(0.0, f64::max) + 1e-4;
                let is_edge = high - low > 2e-3 && (low..=high).contains(&f64::from(met.t));
                if !is_edge {
                    wrong.push((number, x, y, kind, met.t, at(0.0, 0.0)));
                }
            }
        }
    }
    assert!(wrong.is_empty(), "{} of {tried}: {:?}", wrong.len(), &wrong[..wrong.len().min(8)]);
    for kind in ["room", "superquadric", "lathe", "mesh", "capsule", "other"] {
        assert!(seen.get(kind).is_some_and(|n| *n > 15), "{kind} was hardly seen: {seen:?}");
    }
}

#[test]
fn rays_of_tiles_meet_what_rays_alone_meet() {
    let stock = stock();
    let rays = Rays::new(&Intrinsics::pinhole(60.0, 60.0, 47.5, 31.5), 96, 64);
    for number in 0..8 {
        let RandomWorld { world, camera_pose, .. } = RandomWorld::new(3, number, &stock);
        let view = View::new(&rays, &camera_pose);
        let mets = view.cast(&world);
        let all = world.all();
        for (i, met) in mets.iter().enumerate() {
            let dir = view.dir(i % 96, i / 96);
            assert_eq!(*met, world.with_face(view.origin, dir, world.meet(&all, view.origin, dir)));
            let spot = world.spot(view.origin, dir, *met);
            assert!((spot.n.length() - 1.0).abs() < 1e-3, "{:?}", spot.n);
        }
    }
}

#[test]
fn a_world_follows_from_its_seed_and_number_and_keeps_to_its_families() {
    let stock = stock();
    let text = |seed, number| format!("{:?}", RandomWorld::new(seed, number, &stock));
    assert_eq!(text(1, 5), text(1, 5));
    assert_ne!(text(1, 5), text(1, 6));
    assert_ne!(text(1, 5), text(2, 5));
    let few = Stock { families: vec![Family::Plate, Family::Cable], meshes: Vec::new() };
    let mut all = Vec::new();
    for number in 0..40 {
        let world = RandomWorld::new(1, number, &few);
        assert!(world.families.iter().all(|f| few.families.contains(f)), "{:?}", world.families);
        all.extend(RandomWorld::new(1, number, &stock).families);
    }
    all.sort_unstable();
    all.dedup();
    assert_eq!(all, Family::ALL, "every family occurs in forty worlds");
}

#[test]
fn cameras_stand_free_and_at_the_distances_of_their_kind() {
    let stock = stock();
    let rays = Rays::new(&Intrinsics::pinhole(40.0, 40.0, 31.5, 23.5), 64, 48);
    let mut tables = 0;
    let mut good = 0;
    for number in 0..120 {
        let RandomWorld { world, camera_pose, kind, .. } = RandomWorld::new(8, number, &stock);
        let view = View::new(&rays, &camera_pose);
        let mut z: Vec<f32> = view.cast(&world).iter().map(|m| m.t).collect();
        z.sort_by(f32::total_cmp);
        let middle = z[z.len() / 2];
        tables += usize::from(kind == SceneKind::Table);
        let range = if kind == SceneKind::Table { 0.15..2.6 } else { 0.6..6.0 };
        good += usize::from(range.contains(&middle) && z[z.len() / 100] > 0.05);
    }
    assert!((60..=96).contains(&tables), "{tables} of 120 are tables");
    assert!(good >= 110, "only {good} of 120 views are good");
}
