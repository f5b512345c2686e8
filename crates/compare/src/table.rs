//! The summary of one or several runs as a plain aligned table.

use crate::summary::{Method, Summary};

/// Columns: two lines of heading; the first column is aligned left, the others right.
const HEADINGS: [[&str; 2]; 13] = [
    ["", "method"],
    ["RMS", "nm"],
    ["detilted", "nm"],
    ["PV", "nm"],
    ["time", "s"],
    ["", "min"],
    ["max v x, y", "mm/s"],
    ["max a x, y", "mm/s^2"],
    ["v step x, y", "mm/s"],
    ["limits", "kept"],
    ["schedule", "s"],
    ["simulate", "s"],
    ["", "best"],
];

/// Spaces between columns.
const GAP: &str = "  ";

/// The table of one run; ends with a newline.
pub fn table(summary: &Summary) -> String {
    render(&[("", summary)])
}

/// One table of several runs, each with its name; ends with a newline.
pub fn table_of_runs(runs: &[(&str, &Summary)]) -> String {
    render(runs)
}

fn render(runs: &[(&str, &Summary)]) -> String {
    let named = runs.iter().any(|(name, _)| !name.is_empty());
    let mut text = String::new();
    for (name, summary) in runs {
        text += &heading(name, summary);
    }
    text.push('\n');

    let prefix = |cell: &str| named.then(|| cell.to_string());
    let mut rows: Vec<Vec<String>> = (0..2)
        .map(|line| {
            let first = prefix(["", "run"][line]);
            first.into_iter().chain(HEADINGS.iter().map(|h| h[line].to_string())).collect()
        })
        .collect();
    for (name, summary) in runs {
        let best = summary.best();
        for (scheduler, method) in &summary.methods {
            let mark = if best == Some(scheduler) { "*" } else { "" };
            rows.push(prefix(name).into_iter().chain(cells(scheduler, method, mark)).collect());
        }
    }
    text += &align(&rows, if named { 2 } else { 1 });
    if runs.iter().any(|(_, summary)| summary.best().is_some()) {
        text += "\n* smallest RMS among the methods that keep the limits of the machine\n";
    } else if runs.iter().any(|(_, summary)| !summary.methods.is_empty()) {
        text += "\nno method keeps the limits of the machine\n";
    }
    text
}

/// Two lines: the desired removal, and what the dwell times alone would leave.
fn heading(name: &str, summary: &Summary) -> String {
    let title: Vec<&str> = [name, &summary.pipeline, &summary.fixture]
        .into_iter()
        .enumerate()
        // The name of a run is that of its pipeline unless the user gave another.
        .filter(|(i, part)| !(part.is_empty() || *i == 1 && *part == name))
        .map(|(_, part)| part)
        .collect();
    let mut text = format!(
        "{}: initial surface {:.4} nm RMS, {:.2} nm PV",
        title.join(", "),
        summary.initial.rms_nm,
        summary.initial.pv_nm
    );
    match &summary.ideal {
        Some(ideal) => {
            text += &format!(
                "; ideal (dwell at the dwell points) {:.4} nm RMS in {:.2} s\n",
                ideal.rms_nm, ideal.total_time_s
            );
        }
        None => text += "; no ideal (no method 'position')\n",
    }
    text
}

fn cells(scheduler: &str, m: &Method, mark: &str) -> [String; 13] {
    let pair = |[x, y]: [f64; 2], decimals: usize| format!("{x:.decimals$}, {y:.decimals$}");
    let wall = |s: Option<f64>| s.map_or("-".to_string(), |s| format!("{s:.3}"));
    [
        scheduler.to_string(),
        format!("{:.4}", m.rms_nm),
        format!("{:.4}", m.rms_detilted_nm),
        format!("{:.3}", m.pv_nm),
        format!("{:.2}", m.total_time_s),
        format!("{:.3}", m.total_time_s / 60.0),
        pair(m.max_velocity_mm_per_s, 2),
        pair(m.max_acceleration_mm_per_s2, 1),
        pair(m.max_velocity_step_mm_per_s, 3),
        if m.limits_respected { "yes" } else { "no" }.to_string(),
        wall(m.schedule_wall_s),
        wall(m.simulate_wall_s),
        mark.to_string(),
    ]
}

/// Pads every column to its widest cell; the first `left` columns are aligned left.
pub(crate) fn align(rows: &[Vec<String>], left: usize) -> String {
    let width = |c: usize| rows.iter().map(|r| r[c].chars().count()).max().unwrap_or(0);
    let widths: Vec<usize> = (0..rows[0].len()).map(width).collect();
    let mut text = String::new();
    for row in rows {
        let padded: Vec<String> = row
            .iter()
            .zip(&widths)
            .enumerate()
            .map(
                |(c, (cell, &w))| {
                    if c < left { format!("{cell:<w$}") } else { format!("{cell:>w$}") }
                },
            )
            .collect();
        text += padded.join(GAP).trim_end();
        text.push('\n');
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::summary::{Ideal, Initial};

    fn method(rms_nm: f64, limits_respected: bool) -> Method {
        Method {
            rms_nm,
            pv_nm: 1.25,
            rms_detilted_nm: 0.75 * rms_nm,
            total_time_s: 90.0,
            max_velocity_mm_per_s: [12.5, 0.0],
            max_acceleration_mm_per_s2: [87.7, 53.2],
            max_velocity_step_mm_per_s: [0.0, 0.0],
            max_acceleration_step_mm_per_s2: [4.0, 4.0],
            limits_respected,
            schedule_wall_s: Some(0.1234),
            simulate_wall_s: None,
            execution: Default::default(),
        }
    }

    fn summary() -> Summary {
        Summary {
            pipeline: "raster".into(),
            fixture: "coupon".into(),
            initial: Initial { rms_nm: 6.3167, pv_nm: 37.0 },
            ideal: Some(Ideal { rms_nm: 0.1, total_time_s: 88.0 }),
            methods: vec![
                ("position".into(), method(0.1, false)),
                ("pvt".into(), method(0.2, true)),
            ],
        }
    }

    #[test]
    fn one_run() {
        // The words, in the order of the columns; how they are aligned is checked below.
        let expected = "raster, coupon: initial surface 6.3167 nm RMS, 37.00 nm PV; \
            ideal (dwell at the dwell points) 0.1000 nm RMS in 88.00 s \
            RMS detilted PV time max v x, y max a x, y v step x, y limits schedule simulate \
            method nm nm nm s min mm/s mm/s^2 mm/s kept s s best \
            position 0.1000 0.0750 1.250 90.00 1.500 12.50, 0.00 87.7, 53.2 0.000, 0.000 no \
            0.123 - \
            pvt 0.2000 0.1500 1.250 90.00 1.500 12.50, 0.00 87.7, 53.2 0.000, 0.000 yes \
            0.123 - * \
            * smallest RMS among the methods that keep the limits of the machine";
        let found = table(&summary());
        let words = |t: &str| t.split_whitespace().map(String::from).collect::<Vec<_>>();
        assert_eq!(words(&found), words(expected));
        let lines: Vec<&str> = found.lines().filter(|l| l.contains("0.123")).collect();
        assert_eq!(lines[0].find("87.7"), lines[1].find("87.7"));
        assert!(found.lines().all(|l| l == l.trim_end()));
    }

    #[test]
    fn several_runs_have_their_name_before_the_method() {
        let second = Summary {
            ideal: None,
            methods: vec![("pvt".into(), method(0.05, false))],
            ..summary()
        };
        let text = table_of_runs(&[("a", &summary()), ("long-name", &second)]);
        assert!(text.contains("long-name, raster, coupon: initial"));
        assert!(text.contains("no ideal"));
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
        let only = Summary { methods: vec![("pvt".into(), method(0.1, false))], ..summary() };
        assert!(table(&only).contains("no method keeps the limits"));
    }
}
