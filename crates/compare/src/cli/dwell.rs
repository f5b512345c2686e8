//! `planish compare dwell`.

use std::path::PathBuf;

use clap::Args;
use planish_compare::dwell;
use planish_handoff::{Failure, Inputs, Output, Status, flags::OutputArgs, kind, say, task};
use planish_types::text::visible;
use serde_json::json;

use super::super::files;

#[derive(Args)]
pub struct Dwell {
    /// Run: a directory with surface/, tool_path/ and solvers/<solver>/ with dwell/,
    /// position/removal/, executed/{trajectory,removal}/, dwell-wall.json, or only message.txt
    #[arg(value_name = "RUN_DIR")]
    run: PathBuf,
    /// Tool path of the solvers [tool_path artifact; default: tool_path/ in the run]
    #[arg(long, value_name = "DIR")]
    tool_path: Option<PathBuf>,
    /// Solvers that the run leaves out, separated by blanks; what an earlier run left of them does not count
    #[arg(long, value_name = "NAMES", value_delimiter = ' ')]
    skip: Vec<String>,
    /// Name of the mirror
    #[arg(long, value_name = "NAME", default_value = "")]
    mirror: String,
    /// Name of the machine, if nobody named one and it is that of the fixtures; the result says so
    #[arg(long, value_name = "NAME")]
    assumed_machine: Option<String>,
    #[command(flatten)]
    output: OutputArgs,
}

impl Dwell {
    pub fn run(&self) -> Result<Status, Failure> {
        let Dwell { run, tool_path, skip, mirror: fixture, assumed_machine, output } = self;
        let remarks: Vec<String> =
            assumed_machine.iter().map(|name| planish_types::assumed_machine(name)).collect();
        let mut inputs = Inputs::new();
        let task = task!("dwell", json!({ "fixture": fixture, "skip": skip, "remarks": remarks }));
        let tool_path = tool_path.clone().unwrap_or_else(|| run.join("tool_path"));
        let (surface, rows) = files::read_solvers(&mut inputs, run, &tool_path, skip)?;
        let writer = Output::directory(output, &kind::REPORT).begin(&task, &inputs)?.writer();
        let solvers: serde_json::Map<String, serde_json::Value> =
            rows.iter().map(|(name, row)| (name.clone(), json!(row))).collect();
        let initial = surface.statistics();
        let summary = json!({
            "fixture": fixture,
            "initial": { "rms_nm": initial.rms, "pv_nm": initial.pv },
            "solvers": solvers,
            "remarks": remarks,
        });
        let mut bytes = serde_json::to_vec_pretty(&summary)?;
        bytes.push(b'\n');
        // The table is wanted every time, also when the file is there already.
        if let Some(mut writer) = writer {
            let beside = [("summary.json", bytes)];
            writer.write_arrays(&kind::REPORT, &[], &beside, json!({}), &Status::Done)?;
        }
        say(dwell::table(fixture, &surface, &rows));
        remarks.iter().for_each(say);
        say(visible(&output.out.join("summary.json").to_string_lossy()));
        Ok(Status::Done)
    }
}
