//! Distance of a plan from its path, which a program must not exceed while the tool is on.

use planish_handoff::{Failure, Inputs, flags::NearPathArgs, say, warn, with_flags};
use planish_types::PathDistance;

use super::MotionInput;

/// Returns the distance of the plan from its path; `None` if no path is given and the manifest of the plan does not
/// state it.
///
/// # Errors
///
/// Fails for a plan that leaves its path by more than the tolerance, for a path of another plan, and for a path beside
/// a motion of all axes, whose manifest states the distance.
pub(super) fn checked(
    flags: &NearPathArgs,
    motion: &MotionInput,
    inputs: &mut Inputs,
) -> Result<Option<PathDistance>, Failure> {
    let (dir, distance) = match motion {
        MotionInput::Trajectory(dir, on_axes) => (dir, flags.measure(on_axes, inputs)?),
        MotionInput::Axes(_) if flags.tool_path.is_some() => {
            return Err(Failure::new(
                "--tool-path: is for a motion of x and y; of --axes, planish axes motion states the distance of the \
                 contact point",
            ));
        }
        MotionInput::Axes(axes) => (&axes.dir, flags.stated(axes.manifest.as_ref())?),
    };
    match distance.and_then(|distance| distance.excess()) {
        None => Ok(distance),
        Some(excess) => Err(Failure::new(with_flags(&format!(
            "{}: {excess}; plan by planish schedule pvt, which stays within it, or give a larger tolerance that is \
             harmless on this part",
            dir.display()
        )))),
    }
}

/// Prints the distance of the plan from its path, or warns that it is unknown.
pub(super) fn tell(distance: Option<&PathDistance>) {
    match distance {
        Some(distance) => say(format!("the plan is {distance}")),
        None => warn("how far the plan leaves its path is not known: give --tool-path"),
    }
}
