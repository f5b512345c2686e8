//! Pictures as SVG text: maps with a section through them, and spectra.
//!
//! x is to the right, y upwards, axes are in mm. A map is drawn in cells, in bands of equal height. If it
//! has more pixels than the picture can show, a cell is the mean of its pixels. Invalid pixels are white.

use ndarray::Array2;
use planish_draw::{Bands, Frame, Scale, Svg, cells, colour, frame::range, svg::put};
use planish_types::{Grid, Invalid, text::fixed};

use crate::psd::Psd;

/// Height of the texts, px of the picture. Larger: labels overlap. Smaller: they are hard to read.
const FONT_PX: f64 = 14.0;

/// Width of a frame, px. Larger: the picture does not fit onto a page. Smaller: details are lost.
const WIDTH: f64 = 560.0;

/// Height of the frame of a section or of spectra, px. Larger: the picture does not fit onto a page.
/// Smaller: curves are flat.
const HEIGHT: f64 = 260.0;

/// Margins at the left, top, right and bottom of a frame, px. Larger: empty space. Smaller: labels, titles
/// or scales are cut off.
const MARGIN: [f64; 4] = [64.0, 34.0, 86.0, 50.0];

/// Largest number of cells along an axis of a map. Larger: finer details and a larger file. Smaller: a
/// coarser picture.
const MAX_CELLS: usize = 110;

/// Number of height bands of a map, one colour each. Larger: smoother colours and a larger file. Smaller:
/// visible steps.
const BANDS: usize = 24;

/// A map of heights or of rates, which is one of the pictures in a drawing.
#[derive(Clone, Debug)]
pub struct Panel {
    /// Title above the map.
    pub title: String,
    /// Grid of the pixels of the map.
    pub grid: Grid,
    /// Heights or rates of the map (ny, nx); NaN = invalid.
    pub map: Array2<f64>,
}

/// Settings of a drawing of maps.
#[derive(Clone, Debug)]
pub struct MapsSettings {
    /// Unit of the values of the maps (nm, or nm/s for rates), for the scales.
    pub unit: &'static str,
    /// y of the section through the maps, mm; `None` takes the middle of the first map.
    pub section_y_mm: Option<f64>,
    /// True to draw all maps in one colour scale.
    pub common_scale: bool,
    /// Map whose valid pixels are outlined in all pictures; `None` for no outline.
    pub outline: Option<Panel>,
}

/// Draws the maps one below the other, tall ones in two columns, and below them one section through all of them, as SVG
/// text. The text is empty without maps. Refuses a given section that meets none of the maps.
pub fn maps_svg(panels: &[Panel], settings: &MapsSettings) -> Result<String, Invalid> {
    let Some(first) = panels.first() else { return Ok(String::new()) };
    if let Some(y) = settings.section_y_mm
        && !panels.iter().any(|p| (p.grid.y.start_mm()..=p.grid.y.end_mm()).contains(&y))
    {
        let [low, high] = [first.grid.y.start_mm(), first.grid.y.end_mm()];
        let remedy = format!("the first goes from {low} to {high} mm");
        return Err(Invalid::whole("section_y_mm", format!("is {y}, no map is there"), remedy));
    }
    let y_mm =
        settings.section_y_mm.unwrap_or(0.5 * (first.grid.y.start_mm() + first.grid.y.end_mm()));
    let common = range(panels.iter().flat_map(|p| p.map.iter().copied()));
    let x_mm = range(panels.iter().flat_map(|p| p.grid.x.edges_mm()));
    // Flat maps stand one below the other, others in two columns.
    let tallest = panels.iter().map(|p| ratio(&p.grid)).fold(0.0, f64::max);
    let columns = if tallest > 0.45 && panels.len() > 1 { 2 } else { 1 };
    let cell = [WIDTH + MARGIN[0] + MARGIN[2], WIDTH * tallest + MARGIN[1] + MARGIN[3]];
    let mut svg = Svg::new(FONT_PX);
    for (k, panel) in panels.iter().enumerate() {
        let corner = [(k % columns) as f64 * cell[0], (k / columns) as f64 * cell[1]];
        let heights = if settings.common_scale { common } else { range(panel.map.iter().copied()) };
        map(&mut svg, panel, corner, heights, settings, y_mm);
    }
    let top = panels.len().div_ceil(columns) as f64 * cell[1];
    let sections: Vec<(&str, Vec<[f64; 2]>)> =
        panels.iter().filter_map(|p| Some((p.title.as_str(), section(p, y_mm)?))).collect();
    let heights = range(sections.iter().flat_map(|(_, points)| points.iter().map(|p| p[1])));
    let size = [cell[0] * columns as f64 - MARGIN[0] - MARGIN[2], HEIGHT];
    let scales = [Scale::linear(x_mm), Scale::linear(with_rim(heights))];
    let frame = Frame::new([0.0, top], size, MARGIN, scales);
    frame.axes(&mut svg, ["x (mm)", &format!("section ({})", settings.unit)]);
    if let Some(outline) = &settings.outline {
        let points = section(outline, y_mm).unwrap_or_default();
        let ends = range(points.iter().filter(|p| !p[1].is_nan()).map(|p| p[0]));
        for x in ends.into_iter().filter(|x| x.is_finite()) {
            frame.upright(&mut svg, x, "stroke=\"#888888\" stroke-dasharray=\"5 4\"");
        }
    }
    curves(&mut svg, &frame, &sections);
    frame.title(&mut svg, &format!("section at y = {} mm", fixed(y_mm, 3)));
    Ok(svg.finish([cell[0] * columns as f64, top + HEIGHT + MARGIN[1] + MARGIN[3]]))
}

/// Draws the spectra along x and y, and the radial one, on logarithmic axes, as SVG text.
pub fn psd_svg(psd: &Psd) -> String {
    let mut svg = Svg::new(FONT_PX);
    let lines = [
        ("along x", positive_points(&psd.frequency_x_per_mm, &psd.psd_x_nm2_mm)),
        ("along y", positive_points(&psd.frequency_y_per_mm, &psd.psd_y_nm2_mm)),
    ];
    let radial =
        [("radial mean", positive_points(&psd.frequency_radial_per_mm, &psd.psd_radial_nm2_mm2))];
    let total = WIDTH + MARGIN[0] + MARGIN[2];
    let size = [WIDTH, 1.4 * HEIGHT];
    for (k, (spectra, unit, title)) in [
        (&lines[..], "nm² mm", "one-sided, along lines"),
        (&radial[..], "nm² mm²", "two-dimensional"),
    ]
    .into_iter()
    .enumerate()
    {
        let scales = [0, 1].map(|axis| {
            let points = spectra.iter().flat_map(|(_, points)| points.iter());
            let powers = with_rim(range(points.map(|p| p[axis].log10())));
            Scale::logarithmic(powers.map(|power| 10_f64.powf(power)))
        });
        let frame = Frame::new([k as f64 * total, 0.0], size, MARGIN, scales);
        frame.axes(&mut svg, ["spatial frequency (1/mm)", &format!("PSD ({unit})")]);
        curves(&mut svg, &frame, spectra);
        frame.title(&mut svg, title);
    }
    svg.finish([2.0 * total, size[1] + MARGIN[1] + MARGIN[3]])
}

/// Returns the points [frequency, density] that a logarithmic picture can show. It omits the first bin, which contains
/// the mean, and densities that are not positive.
fn positive_points(frequency: &[f64], density: &[f64]) -> Vec<[f64; 2]> {
    let points = frequency.iter().zip(density).skip(1);
    points.filter(|(_, s)| **s > 0.0).map(|(f, s)| [*f, *s]).collect()
}

/// Returns the range of an axis of a plot: that of the data, wider by 4 % at both ends. About a single value it is
/// wider by 1 on each side.
fn with_rim([low, high]: [f64; 2]) -> [f64; 2] {
    let rim = if high > low { 0.04 * (high - low) } else { 1.0 };
    [low - rim, high + rim]
}

/// Returns the ratio of height to width of a drawing: that of the map, limited to 0.08 to 2. Without the limits, a
/// narrow strip would have no height, or more than a page of it.
fn ratio(grid: &Grid) -> f64 {
    let [width, height] = [&grid.x, &grid.y].map(|axis| axis.len() as f64 * axis.step_mm());
    (height / width).clamp(0.08, 2.0)
}

fn map(
    svg: &mut Svg,
    panel: &Panel,
    corner: [f64; 2],
    heights: [f64; 2],
    settings: &MapsSettings,
    section_y_mm: f64,
) {
    let scales = [&panel.grid.x, &panel.grid.y].map(|axis| Scale::linear(axis.edges_mm()));
    let frame = Frame::new(corner, [WIDTH, WIDTH * ratio(&panel.grid)], MARGIN, scales);
    let bands = Bands::new(&colour::VIRIDIS, BANDS, heights);
    cells::draw(svg, &frame, panel.map.view(), &bands, MAX_CELLS);
    if let Some(panel) = &settings.outline {
        outline(svg, &frame, panel);
    }
    frame.axes(svg, ["x (mm)", "y (mm)"]);
    let [right, y] = frame.px([frame.x.ends()[1], section_y_mm]);
    svg.path(
        "stroke=\"#000000\" stroke-width=\"2\"",
        &format!("M{:.1} {y:.1}h-8M{right:.1} {y:.1}h8", frame.left),
    );
    frame.colour_bar(svg, &bands, settings.unit);
    frame.title(svg, &panel.title);
}

/// Returns the points [x in mm, height] of the map row nearest to `y_mm`; the height is NaN where it is invalid. `None`
/// if `y_mm` is beyond the map.
fn section(panel: &Panel, y_mm: f64) -> Option<Vec<[f64; 2]>> {
    let [low, high] = panel.grid.y.edges_mm();
    if !(low..=high).contains(&y_mm) {
        return None;
    }
    let axis = &panel.grid.y;
    let row = ((y_mm - axis.start_mm()) / axis.step_mm()).round() as usize;
    let row = panel.map.row(row.min(axis.len() - 1));
    Some(row.iter().enumerate().map(|(c, z)| [panel.grid.x.coordinate_mm(c), *z]).collect())
}

/// Draws curves, each in a colour of its own, and their names if there are several.
fn curves(svg: &mut Svg, frame: &Frame, curves: &[(&str, Vec<[f64; 2]>)]) {
    for (k, (_, points)) in curves.iter().enumerate() {
        frame.curve(svg, points.iter().copied(), colour::of_line(k));
    }
    if curves.len() > 1 {
        let names = curves.iter().enumerate().map(|(k, (name, _))| (*name, colour::of_line(k)));
        frame.legend(svg, &names.collect::<Vec<_>>());
    }
}

/// Draws the edges between valid and invalid pixels of a map.
fn outline(svg: &mut Svg, frame: &Frame, panel: &Panel) {
    let (ny, nx) = panel.map.dim();
    let Grid { x, y } = &panel.grid;
    let [hx, hy] = [x, y].map(|axis| 0.5 * axis.step_mm());
    // Pixel (r - 1, c - 1); a border of invalid pixels is around the map.
    let mut valid = Array2::from_elem((ny + 2, nx + 2), false);
    for ((r, c), z) in panel.map.indexed_iter() {
        valid[[r + 1, c + 1]] = !z.is_nan();
    }
    let mut d = String::new();
    for r in 0..=ny {
        for c in 0..=nx {
            let left = x.start_mm() + c as f64 * x.step_mm() - hx;
            let below = y.start_mm() + r as f64 * y.step_mm() - hy;
            let [px, py] = frame.px([left, below]);
            if valid[[r + 1, c + 1]] != valid[[r + 1, c]] {
                let end = frame.px([left, below + 2.0 * hy])[1];
                put(&mut d, format_args!("M{px:.1} {py:.1}V{end:.1}"));
            }
            if valid[[r + 1, c + 1]] != valid[[r, c + 1]] {
                let end = frame.px([left + 2.0 * hx, below])[0];
                put(&mut d, format_args!("M{px:.1} {py:.1}H{end:.1}"));
            }
        }
    }
    svg.path("fill=\"none\" stroke=\"#ffffff\" stroke-width=\"1.5\"", &d);
}

#[cfg(test)]
mod tests {
    use super::*;
    use planish_types::Axis;

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
    fn a_map_fills_its_frame_and_has_its_title() {
        let svg = maps_svg(&[panel("a < b", 2, 2, |r, _| r as f64)], &settings()).unwrap();
        assert!(svg.contains("translate(64.00 594.00) scale(280.000000 -280.000000)"), "{svg}");
        assert!(svg.contains("a &lt; b"));
    }

    #[test]
    fn an_invalid_pixel_cuts_the_section() {
        let hole = |r: usize, c: usize| if (r, c) == (1, 2) { f64::NAN } else { c as f64 };
        let svg = maps_svg(&[panel("hole", 6, 3, hole)], &settings()).unwrap();
        let line = svg.split("stroke-width=\"1.5\" d=\"").nth(1).unwrap();
        assert_eq!(line.split('"').next().unwrap().matches('M').count(), 2, "{svg}");
    }

    #[test]
    fn a_section_that_meets_no_map_is_refused() {
        let panels = [panel("one", 2, 3, |r, _| r as f64), panel("two", 2, 6, |r, _| r as f64)];
        let at = |y| maps_svg(&panels, &MapsSettings { section_y_mm: Some(y), ..settings() });
        assert!(at(0.0).is_ok() && at(5.0).is_ok());
        let message = at(5.1).unwrap_err().to_string();
        assert!(
            message.contains("section_y_mm: is 5.1") && message.contains("0 to 2 mm"),
            "{message}"
        );
    }

    #[test]
    fn the_outline_is_the_edge_of_the_valid_pixels() {
        // One valid pixel in the middle of nine: four sides.
        let middle = |r: usize, c: usize| if (r, c) == (1, 1) { 0.0 } else { f64::NAN };
        let outlined = MapsSettings { outline: Some(panel("", 3, 3, middle)), ..settings() };
        let svg = maps_svg(&[panel("map", 3, 3, |_, _| 1.0)], &outlined).unwrap();
        let d = svg.split("stroke=\"#ffffff\" stroke-width=\"1.5\" d=\"").nth(1).unwrap();
        assert_eq!(d.split('"').next().unwrap().matches('M').count(), 4, "{svg}");
    }
}
