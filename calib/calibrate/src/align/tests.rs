use super::*;
use crate::Rigid;
use glam::{DQuat, DVec2, DVec3};

const WIDTH: u32 = 320;
const HEIGHT: u32 = 240;

/// Numbers in -1..1 that look random.
struct Noise(u64);

impl Noise {
    fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 11) as f64 / (1_u64 << 52) as f64 - 1.0
    }

    fn direction(&mut self) -> DVec3 {
        DVec3::new(self.next(), self.next(), self.next()).normalize()
    }
}

fn intrinsics() -> Intrinsics {
    Intrinsics::pinhole(300.0, 300.0, 159.5, 119.5)
}

/// A box.
#[derive(Clone, Copy)]
struct Cuboid {
    low: DVec3,
    high: DVec3,
}

impl Cuboid {
    fn mesh(&self) -> Mesh {
        let corner = |i: u32| {
            let pick = |bit: u32, low: f64, high: f64| if i >> bit & 1 == 0 { low } else { high };
            DVec3::new(
                pick(0, self.low.x, self.high.x),
                pick(1, self.low.y, self.high.y),
                pick(2, self.low.z, self.high.z),
            )
        };
        let faces = [[0, 1, 3, 2], [4, 5, 7, 6], [0, 1, 5, 4], [2, 3, 7, 6], [0, 2, 6, 4], [1, 3, 7, 5]];
        let triangles = faces.iter().flat_map(|[a, b, c, d]| [[*a, *b, *c], [*a, *c, *d]]).collect();
        Mesh::new((0..8).map(corner).collect(), triangles).unwrap()
    }

    /// Where a ray enters the box, in lengths of `direction`.
    fn hit(&self, from: DVec3, direction: DVec3) -> Option<f64> {
        let a = (self.low - from) / direction;
        let b = (self.high - from) / direction;
        let enter = a.min(b).max_element();
        (enter > 0.0 && enter < a.max(b).min_element()).then_some(enter)
    }
}

/// An arm of three boxes that turn about different axes, on a base.
fn boxes() -> Vec<Cuboid> {
    let of = |low: [f64; 3], high: [f64; 3]| Cuboid { low: low.into(), high: high.into() };
    vec![
        of([-0.1, -0.12, 0.0], [0.1, 0.12, 0.15]),
        of([-0.05, -0.06, 0.0], [0.05, 0.05, 0.35]),
        of([-0.04, -0.03, 0.0], [0.04, 0.05, 0.3]),
        of([-0.02, -0.08, 0.0], [0.04, 0.06, 0.1]),
    ]
}

fn kinematics() -> Kinematics {
    let joint = |name: &str, parent: usize, z: f64, axis: DVec3| Joint {
        name: name.to_owned(),
        parent,
        child: parent + 1,
        origin: Rigid { rotation: DQuat::IDENTITY, translation: DVec3::new(0.0, 0.0, z) },
        axis,
        kind: JointKind::Revolute,
        limits: None,
        mimic: None,
    };
    let axis = DVec3::new(0.0, 0.6, 0.8);
    let joints = vec![
        joint("a", 0, 0.15, axis),
        joint("b", 1, 0.35, DVec3::Y),
        joint("c", 2, 0.3, DVec3::new(0.8, 0.6, 0.0)),
    ];
    Kinematics::new((0..4).map(|i| format!("l{i}")).collect(), joints).unwrap()
}

/// A camera 1.2 m away that looks at the arm.
fn truth() -> Rigid {
    let place = DVec3::new(1.1, 0.3, 0.6);
    let forward = (DVec3::new(0.0, 0.0, 0.35) - place).normalize();
    let right = forward.cross(DVec3::Z).normalize();
    Rigid::from_matrix(glam::DMat3::from_cols(right, forward.cross(right), forward), place)
}

/// A view of the boxes, by rays.
fn view(number: usize, positions: &[f64], with_depth: bool) -> AlignView {
    let poses = kinematics().poses(positions).unwrap();
    let camera = Camera::new(&intrinsics()).unwrap();
    let mut inside = Vec::new();
    let mut metres = Vec::new();
    for y in 0..HEIGHT {
        for x in 0..WIDTH {
            let ray = camera.unproject(DVec2::new(f64::from(x), f64::from(y))).unwrap();
            let nearest = boxes()
                .iter()
                .zip(&poses)
                .filter_map(|(b, pose)| {
                    let from_base = pose.inverse();
                    let from = from_base.transform(truth().translation);
                    b.hit(from, from_base.rotation * (truth().rotation * ray))
                })
                .min_by(f64::total_cmp);
            inside.push(nearest.is_some());
            metres.push(nearest.unwrap_or(0.0) as f32);
        }
    }
    AlignView {
        name: number.to_string(),
        base_from_links: poses,
        mask: Mask { width: WIDTH, height: HEIGHT, inside },
        depth: with_depth.then_some(DepthImage { metres }),
    }
}

fn views(with_depth: bool) -> Vec<AlignView> {
    let mut noise = Noise(7);
    (0..6)
        .map(|i| view(i, &[noise.next() * 1.2, noise.next() * 1.2, noise.next() * 1.5], with_depth))
        .collect()
}

fn meshes() -> Vec<Mesh> {
    boxes().iter().map(Cuboid::mesh).collect()
}

/// A start that is off by 10 cm and 15 degrees.
fn start(noise: &mut Noise) -> Rigid {
    let turn = DQuat::from_scaled_axis(noise.direction() * 15_f64.to_radians());
    Rigid { rotation: turn * truth().rotation, translation: truth().translation + noise.direction() * 0.1 }
}

fn aligned(views: &[AlignView], start: &Rigid) -> Result<Alignment> {
    align(&intrinsics(), WIDTH, HEIGHT, &meshes(), views, start)
}

fn message(views: &[AlignView]) -> String {
    aligned(views, &truth()).unwrap_err().to_string()
}

#[test]
fn a_camera_is_found_from_starts_that_are_far_off() {
    let views = views(false);
    let mut noise = Noise(11);
    for trial in 0..10 {
        let found = aligned(&views, &start(&mut noise)).unwrap();
        let off = found.base_from_camera.distance(&truth());
        println!(
            "{trial}: {:.2} mm {:.3} deg, outset {:.2} px, {:.2} px",
            off.metres * 1e3,
            off.radians.to_degrees(),
            found.outset_px,
            found.outline_px
        );
        assert!(off.metres < 3e-3 && off.radians.to_degrees() < 0.3, "{trial}: {off:?}");
        let sigma = |from: usize| (from..from + 3).map(|i| found.covariance[(i, i)]).sum::<f64>().sqrt();
        println!("sigma {:.2} mm {:.3} deg", sigma(3) * 1e3, sigma(0).to_degrees());
        assert!(off.metres < 3.0 * sigma(3) && off.radians < 3.0 * sigma(0), "{trial}: {off:?}");
        assert!(sigma(3) < 3e-3, "{}", sigma(3));
        assert!(found.views.iter().all(|v| v.overlap > 0.95 && v.median_px < 1.0), "{:?}", found.views);
    }
}

#[test]
fn masks_that_are_too_large_on_all_sides_do_not_move_the_camera() {
    let mut views = views(false);
    for view in &mut views {
        let small = view.mask.inside.clone();
        let width = WIDTH as usize;
        for i in width..small.len() - width {
            view.mask.inside[i] =
                small[i] || small[i - 1] || small[i + 1] || small[i - width] || small[i + width];
        }
    }
    let found = aligned(&views, &start(&mut Noise(3))).unwrap();
    let off = found.base_from_camera.distance(&truth());
    assert!(off.metres < 4e-3 && off.radians.to_degrees() < 0.4, "{off:?}");
    assert!((0.5..1.5).contains(&found.outset_px), "{}", found.outset_px);
}

#[test]
fn depth_makes_the_camera_better_known() {
    let without = aligned(&views(false), &start(&mut Noise(5))).unwrap();
    let with = aligned(&views(true), &start(&mut Noise(5))).unwrap();
    let off = with.base_from_camera.distance(&truth());
    assert!(off.metres < 2e-3 && off.radians.to_degrees() < 0.2, "{off:?}");
    assert!(with.depth_m.unwrap() < 1e-3 && without.depth_m.is_none());
    let place = |a: &Alignment| (3..6).map(|i| a.covariance[(i, i)]).sum::<f64>();
    assert!(place(&with) < place(&without));
}

#[test]
fn views_that_cannot_work_are_refused() {
    let good = views(false);
    assert!(message(&good[..2]).contains("2 views of the arm; alignment needs 3"));
    let still: Vec<AlignView> = (0..4).map(|_| good[0].clone()).collect();
    assert!(message(&still).contains("the arm moves by 0 mm"));
    let with = |change: &dyn Fn(&mut AlignView)| {
        let mut views = good.clone();
        change(&mut views[3]);
        message(&views)
    };
    assert!(with(&|v| v.mask.inside.fill(false)).contains("view 3: the mask has 0 pixels"));
    assert!(with(&|v| v.mask.inside.fill(true)).contains("view 3: every pixel"));
    assert!(with(&|v| v.mask.width = 300).contains("view 3: the mask is 300x240"));
    assert!(with(&|v| v.depth = Some(DepthImage { metres: vec![1.0] })).contains("view 3: depth is not"));
    // Masks of other positions.
    let mut mixed = good.clone();
    for (i, view) in mixed.iter_mut().enumerate() {
        view.mask.clone_from(&good[(i + 3) % 6].mask);
    }
    assert!(message(&mixed).contains("each mask belongs to its joint positions"), "{}", message(&mixed));
    let away = Rigid { rotation: truth().rotation * DQuat::from_rotation_y(3.1), ..truth() };
    let behind = aligned(&good, &away).unwrap_err().to_string();
    assert!(behind.contains("the arm is behind the camera"), "{behind}");
}
