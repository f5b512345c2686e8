//! `planish surface spec`.

use std::path::PathBuf;

use clap::{ArgAction, Args};
use ndarray::Array1;
use planish_form::ImagingConic;
use planish_handoff::{
    Begin, Failure, Inputs, Output, Status, flags::OutputArgs, kind, npy::ArrayData, say, task,
};
use planish_surface::{
    quality::{Light, Quality, QualityArrays, QualitySettings, Subject, quality},
    shape::{EllipseParameter, EllipseSettings, Shape},
    specification::{Specification, SpecificationReport, Verdict},
};
use planish_types::{Removal, outcome::specification::SpecificationOutcome, text::significant};
use serde_json::json;

use super::profile::ProfileArgs;

/// Grazing angle of normal incidence, mrad (a right angle).
const NORMAL_MRAD: f64 = 1e3 * std::f64::consts::FRAC_PI_2;

#[derive(Debug, Args)]
pub struct SpecArgs {
    #[command(flatten)]
    source: SourceArgs,
    #[command(flatten)]
    columns: ProfileArgs,
    /// Shape to subtract before anything is measured
    #[arg(long, value_enum, default_value_t = Shape::Plane)]
    subtract: Shape,
    /// Elliptical mirror: source to pole (mm), pole to image (mm), grazing angle (mrad); the source is
    /// where x is smallest [default: that of the specification]
    #[arg(long, num_args = 3, value_names = ["P_MM", "Q_MM", "THETA_MRAD"], allow_negative_numbers = true)]
    ellipse: Option<Vec<f64>>,
    /// Parameters of the ellipse that are fitted, beside piston and tilt
    #[arg(long, value_enum, value_delimiter = ',', requires = "ellipse")]
    ellipse_free: Vec<EllipseParameter>,
    /// Place of the pole of the ellipse, mm [default: the middle of the valid pixels]
    #[arg(long, value_name = "X", requires = "ellipse", allow_negative_numbers = true)]
    ellipse_pole_mm: Option<f64>,
    /// Base length of slopes, mm; the whole number of pixels nearest to it is used
    #[arg(long, value_name = "L", default_value_t = 1.0, allow_negative_numbers = true)]
    base_mm: f64,
    /// Band of spatial frequencies [F0, F1) for an RMS, 1/mm; may be repeated
    #[arg(long, num_args = 2, value_names = ["F0", "F1"], action = ArgAction::Append, allow_negative_numbers = true)]
    band_per_mm: Vec<f64>,
    /// Width of the strip about the middle of y whose mean is the centre line, mm; 0 for one row
    #[arg(long, value_name = "W", default_value_t = 0.0, allow_negative_numbers = true)]
    centre_line_width_mm: f64,
    /// Wavelength of the light, nm, for the Strehl ratio
    #[arg(long, value_name = "L", allow_negative_numbers = true)]
    wavelength_nm: Option<f64>,
    /// Grazing angle for the Strehl ratio, mrad [default: normal incidence]
    #[arg(long, value_name = "A", requires = "wavelength_nm", allow_negative_numbers = true)]
    grazing_mrad: Option<f64>,
    /// Limits that the mirror must keep; with exit code 1 the program names those that it does not keep [JSON]
    #[arg(long, value_name = "FILE")]
    specification: Option<PathBuf>,
    /// RMS of the white noise of the heights, nm, if known: every verdict states the part of the noise, and
    /// whether the noise decides
    #[arg(long, value_name = "S", requires = "specification", allow_negative_numbers = true)]
    noise_nm: Option<f64>,
    #[command(flatten)]
    output: OutputArgs,
}

#[derive(Debug, Args)]
#[group(required = true, multiple = false)]
struct SourceArgs {
    /// Map [surface artifact]
    #[arg(long, value_name = "DIR")]
    surface: Option<PathBuf>,
    /// Predicted removal whose residual is the map [removal artifact]
    #[arg(long, value_name = "DIR")]
    removal: Option<PathBuf>,
    /// Measured line: a table as text, or a .npy file of shape (positions, columns)
    #[arg(long, value_name = "FILE", requires = "value_unit")]
    profile: Option<PathBuf>,
}

impl SpecArgs {
    pub fn run(&self) -> Result<Status, Failure> {
        let mut inputs = Inputs::new();
        let subject = self.subject(&mut inputs)?;
        let specification = match &self.specification {
            Some(file) => {
                let read: Specification = inputs.read_json("specification", file)?;
                read.check().map_err(|e| Failure::new(format!("{}: {e}", file.display())))?;
                Some((file, read))
            }
            None => None,
        };
        let settings = self.settings(specification.as_ref().map(|(_, s)| s))?;
        let profile = self.source.profile.as_ref().map(|_| self.columns.settings());
        let task = task!(
            "spec",
            &json!({
                "quality": settings,
                "profile": profile.transpose()?,
                "noise_nm": self.noise_nm,
            })
        );
        let output = Output::directory(&self.output, &kind::SPECIFICATION);
        let mut output = match output.begin(&task, &inputs)? {
            Begin::Unchanged(status) => return Ok(status),
            Begin::Run(output) => output,
        };
        let quality = quality(&subject, &settings).map_err(Failure::with_flags)?;
        let verdict = match &specification {
            Some((file, specification)) => {
                let noise_nm = self.noise_nm.unwrap_or(0.0);
                let report = specification.judge_beside_noise(&subject, noise_nm).map_err(|e| {
                    match e.array {
                        "noise_nm" => Failure::with_flags(e),
                        _ => Failure::new(format!("{}: {e}", file.display())),
                    }
                })?;
                Some(report)
            }
            None => None,
        };
        let status = verdict
            .as_ref()
            .and_then(SpecificationReport::failures)
            .map_or(Status::Done, Status::Negative);
        let arrays = arrays(&quality.arrays);
        let outcome = SpecificationOutcome { more: &quality, specification: verdict };
        output.write_arrays(&kind::SPECIFICATION, &arrays, &[], &outcome, &status)?;
        report(&quality);
        outcome.specification.iter().flat_map(|v| &v.limits).for_each(|limit| {
            let verdict = match limit.verdict() {
                Verdict::Kept => "kept ",
                Verdict::Broken => "FAILS",
                Verdict::NoiseDecides => "NOISE",
            };
            say(format!("{verdict}  {}", limit.text()));
        });
        Ok(status)
    }

    fn subject(&self, inputs: &mut Inputs) -> Result<Subject, Failure> {
        let SourceArgs { surface, removal, profile } = &self.source;
        match (surface, removal, profile) {
            (Some(dir), ..) => Ok(Subject::Map(inputs.read("surface", dir)?)),
            (_, Some(dir), _) => {
                let removal: Removal = inputs.read("removal", dir)?;
                Ok(Subject::Map(removal.residual().clone()))
            }
            (.., Some(file)) => Ok(Subject::Profile(self.columns.read(inputs, file)?)),
            _ => Err(Failure::new("--surface: is missing; give it, --removal or --profile")),
        }
    }

    fn settings(&self, specification: Option<&Specification>) -> Result<QualitySettings, Failure> {
        let ellipse = match &self.ellipse {
            Some(numbers) => Some(EllipseSettings {
                design: ImagingConic::ellipse(numbers[0], numbers[1], 1e-3 * numbers[2])?,
                free: self.ellipse_free.clone(),
                pole_mm: self.ellipse_pole_mm,
            }),
            None => specification.map(Specification::ellipse).transpose()?.flatten(),
        };
        let grazing_mrad = self.grazing_mrad.unwrap_or(NORMAL_MRAD);
        let light = self.wavelength_nm.map(|wavelength_nm| Light { wavelength_nm, grazing_mrad });
        Ok(QualitySettings {
            after: self.subtract,
            ellipse,
            base_mm: self.base_mm,
            band_per_mm: self.band_per_mm.chunks_exact(2).map(|b| [b[0], b[1]]).collect(),
            centre_line_width_mm: self.centre_line_width_mm,
            light,
        })
    }
}

/// Prints the measured quantities of a mirror.
fn report(quality: &Quality) {
    let base_mm = quality.slope_x.base_mm;
    let over = if base_mm > 0.0 {
        format!("over {} mm", significant(base_mm, 4))
    } else {
        "as measured".into()
    };
    say(format!("after            height RMS    PV (nm)    slope {over}: RMS along x, y (nrad)"));
    for after in &quality.after {
        let shape = &after.shape;
        let mut how = String::new();
        if let Some(radius) = shape.radius_m {
            how += &format!("  radius {} m", significant(radius, 6));
        }
        if let Some(e) = &shape.ellipse {
            let [p, q, theta] = [e.p_mm, e.q_mm, e.theta_mrad].map(|v| significant(v, 9));
            how += &format!("  p {p} mm, q {q} mm, theta {theta} mrad");
        }
        say(format!(
            "{:<14} {:>12} {:>10}    {}, {}{how}",
            shape.shape.name(),
            significant(after.height_rms_nm, 4),
            significant(after.height_pv_nm, 4),
            or_dash(after.slope_x_rms_nrad),
            or_dash(after.slope_y_rms_nrad),
        ));
    }
    let after = quality.shape.shape.name();
    if let Some(line) = &quality.centre_line {
        let [low, high] = line.y_mm.map(|y| significant(y, 4));
        say(format!(
            "centre line (y {low} to {high} mm) after {after}: {} nm RMS, {} nm PV, {} nrad RMS",
            significant(line.height_rms_nm, 4),
            significant(line.height_pv_nm, 4),
            or_dash(line.slope_rms_nrad)
        ));
    }
    for band in &quality.bands {
        let [low, high] = band.band_per_mm;
        say(format!(
            "{low} .. {high} /mm after {after}: {} nm RMS; slope along x {}, along y {} nrad RMS",
            significant(band.height_rms_nm, 4),
            significant(band.slope_x_rms_nrad, 4),
            or_dash(band.slope_y_rms_nrad)
        ));
    }
    let lengths = [quality.autocorrelation_length_x_mm, quality.autocorrelation_length_y_mm];
    let [x, y] = lengths.map(or_dash);
    say(format!("autocorrelation length after {after}: along x {x}, along y {y} mm"));
    if let Some(s) = &quality.strehl {
        say(format!(
            "Strehl ratio at {} nm after {after}: {} ({} rad RMS)",
            significant(s.light.wavelength_nm, 6),
            significant(s.strehl, 4),
            significant(s.phase_rms_rad, 3)
        ));
    }
    quality.notes.iter().for_each(|note| say(format!("note: {note}")));
}

/// Returns a number as it is printed; a dash for `None`.
fn or_dash(value: Option<f64>) -> String {
    value.map_or("-".into(), |v| significant(v, 4))
}

/// Returns the arrays of the artifact, in the order of its kind.
fn arrays(arrays: &QualityArrays) -> Vec<ArrayData<'_>> {
    let QualityArrays { position_mm, height_nm, slope_position_mm, slope_nrad, lines } = arrays;
    let spectra = lines.iter().flat_map(|s| [&s.frequency_per_mm, &s.height, &s.slope]);
    let all = [position_mm, height_nm, slope_position_mm, slope_nrad].into_iter().chain(spectra);
    all.map(|v| ArrayData::F64(Array1::from(v.to_vec()).into_dyn().into())).collect()
}
