//! A path under construction.

use planish_types::{Invalid, ToolPath};

use crate::{MAX_SEGMENTS, region::SLACK};

/// Points in order; each but the first ends a segment.
#[derive(Default)]
pub(crate) struct Draft {
    pub point_mm: Vec<[f64; 2]>,
    pub tool_on: Vec<bool>,
    pub pass_idx: Vec<i64>,
}

impl Draft {
    /// Begins the path at a point.
    pub fn begin(&mut self, point: [f64; 2]) {
        self.point_mm.push(point);
    }

    /// Adds a segment to `point`.
    pub fn to(&mut self, point: [f64; 2], on: bool, pass: usize) {
        self.point_mm.push(point);
        self.tool_on.push(on);
        self.pass_idx.push(pass as i64);
    }

    /// Ends the path, with its dwell points in the middle of the segments. Refuses points that are no path.
    pub fn finish(self) -> Result<ToolPath, Invalid> {
        ToolPath::through(self.point_mm, self.tool_on, self.pass_idx)
    }
}

/// Returns `ceil(length / step)`, at least 1; `None` when `already` and it exceed [`MAX_SEGMENTS`].
pub(crate) fn parts(length: f64, step: f64, already: usize) -> Option<usize> {
    let n = (length / step - SLACK).ceil().max(1.0);
    if already as f64 + n <= MAX_SEGMENTS as f64 { Some(n as usize) } else { None }
}
