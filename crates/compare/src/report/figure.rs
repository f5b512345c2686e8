//! Figures as SVG, for papers and slides: axes with units, colours that people who see fewer of
//! them can tell apart.

use std::fmt::Write;

use planish_numerics::ticks::round_numbers;
use planish_types::text::escaped;
use rayon::prelude::*;

use super::{MethodView, View, map::ScreenMap};
use crate::summary::IDEAL;

/// Blue, white, brown: heights below and above their mean.
pub const HEIGHT_COLOURS: [&str; 7] =
    ["#053061", "#3a7db8", "#a6cde3", "#f7f7f7", "#f0b573", "#bd6a11", "#5c2f04"];

/// Dark to light: speeds and times, from none to the largest.
pub const SPEED_COLOURS: [&str; 6] =
    ["#440154", "#414487", "#2a788e", "#22a884", "#7ad151", "#e8d71f"];

/// Steps of a colour scale in a picture of lines.
const BINS: usize = 24;

/// Largest number of points of a line in a picture.
const MAX_POINTS: usize = 20_000;

/// Differences below this fraction of the values are their rounding.
const FLAT: f64 = 1e-12;

/// Columns of a picture of ranges.
const COLUMNS: usize = 900;

/// Colours of the axes x and y, and of maps before and after.
const AXIS_COLOURS: [&str; 2] = ["#0072b2", "#d55e00"];
const LINE_COLOURS: [&str; 7] =
    ["#000000", "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#b8860b"];

/// The figures of a report: file name and SVG; only those that have something to show.
pub fn figures(views: &[View]) -> Vec<(&'static str, String)> {
    type Figure = fn(&[View]) -> Option<String>;
    let figures: [(&str, Figure); 7] = [
        ("maps.svg", maps),
        ("path.svg", path),
        ("motion.svg", motion),
        ("dwell.svg", dwell),
        ("histogram.svg", |views| Some(histograms(views))),
        ("spectrum.svg", |views| Some(spectra(views))),
        ("refinement.svg", refinement),
    ];
    figures.into_par_iter().filter_map(|(name, figure)| Some((name, figure(views)?))).collect()
}

// ---------------------------------------------------------------------------------------------
// The figures

/// Rows: methods. Columns: desired removal, predicted removal and residual on one scale, and the
/// residual on its own.
fn maps(views: &[View]) -> Option<String> {
    methods(views).next()?;
    let mut sheet = Sheet::new(4, 300.0, aspect(&views.first()?.desired).clamp(0.15, 2.0) * 300.0);
    let mut panels = Vec::new();
    for view in views {
        let common = scale_of(&view.desired);
        for m in &view.methods {
            let own = scale_of(&m.residual);
            let of = label(views, view, m);
            panels.extend([
                (&view.desired, common, "desired removal".to_string()),
                (&m.removal, common, format!("predicted removal, {of}")),
                (&m.residual, common, format!("residual, {of}")),
                (&m.residual, own, format!("residual, {of}, own scale")),
            ]);
        }
    }
    let images: Vec<_> = panels.par_iter().map(|(map, scale, _)| png_of(map, *scale)).collect();
    for ((map, scale, title), image) in panels.iter().zip(images) {
        let (x, y) = extent(map);
        let mut panel = sheet.panel(x, y, ["x (mm)", "y (mm)"], title);
        panel.image(&image, x, y);
        panel.axes();
        panel.colour_bar(&HEIGHT_COLOURS, [-scale, *scale], "nm from the mean");
        sheet.add(panel);
    }
    Some(sheet.finish())
}

fn path(views: &[View]) -> Option<String> {
    methods(views).next()?;
    let shape = aspect(&views.first()?.desired).clamp(0.15, 1.2);
    let mut sheet = Sheet::new(1, 900.0, 900.0 * shape);
    for (view, m) in methods(views) {
        let line = &m.line;
        let speeds: Vec<f64> =
            line.speed_mm_per_s.iter().copied().filter(|v| v.is_finite()).collect();
        let top = match quantile(&speeds, 0.99) {
            0.0 => 1.0,
            top => top,
        };
        let axis = |a: usize| bounds(line.point_mm.iter().map(|p| p[a]));
        let (x, y) = same_scale(axis(0), axis(1), shape);
        let title = format!("path, {}", label(views, view, m));
        let mut panel = sheet.panel(x, y, ["x (mm)", "y (mm)"], &title);
        let every = line.point_mm.len().div_ceil(MAX_POINTS);
        let kept: Vec<usize> = (0..line.point_mm.len()).step_by(every).collect();
        let mut bins = vec![String::new(); BINS + 1];
        for pair in kept.windows(2) {
            let jump = (pair[0] + 1..=pair[1]).any(|i| line.speed_mm_per_s[i].is_nan());
            let fraction = line.speed_mm_per_s[pair[1]] / top * BINS as f64;
            let bin = if jump { BINS } else { (fraction as usize).min(BINS - 1) };
            let [a, b] = [pair[0], pair[1]].map(|i| panel.at(line.point_mm[i]));
            let _ = write!(bins[bin], "M{:.1} {:.1}L{:.1} {:.1}", a[0], a[1], b[0], b[1]);
        }
        for (i, d) in bins.iter().enumerate().filter(|(_, d)| !d.is_empty()) {
            let (colour, more) = match i {
                BINS => ("#888888".to_string(), " stroke-dasharray=\"2 3\" stroke-opacity=\"0.5\""),
                _ => (colour_at(&SPEED_COLOURS, (i as f64 + 0.5) / BINS as f64), ""),
            };
            panel.put(format_args!(
                "<path d=\"{d}\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"1\"{more}/>"
            ));
        }
        panel.axes();
        panel.colour_bar(&SPEED_COLOURS, [0.0, top], "mm/s (99 % are below the top)");
        sheet.add(panel);
    }
    Some(sheet.finish())
}

fn motion(views: &[View]) -> Option<String> {
    methods(views).next()?;
    let mut sheet = Sheet::new(3, 420.0, 240.0);
    for (view, m) in methods(views) {
        let ends = &m.ranges.end_s;
        let time = (0.0, *ends.last()?);
        let names = ["velocity (mm/s)", "acceleration (mm/s^2)", "jerk (mm/s^3)"];
        let keys = super::QUANTITIES.map(|(key, _)| key);
        for ((envelopes, name), key) in m.ranges.envelope.iter().zip(names).zip(keys) {
            let values = envelopes.iter().flat_map(|e| e.low.iter().chain(&e.high)).copied();
            let (low, high) = bounds(values);
            let reach = match low.abs().max(high.abs()) {
                0.0 => 1.0,
                reach => reach,
            };
            let limits =
                [0, 1].map(|a| m.verdict["axes"][a][key]["limit"].as_f64().unwrap_or(f64::NAN));
            let far = |l: f64| l > 3.0 * reach;
            let shown = limits.iter().copied().filter(|l| !far(*l)).fold(reach, f64::max);
            let title = format!("{}, {}", label(views, view, m), name);
            let range = (-1.05 * shown, 1.05 * shown);
            let mut panel = sheet.panel(time, range, ["time (s)", name], &title);
            let mut notes = vec![];
            for (axis, envelope) in envelopes.iter().enumerate() {
                let columns = columns(ends, envelope, time.1);
                let mut d = String::new();
                for (x, low, high) in &columns {
                    let [px, bottom] = panel.at([*x, *low]);
                    let top = panel.at([*x, *high])[1];
                    let _ = write!(d, "M{px:.1} {bottom:.1}V{:.1}", top.min(bottom - 0.7));
                }
                let colour = AXIS_COLOURS[axis];
                panel.put(format_args!(
                    "<path d=\"{d}\" fill=\"none\" stroke=\"{colour}\" stroke-opacity=\"0.75\"/>"
                ));
                let limit = limits[axis];
                let axis_name = ["x", "y"][axis];
                if limit.is_finite() && !far(limit) {
                    for l in [-limit, limit] {
                        let [[x0, y], [x1, _]] = [panel.at([time.0, l]), panel.at([time.1, l])];
                        panel.put(format_args!(
                            "<path d=\"M{x0:.1} {y:.1}H{x1:.1}\" stroke=\"{colour}\" \
                             stroke-dasharray=\"7 4\"/>"
                        ));
                    }
                    notes.push(format!("{axis_name} limit {}", short(limit)));
                } else if limit.is_finite() {
                    notes.push(format!("{axis_name} limit {} beyond the axis", short(limit)));
                }
            }
            panel.legend(&[("x", AXIS_COLOURS[0]), ("y", AXIS_COLOURS[1])]);
            panel.note(&notes.join(", "));
            panel.axes();
            sheet.add(panel);
        }
    }
    Some(sheet.finish())
}

fn dwell(views: &[View]) -> Option<String> {
    let shape = aspect(&views.first()?.desired).clamp(0.15, 1.2);
    let mut sheet = Sheet::new(2, 520.0, 520.0 * shape);
    let mut any = false;
    for (view, m) in methods(views) {
        let Some(d) = &m.dwell else { continue };
        any = true;
        let error: Vec<f64> = d.executed_s.iter().zip(&d.planned_s).map(|(e, p)| e - p).collect();
        let gap = |p: &[[f64; 2]]| (p[1][0] - p[0][0]).hypot(p[1][1] - p[0][1]);
        let gap_mm = quantile(&d.point_mm.windows(2).map(gap).collect::<Vec<_>>(), 0.5);
        let top = match quantile(&d.planned_s, 0.99) {
            0.0 => 1.0,
            top => top,
        };
        let reach = error.iter().fold(1e-6_f64, |m, e| m.max(e.abs()));
        let axis = |a: usize| bounds(d.point_mm.iter().map(|p| p[a]));
        let (x, y) = same_scale(axis(0), axis(1), shape);
        let of = label(views, view, m);
        for (values, range, colours, title) in [
            (&d.planned_s, [0.0, top], &SPEED_COLOURS[..], format!("dwell time, {of}")),
            (&error, [-reach, reach], &HEIGHT_COLOURS[..], format!("executed - planned, {of}")),
        ] {
            let mut panel = sheet.panel(x, y, ["x (mm)", "y (mm)"], &title);
            // A square as large as its fraction of the picture, and no gap to the next one on the path.
            let px_per_mm = panel.at([1.0, 0.0])[0] - panel.at([0.0, 0.0])[0];
            let fraction = (260_000.0 / d.point_mm.len() as f64).sqrt().clamp(1.0, 5.0);
            let side = fraction.max(1.1 * (px_per_mm * gap_mm).min(10.0));
            let mut bins = vec![String::new(); BINS];
            for (p, v) in d.point_mm.iter().zip(values) {
                let fraction = (v - range[0]) / (range[1] - range[0]) * BINS as f64;
                let [px, py] = panel.at(*p);
                let bin = (fraction.max(0.0) as usize).min(BINS - 1);
                let _ = write!(bins[bin], "M{:.1} {py:.1}h{side:.1}", px - 0.5 * side);
            }
            for (i, path) in bins.iter().enumerate().filter(|(_, d)| !d.is_empty()) {
                let colour = colour_at(colours, (i as f64 + 0.5) / BINS as f64);
                panel.put(format_args!(
                    "<path d=\"{path}\" stroke=\"{colour}\" stroke-width=\"{side:.1}\"/>"
                ));
            }
            panel.axes();
            panel.colour_bar(colours, range, "s");
            sheet.add(panel);
        }
    }
    any.then(|| sheet.finish())
}

fn histograms(views: &[View]) -> String {
    let mut sheet = Sheet::new(1, 760.0, 380.0);
    for view in views {
        let mut curves = vec![("before".to_string(), &view.before.0)];
        curves.extend(view.methods.iter().map(|m| (m.name.clone(), &m.after.0)));
        let high =
            curves.iter().flat_map(|(_, h)| &h.density_per_nm).fold(0.0_f64, |m, v| m.max(*v));
        let low = high * 1e-5;
        let x = curves.iter().fold(0.0_f64, |m, (_, h)| m.max(-h.low_nm));
        let labels = ["height from the mean (nm)", "fraction of the pixels (1/nm)"];
        let mut panel =
            sheet.log_panel([false, true], (-x, x), (low, high * 2.0), labels, &title(views, view));
        for (i, (_, h)) in curves.iter().enumerate() {
            let points = h
                .density_per_nm
                .iter()
                .enumerate()
                .map(|(k, v)| [h.low_nm + (k as f64 + 0.5) * h.width_nm, v.max(low)]);
            panel.curve(points, LINE_COLOURS[i % LINE_COLOURS.len()]);
        }
        panel.legend_of(&curves.iter().map(|(n, _)| n.as_str()).collect::<Vec<_>>());
        panel.axes();
        sheet.add(panel);
    }
    sheet.finish()
}

fn spectra(views: &[View]) -> String {
    let mut sheet = Sheet::new(1, 760.0, 420.0);
    for view in views {
        let mut curves = vec![("before".to_string(), &view.before.1)];
        curves.extend(view.methods.iter().map(|m| (m.name.clone(), &m.after.1)));
        let positive = |f: fn(&super::Spectrum) -> &Vec<f64>| {
            let all = curves.iter().flat_map(move |(_, s)| f(s)).copied();
            let (low, high) = bounds(all.filter(|v| *v > 0.0));
            let low = if low > 0.0 { low } else { 1e-3 * high };
            if low < high { (low, high) } else { (0.5 * low, 2.0 * low) }
        };
        let x = positive(|s| &s.frequency_per_mm);
        let y = positive(|s| &s.psd_nm2_mm2);
        let y = (y.0.max(y.1 * 1e-10), y.1 * 2.0);
        let labels = ["spatial frequency (1/mm)", "PSD (nm^2 mm^2)"];
        let mut panel = sheet.log_panel([true, true], x, y, labels, &title(views, view));
        for period in super::BAND_PERIOD_MM {
            let f = 1.0 / period;
            if f > x.0 && f < x.1 {
                let [[px, top], [_, bottom]] = [panel.at([f, y.1]), panel.at([f, y.0])];
                panel.put(format_args!(
                    "<path d=\"M{px:.1} {top:.1}V{bottom:.1}\" stroke=\"#888888\" \
                     stroke-dasharray=\"3 3\"/><text x=\"{:.1}\" y=\"{:.1}\" font-size=\"12\" \
                     fill=\"#555555\">{period} mm</text>",
                    px + 4.0,
                    bottom - 6.0
                ));
            }
        }
        for (i, (_, s)) in curves.iter().enumerate() {
            let points = s.frequency_per_mm.iter().zip(&s.psd_nm2_mm2);
            let points = points.map(|(f, p)| [*f, p.max(y.0)]);
            panel.curve(points, LINE_COLOURS[i % LINE_COLOURS.len()]);
        }
        panel.legend_of(&curves.iter().map(|(n, _)| n.as_str()).collect::<Vec<_>>());
        panel.axes();
        sheet.add(panel);
    }
    sheet.finish()
}

fn refinement(views: &[View]) -> Option<String> {
    let mut sheet = Sheet::new(1, 600.0, 320.0);
    let mut any = false;
    for (view, m) in methods(views) {
        let Some(rounds) = m.rounds.as_ref().filter(|r| !r.rms_nm.is_empty()) else { continue };
        any = true;
        let last = (rounds.rms_nm.len() - 1).max(1) as f64;
        let (_, high) = bounds(rounds.rms_nm.iter().copied());
        let labels = ["round", "RMS of the executed residual (nm)"];
        let title = format!("refinement, {}", label(views, view, m));
        let mut panel = sheet.panel((0.0, last), (0.0, 1.05 * high.max(1e-12)), labels, &title);
        let points = rounds.rms_nm.iter().enumerate().map(|(i, v)| [i as f64, *v]);
        panel.curve(points.clone(), LINE_COLOURS[1]);
        for (i, p) in points.enumerate() {
            let [x, y] = panel.at(p);
            let fill = if rounds.best == Some(i as u64) { LINE_COLOURS[1] } else { "#ffffff" };
            panel.put(format_args!(
                "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"4\" fill=\"{fill}\" stroke=\"#0072b2\"/>"
            ));
        }
        panel.note("full dot: the round that was kept");
        panel.axes();
        sheet.add(panel);
    }
    any.then(|| sheet.finish())
}

// ---------------------------------------------------------------------------------------------
// What they are drawn from

fn methods(views: &[View]) -> impl Iterator<Item = (&View, &MethodView)> {
    views.iter().flat_map(|v| v.methods.iter().map(move |m| (v, m)))
}

fn label(views: &[View], view: &View, m: &MethodView) -> String {
    let run = if views.len() > 1 { format!("{} / ", view.name) } else { String::new() };
    // Nobody is to take it for a plan.
    let ideal = if m.name == IDEAL { " (ideal)" } else { "" };
    format!("{run}{}{ideal}", m.name)
}

fn title(views: &[View], view: &View) -> String {
    if views.len() > 1 { view.name.clone() } else { String::new() }
}

fn extent(map: &ScreenMap) -> ((f64, f64), (f64, f64)) {
    let of = |a: usize| {
        let low = map.start_mm[a] - 0.5 * map.step_mm[a];
        (low, low + map.size[a] as f64 * map.step_mm[a])
    };
    (of(0), of(1))
}

/// Height over width.
fn aspect(map: &ScreenMap) -> f64 {
    let (x, y) = extent(map);
    (y.1 - y.0) / (x.1 - x.0)
}

/// Largest distance from the mean; 1 nm for a map that is flat but for rounding.
fn scale_of(map: &ScreenMap) -> f64 {
    let [low, high] = map.range_nm;
    let reach = (high - map.mean_nm).max(map.mean_nm - low);
    if reach > FLAT * low.abs().max(high.abs()) { reach } else { 1.0 }
}

fn bounds(values: impl Iterator<Item = f64>) -> (f64, f64) {
    let (low, high) = values
        .filter(|v| v.is_finite())
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
    if low <= high { (low, high) } else { (0.0, 1.0) }
}

/// Grows the shorter range so that a mm is as long on both axes of a panel of this shape.
fn same_scale(x: (f64, f64), y: (f64, f64), shape: f64) -> ((f64, f64), (f64, f64)) {
    let (w, h) = (x.1 - x.0, y.1 - y.0);
    // A path that is one point, but for rounding, gets a frame of 1 mm.
    let far = [x.0, x.1, y.0, y.1].into_iter().fold(1.0, |m: f64, v| m.max(v.abs()));
    let (w, h) = if w.max(h) > FLAT * far { (w, h) } else { (1.0, 1.0) };
    let width = 1.04 * w.max(h / shape);
    let around = |r: (f64, f64), size: f64| {
        let middle = 0.5 * (r.0 + r.1);
        (middle - 0.5 * size, middle + 0.5 * size)
    };
    (around(x, width), around(y, width * shape))
}

/// The value below which this fraction of `values` is.
fn quantile(values: &[f64], fraction: f64) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted
        .get(((sorted.len() as f64 - 1.0) * fraction).round().max(0.0) as usize)
        .copied()
        .unwrap_or(1.0)
}

/// Ranges of equal parts of the time: (middle, smallest, largest).
fn columns(ends: &[f64], e: &super::motion::Envelope, total_s: f64) -> Vec<(f64, f64, f64)> {
    let mut found = vec![(f64::INFINITY, f64::NEG_INFINITY); COLUMNS];
    let column = |t: f64| ((t / total_s * COLUMNS as f64) as usize).min(COLUMNS - 1);
    let mut start = 0.0;
    for (i, end) in ends.iter().enumerate() {
        for c in column(start)..=column(*end) {
            found[c] = (found[c].0.min(e.low[i]), found[c].1.max(e.high[i]));
        }
        start = *end;
    }
    let middle = |c: usize| total_s * (c as f64 + 0.5) / COLUMNS as f64;
    found.iter().enumerate().map(|(c, (l, h))| (middle(c), *l, *h)).collect()
}

/// The colour at `fraction` (0 .. 1) of the way through `colours`.
fn colour_at(colours: &[&str], fraction: f64) -> String {
    let [r, g, b] = rgb_at(colours, fraction);
    format!("#{r:02x}{g:02x}{b:02x}")
}

fn rgb_at(colours: &[&str], fraction: f64) -> [u8; 3] {
    let at = fraction.clamp(0.0, 1.0) * (colours.len() - 1) as f64;
    let i = (at as usize).min(colours.len() - 2);
    let part = |text: &str, k: usize| {
        f64::from(u8::from_str_radix(&text[1 + 2 * k..3 + 2 * k], 16).unwrap_or(0))
    };
    [0, 1, 2].map(|k| {
        let (a, b) = (part(colours[i], k), part(colours[i + 1], k));
        (a + (b - a) * (at - i as f64)).round() as u8
    })
}

/// The map in colours, row 0 at the bottom; invalid pixels are clear.
fn png_of(map: &ScreenMap, scale: f64) -> Vec<u8> {
    let [nx, ny] = map.size;
    let mut palette = vec![255; 3];
    palette.extend((0..255).flat_map(|i| rgb_at(&HEIGHT_COLOURS, f64::from(i) / 254.0)));
    let fraction = |v: f64| ((v - map.mean_nm) / scale * 127.0 + 127.0).round().clamp(0.0, 254.0);
    let index = |v: f64| if v.is_nan() { 0 } else { 1 + fraction(v) as u8 };
    let rows = map.means_nm.outer_iter().rev();
    let pixels: Vec<u8> =
        rows.flat_map(|row| row.iter().map(|v| index(*v)).collect::<Vec<_>>()).collect();
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, nx as u32, ny as u32);
    encoder.set_color(png::ColorType::Indexed);
    encoder.set_depth(png::BitDepth::Eight);
    encoder.set_palette(palette);
    encoder.set_trns(vec![0_u8]);
    let mut writer = encoder.write_header().expect("writing to memory cannot fail");
    writer.write_image_data(&pixels).expect("the image has nx * ny pixels");
    writer.finish().expect("writing to memory cannot fail");
    bytes
}

// ---------------------------------------------------------------------------------------------
// SVG

/// Left, top, right, bottom of a panel, in pixels of the picture.
const MARGIN_PX: [f64; 4] = [80.0, 34.0, 96.0, 56.0];

/// Panels in rows.
struct Sheet {
    columns: usize,
    size_px: [f64; 2],
    count: usize,
    text: String,
}

impl Sheet {
    fn new(columns: usize, width_px: f64, height_px: f64) -> Self {
        Self { columns, size_px: [width_px, height_px], count: 0, text: String::new() }
    }

    fn cell_px(&self) -> [f64; 2] {
        let [w, h] = self.size_px;
        [w + MARGIN_PX[0] + MARGIN_PX[2], h + MARGIN_PX[1] + MARGIN_PX[3]]
    }

    fn panel(&self, x: (f64, f64), y: (f64, f64), labels: [&str; 2], title: &str) -> Panel {
        self.log_panel([false; 2], x, y, labels, title)
    }

    fn log_panel(
        &self,
        log: [bool; 2],
        x: (f64, f64),
        y: (f64, f64),
        labels: [&str; 2],
        title: &str,
    ) -> Panel {
        let [w, h] = self.cell_px();
        let (column, row) = (self.count % self.columns, self.count / self.columns);
        let origin = [column as f64 * w + MARGIN_PX[0], row as f64 * h + MARGIN_PX[1]];
        let range =
            [x, y].map(|(low, high)| if low < high { [low, high] } else { [low - 0.5, low + 0.5] });
        let labels = labels.map(String::from);
        let title = title.to_string();
        Panel { origin, size: self.size_px, range, log, labels, title, text: String::new() }
    }

    fn add(&mut self, panel: Panel) {
        self.count += 1;
        self.text += &panel.text;
    }

    fn finish(self) -> String {
        let [w, h] = self.cell_px();
        let columns = self.columns.min(self.count.max(1));
        let (width, height) = (w * columns as f64, h * self.count.div_ceil(self.columns) as f64);
        format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width:.0}\" height=\"{height:.0}\" \
             viewBox=\"0 0 {width:.0} {height:.0}\" font-family=\"sans-serif\" font-size=\"14\">\n\
             <rect width=\"100%\" height=\"100%\" fill=\"#ffffff\"/>\n{}</svg>\n",
            self.text
        )
    }
}

/// One pair of axes.
struct Panel {
    origin: [f64; 2],
    size: [f64; 2],
    range: [[f64; 2]; 2],
    log: [bool; 2],
    labels: [String; 2],
    title: String,
    text: String,
}

impl Panel {
    fn put(&mut self, arguments: std::fmt::Arguments<'_>) {
        self.text.write_fmt(arguments).expect("writing to memory cannot fail");
        self.text.push('\n');
    }

    /// From units of the axes to pixels of the picture.
    fn at(&self, p: [f64; 2]) -> [f64; 2] {
        let fraction = |a: usize| {
            let [low, high] = self.range[a];
            match self.log[a] {
                true => (p[a] / low).ln() / (high / low).ln(),
                false => (p[a] - low) / (high - low),
            }
        };
        let [x0, y0] = self.origin;
        [x0 + fraction(0) * self.size[0], y0 + (1.0 - fraction(1)) * self.size[1]]
    }

    fn curve(&mut self, points: impl Iterator<Item = [f64; 2]>, colour: &str) {
        let mut d = String::from("M");
        for p in points {
            let [x, y] = self.at(p);
            let _ = write!(d, "{x:.1} {y:.1} ");
        }
        if d.len() > 1 {
            self.put(format_args!(
                "<path d=\"{d}\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"1.5\"/>"
            ));
        }
    }

    fn image(&mut self, png: &[u8], x: (f64, f64), y: (f64, f64)) {
        let [left, top] = self.at([x.0, y.1]);
        let [right, bottom] = self.at([x.1, y.0]);
        let data = super::pack::base64(png);
        self.put(format_args!(
            "<image x=\"{left:.1}\" y=\"{top:.1}\" width=\"{:.1}\" height=\"{:.1}\" \
             preserveAspectRatio=\"none\" image-rendering=\"pixelated\" \
             href=\"data:image/png;base64,{data}\"/>",
            right - left,
            bottom - top
        ));
    }

    fn axes(&mut self) {
        let ([x0, y0], [w, h]) = (self.origin, self.size);
        let bottom = y0 + h;
        self.put(format_args!(
            "<rect x=\"{x0:.1}\" y=\"{y0:.1}\" width=\"{w:.1}\" height=\"{h:.1}\" fill=\"none\" \
             stroke=\"#000000\"/>"
        ));
        for v in ticks(self.range[0], self.log[0], w) {
            let x = self.at([v, self.range[1][0]])[0];
            self.put(format_args!(
                "<path d=\"M{x:.1} {bottom:.1}v5\" stroke=\"#000000\"/><text x=\"{x:.1}\" \
                 y=\"{:.1}\" text-anchor=\"middle\">{}</text>",
                bottom + 19.0,
                short(v)
            ));
        }
        for v in ticks(self.range[1], self.log[1], h) {
            let y = self.at([self.range[0][0], v])[1];
            self.put(format_args!(
                "<path d=\"M{x0:.1} {y:.1}h-5\" stroke=\"#000000\"/><text x=\"{:.1}\" y=\"{:.1}\" \
                 text-anchor=\"end\">{}</text>",
                x0 - 8.0,
                y + 5.0,
                short(v)
            ));
        }
        let (middle_x, middle_y) = (x0 + 0.5 * w, y0 + 0.5 * h);
        let [x_label, y_label] = self.labels.clone().map(|l| escaped(&l));
        let title = escaped(&self.title);
        self.put(format_args!(
            "<text x=\"{middle_x:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{x_label}</text>\
             <text transform=\"translate({:.1} {middle_y:.1}) rotate(-90)\" \
             text-anchor=\"middle\">{y_label}</text>\
             <text x=\"{x0:.1}\" y=\"{:.1}\" font-weight=\"bold\">{title}</text>",
            bottom + 40.0,
            x0 - 58.0,
            y0 - 10.0
        ));
    }

    /// Right of the panel.
    fn colour_bar(&mut self, colours: &[&str], range: [f64; 2], unit: &str) {
        let ([x0, y0], [w, h]) = (self.origin, self.size);
        let x = x0 + w + 10.0;
        let steps = 32;
        for i in 0..steps {
            let colour = colour_at(colours, 1.0 - (f64::from(i) + 0.5) / f64::from(steps));
            let height = h / f64::from(steps);
            self.put(format_args!(
                "<rect x=\"{x:.1}\" y=\"{:.2}\" width=\"12\" height=\"{:.2}\" fill=\"{colour}\"/>",
                y0 + height * f64::from(i),
                height + 0.3
            ));
        }
        for (v, y) in [(range[1], y0 + 10.0), (range[0], y0 + h)] {
            let text = short(v);
            self.put(format_args!("<text x=\"{:.1}\" y=\"{y:.1}\">{text}</text>", x + 16.0));
        }
        self.put(format_args!(
            "<text transform=\"translate({:.1} {:.1}) rotate(-90)\" text-anchor=\"middle\" \
             font-size=\"11\">{}</text>",
            x + 28.0,
            y0 + 0.5 * h,
            escaped(unit)
        ));
    }

    fn legend_of(&mut self, names: &[&str]) {
        let entries: Vec<(&str, &str)> = names
            .iter()
            .enumerate()
            .map(|(i, n)| (*n, LINE_COLOURS[i % LINE_COLOURS.len()]))
            .collect();
        self.legend(&entries);
    }

    fn legend(&mut self, entries: &[(&str, &str)]) {
        let ([x0, y0], [w, _]) = (self.origin, self.size);
        let widest = entries.iter().map(|(n, _)| n.chars().count()).max().unwrap_or(0) as f64;
        let x = x0 + w - 40.0 - 7.5 * widest;
        for (i, (name, colour)) in entries.iter().enumerate() {
            let y = y0 + 16.0 + 17.0 * i as f64;
            let name = escaped(name);
            self.put(format_args!(
                "<path d=\"M{x:.1} {:.1}h22\" stroke=\"{colour}\" stroke-width=\"3\"/>\
                 <text x=\"{:.1}\" y=\"{y:.1}\" font-size=\"12\">{name}</text>",
                y - 4.0,
                x + 27.0
            ));
        }
    }

    /// Small text at the lower right, outside.
    fn note(&mut self, text: &str) {
        let ([x0, y0], [w, h]) = (self.origin, self.size);
        let text = escaped(text);
        self.put(format_args!(
            "<text x=\"{:.1}\" y=\"{:.1}\" font-size=\"11\" fill=\"#444444\" \
             text-anchor=\"end\">{text}</text>",
            x0 + w + 90.0,
            y0 + h + 40.0
        ));
    }
}

/// Round values in the range, about one per 80 pixels; powers of ten on a logarithmic axis.
fn ticks([low, high]: [f64; 2], log: bool, length_px: f64) -> Vec<f64> {
    let most = (length_px / 80.0).max(2.0);
    if log {
        let (first, last) = (low.log10().ceil() as i32, high.log10().floor() as i32);
        let every = (f64::from(last - first + 1) / most).ceil().max(1.0) as usize;
        return (first..=last).step_by(every).map(|e| 10.0_f64.powi(e)).collect();
    }
    round_numbers(low, high, most)
}

/// A number for an axis.
fn short(v: f64) -> String {
    let size = v.abs();
    if v == 0.0 {
        return "0".into();
    }
    if !(1e-3..1e5).contains(&size) {
        return format!("{v:.0e}");
    }
    let decimals = (3.0 - size.log10().floor()).clamp(0.0, 6.0) as usize;
    let text = format!("{v:.decimals$}");
    match text.contains('.') {
        true => text.trim_end_matches('0').trim_end_matches('.').to_string(),
        false => text,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_and_inside() {
        assert_eq!(ticks([0.0, 92.3], false, 400.0), [0.0, 20.0, 40.0, 60.0, 80.0]);
        assert_eq!(ticks([-0.3, 0.3], false, 160.0), [0.0]);
        assert_eq!(ticks([0.02, 30.0], true, 800.0), [0.1, 1.0, 10.0]);
        for (v, text) in
            [(0.0, "0"), (-0.25, "-0.25"), (1500.0, "1500"), (1e-7, "1e-7"), (20.0, "20")]
        {
            assert_eq!(short(v), text);
        }
    }

    #[test]
    fn colours_begin_and_end_as_given() {
        assert_eq!(colour_at(&HEIGHT_COLOURS, 0.0), HEIGHT_COLOURS[0]);
        assert_eq!(colour_at(&HEIGHT_COLOURS, 0.5), "#f7f7f7");
        assert_eq!(colour_at(&SPEED_COLOURS, 7.0), SPEED_COLOURS[5]);
        assert_eq!(colour_at(&["#000000", "#ff8000"], 0.5), "#804000");
    }

    #[test]
    fn columns_keep_every_peak() {
        let ends: Vec<f64> = (1..=5000).map(f64::from).collect();
        let mut e = super::super::motion::Envelope { low: vec![0.0; 5000], high: vec![1.0; 5000] };
        e.high[3333] = 9.0;
        e.low[7] = -4.0;
        let found = columns(&ends, &e, 5000.0);
        assert_eq!(found.len(), COLUMNS);
        assert_eq!(bounds(found.iter().flat_map(|c| [c.1, c.2])), (-4.0, 9.0));
        let one = columns(
            &[2.0],
            &super::super::motion::Envelope { low: vec![1.0], high: vec![3.0] },
            2.0,
        );
        assert!(one.iter().all(|c| (c.1, c.2) == (1.0, 3.0)));
    }
}
