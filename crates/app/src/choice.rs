//! Choices of the user in each step, and the command lines that carry them out.
//!
//! A command line is a list of words, and no shell reads it. Every path in it is one of the session's own places, an
//! uploaded file by its checked name, or a fixture by its name: a choice states no path.

use std::collections::BTreeMap;

use planish_pipeline::{definition::Definition, description::PipelineDescription};
use serde::{Deserialize, Serialize};

use crate::{
    guard::{check_file_name, is_word},
    refusal::Refusal,
};

/// Words of a command; the first is `planish`.
pub type Words = Vec<String>;

/// Name of the machine file that the user gave or edited, in the directory of the session.
pub const OWN_MACHINE: &str = "machine.json";
/// Recipe of a tool that is given by a formula, in the directory of the session.
pub const TOOL_RECIPE: &str = "tool-recipe.json";
/// Form that is subtracted from the map of the part, in the directory of the session.
pub const TARGET: &str = "target.json";
/// Folder of the uploaded files of a tool that varies, in the directory of the session.
pub const UPLOADED_VARYING: &str = "files/varying";
/// Directory of a tool that varies, a copy of its uploaded files, in the directory of the session.
pub const VARYING_TOOL: &str = "tool/varying";
/// Map of few pixels of which an estimate is made, in the directory of the session.
pub const BINNED_MAP: &str = "estimates/map";
/// Setting of a pipeline that names the controller of a program.
const EXPORT: &str = "export";
/// Settings that an estimate leaves out: programs and films, which it does not make, and the step, which is its own.
const NOT_ESTIMATED: [&str; 5] = [EXPORT, "program_of", "frames", "noise_nm", STEP];
/// Setting of the distance of the dwell points.
const STEP: &str = "step_mm";
/// Setting of the name of the part.
const PART_NAME: &str = "part_name";
/// Settings that are texts for the heads of the report and of the program. They name no file.
const STATED: [&str; 4] = [PART_NAME, "part_number", "date", "operator"];
/// Distance of the lines of an estimate, over the full width at half maximum of the tool, if those of the plan
/// are closer. Larger: dwell times that remove less well than those of the plan. Smaller: slower estimates; 0.12
/// takes minutes on the fixture flat-92x16, because many dwell times are at their floor. The ripple of a Gaussian
/// tool is 1e-17 there.
const PITCH_PER_WIDTH: f64 = 0.3;
/// Distances of the dwell points of an estimate, over the same width: of few points, and of many. Larger: dwell
/// times that remove less well than a motion. Smaller: slower estimates. Measured beside the plan joint: at 0.3
/// the residual is -9 to +7 % off on rasters, a maze and a random path on coupon, and on disk-100; at 0.4 +21 %
/// on disk-100.
const STEPS_PER_WIDTH: [f64; 2] = [0.3, 0.4];
/// Dwell points up to which they are few. Larger: estimates of spirals take longer than two seconds. Smaller:
/// larger parts have the larger distance, and a larger residual than their plans.
const FEW_POINTS: f64 = 4000.0;
/// Largest number of dwell points of an estimate. Larger: estimates that take minutes. Smaller: none of large parts.
const MOST_POINTS: f64 = 20_000.0;
/// Largest length of a text of the user in a command, bytes. Chosen: names in HDF5 files are shorter.
const MOST_TEXT_BYTES: usize = 200;

/// Reading of the file of an instrument: the flags of `planish import surface`, which the file may make needless.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Reading {
    /// Unit of the values.
    pub unit: Option<String>,
    /// Wavelength of heights in waves, nm.
    pub wavelength_nm: Option<f64>,
    /// Distance of pixel centres, mm.
    pub pixel_mm: Option<f64>,
    /// Unit of the coordinates.
    pub coordinate_unit: Option<String>,
    /// Array to read.
    pub dataset: Option<String>,
    /// Height of the surface per height in the file: 0.5 for the wavefront of one reflection.
    pub surface_per_value: Option<f64>,
    /// Side of the map that the first row of the file is: `top` or `bottom`.
    pub first_row: Option<String>,
    /// Turn counterclockwise, degrees: 0, 90, 180 or 270.
    pub rotate_deg: Option<u16>,
    /// True to mirror x.
    pub flip_x: bool,
    /// True to mirror y.
    pub flip_y: bool,
    /// True if the file counts material as negative.
    pub negate: bool,
}

/// Choice of the part.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PartChoice {
    /// Map of the part.
    pub source: PartSource,
    /// Reading of its file.
    #[serde(default)]
    pub reading: Reading,
    /// Clear aperture; the whole map if absent.
    #[serde(default)]
    pub aperture: Option<Aperture>,
    /// Form that the part is to have, as the text of a form file; `None` if the map is the error already.
    #[serde(default)]
    pub target: Option<String>,
    /// Function that is subtracted before the plan: `piston`, `plane` or `none`.
    pub level: String,
    /// Full width at half maximum of the tool, mm, if narrower pits and dust are to be masked.
    #[serde(default)]
    pub feature_mm: Option<f64>,
}

/// Clear aperture of a part. Numbers in mm.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Aperture {
    /// Smallest and largest x, then y.
    Rectangle([f64; 4]),
    /// Centre x, centre y and radius.
    Circle([f64; 3]),
}

/// Sources of the map of a part, or of a map measured after the run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PartSource {
    /// A simulated mirror, by its name.
    Fixture(String),
    /// An uploaded file, by its name.
    File(String),
    /// The three uploaded arrays `height_nm.npy`, `x_mm.npy` and `y_mm.npy`.
    Arrays,
}

/// Choice of the tool.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ToolChoice {
    /// Source of the removal rates.
    pub source: ToolSource,
    /// Reading of its file.
    #[serde(default)]
    pub reading: Reading,
    /// Formula whose fit replaces a measured tool: `gaussian`, `super-gaussian` or `mixture`; `None` for the samples.
    #[serde(default)]
    pub fit: Option<String>,
}

/// Sources of a tool.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum ToolSource {
    /// The tool of a simulated mirror, by its name.
    Fixture(String),
    /// An uploaded file of rates, by its name.
    Rates(String),
    /// The three uploaded arrays `rate_nm_per_s.npy`, `x_mm.npy` and `y_mm.npy`.
    Arrays,
    /// An uploaded map of the spot, or of the depth of the removal.
    Spot {
        /// Map after the tool acted, or depth of the removal.
        file: String,
        /// Map before; without it, `file` is the depth.
        before: Option<String>,
        /// Time that the tool rested, s.
        dwell_s: f64,
        /// Half the side of the square that becomes the tool, mm.
        half_size_mm: f64,
    },
    /// The uploaded files of a tool that varies, of the kind `tool`, by their names.
    Varying(Vec<String>),
    /// A Gaussian.
    Formula {
        /// Rate at the centre, nm/s.
        peak_nm_per_s: f64,
        /// Full width at half maximum, mm.
        fwhm_mm: f64,
    },
}

/// Choice of the machine.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MachineChoice {
    /// A machine of the fixtures, by its name.
    Fixture(String),
    /// The machine file of the user, in the directory of the session; its text is in the request alone.
    Own,
}

/// Choice of the plan.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlanChoice {
    /// Pipeline, such as `raster`.
    pub pipeline: String,
    /// Settings, by their names; those that are absent have their defaults.
    #[serde(default)]
    pub settings: BTreeMap<String, String>,
}

/// Part, tool and machine of an estimate, in numbers.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EstimateInputs<'a> {
    /// Source of the tool.
    pub tool: &'a ToolSource,
    /// Full width at half maximum of the tool, mm.
    pub width_mm: f64,
    /// Area that the path covers, mm^2.
    pub area_mm2: f64,
    /// Least dwell time per length on the machine, s/mm.
    pub floor_s_per_mm: f64,
}

/// An estimate of a plan.
#[derive(Clone, Debug, PartialEq)]
pub struct Estimate {
    /// Command line.
    pub command: Words,
    /// Directory that it writes to, in that of the session.
    pub out: String,
    /// Factor by which its lines are further apart than those of the plan, at least 1.
    pub coarser: f64,
}

impl Reading {
    /// Returns the flags of the reading.
    ///
    /// # Errors
    /// Refuses a number that is not finite, and a text that is too long or has control characters.
    fn words(&self) -> Result<Words, Refusal> {
        let mut words = Words::new();
        let texts = [
            ("--unit", &self.unit),
            ("--coordinate-unit", &self.coordinate_unit),
            ("--dataset", &self.dataset),
            ("--first-row", &self.first_row),
        ];
        for (flag, text) in texts {
            if let Some(text) = text {
                check_text(flag, text)?;
                words.push(format!("{flag}={text}"));
            }
        }
        let numbers = [
            ("--wavelength-nm", self.wavelength_nm),
            ("--pixel-mm", self.pixel_mm),
            ("--surface-per-value", self.surface_per_value),
            ("--rotate-deg", self.rotate_deg.map(f64::from)),
        ];
        for (flag, number) in numbers {
            if let Some(number) = number {
                words.push(format!("{flag}={number}"));
            }
        }
        for (flag, is_set) in
            [("--flip-x", self.flip_x), ("--flip-y", self.flip_y), ("--negate", self.negate)]
        {
            if is_set {
                words.push(flag.into());
            }
        }
        Ok(words)
    }
}

impl PartSource {
    /// Returns the directory of the map of `role`, in that of the session: three arrays are one as they are.
    pub fn surface(&self, role: &str) -> String {
        match self {
            Self::Arrays => format!("files/{role}"),
            Self::Fixture(_) | Self::File(_) => format!("{role}/surface"),
        }
    }

    /// Returns the command that reads an uploaded map of the folder `role` into its directory
    /// ([`PartSource::surface`]); `None` for arrays.
    ///
    /// # Errors
    /// Refuses a name that cannot be that of a file, and a fixture, which is not uploaded.
    pub fn import(&self, role: &str, reading: &Reading) -> Result<Option<Words>, Refusal> {
        let name = match self {
            Self::Fixture(_) => return Err(Refusal::of_value("give a file; a fixture is none")),
            Self::Arrays => return Ok(None),
            Self::File(name) => name,
        };
        let mut command = words(&["planish", "import", "surface", &uploaded(role, name)?]);
        command.extend(reading.words()?);
        command.extend(words(&["--out", &self.surface(role), "--force"]));
        Ok(Some(command))
    }
}

impl PartChoice {
    /// Returns the commands that read the part, and prepare it as the plan will, in `part/prepared`.
    ///
    /// # Errors
    /// Refuses a name of a file or fixture that cannot be one, and an unknown level.
    pub fn commands(&self, folder: &str) -> Result<Vec<Words>, Refusal> {
        let mut commands = match &self.source {
            PartSource::Fixture(name) => vec![fixture(folder, name, "part")?],
            source => source.import("part", &self.reading)?.into_iter().collect(),
        };
        let mut prepare = words(&["planish", "surface", "prepare", "--surface"]);
        prepare.push(self.source.surface("part"));
        prepare.extend(self.preparation()?);
        prepare.extend(words(&["--out", "part/prepared", "--force"]));
        commands.push(prepare);
        Ok(commands)
    }

    /// Returns the flags of `planish surface prepare`, which are the setting `prepare` of a pipeline, too.
    ///
    /// # Errors
    /// Refuses an unknown level.
    pub fn preparation(&self) -> Result<Words, Refusal> {
        if !["none", "piston", "plane"].contains(&self.level.as_str()) {
            return Err(Refusal::of_value("the level is none, piston or plane"));
        }
        let mut flags = Words::new();
        if self.target.is_some() {
            flags.extend(words(&["--target", TARGET]));
        }
        match &self.aperture {
            None => {}
            Some(Aperture::Rectangle(mm)) => {
                flags.push("--aperture-rectangle-mm".into());
                flags.extend(mm.map(|mm| mm.to_string()));
            }
            Some(Aperture::Circle(mm)) => {
                flags.push("--aperture-circle-mm".into());
                flags.extend(mm.map(|mm| mm.to_string()));
            }
        }
        flags.extend(words(&["--level", &self.level]));
        if let Some(feature_mm) = self.feature_mm {
            flags.push("--mask-outliers".into());
            flags.push(format!("--feature-mm={feature_mm}"));
        }
        Ok(flags)
    }
}

impl ToolSource {
    /// Returns the directory of the tool, in that of the session.
    pub fn tif(&self) -> &'static str {
        if matches!(self, Self::Varying(_)) { VARYING_TOOL } else { "tool/tif" }
    }

    /// Returns the end of the name of a run or an estimate: a run belongs to the place of its tool.
    pub fn run_suffix(&self) -> &'static str {
        if matches!(self, Self::Varying(_)) { "-varying" } else { "" }
    }
}

impl ToolChoice {
    /// Returns the commands that make the tool in its directory ([`ToolSource::tif`]); none for a tool that varies,
    /// whose files are copied.
    ///
    /// # Errors
    /// Refuses a name of a file or fixture that cannot be one, an unknown formula, and a formula for a tool that is one.
    pub fn commands(&self, folder: &str) -> Result<Vec<Words>, Refusal> {
        let is_measured = matches!(
            self.source,
            ToolSource::Rates(_) | ToolSource::Arrays | ToolSource::Spot { .. }
        );
        if let Some(fit) = &self.fit
            && (!is_measured || !["gaussian", "super-gaussian", "mixture"].contains(&fit.as_str()))
        {
            return Err(Refusal::of_value(format!("there is no fit '{fit}' of this tool")));
        }
        let mut command = match &self.source {
            ToolSource::Fixture(name) => return Ok(vec![fixture(folder, name, "tool")?]),
            ToolSource::Formula { .. } => {
                return Ok(vec![words(&[
                    "planish",
                    "fixture",
                    TOOL_RECIPE,
                    "--out",
                    "tool",
                    "--force",
                ])]);
            }
            ToolSource::Varying(names) => {
                if names.is_empty() {
                    return Err(Refusal::of_value("give the files of the tool"));
                }
                names.iter().try_for_each(|name| check_file_name(name))?;
                return Ok(vec![]);
            }
            ToolSource::Arrays => words(&["planish", "tool", "prepare", "--tif", "files/tool"]),
            ToolSource::Rates(name) => {
                words(&["planish", "tool", "from-maps", &uploaded("tool", name)?, "--rate"])
            }
            ToolSource::Spot { file, before, dwell_s, half_size_mm } => {
                let mut command =
                    words(&["planish", "tool", "from-maps", &uploaded("tool", file)?]);
                command.push(format!("--dwell-s={dwell_s}"));
                command.push(format!("--half-size-mm={half_size_mm}"));
                if let Some(before) = before {
                    command.extend(words(&["--before", &uploaded("before", before)?]));
                }
                command
            }
        };
        if !matches!(self.source, ToolSource::Arrays) {
            command.extend(self.reading.words()?);
        }
        let Some(fit) = &self.fit else {
            command.extend(words(&["--out", "tool/tif", "--force"]));
            return Ok(vec![command]);
        };
        command.extend(words(&["--out", "tool/measured", "--force"]));
        let mut fitted = words(&["planish", "tool", "prepare", "--tif", "tool/measured"]);
        fitted.push(format!("--fit-formula={fit}"));
        fitted.extend(words(&["--use-fit", "--out", "tool/tif", "--force"]));
        Ok(vec![command, fitted])
    }

    /// Returns the recipe of a tool that is given by a formula, as JSON; `None` for another tool. The recipe has a small
    /// map, too, because every recipe has one.
    ///
    /// # Errors
    /// Refuses a peak or a width that is not above 0.
    pub fn recipe(&self) -> Result<Option<String>, Refusal> {
        let ToolSource::Formula { peak_nm_per_s, fwhm_mm } = self.source else { return Ok(None) };
        if !(peak_nm_per_s.is_finite()
            && peak_nm_per_s > 0.0
            && fwhm_mm.is_finite()
            && fwhm_mm > 0.0)
        {
            return Err(Refusal::of_value(
                "the peak and the width of the tool are numbers above 0",
            ));
        }
        // FWHM = 2 sqrt(2 ln 2) sigma. At 3.5 sigma the rate is 0.2 % of the peak, as in the fixtures.
        let sigma_mm = fwhm_mm / (8.0 * f64::ln(2.0)).sqrt();
        let recipe = serde_json::json!({
            "name": "formula", "doc": "A tool by a formula.", "seed": 0, "pixels": [21, 21], "width_mm": fwhm_mm,
            "aperture": "rectangle", "legendre": [{ "order": [2, 0], "amplitude_nm": 1.0 }],
            "tif": {
                "peak_nm_per_s": peak_nm_per_s, "half_size_mm": 3.5 * sigma_mm,
                "shape": { "gaussian": { "sigma_mm": sigma_mm } }
            }
        });
        Ok(Some(recipe.to_string()))
    }
}

impl MachineChoice {
    /// Returns the path of the machine file.
    ///
    /// # Errors
    /// Refuses a name that cannot be that of a machine.
    pub fn path(&self, folder: &str) -> Result<String, Refusal> {
        match self {
            Self::Own => Ok(OWN_MACHINE.into()),
            Self::Fixture(name) if is_word(name) => {
                Ok(format!("{folder}fixtures/machines/{name}.json"))
            }
            Self::Fixture(_) => Err(Refusal::of_value("there is no machine of this name")),
        }
    }
}

impl PlanChoice {
    /// Returns the command of the run, and the directory that it writes to. `description` is that of the pipeline.
    ///
    /// # Errors
    /// Refuses a setting that the pipeline does not have or that names a file, a value that it cannot have, and a
    /// program of an own part for a machine of the fixtures.
    pub fn command(
        &self,
        part: &PartChoice,
        tool: &ToolChoice,
        machine: &MachineChoice,
        description: &PipelineDescription,
    ) -> Result<(Words, String), Refusal> {
        let mut command = words(&["planish", "run", &self.pipeline]);
        let is_own = !matches!(
            (&part.source, &tool.source),
            (PartSource::Fixture(a), ToolSource::Fixture(b)) if a == b
        );
        let mirror = match &part.source {
            PartSource::Fixture(name) if !is_own => {
                command.push(format!("fixture={name}"));
                name.as_str()
            }
            _ => {
                command.push(format!("surface={}", part.source.surface("part")));
                command.push(format!("tif={}", tool.source.tif()));
                // A run belongs to its map: those of arrays and of files are in two places.
                if part.source == PartSource::Arrays { "arrays" } else { "own" }
            }
        };
        if is_own && matches!(machine, MachineChoice::Fixture(_)) && self.controller().is_some() {
            return Err(Refusal::of_value(
                "a program moves the machine that will run it, and the machine of this session is one of the fixtures; \
                 give the file of your machine, or edit that of a fixture and keep it as yours",
            ));
        }
        command.push(format!("machine={}", machine.path(&description.folder)?));
        command.push(format!("prepare={}", part.preparation()?.join(" ")));
        command.extend(self.setting_words(description, &[])?);
        if let PartSource::File(name) = &part.source
            && self.settings.get(PART_NAME).is_none_or(String::is_empty)
        {
            command.push(format!("{PART_NAME}={name}"));
        }
        let out = format!("runs/{}-{mirror}{}", self.pipeline, tool.source.run_suffix());
        command.push(format!("out={out}"));
        Ok((command, out))
    }

    /// Returns the estimate of this plan. It is made of [`BINNED_MAP`].
    ///
    /// # Errors
    /// Refuses the settings that [`PlanChoice::command`] refuses, and a part of too many points.
    pub fn estimate(
        &self,
        machine: &MachineChoice,
        description: &PipelineDescription,
        of: &EstimateInputs,
    ) -> Result<Estimate, Refusal> {
        let pitch_mm = self.number("pitch_mm", description);
        let coarse_mm = of_width(PITCH_PER_WIDTH, of.width_mm);
        let coarser = pitch_mm.map_or(1.0, |pitch_mm| (coarse_mm / pitch_mm).max(1.0));
        let lines_mm = of.area_mm2 / (coarser * pitch_mm.unwrap_or(coarse_mm));
        let [fine_mm, step_mm] = STEPS_PER_WIDTH.map(|step| of_width(step, of.width_mm));
        if lines_mm / step_mm > MOST_POINTS {
            return Err(Refusal::of_value(format!(
                "an estimate would have more than {MOST_POINTS} dwell points, because the part is large beside the tool \
                 ({:.2} mm wide); press Plan",
                of.width_mm
            )));
        }
        let step_mm = if lines_mm / fine_mm > FEW_POINTS { step_mm } else { fine_mm };
        let mut command = words(&["planish", "stage", &self.pipeline, "estimate"]);
        command.push(format!("surface={BINNED_MAP}"));
        command.push(format!("tif={}", of.tool.tif()));
        command.push(format!("machine={}", machine.path(&description.folder)?));
        command.push("prepare=--level none".into());
        command.push(format!("{STEP}={step_mm}"));
        let mut left_out = [&NOT_ESTIMATED[..], &STATED].concat();
        if coarser > 1.0 || self.number("min_dwell_s", description).is_some() {
            left_out.extend(["min_dwell_s", "min_dwell_s_per_mm"]);
            // As much time per area as along the lines of the plan.
            let floor_s_per_mm = coarser * self.floor_s_per_mm(description, of.floor_s_per_mm);
            command.push(format!("min_dwell_s_per_mm={}", (1e6 * floor_s_per_mm).round() / 1e6));
        }
        if coarser > 1.0 {
            left_out.push("pitch_mm");
            command.push(format!("pitch_mm={coarse_mm}"));
        }
        command.extend(self.setting_words(description, &left_out)?);
        let out = format!("estimates/{}{}", self.pipeline, of.tool.run_suffix());
        command.push(format!("out={out}"));
        Ok(Estimate { command, out, coarser })
    }

    /// Returns the least dwell time per length, s/mm; `of_machine` if no setting states one.
    fn floor_s_per_mm(&self, description: &PipelineDescription, of_machine: f64) -> f64 {
        let [per_mm, per_point, step_mm, pitch_mm] =
            ["min_dwell_s_per_mm", "min_dwell_s", STEP, "pitch_mm"]
                .map(|name| self.number(name, description));
        let given_step = self.settings.get(STEP).is_some_and(|step| !step.is_empty());
        // The default of the step is a number of its own along straight lines, else the pitch.
        let is_step = given_step || ["raster", "multi-pitch"].contains(&self.pipeline.as_str());
        let step_mm = if is_step { step_mm } else { pitch_mm };
        let of_points = per_point.zip(step_mm).map(|(time_s, step_mm)| time_s / step_mm);
        per_mm.or(of_points).unwrap_or(of_machine)
    }

    /// Returns the number of a setting, or of its default; `None` without either.
    fn number(&self, name: &str, description: &PipelineDescription) -> Option<f64> {
        let default = description.settings.iter().find(|s| s.name == name).map(|s| &s.default);
        let given = self.settings.get(name).filter(|value| !value.is_empty());
        given.or(default)?.parse().ok()
    }

    /// Returns the settings as words of a command, without those that are empty or in `left_out`.
    ///
    /// # Errors
    /// Refuses a setting that the pipeline does not have or that names a file, and a value that it cannot have.
    pub fn setting_words(
        &self,
        description: &PipelineDescription,
        left_out: &[&str],
    ) -> Result<Words, Refusal> {
        let definition = Definition::built_in(&self.pipeline)
            .filter(|_| description.pipeline == self.pipeline)
            .ok_or_else(|| {
                Refusal::of_value(format!("there is no pipeline '{}'", self.pipeline))
            })?;
        let mut all = Words::new();
        for (name, value) in &self.settings {
            let is_stated = STATED.contains(&name.as_str());
            let mut settings = definition.settings.iter().filter(|s| s.name == *name);
            let setting = settings.find(|s| s.kind.is_plain() || is_stated);
            let setting = setting.ok_or_else(|| {
                Refusal::of_value(format!("'{name}' is no setting that this page gives"))
            })?;
            if is_stated {
                check_text(name, value)?;
            }
            if !value.is_empty() {
                setting.kind.check(value).map_err(|wanted| {
                    Refusal::of_value(format!("{name} is '{value}'; give {wanted}"))
                })?;
                if !left_out.contains(&name.as_str()) {
                    all.push(format!("{name}={value}"));
                }
            }
        }
        Ok(all)
    }

    /// Returns the controller of the program; `None` without one.
    pub fn controller(&self) -> Option<&str> {
        self.settings.get(EXPORT).map(String::as_str).filter(|name| !name.is_empty())
    }
}

/// Returns the command that makes the mirror and the tool of a fixture in `out`.
fn fixture(folder: &str, name: &str, out: &str) -> Result<Words, Refusal> {
    if !is_word(name) {
        return Err(Refusal::of_value("there is no fixture of this name"));
    }
    let recipe = format!("{folder}fixtures/{name}.json");
    Ok(words(&["planish", "fixture", &recipe, "--out", out, "--force"]))
}

/// Refuses a text of the user that is too long or has control characters. `name` is that of its flag or setting.
fn check_text(name: &str, text: &str) -> Result<(), Refusal> {
    if text.len() > MOST_TEXT_BYTES || text.contains(char::is_control) {
        return Err(Refusal::of_value(format!("{name} is too long or has control characters")));
    }
    Ok(())
}

/// Returns a fraction of a width, mm, with the three digits that make a command readable.
fn of_width(fraction: f64, width_mm: f64) -> f64 {
    (1e3 * fraction * width_mm).round().max(1.0) / 1e3
}

/// Returns the path of an uploaded file in the directory of the session.
fn uploaded(folder: &str, name: &str) -> Result<String, Refusal> {
    check_file_name(name)?;
    Ok(format!("files/{folder}/{name}"))
}

fn words(list: &[&str]) -> Words {
    list.iter().map(|word| word.to_string()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn description(pipeline: &str) -> PipelineDescription {
        PipelineDescription {
            pipeline: pipeline.into(),
            title: String::new(),
            folder: "/share/".into(),
            fixtures: vec![],
            machines: vec![],
            settings: vec![],
        }
    }

    fn part(source: PartSource) -> PartChoice {
        PartChoice {
            source,
            reading: Reading::default(),
            aperture: None,
            target: None,
            level: "plane".into(),
            feature_mm: None,
        }
    }

    fn plan(settings: &[(&str, &str)]) -> PlanChoice {
        let settings = settings.iter().map(|(a, b)| (a.to_string(), b.to_string())).collect();
        PlanChoice { pipeline: "raster".into(), settings }
    }

    #[test]
    fn a_choice_is_a_command_line() {
        let reading = Reading {
            unit: Some("um".into()),
            pixel_mm: Some(0.25),
            rotate_deg: Some(90),
            flip_x: true,
            ..Reading::default()
        };
        let choice = PartChoice { reading, ..part(PartSource::File("m.datx".into())) };
        let [read, prepare] = choice.commands("/share/").unwrap().try_into().unwrap();
        assert_eq!(
            read.join(" "),
            "planish import surface files/part/m.datx --unit=um --pixel-mm=0.25 --rotate-deg=90 --flip-x --out \
             part/surface --force"
        );
        assert!(prepare.join(" ").contains("--level plane --out part/prepared"));
        let tool = ToolChoice {
            source: ToolSource::Fixture("coupon".into()),
            reading: Reading::default(),
            fit: None,
        };
        let machine = MachineChoice::Fixture("ion-beam".into());
        let raster = description("raster");
        let (own, out) =
            plan(&[("pitch_mm", "2")]).command(&choice, &tool, &machine, &raster).unwrap();
        assert_eq!(
            own.join(" "),
            "planish run raster surface=part/surface tif=tool/tif machine=/share/fixtures/machines/ion-beam.json \
             prepare=--level plane pitch_mm=2 part_name=m.datx out=runs/raster-own"
        );
        assert_eq!(out, "runs/raster-own");
        let named = plan(&[("part_name", "M 1"), ("operator", "me")]);
        let (named, _) = named.command(&choice, &tool, &machine, &raster).unwrap();
        assert_eq!(named[7..9], ["operator=me", "part_name=M 1"]);
        let coupon = part(PartSource::Fixture("coupon".into()));
        let (command, _) = plan(&[]).command(&coupon, &tool, &machine, &raster).unwrap();
        assert_eq!(command[3], "fixture=coupon");
        let choice = plan(&[("pitch_mm", "2"), ("export", "galil"), ("time_elasticity", "0.25")]);
        let of = EstimateInputs {
            tool: &tool.source,
            width_mm: 2.0,
            area_mm2: 100.0,
            floor_s_per_mm: 0.004,
        };
        assert_eq!(
            choice.estimate(&machine, &raster, &of).unwrap().command.join(" "),
            "planish stage raster estimate surface=estimates/map tif=tool/tif \
             machine=/share/fixtures/machines/ion-beam.json prepare=--level none step_mm=0.6 pitch_mm=2 time_elasticity=0.25 \
             out=estimates/raster"
        );
        // Lines three times as far apart have three times the floor of the machine.
        let fine = plan(&[("pitch_mm", "0.2")]).estimate(&machine, &raster, &of).unwrap();
        assert!((fine.coarser - 3.0).abs() < 1e-12, "{fine:?}");
        assert!(fine.command.join(" ").contains("min_dwell_s_per_mm=0.012 pitch_mm=0.6 out="));
        let large = EstimateInputs { area_mm2: 1e5, ..of };
        assert!(plan(&[("pitch_mm", "1")]).estimate(&machine, &raster, &large).is_err());
        let cropped = PartChoice {
            aperture: Some(Aperture::Circle([1.0, -2.5, 40.0])),
            target: Some("{}".into()),
            ..part(PartSource::Arrays)
        };
        assert_eq!(
            cropped.preparation().unwrap().join(" "),
            "--target target.json --aperture-circle-mm 1 -2.5 40 --level plane"
        );
        let fitted =
            ToolChoice { fit: Some("gaussian".into()), source: ToolSource::Arrays, ..tool.clone() };
        assert!(fitted.commands("").unwrap()[1].contains(&"--fit-formula=gaussian".into()));
        assert!(ToolChoice { fit: Some("gaussian".into()), ..tool.clone() }.commands("").is_err());
        let varying = ToolSource::Varying(vec!["weight.npy".into()]);
        let varying = ToolChoice { source: varying, ..tool.clone() };
        assert!(varying.commands("").unwrap().is_empty());
        let arrays = part(PartSource::Arrays);
        let (command, out) = plan(&[]).command(&arrays, &varying, &machine, &raster).unwrap();
        assert_eq!([&command[4], &out], ["tif=tool/varying", "runs/raster-arrays-varying"]);
    }

    #[test]
    fn a_choice_names_no_path_and_no_wrong_value() {
        for name in ["../x", "/etc/passwd", "a/b", "-x", ""] {
            assert!(part(PartSource::File(name.into())).commands("").is_err(), "{name}");
            assert!(part(PartSource::Fixture(name.into())).commands("").is_err(), "{name}");
            for tool in [ToolSource::Rates(name.into()), ToolSource::Varying(vec![name.into()])] {
                let tool = ToolChoice { source: tool, reading: Reading::default(), fit: None };
                assert!(tool.commands("").is_err());
            }
            assert!(MachineChoice::Fixture(name.into()).path("").is_err(), "{name}");
        }
        let coupon = part(PartSource::Fixture("coupon".into()));
        let tool = ToolChoice {
            source: ToolSource::Fixture("coupon".into()),
            reading: Reading::default(),
            fit: None,
        };
        let own = MachineChoice::Own;
        for setting in [
            ("pitch_mm", "0"),
            ("pitch_mm", "1 mm"),
            ("out", "/tmp/x"),
            ("form", "/etc/passwd"),
            ("variant", "--out x"),
            ("nothing", "1"),
            ("export", "abacus"),
            ("operator", "a\nb"),
            ("fixture", "../x"),
        ] {
            let command = plan(&[setting]).command(&coupon, &tool, &own, &description("raster"));
            assert!(command.is_err(), "{setting:?}");
        }
        // The machine of a fixture does not run an own part.
        let file = part(PartSource::File("m.datx".into()));
        let ion_beam = MachineChoice::Fixture("ion-beam".into());
        let galil = plan(&[("export", "galil")]);
        let raster = description("raster");
        assert!(galil.command(&file, &tool, &ion_beam, &raster).is_err());
        assert!(galil.command(&file, &tool, &own, &raster).is_ok());
        assert!(galil.command(&coupon, &tool, &ion_beam, &raster).is_ok());
    }
}
