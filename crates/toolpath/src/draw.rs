//! A picture of a path as SVG text: x to the right, y upwards, one scale for both, axes in mm.
//!
//! Passes take turns with the colours; a single pass goes through them once from its start to its
//! end, so that its order can be seen. Lifts are dashed. A dot marks the start, a square the end.
//! The clear aperture, where it is given, is grey.

use std::fmt::Write;

use planish_numerics::ticks::round_numbers;
use planish_types::{Surface, ToolPath};

use crate::region::{Aperture, Interval};

/// Larger side of the region, in pixels of the picture.
const SIZE_PX: f64 = 1000.0;

/// Left, top, right, bottom of the region, in pixels of the picture.
const MARGIN_PX: [f64; 4] = [70.0, 40.0, 20.0, 60.0];

/// Dark enough for white paper, told apart by people who see fewer colours: a way through the
/// viridis map.
const COLOURS: [&str; 8] =
    ["#440154", "#46327e", "#365c8d", "#277f8e", "#1fa187", "#4ac16d", "#a0b020", "#d8a010"];

/// A picture of `path`, over the valid pixels of `surface` where it is given.
pub fn svg(path: &ToolPath, surface: Option<&Surface>) -> String {
    let aperture = surface.map(|s| Aperture::new(&s.grid().x, &s.grid().y, s.height_nm().view()));
    let frame = Frame::around(path, aperture.as_ref());
    let mut out = String::new();
    frame.open(&mut out);
    if let Some(aperture) = &aperture {
        frame.aperture(&mut out, aperture);
    }
    frame.axes(&mut out);
    frame.path(&mut out, path);
    out.push_str("</svg>\n");
    out
}

/// From mm to pixels of the picture.
struct Frame {
    x_mm: Interval,
    y_mm: Interval,
    px_per_mm: f64,
}

impl Frame {
    fn around(path: &ToolPath, aperture: Option<&Aperture>) -> Self {
        let over = |axis: usize, more: Option<Interval>| {
            let points = path.point_mm().iter().map(|p| p[axis]);
            let ends = points.chain(more.into_iter().flat_map(|i| [i.low, i.high]));
            ends.fold(Interval { low: f64::MAX, high: f64::MIN }, |i, v| Interval {
                low: i.low.min(v),
                high: i.high.max(v),
            })
        };
        let half = aperture.map_or([0.0; 2], |a| a.pixel_mm.map(|h| 0.5 * h));
        let mut x_mm = over(0, aperture.map(|a| a.along(half[0])));
        let mut y_mm = over(1, aperture.map(|a| a.across(half[1])));
        let widest = (x_mm.high - x_mm.low).max(y_mm.high - y_mm.low);
        // A path that is one point, but for rounding, gets a frame of 1 mm.
        let ends = [x_mm.low, x_mm.high, y_mm.low, y_mm.high];
        let rounding = 1e-12 * ends.into_iter().fold(0.0, |m: f64, v| m.max(v.abs()));
        let rim = if widest > rounding { 0.02 * widest } else { 0.5 };
        for i in [&mut x_mm, &mut y_mm] {
            (i.low, i.high) = (i.low - rim, i.high + rim);
        }
        Self { x_mm, y_mm, px_per_mm: SIZE_PX / (widest + 2.0 * rim) }
    }

    fn at(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        [
            MARGIN_PX[0] + (x - self.x_mm.low) * self.px_per_mm,
            MARGIN_PX[1] + (self.y_mm.high - y) * self.px_per_mm,
        ]
    }

    fn open(&self, out: &mut String) {
        let [right, bottom] = self.at([self.x_mm.high, self.y_mm.low]);
        let (width, height) = (right + MARGIN_PX[2], bottom + MARGIN_PX[3]);
        put(
            out,
            format_args!(
                "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width:.0}\" \
                 height=\"{height:.0}\" viewBox=\"0 0 {width:.2} {height:.2}\" \
                 font-family=\"sans-serif\" font-size=\"16\">\n\
                 <rect width=\"100%\" height=\"100%\" fill=\"#ffffff\"/>\n"
            ),
        );
    }

    /// One rectangle for every run of valid pixels.
    fn aperture(&self, out: &mut String, aperture: &Aperture) {
        out.push_str("<path fill=\"#dddddd\" shape-rendering=\"crispEdges\" d=\"");
        let [hx, hy] = aperture.pixel_mm.map(|h| 0.5 * h);
        for (y, runs) in &aperture.rows {
            for run in runs {
                let [left, top] = self.at([run.low - hx, y + hy]);
                let [right, bottom] = self.at([run.high + hx, y - hy]);
                put(out, format_args!("M{left:.2} {top:.2}H{right:.2}V{bottom:.2}H{left:.2}Z"));
            }
        }
        out.push_str("\"/>\n");
    }

    fn axes(&self, out: &mut String) {
        let [left, bottom] = self.at([self.x_mm.low, self.y_mm.low]);
        let [right, top] = self.at([self.x_mm.high, self.y_mm.high]);
        put(
            out,
            format_args!(
                "<rect x=\"{left:.2}\" y=\"{top:.2}\" width=\"{:.2}\" height=\"{:.2}\" \
                 fill=\"none\" stroke=\"#000000\"/>\n",
                right - left,
                bottom - top
            ),
        );
        for v in round_numbers(self.x_mm.low, self.x_mm.high, 10.0) {
            let x = self.at([v, 0.0])[0];
            put(
                out,
                format_args!(
                    "<path stroke=\"#000000\" d=\"M{x:.2} {bottom:.2}v6\"/>\
                     <text x=\"{x:.2}\" y=\"{:.2}\" text-anchor=\"middle\">{v}</text>\n",
                    bottom + 23.0
                ),
            );
        }
        for v in round_numbers(self.y_mm.low, self.y_mm.high, 10.0) {
            let y = self.at([0.0, v])[1];
            put(
                out,
                format_args!(
                    "<path stroke=\"#000000\" d=\"M{left:.2} {y:.2}h-6\"/>\
                     <text x=\"{:.2}\" y=\"{:.2}\" text-anchor=\"end\">{v}</text>\n",
                    left - 10.0,
                    y + 5.0
                ),
            );
        }
        let (x, y) = (0.5 * (left + right), 0.5 * (top + bottom));
        put(
            out,
            format_args!(
                "<text x=\"{x:.2}\" y=\"{:.2}\" text-anchor=\"middle\">x (mm)</text>\n\
                 <text transform=\"translate(18 {y:.2}) rotate(-90)\" \
                 text-anchor=\"middle\">y (mm)</text>\n",
                bottom + 48.0
            ),
        );
    }

    fn path(&self, out: &mut String, path: &ToolPath) {
        let (on, pass, n) = (path.tool_on(), path.pass_idx(), path.len());
        let single = pass.iter().all(|p| *p == pass[0]);
        // Which line of the picture a segment belongs to: a colour, or none for a lift.
        let colour = |i: usize| match single {
            _ if !on[i] => None,
            true => Some(i * COLOURS.len() / n),
            false => Some(pass[i].rem_euclid(COLOURS.len() as i64) as usize),
        };
        let width = (0.25 * SIZE_PX / (n as f64).sqrt()).clamp(0.4, 2.0);
        put(
            out,
            format_args!(
                "<g fill=\"none\" stroke-width=\"{width:.2}\" stroke-linejoin=\"round\" \
                 stroke-linecap=\"round\">\n"
            ),
        );
        let mut i = 0;
        while i < n {
            match colour(i) {
                Some(c) => put(out, format_args!("<path stroke=\"{}\" d=\"", COLOURS[c])),
                None => out.push_str("<path stroke=\"#d62728\" stroke-dasharray=\"6 5\" d=\""),
            }
            let [x, y] = self.at(path.point_mm()[i]);
            put(out, format_args!("M{x:.2} {y:.2}L"));
            let this = (colour(i), pass[i]);
            while i < n && (colour(i), pass[i]) == this {
                i += 1;
                let [x, y] = self.at(path.point_mm()[i]);
                put(out, format_args!("{x:.2} {y:.2} "));
            }
            out.push_str("\"/>\n");
        }
        let [x, y] = self.at(path.point_mm()[0]);
        let [ex, ey] = self.at(path.point_mm()[n]);
        put(
            out,
            format_args!(
                "</g>\n<circle cx=\"{x:.2}\" cy=\"{y:.2}\" r=\"5\"/>\n\
                 <rect x=\"{:.2}\" y=\"{:.2}\" width=\"12\" height=\"12\" fill=\"none\" \
                 stroke=\"#000000\" stroke-width=\"2\"/>\n",
                ex - 6.0,
                ey - 6.0
            ),
        );
        let length: f64 = (0..n).filter(|i| on[*i]).map(|i| path.segment_length_mm(i)).sum();
        put(
            out,
            format_args!(
                "<text x=\"{:.2}\" y=\"{:.2}\">{n} segments, {length:.1} mm; dot: start, square: \
                 end{}</text>\n",
                MARGIN_PX[0],
                MARGIN_PX[1] - 14.0,
                if on.iter().all(|on| *on) { "" } else { ", dashed: tool lifted" }
            ),
        );
    }
}

/// Writing to a string does not fail.
fn put(out: &mut String, text: std::fmt::Arguments) {
    let _ = out.write_fmt(text);
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
