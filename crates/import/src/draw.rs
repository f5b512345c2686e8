//! A picture of a map that was read, as SVG text: x to the right, y upwards, one scale for both.
//!
//! Blue is low, yellow is high, grey is invalid. It is there to be compared with the picture on the
//! instrument: a map that is mirrored or turned cannot be told from its numbers.

use std::fmt::Write;

use ndarray::Array2;
use planish_numerics::ticks::round_numbers;
use planish_types::{
    Grid,
    text::{escaped, fixed, significant},
};

/// Larger side of the map, in pixels of the picture.
const SIZE_PX: f64 = 800.0;

/// Left, top, right, bottom of the map, in pixels of the picture.
const MARGIN_PX: [f64; 4] = [80.0, 60.0, 170.0, 60.0];

/// Least height of the bar of colours, in pixels of the picture: its two numbers stay apart.
const BAR_PX: f64 = 100.0;

/// Cells along the longer side; a cell is the mean of its valid pixels.
const CELLS: usize = 200;

/// Steps of the colours.
const LEVELS: usize = 48;

/// A way through the viridis map, which people who see fewer colours can order.
const COLOURS: [[f64; 3]; 9] = [
    [68.0, 1.0, 84.0],
    [71.0, 44.0, 122.0],
    [59.0, 81.0, 139.0],
    [44.0, 113.0, 142.0],
    [33.0, 144.0, 141.0],
    [39.0, 173.0, 129.0],
    [92.0, 200.0, 99.0],
    [170.0, 220.0, 50.0],
    [253.0, 231.0, 37.0],
];

/// What the values are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scale {
    /// Height in nm.
    HeightNm,
    /// Removal rate in nm/s.
    RateNmPerS,
}

/// A picture of `map` (ny, nx) on `grid`, with a title.
pub fn svg(grid: &Grid, map: &Array2<f64>, scale: Scale, title: &str) -> String {
    let (ny, nx) = map.dim();
    let pixels = [grid.x.step_mm(), grid.y.step_mm()];
    let low = [grid.x.start_mm() - 0.5 * pixels[0], grid.y.start_mm() - 0.5 * pixels[1]];
    let size = [nx as f64 * pixels[0], ny as f64 * pixels[1]];
    let px_per_mm = SIZE_PX / size[0].max(size[1]);
    let (width, height) = (size[0] * px_per_mm, size[1] * px_per_mm);
    let [left, top, right, bottom] = MARGIN_PX;
    let at =
        |x: f64, y: f64| [left + (x - low[0]) * px_per_mm, top + height - (y - low[1]) * px_per_mm];
    let valid = || map.iter().copied().filter(|v| !v.is_nan());
    let (least, most) =
        valid().fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), v| (a.min(v), b.max(v)));

    let mut out = String::new();
    put(
        &mut out,
        format_args!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{0:.0}\" height=\"{1:.0}\" \
             viewBox=\"0 0 {0:.2} {1:.2}\" font-family=\"sans-serif\" font-size=\"16\">\n\
             <rect width=\"100%\" height=\"100%\" fill=\"#ffffff\"/>\n\
             <text x=\"{left}\" y=\"24\">{2}</text>\n",
            (left + width + right).max(640.0),
            top + height.max(BAR_PX) + bottom,
            escaped(title)
        ),
    );
    cells(&mut out, map, [left, top], [width, height], least, most);
    put(
        &mut out,
        format_args!(
            "<rect x=\"{left}\" y=\"{top}\" width=\"{width:.2}\" height=\"{height:.2}\" \
             fill=\"none\" stroke=\"#000000\"/>\n"
        ),
    );
    for v in round_numbers(low[0], low[0] + size[0], 8.0) {
        let [x, y] = at(v, low[1]);
        put(
            &mut out,
            format_args!(
                "<path stroke=\"#000000\" d=\"M{x:.2} {y:.2}v6\"/>\
                 <text x=\"{x:.2}\" y=\"{:.2}\" text-anchor=\"middle\">{v}</text>\n",
                y + 23.0
            ),
        );
    }
    for v in round_numbers(low[1], low[1] + size[1], 8.0) {
        let [x, y] = at(low[0], v);
        put(
            &mut out,
            format_args!(
                "<path stroke=\"#000000\" d=\"M{x:.2} {y:.2}h-6\"/>\
                 <text x=\"{:.2}\" y=\"{:.2}\" text-anchor=\"end\">{v}</text>\n",
                x - 10.0,
                y + 5.0
            ),
        );
    }
    put(
        &mut out,
        format_args!(
            "<text x=\"{:.2}\" y=\"{:.2}\" text-anchor=\"middle\">x (mm)</text>\n\
             <text transform=\"translate(18 {:.2}) rotate(-90)\" text-anchor=\"middle\">y (mm)</text>\n",
            left + 0.5 * width,
            top + height + 48.0,
            top + 0.5 * height
        ),
    );
    bar(&mut out, [left + width + 30.0, top], height, least, most, scale);
    out.push_str("</svg>\n");
    out
}

/// Cells of one colour that follow each other in a row are one rectangle.
fn cells(
    out: &mut String,
    map: &Array2<f64>,
    [left, top]: [f64; 2],
    [width, height]: [f64; 2],
    least: f64,
    most: f64,
) {
    let (ny, nx) = map.dim();
    let block = nx.max(ny).div_ceil(CELLS);
    let (rows, columns) = (ny.div_ceil(block), nx.div_ceil(block));
    let level = |r: usize, c: usize| -> Option<usize> {
        let mut sum = (0.0, 0);
        for i in r * block..((r + 1) * block).min(ny) {
            for j in c * block..((c + 1) * block).min(nx) {
                let v = map[[i, j]];
                if !v.is_nan() {
                    sum = (sum.0 + v, sum.1 + 1);
                }
            }
        }
        let mean = if sum.1 == 0 { return None } else { sum.0 / f64::from(sum.1) };
        let fraction = if most > least { (mean - least) / (most - least) } else { 0.5 };
        Some(((fraction * LEVELS as f64) as usize).min(LEVELS - 1))
    };
    out.push_str("<g shape-rendering=\"crispEdges\">\n");
    let x_at = |c: usize| left + width * ((c * block).min(nx)) as f64 / nx as f64;
    let y_at = |r: usize| top + height * (1.0 - ((r * block).min(ny)) as f64 / ny as f64);
    for r in 0..rows {
        let levels: Vec<Option<usize>> = (0..columns).map(|c| level(r, c)).collect();
        let mut c = 0;
        while c < columns {
            let run = levels[c..].iter().take_while(|l| **l == levels[c]).count();
            let fill =
                levels[c].map_or("#bbbbbb".into(), |l| colour(l as f64 / (LEVELS - 1) as f64));
            put(
                out,
                format_args!(
                    "<path fill=\"{fill}\" d=\"M{:.1} {:.1}H{:.1}V{:.1}H{0:.1}Z\"/>\n",
                    x_at(c),
                    y_at(r),
                    x_at(c + run),
                    y_at(r + 1)
                ),
            );
            c += run;
        }
    }
    out.push_str("</g>\n");
}

fn bar(out: &mut String, [x, top]: [f64; 2], height: f64, least: f64, most: f64, scale: Scale) {
    let height = height.max(BAR_PX);
    let step = height / LEVELS as f64;
    for l in 0..LEVELS {
        put(
            out,
            format_args!(
                "<rect x=\"{x:.1}\" y=\"{:.2}\" width=\"18\" height=\"{:.2}\" fill=\"{}\"/>\n",
                top + height - (l + 1) as f64 * step,
                step + 0.3,
                colour(l as f64 / (LEVELS - 1) as f64)
            ),
        );
    }
    let unit = match scale {
        Scale::HeightNm => "nm",
        Scale::RateNmPerS => "nm/s",
    };
    // A map without a valid pixel has no range.
    for (y, v) in
        [(top + 12.0, most), (top + height, least)].into_iter().filter(|e| e.1.is_finite())
    {
        put(
            out,
            format_args!("<text x=\"{:.1}\" y=\"{y:.1}\">{} {unit}</text>\n", x + 26.0, short(v)),
        );
    }
}

/// Five digits.
fn short(v: f64) -> String {
    let digits = if v == 0.0 { 0 } else { 4 - v.abs().log10().floor() as i32 };
    if digits > 12 { significant(v, 5) } else { fixed(v, digits.max(0) as usize) }
}

fn colour(fraction: f64) -> String {
    let position = fraction.clamp(0.0, 1.0) * (COLOURS.len() - 1) as f64;
    let i = (position as usize).min(COLOURS.len() - 2);
    let f = position - i as f64;
    let [r, g, b] =
        [0, 1, 2].map(|k| (COLOURS[i][k] + f * (COLOURS[i + 1][k] - COLOURS[i][k])).round() as u8);
    format!("#{r:02x}{g:02x}{b:02x}")
}

/// Writing to a string does not fail.
fn put(out: &mut String, text: std::fmt::Arguments) {
    let _ = out.write_fmt(text);
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::array;
    use planish_types::Axis;

    #[test]
    fn the_last_row_is_at_the_top_and_invalid_pixels_are_grey() {
        let grid = Grid { x: Axis::new(0.0, 1.0, 2).unwrap(), y: Axis::new(0.0, 1.0, 2).unwrap() };
        let map = array![[0.0, 0.0], [1.0, f64::NAN]];
        let picture = svg(&grid, &map, Scale::HeightNm, "a < b");
        // 400 px per pixel below the margin of 60 px: the first row is one run at the bottom.
        assert!(picture.contains("<path fill=\"#440154\" d=\"M80.0 860.0H880.0V460.0"));
        assert!(picture.contains("<path fill=\"#fde725\" d=\"M80.0 460.0H480.0V60.0"));
        assert!(picture.contains("<path fill=\"#bbbbbb\" d=\"M480.0 460.0H880.0V60.0"));
        assert!(picture.contains("a &lt; b"));
    }
}
