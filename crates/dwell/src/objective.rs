//! The terms of the bounded least squares other than the square of the residual: the free functions of the map, and the
//! penalty on the dwell times.
//!
//! Both are quadratic in the dwell times, and their matrices are cheap: a few outer products U U', and the
//! tridiagonal matrix L of the penalty. The equations are those of [`crate::bounded_least_squares`].

use std::ops::Range;

use ndarray::Array2;
use planish_numerics::parallel;
use planish_types::{Axis, Grid, Tif, ToolPath};

use serde::Serialize;

/// Length of a segment, as a fraction of the median length, up to which it counts as a rest. The dwell times of
/// neighbours are not related to the length of a rest. Larger: short segments have no dwell-time density. Smaller: the
/// tiny length of a rest makes its density huge.
pub const REST_FRACTION: f64 = 0.01;

/// Fraction of the square of a function that must remain after Gram-Schmidt; a function with less is left out.
/// Example: on a map of one column, x is a constant. Larger: tilts on narrow maps are not free. Smaller: rounding
/// passes as a free function.
const DEPENDENT_FRACTION: f64 = 1e-12;

/// Returns the median length of the segments that have one, mm; `None` if no segment has a length.
pub fn median_length_mm(path: &ToolPath) -> Option<f64> {
    let mut lengths: Vec<f64> =
        (0..path.len()).map(|j| path.segment_length_mm(j)).filter(|l| *l > 0.0).collect();
    lengths.sort_by(f64::total_cmp);
    lengths.get(lengths.len() / 2).copied()
}

/// Low-order terms of the map that need not be removed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Free {
    /// Piston: a constant.
    Piston,
    /// A plane: the part keeps the tilt that this leaves.
    Plane,
}

/// Free functions of the map, which need not be removed (piston, or plane), orthonormal under the weights:
/// `sum_i w_i f_l(x_i) f_m(x_i) = [l = m]`.
pub struct Basis {
    x_mm: Vec<f64>,
    y_mm: Vec<f64>,
    /// Coefficients [a, b, c] of every function f = a + b (x - x0) + c (y - y0), with the middle of the map at (x0,
    /// y0), mm.
    functions: Vec<[f64; 3]>,
}

impl Basis {
    /// Makes the functions for the pixels of `grid` with these weights (ny, nx): a constant, and for a free plane x and
    /// y, without those that depend on the others on the pixels that count.
    pub fn new(grid: &Grid, weight: &Array2<f64>, free: Free) -> Self {
        let x_mm = from_middle_mm(&grid.x);
        let y_mm = from_middle_mm(&grid.y);
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
        // Gram-Schmidt; a function that is none (a map of one column) is left out.
        let count = match free {
            Free::Piston => 1,
            Free::Plane => 3,
        };
        let mut functions: Vec<[f64; 3]> = Vec::new();
        for k in 0..count {
            let mut f = [0.0; 3];
            f[k] = 1.0;
            let before = moment_product(&m, &f, &f);
            for _ in 0..2 {
                for g in &functions {
                    let c = moment_product(&m, &f, g);
                    (0..3).for_each(|l| f[l] -= c * g[l]);
                }
            }
            let after = moment_product(&m, &f, &f);
            if after > DEPENDENT_FRACTION * before {
                functions.push(f.map(|v| v / after.sqrt()));
            }
        }
        Self { x_mm, y_mm, functions }
    }

    fn value_at(&self, f: &[f64; 3], r: usize, c: usize) -> f64 {
        f[0] + f[1] * self.x_mm[c] + f[2] * self.y_mm[r]
    }

    /// Returns the coefficient `sum_i w_i m_i f(x_i)` of a map m (ny, nx) in every free function f.
    pub fn coefficients(&self, weight: &Array2<f64>, map: &Array2<f64>) -> Vec<f64> {
        // By rows: sums of w m and of w m x.
        let rows: Vec<(f64, f64)> = parallel::map(map.nrows(), &|r| {
            let (mut plain, mut along) = (0.0, 0.0);
            for ((w, m), x) in weight.row(r).iter().zip(map.row(r)).zip(&self.x_mm) {
                plain += w * m;
                along += w * m * x;
            }
            (plain, along)
        });
        let mut sums = vec![0.0; self.functions.len()];
        for ((plain, along), y) in rows.into_iter().zip(&self.y_mm) {
            for (sum, f) in sums.iter_mut().zip(&self.functions) {
                *sum += (f[0] + f[2] * y) * plain + f[1] * along;
            }
        }
        sums
    }

    /// Subtracts from the map (ny, nx) its component in the free functions.
    pub fn project(&self, weight: &Array2<f64>, map: &mut Array2<f64>) {
        let coefficients = self.coefficients(weight, map);
        parallel::consume(map.outer_iter_mut(), &|r, mut row| {
            let y = self.y_mm[r];
            let (mut at_0, mut slope) = (0.0, 0.0);
            for (k, f) in coefficients.iter().zip(&self.functions) {
                at_0 += k * (f[0] + f[2] * y);
                slope += k * f[1];
            }
            row.iter_mut().zip(&self.x_mm).for_each(|(m, x)| *m -= at_0 + slope * x);
        });
    }

    /// Applies the adjoint of [`Self::project`] to the map m: subtracts `W f sum_i m_i f(x_i)` for every free function
    /// f.
    pub fn project_adjoint(&self, weight: &Array2<f64>, map: &mut Array2<f64>) {
        let coefficients = self.coefficients(&Array2::ones(weight.dim()), map);
        for (k, f) in coefficients.iter().zip(&self.functions) {
            for ((r, c), m) in map.indexed_iter_mut() {
                *m -= weight[[r, c]] * k * self.value_at(f, r, c);
            }
        }
    }

    /// Returns the columns of `U = B' W f`, one (n) for every free function f; `adjoint` applies B' to a map (ny, nx).
    pub fn columns(
        &self,
        weight: &Array2<f64>,
        adjoint: impl Fn(&Array2<f64>) -> Vec<f64>,
    ) -> Vec<Vec<f64>> {
        let map_of = |f| {
            Array2::from_shape_fn(weight.dim(), |(r, c)| weight[[r, c]] * self.value_at(f, r, c))
        };
        self.functions.iter().map(|f| adjoint(&map_of(f))).collect()
    }
}

/// Returns the coordinates of an axis, counted from its middle, mm.
fn from_middle_mm(axis: &Axis) -> Vec<f64> {
    let middle = 0.5 * (axis.start_mm() + axis.end_mm());
    axis.coordinates().iter().map(|v| v - middle).collect()
}

/// Returns the weighted product of two functions with the coefficients a and b, from the moments of 1, x, y, of which
/// only the lower triangle is read.
fn moment_product(moments: &[[f64; 3]; 3], a: &[f64; 3], b: &[f64; 3]) -> f64 {
    let mut sum = 0.0;
    for k in 0..3 {
        for l in 0..3 {
            sum += a[k] * b[l] * moments[k.max(l)][k.min(l)];
        }
    }
    sum
}

/// Returns `sum_i w_i a_i b_i` of two maps (ny, nx), added row by row: the result is the same for every number of
/// threads.
pub fn weighted_product(weight: &Array2<f64>, a: &Array2<f64>, b: &Array2<f64>) -> f64 {
    let sums: Vec<f64> = parallel::map(weight.nrows(), &|r| {
        let factors = weight.row(r).into_iter().zip(a.row(r)).zip(b.row(r));
        factors.map(|((w, a), b)| w * a * b).sum::<f64>()
    });
    sums.iter().sum()
}

/// Weights of the terms of the objective other than the residual.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PenaltyWeights {
    /// Weight alpha of the squared dwell time per area above its lower bound, dimensionless.
    pub tikhonov: f64,
    /// Weight beta of the squared slope of the dwell time per area along the path, dimensionless.
    pub slope_weight: f64,
    /// Weight lambda of one second of dwell time in half the mean square of the residual, nm^2/s.
    pub time_weight_nm2_per_s: f64,
}

/// Smallest effective area A of the TIF in the penalty, as a multiple of the area of a dwell point (line distance times
/// median length). A smaller tool gets the weights of a path with this many points in the area of the TIF. Larger:
/// smoother dwell times on coarse paths. Smaller: neighbouring dwell times may differ more than a machine can follow.
pub const POINTS_PER_AREA: f64 = 36.0;

/// Quantities of tool, map and path to which the weights of the penalty are relative, so that they mean the same at
/// every pitch.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PenaltyScale {
    /// Diagonal element K of the matrix `B' W B - U U'`, nm^2/s^2 (U: [`Basis::columns`]): that of one column, exact.
    /// The column is the one at which the diagonal is largest, by an estimate if B is applied by FFT. The weights W are
    /// those of the map, without those of a Huber loss.
    pub strongest: f64,
    /// Sum of the weights of the pixels.
    pub pixel_weight: f64,
    /// Effective area A of the TIF ([`Tif::effective_area_mm2`]), and at least that of [`POINTS_PER_AREA`] dwell
    /// points, mm^2.
    pub area_mm2: f64,
    /// Distance p of neighbouring lines of the path, mm ([`line_distance_mm`]).
    pub line_distance_mm: f64,
}

impl PenaltyScale {
    /// Makes the scale from K (`strongest`), the sum of the weights w (`pixel_weight`), and `B' w` (n).
    pub fn new(path: &ToolPath, tif: &Tif, strongest: f64, pixel_weight: f64, b_w: &[f64]) -> Self {
        let line_distance_mm = line_distance_mm(tif, pixel_weight, b_w, &lengths_mm(path));
        let point_mm2 = line_distance_mm * median_length_mm(path).unwrap_or(0.0);
        let area_mm2 = tif.effective_area_mm2().max(POINTS_PER_AREA * point_mm2);
        Self { strongest, pixel_weight, area_mm2, line_distance_mm }
    }
}

/// Returns the length along the path that every dwell time belongs to (n), mm: that of the segment, or the median
/// length for a rest and for a segment with the tool off. All are 0 if no segment has a length.
pub fn lengths_mm(path: &ToolPath) -> Vec<f64> {
    let median = median_length_mm(path);
    (0..path.len())
        .map(|j| match median {
            Some(median) if !has_density(path, j, median) => median,
            Some(_) => path.segment_length_mm(j),
            None => 0.0,
        })
        .collect()
}

/// Returns true if segment j has a dwell-time density: the tool is on, and the segment is not a rest.
pub fn has_density(path: &ToolPath, j: usize, median_mm: f64) -> bool {
    path.tool_on()[j] && path.segment_length_mm(j) > REST_FRACTION * median_mm
}

/// Returns the distance p of neighbouring lines of the path, mm. A tool of the volumetric removal rate V that takes 1
/// s/mm along lines at the distance p removes V / p on average, so with `b = B' w` (n)
///
/// ```text
/// p = V sum_i w_i / sum_j b_j l_j
/// ```
///
/// whatever shape the path has; lines of repeated passes count each. If no length or no removal is above 0, it is 0.
pub fn line_distance_mm(tif: &Tif, pixel_weight: f64, b: &[f64], lengths_mm: &[f64]) -> f64 {
    let removed: f64 = b.iter().zip(lengths_mm).map(|(b, l)| b * l).sum();
    if removed > 0.0 { tif.vrr_nm_mm2_per_s() * pixel_weight / removed } else { 0.0 }
}

/// The penalty: the terms of the objective other than the residual. With `a_j = p l_j`, the area of the part that a
/// dwell point stands for, and `r_j = t_j / a_j`, the dwell time per area:
///
/// ```text
/// 1/2 alpha K A   sum_j a_j (r_j - lo_j / a_j)^2
/// + 1/2 beta K A^2 sum_k p m_k ((r_k - r_{k-1}) / m_k)^2,     m_k = (l_{k-1} + l_k) / 2
/// + sum_j price_j t_j,                               price_j = lambda_j sum_i w_i
/// ```
///
/// The price of a second is its weight lambda times the sum of the weights of the pixels. It is a constant of the
/// gradient of the penalty, `alpha K A (t_j - lo_j) / a_j + .. + lambda sum_i w_i`, and so a part of g in (2) of
/// [`crate::bounded_least_squares`]. The sums are those of integrals over the part: with closer lines or points they go
/// to `alpha K A int (r - lo)^2` and `beta K A^2 int (dr/ds)^2`, s along the path.
#[derive(Clone, PartialEq)]
pub struct Penalty {
    /// Diagonal element `alpha K A / a_j` of the Tikhonov term of every dwell time (n), with A in place of an area a_j
    /// of 0.
    alpha: Vec<f64>,
    /// Price of one second of the dwell times of each tool, in the unit of the objective, with the columns of the tool.
    prices: Vec<(Range<usize>, f64)>,
    lo: Vec<f64>,
    /// Every slope term `(v t_k - u t_{k-1})^2 / 2` as (index k, u, v).
    steps: Vec<(usize, f64, f64)>,
}

impl Penalty {
    /// Makes the penalty for the lower bounds `lo` (n), s. Slope terms join neighbouring segments that both have a
    /// density ([`has_density`]).
    pub fn new(
        path: &ToolPath,
        lo: &[f64],
        scale: &PenaltyScale,
        weights: &PenaltyWeights,
    ) -> Self {
        let PenaltyScale { strongest, pixel_weight, area_mm2, line_distance_mm } = *scale;
        let lengths = lengths_mm(path);
        let diagonal = |l: &f64| {
            let point_mm2 = line_distance_mm * l;
            let own_mm2 = if point_mm2 > 0.0 { point_mm2 } else { area_mm2 };
            weights.tikhonov * strongest * area_mm2 / own_mm2
        };
        let alpha = lengths.iter().map(diagonal).collect();
        let mut steps = Vec::new();
        if let Some(median) = median_length_mm(path).filter(|_| line_distance_mm > 0.0) {
            // p m ((r_k - r_{k-1}) / m)^2 = (t_k / l_k - t_{k-1} / l_{k-1})^2 / (p m)
            for k in 1..lo.len() {
                if has_density(path, k - 1, median) && has_density(path, k, median) {
                    let between = 0.5 * (lengths[k - 1] + lengths[k]);
                    let weight = weights.slope_weight * strongest * area_mm2 * area_mm2;
                    let factor = (weight / (line_distance_mm * between)).sqrt();
                    steps.push((k, factor / lengths[k - 1], factor / lengths[k]));
                }
            }
        }
        let time = weights.time_weight_nm2_per_s * pixel_weight;
        Self { alpha, prices: vec![(0..lo.len(), time)], lo: lo.to_vec(), steps }
    }

    /// Makes the penalty of several tools, the sum of theirs. The dwell times of the tools follow each other in the
    /// order of `parts`. `None` if there are no parts.
    pub fn stacked(parts: impl IntoIterator<Item = Self>) -> Option<Self> {
        parts.into_iter().reduce(|mut all, next| {
            let before = all.len();
            all.alpha.extend(next.alpha);
            all.lo.extend(next.lo);
            all.steps.extend(next.steps.into_iter().map(|(k, u, v)| (k + before, u, v)));
            let moved = next.prices.into_iter();
            all.prices.extend(moved.map(|(r, price)| (r.start + before..r.end + before, price)));
            all
        })
    }

    /// Returns the number of dwell times n.
    pub fn len(&self) -> usize {
        self.lo.len()
    }

    /// Returns the diagonal `alpha K A / a_j` of the Tikhonov term (n).
    pub fn alpha(&self) -> &[f64] {
        &self.alpha
    }

    /// Returns the least diagonal element `alpha K A / a_j` of the Tikhonov term: a lower bound of the eigenvalues of
    /// L.
    pub fn least_alpha(&self) -> f64 {
        self.alpha.iter().copied().fold(f64::INFINITY, f64::min)
    }

    /// Returns the slope terms `(v t_k - u t_{k-1})^2 / 2` of the penalty as (k, u, v).
    pub fn steps(&self) -> &[(usize, f64, f64)] {
        &self.steps
    }

    /// Calls `add(j, k, v)` with parts v of the elements (j, k), k <= j, of the matrix L of the penalty. An element is
    /// the sum of all its parts.
    pub fn for_each(&self, mut add: impl FnMut(usize, usize, f64)) {
        for (j, alpha) in self.alpha.iter().enumerate() {
            add(j, j, *alpha);
        }
        for &(k, u, v) in &self.steps {
            add(k - 1, k - 1, u * u);
            add(k, k, v * v);
            add(k, k - 1, -u * v);
        }
    }

    /// Returns the diagonal of the matrix L of the penalty (n).
    pub fn diagonal(&self) -> Vec<f64> {
        let mut diagonal = vec![0.0; self.len()];
        self.for_each(|j, k, v| {
            if j == k {
                diagonal[j] += v;
            }
        });
        diagonal
    }

    /// Adds the product `L t` with the matrix of the penalty to `out` (n).
    pub fn add_product(&self, t: &[f64], out: &mut [f64]) {
        out.iter_mut().zip(t).zip(&self.alpha).for_each(|((o, t), alpha)| *o += alpha * t);
        for &(k, u, v) in &self.steps {
            let step = v * t[k] - u * t[k - 1];
            out[k] += v * step;
            out[k - 1] -= u * step;
        }
    }

    /// Adds the gradient of the penalty at the dwell times t to `out` (n).
    pub fn add_gradient(&self, t: &[f64], out: &mut [f64]) {
        self.add_product(t, out);
        for (columns, price) in &self.prices {
            let bounds = self.lo[columns.clone()].iter().zip(&self.alpha[columns.clone()]);
            for (o, (lo, alpha)) in out[columns.clone()].iter_mut().zip(bounds) {
                *o += price - alpha * lo;
            }
        }
    }

    /// Returns the value of the penalty at the dwell times t (n).
    pub fn value(&self, t: &[f64]) -> f64 {
        let above_floor = t.iter().zip(&self.lo).zip(&self.alpha);
        let far: f64 = above_floor.map(|((t, lo), alpha)| alpha * (t - lo).powi(2)).sum();
        let rough: f64 =
            self.steps.iter().map(|(k, u, v)| (v * t[*k] - u * t[k - 1]).powi(2)).sum();
        let times = self.prices.iter().map(|(r, price)| price * t[r.clone()].iter().sum::<f64>());
        0.5 * (far + rough) + times.sum::<f64>()
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::TAU;

    use super::*;
    use crate::model::{columns::Columns, operator::Operator};

    fn axis(start: f64, step: f64, n: usize) -> Axis {
        Axis::new(start, step, n).unwrap()
    }

    /// Returns a path of lines along x, `pitch` apart, over (0, width) x (0, height) with half a pitch to its border.
    /// The tool is off between the lines.
    fn raster([width, height]: [f64; 2], pitch: f64, step: f64) -> ToolPath {
        let (lines, steps) = ((height / pitch).round() as usize, (width / step).round() as usize);
        let mut points = Vec::new();
        for line in 0..lines {
            for k in 0..=steps {
                let k = if line % 2 == 0 { k } else { steps - k };
                points.push([k as f64 * step, (line as f64 + 0.5) * pitch]);
            }
        }
        let on: Vec<bool> = (1..points.len()).map(|k| k % (steps + 1) != 0).collect();
        let passes = vec![0; on.len()];
        ToolPath::through(points, on, passes).unwrap()
    }

    #[test]
    fn the_penalty_goes_to_its_integrals_with_closer_lines_and_points() {
        let part @ [width, height] = [8.0, 6.0];
        // r = 1 + 0.3 cos(2 pi x / width) cos(2 pi y / height), lo = 0.2, s/mm^2:
        //   int (r - lo)^2 = (0.8^2 + 0.3^2 / 4) width height
        //   int (dr/dx)^2  = 0.3^2 (2 pi / width)^2 / 4 width height
        let (d, area_mm2) = (7.0, 5.0);
        let part_mm2 = width * height;
        let far = 0.5 * 2e-3 * d * area_mm2 * (0.64 + 0.0225) * part_mm2;
        let rough =
            0.5 * 3e-4 * d * area_mm2 * area_mm2 * 0.0225 * (TAU / width).powi(2) * part_mm2;
        let error = |pitch: f64, step: f64, tikhonov: f64, slope_weight: f64, exact: f64| {
            let path = raster(part, pitch, step);
            let a = pitch * step;
            let on = path.tool_on();
            let places = path.dwell_point_mm();
            let density =
                |p: &[f64; 2]| 1.0 + 0.3 * (TAU * p[0] / width).cos() * (TAU * p[1] / height).cos();
            // Where the tool is off, at the lower bound.
            let lo = vec![0.2 * a; path.len()];
            let t: Vec<f64> = (0..path.len())
                .map(|j| if on[j] { a * density(&places[j]) } else { lo[j] })
                .collect();
            let weights = PenaltyWeights { tikhonov, slope_weight, time_weight_nm2_per_s: 0.0 };
            let scale =
                PenaltyScale { strongest: d, pixel_weight: 1.0, area_mm2, line_distance_mm: pitch };
            Penalty::new(&path, &lo, &scale, &weights).value(&t) / exact - 1.0
        };
        for (pitch, step) in [(0.5, 0.5), (0.25, 0.5), (0.5, 0.25), (0.1, 0.1)] {
            // The midpoint rule is exact for the squares of these waves, and a difference quotient over the step h
            // is the slope times sinc(h pi / width).
            let x = 0.5 * TAU * step / width;
            let sinc = (x.sin() / x).powi(2) - 1.0;
            // Rounding of a sum over the path: the rule is exact here.
            assert!(error(pitch, step, 2e-3, 0.0, far).abs() < 1e-12);
            // The differences end half a step before the ends of a line, where the slope is 0: O(h^3) of it.
            let differs = error(pitch, step, 0.0, 3e-4, rough) - sinc;
            assert!(differs.abs() < 0.5 * (TAU * step / width).powi(3), "{pitch} {step} {differs}");
        }
    }

    #[test]
    fn the_distance_of_the_lines_is_that_of_the_path() {
        let own = Grid { x: axis(-3.0, 0.1, 61), y: axis(-3.0, 0.1, 61) };
        let rate = Array2::from_shape_fn(own.shape(), |(r, c)| {
            8.0 * (-(own.x.coordinate_mm(c).powi(2) + own.y.coordinate_mm(r).powi(2))
                / (2.0 * 0.5 * 0.5))
                .exp()
        });
        let tif = Tif::new(own, rate).unwrap();
        // 4 pi sigma^2, as the samples of a Gaussian that has faded at the border have it.
        assert!((tif.effective_area_mm2() / (2.0 * TAU * 0.5 * 0.5) - 1.0).abs() < 1e-7);
        // 3 mm farther from the border of the lines than the TIF reaches.
        let map = Grid { x: axis(3.0, 0.1, 41), y: axis(3.0, 0.1, 31) };
        let weight = Array2::ones(map.shape());
        let found = |path: &ToolPath| {
            let b = Operator::new(&Columns::Segment.places(path, &tif), &tif, &map).unwrap();
            line_distance_mm(&tif, weight.sum(), &b.adjoint(&weight), &lengths_mm(path))
        };
        for (pitch, step) in [(0.5, 0.5), (0.25, 0.5), (0.5, 0.2)] {
            let path = raster([10.0, 9.0], pitch, step);
            // The ripple of lines a standard deviation apart, 2 exp(-2 pi^2), over the map; and the columns, which
            // integrate a segment by Gauss's rule.
            assert!((found(&path) / pitch - 1.0).abs() < 1e-4, "{}", found(&path));
            // The way back over the same lines is as many lines again.
            let back: Vec<[f64; 2]> =
                path.point_mm().iter().chain(path.point_mm().iter().rev()).copied().collect();
            let on: Vec<bool> = (path.tool_on().iter().copied())
                .chain([false])
                .chain(path.tool_on().iter().rev().copied())
                .collect();
            let passes = vec![0; on.len()];
            let twice = ToolPath::through(back, on, passes).unwrap();
            // As above.
            assert!((found(&twice) / pitch - 0.5).abs() < 1e-4, "{}", found(&twice));
        }
    }
}
