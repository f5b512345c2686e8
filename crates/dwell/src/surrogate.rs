//! Cheap surrogates of the normal matrix of [`crate::bounded_least_squares`], by which its steps
//! are made. What they cost in accuracy is corrected by the exact gradient.
//!
//! The pixels of every cell of s x s are taken together,
//!
//! ```text
//! H~ = B' W^1/2 P W^1/2 B - U U',     P: mean over every cell, weighted                  (1)
//! ```
//!
//! which loses `s^2 h^2 / 12 <|grad R|^2> / <R^2>` of the energy of a column of pixels h: s is the
//! largest at which a given part is lost. U is exact: a mean over cells keeps sums.

use ndarray::{Array2, Zip};
use planish_numerics::{
    linear::skyline::Skyline,
    qp::bounded::{self, End, GradientSettings, ProductSettings, Quadratic},
};
use planish_types::{Axis, Grid, Invalid, Tif};

use crate::{
    bounded_least_squares::{Basis, Free, Penalty},
    columns::{Patch, Place},
    fft_operator::{FftOperator, Sums},
    two_level::{self, Coarse, Nodes, TwoLevel},
};

/// Part of the energy of the TIF that (1) may lose: where H~ is factorised, where it is solved by
/// [`TwoLevel`] for dwell points so dense that what they cannot remove decides, and where products
/// with it are what costs.
pub const LOSS: f64 = 5e-3;
pub const LOSS_TWO_LEVEL: f64 = 1.3e-3;
pub const LOSS_GRADIENT: f64 = 2e-2;

/// Pitch of the splines of [`two_level`], over the width of the TIF `(<R^2> / <|grad R|^2>)^1/2` (sigma
/// of a Gaussian). By the time that problems took.
const SPLINE_PITCH: f64 = 0.7;

/// Least pitch over the mean spacing of the columns: many more splines than columns are dependent, and
/// their matrix is singular to rounding.
const SPACINGS: f64 = 1.5;

/// Most elements of the matrix of the splines (three copies of 120 MB), and of their patches (200 MB).
const MOST_ELEMENTS: f64 = 1.5e7;
const MOST_PATCHED: f64 = 2.5e7;

/// A step takes 2 to 12 sets of free dwell times on measured problems, and conjugate gradients end
/// when they would gain this fraction of what they gained, in the norm of H~.
const SETS: usize = 30;
const INEXACT: f64 = 0.03;

/// The active set method takes 10 to 20 factorisations on measured problems. More means that it
/// cycles: [`SOME`] from any start, [`MOST`] from a good one.
const SOME: usize = 30;
const MOST: usize = 100;

/// A step of H~ on cells that lowers its natural residual to this part is enough: the exact gradient
/// corrects by more than that.
const ENOUGH: f64 = 0.02;

/// Largest cell.
const LARGEST: usize = 16;

/// Pixels of the map along the side of a cell.
pub fn cell_size(tif: &Tif, map: &Grid, most: f64) -> usize {
    let [along_x, along_y] = slopes(tif);
    let (hx, hy) = (map.x.step_mm(), map.y.step_mm());
    let loss = |s: usize| (s * s) as f64 * (hx * hx * along_x + hy * hy * along_y) / 12.0;
    (2..=LARGEST).rev().find(|s| loss(*s) <= most).unwrap_or(1)
}

/// `<R_x^2> / <R^2>` and `<R_y^2> / <R^2>`, 1/mm^2.
fn slopes(tif: &Tif) -> [f64; 2] {
    let (rate, grid) = (tif.rate_nm_per_s(), tif.grid());
    let energy: f64 = rate.iter().map(|r| r * r).sum();
    // sum of (difference / step)^2 along both axes
    let slope = |a: &f64, b: &f64, step: f64| ((a - b) / step).powi(2);
    let (mut along_x, mut along_y) = (0.0, 0.0);
    for row in rate.rows() {
        along_x +=
            row.windows(2).into_iter().map(|w| slope(&w[0], &w[1], grid.x.step_mm())).sum::<f64>();
    }
    for column in rate.columns() {
        along_y += column
            .windows(2)
            .into_iter()
            .map(|w| slope(&w[0], &w[1], grid.y.step_mm()))
            .sum::<f64>();
    }
    [along_x, along_y].map(|slope| slope / energy)
}

/// Largest extent of the places of a column along an axis, mm.
fn length(places: &[Place]) -> f64 {
    let (low, high) = two_level::extent(places.iter().map(|p| &p.position_mm));
    (high[0] - low[0]).max(high[1] - low[1]).max(0.0)
}

/// Reached columns that a spline of this pitch can be made of.
fn are_short(places: &[Vec<Place>], reached: &[bool], pitch_mm: f64) -> Vec<bool> {
    places
        .iter()
        .zip(reached)
        .map(|(places, reached)| *reached && length(places) <= 2.0 * pitch_mm)
        .collect()
}

/// Pitch of splines that can say what the TIF resolves, mm; none where most columns are longer, or
/// where their matrix would be too large, which depends on the area under the reached columns, not on
/// their number.
pub fn spline_pitch(
    places: &[Vec<Place>],
    reached: &[bool],
    tif: &Tif,
    map: &Grid,
    cell: usize,
) -> Option<f64> {
    let [along_x, along_y] = slopes(tif);
    let of_reached =
        places.iter().zip(reached).filter(|(_, reached)| **reached).flat_map(|(p, _)| p);
    let (low, high) = two_level::extent(of_reached.map(|p| &p.position_mm));
    let size_mm = [high[0] - low[0], high[1] - low[1]];
    let count = |of: &[bool]| of.iter().filter(|of| **of).count();
    let spacing = (size_mm[0] * size_mm[1] / count(reached) as f64).sqrt();
    let pitch = (SPLINE_PITCH / (along_x + along_y).sqrt()).max(SPACINGS * spacing);
    let wide = |axis: &Axis| axis.end_mm() - axis.start_mm();
    let reach = [&tif.grid().x, &tif.grid().y].map(|axis| wide(axis) + 4.0 * pitch);
    let (nodes, row) = Nodes::size(size_mm, reach, pitch);
    let cells = |k: usize, step: f64| reach[k] / (cell as f64 * step) + 4.0;
    let patched = nodes * cells(0, map.x.step_mm()) * cells(1, map.y.step_mm());
    let dense = count(&are_short(places, reached, pitch)) * 2 > count(reached);
    (dense && nodes * row <= MOST_ELEMENTS && patched <= MOST_PATCHED).then_some(pitch)
}

/// The columns in an order in which H~ has a small skyline.
pub struct Ordered {
    /// Column of every row of H~; unreached ones are not among them.
    order: Vec<usize>,
    /// (1) with room for the couplings of the penalty.
    data: Quadratic,
    /// Part of the natural residual that a step may leave.
    enough: f64,
}

impl Ordered {
    /// (1) of the columns on the cells; `exact` when these are pixels.
    pub fn new(
        cells: &[Patch],
        u: &[Vec<f64>],
        reached: &[bool],
        penalty: &Penalty,
        exact: bool,
    ) -> Self {
        let along = |axis: usize| {
            let centre = |j: &usize| {
                let ((r, c), (ny, nx)) = (cells[*j].origin, cells[*j].rate_nm_per_s.dim());
                [2 * c + nx, 2 * r + ny][axis]
            };
            let mut order: Vec<usize> = (0..reached.len()).filter(|j| reached[*j]).collect();
            order.sort_by_key(centre);
            let first = first_columns(cells, &order, penalty);
            let elements: usize = first.iter().enumerate().map(|(i, f)| i + 1 - f).sum();
            (elements, order, first)
        };
        let (x, y) = (along(0), along(1));
        let (_, order, first) = if x.0 <= y.0 { x } else { y };

        let mut k = Skyline::zeros(first.clone());
        k.fill(|i, row| {
            for (v, l) in row.iter_mut().zip(&order[first[i]..]) {
                *v = cells[order[i]].dot(&cells[*l]);
            }
        });
        let u = u.iter().map(|u| order.iter().map(|j| u[*j]).collect()).collect();
        Self { order, data: Quadratic { k, u }, enough: if exact { 0.0 } else { ENOUGH } }
    }

    /// H~ and the penalty.
    pub fn penalised(&self, penalty: &Penalty) -> Penalised<'_> {
        let mut rows = vec![None; penalty.len()];
        for (i, j) in self.order.iter().enumerate() {
            rows[*j] = Some(i);
        }
        let mut h = self.data.clone();
        penalty.for_each(|j, k, v| {
            if let (Some(i), Some(l)) = (rows[j], rows[k]) {
                h.k.add(i.max(l), i.min(l), v);
            }
        });
        Penalised { order: &self.order, h, enough: self.enough }
    }
}

/// First coupled column of every row.
fn first_columns(cells: &[Patch], order: &[usize], penalty: &Penalty) -> Vec<usize> {
    let mut first: Vec<usize> = (0..order.len())
        .map(|i| {
            let own = &cells[order[i]];
            (0..i).find(|l| cells[order[*l]].overlaps(own)).unwrap_or(i)
        })
        .collect();
    let mut rows = vec![None; penalty.len()];
    for (i, j) in order.iter().enumerate() {
        rows[*j] = Some(i);
    }
    penalty.for_each(|j, k, _| {
        if let (Some(i), Some(l)) = (rows[j], rows[k]) {
            first[i.max(l)] = first[i.max(l)].min(i.min(l));
        }
    });
    first
}

/// [`Ordered`] with its penalty.
pub struct Penalised<'a> {
    order: &'a [usize],
    h: Quadratic,
    enough: f64,
}

impl Penalised<'_> {
    /// The minimum of `q'd + d'H~d / 2` within the bounds, `d` from `t`, and the factorisations.
    /// `None` when H~ is not positive definite.
    pub fn minimum(
        &self,
        t: &[f64],
        q: &[f64],
        lo: &[f64],
        hi: &[f64],
    ) -> Option<(Vec<f64>, usize)> {
        let pick = |a: &[f64]| -> Vec<f64> { self.order.iter().map(|j| a[*j]).collect() };
        let start = pick(t);
        let g: Vec<f64> = self.h.product(&start).iter().zip(pick(q)).map(|(h, q)| h - q).collect();
        let (lo, hi) = (pick(lo), pick(hi));
        let before = bounded::natural_residual(&start, &pick(q), &self.h.diagonal(), &lo, &hi);
        let enough = self.enough * before;
        let mut found = bounded::active_set(&self.h, &g, &lo, &hi, &start, enough, SOME)?;
        if found.end != End::Optimal {
            // Nearly singular: gradient steps find most of the active set, or descend at least.
            let steps = GradientSettings {
                tolerance: 0.0,
                max_iterations: 300,
                stagnation: 0.0,
                offset: 0.0,
            };
            let apply = |t: &[f64]| self.h.product(t);
            let diagonal = self.h.diagonal();
            let near = bounded::projected_gradient(apply, &diagonal, &g, &lo, &hi, &start, &steps);
            let second = bounded::active_set(&self.h, &g, &lo, &hi, &near.value, enough, MOST)?;
            let iterations = found.iterations + second.iterations;
            found = if second.end == End::Optimal { second } else { near };
            found.iterations = iterations;
        }
        let mut to = t.to_vec();
        for (j, v) in self.order.iter().zip(found.value) {
            to[*j] = v;
        }
        Some((to, found.iterations))
    }
}

/// (1) as an operator on the cells, with the TIF averaged over a cell.
pub struct Convolved {
    b: FftOperator,
    weight: Array2<f64>,
    u: Vec<Vec<f64>>,
    diagonal: Vec<f64>,
    splines: Option<Splines>,
}

/// What [`TwoLevel`] needs.
struct Splines {
    sums: Sums,
    nodes: Nodes,
    coarse: Coarse,
}

impl Convolved {
    /// (1) for cells of `size` x `size` pixels; size 1 is exact. With a pitch of splines its minimum
    /// is found by them and an active set, without by gradient steps.
    pub fn new(
        places: &[Vec<Place>],
        reached: &[bool],
        tif: &Tif,
        map: &Grid,
        weight: &Array2<f64>,
        free: Free,
        (size, spline_pitch_mm): (usize, Option<f64>),
    ) -> Result<Self, Invalid> {
        let axis = |a: &Axis| {
            let s = size as f64;
            let start = a.start_mm() + 0.5 * (s - 1.0) * a.step_mm();
            Axis::new(start, s * a.step_mm(), a.len().div_ceil(size).max(2))
        };
        let grid = Grid { x: axis(&map.x)?, y: axis(&map.y)? };
        let mut cells = Array2::<f64>::zeros(grid.shape());
        for ((r, c), w) in weight.indexed_iter() {
            cells[[r / size, c / size]] += w;
        }
        let tif = if size == 1 { tif.clone() } else { averaged(tif, map, size)? };
        let b = FftOperator::without_border(places, &tif, &grid);
        let basis = Basis::new(&grid, &cells, free);
        let u = basis.columns(&cells, |m| b.adjoint(m));
        let mut diagonal = b.adjoint_of_squared_tif(&cells);
        for u in &u {
            diagonal.iter_mut().zip(u).for_each(|(d, u)| *d -= u * u);
        }
        let splines = spline_pitch_mm.map(|pitch| {
            let short = are_short(places, reached, pitch);
            let lengths = places.iter().zip(&short).filter(|(_, short)| **short);
            let longest = lengths.map(|(places, _)| length(places)).fold(0.0, f64::max);
            // What is under a spline has its centre there.
            let sums = Sums::new(places, &tif, &grid, 4.0 * pitch + 2.0 * longest);
            let nodes = Nodes::new(places, &short, pitch);
            let coarse = Coarse::new(&nodes, &sums, &short);
            Splines { sums, nodes, coarse }
        });
        Ok(Self { b, weight: cells, u, diagonal, splines })
    }

    /// The minimum of `q'd + d'H~d / 2` within the bounds, `d` from `t`, and the products or
    /// gradient steps. Components that are not reached stay.
    pub fn minimum(
        &mut self,
        penalty: &Penalty,
        t: &[f64],
        q: &[f64],
        reached: &[bool],
        bounds: (&[f64], &[f64]),
        settings: &GradientSettings,
    ) -> (Vec<f64>, usize) {
        let Self { b, weight, u: free_part, diagonal: data, splines } = self;
        let (weight, free_part) = (&*weight, &*free_part);
        let apply = |t: &[f64]| {
            let mut h_t = b.adjoint(&(b.apply(t) * weight));
            for u in free_part {
                let c: f64 = u.iter().zip(t).map(|(u, t)| u * t).sum();
                h_t.iter_mut().zip(u).for_each(|(h, u)| *h -= u * c);
            }
            penalty.add_product(t, &mut h_t);
            h_t
        };
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
            let deflation = |free: &[bool]| {
                TwoLevel::new(nodes, coarse, (sums, weight), penalty, free_part, free)
            };
            let products = ProductSettings {
                enough: settings.tolerance,
                inexact: INEXACT,
                max_sets: SETS,
                max_products: settings.max_iterations,
            };
            let bounds = (lo.as_slice(), bounds.1);
            let found = bounded::active_set_by_products(
                apply, deflation, &diagonal, &g, bounds, t, &products,
            );
            if found.value != t {
                return (found.value, found.iterations);
            }
            // No set was better: gradient steps descend at least.
            settings = GradientSettings { max_iterations: 300, stagnation: 0.0, ..settings };
        }
        // The offset is that of the objective at t.
        let own: f64 = (0..t.len()).map(|j| t[j] * (0.5 * h_t[j] - g[j])).sum();
        let settings = GradientSettings { offset: settings.offset - own, ..settings };
        let found = bounded::projected_gradient(apply, &diagonal, &g, &lo, bounds.1, t, &settings);
        (found.value, found.iterations)
    }
}

/// The TIF averaged over cells of the map, sampled at their pitch.
fn averaged(tif: &Tif, map: &Grid, size: usize) -> Result<Tif, Invalid> {
    let axis = |own: &Axis, map: &Axis| {
        let step = size as f64 * map.step_mm();
        let samples = ((own.end_mm() - own.start_mm()) / step).ceil() as usize + 3;
        Axis::new(own.start_mm() - step, step, samples)
    };
    let grid = Grid { x: axis(&tif.grid().x, &map.x)?, y: axis(&tif.grid().y, &map.y)? };
    let within = |map: &Axis| -> Vec<f64> {
        (0..size).map(|k| (k as f64 - 0.5 * (size as f64 - 1.0)) * map.step_mm()).collect()
    };
    let (x, y) = (within(&map.x), within(&map.y));
    let mut rate = Array2::zeros(grid.shape());
    Zip::indexed(&mut rate).par_for_each(|(r, c), v| {
        for dy in &y {
            for dx in &x {
                *v += tif.rate_at(grid.x.at(c) + dx, grid.y.at(r) + dy);
            }
        }
        *v /= (size * size) as f64;
    });
    Tif::new(grid, rate)
}
