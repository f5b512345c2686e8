//! `planish-surface`: conditions measured maps and tools, and describes them.

use std::{
    path::{Path, PathBuf},
    process::ExitCode,
};

use clap::{Args, Parser, Subcommand, ValueEnum};
use ndarray::Array1;
use planish_handoff::{
    Artifact, Begin, Failure, Inputs, Output, Status,
    flags::{OutputArgs, OutputFileArgs},
    kind,
    npy::ArrayData,
    run, say, task,
};
use planish_surface::{
    Level, OutlierSettings, PrepareSettings,
    draw::{MapsSettings, Panel, maps_svg, psd_svg},
    extension::{self, ExtensionSettings, gaussian_decay, gerchberg_papoulis, polynomial},
    low_order::{Circle, Family, LowOrderSettings},
    outliers::half_maximum_width_mm,
    prepare,
    psd::{Detrend, Psd, PsdSettings, Window, psd},
    statistics::surface_statistics,
    tif::{Centre, TifSettings, prepare_tif},
    tif_fit,
};
use planish_types::{ClearAperture, Removal, Surface, Tif};
use serde_json::json;

const RECTANGLE: [&str; 4] = ["X0", "X1", "Y0", "Y1"];
const CIRCLE: [&str; 3] = ["CX", "CY", "R"];

#[global_allocator]
static ALLOCATOR: planish_handoff::Allocator = planish_handoff::Allocator;

const EXAMPLES: &str = "Examples:\n\
    \x20 planish-surface prepare --surface mirror --level plane --out out/surface\n\
    \x20 planish-surface prepare --surface mirror --mask-outliers --feature-mm 4 --out out/surface\n\
    \x20 planish-surface psd --surface mirror --band-per-mm 0.1 1 --out out/psd\n\
    \x20 planish-surface tif --tif spot --centre centroid --fit gaussian --out out/tif";

/// Conditions measured maps and tools, and describes them
#[derive(Debug, Parser)]
#[command(version, after_help = EXAMPLES)]
struct Cli {
    #[command(subcommand)]
    method: Method,
}

#[derive(Debug, Subcommand)]
enum Method {
    /// Makes the desired removal: crops to the clear aperture, masks outliers, levels; on request
    /// fills holes and extends beyond the aperture
    Prepare(Box<PrepareArgs>),
    /// Prints RMS, PV and robust PV of a map, or of a residual, as JSON
    Statistics(StatisticsArgs),
    /// Power spectral densities of a map, or of a residual, and the RMS in bands
    Psd(PsdArgs),
    /// Makes a measured tool ready: border, centre, rotation, pitch, taper; or fits a formula to it
    Tif(TifArgs),
    /// Draws maps and a section through them as SVG
    Draw(DrawArgs),
}

#[derive(Debug, Args)]
struct PrepareArgs {
    /// Measured map [surface artifact]
    #[arg(long, value_name = "DIR")]
    surface: PathBuf,
    /// What to subtract: nothing, a constant (smallest height 0), the plane and a constant, or terms
    /// up to --level-order and a constant
    #[arg(long, value_enum, default_value_t = LevelArg::Piston)]
    level: LevelArg,
    /// Highest order of the terms: n of zernike, i + j of legendre and chebyshev; at most 20
    #[arg(long, value_name = "N", allow_negative_numbers = true)]
    level_order: Option<u32>,
    /// Unit circle of the zernike terms, mm [default: about the valid pixels]
    #[arg(long, num_args = 3, value_names = CIRCLE, allow_negative_numbers = true)]
    zernike_circle_mm: Option<Vec<f64>>,
    #[command(flatten)]
    aperture: ApertureArgs,
    #[command(flatten)]
    outliers: OutlierArgs,
    /// Fill invalid pixels of the clear aperture, or enclosed ones where none is given, smoothly
    /// from their rims (for programs that cannot skip them; the solvers here do)
    #[arg(long)]
    fill: bool,
    #[command(flatten)]
    extension: ExtensionArgs,
    #[command(flatten)]
    output: OutputArgs,
}

#[derive(Clone, Copy, Debug, PartialEq, ValueEnum)]
enum LevelArg {
    None,
    Piston,
    Plane,
    Zernike,
    Legendre,
    Chebyshev,
}

#[derive(Debug, Args)]
#[group(multiple = false)]
struct ApertureArgs {
    /// Clear aperture: pixel centres in this rectangle, mm
    #[arg(long, num_args = 4, value_names = RECTANGLE, allow_negative_numbers = true)]
    aperture_rectangle_mm: Option<Vec<f64>>,
    /// Clear aperture: pixel centres in this circle, mm
    #[arg(long, num_args = 3, value_names = CIRCLE, allow_negative_numbers = true)]
    aperture_circle_mm: Option<Vec<f64>>,
    /// Clear aperture: pixels that are 1 [.npy file (ny, nx)]
    #[arg(long, value_name = "FILE")]
    aperture_mask: Option<PathBuf>,
}

#[derive(Debug, Args)]
struct OutlierArgs {
    /// Mask pits and dust that are narrower than half the tool; needs --tif or --feature-mm
    #[arg(long, requires = "feature")]
    mask_outliers: bool,
    /// Tool influence function whose width at half maximum tells what is narrow [tif artifact]
    #[arg(long, value_name = "DIR", group = "feature", requires = "mask_outliers")]
    tif: Option<PathBuf>,
    /// Full width at half maximum of the tool, mm
    #[arg(
        long,
        value_name = "W",
        group = "feature",
        requires = "mask_outliers",
        allow_negative_numbers = true
    )]
    feature_mm: Option<f64>,
    /// A seed deviates by more than this multiple of the noise (1.4826 MAD) [default: 15]
    #[arg(long, value_name = "K", requires = "mask_outliers", allow_negative_numbers = true)]
    outlier_seed_sigmas: Option<f64>,
    /// A seed grows to pixels above this multiple of the noise [default: 6]
    #[arg(long, value_name = "K", requires = "mask_outliers", allow_negative_numbers = true)]
    outlier_grow_sigmas: Option<f64>,
    /// No seed deviates by less than this, nm [default: 1]
    #[arg(long, value_name = "NM", requires = "mask_outliers", allow_negative_numbers = true)]
    outlier_floor_nm: Option<f64>,
    /// Margin around an outlier, px [default: 3]
    #[arg(long, value_name = "PX", requires = "mask_outliers", allow_negative_numbers = true)]
    outlier_dilate_px: Option<usize>,
}

#[derive(Debug, Args)]
struct ExtensionArgs {
    /// Give every pixel beyond the clear aperture a height (for methods by Fourier transform; the
    /// least-squares solvers need none)
    #[arg(long, value_enum, value_name = "METHOD", requires = "extend_mm")]
    extend: Option<ExtendArg>,
    /// Margin on every side, mm
    #[arg(long, value_name = "M", requires = "extend", allow_negative_numbers = true)]
    extend_mm: Option<f64>,
    /// gaussian-decay: standard deviation, mm [default: a third of the margin]
    #[arg(long, value_name = "S", requires = "extend", allow_negative_numbers = true)]
    extend_sigma_mm: Option<f64>,
    /// gerchberg-papoulis: highest spatial frequency, 1/mm; 1 / (2 FWHM) of the tool is usual
    #[arg(long, value_name = "F", requires = "extend", allow_negative_numbers = true)]
    extend_cutoff_per_mm: Option<f64>,
    /// gerchberg-papoulis: most steps [default: 300]
    #[arg(long, value_name = "N", requires = "extend", allow_negative_numbers = true)]
    extend_iterations: Option<usize>,
    /// gerchberg-papoulis: stop when no height changes by more, nm [default: 1e-3]
    #[arg(long, value_name = "NM", requires = "extend", allow_negative_numbers = true)]
    extend_tolerance_nm: Option<f64>,
    /// polynomial: highest orders along x and y [default: 9 6]
    #[arg(long, num_args = 2, value_names = ["I", "J"], requires = "extend", allow_negative_numbers = true)]
    extend_order: Option<Vec<u32>>,
    /// polynomial: let nothing hold it at the outer edge (only for maps that are polynomials)
    #[arg(long, requires = "extend")]
    extend_without_ring: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, ValueEnum)]
enum ExtendArg {
    Nearest,
    GaussianDecay,
    GerchbergPapoulis,
    Polynomial,
}

#[derive(Debug, Args)]
#[group(required = true, multiple = false)]
struct MapArgs {
    /// Map [surface artifact]
    #[arg(long, value_name = "DIR")]
    surface: Option<PathBuf>,
    /// Predicted removal whose residual is the map [removal artifact]
    #[arg(long, value_name = "DIR")]
    removal: Option<PathBuf>,
}

#[derive(Debug, Args)]
struct StatisticsArgs {
    #[command(flatten)]
    map: MapArgs,
    /// Terms of the fit in the robust PV [default: zernike where the valid pixels fill less than 90 %
    /// of their bounding box, else legendre]
    #[arg(long, value_enum)]
    pvr_terms: Option<Family>,
    /// Unit circle of the zernike terms, mm [default: about the valid pixels]
    #[arg(long, num_args = 3, value_names = CIRCLE, allow_negative_numbers = true)]
    zernike_circle_mm: Option<Vec<f64>>,
}

#[derive(Debug, Args)]
struct PsdArgs {
    #[command(flatten)]
    map: MapArgs,
    /// Window along x and y
    #[arg(long, value_enum, default_value_t = Window::Hann)]
    window: Window,
    /// What to take off first
    #[arg(long, value_enum, default_value_t = Detrend::Plane)]
    detrend: Detrend,
    /// Band of spatial frequencies [F0, F1) whose RMS is wanted, 1/mm; may be repeated
    #[arg(long, num_args = 2, value_names = ["F0", "F1"], action = clap::ArgAction::Append, allow_negative_numbers = true)]
    band_per_mm: Vec<f64>,
    #[command(flatten)]
    output: OutputArgs,
}

#[derive(Debug, Args)]
struct TifArgs {
    /// Measured tool influence function [tif artifact]
    #[arg(long, value_name = "DIR")]
    tif: PathBuf,
    /// Subtract the mean of the border samples and clip what is then negative
    #[arg(long)]
    subtract_border: bool,
    /// What the offsets are counted from; the samples stay as they are
    #[arg(long, value_enum, default_value_t = Centre::Given)]
    centre: Centre,
    /// Turn counterclockwise about the centre, degrees; multiples of 90 are exact
    #[arg(long, value_name = "DEG", default_value_t = 0.0, allow_negative_numbers = true)]
    rotate_deg: f64,
    /// Resample to this pitch, with a sample at the centre, mm
    #[arg(long, value_name = "P", allow_negative_numbers = true)]
    pitch_mm: Option<f64>,
    /// Let the outer fraction of the half size go to zero by a cosine, in (0, 1]; 0.15 is usual
    #[arg(long, value_name = "F", allow_negative_numbers = true)]
    taper_fraction: Option<f64>,
    /// Fit a formula to the result and report it
    #[arg(long, value_enum)]
    fit: Option<tif_fit::Model>,
    /// Write the formula's samples instead of the measured ones
    #[arg(long, requires = "fit")]
    use_fit: bool,
    #[command(flatten)]
    output: OutputArgs,
}

#[derive(Debug, Args)]
struct DrawArgs {
    /// Map; may be repeated [surface artifact]
    #[arg(long, value_name = "DIR", required_unless_present = "tif")]
    surface: Vec<PathBuf>,
    /// Tool influence function, instead of maps; may be repeated [tif artifact]
    #[arg(long, value_name = "DIR", conflicts_with = "surface")]
    tif: Vec<PathBuf>,
    /// Map whose valid pixels are outlined [surface artifact]
    #[arg(long, value_name = "DIR", conflicts_with = "tif")]
    outline: Option<PathBuf>,
    /// y of the section, mm [default: the middle of the first map]
    #[arg(long, value_name = "Y", allow_negative_numbers = true)]
    section_y_mm: Option<f64>,
    /// Draw all maps in one colour scale
    #[arg(long)]
    common_scale: bool,
    #[command(flatten)]
    output: OutputFileArgs,
}

fn main() -> ExitCode {
    let method = planish_handoff::parse::<Cli>().method;
    run(move || match method {
        Method::Prepare(args) => prepare_stage(&args),
        Method::Statistics(args) => statistics_stage(&args),
        Method::Psd(args) => psd_stage(&args),
        Method::Tif(args) => tif_stage(&args),
        Method::Draw(args) => draw_stage(&args),
    })
}

fn prepare_stage(args: &PrepareArgs) -> Result<Status, Failure> {
    let mut inputs = Inputs::new();
    let surface: Surface = inputs.read("surface", &args.surface)?;
    let settings = PrepareSettings {
        aperture: aperture(&mut inputs, &args.aperture)?,
        outliers: outlier_settings(&mut inputs, &args.outliers)?,
        level: level(args)?,
        fill: args.fill,
        extension: extension_settings(&args.extension)?,
    };
    let task = task!("prepare", &settings);
    let mut output = match Output::directory(&args.output, Surface::KIND).begin(&task, &inputs)? {
        Begin::Unchanged(status) => return Ok(status),
        Begin::Run(output) => output,
    };
    let prepared = prepare(&surface, &settings)?;
    let report = &prepared.report;
    output.write(&prepared.surface, serde_json::to_value(report)?, &Status::Done)?;
    let (rows, columns) = report.after.shape;
    let masked = report.outliers.as_ref().map_or(String::new(), |o| {
        format!(", {} outlier(s) masked ({} px)", o.components, o.masked_pixels)
    });
    let filled = report.filled.as_ref().map_or(String::new(), |f| {
        format!(", {} hole(s) filled ({} px)", f.holes, f.filled_pixels)
    });
    let extended = report.extended.as_ref().map_or(String::new(), |e| {
        format!(
            ", {} px extended ({:.2} .. {:.2} nm)",
            e.extended_pixels, e.range_nm[0], e.range_nm[1]
        )
    });
    say(format!(
        "planish-surface: {columns} x {rows} px, {} valid, RMS {:.4} nm, PV {:.3} nm{masked}{filled}{extended}",
        report.after.valid_pixels, report.after.rms_nm, report.after.pv_nm
    ));
    let notes = [
        report.removed_low_order.as_ref().and_then(|r| r.note.as_ref()),
        report.filled.as_ref().and_then(|r| r.note.as_ref()),
    ];
    notes.into_iter().flatten().for_each(|note| say(format!("planish-surface: note: {note}")));
    Ok(Status::Done)
}

fn level(args: &PrepareArgs) -> Result<Level, Failure> {
    let family = match args.level {
        LevelArg::Zernike => Family::Zernike,
        LevelArg::Legendre => Family::Legendre,
        LevelArg::Chebyshev => Family::Chebyshev,
        LevelArg::None | LevelArg::Piston | LevelArg::Plane => {
            if args.level_order.is_some() {
                let remedy = "use it with --level zernike, legendre or chebyshev";
                return Err(Failure::new(format!("--level-order: has no terms here; {remedy}")));
            }
            refuse_circle(args.zernike_circle_mm.is_some())?;
            return Ok(match args.level {
                LevelArg::None => Level::None,
                LevelArg::Plane => Level::Plane,
                _ => Level::Piston,
            });
        }
    };
    refuse_circle(args.zernike_circle_mm.is_some() && family != Family::Zernike)?;
    let order = args.level_order.ok_or_else(|| {
        Failure::new("--level-order: is missing; give the highest order of the terms to subtract")
    })?;
    Ok(Level::LowOrder(LowOrderSettings { family, order, circle: circle(&args.zernike_circle_mm) }))
}

fn refuse_circle(given: bool) -> Result<(), Failure> {
    match given {
        true => Err(Failure::new("--zernike-circle-mm: has no use without zernike terms")),
        false => Ok(()),
    }
}

fn circle(given: &Option<Vec<f64>>) -> Option<Circle> {
    given.as_ref().map(|v| Circle { centre_mm: [v[0], v[1]], radius_mm: v[2] })
}

fn aperture(inputs: &mut Inputs, args: &ApertureArgs) -> Result<Option<ClearAperture>, Failure> {
    if let Some(path) = &args.aperture_mask {
        return Ok(Some(ClearAperture::Mask(inputs.read_mask("aperture-mask", path)?)));
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
    inputs: &mut Inputs,
    args: &OutlierArgs,
) -> Result<Option<OutlierSettings>, Failure> {
    let feature_mm = match (&args.tif, args.feature_mm) {
        (Some(dir), _) => half_maximum_width_mm(&inputs.read::<Tif>("tif", dir)?),
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

fn extension_settings(args: &ExtensionArgs) -> Result<Option<ExtensionSettings>, Failure> {
    let (Some(method), Some(margin_mm)) = (args.extend, args.extend_mm) else { return Ok(None) };
    // A flag of another method would be ignored in silence.
    let flags = [
        ("--extend-sigma-mm", args.extend_sigma_mm.is_some(), ExtendArg::GaussianDecay),
        (
            "--extend-cutoff-per-mm",
            args.extend_cutoff_per_mm.is_some(),
            ExtendArg::GerchbergPapoulis,
        ),
        ("--extend-iterations", args.extend_iterations.is_some(), ExtendArg::GerchbergPapoulis),
        ("--extend-tolerance-nm", args.extend_tolerance_nm.is_some(), ExtendArg::GerchbergPapoulis),
        ("--extend-order", args.extend_order.is_some(), ExtendArg::Polynomial),
        ("--extend-without-ring", args.extend_without_ring, ExtendArg::Polynomial),
    ];
    if let Some((flag, ..)) = flags.iter().find(|(_, given, of)| *given && *of != method) {
        return Err(Failure::new(format!("{flag}: has no use with this --extend; leave it out")));
    }
    let method = match method {
        ExtendArg::Nearest => extension::Method::Nearest,
        ExtendArg::GaussianDecay => extension::Method::GaussianDecay(gaussian_decay::Settings {
            sigma_mm: args.extend_sigma_mm.unwrap_or(margin_mm / 3.0),
        }),
        ExtendArg::GerchbergPapoulis => {
            let cutoff_per_mm = args.extend_cutoff_per_mm.ok_or_else(|| {
                Failure::new(
                    "--extend-cutoff-per-mm: is missing; 1 / (2 FWHM) of the tool is usual",
                )
            })?;
            extension::Method::GerchbergPapoulis(gerchberg_papoulis::Settings {
                cutoff_per_mm,
                max_iterations: args.extend_iterations.unwrap_or(300),
                tolerance_nm: args.extend_tolerance_nm.unwrap_or(1e-3),
            })
        }
        ExtendArg::Polynomial => extension::Method::Polynomial(polynomial::Settings {
            order: args.extend_order.as_ref().map_or([9, 6], |o| [o[0], o[1]]),
            ring: !args.extend_without_ring,
        }),
    };
    Ok(Some(ExtensionSettings { margin_mm, method }))
}

/// The map, or the residual.
fn read_map(inputs: &mut Inputs, args: &MapArgs) -> Result<Surface, Failure> {
    match (&args.surface, &args.removal) {
        (Some(dir), _) => Ok(inputs.read("surface", dir)?),
        (None, Some(dir)) => Ok(inputs.read::<Removal>("removal", dir)?.residual().clone()),
        (None, None) => Err(Failure::new("--surface: is missing; give it or --removal")),
    }
}

fn statistics_stage(args: &StatisticsArgs) -> Result<Status, Failure> {
    let mut inputs = Inputs::new();
    let surface = read_map(&mut inputs, &args.map)?;
    let found = surface_statistics(&surface, args.pvr_terms, circle(&args.zernike_circle_mm))?;
    let zernike = found.pvr.as_ref().is_some_and(|p| p.family == Family::Zernike);
    refuse_circle(args.zernike_circle_mm.is_some() && !zernike)?;
    say(serde_json::to_string_pretty(&found)?);
    Ok(Status::Done)
}

fn psd_stage(args: &PsdArgs) -> Result<Status, Failure> {
    let mut inputs = Inputs::new();
    let surface = read_map(&mut inputs, &args.map)?;
    let settings = PsdSettings {
        window: args.window,
        detrend: args.detrend,
        band_per_mm: args.band_per_mm.chunks_exact(2).map(|b| [b[0], b[1]]).collect(),
    };
    let task = task!("psd", &settings);
    let mut output = match Output::directory(&args.output, &kind::PSD).begin(&task, &inputs)? {
        Begin::Unchanged(status) => return Ok(status),
        Begin::Run(output) => output,
    };
    let found = psd(&surface, &settings)?;
    let picture = [("psd.svg", psd_svg(&found).into_bytes())];
    let outcome = serde_json::to_value(&found.report)?;
    output.write_arrays(&kind::PSD, &psd_arrays(&found), &picture, outcome, &Status::Done)?;
    let r = &found.report;
    say(format!(
        "planish-surface: spectrum of {} x {} px ({:.1} % of the valid ones), RMS {:.4} nm, in the \
         spectrum {:.4} nm",
        r.shape.1,
        r.shape.0,
        100.0 * r.fraction_of_valid_pixels,
        r.rms_nm,
        r.spectral_rms_nm
    ));
    for b in &r.bands {
        let [low, high] = b.band_per_mm;
        say(format!(
            "planish-surface: {low} .. {high} /mm: {:.4} nm RMS (along x {:.4}, along y {:.4})",
            b.rms_nm, b.rms_x_nm, b.rms_y_nm
        ));
    }
    Ok(Status::Done)
}

/// In the order of the kind.
fn psd_arrays(psd: &Psd) -> Vec<ArrayData> {
    let line = |v: &[f64]| ArrayData::F64(Array1::from(v.to_vec()).into_dyn());
    vec![
        ArrayData::F64(psd.psd_2d_nm2_mm2.clone().into_dyn()),
        line(&psd.frequency_2d_x_per_mm),
        line(&psd.frequency_2d_y_per_mm),
        line(&psd.psd_x_nm2_mm),
        line(&psd.frequency_x_per_mm),
        line(&psd.psd_y_nm2_mm),
        line(&psd.frequency_y_per_mm),
        line(&psd.psd_radial_nm2_mm2),
        line(&psd.frequency_radial_per_mm),
    ]
}

fn tif_stage(args: &TifArgs) -> Result<Status, Failure> {
    let mut inputs = Inputs::new();
    let tif: Tif = inputs.read("tif", &args.tif)?;
    let settings = TifSettings {
        subtract_border: args.subtract_border,
        centre: args.centre,
        rotate_deg: args.rotate_deg,
        pitch_mm: args.pitch_mm,
        taper_fraction: args.taper_fraction,
    };
    let model = args.fit;
    let task = task!("tif", json!({ "tif": settings, "fit": model, "use_fit": args.use_fit }));
    let mut output = match Output::directory(&args.output, Tif::KIND).begin(&task, &inputs)? {
        Begin::Unchanged(status) => return Ok(status),
        Begin::Run(output) => output,
    };
    let (mut made, report) = prepare_tif(&tif, &settings)?;
    let mut outcome = serde_json::to_value(&report)?;
    let mut status = Status::Done;
    if let Some(model) = model {
        let (formula, fit) = tif_fit::fit(&made, model)?;
        outcome["fit"] = serde_json::to_value(&fit)?;
        if !fit.converged {
            status = Status::Negative(format!("the fit did not converge in {} steps", fit.steps));
        }
        say(format!(
            "planish-surface: fit: residual {:.3} % of the peak RMS, VRR of the formula {:.4} of the \
             samples'",
            100.0 * fit.residual_rms_to_peak,
            fit.vrr_ratio
        ));
        if args.use_fit {
            made = formula;
        }
    }
    output.write(&made, outcome, &status)?;
    let s = planish_surface::tif::tif_statistics(&made);
    say(format!(
        "planish-surface: TIF {} x {} samples, {:.4} x {:.4} mm; peak {:.4} nm/s, VRR {:.4} \
         nm mm^2/s, centroid ({:.4}, {:.4}) mm, border {:.2} % of the peak",
        s.shape.1,
        s.shape.0,
        s.pitch_mm[0],
        s.pitch_mm[1],
        s.peak_nm_per_s,
        s.vrr_nm_mm2_per_s,
        s.centroid_mm[0],
        s.centroid_mm[1],
        100.0 * s.border_to_peak
    ));
    report.note.iter().for_each(|note| say(format!("planish-surface: note: {note}")));
    Ok(status)
}

fn draw_stage(args: &DrawArgs) -> Result<Status, Failure> {
    let mut inputs = Inputs::new();
    let mut panels = Vec::new();
    for dir in &args.surface {
        panels.push(panel(dir, &inputs.read("surface", dir)?));
    }
    for dir in &args.tif {
        let tif: Tif = inputs.read("tif", dir)?;
        panels.push(Panel {
            title: title(dir),
            grid: *tif.grid(),
            map: tif.rate_nm_per_s().clone(),
        });
    }
    let outline =
        args.outline.as_ref().map(|dir| inputs.read("outline", dir).map(|s| panel(dir, &s)));
    if let Some(y) = args.section_y_mm {
        let inside = |p: &Panel| (p.grid.y.start_mm()..=p.grid.y.end_mm()).contains(&y);
        if !panels.iter().any(inside) {
            let y_mm = &panels[0].grid.y;
            return Err(Failure::new(format!(
                "--section-y-mm: is {y}, no map is there; the first goes from {} to {} mm",
                y_mm.start_mm(),
                y_mm.end_mm()
            )));
        }
    }
    let settings = MapsSettings {
        unit: if args.tif.is_empty() { "nm" } else { "nm/s" },
        section_y_mm: args.section_y_mm,
        common_scale: args.common_scale,
        outline: outline.transpose()?,
    };
    let output = args.output.begin(&inputs)?;
    output.write(maps_svg(&panels, &settings).as_bytes())?;
    let out = args.output.out.display();
    say(format!("planish-surface: {} map(s) drawn to {out}", panels.len()));
    Ok(Status::Done)
}

fn panel(dir: &Path, surface: &Surface) -> Panel {
    Panel { title: title(dir), grid: *surface.grid(), map: surface.height_nm().clone() }
}

/// The name of the directory.
fn title(dir: &Path) -> String {
    dir.file_name().map_or(String::new(), |n| n.to_string_lossy().into_owned())
}
