//! Logs of machines (recorded axis positions over time), read as the motion that the machine made.
//!
//! A controller records the positions of its axes: an encoder log, a gathering, a scope trace. The removal
//! is an integral along that motion as it is along a plan's. So a log becomes a [`Trajectory`] with one
//! segment per interval between two samples ([`motion`]), and the residual *as run* can be compared with
//! the residual *as planned*.
//!
//! | module | contents |
//! |---|---|
//! | [`columns`] | choice of the quantity of every column of a log: by number, by name, or by the names that
//! controllers use |
//! | [`table`] | text in columns: CSV, XPS gatherings, Aerotech and Galil logs |
//! | [`datasets`] | logs in HDF5 files |
//! | [`clock`] | time stamps or a rate: gaps, drift and scatter |
//! | [`moment`], [`stamp`] | time stamps: dates with times of day, or numbers |
//! | [`jumps`] | samples that no axis can have reached |
//! | [`motion`] | cubic or straight pieces between the samples |
//! | [`following`] | following error of the log against its setpoint or a plan |
//!
//! The formats, as far as they are public:
//!
//! * XPS: `GatheringStopAndSave` writes lines of numbers, separated by tabs or semicolons, with the names
//!   `GROUP.POSITIONER.SetpointPosition` and `...CurrentPosition` above them; what
//!   `GatheringDataMultipleLinesGet` returns has none, and then the columns are `setpoint;actual;` per axis
//!   (Newport, XPS programmer's manual).
//! * Galil: uploaded arrays are a CSV whose first line has the names; a shorter array ends with empty cells
//!   (GalilTools manual, "Comma-Separated Values"). `_TPA` is the encoder of axis A, `_RPA` its reference.
//! * Aerotech: the plots of A3200 and Automation1 are saved as text in columns, named after the signals
//!   `Position Command` and `Position Feedback` of an axis. No specification is public, so columns are found
//!   by the words of their names, and named to the user.

pub mod clock;
pub mod columns;
pub mod datasets;
pub mod following;
pub mod jumps;
pub mod moment;
pub mod motion;
pub mod stamp;
pub mod table;

use planish_numerics::polynomial;
use planish_types::{
    AxesMotion, Invalid, Trajectory, is_plausible_mm,
    text::significant,
    units::{Quantity, Unit},
};
use serde::Serialize;

use self::{
    clock::{Clock, Timing},
    columns::{Column, Columns, Log, Role},
    motion::Between,
};

/// Subject of the messages about a log.
const NAME: &str = "log";

/// Controller or format that wrote a log.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum LogFormat {
    /// Text in columns, with or without their names.
    Csv,
    /// HDF5, a dataset per quantity.
    Hdf5,
    /// Newport XPS gathering.
    Xps,
    /// Aerotech plot saved as text.
    Aerotech,
    /// Galil arrays, uploaded as text.
    Galil,
}

impl LogFormat {
    /// Returns `Hdf5` if the bytes are those of an HDF5 file, and `Csv` if `ending`, the ending of the file name in
    /// lower case, is `csv`. Returns `None` for all other files.
    pub fn recognise(bytes: &[u8], ending: Option<&str>) -> Option<Self> {
        match ending {
            _ if crate::format::hdf5::is_hdf5(bytes) => Some(Self::Hdf5),
            Some("csv") => Some(Self::Csv),
            _ => None,
        }
    }
}

/// Settings for reading a log: statements of the user that the log does not make.
#[derive(Clone, Debug, Default, Serialize)]
pub struct TraceSettings {
    /// Columns that the user states for the quantities. In text, the other columns are found by their names; in HDF5
    /// only stated ones are read.
    pub columns: Columns,
    /// Unit of the positions of x, y and linear axes, if the log does not state it: a length or counts. A unit that
    /// contradicts the log is refused.
    pub unit: Option<Unit>,
    /// Unit of the positions of rotary axes, if the log does not state it: an angle. A unit that contradicts the log is
    /// refused.
    pub angle_unit: Option<Unit>,
    /// Length of an encoder count of [x, y], mm; negative if an axis counts backwards. A log in counts needs it.
    pub count_mm: Option<[f64; 2]>,
    /// Unit of the time stamps, if the log does not state it: a time or samples. A unit that contradicts the log is
    /// refused.
    pub time_unit: Option<Unit>,
    /// Sample time of the controller, s, for time stamps that count samples.
    pub sample_s: Option<f64>,
    /// Sampling rate that was set for the log, Hz. A log without time stamps needs it; time stamps are compared with
    /// it.
    pub rate_hz: Option<f64>,
    /// Longest time between two samples, s, that a straight line may bridge; a log with a longer gap is refused.
    pub most_gap_s: f64,
    /// Beam current, in the unit of the log, at which the TIF was measured. A log with a column of the current needs
    /// it.
    pub nominal_current: Option<f64>,
    /// Beginning of the motion to keep, s after the first sample of the log; `None` begins with the first sample.
    pub from_s: Option<f64>,
    /// End of the motion to keep, s after the first sample of the log; `None` ends with the last sample.
    pub until_s: Option<f64>,
    /// Interpolation between two samples, cubic or straight.
    pub between: Between,
}

/// A log of n samples in the order of time: positions of x and y, or of all axes of a machine.
#[derive(Clone, Debug)]
pub struct Trace {
    /// Times of the samples, s after the first sample of the log before it is cut, ascending (n).
    pub time_s: Vec<f64>,
    /// Measured positions [x, y], mm (n); empty if all axes of a machine are read.
    pub actual_mm: Vec<[f64; 2]>,
    /// Measured positions of every axis of a machine, mm or degrees (n values per axis); empty if x and y are read.
    pub axes: Vec<Vec<f64>>,
    /// Setpoints [x, y] of the controller, mm (n); `None` if the log has none.
    pub setpoint_mm: Option<Vec<[f64; 2]>>,
    /// True if the tool was switched on from this sample to the next (n, the last one unused); `None` if the log has no
    /// switch.
    pub tool_on: Option<Vec<bool>>,
    /// Removal rate at the sample relative to that of the TIF: beam current over nominal current (n). `None` if the log
    /// has no current.
    pub rate_factor: Option<Vec<f64>>,
    /// Comparison of the time stamps with equal steps, for the log before `from_s` and `until_s` cut it.
    pub clock: Clock,
    /// Columns, unit and warnings, as they were read.
    pub statement: TraceStatement,
}

/// Record of how a log was read, for the manifest: format, columns and units.
#[derive(Clone, Debug, Serialize)]
pub struct TraceStatement {
    /// Controller or format that wrote the log.
    pub format: LogFormat,
    /// Pairs of a quantity, such as `x`, and the column or dataset of the file that it was read from.
    pub columns: Vec<(String, String)>,
    /// Factor from the stored values of each position column to mm or degrees, in the order of these columns.
    pub mm_or_deg_per_value: Vec<f64>,
    /// Source of the unit of the positions: "asked for" if the user stated that of at least one column, else "the log".
    pub unit_from: &'static str,
    /// Warnings for the user.
    pub warnings: Vec<String>,
}

/// Largest magnitude of a current below zero, relative to the nominal current, that counts as 0. A log with a larger
/// one is refused. Larger: accepts currents with the wrong sign. Smaller: refuses logs with an offset. Chosen: the
/// offset of a picoammeter is far below it.
const MOST_NEGATIVE_CURRENT: f64 = 0.05;

/// Largest ratio of a current to the nominal current, and of the nominal current to the largest current of the log. A
/// log beyond it is refused, because its currents are in another unit. Larger: accepts mistakes in the unit. Smaller:
/// refuses unusual currents. Chosen: from A to mA the ratio is 1000.
const LARGEST_RATE_FACTOR: f64 = 100.0;

/// Largest ratio, either way, of the mean current with the beam on to the nominal current without a
/// warning. Larger: does not notice that the TIF was measured with another beam. Smaller: warns of usual
/// currents.
const USUAL_RATE_FACTOR: f64 = 2.0;

/// Fraction of the largest current of the log above which the beam is on. Larger: a beam with a drifting current counts
/// as off. Smaller: a beam that is being switched off still counts as on.
const BEAM_ON: f64 = 0.5;

/// Reads the bytes of a log, and converts the positions to mm or degrees on one time axis.
///
/// # Errors
/// Refuses settings out of range, a log with fewer than two samples, and one without the needed columns. Refuses units
/// that nobody states or that contradict the settings, and times that do not ascend or have long gaps. Refuses
/// positions or currents that no machine has, and a switch of the tool other than 0 or 1.
pub fn read(format: LogFormat, bytes: &[u8], settings: &TraceSettings) -> Result<Trace, Invalid> {
    check(settings)?;
    let Log { mut columns, times, mut warnings } = match format {
        LogFormat::Hdf5 => datasets::read(bytes, &settings.columns)?,
        _ => table::read(format, bytes, &settings.columns)?,
    };
    let scale = PositionScale::new(&columns, settings)?;
    let positions = columns.iter_mut().filter(|column| column.role.is_position());
    for (column, factor) in positions.zip(&scale.factors) {
        column.values.iter_mut().for_each(|v| *v *= factor);
    }
    let names = columns.iter().map(|c| (settings.columns.name(c.role), c.name.clone())).collect();
    let (time_s, clock) = on_one_clock(&mut columns, &times, settings, &mut warnings)?;
    warnings.extend(clock.warnings());
    let axes = (0..settings.columns.axes.len())
        .filter_map(|k| Some(find(&columns, Role::Axis(k))?.values.clone()));
    let trace = Trace {
        actual_mm: pair(&columns, [Role::X, Role::Y]).unwrap_or_default(),
        axes: axes.collect(),
        setpoint_mm: pair(&columns, [Role::SetpointX, Role::SetpointY]),
        tool_on: find(&columns, Role::ToolOn).map(switched).transpose()?,
        rate_factor: match find(&columns, Role::Current) {
            Some(column) => Some(rate_factor(column, settings.nominal_current, &mut warnings)?),
            None => None,
        },
        time_s,
        clock,
        statement: TraceStatement {
            format,
            columns: names,
            mm_or_deg_per_value: scale.factors,
            unit_from: scale.unit_from,
            warnings,
        },
    };
    trace.check_plausible()?;
    let mut trace = trace.cropped(settings)?;
    let jumps: Vec<String> = trace.positions(settings).iter().filter_map(jumps::doubt).collect();
    trace.statement.warnings.extend(jumps);
    Ok(trace)
}

/// Returns the column of the quantity `role`, or `None` if the log has none.
fn find(columns: &[Column], role: Role) -> Option<&Column> {
    columns.iter().find(|c| c.role == role)
}

/// Returns the values of the two quantities x and y in pairs [x, y] (n), or `None` if one of them is absent.
fn pair(columns: &[Column], [x, y]: [Role; 2]) -> Option<Vec<[f64; 2]>> {
    let [x, y] = [find(columns, x)?, find(columns, y)?];
    Some(x.values.iter().zip(&y.values).map(|(x, y)| [*x, *y]).collect())
}

/// Returns the times of the samples, s, and their comparison with equal steps. A quantity with its own time stamps is
/// interpolated to the times of the log. The log is cut to the times that all quantities have. Refuses fewer than two
/// samples, before or after this cut, and what `Timing` refuses.
fn on_one_clock(
    columns: &mut [Column],
    times: &[Column],
    settings: &TraceSettings,
    warnings: &mut Vec<String>,
) -> Result<(Vec<f64>, Clock), Invalid> {
    let on_log = columns.iter().filter(|c| c.own_time.is_none());
    let samples = on_log.map(|c| c.values.len()).min().unwrap_or(0);
    if samples < 2 {
        let problem = format!("holds {samples} samples of position");
        return Err(Invalid::whole(NAME, problem, "give a log of a motion"));
    }
    let main = columns.iter().find(|c| c.role == Role::Time).cloned();
    let timing = Timing {
        stamps: main.as_ref(),
        samples,
        unit: settings.time_unit,
        sample_s: settings.sample_s,
        rate_hz: settings.rate_hz,
        most_gap_s: settings.most_gap_s,
    };
    let (mut time_s, clock) = timing.clock()?;
    let Some(main) = &main else { return Ok((time_s, clock)) };
    let unit = settings.time_unit.or(main.unit);
    let mut span_s = [time_s[0], time_s[samples - 1]];
    let mut own: Vec<Vec<f64>> = Vec::with_capacity(times.len());
    for stamps in times {
        let timing = Timing {
            stamps: Some(stamps),
            samples: stamps.values.len(),
            unit: stamps.unit.or(unit),
            ..timing
        };
        let unit_s = timing.unit_s(stamps)?;
        let later_s = match (main.first_moment, stamps.first_moment) {
            (Some(a), Some(b)) => {
                let both = moment::times(&[a, b]).map_err(|_| {
                    let problem = format!("is in {} no moment like those of the log", stamps.name);
                    Invalid::whole("time", problem, "give `time_y`")
                })?;
                both.seconds[1]
            }
            _ => (stamps.first - main.first) * unit_s,
        };
        let on_log: Vec<f64> = timing.clock()?.0.iter().map(|t| t + later_s).collect();
        span_s = [span_s[0].max(on_log[0]), span_s[1].min(on_log[on_log.len() - 1])];
        own.push(on_log);
    }
    if own.is_empty() {
        return Ok((time_s, clock));
    }
    // Rounding of sums of times.
    let least_s = 1e-9 / clock.rate_hz;
    let first = time_s.partition_point(|t| *t < span_s[0] - least_s);
    let end = time_s.partition_point(|t| *t <= span_s[1] + least_s);
    if first + 2 > end {
        let problem = "has channels whose times have nothing in common";
        return Err(Invalid::whole(NAME, problem, "give `time` and `time_y` of one recording"));
    }
    time_s.truncate(end);
    time_s.drain(..first);
    for column in columns.iter_mut() {
        match column.own_time {
            Some(k) => {
                let held = column.role == Role::ToolOn;
                column.values = resampled(&own[k], &column.values, &time_s, held);
            }
            None => {
                column.values.truncate(end);
                column.values.drain(..first);
            }
        }
    }
    warnings.push(warning_of_own_times(columns, times, settings, &main.name, &time_s));
    Ok((time_s, clock))
}

/// Returns the warning that quantities have their own time stamps, and are interpolated to `time_s`. `main` is the name
/// of the column with the time stamps of the log.
fn warning_of_own_times(
    columns: &[Column],
    times: &[Column],
    settings: &TraceSettings,
    main: &str,
    time_s: &[f64],
) -> String {
    let by_own: Vec<String> = (columns.iter())
        .filter_map(|c| Some((settings.columns.name(c.role), &times[c.own_time?].name)))
        .map(|(role, name)| format!("{role} by \"{name}\""))
        .collect();
    format!(
        "channels have times of their own: {}; they are interpolated to the times of \"{}\", from {} to {} s, which all \
         channels have",
        by_own.join(", "),
        main,
        significant(time_s[0], 6),
        significant(time_s[time_s.len() - 1], 6)
    )
}

/// Interpolates the `values` of samples at `time_s` to the ascending times `at_s`, by cubics. With `held`, it returns
/// the last sample at or before each time.
fn resampled(time_s: &[f64], values: &[f64], at_s: &[f64], held: bool) -> Vec<f64> {
    let n = time_s.len().min(values.len());
    let pieces = motion::pieces(&time_s[..n], &values[..n], f64::INFINITY, Between::Cubic);
    let mut resampled = Vec::with_capacity(at_s.len());
    for t in at_s {
        let mut i = time_s[..n].partition_point(|s| s <= t).saturating_sub(1);
        // Rounding of times must not turn a switch back.
        if i + 1 < n && time_s[i + 1] - t < 1e-9 * (time_s[i + 1] - time_s[i]) {
            i += 1;
        }
        resampled.push(if held || i + 1 >= n {
            values[i]
        } else {
            polynomial::evaluate(&pieces[i], t - time_s[i])
        });
    }
    resampled
}

/// Refuses a rate, sample time, longest gap or nominal current that is not positive, and an encoder count of 0. Refuses
/// units of the wrong quantity, such as an angle for a length.
fn check(settings: &TraceSettings) -> Result<(), Invalid> {
    let positive = [
        ("rate_hz", settings.rate_hz),
        ("sample_s", settings.sample_s),
        ("most_gap_s", Some(settings.most_gap_s)),
        ("nominal_current", settings.nominal_current),
        ("count_mm", settings.count_mm.map(|[x, y]| x.abs().min(y.abs()))),
    ];
    let units: [(&'static str, Option<Unit>, [Quantity; 2], &str); 3] = [
        ("unit", settings.unit, [Quantity::Length, Quantity::Counts], "of a length"),
        ("angle_unit", settings.angle_unit, [Quantity::Angle; 2], "of an angle"),
        ("time_unit", settings.time_unit, [Quantity::Time, Quantity::Samples], "of a time"),
    ];
    for (name, unit, wanted, quantity) in units {
        if let Some(unit) = unit.filter(|unit| !wanted.contains(&unit.quantity())) {
            let problem = format!("is {unit}");
            return Err(Invalid::whole(name, problem, format!("give the unit {quantity}")));
        }
    }
    for (name, value) in positive {
        if let Some(v) = value.filter(|v| !(v.is_finite() && *v > 0.0)) {
            return Err(Invalid::whole(name, format!("is {v}"), "give a positive number"));
        }
    }
    Ok(())
}

/// Factor from the stored values of every position column to mm or degrees, and the source of the unit.
struct PositionScale {
    factors: Vec<f64>,
    unit_from: &'static str,
}

impl PositionScale {
    /// Finds the units of the position columns, from the log or the settings. Refuses a setting that contradicts the
    /// log, a unit that nobody states, and counts without a length of a count.
    fn new(columns: &[Column], settings: &TraceSettings) -> Result<Self, Invalid> {
        let mut scale = Self { factors: Vec::new(), unit_from: "the log" };
        for column in columns.iter().filter(|c| c.role.is_position()) {
            let is_rotary =
                matches!(column.role, Role::Axis(k) if settings.columns.axes[k].is_rotary);
            let (setting, requested, remedy) = if is_rotary {
                let remedy = "give `angle_unit`: deg, rad, mrad, urad, arcsec, arcmin";
                ("angle_unit", settings.angle_unit, remedy)
            } else {
                let remedy = "give `unit`: m, mm, um, nm, in, mil, or count with `count_mm`";
                ("unit", settings.unit, remedy)
            };
            let unit = match (requested, column.unit) {
                (Some(requested), Some(stated)) if requested != stated => {
                    let problem =
                        format!("is {requested}, but the log has \"{}\" in {stated}", column.name);
                    let remedy = format!("leave `{setting}` out, or correct the log");
                    return Err(Invalid::whole(setting, problem, remedy));
                }
                (Some(requested), _) => {
                    scale.unit_from = "asked for";
                    requested
                }
                (None, Some(stated)) => stated,
                (None, None) => {
                    let problem =
                        format!("of the positions is not in the log, in \"{}\"", column.name);
                    return Err(Invalid::whole(setting, problem, remedy));
                }
            };
            scale.factors.push(match unit.quantity() {
                Quantity::Counts => count(column.role, settings)?,
                _ if is_rotary => unit.size(0).to_degrees(),
                _ => unit.size(-3),
            });
        }
        Ok(scale)
    }
}

/// Returns the length of an encoder count of a position of x or y, mm, from `count_mm`. Refuses its absence, and counts
/// in a log of all axes of a machine.
fn count(role: Role, settings: &TraceSettings) -> Result<f64, Invalid> {
    let axis = match role {
        Role::X | Role::SetpointX => 0,
        Role::Y | Role::SetpointY => 1,
        _ => {
            let remedy = "export the log in mm and degrees";
            return Err(Invalid::whole("unit", "is counts in a log of all axes", remedy));
        }
    };
    let Some(count_mm) = settings.count_mm else {
        let remedy = "give `count_mm`, negative where an axis counts backwards";
        return Err(Invalid::whole("count_mm", "is not in a log in counts", remedy));
    };
    Ok(count_mm[axis])
}

/// Returns the switch of the tool at every sample, true for 1 and false for 0. Refuses other numbers.
fn switched(column: &Column) -> Result<Vec<bool>, Invalid> {
    if let Some(i) = column.values.iter().position(|v| *v != 0.0 && *v != 1.0) {
        let remedy = "a switch of the tool is 0 (off) or 1 (on); give such a column, or the beam current as `current`";
        return Err(Invalid::at_index("tool_on", i, format!("is {}", column.values[i]), remedy));
    }
    Ok(column.values.iter().map(|v| *v == 1.0).collect())
}

/// Returns the current over the nominal current at every sample, which is the removal rate relative to the TIF.
/// Negative ratios down to `-MOST_NEGATIVE_CURRENT` become 0. Refuses an absent `nominal`, lower ratios, and ratios
/// above `LARGEST_RATE_FACTOR`. Refuses currents that are nowhere above zero, or whose largest ratio is below 1 /
/// `LARGEST_RATE_FACTOR`.
fn rate_factor(
    column: &Column,
    nominal: Option<f64>,
    warnings: &mut Vec<String>,
) -> Result<Vec<f64>, Invalid> {
    let nominal = nominal.ok_or_else(|| {
        let remedy =
            "give `nominal_current`, at which the TIF was measured, in the unit of the log";
        Invalid::whole("nominal_current", "is not in a log", remedy)
    })?;
    let mut below = 0;
    let mut factors = Vec::with_capacity(column.values.len());
    for (i, current) in column.values.iter().enumerate() {
        let factor = current / nominal;
        if factor < -MOST_NEGATIVE_CURRENT || !factor.is_finite() {
            let problem = format!("is {current}, with the nominal current {nominal}");
            let remedy = "check the sign and the column of the current";
            return Err(Invalid::at_index("current", i, problem, remedy));
        }
        if factor > LARGEST_RATE_FACTOR {
            return Err(Invalid::at_index("current", i, other_unit(*current, nominal), SAME_UNIT));
        }
        below += usize::from(factor < 0.0);
        factors.push(factor.max(0.0));
    }
    if below > 0 {
        warnings.push(format!("the current is slightly below zero in {below} samples: taken as 0"));
    }
    let largest = factors.iter().copied().fold(0.0, f64::max);
    if largest == 0.0 {
        let remedy = "check the column of the current";
        return Err(Invalid::whole("current", "is nowhere above zero", remedy));
    }
    if largest < LARGEST_RATE_FACTOR.recip() {
        let i = factors.iter().position(|f| *f == largest).unwrap_or(0);
        return Err(Invalid::at_index(
            "current",
            i,
            other_unit(largest * nominal, nominal),
            SAME_UNIT,
        ));
    }
    let on: Vec<f64> = factors.iter().copied().filter(|f| *f > BEAM_ON * largest).collect();
    let mean = on.iter().sum::<f64>() / on.len() as f64;
    if !(USUAL_RATE_FACTOR.recip()..=USUAL_RATE_FACTOR).contains(&mean) {
        warnings.push(format!(
            "the mean current with the beam on is {}, and `nominal_current` is {}: the tool removes {} times as fast \
             as its TIF says",
            significant(mean * nominal, 4),
            significant(nominal, 4),
            significant(mean, 3)
        ));
    }
    Ok(factors)
}

const SAME_UNIT: &str =
    "give the nominal current in the unit of the log, or check the column of the current";

/// Returns the problem text for a `current` that cannot be in the unit of the current `nominal`.
fn other_unit(current: f64, nominal: f64) -> String {
    format!(
        "is {}, and `nominal_current` is {}: the tool would remove {} times as fast as its TIF says",
        significant(current, 4),
        significant(nominal, 4),
        significant(current / nominal, 3)
    )
}

impl Trace {
    /// Refuses measured positions and setpoints, mm or degrees, that are beyond `is_plausible_mm`: a sign of a wrong
    /// unit.
    fn check_plausible(&self) -> Result<(), Invalid> {
        let all = [Some(&self.actual_mm), self.setpoint_mm.as_ref()];
        for positions in all.into_iter().flatten() {
            let far = positions.iter().position(|p| !p.iter().all(|v| is_plausible_mm(*v)));
            if let Some(i) = far {
                let problem = format!("is {:?} mm", positions[i]);
                return Err(Invalid::at_index(
                    "position",
                    i,
                    problem,
                    "check `unit` and `count_mm`",
                ));
            }
        }
        for positions in &self.axes {
            if let Some(i) = positions.iter().position(|v| !is_plausible_mm(*v)) {
                let problem = format!("is {} mm or degrees", positions[i]);
                return Err(Invalid::at_index(
                    "position",
                    i,
                    problem,
                    "check `unit` and `angle_unit`",
                ));
            }
        }
        Ok(())
    }

    /// Returns the measured positions of each axis, with its name and unit, for the search for jumps.
    fn positions(&self, settings: &TraceSettings) -> Vec<jumps::LoggedAxis<'_>> {
        let time_s = &self.time_s;
        if !self.axes.is_empty() {
            let columns = settings.columns.axes.iter().zip(&self.axes);
            let axes = columns.map(|(column, positions)| jumps::LoggedAxis {
                name: column.name.clone(),
                unit: if column.is_rotary { "deg" } else { "mm" },
                time_s,
                positions: positions.as_slice().into(),
            });
            return axes.collect();
        }
        let axes = ["x", "y"].into_iter().enumerate().map(|(a, name)| jumps::LoggedAxis {
            name: name.to_string(),
            unit: "mm",
            time_s,
            positions: self.actual_mm.iter().map(|p| p[a]).collect(),
        });
        axes.collect()
    }

    /// Returns the samples from `from_s` to `until_s` of the settings. Refuses a range with fewer than two, and limits
    /// that are no numbers.
    fn cropped(mut self, settings: &TraceSettings) -> Result<Self, Invalid> {
        let from_s = settings.from_s.unwrap_or(0.0);
        let until_s = settings.until_s.unwrap_or(f64::INFINITY);
        let first = self.time_s.partition_point(|t| *t < from_s);
        let end = self.time_s.partition_point(|t| *t <= until_s);
        if first + 2 > end || from_s.is_nan() || until_s.is_nan() {
            let problem = format!("is {from_s} s, `until_s` {until_s} s");
            let last = self.time_s[self.time_s.len() - 1];
            let remedy = format!("the log goes from 0 to {last} s; leave two samples or more");
            return Err(Invalid::whole("from_s", problem, remedy));
        }
        fn keep<T>(values: &mut Vec<T>, first: usize, end: usize) {
            values.truncate(end);
            values.drain(..first);
        }
        keep(&mut self.time_s, first, end);
        keep(&mut self.actual_mm, first, end);
        self.axes.iter_mut().for_each(|values| keep(values, first, end));
        if let Some(values) = &mut self.setpoint_mm {
            keep(values, first, end);
        }
        if let Some(values) = &mut self.tool_on {
            keep(values, first, end);
        }
        if let Some(values) = &mut self.rate_factor {
            keep(values, first, end);
        }
        Ok(self)
    }

    /// Returns true for every interval between two samples in which the tool removed (n-1). The switch must be on, and
    /// the mean current of the interval above half of the largest current. Only one of both decides if the log lacks
    /// the other; `None` if it has neither.
    pub fn removes(&self) -> Option<Vec<bool>> {
        let intervals = self.time_s.len() - 1;
        let switched = self.tool_on.as_ref().map(|on| on[..intervals].to_vec());
        let Some(w) = &self.rate_factor else { return switched };
        let least = BEAM_ON * w.iter().copied().fold(0.0, f64::max);
        let by_current = w.windows(2).map(|w| 0.5 * (w[0] + w[1]) > least);
        Some(match switched {
            Some(on) => on.into_iter().zip(by_current).map(|(on, beam)| on && beam).collect(),
            None => by_current.collect(),
        })
    }

    /// Returns the switch of the tool in every interval between two samples (n-1), true if on; true everywhere if the
    /// log has no switch.
    fn switched_on(&self) -> Vec<bool> {
        let intervals = self.time_s.len() - 1;
        match &self.tool_on {
            Some(on) => on[..intervals].to_vec(),
            None => vec![true; intervals],
        }
    }

    /// Returns the motion of x and y, with its time from the first sample, and straight lines over gaps. The removal
    /// rate of an interval is the mean of those at its ends. Refuses samples that make no valid motion.
    pub fn motion(&self, between: Between) -> Result<Trajectory, Invalid> {
        let gap_s = self.clock.longest_step_s();
        let motion = motion::through(&self.time_s, &self.actual_mm, gap_s, between)?;
        let motion = Trajectory::new(
            motion.break_time_s().to_vec(),
            motion.coefficient_mm().to_vec(),
            self.switched_on(),
            vec![None; motion.len()],
        )?;
        match &self.rate_factor {
            // The current of an interval is the mean of those at its ends.
            Some(w) => motion.with_rate_factor(w.windows(2).map(|w| 0.5 * (w[0] + w[1])).collect()),
            None => Ok(motion),
        }
    }

    /// Returns the motion of all axes of a machine, with its time from the first sample, and straight lines over gaps.
    /// Refuses samples that make no valid motion.
    pub fn axes_motion(&self, between: Between) -> Result<AxesMotion, Invalid> {
        let gap_s = self.clock.longest_step_s();
        let by_axis: Vec<Vec<[f64; 4]>> = (self.axes.iter())
            .map(|positions| motion::pieces(&self.time_s, positions, gap_s, between))
            .collect();
        let k = self.time_s.len() - 1;
        let coefficient = (0..k).flat_map(|i| by_axis.iter().map(move |axis| axis[i])).collect();
        AxesMotion::new(self.time_s.clone(), coefficient, self.switched_on(), vec![None; k])
    }

    /// Returns the commanded motion through the setpoints, or `None` if the log has none. The tool is on everywhere in
    /// it. Refuses samples that make no valid motion.
    pub fn setpoint(&self, between: Between) -> Result<Option<Trajectory>, Invalid> {
        let Some(setpoint_mm) = &self.setpoint_mm else { return Ok(None) };
        let gap_s = self.clock.longest_step_s();
        motion::through(&self.time_s, setpoint_mm, gap_s, between).map(Some)
    }
}

#[cfg(test)]
mod tests;
