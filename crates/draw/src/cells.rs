//! A surface map drawn as rectangles, each filled with one colour, for pictures in a text format such as SVG.

use ndarray::{Array2, ArrayView2, s};

use crate::{
    colour::Bands,
    frame::Frame,
    svg::{Svg, put},
};

/// Draws `map` (shape ny, nx) over the whole of `frame`, row 0 at the lower edge of the frame. Averages blocks of
/// pixels so that there are at most `most` rectangles along the longer axis. Invalid pixels (NaN) stay blank. `bands`
/// give the colours of the means.
pub fn draw(svg: &mut Svg, frame: &Frame, map: ArrayView2<'_, f64>, bands: &Bands, most: usize) {
    let (means, block) = block_means(map, most);
    // One path for every band, with a rectangle for every run of its cells, in pixels of the map.
    let (ny, nx) = map.dim();
    let edge = |k: usize, n: usize| (k * block).min(n);
    let mut paths = vec![String::new(); bands.colours().len()];
    for (r, row) in means.outer_iter().enumerate() {
        let y = edge(r, ny);
        let height = edge(r + 1, ny) - y;
        let cells: Vec<Option<usize>> =
            row.iter().map(|v| if v.is_nan() { None } else { Some(bands.index(*v)) }).collect();
        let mut c = 0;
        for equal in cells.chunk_by(|a, b| a == b) {
            let x = edge(c, nx);
            c += equal.len();
            if let Some(k) = equal[0] {
                let width = edge(c, nx) - x;
                put(&mut paths[k], format_args!("M{x} {y}h{width}v{height}h-{width}"));
            }
        }
    }
    svg.put(format_args!(
        "<g shape-rendering=\"crispEdges\" transform=\"translate({:.2} {:.2}) scale({:.6} {:.6})\">",
        frame.left,
        frame.bottom(),
        frame.width / nx as f64,
        -frame.height / ny as f64
    ));
    for (colour, path) in bands.colours().iter().zip(&paths) {
        svg.path(&format!("fill=\"{colour}\""), path);
    }
    svg.put(format_args!("</g>"));
}

/// Returns the means of the valid pixels of square blocks of `map`, and the side of a block in pixels of the map.
/// There are at most `most` blocks along the longer axis. A block is NaN if more than half of its pixels are invalid
/// (NaN).
fn block_means(map: ArrayView2<'_, f64>, most: usize) -> (Array2<f64>, usize) {
    let (ny, nx) = map.dim();
    let block = nx.max(ny).div_ceil(most);
    let shape = (ny.div_ceil(block), nx.div_ceil(block));
    let means = Array2::from_shape_fn(shape, |(r, c)| {
        let rows = r * block..((r + 1) * block).min(ny);
        let pixels = map.slice(s![rows, c * block..((c + 1) * block).min(nx)]);
        let valid = pixels.iter().filter(|v| !v.is_nan());
        let count = valid.clone().count();
        if 2 * count < pixels.len() { f64::NAN } else { valid.sum::<f64>() / count as f64 }
    });
    (means, block)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Scale, colour::VIRIDIS};

    fn drawn(map: &Array2<f64>, bands: &Bands) -> String {
        let scales = [Scale::linear([0.0, 1.0]); 2];
        let frame = Frame::new([0.0; 2], [560.0; 2], [64.0, 34.0, 86.0, 50.0], scales);
        let mut svg = Svg::new(14.0);
        draw(&mut svg, &frame, map.view(), bands, 100);
        svg.finish([710.0, 644.0])
    }

    #[test]
    fn y_goes_up_and_higher_is_lighter() {
        let bands = Bands::new(&VIRIDIS, 24, [0.0, 1.0]);
        // Two rows of 2 px: the lower one is dark.
        let svg = drawn(&Array2::from_shape_fn((2, 2), |(r, _)| r as f64), &bands);
        let cell = |k: usize, d: &str| format!("<path fill=\"{}\" d=\"{d}\"/>", bands.colours()[k]);
        assert!(svg.contains(&cell(0, "M0 0h2v1h-2")) && svg.contains(&cell(23, "M0 1h2v1h-2")));
        // From the lower left corner upwards.
        assert!(svg.contains("translate(64.00 594.00) scale(280.000000 -280.000000)"), "{svg}");
    }

    #[test]
    fn invalid_pixels_are_not_drawn() {
        let hole = |(r, c): (usize, usize)| if (r, c) == (1, 2) { f64::NAN } else { c as f64 };
        let bands = Bands::new(&VIRIDIS, 24, [0.0, 5.0]);
        let svg = drawn(&Array2::from_shape_fn((3, 6), hole), &bands);
        // Six columns in three rows, less one.
        assert_eq!(svg.matches('M').count(), 17, "{svg}");
    }

    #[test]
    fn a_large_map_is_drawn_in_few_cells_by_their_mean() {
        let map = Array2::from_shape_fn((301, 400), |(r, c)| ((r + c) % 2) as f64);
        let (means, block) = block_means(map.view(), 110);
        assert_eq!((means.dim(), block), ((76, 100), 4));
        assert!(means.iter().all(|v| *v == 0.5));
    }
}
