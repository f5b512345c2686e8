//! A form given by a map of heights: bicubic between the pixels, with slopes from splines along the runs of valid
//! pixels.
//!
//! ```text
//! m_(i-1) + 4 m_i + m_(i+1) = 3 (z_(i+1) - z_(i-1))        slopes along a run, per pixel               (1)
//! m_0 + 2 m_1 = (-5 z_0 + 4 z_1 + z_2) / 2                 at its ends: one cubic over two intervals   (2)
//! ```
//!
//! z_x follows from the rows, z_y from the columns, and z_xy from the columns of z_x. Over a rectangle of valid pixels
//! this is the tensor product of the splines (C. de Boor, A Practical Guide to Splines, chapters IV and XVII). At an
//! edge, one ring of pixels continues the map quadratically, so that slopes exist up to half a pixel beyond the centres
//! of the valid pixels. The form exists where the nearest pixel is valid, and nowhere else.

use ndarray::{Array2, ArrayViewMut1};
use planish_types::{Axis, Grid, Invalid, Surface};

use crate::{NM_PER_MM, jet::Jet};

/// Distance from the middle between two pixels, in pixels, up to which both count as the nearest one. It keeps rounding
/// from deciding.
const ON_THE_EDGE: f64 = 1e-9;

/// A form given by a map, with the slopes at its pixels.
#[derive(Clone, Debug)]
pub struct Sampled {
    map: Surface,
    /// Height, mm, its derivatives along x and along y, mm per pixel, and its mixed derivative; each (ny, nx). NaN
    /// where there is none.
    values: [Array2<f64>; 4],
}

impl Sampled {
    /// Returns the form of a map of heights along z, nm. Refuses a map without 2 x 2 valid pixels.
    pub fn new(map: &Surface) -> Result<Self, Invalid> {
        let mut z = map.height_nm().mapv(|nm| nm / NM_PER_MM);
        continue_by_one(&mut z);
        let mut zx = z.clone();
        zx.rows_mut().into_iter().for_each(slopes);
        let mut zy = z.clone();
        zy.columns_mut().into_iter().for_each(slopes);
        let mut zxy = zx.clone();
        zxy.columns_mut().into_iter().for_each(slopes);
        let form = Self { map: map.clone(), values: [z, zx, zy, zxy] };
        let (ny, nx) = map.height_nm().dim();
        let has_cell = (0..ny - 1).any(|r| (0..nx - 1).any(|c| form.is_cell(r, c)));
        if !has_cell {
            let remedy = "give a map with areas of valid pixels";
            return Err(Invalid::whole("form", "has no 2 x 2 valid pixels", remedy));
        }
        Ok(form)
    }

    /// Returns the pixel centres of the map.
    pub fn grid(&self) -> &Grid {
        self.map.grid()
    }

    /// Returns the centre [x, y] of the valid pixel that is nearest to the point `p` [x, y], mm.
    pub fn nearest_mm(&self, p: [f64; 2]) -> [f64; 2] {
        let (r, c) = self.map.nearest_valid(p);
        [self.grid().x.coordinate_mm(c), self.grid().y.coordinate_mm(r)]
    }

    /// Returns true if the four corners of the cell with the first row `r` and column `c` have heights and slopes.
    fn is_cell(&self, r: usize, c: usize) -> bool {
        let corner = |r, c| self.values.iter().all(|v| v[[r, c]].is_finite());
        corner(r, c) && corner(r, c + 1) && corner(r + 1, c) && corner(r + 1, c + 1)
    }

    /// Returns the height at (x, y), mm, with its derivatives; NaN where the form does not exist.
    pub(crate) fn jet(&self, [x, y]: [Jet; 2]) -> Jet {
        let grid = self.grid();
        let [s, t] = [(&grid.x, x), (&grid.y, y)].map(|(axis, v)| pixels(axis, v.value));
        let Some((r, c)) = self.cell_around(s, t) else { return Jet::constant(f64::NAN) };
        let along_x = basis(s - c as f64, grid.x.step_mm());
        let along_y = basis(t - r as f64, grid.y.step_mm());
        // Derivatives of these orders by x and y.
        let orders = [(0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2)];
        let mut sums = [0.0; 6];
        for (j, down) in [0, 1, 0, 1].into_iter().enumerate() {
            for (i, right) in [0, 1, 0, 1].into_iter().enumerate() {
                // The first two of the basis are of heights, the others of slopes.
                let which = usize::from(i > 1) + 2 * usize::from(j > 1);
                let value = self.values[which][[r + down, c + right]];
                for (sum, (by_x, by_y)) in sums.iter_mut().zip(orders) {
                    *sum += along_x[by_x][i] * along_y[by_y][j] * value;
                }
            }
        }
        Jet::composed(sums, [x, y])
    }

    /// Returns the row and the column of the first pixel of the cell that contains the point (s, t), in pixels along x
    /// and y. `None` where the nearest pixel is invalid or a corner lacks its slopes.
    fn cell_around(&self, s: f64, t: f64) -> Option<(usize, usize)> {
        let Grid { x, y } = self.grid();
        let mut nearest_pixels = pairs(nearest_pixels(t, y), nearest_pixels(s, x));
        if !nearest_pixels.any(|pixel| !self.map.height_nm()[pixel].is_nan()) {
            return None;
        }
        pairs(cells(t, y), cells(s, x)).find(|(r, c)| self.is_cell(*r, *c))
    }
}

/// Returns the indices of the pixels nearest to a coordinate, which is in pixels: two if it lies midway between them.
/// `None` in the place of an index beyond the axis.
fn nearest_pixels(coordinate: f64, axis: &Axis) -> [Option<usize>; 2] {
    let low = (coordinate - 0.5 - ON_THE_EDGE).ceil();
    let high = (coordinate + 0.5 + ON_THE_EDGE).floor();
    [low, high].map(|i| if i >= 0.0 && i < axis.len() as f64 { Some(i as usize) } else { None })
}

/// Returns the first pixel of the cell that contains a coordinate, which is in pixels. On a pixel centre, the cell
/// before it follows as the second choice.
fn cells(coordinate: f64, axis: &Axis) -> [Option<usize>; 2] {
    let i = (coordinate.max(0.0) as usize).min(axis.len() - 2);
    let on_node = (coordinate - i as f64) < ON_THE_EDGE && i > 0;
    [Some(i), if on_node { Some(i - 1) } else { None }]
}

/// Returns all pairs (row, column) of the indices that are not `None`.
fn pairs(
    rows: [Option<usize>; 2],
    columns: [Option<usize>; 2],
) -> impl Iterator<Item = (usize, usize)> {
    rows.into_iter().flatten().flat_map(move |r| columns.into_iter().flatten().map(move |c| (r, c)))
}

/// Returns the coordinate `mm` in pixels from the first pixel of the axis.
fn pixels(axis: &Axis, mm: f64) -> f64 {
    (mm - axis.start_mm()) / axis.step_mm()
}

/// Returns the cubic Hermite basis at f in [0, 1], and its first and second derivatives by a coordinate in mm. The four
/// functions belong to the heights at both ends, then to the slopes per pixel; `pixel_mm` is the size of a pixel.
fn basis(f: f64, pixel_mm: f64) -> [[f64; 4]; 3] {
    let end = f * f * (3.0 - 2.0 * f);
    let start = f * f * (f - 1.0);
    let first = 1.0 / pixel_mm;
    let second = 1.0 / (pixel_mm * pixel_mm);
    let rise = 6.0 * f * (1.0 - f);
    [
        [1.0 - end, end, start - f * (f - 1.0), start],
        [-rise, rise, 1.0 + f * (3.0 * f - 4.0), f * (3.0 * f - 2.0)].map(|v| first * v),
        [12.0 * f - 6.0, 6.0 - 12.0 * f, 6.0 * f - 4.0, 6.0 * f - 2.0].map(|v| second * v),
    ]
}

/// Gives every invalid pixel beside valid ones the mean of the quadratic continuations along x and y that exist.
fn continue_by_one(z: &mut Array2<f64>) {
    let map = z.clone();
    for (pixel, v) in z.indexed_iter_mut().filter(|(_, v)| v.is_nan()) {
        let all = [[0, 1], [0, -1], [1, 0], [-1, 0]].map(|side| continuation(&map, pixel, side));
        let valid: Vec<f64> = all.into_iter().filter(|v| !v.is_nan()).collect();
        if !valid.is_empty() {
            *v = valid.iter().sum::<f64>() / valid.len() as f64;
        }
    }
}

/// Returns the value at a pixel of the quadratic through the next three pixels in the direction [rows, columns]; NaN if
/// one of them is missing.
fn continuation(map: &Array2<f64>, (r, c): (usize, usize), [dr, dc]: [isize; 2]) -> f64 {
    let [a, b, d] = [1, 2, 3].map(|k| {
        let row = r.checked_add_signed(k * dr);
        let column = c.checked_add_signed(k * dc);
        row.zip(column).and_then(|pixel| map.get(pixel)).copied().unwrap_or(f64::NAN)
    });
    3.0 * a - 3.0 * b + d
}

/// Replaces the heights along a row or column by their slopes per pixel, for each run of valid pixels. NaN if a run has
/// one pixel.
fn slopes(mut line: ArrayViewMut1<f64>) {
    let n = line.len();
    let mut start = 0;
    while start < n {
        let end = (start..n).find(|i| line[*i].is_nan()).unwrap_or(n);
        if end > start {
            let z: Vec<f64> = (start..end).map(|i| line[i]).collect();
            for (i, m) in slopes_of_run(&z).into_iter().enumerate() {
                line[start + i] = m;
            }
        }
        start = end + 1;
    }
}

/// Returns the slopes, per pixel, of a run of heights at neighbouring pixels, by (1) and (2) of the module.
fn slopes_of_run(z: &[f64]) -> Vec<f64> {
    let n = z.len();
    match n {
        1 => return vec![f64::NAN],
        2 => return vec![z[1] - z[0]; 2],
        3 => {
            let ends =
                [-1.5 * z[0] + 2.0 * z[1] - 0.5 * z[2], 0.5 * z[0] - 2.0 * z[1] + 1.5 * z[2]];
            return vec![ends[0], 0.5 * (z[2] - z[0]), ends[1]];
        }
        _ => {}
    }
    // (1) between the ends (2), by elimination from the first to the last.
    let mut above = vec![0.0; n];
    let mut m = vec![0.0; n];
    above[0] = 2.0;
    m[0] = 0.5 * (-5.0 * z[0] + 4.0 * z[1] + z[2]);
    for i in 1..n {
        let (low, middle, high, right) = if i < n - 1 {
            (1.0, 4.0, 1.0, 3.0 * (z[i + 1] - z[i - 1]))
        } else {
            (2.0, 1.0, 0.0, 0.5 * (5.0 * z[i] - 4.0 * z[i - 1] - z[i - 2]))
        };
        let pivot = middle - low * above[i - 1];
        above[i] = high / pivot;
        m[i] = (right - low * m[i - 1]) / pivot;
    }
    for i in (0..n - 1).rev() {
        m[i] -= above[i] * m[i + 1];
    }
    m
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Form;

    fn grid() -> Grid {
        Grid { x: Axis::new(-10.0, 0.5, 41).unwrap(), y: Axis::new(-6.0, 0.4, 31).unwrap() }
    }

    fn map(mm: impl Fn(f64, f64) -> f64, valid: impl Fn(f64, f64) -> bool) -> Surface {
        let grid = grid();
        let height = Array2::from_shape_fn(grid.shape(), |(r, c)| {
            let (x, y) = (grid.x.coordinate_mm(c), grid.y.coordinate_mm(r));
            if valid(x, y) { 1e6 * mm(x, y) } else { f64::NAN }
        });
        Surface::new(grid, height).unwrap()
    }

    #[test]
    fn a_cubic_in_both_coordinates_is_exact() {
        let z = |x: f64, y: f64| {
            0.01 * x.powi(3) - 0.02 * x * x * y + 0.003 * (x * y).powi(3) * 1e-3 + y
        };
        let form = Form::sampled(&map(z, |_, _| true)).unwrap();
        for p in [[0.13, 0.21], [-9.9, 5.7], [9.99, -5.99], [3.0, 2.0]] {
            let at = form.point(p).unwrap();
            // Below: rounding of heights of some 30 mm, over the steps of 0.4 mm, and over their squares.
            assert!((at.sag_mm() - z(p[0], p[1])).abs() < 1e-12, "{p:?}");
            let [x, y] = p;
            let slope = 0.03 * x * x - 0.04 * x * y + 9e-6 * x * x * y.powi(3);
            assert!((at.gradient()[0] - slope).abs() < 1e-11, "{p:?}");
            let second = 0.06 * x - 0.04 * y + 1.8e-5 * x * y.powi(3);
            assert!((at.hessian()[0] - second).abs() < 1e-10, "{p:?}");
        }
        assert!(form.point([10.3, 0.0]).is_none());
    }

    #[test]
    fn a_sphere_on_a_disc_with_a_hole_has_its_slopes_up_to_the_edge() {
        let radius = 40.0_f64;
        let z = |x: f64, y: f64| radius - (radius * radius - x * x - y * y).sqrt();
        let inside = |x: f64, y: f64| {
            let r = x.hypot(y);
            r <= 5.6 && (x - 1.0).hypot(y) > 0.9
        };
        let form = Form::sampled(&map(z, inside)).unwrap();
        let sphere = Form::sphere(radius, [0.0; 2]).unwrap();
        let grid = grid();
        let mut pixels = 0;
        for (r, c) in (0..grid.y.len()).flat_map(|r| (0..grid.x.len()).map(move |c| (r, c))) {
            let p = [grid.x.coordinate_mm(c), grid.y.coordinate_mm(r)];
            match (form.point(p), inside(p[0], p[1])) {
                (Some(found), true) => {
                    pixels += 1;
                    let want = sphere.point(p).unwrap();
                    // Fourth derivative 3 / R^3 = 5e-5 times h^3 / 24 = 5e-3, and the continuation at the edge.
                    for k in 0..2 {
                        let error = (found.gradient()[k] - want.gradient()[k]).abs();
                        assert!(error < 5e-5, "{p:?}: {error:e}");
                    }
                }
                (None, false) => {}
                (found, valid) => panic!("{p:?}: {found:?} for a pixel whose validity is {valid}"),
            }
        }
        assert!(pixels > 400, "{pixels}");
    }

    #[test]
    fn a_map_of_scattered_pixels_is_refused() {
        let lonely = map(
            |_, _| 0.0,
            |x, y| (x.round() as i64 + y.round() as i64) % 9 == 0 && x == x.round(),
        );
        if let Err(e) = Sampled::new(&lonely) {
            assert!(e.to_string().contains("no 2 x 2 valid pixels"), "{e}");
        }
    }
}
