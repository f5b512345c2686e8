//! Nearest valid pixel of every pixel, without approximation.
//!
//! ```text
//! d^2(r, c) = min over valid (r', c') of (r - r')^2 dy^2 + (c - c')^2 dx^2
//!           = min over c' of (c - c')^2 dx^2 + g(r, c')^2
//! ```
//!
//! with g(r, c') the distance to the nearest valid pixel of column c'. The minimum over c' is the
//! lower envelope of parabolas, found for a whole row in one pass.
//!
//! A pixel is a rectangle of the size of the steps. Its nearest point to the centre of another pixel is the
//! middle of an edge, or a corner:
//!
//! ```text
//! d^2(r, c) = min over marked (r', c') of max(|r - r'| - 1/2, 0)^2 dy^2 + max(|c - c'| - 1/2, 0)^2 dx^2
//! ```
//!
//! This is the same minimum with sites half a step to either side, because the far edge is no nearer.
//!
//! Source: P. F. Felzenszwalb, D. P. Huttenlocher, Theory Comput. 8 (2012) 415, section 2.

use ndarray::{Array2, ArrayView1, ArrayView2, ArrayViewMut1};
use planish_types::Grid;
use rayon::prelude::*;

/// Distance of every pixel to its nearest valid pixel, and the index of that pixel.
pub(crate) struct Nearest {
    /// Distance to the nearest valid pixel (ny, nx), mm; 0 on a valid pixel.
    pub distance_mm: Array2<f64>,
    /// Index (row, column) of the nearest valid pixel, for every pixel (ny, nx).
    pub place: Array2<(usize, usize)>,
}

/// Finds the nearest valid pixel of every pixel. Among pixels at the same distance, the choice depends on the map
/// alone. `map` (NaN = invalid) must have at least one valid pixel.
pub(crate) fn nearest(map: ArrayView2<f64>, grid: &Grid) -> Nearest {
    let (ny, nx) = map.dim();
    // Row of the nearest valid pixel in the same column, if there is one.
    let mut in_column = Array2::from_elem((ny, nx), None);
    for c in 0..nx {
        let mut last: Option<usize> = None;
        for r in 0..ny {
            last = if map[[r, c]].is_nan() { last } else { Some(r) };
            in_column[[r, c]] = last;
        }
        last = None;
        for r in (0..ny).rev() {
            last = if map[[r, c]].is_nan() { last } else { Some(r) };
            let above = in_column[[r, c]];
            in_column[[r, c]] = match (above, last) {
                (Some(a), Some(b)) => Some(if r - a <= b - r { a } else { b }),
                (a, b) => a.or(b),
            };
        }
    }
    let [dx, dy] = [grid.x, grid.y].map(|axis| axis.step_mm());
    let rows: Vec<Vec<(f64, (usize, usize))>> = (0..ny)
        .into_par_iter()
        .map(|r| {
            let sites: Vec<(usize, usize, f64)> = (0..nx)
                .filter_map(|c| in_column[[r, c]].map(|row| (c, row)))
                .map(|(c, row)| (c, row, (r.abs_diff(row) as f64 * dy).powi(2)))
                .collect();
            envelope(&sites, nx, dx)
        })
        .collect();
    Nearest {
        distance_mm: Array2::from_shape_fn((ny, nx), |(r, c)| rows[r][c].0.sqrt()),
        place: Array2::from_shape_fn((ny, nx), |(r, c)| rows[r][c].1),
    }
}

/// Returns, for every column c of a row, the smallest `(c - c')^2 dx^2 + g^2` and the (row, column) of the site that
/// has it. A site (c', row, g^2) is the nearest valid pixel of column c'; `dx` is the pixel step, mm.
fn envelope(sites: &[(usize, usize, f64)], nx: usize, dx: f64) -> Vec<(f64, (usize, usize))> {
    // Sites on the envelope, and from which column on each is the lowest.
    let mut lowest: Vec<(usize, f64)> = Vec::with_capacity(sites.len());
    for (k, (c, _, g)) in sites.iter().enumerate() {
        let mut from = f64::NEG_INFINITY;
        while let Some((last, since)) = lowest.last() {
            let (c0, _, g0) = sites[*last];
            // (s - c)^2 + g / dx^2 = (s - c0)^2 + g0 / dx^2
            let (a, b) = (*c as f64, c0 as f64);
            from = ((g - g0) / (dx * dx) + a * a - b * b) / (2.0 * (a - b));
            if from > *since {
                break;
            }
            lowest.pop();
            from = f64::NEG_INFINITY;
        }
        lowest.push((k, from));
    }
    let mut current = 0;
    (0..nx)
        .map(|c| {
            while current + 1 < lowest.len() && lowest[current + 1].1 <= c as f64 {
                current += 1;
            }
            let (column, row, g) = sites[lowest[current].0];
            ((c.abs_diff(column) as f64 * dx).powi(2) + g, (row, column))
        })
        .collect()
}

/// Returns the distance (ny, nx), mm, of the centre of every pixel from the nearest point of a `marked` pixel; 0 in a
/// marked one. At least one pixel has to be marked.
pub(crate) fn to_marked(marked: &Array2<bool>, grid: &Grid) -> Array2<f64> {
    let (ny, nx) = marked.dim();
    let [dx, dy] = [grid.x, grid.y].map(|axis| axis.step_mm());
    // Squared distance from the marked pixels of the same column, infinite where there is none.
    let mut in_column = Array2::from_elem((ny, nx), f64::INFINITY);
    for (mut column, marked) in in_column.columns_mut().into_iter().zip(marked.columns()) {
        lower_behind_marked(&mut column, marked, 0..ny, dy);
        lower_behind_marked(&mut column, marked, (0..ny).rev(), dy);
    }
    let mut distance = Array2::zeros((ny, nx));
    let rows = distance.outer_iter_mut().into_par_iter().zip(in_column.outer_iter());
    rows.for_each(|(mut to, squares)| {
        // Sites every half step, from half a step before the first column: edges and, between them, centres.
        let mut half_steps = vec![f64::INFINITY; 2 * nx + 1];
        for (c, square) in squares.iter().enumerate() {
            half_steps[2 * c..=2 * c + 2].iter_mut().for_each(|site| *site = site.min(*square));
        }
        let sites: Vec<(usize, usize, f64)> = half_steps
            .iter()
            .enumerate()
            .filter(|(_, square)| square.is_finite())
            .map(|(site, square)| (site, 0, *square))
            .collect();
        let nearest = envelope(&sites, 2 * nx + 1, 0.5 * dx);
        for (c, to) in to.iter_mut().enumerate() {
            *to = nearest[2 * c + 1].0.sqrt();
        }
    });
    distance
}

/// Lowers the squared distances of a column, mm^2, to those from the last marked pixel that precedes each of them in
/// the order of `rows`.
fn lower_behind_marked(
    column: &mut ArrayViewMut1<f64>,
    marked: ArrayView1<bool>,
    rows: impl Iterator<Item = usize>,
    dy: f64,
) {
    let mut last: Option<usize> = None;
    for r in rows {
        last = if marked[r] { Some(r) } else { last };
        if let Some(last) = last {
            let steps = (r.abs_diff(last) as f64 - 0.5).max(0.0);
            column[r] = column[r].min((steps * dy).powi(2));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use planish_types::Axis;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    #[test]
    fn equals_the_definition() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        for (ny, nx, fraction) in [(9, 14, 0.2), (20, 7, 0.03), (2, 2, 0.3), (31, 30, 0.9)] {
            let grid =
                Grid { x: Axis::new(0.0, 0.3, nx).unwrap(), y: Axis::new(5.0, 0.2, ny).unwrap() };
            let mut map = Array2::from_shape_simple_fn((ny, nx), || {
                if rng.random_range(0.0..1.0) < fraction { 1.0 } else { f64::NAN }
            });
            map[[ny - 1, nx / 2]] = 1.0;
            let found = nearest(map.view(), &grid);
            for (at, d) in found.distance_mm.indexed_iter() {
                let to = |(r, c): (usize, usize)| {
                    (0.2 * at.0.abs_diff(r) as f64).hypot(0.3 * at.1.abs_diff(c) as f64)
                };
                let valid = map.indexed_iter().filter(|(_, v)| !v.is_nan());
                let want = valid.map(|(p, _)| to(p)).fold(f64::INFINITY, f64::min);
                // Below: rounding of distances of up to 10 mm.
                assert!((d - want).abs() < 1e-12, "{at:?}: {d}, {want}");
                let place = found.place[at];
                assert!(!map[place].is_nan() && (to(place) - want).abs() < 1e-12);
            }
            let marked = map.mapv(|v| !v.is_nan());
            for (at, d) in to_marked(&marked, &grid).indexed_iter() {
                let beyond = |a: usize, b: usize| (a.abs_diff(b) as f64 - 0.5).max(0.0);
                let to = |(r, c)| (0.2 * beyond(at.0, r)).hypot(0.3 * beyond(at.1, c));
                let all = marked.indexed_iter().filter(|(_, marked)| **marked);
                let want = all.map(|(p, _)| to(p)).fold(f64::INFINITY, f64::min);
                // As above.
                assert!((d - want).abs() < 1e-12, "{at:?}: {d}, {want}");
            }
        }
    }
}
