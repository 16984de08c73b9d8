//! The measures over many images: their mean, and all pixels pooled.

use super::sums::{Sums, each};
use super::{Depth, DepthMetrics, DepthRange, Measured};
use crate::Result;

/// Collects images one at a time; memory does not grow with their number.
#[derive(Debug, Clone)]
pub struct Dataset {
    range: DepthRange,
    pooled: Sums,
    /// Sums over the images of the plain measures, and over those that have a strict one.
    plain: [f64; 7],
    strict: [f64; 8],
    images: u64,
    compared: u64,
    counted: u64,
}

/// Metrics of a [`Dataset`].
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct DatasetMetrics {
    /// Mean over images of each image's value; `counted` and `valid` are sums. An image without a valid
    /// pixel takes no part in the plain measures, one without a pixel that counts in none.
    pub mean_of_images: DepthMetrics,
    /// As if all images were one: every pixel weighs the same.
    pub pixel_pooled: DepthMetrics,
    /// Images that were added.
    pub images: u64,
    /// Of these, the ones in which no pixel could be compared.
    pub empty_images: u64,
}

impl Dataset {
    /// No images yet; `range` as in [`super::compare`].
    pub fn new(range: DepthRange) -> Self {
        Self {
            range,
            pooled: Sums::default(),
            plain: [0.0; 7],
            strict: [0.0; 8],
            images: 0,
            compared: 0,
            counted: 0,
        }
    }

    /// Adds one image and returns its own measures.
    ///
    /// # Errors
    /// Those of [`super::compare`]; the image is left out then.
    pub fn add(&mut self, prediction: &Depth<'_>, reference: &Depth<'_>) -> Result<DepthMetrics> {
        let mut sums = Sums::default();
        each(prediction, reference, self.range, |_, seen, truth| sums.add(seen, truth))?;
        Ok(self.include(sums))
    }

    /// Adds one image that was measured elsewhere.
    pub fn push(&mut self, measured: &Measured) -> DepthMetrics {
        self.include(measured.sums)
    }

    fn include(&mut self, sums: Sums) -> DepthMetrics {
        let m = sums.metrics();
        self.pooled = self.pooled.plus(sums);
        self.images += 1;
        if m.valid > 0 {
            self.compared += 1;
            let shares = [m.delta_05, m.delta_1, m.delta_105, m.delta_110];
            let values = [m.l1_m, m.rmse_m, m.abs_rel].into_iter().chain(shares);
            for (sum, value) in self.plain.iter_mut().zip(values) {
                *sum += value;
            }
        }
        if m.counted > 0 {
            self.counted += 1;
            let errors = [m.strict_l1_m, m.strict_rmse_m, m.strict_abs_rel];
            let shares = [m.strict_delta_05, m.strict_delta_1, m.strict_delta_105, m.strict_delta_110];
            let values = errors.into_iter().chain(shares).chain([m.missing_percent]);
            for (sum, value) in self.strict.iter_mut().zip(values) {
                *sum += value;
            }
        }
        m
    }

    /// The measures so far.
    pub fn metrics(&self) -> DatasetMetrics {
        let pixel_pooled = self.pooled.metrics();
        let plain = self.plain.map(|s| s / self.compared as f64);
        let strict = self.strict.map(|s| s / self.counted as f64);
        DatasetMetrics {
            mean_of_images: DepthMetrics {
                counted: pixel_pooled.counted,
                valid: pixel_pooled.valid,
                l1_m: plain[0],
                rmse_m: plain[1],
                abs_rel: plain[2],
                delta_05: plain[3],
                delta_1: plain[4],
                delta_105: plain[5],
                delta_110: plain[6],
                strict_l1_m: strict[0],
                strict_rmse_m: strict[1],
                strict_abs_rel: strict[2],
                strict_delta_05: strict[3],
                strict_delta_1: strict[4],
                strict_delta_105: strict[5],
                strict_delta_110: strict[6],
                missing_percent: strict[7],
            },
            pixel_pooled,
            images: self.images,
            empty_images: self.images - self.compared,
        }
    }
}
