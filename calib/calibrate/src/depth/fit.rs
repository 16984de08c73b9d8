//! The choice of a correction.

use super::correction::{Correction, Model};
use super::plane::median;
use depthrig_calib::{Error, ErrorKind, Result};
use nalgebra::{Matrix2, Vector2};

/// Depth of one place.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Observation {
    /// As the camera senses it, metres.
    pub sensed_m: f64,
    /// As it is, metres.
    pub truth_m: f64,
    /// Standard deviation of their difference, metres.
    pub sigma_m: f64,
    /// Independent errors in it.
    pub windows: f64,
}

/// One form of the correction, fitted.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Candidate {
    /// The form.
    pub model: Model,
    /// The fitted correction.
    pub correction: Correction,
    /// Standard deviations of the correction's parameters; 0 for those that the model does not have.
    pub sigma: Correction,
    /// Bayesian information criterion (Schwarz, 1978): the robust sum of squares plus `k ln n`; the lowest is chosen.
    pub bic: f64,
}

/// Result of [`choose`].
#[derive(Debug, Clone, PartialEq)]
pub struct Choice {
    /// The chosen one.
    pub best: Candidate,
    /// All, in the order in which they were tried.
    pub candidates: Vec<Candidate>,
    /// By how much the places scatter about the best of all models more than their standard deviations say; at least 1.
    /// The standard deviations have it in them (Birge, 1932).
    pub excess: f64,
}

/// Residuals beyond this many standard deviations count linearly (Huber).
const HUBER: f64 = 1.345;
/// Rounds of reweighting.
const ROUNDS: usize = 30;
/// From the median absolute value to the standard deviation of a normal distribution.
const MAD_TO_SIGMA: f64 = 1.482_602_218_505_602;

/// Fits each form of correction and takes the one with the lowest BIC. `is_stereo` allows [`Model::Disparity`].
///
/// # Errors
/// [`ErrorKind::BadInput`] for fewer than three places, or values that are not finite and positive.
pub fn choose(places: &[Observation], is_stereo: bool) -> Result<Choice> {
    let is_good = |p: &Observation| {
        [p.sensed_m, p.truth_m, p.sigma_m, p.windows].iter().all(|v| v.is_finite() && *v > 0.0)
    };
    if places.len() < 3 || !places.iter().all(is_good) {
        return Err(Error::new(ErrorKind::BadInput, "a correction needs three places with depth at least"));
    }
    let mut models = vec![Model::None, Model::Offset, Model::Scale, Model::ScaleOffset];
    if is_stereo {
        models.push(Model::Disparity);
    }
    // The scatter about the models with all that there is to fit.
    let excess = models
        .iter()
        .filter(|m| matches!(m, Model::ScaleOffset | Model::Disparity))
        .map(|m| scatter(*m, places))
        .fold(f64::INFINITY, f64::min)
        .max(1.0);
    let candidates: Vec<Candidate> = models.iter().map(|m| candidate(*m, places, excess)).collect();
    let best = candidates.iter().min_by(|a, b| a.bic.total_cmp(&b.bic)).copied();
    let best = best.ok_or_else(|| Error::new(ErrorKind::BadInput, "no correction was fitted"))?;
    Ok(Choice { best, candidates, excess })
}

/// One row of the regression: `target = design · parameters`, all over the standard deviation.
#[derive(Clone, Copy)]
struct Row {
    design: Vector2<f64>,
    target: f64,
}

/// Parameters are (scale - 1, offset), or (inverse, nothing).
fn row(model: Model, place: &Observation, excess: f64) -> Row {
    let Observation { sensed_m, truth_m, .. } = *place;
    let sigma = place.sigma_m * excess;
    if model == Model::Disparity {
        // d(1/z) = dz / z².
        let weight = truth_m * truth_m / sigma;
        return Row { design: Vector2::new(weight, 0.0), target: (1.0 / truth_m - 1.0 / sensed_m) * weight };
    }
    let by_scale = if matches!(model, Model::Scale | Model::ScaleOffset) { sensed_m } else { 0.0 };
    let by_offset = if matches!(model, Model::Offset | Model::ScaleOffset) { 1.0 } else { 0.0 };
    Row { design: Vector2::new(by_scale, by_offset) / sigma, target: (truth_m - sensed_m) / sigma }
}

/// A regression.
struct Fitted {
    parameters: Vector2<f64>,
    covariance: Matrix2<f64>,
    residuals: Vec<f64>,
}

/// Huber's regression by reweighted least squares, the residuals in units of `scale`.
fn regress(rows: &[Row], scale: f64) -> Fitted {
    let mut weights = vec![1.0; rows.len()];
    let mut parameters = Vector2::zeros();
    let mut covariance = Matrix2::zeros();
    let mut residuals: Vec<f64> = Vec::new();
    for _ in 0..ROUNDS {
        let mut normal = Matrix2::zeros();
        let mut right = Vector2::zeros();
        for (row, weight) in rows.iter().zip(&weights) {
            normal += row.design * row.design.transpose() * *weight;
            right += row.design * (row.target * weight);
        }
        let is_fitted = [normal[(0, 0)] > 0.0, normal[(1, 1)] > 0.0];
        for (i, fitted) in is_fitted.iter().enumerate() {
            if !fitted {
                normal[(i, i)] = 1.0;
            }
        }
        covariance = normal.try_inverse().unwrap_or_else(Matrix2::zeros);
        parameters = covariance * right;
        for (i, fitted) in is_fitted.iter().enumerate() {
            if !fitted {
                covariance[(i, i)] = 0.0;
            }
        }
        residuals = rows.iter().map(|r| r.target - r.design.dot(&parameters)).collect();
        for (weight, residual) in weights.iter_mut().zip(&residuals) {
            *weight = (HUBER * scale / residual.abs()).min(1.0);
        }
    }
    Fitted { parameters, covariance, residuals }
}

/// Standard deviation of the residuals of a model in units of the places' own, from the median, which outliers do not move.
fn scatter(model: Model, places: &[Observation]) -> f64 {
    let rows: Vec<Row> = places.iter().map(|p| row(model, p, 1.0)).collect();
    let mut scale = f64::INFINITY;
    for _ in 0..5 {
        let fitted = regress(&rows, scale);
        let mut sizes: Vec<f64> = fitted.residuals.iter().map(|r| r.abs()).collect();
        let median = median(&mut sizes).unwrap_or(0.0);
        let count = places.len() as f64;
        let free = (count - model.parameters() as f64).max(1.0);
        scale = (MAD_TO_SIGMA * median * (count / free).sqrt()).max(1.0);
    }
    scale
}

fn candidate(model: Model, places: &[Observation], excess: f64) -> Candidate {
    let rows: Vec<Row> = places.iter().map(|p| row(model, p, excess)).collect();
    let fitted = regress(&rows, 1.0);
    let loss = |r: &f64| {
        let size = r.abs();
        if size <= HUBER { size * size } else { HUBER * (2.0 * size - HUBER) }
    };
    let windows: f64 = places.iter().map(|p| p.windows).sum();
    let bic =
        fitted.residuals.iter().map(loss).sum::<f64>() + model.parameters() as f64 * windows.max(2.0).ln();
    let first = fitted.parameters.x;
    let second = fitted.parameters.y;
    let first_sigma = fitted.covariance[(0, 0)].sqrt();
    let second_sigma = fitted.covariance[(1, 1)].sqrt();
    let zero = Correction { scale: 0.0, offset_m: 0.0, inverse_per_m: 0.0 };
    let (correction, sigma) = match model {
        Model::Disparity => (
            Correction { inverse_per_m: first, ..Correction::NONE },
            Correction { inverse_per_m: first_sigma, ..zero },
        ),
        _ => (
            Correction { scale: 1.0 + first, offset_m: second, ..Correction::NONE },
            Correction { scale: first_sigma, offset_m: second_sigma, ..zero },
        ),
    };
    Candidate { model, correction, sigma, bic }
}
