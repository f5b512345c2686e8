//! `planish compare sweep`.

use std::path::{Path, PathBuf};

use clap::Args;
use planish_compare::sweep::{Residual, Table, page, svg};
use planish_handoff::{Failure, Inputs, Output, Status, flags::OutputArgs, kind, say, task};
use planish_types::text::visible;
use serde_json::json;

/// Largest size of a table, bytes. Larger: a wrong file fills the memory. Smaller: large sweeps are refused. Chosen:
/// a million plans of about 1 KiB each.
const LARGEST_TABLE_BYTES: u64 = 1 << 30;

#[derive(Args)]
pub struct Sweep {
    /// Table of the plans, which planish sweep table has written [JSON]
    table: PathBuf,
    #[command(flatten)]
    output: OutputArgs,
}

impl Sweep {
    pub fn run(&self) -> Result<Status, Failure> {
        let mut inputs = Inputs::new();
        let bytes = inputs.read_bytes("table", &self.table, LARGEST_TABLE_BYTES)?;
        let table: Table = serde_json::from_slice(&bytes).map_err(|e| {
            Failure::new(format!("{}: {e}; write it by planish sweep table", self.table.display()))
        })?;
        let to_table = self.to_table();
        let task = task!("sweep", json!({ "to_table": to_table }));
        let recommended = table.recommended().map(|i| table.0.plans[i].id.as_str());
        let status = match recommended {
            Some(_) => Status::Done,
            None => Status::Negative(table.sentence()),
        };
        let writer = Output::directory(&self.output, &kind::SWEEP).begin(&task, &inputs)?.writer();
        if let Some(mut writer) = writer {
            let mut beside = vec![
                ("table.csv", table.csv().into_bytes()),
                ("report.html", page(&table, &to_table).into_bytes()),
            ];
            for (name, residual) in
                [("front.svg", Residual::Nominal), ("front-95-percent.svg", Residual::Below95)]
            {
                let drawn = svg(&table, residual, &to_table);
                if !drawn.is_empty() {
                    beside.push((name, drawn.into_bytes()));
                }
            }
            let [front, front_95_percent] =
                [Residual::Nominal, Residual::Below95].map(|residual| {
                    let front = table.front(residual).into_iter();
                    front.map(|i| table.0.plans[i].id.as_str()).collect::<Vec<_>>()
                });
            let outcome = json!({
                "plans": table.0.plans.len(),
                "failed": table.failed(),
                "recommended": recommended,
                "front": front,
                "front_95_percent": front_95_percent,
            });
            writer.write_arrays(&kind::SWEEP, &[], &beside, outcome, &status)?;
        }
        say(visible_lines(&table.front_table()));
        if table.failed() > 0 {
            say(format!(
                "{} of {} plans have no numbers; the page says why",
                table.failed(),
                table.0.plans.len()
            ));
        }
        say(visible(&table.sentence()));
        for name in ["table.csv", "report.html"] {
            say(visible(&self.output.out.join(name).to_string_lossy()));
        }
        Ok(status)
    }

    /// Returns the prefix of links from the page of the sweep to the folder of the table. It is `../` if the directory
    /// of the page is in that folder, otherwise the absolute path. It is empty if the folder cannot be found.
    fn to_table(&self) -> String {
        let [table, out] = [&self.table, &self.output.out]
            .map(|path| Path::new(".").join(path.parent()?).canonicalize().ok());
        match table {
            Some(table) if Some(&table) == out.as_ref() => "../".into(),
            Some(table) => format!("{}/", table.display()),
            None => String::new(),
        }
    }
}

/// Returns the text with control characters escaped, because they could command a terminal.
fn visible_lines(text: &str) -> String {
    text.lines().map(visible).collect::<Vec<_>>().join("\n")
}
