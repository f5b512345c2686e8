//! Pictures as SVG text: maps with a section through them, and spectra.
//!
//! x to the right, y upwards, axes in mm. A map is drawn in cells of equal height bands; where it has
//! more pixels than the picture can show, a cell is the mean of its pixels. Invalid pixels are white.

use std::fmt::Write;

use ndarray::{Array2, s};
use planish_numerics::ticks::round_numbers;
use planish_types::{
    Axis, Grid,
    text::{escaped, fixed},
};

use crate::psd::Psd;

/// Width of a drawing area, px of the picture.
const WIDTH: f64 = 560.0;

/// Height of the area of a section or of spectra, px.
const HEIGHT: f64 = 260.0;

/// Left, top, right and bottom of an area, px.
const MARGIN: [f64; 4] = [64.0, 34.0, 86.0, 50.0];

/// Most cells along an axis of a map.
const MAX_CELLS: usize = 110;

/// Height bands of a map.
const BANDS: usize = 24;

/// Equal steps through a map of colours that ascends in lightness (viridis).
const COLOURS: [[u8; 3]; 9] = [
    [68, 1, 84],
    [71, 45, 123],
    [59, 82, 139],
    [44, 114, 142],
    [33, 145, 140],
    [40, 174, 128],
    [94, 201, 98],
    [173, 220, 48],
    [253, 231, 37],
];

/// Colours of lines that people who see fewer colours tell apart.
const LINES: [&str; 5] = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#000000"];

/// A map to draw.
#[derive(Clone, Debug)]
pub struct Panel {
    /// Above the map.
    pub title: String,
    /// Its pixels.
    pub grid: Grid,
    /// Its heights (ny, nx); NaN = invalid.
    pub map: Array2<f64>,
}

/// What goes beside the maps.
#[derive(Clone, Debug)]
pub struct MapsSettings {
    /// Unit of the heights, for the scales.
    pub unit: &'static str,
    /// y of the section, mm; `None` takes the middle of the first map.
    pub section_y_mm: Option<f64>,
    /// One colour scale for all maps.
    pub common_scale: bool,
    /// A map whose valid pixels are outlined in all.
    pub outline: Option<Panel>,
}

/// The maps one after the other, and below them one section through all.
pub fn maps_svg(panels: &[Panel], settings: &MapsSettings) -> String {
    let Some(first) = panels.first() else { return String::new() };
    let y_mm =
        settings.section_y_mm.unwrap_or(0.5 * (first.grid.y.start_mm() + first.grid.y.end_mm()));
    let all = panels.iter().map(|p| range(p.map.iter()));
    let common = all.fold(NOTHING, |a, b| [a[0].min(b[0]), a[1].max(b[1])]);
    let x_mm = panels.iter().fold(NOTHING, |i, p| {
        let [low, high] = edges(&p.grid.x);
        [i[0].min(low), i[1].max(high)]
    });
    // Flat maps stand one below the other, others in two columns.
    let tallest = panels.iter().map(|p| ratio(&p.grid)).fold(0.0, f64::max);
    let columns = if tallest > 0.45 && panels.len() > 1 { 2 } else { 1 };
    let cell = [WIDTH + MARGIN[0] + MARGIN[2], WIDTH * tallest + MARGIN[1] + MARGIN[3]];
    let mut out = String::new();
    for (k, panel) in panels.iter().enumerate() {
        let corner = [(k % columns) as f64 * cell[0], (k / columns) as f64 * cell[1]];
        let scale = if settings.common_scale { common } else { range(panel.map.iter()) };
        map(&mut out, panel, corner, scale, settings, y_mm);
    }
    let top = panels.len().div_ceil(columns) as f64 * cell[1];
    let lines: Vec<Line> = panels.iter().filter_map(|p| section(p, y_mm)).collect();
    let heights = lines.iter().flat_map(|l| l.points.iter().flatten().map(|p| p[1]));
    let area = Area {
        left: MARGIN[0],
        top: top + MARGIN[1],
        width: cell[0] * columns as f64 - MARGIN[0] - MARGIN[2],
        height: HEIGHT,
        x: x_mm,
        y: widened(heights.fold(NOTHING, |i, v| [i[0].min(v), i[1].max(v)])),
    };
    area.linear_axes(&mut out, "x (mm)", &format!("section ({})", settings.unit));
    if let Some(outline) = &settings.outline {
        let ends = section(outline, y_mm).into_iter().flat_map(|l| l.points.into_iter().flatten());
        let [low, high] = ends.fold(NOTHING, |i, p| [i[0].min(p[0]), i[1].max(p[0])]);
        for x in [low, high].into_iter().filter(|x| x.is_finite()) {
            let [x, top] = area.at([x, area.y[1]]);
            put(
                &mut out,
                format_args!(
                    "<path stroke=\"#888888\" stroke-dasharray=\"5 4\" d=\"M{x:.1} {top:.1}v{:.1}\"/>\n",
                    area.height
                ),
            );
        }
    }
    area.lines(&mut out, &lines);
    let title = format!("section at y = {} mm", fixed(y_mm, 3));
    text(&mut out, area.left, area.top - 10.0, "start", &title);
    document(cell[0] * columns as f64, top + HEIGHT + MARGIN[1] + MARGIN[3], &out)
}

/// The spectra along x and y, and the radial one, on logarithmic axes.
pub fn psd_svg(psd: &Psd) -> String {
    let mut out = String::new();
    let along = |name: &str, f: &[f64], s: &[f64]| Line {
        name: name.into(),
        points: vec![
            // The first bin holds the mean; a logarithm needs a positive value.
            f.iter().zip(s).skip(1).filter(|(_, s)| **s > 0.0).map(|(f, s)| [*f, *s]).collect(),
        ],
    };
    let lines = [
        along("along x", &psd.frequency_x_per_mm, &psd.psd_x_nm2_mm),
        along("along y", &psd.frequency_y_per_mm, &psd.psd_y_nm2_mm),
    ];
    let radial = [along("radial mean", &psd.frequency_radial_per_mm, &psd.psd_radial_nm2_mm2)];
    let total = WIDTH + MARGIN[0] + MARGIN[2];
    for (k, (lines, unit)) in
        [(&lines[..], "nm^2 mm"), (&radial[..], "nm^2 mm^2")].iter().enumerate()
    {
        let points = || lines.iter().flat_map(|l| l.points.iter().flatten());
        let over = |axis: usize| {
            points().map(|p| p[axis].log10()).fold(NOTHING, |i, v| [i[0].min(v), i[1].max(v)])
        };
        let area = Area {
            left: MARGIN[0] + k as f64 * total,
            top: MARGIN[1],
            width: WIDTH,
            height: 1.4 * HEIGHT,
            x: widened(over(0)),
            y: widened(over(1)),
        };
        area.logarithmic_axes(&mut out, "spatial frequency (1/mm)", &format!("PSD ({unit})"));
        let logarithms = |l: &Line| Line {
            name: l.name.clone(),
            points: l
                .points
                .iter()
                .map(|p| p.iter().map(|q| q.map(f64::log10)).collect())
                .collect(),
        };
        area.lines(&mut out, &lines.iter().map(logarithms).collect::<Vec<_>>());
        let title = if k == 0 { "one-sided, along lines" } else { "two-dimensional" };
        text(&mut out, area.left, area.top - 10.0, "start", title);
    }
    document(2.0 * total, 1.4 * HEIGHT + MARGIN[1] + MARGIN[3], &out)
}

/// The range of no value.
const NOTHING: [f64; 2] = [f64::INFINITY, f64::NEG_INFINITY];

fn range<'a>(values: impl Iterator<Item = &'a f64>) -> [f64; 2] {
    values.filter(|v| !v.is_nan()).fold(NOTHING, |i, v| [i[0].min(*v), i[1].max(*v)])
}

/// With a rim of 4 %, or of 1 about a single value; 0 .. 1 for none.
fn widened([low, high]: [f64; 2]) -> [f64; 2] {
    match high - low {
        d if d > 0.0 => [low - 0.04 * d, high + 0.04 * d],
        0.0 => [low - 1.0, high + 1.0],
        _ => [0.0, 1.0],
    }
}

/// Outer edges of the first and the last pixel.
fn edges(axis: &Axis) -> [f64; 2] {
    [axis.start_mm() - 0.5 * axis.step_mm(), axis.end_mm() + 0.5 * axis.step_mm()]
}

/// Height over width of a drawing: that of the map, unless the map is a strip so narrow that the
/// drawing would have no height, or more than a page of it.
fn ratio(grid: &Grid) -> f64 {
    let length = |axis: &Axis| axis.len() as f64 * axis.step_mm();
    (length(&grid.y) / length(&grid.x)).clamp(0.08, 2.0)
}

/// Means over blocks of pixels, few enough to draw; NaN where most are invalid.
fn cells(map: &Array2<f64>) -> (Array2<f64>, usize) {
    let (ny, nx) = map.dim();
    let block = nx.max(ny).div_ceil(MAX_CELLS);
    let shape = (ny.div_ceil(block), nx.div_ceil(block));
    let mean = |(r, c): (usize, usize)| {
        let rows = r * block..((r + 1) * block).min(ny);
        let part = map.slice(s![rows, c * block..((c + 1) * block).min(nx)]);
        let valid = || part.iter().filter(|v| !v.is_nan());
        let count = valid().count();
        if 2 * count < part.len() { f64::NAN } else { valid().sum::<f64>() / count as f64 }
    };
    (Array2::from_shape_fn(shape, mean), block)
}

fn map(
    out: &mut String,
    panel: &Panel,
    corner: [f64; 2],
    scale: [f64; 2],
    settings: &MapsSettings,
    section_y_mm: f64,
) {
    let area = Area {
        left: corner[0] + MARGIN[0],
        top: corner[1] + MARGIN[1],
        width: WIDTH,
        height: WIDTH * ratio(&panel.grid),
        x: edges(&panel.grid.x),
        y: edges(&panel.grid.y),
    };
    let (cells, block) = cells(&panel.map);
    let band = |v: f64| {
        let t = if scale[1] > scale[0] { (v - scale[0]) / (scale[1] - scale[0]) } else { 0.5 };
        ((t * BANDS as f64) as usize).min(BANDS - 1)
    };
    // One path for every band: a rectangle for every run of cells in it, in pixels of the map.
    let (ny, nx) = panel.map.dim();
    let edge = |k: usize, n: usize| (k * block).min(n);
    let mut paths = vec![String::new(); BANDS];
    for (r, row) in cells.outer_iter().enumerate() {
        let (y, height) = (edge(r, ny), edge(r + 1, ny) - edge(r, ny));
        let mut c = 0;
        while c < row.len() {
            let start = c;
            let this = (!row[c].is_nan()).then(|| band(row[c]));
            while c < row.len() && (!row[c].is_nan()).then(|| band(row[c])) == this {
                c += 1;
            }
            if let Some(k) = this {
                let (x, width) = (edge(start, nx), edge(c, nx) - edge(start, nx));
                put(&mut paths[k], format_args!("M{x} {y}h{width}v{height}h-{width}"));
            }
        }
    }
    put(
        out,
        format_args!(
            "<g shape-rendering=\"crispEdges\" transform=\"translate({:.2} {:.2}) scale({:.6} {:.6})\">\n",
            area.left,
            area.top + area.height,
            area.width / nx as f64,
            -area.height / ny as f64
        ),
    );
    for (k, path) in paths.iter().enumerate().filter(|(_, p)| !p.is_empty()) {
        put(out, format_args!("<path fill=\"{}\" d=\"{path}\"/>\n", colour(k)));
    }
    out.push_str("</g>\n");
    if let Some(outline) = &settings.outline {
        area.outline(out, outline);
    }
    area.linear_axes(out, "x (mm)", "y (mm)");
    let [right, y] = area.at([area.x[1], section_y_mm]);
    put(
        out,
        format_args!(
            "<path stroke=\"#000000\" stroke-width=\"2\" d=\"M{:.1} {y:.1}h-8M{right:.1} {y:.1}h8\"/>\n",
            area.left
        ),
    );
    colour_bar(out, &area, scale, settings.unit);
    text(out, area.left, area.top - 10.0, "start", &panel.title);
}

/// A strip of the colours right of the map with the ends of the scale.
fn colour_bar(out: &mut String, area: &Area, scale: [f64; 2], unit: &str) {
    let (left, step) = (area.left + area.width + 14.0, area.height / BANDS as f64);
    for k in 0..BANDS {
        let top = area.top + area.height - (k + 1) as f64 * step;
        put(
            out,
            format_args!(
                "<rect x=\"{left:.1}\" y=\"{top:.2}\" width=\"12\" height=\"{:.2}\" fill=\"{}\"/>\n",
                step + 0.3,
                colour(k)
            ),
        );
    }
    let digits = |v: f64| fixed(v, if scale[1] - scale[0] < 10.0 { 2 } else { 1 });
    text(out, left + 16.0, area.top + 11.0, "start", &digits(scale[1]));
    text(out, left + 16.0, area.top + 27.0, "start", unit);
    text(out, left + 16.0, area.top + area.height, "start", &digits(scale[0]));
}

fn colour(band: usize) -> String {
    let at = (band as f64 + 0.5) / BANDS as f64 * (COLOURS.len() - 1) as f64;
    let (k, f) = (at as usize, at.fract());
    let [low, high] = [COLOURS[k], COLOURS[k + 1]];
    let mix =
        |i: usize| (f64::from(low[i]) + f * (f64::from(high[i]) - f64::from(low[i]))).round() as u8;
    format!("#{:02x}{:02x}{:02x}", mix(0), mix(1), mix(2))
}

/// Pieces of a line in the units of the axes.
struct Line {
    name: String,
    points: Vec<Vec<[f64; 2]>>,
}

/// The row of the map nearest to `y_mm`, cut where it is invalid; `None` beyond the map.
fn section(panel: &Panel, y_mm: f64) -> Option<Line> {
    let [low, high] = edges(&panel.grid.y);
    if !(low..=high).contains(&y_mm) {
        return None;
    }
    let axis = &panel.grid.y;
    let row = ((y_mm - axis.start_mm()) / axis.step_mm()).round() as usize;
    let mut points = vec![Vec::new()];
    for (c, v) in panel.map.row(row.min(axis.len() - 1)).iter().enumerate() {
        if v.is_nan() {
            points.push(Vec::new());
        } else if let Some(piece) = points.last_mut() {
            piece.push([panel.grid.x.at(c), *v]);
        }
    }
    points.retain(|piece| !piece.is_empty());
    Some(Line { name: panel.title.clone(), points })
}

/// A rectangle of the picture with its axes.
struct Area {
    left: f64,
    top: f64,
    width: f64,
    height: f64,
    x: [f64; 2],
    y: [f64; 2],
}

impl Area {
    fn at(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        [
            self.left + (x - self.x[0]) / (self.x[1] - self.x[0]) * self.width,
            self.top + (self.y[1] - y) / (self.y[1] - self.y[0]) * self.height,
        ]
    }

    fn linear_axes(&self, out: &mut String, x_name: &str, y_name: &str) {
        let fewer = |[low, high]: [f64; 2], px: f64| round_numbers(low, high, (px / 45.0).max(2.0));
        let label = |v: &f64| (*v, v.to_string());
        let x: Vec<_> = fewer(self.x, self.width).iter().map(label).collect();
        let y: Vec<_> = fewer(self.y, self.height).iter().map(label).collect();
        self.axes(out, (&x, x_name), (&y, y_name));
    }

    fn logarithmic_axes(&self, out: &mut String, x_name: &str, y_name: &str) {
        let decades = |[low, high]: [f64; 2]| -> Vec<(f64, String)> {
            let all = (low.ceil() as i32)..=(high.floor() as i32);
            let every = all.clone().count().div_ceil(8).max(1);
            all.step_by(every).map(|k| (f64::from(k), format!("1e{k}"))).collect()
        };
        self.axes(out, (&decades(self.x), x_name), (&decades(self.y), y_name));
    }

    fn axes(
        &self,
        out: &mut String,
        (x_ticks, x_name): (&[(f64, String)], &str),
        (y_ticks, y_name): (&[(f64, String)], &str),
    ) {
        let (bottom, left) = (self.top + self.height, self.left);
        put(
            out,
            format_args!(
                "<rect x=\"{left:.1}\" y=\"{:.1}\" width=\"{:.1}\" height=\"{:.1}\" fill=\"none\" \
                 stroke=\"#000000\"/>\n",
                self.top, self.width, self.height
            ),
        );
        for (v, label) in x_ticks {
            let x = self.at([*v, self.y[0]])[0];
            put(out, format_args!("<path stroke=\"#000000\" d=\"M{x:.1} {bottom:.1}v5\"/>\n"));
            text(out, x, bottom + 19.0, "middle", label);
        }
        for (v, label) in y_ticks {
            let y = self.at([self.x[0], *v])[1];
            put(out, format_args!("<path stroke=\"#000000\" d=\"M{left:.1} {y:.1}h-5\"/>\n"));
            text(out, left - 8.0, y + 5.0, "end", label);
        }
        text(out, left + 0.5 * self.width, bottom + 38.0, "middle", x_name);
        put(
            out,
            format_args!(
                "<text transform=\"translate({:.1} {:.1}) rotate(-90)\" \
                 text-anchor=\"middle\">{y_name}</text>\n",
                left - 46.0,
                self.top + 0.5 * self.height
            ),
        );
    }

    fn lines(&self, out: &mut String, lines: &[Line]) {
        for (k, line) in lines.iter().enumerate() {
            let colour = LINES[k % LINES.len()];
            if line.points.is_empty() {
                continue;
            }
            put(
                out,
                format_args!("<path fill=\"none\" stroke=\"{colour}\" stroke-width=\"1.5\" d=\""),
            );
            for piece in &line.points {
                for (i, p) in piece.iter().enumerate() {
                    let [x, y] = self.at(*p);
                    put(out, format_args!("{}{x:.1} {y:.1}", if i == 0 { "M" } else { "L" }));
                }
            }
            out.push_str("\"/>\n");
        }
        // The names above the area, in the colours of their lines.
        if lines.len() > 1 {
            let (right, y) = (self.left + self.width, self.top - 10.0);
            put(out, format_args!("<text x=\"{right:.1}\" y=\"{y:.1}\" text-anchor=\"end\">"));
            for (k, line) in lines.iter().enumerate() {
                let (colour, name) = (LINES[k % LINES.len()], escaped(&line.name));
                put(out, format_args!("<tspan dx=\"14\" fill=\"{colour}\">{name}</tspan>"));
            }
            out.push_str("</text>\n");
        }
    }

    /// The edges between valid and invalid pixels of `map`.
    fn outline(&self, out: &mut String, panel: &Panel) {
        let (ny, nx) = panel.map.dim();
        let (x, y) = (&panel.grid.x, &panel.grid.y);
        let valid = |r: isize, c: isize| {
            (0..ny as isize).contains(&r)
                && (0..nx as isize).contains(&c)
                && !panel.map[[r as usize, c as usize]].is_nan()
        };
        let (hx, hy) = (0.5 * x.step_mm(), 0.5 * y.step_mm());
        out.push_str("<path fill=\"none\" stroke=\"#ffffff\" stroke-width=\"1.5\" d=\"");
        for r in 0..=ny as isize {
            for c in 0..=nx as isize {
                let (left, below) = (
                    x.start_mm() + c as f64 * x.step_mm() - hx,
                    y.start_mm() + r as f64 * y.step_mm() - hy,
                );
                let [px, py] = self.at([left, below]);
                if valid(r, c) != valid(r, c - 1) {
                    let end = self.at([left, below + 2.0 * hy])[1];
                    put(out, format_args!("M{px:.1} {py:.1}V{end:.1}"));
                }
                if valid(r, c) != valid(r - 1, c) {
                    let end = self.at([left + 2.0 * hx, below])[0];
                    put(out, format_args!("M{px:.1} {py:.1}H{end:.1}"));
                }
            }
        }
        out.push_str("\"/>\n");
    }
}

fn text(out: &mut String, x: f64, y: f64, anchor: &str, words: &str) {
    put(
        out,
        format_args!(
            "<text x=\"{x:.1}\" y=\"{y:.1}\" text-anchor=\"{anchor}\">{}</text>\n",
            escaped(words)
        ),
    );
}

fn document(width: f64, height: f64, content: &str) -> String {
    format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width:.0}\" height=\"{height:.0}\" \
         viewBox=\"0 0 {width:.0} {height:.0}\" font-family=\"sans-serif\" font-size=\"14\">\n\
         <rect width=\"100%\" height=\"100%\" fill=\"#ffffff\"/>\n{content}</svg>\n"
    )
}

/// Writing to a string does not fail.
fn put(out: &mut String, words: std::fmt::Arguments) {
    let _ = out.write_fmt(words);
}

#[cfg(test)]
mod tests {
    use super::*;

    fn panel(title: &str, nx: usize, ny: usize, f: impl Fn(usize, usize) -> f64) -> Panel {
        let grid =
            Grid { x: Axis::new(0.0, 1.0, nx).unwrap(), y: Axis::new(0.0, 1.0, ny).unwrap() };
        let map = Array2::from_shape_fn((ny, nx), |(r, c)| f(r, c));
        Panel { title: title.into(), grid, map }
    }

    fn settings() -> MapsSettings {
        MapsSettings { unit: "nm", section_y_mm: None, common_scale: false, outline: None }
    }

    #[test]
    fn y_goes_up_and_higher_is_lighter() {
        // Two rows of 2 px: the lower one is dark.
        let svg = maps_svg(&[panel("a < b", 2, 2, |r, _| r as f64)], &settings());
        let dark = format!("<path fill=\"{}\" d=\"M0 0h2v1h-2\"/>", colour(0));
        let light = format!("<path fill=\"{}\" d=\"M0 1h2v1h-2\"/>", colour(BANDS - 1));
        assert!(svg.contains(&dark) && svg.contains(&light), "{svg}");
        // From the lower left corner upwards.
        assert!(svg.contains("translate(64.00 594.00) scale(280.000000 -280.000000)"), "{svg}");
        assert!(svg.contains("a &lt; b"));
    }

    #[test]
    fn invalid_pixels_are_not_drawn_and_cut_the_section() {
        let hole = |r: usize, c: usize| if (r, c) == (1, 2) { f64::NAN } else { c as f64 };
        let svg = maps_svg(&[panel("hole", 6, 3, hole)], &settings());
        let line = svg.split("stroke-width=\"1.5\" d=\"").nth(1).unwrap();
        assert_eq!(line.split('"').next().unwrap().matches('M').count(), 2, "{svg}");
        let drawn = svg.split("crispEdges").nth(1).unwrap().split("</g>").next().unwrap();
        // Six columns in three rows, less one.
        assert_eq!(drawn.matches('M').count(), 17);
    }

    #[test]
    fn a_large_map_is_drawn_in_few_cells_by_their_mean() {
        let (cells, block) = cells(&panel("", 400, 301, |r, c| ((r + c) % 2) as f64).map);
        assert_eq!((cells.dim(), block), ((76, 100), 4));
        assert!(cells.iter().all(|v| *v == 0.5));
    }

    #[test]
    fn colours_get_lighter() {
        let light = |k: usize| {
            let c = u32::from_str_radix(&colour(k)[1..], 16).unwrap();
            (c >> 16) * 3 + ((c >> 8) & 255) * 6 + (c & 255)
        };
        assert!((1..BANDS).all(|k| light(k) > light(k - 1)));
    }
}
