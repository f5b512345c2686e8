//! Tables of the summaries of runs as plain aligned text: the results, and how the motions execute their plans.

use std::collections::BTreeSet;

use planish_types::{
    outcome::specification::{Bound, LimitReport, SpecificationReport},
    text::{fixed, significant, visible},
};

use crate::{
    answer::winner,
    chain::Standing,
    csv::{cell, quoted, text_cell},
    specification::Around,
    summary::{MethodResult, Summary},
};

/// Headings of the columns, two lines each. The first column is aligned left, the others right.
const HEADINGS: [[&str; 2]; 15] = [
    ["", "method"],
    ["RMS", "nm"],
    ["short waves", "nm"],
    ["detilted", "nm"],
    ["PV", "nm"],
    ["time", "s"],
    ["", "min"],
    ["max v x, y", "mm/s"],
    ["max a x, y", "mm/s^2"],
    ["v step x, y", "mm/s"],
    ["limits", "kept"],
    ["", "plan"],
    ["schedule", "s"],
    ["simulate", "s"],
    ["", "best"],
];

/// Blanks between two columns.
const GAP: &str = "  ";

/// Returns the table of the results of one run; it ends with a newline.
pub fn table(summary: &Summary) -> String {
    table_of_runs(&[("", summary)])
}

/// Returns one table of the results of several runs, each with its name; it ends with a newline.
pub(crate) fn table_of_runs(runs: &[(&str, &Summary)]) -> String {
    let named = runs.iter().any(|(name, _)| !name.is_empty());
    let mut text = String::new();
    for (name, summary) in runs {
        text += &heading(name, summary);
    }
    text.push('\n');

    let with_run = |name: &str, cells: [String; 15]| -> Vec<String> {
        let first = if named { Some(visible(name).into_owned()) } else { None };
        first.into_iter().chain(cells).collect()
    };
    let mut rows: Vec<Vec<String>> = Vec::new();
    for (line, first) in ["", "run"].into_iter().enumerate() {
        rows.push(with_run(first, HEADINGS.map(|h| h[line].to_string())));
    }
    for (name, summary) in runs {
        for (scheduler, method) in &summary.methods {
            let mark = if summary.best.as_ref() == Some(scheduler) { "*" } else { "" };
            rows.push(with_run(name, cells(scheduler, method, mark)));
        }
        for left in &summary.left_out {
            let word = match left.standing {
                Standing::NotValid => "not valid",
                Standing::Refused => "refused",
                Standing::OutOfDate | Standing::Valid => continue,
            };
            rows.push(with_run(name, cells_left_out(&left.name, word)));
        }
    }
    text += &align(&rows, if named { 2 } else { 1 });
    text.push('\n');
    if runs.iter().any(|(_, summary)| summary.best.is_some()) {
        text += "* recommended: within 5 % of the smallest RMS of those that keep the limits, and its time is worth it\n";
    } else {
        let why: BTreeSet<&str> = runs.iter().map(|(_, summary)| summary.why_no_plan()).collect();
        text += &why.into_iter().map(|why| format!("{why}\n")).collect::<String>();
    }
    if let Some(winner) = winner(runs) {
        text += &format!("{}\n", visible(&winner.sentence));
    }
    if let Some(reach) = runs.iter().find_map(|(_, summary)| summary.reach) {
        text += &format!(
            "short waves: the part of the RMS at wavelengths where the transfer function of the tool is below {} %; \
             ripple of the path is part of it\n",
            significant(100.0 * reach.transfer_threshold, 3)
        );
    }
    for (name, summary) in runs {
        let whose = if named { format!("{}: ", visible(name)) } else { String::new() };
        for note in notes(summary) {
            text += &format!("{whose}{}\n", visible(&note));
        }
    }
    text
}

/// Columns of the results as comma-separated values.
const CSV_HEADINGS: &str = "run,method,rms_nm,short_wave_rms_nm,rms_detilted_nm,pv_nm,total_time_s,\
    max_velocity_x_mm_per_s,max_velocity_y_mm_per_s,max_acceleration_x_mm_per_s2,max_acceleration_y_mm_per_s2,\
    limits_kept,plan,recommended\n";

/// Returns the results of one or several runs as comma-separated values for a spreadsheet, a row per valid method, with
/// all digits. Units end the names of the columns.
pub(crate) fn csv(runs: &[(&str, &Summary)]) -> String {
    let mut text = String::from(CSV_HEADINGS);
    for (run, summary) in runs {
        for (name, m) in &summary.methods {
            let [velocity_x, velocity_y] = m.max_velocity_mm_per_s;
            let [acceleration_x, acceleration_y] = m.max_acceleration_mm_per_s2;
            let cells = [
                text_cell(run),
                text_cell(name),
                m.rms_nm.to_string(),
                cell(m.short_wave_rms_nm),
                m.rms_detilted_nm.to_string(),
                m.pv_nm.to_string(),
                m.total_time_s.to_string(),
                velocity_x.to_string(),
                velocity_y.to_string(),
                acceleration_x.to_string(),
                acceleration_y.to_string(),
                m.limits_respected.to_string(),
                text_cell(&m.plan.word),
                summary.is_to_be_run(name).to_string(),
            ];
            text += &cells.map(|cell| quoted(&cell)).join(",");
            text.push('\n');
        }
    }
    text
}

/// Returns notes below the table, for which its columns have no room: the states of the plans, other remarks, and
/// methods that are left out. Methods with the same remark share a note.
fn notes(summary: &Summary) -> Vec<String> {
    let mut remarks: Vec<(String, Vec<&str>)> = Vec::new();
    for (name, method) in &summary.methods {
        let plan = format!("{}: {}", method.plan.word, method.plan.text);
        for text in std::iter::once(plan).chain(method.remarks.iter().cloned()) {
            match remarks.iter_mut().find(|(t, _)| *t == text) {
                Some((_, names)) => names.push(name),
                None => remarks.push((text, vec![name])),
            }
        }
    }
    let mut notes: Vec<String> =
        remarks.into_iter().map(|(text, names)| format!("{}: {text}", names.join(", "))).collect();
    for left in &summary.left_out {
        let standing = match left.standing {
            Standing::OutOfDate => "out of date, left out",
            Standing::Refused => "refused by its stage",
            Standing::NotValid | Standing::Valid => "not valid",
        };
        notes.push(format!("{}: {standing}: {}", left.name, left.reasons.join("; ")));
    }
    notes.extend(summary.remarks.iter().cloned());
    notes
}

/// Returns the text above the table: names of the run, RMS and PV of the desired removal, and the RMS of the dwell
/// times without a motion.
fn heading(name: &str, summary: &Summary) -> String {
    let title: Vec<&str> = [name, &summary.pipeline, &summary.fixture]
        .into_iter()
        .enumerate()
        // The name of a run is that of its pipeline unless the user gave another.
        .filter(|(i, word)| !(word.is_empty() || *i == 1 && *word == name))
        .map(|(_, word)| word)
        .collect();
    let mut text = format!(
        "{}: initial surface {} nm RMS, {} nm PV",
        visible(&title.join(", ")),
        fixed(summary.initial.rms_nm, 4),
        fixed(summary.initial.pv_nm, 2)
    );
    if let Some(still) = &summary.without_motion {
        text += &format!(
            "; dwell times without a motion leave {} nm RMS in {} s",
            fixed(still.rms_nm, 4),
            fixed(still.total_time_s, 2)
        );
    }
    text + "\n"
}

/// Returns the cells of the row of the method `scheduler`. `mark` stands in the last column.
fn cells(scheduler: &str, m: &MethodResult, mark: &str) -> [String; 15] {
    let wall = |s: Option<f64>| s.map_or("-".to_string(), |s| fixed(s, 3));
    [
        visible(scheduler).into_owned(),
        fixed(m.rms_nm, 4),
        m.short_wave_rms_nm.map_or("-".into(), |nm| fixed(nm, 4)),
        fixed(m.rms_detilted_nm, 4),
        fixed(m.pv_nm, 3),
        fixed(m.total_time_s, 2),
        fixed(m.total_time_s / 60.0, 3),
        pair(m.max_velocity_mm_per_s, 2),
        pair(m.max_acceleration_mm_per_s2, 1),
        pair(m.max_velocity_step_mm_per_s, 3),
        if m.limits_respected { "yes" } else { "no" }.to_string(),
        m.plan.word.clone(),
        wall(m.schedule_wall_s),
        wall(m.simulate_wall_s),
        mark.to_string(),
    ]
}

/// Returns the row of a method that is left out: a dash in place of each number, and `word` in the column of the
/// limits. `scheduler` is its name.
fn cells_left_out(scheduler: &str, word: &str) -> [String; 15] {
    std::array::from_fn(|column| match HEADINGS[column][1] {
        "method" => visible(scheduler).into_owned(),
        "kept" => word.into(),
        "best" => String::new(),
        _ => "-".into(),
    })
}

/// Headings of the columns of the table of executions, two lines each.
const EXECUTION_HEADINGS: [[&str; 2]; 8] = [
    ["", "method"],
    ["dwell error RMS", "ms"],
    ["worst", "ms"],
    ["overshoot x, y", "points"],
    ["largest x, y", "um"],
    ["a step x, y", "mm/s^2"],
    ["jerk in segments", "mm/s^3"],
    ["limits", "kept"],
];

/// Returns the table that says how the motions execute their plans, for one or several runs; it ends with a newline.
pub(crate) fn execution_table(runs: &[(&str, &Summary)]) -> String {
    let ms = |s: Option<f64>| s.map_or("-".into(), |s| fixed(1e3 * s, 4));
    let mut rows: Vec<Vec<String>> = vec![vec![String::new()], vec!["run".into()]];
    for (line, row) in rows.iter_mut().enumerate() {
        row.extend(EXECUTION_HEADINGS.iter().map(|h| h[line].to_string()));
    }
    for (name, summary) in runs {
        for (scheduler, m) in &summary.methods {
            let e = &m.execution;
            rows.push(vec![
                visible(name).into_owned(),
                visible(scheduler).into_owned(),
                ms(e.dwell_error_rms_s),
                ms(e.dwell_error_worst_s),
                format!("{}, {}", e.overshoot_points[0], e.overshoot_points[1]),
                pair(e.max_overshoot_mm.map(|mm| 1e3 * mm), 2),
                pair(m.max_acceleration_step_mm_per_s2, 1),
                pair(e.max_jerk_mm_per_s3, 0),
                if m.limits_respected { "yes" } else { "no" }.into(),
            ]);
        }
    }
    align(&rows, 2)
}

/// Returns the judged maps with the headings of their columns: before, the methods, measured after.
fn judged_columns(summary: &Summary) -> Vec<(&str, &SpecificationReport)> {
    let Around { before, after } = &summary.specification;
    let methods = summary.methods.iter();
    let methods = methods.filter_map(|(name, m)| Some((name.as_str(), m.specification.as_ref()?)));
    let before = before.iter().map(|judged| ("before", judged));
    let after = after.iter().map(|judged| ("measured after", judged));
    before.chain(methods).chain(after).collect()
}

/// Returns the table of the limits of the specification (rows) and the judged maps (columns), run by run. Exceeded
/// limits have a mark. Empty if nothing was judged.
pub(crate) fn specification_table(runs: &[(&str, &Summary)]) -> String {
    let mut text = String::new();
    for (name, summary) in runs {
        let columns = judged_columns(summary);
        let Some((_, first)) = columns.first() else { continue };
        let whose = if runs.len() > 1 { format!("{}: ", visible(name)) } else { String::new() };
        let heads = columns.iter().map(|(head, _)| visible(head).into_owned());
        let mut rows =
            vec![["specification".into(), "limit".into()].into_iter().chain(heads).collect()];
        for (i, limit) in first.limits.iter().enumerate() {
            let reports: Vec<Option<&LimitReport>> =
                columns.iter().map(|(_, judged)| judged.limits.get(i)).collect();
            let one = reports.iter().flatten().all(|l| l.limit == limit.limit);
            let sign = if limit.bound == Bound::AtMost { "<=" } else { ">=" };
            let bound = if one { significant(limit.limit, 4) } else { "line".into() };
            let unit =
                if limit.unit.is_empty() { String::new() } else { format!(" ({})", limit.unit) };
            let cells = reports.into_iter().map(|limit| match limit {
                Some(l) => {
                    let value =
                        if l.value.is_finite() { significant(l.value, 4) } else { "-".into() };
                    format!("{value}{}", if l.passed { " " } else { "!" })
                }
                None => "-".into(),
            });
            let row = [
                visible(&format!("{}{unit}", limit.quantity)).into_owned(),
                format!("{sign} {bound}"),
            ];
            rows.push(row.into_iter().chain(cells).collect());
        }
        let verdicts =
            columns.iter().map(|(_, j)| if j.passed { "kept " } else { "NOT KEPT " }.to_string());
        rows.push(
            [visible(&first.name).into_owned(), String::new()]
                .into_iter()
                .chain(verdicts)
                .collect(),
        );
        text += &format!("{whose}{}", align(&rows, 1));
    }
    text
}

/// Returns the numbers of x and y as the text of one cell, with this number of decimals.
fn pair([x, y]: [f64; 2], decimals: usize) -> String {
    format!("{}, {}", fixed(x, decimals), fixed(y, decimals))
}

/// Pads every column of `rows` to its widest cell. The first `left` columns are aligned left, the others right.
pub(crate) fn align(rows: &[Vec<String>], left: usize) -> String {
    let widths: Vec<usize> = (0..rows[0].len())
        .map(|c| rows.iter().map(|r| r[c].chars().count()).max().unwrap_or(0))
        .collect();
    let mut text = String::new();
    for row in rows {
        let mut padded = Vec::with_capacity(row.len());
        for (c, (cell, &w)) in row.iter().zip(&widths).enumerate() {
            padded.push(if c < left { format!("{cell:<w$}") } else { format!("{cell:>w$}") });
        }
        text += padded.join(GAP).trim_end();
        text.push('\n');
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        plan::{PlanStatus, State},
        summary::{Initial, LeftOut, WithoutMotion},
    };

    fn method(rms_nm: f64, limits_respected: bool) -> MethodResult {
        MethodResult {
            rms_nm,
            pv_nm: 1.25,
            rms_detilted_nm: 0.75 * rms_nm,
            slope_rms_nrad: [Some(200.0), None],
            short_wave_rms_nm: Some(0.5 * rms_nm),
            low_order: None,
            total_time_s: 90.0,
            max_velocity_mm_per_s: [12.5, 0.0],
            max_acceleration_mm_per_s2: [87.7, 53.2],
            max_velocity_step_mm_per_s: [0.0, 0.0],
            max_acceleration_step_mm_per_s2: [4.0, 4.0],
            limits_respected,
            broken_limits: vec![],
            after_servo_rms_nm: None,
            machine: None,
            schedule_wall_s: Some(0.1234),
            simulate_wall_s: None,
            execution: Default::default(),
            places: Default::default(),
            plan: PlanStatus {
                state: State::Certified,
                word: "certified".into(),
                text: "near".into(),
            },
            specification: None,
            on_axes: None,
            remarks: vec![],
        }
    }

    fn summary() -> Summary {
        Summary {
            error_budget: None,
            pipeline: "raster".into(),
            fixture: "coupon".into(),
            part: Default::default(),
            tool: None,
            initial: Initial {
                rms_nm: 6.3167,
                pv_nm: 37.0,
                slope_rms_nrad: [None; 2],
                short_wave_rms_nm: None,
                zone_rms: Default::default(),
                low_order: None,
            },
            slope_base_mm: [Some(1.0); 2],
            reach: None,
            division: crate::places::DivisionReport {
                edge_width_mm: None,
                edge_fraction: None,
                region_bounds_mm: [[0.0; 4]; 2],
                worst_apart_mm: 0.0,
            },
            specification: Default::default(),
            without_motion: Some(WithoutMotion { rms_nm: 0.1, total_time_s: 88.0 }),
            bound: None,
            methods: vec![
                ("position".into(), method(0.1, false)),
                ("pvt".into(), method(0.2, true)),
            ],
            left_out: vec![],
            remarks: vec![],
            best: Some("pvt".into()),
            several: None,
        }
    }

    #[test]
    fn one_run() {
        // The words, in the order of the columns; how they are aligned is checked below.
        let expected = "raster, coupon: initial surface 6.3167 nm RMS, 37.00 nm PV; \
            dwell times without a motion leave 0.1000 nm RMS in 88.00 s \
            RMS short waves detilted PV time max v x, y max a x, y v step x, y limits schedule simulate \
            method nm nm nm nm s min mm/s mm/s^2 mm/s kept plan s s best \
            position 0.1000 0.0500 0.0750 1.250 90.00 1.500 12.50, 0.00 87.7, 53.2 0.000, 0.000 no \
            certified 0.123 - \
            pvt 0.2000 0.1000 0.1500 1.250 90.00 1.500 12.50, 0.00 87.7, 53.2 0.000, 0.000 yes \
            certified 0.123 - * \
            * recommended: within 5 % of the smallest RMS of those that keep the limits, and its time is worth it \
            position, pvt: certified: near";
        let found = table(&summary());
        let words = |t: &str| t.split_whitespace().map(String::from).collect::<Vec<_>>();
        assert_eq!(words(&found), words(expected));
        let lines: Vec<&str> = found.lines().filter(|l| l.contains("0.123")).collect();
        assert_eq!(lines[0].find("87.7"), lines[1].find("87.7"));
        assert!(found.lines().all(|l| l == l.trim_end()));
    }

    #[test]
    fn a_spreadsheet_has_a_row_per_method_and_run() {
        let text = csv(&[("a, b", &summary()), ("=1", &summary())]);
        let rows: Vec<&str> = text.lines().collect();
        assert_eq!(rows.len(), 1 + 2 * 2);
        let row =
            "\"a, b\",pvt,0.2,0.1,0.15000000000000002,1.25,90,12.5,0,87.7,53.2,true,certified,true";
        assert_eq!(rows[2], row);
        assert!(rows[3].starts_with("'=1,position,0.1,"), "no formula: {text}");
        assert_eq!(
            rows[0].split(',').count(),
            row.split(',').count() - 1,
            "one comma is in quotes"
        );
    }

    #[test]
    fn limits_are_rows_and_what_was_judged_columns() {
        assert_eq!(specification_table(&[("run", &summary())]), "");
        let limit = |value: f64, limit: f64, passed| LimitReport {
            quantity: "PSD along x".into(),
            unit: "nm^2 mm".into(),
            value,
            limit,
            bound: Bound::AtMost,
            passed,
            worst: None,
            noise: None,
        };
        let judged = |limits: Vec<LimitReport>| SpecificationReport {
            name: "strict".into(),
            passed: limits.iter().all(|l| l.passed),
            limits,
        };
        let mut summary = summary();
        summary.specification.before =
            Some(judged(vec![limit(3.0, 1.0, false), limit(f64::INFINITY, 2.0, true)]));
        summary.methods[1].1.specification =
            Some(judged(vec![limit(0.5, 1.5, true), limit(1.0, 2.0, true)]));
        let found = specification_table(&[("run", &summary)]);
        let words: Vec<Vec<&str>> = found.lines().map(|l| l.split_whitespace().collect()).collect();
        assert_eq!(words[0], ["specification", "limit", "before", "pvt"]);
        // A line under a spectrum has another limit where the spectrum is worst.
        assert_eq!(words[1][5..], ["<=", "line", "3!", "0.5"]);
        assert_eq!(words[2][5..], ["<=", "2", "-", "1"]);
        assert_eq!(words[3], ["strict", "NOT", "KEPT", "kept"]);
    }

    #[test]
    fn several_runs_have_their_name_before_the_method() {
        let second = Summary {
            without_motion: None,
            methods: vec![("pvt".into(), method(0.05, false))],
            best: None,
            ..summary()
        };
        let text = table_of_runs(&[("a", &summary()), ("long-name", &second)]);
        assert!(text.contains("long-name, raster, coupon: initial"));
        assert!(
            text.contains(
                "long-name, raster, coupon: initial surface 6.3167 nm RMS, 37.00 nm PV\n"
            )
        );
        let row = |start: &str| {
            let line = text.lines().find(|l| l.starts_with(start)).unwrap();
            line.split_whitespace().map(String::from).collect::<Vec<_>>()
        };
        assert_eq!(row("run ")[1], "method");
        // The best of each run: none in the second, though its RMS is the smallest.
        assert_eq!(row("a          pvt").last().unwrap(), "*");
        assert_eq!(row("long-name  pvt").last().unwrap(), "-");
    }

    #[test]
    fn no_method_keeps_the_limits() {
        let methods = vec![("pvt".into(), method(0.1, false))];
        let only = Summary { methods, best: None, ..summary() };
        assert!(table(&only).contains("no method keeps the limits"));
    }

    #[test]
    fn what_is_left_out_has_no_numbers_and_its_reason() {
        let left = |name: &str, standing, reason: &str| LeftOut {
            name: name.into(),
            standing,
            reasons: vec![reason.into()],
        };
        let mut summary = summary();
        summary.left_out = vec![
            left("pvt\u{1b}[31m", Standing::NotValid, "its verdict is of another trajectory"),
            left("old", Standing::OutOfDate, "other dwell times"),
        ];
        let text = table(&summary);
        let row = text.lines().find(|l| l.starts_with(r"pvt\u{1b}[31m ")).unwrap();
        assert!(!row.contains(|c: char| c.is_ascii_digit() && c != '1' && c != '3'), "{row}");
        assert!(row.contains("not valid") && !text.contains('\u{1b}'));
        assert!(text.contains("not valid: its verdict is of another trajectory\n"));
        assert!(text.contains("old: out of date, left out: other dwell times\n"));
        assert!(!text.lines().any(|l| l.starts_with("old ")), "{text}");
    }
}
