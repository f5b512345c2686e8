//! The lattice on which dwell times are spread: the nodes of the map, continued by the reach of the TIF. A *step* here
//! is the distance of two nodes; a *cell* is the interval between them.

use ndarray::{Array2, Axis as NdAxis, s};
use planish_numerics::{
    bspline, keys,
    linear::tridiagonal::{self, TridiagonalRow},
};
use planish_types::{Grid, Tif};

use crate::model::columns::ToolPlace;

/// Difference of the pitches of TIF and lattice, accumulated over all samples of the TIF, in steps, up to which they
/// count as the same. The same pitch may be rounded differently in two files. Larger: the removal shifts by up to that
/// many steps. Smaller: rounded pitches cost the time of another lattice.
const SAME_PITCH: f64 = 1e-4;

/// Choice of the weights with which the dwell time of a tool between nodes is spread on four of them along an axis. It
/// also sets the kernel with which the spread times are convolved.
#[derive(Clone, Copy, PartialEq)]
pub enum Spread {
    /// Keys' weights. The kernel is the samples of the TIF with ghost nodes.
    Keys,
    /// Cubic B-splines. The kernel is the coefficients of the spline through the samples, which is 0 beyond them. It
    /// serves samples that are too few for Keys' weights: at a fifth of the sampling frequency, these lose 3 % of the
    /// amplitude and add an alias of 3 %, splines 0.4 %.
    Splines,
}

/// One axis of the lattice: nodes i of the map (called pixels), and samples j = -1 ..= last of the TIF, of which -1 and
/// the last one or two are ghost nodes beyond its edges.
#[derive(Clone, Copy)]
pub struct Lattice {
    start_mm: f64,
    pub step_mm: f64,
    pub pixels: usize,
    tif_start_mm: f64,
    tif_end_mm: f64,
    /// True if the samples of the TIF have the pitch of the lattice.
    pub own: bool,
    /// Upper edge of the TIF, counted from the lower one, in steps of the lattice.
    pub edge: f64,
    /// Index of the last sample of the TIF, a ghost node beyond the upper edge.
    pub last: isize,
    spread: Spread,
}

impl Lattice {
    /// Makes the lattice along x (`axis` 0) or y (1) with the nodes of `map` and a TIF.
    pub fn new(map: &Grid, tif: &Tif, axis: usize, spread: Spread) -> Self {
        let map = [&map.x, &map.y][axis];
        let samples = [&tif.grid().x, &tif.grid().y][axis];
        let end_mm = tif.edge_mm()[axis];
        let steps = (samples.len() - 1) as f64;
        let own = (map.step_mm() / samples.step_mm() - 1.0).abs() * steps <= SAME_PITCH;
        let edge = if own {
            steps + (end_mm - samples.end_mm()) / samples.step_mm()
        } else {
            (end_mm - samples.start_mm()) / map.step_mm()
        };
        let (whole, fraction) = keys::split(edge);
        Self {
            start_mm: map.start_mm(),
            step_mm: map.step_mm(),
            pixels: map.len(),
            tif_start_mm: samples.start_mm(),
            tif_end_mm: end_mm,
            own,
            edge,
            last: whole + if fraction > 0.0 { 2 } else { 1 },
            spread,
        }
    }

    /// Returns the weights of the nodes -1 ..= 2 for a tool at the offset f, in steps, from node 0.
    #[inline]
    pub fn weights(&self, f: f64) -> [f64; 4] {
        match self.spread {
            Spread::Keys => keys::weights(f),
            Spread::Splines => bspline::on_a_cell(f),
        }
    }

    /// Returns the offset of sample j of the TIF from the tool along the axis, mm; at most the end of the TIF.
    pub fn offset_mm(&self, j: usize) -> f64 {
        (self.tif_start_mm + j as f64 * self.step_mm).min(self.tif_end_mm)
    }

    /// Returns the number of samples of the TIF along the axis, with ghost nodes.
    pub fn kernel(&self) -> usize {
        self.last as usize + 2
    }

    /// Returns the number of nodes (sources) from which the TIF reaches a pixel: -last ..= pixels.
    pub fn sources(&self) -> usize {
        self.pixels + self.last as usize + 1
    }

    /// Returns the cell that contains the first sample of the TIF for a tool at the coordinate p, mm, and the offset of
    /// the sample in the cell, in steps (0 .. 1). The cell has the index of its lower node; pixel 0 has the index 0.
    /// `None` if the TIF is more than two steps away from the map.
    pub fn place(&self, p: f64) -> Option<(i32, f64)> {
        let (cell, f) = keys::split((p + self.tif_start_mm - self.start_mm) / self.step_mm);
        let reaches = cell >= -self.last - 2 && cell <= self.pixels as isize + 1;
        if reaches { Some((cell as i32, f)) } else { None }
    }

    /// Returns two pixel offsets k from the cell of a tool at the offset f, steps. Pixels up to the first offset and
    /// from the second one on are beyond the TIF: there k - f lies outside [0, edge].
    pub fn spills(&self, f: f64) -> [isize; 2] {
        let low = if f > 0.0 { 0 } else { -1 };
        let (whole, _) = keys::split(self.edge + f);
        [low, whole + 1]
    }
}

/// A place of the tool on the lattice: cell and offset of [`Lattice::place`], fraction of the dwell time, and index of
/// the column. Pairs are [across, along] the lines of the lattice that are processed.
#[derive(Clone, Copy)]
pub struct Placed {
    pub cell: [i32; 2],
    pub offset: [f64; 2],
    pub fraction: f64,
    pub column: u32,
}
impl Placed {
    /// Returns the same place with the two axes swapped.
    pub fn swapped(&self) -> Self {
        let [cell_across, cell_along] = self.cell;
        let [across, along] = self.offset;
        Self { cell: [cell_along, cell_across], offset: [along, across], ..*self }
    }
}

/// Returns the places of all columns from which the tool reaches the map, in the order of the columns; their pairs are
/// [y, x].
pub fn placed(places: &[Vec<ToolPlace>], x: &Lattice, y: &Lattice) -> Vec<Placed> {
    let mut placed = Vec::new();
    for (j, places) in places.iter().enumerate() {
        for ToolPlace { position_mm: p, fraction, .. } in places {
            if let (Some((cy, fy)), Some((cx, fx))) = (y.place(p[1]), x.place(p[0])) {
                let fraction = *fraction;
                placed.push(Placed {
                    cell: [cy, cx],
                    offset: [fy, fx],
                    fraction,
                    column: j as u32,
                });
            }
        }
    }
    placed
}

/// Sets the ghost nodes, the outermost samples, to zero.
pub fn without_ghosts(mut samples: Array2<f64>) -> Array2<f64> {
    let (my, mx) = samples.dim();
    samples.slice_mut(s![..;my - 1, ..]).fill(0.0);
    samples.slice_mut(s![.., ..;mx - 1]).fill(0.0);
    samples
}

/// Returns the kernel with which the spread dwell times are convolved, from the samples of the TIF.
pub fn kernel(samples: &Array2<f64>, spread: Spread) -> Array2<f64> {
    let mut kernel = samples.clone();
    if spread == Spread::Keys {
        return kernel;
    }
    // c_{j-1} / 6 + 4 c_j / 6 + c_{j+1} / 6 = R_j along one axis, then along the other
    for axis in [0, 1] {
        for mut line in kernel.lanes_mut(NdAxis(axis)) {
            let coefficients = tridiagonal::solve(line.len(), |j| TridiagonalRow {
                elements: [1.0 / 6.0, 4.0 / 6.0, 1.0 / 6.0],
                right: line[j],
            });
            line.iter_mut().zip(coefficients).for_each(|(v, c)| *v = c);
        }
    }
    kernel
}

/// Returns the samples of the TIF at the pitch of the lattice (y, x), nm/s, with a ghost node before its lower edge and
/// one or two beyond its upper edge on each axis.
pub fn samples(tif: &Tif, x: &Lattice, y: &Lattice) -> Array2<f64> {
    if x.own && y.own {
        return tif.with_ghosts().clone();
    }
    let [ny, nx] = [y, x].map(|lattice| keys::split(lattice.edge).0 as usize + 1);
    let mut g = keys::with_ghosts(
        Array2::from_shape_fn((ny, nx), |(j, i)| tif.rate_at(x.offset_mm(i), y.offset_mm(j)))
            .view(),
    );
    // An edge between two nodes needs one more beyond it.
    for axis in [NdAxis(0), NdAxis(1)] {
        let lattice = if axis.index() == 0 { y } else { x };
        while g.len_of(axis) < lattice.kernel() {
            let n = g.len_of(axis);
            let next = match n {
                0..=2 => g.index_axis(axis, n - 1).to_owned(),
                _ => {
                    let [a, b, c] = [1, 2, 3].map(|k| g.index_axis(axis, n - k));
                    &a * 3.0 - &(&b * 3.0) + c
                }
            };
            g.push(axis, next.view()).expect("a line of the array");
        }
    }
    g.as_standard_layout().into_owned()
}
