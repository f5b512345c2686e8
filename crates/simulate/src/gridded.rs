//! The removal by FFT convolution, exact for a TIF on the pixels of the map.
//!
//! # The convolution
//!
//! Along one axis let the TIF have samples `g[j]` at the offsets `a + j h` and the map pixels at
//! `x0 + i h`. A tool at `P` stands at the lattice coordinate `c = (P + a - x0) / h = C + f`.
//! Keys' interpolation gives the pixel `i = C + k` the rate
//!
//! ```text
//! K(k - f) = sum_d w_d(f) g[k - d],   d = -1..2                                   (1)
//! ```
//!
//! which is a convolution: the tool spreads its seconds over the four lattice points `C + d` with the weights
//! `w_d(f)` (sixteen in two dimensions). The field of seconds is convolved with the samples. No approximation is
//! made: sums are only reordered.
//!
//! The `w_d` are the weights of [`planish_numerics::keys`], where they interpolate at a coordinate *above* a node:
//!
//! ```text
//! K(s) = sum_e w_e(1 - f) g[k - 1 + e],   s = k - f = (k - 1) + (1 - f),   e = -1..2
//! w_e(1 - f) = w_(1-e)(f)                 Keys' kernel is symmetric,   so with d = 1 - e it is (1)
//!
//! w_-1 = -(f - 2 f^2 + f^3) / 2,   w_0 = 1 - (5 f^2 - 3 f^3) / 2
//! w_1  = (f + 4 f^2 - 3 f^3) / 2,  w_2 = -(f^2 - f^3) / 2
//! ```
//!
//! For 0 < f they also need `g[-1]` and `g[n]`, the ghost nodes of that module.
//!
//! # The border
//!
//! `R` ends at its last samples, `K` of (1) goes on for up to three pixels on the way to zero.
//! A measured TIF ends with a step of some percent of its peak, and what spills there is hundreds
//! of times the accuracy wanted. The spill is removed exactly: with `E` the convolution and `ly`,
//! `lx` the indicators of pixel rows and columns beyond the samples,
//!
//! ```text
//! R = E (1 - ly)(1 - lx) = E - E ly - E lx + E ly lx                              (2)
//! ```
//!
//! A spilling row holds only the few samples next to the border, `E ly = sum_j (w (seconds))_j *
//! g[j, :]`: convolutions along one axis. The last term is a few pixels at the corners of the
//! TIF and is added point by point.
//!
//! # Tiles
//!
//! The map is divided in tiles (`tile`), each with the field of seconds from which
//! the tool reaches it: what a thread works on stays in its cache, nothing as large as the map is
//! kept but the removal, and a tile that no motion reaches costs nothing. A tile has two strips of
//! the map side by side, which share one complex transform. The tiles depend on the TIF and the map
//! only, and within one the motion goes in the order of time: the result does not depend on the
//! number of threads. All of this (lattice, tiles, spectra) is a [`GriddedPlan`], which many trajectories
//! share.
//!
//! # Other pixels
//!
//! A TIF whose pitch divides that of the map is on a lattice of its own samples, and nothing changes but that only some
//! of the nodes are pixels. A TIF of any other pitch is first sampled anew on the lattice of the map
//! ([`planish_types::TifLattice`]). The edge of R then lies between two lattice points, which (2) takes into account.
//! The error of the new samples is reported.

use std::{borrow::Cow, ops::Range, sync::Mutex};

use ndarray::{Array2, Axis as NdAxis};
use planish_numerics::fft::{
    lane_convolution::{field_size, is_field_size},
    tiles::field_work,
};
use planish_types::{
    Grid, Headings, Invalid, OnLattice, PARTS_TOLERANCE, Tif, TifLattice, Trajectory, budget,
    progress::PieceCounter,
};
use rayon::prelude::*;

use crate::{
    Numerics, Tell,
    kernel::Kernel,
    lattice::{Lattice, has_border},
    quadrature::{Cutter, Reach, Weight},
    tile::{Tile, Workspace},
};

/// Largest number of points of the lattice on which map and TIF lie; more are refused. Larger: more memory. Smaller:
/// large maps are refused.
const MAX_LATTICE: usize = 1 << 28;

/// Memory of one sample of the TIF on the lattice, bytes, with its part of the padded spectrum (measured: about 60).
/// Larger: problems that would fit are refused. Smaller: the memory may run out.
const BYTES_PER_SAMPLE: usize = 64;

/// Data that depend on the TIF and the map only and serve many trajectories. A tool that varies has several kernels:
///
/// ```text
/// M(x) = g(x) sum_k (phi_k * the seconds weighted with c(t) a_k(P(t)))(x)           (3)
/// ```
///
/// by (1) of [`planish_types::Variation`]: phi_k are the kernels, a_k their weights at the position P(t) of the tool, c
/// a factor of the time and g one of the pixels. A constant tool has one kernel, and no weights.
pub struct GriddedPlan {
    kernels: Vec<OfKernel>,
    /// Lattice of the TIF on the map.
    lattice: TifLattice,
    /// The tool, if it varies over the part or in time.
    varying: Option<Tif>,
    /// Factor of every pixel, shape (ny, nx), if the tool has one.
    factor: Option<Array2<f64>>,
}

/// Convolution with one kernel of the tool.
struct OfKernel {
    kernel: Kernel,
    /// Number of pixels per strip along x and per band along y.
    pixels: [usize; 2],
    /// Buffers of earlier calls that no thread uses at the moment, for the next ones.
    idle: Mutex<Vec<Workspace>>,
}

impl GriddedPlan {
    /// Prepares the removal of `tif` on the pixels of `grid`.
    ///
    /// # Errors
    ///
    /// Refuses a TIF that cannot be sampled on the lattice of the map, and a lattice that does not fit into the memory.
    pub fn new(tif: &Tif, grid: &Grid) -> Result<Self, Invalid> {
        let OnLattice { tif, lattice } = tif.on_lattice_of(grid, PARTS_TOLERANCE)?;
        let peak = tif.peak_nm_per_s();
        let parts = lattice.parts;
        let Some(variation) = tif.variation() else {
            let kernels = vec![OfKernel::new(&tif, peak, grid, parts)?];
            return Ok(Self { kernels, lattice, varying: None, factor: None });
        };
        let components = variation.components().iter();
        let kernels = components
            .map(|c| OfKernel::new(c.kernel(), peak, grid, parts))
            .collect::<Result<_, _>>()?;
        let factor = variation.factor_on(grid).map(Cow::into_owned);
        Ok(Self { kernels, lattice, varying: Some(tif.into_owned()), factor })
    }

    /// Computes the removal of `trajectory`, shape (ny, nx), nm.
    pub fn removal_nm(&self, trajectory: &Trajectory) -> (Array2<f64>, Numerics) {
        self.removal_with_progress(trajectory, &|_| ())
    }

    /// Computes the removal, and calls `tell` with the fraction that is done.
    pub(crate) fn removal_with_progress(
        &self,
        trajectory: &Trajectory,
        tell: Tell<'_>,
    ) -> (Array2<f64>, Numerics) {
        let count = self.kernels.len() as f64;
        let variation = self.varying.as_ref().and_then(Tif::variation);
        let headings = variation.map(|_| Headings::new(trajectory));
        let of_kernels = self.kernels.iter().enumerate().map(|(k, kernel)| {
            let weight = variation.zip(headings.as_ref());
            let weight =
                weight.map(|(variation, headings)| Weight { variation, kernel: k, headings });
            kernel.removal_with_progress(trajectory, weight.as_ref(), &|part| {
                tell((k as f64 + part) / count);
            })
        });
        let sum = of_kernels.reduce(|(a, points), (b, _)| (a + b, points));
        let (mut removal, quadrature_points) = sum.expect("a tool has a kernel");
        let TifLattice { parts, error, .. } = self.lattice;
        let numerics =
            Numerics { quadrature_points, subdivision: parts, tif_interpolation_error: error };
        if let Some(factor) = &self.factor {
            removal *= factor;
        }
        (removal, numerics)
    }
}

impl OfKernel {
    /// Prepares the convolution with one kernel `tif` of the tool. `peak` is the peak of the whole tool, nm/s, and
    /// `parts` the number of lattice steps per pixel along [x, y].
    fn new(tif: &Tif, peak: f64, grid: &Grid, parts: [usize; 2]) -> Result<Self, Invalid> {
        let [x, y] = [0, 1].map(|axis| Lattice::new(grid, tif, parts[axis], axis));
        if x.source_nodes().saturating_mul(y.source_nodes()) > MAX_LATTICE {
            return Err(too_fine(tif, grid, &x, &y));
        }
        // The samples of the TIF on the lattice, and their transform.
        let samples = x.samples() as f64 * y.samples() as f64;
        let remedy = "check that the TIF and the map are both in mm, or crop and bin the TIF";
        budget::affordable("rate_nm_per_s", samples, BYTES_PER_SAMPLE, remedy)?;
        let samples = tif.with_ghosts();
        let spills = has_border(peak, &x, &y, samples);
        let (pixels, size) = layout(&x, &y, spills);
        let kernel = Kernel::new(x, y, samples.view(), size, spills);
        Ok(Self { kernel, pixels, idle: Mutex::default() })
    }

    /// Computes the removal of `trajectory` by this kernel, shape (ny, nx), nm, and the number of quadrature points. A
    /// `weight` multiplies the time of the tool. `tell` gets the fraction that is done.
    fn removal_with_progress(
        &self,
        trajectory: &Trajectory,
        weight: Option<&Weight<'_>>,
        tell: Tell<'_>,
    ) -> (Array2<f64>, usize) {
        let mut removal = Array2::zeros((self.kernel.y.pixels, self.kernel.x.pixels));
        let bands = self.bands();
        let reaching = self.reaching(&bands, trajectory);
        let mut jobs = vec![];
        let mut rest = removal.view_mut();
        for (rows, segments) in bands.iter().zip(&reaching) {
            let (band, below) = rest.split_at(NdAxis(0), rows.len());
            rest = below;
            let mut band = Some(band);
            for strips in self.strips() {
                let whole = band.take().expect("one part for each pair of strips");
                let (part, right) = whole.split_at(NdAxis(1), strips[0].len() + strips[1].len());
                band = Some(right);
                if !segments.is_empty() {
                    jobs.push((Tile::new(&self.kernel, rows.clone(), strips), segments, part));
                }
            }
        }
        let alone = jobs.len() == 1;
        let pieces = PieceCounter::new(jobs.len());
        let idle = || self.idle.lock().expect("no thread panics with the lock");
        let quadrature_points = jobs
            .into_par_iter()
            .with_max_len(1)
            .map(|(tile, segments, part)| {
                let work = idle().pop();
                let mut work = work.unwrap_or_else(|| Workspace::new(&self.kernel));
                let points = tile.run((trajectory, weight), segments, part, &mut work, alone);
                idle().push(work);
                tell(pieces.one_more());
                points
            })
            .sum();
        (removal, quadrature_points)
    }

    /// Returns the rows of each band of the map.
    fn bands(&self) -> Vec<Range<usize>> {
        parts(self.kernel.y.pixels, self.pixels[1])
    }

    /// Returns the columns of the map as two strips for each tile; the second strip of the last tile may be empty.
    fn strips(&self) -> Vec<[Range<usize>; 2]> {
        let n = self.kernel.x.pixels;
        let strips = parts(n, self.pixels[0]);
        strips
            .chunks(2)
            .map(|pair| [pair[0].clone(), pair.get(1).cloned().unwrap_or(n..n)])
            .collect()
    }

    /// Returns, for each band, the segments from which the tool may reach it, in the order of time.
    fn reaching(&self, bands: &[Range<usize>], trajectory: &Trajectory) -> Vec<Vec<Reach>> {
        let cutter = Cutter::new([self.kernel.x.cells(), self.kernel.y.cells()]);
        let segments = (0..trajectory.len()).into_par_iter().with_min_len(256);
        let all: Vec<Reach> = segments
            .filter_map(|segment| {
                let s = trajectory.segment(segment);
                if s.tool_on { Some(cutter.reach(segment, &s)) } else { None }
            })
            .collect();
        bands
            .par_iter()
            .map(|rows| {
                let window = self.kernel.y.window(rows);
                all.iter().filter(|r| r.is_in(1, &window)).copied().collect()
            })
            .collect()
    }
}

/// Returns the range 0 .. n in parts of `size`; the last may be shorter.
fn parts(n: usize, size: usize) -> Vec<Range<usize>> {
    (0..n).step_by(size).map(|from| from..(from + size).min(n)).collect()
}

/// Computes the removal (ny, nx) in nm on `grid`.
///
/// # Errors
///
/// Refuses what [`GriddedPlan::new`] refuses.
pub fn removal_nm(
    trajectory: &Trajectory,
    tif: &Tif,
    grid: &Grid,
) -> Result<(Array2<f64>, Numerics), Invalid> {
    Ok(GriddedPlan::new(tif, grid)?.removal_nm(trajectory))
}

/// Number of cores for which the tiles are laid out. It is fixed, because the result may not depend on the number of
/// cores. Larger: smaller tiles, and more work in total. Smaller: cores idle. Another value changes the last digits of
/// the result.
const CORES: usize = 2;

/// Work of the correction at the border of R, in the unit of [`field_work`], per row or column of pixels and per n
/// log2(n) of its n nodes. It stands for four transforms of the seconds, one of the correction back, and the sums
/// between them. Another value changes the choice of the tiles, and with it the speed.
const SPILL_WORK: f64 = 4.0;

/// Chooses the number of pixels [per strip along x, per band along y], and the shape (ny, nx) of the transform, with
/// the least work for the busiest core. `spills` says if the border of R has to be corrected ((2) of the module).
fn layout(x: &Lattice, y: &Lattice, spills: bool) -> ([usize; 2], (usize, usize)) {
    let mut best = (f64::INFINITY, [0, 0], (0, 0));
    for &(nx, px) in &choices(x) {
        for &(ny, py) in &choices(y) {
            let tiles = x.pixels.div_ceil(px).div_ceil(2) * y.pixels.div_ceil(py);
            let border = if spills {
                SPILL_WORK * (py as f64 * line_work(nx) + px as f64 * line_work(ny))
            } else {
                0.0
            };
            let cost = tiles.div_ceil(CORES) as f64 * (field_work::<f64>((ny, nx)) + border);
            if cost < best.0 {
                best = (cost, [px, py], (ny, nx));
            }
        }
    }
    // Parts of equal size.
    let pixels = [(x, best.1[0]), (y, best.1[1])]
        .map(|(l, part)| l.pixels.div_ceil(l.pixels.div_ceil(part)));
    (pixels, best.2)
}

/// Returns the possible sizes of a transform along an axis, each with the largest number of pixels of the map for which
/// it suffices.
fn choices(l: &Lattice) -> Vec<(usize, usize)> {
    // Elements of a transform that holds all, and so for a part of the pixels.
    let whole = field_size(l.source_nodes());
    (1..=whole)
        .filter(|n| is_field_size(*n) && *n >= l.samples())
        .map(|n| (n, ((n - l.samples()) / l.subdivision + 1).min(l.pixels)))
        .collect()
}

/// Returns n log2(n), at least n, for a row or column of `n` nodes: the work of its transform in the unit of
/// [`field_work`].
fn line_work(n: usize) -> f64 {
    n as f64 * (n as f64).log2().max(1.0)
}

fn too_fine(tif: &Tif, grid: &Grid, x: &Lattice, y: &Lattice) -> Invalid {
    let [of_tif, of_map] =
        [tif.grid(), grid].map(|g| format!("{} x {} mm", g.x.step_mm(), g.y.step_mm()));
    Invalid::whole(
        "rate_nm_per_s",
        format!(
            "is sampled at {of_tif}, the map at {of_map}: a lattice for both has {} x {} points",
            x.source_nodes(),
            y.source_nodes()
        ),
        "check that both are in mm, or resample the TIF to the pitch of the map",
    )
}
