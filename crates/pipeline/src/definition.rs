//! The definition of a pipeline, read from its own file and the file that all pipelines share.

use std::collections::BTreeSet;

use crate::{
    action::Action,
    kind::Kind,
    node::{Complaint, Node, Value, parse},
    phrase::{DefinitionLine, is_name, names},
};

/// Name of the file that all pipelines share, without its ending.
pub const SHARED: &str = "shared";

/// Names of the facts: values that the program finds when it runs a pipeline and that no definition file states.
pub const FACTS: [&str; 11] = [
    "pipeline",
    "repository",
    "surface_kind",
    "tif_kind",
    "surface_name",
    "machine_name",
    "machine_title",
    "machine_by_default",
    "kinematics",
    "fixture_tool",
    "recommended",
];

/// Name of a further fact: the value `name`, which names the mirror, written so that it can name a directory.
pub const DIRECTORY_NAME: &str = "directory_name";

/// Names and texts of the definition files, embedded when the program was built: the shared file first, then one per
/// pipeline.
const FILES: [(&str, &str); 11] = [
    (SHARED, include_str!("../../../pipelines/shared.yaml")),
    ("bspline", include_str!("../../../pipelines/bspline.yaml")),
    ("compare-dwell", include_str!("../../../pipelines/compare-dwell.yaml")),
    ("line", include_str!("../../../pipelines/line.yaml")),
    ("maze", include_str!("../../../pipelines/maze.yaml")),
    ("multi-pitch", include_str!("../../../pipelines/multi-pitch.yaml")),
    ("random-adaptive", include_str!("../../../pipelines/random-adaptive.yaml")),
    ("raster", include_str!("../../../pipelines/raster.yaml")),
    ("rest", include_str!("../../../pipelines/rest.yaml")),
    ("spiral", include_str!("../../../pipelines/spiral.yaml")),
    ("trig-spline", include_str!("../../../pipelines/trig-spline.yaml")),
];

/// A setting of a pipeline, which a user gives as `NAME=VALUE`.
#[derive(Clone, Debug, PartialEq)]
pub struct Setting {
    /// Name of the setting, which ends with its unit.
    pub name: String,
    /// Type of its values, which checks what a user gives.
    pub kind: Kind,
    /// Lines of the default: the first line whose condition holds counts. Empty if the setting has no default.
    pub default: Vec<DefinitionLine>,
    /// True if a user may give it an empty value: it has no default at all, or none in the shared file.
    pub may_be_empty: bool,
    /// Description of the setting for the user.
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
    /// Messages that refuse a combination of settings, each with the condition under which it does.
    pub refuse: Vec<DefinitionLine>,
    /// Names and their values, which are derived from settings and facts: the first line whose condition holds
    /// counts.
    pub values: Vec<(String, Vec<DefinitionLine>)>,
    /// Stages by name. A stage is a list of commands and calls of other stages.
    pub stages: Vec<(String, Stage)>,
}

/// A stage of a pipeline: its steps, and its properties `optional` and `note`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Stage {
    /// Commands and other stages, in their order.
    pub steps: Vec<DefinitionLine>,
    /// Directory that receives the message of the first command if that refuses (exit code 2); the stage then ends and
    /// the run goes on. With `None`, a refusal ends the run.
    pub optional: Option<DefinitionLine>,
    /// Sentence that the user sees when the stage has ended; `None` for no sentence.
    pub note: Option<DefinitionLine>,
}

impl Stage {
    /// Returns all lines of the stage: the steps, then the lines of its properties.
    pub fn lines(&self) -> impl Iterator<Item = &DefinitionLine> {
        self.steps.iter().chain(&self.optional).chain(&self.note)
    }
}

/// Content of one definition file before it is joined with the other one.
#[derive(Default)]
struct Part {
    title: String,
    settings: Vec<(String, Draft)>,
    without: Vec<String>,
    refuse: Vec<DefinitionLine>,
    values: Vec<(String, Vec<DefinitionLine>)>,
    stages: Vec<(String, Stage)>,
}

/// A setting as one file states it. The pipeline's file may state a part, and the shared file the rest.
#[derive(Default)]
struct Draft {
    line: u64,
    kind: Option<Kind>,
    default: Option<Vec<DefinitionLine>>,
    help: Option<String>,
}

impl Definition {
    /// Reads the definition of the pipeline `name`. `shared` is the text of the shared file and `own` that of the
    /// pipeline's file.
    ///
    /// # Errors
    /// Fails with a message that names the file, the line and the remedy.
    pub fn read(name: &str, shared: &str, own: &str) -> Result<Self, String> {
        let shared = part(shared).map_err(|e| format!("pipelines/{SHARED}.yaml: {e}"))?;
        let own = part(own);
        let definition = own.and_then(|own| Self::joined(name, shared, own));
        let definition = definition.map_err(|e| format!("pipelines/{name}.yaml: {e}"))?;
        definition.check().map_err(|e| format!("pipelines/{name}.yaml: {e}"))?;
        Ok(definition)
    }

    /// Returns the definition of a pipeline that is embedded in the program; `None` if there is none of this name.
    pub fn built_in(name: &str) -> Option<Self> {
        let own = built_in_text(name).filter(|_| name != SHARED)?;
        Some(Self::read(name, built_in_text(SHARED)?, own).expect("a test reads every file"))
    }

    /// Returns the names of the settings on which the commands of `stage` depend, also through values and other stages.
    /// It leaves out the names in `cut`, and what only they depend on.
    pub fn settings_of(&self, stage: &str, cut: &[&str]) -> BTreeSet<String> {
        let mut seen: BTreeSet<String> = cut.iter().map(|name| name.to_string()).collect();
        let mut names = Vec::new();
        let mut stages = vec![stage.to_string()];
        let mut entered = BTreeSet::new();
        while let Some(stage) = stages.pop() {
            if !entered.insert(stage.clone()) {
                continue;
            }
            for line in self.stage(&stage).into_iter().flat_map(Stage::lines) {
                names.extend(names_of(line).unwrap_or_default());
            }
            stages.extend(self.stages_in(&stage));
        }
        let mut settings = BTreeSet::new();
        while let Some(name) = names.pop() {
            if !seen.insert(name.clone()) {
                continue;
            }
            names.extend(self.made_of(&name));
            if self.setting(&name).is_some() {
                settings.insert(name);
            }
        }
        settings
    }

    /// Joins the contents of both files. Where both have an entry of the same name, that of the pipeline's file
    /// counts.
    fn joined(name: &str, shared: Part, own: Part) -> Result<Self, Complaint> {
        let mut base = shared.settings;
        let mut settings = Vec::new();
        for (key, draft) in own.settings {
            let shared_index = base.iter().position(|(known, _)| *known == key);
            let shared = shared_index.map(|i| base.remove(i).1).unwrap_or_default();
            let may_be_empty = shared_index.is_some() && shared.default.is_none();
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
            if own.without.contains(&setting.name) {
                without.push(setting);
            } else {
                settings.push(setting);
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

    /// Returns the setting of this name, also if the user cannot give it in this pipeline; `None` if there is none.
    pub fn setting(&self, name: &str) -> Option<&Setting> {
        self.settings.iter().chain(&self.without).find(|setting| setting.name == name)
    }

    /// Returns the lines of the value of this name; `None` if there is none.
    pub fn value(&self, name: &str) -> Option<&[DefinitionLine]> {
        self.values.iter().find(|(known, _)| known == name).map(|(_, lines)| &lines[..])
    }

    /// Returns the stage of this name; `None` if there is none.
    pub fn stage(&self, name: &str) -> Option<&Stage> {
        self.stages.iter().find(|(known, _)| known == name).map(|(_, stage)| stage)
    }

    /// Returns the names of the stages that the stage `name` calls.
    fn stages_in(&self, name: &str) -> Vec<String> {
        let steps = self.stage(name).into_iter().flat_map(|stage| &stage.steps);
        steps.filter_map(|line| Action::read(&line.text).ok()?.stage().map(String::from)).collect()
    }

    /// Returns the names that occur in the lines of a setting's default or of a value.
    fn made_of(&self, name: &str) -> Vec<String> {
        let default = self.setting(name).map(|setting| &setting.default[..]);
        let lines = default.or(self.value(name)).unwrap_or_default();
        lines.iter().flat_map(|line| names_of(line).unwrap_or_default()).collect()
    }

    /// Returns every line of the definition, with the name of the setting, value or stage that contains it.
    pub fn lines(&self) -> impl Iterator<Item = (&str, &DefinitionLine)> {
        let settings = self.settings.iter().chain(&self.without);
        let defaults = settings.map(|setting| (setting.name.as_str(), &setting.default));
        let values = self.values.iter().map(|(name, lines)| (name.as_str(), lines));
        let lists = defaults.chain(values).chain([("refuse", &self.refuse)]);
        let stages = self.stages.iter().map(|(name, stage)| (name.as_str(), stage));
        lists
            .flat_map(|(name, lines)| lines.iter().map(move |line| (name, line)))
            .chain(stages.flat_map(|(name, stage)| stage.lines().map(move |line| (name, line))))
    }

    /// Refuses a definition without a stage `run`, unknown names and stages, values, defaults and stages that refer to
    /// themselves, and lines of a stage that are neither commands nor calls of stages.
    fn check(&self) -> Result<(), String> {
        if self.stage("run").is_none() {
            return Err("there is no stage 'run'; add it to `stages`".into());
        }
        let mut locals = BTreeSet::new();
        for (name, stage) in &self.stages {
            for line in &stage.steps {
                let action = Action::read(&line.text)
                    .map_err(|e| format!("stage {name}: '{}': {e}", line.text))?;
                let Action::Stage(called, values) = action else { continue };
                if self.stage(&called).is_none() {
                    return Err(format!("stage {name}: no stage '{called}'; add it to `stages`"));
                }
                locals.extend(values.into_iter().map(|(name, _)| name));
            }
        }
        let stages = self.stages.iter().map(|(name, _)| name);
        if let Some(circle) = circle(stages, &|stage| self.stages_in(stage)) {
            return Err(format!(
                "stage {}: it runs itself without end ({}); take one of these lines out",
                circle[0],
                circle.join(" -> ")
            ));
        }
        for (owner, line) in self.lines() {
            let names = names_of(line).map_err(|e| format!("{owner}: {e}"))?;
            for name in names {
                if !self.knows(&name) && !locals.contains(&name) {
                    return Err(format!(
                        "{owner}: no setting or value '{name}'; add it, or correct its name"
                    ));
                }
            }
        }
        let values = self.values.iter().map(|(name, _)| name);
        let names = values.chain(self.settings.iter().map(|setting| &setting.name));
        match circle(names, &|name| self.made_of(name)) {
            Some(circle) => {
                Err(format!("{}: is made of itself, by {}", circle[0], circle.join(", ")))
            }
            None => Ok(()),
        }
    }

    /// Returns true if `name` is a setting, a value or a fact.
    fn knows(&self, name: &str) -> bool {
        self.setting(name).is_some()
            || self.value(name).is_some()
            || FACTS.contains(&name)
            || name == DIRECTORY_NAME
    }
}

fn built_in_text(name: &str) -> Option<&'static str> {
    FILES.iter().find(|(known, _)| *known == name).map(|(_, text)| *text)
}

/// Returns the names of a cycle, its first name also as the last; `None` if there is no cycle. `next` returns the
/// names to which a name refers, and the search begins at `starts`.
fn circle<'a>(
    starts: impl IntoIterator<Item = &'a String>,
    next: &dyn Fn(&str) -> Vec<String>,
) -> Option<Vec<String>> {
    let mut done = BTreeSet::new();
    starts.into_iter().find_map(|start| circle_from(start, next, &mut Vec::new(), &mut done))
}

/// Returns a cycle that the search finds from `name` on; `None` if there is none. `above` are the names on the way to
/// `name`, and `done` those that were searched before. `next` returns the names to which a name refers.
fn circle_from(
    name: &str,
    next: &dyn Fn(&str) -> Vec<String>,
    above: &mut Vec<String>,
    done: &mut BTreeSet<String>,
) -> Option<Vec<String>> {
    if let Some(first) = above.iter().position(|known| known == name) {
        return Some([&above[first..], &[name.into()]].concat());
    }
    if !done.insert(name.into()) {
        return None;
    }
    above.push(name.into());
    let circle = next(name).iter().find_map(|name| circle_from(name, next, above, done));
    above.pop();
    circle
}

/// Returns the names in a line: those in braces in its text, and those in its condition.
fn names_of(line: &DefinitionLine) -> Result<Vec<String>, String> {
    let mut names = names(&line.text)?;
    names.extend(line.condition.iter().map(|term| term.name.clone()));
    Ok(names)
}

/// Returns the entries of the pipeline's file, followed by the shared entries of other names.
fn over<T: Clone>(own: Vec<(String, T)>, shared: Vec<(String, T)>) -> Vec<(String, T)> {
    let others = shared.into_iter().filter(|(name, _)| !own.iter().any(|(known, _)| known == name));
    own.iter().cloned().chain(others.collect::<Vec<_>>()).collect()
}

/// Makes a setting of a draft. Refuses a draft without a type or without a description.
fn setting(name: String, draft: Draft) -> Result<Setting, Complaint> {
    let missing = if draft.kind.is_none() { "type" } else { "help" };
    let (Some(kind), Some(help)) = (draft.kind, draft.help) else {
        return Err(Complaint::new(draft.line, format!("the setting {name} lacks `{missing}`")));
    };
    let default = draft.default.unwrap_or_default();
    Ok(Setting { kind, may_be_empty: default.is_empty(), default, help, name })
}

/// Reads the text of one definition file.
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
            "values" => {
                for (name, node) in table("values", node)? {
                    part.values.push((name.clone(), lines(&name, node)?));
                }
            }
            "stages" => {
                for (name, node) in table("stages", node)? {
                    part.stages.push((name.clone(), stage(&name, node)?));
                }
            }
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

/// Returns the keys and values of a YAML table. `what` names the table in messages; another kind of node is refused.
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

/// Reads the stage `name` from a list of steps, or from a table with the steps and the properties.
fn stage(name: &str, node: &Node) -> Result<Stage, Complaint> {
    if !matches!(node.value, Value::Map(_)) {
        return Ok(Stage { steps: lines(name, node)?, ..Stage::default() });
    }
    let mut stage = Stage::default();
    for (key, node) in table(name, node)? {
        match key.as_str() {
            "steps" => stage.steps = lines(name, node)?,
            "optional" => stage.optional = lines(name, node)?.pop(),
            "note" => stage.note = lines(name, node)?.pop(),
            _ => {
                let problem =
                    format!("the stage {name} has no key '{key}'; it has steps, optional, note");
                return Err(Complaint::new(node.line, problem));
            }
        }
    }
    Ok(stage)
}

/// Reads the lines of a list, or the single line of a text. `of` names the owner of the lines in messages.
fn lines(of: &str, node: &Node) -> Result<Vec<DefinitionLine>, Complaint> {
    let line = |(text, line): &(String, u64)| {
        DefinitionLine::read(text).map_err(|e| Complaint::new(*line, format!("{of}: {e}")))
    };
    list(node)?.iter().map(line).collect()
}

/// Returns the texts of a list, each with its line number in the file, from 1. A single text counts as a list of one.
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
        assert_eq!(found.stage("one").unwrap().steps[0].text, "planish-c {c}");
        assert_eq!(found.stage("two").unwrap().steps[0].text, "planish-b {method}");
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
        assert_eq!(names("path"), "export overscan_mm pitch_mm scan step_mm turn variant");
        assert_eq!(names("there-and-back"), "passes");
        assert_eq!(Definition::built_in("shared"), None);
    }

    /// Settings that a pipeline refuses by a message of its own where it does not use them, and the file that every run
    /// copies to `limits`.
    const REFUSED_BY_NAME_OR_COPIED: [&str; 4] = ["passes", "refine", "frames", "machine"];

    #[test]
    fn every_setting_of_a_pipeline_has_an_effect_on_its_run() {
        let mut unused = Vec::new();
        for (name, _) in FILES.iter().filter(|(name, _)| *name != SHARED) {
            let pipeline = Definition::built_in(name).unwrap();
            let used = pipeline.settings_of("run", &[]);
            for setting in &pipeline.settings {
                let is_known = REFUSED_BY_NAME_OR_COPIED.contains(&&*setting.name);
                if !used.contains(&setting.name) && !is_known {
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
            ("stages:\n  one: ['say x']", "stage one: 'say x': pipelines have no 'say' any more"),
            ("stages:\n  one: {steps: [two], quiet: x}", "the stage one has no key 'quiet'"),
            ("stages:\n  one: {note: '{z}'}", "one: no setting or value 'z'"),
            ("stages: [", "pipelines/p.yaml: line "),
        ] {
            let complaint = Definition::read("p", SHARED_TEXT, own).unwrap_err();
            assert!(complaint.contains(said), "{own}: {complaint}");
        }
    }
}
