//! The removal by one FFT convolution, exact for a TIF on the pixels of the map.
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
//! which is a convolution: the tool spreads its seconds over the four lattice points `C + d` with
//! the weights `w_d(f)` (sixteen in two dimensions), and the field of seconds is convolved with
//! the samples. No approximation is made: sums are only reordered.
//!
//! # The border
//!
//! `R` ends at its last samples, `K` of (1) goes on for up to three pixels on the way to zero.
//! A measured TIF ends with a step of some percent of its peak, and what leaks there is hundreds
//! of times the accuracy wanted. The leak is removed exactly: with `E` the convolution and `ly`,
//! `lx` the indicators of pixel rows and columns beyond the samples,
//!
//! ```text
//! R = E (1 - ly)(1 - lx) = E - E ly - E lx + E ly lx                              (2)
//! ```
//!
//! A leaking row holds only the few samples next to the border, `E ly = sum_j (w (seconds))_j *
//! g[j, :]`: convolutions along one axis. The last term is a few pixels at the corners of the
//! TIF and is added point by point.
//!
//! Each row of seconds and of the leak is the work of one thread, from the points that reach it in
//! the order of time: the result does not depend on the number of threads. What depends on the TIF
//! and the map only (lattice, spectra) is a [`Plan`], which many trajectories share.
//!
//! # Other pixels
//!
//! A TIF sampled at another pitch is first sampled anew, by its own interpolation, on a lattice
//! that divides the pixels of the map and is at least twice as fine as the TIF's own. The edge of
//! R then lies between two lattice points, which (2) takes into account. The error of that
//! interpolation is measured; the lattice is refined until it is below [`TIF_TOLERANCE`] of the
//! peak or the lattice too large, and what was reached is reported.

use ndarray::{Array2, ArrayView2, Axis as NdAxis, s};
use planish_numerics::{fft, keys};
use planish_types::{Axis, Grid, Invalid, Tif, Trajectory};
use rayon::prelude::*;

use crate::{
    Numerics,
    quadrature::{self, Lines, Sample},
};

/// Largest accumulated difference between a TIF sample and its lattice point, in steps, at which
/// the two lattices are the same. A shift of 1e-4 of a pixel moves the removal by 1e-4 of what it
/// changes over a pixel.
const SAME_LATTICE: f64 = 1e-4;

/// Wanted error of the TIF on a lattice that is not its own, relative to its peak: 1e-3 nm in a
/// removal of 40 nm.
pub const TIF_TOLERANCE: f64 = 2.5e-5;

/// Most lattice points to refine to (256 MiB of seconds), and most that are accepted at all.
const MAX_REFINED: usize = 1 << 25;
const MAX_LATTICE: usize = 1 << 28;

/// What depends on the TIF and the map only: for many trajectories.
pub struct Plan {
    x: Lattice,
    y: Lattice,
    /// Samples of the TIF on the lattice, with ghost nodes.
    samples: Array2<f64>,
    tif_interpolation_error: f64,
    convolution: fft::Convolution,
    /// `E ly` and `E lx`, transposed; `None` where nothing leaks.
    border: Option<[Leak; 2]>,
}

impl Plan {
    /// Plans the removal of `tif` on `grid`.
    pub fn new(tif: &Tif, grid: &Grid) -> Result<Self, Invalid> {
        let own = [grid.x, grid.y].into_iter().zip([tif.grid().x, tif.grid().y]);
        let subdivision: Vec<usize> = own.map(|(map, tif)| least_subdivision(&map, &tif)).collect();
        let mut refinement = 1;
        let (x, y, samples, tif_interpolation_error) = loop {
            let x = Lattice::new(&grid.x, &tif.grid().x, subdivision[0] * refinement);
            let y = Lattice::new(&grid.y, &tif.grid().y, subdivision[1] * refinement);
            let points = x.source_nodes().saturating_mul(y.source_nodes());
            if points > MAX_LATTICE {
                return Err(too_fine(tif, grid, &x, &y));
            }
            let samples = sample_anew(tif, &x, &y);
            let error = interpolation_error(tif, &x, &y, &samples);
            if error <= TIF_TOLERANCE || points > MAX_REFINED / 4 {
                break (x, y, samples, error);
            }
            refinement *= 2;
        };
        let shape = (y.source_nodes(), x.source_nodes());
        let convolution = fft::Convolution::new(samples.view(), shape);
        let border = has_border(tif, &x, &y, &samples)
            .then(|| [Leak::new(&x, &y, samples.view()), Leak::new(&y, &x, samples.t())]);
        Ok(Self { x, y, samples, tif_interpolation_error, convolution, border })
    }

    /// Removal (ny, nx) of `trajectory`, nm.
    pub fn removal_nm(&self, trajectory: &Trajectory) -> (Array2<f64>, Numerics) {
        let (x, y) = (&self.x, &self.y);
        let lines: Vec<Lines> = x.lines(0).into_iter().chain(y.lines(1)).collect();
        let low_mm = [x.low_mm(), y.low_mm()];
        let high_mm = [x.high_mm(), y.high_mm()];
        let points = quadrature::samples(trajectory, &lines, low_mm, high_mm);
        let placed: Vec<Placed> = points.par_iter().map(|s| Placed::new(s, x, y)).collect();

        // R = E - E ly - E lx + E ly lx                                              (2)
        let by_row = ByCell::new(placed.clone());
        let mut removal = self.convolution(&by_row);
        if let Some([rows, columns]) = &self.border {
            removal -= &rows.of(&by_row, x, y);
            let swapped = ByCell::new(placed.iter().map(Placed::swapped).collect());
            removal -= &columns.of(&swapped, y, x).t();
            add_corners(&mut removal, &placed, x, y, &self.samples);
        }
        let numerics = Numerics {
            quadrature_points: points.len(),
            subdivision: [x.subdivision, y.subdivision],
            tif_interpolation_error: self.tif_interpolation_error,
        };
        (removal, numerics)
    }

    /// E of (2): every pixel of the map, whether or not it is beyond the samples.
    fn convolution(&self, placed: &ByCell) -> Array2<f64> {
        let (x, y) = (&self.x, &self.y);
        let mut seconds = Array2::zeros((y.source_nodes(), x.source_nodes()));
        seconds.outer_iter_mut().into_par_iter().enumerate().for_each(|(r, mut row)| {
            let row = row.as_slice_mut().expect("in C order");
            let node = r as isize - y.last;
            for d in -1..=2 {
                for p in placed.at(node - d) {
                    p.spread(p.time_s * weight_of(&p.weight[1], d), x, row);
                }
            }
        });
        let all = self.convolution.valid(seconds.view());
        if x.subdivision == 1 && y.subdivision == 1 {
            return all;
        }
        all.slice(s![..;y.subdivision, ..;x.subdivision]).to_owned()
    }
}

/// Removal (ny, nx) in nm on `grid`.
pub fn removal_nm(
    trajectory: &Trajectory,
    tif: &Tif,
    grid: &Grid,
) -> Result<(Array2<f64>, Numerics), Invalid> {
    Ok(Plan::new(tif, grid)?.removal_nm(trajectory))
}

fn too_fine(tif: &Tif, grid: &Grid, x: &Lattice, y: &Lattice) -> Invalid {
    let steps = |g: &Grid| format!("{} x {} mm", g.x.step_mm(), g.y.step_mm());
    Invalid::whole(
        "rate_nm_per_s",
        format!(
            "is sampled at {}, the map at {}: a lattice for both has {} x {} points",
            steps(tif.grid()),
            steps(grid),
            x.source_nodes(),
            y.source_nodes()
        ),
        "check that both are in mm, or resample the TIF to the pitch of the map",
    )
}

/// Lattice steps per pixel at which the lattice is twice as fine as the TIF's samples; 0 when
/// those are on the pixels of the map.
fn least_subdivision(map: &Axis, tif: &Axis) -> usize {
    let ratio = map.step_mm() / tif.step_mm();
    if (ratio - 1.0).abs() * (tif.len() - 1) as f64 <= SAME_LATTICE {
        0
    } else {
        (2.0 * ratio).ceil().max(1.0) as usize
    }
}

/// The lattice of one axis: pixel `i` of the map is node `i subdivision`, sample `j` of the TIF
/// (on the lattice) has the offset `low + j step`.
#[derive(Clone, Debug)]
struct Lattice {
    /// Whether the samples of the TIF are the nodes.
    own: bool,
    /// Lattice steps per pixel.
    subdivision: usize,
    /// Distance of the nodes, mm.
    step_mm: f64,
    /// Pixels of the map.
    pixels: usize,
    /// Coordinate of node 0 = pixel 0, mm.
    start_mm: f64,
    /// Offset of TIF sample 0 (= the lower edge of R), mm.
    tif_start_mm: f64,
    /// Upper edge of R, in steps from the lower one.
    edge: f64,
    /// Largest j with a sample: samples are j = -1 ..= last.
    last: isize,
}

impl Lattice {
    /// `subdivision` 0 stands for the TIF's own samples, on the pixels of the map.
    fn new(map: &Axis, tif: &Axis, subdivision: usize) -> Self {
        let own = subdivision == 0;
        let subdivision = subdivision.max(1);
        let step_mm = map.step_mm() / subdivision as f64;
        let edge =
            if own { (tif.len() - 1) as f64 } else { (tif.end_mm() - tif.start_mm()) / step_mm };
        let (whole, fraction) = keys::split(edge);
        let last = whole + if fraction > 0.0 { 2 } else { 1 };
        Self {
            own,
            subdivision,
            step_mm,
            pixels: map.len(),
            start_mm: map.start_mm(),
            tif_start_mm: tif.start_mm(),
            edge,
            last,
        }
    }

    /// Nodes between the first and the last pixel.
    fn nodes(&self) -> usize {
        (self.pixels - 1).saturating_mul(self.subdivision).saturating_add(1)
    }

    /// Tool positions outside low .. high reach no pixel. Two steps more than needed.
    fn low_mm(&self) -> f64 {
        self.start_mm - self.tif_start_mm - (self.last + 2) as f64 * self.step_mm
    }

    fn high_mm(&self) -> f64 {
        let end_mm = self.start_mm + (self.nodes() - 1) as f64 * self.step_mm;
        end_mm - self.tif_start_mm + 2.0 * self.step_mm
    }

    /// Tool positions at which a pixel passes a sample of the TIF, or its upper edge.
    fn lines(&self, axis: usize) -> Vec<Lines> {
        let first_mm = self.start_mm - self.tif_start_mm;
        let line = |first_mm| Lines { axis, first_mm, step_mm: self.step_mm };
        let mut lines = vec![line(first_mm)];
        if keys::split(self.edge).1 > 0.0 {
            lines.push(line(first_mm - self.edge * self.step_mm));
        }
        lines
    }

    /// Sources reach from node -last to node nodes(): one more than outputs and samples need.
    fn source_nodes(&self) -> usize {
        self.nodes().saturating_add(self.last as usize + 1)
    }

    /// Index in a source field of the node `q`, if it is there.
    fn source_index(&self, q: isize) -> Option<usize> {
        usize::try_from(q + self.last).ok().filter(|i| *i < self.source_nodes())
    }

    /// The pixel at the node `q`, if there is one.
    fn pixel(&self, q: isize) -> Option<usize> {
        let i = usize::try_from(q).ok()?;
        (i % self.subdivision == 0 && i / self.subdivision < self.pixels)
            .then_some(i / self.subdivision)
    }

    /// Whether the node k beyond the tool's cell, at the offset f in it, is beyond R's edges:
    /// s = k - f outside [0, edge].
    fn is_beyond(&self, k: isize, f: f64) -> bool {
        let s = k as f64 - f;
        s < -keys::SNAP || s > self.edge + keys::SNAP
    }

    /// The nodes k that may be beyond an edge and still get something from (1).
    fn border(&self) -> Vec<isize> {
        let upper = self.edge.floor() as isize;
        (-2..=self.last + 2).filter(|k| *k <= 0 || *k >= upper).collect()
    }

    /// The samples j that those nodes get something from.
    fn border_samples(&self) -> Vec<isize> {
        let upper = self.edge.floor() as isize;
        (-1..=self.last).filter(|j| *j <= 1 || *j >= upper - 2).collect()
    }
}

/// A quadrature point on the lattice.
#[derive(Clone, Copy, Debug)]
struct Placed {
    /// Lattice cell [x, y].
    cell: [isize; 2],
    /// Offset in the cell [x, y].
    offset: [f64; 2],
    /// Keys' weights of the offset [x, y].
    weight: [[f64; 4]; 2],
    time_s: f64,
}

impl Placed {
    fn new(sample: &Sample, x: &Lattice, y: &Lattice) -> Self {
        let place = |lattice: &Lattice, p: f64| {
            // c = (P + a - x0) / h = C + f
            keys::split((p + lattice.tif_start_mm - lattice.start_mm) / lattice.step_mm)
        };
        let (cx, fx) = place(x, sample.position_mm[0]);
        let (cy, fy) = place(y, sample.position_mm[1]);
        Self {
            cell: [cx, cy],
            offset: [fx, fy],
            weight: [keys::weights(fx), keys::weights(fy)],
            time_s: sample.time_s,
        }
    }

    /// The same with x and y exchanged.
    fn swapped(&self) -> Self {
        let swap = |[a, b]: [isize; 2]| [b, a];
        Self {
            cell: swap(self.cell),
            offset: [self.offset[1], self.offset[0]],
            weight: [self.weight[1], self.weight[0]],
            time_s: self.time_s,
        }
    }

    /// Adds `seconds` to a row of sources, with the weights along x.
    fn spread(&self, seconds: f64, x: &Lattice, row: &mut [f64]) {
        let first = self.cell[0] - 1 + x.last;
        if let Some(nodes) = usize::try_from(first).ok().and_then(|i| row.get_mut(i..i + 4)) {
            nodes.iter_mut().zip(self.weight[0]).for_each(|(n, w)| *n += seconds * w);
            return;
        }
        for (a, w) in self.weight[0].iter().enumerate() {
            if let Some(c) = x.source_index(self.cell[0] + a as isize - 1) {
                row[c] += seconds * w;
            }
        }
    }
}

/// Quadrature points by their cell along y; in the order of time within one.
struct ByCell {
    lowest: isize,
    /// Where the points of `lowest + i` start; one more at the end.
    start: Vec<usize>,
    placed: Vec<Placed>,
}

impl ByCell {
    fn new(mut placed: Vec<Placed>) -> Self {
        placed.sort_by_key(|p| p.cell[1]);
        let lowest = placed.first().map_or(0, |p| p.cell[1]);
        let cells = placed.last().map_or(0, |p| (p.cell[1] - lowest + 1) as usize);
        let before = |i| placed.partition_point(|p| p.cell[1] < lowest + i as isize);
        Self { lowest, start: (0..=cells).map(before).collect(), placed }
    }

    /// The points of one cell.
    fn at(&self, cell: isize) -> &[Placed] {
        let Ok(i) = usize::try_from(cell - self.lowest) else { return &[] };
        match self.start.get(i..i.saturating_add(2)) {
            Some(&[from, to]) => &self.placed[from..to],
            _ => &[],
        }
    }
}

/// `w_d` for d = -1..2, else 0.
fn weight_of(weights: &[f64; 4], d: isize) -> f64 {
    usize::try_from(d + 1).ok().and_then(|i| weights.get(i)).copied().unwrap_or(0.0)
}

/// Samples j = -1 ..= last of both axes; [j + 1] in the array. On the TIF's own lattice these are
/// its samples with Keys' ghost nodes.
fn sample_anew(tif: &Tif, x: &Lattice, y: &Lattice) -> Array2<f64> {
    if x.own && y.own {
        return tif.with_ghosts().clone();
    }
    let offset = |l: &Lattice, j: usize| l.tif_start_mm + (j as f64 - 1.0) * l.step_mm;
    Array2::from_shape_fn(((y.last + 2) as usize, (x.last + 2) as usize), |(j, i)| {
        continued(tif, offset(x, i), offset(y, j))
    })
}

/// R, continued beyond its samples by the polynomials of its outermost cells.
fn continued(tif: &Tif, dx_mm: f64, dy_mm: f64) -> f64 {
    let cell = |axis: &Axis, d: f64| {
        let s = (d - axis.start_mm()) / axis.step_mm();
        let i = (s.floor().max(0.0) as usize).min(axis.len() - 2);
        (i, keys::weights(s - i as f64))
    };
    let ((ix, wx), (iy, wy)) = (cell(&tif.grid().x, dx_mm), cell(&tif.grid().y, dy_mm));
    let g = tif.with_ghosts();
    (0..4).map(|b| wy[b] * (0..4).map(|a| wx[a] * g[[iy + b, ix + a]]).sum::<f64>()).sum()
}

/// Largest error of (1) against R in the middle of the lattice cells, relative to the peak.
fn interpolation_error(tif: &Tif, x: &Lattice, y: &Lattice, g: &Array2<f64>) -> f64 {
    if x.own && y.own {
        return 0.0;
    }
    let middle = keys::weights(0.5);
    let (cells_y, cells_x) = ((y.edge.floor() as usize).max(1), (x.edge.floor() as usize).max(1));
    let worst = (0..cells_y)
        .into_par_iter()
        .map(|j| {
            (0..cells_x)
                .map(|i| {
                    let k: f64 = (0..4)
                        .map(|b| {
                            middle[b] * (0..4).map(|a| middle[a] * g[[j + b, i + a]]).sum::<f64>()
                        })
                        .sum();
                    let dx = x.tif_start_mm + (i as f64 + 0.5) * x.step_mm;
                    let dy = y.tif_start_mm + (j as f64 + 0.5) * y.step_mm;
                    (k - continued(tif, dx, dy)).abs()
                })
                .fold(0.0, f64::max)
        })
        .reduce(|| 0.0, f64::max);
    worst / tif.peak_nm_per_s()
}

/// Whether anything leaks: some sample next to the border is not negligible.
fn has_border(tif: &Tif, x: &Lattice, y: &Lattice, g: &Array2<f64>) -> bool {
    let near = |l: &Lattice, j: usize| l.border_samples().contains(&(j as isize - 1));
    let border = g.indexed_iter().filter(|((r, c), _)| near(y, *r) || near(x, *c));
    // Below this the leak is lost in the rounding of the peak.
    border.map(|(_, v)| v.abs()).fold(0.0, f64::max) > f64::EPSILON * tif.peak_nm_per_s()
}

/// `E ly` of (2): what (1) gives to the pixel rows beyond the samples.
///
/// For each sample row j next to the border, the seconds w_{k-j}(f_y) go to the pixel row C + k
/// that leaks; the row is then convolved with g[j, :] along x.
struct Leak {
    border: Vec<isize>,
    border_samples: Vec<isize>,
    convolution: fft::RowConvolution,
}

impl Leak {
    fn new(x: &Lattice, y: &Lattice, g: ArrayView2<f64>) -> Self {
        let border_samples = y.border_samples();
        let rows: Vec<usize> = border_samples.iter().map(|j| (j + 1) as usize).collect();
        let kernels = g.select(NdAxis(0), &rows);
        let convolution = fft::RowConvolution::new(kernels.view(), x.source_nodes());
        Self { border: y.border(), border_samples, convolution }
    }

    /// (ny, nx) for points by their cell along y.
    fn of(&self, placed: &ByCell, x: &Lattice, y: &Lattice) -> Array2<f64> {
        let mut leak = Array2::zeros((y.pixels, x.pixels));
        leak.outer_iter_mut().into_par_iter().enumerate().for_each_init(
            || {
                let sources = Array2::zeros((self.border_samples.len(), x.source_nodes()));
                (sources, vec![false; self.border_samples.len()], self.convolution.workspace())
            },
            |(sources, used, work), (r, mut out)| {
                used.fill(false);
                let node = (r * y.subdivision) as isize;
                for &k in &self.border {
                    for p in placed.at(node - k).iter().filter(|p| y.is_beyond(k, p.offset[1])) {
                        for (i, j) in self.border_samples.iter().enumerate() {
                            let wy = weight_of(&p.weight[1], k - j);
                            if wy == 0.0 {
                                continue;
                            }
                            let mut source = sources.row_mut(i);
                            let source = source.as_slice_mut().expect("in C order");
                            if !used[i] {
                                source.fill(0.0);
                                used[i] = true;
                            }
                            p.spread(p.time_s * wy, x, source);
                        }
                    }
                }
                let valid = self.convolution.valid_sum(sources.view(), used, work);
                if let Some(valid) = valid {
                    let pixels = valid.iter().step_by(x.subdivision);
                    out.iter_mut().zip(pixels).for_each(|(o, v)| *o = *v);
                }
            },
        );
        leak
    }
}

/// Adds `E ly lx` of (2): the pixels diagonally beyond the corners of the TIF.
fn add_corners(
    removal: &mut Array2<f64>,
    placed: &[Placed],
    x: &Lattice,
    y: &Lattice,
    g: &Array2<f64>,
) {
    let (border_x, border_y) = (x.border(), y.border());
    for p in placed {
        for &ky in border_y.iter().filter(|k| y.is_beyond(**k, p.offset[1])) {
            let Some(r) = y.pixel(p.cell[1] + ky) else { continue };
            for &kx in border_x.iter().filter(|k| x.is_beyond(**k, p.offset[0])) {
                let Some(c) = x.pixel(p.cell[0] + kx) else { continue };
                // (1) in two dimensions
                let mut rate = 0.0;
                for (b, wy) in p.weight[1].iter().enumerate() {
                    let j = ky - (b as isize - 1);
                    for (a, wx) in p.weight[0].iter().enumerate() {
                        let i = kx - (a as isize - 1);
                        if (-1..=y.last).contains(&j) && (-1..=x.last).contains(&i) {
                            rate += wy * wx * g[[(j + 1) as usize, (i + 1) as usize]];
                        }
                    }
                }
                removal[[r, c]] += p.time_s * rate;
            }
        }
    }
}
