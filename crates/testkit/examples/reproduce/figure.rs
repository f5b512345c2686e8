//! Figures as SVG: charts of curves and dots over two axes, and maps on a common scale.

use std::fmt::Write;

use ndarray::{Array2, s};
use planish_surface::draw::{MapsSettings, Panel, maps_svg};
use planish_types::{Axis as Pixels, Grid, Surface};

/// Width of a chart, px of the picture.
const WIDTH: f64 = 640.0;
/// Height of a chart, px of the picture.
const HEIGHT: f64 = 320.0;
/// Margins at the left, right, top and bottom of a chart, px of the picture.
const MARGIN: [f64; 4] = [64.0, 16.0, 16.0, 44.0];
const COLOURS: [&str; 5] = ["#888888", "#c2410c", "#1d4ed8", "#15803d", "#7e22ce"];

/// Points in the order of x.
pub struct Series {
    pub name: &'static str,
    pub points: Vec<[f64; 2]>,
    pub dots: bool,
}

/// An axis with the values at its ticks; `log` for powers of ten.
pub struct Axis {
    pub label: &'static str,
    pub ticks: Vec<f64>,
    pub log: bool,
}

impl Axis {
    fn place(&self, value: f64) -> f64 {
        let of = |v: f64| if self.log { v.log10() } else { v };
        let (first, last) = (self.ticks[0], self.ticks[self.ticks.len() - 1]);
        ((of(value) - of(first)) / (of(last) - of(first))).clamp(0.0, 1.0)
    }

    fn text(&self, tick: f64) -> String {
        if self.log { format!("{tick:e}") } else { format!("{tick}") }
    }
}

/// SVG of a chart; points beyond the ticks are drawn at the edge.
pub fn chart(x: &Axis, y: &Axis, series: &[Series]) -> String {
    chart_of(HEIGHT, x, y, series)
}

/// Charts of equal height, the first on top.
pub fn stacked(height: f64, charts: &[(&Axis, &Axis, Vec<Series>)]) -> String {
    let total = height * charts.len() as f64;
    let mut svg =
        format!("<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH} {total}\">\n");
    for (i, (x, y, series)) in charts.iter().enumerate() {
        let place =
            format!("<svg y=\"{}\" width=\"{WIDTH}\" height=\"{height}\"", height * i as f64);
        svg.push_str(&chart_of(height, x, y, series).replacen("<svg", &place, 1));
    }
    svg.push_str("</svg>\n");
    svg
}

/// Maps (title, heights in nm) one beside the other on one scale, of means over `block` x `block`
/// pixels cut at +-`cut_nm`, and their section at `section_y_mm`.
pub fn maps(maps: &[(String, &Surface)], block: usize, cut_nm: f64, section_y_mm: f64) -> String {
    let panels: Vec<Panel> = maps
        .iter()
        .map(|(title, map)| {
            let (grid, map) = coarse(map, block);
            let map = map.mapv(|v| v.clamp(-cut_nm, cut_nm));
            Panel { title: title.clone(), grid, map }
        })
        .collect();
    let settings = MapsSettings {
        unit: "nm",
        section_y_mm: Some(section_y_mm),
        common_scale: true,
        outline: None,
    };
    maps_svg(&panels, &settings).expect("the section goes through the maps")
}

/// Means over whole blocks; NaN where a pixel is.
fn coarse(map: &Surface, block: usize) -> (Grid, Array2<f64>) {
    let (grid, z) = (map.grid(), map.height_nm());
    let axis = |a: &Pixels| {
        let start = a.start_mm() + 0.5 * (block - 1) as f64 * a.step_mm();
        Pixels::new(start, block as f64 * a.step_mm(), a.len() / block).expect("an axis")
    };
    let grid = Grid { x: axis(&grid.x), y: axis(&grid.y) };
    let mean = |(r, c): (usize, usize)| {
        let (r, c) = (r * block, c * block);
        z.slice(s![r..r + block, c..c + block]).sum() / (block * block) as f64
    };
    (grid, Array2::from_shape_fn(grid.shape(), mean))
}

fn chart_of(height: f64, x: &Axis, y: &Axis, series: &[Series]) -> String {
    let [left, right, top, bottom] = MARGIN;
    let px = |v: f64| left + x.place(v) * (WIDTH - left - right);
    let py = |v: f64| height - bottom - y.place(v) * (height - top - bottom);
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {} {}\" \
         font-family=\"sans-serif\" font-size=\"12\">\n<rect width=\"100%\" height=\"100%\" \
         fill=\"white\"/>\n",
        WIDTH, height
    );
    let mut add = |line: String| {
        let _ = writeln!(svg, "{line}");
    };
    let (x0, x1) = (left, WIDTH - right);
    let (y0, y1) = (height - bottom, top);
    for tick in &x.ticks {
        let at = px(*tick);
        add(format!("<path d=\"M{at:.1} {y0}V{y1}\" stroke=\"#e5e5e5\"/>"));
        let text = x.text(*tick);
        add(format!(
            "<text x=\"{at:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{text}</text>",
            y0 + 16.0
        ));
    }
    for tick in &y.ticks {
        let at = py(*tick);
        add(format!("<path d=\"M{x0} {at:.1}H{x1}\" stroke=\"#e5e5e5\"/>"));
        let text = y.text(*tick);
        add(format!(
            "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">{text}</text>",
            x0 - 6.0,
            at + 4.0
        ));
    }
    let middle = 0.5 * (x0 + x1);
    add(format!(
        "<text x=\"{middle:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{}</text>",
        height - 8.0,
        x.label
    ));
    let middle = 0.5 * (y0 + y1);
    add(format!(
        "<text transform=\"translate(14 {middle:.1}) rotate(-90)\" text-anchor=\"middle\">{}</text>",
        y.label
    ));
    for (i, (s, colour)) in series.iter().zip(COLOURS).enumerate() {
        if s.dots {
            for [u, v] in &s.points {
                add(format!(
                    "<circle cx=\"{:.1}\" cy=\"{:.1}\" r=\"3\" fill=\"{colour}\"/>",
                    px(*u),
                    py(*v)
                ));
            }
        } else {
            let places: Vec<String> =
                s.points.iter().map(|[u, v]| format!("{:.1} {:.1}", px(*u), py(*v))).collect();
            add(format!(
                "<path d=\"M{}\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"1.4\"/>",
                places.join("L")
            ));
        }
        let at = top + 16.0 + 16.0 * i as f64;
        add(format!(
            "<text x=\"{:.1}\" y=\"{at:.1}\" text-anchor=\"end\" fill=\"{colour}\">{}</text>",
            x1 - 8.0,
            s.name
        ));
    }
    svg.push_str("</svg>\n");
    svg
}
