//! Executed contact point of a motion of the axes, as a motion in the coordinates of the part.
//!
//! ```text
//! p(u) = g(q(u))                       g: positions of the axes to the contact point
//! p'   = (g(q + d q') - g(q - d q')) / (2 d)
//! ```
//!
//! Cubics through p and p' at the ends of pieces, which are halved until they stay near p(u).

use planish_form::Form;
use planish_kinematics::AxisMap;
use planish_numerics::polynomial::{derivative, evaluate};
use planish_types::{AxesMotion, Invalid, Machine, Trajectory};
use serde::Serialize;

use crate::piece::{State, cubic};

/// Largest distance of the cubics from the executed contact point, mm. Larger: the prediction is less exact. Smaller:
/// more segments. Chosen: 1e-3 um, 1/2000 of the default `contact_tolerance_um`.
const TOLERANCE_MM: f64 = 1e-6;

/// Distance that the fastest axis moves to each side for the central difference that gives the velocity of the contact
/// point, mm or deg. Larger: truncation, its square times the third derivative. Smaller: rounding of 1e-13 mm over it.
/// Derived: both are below 1e-9 of the velocity on parts with radii of 10 mm and more.
const WAY: f64 = 1e-3;

/// Largest number of times that a segment of the motion of the axes is halved. Larger: memory for 2^n pieces. Smaller:
/// long segments are refused whose cubics are still more than [`TOLERANCE_MM`] away.
const MOST_HALVES: u32 = 16;

/// Report on the motion of the contact point that the axes execute.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ContactReport {
    /// Number of segments of the executed motion.
    pub segment_count: usize,
    /// Largest distance of the cubics from the executed contact point, um, measured at 3 points in every segment.
    pub deviation_um: f64,
    /// Duration of the motion, s.
    pub total_time_s: f64,
}

/// Returns the motion of the contact point over the part that the motion of the axes executes, within 1e-3 um, and a
/// report. It is a trajectory in the plane of the part, with the tool states and dwell points of `motion`.
///
/// # Errors
///
/// Refuses a placement of the part without an inverse, and a motion with another number of axes than the machine.
/// Refuses a motion whose tool meets no surface, and one whose contact point stays away from cubics, for example where
/// an axis jumps.
pub fn contact(
    motion: &AxesMotion,
    machine: &Machine,
    form: &Form,
) -> Result<(Trajectory, ContactReport), Invalid> {
    let map = AxisMap::new(machine, form)?;
    if motion.axes() != map.axes() {
        let problem = format!("has {} axes, and the machine has {}", motion.axes(), map.axes());
        let remedy = "give the machine file that the motion was made for";
        return Err(Invalid::whole("coefficient_mm_or_deg", problem, remedy));
    }
    let mut break_time_s = vec![motion.break_time_s()[0]];
    let mut coefficient = Vec::new();
    let mut tool_on = Vec::new();
    let mut dwell_index = Vec::new();
    let mut deviation_mm: f64 = 0.0;
    for i in 0..motion.len() {
        let cubics = motion.segment(i);
        let missing = |u: f64| {
            let at_s = motion.break_time_s()[i] + u;
            let problem = format!("puts the tool where it meets no surface, at {at_s:.6} s");
            let remedy = "give the form that the motion was made for, with its overscan";
            Invalid::at_index("coefficient_mm_or_deg", i, problem, remedy)
        };
        let state = |u: f64| state(&map, cubics, u).ok_or_else(|| missing(u));
        let h = motion.duration_s(i);
        let mut open = vec![([0.0, h], [state(0.0)?, state(h)?], 0)];
        while let Some(([from, to], [start, end], halves)) = open.pop() {
            let length = to - from;
            let c = [0, 1].map(|k| cubic(start[k], end[k], length));
            let mut away: f64 = 0.0;
            for part in [0.25, 0.5, 0.75] {
                let u = part * length;
                let p = point(&map, cubics, from + u).ok_or_else(|| missing(from + u))?;
                away = away.max((evaluate(&c[0], u) - p[0]).hypot(evaluate(&c[1], u) - p[1]));
            }
            if away > TOLERANCE_MM && halves < MOST_HALVES {
                let middle = 0.5 * (from + to);
                let half = state(middle)?;
                open.push(([middle, to], [half, end], halves + 1));
                open.push(([from, middle], [start, half], halves + 1));
                continue;
            }
            deviation_mm = deviation_mm.max(away);
            coefficient.push(c);
            let start_s = motion.break_time_s()[i];
            break_time_s.push(if to == h { motion.break_time_s()[i + 1] } else { start_s + to });
            tool_on.push(motion.tool_on()[i]);
            dwell_index.push(motion.dwell_index()[i]);
        }
    }
    if deviation_mm > TOLERANCE_MM {
        let problem =
            format!("moves the contact point {:.4} um away from cubics", 1e3 * deviation_mm);
        let remedy = "give a motion of planish axes, whose axes do not jump";
        return Err(Invalid::whole("coefficient_mm_or_deg", problem, remedy));
    }
    let trajectory = Trajectory::new(break_time_s, coefficient, tool_on, dwell_index)?;
    let report = ContactReport {
        segment_count: trajectory.len(),
        deviation_um: 1e3 * deviation_mm,
        total_time_s: trajectory.total_time_s(),
    };
    Ok((trajectory, report))
}

fn point(map: &AxisMap, cubics: &[[f64; 4]], u: f64) -> Option<[f64; 2]> {
    let q: Vec<f64> = cubics.iter().map(|c| evaluate(c, u)).collect();
    Some(map.contact(&q)?.point_mm)
}

/// Returns position and velocity of the contact point along x and y, at the local time `u` of the cubics of the axes.
/// `None` if the tool meets no surface at `u` or where the difference for the velocity is taken.
fn state(map: &AxisMap, cubics: &[[f64; 4]], u: f64) -> Option<[State; 2]> {
    let q: Vec<f64> = cubics.iter().map(|c| evaluate(c, u)).collect();
    let v: Vec<f64> = cubics.iter().map(|c| evaluate(&derivative(c), u)).collect();
    let p = map.contact(&q)?.point_mm;
    let fastest = v.iter().fold(0.0, |a: f64, b| a.max(b.abs()));
    if fastest == 0.0 {
        return Some(p.map(|mm| [mm, 0.0]));
    }
    let d = WAY / fastest;
    let [ahead, back] = [d, -d].map(|d| {
        let moved: Vec<f64> = q.iter().zip(&v).map(|(q, v)| q + d * v).collect();
        map.contact(&moved)
    });
    let (ahead, back) = (ahead?.point_mm, back?.point_mm);
    Some([0, 1].map(|k| [p[k], (ahead[k] - back[k]) / (2.0 * d)]))
}
