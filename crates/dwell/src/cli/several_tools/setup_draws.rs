//! Draws of the set-up errors of several tools: what a plan leaves in runs with them.

use ndarray::Array2;
use planish_dwell::bounded_least_squares::{
    BoundedSettings, ExecutedPlan, SetupDraw, SeveralSolution, ToolTask, execute_with_errors,
};
use planish_handoff::{Failure, say};
use planish_types::Surface;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution as _, StandardNormal};
use serde::Serialize;

/// Results of the runs that were drawn.
#[derive(Clone, Debug, Serialize)]
pub struct DrawsReport {
    /// Number of runs.
    runs: usize,
    /// Seed of their errors.
    seed: u64,
    /// Runs in which no map is measured between the tools.
    without_maps: Spread,
    /// The same runs with the maps between that the rack states; left out if it states none.
    #[serde(skip_serializing_if = "Option::is_none")]
    with_maps: Option<Spread>,
}

/// Spread of the results of several runs.
#[derive(Clone, Debug, Serialize)]
struct Spread {
    /// Residual that half of the runs are below, RMS, nm.
    median_nm: f64,
    /// Residual that 95 % of the runs are below, RMS, nm.
    below_95_percent_nm: f64,
    /// Time of all tools that half of the runs are below, without motion and changes, s.
    median_time_s: f64,
    /// Time of all tools that 95 % of the runs are below, s.
    below_95_percent_time_s: f64,
    /// Number of runs in which every plan after a map kept the residual of the plan before the run.
    kept: usize,
}

impl Spread {
    /// Makes the spread of these runs, of which there is at least one.
    fn new(runs: &[ExecutedPlan]) -> Self {
        let [median_nm, below_95_percent_nm] = quantiles(runs.iter().map(|run| run.rms_nm));
        let [median_time_s, below_95_percent_time_s] =
            quantiles(runs.iter().map(|run| run.time_s.iter().sum()));
        let kept = runs.iter().filter(|run| run.is_kept).count();
        Self { median_nm, below_95_percent_nm, median_time_s, below_95_percent_time_s, kept }
    }
}

/// Returns the least values that half and 95 % of the values do not exceed.
fn quantiles(values: impl Iterator<Item = f64>) -> [f64; 2] {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    [0.5, 0.95].map(|part| values[(part * values.len() as f64).ceil() as usize - 1])
}

/// Draws `runs` runs of a plan with the set-up errors of its tools, each with and without the maps between them, and
/// prints what they leave.
pub fn draw(
    problem: (&Surface, Option<&Array2<f64>>, &BoundedSettings),
    tools: &[ToolTask<'_>],
    plan: &SeveralSolution,
    (runs, seed): (usize, u64),
) -> Result<DrawsReport, Failure> {
    let has_maps = tools.iter().any(|tool| tool.setup.measured_after);
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut without_maps = Vec::with_capacity(runs);
    let mut with_maps = Vec::new();
    for _ in 0..runs {
        let draws: Vec<SetupDraw> = tools.iter().map(|tool| errors(tool, &mut rng)).collect();
        let executed = |has_maps: bool| {
            execute_with_errors(problem, tools, plan, &draws, has_maps).map_err(Failure::with_flags)
        };
        without_maps.push(executed(false)?);
        if has_maps {
            with_maps.push(executed(true)?);
        }
    }
    let with_maps = if has_maps { Some(Spread::new(&with_maps)) } else { None };
    let report = DrawsReport { runs, seed, without_maps: Spread::new(&without_maps), with_maps };
    report.print(plan);
    Ok(report)
}

/// Draws the errors of the set-up of a tool.
fn errors(tool: &ToolTask<'_>, rng: &mut ChaCha8Rng) -> SetupDraw {
    let mut normal = |deviation: f64| {
        let eta: f64 = StandardNormal.sample(&mut *rng);
        deviation * eta
    };
    let [x, y] = tool.setup.shift_mm;
    SetupDraw { shift_mm: [normal(x), normal(y)], rate_fraction: normal(tool.setup.rate_fraction) }
}

impl DrawsReport {
    fn print(&self, plan: &SeveralSolution) {
        say(format!(
            "{} runs with set-up errors, without motion and other errors; planned: {:.4} nm in {:.2} s",
            self.runs, plan.report.model_rms_nm, plan.report.total_time_s
        ));
        say(format!(
            "{:<30} {:>12} {:>12} {:>10} {:>10}",
            "", "median nm", "95 % nm", "median s", "95 % s"
        ));
        let rows = [
            ("no map between", Some(&self.without_maps)),
            ("maps between", self.with_maps.as_ref()),
        ];
        for (name, spread) in rows {
            let Some(spread) = spread else { continue };
            let kept = if name == "maps between" {
                format!("  residual of the plan kept in {} of {}", spread.kept, self.runs)
            } else {
                String::new()
            };
            say(format!(
                "{name:<30} {:>12.4} {:>12.4} {:>10.2} {:>10.2}{kept}",
                spread.median_nm,
                spread.below_95_percent_nm,
                spread.median_time_s,
                spread.below_95_percent_time_s
            ));
        }
    }
}
