//! Motion controllers: rounding of their positions, velocities and times, and their motion between two nodes. A node is
//! an end of a segment in the program of the controller.
//!
//! [`ControllerFile`] is the object `controller` of a machine file, unchecked. [`ControllerModel`]
//! is its checked form, which the stages use. Fields that the file omits have the default of the
//! controller:
//!
//! | controller | clock | shortest segment | velocity | law | switches the tool | source |
//! |---|---|---|---|---|---|---|
//! | `galil` | 2/1024 s | 2/1024 s | 1 count/s | Hermite | no | DMC-40x0 command reference, PV (integer counts, counts/s, samples; two samples at least), TM (1024 samples per second) |
//! | `xps` | 0.1 ms | 0.1 ms | 1e-9 mm/s | Hermite | no | XPS-Q8 user's manual EDH0301, 8.3.6 (element time, displacement, velocity as decimals); servo cycle of 0.1 ms |
//! | `pmac` | 1 ms | 1 ms | 1e-9 mm/s | Hermite | by an M-variable | PMAC2 software reference, PVT{data} (integer ms); a Turbo PMAC resolves 0.25 us |
//! | `gcode` | 1 us | 1 ms | none | linear | yes | LinuxCNC user manual, G93, G1, M62; `[EMCMOT]SERVO_PERIOD` of 1 ms |
//! | `csv` | 1 us | 1 us | 1e-9 mm/s | Hermite | yes | our own table |
//! | `ros` | 1 us | 1 ms | 1e-9 mm/s | Hermite | no | ROS 2, trajectory_msgs/JointTrajectory (nanoseconds); joint_trajectory_controller, Trajectory Representation (cubic); a period of 1 kHz |
//! | `aerotech` | 1 ms | 1 ms | 1e-9 mm/s | Hermite | no | EPICS motor module and Lauecollect, AeroBasic PVT (seconds); a trajectory generator of 1 kHz |
//! | `automation1` | 0.1 ms | 1 ms | 1e-9 mm/s | Hermite | no | Automation1 C interface, MovePvt (`double` milliseconds), and motorAutomation1, MovePt |
//! | `sinumerik` | 1 us | 1 ms | none | linear | no | SINUMERIK 840D sl programming manual, G93, G642, CTOL, G4 F |
//! | `sinumerik-poly` | 1 us | 1 ms | 1e-9 mm/s | Hermite | no | SINUMERIK 840D PGA, POLY, PO, PL, FGROUP, UPATH |
//! | `twincat` | 2 ms | 2 ms | 1e-9 mm/s | Hermite | yes | a table for our program in the PLC; the default cycle of the NC task (SAF) |
//! | `xps-pt` | 0.1 ms | 1 ms | none | linear | no | as `xps`; MultipleAxesPTExecution |
//! | `zaber` | 0.1 ms | 1 ms | count / 1.6384 s | Hermite | no | Zaber ASCII protocol, pvt point; the CSV file of its motion library |
//!
//! The default count is that of an encoder, 0.1 um or 1e-4 degrees: no manual states it. LinuxCNC computes with the
//! numbers of the program as they stand, and rounds no position to counts: its default is 1 nm or 1e-6 degrees. So is
//! that of `sinumerik`, `sinumerik-poly`, `twincat` and `xps-pt`. For a rotary axis, read 1e-9 mm/s as 1e-9 deg/s.

use serde::{Deserialize, Serialize};

use crate::{Invalid, MachineAxis, controller_lines::ControllerLines};

/// Largest numbers of linear and of rotary axes of a machine; every controller has a grid for each of them.
const MOST_LINEAR: usize = 3;
const MOST_ROTARY: usize = 2;

/// Kind of controller. It determines the format of the program.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ControllerKind {
    /// Galil DMC, PVT mode.
    Galil,
    /// Newport XPS, PVT trajectory file.
    Xps,
    /// Delta Tau / Omron PMAC, PVT mode.
    Pmac,
    /// G-code in the dialect of LinuxCNC.
    Gcode,
    /// Table of the motion in our own CSV format.
    Csv,
    /// ROS message `trajectory_msgs/JointTrajectory`, as JSON.
    Ros,
    /// Aerotech Ensemble, PVT commands of AeroBasic.
    Aerotech,
    /// Aerotech Automation1, `MovePvt` of AeroScript.
    Automation1,
    /// Siemens SINUMERIK, lines with inverse time.
    Sinumerik,
    /// Siemens SINUMERIK, polynomials.
    SinumerikPoly,
    /// Beckhoff TwinCAT, table of setpoints.
    Twincat,
    /// Newport XPS, PT trajectory file.
    XpsPt,
    /// Zaber, PVT sequence as CSV.
    Zaber,
}

/// Motion of an axis between two nodes, the ends of a segment of the program.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Interpolation {
    /// The cubic through positions and velocities of both nodes.
    Hermite,
    /// The straight line at constant speed between the positions of both nodes.
    Linear,
}

/// The controller as a machine file states it, not checked yet. An absent field has the default of the kind, see the
/// table of the module.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, rename = "Controller")]
pub struct ControllerFile {
    /// Kind of controller, which determines the defaults.
    pub kind: ControllerKind,
    /// Clock period, s: the times of nodes are multiples of it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tick_s: Option<f64>,
    /// Counts of the linear axes, in the order of the axes, mm: the positions of nodes are multiples of them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub count_mm: Option<Vec<f64>>,
    /// Counts of the rotary axes, in the order of the axes, degrees.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub count_deg: Option<Vec<f64>>,
    /// Resolution of the velocities of the linear axes in a program, mm/s.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub velocity_mm_per_s: Option<f64>,
    /// Resolution of the velocities of the rotary axes in a program, deg/s.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub velocity_deg_per_s: Option<f64>,
    /// Shortest duration of a segment, s.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub min_segment_s: Option<f64>,
    /// Largest number of segments of a program.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max_segments: Option<usize>,
    /// Motion between two nodes of a program.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub interpolation: Option<Interpolation>,
    /// True if the program switches the tool.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub switches_tool: Option<bool>,
    /// Lines of the controller's language before the motion, see [`crate::controller_lines`].
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub prologue: Vec<String>,
    /// Lines of the controller's language after the motion.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub epilogue: Vec<String>,
    /// Lines by which the host switches the tool on (Galil, XPS).
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub tool_on: Vec<String>,
    /// Lines by which the host switches the tool off (Galil, XPS).
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub tool_off: Vec<String>,
}

/// Rounding of one axis in the program of a controller.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct AxisGrid {
    /// Count: node positions are multiples of it, mm or deg.
    pub count: f64,
    /// Resolution of a velocity in the program, mm/s or deg/s.
    pub velocity: f64,
}

/// A checked controller with the defaults filled in; every number is positive and finite.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct ControllerModel {
    /// Kind of controller, which determines the format of the program.
    pub kind: ControllerKind,
    /// Clock period, s.
    pub tick_s: f64,
    /// Rounding of the linear axes, in the order of the axes.
    pub linear: [AxisGrid; MOST_LINEAR],
    /// Rounding of the rotary axes, in the order of the axes.
    pub rotary: [AxisGrid; MOST_ROTARY],
    /// Shortest duration of a segment, s.
    pub min_segment_s: f64,
    /// Largest number of segments of a program; `None` if there is no limit.
    pub max_segments: Option<usize>,
    /// Motion between two nodes of a program.
    pub interpolation: Interpolation,
    /// True if the program switches the tool.
    pub switches_tool: bool,
}

/// Default count of an encoder, mm: 0.1 um. Larger: positions in a program are rounded more.
/// Smaller: a program states positions that the encoder does not resolve. Chosen: the count of a
/// linear encoder of a figuring machine.
const COUNT_MM: f64 = 1e-4;

/// Default count of a rotary encoder, degrees. Larger and smaller: as [`COUNT_MM`]. Chosen: at 80 mm from the axis it
/// is 0.14 um.
const COUNT_DEG: f64 = 1e-4;

/// Default count of a program whose positions no encoder rounds, mm or degrees: 1 nm. Larger: path lines at the limit
/// of the acceleration take longer, by the fraction count / (10 D) of their time for the path deviation D. Smaller:
/// more digits. Chosen: this fraction is 2e-5 at 5 um.
const FINE_COUNT: f64 = 1e-6;

/// Default resolution of a velocity in a program that writes decimals, mm/s or deg/s: the last of nine
/// decimals. Larger: velocities in a program are rounded more.
const LAST_DECIMAL_PER_S: f64 = 1e-9;

/// Default clock and shortest segment of a Galil, s: two samples at TM 1000. Larger: the program
/// follows the plan less closely. Smaller: the controller refuses the program (DMC-40x0 command
/// reference, PV).
const TWO_SAMPLES_S: f64 = 2.0 / 1024.0;

/// Units of velocity of a Zaber per count (microstep) and second. A fact of its ASCII protocol.
const ZABER_UNITS_PER_COUNT: f64 = 1.6384;

impl ControllerKind {
    /// Every kind, in the order of help and messages. Command lines, pipelines and messages take their names from here.
    pub const ALL: [Self; 13] = [
        Self::Galil,
        Self::Xps,
        Self::XpsPt,
        Self::Pmac,
        Self::Gcode,
        Self::Csv,
        Self::Ros,
        Self::Aerotech,
        Self::Automation1,
        Self::Sinumerik,
        Self::SinumerikPoly,
        Self::Twincat,
        Self::Zaber,
    ];

    /// Returns the name in files and on command lines, such as `galil`.
    pub fn name(self) -> &'static str {
        self.words().0
    }

    /// Returns the sentence about this kind in help texts: its program, and the units in it.
    pub fn about(self) -> &'static str {
        self.words().1
    }

    fn words(self) -> (&'static str, &'static str) {
        match self {
            Self::Galil => ("galil", "Galil DMC, PVT mode: counts, counts/s, samples"),
            Self::Xps => {
                ("xps", "Newport XPS, PVT trajectory file: dt, dx, vx, dy, vy, further axes")
            }
            Self::Pmac => ("pmac", "Delta Tau / Omron PMAC, PVT mode"),
            Self::Gcode => {
                ("gcode", "G-code for LinuxCNC and its relatives: straight lines, each in its time")
            }
            Self::Csv => ("csv", "Table of the motion: t, x, vx, y, vy, further axes, tool on"),
            Self::Aerotech => {
                ("aerotech", "Aerotech Ensemble, AeroBasic PVT: mm or degrees, s since the start")
            }
            Self::Ros => ("ros", "ROS JointTrajectory as JSON, which is YAML, too: m, rad, s"),
            Self::Automation1 => {
                ("automation1", "Aerotech Automation1, AeroScript MovePvt: mm or degrees, ms")
            }
            Self::Sinumerik => {
                ("sinumerik", "Siemens SINUMERIK, straight lines, each in its time: G93")
            }
            Self::SinumerikPoly => (
                "sinumerik-poly",
                "Siemens SINUMERIK, cubics: POLY along a virtual axis of the time",
            ),
            Self::Twincat => (
                "twincat",
                "Beckhoff TwinCAT, table of setpoints: one row per cycle of the NC task",
            ),
            Self::XpsPt => ("xps-pt", "Newport XPS, PT trajectory file: dt, dx, dy, further axes"),
            Self::Zaber => {
                ("zaber", "Zaber, PVT sequence as CSV: s, mm or degrees, for its motion library")
            }
        }
    }

    /// Returns the kind of this name, or `None` if no kind has it.
    pub fn named(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|kind| kind.name() == name)
    }

    /// Returns the controller with every default of the table in the module.
    pub fn model(self) -> ControllerModel {
        // Clock, shortest segment, law, tool.
        let (tick_s, min_segment_s, interpolation, switches_tool) = match self {
            Self::Galil => (TWO_SAMPLES_S, TWO_SAMPLES_S, Interpolation::Hermite, false),
            Self::Xps => (1e-4, 1e-4, Interpolation::Hermite, false),
            Self::Pmac => (1e-3, 1e-3, Interpolation::Hermite, false),
            Self::Gcode => (1e-6, 1e-3, Interpolation::Linear, true),
            Self::Csv => (1e-6, 1e-6, Interpolation::Hermite, true),
            Self::Ros => (1e-6, 1e-3, Interpolation::Hermite, false),
            Self::Aerotech => (1e-3, 1e-3, Interpolation::Hermite, false),
            Self::Sinumerik => (1e-6, 1e-3, Interpolation::Linear, false),
            Self::SinumerikPoly => (1e-6, 1e-3, Interpolation::Hermite, false),
            Self::Twincat => (2e-3, 2e-3, Interpolation::Hermite, true),
            Self::XpsPt => (1e-4, 1e-3, Interpolation::Linear, false),
            Self::Automation1 | Self::Zaber => (1e-4, 1e-3, Interpolation::Hermite, false),
        };
        // Their numbers are as fine as they are written.
        let is_fine = matches!(
            self,
            Self::Gcode | Self::Sinumerik | Self::SinumerikPoly | Self::Twincat | Self::XpsPt
        );
        ControllerModel {
            kind: self,
            tick_s,
            linear: [self.grid(if is_fine { FINE_COUNT } else { COUNT_MM }); MOST_LINEAR],
            rotary: [self.grid(if is_fine { FINE_COUNT } else { COUNT_DEG }); MOST_ROTARY],
            min_segment_s,
            max_segments: None,
            interpolation,
            switches_tool,
        }
    }

    /// Returns true if a program of this kind has a place for an output that switches the tool.
    pub fn can_switch_tool(self) -> bool {
        match self {
            Self::Galil
            | Self::Xps
            | Self::XpsPt
            | Self::Ros
            | Self::Aerotech
            | Self::Automation1
            | Self::Sinumerik
            | Self::SinumerikPoly
            | Self::Zaber => false,
            Self::Pmac | Self::Gcode | Self::Csv | Self::Twincat => true,
        }
    }

    /// Returns the rounding of an axis with this count, mm or degrees, and the default resolution of the velocity of
    /// the kind.
    fn grid(self, count: f64) -> AxisGrid {
        let velocity = match self {
            Self::Galil => count,
            Self::Zaber => count / ZABER_UNITS_PER_COUNT,
            _ => LAST_DECIMAL_PER_S,
        };
        AxisGrid { count, velocity }
    }
}

/// Counts as a user gives them: one number for all linear or all rotary axes, or one for each.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Counts {
    /// Counts of the linear axes, mm; `None` for those of the controller.
    pub mm: Option<Vec<f64>>,
    /// Counts of the rotary axes, degrees; `None` for those of the controller.
    pub deg: Option<Vec<f64>>,
}

impl Counts {
    /// Returns counts with the same value for all linear axes, mm, and those of the controller for the rotary ones.
    pub fn linear(count_mm: f64) -> Self {
        Self { mm: Some(vec![count_mm]), deg: None }
    }
}

impl ControllerModel {
    /// Returns the controller with the clock period `tick_s` and `counts` where they are given, for a machine with
    /// these axes. Refuses numbers that are not positive, and counts for axes that the machine does not have.
    pub fn with(
        self,
        tick_s: Option<f64>,
        counts: &Counts,
        axes: &[MachineAxis],
    ) -> Result<Self, Invalid> {
        let mut model = self;
        if let Some(tick_s) = tick_s {
            if !(tick_s.is_finite() && tick_s > 0.0) {
                let problem = format!("is {tick_s}");
                return Err(Invalid::whole("tick_s", problem, "give a positive number"));
            }
            model.tick_s = tick_s;
            model.min_segment_s = model.min_segment_s.max(tick_s);
        }
        for (grids, name, counts, rotary) in [
            (&mut model.linear[..], "count_mm", &counts.mm, false),
            (&mut model.rotary[..], "count_deg", &counts.deg, true),
        ] {
            let Some(counts) = counts else { continue };
            let names = names(axes, rotary);
            let counts = match counts[..] {
                [count] => vec![count; names.len()],
                _ => counts.clone(),
            };
            check_counts(name, &counts, &names)?;
            for (grid, count) in grids.iter_mut().zip(counts) {
                let own = model.kind.grid(count);
                grid.count = count;
                // Elsewhere the unit of the velocity does not follow from the count.
                if matches!(model.kind, ControllerKind::Galil | ControllerKind::Zaber) {
                    grid.velocity = own.velocity;
                }
            }
        }
        Ok(model)
    }

    /// Returns the rounding of each of these axes of a machine, in their order.
    pub fn grids(&self, axes: &[MachineAxis]) -> Vec<AxisGrid> {
        let mut linear = self.linear.iter();
        let mut rotary = self.rotary.iter();
        axes.iter()
            .map_while(|axis| if axis.is_rotary { rotary.next() } else { linear.next() })
            .copied()
            .collect()
    }
}

/// Returns the names of the rotary axes if `rotary` is true, else of the linear ones.
fn names(axes: &[MachineAxis], rotary: bool) -> Vec<&'static str> {
    axes.iter().filter(|a| a.is_rotary == rotary).map(|a| a.name).collect()
}

/// Returns the number that the file states, or the default. Refuses a number that is not positive and finite.
fn positive_or(name: &'static str, stated: Option<f64>, default: f64) -> Result<f64, Invalid> {
    match stated {
        Some(v) if !(v.is_finite() && v > 0.0) => {
            let remedy = "give a positive number, or leave it out for the default";
            Err(Invalid::whole(name, format!("is {v}"), remedy))
        }
        _ => Ok(stated.unwrap_or(default)),
    }
}

/// Refuses counts that are not positive, and a number of counts that differs from the number of axes.
fn check_counts(name: &'static str, counts: &[f64], axes: &[&str]) -> Result<(), Invalid> {
    if counts.len() != axes.len() {
        let problem = format!("has {} numbers", counts.len());
        let remedy = match axes {
            [] => "leave it out: the machine has no such axes".into(),
            axes => format!("give one for each of the axes {}", axes.join(", ")),
        };
        return Err(Invalid::whole(name, problem, remedy));
    }
    match counts.iter().find(|c| !(c.is_finite() && **c > 0.0)) {
        Some(c) => Err(Invalid::whole(name, format!("is {c}"), "give a positive number")),
        None => Ok(()),
    }
}

impl ControllerFile {
    /// Returns a controller that states its kind only, so that every other number is the default.
    pub fn new(kind: ControllerKind) -> Self {
        Self {
            kind,
            tick_s: None,
            count_mm: None,
            count_deg: None,
            velocity_mm_per_s: None,
            velocity_deg_per_s: None,
            min_segment_s: None,
            max_segments: None,
            interpolation: None,
            switches_tool: None,
            prologue: Vec::new(),
            epilogue: Vec::new(),
            tool_on: Vec::new(),
            tool_off: Vec::new(),
        }
    }

    /// Returns the checked lines around the motion. Refuses lines that may move an axis, switch the tool on, or break
    /// the program.
    pub(crate) fn checked_lines(&self) -> Result<ControllerLines, Invalid> {
        let Self { prologue, epilogue, tool_on, tool_off, .. } = self.clone();
        ControllerLines { prologue, epilogue, tool_on, tool_off }.checked(self.kind)
    }

    /// Returns the checked controller of a machine with these axes, with the defaults of its kind. Refuses settings
    /// that no controller of the kind supports.
    pub fn checked(&self, axes: &[MachineAxis]) -> Result<ControllerModel, Invalid> {
        let default = self.kind.model();
        let tick_s = positive_or("controller.tick_s", self.tick_s, default.tick_s)?;
        let mut model = default;
        for (grids, name, counts, rotary) in [
            (&mut model.linear[..], "controller.count_mm", &self.count_mm, false),
            (&mut model.rotary[..], "controller.count_deg", &self.count_deg, true),
        ] {
            let Some(counts) = counts else { continue };
            check_counts(name, counts, &names(axes, rotary))?;
            for (grid, count) in grids.iter_mut().zip(counts) {
                *grid = self.kind.grid(*count);
            }
        }
        for (grids, name, velocity) in [
            (&mut model.linear[..], "controller.velocity_mm_per_s", self.velocity_mm_per_s),
            (&mut model.rotary[..], "controller.velocity_deg_per_s", self.velocity_deg_per_s),
        ] {
            for grid in grids {
                grid.velocity = positive_or(name, velocity, grid.velocity)?;
            }
        }
        // The default segment is no shorter than the clock.
        let shortest = default.min_segment_s.max(tick_s);
        let min_segment_s = positive_or("controller.min_segment_s", self.min_segment_s, shortest)?;
        if self.max_segments == Some(0) {
            let remedy = "give at least 1, or leave it out";
            return Err(Invalid::whole("controller.max_segments", "is 0", remedy));
        }
        let interpolation = self.interpolation.unwrap_or(default.interpolation);
        if interpolation != default.interpolation {
            let problem = "is not the law of such a program";
            return Err(Invalid::whole("controller.interpolation", problem, "leave it out"));
        }
        let switches_tool = self.switches_tool.unwrap_or(default.switches_tool);
        if switches_tool && !self.kind.can_switch_tool() {
            let problem = "is true, but no line of such a program can switch an output";
            return Err(Invalid::whole("controller.switches_tool", problem, "leave it out"));
        }
        Ok(ControllerModel {
            kind: self.kind,
            tick_s,
            min_segment_s,
            max_segments: self.max_segments,
            interpolation,
            switches_tool,
            ..model
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{MachineFile, MachineFileAxis};

    /// Returns the axes x and y of a machine.
    fn x_y() -> Vec<MachineAxis> {
        let axis = |name: &str| MachineFileAxis {
            name: name.into(),
            max_velocity_mm_per_s: 1.0,
            max_acceleration_mm_per_s2: 1.0,
            ..MachineFileAxis::default()
        };
        let axes = vec![axis("x"), axis("y")];
        let file = MachineFile { name: "m".into(), axes, ..MachineFile::default() };
        crate::Machine::new(file).unwrap().axes().to_vec()
    }

    /// Returns the axes x, y, and the rotary axis a.
    fn x_y_a() -> Vec<MachineAxis> {
        let mut axes = x_y();
        axes.push(MachineAxis { name: "a", is_rotary: true, ..axes[0].clone() });
        axes
    }

    fn given(mm: &[f64], deg: &[f64]) -> Counts {
        let some = |counts: &[f64]| (!counts.is_empty()).then(|| counts.to_vec());
        Counts { mm: some(mm), deg: some(deg) }
    }

    #[test]
    fn what_the_file_leaves_out_is_the_default() {
        use ControllerKind::*;
        for kind in ControllerKind::ALL {
            assert_eq!(
                ControllerFile::new(kind).checked(&x_y()).unwrap(),
                kind.model(),
                "{kind:?}"
            );
        }
        let file = ControllerFile {
            count_mm: Some(vec![0.001, 0.002]),
            tick_s: Some(0.004),
            ..ControllerFile::new(Galil)
        };
        let model = file.checked(&x_y()).unwrap();
        // A Galil takes whole counts per second, and no segment is shorter than the clock.
        assert_eq!(
            model.grids(&x_y()).iter().map(|g| g.velocity).collect::<Vec<_>>(),
            [0.001, 0.002]
        );
        assert_eq!(model.min_segment_s, 0.004);
    }

    #[test]
    fn another_clock_lengthens_the_shortest_segment() {
        let model = ControllerKind::Galil.model();
        assert_eq!(model.with(None, &Counts::default(), &x_y()).unwrap(), model);
        let slower = model.with(Some(0.004), &given(&[1e-3], &[]), &x_y()).unwrap();
        assert_eq!((slower.tick_s, slower.min_segment_s), (0.004, 0.004));
        assert_eq!(slower.grids(&x_y()), [AxisGrid { count: 1e-3, velocity: 1e-3 }; 2]);
        let said = model.with(Some(0.0), &Counts::default(), &x_y()).unwrap_err().to_string();
        assert!(said.contains("tick_s: is 0"), "{said}");
        let said =
            model.with(None, &given(&[1e-4, f64::NAN], &[]), &x_y()).unwrap_err().to_string();
        assert!(said.contains("count_mm: is NaN"), "{said}");
    }

    #[test]
    fn every_axis_has_its_own_count() {
        let csv = ControllerKind::Csv.model();
        let model = csv.with(None, &given(&[1e-3, 2e-3], &[5e-4]), &x_y_a()).unwrap();
        let counts: Vec<f64> = model.grids(&x_y_a()).iter().map(|g| g.count).collect();
        assert_eq!(counts, [1e-3, 2e-3, 5e-4]);
        let file = ControllerFile {
            count_deg: Some(vec![2e-4]),
            ..ControllerFile::new(ControllerKind::Galil)
        };
        let grid = file.checked(&x_y_a()).unwrap().grids(&x_y_a())[2];
        assert_eq!(grid, AxisGrid { count: 2e-4, velocity: 2e-4 });
        let said = file.checked(&x_y()).unwrap_err().to_string();
        assert!(said.contains("count_deg: has 1 numbers; leave it out"), "{said}");
        let said = csv.with(None, &given(&[1e-3; 3], &[]), &x_y()).unwrap_err().to_string();
        assert!(said.contains("count_mm: has 3 numbers; give one for each of the axes x, y"));
    }

    #[test]
    fn what_no_controller_does_is_refused() {
        let said = |file: ControllerFile| file.checked(&x_y()).unwrap_err().to_string();
        let csv = || ControllerFile::new(ControllerKind::Csv);
        for v in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            let tick = ControllerFile { tick_s: Some(v), ..csv() };
            assert!(said(tick).contains("controller.tick_s: is"), "{v}");
            let count = ControllerFile { count_mm: Some(vec![1e-4, v]), ..csv() };
            assert!(said(count).contains("controller.count_mm: is"), "{v}");
        }
        let none = ControllerFile { max_segments: Some(0), ..csv() };
        assert!(said(none).contains("controller.max_segments: is 0"));
        let straight = Some(Interpolation::Linear);
        let galil = ControllerFile::new(ControllerKind::Galil);
        let linear = ControllerFile { interpolation: straight, ..galil.clone() };
        assert!(said(linear).contains("controller.interpolation"));
        let gcode = ControllerFile::new(ControllerKind::Gcode);
        assert!(ControllerFile { interpolation: straight, ..gcode }.checked(&x_y()).is_ok());
        let switches = ControllerFile { switches_tool: Some(true), ..galil };
        assert!(said(switches).contains("controller.switches_tool"));
    }
}
