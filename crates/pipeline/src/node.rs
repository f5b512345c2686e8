//! YAML values with the line number of each, so that a message can name the line.

use std::fmt;

use serde::de::{Deserialize, Deserializer, MapAccess, SeqAccess, Visitor};
use serde_saphyr::Spanned;

/// Mistake in a definition file, with its line.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("line {line}: {problem}")]
pub struct Complaint {
    /// Line, counted from 1.
    pub line: u64,
    /// The mistake, and the remedy.
    pub problem: String,
}

impl Complaint {
    /// Makes a complaint about `line`, counted from 1; `problem` says the mistake and the remedy.
    pub fn new(line: u64, problem: impl Into<String>) -> Self {
        Self { line, problem: problem.into() }
    }
}

/// A YAML value with the number of its line.
#[derive(Clone, Debug, PartialEq)]
pub struct Node {
    /// Line, counted from 1.
    pub line: u64,
    /// Value of the node.
    pub value: Value,
}

/// YAML values that a definition file may contain. Each variant shows examples.
#[derive(Clone, Debug, PartialEq)]
pub enum Value {
    /// Number, such as `1`, `0.8`, `1e-3`
    Number(f64),
    /// Text, such as `raster`
    Text(String),
    /// Truth value: `true` or `false`
    Flag(bool),
    /// Empty value: nothing stands after the colon
    Nothing,
    /// List: `[1, 2]`, or lines with hyphens
    List(Vec<Node>),
    /// Table of `key: value` pairs, in the order of the file
    Map(Vec<(Key, Node)>),
}

/// A key of a table with the number of its line.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Key {
    /// Line, counted from 1.
    pub line: u64,
    /// Text of the key.
    pub text: String,
}

impl fmt::Display for Value {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Number(number) => write!(f, "{number}"),
            Self::Text(text) => write!(f, "'{text}'"),
            Self::Flag(flag) => write!(f, "{flag}"),
            Self::Nothing => f.write_str("empty"),
            Self::List(_) => f.write_str("a list"),
            Self::Map(_) => f.write_str("a table of keys"),
        }
    }
}

/// Parses the whole text of a file as one YAML value.
///
/// # Errors
/// Fails if the text is no YAML of [`Value`]s.
pub fn parse(text: &str) -> Result<Node, Complaint> {
    // YAML 1.1 took y, no and off for flags, too.
    let options = serde_saphyr::options! { strict_booleans: true };
    let parsed: Result<Spanned<Raw>, _> = serde_saphyr::from_str_with_options(text, options);
    parsed.map(node).map_err(|error| {
        let line = error.location().map_or(1, |at| at.line());
        // The crate appends where, which stands in front already, and what it calls its settings.
        let whole = error.without_snippet().to_string();
        let problem = whole.split(" at line ").next().unwrap_or(&whole);
        let problem = problem.split(", set DuplicateKeyPolicy").next().unwrap_or(problem);
        Complaint::new(line, format!("{problem}; write keys and values as YAML"))
    })
}

/// [`Value`] with the positions that the YAML parser reports.
enum Raw {
    Number(f64),
    Text(String),
    Flag(bool),
    Nothing,
    List(Vec<Spanned<Raw>>),
    Map(Vec<(Spanned<String>, Spanned<Raw>)>),
}

fn node(raw: Spanned<Raw>) -> Node {
    let line = raw.referenced.line();
    let value = match raw.value {
        Raw::Number(number) => Value::Number(number),
        Raw::Text(text) => Value::Text(text),
        Raw::Flag(flag) => Value::Flag(flag),
        Raw::Nothing => Value::Nothing,
        Raw::List(items) => Value::List(items.into_iter().map(node).collect()),
        Raw::Map(entries) => {
            Value::Map(entries.into_iter().map(|(k, v)| (key(k), node(v))).collect())
        }
    };
    Node { line, value }
}

fn key(key: Spanned<String>) -> Key {
    Key { line: key.referenced.line(), text: key.value }
}

impl<'de> Deserialize<'de> for Raw {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(RawVisitor)
    }
}

struct RawVisitor;

impl<'de> Visitor<'de> for RawVisitor {
    type Value = Raw;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a number, a text, a list or a table of keys")
    }

    fn visit_bool<E>(self, flag: bool) -> Result<Raw, E> {
        Ok(Raw::Flag(flag))
    }

    fn visit_i64<E>(self, number: i64) -> Result<Raw, E> {
        Ok(Raw::Number(number as f64))
    }

    fn visit_u64<E>(self, number: u64) -> Result<Raw, E> {
        Ok(Raw::Number(number as f64))
    }

    fn visit_f64<E>(self, number: f64) -> Result<Raw, E> {
        Ok(Raw::Number(number))
    }

    fn visit_str<E>(self, text: &str) -> Result<Raw, E> {
        Ok(Raw::Text(text.into()))
    }

    fn visit_unit<E>(self) -> Result<Raw, E> {
        Ok(Raw::Nothing)
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut items: A) -> Result<Raw, A::Error> {
        let mut list = Vec::new();
        while let Some(item) = items.next_element()? {
            list.push(item);
        }
        Ok(Raw::List(list))
    }

    fn visit_map<A: MapAccess<'de>>(self, mut entries: A) -> Result<Raw, A::Error> {
        let mut map = Vec::new();
        while let Some(entry) = entries.next_entry()? {
            map.push(entry);
        }
        Ok(Raw::Map(map))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn complaint(text: &str) -> String {
        parse(text).unwrap_err().to_string()
    }

    #[test]
    fn every_value_knows_its_line() {
        let Value::Map(top) = parse("a: 1\nb:\n  - x\n  - {c: true, d: }\n").unwrap().value else {
            panic!("a table")
        };
        assert_eq!((top[0].0.line, top[0].1.value.clone()), (1, Value::Number(1.0)));
        let Value::List(items) = &top[1].1.value else { panic!("a list") };
        assert_eq!((items[0].line, &items[0].value), (3, &Value::Text("x".into())));
        let Value::Map(inner) = &items[1].value else { panic!("a table") };
        assert_eq!(inner[0].0, Key { line: 4, text: "c".into() });
        assert_eq!((&inner[0].1.value, &inner[1].1.value), (&Value::Flag(true), &Value::Nothing));
    }

    #[test]
    fn directions_are_words_and_not_flags() {
        // YAML 1.1 takes y for true.
        let Value::Map(top) = parse("scan: [x, y]").unwrap().value else { panic!("a table") };
        let Value::List(items) = &top[0].1.value else { panic!("a list") };
        assert_eq!(items[1].value, Value::Text("y".into()));
    }

    #[test]
    fn what_is_no_yaml_is_refused_with_its_line() {
        assert!(complaint("a: 1\na: 2\n").starts_with("line 2: duplicate mapping key: a"));
        assert!(complaint("a:\n\tb: 1").starts_with("line 2: tabs"));
        assert!(complaint("a: 1\n---\nb: 2").starts_with("line 3: "));
        assert!(complaint("a: 1\nb: .nan").starts_with("line 2: "));
    }

    #[test]
    fn nesting_without_end_is_refused_and_does_not_overflow_the_stack() {
        for open in ["[", "- ", "{a: ", "? "] {
            parse(&open.repeat(100_000)).unwrap_err();
        }
        // Each line ten times the one before: 1e9 values in the end.
        let mut bomb = "a0: &a0 [0, 0, 0, 0, 0, 0, 0, 0, 0, 0]\n".to_string();
        for i in 1..9 {
            let refer = format!("*a{}, ", i - 1).repeat(10);
            bomb += &format!("a{i}: &a{i} [{refer}]\n");
        }
        parse(&bomb).unwrap_err();
    }
}
