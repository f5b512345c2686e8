//! Doubts: warnings about probable mistakes in inputs that are possible as they are. A doubt is a sentence with a
//! remedy, and never refuses an input. It comes before anything is planned, because a plan for a tilt that nobody
//! wants, or for a pixel that is no height, takes hours of machine time.
//!
//! A function `of_...` returns its doubt, or `None` if its input causes none.
//!
//! [`crate::plausible`] refuses what is certainly a mistake. Each bound here is beyond the values
//! of the fixtures and of measured mirrors, and below the values that the mistake causes.

use ndarray::Array2;
use planish_numerics::statistics;

use crate::{
    ClearAperture, Grid, Kinematics, Limits, Machine, Removal, Surface, Tif, baseline::Baseline,
    text::significant,
};

/// Fraction of the mean square of a map that its best plane explains, above which the plane is doubted as a tilt of the
/// measurement. Larger: a tilt that triples the time causes no doubt. Smaller: more parts whose desired removal is a
/// wedge are doubted; above 0.9 they are rare.
const MOST_PLANE: f64 = 0.9;

/// Smallest PV of a map in nm without a doubt, nm. Larger: flat parts are doubted. Smaller: maps in
/// um pass, whose numbers are a thousand times too small. Chosen: an interferometer repeats to
/// about 0.1 nm RMS.
const LEAST_PV_NM: f64 = 0.5;

/// Largest RMS of a map without its best plane, nm, that causes no doubt. Larger: heights that are a thousand times too
/// large pass. Smaller: parts that are still rough are doubted. Chosen: a mirror that is worth a dwell-time run has
/// less than some hundred nm, and 2 um take the tools of the fixtures days.
const MOST_DETILTED_NM: f64 = 2000.0;

/// Largest number of pixels in which repeated heights and quantiles are searched for. Larger: more time. Smaller: less
/// certain quantiles. Chosen: 0.2 % of the pixels, the threshold of [`LEAST_REPEATED`] and [`EXTREMES`], are 200
/// samples.
const MOST_SAMPLES: usize = 100_000;

/// Smallest fraction of the pixels with exactly one height, above which that height is doubted as a
/// mark of missing data. Larger: small areas without data pass. Smaller: heights that repeat by
/// chance are doubted.
const LEAST_REPEATED: f64 = 2e-3;
/// Smallest ratio of the number of pixels with that repeated height to the number with the next most frequent height.
/// Larger: fewer doubts. Smaller: maps of integer counts are doubted, in which neighbouring heights are about as
/// frequent.
const LEAST_REPEATED_RATIO: usize = 10;

/// Fraction of the pixels at each end, the lowest and the highest ones, that do not decide the
/// range of the others. Larger: larger defects count as spikes. Smaller: a group of spikes widens
/// the range, and hides itself.
const EXTREMES: f64 = 2e-3;
/// Distance of a pixel from the range of the others, relative to that range, above which it is
/// doubted as a spike. Larger: lower spikes pass. Smaller: real pits are doubted. Chosen: the pits
/// of the fixtures, which a tool cannot correct, lie within one range.
const MOST_RANGES: f64 = 3.0;

/// Smallest and largest time in which the resting tool removes the mean depth, s, without a doubt.
/// Below the first, the machine would never stand still. Above the second, a deep part takes long. A
/// narrower interval doubts good plans, a wider one misses mistaken units. Chosen: the fixtures and
/// the reference mirror are between 1.6 and 11 s; rates in nm/min are 60 times too fast, rates in
/// um/min 17 times too slow. Heights in angstrom, 10 times too high, stay within the interval on a
/// shallow part.
const MEAN_DEPTH_S: [f64; 2] = [0.1, 20.0];
/// Usual time in which a resting tool removes the mean depth, s. Among the possible mistakes, the one whose correction
/// leads nearest to this time is named. Chosen: the middle of the fixtures.
const USUAL_MEAN_DEPTH_S: f64 = 4.0;

/// Largest ratio of the sum of all least dwell times to the time of the removal that causes no doubt. Larger: least
/// dwell times in ms pass. Smaller: slow machines, whose largest velocity sets these times, are doubted. Chosen: four
/// times [`MOST_TRAVEL`].
const MOST_FLOOR: f64 = 20.0;

/// Longest removal that causes no doubt, s: a day. Larger: mistaken units pass. Smaller: large parts are doubted.
const LONGEST_S: f64 = 86_400.0;
/// Usual time of a run, s. Among the possible mistakes, the one whose correction leads nearest to this time is named.
const USUAL_S: f64 = 3600.0;

/// Largest relative difference between a number and a multiple of 15 degrees in radians, up to which the number is
/// doubted as radians. It compares four digits. Larger: other small angles are doubted. Smaller: rounded radians pass.
const OF_A_RADIAN: f64 = 3e-4;

/// Smallest and largest ratio of the radius of an aperture to that of the circle about the valid pixels, without a
/// doubt. Outside, a radius was given for a diameter, or the reverse. Narrower: apertures within their part are
/// doubted.
const CIRCLE: [f64; 2] = [0.55, 1.7];

/// Smallest fraction of the rectangle of a map that a hole may take before the mask is doubted as inverted, if all
/// corners are valid. Smaller: square parts with a hole are doubted. Larger: inverted masks pass.
const HOLE: f64 = 0.3;

/// Distance of the pivot of the tilts from the contact point, mm, below which it is doubted as a length in metres.
/// Larger: tools whose pivot is close to the part are doubted. Smaller: pivots in metres pass. Chosen: 30 to 80 mm for
/// the fixtures; a tool that turns about its contact point has exactly 0.
const LEAST_PIVOT_MM: f64 = 1.0;

/// Smallest and largest ratio of the radius of a pad to the half size of its removal, without a doubt. Narrower: pads
/// that orbit, whose removal is wider than they are, are doubted. Wider: diameters that were given for radii pass.
const PAD: [f64; 2] = [0.3, 1.5];

/// Smallest rate over the peak of a TIF at which a sample belongs to the spot. Larger: thin rims do not count. Smaller:
/// noise does.
const OF_SPOT: f64 = 1e-2;

/// Largest ratio of the residual RMS with a mistake corrected to the RMS before the run, at which that mistake explains
/// a residual above the start. Larger: chance counts as a mistake. Smaller: mistakes beside other errors pass.
const EXPLAINED: f64 = 0.5;

/// Largest ratio of the RMS that one corrected mistake leaves to the RMS of a simpler one, at which it is preferred.
/// Larger: shifts hide a wrong rate. Smaller: a wrong rate hides shifts.
const CLEARLY_LESS: f64 = 0.8;

/// Largest shift of the removal against the desired removal that is tried, pixels along x and y. Larger: more time.
/// Smaller: parts that are further off are not recognised.
const MOST_PIXELS_OFF: isize = 12;

/// Largest number of pixels that are compared for each shift. Larger: more time. Smaller: a less certain shift.
const MOST_COMPARED: usize = 4000;

/// Ratio of the time for the path at the largest velocity to the time of the removal, above which
/// the limits are doubted. Larger: mistaken units pass. Smaller: slow machines are doubted. Chosen:
/// at most 0.7 for the fixtures and the reference mirror on every machine; limits in m/s are 1000
/// times too small.
const MOST_TRAVEL: f64 = 5.0;

/// Smallest distance, m, for reaching the largest velocity and stopping, v^2 / a, from which on the limits are doubted.
/// Larger: mistaken units pass. Smaller: fast, weak machines are doubted. Chosen: 0.002 to 0.03 m for the fixtures;
/// velocities in mm/min or accelerations in g make it 3600 or 9800 times as long.
const LEAST_WAY_M: f64 = 5.0;

/// Velocity, mm/s, above which the doubt blames the velocity and not the acceleration for such a distance. Chosen:
/// figuring machines stay below it.
const LEAST_FAST_MM_PER_S: f64 = 600.0;

/// Acceleration of 1 g, mm/s^2.
const STANDARD_GRAVITY_MM_PER_S2: f64 = 9806.65;

/// Largest fraction of the volume of a TIF that the level of its baseline may have without a doubt. Larger: a run
/// removes so much less of the long waves, unsaid. Smaller: good TIFs are doubted. Chosen: a Gaussian that the field
/// cuts at 2.4 standard deviations has 0.5 %.
const MOST_BASELINE_VOLUME: f64 = 0.02;
/// Largest fraction of the volume of a TIF that the tilt of its baseline may move without a doubt. Chosen: the measured
/// TIF of the reference mirror has 3 %.
const MOST_TILTED_VOLUME: f64 = 0.05;
/// Time in which a tool of a usual peak rate may remove the mean depth at one point, s, without a doubt. Larger:
/// mistaken units pass. Smaller: pads on deep errors are doubted. Chosen: the pad of the fixture `edge-pad` takes 106
/// s.
const SURELY_SLOW_S: f64 = 300.0;
/// Peak rate, nm/s, from which on a TIF is usual. Larger: slow tools are doubted. Smaller: mistaken units pass. Chosen:
/// rates in um/min that are read as nm/s are 17 times too small.
const USUAL_PEAK_NM_PER_S: f64 = 3.0;

/// Largest rate on the border, relative to the peak, above which the TIF is doubted as cropped.
/// Larger: cropped spots pass. Smaller: noise is doubted. Chosen: a Gaussian that ends at 2.4
/// standard deviations has this value, and noise of 1 % of the peak stays below it.
const MOST_BORDER: f64 = 0.06;

/// Returns a doubt about the heights of a map in the clear aperture, before the map is levelled: marks of missing data,
/// or spikes. `None` if there is none, as in all functions of the module.
pub fn of_heights(measured: &Surface) -> Option<String> {
    let map = measured.height_nm();
    let mut some = sampled(map);
    some.sort_unstable_by(f64::total_cmp);
    no_height(map, &some).or_else(|| spikes(map, &some))
}

/// Returns a doubt about the desired removal, from its PV and its RMS with (`rms_nm`) and without (`detilted_nm`) the
/// best plane.
pub fn of_removal(pv_nm: f64, rms_nm: f64, detilted_nm: f64) -> Option<String> {
    if pv_nm > 0.0 && pv_nm < LEAST_PV_NM {
        return Some(format!(
            "the heights span {} nm in all, less than an interferometer resolves: heights in um? give nm, or \
             surface_settings=\"--unit um\" for the file of an instrument",
            significant(pv_nm, 2)
        ));
    }
    if detilted_nm > MOST_DETILTED_NM {
        return Some(format!(
            "the heights have {} nm RMS beside their best plane, where a mirror has at most some hundred: heights in nm that \
             were read as um, which would be {} nm, or a form that is still in the map? give the unit of the file \
             (surface_settings=\"--unit nm\"), or prepare=\"--target FORM.json\"",
            significant(detilted_nm, 3),
            significant(1e-3 * detilted_nm, 3)
        ));
    }
    let plane = 1.0 - (detilted_nm / rms_nm).powi(2);
    if plane <= MOST_PLANE || plane.is_nan() {
        return None;
    }
    Some(format!(
        "{:.0} % of the RMS is a plane ({} nm RMS with it, {} nm without): a tilt of the measurement? \
         prepare=\"--level plane\" takes it off; as it is, the run removes it",
        100.0 * (1.0 - detilted_nm / rms_nm),
        significant(rms_nm, 3),
        significant(detilted_nm, 3)
    ))
}

/// Returns a doubt about the samples of a TIF: a spot that the field crops, or a baseline.
pub fn of_tif(tif: &Tif) -> Option<String> {
    let largest = tif.border_to_peak();
    let baseline = Baseline::under(tif);
    // The step of a spot that was cropped is more than its baseline.
    let level = baseline.map_or(0.0, |b| b.level_nm_per_s / tif.peak_nm_per_s());
    if largest > MOST_BORDER && level < 0.5 * largest {
        return Some(format!(
            "the TIF ends at {:.0} % of its peak, so that its volume is too small and a raster prints the step onto \
             the part: a spot that was cropped? measure a wider field",
            100.0 * largest
        ));
    }
    let Baseline { part_of_volume, tilted_part_of_volume, .. } = baseline?;
    if part_of_volume.abs() <= MOST_BASELINE_VOLUME && tilted_part_of_volume <= MOST_TILTED_VOLUME {
        return None;
    }
    let plane = tif.border_plane_nm_per_s();
    let left = tif.vrr_nm_mm2_per_s() - plane.sum() * tif.grid().pixel_mm2();
    let remedy = format!(
        "planish tool prepare --subtract-border takes it off, and leaves {} of {} nm mm^2/s",
        significant(left, 5),
        significant(tif.vrr_nm_mm2_per_s(), 5)
    );
    if part_of_volume.abs() <= MOST_BASELINE_VOLUME {
        return Some(format!(
            "the TIF stands on a plane whose tilt moves {:.0} % of its volume from one side to the other: a tilted \
             baseline? {remedy}",
            100.0 * tilted_part_of_volume
        ));
    }
    let takes = if level < 0.0 { "which takes off" } else { "which is" };
    Some(format!(
        "the TIF has {} % of its peak beside its spot, {takes} {:.0} % of its volume: a baseline? {remedy}",
        significant(100.0 * level, 2),
        100.0 * part_of_volume.abs()
    ))
}

/// Returns a doubt about the units of the map and the TIF, from the time in which the resting tool removes the mean
/// depth.
pub fn of_rates(desired: &Surface, tif: &Tif) -> Option<String> {
    let depth_nm = mean_depth_nm(desired);
    let at_one_place_s = depth_nm / tif.peak_nm_per_s();
    let [least, most] = MEAN_DEPTH_S;
    if (least..=most).contains(&at_one_place_s) || at_one_place_s <= 0.0 {
        return None;
    }
    let is_usual = tif.peak_nm_per_s() >= USUAL_PEAK_NM_PER_S;
    if is_usual && (most..SURELY_SLOW_S).contains(&at_one_place_s) {
        return None;
    }
    let (mistakes, remedy) = if at_one_place_s > most {
        (&TOO_SLOW[..], "give nm and nm/s")
    } else {
        (&TOO_FAST[..], "give nm/s and nm; a depth is divided by the dwell time of its spot")
    };
    // All mistakes that lead back to a usual time, or the nearest one.
    let mut probable: Vec<&Mistake> = mistakes
        .iter()
        .filter(|mistake| (least..=most).contains(&(at_one_place_s * mistake.factor)))
        .collect();
    if probable.is_empty() {
        probable.push(Mistake::most_probable(mistakes, at_one_place_s, USUAL_MEAN_DEPTH_S));
    }
    let probable: Vec<String> = (probable.iter())
        .map(|m| {
            format!("{} (it would be {} s)", m.what, significant(at_one_place_s * m.factor, 2))
        })
        .collect();
    Some(format!(
        "the tool removes the mean depth of {} nm in {} s at one place (its peak is {} nm/s): {}? {remedy}",
        significant(depth_nm, 3),
        significant(at_one_place_s, 2),
        significant(tif.peak_nm_per_s(), 3),
        probable.join(", or ")
    ))
}

/// A mistake in the units that would explain an unusual time.
struct Mistake {
    what: &'static str,
    /// Factor by which the time changes once the mistake is corrected.
    factor: f64,
}

/// Mistakes that make a removal seem too slow.
const TOO_SLOW: [Mistake; 3] = [
    Mistake { what: "rates in um/s", factor: 1e-3 },
    Mistake { what: "rates in um/min", factor: 0.06 },
    Mistake { what: "heights in angstrom", factor: 0.1 },
];
/// Mistakes that make a removal seem too fast.
const TOO_FAST: [Mistake; 2] = [
    Mistake { what: "rates in nm/min, or a depth for a rate", factor: 60.0 },
    Mistake { what: "heights in um", factor: 1e3 },
];

impl Mistake {
    /// Returns the mistake whose correction brings `time_s` nearest to `usual_s`, as a ratio.
    fn most_probable(mistakes: &[Self], time_s: f64, usual_s: f64) -> &Self {
        let ratios = mistakes.iter().map(|mistake| (time_s * mistake.factor / usual_s).ln().abs());
        let nearest = mistakes.iter().zip(ratios).min_by(|a, b| a.1.total_cmp(&b.1));
        nearest.expect("there are some").0
    }
}

/// Returns a doubt about a removal that takes more than a day, which no path or motion can shorten.
pub fn of_time(desired: &Surface, tif: &Tif) -> Option<String> {
    let removal_s = removal_s(desired, tif);
    if removal_s <= LONGEST_S {
        return None;
    }
    let mistake = Mistake::most_probable(&TOO_SLOW, removal_s, USUAL_S);
    let [width, height] = desired.grid().size_mm();
    Some(format!(
        "the removal alone takes {} days: {}? it would be {} h; or a map in um for mm, whose {} x {} mm would be {} x {} mm",
        significant(removal_s / 86_400.0, 3),
        mistake.what,
        significant(removal_s * mistake.factor / 3600.0, 2),
        significant(width, 4),
        significant(height, 4),
        significant(1e-3 * width, 4),
        significant(1e-3 * height, 4)
    ))
}

/// Returns a doubt about least dwell times whose sum `floor_s` is far longer than the removal.
pub fn of_floor(desired: &Surface, tif: &Tif, floor_s: f64) -> Option<String> {
    let removal_s = removal_s(desired, tif);
    if removal_s <= 0.0 || floor_s <= MOST_FLOOR * removal_s {
        return None;
    }
    Some(format!(
        "the least dwell times alone take {} s, and the removal {} s: a least dwell time in ms? together they would take {} s; \
         give s",
        significant(floor_s, 3),
        significant(removal_s, 3),
        significant(1e-3 * floor_s, 3)
    ))
}

/// Returns a doubt about coordinates of the map or the TIF that look like pixel indices. They are steps of exactly 1
/// from 0 or 1 on, or about 0, while the other array has other steps.
pub fn of_pixels(desired: &Surface, tif: &Tif) -> Option<String> {
    let [map, tool] = [desired.grid(), tif.grid()];
    let [map_pitch, tool_pitch] = [map, tool].map(|grid| [grid.x.step_mm(), grid.y.step_mm()]);
    let [map_start, tool_start] = [map, tool].map(|grid| [grid.x.start_mm(), grid.y.start_mm()]);
    let is_from_index = map_start == [0.0; 2] || map_start == [1.0; 2];
    let is_about_0 = tool_start.iter().all(|v| (2.0 * v).fract() == 0.0);
    let (name, grid, other) = if map_pitch == [1.0; 2] && is_from_index && tool_pitch != [1.0; 2] {
        ("map", map, tool_pitch[0])
    } else if tool_pitch == [1.0; 2] && is_about_0 && map_pitch != [1.0; 2] {
        ("TIF", tool, map_pitch[0])
    } else {
        return None;
    };
    let [width, height] = grid.size_mm();
    Some(format!(
        "the pitch of the {name} is exactly 1 mm, and that of the other {} mm: coordinates in pixels? with the same pitch its \
         {} x {} mm would be {} x {} mm; give mm",
        significant(other, 4),
        significant(width, 4),
        significant(height, 4),
        significant(other * width, 4),
        significant(other * height, 4)
    ))
}

/// Returns a doubt about a TIF that is larger than the map along both axes.
pub fn of_sizes(desired: &Surface, tif: &Tif) -> Option<String> {
    let [map, tool] = [desired.grid().size_mm(), tif.grid().size_mm()];
    if tool[0] <= map[0] || tool[1] <= map[1] {
        return None;
    }
    Some(format!(
        "the TIF of {} x {} mm is larger than the map of {} x {} mm: a map in inches? it would be {} x {} mm; or a TIF in \
         another unit? give mm",
        significant(tool[0], 4),
        significant(tool[1], 4),
        significant(map[0], 4),
        significant(map[1], 4),
        significant(25.4 * map[0], 4),
        significant(25.4 * map[1], 4)
    ))
}

/// Returns a doubt about the vertex of a curved form, at (x, y) in mm on the part, if it lies at a corner of the map.
pub fn of_vertex(desired: &Surface, vertex_mm: [f64; 2]) -> Option<String> {
    let grid = desired.grid();
    for (axis, v) in [grid.x, grid.y].into_iter().zip(vertex_mm) {
        if (v - axis.start_mm()).abs().min((v - axis.end_mm()).abs()) > axis.step_mm() {
            return None;
        }
    }
    let [x, y] = [grid.x, grid.y].map(|axis| 0.5 * (axis.start_mm() + axis.end_mm()));
    Some(format!(
        "the vertex of the form lies at ({}, {}) mm, which is a corner of the map: the middle of the part is at ({}, {}) mm; \
         give vertex_mm in the form file",
        significant(vertex_mm[0], 4),
        significant(vertex_mm[1], 4),
        significant(x, 4),
        significant(y, 4)
    ))
}

/// Returns a doubt about an angle in degrees that is a multiple of 15 degrees in radians; `name` is the setting.
pub fn of_angle(name: &str, angle_deg: f64) -> Option<String> {
    let in_degrees = angle_deg.to_degrees();
    let nearest = 15.0 * (in_degrees / 15.0).round();
    let is_radian = nearest != 0.0
        && nearest.abs() <= 360.0
        && (in_degrees / nearest - 1.0).abs() < OF_A_RADIAN;
    if !is_radian {
        return None;
    }
    let stated = significant(angle_deg, 5);
    Some(format!("{name} is {stated} degrees: radians? it would be {nearest} degrees"))
}

/// Returns a doubt about the rotary axes of a machine, if their travel looks like one in radians.
pub fn of_rotary_axes(machine: &Machine) -> Option<String> {
    machine.axes().iter().filter(|axis| axis.is_rotary).find_map(|axis| {
        let name = format!("the travel of the axis {}", axis.name);
        axis.travel?.into_iter().find_map(|end| of_angle(&name, end))
    })
}

/// Returns a doubt about the pivot of the tilts of a machine, if its distance looks like one in metres.
pub fn of_pivot(machine: &Machine) -> Option<String> {
    let pivot_mm = match machine.kinematics() {
        Kinematics::Xy | Kinematics::Xyz => None,
        Kinematics::Tilts { pivot_mm, .. } => Some(*pivot_mm),
        Kinematics::Spindle { pivot_mm, .. } => *pivot_mm,
    }?;
    if pivot_mm == 0.0 || pivot_mm.abs() >= LEAST_PIVOT_MM {
        return None;
    }
    Some(format!(
        "pivot_mm is {} mm, beside the contact point: metres? it would be {} mm; 0 is a tool that tilts about its contact \
         point",
        significant(pivot_mm, 4),
        significant(1e3 * pivot_mm, 4)
    ))
}

/// Returns a doubt about the radius of a pad, mm, against the region in which it removes material: a diameter for a
/// radius, or a radius for a diameter.
pub fn of_pad(tif: &Tif, radius_mm: f64) -> Option<String> {
    let least = OF_SPOT * tif.peak_nm_per_s();
    let grid = tif.grid();
    let spot = tif.rate_nm_per_s().indexed_iter().filter(|(_, rate)| **rate > least);
    let half_mm = spot
        .map(|((r, c), _)| grid.x.coordinate_mm(c).abs().max(grid.y.coordinate_mm(r).abs()))
        .fold(0.0, f64::max);
    let what = match radius_mm / half_mm {
        ratio if ratio > PAD[1] => "a diameter for a radius",
        ratio if ratio < PAD[0] => "a radius that was halved",
        _ => return None,
    };
    let other_mm = if radius_mm > half_mm { 0.5 * radius_mm } else { 2.0 * radius_mm };
    Some(format!(
        "the pad has a radius of {} mm, and its TIF removes up to {} mm from its centre: {what}? it would be {} mm",
        significant(radius_mm, 4),
        significant(half_mm, 4),
        significant(other_mm, 4)
    ))
}

/// Returns a doubt about a plan whose residual is larger than the desired removal was: the mistake that explains most
/// of it, with its value. `None` if the residual is smaller.
pub fn of_residual(desired: &Surface, removal: &Removal) -> Option<String> {
    let [before, after] = [desired, removal.residual()].map(|map| map.statistics().rms);
    if after <= before || before == 0.0 {
        return None;
    }
    let compared = Compared::new(desired, removal);
    let (left, mistake) = compared.best()?;
    let end = if left < EXPLAINED * before {
        format!("{mistake} Then {} nm would be left", significant(left, 3))
    } else {
        "no single factor, turn or shift of the removal explains it: are map, tool and motion of the same part, in the \
         same coordinates?"
            .into()
    };
    Some(format!(
        "the residual of {} nm RMS is larger than the {} nm before the run: {end}",
        significant(after, 4),
        significant(before, 4)
    ))
}

/// Desired and simulated removal (ny, nx), nm, with the pixels at which they are compared.
struct Compared<'a> {
    grid: &'a Grid,
    desired_nm: &'a Array2<f64>,
    removal_nm: &'a Array2<f64>,
    /// Rows and columns [row, column] of the compared pixels.
    pixels: Vec<[usize; 2]>,
}

impl<'a> Compared<'a> {
    fn new(desired: &'a Surface, removal: &'a Removal) -> Self {
        let desired_nm = desired.height_nm();
        let valid = desired_nm.indexed_iter().filter(|(_, height)| !height.is_nan());
        let every = desired_nm.len().div_ceil(MOST_COMPARED);
        let pixels = valid.step_by(every).map(|((r, c), _)| [r, c]).collect();
        Self { grid: desired.grid(), desired_nm, removal_nm: removal.removal_nm(), pixels }
    }

    /// Returns the factor of the removal that leaves the smallest residual, and that residual, nm RMS. `place` maps a
    /// pixel [row, column] to the pixel whose removal it gets. `None` if too few pixels have one.
    fn factor(&self, place: impl Fn([isize; 2]) -> [isize; 2]) -> Option<(f64, f64)> {
        let mut pairs = Vec::with_capacity(self.pixels.len());
        for &[r, c] in &self.pixels {
            let [row, column] = place([r as isize, c as isize]);
            let removed = usize::try_from(row).ok().zip(usize::try_from(column).ok());
            if let Some(removed) = removed.and_then(|pixel| self.removal_nm.get(pixel)) {
                pairs.push([self.desired_nm[[r, c]], *removed]);
            }
        }
        if 2 * pairs.len() < self.pixels.len() {
            return None;
        }
        let count = pairs.len() as f64;
        let mean = [0, 1].map(|k| pairs.iter().map(|pair| pair[k]).sum::<f64>() / count);
        let [mut wanted, mut both, mut removed] = [0.0; 3];
        for pair in &pairs {
            let [d, r] = [0, 1].map(|k| pair[k] - mean[k]);
            wanted += d * d;
            both += d * r;
            removed += r * r;
        }
        if removed <= 0.0 {
            return None;
        }
        Some((both / removed, ((wanted - both * both / removed).max(0.0) / count).sqrt()))
    }

    /// Returns the residual without the mistake that explains most, nm RMS, and the sentence that names the mistake. If
    /// several explain about as much, a factor precedes turns, and turns precede shifts.
    fn best(&self) -> Option<(f64, String)> {
        let (factor, left) = self.factor(|pixel| pixel)?;
        let mut best = (left, scaled(factor));
        let (rows, columns) = self.desired_nm.dim();
        let last = [rows as isize - 1, columns as isize - 1];
        for (name, turns) in [
            ("turned by 180 degrees", [true, true]),
            ("mirrored along x", [false, true]),
            ("mirrored along y", [true, false]),
        ] {
            let turned = self.factor(|pixel| {
                [0, 1].map(|k| if turns[k] { last[k] - pixel[k] } else { pixel[k] })
            });
            if let Some(left) = explained(turned, best.0) {
                best = (left, format!("is the map {name} beside the motion?"));
            }
        }
        let [step_x, step_y] = [self.grid.x.step_mm(), self.grid.y.step_mm()];
        for by_rows in -MOST_PIXELS_OFF..=MOST_PIXELS_OFF {
            for by_columns in -MOST_PIXELS_OFF..=MOST_PIXELS_OFF {
                let moved = self.factor(|[r, c]| [r + by_rows, c + by_columns]);
                if let Some(left) = explained(moved, best.0) {
                    let x = significant(by_columns as f64 * step_x, 3);
                    let y = significant(by_rows as f64 * step_y, 3);
                    best = (left, format!("does the motion lie ({x}, {y}) mm off the map?"));
                }
            }
        }
        Some(best)
    }
}

/// Returns the residual, nm RMS, of a factor above 0 if it is clearly smaller than `best_nm`, that of the best mistake
/// so far; else `None`.
fn explained(factor: Option<(f64, f64)>, best_nm: f64) -> Option<f64> {
    let (factor, left) = factor?;
    if factor > 0.0 && left < CLEARLY_LESS * best_nm { Some(left) } else { None }
}

/// Returns the words for the mistake that the factor `factor` of the removal would correct.
fn scaled(factor: f64) -> String {
    let stated = significant(factor.abs(), 3);
    if factor < 0.0 {
        return "is the sign of the map turned? The removal is high where the map is low.".into();
    }
    format!(
        "does the TIF of the dwell times have another unit or rate? {stated} times the removal would fit."
    )
}

/// Returns a doubt about angles of incidence, stated in degrees, whose largest one is at most a right angle in radians.
/// `largest_deg` is the largest of `count` angles.
pub fn of_incidences(largest_deg: f64, count: usize) -> Option<String> {
    let is_small =
        largest_deg > 0.0 && largest_deg <= std::f64::consts::FRAC_PI_2 * (1.0 + OF_A_RADIAN);
    if !is_small || count < 3 {
        return None;
    }
    Some(format!(
        "the table of incidences ends at {} degrees: radians? it would be {} degrees",
        significant(largest_deg, 4),
        significant(largest_deg.to_degrees(), 3)
    ))
}

/// Returns a doubt about the circle of a clear aperture: a diameter for a radius, or a radius for a diameter.
pub fn of_circle(measured: &Surface, aperture: &ClearAperture) -> Option<String> {
    let ClearAperture::Circle { radius_mm, .. } = aperture else { return None };
    let grid = measured.grid();
    let mut low = [f64::INFINITY; 2];
    let mut high = [f64::NEG_INFINITY; 2];
    for ((r, c), _) in measured.height_nm().indexed_iter().filter(|(_, z)| !z.is_nan()) {
        for (a, v) in [grid.x.coordinate_mm(c), grid.y.coordinate_mm(r)].into_iter().enumerate() {
            low[a] = low[a].min(v);
            high[a] = high[a].max(v);
        }
    }
    let half = [0, 1].map(|a| 0.5 * (high[a] - low[a]));
    let [least, most] = CIRCLE;
    let what = if *radius_mm > most * half[0].max(half[1]) {
        "a diameter for a radius"
    } else if *radius_mm < least * half[0].min(half[1]) {
        "half of the radius, or a radius that was read as a diameter"
    } else {
        return None;
    };
    let other = if *radius_mm > half[0] { 0.5 * radius_mm } else { 2.0 * radius_mm };
    Some(format!(
        "the clear aperture has a radius of {} mm, and the valid pixels lie within {} x {} mm: {what}? {} mm would fit",
        significant(*radius_mm, 4),
        significant(2.0 * half[0], 4),
        significant(2.0 * half[1], 4),
        significant(other, 4)
    ))
}

/// Returns a doubt about the valid pixels if they include all corners and leave a large hole, as an inverted mask does.
pub fn of_mask(measured: &Surface) -> Option<String> {
    let map = measured.height_nm();
    let (rows, columns) = map.dim();
    let corners = [(0, 0), (0, columns - 1), (rows - 1, 0), (rows - 1, columns - 1)];
    let middle = (rows / 2, columns / 2);
    if corners.iter().any(|corner| map[*corner].is_nan()) || !map[middle].is_nan() {
        return None;
    }
    let hole = map.iter().filter(|z| z.is_nan()).count() as f64 / map.len() as f64;
    if hole < HOLE {
        return None;
    }
    Some(format!(
        "the valid pixels are a frame about a hole of {:.0} % of the map: an inverted mask? then {:.0} % would be valid",
        100.0 * hole,
        100.0 * hole
    ))
}

/// Returns a doubt about the limits of the machine for path lines of this pitch, mm. The path is about area / pitch
/// long.
pub fn of_limits(desired: &Surface, tif: &Tif, limits: &Limits, pitch_mm: f64) -> Option<String> {
    of_units_of_limits(limits).or_else(|| of_slow_limits(desired, tif, limits, pitch_mm))
}

/// Returns a doubt about the units of the limits, from the distance v^2 / a in which an axis reaches its largest
/// velocity and stops.
fn of_units_of_limits(limits: &Limits) -> Option<String> {
    let velocities = limits.max_velocity_mm_per_s().into_iter();
    let axes = velocities.zip(limits.max_acceleration_mm_per_s2());
    let ways_m = axes.map(|(v, a)| (1e-3 * v * v / a, v, a));
    let (way_m, v, a) = ways_m.max_by(|one, other| one.0.total_cmp(&other.0))?;
    if way_m < LEAST_WAY_M {
        return None;
    }
    let way = significant(way_m, 2);
    if v > LEAST_FAST_MM_PER_S {
        return Some(format!(
            "an axis needs {way} m to reach its largest velocity of {} mm/s and to stop: velocities in mm/min? {} \
             mm/min are {} mm/s",
            significant(v, 4),
            significant(v, 4),
            significant(v / 60.0, 4)
        ));
    }
    Some(format!(
        "an axis needs {way} m to reach {} mm/s and to stop at its largest acceleration of {} mm/s^2: accelerations \
         in g or m/s^2? {} g are {} mm/s^2, {} m/s^2 are {} mm/s^2",
        significant(v, 4),
        significant(a, 4),
        significant(a, 4),
        significant(STANDARD_GRAVITY_MM_PER_S2 * a, 4),
        significant(a, 4),
        significant(1e3 * a, 4)
    ))
}

/// Returns a doubt about limits with which the motion along the path takes much longer than the removal.
fn of_slow_limits(desired: &Surface, tif: &Tif, limits: &Limits, pitch_mm: f64) -> Option<String> {
    let area_mm2 = desired.statistics().valid_count as f64 * desired.grid().pixel_mm2();
    let removal_s = removal_s(desired, tif);
    let fastest = limits.max_velocity_mm_per_s().into_iter().fold(0.0, f64::max);
    let travel_s = area_mm2 / pitch_mm / fastest;
    if !(removal_s > 0.0 && travel_s > MOST_TRAVEL * removal_s) {
        return None;
    }
    Some(format!(
        "the machine takes {} s for the path at its largest velocity of {} mm/s, and the removal {} s: limits in \
         m/s? give mm/s and mm/s^2",
        significant(travel_s, 3),
        significant(fastest, 3),
        significant(removal_s, 3)
    ))
}

/// Returns a doubt about the pitch of the map, if the part is larger than the travel of the machine.
pub fn of_travel(desired: &Surface, machine: &Machine) -> Option<String> {
    let grid = desired.grid();
    let [Some(x), Some(y)] = machine.travel_mm() else { return None };
    let mut travel_mm = [x[1] - x[0], y[1] - y[0]];
    let mut size_mm = grid.size_mm();
    // The part may lie turned by a quarter.
    travel_mm.sort_unstable_by(f64::total_cmp);
    size_mm.sort_unstable_by(f64::total_cmp);
    let ratio = (size_mm[0] / travel_mm[0]).max(size_mm[1] / travel_mm[1]);
    if ratio <= 1.0 {
        return None;
    }
    let [long, short] = [1, 0].map(|k| significant(size_mm[k], 4));
    let [far, near] = [1, 0].map(|k| significant(travel_mm[k], 4));
    let mistake = if grid.x.step_mm() == 1.0 {
        "coordinates in pixels?".to_string()
    } else {
        // The smallest mistaken unit that explains the size: cm, inches, metres in the place of millimetres.
        let (factor, mistake) =
            [(10.0, "mm that were read as cm"), (25.4, "mm that were read as inches")]
                .into_iter()
                .find(|(factor, _)| *factor >= ratio)
                .unwrap_or((1000.0, "um that were read as mm"));
        format!(
            "a pitch in {mistake}, which would be {} mm?",
            significant(grid.x.step_mm() / factor, 4)
        )
    };
    Some(format!(
        "the map is {long} x {short} mm, larger than the travel of the machine of {far} x {near} mm: {mistake} correct the \
         pitch of the map (surface_settings=\"--pixel-mm P\"), or crop it"
    ))
}

/// Returns the time in which the tool removes the mean depth all over the map, s.
fn removal_s(desired: &Surface, tif: &Tif) -> f64 {
    let area_mm2 = desired.statistics().valid_count as f64 * desired.grid().pixel_mm2();
    mean_depth_nm(desired) * area_mm2 / tif.vrr_nm_mm2_per_s()
}

/// Returns the mean depth of the desired removal, nm: the mean height above the lowest height. The lowest [`EXTREMES`]
/// of the pixels do not count, so that a downward spike is not the depth of the part.
fn mean_depth_nm(desired: &Surface) -> f64 {
    let s = desired.statistics();
    let low = statistics::lowest(desired.height_nm().view(), None, EXTREMES).unwrap_or(s.min);
    s.mean - low
}

/// Returns valid heights, at most [`MOST_SAMPLES`] of them, at equal distances in the array.
fn sampled(map: &Array2<f64>) -> Vec<f64> {
    let valid = statistics::valid_count(map.view());
    map.iter().filter(|z| !z.is_nan()).step_by(valid.div_ceil(MOST_SAMPLES)).copied().collect()
}

/// Returns a doubt about a height that far more pixels have, exactly, than any other height. `some` are sorted heights
/// of the map.
fn no_height(map: &Array2<f64>, some: &[f64]) -> Option<String> {
    let runs = some.chunk_by(|a, b| a == b);
    let mut repeated = 0;
    let mut height = 0.0;
    let mut second = 0;
    for run in runs {
        if run.len() > repeated {
            second = repeated;
            repeated = run.len();
            height = run[0];
        } else {
            second = second.max(run.len());
        }
    }
    // Fewer than two heights are a flat map, and no doubt.
    let many = repeated as f64 > LEAST_REPEATED * some.len() as f64;
    if !many || second == 0 || repeated < LEAST_REPEATED_RATIO * second {
        return None;
    }
    let [count] = statistics::counts(map.view(), [height]);
    Some(format!(
        "{count} pixels have exactly the height {height} nm, and no other height is so frequent: pixels without data? \
         mark them by NaN, or give the clear aperture (prepare=\"--aperture-rectangle-mm X0 X1 Y0 Y1\")"
    ))
}

/// Returns a doubt about pixels far outside the range of all others. `some` are sorted heights of the map.
fn spikes(map: &Array2<f64>, some: &[f64]) -> Option<String> {
    // At least the two outermost samples on each side.
    let out = ((EXTREMES * some.len() as f64) as usize).max(2);
    let low = *some.get(out)?;
    let high = *some.get(some.len().checked_sub(out + 1)?)?;
    let beyond = MOST_RANGES * (high - low);
    let count = map.iter().filter(|z| **z < low - beyond || **z > high + beyond).count();
    if beyond <= 0.0 || count == 0 {
        return None;
    }
    let (lowest, highest) = statistics::range(map.view());
    let farthest = if low - lowest > highest - high { lowest } else { highest };
    let (are, them) = if count == 1 { ("pixel lies", "it") } else { ("pixels lie", "them") };
    Some(format!(
        "{count} {are} up to {} nm beyond all others, which are from {} to {} nm: spikes, or pixels without data ({})? \
         prepare=\"--mask-outliers --feature-mm W\" leaves {them} out, where W is the width of the tool",
        significant((low - lowest).max(highest - high), 3),
        significant(low, 3),
        significant(high, 3),
        significant(farthest, 5)
    ))
}

/// Returns a doubt about a tool of several whose effective area is larger than the map: it removes little more than a
/// piston or a tilt.
pub fn of_width(surface: &Surface, tif: &Tif) -> Option<String> {
    let [x, y] = surface.grid().size_mm();
    let area_mm2 = tif.effective_area_mm2();
    if area_mm2 <= x * y {
        return None;
    }
    Some(format!(
        "is wider than the part (effective area {area_mm2:.0} mm^2, map {:.0} mm^2): it removes little more than a \
         piston or a tilt; leave it out unless that is its task",
        x * y
    ))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Axis;
    use crate::{KinematicsFile, MachineFile, MachineFileAxis};

    fn axis(start: f64, end: f64, n: usize) -> Axis {
        Axis::new(start, (end - start) / (n - 1) as f64, n).unwrap()
    }

    /// Returns a map of 40 x 24 mm with a PV of about 40 nm, whose heights are replaced by those of
    /// `change`.
    fn map(change: impl Fn(f64, (usize, usize)) -> f64) -> Surface {
        let grid = Grid { x: axis(0.0, 40.0, 81), y: axis(0.0, 24.0, 49) };
        let z = Array2::from_shape_fn((49, 81), |(r, c)| {
            let (x, y) = (c as f64 - 40.0, r as f64 - 20.0);
            change(0.01 * x * x + 0.03 * y * y + 0.3 * (0.7 * x).sin(), (r, c))
        });
        Surface::new(grid, z).unwrap()
    }

    /// Returns a Gaussian TIF of sigma 1.5 mm and 10 nm/s out to `half` mm, whose rates are replaced by
    /// those of `change`.
    fn tool(half: f64, change: impl Fn(f64) -> f64) -> Tif {
        let a = axis(-half, half, 49);
        let rate = Array2::from_shape_fn((49, 49), |(r, c)| {
            change(
                10.0 * (-0.5 * (a.coordinate_mm(r).powi(2) + a.coordinate_mm(c).powi(2)) / 2.25)
                    .exp(),
            )
        });
        Tif::new(Grid { x: a, y: a }, rate).unwrap()
    }

    fn limits(velocity: f64) -> Limits {
        let axis = |name: &str| MachineFileAxis {
            name: name.into(),
            max_velocity_mm_per_s: velocity,
            max_acceleration_mm_per_s2: 2000.0,
            ..MachineFileAxis::default()
        };
        let axes = ["x", "y"].map(axis).to_vec();
        MachineFile { name: "m".into(), axes, ..MachineFile::default() }.checked().unwrap()
    }

    fn of_map(surface: &Surface) -> Option<String> {
        let s = surface.statistics();
        of_heights(surface).or_else(|| of_removal(s.pv, s.rms, surface.detilted_rms_nm()))
    }

    #[track_caller]
    fn said(doubt: Option<String>, parts: &[&str]) {
        let doubt = doubt.expect("a doubt");
        assert!(!doubt.contains('\n'), "{doubt}");
        for part in parts {
            assert!(doubt.contains(part), "no {part:?} in: {doubt}");
        }
    }

    #[test]
    fn an_ordinary_map_with_its_tool_and_machine_is_in_no_doubt() {
        let (surface, tif) = (map(|z, _| z), tool(5.0, |rate| rate));
        assert_eq!(of_map(&surface), None);
        // Counts of 0.1 nm, a pit of the depth of the map, and a corner without data.
        assert_eq!(of_map(&map(|z, _| (10.0 * z).round() / 10.0)), None);
        assert_eq!(of_map(&map(|z, at| if at == (7, 9) { -30.0 } else { z })), None);
        assert_eq!(of_map(&map(|z, (r, c)| if r < 9 && c < 9 { f64::NAN } else { z })), None);
        // Some wedge, and a map that is flat.
        assert_eq!(of_map(&map(|z, (_, c)| z + 0.1 * c as f64)), None);
        assert_eq!(of_map(&map(|_, _| 5.0)), None);
        assert_eq!(of_tif(&tif), None);
        // A Gaussian that ends at 2.9 standard deviations, as that of the reference mirror does.
        assert_eq!(of_tif(&tool(4.4, |rate| rate)), None);
        assert_eq!(of_rates(&surface, &tif), None);
        for velocity in [1000.0, 250.0, 10.0] {
            assert_eq!(of_limits(&surface, &tif, &limits(velocity), 1.0), None);
        }
    }

    #[test]
    fn heights_that_are_none_are_named() {
        let hole = |v: f64| move |z, (r, c): (usize, usize)| if r < 9 && c < 20 { v } else { z };
        said(of_map(&map(hole(9999.0))), &["180 pixels have exactly the height 9999 nm"]);
        said(of_map(&map(hole(0.0))), &["the height 0 nm", "mark them by NaN", "prepare="]);
        let few = |z, at| if at == (3, 3) || at == (3, 4) { 9999.0 } else { z };
        said(of_map(&map(few)), &["2 pixels lie", "9999", "--mask-outliers --feature-mm W"]);
        let spikes = |z, at| match at {
            (10, 10) => 3000.0,
            (20, 30) => -3000.0,
            _ => z,
        };
        said(of_map(&map(spikes)), &["2 pixels lie", "spikes"]);
    }

    #[test]
    fn a_tilt_and_heights_in_um_are_named() {
        let tilted = of_map(&map(|z, (_, c)| z + 20.0 * c as f64));
        said(tilted, &["98 % of the RMS is a plane", "prepare=\"--level plane\""]);
        said(of_map(&map(|z, _| 1e-3 * z)), &["span 0.0", "heights in um"]);
    }

    #[test]
    fn heights_in_nm_that_were_read_as_um_are_named() {
        // 10 nm RMS, a thousand times.
        said(
            of_map(&map(|z, _| 1e3 * z)),
            &["nm RMS beside their best plane", "read as um", "--unit nm"],
        );
    }

    #[test]
    fn a_part_that_is_larger_than_the_travel_is_named() {
        let machine = |x: f64, y: f64| {
            let axis = |name: &str, half: f64| MachineFileAxis {
                name: name.into(),
                max_velocity_mm_per_s: 100.0,
                max_acceleration_mm_per_s2: 1000.0,
                travel_mm: Some([-half, half]),
                ..MachineFileAxis::default()
            };
            let axes = vec![axis("x", 0.5 * x), axis("y", 0.5 * y)];
            Machine::new(MachineFile { name: "m".into(), axes, ..MachineFile::default() }).unwrap()
        };
        // The map is 40 x 24 mm with a pitch of 0.5 mm; it may lie turned.
        assert_eq!(of_travel(&map(|z, _| z), &machine(24.0, 40.0)), None);
        let doubt = of_travel(&map(|z, _| z), &machine(39.0, 30.0));
        said(doubt, &["40 x 24 mm", "39 x 30 mm", "read as cm", "0.05 mm"]);
        said(of_travel(&map(|z, _| z), &machine(1.0, 1.0)), &["read as mm", "0.0005 mm"]);
    }

    #[test]
    fn a_tool_with_a_baseline_or_cropped_or_in_other_units_is_named() {
        let surface = map(|z, _| z);
        // 0.5 nm/s on 10 x 10 mm beside 2 pi sigma^2 10 nm/s: 50 / (50 + 141), and the lattice ends half a pitch later.
        // The width of the tail is that of the samples above half of the peak.
        let baseline = of_tif(&tool(5.0, |rate| rate + 0.5));
        said(
            baseline,
            &["4.7 % of its peak", "is 27 % of its volume", "--subtract-border takes it off"],
        );
        // 0.9 % of the peak of sigma 2 mm in a field of 41 mm: 75.6 of 201.3 nm mm^2/s.
        let wide = |add: &dyn Fn(f64, f64) -> f64| {
            let a = axis(-20.0, 20.0, 41);
            let of = |(r, c): (usize, usize)| {
                let (x, y) = (a.coordinate_mm(c), a.coordinate_mm(r));
                5.0 * (-0.125 * (x * x + y * y)).exp() + add(x, y)
            };
            of_tif(&Tif::new(Grid { x: a, y: a }, Array2::from_shape_fn((41, 41), of)).unwrap())
        };
        said(
            wide(&|_, _| 0.045),
            &["0.89 % of its peak", "is 38 % of its volume", "leaves 125.66 of 201.31"],
        );
        said(wide(&|_, _| -0.045), &["takes off 151 % of its volume", "leaves 125.66 of 50.019"]);
        said(wide(&|x, _| 0.00225 * x), &["moves 30 % of its volume", "leaves 125.66 of 125.66"]);
        said(
            wide(&|x, _| 0.00225 * (x + 20.0)),
            &["is 38 % of its volume", "leaves 125.66 of 201.31"],
        );
        assert_eq!(wide(&|_, _| 0.0), None);
        // exp(-1.317^2 / 2) = 0.42
        let cropped = of_tif(&tool(1.317 * 1.5, |rate| rate));
        said(cropped, &["ends at 42 % of its peak", "measure a wider field"]);
        // Mean depth of about 10 nm over 10 nm/s.
        said(of_rates(&surface, &tool(5.0, |rate| 60.0 * rate)), &["600 nm/s", "nm/min"]);
        said(of_rates(&surface, &tool(5.0, |rate| 1e-3 * rate)), &["0.01 nm/s", "um/s"]);
        // A tool that takes 4 s at one place, whose rates are in um/min.
        let usual = mean_depth_nm(&surface) / 10.0 / USUAL_MEAN_DEPTH_S;
        said(
            of_rates(&surface, &tool(5.0, |rate| 0.06 * usual * rate)),
            &[
                "in 67 s at one place",
                "rates in um/min (it would be 4 s), or heights in angstrom (it would be 6.7 s)?",
            ],
        );
        said(
            of_time(&map(|z, _| 1e7 * z), &tool(5.0, |rate| rate)),
            &["days: rates in um/s? it would be"],
        );
        assert_eq!(of_time(&surface, &tool(5.0, |rate| rate)), None);
        let floor = of_floor(&surface, &tool(5.0, |rate| rate), 1e4);
        said(
            floor,
            &["least dwell times alone take 10000 s", "in ms? together they would take 10 s"],
        );
        assert_eq!(of_floor(&surface, &tool(5.0, |rate| rate), 10.0), None);
    }

    #[test]
    fn coordinates_in_pixels_inches_and_beyond_the_travel_are_named() {
        let surface = map(|z, _| z);
        let grid = |start: f64, n: usize| Grid {
            x: axis(start, start + n as f64 - 1.0, n),
            y: axis(start, start + n as f64 - 1.0, n),
        };
        let pixels = Surface::new(grid(0.0, 60), Array2::from_elem((60, 60), 1.0)).unwrap();
        let (fine, coarse) = (
            tool(5.0, |rate| rate),
            Tif::new(grid(-24.0, 49), Array2::from_elem((49, 49), 1.0)).unwrap(),
        );
        // Steps of 10 / 48 mm.
        said(
            of_pixels(&pixels, &fine),
            &["the pitch of the map is exactly 1 mm", "59 x 59 mm would be 12.29 x 12.29 mm"],
        );
        said(
            of_pixels(&surface, &coarse),
            &["the pitch of the TIF is exactly 1 mm", "48 x 48 mm would be 24 x 24 mm"],
        );
        assert_eq!((of_pixels(&surface, &fine), of_pixels(&pixels, &coarse)), (None, None));
        said(of_sizes(&surface, &coarse), &["a map in inches? it would be 1016 x 609.6 mm"]);
        assert_eq!(of_sizes(&surface, &fine), None);
        let machine = |travel: f64| {
            let axis = |name: &str| MachineFileAxis {
                name: name.into(),
                max_velocity_mm_per_s: 10.0,
                max_acceleration_mm_per_s2: 100.0,
                travel_mm: Some([0.0, travel]),
                ..MachineFileAxis::default()
            };
            let axes = ["x", "y"].map(axis).to_vec();
            Machine::new(MachineFile { name: "m".into(), axes, ..MachineFile::default() }).unwrap()
        };
        said(
            of_travel(&surface, &machine(30.0)),
            &["the map is 40 x 24 mm, larger than the travel of the machine of 30 x 30 mm", "cm"],
        );
        said(of_travel(&pixels, &machine(30.0)), &["coordinates in pixels"]);
        assert_eq!(of_travel(&surface, &machine(300.0)), None);
        said(
            of_vertex(&surface, [0.0; 2]),
            &["at (0, 0) mm, which is a corner", "the middle of the part is at (20, 12) mm"],
        );
        assert_eq!(
            (of_vertex(&surface, [20.0, 12.0]), of_vertex(&surface, [0.0, 12.0])),
            (None, None)
        );
    }

    #[test]
    fn radians_are_named() {
        said(
            of_angle("the angle", 1.571),
            &["the angle is 1.571 degrees: radians? it would be 90 degrees"],
        );
        said(of_angle("the angle", -0.5237), &["it would be -30 degrees"]);
        for degrees in [0.0, 1.0, 1.5, 2.0, 0.5, 45.0, 90.0, 3.0] {
            assert_eq!(of_angle("the angle", degrees), None, "{degrees}");
        }
        said(of_incidences(1.2, 7), &["ends at 1.2 degrees: radians? it would be 68.8 degrees"]);
        assert_eq!((of_incidences(60.0, 7), of_incidences(1.2, 2)), (None, None));
    }

    #[test]
    fn a_diameter_of_a_pad_for_its_radius_is_named() {
        let flat = tool(10.0, |_| 5.0);
        said(of_pad(&flat, 20.0), &["up to 10 mm", "a diameter for a radius? it would be 10 mm"]);
        said(of_pad(&flat, 2.5), &["a radius that was halved? it would be 5 mm"]);
        // A pad that orbits removes beyond its edge.
        assert_eq!((of_pad(&flat, 10.0), of_pad(&flat, 5.0)), (None, None));
    }

    #[test]
    fn a_pivot_in_metres_is_named() {
        let with_pivot = |mm: f64| {
            let text = include_str!("../../../fixtures/machines/bonnet-five-axis.json");
            let mut file: MachineFile = serde_json::from_str(text).unwrap();
            if let Some(KinematicsFile::XyzTilts { pivot_mm, .. }) = &mut file.kinematics {
                *pivot_mm = mm;
            }
            of_pivot(&Machine::new(file).unwrap())
        };
        said(with_pivot(0.08), &["pivot_mm is 0.08 mm", "metres? it would be 80 mm"]);
        said(with_pivot(-0.03), &["it would be -30 mm"]);
        assert_eq!((with_pivot(0.0), with_pivot(80.0)), (None, None));
    }

    #[test]
    fn a_residual_above_the_start_names_the_mistake_with_its_value() {
        let waves = |r: usize, c: usize| {
            20.0 * (0.21 * c as f64 + 0.4).sin() * (0.17 * r as f64).cos() + 0.3 * c as f64
        };
        let desired = map(|_, (r, c)| waves(r, c));
        let (rows, columns) = desired.height_nm().dim();
        let removal = |of: &dyn Fn(usize, usize) -> f64| {
            let removed = Array2::from_shape_fn((rows, columns), |(r, c)| of(r, c) + 100.0);
            Removal::new(&desired, removed).unwrap()
        };
        for (of, parts) in [
            (
                &(|r, c| 3.0 * waves(r, c)) as &dyn Fn(usize, usize) -> f64,
                ["another unit", "0.333 times"],
            ),
            (&|r, c| -waves(r, c), ["sign of the map", "nm would be left"]),
            (
                &|r, c| waves(rows - 1 - r, columns - 1 - c),
                ["turned by 180 degrees", "larger than"],
            ),
            (&|r, c| 1.5 * waves(r, c + 7), ["lie (-3.5, 0) mm off", "larger than"]),
            (
                &|r, c| 40.0 * ((r * 7919 + c * 104_729) % 97) as f64,
                ["no single factor", "same part"],
            ),
        ] {
            said(of_residual(&desired, &removal(of)), &parts);
        }
        assert_eq!(of_residual(&desired, &removal(&|r, c| 0.9 * waves(r, c))), None);
    }

    #[test]
    fn apertures_of_another_size_and_inverted_masks_are_named() {
        let grid = Grid { x: axis(-10.0, 10.0, 41), y: axis(-10.0, 10.0, 41) };
        let disk = |inverted: bool| {
            let z = Array2::from_shape_fn((41, 41), |(r, c)| {
                let inside = grid.x.coordinate_mm(c).hypot(grid.y.coordinate_mm(r)) <= 10.0;
                if inside == inverted { f64::NAN } else { 1.0 }
            });
            Surface::new(grid, z).unwrap()
        };
        let circle = |radius_mm: f64| ClearAperture::Circle { centre_mm: [0.0; 2], radius_mm };
        said(of_circle(&disk(false), &circle(20.0)), &["a diameter for a radius? 10 mm would fit"]);
        said(of_circle(&disk(false), &circle(5.0)), &["radius of 5 mm", "10 mm would fit"]);
        for radius in [9.0, 10.0, 11.0, 7.0] {
            assert_eq!(of_circle(&disk(false), &circle(radius)), None);
        }
        said(of_mask(&disk(true)), &["an inverted mask? then 75 % would be valid"]);
        assert_eq!((of_mask(&disk(false)), of_mask(&map(|z, _| z))), (None, None));
    }

    #[test]
    fn limits_in_mm_per_minute_and_in_g_are_named() {
        let of = |velocity: f64, acceleration: f64| {
            let mut file: MachineFile = (&limits(velocity)).into();
            file.axes.iter_mut().for_each(|axis| axis.max_acceleration_mm_per_s2 = acceleration);
            of_limits(&map(|z, _| z), &tool(5.0, |rate| rate), &file.checked().unwrap(), 1.0)
        };
        // 250 mm/s are 15000 mm/min: 15000^2 / 2000 mm are 112 m.
        said(of(15000.0, 2000.0), &["needs 112 m", "mm/min", "15000 mm/min are 250 mm/s"]);
        said(of(250.0, 0.2), &["0.2 g are 1961 mm/s^2", "0.2 m/s^2 are 200 mm/s^2"]);
        // A slow machine: 20 mm/s and 200 mm/s^2.
        said(of(1200.0, 200.0), &["1200 mm/min are 20 mm/s"]);
        said(of(20.0, 0.02), &["0.02 g are 196.1 mm/s^2"]);
        assert_eq!(of(500.0, 100.0), None);
    }

    #[test]
    fn limits_in_metres_per_second_are_named() {
        let doubt = of_limits(&map(|z, _| z), &tool(5.0, |rate| rate), &limits(0.25), 1.0);
        said(doubt, &["largest velocity of 0.25 mm/s", "limits in m/s"]);
    }
}
