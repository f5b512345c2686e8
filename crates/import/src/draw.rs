//! A picture of a map that was read, as SVG text: x to the right, y upwards, one scale for both.
//!
//! Blue is low, yellow is high, grey is invalid. It is there to be compared with the picture on the
//! instrument: a map that is mirrored or turned cannot be told from its numbers.

use ndarray::Array2;
use planish_draw::{Bands, Frame, Scale as AxisScale, Svg, cells, colour, frame::range};
use planish_types::Grid;

/// Size of the lettering, pixels of the picture. Larger: texts overlap. Smaller: they are hard to read.
const FONT_PX: f64 = 16.0;

/// Length of the larger side of the map, pixels of the picture. Larger: the picture does not fit onto a screen.
/// Smaller: details are lost.
const SIZE_PX: f64 = 800.0;

/// Margins at the left, top, right and bottom of the map, pixels of the picture. Larger: empty space.
/// Smaller: labels, title or bar of colours are cut off.
const MARGIN_PX: [f64; 4] = [80.0, 60.0, 170.0, 60.0];

/// Smallest width of the picture, and smallest height of the map in it without the margins, pixels of the picture.
/// Larger: empty space beside small maps. Smaller: the title or the bar of colours is cut off.
const LEAST_PX: [f64; 2] = [640.0, 100.0];

/// Largest number of cells along the longer side of the map; a cell has the colour of the mean of its valid pixels.
/// Larger: finer details and a larger file. Smaller: a coarser picture.
const CELLS: usize = 200;

/// Number of colours of the map. Larger: smoother colours and a larger file. Smaller: visible steps.
const LEVELS: usize = 48;

/// Quantity and unit of the values, for the label of the colour bar.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scale {
    /// Heights in nm.
    HeightNm,
    /// Removal rates in nm/s.
    RateNmPerS,
}

/// Returns a picture of `map` (ny, nx), in the unit that `scale` names, on `grid` as SVG text. `title` stands above it;
/// pixels that are NaN are grey.
pub fn svg(grid: &Grid, map: &Array2<f64>, scale: Scale, title: &str) -> String {
    let [x, y] = [grid.x.edges_mm(), grid.y.edges_mm()];
    let [width_mm, height_mm] = [x, y].map(|[low, high]| high - low);
    let px_per_mm = SIZE_PX / width_mm.max(height_mm);
    let size = [width_mm * px_per_mm, height_mm * px_per_mm];
    let scales = [AxisScale::linear(x), AxisScale::linear(y)];
    let frame = Frame::new([0.0; 2], size, MARGIN_PX, scales);
    let bands = Bands::new(&colour::VIRIDIS, LEVELS, range(map.iter().copied()));

    let mut svg = Svg::new(FONT_PX);
    frame.title(&mut svg, title);
    svg.rectangle([frame.left, frame.top], size, "fill=\"#bbbbbb\"");
    cells::draw(&mut svg, &frame, map.view(), &bands, CELLS);
    frame.axes(&mut svg, ["x (mm)", "y (mm)"]);
    let unit = match scale {
        Scale::HeightNm => "nm",
        Scale::RateNmPerS => "nm/s",
    };
    frame.colour_bar(&mut svg, &bands, unit);
    let [left, top, right, bottom] = MARGIN_PX;
    svg.finish([
        (left + frame.width + right).max(LEAST_PX[0]),
        top + frame.height.max(LEAST_PX[1]) + bottom,
    ])
}

#[cfg(test)]
mod tests {
    use planish_types::Axis;

    use super::*;
    use ndarray::array;

    #[test]
    fn the_last_row_is_at_the_top_and_invalid_pixels_are_grey() {
        let grid = Grid { x: Axis::new(0.0, 1.0, 2).unwrap(), y: Axis::new(0.0, 1.0, 2).unwrap() };
        let map = array![[0.0, 0.0], [1.0, f64::NAN]];
        let picture = svg(&grid, &map, Scale::HeightNm, "a < b");
        let bands = Bands::new(&colour::VIRIDIS, LEVELS, [0.0, 1.0]);
        let cell = |k: usize, d: &str| format!("<path fill=\"{}\" d=\"{d}\"/>", bands.colours()[k]);
        // In pixels of the map from the lower left corner, upwards; grey is below all of it.
        assert!(picture.contains("translate(80.00 860.00) scale(400.000000 -400.000000)"));
        assert!(picture.contains(&cell(0, "M0 0h2v1h-2")), "{picture}");
        assert!(picture.contains(&cell(LEVELS - 1, "M0 1h1v1h-1")), "{picture}");
        assert_eq!(picture.matches("v1h-").count(), 2);
        let grey = picture.find("fill=\"#bbbbbb\"").unwrap();
        assert!(grey < picture.find("crispEdges").unwrap());
        assert!(picture.contains("a &lt; b"));
    }
}
