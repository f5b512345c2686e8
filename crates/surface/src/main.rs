//! `planish-surface`: conditions a measured map.

use std::{path::PathBuf, process::ExitCode};

use clap::{Args, Parser, Subcommand, ValueEnum};
use planish_handoff::{Artifact, Begin, Failure, OutputArgs, Stage, Status, run, stage::say};
use planish_surface::{
    Level, OutlierSettings, PrepareSettings, outliers::half_maximum_width_mm, prepare,
};
use planish_types::{ClearAperture, Surface, Tif};

const RECTANGLE: [&str; 4] = ["X0", "X1", "Y0", "Y1"];

const EXAMPLES: &str = "Examples:\n\
    \x20 planish-surface prepare --surface mirror --level plane --out out/surface\n\
    \x20 planish-surface prepare --surface mirror --mask-outliers --feature-mm 4 --out out/surface";

/// Conditions a measured map: clear aperture, outlier mask, level
#[derive(Debug, Parser)]
#[command(version, after_help = EXAMPLES)]
struct Cli {
    #[command(subcommand)]
    method: Method,
}

#[derive(Debug, Subcommand)]
enum Method {
    /// Makes the desired removal: crops to the clear aperture, masks outliers, levels
    Prepare(Box<PrepareArgs>),
}

#[derive(Debug, Args)]
struct PrepareArgs {
    /// Measured map
    #[arg(long, value_name = "DIR")]
    surface: PathBuf,
    /// What to subtract: nothing, a constant (smallest height 0), or the plane and a constant
    #[arg(long, value_enum, default_value_t = LevelArg::Piston)]
    level: LevelArg,
    #[command(flatten)]
    aperture: ApertureArgs,
    #[command(flatten)]
    outliers: OutlierArgs,
    #[command(flatten)]
    output: OutputArgs,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum LevelArg {
    None,
    Piston,
    Plane,
}

#[derive(Debug, Args)]
#[group(multiple = false)]
struct ApertureArgs {
    /// Clear aperture: pixel centres in this rectangle, mm
    #[arg(long, num_args = 4, value_names = RECTANGLE, allow_negative_numbers = true)]
    aperture_rectangle_mm: Option<Vec<f64>>,
    /// Clear aperture: pixel centres in this circle, mm
    #[arg(long, num_args = 3, value_names = ["CX", "CY", "R"], allow_negative_numbers = true)]
    aperture_circle_mm: Option<Vec<f64>>,
    /// Clear aperture: pixels that are 1 in this .npy array (ny, nx)
    #[arg(long, value_name = "FILE")]
    aperture_mask: Option<PathBuf>,
}

#[derive(Debug, Args)]
struct OutlierArgs {
    /// Mask pits and dust that are narrower than half the tool; needs --tif or --feature-mm
    #[arg(long, requires = "feature")]
    mask_outliers: bool,
    /// Tool influence function whose width at half maximum tells what is narrow
    #[arg(long, value_name = "DIR", group = "feature", requires = "mask_outliers")]
    tif: Option<PathBuf>,
    /// Full width at half maximum of the tool, mm
    #[arg(long, value_name = "W", group = "feature", requires = "mask_outliers")]
    feature_mm: Option<f64>,
    /// A seed deviates by more than this multiple of the noise (1.4826 MAD) [default: 15]
    #[arg(long, value_name = "K", requires = "mask_outliers")]
    outlier_seed_sigmas: Option<f64>,
    /// A seed grows to pixels above this multiple of the noise [default: 6]
    #[arg(long, value_name = "K", requires = "mask_outliers")]
    outlier_grow_sigmas: Option<f64>,
    /// No seed deviates by less than this, nm [default: 1]
    #[arg(long, value_name = "NM", requires = "mask_outliers")]
    outlier_floor_nm: Option<f64>,
    /// Margin around an outlier, px [default: 3]
    #[arg(long, value_name = "PX", requires = "mask_outliers")]
    outlier_dilate_px: Option<usize>,
}

fn main() -> ExitCode {
    let Method::Prepare(args) = planish_handoff::parse::<Cli>().method;
    run(move || prepare_stage(&args))
}

fn prepare_stage(args: &PrepareArgs) -> Result<Status, Failure> {
    let version = env!("CARGO_PKG_VERSION");
    let mut stage = Stage::new("planish-surface", version, "prepare", &args.output);
    let surface: Surface = stage.read("surface", &args.surface)?;
    let settings = PrepareSettings {
        aperture: aperture(&mut stage, &args.aperture)?,
        outliers: outlier_settings(&mut stage, &args.outliers)?,
        level: match args.level {
            LevelArg::None => Level::None,
            LevelArg::Piston => Level::Piston,
            LevelArg::Plane => Level::Plane,
        },
    };
    stage.settings(&settings);
    if let Begin::Unchanged(status) = stage.begin(&[""], Surface::KIND)? {
        return Ok(status);
    }
    let prepared = prepare(&surface, &settings)?;
    let report = &prepared.report;
    stage.write("", &prepared.surface, serde_json::to_value(report)?, &Status::Done)?;
    let (rows, columns) = report.after.shape;
    let masked = report.outliers.as_ref().map_or(String::new(), |o| {
        format!(", {} outlier(s) masked ({} px)", o.components, o.masked_pixels)
    });
    say(format!(
        "planish-surface: {columns} x {rows} px, {} valid, RMS {:.4} nm, PV {:.3} nm{masked}",
        report.after.valid_pixels, report.after.rms_nm, report.after.pv_nm
    ));
    Ok(Status::Done)
}

fn aperture(stage: &mut Stage, args: &ApertureArgs) -> Result<Option<ClearAperture>, Failure> {
    if let Some(path) = &args.aperture_mask {
        return Ok(Some(ClearAperture::Mask(stage.read_mask("aperture-mask", path)?)));
    }
    let rectangle = args
        .aperture_rectangle_mm
        .as_ref()
        .map(|v| ClearAperture::Rectangle { x_mm: [v[0], v[1]], y_mm: [v[2], v[3]] });
    let circle = args
        .aperture_circle_mm
        .as_ref()
        .map(|v| ClearAperture::Circle { centre_mm: [v[0], v[1]], radius_mm: v[2] });
    Ok(rectangle.or(circle))
}

fn outlier_settings(
    stage: &mut Stage,
    args: &OutlierArgs,
) -> Result<Option<OutlierSettings>, Failure> {
    let feature_mm = match (&args.tif, args.feature_mm) {
        (Some(dir), _) => half_maximum_width_mm(&stage.read::<Tif>("tif", dir)?),
        (None, Some(width)) => width,
        (None, None) => return Ok(None),
    };
    let default = OutlierSettings::for_feature_mm(feature_mm);
    Ok(Some(OutlierSettings {
        feature_mm,
        seed_sigmas: args.outlier_seed_sigmas.unwrap_or(default.seed_sigmas),
        grow_sigmas: args.outlier_grow_sigmas.unwrap_or(default.grow_sigmas),
        floor_nm: args.outlier_floor_nm.unwrap_or(default.floor_nm),
        dilate_px: args.outlier_dilate_px.unwrap_or(default.dilate_px),
    }))
}
