//! Newport XPS, PVT trajectory file: one line `dt, dx, vx, dy, vy` per element (segment), with two columns for every
//! further positioner of the group. Distances are relative and velocities those at the end, in mm (or degrees) and s.
//! The file has no header, so what it is made from is in the file beside it only.
//!
//! A PT file (`write_pt`) has lines `dt, dx, dy`: no velocities. No public source states how the controller moves
//! between two of its points. The lines are therefore as short and even as those of G-code: joined by parabolas, they
//! keep the limits.
//!
//! The controller refuses an element without time and a last velocity that is not zero. It does not
//! check where a relative motion ends: the start must be where `start_mm` says.
//!
//! The tool: a line has no place for an output, so the file cannot switch one. The controller can, by
//! its events (start and end of a trajectory, start of an element) and actions on its digital outputs,
//! which the host configures before the run. A motion that lifts the tool is refused.
//!
//! [`commands`] writes the calls that check and run the file, with the lines of the machine file around them.
//!
//! Source: Newport XPS-Q8 user's manual (EDH0301), sections 8.3.6 (trajectory file description) and 8.3.8
//! (verification and execution), and XPS programmer's manual, EventExtendedConfigurationActionSet; newportxps,
//! `XPS_C8_drivers.py` (form of the calls). No
//! length of a line is stated; a line here has up to 100 characters.

use planish_types::Invalid;

use crate::{Abilities, About, Approach, Job, Tool, decimal};

/// Number of decimals of a distance in mm, a velocity in mm/s and a time in s. Larger: longer lines. Smaller:
/// rounding that the controller may notice. Chosen: counts below 1e-9 mm and clocks below 1e-9 s are refused.
const DIGITS: usize = 9;

const TOOL: Tool = Tool::LeftToTheHost(
    "the file cannot switch it: the host switches it, or events of the controller (start and end \
     of the trajectory) that the host configures",
);

/// Writes a PVT file.
pub(crate) fn write<const N: usize>(job: &Job<N>) -> Result<(String, About), Invalid> {
    let tick_s = job.tick()?;
    let (q, mut about) = job.nodes(Abilities {
        most_ticks: i64::MAX >> 10,
        tool: TOOL,
        approach: Approach::Before(
            "go to the start with GroupMoveAbsolute, tool off, then MultipleAxesPVTVerification, then \
             MultipleAxesPVTExecution once: distances are relative, from elsewhere the whole run is displaced, and \
             nothing notices",
        ),
    })?;
    let n = about.segments;
    let mut text = String::new();
    for k in 0..n {
        about.marks.add(&text, q.time_s(k), q.position(k));
        let distance = q.distance(k);
        let velocity = q.velocity[k + 1];
        text += &decimal(q.duration(k) as f64 * tick_s, DIGITS);
        for axis in 0..N {
            let d = distance[axis] as f64 * q.count[axis];
            text += &format!(", {}, {}", decimal(d, DIGITS), decimal(velocity[axis], DIGITS));
        }
        text.push('\n');
    }
    Ok((text, about))
}

/// Writes a PT file.
pub(crate) fn write_pt<const N: usize>(job: &Job<N>) -> Result<(String, About), Invalid> {
    let tick_s = job.tick()?;
    let (q, mut about) = job.nodes(Abilities {
        most_ticks: i64::MAX >> 10,
        tool: TOOL,
        approach: Approach::Before(
            "go to the start with GroupMoveAbsolute, tool off, then MultipleAxesPTVerification, then \
             MultipleAxesPTExecution once: distances are relative, from elsewhere the whole run is displaced, and \
             nothing notices",
        ),
    })?;
    let mut text = String::new();
    for k in 0..about.segments {
        about.marks.add(&text, q.time_s(k), q.position(k));
        let seconds = if q.stands(k) { q.wait_s(k) } else { q.duration(k) as f64 * tick_s };
        text += &decimal(seconds, DIGITS);
        for (distance, count) in q.distance(k).into_iter().zip(q.count) {
            text += &format!(", {}", decimal(distance as f64 * count, DIGITS));
        }
        text.push('\n');
    }
    Ok((text, about))
}

/// Names of a group of positioners on an XPS.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct XpsGroup {
    /// Name of the MultipleAxes group, whose positioners are the axes of the program in its order.
    pub name: String,
    /// Names of its positioners; empty to leave out what the verification found for each.
    pub positioners: Vec<String>,
}

/// Returns the calls that check and run the program in the file `file`, one per line, as they go to port 5001 of the
/// controller. A line that starts with `#` is for the reader. The host waits for the answer of each call, and stops at
/// an answer other than 0.
///
/// # Errors
/// Refuses names that are not made of letters, digits, `_`, `-` and dots, another number of positioners than of axes,
/// and a program with a run-up, during which the tool would be on.
pub fn commands(about: &About, group: &XpsGroup, file: &str) -> Result<String, Invalid> {
    let is_name = |name: &str| {
        !name.is_empty() && name.chars().all(|c| c.is_ascii_alphanumeric() || "_-.".contains(c))
    };
    for name in
        [&group.name].into_iter().chain(&group.positioners).map(String::as_str).chain([file])
    {
        if !is_name(name) {
            let remedy = "give a name of letters, digits, _, - and dots, as the controller has it";
            return Err(Invalid::whole("group", format!("has the name {name:?}"), remedy));
        }
    }
    let starts = about.starts();
    if !(group.positioners.is_empty() || group.positioners.len() == starts.len()) {
        let problem = format!("has {} positioners", group.positioners.len());
        let remedy = format!("give {}, in the order of the columns", starts.len());
        return Err(Invalid::whole("group", problem, remedy));
    }
    if about.excerpt.as_ref().is_some_and(|e| e.run_up_segments > 0) && !about.dry_run {
        let problem = "would switch the tool on before the run-up";
        let remedy = "write them for a `dry_run`, or switch the tool by an event of the controller";
        return Err(Invalid::whole("commands", problem, remedy));
    }
    let name = &group.name;
    let places: Vec<String> = starts.iter().map(|(_, _, p)| decimal(*p, DIGITS)).collect();
    // A name from the user must not begin a line of its own.
    let printable = |c: char| if (' '..='~').contains(&c) { c } else { '_' };
    let machine: String = about.machine.chars().map(printable).collect();
    let mut lines = vec![
        format!("# {file} for {machine}, BLAKE3 {}", about.program_blake3),
        "# send each line to port 5001, wait for its answer, and stop at an answer other than 0"
            .into(),
        format!("# put {file} into the folder Trajectories by FTP, or SFTP on an XPS-D"),
    ];
    if about.dry_run {
        lines.push("# DRY RUN: the tool stays off".into());
    }
    lines.extend(about.tool_off_lines.iter().cloned());
    lines.extend(about.prologue.iter().cloned());
    lines.push(format!("GroupMoveAbsolute({name},{})", places.join(",")));
    lines.push(format!("MultipleAxesPVTVerification({name},{file})"));
    lines.extend(group.positioners.iter().map(|positioner| {
        format!(
            "MultipleAxesPVTVerificationResultGet({name}.{positioner},char *,double *,double *,double *,double *)"
        )
    }));
    if !about.dry_run {
        if about.tool_on_lines.is_empty() {
            lines.push("# tool on here: the machine file states no tool_on".into());
        }
        lines.extend(about.tool_on_lines.iter().cloned());
    }
    lines.push(format!("MultipleAxesPVTExecution({name},{file},1)"));
    lines.extend(about.tool_off_lines.iter().cloned());
    lines.extend(about.epilogue.iter().cloned());
    lines.push(format!(
        "# to stop: tool off, then GroupMoveAbort({name}) on another socket; MultipleAxesPVTParametersGet({name},char *,\
         int *) gives the element"
    ));
    Ok(lines.join("\n") + "\n")
}
