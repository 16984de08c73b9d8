//! Both depths as points that turn, beside each other, in one page that needs nothing else.

use super::Look;
use anyhow::Result;
use depthrig_calib::{Deprojection, PointCloud};

/// Points of each cloud at the most: nine bytes each, so that the page stays below 3 MB.
const MAX_POINTS: usize = 100_000;
/// Steps in which a coordinate is written.
const STEPS: f32 = 65_535.0;
const TEMPLATE: &str = include_str!("page.html");

/// The page.
pub(super) fn write(look: &Look) -> Result<String> {
    let (w, h) = look.color.dimensions();
    let deprojection = Deprojection::new(&look.intrinsics, (w, h))?;
    let mut clouds = [PointCloud::default(), PointCloud::default()];
    for (cloud, depth) in clouds.iter_mut().zip([&look.raw, &look.refined]) {
        deprojection.cloud_of_metres(depth, Some(look.color.as_raw()), cloud)?;
    }
    // What both share: refined depth reaches as far as raw depth does, but for its tail.
    let mut z: Vec<f32> = clouds.iter().flat_map(|c| c.points.iter().map(|p| p[2])).step_by(11).collect();
    z.sort_unstable_by(f32::total_cmp);
    let far = crate::bench::stats::quantile(&z, 0.98).unwrap_or(1.0) * 1.05;
    let middle = crate::bench::stats::quantile(&z, 0.5).unwrap_or(1.0);
    let reach = clouds.iter().flat_map(|c| &c.points).filter(|p| p[2] <= far);
    let size = reach.fold(0.01f32, |most, p| most.max(p[0].abs()).max(p[1].abs()).max((p[2] - middle).abs()));
    let [raw, refined] = clouds.map(|cloud| packed(&cloud, far, middle, size));
    let subtitle = if look.note.is_empty() { format!("{w}x{h}") } else { format!("{w}x{h}, {}", look.note) };
    Ok(TEMPLATE
        .replace("@TITLE@", &escaped(&look.title))
        .replace("@SUBTITLE@", &escaped(&subtitle))
        .replace("@ENGINE@", &escaped(&look.engine))
        .replace("@SIZE@", &format!("{size}"))
        .replace("@MIDDLE@", &format!("{middle}"))
        .replace("@RAW@", &base64(&raw))
        .replace("@REFINED@", &base64(&refined)))
}

/// Points as x, y, z of 16 bits within ±`size` around (0, 0, `middle`), and red, green, blue.
fn packed(cloud: &PointCloud, far: f32, middle: f32, size: f32) -> Vec<u8> {
    let inside: Vec<usize> = (0..cloud.points.len()).filter(|i| cloud.points[*i][2] <= far).collect();
    // A step that shares no factor with the width of usual pictures would show no columns either; a whole one is enough
    // for a view.
    let step = inside.len().div_ceil(MAX_POINTS).max(1);
    let mut out = Vec::with_capacity(inside.len() / step * 9 + 9);
    for i in inside.into_iter().step_by(step) {
        let [x, y, z] = cloud.points[i];
        for v in [x, y, z - middle] {
            let at = ((v / size * 0.5 + 0.5) * STEPS).round().clamp(0.0, STEPS) as u16;
            out.extend_from_slice(&at.to_le_bytes());
        }
        out.extend_from_slice(&cloud.colors[i]);
    }
    out
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

/// RFC 4648, with padding.
fn base64(bytes: &[u8]) -> String {
    const LETTERS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut out = String::with_capacity(bytes.len().div_ceil(3) * 4);
    for three in bytes.chunks(3) {
        let word = three.iter().fold(0u32, |w, b| w << 8 | u32::from(*b)) << (8 * (3 - three.len()));
        for n in 0..4 {
            let letter = LETTERS[(word >> (18 - 6 * n) & 63) as usize];
            out.push(if n <= three.len() { char::from(letter) } else { '=' });
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::base64;

    #[test]
    fn base64_of_the_rfc() {
        for (plain, coded) in
            [("", ""), ("f", "Zg=="), ("fo", "Zm8="), ("foo", "Zm9v"), ("foobar", "Zm9vYmFy")]
        {
            assert_eq!(base64(plain.as_bytes()), coded);
        }
    }
}
