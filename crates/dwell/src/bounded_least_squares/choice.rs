//! The choice of tools from a rack: the subset whose plan and changes together cost least.
//!
//! ```text
//! C(S) = F(S) + sum_{k in S} d_k                                                          (1)
//! ```
//!
//! F(S) is the minimum of the objective of `several` with the tools of S, per weight of a pixel, nm^2. `d_k` is the
//! price of mounting tool k: its time at the price of a second, and what its set-up error adds to half the mean square
//! of the residual.
//!
//! A tool without a floor may stand still, which adds nothing to F. So F(S) is at least F(S') for every S' that has, in
//! addition to S, only tools without a floor. The whole rack is solved first, then the subset with the least bound, whose
//! plan is mostly a good one. The others follow from the largest to the smallest, because a large one bounds many. A
//! subset is left out when this bound, less the proven gap of F(S'), is not below the best complete plan. What is left
//! out cannot be better, and the gaps bound how much worse the choice can be than the best.
//!
//! The set-up errors of the tools have no part in F: with the reserve of a tool for the errors of another one, F(S)
//! would bound no other subset. Their price is that of the change.

use ndarray::Array2;
use planish_types::{Invalid, SetupErrors, Surface};

use super::{
    settings::{BoundedSettings, ToolTask},
    several::{SeveralSolution, solve_several},
};
use crate::{DwellError, bounds::Bound};

/// Largest number of tools of a rack. Its subsets are at most 63. Larger: more problems, each of hours in the worst
/// case. Smaller: real racks are refused.
const MAX_TOOLS: usize = 6;

/// One tool of a rack, from which a choice is made.
#[derive(Clone, Copy, Debug)]
pub struct RackTool<'a> {
    /// The tool with its path, bounds and price of a second.
    pub task: ToolTask<'a>,
    /// Price of mounting the tool, nm^2; >= 0.
    pub change_nm2: f64,
}

/// A subset of the rack that was solved.
#[derive(Clone, Debug)]
pub struct SolvedSubset {
    /// Indices of its tools in the rack, ascending.
    pub tools: Vec<usize>,
    /// Value of (1) of the module for its plan, nm^2.
    pub cost_nm2: f64,
    /// Proven lower bound of (1) for every plan with these tools, nm^2.
    pub bound_nm2: f64,
    /// Plan with these tools.
    pub solution: SeveralSolution,
}

/// The choice from a rack.
#[derive(Clone, Debug)]
pub struct ToolChoice {
    /// Subsets that were solved, in the order in which they were.
    pub solved: Vec<SolvedSubset>,
    /// Index of the best one in `solved`.
    pub best: usize,
    /// Proven lower bound of (1) of the module over all subsets, nm^2.
    pub bound_nm2: f64,
}

impl ToolChoice {
    /// Returns the plan of the best subset so far.
    pub fn best(&self) -> &SolvedSubset {
        &self.solved[self.best]
    }

    /// Returns the proven bound of the distance of its cost from the least one over all subsets, relative to its cost.
    pub fn relative_gap(&self) -> f64 {
        let cost_nm2 = self.best().cost_nm2;
        if cost_nm2 > 0.0 { ((cost_nm2 - self.bound_nm2) / cost_nm2).max(0.0) } else { 0.0 }
    }
}

/// Finds the subset of a rack of at most six tools at which (1) of the module is least, with its plan and a bound over
/// all subsets. `weight` and `settings` are those of [`solve_several`]. After every solved subset, `report` gets the
/// choice so far, whose last subset is the new one.
///
/// # Errors
/// Refuses no tools or more than six, a price of a change that is not >= 0, and what [`solve_several`] refuses.
pub fn choose_tools(
    desired: &Surface,
    rack: &[RackTool<'_>],
    weight: Option<&Array2<f64>>,
    settings: &BoundedSettings,
    mut report: impl FnMut(&ToolChoice),
) -> Result<ToolChoice, DwellError> {
    check_rack(rack)?;
    let choice = ToolChoice { solved: Vec::new(), best: 0, bound_nm2: 0.0 };
    let mut search = Search { rack, subsets: Vec::new(), choice };
    while let Some(subset) = search.next() {
        let tasks: Vec<ToolTask<'_>> = subset
            .members()
            .map(|k| ToolTask { setup: SetupErrors::default(), ..rack[k].task })
            .collect();
        let solution = solve_several(desired, &tasks, weight, settings)?;
        search.add(subset, solution);
        report(&search.choice);
    }
    Ok(search.choice)
}

/// Refuses no tools, more than [`MAX_TOOLS`], and a price of a change that is not >= 0.
fn check_rack(rack: &[RackTool<'_>]) -> Result<(), Invalid> {
    if rack.is_empty() || rack.len() > MAX_TOOLS {
        let problem = format!("has {} tools", rack.len());
        return Err(Invalid::whole("rack", problem, format!("give 1 to {MAX_TOOLS}")));
    }
    let bad = rack.iter().position(|tool| !(tool.change_nm2.is_finite() && tool.change_nm2 >= 0.0));
    let Some(k) = bad else { return Ok(()) };
    let problem = format!("is {} for tool {:?}", rack[k].change_nm2, rack[k].task.name);
    Err(Invalid::at_index("change_nm2", k, problem, "give a number >= 0"))
}

/// A subset of the rack: bit k is set if tool k is in it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Subset(usize);

impl Subset {
    /// Returns all subsets of `tools` tools but the empty one.
    fn all(tools: usize) -> impl Iterator<Item = Self> {
        (1..1_usize << tools).map(Self)
    }

    fn has(self, tool: usize) -> bool {
        self.0 >> tool & 1 == 1
    }

    /// Returns the indices of its tools, ascending.
    fn members(self) -> impl Iterator<Item = usize> {
        (0..MAX_TOOLS).filter(move |tool| self.has(*tool))
    }

    fn contains(self, other: Self) -> bool {
        self.0 & other.0 == other.0
    }
}

/// The search for the best subset of a rack.
struct Search<'a> {
    rack: &'a [RackTool<'a>],
    /// Subsets that are solved so far, in the order of `choice.solved`.
    subsets: Vec<Subset>,
    choice: ToolChoice,
}

impl Search<'_> {
    /// Returns the price of mounting the tools of a subset, nm^2.
    fn changes_nm2(&self, subset: Subset) -> f64 {
        subset.members().map(|k| self.rack[k].change_nm2).sum()
    }

    /// Returns a lower bound of (1) of the module for a subset, nm^2: the largest one that follows from the solved
    /// subsets with further tools that may stand still.
    fn bound_nm2(&self, subset: Subset) -> f64 {
        let solved = self.subsets.iter().zip(&self.choice.solved);
        let larger = solved.filter(|(larger, _)| {
            let further = larger.members().filter(|k| !subset.has(*k));
            larger.contains(subset) && further.map(|k| &self.rack[k]).all(RackTool::may_stand_still)
        });
        let bounds = larger.map(|(larger, solved)| solved.bound_nm2 - self.changes_nm2(*larger));
        bounds.fold(0.0, f64::max) + self.changes_nm2(subset)
    }

    /// Returns true if a subset is not solved.
    fn is_open(&self, subset: Subset) -> bool {
        !self.subsets.contains(&subset)
    }

    /// Returns the next subset to solve: the whole rack, then the one with the least bound, then the largest one that can
    /// be better than the best plan, and of those the one with the least bound. `None` if none can be better.
    fn next(&self) -> Option<Subset> {
        let solved = &self.choice.solved;
        let best_nm2 = solved.get(self.choice.best).map_or(f64::INFINITY, |best| best.cost_nm2);
        let open = Subset::all(self.rack.len()).filter(|subset| self.is_open(*subset));
        let promising = open.filter(|subset| self.bound_nm2(*subset) < best_nm2);
        promising.min_by(|a, b| {
            let by_bound = self.bound_nm2(*a).total_cmp(&self.bound_nm2(*b));
            let by_size = b.members().count().cmp(&a.members().count());
            if solved.len() == 1 { by_bound } else { by_size.then(by_bound) }
        })
    }

    /// Adds the plan of a subset, and updates the best one and the bound.
    fn add(&mut self, subset: Subset, solution: SeveralSolution) {
        let changes_nm2 = self.changes_nm2(subset);
        let objective_nm2 = solution.report.objective_nm2;
        // Nothing is proven without a gap.
        let gap = solution.report.proven.relative_gap.unwrap_or(1.0).min(1.0);
        let solved = SolvedSubset {
            tools: subset.members().collect(),
            cost_nm2: objective_nm2 + changes_nm2,
            bound_nm2: (1.0 - gap) * objective_nm2 + changes_nm2,
            solution,
        };
        self.subsets.push(subset);
        let choice = &mut self.choice;
        if solved.cost_nm2
            < choice.solved.get(choice.best).map_or(f64::INFINITY, |best| best.cost_nm2)
        {
            choice.best = choice.solved.len();
        }
        choice.solved.push(solved);
        let open = Subset::all(self.rack.len()).filter(|subset| self.is_open(*subset));
        let of_open = open.map(|subset| self.bound_nm2(subset));
        let of_solved = self.choice.solved.iter().map(|solved| solved.bound_nm2);
        self.choice.bound_nm2 = of_open.chain(of_solved).fold(f64::INFINITY, f64::min);
    }
}

impl RackTool<'_> {
    /// Returns true if all dwell times of the tool may be 0.
    fn may_stand_still(&self) -> bool {
        match self.task.min_dwell {
            Bound::Seconds(s) | Bound::SecondsPerMm(s) => s == 0.0,
        }
    }
}
