//! The removal matrix of several tools: their columns side by side, `B = [B_1 ... B_K]`.
//!
//! ```text
//! B t = sum_k B_k t_k,   B' m = [B_1' m ... B_K' m]
//! ```

use std::ops::Range;

use ndarray::Array2;

use crate::model::operator::Removal;

/// The removal matrix B of one or several tools. Each has a range of the columns; the ranges follow each other.
pub struct StackedRemoval {
    tools: Vec<(Range<usize>, Removal)>,
}

impl StackedRemoval {
    /// Makes B of the matrices of the tools, each with the range of its columns. Panics if there is no tool.
    pub fn new(tools: Vec<(Range<usize>, Removal)>) -> Self {
        assert!(!tools.is_empty(), "a problem has a tool");
        Self { tools }
    }

    /// Returns the removal `B t` (ny, nx), nm, for the dwell times t (n) of all tools, s.
    pub fn apply(&self, t: &[f64]) -> Array2<f64> {
        let removals = self.tools.iter().map(|(columns, b)| b.apply(&t[columns.clone()]));
        removals.reduce(|sum, removal| sum + removal).expect("a problem has a tool")
    }

    /// Returns the removal `B_k t_k` (ny, nx), nm, by tool number `tool` alone, for the dwell times t (n) of all tools,
    /// s.
    pub fn apply_one(&self, tool: usize, t: &[f64]) -> Array2<f64> {
        let (columns, b) = &self.tools[tool];
        b.apply(&t[columns.clone()])
    }

    /// Returns the adjoint product `B' m` (n) for a map m (ny, nx).
    pub fn adjoint(&self, map: &Array2<f64>) -> Vec<f64> {
        self.tools.iter().flat_map(|(_, b)| b.adjoint(map)).collect()
    }
}
