//! Motion controllers: grids of their positions, velocities and times, and their motion between two
//! nodes.
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
//!
//! The default count is that of an encoder, 0.1 um: no manual states it.

use serde::{Deserialize, Serialize};

use crate::Invalid;

/// Kind of controller; it decides the format of the program.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ControllerKind {
    /// Galil DMC, PVT mode.
    Galil,
    /// Newport XPS, PVT trajectory file.
    Xps,
    /// Delta Tau / Omron PMAC, PVT mode.
    Pmac,
    /// G-code as LinuxCNC runs it.
    Gcode,
    /// Table of the motion.
    Csv,
}

/// Motion of an axis between two nodes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Interpolation {
    /// The cubic through positions and velocities of both nodes.
    Hermite,
    /// The straight line at constant speed.
    Linear,
}

/// The controller as a machine file states it, not checked yet.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, rename = "Controller")]
pub struct ControllerFile {
    /// Kind of controller.
    pub kind: ControllerKind,
    /// Clock: node times are multiples of it, s.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tick_s: Option<f64>,
    /// Count of the axes [x, y]: node positions are multiples of it, mm.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub count_mm: Option<[f64; 2]>,
    /// Resolution of a velocity, mm/s.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub velocity_mm_per_s: Option<f64>,
    /// Shortest segment, s.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub min_segment_s: Option<f64>,
    /// Largest number of segments of a program.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max_segments: Option<usize>,
    /// Motion between two nodes.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub interpolation: Option<Interpolation>,
    /// True if the program switches the tool.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub switches_tool: Option<bool>,
}

/// A controller: every number positive and finite.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct ControllerModel {
    /// Kind of controller.
    pub kind: ControllerKind,
    /// Clock, s.
    pub tick_s: f64,
    /// Count of the axes [x, y], mm.
    pub count_mm: [f64; 2],
    /// Resolution of the velocity of the axes [x, y], mm/s.
    pub velocity_mm_per_s: [f64; 2],
    /// Shortest segment, s.
    pub min_segment_s: f64,
    /// Largest number of segments of a program; `None` if there is no limit.
    pub max_segments: Option<usize>,
    /// Motion between two nodes.
    pub interpolation: Interpolation,
    /// True if the program switches the tool.
    pub switches_tool: bool,
}

/// Default count of an encoder, mm: 0.1 um. Larger: positions in a program are rounded more.
/// Smaller: a program states positions that the encoder does not resolve. Chosen: the count of a
/// linear encoder of a figuring machine.
const COUNT_MM: f64 = 1e-4;

/// Default resolution of a velocity in a program that writes decimals, mm/s: the last of nine
/// decimals. Larger: velocities in a program are rounded more.
const LAST_DECIMAL_MM_PER_S: f64 = 1e-9;

/// Default clock and shortest segment of a Galil, s: two samples at TM 1000. Larger: the program
/// follows the plan less closely. Smaller: the controller refuses the program (DMC-40x0 command
/// reference, PV).
const TWO_SAMPLES_S: f64 = 2.0 / 1024.0;

impl ControllerKind {
    /// The name in files and on command lines.
    pub fn name(self) -> &'static str {
        match self {
            Self::Galil => "galil",
            Self::Xps => "xps",
            Self::Pmac => "pmac",
            Self::Gcode => "gcode",
            Self::Csv => "csv",
        }
    }

    /// The controller with every default of the table.
    pub fn model(self) -> ControllerModel {
        // Clock, shortest segment, velocity (none: a count per second), law, tool.
        let (tick_s, min_segment_s, velocity, interpolation, switches_tool) = match self {
            Self::Galil => (TWO_SAMPLES_S, TWO_SAMPLES_S, COUNT_MM, Interpolation::Hermite, false),
            Self::Xps => (1e-4, 1e-4, LAST_DECIMAL_MM_PER_S, Interpolation::Hermite, false),
            Self::Pmac => (1e-3, 1e-3, LAST_DECIMAL_MM_PER_S, Interpolation::Hermite, false),
            Self::Gcode => (1e-6, 1e-3, LAST_DECIMAL_MM_PER_S, Interpolation::Linear, true),
            Self::Csv => (1e-6, 1e-6, LAST_DECIMAL_MM_PER_S, Interpolation::Hermite, true),
        };
        ControllerModel {
            kind: self,
            tick_s,
            count_mm: [COUNT_MM; 2],
            velocity_mm_per_s: [velocity; 2],
            min_segment_s,
            max_segments: None,
            interpolation,
            switches_tool,
        }
    }
}

impl ControllerModel {
    /// The controller with another clock or other counts, if they are given. Refuses numbers that
    /// are not positive.
    pub fn with(self, tick_s: Option<f64>, count_mm: Option<[f64; 2]>) -> Result<Self, Invalid> {
        let number = |name: &'static str, v: f64| match v.is_finite() && v > 0.0 {
            true => Ok(v),
            false => Err(Invalid::whole(name, format!("is {v}"), "give a positive number")),
        };
        let mut model = self;
        if let Some(tick_s) = tick_s {
            model.tick_s = number("tick_s", tick_s)?;
            model.min_segment_s = model.min_segment_s.max(tick_s);
        }
        if let Some(count_mm) = count_mm {
            count_mm.iter().try_for_each(|c| number("count_mm", *c).map(drop))?;
            model.count_mm = count_mm;
            if model.kind == ControllerKind::Galil {
                model.velocity_mm_per_s = count_mm;
            }
        }
        Ok(model)
    }
}

impl ControllerFile {
    /// A controller that states its kind only, so that every other number is the default.
    pub fn new(kind: ControllerKind) -> Self {
        Self {
            kind,
            tick_s: None,
            count_mm: None,
            velocity_mm_per_s: None,
            min_segment_s: None,
            max_segments: None,
            interpolation: None,
            switches_tool: None,
        }
    }

    /// The checked controller, with the defaults of its kind. Refuses settings that no controller
    /// of the kind supports.
    pub fn checked(&self) -> Result<ControllerModel, Invalid> {
        let default = self.kind.model();
        let number = |name: &'static str, given: Option<f64>, default: f64| match given {
            Some(v) if !(v.is_finite() && v > 0.0) => {
                let remedy = "give a positive number, or leave it out for the default";
                Err(Invalid::whole(name, format!("is {v}"), remedy))
            }
            _ => Ok(given.unwrap_or(default)),
        };
        let tick_s = number("controller.tick_s", self.tick_s, default.tick_s)?;
        let count = |axis: usize| {
            let given = self.count_mm.map(|c| c[axis]);
            number("controller.count_mm", given, default.count_mm[axis])
        };
        let count_mm = [count(0)?, count(1)?];
        let least_velocity = |axis: usize| {
            let default = match self.kind {
                ControllerKind::Galil => count_mm[axis],
                _ => default.velocity_mm_per_s[axis],
            };
            number("controller.velocity_mm_per_s", self.velocity_mm_per_s, default)
        };
        // The default segment is no shorter than the clock.
        let shortest = default.min_segment_s.max(tick_s);
        let min_segment_s = number("controller.min_segment_s", self.min_segment_s, shortest)?;
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
        if switches_tool && matches!(self.kind, ControllerKind::Galil | ControllerKind::Xps) {
            let problem = "is true, but no line of such a program can switch an output";
            return Err(Invalid::whole("controller.switches_tool", problem, "leave it out"));
        }
        Ok(ControllerModel {
            kind: self.kind,
            tick_s,
            count_mm,
            velocity_mm_per_s: [least_velocity(0)?, least_velocity(1)?],
            min_segment_s,
            max_segments: self.max_segments,
            interpolation,
            switches_tool,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_the_file_leaves_out_is_the_default() {
        use ControllerKind::*;
        for kind in [Galil, Xps, Pmac, Gcode, Csv] {
            assert_eq!(ControllerFile::new(kind).checked().unwrap(), kind.model(), "{kind:?}");
        }
        let file = ControllerFile {
            count_mm: Some([0.001, 0.002]),
            tick_s: Some(0.004),
            ..ControllerFile::new(Galil)
        };
        let model = file.checked().unwrap();
        // A Galil takes whole counts per second, and no segment is shorter than the clock.
        assert_eq!((model.velocity_mm_per_s, model.min_segment_s), ([0.001, 0.002], 0.004));
    }

    #[test]
    fn another_clock_lengthens_the_shortest_segment() {
        let model = ControllerKind::Galil.model();
        assert_eq!(model.with(None, None).unwrap(), model);
        let slower = model.with(Some(0.004), Some([1e-3; 2])).unwrap();
        assert_eq!((slower.tick_s, slower.min_segment_s), (0.004, 0.004));
        assert_eq!((slower.count_mm, slower.velocity_mm_per_s), ([1e-3; 2], [1e-3; 2]));
        let said = model.with(Some(0.0), None).unwrap_err().to_string();
        assert!(said.contains("tick_s: is 0"), "{said}");
        let said = model.with(None, Some([1e-4, f64::NAN])).unwrap_err().to_string();
        assert!(said.contains("count_mm: is NaN"), "{said}");
    }

    #[test]
    fn what_no_controller_does_is_refused() {
        let said = |file: ControllerFile| file.checked().unwrap_err().to_string();
        let csv = || ControllerFile::new(ControllerKind::Csv);
        for v in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            let tick = ControllerFile { tick_s: Some(v), ..csv() };
            assert!(said(tick).contains("controller.tick_s: is"), "{v}");
            let count = ControllerFile { count_mm: Some([1e-4, v]), ..csv() };
            assert!(said(count).contains("controller.count_mm: is"), "{v}");
        }
        let none = ControllerFile { max_segments: Some(0), ..csv() };
        assert!(said(none).contains("controller.max_segments: is 0"));
        let straight = Some(Interpolation::Linear);
        let galil = ControllerFile::new(ControllerKind::Galil);
        let linear = ControllerFile { interpolation: straight, ..galil.clone() };
        assert!(said(linear).contains("controller.interpolation"));
        let gcode = ControllerFile::new(ControllerKind::Gcode);
        assert!(ControllerFile { interpolation: straight, ..gcode }.checked().is_ok());
        let switches = ControllerFile { switches_tool: Some(true), ..galil };
        assert!(said(switches).contains("controller.switches_tool"));
    }
}
