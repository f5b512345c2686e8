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
//! The time is nominal: a planner that blends corners, or whose limits are reached, takes longer. The head says how much
//! longer LinuxCNC presumably takes (`planner.rs`). With `linuxcnc_feeds` the feeds are those with which it takes the time
//! of the plan, and a comment in every line states that time, because F is none then.
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

use crate::{
    Abilities, About, Approach, Job, Tool, decimal, generate::Nodes, header::Comment, planner,
};

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
    /// True for feeds with which the planner of LinuxCNC takes the times of the plan, on a machine whose configuration
    /// has the acceleration limits of the machine file.
    pub linuxcnc_feeds: bool,
}

impl Default for GcodeSettings {
    fn default() -> Self {
        Self {
            feed: Feed::InverseTime,
            path_tolerance_mm: None,
            rotary_lines: false,
            linuxcnc_feeds: false,
        }
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
    if turns && settings.linuxcnc_feeds {
        let problem = "are known for linear axes only, and the motion turns an axis";
        return Err(Invalid::whole("linuxcnc_feeds", problem, "leave `linuxcnc_feeds` out"));
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
    let feeds = if job.turns() { None } else { Some(feeds(job, &q, tolerance)?) };
    about.preamble.extend(feeds.iter().flat_map(|feeds| of_planner(job, &q, feeds)));
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
        if stands {
            text += &format!("G4 P{}\n", decimal(q.wait_s(k), DIGITS));
            continue;
        }
        text += frame;
        text += &line(job, &q, k, feeds.as_ref())?;
    }
    text += output("M65 P0\n");
    text += &job.epilogue();
    text += "G94 F60\nM2\n";
    Ok((text, about))
}

/// Returns the text of the line of segment `k`, without G53.
fn line<const N: usize>(
    job: &Job<N>,
    q: &Nodes<N>,
    k: usize,
    feeds: Option<&Feeds>,
) -> Result<String, Invalid> {
    let settings = &job.settings.gcode;
    let (from, to) = (q.position(k), q.position(k + 1));
    // As the interpreter will read them.
    let length = (1..N).fold((to[0] - from[0]).abs(), |sum, a| sum.hypot(to[a] - from[a]));
    let plan_s = q.duration(k) as f64 * job.tick()?;
    let made_up = feeds.filter(|_| settings.linuxcnc_feeds);
    let seconds = made_up.map_or(plan_s, |feeds| length / feeds.mm_per_s[k]);
    let feed = match settings.feed {
        // F = 60 / dt
        Feed::InverseTime => 60.0 / seconds,
        // F = 60 length / dt
        Feed::PerMinute => 60.0 * length / seconds,
    };
    let comment = made_up.map_or(String::new(), |_| format!(" ({} s)", decimal(plan_s, DIGITS)));
    Ok(format!("G1 {} F{}{comment}\n", job.words(to, DIGITS), significant(feed)))
}

/// Feeds of the lines, and what the planner of LinuxCNC presumably makes of them.
struct Feeds {
    /// Feed of every segment, mm/s; 0 for one that stands (n).
    mm_per_s: Vec<f64>,
    /// Time that the planner adds to the lines, s.
    added_s: f64,
    /// Index of the segment near which it adds most, and this time, s.
    most: (usize, f64),
}

/// Returns the feeds of the lines of a program whose axes are all linear.
fn feeds<const N: usize>(job: &Job<N>, q: &Nodes<N>, tolerance_mm: f64) -> Result<Feeds, Invalid> {
    let tick_s = job.tick()?;
    let n = q.segments();
    let mut feeds = Feeds { mm_per_s: vec![0.0; n], added_s: 0.0, most: (0, 0.0) };
    let mut first = 0;
    while first < n {
        let last = (first..n).find(|k| q.stands(*k)).unwrap_or(n);
        if first == last {
            first += 1;
            continue;
        }
        let nodes: Vec<[f64; N]> = (first..=last).map(|k| q.position(k)).collect();
        let lines = planner::Lines::new(&nodes, job.plan.axes, tolerance_mm);
        let line_s: Vec<f64> = (first..last).map(|k| q.duration(k) as f64 * tick_s).collect();
        let mut feed = lines.mean_speeds(&line_s);
        // The motion begins half a line before the first node, and ends half a line after the last one.
        let mut time_s = line_s.clone();
        for end in [0, last - first - 1] {
            time_s[end] += 0.5 * line_s[end];
        }
        if job.settings.gcode.linuxcnc_feeds {
            feed = lines.feeds(&time_s);
        }
        let taken = lines.times(&feed);
        let late: Vec<f64> = taken.iter().zip(&time_s).map(|(t, wanted)| t - wanted).collect();
        feeds.added_s += late.iter().sum::<f64>();
        for (k, [from, to]) in lines.nearby().into_iter().enumerate() {
            let near = late[from..to].iter().sum();
            if near > feeds.most.1 {
                feeds.most = (first + k, near);
            }
        }
        feeds.mm_per_s[first..last].copy_from_slice(&feed);
        first = last;
    }
    Ok(feeds)
}

/// Returns the sentences on what the planner of LinuxCNC presumably makes of the program. `planish-import` knows the
/// first one of a program whose F words are no times.
fn of_planner<const N: usize>(job: &Job<N>, q: &Nodes<N>, feeds: &Feeds) -> [String; 2] {
    let total_s = q.total_s();
    let (near, near_s) = feeds.most;
    let cost = format!(
        "LinuxCNC presumably takes {:.3} s, {:+.2} %, and {:.0} ms of that in the {:.0} mm of path around {}",
        total_s + feeds.added_s,
        100.0 * feeds.added_s / total_s,
        1e3 * near_s,
        2.0 * planner::NEARBY_MM,
        job.words(q.position(near), 1)
    );
    if job.settings.gcode.linuxcnc_feeds {
        let sentence = "planner: the feeds make up for the planner of LinuxCNC, with the acceleration limits of the machine \
                        file. Comments have the times of the lines. Another controller runs them too fast";
        [sentence.into(), format!("planner: {cost}")]
    } else {
        let remedy = "planner: it removes more there. Export with linuxcnc_feeds, which makes up for it where it can. Record the first run \
                      with the tool off, and compare it by planish import trace and planish simulate";
        [format!("planner: {cost}"), remedy.into()]
    }
}

/// Returns a positive feed with [`FEED_DIGITS`] significant digits.
pub(crate) fn significant(v: f64) -> String {
    let decimals = (FEED_DIGITS - 1 - v.log10().floor() as i32).clamp(0, 15);
    decimal(v, decimals as usize)
}
