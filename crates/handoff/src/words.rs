//! Conversion between a text of several words, such as `--unit m --variable 'my map'`, and the list of its words.
//!
//! Words are separated by spaces, tabs and line feeds. Characters that a shell would evaluate (`$`, backticks, `*`,
//! `~`, `;`, `#`, ...) have no special meaning. Quoting is that of a POSIX shell:
//!
//! | written | means |
//! |---|---|
//! | `'...'` | the characters as they are |
//! | `"..."` | the characters as they are, but `\` before one of `"`, `\`, `$`, `` ` `` is dropped |
//! | `\c` | the character c |

/// Reason why a text cannot be split into words.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Unfinished {
    /// A quotation mark that is never closed.
    #[error(
        "the quotation mark {mark} at byte {at} is not closed; close it, or write \\{mark} for the mark itself"
    )]
    Quote {
        /// The quotation mark, `'` or `"`.
        mark: char,
        /// Byte of the mark in the text, counted from 0.
        at: usize,
    },
    /// A backslash at the end.
    #[error("the backslash at the end stands before nothing; write \\\\ for a backslash")]
    Backslash,
}

/// Splits `text` into its words.
///
/// # Errors
/// Refuses a quotation mark that is not closed, and a backslash at the end.
pub fn split(text: &str) -> Result<Vec<String>, Unfinished> {
    let mut words = Vec::new();
    // `None` between two words; an empty word, '', is a word.
    let mut word: Option<String> = None;
    let mut rest = text.char_indices();
    while let Some((at, c)) = rest.next() {
        match c {
            ' ' | '\t' | '\n' => words.extend(word.take()),
            '\'' | '"' => {
                let word = word.get_or_insert_default();
                loop {
                    match rest.next() {
                        None => return Err(Unfinished::Quote { mark: c, at }),
                        Some((_, end)) if end == c => break,
                        Some((_, '\\')) if c == '"' => match rest.next() {
                            None => return Err(Unfinished::Quote { mark: c, at }),
                            Some((_, escaped @ ('"' | '\\' | '$' | '`'))) => word.push(escaped),
                            Some((_, other)) => word.extend(['\\', other]),
                        },
                        Some((_, inside)) => word.push(inside),
                    }
                }
            }
            '\\' => {
                let (_, escaped) = rest.next().ok_or(Unfinished::Backslash)?;
                word.get_or_insert_default().push(escaped);
            }
            other => word.get_or_insert_default().push(other),
        }
    }
    words.extend(word);
    Ok(words)
}

/// Returns the word so that a shell, or [`split`], reads it back. It gets quotation marks only if it needs them.
pub fn quote(word: &str) -> String {
    let mut characters = word.chars();
    let is_plain = characters.all(|c| c.is_ascii_alphanumeric() || "-_./:,+@%".contains(c));
    if !word.is_empty() && is_plain {
        return word.to_string();
    }
    format!("'{}'", word.replace('\'', r"'\''"))
}

/// Joins words into one text, each as [`quote`] writes it.
pub fn join<S: AsRef<str>>(words: impl IntoIterator<Item = S>) -> String {
    let quoted: Vec<String> = words.into_iter().map(|word| quote(word.as_ref())).collect();
    quoted.join(" ")
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn words_are_separated_by_blanks_and_quoted_as_in_a_shell() {
        for (text, words) in [
            ("", vec![]),
            (" \t\n", vec![]),
            ("--rate --unit m", vec!["--rate", "--unit", "m"]),
            ("  --a\n\t--b ", vec!["--a", "--b"]),
            ("--name 'my map'", vec!["--name", "my map"]),
            ("--name \"it's\"", vec!["--name", "it's"]),
            (r"it\'s my\ map", vec!["it's", "my map"]),
            (r#""a\"b\\c\$d\n""#, vec![r#"a"b\c$d\n"#]),
            ("a''b '' \"\"", vec!["ab", "", ""]),
            ("x'y z'\"w\"", vec!["xy zw"]),
            // Nothing is evaluated, and `#` does not begin a comment.
            (
                "$HOME `ls` $(ls) * ~ #3 a;b |&<>",
                vec!["$HOME", "`ls`", "$(ls)", "*", "~", "#3", "a;b", "|&<>"],
            ),
            ("{{ out }}", vec!["{{", "out", "}}"]),
        ] {
            assert_eq!(split(text).unwrap(), words, "{text}");
        }
    }

    #[test]
    fn what_is_not_closed_is_refused_with_its_place() {
        assert_eq!(split("a 'b c"), Err(Unfinished::Quote { mark: '\'', at: 2 }));
        assert_eq!(split("\"b\\"), Err(Unfinished::Quote { mark: '"', at: 0 }));
        assert_eq!(split("a\\"), Err(Unfinished::Backslash));
        let message = split("--name 'x").unwrap_err().to_string();
        assert!(message.contains("' at byte 7 is not closed"), "{message}");
    }

    #[test]
    fn plain_words_stay_as_they_are() {
        assert_eq!(
            join(["planish-dwell", "--out", "out/a_b.c", ""]),
            "planish-dwell --out out/a_b.c ''"
        );
        assert_eq!(quote("it's"), r"'it'\''s'");
        assert_eq!(quote("a=b"), "'a=b'");
    }

    proptest! {
        #[test]
        fn what_is_joined_is_split_into_the_same_words(words: Vec<String>) {
            prop_assert_eq!(split(&join(&words)), Ok(words));
        }
    }
}
