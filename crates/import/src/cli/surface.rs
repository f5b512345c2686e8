//! `planish import surface`.

use clap::Args;
use planish_handoff::{Artifact, Begin, Failure, Inputs, Status, pair, say, task};
use planish_import::{Origin, Scale, surface};
use planish_types::Surface;
use serde_json::json;

use super::{FileArgs, about, draw, in_flags, map_bytes, open, report};

#[derive(Debug, Args)]
pub struct SurfaceArgs {
    #[command(flatten)]
    file: FileArgs,
    /// Place of the coordinate 0
    #[arg(long, value_enum, default_value = "file")]
    origin: Origin,
    /// Coordinates of the pixel with the smallest x and y in the map that is written, mm, where the file does not state the
    /// place of the map
    #[arg(long, value_name = "X,Y", value_parser = pair, allow_hyphen_values = true)]
    place_mm: Option<[f64; 2]>,
}

impl SurfaceArgs {
    pub fn run(&self) -> Result<Status, Failure> {
        let file = &self.file;
        let mut inputs = Inputs::new();
        let pick = file.pick(false);
        let mut settings = file.settings(self.origin);
        settings.place_mm = self.place_mm;
        let bytes = map_bytes(&mut inputs, "file", &file.file)?;
        let format = file.format(bytes.as_deref())?;
        let task = task!("surface", json!({ "format": format, "pick": pick, "reading": settings }));
        let reading = open(&mut inputs, "file", &file.file, format, bytes, &pick)?;
        let mut output = match file.output(Surface::KIND).begin(&task, &inputs)? {
            Begin::Unchanged(status) => return Ok(status),
            Begin::Run(output) => output,
        };
        let (map, statement) = surface(reading, &settings).map_err(|e| about(&file.file, &e))?;
        let statement = in_flags(statement);
        let picture = || draw(map.grid(), map.height_nm(), Scale::HeightNm, &file.file, &statement);
        file.put_picture(&mut output, picture)?;
        let statistics = map.statistics();
        let outcome = json!({
            "reading": statement,
            "pv_nm": statistics.pv,
            "rms_nm": statistics.rms,
        });
        output.write(&map, outcome, &Status::Done)?;
        report("planish-import", &statement, map.grid());
        say(format!(
            "planish import: {:.4} nm RMS, {:.4} nm PV, height {:.4} .. {:.4} nm -> {}",
            statistics.rms,
            statistics.pv,
            map.height_nm().iter().copied().fold(f64::INFINITY, f64::min),
            map.height_nm().iter().copied().fold(f64::NEG_INFINITY, f64::max),
            file.output.out.display()
        ));
        Ok(Status::Done)
    }
}
