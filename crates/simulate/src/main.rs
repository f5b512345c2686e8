//! `planish-simulate`: removal and residual of a trajectory.

use std::{path::PathBuf, process::ExitCode};

use clap::{Parser, ValueEnum};
use planish_handoff::{Artifact, Begin, OutputArgs, Stage, Status, run, stage::say};
use planish_simulate::{Settings, simulate};
use planish_types::{Removal, Surface, Tif, Trajectory};
use serde_json::json;

/// Predict what a trajectory removes from a surface, and what remains
#[derive(Parser)]
#[command(version)]
struct Cli {
    /// Motion [trajectory artifact]
    #[arg(long, value_name = "DIR")]
    trajectory: PathBuf,
    /// Tool influence function [tif artifact]
    #[arg(long, value_name = "DIR")]
    tif: PathBuf,
    /// Desired removal [surface artifact]
    #[arg(long, value_name = "DIR")]
    surface: PathBuf,
    /// How the integral along the motion is computed
    #[arg(long, value_enum, default_value = "gridded")]
    method: Method,
    /// Time steps per segment of the direct method
    #[arg(long, default_value_t = 16)]
    steps: usize,
    #[command(flatten)]
    output: OutputArgs,
}

#[derive(Clone, Copy, ValueEnum)]
enum Method {
    /// Exact quadrature and FFT convolution
    Gridded,
    /// Midpoint quadrature pixel by pixel: slow, to check the other
    Direct,
}

fn main() -> ExitCode {
    let cli = Cli::parse();
    run(|| {
        let settings = match cli.method {
            Method::Gridded => Settings::Gridded,
            Method::Direct => Settings::Direct { steps: cli.steps },
        };
        let mut stage =
            Stage::new("planish-simulate", env!("CARGO_PKG_VERSION"), "simulate", &cli.output);
        stage.settings(settings);
        let trajectory: Trajectory = stage.read("trajectory", &cli.trajectory)?;
        let tif: Tif = stage.read("tif", &cli.tif)?;
        let surface: Surface = stage.read("surface", &cli.surface)?;
        if let Begin::Unchanged(status) = stage.begin(&[""], Removal::KIND)? {
            return Ok(status);
        }

        let prediction = simulate(&trajectory, &tif, &surface, settings)?;

        let residual = prediction.removal.residual();
        let (statistics, detilted) = (residual.statistics(), residual.detilted_rms_nm());
        let outcome = json!({
            "rms_nm": statistics.rms,
            "rms_detilted_nm": detilted,
            "pv_nm": statistics.pv,
            "total_time_s": trajectory.total_time_s(),
            "numerics": prediction.numerics,
        });
        stage.write("", &prediction.removal, outcome, &Status::Done)?;
        say(format!(
            "residual {:.4} nm RMS ({:.4} nm detilted), {:.2} nm PV after {:.2} s -> {}",
            statistics.rms,
            detilted,
            statistics.pv,
            trajectory.total_time_s(),
            cli.output.out.display()
        ));
        Ok(Status::Done)
    })
}
