//! States of the search of [`super::solve`]. One step goes through these:
//!
//! ```text
//! look --> refer --> prove --> conclude --> keep tangents --> step --> look ...
//!            |                    |  |  |                       |
//!            +--------------------|--|--+-----------------------+
//!                            an end  +--> move --> look
//! ```
//!
//! | state | transition |
//! |---|---|
//! | look | how small is the complementarity; is something to be proven here? |
//! | refer | f with the removal itself, where something is to be proven or the last such f is far away |
//! | prove | the gap at the iterate |
//! | conclude | an end; or tangents are kept; or the convex program of the tangents is solved; or a step |
//! | keep tangents | the rows give way to their tangents at the iterate |
//! | move | the iterate moves towards the solution under the tangents, and the rows come back |
//! | step | the step by (2), as far as it is allowed |

use planish_types::{End, progress};

use super::{
    iterate::{Executable, Iterate, PROGRAM_SOLVED, Start},
    program::{Inverse, Program},
};
use crate::{
    JointError,
    merit::{Merit, Progress},
};

/// Fraction of the progress bar for the steps until the complementarity is small enough; the rest is for the proof.
/// Larger or smaller: the bar moves faster or slower towards its end, and nothing else changes. Chosen.
const BEFORE_PROOF: f64 = 0.75;

/// Largest fall of the objective in a step, over the wanted gap, at which the search begins to keep tangents. Larger:
/// proofs begin earlier and fail more often. Smaller: steps after the objective has nearly stopped to fall. Chosen.
const STILL_FALLING: f64 = 0.3;

/// Factor, after each proof that failed, on the largest complementarity at which the search begins to keep tangents.
/// Larger: the next proof begins sooner and may fail again. Smaller: more steps before the next proof. Chosen.
const KEPT_AGAIN: f64 = 0.25;

/// Least ratio of the complementarity to the wanted gap that may be demanded before the search keeps tangents. Larger:
/// proofs begin earlier. Smaller: many steps if the rows bend much, because the iterate then moves slowly along them.
/// Chosen.
const LEAST_KEPT_BELOW: f64 = 0.06;

/// Least number of steps under the rows themselves after a proof that failed. Larger: later proofs. Smaller: the next
/// proof begins at nearly the same iterate and fails as well, up to the last step. Chosen.
const LEAST_STEPS_BETWEEN_PROOFS: usize = 3;

/// Number of last steps that are left for the proof: in these, the search keeps tangents as soon as the complementarity
/// is as small as the wanted gap. Larger: fewer steps lower the objective. Smaller: the last proof is not finished.
/// Chosen: a proof usually takes about as many.
const STEPS_OF_A_PROOF: usize = 25;

/// Fall of the complementarity, as a ratio to its value at the last exact evaluation, at which the objective is
/// computed with the removal itself again. Larger: more convolutions of the map. Smaller: the objective is less exact,
/// because the cells of the normal matrix lose a part. Chosen.
pub(super) const REFERRED_AGAIN: f64 = 0.1;

/// Progress before any step of the search.
pub(super) const FIRST: Progress = Progress { iteration: 0, complementarity: f64::INFINITY };

/// Conditions under which the search stops.
#[derive(Clone, Copy, Debug)]
pub struct Stop {
    /// Wanted gap: proven excess of the objective over its least value, relative to the objective.
    pub relative_gap: f64,
    /// Largest number of steps.
    pub max_iterations: usize,
}

/// Best iterate that the search found, with the history of the search.
#[derive(Clone, Debug)]
pub struct Solution {
    /// Densities of the nodes (D, n), s/mm.
    pub density: Vec<f64>,
    /// Objective at every iterate under the rows themselves (not under kept tangents), nm^2; [`crate::merit`] says
    /// where it is exact.
    pub objective: Vec<f64>,
    /// Number of steps.
    pub iterations: usize,
    /// Dual variables of the rows (z) and of the bounds (y, n) at the last iterate.
    pub duals: [Vec<f64>; 2],
    /// Proven gap over the objective at the returned densities.
    pub relative_gap: f64,
    /// Reason for the end of the search: `optimal` or `iteration-limit`.
    pub end: End,
}

/// Condition for keeping tangents in the place of the rows. It is stricter after each proof that failed.
struct Patience {
    /// Largest complementarity (sum of slacks times dual variables) at which a proof may begin, over the wanted gap.
    below: f64,
    /// First step at which a proof may begin.
    from: usize,
}

impl Patience {
    const FIRST: Self = Self { below: 1.0, from: 0 };

    /// Returns true if a proof may begin; the objective has just fallen by `fall_nm2`, and `wanted_nm2` is the wanted
    /// gap.
    fn ends(&self, there: Progress, fall_nm2: f64, wanted_nm2: f64) -> bool {
        let falls = fall_nm2 > STILL_FALLING * wanted_nm2;
        there.complementarity <= self.below * wanted_nm2 && !falls && there.iteration >= self.from
    }

    /// Returns the condition after a proof that failed at the step of this number.
    fn after_failure(&self, iteration: usize) -> Self {
        Self {
            below: (self.below * KEPT_AGAIN).max(LEAST_KEPT_BELOW),
            from: iteration + LEAST_STEPS_BETWEEN_PROOFS,
        }
    }
}

/// Best of the iterates whose gap is known.
#[derive(Default)]
struct Best {
    iterate: Option<Executable>,
    /// True if its objective is at the final price of time; others cannot be compared.
    is_settled: bool,
}

impl Best {
    /// Replaces the best iterate by `iterate` if that has a lower objective, cannot be compared, or is proven
    /// (`optimal`).
    fn offer(&mut self, iterate: Executable, is_settled: bool, optimal: bool) {
        let comparable = is_settled && self.is_settled && !optimal;
        if !comparable || self.iterate.as_ref().is_none_or(|best| iterate.value <= best.value) {
            *self = Self { iterate: Some(iterate), is_settled };
        }
    }
}

/// State of the search at the iterate, before the step from it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Look {
    there: Progress,
    /// Wanted gap, nm^2.
    wanted_nm2: f64,
    /// True if the search tries to prove the gap here.
    near: bool,
    /// True if no step is left: the largest number of steps is reached.
    last: bool,
}

impl Look {
    /// Returns true if the gap here decides what the search does next.
    pub(super) fn decides(&self) -> bool {
        self.near || self.last
    }
}

/// State that follows a proof.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Next {
    /// The search ends for this reason.
    End(End),
    /// The convex program of the tangents is solved, and proves too little: the iterate moves towards its solution.
    Move,
    /// The tangents at the iterate replace the rows.
    KeepTangents,
    Step,
}

/// Search between two of its states.
pub(super) struct Search<'a> {
    program: &'a Program<'a>,
    stop: Stop,
    row_of: Vec<usize>,
    at: Iterate<'a>,
    /// True if the price of time in the objective is found. Nothing is proven before.
    settled: bool,
    best: Best,
    /// Inverse of the curvature of the objective alone; `None` until the first proof needs it.
    of_curvature: Option<Inverse<'a>>,
    /// Objective at every iterate under the rows themselves, nm^2.
    values: Vec<f64>,
    iteration: usize,
    /// Objective before the last step, nm^2.
    value_before: f64,
    patience: Patience,
    first_complementarity: f64,
    /// Complementarity at which the objective was last computed with the removal itself.
    referred_at: f64,
}

impl<'a> Search<'a> {
    pub(super) fn new(
        program: &'a Program<'a>,
        start: Start,
        stop: Stop,
        merit: &mut Merit<'_>,
    ) -> Self {
        let (f, settled) = merit.evaluate(FIRST, &start.density);
        let at = Iterate::new(program, start, f);
        let first_complementarity = at.complementarity();
        Self {
            program,
            stop,
            row_of: program.normal.row_of(),
            at,
            settled,
            best: Best::default(),
            of_curvature: None,
            values: Vec::new(),
            iteration: 0,
            value_before: f64::INFINITY,
            patience: Patience::FIRST,
            first_complementarity,
            referred_at: first_complementarity,
        }
    }

    /// Returns the state here, and decides whether to prove the gap. Under kept tangents it does so when the
    /// complementarity is as small as the wanted gap. Under the rows the objective must also have stopped to fall, or
    /// few steps be left.
    pub(super) fn look(&self) -> Look {
        let complementarity = self.at.complementarity();
        let there = Progress { iteration: self.iteration, complementarity };
        let wanted_nm2 = self.stop.relative_gap * self.at.f.value;
        let first = self.first_complementarity;
        let near_enough = progress::of_convergence(first, complementarity, wanted_nm2);
        progress::done(BEFORE_PROOF * near_enough);
        let fall_nm2 = self.value_before - self.at.f.value;
        let to_go = self.stop.max_iterations.saturating_sub(self.iteration);
        let near = self.settled
            && complementarity <= wanted_nm2
            && (self.at.anchor.is_some()
                || self.patience.ends(there, fall_nm2, wanted_nm2)
                || to_go <= STEPS_OF_A_PROOF);
        Look { there, wanted_nm2, near, last: to_go == 0 }
    }

    /// Computes the objective with the removal itself if the gap is to be proven or if the complementarity has fallen
    /// much. The price may change by this, and then nothing is proven here.
    pub(super) fn refer(&mut self, look: Look, merit: &mut Merit<'_>) -> Result<Look, JointError> {
        let complementarity = look.there.complementarity;
        if look.decides() || complementarity <= REFERRED_AGAIN * self.referred_at {
            merit.refer_to(look.there, &self.at.density, self.at.anchor.is_some())?;
            self.evaluate(look.there, merit);
            self.referred_at = complementarity;
        }
        self.value_before = self.at.f.value;
        if self.at.anchor.is_none() {
            self.values.push(self.at.f.value);
        }
        Ok(Look { near: look.near && self.settled, ..look })
    }

    /// Returns the proven gap here, nm^2; `None` if the curvature of the objective is singular to rounding.
    pub(super) fn prove(&mut self, look: &Look, merit: &Merit<'_>) -> Option<f64> {
        if look.near && self.of_curvature.is_none() {
            self.of_curvature = Some(self.program.inverse(&self.row_of, self.program.chain)?);
        }
        let of_curvature = self.of_curvature.as_ref().filter(|_| look.near);
        Some(self.at.gap(of_curvature, self.stop.relative_gap, merit))
    }

    /// Stores the iterate if it is the best one, and returns from its gap what the search does next.
    pub(super) fn conclude(&mut self, look: &Look, gap_nm2: f64) -> Next {
        let executable = self.at.executable(gap_nm2);
        let optimal = self.settled && executable.relative_gap <= self.stop.relative_gap;
        self.best.offer(executable, self.settled, optimal);
        if optimal {
            Next::End(End::Optimal)
        } else if look.last {
            Next::End(End::IterationLimit)
        } else if self.at.anchor.is_none() {
            Next::KeepTangents
        } else if gap_nm2 <= PROGRAM_SOLVED * look.wanted_nm2 {
            Next::Move
        } else {
            Next::Step
        }
    }

    /// Replaces the rows by their tangents at the iterate.
    pub(super) fn keep_tangents(&mut self, gap_nm2: f64) {
        self.at.keep_tangents(gap_nm2);
    }

    /// Moves towards the solution under the tangents, and uses the rows again.
    pub(super) fn move_towards_solution(&mut self, look: &Look, merit: &mut Merit<'_>) {
        self.at.move_towards_solution();
        self.patience = self.patience.after_failure(self.iteration);
        self.evaluate(look.there, merit);
    }

    /// Takes the step by (2) of [`super`], as far as it is allowed. `None` if its matrix is singular to rounding.
    pub(super) fn step(&mut self, merit: &mut Merit<'_>) -> Option<()> {
        let step = self.at.step(&self.row_of)?;
        let complementarity = self.at.advance(&step);
        self.iteration += 1;
        self.evaluate(Progress { iteration: self.iteration, complementarity }, merit);
        Some(())
    }

    fn evaluate(&mut self, there: Progress, merit: &mut Merit<'_>) {
        (self.at.f, self.settled) = merit.evaluate(there, &self.at.density);
    }

    /// Returns the best iterate, with the dual variables of the last one; `None` if no gap was ever computed.
    pub(super) fn solution(self, end: End) -> Option<Solution> {
        let Executable { density, relative_gap, .. } = self.best.iterate?;
        let duals = [self.at.z, self.at.y];
        let objective = self.values;
        let iterations = self.iteration;
        Some(Solution { density, objective, iterations, duals, relative_gap, end })
    }
}

#[cfg(test)]
mod tests {
    use planish_dwell::residual::{Free, Residual};

    use super::*;
    use crate::{
        curve::{Rounding, curves},
        interior_point::tests::{machine, part},
        limits::LimitRows,
        merit::Price,
        mesh::Mesh,
    };

    /// Calls `test` with a search of at most `max_iterations` steps, before its first state.
    fn on_search(max_iterations: usize, test: impl FnOnce(Search<'_>, &mut Merit<'_>)) {
        let (desired, tif, path) = part();
        let curves = curves(&path, &Rounding { deviation_mm: 0.1, radius_mm: 0.5 }).curves;
        let mesh = Mesh::new(&curves, &path, 0.7).unwrap();
        let residual = Residual::new(&desired, &tif, &mesh.points_mm, None, Free::Piston).unwrap();
        let normal = residual.normal(&mesh.columns(), None).unwrap();
        let rows = LimitRows::new(&curves, &mesh, &machine(60.0, 400.0), 0.1);
        let lo = rows.least_density().to_vec();
        let density = vec![(1.05 * rows.least_uniform_density()).max(0.3); mesh.nodes];
        let (weights, price) = ((1e-4, 0.0), Price::Nm2PerS(1e-4));
        let mut merit = Merit::new(&residual, &normal, &mesh, &lo, weights, price, &density);
        let (diagonal, below) = merit.chain();
        let chain = (&diagonal[..], &below[..]);
        let program = Program { normal: &normal, chain, lo: &lo, rows: &rows };
        let stop = Stop { relative_gap: 1e-3, max_iterations };
        let start = Start { density, duals: None };
        test(Search::new(&program, start, stop, &mut merit), &mut merit);
    }

    /// Runs the search until something can be proven, and returns the state and twice the wanted gap, nm^2, as the gap
    /// there.
    fn until_tangents(search: &mut Search<'_>, merit: &mut Merit<'_>) -> (Look, f64) {
        loop {
            let look = search.look();
            let look = search.refer(look, merit).unwrap();
            if look.decides() {
                assert!(search.prove(&look, merit).unwrap() > 0.0);
                let gap_nm2 = 2.0 * look.wanted_nm2;
                assert_eq!(search.conclude(&look, gap_nm2), Next::KeepTangents);
                return (look, gap_nm2);
            }
            search.step(merit).unwrap();
        }
    }

    #[test]
    fn a_proof_begins_when_the_complementarity_is_small_and_the_objective_rests() {
        let at = |iteration, complementarity| Progress { iteration, complementarity };
        let first = Patience::FIRST;
        assert!(first.ends(at(0, 1.0), 0.3, 1.0));
        assert!(!first.ends(at(0, 1.1), 0.0, 1.0));
        assert!(!first.ends(at(0, 1.0), 0.31, 1.0));
        let second = first.after_failure(7);
        assert!(!second.ends(at(9, 0.1), 0.0, 1.0), "too soon");
        assert!(!second.ends(at(10, 0.26), 0.0, 1.0), "too large");
        assert!(second.ends(at(10, 0.25), 0.0, 1.0));
        let last = (0..9).fold(second, |patience, _| patience.after_failure(7));
        assert!(last.ends(at(10, LEAST_KEPT_BELOW), 0.0, 1.0));
    }

    #[test]
    fn the_best_is_the_least_of_those_that_can_be_compared() {
        let of = |value| Executable { density: Vec::new(), value, relative_gap: 1.0 };
        let mut best = Best::default();
        for (value, is_settled, optimal, kept) in [
            (1.0, false, false, 1.0),
            (3.0, false, false, 3.0),
            (2.0, true, false, 2.0),
            (2.5, true, false, 2.0),
            (1.5, true, false, 1.5),
            (1.7, true, true, 1.7),
        ] {
            best.offer(of(value), is_settled, optimal);
            assert_eq!(best.iterate.as_ref().unwrap().value, kept, "after {value}");
        }
    }

    #[test]
    fn far_from_the_minimum_the_search_steps() {
        on_search(100, |mut search, merit| {
            let look = search.look();
            assert!(!look.decides());
            let look = search.refer(look, merit).unwrap();
            assert_eq!((search.values.len(), search.iteration), (1, 0));
            let before = search.at.f.value;
            search.step(merit).unwrap();
            assert_eq!((search.value_before, search.iteration), (before, 1));
            assert!(search.at.complementarity() < look.there.complementarity);
            assert!(search.at.c.iter().chain(&search.at.z).all(|v| *v > 0.0));
        });
    }

    #[test]
    fn where_no_step_is_left_the_start_is_the_solution() {
        on_search(0, |mut search, merit| {
            let look = search.look();
            let look = search.refer(look, merit).unwrap();
            assert!(look.last && !look.near);
            let gap_nm2 = search.prove(&look, merit).unwrap();
            assert!(search.of_curvature.is_none(), "nothing near is to be proven");
            assert_eq!(search.conclude(&look, gap_nm2), Next::End(End::IterationLimit));
            let (density, value) = (search.at.density.clone(), search.at.f.value);
            let solution = search.solution(End::IterationLimit).unwrap();
            assert_eq!(solution.density, density);
            assert_eq!(solution.relative_gap, gap_nm2 / value);
            assert_eq!(solution.iterations, 0);
        });
    }

    #[test]
    fn tangents_are_kept_until_their_program_is_solved() {
        on_search(100, |mut search, merit| {
            let (look, gap_nm2) = until_tangents(&mut search, merit);
            let (density, values) = (search.at.density.clone(), search.values.len());
            search.keep_tangents(gap_nm2);
            search.step(merit).unwrap();
            // The steps under the tangents have no values of f under the rows, and are always looked at closely.
            let under = search.look();
            let under = search.refer(under, merit).unwrap();
            assert_eq!(search.values.len(), values);
            let solved = 0.5 * PROGRAM_SOLVED * under.wanted_nm2;
            let kept = search.at.anchor.as_mut().unwrap();
            assert_eq!(kept.density, density);
            // Far below the iterate whose tangents are kept: solved, but nothing is proven of that iterate.
            (kept.value, kept.gap) = (2.0 * search.at.f.value, f64::INFINITY);
            assert_eq!(search.conclude(&look, solved), Next::Move);
            assert_eq!(search.conclude(&look, 2.0 * PROGRAM_SOLVED * look.wanted_nm2), Next::Step);
            search.move_towards_solution(&look, merit);
            assert!(search.at.anchor.is_none());
            assert_eq!(search.patience.from, search.iteration + LEAST_STEPS_BETWEEN_PROOFS);
            assert!(search.at.c.iter().all(|c| *c > 0.0), "every iterate can be executed");
        });
    }
}
