//! A drawing of a point cloud, seen from beside the mount: where two cameras put one surface at two places, the drawing shows it twice.

use core::cmp::Ordering;
use depthrig_calib::PointCloud;
use glam::{Mat3, Vec3};
use image::{Rgb, RgbImage};

/// Size of the drawing, pixels.
const WIDTH: u32 = 1280;
const HEIGHT: u32 = 800;
/// Field of view over the height, radians.
const VIEW: f32 = 0.7;
/// How far the viewpoint is turned away from the mount's own view, to the right and up, radians.
const YAW: f32 = 0.45;
const PITCH: f32 = 0.35;
/// Share of the points that the drawing has to show; the rest are far away.
const SHOWN: f64 = 0.5;
/// Side of a point, pixels.
const POINT: i32 = 2;
const PAPER: Rgb<u8> = Rgb([250, 250, 250]);

/// Draws the points in their colours, nearer ones in front. Without points the drawing is empty.
pub fn draw(cloud: &PointCloud) -> RgbImage {
    draw_as(cloud, cloud)
}

/// The same from where [`draw`] looks at `other`: drawings of clouds that are to be compared.
pub fn draw_as(cloud: &PointCloud, other: &PointCloud) -> RgbImage {
    let mut image = RgbImage::from_pixel(WIDTH, HEIGHT, PAPER);
    let points: Vec<Vec3> = cloud.points.iter().map(|p| Vec3::from(*p)).collect();
    let seen: Vec<Vec3> = other.points.iter().map(|p| Vec3::from(*p)).collect();
    let Some(viewpoint) = Viewpoint::new(&seen) else { return image };
    let mut nearest = vec![f32::INFINITY; (WIDTH * HEIGHT) as usize];
    for (point, color) in points.iter().zip(&cloud.colors) {
        let Some(seen) = viewpoint.project(*point) else { continue };
        for y in seen.y..seen.y + POINT {
            for x in seen.x..seen.x + POINT {
                let (Ok(x), Ok(y)) = (u32::try_from(x), u32::try_from(y)) else { continue };
                if x >= WIDTH || y >= HEIGHT {
                    continue;
                }
                let before = &mut nearest[(y * WIDTH + x) as usize];
                if seen.z < *before {
                    *before = seen.z;
                    image.put_pixel(x, y, Rgb(*color));
                }
            }
        }
    }
    image
}

/// From where the cloud is seen.
struct Viewpoint {
    center: Vec3,
    /// From the mount's axes to the drawing's.
    turn: Mat3,
    distance: f32,
}

/// Where a point is drawn.
struct Seen {
    x: i32,
    y: i32,
    z: f32,
}

impl Viewpoint {
    fn new(points: &[Vec3]) -> Option<Self> {
        let center = Vec3::new(
            quantile(points.iter().map(|p| p.x), 0.5)?,
            quantile(points.iter().map(|p| p.y), 0.5)?,
            quantile(points.iter().map(|p| p.z), 0.5)?,
        );
        let radius = quantile(points.iter().map(|p| p.distance(center)), SHOWN)?;
        let turn = Mat3::from_rotation_x(PITCH) * Mat3::from_rotation_y(YAW);
        Some(Self { center, turn, distance: radius.max(0.01) / (VIEW / 2.0).sin() })
    }

    fn project(&self, point: Vec3) -> Option<Seen> {
        let p = self.turn * (point - self.center) + Vec3::new(0.0, 0.0, self.distance);
        let focal = HEIGHT as f32 / 2.0 / (VIEW / 2.0).tan();
        let x = WIDTH as f32 / 2.0 + focal * p.x / p.z;
        let y = HEIGHT as f32 / 2.0 + focal * p.y / p.z;
        (p.z > 0.01).then_some(Seen { x: x as i32, y: y as i32, z: p.z })
    }
}

/// The value below which this share of the values is; `None` without values.
fn quantile(values: impl Iterator<Item = f32>, share: f64) -> Option<f32> {
    let mut values: Vec<f32> = values.collect();
    let last = values.len().checked_sub(1)?;
    let at = (last as f64 * share) as usize;
    let (_, found, _) = values.select_nth_unstable_by(at, |a, b| a.partial_cmp(b).unwrap_or(Ordering::Equal));
    Some(*found)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn drawn(points: &[[f32; 3]], colors: &[[u8; 3]]) -> RgbImage {
        draw(&PointCloud { points: points.to_vec(), colors: colors.to_vec() })
    }

    #[test]
    fn the_middle_is_in_the_middle_and_nearer_points_are_in_front() {
        let red = [200, 0, 0];
        let blue = [0, 0, 200];
        let around = [[-0.5, 0.0, 1.0], [0.5, 0.0, 1.0], [0.0, -0.5, 1.0], [0.0, 0.5, 1.0]];
        let mut points = around.to_vec();
        // Twice on the line from the viewpoint through the middle, the farther one last.
        let away = Mat3::from_rotation_y(-YAW) * Mat3::from_rotation_x(-PITCH) * Vec3::Z;
        points.extend([[0.0, 0.0, 1.0], (Vec3::Z + 0.2 * away).into()]);
        let image = drawn(&points, &[blue, blue, blue, blue, red, blue]);
        let center =
            Viewpoint::new(&points.iter().map(|p| Vec3::from(*p)).collect::<Vec<_>>()).unwrap().center;
        assert!(center.distance(Vec3::Z) < 0.2, "{center}");
        let reds: Vec<(u32, u32)> =
            image.enumerate_pixels().filter(|(_, _, p)| p.0 == red).map(|(x, y, _)| (x, y)).collect();
        assert_eq!(reds.len(), 4);
        assert!(reds[0].0.abs_diff(WIDTH / 2) < 40 && reds[0].1.abs_diff(HEIGHT / 2) < 40, "{reds:?}");
    }

    #[test]
    fn nothing_is_an_empty_drawing() {
        assert!(drawn(&[], &[]).pixels().all(|p| *p == PAPER));
    }
}
