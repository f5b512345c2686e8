//! Figures as SVG for papers and slides: axes with units, and colours that people with a colour vision deficiency can
//! tell apart. A panel is one plot of a figure; a view is the data of one run.

use planish_draw::{
    Bands, Frame, Scale, Svg,
    colour::{BLUE_TO_BROWN, INK, LINES, VIRIDIS_FOR_LINES, of_line, rgb_at},
    frame::range,
    svg::put,
};
use planish_types::text::{fixed, significant};
use rayon::prelude::*;

use super::{
    map::ScreenMap,
    motion::{Dwell, SpeedLine},
    pack::base64,
    spectrum::{BAND_PERIOD_MM, Spectrum},
    tool::side_by_side,
    view::{MethodView, View},
};
use crate::{answer::duration, front, plan::WITHOUT_MOTION};

/// Number of colours of the path (lines) and of the dwell points (squares) in a picture. Larger: finer steps, larger
/// files. Smaller: coarser steps. Chosen.
const BINS: usize = 24;

/// Number of colour steps of the colour bar beside a map. Larger: a smoother bar. Smaller: visible steps. Chosen.
const BAR_BANDS: usize = 32;

/// Largest number of points of one line in a picture. Larger: larger files. Smaller: a coarser line. Chosen.
const MAX_POINTS: usize = 20_000;

/// Largest spread of values, relative to their magnitude, that counts as rounding. Larger: small differences are not
/// drawn. Smaller: rounding fills the whole scale. Chosen: some thousand times the rounding of one number.
const FLAT: f64 = 1e-12;

/// Number of time columns of a plot of ranges (smallest to largest value). Larger: larger files. Smaller: coarser
/// peaks. Chosen.
const COLUMNS: usize = 900;

/// Colours of the curves of x and of y.
const AXIS_COLOURS: [&str; 2] = [LINES[0], LINES[1]];

/// Height of the texts, px of the picture.
const FONT_PX: f64 = 14.0;

/// Margins of a panel, px: left, top, right and bottom.
const MARGIN_PX: [f64; 4] = [80.0, 34.0, 96.0, 56.0];

/// Arrangement of the panels of a figure: number of columns, and width of each, px. The height, px, applies if the
/// panel does not take the shape of the mirror.
#[derive(Clone, Copy, Debug)]
struct Panels {
    columns: usize,
    width_px: f64,
    height_px: f64,
}

impl Panels {
    const fn new(columns: usize, width_px: f64, height_px: f64) -> Self {
        Self { columns, width_px, height_px }
    }

    /// Creates an empty sheet for panels of the stated height.
    fn sheet(&self) -> Sheet {
        Sheet::new(self.columns, [self.width_px, self.height_px])
    }

    /// Creates an empty sheet for panels whose height is `shape` times their width.
    fn sheet_of_shape(&self, shape: f64) -> Sheet {
        Sheet::new(self.columns, [self.width_px, self.width_px * shape])
    }
}

/// Arrangement of the panels of each figure of a set.
#[derive(Clone, Copy, Debug)]
pub struct Layout {
    overview: Panels,
    /// Overview of a mirror that is much longer than wide, whose panels stand one below the other.
    overview_narrow: Panels,
    maps: Panels,
    path: Panels,
    motion: Panels,
    dwell: Panels,
    histogram: Panels,
    spectrum: Panels,
    refinement: Panels,
}

impl Layout {
    /// Layout for figures beside the report page: many methods, one below the other.
    pub const BESIDE_PAGE: Self = Self {
        overview: Panels::new(3, 300.0, 300.0),
        overview_narrow: Panels::new(1, 900.0, 900.0),
        maps: Panels::new(4, 300.0, 300.0),
        path: Panels::new(1, 900.0, 900.0),
        motion: Panels::new(3, 420.0, 240.0),
        dwell: Panels::new(2, 520.0, 520.0),
        histogram: Panels::new(1, 760.0, 380.0),
        spectrum: Panels::new(1, 760.0, 420.0),
        refinement: Panels::new(1, 600.0, 320.0),
    };

    /// Layout for papers and lab books: every figure is [`PAPER_PX`] wide.
    pub const PAPER: Self = {
        let margin = MARGIN_PX[0] + MARGIN_PX[2];
        let whole = PAPER_PX - margin;
        let half = 0.5 * PAPER_PX - margin;
        Self {
            overview: Panels::new(3, PAPER_PX / 3.0 - MARGIN_OF_THREE_PX, 0.0),
            overview_narrow: Panels::new(1, whole, 0.0),
            maps: Panels::new(2, half, half),
            path: Panels::new(1, whole, whole),
            motion: Panels::new(1, whole, 170.0),
            dwell: Panels::new(2, half, half),
            histogram: Panels::new(1, whole, 300.0),
            spectrum: Panels::new(1, whole, 320.0),
            refinement: Panels::new(1, whole, 260.0),
        }
    };
}

/// Margins to the left and right, in sum, of each of three panels side by side, px. Larger: narrower maps. Smaller:
/// numbers that do not fit. Chosen for numbers of two digits.
const MARGIN_OF_THREE_PX: f64 = 134.0;

/// Ratio of height to width of the extent of a path below which the panels of its overview stand one below the other.
/// Larger: more overviews of this kind. Smaller: very flat maps side by side. Chosen.
const NARROW: f64 = 0.4;

/// Smallest width of a panel that gets a note in small print below it, px. Larger: fewer notes. Smaller: notes that
/// do not fit. Chosen.
const NOTED_FROM_PX: f64 = 500.0;

/// Smallest scale of a residual, relative to the scale of the desired removal, at which the residual is also drawn on
/// the scale of the desired removal. Larger: fewer such maps. Smaller: maps that look empty. Chosen: below it the map
/// spans less than one colour of the bar to either side of the mean.
const LEAST_CONTRAST: f64 = 0.05;

/// Largest difference between planned and executed dwell times that is the rounding of a sum of segments, s. Larger:
/// real differences are not drawn. Smaller: rounding is drawn. Chosen.
const ROUNDING_S: f64 = 1e-6;

/// Width of a figure for papers, px. Larger: smaller texts in print. Smaller: larger texts and less room for maps.
/// Derived: its texts of 14 px are 7.5 pt high when it is printed 180 mm wide.
pub const PAPER_PX: f64 = 952.0;

/// Draws the figures of a report. Returns the names and the SVG texts of those that have something to show.
pub fn figures(views: &[View], layout: &Layout) -> Vec<(&'static str, String)> {
    type Figure = fn(&[View], &Layout) -> Option<String>;
    let figures: [(&str, Figure); 11] = [
        ("overview", overview),
        ("maps", maps),
        ("tool", |views, _| views.iter().find_map(|view| side_by_side(&view.tool))),
        ("axes", axes),
        ("path", path),
        ("motion", motion),
        ("dwell", dwell),
        ("histogram", histograms),
        ("spectrum", spectra),
        ("refinement", refinement),
        ("front", front),
    ];
    let drawn = figures.into_par_iter();
    drawn.filter_map(|(name, figure)| Some((name, figure(views, layout)?))).collect()
}

// ---------------------------------------------------------------------------------------------
// The figures

/// Draws the maps of every method: desired removal, predicted removal and residual. All are on one scale, that of the
/// desired removal, and the residual also on its own scale, that of 99 % of its pixels. The residual on the common
/// scale is left out if it would look empty ([`LEAST_CONTRAST`]). `None` if no run has a method.
fn maps(views: &[View], layout: &Layout) -> Option<String> {
    methods(views).next()?;
    let shape = aspect(&views.first()?.desired).clamp(0.15, 2.0);
    let mut sheet = layout.maps.sheet_of_shape(shape);
    let mut panels = Vec::new();
    for view in views {
        let common = scale_of(&view.desired);
        for m in &view.methods {
            let own = m.residual.reach_99_nm;
            let label = label(views, view, m);
            panels.extend([
                (&view.desired, common, "desired removal".to_string()),
                (&m.removal, common, format!("predicted removal, {label}")),
            ]);
            if own >= LEAST_CONTRAST * common {
                panels.push((&m.residual, common, format!("residual, {label}")));
            }
            panels.push((&m.residual, own, format!("residual, {label}, own scale (99 %)")));
        }
    }
    let images: Vec<_> = panels.par_iter().map(|(map, scale, _)| png_of(map, *scale)).collect();
    for ((map, scale, title), image) in panels.iter().zip(images) {
        let frame = sheet.panel(extent(map).map(Scale::linear));
        draw_map(&mut sheet.svg, &frame, &image, *scale);
        frame.title(&mut sheet.svg, title);
    }
    Some(sheet.finish())
}

/// Returns the picture of the motion of all axes: that of the recommended plan if it has one, otherwise of the first
/// plan that has one; `None` if no plan has one.
fn axes(views: &[View], _: &Layout) -> Option<String> {
    let with_axes: Vec<_> = methods(views).filter(|(_, m)| m.on_axes.is_some()).collect();
    let mut all = with_axes.iter();
    let recommended = all.find(|(view, m)| view.summary.best.as_ref() == Some(&m.name));
    let (_, m) = recommended.or(with_axes.first())?;
    m.on_axes.clone()
}

/// Draws the path of every method, one panel each, in colours of the speed; `None` if no run has a method.
fn path(views: &[View], layout: &Layout) -> Option<String> {
    let (_, first) = methods(views).next()?;
    let shape = shape_of(&first.line.point_mm);
    let mut sheet = layout.path.sheet_of_shape(shape);
    for (view, m) in methods(views) {
        let frame = sheet.panel(same_scale(&m.line.point_mm, shape));
        draw_path(&mut sheet.svg, &frame, &m.line);
        frame.title(&mut sheet.svg, &format!("path, {}", label(views, view, m)));
    }
    Some(sheet.finish())
}

/// Draws the overview of every method in three panels: surface before the run, path in colours of the speed, residual
/// on its own scale. `None` if no run has a method.
fn overview(views: &[View], layout: &Layout) -> Option<String> {
    let (_, first) = methods(views).next()?;
    let shape = shape_of(&first.line.point_mm);
    let narrow = shape < NARROW;
    let panels = if narrow { &layout.overview_narrow } else { &layout.overview };
    let mut sheet = panels.sheet_of_shape(shape);
    if !narrow {
        sheet.margin_px = [56.0, 34.0, MARGIN_OF_THREE_PX - 56.0, 56.0];
    }
    for (view, m) in methods(views) {
        let result = view.summary.methods.iter().find(|(name, _)| *name == m.name);
        let time = duration(result.map_or(f64::NAN, |(_, result)| result.total_time_s));
        let scales = [scale_of(&view.desired), m.residual.reach_99_nm].map(two_digits_up);
        let maps = [(&view.desired, scales[0]), (&m.residual, scales[1])];
        let images = maps.map(|(map, scale)| png_of(map, scale));
        let rms = maps.map(|(map, _)| significant(map.rms_nm, 3));
        // All on the scale of the path, so that the same place is at the same place.
        let scales = same_scale(&m.line.point_mm, shape);
        let frame = sheet.panel(scales);
        draw_map_at(&mut sheet.svg, &frame, &images[0], maps[0]);
        frame.title(&mut sheet.svg, &format!("before: {} nm RMS", rms[0]));
        let frame = sheet.panel(scales);
        draw_path(&mut sheet.svg, &frame, &m.line);
        let [x, y] = extent(&view.desired);
        let [[left, top], [right, bottom]] = [[x[0], y[1]], [x[1], y[0]]].map(|p| frame.px(p));
        let outline = format!("fill=\"none\" stroke=\"{INK}\" stroke-width=\"0.7\"");
        sheet.svg.rectangle([left, top], [right - left, bottom - top], &outline);
        frame.title(&mut sheet.svg, &format!("path: {}, {time}", label(views, view, m)));
        let frame = sheet.panel(scales);
        draw_map_at(&mut sheet.svg, &frame, &images[1], maps[1]);
        frame.title(&mut sheet.svg, &format!("after: {} nm RMS, own scale", rms[1]));
    }
    Some(sheet.finish())
}

/// Draws a map in colours over the whole of `frame`, with axes and colour bar. `image` is the map as PNG. The colours
/// run from `scale` below the mean of the map to `scale` above it, nm.
fn draw_map(svg: &mut Svg, frame: &Frame, image: &[u8], scale: f64) {
    let corner = [frame.left, frame.top];
    put_image(svg, corner, [frame.width, frame.height], image);
    frame.axes(svg, ["x (mm)", "y (mm)"]);
    frame.colour_bar(svg, &Bands::new(&BLUE_TO_BROWN, BAR_BANDS, [-scale, scale]), "nm");
    note_below(svg, frame, "height from the mean");
}

/// Draws a map as [`draw_map`] does, but at its coordinates within a larger frame. The last argument is the map and its
/// scale, nm.
fn draw_map_at(svg: &mut Svg, frame: &Frame, image: &[u8], (map, scale): (&ScreenMap, f64)) {
    let [x, y] = extent(map);
    let [[left, top], [right, bottom]] = [[x[0], y[1]], [x[1], y[0]]].map(|p| frame.px(p));
    put_image(svg, [left, top], [right - left, bottom - top], image);
    frame.axes(svg, ["x (mm)", "y (mm)"]);
    frame.colour_bar(svg, &Bands::new(&BLUE_TO_BROWN, BAR_BANDS, [-scale, scale]), "nm");
    note_below(svg, frame, "height from the mean");
}

/// Adds a note in small print below a panel, if the panel is wide enough for it beside the title of its axis. `words`
/// are the text.
fn note_below(svg: &mut Svg, frame: &Frame, words: &str) {
    if frame.width >= NOTED_FROM_PX {
        frame.note(svg, words);
    }
}

/// Adds a PNG image with the upper left corner [x, y] and this size, px.
fn put_image(svg: &mut Svg, [x, y]: [f64; 2], [width, height]: [f64; 2], image: &[u8]) {
    svg.put(format_args!(
        "<image x=\"{x:.1}\" y=\"{y:.1}\" width=\"{width:.1}\" height=\"{height:.1}\" \
         preserveAspectRatio=\"none\" style=\"image-rendering:pixelated\" \
         href=\"data:image/png;base64,{}\"/>",
        base64(image)
    ));
}

/// Draws a path in colours of the speed, with its axes and its colour bar. Jumps are dotted. A jump is where the motion
/// continues at another position.
fn draw_path(svg: &mut Svg, frame: &Frame, line: &SpeedLine) {
    let speeds: Vec<f64> = line.speed_mm_per_s.iter().copied().filter(|v| v.is_finite()).collect();
    let bands = Bands::new(&VIRIDIS_FOR_LINES, BINS, [0.0, or_one(quantile(&speeds, 0.99))]);
    let every = line.point_mm.len().div_ceil(MAX_POINTS);
    let drawn: Vec<usize> = (0..line.point_mm.len()).step_by(every).collect();
    let mut jumps = String::new();
    let mut moves = vec![String::new(); BINS];
    for pair in drawn.windows(2) {
        let jump = (pair[0] + 1..=pair[1]).any(|i| line.speed_mm_per_s[i].is_nan());
        let bin =
            if jump { &mut jumps } else { &mut moves[bands.index(line.speed_mm_per_s[pair[1]])] };
        let [a, b] = [pair[0], pair[1]].map(|i| frame.px(line.point_mm[i]));
        put(bin, format_args!("M{:.1} {:.1}L{:.1} {:.1}", a[0], a[1], b[0], b[1]));
    }
    for (colour, d) in bands.colours().iter().zip(&moves) {
        svg.path(&format!("fill=\"none\" stroke=\"{colour}\""), d);
    }
    let dashed = "fill=\"none\" stroke=\"#888888\" stroke-dasharray=\"2 3\" stroke-opacity=\"0.5\"";
    svg.path(dashed, &jumps);
    frame.axes(svg, ["x (mm)", "y (mm)"]);
    frame.colour_bar(svg, &bands, "mm/s");
    note_below(svg, frame, "99 % of the speeds are below the top");
}

/// Draws velocity, acceleration and jerk of every method against time; `None` if no run has a method. A limit of the
/// machine is a dashed line if it is at most three times the largest value of the panel; otherwise a note names it.
fn motion(views: &[View], layout: &Layout) -> Option<String> {
    methods(views).next()?;
    let mut sheet = layout.motion.sheet();
    for (view, m) in methods(views) {
        let ends = &m.ranges.end_s;
        let time = [0.0, *ends.last()?];
        let names = ["velocity (mm/s)", "acceleration (mm/s²)", "jerk (mm/s³)"];
        for (order, (envelopes, name)) in m.ranges.envelope.iter().zip(names).enumerate() {
            let values = envelopes.iter().flat_map(|e| e.low.iter().chain(&e.high));
            let reach = or_one(range(values.map(|v| v.abs()))[1].max(0.0));
            let limits = m
                .verdict
                .axes
                .each_ref()
                .map(|axis| axis.derivatives()[order].limit.unwrap_or(f64::NAN));
            let near = limits.map(|l| l <= 3.0 * reach);
            let largest = limits.into_iter().filter(|l| *l <= 3.0 * reach).fold(reach, f64::max);
            let shown = 1.05 * largest;
            let frame = sheet.panel([Scale::linear(time), Scale::linear([-shown, shown])]);
            let svg = &mut sheet.svg;
            let mut notes = vec![];
            for (axis, envelope) in envelopes.iter().enumerate() {
                let mut d = String::new();
                for (x, low, high) in envelope.over_columns(ends, COLUMNS) {
                    let [px, bottom] = frame.px([x, low]);
                    let top = frame.px([x, high])[1];
                    put(&mut d, format_args!("M{px:.1} {bottom:.1}V{:.1}", top.min(bottom - 0.7)));
                }
                let colour = AXIS_COLOURS[axis];
                svg.path(&format!("fill=\"none\" stroke=\"{colour}\" stroke-opacity=\"0.75\""), &d);
                let limit = limits[axis];
                let axis_name = ["x", "y"][axis];
                if limit.is_finite() && near[axis] {
                    let [above, below] = [limit, -limit].map(|l| frame.px([time[0], l])[1]);
                    let x0 = frame.left;
                    let x1 = frame.right();
                    svg.path(
                        &format!("stroke=\"{colour}\" stroke-dasharray=\"7 4\""),
                        &format!("M{x0:.1} {below:.1}H{x1:.1}M{x0:.1} {above:.1}H{x1:.1}"),
                    );
                    notes.push(format!("{axis_name} limit {}", significant(limit, 4)));
                } else if limit.is_finite() {
                    let limit = significant(limit, 4);
                    notes.push(format!("{axis_name} limit {limit} beyond the axis"));
                }
            }
            frame.legend(svg, &[("x", AXIS_COLOURS[0]), ("y", AXIS_COLOURS[1])]);
            frame.note(svg, &notes.join(", "));
            frame.axes(svg, ["time (s)", name]);
            frame.title(svg, &format!("{}, {name}", label(views, view, m)));
        }
    }
    Some(sheet.finish())
}

/// Draws the dwell times of every method that has some; `None` if no method has. If an executed time of any method
/// differs from the planned one by more than [`ROUNDING_S`], it also draws executed minus planned times.
fn dwell(views: &[View], layout: &Layout) -> Option<String> {
    let shape = shape_of(&methods(views).find_map(|(_, m)| m.dwell.as_ref())?.point_mm);
    // Without a difference to show, one panel of a method takes the whole width.
    let some_depart = methods(views)
        .filter_map(|(_, m)| m.dwell.as_ref())
        .any(|d| dwell_errors_s(d).iter().any(|e| e.abs() > ROUNDING_S));
    let panels = if some_depart { &layout.dwell } else { &layout.path };
    let mut sheet = panels.sheet_of_shape(shape);
    for (view, m) in methods(views) {
        let Some(d) = &m.dwell else { continue };
        let error = dwell_errors_s(d);
        let pairs = d.point_mm.windows(2);
        let gaps: Vec<f64> = pairs.map(|p| (p[1][0] - p[0][0]).hypot(p[1][1] - p[0][1])).collect();
        let gap_mm = quantile(&gaps, 0.5);
        let top = or_one(quantile(&d.planned_s, 0.99));
        let reach = error.iter().fold(ROUNDING_S, |m, e| m.max(e.abs()));
        let label = label(views, view, m);
        let shown = [
            (&d.planned_s, Bands::new(&VIRIDIS_FOR_LINES, BINS, [0.0, top]), "dwell time"),
            (&error, Bands::new(&BLUE_TO_BROWN, BINS, [-reach, reach]), "executed - planned"),
        ];
        for (values, bands, title) in shown.into_iter().take(if some_depart { 2 } else { 1 }) {
            let frame = sheet.panel(same_scale(&d.point_mm, shape));
            if values.is_empty() {
                frame.axes(&mut sheet.svg, ["x (mm)", "y (mm)"]);
                frame.title(&mut sheet.svg, &format!("not known of a program: {title}, {label}"));
                continue;
            }
            // A square as large as its fraction of the picture, and no gap to the next one on the
            // path.
            let px_per_mm = frame.px([1.0, 0.0])[0] - frame.px([0.0, 0.0])[0];
            let own_px = (260_000.0 / d.point_mm.len() as f64).sqrt().clamp(1.0, 5.0);
            let side = own_px.max((1.1 * px_per_mm * gap_mm).min(frame.width / 25.0));
            let mut squares = vec![String::new(); BINS];
            for (p, v) in d.point_mm.iter().zip(values) {
                let [px, py] = frame.px(*p);
                let d = &mut squares[bands.index(*v)];
                put(d, format_args!("M{:.1} {py:.1}h{side:.1}", px - 0.5 * side));
            }
            let svg = &mut sheet.svg;
            for (colour, d) in bands.colours().iter().zip(&squares) {
                svg.path(&format!("stroke=\"{colour}\" stroke-width=\"{side:.1}\""), d);
            }
            frame.axes(svg, ["x (mm)", "y (mm)"]);
            frame.colour_bar(svg, &bands, "s");
            if !some_depart && d.executed_s.is_some() {
                let s = significant(ROUNDING_S, 1);
                note_below(svg, &frame, &format!("executed within {s} s of planned"));
            }
            frame.title(svg, &format!("{title}, {label}"));
        }
    }
    sheet.finish_if_any()
}

/// Returns executed minus planned time of every dwell point, s; empty if the executed times are not known.
fn dwell_errors_s(d: &Dwell) -> Vec<f64> {
    let executed_s = d.executed_s.as_deref().unwrap_or_default();
    executed_s.iter().zip(&d.planned_s).map(|(e, p)| e - p).collect()
}

/// Draws histograms of the desired removal (before) and of the residual of every method (after), one panel per run;
/// `None` without runs.
fn histograms(views: &[View], layout: &Layout) -> Option<String> {
    let mut sheet = layout.histogram.sheet();
    for view in views {
        let mut histograms = vec![("before", &view.before.0)];
        histograms.extend(view.methods.iter().map(|m| (m.name.as_str(), &m.after.0)));
        let all = histograms.iter().flat_map(|(_, h)| &h.density_per_nm);
        let high = all.fold(0.0_f64, |m, v| m.max(*v));
        let low = high * 1e-5;
        let reach = histograms.iter().fold(0.0_f64, |m, (_, h)| m.max(-h.low_nm));
        let scales = [Scale::linear([-reach, reach]), Scale::logarithmic([low, 2.0 * high])];
        let curves = histograms.iter().map(|(name, h)| {
            let points = h.density_per_nm.iter().enumerate();
            let middles = points.map(|(k, v)| (h.low_nm + (k as f64 + 0.5) * h.width_nm, v));
            (*name, middles.map(|(middle, v)| [middle, v.max(low)]).collect())
        });
        let frame = sheet.panel(scales);
        curves_of(&mut sheet.svg, &frame, &curves.collect::<Vec<_>>());
        frame.axes(&mut sheet.svg, ["height from the mean (nm)", "fraction of the pixels (1/nm)"]);
        frame.title(&mut sheet.svg, title(views, view));
    }
    sheet.finish_if_any()
}

/// Draws power spectral densities of the desired removal (before) and of the residual of every method (after), one
/// panel per run that has spectra; `None` if no run has.
fn spectra(views: &[View], layout: &Layout) -> Option<String> {
    let mut sheet = layout.spectrum.sheet();
    for view in views {
        let before = std::iter::once(("before", &view.before.1));
        let after = view.methods.iter().map(|m| (m.name.as_str(), &m.after.1));
        let named = before.chain(after).filter_map(|(name, s)| Some((name, s.as_ref()?)));
        let spectra: Vec<(&str, &Spectrum)> = named.collect();
        let Some((_, first)) = spectra.first() else { continue };
        let densities = spectra.iter().flat_map(|(_, s)| &s.psd_nm2_mm2).copied();
        let [low, high] = range(densities.filter(|v| *v > 0.0));
        let low = low.max(high * 1e-10);
        let frequencies = spectra.iter().flat_map(|(_, s)| &s.frequency_per_mm).copied();
        let x = range(frequencies.filter(|v| *v > 0.0));
        let frame = sheet.panel([Scale::logarithmic(x), Scale::logarithmic([low, 2.0 * high])]);
        let svg = &mut sheet.svg;
        for period in BAND_PERIOD_MM {
            let f = 1.0 / period;
            if f > x[0] && f < x[1] {
                frame.upright(svg, f, "stroke=\"#888888\" stroke-dasharray=\"3 3\"");
                let place = [frame.px([f, low])[0] + 4.0, frame.bottom() - 6.0];
                svg.text(place, "font-size=\"12\" fill=\"#555555\"", &format!("{period} mm"));
            }
        }
        let curves = spectra.iter().map(|(name, s)| {
            let points = s.frequency_per_mm.iter().zip(&s.psd_nm2_mm2);
            let drawn = points.filter(|(_, p)| **p > 0.0).map(|(f, p)| [*f, p.max(low)]);
            (*name, drawn.collect())
        });
        curves_of(svg, &frame, &curves.collect::<Vec<_>>());
        let [width, height] = first.size_mm.map(|mm| significant(mm, 4));
        let percent = fixed(100.0 * first.fraction_of_valid_pixels, 1);
        frame.note(svg, &format!("of {width} x {height} mm, {percent} % of the valid pixels"));
        frame.axes(svg, ["spatial frequency (1/mm)", "PSD (nm² mm²)"]);
        frame.title(svg, title(views, view));
    }
    sheet.finish_if_any()
}

/// Draws the RMS of the executed residual in every round of each refinement; `None` if no method was refined.
fn refinement(views: &[View], layout: &Layout) -> Option<String> {
    let mut sheet = layout.refinement.sheet();
    for (view, m) in methods(views) {
        let Some(rounds) = m.rounds.as_ref().filter(|r| !r.rms_nm.is_empty()) else { continue };
        let last = (rounds.rms_nm.len() - 1).max(1) as f64;
        let [_, high] = range(rounds.rms_nm.iter().copied());
        let scales = [Scale::Counts([0.0, last]), Scale::linear([0.0, 1.05 * high.max(1e-12)])];
        let frame = sheet.panel(scales);
        let svg = &mut sheet.svg;
        let points = rounds.rms_nm.iter().enumerate().map(|(i, v)| [i as f64, *v]);
        frame.curve(svg, points.clone(), LINES[0]);
        for (i, p) in points.enumerate() {
            let [x, y] = frame.px(p);
            let fill = if rounds.best == Some(i) { LINES[0] } else { "#ffffff" };
            svg.put(format_args!(
                "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"4\" fill=\"{fill}\" stroke=\"{}\"/>",
                LINES[0]
            ));
        }
        frame.note(svg, "full dot: the round that was kept");
        frame.axes(svg, ["round", "RMS of the executed residual (nm)"]);
        frame.title(svg, &format!("refinement, {}", label(views, view, m)));
    }
    sheet.finish_if_any()
}

/// Draws the residual against the time of every plan; `None` for fewer than two plans.
fn front(views: &[View], _: &Layout) -> Option<String> {
    let runs: Vec<_> = views.iter().map(|view| (view.name.as_str(), &view.summary)).collect();
    front::svg(&front::points(&runs))
}

/// Draws curves with a legend. The first, in black, is the reference with which the others are compared.
fn curves_of(svg: &mut Svg, frame: &Frame, curves: &[(&str, Vec<[f64; 2]>)]) {
    let mut names = Vec::new();
    for (k, (name, points)) in curves.iter().enumerate() {
        let colour = if k == 0 { INK } else { of_line(k - 1) };
        frame.curve(svg, points.iter().copied(), colour);
        names.push((*name, colour));
    }
    frame.legend(svg, &names);
}

/// A figure under construction: panels of equal size, row by row. `size_px` is the size of a panel without its margins,
/// `count` the number of panels so far.
struct Sheet {
    columns: usize,
    size_px: [f64; 2],
    margin_px: [f64; 4],
    count: usize,
    svg: Svg,
}

impl Sheet {
    fn new(columns: usize, size_px: [f64; 2]) -> Self {
        Self { columns, size_px, margin_px: MARGIN_PX, count: 0, svg: Svg::new(FONT_PX) }
    }

    /// Returns the width and the height of a panel with its margins, px.
    fn cell_px(&self) -> [f64; 2] {
        let [left, top, right, bottom] = self.margin_px;
        [self.size_px[0] + left + right, self.size_px[1] + top + bottom]
    }

    /// Adds a panel to the sheet, with these scales of x and y, and returns its frame.
    fn panel(&mut self, scales: [Scale; 2]) -> Frame {
        let [w, h] = self.cell_px();
        let column = self.count % self.columns;
        let row = self.count / self.columns;
        self.count += 1;
        Frame::new([column as f64 * w, row as f64 * h], self.size_px, self.margin_px, scales)
    }

    fn finish(self) -> String {
        let [w, h] = self.cell_px();
        let columns = self.columns.min(self.count.max(1));
        self.svg.finish([w * columns as f64, h * self.count.div_ceil(self.columns) as f64])
    }

    fn finish_if_any(self) -> Option<String> {
        if self.count > 0 { Some(self.finish()) } else { None }
    }
}

// ---------------------------------------------------------------------------------------------
// What they are drawn from

/// Returns every method of all runs, with the view of its run.
fn methods(views: &[View]) -> impl Iterator<Item = (&View, &MethodView)> {
    views.iter().flat_map(|v| v.methods.iter().map(move |m| (v, m)))
}

fn label(views: &[View], view: &View, m: &MethodView) -> String {
    let run = if views.len() > 1 { format!("{} / ", view.name) } else { String::new() };
    // Nobody is to take it for a plan.
    let note = if m.name == WITHOUT_MOTION { " (without a motion)" } else { "" };
    format!("{run}{}{note}", m.name)
}

fn title<'a>(views: &[View], view: &'a View) -> &'a str {
    if views.len() > 1 { &view.name } else { "" }
}

/// Returns the outer edges of the pixels of `map` along x and y, mm.
fn extent(map: &ScreenMap) -> [[f64; 2]; 2] {
    [0, 1].map(|a| {
        let low = map.start_mm[a] - 0.5 * map.step_mm[a];
        [low, low + map.size[a] as f64 * map.step_mm[a]]
    })
}

/// Returns the ratio of height to width of the extent of `points`, limited to 0.15 to 1.2 as the shape of a panel; 1 if
/// the ratio is not finite.
fn shape_of(points: &[[f64; 2]]) -> f64 {
    let [w, h] = [0, 1].map(|a| {
        let [low, high] = range(points.iter().map(|p| p[a]));
        high - low
    });
    let shape = h / w;
    if shape.is_finite() { shape.clamp(0.15, 1.2) } else { 1.0 }
}

/// Returns the ratio of height to width of a map.
fn aspect(map: &ScreenMap) -> f64 {
    let [x, y] = extent(map);
    (y[1] - y[0]) / (x[1] - x[0])
}

/// Returns the largest distance of a height from the mean, nm; 1 nm for a map that is flat but for rounding.
fn scale_of(map: &ScreenMap) -> f64 {
    let [low, high] = map.range_nm;
    let reach = (high - map.mean_nm).max(map.mean_nm - low);
    if reach > FLAT * low.abs().max(high.abs()) { reach } else { 1.0 }
}

/// Rounds the positive `value` up to two significant digits.
fn two_digits_up(value: f64) -> f64 {
    let step = 10.0_f64.powf(value.log10().floor() - 1.0);
    (value / step).ceil() * step
}

/// Returns `end`, or 1 if it is 0, because a range must not be empty.
fn or_one(end: f64) -> f64 {
    if end == 0.0 { 1.0 } else { end }
}

/// Returns scales of x and y around `points` on which 1 mm has the same length along both. `shape` is the ratio of
/// height to width of the panel.
fn same_scale(points: &[[f64; 2]], shape: f64) -> [Scale; 2] {
    let ends = [0, 1].map(|a| range(points.iter().map(|p| p[a])));
    let [w, h] = ends.map(|[low, high]| high - low);
    // A path that is one point, but for rounding, gets a frame of 1 mm.
    let far = ends.as_flattened().iter().fold(1.0, |m: f64, v| m.max(v.abs()));
    let (w, h) = if w.max(h) > FLAT * far { (w, h) } else { (1.0, 1.0) };
    let width = 1.04 * w.max(h / shape);
    let [x, y] = ends.map(|[low, high]| 0.5 * (low + high));
    let sides = [(x, width), (y, width * shape)];
    sides.map(|(middle, size)| Scale::linear([middle - 0.5 * size, middle + 0.5 * size]))
}

/// Returns the value that the given fraction of `values` does not exceed; 1 if there are none.
fn quantile(values: &[f64], fraction: f64) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted
        .get(((sorted.len() as f64 - 1.0) * fraction).round().max(0.0) as usize)
        .copied()
        .unwrap_or(1.0)
}

/// Returns the map in colours as PNG, row 0 at the bottom. The colours run from `scale` below the mean of the map to
/// `scale` above it, nm; invalid pixels are transparent.
fn png_of(map: &ScreenMap, scale: f64) -> Vec<u8> {
    let [nx, ny] = map.size;
    let mut palette = vec![255; 3];
    palette.extend((0..255).flat_map(|i| rgb_at(&BLUE_TO_BROWN, f64::from(i) / 254.0)));
    let mut pixels: Vec<u8> = Vec::with_capacity(nx * ny);
    for v in map.means_nm.outer_iter().rev().flatten() {
        let index = ((v - map.mean_nm) / scale * 127.0 + 127.0).round().clamp(0.0, 254.0);
        pixels.push(if v.is_nan() { 0 } else { 1 + index as u8 });
    }
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_mm_is_as_long_along_both_axes() {
        let [x, y] = same_scale(&[[0.0, 0.0], [10.0, 2.0]], 0.5);
        assert_eq!(x.ends(), [5.0 - 5.2, 5.0 + 5.2]);
        assert_eq!(y.ends(), [1.0 - 2.6, 1.0 + 2.6]);
        // One point, but for rounding.
        let [x, _] = same_scale(&[[7.0, 7.0], [7.0 + 1e-15, 7.0]], 1.0);
        assert!((x.ends()[1] - x.ends()[0] - 1.04).abs() < 1e-12);
    }
}
