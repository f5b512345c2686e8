//! Largest distance of a motion from its tool path.
//!
//! A segment of the motion that serves dwell point i is compared with segment i of the path. A segment that serves
//! none, such as a link between two passes, is compared with the nearest of the segments between those that its
//! neighbours serve. A motion that names no dwell points, such as a program of a controller, is compared with the
//! nearest segment of the whole path.

use std::cell::Cell;

use planish_numerics::distance::{Chord, Point, from_chord, largest};
use serde::{Deserialize, Serialize};

use crate::{Invalid, ToolPath, Trajectory};

/// Usual tolerance of a motion, as a fraction of the distance between the lines of its path. Larger: a motion may swing
/// out into the neighbouring lines. Smaller: it has to stop at corners. Chosen: the middle between two lines.
const USUAL_PART: f64 = 0.5;

/// Smallest turn of a path that ends a straight leg, rad (30 degrees). Larger: slow bends count as straight. Smaller:
/// the segments of a curve count as legs.
const CORNER_RAD: f64 = std::f64::consts::FRAC_PI_6;

/// Largest distance between lines for which the usual tolerance allows, relative to the median distance of points.
/// Larger: a path with long legs has a wide tolerance. Smaller: a motion along lines with close points has to follow
/// more closely than its lines need.
const LINES_PER_POINT: f64 = 4.0;

/// Excess over the tolerance that counts as rounding, relative to the tolerance and, below, in mm. Larger: real
/// excesses pass. Smaller: the rounding of a coordinate of 1 m, 1e-13 mm, and the gap of the search, 1e-7, count.
const ROUNDING: f64 = 1e-6;
const ROUNDING_MM: f64 = 1e-9;

/// Largest distance of a motion from its path, and its tolerance.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct PathDistance {
    /// Largest distance with the tool on, mm.
    pub tool_on_mm: f64,
    /// Start time of the segment of the motion that has this distance, s.
    pub tool_on_time_s: f64,
    /// Largest distance with the tool off, mm. No tolerance applies to it.
    pub tool_off_mm: f64,
    /// Largest allowed distance with the tool on, mm.
    pub tolerance_mm: f64,
    /// True if the distance with the tool on is within its tolerance.
    pub within: bool,
    /// True if every segment of the motion was compared with the segment of the path that it serves, and not with the
    /// nearest one.
    pub by_dwell_points: bool,
}

impl ToolPath {
    /// Returns the tolerance of a motion along the path, mm: the `requested` one, or half the distance between the
    /// lines of the path. That distance is the lower quartile of the lengths of straight legs, limited to between one
    /// and four median distances of neighbouring points. It is 0 for a path without length.
    ///
    /// # Errors
    ///
    /// A requested tolerance that is negative or not finite.
    pub fn tolerance_mm(&self, requested: Option<f64>) -> Result<f64, Invalid> {
        match requested {
            None => Ok(self.usual_tolerance_mm()),
            Some(mm) if mm.is_finite() && mm >= 0.0 => Ok(mm),
            Some(mm) => Err(Invalid::whole(
                "max_path_distance_mm",
                format!("is {mm}"),
                "give the largest distance of the motion from its path, a finite number >= 0",
            )),
        }
    }

    /// Returns half the distance between the lines of the path, mm; 0 for a path without length.
    fn usual_tolerance_mm(&self) -> f64 {
        let [on_mm, off_mm] = [true, false].map(|on| {
            let segments = (0..self.len()).filter(|i| self.tool_on()[*i] == on);
            segments.map(|i| self.segment_length_mm(i)).filter(|mm| *mm > 0.0).collect()
        });
        let point_mm = quantile(on_mm, 2).or_else(|| quantile(off_mm, 2)).unwrap_or(0.0);
        let line_mm = quantile(self.legs_mm(), 4).unwrap_or(point_mm);
        USUAL_PART * line_mm.clamp(point_mm, LINES_PER_POINT * point_mm)
    }

    /// Returns the lengths of the straight legs between two corners of the path, with the tool on, mm. Legs that begin
    /// or end where the tool is switched do not count.
    fn legs_mm(&self) -> Vec<f64> {
        let mut legs_mm = Vec::new();
        // Length since the last corner, if there is one, and direction of the segment before.
        let mut leg_mm = None;
        let mut before = None;
        for i in 0..self.len() {
            let [dx, dy] = self.displacement_mm(i);
            let length_mm = self.segment_length_mm(i);
            if !self.tool_on()[i] {
                leg_mm = None;
                before = None;
            } else if length_mm > 0.0 {
                let direction = [dx / length_mm, dy / length_mm];
                let turns = before.is_some_and(|[x, y]: [f64; 2]| {
                    x * direction[0] + y * direction[1] < CORNER_RAD.cos()
                });
                if turns {
                    legs_mm.extend(leg_mm);
                    leg_mm = Some(0.0);
                }
                leg_mm = leg_mm.map(|mm| mm + length_mm);
                before = Some(direction);
            }
        }
        legs_mm
    }
}

/// Returns the sorted value at the fraction 1 / `part`: 2 for the median, 4 for the lower quartile. `None` without
/// values.
fn quantile(mut values: Vec<f64>, part: usize) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / part).copied()
}

impl PathDistance {
    /// Measures the distance of `motion` from `path`. Without `tolerance_mm`, the usual tolerance of the path applies.
    ///
    /// # Errors
    ///
    /// A tolerance that is negative or not finite, and a motion that serves other dwell points than those of the path.
    pub fn new(
        motion: &Trajectory,
        path: &ToolPath,
        tolerance_mm: Option<f64>,
    ) -> Result<Self, Invalid> {
        let tolerance_mm = path.tolerance_mm(tolerance_mm)?;
        let served = served_segments(motion, path)?;
        let mut distance = Self {
            tool_on_mm: 0.0,
            tool_on_time_s: motion.break_time_s()[0],
            tool_off_mm: 0.0,
            tolerance_mm,
            within: true,
            by_dwell_points: motion.dwell_index().iter().all(Option::is_some),
        };
        let nearest = Nearest { path, last: Cell::new(0) };
        for (segment, range) in motion.segments().zip(served) {
            let before_mm =
                if segment.tool_on { distance.tool_on_mm } else { distance.tool_off_mm };
            let mm =
                largest(segment.coefficient_mm, segment.duration_s, before_mm, |points, enough| {
                    nearest.farthest(points, &range, enough)
                });
            if !segment.tool_on {
                distance.tool_off_mm = mm;
            } else if mm > before_mm {
                distance.tool_on_mm = mm;
                distance.tool_on_time_s = segment.start_s;
            }
        }
        Ok(distance.judged_by(tolerance_mm))
    }

    /// Returns the same distances, judged by another tolerance, mm.
    pub fn judged_by(self, tolerance_mm: f64) -> Self {
        let within = self.tool_on_mm <= tolerance_mm * (1.0 + ROUNDING) + ROUNDING_MM;
        Self { tolerance_mm, within, ..self }
    }

    /// Returns the distances after a transform of both the motion and its path that stretches lengths by up to
    /// `factor`. The tolerance grows in the same proportion.
    pub fn stretched_by(self, factor: f64) -> Self {
        Self {
            tool_on_mm: factor * self.tool_on_mm,
            tool_off_mm: factor * self.tool_off_mm,
            tolerance_mm: factor * self.tolerance_mm,
            ..self
        }
    }

    /// Returns the sentence that states the excess, or `None` if the motion is within its tolerance.
    pub fn excess(&self) -> Option<String> {
        if self.within {
            return None;
        }
        Some(format!(
            "with the tool on, the motion leaves its path by {}, and the tolerance is {} (`max_path_distance_mm`)",
            lengths(self.tool_on_mm),
            lengths(self.tolerance_mm)
        ))
    }
}

impl std::fmt::Display for PathDistance {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(
            f,
            "up to {} from the path with the tool on (tolerance {}), {} with it off",
            lengths(self.tool_on_mm),
            lengths(self.tolerance_mm),
            lengths(self.tool_off_mm)
        )
    }
}

/// Returns a length as text, in um below 0.1 mm, else in mm.
fn lengths(mm: f64) -> String {
    if mm < 0.1 { format!("{:.3} um", 1e3 * mm) } else { format!("{mm:.4} mm") }
}

/// Returns, for every segment of the motion, the first and the last segment of the path with which it is compared.
fn served_segments(motion: &Trajectory, path: &ToolPath) -> Result<Vec<[usize; 2]>, Invalid> {
    let index = motion.dwell_index();
    let last = path.len() - 1;
    if let Some(k) = index.iter().position(|i| i.is_some_and(|i| i > last)) {
        let problem = format!("is {:?}, and the path has {} dwell points", index[k], path.len());
        let remedy = "give the tool path that the motion was made for";
        return Err(Invalid::at_index("dwell_index", k, problem, remedy));
    }
    let nothing_served = index.iter().all(Option::is_none);
    let mut first = 0;
    let mut ranges: Vec<[usize; 2]> = Vec::with_capacity(index.len());
    for served in index {
        first = served.unwrap_or(first);
        ranges.push([first, served.unwrap_or(last)]);
    }
    if !nothing_served {
        // A segment that serves none ends where the next one begins that does. After the last one nothing follows.
        let mut next = index.iter().rev().find_map(|i| *i).unwrap_or(last);
        for (range, served) in ranges.iter_mut().zip(index).rev() {
            next = served.unwrap_or(next);
            range[1] = next;
            if range[0] > range[1] {
                range.reverse();
            }
        }
    }
    Ok(ranges)
}

/// Search for the nearest segment of a path, which begins where the search before ended.
struct Nearest<'a> {
    path: &'a ToolPath,
    /// Index of the segment that was the nearest one in the search before.
    last: Cell<usize>,
}

impl Nearest<'_> {
    /// Returns the distance of `points` from the nearest segment of the range, mm. The distance of a segment is the
    /// largest over the points. The search begins at the segment of the search before, and ends early at a distance of
    /// `enough`.
    fn farthest(&self, points: &[Point], [first, last]: &[usize; 2], enough: f64) -> f64 {
        let start = self.last.get().clamp(*first, *last);
        let mut least = f64::INFINITY;
        let reach = (start - first).max(last - start);
        for apart in 0..=reach {
            let near = [start.checked_sub(apart), start.checked_add(apart)];
            for i in near.into_iter().flatten().filter(|i| (first..=last).contains(&i)) {
                let mm = self.distance_to_segment(points, i);
                if mm < least {
                    least = mm;
                    self.last.set(i);
                }
            }
            if least <= enough {
                break;
            }
        }
        least
    }

    /// Returns the largest distance of `points` from segment `i`, mm.
    fn distance_to_segment(&self, points: &[Point], i: usize) -> f64 {
        let chord: Chord = [self.path.point_mm()[i], self.path.point_mm()[i + 1]];
        points.iter().map(|p| from_chord(*p, &chord)).fold(0.0, f64::max)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn path(points: &[[f64; 2]], on: &[bool]) -> ToolPath {
        ToolPath::through(points.to_vec(), on.to_vec(), vec![0; on.len()]).unwrap()
    }

    fn motion(c: Vec<[[f64; 4]; 2]>, on: &[bool], index: Vec<Option<usize>>) -> Trajectory {
        let times = (0..=c.len()).map(|k| k as f64).collect();
        Trajectory::new(times, c, on.to_vec(), index).unwrap()
    }

    /// Returns the coefficients of a motion from `from` to `to` in 1 s, with a bulge of `bulge` / 4 mm along y.
    fn bulging(from: [f64; 2], to: [f64; 2], bulge: f64) -> [[f64; 4]; 2] {
        [[from[0], to[0] - from[0], 0.0, 0.0], [from[1], to[1] - from[1] + bulge, -bulge, 0.0]]
    }

    #[test]
    fn tool_on_and_off_are_stated_apart_and_a_segment_has_its_own_chord() {
        let path = path(&[[0.0, 0.0], [4.0, 0.0], [4.0, 1.0], [0.0, 1.0]], &[true, false, true]);
        let c = vec![
            bulging([0.0, 0.0], [4.0, 0.0], 2.0),
            bulging([4.0, 0.0], [6.0, 1.0], 0.0),
            // Half a line away from its own line, and on the other one.
            bulging([4.0, 0.0], [0.0, 0.0], 0.0),
        ];
        let on = [true, false, true];
        let own = motion(c.clone(), &on, vec![Some(0), Some(1), Some(2)]);
        let found = PathDistance::new(&own, &path, None).unwrap();
        // The gap of the search is 1e-7.
        assert!((found.tool_on_mm - 1.0).abs() < 1e-6 && found.tool_on_time_s == 2.0, "{found:?}");
        assert!((found.tool_off_mm - 2.0).abs() < 1e-6 && found.by_dwell_points, "{found:?}");
        // Half the median of 4 and 4 mm.
        assert_eq!((found.tolerance_mm, found.within), (2.0, true));
        let strict = PathDistance::new(&own, &path, Some(0.9)).unwrap();
        assert!(strict.excess().unwrap().contains("by 1.0000 mm"), "{strict:?}");
        // Without dwell points the nearest line counts.
        let foreign = motion(c, &on, vec![None; 3]);
        let found = PathDistance::new(&foreign, &path, None).unwrap();
        assert!((found.tool_on_mm - 0.5).abs() < 1e-6 && !found.by_dwell_points, "{found:?}");
    }

    #[test]
    fn a_link_lies_between_the_segments_that_its_neighbours_serve() {
        let points: Vec<[f64; 2]> = (0..5).map(|k| [f64::from(k), 0.0]).collect();
        let path = path(&points, &[true; 4]);
        let along = |from: f64, to: f64| bulging([from, 0.0], [to, 0.0], 0.0);
        let c = vec![along(0.0, 1.0), along(1.0, 2.0), along(3.0, 4.0), along(0.0, 0.5)];
        let index = vec![Some(0), None, Some(1), None];
        let ranges = served_segments(&motion(c.clone(), &[true; 4], index), &path).unwrap();
        assert_eq!(ranges, [[0, 0], [0, 1], [1, 1], [1, 1]]);
        let beyond = motion(c, &[true; 4], vec![Some(4); 4]);
        let message = PathDistance::new(&beyond, &path, None).unwrap_err().to_string();
        assert!(message.contains("the tool path that the motion was made for"), "{message}");
    }

    #[test]
    fn the_usual_tolerance_is_half_the_distance_of_the_lines() {
        // Lines of 20 mm with a pitch of 1 mm and points every 0.5 mm, then every 0.1 mm.
        for (step, expected) in [(0.5, 0.5), (0.1, 0.2), (2.0, 1.0)] {
            let mut points = vec![[0.0, 0.0]];
            for line in 0..6 {
                let [x, y] = [20.0 * f64::from(line % 2), f64::from(line)];
                let sign = if line % 2 == 0 { 1.0 } else { -1.0 };
                let n = (20.0 / step) as u32;
                points.extend((1..=n).map(|k| [x + sign * step * f64::from(k), y]));
                points.push([20.0 - x, y + 1.0]);
            }
            let raster = path(&points, &vec![true; points.len() - 1]);
            // Rounding of coordinates of 20 mm.
            assert!((raster.tolerance_mm(None).unwrap() - expected).abs() < 1e-12, "{step}");
        }
        assert_eq!(path(&[[1.0; 2]; 3], &[true; 2]).tolerance_mm(None).unwrap(), 0.0);
        let lift = path(&[[0.0; 2], [3.0, 4.0]], &[false]);
        assert_eq!(lift.tolerance_mm(None).unwrap(), 2.5);
    }

    #[test]
    fn a_tolerance_that_is_no_length_is_refused() {
        let path = path(&[[0.0; 2], [1.0, 0.0]], &[true]);
        let rest = motion(vec![[[0.0; 4]; 2]], &[true], vec![Some(0)]);
        for mm in [-1.0, f64::NAN, f64::INFINITY] {
            let message = PathDistance::new(&rest, &path, Some(mm)).unwrap_err().to_string();
            assert!(message.contains("max_path_distance_mm"), "{message}");
        }
    }
}
