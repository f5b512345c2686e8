//! Checks of inputs against each other, after each of them is valid by itself.
//!
//! With lengths or heights in metres, rates in m/s, or axes that begin at 0, every number is finite
//! and in range, and the plan is nonsense. The checks therefore compare surface, tool and path with
//! each other. Wherever possible a comparison is independent of scale, so that it suits
//! micro-optics and telescope mirrors. Each bound is at least an order of magnitude beyond what is
//! done on purpose; a mistaken unit is a factor of 1000.
//!
//! A certain mistake is an [`Invalid`]. A plan can also be of no use, because it makes the surface
//! worse or because the run lasts for months. That is a result with a negative verdict, and
//! [`drawback`] states the reason.

use planish_numerics::statistics;

use crate::{Invalid, Surface, Tif, ToolPath, text::significant};

/// Longest useful run, s: 30 days. Larger: plans in mistaken units pass. Smaller: runs of days on
/// large mirrors fail. Chosen: a run of months is stopped, measured and planned anew long before
/// its end.
const LONGEST_RUN_S: f64 = 30.0 * 86_400.0;

/// Largest ratio of the size of the TIF to the size of the map. Larger: mistaken units pass; a TIF
/// in micrometres is hundreds of times larger than the map. Smaller: laps that are a few times
/// larger than a small part are refused.
const MOST_TIF_PER_MAP: f64 = 50.0;

/// Smallest ratio of the size of the TIF to a pixel. Larger: narrow tools are refused. Smaller:
/// mistaken units pass; a TIF in metres extends over a few hundredths of a pixel. Chosen: a map
/// does not resolve a tool that is narrower than a pixel.
const LEAST_TIF_PER_PIXEL: f64 = 0.25;

/// Largest ratio of the volume of the map to the volumetric removal rate, s: three years. Larger:
/// mistaken units pass; rates in m/s take a billion times too long. Smaller: slow tools on large
/// parts are refused.
const LONGEST_VOLUME_S: f64 = 1e8;

/// Fraction of the pixels, the lowest ones, that do not count in the lowest height of the volume. Larger: more of the
/// real volume is left out. Smaller: a pit counts as a layer of its depth all over the part.
const PITS: f64 = 1e-3;

/// Smallest PV of a map in nm, nm: a thousandth of the radius of an atom. Larger: exact test maps
/// are refused. Smaller: maps in metres pass. A map of PV 0, but for [`ROUNDING`], is allowed.
const LEAST_PV_NM: f64 = 1e-4;
/// Largest PV of a flat map, relative to its largest height. Larger: maps in metres with an offset
/// pass as flat. Smaller: the rounding of a flat map is refused.
const ROUNDING: f64 = 1e-9;

/// Distance of an extreme height from all others, relative to their PV, above which it is a marker
/// of invalid pixels. It applies if several pixels have exactly this height, because a measured
/// height does not repeat. Larger: markers pass as heights. Smaller: real plateaus are refused.
const MARKER_DISTANCE: f64 = 10.0;

/// [`MARKER_DISTANCE`] for numbers that are known as markers, such as -9999 and 32767. Larger: markers pass as heights.
/// Smaller: such a number within the heights is refused.
const KNOWN_MARKER_DISTANCE: f64 = 1.0;

/// Largest ratio of the extent of the path with the tool on to that of the map and the TIF
/// together. Larger: mistaken units pass, such as a path in micrometres. Smaller: paths over
/// several parts on one table are refused.
const MOST_PATH_PER_MAP: f64 = 100.0;

/// Largest ratio of the pitch to the size of the TIF. Above 1 the lines leave untouched stripes,
/// which a test of a tool may want. Larger: mistaken units pass; in metres, the TIF is a few
/// hundredths of a pitch. Smaller: such tests are refused.
const MOST_PITCH_PER_TIF: f64 = 10.0;

/// Refuses a TIF that cannot be the tool for this map, and heights that cannot be measured.
pub fn check_tool(surface: &Surface, tif: &Tif) -> Result<(), Invalid> {
    check_offsets(tif)?;
    check_sizes(surface, tif)?;
    check_heights(surface)?;
    let least_s = least_time_s(surface, tif);
    if least_s > LONGEST_VOLUME_S {
        return Err(Invalid::whole(
            "rate_nm_per_s",
            format!(
                "has the volumetric removal rate {} nm mm^2/s and the peak {} nm/s: the volume \
                 of the map takes at least {} s",
                significant(tif.vrr_nm_mm2_per_s(), 4),
                significant(tif.peak_nm_per_s(), 4),
                significant(least_s, 4)
            ),
            "rates in m/s or um/s? give nm/s; or heights that are no heights? mark invalid pixels by NaN",
        ));
    }
    Ok(())
}

/// Refuses everything that [`check_tool`] refuses, and a path that cannot be meant for this map.
pub fn check_path(surface: &Surface, tif: &Tif, path: &ToolPath) -> Result<(), Invalid> {
    check_tool(surface, tif)?;
    let on = (0..path.len()).filter(|i| path.tool_on()[*i]);
    let ends = on.flat_map(|i| [path.point_mm()[i], path.point_mm()[i + 1]]);
    for (axis, name) in ["x", "y"].into_iter().enumerate() {
        let low = ends.clone().map(|p| p[axis]).fold(f64::INFINITY, f64::min);
        let high = ends.clone().map(|p| p[axis]).fold(f64::NEG_INFINITY, f64::max);
        let [map_mm, tif_mm] = [surface.grid(), tif.grid()].map(|grid| grid.size_mm()[axis]);
        if high - low > MOST_PATH_PER_MAP * (map_mm + tif_mm) {
            return Err(Invalid::whole(
                "point_mm",
                format!(
                    "extends over {:.6} mm in {name}, the map over {map_mm:.6} mm and the TIF over \
                     {tif_mm:.6} mm",
                    high - low
                ),
                "a path in um, or a map in metres? give all of them in mm",
            ));
        }
    }
    Ok(())
}

/// Refuses a pitch, the distance between path lines in mm, that is too large for the tool.
pub fn check_pitch(tif: &Tif, pitch_mm: f64) -> Result<(), Invalid> {
    let [x, y] = tif.grid().size_mm();
    let size = x.max(y);
    if pitch_mm <= MOST_PITCH_PER_TIF * size {
        return Ok(());
    }
    Err(Invalid::whole(
        "pitch_mm",
        format!("is {pitch_mm:?} mm, but the TIF extends over {x:.6} by {y:.6} mm only"),
        "axes in metres? give all of them in mm, or a smaller pitch",
    ))
}

/// RMS of a map with and without its best plane, nm.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rms {
    /// RMS after removing the mean, nm.
    pub rms_nm: f64,
    /// RMS after removing the least-squares plane, nm.
    pub detilted_nm: f64,
}

impl Rms {
    /// Returns the two RMS values of a map.
    pub fn of_surface(surface: &Surface) -> Self {
        Self { rms_nm: surface.statistics().rms, detilted_nm: surface.detilted_rms_nm() }
    }
}

/// Returns the reason why a plan is of no use, or `None` if it is of use. The plan reduces the RMS `before` to `after`
/// in `total_time_s`. Either the surface is worse than before, with and without its best plane, or the run is longer
/// than 30 days.
pub fn drawback(before: Rms, after: Rms, total_time_s: f64) -> Option<String> {
    // Any plan makes a flat map worse, so that nothing is expected of it.
    let flat = before.rms_nm <= 0.0;
    if !flat && after.rms_nm > before.rms_nm && after.detilted_nm > before.detilted_nm {
        return Some(format!(
            "the plan makes the surface worse: {} nm RMS before, {} nm RMS after; are the \
             heights in nm, and does the least dwell time remove less than there is? in ms, it has to be given in s",
            significant(before.rms_nm, 5),
            significant(after.rms_nm, 5)
        ));
    }
    too_long(total_time_s)
}

/// Returns the reason why a run of `total_time_s` is too long, or `None` if it is not.
pub fn too_long(total_time_s: f64) -> Option<String> {
    if total_time_s <= LONGEST_RUN_S || total_time_s.is_nan() {
        return None;
    }
    Some(format!(
        "the run takes {} s, {:.0} days, more than {:.0} days; are the heights and \
         rates in nm and nm/s, and invalid pixels NaN?",
        significant(total_time_s, 5),
        total_time_s / 86_400.0,
        LONGEST_RUN_S / 86_400.0
    ))
}

/// Refuses a TIF whose removal is farther from the offset 0, the position of the tool, than its own width. Such axes
/// begin or end at 0, and are coordinates of an array rather than offsets.
fn check_offsets(tif: &Tif) -> Result<(), Invalid> {
    let grid = tif.grid();
    for (name, axis, is_y) in [("x_mm", grid.x, false), ("y_mm", grid.y, true)] {
        if axis.start_mm() < 0.0 && axis.end_mm() > 0.0 {
            continue;
        }
        // Rates, not below 0, and their offsets.
        let rates = tif.rate_nm_per_s().indexed_iter();
        let samples =
            rates.map(|((r, c), v)| (v.max(0.0), axis.coordinate_mm(if is_y { r } else { c })));
        let volume: f64 = samples.clone().map(|(rate, _)| rate).sum();
        let centre_mm = samples.clone().map(|(rate, d)| rate * d).sum::<f64>() / volume;
        let moment: f64 = samples.map(|(rate, d)| rate * (d - centre_mm).powi(2)).sum();
        let sigma_mm = (moment / volume).sqrt();
        if centre_mm.abs() > sigma_mm {
            let from = axis.start_mm();
            let to = axis.end_mm();
            let half = 0.5 * (to - from);
            return Err(Invalid::whole(
                name,
                format!(
                    "of the TIF is {from} .. {to} mm, so that the removal is centred {centre_mm:.6} mm \
                     from the tool, at a width (standard deviation) of {sigma_mm:.6} mm"
                ),
                format!(
                    "coordinates of an array? give offsets (pixel - tool), with 0 where the tool is: \
                     {:.6} .. {half:.6} mm when that is the middle",
                    -half
                ),
            ));
        }
    }
    Ok(())
}

/// Refuses a TIF that is far larger than the map, or smaller than a pixel.
fn check_sizes(surface: &Surface, tif: &Tif) -> Result<(), Invalid> {
    let map = surface.grid().size_mm();
    let tool = tif.grid().size_mm();
    let shown = |s: [f64; 2]| format!("{:.6} by {:.6} mm", s[0], s[1]);
    if tool[0].max(tool[1]) > MOST_TIF_PER_MAP * map[0].max(map[1]) {
        return Err(Invalid::whole(
            "x_mm",
            format!("of the TIF: it extends over {}, the map over {}", shown(tool), shown(map)),
            "a map in metres, or a TIF in um? give both in mm",
        ));
    }
    let pixel = [surface.grid().x.step_mm(), surface.grid().y.step_mm()];
    if tool[0].max(tool[1]) < LEAST_TIF_PER_PIXEL * pixel[0].min(pixel[1]) {
        return Err(Invalid::whole(
            "x_mm",
            format!(
                "of the TIF: it extends over {}, less than a pixel of the map ({})",
                shown(tool),
                shown(pixel)
            ),
            "a TIF in metres, or a map in um? give both in mm",
        ));
    }
    Ok(())
}

/// Refuses heights whose PV is less than the size of an atom, and a number that marks pixels without data.
fn check_heights(surface: &Surface) -> Result<(), Invalid> {
    let map = surface.height_nm();
    let (low, high) = statistics::range(map.view());
    let pv = high - low;
    let largest = low.abs().max(high.abs());
    if pv > ROUNDING * largest && pv < LEAST_PV_NM {
        return Err(Invalid::whole(
            "height_nm",
            format!(
                "spans {} nm from its lowest to its highest pixel, less than an atom",
                significant(pv, 4)
            ),
            "heights in metres? give nm",
        ));
    }
    let markers = [low, high];
    for (marker, count) in markers.into_iter().zip(statistics::counts(map.view(), markers)) {
        if count == 1 {
            continue;
        }
        let (l, h) = statistics::range(map.mapv(|z| if z == marker { f64::NAN } else { z }).view());
        let distance = (l - marker).max(marker - h);
        let far = if is_known_marker(marker) { KNOWN_MARKER_DISTANCE } else { MARKER_DISTANCE };
        if h > l && distance > far * (h - l) {
            let marked = map.indexed_iter().find(|(_, z)| **z == marker);
            let (index, _) = marked.expect("it is one of them");
            return Err(Invalid::at_index(
                "height_nm",
                index,
                format!("is {marker}, exactly as in {count} pixels, and all others are {l} .. {h}"),
                "a marker of invalid pixels? mark them by NaN",
            ));
        }
    }
    Ok(())
}

/// Returns true if the digits of `value` are all nines, or those of the limit of an integer type.
/// The power of ten does not matter, because units may have been converted.
fn is_known_marker(value: f64) -> bool {
    let digits: String = format!("{:e}", value.abs()).chars().take_while(|c| *c != 'e').collect();
    let digits = digits.replace('.', "");
    let nines = digits.len() >= 3 && digits.chars().all(|c| c == '9');
    nines
        || ["32767", "32768", "65535", "2147483640", "2147483647", "2147483648"]
            .iter()
            .any(|limit| limit.trim_end_matches('0') == digits)
}

/// Returns a lower bound on the time of any plan, s: the volume above the lowest pixel, but for [`PITS`],
/// over the volumetric removal rate.
fn least_time_s(surface: &Surface, tif: &Tif) -> f64 {
    let map = surface.height_nm().view();
    let low = statistics::lowest(map, None, PITS).expect("a surface has a valid pixel");
    let height = statistics::sum_above(map, low);
    height * surface.grid().pixel_mm2() / tif.vrr_nm_mm2_per_s()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Axis, Grid};
    use ndarray::Array2;

    fn axis(start: f64, end: f64, n: usize) -> Axis {
        Axis::new(start, (end - start) / (n - 1) as f64, n).unwrap()
    }

    /// Returns a map of 40 x 24 mm with a PV of some 40 nm, times the factors `mm` and `nm` of mistaken units.
    fn map(mm: f64, nm: f64) -> Surface {
        let grid = Grid { x: axis(0.0, 40.0 * mm, 81), y: axis(0.0, 24.0 * mm, 49) };
        let z = Array2::from_shape_fn((49, 81), |(r, c)| {
            nm * (0.01 * (c as f64 - 40.0).powi(2) + 0.03 * (r as f64 - 20.0).powi(2))
        });
        Surface::new(grid, z).unwrap()
    }

    /// Returns a Gaussian TIF of sigma 1.5 mm on -6 .. 6 mm, displaced by `shift` mm, times the factors `mm` and
    /// `rate`.
    fn tool(mm: f64, rate: f64, shift: f64) -> Tif {
        let a = axis((shift - 6.0) * mm, (shift + 6.0) * mm, 49);
        let g = |k: usize| (-0.5 * ((k as f64 - 24.0) / 6.0).powi(2)).exp();
        let rate = Array2::from_shape_fn((49, 49), |(r, c)| 10.0 * rate * g(r) * g(c));
        Tif::new(Grid { x: a, y: a }, rate).unwrap()
    }

    fn lines(mm: f64) -> ToolPath {
        let points: Vec<[f64; 2]> =
            (0..60).map(|k| [f64::from(k % 2) * 40.0 * mm, f64::from(k) * 0.4 * mm]).collect();
        let n = points.len() - 1;
        ToolPath::through(points, vec![true; n], vec![0; n]).unwrap()
    }

    #[test]
    fn any_scale_is_accepted_as_long_as_it_is_one() {
        // From micro-optics of 40 um to a mirror of 40 m, heights from 0.4 nm to 400 um.
        for mm in [1e-3, 1.0, 1e3] {
            for nm in [0.01, 1.0, 1e4] {
                let least = least_time_s(&map(mm, nm), &tool(mm, 1.0, 0.0));
                // Rounding of sums over the pixels, relative.
                assert!(
                    (least / (nm * least_time_s(&map(1.0, 1.0), &tool(1.0, 1.0, 0.0))) - 1.0).abs()
                        < 1e-9
                );
                check_path(&map(mm, nm), &tool(mm, 1.0, 0.0), &lines(mm)).unwrap();
            }
        }
        // Tools of a tenth and of ten times the size, slow and fast ones, and off their middle.
        for size in [0.1, 10.0] {
            check_path(&map(1.0, 1.0), &tool(size, 1.0, 0.0), &lines(1.0)).unwrap();
        }
        for (rate, shift) in [(1e-3, 0.0), (1e3, 0.0), (1.0, 5.0), (1.0, -5.9)] {
            check_path(&map(1.0, 1.0), &tool(1.0, rate, shift), &lines(1.0)).unwrap();
        }
    }

    #[test]
    fn mistaken_units_are_named() {
        let (z, t, p) = (map(1.0, 1.0), tool(1.0, 1.0, 0.0), lines(1.0));
        let message =
            |z: &Surface, t: &Tif, p: &ToolPath| check_path(z, t, p).unwrap_err().to_string();
        for (z, t, p, said) in [
            (&map(1e-3, 1.0), &t, &p, "a map in metres"),
            (&z, &tool(1e-3, 1.0, 0.0), &p, "a TIF in metres"),
            (&z, &tool(1e3, 1.0, 0.0), &p, "a TIF in um"),
            (&map(1e3, 1.0), &t, &p, "a map in um"),
            (&z, &t, &lines(1e3), "a path in um"),
            (&map(1.0, 1e-9), &t, &p, "heights in metres"),
            (&z, &tool(1.0, 1e-9, 0.0), &p, "rates in m/s"),
            (&z, &tool(1.0, 1.0, 6.0), &p, "coordinates of an array"),
            (&z, &tool(1.0, 1.0, 7.0), &p, "coordinates of an array"),
            (&z, &tool(1.0, 1.0, -6.0), &p, "coordinates of an array"),
        ] {
            let got = message(z, t, p);
            assert!(got.contains(said), "{said}: {got}");
        }
        // All three in metres, with a pitch in mm.
        check_path(&map(1e-3, 1.0), &tool(1e-3, 1.0, 0.0), &lines(1e-3)).unwrap();
        let got = check_pitch(&tool(1e-3, 1.0, 0.0), 1.0).unwrap_err().to_string();
        assert!(got.starts_with("pitch_mm: is 1.0 mm") && got.contains("axes in metres"), "{got}");
        check_pitch(&t, 100.0).unwrap();
    }

    #[test]
    fn markers_of_invalid_pixels_are_found() {
        let with = |marker: f64, pixels: usize| {
            let mut z = map(1.0, 1.0).height_nm().clone();
            z.iter_mut().take(pixels).for_each(|z| *z = marker);
            Surface::new(*map(1.0, 1.0).grid(), z).unwrap()
        };
        for marker in [-9999.0, 9999.0, -999.0, 32767.0, -1e5, -9_999_000.0] {
            let got = check_heights(&with(marker, 20)).unwrap_err().to_string();
            assert!(got.contains("height_nm[0, 0]: is") && got.contains("20 pixels"), "{got}");
        }
        // A pit, a plateau and a step within the heights are none; nor is one pixel.
        for (height, pixels) in [(-9999.0, 1), (-200.0, 20), (40.0, 2000), (0.0, 20)] {
            check_heights(&with(height, pixels)).unwrap();
        }
        for flat in [0.0, 5.0, -9999.0] {
            let z = Surface::new(*map(1.0, 1.0).grid(), Array2::from_elem((49, 81), flat)).unwrap();
            check_heights(&z).unwrap();
        }
        assert!(is_known_marker(-9999.0) && is_known_marker(3.2767e9) && is_known_marker(0.999));
        assert!(!is_known_marker(-9998.0) && !is_known_marker(99.0) && !is_known_marker(0.0));
    }

    #[test]
    fn drawbacks_are_named_with_their_numbers() {
        let rms = |rms_nm, detilted_nm| Rms { rms_nm, detilted_nm };
        assert_eq!(drawback(rms(6.0, 5.0), rms(0.2, 0.2), 450.0), None);
        // A plane may be free, and of a flat map nothing is expected.
        assert_eq!(drawback(rms(6.0, 5.0), rms(9.0, 0.2), 450.0), None);
        assert_eq!(drawback(rms(0.0, 0.0), rms(0.1, 0.1), 450.0), None);
        let worse = drawback(rms(6.0, 5.0), rms(11.4, 11.0), 450.0).unwrap();
        assert!(worse.contains("6 nm RMS before, 11.4 nm RMS after"), "{worse}");
        let long = drawback(rms(6.0, 5.0), rms(0.2, 0.2), 14_957_996.0).unwrap();
        assert!(long.contains("173 days, more than 30 days"), "{long}");
        assert_eq!(too_long(LONGEST_RUN_S), None);
    }
}
