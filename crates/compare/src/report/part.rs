//! Picture of a quantity over the part (a map), as SVG.

use ndarray::Array2;
use planish_draw::{Bands, Frame, Scale, Svg, frame::range};
use planish_types::{Axis, Surface};

/// Height of the texts of the picture, px.
pub const FONT_PX: f64 = 14.0;

/// Width of the map, px. Larger: the picture does not fit beside the nine footprints of a tool. Smaller: the numbers
/// of the nine positions overlap.
pub(super) const MAP_PX: f64 = 380.0;

/// Margins of the map to the right and to the bottom, px. Larger: empty space. Smaller: numbers are cut off.
pub(super) const RIGHT_BOTTOM_PX: [f64; 2] = [96.0, 56.0];

/// Largest number of cells of a map along an axis. Larger: finer details and a larger file. Smaller: a coarser picture.
pub const MOST_CELLS: usize = 60;

/// Number of colours of the map. Larger: smoother colours and a larger file. Smaller: visible steps.
pub const BANDS: usize = 32;

/// Returns a quantity in at most [`MOST_CELLS`] x [`MOST_CELLS`] cells (ny, nx), each with the value at its middle
/// pixel. NaN if that pixel is not valid. `quantity` takes the position [x, y], mm, and the index [row, column] of the
/// pixel. The pixels are those of `surface`.
pub fn cells(surface: &Surface, quantity: impl Fn([f64; 2], [usize; 2]) -> f64) -> Array2<f64> {
    let grid = surface.grid();
    let every = grid.x.len().max(grid.y.len()).div_ceil(MOST_CELLS);
    let shape = (grid.y.len().div_ceil(every), grid.x.len().div_ceil(every));
    Array2::from_shape_fn(shape, |(r, c)| {
        let [r, c] =
            [(r, &grid.y), (c, &grid.x)].map(|(k, a)| (k * every + every / 2).min(a.len() - 1));
        let valid = !surface.height_nm()[[r, c]].is_nan();
        if valid {
            quantity([grid.x.coordinate_mm(c), grid.y.coordinate_mm(r)], [r, c])
        } else {
            f64::NAN
        }
    })
}

/// Appearance of a map that [`draw`] draws: colours, unit and title.
pub struct Look<'a> {
    /// Colours from the smallest to the largest value, each written `#rrggbb`.
    pub colours: &'a [&'a str],
    /// Unit of the values, which stands beside the colour bar.
    pub unit: &'a str,
    /// Title above the map.
    pub title: &'a str,
}

/// Draws `map`, the cells of a quantity on `surface`. The panel has its upper left corner at `corner`, and the map is
/// [left, top] px from there. Returns the frame of the map. `look` has its colours, unit and title.
pub fn draw(
    svg: &mut Svg,
    (corner, [left, top]): ([f64; 2], [f64; 2]),
    surface: &Surface,
    map: &Array2<f64>,
    look: &Look,
) -> Frame {
    let axes = [&surface.grid().x, &surface.grid().y];
    let [width, height] = axes.map(side_mm);
    let size = [MAP_PX, MAP_PX * (height / width).clamp(0.15, 2.0)];
    let [right, bottom] = RIGHT_BOTTOM_PX;
    let scales = axes.map(|axis| Scale::linear(axis.edges_mm()));
    let frame = Frame::new(corner, size, [left, top, right, bottom], scales);
    let bands = Bands::new(look.colours, BANDS, range(map.iter().copied()));
    planish_draw::cells::draw(svg, &frame, map.view(), &bands, MOST_CELLS);
    frame.axes(svg, ["x (mm)", "y (mm)"]);
    frame.colour_bar(svg, &bands, look.unit);
    frame.title(svg, look.title);
    frame
}

/// Returns the length of an axis between the outer edges of its first and last pixel, mm.
pub fn side_mm(axis: &Axis) -> f64 {
    axis.len() as f64 * axis.step_mm()
}
