//! The motion: piecewise cubic polynomials per axis in segment-local time.

use planish_numerics::polynomial;

use crate::Invalid;

/// `p(u) = c0 + c1 u + c2 u^2 + c3 u^3` per axis, `u = t - break_time_s[i]`.
///
/// Segment-local time keeps the digits that t^3 at 500 s would cost. Segments need not join:
/// a discontinuity between two of them is a jump, representable, and for `verify` to report.
#[derive(Clone, Debug, PartialEq)]
pub struct Trajectory {
    break_time_s: Vec<f64>,
    coefficient_mm: Vec<[[f64; 4]; 2]>,
    tool_on: Vec<bool>,
    dwell_index: Vec<i64>,
}

/// One polynomial piece of a trajectory.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Segment<'a> {
    /// Start time, s.
    pub start_s: f64,
    /// Duration, s; > 0.
    pub duration_s: f64,
    /// Ascending coefficients per axis [x, y]; order k has the unit mm/s^k.
    pub coefficient_mm: &'a [[f64; 4]; 2],
    /// False when the tool removes nothing.
    pub tool_on: bool,
    /// Dwell point that the segment serves; -1 when none.
    pub dwell_index: i64,
}

impl Segment<'_> {
    /// Position [x, y] in mm at the local time `u_s`.
    pub fn position_mm(&self, u_s: f64) -> [f64; 2] {
        [0, 1].map(|axis| polynomial::evaluate(&self.coefficient_mm[axis], u_s))
    }
}

impl Trajectory {
    /// Checks lengths, finiteness, and that break times ascend strictly.
    ///
    /// `break_time_s` (k+1), `coefficient_mm` (k, axis, order), `tool_on` (k),
    /// `dwell_index` (k): the dwell point that a segment serves, -1 when none.
    pub fn new(
        break_time_s: Vec<f64>,
        coefficient_mm: Vec<[[f64; 4]; 2]>,
        tool_on: Vec<bool>,
        dwell_index: Vec<i64>,
    ) -> Result<Self, Invalid> {
        let k = coefficient_mm.len();
        if k == 0 {
            return Err(Invalid::whole("coefficient_mm", "is empty", "give at least one segment"));
        }
        let lengths = [
            ("break_time_s", break_time_s.len(), k + 1),
            ("tool_on", tool_on.len(), k),
            ("dwell_index", dwell_index.len(), k),
        ];
        for (name, len, expected) in lengths {
            if len != expected {
                let problem = format!("has {len} elements for {k} segments");
                return Err(Invalid::whole(name, problem, format!("give {expected}")));
            }
        }
        if let Some(i) = break_time_s.iter().position(|t| !t.is_finite()) {
            let problem = format!("is {}", break_time_s[i]);
            return Err(Invalid::at("break_time_s", i, problem, "give finite seconds"));
        }
        if let Some(i) = (1..=k).find(|&i| break_time_s[i] <= break_time_s[i - 1]) {
            return Err(Invalid::at(
                "break_time_s",
                i,
                format!("is {} after {}", break_time_s[i], break_time_s[i - 1]),
                "break times ascend strictly; drop segments of zero duration",
            ));
        }
        for (i, axes) in coefficient_mm.iter().enumerate() {
            for (axis, order) in (0..2).flat_map(|a| (0..4).map(move |o| (a, o))) {
                let v = axes[axis][order];
                if !v.is_finite() {
                    let index = (i, axis, order);
                    return Err(Invalid::at(
                        "coefficient_mm",
                        index,
                        format!("is {v}"),
                        "give finite values",
                    ));
                }
            }
        }
        Ok(Self { break_time_s, coefficient_mm, tool_on, dwell_index })
    }

    /// Number of segments k.
    #[allow(clippy::len_without_is_empty)] // never empty
    pub fn len(&self) -> usize {
        self.coefficient_mm.len()
    }

    /// Break times (k+1), s.
    pub fn break_time_s(&self) -> &[f64] {
        &self.break_time_s
    }

    /// Ascending coefficients (k, axis, order).
    pub fn coefficient_mm(&self) -> &[[[f64; 4]; 2]] {
        &self.coefficient_mm
    }

    /// Whether the tool removes (k).
    pub fn tool_on(&self) -> &[bool] {
        &self.tool_on
    }

    /// Dwell point that each segment serves, -1 when none (k).
    pub fn dwell_index(&self) -> &[i64] {
        &self.dwell_index
    }

    /// Segment `i`.
    pub fn segment(&self, i: usize) -> Segment<'_> {
        Segment {
            start_s: self.break_time_s[i],
            duration_s: self.break_time_s[i + 1] - self.break_time_s[i],
            coefficient_mm: &self.coefficient_mm[i],
            tool_on: self.tool_on[i],
            dwell_index: self.dwell_index[i],
        }
    }

    /// All segments in order.
    pub fn segments(&self) -> impl Iterator<Item = Segment<'_>> {
        (0..self.len()).map(|i| self.segment(i))
    }

    /// From the first to the last break, s.
    pub fn total_time_s(&self) -> f64 {
        self.break_time_s[self.len()] - self.break_time_s[0]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn local_time_starts_at_zero_in_every_segment() {
        let c = [[1.0, 2.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]];
        let t = Trajectory::new(vec![0.0, 500.0, 502.0], vec![c, c], vec![true; 2], vec![0, 1])
            .unwrap();
        assert_eq!(t.segment(1).position_mm(2.0), [5.0, 8.0]);
        assert_eq!(t.total_time_s(), 502.0);
    }

    #[test]
    fn bad_trajectories_are_refused() {
        let c = [[0.0; 4]; 2];
        let error = |t: Vec<f64>, c: Vec<[[f64; 4]; 2]>| {
            let k = c.len();
            Trajectory::new(t, c, vec![true; k], vec![0; k]).unwrap_err().to_string()
        };
        assert!(error(vec![0.0], vec![]).contains("empty"));
        assert!(error(vec![0.0, 1.0], vec![c, c]).contains("break_time_s: has 2"));
        assert!(error(vec![0.0, 0.0], vec![c]).contains("break_time_s[1]: is 0 after 0"));
        let mut bad = c;
        bad[1][2] = f64::NAN;
        assert!(error(vec![0.0, 1.0], vec![bad]).contains("coefficient_mm[0, 1, 2]: is NaN"));
    }
}
