//! Residual against total time: refinements at rising prices of a second, and their picture.
//!
//! What no plan can go below is the volume to be removed over the volumetric removal rate,
//!
//! ```text
//! T >= sum_i (z_i - z_min) dA / VRR                                                      (1)
//! ```
//!
//! with the tool never beyond the edge. z_min is the height that [`IGNORED`] of the pixels are
//! below: a pit of a few pixels would ask for a layer of its depth all over the part.

use std::fmt::Write;

use planish_types::{End, Limits, Surface, Tif, ToolPath};

use crate::{Iterate, RefineError, Settings, refine};

/// Part of the pixels that z_min leaves below.
pub const IGNORED: f64 = 1e-3;

/// One price.
#[derive(Clone, Debug, PartialEq)]
pub struct Point {
    /// Price of a second, nm^2/s.
    pub time_weight_nm2_per_s: f64,
    /// The best round of its refinement.
    pub best: Iterate,
    /// Why its refinement ended.
    pub end: End,
}

/// (1), s.
pub fn least_time_s(desired: &Surface, tif: &Tif) -> f64 {
    let mut z: Vec<f64> = desired.height_nm().iter().copied().filter(|z| !z.is_nan()).collect();
    z.sort_by(f64::total_cmp);
    let low = z[((z.len() - 1) as f64 * IGNORED).round() as usize];
    let volume: f64 =
        z.iter().map(|z| (z - low).max(0.0)).sum::<f64>() * desired.grid().pixel_mm2();
    volume / tif.vrr_nm_mm2_per_s()
}

/// Prices from nothing to 3 % of what the whole correction gains per second of (1), in `count`
/// steps of equal ratio over three and a half decades.
pub fn prices(desired: &Surface, tif: &Tif, count: usize) -> Vec<f64> {
    let rms = desired.statistics().rms;
    let whole = 0.5 * rms * rms / least_time_s(desired, tif).max(f64::MIN_POSITIVE);
    let exponent = |k: usize| -5.0 + 3.5 * k as f64 / (count.max(2) - 1) as f64;
    std::iter::once(0.0).chain((0..count).map(|k| whole * 10_f64.powf(exponent(k)))).collect()
}

/// A refinement per price, each from the dwell times of the one before.
pub fn trade_off(
    desired: &Surface,
    tif: &Tif,
    path: &ToolPath,
    limits: &Limits,
    prices: &[f64],
    settings: &Settings,
) -> Result<Vec<Point>, RefineError> {
    let mut points: Vec<Point> = Vec::new();
    let mut first = None;
    for &price in prices {
        let mut settings = *settings;
        settings.dwell.time_weight_nm2_per_s = price;
        if first.is_none() {
            // What the other prices begin with.
            settings.max_rounds = settings.max_rounds.max(Settings::default().max_rounds);
        }
        let mut refined = refine(desired, tif, path, limits, first, &settings)?;
        first = Some(refined.dwell);
        let best = refined.iterates.swap_remove(refined.best);
        points.push(Point { time_weight_nm2_per_s: price, best, end: refined.end });
    }
    Ok(points)
}

const WIDTH: f64 = 720.0;
const HEIGHT: f64 = 440.0;
/// Left, top, right, bottom.
const MARGIN: [f64; 4] = [80.0, 40.0, 30.0, 60.0];

/// The curve as SVG text: total time to the right, residual upwards (logarithmic), the bound (1)
/// dashed.
pub fn svg(points: &[Point], least_time_s: f64) -> String {
    let times = points.iter().map(|p| p.best.total_time_s);
    let end = 1.08 * times.fold(least_time_s, f64::max);
    let rms = || points.iter().map(|p| p.best.rms_nm.max(1e-12).log10());
    let (low, high) = (rms().fold(f64::MAX, f64::min), rms().fold(f64::MIN, f64::max));
    let (low, high) = (low - 0.1, high + 0.1);
    let [left, top, right, bottom] = MARGIN;
    let x = |t: f64| left + (WIDTH - left - right) * t / end;
    let y = |r: f64| HEIGHT - bottom - (HEIGHT - top - bottom) * (r - low) / (high - low);

    let mut out = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH} {HEIGHT}\" \
         font-family=\"sans-serif\" font-size=\"14\">\n\
         <rect width=\"{WIDTH}\" height=\"{HEIGHT}\" fill=\"white\"/>\n"
    );
    let mut line = |x1: f64, y1: f64, x2: f64, y2: f64, style: &str| {
        let _ = writeln!(
            out,
            "<line x1=\"{x1:.1}\" y1=\"{y1:.1}\" x2=\"{x2:.1}\" y2=\"{y2:.1}\" {style}/>"
        );
    };
    let (axis_y, grey) = (HEIGHT - bottom, "stroke=\"#dddddd\"");
    let step = nice_step(end / 6.0);
    let time_ticks: Vec<f64> =
        (0..).map(|k: u32| f64::from(k) * step).take_while(|t| *t <= end).collect();
    let rms_ticks: Vec<f64> = (-6..6)
        .flat_map(|d| [1.0, 1.5, 2.0, 3.0, 5.0, 7.0].map(|m| m * 10_f64.powi(d)))
        .filter(|r| (low..=high).contains(&r.log10()))
        .collect();
    for t in &time_ticks {
        line(x(*t), top, x(*t), axis_y, grey);
    }
    for r in &rms_ticks {
        line(left, y(r.log10()), WIDTH - right, y(r.log10()), grey);
    }
    line(left, axis_y, WIDTH - right, axis_y, "stroke=\"black\"");
    line(left, top, left, axis_y, "stroke=\"black\"");
    let bound = "stroke=\"#d8a010\" stroke-width=\"2\" stroke-dasharray=\"6 4\"";
    line(x(least_time_s), top, x(least_time_s), axis_y, bound);
    let mut text = |x: f64, y: f64, anchor: &str, what: &str| {
        let _ =
            writeln!(out, "<text x=\"{x:.1}\" y=\"{y:.1}\" text-anchor=\"{anchor}\">{what}</text>");
    };
    for t in &time_ticks {
        text(x(*t), axis_y + 20.0, "middle", &format!("{t}"));
    }
    for r in &rms_ticks {
        text(left - 8.0, y(r.log10()) + 5.0, "end", &format!("{}", (r * 1e7).round() / 1e7));
    }
    text(0.5 * (left + WIDTH - right), HEIGHT - 15.0, "middle", "total time, s");
    text(left - 60.0, top - 15.0, "start", "executed residual RMS, nm");
    let label = format!("volume / VRR = {least_time_s:.1} s");
    text(x(least_time_s) + 8.0, top + 16.0, "start", &label);
    let curve: Vec<String> = points
        .iter()
        .map(|p| {
            format!("{:.1},{:.1}", x(p.best.total_time_s), y(p.best.rms_nm.max(1e-12).log10()))
        })
        .collect();
    let _ = writeln!(
        out,
        "<polyline points=\"{}\" fill=\"none\" stroke=\"#365c8d\" stroke-width=\"2\"/>",
        curve.join(" ")
    );
    for c in &curve {
        let (cx, cy) = c.split_once(',').expect("written above");
        let _ = writeln!(out, "<circle cx=\"{cx}\" cy=\"{cy}\" r=\"4\" fill=\"#365c8d\"/>");
    }
    out.push_str("</svg>\n");
    out
}

/// 1, 2 or 5 times a power of ten, at least `least`.
fn nice_step(least: f64) -> f64 {
    let decade = 10_f64.powf(least.max(f64::MIN_POSITIVE).log10().floor());
    [1.0, 2.0, 5.0, 10.0].into_iter().map(|m| m * decade).find(|s| *s >= least).unwrap_or(decade)
}
