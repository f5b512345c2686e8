//! `planish surface prepare`.

use std::path::PathBuf;

use clap::{Args, ValueEnum};
use planish_form::FormFile;
use planish_handoff::{
    Artifact, Begin, Failure, Inputs, Output, Status, flags::OutputArgs, kind, say, task, warn,
};
use planish_surface::{
    Family, Level, LowOrderSettings, OutlierSettings, PrepareError, PrepareReport, PrepareSettings,
    extension::{
        ExtensionMethod, ExtensionSettings, gaussian_decay::GaussianDecaySettings,
        gerchberg_papoulis::GerchbergPapoulisSettings, polynomial::PolynomialSettings,
    },
    prepare_to,
    target::{Heights, Lateral, Target, converted},
};
use planish_types::{ClearAperture, Surface, text::significant};
use serde::Serialize;

use super::{CIRCLE, circle};

const RECTANGLE: [&str; 4] = ["X0", "X1", "Y0", "Y1"];

/// Settings of the preparation as the manifest states them.
#[derive(Serialize)]
struct StatedSettings<'a> {
    #[serde(flatten)]
    settings: &'a PrepareSettings,
    /// Direction of the heights of the map; `None` if the form of the part is not given.
    #[serde(skip_serializing_if = "Option::is_none")]
    heights: Option<&'a Heights>,
    /// Direction of the coordinates of the map; `None` if the form of the part is not given.
    #[serde(skip_serializing_if = "Option::is_none")]
    lateral: Option<&'a Lateral>,
    /// Form to subtract; `None` for none.
    #[serde(skip_serializing_if = "Option::is_none")]
    target: Option<&'a FormFile>,
}

#[derive(Debug, Args)]
pub struct PrepareArgs {
    /// Map as it was measured [surface artifact]
    #[arg(long, value_name = "DIR")]
    surface: PathBuf,
    #[command(flatten)]
    form: FormArgs,
    /// Function to subtract: nothing, a constant (smallest height 0), the plane and a constant, or terms up
    /// to --level-order and a constant
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
    /// Fill invalid pixels of the clear aperture smoothly from their rims; without an aperture, enclosed ones only. Use
    /// it for programs that cannot skip invalid pixels; the solvers of Planish skip them
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
struct FormArgs {
    /// Form to subtract, as given or with the parameters that its `fit` frees [form file, JSON]
    #[arg(long, value_name = "FILE")]
    target: Option<PathBuf>,
    /// Form of the part: a form file [JSON], or its height along z [surface artifact]; for --heights and --lateral
    #[arg(long, value_name = "PATH")]
    form: Option<PathBuf>,
    /// Direction of the heights of the map; they become heights along z
    #[arg(long, value_enum, default_value_t = Heights::Z)]
    heights: Heights,
    /// Lateral axes of the map; they become projected ones
    #[arg(long, value_enum, default_value_t = Lateral::Projected)]
    lateral: Lateral,
}

impl FormArgs {
    /// Returns the map with heights along z and projected axes, and the form file that the conversion used. Without
    /// `--form`, the map stays as it is.
    fn converted(
        &self,
        surface: Surface,
        inputs: &mut Inputs,
    ) -> Result<(Surface, Option<FormFile>), Failure> {
        let Self { form, heights, lateral, .. } = self;
        match form {
            None if *heights == Heights::Normal => {
                Err(Failure::new("--heights: is normal, of an unknown form; give --form"))
            }
            None if *lateral == Lateral::Surface => {
                Err(Failure::new("--lateral: is surface, of an unknown form; give --form"))
            }
            None => Ok((surface, None)),
            Some(path) if (*heights, *lateral) == (Heights::Z, Lateral::Projected) => {
                Err(Failure::new(format!(
                    "--form: {} has no effect on heights along z over projected axes; give --heights normal or --lateral \
                     surface, or --target to subtract a form",
                    path.display()
                )))
            }
            Some(path) => {
                let read = inputs.read_form("form", path)?;
                let map = converted(&surface, &read.form, *heights, *lateral)
                    .map_err(|e| Failure::new(format!("{}: {e}", path.display())))?;
                Ok((map, read.file.map(|stated| stated.file)))
            }
        }
    }

    fn target(&self, inputs: &mut Inputs) -> Result<Option<Target>, Failure> {
        let Some(path) = &self.target else { return Ok(None) };
        let Some(stated) = inputs.read_form("target", path)?.file else {
            return Err(Failure::new(format!(
                "--target: {} is a directory; give a form file, such as {{\"kind\": \"map\", \"surface\": \"DIR\"}}",
                path.display()
            )));
        };
        Ok(Some(Target { file: stated.file, map: stated.map }))
    }
}

#[derive(Debug, Args)]
struct OutlierArgs {
    /// Mask pits and dust that are narrower than half the tool; needs --tif or --feature-mm
    #[arg(long, requires = "feature")]
    mask_outliers: bool,
    /// Tool influence function, whose width at half maximum decides which features are narrow [tif
    /// artifact]
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
    /// Multiple of the noise (1.4826 MAD) above which a deviation is a seed [default: 15]
    #[arg(long, value_name = "K", requires = "mask_outliers", allow_negative_numbers = true)]
    outlier_seed_sigmas: Option<f64>,
    /// Multiple of the noise above which a pixel joins a seed next to it [default: 6]
    #[arg(long, value_name = "K", requires = "mask_outliers", allow_negative_numbers = true)]
    outlier_grow_sigmas: Option<f64>,
    /// Smallest deviation of a seed, nm [default: 1]
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
    /// gerchberg-papoulis: largest number of steps [default: 300]
    #[arg(long, value_name = "N", requires = "extend", allow_negative_numbers = true)]
    extend_iterations: Option<usize>,
    /// gerchberg-papoulis: largest change of a height in the last step, nm [default: 1e-3]
    #[arg(long, value_name = "NM", requires = "extend", allow_negative_numbers = true)]
    extend_tolerance_nm: Option<f64>,
    /// polynomial: highest orders along x and y [default: 9 6]
    #[arg(long, num_args = 2, value_names = ["I", "J"], requires = "extend", allow_negative_numbers = true)]
    extend_order: Option<Vec<u32>>,
    /// polynomial: fit without the ring of heights at the outer edge (only for maps that are polynomials)
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

impl PrepareArgs {
    pub fn run(&self) -> Result<Status, Failure> {
        let mut inputs = Inputs::new();
        let surface: Surface = inputs.read("surface", &self.surface)?;
        let (surface, converted_along) = self.form.converted(surface, &mut inputs)?;
        // The form that an earlier run wrote beside the map stays with it.
        let earlier = self.surface.join(kind::FORM_FILE);
        let mut earlier_form = None;
        if earlier.exists() {
            let read = inputs.read_form("surface-form", &earlier)?;
            earlier_form = read.file.map(|stated| stated.file);
        }
        let target = self.form.target(&mut inputs)?;
        let settings = PrepareSettings {
            aperture: self.aperture.read(&mut inputs)?,
            outliers: self.outliers.read(&mut inputs)?,
            level: self.level()?,
            fill: self.fill,
            extension: self.extension.settings()?,
        };
        let has_form = self.form.form.is_some();
        let stated = StatedSettings {
            settings: &settings,
            heights: Some(&self.form.heights).filter(|_| has_form),
            lateral: Some(&self.form.lateral).filter(|_| has_form),
            target: target.as_ref().map(|target| &target.file),
        };
        let task = task!("prepare", &stated);
        let mut output =
            match Output::directory(&self.output, Surface::KIND).begin(&task, &inputs)? {
                Begin::Unchanged(status) => return Ok(status),
                Begin::Run(output) => output,
            };
        let prepared = prepare_to(&surface, &settings, target.as_ref()).map_err(|e| {
            match (&self.form.target, e) {
                (Some(path), PrepareError::Invalid(e)) if e.to_string().starts_with("target") => {
                    Failure::new(format!("{}: {e}", path.display()))
                }
                (_, e) => e.into(),
            }
        })?;
        let report = &prepared.report;
        // The form stands beside the map, for the stages that need it; a map refers to another directory.
        let subtracted = report.target.as_ref().map(|t| t.form.clone());
        let part_form = earlier_form.or(converted_along).or(subtracted);
        let part_form = part_form.filter(|file| file.surface.is_none());
        let mut beside = Vec::new();
        if let Some(file) = part_form {
            let file = FormFile { fit: None, ..file };
            beside.push((kind::FORM_FILE, serde_json::to_vec_pretty(&file)?));
        }
        let arrays = prepared.surface.to_arrays();
        let outcome = serde_json::to_value(report)?;
        output.write_arrays(Surface::KIND, &arrays, &beside, outcome, &Status::Done)?;
        print_report(report);
        Ok(Status::Done)
    }

    fn low_order(&self, family: Family) -> Result<Level, Failure> {
        let order = self.level_order.ok_or_else(|| {
            Failure::new(
                "--level-order: is missing; give the highest order of the terms to subtract",
            )
        })?;
        let circle = self.zernike_circle_mm.as_deref().map(circle);
        Ok(Level::LowOrder(LowOrderSettings { family, order, circle }))
    }

    fn level(&self) -> Result<Level, Failure> {
        let level = match self.level {
            LevelArg::Zernike => return self.low_order(Family::Zernike),
            LevelArg::Legendre => return self.low_order(Family::Legendre),
            LevelArg::Chebyshev => return self.low_order(Family::Chebyshev),
            LevelArg::None => Level::None,
            LevelArg::Piston => Level::Piston,
            LevelArg::Plane => Level::Plane,
        };
        if self.level_order.is_some() {
            let remedy = "use it with --level zernike, legendre or chebyshev";
            return Err(Failure::new(format!("--level-order: has no terms here; {remedy}")));
        }
        if self.zernike_circle_mm.is_some() {
            return Err(Failure::new("--zernike-circle-mm: has no use without zernike terms"));
        }
        Ok(level)
    }
}

impl ApertureArgs {
    fn read(&self, inputs: &mut Inputs) -> Result<Option<ClearAperture>, Failure> {
        if let Some(path) = &self.aperture_mask {
            return Ok(Some(ClearAperture::Mask(inputs.read_mask("aperture-mask", path)?)));
        }
        let rectangle = self
            .aperture_rectangle_mm
            .as_ref()
            .map(|v| ClearAperture::Rectangle { x_mm: [v[0], v[1]], y_mm: [v[2], v[3]] });
        let circle = self
            .aperture_circle_mm
            .as_ref()
            .map(|v| ClearAperture::Circle { centre_mm: [v[0], v[1]], radius_mm: v[2] });
        Ok(rectangle.or(circle))
    }
}

impl OutlierArgs {
    fn read(&self, inputs: &mut Inputs) -> Result<Option<OutlierSettings>, Failure> {
        let feature_mm = match (&self.tif, self.feature_mm) {
            (Some(dir), _) => inputs.read_tool("tif", dir)?.half_maximum_width_mm(),
            (None, Some(width)) => width,
            (None, None) => return Ok(None),
        };
        let default = OutlierSettings::for_feature_mm(feature_mm);
        Ok(Some(OutlierSettings {
            feature_mm,
            seed_sigmas: self.outlier_seed_sigmas.unwrap_or(default.seed_sigmas),
            grow_sigmas: self.outlier_grow_sigmas.unwrap_or(default.grow_sigmas),
            floor_nm: self.outlier_floor_nm.unwrap_or(default.floor_nm),
            dilate_px: self.outlier_dilate_px.unwrap_or(default.dilate_px),
        }))
    }
}

impl ExtensionArgs {
    fn settings(&self) -> Result<Option<ExtensionSettings>, Failure> {
        let (Some(method), Some(margin_mm)) = (self.extend, self.extend_mm) else {
            return Ok(None);
        };
        self.refuse_flags_of_another(method)?;
        let method = match method {
            ExtendArg::Nearest => ExtensionMethod::Nearest,
            ExtendArg::GaussianDecay => {
                let usual = GaussianDecaySettings::for_margin_mm(margin_mm);
                ExtensionMethod::GaussianDecay(GaussianDecaySettings {
                    sigma_mm: self.extend_sigma_mm.unwrap_or(usual.sigma_mm),
                })
            }
            ExtendArg::GerchbergPapoulis => {
                let cutoff_per_mm = self.extend_cutoff_per_mm.ok_or_else(|| {
                    Failure::new(
                        "--extend-cutoff-per-mm: is missing; 1 / (2 FWHM) of the tool is usual",
                    )
                })?;
                let usual = GerchbergPapoulisSettings::for_cutoff_per_mm(cutoff_per_mm);
                ExtensionMethod::GerchbergPapoulis(GerchbergPapoulisSettings {
                    cutoff_per_mm,
                    max_iterations: self.extend_iterations.unwrap_or(usual.max_iterations),
                    tolerance_nm: self.extend_tolerance_nm.unwrap_or(usual.tolerance_nm),
                })
            }
            ExtendArg::Polynomial => {
                let usual = PolynomialSettings::default();
                ExtensionMethod::Polynomial(PolynomialSettings {
                    order: self.extend_order.as_ref().map_or(usual.order, |o| [o[0], o[1]]),
                    ring: !self.extend_without_ring,
                })
            }
        };
        Ok(Some(ExtensionSettings { margin_mm, method }))
    }

    /// Refuses a flag that belongs to another method of extension, because it would be ignored in silence.
    fn refuse_flags_of_another(&self, method: ExtendArg) -> Result<(), Failure> {
        let flags = [
            ("--extend-sigma-mm", self.extend_sigma_mm.is_some(), ExtendArg::GaussianDecay),
            (
                "--extend-cutoff-per-mm",
                self.extend_cutoff_per_mm.is_some(),
                ExtendArg::GerchbergPapoulis,
            ),
            ("--extend-iterations", self.extend_iterations.is_some(), ExtendArg::GerchbergPapoulis),
            (
                "--extend-tolerance-nm",
                self.extend_tolerance_nm.is_some(),
                ExtendArg::GerchbergPapoulis,
            ),
            ("--extend-order", self.extend_order.is_some(), ExtendArg::Polynomial),
            ("--extend-without-ring", self.extend_without_ring, ExtendArg::Polynomial),
        ];
        let other = flags.iter().find(|(_, is_there, owner)| *is_there && *owner != method);
        if let Some((flag, ..)) = other {
            return Err(Failure::new(format!(
                "{flag}: has no use with this --extend; leave it out"
            )));
        }
        Ok(())
    }
}

/// Prints the steps of the preparation, the RMS and PV of the result, notes and doubts.
fn print_report(report: &PrepareReport) {
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
    if let Some(target) = &report.target {
        let fitted = target.parameters.iter().map(|p| {
            let bound = if p.at_bound { ", at its bound" } else { "" };
            format!(", {} {} (given {}{bound})", p.name, significant(p.value, 9), p.given)
        });
        let [x, y] = target.tilt_urad;
        say(format!(
            "planish surface: form subtracted, tilt {} and {} urad{}; it leaves {} nm RMS",
            significant(x, 6),
            significant(y, 6),
            fitted.collect::<String>(),
            significant(target.rms_nm, 5)
        ));
    }
    say(format!(
        "planish surface: {columns} x {rows} px, {} valid, RMS {:.4} nm, PV {:.3} nm{masked}{filled}{extended}",
        report.after.valid_pixels, report.after.rms_nm, report.after.pv_nm
    ));
    let notes = [
        report.removed_low_order.as_ref().and_then(|r| r.note.as_ref()),
        report.filled.as_ref().and_then(|r| r.note.as_ref()),
    ];
    notes.into_iter().flatten().for_each(|note| say(format!("planish surface: note: {note}")));
    report.doubts.iter().for_each(warn);
}
