//! Words that a name in a definition stands for. A name is a setting (given by the user or by default), a value or a
//! fact.

use std::collections::BTreeMap;

use planish_handoff::words;

use crate::{
    definition::Definition,
    kind::Kind,
    phrase::{DefinitionLine, Term, WordPart, groups},
};

/// Names of settings, values or facts, each with the words that it stands for.
pub type Words = BTreeMap<String, Vec<String>>;

/// Origins of the flags of a command: the settings that give them, so that a message can name what the user wrote.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Origins {
    /// Flags, each with what a user gives in its place: `pitch_mm` for `--pitch-mm`, or `prepare=--level` for a word
    /// of a setting that holds flags. A flag that the pipeline itself writes stands for the setting of its name, or
    /// for itself.
    pub of_flag: Vec<(String, String)>,
    /// Setting that holds further flags of the command, in which a user can give any other flag; `None` if there is
    /// none.
    pub more_flags: Option<String>,
    /// Names of the settings that are whole words of the command, or the values of its flags.
    pub settings: Vec<String>,
}

impl Origins {
    /// Adds the origins of further words of the command, which take precedence. For example, `--surface {surface}` is
    /// the setting `surface`.
    fn add(&mut self, other: Self) {
        self.of_flag.splice(0..0, other.of_flag);
        self.more_flags = other.more_flags.or(self.more_flags.take());
        self.settings.extend(other.settings);
    }
}

/// A pipeline with the settings that the user gave, and the facts that are known so far.
#[derive(Clone, Debug)]
pub struct Scope<'a> {
    /// Definition of the pipeline, which has its settings, values and stages.
    pub definition: &'a Definition,
    given: BTreeMap<String, String>,
    fixed: Words,
}

/// Refuses a setting that is given twice. `first` is its value so far, `None` if it has none, and `second` the further
/// value. `name` is that of the setting.
///
/// # Errors
/// Fails with a message if there is a first value.
pub fn refuse_second(first: Option<String>, name: &str, second: &str) -> Result<(), String> {
    match first {
        None => Ok(()),
        Some(first) => {
            Err(format!("{name} is given twice, as '{first}' and as '{second}'; give it once"))
        }
    }
}

impl<'a> Scope<'a> {
    /// Creates the scope of a pipeline from the settings of the user, each written `NAME=VALUE`.
    ///
    /// # Errors
    /// Fails with a message if a setting is none of the pipeline, is given twice, or does not fit its type.
    pub fn new<S: AsRef<str>>(definition: &'a Definition, settings: &[S]) -> Result<Self, String> {
        let name = &definition.name;
        let mut given = BTreeMap::new();
        for setting in settings.iter().map(AsRef::as_ref) {
            let (key, value) = setting.split_once('=').ok_or_else(|| {
                format!(
                    "'{setting}' is not a setting; write NAME=VALUE (just show {name} lists them)"
                )
            })?;
            let Some(known) = definition.settings.iter().find(|s| s.name == key) else {
                let mut all: Vec<&str> =
                    definition.settings.iter().map(|s| s.name.as_str()).collect();
                all.sort_unstable();
                return Err(format!("{name} has no setting '{key}'; there are: {}", all.join(" ")));
            };
            let value = match known.kind {
                // A path that begins with a hyphen is not a flag.
                Kind::Path if value.starts_with('-') => format!("./{value}"),
                _ => value.to_string(),
            };
            refuse_second(given.insert(key.to_string(), value.clone()), key, &value)?;
        }
        for (key, value) in &given {
            let Some(setting) = definition.setting(key) else { continue };
            let may_be_empty = setting.may_be_empty
                || matches!(setting.kind, Kind::Flags | Kind::Path | Kind::Word);
            if value.is_empty() && may_be_empty {
                continue;
            }
            setting.kind.check(value).map_err(|wanted| match setting.kind {
                Kind::Flags => format!("{key}={value}: {wanted}"),
                _ => {
                    let nothing = if setting.may_be_empty { ", or nothing" } else { "" };
                    format!("{key} is '{value}'; give {wanted}{nothing}")
                }
            })?;
        }
        let by_default = if given.contains_key("machine") { vec![] } else { vec!["yes".into()] };
        let fixed = BTreeMap::from([
            ("pipeline".into(), vec![name.clone()]),
            ("machine_by_default".into(), by_default),
            ("recommended".into(), vec![]),
        ]);
        Ok(Self { definition, given, fixed })
    }

    /// Sets the words of a fact, or replaces those of any other name from now on.
    pub fn set(&mut self, name: &str, words: Vec<String>) {
        self.fixed.insert(name.into(), words);
    }

    /// Returns true if the user gave the setting `name`.
    pub fn is_given(&self, name: &str) -> bool {
        self.given.contains_key(name)
    }

    /// Checks the combination of settings against the `refuse` lines of the definition.
    ///
    /// # Errors
    /// Fails with the text of the first `refuse` line whose condition holds.
    pub fn check(&self) -> Result<(), String> {
        let none = Words::new();
        for line in &self.definition.refuse {
            if self.holds(&line.condition, &none)? {
                return Err(self.expand(&line.text, &none)?.join(" "));
            }
        }
        Ok(())
    }

    /// Returns the words that a name stands for; none for an empty setting, or if no line of its default or value has a
    /// condition that holds. `local` are the words that calls of the running stages gave to names; they take
    /// precedence.
    ///
    /// # Errors
    /// Fails with a message if the name is no setting and no value, and is not set as a fact yet. Also fails if its
    /// words or conditions cannot be read.
    pub fn words(&self, name: &str, local: &Words) -> Result<Vec<String>, String> {
        if let Some(words) = local.get(name).or_else(|| self.fixed.get(name)) {
            return Ok(words.clone());
        }
        if let Some(setting) = self.definition.setting(name) {
            return match (self.given.get(name), &setting.kind) {
                (None, _) => self.first(&setting.default, local),
                (Some(text), Kind::Flags) => {
                    words::split(text).map_err(|e| format!("{name}={text}: {e}"))
                }
                (Some(text), _) if text.is_empty() => Ok(vec![]),
                (Some(text), _) => Ok(vec![text.clone()]),
            };
        }
        let Some(lines) = self.definition.value(name) else {
            return Err(format!("'{name}' is not known yet in {}", self.definition.name));
        };
        self.first(lines, local)
    }

    /// Returns the text that a name stands for outside of any stage: its words, separated by blanks.
    ///
    /// # Errors
    /// Fails with a message where [`Scope::words`] does.
    pub fn text(&self, name: &str) -> Result<String, String> {
        Ok(self.words(name, &Words::new())?.join(" "))
    }

    /// Returns the expanded words of the first line whose condition holds; empty if no line's condition holds.
    fn first(&self, lines: &[DefinitionLine], local: &Words) -> Result<Vec<String>, String> {
        match self.line_that_holds(lines, local)? {
            Some(line) => self.expand(&line.text, local),
            None => Ok(vec![]),
        }
    }

    /// Returns true if all terms of a condition hold. `local` is as in [`Scope::words`].
    ///
    /// # Errors
    /// Fails with a message where [`Scope::words`] does.
    pub fn holds(&self, condition: &[Term], local: &Words) -> Result<bool, String> {
        for term in condition {
            if !term.holds(&self.words(&term.name, local)?) {
                return Ok(false);
            }
        }
        Ok(true)
    }

    /// Returns the words of a text, with every name in braces replaced. A name that is a whole word becomes all of its
    /// words; within a longer word it becomes its words joined by blanks. Words in brackets are left out if a name
    /// among them stands for no word. `local` is as in [`Scope::words`].
    ///
    /// # Errors
    /// Fails with a message if a name is not known yet, or if a bracket or a brace has no partner.
    pub fn expand(&self, text: &str, local: &Words) -> Result<Vec<String>, String> {
        let mut expanded = Vec::new();
        for group in groups(text)? {
            let mut words = Vec::new();
            let mut lacks = false;
            for parts in &group.words {
                if let [WordPart::Name(name)] = &parts[..] {
                    let values = self.words(name, local)?;
                    lacks |= values.is_empty();
                    words.extend(values);
                    continue;
                }
                let mut word = String::new();
                for part in parts {
                    match part {
                        WordPart::Text(text) => word.push_str(text),
                        WordPart::Name(name) => {
                            let values = self.words(name, local)?;
                            lacks |= values.is_empty();
                            word.push_str(&values.join(" "));
                        }
                    }
                }
                words.push(word);
            }
            if !(group.optional && lacks) {
                expanded.extend(words);
            }
        }
        Ok(expanded)
    }

    /// Returns the settings that give the flags in a text. `local` are the words that calls of stages gave to names,
    /// and `local_origins` the origins of these words.
    ///
    /// # Errors
    /// Fails with a message where [`Scope::expand`] does.
    pub fn origins(
        &self,
        text: &str,
        local: &Words,
        local_origins: &BTreeMap<String, Origins>,
    ) -> Result<Origins, String> {
        let mut origins = Origins::default();
        let mut last_flag = None;
        for parts in groups(text)?.into_iter().flat_map(|group| group.words) {
            let flag = match &parts[0] {
                WordPart::Text(text) if text.starts_with("--") => text.split('=').next(),
                _ => None,
            };
            let setting_alone = match &parts[..] {
                [WordPart::Name(name)] | [WordPart::Text(_), WordPart::Name(name)] => Some(name),
                _ => None,
            };
            match (flag, setting_alone) {
                (Some(flag), name) => {
                    let same = flag[2..].replace('-', "_");
                    let setting = name.and_then(|name| self.definition.setting(name));
                    origins.settings.extend(setting.map(|s| s.name.clone()));
                    let own = self.definition.settings.iter().find(|s| s.name == same);
                    let origin = setting.or(own).map_or(flag, |s| s.name.as_str());
                    origins.of_flag.push((flag.into(), origin.into()));
                }
                (None, Some(name)) if self.definition.setting(name).is_some() => {
                    origins.add(self.origins_of_setting(name, last_flag, local)?);
                }
                (None, Some(name)) => {
                    if let Some(known) = local_origins.get(name) {
                        origins.add(known.clone());
                    } else if !local.contains_key(name) && !self.fixed.contains_key(name) {
                        let lines = self.definition.value(name).unwrap_or_default();
                        if let Some(line) = self.line_that_holds(lines, local)? {
                            origins.add(self.origins(&line.text, local, local_origins)?);
                        }
                    }
                }
                (None, None) => {}
            }
            last_flag = match &parts[..] {
                [WordPart::Text(text)] if flag == Some(text) => Some(text.clone()),
                _ => None,
            };
        }
        Ok(origins)
    }

    /// Returns the origins of the words of the setting `name`. If the word before it is a flag, `last_flag`, the
    /// setting is the value of that flag.
    fn origins_of_setting(
        &self,
        name: &str,
        last_flag: Option<String>,
        local: &Words,
    ) -> Result<Origins, String> {
        if !self.definition.setting(name).is_some_and(|setting| setting.kind == Kind::Flags) {
            let of_flag = last_flag.map(|flag| (flag, name.to_string())).into_iter().collect();
            return Ok(Origins { of_flag, more_flags: None, settings: vec![name.into()] });
        }
        let mut of_flag = Vec::new();
        for word in self.words(name, local)?.iter().filter(|word| word.starts_with("--")) {
            let flag = word.split('=').next().unwrap_or(word);
            of_flag.push((flag.to_string(), format!("{name}={flag}")));
        }
        Ok(Origins { of_flag, more_flags: Some(name.into()), settings: vec![name.into()] })
    }

    /// Returns the first line whose condition holds; `None` if there is none.
    fn line_that_holds<'b>(
        &self,
        lines: &'b [DefinitionLine],
        local: &Words,
    ) -> Result<Option<&'b DefinitionLine>, String> {
        for line in lines {
            if self.holds(&line.condition, local)? {
                return Ok(Some(line));
            }
        }
        Ok(None)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SHARED: &str = "
settings:
  a: {type: number above 0, default: '1', help: A}
  b: {type: path, help: B}
  f: {type: flags, help: F}
  w: {type: 'one of x, y', help: W}
refuse: ['b={b} needs w when b and not w']
values:
  v: ['{f} when f', '--a={a}']
stages:
  run: ['planish-x {v} [--b {b}]']
";

    fn expand(settings: &[&str], text: &str) -> Result<Vec<String>, String> {
        let definition = Definition::read("p", SHARED, "title: T").unwrap();
        let scope = Scope::new(&definition, settings)?;
        scope.check()?;
        scope.expand(text, &Words::new())
    }

    #[test]
    fn a_setting_is_one_word_whatever_it_holds() {
        let hostile = "$(touch x) 'a' \"b\" {{ c }} {v}\n[d] when e";
        let b = format!("b={hostile}");
        let words = expand(&["w=x", &b], "p {b} --b={b} [--c {b}]").unwrap();
        assert_eq!(words, ["p", hostile, &format!("--b={hostile}"), "--c", hostile]);
        assert_eq!(expand(&["w=x", "b=-x"], "{b}").unwrap(), ["./-x"]);
    }

    #[test]
    fn flags_are_words_and_what_is_empty_is_left_out() {
        assert_eq!(expand(&["f=--x 'a b' $(y)"], "{v} [--b {b}]").unwrap(), ["--x", "a b", "$(y)"]);
        assert_eq!(expand(&["a=2", "f="], "{v}").unwrap(), ["--a=2"]);
    }

    #[test]
    fn the_settings_behind_the_flags_of_a_command_are_known() {
        let definition = Definition::read("p", SHARED, "title: T").unwrap();
        let text = "planish-x --out d {v} --b {b} [--w={w}] {local} --level";
        let origins_with = |settings: &[&str]| {
            let scope = Scope::new(&definition, settings).unwrap();
            let by_local = BTreeMap::from([(
                "local".to_string(),
                scope.origins("--of-a={a}", &Words::new(), &BTreeMap::new()).unwrap(),
            )]);
            let local = Words::from([("local".to_string(), vec!["--of-a=1".to_string()])]);
            scope.origins(text, &local, &by_local).unwrap()
        };
        let of = |origins: &Origins, flag: &str| {
            origins.of_flag.iter().find(|(known, _)| known == flag).map(|(_, text)| text.clone())
        };
        let origins = origins_with(&["b=q", "w=x"]);
        for (flag, text) in [
            ("--a", "a"),
            ("--b", "b"),
            ("--w", "w"),
            ("--of-a", "a"),
            ("--out", "--out"),
            ("--level", "--level"),
        ] {
            assert_eq!(of(&origins, flag).as_deref(), Some(text), "{flag}");
        }
        assert_eq!(
            (origins.more_flags, origins.settings),
            (None, ["a", "b", "w", "a"].map(String::from).to_vec())
        );
        let origins = origins_with(&["f=--x=1 'a b' --out e"]);
        assert_eq!(of(&origins, "--x").as_deref(), Some("f=--x"));
        assert_eq!(of(&origins, "--out").as_deref(), Some("f=--out"));
        assert_eq!(origins.more_flags.as_deref(), Some("f"));
    }

    #[test]
    fn a_default_of_one_pipeline_does_not_forbid_nothing() {
        let own = "title: T\nsettings:\n  w: {default: x}\n  b: {default: y}";
        let definition = Definition::read("p", SHARED, own).unwrap();
        let scope = Scope::new(&definition, &["w=", "b="]).unwrap();
        assert!(scope.expand("[--w {w}] [--b {b}]", &Words::new()).unwrap().is_empty());
        let said = Scope::new(&definition, &["w=z"]).unwrap_err();
        assert_eq!(said, "w is 'z'; give x or y, or nothing");
    }

    #[test]
    fn what_is_wrong_is_named_with_the_remedy() {
        for (settings, said) in [
            (&["a=-1"][..], "a is '-1'; give a number above 0"),
            (&["a="], "a is ''; give a number above 0"),
            (&["w=z"], "w is 'z'; give x or y, or nothing"),
            (&["f=--x 'y"], "f=--x 'y: the quotation mark"),
            (&["z=1"], "p has no setting 'z'; there are: a b f w"),
            (&["--x"], "'--x' is not a setting; write NAME=VALUE"),
            (&["b=q"], "b=q needs w"),
            (&["a=2", "b=", "a=3"], "a is given twice, as '2' and as '3'; give it once"),
            (&["a=2", "a=2"], "a is given twice, as '2' and as '2'; give it once"),
        ] {
            let message = expand(settings, "x").unwrap_err();
            assert!(message.starts_with(said), "{message}");
        }
    }
}
