//! What spills over the edges of R along one axis: `E ly` and `E lx` of [`crate::gridded`].
//!
//! With the line `C` of cells across the axis, the seconds of its pieces spread *along* the line for each of the
//! weights across it, and the nodes `k` beyond the edges,
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

use planish_numerics::fft::Complex64;
use rayon::prelude::*;

use crate::{kernel::Edge, lattice::Lattice};

/// Lines of cells whose pieces are gone through in the order of time: their sources stay in the cache, and the motion
/// is read in runs.
const BLOCK: usize = 8;

/// Blocks that are transformed before they are used, by the threads that share them: the lines that they spill on stay
/// in the cache.
pub const BLOCKS: usize = 2;

/// Weights across a line.
pub const WEIGHTS: usize = 4;

/// The lines of a tile, of both its strips.
pub struct Lines<'a> {
    /// The edges that they spill over.
    pub edge: &'a Edge,
    /// The axis across the lines.
    pub across: &'a Lattice,
    /// Whether they are shared among the threads.
    pub parallel: bool,
}

/// The pieces of the lines of cells, of which 0 is the first that spreads seconds to the tile.
pub trait Pieces: Sync {
    /// The pieces of each strip in a block of lines, the line of each in the block, and which of the nodes that are
    /// beyond only at times are so for it: [`crate::lattice::BorderNode::kind`].
    fn of(&self, block: usize) -> [impl Iterator<Item = (u32, usize, u8)>; 2];

    /// Adds the seconds of a piece of the given strip to `F_d`, the one at `[d + 1]`.
    fn add(&self, piece: u32, strip: usize, lines: [&mut [Complex64]; WEIGHTS]);
}

/// The sources of a block.
#[derive(Clone, Default)]
struct Group {
    /// Line in the block.
    line: usize,
    kind: u8,
    /// Whether F_d is not 0, at `[d + 1]`.
    used: [bool; WEIGHTS],
}

impl Lines<'_> {
    /// The spectra of the spill on the lines of pixels 0 .. `count`, with the opposite sign. `sources` is a buffer.
    pub fn subtract(
        &self,
        pieces: &impl Pieces,
        count: usize,
        spectra: &mut Vec<Complex64>,
        sources: &mut [Vec<Complex64>; BLOCKS],
    ) {
        let least = if self.parallel { 1 } else { usize::MAX };
        let size = self.edge.convolution.size();
        spectra.clear();
        spectra.resize(count * size, Complex64::default());
        let lines = if count == 0 {
            0
        } else {
            (count - 1) * self.across.subdivision + self.across.samples() + 3
        };
        // The line of cells whose tool reaches the pixel i with its node k is i * subdivision + last - k.
        let nodes = &self.edge.nodes;
        let (Some(low), Some(high)) = (nodes.first(), nodes.last()) else { return };
        let (step, last) = (self.across.subdivision as isize, self.across.last + 2);
        for from in (0..lines).step_by(BLOCK * BLOCKS) {
            let groups: Vec<Vec<Group>> = sources
                .par_iter_mut()
                .enumerate()
                .with_min_len(least)
                .map_init(
                    || self.edge.convolution.scratch(),
                    |scratch, (b, sources)| {
                        self.transform(pieces, from / BLOCK + b, sources, scratch)
                    },
                )
                .collect();
            if groups.iter().all(Vec::is_empty) {
                continue;
            }
            let sources = &*sources;
            let first = (from as isize + low.k - last).max(0) as usize / step as usize;
            let end = (from + BLOCK * BLOCKS) as isize + high.k - last;
            let end = (end.max(0) as usize).div_ceil(step as usize).min(count);
            if first >= end {
                continue;
            }
            spectra[first * size..]
                .par_chunks_mut(size)
                .take(end - first)
                .enumerate()
                .with_min_len(least)
                .for_each_init(Vec::new, |terms, (i, spectrum)| {
                    terms.clear();
                    for node in nodes {
                        let line = (first + i) as isize * step + last - node.k - from as isize;
                        let Ok(line) = usize::try_from(line) else { continue };
                        let (b, line) = (line / BLOCK, line % BLOCK);
                        let Some(groups) = groups.get(b) else { continue };
                        for (g, group) in groups
                            .iter()
                            .enumerate()
                            .filter(|(_, g)| g.line == line && node.is_beyond(g.kind))
                        {
                            let f = |d: usize| &sources[b][(g * WEIGHTS + d) * size..][..size];
                            terms.extend(
                                node.terms
                                    .iter()
                                    .filter(|t| group.used[t.1])
                                    .map(|&(slot, d)| (slot, f(d))),
                            );
                        }
                    }
                    self.edge.convolution.subtract(spectrum, terms);
                });
        }
    }

    /// The spectra of the sources of a block, group by group.
    fn transform(
        &self,
        pieces: &impl Pieces,
        block: usize,
        sources: &mut Vec<Complex64>,
        scratch: &mut [Complex64],
    ) -> Vec<Group> {
        let size = self.edge.convolution.size();
        let mut kinds = [0_u16; BLOCK];
        pieces.of(block).into_iter().flatten().for_each(|(_, line, kind)| kinds[line] |= 1 << kind);
        let mut groups = vec![];
        let mut group_of = [[0; 16]; BLOCK];
        for (line, kinds) in kinds.iter().enumerate() {
            for kind in (0..16).filter(|kind| kinds >> kind & 1 == 1) {
                group_of[line][usize::from(kind)] = groups.len();
                groups.push(Group { line, kind, ..Default::default() });
            }
        }
        let needed = groups.len() * WEIGHTS * size;
        sources.resize(sources.len().max(needed), Complex64::default());
        let sources = &mut sources[..needed];
        sources.fill(Complex64::default());
        for (strip, of) in pieces.of(block).into_iter().enumerate() {
            for (piece, line, kind) in of {
                let group = group_of[line][usize::from(kind)];
                let mut f = sources[group * WEIGHTS * size..].chunks_exact_mut(size);
                pieces.add(
                    piece,
                    strip,
                    [(); WEIGHTS].map(|()| f.next().expect("one for each weight")),
                );
            }
        }
        let used = groups.iter_mut().flat_map(|g| &mut g.used);
        for (used, f) in used.zip(sources.chunks_exact_mut(size)) {
            *used = f.iter().any(|v| v.re != 0.0 || v.im != 0.0);
            if *used {
                self.edge.convolution.forward(f, scratch);
            }
        }
        groups
    }
}

/// Pieces by blocks of cells along one axis; in the order of time within one.
pub struct Blocks<'a> {
    /// Cell and kind of the pieces.
    cells: &'a [[i32; 2]],
    kinds: &'a [[u8; 2]],
    axis: usize,
    lowest: i32,
    /// Where in `order` the pieces of each block start; one more at the end.
    start: Vec<u32>,
    order: Vec<u32>,
}

impl<'a> Blocks<'a> {
    /// For the pieces whose cells are within `window` along the axis.
    pub fn new(
        cells: &'a [[i32; 2]],
        kinds: &'a [[u8; 2]],
        axis: usize,
        window: Range<i64>,
    ) -> Self {
        let lowest = window.start as i32;
        let count = ((window.end - window.start) as usize).div_ceil(BLOCK);
        // Cells below the window are beyond any block.
        let of = |cell: &[i32; 2]| {
            Some((cell[axis] - lowest) as u32 as usize / BLOCK).filter(|b| *b < count)
        };
        let mut start = vec![0; count + 2];
        cells.iter().filter_map(of).for_each(|b| start[b + 2] += 1);
        (2..start.len()).for_each(|i| start[i] += start[i - 1]);
        // start[b + 1] is now where block b starts, and moves to where it ends.
        let mut order = vec![0; start[count + 1] as usize];
        for (index, c) in cells.iter().enumerate() {
            let Some(b) = of(c) else { continue };
            let next = &mut start[b + 1];
            order[*next as usize] = index as u32;
            *next += 1;
        }
        start.pop();
        Self { cells, kinds, axis, lowest, start, order }
    }

    /// The pieces of a block, the line of each in it, and its kind.
    pub fn of(&self, block: usize) -> impl Iterator<Item = (u32, usize, u8)> {
        let order = match self.start.get(block..block + 2) {
            Some(&[from, to]) => &self.order[from as usize..to as usize],
            _ => &[],
        };
        order.iter().map(|&piece| {
            let (cell, kind) = (self.cells[piece as usize], self.kinds[piece as usize]);
            (piece, (cell[self.axis] - self.lowest) as usize % BLOCK, kind[self.axis])
        })
    }
}
