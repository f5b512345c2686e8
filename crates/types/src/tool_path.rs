//! Tool path: control points of the motion and dwell points.

use crate::{Invalid, grid::is_plausible_mm};

/// `n` segments between `n + 1` velocity control points, with a dwell point for each segment.
#[derive(Clone, Debug, PartialEq)]
pub struct ToolPath {
    point_mm: Vec<[f64; 2]>,
    dwell_point_mm: Vec<[f64; 2]>,
    tool_on: Vec<bool>,
    pass_idx: Vec<i64>,
}

impl ToolPath {
    /// Returns the path of n segments.
    ///
    /// `point_mm` (n+1): velocity control points [x, y], the ends of the segments. `dwell_point_mm` (n): the point of
    /// each segment to which its dwell time belongs. `tool_on` (n): false if the tool is lifted. `pass_idx` (n): number
    /// of the contiguous pass or region to which a segment belongs.
    ///
    /// # Errors
    /// Refuses arrays of other lengths, and points that are not finite or beyond 1e7 mm.
    pub fn new(
        point_mm: Vec<[f64; 2]>,
        dwell_point_mm: Vec<[f64; 2]>,
        tool_on: Vec<bool>,
        pass_idx: Vec<i64>,
    ) -> Result<Self, Invalid> {
        let n = dwell_point_mm.len();
        if n == 0 {
            return Err(Invalid::whole(
                "dwell_point_mm",
                "is empty",
                "a path has at least one segment",
            ));
        }
        if point_mm.len() != n + 1 {
            return Err(Invalid::whole(
                "point_mm",
                format!("has {} rows for {n} dwell points", point_mm.len()),
                format!("give {} velocity control points: the ends of every segment", n + 1),
            ));
        }
        for (name, len) in [("tool_on", tool_on.len()), ("pass_idx", pass_idx.len())] {
            if len != n {
                let problem = format!("has {len} elements for {n} dwell points");
                return Err(Invalid::whole(name, problem, "give one per dwell point"));
            }
        }
        for (name, points) in [("point_mm", &point_mm), ("dwell_point_mm", &dwell_point_mm)] {
            if let Some(i) = points.iter().position(|p| p.iter().any(|c| !is_plausible_mm(*c))) {
                let remedy = "give finite coordinates in mm, within 1e7 mm of the origin";
                return Err(Invalid::at_index(name, i, format!("is {:?}", points[i]), remedy));
            }
        }
        Ok(Self { point_mm, dwell_point_mm, tool_on, pass_idx })
    }

    /// Returns the path through `point_mm` whose dwell points are the midpoints of its segments. Refuses what
    /// [`Self::new`] refuses.
    pub fn through(
        point_mm: Vec<[f64; 2]>,
        tool_on: Vec<bool>,
        pass_idx: Vec<i64>,
    ) -> Result<Self, Invalid> {
        let ends = point_mm.windows(2);
        let dwell_point_mm = ends.map(|w| [0, 1].map(|k| 0.5 * (w[0][k] + w[1][k]))).collect();
        Self::new(point_mm, dwell_point_mm, tool_on, pass_idx)
    }

    /// Returns the number of segments n (= dwell points).
    #[allow(clippy::len_without_is_empty)] // never empty
    pub fn len(&self) -> usize {
        self.dwell_point_mm.len()
    }

    /// Returns the velocity control points [x, y] (n+1), mm.
    pub fn point_mm(&self) -> &[[f64; 2]] {
        &self.point_mm
    }

    /// Returns the dwell points [x, y] (n), mm: one per segment, to which its dwell time belongs.
    pub fn dwell_point_mm(&self) -> &[[f64; 2]] {
        &self.dwell_point_mm
    }

    /// Returns the tool flags (n): false if the tool is lifted and removes nothing.
    pub fn tool_on(&self) -> &[bool] {
        &self.tool_on
    }

    /// Returns the number of the contiguous pass or region of each segment (n).
    pub fn pass_idx(&self) -> &[i64] {
        &self.pass_idx
    }

    /// Returns the displacement [x, y] of segment `i`, mm.
    pub fn displacement_mm(&self, i: usize) -> [f64; 2] {
        [0, 1].map(|k| self.point_mm[i + 1][k] - self.point_mm[i][k])
    }

    /// Returns the length of segment `i` along its chord, mm.
    pub fn segment_length_mm(&self, i: usize) -> f64 {
        let [dx, dy] = self.displacement_mm(i);
        dx.hypot(dy)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lengths_must_agree() {
        let p = vec![[0.0, 0.0], [3.0, 4.0]];
        let path = ToolPath::through(p.clone(), vec![true], vec![0]).unwrap();
        assert_eq!((path.len(), path.segment_length_mm(0)), (1, 5.0));
        assert_eq!(path.dwell_point_mm()[0], [1.5, 2.0]);
        let error = |points: &[[f64; 2]], on: usize| {
            ToolPath::new(points.to_vec(), vec![[0.0, 0.0]], vec![true; on], vec![0])
                .unwrap_err()
                .to_string()
        };
        assert!(error(&[[0.0, 0.0]], 1).contains("give 2 velocity control points"));
        assert!(error(&p, 2).contains("tool_on: has 2 elements for 1"));
        assert!(error(&[[0.0, 0.0], [f64::NAN, 0.0]], 1).contains("point_mm[1]"));
    }
}
