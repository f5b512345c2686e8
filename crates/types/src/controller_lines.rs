//! Lines of a controller's own language that a machine file states: before the motion, after it, and for the tool.
//!
//! They wait for a beam, a pump or a spindle, set outputs and dwell. They must move nothing and must not change what
//! the lines of the motion mean. A list of commands that are known to do neither decides; everything else is refused.
//!
//! | controller | commands | length | source of the commands |
//! |---|---|---|---|
//! | `galil` | `MG`, `WT`, `AI`, `SB`, `CB`, `AO`, `SH` | 80 | DMC-40x0 command reference |
//! | `pmac` | `M<n>=`, `DWELL<ms>`, `WHILE(...)WAIT` | 80 | Turbo PMAC software reference |
//! | `gcode` | `G4 P`, `M0`, `M3` to `M9` but `M6`, `S`, `M62` to `M68` but output 0 on, `M100` to `M199` | 252 | LinuxCNC, M-codes |
//! | `aerotech` | `DOUT`, `DWELL` | 80 | EPICS motor module and Lauecollect, AeroBasic programs |
//! | `xps` | `GPIODigitalSet`, `GPIOAnalogSet`, `EventExtended...`, `TimerSet` | 252 | XPS programmer's manual |
//!
//! A program that a line calls (`M100`, an event of an XPS) is not looked at. Other controllers take no lines: their
//! file has no place for one.

use crate::{ControllerKind, Invalid};

/// Lines that a machine file states for its controller; each list may be empty.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ControllerLines {
    /// Lines before the motion.
    pub prologue: Vec<String>,
    /// Lines after the motion.
    pub epilogue: Vec<String>,
    /// Lines by which the host switches the tool on.
    pub tool_on: Vec<String>,
    /// Lines by which the host switches the tool off.
    pub tool_off: Vec<String>,
}

/// Characters that end a comment or a command, or join lines, on one of the controllers.
const BREAKING: [char; 10] = [';', '\'', '"', '`', '%', '#', '\\', '{', '}', '&'];

/// Length of a line that the controllers of the table take.
const TERMINAL_LINE: usize = 80;
const LONG_LINE: usize = 252;

impl ControllerLines {
    /// Returns true if no list has a line.
    pub fn is_empty(&self) -> bool {
        [&self.prologue, &self.epilogue, &self.tool_on, &self.tool_off]
            .iter()
            .all(|lines| lines.is_empty())
    }

    /// Returns the lines for a controller of this kind. Refuses a line that [`check_line`] refuses, a line that
    /// switches the tool on before or after the motion, tool lines where the host does not switch the tool, and one of
    /// `tool_on` and `tool_off` without the other.
    pub(crate) fn checked(self, kind: ControllerKind) -> Result<Self, Invalid> {
        for (name, lines) in [
            ("controller.prologue", &self.prologue),
            ("controller.epilogue", &self.epilogue),
            ("controller.tool_on", &self.tool_on),
            ("controller.tool_off", &self.tool_off),
        ] {
            for (i, line) in lines.iter().enumerate() {
                check_line(kind, line)
                    .map_err(|(problem, remedy)| Invalid::at_index(name, i, problem, remedy))?;
            }
        }
        for (name, lines) in
            [("controller.prologue", &self.prologue), ("controller.epilogue", &self.epilogue)]
        {
            let on = lines.iter().position(|line| self.tool_on.contains(line));
            if let Some(i) = on {
                let problem = format!("is {:?}, which switches the tool on", lines[i]);
                let remedy = "leave it out: the tool goes on with the motion";
                return Err(Invalid::at_index(name, i, problem, remedy));
            }
        }
        let host_switches = matches!(kind, ControllerKind::Galil | ControllerKind::Xps);
        if !(host_switches || self.tool_on.is_empty() && self.tool_off.is_empty()) {
            let problem = format!("is stated, and no host script of a {} reads it", kind.name());
            return Err(Invalid::whole("controller.tool_on", problem, "leave it out"));
        }
        if self.tool_on.is_empty() != self.tool_off.is_empty() {
            let remedy = "state both, or none";
            return Err(Invalid::whole(
                "controller.tool_on",
                "and tool_off are not both stated",
                remedy,
            ));
        }
        Ok(self)
    }
}

/// Checks one line of the machine file for a controller of this kind. Returns the problem and the remedy of a line that
/// is empty, too long, has characters that would break a program, or has a command that may move an axis, switch the
/// tool on, or change what later lines mean.
///
/// # Errors
/// As above.
pub fn check_line(kind: ControllerKind, line: &str) -> Result<(), (String, String)> {
    let short: String = line.chars().take(40).collect();
    let refusal = |problem: String, remedy: &str| Err((problem, remedy.to_string()));
    let Some((most, commands)) = language(kind) else {
        let problem =
            format!("is {short:?}, and a {} file has no place for a command", kind.name());
        return refusal(problem, "leave it out: the host waits and switches");
    };
    if line.trim().is_empty() || line.trim() != line {
        return refusal(format!("is {short:?}"), "give a command without blanks around it");
    }
    if line.len() > most {
        let problem = format!("is {short:?}..., of {} characters", line.len());
        return refusal(problem, &format!("give at most {most}, which the controller takes"));
    }
    let breaks = |c: &char| !(' '..='~').contains(c) || BREAKING.contains(c);
    if let Some(c) = line.chars().find(breaks) {
        let problem = format!("is {short:?}, and {c:?} would break the program");
        return refusal(problem, "give one command in printable ASCII, without a comment");
    }
    let upper = line.to_ascii_uppercase();
    let is_known = match kind {
        ControllerKind::Galil => is_galil(&upper),
        ControllerKind::Pmac => is_pmac(&upper),
        ControllerKind::Gcode => is_gcode(&upper),
        ControllerKind::Aerotech => upper.starts_with("DOUT ") || upper.starts_with("DWELL "),
        _ => is_xps(line),
    };
    if is_known {
        return Ok(());
    }
    let problem = format!(
        "is {short:?}, which is not known to leave axes, tool and modes of the program alone"
    );
    refusal(problem, &format!("give {commands}"))
}

/// Returns the length of a line and the commands of [`check_line`]; `None` if the file of the controller has no place
/// for a line.
fn language(kind: ControllerKind) -> Option<(usize, &'static str)> {
    Some(match kind {
        ControllerKind::Galil => (TERMINAL_LINE, "MG, WT, AI, SB, CB, AO or SH"),
        ControllerKind::Pmac => (TERMINAL_LINE, "M<n>=, DWELL<ms> or WHILE(...)WAIT"),
        ControllerKind::Gcode => (
            LONG_LINE,
            "G4 P, M0, M3 to M5, M7 to M9, S, M62 to M68 (not output 0 on) or M100 to M199",
        ),
        ControllerKind::Aerotech => (TERMINAL_LINE, "DOUT or DWELL"),
        ControllerKind::Xps => (
            LONG_LINE,
            "GPIODigitalSet(...), GPIOAnalogSet(...), TimerSet(...) or EventExtended...(...)",
        ),
        _ => return None,
    })
}

/// Returns true for a Galil command that waits, prints, or sets an output or the servo.
fn is_galil(line: &str) -> bool {
    let Some((command, rest)) = line.split_at_checked(2) else { return false };
    let numbers = |rest: &str| rest.split(',').all(|n| n.trim().parse::<f64>().is_ok());
    match command {
        "MG" => true,
        "SH" => rest.trim().chars().all(|c| c.is_ascii_uppercase()),
        "WT" | "AI" | "SB" | "CB" | "AO" => numbers(rest),
        _ => false,
    }
}

/// Returns true for `M<n>=`, `DWELL<ms>` and `WHILE(...)WAIT` of a PMAC.
fn is_pmac(line: &str) -> bool {
    let compact: String = line.chars().filter(|c| *c != ' ').collect();
    if let Some(ms) = compact.strip_prefix("DWELL") {
        return ms.parse::<f64>().is_ok_and(|ms| ms >= 0.0);
    }
    if let Some(condition) = compact.strip_prefix("WHILE(").and_then(|c| c.strip_suffix(")WAIT")) {
        return condition.chars().all(|c| c.is_ascii_alphanumeric() || "=!<>.".contains(c));
    }
    let assigned = compact.strip_prefix('M').and_then(|rest| rest.split_once('='));
    assigned.is_some_and(|(number, value)| {
        number.parse::<u32>().is_ok() && value.parse::<f64>().is_ok()
    })
}

/// Returns true for words of LinuxCNC that dwell, pause, switch spindle, coolant or an output, or wait for an input.
fn is_gcode(line: &str) -> bool {
    let compact: String = line.chars().filter(|c| *c != ' ').collect();
    let mut words = Vec::new();
    let mut rest = compact.as_str();
    while !rest.is_empty() {
        let end = rest[1..].find(|c: char| c.is_ascii_alphabetic()).map_or(rest.len(), |e| e + 1);
        let (word, after) = rest.split_at(end);
        let Ok(number) = word[1..].parse::<f64>() else { return false };
        words.push((&word[..1], number));
        rest = after;
    }
    let parameter = |letter: &str| words.iter().find(|w| w.0 == letter).map(|w| w.1);
    let mut commands = 0;
    for (letter, number) in &words {
        let is_good = match (*letter, *number) {
            ("G", 4.0) => parameter("P").is_some_and(|s| s >= 0.0),
            ("M", m) if m == 62.0 || m == 64.0 => parameter("P").is_some_and(|p| p != 0.0),
            ("M", m) => {
                [0.0, 3.0, 4.0, 5.0, 7.0, 8.0, 9.0].contains(&m)
                    || [63.0, 65.0, 66.0, 67.0, 68.0].contains(&m)
                    || ((100.0..=199.0).contains(&m) && m.fract() == 0.0)
            }
            ("S" | "P" | "L" | "Q" | "E", _) => continue,
            _ => false,
        };
        if !is_good {
            return false;
        }
        commands += 1;
    }
    commands == 1 || (commands == 0 && words.len() == 1 && words[0].0 == "S")
}

/// Returns true for a call of an XPS that sets an output or a timer, or configures an event.
fn is_xps(line: &str) -> bool {
    let Some((name, rest)) = line.split_once('(') else { return false };
    let is_call = rest.ends_with(')') && !rest[..rest.len() - 1].contains(['(', ')']);
    let is_known = ["GPIODigitalSet", "GPIOAnalogSet", "TimerSet"].contains(&name)
        || name
            .strip_prefix("EventExtended")
            .is_some_and(|n| n.chars().all(|c| c.is_ascii_alphabetic()));
    // An action of an event may move or run a program.
    let moves = ["Move", "ExecuteTCLScript", "KillTCLScript", "ExecuteCommand"];
    is_call && is_known && !moves.iter().any(|word| rest.contains(word))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_that_wait_and_switch_are_taken() {
        let cases: [(ControllerKind, &[&str]); 5] = [
            (ControllerKind::Galil, &["MG _TPA", "WT 500", "AI 1", "SB 3", "SHAB"]),
            (ControllerKind::Pmac, &["M2=1", "DWELL2000", "WHILE(M11=0) WAIT"]),
            (
                ControllerKind::Gcode,
                &[
                    "G4 P2",
                    "M3 S1000",
                    "M66 P1 L3 Q60",
                    "M64 P2",
                    "M65 P0",
                    "M101 P1",
                    "M0",
                    "S500",
                ],
            ),
            (ControllerKind::Aerotech, &["DOUT X,0,1", "DWELL 2"]),
            (ControllerKind::Xps, &["GPIODigitalSet(GPIO1.DO,1,1)", "EventExtendedWait()"]),
        ];
        for (kind, lines) in cases {
            for line in lines {
                assert_eq!(check_line(kind, line), Ok(()), "{kind:?} {line}");
            }
        }
    }

    /// Checks that a line is refused that moves an axis, switches the tool on, changes a mode or breaks the program.
    #[test]
    fn lines_that_move_or_break_are_refused() {
        let cases: [(ControllerKind, &[&str]); 7] = [
            (
                ControllerKind::Galil,
                &[
                    "PA 1,1",
                    "BGA",
                    "PVA=1,0,2",
                    "XQ #BEAM",
                    "SB 1;BGA",
                    "ST",
                    "JG 5",
                    "TM 500",
                    "s",
                    "OP 1",
                ],
            ),
            (
                ControllerKind::Pmac,
                &["X1", "M1==1", "RAPID", "INC", "CMD", "M1=1 X5", "DWELL-1", "P1=2"],
            ),
            (
                ControllerKind::Gcode,
                &[
                    "G0 X1",
                    "G91",
                    "G20",
                    "G92 X0",
                    "G10 L2 P1 X1",
                    "M6 T1",
                    "M62 P0",
                    "M64 P0",
                    "M2",
                    "G4",
                    "o<x> call",
                    "M3 G0 X1",
                    "F5",
                    "M100.5",
                ],
            ),
            (
                ControllerKind::Aerotech,
                &["LINEAR X 1", "PVT X 1,0 TIME 1", "END PROGRAM", "VELOCITY OFF"],
            ),
            (
                ControllerKind::Xps,
                &[
                    "GroupMoveAbsolute(G,1)",
                    "GPIODigitalSet(A,1);GroupKill(G)",
                    "EventExtendedRemove(1)GroupKill(G)",
                    "EventExtendedConfigurationActionSet(ExecuteTCLScript,a,b,c)",
                ],
            ),
            (ControllerKind::Csv, &["M3"]),
            (ControllerKind::Ros, &["M3"]),
        ];
        for (kind, lines) in cases {
            for line in lines {
                assert!(check_line(kind, line).is_err(), "{kind:?} {line}");
            }
        }
        for line in ["", " M3", "M3 (on)", "M3\nM2", "M3 \u{fc}"] {
            assert!(check_line(ControllerKind::Gcode, line).is_err(), "{line:?}");
        }
        let long = format!("M66 P1 L3 Q{}", "0".repeat(250));
        assert!(check_line(ControllerKind::Gcode, &long).is_err());
    }

    #[test]
    fn the_tool_stays_off_outside_the_motion() {
        let lines = |list: &[&str]| list.iter().map(ToString::to_string).collect::<Vec<_>>();
        let galil = ControllerLines {
            tool_on: lines(&["SB 1"]),
            tool_off: lines(&["CB 1"]),
            ..ControllerLines::default()
        };
        assert!(galil.clone().checked(ControllerKind::Galil).is_ok());
        let early = ControllerLines { prologue: lines(&["SB 3", "SB 1"]), ..galil.clone() };
        let said = early.checked(ControllerKind::Galil).unwrap_err().to_string();
        assert!(
            said.contains("controller.prologue[1]: is \"SB 1\", which switches the tool"),
            "{said}"
        );
        let half = ControllerLines { tool_off: vec![], ..galil.clone() };
        assert!(half.checked(ControllerKind::Galil).is_err());
        assert!(galil.checked(ControllerKind::Pmac).is_err());
    }
}
