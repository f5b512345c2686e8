//! B as an operator: by its columns, or by FFT.
//!
//! The columns are exact, but there may be too many of them to be stored. The FFT takes memory proportional to the map
//! ([`crate::model::fft_operator`]). It is exact if a pixel of the map has a whole number of samples of the TIF.

use ndarray::{Array2, Axis, s};
use planish_numerics::parallel;
use planish_types::{Grid, Invalid, Tif};

use crate::model::{
    columns::{self, Stored, ToolPlace},
    fft_operator::FftOperator,
    products::{Bundle, MOST_BUNDLED},
};

/// Largest number of elements of B that [`Operator`] stores (400 MB). Larger: more memory. Smaller: more problems use
/// the FFT.
const MAX_STORED_ELEMENTS: f64 = 5e7;

/// Largest number of elements of B that are held for a short time, or for a certificate in place of the FFT (2 GB).
/// Larger: more memory. Smaller: more problems use the FFT or are refused.
pub const MAX_COLUMN_ELEMENTS: f64 = 2.5e8;

/// Largest area of the TIF in pixels of the map; a larger TIF is refused. The TIF may exceed the map, but not by orders
/// of magnitude. Larger: mistakes in the pitch of a TIF exhaust the memory. Smaller: wide TIFs on fine maps are
/// refused.
const MAX_TIF_PIXELS: f64 = 2.7e8;

/// Largest number n of dwell points for which the normal matrix (n, n) is stored (288 MB); more are refused. Larger:
/// memory grows with the square. Smaller: fewer problems can be solved.
pub const MAX_MATRIX_POINTS: usize = 6000;

/// Returns the area of the rectangle of the TIF in pixels of the map, which may be more pixels than the map has.
pub fn pixels_under(tif: &Tif, grid: &Grid) -> f64 {
    tif.rate_nm_per_s().len() as f64 * tif.grid().pixel_mm2() / grid.pixel_mm2()
}

/// Returns [`pixels_under`]; refuses more than [`MAX_TIF_PIXELS`], at which the units must be wrong.
fn covered_pixels(tif: &Tif, grid: &Grid) -> Result<f64, Invalid> {
    let pixels = pixels_under(tif, grid);
    if pixels <= MAX_TIF_PIXELS {
        return Ok(pixels);
    }
    Err(Invalid::whole(
        "rate_nm_per_s",
        format!("covers {pixels:.0} pixels of the map"),
        "check that the TIF and the map are both in mm",
    ))
}

/// The removal matrix B (pixels, n), in one of two forms.
pub enum Operator {
    /// The matrix, stored by columns.
    Stored(Stored),
    /// Operator that spreads the dwell times on the pixels and convolves them by FFT.
    Fft(Box<FftOperator>),
}

impl Operator {
    /// Makes B for the places of the tool in each column: stored if it is small enough, otherwise by FFT.
    ///
    /// # Errors
    /// Refuses a TIF that covers so many pixels that the units must be wrong.
    pub fn new(places: &[Vec<ToolPlace>], tif: &Tif, grid: &Grid) -> Result<Self, Invalid> {
        // A column has at most the pixels of the map.
        let pixels = covered_pixels(tif, grid)?.min((grid.x.len() * grid.y.len()) as f64);
        Ok(if places.len() as f64 * pixels <= MAX_STORED_ELEMENTS {
            Self::Stored(Stored::new(places, tif, grid))
        } else {
            Self::Fft(Box::new(FftOperator::new(places, tif, grid)))
        })
    }

    /// Returns the name of the method: `columns` or `fft`.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Stored(_) => "columns",
            Self::Fft(_) => "fft",
        }
    }

    /// Returns true if B is exact but for rounding: stored by columns, or by FFT if [`FftOperator::is_exact`]. `tif`
    /// and `grid` must be those of B.
    pub fn is_exact(&self, tif: &Tif, grid: &Grid) -> bool {
        matches!(self, Self::Stored(_)) || FftOperator::is_exact(tif, grid)
    }

    /// Returns the removal `B t` (ny, nx), nm, for dwell times t (n), s.
    pub fn apply(&self, t: &[f64]) -> Array2<f64> {
        match self {
            Self::Stored(b) => b.apply(t),
            Self::Fft(b) => b.apply(t),
        }
    }

    /// Returns [`Self::adjoint`] from stored columns, and a faster approximation of it by FFT. The approximation
    /// includes the spill, by which the TIF extends a few pixels beyond its last samples.
    pub fn adjoint_with_spill(&self, map: &Array2<f64>) -> Vec<f64> {
        match self {
            Self::Stored(_) => self.adjoint(map),
            Self::Fft(operator) => operator.adjoint_with_spill(map),
        }
    }

    /// Returns the adjoint product `B' m` (n) for a map m (ny, nx).
    pub fn adjoint(&self, map: &Array2<f64>) -> Vec<f64> {
        let patches = match self {
            Self::Stored(b) => &b.patches,
            Self::Fft(operator) => return operator.adjoint(map),
        };
        parallel::map(patches.len(), &|j| {
            let p = &patches[j];
            let (r, c) = p.origin;
            let nx = p.rate_nm_per_s.ncols();
            let rows = p.rate_nm_per_s.outer_iter().enumerate();
            rows.map(|(i, rate)| rate.dot(&map.slice(s![r + i, c..c + nx]))).sum()
        })
    }
}

/// The removal matrix B for the exact gradient and the certificate of the bounded least squares: by FFT if the TIF has
/// the pitch of the map, otherwise by columns if they fit into memory, otherwise by FFT. Where a pixel has several
/// samples of the TIF, an FFT of all of them takes longer than the columns.
///
/// It sums in another order than [`Operator`], which stores fewer columns and prefers them.
pub enum Removal {
    /// The matrix, stored by columns.
    Stored(Stored),
    /// Operator that spreads the dwell times on the pixels and convolves them by FFT.
    Convolved(Box<FftOperator>),
}

impl Removal {
    /// Makes B for the places of the tool in each column. It is stored by columns if they have at most
    /// [`MAX_COLUMN_ELEMENTS`], `as_columns` allows it, and the TIF does not have the pitch of the map; otherwise it is
    /// by FFT.
    ///
    /// # Errors
    /// Refuses a TIF that covers so many pixels that the units must be wrong.
    pub fn new(
        places: &[Vec<ToolPlace>],
        tif: &Tif,
        grid: &Grid,
        as_columns: bool,
    ) -> Result<Self, Invalid> {
        let pixels = covered_pixels(tif, grid)?;
        let stored = as_columns
            && !FftOperator::has_pitch_of(tif, grid)
            && places.len() as f64 * pixels <= MAX_COLUMN_ELEMENTS;
        Ok(if stored {
            Self::Stored(Stored::new(places, tif, grid))
        } else {
            Self::Convolved(Box::new(FftOperator::new(places, tif, grid)))
        })
    }

    /// Returns the removal `B t` (ny, nx), nm, for dwell times t (n), s.
    pub fn apply(&self, t: &[f64]) -> Array2<f64> {
        match self {
            Self::Stored(b) => b.apply(t),
            Self::Convolved(b) => b.apply(t),
        }
    }

    /// Returns the adjoint product `B' m` (n) for a map m (ny, nx).
    pub fn adjoint(&self, map: &Array2<f64>) -> Vec<f64> {
        match self {
            Self::Stored(b) => b.adjoint(map),
            Self::Convolved(b) => b.adjoint(map),
        }
    }
}

/// Returns the normal matrix (n, n) of the least squares with a free piston, `B' W B - b b' / sum(w)` with b = B' w and
/// the weights w (ny, nx) of the pixels. Its unit is nm^2/s^2. Refuses more than [`MAX_MATRIX_POINTS`] columns, and a B
/// of more than [`MAX_COLUMN_ELEMENTS`].
pub fn normal_matrix(
    places: &[Vec<ToolPlace>],
    tif: &Tif,
    grid: &Grid,
    weight: &Array2<f64>,
) -> Result<Array2<f64>, Invalid> {
    let n = places.len();
    let pixels = pixels_under(tif, grid);
    if n > MAX_MATRIX_POINTS || n as f64 * pixels > MAX_COLUMN_ELEMENTS {
        return Err(Invalid::whole(
            "dwell_point_mm",
            format!("has {n} points, each of {pixels:.0} pixels of the map"),
            "this solver needs a matrix of at most 6000 points and 2.5e8 elements; use bounded-least-squares",
        ));
    }
    // W^1/2 B
    let mut patches = columns::patches(places, tif, grid);
    let root = weight.mapv(f64::sqrt);
    parallel::consume(&mut patches, &|_, p| {
        let w = p.part_of(&root);
        p.rate_nm_per_s *= &w;
    });
    let b: Vec<f64> =
        parallel::map(n, &|j| (&patches[j].rate_nm_per_s * &patches[j].part_of(&root)).sum());
    let total = weight.sum();
    let mut h = Array2::zeros((n, n));
    let rows = h.axis_chunks_iter_mut(Axis(0), MOST_BUNDLED);
    parallel::consume(rows.zip(patches.chunks(MOST_BUNDLED)), &|k, (mut rows, bundled)| {
        let bundle = Bundle::new(bundled.iter());
        let first = k * MOST_BUNDLED;
        for l in 0..first + bundled.len() {
            let dots = bundle.dots(&patches[l]);
            for (i, dot) in dots[..bundled.len()].iter().enumerate() {
                rows[[i, l]] = dot - b[first + i] * b[l] / total;
            }
        }
    });
    for j in 0..n {
        for k in 0..j {
            h[[k, j]] = h[[j, k]];
        }
    }
    Ok(h)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::fft_operator::Spread;
    use planish_testkit::maps::largest_difference;
    use planish_types::Axis;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    /// Name of a form of B, the product `B t` (ny, nx), and the adjoint product `B' m` (n).
    type Pair<'a> = (&'a str, Array2<f64>, Vec<f64>);

    /// Checks `<B t, m> = <t, B' m>` for every form of B, on a random map, tool and path; the pitch of the TIF is that
    /// of the map or another one.
    fn adjoint_is_adjoint(seed: u64) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut axis = |step: f64, from: usize, to: usize| {
            Axis::new(rng.random_range(-2.0..2.0), step, rng.random_range(from..to)).unwrap()
        };
        let grid = Grid { x: axis(0.1, 3, 70), y: axis(0.13, 3, 50) };
        let same_pitch = seed.is_multiple_of(2);
        let pitch = if same_pitch { [0.1, 0.13] } else { [0.07, 0.16] };
        let own = Grid { x: axis(pitch[0], 4, 40), y: axis(pitch[1], 4, 40) };
        // Rough up to its border.
        let rate = Array2::from_shape_simple_fn(own.shape(), || rng.random_range(0.0..1.0));
        let tif = Tif::new(own, rate).unwrap();
        // Up to three places in a column, over the map, around it, and far away.
        let reach = |a: &Axis, t: &Axis| {
            (a.start_mm() - t.end_mm() - 1.0)..(a.end_mm() - t.start_mm() + 1.0)
        };
        let (x, y) = (reach(&grid.x, &own.x), reach(&grid.y, &own.y));
        let n = rng.random_range(1..80);
        let places: Vec<Vec<ToolPlace>> = (0..n)
            .map(|_| {
                let count = rng.random_range(0..4);
                let fraction = 1.0 / f64::from(count.max(1));
                let mut place = || {
                    let at = [rng.random_range(x.clone()), rng.random_range(y.clone())];
                    ToolPlace::new(at, fraction)
                };
                (0..count).map(|_| place()).collect()
            })
            .collect();
        let t: Vec<f64> = (0..n).map(|_| rng.random_range(-1.0..1.0)).collect();
        let m = Array2::from_shape_simple_fn(grid.shape(), || rng.random_range(-1.0..1.0));

        let stored = Operator::Stored(Stored::new(&places, &tif, &grid));
        let fft = Operator::Fft(Box::new(FftOperator::new(&places, &tif, &grid)));
        let removal = Removal::Stored(Stored::new(&places, &tif, &grid));
        let without_border = FftOperator::without_border(&places, &tif, &grid, Spread::Splines);
        let pairs: [Pair<'_>; 4] = [
            ("stored", stored.apply(&t), stored.adjoint(&m)),
            ("FFT", fft.apply(&t), fft.adjoint(&m)),
            ("stored for a certificate", removal.apply(&t), removal.adjoint(&m)),
            ("without a border", without_border.apply(&t), without_border.adjoint(&m)),
        ];
        // The error of a convolution by FFT is at each pixel at most some log2(N) roundings of |R| |S t| (both
        // Euclidean), for three transforms and two axes; Keys' weights sum to at most 1.25 per axis in
        // magnitude, and what spills is removed by four such convolutions more. Sums of columns are better.
        let length = |v: &mut dyn Iterator<Item = f64>| v.map(|v| v * v).sum::<f64>().sqrt();
        let transform = ((grid.x.len() + 45) * (grid.y.len() + 45)) as f64;
        let rate = length(&mut tif.with_ghosts().iter().copied());
        let total = |v: &mut dyn Iterator<Item = f64>| v.map(f64::abs).sum::<f64>();
        let size =
            rate * 1.25 * 1.25 * total(&mut t.iter().copied()) * total(&mut m.iter().copied());
        let allowed = 5.0 * 3.0 * 2.0 * transform.log2() * f64::EPSILON * size;
        for (name, b_t, b_m) in &pairs {
            let left = (b_t * &m).sum();
            let right: f64 = t.iter().zip(b_m).map(|(t, b)| t * b).sum();
            assert!(
                (left - right).abs() <= allowed,
                "{name}, seed {seed}: {left} {right} {allowed}"
            );
            // The tolerance is far below what the products are made of.
            let sizes = length(&mut b_t.iter().copied()) * length(&mut m.iter().copied());
            assert!(
                sizes == 0.0 || allowed < 1e-6 * sizes,
                "{name}, seed {seed}: {allowed} {sizes}"
            );
        }
        // Both are the same B, where the FFT is exact.
        if same_pitch {
            let apart = largest_difference(&pairs[0].1, &pairs[1].1);
            assert!(apart <= allowed, "seed {seed}: {apart} {allowed}");
        }
        assert_eq!(FftOperator::is_exact(&tif, &grid), same_pitch);
    }

    #[test]
    fn every_form_of_b_has_its_adjoint_on_random_problems() {
        (0..40).for_each(adjoint_is_adjoint);
    }
}
