//! Messages on standard error. Characters that could command a terminal are escaped, and no message
//! is longer than a screen.

use std::{borrow::Cow, io::Write};

use planish_types::text;

use crate::from_run::in_settings;

/// Largest length of a message, characters. It begins with the file and the problem and ends with
/// the remedy; a longer message repeats a damaged value. Larger: such a value fills the screen.
/// Smaller: a list of settings would be cut.
const MOST_CHARACTERS: usize = 4000;

/// Number of characters of a longer message that are kept at its beginning and at its end. Larger:
/// more of a damaged value. Smaller: the problem or the remedy is cut. Their sum has to be below
/// [`MOST_CHARACTERS`].
const KEPT_CHARACTERS: [usize; 2] = [1200, 800];

/// Prints a message on standard error, escaped and shortened; a closed pipe is not an error.
pub(crate) fn complain(message: &str) {
    let message = without_commands(&in_settings(message));
    let _ = writeln!(std::io::stderr(), "{}", shortened(&message));
}

/// Shortens a message of more than [`MOST_CHARACTERS`]: keeps its beginning and its end ([`KEPT_CHARACTERS`]), and
/// replaces its middle by the number of omitted characters.
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

/// Escapes the characters in the lines of `message` that could command a terminal; file names may
/// contain such characters.
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
