//! The TIF on the lattice, prepared for the convolution with a field of seconds: the dwell time on the nodes. Kernel
//! spill is the removal that Keys' interpolation gives beyond the last samples of the TIF, where R is zero.

use ndarray::{ArrayView2, Axis as NdAxis};
use planish_numerics::fft::{lane_convolution::LaneConvolution, line_convolution::LineConvolution};

use crate::lattice::{BorderNode, Lattice};

/// The TIF on the lattice, prepared for tiles of one size.
pub struct Kernel {
    /// The lattice along x.
    pub x: Lattice,
    /// The lattice along y.
    pub y: Lattice,
    /// Convolution with the samples on the lattice.
    pub convolution: LaneConvolution,
    /// Correction of the kernel spill at the border; `None` if nothing spills.
    pub border: Option<Border>,
}

impl Kernel {
    /// Makes the kernel from the samples of the TIF on the lattice, for transforms of the shape `size` (ny, nx).
    /// `spills` says if the border has to be corrected.
    pub fn new(
        x: Lattice,
        y: Lattice,
        samples: ArrayView2<f64>,
        size: (usize, usize),
        spills: bool,
    ) -> Self {
        let convolution = LaneConvolution::new(samples, size);
        let border = if spills { Some(Border::new(&x, &y, samples, size)) } else { None };
        Self { x, y, convolution, border }
    }
}

/// Length of the arrays for the nodes of one axis that receive kernel spill. There are at most seven: three at either
/// edge, and one more if the upper edge lies between two nodes. A length below seven is out of range for such an edge.
pub const MAX_BORDER: usize = 8;

/// Correction that removes the kernel spill: (2) of [`crate::gridded`].
pub struct Border {
    /// Correction beyond the edges of R along y.
    pub rows: Edge,
    /// Correction beyond the edges of R along x.
    pub columns: Edge,
    /// Samples g at the corners of the TIF, nm/s, as `[slot of the row j][weight a][node of the columns]`, with the
    /// slots of [`Lattice::border_samples`]. `None` if all are below the rounding of the peak.
    pub corners: Option<Vec<[[f64; MAX_BORDER]; 4]>>,
}

/// Data for the correction beyond the edges of R along one axis.
pub struct Edge {
    /// Nodes beyond the edges that receive something from Keys' interpolation.
    pub nodes: Vec<BorderNode>,
    /// Convolution with the samples of [`Lattice::border_samples`], along the other axis.
    pub convolution: LineConvolution,
}

impl Edge {
    fn new(g: ArrayView2<f64>, across: &Lattice, size: usize) -> Self {
        let rows: Vec<usize> = across.border_samples().iter().map(|j| (j + 1) as usize).collect();
        let kernels = g.select(NdAxis(0), &rows);
        Self { nodes: across.border(), convolution: LineConvolution::new(kernels.view(), size) }
    }
}

impl Border {
    /// Makes the correction from the samples `g` on the lattice, for transforms of the shape `size` (ny, nx).
    fn new(x: &Lattice, y: &Lattice, g: ArrayView2<f64>, size: (usize, usize)) -> Self {
        let rows = Edge::new(g, y, size.1);
        let columns = Edge::new(g.t(), x, size.0);
        // corners[slot of j][a][slot of kx] = g[j][kx - (a - 1)]
        let samples_x = x.border_samples();
        let samples_y = y.border_samples();
        let mut corners = vec![[[0.0; MAX_BORDER]; 4]; samples_y.len()];
        for (j, table) in samples_y.iter().zip(&mut corners) {
            for (kx, node) in columns.nodes.iter().enumerate() {
                for &(slot, a) in &node.terms {
                    table[a][kx] = g[[(j + 1) as usize, (samples_x[slot] + 1) as usize]];
                }
            }
        }
        let largest = corners.iter().flatten().flatten().fold(0.0_f64, |m, v| m.max(v.abs()));
        let peak = g.iter().fold(0.0_f64, |m, v| m.max(v.abs()));
        let corners = if largest > f64::EPSILON * peak { Some(corners) } else { None };
        Self { rows, columns, corners }
    }
}
