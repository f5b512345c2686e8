//! The problem (1) of [`crate::bounded_least_squares`] with everything that is computed once: the diagonal of H, the
//! mask of the reached columns, and the surrogate.

use ndarray::{Array2, Zip};
use planish_numerics::parallel;
use planish_types::{Grid, Invalid, Surface, Tif, ToolPath};

use super::settings::{BoundedSettings, Product, Program, ToolColumns};
use crate::{
    DwellError,
    model::{
        UNREACHED_FRACTION,
        columns::{self, Patch, Stored, ToolPlace},
        operator::{MAX_COLUMN_ELEMENTS, Removal, pixels_under},
        stacked::StackedRemoval,
    },
    objective::{Basis, Free, Penalty, PenaltyScale, PenaltyWeights},
    surrogate::{self, Convolved, Ordered, Surrogate},
};

/// Smallest diagonal element of the Tikhonov term, as a fraction of K, at which the two-level method is used. Below it,
/// the rounding of the method is larger than the term. Larger: more problems take the slower gradient steps. Smaller:
/// rounding decides the steps.
const MIN_TIKHONOV_TWO_LEVEL: f64 = 1e-7;

/// Estimated energy (weighted sum of squares) of a column, as a fraction of the largest, below which it is computed
/// exactly. Larger: more columns are computed, which takes time. Smaller: columns of weak effect keep an inexact
/// estimate.
const ESTIMATED_ENERGY_FRACTION: f64 = 1e-3;

/// Ratio of the largest rate on the border to the peak above which a TIF ends abruptly, dimensionless. Wide splines
/// cannot represent the step at such a border, and the surrogate of the two-level method ignores it. Larger: steps at
/// the border slow the two-level method. Smaller: more problems are factorised.
const ABRUPT_BORDER_TO_PEAK: f64 = 0.1;

/// Factor on `max_factorised_points` of the settings for problems that the splines of the two-level method would
/// represent badly: these are factorised up to this many times as many dwell points. Larger: more memory and time for
/// the factor. Smaller: more problems take many steps of the two-level method.
const MORE_FACTORISED: usize = 10;

/// Largest number of multiplications of one factorisation (one or two seconds) with which a problem of more than
/// `max_factorised_points` dwell points is factorised. A problem takes ten factorisations (pads, and points that are
/// far apart) to a hundred (wide TIFs that were cropped). Larger: longer factorisations. Smaller: more problems take
/// many steps of the two-level method.
const MOST_WORK: f64 = 1e11;

/// The problem (1) with its inputs and everything that is computed once.
pub struct BoundedProblem<'a> {
    pub desired: &'a Surface,
    /// The tools, in the order of their columns in B.
    pub tools: Vec<PreparedTool<'a>>,
    /// Places of the tool in each of the n columns.
    places: &'a [Vec<ToolPlace>],
    pub settings: &'a BoundedSettings,
    /// Removal operator B (pixels, n), nm/s.
    pub b: StackedRemoval,
    /// Desired removal minus its weighted mean (ny, nx), nm; 0 where the weight is 0.
    pub z: Array2<f64>,
    /// Weights of the pixels as given (ny, nx), without those of a Huber loss.
    pub weight: Array2<f64>,
    pub lo: &'a [f64],
    /// Upper bounds (n), s. Unreached columns have their lower bound here, so that their dwell times never change.
    pub hi: Vec<f64>,
    /// Upper bounds as given (n), s.
    pub hi_given: &'a [f64],
    pub reached: Vec<bool>,
    /// Diagonal of the normal matrix H without the penalty (n), nm^2/s^2, partly an estimate ([`energies`]); 0 for
    /// unreached columns.
    pub diagonal: Vec<f64>,
    /// Columns of U of (2), one (n) for each free function of the map (piston, or plane).
    u: Vec<Vec<f64>>,
    pub surrogate: Surrogate,
    /// Number of pixels along the side of a cell of `surrogate`.
    pub cell: usize,
    /// Pitch of the splines of `surrogate`, mm; `None` if it has none.
    pub splines_mm: Option<f64>,
    /// Dwell times at which the steps begin (n), s.
    pub start: Vec<f64>,
    /// True if `start` is a guess of the caller.
    pub is_guessed: bool,
    /// Product with the matrix Q of (1), if the problem has one.
    pub quadratic: Option<Product<'a>>,
}

/// Returns the energy `sum_i w_i B_ij^2` of every column j (n). For stored columns it is exact. By FFT it is an
/// estimate. With `cells`, it is the energy of the column on them. Without cells, it has the mean of R^2 over the
/// places of the column in place of the square of the mean, and includes the spill of `fft_operator`.
///
/// The energy of a column whose estimate is below [`ESTIMATED_ENERGY_FRACTION`] of the largest is computed exactly.
fn energies(
    b: &Removal,
    cells: Option<&[Patch]>,
    places: &[Vec<ToolPlace>],
    tif: &Tif,
    grid: &Grid,
    weight: &Array2<f64>,
) -> Vec<f64> {
    let mut energy: Vec<f64> = match (b, cells) {
        (Removal::Stored(b), _) => return b.energy(weight),
        (Removal::Convolved(_), Some(cells)) => cells.iter().map(Patch::square).collect(),
        (Removal::Convolved(b), None) => b.adjoint_of_squared_tif(weight),
    };
    let largest = energy.iter().copied().fold(0.0, f64::max);
    let few: Vec<usize> =
        (0..energy.len()).filter(|j| energy[*j] < ESTIMATED_ENERGY_FRACTION * largest).collect();
    let exact = parallel::map(few.len(), &|k| {
        Stored::new(&places[few[k]..=few[k]], tif, grid).energy(weight)[0]
    });
    few.iter().zip(exact).for_each(|(j, e)| energy[*j] = e);
    energy
}

/// One tool of a problem, with the quantities to which the weights of its penalty are relative.
pub struct PreparedTool<'a> {
    /// Tool, path, columns and price of a second.
    pub columns: ToolColumns<'a>,
    /// Quantities K, A, p and sum w of (1), of this tool alone.
    pub scale: PenaltyScale,
}

/// One tool of a problem with its part of B, of U and of the diagonal of H.
struct ToolPart<'a> {
    tool: PreparedTool<'a>,
    b: Removal,
    /// Its elements of the columns of U of (2), one vector for each free function of the map.
    u: Vec<Vec<f64>>,
    /// Its elements of the diagonal of H without the penalty, nm^2/s^2; 0 for unreached columns.
    diagonal: Vec<f64>,
    reached: Vec<bool>,
    /// Its columns of B on the cells, if H~ is factorised.
    cells: Option<Vec<Patch>>,
}

/// Holds what all tools of a problem share: the grid of the map, the weights of its pixels and its free functions.
struct Common<'a> {
    grid: &'a Grid,
    weight: &'a Array2<f64>,
    basis: &'a Basis,
    /// Number of pixels along the side of a cell.
    cell: usize,
    /// True if H~ is factorised.
    factorised: bool,
}

impl<'a> ToolPart<'a> {
    /// Prepares one tool. Its columns are those of `places` (all columns of the program) in its range.
    ///
    /// # Errors
    /// Refuses a TIF that covers too many pixels of the map, and a tool that does not reach the map.
    fn new(
        tool: &ToolColumns<'a>,
        places: &[Vec<ToolPlace>],
        common: &Common<'_>,
    ) -> Result<Self, DwellError> {
        let Common { grid, weight, basis, cell, factorised } = *common;
        let places = &places[tool.columns.clone()];
        let tif = tool.tif;
        // H~ less U U' is positive definite where both are of the same columns.
        let b = Removal::new(places, tif, grid, factorised)?;
        let u = basis.columns(weight, |m| b.adjoint(m));
        let cells = factorised.then(|| columns::on_cells(places, tif, grid, weight, cell));
        // diag H = sum of w B^2 less U^2
        let energy = energies(&b, cells.as_deref(), places, tif, grid, weight);
        let mut diagonal: Vec<f64> = (0..places.len())
            .map(|j| (energy[j] - u.iter().map(|u| u[j] * u[j]).sum::<f64>()).max(0.0))
            .collect();
        let largest = diagonal.iter().copied().fold(0.0, f64::max);
        if largest.is_nan() || largest <= 0.0 {
            return Err(DwellError::OutOfReach { points: places.len() });
        }
        let reached: Vec<bool> =
            diagonal.iter().map(|d| *d > UNREACHED_FRACTION * largest).collect();
        // K decides the weights of (1): the element itself, not the estimate.
        let strongest = strongest(&diagonal, places, (tif, grid), basis, weight);
        for (d, _) in diagonal.iter_mut().zip(&reached).filter(|(_, reached)| !**reached) {
            *d = 0.0;
        }
        let scale = penalty_scale(tool.path, tif, strongest, weight, &u[0]);
        let tool = PreparedTool { columns: tool.clone(), scale };
        Ok(Self { tool, b, u, diagonal, reached, cells })
    }
}

impl<'a> BoundedProblem<'a> {
    /// Prepares the problem for the tools of a program and the weights of the pixels. The ranges of the columns of the
    /// tools follow each other.
    ///
    /// # Errors
    /// Refuses a TIF that covers too many pixels of the map, and a tool that does not reach the map. Refuses several
    /// tools with more columns than can be factorised.
    pub fn new(
        desired: &'a Surface,
        tools: &[ToolColumns<'a>],
        program: &'a Program<'a>,
        weight: Array2<f64>,
        settings: &'a BoundedSettings,
    ) -> Result<Self, DwellError> {
        let n = program.places.len();
        let grid = desired.grid();
        let is_one = tools.len() == 1;
        let most = settings.max_factorised_points;
        // Only the factorised surrogate has the products of columns of different tools.
        let factorised = !is_one || is_factorised(program.places, tools[0].tif, most);
        let basis = Basis::new(grid, &weight, settings.free);
        let loss = match (is_one, factorised) {
            (false, _) => surrogate::MAX_LOSS_SEVERAL,
            (true, true) => surrogate::MAX_LOSS_FACTORISED,
            (true, false) => surrogate::MAX_LOSS_TWO_LEVEL,
        };
        let cell_sizes = tools.iter().map(|tool| surrogate::cell_size(tool.tif, grid, loss));
        let mut cell = cell_sizes.min().expect("a problem has a tool");
        let common = Common { grid, weight: &weight, basis: &basis, cell, factorised };
        let parts = tools.iter().map(|tool| {
            let part = ToolPart::new(tool, program.places, &common);
            if is_one { part } else { part.map_err(|error| error.of_tool(tool.name)) }
        });
        let Stacked { tools, b, u, diagonal, reached, cells } =
            Stacked::new(parts.collect::<Result<_, _>>()?);
        let hi: Vec<f64> =
            (0..n).map(|j| if reached[j] { program.hi[j] } else { program.lo[j] }).collect();
        let first = program.guess.as_ref().unwrap_or(&program.lo);
        let start = (0..n).map(|j| first[j].clamp(program.lo[j], hi[j])).collect();
        let penalty = stacked_penalty(&tools, &program.lo, &settings.penalty_weights());
        let mut splines_mm = None;
        let surrogate = if factorised {
            let is_exact = cell == 1;
            let ordered = ordered(&tools, &cells, &u, &reached, &penalty, is_exact)?;
            Surrogate::Ordered(ordered)
        } else {
            let tif = tools[0].columns.tif;
            let alphas = (penalty.least_alpha(), tools[0].scale.strongest);
            (cell, splines_mm) = cells_of_convolved(program.places, &reached, tif, grid, alphas);
            let cells = (cell, splines_mm);
            convolved(program.places, &reached, tif, grid, &weight, settings.free, cells)?
        };
        Ok(Self {
            z: centred(desired.height_nm(), &weight),
            desired,
            tools,
            places: program.places,
            settings,
            b,
            weight,
            lo: &program.lo,
            hi,
            hi_given: &program.hi,
            reached,
            diagonal,
            u,
            surrogate,
            cell,
            splines_mm,
            start,
            is_guessed: program.guess.is_some(),
            quadratic: program.quadratic,
        })
    }

    /// Returns the penalty of (1) with these weights: that of each tool relative to its own quantities K, A and p, and
    /// with its own price of a second.
    pub fn penalty(&self, weights: &PenaltyWeights) -> Penalty {
        stacked_penalty(&self.tools, self.lo, weights)
    }

    /// Gives the factorised surrogate H~ smaller cells. Returns `false` if there are no smaller ones, if their columns
    /// would take too much memory, or if H~ is not factorised.
    pub fn sharpen(&mut self, penalty: &Penalty) -> bool {
        let grid = self.desired.grid();
        let smaller = self.cell / 2;
        if smaller == 0 || matches!(self.surrogate, Surrogate::Convolved(_)) {
            return false;
        }
        let elements = self.tools.iter().map(|PreparedTool { columns, .. }| {
            let pixels = pixels_under(columns.tif, grid) / (smaller * smaller) as f64;
            columns.path.len() as f64 * pixels
        });
        if elements.sum::<f64>() > MAX_COLUMN_ELEMENTS {
            return false;
        }
        let cells = self.tools.iter().flat_map(|PreparedTool { columns, .. }| {
            let places = &self.places[columns.columns.clone()];
            columns::on_cells(places, columns.tif, grid, &self.weight, smaller)
        });
        let cells: Vec<Patch> = cells.collect();
        let sharper = ordered(&self.tools, &cells, &self.u, &self.reached, penalty, smaller == 1);
        let Ok(sharper) = sharper else { return false };
        self.cell = smaller;
        self.surrogate = Surrogate::Ordered(sharper);
        true
    }

    /// Replaces a factorised H~ that is singular to rounding by one that is only multiplied by vectors. Returns `false`
    /// for at most `max_factorised_points` dwell points: the map then does not determine their dwell times. Returns
    /// `false` for several tools, too.
    ///
    /// # Errors
    /// Refuses cells that [`Convolved::new`] refuses.
    pub fn without_factors(&mut self, penalty: &Penalty) -> Result<bool, Invalid> {
        let [PreparedTool { columns, scale }] = self.tools.as_slice() else { return Ok(false) };
        if columns.path.len() <= self.settings.max_factorised_points {
            return Ok(false);
        }
        let alphas = (penalty.least_alpha(), scale.strongest);
        let grid = self.desired.grid();
        (self.cell, self.splines_mm) =
            cells_of_convolved(self.places, &self.reached, columns.tif, grid, alphas);
        self.surrogate = self.convolved((self.cell, self.splines_mm))?;
        Ok(true)
    }

    /// Makes the surrogate H~ for many dwell points. `cells` is (side of its cells, pixels; pitch of its splines, mm,
    /// `None` without splines).
    ///
    /// # Errors
    /// Refuses cells that [`Convolved::new`] refuses.
    pub fn convolved(&self, cells: (usize, Option<f64>)) -> Result<Surrogate, Invalid> {
        let grid = self.desired.grid();
        let free = self.settings.free;
        let tif = self.tools[0].columns.tif;
        convolved(self.places, &self.reached, tif, grid, &self.weight, free, cells)
    }
}

/// The parts of all tools side by side.
struct Stacked<'a> {
    tools: Vec<PreparedTool<'a>>,
    b: StackedRemoval,
    u: Vec<Vec<f64>>,
    diagonal: Vec<f64>,
    reached: Vec<bool>,
    /// Columns of all tools on the cells; empty if H~ is not factorised.
    cells: Vec<Patch>,
}

impl<'a> Stacked<'a> {
    /// Puts the parts of the tools, in the order of their columns, side by side.
    fn new(parts: Vec<ToolPart<'a>>) -> Self {
        let mut tools = Vec::new();
        let mut removals = Vec::new();
        let mut stacked_u: Vec<Vec<f64>> = Vec::new();
        let mut stacked_diagonal = Vec::new();
        let mut stacked_reached = Vec::new();
        let mut stacked_cells = Vec::new();
        for ToolPart { tool, b, u, diagonal, reached, cells } in parts {
            removals.push((tool.columns.columns.clone(), b));
            tools.push(tool);
            // The free functions are those of the map, so that every tool has as many.
            stacked_u.resize_with(u.len(), Vec::new);
            stacked_u.iter_mut().zip(u).for_each(|(all, u)| all.extend(u));
            stacked_diagonal.extend(diagonal);
            stacked_reached.extend(reached);
            stacked_cells.extend(cells.into_iter().flatten());
        }
        Self {
            tools,
            b: StackedRemoval::new(removals),
            u: stacked_u,
            diagonal: stacked_diagonal,
            reached: stacked_reached,
            cells: stacked_cells,
        }
    }
}

/// Returns the penalty of all tools with these weights and the lower bounds `lo` (n), s. Each tool has its own price of
/// a second.
fn stacked_penalty(tools: &[PreparedTool<'_>], lo: &[f64], weights: &PenaltyWeights) -> Penalty {
    let parts = tools.iter().map(|PreparedTool { columns, scale }| {
        let time_weight_nm2_per_s = columns.time_weight_nm2_per_s;
        let weights = PenaltyWeights { time_weight_nm2_per_s, ..*weights };
        Penalty::new(columns.path, &lo[columns.columns.clone()], scale, &weights)
    });
    Penalty::stacked(parts).expect("a problem has a tool")
}

/// Makes the factorised surrogate H~ from the columns on the cells.
///
/// # Errors
/// Refuses several tools whose matrix is too large in every order of the columns.
fn ordered(
    tools: &[PreparedTool<'_>],
    cells: &[Patch],
    u: &[Vec<f64>],
    reached: &[bool],
    penalty: &Penalty,
    is_exact: bool,
) -> Result<Ordered, Invalid> {
    if tools.len() == 1 {
        return Ok(Ordered::new(cells, u, reached, penalty, is_exact));
    }
    let ranges: Vec<_> = tools.iter().map(|tool| tool.columns.columns.clone()).collect();
    Ordered::of_several(&ranges, cells, u, reached, penalty, is_exact)
}

/// Returns the map z minus its weighted mean (ny, nx); 0 where the weight is 0.
fn centred(z: &Array2<f64>, weight: &Array2<f64>) -> Array2<f64> {
    let mut sum = 0.0;
    let mut total = 0.0;
    Zip::from(z).and(weight).for_each(|z, w| {
        if *w > 0.0 {
            sum += w * z;
            total += w;
        }
    });
    let mean = sum / total;
    let mut centred = Array2::zeros(z.dim());
    Zip::from(&mut centred).and(z).and(weight).for_each(|c, z, w| {
        if *w > 0.0 {
            *c = z - mean;
        }
    });
    centred
}

/// Returns the side of the cells, pixels, and the pitch of the splines, mm, of the surrogate for many dwell points. The
/// pitch is `None` if `least_alpha`, the least diagonal element of the Tikhonov term, is below
/// [`MIN_TIKHONOV_TWO_LEVEL`] times K = `strongest`. It is also `None` if no pitch of splines suits the columns
/// ([`surrogate::spline_pitch`]).
fn cells_of_convolved(
    places: &[Vec<ToolPlace>],
    reached: &[bool],
    tif: &Tif,
    grid: &Grid,
    (least_alpha, strongest): (f64, f64),
) -> (usize, Option<f64>) {
    let weak = least_alpha < MIN_TIKHONOV_TWO_LEVEL * strongest;
    let splines_mm = if weak { None } else { surrogate::spline_pitch(places, reached, tif) };
    let loss = match splines_mm {
        Some(_) => surrogate::MAX_LOSS_TWO_LEVEL,
        None => surrogate::MAX_LOSS_GRADIENT,
    };
    (surrogate::cell_size(tif, grid, loss), splines_mm)
}

/// Makes the surrogate for many dwell points. `cells` is the side of its cells, pixels, and the pitch of its splines,
/// mm.
fn convolved(
    places: &[Vec<ToolPlace>],
    reached: &[bool],
    tif: &Tif,
    grid: &Grid,
    weight: &Array2<f64>,
    free: Free,
    cells: (usize, Option<f64>),
) -> Result<Surrogate, Invalid> {
    let h = Convolved::new(places, reached, tif, grid, weight, free, cells)?;
    Ok(Surrogate::Convolved(Box::new(h)))
}

/// Returns true if H~ is to be factorised: for up to `most` dwell points, and for up to [`MORE_FACTORISED`] times as
/// many if splines represent too little of the problem and a factorisation takes at most [`MOST_WORK`] multiplications.
/// Splines represent too little if the TIF ends abruptly or the columns are sparse.
fn is_factorised(places: &[Vec<ToolPlace>], tif: &Tif, most: usize) -> bool {
    let n = places.len();
    let says_too_little =
        tif.border_to_peak() > ABRUPT_BORDER_TO_PEAK || surrogate::are_sparse(places, tif);
    n <= most
        || n <= most.saturating_mul(MORE_FACTORISED)
            && says_too_little
            && surrogate::factorisation_work(places, tif) <= MOST_WORK
}

/// Returns the quantities to which the weights of the penalty are relative. `u` is the column of U for the first free
/// function, the constant 1 / (sum of w)^1/2, so it is B' w over this root.
fn penalty_scale(
    path: &ToolPath,
    tif: &Tif,
    strongest: f64,
    weight: &Array2<f64>,
    u: &[f64],
) -> PenaltyScale {
    let pixel_weight = weight.sum();
    let b_w: Vec<f64> = u.iter().map(|u| pixel_weight.sqrt() * u).collect();
    PenaltyScale::new(path, tif, strongest, pixel_weight, &b_w)
}

/// Returns K, the diagonal element of `B' W B - U U'` for the column at which `diagonal` is largest, computed exactly
/// even if `diagonal` is an estimate, nm^2/s^2.
fn strongest(
    diagonal: &[f64],
    places: &[Vec<ToolPlace>],
    (tif, grid): (&Tif, &Grid),
    basis: &Basis,
    weight: &Array2<f64>,
) -> f64 {
    let j = (0..diagonal.len()).max_by(|a, b| diagonal[*a].total_cmp(&diagonal[*b])).unwrap_or(0);
    let p = Stored::new(&places[j..=j], tif, grid);
    let u = basis.columns(weight, |m| p.adjoint(m));
    p.energy(weight)[0] - u.iter().map(|u| u[0] * u[0]).sum::<f64>()
}
