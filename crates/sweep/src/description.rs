//! Contents of the file of a sweep, which a user writes in YAML.

use planish_pipeline::node::{Complaint, Key, Node, Value, parse};
use planish_types::outcome::sweep::{Constraints, SettingValue};

use crate::setting::{EXCLUSIVE, METHODS, Owner, PATHS, Setting, default, one_of};

/// A sweep as its file describes it. Paths are as the file gives them, relative to its folder.
#[derive(Clone, Debug, PartialEq)]
pub struct Description {
    /// Source of the mirror: its map and its tool.
    pub mirror: Mirror,
    /// Flags of `planish surface prepare`, with which the map is prepared, as one text.
    pub prepare: String,
    /// Further tools: a name, and the directory of the tool's artifact.
    pub tools: Vec<(String, String)>,
    /// Path of the machine file.
    pub machine: String,
    /// Path of the error budget, if the plans are also judged by the errors of the process; otherwise `None`.
    pub process: Option<String>,
    /// Path of the specification of the mirror, if the plans are also judged by its limits; otherwise `None`.
    pub specification: Option<String>,
    /// Constraints that a plan must keep to be on the front and to be recommended.
    pub constraints: Constraints,
    /// True if each plan gets a report page of its own.
    pub reports: bool,
    /// Blocks of settings that are varied.
    pub blocks: Vec<Block>,
}

/// Source of the mirror.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Mirror {
    /// Path of the recipe of a fixture, which makes an artificial map and its tool.
    Fixture(String),
    /// A measured map and a tool, each given as an artifact or as the file of an instrument.
    Measured {
        /// Path of the map.
        surface: String,
        /// Path of the tool.
        tif: String,
        /// Flags of `planish import surface`, as one text; used if the map is a file of an instrument.
        surface_settings: String,
        /// Flags of `planish tool from-maps`, as one text; used if the tool is a file of an instrument.
        tif_settings: String,
    },
}

/// Settings that are varied together: every combination of path, method and values is a plan.
#[derive(Clone, Debug, PartialEq)]
pub struct Block {
    /// Families of tool paths, such as `raster`.
    pub paths: Vec<String>,
    /// Methods that make dwell times and motion, such as `joint`.
    pub methods: Vec<String>,
    /// Settings with the values that each takes, in the order of the table of settings.
    pub settings: Vec<(String, Vec<SettingValue>)>,
}

/// Reads the text of the file of a sweep.
///
/// # Errors
/// Fails with a complaint about the line that is not understood.
pub fn read(text: &str) -> Result<Description, Complaint> {
    let mut top = DescriptionTable::new("the sweep", &parse(text)?)?;
    let line = top.line;
    let mirror = top.required("mirror", "mirror: with fixture, or surface and tif")?;
    let (mirror, prepare) = mirror_of(&mirror)?;
    let tools = match top.take("tools") {
        Some(node) => DescriptionTable::new("tools", &node)?.texts()?,
        None => vec![],
    };
    let machine = text_of("machine", &top.required("machine", "machine: FILE")?)?;
    let process =
        top.take("error_budget").map(|node| text_of("error_budget", &node)).transpose()?;
    let specification =
        top.take("specification").map(|node| text_of("specification", &node)).transpose()?;
    let constraints = constraints_of(top.take("constraints"), specification.is_some())?;
    let reports = match top.take("reports") {
        None => true,
        Some(node) => words("reports", &node, &["every", "none"])? == ["every"],
    };
    let plans = top.required("plans", "plans: with path, and the settings to be varied")?;
    top.finish()?;
    let names: Vec<String> = tools.iter().map(|(name, _)| name.clone()).collect();
    let blocks = match &plans.value {
        Value::List(items) => {
            items.iter().map(|item| block_of(item, &names)).collect::<Result<Vec<_>, _>>()?
        }
        _ => vec![block_of(&plans, &names)?],
    };
    if blocks.is_empty() {
        return Err(Complaint::new(line, "plans is an empty list; give path and settings"));
    }
    Ok(Description {
        mirror,
        prepare,
        tools,
        machine,
        process,
        specification,
        constraints,
        reports,
        blocks,
    })
}

/// Reads the node `mirror`. Returns the source of the mirror, and the flags of `planish surface prepare`.
fn mirror_of(node: &Node) -> Result<(Mirror, String), Complaint> {
    let mut table = DescriptionTable::new("mirror", node)?;
    let line = table.line;
    let fixture = table.text("fixture")?;
    let surface = table.text("surface")?;
    let tif = table.text("tif")?;
    let surface_settings = table.text("surface_settings")?;
    let tif_settings = table.text("tif_settings")?;
    let prepare = table.text("prepare")?.unwrap_or_else(|| default("prepare"));
    table.finish()?;
    let mirror = match (fixture, surface, tif) {
        (Some(recipe), None, None) => Mirror::Fixture(recipe),
        (None, Some(surface), Some(tif)) => Mirror::Measured {
            surface,
            tif,
            surface_settings: surface_settings.unwrap_or_default(),
            tif_settings: tif_settings.unwrap_or_else(|| default("tif_settings")),
        },
        _ => {
            let problem =
                "mirror has neither fixture alone nor both surface and tif; give one of the two";
            return Err(Complaint::new(line, problem));
        }
    };
    Ok((mirror, prepare))
}

fn constraints_of(node: Option<Node>, is_specified: bool) -> Result<Constraints, Complaint> {
    let mut constraints =
        Constraints { max_time_s: None, keep_limits: true, keep_specification: true };
    let Some(node) = node else { return Ok(constraints) };
    let mut table = DescriptionTable::new("constraints", &node)?;
    if let Some(node) = table.take("max_time_s") {
        let Value::Number(time_s @ f64::MIN_POSITIVE..) = node.value else {
            let problem = format!("max_time_s is {}; give a number above 0, in s", node.value);
            return Err(Complaint::new(node.line, problem));
        };
        constraints.max_time_s = Some(time_s);
    }
    for (key, keep) in [
        ("keep_limits", &mut constraints.keep_limits),
        ("keep_specification", &mut constraints.keep_specification),
    ] {
        let Some(node) = table.take(key) else { continue };
        let Value::Flag(flag) = node.value else {
            let problem = format!("{key} is {}; give true or false", node.value);
            return Err(Complaint::new(node.line, problem));
        };
        if key == "keep_specification" && !is_specified {
            let problem =
                "keep_specification is given without a specification; give specification: FILE";
            return Err(Complaint::new(node.line, problem));
        }
        *keep = flag;
    }
    table.finish()?;
    Ok(constraints)
}

/// Refuses a plan of several tools, whose paths are those of the rack.
fn refuse_several(path: &Node) -> Result<(), Complaint> {
    let names = match &path.value {
        Value::List(items) => &items[..],
        _ => std::slice::from_ref(path),
    };
    let is_several = |node: &&Node| matches!(&node.value, Value::Text(name) if name == "several");
    match names.iter().find(is_several) {
        None => Ok(()),
        Some(node) => {
            let problem = "path is 'several', and a plan of a sweep has one tool; planish run several rack=FILE \
                           price_factors=0.3,1,3 compare=yes executes the plans of a rack at several prices";
            Err(Complaint::new(node.line, problem))
        }
    }
}

fn block_of(node: &Node, tools: &[String]) -> Result<Block, Complaint> {
    let mut table = DescriptionTable::new("plans", node)?;
    let line = table.line;
    let path = table.required("path", &format!("path: {}", PATHS.join(", ")))?;
    refuse_several(&path)?;
    let paths = words("path", &path, &PATHS)?;
    let methods = match table.take("method") {
        Some(node) => words("method", &node, &METHODS)?,
        None => vec!["joint".into()],
    };
    let mut settings = Vec::new();
    for (key, node) in table.rest() {
        let setting = Setting::named(&key.text, key.line)?;
        let used = paths.iter().any(|p| methods.iter().any(|m| setting.concerns(p, m)));
        if !used {
            let (whose, here) = match &setting.owner {
                Owner::Paths(owners) => (owners, &paths),
                Owner::Methods(owners) => (owners, &methods),
            };
            let problem = format!(
                "{} is a setting of {}, and here is {}; leave it out",
                key.text,
                whose.join(", "),
                here.join(", ")
            );
            return Err(Complaint::new(key.line, problem));
        }
        settings.push((setting, setting.values(&node, tools)?, key.line));
    }
    let find = |key: &str| settings.iter().find(|(setting, ..)| setting.key == key);
    for [one, other] in EXCLUSIVE {
        if let (Some(_), Some((.., line))) = (find(one), find(other)) {
            let problem =
                format!("{one} and {other} are both given; leave one out, or write two blocks");
            return Err(Complaint::new(*line, problem));
        }
    }
    let repeated = |(_, values, _): &&(_, Vec<SettingValue>, u64)| {
        values.iter().any(|v| *v != SettingValue::Number(1.0))
    };
    if let (true, Some((.., line))) =
        (methods.iter().any(|m| m == "joint"), find("passes").filter(repeated))
    {
        let problem = "passes above 1 are planned by the method pvt+refined, whose times are the same in every \
                       pass; leave joint out of this block";
        return Err(Complaint::new(*line, problem));
    }
    if settings
        .iter()
        .map(|(_, values, _)| values.len())
        .try_fold(1usize, usize::checked_mul)
        .is_none()
    {
        return Err(Complaint::new(line, "has too many combinations; give shorter lists"));
    }
    let settings = settings.into_iter().map(|(s, values, _)| (s.key.clone(), values)).collect();
    Ok(Block { paths, methods, settings })
}

/// Reads a list of words or a single word, each of which must be one of `known`. `key` names the node in messages.
fn words(key: &str, node: &Node, known: &[&str]) -> Result<Vec<String>, Complaint> {
    let nodes = match &node.value {
        Value::List(items) if !items.is_empty() => items.clone(),
        _ => vec![node.clone()],
    };
    let mut words = Vec::new();
    for node in nodes {
        let Some(word) = one_of(&node, known) else {
            let problem = format!("{key} is {}; give {}", node.value, known.join(", "));
            return Err(Complaint::new(node.line, problem));
        };
        words.push(word.to_string());
    }
    Ok(words)
}

fn text_of(key: &str, node: &Node) -> Result<String, Complaint> {
    match &node.value {
        Value::Text(text) if !text.is_empty() => Ok(text.clone()),
        other => Err(Complaint::new(node.line, format!("{key} is {other}; give a text"))),
    }
}

/// A YAML table while it is read: `take` removes its keys one by one, and a key that is left over is refused as
/// unknown.
struct DescriptionTable {
    what: &'static str,
    line: u64,
    entries: Vec<(Key, Node)>,
    known: Vec<String>,
}

impl DescriptionTable {
    fn new(what: &'static str, node: &Node) -> Result<Self, Complaint> {
        match &node.value {
            Value::Map(entries) => {
                Ok(Self { what, line: node.line, entries: entries.clone(), known: vec![] })
            }
            other => {
                let problem = format!("{what} is {other}; give keys with their values");
                Err(Complaint::new(node.line, problem))
            }
        }
    }

    fn take(&mut self, key: &str) -> Option<Node> {
        self.known.push(key.into());
        let index = self.entries.iter().position(|(k, _)| k.text == key)?;
        Some(self.entries.remove(index).1)
    }

    fn required(&mut self, key: &str, remedy: &str) -> Result<Node, Complaint> {
        self.take(key).ok_or_else(|| {
            Complaint::new(self.line, format!("{} lacks {key}; give {remedy}", self.what))
        })
    }

    fn text(&mut self, key: &str) -> Result<Option<String>, Complaint> {
        self.take(key).map(|node| text_of(key, &node)).transpose()
    }

    /// Returns every entry of the table as a name and a text.
    fn texts(self) -> Result<Vec<(String, String)>, Complaint> {
        let entries = self.entries.into_iter();
        entries.map(|(key, node)| Ok((key.text.clone(), text_of(&key.text, &node)?))).collect()
    }

    fn rest(self) -> Vec<(Key, Node)> {
        self.entries
    }

    /// Refuses the first entry that nobody has taken, because its key is unknown.
    fn finish(self) -> Result<(), Complaint> {
        let Some((key, _)) = self.entries.first() else { return Ok(()) };
        let known = self.known.join(", ");
        let problem = format!("{} has no key '{}'; it has {known}", self.what, key.text);
        Err(Complaint::new(key.line, problem))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const WHOLE: &str = "\
mirror:
  fixture: coupon.json
machine: m.json
constraints: {max_time_s: 600}
plans:
  - path: [raster, maze]
    pitch_mm: [1, 2]
    seed: {from: 1, to: 3, step: 1}
";

    #[test]
    fn a_file_is_read() {
        let sweep = read(WHOLE).unwrap();
        assert_eq!(sweep.mirror, Mirror::Fixture("coupon.json".into()));
        assert_eq!(sweep.prepare, "--level piston");
        assert_eq!(
            sweep.constraints,
            Constraints { max_time_s: Some(600.0), keep_limits: true, keep_specification: true }
        );
        let [block] = &sweep.blocks[..] else { panic!("one block") };
        assert_eq!((block.paths.len(), &block.methods[..]), (2, &["joint".to_string()][..]));
        assert_eq!(block.settings[1].1.len(), 3);
    }

    #[test]
    fn a_mistake_is_named_with_its_line() {
        for (from, to, said) in [
            ("machine:", "machin:", "line 1: the sweep lacks machine; give machine: FILE"),
            (
                "constraints:",
                "constraint:",
                "line 4: the sweep has no key 'constraint'; it has mirror,",
            ),
            (
                "max_time_s: 600",
                "max_time_min: 10",
                "line 4: constraints has no key 'max_time_min'",
            ),
            (
                "max_time_s: 600",
                "max_time_s: 10 min",
                "line 4: max_time_s is '10 min'; give a number",
            ),
            (
                "max_time_s: 600",
                "max_time_s: -1",
                "line 4: max_time_s is -1; give a number above 0",
            ),
            ("pitch_mm", "pitch", "line 7: no setting 'pitch'; write pitch_mm, in that unit"),
            (
                "seed",
                "contrast",
                "line 8: contrast is a setting of random-adaptive, and here is raster, maze",
            ),
            ("[raster, maze]", "rastr", "line 6: path is 'rastr'; give raster, maze"),
            ("[raster, maze]", "[]", "line 6: path is a list; give raster, maze"),
            (
                "[raster, maze]",
                "[raster, several]",
                "line 6: path is 'several', and a plan of a sweep has one tool; planish run several",
            ),
            (
                "fixture: coupon.json",
                "surface: s",
                "line 2: mirror has neither fixture alone nor both",
            ),
            ("fixture: coupon.json", "fixtur: s", "line 2: mirror has no key 'fixtur'"),
            ("fixture: coupon.json", "fixture: 3", "line 2: fixture is 3; give a text"),
            (
                "pitch_mm: [1, 2]",
                "passes: 2",
                "line 7: passes above 1 are planned by the method pvt+refined",
            ),
            (
                "pitch_mm: [1, 2]",
                "time_elasticity: 1\n    time_weight_nm2_per_s: 1",
                "line 8: time_elasticity and time_weight_nm2_per_s are both given",
            ),
            ("plans:\n  - path", "plans: []\nx:\n  - path", "line 6: the sweep has no key 'x'"),
        ] {
            assert!(WHOLE.contains(from));
            let complaint = read(&WHOLE.replacen(from, to, 1)).unwrap_err().to_string();
            assert!(complaint.starts_with(said), "{complaint}");
        }
        assert!(read("").unwrap_err().to_string().contains("the sweep is empty"));
        assert!(read("- 1").unwrap_err().to_string().contains("the sweep is a list"));
    }
}
