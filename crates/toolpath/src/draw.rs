//! A picture of a path as SVG text: x to the right, y upwards, one scale for both, axes in mm.
//!
//! Passes take turns with the colours; a single pass goes through them once from its start to its
//! end, so that its order can be seen. Lifts are dashed. A dot marks the start, a square the end.
//! The clear aperture, where it is given, is grey.

use planish_draw::{
    Frame, Scale, Svg, colour::VIRIDIS_FOR_LINES as COLOURS, frame::range, svg::put,
};
use planish_types::{Surface, ToolPath};

use crate::region::Aperture;

/// Height of the text, in pixels of the picture.
const FONT_PX: f64 = 16.0;

/// Larger side of the region that is drawn, in pixels of the picture. Larger: a larger picture with smaller text.
const SIZE_PX: f64 = 1000.0;

/// Margins left, above, right and below the region, in pixels of the picture; they hold the axes and their labels.
const MARGIN_PX: [f64; 4] = [70.0, 40.0, 20.0, 60.0];

/// Draws a picture of `path`, over the valid pixels of `surface` where it is given.
pub fn svg(path: &ToolPath, surface: Option<&Surface>) -> String {
    let aperture = surface.map(|s| Aperture::new(&s.grid().x, &s.grid().y, s.height_nm().view()));
    let frame = frame_around(path, aperture.as_ref());
    let mut svg = Svg::new(FONT_PX);
    if let Some(aperture) = &aperture {
        draw_aperture(&mut svg, &frame, aperture);
    }
    frame.axes(&mut svg, ["x (mm)", "y (mm)"]);
    draw_path(&mut svg, &frame, path);
    let [left, top, right, bottom] = MARGIN_PX;
    svg.finish([left + frame.width + right, top + frame.height + bottom])
}

/// Returns the frame around the path and the aperture, in mm, with a margin.
fn frame_around(path: &ToolPath, aperture: Option<&Aperture>) -> Frame {
    let half = aperture.map_or([0.0; 2], |a| a.pixel_mm.map(|h| 0.5 * h));
    let beyond = [aperture.map(|a| a.along(half[0])), aperture.map(|a| a.across(half[1]))];
    let [mut x, mut y] = [0, 1].map(|axis| {
        let points = path.point_mm().iter().map(|p| p[axis]);
        range(points.chain(beyond[axis].into_iter().flat_map(|i| [i.low, i.high])))
    });
    let widest = (x[1] - x[0]).max(y[1] - y[0]);
    // A path that is one point, but for rounding, gets a frame of 1 mm.
    let rounding = 1e-12 * [x, y].as_flattened().iter().fold(0.0, |m: f64, v| m.max(v.abs()));
    let rim = if widest > rounding { 0.02 * widest } else { 0.5 };
    for [low, high] in [&mut x, &mut y] {
        *low -= rim;
        *high += rim;
    }
    let px_per_mm = SIZE_PX / (widest + 2.0 * rim);
    let size = [x, y].map(|[low, high]| (high - low) * px_per_mm);
    Frame::new([0.0; 2], size, MARGIN_PX, [Scale::linear(x), Scale::linear(y)])
}

/// Draws one rectangle for every run of valid pixels in a row of the map.
fn draw_aperture(svg: &mut Svg, frame: &Frame, aperture: &Aperture) {
    let [hx, hy] = aperture.pixel_mm.map(|h| 0.5 * h);
    let mut d = String::new();
    for (y, runs) in &aperture.rows {
        for run in runs {
            let [left, top] = frame.px([run.low - hx, y + hy]);
            let [right, bottom] = frame.px([run.high + hx, y - hy]);
            put(&mut d, format_args!("M{left:.2} {top:.2}H{right:.2}V{bottom:.2}H{left:.2}Z"));
        }
    }
    svg.path("fill=\"#dddddd\" shape-rendering=\"crispEdges\"", &d);
}

fn draw_path(svg: &mut Svg, frame: &Frame, path: &ToolPath) {
    let on = path.tool_on();
    let pass = path.pass_idx();
    let n = path.len();
    let single = pass.iter().all(|p| *p == pass[0]);
    // Which line of the picture a segment belongs to: a colour, or none for a lift.
    let colour = |i: usize| {
        let by_pass = pass[i].rem_euclid(COLOURS.len() as i64) as usize;
        let colour = if single { i * COLOURS.len() / n } else { by_pass };
        Some(colour).filter(|_| on[i])
    };
    let width = (0.25 * SIZE_PX / (n as f64).sqrt()).clamp(0.4, 2.0);
    svg.put(format_args!(
        "<g fill=\"none\" stroke-width=\"{width:.2}\" stroke-linejoin=\"round\" \
         stroke-linecap=\"round\">"
    ));
    let mut i = 0;
    while i < n {
        let style = match colour(i) {
            Some(c) => format!("stroke=\"{}\"", COLOURS[c]),
            None => "stroke=\"#d62728\" stroke-dasharray=\"6 5\"".into(),
        };
        let [x, y] = frame.px(path.point_mm()[i]);
        let mut d = format!("M{x:.2} {y:.2}L");
        let this = (colour(i), pass[i]);
        while i < n && (colour(i), pass[i]) == this {
            i += 1;
            let [x, y] = frame.px(path.point_mm()[i]);
            put(&mut d, format_args!("{x:.2} {y:.2} "));
        }
        svg.path(&style, &d);
    }
    svg.put(format_args!("</g>"));
    let [x, y] = frame.px(path.point_mm()[0]);
    svg.put(format_args!("<circle cx=\"{x:.2}\" cy=\"{y:.2}\" r=\"5\"/>"));
    let [x, y] = frame.px(path.point_mm()[n]);
    let square = "fill=\"none\" stroke=\"#000000\" stroke-width=\"2\"";
    svg.rectangle([x - 6.0, y - 6.0], [12.0; 2], square);
    let length: f64 = (0..n).filter(|i| on[*i]).map(|i| path.segment_length_mm(i)).sum();
    let lifted = if on.iter().all(|on| *on) { "" } else { ", dashed: tool lifted" };
    let title = format!("{n} segments, {length:.1} mm; dot: start, square: end{lifted}");
    frame.title(svg, &title);
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::array;
    use planish_types::{Axis, Grid};

    #[test]
    fn y_goes_up_lifts_are_dashed_and_passes_change_colour() {
        let points = vec![[0.0, 0.0], [10.0, 0.0], [10.0, 5.0], [0.0, 5.0]];
        let path = ToolPath::through(points, vec![true, false, true], vec![0, 0, 1]).unwrap();
        let axis = Axis::new(2.0, 1.0, 2).unwrap();
        let hole = array![[0.0, f64::NAN], [0.0, 0.0]];
        let surface = Surface::new(Grid { x: axis, y: axis }, hole).unwrap();
        let picture = svg(&path, Some(&surface));
        // 10 mm and a rim of 2 % on both sides over 1000 px: 96.15 px per mm.
        let line = |colour: usize| format!("<path stroke=\"{}\" d=\"M", COLOURS[colour]);
        assert!(picture.contains(&format!("{}89.23 540.00L1050.77 540.00", line(0))), "{picture}");
        assert!(picture.contains(&format!("{}1050.77 59.23L89.23 59.23", line(1))), "{picture}");
        assert_eq!(picture.matches("stroke-dasharray").count(), 1);
        // The aperture: one run per row.
        let grey = picture.split("#dddddd").nth(1).and_then(|s| s.split("/>").next()).unwrap();
        assert_eq!(grey.matches('M').count(), 2);
    }

    #[test]
    fn a_single_pass_goes_through_the_colours() {
        let points = (0..=800).map(|i| [f64::from(i), 0.0]).collect();
        let path = ToolPath::through(points, vec![true; 800], vec![0; 800]).unwrap();
        let picture = svg(&path, None);
        assert!(COLOURS.iter().all(|c| picture.matches(c).count() == 1));
    }
}
