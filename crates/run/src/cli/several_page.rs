//! Page of a plan of several tools, with each tool of its rack alone if the user wants to compare.

use std::{fs, path::Path};

use planish_handoff::{Failure, Inputs, OutputFile};
use planish_types::{Rack, RackEntry};
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
    /// True if each tool of the rack is also planned and executed alone.
    compares: bool,
    /// Flags that state what part it is.
    stated: Vec<String>,
}

/// A tool of the rack with the file of its machine.
pub struct ToolOfRack {
    /// Entry of the rack with the path of the tool.
    pub entry: RackEntry,
    /// File of its machine.
    pub machine: String,
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
}

impl PageSettings {
    /// Takes the settings of the page out of those of the user. Refuses another value of `compare` than yes and no.
    pub fn take(user: &mut UserSettings) -> Result<Self, Failure> {
        let compares = match user.take_or("compare", "no").as_str() {
            "yes" => true,
            "no" => false,
            other => return Err(Failure::new(format!("compare is '{other}'; give yes or no"))),
        };
        let mut stated = Vec::new();
        for name in STATEMENTS {
            if let Some(value) = user.take(name).filter(|value| !value.is_empty()) {
                stated.push(format!("--{}={value}", name.replace('_', "-")));
            }
        }
        Ok(Self { compares, stated })
    }

    /// Returns the flags that state what part it is.
    pub fn stated(&self) -> &[String] {
        &self.stated
    }

    /// Writes the page of the run, after the plans of single tools if they are wanted. Returns the exit code of the page.
    ///
    /// # Errors
    /// Fails if a program cannot be started, or if a file cannot be written.
    pub fn write(
        &self,
        programs: &Programs,
        run: &PageOfRun,
        rack: &[ToolOfRack],
    ) -> Result<u8, Failure> {
        let alone = format!("{}/alone", run.out);
        if !self.compares && Path::new(&alone).exists() {
            // They are of an earlier run.
            fs::remove_dir_all(&alone)?;
        }
        if self.compares && rack.len() > 1 {
            for tool in rack {
                run_alone(programs, run, tool)?;
            }
        }
        let mut flags: Vec<String> = ["several", run.out].map(String::from).into_iter().collect();
        flags.push(format!("--mirror={}", run.mirror));
        flags.extend(run.assumed_machine.map(|name| format!("--assumed-machine={name}")));
        flags.extend(self.stated.iter().cloned());
        flags.extend(["--out".into(), format!("{}/report", run.out), "--force".into()]);
        programs.run(&command("planish-compare", &flags))
    }
}

/// Plans with one tool of the rack alone, in `alone/NAME` of the run. A negative verdict on it is a row of the page.
fn run_alone(programs: &Programs, run: &PageOfRun, tool: &ToolOfRack) -> Result<(), Failure> {
    let name = &tool.entry.name;
    let at = format!("{}/alone/{name}", run.out);
    let rack = format!("{at}.json");
    let text = serde_json::to_string_pretty(&Rack { tools: vec![tool.entry.clone()] })? + "\n";
    fs::create_dir_all(format!("{}/alone", run.out))?;
    OutputFile::begin("out", Path::new(&rack), true, &Inputs::new())?.write(text.as_bytes())?;
    let settings = [
        "several".into(),
        format!("surface={}/surface", run.out),
        format!("rack={rack}"),
        format!("machine={}", tool.machine),
        "prepare=--level none".into(),
        "choose=no".into(),
        format!("motion={}", run.motion),
        format!("out={at}"),
    ];
    match programs.run(&command("planish-run", &settings))? {
        0 | 1 => Ok(()),
        _ => std::process::exit(2),
    }
}
