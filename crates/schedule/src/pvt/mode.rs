//! Modes of PVT: the objective of the motion, and the default of a machine.

use planish_types::Limits;
use serde::Serialize;

use crate::claim::Claim;

/// Objective of a PVT motion.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Mode {
    /// Least acceleration energy (the integral of the squared acceleration).
    Smooth,
    /// Least acceleration energy without reversal of an axis inside a segment.
    Monotone,
}

/// Choice of a [`Mode`], or of the default of the machine.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum ModeChoice {
    /// Monotone; smooth if the machine has a limit on jerk, which only smooth keeps.
    #[default]
    Auto,
    /// Least acceleration energy; may overshoot corners by up to the tolerance of the path; keeps a limit on jerk.
    Smooth,
    /// Least acceleration energy without reversal inside a segment; its acceleration steps.
    Monotone,
}

impl ModeChoice {
    /// Returns the mode for this machine.
    pub fn on(self, machine: &Limits) -> Mode {
        match self {
            Self::Auto => Mode::within(machine),
            Self::Smooth => Mode::Smooth,
            Self::Monotone => Mode::Monotone,
        }
    }
}

impl Mode {
    /// Returns the name of the mode in settings and messages.
    pub fn name(self) -> &'static str {
        match self {
            Self::Smooth => "smooth",
            Self::Monotone => "monotone",
        }
    }

    /// Returns the mode that would keep the limit on jerk, *smooth*; `None` if this mode is *smooth* already, or if the
    /// claim of the motion does not break the limit.
    pub fn for_jerk(self, claim: &Claim) -> Option<Self> {
        if self == Self::Monotone && claim.jerk == Some(false) { Some(Self::Smooth) } else { None }
    }

    /// Returns the default mode of a machine: monotone, which never leaves the box spanned by the ends of a segment. It
    /// is smooth if the machine limits jerk, because the acceleration of monotone motions steps.
    pub fn within(limits: &Limits) -> Self {
        if limits.axes().iter().any(|axis| axis.max_jerk_mm_per_s3().is_some()) {
            Self::Smooth
        } else {
            Self::Monotone
        }
    }
}
