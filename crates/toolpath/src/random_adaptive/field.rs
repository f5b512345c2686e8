//! The region of the path on a lattice of cells, and the spacing that the density law asks for.
//!
//! ```text
//! region     cells whose centre is within max(o, p/2, h/2) of a valid pixel's centre, in x and in
//!            y; gaps of at most 4 cells (4p/3) are closed
//! r          (G * z) / (G * 1) over the valid pixels, G a Gaussian of 2p; less its minimum where
//!            that is negative; beyond the valid pixels the nearest value
//! rho        (clamp(r, mean r / 4, 4 mean r) / mean r)^b,     4^-b <= rho <= 4^b
//! d          p / sqrt(rho), lowered until |grad d| <= 1/8 and d <= sqrt(area of the island) / 4
//! ```
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | z | `height_nm` | (ny, nx) | nm |
//! | r | `removal` | cells | nm |
//! | b | `contrast` | - | 1 |
//! | d | `spacing_mm` | cells | mm |
//! | o, p, h | `overscan_mm`, `pitch_mm`, pixel | - | mm |

use std::{collections::VecDeque, ops::Range};

use ndarray::Array2;
use planish_types::{Axis, Grid, Invalid, Surface};

use super::{EDGE_PER_SPACING, RandomAdaptiveSettings};

/// Number of cells per pitch. Larger: more memory, and a border that follows the aperture more closely. Smaller: a
/// coarser border.
const CELLS_PER_PITCH: f64 = 3.0;
/// Half the largest width of the gaps in the region that are closed, in cells. Larger: wider holes and slits are
/// closed. Smaller: the path is divided at narrow gaps.
const CLOSING_CELLS: usize = 2;
/// Number of cells around the region, so that closing and its border stay within the lattice: one more than
/// [`CLOSING_CELLS`].
const MARGIN_CELLS: usize = CLOSING_CELLS + 1;
/// Largest number of cells of a lattice (about 1 GB); more are refused. Larger: more memory. Smaller: fine pitches on
/// large parts are refused.
const MAX_CELLS: f64 = 3e7;
/// Smallest r / mean r in the density law, dimensionless; together with [`HIGHEST_RATIO`] it limits the ratio of the
/// largest to the smallest spacing to 4. Larger: less contrast. Smaller: a coarser path where little is removed.
pub(super) const LOWEST_RATIO: f64 = 0.25;
/// Largest r / mean r in the density law, dimensionless. Larger: a finer path where much is removed. Smaller: less
/// contrast.
pub(super) const HIGHEST_RATIO: f64 = 4.0;
/// Largest slope of the spacing, mm per mm: 1/8. Mesh edges then change by 0.3 mm per mm, so that neighbouring
/// triangles differ by a third at most. Larger: thinner triangles. Smaller: the spacing follows the removal less.
const MAX_SLOPE: f64 = 0.3 / EDGE_PER_SPACING;

/// Island number of the cells outside the region.
const OUTSIDE: u32 = u32::MAX;

/// Square cells over the region, with sides of about a third of the pitch p; row by row from the smallest y.
pub(super) struct Field {
    low_mm: [f64; 2],
    pub(super) side_mm: [f64; 2],
    pub(super) count: [usize; 2],
    /// Number of the island (4-connected part of the region) of each cell, or [`OUTSIDE`].
    island: Vec<u32>,
    pub(super) island_area_mm2: Vec<f64>,
    /// True for the cells within [`CLOSING_CELLS`] of the region.
    near: Vec<bool>,
    /// True for the cells whose nearest pixel of the map is valid.
    aperture: Vec<bool>,
    spacing_mm: Vec<f64>,
}

impl Field {
    pub(super) fn new(
        surface: &Surface,
        settings: &RandomAdaptiveSettings,
    ) -> Result<Self, Invalid> {
        let mut field = Self::region(surface, settings)?;
        let rho = field.density(surface, settings);
        // d = p / sqrt(rho)
        let p = settings.pitch_mm;
        for (k, d) in field.spacing_mm.iter_mut().enumerate() {
            let area = field.island_area_mm2.get(field.island[k] as usize);
            let cap = area.map_or(f64::INFINITY, |a| 0.25 * a.sqrt());
            *d = (p / rho[k].sqrt()).min(cap);
        }
        field.limit_slope();
        Ok(field)
    }

    fn region(surface: &Surface, settings: &RandomAdaptiveSettings) -> Result<Self, Invalid> {
        let grid = surface.grid();
        let map = surface.height_nm();
        let p = settings.pitch_mm;
        let axes = [&grid.x, &grid.y];
        let reach = axes.map(|a| settings.overscan_mm.max(0.5 * p).max(0.5 * a.step_mm()));

        // Extent of the valid pixels, overscan included, a whole number of cells.
        let mut ends = [[usize::MAX, 0]; 2];
        for ((r, c), _) in map.indexed_iter().filter(|(_, z)| !z.is_nan()) {
            for (end, i) in ends.iter_mut().zip([c, r]) {
                *end = [end[0].min(i), end[1].max(i)];
            }
        }
        let extent =
            [0, 1].map(|a| axes[a].coordinate_mm(ends[a][1]) - axes[a].coordinate_mm(ends[a][0]));
        let whole = [0, 1].map(|a| extent[a] + 2.0 * reach[a]);
        let cells = whole.map(|w| (w * CELLS_PER_PITCH / p - 1e-9).ceil().max(1.0));
        let total = cells[0] * cells[1];
        if total.is_nan() || total > MAX_CELLS {
            return Err(Invalid::whole(
                "pitch_mm",
                format!(
                    "{p} over {:.6} x {:.6} mm is too fine for this method",
                    whole[0], whole[1]
                ),
                "check the units, or give a larger pitch",
            ));
        }
        let side_mm = [0, 1].map(|a| whole[a] / cells[a]);
        let count = cells.map(|n| n as usize + 2 * MARGIN_CELLS);
        let low_mm = [0, 1].map(|a| {
            axes[a].coordinate_mm(ends[a][0]) - reach[a] - MARGIN_CELLS as f64 * side_mm[a]
        });
        let mut field = Self {
            low_mm,
            side_mm,
            count,
            island: Vec::new(),
            island_area_mm2: Vec::new(),
            near: Vec::new(),
            aperture: Vec::new(),
            spacing_mm: vec![0.0; count[0] * count[1]],
        };

        let valid = ValidCounts::new(map);
        let inside = close(field.cells_near_valid(&valid, grid, reach), count);
        let half_pixel = axes.map(|a| 0.5 * a.step_mm());
        field.aperture = field.cells_near_valid(&valid, grid, half_pixel);
        field.label(&inside);
        field.near = spread(inside, count, true);
        Ok(field)
    }
    /// Returns true for each cell that has the centre of a valid pixel within `reach`, mm, along x and along y.
    fn cells_near_valid(&self, valid: &ValidCounts, grid: &Grid, reach: [f64; 2]) -> Vec<bool> {
        let [columns, rows] = [0, 1].map(|a| -> Vec<Range<usize>> {
            let centres = (0..self.count[a]).map(|i| self.centre_along(a, i));
            centres.map(|centre| within([&grid.x, &grid.y][a], centre, reach[a])).collect()
        });
        rows.iter().flat_map(|r| columns.iter().map(|c| valid.any(r, c))).collect()
    }

    /// Numbers the islands (4-connected parts) of the cells where `inside` is true, and computes their areas.
    fn label(&mut self, inside: &[bool]) {
        let [nx, _] = self.count;
        self.island = vec![OUTSIDE; inside.len()];
        let mut queue = VecDeque::new();
        for start in 0..inside.len() {
            if !inside[start] || self.island[start] != OUTSIDE {
                continue;
            }
            let number = self.island_area_mm2.len() as u32;
            self.island[start] = number;
            queue.push_back(start);
            let mut cells = 0;
            while let Some(k) = queue.pop_front() {
                cells += 1;
                // The margin keeps every neighbour in the lattice.
                for next in [k - 1, k + 1, k - nx, k + nx] {
                    if inside[next] && self.island[next] == OUTSIDE {
                        self.island[next] = number;
                        queue.push_back(next);
                    }
                }
            }
            self.island_area_mm2.push(f64::from(cells) * self.side_mm[0] * self.side_mm[1]);
        }
    }

    /// Returns the density (rho of the module) of every cell, dimensionless; 1 everywhere if the removal is constant 0
    /// or no cell lies in the aperture.
    fn density(&self, surface: &Surface, settings: &RandomAdaptiveSettings) -> Vec<f64> {
        let grid = surface.grid();
        let map = surface.height_nm();
        let mut weighted = vec![0.0; self.island.len()];
        let mut weight = weighted.clone();
        for ((r, c), z) in map.indexed_iter().filter(|(_, z)| !z.is_nan()) {
            let k = self
                .cell([grid.x.coordinate_mm(c), grid.y.coordinate_mm(r)])
                .expect("pixels are in the lattice");
            weighted[k] += z;
            weight[k] += 1.0;
        }
        // r = (G * z) / (G * 1): a pixel that is wider than the cells is smoothed over itself.
        let step = [grid.x.step_mm(), grid.y.step_mm()];
        for a in [0, 1] {
            let sigma = (2.0 * settings.pitch_mm).max(step[a]) / self.side_mm[a];
            smooth(&mut weighted, self.count, a, sigma);
            smooth(&mut weight, self.count, a, sigma);
        }
        weighted.iter_mut().zip(&weight).for_each(|(z, w)| *z /= w);
        let removal = weighted;
        let cells: Vec<usize> =
            (0..weight.len()).filter(|k| self.aperture[*k] && weight[*k] > 0.0).collect();
        let lowest = cells.iter().map(|k| removal[*k]).fold(0.0, f64::min);
        let mean = cells.iter().map(|k| removal[*k] - lowest).sum::<f64>() / cells.len() as f64;
        if cells.is_empty() || mean <= 0.0 {
            return vec![1.0; weight.len()];
        }
        // rho = (clamp(r, mean r / 4, 4 mean r) / mean r)^b
        let rho = self.nearest(&cells).into_iter().map(|k| {
            let ratio = (removal[k] - lowest) / mean;
            ratio.clamp(LOWEST_RATIO, HIGHEST_RATIO).powf(settings.contrast)
        });
        rho.collect()
    }

    /// Returns, for every cell, about the nearest of the cells `sources`, by two sweeps in which cells take over the
    /// nearest of their neighbours.
    fn nearest(&self, sources: &[usize]) -> Vec<usize> {
        let [nx, ny] = self.count;
        let mut best = vec![usize::MAX; nx * ny];
        sources.iter().for_each(|k| best[*k] = *k);
        let distance = |k: usize, source: usize| {
            let x = (k % nx).abs_diff(source % nx) as f64 * self.side_mm[0];
            x.hypot((k / nx).abs_diff(source / nx) as f64 * self.side_mm[1])
        };
        self.sweep(|k, neighbour| {
            let offer = best[neighbour];
            let closer = offer != usize::MAX
                && (best[k] == usize::MAX || distance(k, offer) < distance(k, best[k]));
            if closer {
                best[k] = offer;
            }
        });
        best
    }

    /// Lowers the spacing until it changes by at most [`MAX_SLOPE`] times the distance between cells: d(x) <= d(y) +
    /// slope |x - y|, along the eight directions of the lattice.
    fn limit_slope(&mut self) {
        let mut d = std::mem::take(&mut self.spacing_mm);
        let [nx, _] = self.count;
        let [sx, sy] = self.side_mm;
        let length = [[0.0, sx], [sy, sx.hypot(sy)]];
        self.sweep(|k, n| {
            let away = length[(k / nx).abs_diff(n / nx)][(k % nx).abs_diff(n % nx)];
            d[k] = d[k].min(d[n] + MAX_SLOPE * away);
        });
        self.spacing_mm = d;
    }

    /// Calls `update(cell, neighbour)` for all cells: forwards with the four neighbours before the cell, then backwards
    /// with the four after it.
    fn sweep(&self, mut update: impl FnMut(usize, usize)) {
        let [nx, ny] = self.count;
        for j in 0..ny {
            for i in (0..nx).chain((0..nx).rev()) {
                self.neighbours_before([i, j], 1).for_each(|n| update(j * nx + i, n));
            }
        }
        for j in (0..ny).rev() {
            for i in (0..nx).rev().chain(0..nx) {
                self.neighbours_before([i, j], -1).for_each(|n| update(j * nx + i, n));
            }
        }
    }
    /// Returns the four neighbours before the cell (i, j) in row order, or with the sign -1 the four after it; those
    /// beyond the lattice are left out.
    fn neighbours_before(&self, cell: [usize; 2], sign: isize) -> impl Iterator<Item = usize> {
        let [nx, ny] = self.count;
        let [i, j] = cell.map(|v| v as isize);
        let steps = [(-1, 0), (-1, -1), (0, -1), (1, -1)].into_iter();
        let neighbours = steps.map(move |(di, dj)| (i + sign * di, j + sign * dj));
        neighbours
            .filter(move |(i, j)| (0..nx as isize).contains(i) && (0..ny as isize).contains(j))
            .map(move |(i, j)| j as usize * nx + i as usize)
    }

    fn centre_along(&self, a: usize, i: usize) -> f64 {
        self.low_mm[a] + (i as f64 + 0.5) * self.side_mm[a]
    }

    /// Returns the point of the lattice corner with the index (i, j), mm.
    pub(super) fn corner(&self, index: [usize; 2]) -> [f64; 2] {
        [0, 1].map(|a| self.low_mm[a] + index[a] as f64 * self.side_mm[a])
    }

    /// Returns the centre of cell k, mm.
    pub(super) fn centre(&self, k: usize) -> [f64; 2] {
        [self.centre_along(0, k % self.count[0]), self.centre_along(1, k / self.count[0])]
    }

    fn cell(&self, p: [f64; 2]) -> Option<usize> {
        let i = [0, 1].map(|a| ((p[a] - self.low_mm[a]) / self.side_mm[a]).floor());
        let is_inside = (0..2).all(|a| i[a] >= 0.0 && i[a] < self.count[a] as f64);
        if is_inside { Some(i[1] as usize * self.count[0] + i[0] as usize) } else { None }
    }

    /// Returns the number of the island (connected part of the region) at the point `p`, mm; `None` outside the region.
    pub(super) fn island(&self, p: [f64; 2]) -> Option<usize> {
        self.island_of_cell(self.cell(p)?)
    }

    /// Returns true if the step from `a` to `b` goes more than [`CLOSING_CELLS`] beyond the region.
    pub(super) fn leaves(&self, a: [f64; 2], b: [f64; 2]) -> bool {
        let cells = [0, 1].map(|x| ((b[x] - a[x]) / self.side_mm[x]).abs());
        let parts = cells[0].max(cells[1]).ceil().max(1.0);
        (0..=parts as usize).any(|k| {
            let f = k as f64 / parts;
            let cell = self.cell([0, 1].map(|x| a[x] + f * (b[x] - a[x])));
            cell.is_none_or(|k| !self.near[k])
        })
    }

    /// Returns the number of the island of cell `k`; `None` outside the region.
    pub(super) fn island_of_cell(&self, k: usize) -> Option<usize> {
        if self.island[k] == OUTSIDE { None } else { Some(self.island[k] as usize) }
    }

    /// Returns true if `p` is in the clear aperture: its cell's nearest pixel is valid.
    pub(super) fn in_aperture(&self, p: [f64; 2]) -> bool {
        self.cell(p).is_some_and(|k| self.aperture[k])
    }

    /// Returns the size of the lattice along x and y, mm.
    pub(super) fn extent_mm(&self) -> [f64; 2] {
        [0, 1].map(|a| self.count[a] as f64 * self.side_mm[a])
    }

    /// Returns the area of the cells of the lattice whose centre lies in the clear aperture, mm^2.
    pub(super) fn aperture_mm2(&self) -> f64 {
        let cells = self.aperture.iter().filter(|a| **a).count();
        cells as f64 * self.side_mm[0] * self.side_mm[1]
    }

    /// Returns the mean of 1/d (d: spacing) over the clear aperture, 1/mm. If no centre of a cell lies in the aperture,
    /// it is the mean over the region.
    pub(super) fn mean_inverse_spacing(&self) -> f64 {
        let none = !self.aperture.contains(&true);
        let cells = (0..self.aperture.len())
            .filter(|k| if none { self.island[*k] != OUTSIDE } else { self.aperture[*k] });
        let (sum, count) = cells
            .map(|k| 1.0 / self.spacing_mm[k])
            .fold((0.0, 0_usize), |(sum, count), inverse| (sum + inverse, count + 1));
        sum / count.max(1) as f64
    }

    /// Returns the indices of the cells of the region.
    pub(super) fn cells(&self) -> impl Iterator<Item = usize> + '_ {
        (0..self.island.len()).filter(|k| self.island[*k] != OUTSIDE)
    }

    /// Returns the spacing d at `p`, mm; beyond the lattice that of its nearest cell.
    pub(super) fn spacing_mm(&self, p: [f64; 2]) -> f64 {
        let i = [0, 1].map(|a| {
            let i = ((p[a] - self.low_mm[a]) / self.side_mm[a]).floor();
            i.clamp(0.0, (self.count[a] - 1) as f64) as usize
        });
        self.spacing_mm[i[1] * self.count[0] + i[0]]
    }
}

/// Cumulative numbers of valid pixels, from which the number in a rectangle of the map follows.
struct ValidCounts {
    /// Number of valid pixels in the rows before r and the columns before c, shape (ny+1, nx+1).
    before: Array2<u32>,
}

impl ValidCounts {
    fn new(map: &Array2<f64>) -> Self {
        let (ny, nx) = map.dim();
        let mut before = Array2::zeros((ny + 1, nx + 1));
        for ((r, c), z) in map.indexed_iter() {
            before[[r + 1, c + 1]] =
                u32::from(!z.is_nan()) + before[[r + 1, c]] + before[[r, c + 1]] - before[[r, c]];
        }
        Self { before }
    }

    /// Returns true if a pixel of the rectangle (`rows`, `columns`) is valid.
    fn any(&self, rows: &Range<usize>, columns: &Range<usize>) -> bool {
        self.before[[rows.end, columns.end]] + self.before[[rows.start, columns.start]]
            > self.before[[rows.start, columns.end]] + self.before[[rows.end, columns.start]]
    }
}

/// Returns the indices of the pixels of `axis` whose centres are within `reach` of `x`, both in mm.
fn within(axis: &Axis, x: f64, reach: f64) -> Range<usize> {
    let [low, high] = [x - reach, x + reach]
        .map(|v| ((v - axis.start_mm()) / axis.step_mm()).clamp(-1.0, axis.len() as f64));
    // A pixel that rounding puts 1e-9 of a step too far is within.
    let first = (low - 1e-9).ceil().max(0.0) as usize;
    let end = ((high + 1e-9).floor() + 1.0).max(0.0) as usize;
    first..end.min(axis.len()).max(first)
}

/// Closes narrow gaps of the mask: dilation by a square, then erosion by the same.
fn close(mask: Vec<bool>, count: [usize; 2]) -> Vec<bool> {
    spread(spread(mask, count, true), count, false)
}

/// Spreads the cells of the mask with the value `value` by [`CLOSING_CELLS`] in each direction. `count` is the number
/// of cells [along x, along y].
fn spread(mut mask: Vec<bool>, count: [usize; 2], value: bool) -> Vec<bool> {
    for a in [0, 1] {
        let before = mask.clone();
        let stride = if a == 0 { 1 } else { count[0] };
        for k in 0..mask.len() {
            let i = k / stride % count[a];
            let low = k - stride * i.min(CLOSING_CELLS);
            let high = k + stride * (count[a] - 1 - i).min(CLOSING_CELLS);
            mask[k] = (low..=high).step_by(stride).any(|m| before[m] == value) == value;
        }
    }
    mask
}

/// Convolves the cells along one axis (0: x, 1: y) with a Gaussian of the standard deviation `sigma` cells, cut off at
/// 4 sigma.
fn smooth(values: &mut Vec<f64>, count: [usize; 2], axis: usize, sigma: f64) {
    let reach = (4.0 * sigma).ceil() as usize;
    let taps: Vec<f64> = (0..=reach).map(|d| (-0.5 * (d as f64 / sigma).powi(2)).exp()).collect();
    let stride = if axis == 0 { 1 } else { count[0] };
    let n = count[axis];
    let mut out = vec![0.0; values.len()];
    for (k, sum) in out.iter_mut().enumerate() {
        let i = k / stride % n;
        for m in i.saturating_sub(reach)..(i + reach + 1).min(n) {
            *sum += taps[m.abs_diff(i)] * values[k - i * stride + m * stride];
        }
    }
    *values = out;
}
