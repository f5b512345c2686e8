//! Pictures of a tool. One that is the same everywhere has its rate as a map, and two sections through its peak. One
//! that varies has its removal rate over the part, its footprint at nine positions, and its rate over time.

use ndarray::Array2;
use planish_draw::{
    Bands, Frame, Scale, Svg,
    colour::{BLUE_TO_BROWN, INK, LINES, VIRIDIS_FOR_LINES},
    frame::range,
    svg::MIDDLE,
};
use planish_types::{Axis, Grid, Pose, Surface, Tif, Variation, text::significant};

use super::part::{self, BANDS, FONT_PX, Look, MAP_PX, MOST_CELLS, RIGHT_BOTTOM_PX, side_mm};
use crate::tool_numbers::ToolNumbers;

/// Number of points of a section. Larger: larger files. Smaller: corners that are seen. Chosen: two px of the plot.
const SECTION_POINTS: usize = 200;

/// Height of the plot of the sections, px. Larger: a longer picture. Smaller: flat curves.
const SECTION_PX: f64 = 260.0;

/// Number of points of a dash of a section. Larger: dashes that look like the curve. Smaller: dots.
const DASH_POINTS: usize = 8;

/// Height of a line of text below the sections, px.
const LINE_PX: f64 = 1.4 * FONT_PX;

/// A picture with its size.
#[derive(Clone, Debug)]
pub struct Picture {
    /// The picture as SVG.
    pub svg: String,
    /// Its width and height, px.
    pub size_px: [f64; 2],
    /// True if it shows how a tool varies.
    pub varies: bool,
}

/// Margins of a plot with axes, px: left, top, right and bottom. Larger: empty space. Smaller: numbers are cut off.
const MARGIN_PX: [f64; 4] = [70.0, 34.0, RIGHT_BOTTOM_PX[0], RIGHT_BOTTOM_PX[1]];

/// Side of the drawing of a footprint, px. Larger: the picture is wider than a page. Smaller: its shape cannot be
/// seen.
const FOOTPRINT_PX: f64 = 120.0;

/// Distance between two footprints, px. Larger: empty space. Smaller: no room for the number of the position.
const GAP_PX: f64 = 26.0;

/// Height of the plot of the rate against time, px. Larger: a longer picture. Smaller: a flat line.
const TIME_PX: f64 = 150.0;

/// Positions of the footprints along an axis, as fractions of the side of the map. On a disk all nine are on the
/// part.
const PLACES: [f64; 3] = [1.0 / 6.0, 0.5, 5.0 / 6.0];

/// Draws the tool: its rate and its two sections, or how it varies over the part. `surface` is a map of the part, whose
/// pixels the tool acts on. `name` is the name of the tool, or empty.
pub fn pictures(tif: &Tif, surface: &Surface, name: &str) -> Vec<Picture> {
    match (tif.variation(), ToolNumbers::new(tif)) {
        (Some(variation), _) => vec![varying(variation, surface)],
        (None, Some(numbers)) => vec![rate(tif, name), sections(tif, &numbers, name)],
        (None, None) => vec![],
    }
}

/// Returns pictures beside each other as one; `None` if there are none.
pub fn side_by_side(pictures: &[Picture]) -> Option<String> {
    let mut svg = Svg::new(FONT_PX);
    let mut left = 0.0;
    let mut height = 0.0_f64;
    for picture in pictures {
        let [width, own] = picture.size_px;
        svg.put(format_args!("<g transform=\"translate({left:.0} 0)\">{}</g>", picture.svg));
        left += width;
        height = height.max(own);
    }
    if pictures.is_empty() { None } else { Some(svg.finish([left, height])) }
}

/// Draws the removal rate of a tool that is the same everywhere, at the offset of a pixel from the tool.
fn rate(tif: &Tif, name: &str) -> Picture {
    let mut svg = Svg::new(FONT_PX);
    let grid = tif.grid();
    let shape = (side_mm(&grid.y) / side_mm(&grid.x)).clamp(0.15, 2.0);
    let scales = [&grid.x, &grid.y].map(|axis| Scale::linear(axis.edges_mm()));
    let frame = Frame::new([0.0; 2], [MAP_PX, MAP_PX * shape], MARGIN_PX, scales);
    let map = tif.rate_nm_per_s();
    let bands = Bands::new(&VIRIDIS_FOR_LINES, BANDS, range(map.iter().copied()));
    planish_draw::cells::draw(&mut svg, &frame, map.view(), &bands, MOST_CELLS);
    frame.axes(&mut svg, ["x from the tool (mm)", "y from the tool (mm)"]);
    frame.colour_bar(&mut svg, &bands, "nm/s");
    frame.title(&mut svg, &titled("removal rate", name));
    finished(svg, &frame, 0.0)
}

/// Draws the sections of a tool along x and along y, through its peak, with its numbers.
fn sections(tif: &Tif, numbers: &ToolNumbers, name: &str) -> Picture {
    let mut svg = Svg::new(FONT_PX);
    let Grid { x, y } = tif.grid();
    let [x_peak, y_peak] = numbers.peak_mm;
    let along = |axis: &Axis, rate: &dyn Fn(f64) -> f64| -> Vec<[f64; 2]> {
        let step = (axis.end_mm() - axis.start_mm()) / SECTION_POINTS as f64;
        let places = (0..=SECTION_POINTS).map(|k| axis.start_mm() + k as f64 * step);
        places.map(|place| [place, rate(place)]).collect()
    };
    let along_x = along(x, &|place| tif.rate_at(place, y_peak));
    let along_y = along(y, &|place| tif.rate_at(x_peak, place));
    let all = || along_x.iter().chain(&along_y);
    let [low, high] = range(all().map(|point| point[1]));
    let top = if high > 0.0 { 1.08 * high } else { 1.0 };
    let scales = [Scale::linear(range(all().map(|p| p[0]))), Scale::linear([low.min(0.0), top])];
    let frame = Frame::new([0.0; 2], [MAP_PX, SECTION_PX], MARGIN_PX, scales);
    frame.grid(&mut svg);
    let [from, to] = scales[0].ends();
    frame.curve(&mut svg, [from, to].map(|place| [place, 0.5 * numbers.peak_nm_per_s]), "#888888");
    let width = |axis: usize| match numbers.half_maximum_width_mm[axis] {
        Some(mm) => format!("{} mm", significant(mm, 4)),
        None => "not within the samples".into(),
    };
    frame.curve(&mut svg, along_x.iter().copied(), LINES[0]);
    // Dashes, because the sections of a round tool are the same.
    for dash in along_y.chunks(DASH_POINTS).step_by(2) {
        frame.curve(&mut svg, dash.iter().copied(), LINES[1]);
    }
    frame.legend(&mut svg, &[("along x", LINES[0]), ("along y", LINES[1])]);
    frame.axes(&mut svg, ["place along the section (mm)", "removal rate (nm/s)"]);
    frame.title(&mut svg, &titled("sections through the peak", name));
    let lines = [
        format!("FWHM x {}, y {}; grey: half of the peak", width(0), width(1)),
        format!(
            "peak {} nm/s, volume rate {} nm mm\u{b2}/s",
            significant(numbers.peak_nm_per_s, 4),
            significant(numbers.volume_rate_nm_mm2_per_s, 4)
        ),
    ];
    for (k, line) in lines.iter().enumerate() {
        let below = frame.bottom() + MARGIN_PX[3] + (k as f64 + 0.5) * LINE_PX;
        svg.text([frame.left, below], "", line);
    }
    finished(svg, &frame, 2.0 * LINE_PX)
}

/// Returns a title with the name of the tool, if it has one.
fn titled(title: &str, name: &str) -> String {
    if name.is_empty() { title.into() } else { format!("{name}: {title}") }
}

/// Returns the picture of one plot, with so many px below its axis.
fn finished(svg: Svg, frame: &Frame, below_px: f64) -> Picture {
    let [_, _, right, bottom] = MARGIN_PX;
    let size_px = [frame.right() + right, frame.bottom() + bottom + below_px].map(f64::ceil);
    Picture { svg: svg.finish(size_px), size_px, varies: false }
}

/// Draws how a tool varies over the part. `surface` is a map of the part, whose pixels the tool acts on.
fn varying(variation: &Variation, surface: &Surface) -> Picture {
    let mut svg = Svg::new(FONT_PX);
    let grid = surface.grid();
    let [columns, rows] = [&grid.x, &grid.y]
        .map(|axis| PLACES.map(|f| axis.start_mm() + f * (axis.end_mm() - axis.start_mm())));
    let places: Vec<[f64; 2]> = rows.iter().rev().flat_map(|y| columns.map(|x| [x, *y])).collect();

    let map = rate_over_mean(variation, surface);
    let look = Look {
        colours: &BLUE_TO_BROWN,
        unit: "rate over its mean",
        title: "volume rate of the tool at a place",
    };
    let corners = ([0.0, 0.0], [MARGIN_PX[0], MARGIN_PX[1]]);
    let frame = part::draw(&mut svg, corners, surface, &map, &look);
    let map_bottom = frame.bottom();
    for (k, place) in places.iter().enumerate() {
        let [x, y] = frame.px(*place);
        svg.text([x, y + 0.36 * FONT_PX], MIDDLE, &(k + 1).to_string());
    }

    let left = MARGIN_PX[0] + MAP_PX + MARGIN_PX[2];
    let footprints: Vec<Array2<f64>> =
        places.iter().map(|p| variation.rate_at(Pose::along_x(*p))).collect();
    let offsets = variation.components()[0].kernel().grid();
    let bands = Bands::new(&VIRIDIS_FOR_LINES, BANDS, range(footprints.iter().flatten().copied()));
    let lengths = [&offsets.x, &offsets.y].map(side_mm);
    let longest = lengths[0].max(lengths[1]);
    let size = lengths.map(|mm| FOOTPRINT_PX * mm / longest);
    let scales = [offsets.x.edges_mm(), offsets.y.edges_mm()].map(Scale::linear);
    let step = FOOTPRINT_PX + GAP_PX;
    let mut last = None;
    for (k, footprint) in footprints.iter().enumerate() {
        let corner = [left + (k % 3) as f64 * step, MARGIN_PX[1] + (k / 3) as f64 * step];
        let margin = [0.0, 0.0, MARGIN_PX[2], 0.0];
        let frame = Frame::new(corner, size, margin, scales);
        planish_draw::cells::draw(&mut svg, &frame, footprint.view(), &bands, MOST_CELLS);
        let edge = format!("fill=\"none\" stroke=\"{INK}\"");
        svg.rectangle([frame.left, frame.top], size, &edge);
        svg.text([frame.left, frame.top - 5.0], "", &(k + 1).to_string());
        if k == 2 {
            frame.colour_bar(&mut svg, &bands, "nm/s");
        }
        last = Some(frame);
    }
    let nine_px = MARGIN_PX[1] + 3.0 * step;
    if let Some(frame) = last {
        let words = format!(
            "footprints, {} x {} mm{}",
            significant(lengths[0], 3),
            significant(lengths[1], 3),
            if variation.heading_weights().is_some() { ", motion along x" } else { "" }
        );
        svg.text([left, frame.bottom() + FONT_PX + 4.0], "", &words);
    }
    let width = left + 3.0 * step + MARGIN_PX[2];
    let mut height = (map_bottom + MARGIN_PX[3]).max(nine_px + FONT_PX);
    if let Some(time) = variation.time_factor() {
        let points: Vec<[f64; 2]> =
            time.time_s.iter().zip(&time.factor).map(|(t, c)| [*t, *c]).collect();
        let scales = [0, 1].map(|k| {
            let [low, high] = range(points.iter().map(|p| p[k]));
            let rim = if high > low { 0.04 * (high - low) } else { 0.5 };
            Scale::linear([low - rim, high + rim])
        });
        let size = [width - MARGIN_PX[0] - MARGIN_PX[2], TIME_PX];
        let frame = Frame::new([0.0, height], size, MARGIN_PX, scales);
        frame.grid(&mut svg);
        frame.curve(&mut svg, points.iter().copied(), LINES[0]);
        frame.axes(&mut svg, ["time since the start of the run (s)", "rate factor"]);
        height += MARGIN_PX[1] + TIME_PX + MARGIN_PX[3];
    }
    let size_px = [width, height].map(f64::ceil);
    Picture { svg: svg.finish(size_px), size_px, varies: true }
}

/// Returns the volume that the tool removes per second at each place, relative to its mean over the part, in the cells
/// of a coarse map. The motion heads along x, and the factor that the tool has for each pixel is included. NaN at
/// invalid pixels.
fn rate_over_mean(variation: &Variation, surface: &Surface) -> Array2<f64> {
    let factor = variation.factor_on(surface.grid());
    let volume: Vec<f64> =
        variation.components().iter().map(|c| c.kernel().rate_nm_per_s().sum()).collect();
    let map = part::cells(surface, |place, pixel| {
        let rate: f64 = volume
            .iter()
            .enumerate()
            .map(|(k, v)| v * variation.weight(k, Pose::along_x(place)))
            .sum();
        rate * factor.as_ref().map_or(1.0, |f| f[pixel])
    });
    let valid = map.iter().filter(|v| !v.is_nan());
    let mean = valid.clone().sum::<f64>() / valid.count().max(1) as f64;
    map / mean
}
