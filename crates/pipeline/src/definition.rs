//! The definition of a pipeline, read from its own file and the file that all pipelines share.

use std::collections::BTreeSet;

use crate::{
    action::Action,
    kind::Kind,
    node::{Complaint, Node, Value, parse},
    phrase::{Line, Test, is_name, names},
};

/// Name of the file that all pipelines share, without its ending.
pub const SHARED: &str = "shared";

/// Facts that the program finds and no definition states.
pub const FACTS: [&str; 10] = [
    "pipeline",
    "repository",
    "home",
    "surface_kind",
    "tif_kind",
    "surface_name",
    "machine_name",
    "machine_title",
    "kinematics",
    "fixture_tool",
];

/// Name of the fact that follows from the value `name`: the mirror as the name of a directory.
pub const DIRECTORY_NAME: &str = "directory_name";

/// The file that all pipelines share, and those of the pipelines, as they were when the program was built.
const FILES: [(&str, &str); 10] = [
    (SHARED, include_str!("../../../pipelines/shared.yaml")),
    ("bspline", include_str!("../../../pipelines/bspline.yaml")),
    ("compare-dwell", include_str!("../../../pipelines/compare-dwell.yaml")),
    ("line", include_str!("../../../pipelines/line.yaml")),
    ("maze", include_str!("../../../pipelines/maze.yaml")),
    ("multi-pitch", include_str!("../../../pipelines/multi-pitch.yaml")),
    ("random-adaptive", include_str!("../../../pipelines/random-adaptive.yaml")),
    ("raster", include_str!("../../../pipelines/raster.yaml")),
    ("spiral", include_str!("../../../pipelines/spiral.yaml")),
    ("trig-spline", include_str!("../../../pipelines/trig-spline.yaml")),
];

/// Stages that a pipeline needs.
const NEEDED: [&str; 1] = ["run"];

/// A setting.
#[derive(Clone, Debug, PartialEq)]
pub struct Setting {
    /// Name, which ends with the unit.
    pub name: String,
    /// Type, which checks a value.
    pub kind: Kind,
    /// Default: the first line whose condition holds; empty without one.
    pub default: Vec<Line>,
    /// True if it has no default, here or among the shared settings: then nothing is a value of it.
    pub may_be_empty: bool,
    /// Meaning.
    pub help: String,
}

/// A pipeline: its settings, and its stages as lists of lines.
#[derive(Clone, Debug, PartialEq)]
pub struct Definition {
    /// Name of the pipeline.
    pub name: String,
    /// Sentence that says what the pipeline does.
    pub title: String,
    /// Settings that a user can give: those of the pipeline, then those that it shares.
    pub settings: Vec<Setting>,
    /// Shared settings that the pipeline does not have; their defaults still hold in shared stages.
    pub without: Vec<Setting>,
    /// Messages with the condition under which settings are refused.
    pub refuse: Vec<Line>,
    /// Names for what is made of settings and facts.
    pub values: Vec<(String, Vec<Line>)>,
    /// Stages.
    pub stages: Vec<(String, Vec<Line>)>,
}

/// Content of one file, as far as it is read.
#[derive(Default)]
struct Part {
    title: String,
    settings: Vec<(String, Draft)>,
    without: Vec<String>,
    refuse: Vec<Line>,
    values: Vec<(String, Vec<Line>)>,
    stages: Vec<(String, Vec<Line>)>,
}

/// A setting of which a file may state a part.
#[derive(Default)]
struct Draft {
    line: u64,
    kind: Option<Kind>,
    default: Option<Vec<Line>>,
    help: Option<String>,
}

impl Definition {
    /// Reads the definition of the pipeline `name` from the text of the shared file and of its own. A message names the
    /// file, the line and the remedy.
    pub fn read(name: &str, shared: &str, own: &str) -> Result<Self, String> {
        let named =
            |file: &str, complaint: Complaint| format!("pipelines/{file}.yaml: {complaint}");
        let shared = part(shared).map_err(|e| named(SHARED, e))?;
        let own = part(own).map_err(|e| named(name, e))?;
        let definition = Self::joined(name, shared, own).map_err(|e| named(name, e))?;
        definition.check().map_err(|e| format!("pipelines/{name}.yaml: {e}"))?;
        Ok(definition)
    }

    /// The definition of a pipeline as it was when the program was built; `None` if there is none of this name.
    pub fn built_in(name: &str) -> Option<Self> {
        let text =
            |name: &str| FILES.iter().find(|(known, _)| *known == name).map(|(_, text)| *text);
        let own = text(name).filter(|_| name != SHARED)?;
        Some(Self::read(name, text(SHARED)?, own).expect("a test reads every file"))
    }

    /// Settings on which the commands of a stage depend, also through values and other stages, but not through the names
    /// in `cut`.
    pub fn settings_of(&self, stage: &str, cut: &[&str]) -> BTreeSet<String> {
        let mut seen: BTreeSet<String> = cut.iter().map(|name| name.to_string()).collect();
        let mut names = Vec::new();
        let mut stages = vec![stage.to_string()];
        let mut entered = BTreeSet::new();
        while let Some(stage) = stages.pop() {
            if !entered.insert(stage.clone()) {
                continue;
            }
            for line in self.stage(&stage).unwrap_or_default() {
                names.extend(names_of(line).unwrap_or_default());
                if let Ok(action) = Action::read(&line.text) {
                    stages.extend(action.stages().map(String::from));
                }
            }
        }
        let mut found = BTreeSet::new();
        while let Some(name) = names.pop() {
            if !seen.insert(name.clone()) {
                continue;
            }
            let setting = self.setting(&name).map(|setting| &setting.default[..]);
            for line in setting.or(self.value(&name)).unwrap_or_default() {
                names.extend(names_of(line).unwrap_or_default());
            }
            if setting.is_some() {
                found.insert(name);
            }
        }
        found
    }

    /// The content of both files, in which the own one goes before the shared one.
    fn joined(name: &str, shared: Part, own: Part) -> Result<Self, Complaint> {
        let mut base = shared.settings;
        let mut settings = Vec::new();
        for (key, draft) in own.settings {
            let at = base.iter().position(|(known, _)| *known == key);
            let shared = at.map(|at| base.remove(at).1).unwrap_or_default();
            let may_be_empty = at.is_some() && shared.default.is_none();
            let draft = Draft {
                line: draft.line,
                kind: draft.kind.or(shared.kind),
                default: draft.default.or(shared.default),
                help: draft.help.or(shared.help),
            };
            let mut setting = setting(key, draft)?;
            setting.may_be_empty |= may_be_empty;
            settings.push(setting);
        }
        let mut without = Vec::new();
        for (key, draft) in base {
            let setting = setting(key, draft)?;
            match own.without.contains(&setting.name) {
                true => without.push(setting),
                false => settings.push(setting),
            }
        }
        if let Some(name) = own.without.iter().find(|n| !without.iter().any(|s| s.name == **n)) {
            return Err(Complaint::new(
                1,
                format!("`without` names '{name}', which is no shared setting"),
            ));
        }
        Ok(Self {
            name: name.into(),
            title: own.title,
            settings,
            without,
            refuse: [shared.refuse, own.refuse].concat(),
            values: over(own.values, shared.values),
            stages: over(own.stages, shared.stages),
        })
    }

    /// The setting of this name, whether a user can give it or not.
    pub fn setting(&self, name: &str) -> Option<&Setting> {
        self.settings.iter().chain(&self.without).find(|setting| setting.name == name)
    }

    /// Lines of a value.
    pub fn value(&self, name: &str) -> Option<&[Line]> {
        self.values.iter().find(|(known, _)| known == name).map(|(_, lines)| &lines[..])
    }

    /// Lines of a stage.
    pub fn stage(&self, name: &str) -> Option<&[Line]> {
        self.stages.iter().find(|(known, _)| known == name).map(|(_, lines)| &lines[..])
    }

    /// Refuses names that nothing stands for, values that are made of themselves, and lines that are no steps.
    fn check(&self) -> Result<(), String> {
        if let Some(lacking) = NEEDED.iter().find(|name| self.stage(name).is_none()) {
            return Err(format!("there is no stage '{lacking}'; add it to `stages`"));
        }
        let mut given = BTreeSet::new();
        for (stage, lines) in &self.stages {
            for line in lines {
                let action = Action::read(&line.text)
                    .map_err(|e| format!("stage {stage}: '{}': {e}", line.text))?;
                if let Some(called) = action.stages().find(|called| self.stage(called).is_none()) {
                    return Err(format!("stage {stage}: no stage '{called}'; add it to `stages`"));
                }
                given.extend(action.gives());
            }
        }
        let mut ending = BTreeSet::new();
        for (stage, _) in &self.stages {
            self.refuse_circle(stage, &mut Vec::new(), &mut ending)?;
        }
        let known = |name: &str| {
            self.setting(name).is_some()
                || self.value(name).is_some()
                || FACTS.contains(&name)
                || name == DIRECTORY_NAME
                || given.contains(name)
        };
        let defaults = self.settings.iter().chain(&self.without).map(|s| (&s.name, &s.default));
        let values = self.values.iter().map(|(name, lines)| (name, lines));
        let stages = self.stages.iter().map(|(name, lines)| (name, lines));
        let refuse = ("refuse".to_string(), self.refuse.clone());
        let all = defaults.chain(values).chain(stages).chain([(&refuse.0, &refuse.1)]);
        for (of, lines) in all {
            let mut named = Vec::new();
            for line in lines {
                named.extend(names_of(line).map_err(|e| format!("{of}: {e}"))?);
            }
            if let Some(name) = named.iter().find(|name| !known(name)) {
                return Err(format!(
                    "{of}: no setting or value '{name}'; add it, or correct its name"
                ));
            }
        }
        let mut settled = BTreeSet::new();
        let mut all =
            self.values.iter().map(|(name, _)| name).chain(self.settings.iter().map(|s| &s.name));
        all.try_for_each(|name| self.settle(name, &mut Vec::new(), &mut settled))
    }

    /// Refuses a stage that runs itself, through others. Stages that are known to end are in `ending`.
    fn refuse_circle(
        &self,
        stage: &str,
        above: &mut Vec<String>,
        ending: &mut BTreeSet<String>,
    ) -> Result<(), String> {
        if let Some(first) = above.iter().position(|known| known == stage) {
            let circle = [&above[first..], &[stage.into()]].concat().join(" -> ");
            return Err(format!(
                "stage {stage}: it runs itself without end ({circle}); take one of these lines out"
            ));
        }
        if ending.contains(stage) {
            return Ok(());
        }
        above.push(stage.into());
        for line in self.stage(stage).unwrap_or_default() {
            for called in Action::read(&line.text)?.stages() {
                self.refuse_circle(called, above, ending)?;
            }
        }
        above.pop();
        ending.insert(stage.into());
        Ok(())
    }

    /// Refuses a name that is made of itself, through others.
    fn settle(
        &self,
        name: &str,
        above: &mut Vec<String>,
        settled: &mut BTreeSet<String>,
    ) -> Result<(), String> {
        if above.iter().any(|known| known == name) {
            return Err(format!("{name}: is made of itself, by {}", above.join(", ")));
        }
        if settled.contains(name) {
            return Ok(());
        }
        let setting = self.setting(name).map(|setting| &setting.default[..]);
        above.push(name.into());
        for line in setting.or(self.value(name)).unwrap_or_default() {
            for next in names_of(line)? {
                self.settle(&next, above, settled)?;
            }
        }
        above.pop();
        settled.insert(name.into());
        Ok(())
    }
}

/// Names in a line: in its words, and in its condition.
fn names_of(line: &Line) -> Result<Vec<String>, String> {
    let mut found = names(&line.text)?;
    for term in &line.condition {
        found.push(term.name.clone());
        if let Test::In(list) = &term.test {
            found.push(list.clone());
        }
    }
    Ok(found)
}

/// The own entries, and the shared ones of other names.
fn over(
    own: Vec<(String, Vec<Line>)>,
    shared: Vec<(String, Vec<Line>)>,
) -> Vec<(String, Vec<Line>)> {
    let others = shared.into_iter().filter(|(name, _)| !own.iter().any(|(known, _)| known == name));
    own.iter().cloned().chain(others.collect::<Vec<_>>()).collect()
}

/// The setting of a draft, which is complete.
fn setting(name: String, draft: Draft) -> Result<Setting, Complaint> {
    let lacks =
        |what: &str| Complaint::new(draft.line, format!("the setting {name} lacks `{what}`"));
    let kind = draft.kind.clone().ok_or_else(|| lacks("type"))?;
    let help = draft.help.clone().ok_or_else(|| lacks("help"))?;
    let default = draft.default.unwrap_or_default();
    Ok(Setting { kind, may_be_empty: default.is_empty(), default, help, name })
}

/// Reads one file.
fn part(text: &str) -> Result<Part, Complaint> {
    let mut part = Part::default();
    for (key, node) in table("the file", &parse(text)?)? {
        match key.as_str() {
            "title" => part.title = word("title", node)?,
            "settings" => {
                for (name, node) in table("settings", node)? {
                    part.settings.push((name.clone(), draft(&name, node)?));
                }
            }
            "without" => part.without = list(node)?.iter().map(|(text, _)| text.clone()).collect(),
            "refuse" => part.refuse = lines("refuse", node)?,
            "values" => part.values = entries("values", node)?,
            "stages" => part.stages = entries("stages", node)?,
            _ => {
                let problem = format!(
                    "the file has no key '{key}'; it has title, settings, without, refuse, values, stages"
                );
                return Err(Complaint::new(node.line, problem));
            }
        }
    }
    Ok(part)
}

/// Keys and values of a table.
fn table<'a>(what: &str, node: &'a Node) -> Result<Vec<(String, &'a Node)>, Complaint> {
    match &node.value {
        Value::Map(entries) => {
            Ok(entries.iter().map(|(key, node)| (key.text.clone(), node)).collect())
        }
        other => Err(Complaint::new(
            node.line,
            format!("{what} is {other}; give keys with their values"),
        )),
    }
}

fn draft(name: &str, node: &Node) -> Result<Draft, Complaint> {
    if !is_name(name) {
        let problem =
            format!("'{name}' is no name of a setting; write small letters, digits and _");
        return Err(Complaint::new(node.line, problem));
    }
    let mut draft = Draft { line: node.line, ..Draft::default() };
    for (key, node) in table(name, node)? {
        match key.as_str() {
            "type" => {
                let text = word("type", node)?;
                let kind = Kind::read(&text).ok_or_else(|| {
                    let problem = format!("{name}: '{text}' is no type; give word, path, flags, number ..., one of ...");
                    Complaint::new(node.line, problem)
                })?;
                draft.kind = Some(kind);
            }
            "default" => draft.default = Some(lines(name, node)?),
            "help" => draft.help = Some(word("help", node)?),
            _ => {
                let problem = format!("{name} has no key '{key}'; it has type, default, help");
                return Err(Complaint::new(node.line, problem));
            }
        }
    }
    Ok(draft)
}

/// Entries of a table that are lists of lines.
fn entries(what: &str, node: &Node) -> Result<Vec<(String, Vec<Line>)>, Complaint> {
    let entry = |(name, node): (String, &Node)| Ok((name.clone(), lines(&name, node)?));
    table(what, node)?.into_iter().map(entry).collect()
}

/// Lines of a list, or the single line of a text.
fn lines(of: &str, node: &Node) -> Result<Vec<Line>, Complaint> {
    let line = |(text, line): &(String, u64)| {
        Line::read(text).map_err(|e| Complaint::new(*line, format!("{of}: {e}")))
    };
    list(node)?.iter().map(line).collect()
}

/// Texts of a list, with their lines; a single text is a list of one.
fn list(node: &Node) -> Result<Vec<(String, u64)>, Complaint> {
    match &node.value {
        Value::List(items) => {
            items.iter().map(|item| Ok((word("the item", item)?, item.line))).collect()
        }
        _ => Ok(vec![(word("the item", node)?, node.line)]),
    }
}

fn word(what: &str, node: &Node) -> Result<String, Complaint> {
    match &node.value {
        Value::Text(text) => Ok(text.clone()),
        other => Err(Complaint::new(
            node.line,
            format!("{what} is {other}; give a text, in quotation marks"),
        )),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SHARED_TEXT: &str = "settings:\n  a: {type: word, default: x, help: A}\n  b: {type: word, help: B}\n\
        values:\n  v: ['{a}/v']\nstages:\n  run: [one, two method=m when b]\n  one: ['planish-a {v} ?']\n  two: ['planish-b {method}']\n";

    #[test]
    fn the_own_file_goes_before_the_shared_one() {
        let own = "title: T\nsettings:\n  c: {type: word, help: C}\n  a: {default: y}\nstages:\n  one: ['planish-c {c}']\nwithout: [b]";
        let found = Definition::read("p", SHARED_TEXT, own).unwrap();
        let names = |list: &[Setting]| list.iter().map(|s| s.name.clone()).collect::<Vec<_>>();
        assert_eq!(
            (names(&found.settings), names(&found.without)),
            (vec!["c".into(), "a".into()], vec!["b".into()])
        );
        assert_eq!(found.setting("a").unwrap().default[0].text, "y");
        assert_eq!(found.stage("one").unwrap()[0].text, "planish-c {c}");
        assert_eq!(found.stage("two").unwrap()[0].text, "planish-b {method}");
    }

    #[test]
    fn every_pipeline_is_read_and_knows_the_settings_of_its_stages() {
        for (name, _) in FILES.iter().filter(|(name, _)| *name != SHARED) {
            let own = FILES.iter().find(|(known, _)| known == name).unwrap().1;
            Definition::read(name, FILES[0].1, own).unwrap_or_else(|e| panic!("{e}"));
        }
        let raster = Definition::built_in("raster").unwrap();
        let cut = ["map", "tool", "limits", "one_pass", "tool_path", "form"];
        let names =
            |stage: &str| raster.settings_of(stage, &cut).into_iter().collect::<Vec<_>>().join(" ");
        assert_eq!(names("path"), "overscan_mm pitch_mm scan step_mm turn variant");
        assert_eq!(names("there-and-back"), "passes");
        assert_eq!(Definition::built_in("shared"), None);
    }

    /// Settings that a pipeline refuses by a message of its own where it does not use them.
    const REFUSED_BY_NAME: [&str; 3] = ["passes", "refine", "frames"];

    #[test]
    fn every_setting_of_a_pipeline_has_an_effect_on_its_run() {
        let mut unused = Vec::new();
        for (name, _) in FILES.iter().filter(|(name, _)| *name != SHARED) {
            let pipeline = Definition::built_in(name).unwrap();
            let used = pipeline.settings_of("run", &[]);
            for setting in &pipeline.settings {
                if !used.contains(&setting.name) && !REFUSED_BY_NAME.contains(&&*setting.name) {
                    unused.push(format!("{name}: {}", setting.name));
                }
            }
        }
        assert!(unused.is_empty(), "list these under `without`:\n{}", unused.join("\n"));
    }

    #[test]
    fn a_mistake_is_named_with_its_file_and_the_remedy() {
        for (own, said) in [
            ("titel: x", "pipelines/p.yaml: line 1: the file has no key 'titel'"),
            ("settings:\n  c: {type: text, help: C}", "line 2: c: 'text' is no type; give word"),
            ("settings:\n  c: {type: word}", "line 2: the setting c lacks `help`"),
            ("settings:\n  c: {type: word, default: 1, help: C}", "the item is 1; give a text"),
            ("without: [z]", "`without` names 'z', which is no shared setting"),
            ("stages:\n  one: [three]", "stage one: no stage 'three'; add it to `stages`"),
            ("stages:\n  one: ['planish-a {z}']", "one: no setting or value 'z'"),
            ("stages:\n  one: ['planish-a x when z']", "one: no setting or value 'z'"),
            ("stages:\n  one: ['rm -rf x']", "stage one: 'rm -rf x': "),
            ("values:\n  v: ['{w}']\n  w: ['{v}']", "is made of itself, by v, w"),
            ("stages:\n  one: [one]", "stage one: it runs itself without end (one -> one); take"),
            (
                "stages:\n  one: [two when b]\n  two: [run]",
                "without end (one -> two -> run -> one)",
            ),
            (
                "stages:\n  two: ['choose method otherwise x tried by run']",
                "it runs itself without end (",
            ),
            ("stages: [", "pipelines/p.yaml: line "),
        ] {
            let complaint = Definition::read("p", SHARED_TEXT, own).unwrap_err();
            assert!(complaint.contains(said), "{own}: {complaint}");
        }
    }
}
