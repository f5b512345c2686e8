//! Measures the quantity of a limit in its zone after its shape, and judges it.

use planish_types::{
    Invalid,
    outcome::specification::{Bound, LimitReport, Subtraction},
    text::significant,
};

use super::{limit::Limit, zone::Zones};
use crate::{
    quality::{Direction, Light, ShapeResidual, SpectrumLine, Subject, strehl},
    shape::{EllipseSettings, Shape},
};

/// Grazing angle of normal incidence, mrad (a right angle).
const NORMAL_MRAD: f64 = 1e3 * std::f64::consts::FRAC_PI_2;

/// Mirror in its zones after subtraction of shapes; each pair of zone and shape is computed once.
pub(super) struct ZoneResiduals<'a> {
    zones: Zones<'a>,
    ellipse: Option<EllipseSettings>,
    known: Vec<(Option<String>, Shape, ShapeResidual)>,
}
impl<'a> ZoneResiduals<'a> {
    /// Returns the zones, of which none is measured before a limit asks for it.
    pub fn new(zones: Zones<'a>, ellipse: Option<EllipseSettings>) -> Self {
        Self { zones, ellipse, known: Vec::new() }
    }

    /// Returns the mirror in a zone after `shape`; `None` as the zone stands for all valid pixels.
    fn get(&mut self, zone: Option<&str>, shape: Shape) -> Result<&ShapeResidual, Invalid> {
        let known = self.known.iter().position(|(z, s, _)| z.as_deref() == zone && *s == shape);
        let k = match known {
            Some(k) => k,
            None => {
                let mask = zone.map(|name| self.zones.mask(name)).transpose()?;
                let residual = ShapeResidual::new(
                    self.zones.subject,
                    mask.as_ref(),
                    shape,
                    self.ellipse.as_ref(),
                )?;
                self.known.push((zone.map(String::from), shape, residual));
                self.known.len() - 1
            }
        };
        Ok(&self.known[k].2)
    }
}

/// Returns the verdict on one limit, for heights with white noise of `noise_nm` RMS (0 if it is not known). Refuses a
/// quantity that cannot be measured in its zone.
pub(super) fn judge(
    limit: &Limit,
    residuals: &mut ZoneResiduals,
    noise_nm: f64,
) -> Result<LimitReport, Invalid> {
    let is_profile = matches!(residuals.zones.subject, Subject::Profile(_));
    let residual = residuals.get(limit.zone(), limit.after())?;
    LimitMeasurement { limit, residual, is_profile, noise_nm }.report()
}

/// A limit, and the mirror in its zone after its shape.
struct LimitMeasurement<'a> {
    limit: &'a Limit,
    residual: &'a ShapeResidual,
    is_profile: bool,
    /// RMS of the white noise of the heights, nm; 0 if it is not known.
    noise_nm: f64,
}

impl LimitMeasurement<'_> {
    /// Returns the verdict on the limit, and beside it the value that the noise alone would have. The fit of the shape
    /// takes up a few of the squares of the noise, which is neglected.
    fn report(&self) -> Result<LimitReport, Invalid> {
        let report = self.measured()?;
        let noise_nm = self.noise_nm;
        if noise_nm == 0.0 {
            return Ok(report);
        }
        let rms = |of_noise| report.clone().beside_noise(of_noise, Subtraction::OfSquares);
        let largest = |of_noise| report.clone().beside_noise(of_noise, Subtraction::Linear);
        // The largest of n normal values is expected below sqrt(2 ln n) standard deviations, of magnitudes of 2 n.
        let count = self.residual.height()?.valid_count as f64;
        Ok(match self.limit {
            Limit::HeightRms { along: direction, .. } => match self.band() {
                None => rms(noise_nm),
                Some(band) => {
                    let white = self.residual.spectra()?.white(noise_nm);
                    rms(match self.direction_of(*direction) {
                        Direction::X => white.x.height_rms(band),
                        Direction::Y => white.y.as_ref().map_or(0.0, |y| y.height_rms(band)),
                        Direction::Radial => white.height_rms_nm(band),
                    })
                }
            },
            Limit::HeightPv { .. } => largest(2.0 * noise_nm * (2.0 * count.ln()).sqrt()),
            Limit::SlopeRms { along: direction, base_mm, .. } => match self.band() {
                None => rms(self.noise_slope_nrad(*direction, base_mm.unwrap_or_default())?),
                Some(band) => {
                    let white = self.residual.spectra()?.white(noise_nm);
                    let line = if *direction == Direction::Y { white.y } else { Some(white.x) };
                    rms(line.map_or(0.0, |line| line.slope_rms(band)))
                }
            },
            Limit::SlopePeak { along: direction, base_mm, .. } => {
                let slope_nrad = self.noise_slope_nrad(*direction, *base_mm)?;
                largest(slope_nrad * (2.0 * (2.0 * count).ln()).sqrt())
            }
            Limit::Psd { along: direction, .. } => {
                let white = self.residual.spectra()?.white(noise_nm);
                let line = match direction {
                    Direction::X => Some(white.x),
                    Direction::Y => white.y,
                    Direction::Radial => white.radial,
                };
                // The density of the noise of one line scatters about this mean density, which is
                // subtracted.
                largest(line.map_or(0.0, |line| line.height[0]))
            }
            Limit::Strehl { wavelength_nm, grazing_mrad, .. } => {
                let light = Light {
                    wavelength_nm: *wavelength_nm,
                    grazing_mrad: grazing_mrad.unwrap_or(NORMAL_MRAD),
                };
                let rms_nm = self.residual.height()?.rms;
                let without_nm = (rms_nm.powi(2) - noise_nm.powi(2)).max(0.0).sqrt();
                let [with, without] = [noise_nm, without_nm].map(|nm| strehl(light, nm));
                report.with_and_without_noise(with?.strehl, without?.strehl)
            }
            Limit::Radius { .. } | Limit::AutocorrelationLength { .. } => report,
        })
    }

    /// Returns the RMS of the slope of the noise over a base, nrad: the difference of two noisy heights over the base.
    fn noise_slope_nrad(&self, direction: Direction, base_mm: f64) -> Result<f64, Invalid> {
        let used_mm = self.residual.slope(direction, base_mm)?.base_mm;
        // nm/mm is urad.
        Ok(1e3 * 2.0_f64.sqrt() * self.noise_nm / used_mm)
    }
    /// Returns the direction of a spectrum; where a limit leaves it out, x for a profile and radial for a map.
    fn direction_of(&self, direction: Option<Direction>) -> Direction {
        match direction {
            Some(direction) => direction,
            None if self.is_profile => Direction::X,
            None => Direction::Radial,
        }
    }

    fn measured(&self) -> Result<LimitReport, Invalid> {
        let residual = self.residual;
        Ok(match self.limit {
            Limit::HeightRms { along: direction, at_most_nm, .. } => {
                self.height_rms(*direction, *at_most_nm)?
            }
            Limit::HeightPv { at_most_nm, .. } => {
                let text = self.after("PV height".into());
                LimitReport::new(text, "nm", residual.height()?.pv, Bound::AtMost, *at_most_nm)
                    .worst_at(place(residual.farthest_height()?.0))
            }
            Limit::SlopeRms { along: direction, base_mm, at_most_nrad, .. } => {
                self.slope_rms(*direction, *base_mm, *at_most_nrad)?
            }
            Limit::SlopePeak { along: direction, base_mm, at_most_nrad, .. } => {
                let slope = residual.slope(*direction, *base_mm)?;
                let base = base_in_words(slope.base_mm);
                let text = self.after(format!("largest slope{}{base}", along(*direction)));
                LimitReport::new(text, "nrad", slope.peak_nrad, Bound::AtMost, *at_most_nrad)
                    .worst_at(place(slope.peak_at_mm))
            }
            Limit::Psd { along: direction, a, b, frequency_per_mm, .. } => {
                self.psd(*direction, [*a, *b], *frequency_per_mm)?
            }
            Limit::Strehl { wavelength_nm, grazing_mrad, at_least, .. } => {
                let light = Light {
                    wavelength_nm: *wavelength_nm,
                    grazing_mrad: grazing_mrad.unwrap_or(NORMAL_MRAD),
                };
                let value = strehl(light, residual.height()?.rms)?.strehl;
                let angle = grazing_mrad.map_or(String::new(), |g| format!(" under {g} mrad"));
                let text = self.after(format!("Strehl ratio at {wavelength_nm} nm{angle}"));
                LimitReport::new(text, "", value, Bound::AtLeast, *at_least)
            }
            Limit::Radius { along: direction, at_least_m, .. } => {
                // A shape without curvature has no radius that could be too small.
                let value = residual.shape.radius_m.map_or(f64::INFINITY, f64::abs);
                let text = format!("radius of curvature{}{}", along(*direction), self.in_zone());
                LimitReport::new(text, "m", value, Bound::AtLeast, *at_least_m)
            }
            Limit::AutocorrelationLength { along: direction, at_least_mm, .. } => {
                let value = residual.autocorrelation_length_mm(*direction).ok_or_else(|| {
                    let problem = "has no autocorrelation length: it is longer than the zone";
                    Invalid::whole("map", problem, "leave the limit out, or give a larger zone")
                })?;
                let text = self.after(format!("autocorrelation length{}", along(*direction)));
                LimitReport::new(text, "mm", value, Bound::AtLeast, *at_least_mm)
            }
        })
    }

    fn height_rms(
        &self,
        direction: Option<Direction>,
        at_most_nm: f64,
    ) -> Result<LimitReport, Invalid> {
        let value = match self.band() {
            None => self.residual.height()?.rms,
            Some(band) => {
                let direction = self.direction_of(direction);
                let line = spectrum_line(self.residual, direction)?;
                check_band(line, band)?;
                match direction {
                    Direction::Radial => self.residual.spectra()?.height_rms_nm(band),
                    _ => line.height_rms(band),
                }
            }
        };
        let direction = direction.map_or("", along);
        let text = self.after(format!("RMS height{direction}{}", self.of_periods()));
        let report = LimitReport::new(text, "nm", value, Bound::AtMost, at_most_nm);
        Ok(match self.band() {
            None => report.worst_at(place(self.residual.farthest_height()?.0)),
            Some(_) => report,
        })
    }

    fn slope_rms(
        &self,
        direction: Direction,
        base_mm: Option<f64>,
        at_most_nrad: f64,
    ) -> Result<LimitReport, Invalid> {
        let name = format!("RMS slope{}", along(direction));
        let Some(band) = self.band() else {
            let slope = self.residual.slope(direction, base_mm.unwrap_or_default())?;
            let text = self.after(format!("{name}{}", base_in_words(slope.base_mm)));
            let report =
                LimitReport::new(text, "nrad", slope.rms_nrad, Bound::AtMost, at_most_nrad);
            return Ok(report.worst_at(place(slope.peak_at_mm)));
        };
        let line = spectrum_line(self.residual, direction)?;
        check_band(line, band)?;
        let text = self.after(format!("{name}{}", self.of_periods()));
        Ok(LimitReport::new(text, "nrad", line.slope_rms(band), Bound::AtMost, at_most_nrad))
    }

    /// Returns the verdict on a PSD line: the density at the frequency at which its ratio to A / f^B is largest,
    /// against A / f^B there.
    fn psd(
        &self,
        direction: Direction,
        [a, b]: [f64; 2],
        [low, high]: [f64; 2],
    ) -> Result<LimitReport, Invalid> {
        let line = spectrum_line(self.residual, direction)?;
        let inside = line.frequency_per_mm.iter().zip(&line.height);
        let worst = inside
            .filter(|(f, s)| **f >= low && **f <= high && s.is_finite())
            .map(|(f, s)| (*f, *s, a / f.powf(b)))
            .max_by(|p, q| (p.1 / p.2).total_cmp(&(q.1 / q.2)));
        let Some((f, density, allowed)) = worst else {
            return Err(no_frequency(line, [low, high]));
        };
        let unit = match direction {
            Direction::Radial => "nm^2 mm^2",
            _ => "nm^2 mm",
        };
        let direction = along(direction);
        let text = self.after(format!("PSD{direction} from {low} to {high} /mm under {a} / f^{b}"));
        Ok(LimitReport::new(text, unit, density, Bound::AtMost, allowed)
            .worst_at(format!("at {} /mm", significant(f, 4))))
    }

    /// Returns the band of frequencies of the periods of the limit, 1/mm; `None` if it limits no periods.
    fn band(&self) -> Option<[f64; 2]> {
        self.limit.periods().map(|[shortest, longest]| [1.0 / longest, 1.0 / shortest])
    }

    fn of_periods(&self) -> String {
        match self.limit.periods() {
            Some([0.0, longest]) => format!(", periods up to {longest} mm"),
            Some([shortest, f64::INFINITY]) => format!(", periods above {shortest} mm"),
            Some([shortest, longest]) => format!(", periods {shortest} to {longest} mm"),
            None => String::new(),
        }
    }

    fn in_zone(&self) -> String {
        self.limit.zone().map_or(String::new(), |z| format!(", zone \"{z}\""))
    }

    /// Returns the words for the quantity, with the shape that is subtracted and the zone.
    fn after(&self, quantity: String) -> String {
        format!("{quantity} after {}{}", self.limit.after().name(), self.in_zone())
    }
}

fn along(direction: Direction) -> &'static str {
    match direction {
        Direction::X => " along x",
        Direction::Y => " along y",
        Direction::Radial => ", radial",
    }
}

fn place([x, y]: [f64; 2]) -> String {
    format!("at x {}, y {} mm", significant(x, 4), significant(y, 4))
}

fn base_in_words(base_mm: f64) -> String {
    if base_mm > 0.0 {
        format!(", base {} mm", significant(base_mm, 4))
    } else {
        " as measured".into()
    }
}

fn spectrum_line(residual: &ShapeResidual, direction: Direction) -> Result<&SpectrumLine, Invalid> {
    let spectra = residual.spectra()?;
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
    if line.holds(band) { Ok(()) } else { Err(no_frequency(line, band)) }
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
