//! The motion that a program shall make, on the N axes of a machine.
//!
//! A distance between two positions p and q of the axes is
//!
//! ```text
//! d = sqrt(sum_i (l_i (p_i - q_i))^2)
//! ```
//!
//! with the lever l = 1 for a linear axis. For a rotary axis l is the distance that a point moves per degree of the
//! axis, mm. The radius of this point is the distance from the contact point to the pivot for a tilt, and the largest
//! radius of the motion for a spindle.

use planish_numerics::polynomial::range;
use planish_types::{AxesMotion, AxisGrid, Invalid, Kinematics, Machine, MachineAxis};

/// Smallest radius from which the lever of a rotary axis follows, mm. Larger: tilts about the contact point follow the
/// plan more closely. Smaller: less closely. Chosen: with the default path deviation such a tilt stays within 0.3
/// degrees.
const LEAST_LEVER_MM: f64 = 1.0;

/// The motion, the axes that run it, and the clock and counts of their controller; k is the number of segments.
pub(crate) struct AxesPlan<'a, const N: usize> {
    /// Times of the ends of the segments, s, length k+1.
    pub break_time_s: &'a [f64],
    /// Ascending coefficients of the cubic of every segment (k) and axis, mm or deg per s^order.
    pub coefficient: &'a [[[f64; 4]; N]],
    /// True for the segments (k) in which the tool removes.
    pub tool_on: &'a [bool],
    pub machine: &'a Machine,
    pub axes: &'a [MachineAxis; N],
    pub grids: [AxisGrid; N],
    /// Lever of every axis (l of the module), mm per mm or per degree.
    pub lever: [f64; N],
    /// True if the acceleration may step at a node by J (T1 + T2) / 2, as in a motion of planish axes; J is the limit
    /// on jerk, T1 and T2 are the durations beside the node. False if the acceleration of the plan may not step.
    pub may_step: bool,
    /// Function that returns the contact point of the tool; `None` in a motion for x and y.
    pub contact: Option<&'a Contact<'a>>,
}

/// Function from positions of the axes to the contact point [x, y] on the part, mm; its result is `None` where the tool
/// meets no surface.
pub(crate) type Contact<'a> = dyn Fn(&[f64]) -> Option<[f64; 2]> + 'a;

/// A segment of a plan: its start and duration, and ascending coefficients of every axis.
pub(crate) struct Segment<'a, const N: usize> {
    pub start_s: f64,
    pub duration_s: f64,
    pub coefficient: &'a [[f64; 4]; N],
    pub tool_on: bool,
}

impl<const N: usize> AxesPlan<'_, N> {
    /// Returns the number of segments.
    pub fn len(&self) -> usize {
        self.tool_on.len()
    }

    pub fn segment(&self, i: usize) -> Segment<'_, N> {
        Segment {
            start_s: self.break_time_s[i],
            duration_s: self.break_time_s[i + 1] - self.break_time_s[i],
            coefficient: &self.coefficient[i],
            tool_on: self.tool_on[i],
        }
    }

    pub fn segments(&self) -> impl Iterator<Item = Segment<'_, N>> {
        (0..self.len()).map(|i| self.segment(i))
    }

    pub fn total_time_s(&self) -> f64 {
        self.break_time_s[self.len()] - self.break_time_s[0]
    }

    /// Returns the length of a difference of positions by the formula of the module, mm.
    pub fn length_mm(&self, difference: [f64; N]) -> f64 {
        length_mm(&self.lever, difference)
    }

    /// Returns the distance between the lowest and the highest position of an axis, in its unit.
    pub fn extent(&self, axis: usize) -> f64 {
        let reached = self.segments().map(|s| range(&s.coefficient[axis], s.duration_s));
        let [low, high] = reached
            .fold([f64::INFINITY, f64::NEG_INFINITY], |[l, h], r| [l.min(r.min), h.max(r.max)]);
        high - low
    }
}

/// Returns the length of a difference of positions of axes with the levers `lever`, mm.
pub(crate) fn length_mm<const N: usize>(lever: &[f64; N], difference: [f64; N]) -> f64 {
    let first = (lever[0] * difference[0]).abs();
    (1..N).fold(first, |sum, a| sum.hypot(lever[a] * difference[a]))
}

/// Returns the levers of the axes of `machine` in `motion`, mm per mm or per degree.
pub(crate) fn levers(machine: &Machine, motion: &AxesMotion) -> Vec<f64> {
    let pivot_mm = match machine.kinematics() {
        Kinematics::Tilts { pivot_mm, .. } => pivot_mm.abs(),
        Kinematics::Spindle { pivot_mm, .. } => pivot_mm.unwrap_or_default().abs(),
        Kinematics::Xy | Kinematics::Xyz => 0.0,
    };
    let mut levers = Vec::new();
    for axis in machine.axes() {
        levers.push(match (axis.is_rotary, axis.name) {
            (false, _) => 1.0,
            (true, "c") => largest_radius_mm(motion).max(LEAST_LEVER_MM).to_radians(),
            (true, _) => pivot_mm.max(LEAST_LEVER_MM).to_radians(),
        });
    }
    levers
}

/// Returns the largest magnitude of the first axis in the motion, mm; on a machine with a spindle it is the radius.
fn largest_radius_mm(motion: &AxesMotion) -> f64 {
    let segments = (0..motion.len()).map(|i| (&motion.segment(i)[0], motion.duration_s(i)));
    segments.map(|(c, duration_s)| range(c, duration_s).peak().0).fold(0.0, f64::max)
}

/// Returns the coefficients of every segment as an array over the axes. Refuses a motion with another number of axes.
pub(crate) fn by_segment<const N: usize>(
    motion: &AxesMotion,
) -> Result<Vec<[[f64; 4]; N]>, Invalid> {
    let segments: Result<_, _> = (0..motion.len()).map(|i| motion.segment(i).try_into()).collect();
    segments.map_err(|_| {
        let problem = format!("has {} axes, and the machine has {N}", motion.axes());
        let remedy = "give the machine file that the motion was made for";
        Invalid::whole("coefficient_mm_or_deg", problem, remedy)
    })
}
