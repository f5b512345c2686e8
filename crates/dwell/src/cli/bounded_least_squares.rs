//! `planish dwell bounded-least-squares`.

use std::path::PathBuf;

use clap::Args;
use ndarray::Array2;
use planish_dwell::{
    bounded_least_squares::{self, Bound, BoundedSettings, Free, solve_within},
    columns::Columns,
    problem::rms_before,
    residual_slope::ResidualSlope,
};
use planish_handoff::{
    Artifact, Begin, Failure, Inputs, Output, Status,
    flags::{FloorArgs, MirrorArgs, OutputArgs, PathArgs},
    say, task, warn,
};
use planish_types::{DwellTime, Surface, doubts, outcome::plan::PlanOutcome, plausible};

use super::{status, warn_of};

#[derive(Args)]
pub struct BoundedLeastSquares {
    #[command(flatten)]
    mirror: MirrorArgs,
    #[command(flatten)]
    path: PathArgs,
    /// Weight of every pixel [.npy file (ny, nx), >= 0] [default: from the standard deviations of the map, or 1 if it
    /// has none]
    #[arg(long, value_name = "FILE")]
    weight: Option<PathBuf>,
    #[command(flatten)]
    floor: FloorArgs,
    /// Largest dwell time of every dwell point, s
    #[arg(long, value_name = "T", conflicts_with = "max_dwell_s_per_mm")]
    max_dwell_s: Option<f64>,
    /// Largest dwell time per length of the segment, s/mm
    #[arg(long, value_name = "T")]
    max_dwell_s_per_mm: Option<f64>,
    /// Least dwell times point by point [dwell artifact]
    #[arg(long, value_name = "DIR", conflicts_with_all = ["min_dwell_s", "min_dwell_s_per_mm", "min_dwell_of_machine"])]
    min_dwell: Option<PathBuf>,
    /// Largest dwell times point by point [dwell artifact]
    #[arg(long, value_name = "DIR", conflicts_with_all = ["max_dwell_s", "max_dwell_s_per_mm"])]
    max_dwell: Option<PathBuf>,
    /// Price of a second, relative to half the mean square of the residual, nm^2/s; larger values shorten the run
    #[arg(long, visible_alias = "time-weight", value_name = "L", default_value_t = 0.0)]
    time_weight_nm2_per_s: f64,
    #[command(flatten)]
    objective: ObjectiveArgs,
    #[command(flatten)]
    output: OutputArgs,
}

/// Flags of the objective of bounded least squares, for one tool or several.
#[derive(Args)]
pub(super) struct ObjectiveArgs {
    /// Low-order terms of the map that need not be removed
    #[arg(long, value_enum, default_value = "piston")]
    free: Free,
    /// Residual above which a pixel counts linearly instead of squared, nm; for maps with pits
    #[arg(long, value_name = "K")]
    huber_nm: Option<f64>,
    /// RMS of the noise of the map, nm. The smoothness is raised until the residual reaches it, without the
    /// pixels beyond `--huber-nm`. [default: the RMS of the standard deviations of the map, if it has them]
    #[arg(long, value_name = "S")]
    noise_rms_nm: Option<f64>,
    /// Columns of the removal model: the tool stands at the dwell point, or moves along the segment
    #[arg(long, value_enum, default_value = "segment")]
    columns: Columns,
    /// Tikhonov weight of the squared dwell time per area above its floor; the same at every pitch, pixel and tool
    #[arg(long, value_name = "A", default_value_t = BoundedSettings::default().tikhonov)]
    tikhonov: f64,
    /// Weight of the square of the slope of the dwell time per area along the path: the same at every pitch and tool
    #[arg(long, value_name = "B", default_value_t = BoundedSettings::default().slope_weight)]
    slope_weight: f64,
    #[command(flatten)]
    residual_slope: ResidualSlopeArgs,
}

impl ObjectiveArgs {
    /// Returns the settings of the solver for a map (ny, nx) with the weights of its pixels (ny, nx); bounds and price
    /// of a second are those of the default.
    ///
    /// # Errors
    /// Refuses what [`bounded_least_squares::noise_of_deviations`] refuses.
    pub(super) fn settings(
        &self,
        surface: &Surface,
        weight: Option<&Array2<f64>>,
    ) -> Result<BoundedSettings, Failure> {
        let of_map = bounded_least_squares::noise_of_deviations(surface, weight);
        Ok(BoundedSettings {
            columns: self.columns,
            tikhonov: self.tikhonov,
            slope_weight: self.slope_weight,
            free: self.free,
            huber_nm: self.huber_nm,
            noise_rms_nm: self.noise_rms_nm.or(of_map.map_err(Failure::with_flags)?),
            residual_slope: self.residual_slope.setting(surface),
            ..BoundedSettings::default()
        })
    }
}

/// Weight of the slope of the residual.
#[derive(Args)]
struct ResidualSlopeArgs {
    /// Weight of the mean square slope of the residual beside its mean square, mm^2: a wave of length L counts
    /// 1 + W (2 pi / L)^2 times [default: heights alone]
    #[arg(long, value_name = "W")]
    residual_slope_weight_mm2: Option<f64>,
    /// Base length of the slopes of the residual, mm [default: one step of the map]
    #[arg(long, value_name = "B", requires = "residual_slope_weight_mm2")]
    residual_slope_base_mm: Option<f64>,
}

impl ResidualSlopeArgs {
    /// Returns the setting of the solver; `None` without the flag of the weight.
    fn setting(&self, surface: &Surface) -> Option<ResidualSlope> {
        let step_mm = surface.grid().x.step_mm();
        let base_mm = self.residual_slope_base_mm.unwrap_or(step_mm);
        self.residual_slope_weight_mm2.map(|weight_mm2| ResidualSlope { weight_mm2, base_mm })
    }
}

impl BoundedLeastSquares {
    pub fn run(&self) -> Result<Status, Failure> {
        let mut inputs = Inputs::new();
        let (surface, tif) = self.mirror.read(&mut inputs)?;
        let path = self.path.read(&mut inputs)?;
        let weight =
            self.weight.as_ref().map(|file| inputs.read_map("weight", file)).transpose()?;
        let settings = BoundedSettings {
            min_dwell: self.floor.bound(Bound::Seconds, Bound::SecondsPerMm)?,
            max_dwell: self
                .max_dwell_s
                .map(Bound::Seconds)
                .or(self.max_dwell_s_per_mm.map(Bound::SecondsPerMm)),
            time_weight_nm2_per_s: self.time_weight_nm2_per_s,
            ..self.objective.settings(&surface, weight.as_ref())?
        };
        let least: Option<DwellTime> =
            self.min_dwell.as_ref().map(|dir| inputs.read("min-dwell", dir)).transpose()?;
        let most: Option<DwellTime> =
            self.max_dwell.as_ref().map(|dir| inputs.read("max-dwell", dir)).transpose()?;
        let task = task!("bounded-least-squares", settings);
        let mut output =
            match Output::directory(&self.output, DwellTime::KIND).begin(&task, &inputs)? {
                Begin::Unchanged(status) => return Ok(status),
                Begin::Run(output) => output,
            };

        plausible::check_path(&surface, &tif, &path)?;
        let (lo, hi) =
            bounded_least_squares::bounds(&path, &settings).map_err(Failure::with_flags)?;
        doubts::of_floor(&surface, &tif, lo.iter().sum()).iter().for_each(warn);
        let lo = least.map_or(lo, |least| least.dwell_s().to_vec());
        let hi = most.map_or(hi, |most| most.dwell_s().to_vec());
        let weight = weight.as_ref();
        let solution = solve_within(&surface, &tif, &path, weight, &settings, (lo, hi))
            .map_err(Failure::with_flags)?;

        let r = &solution.report;
        let status = status(r.negative(rms_before(&surface, weight)));
        let outcome =
            PlanOutcome { end: Some(r.end.into()), report: Some(r), ..PlanOutcome::default() };
        output.write(&solution.dwell, outcome, &status)?;
        warn_of(r.tif_lattice);
        say(format!(
            "bounded least squares: {} dwell times, {:.2} s, {:.4} nm RMS in its own model; {} {} after {} \
             iterations, KKT residual {:.1e} s; {} at the lower bound, {} out of reach -> {}",
            solution.dwell.dwell_s().len(),
            r.total_time_s,
            r.model_rms_nm,
            r.algorithm,
            r.end,
            r.iterations,
            r.kkt_residual_s,
            r.at_lower_bound,
            r.unreached_points,
            self.output.out.display()
        ));
        Ok(status)
    }
}
