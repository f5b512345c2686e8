//! A specification: limits on the quantities of [`crate::quality`], in zones, and the verdict whether a
//! mirror keeps them.
//!
//! ```text
//! PSD line (ISO 10110-8)     S(f) <= A / f^B     for every f of the spectrum with f_0 <= f <= f_1
//! ```
//!
//! A limit (`limit.rs`) is on a quantity in a zone of the mirror (`zone.rs`); `judge.rs` measures the quantity, and
//! `verdict.rs` states whether the limit is kept.
//!
//! A limit that cannot be judged (a band without a frequency, a base longer than the zone) is an error: it is
//! neither passed nor failed.
//!
//! | symbol | variable | unit |
//! |---|---|---|
//! | A | `a` | nm^2 mm^(1-B) along a direction, nm^2 mm^(2-B) over rings |
//! | B | `b` | 1 |
//! | f | `frequency_per_mm` | 1/mm |

use planish_form::ImagingConic;
use planish_types::Invalid;
use serde::{Deserialize, Serialize};

use crate::{
    profile::Values,
    quality::Subject,
    shape::{EllipseParameter, EllipseSettings, Shape},
};

mod judge;
mod limit;
mod zone;

pub use limit::Limit;
pub use planish_types::outcome::specification::{
    Bound, LimitReport, NoisePart, SpecificationReport, Verdict,
};
pub use zone::Zone;

use judge::{ZoneResiduals, judge};
use zone::Zones;

/// A specification as its JSON file states it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, rename = "specification")]
pub struct Specification {
    /// Name of the specification.
    pub name: String,
    /// Origin and purpose of the specification.
    #[serde(default)]
    pub description: String,
    /// Ellipse of the limits whose `after` is `ellipse`; absent if there are none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ellipse: Option<EllipseFile>,
    /// Zones that limits name; a limit without a zone is on all valid pixels.
    #[serde(default)]
    pub zones: Vec<Zone>,
    /// Limits on quantities of the mirror; at least one.
    pub limits: Vec<Limit>,
}

/// Ellipse that the mirror is made for, as the file of a specification states it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, rename = "ellipse")]
pub struct EllipseFile {
    /// Distance from source to pole, mm.
    pub p_mm: f64,
    /// Distance from pole to image, mm.
    pub q_mm: f64,
    /// Grazing angle at the pole, mrad.
    pub theta_mrad: f64,
    /// Position of the pole along x, mm; absent for the middle of the valid pixels.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pole_mm: Option<f64>,
    /// Parameters of the ellipse that are fitted in addition to piston and tilt.
    #[serde(default)]
    pub free: Vec<EllipseParameter>,
}

impl Specification {
    /// Checks what the types of the JSON file do not check.
    ///
    /// # Errors
    /// Refuses an empty list of limits, a zone name that two zones have or that a limit names without a zone, an
    /// ellipse that is missing or no mirror, and numbers out of their range.
    pub fn check(&self) -> Result<(), Invalid> {
        if self.limits.is_empty() {
            return Err(Invalid::whole("limits", "are none", "give at least one"));
        }
        for (i, zone) in self.zones.iter().enumerate() {
            zone.check(i)?;
            if self.zones[..i].iter().any(|z| z.name == zone.name) {
                let problem = format!("name is \"{}\" a second time", zone.name);
                return Err(Invalid::at_index("zones", i, problem, "give every zone its own name"));
            }
        }
        self.ellipse()?;
        self.limits.iter().enumerate().try_for_each(|(i, limit)| self.check_limit(i, limit))
    }

    /// Checks the numbers of limit `i`, and that its zone and its ellipse exist.
    fn check_limit(&self, i: usize, limit: &Limit) -> Result<(), Invalid> {
        if let Some(name) = limit.zone().filter(|n| !self.zones.iter().any(|z| z.name == *n)) {
            let problem = format!("zone is \"{name}\"");
            let remedy = "name one of the zones, or leave the key out";
            return Err(Invalid::at_index("limits", i, problem, remedy));
        }
        if limit.after() == Shape::Ellipse && self.ellipse.is_none() {
            let remedy = "give the specification an `ellipse`";
            return Err(Invalid::at_index("limits", i, "after is \"ellipse\"", remedy));
        }
        limit.check(i)
    }

    /// Returns the ellipse of the limits whose `after` is `ellipse`, or `None` if the specification states none.
    /// Refuses one whose numbers make no ellipse.
    pub fn ellipse(&self) -> Result<Option<EllipseSettings>, Invalid> {
        self.ellipse.as_ref().map(EllipseFile::settings).transpose()
    }

    /// Judges a map or a profile, limit by limit. Refuses what [`Self::check`] refuses, and a limit that cannot be
    /// judged.
    pub fn judge(&self, subject: &Subject) -> Result<SpecificationReport, Invalid> {
        self.judge_beside_noise(subject, 0.0)
    }

    /// Judges a map or a profile limit by limit, with white noise of `noise_nm` RMS (s below) in its heights. The noise
    /// alone would have these values:
    ///
    /// ```text
    /// RMS height    s, in a band s (fraction that the band has of all frequencies)^1/2
    /// RMS slope     2^1/2 s / base, in a band the root of the sum of (2 pi f)^2 S df with S the density of the noise
    /// largest       PV 2 s (2 ln N)^1/2, slope 2^1/2 s / base (2 ln 2N)^1/2: above what is expected of N values
    /// ```
    ///
    /// For an RMS the squares are subtracted; for a largest value and a density the values themselves.
    ///
    /// # Errors
    /// Refuses what [`Self::check`] refuses, a limit that cannot be judged, and noise beside measured slopes.
    pub fn judge_beside_noise(
        &self,
        subject: &Subject,
        noise_nm: f64,
    ) -> Result<SpecificationReport, Invalid> {
        self.check()?;
        if !(noise_nm.is_finite() && noise_nm >= 0.0) {
            let problem = format!("is {noise_nm}");
            return Err(Invalid::whole("noise_nm", problem, "give nm RMS, 0 or more"));
        }
        let has_slopes =
            matches!(subject, Subject::Profile(p) if matches!(p.values(), Values::SlopeNrad(_)));
        if noise_nm > 0.0 && has_slopes {
            let problem = "is of heights, but the profile has measured slopes";
            return Err(Invalid::whole("noise_nm", problem, "leave it out"));
        }
        let ellipse = self.ellipse()?;
        let mut residuals = ZoneResiduals::new(Zones::new(subject, &self.zones), ellipse);
        let limits = self.limits.iter().enumerate().map(|(i, limit)| {
            judge(limit, &mut residuals, noise_nm).map_err(|e| {
                let problem = format!("cannot be judged: {} {}", e.array, e.problem);
                Invalid::at_index("limits", i, problem, e.remedy)
            })
        });
        let limits = limits.collect::<Result<Vec<_>, _>>()?;
        let passed = limits.iter().all(|l| l.passed);
        Ok(SpecificationReport { name: self.name.clone(), passed, limits })
    }
}

impl EllipseFile {
    fn settings(&self) -> Result<EllipseSettings, Invalid> {
        let design = ImagingConic::ellipse(self.p_mm, self.q_mm, 1e-3 * self.theta_mrad)?;
        if let Some(mm) = self.pole_mm.filter(|mm| !mm.is_finite()) {
            let problem = format!("pole_mm is {mm}");
            return Err(Invalid::whole("ellipse", problem, "give a place in mm, or leave it out"));
        }
        Ok(EllipseSettings { design, free: self.free.clone(), pole_mm: self.pole_mm })
    }
}
