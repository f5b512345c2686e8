//! Kernels and weights of a tool that is a function of its place, the position p on the part.
//!
//! With the samples `K_j` of the tool at places `p_j` of a grid,
//!
//! ```text
//! K_i . K_j = V L V'                      eigenvalues l_1 >= l_2 >= ...                   (1)
//! phi_k = sum_j V_jk K_j / l_k^1/2        orthonormal: the singular vectors of the samples
//! a_k(p) = phi_k . K(p)                   at every place of the grid                      (2)
//! ```
//!
//! The kernels phi_k are functions of the offset from the tool, and the weights a_k functions of the place. By (2),
//! `|K(p) - sum_k a_k phi_k|^2 = |K(p)|^2 - sum_k a_k^2`, which is computed at every place. Between the places the
//! weights are interpolated; the error of this is measured within cells. The rank, the number of kernels, is the least,
//! and the grid the coarsest of halved ones, whose errors stay below the wanted one.
//!
//! A tool that only turns, with the azimuth of its place or with the direction of its motion, is sampled at angles of
//! one turn instead of places of a grid. It is then as exact at the axis as far from it.

use std::collections::BTreeSet;

use nalgebra::{DMatrix, SymmetricEigen};
use ndarray::{Array2, Zip};
use planish_types::{
    Axis, AzimuthWeights, Grid, Invalid, Pose, Tif, TurnWeights, VaryingTif, text::significant,
};
use rayon::prelude::*;
use serde::Serialize;

/// Largest number of places whose samples of the tool are used to compute the kernels. Larger: a larger matrix, and
/// more time. Smaller: kernels that miss a tool which few places have.
const MOST_TRAINING: usize = 400;

/// Largest number of places at which weights are stored. Larger: finer grids for tools that change fast, and more time
/// and memory. Smaller: such tools are less exact.
const MOST_PLACES: usize = 20_000;

/// Number of cells along the longer side of the first grid. Larger: finer grids than smooth tools need. Smaller: more
/// halvings.
const FIRST_CELLS: f64 = 8.0;

/// Number of angles of one turn with which the search begins, for a tool that turns. Larger: more than smooth tools
/// need. Smaller: more doublings.
const FIRST_ANGLES: usize = 32;

/// Largest number of angles of one turn. Larger: tools with finer shapes, and more time. Smaller: such tools are less
/// exact.
const MOST_ANGLES: usize = 1024;

/// Largest number of cells of a lattice in which the error between the samples is measured. Larger: more time. Smaller:
/// a larger scatter of the measured error.
const MOST_MEASURED: usize = 400;

/// Largest number of cells in which the largest error is searched, on the final lattice. Larger: more time. Smaller: a
/// place with a larger error may be missed.
const MOST_SEARCHED: usize = 2000;

/// Number of cells with the largest errors in which the search for the largest error goes on, and number of tried
/// places along a side of each. Larger: more time. Smaller: a largest error that is stated too small.
const SEARCHED_FURTHER: (usize, usize) = (12, 5);

/// Fractions of a cell, along x and y, by which the searched place moves from one cell to the next. Only the middles
/// would not do: there the third-order error of Keys' interpolation vanishes. Powers of 1 / 1.3247 cover the square
/// evenly (M. Roberts, R2 sequence).
const SPREAD: [f64; 2] = [0.754_877_666_246_692_7, 0.569_840_290_998_053_3];

/// Golden ratio less 1: the fractional parts of its multiples are spread evenly.
const GOLDEN: f64 = 0.618_033_988_749_894_9;

/// Fraction of the wanted error that the choice of the rank may use; interpolation has the rest. Larger: fewer kernels,
/// and finer grids. Smaller: the reverse.
const PART_OF_RANK: f64 = 0.5;

/// Wanted exactness of the kernels and weights.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct LowRankSettings {
    /// Wanted error, dimensionless: root mean square over the places of the error of the samples, over that of the
    /// samples.
    pub error: f64,
    /// Largest number of kernels (rank).
    pub max_rank: usize,
}

impl LowRankSettings {
    fn check(&self) -> Result<(), Invalid> {
        let Self { error, max_rank } = *self;
        if !(error > 0.0 && error < 1.0) {
            let problem = format!("is {error}");
            return Err(Invalid::whole("error", problem, "give a fraction above 0 and below 1"));
        }
        if max_rank == 0 {
            return Err(Invalid::whole("max_rank", "is 0", "give at least one kernel"));
        }
        Ok(())
    }
}

/// Number and distance of the samples of the weights.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[serde(untagged)]
pub enum Samples {
    /// Samples on a grid of places.
    Places {
        /// Number of places along x and y.
        places: [usize; 2],
        /// Distance of the places along x and y, mm.
        spacing_mm: [f64; 2],
    },
    /// Samples at azimuths of the place about the middle of the part.
    Azimuths {
        /// Number of azimuths in one turn.
        azimuths: usize,
        /// Distance between azimuths, degrees.
        spacing_deg: f64,
    },
    /// Samples at directions of the motion of the tool.
    Headings {
        /// Number of directions in one turn.
        headings: usize,
        /// Distance between directions, degrees.
        spacing_deg: f64,
    },
}

/// Report on the errors of the kernels and weights of a tool.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct LowRankReport {
    /// Number of kernels.
    pub rank: usize,
    /// Number and distance of the samples of the weights.
    pub samples: Samples,
    /// Error at the samples, from the limited number of kernels alone: root mean square over the places, relative to
    /// the tool.
    pub rank_error: f64,
    /// Largest error from the limited number of kernels alone at a sample, relative to the root mean square of the
    /// samples.
    pub largest_rank_error: f64,
    /// Error between the samples, from the number of kernels and from the interpolation, and at least `rank_error`:
    /// root mean square, relative to the tool.
    pub error: f64,
    /// Largest error that was found between or at the samples, relative to the root mean square of the samples.
    pub largest_error: f64,
    /// Place or direction of the motion between the samples at which the largest error there was found.
    pub largest_error_at: At,
    /// Wanted error, relative to the tool.
    pub wanted_error: f64,
    /// Mean square of the samples, (nm/s)^2; the errors are relative to its root.
    #[serde(skip)]
    squares: f64,
}

/// Place of the tool, or direction of its motion, at which an error occurs.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum At {
    /// Place [x, y], mm.
    PlaceMm([f64; 2]),
    /// Direction of the motion from positive x towards positive y, degrees.
    HeadingDeg(f64),
}

impl std::fmt::Display for At {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::PlaceMm([x, y]) => write!(f, "x = {x:.3} mm, y = {y:.3} mm"),
            Self::HeadingDeg(degrees) => {
                write!(f, "the heading {} degrees", significant(*degrees, 4))
            }
        }
    }
}

impl LowRankReport {
    /// Returns true if the wanted error is reached, or if the limited number of kernels alone causes a larger one,
    /// which more samples do not mend.
    fn more_samples_do_not_help(&self) -> bool {
        self.error <= self.wanted_error || self.rank_error > self.wanted_error
    }

    /// Returns the sentence that says which error was not reached; `None` if the error is at most the wanted one.
    pub fn negative(&self) -> Option<String> {
        if self.error <= self.wanted_error {
            return None;
        }
        Some(format!(
            "the kernels and weights miss the tool by {:.2e} of it (root mean square), more than the wanted {:.2e}; \
   the largest error, {:.2e}, is at {}; give a larger `error`{}, or a larger `max_rank`",
            self.error,
            self.wanted_error,
            self.largest_error,
            self.largest_error_at,
            match self.samples {
                Samples::Places { .. } => ", a smaller `spacing_mm`",
                Samples::Azimuths { .. } | Samples::Headings { .. } => "",
            }
        ))
    }
}

/// Function that returns the samples of a tool at a place [x, y], nm/s. For a tool that turns with its motion the
/// argument is the unit vector of the direction.
pub type LocalTool<'a> = dyn Fn([f64; 2]) -> Array2<f64> + Sync + 'a;

/// Returns true for the places [x, y] at which a tool is used.
pub type Used<'a> = dyn Fn([f64; 2]) -> bool + Sync + 'a;

/// A tool of kernels and weights, and the report on its errors.
#[derive(Debug)]
pub struct LowRank {
    /// The tool, without factors of the pixels and of the time.
    pub tool: VaryingTif,
    /// Report on the errors of the kernels and weights.
    pub report: LowRankReport,
}

/// Places or directions at which the weights are sampled.
#[derive(Clone, Copy)]
enum Lattice {
    /// Samples on a grid of places.
    Places(Grid),
    /// Samples at azimuths of one turn about a middle, at the distance `radius_mm` from it.
    Azimuths { middle_mm: [f64; 2], radius_mm: f64, count: usize },
    /// Samples at directions of the motion, each as its unit vector. `positions` is a grid that holds the places of the
    /// part.
    Headings { positions: Grid, count: usize },
}

impl Lattice {
    /// Returns the number and distance of the samples, for the report.
    fn samples(&self) -> Samples {
        match self {
            Self::Places(Grid { x, y }) => Samples::Places {
                places: [x.len(), y.len()],
                spacing_mm: [x.step_mm(), y.step_mm()],
            },
            Self::Azimuths { count, .. } => {
                Samples::Azimuths { azimuths: *count, spacing_deg: 360.0 / *count as f64 }
            }
            Self::Headings { count, .. } => {
                Samples::Headings { headings: *count, spacing_deg: 360.0 / *count as f64 }
            }
        }
    }

    /// Returns the indices `used` of samples and those of their neighbours; for angles of one turn only `used`. The
    /// interpolation between used places needs their weights too, and kernels that do not know the tool there can add
    /// material.
    fn with_neighbours(&self, used: &[usize]) -> Vec<usize> {
        let Self::Places(Grid { x, y }) = self else { return used.to_vec() };
        let nx = x.len();
        let is_used: BTreeSet<usize> = used.iter().copied().collect();
        let near = (0..self.len()).filter(|i| {
            let [mut rows, columns] =
                [(i / nx, y.len()), (i % nx, nx)].map(|(k, n)| k.saturating_sub(1)..(k + 2).min(n));
            rows.any(|r| columns.clone().any(|c| is_used.contains(&(r * nx + c))))
        });
        near.collect()
    }

    fn len(&self) -> usize {
        match self {
            Self::Places(grid) => grid.x.len() * grid.y.len(),
            Self::Azimuths { count, .. } | Self::Headings { count, .. } => *count,
        }
    }

    /// Returns the place of sample `i`, [x, y] in mm; for directions of the motion their unit vector.
    fn place(&self, i: usize) -> [f64; 2] {
        match self {
            Self::Places(Grid { x, y }) => {
                [x.coordinate_mm(i % x.len()), y.coordinate_mm(i / x.len())]
            }
            Self::Azimuths { middle_mm, radius_mm, count } => {
                around(*middle_mm, *radius_mm, i as f64 / *count as f64)
            }
            Self::Headings { count, .. } => around([0.0; 2], 1.0, i as f64 / *count as f64),
        }
    }

    /// Returns the sample of `used` whose place is nearest to that of sample `i`.
    fn nearest(&self, used: &[usize], i: usize) -> usize {
        let here = self.place(i);
        let squares = used.iter().map(|j| {
            let there = self.place(*j);
            ((there[0] - here[0]).powi(2) + (there[1] - here[1]).powi(2), *j)
        });
        squares.min_by(|a, b| a.0.total_cmp(&b.0)).expect("there is one").1
    }
    /// Returns the middles of the cells between neighbouring samples, [x, y] in mm.
    fn middles(&self) -> Vec<[f64; 2]> {
        (0..self.cells()).map(|cell| self.within_cell(cell, [0.5; 2])).collect()
    }

    /// Returns the number of cells between neighbouring samples.
    fn cells(&self) -> usize {
        match self {
            Self::Places(Grid { x, y }) => (x.len() - 1) * (y.len() - 1),
            Self::Azimuths { count, .. } | Self::Headings { count, .. } => *count,
        }
    }

    /// Returns the place [x, y] in a cell, mm; `part` is the position within it along x and y, 0 to 1. On a turn only
    /// the first part counts.
    fn within_cell(&self, cell: usize, part: [f64; 2]) -> [f64; 2] {
        match self {
            Self::Places(Grid { x, y }) => {
                let (r, c) = (cell / (x.len() - 1), cell % (x.len() - 1));
                [
                    x.coordinate_mm(c) + part[0] * x.step_mm(),
                    y.coordinate_mm(r) + part[1] * y.step_mm(),
                ]
            }
            Self::Azimuths { middle_mm, radius_mm, count } => {
                around(*middle_mm, *radius_mm, (cell as f64 + part[0]) / *count as f64)
            }
            Self::Headings { count, .. } => {
                around([0.0; 2], 1.0, (cell as f64 + part[0]) / *count as f64)
            }
        }
    }

    /// Returns the position and direction of motion of the tool for a place of the lattice.
    fn pose(&self, place: [f64; 2]) -> Pose {
        match self {
            Self::Places(_) | Self::Azimuths { .. } => {
                Pose { position_mm: place, heading_rad: 0.0 }
            }
            Self::Headings { positions: Grid { x, y }, .. } => Pose {
                position_mm: [x.start_mm(), y.start_mm()],
                heading_rad: place[1].atan2(place[0]),
            },
        }
    }

    /// Returns a place of the lattice as the report states it.
    fn named(&self, place: [f64; 2]) -> At {
        match self {
            Self::Places(_) | Self::Azimuths { .. } => At::PlaceMm(place),
            Self::Headings { .. } => {
                At::HeadingDeg(self.pose(place).heading_rad.to_degrees().rem_euclid(360.0))
            }
        }
    }
}

/// Returns the point at the distance `radius_mm` from a middle, at an azimuth counted from positive x in turns.
fn around(middle_mm: [f64; 2], radius_mm: f64, turns: f64) -> [f64; 2] {
    let (sine, cosine) = (std::f64::consts::TAU * turns).sin_cos();
    [middle_mm[0] + radius_mm * cosine, middle_mm[1] + radius_mm * sine]
}

/// Computes the kernels and weights of the tool `local_tool` on `offsets` that depends on the azimuth of its place
/// about `middle_mm` only, and removes within `radius_mm` of it. Refuses settings out of their range, and a tool that
/// removes nothing at an azimuth.
pub fn low_rank_by_azimuth(
    offsets: &Grid,
    (middle_mm, radius_mm): ([f64; 2], f64),
    local_tool: &LocalTool<'_>,
    settings: &LowRankSettings,
) -> Result<LowRank, Invalid> {
    low_rank_of_turn(
        offsets,
        |count| Lattice::Azimuths { middle_mm, radius_mm, count },
        local_tool,
        settings,
    )
}

/// Computes the kernels and weights of the tool `local_tool` on `offsets` that depends on the direction of its motion
/// only, which it gets as a unit vector [x, y]. The grid `positions` of the weights holds the places of the part.
/// Refuses settings out of their range, and a tool that removes nothing in a direction.
pub fn low_rank_by_heading(
    offsets: &Grid,
    positions: Grid,
    local_tool: &LocalTool<'_>,
    settings: &LowRankSettings,
) -> Result<LowRank, Invalid> {
    low_rank_of_turn(offsets, |count| Lattice::Headings { positions, count }, local_tool, settings)
}

/// Computes kernels and weights on the coarsest lattice of one turn, with doubled numbers of angles, that reaches the
/// wanted error.
fn low_rank_of_turn(
    offsets: &Grid,
    lattice_of: impl Fn(usize) -> Lattice,
    local_tool: &LocalTool<'_>,
    settings: &LowRankSettings,
) -> Result<LowRank, Invalid> {
    settings.check()?;
    let mut count = FIRST_ANGLES;
    loop {
        let is_last = 2 * count > MOST_ANGLES;
        match on_lattice(offsets, lattice_of(count), (local_tool, &|_| true), settings) {
            Ok(fit) if is_last || fit.low_rank.report.more_samples_do_not_help() => {
                return Ok(fit.with_largest_error(local_tool, &|_| true));
            }
            Err(Unreached::NoTool(refusal)) => return Err(refusal),
            Err(Unreached::Samples(refusal)) if is_last => return Err(refusal),
            // Few angles may say too little of the tool.
            _ => count *= 2,
        }
    }
}

/// Computes the kernels and weights of the tool `local_tool` on `offsets`, for places in the rectangle from `low_mm` to
/// `high_mm` [x, y]. Kernels and errors follow from the places at which `counts` is true, where the tool is used. The
/// places of the weights are `spacing_mm` apart, or as far as the wanted error allows.
///
/// # Errors
/// Refuses settings out of their range, a distance that makes too many places, no place at which the tool is used, and
/// a tool that removes nothing at such a place.
pub fn low_rank(
    offsets: &Grid,
    ([low_mm, high_mm], spacing_mm): ([[f64; 2]; 2], Option<f64>),
    local_tool: &LocalTool<'_>,
    counts: &Used<'_>,
    settings: &LowRankSettings,
) -> Result<LowRank, Invalid> {
    settings.check()?;
    if let Some(mm) = spacing_mm.filter(|mm| !(mm.is_finite() && *mm > 0.0)) {
        return Err(Invalid::whole("spacing_mm", format!("is {mm}"), "give a distance in mm"));
    }
    let size = [0, 1].map(|k| high_mm[k] - low_mm[k]);
    let mut spacing = spacing_mm.unwrap_or(size[0].max(size[1]) / FIRST_CELLS);
    loop {
        let [x, y] = [0, 1].map(|k| {
            let cells = (size[k] / spacing - 1e-9).ceil().max(1.0);
            Axis::new(low_mm[k], size[k].max(spacing) / cells, cells as usize + 1)
        });
        let positions = Grid { x: x?, y: y? };
        let places = positions.x.len() * positions.y.len();
        if places > MOST_PLACES && spacing_mm.is_some() {
            let problem = format!("is {spacing} mm, which makes {places} places");
            let remedy = format!("give one that makes at most {MOST_PLACES}");
            return Err(Invalid::whole("spacing_mm", problem, remedy));
        }
        let is_last = spacing_mm.is_some() || 4 * places > MOST_PLACES;
        match on_lattice(offsets, Lattice::Places(positions), (local_tool, counts), settings) {
            Ok(fit) if is_last || fit.low_rank.report.more_samples_do_not_help() => {
                return Ok(fit.with_largest_error(local_tool, counts));
            }
            Err(Unreached::NoTool(refusal)) => return Err(refusal),
            Err(Unreached::Samples(refusal)) if is_last => return Err(refusal),
            // On a coarse grid the few places may say too little of the tool.
            _ => spacing *= 0.5,
        }
    }
}

/// Reason for which there are no kernels and weights on a lattice.
enum Unreached {
    /// The tool removes nothing at a place where it is used; no other lattice helps.
    NoTool(Invalid),
    /// The samples do not make a valid tool; a finer lattice may help.
    Samples(Invalid),
}

/// Computes kernels and weights on one lattice. `counts` says at which places the tool is used.
fn on_lattice(
    offsets: &Grid,
    lattice: Lattice,
    (local_tool, counts): (&LocalTool<'_>, &Used<'_>),
    settings: &LowRankSettings,
) -> Result<LatticeFit, Unreached> {
    let count = lattice.len();
    let used: Vec<usize> =
        (0..count).into_par_iter().filter(|i| counts(lattice.place(*i))).collect();
    if used.is_empty() {
        let remedy = "give a map with valid pixels in the coordinates of the part";
        let problem = "has no place at which the tool is used";
        return Err(Unreached::Samples(Invalid::whole("surface", problem, remedy)));
    }
    let near = lattice.with_neighbours(&used);
    let Some(basis) = Basis::new(offsets, &lattice, &near, local_tool, settings) else {
        return Err(Unreached::NoTool(removes_nothing(lattice, used[0])));
    };
    // The interpolation between used places reads two places beyond them.
    let read: BTreeSet<usize> = lattice.with_neighbours(&near).into_iter().collect();
    let projected = (0..count).into_par_iter().map(|i| {
        if !read.contains(&i) {
            return None;
        }
        let sample = local_tool(lattice.place(i));
        if is_tool(&sample) { Some(basis.project(&sample)) } else { None }
    });
    let projected: Vec<Option<Projected>> = projected.collect();
    if let Some(i) = used.iter().find(|i| projected[**i].is_none()) {
        return Err(Unreached::NoTool(removes_nothing(lattice, *i)));
    }
    // Where nobody works, or the tool removes nothing beside where it is used, it is that of the nearest used place.
    let completed = (0..count).into_par_iter().map(|i| {
        let own = projected[i].clone();
        own.unwrap_or_else(|| {
            let nearest = &projected[lattice.nearest(&used, i)];
            nearest.clone().expect("the tool removes there")
        })
    });
    let samples: Vec<Projected> = completed.collect();
    let tool = basis.tool(offsets, lattice, &samples).map_err(Unreached::Samples)?;
    let tif = Tif::varying(tool.clone()).map_err(Unreached::Samples)?;
    let report = report(&basis, lattice, (&used, &samples), (local_tool, counts), &tif, settings);
    Ok(LatticeFit { basis, lattice, tif, low_rank: LowRank { tool, report } })
}

/// Returns the error for a tool that removes nothing at sample `i` of the lattice, where it is used.
fn removes_nothing(lattice: Lattice, i: usize) -> Invalid {
    let problem = format!("removes nothing at {}", lattice.named(lattice.place(i)));
    let remedy = "a tool that varies removes material wherever it is used: give factors of at least 0.001, make these \
                  pixels of the map invalid, or give a smaller `beyond_mm`";
    Invalid::whole("tool", problem, remedy)
}

/// Returns true if the samples have a finite and positive volume.
fn is_tool(sample: &Array2<f64>) -> bool {
    let volume = sample.sum();
    volume.is_finite() && volume > 0.0
}

fn dot(a: &Array2<f64>, b: &Array2<f64>) -> f64 {
    Zip::from(a).and(b).fold(0.0, |s, a, b| s + a * b)
}

/// Products of a sample of the tool with the kernels, and the sum of its squares.
#[derive(Clone)]
struct Projected {
    products: Vec<f64>,
    square: f64,
}

impl Projected {
    /// Returns the squared part of the sample that the kernels miss, `|K|^2 - sum_k a_k^2`, (nm/s)^2.
    fn missed(&self) -> f64 {
        (self.square - self.products.iter().map(|a| a * a).sum::<f64>()).max(0.0)
    }
}

/// The orthonormal kernels phi_k of (1) of the module, and the root mean square of the samples that they are made of,
/// nm/s.
struct Basis {
    kernels: Vec<Array2<f64>>,
    scale: f64,
}

impl Basis {
    /// Computes the kernels from the samples at the places `taken`, as few as the wanted error allows. `None` if none
    /// of these samples removes material.
    fn new(
        offsets: &Grid,
        lattice: &Lattice,
        taken: &[usize],
        local_tool: &LocalTool<'_>,
        settings: &LowRankSettings,
    ) -> Option<Self> {
        let LowRankSettings { error, max_rank } = *settings;
        let training = taken.len().min(MOST_TRAINING);
        // Evenly spread, by the golden ratio where not all are taken.
        let samples = (0..training).into_par_iter().map(|k| {
            let spread = ((k as f64 * GOLDEN).fract() * taken.len() as f64) as usize;
            let chosen = if training == taken.len() { k } else { spread };
            local_tool(lattice.place(taken[chosen]))
        });
        let mut samples: Vec<Array2<f64>> = samples.collect();
        samples.retain(is_tool);
        if samples.is_empty() {
            return None;
        }
        let training = samples.len();
        let rows: Vec<Vec<f64>> = (0..training)
            .into_par_iter()
            .map(|i| (0..=i).map(|j| dot(&samples[i], &samples[j])).collect())
            .collect();
        let products = DMatrix::from_fn(training, training, |i, j| rows[i.max(j)][i.min(j)]);
        let SymmetricEigen { eigenvalues, eigenvectors } = SymmetricEigen::new(products);
        let mut order: Vec<usize> = (0..training).collect();
        order.sort_by(|a, b| eigenvalues[*b].total_cmp(&eigenvalues[*a]));
        let total: f64 = eigenvalues.iter().map(|l| l.max(0.0)).sum();
        let mut left = total;
        let mut rank = 0;
        while rank < max_rank.min(training)
            && left > (PART_OF_RANK * error).powi(2) * total
            && eigenvalues[order[rank]] > f64::EPSILON * total
        {
            left -= eigenvalues[order[rank]];
            rank += 1;
        }
        let kernels = (0..rank).into_par_iter().map(|k| {
            let column = eigenvectors.column(order[k]);
            let mut kernel = Array2::<f64>::zeros(offsets.shape());
            for (sample, v) in samples.iter().zip(column.iter()) {
                kernel.scaled_add(v / eigenvalues[order[k]].sqrt(), sample);
            }
            // A sign that does not depend on the eigenvectors' own: the larger part of a kernel is positive.
            if kernel.sum() < 0.0 { -kernel } else { kernel }
        });
        Some(Self { kernels: kernels.collect(), scale: (total / training as f64).sqrt() })
    }

    /// Returns the products of a sample of the tool with the kernels: the weights of (2) of the module.
    fn project(&self, sample: &Array2<f64>) -> Projected {
        let products = self.kernels.iter().map(|kernel| dot(kernel, sample)).collect();
        Projected { products, square: dot(sample, sample) }
    }

    /// Returns the square of the error at a place `p` between the samples, (nm/s)^2. It is `|K - sum_k a_k phi_k|^2 =
    /// |K|^2 - 2 a . (phi . K) + |a|^2` with the interpolated weights a.
    /// - 2 a . (phi . K) + |a|^2` with the interpolated weights a.
    fn square_error(
        &self,
        tif: &Tif,
        lattice: Lattice,
        local_tool: &LocalTool<'_>,
        p: [f64; 2],
    ) -> f64 {
        let Projected { products, square } = self.project(&local_tool(p));
        let mut error = square;
        for (k, product) in products.iter().enumerate() {
            // A tool that turns out to be the same everywhere has no weights.
            let weight = tif.variation().map_or(1.0, |v| v.weight(k, lattice.pose(p)));
            let a = weight * self.scale;
            error += a * a - 2.0 * a * product;
        }
        error.max(0.0)
    }

    /// Makes the tool of these kernels, with the products `samples` on a lattice as weights.
    fn tool(
        &self,
        offsets: &Grid,
        lattice: Lattice,
        samples: &[Projected],
    ) -> Result<VaryingTif, Invalid> {
        let rank = self.kernels.len();
        // Weights of every kernel at the samples, and the angles of these on a turn.
        let by_kernel =
            (0..rank).map(|k| samples.iter().map(|s| s.products[k] / self.scale).collect());
        let by_kernel: Vec<Vec<f64>> = by_kernel.collect();
        let count = samples.len();
        let degrees = (0..count).map(|i| 360.0 * i as f64 / count as f64).collect();
        let mut azimuth = None;
        let mut heading = None;
        let (positions, weights) = match lattice {
            Lattice::Places(positions) => {
                let maps = by_kernel.into_iter().map(|weights| {
                    Array2::from_shape_vec(positions.shape(), weights)
                        .expect("one weight per place")
                });
                (positions, maps.collect())
            }
            Lattice::Azimuths { middle_mm, radius_mm, .. } => {
                let [x, y] =
                    middle_mm.map(|middle| Axis::new(middle - radius_mm, 2.0 * radius_mm, 2));
                let positions = Grid { x: x?, y: y? };
                azimuth = Some(AzimuthWeights::new(middle_mm, degrees, by_kernel)?);
                (positions, vec![Array2::ones(positions.shape()); rank])
            }
            Lattice::Headings { positions, .. } => {
                heading = Some(TurnWeights::by_heading(degrees, by_kernel)?);
                (positions, vec![Array2::ones(positions.shape()); rank])
            }
        };
        Ok(VaryingTif {
            offsets: *offsets,
            kernels: self.kernels.iter().map(|kernel| kernel * self.scale).collect(),
            positions,
            weights,
            azimuth,
            heading,
            pixels: None,
            time: None,
        })
    }
}

/// Computes the errors of the kernels and weights, at the samples of the weights and between them.
fn report(
    basis: &Basis,
    lattice: Lattice,
    (used, samples): (&[usize], &[Projected]),
    (local_tool, counts): (&LocalTool<'_>, &Used<'_>),
    tif: &Tif,
    settings: &LowRankSettings,
) -> LowRankReport {
    let used_samples = used.iter().map(|i| &samples[*i]);
    let squares = used_samples.clone().map(|s| s.square).sum::<f64>() / used.len() as f64;
    let missed = used_samples.map(Projected::missed);
    let of_rank = missed.clone().sum::<f64>() / used.len() as f64;
    let largest_of_rank = missed.fold(0.0, f64::max);
    let inside: Vec<[f64; 2]> = lattice.middles().into_par_iter().filter(|p| counts(*p)).collect();
    let measured = inside.len().min(MOST_MEASURED);
    let errors: Vec<(f64, [f64; 2])> = (0..measured)
        .into_par_iter()
        .map(|k| inside[k * inside.len() / measured])
        .map(|p| (basis.square_error(tif, lattice, local_tool, p), p))
        .collect();
    let of_cells = errors.iter().map(|e| e.0).sum::<f64>() / measured.max(1) as f64;
    let first = (0.0, lattice.place(used[0]));
    let worst = errors.iter().fold(first, |a, b| if b.0 > a.0 { *b } else { a });
    let relative = |square: f64| (square / squares).sqrt();
    LowRankReport {
        rank: basis.kernels.len(),
        samples: lattice.samples(),
        rank_error: relative(of_rank),
        largest_rank_error: relative(largest_of_rank),
        error: relative(of_cells).max(relative(of_rank)),
        largest_error: relative(worst.0.max(largest_of_rank)),
        largest_error_at: lattice.named(worst.1),
        wanted_error: settings.error,
        squares,
    }
}

/// Kernels and weights on one lattice, with the data from which their errors are measured.
struct LatticeFit {
    basis: Basis,
    lattice: Lattice,
    tif: Tif,
    low_rank: LowRank,
}

impl LatticeFit {
    /// Returns the tool with its largest error, searched in up to [`MOST_SEARCHED`] cells and further in the worst of
    /// them.
    fn with_largest_error(self, local_tool: &LocalTool<'_>, counts: &Used<'_>) -> LowRank {
        let Self { basis, lattice, tif, low_rank: LowRank { tool, mut report } } = self;
        let measured = |cell: usize, part: [f64; 2]| {
            let p = lattice.within_cell(cell, part);
            if counts(p) {
                Some((basis.square_error(&tif, lattice, local_tool, p), cell, p))
            } else {
                None
            }
        };
        let searched = lattice.cells().min(MOST_SEARCHED);
        let mut errors: Vec<(f64, usize, [f64; 2])> = (0..searched)
            .into_par_iter()
            .filter_map(|k| {
                let cell = k * lattice.cells() / searched;
                measured(cell, SPREAD.map(|by| (cell as f64 * by).fract()))
            })
            .collect();
        errors.sort_by(|a, b| b.0.total_cmp(&a.0));
        let (cells, side) = SEARCHED_FURTHER;
        let worst: Vec<usize> = errors.iter().take(cells).map(|e| e.1).collect();
        let further = (0..worst.len() * side * side).into_par_iter().filter_map(|k| {
            let cell = worst[k / (side * side)];
            let i = k % (side * side);
            measured(cell, [i % side, i / side].map(|i| (i as f64 + 0.5) / side as f64))
        });
        errors.extend(further.collect::<Vec<_>>());
        for (square, _, p) in errors {
            let error = (square / report.squares).sqrt();
            if error > report.largest_error {
                report.largest_error = error;
                report.largest_error_at = lattice.named(p);
            }
        }
        LowRank { tool, report }
    }
}
