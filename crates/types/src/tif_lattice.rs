//! A TIF on the lattice of a map: the one module that reconciles the pitch of the TIF with the pitch of the map.
//!
//! The offsets (pixel - tool) of a motion run through all fractions of a sample. A fast convolution needs samples whose
//! distance divides the pixel size h of the map. A TIF R of another pitch is therefore resampled from its lower edge
//! (`low`) on:
//!
//! ```text
//! R~(u) = Keys' interpolation of R(low + j h / m),   j = 0, 1, ...,   within the edges of R              (1)
//! ```
//!
//! m is the least number of parts of a pixel at which R~ is within a tolerance of R. Every stage uses R~ in place of R,
//! so that dwell times, simulation and certificates assume the same tool. At a pixel x
//!
//! ```text
//! |removal with R~ - removal with R| <= error * peak of R * time that the tool is within its reach of x  (2)
//! ```
//!
//! A TIF whose pitch is that of the map, or divides it, keeps its own samples.
//!
//! Source: R. Keys, IEEE Trans. Acoust. Speech Signal Process. 29 (1981) 1153. The error of (1) is O(d^3) with
//! d = h / m, and O(d^2) times the jump of the second derivative at the knots of R.

use std::borrow::Cow;

use ndarray::Array2;
use planish_numerics::keys;
use serde::{Deserialize, Serialize};

use crate::{Axis, Grid, Invalid, Tif, budget, text::significant};

/// Largest wanted error of a TIF on the lattice of a map, over its peak. Larger: less exact removals. Smaller: more
/// parts of a pixel, and work of a transform in proportion to their squared number.
pub const PARTS_TOLERANCE: f64 = 1e-4;

/// Largest number of parts of a pixel that is tried to reach the tolerance. [`most_parts`] allows more if the TIF has
/// finer samples. Larger: more work for tools with sharp rims. Smaller: a larger error of these.
const MOST_PARTS: usize = 4;

/// Largest accumulated difference between a TIF sample and its lattice point, in steps, up to which the TIF keeps its
/// own samples. A shift of 1e-4 of a pixel moves the removal by 1e-4 of its change over a pixel. Larger: a larger
/// error. Smaller: TIFs with rounded pitches are resampled.
const SAME_LATTICE: f64 = 1e-4;

/// Number of offsets along each axis of a lattice cell at which the error is measured.
const OFFSETS_PER_CELL: usize = 3;

/// Largest number of poses (position and heading) of a tool that varies at which the error is measured.
const POSES: usize = 8;

/// Memory per sample, bytes: the rate, with and without ghost nodes, and copies of both.
const BYTES_PER_SAMPLE: usize = 4 * size_of::<f64>();

/// Lattice of a TIF on a map, and the error of the TIF there.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct TifLattice {
    /// Number of samples of the TIF per pixel along x and y (m of the module).
    pub parts: [usize; 2],
    /// Largest difference from the TIF at thirds of the lattice, over the peak. Between these offsets it may be a fifth
    /// larger. It is 0 if the TIF keeps its own samples.
    pub error: f64,
    /// Change of the volume of the TIF by the resampling, over its volume.
    pub volume_change: f64,
    /// Wanted largest value of `error`.
    pub tolerance: f64,
}

/// A TIF on the lattice of a map, and that lattice.
#[derive(Clone, Debug)]
pub struct OnLattice<'a> {
    /// The TIF, resampled or as it was.
    pub tif: Cow<'a, Tif>,
    /// Lattice of its samples, with their error.
    pub lattice: TifLattice,
}

impl TifLattice {
    /// Returns true if the TIF was resampled.
    fn is_anew(&self) -> bool {
        self.error > 0.0
    }

    /// Returns the lattice if the TIF was resampled, else `None`, for a report that mentions only a change.
    pub fn if_anew(self) -> Option<Self> {
        if self.is_anew() { Some(self) } else { None }
    }

    /// Returns the warning that the error exceeds the tolerance, or `None` if it does not.
    pub fn warning(&self) -> Option<String> {
        if self.error <= self.tolerance {
            return None;
        }
        let [error, tolerance] =
            [self.error, self.tolerance].map(|part| significant(100.0 * part, 2));
        Some(format!(
            "the TIF is too sharp for the pixels of the map: between them it is exact to {error} % of its peak, not \
             to {tolerance} %; sample the TIF at the pitch of the map, or measure it at a smaller pitch"
        ))
    }
}

impl Tif {
    /// Returns the TIF on the lattice of a map, by (1) of the module, without its zero margins. Its error is at most
    /// `tolerance` of its peak, unless that needs more parts of a pixel than are tried.
    ///
    /// # Errors
    /// Refuses a TIF whose samples on the lattice do not fit into the memory.
    pub fn on_lattice_of(&self, map: &Grid, tolerance: f64) -> Result<OnLattice<'_>, Invalid> {
        let tif = self.without_zero_margins();
        let axes = [(&map.x, &tif.grid().x), (&map.y, &tif.grid().y)];
        let own = axes.map(|(map, samples)| own_parts(map, samples));
        if let [Some(nx), Some(ny)] = own {
            let made = self.lattice().copied().filter(|lattice| lattice.parts == [nx, ny]);
            if let Some(lattice) = made {
                return Ok(OnLattice { tif, lattice });
            }
            if nx.max(ny) <= MOST_PARTS {
                let lattice =
                    TifLattice { parts: [nx, ny], error: 0.0, volume_change: 0.0, tolerance };
                return Ok(OnLattice { tif, lattice });
            }
        }
        let most = axes.map(|(map, samples)| most_parts(map, samples));
        let mut parts = 1;
        loop {
            let is_last = parts >= most[0].max(most[1]);
            let each = [0, 1].map(|axis| match own[axis] {
                Some(own) if own <= MOST_PARTS => own,
                _ => parts.min(most[axis]),
            });
            let grid = lattice(&tif, map, each)?;
            match grid.map(|grid| (grid, difference(&tif, grid))) {
                Some((grid, Difference { error, volume_change }))
                    if error <= tolerance || is_last =>
                {
                    let lattice = TifLattice { parts: each, error, volume_change, tolerance };
                    let tif = Cow::Owned(tif.sampled_anew(grid).with_lattice(lattice));
                    return Ok(OnLattice { tif, lattice });
                }
                None if is_last => {
                    let problem = "is narrower than the pixels of the map";
                    let remedy = "check that the TIF and the map are both in mm";
                    return Err(Invalid::whole("rate_nm_per_s", problem.to_string(), remedy));
                }
                Some((_, Difference { error, .. })) => {
                    // No error falls faster than with the fourth power of the parts.
                    let enough = parts as f64 * (error / tolerance).powf(0.25);
                    let largest = most[0].max(most[1]);
                    parts = (enough.ceil() as usize).clamp(parts + 1, largest);
                }
                None => parts += 1,
            }
        }
    }

    /// Returns the TIF, and every kernel of a tool that varies, resampled at the offsets `grid`. Its edges stay where
    /// they are.
    fn sampled_anew(&self, grid: Grid) -> Self {
        let edge_mm = self.edge_mm();
        let ends = [grid.x.end_mm(), grid.y.end_mm()];
        // Samples beyond the edge are zero, and the TIF is zero there.
        let edge_mm = [0, 1].map(|axis| edge_mm[axis].max(ends[axis]));
        let [x, y] = [(0, &grid.x), (1, &grid.y)].map(|(axis, samples)| {
            (0..samples.len()).map(|i| self.tap(axis, samples.coordinate_mm(i))).collect::<Vec<_>>()
        });
        let anew = |tif: &Self| {
            let mut rate = Array2::zeros(grid.shape());
            let mut work = Vec::new();
            for (tap, mut row) in y.iter().zip(rate.outer_iter_mut()) {
                tif.line(tap, &x, &mut work, row.as_slice_mut().expect("in C order"));
            }
            Self::unchecked(grid, rate, edge_mm)
        };
        let variation = self
            .variation()
            .map(|v| v.with_kernels(v.components().iter().map(|c| anew(c.kernel())).collect()));
        anew(self).with_variation(variation)
    }

    /// Returns the first node around the offset `offset_mm` along an axis, and the four weights of Keys' interpolation
    /// there.
    fn tap(&self, axis: usize, offset_mm: f64) -> Tap {
        self.cell(axis, offset_mm).map(|(cell, f)| (cell, keys::weights(f)))
    }

    /// Writes the rates on one line of constant y to `out`. `y` and the entries of `x` are the nodes and weights;
    /// `work` is scratch memory.
    fn line(&self, y: &Tap, x: &[Tap], work: &mut Vec<f64>, out: &mut [f64]) {
        let Some((row, wy)) = y else { return out.fill(0.0) };
        let nodes = self.with_ghosts();
        work.clear();
        work.resize(nodes.ncols(), 0.0);
        for (b, w) in wy.iter().enumerate() {
            work.iter_mut().zip(nodes.row(row + b)).for_each(|(sum, g)| *sum += w * g);
        }
        for (out, tap) in out.iter_mut().zip(x) {
            *out = tap.map_or(0.0, |(cell, wx)| {
                let g = &work[cell..cell + 4];
                wx[0] * g[0] + wx[1] * g[1] + wx[2] * g[2] + wx[3] * g[3]
            });
        }
    }
}

/// First of the four nodes around an offset, and their weights; `None` beyond the TIF.
type Tap = Option<(usize, [f64; 4])>;

/// Returns the number of samples per pixel if it is whole, so that the TIF keeps its own samples; else `None`.
fn own_parts(map: &Axis, samples: &Axis) -> Option<usize> {
    let ratio = map.step_mm() / samples.step_mm();
    let whole = ratio.round().max(1.0);
    let drift = (ratio / whole - 1.0).abs() * (samples.len() - 1) as f64;
    if drift <= SAME_LATTICE { Some(whole as usize) } else { None }
}

/// Returns the largest number of parts of a pixel to try: [`MOST_PARTS`], or the number that halves the pitch of the
/// samples if that is larger.
fn most_parts(map: &Axis, samples: &Axis) -> usize {
    let halves = (2.0 * map.step_mm() / samples.step_mm()).ceil();
    MOST_PARTS.max(halves as usize)
}

/// Returns the offsets of (1) of the module for `parts` samples per pixel; `None` if the TIF has fewer than two of them
/// along an axis.
fn lattice(tif: &Tif, map: &Grid, parts: [usize; 2]) -> Result<Option<Grid>, Invalid> {
    let axes = [(0, &map.x, &tif.grid().x), (1, &map.y, &tif.grid().y)];
    let counts = axes.map(|(axis, map, samples)| {
        let step_mm = map.step_mm() / parts[axis] as f64;
        let (whole, fraction) = keys::split((tif.edge_mm()[axis] - samples.start_mm()) / step_mm);
        // One beyond the edge where the TIF is zero on both sides of it.
        let more = fraction > 0.0 && ends_in_zeros(tif, axis);
        (samples.start_mm(), step_mm, whole + 1 + isize::from(more))
    });
    let [x, y] = counts;
    let remedy = "check that the TIF and the map are both in mm, or crop and bin the TIF";
    budget::affordable("rate_nm_per_s", x.2 as f64 * y.2 as f64, BYTES_PER_SAMPLE, remedy)?;
    if x.2 < 2 || y.2 < 2 {
        return Ok(None);
    }
    let [x, y] = counts.map(|(start_mm, step_mm, len)| Axis::new(start_mm, step_mm, len as usize));
    Ok(Some(Grid { x: x?, y: y? }))
}

/// Returns true if the last samples along x (`axis` 0) or y (1) are zero, for the mean tool and all kernels.
fn ends_in_zeros(tif: &Tif, axis: usize) -> bool {
    let components = tif.variation().map_or(&[][..], |v| v.components());
    components.iter().map(|c| c.kernel()).chain([tif]).all(|tif| {
        let rate = tif.rate_nm_per_s();
        let last = [rate.column(rate.ncols() - 1), rate.row(rate.nrows() - 1)];
        last[axis].iter().all(|v| *v == 0.0)
    })
}

/// Difference between a resampled TIF and the TIF.
struct Difference {
    /// Largest difference of the rate, over the peak.
    error: f64,
    /// Change of the volume of the mean tool, over that volume.
    volume_change: f64,
}

/// Returns the difference between the TIF resampled at the offsets `grid` and the TIF. For a tool that varies, it also
/// takes some poses at which the weights are sampled, and returns the largest error.
fn difference(tif: &Tif, grid: Grid) -> Difference {
    let mut worst = difference_of(&tif.mean_tool(), grid);
    let Some(variation) = tif.variation() else { return worst };
    let poses = variation.sampled();
    for pose in poses.iter().step_by(poses.len().div_ceil(POSES)) {
        let there = Tif::unchecked(*tif.grid(), variation.rate_at(*pose), tif.edge_mm());
        worst.error = worst.error.max(difference_of(&there, grid).error);
    }
    worst
}

/// Returns the difference between a TIF that does not vary, resampled at the offsets `grid`, and the TIF.
fn difference_of(tif: &Tif, grid: Grid) -> Difference {
    let anew = tif.sampled_anew(grid);
    let peak = tif.peak_nm_per_s();
    let offsets_mm = [(0, &grid.x), (1, &grid.y)].map(|(axis, samples)| {
        let step_mm = samples.step_mm() / OFFSETS_PER_CELL as f64;
        let count = ((anew.edge_mm()[axis] - samples.start_mm()) / step_mm + keys::SNAP) as usize;
        (0..=count).map(|k| samples.start_mm() + k as f64 * step_mm).collect::<Vec<f64>>()
    });
    let [x, y] = [0, 1].map(|axis| taps(tif, axis, &offsets_mm[axis]));
    let [x_anew, y_anew] = [0, 1].map(|axis| taps(&anew, axis, &offsets_mm[axis]));
    let mut line = vec![0.0; x.len()];
    let mut line_anew = vec![0.0; x.len()];
    let mut work = Vec::new();
    let mut error = 0.0_f64;
    let mut volume = 0.0;
    let mut change = 0.0;
    for (y, y_anew) in y.iter().zip(&y_anew) {
        tif.line(y, &x, &mut work, &mut line);
        anew.line(y_anew, &x_anew, &mut work, &mut line_anew);
        let off = line.iter().zip(&line_anew).map(|(r, anew)| (anew - r).abs());
        error = error.max(off.fold(0.0, f64::max) / peak);
        volume += line.iter().sum::<f64>();
        change += line_anew.iter().sum::<f64>() - line.iter().sum::<f64>();
    }
    Difference { error, volume_change: change / volume }
}

/// Returns the nodes and weights of several offsets along x (`axis` 0) or y (1).
fn taps(tif: &Tif, axis: usize, offsets_mm: &[f64]) -> Vec<Tap> {
    offsets_mm.iter().map(|mm| tif.tap(axis, *mm)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn square(step: f64, n: usize) -> Grid {
        let axis = Axis::new(-0.5 * step * (n - 1) as f64, step, n).unwrap();
        Grid { x: axis, y: axis }
    }

    /// Returns a Gaussian TIF of sigma 1 mm with samples at distances of `step` up to `half`, mm.
    fn bell(step: f64, half: f64) -> Tif {
        let grid = square(step, 2 * (half / step).round() as usize + 1);
        let at = |(r, c)| {
            (-0.5 * (grid.x.coordinate_mm(c).powi(2) + grid.y.coordinate_mm(r).powi(2))).exp()
        };
        Tif::new(grid, Array2::from_shape_fn(grid.shape(), at)).unwrap()
    }

    #[test]
    fn samples_of_the_map_are_those_of_the_tif() {
        let tif = bell(0.2, 3.0);
        for (step, parts) in [(0.2, 1), (0.4, 2), (0.8, 4)] {
            let found = tif.on_lattice_of(&square(step, 50), PARTS_TOLERANCE).unwrap();
            assert_eq!((found.lattice.parts, found.lattice.error), ([parts; 2], 0.0));
            assert!(matches!(found.tif, Cow::Borrowed(_)));
        }
    }

    #[test]
    fn the_stated_error_bounds_that_at_other_offsets_and_edges_stay() {
        // Cut off at 1 % of the peak and at 0.03 % of it; samples coarser and finer than the pixels.
        for (tif, step) in [(bell(0.31, 3.1), 0.2), (bell(0.13, 3.9), 0.2), (bell(0.05, 3.0), 0.47)]
        {
            let found = tif.on_lattice_of(&square(step, 40), PARTS_TOLERANCE).unwrap();
            let lattice = found.lattice;
            assert!(lattice.error <= PARTS_TOLERANCE, "{lattice:?}");
            let mut largest = 0.0_f64;
            let end = tif.grid().x.end_mm();
            for k in 0..20_000 {
                let place = |golden: f64| ((f64::from(k) * golden).fract() * 2.2 - 1.1) * end;
                let (x, y) = (place(0.754_877_666), place(0.569_840_291));
                let off = found.tif.rate_at(x, y) - tif.rate_at(x, y);
                largest = largest.max(off.abs());
            }
            // The error is measured at thirds of a cell, and may be larger between them.
            assert!(largest < 1.3 * lattice.error, "{largest} {lattice:?}");
            assert!(largest > 0.3 * lattice.error, "{largest} {lattice:?}");
            assert!(lattice.volume_change.abs() < lattice.error);
            // The edge is that of the TIF: its last sample counts, and nothing beyond.
            assert!(found.tif.rate_at(end, 0.0) > 0.0 && found.tif.rate_at(end + 1e-6, 0.0) == 0.0);
            // Once more nothing changes.
            let again = found.tif.on_lattice_of(&square(step, 40), PARTS_TOLERANCE).unwrap();
            assert_eq!(again.lattice, lattice);
            assert!(matches!(again.tif, Cow::Borrowed(_)));
        }
    }

    #[test]
    fn a_sharp_rim_is_said() {
        let grid = square(0.179, 27);
        let at = |(r, c)| f64::from(grid.x.coordinate_mm(c).hypot(grid.y.coordinate_mm(r)) < 1.5);
        let tif = Tif::new(grid, Array2::from_shape_fn(grid.shape(), at)).unwrap();
        let found = tif.on_lattice_of(&square(0.266, 60), PARTS_TOLERANCE).unwrap();
        assert_eq!(found.lattice.parts, [MOST_PARTS; 2]);
        assert!(found.lattice.warning().unwrap().contains("too sharp for the pixels of the map"));
    }

    #[test]
    fn the_error_falls_with_the_second_power_of_the_parts() {
        let tif = bell(0.37, 3.7);
        let error = |step: f64| {
            let grid = lattice(&tif, &square(step, 9), [1, 1]).unwrap().unwrap();
            difference(&tif, grid).error
        };
        let order = (error(0.2) / error(0.05)).log2() / 2.0;
        // Order 3 within the cells of the TIF, and 2 at its knots, where only its first derivative is continuous: they
        // decide. Two steps of a factor of two are not yet the limit.
        assert!((1.7..2.6).contains(&order), "{order}");
    }
}
