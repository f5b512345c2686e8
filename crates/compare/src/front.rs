//! Residual against time of all plans: the points, as comma-separated values, and as a picture.
//!
//! A plan is on the front if no other plan that may be run takes at most its time and leaves at most its residual.

use planish_draw::{
    Frame, Scale, Svg,
    colour::{INK, LINES},
    frame::range,
    svg::END,
};
use planish_numerics::pareto;
use planish_types::text::{escaped, significant};
use serde::Serialize;

use crate::{
    csv::{quoted, text_cell},
    plan::State,
    several::Several,
    summary::Summary,
};

/// Height of the texts of the picture, px.
const FONT_PX: f64 = 14.0;

/// Width and height of the frame of the plot, px. Derived: with the margins as wide as a figure for papers.
const SIZE_PX: [f64; 2] = [822.0, 380.0];

/// Margins of the plot, px: left, top, right and bottom.
const MARGIN_PX: [f64; 4] = [90.0, 40.0, 40.0, 60.0];

/// Room of an axis beyond the points at its ends: a factor of the value on a logarithmic axis; on a linear one, the
/// excess over 1 is a fraction of the range. Larger: empty borders. Smaller: points on the frame.
const ROOM: f64 = 1.12;

/// Smallest ratio of the ends of an axis at which the axis is logarithmic. Larger: small values crowd at one end of a
/// linear axis. Smaller: few round numbers fit on a short logarithmic axis. Chosen.
const DECADES_FROM: f64 = 10.0;

/// Colour of the points of plans that are not to be run.
const NOT_RUN: &str = "#888888";

/// Part of the height of a letter that its width is on average. Larger: labels keep more distance. Smaller: they
/// overlap.
const LETTER: f64 = 0.56;

/// Number of plans from which only those on the front have their names in the picture. Larger: names that cover each
/// other. Smaller: points without a name.
const MANY_PLANS: usize = 16;

/// Kind of a point.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum PointKind {
    /// A motion, which can be run if it keeps the limits.
    Plan,
    /// A motion that exists to compare with.
    Baseline,
    /// Dwell times without a motion, which nobody can run.
    DwellTimes,
}

/// A plan with its time and its residual.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct FrontPoint {
    /// Name of the run.
    pub run: String,
    /// Name of the plan.
    pub plan: String,
    /// Kind of the plan.
    pub kind: PointKind,
    /// Time of the plan, with the changes of tools if there are any, s.
    pub time_s: f64,
    /// RMS of the residual by which plans are compared, nm.
    pub rms_nm: f64,
    /// True if the verdict found every limit of the machine kept; `null` for dwell times without a motion.
    pub limits_kept: Option<bool>,
    /// True if the plan is the one that is to be run.
    pub is_recommended: bool,
}

impl FrontPoint {
    /// Returns true if the plan may be run: a motion, no baseline, within the limits.
    pub fn may_be_run(&self) -> bool {
        self.kind == PointKind::Plan && self.limits_kept == Some(true)
    }
}

/// Returns the points of all plans of the runs, each with its name.
pub fn points(runs: &[(&str, &Summary)]) -> Vec<FrontPoint> {
    let mut points = Vec::new();
    for (run, summary) in runs {
        if let Some(several) = &summary.several {
            points.extend(points_of_tools(run, several));
            continue;
        }
        for (name, m) in &summary.methods {
            let kind = match m.plan.state {
                State::WithoutMotion => PointKind::DwellTimes,
                State::Baseline => PointKind::Baseline,
                _ => PointKind::Plan,
            };
            let numbers = m.candidate();
            let limits_kept =
                if kind == PointKind::DwellTimes { None } else { Some(m.keeps_all_limits()) };
            points.push(FrontPoint {
                run: run.to_string(),
                plan: name.clone(),
                kind,
                time_s: numbers.total_time_s,
                rms_nm: numbers.rms_nm,
                limits_kept,
                is_recommended: summary.best.as_ref() == Some(name),
            });
        }
    }
    points
}

/// Returns the points of a plan of several tools: the plan as it runs, the other plans of the rack as they would run,
/// and the dwell times of each subset of the rack.
fn points_of_tools(run: &str, several: &Several) -> Vec<FrontPoint> {
    let point = |plan: String, kind, numbers: [f64; 2], limits_kept| FrontPoint {
        run: run.into(),
        plan,
        kind,
        time_s: numbers[0],
        rms_nm: numbers[1],
        limits_kept,
        is_recommended: false,
    };
    let mut points = Vec::new();
    for subset in &several.subsets {
        let name = subset.tools.join(" + ");
        let numbers = [subset.time_with_changes_s, subset.rms_nm];
        points.push(point(name, PointKind::DwellTimes, numbers, None));
    }
    for other in &several.others {
        let numbers = [other.time_with_changes_s, other.rms_nm];
        let name = format!("{}, executed", other.words());
        points.push(point(name, PointKind::Plan, numbers, Some(other.limits_kept)));
    }
    if let Some(last) = several.tools.last() {
        let names: Vec<&str> = several.tools.iter().map(|tool| tool.name.as_str()).collect();
        let name = format!("{}, executed", names.join(" + "));
        let numbers = [several.total_time_s, last.rms_nm];
        let kept = several.keeps_limits();
        let plan = point(name, PointKind::Plan, numbers, Some(kept));
        points.push(FrontPoint { is_recommended: kept, ..plan });
    }
    points
}

/// Returns the indices of the points on the front, by ascending time.
pub fn front(points: &[FrontPoint]) -> Vec<usize> {
    let run: Vec<usize> = (0..points.len()).filter(|i| points[*i].may_be_run()).collect();
    let places: Vec<[f64; 2]> = run.iter().map(|i| place(&points[*i])).collect();
    pareto::front(&places).into_iter().map(|k| run[k]).collect()
}

/// Returns the points as comma-separated values, with all digits. Units end the names of the columns.
pub fn csv(points: &[FrontPoint]) -> String {
    let front = front(points);
    let mut text =
        String::from("run,plan,kind,time_s,rms_nm,limits_kept,on_the_front,recommended\n");
    for (i, point) in points.iter().enumerate() {
        let kind = match point.kind {
            PointKind::Plan => "plan",
            PointKind::Baseline => "baseline",
            PointKind::DwellTimes => "dwell-times",
        };
        let cells = [
            text_cell(&point.run),
            text_cell(&point.plan),
            kind.into(),
            point.time_s.to_string(),
            point.rms_nm.to_string(),
            point.limits_kept.map_or(String::new(), |kept| kept.to_string()),
            front.contains(&i).to_string(),
            point.is_recommended.to_string(),
        ];
        text += &cells.map(|cell| quoted(&cell)).join(",");
        text.push('\n');
    }
    text
}

/// Draws the points with their names, and the front as a line; `None` for fewer than two points.
pub fn svg(points: &[FrontPoint]) -> Option<String> {
    if points.len() < 2 {
        return None;
    }
    let scales = [0, 1].map(|k| scale(range(points.iter().map(|point| place(point)[k]))));
    let frame = Frame::new([0.0; 2], SIZE_PX, MARGIN_PX, scales);
    let mut svg = Svg::new(FONT_PX);
    frame.grid(&mut svg);
    frame.axes(&mut svg, ["time (s)", "RMS of the residual (nm)"]);
    frame.legend(
        &mut svg,
        &[
            ("keeps the limits", LINES[0]),
            ("not to be run", NOT_RUN),
            ("dwell times alone", LINES[1]),
        ],
    );
    frame.curve(&mut svg, stairs(points), INK);
    let several = points.iter().any(|point| point.run != points[0].run);
    let front = front(points);
    let mut taken: Vec<[f64; 4]> = Vec::new();
    for (i, point) in points.iter().enumerate() {
        let [x, y] = frame.px(place(point));
        let colour = match point.kind {
            PointKind::DwellTimes => LINES[1],
            _ if point.may_be_run() => LINES[0],
            _ => NOT_RUN,
        };
        let label =
            if several { format!("{} / {}", point.run, point.plan) } else { point.plan.clone() };
        let words = format!(
            "{label}: {} nm in {} s",
            significant(point.rms_nm, 4),
            significant(point.time_s, 4)
        );
        if point.is_recommended {
            svg.put(format_args!(
                "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"9\" fill=\"none\" stroke=\"{INK}\" stroke-width=\"2\"/>"
            ));
        }
        svg.put(format_args!(
            "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"5\" fill=\"{colour}\"><title>{}</title></circle>",
            escaped(&words)
        ));
        if points.len() <= MANY_PLANS || point.is_recommended || front.contains(&i) {
            write_label(&mut svg, &frame, [x, y], &label, &mut taken);
        }
    }
    let [left, top, right, bottom] = MARGIN_PX;
    Some(svg.finish([left + SIZE_PX[0] + right, top + SIZE_PX[1] + bottom]))
}

/// Returns the corners of the staircase that bounds what the plans of the front reach: [time, s; residual, nm].
fn stairs(points: &[FrontPoint]) -> Vec<[f64; 2]> {
    let mut corners: Vec<[f64; 2]> = Vec::new();
    for i in front(points) {
        let [time_s, rms_nm] = place(&points[i]);
        if let Some([_, before_nm]) = corners.last().copied() {
            corners.push([time_s, before_nm]);
        }
        corners.push([time_s, rms_nm]);
    }
    corners
}

/// Writes a label beside the point [x, y], px, at the first place where it covers no other. `taken` are the boxes
/// [left, top, right, bottom] of those before, to which it adds its own.
fn write_label(
    svg: &mut Svg,
    frame: &Frame,
    [x, y]: [f64; 2],
    label: &str,
    taken: &mut Vec<[f64; 4]>,
) {
    let width = LETTER * FONT_PX * label.chars().count() as f64;
    let is_left = x + 12.0 + width > frame.right();
    let left = if is_left { x - 12.0 - width } else { x + 12.0 };
    // Beside the point, then a line below it, a line above it, and so on.
    let rows =
        (0..20).map(|k| f64::from((k + 1) / 2) * if k % 2 == 0 { -FONT_PX } else { FONT_PX });
    let boxes: Vec<[f64; 4]> = rows
        .map(|row| [left, y + row - 0.5 * FONT_PX, left + width, y + row + 0.5 * FONT_PX])
        .collect();
    let is_free = |b: &&[f64; 4]| {
        let inside = b[1] >= frame.top && b[3] <= frame.bottom();
        inside && !taken.iter().any(|t| b[0] < t[2] && t[0] < b[2] && b[1] < t[3] && t[1] < b[3])
    };
    let place = boxes.iter().find(is_free).unwrap_or(&boxes[0]);
    let base = [if is_left { place[2] } else { place[0] }, place[3] - 0.15 * FONT_PX];
    // A rim of paper keeps the letters apart from the line of the front.
    let anchor = if is_left { END } else { "" };
    let attributes =
        format!("stroke=\"#ffffff\" stroke-width=\"3\" paint-order=\"stroke\" {anchor}");
    svg.text(base, attributes.trim_end(), label);
    taken.push(*place);
}

fn place(point: &FrontPoint) -> [f64; 2] {
    [point.time_s, point.rms_nm]
}

/// Returns the axis for values in this range.
fn scale([low, high]: [f64; 2]) -> Scale {
    if low > 0.0 && high > DECADES_FROM * low {
        return Scale::logarithmic([low / ROOM, high * ROOM]);
    }
    let room = (ROOM - 1.0) * (high - low);
    Scale::linear([low - room, high + room])
}

#[cfg(test)]
mod tests {
    use super::*;

    fn point(plan: &str, time_s: f64, rms_nm: f64, limits_kept: Option<bool>) -> FrontPoint {
        let kind = if limits_kept.is_some() { PointKind::Plan } else { PointKind::DwellTimes };
        let run = "raster".to_string();
        let is_recommended = plan == "joint";
        FrontPoint { run, plan: plan.into(), kind, time_s, rms_nm, limits_kept, is_recommended }
    }

    fn four() -> Vec<FrontPoint> {
        vec![
            point("position", 90.0, 0.1, None),
            point("joint", 100.0, 0.2, Some(true)),
            point("pvt,fast", 80.0, 0.5, Some(false)),
            point("pvt<b>", 120.0, 0.3, Some(true)),
        ]
    }

    #[test]
    fn the_front_has_the_plans_that_can_be_run_and_that_no_other_beats() {
        assert_eq!(front(&four()), [1]);
        let mut more = four();
        more.push(point("slow", 200.0, 0.1, Some(true)));
        assert_eq!(front(&more), [1, 4]);
        assert_eq!(stairs(&more), [[100.0, 0.2], [200.0, 0.2], [200.0, 0.1]]);
    }

    #[test]
    fn the_values_are_rows_and_the_picture_has_every_point() {
        let text = csv(&four());
        let rows: Vec<&str> = text.lines().collect();
        assert_eq!(rows[1], "raster,position,dwell-times,90,0.1,,false,false");
        assert_eq!(rows[2], "raster,joint,plan,100,0.2,true,true,true");
        assert_eq!(rows[3], "raster,\"pvt,fast\",plan,80,0.5,false,false,false");
        let drawn = svg(&four()).unwrap();
        assert_eq!(drawn.matches("r=\"5\"").count(), 4);
        assert_eq!(drawn.matches("r=\"9\"").count(), 1);
        assert!(!drawn.contains("<b>") && !drawn.contains("NaN"), "{drawn}");
        assert_eq!(svg(&four()[..1]), None);
    }
}
