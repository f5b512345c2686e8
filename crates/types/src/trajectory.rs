//! The motion of the tool: piecewise cubic polynomials per axis in segment-local time.

use planish_numerics::polynomial;

use crate::Invalid;

/// Motion in k segments: `p(u) = c0 + c1 u + c2 u^2 + c3 u^3` in mm per axis, with `u = t - break_time_s[i]` in segment
/// i.
///
/// Segment-local time keeps the digits that t^3 would lose at 500 s. A trajectory may have a jump
/// between two segments; `verify` reports it.
#[derive(Clone, Debug, PartialEq)]
pub struct Trajectory {
    break_time_s: Vec<f64>,
    coefficient_mm: Vec<[[f64; 4]; 2]>,
    tool_on: Vec<bool>,
    dwell_index: Vec<Option<usize>>,
    /// Removal rate of each segment relative to that of the TIF; `None` if all factors are 1, as in every plan.
    rate_factor: Option<Vec<f64>>,
}

/// One segment of a trajectory, a cubic polynomial per axis.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Segment<'a> {
    /// Start time in the trajectory, s.
    pub start_s: f64,
    /// Duration of the segment, s; > 0.
    pub duration_s: f64,
    /// Ascending coefficients per axis [x, y]; order k has the unit mm/s^k.
    pub coefficient_mm: &'a [[f64; 4]; 2],
    /// True if the tool removes material; false on a move with the tool off.
    pub tool_on: bool,
    /// Index of the dwell point that the segment serves; `None` if it serves none, such as a link between passes.
    pub dwell_index: Option<usize>,
    /// Removal rate of the tool relative to that of its TIF; >= 0.
    pub rate_factor: f64,
}

impl Segment<'_> {
    /// Returns the position [x, y], mm, at the time `u_s` after the start of the segment.
    pub fn position_mm(&self, u_s: f64) -> [f64; 2] {
        [0, 1].map(|axis| polynomial::evaluate(&self.coefficient_mm[axis], u_s))
    }
}

impl Trajectory {
    /// Returns the motion of k segments.
    ///
    /// `break_time_s` (k+1): start of each segment and end of the last one, s. `coefficient_mm` (k, axis, order):
    /// ascending coefficients, order j in mm/s^j. `tool_on` (k): true if the tool removes. `dwell_index` (k): the dwell
    /// point that a segment serves, if any.
    ///
    /// # Errors
    /// Refuses arrays of other lengths, numbers that are not finite, and break times that do not ascend strictly.
    pub fn new(
        break_time_s: Vec<f64>,
        coefficient_mm: Vec<[[f64; 4]; 2]>,
        tool_on: Vec<bool>,
        dwell_index: Vec<Option<usize>>,
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
            return Err(Invalid::at_index("break_time_s", i, problem, "give finite seconds"));
        }
        if let Some(i) = (1..=k).find(|&i| break_time_s[i] <= break_time_s[i - 1]) {
            return Err(Invalid::at_index(
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
                    return Err(Invalid::at_index(
                        "coefficient_mm",
                        index,
                        format!("is {v}"),
                        "give finite values",
                    ));
                }
            }
        }
        Ok(Self { break_time_s, coefficient_mm, tool_on, dwell_index, rate_factor: None })
    }

    /// Returns the motion with a removal rate in segment i that is `rate_factor[i]` (k) times that of the TIF, such as
    /// one from a measured beam current. Refuses factors that are negative or not finite.
    pub fn with_rate_factor(self, rate_factor: Vec<f64>) -> Result<Self, Invalid> {
        let k = self.len();
        if rate_factor.len() != k {
            let problem = format!("has {} elements for {k} segments", rate_factor.len());
            return Err(Invalid::whole("rate_factor", problem, format!("give {k}")));
        }
        if let Some(i) = rate_factor.iter().position(|f| !(f.is_finite() && *f >= 0.0)) {
            let remedy = "give the rate relative to that of the TIF: 1 where they are equal";
            return Err(Invalid::at_index(
                "rate_factor",
                i,
                format!("is {}", rate_factor[i]),
                remedy,
            ));
        }
        let all_one = rate_factor.iter().all(|f| *f == 1.0);
        Ok(Self { rate_factor: if all_one { None } else { Some(rate_factor) }, ..self })
    }

    /// Returns the number of segments k.
    #[allow(clippy::len_without_is_empty)] // never empty
    pub fn len(&self) -> usize {
        self.coefficient_mm.len()
    }

    /// Returns the break times (k+1), s: the start of each segment and the end of the last one.
    pub fn break_time_s(&self) -> &[f64] {
        &self.break_time_s
    }

    /// Returns the ascending coefficients (k, axis, order), order j in mm/s^j of segment-local time.
    pub fn coefficient_mm(&self) -> &[[[f64; 4]; 2]] {
        &self.coefficient_mm
    }

    /// Returns the tool flags (k): true if the tool removes.
    pub fn tool_on(&self) -> &[bool] {
        &self.tool_on
    }

    /// Returns for each segment (k) the index of the dwell point that it serves, or `None` if it serves none.
    pub fn dwell_index(&self) -> &[Option<usize>] {
        &self.dwell_index
    }

    /// Returns the removal rate of every segment relative to that of the TIF (k), or `None` if all of them are 1.
    pub fn rate_factor(&self) -> Option<&[f64]> {
        self.rate_factor.as_deref()
    }

    /// Refuses a motion whose removal rate differs from that of the TIF. Stages that plan with the TIF alone call this.
    pub fn check_rate_is_constant(&self) -> Result<(), Invalid> {
        let factors = self.rate_factor().unwrap_or_default();
        if let Some(i) = factors.iter().position(|f| *f != 1.0) {
            let problem = format!("is {}: a log of what a machine did, with its rate", factors[i]);
            let remedy = "give a plan, or a log that was read without its beam current";
            return Err(Invalid::at_index("rate_factor", i, problem, remedy));
        }
        Ok(())
    }

    /// Returns segment `i`, counted from 0.
    pub fn segment(&self, i: usize) -> Segment<'_> {
        Segment {
            start_s: self.break_time_s[i],
            duration_s: self.break_time_s[i + 1] - self.break_time_s[i],
            coefficient_mm: &self.coefficient_mm[i],
            tool_on: self.tool_on[i],
            dwell_index: self.dwell_index[i],
            rate_factor: self.rate_factor.as_ref().map_or(1.0, |f| f[i]),
        }
    }

    /// Returns all segments in order.
    pub fn segments(&self) -> impl Iterator<Item = Segment<'_>> {
        (0..self.len()).map(|i| self.segment(i))
    }

    /// Returns the duration of the whole motion, s.
    pub fn total_time_s(&self) -> f64 {
        self.break_time_s[self.len()] - self.break_time_s[0]
    }

    /// Returns, for each of `dwell_points` dwell points, the total time of the segments that serve it and for which
    /// `counted` returns true, s.
    ///
    /// The time of a point without such a segment is 0. A segment that serves no point does not
    /// count. Refuses a dwell index beyond the points.
    pub fn served_s(
        &self,
        dwell_points: usize,
        counted: impl Fn(&Segment<'_>) -> bool,
    ) -> Result<Vec<f64>, Invalid> {
        // served_i = sum of the durations h_k over the segments k with dwell_index_k = i
        let mut served_s = vec![0.0; dwell_points];
        for (k, segment) in self.segments().enumerate() {
            let Some(i) = segment.dwell_index else { continue };
            let Some(served_s) = served_s.get_mut(i) else {
                let problem = format!("is {i}, the dwell times are {dwell_points}");
                let remedy = "give the dwell times of this run";
                return Err(Invalid::at_index("dwell_index", k, problem, remedy));
            };
            if counted(&segment) {
                *served_s += segment.duration_s;
            }
        }
        Ok(served_s)
    }
}

/// Returns the break times (k+1) of segments with the durations (k), s; the first one is 0.
pub fn break_times(duration_s: &[f64]) -> Vec<f64> {
    let mut breaks = Vec::with_capacity(duration_s.len() + 1);
    let mut time = 0.0;
    breaks.push(time);
    for d in duration_s {
        time += d;
        breaks.push(time);
    }
    breaks
}

/// Builder of a trajectory: segments are appended in order, from the time 0.
#[derive(Clone, Debug, Default)]
pub struct TrajectoryBuilder {
    end_s: f64,
    duration_s: Vec<f64>,
    coefficient_mm: Vec<[[f64; 4]; 2]>,
    tool_on: Vec<bool>,
    dwell_index: Vec<Option<usize>>,
}

impl TrajectoryBuilder {
    /// Appends a segment with ascending coefficients per axis [x, y], order j in mm/s^j, which serves the dwell point
    /// `dwell_index`, if any.
    pub fn push(
        &mut self,
        duration_s: f64,
        coefficient_mm: [[f64; 4]; 2],
        tool_on: bool,
        dwell_index: Option<usize>,
    ) {
        self.end_s += duration_s;
        self.duration_s.push(duration_s);
        self.coefficient_mm.push(coefficient_mm);
        self.tool_on.push(tool_on);
        self.dwell_index.push(dwell_index);
    }

    /// Returns the number of segments appended so far.
    pub fn len(&self) -> usize {
        self.duration_s.len()
    }

    /// Returns true if there is no segment yet.
    pub fn is_empty(&self) -> bool {
        self.duration_s.is_empty()
    }

    /// Returns the time at which the last segment so far ends, s.
    pub fn end_s(&self) -> f64 {
        self.end_s
    }

    /// Returns the durations of the segments so far (k), s.
    pub fn duration_s(&self) -> &[f64] {
        &self.duration_s
    }

    /// Returns the ascending coefficients of the segments so far (k, axis, order), order j in mm/s^j.
    pub fn coefficient_mm(&self) -> &[[[f64; 4]; 2]] {
        &self.coefficient_mm
    }

    /// Returns the duration and the start time, s, of the first segment that is too short to change the time of the
    /// motion in floating-point numbers. `None` if there is none; [`Self::build`] would refuse such a segment.
    pub fn vanishing_duration_s(&self) -> Option<(f64, f64)> {
        let time_s = break_times(&self.duration_s);
        let first = (0..self.len()).find(|k| time_s[k + 1] <= time_s[*k])?;
        Some((self.duration_s[first], time_s[first]))
    }

    /// Returns the trajectory. Refuses an empty one, and durations that are not positive.
    pub fn build(self) -> Result<Trajectory, Invalid> {
        let break_time_s = break_times(&self.duration_s);
        Trajectory::new(break_time_s, self.coefficient_mm, self.tool_on, self.dwell_index)
    }
}

/// Number that files store as the dwell index of a segment that serves no dwell point.
const STORED_NONE: i64 = -1;

/// Returns the dwell index as files store it: -1 for a segment that serves no dwell point.
pub fn stored_dwell_index(dwell_index: Option<usize>) -> i64 {
    dwell_index.map_or(STORED_NONE, |i| i as i64)
}

/// Returns the dwell indices (k) from the numbers that files store; -1 becomes `None`. Refuses other negative numbers.
pub fn dwell_index_from_stored(stored: &[i64]) -> Result<Vec<Option<usize>>, Invalid> {
    let mut dwell_index = Vec::with_capacity(stored.len());
    for (k, stored) in stored.iter().enumerate() {
        dwell_index.push(match usize::try_from(*stored) {
            Ok(i) => Some(i),
            Err(_) if *stored == STORED_NONE => None,
            Err(_) => {
                let remedy = "give the dwell point that the segment serves, or -1 for none";
                return Err(Invalid::at_index("dwell_index", k, format!("is {stored}"), remedy));
            }
        });
    }
    Ok(dwell_index)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn local_time_starts_at_zero_in_every_segment() {
        let c = [[1.0, 2.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]];
        let t = Trajectory::new(
            vec![0.0, 500.0, 502.0],
            vec![c, c],
            vec![true; 2],
            vec![Some(0), Some(1)],
        )
        .unwrap();
        assert_eq!(t.segment(1).position_mm(2.0), [5.0, 8.0]);
        assert_eq!(t.total_time_s(), 502.0);
    }

    #[test]
    fn a_rate_factor_of_one_is_none() {
        let plan = || served();
        assert_eq!(plan().with_rate_factor(vec![1.0; 4]).unwrap(), plan());
        assert!(plan().check_rate_is_constant().is_ok() && plan().segment(2).rate_factor == 1.0);
        let run = plan().with_rate_factor(vec![1.0, 0.0, 1.25, 1.0]).unwrap();
        assert_eq!(
            run.segments().map(|s| s.rate_factor).collect::<Vec<_>>(),
            [1.0, 0.0, 1.25, 1.0]
        );
        assert_eq!(run.rate_factor(), Some(&[1.0, 0.0, 1.25, 1.0][..]));
        let message = run.check_rate_is_constant().unwrap_err().to_string();
        assert!(message.contains("rate_factor[1]: is 0"), "{message}");
        for bad in [vec![1.0; 3], vec![1.0, 1.0, -0.1, 1.0], vec![1.0, 1.0, f64::NAN, 1.0]] {
            let message = plan().with_rate_factor(bad).unwrap_err().to_string();
            assert!(message.contains("rate_factor"), "{message}");
        }
    }

    #[test]
    fn bad_trajectories_are_refused() {
        let c = [[0.0; 4]; 2];
        let error = |t: Vec<f64>, c: Vec<[[f64; 4]; 2]>| {
            let k = c.len();
            Trajectory::new(t, c, vec![true; k], vec![None; k]).unwrap_err().to_string()
        };
        assert!(error(vec![0.0], vec![]).contains("empty"));
        assert!(error(vec![0.0, 1.0], vec![c, c]).contains("break_time_s: has 2"));
        assert!(error(vec![0.0, 0.0], vec![c]).contains("break_time_s[1]: is 0 after 0"));
        let mut bad = c;
        bad[1][2] = f64::NAN;
        assert!(error(vec![0.0, 1.0], vec![bad]).contains("coefficient_mm[0, 1, 2]: is NaN"));
    }

    /// Returns a motion that serves point 0 for 1 s, point 2 for 2 s, none for 4 s, and point 2 with the tool off for 8
    /// s.
    fn served() -> Trajectory {
        let mut builder = TrajectoryBuilder::default();
        let c = [[0.0; 4]; 2];
        let segments = [(1.0, Some(0)), (2.0, Some(2)), (4.0, None), (8.0, Some(2))];
        for (k, (h, point)) in segments.into_iter().enumerate() {
            assert_eq!(builder.len(), k);
            builder.push(h, c, k < 3, point);
        }
        assert_eq!((builder.end_s(), builder.is_empty()), (15.0, false));
        builder.build().unwrap()
    }

    #[test]
    fn a_builder_adds_the_durations_up() {
        let t = served();
        assert_eq!(t.break_time_s(), [0.0, 1.0, 3.0, 7.0, 15.0]);
        assert_eq!(t.tool_on(), [true, true, true, false]);
        assert_eq!(t.dwell_index(), [Some(0), Some(2), None, Some(2)]);
        let message = TrajectoryBuilder::default().build().unwrap_err().to_string();
        assert!(message.contains("at least one segment"), "{message}");
        let mut still = TrajectoryBuilder::default();
        still.push(0.0, [[0.0; 4]; 2], true, None);
        assert_eq!(still.vanishing_duration_s(), Some((0.0, 0.0)));
        let message = still.build().unwrap_err().to_string();
        assert!(message.contains("break_time_s[1]: is 0 after 0"), "{message}");
        let mut long = TrajectoryBuilder::default();
        long.push(1e12, [[0.0; 4]; 2], true, None);
        assert_eq!(long.vanishing_duration_s(), None);
        // A unit in the last place of 1e12 s is 1.2e-4 s.
        long.push(1e-6, [[0.0; 4]; 2], true, None);
        assert_eq!(long.vanishing_duration_s(), Some((1e-6, 1e12)));
    }

    #[test]
    fn served_time_is_summed_per_dwell_point() {
        let t = served();
        assert_eq!(t.served_s(4, |_| true).unwrap(), [1.0, 0.0, 10.0, 0.0]);
        assert_eq!(t.served_s(3, |s| s.tool_on).unwrap(), [1.0, 0.0, 2.0]);
        let message = t.served_s(2, |_| true).unwrap_err().to_string();
        assert!(message.contains("dwell_index[1]: is 2, the dwell times are 2"), "{message}");
    }

    #[test]
    fn a_file_holds_minus_one_for_no_dwell_point() {
        let index = vec![Some(0), None, Some(7)];
        let stored: Vec<i64> = index.iter().map(|i| stored_dwell_index(*i)).collect();
        assert_eq!(stored, [0, -1, 7]);
        assert_eq!(dwell_index_from_stored(&stored), Ok(index));
        let message = dwell_index_from_stored(&[0, -2]).unwrap_err().to_string();
        assert!(message.contains("dwell_index[1]: is -2; give the dwell point"), "{message}");
    }
}
