//! Noise of the map before the run that the plan has removed.
//!
//! A plan takes the noise n of the map before for figure and removes what the tool reaches of it, M n. The removal and
//! before - after then share this noise, and least squares take it for a higher rate and a narrower tool. The score
//! J' r that the noise adds has the mean
//!
//! ```text
//! s_j = sum over the waves of  v c M D_j
//! M   = (<R, R> / <B, B>)^(1/2)                 reach of the plan
//! v c = v - (1 - g) <B, B>,  from 0 to v        noise that map and removal share
//! g   = <R, B> / (<R, R> <B, B>)^(1/2)          coherence
//! D_j = <J_j, R> / <R, R>                       change of a wave of the removal by a parameter: 1 for the rate
//! ```
//!
//! with means over rings of the spectrum. The fit takes s off its score. Where the figure is large against the noise,
//! s is nothing. Where the plan was made from another map, or from the true figure, the coherence is lower where the
//! noise is, and s is 0.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | B | `before`, the map before the run | (ny, nx) | nm |
//! | R | `removal` | (ny, nx) | nm |
//! | J_j | `columns`, derivatives of the removal | (ny, nx) | nm |
//! | v | half of the spectrum of `rest` | rings | nm^2 |

use ndarray::Array2;
use planish_numerics::fft::{smooth_size, transform};
use planish_types::Grid;

/// Width of the margin that the taper of the maps takes off, in widths of the TIF. Larger: fewer pixels decide. Smaller:
/// the ends of the map leak into short waves, which have little but noise. Chosen.
const MARGIN_IN_WIDTHS: f64 = 1.0;

/// Standard error of s, over s. Larger: less is corrected in runs that remove little but noise. Smaller: errors of the
/// noise model go into the corrections. Chosen: M and v are known to some tenths.
pub const UNCERTAIN: f64 = 0.3;

/// Maps that decide on the noise in the plan; all are 0 where `valid` is 0.
pub struct Planned<'a> {
    /// Map before the run, nm; its invalid pixels do not matter.
    pub before: &'a Array2<f64>,
    /// Removal of the run, nm.
    pub removal: &'a Array2<f64>,
    /// Derivatives of the removal, nm per size.
    pub columns: &'a [Array2<f64>],
    /// Rest of the fit, nm.
    pub rest: &'a Array2<f64>,
    /// 1 where both maps are valid, else 0.
    pub valid: &'a Array2<f64>,
    /// Pixels.
    pub grid: &'a Grid,
    /// Width of the TIF, mm.
    pub width_mm: f64,
}

/// Sums over a ring of the spectrum.
#[derive(Clone, Default)]
struct Ring {
    waves: f64,
    /// <B, B>, <R, R>, <R, B> and the square of the rest.
    before: f64,
    removal: f64,
    both: f64,
    rest: f64,
    /// <J_j, R>
    columns: Vec<f64>,
}

impl Planned<'_> {
    /// The mean s of the score of every column.
    pub fn score(&self) -> Vec<f64> {
        let size = {
            let (ny, nx) = self.valid.dim();
            (smooth_size(ny), smooth_size(nx))
        };
        let steps = [self.grid.y.step_mm(), self.grid.x.step_mm()];
        let taper = self.taper(size);
        let squares: f64 = taper.iter().map(|w| w * w).sum();
        let count = self.columns.len();
        if squares <= 0.0 {
            return vec![0.0; count];
        }
        let transformed = |map: &Array2<f64>| {
            let valid = |at: (usize, usize)| {
                let v = map[at];
                if self.valid[at] > 0.0 && !v.is_nan() { v } else { 0.0 }
            };
            let weighted: f64 =
                self.valid.indexed_iter().map(|(at, _)| taper[at] * valid(at)).sum();
            let mean = weighted / taper.sum();
            let mut tapered = Array2::zeros(size);
            for (at, _) in self.valid.indexed_iter() {
                tapered[at] = taper[at] * (valid(at) - mean);
            }
            transform::forward(tapered.view())
        };
        let frequency = |k: usize, n: usize, step: f64| transform::frequency(k, n) / step;
        let longest_mm = (size.0 as f64 * steps[0]).max(size.1 as f64 * steps[1]);
        let ring_of = |(r, c): (usize, usize)| {
            let f = frequency(r, size.0, steps[0]).hypot(frequency(c, size.1, steps[1]));
            (f * longest_mm).round() as usize
        };
        let most = 0.5 * longest_mm * (1.0 / steps[0]).hypot(1.0 / steps[1]);
        let mut rings =
            vec![Ring { columns: vec![0.0; count], ..Ring::default() }; most.ceil() as usize + 2];
        let (before, removal) = (transformed(self.before), transformed(self.removal));
        let rest = transformed(self.rest);
        for (at, r) in removal.indexed_iter() {
            let ring = &mut rings[ring_of(at)];
            ring.waves += 1.0;
            ring.before += before[at].norm_sqr();
            ring.removal += r.norm_sqr();
            ring.both += (before[at] * r.conj()).re;
            ring.rest += rest[at].norm_sqr();
        }
        for (j, column) in self.columns.iter().enumerate() {
            for (at, v) in transformed(column).indexed_iter() {
                rings[ring_of(at)].columns[j] += (v * removal[at].conj()).re;
            }
        }
        // The sum over the waves of the padded map is one over its pixels; those of the part are valid.
        let part = self.valid.sum() / (size.0 * size.1) as f64;
        let mut score = vec![0.0; count];
        // The ring about zero is the mean, which says nothing.
        for ring in rings.iter().skip(1).filter(|r| r.removal > 0.0 && r.before > 0.0) {
            let per_wave = 1.0 / (ring.waves * squares);
            let coherence = ring.both / (ring.removal * ring.before).sqrt();
            let variance = 0.5 * ring.rest * per_wave;
            let shared = variance - (1.0 - coherence) * ring.before * per_wave;
            let reach = (ring.removal / ring.before).sqrt();
            let noise = part * ring.waves * shared.clamp(0.0, variance) * reach;
            for (s, column) in score.iter_mut().zip(&ring.columns) {
                *s += noise * column / ring.removal;
            }
        }
        score
    }

    /// 1 inside of the valid pixels, falling to 0 at their border.
    fn taper(&self, size: (usize, usize)) -> Array2<f64> {
        let sigma_mm = MARGIN_IN_WIDTHS * self.width_mm;
        let steps = [self.grid.y.step_mm(), self.grid.x.step_mm()];
        // Zeros around the map, so that its border is one
        let margin = steps.map(|step| (3.0 * sigma_mm / step).ceil() as usize);
        let (ny, nx) = self.valid.dim();
        let padded = (smooth_size(ny + margin[0]), smooth_size(nx + margin[1]));
        let mut large = Array2::zeros(padded);
        for (at, v) in self.valid.indexed_iter() {
            large[at] = *v;
        }
        let mut spectrum = transform::forward(large.view());
        for ((r, c), v) in spectrum.indexed_iter_mut() {
            let f = (transform::frequency(r, padded.0) / steps[0])
                .hypot(transform::frequency(c, padded.1) / steps[1]);
            *v *= (-0.5 * (2.0 * std::f64::consts::PI * f * sigma_mm).powi(2)).exp();
        }
        let smooth = transform::inverse(spectrum);
        let mut taper = Array2::zeros(size);
        for (at, valid) in self.valid.indexed_iter() {
            // On a straight border the mean of the valid pixels about it is a half.
            taper[at] = valid * (2.0 * smooth[at] - 1.0).clamp(0.0, 1.0);
        }
        taper
    }
}

#[cfg(test)]
mod tests {
    use planish_types::Axis;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    const SIGMA_MM: f64 = 1.0;
    const NOISE_NM: f64 = 0.5;

    fn grid() -> Grid {
        Grid { x: Axis::new(0.0, 0.25, 180).unwrap(), y: Axis::new(0.0, 0.25, 120).unwrap() }
    }

    /// Uniform numbers of the standard deviation `NOISE_NM`.
    fn noise(rng: &mut ChaCha8Rng) -> Array2<f64> {
        let one = || NOISE_NM * 3.0_f64.sqrt() * rng.random_range(-1.0..1.0);
        Array2::from_shape_simple_fn(grid().shape(), one)
    }

    /// A map with every wave of wave number k times `of((k SIGMA_MM)^2)`.
    fn filtered(map: &Array2<f64>, of: impl Fn(f64) -> f64) -> Array2<f64> {
        let (ny, nx) = map.dim();
        let mut spectrum = transform::forward(map.view());
        for ((r, c), v) in spectrum.indexed_iter_mut() {
            let f = [transform::frequency(r, ny), transform::frequency(c, nx)].map(|f| f / 0.25);
            *v *= of((2.0 * std::f64::consts::PI * SIGMA_MM).powi(2) * (f[0] * f[0] + f[1] * f[1]));
        }
        transform::inverse(spectrum)
    }

    /// What the plan reaches, and its derivative by the width.
    fn plan(map: &Array2<f64>) -> [Array2<f64>; 2] {
        let reach = |q: f64| (-0.5 * q).exp();
        [filtered(map, reach), filtered(map, |q| -q * reach(q))]
    }

    /// Means over `maps` maps of the score of rate and width: as it is found, and as it is with the noise of each map.
    /// The plan is made from the map before, or from another map of the same figure.
    fn scores(maps: u64, from_the_same: bool, with_hole: bool) -> [[f64; 2]; 2] {
        let grid = grid();
        let figure = Array2::from_shape_fn(grid.shape(), |(r, c)| {
            let (x, y) = (0.25 * c as f64, 0.25 * r as f64);
            4.0 * (0.35 * x + 0.4 * y).sin() + 0.01 * (x - 20.0).powi(2)
        });
        let valid = Array2::from_shape_fn(grid.shape(), |(r, c)| {
            let is_hole = with_hole && (r as f64 - 60.0).hypot(c as f64 - 60.0) < 25.0;
            f64::from(u8::from(!is_hole))
        });
        let mut sums = [[0.0; 2]; 2];
        for seed in 0..maps {
            let rng = &mut ChaCha8Rng::seed_from_u64(seed);
            let [first, after, other] = [noise(rng), noise(rng), noise(rng)];
            let from = &figure + if from_the_same { &first } else { &other };
            let columns = plan(&from).map(|c| c * &valid);
            let before = &figure + &first;
            let rest = (&first - &after) * &valid;
            let planned = Planned {
                before: &before,
                removal: &columns[0],
                columns: &columns,
                rest: &rest,
                valid: &valid,
                grid: &grid,
                width_mm: SIGMA_MM,
            };
            let of_noise = plan(if from_the_same { &first } else { &other });
            for (j, found) in planned.score().into_iter().enumerate() {
                sums[0][j] += found / maps as f64;
                sums[1][j] += (&of_noise[j] * &valid * &first).sum() / maps as f64;
            }
        }
        sums
    }

    #[test]
    fn the_score_is_that_of_the_noise_which_the_plan_has_removed() {
        for with_hole in [false, true] {
            let [found, is] = scores(40, true, with_hole);
            // Without a hole s = v A / (2 pi SIGMA_MM^2) for the rate, and -2 times it for the width.
            for j in 0..2 {
                assert!((found[j] / is[j] - 1.0).abs() < 0.2, "{with_hole}: {found:?} {is:?}");
            }
            // Of a plan from another map there is none.
            let [found, _] = scores(40, false, with_hole);
            assert!(found[0].abs() < 0.2 * is[0], "{with_hole}: {found:?} {is:?}");
        }
    }
}
