//! `planish import slopes`.

use std::path::PathBuf;

use clap::Args;
use planish_handoff::{Artifact, Begin, Failure, Inputs, Status, pair, say, task, warn};
use planish_import::{
    Format, Origin, Pick, Scale,
    slopes::{SlopeSettings, SlopeUnit, slopes},
};
use planish_types::{Surface, text::significant};
use serde_json::json;

use super::{FileArgs, about, draw, in_flags, map_bytes, open};

#[derive(Debug, Args)]
pub struct SlopesArgs {
    #[command(flatten)]
    file: FileArgs,
    /// Array of the slopes along x in FILE, named as for --dataset [default: slope_x in a file of several arrays]
    #[arg(long, value_name = "NAME", conflicts_with = "dataset")]
    slope_x: Option<String>,
    /// Array of the slopes along y, in FILE or in --file-y [default: slope_y in a file of several arrays]
    #[arg(long, value_name = "NAME")]
    slope_y: Option<String>,
    /// File of the slopes along y, if FILE holds only those along x
    #[arg(long, value_name = "FILE")]
    file_y: Option<PathBuf>,
    /// Unit of the slopes, where the file does not state it: urad, mrad, rad, deg, arcsec, nm/mm
    #[arg(long, value_name = "UNIT")]
    slope_unit: Option<SlopeUnit>,
    /// The file counts slopes along x towards smaller x
    #[arg(long)]
    negate_x: bool,
    /// The file counts slopes along y towards smaller y, such as down the rows of a picture
    #[arg(long)]
    negate_y: bool,
    /// Integrate slopes along y although their other sign fits those along x better
    #[arg(long)]
    trust_signs: bool,
    /// Place of the coordinate 0
    #[arg(long, value_enum, default_value = "file")]
    origin: Origin,
    /// Coordinates of the pixel with the smallest x and y in the map that is written, mm, where the file does not state the
    /// place of the map
    #[arg(long, value_name = "X,Y", value_parser = pair, allow_hyphen_values = true)]
    place_mm: Option<[f64; 2]>,
}

impl SlopesArgs {
    pub fn run(&self) -> Result<Status, Failure> {
        let file = &self.file;
        if file.unit.is_some() {
            return Err(Failure::new(
                "--unit: is that of heights; give --slope-unit urad, mrad, rad, deg, arcsec or nm/mm",
            ));
        }
        let mut inputs = Inputs::new();
        let mut map = file.settings(self.origin);
        map.place_mm = self.place_mm;
        let settings = SlopeSettings {
            unit: self.slope_unit.clone(),
            negate_x: self.negate_x,
            negate_y: self.negate_y,
            trust_signs: self.trust_signs,
            map,
        };
        let bytes = map_bytes(&mut inputs, "file", &file.file)?;
        let format = file.format(bytes.as_deref())?;
        let bytes_y = match &self.file_y {
            Some(path) => map_bytes(&mut inputs, "file_y", path)?,
            None => bytes.clone(),
        };
        let has_names = matches!(
            format,
            Format::Mat5 | Format::Hdf5 | Format::Npz | Format::Fits | Format::Gwy
        );
        if !has_names && self.file_y.is_none() {
            let problem = "holds one map; give the slopes along y with --file-y";
            return Err(Failure::new(format!("{}: {problem}", file.file.display())));
        }
        let dataset = |name: &Option<String>, usual: &str| match name {
            Some(name) => Some(name.clone()),
            None if has_names && self.file_y.is_none() => Some(usual.to_string()),
            None => None,
        };
        let pick_x = Pick { dataset: dataset(&self.slope_x, "slope_x"), ..file.pick(false) };
        let pick_y = Pick { dataset: dataset(&self.slope_y, "slope_y"), ..file.pick(false) };
        let task = task!(
            "slopes",
            json!({ "format": format, "pick_x": pick_x, "pick_y": pick_y, "reading": settings })
        );
        let path_y = self.file_y.as_ref().unwrap_or(&file.file);
        let along_x = open(&mut inputs, "file", &file.file, format, bytes, &pick_x)?;
        let along_y = open(&mut inputs, "file_y", path_y, format, bytes_y, &pick_y)?;
        let mut output = match file.output(Surface::KIND).begin(&task, &inputs)? {
            Begin::Unchanged(status) => return Ok(status),
            Begin::Run(output) => output,
        };
        let (map, report) =
            slopes(along_x, along_y, &settings).map_err(|e| about(&file.file, &e))?;
        let statement = in_flags(report.x.clone());
        let picture = || draw(map.grid(), map.height_nm(), Scale::HeightNm, &file.file, &statement);
        file.put_picture(&mut output, picture)?;
        let statistics = map.statistics();
        let outcome = json!({
            "slopes": report,
            "pv_nm": statistics.pv,
            "rms_nm": statistics.rms,
        });
        output.write(&map, outcome, &Status::Done)?;
        for warning in &report.warnings {
            warn(planish_handoff::with_flags(warning));
        }
        let (ny, nx) = map.grid().shape();
        let [x, y] = report.slope_rms_urad.map(|v| significant(v, 4));
        say(format!(
            "planish import: slopes of {x} urad RMS along x and {y} urad along y, of which {} urad belong to no surface",
            significant(report.residual_urad, 3)
        ));
        say(format!(
            "planish import: {nx} x {ny} pixels of {} x {} mm, {:.4} nm RMS, {:.4} nm PV -> {}",
            significant(map.grid().x.step_mm(), 10),
            significant(map.grid().y.step_mm(), 10),
            statistics.rms,
            statistics.pv,
            file.output.out.display()
        ));
        Ok(Status::Done)
    }
}
