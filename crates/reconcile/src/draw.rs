//! The picture of a reconciliation: maps of the measured removal, of its difference from the plan, and of the rest of
//! the fit, and the RMS by band of spatial frequency.

use ndarray::Array2;
use planish_draw::{
    Bands, Frame, Scale, Svg, cells,
    colour::{BLUE_TO_BROWN, LINES, VIRIDIS},
    frame::range,
};
use planish_types::{Grid, outcome::reconciliation::Band};

use crate::reconcile::Reconciled;

/// Height of the text, px.
const FONT_PX: f64 = 14.0;

/// Width of a map and of the plot of the bands, and (constant below) height of that plot, px.
const WIDTH: f64 = 560.0;
const HEIGHT: f64 = 220.0;

/// Left, top, right and bottom margin of a frame, px.
const MARGIN: [f64; 4] = [64.0, 34.0, 96.0, 50.0];

/// Largest number of cells along an axis of a map, and number of colours. Larger: larger files. Smaller: coarser
/// maps. Chosen.
const MOST_CELLS: usize = 110;
const COLOURS: usize = 24;

/// Draws the picture; returns the text of an SVG file.
pub fn picture(reconciled: &Reconciled, grid: &Grid) -> String {
    let mut svg = Svg::new(FONT_PX);
    let less_planned = &reconciled.measured_nm - &reconciled.planned_nm;
    // What the plan missed and what is left have the same colours, about zero.
    let largest = range(less_planned.iter().copied()).map(f64::abs);
    let largest = largest.into_iter().filter(|v| v.is_finite()).fold(0.0, f64::max);
    let about_zero = Bands::new(&BLUE_TO_BROWN, COLOURS, [-largest, largest]);
    let heights = range(reconciled.measured_nm.iter().copied());
    let upwards = Bands::new(&VIRIDIS, COLOURS, heights);
    let fitted = &reconciled.outcome.fitted;
    let maps: [(String, &Array2<f64>, &Bands); 3] = [
        (
            format!("measured removal: {:.3} nm RMS", fitted.measured_removal_rms_nm),
            &reconciled.measured_nm,
            &upwards,
        ),
        (
            format!("less the plan's: {:.3} nm RMS", fitted.measured_less_planned_rms_nm),
            &less_planned,
            &about_zero,
        ),
        (
            format!("less what was learnt: {:.3} nm RMS", fitted.rest_rms_nm),
            &reconciled.rest_nm,
            &about_zero,
        ),
    ];
    let [x, y] = [&grid.x, &grid.y]
        .map(|a| [a.start_mm() - 0.5 * a.step_mm(), a.end_mm() + 0.5 * a.step_mm()]);
    let size = [WIDTH, WIDTH * (y[1] - y[0]) / (x[1] - x[0])];
    let each = size[1].max(100.0) + MARGIN[1] + MARGIN[3];
    for (k, (title, map, colours)) in maps.into_iter().enumerate() {
        let scales = [Scale::linear(x), Scale::linear(y)];
        let frame = Frame::new([0.0, k as f64 * each], size, MARGIN, scales);
        cells::draw(&mut svg, &frame, map.view(), colours, MOST_CELLS);
        frame.axes(&mut svg, ["x (mm)", "y (mm)"]);
        frame.title(&mut svg, &title);
        frame.colour_bar(&mut svg, colours, "nm");
    }
    let top = 3.0 * each;
    draw_bands(&mut svg, &reconciled.outcome.bands, top);
    let total = [WIDTH + MARGIN[0] + MARGIN[2], top + HEIGHT + MARGIN[1] + MARGIN[3]];
    svg.finish(total)
}

/// Draws the RMS in each band of spatial frequency as a step, the longest periods at the left. `top` is the upper edge,
/// px.
fn draw_bands(svg: &mut Svg, all: &[Band], top: f64) {
    let lines = [
        ("measured", LINES[0], all.iter().map(|b| b.measured_rms_nm).collect::<Vec<_>>()),
        ("less the plan's", LINES[1], all.iter().map(|b| b.measured_less_planned_rms_nm).collect()),
        ("rest", LINES[2], all.iter().map(|b| b.rest_rms_nm).collect()),
    ];
    let positive = lines.iter().flat_map(|l| l.2.iter().copied()).filter(|v| *v > 0.0);
    let [low, high] = range(positive);
    let scales =
        [Scale::linear([0.0, all.len() as f64]), Scale::logarithmic([0.7 * low, 1.4 * high])];
    let frame = Frame::new([0.0, top], [WIDTH, HEIGHT], MARGIN, scales);
    let edges: Vec<String> = all
        .iter()
        .filter_map(|b| b.period_mm[0].filter(|p| *p > 0.0))
        .map(|p| format!("{p:.1}"))
        .collect();
    let title = format!("band of periods, divided at {} mm", edges.join(", "));
    frame.axes(svg, [&title, "RMS (nm)"]);
    for (_, colour, values) in &lines {
        let steps = values.iter().enumerate().flat_map(|(k, v)| {
            let v = if *v > 0.0 { *v } else { f64::NAN };
            [[k as f64, v], [k as f64 + 1.0, v]]
        });
        frame.curve(svg, steps, colour);
    }
    frame.title(svg, "removal by band");
    frame.legend(svg, &lines.each_ref().map(|l| (l.0, l.1)));
}
