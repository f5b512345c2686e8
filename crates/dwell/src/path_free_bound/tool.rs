//! The map and the tool of a bound: removal by dwell times on a lattice of places, and its adjoint.

use std::ops::Range;

use ndarray::{Array2, ArrayViewMut2, Zip, s};
use planish_numerics::fft::convolution::Convolution;
use planish_types::{Grid, Surface, Tif};

use super::highest::{flanks_mm, upsampled};

/// Largest rate at the edge of a tool, relative to its peak, that is no step. Larger: less work for more tools, and a
/// smaller bound for them. Smaller: nine times the adjoint products for more tools.
const SMALL_STEP: f64 = 1e-3;

/// Desired removal on the valid pixels.
pub struct PartPixels {
    /// Desired removal without its mean (ny, nx), nm; 0 on invalid pixels.
    pub desired_nm: Array2<f64>,
    /// 1 on valid pixels, 0 on others (ny, nx).
    pub valid: Array2<f64>,
    /// Number of valid pixels.
    pub pixels: f64,
}

impl PartPixels {
    /// Makes the part of a map of the desired removal.
    pub fn new(desired: &Surface) -> Self {
        let height_nm = desired.height_nm();
        let valid = height_nm.mapv(|z| f64::from(!z.is_nan()));
        let mut part = Self { pixels: valid.sum(), valid, desired_nm: Array2::zeros((0, 0)) };
        part.desired_nm = height_nm.mapv(|z| if z.is_nan() { 0.0 } else { z });
        part.desired_nm = part.centred(part.desired_nm.clone());
        part
    }

    /// Returns a map (ny, nx) without its mean over the valid pixels; 0 on the others.
    pub fn centred(&self, mut map: Array2<f64>) -> Array2<f64> {
        map *= &self.valid;
        let mean = map.sum() / self.pixels;
        Zip::from(&mut map).and(&self.valid).for_each(|v, valid| *v -= mean * valid);
        map
    }

    /// Returns the residual without its mean (ny, nx), nm, after a removal (ny, nx), nm.
    pub fn residual_nm(&self, removal_nm: Array2<f64>) -> Array2<f64> {
        self.centred(&self.desired_nm - &removal_nm)
    }

    /// Returns the RMS of a map (ny, nx) without mean.
    pub fn rms(&self, map: &Array2<f64>) -> f64 {
        (squares(map) / self.pixels).sqrt()
    }
}

/// Returns the sum of the squares of a map.
pub fn squares(map: &Array2<f64>) -> f64 {
    map.iter().map(|v| v * v).sum()
}

/// Returns the sum of the products of two maps of the same shape.
pub fn product(a: &Array2<f64>, b: &Array2<f64>) -> f64 {
    Zip::from(a).and(b).fold(0.0, |sum, a, b| sum + a * b)
}

/// The tool on a lattice of places that divides the pixels: K of the module above, by FFT.
///
/// A tool that ends in a step removes less immediately beside a place than at it, because a row of pixels at its edge
/// drops out. Such a tool has its limits for places beside those of the lattice, too. No pixel drops out at the upper
/// edge of a tool that ends between two nodes: its last node is inside, where the tool is continuous.
pub struct LatticeTool {
    /// The tool at the places of the lattice, then its limits beside them.
    pub limits: Vec<Limit>,
    /// Number of places for each pixel along [x, y].
    pub parts: [usize; 2],
    /// Length of the flanks along [x, y], in pixels.
    pub flanks: [f64; 2],
}

/// The tool at the places of the lattice, or its limit for places beside them.
pub struct Limit {
    /// Rates (ky, kx) at the offsets of the lattice, nm/s.
    pub samples: Array2<f64>,
    convolution: Convolution,
}

/// A place (row, column) of the lattice, and the number of a limit there.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Place {
    pub index: (usize, usize),
    pub limit: usize,
}

impl LatticeTool {
    /// Makes the tool on a map on `grid`, with places at most `pitch` times the flanks of the tool apart.
    pub fn new(tif: &Tif, grid: &Grid, pitch: f64) -> Self {
        let flanks_mm = flanks_mm(tif);
        let axes = [(0, &grid.x, &tif.grid().x), (1, &grid.y, &tif.grid().y)];
        let flanks = axes.map(|(axis, map, _)| flanks_mm[axis] / map.step_mm());
        // Nodes of the lattice for each step of the TIF: every sample of it is at a node, whatever the rounding.
        let nodes = axes.map(|(axis, _, samples)| {
            (samples.step_mm() / (pitch * flanks_mm[axis])).ceil().max(1.0)
        });
        let parts = axes.map(|(axis, map, samples)| {
            ((map.step_mm() / samples.step_mm()).round() * nodes[axis]) as usize
        });
        let [(x, ends_x), (y, ends_y)] = axes.map(|(axis, _, samples)| {
            let step_mm = samples.step_mm() / nodes[axis];
            let edge_mm = tif.edge_mm()[axis];
            let steps = (edge_mm - samples.start_mm()) / step_mm;
            let last = (steps + 1e-6).floor();
            let at_mm = |k| (samples.start_mm() + k as f64 * step_mm).min(edge_mm);
            let at_mm: Vec<f64> = (0..=last as usize).map(at_mm).collect();
            (at_mm, if steps < last + 1e-6 { 0..3 } else { 0..2 })
        });
        let all = Array2::from_shape_fn((y.len(), x.len()), |(r, c)| tif.rate_at(x[c], y[r]));
        let is_step = tif.border_to_peak() > SMALL_STEP;
        let [ends_x, ends_y] = if is_step { [ends_x, ends_y] } else { [0..1, 0..1] };
        let ends = ends_y.flat_map(|y| ends_x.clone().map(move |x| (y, x)));
        let limits = ends.map(|(end_y, end_x)| {
            let mut samples = all.clone();
            match end_x {
                1 => samples.column_mut(0).fill(0.0),
                2 => samples.column_mut(x.len() - 1).fill(0.0),
                _ => {}
            }
            match end_y {
                1 => samples.row_mut(0).fill(0.0),
                2 => samples.row_mut(y.len() - 1).fill(0.0),
                _ => {}
            }
            let shape = places(grid.shape(), parts, &samples);
            Limit { convolution: Convolution::new(samples.view(), shape), samples }
        });
        Self { limits: limits.collect(), parts, flanks }
    }

    /// Returns the rates (ky, kx) of the tool at the places of the lattice, nm/s.
    pub fn samples(&self) -> &Array2<f64> {
        &self.limits[0].samples
    }

    /// Returns the number of places, at least 1, along [x, y] in this fraction of the flanks.
    pub fn apart(&self, fraction: f64) -> [usize; 2] {
        [0, 1]
            .map(|axis| ((fraction * self.flanks[axis] * self.parts[axis] as f64) as usize).max(1))
    }

    /// Returns the number of places along y and along x.
    pub fn places(&self, part: &PartPixels) -> (usize, usize) {
        places(part.valid.dim(), self.parts, self.samples())
    }

    /// Returns the pixels (ny, nx) of a map on the lattice that begins with the places.
    pub fn pixels_of<'a>(
        &self,
        lattice: &'a mut Array2<f64>,
        part: &PartPixels,
    ) -> ArrayViewMut2<'a, f64> {
        let (ny, nx) = part.valid.dim();
        let [px, py] = self.parts;
        let (ky, kx) = self.samples().dim();
        let [rows, columns] = [ky - 1..ky + (ny - 1) * py, kx - 1..kx + (nx - 1) * px];
        lattice.slice_mut(s![rows; py, columns; px])
    }

    /// Returns the removal (ny, nx), nm, by the dwell times at all places, s, of every limit.
    pub fn removal_nm(&self, dwell_s: &[Array2<f64>]) -> Array2<f64> {
        let [px, py] = self.parts;
        let removals = self.limits.iter().zip(dwell_s).map(|(limit, dwell_s)| {
            limit.convolution.valid(dwell_s.view()).slice(s![..;py, ..;px]).to_owned()
        });
        removals.reduce(|sum, removal| sum + removal).expect("a tool has limits")
    }

    /// Returns the tool at a place, on the valid pixels of the part.
    pub fn window_at(&self, place: Place, part: &PartPixels) -> Window {
        let (ny, nx) = part.desired_nm.dim();
        let [px, py] = self.parts;
        let Place { index: (row, column), limit } = place;
        let samples = &self.limits[limit].samples;
        let (ky, kx) = samples.dim();
        let [rows, columns] = [pixels(row, ky, py, ny), pixels(column, kx, px, nx)];
        // Pixel i is at the node i * parts, and the sample there is i * parts + k - 1 - place.
        let rates = Array2::from_shape_fn((rows.len(), columns.len()), |(r, c)| {
            let [i, j] = [rows.start + r, columns.start + c];
            part.valid[[i, j]] * samples[[i * py + ky - 1 - row, j * px + kx - 1 - column]]
        });
        Window { origin: (rows.start, columns.start), rates }
    }

    /// Returns the adjoint product of a limit of the tool with a map (ny, nx), at all places.
    pub fn adjoint(&self, map: &Array2<f64>, limit: usize) -> Array2<f64> {
        self.limits[limit].convolution.adjoint(upsampled(map, self.parts).view())
    }

    /// Returns the adjoint products of all limits.
    pub fn adjoints(&self, map: &Array2<f64>) -> Vec<Array2<f64>> {
        (0..self.limits.len()).map(|limit| self.adjoint(map, limit)).collect()
    }
}

/// The tool at one place, on the pixels that it reaches.
pub struct Window {
    /// First pixel (row, column).
    pub origin: (usize, usize),
    /// Rates on the valid pixels, nm/s; 0 on the others.
    pub rates: Array2<f64>,
}

/// Returns the pixels that the tool reaches along an axis of n pixels from `place`, with k samples and `parts` of them
/// for each pixel.
fn pixels(place: usize, k: usize, parts: usize, n: usize) -> Range<usize> {
    let start = (place + 1).saturating_sub(k).div_ceil(parts);
    let end = (place / parts + 1).min(n);
    start.min(end)..end
}

/// Returns the number of places (rows, columns) from which the tool reaches a map of the shape `shape`.
fn places(shape: (usize, usize), [px, py]: [usize; 2], samples: &Array2<f64>) -> (usize, usize) {
    ((shape.0 - 1) * py + samples.nrows(), (shape.1 - 1) * px + samples.ncols())
}

#[cfg(test)]
mod tests {
    use planish_types::Axis;

    use super::*;

    /// The last column counted as one that drops out beside a place also where the tool ends between two nodes. Such
    /// dwell times remove what no tool removes: they left 1.4 % less than the best ones.
    #[test]
    fn every_limit_is_the_tool_immediately_beside_the_places() {
        let axis = Axis::new(0.3, 0.6, 7).unwrap();
        let samples = Grid { x: axis, y: axis };
        let rate =
            Array2::from_shape_fn(samples.shape(), |(r, c)| 3.0 + ((2 * r + c) as f64).sin());
        let axis = Axis::new(0.0, 1.0, 5).unwrap();
        let map = Grid { x: axis, y: axis };
        let measured = Tif::new(samples, rate).unwrap();
        let tif = measured.on_lattice_of(&map, 1e-4).unwrap().tif;
        let tool = LatticeTool::new(&tif, &map, 0.5);
        // No slope of the tool is above 100 nm/s/mm: it changes by less than 1e-5 nm/s in the shift.
        let shifts = [0.0, 1e-7, -1e-7];
        for limit in &tool.limits {
            let differences = shifts.iter().flat_map(|y| shifts.iter().map(move |x| (x, y)));
            let differences = differences.map(|(x, y)| {
                let steps = [0, 1]
                    .map(|axis| [map.x.step_mm(), map.y.step_mm()][axis] / tool.parts[axis] as f64);
                let start = [tif.grid().x.start_mm(), tif.grid().y.start_mm()];
                let differences = limit.samples.indexed_iter().map(|((r, c), rate)| {
                    let dx = start[0] + c as f64 * steps[0] + x;
                    let dy = start[1] + r as f64 * steps[1] + y;
                    (rate - tif.rate_at(dx, dy)).abs()
                });
                differences.fold(0.0, f64::max)
            });
            let least = differences.fold(f64::INFINITY, f64::min);
            assert!(least < 1e-5, "{least} nm/s from the tool at all places beside");
        }
    }
}
