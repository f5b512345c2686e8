//! Motion of all axes of a machine as piecewise cubic polynomials.

use planish_numerics::polynomial;

use crate::Invalid;

/// Largest number of axes. Larger: a damaged file takes more memory. Smaller: no machine that Planish knows has more
/// than five.
const MOST_AXES: usize = 16;

/// Motion of all n axes of a machine in k segments: a cubic polynomial per axis and segment, in mm or degrees. The time
/// of a polynomial begins at 0 in its segment.
#[derive(Clone, Debug, PartialEq)]
pub struct AxesMotion {
    break_time_s: Vec<f64>,
    /// Coefficients, element i n + a for axis a of segment i; order 0 to 3 ascending, mm or deg per s^order.
    coefficient: Vec<[f64; 4]>,
    tool_on: Vec<bool>,
    dwell_index: Vec<Option<usize>>,
}

impl AxesMotion {
    /// Returns the motion of n axes in k segments.
    ///
    /// `break_time_s` (k+1); `coefficient` (k n), mm or deg, with the n axes of a segment one after the other,
    /// ascending orders; `tool_on` (k); `dwell_index` (k).
    ///
    /// # Errors
    /// Refuses arrays of other lengths, numbers that are not finite, and break times that do not ascend strictly.
    pub fn new(
        break_time_s: Vec<f64>,
        coefficient: Vec<[f64; 4]>,
        tool_on: Vec<bool>,
        dwell_index: Vec<Option<usize>>,
    ) -> Result<Self, Invalid> {
        let k = tool_on.len();
        if k == 0 {
            return Err(Invalid::whole("tool_on", "is empty", "give at least one segment"));
        }
        let axes = coefficient.len() / k;
        if axes == 0 || axes > MOST_AXES || axes * k != coefficient.len() {
            let problem = format!("has {} polynomials for {k} segments", coefficient.len());
            let remedy = format!("give one per segment and axis, for 1 to {MOST_AXES} axes");
            return Err(Invalid::whole("coefficient_mm_or_deg", problem, remedy));
        }
        for (name, len, expected) in
            [("break_time_s", break_time_s.len(), k + 1), ("dwell_index", dwell_index.len(), k)]
        {
            if len != expected {
                let problem = format!("has {len} elements for {k} segments");
                return Err(Invalid::whole(name, problem, format!("give {expected}")));
            }
        }
        if let Some(i) = break_time_s.iter().position(|t| !t.is_finite()) {
            let problem = format!("is {}", break_time_s[i]);
            return Err(Invalid::at_index("break_time_s", i, problem, "give finite seconds"));
        }
        if let Some(i) = (1..=k).find(|&i| break_time_s[i] <= break_time_s[i - 1]) {
            let problem = format!("is {} after {}", break_time_s[i], break_time_s[i - 1]);
            let remedy = "break times ascend strictly; drop segments of zero duration";
            return Err(Invalid::at_index("break_time_s", i, problem, remedy));
        }
        if let Some(i) = coefficient.iter().position(|c| c.iter().any(|v| !v.is_finite())) {
            let problem = format!("is {:?}", coefficient[i]);
            let index = (i / axes, i % axes);
            return Err(Invalid::at_index(
                "coefficient_mm_or_deg",
                index,
                problem,
                "give finite values",
            ));
        }
        Ok(Self { break_time_s, coefficient, tool_on, dwell_index })
    }

    /// Returns the number of segments k.
    #[allow(clippy::len_without_is_empty)] // never empty
    pub fn len(&self) -> usize {
        self.tool_on.len()
    }

    /// Returns the number of axes n.
    pub fn axes(&self) -> usize {
        self.coefficient.len() / self.len()
    }

    /// Returns the break times (k+1), s: the start of each segment and the end of the last one.
    pub fn break_time_s(&self) -> &[f64] {
        &self.break_time_s
    }

    /// Returns the duration of segment `i`, s.
    pub fn duration_s(&self, i: usize) -> f64 {
        self.break_time_s[i + 1] - self.break_time_s[i]
    }

    /// Returns the cubic polynomials of the axes (n) in segment `i`: coefficients of ascending order, mm or deg per
    /// s^order.
    pub fn segment(&self, i: usize) -> &[[f64; 4]] {
        let n = self.axes();
        &self.coefficient[i * n..(i + 1) * n]
    }

    /// Returns the tool flags (k): true if the tool removes.
    pub fn tool_on(&self) -> &[bool] {
        &self.tool_on
    }

    /// Returns for each segment (k) the index of the dwell point that it serves, or `None` if it serves none, such as a
    /// link.
    pub fn dwell_index(&self) -> &[Option<usize>] {
        &self.dwell_index
    }

    /// Returns the positions of the axes (n), mm or deg, at the time `u_s` after the start of segment `i`.
    pub fn position(&self, i: usize, u_s: f64) -> Vec<f64> {
        self.segment(i).iter().map(|c| polynomial::evaluate(c, u_s)).collect()
    }

    /// Returns the duration of the whole motion, s.
    pub fn total_time_s(&self) -> f64 {
        self.break_time_s[self.len()] - self.break_time_s[0]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_axes_of_a_segment_stand_together() {
        let c = |v: f64| [v, 1.0, 0.0, 0.0];
        let all = vec![c(0.0), c(1.0), c(2.0), c(3.0), c(4.0), c(5.0)];
        let motion =
            AxesMotion::new(vec![0.0, 1.0, 3.0], all, vec![true; 2], vec![None; 2]).unwrap();
        assert_eq!((motion.len(), motion.axes(), motion.total_time_s()), (2, 3, 3.0));
        assert_eq!(motion.position(1, 2.0), [5.0, 6.0, 7.0]);
    }

    #[test]
    fn bad_motions_are_refused() {
        let c = [[0.0; 4]; 4];
        let said = |t: &[f64], c: &[[f64; 4]], k: usize| {
            AxesMotion::new(t.to_vec(), c.to_vec(), vec![true; k], vec![None; k])
                .unwrap_err()
                .to_string()
        };
        assert!(said(&[0.0], &[], 0).contains("tool_on: is empty"));
        assert!(
            said(&[0.0, 1.0], &c[..3], 2)
                .contains("coefficient_mm_or_deg: has 3 polynomials for 2 segments")
        );
        assert!(said(&[0.0, 1.0], &c, 2).contains("break_time_s: has 2 elements"));
        assert!(said(&[0.0, 1.0, 1.0], &c, 2).contains("break_time_s[2]: is 1 after 1"));
        let mut bad = c;
        bad[3][1] = f64::NAN;
        assert!(
            said(&[0.0, 1.0, 2.0], &bad, 2).contains("coefficient_mm_or_deg[1, 1]: is [0.0, NaN")
        );
    }
}
