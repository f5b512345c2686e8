//! Page of a plan of several tools, with the other plans of its rack that the user wants to compare.

use std::{collections::BTreeMap, fs, path::Path};

use planish_handoff::{Failure, Inputs, OutputFile};
use planish_types::{Rack, RackEntry, outcome::plan::ChoiceReport};
use serde::{Deserialize, Serialize};

use super::{
    execute::Programs,
    several::{UserSettings, command},
};

/// Settings that state what part it is; each is a flag of the page and of the programs.
const STATEMENTS: [&str; 4] = ["part_name", "part_number", "date", "operator"];

/// Settings of the page.
#[derive(Clone, Serialize, Deserialize)]
pub struct PageSettings {
    /// True if each tool of the rack is also executed alone, and each subset that may then cost less.
    compares: bool,
    /// Factors on the prices of the rack with which the plan is made and executed again.
    #[serde(default)]
    price_factors: Vec<f64>,
    /// Flags that state what part it is.
    stated: Vec<String>,
}

/// A run of which the page is made.
pub struct PageOfRun<'a> {
    /// Directory of the run.
    pub out: &'a str,
    /// Name of the mirror.
    pub mirror: &'a str,
    /// Name of the machine, if nobody named one.
    pub assumed_machine: Option<&'a str>,
    /// `refine` or `joint`.
    pub motion: &'a str,
    /// File of the machine of the tools that have none of their own.
    pub machine: String,
    /// Tools of the rack with their paths and machines.
    pub rack: Vec<RackEntry>,
    /// Choice of the tools; `None` if the user wanted none.
    pub choice: Option<ChoiceReport>,
    /// Tools of the plan in the order in which they run.
    pub order: Vec<&'a str>,
    /// Cost of the plan as executed, nm^2.
    pub cost_nm2: f64,
}

/// Another plan of the rack that is executed beside the chosen one.
struct OtherPlan {
    tools: Vec<RackEntry>,
    /// True if its tools are chosen from `tools`.
    chooses: bool,
}

impl PageSettings {
    /// Takes the settings of the page out of those of the user. Refuses another value of `compare` than yes and no, and
    /// factors that are not above 0.
    pub fn take(user: &mut UserSettings) -> Result<Self, Failure> {
        let compares = match user.take_or("compare", "no").as_str() {
            "yes" => true,
            "no" => false,
            other => return Err(Failure::new(format!("compare is '{other}'; give yes or no"))),
        };
        let mut price_factors = Vec::new();
        let factors = user.take_or("price_factors", "");
        for text in factors.split(',').filter(|_| !factors.is_empty()) {
            match text.trim().parse::<f64>() {
                Ok(1.0) => {} // the plan itself
                Ok(factor) if factor > 0.0 && factor.is_finite() => price_factors.push(factor),
                _ => {
                    return Err(Failure::new(format!(
                        "price_factors has '{text}'; give numbers above 0 with commas between them, such as 0.3,3"
                    )));
                }
            }
        }
        let mut stated = Vec::new();
        for name in STATEMENTS {
            if let Some(value) = user.take(name).filter(|value| !value.is_empty()) {
                stated.push(format!("--{}={value}", name.replace('_', "-")));
            }
        }
        Ok(Self { compares, price_factors, stated })
    }

    /// Returns the flags that state what part it is.
    pub fn stated(&self) -> &[String] {
        &self.stated
    }

    /// Executes the other plans that the user wants to compare, and writes the page of the run. Returns the exit code of
    /// the page.
    ///
    /// # Errors
    /// Fails if a program cannot be started, or if a file cannot be written.
    pub fn write(&self, programs: &Programs, run: &PageOfRun) -> Result<u8, Failure> {
        let others = self.others(run);
        let folder = format!("{}/others", run.out);
        if Path::new(&folder).exists() {
            for entry in fs::read_dir(&folder)? {
                let entry = entry?;
                if entry.path().is_dir()
                    && !others.contains_key(&*entry.file_name().to_string_lossy())
                {
                    // It is of an earlier run.
                    fs::remove_dir_all(entry.path())?;
                }
            }
        }
        for (label, plan) in &others {
            plan.execute(programs, run, &format!("{folder}/{label}"))?;
        }
        let mut flags: Vec<String> = ["several", run.out].map(String::from).into_iter().collect();
        flags.push(format!("--mirror={}", run.mirror));
        flags.extend(run.assumed_machine.map(|name| format!("--assumed-machine={name}")));
        flags.extend(self.stated.iter().cloned());
        flags.extend(["--out".into(), format!("{}/report", run.out), "--force".into()]);
        programs.run(&command("planish-compare", &flags))
    }

    /// Returns the other plans by their labels, which name their directories: the tools with `+` between them, or
    /// `prices=` and the factor. No name of a tool has these characters.
    fn others(&self, run: &PageOfRun) -> BTreeMap<String, OtherPlan> {
        let mut others = BTreeMap::new();
        for factor in &self.price_factors {
            let mut tools = run.rack.clone();
            for tool in &mut tools {
                tool.time_weight_nm2_per_s *= factor;
            }
            let chooses = run.choice.is_some();
            others.insert(format!("prices={factor}"), OtherPlan { tools, chooses });
        }
        if !self.compares {
            return others;
        }
        let mut subsets: Vec<Vec<String>> =
            run.rack.iter().map(|tool| vec![tool.name.clone()]).collect();
        if let Some(choice) = &run.choice {
            subsets.extend(that_may_cost_less(choice, run.cost_nm2));
        }
        subsets.retain(|names| {
            let is_run = |name: &String| run.order.contains(&name.as_str());
            names.len() != run.order.len() || !names.iter().all(is_run)
        });
        for names in subsets {
            let is_in = |tool: &&RackEntry| names.contains(&tool.name);
            let tools = run.rack.iter().filter(is_in).cloned().collect();
            others.insert(names.join("+"), OtherPlan { tools, chooses: false });
        }
        others
    }
}

/// Returns the tools of the subsets of a choice, but the chosen one, whose dwell times cost less than `cost_nm2`. A
/// motion mostly costs more than its dwell times, so the other subsets presumably cost more as executed.
fn that_may_cost_less(choice: &ChoiceReport, cost_nm2: f64) -> Vec<Vec<String>> {
    let mut subsets = Vec::new();
    for (i, row) in choice.subsets.iter().enumerate() {
        if i != choice.best && row.cost_nm2 < cost_nm2 {
            subsets.push(row.tools.clone());
        }
    }
    subsets
}

impl OtherPlan {
    /// Executes the plan in the directory `at`. A negative verdict on it is a row of the page.
    fn execute(&self, programs: &Programs, run: &PageOfRun, at: &str) -> Result<(), Failure> {
        let rack = format!("{at}.json");
        let text = serde_json::to_string_pretty(&Rack { tools: self.tools.clone() })? + "\n";
        fs::create_dir_all(format!("{}/others", run.out))?;
        OutputFile::begin("out", Path::new(&rack), true, &Inputs::new())?.write(text.as_bytes())?;
        let settings = [
            "several".into(),
            format!("surface={}/surface", run.out),
            format!("rack={rack}"),
            format!("machine={}", run.machine),
            "prepare=--level none".into(),
            format!("choose={}", if self.chooses { "yes" } else { "no" }),
            format!("motion={}", run.motion),
            format!("out={at}"),
        ];
        match programs.run(&command("planish-run", &settings))? {
            0 | 1 => Ok(()),
            _ => std::process::exit(2),
        }
    }
}
