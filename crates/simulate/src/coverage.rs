//! Coverage: the part of a map that the tool of a motion reaches.
//!
//! A motion in other coordinates, or with its tool switched the wrong way round, is a valid motion: it removes nothing,
//! and the residual is the map. So every prediction says which part of the map the tool touches.

use ndarray::{Array2, Zip};
use planish_numerics::polynomial;
use planish_types::{Surface, Tif, Trajectory, text::significant};
use serde::Serialize;

/// Removal, as a fraction of the largest removal, above which a pixel counts as touched. Larger: the thin rim of a tool
/// does not count. Smaller: rounding of the transforms (about 1e-15) and far tails of a smooth tool (below 1e-9 of its
/// peak) count.
const TOUCHED: f64 = 1e-9;

/// Removal up to which a pixel does not count as touched, as a fraction of the peak of the TIF times the time with the
/// tool on. It is rounding of the transforms. Larger: weak removals do not count. Smaller: rounding counts.
const ROUNDING: f64 = 1e-13;

/// Smallest fraction of the valid pixels that a plan for the whole map touches, dimensionless; a run that touches less
/// gets a warning. Such a run is a local correction, or its motion is in other coordinates. Larger: warnings about
/// local corrections. Smaller: wrong coordinates pass.
const LEAST_TOUCHED: f64 = 0.5;

/// Smallest fraction of the removed volume that falls on the valid pixels, dimensionless; a run with less gets a
/// warning. Overscan with a tool as large as the part loses half of the volume, and more with a part that is narrow
/// beside the tool. Larger: warnings about such plans. Smaller: wrong coordinates pass.
const LEAST_ON_MAP: f64 = 0.1;

/// Coverage of a map by a motion: touched pixels, removed volume, and time with the tool on.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Coverage {
    /// Number of valid pixels from which the tool removes material.
    pub touched_pixels: usize,
    /// Number of valid pixels of the map.
    pub valid_pixels: usize,
    /// Fraction of the removed volume that falls on valid pixels; 0 if nothing is removed.
    pub volume_on_map: f64,
    /// Time with the tool on, s.
    pub tool_on_s: f64,
    #[serde(skip)]
    total_s: f64,
    /// Lowest and highest point [x, y] of the motion with the tool on, mm; `None` if it is never on.
    #[serde(skip)]
    spans_mm: Option<[[f64; 2]; 2]>,
    #[serde(skip)]
    map_mm: [[f64; 2]; 2],
}

impl Coverage {
    /// Computes the coverage of the valid pixels of `desired`. `removal_nm` is the removal of `trajectory` with `tif`,
    /// shape (ny, nx), nm.
    pub fn new(
        removal_nm: &Array2<f64>,
        trajectory: &Trajectory,
        tif: &Tif,
        desired: &Surface,
    ) -> Self {
        let mut tool_on_s = 0.0;
        let mut at_rate_s = 0.0;
        let mut spans_mm: Option<[[f64; 2]; 2]> = None;
        for s in trajectory.segments().filter(|s| s.tool_on) {
            tool_on_s += s.duration_s;
            at_rate_s += s.rate_factor * s.duration_s;
            let spans = [0, 1].map(|a| polynomial::range(&s.coefficient_mm[a], s.duration_s));
            let [low, high] = spans_mm.get_or_insert([[f64::INFINITY; 2], [f64::NEG_INFINITY; 2]]);
            for a in 0..2 {
                low[a] = low[a].min(spans[a].min);
                high[a] = high[a].max(spans[a].max);
            }
        }
        let largest = removal_nm.iter().copied().fold(0.0, f64::max);
        let least = (TOUCHED * largest).max(ROUNDING * at_rate_s * tif.peak_nm_per_s());
        let mut touched_pixels = 0;
        let mut valid_pixels = 0;
        let mut volume = 0.0;
        Zip::from(removal_nm).and(desired.height_nm()).for_each(|r, z| {
            if !z.is_nan() {
                valid_pixels += 1;
                touched_pixels += usize::from(*r > least);
                volume += r;
            }
        });
        let grid = desired.grid();
        let volume = volume * grid.pixel_mm2();
        let removed = at_rate_s * tif.vrr_nm_mm2_per_s();
        Self {
            touched_pixels,
            valid_pixels,
            volume_on_map: if removed > 0.0 { volume / removed } else { 0.0 },
            tool_on_s,
            total_s: trajectory.total_time_s(),
            spans_mm,
            map_mm: [[grid.x.start_mm(), grid.y.start_mm()], [grid.x.end_mm(), grid.y.end_mm()]],
        }
    }

    /// Returns the reason why a run is useless whose tool touches no valid pixel; `None` if it touches any.
    pub fn drawback(&self) -> Option<String> {
        if self.touched_pixels > 0 {
            return None;
        }
        let Some(spans_mm) = self.spans_mm else {
            return Some(
                "the motion removes nothing: tool_on is 0 in every segment; is it inverted, or a dry run?"
                    .into(),
            );
        };
        Some(format!(
            "the tool never touches the map: with the tool on the motion is within {}, and the map within {}; are \
             both in mm and in the same coordinates, and is tool_on 1 where the tool removes?",
            shown(&spans_mm),
            shown(&self.map_mm)
        ))
    }

    /// Returns the warning about a run that touches less than `LEAST_TOUCHED` of the valid pixels, or whose volume
    /// falls on them by less than `LEAST_ON_MAP`. Returns `None` for other runs, and for runs that touch no valid
    /// pixel.
    pub fn warning(&self) -> Option<String> {
        let touched = self.touched_pixels as f64 / self.valid_pixels.max(1) as f64;
        let few = touched < LEAST_TOUCHED;
        let spans_mm = self.spans_mm.filter(|_| self.touched_pixels > 0)?;
        if !few && self.volume_on_map >= LEAST_ON_MAP {
            return None;
        }
        Some(format!(
            "the tool removes material from {} % of the map's valid pixels, and {} % of what it removes falls on them; it \
             is on for {} s of {} s, within {}, and the map is within {}: unless this is a local correction, check the \
             coordinates and tool_on",
            significant(100.0 * touched, 2),
            significant(100.0 * self.volume_on_map, 2),
            significant(self.tool_on_s, 4),
            significant(self.total_s, 4),
            shown(&spans_mm),
            shown(&self.map_mm)
        ))
    }
}

/// Returns a text for a rectangle from its lowest and its highest point [x, y], mm.
fn shown([low, high]: &[[f64; 2]; 2]) -> String {
    let [x0, x1, y0, y1] = [low[0], high[0], low[1], high[1]].map(|mm| significant(mm, 5));
    format!("x {x0} .. {x1} mm, y {y0} .. {y1} mm")
}
