//! The surrogate as an operator: too many dwell points for a matrix, which grows with their square over the width
//! of the TIF, while a product by FFT grows with the number of cells.

use ndarray::{Array2, Zip};
use planish_numerics::qp::bounded::{self, DESCENT_STEPS, GradientSettings, ProductSettings};
use planish_types::{Axis, Grid, Invalid, Tif};

use super::{
    resolution::{are_short, length_mm},
    two_level::{Coarse, Nodes, TwoLevel},
};
use crate::{
    model::{
        columns::Place,
        fft_operator::{FftOperator, Sums},
    },
    objective::{Basis, Free, Penalty},
};

/// Most sets of free dwell times in a step; measured problems take 2 to 12.
const MAX_ACTIVE_SETS: usize = 30;

/// Conjugate gradients end when they would gain this fraction of what they have gained, in the norm of H~.
const LINEAR_SOLVE_ERROR: f64 = 0.03;

/// H~ as an operator on the cells, with the TIF averaged over a cell.
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
    /// H~ for cells of `size` x `size` pixels; size 1 is exact. With a pitch of splines its minimum
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
            let longest = lengths.map(|(places, _)| length_mm(places)).fold(0.0, f64::max);
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
                inexact: LINEAR_SOLVE_ERROR,
                max_sets: MAX_ACTIVE_SETS,
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
            settings =
                GradientSettings { max_iterations: DESCENT_STEPS, stagnation: 0.0, ..settings };
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
