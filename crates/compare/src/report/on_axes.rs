//! Picture of the motion of all axes of a machine: every axis with its limits, and the form of the part.

use planish_draw::{
    Frame, Scale, Svg,
    colour::{LINES, VIRIDIS_FOR_LINES},
    frame::range,
    svg::put,
};
use planish_form::Form;
use planish_numerics::polynomial;
use planish_types::{
    AxesMotion, Surface,
    outcome::{
        axes::MotionReport,
        verdict::{AxesVerdict, MachineAxisVerdict},
    },
    text::significant,
};

use super::{
    motion::Envelope,
    part::{self, FONT_PX, Look, RIGHT_BOTTOM_PX},
};

/// Width and height of a panel (one plot), px. Larger: the four panels of an axis are wider than a page. Smaller:
/// peaks of a long run fall together.
const PANEL_PX: [f64; 2] = [230.0, 110.0];

/// Margins of a panel, px: left, top, right and bottom. Larger: empty space. Smaller: numbers are cut off.
const MARGIN_PX: [f64; 4] = [78.0, 30.0, 14.0, 50.0];

/// Number of time columns of a panel; each shows the smallest and the largest value in its time. Larger: larger
/// pages. Smaller: coarser peaks.
const COLUMNS: usize = 230;

/// Ratio of a limit to the largest value of its quantity above which the limit is named and not drawn. Larger: the
/// motion is a flat line. Smaller: limits that the motion comes near are not drawn.
const FAR: f64 = 4.0;

/// Names of the quantities of an axis, with the part of their unit that follows the unit of the axis.
const QUANTITIES: [(&str, &str); 4] =
    [("position", ""), ("velocity", "/s"), ("acceleration", "/s²"), ("jerk", "/s³")];

/// Draws the picture as SVG: position, velocity, acceleration and jerk of every axis against time, with the limits in
/// the verdict. Below, it draws the form of the part on the pixels of the surface; nothing for `None`.
pub fn picture(
    outcome: &MotionReport,
    motion: &AxesMotion,
    verdict: &AxesVerdict,
    part: Option<(&Form, &Surface)>,
) -> String {
    let mut svg = Svg::new(FONT_PX);
    let [left, top, right, bottom] = MARGIN_PX;
    let cell = [PANEL_PX[0] + left + right, PANEL_PX[1] + top + bottom];
    for (axis, (name, unit)) in outcome.axes.iter().zip(&outcome.units).enumerate() {
        for (order, (quantity, per)) in QUANTITIES.iter().enumerate() {
            let corner = [order as f64 * cell[0], axis as f64 * cell[1]];
            let titles = [format!("{name}, {quantity}"), format!("{unit}{per}")];
            let bounds = bounds(verdict.axes.get(axis), order);
            panel(&mut svg, corner, titles, &envelope(motion, axis, order), &bounds, order == 0);
        }
    }
    let mut height = outcome.axes.len() as f64 * cell[1];
    if let Some((form, surface)) = part {
        let heights = part::cells(surface, |place, _| form.sag_mm(place).unwrap_or(f64::NAN));
        let look = Look { colours: &VIRIDIS_FOR_LINES, unit: "mm", title: "height of the form" };
        let frame = part::draw(&mut svg, ([0.0, height], [left, top]), surface, &heights, &look);
        height = frame.bottom() + RIGHT_BOTTOM_PX[1];
    }
    svg.finish([QUANTITIES.len() as f64 * cell[0], height])
}

/// Returns the range of the derivative `order` (0: position) of an axis over [`COLUMNS`] columns of equal duration.
/// Each column is (middle of its time, s; smallest and largest value), exact for every cubic segment. The unit is that
/// of the axis (mm or deg) per s^`order`.
fn envelope(motion: &AxesMotion, axis: usize, order: usize) -> Vec<(f64, f64, f64)> {
    let mut envelope = Envelope::default();
    for i in 0..motion.len() {
        let mut cubic = motion.segment(i)[axis];
        for _ in 0..order {
            cubic = polynomial::derivative(&cubic);
        }
        let reached = polynomial::range(&cubic, motion.duration_s(i));
        envelope.low.push(reached.min);
        envelope.high.push(reached.max);
    }
    let breaks = motion.break_time_s();
    let end_s: Vec<f64> = breaks[1..].iter().map(|t| t - breaks[0]).collect();
    envelope.over_columns(&end_s, COLUMNS)
}

/// Returns the limits of the derivative `order` (0: position) of an axis: the ends of its travel, otherwise plus and
/// minus the limit. Empty if the machine states none.
fn bounds(verdict: Option<&MachineAxisVerdict>, order: usize) -> Vec<f64> {
    let Some(verdict) = verdict else { return Vec::new() };
    match order.checked_sub(1) {
        None => verdict.travel.into_iter().flatten().collect(),
        Some(order) => {
            verdict.derivatives()[order].limit.into_iter().flat_map(|l| [-l, l]).collect()
        }
    }
}

/// Draws one quantity of one axis in a panel with its upper left corner at `corner`, px. `bounds` are its limits,
/// which are the travel if `is_position` is true.
fn panel(
    svg: &mut Svg,
    corner: [f64; 2],
    [title, unit]: [String; 2],
    columns: &[(f64, f64, f64)],
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
        let [x, bottom] = frame.px([*time, *low]);
        let top = frame.px([*time, *high])[1];
        put(&mut d, format_args!("M{x:.1} {bottom:.1}V{:.1}", top.min(bottom - 0.8)));
    }
    svg.path(&format!("fill=\"none\" stroke=\"{}\" stroke-width=\"1.2\"", LINES[0]), &d);
    for bound in &near {
        let y = frame.px([0.0, *bound])[1];
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

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use crate::on_axes::check_names;

    /// Returns a motion of 2 s with two axes: one turns back, x = 2 t - t^2, and one rests at 7.
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
        let outcome: MotionReport = serde_json::from_value(
            json!({ "axes": ["x", "b"], "units": ["mm", "deg"], "contact_deviation_um": 1.0, "gap_um": 0.0,
                "added_tool_on_time_s": 0.0 }),
        )
        .unwrap();
        let axis = json!({ "travel": [-100.0, 100.0], "velocity": { "limit": 3.0 },
            "acceleration": { "limit": 1000.0 }, "jerk": { "limit": null } });
        let verdict: AxesVerdict = serde_json::from_value(json!({ "axes": [axis, axis] })).unwrap();
        let svg = picture(&outcome, &motion(), &verdict, None);
        for words in
            ["x, position, travel -100", "b, velocity", "x, acceleration, limit 1000", "deg/s"]
        {
            assert!(svg.contains(words), "{words} is missing");
        }
        assert!(check_names(&outcome, 2).is_ok() && check_names(&outcome, 3).is_err());
    }
}
