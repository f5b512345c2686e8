//! Fills holes of a map with the smoothest surface that meets their rims.
//!
//! ```text
//! laplace z = 0 in the hole,  z as measured on its rim,
//! no slope across the border of the map and of the clear aperture
//! ```
//!
//! with the five-point formula, solved by conjugate gradients. A plane is filled exactly, and no
//! filled height leaves the range of the rim.
//!
//! Filling is needed for a method that cannot skip pixels (a Fourier transform, another program). The
//! solvers and judges of Planish skip invalid pixels and do better without filling: a filled height is a
//! guess that would count as a measurement.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | z | `surface` | (ny, nx) | nm |
//! | clear aperture | `inside` | (ny, nx) | - |

use ndarray::Array2;
use planish_types::{Invalid, Surface};
use serde::Serialize;

use crate::distance::nearest;

/// Residual at which the conjugate gradients end, relative to the residual of a hole filled with the mean of its rim.
/// Larger: less accurate heights. Smaller: it may never be reached in double precision. Derived: the condition number
/// of a hole of 1000 px is 1e6, so the heights are accurate to about 1e-6 of the range of the rim.
const TOLERANCE: f64 = 1e-12;

/// Ratio of filled pixels to all pixels that are valid after the filling, above which the report has a note. Larger: no
/// note on maps that are mostly guessed. Smaller: notes on usual holes.
const NOTEWORTHY_FRACTION: f64 = 0.05;

/// Numbers of the holes and pixels that were filled.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct FillReport {
    /// Number of holes. The pixels of a hole are connected by edges.
    pub holes: usize,
    /// Number of pixels that were filled.
    pub filled_pixels: usize,
    /// Ratio of filled pixels to all pixels that are valid after the filling.
    pub filled_fraction: f64,
    /// Largest distance of a filled pixel from the nearest measured one, mm.
    pub deepest_mm: f64,
    /// Note that much of the map is filled; absent if at most 5 % are.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub note: Option<String>,
}

/// Returns a mask (ny, nx) of the pixels in holes: invalid pixels that no chain of invalid neighbours connects to the
/// border of the map.
pub fn enclosed(surface: &Surface) -> Array2<bool> {
    let map = surface.height_nm();
    let (ny, nx) = map.dim();
    let mut hole = map.mapv(f64::is_nan);
    for region in regions(&hole) {
        if region.iter().any(|&(r, c)| r == 0 || c == 0 || r == ny - 1 || c == nx - 1) {
            region.into_iter().for_each(|pixel| hole[pixel] = false);
        }
    }
    hole
}

/// Fills the invalid pixels at which `inside` (ny, nx) is true; the others stay as they are. Refuses a hole without a
/// valid neighbour.
pub fn fill(surface: &Surface, inside: &Array2<bool>) -> Result<(Surface, FillReport), Invalid> {
    let map = surface.height_nm();
    let mut hole = map.mapv(f64::is_nan);
    hole.zip_mut_with(inside, |h, i| *h &= i);
    let mut filled = map.clone();
    let holes = regions(&hole);
    for region in &holes {
        fill_one(&mut filled, region, surface)?;
    }
    let filled_pixels = holes.iter().map(Vec::len).sum::<usize>();
    let distance = nearest(map.view(), surface.grid()).distance_mm;
    let deepest = holes.iter().flatten().map(|pixel| distance[*pixel]).fold(0.0, f64::max);
    let valid = filled.iter().filter(|v| !v.is_nan()).count();
    let filled_fraction = filled_pixels as f64 / valid as f64;
    let mut note = None;
    if filled_fraction > NOTEWORTHY_FRACTION {
        note = Some(format!(
            "{:.1} % of the map are filled, not measured; check the aperture and the mask",
            100.0 * filled_fraction
        ));
    }
    let report = FillReport {
        holes: holes.len(),
        filled_pixels,
        filled_fraction,
        deepest_mm: deepest,
        note,
    };
    Ok((Surface::new(*surface.grid(), filled)?, report))
}

/// Returns the regions of pixels (row, column) that are true; the pixels of a region are connected by edges.
fn regions(flags: &Array2<bool>) -> Vec<Vec<(usize, usize)>> {
    let mut open = flags.clone();
    let mut regions = Vec::new();
    for start in ndarray::indices(flags.dim()) {
        if !std::mem::take(&mut open[start]) {
            continue;
        }
        let mut region = vec![start];
        let mut next = 0;
        while next < region.len() {
            for (_, pixel) in neighbours(region[next], flags.dim()) {
                if std::mem::take(&mut open[pixel]) {
                    region.push(pixel);
                }
            }
            next += 1;
        }
        regions.push(region);
    }
    regions
}

/// Returns the neighbours of a pixel at left (side 0), right (1), below (2) and above (3) that are within the map, each
/// with the number of its side.
fn neighbours(
    (r, c): (usize, usize),
    (ny, nx): (usize, usize),
) -> impl Iterator<Item = (usize, (usize, usize))> {
    // A step below 0 wraps round, beyond the map.
    let all = [(r, c.wrapping_sub(1)), (r, c + 1), (r.wrapping_sub(1), c), (r + 1, c)];
    all.into_iter().enumerate().filter(move |(_, (r, c))| *r < ny && *c < nx)
}

/// Fills one region of `map` by solving `sum over neighbours n of w (z_i - z_n) = 0` for every pixel i. The weight w is
/// 1 over the squared step.
fn fill_one(
    map: &mut Array2<f64>,
    region: &[(usize, usize)],
    surface: &Surface,
) -> Result<(), Invalid> {
    let grid = surface.grid();
    let [wx, wy] = [grid.x, grid.y].map(|axis| axis.step_mm().powi(-2));
    let mut index = Array2::from_elem(map.dim(), usize::MAX);
    for (k, pixel) in region.iter().enumerate() {
        index[*pixel] = k;
    }
    let weight = [wx, wx, wy, wy];
    // A = diagonal - links; b = sum of w z over the rim.
    let mut diagonal = vec![0.0; region.len()];
    let mut links = vec![[usize::MAX; 4]; region.len()];
    let mut rim = vec![0.0; region.len()];
    let mut rim_sum = 0.0;
    let mut rim_count = 0.0;
    for (k, pixel) in region.iter().enumerate() {
        for (side, n) in neighbours(*pixel, map.dim()) {
            if index[n] != usize::MAX {
                links[k][side] = index[n];
                diagonal[k] += weight[side];
            } else if !map[n].is_nan() {
                diagonal[k] += weight[side];
                rim_sum += map[n];
                rim_count += 1.0;
            }
        }
    }
    if rim_count == 0.0 {
        let problem = format!("{} invalid pixel(s) have no valid neighbour", region.len());
        let remedy = "crop the map to the part that was measured";
        return Err(Invalid::at_index("height_nm", region[0], problem, remedy));
    }
    // Heights count from the mean of the rim, so that a large piston costs no digits.
    let mean = rim_sum / rim_count;
    for (k, pixel) in region.iter().enumerate() {
        for (side, n) in neighbours(*pixel, map.dim()) {
            if index[n] == usize::MAX && !map[n].is_nan() {
                rim[k] += weight[side] * (map[n] - mean);
            }
        }
    }
    let z = conjugate_gradients(&Laplace { diagonal, links, weight }, &rim);
    for (pixel, z) in region.iter().zip(z) {
        map[*pixel] = mean + z;
    }
    Ok(())
}

/// Matrix A of the five-point formula on the pixels of a region: the diagonal minus the links between neighbours.
struct Laplace {
    diagonal: Vec<f64>,
    /// Index within the region of the neighbour at each side; `usize::MAX` if there is none.
    links: Vec<[usize; 4]>,
    /// Weight of the neighbour at each side: 1 over the squared step, 1/mm^2.
    weight: [f64; 4],
}

impl Laplace {
    /// Returns A z, the five-point formula applied to the heights `z` of the region.
    fn apply(&self, z: &[f64]) -> Vec<f64> {
        let rows = self.links.iter().zip(&self.diagonal).zip(z).map(|((links, diagonal), own)| {
            let linked = links.iter().zip(self.weight).filter(|(n, _)| **n != usize::MAX);
            diagonal * own - linked.map(|(n, w)| w * z[*n]).sum::<f64>()
        });
        rows.collect()
    }

    /// Returns the residual `r` divided by the diagonal of A.
    fn precondition(&self, r: &[f64]) -> Vec<f64> {
        r.iter().zip(&self.diagonal).map(|(r, d)| r / d).collect()
    }
}

/// Solves A z = b by conjugate gradients, with the diagonal of A as the preconditioner.
fn conjugate_gradients(matrix: &Laplace, b: &[f64]) -> Vec<f64> {
    let mut z = vec![0.0; b.len()];
    let mut r = b.to_vec();
    let mut p = matrix.precondition(&r);
    let mut rho = dot(&r, &p);
    let goal = TOLERANCE * TOLERANCE * rho;
    // In exact arithmetic one step per pixel is enough.
    for _ in 0..2 * b.len() + 10 {
        if rho <= goal {
            break;
        }
        let q = matrix.apply(&p);
        let alpha = rho / dot(&p, &q);
        z.iter_mut().zip(&p).for_each(|(z, p)| *z += alpha * p);
        r.iter_mut().zip(&q).for_each(|(r, q)| *r -= alpha * q);
        let s = matrix.precondition(&r);
        let next = dot(&r, &s);
        p = s.iter().zip(&p).map(|(s, p)| s + next / rho * p).collect();
        rho = next;
    }
    z
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use planish_types::{Axis, Grid};

    fn grid() -> Grid {
        Grid { x: Axis::new(0.0, 0.1, 60).unwrap(), y: Axis::new(0.0, 0.2, 40).unwrap() }
    }

    fn with_holes(f: impl Fn(f64, f64) -> f64) -> Surface {
        let g = grid();
        let map = Array2::from_shape_fn(g.shape(), |(r, c)| {
            let round = (r as f64 - 12.0).hypot(c as f64 - 20.0) < 7.5;
            let bar = (25..28).contains(&r) && (10..50).contains(&c);
            let corner = r > 35 && c > 50;
            if round || bar || corner {
                f64::NAN
            } else {
                f(g.x.coordinate_mm(c), g.y.coordinate_mm(r))
            }
        });
        Surface::new(g, map).unwrap()
    }

    #[test]
    fn a_plane_is_filled_exactly_and_a_corner_is_no_hole() {
        let plane = |x: f64, y: f64| 500.0 - 7.0 * x + 3.0 * y;
        let surface = with_holes(plane);
        let (filled, report) = fill(&surface, &enclosed(&surface)).unwrap();
        // All invalid pixels but the 4 x 9 of the corner.
        let invalid = 2400 - surface.statistics().valid_count;
        assert_eq!((report.holes, report.filled_pixels), (2, invalid - 36));
        for ((r, c), z) in filled.height_nm().indexed_iter() {
            if r > 35 && c > 50 {
                assert!(z.is_nan());
            } else {
                let want = plane(grid().x.coordinate_mm(c), grid().y.coordinate_mm(r));
                // 1e-12 of 10 nm, times the hole's condition number of about 100.
                assert!((z - want).abs() < 1e-9, "{r} {c}: {z} {want}");
            }
        }
        // The bar is 3 px of 0.2 mm; the disc has a radius of 7 px along y and x: 7.5 * 0.1 from
        // its sides.
        assert!(report.deepest_mm > 0.7 && report.deepest_mm < 0.85, "{report:?}");
    }

    #[test]
    fn filled_heights_stay_within_the_rim_and_are_their_neighbours_mean() {
        let surface = with_holes(|x, y| (3.0 * x).sin() * 10.0 + y * y);
        let (filled, report) = fill(&surface, &enclosed(&surface)).unwrap();
        let was = surface.statistics();
        let now = filled.statistics();
        assert!(now.min >= was.min && now.max <= was.max);
        assert_eq!(now.valid_count, was.valid_count + report.filled_pixels);
        let z = filled.height_nm();
        let (wx, wy) = (100.0, 25.0);
        for (r, c) in [(12, 20), (10, 16), (26, 30)] {
            let laplace = wx * (z[[r, c - 1]] + z[[r, c + 1]] - 2.0 * z[[r, c]])
                + wy * (z[[r - 1, c]] + z[[r + 1, c]] - 2.0 * z[[r, c]]);
            assert!(laplace.abs() < 1e-7, "{laplace}");
        }
        // Measured pixels are untouched, bit for bit.
        for (a, b) in surface.height_nm().iter().zip(z) {
            assert!(a.is_nan() || a.to_bits() == b.to_bits());
        }
    }

    #[test]
    fn a_corner_within_the_aperture_is_filled_without_slope_across_the_border() {
        let surface = with_holes(|_, y| 4.0 * y);
        let everywhere = Array2::from_elem(grid().shape(), true);
        let (filled, report) = fill(&surface, &everywhere).unwrap();
        assert_eq!((report.holes, filled.statistics().valid_count), (3, 2400));
        assert!(report.note.as_ref().is_some_and(|n| n.contains("filled, not measured")));
        assert!(filled.statistics().max <= surface.statistics().max);
    }

    #[test]
    fn a_part_without_any_measurement_is_refused() {
        let mut map = Array2::zeros(grid().shape());
        map.slice_mut(ndarray::s![.., 30..]).fill(f64::NAN);
        let surface = Surface::new(grid(), map).unwrap();
        let inside = Array2::from_shape_fn(grid().shape(), |(_, c)| c != 35);
        // Columns 31 to 34 touch the measured part; 36 to 59 touch nothing.
        let error = fill(&surface, &inside).unwrap_err().to_string();
        assert!(error.contains("height_nm[0, 36]: 960 invalid pixel(s)"), "{error}");
    }
}
