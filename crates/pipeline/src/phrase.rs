//! Texts with names in braces, and conditions: the two small languages of a definition file.

/// A line of a definition: its text, and the condition under which the line counts.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DefinitionLine {
    /// Text of the line before ` when `, with names in braces unexpanded.
    pub text: String,
    /// Terms of the condition, all of which must hold; empty if the line always counts.
    pub condition: Vec<Term>,
}

/// Part of a condition: `NAME`, `not NAME`, `NAME is A or B`, `NAME is not A or B`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Term {
    /// Name of a setting, a value or a fact, whose words the term tests.
    pub name: String,
    /// Words of which at least one must be among the words of the name. If empty, the term requires that the name has
    /// any word.
    pub choices: Vec<String>,
    /// True if the test must fail for the term to hold (`not`).
    pub negated: bool,
}

/// Returns true if `text` can be a name in braces: small letters, digits and underscores.
pub fn is_name(text: &str) -> bool {
    !text.is_empty()
        && text.bytes().all(|b| b.is_ascii_lowercase() || b.is_ascii_digit() || b == b'_')
}

impl DefinitionLine {
    /// Reads a line of the form `TEXT` or `TEXT when CONDITION`.
    ///
    /// # Errors
    /// Fails with a message if the condition is none.
    pub fn read(line: &str) -> Result<Self, String> {
        let Some((text, condition)) = line.rsplit_once(" when ") else {
            return Ok(Self { text: line.trim().into(), condition: vec![] });
        };
        let condition = condition.split(" and ").map(Term::read).collect::<Result<_, _>>()?;
        Ok(Self { text: text.trim().into(), condition })
    }
}

impl Term {
    fn read(text: &str) -> Result<Self, String> {
        let words: Vec<&str> = text.split_whitespace().collect();
        let (name, negated, choices) = match &words[..] {
            [name] => (*name, false, &[][..]),
            ["not", name] => (*name, true, &[][..]),
            [name, "is", "not", choices @ ..] if is_list(choices) => (*name, true, choices),
            [name, "is", choices @ ..] if is_list(choices) => (*name, false, choices),
            _ => ("", false, &[][..]),
        };
        if !is_name(name) {
            return Err(format!(
                "'{text}' is no condition; write NAME, not NAME, NAME is A, NAME is A or B, or NAME is not A, where A is one \
                 of the words of NAME. These replace `in` and `begins with`; machine_by_default replaces `by default`"
            ));
        }
        let choices = choices.iter().step_by(2).map(|word| word.to_string()).collect();
        Ok(Self { name: name.into(), choices, negated })
    }

    /// Returns true if the term holds when its name stands for `words`.
    pub fn holds(&self, words: &[String]) -> bool {
        let is_met = match &self.choices[..] {
            [] => !words.is_empty(),
            choices => choices.iter().any(|choice| words.contains(choice)),
        };
        is_met != self.negated
    }
}

/// Returns true if `words` are alternatives: `A`, `A or B`, `A or B or C`, and so on.
fn is_list(words: &[&str]) -> bool {
    let is_joined = words.iter().skip(1).step_by(2).all(|word| *word == "or");
    words.len() % 2 == 1 && words[0] != "not" && is_joined
}

/// Part of a word: plain characters, or a name in braces.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum WordPart {
    /// Characters that are taken as they are.
    Text(String),
    /// Name in braces, which its value replaces.
    Name(String),
}

/// Words of a text that are kept or left out together: those in one pair of brackets, or words outside of brackets.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Group {
    /// True for words in brackets: all are left out if a name in them has no value.
    pub optional: bool,
    /// The words, each as the list of its parts.
    pub words: Vec<Vec<WordPart>>,
}

/// Splits a text at blanks into words with their names in braces. The words in one pair of brackets form one optional
/// group.
///
/// # Errors
/// Fails with a message if a bracket or a brace has no partner, or if a name in braces is none.
pub fn groups(text: &str) -> Result<Vec<Group>, String> {
    let mut groups = Vec::new();
    let mut open: Option<Group> = None;
    for word in text.split_whitespace() {
        let begins = word.starts_with('[');
        let word = word.strip_prefix('[').unwrap_or(word);
        let ends = word.ends_with(']');
        let word = word.strip_suffix(']').unwrap_or(word);
        if begins && open.is_some() || ends && !begins && open.is_none() {
            return Err(format!("a bracket at '{word}' has no partner"));
        }
        if begins {
            open = Some(Group { optional: true, words: vec![] });
        }
        match open.as_mut() {
            Some(group) => group.words.push(word_parts(word)?),
            None => groups.push(Group { optional: false, words: vec![word_parts(word)?] }),
        }
        if ends {
            groups.extend(open.take());
        }
    }
    match open {
        Some(_) => Err(format!("a bracket in '{text}' is not closed")),
        None => Ok(groups),
    }
}

fn word_parts(word: &str) -> Result<Vec<WordPart>, String> {
    let mut word_parts = Vec::new();
    let mut rest = word;
    while let Some((before, after)) = rest.split_once('{') {
        let (name, after) =
            after.split_once('}').ok_or_else(|| format!("a brace in '{word}' is not closed"))?;
        if !is_name(name) {
            return Err(format!("'{{{name}}}' in '{word}' is no name in braces"));
        }
        if !before.is_empty() {
            word_parts.push(WordPart::Text(before.into()));
        }
        word_parts.push(WordPart::Name(name.into()));
        rest = after;
    }
    if !rest.is_empty() || word_parts.is_empty() {
        word_parts.push(WordPart::Text(rest.into()));
    }
    Ok(word_parts)
}

/// Returns the names in braces that occur in a text, in their order.
///
/// # Errors
/// Fails with a message where [`groups`] does.
pub fn names(text: &str) -> Result<Vec<String>, String> {
    let mut names = Vec::new();
    for part in groups(text)?.into_iter().flat_map(|group| group.words).flatten() {
        if let WordPart::Name(name) = part {
            names.push(name);
        }
    }
    Ok(names)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn conditions_are_read_and_others_are_refused() {
        let line =
            DefinitionLine::read("x y when a and not b and c is d or e and f is not g").unwrap();
        assert_eq!(line.text, "x y");
        let words = |list: &[&str]| list.iter().map(|word| word.to_string()).collect::<Vec<_>>();
        let terms = line.condition.iter().map(|t| (t.name.as_str(), t.choices.clone(), t.negated));
        assert_eq!(
            terms.collect::<Vec<_>>(),
            [
                ("a", words(&[]), false),
                ("b", words(&[]), true),
                ("c", words(&["d", "e"]), false),
                ("f", words(&["g"]), true),
            ]
        );
        for (i, value, holds) in [
            (0, &["x"][..], true),
            (0, &[], false),
            (1, &[], true),
            (2, &["x", "e"], true),
            (2, &["x"], false),
            (2, &[], false),
            (3, &["x"], true),
            (3, &["x", "g"], false),
        ] {
            assert_eq!(line.condition[i].holds(&words(value)), holds, "{i}: {value:?}");
        }
        for old in ["a in b", "a begins with b", "a by default"] {
            let message = DefinitionLine::read(&format!("x when {old}")).unwrap_err();
            assert!(message.contains("replace"), "{message}");
        }
        for bad in [
            "x when",
            "x when a b",
            "x when a is",
            "x when a is not",
            "x when a is b c",
            "x when A",
            "x when a or b",
        ] {
            assert!(
                DefinitionLine::read(bad).is_err()
                    || DefinitionLine::read(bad).unwrap().condition.is_empty(),
                "{bad}"
            );
        }
    }

    #[test]
    fn brackets_and_braces_have_partners() {
        let found = groups("a [--b={c} d] {e}/f").unwrap();
        assert_eq!(
            found.iter().map(|g| (g.optional, g.words.len())).collect::<Vec<_>>(),
            [(false, 1), (true, 2), (false, 1)]
        );
        assert_eq!(names("a [--b={c} d] {e}/f").unwrap(), ["c", "e"]);
        for bad in ["[a", "a]", "[a [b]]", "{a", "{A}", "{a b}"] {
            assert!(groups(bad).is_err(), "{bad}");
        }
    }
}
