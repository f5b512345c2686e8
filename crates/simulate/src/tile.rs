//! A tile of the map: the work of one thread.
//!
//! The two strips of columns of a tile are the real and the imaginary part of every transform here. Node 0 of a strip,
//! or of the band of rows, is the first from which the tool reaches it.

use std::ops::Range;

use ndarray::{ArrayViewMut2, Axis as NdAxis};
use planish_numerics::fft::{
    lane_convolution::{self, Strips},
    line_convolution::GROUP,
};
use planish_types::Trajectory;
use rayon::prelude::*;

use crate::{
    kernel::{Border, Kernel, MAX_BORDER},
    lattice::BorderNode,
    quadrature::{Cutter, Reach, Weight, Window},
    spill::{Blocks, LinePieces, Lines, Sources, Spilt, WEIGHTS},
};

/// Buffers that a thread uses for one tile after the other.
pub struct Workspace {
    /// Seconds on the nodes of each strip, in rows of the length of the transform.
    seconds: [Vec<f64>; 2],
    transform: lane_convolution::Workspace<f64>,
    cutter: Cutter,
    border_pieces: BorderPieces,
    /// Spectra of the kernel spill ([`crate::spill`]) on the rows, and after them on the columns.
    spilt: Spilt,
    sources: Sources,
}

/// Pieces of the motion in a tile, kept for the correction of the border.
#[derive(Default)]
struct BorderPieces {
    /// Integrals of each piece: [`crate::quadrature::CellPiece::seconds`].
    seconds: Vec<[[f64; 4]; 4]>,
    /// Cell [x, y] of each piece.
    cells: Vec<[i32; 2]>,
    /// Kind of each piece along [x, y]: [`BorderNode::kind`].
    kinds: Vec<[u8; 2]>,
}

impl Workspace {
    /// Makes a workspace for any tile of `kernel`.
    pub fn new(kernel: &Kernel) -> Self {
        Self {
            seconds: Default::default(),
            transform: Default::default(),
            cutter: Cutter::new([kernel.x.cells(), kernel.y.cells()]),
            border_pieces: BorderPieces::default(),
            spilt: Spilt::default(),
            sources: Sources::default(),
        }
    }
}

impl BorderPieces {
    fn blocks(&self, axis: usize, window: Range<i64>) -> Blocks<'_> {
        Blocks::new(&self.cells, &self.kinds, axis, window)
    }
}

/// A band of rows and two strips of columns of the map, the work of one thread.
pub struct Tile<'a> {
    kernel: &'a Kernel,
    rows: Range<usize>,
    strips: [Range<usize>; 2],
    /// Cells of the tool from which seconds are spread to the tile.
    window: Window,
    /// First node of the rows, and first node of the columns of each strip.
    first_y: i64,
    first_x: [i64; 2],
}

impl<'a> Tile<'a> {
    /// Returns the tile of `kernel` with these ranges of rows and of columns of both strips.
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

    /// Adds the removal of the `segments` to `out`, the pixels of the tile, nm; returns the number of quadrature points
    /// that this tile counts. If the tile is the only one (`alone`), the threads share its rows and columns.
    pub fn run(
        &self,
        (trajectory, weight): (&Trajectory, Option<&Weight<'_>>),
        segments: &[Reach],
        mut out: ArrayViewMut2<f64>,
        work: &mut Workspace,
        alone: bool,
    ) -> usize {
        let (points, reached) = self.spread((trajectory, weight), segments, work);
        if !reached {
            return points;
        }
        // R = E - E ly - E lx + E ly lx                                              (2)
        let Workspace { seconds, transform, border_pieces, spilt, sources, .. } = work;
        let x = &self.kernel.x;
        let y = &self.kernel.y;
        let nodes = (y.nodes_of(&self.rows), x.nodes_of(&self.strips[0]));
        let mut strips = Seconds {
            seconds,
            width: self.kernel.convolution.size().1,
            left: self.strips[0].len(),
            subdivision: [x.subdivision, y.subdivision],
            out: out.view_mut(),
        };
        self.kernel.convolution.convolve(nodes, &mut strips, transform);
        if let Some(border) = &self.kernel.border {
            let lines = Lines { edge: &border.rows, across: y, parallel: alone };
            let blocks = border_pieces.blocks(1, y.window(&self.rows));
            let pieces = RowPieces {
                tile: self,
                size: border.rows.convolution.size(),
                border_pieces,
                blocks,
            };
            lines.subtract(&pieces, self.rows.len(), spilt, sources);
            self.add_rows(&lines, spilt, out.view_mut());
            let lines = Lines { edge: &border.columns, across: x, parallel: alone };
            let blocks = [0, 1].map(|s| border_pieces.blocks(0, x.window(&self.strips[s])));
            let pieces = ColumnPieces {
                tile: self,
                size: border.columns.convolution.size(),
                border_pieces,
                blocks,
            };
            lines.subtract(&pieces, self.strips[0].len(), spilt, sources);
            self.add_columns(&lines, spilt, out.view_mut());
            if let Some(corners) = &border.corners {
                self.add_corners(border, corners, border_pieces, out);
            }
        }
        points
    }

    /// Spreads the seconds of the motion over the nodes in `work`, and keeps the pieces for the border. Returns the
    /// number of quadrature points that this tile counts, and true if any piece of the motion reaches the tile.
    fn spread(
        &self,
        (trajectory, weight): (&Trajectory, Option<&Weight<'_>>),
        segments: &[Reach],
        work: &mut Workspace,
    ) -> (usize, bool) {
        let Workspace {
            seconds: nodes,
            cutter,
            border_pieces: BorderPieces { seconds: border_seconds, cells, kinds },
            ..
        } = work;
        let border = self.kernel.border.as_ref();
        let width = self.kernel.convolution.size().1;
        let rows = self.kernel.y.nodes_of(&self.rows);
        for nodes in &mut *nodes {
            nodes.clear();
            nodes.resize(rows * width, 0.0);
        }
        border_seconds.clear();
        cells.clear();
        kinds.clear();
        let x = self.window.low[0]..self.window.high[0];
        let mut points = 0;
        let mut reached = false;
        for reach in segments.iter().filter(|r| r.is_in(0, &x)) {
            let segment = trajectory.segment(reach.segment);
            cutter.pieces((reach.segment, &segment), &self.window, weight, |piece| {
                reached = true;
                points += if self.owns(piece.cell) { piece.points } else { 0 };
                for part in 0..2 {
                    let Some(cx) = self.column(piece.cell[0], part) else { continue };
                    for (b, seconds) in piece.seconds.iter().enumerate() {
                        let r = self.row(piece.cell[1]) + b as i64 - 1;
                        if r < 0 || r >= rows as i64 {
                            continue;
                        }
                        let line = &mut nodes[part][r as usize * width..][..width];
                        add_to(line, cx, *seconds);
                    }
                }
                if let Some(Border { rows, columns, .. }) = border {
                    border_seconds.push(piece.seconds);
                    cells.push(piece.cell.map(|c| c as i32));
                    kinds.push([
                        BorderNode::kind(&columns.nodes, &self.kernel.x, piece.offset[0]),
                        BorderNode::kind(&rows.nodes, &self.kernel.y, piece.offset[1]),
                    ]);
                }
            });
        }
        (points, reached)
    }

    /// Returns true if this tile counts the quadrature points of the cell; every cell is counted in one tile.
    fn owns(&self, cell: [i64; 2]) -> bool {
        let overlap = [self.kernel.x.samples(), self.kernel.y.samples()].map(|n| n as i64 + 2);
        let first = [self.strips[0].start, self.rows.start];
        (0..2).all(|a| first[a] == 0 || cell[a] >= self.window.low[a] + overlap[a])
    }

    /// Returns the node along y of a cell, counted from the first of the tile.
    fn row(&self, cell_y: i64) -> i64 {
        cell_y - self.first_y
    }

    /// Returns the node along x of a cell, counted from the first of the strip `part`; `None` if it spreads no seconds
    /// there.
    fn column(&self, cell_x: i64, part: usize) -> Option<i64> {
        let c = cell_x - self.first_x[part];
        let nodes = self.kernel.x.nodes_of(&self.strips[part]) as i64;
        if nodes > 0 && c >= -2 && c <= nodes { Some(c) } else { None }
    }

    /// Transforms the spectra `rows` (minus the spill on the rows of both strips) back, and adds them to the pixels
    /// `out`.
    fn add_rows(&self, lines: &Lines, rows: &mut Spilt, mut out: ArrayViewMut2<f64>) {
        let convolution = &lines.edge.convolution;
        let x = &self.kernel.x;
        let runs = convolution.runs();
        out.axis_chunks_iter_mut(NdAxis(0), GROUP)
            .into_par_iter()
            .zip(rows.spectra.par_chunks_mut(GROUP * runs))
            .zip(&rows.touched)
            .with_min_len(lines.least())
            .filter(|(_, touched)| **touched)
            .for_each_init(Vec::new, |work, ((mut rows, spilt), _)| {
                convolution.inverse(spilt, work);
                for (mut row, line) in rows.outer_iter_mut().zip(spilt.chunks_exact(runs)) {
                    let row = row.as_slice_mut().expect("in C order");
                    let (left, right) = row.split_at_mut(self.strips[0].len());
                    for (to, from) in
                        [left, right].into_iter().zip(convolution.left_and_right(line))
                    {
                        add_pixels(to, &from[x.samples() - 1..], x.subdivision);
                    }
                }
            });
    }

    /// Transforms the spectra `columns` (minus the spill on the columns of both strips) back, and adds them to the
    /// pixels `out`.
    fn add_columns(&self, lines: &Lines, columns: &Spilt, out: ArrayViewMut2<f64>) {
        let convolution = &lines.edge.convolution;
        let y = &self.kernel.y;
        let (mut left, mut right) = out.split_at(NdAxis(1), self.strips[0].len());
        let mut right = right.axis_chunks_iter_mut(NdAxis(1), GROUP);
        let left = left.axis_chunks_iter_mut(NdAxis(1), GROUP);
        let groups: Vec<_> = left.map(|l| (l, right.next())).collect();
        columns
            .spectra
            .par_chunks(GROUP * convolution.runs())
            .zip(&columns.touched)
            .zip(groups)
            .with_min_len(lines.least())
            .filter(|((_, touched), _)| **touched)
            .for_each_init(Vec::new, |work, ((columns, _), (mut left, mut right))| {
                convolution.inverse_by_elements(columns, work, |node, first, of_left, of_right| {
                    let Some(node) = node.checked_sub(y.samples() - 1) else { return };
                    if !node.is_multiple_of(y.subdivision) {
                        return;
                    }
                    let row = node / y.subdivision;
                    for (to, from) in [(Some(&mut left), of_left), (right.as_mut(), of_right)] {
                        let Some(to) = to.filter(|to| row < to.nrows()) else { continue };
                        let mut to = to.row_mut(row);
                        let to = to.as_slice_mut().expect("in C order");
                        let to = to.get_mut(first..).unwrap_or_default();
                        to.iter_mut().zip(from).for_each(|(to, v)| *to += v);
                    }
                });
            });
    }

    /// Adds the term `E ly lx` of (2) of [`crate::gridded`]: the pixels diagonally beyond the corners of the TIF.
    fn add_corners(
        &self,
        border: &Border,
        corners: &[[[f64; MAX_BORDER]; 4]],
        border_pieces: &BorderPieces,
        mut out: ArrayViewMut2<f64>,
    ) {
        let x = &self.kernel.x;
        let y = &self.kernel.y;
        let [left, right] = &self.strips;
        let columns = left.start..left.end.max(right.end);
        for ((seconds, cell), kind) in
            border_pieces.seconds.iter().zip(&border_pieces.cells).zip(&border_pieces.kinds)
        {
            let mut beyond = [None; MAX_BORDER];
            for (beyond, node) in beyond.iter_mut().zip(&border.columns.nodes) {
                if node.is_beyond(kind[0]) {
                    *beyond = x.pixel(i64::from(cell[0]) + node.k as i64, &columns);
                }
            }
            if beyond == [None; MAX_BORDER] {
                continue;
            }
            for node in &border.rows.nodes {
                let Some(r) = y.pixel(i64::from(cell[1]) + node.k as i64, &self.rows) else {
                    continue;
                };
                if !node.is_beyond(kind[1]) {
                    continue;
                }
                // (1) in two dimensions
                let mut nm = [0.0; MAX_BORDER];
                for &(j, b) in &node.terms {
                    for (seconds, rates) in seconds[b].iter().zip(&corners[j]) {
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

/// The seconds of both strips as the sources of a convolution, and the pixels to which their removal is added.
struct Seconds<'a> {
    seconds: &'a [Vec<f64>; 2],
    width: usize,
    /// Number of pixels of a row in the left strip.
    left: usize,
    /// Number of nodes per pixel along [x, y].
    subdivision: [usize; 2],
    out: ArrayViewMut2<'a, f64>,
}

impl Strips<f64> for Seconds<'_> {
    #[inline(always)]
    fn read(&self, row: usize, column: usize, left: &mut [f64], right: &mut [f64]) {
        let at = row * self.width + column;
        left.copy_from_slice(&self.seconds[0][at..at + left.len()]);
        right.copy_from_slice(&self.seconds[1][at..at + right.len()]);
    }

    #[inline(always)]
    fn write(&mut self, row: usize, column: usize, left: &[f64], right: &[f64]) {
        let [nx, ny] = self.subdivision;
        if !row.is_multiple_of(ny) {
            return;
        }
        // The first pixel at one of these nodes.
        let pixel = column.div_ceil(nx);
        let first = column.next_multiple_of(nx) - column;
        let (Some(left), Some(right)) = (left.get(first..), right.get(first..)) else { return };
        let mut out = self.out.row_mut(row / ny);
        let (to_left, to_right) = out.as_slice_mut().expect("in C order").split_at_mut(self.left);
        for (to, from) in [(to_left, left), (to_right, right)] {
            add_pixels(to.get_mut(pixel..).unwrap_or_default(), from, nx);
        }
    }
}

/// Adds the values on every `subdivision`-th node of `from` to the pixels `to`.
#[inline(always)]
fn add_pixels(to: &mut [f64], from: &[f64], subdivision: usize) {
    if subdivision == 1 {
        to.iter_mut().zip(from).for_each(|(to, v)| *to += v);
    } else {
        to.iter_mut().zip(from.iter().step_by(subdivision)).for_each(|(to, v)| *to += v);
    }
}

/// The pieces by rows of cells, for the term `E ly` of [`crate::gridded`].
struct RowPieces<'a> {
    tile: &'a Tile<'a>,
    /// Number of nodes of a line.
    size: usize,
    border_pieces: &'a BorderPieces,
    blocks: Blocks<'a>,
}

impl LinePieces for RowPieces<'_> {
    fn in_block(&self, block: usize) -> [impl Iterator<Item = (u32, usize, u8)>; 2] {
        [0, 1].map(|_strip| self.blocks.in_block(block))
    }

    fn add(&self, piece: u32, strip: usize, f: &mut [f64], step: usize) {
        let [x, _] = self.border_pieces.cells[piece as usize];
        if let Some(c) = self.tile.column(x.into(), strip) {
            for (d, seconds) in self.border_pieces.seconds[piece as usize].iter().enumerate() {
                add_to(&mut f[d * step..][..self.size], c, *seconds);
            }
        }
    }
}

/// The pieces by columns of cells, for the term `E lx` of [`crate::gridded`].
struct ColumnPieces<'a> {
    tile: &'a Tile<'a>,
    /// Number of nodes of a line.
    size: usize,
    border_pieces: &'a BorderPieces,
    /// Blocks of pieces of each strip.
    blocks: [Blocks<'a>; 2],
}

impl LinePieces for ColumnPieces<'_> {
    fn in_block(&self, block: usize) -> [impl Iterator<Item = (u32, usize, u8)>; 2] {
        [0, 1].map(|strip| self.blocks[strip].in_block(block))
    }

    fn add(&self, piece: u32, _strip: usize, f: &mut [f64], step: usize) {
        let [_, y] = self.border_pieces.cells[piece as usize];
        let [s0, s1, s2, s3] = &self.border_pieces.seconds[piece as usize];
        let r = self.tile.row(y.into());
        for a in 0..WEIGHTS {
            add_to(&mut f[a * step..][..self.size], r, [s0[a], s1[a], s2[a], s3[a]]);
        }
    }
}

/// Adds four times, s, to the nodes c-1 .. c+2 of a line; those that the line does not have are left out.
#[inline(always)]
fn add_to(line: &mut [f64], c: i64, seconds: [f64; 4]) {
    let first = usize::try_from(c - 1).unwrap_or(usize::MAX - 4);
    if let Some(nodes) = line.get_mut(first..first + 4) {
        nodes.iter_mut().zip(seconds).for_each(|(node, s)| *node += s);
        return;
    }
    for (c, s) in (c - 1..).zip(seconds) {
        if let Some(node) = usize::try_from(c).ok().and_then(|i| line.get_mut(i)) {
            *node += s;
        }
    }
}
