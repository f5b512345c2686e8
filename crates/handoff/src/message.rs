//! Messages on standard error: what could command a terminal is spelt out, and none is longer than a screen.

use std::{borrow::Cow, io::Write};

use planish_types::text;

/// Most characters of a message. It begins with the file and the problem and ends with the remedy; what is longer repeats
/// a damaged value. Larger: such a value fills the screen; smaller: a list of settings would be cut.
const MOST_CHARACTERS: usize = 4000;

/// Characters of a longer message that are kept at its beginning and at its end.
const KEPT_CHARACTERS: [usize; 2] = [1200, 800];

/// Lines on standard error; a closed pipe is not an error.
pub(crate) fn complain(message: &str) {
    let _ = writeln!(std::io::stderr(), "{}", shortened(&without_commands(message)));
}

/// A message of at most [`MOST_CHARACTERS`]: of a longer one the middle is left out, and how much that is said.
pub(crate) fn shortened(message: &str) -> Cow<'_, str> {
    let count = message.chars().count();
    if count <= MOST_CHARACTERS {
        return Cow::Borrowed(message);
    }
    let [first, last] = KEPT_CHARACTERS;
    let left_out = count - first - last;
    let begin: String = message.chars().take(first).collect();
    let end: String = message.chars().skip(first + left_out).collect();
    Cow::Owned(format!("{begin} [... {left_out} characters are left out ...] {end}"))
}

/// The lines of `message` with what could command a terminal spelt out: names of files are in it.
pub(crate) fn without_commands(message: &str) -> String {
    message.split('\n').map(text::visible).collect::<Vec<_>>().join("\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_message_that_repeats_a_damaged_value_keeps_its_beginning_and_its_end() {
        let message =
            |length| format!("a.json: '{}' is no number; give one", "\u{e9}".repeat(length));
        let short = message(3000);
        assert_eq!(shortened(&short), short);
        let long = message(70_000);
        let cut = shortened(&long);
        assert!(cut.starts_with("a.json: '\u{e9}") && cut.ends_with("' is no number; give one"));
        assert!(cut.chars().count() < 2100, "{}", cut.chars().count());
        let left_out = long.chars().count() - 2000;
        assert!(cut.contains(&format!("[... {left_out} characters are left out ...]")), "{cut}");
    }
}
