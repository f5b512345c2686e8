//! Table of the stages.

use clap::Subcommand;
use planish_handoff::{Failure, Stage, Status, Subcommands};

/// Subcommands of `planish import` that are of other stages.
#[derive(Debug, Subcommand)]
pub enum ImportNames {
    /// Those of `planish tool`
    #[command(flatten)]
    Tool(planish_tool::command::ImportNames),
    /// Those of `planish reconcile`
    #[command(flatten)]
    Reconcile(planish_reconcile::command::ImportNames),
}

impl Subcommands for ImportNames {
    fn run(&self) -> Result<Status, Failure> {
        match self {
            Self::Tool(names) => names.run(),
            Self::Reconcile(names) => names.run(),
        }
    }
}

/// The stages, in the order of a run; `planish run` runs them.
pub const STAGES: [Stage; 23] = [
    planish_app::command::COMMAND,
    planish_run::command::COMMAND,
    planish_fixture::command::COMMAND,
    planish_import::command::command::<ImportNames>(),
    planish_register::command::COMMAND,
    planish_surface::command::command::<planish_tool::command::SurfaceNames>(),
    planish_tool::command::COMMAND,
    planish_toolpath::command::COMMAND,
    planish_dwell::command::COMMAND,
    planish_bspline_feed::command::COMMAND,
    planish_schedule::command::COMMAND,
    planish_simulate::command::COMMAND,
    planish_verify::command::COMMAND,
    planish_refine::command::COMMAND,
    planish_joint::command::COMMAND,
    planish_axes::command::COMMAND,
    planish_export::command::COMMAND,
    planish_compare::command::COMMAND,
    planish_tolerance::command::COMMAND,
    planish_reconcile::command::COMMAND,
    planish_campaign::command::COMMAND,
    planish_benchmark::command::COMMAND,
    planish_sweep::command::COMMAND,
];
