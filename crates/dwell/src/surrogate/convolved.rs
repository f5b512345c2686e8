//! The surrogate as an operator, for too many dwell points for a matrix. A matrix grows with their square over the
//! width of the TIF, while a product by FFT grows with the number of cells.

use ndarray::Array2;
use planish_numerics::{
    parallel,
    qp::bounded::{self, DESCENT_STEPS, GradientSettings, ProductSettings, Solution},
};
use planish_types::{Axis, Grid, Invalid, Tif};

use super::{
    resolution::{are_short, length_mm},
    two_level::{Coarse, Nodes, TwoLevel},
};
use crate::{
    model::{
        columns::ToolPlace,
        fft_operator::{FftOperator, Spread, Sums},
    },
    objective::{Basis, Free, Penalty},
};

/// Largest number of sets of free dwell times that one step tries. Larger: a step that cycles takes longer. Smaller:
/// steps end before their set is found. Chosen: measured problems take 2 to 12.
const MAX_ACTIVE_SETS: usize = 30;

/// Relative error at which conjugate gradients end. They end if the decrease of the objective by the next step is about
/// the square of this number times the decrease so far. Larger: more steps with inexact solutions. Smaller: more
/// products per step.
const LINEAR_SOLVE_ERROR: f64 = 0.1;

/// The surrogate H~ of the normal matrix as an operator, (2) of [`super`]: the TIF and the weights of the pixels are
/// sampled once in every cell.
pub struct Convolved {
    h: Operator,
    /// Diagonal of H~ (n) without the penalty.
    diagonal: Vec<f64>,
    splines: Option<Splines>,
}

struct Operator {
    b: FftOperator,
    weight: Array2<f64>,
    u: Vec<Vec<f64>>,
}

impl Operator {
    /// Returns the product `H~ t` (n) for dwell times t (n), with the matrix of the penalty added to H~.
    fn product(&self, penalty: &Penalty, t: &[f64]) -> Vec<f64> {
        let mut h_t = self.b.adjoint(&(self.b.apply(t) * &self.weight));
        for u in &self.u {
            let c: f64 = u.iter().zip(t).map(|(u, t)| u * t).sum();
            h_t.iter_mut().zip(u).for_each(|(h, u)| *h -= u * c);
        }
        penalty.add_product(t, &mut h_t);
        h_t
    }
}

/// Lattice of splines, and the removal by the columns under each of them, from which [`TwoLevel`] is made.
struct Splines {
    sums: Sums,
    nodes: Nodes,
    coarse: Coarse,
}

/// Minimum of the objective over the free dwell times without their bounds, which they may therefore exceed.
pub struct Unbounded {
    /// Dwell times, s.
    pub t: Vec<f64>,
    /// Mask of the free dwell times; the others are at their bounds.
    pub free: Vec<bool>,
}

/// Dwell times at which the objective with the surrogate H~ is least.
pub struct Minimum {
    /// Dwell times within the bounds, s.
    pub t: Vec<f64>,
    /// Minimum over the last set of free dwell times, without their bounds; `None` if gradient steps found `t`.
    pub unbounded: Option<Unbounded>,
    /// Number of products with H~ by the active-set method, or number of gradient steps if these found `t`.
    pub iterations: usize,
}

impl Convolved {
    /// Makes H~ for cells of `size` x `size` pixels. With a pitch of splines, [`Self::minimum`] uses the two-level
    /// method on active sets; without one, gradient steps. `weight` has the weights of the pixels (ny, nx); `reached`
    /// is the mask of the reached columns (n).
    ///
    /// # Errors
    /// Refuses sizes for which the cells, or the TIF sampled at their pitch, do not form a valid axis.
    pub fn new(
        places: &[Vec<ToolPlace>],
        reached: &[bool],
        tif: &Tif,
        map: &Grid,
        weight: &Array2<f64>,
        free: Free,
        (size, spline_pitch_mm): (usize, Option<f64>),
    ) -> Result<Self, Invalid> {
        let grid = Grid { x: cell_axis(&map.x, size)?, y: cell_axis(&map.y, size)? };
        let simpler: Vec<Vec<ToolPlace>>;
        let places = if size > 1 {
            let longest_mm = MAX_CELLS_IN_TWO * grid.x.step_mm().min(grid.y.step_mm());
            simpler = places.iter().map(|places| in_two(places, longest_mm)).collect();
            &simpler
        } else {
            places
        };
        let cells = on_cells(weight, grid.shape(), size);
        // On cells of one pixel H~ is H but for what spills over the border of R.
        let (tif, spread) = match size {
            1 => (tif.clone(), Spread::Keys),
            _ => (sampled(tif, map, size)?, Spread::Splines),
        };
        let b = FftOperator::without_border(places, &tif, &grid, spread);
        let basis = Basis::new(&grid, &cells, free);
        let u = basis.columns(&cells, |m| b.adjoint(m));
        let mut diagonal = b.adjoint_of_squared_tif(&cells);
        for u in &u {
            diagonal.iter_mut().zip(u).for_each(|(d, u)| *d -= u * u);
        }
        let splines = spline_pitch_mm.map(|pitch| {
            let short = are_short(places, reached, pitch);
            let lengths = places.iter().zip(&short).filter(|(_, short)| **short);
            let longest = lengths.map(|(places, _)| length_mm(places)).fold(0.0, f64::max);
            // What is under a spline has its centre there.
            let sums = Sums::new(places, &tif, &grid, 4.0 * pitch + 2.0 * longest, spread);
            let nodes = Nodes::new(places, &short, pitch, tif.grid().size_mm());
            let coarse = Coarse::new(&nodes, &sums, &short);
            Splines { sums, nodes, coarse }
        });
        Ok(Self { h: Operator { b, weight: cells, u }, diagonal, splines })
    }

    /// Returns the minimum of `q'd + d'H~d / 2` within the bounds (lower, upper), s, for steps d from the dwell times
    /// `t`; `q` (n) is the gradient of the exact objective at `t`. Columns that are not reached, or have a zero
    /// diagonal element, keep their times.
    pub fn minimum(
        &mut self,
        penalty: &Penalty,
        t: &[f64],
        q: &[f64],
        reached: &[bool],
        bounds: (&[f64], &[f64]),
        settings: &GradientSettings,
    ) -> Minimum {
        let Self { h, diagonal: data, splines } = self;
        let apply = |t: &[f64]| h.product(penalty, t);
        let own = penalty.diagonal();
        let diagonal: Vec<f64> = (0..t.len())
            .map(|j| if reached[j] { data[j].max(0.0) + own[j] } else { 0.0 })
            .collect();
        // A component that does not move keeps its lower bound: that of t.
        let lo: Vec<f64> =
            (0..t.len()).map(|j| if diagonal[j] > 0.0 { bounds.0[j] } else { t[j] }).collect();
        let h_t = apply(t);
        let g: Vec<f64> = h_t.iter().zip(q).map(|(h, q)| h - q).collect();
        let mut settings = *settings;
        if let Some(Splines { sums, nodes, coarse }) = splines {
            let products = ProductSettings {
                enough: settings.tolerance,
                inexact: LINEAR_SOLVE_ERROR,
                max_sets: MAX_ACTIVE_SETS,
                max_products: settings.max_iterations,
            };
            let bounds = (lo.as_slice(), bounds.1);
            let solved = bounded::active_set_by_products(
                apply,
                |free: &[bool]| {
                    TwoLevel::new(nodes, coarse, (sums, &h.weight), penalty, &h.u, free)
                },
                &diagonal,
                &g,
                bounds,
                t,
                &products,
            );
            let Solution { value, iterations, .. } = solved.solution;
            if value != t {
                let unbounded = Unbounded { t: solved.unbounded, free: solved.free };
                return Minimum { t: value, unbounded: Some(unbounded), iterations };
            }
            // No set was better: gradient steps descend at least.
            settings =
                GradientSettings { max_iterations: DESCENT_STEPS, stagnation: 0.0, ..settings };
        }
        // The offset is that of the objective at t.
        let own: f64 = (0..t.len()).map(|j| t[j] * (0.5 * h_t[j] - g[j])).sum();
        let settings = GradientSettings { offset: settings.offset - own, ..settings };
        let descended =
            bounded::projected_gradient(apply, &diagonal, &g, &lo, bounds.1, t, &settings);
        Minimum { t: descended.value, unbounded: None, iterations: descended.iterations }
    }

    /// Returns the step d, s, that nearly minimises `q'd + d'H~d / 2` over the free components, without bounds, and the
    /// number of products with H~. There are at most `max_products`; without splines the step is zero. The accuracy is
    /// that of [`LINEAR_SOLVE_ERROR`].
    ///
    /// The last factorisation of the spline matrix is used again if all dwell times that were free for it are free now.
    /// It is a good preconditioner if they are nearly all that are free now.
    pub fn step(
        &mut self,
        penalty: &Penalty,
        q: &[f64],
        free: &[bool],
        max_products: usize,
    ) -> (Vec<f64>, usize) {
        let Self { h, splines, .. } = self;
        let mut d = vec![0.0; q.len()];
        let Some(Splines { sums, nodes, coarse }) = splines else { return (d, 0) };
        let deflation = if coarse.is_of(penalty, free) {
            TwoLevel::again(nodes, coarse, penalty, free)
        } else {
            TwoLevel::new(nodes, coarse, (sums, &h.weight), penalty, &h.u, free)
        };
        let products = bounded::conjugate_gradients(
            &|t: &[f64]| h.product(penalty, t),
            &deflation,
            free,
            &mut d,
            &mut q.to_vec(),
            LINEAR_SOLVE_ERROR,
            max_products,
        );
        (d, products)
    }
}

/// Largest length of a column, in cells, that is represented by two places of the tool. In the cells of the two-level
/// method it is half the width of the TIF. Larger: the surrogate errs more for long segments. Smaller: more places, and
/// more time.
const MAX_CELLS_IN_TWO: f64 = 3.0;

/// Returns the axis of the samples, one at the first pixel of every cell of `size` pixels. The last sample is at the
/// last pixel or beyond it.
fn cell_axis(map: &Axis, size: usize) -> Result<Axis, Invalid> {
    let cells = (map.len() - 1).div_ceil(size) + 1;
    Axis::new(map.start_mm(), size as f64 * map.step_mm(), cells)
}

/// Returns two places of the tool instead of more, with the same mean, and the same variance in the direction in which
/// it is largest. The places stay as they are if there are at most two, if the column is longer than `longest_mm`, or
/// if their fractions do not sum to more than 0. For uniform motion along a line it is Gauss' rule: a wave of k rad/mm
/// loses the fraction `k^4 l^4 / 4320` on a length of l mm.
fn in_two(places: &[ToolPlace], longest_mm: f64) -> Vec<ToolPlace> {
    let total: f64 = places.iter().map(|p| p.fraction).sum();
    if places.len() <= 2 || length_mm(places) > longest_mm || total <= 0.0 {
        return places.to_vec();
    }
    let [x, y] = [0, 1].map(|k| mean(places, total, |p| p.position_mm[k]));
    let [xx, xy, yy] = [(0, 0), (0, 1), (1, 1)].map(|(a, b)| {
        mean(places, total, |p| (p.position_mm[a] - [x, y][a]) * (p.position_mm[b] - [x, y][b]))
    });
    // The larger eigenvalue of [xx xy; xy yy], and its direction.
    let angle = 0.5 * (2.0 * xy).atan2(xx - yy);
    let spread_mm = (0.5 * (xx + yy) + (0.25 * (xx - yy).powi(2) + xy * xy).sqrt()).sqrt();
    // That of the place in the middle: columns are short beside the bends of a path.
    let heading_rad = places[places.len() / 2].heading_rad;
    let both = [-1.0, 1.0].map(|sign| ToolPlace {
        heading_rad,
        position_mm: [x + sign * spread_mm * angle.cos(), y + sign * spread_mm * angle.sin()],
        fraction: 0.5 * total,
    });
    both.to_vec()
}

/// Returns the mean of `value` over places, weighted with their fractions; `total` is the sum of the fractions.
fn mean(places: &[ToolPlace], total: f64, value: impl Fn(&ToolPlace) -> f64) -> f64 {
    places.iter().map(|p| p.fraction * value(p)).sum::<f64>() / total
}

/// Returns the weights of the samples (W_c), shape `shape`, one sample at the first pixel of every cell of `size`
/// pixels. Every pixel shares its weight linearly between the samples around it. Weighted sums of anything that is
/// linear between the samples are the same as over the pixels.
fn on_cells(weight: &Array2<f64>, shape: (usize, usize), size: usize) -> Array2<f64> {
    let mut cells = Array2::<f64>::zeros(shape);
    for ((r, c), w) in weight.indexed_iter().filter(|(_, w)| **w > 0.0) {
        for (y, v) in shares(r, size) {
            for (x, u) in shares(c, size) {
                cells[[y, x]] += w * v * u;
            }
        }
    }
    cells
}

/// Returns the two cells that share a pixel along an axis, with their shares, which sum to 1.
fn shares(pixel: usize, size: usize) -> [(usize, f64); 2] {
    let below = pixel / size;
    let f = (pixel % size) as f64 / size as f64;
    // A pixel that is the first of a cell has nothing on the next one, which may not be there.
    [(below, 1.0 - f), (below + usize::from(f > 0.0), f)]
}

/// Samples the TIF at the pitch of the cells, with three more samples at either end. The spline through its samples
/// goes on there and falls to 0.27 per sample.
fn sampled(tif: &Tif, map: &Grid, size: usize) -> Result<Tif, Invalid> {
    let [x, y] = [(&tif.grid().x, &map.x), (&tif.grid().y, &map.y)].map(|(own, map)| {
        const BEYOND: usize = 3;
        let step = size as f64 * map.step_mm();
        let samples = ((own.end_mm() - own.start_mm()) / step).ceil() as usize + 1 + 2 * BEYOND;
        Axis::new(own.start_mm() - BEYOND as f64 * step, step, samples)
    });
    let grid = Grid { x: x?, y: y? };
    tif.with_kernels(|kernel| {
        let mut rate = Array2::zeros(grid.shape());
        parallel::consume(rate.outer_iter_mut(), &|r, mut row| {
            let y = grid.y.coordinate_mm(r);
            row.indexed_iter_mut()
                .for_each(|(c, v)| *v = kernel.rate_at(grid.x.coordinate_mm(c), y));
        });
        Ok((grid, rate))
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surrogate::{MAX_LOSS_TWO_LEVEL, cell_size};
    use planish_numerics::linear::skyline::dot;

    fn disk(n: usize, step_mm: f64) -> (Grid, Array2<f64>) {
        let axis = || Axis::new(-0.5 * (n - 1) as f64 * step_mm, step_mm, n).unwrap();
        let map = Grid { x: axis(), y: axis() };
        let edge_mm = map.x.end_mm() + 0.3 * step_mm;
        let inside = |(r, c)| {
            f64::from(u8::from(map.x.coordinate_mm(c).hypot(map.y.coordinate_mm(r)) <= edge_mm))
        };
        (map, Array2::from_shape_fn(map.shape(), inside))
    }

    #[test]
    fn two_places_keep_the_mean_and_the_spread_of_more() {
        let along =
            |s: f64, fraction: f64| ToolPlace::new([3.0 + 0.4 * s, -1.0 + 0.3 * s], fraction);
        // Gauss' rule of three on a line of 0.5 mm
        let g = 0.6_f64.sqrt();
        let three =
            [along(-0.5 * g, 5.0 / 18.0), along(0.0, 8.0 / 18.0), along(0.5 * g, 5.0 / 18.0)];
        let [a, b] = in_two(&three, 0.4).try_into().unwrap();
        let two = 0.5 / 3.0_f64.sqrt();
        for (found, expected) in [(a, along(-two, 0.5)), (b, along(two, 0.5))] {
            let apart = (0..2).map(|k| (found.position_mm[k] - expected.position_mm[k]).abs());
            // Rounding of positions of 3 mm.
            assert!(apart.fold(0.0, f64::max) < 1e-14 && found.fraction == 0.5, "{found:?}");
        }
        // Farther apart than they may be, or two already.
        assert_eq!(in_two(&three, 0.2), three);
        assert_eq!(in_two(&three[..2], 9.0), three[..2]);
        // Around a corner: the largest spread is across the bisector.
        let at = |x: f64, y: f64| ToolPlace::new([x, y], 0.25);
        let corner = [at(-0.2, 0.0), at(-0.1, 0.0), at(0.0, 0.1), at(0.0, 0.2)];
        let [a, b] = in_two(&corner, 1.0).try_into().unwrap();
        let d = [0, 1].map(|k| b.position_mm[k] - a.position_mm[k]);
        // Below: rounding of positions of the order 0.1 mm, and of a root.
        assert!((d[0] - d[1]).abs() < 1e-14 && d[0] > 0.0, "{d:?}");
        let variance = corner.iter().map(|p| {
            0.25 * ((p.position_mm[0] + 0.075) + (p.position_mm[1] - 0.075)).powi(2) / 2.0
        });
        assert!((d[0].hypot(d[1]) / 2.0 - variance.sum::<f64>().sqrt()).abs() < 1e-14);
    }

    #[test]
    fn sums_over_cells_of_what_is_linear_are_those_over_pixels() {
        let (map, mut weight) = disk(53, 0.1);
        weight[[20, 31]] = 0.0;
        weight[[4, 26]] = 2.5;
        for size in [1, 2, 3, 7, 60] {
            let cells = (map.x.len() - 1).div_ceil(size) + 1;
            let found = on_cells(&weight, (cells, cells), size);
            assert!(found.iter().all(|w| *w >= 0.0));
            for [of_1, of_x, of_y] in [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]] {
                let sum = |w: &Array2<f64>, size: usize| -> f64 {
                    let value = |r: usize, c: usize| {
                        of_1 + size as f64 * (of_x * c as f64 + of_y * r as f64)
                    };
                    w.indexed_iter().map(|((r, c), w)| w * value(r, c)).sum()
                };
                let (found, expected) = (sum(&found, size), sum(&weight, 1));
                // Rounding of sums over 3e3 pixels, relative.
                assert!((found / expected - 1.0).abs() < 1e-13, "{size}: {found} {expected}");
            }
        }
    }

    #[test]
    fn what_the_tif_hardly_resolves_has_its_energy_on_cells_too() {
        let (map, weight) = disk(301, 0.05);
        // sigma 1 mm
        let axis = || Axis::new(-5.5, 0.05, 221).unwrap();
        let own = Grid { x: axis(), y: axis() };
        let bell = |(r, c)| {
            (-0.5 * (own.x.coordinate_mm(c).powi(2) + own.y.coordinate_mm(r).powi(2))).exp()
        };
        let tif = Tif::new(own, Array2::from_shape_fn(own.shape(), bell)).unwrap();
        let places: Vec<Vec<ToolPlace>> = (0..21 * 21)
            .map(|j| {
                let at = |k: usize| 0.4 * k as f64 - 4.0;
                vec![ToolPlace::new([at(j % 21), at(j / 21)], 1.0)]
            })
            .collect();
        let reached = vec![true; places.len()];
        let size = cell_size(&tif, &map, MAX_LOSS_TWO_LEVEL);
        assert!(size >= 2);
        let h = Convolved::new(&places, &reached, &tif, &map, &weight, Free::Piston, (size, None))
            .unwrap();
        let exact = FftOperator::new(&places, &tif, &map);
        for k_per_mm in [0.0, 1.0, 2.0, 3.0] {
            // A wave of which the TIF passes exp(-k^2) of the energy; no piston in it.
            let t: Vec<f64> = (places.iter())
                .map(|p| 1.0 + (k_per_mm * p[0].position_mm[0] + 0.3).sin())
                .map(|t| if k_per_mm > 0.0 { t - 1.0 } else { t })
                .collect();
            let energy = |b: &FftOperator, w: &Array2<f64>| {
                let b_t = b.apply(&t);
                dot(&t, &b.adjoint(&(&b_t * w)))
            };
            let (found, expected) = (energy(&h.h.b, &h.h.weight), energy(&exact, &weight));
            // Nothing reaches the rim, and at 3 /mm the splines lose 1e-4. Means over cells lose 2 %.
            assert!((found / expected - 1.0).abs() < 1e-3, "{k_per_mm}: {found} {expected}");
        }
    }
}
