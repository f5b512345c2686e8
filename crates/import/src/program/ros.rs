//! ROS message `trajectory_msgs/JointTrajectory` as JSON: `joint_names`, and `points` with `positions`, `velocities`
//! and `time_from_start`. Prismatic joints are in m and m/s, revolute ones in rad and rad/s. The names `secs` and
//! `nsecs` of ROS 1 are read, too.
//!
//! Between two points the motion is the cubic through positions and velocities, per joint. If the first point is later
//! than 0, the controller begins where the joints stand, at rest: the configuration has to state that position.
//!
//! The program switches no tool: it is on throughout.
//!
//! Source: trajectory_msgs/JointTrajectory, JointTrajectoryPoint, builtin_interfaces/Duration; ros2_control,
//! joint_trajectory_controller, *Trajectory Representation*.

use planish_types::{AxesMotion, Invalid};
use serde::Deserialize;

use super::{Knot, Layout, needed, through};

/// Nanoseconds of a second.
const NANOSECONDS: u32 = 1_000_000_000;

/// The message. Unknown fields are refused, because they could change the motion.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct JointTrajectory {
    #[serde(default)]
    header: Header,
    joint_names: Vec<String>,
    points: Vec<RosPoint>,
}

/// The header of the message.
#[derive(Default, Deserialize)]
#[serde(deny_unknown_fields)]
struct Header {
    #[serde(default, rename = "seq")]
    _seq: u32,
    #[serde(default)]
    stamp: Moment,
    #[serde(default, rename = "frame_id")]
    _frame_id: String,
}

/// A point of the message: one number per joint, in the order of `joint_names`.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RosPoint {
    positions: Vec<f64>,
    #[serde(default)]
    velocities: Vec<f64>,
    #[serde(default)]
    accelerations: Vec<f64>,
    #[serde(default)]
    effort: Vec<f64>,
    time_from_start: Moment,
}

/// A time in seconds and nanoseconds.
#[derive(Clone, Copy, Default, Deserialize)]
#[serde(deny_unknown_fields)]
struct Moment {
    #[serde(alias = "secs")]
    sec: i32,
    #[serde(alias = "nsecs")]
    nanosec: u32,
}

/// Reads the motion of the message, with a cubic per joint between two points. Refuses text that is no such message,
/// joints other than the axes of `layout`, points without velocities or with accelerations or effort, times that do not
/// ascend, a stamp, a velocity at the end, and an absent start position if the first point is later than 0.
pub(super) fn read(text: &str, layout: &Layout) -> Result<AxesMotion, Invalid> {
    let message: JointTrajectory = serde_json::from_str(text).map_err(|e| {
        let remedy = "give the message itself as JSON; of YAML: python3 -c 'import json,sys,yaml; \
                      json.dump(yaml.safe_load(sys.stdin),sys.stdout)'";
        Invalid::whole("program", format!("is no JointTrajectory: {e}"), remedy)
    })?;
    let stamp = message.header.stamp;
    if (stamp.sec, stamp.nanosec) != (0, 0) {
        let problem = format!(
            "is {} s and {} ns: the motion begins at this time of a clock",
            stamp.sec, stamp.nanosec
        );
        return Err(Invalid::whole(
            "header.stamp",
            problem,
            "give 0, to begin when the message arrives",
        ));
    }
    let column = columns(&message.joint_names, layout)?;
    let mut knots: Vec<Knot> = Vec::with_capacity(message.points.len() + 1);
    for (i, point) in message.points.iter().enumerate() {
        check(point, i, layout.len())?;
        let time_s = seconds(point.time_from_start, i)?;
        if i == 0 && time_s > 0.0 {
            let position = needed("start_mm", layout.start.clone())?;
            knots.push(Knot {
                time_s: 0.0,
                position,
                velocity: vec![0.0; layout.len()],
                tool_on: true,
            });
        }
        if knots.last().is_some_and(|before| before.time_s >= time_s) {
            let problem = format!("is at {time_s} s, which is not later than the point before");
            return Err(Invalid::at_index("points", i, problem, "give times that ascend"));
        }
        let position = in_units(&point.positions, &column, layout);
        let velocity = in_units(&point.velocities, &column, layout);
        knots.push(Knot { time_s, position, velocity, tool_on: true });
    }
    if let Some(last) =
        message.points.last().filter(|last| last.velocities.iter().any(|v| *v != 0.0))
    {
        let problem = format!("ends with the velocities {:?} m/s or rad/s", last.velocities);
        return Err(Invalid::whole(
            "program",
            problem,
            "end it at rest: the controller stops there",
        ));
    }
    through(&knots)
}

/// Returns the index among `joints` of every axis of `layout`, in the order of its axes. Refuses other joints than
/// these axes.
fn columns(joints: &[String], layout: &Layout) -> Result<Vec<usize>, Invalid> {
    let columns = layout.names.iter().map(|name| joints.iter().position(|joint| joint == name));
    match columns.collect::<Option<Vec<usize>>>() {
        Some(columns) if joints.len() == layout.len() => Ok(columns),
        _ => {
            let remedy = format!(
                "give each of the axes {} once, as in the machine file",
                layout.names.join(", ")
            );
            Err(Invalid::whole("joint_names", format!("are {joints:?}"), remedy))
        }
    }
}

/// Refuses a point whose numbers are not one position and one velocity per joint, of which there are `joints`. `i` is
/// its index.
fn check(point: &RosPoint, i: usize, joints: usize) -> Result<(), Invalid> {
    for (name, list) in [("positions", &point.positions), ("velocities", &point.velocities)] {
        if list.len() != joints {
            let problem = format!("has {} {name} for {joints} joints", list.len());
            let remedy = "give one position and one velocity per joint: without velocities the motion is no cubic";
            return Err(Invalid::at_index("points", i, problem, remedy));
        }
    }
    for (name, list) in [("accelerations", &point.accelerations), ("effort", &point.effort)] {
        if !list.is_empty() {
            let remedy = format!("leave out `{name}`: with it the motion is no cubic");
            return Err(Invalid::at_index("points", i, format!("has {name}"), remedy));
        }
    }
    Ok(())
}

/// Returns the time in s. Refuses negative seconds, and nanoseconds that are a second or more; `i` is the index of the
/// point.
fn seconds(moment: Moment, i: usize) -> Result<f64, Invalid> {
    let Moment { sec, nanosec } = moment;
    if sec < 0 || nanosec >= NANOSECONDS {
        let problem = format!("has the time_from_start {sec} s and {nanosec} ns");
        let remedy = "give seconds from 0 and nanoseconds below 1000000000";
        return Err(Invalid::at_index("points", i, problem, remedy));
    }
    Ok(f64::from(sec) + f64::from(nanosec) / f64::from(NANOSECONDS))
}

/// Returns the numbers of a point in mm or degrees, or these per second, in the order of the axes.
fn in_units(numbers: &[f64], column: &[usize], layout: &Layout) -> Vec<f64> {
    let units = layout.units.iter().zip(column);
    units
        .map(|(unit, j)| if unit == "deg" { numbers[*j].to_degrees() } else { numbers[*j] * 1e3 })
        .collect()
}
