//! Every command line of every pipeline, read by the flags of its stage, without running it. This finds an unknown flag,
//! a wrong value, and an input that nobody makes.
//!
//! A case is a pipeline with settings and facts: each setting with typical values, in each of [`CONTEXTS`]. Every
//! condition of a definition has to hold in some case, and to fail in another.

use std::{
    collections::{BTreeMap, BTreeSet, HashMap},
    path::{Path, PathBuf},
};

use clap::{ArgMatches, Command as Flags, value_parser};
use planish_pipeline::{
    action::Action,
    definition::{Definition, SHARED, Setting},
    kind::Kind,
    phrase::DefinitionLine,
    scope::{Scope, Words},
    walk::{StageCommand, Step, Walk},
};

use crate::stages::STAGES;

/// Directory of the run, in every case.
const RUN: &str = "RUN";
/// Flags that name what a stage writes. Every other path is an input.
const OUTPUTS: [&str; 4] = ["out", "wall-time", "picture", "dwell-density-out"];
/// Pipelines of which `planish-run compare` runs the stage `compare`.
const COMPARED: [&str; 3] = ["raster", "maze", "random-adaptive"];

/// Settings that a user gives together, and facts that differ from those of a fixture on the axes x and y. `;` separates
/// them.
const CONTEXTS: [(&str, &str); 22] = [
    ("", ""),
    ("machine=m.json;surface=s;tif=t", "surface_kind=bare;tif_kind=bare"),
    ("surface=s;tif=t", "surface_kind=file;tif_kind=file"),
    ("surface=s;tif=t", "surface_kind=artifact;tif_kind=artifact"),
    ("profile=p.csv;profile_settings=--value-unit urad --positive hill;tif=t", "tif_kind=file"),
    (
        "profile=p.csv;profile_settings=--value-unit urad --positive hill;tif=t;export=csv",
        "tif_kind=bare",
    ),
    ("surface=s;tif=t;export=galil", "surface_kind=bare;tif_kind=bare"),
    ("", "fixture_tool=tool-edge --pad-radius-mm 10 --error 3e-3"),
    ("passes=3;error_budget=e.json", ""),
    ("residual_slope_weight_mm2=1", ""),
    ("specification=s.json", ""),
    ("specification=s.json;measured_after=a;noise_nm=0.1;error_budget=e.json", ""),
    ("export=galil;machine=m.json", ""),
    ("export=galil;machine=m.json", "recommended=joint"),
    ("export=pmac;machine=m.json;program_of=pvt;error_budget=e.json;specification=s.json", ""),
    ("export=galil;machine=m.json;refine=no;program_of=pvt+refined", ""),
    ("form=f.json", ""),
    ("form=f.json", "kinematics=xyz-tilts"),
    ("form=f.json;export=gcode;machine=m.json", "kinematics=spindle"),
    ("export=gcode;machine=m.json", "kinematics=xyz;recommended=joint"),
    ("export=gcode;machine=m.json;program_of=joint", "kinematics=xyz"),
    ("path_before=p;aborted=a;surface=s;tif=t", "surface_kind=artifact;tif_kind=artifact"),
];

/// Typical values of settings that hold words or flags; `;` separates them.
const WORDS: [(&str, &str); 15] = [
    ("fixture", "coupon"),
    ("subtract", "piston;sphere"),
    (
        "skip",
        "nnls udo bcls rifta;bounded-least-squares tikhonov-lsqr tikhonov-l-curve truncated-svd lucy-richardson \
         lucy-richardson-map udo-shift feed-law",
    ),
    ("profile_settings", "--value-unit urad --positive hill"),
    ("surface_settings", "--unit um --negate"),
    ("tif_settings", "--rate --unit m --coordinate-unit m"),
    (
        "varying",
        "tool-rate --by incidence --sphere-radius-mm 100 --exponent=-1.7;tool-time --table t.txt;\
         tool-spots --by x --spot 0=a --spot 9=b",
    ),
    ("prepare", "--mask-outliers --feature-mm 4"),
    ("export_settings", "--always-on"),
    ("deconvolution", "--relative-gap 1e-2"),
    ("variant", "--line-order bi-step"),
    ("part_name", "M1 upper"),
    ("part_number", "47-11"),
    ("date", "2026-03-01"),
    ("operator", "A. B."),
];

/// Returns the text of a file in `pipelines/`.
fn text(name: &str) -> String {
    let file = planish_testkit::workspace().join("pipelines").join(format!("{name}.yaml"));
    std::fs::read_to_string(file).unwrap()
}

/// Reads a pipeline from the text of its own file.
fn definition(name: &str, own: &str) -> Definition {
    Definition::read(name, &text(SHARED), own).unwrap()
}

/// Returns typical values of a setting: bounds and a value between them, each of its words, or those of [`WORDS`].
fn typical(name: &str, kind: &Kind) -> Vec<String> {
    match kind {
        Kind::Path => vec![format!("given/{name}")],
        Kind::Number { least, closed: true, .. } => {
            vec![least.to_string(), (least + 0.5).to_string()]
        }
        Kind::Number { least, .. } => vec![(least + 0.5).to_string()],
        Kind::Whole { least, most } => {
            vec![least.to_string(), (least + 2).to_string(), most.unwrap_or(u64::MAX).to_string()]
        }
        Kind::OneOf { words, number } => {
            let mut values = words.clone();
            if *number {
                values.push("30".into());
            }
            values
        }
        Kind::Word | Kind::Flags => {
            let known = WORDS.iter().find(|(known, _)| *known == name);
            let known = known.unwrap_or_else(|| panic!("add typical values of {name} to WORDS"));
            known.1.split(';').map(String::from).collect()
        }
    }
}

/// Paths that a command line names.
#[derive(Clone, Debug, Default)]
struct Paths {
    inputs: Vec<PathBuf>,
    outputs: Vec<PathBuf>,
}

/// Reader of command lines, which remembers what it has read.
#[derive(Default)]
struct Reader {
    flags: HashMap<String, Flags>,
    read: HashMap<Vec<String>, Result<Paths, String>>,
}

impl Reader {
    /// Returns the paths in a command line, or what its program says of its flags.
    fn read(&mut self, command: &StageCommand) -> Result<Paths, String> {
        let mut words = vec![command.program.clone()];
        words.extend(command.arguments.iter().cloned());
        if let Some(known) = self.read.get(&words) {
            return known.clone();
        }
        let paths = self.parse(&words);
        self.read.insert(words, paths.clone());
        paths
    }

    fn parse(&mut self, words: &[String]) -> Result<Paths, String> {
        let program = &words[0];
        let stage = STAGES.iter().find(|stage| stage.name == program);
        let stage = stage.ok_or_else(|| format!("there is no program {program}"))?;
        let flags = self.flags.entry(program.clone()).or_insert_with(stage.definition);
        // Every program takes this flag out of its command line before it reads the others.
        let own = words.iter().filter(|word| *word != "--quiet");
        let matches = flags.try_get_matches_from_mut(own).map_err(|e| e.to_string())?;
        let mut paths = Paths::default();
        add_paths(flags, &matches, &mut paths);
        if program == "planish-export" {
            let beside = |out: &PathBuf| PathBuf::from(format!("{}.json", out.display()));
            paths.outputs.extend(paths.outputs.iter().map(beside).collect::<Vec<_>>());
        }
        Ok(paths)
    }
}

/// Adds the values of all flags that are paths, also of the subcommand.
fn add_paths(flags: &Flags, matches: &ArgMatches, paths: &mut Paths) {
    for flag in flags.get_arguments() {
        if flag.get_value_parser().type_id() != value_parser!(PathBuf).type_id() {
            continue;
        }
        let values = matches.try_get_raw(flag.get_id().as_str()).ok().flatten();
        let values = values.into_iter().flatten().map(PathBuf::from);
        match flag.get_long() {
            Some(long) if OUTPUTS.contains(&long) => paths.outputs.extend(values),
            _ => paths.inputs.extend(values),
        }
    }
    if let Some((name, matches)) = matches.subcommand() {
        add_paths(flags.find_subcommand(name).expect("a subcommand that was read"), matches, paths);
    }
}

/// A pipeline with settings and facts.
struct Case<'a> {
    scope: Scope<'a>,
    settings: Vec<String>,
    /// Plan that the report recommends, if it recommends one.
    recommended: Vec<String>,
}

impl<'a> Case<'a> {
    /// Returns the case of those of these settings that the pipeline has; `None` if it refuses the value of one.
    fn new(
        definition: &'a Definition,
        (given, facts): &(&str, &str),
        setting: Option<&(&str, String)>,
    ) -> Option<Self> {
        let name = |setting: &String| setting.split('=').next().unwrap_or_default().to_string();
        let mut settings: Vec<String> = given.split(';').map(String::from).collect();
        settings.push(format!("out={RUN}"));
        settings.retain(|s| definition.settings.iter().any(|known| known.name == name(s)));
        if let Some((key, value)) = setting {
            settings.retain(|s| name(s) != *key);
            settings.push(format!("{key}={value}"));
        }
        let mut scope = Scope::new(definition, &settings).ok()?;
        // Whoever gives one of them gives both, or the run is refused.
        let [surface, tif] = ["surface", "tif"].map(|name| scope.text(name).unwrap());
        if surface.is_empty() != tif.is_empty() {
            return None;
        }
        let kind = if surface.is_empty() { "none" } else { "artifact" };
        let facts = format!(
            "repository=;home=;surface_name=mirror;directory_name=m;machine_name=machine.json;machine_title=ion-beam;\
             surface_kind={kind};tif_kind={kind};kinematics=xy;fixture_tool=;{facts}"
        );
        let mut recommended = Vec::new();
        for (fact, words) in facts.split(';').filter_map(|fact| fact.split_once('=')) {
            let words: Vec<String> = words.split_whitespace().map(String::from).collect();
            if fact == "recommended" {
                recommended = words;
            } else {
                scope.set(fact, words);
            }
        }
        Some(Self { scope, settings, recommended })
    }

    /// Returns the commands of a stage. The report recommends the plan of the case.
    fn commands(&self, stage: &str) -> Vec<StageCommand> {
        let mut walk = Walk::new(self.scope.clone(), stage).unwrap();
        let mut commands = Vec::new();
        while let Some(step) = walk.step().unwrap() {
            let Step::Run(command) = step else { continue };
            let is_made = |plan: &String| {
                let made = format!("{RUN}/methods/{plan}/removal");
                commands.iter().any(|command: &StageCommand| command.arguments.contains(&made))
            };
            if command.arguments[0] == "report" && self.recommended.iter().all(is_made) {
                walk.scope.set("recommended", self.recommended.clone());
            }
            commands.push(command);
        }
        commands
    }

    /// Notes which conditions fail and hold in this case, before and after the report.
    fn note_conditions(&self, seen: &mut [(String, &DefinitionLine, [bool; 2])]) {
        let mut after_report = self.scope.clone();
        after_report.set("recommended", self.recommended.clone());
        for (_, line, known) in seen.iter_mut().filter(|(_, _, known)| *known != [true; 2]) {
            for scope in [&self.scope, &after_report] {
                let holds = scope.holds(&line.condition, &Words::new()).unwrap();
                known[usize::from(holds)] = true;
            }
        }
    }

    /// Returns what is wrong with the commands of a stage, a sentence each.
    fn mistakes(&self, stage: &str, reader: &mut Reader) -> Vec<String> {
        let mut made = vec![Path::new(RUN).join("machine/machine.json")];
        let mut mistakes = Vec::new();
        for command in self.commands(stage) {
            let line = command.line();
            let paths = match reader.read(&command) {
                Ok(paths) => paths,
                Err(message) => {
                    mistakes.push(format!("{line}\n    {message}"));
                    // What this command makes does not lack, too.
                    let out = command.arguments.iter().skip_while(|word| *word != "--out").nth(1);
                    made.extend(out.map(PathBuf::from));
                    continue;
                }
            };
            for path in &paths.inputs {
                let is_of_run = command.program == "planish-run" && !path.starts_with(RUN);
                let path = if is_of_run { Path::new(RUN).join(path) } else { path.clone() };
                if !self.is_there(&path, &made) {
                    mistakes.push(format!(
                        "{line}\n    no stage before it makes {}, and no setting names it",
                        path.display()
                    ));
                }
            }
            made.extend(paths.outputs);
        }
        mistakes
    }

    /// Returns true if a path is made, holds something that is made, is named by a setting, or is in the repository.
    fn is_there(&self, path: &Path, made: &[PathBuf]) -> bool {
        if path.starts_with(RUN) {
            return made.iter().any(|made| path.starts_with(made) || made.starts_with(path));
        }
        let is_named =
            |setting: &String| setting.split(['=', ' ']).any(|word| Path::new(word) == path);
        self.settings.iter().any(is_named) || planish_testkit::workspace().join(path).is_file()
    }
}

/// Returns the names that stages give to each other.
fn names_given_by_stages(definition: &Definition) -> BTreeSet<String> {
    let steps = definition.stages.iter().flat_map(|(_, stage)| &stage.steps);
    let actions = steps.map(|line| Action::read(&line.text).unwrap());
    let values = actions.filter_map(|action| match action {
        Action::Stage(_, values) => Some(values),
        Action::Command { .. } => None,
    });
    values.flatten().map(|(name, _)| name).collect()
}

/// What the cases of pipelines show.
#[derive(Default)]
struct Findings {
    /// What is wrong with a command.
    mistakes: BTreeSet<String>,
    /// Settings with their values, and whether a case accepts them.
    values: BTreeMap<String, bool>,
    /// Lines with a condition: whether it fails in some case, and whether it holds in some case.
    conditions: BTreeMap<String, [bool; 2]>,
}

impl Findings {
    /// Adds the cases of a pipeline. One that differs from `raster` in its path alone varies the settings of the path.
    fn add(&mut self, definition: &Definition, raster: &Definition, reader: &mut Reader) {
        let of_path = definition.settings_of("path", &[]);
        let is_path_alone = definition.name != raster.name
            && ["run", "mirror"].iter().all(|name| definition.stage(name) == raster.stage(name));
        let is_varied = |setting: &&Setting| {
            setting.name != "out" && (!is_path_alone || of_path.contains(&setting.name))
        };
        let mut settings = vec![None];
        for setting in definition.settings.iter().filter(is_varied) {
            let values = typical(&setting.name, &setting.kind);
            settings.extend(values.into_iter().map(|value| Some((setting.name.as_str(), value))));
        }
        let by_stages = names_given_by_stages(definition);
        let is_by_settings = |(_, line): &(&str, &DefinitionLine)| {
            let mut names = line.condition.iter().map(|term| &term.name);
            !line.condition.is_empty() && !names.any(|name| by_stages.contains(name))
        };
        let lines = definition.lines().filter(is_by_settings);
        let mut seen: Vec<(String, &DefinitionLine, [bool; 2])> =
            lines.map(|(owner, line)| (format!("{owner}: {line:?}"), line, [false; 2])).collect();
        for context in &CONTEXTS {
            for setting in &settings {
                let Some(case) = Case::new(definition, context, setting.as_ref()) else { continue };
                case.note_conditions(&mut seen);
                let is_accepted = case.scope.check().is_ok();
                if let Some((name, value)) = setting {
                    *self.values.entry(format!("{name}={value}")).or_default() |= is_accepted;
                }
                if !is_accepted {
                    continue;
                }
                self.mistakes.extend(case.mistakes("run", reader));
                if setting.is_none() && COMPARED.contains(&definition.name.as_str()) {
                    self.mistakes.extend(case.mistakes("compare", reader));
                }
            }
        }
        for (line, _, [fails, holds]) in seen {
            let known = self.conditions.entry(line).or_default();
            *known = [known[0] || fails, known[1] || holds];
        }
    }
}

#[test]
fn every_line_of_every_pipeline_has_the_flags_of_its_stage_and_inputs_that_are_made() {
    let mut findings = Findings::default();
    let mut reader = Reader::default();
    let raster = definition("raster", &text("raster"));
    let folder = std::fs::read_dir(planish_testkit::workspace().join("pipelines")).unwrap();
    let files = folder.map(|entry| entry.unwrap().path());
    for file in files.filter(|file| file.extension().is_some_and(|ending| ending == "yaml")) {
        let name = file.file_stem().unwrap().to_str().unwrap();
        if name != SHARED {
            findings.add(&definition(name, &text(name)), &raster, &mut reader);
        }
    }
    let Findings { mistakes, values, conditions } = findings;
    let mistakes: Vec<String> = mistakes.into_iter().collect();
    assert!(mistakes.is_empty(), "{} mistakes\n{}", mistakes.len(), mistakes.join("\n"));
    let refused: Vec<_> = values.iter().filter(|(_, is_accepted)| !**is_accepted).collect();
    assert!(refused.is_empty(), "no case accepts {refused:?}");
    let one_way: Vec<_> = conditions.iter().filter(|(_, known)| **known != [true; 2]).collect();
    assert!(one_way.is_empty(), "no case in which these fail, or hold: {one_way:#?}");
    assert!(values.len() > 100 && conditions.len() > 50, "{} {}", values.len(), conditions.len());
}

/// Returns what is wrong with a line that stands after the stages of the mirror.
fn mistakes_in(line: &str) -> Vec<String> {
    let own = format!("title: T\nstages:\n  path: []\n  run: [mirror, line]\n  line: ['{line}']");
    let definition = definition("p", &own);
    Case::new(&definition, &CONTEXTS[0], None).unwrap().mistakes("run", &mut Reader::default())
}

#[test]
fn a_wrong_line_is_found_and_a_right_one_is_not() {
    let path =
        "planish-toolpath raster --surface {map} --tif {tool} --pitch-mm=1 --step-mm=1 --out";
    let right = format!("{path} {{tool_path}} --scan=y --machine {{limits}}");
    assert_eq!(mistakes_in(&right), [""; 0]);
    for (line, mistake) in [
        (format!("{right} --spin 3"), "unexpected argument '--spin' found"),
        (right.replace("=y", "=z"), "invalid value 'z' for '--scan"),
        (right.replace("=1", "=one"), "invalid value 'one' for '--pitch-mm"),
        (right.replace("--surface {map} ", ""), "--surface <DIR>"),
        (right.replace("{map}", "{dwell}"), "no stage before it makes RUN/dwell"),
        (right.replace("{map}", "elsewhere"), "makes elsewhere, and no setting names it"),
        (right.replace("raster", "rastr"), "unrecognized subcommand 'rastr'"),
        (right.replace("toolpath", "path"), "there is no program planish-path"),
    ] {
        let mistakes = mistakes_in(&line);
        assert!(mistakes.len() == 1 && mistakes[0].contains(mistake), "{line}: {mistakes:?}");
    }
}
