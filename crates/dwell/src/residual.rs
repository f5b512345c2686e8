//! The residual as a function of the times spent at given places of the tool, for methods whose unknowns are not dwell
//! times, and whose constraints are not bounds.
//!
//! ```text
//! f(t) = 1/2 sum_i w_i e_i^2 / sum_i w_i,   e = z - B t without its free part       nm^2       (1)
//! gradient = -B' w e / sum_i w_i                                                    nm^2/s
//! ```
//!
//! f is half the mean square of the residual. The places are fixed when the function is made; how the times depend on
//! the unknowns (a density along a curve, for example) is up to the method. A [`Normal`] is the normal matrix for
//! columns that are sums over places. It is computed on cells of pixels, as in [`crate::bounded_least_squares`],
//! because the exact gradient corrects the steps that it gives. C projects a map on those that are the same on all
//! pixels of a cell, and Q on the free functions (piston or plane). Then it is
//!
//! ```text
//! B' w^1/2 C (1 - Q) C w^1/2 B  <=  B' w^1/2 (1 - Q) w^1/2 B,   the curvature of f                (2)
//! ```
//!
//! The inequality holds if C Q = Q, that is, if the free functions are the same on all pixels of a cell: for a piston,
//! but not for a plane. Then (2) gives an upper bound of the distance of f from its minimum, if both sides have the
//! same B. This is not so if TIF and map have different pitches and the operator of f resamples the TIF. The left side
//! has no negative eigenvalue in any case.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | z | `desired` | (ny, nx) | nm |
//! | B | `operator` | (pixels, n) | nm/s |
//! | t | `time_s` | (n) | s |

use std::borrow::Cow;

use ndarray::{Array2, Zip};
use planish_numerics::{linear::skyline::Skyline, parallel, qp::bounded::Quadratic};
use planish_types::{Invalid, PARTS_TOLERANCE, Surface, Tif, budget};

pub use crate::objective::Free;
use crate::{
    DwellError,
    bounds::pixel_weights,
    columns::{self, Patch, ToolPlace},
    model::{FFT_ROUNDING, operator::Operator, products::Order},
    objective::Basis,
    surrogate::{MAX_LOSS_FACTORISED, cell_size},
};

/// Half the mean square of the residual, (1) of the module, as a function of the times at fixed places of the tool.
pub struct Residual<'a> {
    desired: &'a Surface,
    tif: Cow<'a, Tif>,
    /// Places of the tool; their fractions are factors of the removal rate.
    places: Vec<ToolPlace>,
    /// Weights of the pixels (ny, nx); their sum is 1.
    weight: Array2<f64>,
    free: Free,
    basis: Basis,
    operator: Operator,
    cell_size: usize,
}

/// Value and gradient of (1) of the module at some times.
#[derive(Clone, Debug, PartialEq)]
pub struct Evaluation {
    /// Half the mean square f of the residual, nm^2.
    pub half_mean_square_nm2: f64,
    /// Derivatives of f by the times at the places (n), nm^2/s.
    pub gradient_nm2_per_s: Vec<f64>,
}

impl<'a> Residual<'a> {
    /// Makes the function for a desired removal, a tool, and its positions `places_mm` (n) as [x, y]. Without weights
    /// they follow from the standard deviations of the map, if it has any; otherwise every valid pixel counts the same.
    ///
    /// # Errors
    /// Refuses weights as the solvers do, a TIF that cannot be sampled on the lattice of the map or covers too many
    /// pixels, and places from which the tool does not reach the map.
    pub fn new(
        desired: &'a Surface,
        tif: &'a Tif,
        places_mm: &'a [[f64; 2]],
        weight: Option<&Array2<f64>>,
        free: Free,
    ) -> Result<Self, DwellError> {
        let places = places_mm.iter().map(|p| ToolPlace::new(*p, 1.0)).collect();
        Self::at_places(desired, tif, places, weight, free)
    }

    /// Makes the function for places with their directions of motion; the fraction of a place is a factor of the
    /// removal rate there.
    ///
    /// # Errors
    /// Refuses what [`Self::new`] refuses.
    pub fn at_places(
        desired: &'a Surface,
        tif: &'a Tif,
        places: Vec<ToolPlace>,
        weight: Option<&Array2<f64>>,
        free: Free,
    ) -> Result<Self, DwellError> {
        let tif = tif.on_lattice_of(desired.grid(), PARTS_TOLERANCE)?.tif;
        let mut weight = pixel_weights(desired, weight)?;
        weight /= weight.sum();
        let columns: Vec<Vec<ToolPlace>> = places.iter().map(|place| vec![*place]).collect();
        let operator = Operator::new(&columns, &tif, desired.grid())?;
        let largest = operator.adjoint(&weight).into_iter().fold(0.0, f64::max);
        if largest <= FFT_ROUNDING * tif.peak_nm_per_s() {
            return Err(DwellError::OutOfReach { points: places.len() });
        }
        let basis = Basis::new(desired.grid(), &weight, free);
        let cell_size = cell_size(&tif, desired.grid(), MAX_LOSS_FACTORISED);
        Ok(Self { desired, tif, places, weight, free, basis, operator, cell_size })
    }

    /// Limits the side of the cells of the normal matrices to `pixels` pixels.
    pub fn on_cells_of_at_most(self, pixels: usize) -> Self {
        Self { cell_size: self.cell_size.min(pixels), ..self }
    }

    /// Returns the number of pixels along the side of a cell of the normal matrices.
    pub fn cell_size(&self) -> usize {
        self.cell_size
    }

    /// Returns half the mean square f of the residual and its gradient, for the times at the places (n), s.
    pub fn evaluate(&self, time_s: &[f64]) -> Evaluation {
        self.evaluate_removal(&self.removal_nm(time_s))
    }

    /// Returns the removal B t, shape (ny, nx), nm, for the times at the places (n), s.
    pub fn removal_nm(&self, time_s: &[f64]) -> Array2<f64> {
        self.operator.apply(time_s)
    }

    /// Returns half the mean square f of the residual and its gradient, for a removal (ny, nx), nm, in place of B t.
    /// The gradient is by the times at the places.
    pub fn evaluate_removal(&self, removal_nm: &Array2<f64>) -> Evaluation {
        let mut r = Zip::from(self.desired.height_nm())
            .and(removal_nm)
            .and(&self.weight)
            .map_collect(|z, b, w| if *w > 0.0 { z - b } else { 0.0 });
        self.basis.project(&self.weight, &mut r);
        let square = Zip::from(&r).and(&self.weight).fold(0.0, |sum, r, w| sum + w * r * r);
        let mut gradient = self.operator.adjoint(&(&r * &self.weight));
        gradient.iter_mut().for_each(|g| *g = -*g);
        Evaluation { half_mean_square_nm2: 0.5 * square, gradient_nm2_per_s: gradient }
    }

    /// Returns the product of the matrix of the second derivatives of f with some times at the places (n), s: the
    /// change of the gradient (n), nm^2/s.
    pub fn curvature(&self, time_s: &[f64]) -> Vec<f64> {
        let mut r = self.removal_nm(time_s);
        self.basis.project(&self.weight, &mut r);
        self.operator.adjoint(&(&r * &self.weight))
    }

    /// Returns the weighted mean of the removal over the pixels, nm, for the times at the places (n), s.
    pub fn mean_removal_nm(&self, time_s: &[f64]) -> f64 {
        (&self.removal_nm(time_s) * &self.weight).sum()
    }

    /// Returns the normal matrix (2) of the module for m columns. Each column is a sum of places, given as pairs (index
    /// of the place, time per unit of the unknown). The matrix stores an element for every column and the next one,
    /// too, so that a caller can add to it.
    ///
    /// Parts that are `known` from another matrix of the same [`Residual`] are not computed again.
    ///
    /// # Errors
    /// Refuses a matrix beyond the memory budget.
    pub fn normal(
        &self,
        columns: &[Vec<(usize, f64)>],
        known: Option<Known>,
    ) -> Result<Normal, Invalid> {
        let places: Vec<Vec<ToolPlace>> =
            columns.iter().map(|column| self.timed_places(column)).collect();
        let mut known = known.unwrap_or_else(|| Known::nothing(columns.len()));
        let cells = self.on_cells(&places, &mut known);
        let position_mm = [0, 1].map(|axis| positions_mm(&places, axis));
        let all: Vec<usize> = (0..places.len()).collect();
        let pairs: Vec<(usize, usize)> = (1..places.len()).map(|j| (j - 1, j)).collect();
        let ordered = Order::new(&all, &cells, |axis, j| position_mm[axis][j], &pairs);
        budget::affordable(
            "tool_path",
            // The matrix, and the copy that is factorised.
            2.0 * ordered.elements as f64,
            size_of::<f64>(),
            "give a path of fewer nodes: wider lines, or a larger spacing of the nodes",
        )?;
        let rows: Vec<Option<KnownRow>> = ordered.order.iter().map(|j| known.row(*j)).collect();
        let k = ordered.products(&cells, |i, l| rows[i].as_ref()?.coupling(ordered.order[l]));
        let order = ordered.order;
        // U = B' w^1/2 C w^1/2 f of the free functions f
        let size = self.cell_size;
        let u = self.basis.columns(&self.weight, |m| {
            let m = columns::map_on_cells(m, &self.weight, size);
            parallel::map(order.len(), &|k| cells[order[k]].product(&m))
        });
        let exact = self.operator.is_exact(&self.tif, self.desired.grid());
        let below_curvature = exact && self.free == Free::Piston;
        Ok(Normal { order, matrix: Quadratic { k, u }, below_curvature, cells })
    }

    /// Returns the places of a column given as pairs (index, time), with their fractions multiplied by the times.
    fn timed_places(&self, column: &[(usize, f64)]) -> Vec<ToolPlace> {
        let timed = column.iter().map(|(index, time)| {
            let place = self.places[*index];
            ToolPlace { fraction: place.fraction * time, ..place }
        });
        timed.collect()
    }

    /// Returns the removal of every column on cells of pixels; takes that of known columns out of `known`.
    fn on_cells(&self, places: &[Vec<ToolPlace>], known: &mut Known) -> Vec<Patch> {
        let grid = self.desired.grid();
        let new = places.iter().zip(&known.column).filter(|(_, before)| before.is_none());
        let new: Vec<Vec<ToolPlace>> = new.map(|(places, _)| places.clone()).collect();
        let size = self.cell_size;
        let mut made = columns::on_cells(&new, &self.tif, grid, &self.weight, size).into_iter();
        let columns = known.column.iter().map(|before| match before {
            Some(j) => std::mem::take(&mut known.cells[*j]),
            None => made.next().expect("one for every new column"),
        });
        columns.collect()
    }
}

/// Parts of an earlier normal matrix that are used again for a new one, see [`Normal::for_next`].
pub struct Known {
    /// For every new column, the index of the equal column of the earlier matrix; `None` if there is none.
    column: Vec<Option<usize>>,
    /// Row of every column in the earlier matrix.
    row_of: Vec<usize>,
    k: Skyline,
    cells: Vec<Patch>,
}

impl Known {
    fn nothing(columns: usize) -> Self {
        let k = Skyline::zeros(Vec::new());
        Self { column: vec![None; columns], row_of: Vec::new(), k, cells: Vec::new() }
    }

    /// Returns the row of the earlier matrix for a new column; `None` if the column has no equal there.
    fn row(&self, column: usize) -> Option<KnownRow<'_>> {
        let row = self.row_of[self.column[column]?];
        Some(KnownRow { known: self, row, first: self.k.first(row), elements: self.k.row(row) })
    }
}

/// A row of the earlier normal matrix, for a known column.
struct KnownRow<'a> {
    known: &'a Known,
    row: usize,
    first: usize,
    elements: &'a [f64],
}

impl KnownRow<'_> {
    /// Returns the element of the earlier matrix for this column and another new column; `None` if the other one has no
    /// equal there.
    fn coupling(&self, column: usize) -> Option<f64> {
        let Known { column: before, row_of, k, .. } = self.known;
        let other = row_of[before[column]?];
        // Both matrices have nearly the same order, so the other one is nearly always before this one.
        if (self.first..=self.row).contains(&other) {
            Some(self.elements[other - self.first])
        } else {
            Some(k.element(self.row.max(other), self.row.min(other)))
        }
    }
}

/// The normal matrix of some columns, in an order in which it has few stored elements.
#[derive(Clone, Debug)]
pub struct Normal {
    /// Index of the column for every row of the matrix.
    pub order: Vec<usize>,
    /// The matrix: second derivatives of f, nm^2 per square of the unit of the columns.
    pub matrix: Quadratic,
    /// True if inequality (2) of the module holds: the matrix is at most that of the second derivatives of f, so that
    /// it can prove bounds. This needs a free piston and an exact B.
    pub below_curvature: bool,
    /// Removal of every column on cells of pixels, for [`Normal::for_next`].
    cells: Vec<Patch>,
}

impl Normal {
    /// Returns the row of the matrix for every column.
    pub fn row_of(&self) -> Vec<usize> {
        let mut row_of = vec![0; self.order.len()];
        self.order.iter().enumerate().for_each(|(i, j)| row_of[*j] = i);
        row_of
    }

    /// Returns the parts that a next normal matrix can take from this one. `column` holds, for every column of the next
    /// matrix, the index of the equal column here; `None` if there is none.
    pub fn for_next(self, column: Vec<Option<usize>>) -> Known {
        Known { column, row_of: self.row_of(), k: self.matrix.k, cells: self.cells }
    }

    /// Returns the matrix without the parts that only [`Normal::for_next`] needs, to free their memory.
    pub fn as_last(self) -> Self {
        Self { cells: Vec::new(), ..self }
    }

    /// Returns the product of the matrix with a vector x (m), both in the order of the columns, not of the rows.
    pub fn product(&self, x: &[f64]) -> Vec<f64> {
        let by_rows: Vec<f64> = self.order.iter().map(|j| x[*j]).collect();
        let mut product = vec![0.0; x.len()];
        let rows = self.order.iter().zip(self.matrix.product(&by_rows));
        rows.for_each(|(j, v)| product[*j] = v);
        product
    }
}

/// Returns the mean positions of the columns along x (`axis` 0) or y (1), mm. A column without places gets the position
/// of its predecessor (0 if it is the first), so that the element for both lies near the diagonal.
fn positions_mm(columns: &[Vec<ToolPlace>], axis: usize) -> Vec<f64> {
    let mut positions: Vec<f64> = Vec::with_capacity(columns.len());
    for places in columns {
        let sum: f64 = places.iter().map(|p| p.position_mm[axis]).sum();
        let before = positions.last().copied().unwrap_or(0.0);
        positions.push(if places.is_empty() { before } else { sum / places.len() as f64 });
    }
    positions
}

#[cfg(test)]
mod tests {
    use super::*;
    use planish_numerics::linear::{skyline::dot, woodbury::Woodbury};
    use planish_types::{Axis, Grid};

    fn bell() -> Tif {
        bell_of(0.25)
    }

    fn bell_of(pitch_mm: f64) -> Tif {
        let own = Axis::new(-2.0, pitch_mm, (4.0 / pitch_mm).round() as usize + 1).unwrap();
        let g = Grid { x: own, y: own };
        let rate = Array2::from_shape_fn(g.shape(), |(r, c)| {
            10.0 * (-(g.x.coordinate_mm(c).powi(2) + 1.3 * g.y.coordinate_mm(r).powi(2)) / 0.8)
                .exp()
        });
        Tif::new(g, rate).unwrap()
    }

    fn mirror() -> Surface {
        let axis = |n: usize| Axis::new(0.0, 0.25, n).unwrap();
        let grid = Grid { x: axis(33), y: axis(21) };
        let z = Array2::from_shape_fn(grid.shape(), |(r, c)| match (r, c) {
            (3, 4) => f64::NAN,
            _ => 20.0 + (0.3 * c as f64).sin() * (0.4 * r as f64).cos(),
        });
        Surface::new(grid, z).unwrap()
    }

    #[test]
    fn the_gradient_is_that_of_the_value() {
        let (tif, desired) = (bell(), mirror());
        let places: Vec<[f64; 2]> =
            (0..12).map(|k| [0.7 * f64::from(k) - 0.2, 2.0 + (f64::from(k)).sin()]).collect();
        for free in [Free::Piston, Free::Plane] {
            let residual = Residual::new(&desired, &tif, &places, None, free).unwrap();
            let t: Vec<f64> = (0..12).map(|k| 0.1 + 0.01 * f64::from(k)).collect();
            let at = residual.evaluate(&t);
            for j in [0, 5, 11] {
                let value = |h: f64| {
                    let mut t = t.clone();
                    t[j] += h;
                    residual.evaluate(&t).half_mean_square_nm2
                };
                // Quadratic: the central difference is exact but for rounding, 1e-16 / 1e-3.
                let difference = (value(1e-3) - value(-1e-3)) / 2e-3;
                let error = (difference - at.gradient_nm2_per_s[j]).abs();
                assert!(error < 1e-10 * at.gradient_nm2_per_s[j].abs().max(1.0), "{free:?} {j}");
            }
        }
    }

    #[test]
    fn the_normal_matrix_is_the_curvature_of_the_value() {
        let (tif, desired) = (bell(), mirror());
        let places: Vec<[f64; 2]> = (0..9).map(|k| [f64::from(k), 2.5]).collect();
        let residual = Residual::new(&desired, &tif, &places, None, Free::Piston).unwrap();
        let columns: Vec<Vec<(usize, f64)>> =
            (0..8).map(|k| vec![(k, 0.5), (k + 1, 0.5)]).collect();
        let normal = residual.normal(&columns, None).unwrap();
        let d: Vec<f64> = (0..8).map(|k| f64::from(k % 3) - 0.7).collect();
        let mut t = vec![0.0; 9];
        for (k, d) in d.iter().enumerate() {
            t[k] += 0.5 * d;
            t[k + 1] += 0.5 * d;
        }
        let zero = residual.evaluate(&[0.0; 9]);
        let at = residual.evaluate(&t);
        let along: f64 = zero.gradient_nm2_per_s.iter().zip(&t).map(|(g, t)| g * t).sum();
        let curvature = 2.0 * (at.half_mean_square_nm2 - zero.half_mean_square_nm2 - along);
        let ordered: Vec<f64> = normal.order.iter().map(|j| d[*j]).collect();
        let found = dot(&normal.matrix.product(&ordered), &ordered);
        // The cells lose at most the stated fraction of the energy.
        assert!((found / curvature - 1.0).abs() < 2.0 * MAX_LOSS_FACTORISED, "{found} {curvature}");
    }

    #[test]
    fn the_normal_matrix_is_between_zero_and_the_curvature() {
        const N: usize = 600;
        // So many pixels under the TIF that some of them are taken together.
        let pitch_mm = 0.05;
        let tif = bell_of(pitch_mm);
        let axis = |n: usize| Axis::new(0.0, pitch_mm, n).unwrap();
        let grid = Grid { x: axis(161), y: axis(101) };
        let z = Array2::from_shape_fn(grid.shape(), |(r, c)| match (r, c) {
            (13, 24) => f64::NAN,
            _ => 20.0,
        });
        let desired = Surface::new(grid, z).unwrap();
        let places: Vec<[f64; 2]> =
            (0..N).map(|k| [k % 30, k / 30].map(|k| 0.4 * k as f64 - 1.5)).collect();
        let columns: Vec<Vec<(usize, f64)>> = (0..N).map(|k| vec![(k, 1.0)]).collect();
        for (free, below) in [(Free::Piston, true), (Free::Plane, false)] {
            let residual = Residual::new(&desired, &tif, &places, None, free).unwrap();
            assert!(residual.cell_size() > 1);
            let normal = residual.normal(&columns, None).unwrap();
            assert_eq!(normal.below_curvature, below);
            let Quadratic { k, u } = &normal.matrix;
            let strongest = normal.matrix.diagonal().into_iter().fold(0.0, f64::max);
            let zero = residual.evaluate(&[0.0; N]).gradient_nm2_per_s;
            for i in 0..40 {
                // From smooth to rough.
                let t: Vec<f64> = (0..N).map(|j| (0.08 * (i * j) as f64).cos()).collect();
                let gradient = residual.evaluate(&t).gradient_nm2_per_s;
                let moved: Vec<f64> = gradient.iter().zip(&zero).map(|(a, b)| a - b).collect();
                // Rounding of the convolutions, some 1e-16 of the largest products.
                let rounding = 1e-12 * N as f64 * strongest;
                // f is quadratic.
                for (found, moved) in residual.curvature(&t).iter().zip(&moved) {
                    assert!((found - moved).abs() < rounding, "{free:?} {i}: {found} {moved}");
                }
                let (found, curvature) = (dot(&normal.product(&t), &t), dot(&moved, &t));
                assert!(!below || found <= curvature + rounding, "{i}: {found} {curvature}");
                assert!(found >= -rounding, "{free:?} {i}: {found}");
            }
            // A little more than the normal matrix is positive definite.
            let mut more = k.clone();
            (0..N).for_each(|i| more.add(i, i, 1e-9 * strongest));
            let is_definite = |u: Vec<Vec<f64>>| {
                let factor = more.clone().factorise().unwrap();
                Woodbury::new(factor, &u).is_some()
            };
            assert!(is_definite(u.clone()), "{free:?}");
            // With the free functions on all pixels beside columns on cells it would not be.
            let on_pixels = residual.basis.columns(&residual.weight, |m| {
                let of_places = residual.operator.adjoint(m);
                normal.order.iter().map(|j| of_places[*j]).collect()
            });
            assert!(below || !is_definite(on_pixels));
        }
    }

    #[test]
    fn both_operators_are_exact_for_the_tool_on_the_lattice_of_the_map() {
        // Stored elements; too many to be stored, with pixels of another pitch than those of the TIF.
        let tif = bell();
        let places: Vec<[f64; 2]> = (0..80)
            .flat_map(|i| (0..80).map(move |j| [i, j].map(|k| 0.5 * f64::from(k))))
            .collect();
        let columns: Vec<Vec<(usize, f64)>> = vec![vec![(0, 1.0)], vec![(1, 1.0)]];
        for (pitch_mm, operator) in [(0.25, "columns"), (0.04, "fft")] {
            let axis = Axis::new(0.0, pitch_mm, (40.0 / pitch_mm) as usize).unwrap();
            let z = Array2::from_elem((axis.len(), axis.len()), 20.0);
            let desired = Surface::new(Grid { x: axis, y: axis }, z).unwrap();
            let residual = Residual::new(&desired, &tif, &places, None, Free::Piston).unwrap();
            assert_eq!(residual.operator.name(), operator);
            assert!(residual.normal(&columns, None).unwrap().below_curvature);
        }
    }

    #[test]
    fn what_is_known_of_columns_is_what_would_be_computed() {
        let (tif, desired) = (bell(), mirror());
        let places: Vec<[f64; 2]> =
            (0..15).map(|k| [0.55 * f64::from(k) - 0.3, 2.0 + f64::from(k % 4)]).collect();
        let residual = Residual::new(&desired, &tif, &places, None, Free::Plane).unwrap();
        let column = |k: usize| vec![(k, 0.3), (k + 1, 0.7)];
        let before: Vec<_> = (0..14).step_by(2).map(column).collect();
        // Every column between two others is new.
        let after: Vec<_> = (0..14).map(column).collect();
        let same = (0..14).map(|k| (k % 2 == 0).then_some(k / 2)).collect();
        let known = residual.normal(&before, None).unwrap().for_next(same);
        let found = residual.normal(&after, Some(known)).unwrap();
        let expected = residual.normal(&after, None).unwrap();
        assert_eq!(found.order, expected.order);
        for j in 0..14 {
            let mut unit = vec![0.0; 14];
            unit[j] = 1.0;
            assert_eq!(found.product(&unit), expected.product(&unit));
        }
    }
}
