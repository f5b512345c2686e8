//! Picture of a tool that varies over the part: its removal rate over the part, its footprint at nine positions, and
//! its rate over time.

use ndarray::Array2;
use planish_draw::{
    Bands, Frame, Scale, Svg,
    colour::{BLUE_TO_BROWN, INK, LINES, VIRIDIS_FOR_LINES},
    frame::range,
    svg::MIDDLE,
};
use planish_types::{Pose, Surface, Tif, Variation, text::significant};

use super::part::{self, BANDS, FONT_PX, Look, MAP_PX, MOST_CELLS, RIGHT_BOTTOM_PX, side_mm};

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

/// Draws, as SVG, how the tool varies over the part; `None` for a tool that is the same everywhere. `surface` is a map
/// of the part, whose pixels the tool acts on.
pub fn picture(tif: &Tif, surface: &Surface) -> Option<String> {
    let variation = tif.variation()?;
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
    Some(svg.finish([width, height]))
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
