//! Picture of the motion of all axes of a machine: every axis against its limits, and the form of the part.

use ndarray::Array2;
use planish_draw::{
    Bands, Frame, Scale, Svg,
    colour::{LINES, VIRIDIS_FOR_LINES},
    frame::range,
    svg::put,
};
use planish_form::Form;
use planish_numerics::polynomial;
use planish_types::{AxesMotion, Surface, text::significant};
use serde_json::Value;

use crate::on_axes::MotionOutcome;

/// Height of the texts, px of the picture.
const FONT_PX: f64 = 14.0;

/// Width and height of a panel, px. Larger: the four panels of an axis are wider than a page. Smaller: peaks of a long run
/// fall together.
const PANEL_PX: [f64; 2] = [230.0, 110.0];

/// Left, top, right and bottom of a panel, px. Larger: empty space. Smaller: numbers are cut off.
const MARGIN_PX: [f64; 4] = [78.0, 30.0, 14.0, 50.0];

/// Number of columns of a panel, each with the smallest and the largest value in its time. Larger: larger pages. Smaller:
/// coarser peaks.
const COLUMNS: usize = 230;

/// Limit over the largest value of a quantity above which the limit is named and not drawn. Larger: the motion is a flat
/// line. Smaller: limits that the motion comes near are not drawn.
const FAR: f64 = 4.0;

/// Largest number of cells of the map of the form along an axis. Larger: finer details and a larger page. Smaller: a
/// coarser picture.
const MOST_CELLS: usize = 60;

/// Number of colours of the map of the form. Larger: smoother colours and a larger page. Smaller: visible steps.
const BANDS: usize = 32;

/// Keys of the checks of an axis in a verdict, from the position to the jerk, and their names and units over the unit of
/// the axis.
const QUANTITIES: [(&str, &str, &str); 4] = [
    ("position", "position", ""),
    ("velocity", "velocity", "/s"),
    ("acceleration", "acceleration", "/s²"),
    ("jerk", "jerk", "/s³"),
];

/// The picture, as SVG: position, velocity, acceleration and jerk of every axis over the time, with their limits in the
/// verdict; below, the form of the part where it is known.
pub fn picture(
    outcome: &MotionOutcome,
    motion: &AxesMotion,
    verdict: &Value,
    part: Option<(&Form, &Surface)>,
) -> String {
    let mut svg = Svg::new(FONT_PX);
    let [left, top, right, bottom] = MARGIN_PX;
    let cell = [PANEL_PX[0] + left + right, PANEL_PX[1] + top + bottom];
    for (axis, (name, unit)) in outcome.axes.iter().zip(&outcome.units).enumerate() {
        for (order, (_, quantity, per)) in QUANTITIES.iter().enumerate() {
            let corner = [order as f64 * cell[0], axis as f64 * cell[1]];
            let titles = [format!("{name}, {quantity}"), format!("{unit}{per}")];
            let bounds = bounds(verdict, axis, order);
            panel(&mut svg, corner, titles, &envelope(motion, axis, order), &bounds, order == 0);
        }
    }
    let mut height = outcome.axes.len() as f64 * cell[1];
    if let Some((form, surface)) = part {
        height += form_map(&mut svg, [0.0, height], form, surface);
    }
    svg.finish([QUANTITIES.len() as f64 * cell[0], height])
}

/// Ranges of a quantity of an axis over equal times: (middle of the time, s; smallest and largest value).
type Columns = Vec<(f64, f64, f64)>;

/// Ranges of the derivative of this order of an axis: exact for every cubic piece, and those of a column are of all pieces
/// that reach into its time.
fn envelope(motion: &AxesMotion, axis: usize, order: usize) -> Columns {
    let (start_s, total_s) = (motion.break_time_s()[0], motion.total_time_s());
    let column =
        |time_s: f64| (((time_s - start_s) / total_s * COLUMNS as f64) as usize).min(COLUMNS - 1);
    let mut found = vec![(f64::INFINITY, f64::NEG_INFINITY); COLUMNS];
    for i in 0..motion.len() {
        let mut cubic = motion.segment(i)[axis];
        for _ in 0..order {
            cubic = polynomial::derivative(&cubic);
        }
        let reached = polynomial::range(&cubic, motion.duration_s(i));
        let [first, last] = [0, 1].map(|k| column(motion.break_time_s()[i + k]));
        for (low, high) in &mut found[first..=last] {
            (*low, *high) = (low.min(reached.min), high.max(reached.max));
        }
    }
    let middle = |k: usize| total_s * (k as f64 + 0.5) / COLUMNS as f64;
    found.iter().enumerate().map(|(k, (low, high))| (middle(k), *low, *high)).collect()
}

/// Limits of a quantity of an axis in a verdict: the travel of the position, and plus and minus the limit of the others.
/// Empty where the machine states none.
fn bounds(verdict: &Value, axis: usize, order: usize) -> Vec<f64> {
    let axis = &verdict["axes"][axis];
    match order {
        0 => axis["travel"].as_array().into_iter().flatten().filter_map(Value::as_f64).collect(),
        _ => {
            let limit = axis[QUANTITIES[order].0]["limit"].as_f64();
            limit.into_iter().flat_map(|l| [-l, l]).collect()
        }
    }
}

/// Draws one quantity of one axis; the titles are its name and its unit. The bounds of a position are its travel.
fn panel(
    svg: &mut Svg,
    corner: [f64; 2],
    [title, unit]: [String; 2],
    columns: &Columns,
    bounds: &[f64],
    is_position: bool,
) {
    let [low, high] = range(columns.iter().flat_map(|c| [c.1, c.2]));
    let reach = low.abs().max(high.abs());
    let near: Vec<f64> = bounds.iter().copied().filter(|b| b.abs() <= FAR * reach).collect();
    let [low, high] = range(near.iter().copied().chain([low, high]));
    // A quantity that stands still has no range.
    let rim = if high > low { 0.06 * (high - low) } else { 0.5 };
    let end = columns.last().map_or(1.0, |c| c.0);
    let scales = [Scale::linear([0.0, end]), Scale::linear([low - rim, high + rim])];
    let frame = Frame::new(corner, PANEL_PX, MARGIN_PX, scales);
    let mut d = String::new();
    for (time, low, high) in columns {
        let [x, bottom] = frame.at([*time, *low]);
        let top = frame.at([*time, *high])[1];
        put(&mut d, format_args!("M{x:.1} {bottom:.1}V{:.1}", top.min(bottom - 0.8)));
    }
    svg.path(&format!("fill=\"none\" stroke=\"{}\" stroke-width=\"1.2\"", LINES[0]), &d);
    for bound in &near {
        let y = frame.at([0.0, *bound])[1];
        let across = format!("M{:.1} {y:.1}H{:.1}", frame.left, frame.right());
        svg.path(&format!("stroke=\"{}\" stroke-dasharray=\"7 4\"", LINES[1]), &across);
    }
    frame.axes(svg, ["time (s)", &unit]);
    let note = match bounds {
        [low, high] if near.len() < 2 && is_position => {
            format!(", travel {} to {}", significant(*low, 4), significant(*high, 4))
        }
        [_, limit] if near.len() < 2 => format!(", limit {}", significant(*limit, 4)),
        _ => String::new(),
    };
    frame.title(svg, &format!("{title}{note}"));
}

/// Draws the height of the form on the valid pixels of the part; returns the height of the drawing, px.
fn form_map(svg: &mut Svg, corner: [f64; 2], form: &Form, surface: &Surface) -> f64 {
    let grid = surface.grid();
    let every = grid.x.len().max(grid.y.len()).div_ceil(MOST_CELLS);
    let shape = (grid.y.len().div_ceil(every), grid.x.len().div_ceil(every));
    let heights = Array2::from_shape_fn(shape, |(r, c)| {
        let pixel = [
            (r * every + every / 2).min(grid.y.len() - 1),
            (c * every + every / 2).min(grid.x.len() - 1),
        ];
        let valid = !surface.height_nm()[pixel].is_nan();
        let height = form.sag_mm([grid.x.at(pixel[1]), grid.y.at(pixel[0])]);
        height.filter(|_| valid).unwrap_or(f64::NAN)
    });
    let sides = [&grid.x, &grid.y].map(|a| a.len() as f64 * a.step_mm());
    let size = [380.0, 380.0 * (sides[1] / sides[0]).clamp(0.15, 2.0)];
    let margin = [MARGIN_PX[0], MARGIN_PX[1], 96.0, 56.0];
    let scales = [grid.x.edges_mm(), grid.y.edges_mm()].map(Scale::linear);
    let frame = Frame::new(corner, size, margin, scales);
    let bands = Bands::new(&VIRIDIS_FOR_LINES, BANDS, range(heights.iter().copied()));
    planish_draw::cells::draw(svg, &frame, heights.view(), &bands, MOST_CELLS);
    frame.axes(svg, ["x (mm)", "y (mm)"]);
    frame.colour_bar(svg, &bands, "mm");
    frame.title(svg, "height of the form");
    size[1] + margin[1] + margin[3]
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    /// Two seconds of an axis that turns back, x = 2 t - t^2, and of one that stands at 7.
    fn motion() -> AxesMotion {
        let cubics = vec![[0.0, 2.0, -1.0, 0.0], [7.0, 0.0, 0.0, 0.0]];
        AxesMotion::new(vec![5.0, 7.0], cubics, vec![true], vec![None]).unwrap()
    }

    #[test]
    fn ranges_are_exact_between_the_nodes() {
        // The largest position, 1 at t = 1, is at no node.
        let found = envelope(&motion(), 0, 0);
        assert_eq!(range(found.iter().flat_map(|c| [c.1, c.2])), [0.0, 1.0]);
        let velocity = envelope(&motion(), 0, 1);
        assert_eq!(range(velocity.iter().flat_map(|c| [c.1, c.2])), [-2.0, 2.0]);
        assert!(envelope(&motion(), 1, 0).iter().all(|c| (c.1, c.2) == (7.0, 7.0)));
    }

    #[test]
    fn a_picture_names_every_axis_and_limit() {
        let outcome = MotionOutcome::from_json(
            &json!({ "axes": ["x", "b"], "units": ["mm", "deg"], "contact_deviation_um": 1.0, "gap_um": 0.0,
                "added_tool_on_time_s": 0.0 }),
            2,
        )
        .unwrap();
        let axis = json!({ "travel": [-100.0, 100.0], "velocity": { "limit": 3.0 },
            "acceleration": { "limit": 1000.0 }, "jerk": { "limit": null } });
        let svg = picture(&outcome, &motion(), &json!({ "axes": [axis, axis] }), None);
        for words in
            ["x, position, travel -100", "b, velocity", "x, acceleration, limit 1000", "deg/s"]
        {
            assert!(svg.contains(words), "{words} is missing");
        }
        assert!(MotionOutcome::from_json(&json!({ "axes": ["x"] }), 2).is_err());
    }
}
