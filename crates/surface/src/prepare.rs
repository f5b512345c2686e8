//! Preparation of the desired removal from a measured map.
//!
//! In this order:
//!
//! 1. clear aperture: pixels outside become invalid, the map is cropped to the bounding box;
//! 2. outlier mask ([`crate::outliers`]): pits and dust become invalid;
//! 3. target ([`crate::target`]): a form, as given or fitted, is subtracted; the mask is found in what it leaves;
//! 4. level: a plane `a + b x + c y`, or terms of low order ([`mod@planish_form::low_order`]), is
//!    subtracted, fitted to the valid pixels, and the smallest valid height becomes 0 (the machine
//!    can only remove);
//! 5. fill ([`mod@crate::fill`]): holes get a height;
//! 6. extend ([`crate::extension`]): pixels beyond the clear aperture get a height.
//!
//! The last two are for programs that cannot skip pixels; by default invalid pixels stay invalid.
//!
//! ```text
//! z'(x, y) = z(x, y) - (a + b x + c y)
//! none:      a = b = c = 0
//! piston:    b = c = 0, min z' = 0
//! plane:     (b, c) minimise sum (z - a0 - b x - c y)^2 over the valid pixels, min z' = 0
//! low order: z' = z - sum_k c_k phi_k - a,  c minimise the sum of squares, min z' = 0
//! ```
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | z | `measured` | (ny, nx) | nm |
//! | a | `constant_nm` | - | nm |
//! | b, c | `slope_nm_per_mm` | (2) | nm/mm |

use ndarray::{Array2, s};
use planish_form::low_order::{LowOrderReport, LowOrderSettings, low_order};
use planish_numerics::statistics::{Plane, fit_plane, statistics, subtract_plane};
use planish_types::{ClearAperture, Grid, Surface, doubts, progress};
use serde::{Serialize, Serializer};
use serde_json::json;

use crate::{
    PrepareError,
    extension::{ExtensionReport, ExtensionSettings, extend},
    fill::{FillReport, enclosed, fill},
    outliers::{OutlierReport, OutlierSettings, Outliers, outliers},
    target::{Target, TargetReport, without_target},
};

/// Smallest number of valid pixels for a plane; fewer are refused. Larger: refuses small maps. Smaller:
/// noise decides the tilt. Derived: twice the number of its coefficients.
const MIN_PIXELS_FOR_PLANE: usize = 6;

/// Settings of the preparation of a map.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PrepareSettings {
    /// Clear aperture, the region that counts; `None` keeps the whole map.
    #[serde(serialize_with = "describe_aperture")]
    pub aperture: Option<ClearAperture>,
    /// Settings of the outlier mask; `None` for no mask.
    pub outliers: Option<OutlierSettings>,
    /// Function that is subtracted from the map.
    pub level: Level,
    /// True to fill the invalid pixels in the clear aperture, or the enclosed ones if no aperture is given.
    pub fill: bool,
    /// Settings of the extension beyond the clear aperture; `None` for no extension.
    pub extension: Option<ExtensionSettings>,
}

/// Function that is subtracted from the map.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Level {
    /// Nothing is subtracted.
    None,
    /// A constant, so that the smallest height is 0.
    #[default]
    Piston,
    /// The least-squares plane, then a constant so that the smallest height is 0.
    Plane,
    /// Terms of low order, then a constant so that the smallest height is 0.
    LowOrder(LowOrderSettings),
}

/// The prepared map and what was done to it.
#[derive(Clone, Debug)]
pub struct Prepared {
    /// Prepared map: the desired removal, nm.
    pub surface: Surface,
    /// Numbers of the preparation for the manifest.
    pub report: PrepareReport,
}

/// Numbers of the preparation, step by step, for the manifest.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PrepareReport {
    /// Statistics of the measured map as given.
    pub before: MapStatistics,
    /// Statistics of the map within the clear aperture, before outliers are masked and a form or the level is
    /// subtracted.
    pub in_aperture: MapStatistics,
    /// Statistics of the prepared map.
    pub after: MapStatistics,
    /// Numbers of the outlier mask; `None` without one.
    pub outliers: Option<OutlierReport>,
    /// The target form that was subtracted, with its fit; `None` without one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub target: Option<TargetReport>,
    /// The plane that was subtracted; with low-order terms only the constant that makes the smallest height 0, and 0
    /// for no level.
    pub removed_plane: RemovedPlane,
    /// The terms of low order that were subtracted; `None` without them.
    pub removed_low_order: Option<LowOrderReport>,
    /// The holes that were filled; `None` if filling was not asked for.
    pub filled: Option<FillReport>,
    /// Numbers of the extension beyond the clear aperture; `None` without one.
    pub extended: Option<ExtensionReport>,
    /// Probable mistakes in the map, with their remedies.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub doubts: Vec<String>,
}

/// Statistics of the valid pixels of a map.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct MapStatistics {
    /// Population RMS, mean removed, nm.
    pub rms_nm: f64,
    /// Population RMS, least-squares plane removed, nm.
    pub rms_detilted_nm: f64,
    /// Largest minus smallest height, nm.
    pub pv_nm: f64,
    /// Number of valid pixels.
    pub valid_pixels: usize,
    /// Shape of the map (rows, columns).
    pub shape: (usize, usize),
}

/// Plane `constant_nm + slope_nm_per_mm . (x, y)` that was subtracted, in part coordinates.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct RemovedPlane {
    /// Height at x = y = 0, nm.
    pub constant_nm: f64,
    /// Slope of the plane along [x, y], nm/mm.
    pub slope_nm_per_mm: [f64; 2],
}

/// Prepares `measured`: crops, masks, levels, fills and extends it, without a target form. Refuses what [`prepare_to`]
/// refuses.
pub fn prepare(measured: &Surface, settings: &PrepareSettings) -> Result<Prepared, PrepareError> {
    prepare_to(measured, settings, None)
}

/// Prepares `measured` minus the form `target`: crops, masks, levels, fills and extends it.
///
/// # Errors
/// Refuses settings of a step out of their range, an aperture of less than 2 x 2 pixels, too many outliers, valid
/// pixels that do not define what is fitted, and a form that does not exist at one of them.
pub fn prepare_to(
    measured: &Surface,
    settings: &PrepareSettings,
    target: Option<&Target>,
) -> Result<Prepared, PrepareError> {
    let (cropped, inside) = match &settings.aperture {
        Some(aperture) => crop(measured, aperture).map(|(map, inside)| (map, Some(inside)))?,
        None => (measured.clone(), None),
    };
    // Steps that take long on a large map: the mask first, the extension last.
    let parts =
        usize::from(settings.outliers.is_some()) + usize::from(settings.extension.is_some());
    // The mask is found in what the form leaves, and the form is fitted again without the masked pixels.
    let mut without_form = target.map(|target| without_target(&cropped, target)).transpose()?;
    let to_mask = without_form.as_ref().map_or(&cropped, |(map, _)| map);
    let (mut masked, outliers) = match &settings.outliers {
        Some(settings) => progress::part(0, parts, || mask_outliers(to_mask, settings))?,
        None => (to_mask.clone(), None),
    };
    if let (Some(target), Some(_)) = (target, &outliers) {
        let mut map = cropped.height_nm().clone();
        map.zip_mut_with(masked.height_nm(), |z, masked| {
            if masked.is_nan() {
                *z = f64::NAN;
            }
        });
        let fitted = without_target(&Surface::new(*cropped.grid(), map)?, target)?;
        masked = fitted.0.clone();
        without_form = Some(fitted);
    }
    let (mut surface, removed_plane, removed_low_order) = level(&masked, settings.level)?;
    // A pixel that is not a height decides everything else.
    let levelled = map_statistics(&surface);
    let MapStatistics { pv_nm, rms_nm, rms_detilted_nm, .. } = levelled;
    let aperture = settings.aperture.as_ref();
    let pixels = aperture
        .and_then(|aperture| doubts::of_circle(measured, aperture))
        .or_else(|| doubts::of_mask(&masked));
    let heights =
        doubts::of_heights(&masked).or_else(|| doubts::of_removal(pv_nm, rms_nm, rms_detilted_nm));
    let doubts = pixels.into_iter().chain(heights).collect();
    let mut filled = None;
    if settings.fill {
        let inside = inside.unwrap_or_else(|| enclosed(&surface));
        let (map, report) = fill(&surface, &inside)?;
        surface = map;
        filled = Some(report);
    }
    let mut extended = None;
    if let Some(settings) = &settings.extension {
        let (map, report) = progress::part(parts - 1, parts, || extend(&surface, settings))?;
        surface = map;
        extended = Some(report);
    }
    // The steps move heights and fill gaps: a pixel keeps its deviation, and one without a measurement has none.
    let margin = extended.as_ref().map_or((0, 0), |e| e.margin_px);
    let surface = with_deviation(surface, known_deviation(&cropped, &masked), margin)?;
    let report = PrepareReport {
        before: map_statistics(measured),
        in_aperture: map_statistics(&cropped),
        after: match (&filled, &extended) {
            (None, None) => levelled,
            _ => map_statistics(&surface),
        },
        outliers,
        target: without_form.map(|(_, report)| report),
        removed_plane,
        removed_low_order,
        filled,
        extended,
        doubts,
    };
    Ok(Prepared { surface, report })
}

/// Returns the standard deviations of `cropped` (ny, nx), nm, with NaN at the pixels that are masked. `None` if the map
/// has no deviations.
fn known_deviation(cropped: &Surface, masked: &Surface) -> Option<Array2<f64>> {
    let mut known = cropped.deviation_nm()?.clone();
    known.zip_mut_with(masked.height_nm(), |s, z| {
        if z.is_nan() {
            *s = f64::NAN;
        }
    });
    Some(known)
}

/// Returns the map cropped to the bounding box of the aperture, with NaN outside the aperture, and the mask of the
/// aperture on the cropped pixels. Refuses an aperture of less than 2 x 2 pixels.
fn crop(
    measured: &Surface,
    aperture: &ClearAperture,
) -> Result<(Surface, Array2<bool>), PrepareError> {
    let grid = measured.grid();
    let mask = aperture.mask(grid)?;
    let rows = extent(mask.outer_iter().map(|row| row.iter().any(|m| *m)));
    let columns = extent(mask.columns().into_iter().map(|column| column.iter().any(|m| *m)));
    let height = rows.1 + 1 - rows.0;
    let width = columns.1 + 1 - columns.0;
    if height < 2 || width < 2 {
        return Err(PrepareError::TooSmall { rows: height, columns: width });
    }
    let mut map = measured.height_nm().clone();
    map.zip_mut_with(&mask, |z, inside| {
        if !inside {
            *z = f64::NAN;
        }
    });
    let part = s![rows.0..=rows.1, columns.0..=columns.1];
    let map = map.slice(part).to_owned();
    let inside = mask.slice(part).to_owned();
    let grid = Grid { x: grid.x.crop(columns.0, columns.1)?, y: grid.y.crop(rows.0, rows.1)? };
    let cropped = Surface::new(grid, map)?;
    let deviation = measured.deviation_nm().map(|d| d.slice(part).to_owned());
    Ok((with_deviation(cropped, deviation, (0, 0))?, inside))
}

/// Returns the map with the standard deviations `deviation_nm`, whose first element belongs to its pixel `start` (row,
/// column). At all other pixels they are unknown (NaN).
fn with_deviation(
    map: Surface,
    deviation_nm: Option<Array2<f64>>,
    start: (usize, usize),
) -> Result<Surface, PrepareError> {
    let Some(deviation) = deviation_nm else { return Ok(map) };
    let mut all = Array2::from_elem(map.height_nm().dim(), f64::NAN);
    let (ny, nx) = deviation.dim();
    all.slice_mut(s![start.0..start.0 + ny, start.1..start.1 + nx]).assign(&deviation);
    Ok(map.with_deviation(all)?)
}

/// Returns the indices of the first and the last true flag; an aperture has at least one.
fn extent(flags: impl Iterator<Item = bool>) -> (usize, usize) {
    let set = flags.enumerate().filter(|(_, f)| *f).map(|(i, _)| i);
    set.fold((usize::MAX, 0), |(first, last), i| (first.min(i), last.max(i)))
}

fn mask_outliers(
    surface: &Surface,
    settings: &OutlierSettings,
) -> Result<(Surface, Option<OutlierReport>), PrepareError> {
    let Outliers { mask, report } = outliers(surface, settings)?;
    let mut map = surface.height_nm().clone();
    map.zip_mut_with(&mask, |z, outlier| {
        if *outlier {
            *z = f64::NAN;
        }
    });
    Ok((Surface::new(*surface.grid(), map)?, Some(report)))
}

/// Returns the levelled map, the plane that was subtracted, and the report on low-order terms if these were subtracted.
fn level(
    surface: &Surface,
    level: Level,
) -> Result<(Surface, RemovedPlane, Option<LowOrderReport>), PrepareError> {
    let map = surface.height_nm().view();
    let (x, y) = (surface.grid().x.coordinates(), surface.grid().y.coordinates());
    let plane = match level {
        Level::None => {
            let removed_plane = RemovedPlane { constant_nm: 0.0, slope_nm_per_mm: [0.0; 2] };
            return Ok((surface.clone(), removed_plane, None));
        }
        Level::Piston => Plane { a: surface.statistics().min, b: 0.0, c: 0.0 },
        Level::Plane => {
            let valid = surface.statistics().valid_count;
            let fit = fit_plane(map, &x, &y).filter(|_| valid >= MIN_PIXELS_FOR_PLANE);
            fit.ok_or(PrepareError::NoPlane { valid })?
        }
        Level::LowOrder(settings) => {
            let fitted = low_order(surface, &settings)?;
            // z' = z - sum c phi - a, min z' = 0
            let mut rest = surface.height_nm() - &fitted.shape_nm;
            let min = statistics(rest.view()).map_or(0.0, |s| s.min);
            rest -= min;
            let removed_plane = RemovedPlane { constant_nm: min, slope_nm_per_mm: [0.0; 2] };
            let rest = Surface::new(*surface.grid(), rest)?;
            return Ok((rest, removed_plane, Some(fitted.report)));
        }
    };
    // z' = z - (a + b x + c y), then min z' = 0
    let mut flat: Array2<f64> = subtract_plane(map, &x, &y, plane);
    let min = statistics(flat.view()).map_or(0.0, |s| s.min);
    flat -= min;
    let removed_plane =
        RemovedPlane { constant_nm: plane.a + min, slope_nm_per_mm: [plane.b, plane.c] };
    Ok((Surface::new(*surface.grid(), flat)?, removed_plane, None))
}

fn map_statistics(surface: &Surface) -> MapStatistics {
    let s = surface.statistics();
    MapStatistics {
        rms_nm: s.rms,
        rms_detilted_nm: surface.detilted_rms_nm(),
        pv_nm: s.pv,
        valid_pixels: s.valid_count,
        shape: surface.height_nm().dim(),
    }
}

/// Writes the aperture into the settings of the manifest. A mask is an input of its own; the settings only state that
/// there is one.
fn describe_aperture<S: Serializer>(
    aperture: &Option<ClearAperture>,
    serializer: S,
) -> Result<S::Ok, S::Error> {
    let value = match aperture {
        None => json!("whole map"),
        Some(ClearAperture::Rectangle { x_mm, y_mm }) => {
            json!({ "rectangle": { "x_mm": x_mm, "y_mm": y_mm } })
        }
        Some(ClearAperture::Circle { centre_mm, radius_mm }) => {
            json!({ "circle": { "centre_mm": centre_mm, "radius_mm": radius_mm } })
        }
        Some(ClearAperture::Mask(_)) => json!("mask"),
    };
    value.serialize(serializer)
}

#[cfg(test)]
mod tests {
    use super::*;
    use planish_types::Axis;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    fn grid() -> Grid {
        Grid { x: Axis::new(-3.0, 0.1, 61).unwrap(), y: Axis::new(10.0, 0.2, 41).unwrap() }
    }

    fn settings(aperture: Option<ClearAperture>, level: Level) -> PrepareSettings {
        PrepareSettings { aperture, outliers: None, level, fill: false, extension: None }
    }

    #[test]
    fn a_pixel_keeps_its_deviation_through_every_step() {
        let mut map = rough(3);
        map[[20, 30]] = f64::NAN;
        let at = |r: usize, c: usize| (100 * r + c) as f64;
        let deviation = Array2::from_shape_fn(map.dim(), |(r, c)| at(r, c));
        let surface = Surface::new(grid(), map).unwrap().with_deviation(deviation).unwrap();
        let whole = PrepareSettings {
            fill: true,
            extension: Some(ExtensionSettings {
                margin_mm: 0.5,
                method: crate::extension::ExtensionMethod::Nearest,
            }),
            ..settings(disc(), Level::Plane)
        };
        let done = prepare(&surface, &whole).unwrap().surface;
        let found = done.deviation_nm().unwrap();
        let mut known = 0;
        for ((r, c), s) in found.indexed_iter().filter(|(_, s)| !s.is_nan()) {
            let (x, y) = (done.grid().x.coordinate_mm(c), done.grid().y.coordinate_mm(r));
            let [column, row] = [(x + 3.0) / 0.1, (y - 10.0) / 0.2].map(|v| v.round() as usize);
            assert_eq!(*s, at(row, column));
            // Rounding of coordinates, as in the aperture.
            assert!((x - 0.2).hypot(y - 14.0) <= 2.0 + 1e-9 && (row, column) != (20, 30));
            known += 1;
        }
        let inside = prepare(&surface, &settings(disc(), Level::None)).unwrap();
        assert_eq!(known, inside.report.after.valid_pixels);
    }

    fn disc() -> Option<ClearAperture> {
        Some(ClearAperture::Circle { centre_mm: [0.2, 14.0], radius_mm: 2.0 })
    }

    fn rough(seed: u64) -> Array2<f64> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        Array2::from_shape_simple_fn(grid().shape(), || rng.random_range(-5.0..5.0))
    }

    fn tilted(mut map: Array2<f64>, a: f64, b: f64, c: f64) -> Surface {
        for ((row, column), v) in map.indexed_iter_mut() {
            *v += a + b * grid().x.coordinate_mm(column) + c * grid().y.coordinate_mm(row);
        }
        Surface::new(grid(), map).unwrap()
    }

    #[test]
    fn a_plane_on_a_masked_map_is_removed_exactly_and_named() {
        let surface = tilted(Array2::zeros(grid().shape()), 7.0, 3.0, -20.0);
        let done = prepare(&surface, &settings(disc(), Level::Plane)).unwrap();
        // Heights of 300 nm carry rounding of 1e-13 each; the fit may add one digit.
        assert!(done.report.after.pv_nm < 1e-11, "{:?}", done.report);
        let RemovedPlane { constant_nm, slope_nm_per_mm: [b, c] } = done.report.removed_plane;
        // Below: rounding of heights of 300 nm, and over 2 mm.
        assert!((b - 3.0).abs() < 1e-12 && (c + 20.0).abs() < 1e-12, "{b} {c}");
        assert!((constant_nm - 7.0).abs() < 1e-10, "{constant_nm}");
    }

    #[test]
    fn adding_a_plane_leaves_the_levelled_map_unchanged() {
        let settings = settings(disc(), Level::Plane);
        let one = prepare(&tilted(rough(1), 0.0, 0.0, 0.0), &settings).unwrap().surface;
        let two = prepare(&tilted(rough(1), -80.0, 11.0, 6.0), &settings).unwrap().surface;
        let difference = (one.height_nm() - two.height_nm()).mapv(f64::abs);
        // Rounding as above.
        assert!(difference.iter().all(|d| d.is_nan() || *d < 1e-11));
    }

    #[test]
    fn levelling_twice_is_levelling_once_and_the_rms_is_the_detilted_one() {
        let settings = settings(None, Level::Plane);
        let once = prepare(&tilted(rough(2), 1.0, 2.0, 3.0), &settings).unwrap();
        let twice = prepare(&once.surface, &settings).unwrap();
        let difference = (once.surface.height_nm() - twice.surface.height_nm()).mapv(f64::abs);
        // Below: rounding of heights of some ten nm.
        assert!(difference.iter().all(|d| *d < 1e-12));
        let (before, after) = (once.report.before, once.report.after);
        assert!((after.rms_nm - before.rms_detilted_nm).abs() < 1e-12);
        assert!(before.rms_nm > before.rms_detilted_nm + 1.0);
    }

    #[test]
    fn piston_only_shifts_and_none_touches_nothing() {
        let surface = tilted(rough(3), 50.0, 4.0, 0.0);
        let done = prepare(&surface, &settings(None, Level::Piston)).unwrap();
        assert_eq!(done.surface.statistics().min, 0.0);
        let min = surface.statistics().min;
        assert_eq!(done.report.removed_plane.constant_nm, min);
        assert_eq!(done.surface.height_nm(), &surface.height_nm().mapv(|v| v - min));
        let done = prepare(&surface, &settings(None, Level::None)).unwrap();
        assert_eq!(done.surface.height_nm(), surface.height_nm());
    }

    #[test]
    fn the_aperture_crops_to_its_bounding_box_and_keeps_coordinates() {
        let surface = tilted(Array2::zeros(grid().shape()), 0.0, 1.0, 100.0);
        let done = prepare(&surface, &settings(disc(), Level::None)).unwrap();
        let g = *done.surface.grid();
        // x 0.2 +- 2 in steps of 0.1; y 14 +- 2 in steps of 0.2.
        assert_eq!(g.shape(), (21, 41));
        // Rounding of coordinates.
        assert!((g.x.start_mm() + 1.8).abs() < 1e-12 && (g.y.start_mm() - 12.0).abs() < 1e-12);
        for ((r, c), z) in done.surface.height_nm().indexed_iter() {
            let (x, y) = (g.x.coordinate_mm(c), g.y.coordinate_mm(r));
            let inside = (x - 0.2).hypot(y - 14.0) <= 2.0 + 1e-9;
            assert_eq!(z.is_nan(), !inside, "{x} {y}");
            // Rounding of heights of 1600 nm.
            assert!(z.is_nan() || (z - (x + 100.0 * y)).abs() < 1e-9);
        }
    }

    #[test]
    fn what_cannot_be_prepared_says_why() {
        let surface = tilted(rough(4), 0.0, 0.0, 0.0);
        let message = |aperture, level| {
            prepare(&surface, &settings(Some(aperture), level)).unwrap_err().to_string()
        };
        let row = ClearAperture::Rectangle { x_mm: [-1.0, 1.0], y_mm: [11.9, 12.1] };
        assert!(message(row, Level::None).contains("1 row(s) and 21 column(s)"));
        let mut cross = Array2::from_elem(grid().shape(), false);
        for k in [0, 5, 10, 15, 20, 25] {
            cross[[k, k]] = true;
        }
        let line = ClearAperture::Mask(cross);
        assert!(message(line, Level::Plane).contains("6 valid pixel(s) do not define one"));
        let outside = ClearAperture::Circle { centre_mm: [99.0, 0.0], radius_mm: 1.0 };
        assert!(message(outside, Level::None).contains("no pixel"));
    }

    #[test]
    fn a_masked_pit_no_longer_sets_the_minimum() {
        let mut map = Array2::zeros(grid().shape());
        map[[20, 30]] = -20.0;
        let surface = tilted(map, 5.0, 0.0, 0.0);
        let outliers = Some(OutlierSettings::for_feature_mm(2.0));
        let settings = PrepareSettings { outliers, ..settings(None, Level::Piston) };
        let done = prepare(&surface, &settings).unwrap();
        assert_eq!(done.report.in_aperture.pv_nm, 20.0);
        // Rounding of 5 nm.
        assert!(done.report.after.pv_nm < 1e-12);
        assert_eq!(done.report.after.valid_pixels, 61 * 41 - 49);
    }

    #[test]
    fn levelled_with_low_order_nothing_of_it_is_left_and_the_minimum_is_zero() {
        use planish_form::low_order::Family;
        let surface = tilted(rough(6), 3.0, -2.0, 5.0);
        let terms = LowOrderSettings { family: Family::Legendre, order: 4, circle: None };
        let done = prepare(&surface, &settings(disc(), Level::LowOrder(terms))).unwrap();
        assert_eq!(done.surface.statistics().min, 0.0);
        let again = low_order(&done.surface, &terms).unwrap().report;
        // Rounding of heights of some ten nm, times the condition of the terms.
        assert!(again.pv_nm < 1e-11, "{}", again.pv_nm);
        let removed = done.report.removed_low_order.unwrap();
        assert_eq!((removed.terms.len(), removed.terms[1].order), (15, [1, 0]));
        // The domain is the disc's box: 2 mm from its middle a slope of -2 nm/mm is -4 nm.
        assert!((removed.terms[1].coefficient_nm + 4.0).abs() < 1.0, "{:?}", removed.terms[1]);
    }

    #[test]
    fn with_an_aperture_its_invalid_pixels_are_filled_and_no_others() {
        let mut map = Array2::zeros(grid().shape());
        // A dropout on the rim of the disc, which no ring of valid pixels encloses.
        map.slice_mut(s![18..23, 44..60]).fill(f64::NAN);
        let surface = tilted(map, 5.0, 1.0, 0.0);
        let filling = PrepareSettings { fill: true, ..settings(disc(), Level::None) };
        let done = prepare(&surface, &filling).unwrap();
        assert!(done.report.filled.as_ref().unwrap().filled_pixels > 20);
        let g = *done.surface.grid();
        for ((r, c), z) in done.surface.height_nm().indexed_iter() {
            let inside =
                (g.x.coordinate_mm(c) - 0.2).hypot(g.y.coordinate_mm(r) - 14.0) <= 2.0 + 1e-9;
            assert_eq!(z.is_nan(), !inside, "{r} {c}");
        }
    }

    #[test]
    fn a_masked_pit_is_filled_after_levelling_and_the_rest_of_the_map_is_what_it_was() {
        let mut map = Array2::zeros(grid().shape());
        map[[20, 30]] = -20.0;
        let surface = tilted(map, 5.0, 1.0, 0.0);
        let outliers = Some(OutlierSettings::for_feature_mm(2.0));
        let plain = PrepareSettings { outliers, ..settings(None, Level::Piston) };
        let filling = PrepareSettings { fill: true, ..plain.clone() };
        let (without, with) =
            (prepare(&surface, &plain).unwrap(), prepare(&surface, &filling).unwrap());
        assert_eq!(with.report.filled.as_ref().unwrap().filled_pixels, 49);
        for (z, was) in with.surface.height_nm().iter().zip(without.surface.height_nm()) {
            assert!(z.is_finite() && (was.is_nan() || was.to_bits() == z.to_bits()));
        }
        // The map is a plane: so is what was filled.
        assert!(with.surface.detilted_rms_nm() < 1e-9);
    }
}
