//! The median of a sliding window over a map with invalid pixels.
//!
//! ```text
//! m[r, c] = median { z[r + i, c + j] : |i| <= hy, |j| <= hx, valid }
//! ```
//!
//! Beyond the border the map is mirrored (d c b a | a b c d | d c b a). An even number of valid
//! pixels takes the smaller of the two middle values.
//!
//! Source: T. S. Huang, IEEE Trans. Acoust. Speech Signal Process. 27 (1979) 13: the window's
//! histogram is updated, not rebuilt, when the window moves by one column. The bins are the
//! ranks of the values in the whole map, so that the median is exact.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | z | `map` | (ny, nx) | any |
//! | hy, hx | `half` | (2) | px |
//! | m | result | (ny, nx) | that of z |

use ndarray::{Array2, ArrayView2, Axis};
use planish_types::progress;
use rayon::prelude::*;

/// Mark of an invalid pixel in the place of its rank.
const INVALID: u32 = u32::MAX;

/// Number of rows that one task filters with one histogram. Larger: fewer tasks for the threads. Smaller:
/// more histograms to set up. The result does not depend on it.
const BAND: usize = 64;

/// Returns the median (ny, nx) over windows of `2 half + 1` pixels along (rows, columns); NaN where `map` is NaN.
pub fn median_filter(map: ArrayView2<f64>, half: (usize, usize)) -> Array2<f64> {
    let (ny, nx) = map.dim();
    let (sorted, rank) = ranks(map);
    let mut out = Array2::from_elem((ny, nx), f64::NAN);
    let pieces = progress::PieceCounter::new(ny.div_ceil(BAND));
    out.axis_chunks_iter_mut(Axis(0), BAND).into_par_iter().enumerate().for_each(
        |(band, mut out)| {
            let mut window = Histogram::new(sorted.len());
            for (i, mut line) in out.outer_iter_mut().enumerate() {
                let rows = mirrored(band * BAND + i, half.0, ny);
                let column = |c: isize| {
                    let c = mirror(c, nx);
                    rows.iter().map(move |&r| (r, c)).map(|at| rank[at]).filter(|k| *k != INVALID)
                };
                let reach = half.1 as isize;
                (-reach..=reach).flat_map(column).for_each(|k| window.add(k));
                for c in 0..nx {
                    if rank[[rows[half.0], c]] != INVALID {
                        line[c] = sorted[window.median() as usize];
                    }
                    let c = c as isize;
                    column(c - reach).for_each(|k| window.remove(k));
                    column(c + reach + 1).for_each(|k| window.add(k));
                }
                let end = nx as isize;
                (end - reach..=end + reach).flat_map(column).for_each(|k| window.remove(k));
            }
            progress::done(pieces.one_more());
        },
    );
    out
}

/// Returns the valid values in ascending order, and for every pixel the index of its value among them.
fn ranks(map: ArrayView2<f64>) -> (Vec<f64>, Array2<u32>) {
    let mut valid: Vec<_> = map.indexed_iter().filter(|(_, v)| !v.is_nan()).collect();
    valid.par_sort_unstable_by(|a, b| a.1.total_cmp(b.1).then_with(|| a.0.cmp(&b.0)));
    let mut rank = Array2::from_elem(map.dim(), INVALID);
    for (k, (pixel, _)) in valid.iter().enumerate() {
        rank[*pixel] = k as u32;
    }
    (valid.into_iter().map(|(_, v)| *v).collect(), rank)
}

/// Returns the indices `centre - half` to `centre + half`, mirrored at the borders into 0..n.
fn mirrored(centre: usize, half: usize, n: usize) -> Vec<usize> {
    let centre = centre as isize;
    let half = half as isize;
    (centre - half..=centre + half).map(|i| mirror(i, n)).collect()
}

/// Returns the index in 0..n to which the index `i` is mirrored: ... 1 0 | 0 1 .. n-1 | n-1 n-2 ...
fn mirror(i: isize, n: usize) -> usize {
    let i = i.rem_euclid(2 * n as isize) as usize;
    if i < n { i } else { 2 * n - 1 - i }
}

/// Number of pixels of each rank in the window, with sums over blocks of 64 and of 4096 ranks.
struct Histogram {
    count: Vec<u16>,
    of_64: Vec<u32>,
    of_4096: Vec<u32>,
    total: u32,
    /// Index of a block of 4096 ranks; `before` is the number of pixels of the window in the blocks before it.
    block: usize,
    before: u32,
}

impl Histogram {
    fn new(ranks: usize) -> Self {
        let blocks = (ranks >> 12) + 1;
        Self {
            count: vec![0; blocks << 12],
            of_64: vec![0; blocks << 6],
            of_4096: vec![0; blocks],
            total: 0,
            block: 0,
            before: 0,
        }
    }

    fn add(&mut self, rank: u32) {
        let k = rank as usize;
        self.count[k] += 1;
        self.of_64[k >> 6] += 1;
        self.of_4096[k >> 12] += 1;
        self.total += 1;
        self.before += u32::from(k >> 12 < self.block);
    }

    fn remove(&mut self, rank: u32) {
        let k = rank as usize;
        self.count[k] -= 1;
        self.of_64[k >> 6] -= 1;
        self.of_4096[k >> 12] -= 1;
        self.total -= 1;
        self.before -= u32::from(k >> 12 < self.block);
    }

    /// Returns the rank of the median: the rank with `(total - 1) / 2` pixels of the window before it. The window must
    /// not be empty.
    fn median(&mut self) -> u32 {
        let middle = (self.total - 1) / 2;
        while self.before > middle {
            self.block -= 1;
            self.before -= self.of_4096[self.block];
        }
        while self.before + self.of_4096[self.block] <= middle {
            self.before += self.of_4096[self.block];
            self.block += 1;
        }
        let mut before = self.before;
        let mut group = self.block << 6;
        while before + self.of_64[group] <= middle {
            before += self.of_64[group];
            group += 1;
        }
        let mut rank = group << 6;
        while before + u32::from(self.count[rank]) <= middle {
            before += u32::from(self.count[rank]);
            rank += 1;
        }
        rank as u32
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    /// Returns the median by its definition: it sorts the pixels of each window and takes the middle one.
    fn by_definition(map: &Array2<f64>, half: (usize, usize)) -> Array2<f64> {
        let (ny, nx) = map.dim();
        Array2::from_shape_fn((ny, nx), |(r, c)| {
            if map[[r, c]].is_nan() {
                return f64::NAN;
            }
            let mut values = Vec::new();
            for i in mirrored(r, half.0, ny) {
                values.extend(mirrored(c, half.1, nx).into_iter().map(|j| map[[i, j]]));
            }
            values.retain(|v| !v.is_nan());
            values.sort_by(f64::total_cmp);
            values[(values.len() - 1) / 2]
        })
    }

    #[test]
    fn equals_the_definition_bit_for_bit() {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        // Shapes on both sides of a band and of a block of ranks; windows larger than the map.
        let cases = [((5, 7), (1, 1)), ((130, 70), (4, 2)), ((64, 65), (0, 3)), ((3, 2), (4, 4))];
        for ((ny, nx), half) in cases {
            // Few distinct values, so that ties occur; a tenth invalid.
            let map = Array2::from_shape_simple_fn((ny, nx), || {
                let v = f64::from(rng.random_range(-40..40_i32));
                if rng.random_range(0.0..1.0) < 0.1 { f64::NAN } else { v * 0.5 }
            });
            let bits = |m: Array2<f64>| m.mapv(f64::to_bits);
            assert_eq!(
                bits(median_filter(map.view(), half)),
                bits(by_definition(&map, half)),
                "{ny} x {nx}, {half:?}"
            );
        }
    }

    #[test]
    fn a_window_without_reach_changes_nothing() {
        let map = Array2::from_shape_fn((9, 4), |(r, c)| (r * 7 + c * 3) as f64 % 5.0);
        assert_eq!(median_filter(map.view(), (0, 0)), map);
    }
}
