//! Reads programs of motion controllers back, as the motion that the controller will run.
//!
//! This module follows the manuals of the controllers, not `planish export`. The two share no code, so that
//! an error in one of them is not hidden by the same error in the other.
//!
//! | module | program | motion between two lines |
//! |---|---|---|
//! | [`galil`] | `PVA=dP,V,T` in counts and samples | cubic (Hermite) |
//! | [`xps`] | `dt, dx, vx, dy, vy`; `dt, dx, dy` | cubic (Hermite); straight, joined by parabolas |
//! | [`pmac`] | `PVT<ms>`, `X<p>:<v> Y<p>:<v>` | cubic (Hermite) |
//! | [`gcode`] | `G93` or `G94`, `G1 X Y F` | straight, at constant speed; joined by parabolas after `G64 P` |
//! | [`csv`] | `t, x, vx, y, vy, tool on` | cubic (Hermite) |
//! | [`aerotech`] | `PVT X p,v Y p,v TIME t` | cubic (Hermite) |
//! | [`automation1`] | `MovePvt([X, Y], [p, p], [v, v], ms)` | cubic (Hermite) |
//! | [`ros`] | `joint_names`, `points` with `positions`, `velocities`, `time_from_start` | cubic (Hermite) |
//! | [`sinumerik`] | `G93`, `G1 X Y F`; `POLY`, `PO[X]=(end,a2,a3)`, `PL` | straight, joined after `G642`; the polynomial |
//! | [`twincat`] | one row per cycle | cubic (Hermite) |
//! | [`zaber`] | `Time (s),x Position (mm),x Velocity (mm/s)` | cubic (Hermite) |
//!
//! [`Configuration`] states what a program does not say: the position of the axes before it, and the length of an
//! encoder count. Without a list of axes a program moves x and y.

pub mod aerotech;
mod around;
pub mod automation1;
pub mod csv;
pub mod galil;
pub mod gcode;
mod lines;
pub mod pmac;
pub mod ros;
pub mod sinumerik;
pub mod twincat;
pub mod xps;
pub mod zaber;

use planish_types::{AxesMotion, ControllerKind, Invalid, Trajectory, TransformNumbers};
use serde::{Deserialize, Serialize};

/// Settings of the controller for reading a program. A program that needs a setting is refused without it, with a
/// message that asks for it.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Configuration {
    /// Position of the axes [x, y] before the program starts, mm.
    pub start_mm: Option<[f64; 2]>,
    /// Length of an encoder count of [x, y], mm. A Galil program needs it.
    pub count_mm: Option<[f64; 2]>,
    /// Axes that the program moves, in the order in which its lines list their numbers. If empty, it moves x and y.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub axes: Vec<ProgramAxis>,
    /// Sample time of the controller, s. A Galil program needs it, unless the program states it (`TM`).
    pub sample_s: Option<f64>,
    /// Time unit of the velocities of a PMAC program, s: 1e-3 for mm/ms. The program may state it itself (`Isx90`).
    pub feedrate_time_unit_s: Option<f64>,
    /// Transform from the part to the axes with which the program was written. Its inverse takes the motion back to the
    /// part; `None` leaves the motion in the coordinates of the program.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub part_to_axes: Option<TransformNumbers>,
    /// True if the motion that was exported was in the coordinates of the machine. The motion that is read back then is
    /// in them, too.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub was_on_axes: bool,
    /// True if the program is a dry run, with the tool off throughout.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub dry_run: bool,
    /// Run-up and run-down of a program between two marks of another one; `None` for a whole program.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub excerpt: Option<RampTimes>,
    /// BLAKE3 hash of the program that this configuration belongs to; `None` if it was written by hand.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub program_blake3: Option<String>,
}

/// Times in which a program between two marks speeds up and slows down with the tool off, s.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct RampTimes {
    /// Time from the start of the motion to the first mark, s.
    pub run_up_s: f64,
    /// Time from the last mark to the end of the motion, s.
    pub run_down_s: f64,
}

/// An axis of a program that lists its axes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ProgramAxis {
    /// Name of the axis: x, y, z, r, a, b or c.
    pub name: String,
    /// Unit of its positions, mm or deg.
    pub unit: String,
    /// Position of the axis before the program starts, in its unit.
    pub start: f64,
    /// Length or angle of an encoder count, in the unit of the axis.
    pub count: f64,
}

/// Axes that a program moves: their names, units, positions before the program, and sizes of a count.
struct Layout {
    /// Names of the axes, in the order in which the lines of the program list their numbers.
    names: Vec<String>,
    /// Units of the axes, mm or deg.
    units: Vec<String>,
    start: Option<Vec<f64>>,
    count: Option<Vec<f64>>,
}

impl Layout {
    /// Returns the number of axes that the program moves.
    fn len(&self) -> usize {
        self.names.len()
    }

    /// Returns the letter of every axis in a PMAC or G-code program. The radius `r` of a spindle has the letter X.
    fn letters(&self) -> Vec<char> {
        let first = self.names.iter().map(|name| name.chars().next().unwrap_or('?'));
        first.map(|letter| if letter == 'r' { 'X' } else { letter.to_ascii_uppercase() }).collect()
    }

    /// Returns true if at least one axis is a rotation (its unit is deg).
    fn turns(&self) -> bool {
        self.units.iter().any(|unit| unit == "deg")
    }
}

/// Names of the axes that a program may move, with the unit of each.
const AXES: [(&str, &str); 7] =
    [("x", "mm"), ("y", "mm"), ("z", "mm"), ("r", "mm"), ("a", "deg"), ("b", "deg"), ("c", "deg")];

impl Configuration {
    /// Returns the axes of the configuration, x and y if it lists none. Refuses unknown or repeated axes (r and x count
    /// as the same), numbers that are not finite, and a list together with `start_mm` or `count_mm`.
    fn layout(&self) -> Result<Layout, Invalid> {
        if self.axes.is_empty() {
            return Ok(Layout {
                names: vec!["x".into(), "y".into()],
                units: vec!["mm".into(), "mm".into()],
                start: self.start_mm.map(|v| v.to_vec()),
                count: self.count_mm.map(|v| v.to_vec()),
            });
        }
        for (i, axis) in self.axes.iter().enumerate() {
            let is_known = AXES.contains(&(axis.name.as_str(), axis.unit.as_str()));
            // A radius has the letter of x.
            let is_new = self.axes[..i].iter().all(|other| {
                let [a, b] =
                    [other, axis].map(|axis| if axis.name == "r" { "x" } else { &axis.name });
                a != b
            });
            if !(is_known && is_new && axis.start.is_finite() && axis.count.is_finite()) {
                let problem = format!("is {axis:?}");
                let remedy =
                    "give x or r, y, z in mm or a, b, c in deg, each once, with finite numbers";
                return Err(Invalid::at_index("axes", i, problem, remedy));
            }
        }
        if self.start_mm.is_some() || self.count_mm.is_some() {
            let remedy = "leave out `start_mm` and `count_mm`: the list of axes has these numbers";
            return Err(Invalid::whole("axes", "are given beside numbers of x and y", remedy));
        }
        Ok(Layout {
            names: self.axes.iter().map(|a| a.name.clone()).collect(),
            units: self.axes.iter().map(|a| a.unit.clone()).collect(),
            start: Some(self.axes.iter().map(|a| a.start).collect()),
            count: Some(self.axes.iter().map(|a| a.count).collect()),
        })
    }

    /// Returns this configuration, completed with the settings of `about`, the file written together with the program.
    /// Settings that are present in both stay as they are here; `was_on_axes` is true if it is true in one of them.
    pub fn completed_by(self, about: Self) -> Self {
        Self {
            start_mm: self.start_mm.or(about.start_mm),
            count_mm: self.count_mm.or(about.count_mm),
            axes: if self.axes.is_empty() { about.axes } else { self.axes },
            sample_s: self.sample_s.or(about.sample_s),
            feedrate_time_unit_s: self.feedrate_time_unit_s.or(about.feedrate_time_unit_s),
            part_to_axes: self.part_to_axes.or(about.part_to_axes),
            was_on_axes: self.was_on_axes || about.was_on_axes,
            dry_run: self.dry_run || about.dry_run,
            excerpt: self.excerpt.or(about.excerpt),
            program_blake3: self.program_blake3.or(about.program_blake3),
        }
    }
}

/// Reads a program of `controller` as the motion of x and y that it makes. The motion is in the coordinates of the
/// part if the configuration has the transform from the part to the axes.
///
/// # Errors
/// Refuses a configuration with a list of axes, which [`read_axes`] reads, a configuration of another program, and what
/// the reader of the controller refuses. Refuses a transform that has no inverse.
pub fn read(
    controller: ControllerKind,
    bytes: &[u8],
    configuration: &Configuration,
) -> Result<Trajectory, Invalid> {
    if !configuration.axes.is_empty() {
        let problem = "are given, and a trajectory moves x and y";
        return Err(Invalid::whole("axes", problem, "read a motion of all axes"));
    }
    let motion = read_axes(controller, bytes, configuration)?;
    let coefficients = (0..motion.len()).map(|i| {
        let c = motion.segment(i);
        [c[0], c[1]]
    });
    let trajectory = Trajectory::new(
        motion.break_time_s().to_vec(),
        coefficients.collect(),
        motion.tool_on().to_vec(),
        motion.dwell_index().to_vec(),
    )?;
    match &configuration.part_to_axes {
        Some(numbers) => numbers.checked()?.inverse()?.trajectory(&trajectory),
        None => Ok(trajectory),
    }
}

/// Reads a program of `controller` as the motion of all axes that it makes, in the coordinates of the program. The axes
/// are those that the configuration lists, or x and y if it lists none.
///
/// # Errors
/// Refuses a configuration of another program or with wrong axes, and what the reader of the controller refuses.
pub fn read_axes(
    controller: ControllerKind,
    bytes: &[u8],
    configuration: &Configuration,
) -> Result<AxesMotion, Invalid> {
    belongs(bytes, configuration)?;
    let text = crate::text::text("program", bytes)?;
    let head = around::head(&text)?;
    if let Some([k, n]) = head.part {
        let remedy = "give all parts, in their order";
        return Err(Invalid::whole("program", format!("is part {k} of {n}"), remedy));
    }
    let text = around::without_machine_lines(controller, &text)?;
    let text = text.as_ref();
    let layout = configuration.layout()?;
    let motion = match controller {
        ControllerKind::Galil => galil::read(text, configuration, &layout),
        ControllerKind::Xps => xps::read(text, &layout),
        ControllerKind::Pmac => pmac::read(text, configuration, &layout),
        ControllerKind::Gcode => gcode::read(text, &layout),
        ControllerKind::Csv => csv::read(text, &layout),
        ControllerKind::Ros => ros::read(text, &layout),
        ControllerKind::Aerotech => aerotech::read(text, &layout),
        ControllerKind::Automation1 => automation1::read(text, &layout),
        ControllerKind::Sinumerik | ControllerKind::SinumerikPoly => sinumerik::read(text, &layout),
        ControllerKind::Twincat => twincat::read(text, &layout),
        ControllerKind::XpsPt => xps::read_pt(text, &layout),
        ControllerKind::Zaber => zaber::read(text, &layout),
    }?;
    around::with_tool(motion, &head, configuration)
}

/// Returns the program whose parts are `parts`, in their order, each with the hash that the file beside it states. The
/// parts are those of a program that runs from one to the next without a stop.
///
/// # Errors
/// Refuses a part with another hash, a part that was changed, is missing or in the wrong place, and files that are no
/// such parts; the index of the part comes with the error.
pub fn join(parts: &[(Vec<u8>, Configuration)]) -> Result<Vec<u8>, (usize, Invalid)> {
    let texts = parts.iter().enumerate().map(|(i, (bytes, configuration))| {
        belongs(bytes, configuration).map_err(|e| (i, e))?;
        crate::text::text("program", bytes).map_err(|e| (i, e))
    });
    let texts: Vec<_> = texts.collect::<Result<_, _>>()?;
    around::joined(&texts).map(String::into_bytes)
}

/// Returns true if the program, or the file beside it, says that it is a dry run, with the tool off throughout.
pub fn is_dry_run(bytes: &[u8], configuration: &Configuration) -> bool {
    let text = crate::text::text("program", bytes).unwrap_or_default();
    configuration.dry_run || around::head(&text).is_ok_and(|head| head.is_dry_run)
}

/// Returns a doubt about a program: a text on a probable mistake that may also be intended. Only dwells of G-code are
/// looked at; for all other programs it returns `None`.
pub fn doubt(controller: ControllerKind, bytes: &[u8]) -> Option<String> {
    let text = crate::text::text("program", bytes).ok()?;
    match controller {
        ControllerKind::Gcode => gcode::doubt_of_dwell(&text),
        _ => None,
    }
}

/// Refuses a configuration whose hash is that of another program. Its count size or start position would give this
/// program another motion.
fn belongs(bytes: &[u8], configuration: &Configuration) -> Result<(), Invalid> {
    let Some(expected) = &configuration.program_blake3 else { return Ok(()) };
    let hash = blake3::hash(bytes).to_hex();
    if expected.eq_ignore_ascii_case(&hash) {
        return Ok(());
    }
    let short: String = expected.chars().take(16).collect();
    let problem = format!(
        "is {short:?}... in the file of `about`, that of the program is \"{}\"...",
        &hash[..16]
    );
    let remedy = "give the file that was written with this program, or export again";
    Err(Invalid::whole("program_blake3", problem, remedy))
}

/// A state that a program commands (knot of the motion): time since its start (s), positions of the axes (mm or deg)
/// and velocities (mm/s or deg/s).
#[derive(Clone, Debug)]
struct Knot {
    time_s: f64,
    position: Vec<f64>,
    velocity: Vec<f64>,
    /// True if the tool removes material until the next knot.
    tool_on: bool,
}

/// Returns the coefficients of the cubic through the positions `p` and velocities `v` at both ends of the time T =
/// `time_s`:
///
/// ```text
/// p(u) = p0 + v0 u + (3 (p1 - p0)/T - 2 v0 - v1)/T u^2 + (v0 + v1 - 2 (p1 - p0)/T)/T^2 u^3
/// ```
fn hermite(p: [f64; 2], v: [f64; 2], time_s: f64) -> [f64; 4] {
    let mean = (p[1] - p[0]) / time_s;
    [
        p[0],
        v[0],
        (3.0 * mean - 2.0 * v[0] - v[1]) / time_s,
        (v[0] + v[1] - 2.0 * mean) / (time_s * time_s),
    ]
}

/// Returns the motion through the knots, with a cubic between two of them on every axis. Refuses fewer than two knots,
/// and times that make no valid motion.
fn through(knots: &[Knot]) -> Result<AxesMotion, Invalid> {
    if knots.len() < 2 {
        return Err(Invalid::whole("program", "moves nothing", "give a program with motion"));
    }
    let mut cubics = Vec::with_capacity(knots.len() * knots[0].position.len());
    for k in knots.windows(2) {
        let time_s = k[1].time_s - k[0].time_s;
        for a in 0..k[0].position.len() {
            let p = [k[0].position[a], k[1].position[a]];
            cubics.push(hermite(p, [k[0].velocity[a], k[1].velocity[a]], time_s));
        }
    }
    let n = knots.len() - 1;
    AxesMotion::new(
        knots.iter().map(|k| k.time_s).collect(),
        cubics,
        knots[..n].iter().map(|k| k.tool_on).collect(),
        vec![None; n],
    )
}

/// Remedy in the messages about a line that cannot be read.
const REMEDY: &str = "correct the line, or leave it out if it moves nothing and switches nothing";

/// Returns the message about a wrong line of the program; `line` is its number, counted from 1.
fn wrong(line: usize, problem: impl Into<String>) -> Invalid {
    Invalid::at_index("program line", line, problem, REMEDY)
}

/// Returns the number in `text`. Refuses text that is no finite number; `line` is the line of the program, for the
/// message.
fn finite(line: usize, text: &str) -> Result<f64, Invalid> {
    text.trim().parse::<f64>().ok().filter(|v| v.is_finite()).ok_or_else(|| {
        let short: String = text.trim().chars().take(20).collect();
        wrong(line, format!("has \"{short}\" where a number should be"))
    })
}

/// Returns the value of a setting that the program needs. Refuses its absence; `name` is that of the setting.
fn needed<T>(name: &'static str, value: Option<T>) -> Result<T, Invalid> {
    value.ok_or_else(|| {
        let remedy = format!("give `{name}`, or `about` with the file beside the program");
        Invalid::whole(name, "is not in such a program", remedy)
    })
}

/// Returns the value `v` of the setting `name`. Refuses a value that is not finite and positive.
fn positive(name: &'static str, v: f64) -> Result<f64, Invalid> {
    if v.is_finite() && v > 0.0 {
        Ok(v)
    } else {
        Err(Invalid::whole(name, format!("is {v}"), "give a positive number"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn configuration() -> Configuration {
        Configuration {
            start_mm: Some([1.0, -2.0]),
            count_mm: Some([0.001, 0.001]),
            sample_s: Some(0.001),
            feedrate_time_unit_s: Some(1.0),
            ..Configuration::default()
        }
    }

    fn message(controller: ControllerKind, text: &str) -> String {
        read(controller, text.as_bytes(), &configuration()).unwrap_err().to_string()
    }

    /// Checks that the motion is 1 mm in x in 0.1 s, then 0.2 s at rest. With `straight` its speed is constant,
    /// otherwise it goes from rest to rest.
    fn is_the_move(trajectory: &Trajectory, straight: bool) {
        assert_eq!(trajectory.len(), 2);
        let t = trajectory.break_time_s();
        assert!((t[1] - 0.1).abs() < 1e-12 && (t[2] - 0.3).abs() < 1e-12, "{t:?}");
        let first = trajectory.segment(0);
        let ends = [first.position_mm(0.0), first.position_mm(0.1)];
        assert!((ends[0][0] - 1.0).abs() < 1e-12 && (ends[1][0] - 2.0).abs() < 1e-12);
        // A cubic from rest to rest: at a quarter of the time 10/64 of the way.
        let quarter = if straight { 0.25 } else { 10.0 / 64.0 };
        assert!((first.position_mm(0.025)[0] - 1.0 - quarter).abs() < 1e-12);
        assert_eq!(trajectory.segment(1).position_mm(0.1), [2.0, -2.0]);
    }

    #[test]
    fn what_is_given_goes_before_the_file_beside_the_program() {
        let given = Configuration { count_mm: Some([0.5; 2]), ..Configuration::default() };
        let about = Configuration { program_blake3: Some("ab".into()), ..configuration() };
        let both = Configuration { count_mm: Some([0.5; 2]), ..about.clone() };
        assert_eq!(given.completed_by(about.clone()), both);
        assert_eq!(Configuration::default().completed_by(about.clone()), about);
    }

    #[test]
    fn the_same_move_in_every_language() {
        let read = |c, text: &str| read(c, text.as_bytes(), &configuration()).unwrap();
        let galil = "' a comment\nPVA=0,0,-1;PVB=0,0,-1\nPVA=1000,0,100\nPVB=0,0,100\nBTAB\n\
                     PVA=0,0,200\nPVB=0,0,200\nPVA=0,0,0;PVB=0,0,0\n";
        is_the_move(&read(ControllerKind::Galil, galil), false);
        is_the_move(&read(ControllerKind::Xps, "0.1, 1, 0, 0, 0\n0.2, 0, 0, 0, 0\n"), false);
        let pmac = "; a comment\nABS\nPVT100\nX2:0 Y-2:0\nPVT200\nX2:0 Y-2:0\n";
        is_the_move(&read(ControllerKind::Pmac, pmac), false);
        let relative = "INC\nPVT100\nX1:0\nPVT200\nX0 Y0\n";
        is_the_move(&read(ControllerKind::Pmac, relative), false);
        // By itself to the start, wherever the axes stand.
        let there = "ABS\nRAPID\nX1 Y-2\nDWELL0\nPVT100\nX2:0 Y-2:0\nPVT200\nX2:0 Y-2:0\n";
        let elsewhere = Configuration { start_mm: None, ..configuration() };
        is_the_move(
            &super::read(ControllerKind::Pmac, there.as_bytes(), &elsewhere).unwrap(),
            false,
        );
        let inverse =
            "%\n(a comment) G21 G90\nG0 X1 Y-2\nG93\nG1 X2 F600 ; on\nG4 P0.2\nG94 F60\nM2\n";
        is_the_move(&read(ControllerKind::Gcode, inverse), true);
        let feed = "g0x1y-2\ng94g1x2f600\ng4p.2\nm2\n";
        is_the_move(&read(ControllerKind::Gcode, feed), true);
        let csv = "# a comment\nt_s,x_mm,vx_mm_per_s,y_mm,vy_mm_per_s,tool_on\n\
                   0,1,0,-2,0,1\n0.1,2,0,-2,0,1\n0.3,2,0,-2,0,1\n";
        is_the_move(&read(ControllerKind::Csv, csv), false);
        let aerotech = "' a comment\r\nprogram\n plane 1\nabs ' absolute\nLinear X 1 Y -2 F 5\nWAIT MOVEDONE X Y\n\
                        VELOCITY ON\nPVT INIT TIME ABS\nPVT Y -2,0 X 2,0 TIME 0.1\n\
                        pvt x 2 , 0 y -2,0 time .3\nEND PROGRAM\n";
        is_the_move(&read(ControllerKind::Aerotech, aerotech), false);
        let relative = "ABS\nVELOCITY ON\nPVT INIT TIME INC\nPVT X 2,0 Y -2,0 TIME 0.1\n\
                        PVT X 2,0 Y -2,0 TIME 0.2\nEND PROGRAM\n";
        is_the_move(&read(ControllerKind::Aerotech, relative), false);
        let automation1 = "// a comment\nprogram\nSetupTaskTargetMode(TargetMode.Absolute)\n\
                           \tSetupTaskTimeUnits(TimeUnits.Seconds)\nMovePvt([X,Y], [2, -2], [0, 0], 100) // on\n\
                           MovePvt([X, Y], [2, -2], [0, 0], 200)\nend\n";
        is_the_move(&read(ControllerKind::Automation1, automation1), false);
        let zaber = "Time (ms),A Position (cm),A Velocity (cm/s),B Position (um),B Velocity (um/s)\n\
                     100,0.2,0,-2000,0\n200,0.2,0,-2000,0\n";
        is_the_move(&read(ControllerKind::Zaber, zaber), false);
        let lines =
            "; a comment\nN10 G17 G90 FGROUP(X,Y)\ng0x1y-2\nG93 G1 X=2 F600 ; on\nG4 F.2\nM30\n";
        is_the_move(&read(ControllerKind::Sinumerik, lines), true);
        // One line between two parabolas of its time, from rest to rest, then the stop.
        let elements = read(ControllerKind::XpsPt, "0.1, 1, 0\n0.2, 0, 0\n");
        assert!((elements.len(), (elements.total_time_s() - 0.4).abs() < 1e-12) == (5, true));
        assert_eq!(elements.segment(4).position_mm(0.1), [2.0, -2.0]);
        // With d = 1: 3 d p^2 / PL^2 - 2 d p^3 / PL^3, once with PL in ms, once with p from 0 to 1, and W at 2 mm/s.
        let poly = "G0 X1 Y-2 W0\nFGROUP(W)\nUPATH\nF60\nPOLY PO[X]=(2,0.0003,-0.000002) W=0.1 PL=100\n\
                    W=0.3 X2\nM30\n";
        is_the_move(&read(ControllerKind::SinumerikPoly, poly), false);
        let unit = "G0 X1 Y-2 W0\nFGROUP(W) UPATH G94 F120\nPOLY\nPO[X]=(2,3,-2) PO[Y]=(-2) W0.2\nW.6 PL=7\nM30\n";
        is_the_move(&read(ControllerKind::SinumerikPoly, unit), false);
        let table = |row: &str| {
            format!(
                "# a comment\ncycle_s,0.1\ncycle,x_mm,vx_mm_per_s,ax_mm_per_s2,y_mm,vy_mm_per_s,ay_mm_per_s2,tool_on,segment\n\
                 0,1,0,600,-2,0,0,1,0\n1,2,0,0,-2,0,0,1,1\n{row}"
            )
        };
        let rows = table("2,2,0,0,-2,0,0,1,1\n3,2,0,0,-2,0,0,0,2\n");
        is_the_move(&read(ControllerKind::Twincat, &rows), false);
        let ros = joint_trajectory(
            "\"y\", \"x\"",
            &[("-0.002, 0.001", 0), ("-0.002, 0.002", 100), ("-0.002, 0.002", 300)],
        );
        is_the_move(&read(ControllerKind::Ros, &ros), false);
        // From where the joints stand, in the words of ROS 1 and with the lists of a message as it is printed.
        let later =
            joint_trajectory("\"x\", \"y\"", &[("0.002, -0.002", 100), ("0.002, -0.002", 300)])
                .replace("sec\":", "secs\":")
                .replace("nanosecs", "nsecs")
                .replace("{\"positions", "{\"accelerations\": [], \"effort\": [], \"positions");
        is_the_move(&read(ControllerKind::Ros, &later), false);
    }

    /// Returns a JointTrajectory of these joints at rest in these points: positions, and the time in ms.
    fn joint_trajectory(joints: &str, points: &[(&str, u32)]) -> String {
        let points = points.iter().map(|(positions, ms)| {
            format!(
                "{{\"positions\": [{positions}], \"velocities\": [{}], \"time_from_start\": {{\"sec\": 0, \"nanosec\": \
                 {}}}}}",
                vec!["0.0"; positions.split(',').count()].join(", "),
                ms * 1_000_000
            )
        });
        let points: Vec<String> = points.collect();
        format!("{{\"joint_names\": [{joints}], \"points\": [{}]}}", points.join(", "))
    }

    /// Checks that everything is refused that would make the motion of a JointTrajectory another one.
    #[test]
    fn a_joint_trajectory_that_is_no_cubic_from_rest_to_rest_is_refused() {
        let points = [("0.001, -0.002", 0), ("0.002, -0.002", 100)];
        let good = joint_trajectory("\"x\", \"y\"", &points);
        assert!(read(ControllerKind::Ros, good.as_bytes(), &configuration()).is_ok());
        let stamp = "\"header\": {\"stamp\": {\"sec\": 1, \"nanosec\": 0}}, \"joint_names";
        for (from, to, expected) in [
            (
                "\"x\", \"y\"",
                "\"x\", \"z\"",
                "joint_names: are [\"x\", \"z\"]; give each of the axes x, y",
            ),
            ("\"x\", \"y\"", "\"x\", \"y\", \"y\"", "joint_names: are [\"x\", \"y\", \"y\"]"),
            ("\"x\", \"y\"", "\"x\", \"x\"", "joint_names: are [\"x\", \"x\"]"),
            ("[0.001, -0.002]", "[0.001]", "points[0]: has 1 positions for 2 joints"),
            ("\"velocities\": [0.0, 0.0], ", "", "points[0]: has 0 velocities for 2 joints"),
            (
                "\"positions",
                "\"accelerations\": [0.0, 0.0], \"positions",
                "points[0]: has accelerations",
            ),
            ("\"positions", "\"effort\": [0.0, 0.0], \"positions", "points[0]: has effort"),
            ("\"positions", "\"jerks\": [], \"positions", "unknown field `jerks`"),
            (
                "[0.0, 0.0]",
                "[0.0, 0.0], \"velocities\": [1.0, 0.0]",
                "duplicate field `velocities`",
            ),
            ("100000000", "0", "points[1]: is at 0 s, which is not later"),
            ("100000000", "1000000000", "points[1]: has the time_from_start 0 s and 1000000000 ns"),
            ("100000000", "1e8", "invalid type: floating point"),
            ("\"sec\": 0", "\"sec\": -1", "points[0]: has the time_from_start -1 s"),
            ("\"joint_names", stamp, "header.stamp: is 1 s and 0 ns"),
            ("0.001, -0.002", "1e999, -0.002", "is no JointTrajectory: number out of range"),
            ("0.001, -0.002", "NaN, -0.002", "is no JointTrajectory: expected value at line 1"),
        ] {
            let said = message_of(&good.replacen(from, to, 1));
            assert!(said.contains(expected), "{to}: {said}");
        }
        let moving = good.replace("[0.0, 0.0]", "[0.0, 0.5]");
        assert!(message_of(&moving).contains("ends with the velocities [0.0, 0.5] m/s or rad/s"));
        assert!(
            message_of(&joint_trajectory("\"x\", \"y\"", &points[..1])).contains("moves nothing")
        );
        assert!(message_of("joint_names: [x, y]\npoints: []\n").contains("of YAML: python3"));
        let nothing = Configuration::default();
        let later = joint_trajectory("\"x\", \"y\"", &points[1..]);
        let said = read(ControllerKind::Ros, later.as_bytes(), &nothing).unwrap_err().to_string();
        assert!(said.contains("`start_mm`"), "{said}");
    }

    /// Checks that everything is refused that an AeroBasic program would lose or do otherwise.
    #[test]
    fn an_aerobasic_program_that_is_not_understood_is_refused() {
        let head = "PROGRAM\nABS\nVELOCITY ON\nPVT INIT TIME ABS\n";
        let line = "PVT X 2,0 Y -2,0 TIME 0.1\n";
        let good = format!("{head}{line}END PROGRAM\n");
        assert!(read(ControllerKind::Aerotech, good.as_bytes(), &configuration()).is_ok());
        for (from, to, expected) in [
            ("END PROGRAM\n", "", "has no END PROGRAM"),
            ("ABS\nV", "V", "line[4]: comes before ABS, VELOCITY ON and PVT INIT TIME"),
            ("VELOCITY ON", "VELOCITY OFF", "line[5]: comes before ABS"),
            ("PVT INIT TIME ABS\n", "", "line[4]: comes before ABS"),
            ("ABS\nV", "INC\nV", "line[2]: has \"INC\", which is not understood"),
            (" TIME 0.1", "", "line[5]: has no TIME"),
            ("TIME 0.1", "TIME 0", "line[5]: ends at 0 s, the line before at 0 s"),
            ("TIME 0.1", "TIME 0.1 F 5", "line[5]: has \"0.1 F 5\" where a number"),
            ("Y -2,0 ", "", "line[5]: does not have all axes"),
            ("Y -2,0", "Z -2,0", "has \"Z -2 0\", not each of X, Y once, with 2 number(s)"),
            ("Y -2,0", "X -2,0", "has \"X -2 0\", not each of X, Y once"),
            ("Y -2,0", "@1 -2,0", "has \"@1 -2 0\", not each of X, Y"),
            ("Y -2,0", "Y -2", "has \"Y -2\", not each of X, Y"),
            ("Y -2,0", "Y A,0", "line[5]: has \"A\" where a number"),
            ("X 2,0", "X 2,1", "ends with the velocity [1.0, 0.0]"),
            ("END PROGRAM", "DWELL 1\nEND PROGRAM", "line[6]: has \"DWELL 1\""),
            ("END PROGRAM", "LINEAR X 9 Y 9\nEND PROGRAM", "line[6]: has \"LINEAR X 9 Y 9\""),
            ("END PROGRAM", "PVT INIT TIME ABS\nEND PROGRAM", "line[6]: has \"PVT INIT TIME ABS\""),
            ("END PROGRAM\n", "END PROGRAM\nABS\n", "line[7]: has \"ABS\" after END PROGRAM"),
            (
                "PROGRAM\nABS",
                "PROGRAM\nLINEAR X 1 Y 1\nABS",
                "line[2]: goes to the start before ABS",
            ),
            ("VELOCITY ON", "LINEAR X 1\nVELOCITY ON", "line[3]: does not have all axes"),
            ("PVT X", "DOUT X,0,1\nPVT X", "line[5]: has \"DOUT X,0,1\""),
        ] {
            let said = message(ControllerKind::Aerotech, &good.replacen(from, to, 1));
            assert!(said.contains(expected), "{to}: {said}");
        }
        let nothing = Configuration::default();
        let said =
            read(ControllerKind::Aerotech, good.as_bytes(), &nothing).unwrap_err().to_string();
        assert!(said.contains("`start_mm`"), "{said}");
        assert!(
            message(ControllerKind::Aerotech, "PROGRAM\nEND PROGRAM\n").contains("moves nothing")
        );
    }

    /// Checks that everything is refused that a SINUMERIK would do otherwise than it is read.
    #[test]
    fn a_sinumerik_program_that_is_not_understood_is_refused() {
        let poly =
            "G0 X1 Y-2 W0\nFGROUP(W)\nUPATH\nF60\nPOLY PO[X]=(2,3,-2) PO[Y]=(-2) W=0.1\nM30\n";
        let lines = "FGROUP(X,Y)\nG0 X1 Y-2\nG93\nG1 X2 F600\nM30\n";
        for (good, from, to, expected) in [
            (poly, "M30\n", "", "does not end with M30"),
            (poly, "M30\n", "M30\nG1\n", "line[7]: goes on after the end"),
            (poly, "UPATH\n", "", "line[4]: moves by POLY without G94, UPATH and a virtual axis"),
            (poly, "FGROUP(W)", "FGROUP(X)", "has W0.1, which is not understood"),
            (poly, "FGROUP(W)", "FGROUP(X,Y)", "has W0.1, which is not understood"),
            (poly, "F60", "G93 F60", "moves by POLY without G94"),
            (poly, "F60\n", "", "has no F before it"),
            (poly, " W=0.1", "", "does not move the axis in FGROUP"),
            (poly, "W=0.1", "W=0.1 PL=0.00001", "lasts 0.1 s with PL=0.00001"),
            (poly, "W=0.1", "W=-0.1", "lasts -0.1 s"),
            (poly, "POLY PO", "PO", "has PO without POLY"),
            (poly, "(2,3,-2)", "(2,3,-2,1)", "has PO[X], which is not understood"),
            (poly, "PO[Y]", "PO[]", "has PO[], which is not understood"),
            (poly, "PO[Y]=(-2)", "PO[X]=(2)", "has X twice"),
            (poly, "G0 X1 Y-2", "G0 X1", "comes before G0 X Y sets the start"),
            (poly, "M30", "G93\nG1 X3 F600\nM30", "moves axes that are not in FGROUP"),
            (poly, "M30", "FGROUP()\nG93\nG1 X3 F600\nM30", "has lines and polynomials"),
            (lines, " F600", "", "line[4]: has no F; G93 wants one"),
            (lines, "G93\n", "", "moves by G94"),
            (lines, "G1 X2", "G1 X1", "has no length"),
            (lines, "G1 X2", "G2 X2", "has G2, which is not understood"),
            (lines, "G1 X2", "G1 X=IC(1)", "has \"X=IC(1)"),
            (lines, "G1 X2", "G1 X2 X3", "has X twice"),
            (lines, "G1 X2", "G91 G1 X2", "has G91"),
            (lines, "G1 X2", "G1 A2", "has A2"),
            (lines, "G1 X2", "G1 X2 M8", "has M8"),
            (lines, "G93\n", "G93\nG4\n", "has G4 without F"),
            (lines, "G93\n", "G93\nWHEN TRUE DO $A_OUT[1]=1\n", "has \"$A_OUT[1]=1\""),
            (lines, "G93\n", "G93\n/G1 X9 F1\n", "has \"/G1 X9 F1\""),
            (lines, "F600", "F-1", "F is -1"),
            (lines, "G1 X2 F600", "G1 X2 F600\nG0 X9 Y9", "has G0 within the motion"),
        ] {
            assert!(read(ControllerKind::Sinumerik, good.as_bytes(), &configuration()).is_ok());
            let said = message(ControllerKind::Sinumerik, &good.replacen(from, to, 1));
            assert!(said.contains(expected), "{to}: {said}");
        }
    }

    /// Checks that joined lines of a SINUMERIK are bounded by CTOL, as those of G-code are by P.
    #[test]
    fn lines_of_a_sinumerik_are_joined_within_their_tolerance() {
        let pieces = |mode: &str| {
            let text = format!("{mode}\nG0 X0 Y0\nG93\nG1 X1 F60\nG1 X4 F60\nM30\n");
            read(ControllerKind::Sinumerik, text.as_bytes(), &configuration()).unwrap().len()
        };
        // The largest change of the velocity is 3 mm/s: 3/8 mm over 1 s.
        let modes = ["G642 CTOL=0.375", "G642 CTOL=0.374", "G642", "G64 CTOL=1", "G60"];
        assert_eq!(modes.map(pieces), [6, 2, 2, 2, 2]);
    }

    /// Checks that everything is refused that would make another motion of the other tables and programs.
    #[test]
    fn setpoints_sequences_and_scripts_that_are_not_understood_are_refused() {
        use ControllerKind::*;
        let table = "cycle_s,0.1\ncycle,x_mm,vx_mm_per_s,ax_mm_per_s2,y_mm,vy_mm_per_s,ay_mm_per_s2,tool_on,segment\n\
                     0,1,0,600,-2,0,0,1,0\n1,2,0,0,-2,0,0,0,1\n";
        let sequence = "Time (s),x Position (mm),x Velocity (mm/s),y Position (mm),y Velocity (mm/s)\n\
                        0.1,2,0,-2,0\n";
        let script = "program\nSetupTaskTargetMode(TargetMode.Absolute)\nSetupTaskTimeUnits(TimeUnits.Seconds)\n\
                      MovePvt([X, Y], [2, -2], [0, 0], 100)\nend\n";
        let elements = "0.1, 1, 0\n";
        for (controller, good, from, to, expected) in [
            (Twincat, table, "cycle_s,0.1\n", "", "cycle_s: is NaN"),
            (Twincat, table, "0.1", "0", "cycle_s: is 0"),
            (Twincat, table, ",tool_on", "", "does not have the header cycle,x_mm"),
            (Twincat, table, "\n1,2", "\n2,2", "line[4]: is cycle 2, not 1"),
            (Twincat, table, "-2,0,0,0,1\n", "-2,0,0,1,1\n", "ends with the tool on"),
            (Twincat, table, "-2,0,0,1", "-2,0,0,2", "has 2 for tool_on"),
            (Twincat, table, ",1,0\n", ",1,0.5\n", "has 0.5 for segment"),
            (
                Twincat,
                table,
                ",1,0\n",
                ",1,1\n",
                "line[3]: is of segment 1, with tool_on true, which does not",
            ),
            (Twincat, table, ",0,1\n", ",0,0\n", "line[4]: is of segment 0, with tool_on false"),
            (Twincat, table, ",600,", ",-600,", "cycle[0]: has [1.0, 0.0, -600.0], and the cubic"),
            (Twincat, table, ",600,", ",", "line[3]: has 8 fields"),
            (
                Zaber,
                sequence,
                "(s)",
                "(min)",
                "line[1]: is not a header such as Time (s),x Position (mm)",
            ),
            (Zaber, sequence, "(mm/s)", "(mm/min)", "is not a header"),
            (Zaber, sequence, "Position (mm)", "Position (deg)", "is not a header"),
            (Zaber, sequence, "0.1,", "0,", "line[2]: lasts 0 s"),
            (Zaber, sequence, ",-2,0", ",-2", "line[2]: has 4 fields, not 5"),
            (Zaber, sequence, ",2,0,", ",2,1,", "ends with the velocity [1.0, 0.0]"),
            (Automation1, script, "end\n", "", "has no end"),
            (Automation1, script, "end\n", "end\nend\n", "line[6]: goes on after end"),
            (
                Automation1,
                script,
                "Absolute",
                "Incremental",
                "line[2]: has \"SetupTaskTargetMode(TargetMode.Incr",
            ),
            (
                Automation1,
                script,
                "SetupTaskTimeUnits(TimeUnits.Seconds)\n",
                "",
                "line[3]: comes before",
            ),
            (
                Automation1,
                script,
                "[X, Y]",
                "[Y, X]",
                "line[4]: has lists that are not of the axes X, Y",
            ),
            (Automation1, script, "[0, 0]", "[0]", "has lists that are not of the axes X, Y"),
            (Automation1, script, ", 100", "", "has a MovePvt without"),
            (Automation1, script, ", 100", ", 0", "lasts 0 s"),
            (Automation1, script, "[0, 0]", "[0, 1]", "ends with the velocity [0.0, 1.0]"),
            (Automation1, script, "MovePvt", "MovePt", "has \"MovePt("),
            (XpsPt, elements, "0.1, 1, 0", "0.1, 1, 0, 0, 0", "has 5 fields, not dt, dx, dy"),
            (XpsPt, elements, "0.1", "0", "lasts 0 s"),
            (XpsPt, elements, "0.1", "# x\n0.1", "a header or a comment"),
            (XpsPt, elements, "0.1, 1, 0\n", "\n", "moves nothing"),
        ] {
            let read_good = read(controller, good.as_bytes(), &configuration());
            assert!(read_good.is_ok(), "{controller:?}: {read_good:?}");
            let said = message(controller, &good.replacen(from, to, 1));
            assert!(said.contains(expected), "{to}: {said}");
        }
        for (controller, good) in [(Zaber, sequence), (Automation1, script), (XpsPt, elements)] {
            let nothing = Configuration::default();
            let said = read(controller, good.as_bytes(), &nothing).unwrap_err().to_string();
            assert!(said.contains("`start_mm`"), "{said}");
        }
    }

    fn message_of(ros: &str) -> String {
        read(ControllerKind::Ros, ros.as_bytes(), &configuration()).unwrap_err().to_string()
    }

    /// Returns a configuration with the axes r, z and c of a spindle.
    fn of_a_spindle() -> Configuration {
        let axis = |name: &str, unit: &str, start: f64, count: f64| ProgramAxis {
            name: name.into(),
            unit: unit.into(),
            start,
            count,
        };
        Configuration {
            start_mm: None,
            count_mm: None,
            axes: vec![
                axis("r", "mm", 1.0, 0.001),
                axis("z", "mm", -2.0, 0.001),
                axis("c", "deg", 10.0, 0.01),
            ],
            ..configuration()
        }
    }

    #[test]
    fn three_axes_make_the_same_move_in_every_language() {
        let galil =
            "PVA=1000,0,100\nPVB=0,0,100\nPVC=500,0,100\nBTABC\nPVA=0,0,0\nPVB=0,0,0\nPVC=0,0,0\n";
        let csv = "t_s,r_mm,vr_mm_per_s,z_mm,vz_mm_per_s,c_deg,vc_deg_per_s,tool_on\n\
                   0,1,0,-2,0,10,0,1\n0.1,2,0,-2,0,15,0,0\n";
        let aerotech =
            "ABS\nVELOCITY ON\nPVT INIT TIME ABS\nPVT X 2,0 Z -2,0 C 15,0 TIME 0.1\nEND PROGRAM\n";
        let [from_rad, to_rad] = [10.0_f64, 15.0].map(f64::to_radians);
        let ends = [format!("-0.002, {from_rad}, 0.001"), format!("-0.002, {to_rad}, 0.002")];
        let ros = joint_trajectory("\"z\", \"c\", \"r\"", &[(&ends[0], 0), (&ends[1], 100)]);
        for (controller, text, part) in [
            (ControllerKind::Galil, galil, 10.0 / 64.0),
            (ControllerKind::Xps, "0.1, 1, 0, 0, 0, 5, 0\n", 10.0 / 64.0),
            (ControllerKind::Pmac, "ABS\nPVT100\nX2:0 Z-2:0 C15:0\n", 10.0 / 64.0),
            (
                ControllerKind::Pmac,
                "ABS\nRAPID\nX1 Z-2 C10\nDWELL0\nPVT100\nX2:0 Z-2:0 C15:0\n",
                10.0 / 64.0,
            ),
            (ControllerKind::Csv, csv, 10.0 / 64.0),
            (ControllerKind::Gcode, "G0 X1 Z-2 C10\nG93\nG1 X2 C15 F600\nM2\n", 0.25),
            (ControllerKind::Ros, &ros, 10.0 / 64.0),
            (ControllerKind::Aerotech, aerotech, 10.0 / 64.0),
            (
                ControllerKind::Zaber,
                "Time (s),r Position (mm),r Velocity (mm/s),z Position (mm),z Velocity (mm/s),\
                 c Position (deg),c Velocity (deg/s)\n0.1,2,0,-2,0,15,0\n",
                10.0 / 64.0,
            ),
            (
                ControllerKind::SinumerikPoly,
                "G0 X1 Z-2 C10\nFGROUP(W) UPATH F60\nPOLY PO[X]=(2,3,-2) PO[C]=(15,15,-10) W0.1\nM30\n",
                10.0 / 64.0,
            ),
            (ControllerKind::Sinumerik, "G0 X1 Z-2 C10\nG93\nG1 X2 C15 F600\nM30\n", 0.25),
        ] {
            let motion = read_axes(controller, text.as_bytes(), &of_a_spindle()).unwrap();
            // A quarter of the time of a move of 1 mm and 5 degrees.
            let found = motion.position(0, 0.025);
            let expected = [1.0 + part, -2.0, 10.0 + 5.0 * part];
            let away = found.iter().zip(expected).map(|(p, q)| (p - q).abs()).fold(0.0, f64::max);
            assert!(found.len() == 3 && away < 1e-12, "{controller:?}: {found:?}");
        }
    }

    /// Checks two lines of 1 s: r by 1 mm and 3 mm, c by 90 degrees and 0. The path tolerance P bounds the corner of r
    /// alone.
    #[test]
    fn joined_lines_of_rotary_axes_are_bounded_along_the_linear_ones() {
        let text = |p: &str| format!("G64 P{p}\nG0 X0 Z0 C0\nG93\nG1 X1 C90 F60\nG1 X4 F60\nM2\n");
        let pieces = |p: &str| {
            read_axes(ControllerKind::Gcode, text(p).as_bytes(), &of_a_spindle()).unwrap().len()
        };
        // The largest change of the velocity of r is 3 mm/s: 3/8 mm over 1 s.
        assert_eq!((pieces("0.375"), pieces("0.374")), (6, 2));
    }

    #[test]
    fn bad_programs_of_all_axes_are_refused() {
        let said = |controller, text: &str, configuration: &Configuration| {
            read_axes(controller, text.as_bytes(), configuration).unwrap_err().to_string()
        };
        let spindle = of_a_spindle();
        for (controller, text, expected) in [
            (
                ControllerKind::Gcode,
                "G0 X0 Z0 C0\nG94\nG1 C9 F60\nM2\n",
                "a feed means nothing for rotary axes",
            ),
            (
                ControllerKind::Gcode,
                "G0 X0 Z0\nG93\nG1 X1 F60\nM2\n",
                "comes before G0 X Z C sets the start",
            ),
            (ControllerKind::Gcode, "G0 X0 Z0 C0\nG93\nG1 Y1 F60\nM2\n", "has the word Y1"),
            (ControllerKind::Galil, "PVD=1,0,100\n", "not PVA=, PVB=, PVC=, or BTABC"),
            (
                ControllerKind::Xps,
                "0.1, 1, 0, 0, 0\n",
                "has 5 fields, not dt, dr, vr, dz, vz, dc, vc",
            ),
            (ControllerKind::Pmac, "ABS\nRAPID\nX1 Z1\nPVT9\nX1:0\n", "without all axes"),
            (ControllerKind::Csv, "t_s,x_mm\n", "is not the header t_s,r_mm,vr_mm_per_s,z_mm"),
        ] {
            let said = said(controller, text, &spindle);
            assert!(said.contains(expected), "{text:?}: {said}");
        }
        let mut twice = of_a_spindle();
        twice.axes[1].name = "x".into();
        assert!(said(ControllerKind::Xps, "", &twice).contains("axes[1]: is ProgramAxis"));
        let beside = Configuration { start_mm: Some([0.0; 2]), ..of_a_spindle() };
        assert!(said(ControllerKind::Xps, "", &beside).contains("beside numbers of x and y"));
        let plane = read(ControllerKind::Xps, b"", &spindle).unwrap_err().to_string();
        assert!(plane.contains("read a motion of all axes"), "{plane}");
    }

    /// Checks two lines of 1 s, 1 mm and 3 mm long. They become parabolas of 1 s around three nodes, with 1, 2 and -3
    /// mm/s^2, from rest to rest.
    #[test]
    fn joined_lines_are_parabolas_at_continuous_velocity() {
        let text = |mode: &str| format!("{mode}\nG0 X0 Y0\nG93\nG1 X1 F60\nG1 X4 F60\nM2\n");
        let read = |mode: &str| {
            read(ControllerKind::Gcode, text(mode).as_bytes(), &Configuration::default()).unwrap()
        };
        let joined = read("G64 P0.375 Q0");
        assert_eq!((joined.len(), joined.total_time_s()), (6, 3.0));
        let mut before = [0.0, 0.0];
        for (k, expected) in [1.0, 1.0, 2.0, 2.0, -3.0, -3.0].into_iter().enumerate() {
            let segment = joined.segment(k);
            let [p, v, half_a, none] = segment.coefficient_mm[0];
            assert_eq!(([p, v], 2.0 * half_a, none), (before, expected, 0.0), "{k}");
            let u = segment.duration_s;
            before = [p + u * (v + u * half_a), v + 2.0 * u * half_a];
        }
        assert_eq!(before, [4.0, 0.0]);
        // The largest change of velocity, 3 mm/s over 1 s, leaves its corner by 3/8 mm; less is not allowed here.
        for mode in ["G64 P0.374", "G61", "G64"] {
            let lines = read(mode);
            assert_eq!((lines.len(), lines.total_time_s()), (2, 2.0), "{mode}");
        }
        let changed = "G64 P1\nG0 X0 Y0\nG93\nG1 X1 F60\nG61\nG1 X4 F60\nM2\n";
        assert!(message(ControllerKind::Gcode, changed).contains("line[5]: changes the path mode"));
    }

    /// Checks joined lines of 0.1 s and 0.1 mm. A group of them begins half a line earlier and ends half a line later;
    /// a dwell adds its P anywhere.
    #[test]
    fn a_dwell_takes_its_time_at_the_beginning_in_the_middle_and_at_the_end() {
        let lines = ["G1 X0.1 F600\n", "G1 X0.2 F600\n", "G1 X0.3 F600\n"];
        let total_s = |mode: &str, parts: &[&str]| {
            let text = format!("{mode}\nG0 X0 Y0\nG93\n{}M2\n", parts.concat());
            let motion =
                read(ControllerKind::Gcode, text.as_bytes(), &Configuration::default()).unwrap();
            let n = motion.len();
            let last = motion.segment(n - 1);
            assert!((last.position_mm(last.duration_s)[0] - 0.3).abs() < 1e-12, "{parts:?}");
            motion.total_time_s()
        };
        let [a, b, c] = lines;
        for (parts, runs, dwells_s) in [
            (&[a, b, c][..], 1.0, 0.0),
            (&["G4 P5\n", a, b, c], 1.0, 5.0),
            (&[a, b, c, "G4 P3\n"], 1.0, 3.0),
            (&["G4 P9.978\n", a, b, c, "G4 P9.978\n"], 1.0, 19.956),
            (&[a, "G4 P2\n", b, c], 2.0, 2.0),
            // Shorter than the lines beside it, twice in a row, and without time: the motion ends all the same.
            (&[a, "G4 P0.01\n", b, "G4 P1\n", "G4 P0.5\n", c], 3.0, 1.51),
            (&[a, b, "G4 P0\n", c], 2.0, 0.0),
            // An output that switches at once ends the motion before it too.
            (&["M64 P0\n", "G4 P1\n", a, "M65 P0\n", b, c], 2.0, 1.0),
        ] {
            // 1 mm/s changes over 0.1 s: 0.0125 mm from the corner.
            let joined_s = total_s("G64 P0.0125", parts);
            assert!(
                (joined_s - (0.3 + 0.1 * runs + dwells_s)).abs() < 1e-12,
                "{parts:?}: {joined_s}"
            );
            let straight_s = total_s("G61", parts);
            assert!((straight_s - (0.3 + dwells_s)).abs() < 1e-12, "{parts:?}: {straight_s}");
        }
        // At F 60 mm/min the same lines take the same time.
        let feed = ["G94 F60\nG4 P5\n", "G1 X0.1\nG1 X0.2\nG1 X0.3\n", "G4 P3\n"];
        assert!((total_s("G64 P0.0125", &feed) - 8.4).abs() < 1e-12);
    }

    #[test]
    fn a_dwell_before_the_start_counts_with_the_tool_off() {
        let program =
            |first: &str| format!("{first}G4 P2\nG0 X1 Y1\nG93\nM62 P0\nG1 X2 F60\nM65 P0\nM2\n");
        let motion = read(ControllerKind::Gcode, program("M65 P0\n").as_bytes(), &configuration());
        let motion = motion.unwrap();
        assert_eq!((motion.total_time_s(), motion.tool_on()), (3.0, &[false, true][..]));
        assert_eq!(motion.segment(0).position_mm(1.0), [1.0, 1.0]);
        let on = message(ControllerKind::Gcode, &program(""));
        assert!(on.contains("line[1]: comes before G0 X Y sets the start"), "{on}");
        let ms = doubt(ControllerKind::Gcode, b"G0 X0 Y0\nG4 P500\nG4 P20\nM2\n").unwrap();
        assert!(ms.contains("line 2 stands for 500 s") && ms.contains("write P0.5 for ms"), "{ms}");
        assert_eq!(doubt(ControllerKind::Gcode, b"G4 P22.5\nG4 P150.5\n"), None);
    }

    /// Checks programs as users write them: 1 mm in x in 0.1 s from rest to rest, then 0.2 s at rest.
    #[test]
    fn programs_of_others_are_read() {
        use ControllerKind::*;
        let pmac = "; a header\r\nclose\r\n&1\r\nDELETE GATHER\r\n#1->10000X ; counts of mm\r\nOPEN PROG 1 CLEAR\r\n\
                    I190=1000 TA50 TS0 // ramps\r\n/* a comment\r\nover lines */ LINEAR ABS\r\nN10 F20 X1 Y-2\r\ndwell 0\r\n\
                    N20 PVT(100) X2:0Y-2:0\r\n\r\npvt200\r\nx(2):0 y-2:0\r\nP100=3\r\nCLOSE\r\n&1 B1 R\r\n";
        let bom = format!("\u{feff}{pmac}");
        let galil = "#RUN\r\nREM a comment\r\nNO a comment\r\nTM 1000\r\nSH AB\r\nPVA = 1000, 0, 100 ; ' up\r\n\r\npvb=0,0,100\r\n\
                     BT AB\r\nPVA=0,0,200;PVB=0,0,200\r\nPVA=0,0,0;PVB=0,0,0\r\nAM AB;MG \"done\"\r\nEN\r\n";
        let gcode = "%\r\nO1000 (PART 7)\r\n\r\nN10 G21 G90 G17 G40 G49 G80 G54\r\nN20 T1 S1000 ; not used\r\nN30 g0 x1 y-2\r\n\
                     N40 G93 (inverse time)\r\nN50 G1 X2 F600\r\nN60 G4 P0.2\r\nN70 M30\r\n%\r\n";
        let xps = "0.1\t1\t0\t0\t0\r\n\r\n0.2 ; 0 ; 0 ; 0 ; 0\r\n";
        let csv = "# a comment\r\nt_s; X_mm; vx_mm_per_s; y_mm; vy_mm_per_s; tool_on\r\n\r\n0; 1; 0; -2; 0; 1\r\n\
                   0.1; 2; 0; -2; 0; 1\r\n0.3; 2; 0; -2; 0; 1\r\n";
        for (controller, text) in
            [(Pmac, pmac), (Pmac, &bom), (Galil, galil), (Gcode, gcode), (Xps, xps), (Csv, csv)]
        {
            let settings = match controller {
                // Samples of TM 1000, and the unit of I190, are those of the file.
                Galil => Configuration { sample_s: None, ..configuration() },
                Pmac => Configuration { feedrate_time_unit_s: None, ..configuration() },
                _ => configuration(),
            };
            let motion = read(controller, text.as_bytes(), &settings)
                .unwrap_or_else(|e| panic!("{controller:?}: {e}"));
            // TM counts 1.024 us.
            let unit = if controller == Galil { 1.0 / 1.024 } else { 1.0 };
            let times: Vec<f64> = motion.break_time_s().iter().map(|t| t / unit).collect();
            let off = times.iter().zip([0.0, 0.1, 0.3]).map(|(t, s)| (t - s).abs());
            assert!(
                times.len() == 3 && off.fold(0.0, f64::max) < 1e-12,
                "{controller:?}: {times:?}"
            );
            let ends = [0.0, 0.1 * unit].map(|u| motion.segment(0).position_mm(u));
            let away = [ends[0][0] - 1.0, ends[1][0] - 2.0, ends[0][1] + 2.0, ends[1][1] + 2.0];
            assert!(away.iter().all(|d| d.abs() < 1e-12), "{controller:?}: {ends:?}");
        }
        for (controller, text, cause, way_out) in [
            (
                Pmac,
                "OPEN PROG 1 CLEAR\nPVT9\nX1:0\nCLOSE\nOPEN PLC 2\n",
                "line[5]: has \"OPEN\" after CLOSE",
                "first CLOSE",
            ),
            (
                Pmac,
                "OPEN PLC 1 CLEAR\n",
                "line[1]: has PLC 1, which is no motion program",
                "OPEN PROG to CLOSE",
            ),
            (Pmac, "OPEN PROG 1\nOPEN PROG 2\n", "opens a second program", "one program"),
            (Pmac, "CMD\"#1J+\"\n", "line[1]: has CMD", "leave it out"),
            (Pmac, "I42=1\n", "sets I42=1", "leave it out"),
            (Pmac, "I190=60000\n", "a unit of 60 s, and 1 s are given", "feedrate_time_unit_s"),
            (Pmac, "PVT(P1)\n", "line[1]: has \"P1\" where a number", "correct the line"),
            (
                Pmac,
                "LINEAR\nF10\nX1\n",
                "line[3]: goes to the start without all axes",
                "correct the line",
            ),
            (Galil, "TM 500\nPVA=1,0,100\n", "sets samples of 0.00048828125 s (TM)", "sample_s"),
            (Gcode, "G91 G1 X1 F60\n", "has G91", "G90"),
            (Gcode, "G28\n", "has G28", "leave it out"),
            (Gcode, "M3 S1000\n", "has M3", "M62 to M65 P0"),
            (Gcode, "G2 X1 Y1 R1\n", "has G2, an arc", "short lines"),
            (Gcode, "G0 X0 Y0\nG4 S1\n", "line[2]: has G4 without P", "seconds as G4 P"),
            (Gcode, "G0 X0 Y0\nG93\nG1 X1 F60\n", "it was cut off", "end it with M2"),
            (
                Xps,
                "dt, dx, vx, dy, vy\n0.1, 1, 0, 0, 0\n",
                "line[1]: has \"dt, dx",
                "take the line off",
            ),
            (Csv, "t,x,vx,y,vy,on\n", "is not the header", "these columns"),
        ] {
            let said = message(controller, text);
            assert!(
                said.contains(cause) && said.contains(way_out),
                "{controller:?} {text:?}: {said}"
            );
        }
    }

    #[test]
    fn the_tool_is_off_where_the_program_says_so() {
        let text = "G0 X0 Y0\nG93\nM62 P0\nG1 X1 F60\nM63 P0\nG1 X2 F60\nM2\n";
        let program =
            read(ControllerKind::Gcode, text.as_bytes(), &Configuration::default()).unwrap();
        assert_eq!(program.tool_on(), [true, false]);
        let text =
            "t_s,x_mm,vx_mm_per_s,y_mm,vy_mm_per_s,tool_on\n0,1,0,2,0,0\n1,1,0,2,0,1\n2,1,0,2,0,1";
        let program =
            read(ControllerKind::Csv, text.as_bytes(), &Configuration::default()).unwrap();
        assert_eq!(program.tool_on(), [false, true]);
    }

    #[test]
    fn bad_programs_are_refused_with_their_line() {
        use ControllerKind::*;
        for (controller, text, expected) in [
            (Galil, "PVA=1,0,100\n", "1 segment(s) of A, 0 of B"),
            (
                Galil,
                "PVA=1,0,100\nPVB=1,0,102\nBTAB\nPVA=0,0,0\nPVB=0,0,0\n",
                "100 samples for A, 102 for B",
            ),
            (Galil, "PVA=1,x,100\n", "line[1]: has \"X\""),
            (Galil, "PVA=1,0,0\nPVB=1,0,0\n", "0 samples"),
            (Galil, "DP0,0\n", "line[1]: has \"DP0,0\""),
            (Galil, "PVA=1,0,9999\n", "9999 samples"),
            (Xps, "0.1, 1, 0, 0\n", "line[1]: has 4 fields"),
            (Xps, "0, 1, 0, 0, 0\n", "line[1]: lasts 0 s"),
            (Xps, "0.1, 1, 0, 0, 0.5\n", "ends with the velocity"),
            (Xps, "", "moves nothing"),
            (Pmac, "X1:0\n", "before PVT"),
            (Pmac, "PVT0\nX1:0\n", "line[1]: lasts 0 ms"),
            (Pmac, "PVT10\nX1:0\nRAPID\nX1 Y1\n", "line[3]: goes elsewhere by RAPID"),
            (Pmac, "RAPID\nX1\nPVT10\nX1:0\n", "line[2]: goes to the start without all axes"),
            (
                Pmac,
                "INC\nRAPID\nX1 Y1\nPVT10\nX1:0\n",
                "line[3]: goes to the start without all axes",
            ),
            (Pmac, "PVT10\nZ1:0\n", "line[2]: has \"Z"),
            (Gcode, "G93\nG1 X1\n", "line[2]: has no F"),
            (Gcode, "G93\nG0 X0 Y0\nG1 X0 F60\n", "no length"),
            (Gcode, "G0 X0 Y0\nG94\nG1 X1\n", "has no F"),
            (Gcode, "G20\n", "inches"),
            (Gcode, "G2 X1 Y1 R1\n", "G2"),
            (Gcode, "G0 X0 Y0\nG1 X1 F-5\n", "F is -5"),
            (Gcode, "G0 X0 Y0\nG1 Xa F5\n", "line[2]: has the word X without a number"),
            (Csv, "0,1,0,2,0,1\n", "line[1]: is not the header"),
        ] {
            let said = message(controller, text);
            assert!(said.contains(expected), "{controller:?} {text:?}: {said}");
        }
        let nothing = Configuration::default();
        let galil = "PVA=1,0,100\nPVB=1,0,100\nBTAB\nPVA=0,0,0\nPVB=0,0,0\n";
        let said = read(Galil, galil.as_bytes(), &nothing).unwrap_err().to_string();
        assert!(said.contains("`count_mm`"), "{said}");
        let said = read(Xps, b"0.1, 1, 0, 0, 0\n", &nothing).unwrap_err().to_string();
        assert!(said.contains("`start_mm`"), "{said}");
    }

    #[test]
    fn what_would_change_the_motion_without_a_trace_is_an_error() {
        use ControllerKind::*;
        // The line that is wrong is the third.
        let gcode = |line: &str| format!("G0 X0 Y0\nG94\n{line}\nM2\n");
        for (line, expected) in [
            ("G1 X5 ) Y7 F60", "has ) without a comment"),
            ("G1 X5 (a (b) Y7 F60)", "comment within a comment"),
            ("G1 X5 F60 (Y7", "comment that does not end"),
            ("G1 X5 X6 F60", "has the word X twice"),
            ("G1 X5 F60 F70", "has the word F twice"),
            ("G0 G1 X5 F60", "has G1 beside another word of its group (motion)"),
            ("G93 G94 G1 X5 F60", "feed mode"),
            ("M62 M63 P0", "output"),
            ("G1 X F60", "has the word X without a number"),
            ("G1 X5 Z1 F60", "has the word Z1"),
            ("G91 G1 X5 F60", "has G91, which is not understood"),
            ("G1.04 X5 F60", "has G1.04, which is not understood"),
            ("G1 X1e2 F60", "has the word E2"),
            ("G1 X5%Y7 F60", "has \"5%\" where a number should be"),
            ("G1 X5 #1=3 F60", "where a number should be"),
            ("G1 X5 P1 F60", "has a word P that belongs to nothing"),
            ("G1 X5 Q1 F60", "has a word Q that belongs to nothing"),
            ("G4 P1 X5", "has G4 with words that belong to something else"),
            ("M62 P1", "another output than P0"),
            ("/G1 X5 F60", "depends on a switch of the machine"),
            ("G1 N5 X5 F60", "has N not at its beginning"),
            ("%", "has '%' where a letter should be"),
        ] {
            let said = message(Gcode, &gcode(line));
            assert!(said.contains("line[3]") && said.contains(expected), "{line}: {said}");
        }
        let long = gcode(&format!("G1 X5 F60 ({})", "a".repeat(256)));
        assert!(message(Gcode, &long).contains("has 268 characters, the controller takes 252"));
        // A comment may hold what is no comment elsewhere.
        let fine = gcode("N10 (a;b%c/d) G1 X5 Y7 F60 (e) ; f (g");
        let program = read(Gcode, fine.as_bytes(), &Configuration::default()).unwrap();
        let [x, y] = program.segment(0).position_mm(program.total_time_s());
        // The speed is a quotient, the end its product with the time.
        assert!((x - 5.0).abs() < 1e-12 && (y - 7.0).abs() < 1e-12);
        assert!(message(Gcode, "G0 X0 Y0\nG94\nG1 X5 F60\n").contains("it was cut off"));

        let galil = "PVA=1,0,100\nPVB=1,0,100\nBTAB\n";
        for (text, expected) in [
            (galil.into(), "does not end with PVA=0,0,0"),
            (galil.replace("BTAB\n", "PVA=0,0,0\nPVB=0,0,0\n"), "has no BTAB"),
            (format!("{galil}PVA=0,0,-1\n"), "line[4]: clears the segments before it"),
            (format!("{galil}PVA=9,9,-1\n"), "line[4]: takes -1 samples"),
            (format!("{galil}BTAB\n"), "line[4]: begins the motion again"),
            (format!("{galil}PVA=0,0,0\nPVA=1,0,100\n"), "line[5]: goes on after the end"),
            ("PVA=44000001,0,100\n".into(), "line[1]: has 44000001,0, which is beyond"),
        ] {
            let said = message(Galil, &text);
            assert!(said.contains(expected), "{text:?}: {said}");
        }
        for (text, expected) in [
            ("PVT10\nX1:0 X2:0\n", "line[2]: has X twice"),
            ("PVT)10(\nX1:0\n", "line[1]: has \")10(\""),
            ("PVT10\nX1:1\nDWELL5\n", "line[3]: dwells for 5 ms, or while it moves"),
        ] {
            let said = message(Pmac, text);
            assert!(said.contains(expected), "{text:?}: {said}");
        }
        let csv = "t_s,x_mm,vx_mm_per_s,y_mm,vy_mm_per_s,tool_on\n0,1,0,2,0,0.5\n1,1,0,2,0,1\n";
        assert!(message(Csv, csv).contains("line[2]: has 0.5 for tool_on"));
    }

    #[test]
    fn the_tool_switches_when_the_controller_does_it() {
        let on =
            |c, text: &str| read(c, text.as_bytes(), &configuration()).unwrap().tool_on().to_vec();
        let gcode = |body: &str| format!("M65 P0\nG0 X0 Y0\nG93\n{body}M65 P0\nM2\n");
        // G4 is no motion: M62 and M63 wait beyond it.
        let body = "M62 P0\nG4 P1\nG1 X1 F60\nM63 P0\nG4 P1\nG1 X2 F60\n";
        assert_eq!(on(ControllerKind::Gcode, &gcode(body)), [false, true, true, false]);
        let body = "M64 P0\nG4 P1\nG1 X1 F60\nM65 P0\nG4 P1\nG1 X2 F60\n";
        assert_eq!(on(ControllerKind::Gcode, &gcode(body)), [true, true, false, false]);
        let body = "PVT10\nX1:0\nM7==1\nX2:0\nX3:0\nM7==0\nX4:0\n";
        assert_eq!(on(ControllerKind::Pmac, &format!("M7=0\n{body}")), [false, true, true, false]);
        let left_on = "G0 X0 Y0\nG93\nM62 P0\nG1 X1 F60\nM63 P0\nM2\n";
        assert!(
            message(ControllerKind::Gcode, left_on).contains("no motion follows: it never happens")
        );
        let left_on = "G0 X0 Y0\nG93\nM62 P0\nG1 X1 F60\nM2\n";
        assert!(message(ControllerKind::Gcode, left_on).contains("ends with the tool on"));
        let late = "G0 X0 Y0\nG93\nG1 X1 F60\nM62 P0\nG1 X2 F60\nM65 P0\nM2\n";
        assert!(
            message(ControllerKind::Gcode, late).contains("line[4]: switches the tool first here")
        );
        for (text, expected) in [
            ("M7==1\nPVT10\nX1:0\nM7==0\n", "ends with the tool on"),
            ("M7==1\nPVT10\nX1:0\nM7=0\n", "line[4]: assigns with = among moves"),
            ("M7==1\nPVT10\nX1:0\nM8==0\nDWELL0\n", "line[4]: switches another M-variable"),
            ("PVT10\nX1:0\nM7==1\nX2:0\n", "line[3]: switches first here"),
            ("M7==2\n", "line[1]: has \"M7==2\""),
        ] {
            let said = message(ControllerKind::Pmac, text);
            assert!(said.contains(expected), "{text:?}: {said}");
        }
    }

    #[test]
    fn the_file_beside_another_program_is_refused() {
        let text = b"0.1, 1, 0, 0, 0\n";
        let of = |bytes: &[u8]| Configuration {
            program_blake3: Some(blake3::hash(bytes).to_hex().to_string()),
            ..configuration()
        };
        assert!(read(ControllerKind::Xps, text, &of(text)).is_ok());
        let said =
            read(ControllerKind::Xps, text, &of(b"0.1, 2, 0, 0, 0\n")).unwrap_err().to_string();
        assert!(
            said.contains("program_blake3: is") && said.contains("that of the program is"),
            "{said}"
        );
    }
}
