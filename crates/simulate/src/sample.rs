//! Random numbers of a run, from which the errors of a process are drawn.
//!
//! An error that one number decides draws that number; noise along the run draws one for every piece of the motion
//! or every stay. The rate of the Ornstein-Uhlenbeck process is drawn exactly: the mean over a piece and the value
//! at its end are jointly normal given the value at its start.

use ndarray::Array2;
use planish_numerics::orthogonal::legendre;
use planish_types::{Axis, Grid};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution as _, StandardNormal, StandardUniform};

use crate::{
    deviation::Deviation,
    error_budget::{Distribution, Noise},
    motion::Motion,
};

/// Draws a number for an error of size one: normal with the standard deviation 1, uniform in -1 .. 1, or 1 itself.
pub fn draw(distribution: Distribution, rng: &mut impl Rng) -> f64 {
    match distribution {
        Distribution::Normal => StandardNormal.sample(rng),
        Distribution::Uniform => {
            let u: f64 = StandardUniform.sample(rng);
            2.0 * u - 1.0
        }
        Distribution::Fixed => 1.0,
    }
}

/// Returns the generator of the random numbers of stream `index` of a seed.
pub fn stream(seed: u64, index: u64) -> ChaCha8Rng {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream(index);
    rng
}

/// Draws noise of a kind along `motion`, and adds it to the deviations `run`. `size` is its standard deviation, a
/// fraction, mm or s; for a tick it is the whole tick.
pub fn sample(noise: Noise, size: f64, motion: &Motion, rng: &mut impl Rng, run: &mut Deviation) {
    let mut normal = || -> f64 { StandardNormal.sample(rng) };
    let stays = motion.stay_s.len();
    match noise {
        Noise::Rate { correlation_s: tau } => {
            run.rate_of_piece.resize(motion.pieces.len(), 0.0);
            let mut x = normal();
            for (piece, rate) in motion.pieces.iter().zip(&mut run.rate_of_piece) {
                // The value at the end and the mean over the piece, given the value at the start
                let h = piece.duration_s / tau;
                let Mean { weight, variance } = Mean::over(h);
                let decay = (-h).exp();
                let end_variance = -(-2.0 * h).exp_m1();
                let covariance = weight * -(-h).exp_m1();
                let u = normal();
                let v = normal();
                let slope = if end_variance > 0.0 { covariance / end_variance.sqrt() } else { 0.0 };
                let left = (variance - weight * weight - slope * slope).max(0.0);
                *rate += size * (x * weight + slope * u + left.sqrt() * v);
                x = x * decay + end_variance.sqrt() * u;
            }
        }
        Noise::Position => {
            run.place_of_stay_mm.resize(stays, [0.0; 2]);
            for place in &mut run.place_of_stay_mm {
                place.iter_mut().for_each(|p| *p += size * normal());
            }
        }
        Noise::Jitter => {
            run.time_of_stay_s.resize(stays, 0.0);
            run.time_of_stay_s.iter_mut().for_each(|t| *t += size * normal());
        }
        Noise::Tick => {
            run.time_of_stay_s.resize(stays, 0.0);
            let mut before = part_of_tick(size, rng);
            for time in &mut run.time_of_stay_s {
                let after = part_of_tick(size, rng);
                *time += after - before;
                before = after;
            }
        }
    }
}

/// Draws the time by which an event is rounded to a tick, s: uniform within half a tick to both sides.
fn part_of_tick(tick_s: f64, rng: &mut impl Rng) -> f64 {
    let part: f64 = StandardUniform.sample(rng);
    tick_s * (part - 0.5)
}

/// Draws white noise of this standard deviation in every pixel (ny, nx), nm.
pub fn white(sigma_nm: f64, shape: (usize, usize), rng: &mut impl Rng) -> Array2<f64> {
    Array2::from_shape_simple_fn(shape, || {
        let xi: f64 = StandardNormal.sample(rng);
        sigma_nm * xi
    })
}

/// Returns the Legendre polynomials of these orders (along x, along y) over the rectangle of `grid`, each with an RMS
/// of one there, shape (ny, nx).
pub fn legendre_terms(grid: &Grid, orders: &[(usize, usize)]) -> Vec<Array2<f64>> {
    let largest = orders.iter().map(|(i, j)| *i.max(j)).max().unwrap_or(0);
    let [px, py] = [&grid.x, &grid.y].map(|axis| legendre_table(axis, largest));
    let terms = orders.iter().map(|&(i, j)| {
        let scale = ((2 * i + 1) as f64 * (2 * j + 1) as f64).sqrt();
        Array2::from_shape_fn(grid.shape(), |(r, c)| scale * px[c][i] * py[r][j])
    });
    terms.collect()
}

/// Returns the values of the Legendre polynomials of degree 0 to `largest` at every pixel of an axis.
fn legendre_table(axis: &Axis, largest: usize) -> Vec<Vec<f64>> {
    let half = 0.5 * (axis.end_mm() - axis.start_mm());
    let pixels = (0..axis.len()).map(|i| {
        let mut p = vec![0.0; largest + 1];
        let u =
            if half > 0.0 { (axis.coordinate_mm(i) - axis.start_mm()) / half - 1.0 } else { 0.0 };
        legendre(u, &mut p);
        p
    });
    pixels.collect()
}

/// Returns the orders (along x, along y) of the Legendre polynomials of total degree 1 to `degree`.
pub fn low_orders(degree: usize) -> Vec<(usize, usize)> {
    (1..=degree).flat_map(|d| (0..=d).map(move |i| (d - i, i))).collect()
}

/// Weights for the mean of an Ornstein-Uhlenbeck process of variance 1 over a piece; x is the duration of the piece
/// over the correlation time.
pub struct Mean {
    /// Covariance of the mean with the value at the start, a = (1 - exp(-x)) / x.
    pub weight: f64,
    /// Variance of the mean, 2 (x - 1 + exp(-x)) / x^2.
    pub variance: f64,
}

impl Mean {
    /// Computes the weights for a piece of x correlation times.
    pub fn over(x: f64) -> Self {
        let gone = -(-x).exp_m1();
        // The difference loses its digits below 1e-3; there the series errs by x^3 / 60.
        let variance =
            if x > 1e-3 { 2.0 * (x - gone) / (x * x) } else { 1.0 - x / 3.0 + x * x / 12.0 };
        Self { weight: gone / x, variance }
    }
}
