//! `planish register mean`.

use std::path::PathBuf;

use clap::Args;
use planish_handoff::{
    Artifact, Begin, Failure, Inputs, Output, Status, flags::OutputArgs, say, task,
};
use planish_register::{
    maps::MapSettings,
    series::{SeriesSettings, mean},
};
use planish_types::{Surface, text::significant};
use serde_json::json;

use super::{about_map, read_maps, with_error};

#[derive(Debug, Args)]
pub struct MeanArgs {
    /// Repeated measurements of one part; the first one gives the pixels [surface artifacts]
    #[arg(required = true, value_name = "DIR")]
    maps: Vec<PathBuf>,
    /// The part lay still between the measurements: do not register the maps on the first one
    #[arg(long, conflicts_with_all = ["most_shift_mm", "most_rotation_deg", "shorter_than_mm"])]
    still: bool,
    /// Largest shift along an axis, mm
    #[arg(long, value_name = "S", default_value_t = 1.0, allow_negative_numbers = true)]
    most_shift_mm: f64,
    /// Largest rotation, degree
    #[arg(long, value_name = "A", default_value_t = 1.0, allow_negative_numbers = true)]
    most_rotation_deg: f64,
    /// Highest order of the Legendre terms that are free (0 piston, 1 plane, 2 power and astigmatism): two measurements
    /// may differ by them
    #[arg(long, value_name = "N", default_value_t = 1)]
    free_order: usize,
    /// Wavelength above which features are filtered out of both maps, mm, for their registration [default: keep all]
    #[arg(long, value_name = "L", allow_negative_numbers = true)]
    shorter_than_mm: Option<f64>,
    #[command(flatten)]
    output: OutputArgs,
}

impl MeanArgs {
    pub fn run(&self) -> Result<Status, Failure> {
        let registration = MapSettings {
            most_shift_mm: self.most_shift_mm,
            most_rotation_deg: self.most_rotation_deg,
            free_order: self.free_order,
            shorter_than_mm: self.shorter_than_mm,
        };
        let settings = SeriesSettings {
            registration: if self.still { None } else { Some(registration) },
            free_order: self.free_order,
        };
        let mut inputs = Inputs::new();
        let maps = read_maps(&mut inputs, &self.maps)?;
        let output = Output::directory(&self.output, Surface::KIND);
        let mut output = match output.begin(&task!("mean", settings), &inputs)? {
            Begin::Unchanged(status) => return Ok(status),
            Begin::Run(output) => output,
        };
        let series = mean(&maps, &settings).map_err(|e| {
            let hint =
                if self.still || e.index == 0 { "" } else { ", or --still if the part lay still" };
            about_map(&self.maps, &e, hint)
        })?;
        let report = &series.report;
        output.write(&series.mean, json!({ "series": report }), &Status::Done)?;
        for (member, path) in report.members.iter().zip(&self.maps[1..]) {
            let place = match (member.shift_x_mm, member.shift_y_mm, member.rotation_deg) {
                (Some(x), Some(y), Some(turn)) => format!(
                    "lies {} mm along x, {} mm along y, turned by {} degree",
                    with_error(x, 4),
                    with_error(y, 4),
                    with_error(turn, 5)
                ),
                _ => "is taken where it lies".into(),
            };
            say(format!(
                "planish register: {} {place}; it differs from the first map by {} nm RMS",
                path.display(),
                significant(member.difference_rms_nm, 4)
            ));
        }
        say(format!(
            "planish register: mean of {} maps, {} pixels; one map has a standard deviation of {} nm, the mean of {} nm -> {}",
            report.maps,
            report.pixels,
            significant(report.single_deviation_nm, 4),
            significant(report.mean_deviation_nm, 4),
            self.output.out.display()
        ));
        Ok(Status::Done)
    }
}
