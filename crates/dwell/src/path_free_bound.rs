//! A lower bound of the residual on any path, and the dwell times that nearly reach it.
//!
//! Whatever the path, the motion and the machine: the time that the tool spends at each place is a measure m >= 0 of
//! total mass T on the plane, and what it removes is linear in that measure,
//!
//! ```text
//! (K m)_i = int R(x_i - p) dm(p),        residual r = z - c - K m,  c its mean over the N valid pixels
//! ```
//!
//! Take any map e without mean, and let `q = max over all p of (K'e)(p) = sum_i e_i R(x_i - p)`, at least 0. Then
//!
//! ```text
//! |e| |r| >= e'r = e'z - int (K'e)(p) dm(p) >= e'z - T q
//! RMS of r >= (e'z - T q) / (sqrt(N) |e|)                  for every m of total mass T or less         (1)
//! ```
//!
//! by the inequality of Cauchy and Schwarz. (1) needs no optimum: every e gives a valid bound, for every T. The best e
//! is the residual of the best m, by the duality of
//!
//! ```text
//! min over m >= 0, int dm <= T:  1/2 |z - c - K m|^2                                               (2)
//! ```
//!
//! So the work is to find an e that is nearly the best one, and to bound q rigorously:
//!
//! 1. `splines`, `interior_point`: the best e among those that differ from z by splines, with `K'e` bounded at places a
//!    fraction of the tool apart. Rounds add the places at which `K'e` is highest, until it is bounded at all places of
//!    a lattice at the pitch of the map or finer.
//! 2. `highest`: q over the plane, between the nodes of every lattice, too. It gives (1).
//! 3. The multipliers of the constraints are dwell times at their places. Their residual is the *reached* residual: a
//!    plan that could stand at these places would leave it.
//! 4. `alternating`: where the bound is not near that, another e and other dwell times without splines. The larger bound
//!    and the smaller residual count. Splines that are the pixels miss nothing, and need no other way.
//! 5. Where the two still differ, the map by which the splines miss the better residual joins them, and the rounds go
//!    on.
//!
//! The gap between the reached residual and the bound says how good both are: the least residual on any path is
//! between them. The bound is for the tool on the lattice of the map ([`planish_types::TifLattice`]), which is the tool
//! itself if its pitch is that of the map. It is (1) in double precision; the rounding of q is part of it.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | z | `desired_nm` | (ny, nx) | nm |
//! | e, r | `residual_nm` | (ny, nx) | nm |
//! | m | `dwell_s` | (places along y, along x) | s |
//! | q, nu, Lambda | `value`, `price` | | nm^2/s times pixels |

mod alternating;
mod highest;
mod interior_point;
mod splines;
mod tool;

use std::{collections::BTreeSet, ops::RangeInclusive};

use ndarray::{Array1, Array2, Zip};
pub use planish_types::outcome::bound::{PathFreeBound, PathFreeBounds};
use planish_types::{
    Grid, Invalid, OnLattice, PARTS_TOLERANCE, Surface, Tif, TifLattice, progress,
};
use serde::Serialize;

use crate::DwellError;
use alternating::Directions;
use highest::{Highest, highest};
use splines::{Constraints, Splines};
use tool::{LatticeTool, PartPixels, Place, product, squares};

/// Distances of the splines relative to the length of the flanks of the tool: those that find the constraints, and
/// those of the bound. Larger: a smaller bound. Smaller: time that grows with its fourth power.
const PITCHES_OF_SPLINES: [f64; 2] = [0.75, 0.45];

/// Distance of the places relative to the length of the flanks of the tool. Larger: dwell times between the places are
/// missed, and the best residual on the places is larger. Smaller: more memory and time.
const PITCH_OF_PLACES: f64 = 1.0 / 40.0;

/// The same for the places of alternating directions.
const PITCH_OF_DIRECTIONS: f64 = 1.0 / 8.0;

/// Distance of an adjoint from the price, relative to that of the lowest adjoint, up to which a constraint stays when
/// the splines become finer. Smaller: more rounds. Larger: more time for each.
const NEAR_PRICE: f64 = 0.1;

/// Distance of the first constraints relative to the length of the flanks of the tool. Larger: more rounds. Smaller:
/// more time for each.
const PITCH_OF_CONSTRAINTS: f64 = 0.5;

/// Largest number of rounds with the fine splines, each with constraints at the highest places of the round before.
/// Larger: a larger bound. Smaller: less time.
const MAX_ROUNDS: usize = 14;

/// Number of rounds with the fine splines after which the constraints that are not used go. Larger: less time for each
/// round, and constraints that go and come back. Smaller: more time.
const ROUNDS_THAT_DROP: usize = 4;

/// Multiplier relative to the mean one below which a constraint is not used. Larger: more rounds. Smaller: more time for
/// each.
const UNUSED: f64 = 0.01;

/// Part of the bound that the places which are no constraints take from it, at which the rounds end. Larger: a smaller
/// bound. Smaller: more rounds.
const SMALL_LOSS: f64 = 1e-3;

/// Complementarity, relative to the square of the residual, at which a round ends: with the coarse and with the fine
/// splines. Larger: a smaller bound, by a quarter of the last one. Smaller: more steps.
const COMPLEMENTARITY: [f64; 2] = [5e-3, 1e-3];

/// Gap at which a bound needs no other way. Larger: a smaller bound. Smaller: more time.
const SMALL_GAP: f64 = 0.01;

/// Gaps at which rounds with the map that the splines miss follow. Smaller gaps: more time for a gain of a few 0.1 %.
/// Larger gaps: more time where one map is not enough.
const WORTH_ANOTHER: RangeInclusive<f64> = SMALL_GAP..=0.2;

/// Time that a run may take, or the price of it.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Budget {
    /// Total time, s.
    TimeS(f64),
    /// Price of a second in half the sum of the squares, nm^2/s times pixels.
    Price(f64),
}

impl Budget {
    /// Returns the time, s, of a run whose dwell times have this sum, s.
    fn time_s(self, dwell_s: f64) -> f64 {
        match self {
            Self::TimeS(time_s) => time_s,
            Self::Price(_) => dwell_s,
        }
    }

    /// Returns the dwell times, s, nearest to these numbers that are not negative and keep the budget. A price is that
    /// of a second relative to half the sum of the squares of the differences times `weight`.
    fn nearest_s(self, mut dwell_s: Array2<f64>, weight: f64) -> Array2<f64> {
        let less_s = match self {
            Self::Price(price) => price / weight,
            Self::TimeS(time_s) => excess_s(&dwell_s, time_s),
        };
        dwell_s.mapv_inplace(|t| (t - less_s).max(0.0));
        dwell_s
    }
}

/// Returns the time, s, by which all dwell times have to fall so that those above 0 have the sum `time_s`; 0 if it is
/// smaller already.
///
/// Source: C. Michelot, J. Optim. Theory Appl. 50 (1986) 195.
fn excess_s(dwell_s: &Array2<f64>, time_s: f64) -> f64 {
    let mut above: Vec<f64> = dwell_s.iter().copied().filter(|t| *t > 0.0).collect();
    let mut less_s = 0.0;
    loop {
        let excess = (above.iter().sum::<f64>() - time_s) / above.len() as f64;
        if above.is_empty() || excess <= less_s {
            return less_s;
        }
        less_s = excess;
        above.retain(|t| *t > less_s);
    }
}

/// Run times and prices of a second for which bounds are found.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct BoundSettings {
    /// Run times, s.
    pub time_s: Vec<f64>,
    /// Prices of a second, relative to half the mean square of the residual, nm^2/s.
    pub time_weight_nm2_per_s: Vec<f64>,
}

/// Finds lower bounds of the residual RMS of the desired removal that any path and motion of the tool can leave.
///
/// # Errors
/// Refuses no time and no price, a time or a price that is not positive, and what [`BoundProblem::new`] refuses.
pub fn bounds_on_any_path(
    desired: &Surface,
    tif: &Tif,
    settings: &BoundSettings,
) -> Result<PathFreeBounds, DwellError> {
    settings.check()?;
    let problem = BoundProblem::new(desired, tif)?;
    let prices = settings.time_weight_nm2_per_s.iter();
    let budgets: Vec<Budget> = (settings.time_s.iter().map(|t| Budget::TimeS(*t)))
        .chain(prices.map(|price| Budget::Price(price * problem.part.pixels)))
        .collect();
    let mut bounds = Vec::with_capacity(budgets.len());
    for (k, budget) in budgets.iter().enumerate() {
        bounds.push(progress::part(k, budgets.len(), || problem.bound(*budget)));
    }
    Ok(PathFreeBounds {
        pixels: problem.part.pixels as usize,
        desired_rms_nm: problem.desired_rms_nm(),
        tif_lattice: problem.lattice.if_anew(),
        bounds,
    })
}

impl BoundSettings {
    /// Refuses no time and no price, and those that are not positive.
    fn check(&self) -> Result<(), Invalid> {
        if self.time_s.is_empty() && self.time_weight_nm2_per_s.is_empty() {
            let remedy = "give at least one, or a `time_weight_nm2_per_s`";
            return Err(Invalid::whole("time_s", "is missing", remedy));
        }
        for (name, values) in
            [("time_s", &self.time_s), ("time_weight_nm2_per_s", &self.time_weight_nm2_per_s)]
        {
            if let Some(k) = values.iter().position(|v| !(v.is_finite() && *v > 0.0)) {
                let problem = format!("is {}", values[k]);
                return Err(Invalid::at_index(name, k, problem, "give a number above 0"));
            }
        }
        Ok(())
    }
}

/// A part and a tool, with everything that is the same for all run times.
pub struct BoundProblem {
    grid: Grid,
    /// Tool on the lattice of the map.
    tif: Tif,
    lattice: TifLattice,
    part: PartPixels,
    tool: LatticeTool,
    /// Coarse and fine splines.
    splines: [Splines; 2],
    /// Adjoint products of the desired removal at all places of the lattice, for every limit of the tool.
    adjoints: Vec<Array2<f64>>,
    /// The first constraints, for the coarse splines.
    constraints: Constraints,
}

impl BoundProblem {
    /// Makes what the bounds of a part and a tool share.
    ///
    /// # Errors
    /// Refuses a tool that varies, a TIF that cannot be sampled on the lattice of the map, and a map that no removal
    /// makes flatter.
    pub fn new(desired: &Surface, tif: &Tif) -> Result<Self, DwellError> {
        tif.same_everywhere("the bound on any path")?;
        let grid = *desired.grid();
        let OnLattice { tif, lattice } = tif.on_lattice_of(&grid, PARTS_TOLERANCE)?;
        let part = PartPixels::new(desired);
        let tool = LatticeTool::new(&tif, &grid, PITCH_OF_PLACES);
        let splines = PITCHES_OF_SPLINES.map(|pitch| Splines::new(&part, &tool, pitch));
        let adjoints = tool.adjoints(&part.desired_nm);
        let every = tool.apart(PITCH_OF_CONSTRAINTS);
        let (rows, columns) = adjoints[0].dim();
        if adjoints[0].iter().all(|q| *q <= 0.0) {
            return Err(DwellError::OutOfReach { points: rows * columns });
        }
        let first: Vec<Place> = (0..rows)
            .step_by(every[1])
            .flat_map(|r| {
                (0..columns).step_by(every[0]).map(move |c| Place { index: (r, c), limit: 0 })
            })
            .collect();
        let mut constraints = splines[0].unconstrained();
        constraints.add(&first, &splines[0], (&part, &tool), &adjoints);
        let tif = tif.into_owned();
        Ok(Self { grid, tif, lattice, part, tool, splines, adjoints, constraints })
    }

    /// Returns the RMS of the desired removal, nm.
    pub fn desired_rms_nm(&self) -> f64 {
        self.part.rms(&self.part.desired_nm)
    }

    /// Returns the bound for a run time, s.
    pub fn at_time(&self, time_s: f64) -> PathFreeBound {
        self.bound(Budget::TimeS(time_s))
    }

    /// Returns the bound for a budget.
    fn bound(&self, budget: Budget) -> PathFreeBound {
        let first = self.by_splines(budget);
        let mut best_nm = self.left_nm(&first);
        let mut bound = self.of_round(&first, &best_nm, budget);
        if self.splines[1].are_pixels() {
            return bound;
        }
        if bound.gap > SMALL_GAP {
            let (by_directions, residual_nm) = self.by_directions(budget);
            if by_directions.gap < bound.gap {
                best_nm = residual_nm;
            }
            bound = better(bound, by_directions);
        }
        if !WORTH_ANOTHER.contains(&bound.gap) {
            return bound;
        }
        let splines = self.splines[1].with(&first.residual_nm - &best_nm, &self.part);
        let second = self.rounds(&splines, first.places, budget);
        better(bound, self.of_round(&second, &self.left_nm(&second), budget))
    }

    /// Returns the bound by alternating directions, and its map e (ny, nx), nm.
    fn by_directions(&self, budget: Budget) -> (PathFreeBound, Array2<f64>) {
        let tool = LatticeTool::new(&self.tif, &self.grid, PITCH_OF_DIRECTIONS);
        let Directions { residual_nm, dwell_s } = alternating::solve(&self.part, &tool, budget);
        let time_s = budget.time_s(dwell_s.sum());
        let left_nm = self.part.residual_nm(tool.removal_nm(&[dwell_s]));
        let highest = highest(&residual_nm, &self.tif, &self.grid);
        (self.by_map(&residual_nm, highest, self.part.rms(&left_nm), time_s), residual_nm)
    }

    /// Returns the bound by the residual of a round, whose dwell times leave `left_nm`.
    fn of_round(&self, round: &Round, left_nm: &Array2<f64>, budget: Budget) -> PathFreeBound {
        let time_s = budget.time_s(round.dwell_s.sum());
        let highest = highest(&round.residual_nm, &self.tif, &self.grid);
        self.by_map(&round.residual_nm, highest, self.part.rms(left_nm), time_s)
    }

    /// Returns the residual (ny, nx) without mean, nm, after the dwell times of a round.
    fn left_nm(&self, round: &Round) -> Array2<f64> {
        let mut dwell_s = vec![Array2::zeros(self.adjoints[0].dim()); self.adjoints.len()];
        for (place, time_s) in round.places.iter().zip(&round.dwell_s) {
            dwell_s[place.limit][place.index] += *time_s;
        }
        self.part.residual_nm(self.tool.removal_nm(&dwell_s))
    }

    /// Returns the bound (1) of the module by the map e `residual_nm`.
    fn by_map(
        &self,
        residual_nm: &Array2<f64>,
        highest: Highest,
        reached_rms_nm: f64,
        time_s: f64,
    ) -> PathFreeBound {
        let Highest { value, place_mm } = highest;
        let along = product(residual_nm, &self.part.desired_nm);
        let norm = self.part.pixels * self.part.rms(residual_nm);
        // Without a bound above 0 there is no slope: a bound of 0 holds at every time.
        let (bound_rms_nm, bound_slope_nm_per_s) = if along > time_s * value {
            ((along - time_s * value) / norm, value / norm)
        } else {
            (0.0, 0.0)
        };
        PathFreeBound {
            time_s,
            bound_rms_nm,
            reached_rms_nm,
            gap: gap(bound_rms_nm, reached_rms_nm),
            bound_slope_nm_per_s,
            time_weight_nm2_per_s: value / self.part.pixels,
            place_mm,
        }
    }

    /// Returns the round with the best e by splines.
    fn by_splines(&self, budget: Budget) -> Round {
        let [coarse, fine] = &self.splines;
        let round = self.round(coarse, &self.constraints, budget, COMPLEMENTARITY[0]);
        let lowest = round.adjoints.iter().flatten().copied().fold(0.0, f64::min);
        let least = round.price - NEAR_PRICE * (round.price - lowest);
        let is_near = |place: &&Place| round.adjoints[place.limit][place.index] >= least;
        let near = self.constraints.places.iter().filter(is_near);
        self.rounds(fine, near.copied().collect(), budget)
    }

    /// Returns the round with the best e by these splines: with constraints at `places`, then where it needs them.
    fn rounds(&self, splines: &Splines, places: Vec<Place>, budget: Budget) -> Round {
        let mut constraints = splines.unconstrained();
        constraints.add(&places, splines, (&self.part, &self.tool), &self.adjoints);
        let mut number = 1;
        loop {
            let round = self.round(splines, &constraints, budget, COMPLEMENTARITY[1]);
            if number == MAX_ROUNDS || round.loss <= SMALL_LOSS {
                return round;
            }
            progress::done(number as f64 / MAX_ROUNDS as f64);
            if number <= ROUNDS_THAT_DROP {
                constraints = constraints.used(&round.dwell_s, UNUSED);
            }
            let new = self.highest_places(&round, number, &constraints.places);
            constraints.add(&new, splines, (&self.part, &self.tool), &self.adjoints);
            number += 1;
        }
    }

    /// Returns the best e for these splines and constraints.
    fn round(
        &self,
        splines: &Splines,
        constraints: &Constraints,
        budget: Budget,
        complementarity: f64,
    ) -> Round {
        let problem = interior_point::InteriorProblem {
            splines,
            constraints,
            energy: squares(&self.part.desired_nm),
            scale_s: self.scale_s(),
            complementarity,
        };
        let solution = interior_point::solve(problem, budget);
        let residual_nm = self.part.residual_nm(splines.map(&solution.coefficients, &self.part));
        let adjoints = self.tool.adjoints(&residual_nm);
        let places = constraints.places.clone();
        let at_places = places.iter().map(|place| adjoints[place.limit][place.index]);
        let price = at_places.fold(0.0, f64::max);
        let highest = adjoints.iter().flatten().copied().fold(0.0, f64::max);
        let dwell_s = solution.dwell_s;
        let time_s = budget.time_s(dwell_s.sum());
        // e'z - T price is nearly |e|^2: what is left of (1) without the excess of the highest adjoint over the price.
        let loss = time_s * (highest - price).max(0.0) / squares(&residual_nm);
        Round { residual_nm, adjoints, price, loss, places, dwell_s }
    }

    /// Returns the places at which the adjoint has a local maximum above `price`, over all limits of the tool, and
    /// four places around each, that are no constraints yet. The four are nearer with every round. Of maxima that are
    /// nearer to each other than these, the highest counts.
    fn highest_places(&self, round: &Round, number: usize, old: &[Place]) -> Vec<Place> {
        let Round { adjoints, price, .. } = round;
        let [across, along] = self.tool.apart(PITCH_OF_CONSTRAINTS / f64::from(1 << number));
        let mut largest = adjoints[0].clone();
        let mut limits = Array2::from_elem(largest.dim(), 0);
        for (limit, adjoint) in adjoints.iter().enumerate().skip(1) {
            Zip::from(&mut largest).and(&mut limits).and(adjoint).for_each(|most, which, v| {
                if *v > *most {
                    (*most, *which) = (*v, limit);
                }
            });
        }
        let mut maxima: Vec<((usize, usize), f64)> = (largest.indexed_iter())
            .map(|(index, value)| (index, *value))
            .filter(|(index, value)| value > price && is_local_maximum(&largest, *index, *value))
            .collect();
        maxima.sort_by(|(_, a), (_, b)| b.total_cmp(a));
        let mut used: BTreeSet<Place> = old.iter().copied().collect();
        let mut new = Vec::new();
        for index in apart(maxima, (along, across)) {
            let beside = around(index, (along, across), largest.dim())
                .filter(|near| near.0 == index.0 || near.1 == index.1);
            for near in beside {
                let place = Place { index: near, limit: limits[index] };
                if used.insert(place) {
                    new.push(place);
                }
            }
        }
        new
    }

    /// Returns a rough time, s, for the removal of the mean absolute desired removal.
    fn scale_s(&self) -> f64 {
        let volume = self.part.desired_nm.mapv(f64::abs).sum();
        volume / self.tool.samples().sum() * (self.tool.parts[0] * self.tool.parts[1]) as f64
    }
}

/// Best e for some splines and constraints.
struct Round {
    residual_nm: Array2<f64>,
    /// Adjoint products of e at all places of the lattice, for every limit of the tool.
    adjoints: Vec<Array2<f64>>,
    /// Largest adjoint at the constraints.
    price: f64,
    /// Part of the bound that the excess of the largest adjoint over the price takes from it.
    loss: f64,
    /// Places of the constraints.
    places: Vec<Place>,
    /// Multipliers of the constraints, s.
    dwell_s: Array1<f64>,
}

/// Returns the better of two bounds for the same budget: for a time, with the smaller of the reached residuals.
fn better(a: PathFreeBound, b: PathFreeBound) -> PathFreeBound {
    if a.time_s != b.time_s {
        return if b.gap < a.gap { b } else { a };
    }
    let reached_rms_nm = a.reached_rms_nm.min(b.reached_rms_nm);
    let larger = if b.bound_rms_nm > a.bound_rms_nm { b } else { a };
    PathFreeBound { reached_rms_nm, gap: gap(larger.bound_rms_nm, reached_rms_nm), ..larger }
}

/// Returns the gap between a bound and the residual that is reached, relative to the latter.
fn gap(bound_rms_nm: f64, reached_rms_nm: f64) -> f64 {
    if reached_rms_nm > 0.0 { 1.0 - bound_rms_nm / reached_rms_nm } else { 0.0 }
}

/// Returns true if no neighbour of an element of a map is larger than its value.
fn is_local_maximum(map: &Array2<f64>, (r, c): (usize, usize), value: f64) -> bool {
    around((r, c), (1, 1), map.dim()).all(|(row, column)| map[[row, column]] <= value)
}

/// Returns the indices of the maxima, the highest first, that are more than `step` (rows, columns) from those before.
fn apart(maxima: Vec<((usize, usize), f64)>, step: (usize, usize)) -> Vec<(usize, usize)> {
    let mut apart: Vec<(usize, usize)> = Vec::new();
    for ((r, c), _) in maxima {
        let mut others = apart.iter();
        if others.all(|other| r.abs_diff(other.0) > step.0 || c.abs_diff(other.1) > step.1) {
            apart.push((r, c));
        }
    }
    apart
}

/// Returns the indices of an element and of those `step` (rows, columns) away from it within an array of this shape.
fn around(
    (r, c): (usize, usize),
    step: (usize, usize),
    shape: (usize, usize),
) -> impl Iterator<Item = (usize, usize)> {
    let rows = [r.checked_sub(step.0), Some(r), Some(r + step.0)].into_iter().flatten();
    rows.filter(move |row| *row < shape.0).flat_map(move |row| {
        let columns = [c.checked_sub(step.1), Some(c), Some(c + step.1)].into_iter().flatten();
        columns.filter(move |column| *column < shape.1).map(move |column| (row, column))
    })
}
