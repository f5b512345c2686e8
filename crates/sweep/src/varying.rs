//! Tools that vary over the part. The setting `varying` holds the command that makes such a tool; the sweep runs it
//! together with the steps of the mirror.

/// Subcommands of `planish tool` that make a varying tool from a TIF and a map.
const COMMANDS: [&str; 5] = ["incidence", "rate", "footprint", "edge", "turned"];

/// Second names that some of these subcommands have.
const SECOND_NAMES: [&str; 4] = ["tool-rate", "tool-footprint", "tool-edge", "tool-turned"];

/// Value of the setting for a tool that is the same everywhere.
pub const NONE: &str = "none";

/// Flags that the sweep itself adds to the command, so that the setting must not contain them.
const OWN_FLAGS: [&str; 6] = ["--tif", "--surface", "--out", "--force", "--picture", "--wall-time"];

/// Flags of the command whose value is the path of a file or directory.
const PATH_FLAGS: [&str; 2] = ["--form", "--table"];

/// Describes the allowed values of the setting `varying`, for messages.
pub fn wanted() -> String {
    format!("{NONE}, or the words of planish tool {}, with their flags", COMMANDS.join(", "))
}

/// Checks that `text` is an allowed value of the setting `varying`.
///
/// # Errors
/// Fails with the values that the setting may have.
pub fn check(text: &str) -> Result<(), String> {
    if text == NONE {
        return Ok(());
    }
    let mut words = text.split_whitespace();
    let command = words.next().unwrap_or_default();
    if !COMMANDS.contains(&command) && !SECOND_NAMES.contains(&command) {
        return Err(wanted());
    }
    match own_flag(text) {
        None => Ok(()),
        Some(flag) => {
            Err(format!("it without {flag}: the sweep gives --tif, --surface, --out and --force"))
        }
    }
}

/// Returns the first flag in a text that the sweep itself adds; `None` if it contains none.
pub fn own_flag(text: &str) -> Option<&str> {
    let flags =
        text.split_whitespace().map(|word| word.split_once('=').map_or(word, |(flag, _)| flag));
    flags.into_iter().find(|flag| OWN_FLAGS.contains(flag))
}

/// Replaces every path in the words of a command by the path that `place` returns for it.
///
/// # Errors
/// Fails where `place` does.
pub fn with_places<E>(
    words: Vec<String>,
    mut place: impl FnMut(&str) -> Result<String, E>,
) -> Result<Vec<String>, E> {
    let mut is_path = false;
    let each = words.into_iter().map(|word| {
        let joined = word.split_once('=').filter(|(flag, _)| PATH_FLAGS.contains(flag));
        let replaced = match (is_path, joined) {
            (true, _) => place(&word)?,
            (false, Some((flag, path))) => format!("{flag}={}", place(path)?),
            (false, None) => word.clone(),
        };
        is_path = PATH_FLAGS.contains(&word.as_str());
        Ok(replaced)
    });
    each.collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn paths_are_replaced_wherever_they_stand() {
        let words = "rate --by radius --table a/b --form=c --exponent=-1".split(' ');
        let words = words.map(String::from).collect();
        let found = with_places(words, |path| Ok::<_, ()>(format!("/root/{path}"))).unwrap();
        let expected = "rate --by radius --table /root/a/b --form=/root/c --exponent=-1";
        assert_eq!(found.join(" "), expected);
    }
}
