//! A tile of the map: the work of one thread.
//!
//! Its two strips of columns are the real and the imaginary part of every array here. Node 0 of a
//! strip, or of the band of rows, is the first from which the tool reaches it.

use std::ops::Range;

use ndarray::{Array2, ArrayViewMut2, Axis as NdAxis};
use planish_numerics::fft::{Complex64, pair_convolution::LineWorkspace};
use planish_types::Trajectory;
use rayon::prelude::*;

use crate::{
    kernel::{Border, Edge, Kernel, MAX_BORDER},
    quadrature::{Cutter, Piece, Reach, Window},
};

/// Columns of the map that are written together: a cache line.
const COLUMNS: usize = 8;

/// Buffers of a thread.
pub struct Workspace {
    field: Array2<Complex64>,
    cutter: Cutter,
    pieces: Vec<Piece>,
    /// Their cells, to be sorted by.
    cells: Vec<[i64; 2]>,
}

impl Workspace {
    /// For any tile of `kernel`.
    pub fn new(kernel: &Kernel) -> Self {
        Self {
            field: Array2::zeros(kernel.convolution.size()),
            cutter: Cutter::new([kernel.x.cells(), kernel.y.cells()]),
            pieces: Vec::new(),
            cells: Vec::new(),
        }
    }
}

/// Rows and two strips of columns of the map.
pub struct Tile<'a> {
    kernel: &'a Kernel,
    rows: Range<usize>,
    strips: [Range<usize>; 2],
    /// Cells that spread seconds to the tile.
    window: Window,
    /// First node of the rows, and of the columns of each strip.
    first_y: i64,
    first_x: [i64; 2],
}

impl<'a> Tile<'a> {
    /// The tile of `kernel` with these pixels.
    pub fn new(kernel: &'a Kernel, rows: Range<usize>, strips: [Range<usize>; 2]) -> Self {
        let [left, right] = [0, 1].map(|s| kernel.x.window(&strips[s]));
        let y = kernel.y.window(&rows);
        let window = Window {
            low: [left.start, y.start],
            high: [if right.is_empty() { left.end } else { right.end }, y.end],
        };
        let first_y = kernel.y.first_node(&rows);
        let first_x = [0, 1].map(|s| kernel.x.first_node(&strips[s]));
        Self { kernel, rows, strips, window, first_y, first_x }
    }

    /// Adds the removal of the `segments` to `out`, the pixels of the tile; returns the number of
    /// quadrature points. With `alone` its lines are shared among the threads.
    pub fn run(
        &self,
        trajectory: &Trajectory,
        segments: &[Reach],
        mut out: ArrayViewMut2<f64>,
        work: &mut Workspace,
        alone: bool,
    ) -> usize {
        let (points, reached) = self.spread(trajectory, segments, work);
        if !reached {
            return points;
        }
        // R = E - E ly - E lx + E ly lx                                              (2)
        let y = &self.kernel.y;
        let rows = y.nodes_of(&self.rows);
        self.kernel.convolution.convolve(work.field.view_mut(), rows, alone);
        let valid = work.field.outer_iter().skip(y.samples() - 1).step_by(y.subdivision);
        for (mut row, line) in out.outer_iter_mut().zip(valid) {
            self.add_row(
                row.as_slice_mut().expect("in C order"),
                line.as_slice().expect("too"),
                1.0,
            );
        }
        if let Some(border) = &self.kernel.border {
            self.subtract_rows(&border.rows, work, out.view_mut(), alone);
            self.subtract_columns(&border.columns, work, out.view_mut(), alone);
            if let Some(corners) = &border.corners {
                self.add_corners(border, corners, &work.pieces, out);
            }
        }
        points
    }

    /// Spreads the seconds of the motion over `work.field` and keeps the pieces for the border;
    /// the number of quadrature points, and whether there are any pieces.
    fn spread(
        &self,
        trajectory: &Trajectory,
        segments: &[Reach],
        work: &mut Workspace,
    ) -> (usize, bool) {
        let Workspace { field, cutter, pieces, cells } = work;
        let keep = self.kernel.border.is_some();
        let width = field.ncols();
        field.fill(Complex64::default());
        pieces.clear();
        cells.clear();
        let nodes = field.as_slice_mut().expect("in C order");
        let x = self.window.low[0]..self.window.high[0];
        let (mut points, mut reached) = (0, false);
        for reach in segments.iter().filter(|r| r.is_in(0, &x)) {
            cutter.pieces(&trajectory.segment(reach.segment), &self.window, |piece| {
                reached = true;
                points += if self.owns(piece.cell) { piece.points } else { 0 };
                for part in 0..2 {
                    let Some(cx) = self.column(piece, part) else { continue };
                    for (b, seconds) in piece.seconds.iter().enumerate() {
                        let r = self.row(piece) + b as i64 - 1;
                        if r < 0 || r >= (nodes.len() / width) as i64 {
                            continue;
                        }
                        let line = &mut nodes[r as usize * width..][..width];
                        add(line, part, cx, *seconds);
                    }
                }
                if keep {
                    pieces.push(*piece);
                    cells.push(piece.cell);
                }
            });
        }
        (points, reached)
    }

    /// Whether the points of this cell are counted here: in every cell by one tile.
    fn owns(&self, cell: [i64; 2]) -> bool {
        let overlap = [self.kernel.x.samples(), self.kernel.y.samples()].map(|n| n as i64 + 2);
        let first = [self.strips[0].start, self.rows.start];
        (0..2).all(|a| first[a] == 0 || cell[a] >= self.window.low[a] + overlap[a])
    }

    /// Node of the piece's cell along y.
    fn row(&self, piece: &Piece) -> i64 {
        piece.cell[1] - self.first_y
    }

    /// Node of the piece's cell in a strip, if it spreads seconds there.
    fn column(&self, piece: &Piece, part: usize) -> Option<i64> {
        let c = piece.cell[0] - self.first_x[part];
        let nodes = self.kernel.x.nodes_of(&self.strips[part]) as i64;
        (nodes > 0 && c >= -2 && c <= nodes).then_some(c)
    }

    /// Adds `sign` times the valid part of a convolved line to a row of the tile.
    fn add_row(&self, row: &mut [f64], line: &[Complex64], sign: f64) {
        let x = &self.kernel.x;
        let (left, right) = row.split_at_mut(self.strips[0].len());
        let valid = &line[x.samples() - 1..];
        if x.subdivision == 1 {
            left.iter_mut().zip(valid).for_each(|(o, v)| *o += sign * v.re);
            right.iter_mut().zip(valid).for_each(|(o, v)| *o += sign * v.im);
        } else {
            let valid = valid.iter().step_by(x.subdivision);
            left.iter_mut().zip(valid.clone()).for_each(|(o, v)| *o += sign * v.re);
            right.iter_mut().zip(valid).for_each(|(o, v)| *o += sign * v.im);
        }
    }

    /// Subtracts `E ly`: for each sample row j next to the border, the seconds w_{k-j}(f_y) go to
    /// the pixel row C + k that spills; the row is then convolved with g[j, :].
    fn subtract_rows(
        &self,
        edge: &Edge,
        Workspace { pieces, cells, .. }: &Workspace,
        mut out: ArrayViewMut2<f64>,
        alone: bool,
    ) {
        let y = &self.kernel.y;
        let cells = ByCell::new(cells, 1, self.window.low[1]..self.window.high[1]);
        let first = self.rows.start;
        out.axis_iter_mut(NdAxis(0))
            .into_par_iter()
            .enumerate()
            .with_min_len(if alone { 1 } else { usize::MAX })
            .for_each_init(
                || edge.convolution.workspace(),
                |work, (r, mut row)| {
                    let node = ((first + r) * y.subdivision) as i64;
                    for border in &edge.nodes {
                        for piece in cells.at(node - border.k as i64, pieces) {
                            if !border.is_beyond(y, piece.offset[1]) {
                                continue;
                            }
                            for part in 0..2 {
                                let Some(cx) = self.column(piece, part) else { continue };
                                for &(j, b) in &border.terms {
                                    add(work.source(j), part, cx, piece.seconds[b]);
                                }
                            }
                        }
                    }
                    if let Some(line) = edge.convolution.sum(work) {
                        self.add_row(row.as_slice_mut().expect("in C order"), line, -1.0);
                    }
                },
            );
    }

    /// Subtracts `E lx`, a column of both strips at a time.
    fn subtract_columns(
        &self,
        edge: &Edge,
        Workspace { pieces, cells, .. }: &Workspace,
        out: ArrayViewMut2<f64>,
        alone: bool,
    ) {
        let cells = ByCell::new(cells, 0, self.window.low[0]..self.window.high[0]);
        let rows = self.rows.len();
        let (mut left, mut right) = out.split_at(NdAxis(1), self.strips[0].len());
        let mut right = right.axis_chunks_iter_mut(NdAxis(1), COLUMNS);
        let left = left.axis_chunks_iter_mut(NdAxis(1), COLUMNS);
        let groups: Vec<_> = left.map(|l| (l, right.next())).collect();
        groups
            .into_par_iter()
            .enumerate()
            .with_min_len(if alone { 1 } else { usize::MAX })
            .for_each_init(
                || (edge.convolution.workspace(), vec![Complex64::default(); COLUMNS * rows]),
                |(work, spill), (group, (mut left, right))| {
                    for i in 0..left.ncols() {
                        self.column_spill(
                            edge,
                            &cells,
                            pieces,
                            group * COLUMNS + i,
                            work,
                            &mut spill[i * rows..],
                        );
                    }
                    for (r, mut row) in left.outer_iter_mut().enumerate() {
                        row.iter_mut().enumerate().for_each(|(i, o)| *o -= spill[i * rows + r].re);
                    }
                    let Some(mut right) = right else { return };
                    for (r, mut row) in right.outer_iter_mut().enumerate() {
                        row.iter_mut().enumerate().for_each(|(i, o)| *o -= spill[i * rows + r].im);
                    }
                },
            );
    }

    /// `E lx` of column `c` of both strips.
    fn column_spill(
        &self,
        edge: &Edge,
        cells: &ByCell,
        pieces: &[Piece],
        c: usize,
        work: &mut LineWorkspace,
        spill: &mut [Complex64],
    ) {
        let (x, y) = (&self.kernel.x, &self.kernel.y);
        for (part, strip) in self.strips.iter().enumerate().filter(|(_, s)| c < s.len()) {
            let node = ((strip.start + c) * x.subdivision) as i64;
            for border in &edge.nodes {
                for piece in cells.at(node - border.k as i64, pieces) {
                    if border.is_beyond(x, piece.offset[0]) {
                        for &(i, a) in &border.terms {
                            let [s0, s1, s2, s3] = &piece.seconds;
                            let seconds = [s0[a], s1[a], s2[a], s3[a]];
                            add(work.source(i), part, self.row(piece), seconds);
                        }
                    }
                }
            }
        }
        let spill = &mut spill[..self.rows.len()];
        match edge.convolution.sum(work) {
            Some(line) => {
                let valid = line[y.samples() - 1..].iter().step_by(y.subdivision);
                spill.iter_mut().zip(valid).for_each(|(l, v)| *l = *v);
            }
            None => spill.fill(Complex64::default()),
        }
    }

    /// Adds `E ly lx`: the pixels diagonally beyond the corners of the TIF.
    fn add_corners(
        &self,
        border: &Border,
        corners: &[[[f64; MAX_BORDER]; 4]],
        pieces: &[Piece],
        mut out: ArrayViewMut2<f64>,
    ) {
        let (x, y) = (&self.kernel.x, &self.kernel.y);
        let [left, right] = &self.strips;
        let columns = left.start..left.end.max(right.end);
        for piece in pieces {
            let mut beyond = [None; MAX_BORDER];
            for (beyond, node) in beyond.iter_mut().zip(&border.columns.nodes) {
                if node.is_beyond(x, piece.offset[0]) {
                    *beyond = x.pixel(piece.cell[0] + node.k as i64, &columns);
                }
            }
            if beyond == [None; MAX_BORDER] {
                continue;
            }
            for node in &border.rows.nodes {
                let Some(r) = y.pixel(piece.cell[1] + node.k as i64, &self.rows) else { continue };
                if !node.is_beyond(y, piece.offset[1]) {
                    continue;
                }
                // (1) in two dimensions
                let mut nm = [0.0; MAX_BORDER];
                for &(j, b) in &node.terms {
                    for (seconds, rates) in piece.seconds[b].iter().zip(&corners[j]) {
                        nm.iter_mut().zip(rates).for_each(|(n, rate)| *n += seconds * rate);
                    }
                }
                let mut row = out.row_mut(r);
                let row = row.as_slice_mut().expect("in C order");
                for (c, nm) in beyond.iter().zip(nm) {
                    if let Some(c) = c {
                        row[*c] += nm;
                    }
                }
            }
        }
    }
}

/// Adds seconds to the nodes c-1 .. c+2 of a line, as far as it has them.
#[inline]
fn add(line: &mut [Complex64], part: usize, c: i64, seconds: [f64; 4]) {
    if part == 0 {
        add_to(line, c, seconds, |v| &mut v.re);
    } else {
        add_to(line, c, seconds, |v| &mut v.im);
    }
}

#[inline(always)]
fn add_to(
    line: &mut [Complex64],
    c: i64,
    seconds: [f64; 4],
    part: impl Fn(&mut Complex64) -> &mut f64,
) {
    let first = usize::try_from(c - 1).unwrap_or(usize::MAX - 4);
    if let Some([n0, n1, n2, n3]) = line.get_mut(first..first + 4) {
        *part(n0) += seconds[0];
        *part(n1) += seconds[1];
        *part(n2) += seconds[2];
        *part(n3) += seconds[3];
        return;
    }
    for (c, s) in (c - 1..).zip(seconds) {
        if let Some(v) = usize::try_from(c).ok().and_then(|i| line.get_mut(i)) {
            *part(v) += s;
        }
    }
}

/// Pieces by their cell along one axis; in the order of time within one.
struct ByCell {
    lowest: i64,
    /// Where in `order` the pieces of the cell `lowest + i` start; one more at the end.
    start: Vec<u32>,
    order: Vec<u32>,
}

impl ByCell {
    /// For the cells of the pieces, which are within `window` along the axis.
    fn new(cells: &[[i64; 2]], axis: usize, window: Range<i64>) -> Self {
        let lowest = window.start;
        let of = |cell: &[i64; 2]| (cell[axis] - lowest) as usize;
        let mut start = vec![0; (window.end - lowest) as usize + 2];
        cells.iter().for_each(|c| start[of(c) + 2] += 1);
        (2..start.len()).for_each(|i| start[i] += start[i - 1]);
        // start[i + 1] is now where cell i starts, and moves to where it ends.
        let mut order = vec![0; cells.len()];
        for (index, c) in cells.iter().enumerate() {
            let next = &mut start[of(c) + 1];
            order[*next as usize] = index as u32;
            *next += 1;
        }
        start.pop();
        Self { lowest, start, order }
    }

    /// The pieces of one cell.
    fn at<'p>(&'p self, cell: i64, pieces: &'p [Piece]) -> impl Iterator<Item = &'p Piece> {
        let i = usize::try_from(cell - self.lowest).unwrap_or(usize::MAX - 2);
        let order = match self.start.get(i..i + 2) {
            Some(&[from, to]) => &self.order[from as usize..to as usize],
            _ => &[],
        };
        order.iter().map(|i| &pieces[*i as usize])
    }
}
