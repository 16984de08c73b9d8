//! How much refined depth of a still scene changes from image to image.

use super::scene::noisy;
use depthrig_cdm::{Color, ColorFormat, Job, Output, RawDepth, Refiner, Result, StepTimes};
use serde::{Deserialize, Serialize};

/// Standard deviations over the images, mean over pixels, millimetres.
#[derive(Debug, Default, Clone, Serialize, Deserialize)]
pub struct Flicker {
    pub images: u32,
    /// Of raw depth, where every image has some.
    pub raw_mm: f64,
    /// Of refined depth, at the same pixels.
    pub refined_mm: f64,
    /// Of refined depth, at pixels that are holes of raw depth in some image.
    pub holes_mm: f64,
}

/// Sums over images, of one pixel.
#[derive(Debug, Default, Clone, Copy)]
struct Pixel {
    images: u32,
    sum: f64,
    squares: f64,
}

impl Pixel {
    fn add(&mut self, mm: f64) {
        if mm > 0.0 {
            self.images += 1;
            self.sum += mm;
            self.squares += mm * mm;
        }
    }

    /// The standard deviation, if every image has depth here.
    fn deviation(&self, images: u32) -> Option<f64> {
        let n = f64::from(images);
        let variance = self.squares / n - (self.sum / n).powi(2);
        (self.images == images).then(|| (variance.max(0.0) * n / (n - 1.0)).sqrt())
    }
}

/// Refines `images` (2 or more) images of a still scene with the noise of a sensor.
///
/// # Errors
/// Those of the refiner.
pub fn measure(refiner: &mut dyn Refiner, (width, height): (usize, usize), images: u32) -> Result<Flicker> {
    let mut raw = vec![Pixel::default(); width * height];
    let mut refined = raw.clone();
    let mut metres = vec![0f32; raw.len()];
    for number in 0..images {
        let (color, depth) = noisy(width, height, number.into());
        let mut job = Job {
            color: Color { pixels: &color, format: ColorFormat::Rgb8, width, height, stride: 3 * width },
            depth: RawDepth { pixels: &depth, unit_m: 0.001 },
            out: Output::Metres(&mut metres),
            steps: StepTimes::default(),
        };
        refiner.refine(core::slice::from_mut(&mut job))?;
        for (pixel, mm) in raw.iter_mut().zip(&depth) {
            pixel.add(f64::from(*mm));
        }
        for (pixel, m) in refined.iter_mut().zip(&metres) {
            pixel.add(1000.0 * f64::from(*m));
        }
    }
    let of = |deviations: &mut dyn Iterator<Item = f64>| {
        let (n, sum) = deviations.fold((0u64, 0.0), |(n, sum), d| (n + 1, sum + d));
        sum / n.max(1) as f64
    };
    let measured = |raw: &Pixel| raw.images == images;
    let pairs = || raw.iter().zip(&refined);
    Ok(Flicker {
        images,
        raw_mm: of(&mut raw.iter().filter_map(|p| p.deviation(images))),
        refined_mm: of(&mut pairs().filter(|(r, _)| measured(r)).filter_map(|(_, p)| p.deviation(images))),
        holes_mm: of(&mut pairs().filter(|(r, _)| !measured(r)).filter_map(|(_, p)| p.deviation(images))),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use depthrig_cdm::{Description, FillRefiner};

    /// Gives raw depth as it came, holes and all.
    struct Through(Description);

    impl Refiner for Through {
        fn describe(&self) -> &Description {
            &self.0
        }

        fn refine(&mut self, jobs: &mut [Job<'_>]) -> Result<()> {
            for job in jobs {
                let Output::Metres(out) = &mut job.out else { panic!("metres are asked for") };
                for (out, d) in out.iter_mut().zip(job.depth.pixels) {
                    *out = f32::from(*d) / 1000.0;
                }
            }
            Ok(())
        }
    }

    #[test]
    fn the_deviation_is_that_of_the_noise() {
        let mut through = Through(Description { engine: "through".into(), model: String::new() });
        let Flicker { raw_mm, refined_mm, holes_mm, .. } = measure(&mut through, (160, 90), 30).unwrap();
        // 0.0052 1/m at 0.8 to 2.3 m.
        assert!((5.0..25.0).contains(&raw_mm), "{raw_mm}");
        assert!((refined_mm - raw_mm).abs() < 1e-3 * raw_mm, "{refined_mm} beside {raw_mm}");
        assert_eq!(holes_mm, 0.0, "no hole of it has depth in every image");
        let filled = measure(&mut FillRefiner::new(1).unwrap(), (160, 90), 10).unwrap();
        assert!(filled.refined_mm <= 1.05 * filled.raw_mm && filled.holes_mm > 0.0, "{filled:?}");
    }

    #[test]
    fn a_pixel_without_depth_in_one_image_has_no_deviation() {
        let mut pixel = Pixel::default();
        for mm in [1000.0, 1002.0, 0.0] {
            pixel.add(mm);
        }
        assert_eq!(pixel.deviation(3), None);
        pixel.add(1004.0);
        assert!((pixel.deviation(3).unwrap() - 2.0).abs() < 1e-6);
    }
}
