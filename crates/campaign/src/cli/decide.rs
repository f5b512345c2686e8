//! `planish campaign decide`.

use std::path::{Path, PathBuf};

use clap::Args;
use planish_campaign::decision::{
    self, Decision, DecisionSettings, Known, MapError, SpecificationKept, Verdict,
};
use planish_handoff::{
    Begin, Failure, Inputs, Output, Status,
    flags::{OutputArgs, TrajectoryArgs},
    kind, say, task,
};
use planish_types::{
    Invalid, Surface,
    outcome::{
        specification::SpecificationOutcome,
        tolerance::{ErrorLine, ToleranceArrays, ToleranceOutcome, ToleranceSettings},
    },
};

#[derive(Args)]
pub struct Decide {
    /// Map of the present figure, for which the next plan was made [surface artifact]
    #[arg(long, value_name = "DIR")]
    surface: PathBuf,
    /// Motion of the next plan
    #[command(flatten)]
    trajectory: TrajectoryArgs,
    /// Residual of the next plan with the errors of the process [tolerance artifact]
    #[arg(long, value_name = "DIR")]
    tolerance: PathBuf,
    /// Specification, judged on the map [specification artifact]
    #[arg(long, value_name = "DIR", requires = "specified_next")]
    specified_now: Option<PathBuf>,
    /// Specification, judged on the residual of the plan [specification artifact]
    #[arg(long, value_name = "DIR", requires = "specified_now")]
    specified_next: Option<PathBuf>,
    /// Least median gain for another run, in percent of the RMS on the mirror now; raise it if a run is expensive
    #[arg(long, value_name = "P", default_value_t = DecisionSettings::default().least_gain_percent)]
    least_gain_percent: f64,
    #[command(flatten)]
    output: OutputArgs,
}

impl Decide {
    pub fn run(&self) -> Result<Status, Failure> {
        let settings = DecisionSettings { least_gain_percent: self.least_gain_percent };
        let mut inputs = Inputs::new();
        let surface: Surface = inputs.read("surface", &self.surface)?;
        let trajectory = self.trajectory.read(&mut inputs)?;
        let (arrays, manifest) =
            inputs.read_with_manifest::<ToleranceArrays>("tolerance", &self.tolerance)?;
        let levels = levels(&arrays).map_err(|e| {
            Failure::new(format!("{}: {e}", self.tolerance.join("part.npy").display()))
        })?;
        for from in ["surface", "trajectory"] {
            inputs.refuse_unrelated("tolerance", manifest.as_ref(), from)?;
        }
        let manifest = manifest.ok_or_else(|| {
            let problem = "has no manifest, in which the errors of the map are; give the output of planish tolerance";
            Failure::new(format!("{}: {problem}", self.tolerance.display()))
        })?;
        let remedy = "make it again by planish tolerance";
        let outcome: ToleranceOutcome = manifest.read_outcome(&self.tolerance, remedy)?;
        let ToleranceSettings { free } = manifest.read_settings(&self.tolerance)?;
        let specification = match (&self.specified_now, &self.specified_next) {
            (Some(now), Some(next)) => Some(SpecificationKept {
                now: is_kept(&mut inputs, "specified-now", now)?,
                by_the_plan: is_kept(&mut inputs, "specified-next", next)?,
            }),
            _ => None,
        };
        let output = Output::directory(&self.output, &kind::DECISION);
        let mut output = match output.begin(&task!("decide", settings), &inputs)? {
            Begin::Unchanged(status) => return Ok(status),
            Begin::Run(output) => output,
        };
        let statistics = surface.statistics();
        let known = Known {
            // The RMS with the same free terms as that of the tolerance
            measured_rms_nm: match free.as_deref() {
                Some("plane") => surface.detilted_rms_nm(),
                _ => statistics.rms,
            },
            pixels: surface.height_nm().iter().filter(|v| !v.is_nan()).count(),
            map_errors: outcome.errors.iter().filter_map(error_of_the_map).collect(),
            levels,
            nominal_rms_nm: outcome.nominal_rms_nm,
            total_time_s: trajectory.total_time_s(),
            specification,
        };
        let decision = decision::decide(&known, &settings).map_err(Failure::with_flags)?;
        output.write_arrays(&kind::DECISION, &[], &[], &decision, &Status::Done)?;
        say(words(&decision));
        say(format!("-> {}", self.output.out.display()));
        Ok(Status::Done)
    }
}

/// Returns the decision as text for the terminal: RMS on the mirror now and after the next run, gain, and reason.
fn words(d: &Decision) -> String {
    let [low, high] = d.next.interval_95_percent_nm;
    let verdict = match d.verdict {
        Verdict::RunAgain => "RUN AGAIN",
        Verdict::Stop => "STOP",
    };
    [
        format!(
            "now       {:.4} nm RMS on the mirror (+- {:.4}): measured {:.4}, of which {:.4} are the errors of a map",
            d.now_rms_nm, d.now_standard_error_nm, d.measured_rms_nm, d.noise_rms_nm
        ),
        format!(
            "next run  {:.4} nm in half of the runs, {low:.4} to {high:.4} in 95 %; measured {:.4}; in {:.1} min",
            d.next.median_nm,
            d.measured_next_median_nm,
            d.total_time_s / 60.0
        ),
        format!(
            "gain      {:.4} nm in half of the runs ({:.4} per minute), at least {:.4} in 95 %; {:.1} % of the runs gain",
            d.gain_median_nm,
            d.gain_per_minute_nm,
            d.gain_of_95_percent_nm,
            100.0 * d.part_that_gains
        ),
        format!("{verdict}: {}", d.reason),
    ]
    .join("\n")
}

/// Returns the distribution of the residual in a tolerance artifact: (fraction of the simulated runs, RMS in nm that
/// this fraction does not exceed). Refuses fewer than two pairs, pairs that do not ascend, and a negative RMS.
fn levels(arrays: &ToleranceArrays) -> Result<Vec<(f64, f64)>, Invalid> {
    let levels: Vec<(f64, f64)> =
        arrays.part.iter().copied().zip(arrays.rms_nm.iter().copied()).collect();
    let ascend = levels.windows(2).all(|w| w[0].0 < w[1].0 && w[0].1 <= w[1].1);
    if levels.len() < 2 || !ascend || levels[0].1 < 0.0 {
        let problem = "do not ascend";
        return Err(Invalid::whole("part", problem, "make the tolerance again"));
    }
    Ok(levels)
}

/// Converts a line of the error budget into an error of the map; `None` unless its kind is `map_noise` or
/// `map_low_order`.
fn error_of_the_map(line: &ErrorLine) -> Option<MapError> {
    let is_white = line.kind == "map_noise";
    if !is_white && line.kind != "map_low_order" {
        return None;
    }
    let ErrorLine { adds_rms_nm, unreached_rms_nm, .. } = *line;
    Some(MapError { adds_rms_nm, unreached_rms_nm, is_white })
}

/// Returns true if the specification artifact in `dir` reports that its specification is kept. `role` names the input
/// in messages. Refuses an artifact without a specification.
fn is_kept(inputs: &mut Inputs, role: &str, dir: &Path) -> Result<bool, Failure> {
    let manifest = inputs.read_manifest(role, dir, &kind::SPECIFICATION)?;
    let outcome: SpecificationOutcome = manifest.read_outcome(dir, "judge it again")?;
    outcome.specification.map(|report| report.passed).ok_or_else(|| {
        let problem = "was measured without a specification; give planish surface spec one";
        Failure::new(format!("{}: {problem}", dir.display()))
    })
}
