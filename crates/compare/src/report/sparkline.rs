//! Small plots of block characters for a terminal.

use planish_types::text::{fixed, visible};

use super::{map::Histogram, motion::Ranges, view::View};

const BLOCKS: [char; 8] = ['▁', '▂', '▃', '▄', '▅', '▆', '▇', '█'];

/// Width of a plot, characters. Larger: rows that do not fit into a terminal. Smaller: coarser plots. Chosen.
const WIDTH: usize = 48;

/// Returns one block character per value, whose height runs from 0 to the largest value; a blank for a value that is
/// not finite.
fn sparkline(values: &[f64]) -> String {
    let top = values.iter().copied().filter(|v| v.is_finite()).fold(0.0, f64::max);
    let mut text = String::new();
    for v in values {
        text.push(if !v.is_finite() {
            ' '
        } else if top > 0.0 {
            BLOCKS[((v / top * 8.0) as usize).min(7)]
        } else {
            BLOCKS[0]
        });
    }
    text
}

/// Returns small plots as text, method by method: histograms of the heights before and after, and the speed over the
/// run.
pub fn plots(views: &[View]) -> String {
    let mut rows: Vec<[String; 3]> = Vec::new();
    for view in views {
        let name = |method: &str| match views.len() {
            1 => visible(method).into_owned(),
            _ => visible(&format!("{} {method}", view.name)).into_owned(),
        };
        rows.push([name("before"), heights(&view.before.0), caption(&view.before.0)]);
        for m in &view.methods {
            rows.push([name(&m.name), heights(&m.after.0), caption(&m.after.0)]);
            let (speed, top) = speed(&m.ranges);
            rows.push([String::new(), speed, format!("speed over time, at most {top:.2} mm/s")]);
            if let Some(rounds) = m.rounds.as_ref().filter(|r| !r.rms_nm.is_empty()) {
                let first = rounds.rms_nm[0];
                let text = format!("RMS in {} rounds, from {first:.4} nm", rounds.rms_nm.len() - 1);
                rows.push([String::new(), sparkline(&rounds.rms_nm), text]);
            }
        }
    }
    let widest = rows.iter().map(|r| r[0].chars().count()).max().unwrap_or(0);
    rows.iter()
        .map(|[name, plot, text]| format!("{name:<widest$}  {plot:<WIDTH$}  {text}\n"))
        .collect()
}

/// Returns the caption of a histogram: the range of its heights.
fn caption(h: &Histogram) -> String {
    let [low, high] = [h.low_nm, -h.low_nm].map(|nm| fixed(nm, 3));
    format!("heights, {low} to {high} nm about the mean")
}

/// Plots a histogram in [`WIDTH`] characters, each the mean of some bins.
fn heights(h: &Histogram) -> String {
    let n = h.density_per_nm.len();
    let mut means = Vec::with_capacity(WIDTH);
    for i in 0..WIDTH {
        let bins = &h.density_per_nm[i * n / WIDTH..((i + 1) * n / WIDTH).max(i * n / WIDTH + 1)];
        means.push(bins.iter().sum::<f64>() / bins.len() as f64);
    }
    sparkline(&means)
}

/// Plots the largest speed in columns of equal duration, from the ranges of both axes. Also returns the largest of
/// all, mm/s.
fn speed(ranges: &Ranges) -> (String, f64) {
    let total = ranges.end_s.last().copied().unwrap_or(1.0);
    let column = |t: f64| ((t / total * WIDTH as f64) as usize).min(WIDTH - 1);
    let mut largest = vec![0.0_f64; WIDTH];
    let mut start = 0.0;
    for (i, end) in ranges.end_s.iter().enumerate() {
        let [x, y] = ranges.envelope[0].each_ref().map(|e| e.low[i].abs().max(e.high[i].abs()));
        for c in &mut largest[column(start)..=column(*end)] {
            *c = c.max(x.hypot(y));
        }
        start = *end;
    }
    let top = largest.iter().copied().fold(0.0, f64::max);
    (sparkline(&largest), top)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn blocks_grow_with_the_value() {
        assert_eq!(sparkline(&[0.0, 1.0, 4.0, 7.99, 8.0]), "▁▂▅██");
        assert_eq!(sparkline(&[0.0, f64::NAN, 0.0]), "▁ ▁");
        assert_eq!(sparkline(&[]), "");
    }
}
