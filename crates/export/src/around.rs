//! Text around the motion of a program: checksum, dry run, lines of the machine file, and how to run it.
//!
//! The first line of a program that can have comments is its checksum,
//!
//! ```text
//! checksum: crc32 9f3c21aa of the lines below
//! ```
//!
//! the CRC-32 of zlib over the lines below it, each with one line feed at its end, whatever ends it in the file. A
//! program that was cut off, edited, or changed on its way to the controller has another one.

use planish_types::{ControllerKind, ControllerLines, Machine};

use crate::{
    Job, aerotech, automation1, csv, galil, gcode,
    header::{Comment, UNSEALED},
    pmac,
    pmac::PmacBuffer,
    sinumerik, twincat,
};

/// First lines of the parts of a text that the machine file states, and the line that ends each.
const PROLOGUE: [&str; 2] = ["prologue of the machine file", "end of the prologue"];
const EPILOGUE: [&str; 2] = ["epilogue of the machine file", "end of the epilogue"];

/// Returns the form of the comments of a controller; `None` if its file can have none.
pub(crate) fn comment(kind: ControllerKind) -> Option<&'static Comment> {
    match kind {
        ControllerKind::Galil => Some(&galil::COMMENT),
        ControllerKind::Pmac => Some(&pmac::COMMENT),
        ControllerKind::Gcode => Some(&gcode::COMMENT),
        ControllerKind::Csv => Some(&csv::COMMENT),
        ControllerKind::Aerotech => Some(&aerotech::COMMENT),
        ControllerKind::Automation1 => Some(&automation1::COMMENT),
        ControllerKind::Sinumerik | ControllerKind::SinumerikPoly => Some(&sinumerik::COMMENT),
        ControllerKind::Twincat => Some(&twincat::COMMENT),
        ControllerKind::Xps
        | ControllerKind::XpsPt
        | ControllerKind::Ros
        | ControllerKind::Zaber => None,
    }
}

/// Returns the CRC-32 of these lines, as eight hexadecimal digits.
pub(crate) fn checksum<'a>(lines: impl Iterator<Item = &'a str>) -> String {
    let mut hasher = crc32fast::Hasher::new();
    for line in lines {
        hasher.update(line.as_bytes());
        hasher.update(b"\n");
    }
    format!("{:08x}", hasher.finalize())
}

/// Returns the text with its checksum in the first line, if that is a line for it.
pub(crate) fn sealed(text: &str) -> String {
    let Some((first, rest)) = text.split_once('\n').filter(|(first, _)| first.contains(UNSEALED))
    else {
        return text.into();
    };
    let digits = checksum(rest.lines());
    format!("{}\n{rest}", first.replace("00000000", &digits))
}

/// Lines of a machine file whose controller is of another kind.
static NO_LINES: ControllerLines = ControllerLines {
    prologue: Vec::new(),
    epilogue: Vec::new(),
    tool_on: Vec::new(),
    tool_off: Vec::new(),
};

/// Returns the lines that the machine file states for a controller of this kind.
pub(crate) fn lines_for(machine: &Machine, kind: ControllerKind) -> &ControllerLines {
    if machine.controller().is_some_and(|own| own.kind == kind) {
        machine.controller_lines()
    } else {
        &NO_LINES
    }
}

impl<const N: usize> Job<'_, N> {
    /// Returns the lines that the machine file states for this controller.
    pub(crate) fn lines(&self) -> &ControllerLines {
        lines_for(self.plan.machine, self.grids.kind)
    }

    /// Returns the warning about lines of the machine file that this program does not have, because it is for another
    /// controller than that of the machine file; `None` if there is nothing to warn of.
    pub(crate) fn lines_left_out(&self) -> Option<String> {
        let own = self.plan.machine.controller()?;
        let is_other =
            own.kind != self.grids.kind && !self.plan.machine.controller_lines().is_empty();
        is_other.then(|| {
            format!(
                "the machine file states lines for its controller, {}, and this is a program for {}: they are left out",
                own.kind.name(),
                self.grids.kind.name()
            )
        })
    }

    /// Returns the text of the prologue of the machine file between two comments; empty without a prologue.
    pub(crate) fn prologue(&self) -> String {
        self.block(PROLOGUE, &self.lines().prologue)
    }

    /// Returns the text of the epilogue of the machine file between two comments; empty without an epilogue.
    pub(crate) fn epilogue(&self) -> String {
        self.block(EPILOGUE, &self.lines().epilogue)
    }

    fn block(&self, [begin, end]: [&str; 2], lines: &[String]) -> String {
        let Some(comment) = comment(self.grids.kind).filter(|_| !lines.is_empty()) else {
            return String::new();
        };
        let lines: String = lines.iter().map(|line| format!("{line}\n")).collect();
        comment.lines([begin.into()]) + &lines + &comment.lines([end.into()])
    }
}

/// Returns the sentences that say how to load, start and stop a program, and how to find the line of an abort; empty
/// for a controller of which no source was read.
pub(crate) fn handling(kind: ControllerKind, buffer: PmacBuffer) -> Vec<String> {
    let [load, start, stop, abort] = match kind {
        ControllerKind::Galil => [
            "a host sends the lines one by one and keeps the buffer filled. --host-script FILE writes such a host for gclib",
            "BT, which stands where the buffer is full. The host checks position and TM first",
            "tool off, then ST: the axes slow down at DC",
            "tool off, then AB. MG _BTA is the number of segments that have run since BT, the index of the mark",
        ],
        ControllerKind::Xps => [
            "by FTP, or SFTP on an XPS-D, into the folder Trajectories of the controller",
            "MultipleAxesPVTVerification, then MultipleAxesPVTExecution once. --commands FILE writes these calls",
            "tool off, then GroupMoveAbort",
            "MultipleAxesPVTParametersGet gives the number of the current element, from 1: the mark is one less",
        ],
        ControllerKind::Pmac => pmac_handling(buffer),
        ControllerKind::Gcode => [
            "open this file",
            "from its first line only. Run-from-line leaves out the modes: --from-mark writes the rest",
            "abort. A pause leaves output 0, and with it the tool, as it is",
            "motion_line of the status of LinuxCNC, which the user interface highlights",
        ],
        ControllerKind::Csv => [
            "as the controller takes a table",
            "from the first row, where the axes have to stand",
            "tool off, then stop",
            "the time since the start gives the mark",
        ],
        ControllerKind::Ros => [
            "send the message as a goal of FollowJointTrajectory, which can be cancelled",
            "header.stamp is 0: the motion begins when the message arrives",
            "tool off, then cancel the goal",
            "time_from_start in the feedback gives the mark",
        ],
        ControllerKind::Aerotech => [
            "open it as a program of a task, and build it",
            "run the task",
            "tool off, then stop the task",
            "the task stops at a line up to 16 commands ahead of the motion: compare positions with the marks",
        ],
        ControllerKind::Automation1 => [
            "copy it to the controller, as a program of a task",
            "run the task",
            "tool off, then stop the task",
            "the task is ahead of the motion: compare positions with the marks",
        ],
        ControllerKind::Sinumerik | ControllerKind::SinumerikPoly => [
            "copy it to the part programs of the controller",
            "NC Start in the mode AUTO, from its first line. A block search leaves out the modes: --from-mark writes the rest",
            "tool off, then NC Stop. A feed hold would leave the tool over one place",
            "the panel shows the block that is executed: its line is that of the mark",
        ],
        ControllerKind::Twincat => [
            "copy it to the PLC, where bLoad of our program (docs/twincat-table.st) reads it",
            "bStart of our program, with the axes at the start",
            "bAbort: bToolOn goes off in the same cycle, and the axes stop by MC_Stop",
            "nRow is the row that was fed last: its column `segment` is the mark",
        ],
        ControllerKind::XpsPt => [
            "by FTP, or SFTP on an XPS-D, into the folder Trajectories of the controller",
            "MultipleAxesPTVerification, then MultipleAxesPTExecution once",
            "tool off, then GroupMoveAbort",
            "MultipleAxesPTParametersGet gives the number of the current element, from 1: the mark is one less",
        ],
        ControllerKind::Zaber => [
            "as a sequence of Zaber Launcher, or line by line to the controller by the Motion Library",
            "run the sequence once, with the axes at the start",
            "tool off, then stop",
            "the controller does not say its point: compare positions with the marks",
        ],
    };
    [("load", load), ("start it", start), ("stop", stop), ("abort", abort)]
        .map(|(what, how)| format!("{what}: {how}"))
        .to_vec()
}

/// Returns the four sentences of [`handling`] for a PMAC.
fn pmac_handling(buffer: PmacBuffer) -> [&'static str; 4] {
    match buffer {
        PmacBuffer::Rotary(_) => [
            "DEFINE ROT once after power-up, from the highest coordinate system to the lowest, then B0, then this file \
             while it runs",
            "R, after B0 and the first lines",
            "tool off, then A: the axes slow down at Ixx95",
            "PR is the number of lines that are still in the buffer. LIST PC lists the line that is read next, one or \
             two moves ahead",
        ],
        _ => [
            "from OPEN PROG n CLEAR to CLOSE, with no program running",
            "B n, then R, in the coordinate system of the axes",
            "tool off, then A: the axes slow down at Ixx95. H, a feed hold, would leave the tool over one place",
            "LIST PC lists the line that is read next, one or two moves ahead of the motion",
        ],
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Checks the CRC-32 against its published check value: that of the ASCII digits 1 to 9 is cbf43926.
    #[test]
    fn the_checksum_is_crc_32_of_the_lines_below() {
        assert_eq!(format!("{:08x}", crc32fast::hash(b"123456789")), "cbf43926");
        let text = format!("({UNSEALED})\nG1\r\nM2\n");
        let sealed = sealed(&text);
        let expected = format!("{:08x}", crc32fast::hash(b"G1\nM2\n"));
        assert!(sealed.starts_with(&format!("(checksum: crc32 {expected} of")), "{sealed}");
        assert!(sealed.ends_with(")\nG1\r\nM2\n"));
        assert_eq!(super::sealed("0.1, 1, 0\n"), "0.1, 1, 0\n");
    }

    #[test]
    fn every_controller_says_how_to_run_its_program() {
        for kind in ControllerKind::ALL {
            assert_eq!(handling(kind, PmacBuffer::OfTheHost).len(), 4, "{kind:?}");
        }
    }
}
