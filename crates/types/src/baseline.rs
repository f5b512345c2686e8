//! Baseline of a TIF: the plane on which its spot stands, which is of the measurement and not of the tool.
//!
//! A baseline is low beside the peak, and acts on all samples. Its volume therefore counts, not its height: 0.9 % of
//! the peak is 38 % of the volume in a field 10 standard deviations wide on either side. The outer samples decide:
//!
//! ```text
//! R = b + g . u + T exp(-d^2 / 2) + noise        on the outer samples, by least squares                        (1)
//! ```
//!
//! b and g are the baseline. The third term is the tail of a spot that the field cuts off, with d the offset from the
//! spot over its width. Both follow from the samples above half of the peak, as for an elliptical Gaussian.

use ndarray::Array2;

use crate::{
    Grid, Tif,
    regression::{Regression, regression},
};

/// Width of the border whose samples count as outer, over the shorter side of the field. Larger: more of a cropped spot
/// is among the outer samples. Smaller: fewer samples, and larger standard errors.
const OUTER: f64 = 0.1;

/// Largest fraction of the samples that may lie above half of the peak. A spot that fills more has no outer samples
/// without a tail, whose shape would be a guess. Derived: 4.36 sigma^2 for a Gaussian in a square field of 2.1 sigma on
/// either side.
const MOST_ABOVE_HALF: f64 = 0.25;

/// Fraction of zeros among the samples of the border, above which zeros count as not measured. Larger: a round field
/// counts as a square one. Smaller: a floor of rectified noise, of which half is 0, counts as a field with holes.
const MOST_ZEROS: f64 = 0.8;

/// Largest tail among the outer samples, over the peak, up to which the fit (1) of the module omits its third term.
/// Larger: tails count as a baseline. Smaller: a term that rounding determines.
const LEAST_TAIL: f64 = 1e-6;

/// Smallest ratio of a parameter of the baseline to its standard error, below which the parameter counts as noise.
/// Larger: baselines in much noise pass. Smaller: noise is called a baseline.
const LEAST_SIGNIFICANCE: f64 = 4.0;

/// Baseline of a TIF: the plane that the measurement adds below the spot.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Baseline {
    /// Mean rate of the baseline over the samples, nm/s; 0 if it does not differ from noise.
    pub level_nm_per_s: f64,
    /// Volume of this level over the volume of the TIF; negative if the level is.
    pub part_of_volume: f64,
    /// Volume that the tilt of the baseline moves from one side of the field to the other, over the volume of the TIF.
    /// It is 0 if the tilt does not differ from noise.
    pub tilted_part_of_volume: f64,
}

impl Baseline {
    /// Returns the baseline of a TIF (of the mean tool, if it varies); `None` if the spot fills the field, or if too
    /// few samples are outer.
    pub fn under(tif: &Tif) -> Option<Self> {
        let grid = tif.grid();
        let rate = tif.rate_nm_per_s();
        let peak = tif.peak_nm_per_s();
        let measured = measured(rate);
        let outer = outer(&measured)?;
        let count = measured.iter().filter(|is| **is).count() as f64;
        let above = rate.iter().filter(|v| **v >= 0.5 * peak).count() as f64;
        if above > MOST_ABOVE_HALF * count {
            return None;
        }
        let spot = Spot::above_half(grid, rate, peak);
        let middle = [&grid.x, &grid.y].map(|a| 0.5 * (a.start_mm() + a.end_mm()));
        let half = grid.size_mm().map(|size| 0.5 * size);
        let mut samples = Vec::new();
        for (place, _) in outer.indexed_iter().filter(|(_, is)| **is) {
            let [x, y] = [grid.x.coordinate_mm(place.1), grid.y.coordinate_mm(place.0)];
            samples.push(OuterSample {
                plane: [1.0, (x - middle[0]) / half[0], (y - middle[1]) / half[1]],
                tail: (-0.5 * spot.squared_offset([x, y])).exp(),
                rate: rate[place] / peak,
            });
        }
        let (plane, errors) = fitted_plane(&samples)?;
        let mut values: Vec<f64> = samples.iter().map(|s| s.rate).collect();
        values.sort_unstable_by(f64::total_cmp);
        let low = values[values.len() / 50];
        let [mut level, gx, gy] = [0, 1, 2]
            .map(|k| if plane[k].abs() > LEAST_SIGNIFICANCE * errors[k] { plane[k] } else { 0.0 });
        // The fit of a tail of another shape may swing below samples of which none is negative.
        if level < 0.0 && low >= 0.0 {
            level = 0.0;
        }
        // The mean of |g . u| over a rectangle is at most half of its largest value.
        let tilt = [gx, gy].map(|g| 0.5 * g.abs());
        let of_volume = count * peak / rate.sum();
        Some(Self {
            level_nm_per_s: level * peak,
            part_of_volume: level * of_volume,
            tilted_part_of_volume: (tilt[0] + tilt[1]) * of_volume,
        })
    }
}

/// A sample of the TIF near the border of the measured field.
struct OuterSample {
    /// Factors of the level b and of the two slopes g in (1) of the module, with g over half the field.
    plane: [f64; 3],
    /// Factor of the tail amplitude T in (1) of the module: exp(-d^2 / 2) at the sample.
    tail: f64,
    /// Measured rate over the peak of the TIF.
    rate: f64,
}

/// Returns the level b and the two slopes g of (1) of the module, over the peak, then their standard errors. The slopes
/// are per half field. `None` if the samples do not determine them.
fn fitted_plane(samples: &[OuterSample]) -> Option<([f64; 3], [f64; 3])> {
    let largest_tail = samples.iter().map(|s| s.tail).fold(0.0, f64::max);
    if largest_tail <= LEAST_TAIL {
        let rows: Vec<_> = samples.iter().map(|s| (s.plane, s.rate)).collect();
        return regression(&rows).map(|fit| (fit.parameters, fit.standard_errors));
    }
    let rows: Vec<_> =
        samples.iter().map(|s| ([s.plane[0], s.plane[1], s.plane[2], s.tail], s.rate)).collect();
    let Regression { parameters: [b, gx, gy, _], standard_errors: [of_b, of_gx, of_gy, _] } =
        regression(&rows)?;
    Some(([b, gx, gy], [of_b, of_gx, of_gy]))
}

/// Returns a mask of the samples that were measured. It is true everywhere, or where the rate is not 0 if nearly all of
/// the border is 0, as around a round field.
fn measured(rate: &Array2<f64>) -> Array2<bool> {
    let (ny, nx) = rate.dim();
    let border = rate.indexed_iter().filter(|((r, c), _)| is_edge(*r, ny) || is_edge(*c, nx));
    let zeros = border.clone().filter(|(_, v)| **v == 0.0).count() as f64;
    let is_round = zeros > MOST_ZEROS * border.count() as f64;
    rate.mapv(|v| !is_round || v != 0.0)
}

/// Returns true if an index is the first or the last of `n`.
fn is_edge(index: usize, n: usize) -> bool {
    index == 0 || index + 1 == n
}

/// Returns a mask of the measured samples near the border of the measured field, or `None` if no other sample is left.
fn outer(measured: &Array2<bool>) -> Option<Array2<bool>> {
    let (ny, nx) = measured.dim();
    let [rows, columns] = [measured.rows(), measured.columns()].map(|lines| {
        let is_measured: Vec<bool> =
            lines.into_iter().map(|line| line.iter().any(|is| *is)).collect();
        let first = is_measured.iter().position(|is| *is);
        let last = is_measured.iter().rposition(|is| *is);
        first.zip(last).map_or(0, |(first, last)| last - first + 1)
    });
    let width = ((OUTER * rows.min(columns) as f64).round() as usize).max(1);
    let mut inner = measured.clone();
    for _ in 0..width {
        let before = inner.clone();
        inner = Array2::from_shape_fn((ny, nx), |(r, c)| {
            !is_edge(r, ny)
                && !is_edge(c, nx)
                && before[[r, c]]
                && [(r - 1, c), (r + 1, c), (r, c - 1), (r, c + 1)].iter().all(|next| before[*next])
        });
    }
    if !inner.iter().any(|is| *is) {
        return None;
    }
    Some(Array2::from_shape_fn((ny, nx), |place| measured[place] && !inner[place]))
}

/// Centre and covariance of the spot of a TIF.
struct Spot {
    centre_mm: [f64; 2],
    /// Covariance of a Gaussian, [xx, xy, yy], mm^2.
    covariance_mm2: [f64; 3],
}

impl Spot {
    /// Returns the Gaussian that has the same centroid and second moments of the samples above half of its peak. The
    /// ellipse above half of its peak has the second moments `ln 2 / 2` times the covariance.
    fn above_half(grid: &Grid, rate: &Array2<f64>, peak: f64) -> Self {
        let above = rate.indexed_iter().filter(|(_, v)| **v >= 0.5 * peak);
        let places: Vec<[f64; 2]> =
            above.map(|((r, c), _)| [grid.x.coordinate_mm(c), grid.y.coordinate_mm(r)]).collect();
        let count = places.len() as f64;
        let [cx, cy] = [0, 1].map(|k| places.iter().map(|p| p[k]).sum::<f64>() / count);
        let mut squares = [0.0; 3];
        for [x, y] in places {
            squares[0] += (x - cx).powi(2);
            squares[1] += (x - cx) * (y - cy);
            squares[2] += (y - cy).powi(2);
        }
        // A sample stands for its cell.
        let [cell_x, cell_y] = [&grid.x, &grid.y].map(|a| a.step_mm().powi(2) / 12.0);
        let [xx, xy, yy] = squares.map(|sum| sum / count);
        let moments = [xx + cell_x, xy, yy + cell_y];
        let factor = 2.0 / std::f64::consts::LN_2;
        Self { centre_mm: [cx, cy], covariance_mm2: moments.map(|m| factor * m) }
    }

    /// Returns the squared offset d^2 of (1) of the module, in widths of the spot, at the offset `point_mm` [x, y].
    fn squared_offset(&self, point_mm: [f64; 2]) -> f64 {
        let [x, y] = [0, 1].map(|k| point_mm[k] - self.centre_mm[k]);
        let [xx, xy, yy] = self.covariance_mm2;
        (yy * x * x - 2.0 * xy * x * y + xx * y * y) / (xx * yy - xy * xy)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Axis;

    /// Returns a TIF with n x n samples of `rate` (x and y in mm) out to `half_mm`.
    fn tif(half_mm: f64, n: usize, rate: impl Fn(f64, f64) -> f64) -> Tif {
        let a = Axis::new(-half_mm, 2.0 * half_mm / (n - 1) as f64, n).unwrap();
        let of = |(r, c): (usize, usize)| rate(a.coordinate_mm(c), a.coordinate_mm(r));
        Tif::new(Grid { x: a, y: a }, Array2::from_shape_fn((n, n), of)).unwrap()
    }

    /// Returns a Gaussian with the standard deviations 2 and 1.2 mm, turned by 40 degrees, at (x, y) in mm.
    fn ellipse(x: f64, y: f64) -> f64 {
        let (sine, cosine) = 40.0_f64.to_radians().sin_cos();
        let (u, v) = (cosine * x + sine * y, cosine * y - sine * x);
        5.0 * (-0.5 * ((u / 2.0).powi(2) + (v / 1.2).powi(2))).exp()
    }

    fn gaussian(x: f64, y: f64) -> f64 {
        5.0 * (-0.125 * (x * x + y * y)).exp()
    }

    #[test]
    fn a_planted_plane_comes_back_under_spots_that_the_field_cuts_or_not() {
        for (half, worst) in [(20.0, 1e-3), (7.0, 1e-3), (6.0, 4e-3), (4.8, 5e-3)] {
            for level in [0.045, -0.045] {
                let found = Baseline::under(&tif(half, 41, |x, y| gaussian(x, y) + level)).unwrap();
                let of_volume = 41.0 * 41.0
                    / tif(half, 41, |x, y| gaussian(x, y) + level).rate_nm_per_s().sum();
                // Widths from the count of samples above half of the peak, seen: of the volume of a cut spot.
                assert!(
                    (found.part_of_volume - level * of_volume).abs() < worst,
                    "{half}: {found:?}"
                );
                assert!(found.tilted_part_of_volume < 1e-3, "{found:?}");
            }
            for spot in [gaussian, ellipse] {
                let found = Baseline::under(&tif(half, 41, spot)).unwrap();
                assert!(found.part_of_volume.abs() < worst, "{half}: {found:?}");
            }
        }
        // A tilt from -0.9 to 0.9 % of the peak holds no volume and moves 0.225 % x 1681 samples: half of what it has
        // on either side, in the mean over the field.
        let found =
            Baseline::under(&tif(20.0, 41, |x, y| gaussian(x, y) + 0.045 * x / 20.0)).unwrap();
        let moved = 0.5 * 0.045 * 1681.0 / (8.0 * std::f64::consts::PI * 5.0);
        assert!((found.tilted_part_of_volume / moved - 1.0).abs() < 0.01, "{found:?} {moved}");
        assert!(found.part_of_volume.abs() < 1e-3);
    }

    #[test]
    fn a_round_field_and_a_floor_of_rectified_noise_have_a_baseline_and_noise_has_none() {
        let round = |x: f64, y: f64| if x.hypot(y) < 19.0 { gaussian(x, y) + 0.045 } else { 0.0 };
        let found = Baseline::under(&tif(20.0, 41, round)).unwrap();
        assert!((found.level_nm_per_s / 0.045 - 1.0).abs() < 1e-3, "{found:?}");
        // Noise of 1 % of the peak, by the sum of twelve uniform numbers.
        let mut state = 1_u64;
        let mut uniform = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            (state >> 11) as f64 / (1_u64 << 53) as f64
        };
        let noise: Vec<f64> =
            (0..1681).map(|_| 0.05 * ((0..12).map(|_| uniform()).sum::<f64>() - 6.0)).collect();
        let with = |of: &dyn Fn(f64) -> f64| {
            let at = |mm: f64| (mm + 20.0).round() as usize;
            tif(20.0, 41, |x, y| of(gaussian(x, y) + noise[41 * at(y) + at(x)]))
        };
        let plain = Baseline::under(&with(&|v| v)).unwrap();
        assert_eq!(plain.level_nm_per_s, 0.0);
        // The mean of the positive part of normal noise of 0.05 is 0.05 / sqrt(2 pi), to its standard error of 6 %.
        let clipped = Baseline::under(&with(&|v| v.max(0.0))).unwrap();
        assert!((clipped.level_nm_per_s / 0.01995 - 1.0).abs() < 0.2, "{clipped:?}");
    }

    #[test]
    fn a_spot_that_fills_its_field_has_no_baseline_to_be_known() {
        assert_eq!(Baseline::under(&tif(2.6, 41, gaussian)), None);
        let pad = |x: f64, y: f64| if x.hypot(y) < 3.0 { 5.0 } else { 0.0 };
        assert_eq!(Baseline::under(&tif(4.0, 41, pad)), None);
        // A ring ends without a baseline, whatever the shape of its tail.
        let ring = |x: f64, y: f64| {
            let q = 0.25 * (x * x + y * y);
            5.0 * q * (1.0 - q).exp()
        };
        assert_eq!(Baseline::under(&tif(6.0, 41, ring)).map_or(0.0, |b| b.level_nm_per_s), 0.0);
    }
}
