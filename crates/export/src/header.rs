//! The comment at the head of a program, which describes it in lines that the controller accepts.

use crate::{About, decimal};

/// Beginning of a line that continues the text of the line before. LinuxCNC takes a comment that begins with a word
/// like MSG as a command, but not one that begins with dots.
const CONTINUED: &str = "... ";

/// Checksum line of a text whose checksum is not known yet.
pub(crate) const UNSEALED: &str = "checksum: crc32 00000000 of the lines below";

/// Returns the line that says that a program is a dry run; `None` if it is none.
pub(crate) fn dry_run_line(about: &About) -> Option<String> {
    about.dry_run.then(|| "DRY RUN: the tool stays off, nobody switches it on".to_string())
}

/// Form of a comment of a controller: the characters that open and close it, and the length of a line.
pub(crate) struct Comment {
    pub open: &'static str,
    pub close: &'static str,
    /// Largest number of characters of a line, with `open` and `close`.
    pub line: usize,
}

impl About {
    /// Returns the lines of a header, each a whole comment. `units` describes the units of the program.
    ///
    /// Names and paths come from the user. Each character that is not printable ASCII, or that ends a comment or a
    /// command on a controller (brackets, semicolon, the backquote of a Galil), becomes `_`.
    pub(crate) fn header(&self, comment: &Comment, units: &str) -> String {
        let starts = self.starts().into_iter();
        let starts = starts.map(|(name, unit, p)| format!("{name} {} {unit}", decimal(p, 9)));
        let mut lines = vec![UNSEALED.to_string()];
        lines.extend(dry_run_line(self));
        lines.extend([
            format!("{} for {}, written by {}", self.controller, self.machine, self.made_by),
            format!("made from: {}", self.made_from),
            format!("units: {units}"),
            format!("start: {}", starts.collect::<Vec<_>>().join(", ")),
            format!("{} segments, total time {} s", self.segments, decimal(self.total_time_s, 9)),
            format!("tool: {}", self.tool),
        ]);
        lines.extend(self.preamble.iter().cloned());
        if let (Some(segments), Some(s)) = (self.buffer_segments, self.buffer_lasts_s) {
            lines.push(format!(
                "buffer of the controller: {segments} segments, which last {} s at least; the host has to send the \
                 next segments within this time",
                decimal(s, 6)
            ));
        }
        lines.extend(self.warnings.iter().map(|w| format!("warning: {w}")));
        comment.lines(lines)
    }
}

impl Comment {
    /// Returns these sentences as lines, each a whole comment; a long sentence goes on in further lines.
    pub(crate) fn lines(&self, sentences: impl IntoIterator<Item = String>) -> String {
        let room = self.line - self.open.len() - self.close.len();
        let mut text = String::new();
        for line in sentences {
            let is_plain = |c: &char| (' '..='~').contains(c) && !"();`".contains(*c);
            let line: Vec<char> =
                line.chars().map(|c| if is_plain(&c) { c } else { '_' }).collect();
            for part in parts(&line, room) {
                text += self.open;
                text += &part;
                text += self.close;
                text += "\n";
            }
        }
        text
    }
}

/// Cuts `line` into parts of at most `room` characters, at spaces where possible; each part but the first begins with
/// [`CONTINUED`].
fn parts(line: &[char], room: usize) -> Vec<String> {
    let mut parts = Vec::new();
    let mut rest = line;
    let mut room_now = room;
    let mut begin = "";
    while rest.len() > room_now {
        let space = rest[..room_now].iter().rposition(|c| *c == ' ');
        let end = space.filter(|s| *s >= room_now / 2).map_or(room_now, |s| s + 1);
        let text: String = rest[..end].iter().collect();
        parts.push(format!("{begin}{}", text.trim_end()));
        rest = &rest[end..];
        begin = CONTINUED;
        room_now = room - CONTINUED.len();
    }
    let text: String = rest.iter().collect();
    parts.push(format!("{begin}{text}"));
    parts
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_long_line_is_several_and_loses_nothing() {
        let long: Vec<char> = "made from: ".chars().chain(std::iter::repeat_n('a', 100)).collect();
        let parts = parts(&long, 40);
        assert!(parts.iter().all(|p| p.len() <= 40), "{parts:?}");
        let whole: String = parts.iter().map(|p| p.trim_start_matches(CONTINUED)).collect();
        assert_eq!(whole.matches('a').count(), 101);
        let words: Vec<char> = "one two three four five".chars().collect();
        assert_eq!(super::parts(&words, 12), ["one two", "... three", "... four", "... five"]);
        assert_eq!(super::parts(&[], 12), [""]);
    }
}
