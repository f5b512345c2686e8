//! Plans of a sweep, and the stages that make them. A stage is a run of one program of Planish.
//!
//! The name of every result holds the hash of all its inputs. So results that several plans share are made once, and an
//! existing result is never out of date. The ground of a plan are the hashes of the inputs that all plans share; a
//! round is a list of plans that are made together.

use planish_pipeline::{
    scope::Scope,
    walk::{StageCommand, Walk},
};
use planish_types::outcome::sweep::{Constraints, SettingValue};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use crate::{
    setting::{METHODS, PATHS, SETTINGS, pipeline, settings_of, stages},
    varying,
};

/// A sweep that is ready to run: its plans, and the paths of their inputs. All paths are relative to the directory of
/// the sweep, where its stages run, except those of a mirror that the user has given.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Sweep {
    /// Version of the layout of `sweep.json`.
    pub version: u32,
    /// Name of the sweep: the name of its file without the ending.
    pub name: String,
    /// Name of the mirror that people read.
    pub mirror: String,
    /// Stages (runs of programs) that make the map and the tools, in their order.
    pub mirror_steps: Vec<Step>,
    /// Directory of the desired removal.
    pub surface: String,
    /// Tools: name and directory. The first one has an empty name; it is the mirror's own.
    pub tools: Vec<(String, String)>,
    /// Path of the machine file.
    pub machine: String,
    /// Path of the error budget of the process; `None` if the plans are not judged by it.
    pub process: Option<String>,
    /// Path of the specification; `None` if the plans are not judged by it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub specification: Option<String>,
    /// True if each plan gets a report page of its own.
    pub reports: bool,
    /// Constraints that a plan must keep to be on the front of residual against time.
    pub constraints: Constraints,
    /// Settings of `planish run` that all plans share, to make a plan again.
    pub again: Vec<String>,
    /// Hashes of the inputs that all plans share.
    pub ground: Ground,
    /// Rounds of plans: first the grid of the file, then the plans that each round of the search proposed.
    pub rounds: Vec<Round>,
}

/// Plans that are made together: the grid of the file, or one round of the search.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Round {
    /// Hash of the names of its plans, so that another grid is another round.
    pub id: String,
    /// Plans of the round.
    pub plans: Vec<SweptPlan>,
}

/// Hashes of the inputs that all plans share. They are part of the names of all results.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Ground {
    /// Hash of the desired removal.
    pub surface: String,
    /// Hashes of the tools, by name; the mirror's own tool has an empty name.
    pub tools: Vec<(String, String)>,
    /// Hashes of the commands that make varying tools, with the files that they read, by the text of the setting.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub varying: Vec<(String, String)>,
    /// Command of a varying tool for the plans without that setting: that of the fixture; `None` if it has none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub own_varying: Option<String>,
    /// Hash of the machine file.
    pub machine: String,
    /// Hash of the error budget; `None` if there is none.
    pub process: Option<String>,
    /// Hash of the specification; `None` if there is none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub specification: Option<String>,
}

/// A stage with its arguments: one run of a program.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Step {
    /// Name of the program, such as `planish-joint`.
    pub program: String,
    /// Arguments of the program.
    pub arguments: Vec<String>,
}

/// A plan of a sweep: path, method and settings, and the names of its results.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SweptPlan {
    /// Name of the plan, which ends with the hash of its inputs.
    pub id: String,
    /// Name of its tool path, which plans with the same path share.
    pub path_id: String,
    /// Name of its first dwell times, which plans share; `None` if the method does not start from dwell times.
    pub dwell_id: Option<String>,
    /// Family of the tool path, such as `raster`.
    pub path: String,
    /// Method that makes dwell times and motion, such as `joint`.
    pub method: String,
    /// Settings and their values, in the order of the table of settings.
    pub settings: Vec<(String, SettingValue)>,
}

impl Step {
    /// Makes a stage that runs `program` with `arguments`.
    pub fn new(program: &str, arguments: impl IntoIterator<Item = impl Into<String>>) -> Self {
        let arguments = arguments.into_iter().map(Into::into).collect();
        Self { program: program.into(), arguments }
    }
}

impl SweptPlan {
    /// Makes a plan with these settings. It adds the default pitch and step of the path, and the varying tool of the
    /// fixture, if they are not given; other settings keep their defaults unstated. Its name contains the hash of its
    /// inputs.
    pub fn new(
        path: &str,
        method: &str,
        settings: Vec<(String, SettingValue)>,
        ground: &Ground,
    ) -> Self {
        let mut plan = Self {
            id: String::new(),
            path_id: String::new(),
            dwell_id: None,
            path: path.into(),
            method: method.into(),
            settings: with_defaults(path, settings, ground),
        };
        let varied = varied_tool(plan.tool(), plan.varying(), ground);
        let tif = varied.or_else(|| value_of(&ground.tools, plan.tool()).cloned());
        let of_path = resolved(path, &plan.settings, &["paths"]);
        let of_path = json!(["path", path, ground.surface, tif, ground.machine, of_path]);
        plan.path_id = name(path, &of_path);
        if method == "pvt+refined" {
            let of_dwell = resolved(path, &plan.settings, &["dwell"]);
            plan.dwell_id = Some(name(path, &json!(["dwell", plan.path_id, of_dwell])));
        }
        let of_method = resolved(path, &plan.settings, stages(method));
        let of_plan = json!(["plan", plan.path_id, method, ground.process, of_method]);
        let whole = match &ground.specification {
            Some(hash) => json!([of_plan, ["specification", hash]]),
            None => of_plan,
        };
        plan.id = name(&format!("{path}-{method}"), &whole);
        plan
    }

    /// Returns the value of the setting `key`; `None` if the plan does not have it.
    pub fn get(&self, key: &str) -> Option<&SettingValue> {
        value_of(&self.settings, key)
    }

    /// Returns the value of the setting `key` as a number; `None` if the plan does not have it or it is no number.
    pub fn number(&self, key: &str) -> Option<f64> {
        match self.get(key) {
            Some(SettingValue::Number(number)) => Some(*number),
            _ => None,
        }
    }

    /// Returns the name of the plan's tool; it is empty for the mirror's own tool.
    pub fn tool(&self) -> &str {
        match self.get("tool") {
            Some(SettingValue::Word(name)) => name,
            _ => "",
        }
    }

    /// Returns the command that makes the plan's tool vary over the part; `None` if the tool is the same everywhere.
    pub fn varying(&self) -> Option<&str> {
        match self.get("varying") {
            Some(SettingValue::Word(text)) if text != varying::NONE => Some(text),
            _ => None,
        }
    }

    /// Returns the directory of the plan in the sweep.
    pub fn dir(&self) -> String {
        format!("plans/{}", self.id)
    }

    /// Returns the directory of the plan's motion and the results of its method.
    pub fn method_dir(&self) -> String {
        format!("plans/{}/methods/{}", self.id, self.method)
    }

    /// Returns true if the tool goes over the path more than once.
    fn is_repeated(&self) -> bool {
        self.number("passes").is_some_and(|passes| passes > 1.0)
    }
}

impl Round {
    /// Makes a round with these plans.
    pub fn new(plans: Vec<SweptPlan>) -> Self {
        let ids: Vec<&str> = plans.iter().map(|plan| plan.id.as_str()).collect();
        Self { id: hash(&json!(ids)), plans }
    }
}

/// Returns the first 12 hexadecimal digits of the BLAKE3 hash of a value together with the version of this program.
pub fn hash(content: &Value) -> String {
    let versioned = json!([env!("CARGO_PKG_VERSION"), content]);
    blake3::hash(versioned.to_string().as_bytes()).to_hex()[..12].to_string()
}

/// Programs that may make a mirror; a step of the mirror runs no other.
const MIRROR_PROGRAMS: [&str; 4] =
    ["planish-fixture", "planish-import", "planish-surface", "planish-tool"];

/// Returns true if `text` can be the name of an entry of a directory, in characters that a shell needs no quotes for.
fn is_name(text: &str) -> bool {
    !text.is_empty()
        && !text.starts_with(['.', '-'])
        && text.bytes().all(|b| b.is_ascii_alphanumeric() || b"-_+.".contains(&b))
}

/// Returns true if `path` is relative and leads to something in the directory of the sweep.
fn is_inside(path: &str) -> bool {
    path.split('/').all(is_name)
}

impl Sweep {
    /// Checks that an expansion can have written this sweep. Its steps run only programs that make a mirror,
    /// everything is written in the directory of the sweep, and every name contains the hash of its content.
    ///
    /// # Errors
    /// Fails with a message that says what no expansion writes.
    pub fn check(&self) -> Result<(), String> {
        for step in &self.mirror_steps {
            let program = &step.program;
            if !MIRROR_PROGRAMS.contains(&program.as_str()) {
                return Err(format!(
                    "a step of the mirror runs '{program}', which makes no mirror"
                ));
            }
            let mut places = step.arguments.iter().zip(step.arguments.iter().skip(1));
            let outs = places.by_ref().filter(|(flag, _)| *flag == "--out");
            let outs: Vec<&str> = outs.map(|(_, out)| out.as_str()).collect();
            for argument in &step.arguments {
                let writes = ["--out=", "--picture", "--wall-time"];
                if writes.iter().any(|flag| argument.starts_with(flag)) {
                    return Err(format!("a step of the mirror has the flag '{argument}'"));
                }
            }
            if outs.len() != 1 || !outs.iter().all(|out| is_inside(out)) {
                return Err(format!("{program} writes '{}', not in the sweep", outs.join("', '")));
            }
        }
        if !is_inside(&self.surface) || !is_name(&self.ground.surface) {
            return Err(format!("the surface is '{}', not in the sweep", self.surface));
        }
        if let Some(round) = self.rounds.iter().find(|round| !is_name(&round.id)) {
            return Err(format!("a round is named '{}'", round.id));
        }
        match self.plans().find(|plan| !self.is_named_by_content(plan)) {
            Some(plan) => Err(format!("the name '{}' is not that of its plan", plan.id)),
            None => Ok(()),
        }
    }

    fn is_named_by_content(&self, plan: &SweptPlan) -> bool {
        let path = plan.path.as_str();
        let method = plan.method.as_str();
        PATHS.contains(&path)
            && METHODS.contains(&method)
            && scope(path, &plan.settings).is_ok()
            && *plan == SweptPlan::new(path, method, plan.settings.clone(), &self.ground)
    }

    /// Returns the path of the file with the size of the mirror, which exists once the mirror is made.
    pub fn mirror_file(&self) -> String {
        format!("done/mirror-{}.json", self.ground.surface)
    }

    /// Returns the plans of all rounds, round by round.
    pub fn plans(&self) -> impl Iterator<Item = &SweptPlan> {
        self.rounds.iter().flat_map(|round| &round.plans)
    }

    /// Returns the path of the tool that a plan names, before the command of the setting `varying` changes it.
    fn given_tif(&self, plan: &SweptPlan) -> &str {
        value_of(&self.tools, plan.tool()).expect("a plan names a tool of its sweep")
    }

    /// Returns the path of the tool that a plan works with: the result of its command, or the tool that it names.
    pub fn tif(&self, plan: &SweptPlan) -> String {
        let varied = varied_tool(plan.tool(), plan.varying(), &self.ground);
        varied.unwrap_or_else(|| self.given_tif(plan).into())
    }

    /// Adds the stages that make the varying tools of these plans, each tool once. `words` are the words of the
    /// commands, by the text of the setting.
    pub fn add_varying(&mut self, plans: &[SweptPlan], words: &[(String, Vec<String>)]) {
        let mut made: Vec<String> = Vec::new();
        for plan in plans {
            let out = self.tif(plan);
            let words = plan.varying().and_then(|text| value_of(words, text));
            let Some(words) = words.filter(|_| !made.contains(&out)) else { continue };
            self.mirror_steps.extend(steps_of_mirror(
                "vary",
                [
                    ("tool_command", words.clone()),
                    ("constant_tool", vec![self.given_tif(plan).into()]),
                    ("map", vec![self.surface.clone()]),
                    ("tool", vec![out.clone()]),
                ],
            ));
            made.push(out);
        }
    }

    /// Returns the stages that make the tool path of a plan.
    pub fn path_steps(&self, plan: &SweptPlan) -> Vec<Step> {
        self.steps(plan, "paths")
    }

    /// Returns the commands of a stage of the plan's pipeline, with the paths of inputs and outputs in the sweep.
    fn steps(&self, plan: &SweptPlan, stage: &str) -> Vec<Step> {
        let mut scope =
            scope(&plan.path, &plan.settings).expect("the settings of a plan were checked");
        let one_pass = if plan.is_repeated() {
            format!("paths/{}/one-pass", plan.path_id)
        } else {
            self.tool_path(plan)
        };
        let places = [
            ("map", self.surface.clone()),
            ("tool", self.tif(plan)),
            ("limits", self.machine.clone()),
            ("tool_path", self.tool_path(plan)),
            ("one_pass", one_pass),
            ("dwell", format!("dwell/{}", plan.dwell_id.as_deref().unwrap_or_default())),
            ("methods", format!("{}/methods", plan.dir())),
            ("out", plan.dir()),
            ("exported", plan.method.clone()),
        ];
        for (name, word) in places {
            scope.set(name, vec![word]);
        }
        scope.set("error_budget", self.process.iter().cloned().collect());
        scope.set("specification", self.specification.iter().cloned().collect());
        let mut commands =
            Walk::commands(scope, stage).expect("a test expands the stages of every path");
        // The residual after the servo is for the reports of runs.
        commands.retain(|command| !command.arguments.iter().any(|a| a.starts_with("--servo-of=")));
        commands.into_iter().map(Step::from_command).collect()
    }

    /// Returns the directory of the tool path of a plan.
    pub fn tool_path(&self, plan: &SweptPlan) -> String {
        format!("paths/{}/path", plan.path_id)
    }

    /// Returns the stage that makes the first dwell times of a plan; `None` if its method does not start from any.
    pub fn dwell_step(&self, plan: &SweptPlan) -> Option<Step> {
        plan.dwell_id.as_ref()?;
        self.steps(plan, "dwell").pop()
    }

    /// Returns the stages that make the plan, once its path and first dwell times are made.
    pub fn plan_steps(&self, plan: &SweptPlan) -> Vec<Step> {
        let mut steps = self.steps(plan, if plan.dwell_id.is_some() { "refined" } else { "joint" });
        if self.process.is_some() {
            steps.extend(self.steps(plan, "tolerance"));
        }
        steps
    }

    /// Returns the stage that makes the report of a plan, whose directory looks like that of a single run.
    pub fn report_step(&self, plan: &SweptPlan) -> Step {
        let dir = plan.dir();
        let out = format!("{dir}/report");
        let called =
            [dir.as_str(), "--pipeline", &plan.id, "--mirror", &self.mirror, "--plots", "never"];
        let tif = self.tif(plan);
        let own = ["--tif", tif.as_str(), "--out", &out, "--force"];
        Step::new("planish-compare", ["report"].iter().chain(&called).chain(&own).copied())
    }

    /// Returns the settings of `planish run` that make a plan again; the first word is the name of the pipeline.
    pub fn again(&self, plan: &SweptPlan) -> Vec<String> {
        let mut words = vec![plan.path.clone()];
        // A plan of motion and times as one problem does not depend on the error budget.
        let is_joint = plan.method == "joint";
        let has_tool = plan.get("tool").is_some();
        for word in &self.again {
            let is_replaced = is_joint && word.starts_with("error_budget=")
                || has_tool && word.starts_with("tif=");
            if !is_replaced {
                words.push(word.clone());
            }
        }
        for (key, value) in &plan.settings {
            match key.as_str() {
                "tool" => words.push(format!("tif={}", self.given_tif(plan))),
                "varying" if plan.varying().is_none() => {}
                key => words.push(format!("{key}={value}")),
            }
        }
        let method = if is_joint {
            ["plan_joint=yes", "refine=no"]
        } else {
            ["plan_joint=no", "refine=yes"]
        };
        words.extend(method.map(String::from));
        words
    }
}

impl Step {
    /// Makes a step of a command. It leaves out the flags of wall time and picture, so that the same plan gives the
    /// same bytes.
    fn from_command(command: StageCommand) -> Self {
        let mut arguments = Vec::new();
        let mut words = command.arguments.into_iter();
        while let Some(word) = words.next() {
            match word.as_str() {
                "--wall-time" | "--picture" => drop(words.next()),
                _ => arguments.push(word),
            }
        }
        Self { program: command.program, arguments }
    }
}

/// Returns the commands of a stage that makes the mirror, which is the same in all pipelines. `names` are names in
/// the stage with the words that they stand for.
pub fn steps_of_mirror<const N: usize>(stage: &str, names: [(&str, Vec<String>); N]) -> Vec<Step> {
    let mut scope = scope(PATHS[0], &[]).expect("a pipeline needs no setting");
    for (name, words) in names {
        scope.set(name, words);
    }
    let commands = Walk::commands(scope, stage).expect("a test expands the stages of the mirror");
    commands.into_iter().map(Step::from_command).collect()
}

/// Returns the pipeline of a path family with the settings of a plan, except for those that name a tool.
fn scope(path: &str, settings: &[(String, SettingValue)]) -> Result<Scope<'static>, String> {
    let definition = pipeline(path).ok_or_else(|| format!("there is no path '{path}'"))?;
    let settings = settings.iter().filter(|(key, _)| !matches!(key.as_str(), "tool" | "varying"));
    let settings: Vec<String> = settings.map(|(key, value)| format!("{key}={value}")).collect();
    Scope::new(definition, &settings)
}

/// Returns the settings on which these stages depend, with their values in a plan, given or default. `path` is the
/// family of the tool path.
fn resolved(
    path: &str,
    settings: &[(String, SettingValue)],
    stages: &[&str],
) -> Vec<(String, String)> {
    let Ok(scope) = scope(path, settings) else { return vec![] };
    let names = settings_of(path, stages).into_iter();
    names.map(|name| (name.to_string(), scope.text(name).unwrap_or_default())).collect()
}

/// Returns the directory, in the sweep, of the varying tool that the command `text` makes of `tool`. `None` without a
/// command, or for a command that is not in `ground`.
fn varied_tool(tool: &str, text: Option<&str>, ground: &Ground) -> Option<String> {
    let command = value_of(&ground.varying, text?)?;
    let tif = value_of(&ground.tools, tool);
    Some(format!("tool/{}", hash(&json!(["tool", tif, ground.surface, command]))))
}

/// Returns the value of `key` in a list of pairs; `None` if the key is not in it.
fn value_of<'a, T>(list: &'a [(String, T)], key: &str) -> Option<&'a T> {
    list.iter().find(|(known, _)| known == key).map(|(_, value)| value)
}

/// Adds settings that are not given: the default `pitch_mm` and `step_mm` of a path that has them, and the command
/// `varying` of the fixture unless a tool is named. Returns all in the order of the table of settings.
fn with_defaults(
    path: &str,
    mut settings: Vec<(String, SettingValue)>,
    ground: &Ground,
) -> Vec<(String, SettingValue)> {
    // A tool that is given by name is what it is, as in `planish run tif=DIR`.
    let is_own = !settings.iter().any(|(key, _)| matches!(key.as_str(), "varying" | "tool"));
    if let Some(text) = ground.own_varying.as_ref().filter(|_| is_own) {
        settings.push(("varying".into(), SettingValue::Word(text.clone())));
    }
    // Those that people compare plans by are stated.
    if let (Some(definition), Ok(scope)) = (pipeline(path), scope(path, &settings)) {
        for key in ["pitch_mm", "step_mm"] {
            if definition.setting(key).is_some()
                && value_of(&settings, key).is_none()
                && let Ok(number) = scope.text(key).unwrap_or_default().parse()
            {
                settings.push((key.into(), SettingValue::Number(number)));
            }
        }
    }
    settings.sort_by_key(|(key, _)| SETTINGS.iter().position(|s| s.key == *key));
    settings
}

/// Returns a name that begins with `word` and ends with the hash of `content`.
///
/// The hash has 12 digits: of 1e5 plans two have the same hash with a probability of 2e-5, and their names differ
/// by word, too.
fn name(word: &str, content: &Value) -> String {
    format!("{word}-{}", hash(content))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sweep(process: Option<&str>) -> Sweep {
        let named = |own: &str, other: &str| {
            vec![(String::new(), own.to_string()), ("narrow".to_string(), other.to_string())]
        };
        Sweep {
            version: 1,
            name: "s".into(),
            mirror: "m".into(),
            mirror_steps: vec![],
            surface: "surface/s".into(),
            tools: named("mirror/m/tif", "/tools/narrow"),
            machine: "inputs/i/machine.json".into(),
            process: process.map(String::from),
            specification: None,
            constraints: Constraints {
                max_time_s: None,
                keep_limits: true,
                keep_specification: true,
            },
            reports: true,
            again: ["surface=a/b", "tif=a/t", "error_budget=p.json"].map(String::from).to_vec(),
            ground: Ground {
                surface: "s".into(),
                tools: named("t", "n"),
                varying: vec![("edge --pad-radius-mm 10".into(), "e".into())],
                own_varying: None,
                machine: "i".into(),
                process: process.map(String::from),
                specification: None,
            },
            rounds: vec![],
        }
    }

    fn given(sweep: &Sweep, method: &str, settings: &[(&str, SettingValue)]) -> SweptPlan {
        let settings = settings.iter().map(|(k, v)| (k.to_string(), v.clone())).collect();
        SweptPlan::new("raster", method, settings, &sweep.ground)
    }

    fn line(step: &Step) -> String {
        format!("{} {}", step.program, step.arguments.join(" "))
    }

    #[test]
    fn a_path_of_several_passes_is_made_of_one_pass() {
        let sweep = sweep(None);
        let settings =
            [("passes", SettingValue::Number(2.0)), ("scan", SettingValue::Number(30.0))];
        let plan = given(&sweep, "pvt+refined", &settings);
        let steps: Vec<String> = sweep.path_steps(&plan).iter().map(line).collect();
        let at = format!("paths/{}", plan.path_id);
        assert_eq!(
            steps,
            [
                format!(
                    "planish-toolpath raster --surface surface/s --tif mirror/m/tif --pitch-mm=1 --step-mm=1 \
                     --machine inputs/i/machine.json --angle-deg=30 --out {at}/one-pass --force"
                ),
                format!(
                    "planish-toolpath passes --tool-path {at}/one-pass --passes=2 --return --out {at}/path --force"
                ),
            ]
        );
    }

    #[test]
    fn the_mirror_is_made_by_the_stages_of_the_pipelines() {
        let word = |word: &str| vec![word.to_string()];
        let line = |stage: &str, names: [(&str, Vec<String>); 4]| {
            let steps: Vec<String> = steps_of_mirror(stage, names).iter().map(line).collect();
            steps.join("\n")
        };
        let flags = || vec!["--unit".to_string(), "m".to_string()];
        let none = |name| (name, Vec::new());
        let [a, b] = ["a", "b"].map(none);
        let fixture = [("recipe", word("r s.json")), ("made", word("mirror/m")), a, b];
        assert_eq!(line("fixture", fixture), "planish-fixture r s.json --out mirror/m --force");
        for (kind, command) in
            [("surface", "planish-import surface"), ("tif", "planish-tool from-maps")]
        {
            let (settings, out) = (format!("{kind}_settings"), format!("imported_{kind}"));
            let names = [
                (kind, word("/m/f")),
                (settings.as_str(), flags()),
                (out.as_str(), word("mirror/i")),
                none("a"),
            ];
            assert_eq!(
                line(&format!("import-{kind}"), names),
                format!("{command} /m/f --unit m --out mirror/i --force")
            );
        }
        let prepare = [
            ("measured", word("mirror/m/surface")),
            ("prepare", vec!["--level".into(), "none".into()]),
            ("map", word("surface/s")),
            none("a"),
        ];
        assert_eq!(
            line("prepare", prepare),
            "planish-surface prepare --surface mirror/m/surface --level none --out surface/s --force"
        );
    }

    #[test]
    fn each_method_has_its_stages_and_a_process_one_more() {
        let of = |process, method| {
            let sweep = sweep(process);
            let plan =
                given(&sweep, method, &[("time_weight_nm2_per_s", SettingValue::Number(1e-4))]);
            let steps = sweep.dwell_step(&plan).into_iter().chain(sweep.plan_steps(&plan));
            steps.map(|step| line(&step)).collect::<Vec<_>>()
        };
        let programs = |lines: &[String]| -> Vec<String> {
            lines.iter().map(|l| l.split(' ').next().unwrap().into()).collect()
        };
        assert_eq!(
            programs(&of(None, "joint")),
            ["planish-joint", "planish-simulate", "planish-verify"]
        );
        let refined = of(Some("p.json"), "pvt+refined");
        assert_eq!(
            programs(&refined),
            [
                "planish-dwell",
                "planish-refine",
                "planish-simulate",
                "planish-verify",
                "planish-tolerance"
            ]
        );
        let floor = " --min-dwell-of-machine=inputs/i/machine.json ";
        assert!(refined[0].contains(floor), "{}", refined[0]);
        assert!(!refined[0].contains("weight"), "{}", refined[0]);
        assert!(
            refined[1].contains(&format!("{floor}--time-weight-nm2-per-s=0.0001 ")),
            "{}",
            refined[1]
        );
        assert!(refined[1].contains(" --error-budget=p.json "), "{}", refined[1]);
    }

    #[test]
    fn every_setting_of_every_path_and_method_reaches_a_stage() {
        let sweep = sweep(None);
        for path in PATHS {
            for method in METHODS {
                for setting in SETTINGS.iter().filter(|s| s.concerns(path, method)) {
                    let values = [
                        "2",
                        "y",
                        "wilson",
                        "tour",
                        "lift",
                        "off",
                        "smooth",
                        "--line-order bi-step",
                    ];
                    let fits = values.into_iter().find(|value| setting.fits(value));
                    let Some(value) =
                        fits.filter(|_| setting.key != "tool" && setting.key != "varying")
                    else {
                        continue;
                    };
                    let given = |value: &str| match value.parse() {
                        Ok(number) => SettingValue::Number(number),
                        Err(_) => SettingValue::Word(value.into()),
                    };
                    let of = |settings: Vec<(String, SettingValue)>| {
                        let plan = SweptPlan::new(path, method, settings, &sweep.ground);
                        let steps =
                            sweep.path_steps(&plan).into_iter().chain(sweep.dwell_step(&plan));
                        let steps: Vec<String> =
                            steps.chain(sweep.plan_steps(&plan)).map(|s| line(&s)).collect();
                        (
                            plan.id.clone(),
                            steps.join("\n").replace(&plan.path_id, "P").replace(&plan.id, "I"),
                        )
                    };
                    let (plain, varied) =
                        (of(vec![]), of(vec![(setting.key.clone(), given(value))]));
                    assert_ne!(plain.0, varied.0, "{path} {method} {}={value}", setting.key);
                    assert_ne!(plain.1, varied.1, "{path} {method} {}={value}", setting.key);
                }
            }
        }
    }

    #[test]
    fn another_tool_is_that_of_its_stages_and_of_the_command() {
        let sweep = sweep(Some("p.json"));
        let plan = given(&sweep, "joint", &[("tool", SettingValue::Word("narrow".into()))]);
        assert!(line(&sweep.plan_steps(&plan)[0]).contains("--tif /tools/narrow "));
        let again = sweep.again(&plan).join(" ");
        assert_eq!(
            again,
            "raster surface=a/b tif=/tools/narrow pitch_mm=1 step_mm=1 plan_joint=yes refine=no"
        );
    }

    #[test]
    fn a_tool_that_varies_is_made_once_and_is_that_of_all_stages_of_its_plans() {
        let mut sweep = sweep(Some("p.json"));
        let command = "edge --pad-radius-mm 10";
        let varying = |text: &str| ("varying", SettingValue::Word(text.into()));
        let [constant, plain, edge] = [
            given(&sweep, "pvt+refined", &[]),
            given(&sweep, "pvt+refined", &[varying("none")]),
            given(&sweep, "pvt+refined", &[varying(command)]),
        ];
        assert_eq!(
            [sweep.tif(&constant), sweep.tif(&plain)],
            ["mirror/m/tif"; 2].map(String::from)
        );
        let tool = sweep.tif(&edge);
        assert!(tool.starts_with("tool/") && edge.path_id != plain.path_id, "{tool}");
        let words = vec![(command.to_string(), command.split(' ').map(String::from).collect())];
        sweep.add_varying(&[constant, plain.clone(), edge.clone(), edge.clone()], &words);
        let [step] = &sweep.mirror_steps[..] else { panic!("{:?}", sweep.mirror_steps) };
        let expected = format!(
            "planish-tool {command} --tif mirror/m/tif --surface surface/s --out {tool} --force"
        );
        assert_eq!(line(step), expected);
        let mut steps = sweep.path_steps(&edge);
        steps.extend(sweep.dwell_step(&edge));
        steps.extend(sweep.plan_steps(&edge));
        let with_tool = steps.iter().filter(|s| line(s).contains(&format!(" --tif {tool} ")));
        // All but the judge of the limits have a tool.
        assert_eq!(with_tool.count(), steps.len() - 1);
        let again = sweep.again(&edge);
        assert!(again.contains(&format!("varying={command}")), "{again:?}");
        assert!(!sweep.again(&plain).iter().any(|word| word.starts_with("varying")));
        assert_eq!(sweep.check(), Ok(()));
    }
}
