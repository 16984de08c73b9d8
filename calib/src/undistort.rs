//! Undistortion: an image as another camera at the same place would have taken it.

use crate::error::check_len;
use crate::{Camera, Error, ErrorKind, Result};
use depthrig_bus::Intrinsics;
use glam::{DMat3, DVec2};

/// Where each pixel of the new image comes from, computed once. An image costs one pass and allocates nothing.
#[derive(Debug, Clone)]
pub struct Undistortion {
    from: (usize, usize),
    to: (usize, usize),
    /// Per pixel of the new image: column and row of the old one in 1/256 pixel; [`OUTSIDE`] where it shows nothing.
    map: Vec<[i32; 2]>,
}

const OUTSIDE: i32 = i32::MIN;
/// Parts of a pixel.
const PARTS: i32 = 256;

impl Undistortion {
    /// From images of the camera `from` to images of the camera `to`, each with its size. `rotation` turns
    /// directions of `to` into directions of `from`; identity for undistortion alone, else for rectification.
    ///
    /// # Errors
    /// As [`Camera::new`]; [`ErrorKind::BadInput`] for empty images.
    pub fn new(
        (from, from_size): (&Intrinsics, (u32, u32)),
        (to, to_size): (&Intrinsics, (u32, u32)),
        rotation: DMat3,
    ) -> Result<Self> {
        if [from_size.0, from_size.1, to_size.0, to_size.1].contains(&0) {
            return Err(Error::new(ErrorKind::BadInput, "an image without pixels cannot be undistorted"));
        }
        let source = Camera::new(from)?;
        let target = Camera::new(to)?;
        let w = f64::from(from_size.0) - 1.0;
        let h = f64::from(from_size.1) - 1.0;
        let place = |x: u32, y: u32| {
            let ray = target.unproject(DVec2::new(f64::from(x), f64::from(y)))?;
            let at = source.project(rotation * ray)?;
            let inside = at.x >= 0.0 && at.y >= 0.0 && at.x <= w && at.y <= h;
            inside.then(|| [at.x, at.y].map(|v| (v * f64::from(PARTS)).round() as i32))
        };
        let pixels = (0..to_size.1).flat_map(|y| (0..to_size.0).map(move |x| (x, y)));
        Ok(Self {
            from: (from_size.0 as usize, from_size.1 as usize),
            to: (to_size.0 as usize, to_size.1 as usize),
            map: pixels.map(|(x, y)| place(x, y).unwrap_or([OUTSIDE; 2])).collect(),
        })
    }

    /// Width and height of the new images.
    pub const fn size(&self) -> (usize, usize) {
        self.to
    }

    /// An image of `N` bytes a pixel, between four pixels in proportion; 0 where the old one shows nothing.
    ///
    /// # Errors
    /// [`ErrorKind::SizeMismatch`] for images of another size.
    pub fn bytes<const N: usize>(&self, image: &[u8], out: &mut [u8]) -> Result<()> {
        check_len("the image", image.len(), self.from, N)?;
        check_len("the undistorted image", out.len(), self.to, N)?;
        let (w, h) = self.from;
        for (out, [u, v]) in out.chunks_exact_mut(N).zip(&self.map) {
            if *u == OUTSIDE {
                out.fill(0);
                continue;
            }
            let x = (u / PARTS) as usize;
            let y = (v / PARTS) as usize;
            let a = (u % PARTS) as u32;
            let b = (v % PARTS) as u32;
            let right = (x + 1).min(w - 1);
            let below = (y + 1).min(h - 1);
            for (c, out) in out.iter_mut().enumerate() {
                let at = |x: usize, y: usize| u32::from(image[(y * w + x) * N + c]);
                let top = at(x, y) * (256 - a) + at(right, y) * a;
                let bottom = at(x, below) * (256 - a) + at(right, below) * a;
                *out = ((top * (256 - b) + bottom * b + (1 << 15)) >> 16) as u8;
            }
        }
        Ok(())
    }

    /// Depth: the nearest pixel, because a mean of two surfaces is neither. Right without rotation alone, because
    /// depth is measured along the axis.
    ///
    /// # Errors
    /// As [`Undistortion::bytes`].
    pub fn depth(&self, image: &[u16], out: &mut [u16]) -> Result<()> {
        check_len("the image", image.len(), self.from, 1)?;
        check_len("the undistorted image", out.len(), self.to, 1)?;
        let width = self.from.0;
        for (out, [u, v]) in out.iter_mut().zip(&self.map) {
            let nearest = |at: &i32| ((at + PARTS / 2) / PARTS) as usize;
            *out = if *u == OUTSIDE { 0 } else { image[nearest(v) * width + nearest(u)] };
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use depthrig_bus::Distortion;

    #[test]
    fn straight_lines_become_straight() {
        let coeffs = [-0.3, 0.1, 0.001, -0.0005, 0.0, 0.0, 0.0, 0.0];
        let ideal = Intrinsics::pinhole(60.0, 60.0, 31.5, 23.5);
        let bent = Intrinsics { coeffs, model: Distortion::BrownConrady as u32, ..ideal };
        let camera = Camera::new(&bent).unwrap();
        let size = (64, 48);
        // The bent camera looks at brightness that grows with x: 40 per 0.1 of the plane z = 1.
        let brightness = |x: f64| 128.0 + 400.0 * x * 0.5;
        let image: Vec<u8> = (0..64 * 48)
            .map(|i| camera.unproject(DVec2::new(f64::from(i % 64), f64::from(i / 64))).unwrap())
            .map(|ray| brightness(ray.x).round().clamp(0.0, 255.0) as u8)
            .collect();
        let map = Undistortion::new((&bent, size), (&ideal, size), DMat3::IDENTITY).unwrap();
        let mut out = vec![9; 64 * 48];
        map.bytes::<1>(&image, &mut out).unwrap();
        let mut seen = 0;
        for (i, v) in out.iter().enumerate().filter(|(_, v)| **v != 0) {
            let want = brightness(((i % 64) as f64 - 31.5) / 60.0).clamp(0.0, 255.0);
            assert!((f64::from(*v) - want).abs() < 1.6, "{v} at {i}, not {want}");
            seen += 1;
        }
        assert!(seen > 2500, "{seen}");
        // Depth comes from one pixel, never from between two.
        let steps: Vec<u16> = (0..64 * 48).map(|i| if i % 64 < 30 { 500 } else { 900 }).collect();
        let mut depth = vec![0; 64 * 48];
        map.depth(&steps, &mut depth).unwrap();
        assert!(depth.iter().all(|d| matches!(d, 0 | 500 | 900)));
        assert!(map.bytes::<3>(&image, &mut out).is_err());
    }
}
