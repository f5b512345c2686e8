//! The subcommands, one file each.

mod diff;
mod dwell;
mod figures;
mod report;
mod several;
mod sweep;

use clap::Subcommand;
use planish_handoff::{Failure, Status};
use planish_types::text::visible;

#[derive(Subcommand)]
pub enum CompareCommand {
    /// Print the results of the methods of one or several runs side by side; write summary.json,
    /// report.html and figures (SVG)
    Report(report::ReportCommand),
    /// Print what a run of several tools leaves; write summary.json, report.html and figures (SVG)
    ///
    /// The page has the maps tool by tool, and the residual against the time for the subsets of the rack.
    Several(several::SeveralCommand),
    /// Draw the figures of a plan for papers and lab books, as PDF, PNG or SVG
    Figures(figures::Figures),
    /// Print the results of dwell solvers side by side, and write summary.json
    Dwell(dwell::Dwell),
    /// Print which plans of a sweep are best, and which is to be run; write table.csv, report.html and the
    /// front (SVG); exit code 1 when none keeps the constraints
    Sweep(sweep::Sweep),
    /// Print how far the arrays of two artifacts are apart; exit code 1 above the tolerance
    Diff(diff::Diff),
}

impl CompareCommand {
    pub fn run(&self) -> Result<Status, Failure> {
        let ended = match self {
            Self::Report(arguments) => arguments.run(),
            Self::Several(arguments) => arguments.run(),
            Self::Figures(arguments) => arguments.run(),
            Self::Dwell(arguments) => arguments.run(),
            Self::Sweep(arguments) => arguments.run(),
            Self::Diff(arguments) => arguments.run(),
        };
        // Names of files and directories may command the terminal.
        match ended {
            Ok(Status::Negative(reason)) => Ok(Status::Negative(visible(&reason).into_owned())),
            Err(failure) => Err(Failure::new(visible(&failure.to_string()))),
            done => done,
        }
    }
}
