//! Motion of all axes of a machine from the motion of the contact point, and back.
//!
//! A plan is a motion of the contact point in the plane of the part. The axes of a machine with more than x and y
//! follow a nonlinear map of it (`planish_kinematics`). They interpolate by cubics between nodes, as a controller does,
//! so that the executed contact point leaves the path a little between the nodes.
//!
//! | module | contents |
//! |---|---|
//! | `piece` | cubics of all axes between nodes, near the path |
//! | `slow` | stretch of the time where an axis would exceed a limit |
//! | [`motion`] | motion of the axes, with its report |
//! | [`contact`] | executed contact point of a motion of the axes |

// The command line names this library as any other program does.
extern crate self as planish_axes;

mod cli;
pub mod command;
mod contact;
mod motion;
mod piece;
mod slow;

use planish_types::Invalid;
use serde::Serialize;

pub use contact::{ContactReport, contact};
pub use motion::motion;
pub use planish_types::outcome::axes::{MotionReport, SlowedReport, SpindleReport};

/// Smallest and largest tolerance of the contact point that is accepted, um. Above the largest, the distance changes
/// the removal. Below the smallest, rounding of coordinates asks for more pieces than memory has. Chosen.
const TOLERANCES_UM: [f64; 2] = [1e-3, 1e3];

/// Settings of a motion of the axes.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct MotionSettings {
    /// Largest distance of the executed contact point from the path, um. Default 2 um: far below the width of a TIF.
    pub contact_tolerance_um: f64,
}

impl Default for MotionSettings {
    fn default() -> Self {
        Self { contact_tolerance_um: 2.0 }
    }
}

impl MotionSettings {
    fn check(&self) -> Result<(), Invalid> {
        let [least, most] = TOLERANCES_UM;
        if (least..=most).contains(&self.contact_tolerance_um) {
            return Ok(());
        }
        let problem = format!("is {}", self.contact_tolerance_um);
        let remedy = format!("give um, from {least} to {most}");
        Err(Invalid::whole("contact_tolerance_um", problem, remedy))
    }
}
