//! ROS message `trajectory_msgs/JointTrajectory` as JSON, one point per end of a segment: `positions` and
//! `velocities` of every joint, and `time_from_start` in `sec` and `nanosec`. JSON is YAML, too, so that both readers
//! take the file.
//!
//! The units are those of ROS (REP 103): m and m/s of a prismatic joint, rad and rad/s of a revolute one. The joints
//! are the axes of the machine, by their names, in its order.
//!
//! Between two points with positions and velocities, the controller runs the cubic through them; with accelerations it
//! would run a quintic, so the message has none. `header.stamp` is 0: the motion begins when the message arrives. The
//! first point is at the time 0, where the axes stand. From elsewhere it is a leap.
//!
//! Every number of a joint has a decimal point and no exponent: YAML 1.1 reads `1e-7` as a word and `0` as an integer,
//! which a field `float64[]` of a message refuses.
//!
//! The tool: the message has no place for an output, so the host switches it. A motion that lifts the tool is refused.
//!
//! Source: ROS 2, trajectory_msgs/JointTrajectory, trajectory_msgs/JointTrajectoryPoint and builtin_interfaces/Duration
//! (docs.ros.org); ros2_control, joint_trajectory_controller, *Trajectory Representation* (control.ros.org); Universal
//! Robots client library, *Spline Interpolation example* (cubic of positions, velocities and times).

use planish_types::{Invalid, MachineAxis};

use crate::{Abilities, About, Approach, Job, Tool, decimal};

/// Number of decimals of a length in m and a velocity in m/s. Larger: longer lines. Smaller: rounding that the
/// controller may notice. Chosen: counts below 1e-9 mm are refused.
const METRE_DIGITS: usize = 12;

/// Number of decimals of an angle in rad and a velocity in rad/s. No count in degrees is a decimal of a radian, so the
/// last decimal rounds: by 3e-14 degrees at most. Larger: digits that a double does not have. Smaller: rounding that a
/// proof of the limits may notice. Chosen: a double has 1e-16 of a radian.
const RADIAN_DIGITS: usize = 15;

/// Nanoseconds of a second.
const NANOSECONDS: u64 = 1_000_000_000;

/// First number of seconds that the field `sec`, an int32, does not hold.
const FIRST_BEYOND_S: f64 = 2_147_483_648.0;

pub(crate) fn write<const N: usize>(job: &Job<N>) -> Result<(String, About), Invalid> {
    let tick_s = job.tick()?;
    let (q, mut about) = job.nodes(Abilities {
        most_ticks: i64::MAX >> 10,
        tool: Tool::LeftToTheHost(
            "the message cannot switch it: the host switches it on when the motion begins, off when it ends, and off \
             on every stop",
        ),
        approach: Approach::Before(
            "go to the start, tool off, and wait until the joints stand there: the first point is at the time 0, from \
             elsewhere it is a leap. Then send the message once, with spline interpolation in the controller",
        ),
    })?;
    if about.total_time_s >= FIRST_BEYOND_S {
        let problem =
            format!("takes {} s, and `sec` of the message is an int32", about.total_time_s);
        return Err(Invalid::whole("program", problem, "plan fewer lines in one run"));
    }
    let tick_ns = tick_s * NANOSECONDS as f64;
    // A little less or more is the rounding of a number that was typed.
    if (tick_ns - tick_ns.round()).abs() > 1e-9 * tick_ns {
        about.warnings.push(format!(
            "a tick of {tick_s} s is no multiple of a nanosecond, to which the message rounds every time"
        ));
    }
    let axes = job.plan.axes;
    let names: Vec<String> = axes.iter().map(|axis| format!("\"{}\"", axis.name)).collect();
    let mut text = String::from(
        "{\"header\": {\"stamp\": {\"sec\": 0, \"nanosec\": 0}, \"frame_id\": \"\"},\n",
    );
    text += &format!(" \"joint_names\": [{}],\n \"points\": [\n", names.join(", "));
    for k in 0..=about.segments {
        about.marks.add(&text, q.time_s(k), q.position(k));
        let nanoseconds = (q.time_s(k) * NANOSECONDS as f64).round() as u64;
        text += &format!(
            "  {{\"positions\": [{}], \"velocities\": [{}], \
             \"time_from_start\": {{\"sec\": {}, \"nanosec\": {}}}}}{}\n",
            numbers(axes, q.position(k)),
            numbers(axes, q.velocity[k]),
            nanoseconds / NANOSECONDS,
            nanoseconds % NANOSECONDS,
            if k < about.segments { "," } else { "" }
        );
    }
    text += " ]}\n";
    Ok((text, about))
}

/// Returns one number per axis, in mm or degrees or their velocities, as the list of the message: in m or rad,
/// separated by commas.
fn numbers<const N: usize>(axes: &[MachineAxis; N], list: [f64; N]) -> String {
    let numbers = axes.iter().zip(list).map(|(axis, v)| {
        let number = if axis.is_rotary {
            decimal(v.to_radians(), RADIAN_DIGITS)
        } else {
            decimal(v / 1e3, METRE_DIGITS)
        };
        if number.contains('.') { number } else { number + ".0" }
    });
    numbers.collect::<Vec<_>>().join(", ")
}
