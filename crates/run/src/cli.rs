//! The subcommands of `planish run`, one file each.

mod after_tool;
mod campaign;
mod claim;
mod compare;
mod doctor;
mod execute;
mod next_run;
mod place;
mod program;
mod rack;
mod record;
mod resume;
mod run;
mod several;
mod several_page;
mod several_tools;
mod spread;
mod start;
mod sweep;
mod tolerance;
mod verdict;

use clap::Subcommand;
use planish_handoff::{Failure, Status};

#[derive(Subcommand)]
pub enum RunCommand {
    /// Run a pipeline: print every command, then run it, in a directory that the run has for itself
    ///
    /// The settings, the machine file and the mirror are checked first, so that a mistake in them is not found after the
    /// long stages. Then the output directory is locked until the run and all of its stages have ended, however they end.
    /// The file run.json in it names the pipeline and the mirror. A directory of others is refused with exit code 2.
    ///
    /// The exit code is 1 if the recommended plan has a negative verdict. The pipelines are in the folder pipelines/ of
    /// the clone, or of PLANISH_SHARE.
    Run(run::RunPipeline),
    /// Run one stage of a pipeline, with its settings, in the directory of the run
    Stage(run::Stage),
    /// Print the settings of a pipeline as a table, with their defaults and units
    Show(run::Show),
    /// Run every scheduler on the same path and dwell times, along three paths, and compare the plans
    ///
    /// Each path is a run of its own in out/compare/MIRROR/PATH, or in OUT/PATH with out=OUT. The report beside them
    /// holds all three.
    Compare(compare::Compare),
    /// Print the effect of the errors of a process on the plans of several pipelines, the best first
    ///
    /// Each plan is a run of its own in out/tolerance/MIRROR/PIPELINE, or in OUT/PIPELINE with out=OUT. What the errors
    /// add to it is in PIPELINE-tolerance beside it.
    Tolerance(tolerance::Tolerance),
    /// Run a campaign on the virtual machine: plan, run, measure, reconcile, plan again
    ///
    /// The campaign runs with learning, without it, and on a machine whose errors are known. Everything goes to
    /// out/campaign/MIRROR, or to OUT with out=OUT (docs/campaign.md).
    Campaign(campaign::Campaign),
    /// Run campaigns with several seeds, and print how their results scatter
    CampaignSpread(spread::CampaignSpread),
    /// Plan the next run from the maps before and after the last one, and decide whether it is worth its time
    ///
    /// Everything goes to out/next-run/MAP, or to OUT with out=OUT (docs/campaign.md).
    NextRun(next_run::NextRun),
    /// Make all plans of a sweep and recommend one: planish sweep sweeps/small.yaml
    ///
    /// Settings: out=DIR, profile=slurm for a cluster, refine_front=yes for plans between those of the front, retry=yes,
    /// at_once=N, plans_per_job=N, most_jobs=N, snakemake=FLAGS (docs/sweeps.md). It needs a clone, and python3.
    Sweep(sweep::Sweep),
    /// Print what is here, and plan a fixture as a check
    Doctor(doctor::Doctor),
    /// Plan with several tools of a rack: choose them, then plan, judge and simulate tool by tool from coarse to fine
    ///
    /// The tools that follow are planned again on what the motion before them removes. Everything goes to
    /// out/several/MAP, or to OUT with out=OUT (docs/how-to/choose-tools.md). `planish run several` is the same.
    Several(several_tools::Several),
    /// Plan the rest of a run that was interrupted, along the same path and along a new one, and recommend one
    ///
    /// Everything goes to out/resume/RUN, or to OUT with out=OUT (docs/how-to/go-on-after-an-abort.md). The exit code is 1
    /// if a mark of the abort stays.
    Resume(resume::Resume),
    /// Run a command while the directory of a run is locked for it; the command replaces this program
    ///
    /// The program checks the machine file and the mirror first, so that a mistake in them is not found
    /// after the long stages. Then it locks --out until the command and all processes that it has started
    /// have ended, however they end. The file run.json in it names the owner of the directory. The program
    /// refuses the directory of another pipeline or of another mirror, or one with other content, with exit
    /// code 2.
    Start(start::StartCommand),
    /// Print the plan that the program of a run executes, and whether the report recommends that plan
    Program(program::ProgramCommand),
    /// Print the stages of a run that gave a negative verdict; exit code 1 if there are any
    Verdict(verdict::Verdict),
}

impl RunCommand {
    pub fn run(&self) -> Result<Status, Failure> {
        match self {
            Self::Run(arguments) => arguments.run(),
            Self::Stage(arguments) => arguments.run(),
            Self::Show(arguments) => arguments.run(),
            Self::Compare(arguments) => arguments.run(),
            Self::Tolerance(arguments) => arguments.run(),
            Self::Campaign(arguments) => arguments.run(),
            Self::CampaignSpread(arguments) => arguments.run(),
            Self::NextRun(arguments) => arguments.run(),
            Self::Sweep(arguments) => arguments.run(),
            Self::Doctor(arguments) => arguments.run(),
            Self::Several(arguments) => arguments.run(),
            Self::Resume(arguments) => arguments.run(),
            Self::Start(arguments) => arguments.run(),
            Self::Program(arguments) => arguments.run(),
            Self::Verdict(arguments) => arguments.run(),
        }
    }
}
