//! `planish import trace`.

use std::path::PathBuf;

use clap::Args;
use planish_handoff::{
    Artifact, Begin, Failure, Inputs, Output, Status, flags::OutputArgs, kind, pair, say, task,
    warn, with_flags,
};
use planish_import::trace::{
    self, LogFormat, Trace, TraceSettings, TraceStatement,
    clock::Clock,
    columns::{AxisColumn, Columns},
    following::{self, Extent, Following},
    motion::Between,
};
use planish_types::{
    Machine, Trajectory,
    text::significant,
    units::{Quantity, Unit},
};
use serde::Serialize;
use serde_json::json;

use super::{about, foreign};

#[derive(Debug, Args)]
pub struct TraceArgs {
    /// Log of a machine
    file: PathBuf,
    /// File format: the controller or the program that wrote the log [default: hdf5 by the content, csv by the ending]
    #[arg(long, value_enum)]
    format: Option<LogFormat>,
    /// Column of the time stamps: name, number counted from 1, path in HDF5 (PATH:K for its column K)
    /// [default: the one that is called t or time]
    #[arg(long, value_name = "COLUMN")]
    time: Option<String>,
    /// Column of the time stamps of y, where they are not those of x. The positions of y are interpolated to the times of
    /// x [default: the nearest column of times to the left of y]
    #[arg(long, value_name = "COLUMN", requires = "time")]
    time_y: Option<String>,
    /// Name of the x coordinates in the file: the column of the positions [default: by its name]
    #[arg(long, value_name = "COLUMN")]
    x: Option<String>,
    /// Name of the y coordinates in the file: the column of the positions [default: by its name]
    #[arg(long, value_name = "COLUMN")]
    y: Option<String>,
    /// Column of the setpoint of x [default: by its name]
    #[arg(long, value_name = "COLUMN")]
    setpoint_x: Option<String>,
    /// Column of the setpoint of y [default: by its name]
    #[arg(long, value_name = "COLUMN")]
    setpoint_y: Option<String>,
    /// Column of the beam current, which the removal rate follows
    #[arg(long, value_name = "COLUMN")]
    current: Option<String>,
    /// Beam current at which the TIF was measured, in the unit of the log
    #[arg(long, value_name = "I", allow_negative_numbers = true)]
    nominal_current: Option<f64>,
    /// Column that is 1 where the tool removes and 0 where it does not
    #[arg(long, value_name = "COLUMN")]
    tool_on: Option<String>,
    /// Unit of the values in the file (positions), where it does not state it: m, mm, um, nm, in, mil and so on, or count
    #[arg(long, value_name = "UNIT", value_parser = length_unit)]
    unit: Option<Unit>,
    /// Unit of the positions of rotary axes, where the log does not state it: deg, rad, mrad, arcsec and so on
    #[arg(long, value_name = "UNIT", value_parser = angle_unit, requires = "machine")]
    angle_unit: Option<Unit>,
    /// Size of a count, mm: one number, or two for X,Y
    #[arg(long, value_name = "C", value_parser = pair, allow_hyphen_values = true)]
    count_mm: Option<[f64; 2]>,
    /// Unit of the time stamps, where the log does not state it: s, ms, us, ns, min, h, d (days of a spreadsheet), or
    /// samples
    #[arg(long, value_name = "UNIT", value_parser = time_unit)]
    time_unit: Option<Unit>,
    /// Sample time of the controller, s, for time stamps in samples
    #[arg(long, value_name = "T", allow_negative_numbers = true)]
    sample_s: Option<f64>,
    /// Samples per second, Hz; gives the times if the log has no stamps, and is compared with the stamps if
    /// it has
    #[arg(long, value_name = "F", allow_negative_numbers = true)]
    rate_hz: Option<f64>,
    /// Longest gap in the time stamps that is bridged by a straight line, s
    #[arg(long, value_name = "T", default_value_t = 0.1, allow_negative_numbers = true)]
    most_gap_s: f64,
    /// Begin so long after the first sample, s
    #[arg(long, value_name = "T", allow_negative_numbers = true)]
    from_s: Option<f64>,
    /// End so long after the first sample, s
    #[arg(long, value_name = "T", allow_negative_numbers = true)]
    until_s: Option<f64>,
    /// Motion between two samples
    #[arg(long, value_enum, default_value = "cubic")]
    between: Between,
    /// Machine and its limits, whose axes the log holds by their names; writes their motion [axes artifact], of which planish axes
    /// contact makes that of the contact point [JSON]
    #[arg(long, value_name = "FILE", conflicts_with_all = ["x", "y", "setpoint_x", "setpoint_y", "planned", "current"])]
    machine: Option<PathBuf>,
    /// Column of an axis of --machine, as NAME=COLUMN; may be repeated [default: by the name of the axis]
    #[arg(long, value_name = "NAME=COLUMN", value_parser = axis_column, requires = "machine")]
    axis: Vec<(String, String)>,
    /// Plan that was run, to compare with [trajectory artifact]
    #[arg(long, value_name = "DIR")]
    planned: Option<PathBuf>,
    /// Longest time between the beginnings of the log and of the plan, s
    #[arg(long, value_name = "T", default_value_t = 10.0, allow_negative_numbers = true)]
    most_offset_s: f64,
    /// Take the state of the tool from the plan, for logs that do not have it
    #[arg(long, requires = "planned", conflicts_with = "tool_on")]
    tool_from_plan: bool,
    #[command(flatten)]
    output: OutputArgs,
}

fn length_unit(text: &str) -> Result<Unit, String> {
    unit(text, &[Quantity::Length, Quantity::Counts], "a length, such as mm, um, in, or count")
}

fn angle_unit(text: &str) -> Result<Unit, String> {
    unit(text, &[Quantity::Angle], "an angle, such as deg, rad, mrad or arcsec")
}

fn time_unit(text: &str) -> Result<Unit, String> {
    unit(text, &[Quantity::Time, Quantity::Samples], "a time, such as s, ms, ns, min, or samples")
}

/// Reads the unit of a flag. Refuses one that measures none of the quantities `wanted`, which the message calls `kind`.
fn unit(text: &str, wanted: &[Quantity], kind: &str) -> Result<Unit, String> {
    let unit = Unit::read(text, wanted).filter(|unit| wanted.contains(&unit.quantity()));
    unit.ok_or_else(|| format!("is no unit of {kind}"))
}

fn axis_column(text: &str) -> Result<(String, String), String> {
    let (name, column) =
        text.split_once('=').ok_or("give NAME=COLUMN, such as z=\"Z pos (mm)\"")?;
    Ok((name.trim().to_lowercase(), column.trim().to_string()))
}

impl TraceArgs {
    fn settings(&self, machine: Option<&Machine>) -> Result<TraceSettings, Failure> {
        let mut axes: Vec<AxisColumn> = Vec::new();
        for axis in machine.iter().flat_map(|machine| machine.axes()) {
            let flag = self.axis.iter().find(|(name, _)| name == axis.name);
            axes.push(AxisColumn {
                name: axis.name.into(),
                is_rotary: axis.is_rotary,
                column: flag.map(|(_, column)| column.clone()),
            });
        }
        if let Some((name, _)) =
            self.axis.iter().find(|(name, _)| axes.iter().all(|axis| axis.name != *name))
        {
            let names: Vec<&str> = axes.iter().map(|axis| axis.name.as_str()).collect();
            let names = names.join(", ");
            return Err(Failure::new(format!(
                "--axis: the machine has no axis {name:?}, only {names}"
            )));
        }
        Ok(TraceSettings {
            columns: Columns {
                axes,
                time: self.time.clone(),
                time_y: self.time_y.clone(),
                x: self.x.clone(),
                y: self.y.clone(),
                setpoint_x: self.setpoint_x.clone(),
                setpoint_y: self.setpoint_y.clone(),
                current: self.current.clone(),
                tool_on: self.tool_on.clone(),
            },
            unit: self.unit,
            angle_unit: self.angle_unit,
            count_mm: self.count_mm,
            time_unit: self.time_unit,
            sample_s: self.sample_s,
            rate_hz: self.rate_hz,
            most_gap_s: self.most_gap_s,
            nominal_current: self.nominal_current,
            from_s: self.from_s,
            until_s: self.until_s,
            between: self.between,
        })
    }

    fn format(&self, bytes: &[u8]) -> Result<LogFormat, Failure> {
        let ending = self.file.extension().map(|e| e.to_string_lossy().to_ascii_lowercase());
        self.format.or_else(|| LogFormat::recognise(bytes, ending.as_deref())).ok_or_else(|| {
            let problem = "is of no format that is known by its content; give --format";
            Failure::new(format!("{}: {problem}", self.file.display()))
        })
    }

    pub fn run(&self) -> Result<Status, Failure> {
        let mut inputs = Inputs::new();
        let machine = match &self.machine {
            Some(file) => Some(inputs.read_machine(file)?),
            None => None,
        };
        let settings = self.settings(machine.as_ref())?;
        let planned: Option<Trajectory> = match &self.planned {
            Some(dir) => Some(inputs.read("planned", dir)?),
            None => None,
        };
        let bytes = foreign(&mut inputs, "file", &self.file)?;
        let format = self.format(&bytes)?;
        let resolved = json!({
            "format": format,
            "log": settings,
            "most_offset_s": self.most_offset_s,
            "tool_from_plan": self.tool_from_plan,
        });
        let task = task!("trace", resolved);
        let kind = if machine.is_some() { &kind::AXES } else { Trajectory::KIND };
        let output = Output::directory(&self.output, kind);
        let mut output = match output.begin(&task, &inputs)? {
            Begin::Unchanged(status) => return Ok(status),
            Begin::Run(output) => output,
        };
        let failed = |e| about(&self.file, &e);
        let mut trace = trace::read(format, &bytes, &settings).map_err(failed)?;
        drop(bytes);
        if let Some(machine) = &machine {
            let motion = trace.axes_motion(self.between).map_err(failed)?;
            let names: Vec<&str> = machine.axes().iter().map(|axis| axis.name).collect();
            let outcome = json!({
                "axes": names,
                "segments": motion.len(),
                "total_time_s": motion.total_time_s(),
                "reading": trace.statement,
                "clock": trace.clock,
            });
            output.write(&motion, outcome, &Status::Done)?;
            self.report(&trace, motion.len(), motion.total_time_s());
            return Ok(Status::Done);
        }
        let beside_plan = match &planned {
            Some(plan) => Some(self.beside_plan(&mut trace, plan)?),
            None => None,
        };
        let motion = trace.motion(self.between).map_err(failed)?;
        let setpoint = trace.setpoint(self.between).map_err(failed)?;
        let beside_setpoint =
            setpoint.map(|s| following::beside_setpoint(&trace.time_s, &trace.actual_mm, &s));
        let (beside_plan, extent) = beside_plan.unzip();
        let mut outcome = outcome(&trace, &motion, beside_setpoint.as_ref(), beside_plan.as_ref());
        let mut drawback = None;
        if let Some(extent) = &extent {
            outcome.beside_plan = Some(extent);
            drawback = extent.drawback(self.from_s.is_some() || self.until_s.is_some());
        }
        let status = drawback.map_or(Status::Done, Status::Negative);
        output.write(&motion, outcome, &status)?;
        self.report(&trace, motion.len(), motion.total_time_s());
        let drift = beside_plan.as_ref().and_then(|following| following.drift);
        drift
            .and_then(|drift| drift.warning())
            .iter()
            .for_each(|warning| warn(with_flags(warning)));
        // A warning would only repeat the verdict.
        if let (Some(extent), Status::Done) = (&extent, &status) {
            extent.warnings().iter().for_each(|warning| warn(with_flags(warning)));
        }
        for (name, following) in [("setpoint", beside_setpoint), ("plan", beside_plan)] {
            if let Some(following) = following {
                say_following(name, &following);
            }
        }
        Ok(status)
    }

    /// Compares the log with the plan. With `--tool-from-plan`, the log gets the tool state of the plan. Refuses a log
    /// of another motion.
    fn beside_plan(
        &self,
        trace: &mut Trace,
        plan: &Trajectory,
    ) -> Result<(Following, Extent), Failure> {
        let time_s = &trace.time_s;
        let following = following::beside_plan(time_s, &trace.actual_mm, plan, self.most_offset_s)
            .map_err(|e| about(&self.file, &e))?;
        let begin_s = following.reference_begins_s + time_s[0];
        if self.tool_from_plan {
            trace.tool_on = Some(following::tool_of_plan(time_s, plan, begin_s));
        }
        let removes = trace.removes();
        let extent = Extent::new(&trace.time_s, removes.as_deref(), plan, begin_s);
        Ok((following, extent))
    }

    fn report(&self, trace: &Trace, segments: usize, total_time_s: f64) {
        for warning in &trace.statement.warnings {
            warn(with_flags(warning));
        }
        let columns = trace.statement.columns.iter();
        let columns: Vec<String> = columns.map(|(role, name)| format!("{role} {name:?}")).collect();
        say(format!(
            "planish import: {} samples over {:.4} s at {} Hz ({}); columns: {}; unit of the positions: {}",
            trace.time_s.len(),
            total_time_s,
            significant(trace.clock.rate_hz, 8),
            trace.clock.rate_from,
            columns.join(", "),
            trace.statement.unit_from
        ));
        say(format!("planish import: {segments} segments -> {}", self.output.out.display()));
    }
}

/// Outcome of reading a log, as the manifest records it.
#[derive(Serialize)]
struct TraceOutcome<'a> {
    segments: usize,
    total_time_s: f64,
    /// True if the tool removes in every segment.
    always_on: bool,
    reading: &'a TraceStatement,
    clock: &'a Clock,
    #[serde(skip_serializing_if = "Option::is_none")]
    rate_factor: Option<RateFactorOutcome>,
    #[serde(skip_serializing_if = "Option::is_none")]
    following_setpoint: Option<&'a Following>,
    #[serde(skip_serializing_if = "Option::is_none")]
    following_plan: Option<&'a Following>,
    #[serde(skip_serializing_if = "Option::is_none")]
    beside_plan: Option<&'a Extent>,
}

/// Mean, smallest (`least`) and largest (`most`) removal rate along the motion, relative to that of the TIF.
#[derive(Serialize)]
struct RateFactorOutcome {
    mean: f64,
    least: f64,
    most: f64,
}

impl RateFactorOutcome {
    fn of_factors(factor: &[f64]) -> Self {
        Self {
            mean: factor.iter().sum::<f64>() / factor.len() as f64,
            least: factor.iter().copied().fold(f64::INFINITY, f64::min),
            most: factor.iter().copied().fold(0.0, f64::max),
        }
    }
}

fn outcome<'a>(
    trace: &'a Trace,
    motion: &Trajectory,
    following_setpoint: Option<&'a Following>,
    following_plan: Option<&'a Following>,
) -> TraceOutcome<'a> {
    TraceOutcome {
        segments: motion.len(),
        total_time_s: motion.total_time_s(),
        always_on: motion.tool_on().iter().all(|on| *on),
        reading: &trace.statement,
        clock: &trace.clock,
        rate_factor: motion.rate_factor().map(RateFactorOutcome::of_factors),
        following_setpoint,
        following_plan,
        beside_plan: None,
    }
}

/// Prints the following error of both axes against `reference` (setpoint or plan), in um and ms.
fn say_following(reference: &str, following: &Following) {
    for (name, axis) in ["x", "y"].into_iter().zip(&following.axes) {
        let lag = match (axis.lag_ms, axis.lag_standard_error_ms, axis.rms_without_lag_mm) {
            (Some(lag), Some(error), Some(rest)) => format!(
                "lag {} ms (standard error {}), {} um RMS without it",
                significant(lag, 4),
                significant(error, 2),
                significant(1e3 * rest, 4)
            ),
            _ => "no lag: the axis does not move, or its delay has not settled".into(),
        };
        let [rms, largest] = [axis.rms_mm, axis.largest_mm].map(|mm| significant(1e3 * mm, 4));
        say(format!(
            "planish import: {name} beside the {reference}: {rms} um RMS, {largest} um at most (at {:.4} s), {lag}",
            axis.largest_at_s
        ));
    }
    if reference == "plan" {
        let begins = significant(following.reference_begins_s, 7);
        say(format!("planish import: the plan begins {begins} s after the first sample"));
    }
}
