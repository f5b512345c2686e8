//! Types that the stages exchange. Constructors check a value once, when it is made; from then on
//! its type guarantees that it is valid.
//!
//! | type | contents | array shape |
//! |---|---|---|
//! | [`Axis`], [`Grid`] | uniform, ascending pixel centres in mm | (nx), (ny) |
//! | [`Surface`] | height in nm, NaN where invalid | (ny, nx) |
//! | [`ClearAperture`] | the region that counts | mask (ny, nx) |
//! | [`Tif`] | removal rate in nm/s at the offset (pixel - tool) | (my, mx) |
//! | [`Variation`] | variation of the TIF over the part, and in time | kernels (k, my, mx), weights (k, ny, nx) |
//! | [`ToolPath`] | velocity control points, dwell points in mm | (n+1, 2), (n, 2) |
//! | [`DwellTime`] | seconds per dwell point | (n) |
//! | [`DwellDensity`] | dwell-time density in s/mm at nodes along the path | (m) |
//! | [`Limits`] | limits of the machine's axes | - |
//! | [`Machine`] | a machine: limits, travel, kinematics, and how a part lies on it | - |
//! | [`ControllerModel`] | grids of times, positions and velocities of a controller, and its motion between nodes | - |
//! | [`Trajectory`] | piecewise cubic motion in segment-local time | (k, 2, 4) |
//! | [`PathDistance`] | largest distance of a motion from its tool path in mm | - |
//! | [`AxesMotion`] | piecewise cubic motion of all axes of a machine | (k, n, 4) |
//! | [`Transform`] | position of a part on a machine, with its covariance | (2, 2), (6, 6) |
//! | [`Part`] | name, number, date and operator, as a user states them | - |
//! | [`Rack`] | tools of a lab, from which a plan of several tools is made | - |
//! | [`reach::Reach`] | waves of a map that none of its tools reaches | mask (ny, nx) |
//! | [`Removal`] | predicted removal and residual in nm | (ny, nx) |

mod aperture;
mod axes_motion;
mod baseline;
pub mod budget;
mod controller;
pub mod controller_lines;
pub mod doubts;
mod dwell_density;
mod dwell_time;
mod end;
pub mod file_text;
mod grid;
mod heading;
mod kinematics;
mod limits;
mod machine;
pub mod outcome;
mod part;
mod path_distance;
pub mod plausible;
pub mod progress;
mod rack;
pub mod reach;
mod regression;
mod surface;
pub mod text;
mod tif;
mod tif_lattice;
mod tool_path;
mod trajectory;
mod transform;
pub mod units;
mod variation;

pub use aperture::ClearAperture;
pub use axes_motion::AxesMotion;
pub use controller::{
    AxisGrid, ControllerFile, ControllerKind, ControllerModel, Counts, Interpolation,
};
pub use controller_lines::{ControllerLines, check_line};
pub use dwell_density::{DensityNodes, DwellDensity};
pub use dwell_time::DwellTime;
pub use end::End;
pub use grid::{Axis, Grid, is_plausible_mm};
pub use heading::{Headings, headings_of_path_rad};
pub use kinematics::{
    ContactLimits, Kinematics, KinematicsFile, MachineAxis, MachineFileRotaryAxis, Tilt,
};
pub use limits::{
    AxisLimits, DEFAULT_TIME_TO_FULL_ACCELERATION_S, Limits, MachineFile, MachineFileAxis,
};
pub use machine::{Machine, assumed_machine};
pub use part::Part;
pub use path_distance::PathDistance;
pub use rack::{Rack, RackEntry, SetupErrors, check_rates};
pub use surface::{Removal, RemovalMaps, Surface};
pub use tif::{Tif, VaryingTif};
pub use tif_lattice::{OnLattice, PARTS_TOLERANCE, TifLattice};
pub use tool_path::ToolPath;
pub use trajectory::{
    Segment, Trajectory, TrajectoryBuilder, break_times, dwell_index_from_stored,
    stored_dwell_index,
};
pub use transform::{Transform, TransformNumbers};
pub use variation::{
    AzimuthWeights, Component, PixelFactor, Pose, TimeFactor, TurnWeights, Variation,
};

/// Characters at the beginning and at the end of a long text that an error keeps.
const LONGEST_END: usize = 500;

/// An input value that the constructor of a type refuses, with the place, the fault and the remedy.
///
/// `array` is the name of the array or field, and `place` the index or its substitute. `problem`
/// states the fault with the value, and `remedy` the correction.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("{array}{place}: {problem}; {remedy}")]
pub struct Invalid {
    /// Name of the array or field.
    pub array: &'static str,
    /// Index in brackets, or empty for the whole array.
    pub place: String,
    /// The fault in words, with the offending value.
    pub problem: String,
    /// The correction that the user can make.
    pub remedy: String,
}

/// A numerical method that ended before its residual reached its tolerance.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error(
    "{method} has not converged: after {iterations} iterations {residual_of} is {residual:.3e}; {remedy}"
)]
pub struct NotConverged {
    /// Name of the numerical method.
    pub method: &'static str,
    /// Number of iterations that were done.
    pub iterations: usize,
    /// Residual at the end, in the unit that `residual_of` states.
    pub residual: f64,
    /// Name of the quantity of `residual`, with the value that would be enough.
    pub residual_of: &'static str,
    /// The correction that the user can make.
    pub remedy: &'static str,
}

impl Invalid {
    /// Returns an error about the array or field as a whole.
    pub fn whole(
        array: &'static str,
        problem: impl Into<String>,
        remedy: impl Into<String>,
    ) -> Self {
        let [problem, remedy] = [legible(problem.into()), legible(remedy.into())];
        Self { array, place: String::new(), problem, remedy }
    }

    /// Returns an error about the element at `index`, a number or a tuple of numbers.
    pub fn at_index(
        array: &'static str,
        index: impl std::fmt::Debug,
        problem: impl Into<String>,
        remedy: impl Into<String>,
    ) -> Self {
        let place = format!("{index:?}").replace(['(', ')'], "");
        let place = format!("[{}]", place.trim_matches(['[', ']']));
        let [problem, remedy] = [legible(problem.into()), legible(remedy.into())];
        Self { array, place, problem, remedy }
    }
}

/// Returns a text that may quote a file without the middle if it is longer than twice [`LONGEST_END`] characters.
fn legible(text: String) -> String {
    let count = text.chars().count();
    if count <= 2 * LONGEST_END {
        return text;
    }
    let start: String = text.chars().take(LONGEST_END).collect();
    let end: String = text.chars().skip(count - LONGEST_END).collect();
    format!("{start} ... {end}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_error_that_quotes_a_line_of_another_file_keeps_its_sentence() {
        let problem = format!("has {:?}, which is not understood", "\u{8}".repeat(3000));
        let message = Invalid::at_index("program line", 1, problem, "correct the line").to_string();
        assert!(message.starts_with("program line[1]: has "), "{message}");
        assert!(message.ends_with(", which is not understood; correct the line"), "{message}");
        assert!(message.chars().count() < 2 * LONGEST_END + 100, "{message}");
    }
}
