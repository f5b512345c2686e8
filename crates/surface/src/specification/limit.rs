//! A limit as the file of a specification states it.

use planish_types::Invalid;
use serde::{Deserialize, Serialize};

use crate::{quality::Direction, shape::Shape};

/// A limit on one quantity, in one zone, after one shape.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "quantity", rename_all = "snake_case", deny_unknown_fields)]
pub enum Limit {
    /// RMS of the heights. Within periods of a map it is over two dimensions, or along a direction.
    HeightRms {
        /// Name of the zone; absent for all valid pixels.
        #[serde(default)]
        zone: Option<String>,
        /// Shape that is fitted and subtracted before the quantity is measured.
        #[serde(default = "plane")]
        after: Shape,
        /// Direction of the periods; absent for two dimensions of a map.
        #[serde(default)]
        along: Option<Direction>,
        /// Shortest spatial period that counts in the RMS, mm; absent for no lower bound.
        #[serde(default)]
        shortest_period_mm: Option<f64>,
        /// Longest spatial period that counts in the RMS, mm; absent for no upper bound.
        #[serde(default)]
        longest_period_mm: Option<f64>,
        /// Largest allowed value of the quantity, nm.
        at_most_nm: f64,
    },
    /// PV of the heights: largest minus smallest height.
    HeightPv {
        /// Name of the zone; absent for all valid pixels.
        #[serde(default)]
        zone: Option<String>,
        /// Shape that is fitted and subtracted before the quantity is measured.
        #[serde(default = "plane")]
        after: Shape,
        /// Largest allowed value of the quantity, nm.
        at_most_nm: f64,
    },
    /// RMS slope over a base length, or within periods.
    SlopeRms {
        /// Name of the zone; absent for all valid pixels.
        #[serde(default)]
        zone: Option<String>,
        /// Shape that is fitted and subtracted before the quantity is measured.
        #[serde(default = "plane")]
        after: Shape,
        /// Direction of the slope.
        along: Direction,
        /// Base length over which slopes are differences of heights, mm. Measured slopes do not use it.
        #[serde(default)]
        base_mm: Option<f64>,
        /// Shortest spatial period that counts in the RMS, mm; absent for no lower bound.
        #[serde(default)]
        shortest_period_mm: Option<f64>,
        /// Longest spatial period that counts in the RMS, mm; absent for no upper bound.
        #[serde(default)]
        longest_period_mm: Option<f64>,
        /// Largest allowed value of the quantity, nrad.
        at_most_nrad: f64,
    },
    /// Largest deviation of a slope over a base length from the mean slope.
    SlopePeak {
        /// Name of the zone; absent for all valid pixels.
        #[serde(default)]
        zone: Option<String>,
        /// Shape that is fitted and subtracted before the quantity is measured.
        #[serde(default = "plane")]
        after: Shape,
        /// Direction of the slope.
        along: Direction,
        /// Base length over which slopes are differences of heights, mm. Measured slopes do not use it.
        base_mm: f64,
        /// Largest allowed value of the quantity, nrad.
        at_most_nrad: f64,
    },
    /// Line A / f^B that the power spectral density of the heights must not exceed.
    Psd {
        /// Name of the zone; absent for all valid pixels.
        #[serde(default)]
        zone: Option<String>,
        /// Shape that is fitted and subtracted before the quantity is measured.
        #[serde(default = "plane")]
        after: Shape,
        /// Direction of the spectrum; `radial` for the mean over rings.
        along: Direction,
        /// A of the line A / f^B, nm^2 mm^(1-B) along a direction, nm^2 mm^(2-B) over rings.
        a: f64,
        /// B of that line, the exponent.
        b: f64,
        /// Lowest and highest frequency at which the line holds, 1/mm.
        frequency_per_mm: [f64; 2],
    },
    /// Strehl ratio after Marechal, from the RMS of the heights.
    Strehl {
        /// Name of the zone; absent for all valid pixels.
        #[serde(default)]
        zone: Option<String>,
        /// Shape that is fitted and subtracted before the quantity is measured.
        #[serde(default = "plane")]
        after: Shape,
        /// Wavelength of the light, nm.
        wavelength_nm: f64,
        /// Grazing angle, mrad; absent for normal incidence.
        #[serde(default)]
        grazing_mrad: Option<f64>,
        /// Smallest allowed Strehl ratio, 0 to 1.
        at_least: f64,
    },
    /// Magnitude of the radius of the best cylinder along a direction, or of the best sphere.
    Radius {
        /// Name of the zone; absent for all valid pixels.
        #[serde(default)]
        zone: Option<String>,
        /// Direction along which the cylinder is curved; `radial` for the sphere.
        along: Direction,
        /// Smallest allowed magnitude of the radius, m.
        at_least_m: f64,
    },
    /// Lag at which the autocorrelation of the heights falls to 1/e.
    AutocorrelationLength {
        /// Name of the zone; absent for all valid pixels.
        #[serde(default)]
        zone: Option<String>,
        /// Shape that is fitted and subtracted before the quantity is measured.
        #[serde(default = "plane")]
        after: Shape,
        /// Direction of the lag.
        along: Direction,
        /// Smallest allowed lag, mm.
        at_least_mm: f64,
    },
}

fn plane() -> Shape {
    Shape::Plane
}

impl Limit {
    /// Checks the numbers and the combination of keys of this limit, which is limit `i` of the specification: base or
    /// periods of a slope, a period with a direction, and what [`Self::check_periods`] checks.
    pub(super) fn check(&self, i: usize) -> Result<(), Invalid> {
        let refuse =
            |problem: String, remedy: &str| Err(Invalid::at_index("limits", i, problem, remedy));
        for (key, value) in self.positive() {
            if !(value.is_finite() && value > 0.0) {
                return refuse(format!("{key} is {value}"), "give a finite number above 0");
            }
        }
        match self {
            Self::SlopeRms { base_mm, shortest_period_mm, longest_period_mm, .. } => {
                let has_period = shortest_period_mm.is_some() || longest_period_mm.is_some();
                let problem = match (base_mm.is_some(), has_period) {
                    (true, true) => "base_mm and periods are both given",
                    (false, false) => "neither base_mm nor a period is given",
                    _ => return self.check_periods(i),
                };
                return refuse(problem.into(), "a slope error is over a base, or over periods");
            }
            Self::HeightRms {
                along, shortest_period_mm: None, longest_period_mm: None, ..
            } if along.is_some() => {
                let remedy = "give a period, or leave `along` out";
                return refuse("along is given without a period".into(), remedy);
            }
            Self::Psd { b, frequency_per_mm: [low, high], .. } => {
                if !b.is_finite() {
                    return refuse(format!("b is {b}"), "give a finite number");
                }
                if !(low.is_finite() && high.is_finite() && *low > 0.0 && low < high) {
                    let problem = format!("frequency_per_mm is {low} .. {high}");
                    return refuse(problem, "give 0 < from < to in 1/mm");
                }
            }
            _ => {}
        }
        self.check_periods(i)
    }

    /// Refuses periods of this limit (limit `i` of the specification) that do not ascend, and the radial direction for
    /// other quantities than a PSD, an RMS height or a radius.
    fn check_periods(&self, i: usize) -> Result<(), Invalid> {
        let refuse =
            |problem: String, remedy: &str| Err(Invalid::at_index("limits", i, problem, remedy));
        if let Some([shortest, longest]) = self.periods().filter(|[s, l]| s >= l) {
            let problem = format!("the periods are {shortest} .. {longest} mm");
            return refuse(problem, "give shortest_period_mm < longest_period_mm");
        }
        let radial = self.direction() == Some(Direction::Radial);
        let has_rings =
            matches!(self, Self::Psd { .. } | Self::HeightRms { .. } | Self::Radius { .. });
        if radial && !has_rings {
            return refuse("along is \"radial\"".into(), "give \"x\" or \"y\"");
        }
        Ok(())
    }

    /// Returns the name of the zone; `None` for all valid pixels.
    pub(super) fn zone(&self) -> Option<&str> {
        match self {
            Self::HeightRms { zone, .. }
            | Self::HeightPv { zone, .. }
            | Self::SlopeRms { zone, .. }
            | Self::SlopePeak { zone, .. }
            | Self::Psd { zone, .. }
            | Self::Strehl { zone, .. }
            | Self::Radius { zone, .. }
            | Self::AutocorrelationLength { zone, .. } => zone.as_deref(),
        }
    }

    /// Returns the shape that is subtracted before the quantity is measured. For a limit on a radius it is the shape
    /// that has the radius.
    pub(super) fn after(&self) -> Shape {
        match self {
            Self::HeightRms { after, .. }
            | Self::HeightPv { after, .. }
            | Self::SlopeRms { after, .. }
            | Self::SlopePeak { after, .. }
            | Self::Psd { after, .. }
            | Self::Strehl { after, .. }
            | Self::AutocorrelationLength { after, .. } => *after,
            Self::Radius { along: Direction::X, .. } => Shape::CylinderX,
            Self::Radius { along: Direction::Y, .. } => Shape::CylinderY,
            Self::Radius { along: Direction::Radial, .. } => Shape::Sphere,
        }
    }

    /// Returns the direction of the quantity, or `None` if it has none.
    pub(super) fn direction(&self) -> Option<Direction> {
        match self {
            Self::HeightRms { along, .. } => *along,
            Self::SlopeRms { along, .. }
            | Self::SlopePeak { along, .. }
            | Self::Psd { along, .. }
            | Self::Radius { along, .. }
            | Self::AutocorrelationLength { along, .. } => Some(*along),
            Self::HeightPv { .. } | Self::Strehl { .. } => None,
        }
    }

    /// Returns the shortest and the longest period that count, mm; 0 and infinity if not given. `None` if neither is
    /// given.
    pub(super) fn periods(&self) -> Option<[f64; 2]> {
        match self {
            Self::HeightRms { shortest_period_mm, longest_period_mm, .. }
            | Self::SlopeRms { shortest_period_mm, longest_period_mm, .. }
                if shortest_period_mm.is_some() || longest_period_mm.is_some() =>
            {
                Some([
                    shortest_period_mm.unwrap_or(0.0),
                    longest_period_mm.unwrap_or(f64::INFINITY),
                ])
            }
            _ => None,
        }
    }

    /// Returns the keys and values of the limit that must be above 0.
    fn positive(&self) -> Vec<(&'static str, f64)> {
        let mut all = match self {
            Self::HeightRms { at_most_nm, .. } | Self::HeightPv { at_most_nm, .. } => {
                vec![("at_most_nm", *at_most_nm)]
            }
            Self::SlopeRms { at_most_nrad, .. } => vec![("at_most_nrad", *at_most_nrad)],
            Self::SlopePeak { at_most_nrad, base_mm, .. } => {
                vec![("at_most_nrad", *at_most_nrad), ("base_mm", *base_mm)]
            }
            Self::Psd { a, .. } => vec![("a", *a)],
            Self::Strehl { wavelength_nm, grazing_mrad, at_least, .. } => {
                let mut all = vec![("wavelength_nm", *wavelength_nm), ("at_least", *at_least)];
                all.extend(grazing_mrad.map(|angle| ("grazing_mrad", angle)));
                all
            }
            Self::Radius { at_least_m, .. } => vec![("at_least_m", *at_least_m)],
            Self::AutocorrelationLength { at_least_mm, .. } => vec![("at_least_mm", *at_least_mm)],
        };
        if let Self::SlopeRms { base_mm: Some(base_mm), .. } = self {
            all.push(("base_mm", *base_mm));
        }
        if let Self::HeightRms { shortest_period_mm, longest_period_mm, .. }
        | Self::SlopeRms { shortest_period_mm, longest_period_mm, .. } = self
        {
            all.extend(shortest_period_mm.map(|mm| ("shortest_period_mm", mm)));
            all.extend(longest_period_mm.map(|mm| ("longest_period_mm", mm)));
        }
        all
    }
}
