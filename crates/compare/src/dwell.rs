//! Comparison of dwell solvers: residual, motion and cost of their dwell times.
//!
//! ```text
//! roughness = sqrt(mean (q_{k+1} - q_k)^2) / mean q        q_k = t_k / l_k                 (1)
//! ```
//!
//! The first mean is over consecutive dwell points k and k + 1 that both have a length of path (l > 0) and the tool
//! on; the mean of q is over all such points. A machine cannot follow dwell-time densities q that differ much from
//! point to point.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | t | `dwell` | (n) | s |
//! | l, length of the path that belongs to a dwell point | `segment_length_mm` | (n) | mm |

use planish_types::{
    DwellTime, Invalid, Removal, Surface, ToolPath,
    text::{fixed, visible},
};
use serde::Serialize;

use crate::{plan::PlanStatus, table::align};

/// Result of one dwell solver on a mirror: its dwell times, and the residual that they leave without and with a motion.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Solver {
    /// RMS of the residual (mean removed), predicted with the dwell times at the dwell points and without a motion,
    /// nm.
    pub position_rms_nm: f64,
    /// RMS of the residual (mean removed) of the executed motion, nm.
    pub executed_rms_nm: f64,
    /// RMS of the residual (plane removed) of the executed motion, nm.
    pub executed_rms_detilted_nm: f64,
    /// Duration of the executed motion, s.
    pub executed_time_s: f64,
    /// Sum of the dwell times, s.
    pub total_time_s: f64,
    /// Smallest dwell time, s.
    pub smallest_dwell_s: f64,
    /// Largest dwell time, s.
    pub largest_dwell_s: f64,
    /// Roughness of the dwell-time density ((1) of the module), dimensionless.
    pub roughness: f64,
    /// Time that the solver took, s; `null` if it was not measured.
    pub wall_s: Option<f64>,
    /// Peak memory of the solver, MiB; `null` if it was not measured.
    pub peak_memory_mb: Option<f64>,
    /// State of the dwell times: whether their optimality is proven, or the solver converged at all (see
    /// [`crate::plan`]).
    pub plan: PlanStatus,
}

/// Row of the table for one solver: its numbers, or the reason why it has none.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(rename_all = "snake_case", untagged)]
pub enum SolverRow {
    /// The solver found dwell times.
    Solved(Solver),
    /// The solver refused the problem with a message.
    Refused {
        /// Message of the solver.
        refused: String,
    },
}

impl Solver {
    /// Collects the numbers of one solver. `position` is the removal predicted at the dwell points, and `executed`
    /// that of the motion, which takes `executed_time_s`.
    ///
    /// # Errors
    /// Refuses dwell times of another path.
    pub fn new(
        path: &ToolPath,
        dwell: &DwellTime,
        position: &Removal,
        executed: &Removal,
        executed_time_s: f64,
        plan: PlanStatus,
    ) -> Result<Self, Invalid> {
        let t = dwell.dwell_s();
        if t.len() != path.len() {
            let problem = format!("has {} elements for {} dwell points", t.len(), path.len());
            return Err(Invalid::whole("dwell_s", problem, "solve on the path of this run"));
        }
        Ok(Self {
            position_rms_nm: position.residual().statistics().rms,
            executed_rms_nm: executed.residual().statistics().rms,
            executed_rms_detilted_nm: executed.residual().detilted_rms_nm(),
            executed_time_s,
            total_time_s: dwell.total_s(),
            smallest_dwell_s: t.iter().copied().fold(f64::INFINITY, f64::min),
            largest_dwell_s: t.iter().copied().fold(0.0, f64::max),
            roughness: roughness(path, t),
            wall_s: None,
            peak_memory_mb: None,
            plan,
        })
    }
}

/// Returns the roughness of the dwell-time density ((1) of the module), dimensionless. `t` are the dwell times, s. It
/// is 0 if no two consecutive points count, or if all dwell times that count are 0. `path` has the lengths and the
/// state of the tool.
fn roughness(path: &ToolPath, t: &[f64]) -> f64 {
    let mut squares = 0.0;
    let mut pairs = 0.0;
    let mut sum = 0.0;
    let mut count = 0.0;
    let mut previous = None;
    for (k, time_s) in t.iter().enumerate() {
        let length = path.segment_length_mm(k);
        if length <= 0.0 || !path.tool_on()[k] {
            previous = None;
            continue;
        }
        let q = time_s / length;
        sum += q;
        count += 1.0;
        if let Some(before) = previous {
            squares += (q - before) * (q - before);
            pairs += 1.0;
        }
        previous = Some(q);
    }
    if pairs > 0.0 && sum > 0.0 { f64::sqrt(squares / pairs) / (sum / count) } else { 0.0 }
}

/// Headings of the columns of the table, two lines each; detilted means that the best plane is removed.
const HEADINGS: [[&str; 2]; 12] = [
    ["", "solver"],
    ["position", "RMS nm"],
    ["executed", "RMS nm"],
    ["detilted", "nm"],
    ["dwell", "s"],
    ["executed", "s"],
    ["smallest", "s"],
    ["largest", "s"],
    ["", "roughness"],
    ["", "plan"],
    ["wall", "s"],
    ["memory", "MB"],
];

/// Returns the table of the solvers for the mirror `fixture`, with notes below it. RMS and PV of `desired`, the map
/// before the run, stand above it. `rows` are pairs of the name of a solver and its row.
pub fn table(fixture: &str, desired: &Surface, rows: &[(String, SolverRow)]) -> String {
    let mut cells: Vec<Vec<String>> =
        (0..2).map(|line| HEADINGS.iter().map(|h| h[line].to_string()).collect()).collect();
    let mut notes = String::new();
    let mut refused = String::new();
    for (name, row) in rows {
        match row {
            SolverRow::Solved(s) => {
                cells.push(line(name, s));
                let note = format!("{name}: {}: {}", s.plan.word, s.plan.text);
                notes += &format!("{}\n", visible(&note));
            }
            SolverRow::Refused { refused: message } => {
                refused += &format!("{}\n", visible(&format!("{name}: {message}")));
            }
        }
    }
    let initial = desired.statistics();
    let mut text = format!(
        "{}: initial surface {} nm RMS, {} nm PV\n\n",
        visible(fixture),
        fixed(initial.rms, 4),
        fixed(initial.pv, 2)
    );
    text += &align(&cells, 1);
    if !notes.is_empty() {
        text += &format!("\n{notes}");
    }
    if !refused.is_empty() {
        text += &format!("\nrefused:\n{refused}");
    }
    text
}

/// Returns the cells of the row of the solver `name`, in the order of [`HEADINGS`]; a dash for what was not measured.
/// `s` are its numbers.
fn line(name: &str, s: &Solver) -> Vec<String> {
    let or_dash = |v: Option<f64>, d: usize| v.map_or("-".into(), |v| fixed(v, d));
    vec![
        visible(name).into_owned(),
        fixed(s.position_rms_nm, 4),
        fixed(s.executed_rms_nm, 4),
        fixed(s.executed_rms_detilted_nm, 4),
        fixed(s.total_time_s, 2),
        fixed(s.executed_time_s, 2),
        fixed(s.smallest_dwell_s, 4),
        fixed(s.largest_dwell_s, 4),
        fixed(s.roughness, 4),
        s.plan.word.clone(),
        or_dash(s.wall_s, 2),
        or_dash(s.peak_memory_mb, 0),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::State;
    use ndarray::array;
    use planish_types::{Axis, Grid};

    fn path() -> ToolPath {
        // Lengths 1, 2, 0, 1, 1; the last one lifted.
        let x = [0.0, 1.0, 3.0, 3.0, 4.0, 5.0];
        let on = vec![true, true, true, true, false];
        ToolPath::through(x.iter().map(|x| [*x, 0.0]).collect(), on, vec![0; 5]).unwrap()
    }

    #[test]
    fn roughness_is_that_of_the_density_along_the_path() {
        // Densities 2, 3, (rest), 4, (lifted): one pair of neighbours, mean 3.
        let found = roughness(&path(), &[2.0, 6.0, 9.0, 4.0, 100.0]);
        assert!((found - 1.0 / 3.0).abs() < 1e-15, "{found}");
        // Equal densities are smooth whatever the lengths.
        assert_eq!(roughness(&path(), &[0.5, 1.0, 0.0, 0.5, 0.0]), 0.0);
    }

    fn plan() -> PlanStatus {
        PlanStatus { state: State::Unconverged, word: "stagnated".into(), text: "why".into() }
    }

    #[test]
    fn numbers_and_refusals_are_in_the_table() {
        let grid = Grid { x: Axis::new(0.0, 1.0, 2).unwrap(), y: Axis::new(0.0, 1.0, 2).unwrap() };
        let desired = Surface::new(grid, array![[11.0, 11.0], [9.0, 13.0]]).unwrap();
        let removal = Removal::new(&desired, ndarray::Array2::from_elem((2, 2), 3.0)).unwrap();
        let dwell = DwellTime::new(vec![0.1, 0.2, 0.3, 0.4, 0.5]).unwrap();
        let solver = Solver::new(&path(), &dwell, &removal, &removal, 1.75, plan()).unwrap();
        assert_eq!((solver.smallest_dwell_s, solver.largest_dwell_s), (0.1, 0.5));
        // Mean 11, deviations 0, 0, -2, 2.
        assert!((solver.position_rms_nm - 2.0_f64.sqrt()).abs() < 1e-15);
        let other = DwellTime::new(vec![0.1]).unwrap();
        let error = Solver::new(&path(), &other, &removal, &removal, 1.0, plan()).unwrap_err();
        assert!(error.to_string().contains("has 1 elements for 5 dwell points"));
        let rows = [
            ("udo".to_string(), SolverRow::Solved(Solver { wall_s: Some(0.5), ..solver })),
            ("rifta".to_string(), SolverRow::Refused { refused: "the TIF is larger".into() }),
        ];
        let text = table("coupon", &desired, &rows);
        assert!(text.starts_with("coupon: initial surface 1.4142 nm RMS, 4.00 nm PV\n"));
        let udo = text.lines().find(|l| l.starts_with("udo")).unwrap();
        // The plane through 0, 0, -2, 2 rises by 2 along x and leaves 1, -1, -1, 1.
        let words: Vec<&str> = udo.split_whitespace().collect();
        assert_eq!(words[1..8], ["1.4142", "1.4142", "1.0000", "1.50", "1.75", "0.1000", "0.5000"]);
        assert_eq!(words[9..], ["stagnated", "0.50", "-"]);
        assert!(text.contains("\nudo: stagnated: why\n"), "{text}");
        assert!(text.ends_with("refused:\nrifta: the TIF is larger\n"), "{text}");
        let json = serde_json::to_value(&rows[1].1).unwrap();
        assert_eq!(json["refused"], "the TIF is larger");
    }
}
