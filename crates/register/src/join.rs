//! Overlapping sub-aperture maps joined to one map.
//!
//! Every map z_k has its own piston and tilt, because the part or the instrument moved between the measurements. The
//! coordinates of the maps say where they lie. With c(x) the set of the maps that cover the pixel x, n(x) their number,
//! and f = (1, u, v) the piston and the tilts (u, v: coordinates from -1 to 1), the coefficients p_k of the maps
//! minimise
//!
//! ```text
//! sum over x with n(x) >= 2,  sum over k in c(x)   (z_k(x) - p_k f(x) - m(x))^2                     (1)
//! m(x) = sum over k in c(x) of (z_k(x) - p_k f(x)) / n(x)
//! ```
//!
//! A common plane of all maps changes nothing in (1), so the first map has p_0 = 0. Without m, the normal equations are
//!
//! ```text
//! N[k, l] = sum over x of ([k = l] - 1 / n) f f',    r[k] = sum over x of f (z_k - mean of the z at x)  (2)
//! ```
//!
//! m is the joined map. The misfit is the root of the mean of (1) over its degrees of freedom: the number of terms in
//! (1) less the number of pixels and of free coefficients. It is the noise of one map if the maps are right.
//! Distortion, drift, or a wrong position makes it larger. (1) is the joint fit of all overlaps of M. Otsubo, K. Okada,
//! J. Tsujiuchi, Opt. Eng. 33 (1994) 608.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | z_k | `maps` | (ny_k, nx_k) | nm |
//! | p_k | `terms` | (1) or (3) per map | nm |
//! | m | `joined` | (ny, nx) | nm |

use nalgebra::{DMatrix, DVector};
use ndarray::Array2;
use planish_types::{Axis, Grid, Invalid, Surface};
use serde::Serialize;

use crate::{
    low_order::{LEAST_EIGENVALUE, LowOrder},
    resampled::Resampled,
    series::RefusedMap,
};

/// Terms by which a sub-aperture map may differ from its neighbours.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Difference {
    /// A constant.
    Piston,
    /// A plane.
    Plane,
}

/// Settings for joining sub-aperture maps.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct JoinSettings {
    /// Low-order terms by which two maps may differ: the piston, or piston and tilt. They are fitted and subtracted.
    pub differ_by: Difference,
    /// Smallest number of common pixels, dimensionless; two maps with fewer do not count as overlapping.
    pub least_overlap: usize,
}

impl Default for JoinSettings {
    fn default() -> Self {
        // A plane has three coefficients; the mean of 30 pixels has a fifth of the noise of one. Narrow windows of a camera
        // have no more in common, and overlaps in a line are refused anyway.
        Self { differ_by: Difference::Plane, least_overlap: 30 }
    }
}

/// The map joined from sub-apertures, with the quality of the fit.
#[derive(Clone, Debug)]
pub struct Joined {
    /// The joined map, nm, on the smallest grid that contains all maps and continues the pixels of the first one.
    pub joined: Surface,
    /// Quality of the fit: misfit, subtracted terms, and overlaps.
    pub report: JoinReport,
}

/// Quality of a joined map: how well the sub-apertures agree.
#[derive(Clone, Debug, Serialize)]
pub struct JoinReport {
    /// Misfit of the maps where they overlap, nm: the root of the sum (1) of the module over its degrees of freedom.
    pub misfit_nm: f64,
    /// Number of pixels of the joined map that at least two maps cover.
    pub overlap_pixels: usize,
    /// Number of valid pixels of the joined map.
    pub pixels: usize,
    /// True if all maps have their valid pixels in the same rectangle: they are averaged, not joined.
    pub same_place: bool,
    /// Piston and tilts that were subtracted, one entry per map in the order given; zeros for the first map.
    pub terms: Vec<Terms>,
    /// Every pair of maps with common pixels, and their remaining difference.
    pub overlaps: Vec<Overlap>,
}

/// Piston and tilt that were subtracted from one map. The first map keeps its own: its terms are zero.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Terms {
    /// Subtracted height at the centre of the joined map, nm.
    pub piston_nm: f64,
    /// Subtracted slope along [x, y], nm/mm.
    pub tilt_nm_per_mm: [f64; 2],
    /// True if the pixels of the map lie beside those of the joined map, so that heights were interpolated.
    pub interpolated: bool,
}

/// A pair of maps with common pixels, and their difference there.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Overlap {
    /// Numbers of the two maps in the order given, counted from 1.
    pub maps: [usize; 2],
    /// Number of pixels that are valid in both maps.
    pub pixels: usize,
    /// RMS of the difference of the two maps on these pixels, after subtraction of piston and tilt, nm.
    pub rms_nm: f64,
}

/// Largest number of maps. Larger: the normal equations take longer, with the cube of this number. Smaller: large
/// mosaics are refused.
pub const MOST_MAPS: usize = 400;

/// Largest number of pixels of the joined map times the number of maps, because every map is kept on that grid. Larger:
/// more memory (8 bytes each). Smaller: refuses large mosaics. Chosen: 2 GB.
const MOST_STACKED_PIXELS: usize = 1 << 28;

/// Joins overlapping maps whose coordinates are those of the part: fits and subtracts piston and tilt, then averages.
///
/// # Errors
/// Refuses fewer than 2 maps or more than [`MOST_MAPS`], maps that no chain of overlaps connects with the first one,
/// and joined maps that are too large.
pub fn join(maps: &[Surface], settings: &JoinSettings) -> Result<Joined, RefusedMap> {
    let refused = |index: usize| move |reason: Invalid| RefusedMap { index, reason };
    if !(2..=MOST_MAPS).contains(&maps.len()) {
        let problem = format!("has {} map(s)", maps.len());
        let remedy = format!("give 2 to {MOST_MAPS} maps that overlap");
        return Err(refused(0)(Invalid::whole("mosaic", problem, remedy)));
    }
    let grid = whole(maps)?;
    let pieces: Vec<Array2<f64>> = maps.iter().map(|map| resampled(map, &grid)).collect();
    let order = match settings.differ_by {
        Difference::Piston => 0,
        Difference::Plane => 1,
    };
    let low_order = LowOrder::new(&grid, order).map_err(refused(0))?;
    let counts = common_pixels(&pieces);
    refuse_islands(&counts, settings.least_overlap)?;
    let coefficients = solve(&pieces, &low_order)?;

    let levelled: Vec<Array2<f64>> =
        pieces.iter().zip(&coefficients).map(|(z, p)| z - low_order.sum(p)).collect();
    let mut squares = 0.0;
    let mut overlap_pixels = 0_usize;
    let mut summands = 0_usize;
    let height = Array2::from_shape_fn(grid.shape(), |pixel| {
        let known = levelled.iter().map(|z| z[pixel]).filter(|z| !z.is_nan());
        let n = known.clone().count();
        let mean = known.clone().sum::<f64>() / n as f64;
        if n >= 2 {
            overlap_pixels += 1;
            summands += n;
            squares += known.map(|z| (z - mean).powi(2)).sum::<f64>();
        }
        if n == 0 { f64::NAN } else { mean }
    });
    let free = overlap_pixels + (maps.len() - 1) * low_order.len();
    let degrees = summands.saturating_sub(free).max(1) as f64;
    let half = grid.size_mm().map(|size| 0.5 * size);
    let terms = coefficients.iter().zip(maps).map(|(p, map)| Terms {
        piston_nm: p[0],
        // The terms are 1, P_1(v), P_1(u).
        tilt_nm_per_mm: [
            p.get(2).map_or(0.0, |b| b / half[0]),
            p.get(1).map_or(0.0, |c| c / half[1]),
        ],
        interpolated: !Resampled::new(map, &grid).is_exact(),
    });
    let report = JoinReport {
        misfit_nm: (squares / degrees).sqrt(),
        overlap_pixels,
        pixels: height.iter().filter(|z| !z.is_nan()).count(),
        same_place: pieces.windows(2).all(|pair| extent(&pair[0]) == extent(&pair[1])),
        terms: terms.collect(),
        overlaps: overlaps(&levelled, &counts),
    };
    let joined = Surface::new(grid, height).map_err(refused(0))?;
    Ok(Joined { joined, report })
}

/// Returns the smallest grid that contains all maps and continues the pixel grid of the first one. Refuses a grid that
/// is too large.
fn whole(maps: &[Surface]) -> Result<Grid, RefusedMap> {
    let [x, y]: [Vec<&Axis>; 2] = [
        maps.iter().map(|map| &map.grid().x).collect(),
        maps.iter().map(|map| &map.grid().y).collect(),
    ];
    // Start, step and number of the pixels along (x, y).
    let covered = [&x, &y].map(|axes| {
        let start = axes[0].start_mm();
        let step = axes[0].step_mm();
        // A pixel that is missed by rounding is no pixel more.
        let low = axes.iter().map(|a| (a.start_mm() - start) / step).fold(0.0, f64::min);
        let high = axes.iter().map(|a| (a.end_mm() - start) / step).fold(0.0, f64::max);
        let low = (low + 1e-6).floor();
        let high = (high - 1e-6).ceil();
        (start + low * step, step, high - low + 1.0)
    });
    let [nx, ny] = covered.map(|(.., pixels)| pixels);
    if nx * ny * maps.len() as f64 > MOST_STACKED_PIXELS as f64 {
        let farthest_mm = x.iter().zip(&y).map(|(x, y)| {
            x.start_mm().abs().max(x.end_mm().abs()).max(y.start_mm().abs()).max(y.end_mm())
        });
        let farthest = farthest_mm.enumerate().max_by(|a, b| a.1.total_cmp(&b.1));
        let problem = format!("needs a joined map of {nx} x {ny} pixels");
        let remedy = "check the place and the pitch of the maps (planish import surface)";
        let reason = Invalid::whole("mosaic", problem, remedy);
        return Err(RefusedMap { index: farthest.map_or(0, |map| map.0), reason });
    }
    let [x, y] = covered.map(|(start, step, pixels)| {
        Axis::new(start, step, pixels as usize).map_err(|reason| RefusedMap { index: 0, reason })
    });
    Ok(Grid { x: x?, y: y? })
}

/// Returns a map resampled on the pixels of the joined map (ny, nx), nm; NaN where it has no valid height.
fn resampled(map: &Surface, grid: &Grid) -> Array2<f64> {
    let source = Resampled::new(map, grid);
    Array2::from_shape_fn(grid.shape(), |(r, c)| {
        source
            .at_pixel((r, c), [grid.x.coordinate_mm(c), grid.y.coordinate_mm(r)])
            .unwrap_or(f64::NAN)
    })
}

/// Returns the first and last row, then the first and last column, that contain a valid pixel. `piece` is one map on
/// the grid of the joined map.
fn extent(piece: &Array2<f64>) -> [usize; 4] {
    let valid = piece.indexed_iter().filter(|(_, z)| !z.is_nan());
    valid.fold([usize::MAX, 0, usize::MAX, 0], |[r0, r1, c0, c1], ((r, c), _)| {
        [r0.min(r), r1.max(r), c0.min(c), c1.max(c)]
    })
}

/// Returns the number of common valid pixels of every pair of maps: element `[k][l]` is that of the maps k and l.
fn common_pixels(pieces: &[Array2<f64>]) -> Vec<Vec<usize>> {
    let mut counts = vec![vec![0; pieces.len()]; pieces.len()];
    let (ny, nx) = pieces[0].dim();
    let mut there = Vec::new();
    for pixel in (0..ny).flat_map(|r| (0..nx).map(move |c| (r, c))) {
        there.clear();
        there.extend((0..pieces.len()).filter(|k| !pieces[*k][pixel].is_nan()));
        for &k in &there {
            there.iter().for_each(|&l| counts[k][l] += 1);
        }
    }
    counts
}

/// Refuses maps that no chain of overlaps connects with the first one. `least` is the smallest number of common pixels
/// of an overlap.
fn refuse_islands(counts: &[Vec<usize>], least: usize) -> Result<(), RefusedMap> {
    let mut reached = vec![false; counts.len()];
    let mut next = vec![0];
    while let Some(k) = next.pop() {
        if !std::mem::replace(&mut reached[k], true) {
            next.extend((0..counts.len()).filter(|l| counts[k][*l] >= least && *l != k));
        }
    }
    let Some(index) = reached.iter().position(|r| !r) else { return Ok(()) };
    let most = (0..counts.len()).filter(|k| reached[*k]).map(|k| counts[index][k]).max();
    let problem = format!(
        "has at most {} pixel(s) in common with a map that is connected to the first one, {least} are needed",
        most.unwrap_or(0)
    );
    let remedy = "check its place (x_mm and y_mm), give the maps between them, or a lower \
                  `least_overlap`";
    Err(RefusedMap { index, reason: Invalid::whole("mosaic", problem, remedy) })
}

/// Solves the normal equations (2) of the module. Returns the coefficients of piston and tilt of every map, nm; those
/// of the first one are 0. Refuses overlaps that do not determine them.
fn solve(pieces: &[Array2<f64>], low_order: &LowOrder) -> Result<Vec<Vec<f64>>, RefusedMap> {
    let terms = low_order.len();
    let maps = pieces.len();
    let size = terms * maps;
    let mut normal = DMatrix::<f64>::zeros(size, size);
    let mut right = DVector::<f64>::zeros(size);
    let mut f = vec![0.0; terms];
    let (ny, nx) = pieces[0].dim();
    let mut there = Vec::new();
    for pixel in (0..ny).flat_map(|r| (0..nx).map(move |c| (r, c))) {
        there.clear();
        there.extend((0..maps).filter(|k| !pieces[*k][pixel].is_nan()));
        if there.len() < 2 {
            continue;
        }
        let share = 1.0 / there.len() as f64;
        let mean = there.iter().map(|k| pieces[*k][pixel]).sum::<f64>() * share;
        low_order.write_terms(pixel, &mut f);
        for &k in &there {
            for i in 0..terms {
                right[k * terms + i] += f[i] * (pieces[k][pixel] - mean);
                for &l in &there {
                    let weight = f64::from(u8::from(k == l)) - share;
                    for j in 0..terms {
                        normal[(k * terms + i, l * terms + j)] += weight * f[i] * f[j];
                    }
                }
            }
        }
    }
    // p_0 = 0
    let normal = normal.view((terms, terms), (size - terms, size - terms)).into_owned();
    let right = right.rows(terms, size - terms).into_owned();
    // Unit diagonal: the size of an overlap does not decide whether it determines a plane.
    let scale = normal.diagonal().map(|d| if d > 0.0 { d.sqrt().recip() } else { 0.0 });
    let scaled = DMatrix::from_fn(normal.nrows(), normal.ncols(), |i, j| {
        scale[i] * normal[(i, j)] * scale[j]
    });
    let eigen = scaled.clone().symmetric_eigen();
    let least = eigen.eigenvalues.imin();
    if eigen.eigenvalues[least] <= LEAST_EIGENVALUE {
        // The map whose terms the overlaps determine least.
        let vector = eigen.eigenvectors.column(least);
        let index = vector.iamax() / terms + 1;
        let problem =
            "overlaps with its neighbours in too few rows or columns to determine its tilt";
        let remedy = "give maps with a wider overlap, or maps that differ by pistons alone \
                      (`differ_by` piston)";
        return Err(RefusedMap { index, reason: Invalid::whole("mosaic", problem, remedy) });
    }
    let solved = scaled.cholesky().map(|c| c.solve(&right.component_mul(&scale)));
    let solved = solved.expect("its eigenvalues are positive").component_mul(&scale);
    let mut coefficients = vec![vec![0.0; terms]];
    coefficients
        .extend((0..maps - 1).map(|k| solved.rows(k * terms, terms).iter().copied().collect()));
    Ok(coefficients)
}

/// Returns every pair of maps with common pixels, with the RMS of their difference after subtraction of the fitted
/// terms.
fn overlaps(levelled: &[Array2<f64>], counts: &[Vec<usize>]) -> Vec<Overlap> {
    let mut overlaps = Vec::new();
    for k in 0..levelled.len() {
        for l in k + 1..levelled.len() {
            if counts[k][l] > 0 {
                let differences = levelled[k].iter().zip(&levelled[l]).map(|(a, b)| a - b);
                let squares: f64 = differences.filter(|d| !d.is_nan()).map(|d| d * d).sum();
                let rms_nm = (squares / counts[k][l] as f64).sqrt();
                overlaps.push(Overlap { maps: [k + 1, l + 1], pixels: counts[k][l], rms_nm });
            }
        }
    }
    overlaps
}
