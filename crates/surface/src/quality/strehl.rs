//! The Strehl ratio after Marechal: `exp(-(4 pi sin(g) RMS / wavelength)^2)`, g the grazing angle.

use std::f64::consts::PI;

use planish_types::Invalid;
use serde::Serialize;

/// Light that a mirror reflects.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Light {
    /// Wavelength, nm.
    pub wavelength_nm: f64,
    /// Grazing angle, mrad; 1570.8 is normal incidence.
    pub grazing_mrad: f64,
}

/// Strehl ratio after Marechal, with the light and the phase error.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct StrehlReport {
    /// Light for which the ratio holds.
    pub light: Light,
    /// RMS of the phase error of the reflected light, rad.
    pub phase_rms_rad: f64,
    /// Strehl ratio, 0 to 1.
    pub strehl: f64,
}

/// Returns the Strehl ratio of a mirror whose heights have the RMS `rms_nm`. Refuses a wavelength or an angle out of
/// its range.
pub(crate) fn strehl(light: Light, rms_nm: f64) -> Result<StrehlReport, Invalid> {
    let Light { wavelength_nm, grazing_mrad } = light;
    if !(wavelength_nm.is_finite() && wavelength_nm > 0.0) {
        let problem = format!("`wavelength_nm` is {wavelength_nm}");
        return Err(Invalid::whole("light", problem, "give a wavelength in nm, above 0"));
    }
    let largest_mrad = 1e3 * PI / 2.0;
    // 1570.8 stands for a right angle.
    if !(grazing_mrad > 0.0 && grazing_mrad <= largest_mrad + 0.01) {
        let problem = format!("`grazing_mrad` is {grazing_mrad}");
        let remedy =
            "give the angle to the surface in mrad, above 0 and at most 1570.8 (normal incidence)";
        return Err(Invalid::whole("light", problem, remedy));
    }
    let grazing = (1e-3 * grazing_mrad).min(PI / 2.0);
    let phase_rms_rad = 4.0 * PI * grazing.sin() * rms_nm / wavelength_nm;
    Ok(StrehlReport { light, phase_rms_rad, strehl: (-phase_rms_rad * phase_rms_rad).exp() })
}
