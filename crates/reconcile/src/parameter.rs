//! Parameters of machine and tool that a run determines.

use planish_simulate::{
    deviation::has_one_ellipse,
    error_budget::{Effect, ErrorBudget, Kind, Scalar},
};
use planish_types::{Invalid, Tif};
use serde::Serialize;

/// Parameter of machine or tool. Its meaning and sign are those of the error of the same name in an error budget; 0 is
/// the plan.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Parameter {
    /// Relative excess of the removal rate over that of the TIF.
    RateScale,
    /// Displacement of the tool along x against the map, mm.
    OffsetX,
    /// Displacement of the tool along y against the map, mm.
    OffsetY,
    /// Rotation of the axes against the map about its middle, from x to y, rad.
    Rotation,
    /// Relative excess of the machine's lengths over those of the map, from the middle of the map.
    Magnification,
    /// Relative excess of the width of the TIF, at the same volumetric removal rate.
    TifWidth,
    /// Ellipticity of the TIF along x: it is longer along x by half of this fraction, and shorter along y.
    TifEllipticity,
    /// Ellipticity of the TIF along the diagonal x = y: it is longer along it by half of this fraction, and shorter
    /// across.
    TifDiagonalEllipticity,
    /// Relative drift of the rate: its linear rise from the start to the end of the run, about the middle of the run.
    RateDrift,
}

/// All parameters, in the order of the report.
pub const ALL: [Parameter; 9] = [
    Parameter::RateScale,
    Parameter::OffsetX,
    Parameter::OffsetY,
    Parameter::Rotation,
    Parameter::Magnification,
    Parameter::TifWidth,
    Parameter::TifEllipticity,
    Parameter::TifDiagonalEllipticity,
    Parameter::RateDrift,
];

impl Parameter {
    /// Returns the name of the parameter on the command line and in the manifest.
    pub fn name(self) -> &'static str {
        match self {
            Self::RateScale => "rate_scale",
            Self::OffsetX => "offset_x",
            Self::OffsetY => "offset_y",
            Self::Rotation => "rotation",
            Self::Magnification => "magnification",
            Self::TifWidth => "tif_width",
            Self::TifEllipticity => "tif_ellipticity",
            Self::TifDiagonalEllipticity => "tif_diagonal_ellipticity",
            Self::RateDrift => "rate_drift",
        }
    }

    /// Returns the unit in which reports state the parameter, and the size of that unit in the unit of the calculation
    /// (mm, rad or a fraction).
    pub fn unit(self) -> (&'static str, f64) {
        match self {
            Self::OffsetX | Self::OffsetY => ("mm", 1.0),
            Self::Rotation => ("deg", std::f64::consts::PI / 180.0),
            _ => ("%", 0.01),
        }
    }

    /// Returns the effect of the parameter on a simulated run; `None` for the rate, which is a factor of the removal.
    pub fn effect(self) -> Option<Scalar> {
        Some(match self {
            Self::RateScale => return None,
            Self::OffsetX => Scalar::OffsetX,
            Self::OffsetY => Scalar::OffsetY,
            Self::Rotation => Scalar::Rotation,
            Self::Magnification => Scalar::Magnification,
            Self::TifWidth => Scalar::TifWidth,
            Self::TifEllipticity => Scalar::TifEllipticity,
            Self::TifDiagonalEllipticity => Scalar::TifDiagonalEllipticity,
            Self::RateDrift => Scalar::RateDrift,
        })
    }

    /// Returns true if the parameter is meaningful for the tool `tif`: a spot that turns has no ellipticity along axes
    /// of the part.
    pub fn is_of(self, tif: &Tif) -> bool {
        let is_ellipse = matches!(self, Self::TifEllipticity | Self::TifDiagonalEllipticity);
        !is_ellipse || has_one_ellipse(tif)
    }

    /// Returns the scale (standard deviation) of the parameter if nothing is known of the machine: 10 % for the rate,
    /// its drift, and the width and ellipticities of the TIF, 0.5 mm for an offset, 0.5 degrees for the rotation, and 1
    /// % for the magnification.
    pub fn usual_scale(self) -> f64 {
        match self {
            Self::RateScale | Self::TifWidth | Self::TifEllipticity => 0.1,
            Self::TifDiagonalEllipticity | Self::RateDrift => 0.1,
            Self::OffsetX | Self::OffsetY => 0.5,
            Self::Rotation => 0.5 * std::f64::consts::PI / 180.0,
            Self::Magnification => 0.01,
        }
    }

    /// Returns the scale of the parameter by an error budget: the root of the sum of squares of the sizes of its
    /// errors. Without such errors it is the usual scale, but an ellipticity along the diagonal has that along x.
    pub fn scale_in(self, process: &ErrorBudget) -> f64 {
        let mut sum = sum_of_squares(process, self.scalar());
        // An ellipticity of no stated direction has that size along the diagonal, too.
        if sum == 0.0 && self == Self::TifDiagonalEllipticity {
            sum = sum_of_squares(process, Scalar::TifEllipticity);
        }
        if sum > 0.0 { sum.sqrt() } else { self.usual_scale() }
    }

    /// Returns the effect in an error budget that has the meaning of this parameter.
    pub fn scalar(self) -> Scalar {
        self.effect().unwrap_or(Scalar::RateScale)
    }

    /// Returns the kind of error in an error budget that has the meaning of this parameter.
    pub fn kind(self) -> Kind {
        match self {
            Self::RateScale => Kind::RateScale,
            Self::OffsetX => Kind::OffsetX,
            Self::OffsetY => Kind::OffsetY,
            Self::Rotation => Kind::Rotation,
            Self::Magnification => Kind::Magnification,
            Self::TifWidth => Kind::TifWidth,
            Self::TifEllipticity => Kind::TifEllipticity,
            Self::TifDiagonalEllipticity => Kind::TifDiagonalEllipticity,
            Self::RateDrift => Kind::RateDrift,
        }
    }

    /// Returns the parameter with this name; `None` if there is none.
    pub fn named(name: &str) -> Option<Self> {
        ALL.into_iter().find(|p| p.name() == name)
    }
}

/// Returns the sum of squares of the sizes of the errors with the effect `scalar`, in the unit of the calculation
/// squared.
fn sum_of_squares(process: &ErrorBudget, scalar: Scalar) -> f64 {
    let errors = process.errors.iter().filter(|e| e.effect == Effect::Scalar(scalar));
    errors.map(|e| e.size * e.size).sum::<f64>()
}

/// Refuses names in `setting` that are neither a parameter nor a term of the metrology.
pub(crate) fn check_names(setting: &'static str, names: &[String]) -> Result<(), Invalid> {
    let terms = crate::metrology::NAMES;
    for (i, name) in names.iter().enumerate() {
        if Parameter::named(name).is_none() && !terms.contains(&name.as_str()) {
            let known: Vec<&str> = ALL.iter().map(|p| p.name()).chain(terms).collect();
            let remedy = format!("give one of {}", known.join(", "));
            return Err(Invalid::at_index(setting, i, format!("is {name:?}"), remedy));
        }
    }
    Ok(())
}
