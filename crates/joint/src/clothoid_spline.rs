//! A smooth curve through points: one clothoid from each point to the next one, with continuous curvature.
//!
//! The headings at the points are the unknowns. With the angles phi_0 and phi_1 from the chord of length d to the
//! headings at its two ends, a clothoid of length L whose turns are small has
//!
//! ```text
//! kappa_0 L = -4 phi_0 - 2 phi_1,   kappa_1 L = 2 phi_0 + 4 phi_1                                        (1)
//! ```
//!
//! The curvature is continuous where kappa_1 of a clothoid is kappa_0 of the next one. By (1) these are tridiagonal
//! equations for the headings. [`Shape::joined`] finds the clothoids themselves: it shifts both angles in (1) by one
//! number until the end is where it has to be. The turn phi_1 - phi_0 is exact for every shift.
//!
//! Where the curve leaves a straight line, its first heading is that of the line and its curvature begins with 0. Such
//! an end has two clothoids, of the lengths f L and (1 - f) L. With the curvature k between them
//!
//! ```text
//! kappa_1 L = (2 (1 + f) phi_0 + 2 (2 - f) phi_1) / (1 - f),   k L = 2 (phi_1 - phi_0) - (1 - f) kappa_1 L      (2)
//! ```
//!
//! Where the curve begins or ends at rest, its outermost clothoid is a circular arc.
//!
//! Source: E. Bertolazzi and M. Frego, Math. Methods Appl. Sci. 41 (2018) 1723, for (1) with continuous curvature; (2)
//! by the same conditions.

use planish_numerics::{
    linear::tridiagonal::{self, TridiagonalRow as Row},
    motion::clothoid,
};

use crate::piece::{CurvePiece, Station};

/// Largest number of Newton steps for the headings, and of shifts of the angles of one clothoid. Larger: more time for
/// points that no spline of small turns goes through. Smaller: splines are given up that need a step more. Chosen: each
/// step leaves a fraction of the error, of the order of the square of the turn.
const MOST_STEPS: usize = 60;

/// Largest error of an angle at which the Newton steps and the shifts end, rad. Larger: steps of heading and curvature
/// of the curve. Smaller: rounding keeps the iteration going. Chosen: some tens of roundings.
const ANGLE_TOLERANCE_RAD: f64 = 2e-15;

/// Largest error of a curvature times the length of the longer clothoid beside it at which the steps end. Larger: steps
/// of acceleration. Smaller: rounding keeps the steps going. Chosen: some hundred roundings.
const BEND_TOLERANCE_RAD: f64 = 2e-13;

/// Kind of the beginning or end of the curve.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum End {
    /// The curve begins or ends at the outermost point with the machine at rest; no straight line precedes or follows
    /// it.
    Rest,
    /// The curve leaves a straight line at the outermost point. The curvature has a kink at this fraction (f) of the
    /// length of the outermost part, counted from the line.
    Line(f64),
}

/// Kind of the curve between two neighbouring points.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Shape {
    /// One clothoid.
    One,
    /// Two clothoids, of which the first one begins with curvature 0. The number is the fraction (f) of the length of
    /// the first one.
    FromLine(f64),
    /// Two clothoids, of which the last one ends with curvature 0. The number is the fraction (f) of the length of the
    /// last one.
    ToLine(f64),
}

/// Curvatures of a shape times its length, rad: at its start, at the kink between two clothoids if there are two, and
/// at its end.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Bends {
    start: f64,
    /// Position of the kink, as a fraction of the length, and the curvature there; `None` for one clothoid.
    kink: Option<(f64, f64)>,
    end: f64,
}

impl Bends {
    /// Returns the clothoids of a shape of length 1: for each the fraction of the length, and the curvatures at its
    /// start and end.
    fn parts(&self) -> Vec<(f64, [f64; 2])> {
        match self.kink {
            None => vec![(1.0, [self.start, self.end])],
            Some((f, k)) => vec![(f, [self.start, k]), (1.0 - f, [k, self.end])],
        }
    }

    /// Returns the end point of the shape of length 1 that begins at the origin along the first axis.
    fn tip(&self) -> [f64; 2] {
        let mut tip = [0.0; 2];
        let mut heading = 0.0;
        for (length, [from, to]) in self.parts() {
            let sharpness = (to - from) / length;
            let step = clothoid::position(from, sharpness, length);
            tip = plus(tip, turned(step, direction(heading)));
            heading += clothoid::heading(from, sharpness, length);
        }
        tip
    }
}

impl Shape {
    /// Returns the factors of the angles phi_0 and phi_1 in the curvatures at the start and at the end, times the
    /// length, by (1) or (2) of the module. The angles are the headings at both ends, from the chord.
    fn factors(&self) -> [[f64; 2]; 2] {
        match *self {
            Self::One => [[-4.0, -2.0], [2.0, 4.0]],
            Self::FromLine(f) => [[0.0, 0.0], factors_of_line(f)],
            Self::ToLine(f) => {
                let [far, near] = factors_of_line(f);
                [[-near, -far], [0.0, 0.0]]
            }
        }
    }

    fn bends(&self, angles_rad: [f64; 2]) -> Bends {
        let [start, end] = self.factors().map(|f| f[0] * angles_rad[0] + f[1] * angles_rad[1]);
        let turn = angles_rad[1] - angles_rad[0];
        let kink = match *self {
            Self::One => None,
            Self::FromLine(f) => Some((f, 2.0 * turn - (1.0 - f) * end)),
            Self::ToLine(f) => Some((1.0 - f, 2.0 * turn - (1.0 - f) * start)),
        };
        Bends { start, kink, end }
    }

    /// Returns the length of the shape over a chord of `chord_mm`, mm, and its curvatures times this length.
    /// `angles_rad` are the headings at its ends, counted from the chord. Returns `None` if the turns are so large that
    /// the shifts do not converge.
    fn joined(&self, angles_rad: [f64; 2], chord_mm: f64) -> Option<(f64, Bends)> {
        let mut shift = 0.0;
        for _ in 0..MOST_STEPS {
            let bends = self.bends(angles_rad.map(|a| a + shift));
            let [x, y] = bends.tip();
            let error = y.atan2(x) + angles_rad[0];
            if error.abs() <= ANGLE_TOLERANCE_RAD {
                return Some((chord_mm / x.hypot(y), bends));
            }
            shift += error;
        }
        None
    }
}

/// Returns the factors of phi_0 and phi_1 in kappa_1 L, (2) of the module.
fn factors_of_line(f: f64) -> [f64; 2] {
    [2.0 * (1.0 + f) / (1.0 - f), 2.0 * (2.0 - f) / (1.0 - f)]
}

/// Chord between two neighbouring points, with the shape of the curve over it.
struct Chord {
    length_mm: f64,
    /// Unit vector from the first point to the second one.
    along: [f64; 2],
    shape: Shape,
    /// Angle from this chord to the next one, rad, positive to the left; 0 for the last one.
    turn_rad: f64,
}

/// Spline during its solution: the chords, and the headings so far.
struct Spline {
    chords: Vec<Chord>,
    /// Angles from the chord after a point to the heading of the curve there, rad, positive to the left. At the last
    /// point it is from the chord before it.
    angles_rad: Vec<f64>,
    ends: [End; 2],
}

/// Returns the clothoids from each of these points, mm, to the next one: one, or two beside a line. `lines` has the
/// unit vectors of the lines at both ends; an end at rest ignores its own. `None` if the turns are too large, or if
/// `MOST_STEPS` steps find no spline.
pub fn through(
    points_mm: &[[f64; 2]],
    ends: [End; 2],
    lines: [[f64; 2]; 2],
) -> Option<Vec<Vec<CurvePiece>>> {
    let mut spline = Spline::new(points_mm, ends, lines);
    for _ in 0..MOST_STEPS {
        let joined = spline.joined()?;
        if spline.is_continuous(&joined) {
            return Some(spline.arcs(points_mm, &joined));
        }
        let step = spline.step(&joined);
        spline.angles_rad.iter_mut().zip(step).for_each(|(angle, step)| *angle += step);
    }
    None
}

impl Spline {
    fn new(points_mm: &[[f64; 2]], ends: [End; 2], lines: [[f64; 2]; 2]) -> Self {
        let mut chords: Vec<Chord> = points_mm
            .windows(2)
            .map(|w| {
                let [dx, dy] = [w[1][0] - w[0][0], w[1][1] - w[0][1]];
                let length_mm = dx.hypot(dy);
                let along = [dx / length_mm, dy / length_mm];
                Chord { length_mm, along, shape: Shape::One, turn_rad: 0.0 }
            })
            .collect();
        let n = chords.len();
        for k in 1..n {
            chords[k - 1].turn_rad = angle_between(chords[k - 1].along, chords[k].along);
        }
        // Halfway between the chords beside a point
        let mut angles_rad: Vec<f64> = (1..n).map(|k| -0.5 * chords[k - 1].turn_rad).collect();
        let [first, last] = ends;
        angles_rad.insert(
            0,
            match first {
                End::Rest => -0.5 * chords[0].turn_rad,
                End::Line(f) => {
                    chords[0].shape = Shape::FromLine(f);
                    angle_between(chords[0].along, lines[0])
                }
            },
        );
        angles_rad.push(match last {
            End::Rest => 0.5 * chords[n.max(2) - 2].turn_rad,
            End::Line(f) => {
                chords[n - 1].shape = Shape::ToLine(f);
                angle_between(chords[n - 1].along, lines[1])
            }
        });
        Self { chords, angles_rad, ends }
    }

    /// Returns length, mm, and curvatures times length of every shape; `None` if a turn is too large.
    fn joined(&self) -> Option<Vec<(f64, Bends)>> {
        let chords = self.chords.iter().enumerate().map(|(k, chord)| {
            let angles = [self.angles_rad[k], self.angles_rad[k + 1] + chord.turn_rad];
            chord.shape.joined(angles, chord.length_mm)
        });
        chords.collect()
    }

    /// Returns the curvature before an inner point less that after it, 1/mm.
    fn kink_per_mm(joined: &[(f64, Bends)], point: usize) -> f64 {
        let ((before_mm, before), (after_mm, after)) = (&joined[point - 1], &joined[point]);
        before.end / before_mm - after.start / after_mm
    }

    /// Returns the sum of the angles of the curve from the chord at the two ends of an outermost arc, rad; 0 for a
    /// circular arc.
    fn asymmetry_rad(&self, chord: usize) -> f64 {
        self.angles_rad[chord] + self.angles_rad[chord + 1] + self.chords[chord].turn_rad
    }

    fn is_continuous(&self, joined: &[(f64, Bends)]) -> bool {
        let inner = (1..self.chords.len()).all(|k| {
            let length_mm = joined[k - 1].0.max(joined[k].0);
            Self::kink_per_mm(joined, k).abs() * length_mm <= BEND_TOLERANCE_RAD
        });
        let mut outermost = self.ends.into_iter().zip([0, self.chords.len() - 1]);
        inner
            && outermost.all(|(end, chord)| {
                end != End::Rest || self.asymmetry_rad(chord).abs() <= BEND_TOLERANCE_RAD
            })
    }

    /// Returns the changes of the angles by a step of Newton's method, rad, with the derivatives by (1) and (2) of the
    /// module.
    fn step(&self, joined: &[(f64, Bends)]) -> Vec<f64> {
        let n = self.chords.len();
        tridiagonal::solve(n + 1, |k| {
            if k == 0 {
                return self.row_of_end(self.ends[0], [0.0, 1.0, 1.0], 0);
            }
            if k == n {
                return self.row_of_end(self.ends[1], [1.0, 1.0, 0.0], n - 1);
            }
            let [_, before] =
                self.chords[k - 1].shape.factors().map(|f| f.map(|v| v / joined[k - 1].0));
            let [after, _] = self.chords[k].shape.factors().map(|f| f.map(|v| v / joined[k].0));
            let elements = [before[0], before[1] - after[0], -after[1]];
            Row { elements, right: -Self::kink_per_mm(joined, k) }
        })
    }

    /// Returns the row of the Newton step for the heading at an end of the curve, whose outermost chord is `chord`.
    fn row_of_end(&self, end: End, elements: [f64; 3], chord: usize) -> Row {
        match end {
            End::Rest => Row { elements, right: -self.asymmetry_rad(chord) },
            End::Line(_) => Row::held(0.0),
        }
    }

    fn arcs(&self, points_mm: &[[f64; 2]], joined: &[(f64, Bends)]) -> Vec<Vec<CurvePiece>> {
        let shapes = joined.iter().enumerate().map(|(k, (length_mm, bends))| {
            let tangent = turned(direction(self.angles_rad[k]), self.chords[k].along);
            let mut there = Station { point_mm: points_mm[k], tangent, curvature_per_mm: 0.0 };
            let mut arcs = Vec::with_capacity(2);
            for (part, curvatures) in bends.parts() {
                let [curvature_per_mm, end_per_mm] = curvatures.map(|c| c / length_mm);
                let length_mm = part * length_mm;
                let arc = CurvePiece {
                    start: Station { curvature_per_mm, ..there },
                    sharpness_per_mm2: (end_per_mm - curvature_per_mm) / length_mm,
                    from_mm: 0.0,
                    length_mm,
                    segment: 0,
                };
                there = arc.station(length_mm);
                arcs.push(arc);
            }
            arcs
        });
        shapes.collect()
    }
}

fn plus(a: [f64; 2], b: [f64; 2]) -> [f64; 2] {
    [a[0] + b[0], a[1] + b[1]]
}

fn direction(angle_rad: f64) -> [f64; 2] {
    let (sin, cos) = angle_rad.sin_cos();
    [cos, sin]
}

/// Returns the vector turned by the angle from the first axis to the unit vector `[cos, sin]`.
fn turned([x, y]: [f64; 2], [cos, sin]: [f64; 2]) -> [f64; 2] {
    [cos * x - sin * y, sin * x + cos * y]
}

/// Returns the angle from the first vector to the second one, positive to the left, rad.
pub fn angle_between([ax, ay]: [f64; 2], [bx, by]: [f64; 2]) -> f64 {
    (ax * by - ay * bx).atan2(ax * bx + ay * by)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the largest steps from arc to arc: of the position (mm), of the direction, and of the curvature times
    /// length.
    fn steps(arcs: &[CurvePiece]) -> [f64; 3] {
        let mut most = [0.0f64; 3];
        for w in arcs.windows(2) {
            let (end, start) = (w[0].station(w[0].length_mm), w[1].start);
            let (t, u) = (end.tangent, start.tangent);
            let bend = (end.curvature_per_mm - start.curvature_per_mm) * w[0].length_mm;
            let of = [
                (end.point_mm[0] - start.point_mm[0]).hypot(end.point_mm[1] - start.point_mm[1]),
                (t[0] - u[0]).hypot(t[1] - u[1]),
                bend.abs(),
            ];
            most = [0, 1, 2].map(|k| most[k].max(of[k]));
        }
        most
    }

    #[test]
    fn points_of_a_circle_give_the_circle() {
        let (radius, part) = (5.0, 0.3);
        let points: Vec<[f64; 2]> =
            (0..9).map(|k| direction(part * f64::from(k)).map(|v| radius * v)).collect();
        let arcs = through(&points, [End::Rest; 2], [[1.0, 0.0]; 2]).unwrap().concat();
        assert_eq!(arcs.len(), 8);
        for arc in arcs {
            // Below: some tens of roundings of a radius of 5 mm, and of its curvature.
            assert!((arc.length_mm - radius * part).abs() < 1e-13);
            for curvature in arc.curvatures_per_mm() {
                assert!((curvature * radius - 1.0).abs() < 1e-12, "{curvature}");
            }
        }
    }

    #[test]
    fn position_heading_and_curvature_are_continuous() {
        // A wave with unequal steps, from a line to a line and from rest to rest
        let mut at = 0.0;
        let points: Vec<[f64; 2]> = (0..30)
            .map(|k| {
                at += 0.3 + 0.1 * f64::from(k % 3);
                [at, (0.5 * at).sin()]
            })
            .collect();
        let lines =
            [[1.0, 0.4], [1.0, -0.2]].map(|[x, y]: [f64; 2]| [x, y].map(|v| v / x.hypot(y)));
        for ends in [[End::Rest; 2], [End::Line(0.4); 2], [End::Line(0.3), End::Rest]] {
            let arcs = through(&points, ends, lines).unwrap().concat();
            let [position, heading, bend] = steps(&arcs);
            // Some tens of roundings of coordinates of 12 mm, and the tolerance of the steps
            assert!(
                position < 1e-13 && heading < 1e-13 && bend < 1e-12,
                "{position} {heading} {bend}"
            );
            if ends[0] == End::Line(0.4) {
                let (first, last) = (arcs[0], arcs[arcs.len() - 1]);
                let end = last.station(last.length_mm);
                assert_eq!((first.start.curvature_per_mm, end.curvature_per_mm), (0.0, 0.0));
                for (a, b) in [(first.start.tangent, lines[0]), (end.tangent, lines[1])] {
                    // Some tens of roundings of unit vectors.
                    assert!((a[0] - b[0]).hypot(a[1] - b[1]) < 1e-13);
                }
            }
        }
    }

    #[test]
    fn points_of_a_smooth_curve_give_its_curvature_to_the_second_order() {
        // An Archimedean spiral r = b angle, kappa = (2 + angle^2) / (b (1 + angle^2)^(3/2))
        let b = 0.5;
        let error = |n: usize| {
            let angle = |k: usize| 20.0 + 10.0 * k as f64 / n as f64;
            let points: Vec<[f64; 2]> =
                (0..=n).map(|k| direction(angle(k)).map(|v| b * angle(k) * v)).collect();
            let arcs = through(&points, [End::Rest; 2], [[1.0, 0.0]; 2]).unwrap().concat();
            let of = |k: usize| {
                let a = angle(k);
                let kappa = (2.0 + a * a) / (b * (1.0 + a * a).powf(1.5));
                (arcs[k].start.curvature_per_mm / kappa - 1.0).abs()
            };
            (n / 4..3 * n / 4).map(of).fold(0.0, f64::max)
        };
        let (coarse, fine) = (error(80), error(160));
        // 2 in the order: a quarter of the error at half the step, within a tenth
        assert!(coarse < 2e-3 && (coarse / fine / 4.0 - 1.0).abs() < 0.1, "{coarse} {fine}");
    }
}
