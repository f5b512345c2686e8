//! `planish surface draw`.

use std::path::{Path, PathBuf};

use clap::Args;
use planish_handoff::{Failure, Inputs, Status, flags::OutputFileArgs, say};
use planish_surface::draw::{MapsSettings, Panel, maps_svg};
use planish_types::{Surface, Tif};

#[derive(Debug, Args)]
pub struct DrawArgs {
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

impl DrawArgs {
    pub fn run(&self) -> Result<Status, Failure> {
        let mut inputs = Inputs::new();
        let mut panels = Vec::new();
        for dir in &self.surface {
            panels.push(panel(dir, &inputs.read("surface", dir)?));
        }
        for dir in &self.tif {
            let tif: Tif = inputs.read("tif", dir)?;
            panels.push(Panel {
                title: title(dir),
                grid: *tif.grid(),
                map: tif.rate_nm_per_s().clone(),
            });
        }
        let outline =
            self.outline.as_ref().map(|dir| inputs.read("outline", dir).map(|s| panel(dir, &s)));
        let settings = MapsSettings {
            unit: if self.tif.is_empty() { "nm" } else { "nm/s" },
            section_y_mm: self.section_y_mm,
            common_scale: self.common_scale,
            outline: outline.transpose()?,
        };
        let output = self.output.begin(&inputs)?;
        output.write(maps_svg(&panels, &settings)?.as_bytes())?;
        let out = self.output.out.display();
        say(format!("planish surface: {} map(s) drawn to {out}", panels.len()));
        Ok(Status::Done)
    }
}

fn panel(dir: &Path, surface: &Surface) -> Panel {
    Panel { title: title(dir), grid: *surface.grid(), map: surface.height_nm().clone() }
}

/// Returns the name of the directory, as the title of its map.
fn title(dir: &Path) -> String {
    dir.file_name().map_or(String::new(), |n| n.to_string_lossy().into_owned())
}
