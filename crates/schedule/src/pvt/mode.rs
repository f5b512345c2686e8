//! What a motion shall be like.

use planish_types::Limits;
use serde::Serialize;

use crate::claim::Claim;

/// What the motion shall be like.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Mode {
    /// Least acceleration energy.
    Smooth,
    /// Least acceleration energy without reversal inside a segment.
    Monotone,
}

/// A [`Mode`], or the one that suits the machine.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "cli", derive(clap::ValueEnum))]
pub enum ModeChoice {
    /// Monotone, or smooth where the machine has a limit on jerk, which only that mode keeps.
    #[default]
    Auto,
    /// Least acceleration energy; may overshoot corners; keeps a limit on jerk.
    Smooth,
    /// Least acceleration energy without reversal inside a segment; its acceleration steps.
    Monotone,
}

impl ModeChoice {
    /// The mode on this machine.
    pub fn on(self, machine: &Limits) -> Mode {
        match self {
            Self::Auto => Mode::within(machine),
            Self::Smooth => Mode::Smooth,
            Self::Monotone => Mode::Monotone,
        }
    }
}

impl Mode {
    /// As it is called in settings and messages.
    pub fn name(self) -> &'static str {
        match self {
            Self::Smooth => "smooth",
            Self::Monotone => "monotone",
        }
    }

    /// The mode that keeps the limit on jerk, where the motion of this one breaks it.
    pub fn for_jerk(self, claim: &Claim) -> Option<Self> {
        (self == Self::Monotone && claim.jerk == Some(false)).then_some(Self::Smooth)
    }

    /// The mode for a machine where none is asked for: monotone, which never leaves the box of a segment;
    /// where the machine limits jerk, smooth, because the acceleration of monotone motions steps.
    pub fn within(limits: &Limits) -> Self {
        match limits.axes().iter().any(|axis| axis.max_jerk_mm_per_s3().is_some()) {
            true => Self::Smooth,
            false => Self::Monotone,
        }
    }
}
