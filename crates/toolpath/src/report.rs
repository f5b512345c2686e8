//! Report on a path: its statistics, and warnings for the user.

use planish_types::{Machine, Surface, Tif, ToolPath};
use serde::Serialize;

use crate::{
    region::valid_mm,
    statistics::{PathStatistics, PitchLimit, pitch_limit, statistics},
};

/// Returns a sentence for every axis of `machine` whose travel `path` leaves. It says how far the path is beyond the
/// travel, and how much overscan the travel allows.
///
/// ```text
/// too far = beyond the travel by the path;   the largest overscan = travel beyond the clear aperture, on the nearer side
/// ```
pub fn travel_warnings(path: &ToolPath, surface: &Surface, machine: &Machine) -> Vec<String> {
    let aperture = valid_mm(surface);
    let mut warnings = Vec::new();
    for (axis, travel) in machine.travel_mm().iter().enumerate() {
        let Some([from, to]) = *travel else { continue };
        let [low, high] = range_on_axis(path.point_mm(), machine, axis);
        let beyond = (from - low).max(high - to);
        if beyond <= TRAVEL_NOISE_MM {
            continue;
        }
        let [first, last] = range_on_axis(&aperture, machine, axis);
        let room = (first - from).min(to - last);
        let what_fits = if room >= 0.0 {
            format!(
                "the clear aperture is from {first:.3} to {last:.3} mm there, which leaves an overscan of \
                 {room:.3} mm at most (`overscan_mm`)"
            )
        } else {
            format!(
                "the clear aperture itself, from {first:.3} to {last:.3} mm there, does not fit"
            )
        };
        let length = high - low;
        let available = to - from;
        let remedy = if length <= available {
            // The middle: a motion swings a little beyond the path.
            let to_middle = (from + to - low - high) / 2.0;
            format!(
                "; with part_origin_mm of {} moved by {to_middle:.3} mm the path is in the middle of the travel",
                AXES[axis]
            )
        } else {
            String::new()
        };
        warnings.push(format!(
            "the path leaves the travel of axis {} of {}: from {low:.3} to {high:.3} mm, the travel is {from} to \
             {to} mm, {beyond:.3} mm too far; {what_fits}{remedy}",
            AXES[axis],
            machine.name().escape_debug()
        ));
    }
    warnings
}

/// Returns the smallest and largest position of a machine axis (0: x, 1: y), mm, at points given in coordinates of the
/// part.
fn range_on_axis(points: &[[f64; 2]], machine: &Machine, axis: usize) -> [f64; 2] {
    let positions = points
        .iter()
        .map(|p| machine.part_to_axes().map_or(*p, |transform| transform.point(*p))[axis]);
    positions.fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], v| [low.min(v), high.max(v)])
}

/// Names of the machine axes 0 and 1 in warnings.
const AXES: [&str; 2] = ["x", "y"];

/// Distance beyond the travel up to which a point counts as within it, mm. Larger: real violations pass without a
/// warning. Smaller: rounding of a rotation (1e-13 mm) causes warnings.
const TRAVEL_NOISE_MM: f64 = 1e-9;

/// Report on a path: statistics, limits of the pitch, results of its method (`R`) and warnings.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PathReport<R> {
    /// Lengths, steps, turns, crossings and coverage of the path.
    #[serde(flatten)]
    pub statistics: PathStatistics,
    /// Upper limits of the pitch for this TIF; left out without a TIF.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub pitch_limit: Option<PitchLimit>,
    /// Results that only the method of this path has.
    #[serde(flatten)]
    pub own: R,
    /// Warnings for the user.
    pub warnings: Vec<String>,
}

impl<R> PathReport<R> {
    /// Reports on `path` over the valid pixels of `surface`; `largest_pitch_mm` is the largest distance
    /// of its neighbouring lines, `warnings` are those of its method.
    pub fn new(
        path: &ToolPath,
        surface: &Surface,
        tif: Option<&Tif>,
        largest_pitch_mm: f64,
        own: R,
        mut warnings: Vec<String>,
    ) -> Self {
        let statistics = statistics(path, surface);
        let pitch_limit = tif.map(pitch_limit);
        if let Some(l) = pitch_limit.filter(|l| largest_pitch_mm > l.tif_size_sixth_mm) {
            warnings.push(format!(
                "the pitch of {largest_pitch_mm} mm is larger than a sixth of the TIF's size ({:.4} mm): \
                 the lines will show",
                l.tif_size_sixth_mm
            ));
        }
        if let Some(far) = statistics.coverage_mm.filter(|far| *far > largest_pitch_mm) {
            warnings.push(format!(
                "a pixel is {far:.4} mm from the path, more than the pitch of {largest_pitch_mm} mm: give \
                 a smaller pitch or a larger overscan"
            ));
        }
        Self { statistics, pitch_limit, own, warnings }
    }
}
