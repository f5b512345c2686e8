//! The penalty of the bounded least squares, from its definition: what several tests compare with.

use ndarray::{Array2, s};
use planish_dwell::columns::Patch;
use planish_types::{Tif, ToolPath};

/// The penalty `1/2 sum_j alpha_j (t_j - lo_j)^2 + 1/2 sum_k beta_k (t_k / l_k - t_{k-1} / l_{k-1})^2` of the bounded
/// least squares, by its definition.
pub struct Penalty {
    /// Factors `alpha K A / (p l_j)` of the Tikhonov term (n).
    pub alpha: Vec<f64>,
    /// Factors `beta K A^2 / (p m_k)` of the slope between segments k - 1 and k (n); 0 if one of them has no density.
    pub beta: Vec<f64>,
    /// Lengths l of the segments (n), mm.
    pub length_mm: Vec<f64>,
}

impl Penalty {
    /// Makes the penalty for `columns` of segments on a map whose pixels have the weights `weight`, with D =
    /// `strongest`.
    pub fn new(
        path: &ToolPath,
        tif: &Tif,
        columns: &[Patch],
        weight: &Array2<f64>,
        strongest: f64,
        (tikhonov, slope_weight): (f64, f64),
    ) -> Self {
        let n = path.len();
        let own: Vec<f64> = (0..n).map(|j| path.segment_length_mm(j)).collect();
        let mut sorted: Vec<f64> = own.iter().copied().filter(|l| *l > 0.0).collect();
        sorted.sort_by(f64::total_cmp);
        let median = sorted[sorted.len() / 2];
        let has_density: Vec<bool> =
            (0..n).map(|j| path.tool_on()[j] && own[j] > 0.01 * median).collect();
        let length_mm: Vec<f64> =
            (0..n).map(|j| if has_density[j] { own[j] } else { median }).collect();
        // A = (integral of R)^2 / integral of R^2, at least that of 36 dwell points
        let rate = tif.rate_nm_per_s();
        let pixel = tif.grid().x.step_mm() * tif.grid().y.step_mm();
        let area = rate.sum().powi(2) / rate.mapv(|r| r * r).sum() * pixel;
        // p: V over what 1 s/mm removes on average
        let removed: f64 = (columns.iter().zip(&length_mm))
            .map(|(p, l)| {
                let ((r, c), (ny, nx)) = (p.origin, p.rate_nm_per_s.dim());
                l * (&p.rate_nm_per_s * &weight.slice(s![r..r + ny, c..c + nx])).sum()
            })
            .sum();
        let p = rate.sum() * pixel * weight.sum() / removed;
        let area = area.max(36.0 * p * median);
        let alpha = length_mm.iter().map(|l| tikhonov * strongest * area / (p * l)).collect();
        let between = |k: usize| 0.5 * (length_mm[k - 1] + length_mm[k]);
        let beta = (0..n)
            .map(|k| match k > 0 && has_density[k - 1] && has_density[k] {
                true => slope_weight * strongest * area * area / (p * between(k)),
                false => 0.0,
            })
            .collect();
        Self { alpha, beta, length_mm }
    }

    /// Returns the value of the penalty at the dwell times t (n).
    #[allow(dead_code, reason = "not every test that has this module needs all of it")]
    pub fn value(&self, t: &[f64], lo: &[f64]) -> f64 {
        let far: f64 = (0..t.len()).map(|j| self.alpha[j] * (t[j] - lo[j]).powi(2)).sum();
        let density = |j: usize| t[j] / self.length_mm[j];
        let rough: f64 =
            (1..t.len()).map(|k| self.beta[k] * (density(k) - density(k - 1)).powi(2)).sum();
        0.5 * (far + rough)
    }

    /// Returns the gradient of the penalty at the dwell times t (n).
    #[allow(dead_code, reason = "not every test that has this module needs all of it")]
    pub fn gradient(&self, t: &[f64], lo: &[f64]) -> Vec<f64> {
        let mut q: Vec<f64> = (0..t.len()).map(|j| self.alpha[j] * (t[j] - lo[j])).collect();
        for k in 1..t.len() {
            let step = t[k] / self.length_mm[k] - t[k - 1] / self.length_mm[k - 1];
            q[k] += self.beta[k] * step / self.length_mm[k];
            q[k - 1] -= self.beta[k] * step / self.length_mm[k - 1];
        }
        q
    }

    /// Returns the diagonal of the matrix of the penalty (n).
    #[allow(dead_code, reason = "not every test that has this module needs all of it")]
    pub fn diagonal(&self) -> Vec<f64> {
        let mut d = self.alpha.clone();
        for k in 1..d.len() {
            d[k] += self.beta[k] / self.length_mm[k].powi(2);
            d[k - 1] += self.beta[k] / self.length_mm[k - 1].powi(2);
        }
        d
    }
}
