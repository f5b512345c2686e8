//! `planish tool from-maps`.

use std::path::PathBuf;

use clap::Args;
use planish_handoff::{Artifact, Begin, Failure, Inputs, Status, as_command, pair, say, warn};
use planish_import::{
    Origin, Reading, ReadingSettings, Scale, Statement,
    cli::{FileArgs, about, draw, in_flags, map_bytes, open, report},
    surface, tif,
};
use planish_tool::{Alignment, Baseline, Spot, SpotSettings, spot};
use planish_types::{Tif, doubts};
use serde_json::json;

use super::Name;

#[derive(Debug, Args)]
pub struct FromMapsArgs {
    #[command(flatten)]
    file: FileArgs,
    /// The values are rates already, on the offsets from the tool centre: per second, unless the file or --unit states
    /// another time
    #[arg(long, required_unless_present = "dwell_s", conflicts_with_all = ["dwell_s", "before"])]
    rate: bool,
    /// Place of the coordinate 0, the centre of the tool, in a map of rates [default: the file's coordinates, else
    /// the middle]
    #[arg(long, value_enum, requires = "rate")]
    origin: Option<Origin>,
    /// Time that the tool rested, s; FILE is the depth of the removal, or the map after it
    #[arg(long, value_name = "T", requires = "half_size_mm", allow_negative_numbers = true)]
    dwell_s: Option<f64>,
    /// Map measured before the tool acted, read with the same flags; FILE is the map after
    #[arg(long, value_name = "FILE")]
    before: Option<PathBuf>,
    /// Half the side of the square that becomes the TIF, mm
    #[arg(long, value_name = "H", requires = "dwell_s", allow_negative_numbers = true)]
    half_size_mm: Option<f64>,
    /// Place of the spot, mm [default: the place of the deepest removal]
    #[arg(long, value_name = "X,Y", value_parser = pair, requires = "dwell_s", allow_hyphen_values = true)]
    spot_mm: Option<[f64; 2]>,
    /// Treatment of a part that moved between the maps
    #[arg(long, value_enum, default_value = "none", requires = "dwell_s")]
    align: Alignment,
    /// Function that is subtracted from the removal, fitted outside the square
    #[arg(long, value_enum, default_value = "plane", requires = "dwell_s")]
    baseline: Baseline,
    /// Set negative rates (noise) to zero and scale the others, so that the volume stays
    #[arg(long, requires = "dwell_s")]
    clip_negative: bool,
}

/// Prints the centre of a spot, the shift between its maps and the noise outside it.
fn say_spot(program: &str, spot: &Spot) {
    let program = as_command(program);
    say(format!(
        "{program}: spot at {} mm, shift {} mm (standard error {} mm), noise {:.4} nm RMS outside it",
        json!(spot.centre_mm),
        json!(spot.shift_mm),
        json!(spot.shift_error_mm),
        spot.outside_rms_nm
    ));
}

impl FromMapsArgs {
    pub fn run(&self, name: Name) -> Result<Status, Failure> {
        let file = &self.file;
        let mut inputs = Inputs::new();
        // Maps of a spot are surfaces.
        let pick = file.pick(self.rate);
        let bytes = map_bytes(&mut inputs, "file", &file.file)?;
        let format = file.format(bytes.as_deref())?;
        let origin = self.origin.unwrap_or(Origin::File);
        let mut settings = file.settings(origin);
        let spot_settings = match (self.dwell_s, self.half_size_mm) {
            (Some(dwell_s), Some(half_size_mm)) => Some(SpotSettings {
                dwell_s,
                half_size_mm,
                spot_mm: self.spot_mm,
                align: self.align,
                baseline: self.baseline,
                clip_negative: self.clip_negative,
            }),
            _ => None,
        };
        let resolved = json!({
            "format": format,
            "pick": pick,
            "reading": settings,
            "origin_given": self.origin.is_some(),
            "spot": spot_settings,
        });
        let task = name.task(resolved);
        let reading = open(&mut inputs, "file", &file.file, format, bytes, &pick)?;
        let before = match &self.before {
            Some(path) => {
                let bytes = map_bytes(&mut inputs, "before", path)?;
                Some(open(&mut inputs, "before", path, format, bytes, &pick)?)
            }
            None => None,
        };
        let mut output = match file.output(Tif::KIND).begin(&task, &inputs)? {
            Begin::Unchanged(status) => return Ok(status),
            Begin::Run(output) => output,
        };
        let (made, statement, own) = match &spot_settings {
            Some(spot_settings) => self.of_spot(reading, before, &settings, spot_settings)?,
            None => {
                settings.origin =
                    self.origin.unwrap_or_else(|| reading.usual_tif_origin(&settings));
                let (made, statement) =
                    tif(reading, &settings).map_err(|e| about(&file.file, &e))?;
                (made, statement, None)
            }
        };
        let statement = in_flags(statement);
        let picture =
            || draw(made.grid(), made.rate_nm_per_s(), Scale::RateNmPerS, &file.file, &statement);
        file.put_picture(&mut output, picture)?;
        let doubts: Vec<String> = doubts::of_tif(&made).into_iter().collect();
        let outcome = json!({
            "reading": statement,
            "doubts": doubts,
            "spot": own,
            "peak_nm_per_s": made.peak_nm_per_s(),
            "vrr_nm_mm2_per_s": made.vrr_nm_mm2_per_s(),
        });
        output.write(&made, outcome, &Status::Done)?;
        report(name.program, &statement, made.grid());
        if let Some(spot) = &own {
            say_spot(name.program, spot);
        }
        say(format!(
            "{}: peak {:.4} nm/s, {:.4} nm mm^2/s -> {}",
            as_command(name.program),
            made.peak_nm_per_s(),
            made.vrr_nm_mm2_per_s(),
            file.output.out.display()
        ));
        doubts.iter().for_each(warn);
        Ok(Status::Done)
    }

    /// Makes the TIF from the maps of a spot. Returns it with the record of how the maps were read and the numbers of
    /// the spot.
    fn of_spot(
        &self,
        after: Reading,
        before: Option<Reading>,
        settings: &ReadingSettings,
        spot_settings: &SpotSettings,
    ) -> Result<(Tif, Statement, Option<Spot>), Failure> {
        let (after, mut statement) =
            surface(after, settings).map_err(|e| about(&self.file.file, &e))?;
        let before = match (before, &self.before) {
            (Some(reading), Some(path)) => {
                let (map, of_before) = surface(reading, settings).map_err(|e| about(path, &e))?;
                let named = |w: String| format!("{}: {w}", path.display());
                statement.warnings.extend(of_before.warnings.into_iter().map(named));
                Some(map)
            }
            _ => None,
        };
        let made = spot(before.as_ref(), &after, spot_settings).map_err(Failure::with_flags)?;
        Ok((made.tif.clone(), statement, Some(made)))
    }
}
