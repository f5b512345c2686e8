//! Kernel spill over the edges of R along one axis: `E ly` and `E lx` of [`crate::gridded`].
//!
//! Kernel spill is the removal that Keys' interpolation gives beyond the last samples of the TIF. A line `C` is a row
//! or a column of cells, across the axis. The seconds of its pieces spread *along* the line for each of the weights
//! across it. With these sums and the nodes `k` beyond the edges,
//!
//! ```text
//! F_d[C] = sum over the pieces in C of w_d(f) (seconds along the line),                   d = -1..2
//! spill on the line C + k = sum_d g[k - d, :] * F_d[C]                                        (3)
//! ```
//!
//! Each `F_d` is transformed once for all the lines that it spills on, and what these lines get is summed before it is
//! transformed back. At a few nodes the spill depends on where in its cell the tool is: pieces of one cell that differ
//! in this have lines of their own.

use std::ops::Range;

use planish_numerics::fft::line_convolution::{GROUP, Run};
use rayon::prelude::*;

use crate::{
    kernel::Edge,
    lattice::{BorderNode, Lattice},
};

/// Number of lines (rows or columns) of cells whose pieces are processed together as a block, in the order of time. The
/// data of so many lines stay in the cache. Larger: cache misses. Smaller: the pieces are visited in a less regular
/// order. It changes the speed only.
const BLOCK: usize = 8;

/// Number of blocks of lines that are transformed before they are used; the threads share them. The lines of pixels
/// that they affect stay in the cache. Larger: cache misses. Smaller: threads idle.
const BLOCKS: usize = 2;

/// Number of Keys' weights across a line, and so of sources `F_d` of a line.
pub const WEIGHTS: usize = 4;

/// Rows or columns of pixels of a tile, in both its strips, from which spill is subtracted.
pub struct Lines<'a> {
    /// Edges of the TIF over which the kernel spills.
    pub edge: &'a Edge,
    /// Lattice of the axis across the lines.
    pub across: &'a Lattice,
    /// True if the threads share the blocks of lines.
    pub parallel: bool,
}

/// Pieces of the motion by lines of cells; line 0 is the first one that spreads seconds to the tile.
pub trait LinePieces: Sync {
    /// Returns the indices of the pieces that reach each strip, for one block of lines. Each comes with the index of
    /// its line in the block and with its [`crate::lattice::BorderNode::kind`].
    fn in_block(&self, block: usize) -> [impl Iterator<Item = (u32, usize, u8)>; 2];

    /// Adds the seconds of a piece to the sources `F_d` of a strip; that of the weight d begins at `(d + 1) step` in
    /// `f`.
    fn add(&self, piece: u32, strip: usize, f: &mut [f64], step: usize);
}

/// Spectra of the spill that is subtracted from lines of pixels, of both strips together.
#[derive(Default)]
pub struct Spilt {
    /// Spectra of the lines of pixels, [`GROUP`] lines at a time; the last group may have lines of zeros.
    pub spectra: Vec<Run>,
    /// True for the groups of lines that receive spill.
    pub touched: Vec<bool>,
}

/// Buffers of a thread: the sources of some blocks of lines.
#[derive(Default)]
pub struct Sources {
    blocks: [Source; BLOCKS],
}

/// The sources `F_d` of a block of lines.
#[derive(Default)]
struct Source {
    groups: Vec<Group>,
    /// Spectra of the four sources `F_d` of each group.
    spectra: Vec<Run>,
    work: Vec<f64>,
}

/// The pieces of one line of cells that are beyond the same nodes: those of one kind.
struct Group {
    /// Index of the line in the block.
    line: usize,
    kind: u8,
}

impl Lines<'_> {
    /// Sets `spilt` to minus the spectra of the spill on the lines of pixels 0 .. `count`. `sources` are buffers.
    pub fn subtract(
        &self,
        pieces: &impl LinePieces,
        count: usize,
        spilt: &mut Spilt,
        sources: &mut Sources,
    ) {
        let runs = self.edge.convolution.runs();
        let groups = count.div_ceil(GROUP);
        zeros(&mut spilt.spectra, groups * GROUP * runs);
        spilt.touched.clear();
        spilt.touched.resize(groups, false);
        let lines = match count {
            0 => 0,
            n => (n - 1) * self.across.subdivision + self.across.samples() + 3,
        };
        for from in (0..lines).step_by(BLOCK * BLOCKS) {
            let sources = &mut sources.blocks;
            sources
                .par_iter_mut()
                .enumerate()
                .with_min_len(self.least())
                .for_each(|(b, source)| source.transform(self.edge, pieces, from / BLOCK + b));
            if sources.iter().any(|s| !s.groups.is_empty()) {
                self.subtract_blocks(from, sources, count, spilt);
            }
        }
    }

    /// Returns the smallest number of lines or blocks that one thread takes: all of them unless the threads share the
    /// lines.
    pub fn least(&self) -> usize {
        if self.parallel { 1 } else { usize::MAX }
    }

    /// Subtracts the spill that the blocks `sources` cause from the lines of pixels 0 .. `count` that it reaches.
    /// `from` is the index of the first line of cells of the blocks.
    fn subtract_blocks(
        &self,
        from: usize,
        sources: &[Source; BLOCKS],
        count: usize,
        spilt: &mut Spilt,
    ) {
        let Edge { nodes, convolution } = self.edge;
        let runs = convolution.runs();
        // The line of cells whose tool reaches the pixel i with its node k is i * subdivision + last - k.
        let step = self.across.subdivision;
        let last = self.across.last + 2;
        let reached = |node: &BorderNode| {
            let first = (from as isize + node.k - last).max(0) as usize;
            let end = ((from + BLOCK * BLOCKS) as isize + node.k - last).max(0) as usize;
            first / step / GROUP..end.div_ceil(step).min(count).div_ceil(GROUP)
        };
        let (Some(low), Some(high)) = (nodes.first(), nodes.last()) else { return };
        let groups = reached(low).start..reached(high).end;
        if groups.is_empty() {
            return;
        }
        let lines = &mut spilt.spectra[groups.start * GROUP * runs..groups.end * GROUP * runs];
        lines
            .par_chunks_mut(GROUP * runs)
            .zip(&mut spilt.touched[groups.clone()])
            .zip(groups)
            .with_min_len(self.least())
            .for_each_init(Vec::new, |terms, ((lines, touched), group)| {
                terms.clear();
                let mut sums = vec![];
                for (i, sum) in lines.chunks_exact_mut(runs).enumerate() {
                    let before = terms.len();
                    for node in nodes {
                        let line = ((group * GROUP + i) * step) as isize + last - node.k;
                        let Ok(line) = usize::try_from(line - from as isize) else { continue };
                        let Some(source) = sources.get(line / BLOCK) else { continue };
                        source.terms(line % BLOCK, node, runs, terms);
                    }
                    if terms.len() > before {
                        sums.push((sum, before..terms.len()));
                    }
                }
                *touched |= !sums.is_empty();
                convolution.subtract(&mut sums, terms);
            });
    }
}

/// Sets `runs` to `count` runs that are all zero.
fn zeros(runs: &mut Vec<Run>, count: usize) {
    runs.resize(count, Run::default());
    runs.as_flattened_mut().fill(0.0);
}

impl Source {
    /// Computes the spectra of the sources of a block.
    fn transform(&mut self, edge: &Edge, pieces: &impl LinePieces, block: usize) {
        let Self { groups, spectra, work } = self;
        let runs = edge.convolution.runs();
        let mut kinds = [0_u16; BLOCK];
        pieces
            .in_block(block)
            .into_iter()
            .flatten()
            .for_each(|(_, line, kind)| kinds[line] |= 1 << kind);
        groups.clear();
        let mut group_of = [[0; 16]; BLOCK];
        for (line, kinds) in kinds.iter().enumerate() {
            for kind in (0..16).filter(|kind| kinds >> kind & 1 == 1) {
                group_of[line][usize::from(kind)] = groups.len();
                groups.push(Group { line, kind });
            }
        }
        zeros(spectra, (groups.len() * WEIGHTS).next_multiple_of(GROUP) * runs);
        let lines = spectra.as_flattened_mut();
        let step = edge.convolution.numbers();
        for (strip, in_strip) in pieces.in_block(block).into_iter().enumerate() {
            for (piece, line, kind) in in_strip {
                let from = WEIGHTS * step * group_of[line][usize::from(kind)];
                let f = &mut lines[from + strip * edge.convolution.size()..];
                pieces.add(piece, strip, f, step);
            }
        }
        edge.convolution.forward(spectra, work);
    }

    /// Appends the terms of (3) of the module that one line of the block gives to one node. Each is the index of the
    /// sample g in [`crate::lattice::Lattice::border_samples`], and the spectrum of the source `F_d`.
    fn terms<'a>(
        &'a self,
        line: usize,
        node: &BorderNode,
        runs: usize,
        terms: &mut Vec<(usize, &'a [Run])>,
    ) {
        for (g, group) in self.groups.iter().enumerate() {
            if group.line == line && node.is_beyond(group.kind) {
                let f = &self.spectra[g * WEIGHTS * runs..];
                terms.extend(node.terms.iter().map(|&(slot, d)| (slot, &f[d * runs..][..runs])));
            }
        }
    }
}

/// Pieces of the motion, sorted into blocks of cells along one axis; in the order of time within a block.
pub struct Blocks<'a> {
    /// Cells [x, y] of the pieces, and their kinds.
    cells: &'a [[i32; 2]],
    kinds: &'a [[u8; 2]],
    axis: usize,
    lowest: i32,
    /// Index in `order` at which the pieces of each block start, with one more value at the end.
    start: Vec<u32>,
    order: Vec<u32>,
}

impl<'a> Blocks<'a> {
    /// Sorts the pieces whose cells are within `window` along the axis (0: x, 1: y) into blocks.
    pub fn new(
        cells: &'a [[i32; 2]],
        kinds: &'a [[u8; 2]],
        axis: usize,
        window: Range<i64>,
    ) -> Self {
        let lowest = window.start as i32;
        let count = ((window.end - window.start) as usize).div_ceil(BLOCK);
        // Cells below the window are beyond any block.
        let block = |cell: &[i32; 2]| {
            Some((cell[axis] - lowest) as u32 as usize / BLOCK).filter(|b| *b < count)
        };
        let mut start = vec![0; count + 2];
        cells.iter().filter_map(block).for_each(|b| start[b + 2] += 1);
        (2..start.len()).for_each(|i| start[i] += start[i - 1]);
        // start[b + 1] is now where block b starts, and moves to where it ends.
        let mut order = vec![0; start[count + 1] as usize];
        for (index, c) in cells.iter().enumerate() {
            let Some(b) = block(c) else { continue };
            let next = &mut start[b + 1];
            order[*next as usize] = index as u32;
            *next += 1;
        }
        start.pop();
        Self { cells, kinds, axis, lowest, start, order }
    }

    /// Returns the indices of the pieces of a block, each with its line in the block and its kind.
    pub fn in_block(&self, block: usize) -> impl Iterator<Item = (u32, usize, u8)> {
        let order = match self.start.get(block..block + 2) {
            Some(&[from, to]) => &self.order[from as usize..to as usize],
            _ => &[],
        };
        order.iter().map(|&piece| {
            let cell = self.cells[piece as usize];
            let kind = self.kinds[piece as usize];
            (piece, (cell[self.axis] - self.lowest) as usize % BLOCK, kind[self.axis])
        })
    }
}
