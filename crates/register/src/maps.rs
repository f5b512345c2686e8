//! Registration of a map on an earlier one of the same part, from the features that both have.
//!
//! A map z after a run shows the part of the map b before it, moved by a shift s and turned by theta about
//! the middle c of the map, less the removal. The slowly varying part of the removal is fitted by free
//! low-order terms Q. If a wavelength is given, everything longer is filtered out of both maps before:
//!
//! ```text
//! z(x) = b(p) + Q a + noise,    p = c + R(-theta) (x - c - s)
//! ```
//!
//! Gauss-Newton steps in (s, theta), with a solved for in every step, start at the best place of a search
//! by whole pixels. With g the gradient of b at p turned by theta, and d = x - c - s,
//!
//! ```text
//! dz/ds = -g,    dz/dtheta = g_x d_y - g_y d_x
//! ```
//!
//! Between its pixels, b is Keys' cubic convolution. The convolution smooths the noise of b, most in the
//! middle between pixels. Least squares are therefore biased towards there, by tenths of a pixel if the
//! noise is a tenth of the features. So the equations are not those of least squares: they have the
//! gradient h of z in the place of g (an instrumental variable, J. D. Sargan, Econometrica 26 (1958) 393).
//! With H and G the rows of h and of g, and of the free terms,
//!
//! ```text
//! sum H' r = 0,    step = (H'G)^-1 H' r
//! ```
//!
//! h comes from central differences. Its noise correlates neither with the noise of z at the same pixel nor
//! with the noise of b. The noise of maps is correlated (air, camera, interpolation), so the standard
//! errors do not follow from the number of pixels. They follow from the sums of H'r over blocks of the map:
//! C = f (H'G)^-1 (sum over blocks of (H'r)(H'r)') (G'H)^-1 (the sandwich of H. White, Econometrica 48
//! (1980) 817, by clusters). C is right if the blocks are larger than the correlation length. The sums over
//! blocks of X x Y pixels miss the correlation across their borders. The factor f makes up for it, with the
//! autocovariance A of r:
//!
//! ```text
//! f = sum A(i, j) / sum A(i, j) (1 - |i| / X) (1 - |j| / Y)     over lags until the mean of A is noise
//! ```
//!
//! For noise averaged over 3 x 3 pixels in blocks of 17 x 10, the missing part is a seventh of the
//! variance.
//!
//! A direction counts as determined only by features that the maps have *in common*. The test compares two
//! correlations of the derivative of z with that of b along the direction: the correlation at the place
//! that was found, and the same at many wrong places. The derivative of noise correlates at no place,
//! however large the noise is. Features that repeat correlate at wrong places too.

mod search;

use nalgebra::{DMatrix, DVector};
use ndarray::Array2;
use planish_numerics::orthogonal::legendre;
use planish_types::{Invalid, Surface, Transform, progress, text::significant};
use rayon::prelude::*;
use serde::Serialize;

use crate::{
    field::{self, Field},
    fit::Estimate,
};

/// Settings for registering a map on an earlier map of the same part.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct MapSettings {
    /// Largest shift along x or y that the search allows, mm.
    pub most_shift_mm: f64,
    /// Largest rotation in either direction that the search allows, degree; at most 30.
    pub most_rotation_deg: f64,
    /// Highest total order of the Legendre terms that are fitted to the removal: 0 is the piston, 1 the plane.
    pub free_order: usize,
    /// Wavelength, mm, above which features are filtered out of both maps before the fit; `None` keeps all.
    pub shorter_than_mm: Option<f64>,
}

/// Shift and rotation of a later map, and their quality.
#[derive(Clone, Debug)]
pub struct MapRegistration {
    /// Transform from the coordinates of the map before to those of the map after.
    pub transform: Transform,
    /// Standard errors, residual and common features.
    pub report: MapReport,
}

/// Position of the later map on the earlier one with its standard errors, and the quality of the fit.
#[derive(Clone, Debug, Serialize)]
pub struct MapReport {
    /// Shift of the later map along x, mm.
    pub shift_x_mm: Estimate,
    /// Shift of the later map along y, mm.
    pub shift_y_mm: Estimate,
    /// Rotation of the later map about its middle, degree; positive from x towards y.
    pub rotation_deg: Estimate,
    /// Measure of common features along x, along y and for rotation, dimensionless; below 3 the map is refused. It is
    /// the correlation of the derivatives of both maps at the position found, divided by its RMS at wrong positions.
    /// Both pass Fisher's transformation (atanh) first.
    pub features: [f64; 3],
    /// Correlation coefficient of the two maps at the position found, after subtraction of the free low-order terms.
    pub correlation: f64,
    /// RMS of the difference of the maps that shift, rotation and free terms leave, nm.
    pub rms_nm: f64,
    /// Number of pixels of the later map where both maps are valid, with neighbours enough for gradients.
    pub pixels: usize,
    /// Number of Gauss-Newton steps until the position settled.
    pub steps: usize,
}

/// Highest total order of the free Legendre terms that a caller may ask for. Larger: the terms begin to fit
/// the features that the registration needs. Smaller: less of the removal can be fitted.
const MOST_ORDER: usize = 8;

/// Smallest ratio of the correlation of derivatives at the position found to its RMS at wrong positions,
/// dimensionless; a smaller ratio is refused. Larger: refuses maps with weak features. Smaller: chance
/// passes for features. Derived: within the limits of the search some hundred positions are independent of
/// each other, and the best of so many reaches 2.5 by chance.
const LEAST_FEATURES: f64 = 3.0;

/// Largest standard error of a shift, and of the rotation times half the diagonal of the map, pixels; a
/// larger one is refused. Larger: accepts an uncertain position. Smaller: refuses more maps. Chosen:
/// an error of more than half a pixel is no better than a comparison by eye.
const MOST_ERROR_PIXELS: f64 = 0.5;

/// Number of wrong positions on each side along each axis, at which the correlation shows what chance does. They are
/// displaced by multiples of a tenth of the map; 3 makes 48 of them. Larger: the RMS at wrong positions is known
/// better, for more time and less common area. Smaller: that RMS is less certain.
const WRONG_PLACES: i64 = 3;

/// Largest absolute correlation that enters Fisher's transformation; a larger one is counted as this one.
/// Closer to 1: identical maps get a larger, still finite ratio. Farther from 1: very similar maps count as
/// less certain.
const CLOSEST_TO_ONE: f64 = 1.0 - 1e-9;

/// Number of blocks of the map along each side, for the standard errors. Larger: blocks become smaller than
/// the correlation length of the noise, and the standard errors too small. Smaller: the standard errors
/// come from fewer blocks and are uncertain themselves.
const BLOCKS: usize = 6;

/// Threshold on the mean autocovariance of the residual over a ring of equal lags, at which the sum over lags ends. Its
/// unit is the standard error of that mean for white noise. Larger: the sum ends earlier and misses correlation.
/// Smaller: the sum includes noise.
const SEEN: f64 = 2.0;

/// Smallest number of blocks with common pixels, of `BLOCKS`^2 = 36; fewer are refused. Larger: refuses
/// maps with a small common area. Smaller: standard errors from few blocks, which are too uncertain.
const LEAST_BLOCKS: usize = 16;
/// Smallest number of valid pixels in common (or four per unknown, if that is more); fewer are refused.
/// Larger: refuses small common areas. Smaller: fits that few pixels determine.
const LEAST_PIXELS: usize = 200;

/// Largest number of Gauss-Newton steps; the registration is refused if it needs more. Larger: more time on
/// maps that do not settle. Smaller: refuses maps that settle slowly.
const MOST_STEPS: usize = 50;
/// Gauss-Newton step, pixels, below which the registration has settled. Smaller: it may never settle,
/// because pixels enter and leave at the border of the common area. Larger: the position is off by up to
/// this step.
const SETTLED_PIXELS: f64 = 5e-3;

/// Position of the later map on the earlier one: shift [x, y] in mm and rotation in rad, positive from x towards y.
pub(crate) type Pose = [f64; 3];

/// Finds the shift and the rotation of the map `after` relative to `before`, with their standard errors.
///
/// # Errors
/// Refuses settings that are not positive or too large, maps with too few pixels or features in common, and a position
/// beyond the limits of the search.
pub fn register(
    before: &Surface,
    after: &Surface,
    settings: &MapSettings,
) -> Result<MapRegistration, Invalid> {
    check(settings)?;
    let [before, after] = [before, after].map(|map| match settings.shorter_than_mm {
        Some(wavelength_mm) => field::shorter_than(map, wavelength_mm),
        None => Ok(map.clone()),
    });
    let [before, after] = [Field::new(before?), Field::new(after?)];
    let problem = Problem::new(&before, &after, settings.free_order)?;
    let limits = [settings.most_shift_mm, settings.most_rotation_deg.to_radians()];
    let start = search::best(&problem.detrended(), &after, &before, problem.centre_mm, limits);
    match progress::part(0, 2, || problem.settled(start, limits)) {
        Ok((pose, equations, steps)) => {
            progress::part(1, 2, || problem.result(pose, &equations, steps))
        }
        // If the features are too few, the message gives that as the reason.
        Err(e) => problem.check_features(start).and(Err(e)),
    }
}

/// Refuses settings that are not positive, a rotation above 30 degrees, and an order above [`MOST_ORDER`].
fn check(settings: &MapSettings) -> Result<(), Invalid> {
    let positive = [
        ("most_shift_mm", Some(settings.most_shift_mm)),
        ("most_rotation_deg", Some(settings.most_rotation_deg)),
        ("shorter_than_mm", settings.shorter_than_mm),
    ];
    for (name, value) in positive {
        if let Some(v) = value.filter(|v| !(v.is_finite() && *v > 0.0)) {
            return Err(Invalid::whole(name, format!("is {v}"), "give a positive number"));
        }
    }
    if settings.most_rotation_deg > 30.0 {
        let problem = format!("is {}", settings.most_rotation_deg);
        let remedy = "turn the map by hand first (planish import surface), to within 30 degrees";
        return Err(Invalid::whole("most_rotation_deg", problem, remedy));
    }
    if settings.free_order > MOST_ORDER {
        let problem = format!("is {}", settings.free_order);
        return Err(Invalid::whole("free_order", problem, format!("give 0 to {MOST_ORDER}")));
    }
    Ok(())
}

/// Inputs of the fit that stay the same in every Gauss-Newton step: both maps, the order of the free terms, and
/// lengths.
struct Problem<'a> {
    before: &'a Field,
    after: &'a Field,
    order: usize,
    centre_mm: [f64; 2],
    half_mm: [f64; 2],
    half_diagonal_mm: f64,
    pixel_mm: f64,
}

/// The equations H'G step = H'r of the module at one position, with the sums for the standard errors. Unknowns: shift
/// x, shift y, rotation times half the diagonal (mm), then the free terms.
struct Equations {
    /// Matrix H'G of the module.
    normal: DMatrix<f64>,
    /// Sums of the squares of the columns of H, and of those of G.
    sizes: [DVector<f64>; 2],
    /// Right side H'r of the module, from the residual r in nm.
    right: DVector<f64>,
    /// Part of H'r in every block of the map that has pixels, from the residual without the free terms.
    scores: Vec<DVector<f64>>,
    /// Factor f of the module: variance with the correlation across the borders of blocks, relative to the variance
    /// without it.
    across_borders: f64,
    pixels: usize,
    squares: f64,
    correlation: f64,
}

impl<'a> Problem<'a> {
    fn new(before: &'a Field, after: &'a Field, order: usize) -> Result<Self, Invalid> {
        let grid = after.grid();
        let centre_mm = [&grid.x, &grid.y].map(|axis| 0.5 * (axis.start_mm() + axis.end_mm()));
        let half_mm = grid.size_mm().map(|size| 0.5 * size);
        let steps = [before.grid(), grid].map(|g| g.x.step_mm().max(g.y.step_mm()));
        Ok(Self {
            before,
            after,
            order,
            centre_mm,
            half_mm,
            half_diagonal_mm: half_mm[0].hypot(half_mm[1]),
            pixel_mm: steps[0].max(steps[1]),
        })
    }

    /// Takes Gauss-Newton steps from `pose` until they are below [`SETTLED_PIXELS`]. Returns the last pose, the
    /// equations there, and the number of steps. `limits` are the largest shift (mm) and rotation (rad).
    fn settled(
        &self,
        mut pose: Pose,
        limits: [f64; 2],
    ) -> Result<(Pose, Equations, usize), Invalid> {
        let mut first = None;
        let mut pixels = f64::INFINITY;
        for steps in 1..=MOST_STEPS {
            let step = self.equations(pose)?.step(self)?;
            pose.iter_mut().zip(step).for_each(|(p, d)| *p += d);
            self.refuse_beyond(pose, limits)?;
            let turned_mm = self.half_diagonal_mm * step[2].abs();
            pixels = (step[0].hypot(step[1]) + turned_mm) / self.pixel_mm;
            let first = *first.get_or_insert(pixels);
            progress::done(progress::of_convergence(first, pixels, SETTLED_PIXELS));
            if pixels < SETTLED_PIXELS {
                return Ok((pose, self.equations(pose)?, steps));
            }
        }
        let what =
            format!("has not settled after {MOST_STEPS} steps, the last of {pixels:.2e} pixels");
        let remedy = "the maps have too little in common: give `shorter_than_mm`, or fiducials";
        Err(Invalid::whole("after", what, remedy))
    }

    /// Returns the number of free low-order terms: (order + 1)(order + 2)/2.
    fn terms(&self) -> usize {
        (self.order + 1) * (self.order + 2) / 2
    }

    /// Writes the free terms P_i(u) P_j(v), i + j <= order, at a point `x` [x, y] in mm of the later map to `out`. u
    /// and v are -1 to 1 across that map.
    fn low_order(&self, x: [f64; 2], out: &mut [f64]) {
        let n = self.order + 1;
        let [mut px, mut py] = [[0.0; MOST_ORDER + 1]; 2];
        legendre((x[0] - self.centre_mm[0]) / self.half_mm[0], &mut px[..n]);
        legendre((x[1] - self.centre_mm[1]) / self.half_mm[1], &mut py[..n]);
        let mut k = 0;
        for i in 0..n {
            for j in 0..n - i {
                out[k] = px[i] * py[j];
                k += 1;
            }
        }
    }

    /// Returns the heights of [later map, earlier map] without the fitted free terms, nm, row by row; NaN where
    /// invalid. The search uses them.
    fn detrended(&self) -> [Vec<f64>; 2] {
        [self.after, self.before].map(|field| {
            let terms = self.terms();
            let mut normal = DMatrix::<f64>::zeros(terms, terms);
            let mut right = DVector::<f64>::zeros(terms);
            let mut q = vec![0.0; terms];
            for (x, z) in field.valid() {
                self.low_order(x, &mut q);
                for i in 0..terms {
                    right[i] += q[i] * z;
                    for j in 0..terms {
                        normal[(i, j)] += q[i] * q[j];
                    }
                }
            }
            // A map of few pixels may not determine all terms; then no terms are subtracted.
            let solved = normal.cholesky().map(|c| c.solve(&right));
            field.map_values(|x, z| match &solved {
                Some(a) => {
                    self.low_order(x, &mut q);
                    z - q.iter().zip(a.iter()).map(|(q, a)| q * a).sum::<f64>()
                }
                None => z,
            })
        })
    }

    /// Returns the equations at `pose`. Refuses maps with too few valid pixels in common.
    fn equations(&self, pose: Pose) -> Result<Equations, Invalid> {
        let m = 3 + self.terms();
        let (sin, cos) = pose[2].sin_cos();
        let mut normal = DMatrix::<f64>::zeros(m, m);
        let mut sizes = [DVector::<f64>::zeros(m), DVector::zeros(m)];
        let mut right = DVector::<f64>::zeros(m);
        let mut samples: Vec<([usize; 2], Vec<f64>, f64, f64)> = Vec::new();
        let mut of_h = vec![0.0; m];
        let mut of_g = vec![0.0; m];
        for (index, x, z) in self.after.valid_indexed() {
            let d = [0, 1].map(|a| x[a] - self.centre_mm[a] - pose[a]);
            // p = c + R(-theta) d
            let p = [
                self.centre_mm[0] + cos * d[0] + sin * d[1],
                self.centre_mm[1] - sin * d[0] + cos * d[1],
            ];
            let Some((b, g)) = self.before.height_and_gradient(p) else { continue };
            let Some(h) = self.after.gradient(index) else { continue };
            // The gradient of b, turned into the frame of the later map.
            let g = [cos * g[0] - sin * g[1], sin * g[0] + cos * g[1]];
            for (row, g) in [(&mut of_h, h), (&mut of_g, g)] {
                row[0] = -g[0];
                row[1] = -g[1];
                row[2] = (g[0] * d[1] - g[1] * d[0]) / self.half_diagonal_mm;
                self.low_order(x, &mut row[3..]);
            }
            for i in 0..m {
                right[i] += of_h[i] * (z - b);
                sizes[0][i] += of_h[i] * of_h[i];
                sizes[1][i] += of_g[i] * of_g[i];
                for j in 0..m {
                    normal[(i, j)] += of_h[i] * of_g[j];
                }
            }
            samples.push((index, of_h.clone(), z - b, z));
        }
        if samples.len() < LEAST_PIXELS.max(4 * m) {
            let problem =
                format!("has {} valid pixels in common with the map before", samples.len());
            return Err(Invalid::whole("after", problem, "give maps of the same area"));
        }
        self.assembled(normal, sizes, right, &samples)
    }

    /// Completes the equations from the samples: each has its pixel [row, column], its row of H, the difference z - b
    /// of the maps, and the height z, nm.
    fn assembled(
        &self,
        normal: DMatrix<f64>,
        sizes: [DVector<f64>; 2],
        right: DVector<f64>,
        samples: &[([usize; 2], Vec<f64>, f64, f64)],
    ) -> Result<Equations, Invalid> {
        let m = right.len();
        // Residual with the free terms alone, at this place; and z itself without them.
        let of_terms = normal.view((3, 3), (m - 3, m - 3)).into_owned().cholesky();
        let of_terms = of_terms.ok_or_else(|| {
            let problem = format!("does not determine free terms of order {}", self.order);
            Invalid::whole("free_order", problem, "give a lower order")
        })?;
        let a = of_terms.solve(&right.rows(3, m - 3).into_owned());
        let mut for_z = DVector::zeros(m - 3);
        for (_, row, _, z) in samples {
            for i in 3..m {
                for_z[i - 3] += row[i] * z;
            }
        }
        let a_of_z = of_terms.solve(&for_z);
        let mut scores = vec![DVector::zeros(m); BLOCKS * BLOCKS];
        let mut filled = [false; BLOCKS * BLOCKS];
        let [mut squares, mut zz, mut bb, mut zb] = [0.0; 4];
        let mut left = Array2::from_elem(self.after.grid().shape(), f64::NAN);
        for (index, row, rest, z) in samples {
            let block = self.block(*index);
            let [low, low_of_z] = [&a, &a_of_z]
                .map(|a| row[3..].iter().zip(a.iter()).map(|(q, a)| q * a).sum::<f64>());
            let r = rest - low;
            let z = z - low_of_z;
            let b = z - r;
            squares += r * r;
            zz += z * z;
            bb += b * b;
            zb += z * b;
            for i in 0..m {
                scores[block][i] += row[i] * r;
            }
            filled[block] = true;
            left[*index] = r;
        }
        let scores = scores.into_iter().zip(filled).filter(|(_, is_filled)| *is_filled);
        Ok(Equations {
            normal,
            sizes,
            right,
            scores: scores.map(|(score, _)| score).collect(),
            across_borders: self.across_borders(&left),
            pixels: samples.len(),
            squares,
            correlation: zb / (zz * bb).sqrt().max(f64::MIN_POSITIVE),
        })
    }

    /// Returns the factor f of the module, from the residuals `left` of the fit, nm (ny, nx); NaN marks pixels without
    /// a residual.
    fn across_borders(&self, left: &Array2<f64>) -> f64 {
        let (ny, nx) = left.dim();
        let block = [ny, nx].map(|n| n as f64 / BLOCKS as f64);
        let (variance, pixels) = autocovariance(left, 0, 0);
        let mut all = variance;
        let mut within = variance;
        let most = (0.5 * block[0].min(block[1])) as isize;
        for ring in 1..=most {
            let [mut sum, mut tapered, mut lags] = [0.0; 3];
            // One half of the lags is enough: the autocovariance is even.
            let half = (-ring + 1..=ring).map(|j| (ring, j)).chain((0..ring).map(|i| (i, ring)));
            for (i, j) in half.chain((1..=ring).map(|i| (i, -ring))) {
                let (a, _) = autocovariance(left, i, j);
                sum += a;
                tapered += a * (1.0 - i as f64 / block[0]) * (1.0 - j.abs() as f64 / block[1]);
                lags += 1.0;
            }
            // The mean of so many covariances of white noise scatters by its variance over (pixels lags)^1/2.
            if sum / lags <= SEEN * variance / (pixels * lags).sqrt() {
                break;
            }
            all += 2.0 * sum;
            within += 2.0 * tapered;
        }
        if within > 0.0 { all / within } else { 1.0 }
    }

    /// Returns the index, row by row, of the block of the map that contains a pixel [row, column].
    fn block(&self, [r, c]: [usize; 2]) -> usize {
        let (ny, nx) = self.after.grid().shape();
        (r * BLOCKS / ny) * BLOCKS + c * BLOCKS / nx
    }

    /// Returns the correlation coefficients of the derivatives of both maps along x, along y and around the middle at
    /// `pose`. The earlier map is displaced by `by_mm` [x, y] beforehand.
    fn common(&self, pose: Pose, by_mm: [f64; 2]) -> [f64; 3] {
        let (sin, cos) = pose[2].sin_cos();
        let mut sums = [[0.0; 3]; 3];
        for (index, x, _) in self.after.valid_indexed() {
            let Some(h) = self.after.gradient(index) else { continue };
            let d = [0, 1].map(|a| x[a] - self.centre_mm[a] - pose[a]);
            let p = [
                self.centre_mm[0] + cos * d[0] + sin * d[1] + by_mm[0],
                self.centre_mm[1] - sin * d[0] + cos * d[1] + by_mm[1],
            ];
            let Some(g) = self.before.nearest(p).and_then(|pixel| self.before.gradient(pixel))
            else {
                continue;
            };
            let g = [cos * g[0] - sin * g[1], sin * g[0] + cos * g[1]];
            let around = [g, h].map(|g| g[1] * d[0] - g[0] * d[1]);
            let pairs = [[g[0], h[0]], [g[1], h[1]], around];
            for (s, [g, h]) in sums.iter_mut().zip(pairs) {
                *s = [s[0] + g * h, s[1] + g * g, s[2] + h * h];
            }
        }
        sums.map(|[gh, gg, hh]| if gg * hh > 0.0 { gh / (gg * hh).sqrt() } else { 0.0 })
    }

    /// Returns the correlations along x, along y and for rotation at `pose`, relative to their RMS at wrong positions.
    /// Both pass Fisher's transformation first.
    fn features(&self, pose: Pose) -> [f64; 3] {
        let here = fisher(self.common(pose, [0.0; 2]));
        let range = -WRONG_PLACES..=WRONG_PLACES;
        let wrong: Vec<[i64; 2]> = range
            .clone()
            .flat_map(|j| range.clone().map(move |i| [i, j]))
            .filter(|by| *by != [0, 0])
            .collect();
        let pieces = progress::PieceCounter::new(wrong.len());
        let elsewhere = wrong.par_iter().map(|by| {
            let by_mm = [0, 1].map(|a| by[a] as f64 * 0.2 * self.half_mm[a]);
            let correlations = fisher(self.common(pose, by_mm));
            progress::done(pieces.one_more());
            correlations
        });
        let elsewhere: Vec<[f64; 3]> = elsewhere.collect();
        [0, 1, 2].map(|k| {
            let squares = elsewhere.iter().map(|c| c[k] * c[k]).sum::<f64>() / wrong.len() as f64;
            // Without noise the correlations at wrong places may be exactly zero; then the one at `pose`
            // decides.
            if here[k] == 0.0 { 0.0 } else { here[k] / squares.sqrt() }
        })
    }

    /// Refuses a pose beyond the largest shift (mm) or the largest rotation (rad).
    fn refuse_beyond(&self, pose: Pose, [shift_mm, rotation]: [f64; 2]) -> Result<(), Invalid> {
        if pose[0].abs() <= shift_mm && pose[1].abs() <= shift_mm && pose[2].abs() <= rotation {
            return Ok(());
        }
        let problem = format!(
            "lies beyond `most_shift_mm` {shift_mm} and `most_rotation_deg` {}: at {:?} mm and {} degree",
            significant(rotation.to_degrees(), 4),
            [pose[0], pose[1]].map(|v| (v * 1e4).round() / 1e4),
            significant(pose[2].to_degrees(), 4)
        );
        let remedy = "give larger ones; or the maps have too little in common: give `shorter_than_mm`, or \
                      fiducials";
        Err(Invalid::whole("after", problem, remedy))
    }

    /// Returns the transform at a pose, and the quality of the fit. Refuses a pose with too few common features or too
    /// large standard errors.
    fn result(&self, pose: Pose, e: &Equations, steps: usize) -> Result<MapRegistration, Invalid> {
        let features = self.check_features(pose)?;
        let covariance = e.covariance(self)?;
        let error = [0, 1, 2].map(|i| covariance[(i, i)].sqrt());
        let pixels =
            [error[0], error[1], error[2] * self.half_diagonal_mm].map(|v| v / self.pixel_mm);
        for (name, error) in ["shift along x", "shift along y", "rotation"].iter().zip(pixels) {
            if error.is_nan() || error > MOST_ERROR_PIXELS {
                let problem = format!(
                    "leaves the {name} uncertain by {} pixels (standard error)",
                    significant(error, 3)
                );
                let remedy =
                    "the common features do not determine it: give `shorter_than_mm`, or fiducials";
                return Err(Invalid::whole("after", problem, remedy));
            }
        }
        let estimate = |i: usize, unit: f64| Estimate {
            value: pose[i] * unit,
            standard_error: error[i] * unit,
        };
        Ok(MapRegistration {
            transform: self.transform(pose, &covariance)?,
            report: MapReport {
                shift_x_mm: estimate(0, 1.0),
                shift_y_mm: estimate(1, 1.0),
                rotation_deg: estimate(2, 1f64.to_degrees()),
                features,
                correlation: e.correlation,
                rms_nm: (e.squares / e.pixels as f64).sqrt(),
                pixels: e.pixels,
                steps,
            },
        })
    }

    /// Returns the ratios of [`Self::features`] at a pose. Refuses ratios below [`LEAST_FEATURES`].
    fn check_features(&self, pose: Pose) -> Result<[f64; 3], Invalid> {
        let features = self.features(pose);
        let names = ["along x", "along y", "around the middle"];
        let too_few: Vec<usize> =
            (0..3).filter(|k| features[*k].is_nan() || features[*k] < LEAST_FEATURES).collect();
        if !too_few.is_empty() {
            let problem = format!(
                "has too few features {} in common with the map before: they stand out of chance by a factor of {}, \
                 {LEAST_FEATURES} is needed",
                too_few.iter().map(|k| names[*k]).collect::<Vec<_>>().join(", "),
                too_few.iter().map(|k| significant(features[*k], 2)).collect::<Vec<_>>().join(", ")
            );
            let remedy =
                "give `shorter_than_mm`, so that what was removed does not hide them, or fiducials";
            return Err(Invalid::whole("after", problem, remedy));
        }
        Ok(features)
    }

    /// Returns the transform q = R(theta) (p - c) + c + s of the module, with its covariance. `covariance` is that of s
    /// (mm) and theta (rad).
    fn transform(&self, pose: Pose, covariance: &DMatrix<f64>) -> Result<Transform, Invalid> {
        let (sin, cos) = pose[2].sin_cos();
        let c = self.centre_mm;
        // Gradients of (image x, image y, M) by (s_x, s_y, theta).
        let by = [
            [1.0, 0.0, 0.0, 0.0, 0.0, 0.0],
            [0.0, 1.0, 0.0, 0.0, 0.0, 0.0],
            [0.0, 0.0, -sin, -cos, cos, -sin],
        ];
        let mut six = [[0.0; 6]; 6];
        for (i, j) in (0..6).flat_map(|i| (0..6).map(move |j| (i, j))) {
            for (k, l) in (0..3).flat_map(|k| (0..3).map(move |l| (k, l))) {
                // The two halves of a product in one order, so that the matrix is symmetric to the last bit.
                six[i.max(j)][i.min(j)] += by[k][i.max(j)]
                    * covariance[(k.max(l), k.min(l))]
                    * by[l][i.min(j)]
                    * if i == j { 1.0 } else { 0.5 };
            }
        }
        for i in 0..6 {
            for j in 0..i {
                six[j][i] = six[i][j];
            }
        }
        Transform::new([[cos, -sin], [sin, cos]], c, [c[0] + pose[0], c[1] + pose[1]], six)
    }
}

/// Returns Fisher's transformation atanh of three correlations, which makes their scatter independent of their size.
fn fisher(correlations: [f64; 3]) -> [f64; 3] {
    correlations.map(|r| r.clamp(-CLOSEST_TO_ONE, CLOSEST_TO_ONE).atanh())
}

/// Returns the mean product of the pixels that lie `i` rows (0 or more) and `j` columns apart, and the number of these
/// pairs. NaN marks pixels that do not count; without pairs the mean is 0.
fn autocovariance(map: &Array2<f64>, i: isize, j: isize) -> (f64, f64) {
    let (ny, nx) = map.dim();
    let from = j.unsigned_abs();
    let mut sum = 0.0;
    let mut count = 0.0;
    for r in 0..ny - i as usize {
        for c in 0..nx - from {
            let (a, b) = if j < 0 { (c + from, c) } else { (c, c + from) };
            let product = map[[r, a]] * map[[r + i as usize, b]];
            if !product.is_nan() {
                sum += product;
                count += 1.0;
            }
        }
    }
    (if count > 0.0 { sum / count } else { 0.0 }, count)
}

impl Equations {
    /// Returns the Gauss-Newton step of the pose: shift in mm, rotation in rad.
    fn step(&self, problem: &Problem) -> Result<Pose, Invalid> {
        let solved = self.inverse()? * &self.right;
        Ok([solved[0], solved[1], solved[2] / problem.half_diagonal_mm])
    }

    /// Returns the inverse of the matrix H'G of the module. Refuses equations that do not determine the position.
    fn inverse(&self) -> Result<DMatrix<f64>, Invalid> {
        // Smallest singular value of the scaled matrix H'G, dimensionless; a smaller one is refused.
        // Columns are scaled to length 1 first, so that the value does not depend on units. Larger: refuses
        // maps that barely determine the place. Smaller: accepts a nearly singular matrix.
        const LEAST_SINGULAR_VALUE: f64 = 1e-6;
        let m = self.right.len();
        let [h, g] = self.sizes.each_ref().map(|s| s.map(f64::sqrt));
        let flat: Vec<&str> =
            (0..3).filter(|i| h[*i] * g[*i] == 0.0).map(|i| ["x", "y", "rotation"][i]).collect();
        let remedy = "give fewer free terms, or fiducials";
        if !flat.is_empty() {
            let problem = format!("has nothing that changes with {}", flat.join(" or "));
            return Err(Invalid::whole("after", problem, remedy));
        }
        let scaled = DMatrix::from_fn(m, m, |i, j| self.normal[(i, j)] / (h[i] * g[j]));
        let least = if scaled.iter().all(|v| v.is_finite()) {
            scaled.clone().singular_values().min()
        } else {
            0.0
        };
        let inverse = scaled.try_inverse().filter(|_| least > LEAST_SINGULAR_VALUE);
        let inverse = inverse.ok_or_else(|| {
            let problem = "does not determine shift and rotation beside the free terms";
            Invalid::whole("after", problem, remedy)
        })?;
        Ok(DMatrix::from_fn(m, m, |i, j| inverse[(i, j)] / (g[i] * h[j])))
    }

    /// Returns the covariance (3 x 3) of the pose, in mm and rad: C of the module, from the sums over blocks. Refuses
    /// too few blocks with pixels.
    fn covariance(&self, problem: &Problem) -> Result<DMatrix<f64>, Invalid> {
        let blocks = self.scores.len();
        if blocks < LEAST_BLOCKS {
            let what = format!("has pixels in {blocks} blocks of {}", BLOCKS * BLOCKS);
            return Err(Invalid::whole("after", what, "give maps of the same area"));
        }
        let inverse = self.inverse()?;
        let m = self.right.len();
        let mut middle = DMatrix::zeros(m, m);
        for score in &self.scores {
            middle += score * score.transpose();
        }
        // Correction for the small number of blocks and the three parameters of the pose.
        let correction = self.across_borders * blocks as f64 / (blocks as f64 - 3.0);
        let all = &inverse * middle * inverse.transpose() * correction;
        let unit = [1.0, 1.0, problem.half_diagonal_mm];
        Ok(DMatrix::from_fn(3, 3, |i, j| all[(i, j)] / (unit[i] * unit[j])))
    }
}
