//! Symmetric systems of the form `[B E; Eᵀ D]`, where `B` is a band (a trajectory's unknowns) and `D` small (the cameras').

use nalgebra::{Cholesky, DMatrix, DVector, Dyn};

/// Rows below the diagonal that the band has, and the diagonal.
pub(super) const BAND: usize = 24;

/// The system.
#[derive(Debug, Clone)]
pub(super) struct Arrow {
    /// Rows of the band's lower half: row `i` has the columns `i - 23..=i`.
    band: Vec<[f64; BAND]>,
    pub cross: DMatrix<f64>,
    pub corner: DMatrix<f64>,
}

/// The system solved for its band, ready for right-hand sides.
pub(super) struct Factors {
    lower: Vec<[f64; BAND]>,
    /// `B⁻¹ E`.
    pub influence: DMatrix<f64>,
    corner: Cholesky<f64, Dyn>,
}

/// A vector of the system.
#[derive(Debug, Clone)]
pub(super) struct Parts {
    pub band: DVector<f64>,
    pub corner: DVector<f64>,
}

impl Arrow {
    pub fn zeros(band: usize, corner: usize) -> Self {
        Self {
            band: vec![[0.0; BAND]; band],
            cross: DMatrix::zeros(band, corner),
            corner: DMatrix::zeros(corner, corner),
        }
    }

    /// Adds to an element of the band; `row >= column`.
    pub fn add_band(&mut self, row: usize, column: usize, value: f64) {
        self.band[row][BAND - 1 + column - row] += value;
    }

    /// An element of the band; `row >= column`.
    #[cfg(test)]
    pub fn band(&self, row: usize, column: usize) -> f64 {
        self.band[row][BAND - 1 + column - row]
    }

    /// Solves for the band; `None` if the system is not positive definite. The diagonal is enlarged by `damping` of itself.
    pub fn factors(&self, damping: f64) -> Option<Factors> {
        let lower = cholesky(&self.band, damping)?;
        let mut influence = self.cross.clone();
        for mut column in influence.column_iter_mut() {
            solve(&lower, column.as_mut_slice());
        }
        let mut corner = &self.corner - self.cross.transpose() * &influence;
        for i in 0..corner.nrows() {
            corner[(i, i)] += damping * self.corner[(i, i)];
        }
        Some(Factors { lower, influence, corner: Cholesky::new(corner)? })
    }
}

impl Factors {
    /// The solution for a right-hand side.
    pub fn solve(&self, of: &Parts) -> Parts {
        let reduced = &of.corner - self.influence.transpose() * &of.band;
        let corner = self.corner.solve(&reduced);
        let mut band = of.band.clone();
        solve(&self.lower, band.as_mut_slice());
        band -= &self.influence * &corner;
        Parts { band, corner }
    }

    /// The inverse's part that belongs to `D`.
    pub fn corner_inverse(&self) -> DMatrix<f64> {
        self.corner.inverse()
    }
}

/// Lower triangle `L` with `L Lᵀ` the band.
fn cholesky(band: &[[f64; BAND]], damping: f64) -> Option<Vec<[f64; BAND]>> {
    let mut lower: Vec<[f64; BAND]> = Vec::with_capacity(band.len());
    for (i, row) in band.iter().enumerate() {
        let mut own = [0.0; BAND];
        for at in (BAND - 1).saturating_sub(i)..BAND {
            // Column of the system; its row of L begins `shift` columns before ours.
            let j = i + at + 1 - BAND;
            let shift = i - j;
            let mut sum = row[at];
            if at == BAND - 1 {
                sum += damping * row[at];
                sum -= own[..at].iter().map(|l| l * l).sum::<f64>();
                if sum.is_nan() || sum <= 0.0 {
                    return None;
                }
                own[at] = sum.sqrt();
            } else {
                let other = &lower[j];
                sum -= (0..at).map(|k| own[k] * other[k + shift]).sum::<f64>();
                own[at] = sum / other[BAND - 1];
            }
        }
        lower.push(own);
    }
    Some(lower)
}

/// Solves `L Lᵀ x = b` in place.
fn solve(lower: &[[f64; BAND]], x: &mut [f64]) {
    for (i, row) in lower.iter().enumerate() {
        let from = (BAND - 1).saturating_sub(i);
        let sum: f64 = (from..BAND - 1).map(|k| row[k] * x[i + k + 1 - BAND]).sum();
        x[i] = (x[i] - sum) / row[BAND - 1];
    }
    for (i, row) in lower.iter().enumerate().rev() {
        let from = (BAND - 1).saturating_sub(i);
        x[i] /= row[BAND - 1];
        let own = x[i];
        for k in from..BAND - 1 {
            x[i + k + 1 - BAND] -= row[k] * own;
        }
    }
}
