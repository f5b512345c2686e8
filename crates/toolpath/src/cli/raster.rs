//! `planish toolpath raster`.

use clap::{Args, ValueEnum};
use planish_handoff::{Begin, Failure, Status, task};
use planish_toolpath::{LineOrder, RasterSettings, Scan, Turn, raster};
use planish_types::doubts;
use serde_json::json;

use super::{Region, RegionArgs};

#[derive(Debug, Args)]
pub struct RasterArgs {
    #[command(flatten)]
    region: RegionArgs,
    /// Longest segment, mm
    #[arg(long, value_name = "S", allow_negative_numbers = true)]
    step_mm: f64,
    /// Direction of the lines
    #[arg(long, value_enum, default_value_t = ScanArg::X)]
    scan: ScanArg,
    /// Direction of the lines from x towards y, degrees: 0 and 90 are the scans along x and y
    #[arg(long, value_name = "A", conflicts_with = "scan", allow_negative_numbers = true)]
    angle_deg: Option<f64>,
    /// Turns between consecutive lines [default: square; lift for lines in one direction or in
    /// random order]
    #[arg(long, value_enum)]
    turn: Option<Turn>,
    /// Run all lines in the same direction, and return with the tool off
    #[arg(long)]
    one_directional: bool,
    /// Order of the lines
    #[arg(long, value_enum, default_value_t = LineOrderArg::Sequential)]
    line_order: LineOrderArg,
    /// Random seed of the line order [default: 1]
    #[arg(long, value_name = "N")]
    seed: Option<u64>,
    /// Range A to B of the distance of the lines, which follows the mean of the map along them;
    /// --pitch-mm is then the distance at the mean of the map
    #[arg(
        long,
        value_names = ["A", "B"],
        num_args = 2,
        conflicts_with = "line_origin_mm",
        allow_negative_numbers = true
    )]
    pitch_range_mm: Option<Vec<f64>>,
    /// Coordinate of one line across the lines (y for lines along x), mm [default: lines centred
    /// on the region]
    #[arg(long, value_name = "C", allow_negative_numbers = true)]
    line_origin_mm: Option<f64>,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum ScanArg {
    X,
    Y,
}

#[derive(Clone, Copy, Debug, PartialEq, ValueEnum)]
enum LineOrderArg {
    /// The next line
    Sequential,
    /// Every other line, then back over the lines between them
    BiStep,
    /// A random line; the tool is lifted between lines
    Random,
}

impl RasterArgs {
    pub fn run(&self) -> Result<Status, Failure> {
        let on = Region::read(&self.region)?;
        let order = match (self.line_order, self.seed) {
            (LineOrderArg::Sequential, None) => LineOrder::Sequential,
            (LineOrderArg::BiStep, None) => LineOrder::BiStep,
            (LineOrderArg::Random, seed) => LineOrder::Random { seed: seed.unwrap_or(1) },
            (_, Some(_)) => return Err(Failure::new("seed: only --line-order random has one")),
        };
        let settings = RasterSettings {
            pitch_mm: self.region.pitch_mm,
            step_mm: self.step_mm,
            overscan_mm: on.overscan_mm,
            scan: match (self.angle_deg, self.scan) {
                (Some(angle_deg), _) => Scan::Angle { angle_deg },
                (None, ScanArg::X) => Scan::X,
                (None, ScanArg::Y) => Scan::Y,
            },
            turn: self.turn.unwrap_or(Turn::usual(order, self.one_directional)),
            line_origin_mm: self.line_origin_mm,
            order,
            one_directional: self.one_directional,
            pitch_range_mm: self.pitch_range_mm.as_ref().map(|range| [range[0], range[1]]),
        };
        let mut output = match on.begin(&task!("raster", &on.stated(&settings)))? {
            Begin::Unchanged(status) => return Ok(status),
            Begin::Run(output) => output,
        };
        let path = raster(&on.surface, &settings)?;
        let mut warnings = settings.warnings(&path);
        warnings.extend(self.angle_deg.and_then(|angle| doubts::of_angle("`angle_deg`", angle)));
        on.write(&mut output, &path, settings.largest_pitch_mm(), json!({}), warnings)
    }
}
