//! G-code for LinuxCNC and its relatives: straight lines, each in its time.
//!
//! ```text
//! G93:  F = 60 / dt            (1/min)
//! G94:  F = 60 length / dt     (mm/min)
//! ```
//!
//! A program of all axes has the words X Y Z A B C, the rotary ones in degrees; a radius is X. Its lines are straight
//! in the space of the axes. A feed of axes in mm and degrees means nothing, so such a program is one of inverse time.
//! The tolerance of G64 bounds the linear axes only.
//!
//! LinuxCNC runs such lines otherwise. Its interpreter turns F of G93 into a feed along X Y Z, of at least 0.1 mm/min,
//! and its planner computes length, velocity, acceleration and the corner of two lines from X Y Z alone. Where these
//! hardly move while an axis turns, the corner is nowhere and the acceleration that is left for it is tiny. So a motion of
//! rotary axes is refused unless `rotary_lines` says that the planner was tried.
//!
//! Inverse time (G93) is what removal wants: it depends on the time, not on the speed. A line of no length would
//! silently lose its time there, so standing is written as `G4 P`. A G4 begins when the motion before it has ended,
//! half a line after its last node, and the next motion begins half a line before its first one. P leaves these halves
//! out. Between two lines the motion is straight and its speed is constant; a smaller `max_step_s` follows a schedule
//! that is neither.
//!
//! The time is nominal: a planner that blends corners, or whose limits are reached, takes longer.
//!
//! No offset moves the path. If the positions are readings of the axes, every line has `G53`; else `G54` alone counts,
//! which the operator sets for the part, and `G92.2` leaves out what G92 has left. `M49` locks the overrides of feed and
//! spindle at 100 % until `M2`.
//!
//! The tool is digital output 0.
//!
//! | word | takes effect | used |
//! |---|---|---|
//! | `M62 P0`, `M63 P0` | with the start of the next motion; never without one | before a `G1` |
//! | `M64 P0`, `M65 P0` | at once, after the motion before it has ended (breaks blending) | at the start, before `G4`, at the end |
//!
//! `G4` is no motion: `M62` before it waits until it is over. So the output is off before the rapid to the
//! start, switches where a dwell begins, and is off at the end. On an abort and on a pause it stays as it
//! is, which no program can change: `[RS274NGC]ON_ABORT_COMMAND` with `M65 P0`, or in HAL an `and2` of
//! `motion.digital-out-00` with `halui.program.is-running`.
//!
//! Source: LinuxCNC documentation: G-codes (G1, G4, G61, G64, G93, G94), M-codes (M62 - M65 Digital Output
//! Control), G-code Overview (Format of a line: 256 characters at most), and the run of a program in its
//! simulator (`crates/export/tests/interpreter.py`).

use planish_types::Invalid;

use crate::{Abilities, About, Approach, Job, Tool, decimal, generate::Nodes, header::Comment};

/// Number of decimals of a position in mm and of a time in s. Larger: longer lines. Smaller: rounding that a
/// controller may notice. Chosen: counts below 1e-9 mm and clocks below 1e-9 s are refused.
const DIGITS: usize = 9;

/// Number of significant digits of F. Larger: longer lines. Smaller: times that are off, and with them the
/// accelerations at nodes. Derived: nine let an acceleration at its limit exceed it by 2e-9, which `planish verify`
/// does not allow; thirteen are four orders more exact.
const FEED_DIGITS: i32 = 13;

/// Form of a comment. The interpreter `rs274` takes lines of up to 252 characters ("Command too long" at 253), although
/// the documentation says 256.
pub(crate) const COMMENT: Comment = Comment { open: "(", close: ")", line: 252 };

/// Smallest path tolerance, mm, except 0. Larger: sensible tolerances are refused. Smaller: it would be written as 0,
/// which means any deviation.
const LEAST_TOLERANCE_MM: f64 = 1e-6;

/// Convention of the F word.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Feed {
    /// G93, inverse time: F is one over the duration of the line, 1/min.
    InverseTime,
    /// G94, units per minute: F is the feedrate, mm/min.
    PerMinute,
}

/// Settings of a G-code program.
#[derive(Clone, Debug, PartialEq)]
pub struct GcodeSettings {
    /// Convention of the F word: inverse time or units per minute.
    pub feed: Feed,
    /// Largest distance of the path from the corners between lines, mm (G64 P); 0 for an exact path (G61). `None`: the
    /// path deviation of the program.
    pub path_tolerance_mm: Option<f64>,
    /// True if lines may move rotary axes; otherwise a motion of rotary axes is refused.
    pub rotary_lines: bool,
}

impl Default for GcodeSettings {
    fn default() -> Self {
        Self { feed: Feed::InverseTime, path_tolerance_mm: None, rotary_lines: false }
    }
}

/// Returns the largest distance of the path from the corners between lines, mm. Refuses a length that G64 P would take
/// differently, and a feed per minute if an axis is rotary (`turns`).
pub(crate) fn tolerance_mm(all: &crate::ProgramSettings, turns: bool) -> Result<f64, Invalid> {
    let settings = &all.gcode;
    let tolerance = settings.path_tolerance_mm.unwrap_or(all.path_deviation_mm);
    let is_length = tolerance == 0.0 || tolerance >= LEAST_TOLERANCE_MM;
    if !(tolerance.is_finite() && is_length) {
        let problem = format!("is {tolerance}, and G64 P0 would allow any deviation");
        let remedy = "give a length of at least 1e-6 mm, or 0 for an exact path";
        return Err(Invalid::whole("path_tolerance_mm", problem, remedy));
    }
    if turns && settings.feed == Feed::PerMinute {
        let problem = "is per-minute, and a feed of axes in mm and degrees means nothing";
        return Err(Invalid::whole("f_word", problem, "give inverse-time"));
    }
    Ok(tolerance)
}

/// Refuses a motion that turns a rotary axis, unless the settings allow it.
fn check_rotary<const N: usize>(job: &Job<N>) -> Result<(), Invalid> {
    let mut axes = job.plan.axes.iter().enumerate();
    let turning = axes.find(|(a, axis)| axis.is_rotary && job.plan.extent(*a) > 0.0);
    let Some((_, axis)) = turning.filter(|_| !job.settings.gcode.rotary_lines) else {
        return Ok(());
    };
    let problem = format!(
        "turns the axis {}: LinuxCNC plans a line by the length of its linear axes alone, so a line that mainly turns \
         takes longer than its time, and others exceed the limits",
        axis.name
    );
    let remedy = "write another kind, such as csv, pmac, galil or sinumerik-poly, or give `rotary_lines` if the planner \
                  of your controller was tried with such lines";
    Err(Invalid::whole("motion", problem, remedy))
}

pub(crate) fn write<const N: usize>(job: &Job<N>) -> Result<(String, About), Invalid> {
    let settings = &job.settings.gcode;
    let tick_s = job.tick()?;
    let tolerance = tolerance_mm(job.settings, job.turns())?;
    check_rotary(job)?;
    let switched = job.grids.switches_tool;
    let (q, mut about) = job.nodes(Abilities {
        most_ticks: i64::MAX >> 10,
        tool: if !switched {
            Tool::LeftToTheHost("no output of the controller does: the host switches it")
        } else { Tool::Switched(
            "digital output 0: M62 P0 on and M63 P0 off with the start of the next G1, M64 P0 on and M65 P0 off at \
             once, off before the rapid to the start and at the end. On an abort or a pause it stays as it is, HAL \
             or ON_ABORT_COMMAND has to switch it off"
                .into(),
        ) },
        approach: Approach::InProgram(if job.is_on_machine() {
            "the way from where the axes stand to the start is free: the program goes there by G0, straight, at the \
             rapid feed of the controller. Every line has G53: positions are those of the axes, and no work offset moves \
             them"
        } else {
            "the way from where the axes stand to the start is free: the program goes there by G0, straight, at the \
             rapid feed of the controller, in the work coordinates G54, which are set to those of the part, and without \
             G92"
        }),
    })?;
    let (mode, unit) = match settings.feed {
        Feed::InverseTime => ("G93", "lines per minute"),
        Feed::PerMinute => ("G94", "mm per minute"),
    };
    about.preamble.extend(of_planner(job, &q, about.segments, tick_s));
    let lengths = if job.turns() { "mm and deg" } else { "mm" };
    let mut text = about.header(&COMMENT, &format!("{lengths}, F in {unit}, G4 P in s"));
    let output = |words: &'static str| if switched { words } else { "" };
    text += output("M65 P0\n");
    text += &job.prologue();
    // No work offset but G54, by G53 none at all. M49: no override; M2 ends that.
    text += "G21 G90 G17 G40 G49 G54 G94\nG92.2\nM49\n";
    text += &match tolerance {
        0.0 => "G61\n".to_string(),
        // Q0: lines of one feed that are nearly straight are not merged.
        p => format!("G64 P{} Q0\n", decimal(p, DIGITS)),
    };
    let frame = if job.is_on_machine() { "G53 " } else { "" };
    text += &format!("{frame}G0 {}\n{mode}\n", job.words(q.position(0), DIGITS));
    let mut on = false;
    for k in 0..about.segments {
        about.marks.add(&text, q.time_s(k), q.position(k));
        let stands = q.stands(k);
        if q.tool_on[k] != on {
            on = q.tool_on[k];
            text += output(match (on, stands) {
                (true, false) => "M62 P0\n",
                (false, false) => "M63 P0\n",
                (true, true) => "M64 P0\n",
                (false, true) => "M65 P0\n",
            });
        }
        let from = q.position(k);
        let to = q.position(k + 1);
        let seconds = q.duration(k) as f64 * tick_s;
        // As the interpreter will read them.
        let length = (1..N).fold((to[0] - from[0]).abs(), |sum, a| sum.hypot(to[a] - from[a]));
        if stands {
            text += &format!("G4 P{}\n", decimal(q.wait_s(k), DIGITS));
            continue;
        }
        let feed = match settings.feed {
            // F = 60 / dt
            Feed::InverseTime => 60.0 / seconds,
            // F = 60 length / dt
            Feed::PerMinute => 60.0 * length / seconds,
        };
        text += &format!("{frame}G1 {} F{}\n", job.words(to, DIGITS), significant(feed));
    }
    text += output("M65 P0\n");
    text += &job.epilogue();
    text += "G94 F60\nM2\n";
    Ok((text, about))
}

/// Used fraction of an acceleration limit above which the planner of LinuxCNC takes more time than the program states.
/// Derived: in the blend of two lines it uses half of the acceleration along the path.
const PLANNER_USE: f64 = 0.5;

/// Part of the time of a program above [`PLANNER_USE`] from which the program says so. Larger: programs that a planner
/// spoils are silent. Smaller: the sentence is in every program.
const PLANNER_TIME: f64 = 0.01;

/// Returns the sentence on what a planner makes of the program, if the lines need much acceleration.
fn of_planner<const N: usize>(
    job: &Job<N>,
    q: &Nodes<N>,
    segments: usize,
    tick_s: f64,
) -> Option<String> {
    let mut before = [0.0; N];
    let mut before_s = f64::INFINITY;
    let [mut much_s, mut total_s] = [0.0; 2];
    for k in 0..segments {
        let seconds = q.duration(k) as f64 * tick_s;
        let (from, to) = (q.position(k), q.position(k + 1));
        let velocity: [f64; N] = std::array::from_fn(|a| (to[a] - from[a]) / seconds);
        // a = (m_k - m_{k-1}) / min(T_{k-1}, T_k)
        let is_much = job.plan.axes.iter().enumerate().any(|(a, axis)| {
            let acceleration = (velocity[a] - before[a]) / seconds.min(before_s);
            acceleration.abs() > PLANNER_USE * axis.max_acceleration
        });
        much_s += if is_much { seconds } else { 0.0 };
        total_s += seconds;
        (before, before_s) = (velocity, seconds);
    }
    let part = much_s / total_s;
    if part < PLANNER_TIME {
        return None;
    }
    Some(format!(
        "planner: {:.0} % of the time uses more than half of an acceleration limit. There LinuxCNC takes longer than \
         the lines state, and removes more. Lines of at most 0.002 s lower the difference, a plan for smaller limits \
         avoids it. Record the first run with the tool off, and compare it by planish import trace and planish \
         simulate",
        100.0 * part
    ))
}

/// Returns a positive feed with [`FEED_DIGITS`] significant digits.
pub(crate) fn significant(v: f64) -> String {
    let decimals = (FEED_DIGITS - 1 - v.log10().floor() as i32).clamp(0, 15);
    decimal(v, decimals as usize)
}
