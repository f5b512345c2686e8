//! Set-up errors in a plan of several tools: the reserve that is left for the tool after a measured map, and the errors
//! that no map shows.
//!
//! A tool is mounted with an error of its place and of its rate. To first order it removes, in place of m,
//!
//! ```text
//! m + eta_0 r m + eta_x s_x dm/dx + eta_y s_y dm/dy,   eta normal with the deviation 1,   m = B t
//! sigma^2 = r^2 m^2 + s_x^2 (dm/dx)^2 + s_y^2 (dm/dy)^2                                                  (1)
//! ```
//!
//! r is the relative error of the rate and s that of the place, mm, both standard deviations ([`SetupErrors`]).
//!
//! **With a map after the tool** the next one is planned again, and mends the errors as far as they ask for removal.
//! So it gets a reserve: in the plan it removes at least q sigma everywhere, q = [`RESERVE_DEVIATIONS`]. With V, the
//! volumetric removal rate, and the area `a_j` of a dwell point, its dwell times have the lower bounds
//!
//! ```text
//! l_j = q sigma(x_j) a_j / V                                                                               (2)
//! ```
//!
//! and the other tools leave that much. sigma is that of the plan without a reserve, in which the coarse tool removes
//! more; so it is rather too large. Errors of several tools before one map add, sigma^2 = sum of their sigma_k^2.
//!
//! **Errors that no map shows** stay in the residual. Their expected square is a further term of the objective,
//!
//! ```text
//! t_k' Q_k t_k / 2,   Q_k = B_k' (r^2 W P + s_x^2 D_x' W P D_x + s_y^2 D_y' W P D_y) B_k                 (3)
//! ```
//!
//! with the weights W of the pixels, P that subtracts what is free (a piston, or a plane), and D, central differences
//! on the pixels of the map, one-sided at its borders.

use ndarray::{Array2, Axis as Dimension};
use planish_types::{Grid, Invalid, SetupErrors, Tif, ToolPath, outcome::plan::Reserve};

use super::settings::ToolTask;
use crate::{
    model::{columns::ToolPlace, operator::Removal},
    objective::{Basis, Free, lengths_mm},
};

/// Number of standard deviations of the earlier tools that a tool keeps as its reserve: 95 % of normal errors are
/// within two. Larger: more time of the narrow tool. Smaller: more runs in which it needs more time than planned.
const RESERVE_DEVIATIONS: f64 = 2.0;

/// Set-up errors of the tools of a plan by what happens to them, with indices of the tools.
pub(super) struct Fates {
    /// Tools with errors that a map shows, and the tool after that map.
    pub mended: Vec<(Vec<usize>, usize)>,
    /// Tools with errors that no map shows.
    pub blind: Vec<usize>,
}

impl Fates {
    /// Follows the tools from the widest to the narrowest, by their width at half of the peak.
    pub(super) fn new(tools: &[ToolTask<'_>]) -> Self {
        let order = order_of_use(tools);
        let mut fates = Self { mended: Vec::new(), blind: Vec::new() };
        let mut unseen = Vec::new();
        for (place, k) in order.iter().enumerate() {
            let setup = tools[*k].setup;
            if !setup.are_zero() {
                unseen.push(*k);
            }
            if let Some(next) = order.get(place + 1)
                && setup.measured_after
                && !unseen.is_empty()
            {
                fates.mended.push((std::mem::take(&mut unseen), *next));
            }
        }
        fates.blind = unseen;
        fates
    }
}

/// Returns the indices of the tools in the order in which they work: from the widest at half of its peak to the
/// narrowest.
pub(super) fn order_of_use(tools: &[ToolTask<'_>]) -> Vec<usize> {
    let mut order: Vec<usize> = (0..tools.len()).collect();
    let width = |k: usize| tools[k].tif.half_maximum_width_mm();
    order.sort_by(|a, b| width(*b).total_cmp(&width(*a)));
    order
}

/// Result of a plan for one tool, as far as the reserve needs it.
pub(super) struct Planned {
    /// Its removal (ny, nx), nm.
    pub removal_nm: Array2<f64>,
    /// Distance of neighbouring lines of its path, mm.
    pub line_distance_mm: f64,
    /// True for its dwell points that reach the map (n).
    pub reached: Vec<bool>,
}

/// Returns the variance (1) of the module of a removal (ny, nx), nm^2.
fn variance_nm2(removal_nm: &Array2<f64>, setup: &SetupErrors, grid: &Grid) -> Array2<f64> {
    let mut variance = removal_nm.mapv(|m| (setup.rate_fraction * m).powi(2));
    for (axis, shift_mm) in setup.shift_mm.into_iter().enumerate() {
        let slope = slope(removal_nm, axis, grid);
        variance.zip_mut_with(&slope, |variance, slope| *variance += (shift_mm * slope).powi(2));
    }
    variance
}

/// Returns the reserve that tool `next` keeps for the errors of the tools `earlier`, and its least dwell times (2) of
/// the module (n), s.
pub(super) fn reserve(
    tools: &[ToolTask<'_>],
    plan: &[Planned],
    (earlier, next): (&[usize], usize),
    (grid, weight): (&Grid, &Array2<f64>),
) -> (Reserve, Vec<f64>) {
    let mut variance = Array2::<f64>::zeros(grid.shape());
    for k in earlier {
        variance += &variance_nm2(&plan[*k].removal_nm, &tools[*k].setup, grid);
    }
    let reserve_nm = variance.mapv(|v| RESERVE_DEVIATIONS * v.sqrt());
    let ToolTask { path, tif, .. } = tools[next];
    let Planned { line_distance_mm, reached, .. } = &plan[next];
    let lengths = lengths_mm(path);
    let least_s: Vec<f64> = (0..path.len())
        .map(|j| {
            if !reached[j] || !path.tool_on()[j] {
                return 0.0;
            }
            let area_mm2 = line_distance_mm * lengths[j];
            reserve_nm[pixel_at(grid, path.dwell_point_mm()[j])] * area_mm2 / tif.vrr_nm_mm2_per_s()
        })
        .collect();
    let counted = || reserve_nm.iter().zip(weight).filter(|(_, w)| **w > 0.0);
    let reserve = Reserve {
        errors_of: earlier.iter().map(|k| tools[*k].name.to_string()).collect(),
        mean_nm: counted().map(|(r, w)| r * w).sum::<f64>() / weight.sum(),
        largest_nm: counted().map(|(r, _)| *r).fold(0.0, f64::max),
        time_s: least_s.iter().sum(),
    };
    (reserve, least_s)
}

/// Raises the lower bounds `lo` (n) of a tool to its reserve, s.
///
/// # Errors
/// Refuses a reserve above the upper bounds `hi` (n), s.
pub(super) fn raise(
    lo: &mut [f64],
    hi: &[f64],
    least_s: &[f64],
    reserve: &Reserve,
) -> Result<(), Invalid> {
    for (j, least_s) in least_s.iter().enumerate() {
        if *least_s > hi[j] {
            let problem = format!(
                "is {} s, below the {least_s} s that the reserve for the set-up errors of {} asks for",
                hi[j],
                reserve.errors_of.join(" and ")
            );
            let remedy = "give a larger upper bound, or smaller set-up errors";
            return Err(Invalid::at_index("max_dwell", j, problem, remedy));
        }
        lo[j] = lo[j].max(*least_s);
    }
    Ok(())
}

/// Returns the index of the pixel nearest to a point [x, y], mm.
fn pixel_at(grid: &Grid, point_mm: [f64; 2]) -> [usize; 2] {
    let [column, row] = [(&grid.x, point_mm[0]), (&grid.y, point_mm[1])].map(|(axis, mm)| {
        let place = ((mm - axis.start_mm()) / axis.step_mm()).round();
        place.clamp(0.0, (axis.len() - 1) as f64) as usize
    });
    [row, column]
}

/// Returns the central differences of a map (ny, nx) along axis 0 (x) or 1 (y), per mm; one-sided at the borders.
fn slope(map: &Array2<f64>, axis: usize, grid: &Grid) -> Array2<f64> {
    let step_mm = [grid.x.step_mm(), grid.y.step_mm()][axis];
    let mut slope = Array2::zeros(map.dim());
    let lanes = map.lanes(Dimension(1 - axis));
    for (line, mut slope) in lanes.into_iter().zip(slope.lanes_mut(Dimension(1 - axis))) {
        for i in 0..line.len() {
            let (before, after) = neighbours(i, line.len());
            if after > before {
                slope[i] = (line[after] - line[before]) / ((after - before) as f64 * step_mm);
            }
        }
    }
    slope
}

/// Returns the adjoint of [`slope`], applied to a map (ny, nx).
fn slope_adjoint(map: &Array2<f64>, axis: usize, grid: &Grid) -> Array2<f64> {
    let step_mm = [grid.x.step_mm(), grid.y.step_mm()][axis];
    let mut sum = Array2::zeros(map.dim());
    let lanes = map.lanes(Dimension(1 - axis));
    for (line, mut sum) in lanes.into_iter().zip(sum.lanes_mut(Dimension(1 - axis))) {
        for i in 0..line.len() {
            let (before, after) = neighbours(i, line.len());
            if after > before {
                let part = line[i] / ((after - before) as f64 * step_mm);
                sum[after] += part;
                sum[before] -= part;
            }
        }
    }
    sum
}

/// Returns the indices of the samples between which the slope at sample i of n is taken.
fn neighbours(i: usize, n: usize) -> (usize, usize) {
    (i.saturating_sub(1), (i + 1).min(n - 1))
}

/// The term (3) of the module: the expected square of the errors that no map shows.
pub(super) struct ExpectedSquare<'a> {
    grid: &'a Grid,
    weight: &'a Array2<f64>,
    basis: Basis,
    /// Range of the columns of each tool with such errors, its matrix B, and its errors.
    tools: Vec<(std::ops::Range<usize>, Removal, SetupErrors)>,
    columns: usize,
}

impl<'a> ExpectedSquare<'a> {
    /// Makes the term for a map with these weights of its pixels, without tools. `columns` is the number of columns of
    /// all tools.
    pub(super) fn new(grid: &'a Grid, weight: &'a Array2<f64>, free: Free, columns: usize) -> Self {
        Self { grid, weight, basis: Basis::new(grid, weight, free), tools: Vec::new(), columns }
    }

    /// Adds the errors of a tool with these columns, whose places in all columns are `places`.
    ///
    /// # Errors
    /// Refuses a TIF that covers so many pixels that the units must be wrong.
    pub(super) fn add(
        &mut self,
        columns: std::ops::Range<usize>,
        places: &[Vec<ToolPlace>],
        tif: &Tif,
        setup: SetupErrors,
    ) -> Result<(), Invalid> {
        let b = Removal::new(&places[columns.clone()], tif, self.grid, false)?;
        self.tools.push((columns, b, setup));
        Ok(())
    }

    pub(super) fn is_empty(&self) -> bool {
        self.tools.is_empty()
    }

    /// Returns `Q t` (n) for the dwell times t (n) of all tools.
    pub(super) fn product(&self, t: &[f64]) -> Vec<f64> {
        let mut product = vec![0.0; self.columns];
        for (columns, b, setup) in &self.tools {
            let removal_nm = b.apply(&t[columns.clone()]);
            let mut sum = self.weighted(removal_nm.clone()) * setup.rate_fraction.powi(2);
            for (axis, shift_mm) in setup.shift_mm.into_iter().enumerate() {
                let sloped = self.weighted(slope(&removal_nm, axis, self.grid));
                sum.scaled_add(shift_mm * shift_mm, &slope_adjoint(&sloped, axis, self.grid));
            }
            product[columns.clone()].copy_from_slice(&b.adjoint(&sum));
        }
        product
    }

    /// Returns `W P m` of a map m (ny, nx).
    fn weighted(&self, mut map: Array2<f64>) -> Array2<f64> {
        self.basis.project(self.weight, &mut map);
        map * self.weight
    }

    /// Returns the root of the expected mean square `t'Q t / sum w`, nm.
    pub(super) fn rms_nm(&self, t: &[f64]) -> f64 {
        let square: f64 = self.product(t).iter().zip(t).map(|(q, t)| q * t).sum();
        (square.max(0.0) / self.weight.sum()).sqrt()
    }
}

/// Returns the path displaced by `shift_mm` along [x, y].
pub(super) fn displaced(path: &ToolPath, shift_mm: [f64; 2]) -> Result<ToolPath, Invalid> {
    let moved = |points: &[[f64; 2]]| {
        points.iter().map(|p| [p[0] + shift_mm[0], p[1] + shift_mm[1]]).collect()
    };
    ToolPath::new(
        moved(path.point_mm()),
        moved(path.dwell_point_mm()),
        path.tool_on().to_vec(),
        path.pass_idx().to_vec(),
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use planish_types::Axis;

    #[test]
    fn the_adjoint_of_the_slope_is_its_transpose() {
        let grid = Grid { x: Axis::new(0.0, 0.5, 7).unwrap(), y: Axis::new(0.0, 0.25, 5).unwrap() };
        let map = |a: f64| {
            Array2::from_shape_fn(grid.shape(), |(r, c)| (a * r as f64 + 0.7 * c as f64).sin())
        };
        let (m, z) = (map(1.3), map(-2.1));
        for axis in [0, 1] {
            let left = (&slope(&m, axis, &grid) * &z).sum();
            let right = (&slope_adjoint(&z, axis, &grid) * &m).sum();
            // Rounding of sums of 35 products.
            assert!((left - right).abs() < 1e-13, "{axis}: {left} {right}");
        }
        // Central differences are exact for a plane, and one-sided ones, too.
        let plane =
            Array2::from_shape_fn(grid.shape(), |(r, c)| 3.0 * 0.5 * c as f64 - 0.25 * r as f64);
        for (axis, expected) in [(0, 3.0), (1, -1.0)] {
            assert!(slope(&plane, axis, &grid).iter().all(|s| (s - expected).abs() < 1e-13));
        }
    }
}
