//! Continuation of a map beyond its aperture, for solvers that need heights there (inverse filter, adjoint image).
//!
//! ```text
//! odd   z(p) = 2 z(e) - z(2e - p),   e the valid pixel nearest to p                        (1)
//! rise  z(p) = sum_ab c_ab T_a(y) T_b(x),   c fitted to the valid pixels and to a ring of (1)   (2)
//! ```
//!
//! T_a are Chebyshev polynomials on the extended map. The *ring* has all pixels that are at least a given distance from
//! the aperture. It keeps the polynomial from growing without limit. Valid pixels keep their value. Where the mirrored
//! pixel `2e - p` is not valid, (1) is the nearest value z(e).
//!
//! Source: T. Wang et al., Opt. Express 29 (2021) 15114 (the fit of correctable errors beyond the
//! aperture; their ring is a natural-neighbour interpolation).

use ndarray::{Array1, Array2, Axis as ArrayAxis, s};
use planish_numerics::{
    linear::skyline::{Factor, Skyline},
    parallel,
};
use planish_types::{Axis, Grid, Invalid};

/// Number of Chebyshev polynomials along y and x, those of the source of the module. Larger: the extension follows the
/// map more closely, and may swing beyond it. Smaller: it is smoother.
const POLYNOMIALS_Y_X: (usize, usize) = (6, 9);

/// Grid of a map with a border of pixels on every side, and everything that its extension needs except the heights.
pub(crate) struct Extension {
    /// Grid of the extended map.
    pub grid: Grid,
    /// Number of pixels of the border: [above and below, left and right].
    pub border: [usize; 2],
    /// Mask of the valid pixels of the extended map; the border has none.
    valid: Array2<bool>,
    /// Nearest valid pixel (row, column) of every pixel.
    nearest: Array2<(usize, usize)>,
    ring: Array2<bool>,
    /// Chebyshev polynomials T_a at the rows (ny, a) and T_b at the columns (nx, b) of the extended map.
    basis: (Array2<f64>, Array2<f64>),
    /// Factor of the normal equations of the fit (2) of the module; `None` if they are singular.
    factor: Option<Factor>,
}

impl Extension {
    /// Makes a border of `border` pixels [above and below, left and right] around the pixels of `grid`, of which
    /// `valid` is the mask. The ring of (2) of the module begins `ring_mm` from the nearest valid pixel.
    ///
    /// # Errors
    /// Refuses a border for which the extended map has no valid axis.
    pub fn new(
        grid: &Grid,
        valid: &Array2<bool>,
        border: [usize; 2],
        ring_mm: f64,
    ) -> Result<Self, Invalid> {
        let [rows, columns] = border;
        let x = widened(&grid.x, columns)?;
        let extended = Grid { x, y: widened(&grid.y, rows)? };
        let (ny, nx) = grid.shape();
        let mut wide = Array2::from_elem(extended.shape(), false);
        wide.slice_mut(s![rows..rows + ny, columns..columns + nx]).assign(valid);
        let nearest = nearest_valid(&wide, grid.x.step_mm(), grid.y.step_mm());
        let mut extension = Self {
            grid: extended,
            border,
            valid: wide,
            nearest,
            ring: Array2::from_elem(extended.shape(), false),
            basis: (
                chebyshev(extended.y.len(), POLYNOMIALS_Y_X.0),
                chebyshev(extended.x.len(), POLYNOMIALS_Y_X.1),
            ),
            factor: None,
        };
        extension.ring =
            Array2::from_shape_fn(extended.shape(), |p| extension.distance_mm(p) >= ring_mm);
        extension.factor = extension.normal_equations();
        Ok(extension)
    }

    /// Returns the distance of a pixel (row, column) of the extended map to the nearest valid one, mm.
    pub fn distance_mm(&self, (r, c): (usize, usize)) -> f64 {
        let (nr, nc) = self.nearest[[r, c]];
        let dy = r as f64 - nr as f64;
        let dx = c as f64 - nc as f64;
        (dx * self.grid.x.step_mm()).hypot(dy * self.grid.y.step_mm())
    }

    /// Returns the part of an extended map without the border.
    pub fn inner(&self, map: &Array2<f64>) -> Array2<f64> {
        let (ny, nx) = map.dim();
        let [rows, columns] = self.border;
        map.slice(s![rows..ny - rows, columns..nx - columns]).to_owned()
    }

    /// Returns the extended map for a map (ny, nx): valid pixels keep their values, those of the ring follow (1) of the
    /// module, the others (2). If the fit (2) is singular, all others follow (1). The values of invalid pixels do not
    /// matter.
    pub fn rise(&self, map: &Array2<f64>) -> Array2<f64> {
        let mut z = Array2::zeros(self.valid.dim());
        let (ny, nx) = map.dim();
        let [rows, columns] = self.border;
        z.slice_mut(s![rows..rows + ny, columns..columns + nx]).assign(map);
        let odd = Array2::from_shape_fn(z.dim(), |p| self.odd(&z, p));
        let Some(factor) = &self.factor else { return odd };
        // Phi' z over the valid pixels and the ring, as T_y' Z T_x.
        let (ty, tx) = &self.basis;
        let known = Array2::from_shape_fn(z.dim(), |p| if self.fitted(p) { odd[p] } else { 0.0 });
        let mut c: Vec<f64> = ty.t().dot(&known).dot(tx).iter().copied().collect();
        factor.solve(&mut c);
        let c = Array2::from_shape_vec(POLYNOMIALS_Y_X, c).expect("one per product");
        let polynomial = ty.dot(&c).dot(&tx.t());
        Array2::from_shape_fn(z.dim(), |p| if self.fitted(p) { odd[p] } else { polynomial[p] })
    }

    /// Returns true if the polynomial of (2) of the module is fitted to this pixel: a valid one, or one of the ring.
    fn fitted(&self, p: (usize, usize)) -> bool {
        self.valid[p] || self.ring[p]
    }

    /// Returns the odd reflection (1) of the module at a pixel p; on valid pixels it is the value itself.
    fn odd(&self, z: &Array2<f64>, p: (usize, usize)) -> f64 {
        let e = self.nearest[p];
        let mirrored = (2 * e.0).checked_sub(p.0).zip((2 * e.1).checked_sub(p.1));
        match mirrored.filter(|m| self.valid.get(*m) == Some(&true)) {
            Some(m) => 2.0 * z[e] - z[m],
            None => z[e],
        }
    }

    /// Returns the factor of the normal matrix of the polynomials over the fitted pixels. `None` if it is singular,
    /// for example if all valid pixels are on a line.
    fn normal_equations(&self) -> Option<Factor> {
        let (ty, tx) = &self.basis;
        let (a, b) = POLYNOMIALS_Y_X;
        let fitted = Array2::from_shape_fn(self.valid.dim(), |p| f64::from(self.fitted(p)));
        // sum over pixels of T_a T_a' T_b T_b': products along one axis, then along the other.
        let sums = column_products(ty).t().dot(&fitted).dot(&column_products(tx));
        let gram = Array2::from_shape_fn((a * b, a * b), |(p, q)| {
            let ((pa, pb), (qa, qb)) = ((p / b, p % b), (q / b, q % b));
            sums[[pa * a + qa, pb * b + qb]]
        });
        let largest = gram.diag().iter().copied().fold(0.0, f64::max);
        // Far below the noise of any map, far above the rounding of the sums.
        Skyline::from_dense(&(gram + Array2::<f64>::eye(a * b) * (1e-10 * largest))).factorise()
    }
}

/// Returns an axis with `border` more coordinates at each end.
fn widened(axis: &Axis, border: usize) -> Result<Axis, Invalid> {
    let start_mm = axis.start_mm() - border as f64 * axis.step_mm();
    Axis::new(start_mm, axis.step_mm(), axis.len() + 2 * border)
}

/// Returns the products of every column of t (m, k) with every column, as the columns of a matrix (m, k^2).
fn column_products(t: &Array2<f64>) -> Array2<f64> {
    let k = t.ncols();
    Array2::from_shape_fn((t.nrows(), k * k), |(i, q)| t[[i, q / k]] * t[[i, q % k]])
}

/// Returns the Chebyshev polynomials T_0 .. T_{count-1} (columns) at `n` points from -1 to 1 (rows).
fn chebyshev(n: usize, count: usize) -> Array2<f64> {
    let x = Array1::from_iter((0..n).map(|i| 2.0 * i as f64 / (n - 1) as f64 - 1.0));
    let mut t = Array2::ones((n, count));
    for k in 1..count {
        let next = match k {
            1 => x.clone(),
            _ => 2.0 * &x * t.column(k - 1) - t.column(k - 2),
        };
        t.column_mut(k).assign(&next);
    }
    t
}

/// Finds, for every pixel, the nearest valid one (row, column); at least one must be valid. The distance is Euclidean,
/// with a pitch of `dx` along a row and `dy` along a column.
///
/// Exact in two passes: nearest in the column, then the lower envelope of the parabolas
/// `(c - k)^2 dx^2 + d_k^2` along each row. Source: P. F. Felzenszwalb, D. P. Huttenlocher, Theory of
/// Computing 8 (2012) 415.
fn nearest_valid(valid: &Array2<bool>, dx: f64, dy: f64) -> Array2<(usize, usize)> {
    const NO_PIXEL: usize = usize::MAX;
    let (ny, nx) = valid.dim();
    let mut row_of = Array2::from_elem((ny, nx), NO_PIXEL);
    parallel::consume(row_of.axis_iter_mut(ArrayAxis(1)), &|c, mut column| {
        let mut last = NO_PIXEL;
        for r in 0..ny {
            if valid[[r, c]] {
                last = r;
            }
            column[r] = last;
        }
        let mut next = NO_PIXEL;
        for r in (0..ny).rev() {
            if valid[[r, c]] {
                next = r;
            }
            if next != NO_PIXEL && (column[r] == NO_PIXEL || next - r < r - column[r]) {
                column[r] = next;
            }
        }
    });
    let x: Vec<f64> = (0..nx).map(|k| k as f64 * dx).collect();
    let mut nearest = Array2::from_elem((ny, nx), (0, 0));
    parallel::consume(nearest.outer_iter_mut(), &|r, mut out| {
        // Square of the distance to the nearest pixel in column k.
        let d: Vec<f64> =
            (0..nx).map(|k| ((r as f64 - row_of[[r, k]] as f64) * dy).powi(2)).collect();
        let mut parabolas: Vec<usize> = Vec::new();
        let mut from: Vec<f64> = Vec::new();
        for q in (0..nx).filter(|q| row_of[[r, *q]] != NO_PIXEL) {
            loop {
                let Some(&v) = parabolas.last() else {
                    from.push(f64::NEG_INFINITY);
                    break;
                };
                let crossing = (d[q] + x[q].powi(2) - d[v] - x[v].powi(2)) / (2.0 * (x[q] - x[v]));
                if crossing > *from.last().expect("one per parabola") {
                    from.push(crossing);
                    break;
                }
                parabolas.pop();
                from.pop();
            }
            parabolas.push(q);
        }
        let mut k = 0;
        for c in 0..nx {
            while k + 1 < parabolas.len() && from[k + 1] < x[c] {
                k += 1;
            }
            out[c] = (row_of[[r, parabolas[k]]], parabolas[k]);
        }
    });
    nearest
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grid(nx: usize, ny: usize) -> Grid {
        Grid { x: Axis::new(0.0, 0.5, nx).unwrap(), y: Axis::new(-3.0, 0.4, ny).unwrap() }
    }

    #[test]
    fn nearest_is_nearest() {
        let valid = Array2::from_shape_fn((17, 23), |(r, c)| (r * 7 + c * 11) % 29 == 3);
        let found = nearest_valid(&valid, 0.5, 0.4);
        for ((r, c), (nr, nc)) in found.indexed_iter() {
            let d = |r2: usize, c2: usize| {
                ((c as f64 - c2 as f64) * 0.5).hypot((r as f64 - r2 as f64) * 0.4)
            };
            assert!(valid[[*nr, *nc]]);
            let all = valid.indexed_iter().filter(|(_, v)| **v).map(|((a, b), _)| d(a, b));
            // Rounding of distances, which may be equal.
            assert!(d(*nr, *nc) <= all.fold(f64::INFINITY, f64::min) + 1e-12, "{r} {c}");
        }
    }

    #[test]
    fn constants_and_planes_continue_and_valid_pixels_stay() {
        let g = grid(40, 30);
        let valid = Array2::from_elem(g.shape(), true);
        let e = Extension::new(&g, &valid, [9, 9], 3.2).unwrap();
        for (a, b) in [(0.0, 0.0), (0.3, -0.7)] {
            let plane = |x: f64, y: f64| 5.0 + a * x + b * y;
            let map = Array2::from_shape_fn(g.shape(), |(r, c)| {
                plane(g.x.coordinate_mm(c), g.y.coordinate_mm(r))
            });
            let found = e.rise(&map);
            assert_eq!(e.inner(&found), map);
            for ((r, c), z) in found.indexed_iter() {
                // Opposite a side, not a corner, the mirror is a reflection in the side; the ridge of
                // 1e-10 of the normal equations decides the rest.
                let expected = plane(e.grid.x.coordinate_mm(c), e.grid.y.coordinate_mm(r));
                assert!((z - expected).abs() < 1e-6, "{r} {c}: {z} {expected}");
            }
        }
    }

    #[test]
    fn a_hole_and_a_disk_are_filled_within_reason() {
        let g = grid(60, 60);
        let disk = Array2::from_shape_fn(g.shape(), |(r, c)| {
            let (y, x) = (r as f64 - 29.5, c as f64 - 29.5);
            x.hypot(y) < 25.0 && x.hypot(y - 5.0) > 3.0
        });
        let map = Array2::from_shape_fn(g.shape(), |(r, c)| {
            if disk[[r, c]] { (0.1 * r as f64).sin() + 0.05 * c as f64 } else { f64::NAN }
        });
        let e = Extension::new(&g, &disk, [10, 10], 4.0).unwrap();
        let found = e.rise(&map);
        // The map is within -1 and 4; an odd reflection doubles the way to the edge value.
        assert!(found.iter().all(|z| z.is_finite() && *z > -4.0 && *z < 7.0));
    }
}
