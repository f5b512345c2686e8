//! Plans of a sweep: the front of the best ones, and the plan that is to be run.
//!
//! A plan is a point of residual against time. On the front are the plans that no other plan beats in both. The
//! residual is that of the plan without errors. If the sweep has an error budget, there is a second front with the
//! residual that 95 % of the runs are below.

mod picture;

use std::collections::BTreeSet;

use planish_numerics::pareto;
use planish_types::{
    outcome::sweep::{Limited, PlanNumbers, SettingValue, Specified, SweepPlan, SweepTable},
    text::significant,
};
use serde::Deserialize;

use crate::{
    csv::{cell, quoted, text_cell},
    recommended::{Candidate, recommended},
    table::align,
};

pub use picture::{page, svg};

/// Table of the plans of a sweep, as `planish sweep table` writes it.
#[derive(Clone, Debug, Deserialize)]
#[serde(transparent)]
pub struct Table(pub SweepTable);

/// Returns the heading of the column of a limit: its quantity and, in brackets, its unit.
fn heading(limit: &Limited) -> String {
    if limit.unit.is_empty() {
        return limit.quantity.clone();
    }
    format!("{} ({})", limit.quantity, limit.unit)
}

/// Returns a few words on whether a plan keeps the specification; empty without a specification.
fn specification_in_words(numbers: &PlanNumbers) -> String {
    let Some(Specified { passed, limits }) = &numbers.specification else { return String::new() };
    let missed = limits.iter().filter(|limit| !limit.passed).count();
    if *passed { "kept".into() } else { format!("{missed} of {} missed", limits.len()) }
}

/// Choice of the residual by which plans are compared.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Residual {
    /// RMS of the residual of the plan without errors of the process, nm.
    Nominal,
    /// RMS of the residual that 95 % of the runs are below, with the errors of the process, nm.
    Below95,
}

impl Residual {
    /// Returns the caption of the axis that shows this residual.
    fn caption(self) -> &'static str {
        match self {
            Self::Nominal => "RMS of the residual (nm)",
            Self::Below95 => "RMS that 95 % of the runs are below (nm)",
        }
    }
}

impl Table {
    /// Returns the point of a plan in the plane of time and residual: [time, s; residual, nm]. `None` if the plan has
    /// no numbers, lacks this residual, or does not keep the constraints.
    pub fn point(&self, row: &SweepPlan, residual: Residual) -> Option<[f64; 2]> {
        let numbers = row.numbers.as_ref()?;
        let nm = match residual {
            Residual::Nominal => Some(numbers.rms_nm),
            Residual::Below95 => numbers.below_95_percent_nm,
        };
        nm.filter(|_| numbers.keeps(&self.0.constraints)).map(|nm| [numbers.total_time_s, nm])
    }

    /// Returns the residual by which the plans are chosen: that with errors if the sweep has an error budget,
    /// otherwise that without.
    pub fn judged_by(&self) -> Residual {
        if self.0.has_process { Residual::Below95 } else { Residual::Nominal }
    }

    /// Returns the indices of the plans on the front of residual against time, the plan of the shortest time first.
    pub fn front(&self, residual: Residual) -> Vec<usize> {
        let none = [f64::NAN; 2];
        let points: Vec<[f64; 2]> =
            self.0.plans.iter().map(|row| self.point(row, residual).unwrap_or(none)).collect();
        pareto::front(&points)
    }

    /// Returns the index of the plan that is to be run, by the rule of [`crate::recommended`]; `None` if no plan has a
    /// point (see `point`).
    pub fn recommended(&self) -> Option<usize> {
        let mut candidates: Vec<(usize, Candidate)> = Vec::new();
        for (i, row) in self.0.plans.iter().enumerate() {
            let point = self.point(row, self.judged_by());
            if let (Some([total_time_s, rms_nm]), Some(numbers)) = (point, &row.numbers) {
                let keeps_specification = numbers.keeps_specification();
                candidates.push((i, Candidate { rms_nm, total_time_s, keeps_specification }));
            }
        }
        recommended(&candidates)
    }

    /// Returns a sentence that names the plan to be run, with the command that makes it again; or that says that no
    /// plan keeps the constraints.
    pub fn sentence(&self) -> String {
        let count = self.0.plans.len();
        let Some(row) = self.recommended().map(|i| &self.0.plans[i]) else {
            return format!("None of the {count} plans keeps the constraints.");
        };
        let numbers = row.numbers.as_ref().expect("a plan without numbers is not recommended");
        let errors = numbers.below_95_percent_nm.map(|x| {
            let nm = significant(x, 4);
            format!(", with the errors of the process {nm} nm or less in 95 % of the runs,")
        });
        format!(
            "Of the {count} plans, {} is to be run: it leaves {} nm RMS{} in {} s; made again by: {}",
            row.id,
            significant(numbers.rms_nm, 4),
            errors.unwrap_or_default(),
            significant(numbers.total_time_s, 4),
            row.again
        )
    }

    /// Returns the names of the settings whose values differ between plans, in alphabetical order. A setting that only
    /// some plans have differs, too.
    pub fn varied(&self) -> Vec<&str> {
        let mut keys: Vec<&str> = self.setting_names().into_iter().collect();
        keys.retain(|key| {
            let mut values = self.0.plans.iter().map(|row| row.settings.get(*key));
            let first = values.next().flatten();
            values.any(|value| value != first)
        });
        keys
    }

    /// Returns the names of the settings of all plans, in alphabetical order.
    fn setting_names(&self) -> BTreeSet<&str> {
        self.0.plans.iter().flat_map(|row| row.settings.keys().map(String::as_str)).collect()
    }

    /// Returns the limits of the specification, with the values of the first plan that has some. Empty without a
    /// specification.
    fn specified(&self) -> &[Limited] {
        let numbers = self.0.plans.iter().filter_map(|row| row.numbers.as_ref());
        let mut specified = numbers.filter_map(|numbers| numbers.specification.as_ref());
        specified.next().map_or(&[], |specification| &specification.limits)
    }

    /// Returns all plans as comma-separated values, a row per plan; settings and numbers have their names as
    /// headings. Every limit of a specification is a column with the value of the plan.
    pub fn csv(&self) -> String {
        let keys = self.setting_names();
        let mut out = String::from("id,path,method,");
        for key in &keys {
            out += &format!("{},", quoted(&text_cell(key)));
        }
        out += "total_time_s,rms_nm,rms_detilted_nm,below_95_percent_nm,limits_kept,";
        let limits = self.specified();
        if !limits.is_empty() {
            out += "specification_kept,";
        }
        for limit in limits {
            out += &format!("{},", quoted(&text_cell(&heading(limit))));
        }
        out += "keeps_constraints,on_front,on_front_95_percent,recommended,status,message,again\n";
        let fronts = [Residual::Nominal, Residual::Below95].map(|residual| self.front(residual));
        let recommended = self.recommended();
        for (i, row) in self.0.plans.iter().enumerate() {
            let mut cells = [&row.id, &row.path, &row.method].map(|word| text_cell(word)).to_vec();
            for key in &keys {
                cells.push(match row.settings.get(*key) {
                    Some(SettingValue::Word(word)) => text_cell(word),
                    Some(SettingValue::Number(number)) => number.to_string(),
                    None => String::new(),
                });
            }
            let n = row.numbers.as_ref();
            cells.extend([
                cell(n.map(|n| n.total_time_s)),
                cell(n.map(|n| n.rms_nm)),
                cell(n.map(|n| n.rms_detilted_nm)),
                cell(n.and_then(|n| n.below_95_percent_nm)),
                cell(n.map(|n| n.limits_kept)),
            ]);
            if !limits.is_empty() {
                let specification = n.and_then(|n| n.specification.as_ref());
                cells.push(cell(specification.map(|s| s.passed)));
                let values = specification.map_or(&[][..], |s| &s.limits[..]);
                cells.extend((0..limits.len()).map(|k| cell(values.get(k).and_then(|l| l.value))));
            }
            cells.push(self.point(row, Residual::Nominal).is_some().to_string());
            cells.extend(fronts.iter().map(|front| front.contains(&i).to_string()));
            cells.push((recommended == Some(i)).to_string());
            let message = row.message.as_deref().unwrap_or_default();
            let status = row.status.to_string();
            cells.extend([status.as_str(), message, row.again.as_str()].map(text_cell));
            let cells: Vec<String> = cells.iter().map(|cell| quoted(cell)).collect();
            out += &cells.join(",");
            out.push('\n');
        }
        out
    }

    /// Returns the plans on the front as a table for people, the plan of the shortest time first.
    pub(crate) fn front_table(&self) -> String {
        let varied = self.varied();
        let mut lines = vec![vec!["time".to_string(), "residual".into(), "95 % below".into()]];
        let is_specified = !self.specified().is_empty();
        lines[0].push("limits".into());
        if is_specified {
            lines[0].push("specification".into());
        }
        lines[0].extend(["path".into(), "method".into()]);
        lines[0].extend(varied.iter().map(|key| key.to_string()));
        lines[0].push(String::new());
        lines.push(vec!["s".into(), "nm".into(), "nm".into()]);
        let recommended = self.recommended();
        for i in self.front(self.judged_by()) {
            let row = &self.0.plans[i];
            let Some(n) = &row.numbers else { continue };
            let mut cells = vec![significant(n.total_time_s, 4), significant(n.rms_nm, 4)];
            cells.push(n.below_95_percent_nm.map(|x| significant(x, 4)).unwrap_or_default());
            cells.push(if n.limits_kept { "kept" } else { "exceeded" }.into());
            if is_specified {
                cells.push(specification_in_words(n));
            }
            cells.extend([row.path.clone(), row.method.clone()]);
            cells.extend(varied.iter().map(|key| {
                row.settings.get(*key).map(SettingValue::to_string).unwrap_or_default()
            }));
            cells.push(if recommended == Some(i) { "*".into() } else { String::new() });
            lines.push(cells);
        }
        let columns = lines[0].len();
        lines.iter_mut().for_each(|cells| cells.resize(columns, String::new()));
        align(&lines, 0).trim_end_matches('\n').to_string()
    }

    /// Returns the number of plans that could not be made and have no numbers.
    pub fn failed(&self) -> usize {
        self.0.plans.iter().filter(|row| row.numbers.is_none()).count()
    }
}

/// Returns path, method and settings of a plan as a phrase.
fn in_words(row: &SweepPlan) -> String {
    let settings: Vec<String> =
        row.settings.iter().map(|(key, value)| format!("{key}={value}")).collect();
    format!("{}, {}: {}", row.path, row.method, settings.join(" "))
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::{Value, json};

    /// Returns a table of plans with these times (s), residuals (nm) and states of the limits (true: kept).
    pub(super) fn table(plans: &[(f64, f64, bool)], max_time_s: Option<f64>) -> Table {
        let row = |(i, (time, rms, kept)): (usize, &(f64, f64, bool))| {
            json!({
                "id": format!("plan-{i}"), "path": if i % 2 == 0 { "raster" } else { "maze" }, "method": "joint",
                "settings": { "pitch_mm": i, "turn": "lift" }, "status": "done", "message": null,
                "numbers": {
                    "total_time_s": time, "rms_nm": rms, "rms_detilted_nm": rms, "below_95_percent_nm": null,
                    "limits_kept": kept,
                },
                "report": format!("plans/{i}/report.html"), "again": format!("planish run raster pitch_mm={i}"),
            })
        };
        let plans: Vec<Value> = plans.iter().enumerate().map(row).collect();
        serde_json::from_value(json!({
            "name": "s", "mirror": "m", "has_process": false,
            "constraints": { "max_time_s": max_time_s, "keep_limits": true, "keep_specification": true }, "plans": plans,
        }))
        .unwrap()
    }

    #[test]
    fn the_front_has_what_keeps_the_constraints_and_nothing_beats() {
        let plans = [
            (10.0, 1.0, true),
            (5.0, 2.0, true),
            (11.0, 1.5, true),
            (1.0, 0.1, false),
            (99.0, 0.5, true),
        ];
        assert_eq!(table(&plans, Some(50.0)).front(Residual::Nominal), [1, 0]);
        assert_eq!(table(&plans, None).front(Residual::Nominal), [1, 0, 4]);
        // No plan has a residual with errors.
        assert!(table(&plans, None).front(Residual::Below95).is_empty());
    }

    #[test]
    fn what_is_recommended_is_what_the_report_of_a_run_would_recommend() {
        // 3 % more for a tenth of the time: RMS^2 T^(1/2) is least for the second.
        let plans = [(100.0, 1.0, true), (10.0, 1.03, true), (1.0, 3.0, true)];
        let swept = table(&plans, None);
        assert_eq!(swept.recommended(), Some(1));
        let sentence = swept.sentence();
        assert!(
            sentence.contains("plan-1 is to be run: it leaves 1.03 nm RMS in 10 s"),
            "{sentence}"
        );
        assert!(sentence.ends_with("planish run raster pitch_mm=1"), "{sentence}");
        assert!(table(&plans, Some(0.5)).sentence().starts_with("None of the 3 plans"));
    }

    #[test]
    fn the_csv_has_every_plan_and_quotes_what_must_be_quoted() {
        let mut table = table(&[(2.0, 1.0, true), (1.0, 2.0, true)], None);
        table.0.plans[1].message = Some("a, \"b\"".into());
        table.0.plans[1].numbers = None;
        let csv = table.csv();
        let lines: Vec<&str> = csv.lines().collect();
        assert_eq!(lines.len(), 3);
        assert!(lines[0].starts_with("id,path,method,pitch_mm,turn,total_time_s"));
        assert!(
            lines[1]
                .starts_with("plan-0,raster,joint,0,lift,2,1,1,,true,true,true,false,true,done,")
        );
        assert!(lines[2].contains(",,,,,,false,false,false,false,done,\"a, \"\"b\"\"\","), "{csv}");
    }

    #[test]
    fn no_word_of_a_cell_is_a_formula() {
        let mut table = table(&[(2.0, 1.0, true)], None);
        let row = &mut table.0.plans[0];
        row.settings.insert("tool".into(), SettingValue::Word("=HYPERLINK(\"http://x\")".into()));
        row.settings.insert("pitch_mm".into(), SettingValue::Number(-1.5));
        row.message = Some("@SUM(1)".into());
        row.again = "+1".into();
        let csv = table.csv();
        let cells = ",\"'=HYPERLINK(\"\"http://x\"\")\",";
        assert!(csv.contains(cells) && csv.ends_with(",done,'@SUM(1),'+1\n"), "{csv}");
        // A number is none.
        assert!(csv.contains(",-1.5,"), "{csv}");
    }

    #[test]
    fn only_what_differs_is_in_the_table() {
        let table = table(&[(2.0, 1.0, true), (1.0, 2.0, true)], None);
        assert_eq!(table.varied(), ["pitch_mm"]);
        assert_eq!(table.front_table().lines().count(), 4);
    }
}
