//! `planish sweep table`.

use std::path::PathBuf;

use clap::Args;
use planish_handoff::{Failure, Status, say};
use planish_sweep::row::PlanRow;
use planish_types::outcome::sweep::{SweepPlan, SweepTable};
use serde_json::{Map, Value, json};

use super::super::files::{again, read_row, read_sweep, write_json};

#[derive(Args)]
pub struct TableCommand {
    /// Directory of the sweep
    dir: PathBuf,
}

impl TableCommand {
    pub fn run(&self) -> Result<Status, Failure> {
        let sweep = read_sweep(&self.dir)?;
        let mut plans = Vec::new();
        let mut failed = 0;
        for plan in sweep.plans() {
            let row = read_row(&self.dir, &plan.id)?;
            let PlanRow { status, message, numbers, .. } = row.unwrap_or_else(|| {
                PlanRow::failed(&plan.id, "it is not made; run the sweep again")
            });
            failed += usize::from(numbers.is_none());
            let report = format!("{}/report/report.html", plan.dir());
            let has_report = self.dir.join(&report).is_file();
            let settings: Map<String, Value> =
                plan.settings.iter().map(|(key, value)| (key.clone(), json!(value))).collect();
            plans.push(SweepPlan {
                id: plan.id.clone(),
                path: plan.path.clone(),
                method: plan.method.clone(),
                settings,
                status,
                message,
                numbers,
                report: Some(report).filter(|_| has_report),
                again: again(&sweep, plan),
            });
        }
        let table = SweepTable {
            name: sweep.name.clone(),
            mirror: sweep.mirror.clone(),
            has_process: sweep.process.is_some(),
            constraints: sweep.constraints,
            plans,
        };
        let path = self.dir.join("table.json");
        write_json(&path, &table)?;
        let count = table.plans.len();
        say(format!("{count} plans, {failed} without numbers -> {}", path.display()));
        Ok(Status::Done)
    }
}
