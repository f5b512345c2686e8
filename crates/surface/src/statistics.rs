//! Numbers that describe a map: RMS, PV, and a robust PV that does not depend on one bad pixel.
//!
//! ```text
//! RMS  = sqrt(mean (z - mean z)^2)        PV = max z - min z
//! PVr  = PV(low-order fit) + 3 RMS(z - low-order fit)
//! ```
//!
//! The fit of PVr has 36 terms: Zernike terms up to n = 7 for a disc, Legendre terms with i + j <= 7 for a
//! rectangle. The source defines PVr on discs with the first 36 Zernike terms. The same number of Legendre
//! terms on a rectangle is a definition of Planish.
//!
//! Source: C. J. Evans, Opt. Eng. 48 (2009) 043605.

use planish_form::low_order::{Circle, Family, LowOrderSettings, low_order};
use planish_types::{Invalid, Surface};
use serde::Serialize;

/// Highest order of the fit of PVr; it has 36 terms, as in the source. Another order gives another
/// quantity.
const PVR_ORDER: u32 = 7;

/// Statistics of the valid pixels of a map.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SurfaceStatistics {
    /// Shape of the map (rows, columns).
    pub shape: (usize, usize),
    /// Number of valid pixels.
    pub valid_pixels: usize,
    /// Area of the valid pixels, mm^2.
    pub valid_area_mm2: f64,
    /// Mean height, nm.
    pub mean_nm: f64,
    /// Population RMS, mean removed, nm.
    pub rms_nm: f64,
    /// Population RMS, least-squares plane removed, nm.
    pub rms_detilted_nm: f64,
    /// Largest minus smallest height, nm.
    pub pv_nm: f64,
    /// Robust PV (PVr); absent if its terms cannot be fitted.
    pub pvr: Option<RobustPv>,
    /// Reason why the robust PV is absent; left out if the robust PV is there.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub pvr_note: Option<String>,
}

/// Robust PV (PVr of the module) and its parts.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct RobustPv {
    /// Robust PV: `fit_pv_nm` plus three times `rest_rms_nm`, nm.
    pub pvr_nm: f64,
    /// PV of the low-order fit over the valid pixels, nm.
    pub fit_pv_nm: f64,
    /// RMS of the map minus the low-order fit, nm.
    pub rest_rms_nm: f64,
    /// Family of the fitted terms.
    pub family: Family,
    /// Highest order of the fitted terms.
    pub order: u32,
    /// Definition of the robust PV, in words.
    pub definition: &'static str,
}

/// Describes `surface`. `family` is that of the fit of PVr; `None` takes the one that suits
/// their outline ([`Family::suited_to`]). `circle` is the unit circle of Zernike
/// terms, as in [`LowOrderSettings`].
///
/// # Errors
/// If a circle is given, refuses it for other than Zernike terms, if it does not hold all valid pixels, or if these do
/// not determine the terms.
pub fn surface_statistics(
    surface: &Surface,
    family: Option<Family>,
    circle: Option<Circle>,
) -> Result<SurfaceStatistics, Invalid> {
    let s = surface.statistics();
    let family = family.unwrap_or_else(|| Family::suited_to(surface));
    let (pvr, pvr_note) = match robust_pv(surface, family, circle) {
        Ok(pvr) => (Some(pvr), None),
        // A map that is too small for 36 terms still has an RMS; a wrong circle is a mistake.
        Err(e) if circle.is_none() => (None, Some(e.to_string())),
        Err(e) => return Err(e),
    };
    Ok(SurfaceStatistics {
        shape: surface.height_nm().dim(),
        valid_pixels: s.valid_count,
        valid_area_mm2: s.valid_count as f64 * surface.grid().pixel_mm2(),
        mean_nm: s.mean,
        rms_nm: s.rms,
        rms_detilted_nm: surface.detilted_rms_nm(),
        pv_nm: s.pv,
        pvr,
        pvr_note,
    })
}

/// Returns the robust PV with the terms of a family. Refuses valid pixels that do not determine the terms, and a circle
/// that does not contain all of them.
fn robust_pv(
    surface: &Surface,
    family: Family,
    circle: Option<Circle>,
) -> Result<RobustPv, Invalid> {
    let fitted = low_order(surface, &LowOrderSettings { family, order: PVR_ORDER, circle })?;
    let rest = Surface::new(*surface.grid(), surface.height_nm() - &fitted.shape_nm)?;
    let fit_pv_nm = fitted.report.pv_nm;
    let rest_rms_nm = rest.statistics().rms;
    Ok(RobustPv {
        // PVr = PV(fit) + 3 RMS(rest)
        pvr_nm: fit_pv_nm + 3.0 * rest_rms_nm,
        fit_pv_nm,
        rest_rms_nm,
        family,
        order: PVR_ORDER,
        definition: "PV of the 36-term fit plus 3 RMS of the rest (C. J. Evans, Opt. Eng. 48, 043605)",
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::Array2;
    use planish_types::{Axis, Grid};
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, Normal};

    fn map(round: bool, noise_nm: f64, f: impl Fn(f64, f64) -> f64) -> Surface {
        let axis = Axis::new(-1.0, 0.01, 201).unwrap();
        let grid = Grid { x: axis, y: axis };
        let mut rng = ChaCha8Rng::seed_from_u64(8);
        let noise = Normal::new(0.0, noise_nm).unwrap();
        let map = Array2::from_shape_fn(grid.shape(), |(r, c)| {
            let (x, y) = (axis.coordinate_mm(c), axis.coordinate_mm(r));
            let z = f(x, y) + noise.sample(&mut rng);
            if round && x.hypot(y) > 1.0 { f64::NAN } else { z }
        });
        Surface::new(grid, map).unwrap()
    }

    #[test]
    fn the_robust_pv_of_a_figure_with_noise_is_its_pv_and_three_sigma() {
        // Astigmatism: 20 nm PV on the disc; on the square x^2 - y^2 too.
        for (round, family) in [(true, Family::Zernike), (false, Family::Legendre)] {
            let figure = |x: f64, y: f64| 10.0 * (x * x - y * y);
            let s = surface_statistics(&map(round, 0.5, figure), None, None).unwrap().pvr.unwrap();
            assert_eq!(s.family, family);
            // The noise of 30000 pixels is known to 0.5 %; in the fit it is 0.5 sqrt(36 / 30000)
            // RMS, at the rim some times that.
            assert!((s.rest_rms_nm / 0.5 - 1.0).abs() < 0.02, "{s:?}");
            assert!((s.fit_pv_nm - 20.0).abs() < 0.3, "{s:?}");
            assert_eq!(s.pvr_nm, s.fit_pv_nm + 3.0 * s.rest_rms_nm);
        }
    }

    #[test]
    fn one_bad_pixel_decides_the_pv_and_not_the_robust_pv() {
        let figure = |x: f64, y: f64| 10.0 * (x * x - y * y);
        let with = |x: f64, y: f64| figure(x, y) + if x == -0.5 && y == -0.5 { 200.0 } else { 0.0 };
        let clean = surface_statistics(&map(true, 0.5, figure), None, None).unwrap();
        let dirty = surface_statistics(&map(true, 0.5, with), None, None).unwrap();
        assert!(dirty.pv_nm > clean.pv_nm + 150.0, "{dirty:?}");
        // 200 nm on one of 31400 pixels: sqrt(0.5^2 + 200^2 / 31400) = 1.23 nm RMS.
        let pvr = |s: SurfaceStatistics| s.pvr.unwrap().pvr_nm;
        assert!(pvr(dirty) < pvr(clean) + 4.0);
    }

    #[test]
    fn a_map_that_is_too_small_for_the_fit_still_has_its_rms() {
        let axis = Axis::new(0.0, 1.0, 2).unwrap();
        let four = Array2::from_shape_fn((2, 2), |(r, c)| (r + c) as f64);
        let four = Surface::new(Grid { x: axis, y: axis }, four).unwrap();
        let s = surface_statistics(&four, None, None).unwrap();
        assert_eq!((s.rms_nm, s.pvr), (0.5_f64.sqrt(), None));
        assert!(s.pvr_note.unwrap().contains("4 valid pixel(s) for 36 terms"));
        let circle = Circle { centre_mm: [0.0; 2], radius_mm: 0.0 };
        assert!(surface_statistics(&four, Some(Family::Zernike), Some(circle)).is_err());
    }
}
