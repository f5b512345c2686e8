//! A specification: limits on what [`crate::quality`] measures, in zones, and whether a mirror keeps them.
//!
//! ```text
//! PSD line (ISO 10110-8)     S(f) <= A / f^B     for every f of the spectrum with f_0 <= f <= f_1
//! zone inside                valid pixels at least w from the outline
//! zone edge                  valid pixels nearer than w to it
//! ```
//!
//! The outline is where valid pixels meet the rim of the map or invalid pixels that reach to it: a hole in the
//! middle has no edge zone. A pixel is half a step wide about its centre.
//!
//! A limit that cannot be judged (a band without a frequency, a base longer than the zone) is an error, not
//! passed and not failed.
//!
//! | symbol | variable | unit |
//! |---|---|---|
//! | A | `a` | nm^2 mm^(1-B) along a direction, nm^2 mm^(2-B) over rings |
//! | B | `b` | 1 |
//! | f | `frequency_per_mm` | 1/mm |

use ndarray::Array2;
use planish_types::{Axis, ClearAperture, Grid, Invalid, Surface, text::significant};
use serde::{Deserialize, Serialize};

use crate::{
    distance::nearest,
    ellipse::Ellipse,
    quality::{Direction, Light, Piece, SpectrumLine, Subject, strehl},
    shape::{EllipseParameter, EllipseSettings, Shape},
};

/// Grazing angle of normal incidence, mrad.
const NORMAL_MRAD: f64 = 1e3 * std::f64::consts::FRAC_PI_2;

/// A specification as its JSON file states it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, rename = "specification")]
pub struct Specification {
    /// Name.
    pub name: String,
    /// Where it comes from, what it is for.
    #[serde(default)]
    pub description: String,
    /// The ellipse of the limits after `ellipse`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ellipse: Option<EllipseFile>,
    /// The zones that limits name; a limit without one is on all valid pixels.
    #[serde(default)]
    pub zones: Vec<Zone>,
    /// The limits.
    pub limits: Vec<Limit>,
}

/// An ellipse as a file states it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, rename = "ellipse")]
pub struct EllipseFile {
    /// Source to pole, mm.
    pub p_mm: f64,
    /// Pole to image, mm.
    pub q_mm: f64,
    /// Grazing angle at the pole, mrad.
    pub theta_mrad: f64,
    /// Where the pole is, mm; absent for the middle.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pole_mm: Option<f64>,
    /// What is fitted beside piston and tilt.
    #[serde(default)]
    pub free: Vec<EllipseParameter>,
}

/// Which part of a mirror; exactly one of the keys beside the name, or `x_mm` and `y_mm` together.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, rename = "zone")]
pub struct Zone {
    /// Name.
    pub name: String,
    /// Smallest and largest x, mm.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub x_mm: Option<[f64; 2]>,
    /// Smallest and largest y, mm.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub y_mm: Option<[f64; 2]>,
    /// Centre x, centre y and radius of a circle, mm.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub circle_mm: Option<[f64; 3]>,
    /// At least this far from the outline, mm.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub inside_mm: Option<f64>,
    /// Nearer than this to the outline, mm.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub edge_mm: Option<f64>,
}

/// What every limit says beside its quantity.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "quantity", rename_all = "snake_case", deny_unknown_fields)]
pub enum Limit {
    /// RMS height; within periods of a map over two dimensions, or along a direction.
    HeightRms {
        /// Zone; absent for all valid pixels.
        #[serde(default)]
        zone: Option<String>,
        /// The shape that is taken off first.
        #[serde(default = "plane")]
        after: Shape,
        /// Direction of the periods.
        #[serde(default)]
        along: Option<Direction>,
        /// Shortest period that counts, mm.
        #[serde(default)]
        shortest_period_mm: Option<f64>,
        /// Longest period that counts, mm.
        #[serde(default)]
        longest_period_mm: Option<f64>,
        /// The limit, nm.
        at_most_nm: f64,
    },
    /// Largest minus smallest height.
    HeightPv {
        /// Zone; absent for all valid pixels.
        #[serde(default)]
        zone: Option<String>,
        /// The shape that is taken off first.
        #[serde(default = "plane")]
        after: Shape,
        /// The limit, nm.
        at_most_nm: f64,
    },
    /// RMS slope over a base length, or within periods.
    SlopeRms {
        /// Zone; absent for all valid pixels.
        #[serde(default)]
        zone: Option<String>,
        /// The shape that is taken off first.
        #[serde(default = "plane")]
        after: Shape,
        /// Direction.
        along: Direction,
        /// Base length, mm; not used of measured slopes.
        #[serde(default)]
        base_mm: Option<f64>,
        /// Shortest period that counts, mm.
        #[serde(default)]
        shortest_period_mm: Option<f64>,
        /// Longest period that counts, mm.
        #[serde(default)]
        longest_period_mm: Option<f64>,
        /// The limit, nrad.
        at_most_nrad: f64,
    },
    /// Largest slope from the mean over a base length.
    SlopePeak {
        /// Zone; absent for all valid pixels.
        #[serde(default)]
        zone: Option<String>,
        /// The shape that is taken off first.
        #[serde(default = "plane")]
        after: Shape,
        /// Direction.
        along: Direction,
        /// Base length, mm; not used of measured slopes.
        base_mm: f64,
        /// The limit, nrad.
        at_most_nrad: f64,
    },
    /// A line that the power spectral density of heights does not exceed.
    Psd {
        /// Zone; absent for all valid pixels.
        #[serde(default)]
        zone: Option<String>,
        /// The shape that is taken off first.
        #[serde(default = "plane")]
        after: Shape,
        /// Direction.
        along: Direction,
        /// A.
        a: f64,
        /// B.
        b: f64,
        /// From and to, 1/mm.
        frequency_per_mm: [f64; 2],
    },
    /// Strehl ratio after Marechal.
    Strehl {
        /// Zone; absent for all valid pixels.
        #[serde(default)]
        zone: Option<String>,
        /// The shape that is taken off first.
        #[serde(default = "plane")]
        after: Shape,
        /// Wavelength, nm.
        wavelength_nm: f64,
        /// Grazing angle, mrad; absent for normal incidence.
        #[serde(default)]
        grazing_mrad: Option<f64>,
        /// The limit.
        at_least: f64,
    },
    /// Magnitude of the radius of the best cylinder along a direction, or of the best sphere.
    Radius {
        /// Zone; absent for all valid pixels.
        #[serde(default)]
        zone: Option<String>,
        /// Direction; `radial` for the sphere.
        along: Direction,
        /// The limit, m.
        at_least_m: f64,
    },
    /// Lag at which the autocorrelation falls to 1/e.
    AutocorrelationLength {
        /// Zone; absent for all valid pixels.
        #[serde(default)]
        zone: Option<String>,
        /// The shape that is taken off first.
        #[serde(default = "plane")]
        after: Shape,
        /// Direction.
        along: Direction,
        /// The limit, mm.
        at_least_mm: f64,
    },
}

fn plane() -> Shape {
    Shape::Plane
}

/// What a specification says of a mirror.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SpecificationReport {
    /// Name of the specification.
    pub name: String,
    /// Whether every limit is kept.
    pub passed: bool,
    /// Limit by limit, in the order of the file.
    pub limits: Vec<LimitReport>,
}

/// What was found of a limit.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct LimitReport {
    /// The quantity in words.
    pub quantity: String,
    /// Unit of the value and the limit.
    pub unit: &'static str,
    /// What was found; `null` for infinity (the radius of a plane).
    pub value: f64,
    /// What is allowed.
    pub limit: f64,
    /// Whether `limit` is the largest or the smallest allowed value.
    pub bound: Bound,
    /// Whether it is kept.
    pub passed: bool,
    /// Where the mirror is worst, in words; `null` where the quantity has no place.
    pub worst: Option<String>,
}

/// Which side of a limit is allowed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Bound {
    /// At most the limit.
    AtMost,
    /// At least the limit.
    AtLeast,
}

impl LimitReport {
    fn new(quantity: String, unit: &'static str, value: f64, bound: Bound, limit: f64) -> Self {
        let passed = match bound {
            Bound::AtMost => value <= limit,
            Bound::AtLeast => value >= limit,
        };
        Self { quantity, unit, value, limit, bound, passed, worst: None }
    }

    fn worst_at(self, worst: String) -> Self {
        Self { worst: Some(worst), ..self }
    }

    /// The verdict as a sentence without a full stop.
    pub fn text(&self) -> String {
        let Self { quantity, unit, bound, worst, .. } = self;
        let unit = if unit.is_empty() { String::new() } else { format!(" {unit}") };
        let [value, limit] = [self.value, self.limit].map(|v| significant(v, 4));
        let allowed = match bound {
            Bound::AtMost => "at most",
            Bound::AtLeast => "at least",
        };
        let percent = significant(100.0 * (self.value / self.limit - 1.0).abs(), 3);
        let verdict = match (self.passed, bound) {
            (true, _) => String::new(),
            (false, Bound::AtMost) => format!(", {percent} % too much"),
            (false, Bound::AtLeast) => format!(", {percent} % too little"),
        };
        let place = worst.as_ref().map_or(String::new(), |w| format!("; worst {w}"));
        format!("{quantity}: {value}{unit}, {allowed} {limit}{unit}{verdict}{place}")
    }
}

impl SpecificationReport {
    /// What fails, by how much and where; `None` where everything is kept.
    pub fn failures(&self) -> Option<String> {
        let failed: Vec<String> =
            self.limits.iter().filter(|l| !l.passed).map(LimitReport::text).collect();
        (!failed.is_empty()).then(|| {
            let (n, all) = (failed.len(), self.limits.len());
            format!("{n} of {all} limits of {} are exceeded: {}", self.name, failed.join("; "))
        })
    }
}

impl Specification {
    /// Checks what the JSON types do not: names, zones, and every number.
    pub fn check(&self) -> Result<(), Invalid> {
        if self.limits.is_empty() {
            return Err(Invalid::whole("limits", "are none", "give at least one"));
        }
        for (i, zone) in self.zones.iter().enumerate() {
            zone.check(i)?;
            if self.zones[..i].iter().any(|z| z.name == zone.name) {
                let problem = format!("name is \"{}\" a second time", zone.name);
                return Err(Invalid::at("zones", i, problem, "give every zone its own name"));
            }
        }
        self.ellipse()?;
        self.limits.iter().enumerate().try_for_each(|(i, limit)| self.check_limit(i, limit))
    }

    fn check_limit(&self, i: usize, limit: &Limit) -> Result<(), Invalid> {
        let refuse = |problem: String, remedy: &str| Err(Invalid::at("limits", i, problem, remedy));
        if let Some(name) = limit.zone().filter(|n| !self.zones.iter().any(|z| z.name == *n)) {
            let problem = format!("zone is \"{name}\"");
            return refuse(problem, "name one of the zones, or leave the key out");
        }
        if limit.after() == Shape::Ellipse && self.ellipse.is_none() {
            return refuse("after is \"ellipse\"".into(), "give the specification an `ellipse`");
        }
        for (key, value) in limit.positive() {
            if !(value.is_finite() && value > 0.0) {
                return refuse(format!("{key} is {value}"), "give a finite number above 0");
            }
        }
        match limit {
            Limit::SlopeRms { base_mm, shortest_period_mm, longest_period_mm, .. } => {
                let of_periods = shortest_period_mm.is_some() || longest_period_mm.is_some();
                if base_mm.is_some() == of_periods {
                    let problem = match of_periods {
                        true => "base_mm and periods are both given",
                        false => "neither base_mm nor a period is given",
                    };
                    return refuse(problem.into(), "a slope error is over a base, or over periods");
                }
            }
            Limit::HeightRms {
                along, shortest_period_mm: None, longest_period_mm: None, ..
            } if along.is_some() => {
                let remedy = "give a period, or leave `along` out";
                return refuse("along is given without a period".into(), remedy);
            }
            Limit::Psd { b, frequency_per_mm: [low, high], .. } => {
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
        if let Some([shortest, longest]) = limit.periods().filter(|[s, l]| s >= l) {
            let problem = format!("the periods are {shortest} .. {longest} mm");
            return refuse(problem, "give shortest_period_mm < longest_period_mm");
        }
        let radial = limit.direction() == Some(Direction::Radial);
        let has_rings =
            matches!(limit, Limit::Psd { .. } | Limit::HeightRms { .. } | Limit::Radius { .. });
        if radial && !has_rings {
            return refuse("along is \"radial\"".into(), "give \"x\" or \"y\"");
        }
        Ok(())
    }

    /// The ellipse, where it has one.
    pub fn ellipse(&self) -> Result<Option<EllipseSettings>, Invalid> {
        self.ellipse.as_ref().map(EllipseFile::settings).transpose()
    }

    /// Judges `subject`, limit by limit.
    pub fn judge(&self, subject: &Subject) -> Result<SpecificationReport, Invalid> {
        self.check()?;
        let ellipse = self.ellipse()?;
        let zones = Zones { subject, specification: self, outline: None, masks: Vec::new() };
        let mut pieces = Pieces { zones, ellipse, known: Vec::new() };
        let limits = self.limits.iter().enumerate().map(|(i, limit)| {
            judge(limit, &mut pieces).map_err(|e| {
                let problem = format!("cannot be judged: {} {}", e.array, e.problem);
                Invalid::at("limits", i, problem, e.remedy)
            })
        });
        let limits = limits.collect::<Result<Vec<_>, _>>()?;
        let passed = limits.iter().all(|l| l.passed);
        Ok(SpecificationReport { name: self.name.clone(), passed, limits })
    }
}

impl EllipseFile {
    fn settings(&self) -> Result<EllipseSettings, Invalid> {
        let design = Ellipse::new(self.p_mm, self.q_mm, 1e-3 * self.theta_mrad)?;
        if let Some(mm) = self.pole_mm.filter(|mm| !mm.is_finite()) {
            let problem = format!("pole_mm is {mm}");
            return Err(Invalid::whole("ellipse", problem, "give a place in mm, or leave it out"));
        }
        Ok(EllipseSettings { design, free: self.free.clone(), pole_mm: self.pole_mm })
    }
}

impl Zone {
    fn check(&self, i: usize) -> Result<(), Invalid> {
        let rectangle = self.x_mm.is_some() || self.y_mm.is_some();
        let kinds =
            [rectangle, self.circle_mm.is_some(), self.inside_mm.is_some(), self.edge_mm.is_some()];
        let count = kinds.iter().filter(|given| **given).count();
        if count != 1 {
            let problem = format!("\"{}\" is described in {count} ways", self.name);
            let remedy =
                "give x_mm and y_mm (or one of them), or circle_mm, or inside_mm, or edge_mm";
            return Err(Invalid::at("zones", i, problem, remedy));
        }
        let ranges = [("x_mm", self.x_mm), ("y_mm", self.y_mm)];
        for (key, [low, high]) in ranges.iter().filter_map(|(k, r)| r.map(|r| (k, r))) {
            if !(low.is_finite() && high.is_finite() && low < high) {
                let problem = format!("{key} is {low} .. {high}");
                return Err(Invalid::at(
                    "zones",
                    i,
                    problem,
                    "give finite smallest < largest in mm",
                ));
            }
        }
        let sizes = [
            ("the radius of circle_mm", self.circle_mm.map(|c| c[2])),
            ("inside_mm", self.inside_mm),
            ("edge_mm", self.edge_mm),
        ];
        for (key, mm) in sizes.iter().filter_map(|(k, v)| v.map(|v| (k, v))) {
            if !(mm.is_finite() && mm > 0.0) {
                let problem = format!("{key} is {mm}");
                return Err(Invalid::at("zones", i, problem, "give a length in mm, above 0"));
            }
        }
        Ok(())
    }
}

impl Limit {
    fn zone(&self) -> Option<&str> {
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

    fn after(&self) -> Shape {
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

    fn direction(&self) -> Option<Direction> {
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

    /// Shortest and longest period, 0 and infinity where not given; `None` without both.
    fn periods(&self) -> Option<[f64; 2]> {
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

    /// Keys and values that must be above 0.
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

/// The zones of a mirror as masks, each made once.
struct Zones<'a> {
    subject: &'a Subject,
    specification: &'a Specification,
    /// Distance of every pixel from the outline, mm.
    outline: Option<Array2<f64>>,
    masks: Vec<(String, Array2<bool>)>,
}

impl Zones<'_> {
    fn mask(&mut self, name: &str) -> Result<Array2<bool>, Invalid> {
        if let Some((_, mask)) = self.masks.iter().find(|(n, _)| n == name) {
            return Ok(mask.clone());
        }
        let zones = &self.specification.zones;
        let zone = zones.iter().find(|z| z.name == name).expect("the specification is checked");
        let (valid, x_mm, y_mm) = match self.subject {
            Subject::Map(surface) => {
                let grid = surface.grid();
                let valid = surface.height_nm().mapv(|z| !z.is_nan());
                (valid, grid.x.coordinates(), grid.y.coordinates())
            }
            Subject::Profile(profile) => {
                let n = profile.position_mm().len();
                (Array2::from_elem((1, n), true), profile.position_mm().to_vec(), vec![0.0])
            }
        };
        let within =
            |at: f64, range: Option<[f64; 2]>| range.is_none_or(|[l, h]| at >= l && at <= h);
        let mask = if let Some([cx, cy, radius_mm]) = zone.circle_mm {
            let Subject::Map(surface) = self.subject else {
                let remedy = "a profile has zones by x_mm, inside_mm or edge_mm";
                return Err(Invalid::whole("zone", "circle_mm is of a profile", remedy));
            };
            ClearAperture::Circle { centre_mm: [cx, cy], radius_mm }.mask(surface.grid())?
        } else if let Some(width) = zone.inside_mm.or(zone.edge_mm) {
            let distance = match &mut self.outline {
                Some(distance) => distance,
                none => none.insert(match self.subject {
                    Subject::Map(surface) => from_outline(surface)?,
                    Subject::Profile(_) => {
                        let ends = [x_mm[0], x_mm[x_mm.len() - 1]];
                        Array2::from_shape_fn((1, x_mm.len()), |(_, c)| {
                            (x_mm[c] - ends[0]).min(ends[1] - x_mm[c])
                        })
                    }
                }),
            };
            let inside = zone.inside_mm.is_some();
            distance.mapv(|d| (d >= width) == inside)
        } else {
            Array2::from_shape_fn(valid.dim(), |(r, c)| {
                within(x_mm[c], zone.x_mm) && within(y_mm[r], zone.y_mm)
            })
        };
        let mask = mask & &valid;
        if !mask.iter().any(|inside| *inside) {
            let problem = format!("\"{name}\" holds no valid pixel");
            return Err(Invalid::whole("zone", problem, "check its place and units"));
        }
        self.masks.push((name.into(), mask.clone()));
        Ok(mask)
    }
}

/// Distance of every pixel from the outline of the valid pixels, mm.
fn from_outline(surface: &Surface) -> Result<Array2<f64>, Invalid> {
    let (ny, nx) = surface.height_nm().dim();
    let Grid { x, y } = surface.grid();
    let axis = |a: &Axis| Axis::new(a.start_mm() - a.step_mm(), a.step_mm(), a.len() + 2);
    let grid = Grid { x: axis(x)?, y: axis(y)? };
    let invalid = |r: usize, c: usize| {
        r == 0
            || c == 0
            || r == ny + 1
            || c == nx + 1
            || surface.height_nm()[[r - 1, c - 1]].is_nan()
    };
    // What is invalid and reaches to the rim, from the rim inwards.
    let mut outside = Array2::from_elem((ny + 2, nx + 2), f64::NAN);
    let mut open: Vec<(usize, usize)> = vec![(0, 0)];
    outside[[0, 0]] = 0.0;
    while let Some((r, c)) = open.pop() {
        let steps = [(r.wrapping_sub(1), c), (r + 1, c), (r, c.wrapping_sub(1)), (r, c + 1)];
        for (r, c) in steps.into_iter().filter(|(r, c)| *r < ny + 2 && *c < nx + 2) {
            if outside[[r, c]].is_nan() && invalid(r, c) {
                outside[[r, c]] = 0.0;
                open.push((r, c));
            }
        }
    }
    let half = 0.5 * x.step_mm().min(y.step_mm());
    let distance = nearest(outside.view(), &grid).distance_mm;
    Ok(Array2::from_shape_fn((ny, nx), |(r, c)| distance[[r + 1, c + 1]] - half))
}

/// Zones after shapes, each made once.
struct Pieces<'a> {
    zones: Zones<'a>,
    ellipse: Option<EllipseSettings>,
    known: Vec<(Option<String>, Shape, Piece)>,
}

impl Pieces<'_> {
    fn of(&mut self, zone: Option<&str>, shape: Shape) -> Result<&Piece, Invalid> {
        let same = |(z, s, _): &(Option<String>, Shape, Piece)| z.as_deref() == zone && *s == shape;
        let at = match self.known.iter().position(same) {
            Some(at) => at,
            None => {
                let mask = zone.map(|name| self.zones.mask(name)).transpose()?;
                let piece =
                    Piece::new(self.zones.subject, mask.as_ref(), shape, self.ellipse.as_ref())?;
                self.known.push((zone.map(String::from), shape, piece));
                self.known.len() - 1
            }
        };
        Ok(&self.known[at].2)
    }
}

fn place([x, y]: [f64; 2]) -> String {
    format!("at x {}, y {} mm", significant(x, 4), significant(y, 4))
}

fn judge(limit: &Limit, pieces: &mut Pieces) -> Result<LimitReport, Invalid> {
    let is_profile = matches!(pieces.zones.subject, Subject::Profile(_));
    let (zone, after) = (limit.zone(), limit.after());
    let piece = pieces.of(zone, after)?;
    let along = |direction: Direction| match direction {
        Direction::X => " along x",
        Direction::Y => " along y",
        Direction::Radial => ", radial",
    };
    let of = |quantity: String| {
        let zone = zone.map_or(String::new(), |z| format!(", zone \"{z}\""));
        format!("{quantity} after {}{zone}", after.name())
    };
    let band = limit.periods().map(|[shortest, longest]| [1.0 / longest, 1.0 / shortest]);
    let of_periods = || match limit.periods() {
        Some([0.0, longest]) => format!(", periods up to {longest} mm"),
        Some([shortest, f64::INFINITY]) => format!(", periods above {shortest} mm"),
        Some([shortest, longest]) => format!(", periods {shortest} to {longest} mm"),
        None => String::new(),
    };
    Ok(match limit {
        Limit::HeightRms { along: direction, at_most_nm, .. } => {
            let value = match band {
                None => piece.height()?.rms,
                Some(band) => {
                    let direction = match direction {
                        Some(direction) => *direction,
                        None if is_profile => Direction::X,
                        None => Direction::Radial,
                    };
                    let line = spectrum_line(piece, direction)?;
                    check_band(line, band)?;
                    match direction {
                        Direction::Radial => piece.spectra()?.height_rms_nm(band),
                        _ => line.height_rms(band),
                    }
                }
            };
            let text = of(format!("RMS height{}{}", direction.map_or("", along), of_periods()));
            let report = LimitReport::new(text, "nm", value, Bound::AtMost, *at_most_nm);
            match band {
                None => report.worst_at(place(piece.farthest_height()?.0)),
                Some(_) => report,
            }
        }
        Limit::HeightPv { at_most_nm, .. } => {
            let value = piece.height()?.pv;
            LimitReport::new(of("PV height".into()), "nm", value, Bound::AtMost, *at_most_nm)
                .worst_at(place(piece.farthest_height()?.0))
        }
        Limit::SlopeRms { along: direction, base_mm, at_most_nrad, .. } => {
            let name = format!("RMS slope{}", along(*direction));
            match (band, base_mm) {
                (Some(band), _) => {
                    let line = spectrum_line(piece, *direction)?;
                    check_band(line, band)?;
                    let text = of(format!("{name}{}", of_periods()));
                    let value = line.slope_rms(band);
                    LimitReport::new(text, "nrad", value, Bound::AtMost, *at_most_nrad)
                }
                (None, base_mm) => {
                    let base_mm = base_mm.unwrap_or_default();
                    let found = piece.slope(*direction, base_mm)?;
                    let text = of(format!("{name}{}", of_base(found.base_mm)));
                    LimitReport::new(text, "nrad", found.rms_nrad, Bound::AtMost, *at_most_nrad)
                        .worst_at(place(found.peak_at_mm))
                }
            }
        }
        Limit::SlopePeak { along: direction, base_mm, at_most_nrad, .. } => {
            let found = piece.slope(*direction, *base_mm)?;
            let text = of(format!("largest slope{}{}", along(*direction), of_base(found.base_mm)));
            LimitReport::new(text, "nrad", found.peak_nrad, Bound::AtMost, *at_most_nrad)
                .worst_at(place(found.peak_at_mm))
        }
        Limit::Psd { along: direction, a, b, frequency_per_mm: [low, high], .. } => {
            let line = spectrum_line(piece, *direction)?;
            // A / f^B at the frequency at which the density exceeds it most
            let inside = line.frequency_per_mm.iter().zip(&line.height);
            let worst = inside
                .filter(|(f, s)| **f >= *low && **f <= *high && s.is_finite())
                .map(|(f, s)| (*f, *s, a / f.powf(*b)))
                .max_by(|p, q| (p.1 / p.2).total_cmp(&(q.1 / q.2)));
            let Some((f, density, allowed)) = worst else {
                return Err(no_frequency(line, [*low, *high]));
            };
            let unit = match direction {
                Direction::Radial => "nm^2 mm^2",
                _ => "nm^2 mm",
            };
            let text =
                of(format!("PSD{} from {low} to {high} /mm under {a} / f^{b}", along(*direction)));
            LimitReport::new(text, unit, density, Bound::AtMost, allowed)
                .worst_at(format!("at {} /mm", significant(f, 4)))
        }
        Limit::Strehl { wavelength_nm, grazing_mrad, at_least, .. } => {
            let light = Light {
                wavelength_nm: *wavelength_nm,
                grazing_mrad: grazing_mrad.unwrap_or(NORMAL_MRAD),
            };
            let value = strehl(light, piece.height()?.rms)?.strehl;
            let angle = grazing_mrad.map_or(String::new(), |g| format!(" under {g} mrad"));
            let text = of(format!("Strehl ratio at {wavelength_nm} nm{angle}"));
            LimitReport::new(text, "", value, Bound::AtLeast, *at_least)
        }
        Limit::Radius { along: direction, at_least_m, .. } => {
            // What is not curved has no radius that could be too small.
            let value = piece.shape.radius_m.map_or(f64::INFINITY, f64::abs);
            let zone = zone.map_or(String::new(), |z| format!(", zone \"{z}\""));
            let text = format!("radius of curvature{}{zone}", along(*direction));
            LimitReport::new(text, "m", value, Bound::AtLeast, *at_least_m)
        }
        Limit::AutocorrelationLength { along: direction, at_least_mm, .. } => {
            let value = piece.autocorrelation_length_mm(*direction).ok_or_else(|| {
                let problem = "has no autocorrelation length: it is longer than the zone";
                Invalid::whole("map", problem, "leave the limit out, or give a larger zone")
            })?;
            let text = of(format!("autocorrelation length{}", along(*direction)));
            LimitReport::new(text, "mm", value, Bound::AtLeast, *at_least_mm)
        }
    })
}

fn of_base(base_mm: f64) -> String {
    match base_mm > 0.0 {
        true => format!(", base {} mm", significant(base_mm, 4)),
        false => " as measured".into(),
    }
}

fn spectrum_line(piece: &Piece, direction: Direction) -> Result<&SpectrumLine, Invalid> {
    let spectra = piece.spectra()?;
    let line = match direction {
        Direction::X => Some(&spectra.x),
        Direction::Y => spectra.y.as_ref(),
        Direction::Radial => spectra.radial.as_ref(),
    };
    line.ok_or_else(|| {
        let remedy = "a profile has a spectrum along x only";
        Invalid::whole("spectrum", "`along` is y or radial", remedy)
    })
}

fn check_band(line: &SpectrumLine, band: [f64; 2]) -> Result<(), Invalid> {
    match line.holds(band) {
        true => Ok(()),
        false => Err(no_frequency(line, band)),
    }
}

fn no_frequency(line: &SpectrumLine, [low, high]: [f64; 2]) -> Invalid {
    let f = &line.frequency_per_mm;
    let problem = format!(
        "has no frequency from {} to {} /mm (those of the zone: {} to {} /mm)",
        significant(low, 4),
        significant(high, 4),
        significant(f[1], 4),
        significant(f[f.len() - 1], 4)
    );
    Invalid::whole("spectrum", problem, "give periods that the zone holds")
}
