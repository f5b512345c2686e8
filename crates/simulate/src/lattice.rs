//! The lattice of nodes on which the map and the TIF are.

use std::ops::Range;

use ndarray::Array2;
use planish_numerics::keys;
use planish_types::{Grid, Tif};

use crate::quadrature::NodeCells;

/// The lattice of one axis: pixel `i` of the map is node `i subdivision`, sample `j` of the TIF
/// (on the lattice) has the offset `low + j step`.
#[derive(Clone, Debug)]
pub struct Lattice {
    /// Lattice steps per pixel.
    pub subdivision: usize,
    /// Distance of the nodes, mm.
    step_mm: f64,
    /// Pixels of the map.
    pub pixels: usize,
    /// Coordinate of node 0 = pixel 0, mm.
    start_mm: f64,
    /// Offset of TIF sample 0 (= the lower edge of R), mm.
    tif_start_mm: f64,
    /// Upper edge of R, in steps from the lower one.
    edge: f64,
    /// Largest j with a sample: samples are j = -1 ..= last.
    pub last: isize,
}

impl Lattice {
    /// Makes the lattice along x (0) or y (1) for a map and a TIF on its lattice with so many samples to a pixel.
    pub fn new(map: &Grid, tif: &Tif, subdivision: usize, axis: usize) -> Self {
        let map = [&map.x, &map.y][axis];
        let samples = [&tif.grid().x, &tif.grid().y][axis];
        let beyond = (tif.edge_mm()[axis] - samples.end_mm()) / samples.step_mm();
        let edge = (samples.len() - 1) as f64 + beyond;
        let (whole, fraction) = keys::split(edge);
        let last = whole + if fraction > 0.0 { 2 } else { 1 };
        Self {
            subdivision,
            step_mm: map.step_mm() / subdivision as f64,
            pixels: map.len(),
            start_mm: map.start_mm(),
            tif_start_mm: samples.start_mm(),
            edge,
            last,
        }
    }

    /// Returns the nodes between the first and the last pixel.
    fn nodes(&self) -> usize {
        (self.pixels - 1).saturating_mul(self.subdivision).saturating_add(1)
    }

    /// Returns the cells: cell C begins at the tool position at which sample 0 of the TIF is on the node C.
    pub fn cells(&self) -> NodeCells {
        let fraction = keys::split(self.edge).1;
        NodeCells {
            origin_mm: self.start_mm - self.tif_start_mm,
            step_mm: self.step_mm,
            inner: if fraction > 0.0 { Some(1.0 - fraction) } else { None },
        }
    }

    /// Samples of the TIF, j = -1 ..= last.
    pub fn samples(&self) -> usize {
        (self.last + 2) as usize
    }

    /// Returns the number of nodes of the sources of the whole map: they reach from node -last to node nodes(), one
    /// more than outputs and samples need.
    pub fn source_nodes(&self) -> usize {
        self.nodes().saturating_add(self.last as usize + 1)
    }

    /// Returns the number of nodes of a source from which the tool reaches `pixels`.
    pub fn nodes_of(&self, pixels: &Range<usize>) -> usize {
        match pixels.len() {
            0 => 0,
            n => (n - 1) * self.subdivision + self.samples(),
        }
    }

    /// Returns the node of the lattice that is node 0 of the source of `pixels`.
    pub fn first_node(&self, pixels: &Range<usize>) -> i64 {
        (pixels.start * self.subdivision) as i64 - self.last as i64
    }

    /// Returns the pixel at the node `q`, counted from the first of `pixels`, if it is one of them.
    pub fn pixel(&self, q: i64, pixels: &Range<usize>) -> Option<usize> {
        let q = usize::try_from(q).ok()?;
        let i = match self.subdivision {
            1 => q,
            nodes if q.is_multiple_of(nodes) => q / nodes,
            _ => return None,
        };
        if pixels.contains(&i) { Some(i - pixels.start) } else { None }
    }

    /// Returns the cells that spread seconds to the source of `pixels`.
    pub fn window(&self, pixels: &Range<usize>) -> Range<i64> {
        let first = self.first_node(pixels);
        match self.nodes_of(pixels) {
            0 => first..first,
            n => first - 2..first + n as i64 + 1,
        }
    }

    /// Returns true if the node k, with the tool at the offset f in its cell, is beyond R's edges: s = k - f outside
    /// [0, edge].
    fn is_beyond(&self, k: isize, f: f64) -> bool {
        let s = k as f64 - f;
        s < -keys::SNAP || s > self.edge + keys::SNAP
    }

    /// Returns the samples j from which the nodes beyond the edges get something.
    pub fn border_samples(&self) -> Vec<isize> {
        let upper = self.edge.floor() as isize;
        (-1..=self.last).filter(|j| *j <= 1 || *j >= upper - 2).collect()
    }

    /// Returns the nodes k that may be beyond an edge and still get something from (1).
    pub fn border(&self) -> Vec<BorderNode> {
        let samples = self.border_samples();
        let mut bit = 1;
        (-2..=self.last + 2)
            .filter(|k| self.is_beyond(*k, 0.0) || self.is_beyond(*k, 1.0 - keys::SNAP))
            .map(|k| {
                let terms = samples.iter().enumerate().filter_map(|(slot, j)| {
                    let weight = usize::try_from(k - j + 1).ok().filter(|d| *d < 4)?;
                    Some((slot, weight))
                });
                let always = self.is_beyond(k, 0.0) && self.is_beyond(k, 1.0 - keys::SNAP);
                let at_times = if always { 0 } else { bit };
                bit <<= u8::from(!always);
                BorderNode { k, at_times, terms: terms.collect() }
            })
            .collect()
    }
}

/// A node beyond an edge of R.
#[derive(Clone, Debug)]
pub struct BorderNode {
    /// Steps from the tool's cell.
    pub k: isize,
    /// 0 where it is beyond wherever in its cell the tool is; else its bit of [`BorderNode::kind`]: there are at most two,
    /// the node whose step an edge crosses at either end.
    at_times: u8,
    /// Contributions to the node by (1): position in [`Lattice::border_samples`] of the sample j, and the index d + 1
    /// of the weight with d = k - j.
    pub terms: Vec<(usize, usize)>,
}

impl BorderNode {
    /// Returns the bits of those `nodes` beyond only at times that are so with the tool at the offset `f` in its
    /// cell.
    #[inline]
    pub fn kind(nodes: &[Self], lattice: &Lattice, f: f64) -> u8 {
        let beyond = nodes.iter().filter(|n| n.at_times != 0 && lattice.is_beyond(n.k, f));
        beyond.map(|n| n.at_times).sum()
    }

    /// Returns true if the node is beyond with the tool at offsets of this kind.
    #[inline]
    pub fn is_beyond(&self, kind: u8) -> bool {
        self.at_times == 0 || self.at_times & kind != 0
    }
}

/// Returns true if anything spills: some sample next to the border is not negligible.
pub fn has_border(peak: f64, x: &Lattice, y: &Lattice, g: &Array2<f64>) -> bool {
    let [rows, columns] = [y, x].map(Lattice::border_samples);
    let border = g.indexed_iter().filter(|((r, c), _)| {
        rows.contains(&(*r as isize - 1)) || columns.contains(&(*c as isize - 1))
    });
    // Below this the spill is lost in the rounding of the peak.
    border.map(|(_, v)| v.abs()).fold(0.0, f64::max) > f64::EPSILON * peak
}
