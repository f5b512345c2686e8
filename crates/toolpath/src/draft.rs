//! A path under construction: points, and for each segment the state of the tool and the pass.

use planish_types::{Invalid, ToolPath};

use crate::{MAX_SEGMENTS, region::SLACK};

/// Points of the path in order, mm; each but the first ends a segment, for which `tool_on` and `pass_idx` have one
/// value.
#[derive(Default)]
pub(crate) struct Draft {
    pub point_mm: Vec<[f64; 2]>,
    pub tool_on: Vec<bool>,
    pub pass_idx: Vec<i64>,
}

impl Draft {
    /// Begins the path at a point, mm.
    pub fn begin(&mut self, point: [f64; 2]) {
        self.point_mm.push(point);
    }

    /// Adds a segment to `point`, mm, with the tool on if `on` is true, in the pass with the number `pass`.
    pub fn to(&mut self, point: [f64; 2], on: bool, pass: usize) {
        self.point_mm.push(point);
        self.tool_on.push(on);
        self.pass_idx.push(pass as i64);
    }

    /// Ends the path, with its dwell points in the middle of the segments. Refuses points that make no valid path.
    pub fn finish(self) -> Result<ToolPath, Invalid> {
        ToolPath::through(self.point_mm, self.tool_on, self.pass_idx)
    }
}

/// Returns the number of equal steps of at most `step` into which `length` is divided: `ceil(length / step)`, at least
/// 1. Returns `None` if with the `already` existing segments it would exceed [`MAX_SEGMENTS`].
pub(crate) fn parts(length: f64, step: f64, already: usize) -> Option<usize> {
    let n = (length / step - SLACK).ceil().max(1.0);
    if already as f64 + n <= MAX_SEGMENTS as f64 { Some(n as usize) } else { None }
}
