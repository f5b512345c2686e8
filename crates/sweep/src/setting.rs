//! Settings that a sweep can vary: those of the pipelines on which its stages depend, and the paths or methods they
//! belong to.
//!
//! They are called as in the pipelines, with the unit at the end of the name.

use std::{collections::BTreeSet, sync::LazyLock};

use planish_pipeline::{
    definition::Definition,
    kind::Kind,
    node::{Complaint, Node, Value},
    scope::Scope,
};
use planish_types::outcome::sweep::SettingValue;

use crate::varying;

/// Families of tool paths; each has a pipeline of the same name.
pub const PATHS: [&str; 5] = ["raster", "maze", "random-adaptive", "spiral", "multi-pitch"];

/// Methods that make dwell times and motion along a path.
pub const METHODS: [&str; 2] = ["joint", "pvt+refined"];

/// Names in the pipelines to which the sweep itself gives values: paths of inputs and outputs, and settings that all
/// plans share.
pub const OWN: [&str; 14] = [
    "map",
    "tool",
    "limits",
    "tool_path",
    "one_pass",
    "dwell",
    "methods",
    "out",
    "form",
    "error_budget",
    "specification",
    "noise_nm",
    "measured_after",
    "exported",
];

/// Names of the settings that select a tool. They exist in a sweep only, not in the pipelines.
const TOOLS: [&str; 2] = ["tool", "varying"];

/// Definitions of the pipelines of [`PATHS`], in that order.
static PIPELINES: LazyLock<Vec<Definition>> = LazyLock::new(|| {
    PATHS.iter().map(|name| Definition::built_in(name).expect("a pipeline")).collect()
});

/// All settings that can be varied, in the order of the columns of a table.
pub static SETTINGS: LazyLock<Vec<Setting>> = LazyLock::new(settings);

/// A setting that can be varied.
#[derive(Debug)]
pub struct Setting {
    /// Name of the setting, which ends with its unit.
    pub key: String,
    kind: Kind,
    /// Paths or methods to which the setting belongs.
    pub owner: Owner,
}

/// Paths or methods to which a setting belongs.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Owner {
    /// The setting belongs to the tool paths of these families.
    Paths(Vec<&'static str>),
    /// The setting belongs to these methods.
    Methods(Vec<&'static str>),
}

/// Returns the definition of the pipeline of a path family; `None` for an unknown family.
pub fn pipeline(path: &str) -> Option<&'static Definition> {
    PIPELINES.iter().find(|definition| definition.name == path)
}

/// Returns the default, as text, of a setting that all pipelines share. Panics for another name.
pub fn default(name: &str) -> String {
    let scope = Scope::new::<&str>(&PIPELINES[0], &[]).expect("no settings");
    scope.text(name).expect("a setting that all pipelines share")
}

/// Returns the names of the pipeline's stages that make a plan by `method`, without those of its path.
pub fn stages(method: &str) -> &'static [&'static str] {
    if method == "joint" { &["joint"] } else { &["dwell", "refined"] }
}

/// Table of (path family, stage, settings on which the stage depends). It is computed once, because a sweep needs it
/// for every plan.
static SETTINGS_OF_STAGES: LazyLock<Vec<(&str, &str, BTreeSet<String>)>> = LazyLock::new(|| {
    let stages = ["paths", "dwell", "refined", "joint"];
    let pairs = PIPELINES.iter().flat_map(|p| stages.map(|stage| (p, stage)));
    pairs.map(|(p, stage)| (p.name.as_str(), stage, p.settings_of(stage, &OWN))).collect()
});

/// Returns the settings on which these stages depend in the pipeline of `path`, in alphabetical order.
pub fn settings_of(path: &str, stages: &[&str]) -> BTreeSet<&'static str> {
    let known = SETTINGS_OF_STAGES.iter();
    let known = known.filter(|(p, stage, _)| *p == path && stages.contains(stage));
    known.flat_map(|(.., settings)| settings).map(String::as_str).collect()
}

fn settings() -> Vec<Setting> {
    let mut settings = Vec::new();
    for key in TOOLS {
        add(&mut settings, key, &Kind::Word, Owner::Paths(PATHS.to_vec()));
    }
    for definition in PIPELINES.iter() {
        for setting in &definition.settings {
            let name = setting.name.as_str();
            let mut paths = PATHS.to_vec();
            paths.retain(|path| settings_of(path, &["paths"]).contains(name));
            if paths.contains(&definition.name.as_str()) {
                add(&mut settings, name, &setting.kind, Owner::Paths(paths));
            }
        }
    }
    for setting in &PIPELINES[0].settings {
        let name = setting.name.as_str();
        let mut methods = METHODS.to_vec();
        methods.retain(|method| settings_of(PATHS[0], stages(method)).contains(name));
        if !methods.is_empty() {
            add(&mut settings, name, &setting.kind, Owner::Methods(methods));
        }
    }
    settings
}

fn add(settings: &mut Vec<Setting>, key: &str, kind: &Kind, owner: Owner) {
    if !settings.iter().any(|setting| setting.key == key) {
        settings.push(Setting { key: key.into(), kind: kind.clone(), owner });
    }
}

/// Largest whole number that a YAML number, which is a 64-bit float, keeps exactly: 2^53. A larger one would be
/// rounded.
const LARGEST_WHOLE: f64 = 9_007_199_254_740_992.0;

/// Pairs of settings that exclude each other: a plan has at most one of each pair.
pub const EXCLUSIVE: [[&str; 2]; 2] =
    [["min_dwell_s", "min_dwell_s_per_mm"], ["time_elasticity", "time_weight_nm2_per_s"]];

impl Setting {
    /// Returns the setting of the name `key`.
    ///
    /// # Errors
    /// Fails with a complaint about `line` that names the remedy if there is none.
    pub fn named(key: &str, line: u64) -> Result<&'static Self, Complaint> {
        if let Some(setting) = SETTINGS.iter().find(|s| s.key == key) {
            return Ok(setting);
        }
        let stem = stem(key);
        let alike: Vec<&str> = SETTINGS
            .iter()
            .map(|s| s.key.as_str())
            .filter(|known| self::stem(known) == stem)
            .collect();
        let problem = if alike.is_empty() {
            let known: Vec<&str> = SETTINGS.iter().map(|s| s.key.as_str()).collect();
            format!("no setting '{key}'; there are path, method, {}", known.join(", "))
        } else {
            format!("no setting '{key}'; write {}, in that unit", alike.join(" or "))
        };
        Err(Complaint::new(line, problem))
    }

    /// Returns true if a plan with this path and method has this setting.
    pub fn concerns(&self, path: &str, method: &str) -> bool {
        match &self.owner {
            Owner::Paths(paths) => paths.contains(&path),
            Owner::Methods(methods) => methods.contains(&method),
        }
    }

    /// Returns true if `value` is allowed by the type of the setting.
    pub fn fits(&self, value: &str) -> bool {
        self.kind.check(value).is_ok()
    }

    /// Returns true if the setting is a count or a seed: no values lie between two of its values.
    pub fn is_whole(&self) -> bool {
        matches!(self.kind, Kind::Whole { .. })
    }

    /// Reads the values of the setting from a YAML node: one value, a list, or a range. `tools` are the names of the
    /// sweep's tools, which a setting may name.
    ///
    /// # Errors
    /// Fails if one is no value of the setting, or if the list or the range has none.
    pub fn values(&self, node: &Node, tools: &[String]) -> Result<Vec<SettingValue>, Complaint> {
        let nodes = match &node.value {
            Value::List(items) if items.is_empty() => {
                let problem = format!("{} is an empty list; give a value", self.key);
                return Err(Complaint::new(node.line, problem));
            }
            Value::List(items) => items.clone(),
            Value::Map(entries) => {
                let numbers = range(&self.key, node.line, entries)?;
                numbers.map(|x| Node { line: node.line, value: Value::Number(x) }).collect()
            }
            _ => vec![node.clone()],
        };
        nodes.iter().map(|node| self.value(node, tools)).collect()
    }

    fn value(&self, node: &Node, tools: &[String]) -> Result<SettingValue, Complaint> {
        let refused = |wanted: String| {
            let problem = format!("{} is {}; give {wanted}", self.key, node.value);
            Err(Complaint::new(node.line, problem))
        };
        let text = match &node.value {
            Value::Text(text) => Some(text),
            _ => None,
        };
        match (self.key.as_str(), &self.kind) {
            ("tool", _) => {
                let names: Vec<&str> = tools.iter().map(String::as_str).collect();
                match (one_of(node, &names), names.is_empty()) {
                    (Some(name), _) => Ok(name),
                    (None, true) => refused("tools: NAME: DIR in the file, too".into()),
                    (None, false) => refused(names.join(", ")),
                }
            }
            ("varying", _) => match text.map(|text| (text, varying::check(text))) {
                Some((text, Ok(()))) => Ok(SettingValue::Word(text.clone())),
                Some((_, Err(wanted))) => refused(wanted),
                None => refused(varying::wanted()),
            },
            (_, Kind::Number { .. } | Kind::Whole { .. }) => match &node.value {
                Value::Number(x)
                    if x.abs() <= LARGEST_WHOLE && self.kind.check(&x.to_string()).is_ok() =>
                {
                    Ok(SettingValue::Number(*x))
                }
                Value::Text(text)
                    if text.trim_start().starts_with(|c: char| c.is_ascii_digit()) =>
                {
                    refused(format!(
                        "{} without a unit: the unit is that of the name",
                        self.kind.wanted()
                    ))
                }
                _ => refused(self.kind.wanted()),
            },
            (_, Kind::OneOf { number: true, .. }) if matches!(node.value, Value::Number(_)) => {
                match node.value {
                    Value::Number(x) => Ok(SettingValue::Number(x)),
                    _ => refused(self.kind.wanted()),
                }
            }
            (_, kind) => match text {
                Some(text) if kind.check(text).is_ok() && varying::own_flag(text).is_none() => {
                    Ok(SettingValue::Word(text.clone()))
                }
                Some(text) => match varying::own_flag(text) {
                    Some(flag) => {
                        refused(format!("it without {flag}, which the sweep gives itself"))
                    }
                    None => refused(kind.wanted()),
                },
                None => refused(kind.wanted()),
            },
        }
    }
}

/// Returns the word in the node if it is one of `words`; otherwise `None`.
pub fn one_of(node: &Node, words: &[&str]) -> Option<SettingValue> {
    match &node.value {
        Value::Text(text) if words.contains(&text.as_str()) => {
            Some(SettingValue::Word(text.clone()))
        }
        _ => None,
    }
}

/// Returns the name of a setting without the unit at its end.
fn stem(key: &str) -> &str {
    const UNITS: [&str; 12] = [
        "_s_per_mm",
        "_nm2_per_s",
        "_s_per_m",
        "_um2_per_s",
        "_mm",
        "_um",
        "_nm",
        "_cm",
        "_ms",
        "_min",
        "_m",
        "_s",
    ];
    UNITS.iter().find_map(|unit| key.strip_suffix(unit)).unwrap_or(key)
}

/// Largest number of values of a range in the file of a sweep; more are refused. Larger: a mistyped step makes too
/// many plans. Smaller: fine ranges are refused.
const MOST_OF_A_RANGE: f64 = 10_000.0;

/// Returns the numbers of a range `{from: A, to: B, step: S}` or `{from: A, to: B, count: N}`. With `spacing:
/// logarithmic`, the latter has equal ratios between neighbours. Refuses A above B, a step that is not positive, a
/// count below 2, and more than [`MOST_OF_A_RANGE`] values.
fn range(
    key: &str,
    line: u64,
    entries: &[(planish_pipeline::node::Key, Node)],
) -> Result<impl Iterator<Item = f64>, Complaint> {
    let [mut from, mut to, mut step, mut count] = [None; 4];
    let mut logarithmic = false;
    for (name, node) in entries {
        let place = match name.text.as_str() {
            "from" => &mut from,
            "to" => &mut to,
            "step" => &mut step,
            "count" => &mut count,
            "spacing" => {
                logarithmic = match one_of(node, &["linear", "logarithmic"]) {
                    Some(SettingValue::Word(word)) => word == "logarithmic",
                    _ => {
                        let problem = format!(
                            "spacing of {key} is {}; give linear or logarithmic",
                            node.value
                        );
                        return Err(Complaint::new(node.line, problem));
                    }
                };
                continue;
            }
            other => {
                let problem =
                    format!("a range has no '{other}'; it has from, to, and step or count");
                return Err(Complaint::new(name.line, problem));
            }
        };
        let Value::Number(number) = node.value else {
            let problem = format!("{} of {key} is {}; give a number", name.text, node.value);
            return Err(Complaint::new(node.line, problem));
        };
        *place = Some(number);
    }
    let refused =
        |problem: String| Err(Complaint::new(line, format!("the range of {key} {problem}")));
    let (Some(from), Some(to)) = (from, to) else {
        return refused("lacks from or to; give both".into());
    };
    if from > to {
        return refused(format!(
            "is empty: it goes from {from} to {to}; give the smaller one first"
        ));
    }
    if logarithmic && (from <= 0.0 || step.is_some()) {
        return refused(
            "has logarithmic spacing; begin the range above 0, and give `count` instead of `step`"
                .into(),
        );
    }
    let count = match (step, count) {
        // Its end belongs to a range, whatever rounding makes of it.
        (Some(step), None) if step > 0.0 => ((to - from) / step + 1e-9).floor() + 1.0,
        (None, Some(count)) if count >= 2.0 && count.fract() == 0.0 => count,
        _ => {
            return refused(
                "has no length; give step above 0, or a whole count of 2 or more".into(),
            );
        }
    };
    if count > MOST_OF_A_RANGE {
        return refused(format!("has {count} values; give at most {MOST_OF_A_RANGE}"));
    }
    Ok((0..count as usize).map(move |i| {
        let i = i as f64;
        rounded(match step {
            Some(step) => from + i * step,
            None if logarithmic => from * (to / from).powf(i / (count - 1.0)),
            None => from + (to - from) * i / (count - 1.0),
        })
    }))
}

/// Rounds to 12 significant digits, so that 0.8 + 2 * 0.2 is 1.2.
fn rounded(x: f64) -> f64 {
    format!("{x:.11e}").parse().expect("a formatted number is one")
}

#[cfg(test)]
mod tests {
    use super::*;
    use planish_pipeline::node::parse;

    fn values(key: &str, text: &str) -> Result<Vec<String>, String> {
        let Value::Map(top) = parse(&format!("\n{key}: {text}\n")).unwrap().value else {
            panic!("a table")
        };
        let setting = Setting::named(key, 2).map_err(|e| e.to_string())?;
        let values = setting.values(&top[0].1, &["narrow".into()]).map_err(|e| e.to_string())?;
        Ok(values.iter().map(SettingValue::to_string).collect())
    }

    #[test]
    fn a_value_a_list_and_ranges_are_read() {
        assert_eq!(values("pitch_mm", "0.8").unwrap(), ["0.8"]);
        assert_eq!(values("scan", "[x, y, 30]").unwrap(), ["x", "y", "30"]);
        // 0.8 + 2 * 0.2 is 1.2000000000000002 in binary; the last one is the end that was asked for.
        let pitches = values("pitch_mm", "{from: 0.8, to: 2, step: 0.2}").unwrap();
        assert_eq!(pitches, ["0.8", "1", "1.2", "1.4", "1.6", "1.8", "2"]);
        assert_eq!(values("seed", "{from: 1, to: 3, count: 3}").unwrap(), ["1", "2", "3"]);
        let prices = "{from: 1e-4, to: 1e-2, count: 3, spacing: logarithmic}";
        assert_eq!(values("time_weight_nm2_per_s", prices).unwrap(), ["0.0001", "0.001", "0.01"]);
        assert_eq!(values("tool", "narrow").unwrap(), ["narrow"]);
        let [none, beam] = ["none", "incidence --exponent=-1.7"];
        let second = "tool-rate --by incidence --exponent=-1.7";
        let beams = format!("[{none}, {beam}, {second}]");
        assert_eq!(values("varying", &beams).unwrap(), [none, beam, second]);
    }

    #[test]
    fn what_is_wrong_is_named_with_its_line_and_the_remedy() {
        for (key, text, said) in [
            ("pitch_um", "800", "line 2: no setting 'pitch_um'; write pitch_mm, in that unit"),
            ("min_dwell_ms", "1", "write min_dwell_s or min_dwell_s_per_mm, in that unit"),
            (
                "ptich_mm",
                "1",
                "no setting 'ptich_mm'; there are path, method, tool, varying, pitch_mm",
            ),
            (
                "pitch_mm",
                "1 mm",
                "line 2: pitch_mm is '1 mm'; give a number above 0 without a unit",
            ),
            ("pitch_mm", "-1", "pitch_mm is -1; give a number above 0"),
            ("pitch_mm", "[1, [2]]", "pitch_mm is a list; give a number above 0"),
            ("pitch_mm", "", "pitch_mm is empty; give a number above 0"),
            ("pitch_mm", "[]", "pitch_mm is an empty list; give a value"),
            ("passes", "1.5", "passes is 1.5; give a whole number from 1 to 99"),
            ("contrast", "2", "contrast is 2; give a number from 0 to 1"),
            ("turn", "round", "turn is 'round'; give square, semicircle or lift"),
            ("tool", "wide", "tool is 'wide'; give narrow"),
            (
                "varying",
                "1",
                "varying is 1; give none, or the words of planish tool incidence, rate,",
            ),
            ("varying", "prepare", "varying is 'prepare'; give none, or the words of"),
            (
                "varying",
                "edge --out elsewhere",
                "give it without --out: the sweep gives --tif, --surface, --out and --force",
            ),
            ("pitch_mm", "{from: 2, to: 1, step: 0.1}", "is empty: it goes from 2 to 1"),
            ("pitch_mm", "{from: 1, to: 2, step: 0}", "has no length; give step above 0"),
            ("pitch_mm", "{from: 1, to: 2}", "has no length"),
            ("pitch_mm", "{from: 1, step: 2}", "lacks from or to"),
            ("pitch_mm", "{from: 1, to: 2, steps: 2}", "a range has no 'steps'"),
            (
                "pitch_mm",
                "{from: 1, to: 2, step: 1e-9}",
                "has 1000000000 values; give at most 10000",
            ),
            (
                "pitch_mm",
                "{from: 0, to: 2, count: 3, spacing: logarithmic}",
                "begin the range above 0",
            ),
        ] {
            let complaint = values(key, text).unwrap_err();
            assert!(complaint.contains(said) && complaint.starts_with("line 2: "), "{complaint}");
        }
    }
}
