//! The common lattice of nodes on which the pixels of the map and the samples of the TIF lie. R, g, K and (1) are those
//! of [`crate::gridded`].

use std::ops::Range;

use ndarray::Array2;
use planish_numerics::keys;
use planish_types::{Grid, Tif};

use crate::quadrature::NodeCells;

/// The lattice of one axis: pixel `i` of the map is node `i subdivision`, sample `j` of the TIF
/// (on the lattice) has the offset `low + j step`.
#[derive(Clone, Debug)]
pub struct Lattice {
    /// Number of lattice steps per pixel of the map.
    pub subdivision: usize,
    /// Distance of the nodes, mm.
    step_mm: f64,
    /// Number of pixels of the map along the axis.
    pub pixels: usize,
    /// Coordinate of node 0, which is pixel 0, mm.
    start_mm: f64,
    /// Offset of sample 0 of the TIF from the tool, mm: the lower edge of R.
    tif_start_mm: f64,
    /// Position of the upper edge of R, in steps from the lower edge.
    edge: f64,
    /// Largest index j of a sample: the samples are j = -1 ..= last.
    pub last: isize,
}

impl Lattice {
    /// Makes the lattice along x (axis 0) or y (axis 1), for a map and a TIF on it. `subdivision` is the number of its
    /// samples per pixel.
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

    /// Returns the number of nodes from the first to the last pixel.
    fn nodes(&self) -> usize {
        (self.pixels - 1).saturating_mul(self.subdivision).saturating_add(1)
    }

    /// Returns the cells in which the position of the tool is counted. Cell C begins where the tool has sample 0 of the
    /// TIF on the node C.
    pub fn cells(&self) -> NodeCells {
        let fraction = keys::split(self.edge).1;
        NodeCells {
            origin_mm: self.start_mm - self.tif_start_mm,
            step_mm: self.step_mm,
            inner: if fraction > 0.0 { Some(1.0 - fraction) } else { None },
        }
    }

    /// Returns the number of samples of the TIF on the lattice, j = -1 ..= last.
    pub fn samples(&self) -> usize {
        (self.last + 2) as usize
    }

    /// Returns the number of nodes that hold the seconds for the whole map. They go from node -last to node nodes(),
    /// one more than outputs and samples need.
    pub fn source_nodes(&self) -> usize {
        self.nodes().saturating_add(self.last as usize + 1)
    }

    /// Returns the number of nodes that hold the seconds with which the tool reaches `pixels`.
    pub fn nodes_of(&self, pixels: &Range<usize>) -> usize {
        match pixels.len() {
            0 => 0,
            n => (n - 1) * self.subdivision + self.samples(),
        }
    }

    /// Returns the lattice node at which the seconds for `pixels` begin.
    pub fn first_node(&self, pixels: &Range<usize>) -> i64 {
        (pixels.start * self.subdivision) as i64 - self.last as i64
    }

    /// Returns the index within `pixels` of the pixel at the node `q`, which is counted from pixel 0; `None` if there
    /// is no such pixel.
    pub fn pixel(&self, q: i64, pixels: &Range<usize>) -> Option<usize> {
        let q = usize::try_from(q).ok()?;
        let i = match self.subdivision {
            1 => q,
            nodes if q.is_multiple_of(nodes) => q / nodes,
            _ => return None,
        };
        if pixels.contains(&i) { Some(i - pixels.start) } else { None }
    }

    /// Returns the cells of the tool's position from which seconds are spread to the nodes for `pixels`.
    pub fn window(&self, pixels: &Range<usize>) -> Range<i64> {
        let first = self.first_node(pixels);
        match self.nodes_of(pixels) {
            0 => first..first,
            n => first - 2..first + n as i64 + 1,
        }
    }

    /// Returns true if the node k lies beyond the edges of R, with the tool at the offset f in its cell: s = k - f is
    /// outside [0, edge].
    fn is_beyond(&self, k: isize, f: f64) -> bool {
        let s = k as f64 - f;
        s < -keys::SNAP || s > self.edge + keys::SNAP
    }

    /// Returns the indices j of the samples of the TIF that give nodes beyond the edges of R something by (1): up to
    /// three next to the lower edge, and those next to the upper one.
    pub fn border_samples(&self) -> Vec<isize> {
        let upper = self.edge.floor() as isize;
        (-1..=self.last).filter(|j| *j <= 1 || *j >= upper - 2).collect()
    }

    /// Returns the nodes k, counted from the cell of the tool, that can lie beyond an edge of R and still get something
    /// by (1).
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

/// A node that lies beyond an edge of R, at least for some positions of the tool.
#[derive(Clone, Debug)]
pub struct BorderNode {
    /// Position of the node, in steps from the cell of the tool.
    pub k: isize,
    /// 0 if the node is beyond the edge wherever in its cell the tool is; otherwise its bit of [`BorderNode::kind`].
    /// There are at most two such nodes, those in whose step an edge lies.
    at_times: u8,
    /// Contributions of samples to the node by (1): index of the sample j in [`Lattice::border_samples`], and index d +
    /// 1 of the weight with d = k - j.
    pub terms: Vec<(usize, usize)>,
}

impl BorderNode {
    /// Returns the bits of the `nodes` that are beyond an edge at the offset `f` of the tool in its cell, among those
    /// that are not always beyond it.
    #[inline]
    pub fn kind(nodes: &[Self], lattice: &Lattice, f: f64) -> u8 {
        let beyond = nodes.iter().filter(|n| n.at_times != 0 && lattice.is_beyond(n.k, f));
        beyond.map(|n| n.at_times).sum()
    }

    /// Returns true if the node is beyond an edge for offsets of the tool with the bits `kind`.
    #[inline]
    pub fn is_beyond(&self, kind: u8) -> bool {
        self.at_times == 0 || self.at_times & kind != 0
    }
}

/// Returns true if the border of R needs a correction: a sample of `g` next to it is above the rounding (1e-16) of the
/// `peak` of the tool.
pub fn has_border(peak: f64, x: &Lattice, y: &Lattice, g: &Array2<f64>) -> bool {
    let [rows, columns] = [y, x].map(Lattice::border_samples);
    let border = g.indexed_iter().filter(|((r, c), _)| {
        rows.contains(&(*r as isize - 1)) || columns.contains(&(*c as isize - 1))
    });
    // Below this the spill is lost in the rounding of the peak.
    border.map(|(_, v)| v.abs()).fold(0.0, f64::max) > f64::EPSILON * peak
}
