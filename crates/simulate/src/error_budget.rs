//! The error budget: the errors of a process, as its file states them.
//!
//! ```json
//! { "name": "ion beam",
//!   "errors": [
//!     { "kind": "rate_scale", "size": 1, "unit": "%", "distribution": "normal", "note": "rate of the day" },
//!     { "kind": "rate_noise", "size": 1, "unit": "%", "distribution": "normal", "correlation_s": 20, "note": "" }
//!   ] }
//! ```
//!
//! The size is the standard deviation of a normal error, half the width of a uniform one, and the value of one
//! that is fixed: known, but not corrected. A tick is uniform, and its size is the whole tick.

pub use planish_types::outcome::tolerance::Distribution;
use planish_types::{Invalid, text::significant};
use serde::{Deserialize, Serialize};

use crate::play;

/// Kinds of errors that a budget may state; a file names them in snake case, for example `rate_scale`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    /// Relative error of the removal rate throughout the run.
    RateScale,
    /// Relative rise of the rate from the start to the end of the run, linear and about the middle of the run.
    RateDrift,
    /// Relative lack of the rate at the start of the run, which decays exponentially.
    RateWarmUp,
    /// Relative fluctuation of the rate: an Ornstein-Uhlenbeck process of this standard deviation.
    RateNoise,
    /// Displacement of the tool along x against the map.
    OffsetX,
    /// Displacement of the tool along y against the map.
    OffsetY,
    /// Rotation of the axes against the map about its middle, from x to y.
    Rotation,
    /// Relative excess of the machine's lengths over those of the map, from the middle of the map.
    Magnification,
    /// Shear of the axes: the machine's x grows by this fraction of y, counted from the middle of the map.
    Shear,
    /// Relative excess of the width of the TIF, at the same volumetric removal rate.
    TifWidth,
    /// Ellipticity of the TIF along x: it is longer along x by half of this fraction, and shorter along y.
    TifEllipticity,
    /// Ellipticity of the TIF along the diagonal x = y: it is longer along it by half of this fraction, and shorter
    /// across.
    TifDiagonalEllipticity,
    /// Rotation of the TIF about its centroid, from x to y.
    TifRotation,
    /// Displacement of the TIF along x against the position of the tool.
    TifOffsetX,
    /// Displacement of the TIF along y against the position of the tool.
    TifOffsetY,
    /// Independent displacement of every dwell point, along x and along y.
    PositionNoise,
    /// Delay of the tool: at each time it is where its plan had it this time earlier, to first order in the delay.
    VelocityLag,
    /// Time constant of axes that follow their command as a servo of first order.
    ServoFirstOrder,
    /// Lag at constant velocity of axes that follow their command as a servo of second order.
    ServoSecondOrder,
    /// Time over which the planner of the controller averages the commanded positions.
    Smoothing,
    /// Largest change of the velocity at a corner for which the planner of the controller does not slow down, mm/s.
    CornerSpeed,
    /// Play of each axis: after it turns back, the tool stands until the drive has moved by the play.
    Backlash,
    /// Independent error of the time of every dwell point.
    TimingJitter,
    /// Tick of the controller, which begins and ends its actions at multiples of it.
    TimingTick,
    /// Independent noise of every pixel of the map.
    MapNoise,
    /// Low-order error of the map: Legendre polynomials up to a total degree, piston left out, of this RMS together.
    MapLowOrder,
}

/// An error budget as its file states it, not checked yet.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ErrorBudgetFile {
    /// Name of the process.
    pub name: String,
    /// Errors of the process.
    pub errors: Vec<ErrorFile>,
}

/// An error as the file of the budget states it, not checked yet.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ErrorFile {
    /// Kind of the error.
    pub kind: Kind,
    /// Size of the error, in `unit`.
    pub size: f64,
    /// Unit of the size.
    pub unit: String,
    /// Distribution of the error from run to run; it defines what `size` is, for example the standard deviation.
    pub distribution: Distribution,
    /// Note on where the size comes from, for the reader; no calculation uses it.
    pub note: String,
    /// Correlation time of `rate_noise`, s; absent for other kinds.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub correlation_s: Option<f64>,
    /// Time constant of `rate_warm_up`, s; absent for other kinds.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub time_constant_s: Option<f64>,
    /// Damping ratio of `servo_second_order`; absent for other kinds.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub damping_ratio: Option<f64>,
    /// Acceleration along the path with which the planner slows down at a corner (`corner_speed`), mm/s^2; absent for
    /// other kinds.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub acceleration_mm_per_s2: Option<f64>,
    /// Largest total degree of `map_low_order`; absent for other kinds.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub degree: Option<usize>,
}

/// A checked error budget: it has at least one error, and every size and setting suits its kind.
#[derive(Clone, Debug, PartialEq)]
pub struct ErrorBudget {
    /// Name of the process.
    pub name: String,
    /// Errors of the process.
    pub errors: Vec<ProcessError>,
}

/// A checked error of a budget.
#[derive(Clone, Debug, PartialEq)]
pub struct ProcessError {
    /// The error as the file states it.
    pub stated: ErrorFile,
    /// Size of the error in the unit of the calculation: a fraction, or in mm, rad, s or nm, as its kind has it.
    pub size: f64,
    /// Effect of the error on a run.
    pub effect: Effect,
}

/// Effect of an error on a run, with all numbers that its kind needs.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Effect {
    /// An error that a single number describes.
    Scalar(Scalar),
    /// An error of independent random numbers along the run.
    Noise(Noise),
    /// Low-order error of the map: Legendre polynomials up to a total degree.
    MapLowOrder {
        /// Largest total degree of the polynomials.
        degree: usize,
    },
    /// White noise of the map, independent in every pixel.
    MapNoise,
}

/// Effect of an error that a single number describes.
#[derive(Clone, Copy, Debug, PartialEq)]
#[allow(missing_docs)] // what each is stands at its kind
pub enum Scalar {
    RateScale,
    RateDrift,
    RateWarmUp { time_constant_s: f64 },
    OffsetX,
    OffsetY,
    Rotation,
    Magnification,
    Shear,
    TifWidth,
    TifEllipticity,
    TifDiagonalEllipticity,
    TifRotation,
    VelocityLag,
    ServoFirstOrder,
    ServoSecondOrder { damping_ratio: f64 },
    Smoothing,
    CornerSpeed { acceleration_mm_per_s2: f64 },
    Backlash,
}

impl Scalar {
    /// Returns true if the error delays the axes.
    pub fn is_a_lag(self) -> bool {
        let is_servo = matches!(
            self,
            Self::VelocityLag | Self::ServoFirstOrder | Self::ServoSecondOrder { .. }
        );
        is_servo || self.is_of_planner()
    }

    /// Returns true if the planner of the controller causes the error. Its size is not small, so it has no first order.
    pub fn is_of_planner(self) -> bool {
        matches!(self, Self::Smoothing | Self::CornerSpeed { .. })
    }

    /// Returns true if the maps before and after a run can determine the error. These are the rate, offsets, rotation
    /// and magnification of the motion, and width, ellipticities and rotation of the TIF.
    pub fn is_learnt(self) -> bool {
        match self {
            Self::RateScale
            | Self::OffsetX
            | Self::OffsetY
            | Self::Rotation
            | Self::Magnification
            | Self::TifWidth
            | Self::TifEllipticity
            | Self::TifDiagonalEllipticity
            | Self::TifRotation => true,
            Self::RateDrift
            | Self::RateWarmUp { .. }
            | Self::Shear
            | Self::VelocityLag
            | Self::ServoFirstOrder
            | Self::ServoSecondOrder { .. }
            | Self::Smoothing
            | Self::CornerSpeed { .. }
            | Self::Backlash => false,
        }
    }
}

/// Effect of an error of independent random numbers along the run.
#[derive(Clone, Copy, Debug, PartialEq)]
#[allow(missing_docs)] // what each is stands at its kind
pub enum Noise {
    Rate { correlation_s: f64 },
    Position,
    Jitter,
    Tick,
}

/// Name of a unit that a file may state, and its size in the unit of the calculation.
type Unit = (&'static str, f64);

/// Units in which a file may state a fraction, with their values.
const FRACTIONS: &[Unit] = &[("%", 0.01), ("1", 1.0)];
/// Units in which a file may state a length, with their sizes in mm.
const LENGTHS: &[Unit] = &[("mm", 1.0), ("um", 1e-3)];
/// Units in which a file may state an angle, with their sizes in rad.
const ANGLES: &[Unit] = &[("deg", std::f64::consts::PI / 180.0), ("mrad", 1e-3), ("rad", 1.0)];
/// Units in which a file may state a time, with their sizes in s.
const TIMES: &[Unit] = &[("s", 1.0), ("ms", 1e-3), ("us", 1e-6)];
/// Units in which a file may state a speed, with their sizes in mm/s.
const SPEEDS: &[Unit] = &[("mm/s", 1.0)];
/// Units in which a file may state a height, with their sizes in nm.
const HEIGHTS: &[Unit] = &[("nm", 1.0)];

/// Largest size of an error that is a fraction, dimensionless. A larger one is refused: it is another process, not an
/// error of this one, and a rate could become negative. Smaller: large but real errors are refused.
const LARGEST_FRACTION: f64 = 0.25;
/// Largest size of an error that is an angle, rad. A larger one is refused: the unit is probably wrong. Smaller:
/// large but real errors are refused.
const LARGEST_ANGLE_RAD: f64 = 0.25;
/// Largest size of an error that is a time, s; a larger one is refused as a wrong unit. Smaller: slow servos are
/// refused.
const LARGEST_TIME_S: f64 = 1e3;
/// Largest size of an error that is a length, mm; a larger one is refused as a wrong unit. Smaller: errors on large
/// machines are refused.
const LARGEST_LENGTH_MM: f64 = 1e3;
/// Largest size of a lag or of a servo's time, s; a larger one is refused. Axes with this lag follow frequencies up to
/// about 0.2 Hz, which follows no plan. Larger: wrong units pass. Smaller: slow axes are refused.
const LARGEST_LAG_S: f64 = 1.0;
/// Largest change of the velocity at a corner, mm/s; a larger one is refused as a wrong unit. Smaller: fast machines are
/// refused.
const LARGEST_SPEED_MM_PER_S: f64 = 1e5;
/// Smallest and largest acceleration of a planner along the path, mm/s^2; others are refused as a wrong unit.
const PATH_ACCELERATIONS_MM_PER_S2: [f64; 2] = [1e-3, 1e7];
/// Largest size of an error of the map, nm; a larger one is refused as a wrong unit. Smaller: large but real errors are
/// refused.
const LARGEST_HEIGHT_NM: f64 = 1e6;

/// Largest correlation time or warm-up time, s (a year); a larger one is refused as a wrong unit. Smaller: slow
/// drifts are refused.
const LONGEST_TIME_S: f64 = 3.2e7;

/// Smallest and largest damping ratio; others are refused. Structures of steel have some 0.01 to 0.03, and a servo
/// above 2 is one of first order.
const DAMPING_RATIOS: [f64; 2] = [0.005, 2.0];

/// Largest total degree of the polynomials of a low-order error of the map; higher ones are refused, because a map
/// measures them.
const LARGEST_DEGREE: usize = 8;

impl Kind {
    /// Returns the units in which a file may state the size of this kind, and the largest size in the unit of the
    /// calculation.
    fn units(self) -> (&'static [Unit], f64) {
        use Kind::*;
        match self {
            RateScale
            | RateDrift
            | RateWarmUp
            | RateNoise
            | Magnification
            | Shear
            | TifWidth
            | TifEllipticity
            | TifDiagonalEllipticity => (FRACTIONS, LARGEST_FRACTION),
            OffsetX | OffsetY | TifOffsetX | TifOffsetY | PositionNoise | Backlash => {
                (LENGTHS, LARGEST_LENGTH_MM)
            }
            Rotation | TifRotation => (ANGLES, LARGEST_ANGLE_RAD),
            VelocityLag | ServoFirstOrder | ServoSecondOrder | Smoothing => (TIMES, LARGEST_LAG_S),
            CornerSpeed => (SPEEDS, LARGEST_SPEED_MM_PER_S),
            TimingJitter | TimingTick => (TIMES, LARGEST_TIME_S),
            MapNoise | MapLowOrder => (HEIGHTS, LARGEST_HEIGHT_NM),
        }
    }

    /// Returns the name of the kind in a file.
    pub fn name(self) -> String {
        let value = serde_json::to_value(self).expect("a name serialises");
        value.as_str().expect("an enumeration without contents is a string").into()
    }
}

/// Size of an error in % below which a warning asks whether it is a fraction. Larger: warnings about good machines.
/// Smaller: fractions pass. Chosen: the smallest rates and widths of the fixtures are 0.5 %. Geometric errors may be
/// smaller.
const LEAST_PERCENT: f64 = 0.1;

impl ErrorBudget {
    /// Returns the warning about errors in % that are so small that they may be fractions; `None` if there are none.
    pub fn doubt(&self) -> Option<String> {
        let small: Vec<String> =
            self.errors.iter().filter_map(ProcessError::small_percent).collect();
        if small.is_empty() {
            return None;
        }
        Some(format!("{}: fractions? give the size in %, or the unit \"1\"", small.join(", ")))
    }

    /// Returns the sentence on the state in which an axis with play begins; `None` if the process has no play of a size
    /// other than 0.
    pub fn play_start(&self) -> Option<&'static str> {
        let mut errors = self.errors.iter();
        let has_play =
            errors.any(|e| e.effect == Effect::Scalar(Scalar::Backlash) && e.size != 0.0);
        if has_play { Some(play::START) } else { None }
    }
}

impl ProcessError {
    /// Returns a text about an error in % of the rate or of the tool's shape that is so small that it may be a
    /// fraction; otherwise `None`.
    fn small_percent(&self) -> Option<String> {
        let ErrorFile { kind, size, unit, .. } = &self.stated;
        let is_of_tool = !matches!(kind, Kind::Magnification | Kind::Shear);
        if unit != "%" || !is_of_tool || *size == 0.0 || size.abs() >= LEAST_PERCENT {
            return None;
        }
        Some(format!(
            "{} is {size} %, and would be {} %",
            kind.name(),
            significant(100.0 * size, 4)
        ))
    }
}

impl ErrorBudgetFile {
    /// Checks what the JSON types do not: units, signs, magnitudes, and the settings of every kind.
    ///
    /// # Errors
    ///
    /// Refuses a budget without errors, and an error whose size, unit, distribution or settings do not fit its kind.
    pub fn checked(self) -> Result<ErrorBudget, Invalid> {
        if self.errors.is_empty() {
            let remedy = "give at least one error";
            return Err(Invalid::whole("errors", "are none", remedy));
        }
        let errors = self.errors.into_iter().enumerate().map(|(i, e)| e.checked(i));
        Ok(ErrorBudget { name: self.name, errors: errors.collect::<Result<_, _>>()? })
    }
}

impl ErrorFile {
    fn checked(self, index: usize) -> Result<ProcessError, Invalid> {
        let name = self.kind.name();
        let bad =
            |problem: String, remedy: &str| Invalid::at_index("errors", index, problem, remedy);
        let (units, largest) = self.kind.units();
        let Some((_, factor)) = units.iter().find(|(unit, _)| *unit == self.unit) else {
            let known: Vec<&str> = units.iter().map(|(unit, _)| *unit).collect();
            let problem = format!("the unit of {name} is {:?}", self.unit);
            return Err(bad(problem, &format!("give one of {known:?}")));
        };
        let size = self.size * factor;
        if !size.is_finite() {
            return Err(bad(
                format!("the size of {name} is {}", self.size),
                "give a finite number",
            ));
        }
        let remedy = match (self.kind, self.distribution) {
            (Kind::ServoFirstOrder | Kind::ServoSecondOrder, Distribution::Fixed) => {
                "axes are not ahead of their command; give the lag, or a velocity_lag"
            }
            (Kind::Smoothing | Kind::CornerSpeed, Distribution::Fixed) => {
                "give what the planner does, a positive number"
            }
            (_, Distribution::Fixed) => "",
            _ => "a standard deviation or half a width is not negative; give its magnitude",
        };
        // A corner that lets no change of the velocity pass would never be left.
        let is_negative = size < 0.0 || self.kind == Kind::CornerSpeed && size == 0.0;
        if is_negative && !remedy.is_empty() {
            let problem = format!("the size of {name} is {} {}", self.size, self.unit);
            return Err(bad(problem, remedy));
        }
        if size.abs() > largest {
            let problem = format!("the size of {name} is {} {}", self.size, self.unit);
            let mut remedy =
                format!("give at most {} {}; is the unit right?", largest / factor, self.unit);
            if self.unit == "1" && 0.01 * size.abs() <= largest {
                remedy = format!("give at most {largest}, or the unit \"%\" for {} %", self.size);
            }
            return Err(bad(problem, &remedy));
        }
        self.check_distribution(index, &name)?;
        let effect = self.effect(index, &name)?;
        Ok(ProcessError { stated: self, size, effect })
    }

    /// Refuses a distribution that does not fit the kind. Noise along the run and errors of the map are normal, a tick
    /// uniform, and the lag of a servo of first or second order and the errors of a planner fixed. Other errors may have any.
    fn check_distribution(&self, index: usize, name: &str) -> Result<(), Invalid> {
        use Kind::*;
        let only = match self.kind {
            RateNoise | PositionNoise | TimingJitter | MapNoise | MapLowOrder => {
                Distribution::Normal
            }
            TimingTick => Distribution::Uniform,
            ServoFirstOrder | ServoSecondOrder | Smoothing | CornerSpeed => Distribution::Fixed,
            _ => return Ok(()),
        };
        if self.distribution == only {
            return Ok(());
        }
        let [own, only] = [self.distribution, only]
            .map(|distribution| format!("{distribution:?}").to_lowercase());
        let problem = format!("the distribution of {name} is {own:?}");
        Err(Invalid::at_index("errors", index, problem, format!("give {only:?}")))
    }

    /// Returns the effect of the error with the settings that its kind needs. Refuses settings that are missing, out of
    /// range or not of its kind.
    fn effect(&self, index: usize, name: &str) -> Result<Effect, Invalid> {
        let degree = self.degree.map(|d| d as f64);
        let settings = [
            ("correlation_s", self.correlation_s),
            ("time_constant_s", self.time_constant_s),
            ("damping_ratio", self.damping_ratio),
            ("acceleration_mm_per_s2", self.acceleration_mm_per_s2),
            ("degree", degree),
        ];
        let wanted = match self.kind {
            Kind::RateNoise => Some(("correlation_s", 1e-6, LONGEST_TIME_S)),
            Kind::RateWarmUp => Some(("time_constant_s", 1e-6, LONGEST_TIME_S)),
            Kind::ServoSecondOrder => Some(("damping_ratio", DAMPING_RATIOS[0], DAMPING_RATIOS[1])),
            Kind::CornerSpeed => {
                let [least, most] = PATH_ACCELERATIONS_MM_PER_S2;
                Some(("acceleration_mm_per_s2", least, most))
            }
            Kind::MapLowOrder => Some(("degree", 1.0, LARGEST_DEGREE as f64)),
            _ => None,
        };
        let wanted_name = wanted.map(|(name, ..)| name);
        let extra = settings.iter().find(|(s, v)| v.is_some() && wanted_name != Some(*s));
        if let Some((extra, _)) = extra {
            let problem = format!("`{extra}` is given for {name}");
            return Err(Invalid::at_index(
                "errors",
                index,
                problem,
                "leave it out: this kind has none",
            ));
        }
        let value = match wanted {
            None => 0.0,
            Some((setting, least, most)) => {
                let remedy = format!("give {least} to {most}");
                let stated = settings.iter().find(|(s, _)| *s == setting).and_then(|(_, v)| *v);
                let Some(value) = stated else {
                    let problem = format!("{name} has no `{setting}`");
                    return Err(Invalid::at_index("errors", index, problem, remedy));
                };
                if !(least..=most).contains(&value) {
                    let problem = format!("`{setting}` of {name} is {value}");
                    return Err(Invalid::at_index("errors", index, problem, remedy));
                }
                value
            }
        };
        Ok(match self.kind {
            Kind::RateScale => Effect::Scalar(Scalar::RateScale),
            Kind::RateDrift => Effect::Scalar(Scalar::RateDrift),
            Kind::RateWarmUp => Effect::Scalar(Scalar::RateWarmUp { time_constant_s: value }),
            Kind::RateNoise => Effect::Noise(Noise::Rate { correlation_s: value }),
            Kind::OffsetX | Kind::TifOffsetX => Effect::Scalar(Scalar::OffsetX),
            Kind::OffsetY | Kind::TifOffsetY => Effect::Scalar(Scalar::OffsetY),
            Kind::Rotation => Effect::Scalar(Scalar::Rotation),
            Kind::Magnification => Effect::Scalar(Scalar::Magnification),
            Kind::Shear => Effect::Scalar(Scalar::Shear),
            Kind::TifWidth => Effect::Scalar(Scalar::TifWidth),
            Kind::TifEllipticity => Effect::Scalar(Scalar::TifEllipticity),
            Kind::TifDiagonalEllipticity => Effect::Scalar(Scalar::TifDiagonalEllipticity),
            Kind::TifRotation => Effect::Scalar(Scalar::TifRotation),
            Kind::PositionNoise => Effect::Noise(Noise::Position),
            Kind::VelocityLag => Effect::Scalar(Scalar::VelocityLag),
            Kind::ServoFirstOrder => Effect::Scalar(Scalar::ServoFirstOrder),
            Kind::ServoSecondOrder => {
                Effect::Scalar(Scalar::ServoSecondOrder { damping_ratio: value })
            }
            Kind::Smoothing => Effect::Scalar(Scalar::Smoothing),
            Kind::CornerSpeed => {
                Effect::Scalar(Scalar::CornerSpeed { acceleration_mm_per_s2: value })
            }
            Kind::Backlash => Effect::Scalar(Scalar::Backlash),
            Kind::TimingJitter => Effect::Noise(Noise::Jitter),
            Kind::TimingTick => Effect::Noise(Noise::Tick),
            Kind::MapNoise => Effect::MapNoise,
            Kind::MapLowOrder => Effect::MapLowOrder { degree: value as usize },
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Makes a process with one error of the rate.
    fn process(size: f64, unit: &str) -> Result<ErrorBudget, Invalid> {
        let error = ErrorFile {
            kind: Kind::RateScale,
            size,
            unit: unit.into(),
            distribution: Distribution::Normal,
            note: String::new(),
            correlation_s: None,
            time_constant_s: None,
            damping_ratio: None,
            acceleration_mm_per_s2: None,
            degree: None,
        };
        ErrorBudgetFile { name: "process".into(), errors: vec![error] }.checked()
    }

    #[test]
    fn a_percentage_for_a_fraction_and_the_reverse_are_named_with_the_value() {
        let refusal = process(5.0, "1").unwrap_err().to_string();
        assert!(refusal.contains("give at most 0.25, or the unit \"%\" for 5 %"), "{refusal}");
        let doubt = process(0.05, "%").unwrap().doubt().unwrap();
        assert!(doubt.contains("rate_scale is 0.05 %, and would be 5 %: fractions?"), "{doubt}");
        for (size, unit) in [(0.5, "%"), (0.0, "%"), (0.05, "1")] {
            assert_eq!(process(size, unit).unwrap().doubt(), None, "{size} {unit}");
        }
    }
}
