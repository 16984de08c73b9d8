//! Weighted normal equations of residuals, and what their solution is worth.

use super::samples::{Kind, Sample, UNKNOWNS};
use nalgebra::{SMatrix, SVector};
use std::collections::BTreeMap;

type Matrix = SMatrix<f64, UNKNOWNS, UNKNOWNS>;
type Vector = SVector<f64, UNKNOWNS>;

/// From a median of absolute values to a standard deviation of the normal distribution.
const MEDIAN_TO_SIGMA: f64 = 1.4826;

/// Standard deviation of an outline that is rounded to pixels.
const GRID_PX: f64 = 0.29;
/// Neighbouring points of an outline that the grid rounds alike.
const ALIKE: f64 = 24.0;

/// Scales of the residuals.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Scale {
    /// Standard deviation that residuals are divided by.
    pub sigma: f64,
    /// Residual at which the weight is a quarter.
    pub cutoff: f64,
}

/// Scales of both kinds of residuals: pixels, metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Scales {
    pub outline: Scale,
    pub depth: Scale,
}

impl Scales {
    fn of(&self, kind: Kind) -> &Scale {
        match kind {
            Kind::Outline => &self.outline,
            Kind::Depth => &self.depth,
        }
    }

    /// Square of a residual in cutoffs.
    fn square(&self, sample: &Sample) -> f64 {
        (sample.residual / self.of(sample.kind).cutoff).powi(2)
    }

    fn weight(&self, sample: &Sample) -> f64 {
        (1.0 + self.square(sample)).powi(-2) / self.of(sample.kind).sigma.powi(2)
    }
}

/// A standard deviation of residuals of a kind that outliers do not move; `None` without residuals.
pub(super) fn sigma(samples: &[Sample], kind: Kind) -> Option<f64> {
    let mut all: Vec<f64> = samples.iter().filter(|s| s.kind == kind).map(|s| s.residual.abs()).collect();
    if all.is_empty() {
        return None;
    }
    let middle = all.len() / 2;
    let (_, median, _) = all.select_nth_unstable_by(middle, f64::total_cmp);
    Some(*median * MEDIAN_TO_SIGMA)
}

/// Normal equations with the weights of Geman and McClure.
pub(super) struct Equations {
    matrix: Matrix,
    right: Vector,
    /// Sum of the second derivatives of the loss, over that of the weights.
    curvature: f64,
}

impl Equations {
    pub(super) fn new(samples: &[Sample], scales: &Scales) -> Self {
        let mut this = Self { matrix: Matrix::zeros(), right: Vector::zeros(), curvature: 1.0 };
        let mut weights = 0.0;
        let mut curvatures = 0.0;
        for sample in samples {
            let u = scales.square(sample);
            let weight = scales.weight(sample);
            weights += weight;
            curvatures += weight * (1.0 - 3.0 * u) / (1.0 + u);
            let weighted = sample.jacobian * weight;
            this.matrix += weighted * sample.jacobian.transpose();
            this.right -= weighted * sample.residual;
        }
        if weights > 0.0 {
            this.curvature = (curvatures / weights).max(0.1);
        }
        this
    }

    /// The step to the minimum; `None` when the residuals leave a direction open. Without `outset` the masks stay as they are.
    pub(super) fn step(&self, damping: f64, outset: bool) -> Option<Vector> {
        let mut matrix = self.matrix;
        let mut right = self.right;
        let last = UNKNOWNS - 1;
        if !outset {
            matrix.fill_row(last, 0.0);
            matrix.fill_column(last, 0.0);
            matrix[(last, last)] = 1.0;
            right[last] = 0.0;
        }
        for i in 0..UNKNOWNS {
            matrix[(i, i)] *= 1.0 + damping;
        }
        let step = matrix.cholesky()?.solve(&right);
        step.iter().all(|v| v.is_finite()).then_some(step)
    }

    /// Covariance of the unknowns. Residuals next to each other are not independent: the sums of scores over squares of the image take
    /// the place of single residuals (White, 1980; clustered as in Cameron, Gelbach and Miller, 2011, with the views as the second
    /// way to group them).
    pub(super) fn covariance(&self, samples: &[Sample], scales: &Scales) -> Option<Matrix> {
        let mut cells: BTreeMap<u32, Vector> = BTreeMap::new();
        let mut views: BTreeMap<usize, Vector> = BTreeMap::new();
        for sample in samples {
            let score = sample.jacobian * (scales.weight(sample) * -sample.residual);
            *cells.entry(sample.cell).or_insert_with(Vector::zeros) += score;
            *views.entry(sample.view).or_insert_with(Vector::zeros) += score;
        }
        let inverse = self.matrix.cholesky()?.inverse() / self.curvature;
        let meat = |sums: &mut dyn Iterator<Item = &Vector>, count: usize| {
            let n = count as f64;
            let factor = if n > 7.0 { n / (n - 7.0) } else { 1.0 };
            sums.map(|s| s * s.transpose()).sum::<Matrix>() * factor
        };
        let cells = meat(&mut cells.values(), cells.len());
        let views = meat(&mut views.values(), 1);
        let mut grid = Matrix::zeros();
        for sample in samples.iter().filter(|s| s.kind == Kind::Outline) {
            let weighted = sample.jacobian * (scales.weight(sample) * GRID_PX);
            grid += weighted * weighted.transpose() * ALIKE;
        }
        Some(inverse * (cells + views + grid) * inverse)
    }
}
