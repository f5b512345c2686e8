//! Siemens SINUMERIK 840D, 840D sl and ONE: straight lines in inverse time ([`write_lines`]), or cubics
//! ([`write_polynomials`]). Axes are X Y Z A B C, the rotary ones in degrees; a radius is X.
//!
//! Lines: `G1 X Y F` after `G93`, F = 60 / dt in 1/min, joined within CTOL after `G642`. A dwell is `G4 F`, in s. A
//! `G4` begins when the motion before it has ended, as in [`crate::gcode`].
//!
//! Cubics: `PO[X]=(end,a2,a3)` after `POLY`. The position is, with the position a0 at the end of the block before,
//!
//! ```text
//! f(p) = a0 + a1 p + a2 p^2 + a3 p^3      p from 0 to PL,  f(PL) = end
//! ```
//!
//! so a1 follows from the end, and PL is the duration in ms. The feed F is that of the axes in FGROUP along their path.
//! Along the path of x and y it would be constant in a block, and the motion not the cubic. So FGROUP has a virtual
//! axis W only, which counts the seconds: 1 mm is 1 s, and F is 60 mm/min throughout. W runs linearly in p, and with
//! `UPATH` the other axes follow p. The times are then exact, and no block begins with another feed than the one before.
//!
//! The tool: an output would need the synchronized actions or the M functions of the machine, so the host switches.
//!
//! The grid: the controller computes positions in increments, by default 1000 per mm and per degree (machine data
//! INT_INCR_PER_MM, INT_INCR_PER_DEG). The counts of a program have to be multiples of these.
//!
//! Source: SINUMERIK 840D/840Di/810D, Programming Guide Advanced, 04.00, 5.4 (POLY) and 5.5 (SPATH, UPATH);
//! SINUMERIK ONE, NC programming, 12/2019, 2.7.1 (G93, FGROUP) and 3.7 (UPATH); SINUMERIK 840Di sl, Programming Manual
//! Fundamentals, 11/2006, 7.1 (G93).

use planish_types::{ControllerModel, Invalid};

use crate::{
    Abilities, About, Approach, Job, Tool, decimal, gcode::significant, header::Comment, letter,
    tick_s, velocities::hermite,
};

/// Form of a comment. The manuals state no length of a line; 120 characters are chosen for reading.
pub(crate) const COMMENT: Comment = Comment { open: "; ", close: "", line: 120 };

/// Number of decimals of a position and of a time in s. Larger: longer lines. Smaller: rounding that the controller may
/// notice. Chosen: counts below 1e-9 mm and clocks below 1e-9 s are refused.
const DIGITS: usize = 9;

/// Smallest and largest PL, ms. Facts of the controller (PGA, 5.4).
const LEAST_PL_MS: f64 = 1e-4;
const MOST_PL_MS: f64 = 99_999.999_9;

const TOOL: Tool = Tool::LeftToTheHost(
    "this program does not switch it: an output needs M functions or synchronized actions of the machine. The host \
     switches it on and off, and off on every stop",
);

/// Returns the tick of cubics, s, and the largest number of ticks of a segment. Refuses a tick that no PL states.
pub(crate) fn checked(grids: &ControllerModel) -> Result<(f64, i64), Invalid> {
    let tick_s = tick_s(grids)?;
    // A little less is the rounding of a number that was typed.
    if 1e3 * tick_s < LEAST_PL_MS * (1.0 - 1e-9) {
        let problem = format!("is {tick_s} s, and PL states at least {LEAST_PL_MS} ms");
        return Err(Invalid::whole("tick_s", problem, "give a larger tick"));
    }
    Ok((tick_s, (MOST_PL_MS / (1e3 * tick_s)).floor() as i64))
}

/// Writes lines in inverse time.
pub(crate) fn write_lines<const N: usize>(job: &Job<N>) -> Result<(String, About), Invalid> {
    let tick_s = job.tick()?;
    let (q, mut about) = job.nodes(Abilities {
        most_ticks: i64::MAX >> 10,
        tool: TOOL,
        approach: Approach::InProgram(
            "the way from where the axes stand to the start is free: the program goes there by G0, in the work \
             coordinates that are active. INT_INCR_PER_MM and INT_INCR_PER_DEG are at least one over the counts",
        ),
    })?;
    let lengths = if job.turns() { "mm and deg" } else { "mm" };
    let mut text = about.header(&COMMENT, &format!("{lengths}, F in lines per minute, G4 F in s"));
    let axes: Vec<&str> = job.plan.axes.iter().map(letter).collect();
    text += &format!("G17 G40 G71 G90 G94\nFGROUP({})\n", axes.join(","));
    text += &format!("G642 CTOL={}\n", decimal(job.settings.path_deviation_mm, DIGITS));
    text += &format!("G0 {}\nG93\n", job.words(q.position(0), DIGITS));
    for k in 0..about.segments {
        about.marks.add(&text, q.time_s(k), q.position(k));
        if q.stands(k) {
            text += &format!("G4 F{}\n", decimal(q.wait_s(k), DIGITS));
            continue;
        }
        let feed = 60.0 / (q.duration(k) as f64 * tick_s);
        text += &format!("G1 {} F{}\n", job.words(q.position(k + 1), DIGITS), significant(feed));
    }
    text += "G94 F60\nM30\n";
    Ok((text, about))
}

/// Writes cubics in the time of the virtual axis W.
pub(crate) fn write_polynomials<const N: usize>(job: &Job<N>) -> Result<(String, About), Invalid> {
    let (tick_s, most_ticks) = checked(&job.grids)?;
    let (q, mut about) = job.nodes(Abilities {
        most_ticks,
        tool: TOOL,
        approach: Approach::InProgram(
            "the way from where the axes stand to the start is free: the program goes there by G0, in the work \
             coordinates that are active. W is a virtual linear axis of the channel without software limits, whose \
             acceleration is 100 m/s^2 or more: it counts the seconds, 1 mm each. INT_INCR_PER_MM and \
             INT_INCR_PER_DEG are at least one over the counts",
        ),
    })?;
    let ticks_of_pl = 1e3 * tick_s / LEAST_PL_MS;
    if (ticks_of_pl - ticks_of_pl.round()).abs() > 1e-6 * ticks_of_pl {
        about.warnings.push(format!(
            "a tick of {tick_s} s is no multiple of {LEAST_PL_MS} ms, the last decimal of PL in the manual"
        ));
    }
    let lengths = if job.turns() { "mm and deg" } else { "mm" };
    let mut text = about.header(&COMMENT, &format!("{lengths}, PL in ms, W in s"));
    text += "G17 G40 G71 G90 G94\n";
    text += &format!("G0 {} W=0\nFGROUP(W)\nUPATH\nG64\nF60\n", job.words(q.position(0), DIGITS));
    for k in 0..about.segments {
        about.marks.add(&text, q.time_s(k), q.position(k));
        let ms = 1e3 * q.duration(k) as f64 * tick_s;
        let distance = q.distance(k);
        let mut words = String::new();
        for (a, axis) in job.plan.axes.iter().enumerate() {
            let d = distance[a] as f64 * q.count[a];
            // a2 p^2 = c2 u^2, a3 p^3 = c3 u^3     u: time, s; p = 1000 u
            let c = hermite(d, [q.velocity[k][a], q.velocity[k + 1][a]], 1e-3 * ms);
            let end = decimal(q.position(k + 1)[a], DIGITS);
            let [a2, a3] = [c[2] * 1e-6, c[3] * 1e-9].map(coefficient);
            words += &format!("PO[{}]=({end},{a2},{a3}) ", letter(axis));
        }
        let mode = if k == 0 { "POLY " } else { "" };
        let end_s = decimal(q.time_s(k + 1), DIGITS);
        text += &format!("{mode}{words}W={end_s} PL={}\n", decimal(ms, 4));
    }
    text += "G1\nFGROUP()\nM30\n";
    Ok((text, about))
}

/// Returns a coefficient with 13 significant digits and no exponent, which an address does not take.
fn coefficient(v: f64) -> String {
    if v == 0.0 {
        return "0".into();
    }
    decimal(v, (12 - v.abs().log10().floor() as i32).clamp(0, 40) as usize)
}
