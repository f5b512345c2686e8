//! The terms of the bounded least squares beside the residual: what of it is free, and what is penalised.
//!
//! Both are quadratic in the dwell times, and their matrices are cheap: a few outer products U U', and a
//! tridiagonal matrix `alpha D I + beta D G' G`. The equations are those of
//! [`crate::bounded_least_squares`].

use ndarray::Array2;
use planish_types::{Axis, Grid, ToolPath};
use serde::Serialize;

/// A segment shorter than this fraction of the median is a rest, whose length says nothing about the dwell
/// time of its neighbours.
pub const REST_FRACTION: f64 = 0.01;

/// A function of which Gram-Schmidt leaves less than this fraction of its square is none on the map: on a
/// map of one column x is a constant.
const DEPENDENT_FRACTION: f64 = 1e-12;

/// Median length of the segments that have one, mm.
pub fn median_length_mm(path: &ToolPath) -> Option<f64> {
    let mut lengths: Vec<f64> =
        (0..path.len()).map(|j| path.segment_length_mm(j)).filter(|l| *l > 0.0).collect();
    lengths.sort_by(f64::total_cmp);
    lengths.get(lengths.len() / 2).copied()
}

/// What need not be removed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[cfg_attr(feature = "cli", derive(clap::ValueEnum))]
#[serde(rename_all = "lowercase")]
pub enum Free {
    /// A constant.
    Piston,
    /// A plane: the part keeps the tilt that this leaves.
    Plane,
}

/// What the removal need not remove, as functions orthonormal under the weights:
/// `sum_i w_i f_l(x_i) f_m(x_i) = [l = m]`.
pub struct Basis {
    x_mm: Vec<f64>,
    y_mm: Vec<f64>,
    /// f = a + b (x - x0) + c (y - y0) with the middle of the map at (x0, y0).
    functions: Vec<[f64; 3]>,
}

impl Basis {
    /// On the pixels of `grid` with these weights.
    pub fn new(grid: &Grid, weight: &Array2<f64>, free: Free) -> Self {
        let centred = |a: &Axis| -> Vec<f64> {
            let middle = 0.5 * (a.start_mm() + a.end_mm());
            a.coordinates().iter().map(|v| v - middle).collect()
        };
        let (x_mm, y_mm) = (centred(&grid.x), centred(&grid.y));
        // Moments m[k][l] = sum of w f_k f_l with f = 1, x, y.
        let mut m = [[0.0; 3]; 3];
        for (r, row) in weight.outer_iter().enumerate() {
            for (c, w) in row.iter().enumerate() {
                let f = [1.0, x_mm[c], y_mm[r]];
                for k in 0..3 {
                    for l in 0..=k {
                        m[k][l] += w * f[k] * f[l];
                    }
                }
            }
        }
        let product = |a: &[f64; 3], b: &[f64; 3]| -> f64 {
            let mut sum = 0.0;
            for k in 0..3 {
                for l in 0..3 {
                    sum += a[k] * b[l] * m[k.max(l)][k.min(l)];
                }
            }
            sum
        };
        // Gram-Schmidt; a function that is none (a map of one column) is left out.
        let count = match free {
            Free::Piston => 1,
            Free::Plane => 3,
        };
        let mut functions: Vec<[f64; 3]> = Vec::new();
        for k in 0..count {
            let mut f = [0.0; 3];
            f[k] = 1.0;
            let before = product(&f, &f);
            for _ in 0..2 {
                for g in &functions {
                    let c = product(&f, g);
                    (0..3).for_each(|l| f[l] -= c * g[l]);
                }
            }
            let after = product(&f, &f);
            if after > DEPENDENT_FRACTION * before {
                functions.push(f.map(|v| v / after.sqrt()));
            }
        }
        Self { x_mm, y_mm, functions }
    }

    fn at(&self, f: &[f64; 3], r: usize, c: usize) -> f64 {
        f[0] + f[1] * self.x_mm[c] + f[2] * self.y_mm[r]
    }

    /// `sum_i w_i m_i f(x_i)` for every function.
    pub fn coefficients(&self, weight: &Array2<f64>, map: &Array2<f64>) -> Vec<f64> {
        // By rows: sums of w m and of w m x.
        let mut sums = vec![0.0; self.functions.len()];
        for (r, (w, m)) in weight.outer_iter().zip(map.outer_iter()).enumerate() {
            let (mut plain, mut along) = (0.0, 0.0);
            for ((w, m), x) in w.iter().zip(m).zip(&self.x_mm) {
                plain += w * m;
                along += w * m * x;
            }
            for (sum, f) in sums.iter_mut().zip(&self.functions) {
                *sum += (f[0] + f[2] * self.y_mm[r]) * plain + f[1] * along;
            }
        }
        sums
    }

    /// Takes the component in the functions out of the map.
    pub fn project(&self, weight: &Array2<f64>, map: &mut Array2<f64>) {
        let coefficients = self.coefficients(weight, map);
        for (mut row, y) in map.outer_iter_mut().zip(&self.y_mm) {
            let (mut at_0, mut slope) = (0.0, 0.0);
            for (k, f) in coefficients.iter().zip(&self.functions) {
                at_0 += k * (f[0] + f[2] * y);
                slope += k * f[1];
            }
            row.iter_mut().zip(&self.x_mm).for_each(|(m, x)| *m -= at_0 + slope * x);
        }
    }

    /// `U = B' W f` for every function, `adjoint` being B'.
    pub fn columns(
        &self,
        weight: &Array2<f64>,
        adjoint: impl Fn(&Array2<f64>) -> Vec<f64>,
    ) -> Vec<Vec<f64>> {
        let of = |f: &[f64; 3]| {
            adjoint(&Array2::from_shape_fn(weight.dim(), |(r, c)| {
                weight[[r, c]] * self.at(f, r, c)
            }))
        };
        self.functions.iter().map(of).collect()
    }
}

/// What the terms of the penalty weigh.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PenaltyWeights {
    /// alpha: weight of the distance to the lower bound.
    pub tikhonov: f64,
    /// beta: weight of the roughness of the dwell-time density.
    pub smoothness: f64,
    /// Price of a second beside half the mean square of the residual, nm^2/s.
    pub time_weight_nm2_per_s: f64,
}

/// The terms of the objective beside the residual, with `alpha D` and `beta D`:
///
/// ```text
/// 1/2 alpha D sum_j (t_j - lo_j)^2 + 1/2 beta D sum_k (q_k - q_{k-1})^2 + price sum_j t_j
/// ```
#[derive(Clone)]
pub struct Penalty {
    alpha: f64,
    beta: f64,
    /// Price of a second in the unit of the objective.
    time: f64,
    lo: Vec<f64>,
    /// k and the factors of t_{k-1} and t_k in q_k - q_{k-1}.
    steps: Vec<(usize, f64, f64)>,
}

impl Penalty {
    /// For the lower bounds `lo` (n), s, the largest diagonal element D of `B' W B`, and the sum of the
    /// weights of the pixels.
    pub fn new(
        path: &ToolPath,
        lo: &[f64],
        d: f64,
        pixel_weight: f64,
        weights: &PenaltyWeights,
    ) -> Self {
        let mut steps = Vec::new();
        if let Some(median) = median_length_mm(path) {
            let length = |j: usize| path.segment_length_mm(j);
            // A density needs a length.
            let has_density = |j: usize| path.tool_on()[j] && length(j) > REST_FRACTION * median;
            // q_k - q_{k-1} = t_k l / l_k - t_{k-1} l / l_{k-1}
            steps = (1..lo.len())
                .filter(|k| has_density(k - 1) && has_density(*k))
                .map(|k| (k, median / length(k - 1), median / length(k)))
                .collect();
        }
        let (alpha, beta) = (weights.tikhonov * d, weights.smoothness * d);
        let time = weights.time_weight_nm2_per_s * pixel_weight;
        Self { alpha, beta, time, lo: lo.to_vec(), steps }
    }

    /// Number of dwell times.
    pub fn len(&self) -> usize {
        self.lo.len()
    }

    /// alpha D
    pub fn alpha(&self) -> f64 {
        self.alpha
    }

    /// beta D
    pub fn beta(&self) -> f64 {
        self.beta
    }

    /// k and the factors u, v of `(v t_k - u t_{k-1})^2`.
    pub fn steps(&self) -> &[(usize, f64, f64)] {
        &self.steps
    }

    /// Elements (j, k), k <= j, of the matrix.
    pub fn for_each(&self, mut add: impl FnMut(usize, usize, f64)) {
        for j in 0..self.len() {
            add(j, j, self.alpha);
        }
        for &(k, u, v) in &self.steps {
            add(k - 1, k - 1, self.beta * u * u);
            add(k, k, self.beta * v * v);
            add(k, k - 1, -self.beta * u * v);
        }
    }

    /// Diagonal of the matrix.
    pub fn diagonal(&self) -> Vec<f64> {
        let mut diagonal = vec![0.0; self.len()];
        self.for_each(|j, k, v| {
            if j == k {
                diagonal[j] += v;
            }
        });
        diagonal
    }

    /// `out += (alpha D + beta D G' G) t`.
    pub fn add_product(&self, t: &[f64], out: &mut [f64]) {
        out.iter_mut().zip(t).for_each(|(o, t)| *o += self.alpha * t);
        for &(k, u, v) in &self.steps {
            let step = self.beta * (v * t[k] - u * t[k - 1]);
            out[k] += v * step;
            out[k - 1] -= u * step;
        }
    }

    /// `out += ` the gradient.
    pub fn add_gradient(&self, t: &[f64], out: &mut [f64]) {
        self.add_product(t, out);
        out.iter_mut().zip(&self.lo).for_each(|(o, lo)| *o += self.time - self.alpha * lo);
    }

    /// The terms themselves.
    pub fn value(&self, t: &[f64]) -> f64 {
        let far: f64 = t.iter().zip(&self.lo).map(|(t, lo)| (t - lo).powi(2)).sum();
        let rough: f64 =
            self.steps.iter().map(|(k, u, v)| (v * t[*k] - u * t[k - 1]).powi(2)).sum();
        0.5 * (self.alpha * far + self.beta * rough) + self.time * t.iter().sum::<f64>()
    }
}
