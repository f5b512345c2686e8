//! `planish toolpath maze`.

use clap::{Args, ValueEnum};
use planish_handoff::{Begin, Failure, Status, task};
use planish_toolpath::{MazeSettings, Tree, maze};
use serde_json::json;

use super::{Region, RegionArgs};

#[derive(Debug, Args)]
pub struct MazeArgs {
    #[command(flatten)]
    region: RegionArgs,
    /// Longest segment, mm [default: the pitch; with rounded corners their radius]
    #[arg(long, value_name = "S", allow_negative_numbers = true)]
    step_mm: Option<f64>,
    /// Random seed
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,
    /// Random tree around which the path goes
    #[arg(long, value_enum, default_value_t = TreeArg::DepthFirst)]
    tree: TreeArg,
    /// Chance that depth-first keeps its direction where that is possible, 0 to 1 [default: 0]
    #[arg(long, value_name = "C", allow_negative_numbers = true)]
    straightness: Option<f64>,
    /// Radius of rounded corners, mm: from 0 (sharp) to half the pitch
    #[arg(long, value_name = "R", default_value_t = 0.0, allow_negative_numbers = true)]
    corner_radius_mm: f64,
    /// Leave out the step that leads back to the start
    #[arg(long)]
    open: bool,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum TreeArg {
    /// Depth-first tree: long corridors
    DepthFirst,
    /// Wilson's algorithm, every spanning tree equally likely: more turns
    Wilson,
}

impl MazeArgs {
    pub fn run(&self) -> Result<Status, Failure> {
        let on = Region::read(&self.region)?;
        let pitch_mm = self.region.pitch_mm;
        let corner_radius_mm = self.corner_radius_mm;
        let settings = MazeSettings {
            pitch_mm,
            step_mm: self
                .step_mm
                .unwrap_or_else(|| MazeSettings::usual_step_mm(pitch_mm, corner_radius_mm)),
            overscan_mm: on.overscan_mm,
            corner_radius_mm,
            tree: match (self.tree, self.straightness) {
                (TreeArg::DepthFirst, s) => Tree::DepthFirst { straightness: s.unwrap_or(0.0) },
                (TreeArg::Wilson, None) => Tree::Wilson,
                (TreeArg::Wilson, Some(_)) => {
                    return Err(Failure::new("straightness: only --tree depth-first has one"));
                }
            },
            open: self.open,
            seed: self.seed,
        };
        let mut output = match on.begin(&task!("maze", &on.stated(&settings)))? {
            Begin::Unchanged(status) => return Ok(status),
            Begin::Run(output) => output,
        };
        let made = maze(&on.surface, &settings)?;
        let own = json!({ "cells": made.cells, "cells_left_out": made.cells_left_out });
        on.write(&mut output, &made.path, pitch_mm, own, Vec::new())
    }
}
