//! A program in several files that follow each other.
//!
//! A controller that takes lines while it runs (Galil, a rotary buffer of a PMAC), and a table, go on from one file to
//! the next without a stop: the files have the lines of one program. Programs for all other controllers end at rest, so
//! their parts are made as programs of their own, between two marks, with a run-up and a run-down
//! ([`crate::ProgramSettings::marks`]).
//!
//! Each later part names the checksum of the part before it. So a reader, and a host that sends the parts, find a part
//! that is missing or in the wrong place.

use planish_types::ControllerKind;
use serde::Serialize;

use crate::{
    Marks, Program, ProgramSettings, around, decimal, header, header::UNSEALED, pmac::PmacBuffer,
};

/// Place of a file among the parts of a program.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ProgramPart {
    /// Number of the part, from 1.
    pub number: usize,
    /// Number of parts.
    pub parts: usize,
    /// True if the motion goes on from this part to the next one without a stop, so that all parts are one program.
    pub joins: bool,
    /// Index of the first mark of the part in the whole program.
    pub first_mark: usize,
    /// CRC-32 in the first line of the part before; `None` in the first part, and in parts that do not join.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub after: Option<String>,
}

/// Returns true if the parts of a program of this kind join without a stop.
pub fn joins_without_stop(kind: ControllerKind, settings: &ProgramSettings) -> bool {
    match kind {
        ControllerKind::Galil | ControllerKind::Csv => true,
        ControllerKind::Pmac => matches!(settings.pmac.buffer, PmacBuffer::Rotary(_)),
        _ => false,
    }
}

/// Returns the first marks of `parts` parts of nearly the same number of segments, and the number of segments.
pub fn cuts(segments: usize, parts: usize) -> Vec<usize> {
    (0..=parts).map(|k| k * segments / parts).collect()
}

/// Returns the parts of a program whose parts join without a stop; `cuts` are their first marks, and the number of
/// segments.
///
/// # Panics
/// Panics if `cuts` do not ascend from 0 to the number of segments, or if the file of the controller has no comments.
pub fn in_parts(
    program: &Program,
    kind: ControllerKind,
    settings: &ProgramSettings,
    cuts: &[usize],
) -> Vec<Program> {
    let comment = around::comment(kind).expect("a controller whose parts join has comments");
    let lines: Vec<&str> = program.text.lines().collect();
    let marks = program.about.marks.all();
    let count = cuts.len() - 1;
    let mut parts: Vec<Program> = Vec::with_capacity(count);
    let mut after = None;
    for (k, cut) in cuts.windows(2).enumerate() {
        let [from, to] = [cut[0], cut[1]];
        // Of the first part the header; its checksum is another one.
        let begin = if k == 0 { 1 } else { marks[from].line - 1 };
        let end = if k + 1 == count { lines.len() } else { marks[to].line - 1 };
        let mut head = vec![UNSEALED.to_string()];
        head.extend(header::dry_run_line(&program.about).filter(|_| k > 0));
        head.push(format!("part {} of {count}, joined without a stop", k + 1));
        if let Some(before) = &after {
            let place: Vec<String> = marks[from].position.iter().map(|p| decimal(*p, 6)).collect();
            head.push(format!("after the part with the checksum crc32 {before}"));
            head.push(format!(
                "goes on at {} s, at {}",
                decimal(marks[from].time_s, 6),
                place.join(", ")
            ));
        }
        let opening = settings.pmac.buffer.opening();
        let is_opened = kind == ControllerKind::Pmac && !opening.is_empty();
        let mut text = comment.lines(head);
        if is_opened && k > 0 {
            text += &opening;
        }
        // Lines of this part are later by this many than in the whole program.
        let first_line = text.lines().count() + 1;
        text.extend(lines[begin..end].iter().flat_map(|line| [*line, "\n"]));
        if is_opened && k + 1 < count {
            text += "CLOSE\n";
        }
        let text = around::sealed(&text);
        let own_marks = marks[from..to].iter().cloned().map(|mut mark| {
            mark.line = mark.line - (begin + 1) + first_line;
            mark
        });
        let mut about = program.about.clone();
        about.part =
            Some(ProgramPart { number: k + 1, parts: count, joins: true, first_mark: from, after });
        about.segments = to - from;
        about.total_time_s = marks.get(to).map_or(about.total_time_s, |mark| mark.time_s);
        about.marks = Marks::from_list(own_marks.collect());
        about.program_blake3 = blake3::hash(text.as_bytes()).to_hex().to_string();
        let position = &marks[from].position;
        about.start_mm = about.start_mm.map(|_| [position[0], position[1]]);
        about.axes.iter_mut().zip(position).for_each(|(axis, p)| axis.start = *p);
        after = Some(around::checksum(text.lines().skip(1)));
        parts.push(Program { text, about });
    }
    parts
}
